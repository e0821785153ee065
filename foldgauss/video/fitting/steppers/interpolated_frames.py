"""Training images between frames: which steps have one, and what the optical flow predicts there.

Without them, what a fit shows between two frames is not determined: Gaussians that are visible in one frame only add
what that frame lacks, and are wrong half way to the next. Only the steps before `FitConfig.interpolation_end` have
interpolated frames; the others recover the quality at the frames, and lose a part only of what was gained between.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from foldgauss.video.fitting.config import FitConfig, chosen_interpolation
from foldgauss.video.motion.optical_flow import Motion

#: Times lie at least this fraction of an interval away from both of its frames.
MARGIN = 0.1


class InterpolatedFrames:
    """The interpolated frames of a fit, made when they are needed."""

    def __init__(self, frames: np.ndarray, config: FitConfig, chance: float, motion: Motion):
        self.frames, self.config, self.chance, self.motion = frames, config, chance, motion
        self.left_out = {*(k - 1 for k in motion.find_cuts()), *motion.find_still(), len(frames) - 1}

    def choose(self, step: int, progress: float, k: int) -> float | None:
        """At which fraction of the way from frame k to the next the time of a step lies; None for the frame itself."""
        if progress >= self.config.interpolation_end or k in self.left_out or not step:
            return None
        rng = np.random.default_rng([self.config.seed, 2, step, k])
        chosen, fraction = rng.random() < self.chance, rng.uniform(MARGIN, 1 - MARGIN)
        return fraction if chosen else None

    def interpolate(self, k: int, fraction: float, size: tuple[int, int]) -> Float32[np.ndarray, "height width 3"]:
        """The image at a fraction of the way from frame k to the next; values about [0, 1]."""
        return self.motion.interpolate(self.frames, k, fraction, size) * np.float32(1 / 255)


def make_interpolated(
    frames: np.ndarray, config: FitConfig, find_motion: Callable[[], Motion]
) -> InterpolatedFrames | None:
    """The interpolated frames of a fit to `frames`; None where it has none, and so needs no optical flow for them."""
    chance = chosen_interpolation(config, alpha=frames.shape[3] == 4) if len(frames) > 1 else 0.0
    return InterpolatedFrames(frames, config, chance, find_motion()) if chance > 0 else None
