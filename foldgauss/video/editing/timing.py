"""The timing of edits: spans in which they act, clocks of objects, and maps between two times of the same frames."""

import dataclasses
import math
from collections.abc import Callable
from numbers import Real
from typing import Any, TypedDict

import equinox as eqx
import numpy as np
from jaxtyping import Float, Float64

from foldgauss._runtime.checks import check_one_of, is_within, require
from foldgauss.video.editing.arguments import check_increasing, check_number, static_numbers
from foldgauss.video.selection.regions import check_times, resolve_frames

CURVES = ("linear", "smooth")
#: Frames. Rounding error of the frame that a clock shows.
_FRAME_TOLERANCE = 1e-6
#: Frames. Times this close are the same, so that edits of a clip in one segment are those of its model.
_SAME = 1e-3


# ------------------------------------------------------------------------------------------------------- spans


class When(TypedDict, total=False):
    """When an edit acts: the keyword arguments of `make_span`. None given: always."""

    frame: int
    frames: tuple[int | None, int | None]
    times: tuple[float, float]
    ease: float | tuple[float, float]
    curve: str


class Span(eqx.Module):
    """An interval of time in which an edit acts, and its `progress` there, from 0 to 1.

    The interval is `start` <= t < `stop`, None for no end. Inside, progress is 1, or it is interpolated between the
    knots `times` and `values` and passed through `curve`: "linear", or "smooth", s^2 (3 - 2 s). Outside it is 0.
    `make_span` makes one from frame numbers.

    **Units:** model time. **Example:** `Span(0.4, 0.6).progress(0.5)  # 1.0`

    **Raises:** ValueError for an empty span, knots of different lengths or not increasing, and an unknown curve.
    """

    start: float | None = static_numbers("start", optional=True, default=None)
    stop: float | None = static_numbers("stop", optional=True, default=None)
    times: tuple[float, ...] = static_numbers("times", None, default=())
    values: tuple[float, ...] = static_numbers("values", None, default=())
    curve: str = eqx.field(static=True, default="linear")

    def __check_init__(self) -> None:
        check_one_of("curve", self.curve, CURVES)
        require(
            None in (self.start, self.stop) or self.start < self.stop,
            "start, stop",
            expected="a start before the stop",
            got=f"{self.start}, {self.stop}",
        )
        require(
            len(self.times) == len(self.values) and all(is_within(value, "[0, 1]") for value in self.values),
            "values",
            expected=f"{len(self.times)} numbers in [0, 1]",
            got=self.values,
        )
        check_increasing("times", self.times)

    def progress(self, t: float) -> float:
        """The progress of the edit at time t; 0 where it does not act."""
        if (self.start is not None and t < self.start) or (self.stop is not None and t >= self.stop):
            return 0.0
        if not self.times:
            return 1.0
        s = float(np.interp(t, self.times, self.values))
        return s if self.curve == "linear" else s * s * (3 - 2 * s)


#: The span of an edit that acts on no frame of a segment: no video has these times.
NEVER = Span(2.0, 3.0)


def make_span(
    frame_times: Float[np.ndarray, " num_frames"],
    *,
    frame: int | None = None,
    frames: tuple[int | None, int | None] | None = None,
    times: tuple[float, float] | None = None,
    ease: float | tuple[float, float] = 0,
    curve: str = "linear",
) -> Span | None:
    """The span of one frame, of frames (first, stop) or of times (start, stop); None for always.

    A frame reaches half way to its neighbors: frame k covers |position - k| < 0.5, where `position` is the frame
    number interpolated between the frame times. So the span contains its frames, every other frame stays the same to
    the bit, and frames that are interpolated near it show the edit. `frames` includes first and excludes stop. None,
    the first or the last frame as an end means that the span has no end there.

    `ease`: the number of frames over which the edit comes in and goes out, inside the span; or one number for each.
    Where the span has no end, there is no easing. `curve`: as in `Span`.

    **Example:** `make_span(model.frame_times.times(), frames=(10, 20), ease=4, curve="smooth")`.

    **Raises:** ValueError for more than one of `frame`, `frames` and `times`, for values outside the clip, and for
    `ease` without a span or longer than it.
    """
    knots = np.asarray(frame_times, np.float64)
    num_given = sum(x is not None for x in (frame, frames, times))
    check_one_of("curve", curve, CURVES)
    require(num_given <= 1, "frame, frames, times", expected="one of them at most", got=f"{num_given} of them")
    pair = ease if isinstance(ease, (tuple, list)) else (ease, ease)
    require(
        len(pair) == 2 and all(isinstance(x, Real) and x >= 0 and math.isfinite(x) for x in pair),
        "ease",
        expected="a number of frames >= 0, or two of them",
        got=repr(ease),
    )
    lengths = float(pair[0]), float(pair[1])
    if not num_given:
        require(
            lengths == (0, 0), "ease", expected="a span to ease into", got=ease, cure="Give frame=, frames= or times=."
        )
        return None
    begin, end = _span_positions(knots, frame, frames, times)
    rise, fall = (length if math.isfinite(x) else 0.0 for length, x in zip(lengths, (begin, end), strict=True))
    first, last = max(begin, 0.0), min(end, len(knots) - 1.0)
    require(
        rise + fall <= last - first,
        "ease",
        expected=f"no more than the span's {last - first:g} frames, in and out together",
        got=f"{rise:g} and {fall:g}",
        cure="Make the span longer.",
    )
    number = np.arange(len(knots))
    start, stop = (float(np.interp(x, number, knots)) if math.isfinite(x) else None for x in (begin, end))
    if not rise and not fall:
        return Span(start, stop, curve=curve)
    corners = {first, last, *(x for x in (begin + rise, end - fall) if first < x < last)}
    positions = np.array(sorted(corners | set(number[(number > first) & (number < last)].tolist())))
    inward = [distance / length for distance, length in ((positions - begin, rise), (end - positions, fall)) if length]
    values = np.clip(np.min(inward, axis=0), 0.0, 1.0)
    return Span(start, stop, *distinct_knots(np.interp(positions, number, knots), values), curve)


def _span_positions(knots: np.ndarray, frame, frames, times) -> tuple[float, float]:
    """The frame positions at which a span begins and ends; infinite where it has no end."""
    last = len(knots) - 1
    if times is not None:
        first, stop = check_times(times)
        require(first < stop, "times", expected="(start, stop), rising, in [0, 1]", got=times)
        begin, end = np.interp((first, stop), knots, np.arange(last + 1)).tolist()
        return -math.inf if begin <= 0 else begin, math.inf if end >= last else end
    chosen = resolve_frames(last + 1, frame, frames)
    first, stop = chosen.start, chosen.stop
    return -math.inf if first == 0 else first - 0.5, math.inf if stop == last + 1 else stop - 0.5


def distinct_knots(
    times: Float[np.ndarray, " num"], values: Float[np.ndarray, " num"]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Knots of a piecewise linear function, as tuples; of knots at equal times only the last one is kept."""
    keep = np.concatenate([np.diff(times) > 0, [True]])
    return tuple(times[keep].tolist()), tuple(values[keep].tolist())


# ------------------------------------------------------------------------------------------------------ clocks


class Clock(eqx.Module):
    """An object's own time as a function of the video's time: linear between knots (t, own time).

    Before the first and after the last knot the own time is constant. Clocks may run backwards. At own times below 0
    and above 1 the first and the last frame are shown: no frame was fitted beyond them, and folds that are extrapolated
    there soon scatter.

    **Units:** model time, which is [0, 1]; n evenly timed frames lie 1 / (n - 1) apart.

    **Example:** `Clock((0.0, 0.5, 1.0), (0.0, 0.5, 0.0))` runs to the middle and back.

    **Raises:** ValueError for knots that are not finite, of different lengths or not increasing.
    """

    times: tuple[float, ...] = static_numbers("times", None)
    own_times: tuple[float, ...] = static_numbers("own_times", None)

    def __check_init__(self) -> None:
        require(
            self.times and len(self.times) == len(self.own_times),
            "times, own_times",
            expected="as many of each, at least 1",
            got=f"{len(self.times)} and {len(self.own_times)}",
        )
        check_increasing("times", self.times)

    @classmethod
    def frozen(cls, own_time: float) -> "Clock":
        """A clock that always shows `own_time`."""
        return cls((0.0,), (own_time,))

    @classmethod
    def shifted(cls, shift: float = 0.0, stretch: float = 1.0, *, about: float = 0.0) -> "Clock":
        """Own time t in [0, 1] is shown at about + shift + stretch (t - about): later by `shift`, slower by `stretch`.

        A negative stretch runs backwards.
        """
        shift, stretch, about = (
            check_number(name, x) for name, x in (("shift", shift), ("stretch", stretch), ("about", about))
        )
        require(
            stretch != 0, "stretch", expected="a number other than 0", got=stretch, cure="To stop time: Clock.frozen."
        )
        knots = sorted((about + shift + stretch * (own - about), own) for own in (0.0, 1.0))
        return cls(*zip(*knots, strict=True))

    def __call__(self, t: float) -> float:
        """The own time at time t."""
        return float(np.interp(t, self.times, self.own_times))


# -------------------------------------------------------------------------------------------------------- maps


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

    @property
    def to_own(self) -> Clock:
        """Own times of times of the whole; before the first frame and after the last, the time of that frame."""
        return Clock(*distinct_knots(self.whole, self.own))

    @property
    def to_whole(self) -> Clock:
        """Times of the whole of own times."""
        return Clock(*distinct_knots(self.own, self.whole))

    def convert_function(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function whose last argument is a time of the whole, as a function of own time."""

        to_whole = self.to_whole

        def converted(*arguments: Any) -> Any:
            *others, t = arguments
            return function(*others, to_whole(t))

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
