"""The reference engine: every splat on every pixel, in plain JAX, in the dtype of its input (float64 included).

Slow and readable on purpose. Tests hold every other engine to it, gradients included.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss.render.footprint import cap_alpha, compute_whitener, pixel_centers, raw_alpha, squared_distance
from foldgauss.render.splats import RenderOptions, Splats2D


def render_reference(
    splats: Splats2D,
    size: tuple[int, int],
    background: Float[Array, " channels"],
    *,
    compositing: str,
    options: RenderOptions,
) -> Float[Array, "height width channels"]:
    """Render the splats; `foldgauss.render.render` documents the arguments."""
    centers = pixel_centers(size, splats.mean.dtype)
    over = compositing == "over"

    def add(carry, splat):
        transmittance, image = carry
        alpha = splat_alpha(splat, centers, options)
        if over:
            alpha = jnp.where(transmittance > options.transmittance_stop, alpha, jnp.zeros_like(alpha))
        weight = alpha * transmittance  # with "sum" the background is not attenuated
        image = image + weight[..., None] * splat.color[None, None, :]
        return (transmittance - weight if over else transmittance, image), None

    start = jnp.ones(size, splats.mean.dtype), jnp.zeros((*size, splats.color.shape[-1]), splats.mean.dtype)
    (transmittance, image), _ = jax.lax.scan(add, start, splats)
    return image + transmittance[..., None] * background[None, None, :]


def splat_alpha(
    splat: Splats2D, centers: Float[Array, "height width 2"], options: RenderOptions
) -> Float[Array, "height width"]:
    """Alpha of one splat at every pixel center: capped, and zero where it is left out."""
    whitener, valid = compute_whitener(splat.factor, options.low_pass)
    offset = centers - splat.mean[None, None, :]
    distance = squared_distance(offset[..., 0], offset[..., 1], whitener)
    alpha = cap_alpha(raw_alpha(splat.opacity, distance, options), options)
    return jnp.where(valid, alpha, jnp.zeros_like(alpha))
