"""Where a model comes from: what its file and its checkpoint say of the frames it was fitted to."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foldgauss.io.media.clip import Clip
from foldgauss.io.media.lazy_frames import LazyFrames


def fingerprint(clip: Clip) -> dict[str, Any]:
    """What a resumed fit must find again: the frames themselves, whatever they are called now."""
    digest = hashlib.blake2b(clip.frames, digest_size=16).hexdigest()
    return {"num_frames": clip.num_frames, "size": list(clip.size), "frames_digest": digest}


def describe_source(clip: Clip, seed: int) -> dict[str, Any]:
    """What is noted in a model's file of where it comes from."""
    return {"clip": Path(clip.source).name, "seed": seed, "frames_digest": fingerprint(clip)["frames_digest"]}


def has_other_frames(about: Mapping[str, Any], clip: Clip) -> bool:
    """Whether `clip` has other frames than a model's file says `about` its own; False where it says nothing.

    Of a clip that is read lazily, as of a model in segments, frames are compared as they are before they are scaled.
    """
    lazy = isinstance(clip.frames, LazyFrames)
    had = about.get("clip_digest" if lazy else "frames_digest")
    if had is None:
        return False
    return had != (clip.frames.index.digest if lazy else fingerprint(clip)["frames_digest"])
