"""What a running fit shows and leaves behind, as a user meets it: history, curves, lines, JSON, nothing."""

import json
import re
import signal
import sys

import cv2
import numpy as np
import pytest
from commands import call, run

from foldgauss.cli.fitting import fit as fitting
from foldgauss.cli.shared import fit_progress as _progress
from foldgauss.io import write_video
from foldgauss.io.history import read_history
from foldgauss.jobs import runner

QUICK = ["--gaussians", "300", "--steps", "20"]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Six frames of a blob that moves."""
    y, x = np.mgrid[0:48, 0:64]
    blob = np.exp(-((x - np.linspace(12, 45, 6)[:, None, None]) ** 2 + (y - 24) ** 2) / 40)
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    return write_video(path, np.stack([255 * blob, 128 + 0 * blob, 255 - 200 * blob], -1).astype(np.uint8), 12.0)


def test_history_and_its_curves(clip, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is an optional extra")
    target, path = tmp_path / "m.safetensors", tmp_path / "m.jsonl"
    assert run("fit", clip, "--out", target, *QUICK, "--history", path) == 0
    history = read_history(path)
    assert [info.step for info in history] == list(range(1, 21))
    assert history[-1].stopped_by == "steps"
    assert history[-1].num_gaussians == 300
    assert history[-1].psnr > history[5].psnr
    assert np.all(np.diff([info.seconds for info in history]) > 0)
    assert min(cv2.imread(str(tmp_path / "m.png")).shape[:2]) > 300
    # Nothing that is there is replaced unasked, be it the history or its curves.
    before = path.read_bytes()
    assert run("fit", clip, "--out", tmp_path / "2.safetensors", *QUICK, "--history", path) == 2
    path.rename(tmp_path / "away.jsonl")
    assert run("fit", clip, "--out", tmp_path / "2.safetensors", *QUICK, "--history", path) == 2
    assert (tmp_path / "away.jsonl").read_bytes() == before
    assert run("fit", clip, "--out", target, *QUICK[:-1], "10", "--history", path, "--overwrite") == 0
    assert len(read_history(path)) == 10


def test_without_matplotlib_only_the_curves_are_missing(clip, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    told, history = ["warning: no curves", "foldgauss[plot]"], tmp_path / "h.jsonl"
    call("fit", clip, "--out", tmp_path / "m.safetensors", *QUICK, "--history", history, err=told)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["h.jsonl", "m.safetensors"]


def test_a_full_disk_ends_the_history_and_not_the_fit(clip, tmp_path, monkeypatch):
    target, write = tmp_path / "m.safetensors", fitting.HistoryFile.__call__

    def full(self, state, info):
        if info.step >= 5:
            raise OSError(28, "No space left on device")
        write(self, state, info)

    monkeypatch.setattr(fitting.HistoryFile, "__call__", full)
    history = ("--history", tmp_path / "h.jsonl")
    told = call("fit", clip, "--out", target, *QUICK, *history, err="no more history from step 5 on").err
    assert target.exists()
    assert len(read_history(tmp_path / "h.jsonl")) == 4
    assert told.count("No space left") == 1


def test_quiet_says_nothing(clip, tmp_path):
    fit = ("fit", clip, "--out", tmp_path / "m.safetensors", *QUICK, "--quiet")
    assert call(*fit) == ("", "")
    assert call(*fit, code=2).err.startswith("error: --out")


def test_log_json_is_json_line_by_line(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(_progress, "JSON_SECONDS", 0.0)
    target = tmp_path / "m :car: [b].safetensors"
    shown, told = call("fit", clip, "--out", target, *QUICK, "--log-json")
    start, *progress, done = map(json.loads, shown.splitlines())
    assert told == ""
    assert (start["event"], start["num_frames"], start["most_gaussians"]) == ("start", 6, 300)
    assert {line["event"] for line in progress} == {"progress"}
    assert [line["step"] for line in progress] == list(range(1, 21))
    assert progress[-1]["progress"] == 1
    assert (done["event"], done["stopped_by"], done["steps"]) == ("done", "steps", 20)
    assert done["model"] == str(target)
    assert done["file_bytes"] == target.stat().st_size
    assert done["mean_psnr"] > 15


def test_json_lines_come_now_and_then_and_at_the_end(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(_progress, "JSON_SECONDS", 1e9)
    shown = call("fit", clip, "--out", tmp_path / "m.safetensors", *QUICK, "--log-json").out
    assert [json.loads(line).get("step") for line in shown.splitlines()] == [None, 1, 20, None]


def test_lines_in_a_log(clip, tmp_path, monkeypatch, capfd):
    """Standard error is no terminal here."""
    monkeypatch.setattr("foldgauss.cli.shared.console.FIRST_LINE_SECONDS", 0.0)
    monkeypatch.setattr("foldgauss.cli.shared.console.LINE_SECONDS", 0.0)
    assert run("fit", clip, "--out", tmp_path / "m.safetensors", *QUICK) == 0
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("Fitting")]
    assert len(lines) == 20
    assert re.fullmatch(r"Fitting  50%  10 steps  loss 0\.\d+  \d+\.\d+ dB  300 Gaussians  \d+ s left", lines[9])
    assert lines[-1].startswith("Fitting 100%  20 steps")
    monkeypatch.undo()  # a fit shorter than the first pause tells its end alone
    assert run("fit", clip, "--out", tmp_path / "m.safetensors", *QUICK, "--overwrite") == 0
    assert len(re.findall("^Fitting", capfd.readouterr().err, re.M)) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_fit_stops_at_once_before_its_first_step(number, clip, tmp_path, monkeypatch):
    def starting(*given, **options):
        signal.raise_signal(number)
        raise AssertionError("went on")
        yield

    monkeypatch.setattr(runner, "fit_steps", starting)
    call(
        "fit",
        clip,
        "--out",
        tmp_path / "m.safetensors",
        *QUICK,
        code=1,
        err=f"stopped by {number.name} before the first step",
    )
    assert list(tmp_path.glob("m.*")) == []
