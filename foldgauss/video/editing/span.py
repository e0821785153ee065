"""Spans: when an edit acts, and with which progress between 0 and 1."""

import dataclasses
import math
from numbers import Real
from typing import TypedDict

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import check_one_of, is_within, require
from foldgauss.video.editing.arguments import check_increasing, check_number, check_numbers
from foldgauss.video.selection.regions import check_times, resolve_frames

CURVES = ("linear", "smooth")


class When(TypedDict, total=False):
    """When an edit acts: the keyword arguments of `make_span`. None given: always."""

    frame: int
    frames: tuple[int | None, int | None]
    times: tuple[float, float]
    ease: float | tuple[float, float]
    curve: str


@dataclasses.dataclass(frozen=True)
class Span:
    """An interval of time in which an edit acts, and its `progress` there, from 0 to 1.

    The interval is `start` <= t < `stop`, None for no end. Inside, progress is 1, or it is interpolated between the
    knots `times` and `values` and passed through `curve`: "linear", or "smooth", s^2 (3 - 2 s). Outside it is 0.
    `make_span` makes one from frame numbers.

    **Units:** model time. **Example:** `Span(0.4, 0.6).progress(0.5)  # 1.0`

    **Raises:** ValueError for an empty span, knots of different lengths or not increasing, and an unknown curve.
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
        require(
            self._first < self._last,
            "start, stop",
            expected="a start before the stop",
            got=f"{self.start}, {self.stop}",
        )
        object.__setattr__(self, "times", check_numbers("times", self.times))
        object.__setattr__(self, "values", check_numbers("values", self.values))
        require(
            len(self.times) == len(self.values) and all(is_within(value, "[0, 1]") for value in self.values),
            "values",
            expected=f"{len(self.times)} numbers in [0, 1]",
            got=self.values,
        )
        check_increasing("times", self.times)

    @property
    def _first(self) -> float:
        return -math.inf if self.start is None else self.start

    @property
    def _last(self) -> float:
        return math.inf if self.stop is None else self.stop

    def progress(self, t: float) -> float:
        """The progress of the edit at time t; 0 where it does not act."""
        if not self._first <= t < self._last:
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
    values = np.ones(len(positions))
    if rise:
        values = np.minimum(values, (positions - begin) / rise)
    if fall:
        values = np.minimum(values, (end - positions) / fall)
    values = np.clip(values, 0.0, 1.0)
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
