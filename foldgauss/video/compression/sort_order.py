"""Gaussians in an order that is cheap to tell: from cell to cell, wherever which of them covers which does not show.

Two that never overlap may change places without changing any picture. What changing places would cost is measured for
all pairs, on a grid of pixels that moves from frame to frame; pairs that matter keep their order.
"""

import heapq
import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int, Int32

from foldgauss._runtime.kernels import kernel
from foldgauss.video.models.splats import SH_C0
from foldgauss.video.selection.contributions import Contributions

#: Pixels of a frame that are looked at, about: those of a grid; the least distance between them.
_POINTS, _STRIDE = 4000, 2
#: Layers of a pixel that are looked at, from the front; the least light that counts, since what many hide together
#: would else be free to pass each of them; what two add to a pixel, below which they do not cover each other.
_LAYERS, _HIDDEN, _FAINT = 256, 0.2, 0.004
_EMPTY = -1


#: Pairs of Gaussians that cover each other, the front ones and the back ones, and what changing places costs.
Overlaps = tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]


def free_order(cell: Int32[np.ndarray, " num"], found: Overlaps, room: float) -> Int[np.ndarray, " num"]:
    """The numbers of Gaussians in a new order, sweep after sweep through the cells; `found` is of `overlaps`.

    `room`: what the pairs that are let go may add to the squared error, were all of them to change places; colours
    about [0, 1], summed over frames, pixels and channels.
    """
    front, back, cost = found
    cheapest = np.argsort(cost, kind="stable")
    matters = cheapest[np.searchsorted(np.cumsum(cost[cheapest]), room, side="right") :]
    return swept(cell, front[matters], back[matters])


def swept(
    cell: Int32[np.ndarray, " num"], front: Int[np.ndarray, " pairs"], back: Int[np.ndarray, " pairs"]
) -> Int[np.ndarray, " num"]:
    """An order in which every `front` comes before its `back`: of those that may come next the one in the next cell."""
    num, order = len(cell), np.argsort(front, kind="stable")
    start = np.searchsorted(front[order], np.arange(num + 1)).tolist()
    behind, waits = back[order].tolist(), np.bincount(back, minlength=num).tolist()
    cell, out = cell.tolist(), []
    now: list[tuple[int, int]] = []
    after = [(cell[k], k) for k in range(num) if not waits[k]]
    while now or after:
        if not now:
            now, after = after, now
            heapq.heapify(now)
        here, k = heapq.heappop(now)
        out.append(k)
        for j in behind[start[k] : start[k + 1]]:
            waits[j] -= 1
            if not waits[j]:
                if cell[j] >= here:
                    heapq.heappush(now, (cell[j], j))
                else:
                    after.append((cell[j], j))
    return np.array(out)


def overlaps(lit: Contributions) -> Overlaps:
    """Pairs of Gaussians that cover each other, the front one first, and the squared change were they to change places.

    Neighbours in the order at a pixel with opacities a, b and colours differing by d change by a b d times the light
    that reaches them.
    """
    num, (height, width) = lit.num_gaussians, lit.size
    stride = max(_STRIDE, round(math.sqrt(height * width / _POINTS)))
    rows = -(-height // stride), -(-width // stride)
    layers = np.empty((*rows, _LAYERS), np.int32), np.empty((*rows, _LAYERS, 2), np.float32)
    color = np.maximum(0.5 + SH_C0 * np.asarray(lit.model.splats.color_dc, np.float64), 0)
    keys, costs = np.full(1 << 20, _EMPTY, np.int64), np.zeros(1 << 20)
    options, used = lit.model.options, 0
    for k in range(len(lit.times)):
        done, offset = lit.at_frame(k).splats, (k % stride, k // stride % stride)
        light, count = np.ones(rows, np.float32), np.zeros(rows, np.int32)
        seen = np.float32(options.low_pass), np.float32(options.alpha_cutoff)
        _layered(done.mean, done.factor, done.opacity, done.alive, offset, stride, *seen, light, count, *layers)
        begun = [0, 0]
        while begun[0] < rows[0]:
            if 2 * used > len(keys):
                keys, costs = _grown(keys, costs)
            *begun, used = _paired(count, *layers, color, num, keys, costs, begun[0], begun[1], used)
    there = np.flatnonzero(keys != _EMPTY)
    return keys[there] // num, keys[there] % num, costs[there] * stride**2


def _grown(keys: np.ndarray, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    there = np.flatnonzero(keys != _EMPTY)
    more, own = np.full(4 * len(keys), _EMPTY, np.int64), np.zeros(4 * len(keys))
    _moved(keys[there], costs[there], more, own)
    return more, own


@kernel
def _slot(keys, key):
    place = (key * 11400714819323198485 >> 20) & (len(keys) - 1)
    while keys[place] != -1 and keys[place] != key:
        place = (place + 1) & (len(keys) - 1)
    return place


@kernel
def _moved(keys, costs, more, own):
    for k in range(len(keys)):
        place = _slot(more, keys[k])
        more[place], own[place] = keys[k], costs[k]


@kernel
def _layered(mean, factor, opacity, alive, offset, stride, low_pass, cutoff, light, count, who, what):
    """The Gaussians at each pixel of the grid, front to back, with their opacities and the light that reaches them."""
    for k in range(len(alive)):
        a, b, c, d = factor[k, 0, 0], factor[k, 0, 1], factor[k, 1, 0], factor[k, 1, 1]
        xx, xy, yy = a * a + b * b + low_pass, a * c + b * d, c * c + d * d + low_pass
        det = xx * yy - xy * xy
        if det <= 0 or opacity[k] <= cutoff:
            continue
        reach = math.sqrt(2 * math.log(opacity[k] / max(cutoff, np.float32(1e-4))))
        x, y = (mean[k, 0] - 0.5 - offset[0]) / stride, (mean[k, 1] - 0.5 - offset[1]) / stride
        wide, high = reach * math.sqrt(xx) / stride, reach * math.sqrt(yy) / stride
        if not (abs(x) < 1e6 and abs(y) < 1e6):
            continue
        first, last = max(math.ceil(x - wide), 0), min(math.floor(x + wide), light.shape[1] - 1)
        top, bottom = max(math.ceil(y - high), 0), min(math.floor(y + high), light.shape[0] - 1)
        for r in range(top, bottom + 1):
            for q in range(first, last + 1):
                if count[r, q] >= _LAYERS:
                    continue
                dx, dy = (q - x) * stride, (r - y) * stride
                alpha = opacity[k] * math.exp(-0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det)
                if alpha < cutoff:
                    continue
                place = count[r, q]
                who[r, q, place] = alive[k]
                what[r, q, place, 0], what[r, q, place, 1] = alpha, light[r, q]
                count[r, q] = place + 1
                light[r, q] *= 1 - alpha


@kernel
def _paired(count, who, what, color, num, keys, costs, row, column, used):
    """Adds what pairs cost, from a pixel on until the table is half full; where to go on, and how full it is."""
    for r in range(row, count.shape[0]):
        for q in range(column if r == row else 0, count.shape[1]):
            if 2 * used > len(keys):
                return r, q, used
            for i in range(count[r, q]):
                if what[r, q, i, 0] * what[r, q, i, 1] < _FAINT:
                    continue
                for j in range(i + 1, count[r, q]):
                    # The light that reaches the back one, were the other away; but what is hidden by many at once
                    # must not come to light by one after another.
                    light = max(what[r, q, j, 1], _HIDDEN) / max(1 - what[r, q, i, 0], np.float32(0.01))
                    passed = min(light, what[r, q, i, 1])
                    both = what[r, q, i, 0] * what[r, q, j, 0] * passed
                    if both < _FAINT:
                        continue
                    a, b = who[r, q, i], who[r, q, j]
                    apart = 0.0
                    for c in range(3):
                        apart += (color[a, c] - color[b, c]) ** 2
                    key = nb.int64(a) * num + b
                    place = _slot(keys, key)
                    if keys[place] == -1:
                        keys[place] = key
                        used += 1
                    costs[place] += both * both * apart
    return count.shape[0], 0, used
