"""Two-dimensional splats, their conversion to pixels, and the options of rendering."""

import dataclasses
import math
from numbers import Real

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss._runtime.checks import is_integer, is_within, require

#: Engine "xla" counts (tile, splat) pairs up to one more than this, so that the sum of two counts fits into int32.
LARGEST_CAPACITY = 2**30 - 2
#: Valid values of `RenderOptions`. Below a support radius of 0.1 standard deviations a splat is no longer Gaussian; the
#: square of the largest one is still far from float32's maximum.
BOUNDS = {
    "alpha_cutoff": "[1e-8, 1)",
    "alpha_ceiling": "[0, 1]",
    "low_pass": "[0, inf)",
    "transmittance_stop": "[0, 1)",
    "support_radius": "[0.1, 1e6]",
    "tile_size": "[4, 32]",
    "list_capacity": f"[1, {LARGEST_CAPACITY}]",
}


class Splats2D(eqx.Module):
    r"""Gaussians of one frame, in array order from front to back.

    $$ \alpha_i(x) = \rho_i \exp(-\tfrac12 (x - m_i)^T (F_i F_i^T)^{-1} (x - m_i)) $$

    Shapes: `mean` (num, 2) as (x right, y down); `factor` (num, 2, 2), any F with covariance F F^T (a
    rotation times scales, or a Cholesky factor); `opacity` (num,) in [0, 1]; `color` (num, channels);
    `depth` (num,) along the camera's axis in model units, set by `project`, or None. Only an expected depth depends on
    it: the order is the array's.
    Units: `render` takes pixels, with pixel centers at +0.5; `to_pixels` converts from model space, where the
    frame's center is the origin and its longer side has length 1.
    """

    mean: Float[Array, "num 2"]
    factor: Float[Array, "num 2 2"]
    opacity: Float[Array, " num"]
    color: Float[Array, "num channels"]
    depth: Float[Array, " num"] | None = None

    def __check_init__(self) -> None:
        check_shapes(self, mean=(2,), factor=(2, 2))
        opacity, depth = (getattr(leaf, "shape", None) for leaf in (self.opacity, self.depth))
        require(
            None in (opacity, depth) or depth == opacity,
            "depth",
            expected=f"shape {opacity}, that of opacity",
            got=f"shape {depth}",
        )

    def to_pixels(self, size: tuple[int, int], *, aspect: float | None = None) -> "Splats2D":
        """Convert from model space to pixels of an image of `size` = (height, width).

        `aspect` is the model frame's height / width (default: the image's own). If the two differ, the frame covers
        the image and is cropped about its center. Raises ValueError as `pixels_per_unit`.
        """
        scale = pixels_per_unit(size, aspect=aspect)
        height, width = size
        center = jnp.asarray([[width / 2, height / 2]], self.mean.dtype)
        return Splats2D(self.mean * scale + center, self.factor * scale, self.opacity, self.color, self.depth)


def check_shapes(splats: eqx.Module, **geometry: tuple[int, ...]) -> None:
    """Raise unless the shapes match: per splat those given in `geometry`, opacity (), color (channels,)."""
    names = [*geometry, "opacity", "color"]
    shapes = [getattr(getattr(splats, name), "shape", None) for name in names]
    if any(shape is None for shape in shapes):
        return  # placeholders, as inside tree transformations
    *_, num, color = shapes
    own = [(*num, *shape) for shape in geometry.values()]
    texts = [f"(num, {', '.join(map(str, shape))})" for shape in geometry.values()]
    require(
        shapes == [*own, num, (*num, *color[-1:])] and len(color) != len(num),
        ", ".join(names),
        expected=f"shapes {', '.join(texts)}, (num,), (num, channels)",
        got=", ".join(map(str, shapes)),
    )


def check_size(size: tuple[int, int]) -> None:
    """Raise unless `size` is an image's (height, width)."""
    pair = isinstance(size, (tuple, list)) and len(size) == 2
    require(
        pair and all(is_integer(n, 1) for n in size),
        "size",
        expected="(height, width), both whole and >= 1",
        got=size,
    )


def check_aspect(aspect: float) -> None:
    """Raise unless `aspect` is a positive number."""
    require(
        isinstance(aspect, Real) and 0 < aspect < math.inf,
        "aspect",
        expected="a frame's height / width, one positive number",
        got=aspect,
    )


def pixels_per_unit(size: tuple[int, int], *, aspect: float | None = None) -> float:
    """Pixels per unit of model space if a frame of height / width `aspect` (None: that of `size`) covers `size`.

    Raises ValueError unless `size` is two whole numbers >= 1 and `aspect` a positive number.
    """
    check_size(size)
    height, width = size
    aspect = height / width if aspect is None else aspect
    check_aspect(aspect)
    unit_height, unit_width = min(1.0, aspect), min(1.0, 1 / aspect)
    return max(height / unit_height, width / unit_width)


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """Cutoffs of rendering; and tiling, which affects speed and memory but not the image.

    The defaults are the constants of the published 3DGS rasterizer and so of VeGaS. For a single splat the cutoff and
    the stop change a pixel by at most one step of 8 bits, the ceiling by up to 2.55 steps (where the opacity is above
    0.99), the low pass by more. See `exact`, `standard` and `fast`.

    Raises ValueError for a value outside its bounds. Values are stored as Python numbers.
    """

    #: A splat is dropped where its alpha is below this: less than one step of an 8-bit image.
    alpha_cutoff: float = 1 / 255
    #: Alpha never exceeds this, so that the transmittance stays positive and splats behind have a gradient. 1: none.
    alpha_ceiling: float = 0.99
    #: Variance in px^2 added to both axes: a splat is never thinner than about a pixel.
    low_pass: float = 0.3
    #: A pixel is finished once its transmittance is not above this.
    transmittance_stop: float = 1e-4
    #: A splat is dropped beyond this many standard deviations. None: where the cutoff drops it anyway (3.3 deviations
    #: for opacity 1 and 1/255). The published rasterizer applies 3 to its tiles' lists, not to its pixels.
    support_radius: float | None = None
    #: Side of the square tiles of the splats' lists in engines "xla" and "pallas", in px: speed only. None: the
    #: engine's fastest.
    tile_size: int | None = None
    #: Capacity for (tile, splat) pairs in engines "xla" and "pallas": memory and speed only, since splats beyond it are
    #: rendered in further rounds. At least the number of tiles; None: counted where the splats are concrete, else
    #: (inside `jit`, `vmap`) derived from the numbers of splats and tiles.
    list_capacity: int | None = None

    def __post_init__(self) -> None:
        for name, bounds in BOUNDS.items():
            value, whole = getattr(self, name), name in ("tile_size", "list_capacity")
            if value is None and getattr(type(self), name) is None:
                continue
            require(
                is_within(value, bounds) and (not whole or is_integer(value, 0)),
                f"RenderOptions.{name}",
                expected=f"a {'whole number' if whole else 'number'} in {bounds}",
                got=value,
            )
            object.__setattr__(self, name, int(value) if whole else float(value))

    @classmethod
    def exact(cls) -> "RenderOptions":
        """The exact equation: no low pass, no ceiling, no stop, and the smallest cutoff.

        Only alphas below 1e-8 are dropped (6 deviations), which a float32 image does not resolve. Splats much smaller
        than a pixel are then visible only if they meet a pixel's center.
        """
        return cls(alpha_cutoff=1e-8, alpha_ceiling=1.0, low_pass=0.0, transmittance_stop=0.0)

    @classmethod
    def standard(cls) -> "RenderOptions":
        """The published constants, as `RenderOptions()`."""
        return cls()

    @classmethod
    def fast(cls) -> "RenderOptions":
        """Cutoff 1/64 and stop 1e-3, for previews; docs/results.md reports speed and error on a fitted model.

        An earlier stop or a smaller support radius would cost more quality than they save time.
        """
        return cls(alpha_cutoff=1 / 64, transmittance_stop=1e-3)
