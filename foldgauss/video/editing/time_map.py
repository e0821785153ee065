"""Maps between two times of the same frames: edits in the time of a whole clip, in the own time of a part of it."""

import dataclasses
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64

from foldgauss._runtime.checks import require
from foldgauss.video.editing.clock import Clock
from foldgauss.video.editing.span import NEVER, Span, distinct_knots

#: Frames. Rounding error of the frame that a clock shows.
_FRAME_TOLERANCE = 1e-6
#: Frames. Times this close are the same, so that edits of a clip in one segment are those of its model.
_SAME = 1e-3


def frame_times_of(video: Any) -> Float64[np.ndarray, " num_frames"]:
    """The frame times of a video, float64."""
    return np.asarray(video.frame_times.times(), np.float64)


@dataclasses.dataclass(frozen=True, eq=False)
class TimeMap:
    """The `own` times of the frames of a segment, and their times in the `whole` clip; linear between frames.

    The whole may also be another video that is stacked with the segment. Methods convert edits of the whole into edits
    in own time.

    **Units:** each in [0, 1], rising.
    """

    own: Float64[np.ndarray, " num_frames"]
    whole: Float64[np.ndarray, " num_frames"]

    @property
    def is_identity(self) -> bool:
        """Whether both times are the same, to `_SAME`."""
        return bool(np.abs(self.own - self.whole).max() * max(len(self.own) - 1, 1) <= _SAME)

    def to_own(self, t: float) -> float:
        """The own time at a time of the whole; before the first frame and after the last, the time of that frame."""
        return float(np.interp(t, self.whole, self.own))

    def to_whole(self, t: float) -> float:
        """The time of the whole at an own time."""
        return float(np.interp(t, self.own, self.whole))

    def convert_function(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function whose last argument is a time of the whole, as a function of own time."""

        def converted(*arguments: Any) -> Any:
            *others, t = arguments
            return function(*others, self.to_whole(float(t)))

        return converted

    def convert_span(self, span: Span) -> Span:
        """The span in own time; `NEVER` if it does not reach the segment. Progress at a moment stays."""
        first, last = self.whole[[0, -1]].tolist()
        if (span.start is not None and span.start > last) or (span.stop is not None and span.stop <= first):
            return NEVER
        start = None if span.start is None or span.start <= first else self.to_own(span.start)
        stop = None if span.stop is None or span.stop > last else self.to_own(span.stop)
        if not span.times:
            return Span(start, stop, curve=span.curve)
        corners = np.unique(np.clip([first, last, *span.times, *self.whole], first, last))
        times, values = np.interp(corners, self.whole, self.own), np.interp(corners, span.times, span.values)
        return Span(start, stop, *distinct_knots(times, values), span.curve)

    def convert_clock(self, clock: Clock) -> Clock:
        """The clock from own time to own time, for a clock that shows frames of the segment only."""
        first, last = self.whole[[0, -1]]
        knots = sorted({*self.whole.tolist(), *(t for t in clock.times if first < t < last)})
        corners = set(knots)
        for one, other in pairwise(knots):  # the slope also changes where a frame is passed
            begin, end = clock(one), clock(other)
            low, high = sorted((begin, end))
            passed = self.whole[(low < self.whole) & (self.whole < high)].tolist()
            corners |= {one + (other - one) * (t - begin) / (end - begin) for t in passed}
        times = np.array([(self.to_own(t), self.to_own(clock(t))) for t in sorted(corners)])
        return Clock(*distinct_knots(*times.T))

    def check_clock(self, clock: Clock, span: Span | None, parameter: str, num_frames: int) -> None:
        """Raise ValueError if a clock, in the span where it acts, shows frames of other segments of the clip.

        Times before the first of the clip's `num_frames` frames, and after its last, belong to no other segment.
        """
        first, last = self.whole[[0, -1]].tolist()
        steps = max(num_frames - 1, 1)
        start = first if span is None or span.start is None else max(span.start, first)
        stop = last if span is None or span.stop is None else min(span.stop, last)
        for t in (start, *(t for t in clock.times if start < t < stop), stop):
            shown = clock(t)
            early = shown < first - _FRAME_TOLERANCE / steps and first > 0
            late = shown > last + _FRAME_TOLERANCE / steps and last < 1
            require(
                not early and not late,
                parameter,
                expected=f"times of the segment that shows the object, frames {first * steps:g} to {last * steps:g}",
                got=f"frame {shown * steps:.6g} for frame {t * steps:.6g}, which is in another segment",
                cure="Give frames= that keep it within one segment, or select what only one segment shows.",
            )
