"""Compact models by `foldgauss fit`, as a user meets them."""

import os
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import call, run

from foldgauss.io import load_video_model, save_compact, write_video
from foldgauss.io.datasets import ball
from foldgauss.io.models.compact import is_compact
from foldgauss.io.models.video_model import read_metadata
from foldgauss.video import FitConfig, fit
from foldgauss.video.compression.quantize import Rule, compute_columns, is_integral, quantize

QUICK = ["--gaussians", "200", "--steps", "60"]
FRAMES = ball(8, size=(48, 64)).clip.frames


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Lossless, so that the frames are the same whatever codecs there are."""
    return write_video(tmp_path_factory.mktemp("clip") / "ball", FRAMES, 12.0)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_the_default_is_a_compact_file(clip, tmp_path):
    call("fit", clip, *QUICK, out="60 steps, quality 70")
    assert [path.name for path in tmp_path.iterdir()] == ["ball.fgz"]
    assert is_compact("ball.fgz")
    about = read_metadata("ball.fgz")
    assert about["budget"] == {"steps": 60, "quality": 70}
    model = load_video_model("ball.fgz")
    assert model.num_gaussians < 200
    call("evaluate", "ball.fgz", clip, out=f"{about['mean_psnr']:.2f}")
    assert run("fit", clip, *QUICK) == 2  # it exists


def test_segments_are_joined_in_a_compact_file(clip):
    assert run("fit", clip, *QUICK, "--segment-seconds", 0.2, "--size-mb", 0.02) == 0
    assert os.path.getsize("ball.fgz") <= 20_000
    video = load_video_model("ball.fgz")
    assert len(video.segments) == 2
    assert all(segment.model.num_gaussians < 200 for segment in video.segments)
    assert read_metadata("ball.fgz")["mean_psnr"] > 20


def test_float32_parameters_on_demand(clip):
    """Without a goal they are not rounded; with a quality the file holds what the compact one decodes to."""
    assert run("fit", clip, *QUICK, "--out", "plain.safetensors") == 0
    assert load_video_model("plain.safetensors").num_gaussians == 200
    assert read_metadata("plain.safetensors")["budget"] == {"steps": 60}
    assert run("fit", clip, *QUICK, "--quality", 70, "--out", "decoded.safetensors") == 0
    assert run("fit", clip, *QUICK) == 0
    one, other = (jax.tree.leaves(load_video_model(name)) for name in ("decoded.safetensors", "ball.fgz"))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.filterwarnings("default:.*chunks is cut off")
def test_a_file_that_is_cut_off_is_shown_with_a_warning(clip):
    """`info` tells the chunks; of a file that is cut off after the first two it also warns, in one line."""
    exact = compute_columns(fit(FRAMES, FitConfig(num_gaussians=90, steps=9), fps=12.0).model)
    rules = {name: Rule(0.0, -9.0) for name in exact.info.column_names if not is_integral(name)}
    save_compact("whole.fgz", quantize(exact, np.zeros(90, np.int32), rules, np.arange(90)[::-1] // 30))
    told = call("info", "whole.fgz")
    assert re.search(r"chunks +│ 3; the first is \d\d% of the file", told.out)
    assert told.err == ""
    data = Path("whole.fgz").read_bytes()
    Path("cut.fgz").write_bytes(data[:-1])
    note = "warning: 'cut.fgz': 1 of its 3 chunks is cut off or damaged; 30 of 90 Gaussians are missing. Copy it again."
    for command in (["info", "cut.fgz"], ["evaluate", "cut.fgz", clip]):
        assert call(*command).err.splitlines() == [note]
    Path("cut.fgz").write_bytes(data[:200])
    (line,) = call("info", "cut.fgz", code=1).err.splitlines()
    assert line.startswith("error: path: expected a compact model, got one")
