"""Colours by sparse least squares, with geometry held: given alpha, every pixel is linear in the colours."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss._runtime.checks import invalid
from foldgauss.render.api import render
from foldgauss.render.splats import RenderOptions, Splats2D

#: Pull towards the colours the solve starts from, as a share of a bound on the normal matrix's largest eigenvalue: the
#: colour of a splat that hardly any pixel sees would otherwise run off to far outside [0, 1] for no visible gain.
RIDGE = 1e-6


def solve_colors(
    splats: Splats2D | Sequence[Splats2D],
    images: Float[Array, "height width channels"] | Sequence[Float[Array, "height width channels"]],
    *,
    background: Float[Array, " channels"] | None = None,
    compositing: str = "over",
    engine: str = "auto",
    options: RenderOptions | None = None,
    ridge: float = RIDGE,
    tolerance: float = 1e-4,
    max_iterations: int = 100,
) -> Float[Array, "num channels"]:
    r"""The colours that come closest to the images, geometry and opacities held.

    $$ \min_c \sum_k \| A_k c + b_k - y_k \|^2 + \lambda \| c - c_0 \|^2 $$

    A_k is the renderer's linear map from colours to frame k (the weights alpha_i T_i, the same for every channel), b_k
    what the background adds, c_0 the colours that the splats came with.

    - `splats`: of one frame, or a list of several frames' whose splats number i share one colour; the colours of the
      first are c_0.
    - `images`: (height, width, channels), or a list with one for each frame; sizes may differ.
    - `background`, `compositing`, `engine`, `options`: as `render`. Clamp nothing afterwards and the picture is the
      least-squares one; colours outside [0, 1] are legal.
    - `ridge`: lambda as a share of the largest row sum of sum_k A_k^T A_k, a bound on its eigenvalues as no weight is
      negative; larger pulls colours that few pixels see back to c_0. 0 is plain least squares.
    - `tolerance`, `max_iterations`: conjugate gradient stops once the residual of the normal equations has fallen by
      this factor in every channel, or after so many products with A and its transpose.

    Returns (num, channels). Raises ValueError where frames and images do not fit together or hold numbers that are not
    finite. Not for use inside `jit`: when to stop is decided on the host.

    Example: `Splats2D(mean, factor, opacity, solve_colors(splats, image))`.

    Source: Hestenes and Stiefel 1952, conjugate gradients on the normal equations (CGNR), preconditioned by row sums.
    """
    frames, images = _frames(splats, images)
    if not ridge >= 0:
        raise invalid("ridge", expected="a number >= 0", got=ridge)
    # Below single precision the descent loses its way.
    dtype = frames[0].color.dtype
    if dtype.itemsize < 4:
        frames, images = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (frames, images))
    start = frames[0].color
    how = {"compositing": compositing, "engine": engine, "options": options}

    def pictures(colors, background):
        return [
            render(Splats2D(one.mean, one.factor, one.opacity, colors), image.shape[:2], background=background, **how)
            for one, image in zip(frames, images, strict=True)
        ]

    def forward(colors):
        return pictures(colors, None)

    # The vector-Jacobian product of a linear map is its transpose, wherever it is taken.
    drawn, pull_back = jax.vjp(lambda colors: pictures(colors, background), start)

    def transpose(pictures):
        return pull_back(pictures)[0]

    row_sums = transpose(forward(jnp.ones_like(start)))
    damping = ridge * jnp.max(row_sums, initial=0)

    def normal(colors):
        return transpose(forward(colors)) + damping * colors

    right = transpose(jax.tree.map(jnp.subtract, images, drawn))
    found = start + _conjugate_gradient(normal, right, row_sums + damping, tolerance, max_iterations)
    return found.astype(dtype)


def _conjugate_gradient(normal, right, scale, tolerance: float, max_iterations: int) -> Float[Array, "num channels"]:
    """Solve normal(x) = right from x = 0, every channel a system of its own; rows where `scale` is 0 stay 0."""

    def dot(one, other):
        return jnp.sum(one * other, axis=0, keepdims=True)

    def ratio(above, below):
        return jnp.where(below > 0, above / jnp.where(below > 0, below, 1), 0)

    solution, residual = jnp.zeros_like(right), right
    direction = ratio(residual, scale)
    energy, goal = dot(residual, direction), tolerance**2 * dot(right, ratio(right, scale))
    for _ in range(max_iterations):
        if not bool(jnp.any(energy > goal)):
            break
        image = normal(direction)
        length = ratio(energy, dot(direction, image))
        solution, residual = solution + length * direction, residual - length * image
        conditioned = ratio(residual, scale)
        before, energy = energy, dot(residual, conditioned)
        direction = conditioned + ratio(energy, before) * direction
    return solution


def _frames(splats, images) -> tuple[list[Splats2D], list[Array]]:
    """Lists of equally many frames and images that fit together."""
    if isinstance(splats, Splats2D):
        splats, images = [splats], [images]
    splats, images = list(splats), list(images)
    if not splats or len(splats) != len(images):
        raise invalid("images", expected=f"one for each of {len(splats)} frames (at least 1)", got=len(images))
    shape, dtype = splats[0].color.shape, splats[0].color.dtype
    for one in splats:
        if one.color.shape != shape:
            raise invalid("splats", expected=f"colours of shape {shape} in every frame", got=one.color.shape)
    images = [jnp.asarray(image, dtype) for image in images]
    for image in images:
        if image.ndim != 3 or image.shape[-1] != shape[-1]:
            raise invalid("images", expected=f"shape (height, width, {shape[-1]})", got=image.shape)
    # One NaN would end the descent of every channel at its first step.
    for name, arrays in (("images", images), ("splats.color", [splats[0].color])):
        wrong = sum(int(jnp.sum(~jnp.isfinite(one))) for one in arrays)
        if wrong:
            raise invalid(name, expected="finite numbers", got=f"{wrong} that are NaN or infinite")
    return splats, images
