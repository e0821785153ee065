"""`FitJob`: a fit with all that it depends on, and the files beside its model; and a job for each clip of a folder."""

import dataclasses
import hashlib
import itertools
import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from foldgauss._runtime.checks import require
from foldgauss.io._atomic import MissingInput, describe_missing
from foldgauss.io.media.images import IMAGE_SUFFIXES, image_paths, natural_sort_key
from foldgauss.io.media.writing import ANIMATION_SUFFIXES
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX
from foldgauss.video import FitConfig

#: Suffixes of video files: a file with one of them is taken for a clip, whatever its content.
CLIP_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".qt", ".mkv", ".webm", ".avi", ".divx", ".wmv", ".asf", ".flv", ".f4v", ".ogv", ".ogg"),
    *(".mpg", ".mpeg", ".m2v", ".vob", ".ts", ".mts", ".m2ts", ".3gp", ".3g2", ".mxf", ".y4m", ".mjpeg", ".ivf"),
    *(".nut", *ANIMATION_SUFFIXES),
)
#: In place of masks: the object that moves.
MOVING = "moving"
#: Folder, beside the models, of checkpoints and records.
RECORDS = "records"
#: Fields of a record besides the request and the scores of each frame.
_RECORD = {
    "num_frames",
    "size",
    "fps",
    "num_gaussians",
    "mean_psnr",
    "mean_ssim",
    "steps",
    "seconds",
    "stopped_by",
    "file_bytes",
    "file_digest",
    "peak_bytes",
    "notes",
    "warnings",
}
#: What reading JSON that is missing, damaged or of another shape may raise.
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, RecursionError)


@dataclasses.dataclass(frozen=True)
class FitJob:
    """A fit of a clip, or of a span of one, with all that it depends on; small, and the same on every machine.

    `clip`, which may be a model file, whose frames are rendered, and `target` are paths that every worker can open;
    `size` is the (height, width) of the frames, or None; `frames` the range (first, stop) of the clip, or None. With
    `index`, the file of a `FrameIndex`, frames are found by seeking, and counted from the first one of the index. `fps`
    replaces the clip's frame rate. `source` identifies the clip: results of another source are not reused. `masks` is
    the path of the masks of objects that get layers of their own, `MOVING` for the object that moves, or "X,Y" or
    "X,Y@FRAME" for the one there, with their `shadows` or without. `metadata` is added to the metadata of the model
    file. Checkpoint and record are in `folder`, by default beside the model.
    """

    name: str
    clip: str
    target: str
    config: FitConfig
    size: tuple[int, int] | None = None
    frames: tuple[int | None, int | None] | None = None
    index: str | None = None
    fps: float | None = None
    checkpoint_seconds: float | None = None
    folder: str | None = None
    source: dict[str, Any] = dataclasses.field(default_factory=dict)
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)
    masks: str | None = None
    shadows: bool = False

    @property
    def request(self) -> dict[str, Any]:
        """What the results depend on, as JSON represents it: results of an equal request are reused."""
        asked = {
            "config": dataclasses.asdict(self.config),
            "size": self.size,
            "frames": self.frames,
            "masks": self.masks,
            "shadows": self.shadows,
        }
        return json.loads(json.dumps(asked | {"source": self.source}))

    @property
    def checkpoint(self) -> Path:
        """The file of the running fit, of its first layer."""
        return self.checkpoint_of(0)

    def checkpoint_of(self, layer: int) -> Path:
        """The file of the running fit of a layer."""
        return self._beside(f".{layer}.checkpoint" if layer else ".checkpoint")

    def remove_checkpoints(self) -> None:
        """Remove the files of the fit."""
        files = itertools.takewhile(Path.exists, map(self.checkpoint_of, itertools.count()))
        for file in reversed(list(files)):  # the first one is left if this is interrupted
            file.unlink()

    @property
    def record(self) -> Path:
        """The file of what `fit_job` returns, as JSON."""
        return self._beside(".json")

    def _beside(self, ending: str) -> Path:
        target = Path(self.target)
        return Path(self.folder or target.parent) / f"{target.name}{ending}"


def read_record(job: FitJob) -> dict[str, Any] | None:
    """The record of a finished job; None if there is none, or the request or the model file differ from it.

    Model files of segments are compared by digest, since segments of equal length have files of equal size.
    """
    try:
        record = json.loads(job.record.read_text())
        same = record["asked"] == job.request and os.path.getsize(job.target) == record["file_bytes"]
        same = same and len(record["psnr"]) == len(record["ssim"]) == record["num_frames"] and record.keys() >= _RECORD
        same = same and (job.index is None or record["file_digest"] == file_digest(job.target))
    except _UNREADABLE:
        return None
    return record if same else None


def file_digest(path: str | os.PathLike) -> str:
    """The 16-byte BLAKE2b digest of a file, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, partial(hashlib.blake2b, digest_size=16)).hexdigest()


def limit_range(frames: tuple[int | None, int | None] | None, num: int) -> tuple[int | None, int | None] | None:
    """The range of `num` frames; it may have ended beyond the clip."""
    if frames is None or frames[1] is None:
        return frames
    return frames[0], min(frames[1], (frames[0] or 0) + num)


def stamp_clip(clip: Path) -> dict[str, list[int]]:
    """Sizes and times of a clip's files, which differ if the clip was replaced."""
    try:
        stats = [path.stat() for path in (image_paths(clip) if clip.is_dir() else [clip])]
    except OSError:
        return {}
    return {"bytes": [stat.st_size for stat in stats], "modified": [stat.st_mtime_ns for stat in stats]}


def write_request(job: FitJob) -> None:
    """Write the request in place of the record. Not atomic: there may be thousands, and half a file reads as none."""
    job.record.write_text(json.dumps({"asked": job.request}) + "\n")


def read_request(job: FitJob) -> dict[str, Any] | None:
    """The request in the job's record, finished or not; None if there is none."""
    try:
        asked = json.loads(job.record.read_text())["asked"]
    except _UNREADABLE:
        return None
    return asked if isinstance(asked, dict) else None


# ------------------------------------------------------------------------------------------------- many clips


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
) -> list[FitJob]:
    """A job for each clip; models go to the folder `out` under the clips' names, such as "one.mp4.fgz".

    They are compact files where `config` asks for compact models.

    Checkpoints and records go to the folder `RECORDS` in `out`, which must exist.
    """
    out, config = Path(out).absolute(), FitConfig() if config is None else config
    return [
        FitJob(
            clip.name,
            str(clip.absolute()),
            str(out / f"{clip.name}{COMPACT_SUFFIX if config.is_compact else MODEL_SUFFIX}"),
            config,
            size,
            frames,
            checkpoint_seconds=checkpoint_seconds,
            folder=str(out / RECORDS),
            source=stamp_clip(clip),
        )
        for clip in clips
    ]
