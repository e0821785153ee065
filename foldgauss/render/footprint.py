"""The alpha of one splat at a pixel: closed forms in plain JAX, and the cutoffs that all engines apply."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from foldgauss.render._cpu_kernels import THINNEST, WIDEST
from foldgauss.render.splats import RenderOptions

# WIDEST and THINNEST are bounds of 1 / (a standard deviation) in the unit in which the exponent is a power of two. They
# are defined beside the kernels, since Numba's cache does not notice a change in another file.
_PER_POWER_OF_TWO = math.sqrt(0.5 * math.log2(math.e))


def compute_whitener(factor: Float[Array, "2 2"], low_pass: float) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    r"""(p, q, r) with (p dx + q dy)^2 + (r dy)^2 the squared Mahalanobis distance, and whether the splat is rendered.

    The covariance is F F^T + low_pass I. Its determinant is written as a sum of squares, which cannot cancel, and the
    offset is whitened before it is squared: the three terms of the usual conic cancel for thin, slanted splats.
    A splat that is left out (too thin, too wide, NaN) gets the values of F = I, so that no NaN reaches a gradient.
    """
    p, q, r = _whitener(factor, low_pass) * _PER_POWER_OF_TWO
    along_x = _PER_POWER_OF_TWO / jnp.sqrt(covariance(factor, low_pass)[0])
    # Also False for NaN, and for a determinant of 0.
    valid = (p < THINNEST) & (jnp.hypot(q, r) < THINNEST) & (r > WIDEST) & (along_x > WIDEST)
    return _whitener(jnp.where(valid, factor, jnp.eye(2, dtype=factor.dtype)), low_pass), valid


def _whitener(factor: Float[Array, "2 2"], low_pass: float) -> Float[Array, "3"]:
    _, xy, yy, det = covariance(factor, low_pass)
    # Two roots, not the root of the quotient: its derivative holds det^2, which underflows.
    p = jnp.sqrt(yy) / jnp.sqrt(det)
    return jnp.stack([p, -xy / yy * p, 1 / jnp.sqrt(yy)])


def covariance(factor: Float[Array, "2 2"], low_pass: float) -> tuple[Float[Array, ""], ...]:
    """Entries xx, xy, yy of F F^T + low_pass I, and the determinant."""
    (a, b), (c, d) = factor
    xx, xy, yy = a * a + b * b + low_pass, a * c + b * d, c * c + d * d + low_pass
    return xx, xy, yy, (a * d - b * c) ** 2 + low_pass * (xx + yy - low_pass)


def squared_distance(dx, dy, whitener):
    """Squared Mahalanobis distance of offsets x - m; `whitener` is (p, q, r), each of a shape that broadcasts."""
    p, q, r = whitener
    return (p * dx + q * dy) ** 2 + (r * dy) ** 2


def raw_alpha(opacity, distance, options: RenderOptions):
    """Opacity times the Gaussian; 0 below the cutoff and beyond the support radius. Not yet capped."""
    alpha = opacity * jnp.exp(-distance / 2)
    kept = alpha >= options.alpha_cutoff
    if options.support_radius is not None:
        kept &= distance <= options.support_radius**2
    return jnp.where(kept, alpha, jnp.zeros_like(alpha))


def cap_alpha(alpha, options: RenderOptions):
    """Limit alpha to the ceiling. Not `minimum`, whose gradient is 1/2 where the two are equal, as at alpha 1."""
    return jnp.where(alpha > options.alpha_ceiling, jnp.full_like(alpha, options.alpha_ceiling), alpha)


def squared_reach(opacity, options: RenderOptions):
    """Squared Mahalanobis distance up to which a splat may be visible; negative where it is nowhere."""
    cutoff = options.alpha_cutoff
    reach = 2 * (jnp.log(jnp.maximum(opacity, cutoff / 2)) - math.log(cutoff))
    return reach if options.support_radius is None else jnp.minimum(reach, options.support_radius**2)


def pixel_centers(size: tuple[int, int], dtype: jnp.dtype) -> Float[Array, "height width 2"]:
    """Coordinates (x, y) of every pixel's center: x right, y down, the first at 0.5."""
    height, width = size
    x, y = jnp.arange(width, dtype=dtype) + 0.5, jnp.arange(height, dtype=dtype) + 0.5
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)
