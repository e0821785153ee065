"""`render`: the one door to every engine, differentiable, usable inside jit and vmap."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._checks import invalid, one_of
from foldgauss.render import cpu
from foldgauss.render.reference import render_reference
from foldgauss.render.splats import RenderOptions, Splats2D, check_size
from foldgauss.render.xla import render_xla

ENGINES = ("auto", "cpu", "xla", "reference")
COMPOSITINGS = ("over", "sum")


def render(
    splats: Splats2D,
    size: tuple[int, int],
    *,
    background: Float[Array, "channels"] | None = None,
    compositing: str = "over",
    engine: str = "auto",
    options: RenderOptions | None = None,
) -> Float[Array, "height width channels"]:
    r"""Picture of two-dimensional splats.

    .. math:: C = \sum_i c_i \alpha_i T_i + T_{end}\, c_{bg}, \qquad T_i = \prod_{j<i} (1 - \alpha_j)

    - `splats`: in pixels (x right, y down, centres at +0.5), front to back in array order.
    - `size`: (height, width) in pixels.
    - `background`: one colour, (channels,); None is black.
    - `compositing`: "over", as 3DGS and VeGaS; or "sum", the accumulated blend of GaussianImage, where all
      T_i are 1 and the background is added whole.
    - `engine`: "cpu" (Numba, float32 inside); "xla" (tiles in plain JAX, on CPU, GPU and TPU, float32 or float64);
      "reference" (dense, slow); or "auto": "cpu" where JAX's default device is a CPU and the options are those that
      "cpu" takes, else "xla".
    - `options`: what may be left out, `RenderOptions`.

    Returns (height, width, channels) in the dtype of `splats.mean`. Differentiable in every leaf of `splats` and in
    `background`. A splat with a number that is not finite among its parameters is not drawn and gets no gradient.
    Raises ValueError for an unknown option, a size below 1, shapes that do not fit or colours without a channel.

    Example: `render(Splats2D(mean, factor, opacity, color), (160, 320))`.

    Source: Kerbl et al. 2023, 3D Gaussian Splatting, eq. 3; VeGaS, section 4.
    """
    one_of("engine", engine, ENGINES)
    one_of("compositing", compositing, COMPOSITINGS)
    check_size(size)
    if not isinstance(splats, Splats2D):
        cure = "For Gaussians3D use foldgauss.render.project first."
        raise invalid("splats", expected="Splats2D", got=type(splats).__name__, cure=cure)
    if not isinstance(options, RenderOptions | None):
        cure = "A preset is RenderOptions.fast(), with parentheses."
        raise invalid("options", expected="RenderOptions or None", got=repr(options), cure=cure)
    if splats.mean.ndim != 2:
        raise invalid(
            "splats", expected="mean of shape (num, 2)", got=splats.mean.shape, cure="Use jax.vmap for a batch."
        )
    if not jnp.issubdtype(splats.mean.dtype, jnp.floating):
        raise invalid("splats.mean", expected="a floating dtype", got=splats.mean.dtype)
    options = RenderOptions() if options is None else options
    channels, dtype = splats.color.shape[-1], splats.mean.dtype
    background = jnp.zeros(channels, dtype) if background is None else jnp.asarray(background, dtype)
    if channels == 0:
        raise invalid("splats.color", expected="at least one channel", got=f"shape {splats.color.shape}")
    if background.shape != (channels,):
        raise invalid("background", expected=f"shape ({channels},)", got=background.shape)
    if engine == "auto":
        engine = "cpu" if jax.default_backend() == "cpu" and _cpu_takes(options) else "xla"
    if engine == "cpu":
        cpu.check_options(options)
    height, width = map(int, size)
    leaves = (*_finite_splats(splats), background)
    if engine == "reference":
        return render_reference(
            Splats2D(*leaves[:4]), (height, width), background, compositing=compositing, options=options
        )
    # Below single precision a sum of hundreds of splats has no digits left; float64 stays what it is, but in "cpu".
    inner = jnp.float32 if engine == "cpu" or dtype.itemsize < 4 else dtype
    leaves = tuple(leaf.astype(inner) for leaf in leaves)
    if engine == "xla":
        image = render_xla(leaves, (height, width), compositing=compositing, options=options)
    else:
        image = _render_cpu((height, width), compositing, options, *leaves)
    return image.astype(dtype)


def _cpu_takes(options: RenderOptions) -> bool:
    try:
        cpu.check_options(options)
    except ValueError:
        return False
    return True


@jax.jit
def _finite_splats(splats: Splats2D) -> tuple[jax.Array, ...]:
    """The leaves, with zeros in place of splats that hold NaN or an infinity: without opacity they are not drawn."""
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

    def draw(*leaves):
        trace = cpu.forward(*_as_numpy(leaves), size, compositing=compositing, options=options)
        return np.moveaxis(trace.image, 0, -1)

    shape = jax.ShapeDtypeStruct((*size, len(leaves[-1])), jnp.float32)
    return jax.pure_callback(draw, shape, *leaves, vmap_method="sequential")


def _render_cpu_fwd(size, compositing, options, *leaves):
    return _render_cpu(size, compositing, options, *leaves), leaves


def _render_cpu_bwd(size, compositing, options, leaves, grad_image):
    """Renders again, since a trace cannot travel through JAX: a third of the backward pass's own cost."""

    def differentiate(grad_image, *leaves):
        trace = cpu.forward(*_as_numpy(leaves), size, compositing=compositing, options=options)
        return cpu.backward(trace, np.ascontiguousarray(np.moveaxis(np.asarray(grad_image), -1, 0)))

    shapes = tuple(jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in leaves)
    return jax.pure_callback(differentiate, shapes, grad_image, *leaves, vmap_method="sequential")


def _as_numpy(leaves):
    return tuple(np.ascontiguousarray(leaf, np.float32) for leaf in leaves)


_render_cpu.defvjp(_render_cpu_fwd, _render_cpu_bwd)
