"""Colors by sparse least squares with fixed geometry: given alpha, every pixel is linear in the colors."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss._runtime.checks import require
from foldgauss.render.api import render
from foldgauss.render.splats import RenderOptions, Splats2D

#: Regularization towards the initial colors, as a fraction of a bound on the normal matrix's largest eigenvalue:
#: without it the color of a splat that is hardly visible could end far outside [0, 1].
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
    r"""Solve for the colors that fit the images best in least squares, with geometry and opacities fixed.

    $$ \min_c \sum_k \| A_k c + b_k - y_k \|^2 + \lambda \| c - c_0 \|^2 $$

    A_k is the renderer's linear map from colors to frame k (the weights alpha_i T_i, the same for every channel), b_k
    the background's contribution, c_0 the splats' own colors.

    - `splats`: of one frame, or a list of several frames' whose i-th splats share one color; the colors of the first
      are c_0.
    - `images`: (height, width, channels), or a list with one for each frame; sizes may differ.
    - `background`, `compositing`, `engine`, `options`: as `render`. Colors outside [0, 1] are valid; clamping them
      would leave the least-squares solution.
    - `ridge`: lambda as a fraction of the largest row sum of sum_k A_k^T A_k, a bound on its eigenvalues as no weight
      is negative; larger values keep colors of hardly visible splats near c_0. 0 is plain least squares.
    - `tolerance`, `max_iterations`: conjugate gradients stop once the residual of the normal equations has fallen by
      this factor, or after this many products with A and its transpose.

    Returns (num, channels). Raises ValueError if frames and images do not match or hold values that are not finite.
    Not for use inside `jit`: convergence is checked on the host.

    Example: `Splats2D(mean, factor, opacity, solve_colors(splats, image))`.

    Source: Hestenes and Stiefel 1952, conjugate gradients on the normal equations (CGNR), preconditioned by row sums.
    """
    frames, images = _check_frames(splats, images)
    require(ridge >= 0, "ridge", expected="a number >= 0", got=ridge)
    # Conjugate gradients need at least single precision.
    dtype = frames[0].color.dtype
    if dtype.itemsize < 4:
        frames, images = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (frames, images))
    start = frames[0].color

    def render_frames(colors, background):
        return [
            render(
                Splats2D(one.mean, one.factor, one.opacity, colors),
                image.shape[:2],
                background=background,
                compositing=compositing,
                engine=engine,
                options=options,
            )
            for one, image in zip(frames, images, strict=True)
        ]

    # The vector-Jacobian product of a linear map is its transpose, wherever it is taken.
    rendered, pull_back = jax.vjp(lambda colors: render_frames(colors, background), start)

    def gram(colors):
        """The product of A^T A and the colors."""
        return pull_back(render_frames(colors, None))[0]

    row_sums = gram(jnp.ones_like(start))
    damping = ridge * jnp.max(row_sums, initial=0)

    def precondition(residual):
        scale = row_sums + damping
        return jnp.where(scale > 0, residual / jnp.where(scale > 0, scale, 1), 0)

    right, *_ = pull_back(jax.tree.map(jnp.subtract, images, rendered))
    solve = functools.partial(jax.scipy.sparse.linalg.cg, maxiter=max_iterations, tol=tolerance)
    change, _ = solve(lambda colors: gram(colors) + damping * colors, right, M=precondition)
    return (start + change).astype(dtype)


def _check_frames(splats, images) -> tuple[list[Splats2D], list[Array]]:
    """Lists of frames and images, equally long and of matching shapes."""
    if isinstance(splats, Splats2D):
        splats, images = [splats], [images]
    splats, images = list(splats), list(images)
    require(
        splats and len(splats) == len(images),
        "images",
        expected=f"one for each of {len(splats)} frames (at least 1)",
        got=len(images),
    )
    shape, dtype = splats[0].color.shape, splats[0].color.dtype
    for one in splats:
        require(
            one.color.shape == shape, "splats", expected=f"colors of shape {shape} in every frame", got=one.color.shape
        )
    images = [jnp.asarray(image, dtype) for image in images]
    for image in images:
        require(
            image.ndim == 3 and image.shape[-1] == shape[-1],
            "images",
            expected=f"shape (height, width, {shape[-1]})",
            got=image.shape,
        )
    # One NaN would end the iteration of every channel at its first step.
    for name, arrays in (("images", images), ("splats.color", [splats[0].color])):
        count = sum(int(jnp.sum(~jnp.isfinite(one))) for one in arrays)
        require(not count, name, expected="finite numbers", got=f"{count} that are NaN or infinite")
    return splats, images
