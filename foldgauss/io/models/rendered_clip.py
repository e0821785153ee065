"""Models in place of clips: the frames that a model renders, read as those of a file."""

import os
from collections.abc import Callable, Iterator, Sized
from pathlib import Path
from typing import Any

import numpy as np

from foldgauss.io._atomic import PathLike
from foldgauss.io.media.clip import Clip, ClipFacts, Range, Size, clamp_stop, read_head, translate_os_errors
from foldgauss.io.media.reading import read_video, scan_clip
from foldgauss.io.models.compact import is_compact
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin

_NOTE = "the frames are rendered by a model, over black. Scores compare with them, not with the clip of that model."


def is_model(path: PathLike) -> bool:
    """Whether a file begins as a model file does, compact or not."""
    with translate_os_errors(Path(path)):
        return os.path.isfile(path) and (is_compact(path) or read_head(Path(path))[8:9] == b"{")  # as safetensors


def read_clip_or_model(path: PathLike, *, frames: Range | None = None, size: Size | None = None) -> Clip:
    """As `read_video`; of a model file the frames that it renders, over black, at its size, rate and times.

    Raises as `read_video` and `load_video_model`.
    """
    return read_video(path, frames=frames, size=size, scan=_scan_model if is_model(path) else scan_clip)


def place_in_clip(path: PathLike, clip: Clip, frames: Range | None) -> dict[str, Any]:
    """Metadata: which frames of the model's clip these frames of a model are, and when its video shows the first."""
    about = read_origin(path)
    first = (about.get("frames") or (0,))[0] or 0
    second = about.get("first_second", first / clip.fps) + clip.first_second
    first += (frames or (0,))[0] or 0
    return {"frames": [first, first + clip.num_frames]} | ({"first_second": second} if second else {})


def _scan_model(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], Sized]
) -> tuple[Sized, ClipFacts]:
    """As `scan_clip`, of the frames that a model renders."""
    model = load_video_model(path)
    stop = clamp_stop(start, stop, model.num_frames, path)
    seconds = read_frame_seconds(read_origin(path), model.num_frames)
    if seconds is None:
        seconds = np.arange(model.num_frames + 1) / model.fps
    images = model.frames(np.asarray(model.frame_times.times())[start:stop])
    kept = keep(np.ascontiguousarray(image[..., ::-1]) for image in images)
    return kept, ClipFacts("video", model.fps, model.num_frames, seconds[:stop], 1.0, seconds[stop], [_NOTE])
