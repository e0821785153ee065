"""Which clips a folder has, and what their models are called."""

from pathlib import Path

import numpy as np
import pytest

from foldgauss.io import write_image
from foldgauss.jobs import find_clips, make_jobs
from foldgauss.video import FitConfig


def made(folder, *names):
    for name in names:
        (folder / name).write_bytes(b"")
    return folder


def folder_of_images(path):
    path.mkdir()
    write_image(path / "0.png", np.zeros((4, 4, 3), np.uint8))


def test_clips_are_videos_by_name_and_folders_of_images(tmp_path):
    made(tmp_path, "b2.mp4", "b10.MKV", "a.gif", "notes.txt", ".hidden.mp4", "picture.png")
    folder_of_images(tmp_path / "frames")
    (tmp_path / "empty").mkdir()
    found = find_clips(tmp_path)
    assert [clip.name for clip in found.clips] == ["a.gif", "b2.mp4", "b10.MKV", "frames"]
    assert [other.name for other in found.others] == ["empty", "notes.txt", "picture.png"]


@pytest.mark.parametrize(
    ("place", "error", "message"),
    [
        ("none", FileNotFoundError, "missing"),
        ("texts", ValueError, "folder: expected a folder with clips"),
        ("texts/notes.txt", ValueError, "One clip alone: foldgauss fit"),
        ("frames", ValueError, "Its images are one clip"),
    ],
)
def test_what_has_no_clips_is_refused_in_words(tmp_path, place, error, message):
    (tmp_path / "texts").mkdir()
    made(tmp_path / "texts", "notes.txt")
    folder_of_images(tmp_path / "frames")
    with pytest.raises(error, match=message):
        find_clips(tmp_path / place)


@pytest.mark.parametrize(
    "names",
    [
        {"one.mp4": "one.mp4", "One.avi": "One.avi", "two.v1.mp4": "two.v1.mp4"},
        {  # the whole name of one may be the stem of another
            "a.mp4": "a.mp4",
            "a.avi": "a.avi",
            "a.mp4.mkv": "a.mp4.mkv",
            "a.mp4.mkv.gif": "a.mp4.mkv.gif",
            "b.mov": "b.mov",
        },
    ],
)
def test_no_two_clips_have_one_model(tmp_path, names):
    made(tmp_path, *names)
    jobs = make_jobs(find_clips(tmp_path).clips, tmp_path / "out")
    assert {job.name: Path(job.target).name.removesuffix(".safetensors") for job in jobs} == names
    assert {job.record.parent for job in jobs} == {tmp_path / "out" / "records"}


def test_a_clip_in_the_place_of_another_is_another(tmp_path):
    made(tmp_path, "one.mp4")
    before = make_jobs(find_clips(tmp_path).clips, tmp_path)[0]
    (tmp_path / "one.mp4").write_bytes(b"other")
    after = make_jobs(find_clips(tmp_path).clips, tmp_path)[0]
    assert before.request != after.request


def test_settings_reach_each_job(tmp_path):
    made(tmp_path, "one.mp4", "two.mp4")
    config = FitConfig(steps=7)
    jobs = make_jobs(find_clips(tmp_path).clips, tmp_path, config, size=(8, 8), frames=(0, 3), checkpoint_seconds=2.0)
    assert {Path(job.target).name for job in jobs} == {"one.mp4.safetensors", "two.mp4.safetensors"}
    for goal in ({"quality": 50.0}, {"size_mb": 1.0}, {"psnr": 30.0}):  # which ask for compact models
        jobs_of_goal = make_jobs(find_clips(tmp_path).clips, tmp_path, FitConfig(**goal))
        assert {Path(job.target).name for job in jobs_of_goal} == {"one.mp4.fgz", "two.mp4.fgz"}
    assert {(job.config.steps, job.size, job.frames, job.checkpoint_seconds) for job in jobs} == {
        (7, (8, 8), (0, 3), 2.0)
    }
