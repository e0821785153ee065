"""The judge: every splat on every pixel, in plain JAX, in the dtype of its input (float64 included).

Slow and readable on purpose. Every other engine must agree with it, gradients too.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss.render.footprint import capped, pixel_centres, raw_alpha, squared_distance, whitening
from foldgauss.render.splats import RenderOptions, Splats2D


def render_reference(
    splats: Splats2D,
    size: tuple[int, int],
    background: Float[Array, " channels"],
    *,
    compositing: str,
    options: RenderOptions,
) -> Float[Array, "height width channels"]:
    """Picture of the splats; see `foldgauss.render.render` for the meaning of the arguments."""
    centres = pixel_centres(size, splats.mean.dtype)
    step = {"over": _over, "sum": _sum}[compositing]

    def add(carry, splat):
        alpha = splat_alpha(splat, centres, options)
        return step(carry, alpha, splat.color, options), None

    light = jnp.ones(size, splats.mean.dtype)
    blank = jnp.zeros((*size, splats.color.shape[-1]), splats.mean.dtype)
    (transmittance, image), _ = jax.lax.scan(add, (light, blank), splats)
    return image + transmittance[..., None] * background[None, None, :]


def splat_alpha(
    splat: Splats2D, centres: Float[Array, "height width 2"], options: RenderOptions
) -> Float[Array, "height width"]:
    """Alpha of one splat at every pixel centre: capped, and zero where it is left out."""
    whitener, drawn = whitening(splat.factor, options.low_pass)
    offset = centres - splat.mean[None, None, :]
    distance = squared_distance(offset[..., 0], offset[..., 1], whitener)
    alpha = capped(raw_alpha(splat.opacity, distance, options), options)
    return jnp.where(drawn, alpha, jnp.zeros_like(alpha))


def _over(carry, alpha, color, options):
    """Front to back: a splat takes its share of the light that those before it left."""
    transmittance, image = carry
    alpha = jnp.where(transmittance > options.transmittance_stop, alpha, jnp.zeros_like(alpha))
    weight = alpha * transmittance
    return transmittance - weight, image + weight[..., None] * color[None, None, :]


def _sum(carry, alpha, color, options):
    """Accumulated blend: every splat adds its light, over a background that stays whole."""
    del options
    transmittance, image = carry
    return transmittance, image + alpha[..., None] * color[None, None, :]
