"""The paper's two ablation tables, at a size and for a number of steps that a desk machine has time for.

    python -m benchmarks.ablation [--json FILE] [--size HxW] [--minutes M | --steps N] [--preset paper|standard]
                                  [--clip bunny|bikes|carphone|PATH] [--frames A:B] [--seed S]

Batches of 1, 3, 5 by degrees 1, 3, 5, 7, 9 (table:bs-pol), and 0.1 to 0.6 million Gaussians at the start
(table:init-gauss; batches of 3, degree 7): 20 fits, as the two tables have one in common. (The paper's has 38.53 dB and
0.62 million Gaussians in both tables: so all of table:bs-pol starts from 0.1 million.)

Without options: *Bunny* at 160x320, all fits within 60 minutes together. Numbers of Gaussians, given for 640x1280, are
in proportion to the pixels. All fits take the same number of steps, 2,000 or as many as the minutes allow by a short
timing of each batch size, or --steps. A step of batch 5 sees five times the
frames of one of batch 1, in the paper as here: frames seen stand beside the steps. With --json each fit that is done is
kept there, and the same command goes on after it, with the same steps.

PSNR is of 8-bit pictures, mean over all frames. `benchmarks.ideas` asks the same of the ideas of the default fit.
"""

import dataclasses
import statistics
from pathlib import Path

from benchmarks import _common, fit_clip, presets
from benchmarks._common import console
from benchmarks._runs import Run, Runs, fitted, kept_setting, scaled, seconds_per_step
from foldgauss.io import Clip, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.video import FitConfig

SIZE, MINUTES = (160, 320), 60.0
BATCHES, DEGREES, STARTS = (1, 3, 5), (1, 3, 5, 7, 9), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)  # the last in millions
#: That cell of table:bs-pol which table:init-gauss has, too.
BATCH, DEGREE = 3, 7
#: table:bs-pol: PSNR in dB and millions of Gaussians at the end, by batch and degree; and the mean training time.
PAPER_GRID = {
    1: ((36.73, 1.26), (37.31, 1.77), (37.30, 1.73), (37.36, 1.72), (37.42, 1.83)),
    3: ((38.15, 0.57), (38.31, 0.58), (38.39, 0.59), (38.53, 0.62), (38.24, 0.59)),
    5: ((37.84, 0.33), (37.94, 0.32), (37.95, 0.32), (37.92, 0.31), (37.94, 0.31)),
}
PAPER_TIMES = {1: "31m20s", 3: "56m30s", 5: "1h15m29s"}
#: table:init-gauss: PSNR in dB, millions of Gaussians at the end, training time, by millions at the start.
PAPER_STARTS = {
    0.1: (38.53, 0.62, "57m00s"),
    0.2: (38.85, 0.62, "57m29s"),
    0.3: (38.99, 0.62, "58m03s"),
    0.4: (38.96, 0.64, "59m36s"),
    0.5: (39.02, 0.65, "58m58s"),
    0.6: (38.86, 0.66, "1h00m53s"),
}
PAPER_STEPS = 30_000
#: Steps of every fit, where there is time for them; and the Gaussians, by batch size, at 160x320, by which a step is
#: timed. Small frames grow more than the paper's, and longer plans more often: from 6,250 at the start batches of 1, 3,
#: 5 come to 35,986, 22,710 and 14,418 with 1,500 steps; batches of 3 to 57,474 after 1,050 of 3,000 steps.
STEPS, GROWN = 2000, {1: 100_000, 3: 40_000, 5: 25_000}
#: Of the minutes, what fits may take by the estimate: the rest is evaluation, and slow minutes.
USABLE = 0.85
#: dB: a difference that says nothing, as seeds differ by as much; and what is little beyond degree 3.
NOTHING, LITTLE = 0.1, 0.3


@dataclasses.dataclass(frozen=True)
class Cell:
    """A fit of the tables; `start` is in millions of Gaussians at 640x1280."""

    batch: int
    degree: int
    start: float

    @property
    def name(self) -> str:
        return f"batch {self.batch}, degree {self.degree}, {self.start:g} M"

    def config(self, preset: str, size: tuple[int, int], steps: int, seed: int) -> FitConfig:
        num = scaled(1e6 * self.start, size)
        own = {"num_gaussians": num, "degree": self.degree, "batch_size": self.batch}
        return FitConfig.preset(preset, **own, steps=steps, seed=seed)


def cells() -> list[Cell]:
    """All fits, those of batch 3 first: if time runs out, the cheapest table is whole."""
    grid = [Cell(batch, degree, STARTS[0]) for batch in (BATCH, 1, 5) for degree in DEGREES]
    return [*grid[: len(DEGREES)], *(Cell(BATCH, DEGREE, start) for start in STARTS[1:]), *grid[len(DEGREES) :]]


def seconds_of_a_step(clip: Clip, preset: str) -> dict[int, float]:
    """By batch size: with the middle degree and as many Gaussians as there are in the end."""
    middle, made = DEGREES[len(DEGREES) // 2], {}
    for batch in BATCHES:
        config = Cell(batch, middle, STARTS[0]).config(preset, clip.size, steps=1, seed=0)
        num = config.num_gaussians if config.growth is None else scaled(GROWN[batch], clip.size, SIZE)
        made[batch] = seconds_per_step(clip, config, num)
    return made


def steps_within(minutes: float, pace: dict[int, float]) -> int:
    """Steps of every fit, so that all fits take `minutes` at the most: two leading figures."""
    steps = int(60 * minutes * USABLE / sum(pace[cell.batch] for cell in cells()))
    digits = 10 ** max(len(str(steps)) - 2, 0)
    return min(max(steps // digits * digits, 1), STEPS)


def measure(clip: Clip, runs: Runs, preset: str, steps: int, seed: int) -> dict[Cell, Run]:
    """All fits, one after another."""
    made, every = {}, cells()
    for count, cell in enumerate(every, 1):
        config = cell.config(preset, clip.size, steps, seed)
        made[cell] = runs.get(cell.name, lambda config=config: fitted(clip, config, with_ssim=False)[1])
        spent, seen = sum(run["seconds"] for run in made.values()) / 60, sum(cell.batch for cell in made)
        whole = spent * sum(cell.batch for cell in every) / seen
        text = f"{count} of {len(every)} fits, {spent:.1f} minutes; by the frames seen, all will take {whole:.0f}"
        console.print(text, style="dim", soft_wrap=True)
    return made


def show_grid(made: dict[Cell, Run], steps: int) -> None:
    """table:bs-pol, the paper's below ours."""
    columns = [f"degree {degree}" for degree in DEGREES]
    table = _common.table(
        "PSNR, dB (Gaussians at the end), and the paper's (table:bs-pol)",
        "batch",
        *columns,
        "steps",
        "frames seen",
        "mean time",
    )
    for batch in BATCHES:
        own = [made[Cell(batch, degree, STARTS[0])] for degree in DEGREES]
        shown = (f"{run['psnr']:.2f} ({count(run['gaussians'])})" for run in own)
        seconds = sum(run["seconds"] for run in own) / len(own)
        table.add_row(f"{batch}, here", *shown, f"{steps:,}", f"{batch * steps:,}", clock(seconds))
    table.add_section()
    for batch, row in PAPER_GRID.items():
        shown = (f"{psnr:.2f} ({num:.2f}M)" for psnr, num in row)
        frames = f"{batch * PAPER_STEPS:,}"
        table.add_row(f"{batch}, paper", *shown, f"{PAPER_STEPS:,}", frames, PAPER_TIMES[batch])
    console.print(table)


def show_starts(made: dict[Cell, Run], size: tuple[int, int], steps: int) -> None:
    """table:init-gauss beside ours."""
    title = f"Batch {BATCH}, degree {DEGREE}, {steps:,} steps here, {PAPER_STEPS:,} in the paper (table:init-gauss)"
    columns = "at the start", "PSNR, dB", "at the end", "time", "paper: PSNR, dB", "at the end", "time"
    table = _common.table(title, "initial Gaussians", *columns)
    for start, (psnr, end, time) in PAPER_STARTS.items():
        run = made[Cell(BATCH, DEGREE, start)]
        own = count(scaled(1e6 * start, size)), f"{run['psnr']:.2f}", count(run["gaussians"]), clock(run["seconds"])
        table.add_row(f"{start:.2f}M", *own, f"{psnr:.2f}", f"{end:.2f}M", time)
    console.print(table)


def trend(made: dict[Cell, Run]) -> list[str]:
    """Whether what the paper finds is so here, in words: by the numbers alone."""
    grid = {(batch, degree): made[Cell(batch, degree, STARTS[0])]["psnr"] for batch in BATCHES for degree in DEGREES}
    return [_best_batch(grid), _best_cell(grid), _higher_degrees(grid), _best_start(made)]


def _said(claim: str, holds: bool, figures: str) -> str:
    return f"{claim}: {'holds' if holds else 'does not hold'}. {figures}"


def _best_batch(grid: dict[tuple[int, int], float]) -> str:
    means = {batch: statistics.fmean(grid[batch, degree] for degree in DEGREES) for batch in BATCHES}
    first, *others = sorted(means, key=means.get, reverse=True)
    over = " and ".join(f"{means[first] - means[other]:.2f} dB over batch {other}" for other in others)
    return _said(f"Batch {BATCH} best, mean over degrees", first == BATCH, f"Batch {first} is, by {over}.")


def _best_cell(grid: dict[tuple[int, int], float]) -> str:
    batch, degree = max(grid, key=grid.get)
    short = grid[batch, degree] - grid[BATCH, DEGREE]
    figures = f"Batch {batch} with degree {degree} is, by {short:.2f} dB over that"
    figures += ", which says nothing." if 0 < short < NOTHING else "."
    return _said(f"Batch {BATCH} with degree {DEGREE} best of all", short == 0, figures if short else "")


def _higher_degrees(grid: dict[tuple[int, int], float]) -> str:
    beyond = {batch: max(grid[batch, degree] for degree in DEGREES if degree > 3) - grid[batch, 3] for batch in BATCHES}
    up_to = ", ".join(f"{grid[batch, 3] - grid[batch, 1]:+.2f}" for batch in BATCHES)
    figures = ", ".join(f"{gain:+.2f} dB with batch {batch}" for batch, gain in beyond.items())
    figures = f"The best higher degree brings {figures}; degree 3 over degree 1 {up_to}."
    return _said(f"Below {LITTLE:g} dB beyond degree 3 (the paper: 0.22)", max(beyond.values()) < LITTLE, figures)


def _best_start(made: dict[Cell, Run]) -> str:
    starts = {start: made[Cell(BATCH, DEGREE, start)]["psnr"] for start in STARTS}
    top = max(starts, key=starts.get)
    figures = f"{top:g} M is, by {starts[top] - starts[0.1]:.2f} dB over 0.1 M (the paper: 0.49)"
    figures += "." if top == 0.5 else f" and {starts[top] - starts[0.5]:.2f} over 0.5 M."
    return _said("Half a million at the start best", top == 0.5, figures)


def count(num: float) -> str:
    return f"{num / 1e6:.2f}M" if num >= 1e6 else f"{num / 1e3:.1f}k"


def clock(seconds: float) -> str:
    """As the paper writes times."""
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}h{minutes % 60:02}m{seconds:02}s" if minutes >= 60 else f"{minutes}m{seconds:02}s"


def main(arguments: list[str] | None = None) -> None:
    parser = _parser()
    options = _common.parse(parser, arguments)
    path = sample_clip(options.clip) if options.clip in fit_clip.SAMPLES else Path(options.clip)
    clip = read_video(path, frames=options.frames, size=options.size)
    steps = options.steps or kept_setting(options.json, "steps") or planned(clip, options)
    setting = {"clip": Path(options.clip).name, "size": clip.size, "frames": options.frames}
    setting |= {"preset": options.preset, "steps": steps, "seed": options.seed}
    try:
        runs = Runs(options.json, setting)
    except ValueError as error:
        parser.error(str(error))
    height, width = clip.size
    title = f"{setting['clip']}, {clip.num_frames} frames of {height}x{width}, preset {options.preset}"
    console.print(f"{title}: {len(cells())} fits of {steps:,} steps")
    made = measure(clip, runs, options.preset, steps, options.seed)
    console.print(f"\n{title}, seed {options.seed}", soft_wrap=True)
    show_grid(made, steps)
    show_starts(made, clip.size, steps)
    words = trend(made)
    console.print("What the paper finds:", *words, sep="\n- ", soft_wrap=True)
    console.print(
        "machine: " + ", ".join(f"{name} {value}" for name, value in _common.describe_machine().items()), style="dim"
    )
    figures = {f"psnr, {cell.name}": run["psnr"] for cell, run in made.items()}
    runs.write(figures=figures, trend=words)


def planned(clip: Clip, options) -> int:
    """The number of steps, and a word on how it comes about."""
    pace = seconds_of_a_step(clip, options.preset)
    steps = steps_within(options.minutes, pace)
    told = ", ".join(f"{1e3 * seconds:.1f} ms a step of batch {batch}" for batch, seconds in pace.items())
    console.print(f"timing: {told}", soft_wrap=True)
    each = ", ".join(f"{steps * seconds / 60:.1f} with batch {batch}" for batch, seconds in pace.items())
    total = steps * sum(pace[cell.batch] for cell in cells()) / 60
    console.print(
        f"{steps:,} steps for every fit: estimated minutes of each {each}; {total:.0f} in all, and evaluation",
        soft_wrap=True,
    )
    return steps


def _parser():
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", default="bunny", help="a sample clip or a path [bunny]")
    parser.add_argument("--size", type=_common.size, metavar="HxW", default=SIZE, help="[160x320]")
    parser.add_argument("--frames", type=fit_clip._frames, metavar="A:B", help="frames A <= i < B [all]")
    parser.add_argument(
        "--preset", choices=("paper", "standard"), default="paper", help="what all else is as in [paper]"
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=presets.minutes, default=MINUTES, help=f"for all fits together [{MINUTES:g}]")
    length.add_argument("--steps", type=_common.whole, help="of every fit, instead of minutes")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    return parser


if __name__ == "__main__":
    main()
