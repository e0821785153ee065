"""Checks of the arguments of edits: numbers, lists of numbers, matrices and colors."""

import warnings
from itertools import pairwise
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float64

from foldgauss._runtime.checks import invalid, require, short_repr


def check_array(parameter: str, values: object, *shape: int | None) -> Float64[np.ndarray, "..."]:
    """`values` as finite numbers of a shape, in which None is any length. Raises ValueError for anything else."""
    try:
        array = np.asarray(values)
        if array.dtype.kind in "USbOcmM":  # NumPy would convert strings and booleans to numbers
            raise TypeError
        array = array.astype(np.float64)
        fits = np.isfinite(array).all() and array.ndim == len(shape)
    except (TypeError, ValueError):
        fits = False
    if not fits or any(length not in (None, own) for own, length in zip(array.shape, shape, strict=True)):
        texts = {
            (): "a finite number",
            (None,): "finite numbers in a list",
            (None, 2): "pairs, as [(0.1, 0.0), (0.2, 0.0)]",
        }
        texts |= {(length,): f"{length} finite numbers" for length in shape if length is not None}
        raise invalid(parameter, expected=texts.get(shape, f"finite numbers of shape {shape}"), got=short_repr(values))
    return array


def check_number(parameter: str, value: object) -> float:
    """`value` as a float. Raises ValueError unless it is one finite number or an array of shape ()."""
    return float(check_array(parameter, value))


def check_numbers(parameter: str, values: object, length: int | None = None) -> tuple[float, ...]:
    """`values` as a tuple of `length` finite floats (None: any length). Raises ValueError for anything else."""
    return tuple(check_array(parameter, values, length).tolist())


def check_increasing(parameter: str, values: tuple[float, ...]) -> None:
    """Raise ValueError unless `values` increase strictly."""
    require(all(a < b for a, b in pairwise(values)), parameter, expected="strictly increasing numbers", got=values)


def check_one_or_more(parameter: str, values: ArrayLike) -> tuple[float, ...]:
    """One number or a list of numbers, as a tuple."""
    is_list = isinstance(values, (list, tuple)) or getattr(values, "ndim", 0) > 0
    return check_numbers(parameter, values) if is_list else (check_number(parameter, values),)


def broadcast_numbers(parameter: str, values: ArrayLike, num: int) -> tuple[float, ...]:
    """`num` numbers, from `num` numbers or from one that is repeated."""
    numbers = check_one_or_more(parameter, values)
    require(len(numbers) in (1, num), parameter, expected=f"one number or {num}", got=f"{len(numbers)}")
    return numbers if len(numbers) == num else numbers * num


def static_numbers(parameter: str, *shape: int | None, optional: bool = False, **more: Any) -> Any:
    """A static field of a module: finite numbers of a shape, as tuples; or None if `optional`."""

    def convert(values):
        return None if optional and values is None else _to_tuples(check_array(parameter, values, *shape).tolist())

    return eqx.field(static=True, converter=convert, **more)


def _to_tuples(values: Any) -> Any:
    return tuple(map(_to_tuples, values)) if isinstance(values, list) else values


def check_color_map(
    gain: ArrayLike | None, offset: ArrayLike | None, matrix: ArrayLike | None
) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """Matrix and offset of the map c -> gain * (M c) + offset; None is 1, 0 and the identity."""
    rows = np.eye(3) if matrix is None else check_array("matrix", matrix, 3, 3)
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
    require(
        selection is None or not criteria,
        "selection",
        expected="a selection or criteria",
        got=f"{type(selection).__name__} and {', '.join(criteria)}",
    )


def warn_if_outside_clip(parameter: str, shift: float, stretch: float, about: float, num_frames: int) -> None:
    """Warn of a line of times with which the selection stands still in the whole clip."""
    ends = [about + shift + stretch * (own - about) for own in (0.0, 1.0)]
    if max(ends) < 0 or min(ends) > 1:
        text = f"{parameter}: expected times of a clip of [0, 1], got {shift:g}: it stands still throughout."
        warnings.warn(f"{text} For frames divide by {max(num_frames - 1, 1)}.", stacklevel=3)
