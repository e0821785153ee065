"""Irregular playback speed from the posterior of frame times: duplicated and dropped frames."""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

from foldgauss._runtime.checks import check_within
from foldgauss.uncertainty.posterior.result import FrameTimePosterior
from foldgauss.video.models.frame_times import is_cut

#: An increment is compared with the median of those up to this many intervals before and after it.
REACH = 4
#: Draws used, evenly spaced among all: the standard error of a probability is below 1%.
MAX_DRAWS = 4000


@dataclasses.dataclass(frozen=True)
class IncrementIntervals:
    """Increments between frames in units of the median increment: 1 is the clip's regular speed.

    **Shapes:** `mean`, `low`, `high` (num_frames - 1,); `low` to `high` contains the fraction `level` of the draws.
    Cuts are excluded from the median.
    """

    mean: Float64[np.ndarray, " intervals"]
    low: Float64[np.ndarray, " intervals"]
    high: Float64[np.ndarray, " intervals"]
    level: float


@dataclasses.dataclass(frozen=True)
class Irregularity:
    """An interval between two frames that is far shorter or longer than its neighbors.

    `frames`: the two frames. `kind`: "duplicated", the second repeats the first, or "dropped", frames between them are
    missing, about `size` - 1. `probability`: fraction of the draws in which this holds. `size`: mean increment in units
    of the local median, `low` to `high` its central 90%.
    """

    frames: tuple[int, int]
    kind: Literal["duplicated", "dropped"]
    probability: float
    size: float
    low: float
    high: float


def increment_intervals(posterior: FrameTimePosterior, level: float = 0.95) -> IncrementIntervals:
    """Means and central intervals of all increments, each draw in units of its own median increment.

    Raises ValueError for a level outside (0, 1).
    """
    check_within("level", level, "(0, 1)", "a number in (0, 1)")
    steps = np.diff(_thin_draws(posterior), axis=1)
    steps /= np.median(steps[:, ~find_cuts(posterior)], axis=1, keepdims=True)
    low, high = np.quantile(steps, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return IncrementIntervals(steps.mean(0), low, high, level)


def is_assessable(posterior: FrameTimePosterior) -> Bool[np.ndarray, " intervals"]:
    """Intervals that `irregularities` assesses: not cuts, both frames identified."""
    identified = posterior.identified()
    return ~find_cuts(posterior) & identified[:-1] & identified[1:]


def irregularities(
    posterior: FrameTimePosterior,
    duplicate: float = 0.25,
    dropped: float = 1.75,
    *,
    probability: float = 0.5,
) -> list[Irregularity]:
    """Intervals below `duplicate` or above `dropped` times the local median in at least `probability` of the draws.

    The local median is that of the four intervals before and after within the shot, in the same draw, so a speed
    that changes smoothly is regular. Cuts (`frame_times.is_cut`) are not reported and limit the neighborhood. Intervals
    of frames that are not identified (`FrameTimePosterior.identified`) are not assessed.

    Raises ValueError for bounds that are not 0 < duplicate < 1 < dropped, and a probability outside (0, 1].

    **Example:** `[one.frames for one in irregularities(posterior) if one.kind == "duplicated"]`.
    """
    check_within("duplicate", duplicate, "(0, 1)", "a number in (0, 1)")
    check_within("dropped", dropped, "(1, inf)", "a number > 1")
    check_within("probability", probability, "(0, 1]", "a number in (0, 1]")
    steps, assessable, found = np.diff(_thin_draws(posterior), axis=1), is_assessable(posterior), []
    for k, near in _neighbors(find_cuts(posterior)):
        if not assessable[k]:
            continue
        size = steps[:, k] / np.median(steps[:, near], axis=1)
        for kind, holds in (("duplicated", size < duplicate), ("dropped", size > dropped)):
            if holds.mean() >= probability:
                low, high = np.quantile(size, [0.05, 0.95])
                summary = float(holds.mean()), float(size.mean()), float(low), float(high)
                found.append(Irregularity((k, k + 1), kind, *summary))
    return found


def _thin_draws(posterior: FrameTimePosterior) -> Float64[np.ndarray, "draws num_frames"]:
    """At most MAX_DRAWS draws, evenly spaced."""
    draws = posterior.draws
    return draws[np.unique(np.linspace(0, len(draws) - 1, MAX_DRAWS).astype(int))]


def find_cuts(posterior: FrameTimePosterior) -> Bool[np.ndarray, " intervals"]:
    """Intervals that are cuts, by the posterior means (`foldgauss.video.models.frame_times.is_cut`)."""
    return np.asarray(is_cut(posterior.mean().astype(np.float32)))


def even_times(posterior: FrameTimePosterior) -> tuple[Float64[np.ndarray, " num_frames"], float]:
    """Evenly spaced times between the first and last frame of every shot, and the mean step: the unit of one frame.

    Without cuts: k / (num_frames - 1), and 1 / (num_frames - 1).
    """
    mean, cut = posterior.mean(), find_cuts(posterior)
    even = mean.copy()
    ends = np.concatenate([[-1], np.flatnonzero(cut), [len(mean) - 1]])
    for before, last in itertools.pairwise(ends):
        even[before + 1 : last + 1] = np.linspace(mean[before + 1], mean[last], last - before)
    return even, float(np.diff(mean)[~cut].mean())


def _neighbors(cut: np.ndarray) -> Iterator[tuple[int, list[int]]]:
    """Each interval that is not a cut, with those near it in the same shot, if there are at least two."""
    shot = np.cumsum(cut)
    for k in np.flatnonzero(~cut):
        around = range(max(k - REACH, 0), min(k + REACH + 1, len(cut)))
        near = [j for j in around if j != k and not cut[j] and shot[j] == shot[k]]
        if len(near) >= 2:
            yield int(k), near
