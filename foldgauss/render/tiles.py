"""Tiling for the JAX engines `xla` and `pallas`: bins splats into square tiles, and converts tiles to images and back.

Every splat is listed in the tiles that its cutoff ellipse reaches: prefix sums assign a slot to each (splat, tile) of a
bounding box, an exact test drops those that the ellipse misses, and one sort by tile * num + splat groups the slots by
tile, front to back. The number of slots is static, as XLA requires, but no splat is dropped: those beyond it are
rendered in further *rounds*: see `rounds`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from foldgauss._runtime.checks import require
from foldgauss.render.footprint import compute_whitener, covariance, squared_reach
from foldgauss.render.splats import LARGEST_CAPACITY, RenderOptions

#: Slots per splat where the splats' sizes are unknown (inside `jit`).
SLOTS_PER_SPLAT = 16
#: Slots per tile there, if there are few splats.
SLOTS_PER_TILE = 16
#: The most slots of one round.
MAX_SLOTS = 1 << 22
#: Ellipses are enlarged a little for binning, so that the alpha test alone decides about a pixel.
SLACK = 1e-3
#: Sums of slots saturate here, above any capacity.
_SATURATED = LARGEST_CAPACITY + 1
# Rows of a splat's fields, followed by its colors.
X = 0
Y = 1
P = 2
Q = 3
R = 4
OPACITY = 5
COLOR = 6
# Rows of a splat's gradient sums, followed by its colors': of dL/dalpha * alpha times 1, v, w, v^2, v w, w^2, where
# v = p dx + q dy and w = r dy.
MOMENTS = 6


class Plan(NamedTuple):
    """The tiling, its static capacity, and the compositing rule; static under jit."""

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
    def stop(self) -> float:
        """The transmittance up to which a pixel is finished; with compositing "sum" none is."""
        return self.options.transmittance_stop if self.over else -1.0


def make_plan(leaves, size, compositing, options, *, tile: int, batch_pixels: int) -> Plan:
    """Choose the capacity and batches: by counting slots of concrete splats, from the number of splats if traced.

    `tile`: side of a tile in px; `batch_pixels`: the approximate number of pixels in a batch of tiles.
    """
    num_tiles = -(-size[0] // tile) * -(-size[1] // tile)
    num_batches = -(-num_tiles * tile * tile // max(batch_pixels, tile * tile))
    batch = -(-num_tiles // num_batches)
    plan = Plan(size, compositing == "over", options, tile, 1, batch)
    capacity = options.list_capacity
    require(
        capacity is None or capacity >= num_tiles,
        "options.list_capacity",
        expected=f"at least the number of tiles, {num_tiles}",
        got=capacity,
        cure="None chooses it.",
    )
    if capacity is None:
        geometry = jax.lax.stop_gradient(leaves[:3])  # concrete even under an eager `grad`
        traced = any(isinstance(leaf, jax.core.Tracer) for leaf in geometry)
        num = len(leaves[2])
        # A few wide splats need slots for every tile, but small splats leave most of them empty.
        guess = min(num * num_tiles, max(SLOTS_PER_SPLAT * num, SLOTS_PER_TILE * num_tiles))
        slots = guess if traced else int(_count_slots(plan, *geometry))
        # A power of two, so that a moving scene does not recompile for each frame.
        capacity = max(_power_of_two(min(slots, MAX_SLOTS)), _power_of_two(num_tiles))
    return plan._replace(capacity=capacity)


def _power_of_two(number: int) -> int:
    return 1 << max(number - 1, 0).bit_length()


# ------------------------------------------------------------------------------------------------ splats


class Projected(NamedTuple):
    """The ellipse of every splat and its bounding box of tiles."""

    whitener: Float[Array, "3 num"]
    reach: Float[Array, " num"]  # squared Mahalanobis distance, with slack; not positive: not visible
    radius_x: Float[Array, " num"]
    first: Int[Array, "2 num"]  # (row, column) of tiles of the bounding box
    shape: Int[Array, "2 num"]  # its rows and columns; 0 where it is not visible

    @property
    def slots(self) -> Int[Array, " num"]:
        return self.shape[0] * self.shape[1]


def project(plan: Plan, mean, factor, opacity) -> Projected:
    options = plan.options
    whitener, valid = jax.vmap(lambda one: compute_whitener(one, options.low_pass), out_axes=(-1, 0))(factor)
    xx, _, yy, _ = jax.vmap(lambda one: covariance(one, options.low_pass))(factor)
    reach = squared_reach(opacity, options)
    seen = valid & (reach >= 0) & jnp.all(jnp.isfinite(mean), axis=1)
    reach = jnp.where(seen, reach * (1 + SLACK) + SLACK, jnp.zeros_like(reach))
    radius_x, radius_y = jnp.sqrt(reach * jnp.where(seen, xx, 1)), jnp.sqrt(reach * jnp.where(seen, yy, 1))
    center, radius = mean.T[::-1], jnp.stack([radius_y, radius_x])
    length = np.asarray(plan.size, mean.dtype)[:, None]
    first, last = _tiles_between(center - radius, center + radius, length, plan.tile)
    return Projected(whitener, reach, radius_x, first, jnp.where(seen[None], last - first, 0))


def find_visible(mean, factor, opacity, size: tuple[int, int], options: RenderOptions) -> Bool[Array, " num"]:
    """Which splats may reach an image: those whose cutoff ellipse has a bounding box that contains pixel centers."""
    plan = Plan(size, True, options, max(size), 1, 1)
    return project(plan, mean, factor, opacity).slots > 0


def _tiles_between(low, high, length, tile: int):
    """Tiles first <= k < last whose pixel centers lie within [low, high]; clipped before the cast to an integer.

    Rows and columns: `low` and `high` (2, num), `length` (2, 1) in pixels.
    """
    first = jnp.clip(jnp.ceil(low - 0.5), 0, length)
    last = jnp.clip(jnp.floor(high - 0.5), -1, length - 1)
    first_tile, last_tile = first.astype(jnp.int32) // tile, last.astype(jnp.int32) // tile
    return first_tile, jnp.where(last >= first, last_tile + 1, first_tile)


@functools.partial(jax.jit, static_argnums=0)
def _count_slots(plan: Plan, mean, factor, opacity) -> Int[Array, ""]:
    return _running_sum(project(plan, mean, factor, opacity).slots)[-1]


def indices(count: int) -> Int[Array, " count"]:
    """0, 1, ...: 32 bits also where JAX's default is 64."""
    return jnp.arange(count, dtype=jnp.int32)


def _running_sum(counts: Int[Array, " num"]) -> Int[Array, " num"]:
    """Inclusive prefix sum that saturates: the pairs of a million large splats would overflow, as a float sum shows.

    (`associative_scan` of a sum that saturates would be a hundred GPU programs.)
    """
    overflows = jnp.cumsum(counts.astype(jnp.float32)) > 1.5 * _SATURATED
    return jnp.where(overflows, _SATURATED, jnp.minimum(jnp.cumsum(counts), _SATURATED))


def pack_fields(projected: Projected, mean, opacity, color) -> Float[Array, "num+1 fields"]:
    """A row of parameters for every splat, and one of zeros, which is invisible, for empty slots."""
    table = jnp.concatenate([mean, projected.whitener.T, opacity[:, None], color], axis=1)
    return jnp.concatenate([table, jnp.zeros((1, table.shape[1]), table.dtype)])


# ------------------------------------------------------------------------------------------------- lists


class Lists(NamedTuple):
    """Splats of tile k, front to back: `splat[start[k] : start[k] + length[k]]`; tiles are padded to whole batches.

    Empty slots, at the end, have the index of the invisible row of `pack_fields`.
    """

    splat: Int[Array, " capacity"]
    start: Int[Array, " tiles"]
    length: Int[Array, " tiles"]
    order: Int[Array, "batches batch"]  # tiles, longest lists first


def make_lists(plan: Plan, projected: Projected, mean, begin) -> tuple[Lists, Int[Array, ""]]:
    """Lists of the splats from index `begin` on, as many as fit, and the index of the first that does not."""
    num = len(mean)
    slots = jnp.where(indices(num) >= begin, projected.slots, 0)
    total = _running_sum(slots)
    end = jnp.sum(total <= plan.capacity, dtype=jnp.int32)
    slots = jnp.where(indices(num) < end, slots, 0)
    first = total - slots  # meaningless for splats from `end` on, which have no slots
    number = indices(plan.capacity)
    # A mark at each splat's first slot; splats without slots share a position, which belongs to the last of them.
    marks = jnp.zeros(plan.capacity, jnp.int32).at[jnp.where(indices(num) < end, first, plan.capacity)]
    owner = jnp.cumsum(marks.add(1, mode="drop")) - 1
    used = number < jnp.max(jnp.where(indices(num) < end, total, 0))
    owner = jnp.where(used, owner, 0)
    local, across = number - first[owner], jnp.maximum(projected.shape[1][owner], 1)
    down = local // across
    rows, columns = projected.first[0][owner] + down, projected.first[1][owner] + local - down * across
    used &= _reaches_tile(plan, projected, mean, owner, rows, columns)
    tile = jnp.where(used, rows * plan.grid[1] + columns, plan.num_tiles)
    tile, splat = _sort_by_tile(tile, owner, plan.num_tiles, num)
    splat = jnp.where(tile < plan.num_tiles, splat, num)
    padded = plan.num_batches * plan.batch
    # Unrolled it is one GPU program; as a loop, several for each step of the search.
    bounds = jnp.searchsorted(tile, indices(padded + 1), side="left", method="scan_unrolled").astype(jnp.int32)
    bounds = jnp.where(indices(padded + 1) <= plan.num_tiles, bounds, bounds[plan.num_tiles])
    length = bounds[1:] - bounds[:-1]
    order = jnp.argsort(-length).astype(jnp.int32).reshape(plan.num_batches, plan.batch)
    return Lists(splat, bounds[:-1], length, order), end


def _reaches_tile(plan: Plan, projected: Projected, mean, owner, rows, columns) -> Bool[Array, " slots"]:
    """Whether the splat's ellipse contains pixel centers of a tile: within the tile's rows it is widest at its turning
    point, or at the row nearest to it.
    """
    p, q, r = projected.whitener[:, owner]
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
    """Sort by tile, then splat. As one key if it fits into 32 bits: on the CPU five times faster than pairs."""
    if (num_tiles + 1) * num >= 2**32:
        return jax.lax.sort((tile, splat), num_keys=2, is_stable=False)
    key = jnp.sort(tile.astype(jnp.uint32) * np.uint32(num) + splat.astype(jnp.uint32))
    tile = key // np.uint32(num)
    return tile.astype(jnp.int32), (key - tile * np.uint32(num)).astype(jnp.int32)


# ------------------------------------------------------------------------------------------------ planes


def initial_transmittance(plan: Plan, dtype) -> Float[Array, "tiles pixels"]:
    """Tiles are padded to whole batches. Pixels outside the image have transmittance 0: they count as finished."""
    tile, pixel = indices(plan.num_batches * plan.batch)[:, None], indices(plan.tile**2)[None, :]
    y = tile // plan.grid[1] * plan.tile + pixel // plan.tile
    x = tile % plan.grid[1] * plan.tile + pixel % plan.tile
    return ((y < plan.size[0]) & (x < plan.size[1])).astype(dtype)


def join_tiles(plan: Plan, planes: Float[Array, "channels tiles pixels"]) -> Float[Array, "height width channels"]:
    (rows, columns), tile = plan.grid, plan.tile
    planes = planes[:, : plan.num_tiles].reshape(len(planes), rows, columns, tile, tile)
    image = planes.transpose(1, 3, 2, 4, 0).reshape(rows * tile, columns * tile, len(planes))
    return image[: plan.size[0], : plan.size[1]]


def split_tiles(plan: Plan, image: Float[Array, "height width channels"]) -> Float[Array, "channels tiles pixels"]:
    """The inverse of `join_tiles`, padded with zeros."""
    (rows, columns), tile, channels = plan.grid, plan.tile, image.shape[-1]
    image = jnp.pad(image, ((0, rows * tile - image.shape[0]), (0, columns * tile - image.shape[1]), (0, 0)))
    planes = image.reshape(rows, tile, columns, tile, channels).transpose(4, 0, 2, 1, 3)
    planes = planes.reshape(channels, plan.num_tiles, tile * tile)
    return jnp.pad(planes, ((0, 0), (0, plan.num_batches * plan.batch - plan.num_tiles), (0, 0)))


def gradients_from_sums(projected: Projected, sums, factor, opacity):
    """Convert a splat's gradient sums to gradients of its mean, factor, opacity and color.

    With W = [[p, q], [0, r]]: Sigma^-1 = W^T W, dL/dmean = W^T (v, w), dL/dF = W^T M W F, M the second moments of
    (v, w). In whitened coordinates the moments of thin splats do not cancel.
    """
    p, q, r = projected.whitener
    total, v, w, vv, vw, ww = (sums[:, k] for k in range(MOMENTS))
    mean = jnp.stack([p * v, q * v + r * w], axis=-1)
    seen = projected.reach > 0
    white_x = p[:, None] * factor[:, 0] + q[:, None] * factor[:, 1]
    white_y = r[:, None] * factor[:, 1]
    by_v = vv[:, None] * white_x + vw[:, None] * white_y
    by_w = vw[:, None] * white_x + ww[:, None] * white_y
    d_factor = jnp.stack([p[:, None] * by_v, q[:, None] * by_v + r[:, None] * by_w], axis=1)
    d_factor = jnp.where(seen[:, None, None], d_factor, jnp.zeros_like(d_factor))
    d_opacity = jnp.where(seen, total / jnp.where(seen, opacity, jnp.ones_like(opacity)), jnp.zeros_like(total))
    return mean, d_factor, d_opacity, sums[:, MOMENTS:]
