"""Coarse to fine: the first part of a fit sees its frames at a quarter and at half of their size.

A step there costs a fraction, and Gaussians that are far off find their place by what is large in the picture.
"""

from typing import NamedTuple

import cv2
import numpy as np

from foldgauss.video.fitting.config import FitConfig

#: Frames are not made smaller than this many pixels along their shorter side: what is left there teaches nothing.
LEAST_SIDE = 120


class Level(NamedTuple):
    """A part of the plan and the size it sees frames at."""

    share: float  # of the plan
    size: tuple[int, int]  # height, width


def levels(config: FitConfig, size: tuple[int, int]) -> list[Level]:
    """The levels of a fit to frames of `size`, coarse to fine; the last is `size` itself.

    A level too small for its frames (`LEAST_SIDE`) gives its share to the next finer one. With `target_psnr` there is
    but one: what is reached at a smaller size says nothing about the clip's own, and the fit must be able to end.
    """
    if config.target_psnr is not None:
        return [Level(1.0, tuple(size))]
    made, pending = [], 0.0
    for factor, share in ((4, config.quarter_fraction), (2, config.half_fraction)):
        pending += share
        small = tuple(max(round(length / factor), 1) for length in size)
        if pending and min(small) >= LEAST_SIDE:
            made.append(Level(pending, small))
            pending = 0.0
    return [*made, Level(1.0 - sum(level.share for level in made), tuple(size))]


def level_at(made: list[Level], progress: float) -> int:
    """Which level a step belongs to, by the share of the plan that is done."""
    end = 0.0
    for index, level in enumerate(made[:-1]):
        end += level.share
        if progress < end:
            return index
    return len(made) - 1


def work_done(made: list[Level], progress: float) -> float:
    """Share of the fit's time that is over at `progress`, a step's time being as its frame's area."""
    end, done, total = 0.0, 0.0, 0.0
    for level in made:
        area = level.size[0] * level.size[1]
        done += area * min(max(progress - end, 0.0), level.share)
        total += area * level.share
        end += level.share
    return min(done / total, 1.0)


def shrunk(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A frame, uint8 (height, width, channels), at a level's size: the mean over each pixel's area."""
    return frame if frame.shape[:2] == size else cv2.resize(frame, size[::-1], interpolation=cv2.INTER_AREA)
