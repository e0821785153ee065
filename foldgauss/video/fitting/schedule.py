"""What a step of a fit is given, whatever computes it: its views of the clip and its rates."""

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
