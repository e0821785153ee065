"""Where a model comes from: what its file and its checkpoint say of the frames it was fitted to."""

import hashlib
from pathlib import Path
from typing import Any

from foldgauss.io.video_file import Clip


def fingerprint(clip: Clip) -> dict[str, Any]:
    """What a resumed fit must find again: the frames themselves, whatever they are called now."""
    digest = hashlib.blake2b(clip.frames, digest_size=16).hexdigest()
    return {"num_frames": clip.num_frames, "size": list(clip.size), "frames_digest": digest}


def provenance(clip: Clip, seed: int) -> dict[str, Any]:
    """What is noted in a model's file of where it comes from."""
    return {"clip": Path(clip.source).name, "seed": seed, "frames_digest": fingerprint(clip)["frames_digest"]}
