"""The shape one splat leaves on the pixels: closed forms in plain JAX."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def whitening(factor: Float[Array, "2 2"], low_pass: float) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    r"""(p, q, r) with (p dx + q dy)^2 + (r dy)^2 the squared Mahalanobis distance, and the covariance's determinant.

    The covariance is F F^T + low_pass I. Its determinant is written as a sum of squares, which cannot cancel, and the
    distance is centred before it is squared: the three terms of the usual conic cancel for thin, slanted splats.
    """
    xx = jnp.sum(factor[0] ** 2) + low_pass
    xy = jnp.sum(factor[0] * factor[1])
    yy = jnp.sum(factor[1] ** 2) + low_pass
    area = factor[0, 0] * factor[1, 1] - factor[0, 1] * factor[1, 0]
    det = area**2 + low_pass * (xx + yy - low_pass)
    kept = (det > 0) & (yy > 0)
    det_safe, yy_safe = jnp.where(kept, det, jnp.ones_like(det)), jnp.where(kept, yy, jnp.ones_like(yy))
    across = jnp.sqrt(det_safe * yy_safe)
    return jnp.stack([yy / across, -xy / across, 1 / jnp.sqrt(yy_safe)]), det


def exponent(offset: Float[Array, "*pixels 2"], whitener: Float[Array, "3"]) -> Float[Array, "*pixels"]:
    """Minus half the squared Mahalanobis distance of offsets x - m."""
    dx, dy = offset[..., 0], offset[..., 1]
    p, q, r = whitener
    return -((p * dx + q * dy) ** 2 + (r * dy) ** 2) / 2


def pixel_centres(size: tuple[int, int], dtype: jnp.dtype) -> Float[Array, "height width 2"]:
    """Coordinates (x, y) of every pixel's centre: x right, y down, the first at 0.5."""
    height, width = size
    x, y = jnp.arange(width, dtype=dtype) + 0.5, jnp.arange(height, dtype=dtype) + 0.5
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)
