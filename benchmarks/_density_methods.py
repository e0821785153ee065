"""The methods of `benchmarks.density`: each fits training points, selects its own size from them alone, and is scored.

Every selection (BIC, cross-validation, early stopping) takes rows as independent. Rows have mean 0 and standard
deviation 1 in each column, over training and test points together.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from sklearn.mixture import BayesianGaussianMixture, GaussianMixture
from sklearn.model_selection import GridSearchCV, KFold
from sklearn.neighbors import KernelDensity

from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture

__all__ = ["METHODS", "OURS", "Effort", "Fitted"]

Rows = Float[np.ndarray, "n d"]


class Effort(NamedTuple):
    """What a search may spend."""

    components: int = 20
    starts: int = 3  # of Gaussian mixtures, for each number of components
    max_iter: int = 500
    epochs: int = 500


class Fitted(NamedTuple):
    """A density: log p(x) of rows, the number of stored parameters, whether the fit converged, and what was chosen."""

    log_density: Callable[[Rows], Float[np.ndarray, " n"]]
    parameters: int
    converged: bool
    chosen: str


# --- scikit-learn -----------------------------------------------------------------------------------------------


def _gaussian_mixture(x: Rows, seed: int, effort: Effort) -> Fitted:
    """Full covariances, the number of components by BIC."""
    options = {"n_init": effort.starts, "max_iter": effort.max_iter, "random_state": seed}
    models = [GaussianMixture(size, **options).fit(x) for size in range(1, effort.components + 1)]
    best = min(models, key=lambda model: model.bic(x))
    return Fitted(best.score_samples, best._n_parameters(), best.converged_, f"{best.n_components} components")


def _bayesian_mixture(x: Rows, seed: int, effort: Effort) -> Fitted:
    """A Dirichlet process' mixture at its default priors; components of less than one point are not counted.

    Scored is the mixture of the posterior's mean weights, means and covariances: the class's own `score_samples` sums
    exponentials of expected logarithms, which are less than a density.
    """
    model = BayesianGaussianMixture(
        n_components=effort.components, n_init=effort.starts, max_iter=effort.max_iter, random_state=seed
    ).fit(x)
    used, dim = int((model.weights_ * len(x) >= 1).sum()), x.shape[1]
    parameters = used * (dim + dim * (dim + 1) // 2) + used - 1
    mixture = GaussianMixture(effort.components)
    mixture.weights_, mixture.means_, mixture.covariances_ = model.weights_, model.means_, model.covariances_
    mixture.precisions_cholesky_ = np.linalg.inv(np.linalg.cholesky(model.covariances_)).swapaxes(1, 2)
    return Fitted(mixture.score_samples, parameters, model.converged_, f"{used} components")


def _kernel_density(x: Rows, seed: int, effort: Effort) -> Fitted:
    """A Gaussian kernel of one bandwidth, by 5-fold cross-validation: it stores the points and the bandwidth."""
    grid = {"bandwidth": np.geomspace(0.02, 1.0, 25)}
    folds = KFold(5, shuffle=True, random_state=seed)
    best = GridSearchCV(KernelDensity(), grid, cv=folds).fit(x).best_estimator_
    return Fitted(best.score_samples, x.size + 1, True, f"bandwidth {best.bandwidth:.3f}")


# --- a normalising flow -----------------------------------------------------------------------------------------

#: Fraction of the rows on which the validation loss is measured.
_VALIDATION = 0.15
#: Training stops when the validation loss has not decreased for this many epochs.
_PATIENCE = 30
#: Interval of the splines.
_INTERVAL = 4.0


def _flow(x: Rows, seed: int, effort: Effort) -> Fitted:
    """flowjax's masked autoregressive flow of rational-quadratic splines; training stops by a validation part."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import paramax
    from flowjax.bijections import RationalQuadraticSpline
    from flowjax.distributions import Normal
    from flowjax.flows import masked_autoregressive_flow
    from flowjax.train import fit_to_data

    build, train = jax.random.split(jax.random.key(seed))
    start = masked_autoregressive_flow(
        build,
        base_dist=Normal(jnp.zeros(x.shape[1])),
        transformer=RationalQuadraticSpline(knots=8, interval=_INTERVAL),
        flow_layers=4,
        nn_width=32,
    )
    flow, losses = fit_to_data(
        train,
        start,
        jnp.asarray(x, jnp.float32),
        learning_rate=3e-3,
        max_epochs=effort.epochs,
        max_patience=_PATIENCE,
        batch_size=min(100, len(x) // 2),
        val_prop=_VALIDATION,
        show_progress=False,
    )
    frozen = lambda leaf: isinstance(leaf, paramax.NonTrainable)  # noqa: E731
    trained = eqx.filter(flow, eqx.is_inexact_array, is_leaf=frozen)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(trained))
    log_prob, epochs = eqx.filter_jit(flow.log_prob), len(losses["val"])
    score = lambda rows: np.asarray(log_prob(jnp.asarray(rows, jnp.float32)), np.float64)  # noqa: E731
    return Fitted(score, parameters, epochs < effort.epochs, f"{epochs} epochs")


# --- Folded-Gaussians -------------------------------------------------------------------------------------------

#: Starts among which BIC chooses, for each column as time.
_STARTS = [
    {"init_params": start, "annealing": annealing} for start in ("kmeans", "trajectories") for annealing in (1.0, 0.1)
]


def _folded_by_bic(degree: int | str) -> Callable[[Rows, int, Effort], Fitted]:
    """ "auto" from up to as many components as scikit-learn may use; the column that is time, and the start, by BIC."""

    def fit(x: Rows, seed: int, effort: Effort) -> Fitted:
        options: dict[str, Any] = {"degree": degree, "max_components": effort.components, "random_state": seed}
        models = [
            FoldedGaussianMixture(time_column=column, max_iter=effort.max_iter, **start, **options).fit(x)
            for column in range(x.shape[1])
            for start in _STARTS
        ]
        return _describe(min(models, key=lambda model: model.bic(x)))

    return fit


def _folded_defaults(x: Rows, seed: int, effort: Effort) -> Fitted:
    """The estimator as it is without arguments: the last column is time, at most 10 components of degree 3."""
    return _describe(FoldedGaussianMixture(random_state=seed).fit(x))


def _describe(model: FoldedGaussianMixture) -> Fitted:
    degrees = "".join(str(degree) for degree in sorted(model.degrees_, reverse=True))
    chosen = f"time {model.time_column}, degrees {degrees}, {model.init_params}, annealing {model.annealing:g}"
    return Fitted(model.score_samples, model._n_parameters(), bool(model.converged_), chosen)


#: The row that is held against the others.
OURS = "foldgauss"
#: By name; cheap and telling ones first.
METHODS: dict[str, Callable[[Rows, int, Effort], Fitted]] = {
    OURS: _folded_by_bic("auto"),
    "GaussianMixture": _gaussian_mixture,
    "flow": _flow,
    "KernelDensity": _kernel_density,
    "foldgauss, degree 2": _folded_by_bic(2),
    "BayesianGaussianMixture": _bayesian_mixture,
    "foldgauss, defaults": _folded_defaults,
}
