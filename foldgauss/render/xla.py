"""The XLA engine: tiles in plain JAX, for `jit`, `grad` and `vmap` on CPU, GPU and TPU alike.

How a picture is made, and why so:

* *Lists.* Every splat is listed in the tiles that its cutoff ellipse reaches: prefix sums give each (splat, tile) of a
  bounding box a slot, an exact test drops what the ellipse misses, and one sort by tile * num + splat brings
  the slots of a tile together, front to back. The room for slots is static, as XLA wants it, yet nothing is ever cut:
  splats that do not fit at once are drawn in *rounds*, from front to back, while the light left travels along.
* *Blending.* Tiles are taken in batches, longest lists first, so that the tiles of a batch have about as much to
  do; a batch walks down its lists in chunks and stops when no light is left. Arrays are (pixel of the tile, tile): with
  tiles along the vectors, sums over pixels too are whole-vector operations.
* *Backward*, batch by batch again: forward once more, keeping light at the starts of chunks, then the chunks from
  back to front. With B the colour that lies behind, times incoming gradient and for unit light, dL/dalpha_i =
  T_i (c_i . g - B_i): no division by 1 - alpha, so alpha may be 1. What is kept grows with the square root of the
  longest list only. Of several rounds, taken from back to front too, some starts are kept, and the others drawn anew.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from foldgauss._checks import invalid
from foldgauss.render.footprint import capped, covariance, raw_alpha, squared_distance, squared_reach, whitening
from foldgauss.render.splats import LARGEST_CAPACITY, RenderOptions

#: Measured on two AVX-512 cores, 20k splats on 160x320: 8 lists twice the entries of 16 for half the pairs of pixel and
#: splat, 1.3 times faster forward, 1.8 with the backward pass.
TILE_SIZE = 8
#: Splats of a chunk: what is gathered, and in the backward pass kept, at once.
CHUNK = 16
#: Pixels of a batch of tiles: a plane of 64 KiB stays in a core's cache; a GPU needs more to be busy.
BATCH_PIXELS = {"cpu": 1 << 14, "other": 1 << 18}
#: Slots per splat where the splats' sizes are not known (inside `jit`), and the most slots of one round.
SLOTS_PER_SPLAT, MOST_SLOTS = 16, 1 << 22
#: Rounds whose start the backward pass keeps, a plane of light each; of more, every n-th.
KEPT_ROUNDS = 8
#: Ellipses are listed a little too large, so that the alpha test alone decides about a pixel.
SLACK = 1e-3
#: Sums of slots stop here, above any capacity.
_MANY = LARGEST_CAPACITY + 1
# Rows of a splat's fields, colours after them.
_X, _Y, _P, _Q, _R, _OPACITY, _COLOR = range(7)
# Rows of a splat's gradient sums, colours after them: of dL/dalpha * alpha against 1, v, w, v^2, v w, w^2, where
# v = p dx + q dy and w = r dy.
_MOMENTS = 6


class Plan(NamedTuple):
    """How the work is cut; static."""

    size: tuple[int, int]
    over: bool
    options: RenderOptions
    tile: int
    capacity: int
    batch: int  # tiles

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-self.size[0] // self.tile), -(-self.size[1] // self.tile)

    @property
    def num_tiles(self) -> int:
        return self.grid[0] * self.grid[1]

    @property
    def num_batches(self) -> int:
        return -(-self.num_tiles // self.batch)

    @property
    def finished(self) -> float:
        """Light up to which a pixel is finished; with compositing "sum" it never is."""
        return self.options.transmittance_stop if self.over else -1.0


def render_xla(
    leaves: tuple[Array, ...], size: tuple[int, int], *, compositing: str, options: RenderOptions
) -> Float[Array, "height width channels"]:
    """Picture of (mean, factor, opacity, color, background), all of one floating dtype; see `render`."""
    num, (height, width) = len(leaves[2]), size
    if num == 0:
        return jnp.broadcast_to(leaves[4][None, None, :], (height, width, len(leaves[4])))
    plan = _plan(leaves, size, compositing, options)
    return _render_jit(plan, leaves)


def _plan(leaves, size, compositing, options) -> Plan:
    """Cut the work: counted where the splats are at hand, from their number where they are traced."""
    tile = options.tile_size or TILE_SIZE
    num_tiles = -(-size[0] // tile) * -(-size[1] // tile)
    pixels = BATCH_PIXELS["cpu" if jax.default_backend() == "cpu" else "other"]
    num_batches = -(-num_tiles * tile * tile // pixels)
    batch = -(-num_tiles // num_batches)
    plan = Plan(size, compositing == "over", options, tile, 1, batch)
    capacity = options.list_capacity
    if capacity is not None and capacity < num_tiles:
        raise invalid(
            "options.list_capacity",
            expected=f"at least the number of tiles, {num_tiles}",
            got=capacity,
            cure="Or None, to have it chosen.",
        )
    if capacity is None:
        geometry = jax.lax.stop_gradient(leaves[:3])  # concrete even under an eager `grad`
        traced = any(isinstance(leaf, jax.core.Tracer) for leaf in geometry)
        num = len(leaves[2])
        # Of a few wide splats a chunk for every tile: fewer would make rounds of little work, more would be sorted in
        # vain where splats are small (a million slots double the time of 20k splats on 160x320).
        guess = min(num * num_tiles, max(SLOTS_PER_SPLAT * num, CHUNK * num_tiles))
        slots = guess if traced else int(_count_slots(plan, *geometry))
        # A power of two, so that a scene that moves does not compile anew for each frame.
        capacity = max(_power_of_two(min(slots, MOST_SLOTS)), _power_of_two(num_tiles))
    return plan._replace(capacity=capacity)


def _power_of_two(number: int) -> int:
    return 1 << max(number - 1, 0).bit_length()


# ------------------------------------------------------------------------------------------------ splats


class Projected(NamedTuple):
    """What the tiles need to know of every splat."""

    white: Float[Array, "3 num"]
    reach: Float[Array, "num"]  # squared Mahalanobis distance, with slack; not positive: not seen
    radius_x: Float[Array, "num"]
    first: Int[Array, "2 num"]  # (row, column) of tiles of the bounding box
    shape: Int[Array, "2 num"]  # its rows and columns; 0 where it is not seen

    @property
    def slots(self) -> Int[Array, "num"]:
        return self.shape[0] * self.shape[1]


def _project(plan: Plan, mean, factor, opacity) -> Projected:
    options = plan.options
    white, drawn = jax.vmap(lambda one: whitening(one, options.low_pass), out_axes=(-1, 0))(factor)
    xx, _, yy, _ = jax.vmap(lambda one: covariance(one, options.low_pass))(factor)
    reach = squared_reach(opacity, options)
    seen = drawn & (reach >= 0) & jnp.all(jnp.isfinite(mean), axis=1)
    reach = jnp.where(seen, reach * (1 + SLACK) + SLACK, jnp.zeros_like(reach))
    radius_x, radius_y = jnp.sqrt(reach * jnp.where(seen, xx, 1)), jnp.sqrt(reach * jnp.where(seen, yy, 1))
    firsts, shapes = [], []
    for axis, radius, length in ((1, radius_y, plan.size[0]), (0, radius_x, plan.size[1])):
        first, last = _tiles_between(mean[:, axis] - radius, mean[:, axis] + radius, length, plan.tile)
        firsts.append(first)
        shapes.append(jnp.where(seen, last - first, 0))
    return Projected(white, reach, radius_x, jnp.stack(firsts), jnp.stack(shapes))


def _tiles_between(low, high, length: int, tile: int):
    """Tiles first <= k < last whose pixel centres lie within [low, high]; clipped before the cast to an integer."""
    first = jnp.clip(jnp.ceil(low - 0.5), 0, length)
    last = jnp.clip(jnp.floor(high - 0.5), -1, length - 1)
    first_tile, last_tile = first.astype(jnp.int32) // tile, last.astype(jnp.int32) // tile
    return first_tile, jnp.where(last >= first, last_tile + 1, first_tile)


@functools.partial(jax.jit, static_argnums=0)
def _count_slots(plan: Plan, mean, factor, opacity) -> Int[Array, ""]:
    return _running_sum(_project(plan, mean, factor, opacity).slots)[-1]


def _numbers(count: int) -> Int[Array, "count"]:
    """0, 1, ...: 32 bits also where JAX's default is 64."""
    return jnp.arange(count, dtype=jnp.int32)


def _running_sum(counts: Int[Array, "num"]) -> Int[Array, "num"]:
    """Inclusive prefix sum that stays at `_MANY`: the pairs of a million large splats would overflow."""
    return jax.lax.associative_scan(lambda a, b: jnp.minimum(a + b, _MANY), jnp.minimum(counts, _MANY))


def _fields(projected: Projected, mean, opacity, color) -> Float[Array, "num+1 fields"]:
    """A row for every splat, and one of zeros, which is never seen, for the empty slots."""
    table = jnp.concatenate([mean, projected.white.T, opacity[:, None], color], axis=1)
    return jnp.concatenate([table, jnp.zeros((1, table.shape[1]), table.dtype)])


# ------------------------------------------------------------------------------------------------- lists


class Lists(NamedTuple):
    """Splats of every tile, front to back, at `splat[start[k] : start[k] + length[k]]`; tiles fill whole batches."""

    splat: Int[Array, "capacity"]
    start: Int[Array, "tiles"]
    length: Int[Array, "tiles"]
    order: Int[Array, "batches batch"]  # tiles, longest lists first


def _make_lists(plan: Plan, projected: Projected, mean, begin) -> tuple[Lists, Int[Array, ""]]:
    """Lists of the splats from number `begin` on, as many as have room, and the number of the first that has not."""
    num = len(mean)
    slots = jnp.where(_numbers(num) >= begin, projected.slots, 0)
    total = _running_sum(slots)
    end = jnp.sum(total <= plan.capacity, dtype=jnp.int32)
    slots = jnp.where(_numbers(num) < end, slots, 0)
    first = total - slots  # of no meaning for splats from `end` on, which have no slots
    number = _numbers(plan.capacity)
    # A mark at each splat's first slot; splats without slots share a place, of whom the last counts.
    marks = jnp.zeros(plan.capacity, jnp.int32).at[jnp.where(_numbers(num) < end, first, plan.capacity)]
    owner = jnp.cumsum(marks.add(1, mode="drop")) - 1
    used = number < jnp.max(jnp.where(_numbers(num) < end, total, 0))
    owner = jnp.where(used, owner, 0)
    rows, columns = _place(projected, owner, number - first[owner])
    used &= _meets(plan, projected, mean, owner, rows, columns)
    tile = jnp.where(used, rows * plan.grid[1] + columns, plan.num_tiles)
    tile, splat = _sort_by_tile(tile, owner, plan.num_tiles, num)
    padded = plan.num_batches * plan.batch
    bounds = jnp.searchsorted(tile, _numbers(padded + 1), side="left").astype(jnp.int32)
    bounds = jnp.where(_numbers(padded + 1) <= plan.num_tiles, bounds, bounds[plan.num_tiles])
    length = bounds[1:] - bounds[:-1]
    order = jnp.argsort(-length).astype(jnp.int32).reshape(plan.num_batches, plan.batch)
    return Lists(splat, bounds[:-1], length, order), end


def _place(projected: Projected, owner, local):
    """Row and column of tiles of slot number `local` of its splat."""
    columns = jnp.maximum(projected.shape[1][owner], 1)
    down = local // columns
    return projected.first[0][owner] + down, projected.first[1][owner] + local - down * columns


def _meets(plan: Plan, projected: Projected, mean, owner, rows, columns) -> Bool[Array, "slots"]:
    """Whether the splat's ellipse meets the pixel centres of a tile: within the tile's rows it is widest at its own
    turning point, or at the nearest of the rows.
    """
    p, q, r = projected.white[:, owner]
    x, y, reach = mean[owner, 0], mean[owner, 1], projected.reach[owner]
    top = (rows * plan.tile).astype(mean.dtype) + 0.5
    bottom = jnp.minimum(top + (plan.tile - 1), plan.size[0] - 0.5)
    left = (columns * plan.tile).astype(mean.dtype) + 0.5
    turn = -p * q * projected.radius_x[owner] / (q * q + r * r)

    def edge(q, dy):
        return (jnp.sqrt(jnp.maximum(reach - (r * dy) ** 2, 0)) - q * dy) / p

    right_end = x + edge(q, jnp.clip(turn, top - y, bottom - y))
    left_end = x - edge(-q, jnp.clip(-turn, top - y, bottom - y))
    return (right_end >= left) & (left_end <= left + (plan.tile - 1))


def _sort_by_tile(tile, splat, num_tiles: int, num: int):
    """Sort by tile, then splat. As one number if it fits into 32 bits: on the CPU five times faster than pairs."""
    if (num_tiles + 1) * num >= 2**32:
        return jax.lax.sort((tile, splat), num_keys=2, is_stable=False)
    key = jnp.sort(tile.astype(jnp.uint32) * np.uint32(num) + splat.astype(jnp.uint32))
    tile = key // np.uint32(num)
    return tile.astype(jnp.int32), (key - tile * np.uint32(num)).astype(jnp.int32)


# ---------------------------------------------------------------------------------------------- blending


class Canvas(NamedTuple):
    """Pixels by tile, filled up to whole batches."""

    light: Float[Array, "pixels tiles"]
    color: tuple[Float[Array, "pixels tiles"], ...]  # a plane per channel


def _blank(plan: Plan, channels: int, dtype) -> Canvas:
    """Where a tile reaches beyond the picture there is no light from the start: nothing waits for it to be taken."""
    pixel, tile = _numbers(plan.tile**2)[:, None], _numbers(plan.num_batches * plan.batch)[None, :]
    y = tile // plan.grid[1] * plan.tile + pixel // plan.tile
    x = tile % plan.grid[1] * plan.tile + pixel % plan.tile
    light = ((y < plan.size[0]) & (x < plan.size[1])).astype(dtype)
    return Canvas(light, tuple(jnp.zeros_like(light) for _ in range(channels)))


def _picture(plan: Plan, planes: Float[Array, "channels pixels tiles"]) -> Float[Array, "height width channels"]:
    (rows, columns), tile = plan.grid, plan.tile
    planes = planes[..., : plan.num_tiles].reshape(len(planes), tile, tile, rows, columns)
    image = planes.transpose(3, 1, 4, 2, 0).reshape(rows * tile, columns * tile, len(planes))
    return image[: plan.size[0], : plan.size[1]]


def _planes(plan: Plan, image: Float[Array, "height width channels"]) -> Float[Array, "channels pixels tiles"]:
    """The reverse of `_picture`; zeros where there is no pixel."""
    (rows, columns), tile, channels = plan.grid, plan.tile, image.shape[-1]
    image = jnp.pad(image, ((0, rows * tile - image.shape[0]), (0, columns * tile - image.shape[1]), (0, 0)))
    planes = image.reshape(rows, tile, columns, tile, channels).transpose(4, 1, 3, 0, 2)
    planes = planes.reshape(channels, tile * tile, plan.num_tiles)
    return jnp.pad(planes, ((0, 0), (0, 0), (0, plan.num_batches * plan.batch - plan.num_tiles)))


class Batch(NamedTuple):
    """Some tiles and their lists."""

    tiles: Int[Array, "batch"]
    start: Int[Array, "batch"]
    length: Int[Array, "batch"]
    left: Float[Array, "batch"]  # x of the first pixels' centres
    top: Float[Array, "batch"]


def _batch(plan: Plan, lists: Lists, k, dtype) -> Batch:
    tiles = lists.order[k]
    left, top = tiles % plan.grid[1] * plan.tile, tiles // plan.grid[1] * plan.tile
    return Batch(tiles, lists.start[tiles], lists.length[tiles], left.astype(dtype) + 0.5, top.astype(dtype) + 0.5)


def _load(batch: Batch, lists: Lists, fields, chunk) -> tuple[Array, tuple[Array, ...]]:
    """Splats number chunk * CHUNK to (chunk + 1) * CHUNK of each list: their numbers (CHUNK, batch), and their fields.

    Fields are arrays of their own: XLA on the CPU makes scalar code of a loop that takes rows out of a common one.
    """
    position = chunk * CHUNK + _numbers(CHUNK)[:, None]
    slot = jnp.minimum(batch.start[None, :] + position, len(lists.splat) - 1)
    splat = jnp.where(position < batch.length[None, :], lists.splat[slot], len(fields) - 1)
    return splat, tuple(jnp.moveaxis(fields[splat], -1, 0))


def _offsets(plan: Plan, batch: Batch, splat):
    """Offsets (dx, dy) of all pixels from a splat per tile, (pixels, batch)."""
    pixel, dtype = _numbers(plan.tile**2)[:, None], splat[_X].dtype
    x = (pixel % plan.tile).astype(dtype) + batch.left[None, :]
    y = (pixel // plan.tile).astype(dtype) + batch.top[None, :]
    return x - splat[_X][None, :], y - splat[_Y][None, :]


def _white(splat):
    return tuple(splat[k][None, :] for k in (_P, _Q, _R))


def _alpha(plan: Plan, batch: Batch, splat):
    distance = squared_distance(*_offsets(plan, batch, splat), _white(splat))
    return raw_alpha(splat[_OPACITY][None, :], distance, plan.options)


def _seen(plan: Plan, light, raw):
    """Alpha that counts: capped, and 0 where the pixel is finished."""
    alpha = capped(raw, plan.options)
    return jnp.where(light > plan.finished, alpha, jnp.zeros_like(alpha)) if plan.over else alpha


def _num_chunks(batch: Batch) -> Int[Array, ""]:
    return -(-jnp.max(batch.length) // CHUNK)


def _unroll() -> int:
    """XLA makes one kernel of an unrolled chunk on a GPU, and poor ones on a CPU."""
    return 1 if jax.default_backend() == "cpu" else CHUNK


def _blend_batch(plan: Plan, fields, lists: Lists, canvas: Canvas, k) -> Canvas:
    batch = _batch(plan, lists, k, fields.dtype)

    def add(carry, splat):
        light, color = carry
        weight = _seen(plan, light, _alpha(plan, batch, splat)) * light
        color = tuple(plane + weight * own[None, :] for plane, own in zip(color, splat[_COLOR:], strict=True))
        return (light - weight if plan.over else light, color), None

    def walk(carry):
        chunk, light, color = carry
        _, splats = _load(batch, lists, fields, chunk)
        (light, color), _ = jax.lax.scan(add, (light, color), splats, unroll=_unroll())
        return chunk + 1, light, color

    def more(carry):
        return (carry[0] < _num_chunks(batch)) & jnp.any(carry[1] > plan.finished)

    start = jnp.int32(0), canvas.light[:, batch.tiles], tuple(plane[:, batch.tiles] for plane in canvas.color)
    _, light, color = jax.lax.while_loop(more, walk, start)
    color = tuple(plane.at[:, batch.tiles].set(own) for plane, own in zip(canvas.color, color, strict=True))
    return Canvas(canvas.light.at[:, batch.tiles].set(light), color)


def _draw_round(plan: Plan, projected: Projected, mean, fields, begin, canvas: Canvas):
    """Draw what fits into the lists; returns the number of the first splat that did not, and the canvas."""
    lists, end = _make_lists(plan, projected, mean, begin)
    blend = functools.partial(_blend_batch, plan, fields, lists)
    canvas = jax.lax.fori_loop(0, plan.num_batches, lambda k, canvas: blend(canvas, k), canvas)
    return end, canvas


def _forward(plan: Plan, leaves) -> tuple[Int[Array, ""], Canvas]:
    """The number of rounds drawn, until no splat or no light was left, and the canvas."""
    mean, factor, opacity, color, _ = leaves
    projected = _project(plan, mean, factor, opacity)
    fields = _fields(projected, mean, opacity, color)

    def more(carry):
        return (carry[1] < len(mean)) & jnp.any(carry[2].light > plan.finished)

    def draw(carry):
        return carry[0] + 1, *_draw_round(plan, projected, mean, fields, *carry[1:])

    start = jnp.int32(0), jnp.int32(0), _blank(plan, color.shape[1], mean.dtype)
    num, _, canvas = jax.lax.while_loop(more, draw, start)
    return num, canvas


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _render(plan: Plan, leaves):
    return _render_fwd(plan, leaves)[0]


def _render_fwd(plan: Plan, leaves):
    num, canvas = _forward(plan, leaves)
    planes = [plane + canvas.light * own for plane, own in zip(canvas.color, leaves[4], strict=True)]
    return _picture(plan, jnp.stack(planes)), (leaves, canvas.light, num)


_render_jit = jax.jit(_render, static_argnums=0)


# ---------------------------------------------------------------------------------------------- backward


def _sum_pixels(plane: Float[Array, "*rest pixels batch"]) -> Float[Array, "*rest batch"]:
    """Sum over pixels by halves: whole-vector additions, where XLA's own sum on the CPU goes one by one."""
    half = plane.shape[-2] // 2
    if half == 0 or plane.shape[-2] % 2:
        return jnp.sum(plane, axis=-2)
    return _sum_pixels(plane[..., :half, :] + plane[..., half:, :])


class Kept(NamedTuple):
    """Light at the starts of chunks, in two steps: of every stretch of chunks, and of every chunk in one stretch.

    With as many stretches as chunks in one, room for the square root of the longest list there can be is enough.
    """

    stretches: Float[Array, "room pixels batch"]
    chunks: Float[Array, "room pixels batch"]


def _room(plan: Plan, num: int) -> int:
    return math.isqrt(min(num, plan.capacity) // CHUNK) + 1


def _keep_lights(plan: Plan, fields, lists, batch: Batch, light, stride, stretches):
    """Light at every `stride`-th chunk of a batch, and the number of chunks until no light is left."""

    def more(carry):
        return (carry[0] < _num_chunks(batch)) & jnp.any(carry[1] > plan.finished)

    def walk(carry):
        chunk, light, kept = carry
        k = chunk // stride
        kept = kept.at[k].set(jnp.where(chunk % stride == 0, light, kept[k]))
        return chunk + 1, _dim(plan, fields, lists, batch, chunk, light), kept

    num, _, stretches = jax.lax.while_loop(more, walk, (jnp.int32(0), light, stretches))
    return num, stretches


def _dim(plan: Plan, fields, lists, batch: Batch, chunk, light):
    """The light behind a chunk."""
    if not plan.over:
        return light

    def add(light, splat):
        return light - _seen(plan, light, _alpha(plan, batch, splat)) * light, None

    return jax.lax.scan(add, light, _load(batch, lists, fields, chunk)[1], unroll=_unroll())[0]


def _unblend_chunk(plan: Plan, batch: Batch, splats, grad_planes, light, behind):
    """Gradient sums (CHUNK, moments and channels, batch) of a chunk, and the colour behind, now in front of it."""

    def shade(light, splat):
        raw = _alpha(plan, batch, splat)
        alpha = _seen(plan, light, raw)
        return (light - alpha * light if plan.over else light), (raw, light)

    _, (raws, lights) = jax.lax.scan(shade, light, splats, unroll=_unroll())

    def step(behind, each):
        splat, raw, light = each
        own = sum(color[None, :] * plane for color, plane in zip(splat[_COLOR:], grad_planes, strict=True))
        gain = own - behind if plan.over else own
        return (behind + _seen(plan, light, raw) * gain if plan.over else behind), gain

    behind, gains = jax.lax.scan(step, behind, (splats, raws, lights), reverse=True, unroll=_unroll())
    free = (raws <= plan.options.alpha_ceiling) & (lights > plan.finished)
    slopes = jnp.where(free, lights * gains * raws, jnp.zeros_like(raws))
    weights = _seen(plan, lights, raws) * lights
    sums = jax.vmap(functools.partial(_gradient_sums, plan, batch, grad_planes))(splats, slopes, weights)
    return sums, behind


def _gradient_sums(plan: Plan, batch: Batch, grad_planes, splat, slope, weight) -> Float[Array, "batch sums"]:
    """Of one splat per tile: slopes against 1, v, w, v^2, v w, w^2, and weights against the incoming gradient.

    The slopes are summed row by row first, along which w is constant.
    """
    square = (plan.tile, plan.tile, plan.batch)
    dx, dy = _offsets(plan, batch, splat)
    p, q, r = _white(splat)
    v, w = p * dx + q * dy, (r * dy).reshape(square)[:, 0]
    by_1, by_v, by_vv = (_sum_pixels(plane.reshape(square)) for plane in (slope, slope * v, slope * v * v))
    rows = (by_1, by_v, by_1 * w, by_vv, by_v * w, by_1 * w * w)
    planes = (weight * plane for plane in grad_planes)
    return jnp.stack([_sum_pixels(plane) for plane in (*rows, *planes)], axis=-1)


def _unblend_batch(plan: Plan, fields, lists: Lists, light, grad_planes, carry, k):
    """Add the gradient sums of a batch to the splats'."""
    sums, behind, (stretches, chunks) = carry
    batch = _batch(plan, lists, k, fields.dtype)
    light, grad = light[:, batch.tiles], tuple(plane[:, batch.tiles] for plane in grad_planes)
    stride = jnp.maximum(-(-_num_chunks(batch) // len(stretches)), 1)
    num, stretches = _keep_lights(plan, fields, lists, batch, light, stride, stretches)

    def walk_chunk(first, chunks, carry):
        chunk, sums, behind = carry
        splat, splats = _load(batch, lists, fields, chunk)
        own, behind = _unblend_chunk(plan, batch, splats, grad, chunks[chunk - first], behind)
        return chunk - 1, sums.at[splat].add(own), behind

    def walk_stretch(carry):
        stretch, sums, behind, chunks = carry
        first, end = stretch * stride, jnp.minimum((stretch + 1) * stride, num)

        def fill(chunk, chunks):
            light = _dim(plan, fields, lists, batch, chunk, chunks[chunk - first])
            return chunks.at[chunk + 1 - first].set(light)

        chunks = jax.lax.fori_loop(first, end - 1, fill, chunks.at[0].set(stretches[stretch]))
        walk = functools.partial(walk_chunk, first, chunks)
        _, sums, behind = jax.lax.while_loop(lambda carry: carry[0] >= first, walk, (end - 1, sums, behind))
        return stretch - 1, sums, behind, chunks

    start = -(-num // stride) - 1, sums, behind[:, batch.tiles], chunks
    _, sums, own_behind, chunks = jax.lax.while_loop(lambda carry: carry[0] >= 0, walk_stretch, start)
    return sums, behind.at[:, batch.tiles].set(own_behind), Kept(stretches, chunks)


def _render_bwd(plan: Plan, residuals, grad_image):
    leaves, final_light, num = residuals
    mean, factor, opacity, color, background = leaves
    projected = _project(plan, mean, factor, opacity)
    fields = _fields(projected, mean, opacity, color)
    grad_planes = _planes(plan, grad_image)
    behind = jnp.sum(grad_planes * background[:, None, None], axis=0)
    before = _keep_rounds(plan, projected, mean, fields[:, :_COLOR], num)

    def undraw(carry):
        number, *state = carry
        begin, light = before(number)
        lists, _ = _make_lists(plan, projected, mean, begin)
        unblend = functools.partial(_unblend_batch, plan, fields, lists, light, grad_planes)
        state = jax.lax.fori_loop(0, plan.num_batches, lambda k, state: unblend(state, k), tuple(state))
        return number - 1, *state

    sums = jnp.zeros((len(fields), _MOMENTS + color.shape[1]), mean.dtype)
    room = jnp.zeros((_room(plan, len(mean)), plan.tile**2, plan.batch), mean.dtype)
    start = num - 1, sums, behind, Kept(room, room)
    _, sums, *_ = jax.lax.while_loop(lambda carry: carry[0] >= 0, undraw, start)
    lit = final_light[None, :, :] * grad_planes
    return ((*_gather(projected, sums[:-1], factor, opacity), jnp.sum(lit, axis=(1, 2))),)


def _keep_rounds(plan: Plan, projected: Projected, mean, bare, num):
    """Draw `num` rounds once more but for colours, keeping starts; returns the function that gives, for the number of
    a round, its first splat and the light there, by drawing on from the start kept before it.
    """
    stride = jnp.maximum(-(-num // KEPT_ROUNDS), 1)
    last = (num - 1) // stride

    def advance(count, begin, light):
        def draw(_, state):
            begin, canvas = _draw_round(plan, projected, mean, bare, state[0], Canvas(state[1], ()))
            return begin, canvas.light

        return jax.lax.fori_loop(0, count, draw, (begin, light))

    def keep(k, carry):
        begins, lights, begin, light = carry
        begins, lights = begins.at[k].set(begin), lights.at[k].set(light)
        return begins, lights, *advance(jnp.where(k < last, stride, 0), begin, light)

    light = _blank(plan, 0, mean.dtype).light
    room = jnp.zeros(KEPT_ROUNDS, jnp.int32), jnp.zeros((KEPT_ROUNDS, *light.shape), light.dtype)
    begins, lights, *_ = jax.lax.fori_loop(0, last + 1, keep, (*room, jnp.int32(0), light))
    return lambda number: advance(number % stride, begins[number // stride], lights[number // stride])


def _gather(projected: Projected, sums, factor, opacity):
    """Carry a splat's sums back to its mean, factor, opacity and colour.

    With W = [[p, q], [0, r]]: Sigma^-1 = W^T W, dL/dmean = W^T (v, w), dL/dF = W^T M W F, M the second moments of
    (v, w). In whitened coordinates the moments of thin splats do not cancel.
    """
    p, q, r = projected.white
    total, v, w, vv, vw, ww = (sums[:, k] for k in range(_MOMENTS))
    mean = jnp.stack([p * v, q * v + r * w], axis=-1)
    seen = projected.reach > 0
    white_x = p[:, None] * factor[:, 0] + q[:, None] * factor[:, 1]
    white_y = r[:, None] * factor[:, 1]
    by_v = vv[:, None] * white_x + vw[:, None] * white_y
    by_w = vw[:, None] * white_x + ww[:, None] * white_y
    d_factor = jnp.stack([p[:, None] * by_v, q[:, None] * by_v + r[:, None] * by_w], axis=1)
    d_factor = jnp.where(seen[:, None, None], d_factor, jnp.zeros_like(d_factor))
    d_opacity = jnp.where(seen, total / jnp.where(seen, opacity, jnp.ones_like(opacity)), jnp.zeros_like(total))
    return mean, d_factor, d_opacity, sums[:, _MOMENTS:]


_render.defvjp(_render_fwd, _render_bwd)
