"""When an edit acts, and by which clock an object goes."""

import dataclasses
import math
from collections.abc import Sequence
from itertools import pairwise
from numbers import Real
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import check_one_of, invalid, is_integer, is_within, short_repr

CURVES = ("linear", "smooth")
OUTSIDE = ("hold", "continue")


@dataclasses.dataclass(frozen=True)
class Span:
    """A stretch of time in which an edit acts, and how far along it is there: `progress`, from 0 to 1.

    `start` <= t < `stop`, None for no end. Inside, progress is 1, or what lies between the knots `times` and `values`,
    bent by `curve`: "linear", or "smooth", s^2 (3 - 2 s). Outside it is 0. Made from frame numbers by `make_span`.

    **Units:** model time. **Example:** `Span(0.4, 0.6).progress(0.5)  # 1.0`

    **Raises:** ValueError for a span without length, knots that do not fit or go back, and an unknown curve.
    """

    start: float | None = None
    stop: float | None = None
    times: tuple[float, ...] = ()
    values: tuple[float, ...] = ()
    curve: str = "linear"

    def __post_init__(self) -> None:
        check_one_of("curve", self.curve, CURVES)
        for name in ("start", "stop"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, check_number(name, value))
        if not self._first < self._last:
            raise invalid("start, stop", expected="a start before the stop", got=f"{self.start}, {self.stop}")
        object.__setattr__(self, "times", check_numbers("times", self.times))
        object.__setattr__(self, "values", check_numbers("values", self.values))
        if len(self.times) != len(self.values) or not all(is_within(value, "[0, 1]") for value in self.values):
            raise invalid("values", expected=f"{len(self.times)} numbers in [0, 1]", got=self.values)
        _check_rising(self.times)

    @property
    def _first(self) -> float:
        return -math.inf if self.start is None else self.start

    @property
    def _last(self) -> float:
        return math.inf if self.stop is None else self.stop

    def progress(self, t: float) -> float:
        """How far along the edit is at time t; 0 where it does not act."""
        if not self._first <= t < self._last:
            return 0.0
        if not self.times:
            return 1.0
        s = float(np.interp(t, self.times, self.values))
        return s if self.curve == "linear" else s * s * (3 - 2 * s)


def make_span(
    frame_times: Float[np.ndarray, " num_frames"],
    *,
    frame: int | None = None,
    frames: tuple[int | None, int | None] | None = None,
    times: tuple[float, float] | None = None,
    ease: float | tuple[float, float] = 0,
    curve: str = "linear",
) -> Span | None:
    """The span of one frame, of frames from the first up to, not including, the second, or of times; None for always.

    A frame reaches half way to its neighbours: frame k is where |position - k| < 0.5, the position being the frame
    number that a time has between those of the frames. So a span holds its frames, leaves all others as they were to
    the bit, and shows in what is interpolated between. None, the first or the last frame as an end means no end there.

    `ease` is how many frames it takes to come in and to go out, from the ends of the span inwards, or two such numbers;
    at the ends of the clip there is nothing to come from, and the edit stands from the start, or stays.

    **Example:** `make_span(model.frame_times.times(), frames=(10, 20), ease=4, curve="smooth")`.

    **Raises:** ValueError for more than one of the three, frames or times that the clip has not, and ease without a
    span, or longer than it.
    """
    knots = np.asarray(frame_times, np.float64)
    stretch = make_frame_span(knots, frame=frame, frames=frames, times=times, ease=ease, curve=curve)
    return None if stretch is None else restrict_span(stretch, knots)


class FrameSpan(NamedTuple):
    """A span as positions among a clip's frames: from `begin` to `end`, infinite where it has no end.

    `rise` and `fall`: how many frames it takes to come in and to go out.
    """

    begin: float
    end: float
    rise: float
    fall: float
    curve: str


def make_frame_span(
    frame_times: Float[np.ndarray, " num_frames"],
    *,
    frame: int | None = None,
    frames: tuple[int | None, int | None] | None = None,
    times: tuple[float, float] | None = None,
    ease: float | tuple[float, float] = 0,
    curve: str = "linear",
) -> FrameSpan | None:
    """As `make_span`, among the frames."""
    knots, one_of_them = np.asarray(frame_times, np.float64), [x for x in (frame, frames, times) if x is not None]
    check_one_of("curve", curve, CURVES)
    if len(one_of_them) > 1:
        raise invalid("frame, frames, times", expected="one of them at most", got=f"{len(one_of_them)} of them")
    lengths = _checked_ease(ease)
    if not one_of_them:
        if lengths != (0, 0):
            raise invalid("ease", expected="a span to ease into", got=ease, cure="Give frame=, frames= or times=.")
        return None
    begin, end = _positions(knots, frame, frames, times)
    rise, fall = (length if math.isfinite(x) else 0.0 for length, x in zip(lengths, (begin, end), strict=True))
    first, last = max(begin, 0.0), min(end, len(knots) - 1.0)
    if rise + fall > last - first:
        expected = f"no more than the span's {last - first:g} frames, in and out together"
        raise invalid("ease", expected=expected, got=f"{rise:g} and {fall:g}", cure="Make the span longer.")
    return FrameSpan(begin, end, rise, fall, curve)


def _positions(knots: np.ndarray, frame, frames, times) -> tuple[float, float]:
    """Where a span begins and ends, as positions among the frames; infinite where it has no end."""
    last = len(knots) - 1
    if times is not None:
        first, stop = _pair("times", times)
        if not (is_within(first, "[0, 1]") and is_within(stop, "[0, 1]") and first < stop):
            raise invalid("times", expected="(start, stop), rising, in [0, 1]", got=times)
        begin, end = (float(np.interp(t, knots, np.arange(last + 1))) for t in (first, stop))
        return -math.inf if begin <= 0 else begin, math.inf if end >= last else end
    if frame is not None:
        if not (is_integer(frame, 0) and frame <= last):
            raise invalid("frame", expected=f"a whole number in [0, {last}]", got=frame)
        frames = (frame, frame + 1)
    first, stop = (
        end if given is None else given for given, end in zip(_pair("frames", frames), (0, last + 1), strict=True)
    )
    if not (is_integer(first, 0) and is_integer(stop, 1) and first < stop <= last + 1):
        expected = f"(first, stop), whole, 0 <= first < stop <= {last + 1}"
        raise invalid("frames", expected=expected, got=frames, cure="None is the clip's own end.")
    return -math.inf if first == 0 else first - 0.5, math.inf if stop == last + 1 else stop - 0.5


def restrict_span(stretch: FrameSpan, frame_times: Float[np.ndarray, " num_frames"], first: int = 0) -> Span:
    """A clip's span in the own time of a part of it, whose frames, at `frame_times`, begin with the clip's `first`.

    At each frame and between progress is what it is in the clip; `NEVER` where it reaches no frame of the part.
    """
    knots, last = np.asarray(frame_times, np.float64), len(frame_times) - 1
    # From here on frames count from the part's first.
    begin, end, rise, fall = stretch.begin - first, stretch.end - first, stretch.rise, stretch.fall
    if end <= 0 or begin > last:
        return NEVER
    number, ends = np.arange(last + 1), (max(begin, 0.0), min(end, float(last)))
    start = None if begin <= 0 else float(np.interp(begin, number, knots))
    stop = None if end > last else float(np.interp(end, number, knots))
    if not rise and not fall:
        return Span(start, stop, curve=stretch.curve)
    corners = {*ends, *(x for x in (begin + rise, end - fall) if ends[0] < x < ends[1])}
    positions = np.array(sorted(corners | set(number[(number > ends[0]) & (number < ends[1])].tolist())))
    values = np.ones(len(positions))
    if rise:
        values = np.minimum(values, (positions - begin) / rise)
    if fall:
        values = np.minimum(values, (end - positions) / fall)
    times = np.interp(positions, number, knots)
    apart = np.concatenate([np.diff(times) > 0, [True]])  # frames at one and the same time are one knot
    values = np.clip(values, 0.0, 1.0)
    return Span(start, stop, tuple(times[apart].tolist()), tuple(values[apart].tolist()), stretch.curve)


@dataclasses.dataclass(frozen=True)
class Clock:
    """An object's own time as a function of the video's: straight between knots (t, own time).

    Beyond the first and the last knot it stands still (`outside` "hold") or goes on as fast as between the last two
    ("continue"; with two knots or more). Clocks may run backwards.

    **Units:** model time, which is [0, 1]; n evenly timed frames lie 1 / (n - 1) apart. An own time outside [0, 1]
    shows the model as its folds go on, where no frame was seen.

    **Example:** `Clock((0.0, 0.5, 1.0), (0.0, 0.5, 0.0))` goes to the middle and back.

    **Raises:** ValueError for knots that do not rise, fit, or are not finite, and an unknown `outside`.
    """

    times: tuple[float, ...]
    own_times: tuple[float, ...]
    outside: str = "hold"

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_numbers("times", self.times))
        object.__setattr__(self, "own_times", check_numbers("own_times", self.own_times))
        check_one_of("outside", self.outside, OUTSIDE)
        least = 2 if self.outside == "continue" else 1
        if len(self.times) < least or len(self.times) != len(self.own_times):
            got = f"{len(self.times)} and {len(self.own_times)}"
            raise invalid("times, own_times", expected=f"as many of each, at least {least}", got=got)
        _check_rising(self.times)

    @classmethod
    def frozen(cls, own_time: float) -> "Clock":
        """Stands still at a time of the model."""
        return cls((0.0,), (own_time,))

    @classmethod
    def shifted(
        cls, shift: float = 0.0, stretch: float = 1.0, *, about: float = 0.0, outside: str = "continue"
    ) -> "Clock":
        """What was at time t comes at `about + shift + stretch (t - about)`: later, and slower by `stretch`.

        A negative stretch runs backwards. With `outside` "hold" the own time is kept within [0, 1].
        """
        shift, stretch, about = (
            check_number(name, x) for name, x in (("shift", shift), ("stretch", stretch), ("about", about))
        )
        if stretch == 0:
            raise invalid("stretch", expected="a number but 0", got=stretch, cure="To stand still use Clock.frozen.")
        knots = sorted((about + shift + stretch * (own - about), own) for own in (0.0, 1.0))
        return cls(*zip(*knots, strict=True), outside=outside)

    def __call__(self, t: float) -> float:
        """The own time at time t."""
        if self.outside == "continue":
            side = 0 if t < self.times[0] else -2 if t > self.times[-1] else None
            if side is not None:
                (a, b), (own_a, own_b) = self.times[side:][:2], self.own_times[side:][:2]
                return own_a + (t - a) * (own_b - own_a) / (b - a)
        return float(np.interp(t, self.times, self.own_times))


def check_number(parameter: str, value: object) -> float:
    """`value` as a float. Raises ValueError unless it is one finite number, alone or as an array without axes."""
    value = value.item() if getattr(value, "ndim", None) == 0 else value
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        raise invalid(parameter, expected="a finite number", got=short_repr(value))
    return float(value)


def check_numbers(parameter: str, values: object, length: int | None = None) -> tuple[float, ...]:
    """`values` as a tuple of floats, `length` of them. Raises ValueError for anything else."""
    wanted = "finite numbers in a list" if length is None else f"{length} finite numbers"
    try:
        array = np.asarray(values)
        if array.dtype.kind in "USbOcmM":  # texts, too, would become numbers
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError):
        raise invalid(parameter, expected=wanted, got=short_repr(values)) from None
    if array.ndim != 1 or not np.isfinite(array).all() or length not in (None, len(array)):
        raise invalid(parameter, expected=wanted, got=short_repr(values))
    return tuple(array.tolist())


def _check_rising(times: tuple[float, ...]) -> None:
    if not all(a < b for a, b in pairwise(times)):
        raise invalid("times", expected="rising numbers", got=times)


def _checked_ease(ease: object) -> tuple[float, float]:
    pair = ease if isinstance(ease, (tuple, list)) else (ease, ease)
    if len(pair) != 2 or not all(isinstance(x, Real) and x >= 0 and math.isfinite(x) for x in pair):
        raise invalid("ease", expected="a number of frames >= 0, or two of them", got=repr(ease))
    return float(pair[0]), float(pair[1])


def _pair(parameter: str, value: object) -> Sequence:
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        cure = "For one frame give frame=k." if parameter == "frames" else ""
        raise invalid(parameter, expected="two of them, (start, stop)", got=short_repr(value), cure=cure)
    return value


#: Of an edit that no frame of a part of a clip is reached by: no video has these times.
NEVER = Span(2.0, 3.0)
