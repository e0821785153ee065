"""Long clips in segments and many clips at once, by the command."""

import json
import os
import shutil
import signal
import sys
from contextlib import contextmanager
from unittest.mock import Mock

import numpy as np
import pytest
from commands import call, run

import foldgauss.jobs.runner as fitting
from foldgauss.cli.fitting import job_progress as _jobs_view
from foldgauss.io import load_video_model, read_video, write_frames, write_video
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
    write_frames(folder / "frames", pictures(15, 5.0))
    (folder / "broken.mp4").write_text("no video at all")
    (folder / "notes.txt").write_text("about these clips")
    return folder


# ------------------------------------------------------------------------------------------------ fit, in segments


@pytest.fixture(scope="module")
def whole(long_clip, tmp_path_factory):
    """The model of a fit that nothing disturbed."""
    target = tmp_path_factory.mktemp("whole") / "m.safetensors"
    told = ["39 frames of 24x32 in 3 segments of", "each with 40 Gaussians of degree 1, 12 steps, by this process"]
    call("fit", long_clip, "--out", target, *SEGMENTS, out=told, err="1 of 3 segments done: segment 0")
    return target


def test_a_fit_in_segments_is_one_model(long_clip, whole, tmp_path):
    target = tmp_path / "m.safetensors"
    shown = call("fit", long_clip, "--out", target, *SEGMENTS, "--log-json").out
    start, *events, done = map(json.loads, shown.splitlines())
    video = load_video_model(target)
    assert isinstance(video, SegmentedVideo)
    assert start["spans"] == [[part.first, part.stop] for part in video.segments]
    assert sum(event["event"] == "ended" for event in events) == done["num_segments"] == len(video.segments) == 3
    scores = evaluate(video, read_video(long_clip).frames)
    assert done["mean_psnr"] == pytest.approx(scores.mean_psnr, abs=1e-3)
    assert done["peak_mib"] > 50
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.safetensors"]
    assert target.read_bytes() == whole.read_bytes()


@contextmanager
def stopped(name):
    """A signal is sent to this process once a job tells of itself for the second time."""
    seen, update = [], _jobs_view._View.update

    def watch(view, share, info):
        update(view, share, info)
        seen.append(share)
        if seen.count(name) == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "REPORT_SECONDS", 0.0)
        patch.setattr(_jobs_view._View, "update", watch)
        yield


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are POSIX's; CI runs it on Linux")
def test_a_stopped_fit_goes_on_when_the_command_is_given_again(long_clip, whole, tmp_path):
    target, folder = tmp_path / "m.safetensors", tmp_path / "m.safetensors.segments"
    with stopped("segment 1"):
        call("fit", long_clip, "--out", target, *SEGMENTS, code=1, err="stopped by SIGTERM; 1 of 3 segments are done")
    assert (folder / "segment-0001.safetensors.checkpoint").exists()
    call("fit", long_clip, "--out", target, *SEGMENTS[:-1], "2", code=2, err="segment_seconds=1.5")
    call(
        "fit",
        long_clip,
        "--out",
        target,
        *QUICK,
        code=2,
        err="expected no other fit to be unfinished, got one in segments",
    )
    call("fit", long_clip, "--out", target, *SEGMENTS, err="continuing: 1 of 3 segments done, 1 begun")
    assert target.read_bytes() == whole.read_bytes()
    assert not folder.exists()


def test_begun_anew_and_left_alone(long_clip, whole, tmp_path):
    target, folder = tmp_path / "m.safetensors", tmp_path / "m.safetensors.segments"
    shutil.copyfile(whole, target)
    call("fit", long_clip, "--out", target, *SEGMENTS, code=2, err="add --overwrite")
    folder.mkdir()
    (folder / "mine.txt").write_text("not of a fit")
    call("fit", long_clip, "--out", target, *SEGMENTS, "--overwrite", code=2, err="mine.txt")
    (folder / "mine.txt").rename(folder / "segment-0000.safetensors")
    assert run("fit", long_clip, "--out", target, *SEGMENTS, "--overwrite") == 0
    assert target.read_bytes() == whole.read_bytes()


def test_that_nobody_listens_any_more_costs_no_fit(long_clip, whole, tmp_path, monkeypatch):
    monkeypatch.setattr("builtins.print", Mock(side_effect=BrokenPipeError))
    assert run("fit", long_clip, "--out", tmp_path / "m.safetensors", *SEGMENTS, "--log-json") == 0
    assert (tmp_path / "m.safetensors").read_bytes() == whole.read_bytes()


def test_a_segment_that_fails_leaves_the_others(long_clip, tmp_path, monkeypatch):
    read, target = fitting.read_indexed, tmp_path / "m.safetensors"

    def fails(index, low, high, **named):
        if low <= 13 < high:
            raise OSError("the disk has gone")
        return read(index, low, high, **named)

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "read_indexed", fails)
        told = ["the disk has gone", "segments failed; the others are kept"]
        call("fit", long_clip, "--out", target, *SEGMENTS, code=1, err=told)
    assert not target.exists()
    assert run("fit", long_clip, "--out", target, *SEGMENTS) == 0


# ------------------------------------------------------------------------------------------------------- fit-many


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


def test_many_clips_make_a_model_each_and_failures_are_listed(clips, tmp_path):
    out = tmp_path / "models"
    call(
        "fit-many",
        clips,
        "--out",
        out,
        *QUICK,
        code=1,
        out=["skipped, not clips: notes.txt", "3 models in", "1 failed"],
        err="failed: broken.mp4: path: expected a video file",
    )
    models = sorted(out.glob("*.fgz"))
    assert [path.name for path in models] == ["clip0.mp4.fgz", "clip1.mp4.fgz", "frames.fgz"]
    for path, source in zip(models, ("clip0.mp4", "clip1.mp4", "frames"), strict=True):
        model = load_video_model(path)
        assert isinstance(model, VideoModel)
        row = next(row for row in summary_of(out)["each"] if row["clip"] == source)
        assert evaluate(model, read_video(clips / source).frames).mean_psnr == pytest.approx(row["mean_psnr"], abs=1e-3)
    assert (summary_of(out)["done"], summary_of(out)["failed"]) == (3, 1)


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are POSIX's; CI runs it on Linux")
def test_many_clips_given_again_do_what_is_left(clips, tmp_path):
    """With other settings only if asked to, and from where they were stopped."""
    own, out, other = shutil.copytree(clips, tmp_path / "clips"), tmp_path / "models", (*QUICK[:-1], "2")
    fit = ("fit-many", own, "--out", out)
    assert run(*fit, *QUICK, "--quiet") == 1
    stamps = {path: path.stat().st_mtime_ns for path in out.glob("*.fgz")}
    call(*fit, *other, code=2, err="exists, with other settings")
    shutil.copyfile(own / "clip0.mp4", own / "broken.mp4")  # mended
    call(*fit, *QUICK, out="4 clips, 3 of them done already")
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())
    assert summary_of(out)["failed"] == 0
    with stopped("clip1.mp4"):
        told = "Give the command again without --overwrite to continue."
        call(*fit, *other, "--overwrite", code=1, err=told)
    kept = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != "summary.json"}
    for settings in (QUICK, (*QUICK[:-1], "3")):  # what is kept is of others
        call(*fit, *settings, code=2, err="exists, with other settings")
    assert out / "records" / "clip1.mp4.fgz.checkpoint" in kept
    assert {path: path.read_bytes() for path in kept} == kept
    call(*fit, *other, out="4 clips, 2 of them done already")
    assert {load_video_model(path).degree for path in out.glob("*.fgz")} == {2}


@pytest.mark.parametrize("options", [("--workers", "2"), ("--scheduler", "tcp://127.0.0.1:1")])
def test_without_dask_nothing_is_begun(clips, tmp_path, monkeypatch, options):
    monkeypatch.setitem(sys.modules, "distributed", None)
    call(
        "fit-many",
        clips,
        "--out",
        tmp_path / "models",
        *QUICK,
        *options,
        code=2,
        err=f"{options[0]}: expected dask.distributed, got none. Install it: pip install",
    )
    assert not list(tmp_path.iterdir())
