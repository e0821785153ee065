"""The contexts in which the columns of a compact file are entropy-coded.

Encoder and decoder derive them, column by column, from the columns before.
"""

import numpy as np
from jaxtyping import Float, Int, Int32, UInt8

from foldgauss._runtime.kernels import exact_kernel
from foldgauss.video.compression.quantize import (
    COLORS,
    ColumnDecoder,
    CompactInfo,
    Rule,
    clamp_unit,
    compute_steps,
    trajectory_power,
    trajectory_span,
)
from foldgauss.video.compression.range_coder import Column

#: Neighbors that predict a value.
NEIGHBORS = 4
#: Candidates for neighbors in each grid square.
CANDIDATES = 16
#: Weight of time in the distance of neighbors.
TIME_WEIGHT = 0.3
_MAGNITUDE_BOUNDS = np.array([0.5, 1.5] + [3.0 * 2**k for k in range(13)])


class ColumnContexts:
    """The contexts of a chunk's columns in turn: `describe_next` gives a column's, then `add` takes its values.

    `columns` has the values of those that were added.
    """

    def __init__(self, rules: dict[str, Rule], info: CompactInfo, cells: tuple[int, int, int], num: int):
        self._info, self._cells, self._num = info, cells, num
        self._decoder = ColumnDecoder(rules, info, cells, num)
        self.columns: dict[str, np.ndarray] = {}
        self._in_cell = self._nearest = np.zeros((num, 0), np.int32)
        self._half = np.ones(num)

    def describe_next(self, name: str) -> Column:
        """What is known of the next column before its values."""
        decoder = self._decoder
        if name == "cell":
            return Column.without_contexts(self._num)
        halves = decoder.half_exponents(name)
        steps = compute_steps(halves, name)
        known = {"origin": decoder.origin(name, steps), "step": steps}
        power = trajectory_power(name)
        near = self._nearest if power or name in ("angle", *COLORS) else self._in_cell
        scale = np.ones(self._num)
        for _ in range(power):  # not a power, whose last bit libraries do not agree on
            scale = scale * self._half
        contexts = self._contexts(name, power, halves)
        return Column(present=decoder.has(name), contexts=contexts, scale=scale, near=near, **known)

    def add(self, name: str, numbers: Int32[np.ndarray, " num"]) -> None:
        """Record the column's values."""
        decoder, info = self._decoder, self._info
        self.columns[name] = numbers
        decoder.add(name, numbers, decoder.half_exponents(name))
        if name == "cell":
            self._in_cell = find_latest_in_cell(numbers, 1 << sum(self._cells))
        if name == "y0":
            v = decoder.values
            middle, self._half = trajectory_span(clamp_unit(v["time"]), v["duration"], info.reach)
            at = v["x0"], v["y0"], TIME_WEIGHT * middle
            if info.paths is not None:  # within the rectangle of the cells
                (x, y), longer = info.paths.middle, max(info.paths.sides)
                at = (at[0] - x) / longer, (at[1] - y) / longer, at[2] / longer
            self._nearest = find_nearest(*at, max(self._cells[:2]) + 1)

    def _contexts(self, name: str, power: int, halves: np.ndarray) -> UInt8[np.ndarray, "num 2"]:
        """The first and the second context of each value."""
        q, first = self.columns, (halves >> 1) & 31
        if name == "class":
            second = 0
        elif power:
            first = first + 32 * (q["degree"] == power)
            # The preceding value of the other axis, and this axis's of the power below.
            other = f"x{power}" if name[0] == "y" else f"y{power - 1}"
            high = q["degree"] if name == "x1" else quantize_magnitude(q[other])
            low = q["degree"] if power == 1 else quantize_magnitude(q[f"{name[0]}{power - 1}"])
            second = 16 * high + low
        elif name == "blue":
            second = 16 * quantize_magnitude(q["luma"])
        elif name == "green":
            second = 16 * quantize_magnitude(q["luma"]) + quantize_magnitude(q["blue"])
        else:
            second = q["class"] & 31
        return np.stack(np.broadcast_arrays(first, second), 1).astype(np.uint8)


def quantize_magnitude(numbers: Int32[np.ndarray, " num"]) -> Int[np.ndarray, " num"]:
    """Classes of magnitude: 0, 1, 2, then 3 to 5, 6 to 11 and so on; 15 at most."""
    return np.searchsorted(_MAGNITUDE_BOUNDS, np.abs(numbers), side="right")


@exact_kernel
def find_latest_in_cell(cell, num_cells):
    """The latest Gaussians before each in its cell, (num, 4); without any, the one before it. -1: no further one."""
    last, before = np.full(num_cells, -1, np.int32), np.full(len(cell), -1, np.int32)
    out = np.full((len(cell), NEIGHBORS), -1, np.int32)
    for i in range(len(cell)):
        j, count = last[cell[i]], 0
        before[i] = j
        while j >= 0 and count < out.shape[1]:
            out[i, count] = j
            j = before[j]
            count += 1
        if count == 0:
            out[i, 0] = i - 1
        last[cell[i]] = i
    return out


def find_nearest(
    x: Float[np.ndarray, " num"], y: Float[np.ndarray, " num"], time: Float[np.ndarray, " num"], bits: int
) -> Int32[np.ndarray, "num 4"]:
    """The nearest Gaussians before each, among the latest of its grid square and the adjacent ones. -1: none."""
    side = 1 << bits
    at = [np.minimum(np.maximum(np.floor((one + 0.5) * side), 0), side - 1).astype(np.int64) for one in (x, y)]
    out = np.full((len(x), NEIGHBORS), -1, np.int32)
    _find_nearest(x, y, time, *at, np.full((side, side), -1, np.int32), np.full(len(x), -1, np.int32), CANDIDATES, out)
    return out


@exact_kernel
def _find_nearest(x, y, time, column, row, last, before, most, out):
    best = np.empty(out.shape[1])
    for i in range(len(x)):
        best[:] = np.inf
        for c in range(max(column[i] - 1, 0), min(column[i] + 2, last.shape[0])):
            for r in range(max(row[i] - 1, 0), min(row[i] + 2, last.shape[1])):
                j, count = last[c, r], 0
                while j >= 0 and count < most:
                    dx, dy, dt = x[i] - x[j], y[i] - y[j], time[i] - time[j]
                    far = dx * dx + dy * dy + dt * dt
                    place = len(best)
                    while place > 0 and far < best[place - 1]:
                        place -= 1
                    if place < len(best):
                        for k in range(len(best) - 1, place, -1):
                            best[k], out[i, k] = best[k - 1], out[i, k - 1]
                        best[place], out[i, place] = far, j
                    j = before[j]
                    count += 1
        before[i] = last[column[i], row[i]]
        last[column[i], row[i]] = i
