"""Speed of the rasterisers: `cpu` against `xla`, and against the same algorithm in C++.

    python -m benchmarks.rasterizer [--all] [--json FILE] [--plot FILE] [--rounds 7] [--scene 20k ...]

Scenes: random splats (`_common.random_scene`), from 1k at 128x128 to 500k at 1080x1920, compositing "over"; without
--all or --scene the 20k and 100k ones. A *pair* is one pixel of one 16x16 tile times one Gaussian listed there; figures
count the CPU engine's own lists (exact ellipse-tile tests: fewer pairs than bounding boxes, so the stricter unit).

Timed: wall seconds of a whole call from float32 NumPy (cpu) or device (xla) arrays to finished results, median over
rounds that run all engines in turn, listing included. XLA uses all cores and is told its lists' capacity, `cpu` is
timed with one thread and with two. Backward is the gradient of <image, g> by mean, factor, opacity, color and
background, the forward pass included. `cpu` is timed twice: its own functions, as playback and fitting call them, and
through the jitted `render` with two threads, as `xla` is: checks, planes made pixels and, in the backward pass, a
second forward one are then counted.

`cpu_over_cpp`: one thread of the engine's `forward_rows`, which lists by tile and blends, over the same algorithm by
hand in C++ (`rasterizer_kernel.cpp`, `g++ -O3 -march=native -ffast-math`, compiled on the spot), serial and from the
lists that the engine made: equal pairs, equal cells, the same early stop. The images of all engines must agree
(`check_agreement`). With --all the cost is also measured against the number of splats (at one size) and of pixels (at
one number of splats, whose sizes grow with the picture), and plotted with the line of best fit.

What bounds `cpu`, as LLVM 20 compiles it for AVX-512, per 16 pixels visited (the cells of 4x4 pixels that the ellipse
reaches, until the tile is opaque): forward 25 vector instructions, 15 of them multiplications; backward 21 (11) to walk
a block again and 20 (13) to walk it back. A Zen 4 core starts two 512-bit instructions per cycle, of them one
multiplication: 15 and 24 cycles, so 4.3 and 6.9 ns at 3.5 GHz, 0.27 and 0.43 ns per visited pair, on one thread. Beside
them stand the listing, loading the blocks, and 33 instructions per splat and tile to sum over a cell's lanes.
"""

import ctypes
import functools
import shutil
import statistics
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from benchmarks._common import Scene, Task, console, interleaved, random_scene
from foldgauss._runtime.threads import run_tasks, set_num_threads
from foldgauss.io.figures import write_figure
from foldgauss.render import RenderOptions, Splats2D, _cpu_kernels, cpu, render

SCENES = {
    "1k": (1_000, (128, 128)),
    "20k": (20_000, (160, 320)),
    "50k": (50_000, (360, 640)),
    "100k": (100_000, (640, 1280)),
    "500k": (500_000, (1080, 1920)),
}
DEFAULT_SCENES = ("20k", "100k")
SOURCE = Path(__file__).with_name("rasterizer_kernel.cpp")
FLAGS = ("-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512", "-std=c++17", "-shared", "-fPIC")
#: Largest difference between two engines.
TOLERANCE = 1e-4
#: Fraction of the pixels that may exceed it: where a splat is at the very cutoff (alpha 1/255), rounding decides
#: whether an engine draws it.
CUTOFF_FRACTION = 1e-5
#: Numbers of splats of the first line, at the size `LINE_SIZE`.
LINE_SPLATS = (25_000, 50_000, 100_000, 200_000, 400_000)
LINE_SIZE = (640, 1280)
#: Widths of the pictures of the second line, of `LINE_NUM` splats, whose deviations grow with the width. (In much
#: smaller pictures the splats are smaller than a tile, and what is visited no longer follows their area.)
LINE_WIDTHS = (640, 960, 1280, 1920, 2560)
LINE_NUM = 50_000
XLA_TILE = 8  # pixels along a side of what the engine lists by


def num_boxes(scene: Scene, tile: int) -> int:
    """Pairs of a splat and a tile that the bounding box of its cutoff ellipse touches."""
    mean, factor, opacity = (leaf.astype(np.float64) for leaf in scene.leaves[:3])
    variances = (factor**2).sum(2) + RenderOptions().low_pass
    radius = np.sqrt(2 * np.log(opacity / RenderOptions().alpha_cutoff)[:, None] * variances)
    most = [-(-scene.size[1] // tile), -(-scene.size[0] // tile)]
    first = np.clip(np.floor((mean - radius) / tile), 0, most)
    last = np.clip(np.floor((mean + radius) / tile) + 1, 0, most)
    return int((last - first).prod(axis=1).sum())


# --------------------------------------------------------------------------------------------- engines


def cpu_tasks(scene: Scene, threads: tuple[int, ...] = (1, 2)) -> dict[str, Task]:
    """The CPU engine with each number of threads."""

    def forward():
        return cpu.forward(*scene.leaves, scene.size)

    def both():
        return cpu.backward(forward(), scene.grad_image)

    tasks = {}
    for num in threads:
        prepare = functools.partial(_use_threads, num)
        tasks |= {f"cpu forward {num}": Task(forward, prepare), f"cpu both {num}": Task(both, prepare)}
    return tasks


def _use_threads(threads: int) -> None:
    """Set the number of threads and wake them, so that starting them is not timed."""
    set_num_threads(threads)
    run_tasks(lambda _: None, range(4 * threads))


def render_tasks(scene: Scene) -> dict[str, Task]:
    """Both engines through the jitted `render`."""
    *parts, background = scene.leaves
    own = jax.device_put((Splats2D(*parts), background, np.moveaxis(scene.grad_image, 0, -1)))
    tiles = -(-scene.size[0] // XLA_TILE) * -(-scene.size[1] // XLA_TILE)
    # Room for all slots of engine "xla" at once, as it would count them itself outside `jit`.
    room = RenderOptions(list_capacity=1 << (max(num_boxes(scene, XLA_TILE), tiles) - 1).bit_length())
    tasks = {}
    for engine, options, name in (("xla", room, "xla"), ("cpu", None, "render")):
        draw, differentiate = _jitted(scene.size, engine, options)
        prepare = functools.partial(_use_threads, 2)
        tasks[f"{name} forward"] = Task(lambda f=draw: jax.block_until_ready(f(*own[:2])), prepare)
        tasks[f"{name} both"] = Task(lambda f=differentiate: jax.block_until_ready(f(*own)), prepare)
    return tasks


def _jitted(size: tuple[int, int], engine: str, options: RenderOptions | None) -> tuple[Callable, Callable]:
    """The picture, and the gradient of <picture, gradient>, as compiled functions."""

    @jax.jit
    def forward(splats, background):
        return render(splats, size, background=background, engine=engine, options=options)

    @jax.jit
    def both(splats, background, gradient):
        return jax.grad(lambda *own: jnp.vdot(forward(*own), gradient), argnums=(0, 1))(splats, background)

    return forward, both


def cpp_tasks(trace: cpu.Trace, compiled: ctypes.CDLL) -> tuple[dict[str, Task], np.ndarray]:
    """The engine's rows by themselves and those of C++, on one thread; and the image that the latter draws."""
    planes = np.empty_like(trace.image), np.empty_like(trace.transmittance)
    splats, background = (trace.geometry, trace.inputs[2]), np.asarray(trace.constants[0], np.float32)
    row_start, entries, *_ = trace.buckets
    lengths = np.concatenate([np.diff(start) for start, *_ in trace.lists])
    parts = zip(trace.parts, trace.lists, strict=True)
    listed = np.concatenate([entries[row_start[first] + listed] for (first, _), (_, listed, *_) in parts])
    # Tile t, row by row, lists splats listed[start[t] : start[t + 1]], front to back.
    arrays = (np.append(0, np.cumsum(lengths)), listed, *splats, background)
    assert [array.dtype.name for array in arrays] == ["int64", "int32", "float32", "float32", "float32"]
    sizes, limits = map(ctypes.c_int, planes[1].shape), map(ctypes.c_float, trace.constants[2:])
    given = [*sizes, *map(_pointer, arrays), *limits, *map(_pointer, planes)]

    def composite() -> None:
        for part in trace.parts:
            _cpu_kernels.forward_rows(*part, row_start, entries, *splats, *trace.constants, *planes)

    prepare = functools.partial(_use_threads, 1)
    tasks = {"cpu rows": Task(composite, prepare), "c++": Task(lambda: compiled.exact(*given), prepare)}
    return tasks, planes[0]


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return array.ctypes.data_as(ctypes.c_void_p)


def compile_kernel() -> ctypes.CDLL | None:
    """The C++ kernel, where there is a compiler."""
    if shutil.which("g++") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "rasterizer_kernel.so"
        subprocess.run(["g++", *FLAGS, str(SOURCE), "-o", str(library)], check=True)
        return ctypes.CDLL(str(library))


def check_agreement(name: str, image: np.ndarray, expected: np.ndarray) -> None:
    """Raise AssertionError where an image differs from that of the CPU engine by more than rounding at the cutoff."""
    difference = np.abs(image - expected)
    fraction = np.mean(difference > TOLERANCE)
    assert fraction <= CUTOFF_FRACTION, f"{name} and cpu: {fraction:.2%} of the pixels differ"
    assert difference.max() < 1 / 255, f"{name} and cpu differ by {difference.max():g}, more than a splat at the cutoff"


# ---------------------------------------------------------------------------------------------- report


def measure(name: str, rounds: int, compiled: ctypes.CDLL | None) -> dict[str, float]:
    """Figures of a scene, which are also shown."""
    num, size = SCENES[name]
    scene = random_scene(num, size)
    trace = cpu.forward(*scene.leaves, size)
    tasks = cpu_tasks(scene) | render_tasks(scene)
    check_agreement("xla", np.moveaxis(np.asarray(tasks["xla forward"].run()), -1, 0), trace.image)
    if compiled is not None:
        own, image = cpp_tasks(trace, compiled)
        own["c++"].run()
        check_agreement("C++", image, trace.image)
        tasks |= own
    seconds = {task: statistics.median(values) for task, values in interleaved(tasks, rounds).items()}
    set_num_threads(None)
    figures = {f"{task} (ms)": 1e3 * value for task, value in seconds.items()}
    figures |= {f"{task} (ns/pair)": 1e9 * value / trace.num_pairs for task, value in seconds.items()}
    rows = ((task, f"{figures[f'{task} (ms)']:.2f}", f"{figures[f'{task} (ns/pair)']:.3f}") for task in seconds)
    title = f"{num:,} splats, {size[0]}x{size[1]}, {trace.num_pairs / 1e6:.1f}M pairs"
    _common.print_table(title, ("engine, pass, threads", "ms", "ns/pair"), rows)
    for what in ("forward", "both"):
        figures[f"xla_over_cpu_{what}"] = seconds[f"xla {what}"] / seconds[f"render {what}"]
    if compiled is not None:
        figures["cpu_over_cpp"] = seconds["cpu rows"] / seconds["c++"]
    return figures


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
    pixels = [_grown(random_scene(LINE_NUM, (9 * width // 16, width))) for width in LINE_WIDTHS]
    counts = [scene.num_splats for scene in splats], [scene.size[0] * scene.size[1] for scene in pixels]
    lines = {}
    for name, label, scenes, x in (
        ("splats", "splats, 640x1280", splats, counts[0]),
        ("pixels", "pixels, 50,000 splats", pixels, counts[1]),
    ):
        tasks = {(k, task): what for k, scene in enumerate(scenes) for task, what in cpu_tasks(scene, (1,)).items()}
        timed = interleaved(tasks, rounds)
        by_task = {task: [statistics.median(timed[k, task]) for k in range(len(x))] for _, task in timed}
        lines[name] = Line(label, x, by_task)
    set_num_threads(None)
    return lines


def _grown(scene: Scene) -> Scene:
    mean, factor, *others = scene.leaves
    larger = np.ascontiguousarray(factor * np.float32(scene.size[1] / LINE_SIZE[1]))
    return scene._replace(leaves=(mean, larger, *others))


def plot(lines: dict[str, Line], path: Path) -> None:
    """Measured points and the lines of best fit."""

    def draw(figure: Any) -> None:
        for axis, line in zip(figure.subplots(1, len(lines)), lines.values(), strict=True):
            ends = np.array([0, max(line.x)])
            for task, seconds in line.seconds.items():
                slope, intercept, straight = line.fit(task)
                (mark,) = axis.plot(line.x, np.array(seconds) * 1e3, "o")
                words = f"{task}, R² = {straight:.4f}"
                axis.plot(ends, (slope * ends + intercept) * 1e3, "-", color=mark.get_color(), label=words)
            axis.set(xlabel=line.label, ylabel="ms, one thread", xlim=(0, None), ylim=(0, None))
            axis.legend()

    write_figure(path, draw, (11, 4))


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--rounds", type=_common.whole, default=7, help="rounds of all engines in turn [7]")
    parser.add_argument("--scene", choices=tuple(SCENES), action="append", help="only this scene [20k and 100k]")
    parser.add_argument("--all", action="store_true", help="all scenes, and the lines")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="PNG of the lines [with --all: rasterizer.png]")
    options = _common.parse(parser, arguments)
    compiled, figures = compile_kernel(), {}
    if compiled is None:
        console.print("No g++: the engine is not compared with C++.")
    for name in options.scene or (SCENES if options.all else DEFAULT_SCENES):
        own = measure(name, options.rounds, compiled)
        figures |= {f"{name}: {what}": value for what, value in own.items()}
    if options.all or options.plot:
        lines = measure_lines(options.rounds)
        plot(lines, options.plot or Path("rasterizer.png"))
        figures |= {f"r2_{name}_{task}": line.fit(task)[2] for name, line in lines.items() for task in line.seconds}
    _common.finish(options.json, figures, rounds=options.rounds)


if __name__ == "__main__":
    main()
