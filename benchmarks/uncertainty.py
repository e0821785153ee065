"""How sure frame times are, and whether that is true: seconds, calibration, and clips re-timed on purpose.

    python -m benchmarks.uncertainty [--json FILE] [--parts clip calibration retimed] [--model FILE]
                                     [--clip NAME|PATH] [--gaussians N] [--minutes M] [--replicates N] [--plot FILE]
                                     [--seed S]

- clip: the posterior of all frame times of *bunny* (160x320) given the splats of a model (`--model`, or fitted for
  `--minutes`): seconds of each part, R-hat, autocorrelation times, and how far emcee is from forward and backward
  passes.
- calibration: ranks of true times in simulated videos of a small synthetic scene, with right noise, noise assumed 1.5
  times too great and too small, frames of 8 bits, and smoothed noise; coverage of 50% and 90% intervals; `--plot`
  draws the ranks.
- retimed: that scene drawn at a smooth warp of times, with noise: are the warp's times in the intervals, given the
  true splats, and given splats that were fitted to a uniform clip or, times learned with them, to the warped clip?
"""

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common
from benchmarks._calibration import SimulatedRanks, ecdf_band, simulated_ranks
from benchmarks._clips import clip_path
from benchmarks._common import console
from foldgauss.envelope import TimeLikelihood
from foldgauss.io import load_video_model, read_video
from foldgauss.io.figures import write_figure
from foldgauss.render import RenderOptions
from foldgauss.uncertainty import (
    FrameNoise,
    exact_posterior,
    frame_time_posterior,
    likelihood_profiles,
)
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video import FitConfig, FoldedSplats, FrameTimes, VideoModel, fit

SIZE = (160, 320)
GAUSSIANS = 40_000
MINUTES = 2.0
REPLICATES = 300
#: Levels of the intervals.
LEVELS = (0.5, 0.9)
#: The synthetic scene of soft splats that move.
SCENE_SIZE = (48, 64)
SCENE_SPLATS = 40
SCENE_FRAMES = 10
#: Standard deviation of its noise, as of a good camera.
SCENE_SCALE = 0.02
#: Frames of a clip that is re-timed.
RETIMED_FRAMES = 24
#: Such clips given the true splats.
RETIMED_CLIPS = 50
#: Such clips given splats that are fitted to a uniform clip.
FRESH_CLIPS = 10
FIT_GAUSSIANS = 400
FIT_STEPS = 1500


def scene(seed: int = 0) -> VideoModel:
    """Splats that move smoothly, a third of them small."""
    rng, num = np.random.default_rng(seed), SCENE_SPLATS

    def normal(*shape, scale=1.0):
        return (rng.normal(size=(num, *shape)) * scale).astype(np.float32)

    small = np.arange(num) < num // 3
    splats = FoldedSplats(
        loc=normal(2, scale=0.25),
        log_scale=np.where(small[:, None], -3.2, -2.2).astype(np.float32) + normal(2, scale=0.3),
        angle_logit=normal(),
        time_loc_logit=normal(scale=0.5),
        log_time_scale=normal(scale=0.2) - np.float32(0.5),
        coefficients=normal(3, 2, scale=0.05),
        opacity_logit=normal(),
        color_dc=normal(3),
        envelope=TimeLikelihood(2.0, 0.0),
    )
    return VideoModel(splats, FrameTimes.uniform(SCENE_FRAMES), SCENE_SIZE, 25.0, RenderOptions.exact(), "over")


def drawn(model: VideoModel, times: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    """Frames of 8 bits at `times`, with white noise."""
    residuals = Residuals(model, np.zeros((3, *model.size, 3), np.uint8))
    pictures = np.moveaxis(np.stack(list(residuals.render_at(times))), 1, -1)
    noisy = pictures + scale * rng.standard_normal(pictures.shape)
    return np.clip(np.rint(255 * noisy), 0, 255).astype(np.uint8)


def warp(u: np.ndarray) -> np.ndarray:
    """An increasing map of [0, 1] onto itself, at speeds from 0.5 to 1.5."""
    return u + 0.5 * np.sin(2 * np.pi * u) / (2 * np.pi)


def inside(interval: tuple[np.ndarray, ...], truth: np.ndarray) -> float:
    """Share of the frames, but for the first and the last, whose true time is in the interval."""
    low, high = interval
    return float(((truth >= low) & (truth <= high))[1:-1].mean())


def clip_posterior(options: argparse.Namespace) -> dict[str, float]:
    """A whole clip given its splats: how long it takes, and how far emcee is from the exact passes."""
    if options.model is None:
        frames = read_video(clip_path(options.clip), size=SIZE).frames
        config = FitConfig(num_gaussians=options.gaussians, minutes=options.minutes, seed=options.seed)
        model = fit(frames, config).model
    else:
        model = load_video_model(options.model)
        frames = read_video(clip_path(options.clip), size=model.size).frames[: model.frame_times.num_frames]
    with warnings.catch_warnings():  # what is compiled once is not timed
        warnings.simplefilter("ignore")
        likelihood_profiles(model, frames[: max(3, len(frames) // 40)], noise="score")
    clock = [time.perf_counter()]
    profiles = likelihood_profiles(model, frames, noise="score")
    clock.append(time.perf_counter())
    found = frame_time_posterior(profiles, seed=options.seed)
    clock.append(time.perf_counter())
    exact, free = found.exact, found.free
    std = exact.std()[free]
    console.print(found.message)
    return {
        "gaussians": model.num_gaussians,
        "seconds of images": clock[1] - clock[0],
        "seconds of sampling": clock[2] - clock[1],
        "images": profiles.num_rendered,
        "converged": found.converged,
        "steps": found.times.shape[1],
        "largest R-hat": found.r_hat.max(),
        "largest autocorrelation time": found.tau.max(),
        "least effective sample size": found.ess.min(),
        "median std (frames)": np.median(std) * (len(frames) - 1),
        "means, from the exact ones (standard errors)": np.abs(
            (found.mean() - exact.mean())[free] / (std / np.sqrt(found.ess))
        ).max(),
        "std, from the exact ones (relative)": np.abs(found.std()[free] / std - 1).max(),
    }


def calibration(replicates: int, seed: int, plot: Path | None) -> dict[str, float]:
    model, right = scene(), FrameNoise(SCENE_SCALE, 1.0)
    runs = {
        "right noise": {},
        "noise x 1.5": {"assumed_noise": FrameNoise(1.5 * SCENE_SCALE, 1.0)},
        "noise / 1.5": {"assumed_noise": FrameNoise(SCENE_SCALE / 1.5, 1.0)},
        "measured": {"assumed_noise": "independent"},
        "8 bits": {"eight_bits": True},
        "8 bits, measured": {"eight_bits": True, "assumed_noise": "independent"},
        "smoothed, independent": {"assumed_noise": "independent", "correlation": 1.0},
        "smoothed, score": {"assumed_noise": "score", "correlation": 1.0},
    }
    found: dict[str, SimulatedRanks] = {}
    rows, figures = [], {}
    for name, settings in runs.items():
        ranks = simulated_ranks(model, right, num_frames=SCENE_FRAMES, replicates=replicates, seed=seed, **settings)
        found[name], stay = ranks, ranks.inside(0.99)
        # Of all free frames; those of one replicate are near independent where the noise tells their times.
        covered = [float(ranks.coverage(level)[:-2].mean()) for level in LEVELS]
        figures[f"{name}: inside"] = stay.mean()
        figures |= {f"{name}: {level:.0%} intervals": part for level, part in zip(LEVELS, covered, strict=True)}
        rows.append((name, f"{stay.sum()} of {len(stay)}", *(f"{part:.1%}" for part in covered)))
    columns = "noise", "in the 99% envelope", *(f"in {level:.0%} intervals" for level in LEVELS)
    _common.print_table(f"Calibration, {replicates} replicates", columns, rows)
    if plot is not None:
        draw_ranks(found, plot)
    return figures


def draw_ranks(found: dict[str, SimulatedRanks], path: Path) -> None:
    """Fractions of ranks less what uniform ones would have, in their envelopes."""
    names = list(found)[:3]

    def draw(figure: Any) -> None:
        axes = figure.subplots(1, len(names), sharey=True)
        for axis, name in zip(axes, names, strict=True):
            ranks = found[name]
            uniform = np.arange(1, ranks.num_ranks + 1) / ranks.num_ranks
            low, high = ecdf_band(len(ranks.ranks), ranks.num_ranks, 0.99)
            axis.fill_between(uniform, low - uniform, high - uniform, color="0.85", step="post", label="99%, if right")
            *frames, last = ranks.ecdf() - uniform
            axis.step(uniform, np.transpose(frames), where="post", color="C0", lw=0.8, alpha=0.7)
            axis.step(uniform, last, where="post", color="C3", lw=1.6, label=ranks.names[-1])
            axis.set(title=f"{name} ({ranks.inside(0.99).sum()} of {len(ranks.names)} inside)", xlabel="rank / ranks")
        axes[0].set_ylabel("fraction of ranks below, less uniform")
        axes[0].legend(fontsize=8, loc="lower right")

    write_figure(path, draw, (11, 3.4))


MEASURES = (*(f"inside {level:.0%}" for level in LEVELS), "miss (frames)", "std (frames)", "rms z")


def retimed(seed: int) -> dict[str, float]:
    """A clip of known, uneven times: given the true splats, and splats that had to be fitted."""
    rng = np.random.default_rng(seed)
    model, truth = scene(), warp(np.linspace(0, 1, RETIMED_FRAMES))
    noise = FrameNoise(SCENE_SCALE, 1.0)
    clips = (drawn(model, truth, SCENE_SCALE, rng) for _ in range(RETIMED_CLIPS))
    found = {"true splats": np.mean([measured(model, clip, truth, noise) for clip in clips], axis=0)}
    uniform = drawn(model, np.linspace(0, 1, 4 * RETIMED_FRAMES), SCENE_SCALE, rng)
    fresh = drawn(model, truth, SCENE_SCALE, rng)
    # Maps of shared paths at each frame would absorb the information of its time.
    config = FitConfig(num_gaussians=FIT_GAUSSIANS, steps=FIT_STEPS, seed=seed, follow_camera=False)
    fitted = fit(uniform, config.replace(**{"rates.frame_times": 0.0})).model
    others = (drawn(model, truth, SCENE_SCALE, rng) for _ in range(FRESH_CLIPS))
    found["fitted to a uniform clip"] = np.mean([measured(fitted, clip, truth, "score") for clip in others], axis=0)
    found["fitted to the clip itself"] = measured(fit(fresh, config).model, fresh, truth, "score")
    rows = ((name, *(f"{value:.3g}" for value in values)) for name, values in found.items())
    _common.print_table("Re-timed by a warp", ("splats", *MEASURES), rows)
    pairs = ((name, zip(MEASURES, values, strict=True)) for name, values in found.items())
    return {f"{name}: {what}": value for name, measures in pairs for what, value in measures}


def measured(model: VideoModel, frames: np.ndarray, truth: np.ndarray, noise: FrameNoise | str) -> list[float]:
    """`MEASURES`: fractions of true times in intervals; median miss and std; root mean square of their quotient."""
    profiles = likelihood_profiles(model, frames, noise=noise)
    found = exact_posterior(profiles.curves)
    covered = [inside(found.interval(level), truth) for level in LEVELS]
    miss, std, last = (found.mean() - truth)[1:-1], found.std()[1:-1], len(truth) - 1
    z = np.sqrt(np.mean((miss / std) ** 2))
    return [*covered, float(np.median(np.abs(miss))) * last, float(np.median(std)) * last, float(z)]


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    parts = {
        "clip": clip_posterior,
        "calibration": lambda options: calibration(options.replicates, options.seed, options.plot),
        "retimed": lambda options: retimed(options.seed),
    }
    made.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    made.add_argument("--model", type=Path, metavar="FILE", help="of the clip, instead of a fit")
    made.add_argument("--clip", default="bunny")
    made.add_argument("--gaussians", type=_common.whole, default=GAUSSIANS)
    made.add_argument("--minutes", type=_common.positive, default=MINUTES)
    made.add_argument("--replicates", type=_common.whole, default=REPLICATES)
    made.add_argument("--plot", type=Path, metavar="FILE", help="draw the ranks")
    made.add_argument("--seed", type=int, default=_common.SEED)
    options, figures = _common.parse(made, arguments), {}
    for part in options.parts:
        figures |= {f"{part}: {name}": value for name, value in parts[part](options).items()}
    _common.finish(options.json, figures, parts=options.parts)


if __name__ == "__main__":
    main()
