"""How sure the learned frame times are: likelihood profiles, and what is drawn from them."""

from foldgauss.uncertainty.diagnostics.calibration import SimulatedRanks, coverage, ecdf_band, simulated_ranks
from foldgauss.uncertainty.diagnostics.irregularities import (
    ComparedTimes,
    IncrementIntervals,
    Irregularity,
    compare_times,
    intervals,
    irregularities,
)
from foldgauss.uncertainty.diagnostics.report import frame_table, summary
from foldgauss.uncertainty.likelihood.colors import evidence_without_colors
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles, evidence
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.likelihood.profiles import Profiles
from foldgauss.uncertainty.likelihood.refit import Refit, RefitTimes, refit_frame_times, refits
from foldgauss.uncertainty.posterior.exact import ExactTimes, exact_times
from foldgauss.uncertainty.posterior.increments import Increments
from foldgauss.uncertainty.posterior.laplace import LaplaceTimes, laplace_times
from foldgauss.uncertainty.posterior.log_prob import FrameTimeLogProb, drawn_log_likelihood, frame_time_log_prob
from foldgauss.uncertainty.posterior.sampling import FrameTimePosterior, frame_time_posterior

__all__ = [
    "ComparedTimes",
    "ExactTimes",
    "FrameNoise",
    "FrameTimeLogProb",
    "FrameTimePosterior",
    "IncrementIntervals",
    "Increments",
    "Irregularity",
    "LaplaceTimes",
    "LikelihoodProfiles",
    "Profiles",
    "Refit",
    "RefitTimes",
    "SimulatedRanks",
    "compare_times",
    "coverage",
    "drawn_log_likelihood",
    "ecdf_band",
    "evidence",
    "evidence_without_colors",
    "exact_times",
    "frame_table",
    "frame_time_log_prob",
    "frame_time_posterior",
    "intervals",
    "irregularities",
    "laplace_times",
    "refit_frame_times",
    "refits",
    "simulated_ranks",
    "summary",
]
