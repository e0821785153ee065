"""Folded-Gaussian mixtures in JAX, and videos made of them (VeGaS, Smolak-Dyżewska et al. 2024)."""

from foldgauss.distribution import FoldedGaussian, Gaussian, Normal
from foldgauss.divergence import kl_divergence
from foldgauss.envelope import CallableEnvelope, Constant, TimeLikelihood, plain_envelope
from foldgauss.fold import CallableFold, FourierFold, PolynomialFold, SplineFold, ZeroFold
from foldgauss.mixture import FoldedMixture, GaussianMixture

__version__ = "0.1.0"

__all__ = [
    "CallableEnvelope",
    "CallableFold",
    "Constant",
    "FoldedGaussian",
    "FoldedMixture",
    "FourierFold",
    "Gaussian",
    "GaussianMixture",
    "Normal",
    "PolynomialFold",
    "SplineFold",
    "TimeLikelihood",
    "ZeroFold",
    "__version__",
    "kl_divergence",
    "plain_envelope",
]
