"""Long clips in segments and many clips at once, by the command."""

import json
import os
import shutil
import signal
import sys

import numpy as np
import pytest
from commands import run

import foldgauss.jobs.runner as fitting
from foldgauss.cli.fitting import job_progress as _jobs_view
from foldgauss.io import load_video_model, read_video, write_image, write_video
from foldgauss.video import SegmentedVideo, VideoModel, evaluate

QUICK = ("--gaussians", "40", "--steps", "12", "--degree", "1")
SEGMENTS = (*QUICK, "--segment-seconds", "1.5")
NUM_FRAMES = 39


def pictures(num_frames, phase=0.0):
    y, x = np.mgrid[:24, :32]
    waves = np.stack([127 + 60 * np.sin((x + 0.4 * k + phase) / 3) * np.cos(y / 4) for k in range(num_frames)])
    return np.repeat(waves[..., None], 3, axis=-1).astype(np.uint8)


@pytest.fixture(scope="module")
def long_clip(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("long") / "long.mp4", pictures(NUM_FRAMES), 10.0)


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Three that can be fitted, one of them a folder, and one that cannot."""
    folder = tmp_path_factory.mktemp("clips")
    for k in range(2):
        write_video(folder / f"clip{k}.mp4", pictures(15, k), 10.0)  # as many as a segment of the long one has
    (folder / "frames").mkdir()
    for k, picture in enumerate(pictures(15, 5.0)):
        write_image(folder / "frames" / f"{k}.png", picture)
    (folder / "broken.mp4").write_text("no video at all")
    (folder / "notes.txt").write_text("about these clips")
    return folder


# ------------------------------------------------------------------------------------------------ fit, in segments


@pytest.fixture(scope="module")
def whole(long_clip, tmp_path_factory):
    """The model of a fit that nothing disturbed."""
    target = tmp_path_factory.mktemp("whole") / "m.safetensors"
    assert run("fit", long_clip, "--out", target, *SEGMENTS, "--quiet") == 0
    return target


def test_a_fit_in_segments_is_one_model(long_clip, whole, tmp_path, capsys):
    target = tmp_path / "m.safetensors"
    assert run("fit", long_clip, "--out", target, *SEGMENTS, "--log-json") == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    start, done = events[0], events[-1]
    video = load_video_model(target)
    assert isinstance(video, SegmentedVideo)
    assert start["spans"] == [[part.first, part.stop] for part in video.segments]
    assert sum(event["event"] == "ended" for event in events) == done["num_segments"] == len(video.segments) == 3
    scores = evaluate(video, read_video(long_clip).frames)
    assert done["mean_psnr"] == pytest.approx(scores.mean_psnr, abs=1e-3)
    assert done["peak_mib"] > 50
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.safetensors"]
    assert target.read_bytes() == whole.read_bytes()


def test_the_plan_and_the_figures_are_told(long_clip, tmp_path, capsys):
    assert run("fit", long_clip, "--out", tmp_path / "m.safetensors", *SEGMENTS) == 0
    told = capsys.readouterr()
    assert "39 frames of 24x32 in 3 segments of" in told.out
    assert "each with 40 Gaussians of degree 1, 12 steps, by this process" in told.out
    assert "1 of 3 segments done: segment 0" in told.err


class Stopping:
    """Sends a signal to this process once a segment tells of itself for the second time."""

    def __init__(self, monkeypatch, name):
        self.name, self.seen, self.watch = name, 0, _jobs_view._View.update
        monkeypatch.setattr(fitting, "REPORT_SECONDS", 0.0)
        monkeypatch.setattr(_jobs_view._View, "update", lambda *each: self(*each))

    def __call__(self, view, name, info):
        self.watch(view, name, info)
        self.seen += name == self.name
        if self.seen == 2:
            os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are POSIX's; CI runs it on Linux")
def test_a_stopped_fit_goes_on_when_the_command_is_given_again(long_clip, whole, tmp_path, capsys, monkeypatch):
    target, folder = tmp_path / "m.safetensors", tmp_path / "m.safetensors.segments"
    with monkeypatch.context() as patch:
        Stopping(patch, "segment 1")
        assert run("fit", long_clip, "--out", target, *SEGMENTS) == 1
    assert "stopped by SIGTERM; 1 of 3 segments are done" in capsys.readouterr().err
    assert (folder / "segment-0001.safetensors.checkpoint").exists()
    assert run("fit", long_clip, "--out", target, *SEGMENTS[:-1], "2") == 2  # not with other options
    assert "segment_seconds=1.5" in capsys.readouterr().err
    assert run("fit", long_clip, "--out", target, *SEGMENTS) == 0
    assert "continuing: 1 of 3 segments done, 1 begun" in capsys.readouterr().err
    assert target.read_bytes() == whole.read_bytes()
    assert not folder.exists()


def test_begun_anew_and_left_alone(long_clip, whole, tmp_path, capsys):
    target, folder = tmp_path / "m.safetensors", tmp_path / "m.safetensors.segments"
    shutil.copyfile(whole, target)
    assert run("fit", long_clip, "--out", target, *SEGMENTS) == 2
    assert "add --overwrite" in capsys.readouterr().err
    folder.mkdir()
    (folder / "mine.txt").write_text("not of a fit")
    assert run("fit", long_clip, "--out", target, *SEGMENTS, "--overwrite") == 2
    assert "mine.txt" in capsys.readouterr().err
    (folder / "mine.txt").rename(folder / "segment-0000.safetensors")
    assert run("fit", long_clip, "--out", target, *SEGMENTS, "--overwrite") == 0
    assert target.read_bytes() == whole.read_bytes()


def stopped(monkeypatch, where, *words):
    with monkeypatch.context() as patch:
        Stopping(patch, where)
        assert run(*words) == 1


def test_that_nobody_listens_any_more_costs_no_fit(long_clip, whole, tmp_path, monkeypatch):
    def gone(event, figures):
        raise BrokenPipeError

    monkeypatch.setattr(_jobs_view, "print_json", gone)
    assert run("fit", long_clip, "--out", tmp_path / "m.safetensors", *SEGMENTS, "--log-json") == 0
    assert (tmp_path / "m.safetensors").read_bytes() == whole.read_bytes()


def test_a_segment_that_fails_leaves_the_others(long_clip, tmp_path, capsys, monkeypatch):
    real = fitting.read_indexed
    (first, _stop) = (13, 28)

    def fails(index, low, high, **named):
        if low <= first < high:
            raise OSError("the disk has gone")
        return real(index, low, high, **named)

    target = tmp_path / "m.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(fitting, "read_indexed", fails)
        assert run("fit", long_clip, "--out", target, *SEGMENTS) == 1
    told = capsys.readouterr().err
    assert "the disk has gone" in told
    assert "segments failed; the others are kept" in told
    assert not target.exists()
    assert run("fit", long_clip, "--out", target, *SEGMENTS) == 0


# ------------------------------------------------------------------------------------------------------- fit-many


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


def test_many_clips_make_a_model_each_and_failures_are_listed(clips, tmp_path, capsys):
    out = tmp_path / "models"
    assert run("fit-many", clips, "--out", out, *QUICK) == 1
    told = capsys.readouterr()
    assert "skipped, not clips: notes.txt" in told.out
    assert "3 models in" in told.out
    assert "1 failed" in told.out
    assert "failed: broken.mp4: path: expected a video file" in told.err
    models = sorted(out.glob("*.fgz"))
    assert [path.name for path in models] == ["clip0.mp4.fgz", "clip1.mp4.fgz", "frames.fgz"]
    for path, source in zip(models, ("clip0.mp4", "clip1.mp4", "frames"), strict=True):
        model = load_video_model(path)
        assert isinstance(model, VideoModel)
        row = next(row for row in summary_of(out)["each"] if row["clip"] == source)
        assert evaluate(model, read_video(clips / source).frames).mean_psnr == pytest.approx(row["mean_psnr"], abs=1e-3)
    assert (summary_of(out)["done"], summary_of(out)["failed"]) == (3, 1)


def test_many_clips_given_again_do_what_is_left(clips, tmp_path, capsys, monkeypatch):
    own, out = tmp_path / "clips", tmp_path / "models"
    shutil.copytree(clips, own)
    assert run("fit-many", own, "--out", out, *QUICK, "--quiet") == 1
    stamps = {path.name: path.stat().st_mtime_ns for path in out.glob("*.fgz")}
    assert run("fit-many", own, "--out", out, *QUICK[:-1], "2") == 2  # not in place of others
    assert "with other settings" in capsys.readouterr().err
    shutil.copyfile(own / "clip0.mp4", own / "broken.mp4")  # mended
    assert run("fit-many", own, "--out", out, *QUICK) == 0
    assert "4 clips, 3 of them done already" in capsys.readouterr().out
    assert all((out / name).stat().st_mtime_ns == stamp for name, stamp in stamps.items())
    assert summary_of(out)["failed"] == 0
    assert run("fit-many", own, "--out", out, *QUICK[:-1], "2", "--overwrite", "--quiet") == 0
    assert {load_video_model(path).degree for path in out.glob("*.fgz")} == {2}


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are POSIX's; CI runs it on Linux")
def test_many_clips_begun_anew_and_stopped_go_on(clips, tmp_path, capsys, monkeypatch):
    out = tmp_path / "models"
    assert run("fit-many", clips, "--out", out, *QUICK, "--quiet") == 1
    other = (*QUICK[:-1], "2")
    stopped(monkeypatch, "clip1.mp4", "fit-many", clips, "--out", out, *other, "--overwrite")
    assert "Give the command again without --overwrite to continue." in capsys.readouterr().err
    assert run("fit-many", clips, "--out", out, *QUICK) == 2  # what is kept is of other settings
    assert "exists, with other settings" in capsys.readouterr().err
    kept = out / "records" / "clip1.mp4.fgz.checkpoint"
    before, stamp = kept.read_bytes(), (out / "clip0.mp4.fgz").stat().st_mtime_ns
    assert run("fit-many", clips, "--out", out, *other[:-1], "3") == 2
    assert kept.read_bytes() == before
    assert run("fit-many", clips, "--out", out, *other) == 1
    assert "4 clips, 1 of them done already" in capsys.readouterr().out
    assert (out / "clip0.mp4.fgz").stat().st_mtime_ns == stamp
    assert {load_video_model(path).degree for path in out.glob("*.fgz")} == {2}


@pytest.mark.parametrize("options", [("--workers", "2"), ("--scheduler", "tcp://127.0.0.1:1")])
def test_without_dask_nothing_is_begun(clips, tmp_path, capsys, monkeypatch, options):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run("fit-many", clips, "--out", tmp_path / "models", *QUICK, *options) == 2
    assert f"{options[0]}: expected dask.distributed, got none. Install it: pip install" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
