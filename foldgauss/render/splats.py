"""Two-dimensional splats and the constants that say how they become pixels."""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss._checks import invalid


class Splats2D(eqx.Module):
    r"""Gaussians of one frame, in array order from front to back.

    .. math:: \alpha_i(x) = \rho_i \exp(-\tfrac12 (x - m_i)^T (F_i F_i^T)^{-1} (x - m_i))

    Shapes: `mean` (num, 2) as (x right, y down); `factor` (num, 2, 2), any F with covariance F F^T (a
    rotation times scales, or a Cholesky factor); `opacity` (num,) in [0, 1]; `color` (num, channels).
    Units: `render` takes pixels, with pixel centres at +0.5; `to_pixels` brings splats there from model
    space, where the frame's centre is the origin and its longer side has length 1.
    """

    mean: Float[Array, "num 2"]
    factor: Float[Array, "num 2 2"]
    opacity: Float[Array, "num"]
    color: Float[Array, "num channels"]

    def __check_init__(self) -> None:
        shapes = [getattr(leaf, "shape", None) for leaf in (self.mean, self.factor, self.opacity, self.color)]
        if any(shape is None for shape in shapes):
            return  # a skeleton, as inside tree transformations
        num = shapes[0][:-1]
        fits = shapes == [(*num, 2), (*num, 2, 2), num, (*num, *shapes[3][-1:])] and len(shapes[3]) > len(num)
        if not fits:
            raise invalid(
                "mean, factor, opacity, color",
                expected="shapes (num, 2), (num, 2, 2), (num,), (num, channels)",
                got=", ".join(map(str, shapes)),
            )

    def to_pixels(self, size: tuple[int, int], *, aspect: float | None = None) -> "Splats2D":
        """Model space to pixels of a picture of `size` = (height, width).

        `aspect` is the model frame's height / width (default: the picture's own). Where the two differ the
        frame covers the picture and what sticks out is cut off evenly, as a centre crop does.
        """
        height, width = size
        scale = pixels_per_unit(size, aspect=height / width if aspect is None else aspect)
        centre = jnp.asarray([[width / 2, height / 2]], self.mean.dtype)
        return Splats2D(self.mean * scale + centre, self.factor * scale, self.opacity, self.color)


def pixels_per_unit(size: tuple[int, int], *, aspect: float) -> float:
    """Pixels along one unit of model space when a frame of height/width `aspect` covers `size`."""
    height, width = size
    unit_height, unit_width = min(1.0, aspect), min(1.0, 1 / aspect)
    return max(height / unit_height, width / unit_width)


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """What is left out of a picture, and how little it matters.

    The defaults are the constants of the published 3DGS rasteriser and so of VeGaS; `low_pass` excepted, they
    change a pixel by less than one step of 8 bits for a single splat.
    """

    #: A splat is dropped where its alpha is below this: less than one step of an 8-bit picture.
    alpha_cutoff: float = 1 / 255
    #: Alpha never exceeds this, so that some light is left and the gradient of what lies behind is finite.
    alpha_ceiling: float = 0.99
    #: Variance in px^2 added to both axes: a splat is never thinner than about a pixel's footprint.
    low_pass: float = 0.3
    #: A pixel is finished once the light left is not above this.
    transmittance_stop: float = 1e-4

    def __post_init__(self) -> None:
        bounds = {
            "alpha_cutoff": (1e-8, 1.0),
            "alpha_ceiling": (0.0, 1.0),
            "low_pass": (0.0, math.inf),
            "transmittance_stop": (0.0, 1.0),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not (isinstance(value, float | int) and low <= value < high):
                raise invalid(f"RenderOptions.{name}", expected=f"a number in [{low:g}, {high:g})", got=value)
