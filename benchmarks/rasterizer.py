"""Speed of the rasterisers: `cpu` against the dense `reference` and a plain XLA tile loop.

    python -m benchmarks.rasterizer [--json FILE] [--rounds 7] [--scene 20k|100k]

Scenes: 20k random splats at 160x320 and 100k at 640x1280 (`_common.random_scene`), compositing "over". A
*pair* is one pixel of one 16x16 tile times one Gaussian listed there; figures count the CPU engine's own
lists (exact ellipse-tile tests: fewer pairs than bounding boxes, so the stricter unit), the table gives both.

Timed: wall seconds of a whole call from float32 NumPy (cpu) or device (XLA) arrays to finished results,
median over rounds that run all engines in turn. Listing and binning count for `cpu`; the XLA loops get
their lists for nothing. XLA uses all cores, `cpu` is timed with one thread and with all. Backward is the
gradient of <image, g> by mean, factor, opacity, colour and background, the forward pass included. The
reference is dense, so it draws only as many splats as make about 1e7 pairs of its own, pixels times splats.
Engines must agree: see `check_agreement`.

`xla` blends all tiles at once from lists by bounding box (the plain loop; forward only, its backward would keep
some GB). Two stronger forms stand beside it: `xla exact` takes `cpu`'s exact lists, `xla by row` those too and
one row of tiles after another, kinder to the cache.

What bounds `cpu`: per 16 pixels visited (the pixel rows of a tile that the ellipse reaches, until the tile is
opaque), as LLVM 20 compiles it for AVX-512, forward takes 24 vector instructions (13 multiply-adds), 4 loads
and 4 stores; backward about 50 (28 multiply-adds, one division), 9 loads and 2 stores. A core that starts one
512-bit multiply-add per cycle (Zen 4) cannot go below 0.8 cycles per visited pair forward and 1.8 more
backward: 0.23 and 0.5 ns at 3.5 GHz on one thread. Beside them stand the listing (projection, bucketing by
row and tile) and the latency of short loops.
"""

import functools
import statistics
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from benchmarks._common import Scene, Task, console, interleaved, random_scene
from benchmarks._xla_tiles import TileLists, box_lists, render_tiles, tile_lists
from foldgauss._threads import available_cores, run_tasks, set_num_threads
from foldgauss.render import RenderOptions, Splats2D, cpu, render

SCENES = {"20k": (20_000, (160, 320)), "100k": (100_000, (640, 1280))}
COLUMNS = ("engine", "pass", "ms", "best ms", "ns/pair, own lists", "ns/pair, boxes", "ns/visited")
REFERENCE_PAIRS = 1e7  # some 0.1 s a call
#: Largest difference between two engines, and the share of the pixels that may exceed it: where a splat is at
#: the very cutoff (alpha 1/255), rounding decides whether an engine draws it.
TOLERANCE, CUTOFF_SHARE = 1e-4, 1e-5


class Pairs(NamedTuple):
    """Pairs of a scene, counted in four ways."""

    boxes: int  # in tiles touched by the bounding box of the cutoff ellipse
    listed: int  # in the engine's lists
    visited: int  # on pixel rows that the engine's loop runs over
    above: int  # with alpha above the cutoff, whatever light is left


class Case(NamedTuple):
    """A scene with its trace, and the number of pairs each engine is charged for."""

    scene: Scene
    trace: cpu.Trace
    pairs: Pairs
    reference_splats: int


def make_case(name: str) -> Case:
    num, size = SCENES[name]
    scene = random_scene(num, size, f"{name}_{size[0]}x{size[1]}")
    trace = cpu.forward(*scene.leaves, size)
    kept = max(1, round(REFERENCE_PAIRS / (size[0] * size[1])))
    return Case(scene, trace, count_pairs(scene, trace), kept)


# -------------------------------------------------------------------------------------------- counting


def count_pairs(scene: Scene, trace: cpu.Trace) -> Pairs:
    """Count on the host, from the splats' own formulas."""
    lists = tile_lists(trace, by_row=False)
    position, tile = np.nonzero(lists.listed[0] >= 0)
    splat = lists.listed[0, position, tile]
    left, top = lists.left[0, tile], lists.top[0, tile]
    used = np.concatenate([used - start[:-1] for start, _, used in trace.lists])
    mean, opacity = scene.leaves[0], scene.leaves[2]
    conic, above = np.linalg.inv(_covariance(scene)), 0
    rows = _num_rows(mean[splat], conic[splat], _reach(scene)[splat], left, top) * (position < used[tile])
    for part in np.array_split(np.arange(len(splat)), -(-len(splat) // 20_000)):
        i = splat[part]
        above += _num_above(mean[i], conic[i], opacity[i], left[part], top[part])
    return Pairs(_num_boxes(scene) * cpu.PIXELS, trace.num_pairs, int(rows.sum()) * cpu.TILE, above)


def _covariance(scene: Scene) -> np.ndarray:
    factor = scene.leaves[1].astype(np.float64)
    return factor @ factor.transpose(0, 2, 1) + RenderOptions().low_pass * np.eye(2)


def _reach(scene: Scene) -> np.ndarray:
    """Squared Mahalanobis distance at which alpha falls to the cutoff."""
    return 2 * np.log(scene.leaves[2].astype(np.float64) / RenderOptions().alpha_cutoff)


def _boxes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """First and last (column, row) of the tiles that each cutoff ellipse's bounding box touches."""
    variances = np.diagonal(_covariance(scene), axis1=1, axis2=2)
    radius, mean = np.sqrt(_reach(scene)[:, None] * variances), scene.leaves[0]
    most = [-(-scene.size[1] // cpu.TILE), -(-scene.size[0] // cpu.TILE)]
    first = np.clip(np.floor((mean - radius) / cpu.TILE), 0, most)
    last = np.clip(np.floor((mean + radius) / cpu.TILE) + 1, 0, most)
    return first, last


def _num_boxes(scene: Scene) -> int:
    first, last = _boxes(scene)
    return int((last - first).prod(axis=1).sum())


def _num_rows(mean, conic, reach, left, top) -> np.ndarray:
    """Pixel rows of a tile that the cutoff ellipse reaches within the tile's columns, by entry.

    On the column dx the ellipse spans dy = (-xy dx -+ sqrt(yy reach - det dx^2)) / yy; it is highest and lowest where
    dx = -+ xy sqrt(reach / (xx det)), or at the nearest column of the tile.
    """
    xx, xy, yy = conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]
    det, x, y = xx * yy - xy**2, mean[:, 0] - left - 0.5, mean[:, 1] - top - 0.5
    turn = xy * np.sqrt(reach / (xx * det))
    ends = []
    for side in (-1, 1):
        dx = np.clip(-side * turn, -x, cpu.TILE - 1 - x)
        ends.append(y + (-xy * dx + side * np.sqrt(np.maximum(yy * reach - det * dx**2, 0))) / yy)
    first, last = np.maximum(np.ceil(ends[0]), 0), np.minimum(np.floor(ends[1]), cpu.TILE - 1)
    return np.maximum(last - first + 1, 0)


def _num_above(mean, conic, opacity, left, top) -> int:
    """Pixels above the cutoff, over entries given by splat and tile."""
    pixel = np.arange(cpu.TILE) + 0.5
    dx = (left - mean[:, 0])[:, None, None] + pixel[None, None, :]
    dy = (top - mean[:, 1])[:, None, None] + pixel[None, :, None]
    xx, xy, yy = (conic[:, j, k, None, None].astype(np.float32) for j, k in ((0, 0), (0, 1), (1, 1)))
    distance = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
    reach = 2 * np.log(opacity / np.float32(RenderOptions().alpha_cutoff))
    return int(np.count_nonzero(distance <= reach[:, None, None]))


# --------------------------------------------------------------------------------------------- engines


def cpu_tasks(case: Case) -> dict[str, Task]:
    """The CPU engine with one thread and with all."""
    scene = case.scene

    def forward():
        return cpu.forward(*scene.leaves, scene.size)

    def both():
        return cpu.backward(forward(), scene.grad_image)

    tasks = {}
    for threads in (1, available_cores()):
        prepare = functools.partial(_use_threads, threads)
        tasks[f"cpu forward {threads}"] = Task(forward, prepare)
        tasks[f"cpu both {threads}"] = Task(both, prepare)
    return tasks


def _use_threads(threads: int) -> None:
    """Set the number of threads and wake them, so that starting them is not timed."""
    set_num_threads(threads)
    run_tasks(lambda _: None, range(4 * threads))


def xla_tasks(case: Case) -> dict[str, Task]:
    scene = case.scene
    leaves, gradient = jax.device_put((scene.leaves, scene.grad_image))
    boxes = jax.device_put(box_lists(*_boxes(scene), scene.size))
    whole = jax.device_put(tile_lists(case.trace, by_row=False))
    rows = jax.device_put(tile_lists(case.trace, by_row=True))

    def forward(lists: TileLists):
        return render_tiles(*leaves, lists, size=scene.size)

    @jax.jit
    def both(leaves, lists, gradient):
        return jax.grad(lambda own: jnp.vdot(render_tiles(*own, lists, size=scene.size), gradient))(leaves)

    return {
        "xla forward": Task(lambda: forward(boxes).block_until_ready()),
        "xla exact forward": Task(lambda: forward(whole).block_until_ready()),
        "xla by row forward": Task(lambda: forward(rows).block_until_ready()),
        "xla by row both": Task(lambda: jax.block_until_ready(both(leaves, rows, gradient))),
    }


def reference_tasks(case: Case) -> dict[str, Task]:
    scene = case.scene
    *parts, background = scene.leaves
    splats = jax.device_put(Splats2D(*(leaf[: case.reference_splats] for leaf in parts)))
    gradient = jax.device_put(np.moveaxis(scene.grad_image, 0, -1))

    @jax.jit
    def forward(splats, background):
        return render(splats, scene.size, background=background, engine="reference")

    @jax.jit
    def both(splats, background, gradient):
        return jax.grad(lambda *own: jnp.vdot(forward(*own), gradient), argnums=(0, 1))(splats, background)

    return {
        "reference forward": Task(lambda: forward(splats, background).block_until_ready()),
        "reference both": Task(lambda: jax.block_until_ready(both(splats, background, gradient))),
    }


def check_agreement(case: Case) -> float:
    """Largest difference of the XLA loops from the CPU engine; AssertionError where they do not agree."""
    worst = 0.0
    boxes = box_lists(*_boxes(case.scene), case.scene.size)
    for lists in (boxes, tile_lists(case.trace, by_row=False), tile_lists(case.trace, by_row=True)):
        image = np.asarray(render_tiles(*case.scene.leaves, lists, size=case.scene.size))
        difference = np.abs(image - case.trace.image)
        share = np.mean(difference > TOLERANCE)
        worst = max(worst, float(difference.max()))
        assert share <= CUTOFF_SHARE, f"xla and cpu: {share:.2%} of the pixels differ by more than {TOLERANCE:g}"
    assert worst < 1 / 255, f"xla and cpu differ by {worst:g}, more than a splat at the cutoff may"
    return worst


# ---------------------------------------------------------------------------------------------- report


def measure(case: Case, rounds: int) -> dict[str, list[float]]:
    """Seconds of every round, by task."""
    tasks = cpu_tasks(case) | xla_tasks(case) | reference_tasks(case)
    try:
        return interleaved(tasks, rounds)
    finally:
        set_num_threads(None)


def show(case: Case, seconds: dict[str, list[float]], difference: float) -> None:
    height, width = case.scene.size
    pairs = case.pairs
    title = f"{case.scene.num_splats:,} splats, {height}x{width}"
    table = _common.table(title, *COLUMNS)
    for name, values in seconds.items():
        (engine, what), value = _words(name), statistics.median(values)
        own = height * width * case.reference_splats
        counts = (own, None, None) if engine == "reference" else (pairs.listed, pairs.boxes, pairs.visited)
        cells = ["" if n is None else f"{value * 1e9 / n:.3f}" for n in counts]
        table.add_row(engine, what, f"{value * 1e3:.1f}", f"{min(values) * 1e3:.1f}", *cells)
    console.print(table)
    shares = f"{pairs.visited / pairs.listed:.0%} visited, {pairs.above / pairs.listed:.0%} above the cutoff"
    console.print(
        f"pairs: {pairs.listed / 1e6:.1f}M listed ({pairs.listed // cpu.PIXELS:,} entries; {shares}), "
        f"{pairs.boxes / 1e6:.1f}M in bounding boxes ({pairs.boxes // cpu.PIXELS:,} entries); "
        f"reference: {case.reference_splats} splats on every pixel; xla - cpu at most {difference:.1e}\n"
    )


def _words(name: str) -> tuple[str, str]:
    """A task's name as engine and pass."""
    engine, _, threads = name.rpartition(" ") if name[-1].isdigit() else (name, "", "")
    engine, _, what = engine.rpartition(" ")
    engine += f", {threads} thread{'s' if threads != '1' else ''}" if threads else ""
    return engine, {"forward": "forward", "both": "forward + backward"}[what]


def scene_figures(case: Case, seconds: dict[str, float]) -> dict[str, float]:
    """Figures of one scene from median seconds by task, by name without the scene."""
    cores, pairs = available_cores(), case.pairs
    per_pair = 1e9 / pairs.listed
    own = case.scene.size[0] * case.scene.size[1] * case.reference_splats
    forward, both = seconds[f"cpu forward {cores}"], seconds[f"cpu both {cores}"]
    return {
        "cpu_forward_ns_per_pair": forward * per_pair,
        "cpu_forward_backward_ns_per_pair": both * per_pair,
        "cpu_forward_ns_per_pair_1_thread": seconds["cpu forward 1"] * per_pair,
        "cpu_forward_backward_ns_per_pair_1_thread": seconds["cpu both 1"] * per_pair,
        "cpu_forward_ns_per_box_pair": forward * 1e9 / pairs.boxes,
        "cpu_forward_backward_ns_per_box_pair": both * 1e9 / pairs.boxes,
        "cpu_forward_ms": forward * 1e3,
        "cpu_forward_backward_ms": both * 1e3,
        "xla_over_cpu_forward": seconds["xla forward"] / forward,
        "xla_exact_over_cpu_forward": seconds["xla exact forward"] / forward,
        "xla_by_row_over_cpu_forward": seconds["xla by row forward"] / forward,
        "xla_by_row_over_cpu_forward_backward": seconds["xla by row both"] / both,
        "reference_forward_ns_per_pair": seconds["reference forward"] * 1e9 / own,
        "reference_forward_backward_ns_per_pair": seconds["reference both"] * 1e9 / own,
        "above_cutoff_share": pairs.above / pairs.listed,
    }


def worst_of(figures: dict[str, dict[str, float]]) -> dict[str, float]:
    """The worst scene: the smallest ratio or share, the largest time."""
    names = next(iter(figures.values()))
    smallest = [name for name in names if "_over_" in name or name.endswith("share")]
    return {
        name: (min if name in smallest else max)(each[name] for each in figures.values())
        for name in names
        if not name.endswith("_ms")
    }


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--rounds", type=_common.whole, default=7, help="rounds of all engines in turn [7]")
    parser.add_argument("--scene", choices=tuple(SCENES), action="append", help="only this scene [both]")
    options = _common.parse(parser, arguments)
    facts, figures = _common.machine(), {}
    for name in options.scene or SCENES:
        case = make_case(name)
        difference = check_agreement(case)
        seconds = measure(case, options.rounds)
        show(case, seconds, difference)
        medians = {task: statistics.median(values) for task, values in seconds.items()}
        figures[case.scene.name] = scene_figures(case, medians)
    flat = {f"{name}_{scene}": value for scene, own in figures.items() for name, value in own.items()}
    _common.finish(options.json, worst_of(figures) | flat, facts, rounds=options.rounds)


if __name__ == "__main__":
    main()
