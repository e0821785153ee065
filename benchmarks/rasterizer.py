"""Speed of the rasterisers: `cpu` against `xla`, `reference`, and the same loops in C++.

    python -m benchmarks.rasterizer [--all] [--json FILE] [--plot FILE] [--rounds 7] [--scene 20k ...]

Scenes: random splats (`_common.random_scene`), from 1k at 128x128 to 500k at 1080x1920, compositing "over"; without
--all or --scene the 20k and 100k ones. A *pair* is one pixel of one 16x16 tile times one Gaussian listed there; figures
count the CPU engine's own lists (exact ellipse-tile tests: fewer pairs than bounding boxes, so the stricter
unit), the table gives both.

Timed: wall seconds of a whole call from float32 NumPy (cpu) or device (xla) arrays to finished results, median over
rounds that run all engines in turn, listing included. XLA uses all cores and is told its lists' capacity, `cpu` is
timed with one thread and with two. Backward is the gradient of <image, g> by mean, factor, opacity, color and
background, the forward pass included. The reference is dense, so it draws only as many splats as make about 1e7
pairs of its own, pixels times splats.

`cpu` is timed twice: its own functions, as playback and fitting call them, and through the jitted `render` with two
threads ("cpu, render"), which is the door that engine "xla" has: checks, planes made pixels and, in the backward
pass, a second forward one are then counted. `xla_over_cpu_forward` and `xla_over_cpu_forward_backward` compare the
engines through that door; all other figures of `cpu` are of its own functions.

The C++ rivals (`rasterizer_kernel.cpp`, compiled on the spot) are serial and get their lists for nothing:

* `cpu_over_cpp`: one thread of the engine's `forward_rows` calls, which list by tile and blend, over C++ `exact`, the
  same algorithm by hand from the lists that the engine made: equal pairs, equal cells, the same early stop.
* `plain_over_cpp`: the textbook loop (bounding boxes, every pixel of every listed pair, no early stop) in Numba over
  the same in C++, on equal lists.
* `exact_over_plain`: the engine's projection, a listing by bounding boxes and the plain loop in Numba, over the
  engine's forward pass: a whole image either way, one thread. `exact_over_plain_loop`: without the listing.

Engines must agree: see `check_agreement`. With --all the cost is also measured against the number of splats (at one
size) and of pixels (at one number of splats, whose sizes grow with the picture), and plotted with the line of best fit.

What bounds `cpu`, as LLVM 20 compiles it for AVX-512, per 16 pixels visited (the cells of 4x4 pixels that the ellipse
reaches, until the tile is opaque): forward 25 vector instructions, 15 of them multiplications; backward 21 (11) to walk
a block again and 20 (13) to walk it back. A Zen 4 core starts two 512-bit instructions per cycle, of them one
multiplication: 15 and 24 cycles, so 4.3 and 6.9 ns at 3.5 GHz, 0.27 and 0.43 ns per visited pair, on one thread. Beside
them stand the listing, loading the blocks, and 33 instructions per splat and tile to sum over a cell's lanes. (Rows of
16 pixels instead of cells took 12 and 25 cycles, but a third more of them were visited.)
"""

import contextlib
import functools
import statistics
import tempfile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common, _rivals
from benchmarks._common import Scene, Task, console, interleaved, random_scene
from foldgauss._runtime.threads import run_tasks, set_num_threads
from foldgauss.render import RenderOptions, Splats2D, cpu, render

SCENES = {
    "1k": (1_000, (128, 128)),
    "20k": (20_000, (160, 320)),
    "50k": (50_000, (360, 640)),
    "100k": (100_000, (640, 1280)),
    "500k": (500_000, (1080, 1920)),
}
DEFAULT_SCENES = ("20k", "100k")
THREADS = (1, 2)
COLUMNS = ("engine", "pass", "ms", "best ms", "ns/pair, own lists", "ns/pair, boxes", "ns/visited")
REFERENCE_PAIRS = 1e7  # some 0.1 s a call
#: Largest difference between two engines, and the share of the pixels that may exceed it: where a splat is at
#: the very cutoff (alpha 1/255), rounding decides whether an engine draws it.
TOLERANCE, CUTOFF_SHARE = 1e-4, 1e-5
#: Lines: numbers of splats at one size; sizes at one number of splats, whose deviations grow with the width. (In much
#: smaller pictures the splats are smaller than a tile, and what is visited no longer follows their area.)
LINE_SPLATS, LINE_SIZE = (25_000, 50_000, 100_000, 200_000, 400_000), (640, 1280)
LINE_WIDTHS, LINE_NUM = (640, 960, 1280, 1920, 2560), 50_000
#: Entries whose pixels are counted one by one; of more, every n-th is.
MOST_COUNTED = 500_000
XLA_TILE = 8  # what the engine lists by
CELL = 4  # pixels along a side of what the engine `cpu` visits or skips


class Pairs(NamedTuple):
    """Pairs of a scene, counted in four ways."""

    boxes: int  # in tiles touched by the bounding box of the cutoff ellipse
    listed: int  # in the engine's lists
    visited: int  # in cells that the engine's loop runs over
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
    kept = min(num, max(1, round(REFERENCE_PAIRS / (size[0] * size[1]))))
    return Case(scene, trace, count_pairs(scene, trace), kept)


# -------------------------------------------------------------------------------------------- counting


def count_pairs(scene: Scene, trace: cpu.Trace) -> Pairs:
    """Count on the host, from the splats' own formulas."""
    lists, across = _rivals.own_lists(trace), -(-scene.size[1] // cpu.TILE)
    lengths = np.diff(lists.start)
    tile, splat = np.repeat(np.arange(len(lengths)), lengths), lists.listed
    position = np.arange(len(splat)) - lists.start[tile]
    left, top = (tile % across * cpu.TILE).astype(np.float32), (tile // across * cpu.TILE).astype(np.float32)
    used = np.concatenate([used - start[:-1] for start, _, used in trace.lists])
    mean, opacity = scene.leaves[0], scene.leaves[2]
    conic = np.linalg.inv(_covariance(scene))
    covariance, reach = _covariance(scene), _reach(scene)
    cells = _num_cells(mean[splat], conic[splat], covariance[splat], reach[splat], left, top)
    cells *= position < used[tile]
    sample, above = np.arange(0, len(splat), -(-len(splat) // MOST_COUNTED)), 0
    for part in np.array_split(sample, -(-len(sample) // 20_000)):
        i = splat[part]
        above += _num_above(mean[i], conic[i], opacity[i], left[part], top[part])
    above = round(above * len(splat) / len(sample))
    return Pairs(num_boxes(scene) * cpu.PIXELS, trace.num_pairs, int(cells.sum()) * CELL**2, above)


def _covariance(scene: Scene) -> np.ndarray:
    factor = scene.leaves[1].astype(np.float64)
    return factor @ factor.transpose(0, 2, 1) + RenderOptions().low_pass * np.eye(2)


def _reach(scene: Scene) -> np.ndarray:
    """Squared Mahalanobis distance at which alpha falls to the cutoff."""
    return 2 * np.log(scene.leaves[2].astype(np.float64) / RenderOptions().alpha_cutoff)


def boxes(scene: Scene, tile: int = cpu.TILE) -> tuple[np.ndarray, np.ndarray]:
    """First and last (column, row) of the tiles that each cutoff ellipse's bounding box touches."""
    variances = np.diagonal(_covariance(scene), axis1=1, axis2=2)
    radius, mean = np.sqrt(_reach(scene)[:, None] * variances), scene.leaves[0]
    most = [-(-scene.size[1] // tile), -(-scene.size[0] // tile)]
    first = np.clip(np.floor((mean - radius) / tile), 0, most)
    last = np.clip(np.floor((mean + radius) / tile) + 1, 0, most)
    return first, last


def num_boxes(scene: Scene, tile: int = cpu.TILE) -> int:
    first, last = boxes(scene, tile)
    return int((last - first).prod(axis=1).sum())


def _num_cells(mean, conic, covariance, reach, left, top) -> np.ndarray:
    """Cells of a tile that the cutoff ellipse reaches, by entry.

    On the line dy the ellipse spans dx = (-xy dy -+ sqrt(xx reach - det dy^2)) / xx of the conic; it reaches furthest
    to the right on dy = c_xy sqrt(reach / c_xx) of the covariance, or in a band of cells on the nearest line.
    """
    xx, xy, yy = conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]
    det, x, y = xx * yy - xy**2, mean[:, 0] - left - 0.5, mean[:, 1] - top - 0.5
    turn, total = covariance[:, 0, 1] * np.sqrt(reach / covariance[:, 0, 0]), np.zeros(len(mean), np.int64)
    for upper in range(0, cpu.TILE, CELL):
        ends, met = [], True
        for side in (-1, 1):
            dy = np.clip(side * turn, upper - y, upper + CELL - 1 - y)
            room = xx * reach - det * dy**2
            met &= room >= 0
            ends.append(x + (-xy * dy + side * np.sqrt(np.maximum(room, 0))) / xx)
        first, last = np.maximum(np.ceil(ends[0]), 0), np.minimum(np.floor(ends[1]), cpu.TILE - 1)
        total += np.where(met & (first <= last), last // CELL - first // CELL + 1, 0).astype(np.int64)
    return total


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


def cpu_tasks(scene: Scene) -> dict[str, Task]:
    """The CPU engine with one thread and with two."""

    def forward():
        return cpu.forward(*scene.leaves, scene.size)

    def both():
        return cpu.backward(forward(), scene.grad_image)

    tasks = {}
    for threads in THREADS:
        prepare = functools.partial(_use_threads, threads)
        tasks[f"cpu forward {threads}"] = Task(forward, prepare)
        tasks[f"cpu both {threads}"] = Task(both, prepare)
    return tasks


def _use_threads(threads: int) -> None:
    """Set the number of threads and wake them, so that starting them is not timed."""
    set_num_threads(threads)
    run_tasks(lambda _: None, range(4 * threads))


def rival_tasks(case: Case, compiled: _rivals.Compiled | None) -> dict[str, Task]:
    """The engine's rows by themselves, the plain loop, and both in C++; one thread."""
    scene, prepare = case.scene, functools.partial(_use_threads, 1)
    draft = cpu._ForwardPass(scene.leaves, scene.size, "over", RenderOptions(), False)
    for start in draft.chunks if len(draft.chunks) > 1 else ():
        draft.project(start)
    draft.bucket()
    parts = draft.split(whole=draft.work < cpu.SINGLE_TASK_NS)
    by_box, planes = _rivals.box_lists(*boxes(scene), scene.size), _rivals.Planes.of_size(scene.size)
    tasks = {
        "cpu rows forward 1": Task(lambda: [draft.composite(part) for part in parts], prepare),
        "plain forward 1": Task(lambda: _rivals.plain_numba(by_box, case.trace, planes), prepare),
        "plain image forward 1": Task(lambda: _rivals.plain_image(scene, case.trace), prepare),
    }
    if compiled is not None:
        own = _rivals.own_lists(case.trace)
        tasks["c++ exact forward 1"] = Task(lambda: compiled("exact", own, case.trace, planes), prepare)
        tasks["c++ plain forward 1"] = Task(lambda: compiled("plain", by_box, case.trace, planes), prepare)
    return tasks


def render_tasks(case: Case) -> dict[str, Task]:
    """Engines through the jitted `render`: XLA, the CPU engine with its most threads, the reference with few splats."""
    scene, threads = case.scene, max(THREADS)
    gradient, room = np.moveaxis(scene.grad_image, 0, -1), RenderOptions(list_capacity=_capacity(scene))
    tasks = {}
    for engine, name, options, num, *prepare in (
        ("xla", "xla {}", room, scene.num_splats),
        ("cpu", f"cpu, render {{}} {threads}", None, scene.num_splats, functools.partial(_use_threads, threads)),
        ("reference", "reference {}", None, case.reference_splats),
    ):
        *parts, background = scene.leaves
        own = jax.device_put((Splats2D(*(leaf[:num] for leaf in parts)), background, gradient))
        draw, differentiate = _jitted(scene.size, engine, options)
        tasks[name.format("forward")] = Task(functools.partial(_wait_for, draw, *own[:2]), *prepare)
        tasks[name.format("both")] = Task(functools.partial(_wait_for, differentiate, *own), *prepare)
    return tasks


def _wait_for(function, *arguments):
    return jax.block_until_ready(function(*arguments))


def _capacity(scene: Scene) -> int:
    """Room for all slots of engine "xla" at once, as it would count them itself outside `jit`."""
    tiles = -(-scene.size[0] // XLA_TILE) * -(-scene.size[1] // XLA_TILE)
    return 1 << (max(num_boxes(scene, XLA_TILE), tiles) - 1).bit_length()


def _jitted(size, engine, options):
    """The picture, and the gradient of <picture, gradient>, as compiled functions."""

    @jax.jit
    def forward(splats, background):
        return render(splats, size, background=background, engine=engine, options=options)

    @jax.jit
    def both(splats, background, gradient):
        return jax.grad(lambda *own: jnp.vdot(forward(*own), gradient), argnums=(0, 1))(splats, background)

    return forward, both


def check_agreement(case: Case, compiled: _rivals.Compiled | None) -> float:
    """Largest difference of XLA and the rivals from the CPU engine; AssertionError where they do not agree."""
    scene, planes = case.scene, _rivals.Planes.of_size(case.scene.size)
    *parts, background = scene.leaves
    image = render(Splats2D(*map(jnp.asarray, parts)), scene.size, background=background, engine="xla")
    images = {"xla": np.moveaxis(np.asarray(image), -1, 0)}
    by_box = _rivals.box_lists(*boxes(scene), scene.size)
    _rivals.plain_numba(by_box, case.trace, planes)
    images["plain"] = planes.image.copy()
    images["plain image"] = _rivals.plain_image(scene, case.trace).image
    if compiled is not None:
        for name, lists in (("exact", _rivals.own_lists(case.trace)), ("plain", by_box)):
            compiled(name, lists, case.trace, planes)
            images[f"c++ {name}"] = planes.image.copy()
    worst = 0.0
    for name, image in images.items():
        difference = np.abs(image - case.trace.image)
        share = np.mean(difference > TOLERANCE)
        worst = max(worst, float(difference.max()))
        assert share <= CUTOFF_SHARE, f"{name} and cpu: {share:.2%} of the pixels differ by more than {TOLERANCE:g}"
    assert worst < 1 / 255, f"two engines differ by {worst:g}, more than a splat at the cutoff may"
    return worst


# ---------------------------------------------------------------------------------------------- report


def measure(case: Case, rounds: int, compiled: _rivals.Compiled | None) -> dict[str, list[float]]:
    """Seconds of every round, by task."""
    tasks = cpu_tasks(case.scene) | rival_tasks(case, compiled) | render_tasks(case)
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
        f"reference: {case.reference_splats} splats on every pixel; others differ by at most {difference:.1e}\n"
    )


def _words(name: str) -> tuple[str, str]:
    """A task's name as engine and pass."""
    engine, _, threads = name.rpartition(" ") if name[-1].isdigit() else (name, "", "")
    engine, _, what = engine.rpartition(" ")
    engine += f", {threads} thread{'s' if threads != '1' else ''}" if threads else ""
    return engine, {"forward": "forward", "both": "forward + backward"}[what]


def scene_figures(case: Case, seconds: dict[str, float]) -> dict[str, float]:
    """Figures of one scene from median seconds by task, by name without the scene."""
    pairs = case.pairs
    own = case.scene.size[0] * case.scene.size[1] * case.reference_splats
    forward, both, alone = seconds["cpu forward 2"], seconds["cpu both 2"], seconds["cpu forward 1"]
    through = {what: seconds[f"cpu, render {what} {max(THREADS)}"] for what in ("forward", "both")}
    figures = {
        "cpu_forward_ns_per_pair": forward * 1e9 / pairs.listed,
        "cpu_forward_backward_ns_per_pair": both * 1e9 / pairs.listed,
        "cpu_forward_ns_per_pair_1_thread": alone * 1e9 / pairs.listed,
        "cpu_forward_backward_ns_per_pair_1_thread": seconds["cpu both 1"] * 1e9 / pairs.listed,
        "cpu_forward_ns_per_box_pair": forward * 1e9 / pairs.boxes,
        "cpu_forward_backward_ns_per_box_pair": both * 1e9 / pairs.boxes,
        "cpu_forward_ms": forward * 1e3,
        "cpu_forward_backward_ms": both * 1e3,
        "cpu_forward_1_thread_ms": alone * 1e3,
        "cpu_forward_backward_1_thread_ms": seconds["cpu both 1"] * 1e3,
        "xla_forward_ms": seconds["xla forward"] * 1e3,
        "xla_forward_backward_ms": seconds["xla both"] * 1e3,
        "cpu_render_forward_ms": through["forward"] * 1e3,
        "cpu_render_forward_backward_ms": through["both"] * 1e3,
        "xla_over_cpu_forward": seconds["xla forward"] / through["forward"],
        "xla_over_cpu_forward_backward": seconds["xla both"] / through["both"],
        "exact_over_plain": seconds["plain image forward 1"] / alone,
        "exact_over_plain_loop": seconds["plain forward 1"] / alone,
        "reference_forward_ns_per_pair": seconds["reference forward"] * 1e9 / own,
        "reference_forward_backward_ns_per_pair": seconds["reference both"] * 1e9 / own,
        "above_cutoff_share": pairs.above / pairs.listed,
    }
    if "c++ exact forward 1" in seconds:
        figures["cpu_over_cpp"] = seconds["cpu rows forward 1"] / seconds["c++ exact forward 1"]
        figures["plain_over_cpp"] = seconds["plain forward 1"] / seconds["c++ plain forward 1"]
        figures["cpp_exact_ns_per_pair"] = seconds["c++ exact forward 1"] * 1e9 / pairs.listed
        figures["cpp_plain_ns_per_box_pair"] = seconds["c++ plain forward 1"] * 1e9 / pairs.boxes
    return figures


def worst_of(figures: dict[str, dict[str, float]]) -> dict[str, float]:
    """The worst scene: the smallest gain or share, the largest time."""
    names = next(iter(figures.values()))
    gains = [name for name in names if name.startswith(("xla_over", "exact_over")) or name.endswith("share")]
    return {
        name: (min if name in gains else max)(each[name] for each in figures.values())
        for name in names
        if not name.endswith("_ms")
    }


# ----------------------------------------------------------------------------------------------- lines


class Line(NamedTuple):
    """Cost against something, and how straight it is."""

    label: str
    x: list[float]
    seconds: dict[str, list[float]]  # by task

    def fit(self, task: str) -> tuple[float, float, float]:
        """Slope, intercept, and the coefficient of determination."""
        x, y = np.array(self.x), np.array(self.seconds[task])
        slope, intercept = np.polyfit(x, y, 1)
        rest = y - (slope * x + intercept)
        return slope, intercept, 1 - rest.var() / y.var()


def measure_lines(rounds: int) -> dict[str, Line]:
    splats = [random_scene(num, LINE_SIZE) for num in LINE_SPLATS]
    sizes = [(9 * width // 16, width) for width in LINE_WIDTHS]
    pixels = [
        _grown(random_scene(LINE_NUM, size), width / LINE_SIZE[1])
        for size, width in zip(sizes, LINE_WIDTHS, strict=True)
    ]
    lines = {}
    for name, label, scenes in (("splats", "splats, 640x1280", splats), ("pixels", "pixels, 50,000 splats", pixels)):
        x = [scene.num_splats if name == "splats" else scene.size[0] * scene.size[1] for scene in scenes]
        tasks = {(k, task): what for k, scene in enumerate(scenes) for task, what in cpu_tasks(scene).items()}
        try:
            timed = interleaved({key: what for key, what in tasks.items() if key[1].endswith("1")}, rounds)
        finally:
            set_num_threads(None)
        by_task = {task: [statistics.median(timed[k, task]) for k in range(len(x))] for _, task in timed}
        lines[name] = Line(label, x, by_task)
    return lines


def _grown(scene: Scene, scale: float) -> Scene:
    mean, factor, *others = scene.leaves
    return scene._replace(leaves=(mean, np.ascontiguousarray(factor * np.float32(scale)), *others))


def plot(lines: dict[str, Line], path: Path) -> None:
    """Measured points and the lines of best fit, into a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(lines), figsize=(11, 4), layout="constrained")
    for axis, line in zip(axes, lines.values(), strict=True):
        for task in line.seconds:
            slope, intercept, straight = line.fit(task)
            ends = np.array([0, max(line.x)])
            (mark,) = axis.plot(line.x, np.array(line.seconds[task]) * 1e3, "o")
            words = f"{_words(task)[1]}, R² = {straight:.4f}"
            axis.plot(ends, (slope * ends + intercept) * 1e3, "-", color=mark.get_color(), label=words)
        axis.set(xlabel=line.label, ylabel="ms, one thread", xlim=(0, None), ylim=(0, None))
        axis.legend()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--rounds", type=_common.whole, default=7, help="rounds of all engines in turn [7]")
    parser.add_argument("--scene", choices=tuple(SCENES), action="append", help="only this scene [20k and 100k]")
    parser.add_argument("--all", action="store_true", help="all scenes, and the lines")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="PNG of the lines [with --all: rasterizer.png]")
    options = _common.parse(parser, arguments)
    names = options.scene or (SCENES if options.all else DEFAULT_SCENES)
    facts, figures, lines = _common.describe_machine(), {}, {}
    with contextlib.ExitStack() as stack:
        compiled = None
        if _rivals.has_compiler():
            compiled = _rivals.Compiled(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        for name in names:
            case = make_case(name)
            difference = check_agreement(case, compiled)
            seconds = measure(case, options.rounds, compiled)
            show(case, seconds, difference)
            medians = {task: statistics.median(values) for task, values in seconds.items()}
            figures[case.scene.name] = scene_figures(case, medians)
    if options.all or options.plot:
        lines = measure_lines(options.rounds)
        plot(lines, options.plot or Path("rasterizer.png"))
    flat = {f"{name}_{scene}": value for scene, own in figures.items() for name, value in own.items()}
    for name, line in lines.items():
        flat |= {f"r2_{name}_{task.split()[1]}": line.fit(task)[2] for task in line.seconds}
    _common.finish(options.json, worst_of(figures) | flat, facts, rounds=options.rounds)


if __name__ == "__main__":
    main()
