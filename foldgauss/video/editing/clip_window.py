"""A video as a part of a longer clip: times of the clip in the part's own, and back."""

import dataclasses
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64

from foldgauss._runtime.checks import invalid
from foldgauss.video.editing.clock import NEVER, Clock, FrameSpan, Span, make_frame_span, restrict_span

#: Frames. Learned times so near to even ones are even: a line through time stays a line.
_EVEN = 1e-3
#: Frames. What a clock misses a frame by, by rounding.
_CLOSE = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class ClipWindow:
    """Where a video stands in a clip of `num_frames` frames: `first` is the clip's number of its first frame.

    `times` are its own frame times. The clip's frame k is at k / (num_frames - 1), that of one frame alone at 0.

    **Units:** times of the clip and of the part, each in [0, 1]; positions count the clip's frames.
    """

    times: Float64[np.ndarray, " own"]
    first: int
    num_frames: int

    @property
    def last(self) -> int:
        """The clip's number of its last frame."""
        return self.first + len(self.times) - 1

    @property
    def frame_times(self) -> Float64[np.ndarray, " num_frames"]:
        """Of the clip."""
        return self.times if self.is_whole else np.arange(self.num_frames) / self._steps

    @property
    def is_whole(self) -> bool:
        """Whether there is nothing but this part, and its times are the clip's."""
        return len(self.times) == self.num_frames and (self.num_frames == 1 or self.is_even)

    @property
    def is_even(self) -> bool:
        """Whether its frames are evenly spaced, so that its time goes as evenly as the clip's."""
        steps = len(self.times) - 1
        return steps > 0 and bool(np.abs(steps * self.times - np.arange(steps + 1)).max() < _EVEN)

    @property
    def _steps(self) -> int:
        return max(self.num_frames - 1, 1)

    def span(self, **when: Any) -> Span | None:
        """As `make_span` of the clip's frames and times, in own time; `NEVER` where it reaches none of its frames."""
        stretch = make_frame_span(self.frame_times, **when)
        return None if stretch is None else restrict_span(stretch, self.times, self.first)

    def position(self, own_time: float) -> float:
        """The clip's frame position of an own time."""
        if self.is_even:
            return self.first + own_time * (len(self.times) - 1)
        return self.first + float(np.interp(own_time, self.times, np.arange(len(self.times))))

    def clip_time(self, own_time: float) -> float:
        """The clip's time of an own time."""
        return own_time if self.is_whole else self.position(own_time) / self._steps

    def by_clip_time(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function whose last argument is the clip's time, as one of the own time."""
        return function if self.is_whole else _ByClipTime(function, self)

    # ------------------------------------------------------------------------------------------------ clocks

    def check_own(self, clock: Clock, parameter: str, **when: Any) -> None:
        """Raise ValueError unless all that an object's clock asks for while it acts lies in this part.

        Before the clip's first frame and after its last there is no other part to ask.
        """
        if self.span(**when) is NEVER:
            return
        stretch = make_frame_span(self.frame_times, **when) or FrameSpan(-np.inf, np.inf, 0.0, 0.0, "linear")
        low, high = max(stretch.begin, self.first), min(stretch.end, self.last)
        knots = [position for position in (t * self._steps for t in clock.times) if low < position < high]
        for shown in (low, *knots, high):
            own = clock(shown / self._steps) * self._steps
            early = own < self.first - _CLOSE and self.first > 0
            late = own > self.last + _CLOSE and self.last < self.num_frames - 1
            if early or late:
                expected = f"times of the segment that shows the object, frames {self.first} to {self.last}"
                cure = "Give frames= in which it stays within one segment, or select what only one segment shows."
                got = f"frame {own:.6g} for frame {shown:.6g}, which another segment has"
                raise invalid(parameter, expected=expected, got=got, cure=cure)

    def line(self, shift: float, stretch: float, about: float) -> tuple[float, float, float] | None:
        """Shift, stretch and about of the same line in own time, see `Clock.shifted`; None where it is none there."""
        if self.is_whole:
            return shift, stretch, about
        if not self.is_even:
            return None
        longer = self._steps / (len(self.times) - 1)
        return shift * longer, stretch, self._own_by_line(about)

    def _own_by_line(self, t: float) -> float:
        return (t * self._steps - self.first) / (len(self.times) - 1)

    def clock(self, clock: Clock) -> Clock:
        """The clock in own time: for each own time the own time that the object then has."""
        if self.is_whole:
            return clock
        if len(self.times) == 1:
            return Clock.frozen(0.0)
        if self.is_even:
            times = tuple(self._own_by_line(t) for t in clock.times)
            return Clock(times, tuple(self._own_by_line(t) for t in clock.own_times), clock.outside)
        shown = self._corners(clock)
        own = np.array([clock(position / self._steps) * self._steps for position in shown])
        times = np.interp(shown - self.first, np.arange(len(self.times)), self.times)
        apart = np.concatenate([np.diff(times) > 0, [True]])
        own_times = self._continued(own - self.first)
        return Clock(tuple(times[apart].tolist()), tuple(own_times[apart].tolist()))

    def _corners(self, clock: Clock) -> Float64[np.ndarray, " corners"]:
        """The positions at which the clock has a corner in own time: at its knots, and where it goes past a frame."""
        inner = [t * self._steps for t in clock.times if self.first < t * self._steps < self.last]
        shown = sorted({*map(float, range(self.first, self.last + 1)), *inner})
        corners = set(shown)
        for one, other in pairwise(shown):
            begin, end = (clock(position / self._steps) * self._steps for position in (one, other))
            low, high = sorted((begin, end))
            passed = range(max(int(np.ceil(low)), self.first), min(int(np.floor(high)), self.last) + 1)
            corners |= {one + (other - one) * (k - begin) / (end - begin) for k in passed if low < k < high}
        return np.array(sorted(corners))

    def _continued(self, positions: Float64[np.ndarray, " num"]) -> Float64[np.ndarray, " num"]:
        """Own times of positions among the own frames; beyond the ends as fast as beside them."""
        times, last = self.times, len(self.times) - 1
        before, after = np.minimum(positions, 0), np.maximum(positions - last, 0)
        inside = np.interp(positions, np.arange(last + 1), times)
        return inside + before * (times[1] - times[0]) + after * (times[-1] - times[-2])


@dataclasses.dataclass(frozen=True, eq=False)
class _ByClipTime:
    function: Callable[..., Any]
    part: ClipWindow

    def __call__(self, *arguments: Any) -> Any:
        *others, t = arguments
        return self.function(*others, self.part.clip_time(float(t)))
