"""Provenance: what a model file and a checkpoint record about the frames of the fit."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foldgauss.io.media.clip import Clip
from foldgauss.io.media.indexing import FrameIndex, LazyFrames


def fingerprint(clip: Clip) -> dict[str, Any]:
    """The identity of a clip's frames, independent of its file name; a resumed fit must find the same."""
    digest = hashlib.blake2b(clip.frames, digest_size=16).hexdigest()
    return {"num_frames": clip.num_frames, "size": list(clip.size), "frames_digest": digest}


def describe_source(clip: Clip, seed: int) -> dict[str, Any]:
    """The metadata about the clip and the seed in a model file."""
    return {"clip": Path(clip.source).name, "seed": seed, "frames_digest": fingerprint(clip)["frames_digest"]}


def describe_reading(clip: Clip | FrameIndex) -> dict[str, Any]:
    """The metadata about when frames are shown: `frame_seconds`, with the end, where they are not evenly spaced, and
    `first_second`, as of `Clip`.
    """
    about: dict[str, Any] = {} if clip.times is None else {"frame_seconds": [*clip.times.tolist(), clip.duration]}
    return about | ({"first_second": clip.first_second} if clip.first_second else {})


def has_other_frames(about: Mapping[str, Any], clip: Clip) -> bool:
    """Whether `clip` has other frames than the metadata `about` record; False where they record none.

    Frames that are read lazily, as for a model in segments, are compared before resizing.
    """
    lazy = isinstance(clip.frames, LazyFrames)
    had = about.get("clip_digest" if lazy else "frames_digest")
    if had is None:
        return False
    return had != (clip.frames.index.digest if lazy else fingerprint(clip)["frames_digest"])
