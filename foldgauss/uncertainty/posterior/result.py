"""The sampled posterior of frame times with its convergence diagnostics."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from foldgauss._runtime.checks import check_within
from foldgauss._runtime.optional_imports import import_optional
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles
from foldgauss.uncertainty.posterior.exact import ExactPosterior
from foldgauss.uncertainty.posterior.log_prob import FrameTimeLogProb, logits_of

if TYPE_CHECKING:
    import arviz
    import xarray

#: Frames whose draws are reduced together: only these are copied, not all draws.
FRAMES_PER_BATCH = 64


@dataclasses.dataclass(frozen=True, repr=False)
class FrameTimePosterior:
    r"""Draws from the posterior of frame times, with convergence diagnostics.

    **Shapes:** `times` (ensembles, steps, walkers, num_frames) after burn-in; `acceptance` (ensembles,), the mean
    acceptance fraction; `tau`, `r_hat`, `ess` (num_free,) in the order of `free`: integrated autocorrelation time in
    steps of the sampler, split rank R-hat over the ensembles, and effective sample size.

    `converged`: more than 50 tau are kept for every frame, every R-hat is below 1.01, and every mean is within
    0.1 + 5 / sqrt(ess) standard deviations of the exact one, which detects ensembles that all miss the same mode.
    `message` states this or what is missing, and how many frames are `identified` if not all are.
    `exact`: the same posterior by the forward-backward algorithm.

    **Source:** emcee, Foreman-Mackey et al. 2013; R-hat, Vehtari et al. 2021. The walkers of one ensemble are
    dependent, so each ensemble is one chain; ESS is steps times walkers over tau.
    """

    log_prob: FrameTimeLogProb
    profiles: LikelihoodProfiles
    exact: ExactPosterior
    times: Float64[np.ndarray, "ensembles steps walkers num_frames"]
    acceptance: Float64[np.ndarray, " ensembles"]
    tau: Float64[np.ndarray, " num_free"]
    r_hat: Float64[np.ndarray, " num_free"]
    ess: Float64[np.ndarray, " num_free"]
    converged: bool = False
    message: str = ""

    def __repr__(self) -> str:
        ensembles, steps, walkers, frames = self.times.shape
        shape = f"{len(self.free)} of {frames} times, {ensembles} x {steps} x {walkers} draws"
        return f"{type(self).__name__}({shape}: {self.message})"

    @property
    def free(self) -> np.ndarray:
        """Indices of the frames whose times were sampled: all but the first and the last."""
        return np.arange(1, self.times.shape[-1] - 1)

    @property
    def draws(self) -> Float64[np.ndarray, "draws num_frames"]:
        """All draws of all ensembles."""
        return self.times.reshape(-1, self.times.shape[-1])

    def mean(self) -> Float64[np.ndarray, " num_frames"]:
        return self.times.mean((0, 1, 2))

    def std(self) -> Float64[np.ndarray, " num_frames"]:
        return self._reduce(lambda draws: draws.std(0))

    def interval(self, level: float = 0.95) -> tuple[Float64[np.ndarray, " num_frames"], ...]:
        """(low, high) of the central intervals that contain the fraction `level` of the draws."""
        check_within("level", level, "(0, 1)", "a number in (0, 1)")
        bounds = [(1 - level) / 2, (1 + level) / 2]
        return tuple(self._reduce(lambda draws: np.quantile(draws, bounds, axis=0)))

    def _reduce(self, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Apply a reduction of draws (draws, frames) to batches of frames, without a copy of all draws."""
        num_frames = self.times.shape[-1]
        parts = [self.times[..., k : k + FRAMES_PER_BATCH] for k in range(0, num_frames, FRAMES_PER_BATCH)]
        return np.concatenate([function(part.reshape(-1, part.shape[-1])) for part in parts], axis=-1)

    def identified(self, fraction: float = 0.8) -> np.ndarray:
        """Frames whose time the likelihood determines, bool (num_frames,): spread below `fraction` of the prior's.

        The prior's spread is that of a frame between its neighbors at their posterior means. The first and the last
        frame count as identified.
        """
        mean, alpha = self.mean(), self.log_prob.concentration
        found = np.ones(len(mean), bool)
        gap = mean[2:] - mean[:-2]
        found[1:-1] = self.std()[1:-1] < fraction * gap * np.sqrt(0.25 / (2 * alpha + 1))
        return found

    def to_arviz(self) -> "arviz.InferenceData | xarray.DataTree":
        """Draws for ArviZ: an InferenceData, from ArviZ 1.0 on a DataTree. Each walker is a chain.

        Posterior: `t` (chain, draw, frame) and `w` (chain, draw, interval), centered; sample statistics: `lp`; the
        coordinate `ensemble` (chain) tells which walkers belong together. Consecutive draws of a chain are consecutive
        steps, as ArviZ's ESS presupposes. Its R-hat takes walkers as independent, `r_hat` takes ensembles.
        """
        arviz, xarray = import_optional("arviz", "uncertainty"), import_optional("xarray", "uncertainty")
        ensembles, steps, walkers, num_frames = self.times.shape
        times = np.moveaxis(self.times, 2, 1).reshape(ensembles * walkers, steps, num_frames)
        attrs = {"converged": int(self.converged), "message": self.message}
        lp = np.stack([self.log_prob(chain[..., self.free]) for chain in times])
        coords = {
            "chain": np.arange(ensembles * walkers),
            "draw": np.arange(steps),
            "ensemble": ("chain", np.repeat(np.arange(ensembles), walkers)),
        }
        places = {"frame": np.arange(num_frames), "interval": np.arange(num_frames - 1)}
        arrays = {
            "t": (("chain", "draw", "frame"), times),
            "w": (("chain", "draw", "interval"), logits_of(times)),
        }
        posterior = xarray.Dataset(arrays, coords | places)
        statistics = xarray.Dataset({"lp": (("chain", "draw"), lp)}, coords)
        if int(arviz.__version__.split(".")[0]) < 1:
            return arviz.InferenceData(posterior=posterior, sample_stats=statistics, attrs=attrs)
        groups = {"/": xarray.Dataset(attrs=attrs), "posterior": posterior, "sample_stats": statistics}
        return xarray.DataTree.from_dict(groups)
