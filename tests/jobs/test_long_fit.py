"""A long clip in segments: its plan, and what is made of it."""

import dataclasses
import json
import os
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from drifting import CONFIG, SIZE, drifting, write_drifting

import foldgauss.jobs.runner as fitting
import foldgauss.jobs.segments as long
from foldgauss.io import VideoError, index_video, load_video_model, read_video, save_video_model
from foldgauss.io._atomic import OutputError
from foldgauss.io.models.video_model import read_metadata
from foldgauss.jobs import Outcome, Stopped, plan_long_fit, run_here, segments_folder
from foldgauss.video import SegmentedVideo, VideoModel, evaluate

NUM_FRAMES, ASKED = 34, {"segment_seconds": 1.3, "overlap": 2}


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_drifting(tmp_path_factory.mktemp("clip") / "clip.mp4", NUM_FRAMES)


def ignored(name, info):
    return None


def done_here(fit) -> list[Outcome]:
    return list(run_here(fit.jobs, ignored))


def joined(fit):
    return fit.join({outcome.job.name: outcome.record for outcome in done_here(fit)})


@pytest.fixture(scope="module")
def whole(clip, tmp_path_factory):
    """A fit that nothing disturbed, as (its plan, what was joined)."""
    fit = plan_long_fit(clip, tmp_path_factory.mktemp("whole") / "long.safetensors", CONFIG, **ASKED)
    return fit, joined(fit)


def copy_done(whole, fit, num=3):
    """Put the models and records of the first segments in their place, as if they had been done."""
    for job, made in list(zip(fit.jobs, whole[0].jobs, strict=True))[:num]:
        Path(job.target).write_bytes(Path(made.target).read_bytes())
        job.record.write_text(made.record.read_text())


def test_segments_cover_the_clip_and_share_frames(whole):
    fit, _ = whole
    assert len(fit.spans) == 3
    assert fit.spans[0][0] == 0
    assert fit.spans[-1][1] == NUM_FRAMES
    assert all(after[0] == before[1] - 2 for before, after in zip(fit.spans[:-1], fit.spans[1:], strict=True))


def test_scores_are_those_of_the_joined_video(whole, clip):
    fit, made = whole
    video = load_video_model(fit.target)
    assert isinstance(video, SegmentedVideo)
    assert video.num_frames == NUM_FRAMES
    scores = evaluate(video, read_video(clip).frames)
    assert scores.psnr == pytest.approx(made.psnr, abs=2e-4)
    assert scores.ssim == pytest.approx(made.ssim, abs=2e-5)


def test_each_segment_says_what_it_is_of(whole, clip):
    fit, _ = whole
    for (first, stop), job in zip(fit.spans, fit.jobs, strict=True):
        model = load_video_model(job.target)
        mean = json.loads(job.record.read_text())["mean_psnr"]
        clip_of_it = read_video(clip, frames=(first, stop))
        assert isinstance(model, VideoModel)
        assert evaluate(model, clip_of_it.frames).mean_psnr == pytest.approx(mean, abs=1e-3)
    notes = [segment.metadata for segment in load_video_model(fit.target).segments]
    assert [note["frames"] for note in notes] == [list(span) for span in fit.spans]


def test_the_folder_goes_and_what_others_put_there_stays(whole, clip, tmp_path):
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **ASKED)
    assert fit.folder == segments_folder(tmp_path / "long.safetensors")
    copy_done(whole, fit)
    for job in fit.jobs:
        (fit.folder / f".{Path(job.target).stem}.own-01234567.safetensors").write_bytes(b"left by a kill")
    fit.clean_up()
    assert not fit.folder.exists()
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **ASKED)
    (fit.folder / "mine.txt").write_text("kept")
    fit.clean_up()
    assert [entry.name for entry in fit.folder.iterdir()] == ["mine.txt"]


def test_a_plan_is_taken_up_without_looking_through_the_clip_again(whole, clip, tmp_path, monkeypatch):
    target = tmp_path / "long.safetensors"
    first = plan_long_fit(clip, target, CONFIG, **ASKED)
    copy_done(whole, first, 2)  # two segments are done, then the process dies
    with monkeypatch.context() as patched:
        patched.delattr(long, "index_video")
        second = plan_long_fit(clip, target, CONFIG, **ASKED)
    assert second.jobs == first.jobs
    assert second.spans == first.spans
    stamps = [os.stat(job.target).st_mtime_ns for job in first.jobs[:2]]
    joined(second)
    assert [os.stat(job.target).st_mtime_ns for job in first.jobs[:2]] == stamps
    assert second.target.read_bytes() == whole[0].target.read_bytes()


DAMAGES = {"cut": lambda data: data[:20], "other types": lambda data: b'{"asked": [], "clip": 1, "digest": 2}'}


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("plan.json", "other types"),
        ("index.npz", "cut"),
        pytest.param("plan.json", "cut", marks=pytest.mark.slow),
        pytest.param("index.npz", "other types", marks=pytest.mark.slow),
    ],
)
def test_a_plan_that_cannot_be_read_is_made_again(clip, tmp_path, file, damage):
    target = tmp_path / "long.safetensors"
    fit = plan_long_fit(clip, target, CONFIG, **ASKED)
    (fit.folder / file).write_bytes(DAMAGES[damage]((fit.folder / file).read_bytes()))
    again = plan_long_fit(clip, target, CONFIG, **ASKED)
    assert (again.spans, again.jobs) == (fit.spans, fit.jobs)


CHANGES = {
    "segment_seconds": {"segment_seconds": 2.0},
    "overlap": {"overlap": 3},
    "size": {"size": (12, 16)},
    "frames": {"frames": (0, 30)},
    "degree": {"config": dataclasses.replace(CONFIG, degree=2)},
}


@pytest.mark.parametrize("change", CHANGES)
def test_other_options_are_refused_by_name(clip, tmp_path, change):
    target = tmp_path / "long.safetensors"
    plan_long_fit(clip, target, CONFIG, **ASKED)
    with pytest.raises(ValueError, match=f"overwrite: expected {change}=") as refused:
        plan_long_fit(clip, target, **({"config": CONFIG} | ASKED | CHANGES[change]))
    assert "--overwrite" in str(refused.value)


def test_another_clip_in_its_place_is_refused_and_the_same_one_is_not(tmp_path):
    target, clip = tmp_path / "long.safetensors", write_drifting(tmp_path / "clip.mp4", 20)
    plan_long_fit(clip, target, CONFIG, **ASKED)
    os.utime(clip, (1, 1))
    plan_long_fit(clip, target, CONFIG, **ASKED)
    write_drifting(clip, 20, phase=1.0)
    with pytest.raises(ValueError, match="clip: expected the clip that the fit was started with"):
        plan_long_fit(clip, target, CONFIG, **ASKED)


def test_a_short_clip_is_an_ordinary_model(tmp_path):
    clip = write_drifting(tmp_path / "clip.mp4", 10)
    fit = plan_long_fit(clip, tmp_path / "short.safetensors", CONFIG)
    joined(fit)
    assert len(fit.spans) == 1
    assert fit.target.read_bytes() == Path(fit.jobs[0].target).read_bytes()
    assert isinstance(load_video_model(fit.target), VideoModel)


def test_file_sizes_are_shared_out_by_frames(clip, tmp_path):
    config = dataclasses.replace(CONFIG, size_mb=3.4)
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", config, **ASKED)
    lengths, shares = [stop - first for first, stop in fit.spans], [job.config.size_mb for job in fit.jobs]
    room = 3.4 - 0.004 * len(lengths)  # of the one file, though some frames are in two segments
    assert room - 0.002 < sum(shares) < room
    assert shares == pytest.approx([sum(shares) * one / sum(lengths) for one in lengths])
    with pytest.raises(ValueError, match=r"size_mb: expected more than 0\.012\d for 3 segments, got 0\.01"):
        plan_long_fit(clip, tmp_path / "small.fgz", dataclasses.replace(CONFIG, size_mb=0.01), **ASKED)


@pytest.mark.parametrize(
    ("asked", "name"),
    [
        ({"segment_seconds": 0.0}, "segment_seconds"),
        ({"segment_seconds": np.nan}, "segment_seconds"),
        ({"segment_seconds": 1e308}, "segment_seconds"),
        ({"overlap": 0}, "overlap"),
    ],
)
def test_settings_out_of_range_are_refused(clip, tmp_path, asked, name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **asked)
    assert not list(tmp_path.iterdir())


def test_no_segment_is_shorter_than_two_frames(clip, tmp_path):
    """A rate of a frame in ten seconds, or seconds that are few."""
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, segment_seconds=0.01)
    assert {stop - first for first, stop in fit.spans} == {2}


def test_models_in_the_place_of_others_are_not_taken_for_them(whole, clip, tmp_path):
    """Also where the files have one size."""
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **ASKED)
    copy_done(whole, fit)
    records = {outcome.job.name: outcome.record for outcome in done_here(fit)}
    one = Path(fit.jobs[0].target)
    size, model, metadata = one.stat().st_size, load_video_model(one), read_metadata(one)
    other = dataclasses.replace(model, splats=dataclasses.replace(model.splats, loc=model.splats.loc + 0.01))
    save_video_model(one, other, metadata=metadata)
    assert one.stat().st_size == size
    with pytest.raises(OutputError, match="expected segment 0 as it was written"):
        fit.join(records)
    assert not fit.target.exists()
    joined(fit)
    assert fit.target.read_bytes() == whole[0].target.read_bytes()


def test_an_index_of_another_clip_is_made_again(clip, tmp_path):
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **ASKED)
    other = write_drifting(tmp_path / "other.mp4", 20)
    index_video(other).save(fit.folder / "index.npz")
    assert plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **ASKED).jobs == fit.jobs


def test_anew_gives_up_what_is_kept_once_the_clip_can_be_read(clip, tmp_path):
    target = tmp_path / "long.safetensors"
    fit = plan_long_fit(clip, target, CONFIG, **ASKED)
    kept = fit.folder / "segment-0000.safetensors.checkpoint"
    kept.write_bytes(b"hours")
    with pytest.raises(FileNotFoundError):
        plan_long_fit(tmp_path / "none.mp4", target, CONFIG, **ASKED, restart=True)
    (fit.folder / "mine.txt").write_text("")
    with pytest.raises(ValueError, match=r"target: expected only files of a fit in .*'mine.txt' in it"):
        plan_long_fit(clip, target, CONFIG, **ASKED, restart=True)
    (fit.folder / "mine.txt").unlink()
    assert kept.exists()
    changed = plan_long_fit(clip, target, CONFIG, segment_seconds=2.0, restart=True)
    assert changed.spans != fit.spans
    assert not kept.exists()


def test_segments_of_a_damaged_clip_name_the_frames_that_read_video_finds(tmp_path):
    path = tmp_path / "damaged.avi"
    codec = cv2.VideoWriter.fourcc(*"png ")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, 10.0, SIZE[::-1])
    for picture in drifting(NUM_FRAMES):
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    data = bytearray(path.read_bytes())
    starts = [at for at in range(len(data)) if data.startswith(b"\x89PNG", at)]
    for k in (5, 6):
        data[starts[k] : starts[k] + 30] = bytes(30)
    path.write_bytes(data)
    fit = plan_long_fit(path, tmp_path / "long.safetensors", CONFIG, **ASKED, frames=(2, NUM_FRAMES))
    assert fit.index.num_frames < NUM_FRAMES - 2
    whole_clip = read_video(path, frames=(2, NUM_FRAMES)).frames
    for (first, stop), job in zip(fit.spans, fit.jobs, strict=True):
        named = read_video(path, frames=tuple(job.metadata["frames"])).frames
        np.testing.assert_array_equal(named, whole_clip[first:stop])


def test_what_is_no_clip_leaves_nothing(tmp_path):
    (tmp_path / "no.mp4").write_text("no video")
    with pytest.raises(VideoError):
        plan_long_fit(tmp_path / "no.mp4", tmp_path / "long.safetensors")
    assert [entry.name for entry in tmp_path.iterdir()] == ["no.mp4"]


def test_jobs_stop_between_two_and_within_one(clip, tmp_path):
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **ASKED)
    ended = []
    outcomes = run_here(fit.jobs, ignored, should_stop=lambda: bool(ended))
    ended.append(next(outcomes))
    with pytest.raises(Stopped):
        next(outcomes)
    assert len(ended) == 1
    assert ended[0].failure is None


def test_a_failure_of_any_kind_is_an_outcome_and_others_go_on(clip, tmp_path, monkeypatch):
    fit = plan_long_fit(clip, tmp_path / "long.safetensors", CONFIG, **ASKED)
    broken = dataclasses.replace(fit.jobs[0], index=str(tmp_path / "none.npz"))
    outcomes = list(run_here([broken, fit.jobs[1]], ignored))
    assert [outcome.failure is None for outcome in outcomes] == [False, True]
    assert "none.npz" in outcomes[0].failure
    assert "\n" not in outcomes[0].failure
    monkeypatch.setattr(fitting, "fit_steps", Mock(side_effect=ZeroDivisionError("by nothing")))
    (outcome,) = run_here(fit.jobs[:1], ignored)
    assert outcome.failure == "ZeroDivisionError: by nothing"
