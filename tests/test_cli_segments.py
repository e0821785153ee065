"""The commands on a model in segments."""

import base64
import dataclasses
import json
import re

import cv2
import numpy as np
import pytest
from commands import call, run
from soft_models import NUM, soft_model

from foldgauss.cli.viewing import view as viewing
from foldgauss.io import load_video_model, read_vegas_ply, read_video, save_video_model, write_frames
from foldgauss.io.models.video_model import read_metadata
from foldgauss.video import Segment, SegmentedVideo, edit, evaluate, interpolate_frames, psnr, times_at

#: Spans 0:7, 4:13 (three frames shared) and 13:18 (a cut).
FIRSTS, LENGTHS, NUM_FRAMES = (0, 4, 13), (7, 9, 5), 18


def video():
    """Of its first segment nothing is noted."""
    parts = [Segment.from_model(first, soft_model(seed=k, num_frames=LENGTHS[k])) for k, first in enumerate(FIRSTS)]
    noted = [dataclasses.replace(part, metadata={"mean_psnr": 31.5, "seed": 3}) for part in parts[1:]]
    return SegmentedVideo([parts[0], *noted])


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """long.safetensors, and what it was fitted to: frames 2 to 19 of the images in clip."""
    folder = tmp_path_factory.mktemp("work")
    frames = np.stack(list(video().frames()))
    noise = np.random.default_rng(0).standard_normal(frames.shape) * np.linspace(2, 9, NUM_FRAMES)[:, None, None, None]
    noisy = np.clip(np.rint(frames + noise), 0, 255).astype(np.uint8)
    write_frames(folder / "clip", [noisy[0], noisy[0], *noisy, noisy[-1]])
    save_video_model(folder / "long.safetensors", video(), metadata={"clip": "clip", "frames": [2, 20]})
    return folder


@pytest.fixture
def here(work, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return work / "long.safetensors"


def pictures(folder):
    return [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in sorted(folder.iterdir())]


@pytest.mark.parametrize(
    ("options", "positions"),
    [
        pytest.param([], range(NUM_FRAMES), marks=pytest.mark.slow),
        (["--fps", 75], np.arange(52) / 3),
        pytest.param(["--fps", 50, "--no-flow"], np.arange(35) / 2, marks=pytest.mark.slow),
        (["--speed", "-0.5"], 17 - np.arange(35) / 2),
        (["--remap", "0=0.48,0.08=0.24"], [12, 9, 6]),
        (["--times", "0:1:5", "--size", "20x32", "--background", "00ff00"], np.linspace(0, 17, 5)),
    ],
)
def test_render_shows_what_the_model_does(options, positions, here, tmp_path):
    assert run("render", here, "--out", tmp_path / "frames", *options) == 0
    clip, how = video(), {"size": (20, 32), "background": (0.0, 1.0, 0.0)} if "--size" in options else {}
    times = times_at(clip.frame_times.times(), np.asarray(positions))
    own = clip.frames(times, **how) if "--no-flow" in options else interpolate_frames(clip, times, **how)
    np.testing.assert_array_equal(pictures(tmp_path / "frames"), list(own))


def test_evaluate_reads_the_clip_bit_by_bit(here, work, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "foldgauss.cli.shared.files.read_video", lambda *_, **__: pytest.fail("the whole clip was read")
    )
    expected = evaluate(video(), read_video(work / "clip", frames=(2, 20)).frames)
    row = f"│ 1 │ 4:13 │ {np.mean(expected.psnr[4:13]):.2f} │ {min(expected.psnr[4:13]):.2f} │"
    assert call("evaluate", here, work / "clip", "--json", tmp_path / "scores.json", out=row).err.count("warning") == 0
    kept = json.loads((tmp_path / "scores.json").read_text())
    assert kept["psnr"] == list(expected.psnr)
    assert kept["num_gaussians"] == 3 * NUM
    call("evaluate", here, work / "clip", "--frames", "0:4", code=2, err="expected 18 frames as in the model, got 4")


def test_evaluate_knows_another_clip(here, work, tmp_path):
    digest = "0" * 32
    save_video_model("noted.safetensors", video(), metadata={"clip": "clip", "frames": [2, 20], "clip_digest": digest})
    call("evaluate", "noted.safetensors", work / "clip", err="are not those that the model was fitted to (clip)")
    assert run("evaluate", here, work / "clip", "--frames", "0:18") == 0


def test_info_tells_the_segments_and_loads_none(here, monkeypatch):
    monkeypatch.setattr("foldgauss.io.models.segmented.load_part", lambda *_: pytest.fail("a model was loaded"))
    texts = [
        "18 of 40x64 (height x width), 25 per second", "3; begin at a cut: 1; fade in: 1", f"{3 * NUM} in all",
        "│ 0 │ 0:7 │ │ 40 │", "│ 1 │ 4:13 │ fading in over 3 │ 40 │ 31.50 │", "│ 2 │ 13:18 │ at a cut │ 40 │",
        "frames of the clip │ [2, 20]",
    ]  # fmt: skip
    call("info", here, out=texts)


def test_exports(here, tmp_path):
    assert run("export", here, "--format", "ply") == 0
    assert len(list((tmp_path / "long-ply").iterdir())) == 3
    assert run("export", here, "--format", "ply") != 0
    assert run("export", here, "--format", "ply", "--overwrite") == 0
    call("export", here, "--format", "ply", "--out", "one.ply", code=2, err="expected a folder without extension")
    assert run("export", here, "--format", "obj", "--times", "0:1:4") == 0
    assert len(list((tmp_path / "long-obj").glob("*.obj"))) == 4
    assert run("export", here, "--format", "ply3dgs", "--times", "0.9") == 0
    assert (tmp_path / "long.3dgs.ply").exists()


def test_one_segment_is_taken_out(here, work, tmp_path):
    call(
        "export",
        here,
        "--format",
        "model",
        "--segment",
        1,
        out="long.1.safetensors: foldgauss (model), 9 frames, 40 Gaussians",
    )
    assert read_metadata("long.1.safetensors") == {"clip": "clip", "frames": [6, 15], "mean_psnr": 31.5, "seed": 3}
    one = load_video_model("long.1.safetensors")
    np.testing.assert_array_equal(list(one.frames()), list(soft_model(seed=1, num_frames=9).frames()))
    assert run("evaluate", "long.1.safetensors", work / "clip") == 0  # its own frames of the clip
    call("export", here, "--format", "model", "--segment", 1, code=2, err="overwrite")
    assert run("export", here, "--format", "ply", "--segment", 2) == 0
    assert read_vegas_ply("long.2.ply", size=one.size).num_frames == 5


def test_a_page_plays_all_segments(here, work, tmp_path, monkeypatch):
    out = tmp_path / "long.html"
    call("view", here, "--out", out, "--original", work / "clip", out="long.html: a page of 0.3 MB")
    page = out.read_text(encoding="utf-8")
    assert page.count('id="model-') == 3
    assert page.count('id="frame-') == NUM_FRAMES
    third = re.search(r'id="frame-2">([^<]*)<', page)[1]
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(third), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    noted = read_video(work / "clip").frames[2 + 2]  # the model's frame 2 is the folder's fourth
    assert psnr(shown, noted) > 25
    served = []
    monkeypatch.setattr(viewing.PageServer, "serve_forever", lambda server: served.append(server.page.decode()))
    assert run("view", here, "--no-browser", "--original", work / "clip") == 0
    (seen,) = served
    assert (seen.count('id="model-'), seen.count('id="frame-')) == (3, NUM_FRAMES)
    assert ">clip<" in seen  # named after its clip


NIGHT = '[[edits]]\ndo = "recolor"\ngain = 0.5\nframes = "4:14"\nease = 3\n'


def test_edit_acts_on_all_segments(here, tmp_path):
    """Into a model, which is edited again and rendered, and into pictures."""
    (tmp_path / "night.toml").write_text(NIGHT)
    call("edit", here, "night.toml", out=f"a model in segments, {3 * NUM} Gaussians")
    wanted = edit(video()).recolor(gain=0.5, frames=(4, 14), ease=3).video()
    made = load_video_model(tmp_path / "long.night.safetensors")
    assert isinstance(made, SegmentedVideo)
    np.testing.assert_array_equal(list(made.frames()), list(wanted.frames()))
    about = read_metadata(tmp_path / "long.night.safetensors")
    assert about == {"clip": "clip", "frames": [2, 20], "edited_by": "night.toml"}
    assert run("edit", "long.night.safetensors", "night.toml", "--out", "twice") == 0
    twice = edit(wanted).recolor(gain=0.5, frames=(4, 14), ease=3).video()
    np.testing.assert_array_equal(pictures(tmp_path / "twice"), list(twice.frames()))
    (tmp_path / "still.toml").write_text('# one\n[[edits]]\ndo = "freeze"\nat = 2\n')
    before = sorted(tmp_path.iterdir())
    call(
        "edit",
        here,
        "still.toml",
        code=1,
        err="still.toml, [[edits]] number 1: at: expected times of the segment that shows",
    )
    assert sorted(tmp_path.iterdir()) == before


def test_what_was_noted_of_quality_is_not_that_of_edited_segments(here, tmp_path):
    noted = [dataclasses.replace(part, metadata={"clip": "clip", "mean_psnr": 30.0}) for part in video().segments]
    save_video_model(tmp_path / "noted.safetensors", SegmentedVideo(noted))
    (tmp_path / "dark.toml").write_text('[[edits]]\ndo = "recolor"\ngain = 0.5\nframe = 0\n')
    words = ("edit", tmp_path / "noted.safetensors", tmp_path / "dark.toml", "--out", tmp_path / "dark.safetensors")
    assert run(*words) == 0
    segments = load_video_model(tmp_path / "dark.safetensors").segments
    assert [segment.metadata for segment in segments] == 3 * [{"clip": "clip"}]


def test_segments_and_edits_keep_uneven_times(tmp_path):
    """A segment is shown as its part of the clip, and an edited model as the clip."""
    whole, seconds = video(), np.cumsum([0, *np.where(np.arange(NUM_FRAMES) % 4, 0.04, 0.3)])
    about = {"frames": [2, 2 + NUM_FRAMES], "frame_seconds": seconds.tolist(), "first_second": 0.5}
    path, script = save_video_model(tmp_path / "long.safetensors", whole, metadata=about), tmp_path / "e.toml"
    assert run("export", path, "--format", "model", "--segment", 1, "--out", tmp_path / "one.safetensors") == 0
    span = whole.segments[1]
    own = seconds[span.first : span.stop + 1]
    found = read_metadata(tmp_path / "one.safetensors")
    np.testing.assert_allclose(found["frame_seconds"], own - own[0])
    assert found["first_second"] == pytest.approx(0.5 + own[0])
    script.write_text('[[edits]]\ndo = "recolor"\ngain = 0.5\n')
    for name, expected in (("one", own - own[0]), ("long", seconds)):
        assert run("edit", tmp_path / f"{name}.safetensors", script, "--out", tmp_path / f"{name}.mp4") == 0
        shown = read_video(tmp_path / f"{name}.mp4")
        np.testing.assert_allclose([*shown.times, shown.duration], expected, atol=1e-4)
        assert run("edit", tmp_path / f"{name}.safetensors", script, "--out", tmp_path / f"{name}-e.safetensors") == 0
        np.testing.assert_allclose(read_metadata(tmp_path / f"{name}-e.safetensors")["frame_seconds"], expected)
