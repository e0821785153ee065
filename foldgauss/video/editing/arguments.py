"""Checks of the arguments of edits: numbers, lists of numbers, matrices and colors."""

import math
import warnings
from itertools import pairwise
from numbers import Real

import numpy as np
from jaxtyping import ArrayLike, Float

from foldgauss._runtime.checks import invalid, short_repr


def check_number(parameter: str, value: object) -> float:
    """`value` as a float. Raises ValueError unless it is one finite number or an array of shape ()."""
    value = value.item() if getattr(value, "ndim", None) == 0 else value
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        raise invalid(parameter, expected="a finite number", got=short_repr(value))
    return float(value)


def check_numbers(parameter: str, values: object, length: int | None = None) -> tuple[float, ...]:
    """`values` as a tuple of `length` finite floats (None: any length). Raises ValueError for anything else."""
    expected = "finite numbers in a list" if length is None else f"{length} finite numbers"
    try:
        array = np.asarray(values)
        if array.dtype.kind in "USbOcmM":  # NumPy would convert strings and booleans to numbers
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError):
        raise invalid(parameter, expected=expected, got=short_repr(values)) from None
    if array.ndim != 1 or not np.isfinite(array).all() or length not in (None, len(array)):
        raise invalid(parameter, expected=expected, got=short_repr(values))
    return tuple(array.tolist())


def check_increasing(parameter: str, values: tuple[float, ...]) -> None:
    """Raise ValueError unless `values` increase strictly."""
    if not all(a < b for a, b in pairwise(values)):
        raise invalid(parameter, expected="strictly increasing numbers", got=values)


def check_one_or_more(parameter: str, values: ArrayLike) -> tuple[float, ...]:
    """One number or a list of numbers, as a tuple."""
    is_list = isinstance(values, (list, tuple)) or getattr(values, "ndim", 0) > 0
    return check_numbers(parameter, values) if is_list else (check_number(parameter, values),)


def broadcast_numbers(parameter: str, values: ArrayLike, num: int) -> tuple[float, ...]:
    """`num` numbers, from `num` numbers or from one that is repeated."""
    numbers = check_one_or_more(parameter, values)
    if len(numbers) not in (1, num):
        raise invalid(parameter, expected=f"one number or {num}", got=f"{len(numbers)}")
    return numbers if len(numbers) == num else numbers * num


def check_matrix(parameter: str, values: ArrayLike, size: int) -> Float[np.ndarray, "size size"]:
    """`values` as a matrix of shape (size, size), float64."""
    try:
        return np.array([check_numbers(parameter, row, size) for row in values]).reshape(size, size)
    except (TypeError, ValueError):
        expected = f"finite numbers of shape ({size}, {size})"
        raise invalid(parameter, expected=expected, got=short_repr(values)) from None


def check_pairs(parameter: str, values: object) -> list:
    """`values` as a list of at least one iterable; their lengths are not checked."""
    try:
        rows = list(values)
    except TypeError:
        rows = []
    if not rows or any(not np.iterable(row) for row in rows):
        raise invalid(parameter, expected="pairs, as [(0.1, 0.0), (0.2, 0.0)]", got=repr(values))
    return rows


def check_color(color: ArrayLike) -> tuple[float, ...]:
    """Red, green and blue. Raises ValueError unless all are in [0, 1]."""
    rgb = check_numbers("color", color, 3)
    if min(rgb) < 0 or max(rgb) > 1:
        raise invalid("color", expected="red, green and blue in [0, 1]", got=rgb)
    return rgb


def check_color_map(
    gain: ArrayLike | None, offset: ArrayLike | None, matrix: ArrayLike | None
) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """Matrix and offset of the map c -> gain * (M c) + offset; None is 1, 0 and the identity."""
    rows = np.eye(3) if matrix is None else check_matrix("matrix", matrix, 3)
    gains = broadcast_numbers("gain", 1.0 if gain is None else gain, 3)
    shift = broadcast_numbers("offset", 0.0 if offset is None else offset, 3)
    return tuple(map(tuple, (np.array(gains)[:, None] * rows).tolist())), shift


def missing_attribute(chain: object, name: str, video_type: type) -> AttributeError:
    """The error for an attribute that a chain of edits does not have; its video may have it."""
    cure = " End the chain with .video()." if name in dir(video_type) else ""
    text = f"{type(chain).__name__!r} object has no attribute {name!r}.{cure}"
    return AttributeError(text, name=name, obj=chain)


def check_select_arguments(selection: object, criteria: dict[str, object]) -> None:
    """Raise ValueError for a selection together with criteria."""
    if selection is not None and criteria:
        got = f"{type(selection).__name__} and {', '.join(criteria)}"
        raise invalid("selection", expected="a selection or criteria", got=got)


def warn_if_outside_clip(parameter: str, shift: float, stretch: float, about: float, num_frames: int) -> None:
    """Warn of a line of times with which the selection stands still in the whole clip."""
    ends = [about + shift + stretch * (own - about) for own in (0.0, 1.0)]
    if max(ends) < 0 or min(ends) > 1:
        text = f"{parameter}: expected times of a clip of [0, 1], got {shift:g}: it stands still throughout."
        warnings.warn(f"{text} For frames divide by {max(num_frames - 1, 1)}.", stacklevel=3)
