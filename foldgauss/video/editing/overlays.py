"""Overlays: edits of the conditioned Gaussians at each time, for what no folded model represents.

An overlay is a mask over a model's Gaussians, a span of time and a few parameters. It takes the selected Gaussians that
are alive at a time and returns them changed; all others stay the same to the bit.
"""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from foldgauss._runtime.checks import check_one_of, require
from foldgauss.video.editing.arguments import static_numbers
from foldgauss.video.editing.timing import Clock, Span

#: Luminance of red, green and blue: Rec. 709.
LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
IDENTITY = ((1.0, 0.0), (0.0, 1.0))


@dataclasses.dataclass(frozen=True)
class SelectedGaussians:
    """The selected Gaussians that are alive at one time, in array order and model space: the input of an edit.

    **Shapes:** `index` (num,), their indices in the model; `mean` (num, dim), x right, y down (and z away); `factor`
    (num, dim, 2), any F with covariance F F^T; `opacity` (num,) in [0, 1]; `color` (num, 3), >= 0. dim is 2, or 3 once
    an edit has moved Gaussians of the model into 3D space. NumPy arrays.

    **Units:** the frame's center is the origin and its longer side 1.

    **Example:** `dataclasses.replace(gaussians, mean=gaussians.mean + [0.1, 0.0])`.
    """

    index: Int[np.ndarray, " num"]
    mean: Float[np.ndarray, "num dim"]
    factor: Float[np.ndarray, "num dim 2"]
    opacity: Float[np.ndarray, " num"]
    color: Float[np.ndarray, "num 3"]

    def __len__(self) -> int:
        return len(self.opacity)

    @property
    def center(self) -> Float[np.ndarray, " dim"]:
        """Their center: the mean of the means, weighted by opacity times area.

        The weights include the area since Gaussians far from their own time are small; so the center moves smoothly.
        """
        first, second = np.moveaxis(self.in_space().factor, 2, 0)
        weights = self.opacity * np.linalg.norm(np.cross(first, second), axis=1)
        if not weights.sum() > 0:
            weights = np.ones(len(self), np.float32)
        return np.einsum("n,nd->d", weights, self.mean, dtype=np.float64) / weights.sum(dtype=np.float64)

    def in_space(self) -> "SelectedGaussians":
        """The same Gaussians with dim 3; those with dim 2 are put in the plane z = 0."""
        if self.mean.shape[1] == 3:
            return self
        mean = np.concatenate([self.mean, np.zeros_like(self.mean[:, :1])], 1)
        factor = np.concatenate([self.factor, np.zeros_like(self.factor[:, :1])], 1)
        return dataclasses.replace(self, mean=mean, factor=factor)


def _map_factors(matrix: Float[np.ndarray, "dim dim"], factor: Float[np.ndarray, "num dim 2"]) -> np.ndarray:
    """A F for each F, as one matrix product."""
    columns = np.swapaxes(factor, 1, 2)
    rows = columns.reshape(-1, len(matrix)) @ matrix.T.astype(np.float32)
    return np.swapaxes(rows.reshape(columns.shape), 1, 2)


class TimedEdit(eqx.Module):
    """The Gaussians that an edit applies to, and when it does. **Shapes:** `mask` bool (num_gaussians,)."""

    mask: Bool[np.ndarray, " num_gaussians"]
    span: Span | None = eqx.field(static=True)

    def progress(self, t: float) -> float:
        """The progress of the edit at time t."""
        return 1.0 if self.span is None else self.span.progress(t)


class AbstractOverlay(TimedEdit):
    """An edit of the conditioned Gaussians.

    A subclass has static, hashable fields, checks them in `__check_init__`, and is listed in `KINDS` if it can be
    saved.
    """

    @abstractmethod
    def __call__(self, gaussians: SelectedGaussians, t: float, progress: float) -> SelectedGaussians:
        """The selected Gaussians of time t, edited with progress in [0, 1]: 0 is unchanged, 1 fully edited."""


class Affine(AbstractOverlay):
    r"""An affine map of the plane about a point, or about the selection's own center at each time.

    $$ m' = c + A (m - c) + b, \quad F' = A F, \quad A = R(\theta) S $$

    At progress s the angle is s theta, the symmetric part I + s (S - I) and the offset s b: so rotations keep their
    direction, and sizes change monotonically unless the map mirrors. Gaussians in 3D space keep their depth.

    **Units:** `angle` in radians from x to y, which is clockwise on the screen; `offset` and `about` model space.
    """

    angle: float = static_numbers("angle")
    stretch: tuple[tuple[float, float], tuple[float, float]] = static_numbers("stretch", 2, 2)
    offset: tuple[float, float] = static_numbers("offset", 2)
    about: tuple[float, float] | None = static_numbers("about", 2, optional=True)

    def __check_init__(self) -> None:
        (first, shear), (other, second) = self.stretch
        require(shear == other, "stretch", expected="a symmetric matrix", got=self.stretch)
        require(
            first * second - shear**2 != 0,
            "stretch",
            expected="an invertible matrix",
            got=self.stretch,
            cure="See vanish().",
        )

    @property
    def is_translation(self) -> bool:
        """Whether it is a translation."""
        return self.angle == 0 and self.stretch == IDENTITY

    @property
    def is_identity(self) -> bool:
        """Whether it is the identity."""
        return self.is_translation and self.offset == (0.0, 0.0)

    def matrix(self, progress: float = 1.0) -> Float[np.ndarray, "2 2"]:
        """The matrix A at a progress."""
        cos, sin = np.cos(progress * self.angle), np.sin(progress * self.angle)
        return np.array([[cos, -sin], [sin, cos]]) @ (np.eye(2) + progress * (np.array(self.stretch) - np.eye(2)))

    def __call__(self, gaussians, t, progress):
        dim, shift = gaussians.mean.shape[1], progress * np.array(self.offset)
        move = np.zeros(dim)
        if self.is_translation:
            move[:2] = shift
            return dataclasses.replace(gaussians, mean=gaussians.mean + move.astype(np.float32))
        matrix = np.eye(dim)
        matrix[:2, :2] = self.matrix(progress)
        center = gaussians.center[:2] if self.about is None else np.array(self.about)
        move[:2] = center - matrix[:2, :2] @ center + shift
        mean = gaussians.mean @ matrix.T.astype(np.float32) + move.astype(np.float32)
        return dataclasses.replace(gaussians, mean=mean, factor=_map_factors(matrix, gaussians.factor))


def polar_decompose(
    matrix: Float[np.ndarray, "2 2"],
) -> tuple[float, tuple[tuple[float, float], tuple[float, float]]]:
    """Angle of R and symmetric part S of A = R S; R is a rotation, so S mirrors where A does."""
    (a, b), (c, d) = matrix.tolist()
    angle = math.atan2(c - b, a + d + 0.0)  # 0 where the sum is -0; with it R^T A is symmetric, its trace not negative
    cos, sin = math.cos(angle), math.sin(angle)
    cross = cos * b + sin * d
    return angle, ((cos * a + sin * c, cross), (cross, cos * d - sin * b))


class Opacity(AbstractOverlay):
    """Opacity times a factor, clipped at 1: `before` at progress 0, `factor` at progress 1, interpolated between."""

    factor: float = static_numbers("factor")
    before: float = static_numbers("before", default=1.0)

    def __check_init__(self) -> None:
        for name in ("factor", "before"):
            value = getattr(self, name)
            require(value >= 0, name, expected="a number >= 0", got=value)

    def __call__(self, gaussians, t, progress):
        by = self.before + progress * (self.factor - self.before)
        return dataclasses.replace(gaussians, opacity=np.minimum(gaussians.opacity * by, 1.0))


def is_active(overlay: AbstractOverlay, progress: float) -> bool:
    """Whether an overlay changes anything at a progress; at 0 only an `Opacity` with `before` other than 1 does."""
    return progress > 0 or (isinstance(overlay, Opacity) and overlay.before != 1)


class Recolor(AbstractOverlay):
    """A linear map of colors c' = max(M c + b, 0), applied as c + s (c' - c) at progress s, or a new hue.

    `hue` is in turns (0 red, 1/3 green, 2/3 blue); it is set before the linear map. Lightness (Rec. 709) and the
    distance from gray are kept.
    """

    matrix: tuple[tuple[float, float, float], ...] = static_numbers("matrix", 3, 3)
    offset: tuple[float, float, float] = static_numbers("offset", 3)
    hue: float | None = static_numbers("hue", optional=True, default=None)

    def map_colors(self, color: Float[np.ndarray, "num 3"]) -> Float[np.ndarray, "num 3"]:
        """The colors at progress 1, float64."""
        color = np.asarray(color, np.float64)
        if self.hue is not None:
            color = _with_hue(color, self.hue)
        return np.maximum(color @ np.array(self.matrix).T + np.array(self.offset), 0.0)

    def __call__(self, gaussians, t, progress):
        color = gaussians.color
        return dataclasses.replace(gaussians, color=color + progress * (self.map_colors(color) - color))


def _with_hue(color: Float[np.ndarray, "num 3"], hue: float) -> Float[np.ndarray, "num 3"]:
    gray = (color @ LUMINANCE_WEIGHTS)[:, None]
    pure = np.clip(np.abs((hue + np.array([0, 2 / 3, 1 / 3])) % 1 * 6 - 3) - 1, 0, 1)
    direction = pure - pure @ LUMINANCE_WEIGHTS
    return gray + np.linalg.norm(color - gray, axis=1, keepdims=True) * direction / np.linalg.norm(direction)


class Place(AbstractOverlay):
    """A rigid motion in 3D space: the flat selection is rotated about a point of the image plane and moved in depth.

    The video's camera (by default the front camera) shows it in perspective; depth > 0 is away from the viewer.

    **Units:** `rotation` is an axis times an angle in radians, about x (right), y (down), z (away from the viewer);
    `depth` model space; `about` (x, y), or None for the selection's own center.

    **Source:** MiraGe, flat Gaussians in space; VeGaS eq:mirage.
    """

    depth: float = static_numbers("depth")
    rotation: tuple[float, float, float] = static_numbers("rotation", 3)
    about: tuple[float, float] | None = static_numbers("about", 2, optional=True)

    def __call__(self, gaussians, t, progress):
        gaussians = gaussians.in_space()
        mean, factor, move = gaussians.mean, gaussians.factor, np.array([0, 0, progress * self.depth])
        if any(self.rotation):
            center = gaussians.center if self.about is None else np.array([*self.about, 0.0])
            turn = scipy.spatial.transform.Rotation.from_rotvec(progress * np.array(self.rotation)).as_matrix()
            mean, factor = mean @ turn.T.astype(np.float32), _map_factors(turn, factor)
            move = move + center - turn @ center
        return dataclasses.replace(gaussians, mean=mean + move.astype(np.float32), factor=factor)


class GaussianFunction(AbstractOverlay):
    """A function of the conditioned Gaussians and the time. It cannot be saved."""

    function: Callable[[SelectedGaussians, float], SelectedGaussians] = eqx.field(static=True)

    def __call__(self, gaussians, t, progress):
        after = _check_result(gaussians, self.function(gaussians, t))
        return after if progress == 1 else _interpolate(gaussians, after, progress)


_MIN_PADDED_SIZE = 1024


def call_padded(function: Callable[..., Any], *arrays: Float[np.ndarray, "num ..."]) -> Any:
    """Call a compiled function that maps rows of arrays to rows, float32.

    The number of rows is padded to a power of two, so that compiled code is reused: by 0, or by unit matrices, which
    are valid factors.
    """
    num = len(arrays[0])
    size, padded = max(_MIN_PADDED_SIZE, 1 << (num - 1).bit_length()), []
    for array in arrays:
        fill = np.eye(*array.shape[1:]) if array.ndim == 3 else np.zeros(array.shape[1:])
        padded.append(np.concatenate([array, np.broadcast_to(fill, (size - num, *fill.shape))], dtype=np.float32))
    return jax.tree.map(lambda leaf: np.array(leaf)[:num], function(*padded))


def _check_result(before: SelectedGaussians, after: object) -> SelectedGaussians:
    require(
        isinstance(after, SelectedGaussians),
        "function",
        expected="SelectedGaussians back",
        got=type(after).__name__,
        cure="Return dataclasses.replace(gaussians, ...).",
    )
    require(
        after.index is before.index or np.array_equal(after.index, before.index),
        "function",
        expected="the same Gaussians",
        got="other indices",
        cure="Set opacities to 0 to hide some.",
    )
    num, dim = len(before), np.shape(after.mean)[-1] if np.ndim(after.mean) else 0
    shapes = {"mean": (num, dim), "factor": (num, dim, 2), "opacity": (num,), "color": (num, 3)}
    for name, shape in shapes.items():
        leaf = np.asarray(getattr(after, name))
        require(
            leaf.shape == shape and dim in (2, 3) and leaf.dtype.kind in "fiu" and np.isfinite(leaf).all(),
            f"function's {name}",
            expected=f"finite numbers of shape {shape}, dim 2 or 3",
            got=f"{leaf.dtype} {leaf.shape}",
        )
    require(
        np.min(after.opacity, initial=0) >= 0
        and np.max(after.opacity, initial=0) <= 1
        and np.min(after.color, initial=0) >= 0,
        "function",
        expected="opacity in [0, 1] and color >= 0",
        got="numbers outside of that",
    )
    return after


def _interpolate(before: SelectedGaussians, after: SelectedGaussians, progress: float) -> SelectedGaussians:
    if before.mean.shape != np.shape(after.mean):
        before, after = before.in_space(), after.in_space()
    mixed = {}
    for name in ("mean", "factor", "opacity", "color"):
        old, new = getattr(before, name), getattr(after, name)
        mixed[name] = old if new is old else old + progress * (np.asarray(new) - old)
    return dataclasses.replace(before, **mixed)


class Retiming(TimedEdit):
    """Gaussians with their own clock, over a span or always: at progress s their time is t + s (clock(t) - t).

    `clock(t)` is clipped to [0, 1], the times that the model was fitted to.
    """

    clock: Clock = eqx.field(static=True)

    def own_time(self, t: float) -> float:
        """The time at which the Gaussians are conditioned at the video's time t."""
        progress = self.progress(t)
        own = min(max(self.clock(t), 0.0), 1.0)
        if progress in (0, 1):  # exactly
            return own if progress else t
        return t + progress * (own - t)


#: The edits that can be saved, by their names in files.
KINDS: dict[str, type[TimedEdit]] = {
    "affine": Affine,
    "opacity": Opacity,
    "recolor": Recolor,
    "place": Place,
    "retimed": Retiming,
}


def describe_overlay(overlay: TimedEdit) -> dict:
    """An overlay without its mask as JSON values. Raises ValueError for functions, which cannot be saved."""
    names = {kind: name for name, kind in KINDS.items()}
    require(
        type(overlay) in names,
        "overlays",
        expected="edits that can be saved",
        got=type(overlay).__name__,
        cure="Save the video without it and apply the function again after loading; or write a video file.",
    )
    fields = dataclasses.asdict(overlay)
    del fields["mask"]
    return {"kind": names[type(overlay)], **fields}


def restore_overlay(description: dict, mask: Bool[np.ndarray, " num_gaussians"]) -> TimedEdit:
    """The inverse of `describe_overlay`. Raises ValueError, KeyError or TypeError for an invalid description."""
    fields = dict(description)
    check_one_of("kind", fields["kind"], tuple(KINDS))
    kind = KINDS[fields.pop("kind")]
    if fields["span"] is not None:
        fields["span"] = Span(**fields["span"])
    if "clock" in fields:
        fields["clock"] = Clock(**fields["clock"])
    return kind(mask=mask, **fields)
