"""A tile renderer in plain XLA, what JAX alone makes of the same work: a yardstick for `render/cpu.py`.

The lists are made on the host and padded to the longest; XLA does not pay for making them. The plain form lists a
splat in every tile that its bounding box touches; the stronger one takes the exact lists of the CPU engine's trace.
A `lax.scan` over list position blends one splat per tile, all
tiles of a band at once, 256 pixels each; a band is the whole picture (the textbook form) or one row of tiles
after another, whose state stays in the cache. The constants are `RenderOptions`'.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss.render import RenderOptions
from foldgauss.render.cpu import TILE, Trace


class TileLists(NamedTuple):
    """Splats listed per tile, front to back: `listed` (bands, longest, tiles per band), padded with -1."""

    listed: np.ndarray
    left: np.ndarray  # (bands, tiles per band): the tile's first column of pixels
    top: np.ndarray


def tile_lists(trace: Trace, *, by_row: bool) -> TileLists:
    """The trace's lists as rectangles: one band per row of tiles, or a single band."""
    row_start, entries, _, _ = trace.buckets
    lists = []
    for row, (tile_start, listed, _) in enumerate(trace.lists):
        for tile in range(len(tile_start) - 1):
            lists.append(entries[row_start[row] + listed[tile_start[tile] : tile_start[tile + 1]]])
    return _padded(lists, trace.image.shape[1:], bands=len(trace.lists) if by_row else 1)


def box_lists(first: np.ndarray, last: np.ndarray, size: tuple[int, int]) -> TileLists:
    """Lists by bounding box, one band: splat i is in tiles first[i] <= (column, row) < last[i]."""
    lists: list[list[int]] = [[] for _ in range(-(-size[1] // TILE) * -(-size[0] // TILE))]
    for i, ((left, top), (right, bottom)) in enumerate(zip(first.astype(int), last.astype(int), strict=True)):
        for row in range(top, bottom):
            for column in range(left, right):
                lists[row * -(-size[1] // TILE) + column].append(i)
    return _padded([np.array(own, np.int32) for own in lists], size, bands=1)


def _padded(lists: list[np.ndarray], size: tuple[int, int], *, bands: int) -> TileLists:
    """Lists of the tiles, row by row, as rectangles."""
    num_columns = -(-size[1] // TILE)
    places = [(k % num_columns * TILE, k // num_columns * TILE) for k in range(len(lists))]
    padded = np.full((max(map(len, lists)), len(lists)), -1, np.int32)
    for k, splats in enumerate(lists):
        padded[: len(splats), k] = splats
    left, top = np.array(places, np.float32).reshape(bands, -1, 2).transpose(2, 0, 1)
    return TileLists(padded.reshape(len(padded), bands, -1).transpose(1, 0, 2).copy(), left, top)


@functools.partial(jax.jit, static_argnames=("size", "options"))
def render_tiles(mean, factor, opacity, color, background, lists, *, size, options=None):
    """Picture (3, height, width) of float32 splats in pixels; differentiable. Sizes: multiples of 16."""
    options = RenderOptions() if options is None else options
    splats = _columns(mean, factor, opacity, color, options.low_pass)
    # Row -1, the padding's, is a splat without opacity.
    splats = jnp.concatenate([splats, jnp.zeros((1, splats.shape[1]), splats.dtype)])

    # Recomputed band by band in the backward pass: otherwise every position of every list is kept in memory.
    @jax.checkpoint
    def band(listed, left, top):
        return _blend(splats[listed], left, top, options)

    planes = jax.lax.map(lambda one: band(*one), lists)  # (bands, 4, tiles per band, 256)
    image = _untile(jnp.moveaxis(planes, 1, 0), size)
    return image[1:] + image[:1] * background[:, None, None]


def _columns(mean, factor, opacity, color, low_pass):
    """Per splat: mean, minus half the conic (xx, 2 xy, yy), opacity, colour."""
    xx = jnp.sum(factor[:, 0] ** 2, -1) + low_pass
    xy = jnp.sum(factor[:, 0] * factor[:, 1], -1)
    yy = jnp.sum(factor[:, 1] ** 2, -1) + low_pass
    area = factor[:, 0, 0] * factor[:, 1, 1] - factor[:, 0, 1] * factor[:, 1, 0]
    det = area**2 + low_pass * (xx + yy - low_pass)
    conic = [-0.5 * yy / det, xy / det, -0.5 * xx / det]
    return jnp.stack([mean[:, 0], mean[:, 1], *conic, opacity, *color.T], -1)


def _blend(splats, left, top, options):
    """Light left and colours (4, tiles, 256) of tiles with their splats by position, (longest, tiles, 9)."""
    pixel = jnp.arange(TILE * TILE)
    x = left[:, None] + (pixel % TILE)[None, :].astype(jnp.float32) + 0.5
    y = top[:, None] + (pixel // TILE)[None, :].astype(jnp.float32) + 0.5

    def add(planes, splat):
        light, *colors = planes
        mean_x, mean_y, xx, xy, yy, opacity, *own = (column[:, None] for column in splat.T)
        dx, dy = x - mean_x, y - mean_y
        alpha = opacity * jnp.exp(xx * dx * dx + xy * dx * dy + yy * dy * dy)
        seen = (alpha >= options.alpha_cutoff) & (light > options.transmittance_stop)
        weight = jnp.where(seen, jnp.minimum(alpha, options.alpha_ceiling), 0.0) * light
        return (light - weight, *(c + weight * o for c, o in zip(colors, own, strict=True))), None

    blank = jnp.zeros_like(x)
    planes, _ = jax.lax.scan(add, (jnp.ones_like(x), blank, blank, blank), splats)
    return jnp.stack(planes)


def _untile(planes, size):
    """(channels, bands, tiles per band, 256) to (channels, height, width)."""
    height, width = size
    tiles = planes.reshape(len(planes), height // TILE, width // TILE, TILE, TILE)
    return tiles.transpose(0, 1, 3, 2, 4).reshape(len(planes), height, width)
