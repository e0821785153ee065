"""A mixture's density as an image, rendered exactly as a sum of splats."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from foldgauss._runtime.checks import require
from foldgauss.mixture import FoldedMixture
from foldgauss.render import RenderOptions, Splats2D, render

__all__ = ["density_image"]

_LOG_2PI = float(np.log(2 * np.pi))


def density_image(
    mixture: FoldedMixture, t: ArrayLike, size: tuple[int, int], *, aspect: float | None = None, engine: str = "auto"
) -> Float[Array, "height width"]:
    """p(x, y, t) at the center of every pixel: `mixture.pdf` on the grid, but rendered.

        sum_k  w_k N(t; m_t, sigma_t^2) / (2 pi sqrt(det a Sigma_s))  exp(-q_k(x, y) / 2)

    The components at t are splats whose color is their peak, added up without low-pass filter, ceiling or stop. Left
    out are values below 1e-8 of a component's *own* peak (6 deviations), and components much thinner than a pixel, see
    `RenderOptions.exact`. Differentiable in the mixture's parameters.

    Shapes: `mixture` of (x, y, t) without batch dimensions; t a number; `size` (height, width) -> (height, width).

    Units: density per unit of model space squared and of time, *not* per pixel: model space has its origin at the
    image's center, x right, y down, and the longer side of the frame is 1 (`aspect`: height / width of the frame,
    default the image's own). Divide by `pixels_per_unit(size)` squared for pixels, and by `p(t)` for space given t.

    Example: `density_image(mixture, 0.5, (90, 160))`.

    Source: eq:foldgauss, as the accumulated blend of eq:vegas_equiv_cond. Raises ValueError unless the mixture is of
    (x, y, t), and as `render`.
    """
    require(
        mixture.event_shape == (3,) and mixture.batch_shape == (),
        "mixture",
        expected="points (x, y, t) and no batch",
        got=f"event {mixture.event_shape}, batch {mixture.batch_shape}",
        cure="Use marginal, or jax.vmap.",
    )
    components, dtype = mixture.components, mixture.components.loc.dtype
    t = jnp.asarray(t, dtype)
    require(not t.ndim, "t", expected="one number", got=f"shape {t.shape}", cure="Use jax.vmap for several times.")
    at = components.condition_time(t)
    log_det = jnp.log(jnp.diagonal(at.base_tril, axis1=-2, axis2=-1)).sum(-1) + 2 * at.log_scale
    log_peak = mixture.log_weights + components.marginal([-1]).log_prob(t[..., None]) - log_det - _LOG_2PI
    # Peaks of any size are colors: opacities cannot exceed 1.
    highest = float(np.log(jnp.finfo(dtype).max)) - 1  # an infinite color would not be rendered
    peak = jnp.exp(jnp.minimum(log_peak, highest))
    num = mixture.num_components
    factor = jnp.broadcast_to(jnp.tril(at.scale_tril), (num, 2, 2))  # no gradient above the diagonal
    splats = Splats2D(at.mean, factor, jnp.ones_like(peak), peak[:, None])
    pixels = splats.to_pixels(size, aspect=aspect)
    return render(pixels, size, compositing="sum", engine=engine, options=RenderOptions.exact())[..., 0]
