"""Paths that many Gaussians share, such as the motion of the camera: affine maps that depend on time."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from foldgauss._numerics.piecewise import locate
from foldgauss._runtime.checks import require
from foldgauss.render import Splats2D

#: A Gaussian's path is a byte: 0 for none, else the number of the path, from 1.
MAX_PATHS = 255
#: From the times (knots,) and matrices (knots, 2, 3) of a path to those of another.
PathChange = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class SharedPaths(eqx.Module):
    """Affine maps of model space that depend on time, one path for each group of Gaussians.

    A Gaussian on path p with the conditional N(m(t), C(t)), polynomial fold included, is rendered at time t as
    N(L m(t) + b, L C(t) L^T), with (L, b) the map of the path at t. Gaussians on no path are rendered as they are.

    Shapes: `matrices` (paths, frames, 2, 3), rows (L | b) at `times` (paths, frames), which do not decrease. Between
    them maps are interpolated linearly; before the first and after the last they stay the same.
    Units: model space, see `FoldedSplats`; time is that of the model.
    Source: the "suitably chosen" f of VeGaS eq:transform_s, here with a part that Gaussians share.
    """

    times: Float[Array, "paths frames"]
    matrices: Float[Array, "paths frames 2 3"]

    @property
    def num_paths(self) -> int:
        return self.matrices.shape[0]

    @property
    def num_knots(self) -> int:
        """Times at which each path has a map of its own."""
        return self.matrices.shape[1]

    def at(self, t: Float[Array, ""]) -> Float[Array, "paths 2 3"]:
        """The maps at time t; NumPy arrays if the leaves and t are."""
        xp = np if isinstance(self.matrices, np.ndarray) and isinstance(t, float | np.floating) else jnp
        return self.by_path(xp.full(self.num_paths, t, self.times.dtype), xp.arange(self.num_paths))

    def by_path(self, t: Float[Array, "*batch"], path: Int[Array, "*batch"]) -> Float[Array, "*batch 2 3"]:
        """The maps of paths, numbered from 0, each at a time of its own."""
        xp = np if isinstance(self.matrices, np.ndarray) and isinstance(t, np.ndarray) else jnp
        matrices, times = xp.asarray(self.matrices), xp.asarray(self.times)
        before, after, fraction = locate(times, path, t)
        fraction = fraction[..., None, None]
        return (1 - fraction) * matrices[path, before] + fraction * matrices[path, after]

    def by_index(self, t: Float[Array, "*batch"], index: UInt8[Array, "*batch"]) -> Float[Array, "*batch 2 3"]:
        """The maps of Gaussians with this `path_index`, each at a time of its own; the identity for those on no path.

        NumPy arrays if the leaves and t are.
        """
        xp = np if isinstance(self.matrices, np.ndarray) and isinstance(t, np.ndarray) else jnp
        path = xp.asarray(index).astype(xp.int32)
        maps = self.by_path(t, xp.maximum(path - 1, 0))
        return xp.where((path > 0)[..., None, None], maps, xp.eye(2, 3, dtype=maps.dtype))


def move_splats(splats: Splats2D, path_index: UInt8[Array, " num"], maps: Float[Array, "paths 2 3"]) -> Splats2D:
    """Splats in model space, each moved by the map of its path."""
    own = jnp.broadcast_to(jnp.eye(2, 3, dtype=maps.dtype), (*path_index.shape, 2, 3))
    for number, one in enumerate(maps, 1):  # not `maps[path_index]`: the gradient is a sum in a fixed order
        own = jnp.where((path_index == number)[:, None, None], one[None], own)
    linear, offset = own[..., :2], own[..., 2]
    mean = jnp.einsum("nij,nj->ni", linear, splats.mean) + offset
    return Splats2D(mean, linear @ splats.factor, splats.opacity, splats.color, splats.depth)


def check_paths(splats: Any) -> None:
    """Raise ValueError unless maps and times are finite, times do not decrease, and every Gaussian's path is there.

    The splats must have known values.
    """
    if splats.paths is None:
        return
    times, matrices = np.asarray(splats.paths.times), np.asarray(splats.paths.matrices)
    require(
        np.isfinite(times).all() and np.isfinite(matrices).all(),
        "paths",
        expected="finite times and matrices",
        got="others",
        cure="Fit again.",
    )
    require(
        (np.diff(times, axis=1) >= 0).all(),
        "paths.times",
        expected="times that do not decrease",
        got="others",
        cure="Sort the knots.",
    )
    largest = int(np.asarray(splats.path_index).max(initial=0))
    require(
        largest <= splats.paths.num_paths,
        "path_index",
        expected=f"paths from 0 to {splats.paths.num_paths}",
        got=largest,
    )


def to_pixel_maps(
    maps: Float[np.ndarray, "paths 2 3"], unit: float, center: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "paths+1 2 3"]:
    """Maps of pixels, float32: model space times `unit`, with its origin at `center`. The first is the identity."""
    maps = np.concatenate([np.eye(2, 3)[None], maps])
    offset = center + unit * maps[:, :, 2] - maps[:, :, :2] @ center
    return np.concatenate([maps[:, :, :2], offset[:, :, None]], 2).astype(np.float32)


def invert_maps(maps: Float[np.ndarray, "*batch 2 3"]) -> Float[np.ndarray, "*batch 2 3"]:
    """The maps back, float32; not finite where there is none."""
    (a, b), (c, d) = np.moveaxis(maps[..., :2].astype(np.float64), (-2, -1), (0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        linear = np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), (0, 1), (-2, -1))
        return np.concatenate([linear, -linear @ maps[..., 2:]], -1).astype(np.float32)


def from_pixel_gradient(
    gradient: Float[np.ndarray, "paths+1 2 3"], unit: float, center: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "paths 2 3"]:
    """The gradient by maps of model space, from that by the maps of `to_pixel_maps`."""
    linear, offset = gradient[1:, :, :2], gradient[1:, :, 2:]
    return np.concatenate([linear - offset * center, unit * offset], 2)


def change_paths(splats: Any, mask: Bool[np.ndarray, " num"], change: PathChange) -> Any | None:
    """The splats, with the paths of the Gaussians of `mask` replaced by `change(times, matrices)` of them, float64.

    A path that others follow stays as it is, and the changed one is added. None if there would be more than `MAX_PATHS`
    or if a number is not finite.
    """
    if splats.paths is None:
        return splats
    index = np.array(splats.path_index)
    leaves = splats.paths.times, splats.paths.matrices
    times, matrices = (list(np.asarray(leaf, np.float64)) for leaf in leaves)
    for path in set(index[mask].tolist()) - {0}:
        on_path = index == path
        changed = change(times[path - 1], matrices[path - 1])
        if (on_path & ~mask).any():
            times, matrices = [*times, changed[0]], [*matrices, changed[1]]
            if len(times) > MAX_PATHS:
                return None
            index[on_path & mask] = len(times)
        else:
            times[path - 1], matrices[path - 1] = changed
    with np.errstate(over="ignore"):
        new = [np.asarray(parts, leaf.dtype) for parts, leaf in zip((times, matrices), leaves, strict=True)]
    if not all(np.isfinite(leaf).all() for leaf in new):
        return None
    return dataclasses.replace(splats, path_index=jnp.asarray(index), paths=SharedPaths(*map(jnp.asarray, new)))


def join_paths(parts: Sequence[Any]) -> tuple[UInt8[np.ndarray, " num"], SharedPaths] | tuple[None, None]:
    """`path_index` and `paths` of the Gaussians of several splats, in turn; equal paths become one.

    Paths with fewer knots repeat their last one. Raises ValueError for more than `MAX_PATHS`.
    """
    num_knots = max((part.paths.num_knots for part in parts if part.paths is not None), default=0)
    if not num_knots:
        return None, None
    known, rows, index = {}, [], []
    for part in parts:
        numbers = [0]
        if part.paths is not None:
            after = num_knots - part.paths.num_knots
            times = np.pad(np.asarray(part.paths.times), [(0, 0), (0, after)], mode="edge")
            matrices = np.pad(np.asarray(part.paths.matrices), [(0, 0), (0, after), (0, 0), (0, 0)], mode="edge")
            for row in zip(times, matrices, strict=True):
                key = row[0].tobytes() + row[1].tobytes()
                if key not in known:
                    rows.append(row)
                    known[key] = len(rows)
                numbers.append(known[key])
        own = np.zeros(part.num_gaussians, int) if part.paths is None else np.asarray(part.path_index)
        index.append(np.array(numbers)[own])
    require(len(rows) <= MAX_PATHS, "paths", expected=f"at most {MAX_PATHS} in all", got=len(rows))
    times, matrices = map(np.stack, zip(*rows, strict=True))
    return jnp.asarray(np.concatenate(index).astype(np.uint8)), SharedPaths(jnp.asarray(times), jnp.asarray(matrices))
