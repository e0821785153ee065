"""`foldgauss render --stabilize`."""

import numpy as np
import pytest
from commands import call, run
from tiny_clips import NUM_FRAMES, model_of_12

from foldgauss.io import load_video_model, read_video, save_video_model
from foldgauss.video import FitConfig, fit, interpolate_frames, interpolated_times, stabilize

STABLE = ("--stabilize", "smooth")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("stabilize") / "m.safetensors"
    save_video_model(path, model_of_12())
    return path


def test_a_camera_that_stands_still_stays(model, tmp_path):
    """Objects move in this clip, the camera does not."""
    images = tmp_path / "images"
    call("render", model, *STABLE, "--out", images, "--border", "keep", "--speed", "0.5", out="23 frames")
    frames = read_video(images).frames
    assert frames.shape == (2 * NUM_FRAMES - 1, 40, 64, 3)
    video = stabilize(load_video_model(model), border="keep")
    times = interpolated_times(np.asarray(video.frame_times.times()), 2)
    np.testing.assert_array_equal(frames, list(interpolate_frames(video, times)))
    assert (
        run("render", model, *STABLE, "--out", images, "--border", "keep", "--speed", "0.5", "--no-flow", "--overwrite")
        == 0
    )
    np.testing.assert_array_equal(read_video(images).frames, list(video.frames(times)))


def test_options_reach_the_video(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ("--stabilize", "fixed", "--border", "fill", "--size", "80x128", "--fps", "12.5")
    call("render", model, *options, out="12.5 frames per second")
    assert read_video(tmp_path / "m.stable.mp4").frames.shape[1:] == (80, 128, 3)
    call("render", model, *STABLE, code=2, err="exists. Choose another path, or add --overwrite.")
    call("render", model, *STABLE, "--overwrite", "--smoothing", "0.2", out="Enlarged by 1.0")
    assert "Enlarged" not in call("render", model, *STABLE, "--overwrite", "--smoothing", "0.001").out  # by 1.00


def test_shots_are_named(tmp_path):
    """Each frame another picture: no motion is known."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (3, 40, 64, 3), np.uint8)
    save_video_model(tmp_path / "m.safetensors", fit(frames, FitConfig(num_gaussians=200, steps=20), fps=5.0).model)
    call(
        "render",
        tmp_path / "m.safetensors",
        *STABLE,
        "--out",
        tmp_path / "images",
        err=[
            "shots, each on its own; they begin at frames 0, ",
            "The motion of the camera was not found before frames",
        ],
    )
