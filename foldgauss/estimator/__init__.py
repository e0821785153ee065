"""Estimation of Folded-Gaussians and their mixtures from points.

`FoldedGaussianMixture` fits mixtures by EM as a scikit-learn estimator, and `model_selection.select_mixture` chooses
their size; `likelihood.fit` fits a single Folded-Gaussian by maximum likelihood, and `gradient_fit.fit_gradient` a
mixture with any fold and envelope by gradient ascent. `em` is the algorithm on arrays. Names are imported when first
used: `likelihood` does not need scikit-learn.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from foldgauss.estimator.em.loop import EMStatus
    from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture

__all__ = ["EMStatus", "FoldedGaussianMixture"]


def __getattr__(name: str) -> object:
    if name in __all__:
        from foldgauss.estimator import folded_gaussian_mixture

        return getattr(folded_gaussian_mixture, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
