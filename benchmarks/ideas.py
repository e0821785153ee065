"""What single settings of a fit are worth: each changed alone, beside the default, in equal CPU time.

    python -m benchmarks.ideas --cpu-seconds S [--clips FOLDER] [--samples bunny|bikes|carphone ...] [--only NAME ...]
                               [--size HxW] [--frames N] [--seeds N] [--json FILE]

Each row is a fit with one setting changed and everything else as in `FitConfig()`: an idea of the default that is
switched off, or a value that a search by hand would try. Fits take one thread and S seconds of the CPU time of their
process, so that other work on the machine takes nothing from them. PSNR is the mean over all frames of 8-bit images,
and that of the worst frame. `VARIANTS` lists the rows; rows that change the number of Gaussians are relative to the
number that the default chose.

A clip of fewer frames or pixels with a budget in proportion has the same CPU time for each pixel, and so gets about as
many Gaussians for each pixel and visits to each frame: a search in ten minutes of 90 frames of 480x854 on two cores is
represented by 80 seconds with --frames 24 --size 240x427.

With --json each fit that is done is kept there, and the same command continues after it.
"""

import argparse
import functools
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common
from benchmarks._clips import SAMPLE_SIZES, folder_sources, sample_sources
from benchmarks._runs import Run, Runs, fit_by_clock, scores, warm_up
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import Clip
from foldgauss.render import RenderOptions
from foldgauss.video import FitConfig, FitDiverged, LearningRates
from foldgauss.video.models.row_layout import columns

DEFAULT = "default"


def scaled_rates(factor: float) -> dict[str, float]:
    leaves = (*columns(0), "frame_times", "paths")
    return {f"rates.{leaf}": factor * getattr(LearningRates(), leaf) for leaf in leaves}


#: The fields of `FitConfig` that each row changes; `gaussians` is a factor on the number that the default chose.
VARIANTS: dict[str, dict[str, Any]] = {
    "starts at rest": {"initialization": "static"},
    "camera not followed": {"follow_camera": False},
    "rates not in own units": {"rates.own_units": False},
    "frame times fixed": {"rates.frame_times": 0.0},
    "low pass 0.3 px^2": {"options": RenderOptions()},
    "Gaussians x0.5": {"gaussians": 0.5},
    "Gaussians x0.7": {"gaussians": 0.7},
    "Gaussians x1.5": {"gaussians": 1.5},
    "Gaussians x2": {"gaussians": 2.0},
    "Gaussians x3": {"gaussians": 3.0},
    "rates x0.7": scaled_rates(0.7),
    "rates x1.4": scaled_rates(1.4),
    "final rate 0.1": {"rates.final": 0.1},
    "final rate 0.4": {"rates.final": 0.4},
    "cooldown 0.5": {"rates.cooldown": 0.5},
    "degree 1": {"degree": 1},
    "degree 2": {"degree": 2},
    "no squared error": {"loss.l2_fraction": 0.0},
    "squared error 0.6": {"loss.l2_fraction": 0.6},
    "D-SSIM 0": {"loss.ssim_fraction": 0.0},
    "D-SSIM 0.1": {"loss.ssim_fraction": 0.1},
    "views by error 0": {"views.error_fraction": 0.0},
    "views by error 0.6": {"views.error_fraction": 0.6},
    "relocated 0": {"strategy.relocated_fraction": 0.0},
    "relocated 0.1": {"strategy.relocated_fraction": 0.1},
    "2 frames a step": {"views.batch_size": 2},
}


def config_of(name: str, cpu_seconds: float, seed: int, chosen: int | None) -> FitConfig:
    """The settings of a row; `chosen`: the number of Gaussians of the default's fit."""
    changes = dict(VARIANTS.get(name, {}))
    factor = changes.pop("gaussians", None)
    num = None if factor is None else round(factor * chosen)
    return FitConfig(minutes=cpu_seconds / 60, num_gaussians=num, seed=seed).replace(**changes)


def fit_row(clip: Clip, config: FitConfig) -> Run:
    """The quality of a fit, or only that it diverged."""
    warm_up(clip.num_frames)
    try:
        result = fit_by_clock(clip.frames, config, clip.fps)
    except FitDiverged as error:
        return {"diverged": str(error)}
    last = result.history[-1]
    run = {"gaussians": result.model.num_gaussians, "steps": last.step, "cpu_seconds": last.seconds}
    return scores(result.model, clip.frames) | run


def measure(options: argparse.Namespace, runs: Runs) -> dict[str, dict[str, list[Run]]]:
    """The runs of every seed by clip and row, the default first."""
    found: dict[str, dict[str, list[Run]]] = {}
    sources = sample_sources(options.samples) + (folder_sources(options.clips) if options.clips else [])
    if not sources:
        raise SystemExit("No clips: give --clips FOLDER, or --samples with some of " + ", ".join(SAMPLE_SIZES) + ".")
    for source in sources:
        clip = source._replace(size=options.size or source.size, frames=options.frames).read()
        rows = found[source.name] = {name: [] for name in (DEFAULT, *options.only)}
        for seed in range(options.seeds):
            for name in rows:
                chosen = rows[DEFAULT][seed]["gaussians"] if name != DEFAULT else None
                config = config_of(name, options.cpu_seconds, seed, chosen)
                fit_it = functools.partial(fit_row, clip, config)
                rows[name].append(runs.get(f"{source.name}, seed {seed}, {name}", fit_it))
    return found


def means(runs: list[Run]) -> tuple[float, float]:
    """Mean PSNR and that of the worst frame, over the seeds; NaN where a fit diverged."""
    return tuple(float(np.mean([run.get(name, np.nan) for run in runs])) for name in ("psnr", "worst_psnr"))


def show(clip: str, rows: dict[str, list[Run]], options: argparse.Namespace) -> dict[str, float]:
    """Print a clip's table, best first; returns its figures."""
    default, worst = means(rows[DEFAULT])
    shown = []
    for name, runs in sorted(rows.items(), key=lambda row: -np.nan_to_num(means(row[1])[0])):
        psnr, lowest = means(runs)
        counts = (f"{np.mean([run.get(key, np.nan) for run in runs]):,.0f}" for key in ("gaussians", "steps"))
        quality = f"{psnr:.2f}", f"{psnr - default:+.2f}", f"{lowest:.2f}", f"{lowest - worst:+.2f}"
        shown.append((name, *quality, *counts))
    title = f"{clip}: {options.cpu_seconds:g} s of one core, {options.seeds} seed(s)"
    columns = "changed", "PSNR, dB", "gain", "worst frame", "gain", "Gaussians", "steps"
    _common.print_table(title, columns, shown)
    figures = {f"{clip}_{name}_gain": means(runs)[0] - default for name, runs in rows.items() if name != DEFAULT}
    return {f"{clip}_{DEFAULT}_psnr": default} | figures


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--cpu-seconds", type=_common.positive, required=True, metavar="S", help="of each fit")
    parser.add_argument("--clips", type=Path, metavar="FOLDER", help="whose subfolders of images are the clips")
    parser.add_argument("--samples", nargs="+", choices=tuple(SAMPLE_SIZES), default=[], help="sample clips [none]")
    names = tuple(VARIANTS)
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME", help=f"[{', '.join(names)}]")
    parser.add_argument("--size", type=_common.parse_size, metavar="HxW", help="of all clips [each its own]")
    parser.add_argument("--frames", type=_common.whole, metavar="N", help="only the first N of each clip [all]")
    parser.add_argument("--seeds", type=_common.whole, default=1, help="[1]")
    options = _common.parse(parser, arguments)
    set_num_threads(1)
    runs = Runs(options.json, {name: getattr(options, name) for name in ("cpu_seconds", "size", "frames")})
    figures = {}
    for clip, rows in measure(options, runs).items():
        figures |= show(clip, rows, options)
    runs.finish(figures)


if __name__ == "__main__":
    main()
