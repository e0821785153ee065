"""What is known of a column of a compact file before its numbers: the contexts that they are coded in.

Both sides walk the columns in their order and come to the same, since all of it follows from columns before.
"""

import numba as nb
import numpy as np
from jaxtyping import Float, Int, Int32, UInt8

from foldgauss.io._range_coder import Column
from foldgauss.video.quantise import COLORS, Facts, Unrolling, in_clip, is_whole, span_of, steps_of

#: Gaussians nearby that say what to expect; candidates for them in each square of a grid; what time counts as length.
NEIGHBOURS, CANDIDATES, TIME = 4, 16, 0.3
_LEVELS = np.array([0.5, 1.5] + [3.0 * 2**k for k in range(13)])

#: Without the liberties that other kernels take with floating-point numbers.
_kernel = nb.njit(nogil=True, cache=True, error_model="numpy")


class Walk:
    """The columns of a file, one after another."""

    def __init__(self, rules: dict, facts: Facts):
        self._facts, self._unrolling = facts, Unrolling(rules, facts)
        self._numbers: dict[str, np.ndarray] = {}
        self._degrees: np.ndarray | None = None

    def column(self, name: str) -> Column:
        """The one that comes next."""
        unrolling, facts = self._unrolling, self._facts
        rows, halves = unrolling.rows(name), unrolling.halves(name)
        if name == "cell" or rows != facts.num_gaussians:
            column = Column.plain(rows)
            near = np.arange(-1, rows - 1, dtype=np.int32)[:, None]
            if name == "cell":
                return column
            return Column(column.present, column.contexts, unrolling.origin(name), steps_of(halves), column.scale, near)
        path = name[0] in "xy"
        near = self._nearest if name in (*COLORS, "shade", "angle") or (path and name[1:] != "0") else self._in_cell
        scale = np.ones(rows)
        for k in range(int(name[1:]) if path else 0):  # not a power, whose last bit libraries do not agree on
            scale = scale * self._half if k else self._half
        origin, steps = unrolling.origin(name), steps_of(halves, name)
        return Column(unrolling.has(name), self._contexts(name, halves), origin, steps, scale, near)

    def add(self, name: str, numbers: Int32[np.ndarray, "rows"]) -> None:
        """Its numbers."""
        unrolling, facts = self._unrolling, self._facts
        self._numbers[name] = numbers
        unrolling.add(name, numbers, unrolling.halves(name))
        if name == "cell":
            self._in_cell = latest_in(numbers, 1 << sum(facts.cells))
        if name == "y0":
            v = unrolling.values
            middle, self._half = span_of(in_clip(v["time"]), v["duration"], facts.reach)
            bits = max(facts.cells[:2]) + 1
            self._nearest = nearest_of(v["x0"], v["y0"], TIME * middle, bits)

    def _contexts(self, name: str, halves: np.ndarray) -> UInt8[np.ndarray, "num 2"]:
        q, classes = self._numbers, self._numbers["class"] & 31 if "class" in self._numbers else 0
        first = (halves >> 1) & 31
        if name in ("class", "lasting"):
            second = classes
        elif name == "degree" or is_whole(name):
            second = classes + 32 * q["lasting"]
        elif name[0] in "xy" and name[1:] != "0":
            k = int(name[1:])
            first = first + 32 * (q["degree"] == k)
            high = level(q[f"x{k}"]) if name[0] == "y" else level(q[f"y{k - 1}"]) if k > 1 else q["degree"]
            low = level(q[f"{name[0]}{k - 1}"]) if k > 1 else q["degree"]
            second = 16 * high + low
        elif name == "blue":
            second = 16 * level(q["luma"])
        elif name == "green":
            second = 16 * level(q["luma"]) + level(q["blue"])
        else:
            second = classes + 32 * q["lasting"]
        return np.stack(np.broadcast_arrays(first, second, halves)[:2], 1).astype(np.uint8)


def level(numbers: Int32[np.ndarray, "num"]) -> Int[np.ndarray, "num"]:
    """The size of numbers: 0, 1, 2, then 3 to 5, 6 to 11 and so on; 15 at most."""
    return np.searchsorted(_LEVELS, np.abs(numbers), side="right")


def latest_in(cell: Int32[np.ndarray, "num"], num_cells: int) -> Int32[np.ndarray, "num 4"]:
    """The last Gaussians before each that are in its cell; where there are none, the one before it. -1: no more."""
    out = np.full((len(cell), NEIGHBOURS), -1, np.int32)
    _latest(cell, np.full(num_cells, -1, np.int32), np.full(len(cell), -1, np.int32), out)
    return out


@_kernel
def _latest(cell, last, before, out):
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


def nearest_of(
    x: Float[np.ndarray, "num"], y: Float[np.ndarray, "num"], time: Float[np.ndarray, "num"], bits: int
) -> Int32[np.ndarray, "num 4"]:
    """The nearest Gaussians before each, among the last ones of its square of a grid and of those around. -1: none."""
    side = 1 << bits
    at = [np.minimum(np.maximum(np.floor((one + 0.5) * side), 0), side - 1).astype(np.int64) for one in (x, y)]
    out = np.full((len(x), NEIGHBOURS), -1, np.int32)
    _nearest(x, y, time, *at, np.full((side, side), -1, np.int32), np.full(len(x), -1, np.int32), CANDIDATES, out)
    return out


@_kernel
def _nearest(x, y, time, column, row, last, before, most, out):
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
