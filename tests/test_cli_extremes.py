"""The commands with clips at the extremes: one picture, 16 bits, a few pixels, a line of them, plain white."""

import json
import math

import cv2
import numpy as np
import pytest
from commands import call, run

from foldgauss.io import load_video_model, read_video


def ramp(num_frames, height, width, depth=np.uint8):
    """Smooth, and of all bits."""
    y, x = np.mgrid[:height, :width]
    one = np.stack([(x + 1) / (width + 1), (y + 1) / (height + 1), 0.5 + 0.4 * np.sin(8 * x / width)], -1)
    return np.broadcast_to((one * np.iinfo(depth).max).astype(depth), (num_frames, height, width, 3))


CLIPS = {
    "one": ramp(1, 24, 32),
    "two, 16 bits": ramp(2, 24, 32, np.uint16),
    "tiny": ramp(2, 8, 8),
    "line": ramp(2, 1, 600),
    "column": ramp(2, 600, 1),
    "white": np.full((2, 24, 32, 3), 255, np.uint8),
    "black": np.zeros((2, 24, 32, 3), np.uint8),
}
QUICK = ("--gaussians", 300, "--steps", 60)


def written(folder, frames):
    folder.mkdir()
    for k, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / f"{k}.png"), frame[..., ::-1])
    return folder


@pytest.mark.parametrize(
    "name",
    [
        "one",
        *(pytest.param(name, marks=pytest.mark.slow) for name in CLIPS if name != "one"),
    ],
)
def test_from_a_clip_to_its_pictures(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    frames = CLIPS[name]
    clip = written(tmp_path / "clip", frames)
    assert run("fit", clip, "--out", "m.safetensors", *QUICK, "--history", "h.jsonl") == 0
    assert run("evaluate", "m.safetensors", clip, "--json", "s.json") == 0
    scores = json.loads((tmp_path / "s.json").read_text())
    assert 25 < scores["mean_psnr"] <= 100
    assert all(math.isfinite(x) for x in scores["psnr"] + scores["ssim"])
    assert run("info", "m.safetensors") == 0
    assert run("render", "m.safetensors", "--out", "slow", "--fps", 75) == 0
    shown = read_video(tmp_path / "slow").frames
    assert shown.shape == (3 * (len(frames) - 1) + 1, *frames.shape[1:])
    assert np.abs(shown[0].astype(float) - read_video(clip).frames[0]).mean() < 12
    assert run("render", "m.safetensors", "--out", "fast.mp4", "--fps", 60) == 0
    assert run("compress", "m.safetensors", clip, "--quality", 90) == 0
    assert run("evaluate", "m.fgz", clip) == 0
    assert "nan" not in call("export", "m.safetensors", "--format", "ply3dgs", "--out", "scenes").out.lower()


def test_steps_that_do_not_see_all_frames_are_warned_of(tmp_path):
    clip = written(tmp_path / "clip", ramp(9, 16, 16))
    for steps, warned in ((8, True), (9, False)):
        out = tmp_path / f"{steps}.safetensors"
        assert (
            "8 steps use 8 of 9 frames"
            in " ".join(call("fit", clip, "--out", out, "--gaussians", 100, "--steps", steps).err.split())
        ) == warned
        assert load_video_model(out).num_frames == 9
