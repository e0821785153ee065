"""Numba kernels of the CPU engine: binning, compositing front to back, and the backward pass. `cpu` calls them.

All are in one file, since Numba reuses cached code as long as the file of the function itself has not changed.
"""

import math

import numba as nb
import numpy as np

from foldgauss._numerics.simd import (
    LANES,
    add_lanes,
    any_set,
    broadcast,
    cell_columns,
    cell_rows,
    exp2,
    gather_columns,
    load,
    lowest_bit,
    range_mask,
    select,
    store,
    transpose_cells,
)
from foldgauss._runtime.kernels import inline, kernel

TILE = 16
PIXELS = TILE * TILE
_SHIFT = 4  # log2(TILE)
_CELL_SHIFT = 2  # log2(CELL)
#: Side of a cell in pixels; the pixels of a cell are one vector.
CELL = 4
#: Side of a tile in cells. The cost of a splat is the number of cells that it meets: compact shapes meet a third fewer
#: square cells than rows of 16 pixels.
CELLS = 4
assert CELL * CELL == LANES
#: Reciprocal of the largest standard deviation rendered, 1e9 px: the determinant of a wider splat does not fit into
#: float32.
WIDEST = 1e-9
#: Reciprocal of the smallest one rendered, along x at fixed y and along y at fixed x, 1e-6 px: a thinner splat
#: practically never meets a pixel center. Within these bounds nothing here overflows.
THINNEST = 1e6
#: Ellipses are enlarged a little for binning, so that the alpha test alone decides about a pixel.
SLACK = np.float32(1e-3)

_f = nb.float32
_i = nb.int32
_u = nb.uint64

# Columns of the per-splat geometry. The exponent is kept in powers of two, log2 of the opacity included:
# alpha = 2^(LOG - (P dx + Q dy)^2 - (R dy)^2). Offsets are whitened before they are squared: the three terms of the
# usual conic cancel for thin, slanted splats. A pixel counts where the exponent is at least LEAST; that ellipse extends
# furthest to the right on the line dy = TURN, to the left on -TURN.
_X = 0
_Y = 1
_P = 2
_Q = 3
_R = 4
_LOG = 5
_LEAST = 6
_TURN = 7
# A tile is composited in blocks of so many splats, whose parameters are stored column by column: those above, then the
# colors. Between blocks the tile ends early if all its pixels are opaque.
BLOCK = 64
# The first column of colors.
_COLOR = 8
# Sums of a gradient slot: of dL/dalpha * alpha times 1, v, w, v^2, v w, w^2, where v = P dx + Q dy and w = R dy (in
# whitened coordinates the moments of thin splats do not cancel either), then the colors'; padded to a vector.
_MOMENTS = 6
#: Channels of one image at most, which are kept in registers.
MOST_CHANNELS = 4
# Planes of the scratch: the transmittance; then, forward, the colors; backward, from here on the color from behind
# (times the incoming gradient),
_BEHIND = PIXELS
# and the incoming gradients.
_G = 2 * PIXELS
# What the backward pass stores for each cell of a splat: a vector of alphas and a vector of weights.
_STORED = 2 * LANES


@inline
def _pixel_range(left, right, width):
    """Columns (or rows) first <= k < stop of pixels with left <= k <= right, of 0 <= k < width."""
    # Clipped to the image before the cast; truncated, as ceil and floor would be calls into libm here.
    # The bound is the first argument of `max`, which then returns it for NaN, whose cast would be undefined.
    low = min(max(_f(0.0), left), width)
    high = min(max(_f(-1.0), right), width - _f(1.0))
    first = _i(low)
    first += _i(_f(first) < low)
    return first, _i(high + _f(1.0))


@kernel
def project(start, stop, mean, factor, opacity, color, height, width, low_pass, cutoff, support, geometry, span, count):
    """Geometry of splats start..stop and the rows of tiles that each one reaches (none if it is not visible).

    The splats that reach a row are added to its number in `count`.
    `support` is the squared support radius in standard deviations, or infinity.
    """
    half_log2e = _f(0.5 * math.log2(math.e))
    log_cutoff, radius = _f(math.log2(cutoff)), half_log2e * support
    for i in range(start, stop):
        span[i, 0] = 0
        span[i, 1] = 0
        # In double precision: the determinant holds fourth powers of a standard deviation.
        a, b = nb.float64(factor[i, 0, 0]), nb.float64(factor[i, 0, 1])
        c, d = nb.float64(factor[i, 1, 0]), nb.float64(factor[i, 1, 1])
        xx = a * a + b * b + low_pass
        xy = a * c + b * d
        yy = c * c + d * d + low_pass
        area = a * d - b * c
        det = area * area + low_pass * (xx + yy - low_pass)
        inverse = 1.0 / yy
        p, r = math.sqrt(half_log2e * (yy / det)), math.sqrt(half_log2e * inverse)
        q = -xy * inverse * p
        # Also false for NaN, and for a determinant of 0.
        drawable = p < THINNEST and q * q + r * r < THINNEST**2 and max(xx, yy) < half_log2e / WIDEST**2
        if not (drawable and cutoff <= opacity[i] < math.inf):
            continue
        finite = True
        for c in range(color.shape[1]):
            finite &= math.isfinite(color[i, c])
        if not finite:
            continue
        log = math.log2(opacity[i])
        reach = (min(log - log_cutoff, radius) * (_f(1.0) + SLACK) + SLACK) / half_log2e
        radius_x, radius_y = math.sqrt(reach * _f(xx)), math.sqrt(reach * _f(yy))
        x, y = mean[i, 0], mean[i, 1]
        seen = x + radius_x > 0.0 and x - radius_x < width and y + radius_y > 0.0 and y - radius_y < height
        if not seen:
            continue
        geometry[i, _X] = x
        geometry[i, _Y] = y
        geometry[i, _P] = p
        geometry[i, _Q] = q
        geometry[i, _R] = r
        geometry[i, _LOG] = log
        geometry[i, _LEAST] = max(log_cutoff, log - radius)
        geometry[i, _TURN] = _f(xy / xx) * radius_x
        first, after = _pixel_range(y - radius_y - _f(0.5), y + radius_y - _f(0.5), _f(height))
        if after > first:
            span[i, 0] = first >> _i(_SHIFT)
            span[i, 1] = (after + _i(TILE - 1)) >> _i(_SHIFT)
            for row in range(span[i, 0], span[i, 1]):
                count[row] += 1


@kernel
def fill_rows(start, stop, span, slot, fill, entries, first_slot, slot_position):
    """List splats start..stop in the rows that they reach, in array order, and the positions of each one's entries.

    `slot`: the first one of these splats; `fill`: the position in `entries` of the first in each row, overwritten.
    """
    for i in range(start, stop):
        first_slot[i] = slot
        for row in range(span[i, 0], span[i, 1]):
            position = fill[row]
            entries[position] = i
            slot_position[slot] = position
            slot += 1
            fill[row] = position + 1
    first_slot[stop] = slot


@inline
def _right_edge(p, q, r, level, dy):
    """Right edge of the ellipse (p dx + q dy)^2 + (r dy)^2 = level on the line dy."""
    return (math.sqrt(max(level - r * dy * r * dy, _f(0.0))) - q * dy) / p


@inline
def _level(log, least):
    """(P dx + Q dy)^2 + (R dy)^2 at the edge of the enlarged ellipse."""
    return (log - least) * (_f(1.0) + SLACK) + SLACK


@kernel
def _load_geometry(geometry, num, which, left, top, block):
    """The geometry of splats which[:num], column after column, their centers relative to (left, top).

    `which` has length BLOCK: up to a multiple of 16 it is padded with the last splat.
    """
    for e in range(num, (num + LANES - 1) // LANES * LANES):
        which[e] = which[num - 1]
    for e in range(_u(0), _u(num), _u(LANES)):
        columns = gather_columns(geometry, which, e)
        store(block, _u(_X * BLOCK) + e, columns[_X] - broadcast(left))
        store(block, _u(_Y * BLOCK) + e, columns[_Y] - broadcast(top))
        store(block, _u(_P * BLOCK) + e, columns[_P])
        store(block, _u(_Q * BLOCK) + e, columns[_Q])
        store(block, _u(_R * BLOCK) + e, columns[_R])
        store(block, _u(_LOG * BLOCK) + e, columns[_LOG])
        store(block, _u(_LEAST * BLOCK) + e, columns[_LEAST])
        store(block, _u(_TURN * BLOCK) + e, columns[_TURN])


@kernel
def _find_squares(num, block, upper, lower, width, shift, first, end):
    """Squares first <= k < end of a band that the block's splats reach, 2^shift pixels wide.

    `upper` and `lower`: the y of the band's first and last pixel centers. Exact for the rectangle of a square's pixel
    centers.
    """
    for e in range(_u(num)):
        x, y = block[_u(_X * BLOCK) + e], block[_u(_Y * BLOCK) + e]
        p, q, r = block[_u(_P * BLOCK) + e], block[_u(_Q * BLOCK) + e], block[_u(_R * BLOCK) + e]
        level = _level(block[_u(_LOG * BLOCK) + e], block[_u(_LEAST * BLOCK) + e])
        # Within the band the ellipse is widest on the line nearest to its turning point.
        turn = block[_u(_TURN * BLOCK) + e]
        on_right, on_left = min(max(turn, upper - y), lower - y), min(max(-turn, upper - y), lower - y)
        left, right = x - _right_edge(p, -q, r, level, on_left), x + _right_edge(p, q, r, level, on_right)
        column, stop = _pixel_range(left, right, width)
        # The line nearest to the turning point meets the ellipse if any line of the band does.
        reached = (stop > column) & (r * on_right * r * on_right <= level)
        first[e] = column >> shift
        end[e] = (stop + (_i(1) << shift) - _i(1)) >> shift if reached else first[e]


@kernel
def _bucket_tiles(geometry, row_start, entries, begin, end, height, width):
    """The entries of each tile of rows begin..end, in array order, relative to the first entry of row `begin`."""
    across, base = (width + TILE - 1) // TILE, row_start[begin]
    count = row_start[end] - base
    first, after = np.empty(count, np.int32), np.empty(count, np.int32)
    block, which = _aligned_empty(8 * BLOCK), np.empty(BLOCK, np.int32)
    tile_start = np.zeros((end - begin) * across + 1, np.int64)
    for row in range(begin, end):
        upper, lower = _f(row * TILE), _f(min((row + 1) * TILE, height) - 1)
        for start in range(row_start[row] - base, row_start[row + 1] - base, BLOCK):
            stop = min(start + BLOCK, row_start[row + 1] - base)
            which[: stop - start] = entries[base + start : base + stop]
            _load_geometry(geometry, stop - start, which, _f(0.5), _f(0.5), block)
            own_first, own_after = first[start:stop], after[start:stop]
            _find_squares(stop - start, block, upper, lower, _f(width), _i(_SHIFT), own_first, own_after)
            left = (row - begin) * across
            for e in range(start, stop):
                for tile in range(left + first[e], left + after[e]):
                    tile_start[tile + 1] += 1
    for tile in range(len(tile_start) - 1):
        tile_start[tile + 1] += tile_start[tile]
    fill = tile_start.copy()
    listed = np.empty(tile_start[-1], np.int32)
    for row in range(begin, end):
        left = (row - begin) * across
        for e in range(row_start[row] - base, row_start[row + 1] - base):
            for tile in range(left + first[e], left + after[e]):
                listed[fill[tile]] = e
                fill[tile] += 1
    return tile_start, listed


@inline
def _aligned_empty(size):
    """An array of `size` floats that starts on a cache line, so that no vector of 16 straddles two."""
    buffer = np.empty(size + TILE, np.float32)
    skip = (-buffer.ctypes.data // 4) % TILE
    return buffer[skip : skip + size]


@kernel
def _load_block(geometry, color, background, entries, listed, left, top, block, first, end):
    """The parameters of up to BLOCK splats of a tile, one after another, and the cells that each one reaches.

    Centers are relative to the center of the tile's first pixel.
    """
    which = end  # reused: `end` is written last
    for e in range(_u(len(listed))):
        i = entries[listed[e]]
        which[e] = i
        for c in range(_u(len(background))):
            block[_u(_COLOR * BLOCK) + c * _u(BLOCK) + e] = color[i, c]
    _load_geometry(geometry, len(listed), which, left + _f(0.5), top + _f(0.5), block)
    for band in range(CELLS):
        upper, begin, stop = _f(band * CELL), band * BLOCK, (band + 1) * BLOCK
        lower, own_first, own_end = upper + _f(CELL - 1), first[begin:stop], end[begin:stop]
        _find_squares(len(listed), block, upper, lower, _f(TILE), _i(_CELL_SHIFT), own_first, own_end)
        own_end[len(listed) :] = 0


@inline
def _offsets(block, e, x, y):
    """P dx + Q dy and R dy of 16 splats of a block, from e on, at pixel (x, y) of their tile."""
    dx, dy = broadcast(x) - load(block, _u(_X * BLOCK) + e), broadcast(y) - load(block, _u(_Y * BLOCK) + e)
    across = load(block, _u(_P * BLOCK) + e) * dx + load(block, _u(_Q * BLOCK) + e) * dy
    return across, load(block, _u(_R * BLOCK) + e) * dy


@kernel
def _composite(num, block, first, end, shear, rise, scratch, background, over, ceiling, finished):
    """Composite a block's splats onto the tile: scratch holds transmittance, then colors, cell after cell.

    A cell's transmittance and colors stay in registers while the splats that reach it, one bit each, are
    composited in turn; `shear` and `rise` are buffers for P dx + Q dy and R dy at its first pixel.
    """
    attenuation, highest = broadcast(_f(1.0) if over else _f(0.0)), broadcast(ceiling)
    stop, none = broadcast(finished), broadcast(_f(0.0))
    x, y = cell_columns(), cell_rows()
    channels, color = _u(len(background)), _u(_COLOR * BLOCK)
    for cell in range(_u(CELLS * CELLS)):
        base, band, column, remaining = cell * _u(LANES), cell // _u(CELLS), cell % _u(CELLS), _u(0)
        for e in range(_u(0), _u(num), _u(LANES)):
            remaining |= range_mask(first, end, band * _u(BLOCK) + e, _i(column)) << e
        transmittance = load(scratch, base)
        if remaining == _u(0) or not any_set(transmittance > stop):
            continue
        for e in range(_u(0), _u(num), _u(LANES)):
            across, along = _offsets(block, e, _f(_i(column * _u(CELL))), _f(_i(band * _u(CELL))))
            store(shear, e, across)
            store(rise, e, along)
        plane = base + _u(PIXELS)
        c_0th, c_1st, c_2nd, c_3rd = load(scratch, plane), none, none, none
        if channels > _u(1):
            c_1st = load(scratch, plane + _u(PIXELS))
        if channels > _u(2):
            c_2nd = load(scratch, plane + _u(2 * PIXELS))
        if channels > _u(3):
            c_3rd = load(scratch, plane + _u(3 * PIXELS))
        while remaining != _u(0):
            e = lowest_bit(remaining)
            remaining &= remaining - _u(1)
            across = broadcast(block[_u(_P * BLOCK) + e]) * x + (
                broadcast(block[_u(_Q * BLOCK) + e]) * y + broadcast(shear[e])
            )
            along = broadcast(block[_u(_R * BLOCK) + e]) * y + broadcast(rise[e])
            power = broadcast(block[_u(_LOG * BLOCK) + e]) - along * along - across * across
            alpha = exp2(power)
            alpha = select(alpha < highest, alpha, highest)
            alpha = select(power >= broadcast(block[_u(_LEAST * BLOCK) + e]), alpha, none)
            weight = alpha * select(transmittance > stop, transmittance, none)
            transmittance = transmittance - attenuation * weight
            c_0th = c_0th + weight * broadcast(block[color + e])
            if channels > _u(1):
                c_1st = c_1st + weight * broadcast(block[color + _u(BLOCK) + e])
            if channels > _u(2):
                c_2nd = c_2nd + weight * broadcast(block[color + _u(2 * BLOCK) + e])
            if channels > _u(3):
                c_3rd = c_3rd + weight * broadcast(block[color + _u(3 * BLOCK) + e])
        store(scratch, base, transmittance)
        store(scratch, plane, c_0th)
        if channels > _u(1):
            store(scratch, plane + _u(PIXELS), c_1st)
        if channels > _u(2):
            store(scratch, plane + _u(2 * PIXELS), c_2nd)
        if channels > _u(3):
            store(scratch, plane + _u(3 * PIXELS), c_3rd)


@kernel
def _is_opaque(scratch, finished):
    """Whether every pixel of the tile is finished: its transmittance is not above the stop."""
    stop = broadcast(finished)
    unfinished = False
    for row in range(_u(TILE)):
        unfinished |= any_set(load(scratch, row * _u(TILE)) > stop)
    return not unfinished


@kernel
def _clear_tile(scratch, rows, columns):
    """Initialize the scratch of a tile: transmittance 1 on `rows` x `columns` pixels, no color."""
    scratch[:] = 0.0
    for y in range(rows):  # pixels outside the image have transmittance 0: no work waits for them
        scratch[y * TILE : y * TILE + columns] = 1.0
    _reorder(scratch, _u(0))


@kernel
def _reorder(scratch, plane):
    """Reorder a plane of the scratch from cells to rows of pixels, or back."""
    for band in range(_u(CELLS)):
        at = plane + band * _u(TILE * CELL)
        first, second = load(scratch, at), load(scratch, at + _u(LANES))
        third, fourth = load(scratch, at + _u(2 * LANES)), load(scratch, at + _u(3 * LANES))
        rows = transpose_cells(first, second, third, fourth)
        store(scratch, at, rows[0])
        store(scratch, at + _u(LANES), rows[1])
        store(scratch, at + _u(2 * LANES), rows[2])
        store(scratch, at + _u(3 * LANES), rows[3])


@kernel
def _write_tile(scratch, background, image, transmittance, top, left):
    """Write a tile into the image; overwrites its scratch."""
    height, width = transmittance.shape
    rows, columns = min(TILE, height - top), min(TILE, width - left)
    for plane in range(_u(1 + len(background))):
        _reorder(scratch, plane * _u(PIXELS))
    for y in range(rows):
        base, out = _u(y * TILE), transmittance[top + y, left : left + columns]
        for x in range(_u(columns)):
            out[x] = scratch[base + x]
        for c in range(len(background)):
            plane, out = base + _u((c + 1) * PIXELS), image[c, top + y, left : left + columns]
            behind = background[c]
            for x in range(_u(columns)):
                out[x] = scratch[plane + x] + scratch[base + x] * behind


@kernel
def forward_rows(
    begin,
    end,
    row_start,
    entries,
    geometry,
    color,
    background,
    over,
    ceiling,
    finished,
    image,
    transmittance,
):
    """Composite rows begin..end of tiles into `image` (channels, height, width) and `transmittance` (height, width).

    `background` is a tuple, so that the loop over channels is unrolled.

    Returns the tiles' lists (start, entries relative to the rows' first, the end of those composited), and the
    transmittance of every pixel of a tile at the start of each block but the first, tile after tile.
    """
    height, width = transmittance.shape
    across = (width + TILE - 1) // TILE
    tile_start, listed = _bucket_tiles(geometry, row_start, entries, begin, end, height, width)
    entries = entries[row_start[begin] : row_start[end]]
    num_stored = len(listed) // BLOCK if over else 0  # an upper limit: the first block of each tile is not stored
    used = np.empty(len(tile_start) - 1, np.int64)
    block_transmittances = np.empty((num_stored, PIXELS), np.float32)
    scratch, block = _aligned_empty((1 + len(background)) * PIXELS), _aligned_empty((_COLOR + len(background)) * BLOCK)
    first, after = np.empty(CELLS * BLOCK, np.int32), np.empty(CELLS * BLOCK, np.int32)
    shear, rise = _aligned_empty(BLOCK), _aligned_empty(BLOCK)
    kept = 0
    for tile in range(len(used)):
        top, left = (begin + tile // across) * TILE, tile % across * TILE
        _clear_tile(scratch, min(TILE, height - top), min(TILE, width - left))
        used[tile] = tile_start[tile + 1]
        for k in range(tile_start[tile], tile_start[tile + 1], BLOCK):
            if over and k > tile_start[tile]:
                if _is_opaque(scratch, finished):
                    used[tile] = k
                    break
                for p in range(_u(PIXELS)):
                    block_transmittances[kept, p] = scratch[p]
                kept += 1
            part = listed[k : min(k + BLOCK, tile_start[tile + 1])]
            _load_block(geometry, color, background, entries, part, _f(left), _f(top), block, first, after)
            _composite(len(part), block, first, after, shear, rise, scratch, background, over, ceiling, finished)
        _write_tile(scratch, background, image, transmittance, top, left)
    return tile_start, listed, used, block_transmittances[:kept]


@kernel
def _list_cells(num, block, first, end, items, stop, shear, rise):
    """List every cell that a splat of the block reaches, those of splat e before stop[e]; returns their number.

    One flat list, since a loop over each splat's few cells would mispredict its end for every splat.
    """
    total = _u(0)
    for e in range(_u(num)):
        x, y = block[_u(_X * BLOCK) + e], block[_u(_Y * BLOCK) + e]
        p, q, r = block[_u(_P * BLOCK) + e], block[_u(_Q * BLOCK) + e], block[_u(_R * BLOCK) + e]
        for band in range(_u(CELLS)):
            column, after = first[band * _u(BLOCK) + e], end[band * _u(BLOCK) + e]
            dx, dy = _f(column * _i(CELL)) - x, _f(_i(band) * _i(CELL)) - y
            item = (_i(band) * _i(CELLS) + column) << _i(8) | _i(e)
            for k in range(_u(CELLS)):  # always all of them, one vector: the next splat overwrites the excess
                items[total + k] = item + (_i(k) << _i(8))
                shear[total + k] = p * (dx + _f(_i(k) * _i(CELL))) + q * dy
                rise[total + k] = r * dy
            total += _u(after - column)
        stop[e] = total
    return total


@kernel
def _store_alphas(num_items, items, shear, rise, block, scratch, stored, over, ceiling, finished):
    """Traverse a block forward once more and store alpha and weight of every item; scratch: the transmittance."""
    highest, stop, none = broadcast(ceiling), broadcast(finished), broadcast(_f(0.0))
    x, y = cell_columns(), cell_rows()
    for n in range(_u(num_items)):
        e, base, note = _u(items[n] & _i(255)), _u(items[n] >> _i(8)) * _u(LANES), n * _u(_STORED)
        across = broadcast(block[_u(_P * BLOCK) + e]) * x + (
            broadcast(block[_u(_Q * BLOCK) + e]) * y + broadcast(shear[n])
        )
        along = broadcast(block[_u(_R * BLOCK) + e]) * y + broadcast(rise[n])
        power = broadcast(block[_u(_LOG * BLOCK) + e]) - along * along - across * across
        transmittance = load(scratch, base)
        alpha = exp2(power)
        alpha = select(alpha < highest, alpha, highest)
        seen = (power >= broadcast(block[_u(_LEAST * BLOCK) + e])) & (transmittance > stop)
        alpha = select(seen, alpha, none)
        weight = alpha * transmittance
        if over:
            store(scratch, base, transmittance - weight)
        store(stored, note, alpha)
        store(stored, note + _u(LANES), weight)


@kernel
def _add_gradients(begin, end, items, shear, rise, e, block, scratch, stored, background, over, flat, slot):
    """Add the gradient sums of splat e, items begin..end of a tile, to its slot, and composite it over `behind`.

    With B the color behind the splat per unit of transmittance, times the incoming gradient, dL/dalpha = T (c . g - B):
    nothing is divided by 1 - alpha, which may be 0. `flat`: the alpha at which `_store_alphas` capped it; from there on
    it does not depend on the exponent.
    """
    num, limit, none = _u(len(background)), broadcast(flat), broadcast(_f(0.0))
    x, y, color = cell_columns(), cell_rows(), _u(_COLOR * BLOCK) + e
    slant = broadcast(block[_u(_P * BLOCK) + e]) * x + broadcast(block[_u(_Q * BLOCK) + e]) * y
    slope_y = broadcast(block[_u(_R * BLOCK) + e]) * y
    s_1, s_v, s_w, s_vv, s_vw, s_ww = none, none, none, none, none, none
    s_0th, s_1st, s_2nd, s_3rd = none, none, none, none
    for n in range(begin, end):
        base, note = _u(items[n] >> _i(8)) * _u(LANES), n * _u(_STORED)
        alpha, weight = load(stored, note), load(stored, note + _u(LANES))
        across, along = slant + broadcast(shear[n]), slope_y + broadcast(rise[n])
        plane = base + _u(_G)
        grad = load(scratch, plane)
        own = broadcast(block[color]) * grad
        s_0th = s_0th + weight * grad
        if num > _u(1):
            grad = load(scratch, plane + _u(PIXELS))
            own = own + broadcast(block[color + _u(BLOCK)]) * grad
            s_1st = s_1st + weight * grad
        if num > _u(2):
            grad = load(scratch, plane + _u(2 * PIXELS))
            own = own + broadcast(block[color + _u(2 * BLOCK)]) * grad
            s_2nd = s_2nd + weight * grad
        if num > _u(3):
            grad = load(scratch, plane + _u(3 * PIXELS))
            own = own + broadcast(block[color + _u(3 * BLOCK)]) * grad
            s_3rd = s_3rd + weight * grad
        gain = own
        if over:
            behind = load(scratch, base + _u(_BEHIND))
            gain = own - behind
            store(scratch, base + _u(_BEHIND), behind + alpha * gain)
        slope = select(alpha < limit, weight * gain, none)
        by_v, by_w = slope * across, slope * along
        s_1 = s_1 + slope
        s_v = s_v + by_v
        s_w = s_w + by_w
        s_vv = s_vv + by_v * across
        s_vw = s_vw + by_v * along
        s_ww = s_ww + by_w * along
    pairs = add_lanes(s_1, s_v, 1), add_lanes(s_w, s_vv, 1), add_lanes(s_vw, s_ww, 1), add_lanes(s_0th, s_1st, 1)
    first = add_lanes(add_lanes(pairs[0], pairs[1], 2), add_lanes(pairs[2], pairs[3], 2), 4)
    second = add_lanes(add_lanes(add_lanes(s_2nd, s_3rd, 1), none, 2), none, 4)
    store(slot, _u(0), load(slot, _u(0)) + add_lanes(first, second, 8))


@kernel
def backward_rows(
    begin,
    end,
    row_start,
    entries,
    tile_start,
    listed,
    used,
    block_transmittances,
    geometry,
    color,
    background,
    over,
    ceiling,
    finished,
    grad_image,
    slots,
):
    """Write the gradient sums of every entry of rows begin..end to its slot; `forward_rows` made the lists."""
    channels, (height, width) = len(background), grad_image.shape[1:]
    across = (width + TILE - 1) // TILE
    flat = ceiling * _f(1.0 + 2.0**-23)  # the next float: an alpha equal to the ceiling still depends on the exponent
    entries, slots = entries[row_start[begin] : row_start[end]], slots[row_start[begin] : row_start[end]]
    slots[:] = 0.0
    scratch, block = _aligned_empty((2 + channels) * PIXELS), _aligned_empty((_COLOR + channels) * BLOCK)
    size = BLOCK * CELLS * CELLS
    items, shear, rise = np.empty(size, np.int32), np.empty(size, np.float32), np.empty(size, np.float32)
    first, after = np.empty(CELLS * BLOCK, np.int32), np.empty(CELLS * BLOCK, np.int32)
    stop = np.empty(BLOCK, np.uint64)
    stored = _aligned_empty(size * _STORED)
    kept = len(block_transmittances)
    for tile in range(len(used) - 1, -1, -1):
        top, left = (begin + tile // across) * TILE, tile % across * TILE
        columns = min(TILE, width - left)
        scratch[_BEHIND:] = 0.0
        for c in range(channels):
            behind = background[c]
            for y in range(min(TILE, height - top)):
                base, row_of_grad = _u(y * TILE), grad_image[c, top + y, left : left + columns]
                plane = base + _u(_G + c * PIXELS)
                for x in range(_u(columns)):
                    scratch[plane + x] = row_of_grad[x]
                    scratch[base + _u(_BEHIND) + x] += row_of_grad[x] * behind
        for plane in range(_u(_BEHIND), _u((2 + channels) * PIXELS), _u(PIXELS)):
            _reorder(scratch, plane)
        start = tile_start[tile]
        for k in range((used[tile] - start - 1) // BLOCK, -1, -1):
            part = listed[start + k * BLOCK : min(start + (k + 1) * BLOCK, used[tile])]
            _load_block(geometry, color, background, entries, part, _f(left), _f(top), block, first, after)
            num_items = _list_cells(len(part), block, first, after, items, stop, shear, rise)
            if over and k > 0:
                kept -= 1
                for p in range(_u(PIXELS)):
                    scratch[p] = block_transmittances[kept, p]
            else:
                scratch[:PIXELS] = 1.0
            _store_alphas(num_items, items, shear, rise, block, scratch, stored, over, flat, finished)
            for e in range(len(part) - 1, -1, -1):
                start_of_own, own = stop[e - 1] if e else _u(0), slots[part[e]]
                _add_gradients(
                    *(start_of_own, stop[e], items, shear, rise, _u(e), block, scratch, stored),
                    *(background, over, flat, own),
                )


@kernel
def gather(
    start,
    stop,
    first_slot,
    slot_position,
    slots,
    geometry,
    factor,
    opacity,
    d_mean,
    d_factor,
    d_opacity,
    d_color,
):
    """Sum the slots of splats start..stop and convert them to gradients of mean, factor, opacity and color."""
    c = _f(2.0 * math.log(2.0))
    total = np.empty(LANES, np.float32)
    for i in range(start, stop):
        total[:] = 0.0
        for s in range(first_slot[i], first_slot[i + 1]):
            slot = slots[slot_position[s]]
            store(total, _u(0), load(total, _u(0)) + load(slot, _u(0)))
        for k in range(d_color.shape[1]):
            d_color[i, k] = total[_MOMENTS + k]
        if first_slot[i] == first_slot[i + 1]:
            d_opacity[i] = 0.0
            d_mean[i] = 0.0
            d_factor[i] = 0.0
            continue
        # With W = [[P, Q], [0, R]]: Sigma^-1 = c W^T W, dL/dmean = c W^T (v, w), dL/dF = c^2 W^T M W F, M the
        # second moments of (v, w).
        p, q, r = geometry[i, _P], geometry[i, _Q], geometry[i, _R]
        d_opacity[i] = total[0] / opacity[i]
        d_mean[i, 0] = c * p * total[1]
        d_mean[i, 1] = c * (q * total[1] + r * total[2])
        for k in range(2):
            v = c * (p * factor[i, 0, k] + q * factor[i, 1, k])
            w = c * r * factor[i, 1, k]
            by_v = total[3] * v + total[4] * w
            by_w = total[4] * v + total[5] * w
            d_factor[i, 0, k] = c * p * by_v
            d_factor[i, 1, k] = c * (q * by_v + r * by_w)
