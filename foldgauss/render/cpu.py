"""The CPU engine: Numba kernels over rows of tiles, forward and backward, on our own threads.

How a picture is made, and why so:

* A *row* is a band of tiles across the picture. Splats are bucketed by row in one counting pass, which keeps
  array order, hence depth order, with no sort. Each row is then one task: it buckets its splats by tile, again
  counting, and blends tile after tile. Rows share nothing, so any number of threads gives the same bits. Several
  frames are one such heap of rows. A picture that takes less time than a second thread would cost is one task.
* Inside a tile only the cells of 4x4 pixels that the splat's cutoff ellipse reaches are visited, and a cell is
  one AVX-512 vector (`_vectors`), with an exponential made of a polynomial and an addition to the exponent. Before,
  a vector was a row of 16 pixels: a third more of them were visited, for 5 to 10% more time in all.
* The backward pass takes a tile's blocks of 64 splats from back to front, as the light at the start of each block was
  kept. A block is walked forward once more, noting alpha and weight of every cell, then backward with the light
  that comes from behind: dL/dalpha_i = T_i (c_i . g - B_i), which holds for alpha 1 too, since nothing is divided
  by 1 - alpha. Gradients go to one slot per (splat, row) and are summed per splat afterwards: deterministic,
  no atomics.

Tiles are 16x16. Tiles of 8x8 were measured, 20,000 splats on 160x320, one thread, forward / backward: 1.24x / 1.21x
the time for standard deviations of 0.3 to 1 px, 1.41x / 1.41x for 1 to 6 px, 1.65x / 1.49x for 4 to 12 px. What they
save in pixels not visited is less than what the longer lists cost.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from foldgauss._runtime.checks import invalid
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import _cpu_kernels as kernels
from foldgauss.render.splats import RenderOptions, check_size

TILE, PIXELS = kernels.TILE, kernels.PIXELS
CHUNK = 8192  # splats per task where splats, not rows, are shared out
STANDARD = RenderOptions()
#: Nanoseconds, roughly, that it takes to blend an entry of a row of tiles and to write a pixel; and below which in all
#: another thread would cost more than it brings.
ENTRY, PIXEL, SMALL = 80, 1.5, 4e5


class Statistics(NamedTuple):
    """What densification asks of each splat of a picture; (num,) each."""

    contribution: np.ndarray  # sum over pixels of alpha times the light that reaches the splat, in pixels
    largest_alpha: np.ndarray  # where it was drawn; 0 if nowhere


@dataclasses.dataclass(frozen=True)
class Trace:
    """A picture, and what the forward pass leaves for the backward one."""

    image: np.ndarray  # (channels, height, width)
    light: np.ndarray  # (height, width): what is left of the light; the picture's own alpha is 1 - light
    statistics: Statistics | None
    num_pairs: int  # pixels times splats over the tiles' lists as made: the unit that speed is counted in
    inputs: tuple[np.ndarray, ...]  # factor, opacity, color
    geometry: np.ndarray
    buckets: tuple[np.ndarray, ...]  # row_start, entries, first_slot, slot_position
    parts: list[tuple[int, int]]  # first row of tiles and the one after the last, of each task
    lists: list[tuple[np.ndarray, ...]]  # per part: tile_start, listed, used
    lights: list[np.ndarray]  # per part: the light at the start of blocks
    constants: tuple  # background, over, ceiling, finished

    @property
    def seen(self) -> np.ndarray:
        """Which splats reach the picture: (num,), bool."""
        return np.diff(self.buckets[2]) > 0


def check_options(options: RenderOptions) -> None:
    """Raise ValueError for options that this engine does not know."""
    if options.tile_size not in (None, TILE):
        raise invalid(
            "options.tile_size",
            expected=f"None or {TILE} for engine 'cpu'",
            got=options.tile_size,
            cure="Other tiles are slower there; use engine='xla' for them.",
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
    statistics: bool = False,
) -> Trace:
    """Render float32 splats: shapes (num, 2), (num, 2, 2), (num,), (num, channels), (channels,), in pixels.

    Returns the trace: its `image` is planar, (channels, height, width), its `statistics` are there if asked for.
    A splat with a number that is not finite is not drawn and gets no gradient.
    Any number of channels from 1 on; kernels for 1 to 4 are compiled each, one for all others. Raises ValueError for
    a tile size that is not this engine's, a size below 1, and arrays that are not float32 or do not fit together.
    """
    leaves = (mean, factor, opacity, color, background)
    return forward_frames([leaves], size, compositing=compositing, options=options, statistics=statistics)[0]


def forward_frames(
    frames: Sequence[tuple[np.ndarray, ...]],
    size: tuple[int, int],
    *,
    compositing: str = "over",
    options: RenderOptions | None = None,
    statistics: bool = False,
) -> list[Trace]:
    """`forward` of several frames at once, (mean, factor, opacity, color, background) each: fewer waits for threads.

    Raises ValueError as `forward`.
    """
    options = STANDARD if options is None else options
    check_options(options)
    check_size(size)
    for frame in frames:
        _check_leaves(*frame)
    drafts = [_Draft(frame, size, compositing, options, statistics) for frame in frames]
    run_tasks(_call, [(one.project, start) for one in drafts if len(one.chunks) > 1 for start in one.chunks])
    run_tasks(_Draft.bucket, drafts)
    small = sum(one.work for one in drafts) < SMALL
    run_tasks(_call, [(one.blend, part) for one in drafts for part in one.cut(whole=small)], serial=small)
    if statistics:
        run_tasks(_call, [(one.gather, start) for one in drafts for start in one.chunks])
    return [one.trace() for one in drafts]


def _call(task) -> None:
    method, part = task
    method(part)


def _check_leaves(mean, factor, opacity, color, background) -> None:
    """Raise unless the arrays fit together: the kernels check no bounds."""
    leaves = (mean, factor, opacity, color, background)
    shapes, dtypes = [np.shape(leaf) for leaf in leaves], {getattr(leaf, "dtype", None) for leaf in leaves}
    num, channels = shapes[2][:1], shapes[4][:1]
    expected = [(*num, 2), (*num, 2, 2), num, (*num, *channels), channels]
    if shapes != expected or channels == (0,) or not (num and channels):
        raise invalid(
            "mean, factor, opacity, color, background",
            expected="shapes (num, 2), (num, 2, 2), (num,), (num, channels), (channels,), at least one channel",
            got=", ".join(map(str, shapes)),
        )
    if dtypes != {np.dtype(np.float32)}:
        got = ", ".join(sorted(str(dtype) for dtype in dtypes))
        raise invalid("mean, factor, opacity, color, background", expected="float32 NumPy arrays", got=got)


class _Draft:
    """A frame on its way to a `Trace`; the methods in their order, `project`, `blend` and `gather` in parts."""

    def __init__(self, frame, size, compositing, options, statistics) -> None:
        self.mean, self.factor, self.opacity, self.color, background = frame
        self.size, self.options = size, options
        num, channels, over = len(self.opacity), len(background), compositing == "over"
        self.chunks = range(0, num, CHUNK)
        self.num_rows = -(-size[0] // TILE)
        self.geometry, self.span = np.empty((num, 8), np.float32), np.empty((num, 2), np.int32)
        self.image, self.light = np.empty((channels, *size), np.float32), np.empty(size, np.float32)
        self.statistics = Statistics(*np.empty((2, num), np.float32)) if statistics else None
        self.constants = (
            tuple(np.asarray(background, np.float32)) if channels <= kernels.FEW else background,
            over,
            np.float32(options.alpha_ceiling),
            np.float32(options.transmittance_stop if over else 0.0),
        )

    def project(self, start: int) -> None:
        kernels.project(start, min(start + CHUNK, len(self.opacity)), *self._to_project())

    def _to_project(self) -> tuple:
        radius = self.options.support_radius
        low_pass, cutoff = np.float32(self.options.low_pass), np.float32(self.options.alpha_cutoff)
        support = np.float32(math.inf if radius is None else radius**2)
        splats = (self.mean, self.factor, self.opacity, self.color)
        return *splats, *self.size, low_pass, cutoff, support, self.geometry, self.span

    def bucket(self) -> None:
        """List the splats of every row; those of a single chunk are projected here as well."""
        if len(self.chunks) == 1:
            self.buckets = kernels.project_and_bucket(self.num_rows, *self._to_project())
        else:
            self.buckets = kernels.bucket_rows(self.span, self.num_rows)
        self.marks = None if self.statistics is None else np.empty((len(self.buckets[1]), 2), np.float32)

    @property
    def work(self) -> float:
        """Nanoseconds, roughly, that blending takes."""
        return ENTRY * len(self.buckets[1]) + PIXEL * self.light.size

    def cut(self, *, whole: bool) -> range:
        """Part the blending, by rows of tiles or not at all; the parts by number."""
        step = self.num_rows if whole else 1
        self.parts = [(row, row + step) for row in range(0, self.num_rows, step)]
        self.lists: list = [()] * len(self.parts)
        self.lights: list = [None] * len(self.parts)
        self.num_listed = [0] * len(self.parts)
        return range(len(self.parts))

    def blend(self, part: int) -> None:
        room = None if self.marks is None else np.zeros(2 * TILE * kernels.BLOCK, np.float32)
        splats, planes = (self.geometry, self.color), (self.image, self.light)
        *self.lists[part], self.lights[part], self.num_listed[part] = kernels.forward_rows(
            *self.parts[part], *self.buckets[:2], *splats, *self.constants, *planes, self.marks, room
        )

    def gather(self, start: int) -> None:
        stop = min(start + CHUNK, len(self.opacity))
        kernels.gather_statistics(start, stop, *self.buckets[2:], self.marks, *self.statistics)

    def trace(self) -> Trace:
        inputs = (self.factor, self.opacity, self.color)
        made = (inputs, self.geometry, self.buckets, self.parts, self.lists, self.lights, self.constants)
        return Trace(self.image, self.light, self.statistics, sum(self.num_listed) * PIXELS, *made)


def backward(trace: Trace, grad_image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Gradients of mean, factor, opacity, color and background, given dL/dimage, planar (channels, height, width).

    Raises ValueError where that is not the picture's shape.
    """
    return backward_frames([trace], [grad_image])[0]


def backward_frames(traces: Sequence[Trace], grad_images: Sequence[np.ndarray]) -> list[tuple[np.ndarray, ...]]:
    """`backward` of several frames at once; raises ValueError as it does."""
    for trace, grad_image in zip(traces, grad_images, strict=True):
        if grad_image.shape != trace.image.shape:
            raise invalid("grad_image", expected=f"the picture's shape {trace.image.shape}", got=grad_image.shape)
    rooms = ((_slots(trace), _room_for_grads(trace)) for trace in traces)
    jobs = [(trace, grad, *room) for trace, grad, room in zip(traces, grad_images, rooms, strict=True)]

    def unblend(task) -> None:
        (trace, grad_image, slots, _), part = task
        lists, splats = (*trace.lists[part], trace.lights[part]), (trace.geometry, trace.inputs[2])
        rows = (*trace.parts[part], *trace.buckets[:2])
        kernels.backward_rows(*rows, *lists, *splats, *trace.constants, grad_image, slots)

    def gather(task) -> None:
        (trace, _, slots, grads), start = task
        stop = min(start + CHUNK, len(trace.geometry))
        kernels.gather(start, stop, *trace.buckets[2:], slots, trace.geometry, *trace.inputs[:2], *grads)

    run_tasks(unblend, [(job, part) for job in jobs for part in range(len(job[0].parts))])
    run_tasks(gather, [(job, start) for job in jobs for start in range(0, len(job[0].geometry), CHUNK)])
    return [
        (*grads, np.einsum("chw,hw->c", grad_image, trace.light, dtype=np.float32))
        for trace, grad_image, _, grads in jobs
    ]


def _slots(trace: Trace) -> np.ndarray:
    """Room for the gradient sums of every (splat, row)."""
    return np.empty((len(trace.buckets[1]), kernels.slot_width(len(trace.image))), np.float32)


def _room_for_grads(trace: Trace) -> tuple[np.ndarray, ...]:
    num = len(trace.geometry)
    shapes = ((num, 2), (num, 2, 2), (num,), (num, len(trace.image)))
    return tuple(np.empty(shape, np.float32) for shape in shapes)


def screen_gradient(d_mean: np.ndarray) -> np.ndarray:
    """How far a splat is from where it wants to be: |dL/dmean|, (num,), given dL/dmean in pixels, (num, 2).

    The published densification splits and clones where its mean over views exceeds a threshold. There it is in units
    of half the picture: multiply by half the width and height first.

    Source: Kerbl et al. 2023, 3D Gaussian Splatting, section 5.2.
    """
    return np.hypot(d_mean[:, 0], d_mean[:, 1])
