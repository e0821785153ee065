"""What folds bring: a folded video against every frame its own Gaussians (eq:miragevideo), at equal parameters stored.

    python -m benchmarks.folding_gain [--json FILE] [--clip bunny|bikes|carphone|PATH ...] [--size HxW] [--frames A:B]
                                      [--minutes M | --steps N] [--longer F] [--gaussians N] [--seed S]

Without options: *bunny* at 160x320, *bikes* and *carphone* at their own sizes, 3 minutes for each of the two fits, some
20 minutes in all. The default fit first; then `independent_frames` with as many numbers (a Gaussian of one frame takes
9: it has no time, no sigma_t and no fold) in as many seconds of fitting. With --json each fit that is done is kept
there, and the same command goes on after it. With --steps both see every frame equally often instead: a try, not a fair
match, since a step of a few hundred Gaussians costs less. `--longer F` adds the control with F times the time or steps:
what it comes to if it may.

PSNR and SSIM are of 8-bit pictures, mean over all frames.
"""

import dataclasses
from pathlib import Path

from benchmarks import _common, fit_clip, presets
from benchmarks._common import console
from benchmarks._runs import Run, Runs, fitted, scores
from foldgauss.io import Clip, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.video import FitConfig, independent_frames

SIZES = {"bunny": (160, 320), "bikes": None, "carphone": None}
MINUTES = 3.0
FOLDED, ALONE = "folded", "independent frames"


def of_frames(clip: Clip, num_parameters: int, config: FitConfig) -> Run:
    """The control's quality and what it took."""
    made = independent_frames(clip.frames, num_parameters, config, fps=clip.fps)
    run = scores(made, clip.frames) | {"gaussians": made.num_gaussians, "floats": made.num_parameters}
    return run | {"steps": made.steps, "frames_seen": made.steps * config.batch_size, "seconds": made.seconds}


def measure(name: str, clip: Clip, config: FitConfig, runs: Runs, longer: float | None = None) -> dict[str, Run]:
    """Both fits of a clip; and with `longer` the control with so many times the budget."""
    folded = runs.get(f"{name} {FOLDED}", lambda: fitted(clip, config)[1])
    times = {ALONE: 1.0} | ({f"{ALONE}, {longer:g} times as long": longer} if longer else {})
    made = {FOLDED: folded}
    for title, factor in times.items():
        if config.minutes is not None:
            budget = {"minutes": factor * folded["seconds"] / 60}
        else:
            budget = {"steps": max(round(factor * folded["steps"] / clip.num_frames), 1)}
        own = dataclasses.replace(config, num_gaussians=None, **budget)
        made[title] = runs.get(f"{name} {title}", lambda own=own: of_frames(clip, folded["floats"], own))
    return made


def show(title: str, made: dict[str, Run]) -> None:
    columns = "PSNR, dB", "worst", "SSIM", "Gaussians", "parameters stored", "frames seen", "minutes"
    table = _common.table(title, "fit", *columns)
    for name, run in made.items():
        quality = f"{run['psnr']:.2f}", f"{run['worst_psnr']:.2f}", f"{run['ssim']:.4f}"
        counts = (f"{run[count]:,}" for count in ("gaussians", "floats", "frames_seen"))
        table.add_row(name, *quality, *counts, f"{run['seconds'] / 60:.2f}")
    table.add_section()
    for name, run in list(made.items())[1:]:
        table.add_row(f"folded above {name}", f"{made[FOLDED]['psnr'] - run['psnr']:+.2f}")
    console.print(table)


def main(arguments: list[str] | None = None) -> None:
    parser = _parser()
    options = _common.parse(parser, arguments)
    budget = {"steps": options.steps} if options.steps else {"minutes": options.minutes}
    kept = {"size": options.size, "frames": options.frames, "gaussians": options.gaussians, "seed": options.seed}
    try:
        runs = Runs(options.json, kept | budget)
    except ValueError as error:
        parser.error(str(error))
    figures = {}
    for name in options.clip or tuple(SIZES):
        path = sample_clip(name) if name in fit_clip.SAMPLES else Path(name)
        clip = read_video(path, frames=options.frames, size=options.size or SIZES.get(name))
        config = FitConfig(num_gaussians=options.gaussians, seed=options.seed, **budget)
        made = measure(path.name, clip, config, runs, options.longer)
        show(f"{path.stem}: {clip.num_frames} frames of {clip.size[0]}x{clip.size[1]}, seed {options.seed}", made)
        for title, run in list(made.items())[1:]:
            end = "" if title == ALONE else f"_over_{options.longer:g}_times_as_long"
            figures[f"gain_{Path(name).stem}{end}"] = made[FOLDED]["psnr"] - run["psnr"]
    _common.finish(None, figures, _common.describe_machine())
    runs.write(figures=figures)


def _parser():
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", action="append", help="a sample clip or a path; may be given again [all three]")
    parser.add_argument("--size", type=_common.size, metavar="HxW", help="[160x320 for bunny, else the clip's]")
    parser.add_argument("--frames", type=fit_clip._frames, metavar="A:B", help="frames A <= i < B [all]")
    parser.add_argument("--gaussians", type=_common.whole, help="of the folded fit [by the frame's size]")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=presets.minutes, default=MINUTES, help=f"of each fit [{MINUTES:g}]")
    length.add_argument("--steps", type=_common.whole, help="of the folded fit, instead of minutes")
    parser.add_argument("--longer", type=presets.minutes, metavar="F", help="the control again, F times as long")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    return parser


if __name__ == "__main__":
    main()
