"""Many clips, a model each: which ones there are in a folder, and what their models are called."""

import dataclasses
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from foldgauss._runtime.checks import invalid
from foldgauss.io.media.image_files import IMAGE_SUFFIXES, image_paths, natural_sort_key
from foldgauss.io.media.video_writing import ANIMATION_SUFFIXES
from foldgauss.io.models.video_model import MODEL_SUFFIX
from foldgauss.jobs.fitting import FitJob
from foldgauss.video.fitting.config import FitConfig

#: Names that video files have. A file of such a name is a clip, whatever is in it; others are left alone.
CLIP_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".qt", ".mkv", ".webm", ".avi", ".divx", ".wmv", ".asf", ".flv", ".f4v", ".ogv", ".ogg"),
    *(
        ".mpg",
        ".mpeg",
        ".m2v",
        ".vob",
        ".ts",
        ".mts",
        ".m2ts",
        ".3gp",
        ".3g2",
        ".mxf",
        ".y4m",
        ".mjpeg",
        ".ivf",
        ".nut",
    ),
    *ANIMATION_SUFFIXES,
)


#: Folder, beside the models, for what is kept of each.
RECORDS = "records"


class FoundClips(NamedTuple):
    """Clips of a folder in natural order, and what else is there."""

    clips: list[Path]
    others: list[Path]


def find_clips(folder: str | os.PathLike) -> FoundClips:
    """Video files in `folder`, by their names, and folders of images in it; hidden ones are left out.

    A .webp beside other images is one of them; single images are no clips. Raises FileNotFoundError and ValueError for
    what is no folder, or one without a clip.
    """
    folder = Path(folder)
    if not folder.exists():
        raise FileNotFoundError(f"folder: expected a folder with clips, got {str(folder)!r}, which is missing.")
    if not folder.is_dir():
        cure = f"One clip alone: foldgauss fit {folder}."
        raise invalid("folder", expected="a folder with clips", got=f"the file {str(folder)!r}", cure=cure)
    clips, others = [], []
    entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    for entry in sorted(entries, key=lambda entry: natural_sort_key(entry.name)):
        is_clip = bool(image_paths(entry)) if entry.is_dir() else entry.suffix.lower() in CLIP_SUFFIXES
        (clips if is_clip else others).append(entry)
    if not clips:
        images = any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in others)
        cure = f"Its images are one clip: foldgauss fit {folder}." if images else "Video files, or folders of images."
        raise invalid("folder", expected="a folder with clips", got=f"{str(folder)!r} without any", cure=cure)
    return FoundClips(clips, others)


def jobs_of(
    clips: Sequence[Path],
    out: str | os.PathLike,
    config: FitConfig | None = None,
    *,
    size: tuple[int, int] | None = None,
    frames: tuple[int | None, int | None] | None = None,
    checkpoint_seconds: float | None = None,
) -> list[FitJob]:
    """A job for each clip, whose model goes to `out` under the clip's name, with its extension where two are alike.

    Checkpoints and records go to `RECORDS`, a folder in `out`, which must be there.
    """
    out, config = Path(out).absolute(), FitConfig() if config is None else config
    jobs = []
    for clip, stem in zip(clips, _names(clips), strict=True):
        target = str(out / f"{stem}{MODEL_SUFFIX}")
        job = FitJob(clip.name, str(clip.absolute()), target, config, size, frames, source=_stamp(clip))
        jobs.append(dataclasses.replace(job, checkpoint_seconds=checkpoint_seconds, folder=str(out / RECORDS)))
    return jobs


def _names(clips: Sequence[Path]) -> list[str]:
    """A name of each that no other has: its stem, or all of it."""
    names = [_stem(clip) for clip in clips]
    while True:
        counts = Counter(name.casefold() for name in names)
        alike = [k for k, name in enumerate(names) if counts[name.casefold()] > 1 and name != clips[k].name]
        if not alike:
            return names
        for k in alike:  # and once more, since a.mp4 beside a.avi is called as a.mp4.mkv is
            names[k] = clips[k].name


def _stem(clip: Path) -> str:
    return clip.name if clip.is_dir() else clip.stem


def _stamp(clip: Path) -> dict[str, list[int]]:
    """What tells a clip from one that was put in its place: sizes and times of its file, or of its images."""
    try:
        files = image_paths(clip) if clip.is_dir() else [clip]
        stats = [path.stat() for path in files]
    except OSError:
        return {}
    return {"bytes": [stat.st_size for stat in stats], "modified": [stat.st_mtime_ns for stat in stats]}
