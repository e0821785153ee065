"""Packed rows: all parameters of a Gaussian in one row, the layout that the optimizer works on.

A Gaussian's parameters, moments and gradients each fit in one or two cache lines, so that a step reads only the
Gaussians alive.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from foldgauss.envelope import TimeLikelihood
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.models.splats import FoldedSplats

#: Beyond this degree, float32 cannot tell the powers of u and their gradients apart; compact files hold no more either.
MAX_DEGREE = 15
#: Leaves of `FoldedSplats` that compact models round together, and first.
SHAPE = ("log_scale", "angle_logit", "time_loc_logit", "log_time_scale", "opacity_logit")
#: They are rounded after the shapes, since the span of time of a trajectory follows from the duration.
TRAJECTORY = ("loc", "coefficients")
#: They are rounded last: colors make up for errors of all others.
COLOR = ("color_dc",)
#: The bit of each of these groups.
GROUPS = {SHAPE: 1, TRAJECTORY: 2, COLOR: 4}
#: Fields of `FoldedSplats` that are not in `columns`.
_OTHERS = ("envelope", "path_index", "paths")


def _leaf_names() -> list[str]:
    """Trainable leaves, the fold last since its width varies with the degree."""
    names = [field.name for field in dataclasses.fields(FoldedSplats) if field.name not in _OTHERS]
    return sorted(names, key=lambda name: name == "coefficients")


def columns(degree: int) -> dict[str, slice]:
    """The columns of each trainable leaf of `FoldedSplats` in a row."""
    widths = {"loc": 2, "log_scale": 2, "color_dc": 3, "coefficients": 2 * degree}
    place, start = {}, 0
    for name in _leaf_names():
        stop = start + widths.get(name, 1)
        place[name], start = slice(start, stop), stop
    return place


def group_bits(degree: int) -> UInt8[np.ndarray, " width"]:
    """The bit of the group (`GROUPS`) of each column of a row."""
    place = columns(degree)
    bits = np.zeros(place["coefficients"].stop, np.uint8)
    for group, bit in GROUPS.items():
        for name in group:
            bits[place[name]] = bit
    return bits


def pack(splats: FoldedSplats) -> np.ndarray:
    """Leaves to rows, float32 (num, 11 + 2 degree); with shared paths the last column is `path_index`."""
    num, place = splats.num_gaussians, columns(splats.degree)
    leaves = [np.asarray(getattr(splats, k), np.float32).reshape(num, at.stop - at.start) for k, at in place.items()]
    if splats.paths is not None:
        leaves.append(np.asarray(splats.path_index, np.float32)[:, None])
    return np.ascontiguousarray(np.concatenate(leaves, axis=1))


def has_path_column(rows: np.ndarray, degree: int) -> bool:
    """Whether rows end with a column of `path_index`."""
    return rows.shape[1] > columns(degree)["coefficients"].stop


def unpack(rows: np.ndarray, degree: int, envelope: TimeLikelihood, paths: SharedPaths | None = None) -> FoldedSplats:
    """Rows to leaves (copies), the inverse of `pack`; with `paths` where rows have a column of `path_index`."""
    num = len(rows)
    shapes = {"loc": (num, 2), "log_scale": (num, 2), "color_dc": (num, 3), "coefficients": (num, degree, 2)}
    leaves = {name: rows[:, place].reshape(shapes.get(name, (num,))).copy() for name, place in columns(degree).items()}
    if paths is not None:
        xp = np if isinstance(rows, np.ndarray) else jnp
        leaves |= {"path_index": rows[:, -1].astype(xp.uint8), "paths": paths}
    return FoldedSplats(**leaves, envelope=envelope)
