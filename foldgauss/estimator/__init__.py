"""Estimation from points: mixtures by EM as a scikit-learn estimator, one Folded-Gaussian by maximum likelihood.

`FoldedGaussianMixture` is the estimator; `likelihood.fit` fits a single Folded-Gaussian, `gradient_fit` a mixture with
any fold and envelope by gradient ascent, `model_selection` chooses the number of components. `em` has the algorithm on
arrays. Names are imported when first used: `likelihood` works without scikit-learn.
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
