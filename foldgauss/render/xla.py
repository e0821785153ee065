"""The XLA engine: tiled compositing in plain JAX, for `jit`, `grad` and `vmap` on CPU, GPU and TPU.

* *Lists* of splats by tile, in rounds: see `tiles`.
* *Compositing.* Tiles are processed in batches, longest lists first, so that the tiles of a batch have lists of similar
  length; a batch traverses its lists in chunks and stops when all pixels are finished. Arrays are (pixel of the tile,
  tile): with tiles along the vectors, sums over pixels are whole-vector operations, too.
* *Backward*, again by batches: forward once more, storing the transmittance at the starts of chunks, then the chunks
  from back to front. With B the color behind per unit of transmittance, times the incoming gradient, dL/dalpha_i =
  T_i (c_i . g - B_i): no division by 1 - alpha, so alpha may be 1. Memory grows with the square root of the longest
  list only. Rounds are processed from back to front, too; only some of their starts are stored, the others recomputed.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from foldgauss._runtime.device import default_platform
from foldgauss.render.footprint import cap_alpha, raw_alpha, squared_distance
from foldgauss.render.splats import RenderOptions
from foldgauss.render.tiles import (
    COLOR,
    MOMENTS,
    OPACITY,
    Canvas,
    Lists,
    P,
    Plan,
    Projected,
    Q,
    R,
    X,
    Y,
    checkpoint_rounds,
    gradients_from_sums,
    indices,
    join_tiles,
    make_canvas,
    make_lists,
    make_plan,
    pack_fields,
    project,
    split_tiles,
)

#: Twice the list entries of 16, but half the pairs of pixel and splat: faster on CPUs.
TILE_SIZE = 8
#: Splats of a chunk: those gathered, and in the backward pass stored, at once.
CHUNK = 16
#: Pixels of a batch of tiles: a plane of 64 KiB stays in a core's cache; a GPU needs more to be fully used.
BATCH_PIXELS = {"cpu": 1 << 14, "other": 1 << 18}


def render_xla(
    leaves: tuple[Array, ...], size: tuple[int, int], *, compositing: str, options: RenderOptions
) -> Float[Array, "height width channels"]:
    """Render (mean, factor, opacity, color, background), all of one floating dtype; see `render`."""
    return _render_jit(_plan(leaves, size, compositing, options), leaves)


def _plan(leaves, size, compositing, options) -> Plan:
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


def _composite_batch(plan: Plan, fields, lists: Lists, canvas: Canvas, k) -> Canvas:
    batch = _select_batch(plan, lists, k, fields.dtype)

    def add(carry, splat):
        transmittance, color = carry
        weight = _effective_alpha(plan, transmittance, _raw_alpha(plan, batch, splat)) * transmittance
        color = tuple(plane + weight * own[None, :] for plane, own in zip(color, splat[COLOR:], strict=True))
        return (transmittance - weight if plan.over else transmittance, color), None

    def walk(carry):
        chunk, transmittance, color = carry
        _, splats = _load(batch, lists, fields, chunk)
        (transmittance, color), _ = jax.lax.scan(add, (transmittance, color), splats, unroll=_unroll())
        return chunk + 1, transmittance, color

    def more(carry):
        return (carry[0] < _num_chunks(batch)) & jnp.any(carry[1] > plan.stop)

    start = jnp.int32(0), canvas.transmittance[:, batch.tiles], tuple(plane[:, batch.tiles] for plane in canvas.color)
    _, transmittance, color = jax.lax.while_loop(more, walk, start)
    color = tuple(plane.at[:, batch.tiles].set(own) for plane, own in zip(canvas.color, color, strict=True))
    return Canvas(canvas.transmittance.at[:, batch.tiles].set(transmittance), color)


def _composite_round(plan: Plan, projected: Projected, mean, fields, begin, canvas: Canvas):
    """Composite the splats that fit into the lists; returns the index of the first that did not, and the canvas."""
    lists, end = make_lists(plan, projected, mean, begin)
    composite = functools.partial(_composite_batch, plan, fields, lists)
    canvas = jax.lax.fori_loop(0, plan.num_batches, lambda k, canvas: composite(canvas, k), canvas)
    return end, canvas


def _forward(plan: Plan, leaves) -> tuple[Int[Array, ""], Canvas]:
    """The number of rounds until no splat or no unfinished pixel was left, and the canvas."""
    mean, factor, opacity, color, _ = leaves
    projected = project(plan, mean, factor, opacity)
    fields = pack_fields(projected, mean, opacity, color)

    def more(carry):
        return (carry[1] < len(mean)) & jnp.any(carry[2].transmittance > plan.stop)

    def composite(carry):
        return carry[0] + 1, *_composite_round(plan, projected, mean, fields, *carry[1:])

    start = jnp.int32(0), jnp.int32(0), make_canvas(plan, color.shape[1], mean.dtype)
    num, _, canvas = jax.lax.while_loop(more, composite, start)
    return num, canvas


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _render(plan: Plan, leaves):
    return _render_fwd(plan, leaves)[0]


def _render_fwd(plan: Plan, leaves):
    num, canvas = _forward(plan, leaves)
    planes = [plane + canvas.transmittance * own for plane, own in zip(canvas.color, leaves[4], strict=True)]
    return join_tiles(plan, jnp.stack(planes)), (leaves, canvas.transmittance, num)


_render_jit = jax.jit(_render, static_argnums=0)


# ---------------------------------------------------------------------------------------------- backward


def _sum_pixels(plane: Float[Array, "*rest pixels batch"]) -> Float[Array, "*rest batch"]:
    """Sum over pixels by halves: whole-vector additions, where XLA's own sum on the CPU is sequential."""
    half = plane.shape[-2] // 2
    if half == 0 or plane.shape[-2] % 2:
        return jnp.sum(plane, axis=-2)
    return _sum_pixels(plane[..., :half, :] + plane[..., half:, :])


class Checkpoints(NamedTuple):
    """Transmittance at the starts of chunks, in two levels: of every segment of chunks, and of each chunk in a segment.

    With as many segments as chunks in one, the square root of the longest possible list is enough.
    """

    segments: Float[Array, "size pixels batch"]
    chunks: Float[Array, "size pixels batch"]


def _num_checkpoints(plan: Plan, num: int) -> int:
    return math.isqrt(min(num, plan.capacity) // CHUNK) + 1


def _store_segments(plan: Plan, fields, lists, batch: Batch, transmittance, stride, segments):
    """Transmittance at every `stride`-th chunk of a batch, and the number of chunks until all pixels are finished."""

    def more(carry):
        return (carry[0] < _num_chunks(batch)) & jnp.any(carry[1] > plan.stop)

    def walk(carry):
        chunk, transmittance, stored = carry
        k = chunk // stride
        stored = stored.at[k].set(jnp.where(chunk % stride == 0, transmittance, stored[k]))
        return chunk + 1, _attenuate(plan, fields, lists, batch, chunk, transmittance), stored

    num, _, segments = jax.lax.while_loop(more, walk, (jnp.int32(0), transmittance, segments))
    return num, segments


def _attenuate(plan: Plan, fields, lists, batch: Batch, chunk, transmittance):
    """The transmittance behind a chunk."""
    if not plan.over:
        return transmittance

    def add(transmittance, splat):
        return transmittance - _effective_alpha(
            plan, transmittance, _raw_alpha(plan, batch, splat)
        ) * transmittance, None

    return jax.lax.scan(add, transmittance, _load(batch, lists, fields, chunk)[1], unroll=_unroll())[0]


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


def _backward_batch(plan: Plan, fields, lists: Lists, transmittance, grad_planes, carry, k):
    """Add the gradient sums of a batch to the splats'."""
    sums, behind, (segments, chunks) = carry
    batch = _select_batch(plan, lists, k, fields.dtype)
    transmittance, grad = transmittance[:, batch.tiles], tuple(plane[:, batch.tiles] for plane in grad_planes)
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
            transmittance = _attenuate(plan, fields, lists, batch, chunk, chunks[chunk - first])
            return chunks.at[chunk + 1 - first].set(transmittance)

        chunks = jax.lax.fori_loop(first, end - 1, fill, chunks.at[0].set(segments[segment]))
        walk = functools.partial(walk_chunk, first, chunks)
        _, sums, behind = jax.lax.while_loop(lambda carry: carry[0] >= first, walk, (end - 1, sums, behind))
        return segment - 1, sums, behind, chunks

    start = -(-num // stride) - 1, sums, behind[:, batch.tiles], chunks
    _, sums, own_behind, chunks = jax.lax.while_loop(lambda carry: carry[0] >= 0, walk_segment, start)
    return sums, behind.at[:, batch.tiles].set(own_behind), Checkpoints(segments, chunks)


def _render_bwd(plan: Plan, residuals, grad_image):
    leaves, final_transmittance, num = residuals
    mean, factor, opacity, color, background = leaves
    projected = project(plan, mean, factor, opacity)
    fields = pack_fields(projected, mean, opacity, color)
    grad_planes = split_tiles(plan, grad_image)
    behind = jnp.sum(grad_planes * background[:, None, None], axis=0)

    def attenuate(begin, transmittance):
        end, canvas = _composite_round(plan, projected, mean, fields[:, :COLOR], begin, Canvas(transmittance, ()))
        return end, canvas.transmittance

    start_of = checkpoint_rounds(plan, make_canvas(plan, 0, mean.dtype).transmittance, num, attenuate)

    def backward_round(carry):
        number, *state = carry
        begin, transmittance = start_of(number)
        lists, _ = make_lists(plan, projected, mean, begin)
        backward = functools.partial(_backward_batch, plan, fields, lists, transmittance, grad_planes)
        state = jax.lax.fori_loop(0, plan.num_batches, lambda k, state: backward(state, k), tuple(state))
        return number - 1, *state

    # Without a row for empty slots: on a GPU, additions to a single row wait for each other.
    sums = jnp.zeros((len(mean), MOMENTS + color.shape[1]), mean.dtype)
    empty = jnp.zeros((_num_checkpoints(plan, len(mean)), plan.tile**2, plan.batch), mean.dtype)
    start = num - 1, sums, behind, Checkpoints(empty, empty)
    _, sums, *_ = jax.lax.while_loop(lambda carry: carry[0] >= 0, backward_round, start)
    d_background = jnp.sum(final_transmittance[None, :, :] * grad_planes, axis=(1, 2))
    return ((*gradients_from_sums(projected, sums, factor, opacity), d_background),)


_render.defvjp(_render_fwd, _render_bwd)
