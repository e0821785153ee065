r"""Simulation-based calibration of the posterior of frame times.

Times are drawn from the prior, frames are rendered at these times with noise, and the posterior given the frames is
sampled: the rank of the true time among the draws is uniform if prior, noise, profiles and sampler are correct.
"""

import dataclasses
import functools
from collections.abc import Iterable, Iterator

import numpy as np
import scipy.ndimage
import scipy.stats
from jaxtyping import Bool, Float32, Float64, Int

from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles, ProfileBuilder
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.uncertainty.posterior.exact import exact_posterior
from foldgauss.uncertainty.posterior.log_prob import FrameTimeLogProb
from foldgauss.uncertainty.posterior.sampling import frame_time_posterior
from foldgauss.video.models.video_model import VideoModel

#: Draws of each posterior: 99 give 100 ranks, of which 5% and 25% are integers.
DRAWS = 99
#: Steps of emcee per replicate: enough for about a hundred independent draws.
STEPS = 600
#: Simulated sets of ranks per envelope: the standard error of its level is 0.1%.
ENVELOPES = 10_000
#: Keys of the random streams of replicates, of envelopes, and of the choice among emcee's draws.
_REPLICATE = 22
_BAND = 23
_THINNING = 24


@dataclasses.dataclass(frozen=True)
class SimulatedRanks:
    """Ranks of the true quantities among draws of the posterior, 0 to `num_ranks` - 1; uniform if calibrated.

    **Shapes:** `ranks` (replicates, quantities), with the quantities `names`: the times of the free frames, the time of
    one free frame chosen at random in every replicate ("any frame"), and the joint log-likelihood. Replicates are
    independent, quantities of one replicate are not. `true` (replicates, num_frames): the true times.
    `converged`: fraction of replicates whose sampler converged; 1 for exact sampling.
    """

    ranks: Int[np.ndarray, "replicates quantities"]
    num_ranks: int
    names: list[str]
    true: Float64[np.ndarray, "replicates num_frames"]
    converged: float

    def ecdf(self) -> Float64[np.ndarray, "quantities num_ranks"]:
        """Fraction of each quantity's ranks below 1, 2, ..., `num_ranks`."""
        below = self.ranks[:, :, None] < np.arange(1, self.num_ranks + 1)
        return below.mean(0)

    def inside(self, level: float = 0.99) -> Bool[np.ndarray, " quantities"]:
        """Quantities whose ranks lie entirely within the simultaneous envelope (see `ecdf_band`)."""
        low, high = ecdf_band(len(self.ranks), self.num_ranks, level)
        fractions = self.ecdf()
        return ((fractions >= low - 1e-12) & (fractions <= high + 1e-12)).all(1)

    def coverage(self, level: float) -> Float64[np.ndarray, " quantities"]:
        """Fraction of replicates in which the central interval with the fraction `level` of the draws has the truth.

        `level` must leave an integer number of ranks on either side.
        """
        tail = round((1 - level) / 2 * self.num_ranks)
        return ((self.ranks >= tail) & (self.ranks < self.num_ranks - tail)).mean(0)


def simulated_ranks(
    model: VideoModel,
    noise: FrameNoise,
    *,
    num_frames: int,
    replicates: int,
    sampler: str = "exact",
    draws: int = DRAWS,
    concentration: float = 1.0,
    seed: int = 0,
    assumed_noise: str | FrameNoise | None = None,
    correlation: float | None = None,
    steps: int = STEPS,
    eight_bits: bool = False,
) -> SimulatedRanks:
    """Ranks over `replicates` simulated videos of `num_frames` frames whose times are drawn from the prior.

    Frames are images of `model` plus Gaussian noise of standard deviation `noise.scale`: white, or smoothed by a
    Gaussian of `correlation` pixels' standard deviation and rescaled. They are neither rounded nor clipped, or with
    `eight_bits` both, as those of a video; noise clipped at black or white is no longer centered, which shifts times a
    little. Profiles are computed as by `likelihood_profiles` with `assumed_noise` (default: `noise`). `sampler`:
    "exact", or "emcee" with `steps` steps.

    **Source:** Talts, Betancourt, Simpson, Vehtari and Gelman 2018; the log-likelihood as a quantity: Modrak et al.
    2023.
    """
    noise = noise.for_frames(num_frames)
    assumed = noise if assumed_noise is None else assumed_noise
    if isinstance(assumed, FrameNoise):
        assumed = assumed.for_frames(num_frames)
    images = _CachedImages(model)
    ranks, true, converged = [], [], 0
    for seeds in np.random.SeedSequence(seed, spawn_key=(_REPLICATE,)).spawn(replicates):
        rng = np.random.default_rng(seeds)
        times = draw_times(num_frames, concentration, rng)
        clean = np.stack(list(images.residuals.render_at(times)))
        scale = noise.scale[:, None, None, None].astype(np.float32)
        frames = clean + scale * _draw_noise(clean.shape, correlation, rng)
        if eight_bits:
            rounded = np.rint(255 * np.moveaxis(frames, 1, -1)).clip(0, 255).astype(np.uint8)
            builder = ProfileBuilder(Residuals(model, rounded))
        else:
            builder = ProfileBuilder(_SimulatedResiduals(images, frames))
        builder.compare_coarse()
        profiles = builder.build(assumed)
        log_prob = FrameTimeLogProb(profiles.curves, concentration)
        seed_of_draws = int(rng.integers(2**31))
        if sampler == "exact":
            sample, success = exact_posterior(profiles.curves, concentration).sample(draws, seed_of_draws), True
        else:
            sample, success = _sample_by_emcee(profiles, concentration, draws, steps, seed_of_draws)
        below = (sample < times).sum(0)
        any_frame = int(rng.integers(1, num_frames - 1))
        # The likelihood alone is finite at the true times, which the profiles cover.
        likelihood = (log_prob.log_likelihood(sample) < log_prob.log_likelihood(times)).sum()
        ranks.append([*below[1:-1], below[any_frame], likelihood])
        true.append(times)
        converged += success
    names = [f"frame {k}" for k in range(1, num_frames - 1)] + ["any frame", "log-likelihood"]
    return SimulatedRanks(np.array(ranks), draws + 1, names, np.array(true), converged / replicates)


def draw_times(num_frames: int, concentration: float, rng: np.random.Generator) -> np.ndarray:
    """Frame times drawn from their prior."""
    steps = rng.dirichlet(np.full(num_frames - 1, concentration))
    return np.minimum(np.append(0.0, np.cumsum(steps)), 1.0)  # rounding may exceed it


@functools.cache
def ecdf_band(replicates: int, num_ranks: int, level: float = 0.99) -> Float64[np.ndarray, "2 num_ranks"]:
    """Simultaneous envelope of the empirical CDF of uniform ranks, at 1, 2, ..., `num_ranks`.

    The ECDF of `replicates` independent uniform ranks stays entirely within it with probability `level`. It consists
    of pointwise binomial intervals, whose pointwise level is calibrated by simulation.

    **Source:** Saeilynoja, Buerkner and Vehtari 2022, algorithm 1.
    """
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(_BAND,)))
    fractions = np.arange(1, num_ranks) / num_ranks  # all ranks are at most the last
    counts = rng.multinomial(replicates, np.full(num_ranks, 1 / num_ranks), ENVELOPES)[:, :-1].cumsum(1)
    # Two-sided tail probabilities of all possible counts.
    every = np.arange(replicates + 1)[:, None]
    below = scipy.stats.binom.cdf(every, replicates, fractions)
    tails = 2 * np.minimum(below, scipy.stats.binom.sf(every - 1, replicates, fractions))
    least = tails[counts, np.arange(num_ranks - 1)].min(1)
    # The largest attained pointwise level that the fraction `level` of sets stay above.
    pointwise = np.quantile(least, 1 - level, method="lower")
    inside = tails >= pointwise * (1 - 1e-9)
    low = inside.argmax(0)
    high = replicates - inside[::-1].argmax(0)
    return np.stack([np.append(low, replicates), np.append(high, replicates)]) / replicates


class _CachedImages:
    """Rendered images of a model by time."""

    def __init__(self, model: VideoModel):
        self.residuals = Residuals(model, np.zeros((3, *model.size, 3), np.uint8))
        self.kept: dict[float, np.ndarray] = {}

    def __call__(self, times: Iterable[float]) -> Iterator[Float32[np.ndarray, "3 height width"]]:
        times = [float(t) for t in times]
        missing = [t for t in dict.fromkeys(times) if t not in self.kept]
        self.kept |= zip(missing, self.residuals.render_at(missing), strict=True)
        yield from (self.kept[t] for t in times)


def _draw_noise(shape: tuple[int, ...], correlation: float | None, rng: np.random.Generator) -> np.ndarray:
    """Stationary noise of variance 1, periodic at the borders."""
    white = rng.standard_normal(shape, np.float32)
    if correlation is None:
        return white
    spread = (*(0,) * (len(shape) - 2), correlation, correlation)
    impulse = np.zeros(shape[-2:])
    impulse[0, 0] = 1
    kernel = scipy.ndimage.gaussian_filter(impulse, correlation, mode="wrap")
    return scipy.ndimage.gaussian_filter(white, spread, mode="wrap") / np.float32(np.sqrt((kernel**2).sum()))


class _SimulatedResiduals:
    """Stands in for `Residuals`, with cached images and frames that are not rounded to 8 bits."""

    def __init__(self, images: _CachedImages, frames: Float32[np.ndarray, "num_frames 3 height width"]):
        self.frames, self.model, self.render_at = frames, images.residuals.model, images

    def squared_errors(self, image: np.ndarray, which: Iterable[int]) -> np.ndarray:
        misses = (self.frames[np.asarray(which)] - image).reshape(len(which), -1)
        return np.einsum("kp,kp->k", misses, misses, dtype=np.float64)

    def residual(self, k: int, image: np.ndarray) -> np.ndarray:
        return self.frames[k] - image


def _sample_by_emcee(
    profiles: LikelihoodProfiles, concentration: float, draws: int, steps: int, seed: int
) -> tuple[Float64[np.ndarray, "draws num_frames"], bool]:
    found = frame_time_posterior(profiles, concentration=concentration, steps=steps, ensembles=2, seed=seed)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_THINNING,)))
    which = rng.choice(len(found.draws), draws, replace=False)
    return found.draws[which], found.converged
