"""Small clips for fits that are done in parts: a pattern that drifts, so that all frames differ."""

from pathlib import Path

import numpy as np

from foldgauss.io import write_video
from foldgauss.video import FitConfig

SIZE = (24, 32)
#: As few steps and Gaussians as show anything; one program for all segments of one length.
CONFIG = FitConfig(num_gaussians=40, steps=12, degree=1)


def drifting(num_frames: int, phase: float = 0.0) -> np.ndarray:
    """Frames uint8 (num_frames, *SIZE, 3)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    moved = [(x + 0.4 * k + phase) / 3.0 for k in range(num_frames)]
    waves = np.stack([127 + 60 * np.sin(one) * np.cos(y / 4) for one in moved])
    colors = np.array([1.0, 0.8, 0.6])
    return np.clip(waves[..., None] * colors, 0, 255).astype(np.uint8)


def write_drifting(path: Path, num_frames: int, phase: float = 0.0) -> Path:
    return write_video(path, drifting(num_frames, phase), 10.0)
