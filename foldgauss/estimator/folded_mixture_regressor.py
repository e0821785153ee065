"""`FoldedMixtureRegressor`: regression by the conditional distribution of a mixture of Folded-Gaussians."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin, clone
from sklearn.utils.validation import check_is_fitted, validate_data

from foldgauss._runtime.checks import require
from foldgauss.estimator.em.statistics import enable_dtype
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture
from foldgauss.estimator.parameter_checks import check_column, check_real
from foldgauss.estimator.prediction import map_blocks
from foldgauss.estimator.rows import order_columns


class FoldedMixtureRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Regression of y on X by a `FoldedGaussianMixture` of the columns (X, y), in which a column of X is time.

        p(y | x) = sum_k w_k(x) N(y | mu_k(x), a_k(t) C_k),   w_k(x) ~ w_k p_k(x),   x = (s, t)

    The fold's variable t is always a feature: t ~ N(m_k, sigma_k^2), and given t the other features s and the targets y
    are jointly Gaussian around a curve in t. Therefore p(y | x) is exactly a mixture of Gaussians: mu_k(x) is a
    polynomial of t, linear in s, and C_k the covariance of y given s at a = 1. With a single feature, X is t and
    mu_k(t) = loc_k + f_k(m_k - t). The weights w_k(x) change between the components, so that the regression may have
    other slopes, variances and numbers of modes in other regions; far from all data the nearest component's polynomial
    extrapolates.

    **Parameters:** `mixture`, an unfitted `FoldedGaussianMixture` (default: one with its defaults), whose `time_column`
    is a column of X. It maximizes the joint likelihood of X and y, not the error of y.

    **Shapes:** X (n, p), p >= 1; y (n,) or (n, m); predictions have the shape of y. **dtype:** float64.

    **Fitted:** `mixture_`, the `FoldedGaussianMixture` of the columns (X, y); `n_iter_`, `n_features_in_`.

    **Example:**

        regressor = FoldedMixtureRegressor(FoldedGaussianMixture(3, degree=2, random_state=0)).fit(X, y)
        mean, std = regressor.predict(X, return_std=True)
        low, median, high = regressor.predict_quantiles(X, [0.05, 0.5, 0.95]).T

    **Source:** Gaussian mixture regression (Ghahramani and Jordan 1994) with eq:cond_dens for each component.
    **Raises:** ValueError naming the parameter.
    """

    def __init__(self, mixture=None):
        self.mixture = mixture

    def fit(self, X, y, sample_weight=None, groups=None):
        """Fit the mixture of (X, y); `sample_weight` (n,) and `groups` (n,) as in `FoldedGaussianMixture.fit`.

        **Raises:** ValueError on invalid parameters, NaN or infinity, and fewer rows than components. Warns
        (ConvergenceWarning) if EM did not converge, see `mixture_.status_`.
        """
        check_real("X", X)
        X, y = validate_data(self, X, y, dtype=np.float64, multi_output=True, y_numeric=True, ensure_min_samples=2)
        mixture = FoldedGaussianMixture() if self.mixture is None else clone(self.mixture)
        column = check_column(mixture.time_column, X.shape[1], getattr(self, "feature_names_in_", None))
        self.mixture_ = mixture.set_params(time_column=column).fit(
            np.column_stack([X, y]), sample_weight=sample_weight, groups=groups
        )
        self.n_iter_, self._target_shape = self.mixture_.n_iter_, y.shape[1:]
        return self

    def predict(self, X, return_std=False) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """E[y | x] of each row, (n,) or (n, m); with `return_std` a tuple with the standard deviations of y given x."""
        mean, std = (z.reshape(-1, *self._target_shape) for z in self._evaluate(_moments, X))
        return (mean, std) if return_std else mean

    def predict_quantiles(self, X, quantiles: ArrayLike) -> np.ndarray:
        """The quantiles of p(y | x) at these levels, of each target by itself.

        **Shapes:** the shape of `predict`, followed by that of `quantiles`.

        **Example:** `regressor.predict_quantiles(X, [0.05, 0.95])  # (n, 2): an interval of 90%`

        **Raises:** ValueError on levels outside (0, 1).
        """
        levels = np.asarray(quantiles, np.float64)
        require(
            ((levels > 0) & (levels < 1)).all(),
            "quantiles",
            expected="levels between 0 and 1",
            got=levels.tolist(),
            cure="0.5 is the median.",
        )
        (values,) = self._evaluate(_quantiles, X, levels.ravel())
        return values.reshape(-1, *self._target_shape, *levels.shape)

    def _evaluate(self, function, X, *args) -> tuple[np.ndarray, ...]:
        """The arrays that `function` gives of p(y | x), by blocks of rows."""
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        order = order_columns(self.mixture_.time_column, self.mixture_.n_features_in_).tolist()
        indices = tuple(order.index(column) for column in range(X.shape[1]))
        with enable_dtype(X.dtype):
            mixture = self.mixture_.to_mixture()
            return map_blocks(lambda x: function(mixture, indices, jnp.asarray(x), *args), X)


@eqx.filter_jit
def _moments(mixture, indices: tuple[int, ...], x):
    """The means and standard deviations of the targets, (n, m) each."""
    given = mixture.condition(indices, x)
    return given.mean, given.stddev


@eqx.filter_jit
def _quantiles(mixture, indices: tuple[int, ...], x, levels):
    """The quantiles of each target, (n, m, q)."""
    given = mixture.condition(indices, x)
    targets = [given.marginal([j]).icdf(jnp.asarray(levels)[:, None]) for j in range(*given.event_shape)]
    return (jnp.concatenate(targets, axis=-1).transpose(1, 2, 0),)
