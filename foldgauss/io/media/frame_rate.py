"""Frame rates and frame times, estimated from the time stamps of a container."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

DEFAULT_FPS = 25.0  # of a folder of images, and of a container without a usable rate
MIN_FPS = 1e-5  # encoders take it as a fraction with a denominator of at most 100,000
MAX_FPS = 1000.0  # time stamps of many containers are milliseconds
#: Longest clip of frames with their own times. MP4 has 32 bits for an interval, in units of 1 / 90,000 s.
MAX_SECONDS = 40_000.0
#: Fraction of a frame interval. Times that deviate less from an even grid count as even: time stamps are rounded, in a
#: GIF to 10 ms.
OFF_GRID = 1 / 3
#: In units of the longest interval. The last frame's duration is not recorded; frames are missing only beyond this.
MAX_LAST_DURATION = 1.5
#: A last frame of at least this many intervals is held; shorter ones may be inexact, as containers round.
MIN_HELD = 2.0


class FrameRate(NamedTuple):
    """The rate of a clip; where its frames are not evenly spaced, their `times` in seconds and `fps` as the mean rate.

    `duration`: seconds to the end of the last one; None where they are evenly spaced.
    `guessed`: the file records no usable rate. `first_second`: as of `Clip`.
    """

    fps: float
    times: Float[np.ndarray, " num_frames"] | None = None
    guessed: bool = False
    first_second: float = 0.0
    duration: float | None = None


def are_rising_seconds(values: object) -> bool:
    """Whether `values` are seconds at which frames are shown: numbers that rise from 0 to at most `MAX_SECONDS`."""
    try:
        seconds = np.asarray(values)
    except (TypeError, ValueError, OverflowError):
        return False
    if seconds.dtype.kind not in "fiu" or seconds.ndim != 1 or not len(seconds) or seconds[0] != 0:
        return False
    return bool((np.diff(seconds.astype(np.float64)) > 0).all() and seconds[-1] <= MAX_SECONDS)


def estimate_rate(seconds: Float[np.ndarray, " num_frames"], fps: float, end: float | None = None) -> FrameRate:
    """The rate of frames shown at the increasing times `seconds`: the container's `fps` where they agree with it.

    It is the default one where theirs is above `MAX_FPS`. `end`: when the last one ends, if that is known.
    """
    if len(seconds) < 2:
        return FrameRate(fps)
    times = seconds - seconds[0]
    last = 0.0 if end is None or end - seconds[0] > MAX_SECONDS else end - seconds[-1]
    mean = (len(times) - 1) / times[-1]
    grid, rates = np.arange(len(times)), (fps, mean)
    even = [FrameRate(rate) for rate in rates if np.abs(times - grid / rate).max() <= OFF_GRID / rate]
    even = [rate for rate in even if last * rate.fps < MIN_HELD]
    duration = float(times[-1] + (last if last > 0 else 1 / mean))
    rate = even[0] if even else FrameRate(mean, times, duration=duration)
    return rate if rate.fps <= MAX_FPS else FrameRate(DEFAULT_FPS, guessed=True)


def describe_rate(rate: FrameRate) -> tuple[str, ...]:
    """Notes about a rate that was guessed, and about uneven frame times."""
    if rate.guessed:
        return (
            f"the file records no usable frame rate; {rate.fps:g} frames per second are assumed unless fps is given.",
        )
    if rate.times is None:
        return ()
    intervals = np.diff([*rate.times, rate.duration])
    return (
        f"frames are shown for {intervals.min():.3g} to {intervals.max():.3g} s, {rate.fps:.4g} per second on average; "
        "all are kept, with their times.",
    )


def make_increasing(stamps: list[float], fps: float) -> Float[np.ndarray, " num_frames"]:
    """Strictly increasing times in seconds: stamps that repeat or decrease, as in raw streams, continue at `fps`."""
    seconds: list[float] = []
    for value in stamps:
        seconds.append(value if not seconds or value > seconds[-1] else seconds[-1] + 1 / fps)
    return np.array(seconds)


def count_ticks(times: Float[np.ndarray, " num"], least: int = 1) -> Int[np.ndarray, " num"]:
    """Times rounded to whole units, at least `least` apart: where frames come more quickly, they are moved apart."""
    ticks, apart = np.rint(times).astype(np.int64), least * np.arange(len(times))
    return np.maximum.accumulate(ticks - apart) + apart
