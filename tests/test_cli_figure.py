"""`foldgauss figure`: pictures of pictures, and what is in them."""

from functools import partial

import cv2
import numpy as np
import pytest
from commands import run
from soft_models import SIZE
from tiny_clips import NUM_FRAMES, clip_of, model_of_12, write_both

from foldgauss.cli.shared.contact_sheet import ERROR_GAIN
from foldgauss.io import load_video_model, save_video_model
from foldgauss.video import FrameTimes, VideoModel, interpolate_frames, layers
from foldgauss.video.models.frame_times import make_time_logits, times_at

#: Of a montage: what is left of each picture, what is above it, and what follows the last.
MARGIN, BAND = 8, 26


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work")
    write_both(folder)
    return folder


def tiles(path, rows, columns):
    """The pictures of a montage, by row."""
    picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    height, width = (picture.shape[0] - MARGIN) // rows, (picture.shape[1] - MARGIN) // columns
    assert picture.shape[:2] == (height * rows + MARGIN, width * columns + MARGIN)
    return [
        [picture[r * height + BAND : (r + 1) * height, c * width + MARGIN : (c + 1) * width] for c in range(columns)]
        for r in range(rows)
    ]


def titles(path):
    """How much ink is above the first row."""
    return int((cv2.imread(str(path))[:BAND, MARGIN:].max(-1) < 128).sum())


def test_interpolation_shows_the_times_between(work, tmp_path, capsys):
    out, images = tmp_path / "between.png", {}
    model = load_video_model(work / "model.safetensors")
    times = np.asarray(model.frame_times.times())
    for flow, draw in (("--flow", partial(interpolate_frames, model)), ("--no-flow", model.frames)):
        command = ("figure", "interpolation", work / "model.safetensors", "--at", "3,8", "--out", out, "--overwrite")
        assert run(*command, flow) == 0
        assert "from frame 3 to 4, from frame 8 to 9" in capsys.readouterr().out
        images[flow] = tiles(out, 2, 5)
        for row, k in zip(images[flow], (3, 8), strict=True):
            np.testing.assert_array_equal(row, list(draw(times_at(times, k + np.arange(5) / 4))))
            assert not np.array_equal(row[0], row[4])
    assert not np.array_equal(images["--flow"], images["--no-flow"])
    assert titles(out) > 50


def test_interpolation_follows_learned_times(tmp_path):
    """Half way between two frames is half way between their times, not a place among even ones."""
    model, logits = model_of_12(), np.zeros(NUM_FRAMES - 1, np.float32)
    logits[5] = 1.5
    model = VideoModel(model.splats, FrameTimes(logits), model.size, model.fps, model.options)
    save_video_model(tmp_path / "m.safetensors", model)
    out = tmp_path / "a.png"
    assert run("figure", "interpolation", tmp_path / "m.safetensors", "--parts", 2, "--no-flow", "--out", out) == 0
    times = np.asarray(model.frame_times.times())
    (shown,) = tiles(out, 1, 3)
    expected = list(model.frames(np.array([times[5], (times[5] + times[6]) / 2, times[6]], np.float32)))
    np.testing.assert_allclose(shown, expected, atol=1)


def test_width_and_overwrite(work, tmp_path, capsys):
    out = tmp_path / "a.png"
    command = ("figure", "interpolation", work / "model.safetensors", "--width", 128, "--out", out)
    assert run(*command) == 0
    (row,) = tiles(out, 1, 5)
    assert {one.shape for one in row} == {(80, 128, 3)}
    before = out.read_bytes()
    assert run(*command) == 2
    assert "exists" in capsys.readouterr().err
    assert run(*command, "--parts", 2, "--overwrite") == 0
    assert out.read_bytes() != before
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_cut_is_not_chosen_and_warned_of(tmp_path, capsys):
    model = model_of_12()
    cut = FrameTimes(make_time_logits(NUM_FRAMES, [6]))
    model = VideoModel(model.splats, cut, model.size, model.fps, model.options)
    save_video_model(tmp_path / "m.safetensors", model)
    assert run("figure", "interpolation", tmp_path / "m.safetensors", "--out", tmp_path / "a.png") == 0
    assert "from frame 4 to 5" in capsys.readouterr().out
    assert run("figure", "interpolation", tmp_path / "m.safetensors", "--at", 5, "--out", tmp_path / "b.png") == 0
    assert "there is a cut between frames 5 and 6" in capsys.readouterr().err
    ((first, second, _, fourth, last),) = tiles(tmp_path / "b.png", 1, 5)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(fourth, last)


def test_reconstruction_shows_clip_model_and_difference(work, tmp_path, capsys):
    out = tmp_path / "frames.png"
    command = ("figure", "reconstruction", work / "model.safetensors", work / "clip")
    assert run(*command, "--at", "0,7", "--out", out) == 0
    assert "frame 0, " in capsys.readouterr().out
    model = load_video_model(work / "model.safetensors")
    clip, own = clip_of(model), list(model.frames())
    for row, k in zip(tiles(out, 2, 3), (0, 7), strict=True):
        np.testing.assert_array_equal(row[0], clip[k])
        np.testing.assert_array_equal(row[1], own[k])
        error = np.abs(clip[k].astype(int) - own[k]) * ERROR_GAIN
        np.testing.assert_array_equal(row[2], np.clip(error, 0, 255))
    assert run(*command, "--width", 32, "--out", tmp_path / "small.png") == 0
    for row in tiles(tmp_path / "small.png", 3, 3):
        assert {one.shape for one in row} == {(20, 32, 3)}
    assert "frame 2, " in capsys.readouterr().out


def test_edited_models_and_compact_files(work, tmp_path):
    edited = layers(model_of_12())
    save_video_model(tmp_path / "e.safetensors", edited)
    for name, command in (("a", ("interpolation",)), ("b", ("reconstruction", work / "clip"))):
        kind, *clip = command
        assert run("figure", kind, tmp_path / "e.safetensors", *clip, "--out", tmp_path / f"{name}.png") == 0
    assert len(tiles(tmp_path / "a.png", 1, 5)[0]) == 5


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--at", "11"), "--at: expected frames from 0 to 10"),
        (("--at", "1,x"), "--at: expected frames"),
        (("--at", "-1"), "--at: expected frames"),
        (("--at", ",".join(["1"] * 40)), "--at: expected at most 32"),
        (("--parts", "1"), "--parts: expected a whole number from 2"),
        (("--width", "3"), "--width: expected at least 16"),
        (("--width", "99999999"), "--width: expected an image that fits in memory"),
        (("--out", "a.jpg"), "--out: expected a name ending in .png"),
    ],
)
def test_wrong_use_of_interpolation(work, tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    given = ("--out", "a.png") if "--out" not in arguments else ()
    assert run("figure", "interpolation", work / "model.safetensors", *given, *arguments) != 0
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_wrong_use_of_reconstruction(work, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ("figure", "reconstruction", work / "model.safetensors")
    for arguments, said in (
        ((work / "clip", "--at", "12"), "--at: expected frames from 0 to 11"),
        ((work / "clip", "--width", SIZE[1] + 1), f"--width: expected at most the model's {SIZE[1]}"),
        ((work / "clip", "--frames", "0:5"), "--frames: expected 12 frames"),
        ((work / "nothing",), "nothing"),
    ):
        assert run(*command, *arguments, "--out", "a.png") == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_one_frame_has_no_between(tmp_path, capsys):
    model = model_of_12()
    single = VideoModel(model.splats, FrameTimes.uniform(1), model.size, model.fps, model.options)
    save_video_model(tmp_path / "m.safetensors", single)
    assert run("figure", "interpolation", tmp_path / "m.safetensors", "--out", tmp_path / "a.png") == 2
    assert "expected at least 2 frames, got 1" in capsys.readouterr().err
