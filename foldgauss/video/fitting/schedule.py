"""What each step of a fit uses: its views of the clip, the resolution level of its frames, and its learning rates."""

from typing import NamedTuple

import cv2
import numpy as np

from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.divergence import LOWERED
from foldgauss.video.models.row_layout import columns

#: Frames that tell how good the start is.
LOOKED_AT = 16


def num_views(config: FitConfig, num_frames: int) -> int:
    """Views of a pass: every frame, then with two cameras every frame mirrored."""
    return 2 * num_frames if config.two_cameras else num_frames


def steps_per_pass(config: FitConfig, num_frames: int) -> int:
    return -(-num_views(config, num_frames) // config.batch_size)


def views_of(config: FitConfig, num_frames: int, step: int) -> np.ndarray:
    """Views of a step: every pass visits all once, in an order that depends on seed and pass only.

    View k is frame k; from the number of frames on, frame k - num_frames, mirrored.
    """
    first, num = step * config.batch_size, num_views(config, num_frames)
    positions = np.arange(first, first + config.batch_size)
    return np.array([_order(config, num, p // num)[p % num] for p in positions])


def _order(config: FitConfig, num: int, epoch: int) -> np.ndarray:
    return np.random.default_rng([config.seed, 1, epoch]).permutation(num)


def looked_at(num_frames: int) -> np.ndarray:
    """Frames that tell how good the start is: evenly spaced, from the first to the last."""
    return np.unique(np.linspace(0, num_frames - 1, LOOKED_AT).round().astype(int))


class Rates:
    """Adam's rates by column of a row, and that of the frame times, as they fall."""

    def __init__(self, config: FitConfig):
        width = columns(config.degree)["coefficients"].stop
        self.config, self.first = config, np.empty(width, np.float32)
        self.decayed = np.ones(width, bool)
        for name, place in columns(config.degree).items():
            self.first[place] = getattr(config.rates, name)
            self.decayed[place] = config.decayed in ("all", name)

    def at(self, progress: float, backoffs: int) -> tuple[np.ndarray, np.float32]:
        """Those of rows, float32 (width,), and that of frame times, at a share of the plan and after back-offs."""
        config = self.config
        decay = config.final_rate**progress if config.final_rate > 0 else max(1 - progress, 0.0)
        slower = LOWERED**-backoffs
        rows = np.where(self.decayed, self.first * np.float32(decay), self.first) * np.float32(slower)
        times = config.rates.frame_times * (decay if config.decayed == "all" else 1.0) * slower
        return rows, np.float32(times)


# --------------------------------------------------------------------------------- resolution levels

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
