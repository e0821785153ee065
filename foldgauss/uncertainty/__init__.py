"""How sure the learned frame times are: likelihood profiles, and what is drawn from them."""

from foldgauss.uncertainty.drawing import Evidence, evidence
from foldgauss.uncertainty.noise import FrameNoise
from foldgauss.uncertainty.profiles import Profiles

__all__ = ["Evidence", "FrameNoise", "Profiles", "evidence"]
