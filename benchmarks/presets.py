"""The published recipe against the default: `paper` and `standard` at equal time, and at equal numbers of Gaussians.

    python -m benchmarks.presets [--json FILE] [--clip bunny|bikes|carphone|PATH] [--size HxW ...] [--frames A:B]
                                 [--minutes M] [--seed S]

Without options: *Bunny* at 160x320 and at 320x640, 5 minutes a fit, three fits a size, half an hour in all, and the
tries. With --json each fit that is done is kept there, and the same command goes on after it.

- `paper`: 500,000 Gaussians for 640x1280, in proportion to the pixels here, which grow as published. As many steps as
  will take the minutes, by the pace of a try before: so its schedule comes to its end, somewhat sooner or later.
- `standard`: its own number of Gaussians, for as long as `paper` took;
- `standard` with as many Gaussians as `paper` ended with, for as long.

Time is that of fitting; rates of `paper` are not scaled to short plans, see `FitConfig.preset`. PSNR and SSIM are of
8-bit pictures, mean over all frames.
"""

import argparse
import dataclasses
import math
from pathlib import Path

from benchmarks import _common, fit_clip
from benchmarks._common import console
from benchmarks._runs import Run, Runs, fitted, scaled, seconds_per_step, told
from foldgauss.io import Clip, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.video import FitConfig
from foldgauss.video.fitting.config import PRESETS

SIZES, MINUTES = ((160, 320), (320, 640)), 5.0
#: The pace of `paper` is that with so many times the Gaussians at the start. Small frames grow more than the paper's
#: 1.3 times (table:init-gauss): there is more to see in each pixel. (Bunny 80x160, 1,668 steps: 4.9 times by the end.)
GROWN = 4
EARLY, TRIES = 0.8, 3
#: Gaussians grow more in longer plans: the steps that fit into a time grow with this power of it. (Bunny 160x320: 1,510
#: steps in 122 s, 3,247 in 848 s.)
LONGER = 0.4
EQUAL = "standard, Gaussians of paper"


def of_paper(clip: Clip, minutes: float, seed: int) -> Run:
    """A fit by the published recipe, whose steps are planned to take `minutes`.

    How many Gaussians there will be is not known before, so nor is the pace: a fit that ends before `EARLY` of its time
    is planned anew by its own, and that one counts.
    """
    num = scaled(PRESETS["paper"]["num_gaussians"], clip.size)
    config = FitConfig.preset("paper", num_gaussians=num, seed=seed)
    steps = 60 * minutes / seconds_per_step(clip, config, GROWN * num)
    for tries in range(TRIES, 0, -1):
        run = fitted(clip, dataclasses.replace(config, steps=max(round(steps), 1)))[1]
        done = run["seconds"] / (60 * minutes)
        if done >= EARLY or tries == 1:
            break
        console.print(f"  {told(run)}: planned anew, for {minutes:g} minutes", style="dim", soft_wrap=True)
        steps = run["steps"] * done**-LONGER
    return run


def measure(clip: Clip, runs: Runs, minutes: float, seed: int) -> dict[str, Run]:
    """The three fits of one size."""
    shape = "x".join(map(str, clip.size))
    paper = runs.get(f"{shape} paper", lambda: of_paper(clip, minutes, seed))
    budget = {"minutes": paper["seconds"] / 60, "seed": seed}
    numbers = {"standard": None, EQUAL: paper["gaussians"]}
    others = {
        name: runs.get(f"{shape} {name}", lambda num=num: fitted(clip, FitConfig(num_gaussians=num, **budget))[1])
        for name, num in numbers.items()
    }
    return {"paper": paper, **others}


def gains(made: dict[str, Run]) -> dict[str, float]:
    """dB of `standard` above `paper`."""
    paper = made["paper"]["psnr"]
    return {
        "gain_equal_time": made["standard"]["psnr"] - paper,
        "gain_equal_gaussians": made[EQUAL]["psnr"] - paper,
    }


def show(title: str, made: dict[str, Run]) -> None:
    columns = "PSNR, dB", "SSIM", "Gaussians", "steps", "frames seen", "minutes", "above paper, dB"
    table = _common.table(title, "preset", *columns)
    for name, run in made.items():
        numbers = f"{run['psnr']:.2f}", f"{run['ssim']:.4f}", f"{run['gaussians']:,}", f"{run['steps']:,}"
        gain = run["psnr"] - made["paper"]["psnr"]
        table.add_row(name, *numbers, f"{run['frames_seen']:,}", f"{run['seconds'] / 60:.1f}", f"{gain:+.2f}")
    console.print(table)


def main(arguments: list[str] | None = None) -> None:
    parser = _parser()
    options = _common.parse(parser, arguments)
    path = sample_clip(options.clip) if options.clip in fit_clip.SAMPLES else Path(options.clip)
    setting = {"clip": Path(options.clip).name, "frames": options.frames, "minutes": options.minutes}
    try:
        runs = Runs(options.json, setting | {"seed": options.seed})
    except ValueError as error:
        parser.error(str(error))
    figures = {}
    for size in options.size or SIZES:
        clip = read_video(path, frames=options.frames, size=size)
        made = measure(clip, runs, options.minutes, options.seed)
        show(f"{setting['clip']}, {clip.num_frames} frames of {size[0]}x{size[1]}, seed {options.seed}", made)
        figures |= {f"{name}_{size[0]}x{size[1]}": gain for name, gain in gains(made).items()}
    _common.finish(None, figures, _common.describe_machine())
    runs.write(figures=figures)


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", default="bunny", help="a sample clip or a path [bunny]")
    parser.add_argument("--size", type=_common.size, action="append", metavar="HxW", help="[160x320 and 320x640]")
    parser.add_argument("--frames", type=fit_clip._frames, metavar="A:B", help="frames A <= i < B [all]")
    parser.add_argument("--minutes", type=minutes, default=MINUTES, help=f"of each fit [{MINUTES:g}]")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    return parser


def minutes(text: str) -> float:
    """argparse type: a number > 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number > 0, got {text!r}")
    return value


if __name__ == "__main__":
    main()
