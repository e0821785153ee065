"""Paths that many Gaussians share, such as the motion of the camera: affine maps that depend on time."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from foldgauss._runtime.checks import invalid
from foldgauss.render import Splats2D

#: A Gaussian's path is a byte: 0 for none, else the number of the path, from 1.
MAX_PATHS = 255
FEW_PATHS = 4


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
        matrices, times = xp.asarray(self.matrices), xp.asarray(self.times)[path]
        last = xp.clip((times <= t[..., None]).sum(-1) - 1, 0, max(self.num_knots - 2, 0))
        after = xp.minimum(last + 1, self.num_knots - 1)
        begun, ended = (xp.take_along_axis(times, k[..., None], -1)[..., 0] for k in (last, after))
        span = ended - begun
        fraction = xp.clip((t - begun) / xp.where(span > 0, span, 1), 0, 1)[..., None, None]
        return (1 - fraction) * matrices[path, last] + fraction * matrices[path, after]


def all_maps(maps: Float[Array, "paths 2 3"]) -> Float[Array, "paths+1 2 3"]:
    """Maps by the number of a Gaussian's path: the first one is the identity."""
    xp = np if isinstance(maps, np.ndarray) else jnp
    return xp.concatenate([xp.eye(2, 3, dtype=maps.dtype)[None], maps])


def move_splats(splats: Splats2D, path_index: UInt8[Array, " num"], maps: Float[Array, "paths 2 3"]) -> Splats2D:
    """Splats in model space, each moved by the map of its path."""
    if len(maps) > FEW_PATHS:
        own = all_maps(maps)[path_index]
    else:  # the gradient by a map is then a sum in a fixed order
        own = jnp.broadcast_to(jnp.eye(2, 3, dtype=maps.dtype), (*path_index.shape, 2, 3))
        for number, one in enumerate(maps, 1):
            own = jnp.where((path_index == number)[:, None, None], one[None], own)
    linear, offset = own[..., :2], own[..., 2]
    mean = jnp.einsum("nij,nj->ni", linear, splats.mean) + offset
    return Splats2D(mean, linear @ splats.factor, splats.opacity, splats.color, splats.depth)


def leave_paths(splats: Any, which: Bool[np.ndarray, " num"]) -> Any:
    """`FoldedSplats` of NumPy arrays where those of `which` are on no path, at the position and size of their m_t.

    They keep their angles and folds.
    """
    if splats.paths is None or not (which & (splats.path_index > 0)).any():
        return splats
    times = 1 / (1 + np.exp(-splats.time_loc_logit.astype(float)))
    own = splats.paths.by_path(np.float32(times), np.maximum(splats.path_index, 1) - 1)
    leaving = (which & (splats.path_index > 0))[:, None]
    loc = np.einsum("nij,nj->ni", own[:, :, :2], splats.loc) + own[:, :, 2]
    larger = 0.5 * np.log(np.linalg.det(own[:, :, :2].astype(float)))[:, None]
    return dataclasses.replace(
        splats,
        loc=np.where(leaving, loc, splats.loc).astype(np.float32),
        log_scale=np.where(leaving, splats.log_scale + larger, splats.log_scale).astype(np.float32),
        path_index=np.where(leaving[:, 0], 0, splats.path_index).astype(np.uint8),
    )


def check_path_index(splats: Any) -> None:
    """Raise ValueError unless every Gaussian's path is one that there is; the splats must have known values."""
    if splats.paths is None:
        return
    largest = int(np.asarray(splats.path_index).max(initial=0))
    if largest > splats.paths.num_paths:
        raise invalid("path_index", expected=f"paths from 0 to {splats.paths.num_paths}", got=largest)


def to_pixel_maps(
    maps: Float[np.ndarray, "paths 2 3"], unit: float, center: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "paths+1 2 3"]:
    """Maps by the number of a Gaussian's path, of pixels: model space times `unit`, its origin at `center`; float32."""
    maps = all_maps(np.asarray(maps, np.float64))
    offset = center + unit * maps[:, :, 2] - maps[:, :, :2] @ center
    return np.concatenate([maps[:, :, :2], offset[:, :, None]], 2).astype(np.float32)


def from_pixel_gradient(
    gradient: Float[np.ndarray, "paths+1 2 3"], unit: float, center: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "paths 2 3"]:
    """The gradient by maps of model space, from that by the maps of `to_pixel_maps`."""
    linear, offset = gradient[1:, :, :2], gradient[1:, :, 2:]
    return np.concatenate([linear - offset * center, unit * offset], 2)
