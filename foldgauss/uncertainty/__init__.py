"""How sure the learned frame times are: likelihood profiles, and what is drawn from them."""

from foldgauss.uncertainty.calibration import SimulatedRanks, coverage, ecdf_band, simulated_ranks
from foldgauss.uncertainty.colors import evidence_without_colors
from foldgauss.uncertainty.drawing import Evidence, evidence
from foldgauss.uncertainty.exact import ExactTimes, exact_times
from foldgauss.uncertainty.increments import Increments
from foldgauss.uncertainty.laplace import LaplaceTimes, laplace_times
from foldgauss.uncertainty.log_prob import FrameTimeLogProb, drawn_log_likelihood, frame_time_log_prob
from foldgauss.uncertainty.noise import FrameNoise
from foldgauss.uncertainty.pace import (
    ComparedTimes,
    IncrementIntervals,
    Irregularity,
    compare_times,
    intervals,
    irregularities,
)
from foldgauss.uncertainty.posterior import FrameTimePosterior, frame_time_posterior
from foldgauss.uncertainty.profiles import Profiles
from foldgauss.uncertainty.refit import Refit, RefitTimes, refit_frame_times, refits
from foldgauss.uncertainty.report import frame_table, summary

__all__ = [
    "ComparedTimes",
    "Evidence",
    "ExactTimes",
    "FrameNoise",
    "FrameTimeLogProb",
    "FrameTimePosterior",
    "IncrementIntervals",
    "Increments",
    "Irregularity",
    "LaplaceTimes",
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
