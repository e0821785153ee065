"""The CPU engine: Numba kernels over rows of tiles, forward and backward, on a thread pool.

* A *row* is a band of tiles across the image. Splats are bucketed by row in one counting pass, which keeps array
  order, hence depth order, without a sort. Each row is then one task: it buckets its splats by tile, again by counting,
  and composites tile after tile. Rows share no data, so the result does not depend on the number of threads. A small
  image is a single task: a second thread would cost more than it saves.
* Inside a tile only the cells of 4x4 pixels that the splat's cutoff ellipse reaches are visited. A cell is one
  AVX-512 vector (`_numerics.simd`); the exponential is a polynomial and an addition to the exponent's bits.
* The backward pass takes a tile's blocks of 64 splats from back to front, starting from the transmittance stored at the
  start of each block. A block is traversed forward once more, storing alpha and weight of every cell, then backward:
  dL/dalpha_i = T_i (c_i . g - B_i), with B_i the color from behind times the incoming gradient. Nothing is divided by
  1 - alpha, so alpha may be 1. Gradients go to one slot per (splat, row) and are summed per splat afterwards:
  deterministic, without atomics.

Tiles are 16x16: with 8x8 the longer lists cost more than the skipped pixels save.
"""

import dataclasses
import math

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import _cpu_kernels as kernels
from foldgauss.render.splats import RenderOptions, check_size

TILE = kernels.TILE
PIXELS = kernels.PIXELS
MOST_CHANNELS = kernels.MOST_CHANNELS
SPLATS_PER_TASK = 8192
STANDARD = RenderOptions()
#: Estimated nanoseconds to composite one entry of a row of tiles.
ENTRY_NS = 80
#: Estimated nanoseconds to write one pixel.
PIXEL_NS = 1.5
#: Images that take less in total are rendered by a single thread: starting another costs more than it saves.
SINGLE_TASK_NS = 4e5


@dataclasses.dataclass(frozen=True)
class Trace:
    """A rendered image, and what the backward pass needs from the forward pass."""

    image: np.ndarray  # (channels, height, width)
    transmittance: np.ndarray  # (height, width), behind all splats; the image's own alpha is 1 - transmittance
    num_pairs: int  # pixels times splats over the tiles' full lists: the unit in which speed is reported
    inputs: tuple[np.ndarray, ...]  # factor, opacity, color
    geometry: np.ndarray
    buckets: tuple[np.ndarray, ...]  # row_start, entries, first_slot, slot_position
    parts: list[tuple[int, int]]  # first row of tiles and the one after the last, of each task
    lists: list[tuple[np.ndarray, ...]]  # per part: tile_start, listed, used, the transmittances at starts of blocks
    constants: tuple  # background, over, ceiling, stop


def forward(
    mean: np.ndarray,
    factor: np.ndarray,
    opacity: np.ndarray,
    color: np.ndarray,
    background: np.ndarray,
    size: tuple[int, int],
    *,
    compositing: str = "over",
    options: RenderOptions = STANDARD,
) -> Trace:
    """Render float32 splats: shapes (num, 2), (num, 2, 2), (num,), (num, channels), (channels,), in pixels.

    Returns the trace: its `image` is planar, (channels, height, width).
    A splat with a parameter that is not finite is left out and gets no gradient. One kernel is compiled for each
    number of channels, from 1 to 4. Tiles have `TILE` pixels, whatever `options.tile_size`. Raises
    ValueError for a size below 1, and arrays that are not float32 or whose shapes do not match.
    """
    check_size(size)
    _check_leaves(mean, factor, opacity, color, background)
    mean, factor, opacity, color, background = map(_read_only, (mean, factor, opacity, color, background))
    num, channels, over, radius = len(opacity), len(background), compositing == "over", options.support_radius
    chunks, num_rows = range(0, max(num, 1), SPLATS_PER_TASK), -(-size[0] // TILE)
    geometry, span = np.empty((num, 8), np.float32), np.empty((num, 2), np.int32)
    counts = np.zeros((len(chunks), num_rows), np.int64)  # entries by chunk and row of tiles
    cutoffs = np.float32([options.low_pass, options.alpha_cutoff, math.inf if radius is None else radius**2])

    def project(start: int) -> None:
        stop = min(start + SPLATS_PER_TASK, num)
        count = counts[start // SPLATS_PER_TASK]
        kernels.project(start, stop, mean, factor, opacity, color, *size, *cutoffs, geometry, span, count)

    run_tasks(project, chunks)
    # Entries are ordered by row, then by chunk; slots by chunk.
    position = np.append(0, np.cumsum(counts.T))
    fill_from = position[:-1].reshape(counts.T.shape).T.copy(order="C")  # `fill_rows` overwrites it
    slot_from = np.append(0, np.cumsum(counts.sum(1)))
    row_start, first_slot = np.ascontiguousarray(position[:: len(chunks)]), np.empty(num + 1, np.int64)
    entries, slot_position = np.empty(position[-1], np.int32), np.empty(position[-1], np.int64)
    buckets = row_start, entries, first_slot, slot_position

    def fill(start: int) -> None:
        chunk, stop = start // SPLATS_PER_TASK, min(start + SPLATS_PER_TASK, num)
        kernels.fill_rows(start, stop, span, slot_from[chunk], fill_from[chunk], *buckets[1:])

    run_tasks(fill, chunks)
    image, transmittance = np.empty((channels, *size), np.float32), np.empty(size, np.float32)
    constants = (
        tuple(background),
        over,
        np.float32(options.alpha_ceiling),
        np.float32(options.transmittance_stop if over else 0.0),
    )
    small = ENTRY_NS * len(entries) + PIXEL_NS * transmittance.size < SINGLE_TASK_NS
    step = num_rows if small else 1
    parts = [(row, row + step) for row in range(0, num_rows, step)]
    lists: list = [()] * len(parts)

    def composite(part: int) -> None:
        planes = image, transmittance
        lists[part] = kernels.forward_rows(*parts[part], *buckets[:2], geometry, color, *constants, *planes)

    run_tasks(composite, range(len(parts)))
    num_pairs = sum(len(listed) for _, listed, *_ in lists) * PIXELS
    inputs = factor, opacity, color
    return Trace(image, transmittance, num_pairs, inputs, geometry, buckets, parts, lists, constants)


def _check_leaves(mean, factor, opacity, color, background) -> None:
    """Raise unless the shapes match: the kernels check no bounds."""
    names, leaves = "mean, factor, opacity, color, background", (mean, factor, opacity, color, background)
    shapes, dtypes = [np.shape(leaf) for leaf in leaves], {getattr(leaf, "dtype", None) for leaf in leaves}
    num, channels = shapes[2][:1], shapes[4][:1]
    expected = [(*num, 2), (*num, 2, 2), num, (*num, *channels), channels]
    require(
        shapes == expected and num and channels and 0 < channels[0] <= MOST_CHANNELS,
        names,
        expected=f"shapes (num, 2), (num, 2, 2), (num,), (num, channels), (channels,), 1 to {MOST_CHANNELS} channels",
        got=", ".join(map(str, shapes)),
    )
    require(
        dtypes == {np.dtype(np.float32)},
        names,
        expected="float32 NumPy arrays",
        got=", ".join(sorted(str(dtype) for dtype in dtypes)),
    )


def _read_only(array: np.ndarray) -> np.ndarray:
    """A view of the array: Numba would compile the kernels again for arrays that may be written."""
    view = array.view()
    view.flags.writeable = False
    return view


def backward(trace: Trace, grad_image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Gradients of mean, factor, opacity and color, given dL/dimage, planar (channels, height, width).

    That of the background is `background_gradient`. Raises ValueError if `grad_image` does not have the image's shape.
    """
    require(
        grad_image.shape == trace.image.shape,
        "grad_image",
        expected=f"the image's shape {trace.image.shape}",
        got=grad_image.shape,
    )
    grad_image, num, channels = _read_only(grad_image), len(trace.geometry), len(trace.image)
    slots = np.empty((len(trace.buckets[1]), kernels.LANES), np.float32)  # of every (splat, row)
    grads = tuple(np.empty(shape, np.float32) for shape in ((num, 2), (num, 2, 2), (num,), (num, channels)))

    def sum_rows(part: int) -> None:
        rows, splats = (*trace.parts[part], *trace.buckets[:2]), (trace.geometry, trace.inputs[2])
        kernels.backward_rows(*rows, *trace.lists[part], *splats, *trace.constants, grad_image, slots)

    def gather(start: int) -> None:
        stop = min(start + SPLATS_PER_TASK, num)
        kernels.gather(start, stop, *trace.buckets[2:], slots, trace.geometry, *trace.inputs[:2], *grads)

    run_tasks(sum_rows, range(len(trace.parts)))
    run_tasks(gather, range(0, num, SPLATS_PER_TASK))
    return grads


def background_gradient(trace: Trace, grad_image: np.ndarray) -> np.ndarray:
    """The gradient of the background, (channels,), given dL/dimage as for `backward`."""
    return np.einsum("chw,hw->c", grad_image, trace.transmittance, dtype=np.float32)


def raise_screen_gradients(largest: np.ndarray, trace: Trace, d_mean: np.ndarray, indices: np.ndarray) -> None:
    """Raise `largest`, float32, where the positional gradient that densification uses is larger, in place.

    That is |dL/dmean|, with means in units of half the image. `d_mean` is dL/dmean in pixels, (num, 2); splat i is that
    of `largest[indices[i]]`, each at most once. Splats that do not reach the image are left out. The published
    densification splits and clones where the mean over views exceeds a threshold.

    Source: Kerbl et al. 2023, 3D Gaussian Splatting, section 5.2.
    """
    x, y = (d_mean * (np.float32(trace.image.shape[:0:-1]) / 2)).T
    reaches = np.diff(trace.buckets[2]) > 0
    before = largest[indices]
    largest[indices] = np.where(reaches, np.maximum(before, np.sqrt(x * x + y * y)), before)
