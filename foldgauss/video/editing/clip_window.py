"""Segments of a longer clip: frames, times, spans and clocks of the clip in a segment's own time, and back."""

import dataclasses
from collections.abc import Callable
from itertools import pairwise
from typing import Any, Unpack

import numpy as np
from jaxtyping import Float64

from foldgauss._runtime.checks import invalid
from foldgauss.video.editing.clock import Clock
from foldgauss.video.editing.span import (
    NEVER,
    FrameSpan,
    Span,
    When,
    distinct_knots,
    make_frame_span,
    restrict_span,
)

#: Frames. Frame times this close to even spacing count as evenly spaced, so that linear clocks stay linear.
_EVEN_TOLERANCE = 1e-3
#: Frames. Rounding error of the frame that a clock shows.
_FRAME_TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class ClipWindow:
    """The frames of a clip of `num_frames` frames that a segment has: its frame times `times`, from frame `first` on.

    Frame k of the clip is at k / (num_frames - 1), the frame of a clip with one frame at 0.

    **Units:** clip times and own times of the segment, each in [0, 1]; positions are in frames of the clip.
    """

    times: Float64[np.ndarray, " own"]
    first: int
    num_frames: int

    @property
    def last(self) -> int:
        """The clip's number of the segment's last frame."""
        return self.first + len(self.times) - 1

    @property
    def frame_times(self) -> Float64[np.ndarray, " num_frames"]:
        """The frame times of the clip."""
        return self.times if self.is_whole else np.arange(self.num_frames) / self._steps

    @property
    def is_whole(self) -> bool:
        """Whether the segment is the whole clip, with its frame times."""
        return len(self.times) == self.num_frames and (self.num_frames == 1 or self.is_even)

    @property
    def is_even(self) -> bool:
        """Whether the segment's frames are evenly spaced, so that own time is linear in clip time."""
        steps = len(self.times) - 1
        return steps > 0 and bool(np.abs(steps * self.times - np.arange(steps + 1)).max() < _EVEN_TOLERANCE)

    @property
    def _steps(self) -> int:
        return max(self.num_frames - 1, 1)

    def own_span(self, **when: Unpack[When]) -> Span | None:
        """The span, for the clip's frames and times, in own time; `NEVER` if it contains no frame of the segment."""
        return restrict_span(make_frame_span(self.frame_times, **when), self.times, self.first)

    def position(self, own_time: float) -> float:
        """The clip's frame position at an own time."""
        if self.is_even:
            return self.first + own_time * (len(self.times) - 1)
        return self.first + float(np.interp(own_time, self.times, np.arange(len(self.times))))

    def clip_time(self, own_time: float) -> float:
        """The clip's time at an own time."""
        return own_time if self.is_whole else self.position(own_time) / self._steps

    def with_clip_time(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function of the clip's time, its last argument, as a function of the own time."""
        return function if self.is_whole else FunctionOfTime(function, self.clip_time)

    # ------------------------------------------------------------------------------------------------ clocks

    def check_own_times(self, clock: Clock, parameter: str, **when: Unpack[When]) -> None:
        """Raise ValueError if a clock, in the span where it acts, shows frames of other segments.

        Times before the clip's first frame or after its last belong to no other segment.
        """
        if self.own_span(**when) is NEVER:
            return
        span = make_frame_span(self.frame_times, **when) or FrameSpan(-np.inf, np.inf, 0.0, 0.0, "linear")
        low, high = max(span.begin, self.first), min(span.end, self.last)
        knots = [position for position in (t * self._steps for t in clock.times) if low < position < high]
        for shown in (low, *knots, high):
            own = clock(shown / self._steps) * self._steps
            early = own < self.first - _FRAME_TOLERANCE and self.first > 0
            late = own > self.last + _FRAME_TOLERANCE and self.last < self.num_frames - 1
            if early or late:
                expected = f"times of the segment that shows the object, frames {self.first} to {self.last}"
                cure = "Give frames= that keep it within one segment, or select what only one segment shows."
                got = f"frame {own:.6g} for frame {shown:.6g}, which is in another segment"
                raise invalid(parameter, expected=expected, got=got, cure=cure)

    def own_line(self, shift: float, stretch: float, about: float) -> tuple[float, float, float] | None:
        """Shift, stretch and about of `Clock.shifted` in own time; None if it is not linear there."""
        if self.is_whole:
            return shift, stretch, about
        if not self.is_even:
            return None
        longer = self._steps / (len(self.times) - 1)
        return shift * longer, stretch, self._own_time(about)

    def _own_time(self, t: float) -> float:
        """The own time at a time of the clip, for evenly spaced frames."""
        return (t * self._steps - self.first) / (len(self.times) - 1)

    def own_clock(self, clock: Clock) -> Clock:
        """The clock in own time: from the segment's own time to the object's."""
        if self.is_whole:
            return clock
        if len(self.times) == 1:
            return Clock.frozen(0.0)
        if self.is_even:
            times = tuple(self._own_time(t) for t in clock.times)
            return Clock(times, tuple(self._own_time(t) for t in clock.own_times))
        shown = self._corners(clock)
        own = np.array([clock(position / self._steps) * self._steps for position in shown])
        times, own_times = (np.interp(x - self.first, np.arange(len(self.times)), self.times) for x in (shown, own))
        return Clock(*distinct_knots(times, own_times))

    def _corners(self, clock: Clock) -> Float64[np.ndarray, " corners"]:
        """Positions where the clock's slope changes in own time: its knots, and where it or the clip passes a frame."""
        inner = [t * self._steps for t in clock.times if self.first < t * self._steps < self.last]
        shown = sorted({*map(float, range(self.first, self.last + 1)), *inner})
        corners = set(shown)
        for one, other in pairwise(shown):
            begin, end = (clock(position / self._steps) * self._steps for position in (one, other))
            low, high = sorted((begin, end))
            passed = range(max(int(np.ceil(low)), self.first), min(int(np.floor(high)), self.last) + 1)
            corners |= {one + (other - one) * (k - begin) / (end - begin) for k in passed if low < k < high}
        return np.array(sorted(corners))


@dataclasses.dataclass(frozen=True, eq=False)
class FunctionOfTime:
    """A function whose last argument is a time, with that time converted before each call."""

    function: Callable[..., Any]
    convert: Callable[[float], float]

    def __call__(self, *arguments: Any) -> Any:
        *others, t = arguments
        return self.function(*others, self.convert(float(t)))
