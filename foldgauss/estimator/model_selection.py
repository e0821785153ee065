"""Selection of the number of components and the degree, by information criteria or cross-validation over a grid."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import _safe_indexing

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import check_one_of, invalid, is_integer
from foldgauss.estimator.chunks import is_chunked
from foldgauss.estimator.folded_gaussian_mixture import EMStatus, FoldedGaussianMixture

__all__ = ["MixtureChoice", "select_mixture"]


class MixtureChoice(NamedTuple):
    """The estimator with the smallest criterion, fitted to all points; the criterion, (components, degrees), inf for a
    failed fit; and the values along these axes."""

    estimator: FoldedGaussianMixture
    scores: Float[np.ndarray, "components degrees"]
    n_components: tuple[int, ...]
    degrees: tuple[int | str, ...]


def select_mixture(
    estimator: FoldedGaussianMixture,
    X: Float[np.ndarray, "n d"],
    *,
    n_components: Sequence[int],
    degrees: Sequence[int | str],
    criterion: str = "bic",
    folds: int = 5,
    groups: np.ndarray | None = None,
) -> MixtureChoice:
    """Select the number of components and the degree that minimize a criterion.

    * "bic": -2 log-likelihood + parameters log n; "aic": + 2 parameters;
    * "cv": -2 times the log-likelihood of held-out points, in `folds` folds.

    `groups` (n,) are the units of dependent rows, such as the track of each row, as in `FoldedGaussianMixture.fit`:
    "cv" keeps each group in one fold, the other criteria count groups instead of rows.

    A degree of "auto" is chosen for each component by itself, up to `max_degree`.

    **Shapes:** X (n, d), as in `fit`, or chunks of rows for "bic" and "aic"; all other settings are the estimator's.

    **Example:** `select_mixture(FoldedGaussianMixture(n_init=3), x, n_components=range(1, 6), degrees=[0, 1, 3])`

    **Source:** Schwarz 1978; Akaike 1974; Stone 1974. **Raises:** ValueError on empty or invalid choices, or if no fit
    is finite.
    """
    check_one_of("criterion", criterion, ("bic", "aic", "cv"))
    sizes, degrees = tuple(n_components), tuple(degrees)
    if not sizes or not all(is_integer(k, 1) for k in sizes):
        raise invalid("n_components", expected="whole numbers >= 1", got=sizes, cure="For example range(1, 6).")
    if not degrees or not all(q == "auto" or is_integer(q, 0) for q in degrees):
        raise invalid("degrees", expected='whole numbers >= 0 or "auto"', got=degrees)
    parts = None
    if criterion == "cv":
        if is_chunked(X):
            got, cure = '"cv"', "Or pass one array."
            raise invalid("criterion", expected='"bic" or "aic" for chunks of rows', got=got, cure=cure)
        X = X if hasattr(X, "shape") else np.asarray(X)  # a data frame keeps the names of its columns
        parts = _assign_folds(len(X), folds, groups)
    scores, chosen, told = np.full((len(sizes), len(degrees)), np.inf), None, []
    for i, size in enumerate(sizes):
        for j, degree in enumerate(degrees):
            one = clone(estimator).set_params(n_components=int(size), degree=degree)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", ConvergenceWarning)
                if criterion == "cv":
                    scores[i, j] = _hold_out(one, X, parts, groups)
                else:
                    scores[i, j] = _penalize(one, X, groups, criterion)
            if scores[i, j] < np.inf and scores[i, j] == scores.min():
                chosen, told = one, caught
    if not np.isfinite(scores).any():
        raise invalid("X", expected="points that some mixture fits", got="none", cure="Raise reg_covar.")
    if criterion == "cv":
        chosen.fit(X, groups=groups)
    else:  # fitted already: fitting again could find another optimum
        for warning in told:
            warnings.warn(warning.message, stacklevel=2)
    return MixtureChoice(chosen, scores, sizes, degrees)


def _penalize(estimator, X, groups, criterion: str) -> float:
    estimator.fit(X, groups=groups)
    return np.inf if estimator.status_ == EMStatus.NOT_FINITE else getattr(estimator, criterion)(X, groups)


def _hold_out(estimator, X, parts, groups) -> float:
    total = 0.0
    for part in range(parts.max() + 1):
        kept, held = np.flatnonzero(parts != part), np.flatnonzero(parts == part)
        some = None if groups is None else np.asarray(groups)[kept]
        if some is not None and len(np.unique(some)) < 2:  # the rows of a single group give no gap between groups
            some = None
        fitted = clone(estimator).fit(_safe_indexing(X, kept), groups=some)
        if fitted.status_ == EMStatus.NOT_FINITE:
            return np.inf
        total -= 2 * float(fitted.score_samples(_safe_indexing(X, held)).sum(dtype=np.float64))
    return total if np.isfinite(total) else np.inf


def _assign_folds(num: int, folds: int, groups: np.ndarray | None) -> np.ndarray:
    """The cross-validation fold of each point: folds of equal size, random but reproducible."""
    names, which = np.unique(np.arange(num) if groups is None else groups, return_inverse=True)
    if which.shape != (num,):
        raise invalid("groups", expected=f"shape ({num},)", got=f"shape {np.shape(groups)}", cure="One per row of X.")
    if not is_integer(folds, 2) or folds > len(names):
        raise invalid("folds", expected=f"a whole number from 2 to {len(names)}", got=folds, cure="Fewer parts.")
    return (make_generator(Stream.CROSS_VALIDATION).permutation(len(names)) % folds)[which]
