"""The XLA engine: tiled compositing in plain JAX, for `jit`, `grad` and `vmap` on CPU, GPU and TPU.

* *Lists* of splats by tile, in rounds: see `tiles` and `rounds`.
* *Compositing.* Tiles are processed in batches, longest lists first, so that the tiles of a batch have lists of similar
  length; a batch traverses its lists in chunks and stops when all pixels are finished. Arrays are (pixel of the tile,
  tile): with tiles along the vectors, sums over pixels are whole-vector operations, too.
* *Backward*, again by batches: forward once more, storing the transmittance at the starts of chunks, then the chunks
  from back to front. With B the color behind per unit of transmittance, times the incoming gradient, dL/dalpha_i =
  T_i (c_i . g - B_i): no division by 1 - alpha, so alpha may be 1. Memory grows with the square root of the longest
  list only.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from foldgauss._runtime.device import default_platform
from foldgauss.render.footprint import cap_alpha, raw_alpha, squared_distance
from foldgauss.render.rounds import Engine
from foldgauss.render.tiles import COLOR, OPACITY, Lists, P, Plan, Q, R, X, Y, indices, make_plan

#: Twice the list entries of 16, but half the pairs of pixel and splat: faster on CPUs.
TILE_SIZE = 8
#: Splats of a chunk: those gathered, and in the backward pass stored, at once.
CHUNK = 16
#: Pixels of a batch of tiles: a plane of 64 KiB stays in a core's cache; a GPU needs more to be fully used.
BATCH_PIXELS = {"cpu": 1 << 14, "other": 1 << 18}


def choose_plan(leaves, size, compositing, options) -> Plan:
    """The tiling of an image of (mean, factor, opacity, color, background); see `render`."""
    pixels = BATCH_PIXELS["cpu" if default_platform() == "cpu" else "other"]
    return make_plan(leaves, size, compositing, options, tile=options.tile_size or TILE_SIZE, batch_pixels=pixels)


# ------------------------------------------------------------------------------------------- compositing


class Batch(NamedTuple):
    """Some tiles and their lists."""

    tiles: Int[Array, " batch"]
    start: Int[Array, " batch"]
    length: Int[Array, " batch"]
    left: Float[Array, " batch"]  # x of the first pixels' centers
    top: Float[Array, " batch"]


def _select_batch(plan: Plan, lists: Lists, k, dtype) -> Batch:
    tiles = lists.order[k]
    left, top = tiles % plan.grid[1] * plan.tile, tiles // plan.grid[1] * plan.tile
    return Batch(tiles, lists.start[tiles], lists.length[tiles], left.astype(dtype) + 0.5, top.astype(dtype) + 0.5)


def _load(batch: Batch, lists: Lists, fields, chunk) -> tuple[Array, tuple[Array, ...]]:
    """Entries chunk * CHUNK to (chunk + 1) * CHUNK of each list: splat indices (CHUNK, batch) and their fields.

    Fields are separate arrays: XLA on the CPU generates scalar code for a loop that takes rows out of a common one.
    """
    position = chunk * CHUNK + indices(CHUNK)[:, None]
    slot = jnp.minimum(batch.start[None, :] + position, len(lists.splat) - 1)
    splat = jnp.where(position < batch.length[None, :], lists.splat[slot], len(fields) - 1)
    return splat, tuple(jnp.moveaxis(fields[splat], -1, 0))


def _offsets(plan: Plan, batch: Batch, splat):
    """Offsets (dx, dy) of all pixels from a splat per tile, (pixels, batch)."""
    pixel, dtype = indices(plan.tile**2)[:, None], splat[X].dtype
    x = (pixel % plan.tile).astype(dtype) + batch.left[None, :]
    y = (pixel // plan.tile).astype(dtype) + batch.top[None, :]
    return x - splat[X][None, :], y - splat[Y][None, :]


def _whitener(splat):
    return tuple(splat[k][None, :] for k in (P, Q, R))


def _raw_alpha(plan: Plan, batch: Batch, splat):
    distance = squared_distance(*_offsets(plan, batch, splat), _whitener(splat))
    return raw_alpha(splat[OPACITY][None, :], distance, plan.options)


def _effective_alpha(plan: Plan, transmittance, raw):
    """Alpha, cap_alpha, and 0 where the pixel is finished."""
    alpha = cap_alpha(raw, plan.options)
    return jnp.where(transmittance > plan.stop, alpha, jnp.zeros_like(alpha)) if plan.over else alpha


def _num_chunks(batch: Batch) -> Int[Array, ""]:
    return -(-jnp.max(batch.length) // CHUNK)


def _unroll() -> int:
    """XLA compiles an unrolled chunk to one kernel on a GPU, and to slow ones on a CPU."""
    return 1 if default_platform() == "cpu" else CHUNK


def _composite(plan: Plan, lists: Lists, fields, transmittance, planes):
    """See `rounds.Engine`; the backward pass needs the transmittance before a round."""
    composite = functools.partial(_composite_batch, plan, fields, lists)
    after, planes = jax.lax.fori_loop(0, plan.num_batches, composite, (transmittance, planes))
    return after, planes, transmittance


def _composite_batch(plan: Plan, fields, lists: Lists, k, canvas):
    batch = _select_batch(plan, lists, k, fields.dtype)

    def walk(carry):
        chunk, *own = carry
        return chunk + 1, *_composite_chunk(plan, fields, lists, batch, chunk, *own)

    def more(carry):
        return (carry[0] < _num_chunks(batch)) & jnp.any(carry[1] > plan.stop)

    own = jax.tree.map(lambda plane: plane[batch.tiles].T, canvas)
    _, *own = jax.lax.while_loop(more, walk, (jnp.int32(0), *own))
    return jax.tree.map(lambda plane, own: plane.at[batch.tiles].set(own.T), canvas, tuple(own))


def _composite_chunk(plan: Plan, fields, lists: Lists, batch: Batch, chunk, transmittance, color=()):
    """The transmittance behind a chunk, and the planes of `color` with it."""
    if not plan.over and not color:
        return transmittance, color

    def add(carry, splat):
        transmittance, color = carry
        weight = _effective_alpha(plan, transmittance, _raw_alpha(plan, batch, splat)) * transmittance
        color = tuple(plane + weight * own[None, :] for plane, own in zip(color, splat[COLOR:], strict=False))
        return (transmittance - weight if plan.over else transmittance, color), None

    _, splats = _load(batch, lists, fields, chunk)
    return jax.lax.scan(add, (transmittance, color), splats, unroll=_unroll())[0]


# ---------------------------------------------------------------------------------------------- backward


def _sum_pixels(plane: Float[Array, "*rest pixels batch"]) -> Float[Array, "*rest batch"]:
    """Sum over pixels by halves: whole-vector additions, where XLA's own sum on the CPU is sequential."""
    half = plane.shape[-2] // 2
    if half == 0 or plane.shape[-2] % 2:
        return jnp.sum(plane, axis=-2)
    return _sum_pixels(plane[..., :half, :] + plane[..., half:, :])


def _store_segments(plan: Plan, fields, lists, batch: Batch, transmittance, stride, segments):
    """Transmittance at every `stride`-th chunk of a batch, and the number of chunks until all pixels are finished."""

    def more(carry):
        return (carry[0] < _num_chunks(batch)) & jnp.any(carry[1] > plan.stop)

    def walk(carry):
        chunk, transmittance, stored = carry
        k = chunk // stride
        stored = stored.at[k].set(jnp.where(chunk % stride == 0, transmittance, stored[k]))
        return chunk + 1, _composite_chunk(plan, fields, lists, batch, chunk, transmittance)[0], stored

    num, _, segments = jax.lax.while_loop(more, walk, (jnp.int32(0), transmittance, segments))
    return num, segments


def _backward_chunk(plan: Plan, batch: Batch, splats, grad_planes, transmittance, behind):
    """Gradient sums (CHUNK, moments and channels, batch) of a chunk, and `behind` with the chunk composited over it."""

    def forward(transmittance, splat):
        raw = _raw_alpha(plan, batch, splat)
        alpha = _effective_alpha(plan, transmittance, raw)
        return (transmittance - alpha * transmittance if plan.over else transmittance), (raw, transmittance)

    _, (raws, transmittances) = jax.lax.scan(forward, transmittance, splats, unroll=_unroll())

    def step(behind, each):
        splat, raw, transmittance = each
        own = sum(color[None, :] * plane for color, plane in zip(splat[COLOR:], grad_planes, strict=True))
        gain = own - behind if plan.over else own
        return (behind + _effective_alpha(plan, transmittance, raw) * gain if plan.over else behind), gain

    behind, gains = jax.lax.scan(step, behind, (splats, raws, transmittances), reverse=True, unroll=_unroll())
    free = (raws <= plan.options.alpha_ceiling) & (transmittances > plan.stop)
    slopes = jnp.where(free, transmittances * gains * raws, jnp.zeros_like(raws))
    weights = _effective_alpha(plan, transmittances, raws) * transmittances
    sums = jax.vmap(functools.partial(_gradient_sums, plan, batch, grad_planes))(splats, slopes, weights)
    return sums, behind


def _gradient_sums(plan: Plan, batch: Batch, grad_planes, splat, slope, weight) -> Float[Array, "batch sums"]:
    """Of one splat per tile: slopes times 1, v, w, v^2, v w, w^2, and weights times the incoming gradient.

    Slopes are summed over rows of pixels first, along which w is constant.
    """
    square = (plan.tile, plan.tile, plan.batch)
    dx, dy = _offsets(plan, batch, splat)
    p, q, r = _whitener(splat)
    v, w = p * dx + q * dy, (r * dy).reshape(square)[:, 0]
    by_1, by_v, by_vv = (_sum_pixels(plane.reshape(square)) for plane in (slope, slope * v, slope * v * v))
    rows = (by_1, by_v, by_1 * w, by_vv, by_v * w, by_1 * w * w)
    planes = (weight * plane for plane in grad_planes)
    return jnp.stack([_sum_pixels(plane) for plane in (*rows, *planes)], axis=-1)


def _pull_back(plan: Plan, lists: Lists, fields, transmittance, grad_planes, behind, sums):
    """See `rounds.Engine`."""
    # Transmittances at the starts of chunks are stored in two levels: of segments of chunks, and of the chunks of one
    # segment. With as many segments as chunks in one, the square root of the longest possible list is enough.
    num = math.isqrt(min(len(sums), plan.capacity) // CHUNK) + 1
    empty = jnp.zeros((num, plan.tile**2, plan.batch), sums.dtype)
    backward = functools.partial(_backward_batch, plan, fields, lists, transmittance, grad_planes)
    sums, behind, *_ = jax.lax.fori_loop(0, plan.num_batches, backward, (sums, behind, empty, empty))
    return sums, behind


def _backward_batch(plan: Plan, fields, lists: Lists, transmittance, grad_planes, k, carry):
    """Add the gradient sums of a batch to the splats'."""
    sums, behind, segments, chunks = carry
    batch = _select_batch(plan, lists, k, fields.dtype)
    transmittance, grad = transmittance[batch.tiles].T, [plane[batch.tiles].T for plane in grad_planes]
    stride = jnp.maximum(-(-_num_chunks(batch) // len(segments)), 1)
    num, segments = _store_segments(plan, fields, lists, batch, transmittance, stride, segments)

    def walk_chunk(first, chunks, carry):
        chunk, sums, behind = carry
        splat, splats = _load(batch, lists, fields, chunk)
        own, behind = _backward_chunk(plan, batch, splats, grad, chunks[chunk - first], behind)
        return chunk - 1, sums.at[splat].add(own, mode="drop"), behind

    def walk_segment(carry):
        segment, sums, behind, chunks = carry
        first, end = segment * stride, jnp.minimum((segment + 1) * stride, num)

        def fill(chunk, chunks):
            transmittance, _ = _composite_chunk(plan, fields, lists, batch, chunk, chunks[chunk - first])
            return chunks.at[chunk + 1 - first].set(transmittance)

        chunks = jax.lax.fori_loop(first, end - 1, fill, chunks.at[0].set(segments[segment]))
        walk = functools.partial(walk_chunk, first, chunks)
        _, sums, behind = jax.lax.while_loop(lambda carry: carry[0] >= first, walk, (end - 1, sums, behind))
        return segment - 1, sums, behind, chunks

    start = -(-num // stride) - 1, sums, behind[batch.tiles].T, chunks
    _, sums, own_behind, chunks = jax.lax.while_loop(lambda carry: carry[0] >= 0, walk_segment, start)
    return sums, behind.at[batch.tiles].set(own_behind.T), segments, chunks


ENGINE = Engine(_composite, lambda plan, lists, fields, transmittance: transmittance, _pull_back)
