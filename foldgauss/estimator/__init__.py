"""Estimation of Folded-Gaussians and their mixtures from points.

`FoldedGaussianMixture` fits mixtures by EM as a scikit-learn estimator, and `FoldedMixtureRegressor` predicts by the
conditional distribution of one; `likelihood.fit` fits a single Folded-Gaussian by maximum likelihood, and
`gradient_fit.fit_gradient` a mixture with any fold and envelope by gradient ascent. `em` is the algorithm on arrays.
Names are imported when first used: `likelihood` does not need scikit-learn.
"""

import importlib
from typing import TYPE_CHECKING

from foldgauss._runtime.optional_imports import import_optional

if TYPE_CHECKING:
    from foldgauss.estimator.em.loop import EMStatus
    from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture
    from foldgauss.estimator.folded_mixture_regressor import FoldedMixtureRegressor

__all__ = ["EMStatus", "FoldedGaussianMixture", "FoldedMixtureRegressor"]

_HOMES = {
    "EMStatus": "em.loop",
    "FoldedGaussianMixture": "folded_gaussian_mixture",
    "FoldedMixtureRegressor": "folded_mixture_regressor",
}


def __getattr__(name: str) -> object:
    if name in _HOMES:
        import_optional("sklearn", "sklearn")
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
