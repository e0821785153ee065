"""Clocks: an object's own time as a piecewise linear function of the video's time."""

import dataclasses

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.video.editing.arguments import check_increasing, check_number, check_numbers


@dataclasses.dataclass(frozen=True)
class Clock:
    """An object's own time as a function of the video's time: linear between knots (t, own time).

    Before the first and after the last knot the own time is constant. Clocks may run backwards. At own times below 0
    and above 1 the first and the last frame are shown: no frame was fitted beyond them, and folds that are extrapolated
    there soon scatter.

    **Units:** model time, which is [0, 1]; n evenly timed frames lie 1 / (n - 1) apart.

    **Example:** `Clock((0.0, 0.5, 1.0), (0.0, 0.5, 0.0))` runs to the middle and back.

    **Raises:** ValueError for knots that are not finite, of different lengths or not increasing.
    """

    times: tuple[float, ...]
    own_times: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_numbers("times", self.times))
        object.__setattr__(self, "own_times", check_numbers("own_times", self.own_times))
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


def check_clock(clock: object, has_line: bool) -> None:
    """Raise ValueError unless `clock` is one, given without a line of times."""
    require(not has_line, "clock", expected="a clock, or shift, stretch and about", got="both")
    require(
        isinstance(clock, Clock),
        "clock",
        expected="a Clock",
        got=type(clock).__name__,
        cure="Clock(times, own_times) is linear between knots." if callable(clock) else "",
    )
