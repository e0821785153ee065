"""The shape one splat leaves on the pixels: closed forms in plain JAX."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def conic(factor: Float[Array, "2 2"], low_pass: float) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Inverse of F F^T + low_pass I as (xx, xy, yy), and the determinant it was divided by.

    The determinant is written as a sum of squares, det(F)^2 + low_pass |F|^2 + low_pass^2, which cannot cancel.
    """
    squared = jnp.sum(factor**2)
    xx = jnp.sum(factor[0] ** 2) + low_pass
    xy = jnp.sum(factor[0] * factor[1])
    yy = jnp.sum(factor[1] ** 2) + low_pass
    det = (factor[0, 0] * factor[1, 1] - factor[0, 1] * factor[1, 0]) ** 2 + low_pass * (squared + low_pass)
    safe = jnp.where(det > 0, det, jnp.ones_like(det))
    return jnp.stack([yy, -xy, xx]) / safe, det


def exponent(
    offset: Float[Array, "*pixels 2"], conic_entries: Float[Array, "3"]
) -> Float[Array, "*pixels"]:
    """-1/2 (x - m)^T K (x - m) for offsets x - m and K given as (xx, xy, yy)."""
    dx, dy = offset[..., 0], offset[..., 1]
    xx, xy, yy = conic_entries
    return -(xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy) / 2


def pixel_centres(size: tuple[int, int], dtype: jnp.dtype) -> Float[Array, "height width 2"]:
    """Coordinates (x, y) of every pixel's centre: x right, y down, the first at 0.5."""
    height, width = size
    x, y = jnp.arange(width, dtype=dtype) + 0.5, jnp.arange(height, dtype=dtype) + 0.5
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)
