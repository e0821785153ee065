"""The public function `render`: checks its arguments, chooses an engine, and is differentiable under jit and vmap."""

import dataclasses
import functools
import math
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from jaxtyping import Array, Float

from foldgauss._runtime.checks import check_one_of, require
from foldgauss._runtime.device import default_platform
from foldgauss.render import cpu, pallas, xla
from foldgauss.render.reference import render_reference
from foldgauss.render.rounds import render_rounds
from foldgauss.render.splats import RenderOptions, Splats2D, check_size

ENGINES = ("auto", "cpu", "xla", "pallas", "reference")
COMPOSITINGS = ("over", "sum")


def render(
    splats: Splats2D,
    size: tuple[int, int],
    *,
    background: Float[Array, " channels"] | None = None,
    compositing: str = "over",
    engine: str = "auto",
    options: RenderOptions | None = None,
    return_alpha: bool = False,
    return_depth: bool = False,
) -> Float[Array, "height width channels"] | tuple[Array, ...]:
    r"""Render an image of two-dimensional splats by alpha compositing front to back.

    $$ C = \sum_i c_i \alpha_i T_i + T_{end}\, c_{bg}, \qquad T_i = \prod_{j<i} (1 - \alpha_j) $$

    - `splats`: in pixels (x right, y down, centers at +0.5), front to back in array order.
    - `size`: (height, width) in pixels.
    - `background`: one color, (channels,); None is black.
    - `compositing`: "over", as 3DGS and VeGaS; or "sum", the accumulated blend of GaussianImage, where all
      T_i are 1 and the background is added in full.
    - `engine`: "cpu" (Numba, float32 inside); "xla" (tiles in plain JAX, on CPU, GPU and TPU, float32 or float64);
      "pallas" (a GPU program per tile, float32 inside; on a CPU interpreted, for tests only); "reference" (dense,
      slow); or "auto": "cpu" if JAX's default device is a CPU and "cpu" supports the options, "pallas" if it is a GPU,
      "pallas" supports the options and the splats are float32, else "xla".
    - `options`: cutoffs and tiling, `RenderOptions`.
    - `return_alpha`: also return alpha, (height, width): sum_i alpha_i T_i, which is 1 - T_end up to rounding.
    - `return_depth`: also return the expected depth, (height, width), in model units along the camera's axis:
      sum_i alpha_i T_i z_i / sum_i alpha_i T_i with z the `splats.depth` that `project` sets; 0 where alpha is 0. This
      is gsplat's mode "ED"; its "D", the sum without the division, is the product of depth and alpha.

    Returns the image, (height, width, channels), in the dtype of `splats.mean`; or a tuple of image, alpha and depth
    without what was not asked for. Differentiable in every leaf of `splats` and in `background`. A splat with a
    parameter that is not finite is left out and gets no gradient. Raises ValueError for an unknown option, a size below
    1, shapes that do not match, colors without a channel, alpha or depth with compositing "sum", and depth of splats
    without one; RuntimeError in a process that was forked after JAX had started.

    Example: `render(Splats2D(mean, factor, opacity, color), (160, 320))`.

    Source: Kerbl et al. 2023, 3D Gaussian Splatting, eq. 3; VeGaS, section 4.
    """
    check_one_of("engine", engine, ENGINES)
    check_one_of("compositing", compositing, COMPOSITINGS)
    check_size(size)
    require(
        isinstance(splats, Splats2D),
        "splats",
        expected="Splats2D",
        got=type(splats).__name__,
        cure="For Gaussians3D use foldgauss.render.project first.",
    )
    require(
        isinstance(options, RenderOptions | None),
        "options",
        expected="RenderOptions or None",
        got=repr(options),
        cure="A preset is RenderOptions.fast(), with parentheses.",
    )
    require(
        splats.mean.ndim == 2,
        "splats",
        expected="mean of shape (num, 2)",
        got=splats.mean.shape,
        cure="Use jax.vmap for a batch.",
    )
    require(
        jnp.issubdtype(splats.mean.dtype, jnp.floating),
        "splats.mean",
        expected="a floating dtype",
        got=splats.mean.dtype,
    )
    options = cpu.STANDARD if options is None else options
    channels, dtype = splats.color.shape[-1], splats.mean.dtype
    background = jnp.zeros(channels, dtype) if background is None else jnp.asarray(background, dtype)
    require(channels != 0, "splats.color", expected="at least one channel", got=f"shape {splats.color.shape}")
    require(background.shape == (channels,), "background", expected=f"shape ({channels},)", got=background.shape)
    if engine == "auto":
        engine = choose_engine(options, dtype)
    if engine == "pallas":
        pallas.check_options(options)
    # Engine "xla" is not compiled here: it sizes its lists by concrete values where it can.
    run = _run_compiled if engine == "cpu" else _run_engine
    how = (tuple(map(int, size)), compositing, engine, options)
    if not (return_alpha or return_depth):
        return run(splats, background, *how)
    require(
        compositing == "over",
        "compositing",
        expected="'over' for alpha and depth",
        got=repr(compositing),
        cure="A sum has no transmittance; the image of colors of 1 is the sum of its alphas.",
    )
    require(
        not return_depth or splats.depth is not None,
        "splats.depth",
        expected="a depth of each splat, shape (num,)",
        got=None,
        cure="foldgauss.render.project sets them.",
    )
    # Images of the same weights: alpha is that of color 1, and the sum of weighted depths that of color z, both over 0.
    added = [jnp.ones_like(splats.opacity), *([splats.depth] if return_depth else [])]
    color = jnp.concatenate([splats.color, jnp.stack(added, -1).astype(splats.color.dtype)], -1)
    behind = jnp.concatenate([background, jnp.zeros(len(added), dtype)])
    image = run(dataclasses.replace(splats, color=color), behind, *how)
    alpha = image[..., channels]
    outputs = [image[..., :channels], *([alpha] if return_alpha else [])]
    if return_depth:
        outputs.append(image[..., -1] / jnp.where(alpha > 0, alpha, jnp.ones_like(alpha)))
    return tuple(outputs)


def choose_engine(options: RenderOptions, dtype: np.dtype) -> str:
    """The engine that "auto" stands for, by the options and the dtype of the splats."""
    if default_platform() == "cpu":
        return "cpu"
    return "pallas" if dtype == jnp.float32 and pallas.is_preferred(options) else "xla"


def _run_engine(splats, background, size, compositing, engine, options):
    dtype = splats.mean.dtype
    if engine == "cpu":  # it leaves out splats that are not finite itself
        leaves = (splats.mean, splats.factor, splats.opacity, splats.color, background)
    else:
        leaves = (*_zero_nonfinite(splats), background)
    if engine == "reference":
        return render_reference(Splats2D(*leaves[:4]), size, background, compositing=compositing, options=options)
    # Below single precision a sum of hundreds of splats has no digits left; "xla" keeps float64.
    inner = jnp.float32 if engine in ("cpu", "pallas") or dtype.itemsize < 4 else dtype
    leaves = tuple(leaf.astype(inner) for leaf in leaves)
    if engine != "cpu" and not len(leaves[2]):
        image = jnp.broadcast_to(leaves[4][None, None, :], (*size, len(leaves[4])))
    elif engine == "cpu":
        parts = [slice(k, k + cpu.MOST_CHANNELS) for k in range(0, len(leaves[4]), cpu.MOST_CHANNELS)]
        images = [
            _render_cpu(size, compositing, options, *leaves[:3], leaves[3][:, part], leaves[4][part]) for part in parts
        ]
        image = jnp.concatenate(images, -1)
    else:
        module = xla if engine == "xla" else pallas
        image = render_rounds(module.ENGINE, module.choose_plan(leaves, size, compositing, options), leaves)
    return image.astype(dtype)


_run_compiled = jax.jit(_run_engine, static_argnums=(2, 3, 4, 5))


@jax.jit
def _zero_nonfinite(splats: Splats2D) -> tuple[jax.Array, ...]:
    """The leaves, with zeros in place of splats that hold NaN or infinity: without opacity they are left out."""
    leaves = (splats.mean, splats.factor, splats.opacity, splats.color)
    flat = [leaf.reshape(len(leaf), math.prod(leaf.shape[1:])) for leaf in leaves]
    kept = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf), axis=1) for leaf in flat]), axis=0)
    return tuple(
        jnp.where(kept[:, None], leaf, jnp.zeros_like(leaf)).reshape(own.shape)
        for leaf, own in zip(flat, leaves, strict=True)
    )


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _render_cpu(size, compositing, options, *leaves):
    """The CPU engine as a JAX function of float32 leaves."""

    def fill(image, *leaves):
        trace = cpu.forward(*leaves, size, compositing=compositing, options=options)
        image[...] = cv2.merge(list(trace.image)).reshape(image.shape)  # faster than by NumPy

    shape = jax.ShapeDtypeStruct((*size, len(leaves[-1])), jnp.float32)
    return _call_on_host(fill, shape, *leaves)


def _render_cpu_bwd(size, compositing, options, leaves, grad_image):
    """Renders again, since a trace is not a JAX value: this costs a third of the backward pass itself."""

    def differentiate(gradients, grad_image, *leaves):
        trace = cpu.forward(*leaves, size, compositing=compositing, options=options)
        grad_image = np.ascontiguousarray(np.moveaxis(grad_image, -1, 0))
        by_leaf = *cpu.backward(trace, grad_image), cpu.background_gradient(trace, grad_image)
        for out, gradient in zip(gradients, by_leaf, strict=True):
            out[...] = gradient

    shapes = tuple(jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in leaves)
    return _call_on_host(differentiate, shapes, grad_image, *leaves)


_render_cpu.defvjp(
    lambda *settings_and_leaves: (_render_cpu(*settings_and_leaves), settings_and_leaves[3:]), _render_cpu_bwd
)


def _call_on_host(function: Callable, shapes, *arrays: jax.Array):
    """Call NumPy code from compiled code; returns what `function(out, *arrays)` writes into `out`, of `shapes`.

    On the CPU without copies; `jax.pure_callback` would copy arrays out of JAX and back, for a millisecond or more.
    """

    def in_place(_, out, *buffers):
        function(jax.tree.map(np.asarray, out), *map(np.asarray, buffers))

    def copied(*arrays):
        out = jax.tree.map(lambda shape: np.empty(shape.shape, shape.dtype), shapes)
        function(out, *(np.ascontiguousarray(array) for array in arrays))
        return out

    through_copies = functools.partial(jax.pure_callback, copied, shapes, vmap_method="sequential")
    directly = buffer_callback(in_place, shapes, vmap_method="sequential")
    return jax.lax.platform_dependent(*arrays, cpu=directly, default=through_copies)
