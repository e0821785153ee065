"""Reorders Gaussians by cell, which compresses well, where the compositing order hardly matters.

Two Gaussians that never overlap may be swapped without changing any image. The error of a swap is measured for all
overlapping pairs, on a grid of pixels that moves from frame to frame; pairs whose swap would be visible keep their
order.
"""

import heapq
import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int, Int32

from foldgauss._runtime.kernels import kernel
from foldgauss.video.models.splats import SH_C0
from foldgauss.video.selection.contributions import Contributions

#: About how many pixels of a frame are sampled, on a grid.
_POINTS = 4000
#: The least spacing of that grid, in pixels.
_STRIDE = 2
#: Layers of a pixel that are examined, from the front.
_LAYERS = 256
#: Least transmittance that is assumed: otherwise a Gaussian behind many could be swapped with each of them at no cost.
_MIN_TRANSMITTANCE = 0.2
#: Product of alphas and transmittance below which two Gaussians do not overlap.
_FAINT = 0.004
_EMPTY = -1


#: Overlapping pairs of Gaussians: the front ones, the back ones, and the error of swapping them.
Overlaps = tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]


def sort_by_cell(cell: Int32[np.ndarray, " num"], overlaps: Overlaps, budget: float) -> Int[np.ndarray, " num"]:
    """Indices of the Gaussians in a new order, in sweeps through the cells; `overlaps` is from `find_overlaps`.

    `budget`: the squared error allowed if all pairs whose order is given up were swapped; colors in [0, 1], summed
    over frames, pixels and channels.
    """
    front, back, cost = overlaps
    cheapest = np.argsort(cost, kind="stable")
    matters = cheapest[np.searchsorted(np.cumsum(cost[cheapest]), budget, side="right") :]
    return sort_constrained(cell, front[matters], back[matters])


def sort_constrained(
    cell: Int32[np.ndarray, " num"], front: Int[np.ndarray, " pairs"], back: Int[np.ndarray, " pairs"]
) -> Int[np.ndarray, " num"]:
    """An order with every `front` before its `back`; among the Gaussians that may come next, that of the next cell."""
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


def find_overlaps(contributions: Contributions) -> Overlaps:
    """Overlapping pairs of Gaussians, the front one first, and the squared error of swapping them.

    A pixel where two neighbors in the order have alphas a, b and colors that differ by d changes by a b d times the
    transmittance in front of them.
    """
    num, (height, width) = contributions.num_gaussians, contributions.size
    stride = max(_STRIDE, round(math.sqrt(height * width / _POINTS)))
    rows = -(-height // stride), -(-width // stride)
    layers = np.empty((*rows, _LAYERS), np.int32), np.empty((*rows, _LAYERS, 2), np.float32)
    color = np.maximum(0.5 + SH_C0 * np.asarray(contributions.model.splats.color_dc, np.float64), 0)
    keys, costs = np.full(1 << 20, _EMPTY, np.int64), np.zeros(1 << 20)
    options, used = contributions.model.options, 0
    for k in range(len(contributions.times)):
        done, offset = contributions.at_frame(k).splats, (k % stride, k // stride % stride)
        transmittance, count = np.ones(rows, np.float32), np.zeros(rows, np.int32)
        seen = np.float32(options.low_pass), np.float32(options.alpha_cutoff)
        _list_layers(
            done.mean, done.factor, done.opacity, done.alive, offset, stride, *seen, transmittance, count, *layers
        )
        position = [0, 0]
        while position[0] < rows[0]:
            if 2 * used > len(keys):
                keys, costs = _enlarge(keys, costs)
            *position, used = _add_costs(count, *layers, color, num, keys, costs, position[0], position[1], used)
    used_slots = np.flatnonzero(keys != _EMPTY)
    return keys[used_slots] // num, keys[used_slots] % num, costs[used_slots] * stride**2


def _enlarge(keys: np.ndarray, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used_slots = np.flatnonzero(keys != _EMPTY)
    more, own = np.full(4 * len(keys), _EMPTY, np.int64), np.zeros(4 * len(keys))
    _rehash(keys[used_slots], costs[used_slots], more, own)
    return more, own


@kernel
def _slot(keys, key):
    place = (key * 11400714819323198485 >> 20) & (len(keys) - 1)
    while keys[place] != -1 and keys[place] != key:
        place = (place + 1) & (len(keys) - 1)
    return place


@kernel
def _rehash(keys, costs, more, own):
    for k in range(len(keys)):
        place = _slot(more, keys[k])
        more[place], own[place] = keys[k], costs[k]


@kernel
def _list_layers(mean, factor, opacity, alive, offset, stride, low_pass, cutoff, transmittance, count, index, layer):
    """Append Gaussians to the layers of each pixel of the grid, front to back: indices, alphas, transmittances."""
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
        first, last = max(math.ceil(x - wide), 0), min(math.floor(x + wide), transmittance.shape[1] - 1)
        top, bottom = max(math.ceil(y - high), 0), min(math.floor(y + high), transmittance.shape[0] - 1)
        for r in range(top, bottom + 1):
            for q in range(first, last + 1):
                if count[r, q] >= _LAYERS:
                    continue
                dx, dy = (q - x) * stride, (r - y) * stride
                alpha = opacity[k] * math.exp(-0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det)
                if alpha < cutoff:
                    continue
                place = count[r, q]
                index[r, q, place] = alive[k]
                layer[r, q, place, 0], layer[r, q, place, 1] = alpha, transmittance[r, q]
                count[r, q] = place + 1
                transmittance[r, q] *= 1 - alpha


@kernel
def _add_costs(count, index, layer, color, num, keys, costs, row, column, used):
    """Add the errors of pairs, pixel by pixel, until the table is half full; returns the next pixel and the fill."""
    for r in range(row, count.shape[0]):
        for q in range(column if r == row else 0, count.shape[1]):
            if 2 * used > len(keys):
                return r, q, used
            for i in range(count[r, q]):
                if layer[r, q, i, 0] * layer[r, q, i, 1] < _FAINT:
                    continue
                for j in range(i + 1, count[r, q]):
                    # The transmittance in front of the back one without the other, at least `_MIN_TRANSMITTANCE`.
                    behind = max(layer[r, q, j, 1], _MIN_TRANSMITTANCE) / max(1 - layer[r, q, i, 0], np.float32(0.01))
                    passed = min(behind, layer[r, q, i, 1])
                    both = layer[r, q, i, 0] * layer[r, q, j, 0] * passed
                    if both < _FAINT:
                        continue
                    a, b = index[r, q, i], index[r, q, j]
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
