"""Folded-Gaussian mixtures in JAX, and videos made of them (VeGaS, Smolak-Dyżewska et al. 2024).

Names and modules are imported when first asked for: `import foldgauss` alone, as the command does, brings not even JAX.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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

_HOMES = {
    "distribution": ("FoldedGaussian", "Gaussian", "Normal"),
    "divergence": ("kl_divergence",),
    "envelope": ("CallableEnvelope", "Constant", "TimeLikelihood", "plain_envelope"),
    "fold": ("CallableFold", "FourierFold", "PolynomialFold", "SplineFold", "ZeroFold"),
    "mixture": ("FoldedMixture", "GaussianMixture"),
}


def __getattr__(name: str) -> object:
    """A public name, or a module (PEP 562); each is asked for here once."""
    for home, names in _HOMES.items():
        if name in names:
            globals()[name] = found = getattr(importlib.import_module(f"{__name__}.{home}"), name)
            return found
    if not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}") is not None:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
