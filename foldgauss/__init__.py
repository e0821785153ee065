"""Folded-Gaussian mixtures in JAX, and videos made of them (VeGaS, Smolak-Dyżewska et al. 2024).

Names and modules are imported when first asked for: `import foldgauss` alone, as the command does, brings not even JAX.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING

from foldgauss._runtime import notebook_hooks

if TYPE_CHECKING:
    from foldgauss.analysis.divergence import kl_divergence
    from foldgauss.distribution import FoldedGaussian, Gaussian
    from foldgauss.envelope import CallableEnvelope, Constant, TimeLikelihood, plain_envelope
    from foldgauss.estimator import FoldedGaussianMixture as FoldedGaussianMixture
    from foldgauss.estimator import FoldedMixtureRegressor as FoldedMixtureRegressor
    from foldgauss.fold import CallableFold, FourierFold, PolynomialFold, SharedPathFold, SplineFold, ZeroFold
    from foldgauss.mixture import FoldedMixture, Mixture

notebook_hooks.register("video", "foldgauss.io.page.player_page:make_notebook_iframe")

__version__ = "0.1.0"

# Without those of `estimator`, which need scikit-learn: `from foldgauss import *` works without the extra.
__all__ = [
    "CallableEnvelope",
    "CallableFold",
    "Constant",
    "FoldedGaussian",
    "FoldedMixture",
    "FourierFold",
    "Gaussian",
    "Mixture",
    "PolynomialFold",
    "SharedPathFold",
    "SplineFold",
    "TimeLikelihood",
    "ZeroFold",
    "__version__",
    "kl_divergence",
    "plain_envelope",
]

_HOMES = {
    "distribution": ("FoldedGaussian", "Gaussian"),
    "analysis.divergence": ("kl_divergence",),
    "envelope": ("CallableEnvelope", "Constant", "TimeLikelihood", "plain_envelope"),
    "estimator": ("FoldedGaussianMixture", "FoldedMixtureRegressor"),
    "fold": ("CallableFold", "FourierFold", "PolynomialFold", "SharedPathFold", "SplineFold", "ZeroFold"),
    "mixture": ("FoldedMixture", "Mixture"),
}


def __getattr__(name: str) -> object:
    """Import a public name or a module when it is first accessed (PEP 562)."""
    for home, names in _HOMES.items():
        if name in names:
            globals()[name] = found = getattr(importlib.import_module(f"{__name__}.{home}"), name)
            return found
    if not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}") is not None:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
