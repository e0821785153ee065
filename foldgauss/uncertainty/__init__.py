"""How sure the learned frame times are: likelihood profiles, and what is drawn from them."""

from foldgauss.uncertainty.drawing import Evidence, evidence
from foldgauss.uncertainty.noise import FrameNoise
from foldgauss.uncertainty.profiles import Profiles
from foldgauss.uncertainty.refit import Refit, RefitTimes, refit_frame_times, refits

__all__ = ["Evidence", "FrameNoise", "Profiles", "Refit", "RefitTimes", "evidence", "refit_frame_times", "refits"]
