"""The paper's recipe to its end: preset `paper` with all its steps, and with one thing changed.

    python -m benchmarks.reproduce --folder FOLDER [--tables | --only NAME ...] [--size HxW | --crop HxW] [--frames A:B]
                                   [--clip PATH] [--steps N] [--seed S] [--engine E] [--default] [--json FILE]
                                   [--plot FILE]

*Bunny* or another clip, by default all 132 frames of 640x1280, in the published 30,000 steps of 3 frames: hours on the
CPU of a desktop machine; `--engine auto` uses a GPU where JAX sees one. A smaller `--size` has Gaussians at the start
in proportion to its pixels, and lengths, rates of positions and thresholds of gradients that are the same in pixels
(`config_of`).
Smaller frames show more detail per pixel; `--crop` instead fits the central window of the frames, with as much detail
as they have.
`VARIANTS` lists the fits: "as published", the power of the paper's text instead of its code's, other batches and
degrees, and what the paper does not state or we chose. With --tables they are the `CELLS` of the paper's tables of
batches and degrees (table:bs-pol) and of Gaussians at the start (table:init-gauss), the most telling first. The former
start with 100,000: their 38.53 dB for batch 3 and degree 7 is the first row of the other table. PSNR and SSIM are of
8-bit images, the mean over all frames, beside the published PSNR.

FOLDER keeps a checkpoint of the fit under way and, for each fit, the curve NAME.csv of running PSNR (of all frames,
each with the error it had when a step last rendered it) and number of Gaussians against steps. The same command
continues a fit after its checkpoint; with --json also after the fits that are done. `cpu_hours` are of the process,
over all its runs. With --default a fit of the defaults follows, with at most as many Gaussians as the first fit ends
with, for as long as that took (processor time of all threads together).
"""

import csv
import dataclasses
import math
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common
from benchmarks._common import console
from benchmarks._runs import Run, Runs, fitted, scaled, scores, size_on_disk
from foldgauss._runtime.settings import settings_by_name
from foldgauss._runtime.threads import num_threads
from foldgauss.io import Clip, read_video
from foldgauss.io._atomic import atomic_path
from foldgauss.io.datasets import sample_clip
from foldgauss.io.figures import write_figure
from foldgauss.io.provenance import fingerprint
from foldgauss.jobs.runner import Checkpoint, run_steps
from foldgauss.video import FitConfig, fit_steps
from foldgauss.video.fitting.config import FIT_ENGINES, PUBLISHED_STEPS
from foldgauss.video.fitting.loop import start
from foldgauss.video.fitting.state import FitState, to_model
from foldgauss.video.models.row_layout import columns

FULL = (640, 1280)
#: Steps between two points of a curve.
EVERY = 100
CHECKPOINT_SECONDS = 120.0

#: What each fit changes in the preset, or in its `Growth`; the largest questions first. `rates` is a factor of all
#: learning rates, `extent` one of what is in units of the scene's extent (the learning rate of positions and two
#: lengths of `Growth`), `box` one of positions and sizes at the start.
VARIANTS: dict[str, dict[str, Any]] = {
    "as published": {},
    "power of the text": {"power": 1.0},
    "batch 1": {"views.batch_size": 1},
    "degree 1": {"degree": 1},
    "degree 3": {"degree": 3},
    "one camera": {"views.two_cameras": False},
    "start from the clip": {"initialization": "static"},
    "start in a box of 1.1 frames": {"box": 1.1},
    "extent of 1 unit": {"extent": 1 / 1.1},
    "time gradient not used": {"strategy.growth.time_gradient": 1e9},
    "time gradient x0.25": {"strategy.growth.time_gradient": 5e-5},
    "time gradient splits": {"strategy.growth.clone_below_time": 1e-9},
    "half of the gradients": {"strategy.growth.screen_gradient": 1e-4, "strategy.growth.time_gradient": 1e-4},
    "opacity 0.005 pruned": {"strategy.growth.prune_opacity": 0.005},
    "radius above 20 px pruned": {"strategy.growth.prune_radius": 20.0},
    "wide Gaussians kept": {"strategy.growth.prune_scale": 1e9},
    "thin Gaussians drawn": {"strategy.scale_cutoff": 0.0},
    "no resets": {"strategy.growth.reset_every": 10**9},
    "rates x2": {"rates": 2.0},
    "positions learn to the end": {"rates.final": 1.0},
}

#: table:bs-pol: by batch size and, in this order, degrees: PSNR in dB and number of Gaussians at the end, in millions.
DEGREES = 1, 3, 5, 7, 9
PAPER_GRID = {
    1: ((36.73, 1.26), (37.31, 1.77), (37.30, 1.73), (37.36, 1.72), (37.42, 1.83)),
    3: ((38.15, 0.57), (38.31, 0.58), (38.39, 0.59), (38.53, 0.62), (38.24, 0.59)),
    5: ((37.84, 0.33), (37.94, 0.32), (37.95, 0.32), (37.92, 0.31), (37.94, 0.31)),
}
#: table:init-gauss: the same and the training time, by number of Gaussians at the start, for batch size 3 and degree 7.
PAPER_STARTS = {
    100_000: (38.53, 0.62, "57m00s"),
    200_000: (38.85, 0.62, "57m29s"),
    300_000: (38.99, 0.62, "58m03s"),
    400_000: (38.96, 0.64, "59m36s"),
    500_000: (39.02, 0.65, "58m58s"),
    600_000: (38.86, 0.66, "1h00m53s"),
}
#: Gaussians at the start, batch size and degree of all cells of both tables; the most telling first.
CELLS = {"as published": (500_000, 3, 7)} | {
    f"{start:,}, batch {batch}, degree {degree}": (start, batch, degree)
    for start, batch, degree in (
        *((100_000, batch, 7) for batch in (3, 1, 5)),
        *((100_000, 3, degree) for degree in (1, 3, 9, 5)),
        *((start, 3, 7) for start in (300_000, 600_000, 200_000, 400_000)),
        *((100_000, batch, degree) for degree in (1, 3, 9, 5) for batch in (1, 5)),
    )
}


def published(name: str) -> tuple[float, float] | None:
    """PSNR and millions of Gaussians at the end as the paper reports them, at `FULL`; None for other `VARIANTS`."""
    if name not in CELLS:
        return None
    start, batch, degree = CELLS[name]
    return PAPER_STARTS[start][:2] if (batch, degree) == (3, 7) else PAPER_GRID[batch][DEGREES.index(degree)]


def config_of(name: str, size: tuple[int, int], steps: int, seed: int) -> FitConfig:
    """The settings of a fit, in pixels the same at every size.

    Numbers are stated for `FULL` and in proportion to the pixels. Lengths in model space, in units of the longer side,
    grow as that side gets fewer pixels; so do gradients of the mean over all pixels by a position in half widths.
    """
    zoom = max(FULL) / max(size)
    if name in CELLS:
        changes = dict(zip(("num_gaussians", "views.batch_size", "degree"), CELLS[name], strict=True))
    else:
        changes = {setting: value for setting, value in VARIANTS[name].items() if setting != "box"}
    extent, factor = changes.pop("extent", 1.0), changes.pop("rates", 1.0)
    config = FitConfig.preset("paper", **changes, steps=steps, seed=seed)
    factors = {f"rates.{leaf}": factor for leaf in columns(0)} | {"rates.frame_times": factor}
    factors |= {"rates.loc": extent * factor * zoom, "rates.coefficients": factor * zoom, "strategy.scale_cutoff": zoom}
    factors |= {f"strategy.growth.{length}": zoom for length in ("screen_gradient", "time_gradient")}
    factors |= {f"strategy.growth.{length}": extent * zoom for length in ("clone_below", "prune_scale")}
    values = settings_by_name(config)
    scaled_values = {setting: by * values[setting] for setting, by in factors.items()}
    return config.replace(**scaled_values, num_gaussians=scaled(config.num_gaussians, size))


class Curve:
    """Steps, PSNR, number of Gaussians and CPU seconds of a fit, in a CSV file; a resumed fit continues it."""

    COLUMNS = ("step", "psnr", "gaussians", "cpu_seconds")

    def __init__(self, path: Path, state: FitState | None):
        self.path = path
        self.points: list[tuple[float, ...]] = []
        if state is not None and path.exists():
            self.points = [point for point in read_curve(path) if point[0] <= state.step]
        self.before = self.points[-1][-1] if self.points else 0.0
        self.begun = time.process_time()

    def cpu_seconds(self) -> float:
        return self.before + time.process_time() - self.begun

    def add(self, step: int, psnr: float, gaussians: int) -> None:
        self.points.append((step, round(psnr, 3), gaussians, round(self.cpu_seconds(), 1)))
        with atomic_path(self.path) as temporary, temporary.open("w", newline="") as file:
            csv.writer(file).writerows([self.COLUMNS, *self.points])


def read_curve(path: Path) -> list[tuple[float, ...]]:
    with path.open(newline="") as file:
        rows = [[row[name] for name in Curve.COLUMNS] for row in csv.DictReader(file)]
    return [(int(step), float(psnr), int(num), float(cpu)) for step, psnr, num, cpu in rows]


def curve_path(folder: Path, name: str) -> Path:
    return folder / f"{name.replace(' ', '-').replace(',', '').replace('.', '_')}.csv"


def plot_curves(folder: Path, names: Iterable[str], path: Path) -> None:
    """PSNR and number of Gaussians against steps, of the fits whose curves `folder` holds."""

    def draw(figure: Any) -> None:
        quality, numbers = figure.subplots(1, 2)
        for name in names:
            if curve_path(folder, name).exists():
                steps, psnr, num, _ = np.array(read_curve(curve_path(folder, name))).T
                quality.plot(steps / 1000, psnr, label=name, lw=1)
                numbers.plot(steps / 1000, num / 1e6, label=name, lw=1)
        quality.set(xlabel="thousands of steps", ylabel="running PSNR (dB)")
        numbers.set(xlabel="thousands of steps", ylabel="millions of Gaussians", ylim=(0, None))
        numbers.legend(fontsize=7)

    write_figure(path, draw, (9, 3.6))


def start_in_box(clip: Clip, config: FitConfig, factor: float) -> FitState:
    """The state before the first step, with distances between the Gaussians and their sizes `factor` times as large."""
    state, place = start(clip.frames, config), columns(config.fold_degree)
    state.rows[:, place["loc"]] *= np.float32(factor)
    state.rows[:, place["log_scale"]] += np.float32(math.log(factor))
    return state


def run_to_end(clip: Clip, name: str, config: FitConfig, folder: Path) -> Run:
    """A fit, continued after its checkpoint. Raises ValueError for a checkpoint of other settings or frames."""
    curve_file = curve_path(folder, name)
    checkpoint = Checkpoint(curve_file.with_suffix(".checkpoint"), config, fingerprint(clip))
    state = checkpoint.load()
    curve = Curve(curve_file, state)
    where = "" if state is None else f" continues after step {state.step:,}"
    if state is None and (box := VARIANTS.get(name, {}).get("box")):
        state = start_in_box(clip, config, box)
    console.print(f"{name}{where}", style="dim", soft_wrap=True)

    def observe(state: FitState, info) -> None:
        if info.step % EVERY == 0 or info.progress >= 1:
            curve.add(info.step, info.psnr, info.num_gaussians)

    state, info = run_steps(fit_steps(clip.frames, config, state), observe, checkpoint, CHECKPOINT_SECONDS)
    model = to_model(state, config, clip.size, clip.fps)
    run = scores(model, clip.frames) | {"gaussians": model.num_gaussians, "steps": info.step}
    run |= {"floats": model.num_parameters} | size_on_disk(model, clip)
    checkpoint.path.unlink(missing_ok=True)
    return run | {"seconds": info.seconds, "cpu_hours": curve.cpu_seconds() / 3600}


def run_default(clip: Clip, config: FitConfig) -> Run:
    """A fit whose minutes are processor time, of all threads together as `cpu_hours` are."""
    threads = num_threads()
    run = fitted(clip, dataclasses.replace(config, minutes=config.minutes / threads), cpu_time=True)[1]
    return run | {"cpu_hours": run["seconds"] * threads / 3600}


def show(runs: dict[str, Run], title: str, *, beside_paper: bool) -> None:
    """Print the fits, with differences to the first, for *Bunny* beside what the paper reports for `FULL`."""
    columns = "fit", "PSNR, dB", "", "worst frame", "SSIM", "Gaussians", "CPU hours", "paper: PSNR", "million"
    first, rows = next(iter(runs.values())), []
    for name, run in runs.items():
        gain = f"{run['psnr'] - first['psnr']:+.2f}"
        figures = f"{run['psnr']:.2f}", gain, f"{run['worst_psnr']:.2f}", f"{run['ssim']:.4f}"
        theirs = published(name) if beside_paper else None
        rows.append((name, *figures, f"{run['gaussians']:,}", f"{run['cpu_hours']:.2f}", *(theirs or ("", ""))))
    _common.print_table(title, columns, rows)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", type=Path, metavar="PATH", help="instead of Bunny")
    parser.add_argument("--folder", type=Path, required=True, help="of checkpoints and curves")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--size", type=_common.parse_size, metavar="HxW", default=FULL, help="[640x1280]")
    shown.add_argument("--crop", type=_common.parse_size, metavar="HxW", help="the central window, not resized")
    parser.add_argument("--frames", type=_common.frame_range, metavar="A:B", help="frames A <= i < B [all]")
    parser.add_argument("--steps", type=_common.whole, default=PUBLISHED_STEPS, help=f"[{PUBLISHED_STEPS:,}]")
    names = tuple(VARIANTS | CELLS)
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--tables", action="store_true", help="the cells of the paper's tables, not the variants")
    chosen.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"these of {'; '.join(names)}")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    parser.add_argument("--engine", choices=FIT_ENGINES, default="auto", help="that computes the steps [auto]")
    parser.add_argument("--default", action="store_true", help="beside the first fit, at equal number and time")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the curves here (PNG)")
    options = _common.parse(parser, arguments)
    path, size = options.clip or sample_clip("bunny"), None if options.crop else options.size
    clip = read_video(path, frames=options.frames, center_crop=options.crop, size=size)
    setting = {"size": clip.size, "frames": clip.num_frames, "steps": options.steps, "seed": options.seed}
    if options.crop:
        setting["cropped"] = True
    if options.clip:
        setting["clip"] = options.clip.stem
    options.folder.mkdir(parents=True, exist_ok=True)
    runs, done = Runs(options.json, setting), {}
    for name in options.only or (CELLS if options.tables else VARIANTS):
        config = config_of(name, clip.size, options.steps, options.seed)
        config = dataclasses.replace(config, engine=options.engine)
        done[name] = runs.get(name, lambda name=name, config=config: run_to_end(clip, name, config, options.folder))
    if options.default:
        first = next(iter(done.values()))
        equal = FitConfig(max_gaussians=first["gaussians"], minutes=60 * first["cpu_hours"], seed=options.seed)
        done["default"] = runs.get("default", lambda: run_default(clip, equal))
    name = options.clip.stem if options.clip else "Bunny"
    title = f"{name}, {clip.num_frames} frames of {clip.size[0]}x{clip.size[1]}, {options.steps:,} steps"
    show(done, title + (", not resized" if options.crop else ""), beside_paper=options.clip is None)
    if options.plot:
        plot_curves(options.folder, done, options.plot)
    runs.finish({f"psnr, {name}": run["psnr"] for name, run in done.items()})


if __name__ == "__main__":
    main()
