"""The CPU engine: Numba kernels over rows of tiles, forward and backward, on our own threads.

How a picture is made, and why so:

* A *row* is a band of tiles across the picture. Splats are bucketed by row in one counting pass, which keeps
  array order, hence depth order, with no sort. Each row is then one task: it buckets its splats by tile, again
  counting, and blends tile after tile. Rows share nothing, so any number of threads gives the same bits.
* Inside a tile only the pixel rows that the splat's cutoff ellipse reaches are visited, and a row of 16 pixels is
  one AVX-512 vector. The loops are written for the vectoriser: unsigned indices into one scratch buffer at
  constant offsets, no branches, an exponential made of a polynomial and a bit cast.
* The backward pass walks in the same order as the forward one. With R the colour still to come, colour times
  incoming gradient, dL/dalpha_i = T_i (c_i . g) - R_i / (1 - alpha_i): no per-splat state is stored. Gradients
  go to one slot per (splat, row) and are summed per splat afterwards: deterministic, no atomics.
"""

import dataclasses
import math

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from foldgauss._checks import invalid
from foldgauss._kernels import inline, kernel
from foldgauss._threads import run_tasks
from foldgauss.render.splats import RenderOptions

TILE = 16  # one AVX-512 vector of float32; narrower machines split it themselves
PIXELS = TILE * TILE
CHUNK = 8192  # splats per task where splats, not rows, are shared out
#: (1 - alpha) is divided by in the backward pass; above this ceiling float32 loses the third digit.
HIGHEST_CEILING = 0.999
#: A splat is drawn if its standard deviations, along x at fixed y and along y, are between about 1e-6 and 1e12 px:
#: what is thinner no pixel's centre meets but by design, what is wider float32 cannot follow.
WIDEST, THINNEST = 1e-12, 1e6
#: Ellipses are listed a little too large, so that the alpha test alone decides about a pixel.
SLACK = np.float32(1e-3)

_f, _i, _u = nb.float32, nb.int32, nb.uint64

# Columns of the per-splat geometry. The exponent is kept in powers of two, log2 of the opacity included:
# alpha = 2^(LOG - (P dx + Q dy)^2 - (R dy)^2). Whitened before it is squared: the three terms of the usual conic
# cancel for thin, slanted splats. RX and RY are the half-sizes of the cutoff ellipse's box.
_X, _Y, _P, _Q, _R, _LOG, _RX, _RY = range(8)
# A tile is blended in blocks of splats, whose parameters are laid out one after another: those above without the
# half-sizes, and three colours. Between blocks the tile is left if no light is.
BLOCK, _RED, _BLOCK_PARTS = 64, 6, 9
# Columns of a gradient slot: three colours, then the sums of dL/dalpha * alpha against 1, v, w, v^2, v w, w^2, where
# v = P dx + Q dy and w = R dy: in whitened coordinates the moments of thin splats do not cancel either.
_SLOTS = 9
# Offsets of the planes in the backward scratch: light, incoming gradient, light to come, pixel coordinates.
_G, _REST, _PX, _PY = PIXELS, 4 * PIXELS, 5 * PIXELS, 6 * PIXELS


@intrinsic
def _bits_as_float(typing_context, bits):
    """Reinterpret an int32 as a float32, without going through memory."""

    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@inline
def _exp2(x):
    """2^x for -126 < x <= 0 within 3e-7: polynomial on the fraction in (-1, 0], integer part into the exponent.

    Anything else gives a number without meaning, for the caller to drop.
    """
    whole = _i(x)
    part = x - _f(whole)
    y = _f(9.418212e-4)
    y = y * part + _f(9.197656e-3)
    y = y * part + _f(5.5289872e-2)
    y = y * part + _f(0.24017744)
    y = y * part + _f(0.6931434)
    y = y * part + _f(1.0)
    return y * _bits_as_float((whole + _i(127)) << _i(23))


@kernel
def _project(start, stop, mean, factor, opacity, height, width, low_pass, cutoff, geometry, span):
    """Geometry of splats start..stop and the rows of tiles each one reaches (none: it is not seen)."""
    half_log2e = _f(0.5 * math.log2(math.e))
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
        p, r = math.sqrt(half_log2e * (yy / det)), math.sqrt(half_log2e / yy)
        # Also false for NaN, and for a determinant of 0.
        drawable = p > WIDEST and p < THINNEST and r > WIDEST and r < THINNEST
        if not (drawable and opacity[i] >= cutoff):
            continue
        reach = _f(2.0) * math.log(opacity[i] / cutoff) * (_f(1.0) + SLACK) + SLACK
        radius_x, radius_y = math.sqrt(reach * xx), math.sqrt(reach * yy)
        x, y = mean[i, 0], mean[i, 1]
        seen = x + radius_x > 0.0 and x - radius_x < width and y + radius_y > 0.0 and y - radius_y < height
        if not seen:
            continue
        geometry[i, _X] = x
        geometry[i, _Y] = y
        geometry[i, _P] = p
        geometry[i, _Q] = -xy / yy * p
        geometry[i, _R] = r
        geometry[i, _LOG] = math.log2(opacity[i])
        geometry[i, _RX] = radius_x
        geometry[i, _RY] = radius_y
        # Pixel rows whose centres lie within the radius; clipped before the cast, so no float is too large for it.
        first = math.ceil(max(y - radius_y - _f(0.5), _f(0.0)))
        last = math.floor(min(y + radius_y - _f(0.5), _f(height - 1)))
        if last >= first:
            span[i, 0] = first // TILE
            span[i, 1] = last // TILE + 1


@kernel
def _bucket_rows(span, num_rows):
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


@kernel
def _bucket_tiles(geometry, entries, start, stop, top, height, width, log_cutoff):
    """Exact ellipse-tile test within one row: which tiles each entry reaches, listed by tile in array order."""
    num_tiles = (width + TILE - 1) // TILE
    count = stop - start
    reach = np.empty((count, 2), np.int32)
    tile_start = np.zeros(num_tiles + 1, np.int64)
    upper, lower = _f(top) + _f(0.5), _f(min(top + TILE, height)) - _f(0.5)
    for e in range(count):
        i = entries[start + e]
        p, q, r = geometry[i, _P], geometry[i, _Q], geometry[i, _R]
        x, y, radius = geometry[i, _X], geometry[i, _Y], geometry[i, _RX]
        level = (geometry[i, _LOG] - log_cutoff) * (_f(1.0) + SLACK) + SLACK
        # The ellipse is widest to the right at dy = turn, to the left at -turn; within the band, at the nearest line.
        turn = -p * q * radius / (q * q + r * r)
        right = x + _edge(p, q, r, level, min(max(turn, upper - y), lower - y))
        left = x - _edge(p, -q, r, level, min(max(-turn, upper - y), lower - y))
        first = math.ceil(max(left - _f(0.5), _f(0.0)))
        last = math.floor(min(right - _f(0.5), _f(width - 1)))
        reach[e, 0] = first // TILE
        reach[e, 1] = last // TILE + 1 if last >= first else first // TILE
        for tile in range(reach[e, 0], reach[e, 1]):
            tile_start[tile + 1] += 1
    for tile in range(num_tiles):
        tile_start[tile + 1] += tile_start[tile]
    fill = tile_start.copy()
    listed = np.empty(tile_start[num_tiles], np.int32)
    for e in range(count):
        for tile in range(reach[e, 0], reach[e, 1]):
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
    low = min(max(y - (shear * below + half_below) * inverse, _f(0.0)), _f(TILE))
    high = min(max(y - (shear * above - half_above) * inverse, _f(-1.0)), _f(TILE - 1))
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
def _load_block(geometry, color, entries, listed, left, top, block):
    """The geometry and colours of up to BLOCK splats of a tile, parameter by parameter; positions within the tile."""
    for e in range(_u(len(listed))):
        i = entries[listed[e]]
        block[_X * BLOCK + e] = geometry[i, _X] - left - _f(0.5)
        block[_Y * BLOCK + e] = geometry[i, _Y] - top - _f(0.5)
        block[_P * BLOCK + e] = geometry[i, _P]
        block[_Q * BLOCK + e] = geometry[i, _Q]
        block[_R * BLOCK + e] = geometry[i, _R]
        block[_LOG * BLOCK + e] = geometry[i, _LOG]
        for c in range(_u(3)):
            block[_u(_RED * BLOCK) + c * _u(BLOCK) + e] = color[i, c]


@kernel
def _list_rows(num, block, log_cutoff, first, last, items, shear, drop):
    """Write an item for every pixel row that a splat of the block reaches; returns their number.

    Along a row alpha = 2^(drop - (P column + shear)^2). One flat list, since a loop over each splat's own few rows
    would mispredict its end for every splat.
    """
    for e in range(_u(num)):
        log = block[_u(_LOG * BLOCK) + e]
        first[e], last[e] = _pixel_rows(
            block[_u(_X * BLOCK) + e],
            block[_u(_Y * BLOCK) + e],
            block[_u(_P * BLOCK) + e],
            block[_u(_Q * BLOCK) + e],
            block[_u(_R * BLOCK) + e],
            (log - log_cutoff) * (_f(1.0) + SLACK) + SLACK,
        )
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
        stop += _u(max(last[e] - first[e], _i(0)))
    return stop


@kernel
def _blend(num_items, items, shear, drop, block, scratch, over, log_cutoff, ceiling, finished):
    """Add the listed rows of a block's splats to the tile: scratch holds the light left, then the colours."""
    share = _f(1.0) if over else _f(0.0)
    for n in range(_u(num_items)):
        e, base = _u(items[n] & _i(255)), _u(items[n] >> _i(8)) * _u(TILE)
        p, red = block[_u(_P * BLOCK) + e], block[_u(_RED * BLOCK) + e]
        green, blue = block[_u((_RED + 1) * BLOCK) + e], block[_u((_RED + 2) * BLOCK) + e]
        start, top = shear[n], drop[n]
        for column in range(_u(TILE)):
            across = p * _f(_i(column)) + start
            power = top - across * across
            light = scratch[base + column]
            seen = (power >= log_cutoff) & (light > finished)
            alpha = min(_exp2(power), ceiling)
            weight = alpha * light if seen else _f(0.0)
            scratch[base + column] = light - share * weight
            scratch[base + column + _u(PIXELS)] += weight * red
            scratch[base + column + _u(2 * PIXELS)] += weight * green
            scratch[base + column + _u(3 * PIXELS)] += weight * blue


@kernel
def _dark(scratch, finished):
    """Whether no pixel of the tile has light left."""
    brightest = _f(0.0)
    for p in range(_u(PIXELS)):
        brightest = max(brightest, scratch[p])
    return brightest <= finished


@kernel
def _write_tile(scratch, background, image, light, top, left):
    height, width = light.shape
    columns = min(TILE, width - left)
    for y in range(min(TILE, height - top)):
        base, out = _u(y * TILE), light[top + y, left : left + columns]
        for x in range(_u(columns)):
            out[x] = scratch[base + x]
        for c in range(3):
            plane, out = _u((c + 1) * PIXELS), image[c, top + y, left : left + columns]
            for x in range(_u(columns)):
                out[x] = scratch[base + plane + x] + scratch[base + x] * background[c]


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


@kernel
def _forward_row(
    row, row_start, entries, geometry, color, background, over, log_cutoff, ceiling, finished, image, light
):
    """Blend one row of tiles into `image` (3, height, width) and `light` (height, width); return its lists."""
    height, width = light.shape
    top, start = row * TILE, row_start[row]
    tile_start, listed = _bucket_tiles(geometry, entries, start, row_start[row + 1], top, height, width, log_cutoff)
    used = np.empty(len(tile_start) - 1, np.int64)
    scratch = _aligned(4 * PIXELS)
    block, items = _aligned(_BLOCK_PARTS * BLOCK), np.empty((BLOCK + 1) * TILE, np.int32)
    first, last = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    shear, drop = np.empty((BLOCK + 1) * TILE, np.float32), np.empty((BLOCK + 1) * TILE, np.float32)
    entries = entries[start : row_start[row + 1]]
    for tile in range(len(used)):
        scratch[:PIXELS] = 1.0
        scratch[PIXELS:] = 0.0
        used[tile] = tile_start[tile + 1]
        for k in range(tile_start[tile], tile_start[tile + 1], BLOCK):
            if over and k > tile_start[tile] and _dark(scratch, finished):
                used[tile] = k
                break
            part = listed[k : min(k + BLOCK, tile_start[tile + 1])]
            _load_block(geometry, color, entries, part, _f(tile * TILE), _f(top), block)
            num_items = _list_rows(len(part), block, log_cutoff, first, last, items, shear, drop)
            _blend(num_items, items, shear, drop, block, scratch, over, log_cutoff, ceiling, finished)
        _write_tile(scratch, background, image, light, top, tile * TILE)
    return *_kept_lists(tile_start, listed, used), len(listed)


@kernel
def _unblend(geometry, color, i, left, top, scratch, over, log_cutoff, ceiling, finished, slot):
    """Gradient sums of splat i over one tile, added to its slot; the scratch moves on behind the splat."""
    x, y = geometry[i, _X] - left - _f(0.5), geometry[i, _Y] - top - _f(0.5)
    white_x, white_xy, white_y, log = geometry[i, _P], geometry[i, _Q], geometry[i, _R], geometry[i, _LOG]
    red, green, blue = color[i, 0], color[i, 1], color[i, 2]
    share = _f(1.0) if over else _f(0.0)
    s_red, s_green, s_blue = _f(0.0), _f(0.0), _f(0.0)
    s_1, s_v, s_w, s_vv, s_vw, s_ww = _f(0.0), _f(0.0), _f(0.0), _f(0.0), _f(0.0), _f(0.0)
    level = (log - log_cutoff) * (_f(1.0) + SLACK) + SLACK
    first, last = _pixel_rows(x, y, white_x, white_xy, white_y, level)
    base = _u(first * _i(TILE))
    for k in range(_u((last - first) * _i(TILE) if last > first else _i(0))):
        p = base + k
        dx, dy = scratch[p + _u(_PX)] - x, scratch[p + _u(_PY)] - y
        across, along = white_x * dx + white_xy * dy, white_y * dy
        power = log - across * across - along * along
        light = scratch[p]
        seen = (power >= log_cutoff) & (light > finished)
        alpha = min(_exp2(power), ceiling) if seen else _f(0.0)
        g_red, g_green, g_blue = (
            scratch[p + _u(_G)],
            scratch[p + _u(_G + PIXELS)],
            scratch[p + _u(_G + 2 * PIXELS)],
        )
        own = red * g_red + green * g_green + blue * g_blue
        weight = alpha * light
        behind = scratch[p + _u(_REST)] - share * weight * own
        scratch[p + _u(_REST)] = behind
        scratch[p] = light - share * weight
        slope = (light * own - share * behind / (_f(1.0) - alpha)) * alpha
        slope = slope if alpha < ceiling else _f(0.0)
        s_red += weight * g_red
        s_green += weight * g_green
        s_blue += weight * g_blue
        s_1 += slope
        s_v += slope * across
        s_w += slope * along
        s_vv += slope * across * across
        s_vw += slope * across * along
        s_ww += slope * along * along
    slot[0] += s_red
    slot[1] += s_green
    slot[2] += s_blue
    slot[3] += s_1
    slot[4] += s_v
    slot[5] += s_w
    slot[6] += s_vv
    slot[7] += s_vw
    slot[8] += s_ww


@kernel
def _backward_row(
    row,
    row_start,
    entries,
    tile_start,
    listed,
    used,
    geometry,
    color,
    over,
    log_cutoff,
    ceiling,
    finished,
    image,
    grad_image,
    slots,
):
    """Gradient sums of every entry of one row, into its slots."""
    height, width = image.shape[1:]
    top, start = row * TILE, row_start[row]
    slots[start : row_start[row + 1]] = 0.0
    scratch = _aligned(7 * PIXELS)
    for p in range(PIXELS):
        scratch[_PX + p] = p % TILE
        scratch[_PY + p] = p // TILE
    for tile in range(len(used)):
        left = tile * TILE
        scratch[:PIXELS] = 1.0
        scratch[_G:_PX] = 0.0
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                p = y * TILE + x
                for c in range(3):
                    g = grad_image[c, top + y, left + x]
                    scratch[_G + c * PIXELS + p] = g
                    if over:
                        scratch[_REST + p] += g * image[c, top + y, left + x]
        for k in range(tile_start[tile], used[tile]):
            e = start + listed[k]
            _unblend(
                geometry,
                color,
                entries[e],
                _f(left),
                _f(top),
                scratch,
                over,
                log_cutoff,
                ceiling,
                finished,
                slots[e],
            )


@kernel
def _gather(
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
    total = np.empty(_SLOTS, np.float32)
    for i in range(start, stop):
        total[:] = 0.0
        for s in range(first_slot[i], first_slot[i + 1]):
            for k in range(_SLOTS):
                total[k] += slots[slot_position[s], k]
        d_color[i, 0], d_color[i, 1], d_color[i, 2] = total[0], total[1], total[2]
        if first_slot[i] == first_slot[i + 1]:
            d_opacity[i] = 0.0
            d_mean[i] = 0.0
            d_factor[i] = 0.0
            continue
        # With W = [[P, Q], [0, R]]: Sigma^-1 = c W^T W, dL/dmean = c W^T (v, w), dL/dF = c^2 W^T M W F, M the
        # second moments of (v, w).
        p, q, r = geometry[i, _P], geometry[i, _Q], geometry[i, _R]
        d_opacity[i] = total[3] / opacity[i]
        d_mean[i, 0] = c * p * total[4]
        d_mean[i, 1] = c * (q * total[4] + r * total[5])
        for k in range(2):
            v = c * (p * factor[i, 0, k] + q * factor[i, 1, k])
            w = c * r * factor[i, 1, k]
            by_v = total[6] * v + total[7] * w
            by_w = total[7] * v + total[8] * w
            d_factor[i, 0, k] = c * p * by_v
            d_factor[i, 1, k] = c * (q * by_v + r * by_w)


@dataclasses.dataclass(frozen=True)
class Trace:
    """What the forward pass leaves for the backward one."""

    inputs: tuple[np.ndarray, ...]  # factor, opacity, color
    geometry: np.ndarray
    buckets: tuple[np.ndarray, ...]  # row_start, entries, first_slot, slot_position
    lists: list  # per row: tile_start, listed, used
    constants: tuple  # over, log_cutoff, ceiling, finished
    image: np.ndarray  # (3, height, width)
    light: np.ndarray  # (height, width)
    num_pairs: int  # pixels times splats over the tiles' lists as made: the unit that speed is counted in


def check_options(options: RenderOptions) -> None:
    """Raise ValueError for options that this engine cannot keep its accuracy with."""
    if options.alpha_ceiling > HIGHEST_CEILING:
        raise invalid(
            "options.alpha_ceiling",
            expected=f"at most {HIGHEST_CEILING} for engine 'cpu'",
            got=options.alpha_ceiling,
            cure="Use engine='reference' for more.",
        )


def forward(
    mean: np.ndarray,
    factor: np.ndarray,
    opacity: np.ndarray,
    color: np.ndarray,
    background: np.ndarray,
    size: tuple[int, int],
    *,
    compositing: str = "over",
    options: RenderOptions | None = None,
) -> Trace:
    """Render float32 splats: shapes (num, 2), (num, 2, 2), (num,), (num, 3), (3,), in pixels.

    Returns the trace, whose `image` is planar, (3, height, width).
    """
    options = RenderOptions() if options is None else options
    check_options(options)
    (height, width), num = size, len(opacity)
    geometry, span = np.empty((num, 8), np.float32), np.empty((num, 2), np.int32)
    low_pass, cutoff = np.float32(options.low_pass), np.float32(options.alpha_cutoff)

    def project(start: int) -> None:
        stop = min(start + CHUNK, num)
        _project(start, stop, mean, factor, opacity, height, width, low_pass, cutoff, geometry, span)

    run_tasks(project, range(0, num, CHUNK))
    num_rows = -(-height // TILE)
    buckets = _bucket_rows(span, num_rows)
    constants = (
        compositing == "over",
        np.float32(math.log2(options.alpha_cutoff)),
        np.float32(options.alpha_ceiling),
        np.float32(options.transmittance_stop if compositing == "over" else -1.0),
    )
    image, light = np.empty((3, height, width), np.float32), np.empty((height, width), np.float32)
    lists: list = [[] for _ in range(num_rows)]
    num_listed = np.zeros(num_rows, np.int64)

    def blend(row: int) -> None:
        *lists[row], num_listed[row] = _forward_row(
            row, *buckets[:2], geometry, color, background, *constants, image, light
        )

    run_tasks(blend, range(num_rows))
    return Trace(
        (factor, opacity, color), geometry, buckets, lists, constants, image, light, int(num_listed.sum()) * PIXELS
    )


def backward(trace: Trace, grad_image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Gradients of mean, factor, opacity, color and background, given dL/dimage, planar (3, height, width)."""
    factor, opacity, color = trace.inputs
    row_start, entries, first_slot, slot_position = trace.buckets
    num, slots = len(opacity), np.empty((len(entries), _SLOTS), np.float32)

    def unblend(row: int) -> None:
        _backward_row(
            row,
            row_start,
            entries,
            *trace.lists[row],
            trace.geometry,
            color,
            *trace.constants,
            trace.image,
            grad_image,
            slots,
        )

    run_tasks(unblend, range(len(trace.lists)))
    grads = np.empty((num, 2), np.float32), np.empty((num, 2, 2), np.float32)
    grads += np.empty(num, np.float32), np.empty((num, 3), np.float32)

    def gather(start: int) -> None:
        stop = min(start + CHUNK, num)
        _gather(start, stop, first_slot, slot_position, slots, trace.geometry, factor, opacity, *grads)

    run_tasks(gather, range(0, num, CHUNK))
    return *grads, np.einsum("chw,hw->c", grad_image, trace.light, dtype=np.float32)
