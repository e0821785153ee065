"""Learned frame times against fixed ones, on a clip that has lost frames and shows others twice.

    python -m benchmarks.frame_times [--json FILE] [--plot FILE] [--clip carphone|bunny|bikes|PATH] [--size HxW]
                                     [--frames A:B] [--dropped SHARE] [--doubled SHARE] [--gaussians N]
                                     [--minutes M | --steps N] [--rate R] [--set NAME=VALUE ...] [--seed S]

Without options: *carphone*, of which 15% of the frames are left out and 15% of the rest shown twice, at random; 2
minutes for each of two fits that do not follow the camera, alike but for `learn_frame_times`. The true time of a frame
is its place in the clip as it was, in frame intervals; the first and the last frame stay, since a model's times begin
at 0 and end at 1. (*Bunny* has doubled frames of its own, of which this would know nothing.)

Beside the PSNR of both stand, for the learned times, the root mean square of what they are off by, against that of even
ones; the correlation of learned with true deviations from even times; and that of learned with true steps from frame to
frame. The last says most: times that drift slowly are as good as others, since folds bend to them. `--plot` draws all.

`--rate` is that of frame times, `LearningRates.frame_times`; `--set` changes any other field of `FitConfig` for both
fits: `--set follow_motion=False`, so that no fold starts along the uneven motion. With --json each fit that is done is
kept there, and the same command goes on after it.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common, fit_clip, presets
from benchmarks._common import console
from benchmarks._runs import Run, Runs, fitted
from foldgauss.io import Clip, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.io.figures import write_figure
from foldgauss.video import FitConfig, LearningRates

MINUTES, SHARE = 2.0, 0.15
FIXED, LEARNED = "fixed", "learned"


def uneven(num_frames: int, dropped: float, doubled: float, seed: int) -> np.ndarray:
    """Which frames are shown, in order: a share left out, and one of the rest shown twice; never the ends."""
    rng = np.random.default_rng([seed, 8])
    inner = rng.permutation(np.arange(1, num_frames - 1))
    inner = inner[round(dropped * len(inner)) :]
    twice = inner[: round(doubled * len(inner))]
    return np.sort(np.concatenate([[0, num_frames - 1], inner, twice]))


def recovered(times: np.ndarray, shown: np.ndarray) -> dict[str, float]:
    """How well model times, in [0, 1], tell which frames are shown; in frame intervals of the clip as it was."""
    even, found = np.linspace(0, shown[-1], len(shown)), np.asarray(times, np.float64) * shown[-1]
    return {
        "rmse": _rms(found - shown),
        "rmse_even": _rms(even - shown),
        "correlation": _correlation(found - even, shown - even),
        "correlation_of_steps": _correlation(np.diff(found), np.diff(shown)),
        "step_where_doubled": _mean(np.diff(found)[np.diff(shown) == 0]),
        "step_where_dropped": _mean(np.diff(found)[np.diff(shown) > 1]),
        "step_elsewhere": _mean(np.diff(found)[np.diff(shown) == 1]),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else 0.0


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """0 where either is constant, but for rounding."""
    spread = np.std(one) * np.std(other)
    return float(np.mean((one - one.mean()) * (other - other.mean())) / spread) if spread > 1e-12 else 0.0


def run(clip: Clip, config: FitConfig) -> Run:
    """A fit, and its times."""
    model, made = fitted(clip, config)
    return made | {"times": np.asarray(model.frame_times.times(), np.float64).tolist()}


def show(made: dict[str, Run], found: dict[str, float], title: str) -> None:
    table = _common.table(title, "frame times", "PSNR, dB", "worst", "SSIM", "steps", "off by, frames")
    for name, off in ((FIXED, found["rmse_even"]), (LEARNED, found["rmse"])):
        one = made[name]
        quality = f"{one['psnr']:.2f}", f"{one['worst_psnr']:.2f}", f"{one['ssim']:.4f}"
        table.add_row(name, *quality, f"{one['steps']:,}", f"{off:.3f}")
    console.print(table)


def plot(path: Path, times: np.ndarray, shown: np.ndarray) -> None:
    """Deviations from even times above, steps below; a PNG, whole or not at all."""
    even, found = np.linspace(0, shown[-1], len(shown)), np.asarray(times) * shown[-1]

    def draw(figure: Any) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(shown - even, color="0.6", linewidth=3, label="true")
        above.plot(found - even, color="C3", linewidth=1, label="learned")
        above.set_ylabel("off even times, frames")
        above.legend()
        below.step(range(len(shown) - 1), np.diff(shown), color="0.6", linewidth=3, where="mid", label="true")
        below.plot(np.diff(found), ".", color="C3", label="learned")
        below.set_ylabel("step to the next, frames")
        below.set_xlabel("frame shown")
        for axes in (above, below):
            axes.grid(alpha=0.3)

    write_figure(path, draw, (9, 5))


def main(arguments: list[str] | None = None) -> None:
    parser = _parser()
    options = _common.parse(parser, arguments)
    path = sample_clip(options.clip) if options.clip in fit_clip.SAMPLES else Path(options.clip)
    whole = read_video(path, frames=options.frames, size=options.size)
    if whole.num_frames < 3:
        parser.error(f"--frames: expected at least 3, got {whole.num_frames}")
    shown = uneven(whole.num_frames, options.dropped, options.doubled, options.seed)
    clip = dataclasses.replace(whole, frames=np.ascontiguousarray(whole.frames[shown]))
    budget = {"steps": options.steps} if options.steps else {"minutes": options.minutes}
    names = ("frames", "dropped", "doubled", "gaussians", "rate", "set", "seed")
    kept = {name: getattr(options, name) for name in names}
    try:
        runs = Runs(options.json, kept | {"clip": path.name, "size": whole.size} | budget)
    except ValueError as error:
        parser.error(str(error))
    rates = LearningRates() if options.rate is None else LearningRates(frame_times=options.rate)
    own = {"num_gaussians": options.gaussians, "rates": rates, "seed": options.seed}
    # Maps of the camera at each frame would absorb what its time tells.
    config = FitConfig(**{"follow_camera": False} | own | budget | dict(options.set or ()))
    made = {}
    for name in (FIXED, LEARNED):
        own = dataclasses.replace(config, learn_frame_times=name == LEARNED)
        made[name] = runs.get(name, lambda own=own: run(clip, own))
    times = np.asarray(made[LEARNED]["times"])
    found = recovered(times, shown)
    size, twice = "x".join(map(str, whole.size)), int((np.diff(shown) == 0).sum())
    lost = whole.num_frames - len(np.unique(shown))
    show(made, found, f"{path.stem}, {whole.num_frames} frames of {size}: {lost} left out, {twice} shown twice")
    if options.plot is not None:
        plot(options.plot, times, shown)
    gain = made[LEARNED]["psnr"] - made[FIXED]["psnr"]
    figures = {"psnr_fixed": made[FIXED]["psnr"], "psnr_learned": made[LEARNED]["psnr"], "gain": gain, **found}
    _common.finish(None, figures, _common.describe_machine())
    runs.write(figures=figures, shown=shown.tolist())


def share(text: str) -> float:
    """argparse type: a share of the frames, below a half."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < 0.5:
        raise argparse.ArgumentTypeError(f"expected a share in [0, 0.5), got {text!r}")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the times here (PNG)")
    parser.add_argument("--clip", default="carphone", help="a sample clip or a path [carphone]")
    parser.add_argument("--size", type=_common.size, metavar="HxW", help="[the clip's]")
    parser.add_argument("--frames", type=fit_clip._frames, metavar="A:B", help="frames A <= i < B [all]")
    parser.add_argument("--dropped", type=share, default=SHARE, help=f"share of the frames left out [{SHARE:g}]")
    parser.add_argument("--doubled", type=share, default=SHARE, help=f"share of the rest shown twice [{SHARE:g}]")
    parser.add_argument("--gaussians", type=_common.whole, help="[by the frame's size]")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=presets.minutes, default=MINUTES, help=f"of each fit [{MINUTES:g}]")
    length.add_argument("--steps", type=_common.whole, help="of each fit, instead of minutes")
    parser.add_argument("--rate", type=float, help=f"of frame times [{LearningRates().frame_times:g}]")
    parser.add_argument("--set", action="append", type=fit_clip._setting, metavar="NAME=VALUE", help="of FitConfig")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    return parser


if __name__ == "__main__":
    main()
