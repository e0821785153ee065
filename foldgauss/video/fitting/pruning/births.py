"""Gaussians born where a running fit errs most, drawn and moved as those of the start are."""

import math
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from foldgauss.envelope import TimeLikelihood
from foldgauss.video.fitting.initialize import SCALE_FACTOR, born, drawn, steady, without_end
from foldgauss.video.fitting.optical_flow import Motion
from foldgauss.video.models.row_layout import columns, pack

#: How much smaller newborns are than their neighbours would be if all were evenly spread: errors are finer than what is
#: there already.
SMALLER = 0.6


def newborns(
    num: int,
    frames: UInt8[np.ndarray, "num_frames height width 3"],
    times: Float[np.ndarray, " num_frames"],
    errors: Float[np.ndarray, " num_frames"],
    squares: Callable[[int], Float32[np.ndarray, "height width"]],
    alive: float,
    *,
    degree: int,
    envelope: TimeLikelihood,
    motion: Motion | None,
    opacity: float,
    seed: tuple[int, ...],
) -> Float32[np.ndarray, "num width"]:
    """Packed rows of `num` Gaussians, in frames and at places drawn by squared error, in the clip's own colours.

    `errors` are those of the frames, `squares(k)` those of the pixels of frame k; `alive` Gaussians are in a frame on
    the average.
    """
    rng = np.random.default_rng(seed)
    home = np.sort(rng.choice(len(frames), num, p=errors / errors.sum()))

    def share_of(k: int) -> np.ndarray:
        smooth = cv2.GaussianBlur(squares(k).astype(np.float64), (0, 0), 1.0) + 1e-12
        return smooth / smooth.sum()

    position, _ = drawn(home, share_of, rng)
    splats, _ = born(frames, home, position, times, degree, envelope, motion, rng, opacity)
    rows = pack(without_end(splats, steady(frames, home, position)))
    size = frames.shape[1:3]
    apart = math.sqrt(math.prod(size) / max(alive, 1.0)) / max(size)
    rows[:, columns(degree)["log_scale"]] = np.log(SMALLER * SCALE_FACTOR * apart)
    return rows


def among(num_old: int, num_new: int, rng: np.random.Generator) -> Int[np.ndarray, "all"]:
    """An order of old ones, which keep theirs, with new ones in between: positions in old followed by new."""
    place = np.concatenate([np.arange(num_old) + 0.5, rng.uniform(0, num_old, num_new)])
    return np.argsort(place, kind="stable")
