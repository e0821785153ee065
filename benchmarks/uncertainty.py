"""How sure frame times are, and whether that is true: seconds, calibration, and clips re-timed on purpose.

    python -m benchmarks.uncertainty [--json FILE] [--parts clip unseen calibration retimed] [--model FILE]
                                     [--clip NAME|PATH] [--gaussians N] [--minutes M] [--replicates N] [--plot FILE]
                                     [--seed S]

- clip: the posterior of all frame times of *bunny* (160x320) given the splats of a model (`--model`, or fitted for
  `--minutes`): seconds of each part, R-hat, autocorrelation times, and how far emcee is from forward and backward
  passes. Then a smooth subset of its frames, every first to third, as a video of fewer frames whose times nobody knows:
  is each frame found where the whole clip has it? Its pictures and its splats are the same, so this tells only that
  frames are found wherever they are.
- unseen: every second frame of the clip is fitted, and the frames between are looked for: are they half way between
  the times of their neighbors, if the clip's playback speed is regular?
- calibration: ranks of true times in simulated videos of a small synthetic scene, with right noise, noise assumed 1.5
  times too great and too small, frames of 8 bits, and smoothed noise; coverage of 50% and 90% intervals; `--plot`
  draws the ranks.
- retimed: that scene drawn at a smooth warp of times, with noise: are the warp's times in the intervals, given the
  true splats, and given splats that were fitted to a uniform clip or, times learned with them, to the warped clip?
"""

import argparse
import dataclasses
import time
import warnings
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import console
from foldgauss.envelope import TimeLikelihood
from foldgauss.io import load_video_model, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.render import RenderOptions
from foldgauss.uncertainty import (
    FrameNoise,
    Increments,
    SimulatedRanks,
    ecdf_band,
    exact_posterior,
    frame_time_posterior,
    likelihood_profiles,
    simulated_ranks,
)
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video import FitConfig, FoldedSplats, FrameTimes, VideoModel, fit

PARTS = "clip", "unseen", "calibration", "retimed"
SIZE, GAUSSIANS, MINUTES = (160, 320), 40_000, 2.0
REPLICATES, LEVELS = 300, (0.5, 0.9)
#: The synthetic scene: soft splats that move, and noise as of a good camera.
SCENE_SIZE, SCENE_SPLATS, SCENE_SCALE, SCENE_FRAMES = (48, 64), 40, 0.02, 10
#: Clips re-timed, of so many frames: so many given the true splats, and given those fitted to a uniform clip.
RETIMED_FRAMES, RETIMED_CLIPS, FRESH_CLIPS = 24, 50, 10
FIT_GAUSSIANS, FIT_STEPS = 400, 1500


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


def clip_posterior(model: VideoModel, frames: np.ndarray, seed: int, figures: dict[str, float]):
    """Level (a) of a whole clip: how long it takes, and how far emcee is from the exact passes."""
    with warnings.catch_warnings():  # what is compiled once is not timed
        warnings.simplefilter("ignore")
        likelihood_profiles(model, frames[: max(3, len(frames) // 40)], noise="score", reach=1)
    begun = time.perf_counter()
    profiles = likelihood_profiles(model, frames, noise="score")
    pictures = time.perf_counter() - begun
    increments = Increments(np.linspace(0, 1, len(frames)))
    begun = time.perf_counter()
    exact_posterior(profiles.curves, increments)
    passes = time.perf_counter() - begun
    begun = time.perf_counter()
    found = frame_time_posterior(profiles, seed=seed)
    sampling = time.perf_counter() - begun
    exact, free, frame = found.exact, found.free, 1 / (len(frames) - 1)
    std = exact.std()[free]
    error = std / np.sqrt(found.ess)
    ends = np.abs(np.subtract(found.interval(0.9), exact.interval(0.9)))[:, free] / std
    figures |= {
        "clip.seconds": pictures + sampling,
        "clip.seconds.pictures": pictures,
        "clip.seconds.passes": passes,
        "clip.seconds.sampling": sampling,
        "clip.pictures": profiles.num_rendered,
        "clip.share": float(np.median(profiles.noise.fraction)),
        "clip.converged": found.converged,
        "clip.steps": found.times.shape[1],
        "clip.r_hat": found.r_hat.max(),
        "clip.tau": found.tau.max(),
        "clip.tau.median": float(np.median(found.tau)),
        "clip.ess": found.ess.min(),
        "clip.acceptance": found.acceptance.mean(),
        "clip.std.frames": float(np.median(std)) / frame,
        "clip.std.frames.max": std.max() / frame,
        "clip.exact.mean.z": np.abs((found.mean() - exact.mean())[free] / error).max(),
        "clip.exact.std": np.abs(found.std()[free] / std - 1).max(),
        "clip.exact.ends": ends.max(),
    }
    console.print(found.message)
    return found


def subset_of_clip(model: VideoModel, frames: np.ndarray, whole, figures: dict[str, float]) -> None:
    """Every first to third frame, by a smooth warp, whose times and numbers nobody says."""
    last = len(frames) - 1
    numbers = np.unique(np.rint(warp(np.linspace(0, 1, last // 2 + 1)) * last).astype(int))
    profiles = likelihood_profiles(model, frames[numbers], noise="score")
    found = exact_posterior(profiles.curves, Increments(np.linspace(0, 1, len(numbers))))
    truth, spread = whole.exact.mean()[numbers], whole.exact.std()[numbers]
    miss = np.abs(found.mean() - truth)[1:-1] * last
    both = np.hypot(found.std(), spread)[1:-1] * last
    uniform = np.abs(np.linspace(0, 1, len(numbers)) - truth)[1:-1] * last
    figures |= {
        "subset.frames": len(numbers),
        "subset.step.max": np.diff(numbers).max(),
        "subset.miss.frames": float(np.median(miss)),
        "subset.miss.frames.max": miss.max(),
        "subset.miss.uniform": float(np.median(uniform)),
        "subset.std.frames": float(np.median(found.std()[1:-1])) * last,
        "subset.z": float(np.sqrt(np.mean((miss / both) ** 2))),
        **{f"subset.inside.{level:g}": inside(found.interval(level), truth) for level in LEVELS},
    }


def calibration(replicates: int, seed: int, plot: Path | None, figures: dict[str, float]) -> None:
    model, right = scene(), FrameNoise(SCENE_SCALE, 1.0)
    runs = {
        "right noise": {},
        "noise x 1.5": {"assumed_noise": FrameNoise(1.5 * SCENE_SCALE, 1.0)},
        "noise / 1.5": {"assumed_noise": FrameNoise(SCENE_SCALE / 1.5, 1.0)},
        "measured": {"assumed_noise": "independent"},
        "8 bits": {"eight_bits": True},
        "8 bits, measured": {"eight_bits": True, "assumed_noise": "independent"},
        "smoothed, independent": {"assumed_noise": "independent", "correlation": 1.0},
        "smoothed, effective": {"assumed_noise": "effective", "correlation": 1.0},
        "smoothed, score": {"assumed_noise": "score", "correlation": 1.0},
    }
    shown = _common.table(
        f"Calibration, {replicates} replicates", "noise", "s", "in the 99% envelope", *(f"{x:.0%}" for x in LEVELS)
    )
    found: dict[str, SimulatedRanks] = {}
    for name, settings in runs.items():
        begun = time.perf_counter()
        ranks = simulated_ranks(model, right, num_frames=SCENE_FRAMES, replicates=replicates, seed=seed, **settings)
        seconds, stay = time.perf_counter() - begun, ranks.inside(0.99)
        # Of all free frames; those of one replicate are near independent where the noise tells their times.
        covered = [float(ranks.coverage(level)[:-2].mean()) for level in LEVELS]
        key = name.replace(" ", "").replace(",", ".")
        figures |= {f"calibration.{key}.inside": stay.mean(), f"calibration.{key}.seconds": seconds}
        figures |= {f"calibration.{key}.{level:g}": share for level, share in zip(LEVELS, covered, strict=True)}
        shown.add_row(name, f"{seconds:.0f}", f"{stay.sum()} of {len(stay)}", *(f"{share:.1%}" for share in covered))
        found[name] = ranks
    console.print(shown)
    if plot is not None:
        draw(found, plot)


def draw(found: dict[str, SimulatedRanks], path: Path) -> None:
    """Shares of ranks less what uniform ones would have, in their envelopes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(found)[:3]
    figure, axes = pyplot.subplots(1, len(names), figsize=(11, 3.4), sharey=True, layout="constrained")
    for axis, name in zip(axes, names, strict=True):
        ranks = found[name]
        uniform = np.arange(1, ranks.num_ranks + 1) / ranks.num_ranks
        low, high = ecdf_band(len(ranks.ranks), ranks.num_ranks, 0.99)
        axis.fill_between(uniform, low - uniform, high - uniform, color="0.85", step="post", label="99% of right ones")
        for k, (label, shares) in enumerate(zip(ranks.names, ranks.ecdf(), strict=True)):
            style = (
                {"color": "C3", "lw": 1.6} if k == len(ranks.names) - 1 else {"color": "C0", "lw": 0.8, "alpha": 0.7}
            )
            known = label if k == len(ranks.names) - 1 else ("times of frames" if k == 0 else None)
            axis.step(uniform, shares - uniform, where="post", label=known, **style)
        axis.set(title=f"{name} ({ranks.inside(0.99).sum()} of {len(ranks.names)} inside)", xlabel="rank / ranks")
    axes[0].set_ylabel("fraction of ranks below, less uniform")
    axes[0].legend(fontsize=8, loc="lower right")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def retimed(seed: int, figures: dict[str, float]) -> None:
    """A clip of known, uneven times: given the true splats, and splats that had to be fitted."""
    rng = np.random.default_rng(seed)
    model, truth = scene(), warp(np.linspace(0, 1, RETIMED_FRAMES))
    noise = FrameNoise(SCENE_SCALE, 1.0)
    kept = []
    for _ in range(RETIMED_CLIPS):
        found = posterior_of(model, drawn(model, truth, SCENE_SCALE, rng), noise)
        kept.append([*(inside(found.interval(level), truth) for level in LEVELS), *errors(found, truth)])
    put(figures, "retimed.true splats", np.mean(kept, axis=0))
    uniform = drawn(model, np.linspace(0, 1, 4 * RETIMED_FRAMES), SCENE_SCALE, rng)
    fresh = drawn(model, truth, SCENE_SCALE, rng)
    config = FitConfig(num_gaussians=FIT_GAUSSIANS, steps=FIT_STEPS, seed=seed)
    fitted = fit(uniform, dataclasses.replace(config, learn_frame_times=False)).model
    others = [drawn(model, truth, SCENE_SCALE, rng) for _ in range(FRESH_CLIPS)]
    put(
        figures, "retimed.fitted to a uniform clip", np.mean([measured(fitted, each, truth) for each in others], axis=0)
    )
    fitted = fit(fresh, config).model
    learned = np.asarray(fitted.frame_times.times())
    figures["retimed.learned.miss.frames"] = np.abs(learned - truth).max() * (RETIMED_FRAMES - 1)
    put(figures, "retimed.fitted to the clip itself", measured(fitted, fresh, truth))
    shown = _common.table(
        "Re-timed by a warp", "splats", *(f"inside {x:.0%}" for x in LEVELS), "miss, frames", "std, frames", "rms z"
    )
    for name in ("true splats", "fitted to a uniform clip", "fitted to the clip itself"):
        row = [figures[f"retimed.{name}.{what}"] for what in MEASURES]
        shown.add_row(name, *(f"{share:.0%}" for share in row[:2]), *(f"{value:.3g}" for value in row[2:]))
    console.print(shown)


MEASURES = (*(f"inside.{level:g}" for level in LEVELS), "miss.frames", "std.frames", "z")


def put(figures: dict[str, float], name: str, values) -> None:
    figures |= {f"{name}.{what}": value for what, value in zip(MEASURES, values, strict=True)}


def posterior_of(model: VideoModel, frames: np.ndarray, noise: FrameNoise | str):
    profiles = likelihood_profiles(model, frames, noise=noise)
    return exact_posterior(profiles.curves, Increments(np.linspace(0, 1, len(frames))))


def measured(model: VideoModel, frames: np.ndarray, truth: np.ndarray) -> list[float]:
    found = posterior_of(model, frames, "score")
    return [*(inside(found.interval(level), truth) for level in LEVELS), *errors(found, truth)]


def errors(found, truth: np.ndarray) -> tuple[float, float, float]:
    """Median miss and standard deviation in frames, and the root mean square of their quotient."""
    miss, std = (found.mean() - truth)[1:-1], found.std()[1:-1]
    last = len(truth) - 1
    return (
        float(np.median(np.abs(miss))) * last,
        float(np.median(std)) * last,
        float(np.sqrt(np.mean((miss / std) ** 2))),
    )


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    made.add_argument("--model", type=Path, metavar="FILE", help="of the clip, instead of a fit")
    made.add_argument("--clip", default="bunny")
    made.add_argument("--gaussians", type=_common.whole, default=GAUSSIANS)
    made.add_argument("--minutes", type=float, default=MINUTES)
    made.add_argument("--replicates", type=_common.whole, default=REPLICATES)
    made.add_argument("--plot", type=Path, metavar="FILE", help="draw the ranks")
    made.add_argument("--seed", type=int, default=_common.SEED)
    options = _common.parse(made, arguments)
    figures: dict[str, float] = {}
    if "clip" in options.parts:
        clip_part(options, figures)
    if "unseen" in options.parts:
        unseen_part(options, figures)
    if "calibration" in options.parts:
        calibration(options.replicates, options.seed, options.plot, figures)
    if "retimed" in options.parts:
        retimed(options.seed, figures)
    _common.finish(options.json, figures, _common.describe_machine(), parts=options.parts)


def clip_part(options: argparse.Namespace, figures: dict[str, float]) -> None:
    path = Path(options.clip) if Path(options.clip).exists() else sample_clip(options.clip)
    if options.model is None:
        frames = read_video(path, size=SIZE).frames
        model = fit(
            frames, FitConfig(num_gaussians=options.gaussians, minutes=options.minutes, seed=options.seed)
        ).model
    else:
        model = load_video_model(options.model)
        frames = read_video(path, size=model.size).frames[: model.frame_times.num_frames]
    figures["clip.gaussians"] = model.num_gaussians
    whole = clip_posterior(model, frames, options.seed, figures)
    subset_of_clip(model, frames, whole, figures)


def unseen_part(options: argparse.Namespace, figures: dict[str, float]) -> None:
    """Frames between those that were fitted: their times against the middle of their neighbors' learned times."""
    path = Path(options.clip) if Path(options.clip).exists() else sample_clip(options.clip)
    frames = read_video(path, size=SIZE).frames
    frames = frames[: len(frames) - (len(frames) + 1) % 2]  # the first and the last are fitted
    config = FitConfig(num_gaussians=options.gaussians, minutes=options.minutes, seed=options.seed)
    model = fit(np.ascontiguousarray(frames[::2]), config).model
    learned = np.asarray(model.frame_times.times(), np.float64)
    truth = np.concatenate([[0.0], (learned[1:] + learned[:-1]) / 2, [1.0]])
    numbers = [0, *range(1, len(frames), 2), len(frames) - 1]
    profiles = likelihood_profiles(model, frames[numbers], noise="score")
    found = exact_posterior(profiles.curves, Increments(np.linspace(0, 1, len(numbers))))
    miss, median_std, z = errors(found, truth)
    last = (len(frames) - 1) / (len(numbers) - 1)  # `errors` counts in steps of this video, two frames each
    figures |= {
        "unseen.miss.frames": miss * last,
        "unseen.std.frames": median_std * last,
        "unseen.z": z,
        **{f"unseen.inside.{level:g}": inside(found.interval(level), truth) for level in LEVELS},
    }


if __name__ == "__main__":
    main()
