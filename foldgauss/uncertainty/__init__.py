"""Posterior distribution of the learned frame times.

`likelihood_profiles` renders the model at many times and gives the log-likelihood of each frame as a function of its
time; `frame_time_posterior` samples the times from their posterior by emcee, beside the exact marginals
(`exact_posterior`); `irregularities`, `summary` and `frame_table` report on it; `refit_frame_times` refits splats and
times together. Sampling needs the extra `uncertainty`.
"""

from foldgauss.uncertainty.diagnostics.irregularities import (
    IncrementIntervals,
    Irregularity,
    increment_intervals,
    irregularities,
)
from foldgauss.uncertainty.diagnostics.report import frame_table, summary
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles, likelihood_profiles
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.likelihood.refit import RefitTimes, refit_frame_times
from foldgauss.uncertainty.posterior.exact import ExactPosterior, exact_posterior
from foldgauss.uncertainty.posterior.log_prob import FrameTimeLogProb
from foldgauss.uncertainty.posterior.result import FrameTimePosterior
from foldgauss.uncertainty.posterior.sampling import frame_time_posterior

__all__ = [
    "ExactPosterior",
    "FrameNoise",
    "FrameTimeLogProb",
    "FrameTimePosterior",
    "IncrementIntervals",
    "Irregularity",
    "LikelihoodProfiles",
    "ProfileCurves",
    "RefitTimes",
    "exact_posterior",
    "frame_table",
    "frame_time_posterior",
    "increment_intervals",
    "irregularities",
    "likelihood_profiles",
    "refit_frame_times",
    "summary",
]
