"""The losses of `loss` in JAX, for fits on a device; a test compares both."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from foldgauss.video.fitting.steppers.loss import C1, C2, RADIUS, SQUARE_WEIGHT, TAPS, ImageLoss


@jax.custom_vjp
def blur(x: Float[Array, "*batch height width channels"]) -> Float[Array, "*batch height width channels"]:
    """The 11 taps down the columns and along the rows, zeros around. It is its own transpose."""
    # A barrier between the two passes: fused they would take 121 products instead of 22.
    return _along(jax.lax.optimization_barrier(_along(x, -3)), -2)


blur.defvjp(lambda x: (blur(x), None), lambda _, grad: (blur(grad),))


def _along(x: Array, axis: int) -> Array:
    axis, length = axis + x.ndim, x.shape[axis]
    padded = jnp.pad(x, [(RADIUS, RADIUS) if k == axis else (0, 0) for k in range(x.ndim)])

    def shift(k: int) -> Array:
        return jax.lax.slice_in_dim(padded, RADIUS + k, RADIUS + k + length, axis=axis)

    out = TAPS[0] * x
    for k in range(1, RADIUS + 1):
        out = out + TAPS[k] * (shift(-k) + shift(k))
    return out


def ssim(
    x: Float[Array, "*batch height width channels"], y: Float[Array, "*batch height width channels"]
) -> Float[Array, "*batch height width channels"]:
    """SSIM at every pixel, with zeros around the images: what `loss.image_loss` averages."""
    mean_x, mean_y, xx, yy, xy = blur(jnp.stack([x, y, x * x, y * y, x * y]))
    var_x, var_y, cov = xx - mean_x * mean_x, yy - mean_y * mean_y, xy - mean_x * mean_y
    top = (2 * mean_x * mean_y + C1) * (2 * cov + C2)
    return top / ((mean_x * mean_x + mean_y * mean_y + C1) * (var_x + var_y + C2))


def compute_losses(
    rendered: Float[Array, "batch height width channels"],
    target: Float[Array, "batch height width channels"],
    squared: Bool[Array, ""],
    ssim_fraction: float,
    function: Callable[[Array, Array], Array] | None = None,
) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
    """The loss of each image, as `squared_loss`, or as `image_loss` or by `function`, and its mean squared error.

    Source: Kerbl et al. 2023, eq. 7, with D-SSIM as 1 - SSIM; Wang et al. 2004.
    """
    difference = rendered - target
    errors = _mean(difference * difference)

    def first() -> Float[Array, " batch"]:
        if function is not None:
            return jax.vmap(function)(rendered, target)
        # Not `abs`, whose slope in JAX is 1 where both are equal: there it is 0.
        value = (1 - ssim_fraction) * _mean(difference * jax.lax.stop_gradient(jnp.sign(difference)))
        return value if ssim_fraction == 0 else value + ssim_fraction * (1 - _mean(ssim(rendered, target)))

    return jax.lax.cond(squared, lambda: np.float32(SQUARE_WEIGHT) * errors, first), errors


def custom_loss(rendered: np.ndarray, target: np.ndarray, function: Callable[[Array, Array], Array]) -> ImageLoss:
    """A function of `register_loss` for planar float32 images (channels, height, width), with its gradient."""
    value, gradient = _differentiate(function)(np.moveaxis(rendered, 0, -1), np.moveaxis(target, 0, -1))
    error = float(np.square(rendered - target).mean())
    return ImageLoss(float(value), np.array(np.moveaxis(np.asarray(gradient), -1, 0), order="C"), error)


@functools.cache
def _differentiate(function: Callable[[Array, Array], Array]) -> Callable[..., tuple[Array, Array]]:
    return jax.jit(jax.value_and_grad(function))


def _mean(x: Float[Array, "batch height width channels"]) -> Float[Array, " batch"]:
    """Mean over rows first: float32 sums of millions of pixels one by one would lose digits."""
    return jnp.mean(jnp.mean(x, axis=(2, 3)), axis=1)
