"""Two-dimensional splats and the constants that say how they become pixels."""

import dataclasses
import math
from numbers import Integral, Real

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss._runtime.checks import invalid

#: Below the first support radius, in standard deviations, a splat is no Gaussian any more; the square of the second
#: is still far from the end of float32.
SMALLEST_RADIUS, LARGEST_RADIUS = 0.1, 1e6
#: Engine "xla" counts (tile, splat) pairs up to one more, so that int32 holds the sum of two.
LARGEST_CAPACITY = 2**30 - 2


class Splats2D(eqx.Module):
    r"""Gaussians of one frame, in array order from front to back.

    $$ \alpha_i(x) = \rho_i \exp(-\tfrac12 (x - m_i)^T (F_i F_i^T)^{-1} (x - m_i)) $$

    Shapes: `mean` (num, 2) as (x right, y down); `factor` (num, 2, 2), any F with covariance F F^T (a
    rotation times scales, or a Cholesky factor); `opacity` (num,) in [0, 1]; `color` (num, channels).
    Units: `render` takes pixels, with pixel centres at +0.5; `to_pixels` brings splats there from model
    space, where the frame's centre is the origin and its longer side has length 1.
    """

    mean: Float[Array, "num 2"]
    factor: Float[Array, "num 2 2"]
    opacity: Float[Array, " num"]
    color: Float[Array, "num channels"]

    def __check_init__(self) -> None:
        check_shapes(self, mean=(2,), factor=(2, 2))

    def to_pixels(self, size: tuple[int, int], *, aspect: float | None = None) -> "Splats2D":
        """Model space to pixels of a picture of `size` = (height, width).

        `aspect` is the model frame's height / width (default: the picture's own). Where the two differ the
        frame covers the picture and what sticks out is cut off evenly, as a centre crop does. Raises ValueError as
        `pixels_per_unit`.
        """
        scale = pixels_per_unit(size, aspect=aspect)
        height, width = size
        centre = jnp.asarray([[width / 2, height / 2]], self.mean.dtype)
        return Splats2D(self.mean * scale + centre, self.factor * scale, self.opacity, self.color)


def check_shapes(splats: eqx.Module, **geometry: tuple[int, ...]) -> None:
    """Raise unless the leaves fit: for one splat those named have these shapes, opacity (), color (channels,)."""
    names = [*geometry, "opacity", "color"]
    shapes = [getattr(getattr(splats, name), "shape", None) for name in names]
    if any(shape is None for shape in shapes):
        return  # a skeleton, as inside tree transformations
    *_, num, color = shapes
    own = [(*num, *shape) for shape in geometry.values()]
    if shapes != [*own, num, (*num, *color[-1:])] or len(color) == len(num):
        texts = [f"(num, {', '.join(map(str, shape))})" for shape in geometry.values()]
        expected = f"shapes {', '.join(texts)}, (num,), (num, channels)"
        raise invalid(", ".join(names), expected=expected, got=", ".join(map(str, shapes)))


def check_size(size: tuple[int, int]) -> None:
    """Raise unless `size` is that of a picture, (height, width)."""
    pair = isinstance(size, (tuple, list)) and len(size) == 2
    if not (pair and all(isinstance(n, Integral) and n >= 1 for n in size)):
        raise invalid("size", expected="(height, width), both whole and >= 1", got=size)


def check_aspect(aspect: float) -> None:
    """Raise unless `aspect` is that of a frame."""
    if not (isinstance(aspect, Real) and 0 < aspect < math.inf):
        raise invalid("aspect", expected="a frame's height / width, one positive number", got=aspect)


def pixels_per_unit(size: tuple[int, int], *, aspect: float | None = None) -> float:
    """Pixels along one unit of model space when a frame of height/width `aspect` covers `size` (None: its own).

    Raises ValueError unless `size` is two whole numbers >= 1 and `aspect` one positive number.
    """
    check_size(size)
    height, width = size
    aspect = height / width if aspect is None else aspect
    check_aspect(aspect)
    unit_height, unit_width = min(1.0, aspect), min(1.0, 1 / aspect)
    return max(height / unit_height, width / unit_width)


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """What is left out of a picture, and how little it matters; and how the work is cut, which changes no picture.

    The defaults are the constants of the published 3DGS rasteriser and so of VeGaS. For a single splat the cutoff and
    the stop change a pixel by no more than one step of 8 bits, the ceiling by up to 2.55 of them (where the opacity is
    above 0.99), the low pass by more. See `exact`, `standard` and `fast`.

    Raises ValueError for a number outside its bounds. Numbers are kept as Python's own.
    """

    #: A splat is dropped where its alpha is below this: less than one step of an 8-bit picture.
    alpha_cutoff: float = 1 / 255
    #: Alpha never exceeds this, so that some light is left and what lies behind has a gradient. 1: no ceiling.
    alpha_ceiling: float = 0.99
    #: Variance in px^2 added to both axes: a splat is never thinner than about a pixel's footprint.
    low_pass: float = 0.3
    #: A pixel is finished once the light left is not above this.
    transmittance_stop: float = 1e-4
    #: A splat is dropped beyond this many standard deviations. None: where the cutoff drops it anyway, which loses
    #: nothing more (3.3 deviations for opacity 1 and 1/255). The published rasteriser cuts its tiles' lists, not its
    #: pixels, at 3.
    support_radius: float | None = None
    #: Side of the square tiles that splats are listed by, in px: speed only. None: what the engine is fastest with.
    tile_size: int | None = None
    #: Room for (tile, splat) pairs in engine "xla": memory and speed only, since splats that do not fit into the lists
    #: at once are drawn in several rounds. A whole number of at least the number of tiles; None: counted where the
    #: splats are known, else (inside `jit`, `vmap`) derived from the numbers of splats and tiles.
    list_capacity: int | None = None

    def __post_init__(self) -> None:
        highest = {"alpha_cutoff": 1.0, "alpha_ceiling": 1.0, "low_pass": math.inf, "transmittance_stop": 1.0}
        for name, high in highest.items():
            self._check(name, 1e-8 if name == "alpha_cutoff" else 0.0, high, closed=name == "alpha_ceiling")
        if self.support_radius is not None:
            self._check("support_radius", SMALLEST_RADIUS, LARGEST_RADIUS, closed=True)
        for name, low, high in (("tile_size", 4, 32), ("list_capacity", 1, LARGEST_CAPACITY)):
            value = getattr(self, name)
            if value is None:
                continue
            if not (isinstance(value, Integral) and not isinstance(value, bool) and low <= value <= high):
                expected = f"None or a whole number in [{low}, {high}]"
                raise invalid(f"RenderOptions.{name}", expected=expected, got=value)
            object.__setattr__(self, name, int(value))

    def _check(self, name: str, low: float, high: float, *, closed: bool = False) -> None:
        value = getattr(self, name)
        within = isinstance(value, Real) and low <= value and (value <= high if closed else value < high)
        if not within:
            expected = f"a number in [{low:g}, {high:g}{']' if closed else ')'}"
            raise invalid(f"RenderOptions.{name}", expected=expected, got=value)
        object.__setattr__(self, name, float(value))

    @classmethod
    def exact(cls) -> "RenderOptions":
        """The formula to the letter: no low pass, no ceiling, no stop, and the smallest cutoff there is.

        Alphas below 1e-8 alone are dropped (6 deviations), as no float32 picture would show them. Splats much
        smaller than a pixel are then seen only if they meet a pixel's centre.
        """
        return cls(alpha_cutoff=1e-8, alpha_ceiling=1.0, low_pass=0.0, transmittance_stop=0.0)

    @classmethod
    def standard(cls) -> "RenderOptions":
        """The published constants, as `RenderOptions()`."""
        return cls()

    @classmethod
    def fast(cls) -> "RenderOptions":
        """Cutoff 1/64 and stop 1e-3, for previews: what these bring on a fitted model is in docs/performance.md.

        A later stop costs more picture than it saves time, and so does a smaller support radius.
        """
        return cls(alpha_cutoff=1 / 64, transmittance_stop=1e-3)
