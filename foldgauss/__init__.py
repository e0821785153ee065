"""Folded-Gaussian mixtures in JAX, and videos made of them (VeGaS, Smolak-Dyżewska et al. 2024)."""

from foldgauss.distribution import FoldedGaussian, Gaussian, Normal
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import PolynomialFold, ZeroFold

__version__ = "0.1.0"

__all__ = [
    "Constant",
    "FoldedGaussian",
    "Gaussian",
    "Normal",
    "PolynomialFold",
    "TimeLikelihood",
    "ZeroFold",
    "__version__",
]
