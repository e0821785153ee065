"""`foldgauss compress` as a user meets it."""

import json
import re

import equinox as eqx
import numpy as np
import pytest
from commands import call, run

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import load_video_model, read_video, save_video_model, write_video
from foldgauss.io.models.video_model import read_metadata, read_origin
from foldgauss.render import RenderOptions
from foldgauss.video import FoldedSplats, FrameTimes, VideoModel, evaluate

SIZE, FRAMES, NUM = (32, 48), 5, 60


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A model, and a clip that is nearly its pictures."""
    folder, rng = tmp_path_factory.mktemp("work"), np.random.default_rng(0)

    def normal(*shape, scale=1.0, at=0.0):
        return (at + scale * rng.normal(size=(NUM, *shape))).astype(np.float32)

    splats = FoldedSplats(
        loc=normal(2, scale=0.25),
        log_scale=normal(2, scale=0.3, at=-2.3),
        angle_logit=normal(),
        time_loc_logit=normal(scale=0.5),
        log_time_scale=normal(scale=0.2, at=-0.5),
        coefficients=normal(2, 2, scale=0.05),
        opacity_logit=normal(),
        color_dc=normal(3),
        envelope=TimeLikelihood(np.float32(2)),
    )
    model = VideoModel(splats, FrameTimes.uniform(FRAMES), SIZE, 12.0, RenderOptions())
    save_video_model(folder / "model.safetensors", model, metadata={"clip": "clip", "mean_psnr": 33.3})
    pictures = np.stack(list(model.frames())).astype(float) + 5 * rng.normal(size=(FRAMES, *SIZE, 3))
    write_video(folder / "clip", np.clip(pictures, 0, 255).astype(np.uint8), 12.0)
    return folder


def test_compress_and_use(work, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown, progress = call("compress", work / "model.safetensors", work / "clip", "--quality", 80)
    assert re.search(r"^Compressing 100%  \d+ steps  loss .* dB  \d+ Gaussians$", progress, re.MULTILINE)
    assert re.search(r"compression factor\s*│ \d+\.\d\d", shown)
    about = read_metadata("model.fgz")
    assert about["clip"] == "clip"
    assert (tmp_path / "model.fgz").stat().st_size < (work / "model.safetensors").stat().st_size
    scores = []
    for path in (work / "model.safetensors", "model.fgz"):
        assert run("evaluate", path, work / "clip", "--json", "s.json", "--overwrite") == 0
        scores.append(json.loads((tmp_path / "s.json").read_text())["mean_psnr"])
    assert scores[1] > scores[0] - 1.5
    assert scores[1] == pytest.approx(about["mean_psnr"], abs=2e-3)
    call("info", "model.fgz", out="bits per pixel")
    assert run("render", "model.fgz", "--out", "slow.mp4", "--speed", 0.5) == 0
    assert read_video("slow.mp4").num_frames == 9
    assert run("export", "model.fgz", "--format", "ply", "--out", "m.ply") == 0
    (tmp_path / "edits.toml").write_text(
        '[selections.left]\nbox = [0, 0, 24, 32]\nframe = 0\n[[edits]]\nselect = "left"\ndo = "vanish"\n'
    )
    assert run("edit", "model.fgz", "edits.toml", "--out", "edited.safetensors") == 0
    assert load_video_model("edited.safetensors").num_gaussians < load_video_model("model.fgz").num_gaussians
    with pytest.raises(ValueError, match="foldgauss compress"):
        save_video_model("again.fgz", load_video_model("model.fgz"))


ODD = [
    {"mean_psnr": "high"},
    {"mean_psnr": 10**400},
    {"mean_psnr": [33.3]},
    {"frames": "0:5"},
    {"frames": {"0": 5}},
    {"frames": [0]},
    {"frames": [0, "5"]},
    {"frames": [-3, 5]},
    {"frames": [5, 3]},
    {"frames": 5},
    {"frames_digest": ["another's"]},
    {"clip": {"a": 1}, "seed": "0"},
    {"frame_seconds": [0, 0.2, 0.2]},
    {"frame_seconds": [0.1, 0.2]},
    {"frame_seconds": {"0": 0}},
    {"frame_seconds": [0, "1"]},
    {"frame_seconds": 5},
    {"frame_seconds": True},
    {"first_second": -1},
]


@pytest.mark.parametrize(
    "odd", [*ODD[::4], *(pytest.param(odd, marks=pytest.mark.slow) for odd in ODD if odd not in ODD[::4])], ids=str
)
def test_notes_of_another_kind_are_none(work, tmp_path, odd):
    """Files come from strangers: what is no note of a fit is not there, for no command."""
    path, made = tmp_path / "m.safetensors", tmp_path / "m.fgz"
    about = {"clip": "clip", "mean_psnr": 33.3, "frames": [0, FRAMES], "frames_digest": "another's", "mine": [1]} | odd
    save_video_model(path, load_video_model(work / "model.safetensors"), metadata=about)
    assert read_origin(path) == {name: value for name, value in about.items() if name not in odd}
    assert read_metadata(path) == about  # all that was written
    assert run("compress", path, work / "clip", "--minutes", 0.001, "--out", made) == 0
    assert not odd.keys() & read_metadata(made).keys() - {"mean_psnr"}
    assert run("evaluate", path, work / "clip") == 0
    assert run("info", path) == 0
    assert "Traceback" not in call("view", path, "--out", tmp_path / "m.html").err


def test_an_edit_that_is_fitted_away_is_told(work, tmp_path):
    """Baked edits leave a plain model; fitted anew to the clip as it was, it becomes that again."""
    model = load_video_model(work / "model.safetensors")
    bright = eqx.tree_at(lambda m: m.splats.color_dc, model, np.asarray(model.splats.color_dc) + 1)
    path = save_video_model(tmp_path / "bright.safetensors", bright)
    clip = work / "clip", "--quality", 90
    assert re.search(
        r"warning: the compact model is \d+\.\d dB closer to the clip",
        call("compress", path, *clip, "--out", tmp_path / "bright.fgz").err,
    )
    assert "closer" not in call("compress", path, "--out", tmp_path / "rounded.fgz").err


def test_without_the_clip(work, tmp_path):
    """Parameters are rounded, and the pictures stay about what they were."""
    shown, told = call("compress", work / "model.safetensors", "--out", tmp_path / "m.fgz")
    assert "PSNR" not in shown  # of what is not known
    assert "no smaller" not in told
    made, model = load_video_model(tmp_path / "m.fgz"), load_video_model(work / "model.safetensors")
    assert made.num_frames == FRAMES
    assert evaluate(made, np.stack(list(model.frames()))).mean_psnr > 38
    assert read_metadata(tmp_path / "m.fgz") == {"clip": "clip"}  # the scores are of another model
    assert run("compress", work / "model.safetensors", "--quality", 30, "--out", tmp_path / "low.fgz") == 0
    assert (tmp_path / "low.fgz").stat().st_size < (tmp_path / "m.fgz").stat().st_size


@pytest.mark.parametrize("clip", [(), ("clip", "--minutes", 0.01)], ids=["alone", "clip"])
def test_the_size_is_kept_with_long_metadata(work, tmp_path, clip):
    """Seconds of many frames, as of clips whose frames are not evenly spaced, are in the file, too."""
    path = tmp_path / "m.safetensors"
    about = {"frame_seconds": [0.1, 0.2, 0.4, 0.5, 0.7, 0.9], "clip": "long name " * 150}
    save_video_model(path, load_video_model(work / "model.safetensors"), metadata=about)
    words = [work / clip[0], *clip[1:]] if clip else []
    assert run("compress", path, *words, "--size-mb", 0.0065, "--out", tmp_path / "m.fgz") == 0
    assert (tmp_path / "m.fgz").stat().st_size <= 6500
    assert read_metadata(tmp_path / "m.fgz")["clip"] == about["clip"]


def test_a_psnr_is_reached(work, tmp_path):
    goal = (work / "model.safetensors", work / "clip", "--psnr", 25)  # by steps: the machine may be busy
    assert "--psnr" not in call("compress", *goal, "--out", tmp_path / "m.fgz").err
    assert read_metadata(tmp_path / "m.fgz")["mean_psnr"] >= 25
    told = call("compress", *goal[:-1], 90, "--minutes", 0.01, "--out", tmp_path / "n.fgz").err
    assert re.search(r"warning: --psnr: expected 90 dB, got \d+\.\d\d\.", " ".join(told.split()))


def test_a_file_that_is_no_smaller_is_told(work, tmp_path):
    assert run("compress", work / "model.safetensors", "--quality", 40, "--out", tmp_path / "m.fgz") == 0
    assert "n.fgz is no smaller than" in call(
        "compress", tmp_path / "m.fgz", "--quality", 100, "--out", tmp_path / "n.fgz"
    ).err.replace("\n", " ")


def test_the_wrong_clip_is_refused(work, tmp_path, monkeypatch):
    """Fitted anew to it, the model would be lost; one that a decoder changed by a little is taken."""
    monkeypatch.chdir(tmp_path)
    model, frames = load_video_model(work / "model.safetensors"), read_video(work / "clip").frames
    about = {"clip": "clip", "mean_psnr": 33.3, "frames": [0, FRAMES], "frames_digest": "another's"}
    save_video_model("m.safetensors", model, metadata=about)
    write_video("gray", np.full_like(frames, 90), 12.0)
    write_video("short", frames[:3], 12.0)
    call("compress", "m.safetensors", "gray", code=2, err="VIDEO: expected the clip that the model was fitted to")
    assert "VIDEO: expected 5 frames as in the model, got 3 of 'short'. Give the clip" in " ".join(
        call("compress", "m.safetensors", "short", code=2).err.split()
    )
    assert not list(tmp_path.glob("*.fgz"))
    assert run("compress", "m.safetensors", work / "clip", "--minutes", 0.001) == 0
