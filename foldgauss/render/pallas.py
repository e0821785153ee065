"""The Pallas engine: one GPU program per tile, forward and backward, for `jit`, `grad` and `vmap`.

* *Lists* of splats by tile, in rounds: see `tiles` and `rounds`. The splats' fields are gathered into the order of the
  lists first, so that a program reads contiguous memory.
* *Compositing.* A program holds the pixels of its tile in registers, traverses its list entry by entry, and stops when
  all of them are finished. Longest lists start first.
* *Backward*, from the last composited entry to the first. With B the color behind per unit of transmittance, times the
  incoming gradient, dL/dalpha_i = T_i (c_i . g - B_i), and T_i = T_(i+1) / (1 - alpha_i): the ceiling must be below 1.
  A program writes the sums of each entry to its own slot, without atomics; they are summed per splat afterwards.

On a CPU programs are interpreted: correct, but too slow for anything but tests. On NVIDIA GPUs this engine is several
times faster than `xla` (docs/gpu.md), so engine "auto" chooses it there.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jaxtyping import Array, Float

from foldgauss._runtime.checks import require
from foldgauss._runtime.device import default_platform
from foldgauss.render.footprint import cap_alpha, raw_alpha, squared_distance
from foldgauss.render.rounds import Engine
from foldgauss.render.splats import RenderOptions
from foldgauss.render.tiles import COLOR, OPACITY, Lists, P, Plan, Q, R, X, Y, make_plan

try:  # deprecated since JAX 0.11; the compiler Mosaic GPU supports no loads of single numbers
    from jax.experimental.pallas.triton import CompilerParams
except ImportError:
    CompilerParams = None

#: Sides of tiles that may be chosen, in px; powers of two, as a program's arrays must be.
TILES = (8, 16, 32)
#: Side of a tile in px. Each thread of a warp then holds 8 pixels, so that sums over a tile are mostly sums within
#: threads.
TILE_SIZE = 16
#: Warps of a program.
WARPS = 1
#: Side of a tile in images of few tiles, where smaller ones are faster.
SMALL_TILE_SIZE = 8
#: Images of fewer tiles than this have small ones.
FEW_TILES = 1024
#: Entries between two tests whether all pixels are finished.
CHUNK = 16
#: The largest alpha ceiling: the backward pass divides by 1 - alpha.
HIGHEST_CEILING = 0.999
#: The smallest transmittance at which a pixel is finished: from one that has underflowed to 0 the backward pass could
#: not go back. Times 1 - HIGHEST_CEILING it is still a normal number of float32.
LOWEST_STOP = 1e-30


def check_options(options: RenderOptions) -> None:
    """Raise ValueError for options that this engine does not support."""
    cure = "engine='xla' supports others."
    require(
        options.tile_size in (None, *TILES),
        "options.tile_size",
        expected=f"None or one of {TILES}",
        got=options.tile_size,
        cure=cure,
    )
    require(
        options.alpha_ceiling <= HIGHEST_CEILING,
        "options.alpha_ceiling",
        expected=f"at most {HIGHEST_CEILING} for engine 'pallas'",
        got=options.alpha_ceiling,
        cure=cure,
    )


def is_preferred(options: RenderOptions) -> bool:
    """Whether engine "auto" should use this one: a GPU that it compiles for is JAX's default device."""
    supported = options.tile_size in (None, *TILES) and options.alpha_ceiling <= HIGHEST_CEILING
    return supported and default_platform() == "gpu" and CompilerParams is not None


def choose_tile_size(size: tuple[int, int], capacity: int | None = None) -> int:
    """The side of the tiles of an image of `size` (height, width), unless `RenderOptions.tile_size` gives it.

    `capacity`: `RenderOptions.list_capacity`, at least the number of tiles.
    """
    large, small = (math.prod(-(-side // tile) for side in size) for tile in (TILE_SIZE, SMALL_TILE_SIZE))
    return SMALL_TILE_SIZE if large < FEW_TILES and small <= (capacity or small) else TILE_SIZE


def choose_plan(leaves, size, compositing, options) -> Plan:
    """The tiling of an image of (mean, factor, opacity, color, background); see `render`."""
    options = dataclasses.replace(options, transmittance_stop=max(options.transmittance_stop, LOWEST_STOP))
    tile = options.tile_size or choose_tile_size(size, options.list_capacity)
    return make_plan(leaves, size, compositing, options, tile=tile, batch_pixels=1)


# ---------------------------------------------------------------------------------------------- programs


def _pixels(plan: Plan, tile) -> tuple[Float[Array, " pixels"], Float[Array, " pixels"]]:
    """Coordinates x, y of the pixel centers of a tile."""
    pixel = jax.lax.iota(jnp.int32, plan.tile**2)
    side, columns = jnp.int32(plan.tile), jnp.int32(plan.grid[1])
    x = jax.lax.rem(tile, columns) * side + jax.lax.rem(pixel, side)
    y = jax.lax.div(tile, columns) * side + jax.lax.div(pixel, side)
    return x.astype(jnp.float32) + 0.5, y.astype(jnp.float32) + 0.5


def _entry(entries, k) -> tuple[Float[Array, ""], ...]:
    return tuple(entries[k, field] for field in range(entries.shape[1]))


def _forward_kernel(
    plan: Plan, order, start, length, entries, transmittance_in, color_in, transmittance_out, color_out, last_out
):
    """Composite a tile's entries; `last`: of each pixel the entry at which it was finished, or the end of the list."""
    tile = order[pl.program_id(0)]
    x, y = _pixels(plan, tile)
    begin = start[tile]
    end = begin + length[tile]

    def add(k, carry):
        transmittance, color, last = carry
        splat = _entry(entries, k)
        raw = raw_alpha(splat[OPACITY], squared_distance(x - splat[X], y - splat[Y], splat[P : R + 1]), plan.options)
        unfinished = transmittance > plan.stop
        weight = jnp.where(unfinished, cap_alpha(raw, plan.options), 0.0) * transmittance
        color = tuple(plane + weight * own for plane, own in zip(color, splat[COLOR:], strict=True))
        return transmittance - weight if plan.over else transmittance, color, jnp.where(unfinished, k + 1, last)

    def walk(carry):
        k, *state = carry
        after = jnp.minimum(k + CHUNK, end)
        return after, *jax.lax.fori_loop(k, after, add, tuple(state))

    def more(carry):
        return (carry[0] < end) & (jnp.max(carry[1]) > plan.stop)

    color = tuple(plane[tile, :] for plane in color_in)
    last = jnp.full(x.shape, begin, jnp.int32)
    _, transmittance, color, last = jax.lax.while_loop(more, walk, (begin, transmittance_in[tile, :], color, last))
    transmittance_out[tile, :] = transmittance
    last_out[tile, :] = last
    for out, plane in zip(color_out, color, strict=True):
        out[tile, :] = plane


def _backward_kernel(
    plan: Plan, order, start, entries, transmittance_in, last_in, grad_in, behind_in, _, sums, behind_out
):
    """Gradient sums of a tile's entries, back to front; `behind`: the color behind its list, then behind nothing."""
    tile = order[pl.program_id(0)]
    x, y = _pixels(plan, tile)
    last = last_in[tile, :]
    top = jnp.max(last)
    grad = tuple(grad_in[channel, tile, :] for channel in range(grad_in.shape[0]))

    def step(count, carry):
        transmittance, behind = carry
        k = top - 1 - count
        splat = _entry(entries, k)
        dx, dy = x - splat[X], y - splat[Y]
        v, w = splat[P] * dx + splat[Q] * dy, splat[R] * dy
        raw = jnp.where(k < last, raw_alpha(splat[OPACITY], v * v + w * w, plan.options), 0.0)
        alpha = cap_alpha(raw, plan.options)
        transmittance = transmittance / (1 - alpha) if plan.over else transmittance
        own = sum(color * plane for color, plane in zip(splat[COLOR:], grad, strict=True))
        gain = own - behind if plan.over else own
        slope = jnp.where(raw <= plan.options.alpha_ceiling, transmittance * gain * raw, 0.0)
        by_v, by_w, weight = slope * v, slope * w, alpha * transmittance
        moments = (slope, by_v, by_w, by_v * v, by_v * w, by_w * w, *(weight * plane for plane in grad))
        for column, plane in enumerate(moments):
            sums[k, column] = jnp.sum(plane)
        return transmittance, behind + alpha * gain if plan.over else behind

    state = transmittance_in[tile, :], behind_in[tile, :]
    _, behind = jax.lax.fori_loop(jnp.int32(0), top - start[tile], step, state)
    behind_out[tile, :] = behind


def _call(kernel, plan: Plan, shapes, *arrays, aliases: dict[int, int] | None = None):
    """Run a program for every tile: interpreted on a CPU, compiled elsewhere."""
    call = functools.partial(
        pl.pallas_call,
        functools.partial(kernel, plan),
        grid=(plan.num_tiles,),
        out_shape=shapes,
        input_output_aliases=aliases or {},
    )
    params = None if CompilerParams is None else CompilerParams(num_warps=WARPS, num_stages=1)
    return jax.lax.platform_dependent(*arrays, cpu=call(interpret=True), default=call(compiler_params=params))


def _like(array: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


# ------------------------------------------------------------------------------------------------ rounds


def _composite(plan: Plan, lists: Lists, fields, transmittance, planes):
    """See `rounds.Engine`; the backward pass needs the transmittance behind a round and its last entries."""
    shapes = _like(transmittance), tuple(map(_like, planes)), jax.ShapeDtypeStruct(transmittance.shape, jnp.int32)
    arrays = (lists.order[:, 0], lists.start, lists.length, fields[lists.splat], transmittance, planes)
    transmittance, planes, last = _call(_forward_kernel, plan, shapes, *arrays)
    return transmittance, planes, (transmittance, last)


def _pull_back(plan: Plan, lists: Lists, fields, needed, grad_planes, behind, sums):
    """See `rounds.Engine`."""
    own = jnp.zeros((len(lists.splat), sums.shape[1]), jnp.float32)
    arrays = (lists.order[:, 0], lists.start, fields[lists.splat], *needed, grad_planes, behind, own)
    own, behind = _call(_backward_kernel, plan, (_like(own), _like(behind)), *arrays, aliases={7: 0})
    return sums.at[lists.splat].add(own, mode="drop"), behind


ENGINE = Engine(_composite, lambda *before: _composite(*before, ())[2], _pull_back)
