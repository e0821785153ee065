"""One fit as a job: taken up wherever it was left, with the same bits."""

import dataclasses
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from unittest.mock import Mock, patch

import numpy as np
import pytest
from drifting import CONFIG, write_drifting

import foldgauss.jobs.runner as fitting
from foldgauss.io import index_video, load_video_model
from foldgauss.io._atomic import OutputError, lock_output
from foldgauss.io.models.video_model import read_metadata
from foldgauss.jobs import FitJob, Stopped, fit_job
from foldgauss.jobs.job import read_record

NUM_FRAMES = 10


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_drifting(tmp_path_factory.mktemp("clip") / "clip.mp4", NUM_FRAMES)


def job_of(clip, place, name="model.safetensors", **changes):
    return dataclasses.replace(FitJob("clip", str(clip), str(place / name), CONFIG), **changes)


@pytest.fixture(scope="module")
def done(clip, tmp_path_factory):
    """A job that was done in one go, and its record."""
    job = job_of(clip, tmp_path_factory.mktemp("done"))
    return job, fit_job(job)


def test_a_job_leaves_its_model_and_its_record_alone(done):
    job, record = done
    model = load_video_model(job.target)
    assert (model.num_frames, record["num_frames"], record["steps"]) == (NUM_FRAMES, NUM_FRAMES, CONFIG.steps)
    assert len(record["psnr"]) == NUM_FRAMES
    assert record["mean_psnr"] == pytest.approx(np.mean(record["psnr"]), abs=1e-3)
    assert record["file_bytes"] == os.path.getsize(job.target)
    assert json.loads(job.record.read_text()) == json.loads(json.dumps(record)) == read_record(job)
    assert not job.checkpoint.exists()


def test_what_is_done_is_not_done_again(done, monkeypatch):
    job, record = done
    monkeypatch.delattr(fitting, "read_clip_or_model")
    assert fit_job(job) == json.loads(json.dumps(record))


@pytest.mark.parametrize("change", ["config", "source", "size", "model", "record"])
def test_a_record_of_something_else_is_none(done, clip, tmp_path, change):
    job, _record = done
    changed = {
        "config": {"config": dataclasses.replace(CONFIG, steps=13)},
        "source": {"source": {"digest": "another"}},
        "size": {"size": (12, 16)},
        "model": {},
        "record": {},
    }[change]
    other = job_of(clip, tmp_path, **changed)
    for made, wanted in ((job.target, other.target), (job.record, other.record)):
        Path(wanted).write_bytes(Path(made).read_bytes())
    if change == "model":
        Path(other.target).write_bytes(Path(job.target).read_bytes()[:-1])
    if change == "record":
        told = json.loads(job.record.read_text())
        del told["mean_psnr"]
        other.record.write_text(json.dumps(told))
    assert read_record(other) is None


def stopped_after(job, step):
    """The job, asked to stop when it tells of a step so far."""
    with pytest.raises(Stopped):
        fit_job(job, lambda progress: progress.step < step)


@pytest.mark.parametrize(
    "goal",
    [{"quality": 60.0}, *(pytest.param(goal, marks=pytest.mark.slow) for goal in ({}, {"size_mb": 0.006}))],
    ids=str,
)
def test_a_job_stopped_or_killed_at_any_write_goes_on_to_the_same_bits(clip, tmp_path, monkeypatch, goal):
    """The process ends as each file is about to be written; the next does what is left."""
    monkeypatch.setattr(fitting, "REPORT_SECONDS", 0.0)
    (tmp_path / "whole").mkdir()
    config = dataclasses.replace(CONFIG, **goal)
    name, writer = ("model.fgz", "save_compact") if goal else ("model.safetensors", "save_video_model")
    whole, job = (job_of(clip, place, name, config=config) for place in (tmp_path / "whole", tmp_path))
    record, told = fit_job(whole), []
    assert record["file_bytes"] == os.path.getsize(whole.target)
    assert record["file_bytes"] <= 6000 or not goal
    assert load_video_model(whole.target).num_gaussians == record["num_gaussians"]
    assert read_metadata(whole.target)["budget"] == {"steps": CONFIG.steps} | goal
    stopped_after(job, 5)
    assert job.checkpoint.exists()
    assert not Path(job.target).exists()
    often = dataclasses.replace(job, checkpoint_seconds=0.0)
    for writes in ("save_checkpoint", writer, "atomic_path"):
        with patch.object(fitting, writes, side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
            fit_job(often, lambda progress: not told.append(progress.step))
    again = fit_job(job)
    assert told[0] == 6
    assert Path(job.target).read_bytes() == Path(whole.target).read_bytes()
    assert [again[name] for name in ("psnr", "ssim")] == [record[name] for name in ("psnr", "ssim")]
    assert not job.checkpoint.exists()


def test_a_size_is_kept_with_long_metadata(clip, tmp_path):
    config = dataclasses.replace(CONFIG, num_gaussians=600, size_mb=0.009)
    record = fit_job(job_of(clip, tmp_path, "m.fgz", config=config, metadata={"note": "a" * 4000}))
    assert 7000 < record["file_bytes"] <= 9000


def test_a_compact_file_needs_a_goal(clip, tmp_path):
    with pytest.raises(
        ValueError, match=r"config: expected one of a compact model .* Give a quality, a size or a PSNR"
    ):
        fit_job(job_of(clip, tmp_path, "model.fgz"))


@pytest.mark.parametrize(
    ("goals", "num"),
    [({"psnr": 99.0}, 1), ({"psnr": 5.0}, 0), ({"psnr": 99.0, "size_mb": 1.0}, 1), ({"psnr": 99.0, "quality": 1.0}, 1)],
)
def test_a_psnr_out_of_reach_is_noted(clip, tmp_path, goals, num):
    job = job_of(clip, tmp_path, "model.fgz", config=dataclasses.replace(CONFIG, **goals))
    told = [text for text in fit_job(job)["warnings"] if text.startswith("--psnr: expected 99 dB, got ")]
    assert len(told) == num


@pytest.mark.parametrize("damage", ["cut", "other"])
def test_a_checkpoint_that_cannot_be_used_is_an_error_and_stays(clip, tmp_path, monkeypatch, damage):
    monkeypatch.setattr(fitting, "REPORT_SECONDS", 0.0)
    job = job_of(clip, tmp_path)
    if damage == "cut":
        stopped_after(job, 5)
        job.checkpoint.write_bytes(job.checkpoint.read_bytes()[:-10])
    else:
        stopped_after(dataclasses.replace(job, config=dataclasses.replace(CONFIG, seed=1)), 5)
    before = job.checkpoint.read_bytes()
    with pytest.raises(ValueError, match=job.checkpoint.name):
        fit_job(job)
    assert job.checkpoint.read_bytes() == before


def test_a_span_is_found_by_its_index(clip, tmp_path):
    index = index_video(clip)
    path = index.save(tmp_path / "index.npz")
    by_index = job_of(clip, tmp_path, "indexed.safetensors", frames=(3, 9), index=str(path), fps=99.0)
    plain = job_of(clip, tmp_path, "plain.safetensors", frames=(3, 9))
    assert fit_job(by_index)["psnr"] == fit_job(plain)["psnr"]
    assert load_video_model(by_index.target).fps == 99.0


def test_a_job_waits_for_another_of_its_target_and_no_longer_than_it_may(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "WAIT_SECONDS", 0.0)
    job = job_of(clip, tmp_path)
    with lock_output(Path(job.target)), pytest.raises(OutputError, match="no other process is writing"):
        fit_job(job)


def test_a_full_disk_at_a_checkpoint_costs_no_fit(done, clip, tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "save_checkpoint", Mock(side_effect=OutputError("path: expected room, got none.")))
    job = job_of(clip, tmp_path, checkpoint_seconds=0.0)
    fit_job(job)
    assert Path(job.target).read_bytes() == Path(done[0].target).read_bytes()


def test_warnings_of_a_fit_are_in_its_record(clip, tmp_path, monkeypatch):
    real = fitting.run_fit

    def warn(*given):
        warnings.warn("of the\nfit", stacklevel=1)
        warnings.warn("of the fit", stacklevel=1)
        return real(*given)

    monkeypatch.setattr(fitting, "run_fit", warn)
    assert fit_job(job_of(clip, tmp_path))["warnings"] == ["of the fit"]


def test_files_go_where_they_are_asked_to(clip, tmp_path):
    (tmp_path / "records").mkdir()
    job = job_of(clip, tmp_path, folder=str(tmp_path / "records"))
    fit_job(job)
    assert job.record.parent == tmp_path / "records"
    assert job.record.exists()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["model.safetensors", "records"]


def test_what_was_compiled_for_many_shapes_is_forgotten(monkeypatch):
    """Else a worker that goes through a thousand clips would hold programs for each."""
    cleared = Mock()
    monkeypatch.setattr(fitting.jax, "clear_caches", cleared)
    monkeypatch.setattr(fitting, "_SHAPES", set())
    for length, times in [*((length, 0) for length in range(fitting.MAX_SHAPES)), (0, 0), (100, 1), (0, 1)]:
        fitting._limit_compiled((length, 8, 8, 3))
        assert cleared.call_count == times


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a process's largest memory is its own")
def test_the_largest_memory_is_that_of_the_process_alone():
    """Linux' `ru_maxrss` begins with that of the process that started it."""
    own = bytearray(2**20) * 1500
    program = "from foldgauss.jobs.runner import peak_bytes; print(peak_bytes())"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert 2**26 < int(ran.stdout) < len(own) < fitting.peak_bytes()
