"""Errors that carry their cure: parameter, expected, got, what to try."""

import math
from numbers import Integral, Real


def invalid(parameter: str, *, expected: str, got: object, cure: str = "") -> ValueError:
    """The one shape of a value error in this package, ready to be raised."""
    text = f"{parameter}: expected {expected}, got {got}."
    return ValueError(f"{text} {cure}" if cure else text)


def one_of(parameter: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise unless `value` is one of `choices`; an unknown option never falls through to a default."""
    if value not in choices:
        raise invalid(parameter, expected="one of " + ", ".join(map(repr, choices)), got=repr(value))


def within(value: object, bounds: str) -> bool:
    """Whether `value` is a finite number in an interval written as "[0, 1)": "[" includes the bound, "(" does not."""
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        return False
    low, high = (float(part) for part in bounds[1:-1].split(","))
    return (low < value or (bounds[0] == "[" and low == value)) and (
        value < high or (bounds[-1] == "]" and value == high)
    )


def whole(value: object, least: int) -> bool:
    """Whether `value` is a whole number of at least `least`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and value >= least
