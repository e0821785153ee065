"""The Pallas engine: a program of a GPU for every tile, forward and backward, for `jit`, `grad` and `vmap`.

* *Lists*, and rounds of them: see `tiles`. The splats' fields are brought into the order of the lists first, so that
  what a program reads next lies next.
* *Blending.* A program holds the pixels of its tile in registers, walks down its list entry by entry, and stops when
  none of them has light left. Longest lists start first.
* *Backward*, from the last entry that a pixel saw up to the first. With B the colour that lies behind, times incoming
  gradient and for unit light, dL/dalpha_i = T_i (c_i . g - B_i), and T_i = T_(i+1) / (1 - alpha_i): the ceiling must be
  below 1. A program writes the sums of an entry to the entry's own place, without atomics; those of a splat are added
  up afterwards.

On a CPU programs are interpreted: right, and far too slow for anything but tests. No figure of a GPU is known yet, so
that engine "auto" does not choose this one.
"""

import functools

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jaxtyping import Array, Float

from foldgauss._runtime.checks import invalid
from foldgauss.render.footprint import capped, raw_alpha, squared_distance
from foldgauss.render.splats import RenderOptions
from foldgauss.render.tiles import (
    COLOR,
    MOMENTS,
    OPACITY,
    Canvas,
    Lists,
    P,
    Plan,
    Q,
    R,
    X,
    Y,
    blank,
    carry_back,
    fields_of,
    keep_rounds,
    make_lists,
    make_plan,
    picture_of,
    planes_of,
    project,
)

try:
    from jax.experimental.pallas.triton import CompilerParams
except ImportError:  # where JAX has another compiler for GPUs, that one's own choice
    CompilerParams = None

#: Sides of tiles, in px; powers of two, as a program's arrays must be. Of 16 a thread of one warp holds 8 pixels: sums
#: over a tile are then mostly sums within threads.
TILES, TILE_SIZE, WARPS = (8, 16, 32), 16, 1
#: Entries between two looks whether any light is left.
CHUNK = 16
#: Of alpha: light is found again by division by what is left of 1.
HIGHEST_CEILING = 0.999


def render_pallas(
    leaves: tuple[Array, ...], size: tuple[int, int], *, compositing: str, options: RenderOptions
) -> Float[Array, "height width channels"]:
    """Picture of (mean, factor, opacity, color, background), all float32; see `render`."""
    num, (height, width) = len(leaves[2]), size
    if num == 0:
        return jnp.broadcast_to(leaves[4][None, None, :], (height, width, len(leaves[4])))
    return _render_jit(_plan(leaves, size, compositing, options), leaves)


def check_options(options: RenderOptions) -> None:
    """Raise ValueError for options that this engine does not know."""
    cure = "Use engine='xla' for others."
    if options.tile_size not in (None, *TILES):
        raise invalid("options.tile_size", expected=f"None or one of {TILES}", got=options.tile_size, cure=cure)
    if options.alpha_ceiling > HIGHEST_CEILING:
        expected = f"at most {HIGHEST_CEILING} for engine 'pallas'"
        raise invalid("options.alpha_ceiling", expected=expected, got=options.alpha_ceiling, cure=cure)


def _plan(leaves, size, compositing, options) -> Plan:
    return make_plan(leaves, size, compositing, options, tile=options.tile_size or TILE_SIZE, batch_pixels=1)


# ---------------------------------------------------------------------------------------------- programs


def _pixels(plan: Plan, tile) -> tuple[Float[Array, " pixels"], Float[Array, " pixels"]]:
    """Coordinates x, y of the pixels' centres of a tile."""
    pixel = jax.lax.iota(jnp.int32, plan.tile**2)
    side, columns = jnp.int32(plan.tile), jnp.int32(plan.grid[1])
    x = jax.lax.rem(tile, columns) * side + jax.lax.rem(pixel, side)
    y = jax.lax.div(tile, columns) * side + jax.lax.div(pixel, side)
    return x.astype(jnp.float32) + 0.5, y.astype(jnp.float32) + 0.5


def _entry(entries, k) -> tuple[Float[Array, ""], ...]:
    return tuple(entries[k, field] for field in range(entries.shape[1]))


def _blend_kernel(plan: Plan, order, start, length, entries, light_in, color_in, light_out, color_out, last_out):
    """Add a tile's entries to its pixels; `last`: of each pixel the entry at which it was finished, or the end."""
    tile = order[pl.program_id(0)]
    x, y = _pixels(plan, tile)
    begin = start[tile]
    end = begin + length[tile]

    def add(k, carry):
        light, color, last = carry
        splat = _entry(entries, k)
        raw = raw_alpha(splat[OPACITY], squared_distance(x - splat[X], y - splat[Y], splat[P : R + 1]), plan.options)
        lit = light > plan.finished
        weight = jnp.where(lit, capped(raw, plan.options), 0.0) * light
        color = tuple(plane + weight * own for plane, own in zip(color, splat[COLOR:], strict=True))
        return light - weight if plan.over else light, color, jnp.where(lit, k + 1, last)

    def walk(carry):
        k, *state = carry
        after = jnp.minimum(k + CHUNK, end)
        return after, *jax.lax.fori_loop(k, after, add, tuple(state))

    def more(carry):
        return (carry[0] < end) & (jnp.max(carry[1]) > plan.finished)

    color = tuple(plane[tile, :] for plane in color_in)
    last = jnp.full(x.shape, begin, jnp.int32)
    _, light, color, last = jax.lax.while_loop(more, walk, (begin, light_in[tile, :], color, last))
    light_out[tile, :] = light
    last_out[tile, :] = last
    for out, plane in zip(color_out, color, strict=True):
        out[tile, :] = plane


def _unblend_kernel(plan: Plan, order, start, entries, light_in, last_in, grad_in, behind_in, _, sums, behind_out):
    """Gradient sums of a tile's entries, back to front; `behind`: the colour behind, before and after."""
    tile = order[pl.program_id(0)]
    x, y = _pixels(plan, tile)
    last = last_in[tile, :]
    top = jnp.max(last)
    grad = tuple(grad_in[channel, tile, :] for channel in range(grad_in.shape[0]))

    def take(count, carry):
        light, behind = carry
        k = top - 1 - count
        splat = _entry(entries, k)
        dx, dy = x - splat[X], y - splat[Y]
        v, w = splat[P] * dx + splat[Q] * dy, splat[R] * dy
        raw = jnp.where(k < last, raw_alpha(splat[OPACITY], v * v + w * w, plan.options), 0.0)
        alpha = capped(raw, plan.options)
        light = light / (1 - alpha) if plan.over else light
        own = sum(color * plane for color, plane in zip(splat[COLOR:], grad, strict=True))
        gain = own - behind if plan.over else own
        slope = jnp.where(raw <= plan.options.alpha_ceiling, light * gain * raw, 0.0)
        by_v, by_w, weight = slope * v, slope * w, alpha * light
        moments = (slope, by_v, by_w, by_v * v, by_v * w, by_w * w, *(weight * plane for plane in grad))
        for column, plane in enumerate(moments):
            sums[k, column] = jnp.sum(plane)
        return light, behind + alpha * gain if plan.over else behind

    state = light_in[tile, :], behind_in[tile, :]
    _, behind = jax.lax.fori_loop(jnp.int32(0), top - start[tile], take, state)
    behind_out[tile, :] = behind


def _call(kernel, plan: Plan, shapes, *arrays, aliases: dict[int, int] | None = None):
    """Run a program for every tile."""
    how = {"grid": (plan.num_tiles,), "out_shape": shapes, "input_output_aliases": aliases or {}}
    kernel = functools.partial(kernel, plan)

    def interpreted(*arrays):
        return pl.pallas_call(kernel, interpret=True, **how)(*arrays)

    def compiled(*arrays):
        params = None if CompilerParams is None else CompilerParams(num_warps=WARPS, num_stages=1)
        return pl.pallas_call(kernel, compiler_params=params, **how)(*arrays)

    return jax.lax.platform_dependent(*arrays, cpu=interpreted, default=compiled)


def _like(array: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


# ----------------------------------------------------------------------------------- forward and backward


def _blend(plan: Plan, lists: Lists, fields, light, color):
    """Light, colours by channel and last entries, (tiles, pixels) each, behind what is listed."""
    shapes = _like(light), tuple(map(_like, color)), jax.ShapeDtypeStruct(light.shape, jnp.int32)
    entries = fields[lists.splat]
    return _call(_blend_kernel, plan, shapes, lists.order[:, 0], lists.start, lists.length, entries, light, color)


def _dark(plan: Plan, channels: int):
    """Light, and colours, before anything is drawn."""
    canvas: Canvas = blank(plan, 0, jnp.float32)
    light = canvas.light.T
    return light, (jnp.zeros_like(light),) * channels


def _forward(plan: Plan, leaves):
    """The number of rounds drawn until no splat or no light was left; light, colours, and last entries of the last."""
    mean, factor, opacity, color, _ = leaves
    projected = project(plan, mean, factor, opacity)
    fields = fields_of(projected, mean, opacity, color)

    def more(carry):
        return (carry[1] < len(mean)) & jnp.any(carry[2] > plan.finished)

    def draw(carry):
        number, begin, light, color, _ = carry
        lists, end = make_lists(plan, projected, mean, begin)
        return number + 1, end, *_blend(plan, lists, fields, light, color)

    light, planes = _dark(plan, color.shape[1])
    start = jnp.int32(0), jnp.int32(0), light, planes, jnp.zeros(light.shape, jnp.int32)
    number, _, *state = jax.lax.while_loop(more, draw, start)
    return number, *state


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _render(plan: Plan, leaves):
    return _render_fwd(plan, leaves)[0]


def _render_fwd(plan: Plan, leaves):
    num, light, color, last = _forward(plan, leaves)
    planes = [plane + light * own for plane, own in zip(color, leaves[4], strict=True)]
    return picture_of(plan, jnp.stack(planes).swapaxes(1, 2)), (leaves, light, last, num)


_render_jit = jax.jit(_render, static_argnums=0)


def _render_bwd(plan: Plan, residuals, grad_image):
    leaves, final_light, final_last, num = residuals
    mean, factor, opacity, color, background = leaves
    projected = project(plan, mean, factor, opacity)
    fields = fields_of(projected, mean, opacity, color)
    grad = planes_of(plan, grad_image).swapaxes(1, 2)
    dark, none = _dark(plan, 0)

    def dim(begin, light):
        lists, end = make_lists(plan, projected, mean, begin)
        light, _, _ = _blend(plan, lists, fields[:, :COLOR], light, none)
        return end, light

    before = keep_rounds(plan, dark, num, dim)

    def undraw(carry):
        number, sums, behind = carry
        begin, light = before(number)
        lists, _ = make_lists(plan, projected, mean, begin)

        def again():
            light_after, _, last = _blend(plan, lists, fields[:, :COLOR], light, none)
            return light_after, last

        light, last = jax.lax.cond(number == num - 1, lambda: (final_light, final_last), again)
        own, behind = _unblend(plan, lists, fields, light, last, grad, behind)
        return number - 1, sums.at[lists.splat].add(own), behind

    sums = jnp.zeros((len(fields), MOMENTS + color.shape[1]), jnp.float32)
    start = num - 1, sums, jnp.sum(grad * background[:, None, None], axis=0)
    _, sums, _ = jax.lax.while_loop(lambda carry: carry[0] >= 0, undraw, start)
    lit = final_light[None] * grad
    return ((*carry_back(projected, sums[:-1], factor, opacity), jnp.sum(lit, axis=(1, 2))),)


def _unblend(plan: Plan, lists: Lists, fields, light, last, grad, behind):
    """Gradient sums of every entry, (capacity, moments and channels), and the colour behind, now before the first."""
    entries = fields[lists.splat]
    sums = jnp.zeros((len(entries), MOMENTS + len(grad)), jnp.float32)
    arrays = (lists.order[:, 0], lists.start, entries, light, last, grad, behind, sums)
    return _call(_unblend_kernel, plan, (_like(sums), _like(behind)), *arrays, aliases={7: 0})


_render.defvjp(_render_fwd, _render_bwd)
