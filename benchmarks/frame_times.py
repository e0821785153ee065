"""Learned frame times against fixed ones, on a clip that has lost frames and shows others twice.

    python -m benchmarks.frame_times [--json FILE] [--plot FILE] [--clip carphone|bunny|bikes|PATH] [--size HxW]
                                     [--frames A:B] [--gaussians N] [--minutes M | --steps N] [--seed S]

Without options: *carphone*, of which 15% of the frames are left out and 15% of the rest shown twice, at random; 2
minutes for each of two fits that do not follow the camera, alike but for the learning rate of the frame times, which is
0 in one. The true time of a frame is its place in the clip as it was, in frame intervals; the first and the last frame
stay, since a model's times begin at 0 and end at 1. (*Bunny* has doubled frames of its own, of which this would know
nothing.)

The table has the PSNR of both fits and three figures of the learned times: their root mean square error beside that
of even times, the correlation of learned and true deviations from even times, and the correlation of learned and true
intervals between frames. The last is the most informative one, since folds can absorb a slow drift of the times.
`--plot` draws all.
With --json each fit that is done is kept there, and the same command continues after it.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common
from benchmarks._clips import clip_path
from benchmarks._runs import Run, Runs, fitted
from foldgauss.io import Clip, read_video
from foldgauss.io.figures import write_figure
from foldgauss.video import FitConfig

MINUTES = 2.0
#: Fraction of the frames that are left out, and of the rest that are shown twice.
FRACTION = 0.15
FIXED = "fixed"
LEARNED = "learned"


def uneven(num_frames: int, fraction: float, seed: int) -> np.ndarray:
    """Which frames are shown, in order: a fraction left out, and one of the rest shown twice; never the ends."""
    inner = np.random.default_rng([seed, 8]).permutation(np.arange(1, num_frames - 1))
    inner = inner[round(fraction * len(inner)) :]
    twice = inner[: round(fraction * len(inner))]
    return np.sort(np.concatenate([[0, num_frames - 1], inner, twice]))


def recovered(times: np.ndarray, shown: np.ndarray) -> dict[str, float]:
    """How well model times, in [0, 1], tell which frames are shown; in frame intervals of the clip as it was."""
    even, found = np.linspace(0, shown[-1], len(shown)), np.asarray(times, np.float64) * shown[-1]
    steps, true_steps = np.diff(found), np.diff(shown)
    return {
        "rmse": float(np.sqrt(np.mean((found - shown) ** 2))),
        "rmse_even": float(np.sqrt(np.mean((even - shown) ** 2))),
        "correlation": float(np.corrcoef(found - even, shown - even)[0, 1]),
        "correlation_of_steps": float(np.corrcoef(steps, true_steps)[0, 1]),
        "step_where_doubled": float(steps[true_steps == 0].mean()),
        "step_where_dropped": float(steps[true_steps > 1].mean()),
        "step_elsewhere": float(steps[true_steps == 1].mean()),
    }


def run(clip: Clip, config: FitConfig) -> Run:
    """A fit, and its times."""
    model, made = fitted(clip, config)
    return made | {"times": np.asarray(model.frame_times.times(), np.float64).tolist()}


def plot(path: Path, times: np.ndarray, shown: np.ndarray) -> None:
    """Deviations from even times above, steps below."""
    even, found = np.linspace(0, shown[-1], len(shown)), times * shown[-1]

    def draw(figure: Any) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(shown - even, color="0.6", linewidth=3, label="true")
        above.plot(found - even, color="C3", linewidth=1, label="learned")
        above.set(ylabel="off even times, frames")
        above.legend()
        below.step(range(len(shown) - 1), np.diff(shown), color="0.6", linewidth=3, where="mid")
        below.plot(np.diff(found), ".", color="C3")
        below.set(xlabel="frame shown", ylabel="step to the next, frames")

    write_figure(path, draw, (9, 5))


def main(arguments: list[str] | None = None) -> None:
    parser = _common.fit_parser(__doc__, MINUTES)
    parser.add_argument("--size", type=_common.parse_size, metavar="HxW", help="of the frames [see above]")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the times here (PNG)")
    parser.add_argument("--clip", default="carphone", help="a sample clip or a path [carphone]")
    options = _common.parse(parser, arguments)
    path, budget = clip_path(options.clip), _common.budget(options)
    whole = read_video(path, frames=options.frames, size=options.size)
    shown = uneven(whole.num_frames, FRACTION, options.seed)
    clip = dataclasses.replace(whole, frames=np.ascontiguousarray(whole.frames[shown]))
    kept = {name: getattr(options, name) for name in ("frames", "gaussians", "seed")}
    runs = Runs(options.json, kept | {"clip": path.name, "size": whole.size} | budget)
    # Maps of the camera at each frame would absorb the information of its time.
    config = FitConfig(num_gaussians=options.gaussians, seed=options.seed, follow_camera=False, **budget)
    made = {}
    for name in (FIXED, LEARNED):
        own = config if name == LEARNED else config.replace(**{"rates.frame_times": 0})
        made[name] = runs.get(name, lambda own=own: run(clip, own))
    times = np.asarray(made[LEARNED]["times"])
    forms = {"psnr": ".2f", "worst_psnr": ".2f", "ssim": ".4f", "steps": ","}
    rows = ((name, *(format(one[figure], form) for figure, form in forms.items())) for name, one in made.items())
    title = f"{path.stem}, {whole.num_frames} frames, of which {len(np.unique(shown))} are shown"
    _common.print_table(title, ("frame times", "PSNR, dB", "worst", "SSIM", "steps"), rows)
    if options.plot is not None:
        plot(options.plot, times, shown)
    figures = {"psnr_fixed": made[FIXED]["psnr"], "psnr_learned": made[LEARNED]["psnr"], **recovered(times, shown)}
    runs.finish(figures, shown=shown.tolist())


if __name__ == "__main__":
    main()
