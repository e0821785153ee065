"""When frames are shown: a container says so of each, and its rate and its count may tell otherwise."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

#: Of the time of a frame. What is nearer to an even grid is even: time stamps are rounded, in a GIF to 10 ms.
OFF_GRID = 1 / 3
#: Of the longest interval. Nobody knows how long the last frame lasts; what is missing beyond that is missing.
LAST = 1.5


class FrameRate(NamedTuple):
    """How frames follow one another: at an even rate; or, as `times` in seconds from the first, at a mean one.

    `guessed`: the file tells no rate that can be used.
    """

    fps: float
    times: Float[np.ndarray, " num_frames"] | None = None
    guessed: bool = False


def pace_of(seconds: Float[np.ndarray, " num_frames"], fps: float) -> FrameRate:
    """The rate of frames shown at `seconds`, rising; `fps`, the container's, where they agree with it."""
    if len(seconds) < 2:
        return FrameRate(fps)
    times = seconds - seconds[0]
    mean = (len(times) - 1) / times[-1]
    for rate in (fps, mean):
        if np.abs(times - np.arange(len(times)) / rate).max() <= OFF_GRID / rate:
            return FrameRate(rate)
    return FrameRate(mean, times)


def risen(milliseconds: list[float], fps: float) -> Float[np.ndarray, " num_frames"]:
    """Seconds that rise from frame to frame: what stands still or goes back, as in a raw stream, is taken as even."""
    seconds: list[float] = []
    for value in milliseconds:
        known = np.isfinite(value) and (not seconds or value / 1000 > seconds[-1])
        seconds.append(value / 1000 if known else seconds[-1] + 1 / fps if seconds else 0.0)
    return np.array(seconds)


def promised(seconds: Float[np.ndarray, " num_frames"], duration: float, fps: float, reached: int) -> int:
    """Frames in all where a container tells its duration alone, and `reached` frames of it end at seconds[-1]."""
    left, intervals = duration - seconds[-1], np.diff(seconds)
    if left <= LAST * max(1 / fps, intervals.max(initial=0.0)):
        return reached
    return reached - 1 + round(left / (intervals.mean() if len(intervals) else 1 / fps))
