"""Fits of many clips: finds the clips of a folder, and makes a job for each."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from foldgauss._runtime.checks import require
from foldgauss.io._atomic import MissingInput, describe_missing
from foldgauss.io.media.clip import AS_STORED, Reading
from foldgauss.io.media.images import IMAGE_SUFFIXES, image_paths, natural_sort_key
from foldgauss.io.media.writing import ANIMATION_SUFFIXES
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX
from foldgauss.jobs.job import FitJob, stamp_clip
from foldgauss.video import FitConfig

#: Suffixes of video files: a file with one of them is taken for a clip, whatever its content.
CLIP_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".qt", ".mkv", ".webm", ".avi", ".divx", ".wmv", ".asf", ".flv", ".f4v", ".ogv", ".ogg"),
    *(".mpg", ".mpeg", ".m2v", ".vob", ".ts", ".mts", ".m2ts", ".3gp", ".3g2", ".mxf", ".y4m", ".mjpeg", ".ivf"),
    *(".nut", *ANIMATION_SUFFIXES),
)
#: Folder, beside the models, of checkpoints and records.
RECORDS = "records"


class FoundClips(NamedTuple):
    """The clips of a folder in natural order, and its other entries."""

    clips: list[Path]
    others: list[Path]


def find_clips(folder: str | os.PathLike) -> FoundClips:
    """Video files in `folder`, by their suffixes, and its folders of images; hidden entries are skipped.

    Single images are not clips. Raises FileNotFoundError and ValueError unless `folder` is a folder with clips.
    """
    folder = Path(folder)
    require(
        folder.exists(),
        "folder",
        expected="a folder with clips",
        got=f"{str(folder)!r}, {describe_missing(folder)}",
        kind=MissingInput,
    )
    require(
        folder.is_dir(),
        "folder",
        expected="a folder with clips",
        got=f"the file {str(folder)!r}",
        cure=f"One clip alone: foldgauss fit {folder}.",
    )
    clips, others = [], []
    entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    for entry in sorted(entries, key=lambda entry: natural_sort_key(entry.name)):
        is_clip = bool(image_paths(entry)) if entry.is_dir() else entry.suffix.lower() in CLIP_SUFFIXES
        (clips if is_clip else others).append(entry)
    images = any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in others)
    require(
        clips,
        "folder",
        expected="a folder with clips",
        got=f"{str(folder)!r} without any",
        cure=f"Its images are one clip: foldgauss fit {folder}." if images else "Video files, or folders of images.",
    )
    return FoundClips(clips, others)


def make_jobs(
    clips: Sequence[Path],
    out: str | os.PathLike,
    config: FitConfig | None = None,
    *,
    size: tuple[int, int] | None = None,
    frames: tuple[int | None, int | None] | None = None,
    checkpoint_seconds: float | None = None,
    reading: Reading = AS_STORED,
) -> list[FitJob]:
    """A job for each clip; models go to the folder `out` under the clips' names, such as "one.mp4.fgz".

    They are compact files where `config` asks for compact models.

    Checkpoints and records go to the folder `RECORDS` in `out`, which must exist.
    """
    out, config = Path(out).absolute(), FitConfig() if config is None else config
    jobs = []
    for clip in clips:
        job = FitJob(
            clip.name,
            str(clip.absolute()),
            str(out / f"{clip.name}{COMPACT_SUFFIX if config.is_compact else MODEL_SUFFIX}"),
            config,
            size,
            frames,
            checkpoint_seconds=checkpoint_seconds,
            reading=reading,
            folder=str(out / RECORDS),
            source=stamp_clip(clip),
        )
        jobs.append(job)
    return jobs
