"""What the CPU engine is held against on equal pairs: the plain loop in Numba, and both loops in C++.

The C++ kernels (`rasterizer_kernel.cpp`) are compiled on the spot, `g++ -O3 -march=native -ffast-math`, and called
through ctypes. All rivals are serial and get their lists for nothing.
"""

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks._common import Scene
from foldgauss._numerics.simd import broadcast, exp2, lane_indices, load, select, store
from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import RenderOptions, _cpu_kernels, cpu
from foldgauss.render._cpu_kernels import _f, _i, _u

SOURCE = Path(__file__).with_name("rasterizer_kernel.cpp")
FLAGS = ("-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512", "-std=c++17", "-shared", "-fPIC")
_TILE, _PIXELS, _aligned = _cpu_kernels.TILE, _cpu_kernels.PIXELS, _cpu_kernels._aligned_empty


class Lists(NamedTuple):
    """Tile t, row by row, lists splats listed[start[t] : start[t + 1]], front to back."""

    start: np.ndarray  # int64
    listed: np.ndarray  # int32


def own_lists(trace: cpu.Trace) -> Lists:
    """The engine's lists; what lies behind the last light may have been cut from them."""
    row_start, entries, _, _ = trace.buckets
    lengths = [np.diff(start) for start, _, _ in trace.lists]
    parts = zip(trace.parts, trace.lists, strict=True)
    listed = [entries[row_start[first] + listed] for (first, _), (_, listed, _) in parts]
    return Lists(np.concatenate([[0], np.cumsum(np.concatenate(lengths))]), np.concatenate(listed))


def box_lists(first: np.ndarray, last: np.ndarray, size: tuple[int, int]) -> Lists:
    """Lists by bounding box: splat i is in the tiles first[i] <= (column, row) < last[i]."""
    across, down = (-(-length // _TILE) for length in (size[1], size[0]))
    shape = (last - first).astype(np.int64)
    splat = np.repeat(np.arange(len(first)), shape.prod(axis=1))
    own = np.arange(len(splat)) - np.repeat(np.cumsum(shape.prod(axis=1)) - shape.prod(axis=1), shape.prod(axis=1))
    column, row = first[splat, 0] + own % shape[splat, 0], first[splat, 1] + own // shape[splat, 0]
    tile = (row * across + column).astype(np.int64)
    order = np.argsort(tile, kind="stable")
    return Lists(np.searchsorted(tile[order], np.arange(across * down + 1)), splat[order].astype(np.int32))


class Planes(NamedTuple):
    """A picture of three channels, (3, height, width), and the light left."""

    image: np.ndarray
    light: np.ndarray

    @classmethod
    def of_size(cls, size: tuple[int, int]) -> "Planes":
        return cls(np.zeros((3, *size), np.float32), np.zeros(size, np.float32))


@kernel
def _plain(start, listed, geometry, color, background, ceiling, finished, image, light):
    width = light.shape[1]
    across = (width + _TILE - 1) // _TILE
    scratch = _aligned(4 * _PIXELS)
    highest, stop, none, columns = broadcast(ceiling), broadcast(finished), broadcast(_f(0.0)), lane_indices()
    for tile in range(len(start) - 1):
        left, top = tile % across * _TILE, tile // across * _TILE
        scratch[:_PIXELS] = 1.0
        scratch[_PIXELS:] = 0.0
        for k in range(start[tile], start[tile + 1]):
            i = listed[k]
            x, y = geometry[i, 0] - _f(left) - _f(0.5), geometry[i, 1] - _f(top) - _f(0.5)
            p, q, r = geometry[i, 2], geometry[i, 3], geometry[i, 4]
            log, least = geometry[i, 5], broadcast(geometry[i, 6])
            for row in range(_u(_TILE)):
                base, dy = row * _u(_TILE), _f(_i(row)) - y
                along = broadcast(p) * columns + broadcast(q * dy - p * x)
                power = broadcast(log - r * dy * r * dy) - along * along
                alpha, here = exp2(power), load(scratch, base)
                alpha = select(power >= least, select(alpha < highest, alpha, highest), none)
                weight = alpha * select(here > stop, here, none)
                store(scratch, base, here - weight)
                for c in range(_u(3)):
                    plane = base + (c + _u(1)) * _u(_PIXELS)
                    store(scratch, plane, load(scratch, plane) + weight * broadcast(color[i, c]))
        _write_rows(scratch, background, image, light, top, left)


@kernel
def _write_rows(scratch, background, image, light, top, left):
    """`_cpu_kernels._write_tile` for a tile that is kept row by row."""
    height, width = light.shape
    columns = min(_TILE, width - left)
    for y in range(min(_TILE, height - top)):
        base, out = _u(y * _TILE), light[top + y, left : left + columns]
        for x in range(_u(columns)):
            out[x] = scratch[base + x]
        for c in range(_u(len(background))):
            plane, out = (c + _u(1)) * _u(_PIXELS), image[c, top + y, left : left + columns]
            behind = background[c]
            for x in range(_u(columns)):
                out[x] = scratch[base + plane + x] + scratch[base + x] * behind


def plain_numba(lists: Lists, trace: cpu.Trace, planes: Planes) -> None:
    """Every pixel of every listed pair, in Numba with the engine's own vectors and exponential."""
    background, _, ceiling, finished = trace.constants
    _plain(*lists, trace.geometry, trace.inputs[2], background, ceiling, finished, *planes)


@kernel
def _list_boxes(first, last, across, num_tiles):
    """Counting pass over the tiles first[i] <= (column, row) < last[i] of every splat."""
    start = np.zeros(num_tiles + 1, np.int64)
    for i in range(len(first)):
        for row in range(first[i, 1], last[i, 1]):
            for column in range(first[i, 0], last[i, 0]):
                start[row * across + column + 1] += 1
    for tile in range(num_tiles):
        start[tile + 1] += start[tile]
    fill, listed = start.copy(), np.empty(start[num_tiles], np.int32)
    for i in range(len(first)):
        for row in range(first[i, 1], last[i, 1]):
            for column in range(first[i, 0], last[i, 0]):
                listed[fill[row * across + column]] = i
                fill[row * across + column] += 1
    return start, listed


@kernel
def _boxes(geometry, span, across, first, last):
    """The tiles of every splat's bounding box, from the turn and the rows that the engine's projection gave."""
    for i in range(len(span)):
        if span[i, 1] <= span[i, 0]:
            first[i], last[i] = 0, 0
            continue
        own = geometry[i]
        radius = _cpu_kernels._right_edge(own[2], own[3], own[4], _cpu_kernels._level(own[5], own[6]), own[7])
        left, right = own[0] - radius, own[0] + radius
        first[i, 0] = min(max(left, _f(0.0)) / _f(_TILE), _f(across))
        last[i, 0] = min(max(right, _f(0.0)) / _f(_TILE) + _f(1.0), _f(across))
        first[i, 1], last[i, 1] = span[i, 0], span[i, 1]


def plain_image(scene: Scene, trace: cpu.Trace) -> Planes:
    """A whole image the textbook way: projection, lists by bounding box, every pixel of every listed pair."""
    draft = cpu._ForwardPass(scene.leaves, scene.size, "over", RenderOptions(), False)
    run_tasks(draft.project, draft.chunks)
    across, down = -(-scene.size[1] // _TILE), -(-scene.size[0] // _TILE)
    first, last = np.empty((len(draft.span), 2), np.int32), np.empty((len(draft.span), 2), np.int32)
    _boxes(draft.geometry, draft.span, across, first, last)
    planes = Planes(np.empty((3, *scene.size), np.float32), np.empty(scene.size, np.float32))
    plain_numba(Lists(*_list_boxes(first, last, across, across * down)), trace, planes)
    return planes


class Compiled:
    """The C++ kernels `plain` and `exact`, by name."""

    def __init__(self, folder: Path) -> None:
        library = folder / "rasterizer_kernel.so"
        subprocess.run(["g++", *FLAGS, str(SOURCE), "-o", str(library)], check=True)
        self._library = ctypes.CDLL(str(library))

    def __call__(self, name: str, lists: Lists, trace: cpu.Trace, planes: Planes) -> None:
        background, _, ceiling, finished = trace.constants
        arrays = (*lists, trace.geometry, trace.inputs[2], np.asarray(background, np.float32))
        assert [array.dtype.name for array in arrays] == ["int64", "int32", "float32", "float32", "float32"]
        sizes = (ctypes.c_int(length) for length in planes.light.shape)
        constants = (ctypes.c_float(value) for value in (ceiling, finished))
        getattr(self._library, name)(*sizes, *map(_pointer, arrays), *constants, *map(_pointer, planes))


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return array.ctypes.data_as(ctypes.c_void_p)


def has_compiler() -> bool:
    return shutil.which("g++") is not None
