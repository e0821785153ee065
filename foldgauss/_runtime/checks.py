"""Checks of arguments, with errors that name the parameter, what was expected, what was passed, and a remedy."""

import inspect
import math
import warnings
from collections.abc import Callable
from numbers import Integral, Real
from typing import TypeVar


class ParameterError(ValueError):
    """An invalid argument: the name of the `parameter`, and the `problem`: what was expected and got."""

    def __init__(self, parameter: str, problem: str):
        super().__init__(parameter, problem)  # which pickle passes on
        self.parameter, self.problem = parameter, problem

    def __str__(self) -> str:
        return f"{self.parameter}: {self.problem}"


Error = TypeVar("Error", bound=ParameterError)


def invalid(parameter: str, *, expected: str, got: object, cure: str = "", kind: type[Error] = ParameterError) -> Error:
    """An error in this package's format, to be raised."""
    text = f"expected {expected}, got {got}."
    return kind(parameter, f"{text} {cure}" if cure else text)


def check_one_of(parameter: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise unless `value` is one of `choices`; an unknown option never falls through to a default."""
    require(value in choices, parameter, expected="one of " + ", ".join(map(repr, choices)), got=short_repr(value))


def short_repr(value: object) -> str:
    """`repr` for an error of one line; the type's name if that is long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else type(value).__name__


def is_within(value: object, bounds: str) -> bool:
    """Whether `value` is a finite number in an interval written as "[0, 1)": "[" includes the bound, "(" does not."""
    if not isinstance(value, Real) or isinstance(value, bool) or not _is_finite(value):
        return False
    low, high = (float(part) for part in bounds[1:-1].split(","))
    return (low < value or (bounds[0] == "[" and low == value)) and (
        value < high or (bounds[-1] == "]" and value == high)
    )


def check_within(parameter: str, value: object, bounds: str, expected: str) -> None:
    """Raise unless `is_within(value, bounds)`; `expected` describes what is."""
    require(is_within(value, bounds), parameter, expected=expected, got=repr(value))


def _is_finite(value: Real) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer larger than any float
        return False


def is_integer(value: object, least: int) -> bool:
    """Whether `value` is an integer of at least `least`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and value >= least


def check_signature(parameter: str, function: Callable, *arguments: str) -> None:
    """Raise unless `function` can be called with these arguments; unknown signatures pass."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some built-in functions have none
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        got = f"the class {function.__name__}" if isinstance(function, type) else f"one of {signature}"
        raise invalid(parameter, expected=f"a function of ({', '.join(arguments)})", got=got) from None


def warn_if_degrees(parameter: str, *angles: float, stacklevel: int = 3) -> None:
    """Warn if an angle is probably in degrees: a multiple of 0.5 larger than one turn."""
    for angle in angles:
        if abs(angle) > 2 * math.pi and float(2 * angle).is_integer():
            text = f"{parameter}: expected radians, got {angle:g}, {abs(angle) / (2 * math.pi):.1f} turns."
            warnings.warn(f"{text} For degrees use math.radians({angle:g}).", stacklevel=stacklevel)


def require(
    condition: object,
    parameter: str,
    *,
    expected: str,
    got: object,
    cure: str = "",
    kind: type[ParameterError] = ParameterError,
) -> None:
    """Raise the error of `invalid` unless `condition` is true."""
    if not condition:
        raise invalid(parameter, expected=expected, got=got, cure=cure, kind=kind)
