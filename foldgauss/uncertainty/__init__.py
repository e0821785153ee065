"""How sure the learned frame times are: likelihood profiles, and what is drawn from them."""

from foldgauss.uncertainty.calibration import SimulatedRanks, coverage, ecdf_band, simulated_ranks
from foldgauss.uncertainty.colors import evidence_without_colors
from foldgauss.uncertainty.drawing import Evidence, evidence
from foldgauss.uncertainty.exact import ExactTimes, exact_times
from foldgauss.uncertainty.increments import Increments
from foldgauss.uncertainty.laplace import LaplaceTimes, laplace_times
from foldgauss.uncertainty.log_prob import FrameTimeLogProb, drawn_log_likelihood, frame_time_log_prob
from foldgauss.uncertainty.noise import FrameNoise
from foldgauss.uncertainty.posterior import FrameTimePosterior, frame_time_posterior
from foldgauss.uncertainty.profiles import Profiles
from foldgauss.uncertainty.refit import Refit, RefitTimes, refit_frame_times, refits

__all__ = [
    "Evidence",
    "ExactTimes",
    "FrameNoise",
    "FrameTimeLogProb",
    "FrameTimePosterior",
    "Increments",
    "LaplaceTimes",
    "Profiles",
    "Refit",
    "RefitTimes",
    "SimulatedRanks",
    "coverage",
    "drawn_log_likelihood",
    "ecdf_band",
    "evidence",
    "evidence_without_colors",
    "exact_times",
    "frame_time_log_prob",
    "frame_time_posterior",
    "laplace_times",
    "refit_frame_times",
    "refits",
    "simulated_ranks",
]
