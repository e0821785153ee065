"""Kernels of the CPU engine: listing, blending and the way back. `cpu` says how they are put together.

All in one file, since Numba takes kept code for fresh as long as the file of the function itself has not changed.
"""

import math

import numba as nb
import numpy as np

from foldgauss._kernels import inline, kernel
from foldgauss.render._vectors import (
    LANES,
    any_of,
    between,
    choose,
    every,
    folded,
    lanes,
    load,
    lowest_bit,
    scale,
    split,
    store,
)

TILE = LANES  # a row of a tile is one vector
PIXELS = TILE * TILE
_SHIFT = 4  # log2(TILE)
#: A splat is drawn if it is thicker than about 1e-6 px (standard deviations along x at fixed y, and along y at fixed x)
#: and, over all, not wider or higher than 1e9 px: what is thinner no pixel's centre meets but by design, and of what is
#: wider float32 does not hold the determinant. Within these bounds nothing here overflows.
WIDEST, THINNEST = 1e-9, 1e6
#: Ellipses are listed a little too large, so that the alpha test alone decides about a pixel.
SLACK = np.float32(1e-3)

_f, _i, _u = nb.float32, nb.int32, nb.uint64

# Columns of the per-splat geometry. The exponent is kept in powers of two, log2 of the opacity included:
# alpha = 2^(LOG - (P dx + Q dy)^2 - (R dy)^2). Whitened before it is squared: the three terms of the usual conic
# cancel for thin, slanted splats. Drawn where the exponent is at least LEAST; RX is half the drawn ellipse's width.
_X, _Y, _P, _Q, _R, _LOG, _LEAST, _RX = range(8)
# A tile is blended in blocks of splats, whose parameters are laid out one after another: those above without the
# half-width, then the colours. Between blocks the tile is left if no light is.
BLOCK, _COLOR = 64, 7
# Sums of a gradient slot: of dL/dalpha * alpha against 1, v, w, v^2, v w, w^2, where v = P dx + Q dy and w = R dy (in
# whitened coordinates the moments of thin splats do not cancel either), then the colours'. Whole vectors of them.
_MOMENTS = 6
#: Channels that the backward pass keeps in registers; what is more goes through memory.
FEW = 4
# Planes of the scratch: the light left; then, forward, the colours; backward, the light that comes from behind and
# the incoming gradients.
_BEHIND, _G = PIXELS, 2 * PIXELS
# What the backward pass notes of each pixel row of a splat: alpha and weight, a vector of each.
_NOTES = 2 * LANES


def slot_width(channels: int) -> int:
    """Floats of a gradient slot."""
    return -(-(_MOMENTS + channels) // LANES) * LANES


@inline
def _exp2(x):
    """2^x of a vector within 2e-7: a polynomial of the part in [-0.5, 0.5], the whole part into the exponent.

    For x in [-126, 127]; anything else gives numbers without meaning, for the caller to drop.
    """
    whole, part = split(x)
    y = every(_f(1.3264727e-3))
    y = y * part + every(_f(9.671513e-3))
    y = y * part + every(_f(5.5507336e-2))
    y = y * part + every(_f(0.24022242))
    y = y * part + every(_f(0.693147))
    y = y * part + every(_f(1.0))
    return scale(y, whole)


@kernel
def project(start, stop, mean, factor, opacity, height, width, low_pass, cutoff, support, geometry, span):
    """Geometry of splats start..stop and the rows of tiles each one reaches (none: it is not seen).

    `support` is the squared support radius in standard deviations, or infinity.
    """
    half_log2e = _f(0.5 * math.log2(math.e))
    log_cutoff, radius = _f(math.log2(cutoff)), half_log2e * support
    for i in range(start, stop):
        span[i, 0] = 0
        span[i, 1] = 0
        # In double precision: fourth powers of a standard deviation stand in the determinant.
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
        if not (drawable and opacity[i] >= cutoff):
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
        geometry[i, _RX] = radius_x
        # Pixel rows whose centres lie within the radius; clipped before the cast, so no float is too large for it.
        first = math.ceil(max(y - radius_y - _f(0.5), _f(0.0)))
        last = math.floor(min(y + radius_y - _f(0.5), _f(height - 1)))
        if last >= first:
            span[i, 0] = first // TILE
            span[i, 1] = last // TILE + 1


@kernel
def bucket_rows(span, num_rows):
    """Counting pass: the splats of every row in array order, and where each splat's entries stand."""
    num = len(span)
    start = np.zeros(num_rows + 1, np.int64)
    first_slot = np.zeros(num + 1, np.int64)
    for i in range(num):
        first_slot[i + 1] = first_slot[i] + span[i, 1] - span[i, 0]
        for row in range(span[i, 0], span[i, 1]):
            start[row + 1] += 1
    for row in range(num_rows):
        start[row + 1] += start[row]
    fill = start.copy()
    entries = np.empty(start[num_rows], np.int32)
    slot_position = np.empty(start[num_rows], np.int64)
    for i in range(num):
        slot = first_slot[i]
        for row in range(span[i, 0], span[i, 1]):
            position = fill[row]
            entries[position] = i
            slot_position[slot] = position
            slot += 1
            fill[row] = position + 1
    return start, entries, first_slot, slot_position


@inline
def _edge(p, q, r, level, dy):
    """Right edge of the ellipse (p dx + q dy)^2 + (r dy)^2 = level on the line dy."""
    return (math.sqrt(max(level - r * dy * r * dy, _f(0.0))) - q * dy) / p


@inline
def _level(log, least):
    """What (P dx + Q dy)^2 + (R dy)^2 is at the edge of what is listed."""
    return (log - least) * (_f(1.0) + SLACK) + SLACK


@kernel
def _tiles_of(num, block, upper, lower, width, first, end):
    """Exact ellipse-tile test: tiles first <= k < end of a band that the block's splats reach.

    `upper` and `lower`: the y of the band's first and last pixel centres.
    """
    for e in range(_u(num)):
        x, y = block[_u(_X * BLOCK) + e], block[_u(_Y * BLOCK) + e]
        p, q, r = block[_u(_P * BLOCK) + e], block[_u(_Q * BLOCK) + e], block[_u(_R * BLOCK) + e]
        level = _level(block[_u(_LOG * BLOCK) + e], block[_u(_LEAST * BLOCK) + e])
        # The ellipse is widest to the right at dy = turn, to the left at -turn; within the band, at the nearest line.
        turn = -p * q * block[_u(_RX * BLOCK) + e] / (q * q + r * r)
        right = x + _edge(p, q, r, level, min(max(turn, upper - y), lower - y))
        left = x - _edge(p, -q, r, level, min(max(-turn, upper - y), lower - y))
        # Held within the picture before the cast; truncated, as ceil and floor would be calls into libm here.
        # The bound stands first in `max`, which so makes it of NaN, whose cast could be any number.
        low = min(max(_f(0.0), left - _f(0.5)), width)
        high = min(max(_f(-1.0), right - _f(0.5)), width - _f(1.0))
        column = _i(low)
        column += _i(_f(column) < low)
        stop = _i(high + _f(1.0))
        first[e] = column >> _i(_SHIFT)
        end[e] = max((stop + _i(TILE - 1)) >> _i(_SHIFT), first[e]) if stop > column else first[e]


@kernel
def _bucket_tiles(geometry, entries, top, height, width):
    """The entries of one band that each of its tiles lists, by tile in array order."""
    num_tiles, count = (width + TILE - 1) // TILE, len(entries)
    first, end = np.empty(count, np.int32), np.empty(count, np.int32)
    upper, lower = _f(top) + _f(0.5), _f(min(top + TILE, height)) - _f(0.5)
    block = np.empty(8 * BLOCK, np.float32)
    for begin in range(0, count, BLOCK):
        num = min(BLOCK, count - begin)
        for e in range(_u(num)):
            i = entries[_u(begin) + e]
            for k in range(_u(8)):
                block[k * _u(BLOCK) + e] = geometry[i, k]
        _tiles_of(num, block, upper, lower, _f(width), first[begin : begin + num], end[begin : begin + num])
    # How many more entries a tile has than the one before it.
    more = np.zeros(num_tiles + 1, np.int64)
    for e in range(count):
        more[first[e]] += 1
        more[end[e]] -= 1
    tile_start, here = np.zeros(num_tiles + 1, np.int64), 0
    for tile in range(num_tiles):
        here += more[tile]
        tile_start[tile + 1] = tile_start[tile] + here
    fill = tile_start.copy()
    listed = np.empty(tile_start[num_tiles], np.int32)
    for e in range(count):
        for tile in range(first[e], end[e]):
            listed[fill[tile]] = e
            fill[tile] += 1
    return tile_start, listed


@inline
def _pixel_rows(x, y, p, q, r, level):
    """Pixel rows (first, end) of a tile that the ellipse (p dx + q dy)^2 + (r dy)^2 = level reaches within its columns.

    The centre (x, y) is relative to the centre of the tile's first pixel. The ellipse is highest at dx = turn and
    lowest at -turn; within the columns, at the nearest one.
    """
    square = q * q + r * r
    inverse, shear = _f(1.0) / square, p * q
    turn = -q * math.sqrt(level) / (p * r)
    left, right = -x, _f(TILE - 1) - x
    above, below = min(max(turn, left), right), min(max(-turn, left), right)
    half_above = math.sqrt(max(square * level - (p * r * above) * (p * r * above), _f(0.0)))
    half_below = math.sqrt(max(square * level - (p * r * below) * (p * r * below), _f(0.0)))
    # Held within the tile before the cast; truncated, as ceil and floor would be calls into libm here.
    # NaN, too: see `_tiles_of`.
    low = min(max(_f(0.0), y - (shear * below + half_below) * inverse), _f(TILE))
    high = min(max(_f(-1.0), y - (shear * above - half_above) * inverse), _f(TILE - 1))
    first = _i(low)
    first += _i(_f(first) < low)
    return first, _i(high + _f(1.0))


@inline
def _aligned(size):
    """Room for `size` floats that starts on a cache line, so that no vector of 16 straddles two."""
    room = np.empty(size + TILE, np.float32)
    skip = (-room.ctypes.data // 4) % TILE
    return room[skip : skip + size]


@kernel
def _load_block(geometry, color, background, entries, listed, left, top, block, first, last):
    """The parameters of up to BLOCK splats of a tile, one after another, and the pixel rows that each one reaches."""
    for e in range(_u(len(listed))):
        i = entries[listed[e]]
        block[_u(_X * BLOCK) + e] = geometry[i, _X] - left - _f(0.5)
        block[_u(_Y * BLOCK) + e] = geometry[i, _Y] - top - _f(0.5)
        block[_u(_P * BLOCK) + e] = geometry[i, _P]
        block[_u(_Q * BLOCK) + e] = geometry[i, _Q]
        block[_u(_R * BLOCK) + e] = geometry[i, _R]
        block[_u(_LOG * BLOCK) + e] = geometry[i, _LOG]
        block[_u(_LEAST * BLOCK) + e] = geometry[i, _LEAST]
        for c in range(_u(len(background))):
            block[_u(_COLOR * BLOCK) + c * _u(BLOCK) + e] = color[i, c]
    for e in range(_u(len(listed))):
        first[e], last[e] = _pixel_rows(
            block[_u(_X * BLOCK) + e],
            block[_u(_Y * BLOCK) + e],
            block[_u(_P * BLOCK) + e],
            block[_u(_Q * BLOCK) + e],
            block[_u(_R * BLOCK) + e],
            _level(block[_u(_LOG * BLOCK) + e], block[_u(_LEAST * BLOCK) + e]),
        )
        last[e] = max(first[e], last[e])
    last[len(listed) :] = 0


@kernel
def _blend(num, block, first, last, shear, drop, scratch, background, over, ceiling, finished, marks):
    """Add a block's splats to the tile: scratch holds the light left, then the colours.

    One row of pixels after another, whose light and first FEW colours stay in registers while the splats that reach
    it, a bit each, are taken in turn. Along a row alpha = 2^(drop - (P column + shear)^2).
    `marks`: None, or room for two vectors for each splat, to add its weights and to keep its largest alphas in.
    """
    share, highest = every(_f(1.0) if over else _f(0.0)), every(ceiling)
    stop, none, columns = every(finished), every(_f(0.0)), lanes()
    channels, color = _u(len(background)), _u(_COLOR * BLOCK)
    for row in range(_u(TILE)):
        base, here, left = row * _u(TILE), every(_f(_i(row))), _u(0)
        for e in range(_u(0), _u(num), _u(LANES)):
            left |= between(first, last, e, _i(row)) << e
            dy = here - load(block, _u(_Y * BLOCK) + e)
            along = load(block, _u(_R * BLOCK) + e) * dy
            offset = load(block, _u(_P * BLOCK) + e) * load(block, _u(_X * BLOCK) + e)
            store(shear, e, load(block, _u(_Q * BLOCK) + e) * dy - offset)
            store(drop, e, load(block, _u(_LOG * BLOCK) + e) - along * along)
        light = load(scratch, base)
        if left == _u(0) or not any_of(light > stop):
            continue
        plane = base + _u(PIXELS)
        c_0th, c_1st, c_2nd, c_3rd = load(scratch, plane), none, none, none
        if channels > _u(1):
            c_1st = load(scratch, plane + _u(PIXELS))
        if channels > _u(2):
            c_2nd = load(scratch, plane + _u(2 * PIXELS))
        if channels > _u(3):
            c_3rd = load(scratch, plane + _u(3 * PIXELS))
        while left != _u(0):
            e = lowest_bit(left)
            left &= left - _u(1)
            across = every(block[_u(_P * BLOCK) + e]) * columns + every(shear[e])
            power = every(drop[e]) - across * across
            alpha = _exp2(power)
            alpha = choose(alpha < highest, alpha, highest)
            alpha = choose(power >= every(block[_u(_LEAST * BLOCK) + e]), alpha, none)
            weight = alpha * choose(light > stop, light, none)
            if marks is not None:
                place = e * _u(2 * LANES)
                store(marks, place, load(marks, place) + weight)
                place += _u(LANES)
                drawn, most = choose(light > stop, alpha, none), load(marks, place)
                store(marks, place, choose(drawn > most, drawn, most))
            light = light - share * weight
            c_0th = c_0th + weight * every(block[color + e])
            if channels > _u(1):
                c_1st = c_1st + weight * every(block[color + _u(BLOCK) + e])
            if channels > _u(2):
                c_2nd = c_2nd + weight * every(block[color + _u(2 * BLOCK) + e])
            if channels > _u(3):
                c_3rd = c_3rd + weight * every(block[color + _u(3 * BLOCK) + e])
            if channels > _u(FEW):
                for c in range(_u(FEW), channels):
                    own = weight * every(block[color + c * _u(BLOCK) + e])
                    store(scratch, plane + c * _u(PIXELS), load(scratch, plane + c * _u(PIXELS)) + own)
        store(scratch, base, light)
        store(scratch, plane, c_0th)
        if channels > _u(1):
            store(scratch, plane + _u(PIXELS), c_1st)
        if channels > _u(2):
            store(scratch, plane + _u(2 * PIXELS), c_2nd)
        if channels > _u(3):
            store(scratch, plane + _u(3 * PIXELS), c_3rd)


@kernel
def _add_marks(listed, marks, statistics):
    """Carry a block's marks over to its entries' (sum of weights, largest alpha), and clear them."""
    for e in range(_u(len(listed))):
        total, most = _f(0.0), _f(0.0)
        for k in range(_u(LANES)):
            total += marks[e * _u(2 * LANES) + k]
            most = max(most, marks[e * _u(2 * LANES) + _u(LANES) + k])
        statistics[listed[e], 0] += total
        statistics[listed[e], 1] = max(statistics[listed[e], 1], most)
    marks[:] = 0.0


@kernel
def _dark(scratch, finished):
    """Whether no pixel of the tile has light left."""
    stop = every(finished)
    lit = False
    for row in range(_u(TILE)):
        lit |= any_of(load(scratch, row * _u(TILE)) > stop)
    return not lit


@kernel
def _write_tile(scratch, background, image, light, top, left):
    height, width = light.shape
    columns = min(TILE, width - left)
    for y in range(min(TILE, height - top)):
        base, out = _u(y * TILE), light[top + y, left : left + columns]
        for x in range(_u(columns)):
            out[x] = scratch[base + x]
        for c in range(len(background)):
            plane, out = _u((c + 1) * PIXELS), image[c, top + y, left : left + columns]
            behind = background[c]
            for x in range(_u(columns)):
                out[x] = scratch[base + plane + x] + scratch[base + x] * behind


@kernel
def _kept_lists(tile_start, listed, used):
    """The lists without what lies behind the splats that took all light, once that is worth a copy."""
    total = 0
    for tile in range(len(used)):
        total += used[tile] - tile_start[tile]
    if 2 * total > len(listed):
        return tile_start, listed, used
    kept, start, stop = np.empty(total, listed.dtype), np.zeros_like(tile_start), np.empty_like(used)
    for tile in range(len(used)):
        stop[tile] = start[tile] + used[tile] - tile_start[tile]
        start[tile + 1] = stop[tile]
        kept[start[tile] : stop[tile]] = listed[tile_start[tile] : used[tile]]
    return start, kept, stop


@inline
def _num_lights(start, stop):
    """Blocks of a tile's list but the first: those whose light at the start is kept for the way back."""
    return max((stop - start + BLOCK - 1) // BLOCK - 1, 0)


@kernel
def forward_row(
    row, row_start, entries, geometry, color, background, over, ceiling, finished, image, light, statistics, marks
):
    """Blend one row of tiles into `image` (channels, height, width) and `light` (height, width).

    `background` is a tuple of up to FEW channels, so that the channels' loop is unrolled, or an array. `statistics`:
    None, or room for the (sum of weights, largest alpha) of every entry; `marks`, zeros, is `_blend`'s.

    Returns the tiles' lists (start, entries within the row, stop), the light of every pixel of a tile at the start
    of each block but the first, tile after tile, and how many entries were listed.
    """
    height, width = light.shape
    top = row * TILE
    entries = entries[row_start[row] : row_start[row + 1]]
    tile_start, listed = _bucket_tiles(geometry, entries, top, height, width)
    num_lights = 0
    for tile in range(len(tile_start) - 1):
        num_lights += _num_lights(tile_start[tile], tile_start[tile + 1])
    used, lights = np.empty(len(tile_start) - 1, np.int64), np.empty((num_lights if over else 0, PIXELS), np.float32)
    scratch, block = _aligned((1 + len(background)) * PIXELS), _aligned((_COLOR + len(background)) * BLOCK)
    first, last = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    shear, drop = _aligned(BLOCK), _aligned(BLOCK)
    if statistics is not None:
        statistics[row_start[row] : row_start[row + 1]] = 0.0
    kept = 0
    for tile in range(len(used)):
        scratch[:] = 0.0
        for y in range(min(TILE, height - top)):  # pixels outside the picture have no light from the start
            for x in range(min(TILE, width - tile * TILE)):
                scratch[y * TILE + x] = 1.0
        used[tile] = tile_start[tile + 1]
        for k in range(tile_start[tile], tile_start[tile + 1], BLOCK):
            if over and k > tile_start[tile]:
                if _dark(scratch, finished):
                    used[tile] = k
                    break
                for p in range(_u(PIXELS)):
                    lights[kept, p] = scratch[p]
                kept += 1
            part = listed[k : min(k + BLOCK, tile_start[tile + 1])]
            _load_block(geometry, color, background, entries, part, _f(tile * TILE), _f(top), block, first, last)
            _blend(len(part), block, first, last, shear, drop, scratch, background, over, ceiling, finished, marks)
            if statistics is not None:
                _add_marks(part, marks, statistics[row_start[row] : row_start[row + 1]])
        _write_tile(scratch, background, image, light, top, tile * TILE)
    return *_kept_lists(tile_start, listed, used), lights[:kept], len(listed)


@kernel
def _list_rows(num, block, first, last, items, shear, drop):
    """Write an item for every pixel row that a splat of the block reaches; returns their number.

    One flat list, since a loop over each splat's own few rows would mispredict its end for every splat.
    """
    stop = _u(0)
    for e in range(_u(num)):
        x, y, log = block[_u(_X * BLOCK) + e], block[_u(_Y * BLOCK) + e], block[_u(_LOG * BLOCK) + e]
        p, q, r = block[_u(_P * BLOCK) + e], block[_u(_Q * BLOCK) + e], block[_u(_R * BLOCK) + e]
        for k in range(_u(TILE)):  # always all 16, one vector: what is too much the next splat writes over
            row = first[e] + _i(k)
            dy = _f(row) - y
            items[stop + k] = (row << _i(8)) | _i(e)
            shear[stop + k] = q * dy - p * x
            drop[stop + k] = log - r * dy * r * dy
        stop += _u(last[e] - first[e])
    return stop


@kernel
def _note(num_items, items, shear, drop, block, scratch, notes, over, ceiling, finished):
    """Walk forward through a block once more, noting alpha and weight of every item; scratch: the light."""
    highest, stop, none, columns = every(ceiling), every(finished), every(_f(0.0)), lanes()
    for n in range(_u(num_items)):
        e, base, note = _u(items[n] & _i(255)), _u(items[n] >> _i(8)) * _u(TILE), n * _u(_NOTES)
        across = every(block[_u(_P * BLOCK) + e]) * columns + every(shear[n])
        power = every(drop[n]) - across * across
        light = load(scratch, base)
        alpha = _exp2(power)
        alpha = choose(alpha < highest, alpha, highest)
        seen = (power >= every(block[_u(_LEAST * BLOCK) + e])) & (light > stop)
        alpha = choose(seen, alpha, none)
        weight = alpha * light
        if over:
            store(scratch, base, light - weight)
        store(notes, note, alpha)
        store(notes, note + _u(LANES), weight)


@kernel
def _unblend(begin, end, items, shear, e, block, scratch, notes, background, over, flat, many, slot):
    """Add the gradient sums of splat e, items begin..end of a tile, to its slot; light from behind moves before it.

    With B the light, times incoming gradient, that one unit of light would bring back from behind the splat,
    dL/dalpha = T (c . g - B): nothing is divided by 1 - alpha, which may be 0. `flat`: the alpha that `_note` capped
    at, from which on it does not follow the exponent. `many`: room for the sums of the channels beyond FEW.
    """
    num, limit, none, columns = _u(len(background)), every(flat), every(_f(0.0)), lanes()
    slant = every(block[_u(_P * BLOCK) + e])
    color = _u(_COLOR * BLOCK) + e
    y, r = block[_u(_Y * BLOCK) + e], block[_u(_R * BLOCK) + e]
    s_1, s_v, s_w, s_vv, s_vw, s_ww = none, none, none, none, none, none
    s_0th, s_1st, s_2nd, s_3rd = none, none, none, none
    if num > _u(FEW):
        for c in range(num - _u(FEW)):
            store(many, c * _u(LANES), none)
    for n in range(begin, end):
        row, note = items[n] >> _i(8), n * _u(_NOTES)
        base = _u(row) * _u(TILE)
        alpha, weight = load(notes, note), load(notes, note + _u(LANES))
        across = slant * columns + every(shear[n])
        plane = base + _u(_G)
        grad = load(scratch, plane)
        own = every(block[color]) * grad
        s_0th = s_0th + weight * grad
        if num > _u(1):
            grad = load(scratch, plane + _u(PIXELS))
            own = own + every(block[color + _u(BLOCK)]) * grad
            s_1st = s_1st + weight * grad
        if num > _u(2):
            grad = load(scratch, plane + _u(2 * PIXELS))
            own = own + every(block[color + _u(2 * BLOCK)]) * grad
            s_2nd = s_2nd + weight * grad
        if num > _u(3):
            grad = load(scratch, plane + _u(3 * PIXELS))
            own = own + every(block[color + _u(3 * BLOCK)]) * grad
            s_3rd = s_3rd + weight * grad
        if num > _u(FEW):
            for c in range(num - _u(FEW)):
                grad = load(scratch, plane + (c + _u(FEW)) * _u(PIXELS))
                own = own + every(block[color + (c + _u(FEW)) * _u(BLOCK)]) * grad
                store(many, c * _u(LANES), load(many, c * _u(LANES)) + weight * grad)
        along = every(r * (_f(row) - y))
        gain = own
        if over:
            behind = load(scratch, base + _u(_BEHIND))
            gain = own - behind
            store(scratch, base + _u(_BEHIND), behind + alpha * gain)
        slope = choose(alpha < limit, weight * gain, none)
        by_v, by_w = slope * across, slope * along
        s_1 = s_1 + slope
        s_v = s_v + by_v
        s_w = s_w + by_w
        s_vv = s_vv + by_v * across
        s_vw = s_vw + by_v * along
        s_ww = s_ww + by_w * along
    pairs = folded(s_1, s_v, 1), folded(s_w, s_vv, 1), folded(s_vw, s_ww, 1), folded(s_0th, s_1st, 1)
    first = folded(folded(pairs[0], pairs[1], 2), folded(pairs[2], pairs[3], 2), 4)
    second = folded(folded(folded(s_2nd, s_3rd, 1), none, 2), none, 4)
    store(slot, _u(0), load(slot, _u(0)) + folded(first, second, 8))
    if num > _u(FEW):
        for c in range(num - _u(FEW)):
            total = _f(0.0)
            for k in range(_u(LANES)):
                total += many[c * _u(LANES) + k]
            slot[_u(_MOMENTS + FEW) + c] += total


@kernel
def backward_row(
    row,
    row_start,
    entries,
    tile_start,
    listed,
    used,
    lights,
    geometry,
    color,
    background,
    over,
    ceiling,
    finished,
    grad_image,
    slots,
):
    """Gradient sums of every entry of one row, into its slots; arguments as `forward_row` took and gave them."""
    channels, (height, width) = len(background), grad_image.shape[1:]
    top = row * TILE
    flat = ceiling * _f(1.0 + 2.0**-23)  # the next float: an alpha at the ceiling itself follows the exponent
    entries, slots = entries[row_start[row] : row_start[row + 1]], slots[row_start[row] : row_start[row + 1]]
    slots[:] = 0.0
    scratch, block = _aligned((2 + channels) * PIXELS), _aligned((_COLOR + channels) * BLOCK)
    size = (BLOCK + 1) * TILE  # with the tail that `_list_rows` writes
    items, shear, drop = np.empty(size, np.int32), np.empty(size, np.float32), np.empty(size, np.float32)
    first, last = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    notes, many = _aligned(BLOCK * TILE * _NOTES), _aligned(max(channels - FEW, 0) * LANES)
    kept = len(lights)
    for tile in range(len(used) - 1, -1, -1):
        left, columns = tile * TILE, min(TILE, width - tile * TILE)
        scratch[_BEHIND:] = 0.0
        for c in range(channels):
            behind = background[c] if over else _f(0.0)
            for y in range(min(TILE, height - top)):
                base, row_of_grad = _u(y * TILE), grad_image[c, top + y, left : left + columns]
                plane = base + _u(_G + c * PIXELS)
                for x in range(_u(columns)):
                    scratch[plane + x] = row_of_grad[x]
                    scratch[base + _u(_BEHIND) + x] += row_of_grad[x] * behind
        start = tile_start[tile]
        for k in range((used[tile] - start - 1) // BLOCK, -1, -1):
            part = listed[start + k * BLOCK : min(start + (k + 1) * BLOCK, used[tile])]
            _load_block(geometry, color, background, entries, part, _f(left), _f(top), block, first, last)
            num_items = _list_rows(len(part), block, first, last, items, shear, drop)
            if over and k > 0:
                kept -= 1
                for p in range(_u(PIXELS)):
                    scratch[p] = lights[kept, p]
            else:
                scratch[:PIXELS] = 1.0
            _note(num_items, items, shear, drop, block, scratch, notes, over, flat, finished)
            end = num_items
            for e in range(len(part) - 1, -1, -1):
                begin = end - _u(last[e] - first[e])
                _unblend(
                    begin, end, items, shear, _u(e), block, scratch, notes, background, over, flat, many, slots[part[e]]
                )
                end = begin


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
    """Sum the slots of splats start..stop and carry the sums back to mean, factor, opacity and colour."""
    c = _f(2.0 * math.log(2.0))
    channels = d_color.shape[1]
    total = np.empty(slots.shape[1], np.float32)
    for i in range(start, stop):
        total[:] = 0.0
        for s in range(first_slot[i], first_slot[i + 1]):
            slot = slots[slot_position[s]]
            for k in range(_u(0), _u(slots.shape[1]), _u(LANES)):
                store(total, k, load(total, k) + load(slot, k))
        for k in range(channels):
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


@kernel
def gather_statistics(start, stop, first_slot, slot_position, statistics, contribution, largest_alpha):
    """Sum the weights and take the largest alpha over the entries of splats start..stop."""
    for i in range(start, stop):
        total, most = _f(0.0), _f(0.0)
        for s in range(first_slot[i], first_slot[i + 1]):
            total += statistics[slot_position[s], 0]
            most = max(most, statistics[slot_position[s], 1])
        contribution[i], largest_alpha[i] = total, most
