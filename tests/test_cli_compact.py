"""Compact models by `foldgauss fit`, as a user meets them."""

import os
import re
import signal
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import run

from foldgauss.io import load_video_model, save_compact, write_video
from foldgauss.io.datasets import ball
from foldgauss.io.models.compact import is_compact
from foldgauss.io.models.video_model import read_metadata
from foldgauss.jobs import runner
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


def test_the_default_is_a_compact_file(clip, tmp_path, capsys):
    assert run("fit", clip, *QUICK) == 0
    told = capsys.readouterr()
    assert "60 steps, quality 70" in told.out
    assert [path.name for path in tmp_path.iterdir()] == ["ball.fgz"]
    assert is_compact("ball.fgz")
    about = read_metadata("ball.fgz")
    assert about["budget"] == {"steps": 60, "quality": 70}
    model = load_video_model("ball.fgz")
    assert model.num_gaussians < 200
    assert run("evaluate", "ball.fgz", clip) == 0
    assert f"{about['mean_psnr']:.2f}" in capsys.readouterr().out
    assert run("fit", clip, *QUICK) == 2  # it exists


def test_segments_are_joined_in_a_compact_file(clip):
    assert run("fit", clip, *QUICK, "--segment-seconds", 0.2, "--size-mb", 0.02) == 0
    assert os.path.getsize("ball.fgz") <= 20_000
    video = load_video_model("ball.fgz")
    assert len(video.segments) == 2
    assert all(segment.model.num_gaussians < 200 for segment in video.segments)
    assert read_metadata("ball.fgz")["mean_psnr"] > 20


@pytest.mark.parametrize("size_mb", [0.005, 0.007])
def test_the_file_is_no_larger_than_asked_for(clip, size_mb):
    assert run("fit", clip, *QUICK, "--size-mb", size_mb) == 0
    assert os.path.getsize("ball.fgz") <= 1e6 * size_mb
    assert read_metadata("ball.fgz")["budget"] == {"steps": 60, "size_mb": size_mb}


def test_a_psnr_out_of_reach_is_told(clip, capsys):
    assert run("fit", clip, *QUICK, "--psnr", 90) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert re.search(r"warning: --psnr: expected 90 dB, got \d+\.\d\d\. Give more --minutes or --steps", told)
    assert run("fit", clip, *QUICK, "--psnr", 15, "--overwrite") == 0
    assert "--psnr" not in capsys.readouterr().err
    assert read_metadata("ball.fgz")["mean_psnr"] >= 15


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


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are POSIX's; CI runs it on Linux")
@pytest.mark.parametrize("step", [20, 57])
def test_stopped_and_resumed(clip, tmp_path, monkeypatch, capsys, step):
    """Before and between the steps of rounding: the file equals that of a fit that was never stopped."""
    steps = runner.fit_steps

    def stepping(*arguments):
        for state, info in steps(*arguments):
            if info.step == step:
                os.kill(os.getpid(), signal.SIGTERM)
            yield state, info

    with monkeypatch.context() as patch:
        patch.setattr(runner, "fit_steps", stepping)
        assert run("fit", clip, *QUICK) == 1
    assert "Give the same command again to continue." in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["ball.fgz.checkpoint"]
    assert run("fit", clip, *QUICK, "--quality", 60) == 2  # not with another goal
    assert run("fit", clip, *QUICK) == 0
    assert run("fit", clip, *QUICK, "--out", "whole.fgz") == 0
    assert (tmp_path / "ball.fgz").read_bytes() == (tmp_path / "whole.fgz").read_bytes()


@pytest.mark.filterwarnings("default:.*chunks is cut off")
def test_a_file_that_is_cut_off_is_shown_with_a_warning(clip, capsys):
    """`info` tells the chunks; of a file that is cut off after the first two it also warns, in one line."""
    exact = compute_columns(fit(FRAMES, FitConfig(num_gaussians=90, steps=9), fps=12.0).model)
    rules = {name: Rule(0.0, -9.0) for name in exact.info.column_names if not is_integral(name)}
    save_compact("whole.fgz", quantize(exact, np.zeros(90, np.int32), rules, np.arange(90)[::-1] // 30))
    assert run("info", "whole.fgz") == 0
    told = capsys.readouterr()
    assert re.search(r"chunks +│ 3; the first is \d\d% of the file", told.out)
    assert told.err == ""
    data = Path("whole.fgz").read_bytes()
    Path("cut.fgz").write_bytes(data[:-1])
    note = "warning: 'cut.fgz': 1 of its 3 chunks is cut off or damaged; 30 of 90 Gaussians are missing. Copy it again."
    for command in (["info", "cut.fgz"], ["evaluate", "cut.fgz", clip]):
        assert run(*command) == 0
        told = capsys.readouterr()
        assert told.err.splitlines() == [note]
    Path("cut.fgz").write_bytes(data[:200])
    assert run("info", "cut.fgz") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: path: expected a compact model, got one")
