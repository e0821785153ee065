"""`FoldedGaussianMixture`: a mixture of Folded-Gaussians as a scikit-learn estimator.

Where scikit-learn's GaussianMixture has ellipsoids, this has tubes that bend over time; with `degree=1` it is the same
model. Needs scikit-learn: `pip install "foldgauss[sklearn]"`.
"""

import warnings
from collections.abc import Iterable
from numbers import Integral
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data

from foldgauss._runtime.checks import check_one_of, invalid, is_integer, is_within
from foldgauss._runtime.threads import check_not_forked
from foldgauss.envelope import AbstractEnvelope, Constant, TimeLikelihood
from foldgauss.estimator.chunks import Chunks, Piece, Survey, chunks_of, is_chunked, picked, survey, variances_of
from foldgauss.estimator.em.components import Parameters, log_likelihoods, pairs_of
from foldgauss.estimator.em.loop import EMStatus, Run, best, expectation_maximisation, used_degrees
from foldgauss.estimator.em.online import FORGETTING, batch_sums, online_step
from foldgauss.estimator.em.prune import compressed, num_parameters, pruned
from foldgauss.estimator.em.scaling import Prepare, Scaling, scaling_of, to_mixture
from foldgauss.estimator.em.starts import STARTS, drawn, from_joint, start
from foldgauss.estimator.em.statistics import Blocks, Points, blocks_of, points_of, precision, scores
from foldgauss.estimator.em.updates import Model
from foldgauss.mixture import FoldedMixture

__all__ = ["EMStatus", "FoldedGaussianMixture"]

_COVARIANCES = ("full", "diag", "spherical", "tied")
_ENVELOPES = {"constant": Constant, "time_likelihood": lambda: TimeLikelihood(power=1.0, floor=1e-3)}
_CURES = {
    EMStatus.NOT_CONVERGED: "Raise max_iter or tol, or scale the data.",
    EMStatus.NOT_FINITE: "A component collapsed, or a point is out of all reach: raise reg_covar or the envelope's "
    "floor, or lower n_components or degree.",
    EMStatus.SINGULAR: "A component's points lie on its curve, at one time, or in a plane: raise reg_covar, or lower "
    "n_components or degree.",
}
#: Of the points, this many for each component that "auto" starts with.
_POINTS_PER_COMPONENT = 8
#: The highest degree fitted in float32. Beyond, with times far from normal, a curve's normal equations lose more digits
#: than float32 has: up to 1 nat a point at degree 10 (docs/estimator.md).
_SINGLE_DEGREE = 6
#: Steps between floating-point times up to this share of a component's spread are no loss.
_COARSEST = 0.01


class FoldedGaussianMixture(DensityMixin, BaseEstimator):
    """A mixture of Folded-Gaussians, fitted by expectation maximisation.

        p(x) = sum_k w_k N(t | m_k, sigma_k^2) N(s | loc_k + f_k(m_k - t), a_k(t) Sigma_k),   x = (s, t)

    Parameters and fitted attributes are those of scikit-learn's GaussianMixture where they mean the same. With the
    default envelope a = 1, `degree=1` *is* its model with `covariance_type="full"` and `degree=0` with
    `covariance_type="diag"` its "diag".

    **Data larger than memory:** wherever X are rows (n, d), they may be chunks of rows: an iterable of arrays (n_i, d)
    that can be gone through again, a function that returns a fresh iterator of them, or a dask array chunked along its
    rows. `sample_weight` is then chunked likewise, or one array of n weights. Every iteration reads all chunks once
    (twice with an envelope other than "constant"), one after another; a dask array's by the workers where a
    `dask.distributed` client is active. The result is that of the rows in one array, up to rounding.

    **Parameters:**

    * `n_components`: K, or "auto": from `max_components`, those that do not pay (`criterion`) are taken away.
    * `degree`: of every component's polynomial f, or "auto": from `max_degree`, per component.
    * `covariance_type`: of Sigma_k, "full", "diag", "spherical" or "tied". Times have variances of their own always.
    * `envelope`: "constant" (a = 1), "time_likelihood" (the paper's, `TimeLikelihood(power=1, floor=1e-3)`), or any
      envelope. It is not fitted; see `gradient_fit` for that.
    * `time_column`: the column of X that is time; the last one, as in `FoldedGaussian`.
    * `tol`, `max_iter`, `n_init`, `reg_covar`, `weights_init`, `means_init`, `precisions_init`, `random_state`,
      `warm_start`, `verbose`: as in GaussianMixture. `reg_covar` is added to the variances of each Sigma_k
      and of time, in the units of X.
    * `reg_relative`: added too, this share of each column's own variance.
    * `init_params`: "kmeans", "k-means++", "random", "random_from_data", or "trajectories" (random curves grown along
      the points: for tracks that cross).
    * `annealing`: the inverse temperature that EM starts with, raised to 1 in 50 steps; 1 is none. 0.1 finds tracks
      that cross from nearly any start; round groups far apart are better off without.
    * `criterion`: "bic" or "aic", for "auto".
    * `devices`: how many of JAX's devices the points are spread over.

    **dtype:** float32 data are fitted in float32, those with degrees above 6 and all others in float64, whatever JAX is
    set to.

    **Fitted:** `weights_` (K,), `means_` (K, d) and `covariances_` (K, d, d) of whole components, columns as
    in X, `locs_` (K, d-1), `space_covariances_` (K, d-1, d-1), `time_means_`, `time_scales_` (K,), `fold_coefficients_`
    (K, q, d-1) with row j - 1 for u^j, u = m_k - t, `degrees_` (K,), `lower_bound_`, `lower_bounds_`, `n_iter_`,
    `converged_`, `status_` (`EMStatus`), `n_features_in_`.

    **Example:**

        mixture = FoldedGaussianMixture(3, degree=3, init_params="trajectories", n_init=5).fit(x)
        mixture.predict(x), mixture.score_samples(x), mixture.condition(-1, 0.5).mean

    **Source:** eq:vegas and eq:foldgauss; Dempster, Laird and Rubin 1977. **Raises:** ValueError naming the parameter.
    """

    def __init__(
        self,
        n_components="auto",
        *,
        degree="auto",
        covariance_type="full",
        envelope="constant",
        time_column=-1,
        tol=1e-3,
        reg_covar=1e-6,
        reg_relative=1e-9,
        max_iter=100,
        n_init=1,
        init_params="kmeans",
        annealing=1.0,
        weights_init=None,
        means_init=None,
        precisions_init=None,
        max_components=10,
        max_degree=3,
        criterion="bic",
        random_state=None,
        warm_start=False,
        verbose=0,
        devices=1,
    ):
        self.n_components = n_components
        self.degree = degree
        self.covariance_type = covariance_type
        self.envelope = envelope
        self.time_column = time_column
        self.tol = tol
        self.reg_covar = reg_covar
        self.reg_relative = reg_relative
        self.max_iter = max_iter
        self.n_init = n_init
        self.init_params = init_params
        self.annealing = annealing
        self.weights_init = weights_init
        self.means_init = means_init
        self.precisions_init = precisions_init
        self.max_components = max_components
        self.max_degree = max_degree
        self.criterion = criterion
        self.random_state = random_state
        self.warm_start = warm_start
        self.verbose = verbose
        self.devices = devices

    # --- fitting --------------------------------------------------------------------------------------------

    def fit(self, X, y=None, sample_weight=None):
        """Fit to rows of X (n, d); `sample_weight` (n,) counts repetitions: 2 is the point twice, 0 is not there.

        **Raises:** ValueError on bad parameters, NaN or infinity, fewer points than components, and naming the chunk
        where chunks have other columns than the first, can be read but once, or differ from one pass to the next;
        warns (ConvergenceWarning) where it did not converge, see `status_`.
        """
        self._fit(X, sample_weight)
        return self

    def fit_predict(self, X, y=None, sample_weight=None) -> Int[np.ndarray, " n"]:
        """Fit, and the likeliest component of each row, as `predict`."""
        scaled = self._fit(X, sample_weight)
        if scaled is None:
            return self.predict(X)
        with precision(scaled.dtype):
            return self._posteriors(scaled).argmax(1)

    def _fit(self, X, sample_weight):
        _check_parameters(self)
        double = (self.max_degree if self.degree == "auto" else self.degree) > _SINGLE_DEGREE
        if is_chunked(X):
            x, data = None, self._checked_chunks(X, sample_weight, double)
        else:
            x, weights = self._checked(X, sample_weight)
            if double:
                x, weights = x.astype(np.float64), weights.astype(np.float64)
            present = weights > 0  # rows without weight may hold any number
            data = _Rows(x[present], weights[present])
        with precision(data.dtype):
            run, model = self._runs(data)
        self._keep(run, model)
        if run.status != EMStatus.CONVERGED:
            warnings.warn(
                f"EM ended as {run.status.name} after {run.num_steps} iterations. {_CURES[run.status]}",
                ConvergenceWarning,
                stacklevel=3,
            )
        return None if x is None else self._scaling.apply(x)

    def _checked(self, X, sample_weight, reset: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Rows with time last, and weights, both of the dtype that is fitted in."""
        check_not_forked()
        X = validate_data(self, X, dtype=[np.float64, np.float32], ensure_min_samples=2 if reset else 1, reset=reset)
        weights = _check_sample_weight(sample_weight, X, dtype=X.dtype, ensure_non_negative=True)
        self._check_sizes(X.shape[1], int((weights > 0).sum()), weights.sum(), reset)
        return _time_last(X, self._column(X.shape[1])), weights

    def _checked_chunks(self, X, sample_weight, double: bool) -> "_ChunkedRows":
        """Chunks of rows, after a first pass through them."""
        check_not_forked()
        chunks = chunks_of(X, sample_weight)
        found, sizes = survey(chunks)
        if found.num_rows < 2:
            raise invalid("X", expected="at least 2 rows", got=found.num_rows)
        width = chunks.width
        self._check_sizes(width, found.size, found.total)
        order = _order(self._column(width), width)
        vars(self).pop("feature_names_in_", None)
        self.n_features_in_ = width
        dtype = np.dtype(np.float32 if found.single and not double else np.float64)
        return _ChunkedRows(chunks, found, sizes, order, dtype)

    def _check_sizes(self, num_columns: int, num_points: int, total: float, reset: bool = True) -> None:
        if num_columns < 2:
            cure = "One column is time; give at least one of space."
            raise invalid("X", expected="at least 2 columns", got=f"n_features = {num_columns}", cure=cure)
        if not total > 0:
            raise invalid("sample_weight", expected="a positive sum", got="0", cure="0 takes a row out.")
        least = 1 if self.n_components == "auto" or not reset else self.n_components
        if num_points < least:
            raise invalid(
                "n_components",
                expected=f"at most the number of points (n_samples = {num_points})",
                got=self.n_components,
                cure='Fewer components, or n_components="auto".',
            )

    def _column(self, num_columns: int) -> int:
        column = self.time_column
        if not isinstance(column, Integral) or isinstance(column, bool) or not -num_columns <= column < num_columns:
            raise invalid(
                "time_column", expected=f"a column of {num_columns}", got=repr(column), cure="-1 is the last."
            )
        return int(column) % num_columns

    def _runs(self, data: "_Rows | _ChunkedRows") -> tuple[Run, Model]:
        auto = "auto" in (self.n_components, self.degree)
        if auto and data.total < data.size:  # shares: what pays is decided by numbers of points
            data = data.weighted(data.size / data.total)
        mean, variance = data.variances()
        num_columns, total = len(mean), data.total
        envelope = _envelope(self.envelope)
        warm = self._warm_start(num_columns)
        if warm is None:
            scaling = scaling_of(mean, variance, envelope, self.covariance_type)
            num, degree = self._sizes(data.size)
        else:
            scaling, (num, degree) = self._scaling, warm
        data = data.scaled(scaling)
        floor = (self.reg_covar + self.reg_relative * variance) / scaling.scale**2
        degrees = used_degrees(degree if warm is None else self.degrees_, num)
        model = Model(degrees, jnp.asarray(floor, data.dtype), self.covariance_type)
        starts = self._starts(data, scaling, model, degree, warm is not None)
        points = data.points(num * len(starts.time_loc), self.devices)
        run = best(
            expectation_maximisation(
                starts,
                points,
                envelope,
                model,
                total=total,
                least_mass=0.5 * total / data.size,
                tol=self.tol,
                max_steps=self.max_iter,
                annealing=self.annealing,
                observe=_printed if self.verbose else None,
            )
        )
        if auto and warm is None and run.status != EMStatus.NOT_FINITE:
            run, model = self._pruned(run, points, envelope, model, total)
        self._scaling, self._envelope, self._floor = scaling, envelope, floor
        vars(self).pop("_online", None)  # a new fit begins anew
        self._fitted_with = self.covariance_type, self._column(num_columns)
        return run._replace(log_likelihood=run.log_likelihood - scaling.log_volume), model

    def _pruned(self, run: Run, points: Points | Blocks, envelope, model: Model, total: float) -> tuple[Run, Model]:
        params, model = pruned(
            run.params,
            points,
            envelope,
            model,
            penalty=np.log(total) if self.criterion == "bic" else 2.0,
            components=self.n_components == "auto",
            powers=self.degree == "auto",
            total=total,
            tol=self.tol,
            max_steps=self.max_iter,
        )
        params, model = compressed(params, model)
        starts = jax.tree.map(lambda z: z[None], params)
        options = {"total": total, "tol": self.tol, "max_steps": self.max_iter}
        last = expectation_maximisation(starts, points, envelope, model, **options)[0]
        return last._replace(num_steps=run.num_steps + last.num_steps, history=run.history + last.history), model

    def _sizes(self, num_points: int) -> tuple[int, int]:
        degree = self.max_degree if self.degree == "auto" else self.degree
        if self.n_components != "auto":
            return self.n_components, degree
        return max(1, min(self.max_components, num_points // _POINTS_PER_COMPONENT)), degree

    def _warm_start(self, num_columns: int) -> tuple[int, int] | None:
        """The sizes to go on with; None where there are none, or what they stand for was changed."""
        if not self.warm_start or not hasattr(self, "_params") or self._params.tril.shape[-1] + 1 != num_columns:
            return None
        same = self._fitted_with == (self.covariance_type, self._column(num_columns))
        same &= self.n_components in ("auto", len(self.weights_)) and self.degree in ("auto", self._params.degree)
        return (len(self.weights_), self._params.degree) if same else None

    def _starts(self, data, scaling: Scaling, model: Model, degree: int, warm: bool) -> Parameters:
        """Starts, a leading axis of `n_init`."""
        if warm:
            return jax.tree.map(lambda z: jnp.asarray(z, data.dtype)[None], self._params)
        rng = check_random_state(self.random_state)
        made, whole = [], None
        for _ in range(self.n_init):
            some = drawn(data.size, rng)
            if some is None and whole is None:
                whole = data.rows()
            one = start(self.init_params, *(whole if some is None else data.rows(some)), model, degree, rng)
            made.append(_of_kind(self._with_given(one, scaling, degree), self.covariance_type))
        return jax.tree.map(lambda *z: jnp.stack(z), *made)

    def _with_given(self, params: Parameters, scaling: Scaling, degree: int) -> Parameters:
        """A start with `weights_init`, `means_init` and `precisions_init` in place of what they say."""
        given = (self.weights_init, self.means_init, self.precisions_init)
        if all(z is None for z in given):
            return params
        num, dtype = len(params.time_loc), params.curve.dtype
        mixture = to_mixture(params, scaling, Constant())
        means, covariances = (np.asarray(z, np.float64) for z in mixture.components.moments())
        weights = np.exp(np.asarray(params.log_weights, np.float64))
        dim = means.shape[1]
        order = _order(self._column(dim), dim)
        if self.weights_init is not None:
            weights = _shaped("weights_init", self.weights_init, (num,))
            if not ((weights >= 0).all() and np.isclose(weights.sum(), 1)):
                raise invalid(
                    "weights_init", expected="shares with sum 1", got=weights.tolist(), cure="Divide by the sum."
                )
        if self.means_init is not None:
            means = _shaped("means_init", self.means_init, (num, dim))[:, order]
        if self.precisions_init is not None:
            covariances = _covariances(self.precisions_init, self.covariance_type, num, dim)[:, order][:, :, order]
        scale = scaling.scale
        return from_joint(
            weights, (means - scaling.shift) / scale, covariances / (scale[:, None] * scale), degree, dtype
        )

    def _keep(self, run: Run, model: Model) -> None:
        """The fitted attributes, in NumPy."""
        params = Parameters(*(np.asarray(z) for z in run.params))
        self._params = params
        with precision(params.curve.dtype):
            mixture = to_mixture(params, self._scaling, self._envelope)
            means, covariances = mixture.components.moments()
            back = np.argsort(_order(self._column(means.shape[-1]), means.shape[-1]))
            self.means_ = np.asarray(means)[:, back]
            self.covariances_ = np.asarray(covariances)[:, back][:, :, back]
            components = mixture.components
            self.locs_, tril = np.asarray(components.loc), np.asarray(components.scale_tril)
            self.time_means_, self.time_scales_ = np.asarray(components.time_loc), np.asarray(components.time_scale)
            self.fold_coefficients_ = np.asarray(components.fold.coefficients)
        self.space_covariances_ = tril @ tril.swapaxes(-1, -2)
        self.weights_ = np.exp(params.log_weights) / np.exp(params.log_weights).sum()
        self.degrees_ = np.asarray(model.used)
        self.status_, self.converged_ = run.status, run.status == EMStatus.CONVERGED
        self.n_iter_, self.lower_bound_ = run.num_steps, run.log_likelihood
        self.lower_bounds_ = [value - self._scaling.log_volume for value in run.history]

    def partial_fit(self, X, y=None, sample_weight=None):
        """Online EM: learn from one batch after another, for data larger than memory.

        The first batch is fitted by `fit` (so let it be no less than some hundred points per component), sets the
        floors, and takes the place of any fit before; each later one takes one step, weighed in by its share of all
        weight so far to the power 0.7: older batches are forgotten slowly, as they were seen with poorer components.
        `n_iter_` counts batches; `lower_bound_` is that of the last batch before its step.

        **Source:** Cappé and Moulines 2009. **Raises:** as `fit`; ValueError for an envelope other than "constant",
        whose sums do not outlive a step of time.
        """
        if is_chunked(X):
            cure = "fit takes chunks; or call partial_fit with one after another."
            raise invalid("X", expected="one batch of rows", got="chunks", cure=cure)
        if not hasattr(self, "_online"):
            if not isinstance(_envelope(self.envelope), Constant):
                cure = "Use fit, or gradient_fit.fit_gradient with batch_size."
                raise invalid("envelope", expected='"constant" for partial_fit', got=repr(self.envelope), cure=cure)
            return self._first_batch(X, sample_weight)
        _check_parameters(self)
        x, weights = self._checked(X, sample_weight, reset=False)
        sums, seen, batches, model = self._online
        with precision(self._params.curve.dtype):
            scaled = self._scaling.apply(x.astype(self._params.curve.dtype))
            points = points_of(scaled, weights.astype(scaled.dtype), len(self.weights_), self.devices)
            total, batches = float(weights.sum(dtype=np.float64)), batches + 1
            share = (total / (seen + total)) ** FORGETTING
            params = self._arrays(scaled.dtype)
            new = batch_sums(params, points)
            value = float(new.log_likelihood) / total
            params, sums = online_step(params, sums, new, model, jnp.asarray(share, scaled.dtype))
        status = EMStatus.NOT_CONVERGED if np.isfinite(value) else EMStatus.NOT_FINITE
        if status == EMStatus.NOT_FINITE:
            raise invalid("X", expected="a batch within reach of the components", got="none", cure="Shuffle the data.")
        history = [*self._history, value]
        self._keep(Run(params, value - self._scaling.log_volume, history, batches, status, 0), model)
        self._online, self._history = (sums, seen + total, batches, model), history
        return self

    def _first_batch(self, X, sample_weight):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            scaled = self.fit(X, sample_weight=sample_weight)._scaled(X).astype(self._params.curve.dtype)
        if self.status_ in (EMStatus.NOT_FINITE, EMStatus.SINGULAR):
            warnings.warn(
                f"The first batch ended as {self.status_.name}. {_CURES[self.status_]}",
                ConvergenceWarning,
                stacklevel=3,
            )
        with precision(scaled.dtype):
            weights = _check_sample_weight(sample_weight, scaled, dtype=scaled.dtype)
            points = points_of(scaled, weights, len(self.weights_), self.devices)
            sums = batch_sums(self._arrays(scaled.dtype), points)
            model = Model(jnp.asarray(self.degrees_), jnp.asarray(self._floor, scaled.dtype), self.covariance_type)
        self._online = (sums, float(weights.sum(dtype=np.float64)), 1, model)
        self._history = [self.lower_bound_ + self._scaling.log_volume]
        self.n_iter_ = 1
        return self

    # --- what is known of points ------------------------------------------------------------------------------
    # Of chunks: an iterator of one array for each, or of a dask array another one, computed when it is asked for.

    def score_samples(self, X) -> Float[np.ndarray, " n"]:
        """log p(x) of each row, in the units of X. Of chunks, an iterator of arrays; of a dask array, a dask array."""
        if is_chunked(X):
            return self._chunks(X).mapped(_log_prob, self._known())
        y = self._scaled(X)
        with precision(y.dtype):
            points = points_of(y, np.ones(len(y), y.dtype), len(self._params.time_loc))
            value = np.asarray(_scores(self._arrays(y.dtype), self._envelope, points))[: len(y)]
        return value - y.dtype.type(self._scaling.log_volume)

    def score(self, X, y=None) -> float:
        """The mean of `score_samples`; of chunks, one number for all of them."""
        return self._mean_score(X)[0]

    def predict(self, X) -> Int[np.ndarray, " n"]:
        """The likeliest component of each row. Of chunks, an iterator of arrays; of a dask array, a dask array."""
        if is_chunked(X):
            return self._chunks(X).mapped(_likeliest, self._known(), dtype=np.int64)
        return self.predict_proba(X).argmax(1)

    def predict_proba(self, X) -> Float[np.ndarray, "n k"]:
        """P(component | x) of each row. Of chunks, an iterator of arrays; of a dask array, a dask array."""
        if is_chunked(X):
            return self._chunks(X).mapped(_shares, self._known(), num_columns=len(self.weights_))
        y = self._scaled(X)
        with precision(y.dtype):
            return self._posteriors(y)

    def _posteriors(self, y):
        points = points_of(y, np.ones(len(y), y.dtype), len(self._params.time_loc))
        return np.asarray(_responsibilities(self._arrays(y.dtype), self._envelope, points))[: len(y)]

    def _mean_score(self, X) -> tuple[float, int]:
        """The mean log p(x), and the number of rows."""
        if not is_chunked(X):
            value = self.score_samples(X)
            return float(value.mean(dtype=np.float64)), len(value)
        parts = list(self._chunks(X).run(_total_log_prob, self._known()))
        num = sum(size for _, size in parts)
        if not num:
            raise invalid("X", expected="at least one chunk with rows", got="none")
        return sum(total for total, _ in parts) / num, num

    def _chunks(self, X) -> Chunks:
        check_not_forked()
        check_is_fitted(self)
        return chunks_of(X, width=self.n_features_in_)

    def _known(self) -> "_Known":
        order = _order(self._column(self.n_features_in_), self.n_features_in_)
        envelope = jax.tree.map(lambda z: np.asarray(z) if isinstance(z, jax.Array) else z, self._envelope)
        return _Known(self._params, envelope, self._scaling, order)

    def bic(self, X) -> float:
        """-2 log-likelihood + parameters log n: smaller is better."""
        mean, num = self._mean_score(X)
        return -2 * mean * num + self._n_parameters() * float(np.log(num))

    def aic(self, X) -> float:
        """-2 log-likelihood + 2 parameters: smaller is better."""
        mean, num = self._mean_score(X)
        return -2 * mean * num + 2 * self._n_parameters()

    def _n_parameters(self) -> int:
        check_is_fitted(self)
        return num_parameters(self.weights_, self.degrees_, self.locs_.shape[1], self.covariance_type)

    # --- the mixture --------------------------------------------------------------------------------------------

    def to_mixture(self) -> FoldedMixture:
        """The fitted `FoldedMixture`, **time last**; in float32 unless JAX has float64 enabled.

        Warns where its times, far from zero, then lie too far apart for how fast its components move.
        """
        check_is_fitted(self)
        dtype = jax.dtypes.canonicalize_dtype(self._params.curve.dtype)
        if dtype != self._params.curve.dtype:
            self._warn_of_coarse_times(dtype)
        params = Parameters(*(jnp.asarray(z, dtype) for z in self._params))
        return to_mixture(params, self._scaling, self._envelope)

    def _warn_of_coarse_times(self, dtype) -> None:
        step = np.spacing((np.abs(self.time_means_) + 3 * self.time_scales_).astype(dtype)).astype(np.float64)
        speed = np.abs(self.fold_coefficients_[:, :1]).sum(1) / np.sqrt(_diagonals(self.space_covariances_))
        worst = float((step * np.maximum(1 / self.time_scales_, speed.max(1))).max())
        if worst > _COARSEST:
            warnings.warn(
                f"In {np.dtype(dtype).name} times lie so far apart that a component moves or fades by {worst:.2g} of "
                "its own spread from one to the next. Subtract an offset from the time column before the fit, or "
                "enable float64: jax.config.update('jax_enable_x64', True).",
                stacklevel=3,
            )

    def sample(self, n_samples=1) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
        """(X, components): draws from the fitted mixture; deterministic for an integer `random_state`."""
        if not is_integer(n_samples, 1):
            raise invalid("n_samples", expected="a whole number >= 1", got=repr(n_samples))
        check_is_fitted(self)
        seed = check_random_state(self.random_state).randint(np.iinfo(np.int32).max)
        check_not_forked()
        with precision(self._params.curve.dtype):
            x, component = self.to_mixture().sample(jax.random.key(seed), (n_samples,), return_component=True)
            x, component = np.asarray(x), np.asarray(component)
        return x[:, np.argsort(_order(self._column(x.shape[1]), x.shape[1]))], component

    def condition(self, columns, values):
        """The mixture of the other columns, **time last**, where these have these values: `FoldedMixture.condition`.

        **Example:** `fitted.condition(-1, 0.5)  # space at time 0.5`
        """
        check_is_fitted(self)
        num = self.n_features_in_
        order = list(_order(self._column(num), num))
        columns = np.atleast_1d(np.asarray(columns))
        if columns.ndim != 1 or columns.dtype.kind not in "iu" or ((columns < -num) | (columns >= num)).any():
            raise invalid("columns", expected=f"columns of {num}", got=columns.tolist(), cure="They are those of X.")
        values = np.atleast_1d(np.asarray(values, np.float64))
        if not np.isfinite(values).all():
            raise invalid("values", expected="finite numbers", got=values.tolist())
        with precision(self._params.curve.dtype):  # the times of data far from zero do not fit into float32
            made = self.to_mixture().condition([order.index(int(c) % num) for c in columns], values)
        return jax.tree.map(lambda z: jnp.asarray(z, jax.dtypes.canonicalize_dtype(z.dtype)), made)

    def _scaled(self, X) -> np.ndarray:
        check_not_forked()
        check_is_fitted(self)
        X = validate_data(self, X, dtype=[np.float64, np.float32], reset=False)
        return self._scaling.apply(_time_last(X, self._column(X.shape[1])))

    def _arrays(self, dtype) -> Parameters:
        return Parameters(*(jnp.asarray(z, dtype) for z in self._params))


# --- rows in memory and in chunks: what a fit asks of them --------------------------------------------------------


class _Rows(NamedTuple):
    """Rows with weight, time last."""

    x: Float[np.ndarray, "n d"]
    weights: Float[np.ndarray, " n"]

    @property
    def dtype(self) -> np.dtype:
        return self.x.dtype

    @property
    def size(self) -> int:
        return len(self.weights)

    @property
    def total(self) -> float:
        return float(self.weights.sum(dtype=np.float64))

    def variances(self) -> tuple[np.ndarray, np.ndarray]:
        return variances_of(self.x, self.weights)

    def weighted(self, factor: float) -> "_Rows":
        return self._replace(weights=self.weights * self.dtype.type(factor))

    def scaled(self, scaling: Scaling) -> "_Rows":
        return self._replace(x=scaling.apply(self.x))

    def rows(self, some: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        return (self.x, self.weights) if some is None else (self.x[some], self.weights[some])

    def points(self, num_components: int, devices: int) -> Points:
        return points_of(self.x, self.weights, num_components, devices)


class _ChunkedRows(NamedTuple):
    """Chunks, and what a first pass told of them."""

    chunks: Chunks
    found: Survey
    sizes: list[int]
    order: Int[np.ndarray, " d"]
    dtype: np.dtype
    factor: float = 1.0
    scaling: Scaling | None = None

    @property
    def size(self) -> int:
        return self.found.size

    @property
    def total(self) -> float:
        return self.found.total * self.factor

    @property
    def prepare(self) -> Prepare:
        return Prepare(self.order, self.scaling, self.factor, self.dtype)

    def variances(self) -> tuple[np.ndarray, np.ndarray]:
        return self.found.mean[self.order], self.found.scatter[self.order] / self.found.total

    def weighted(self, factor: float) -> "_ChunkedRows":
        return self._replace(factor=factor)

    def scaled(self, scaling: Scaling) -> "_ChunkedRows":
        return self._replace(scaling=scaling)

    def rows(self, some: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        return picked(self.chunks, self.sizes, some, self.prepare)

    def points(self, num_components: int, devices: int) -> Blocks:
        return Blocks(self.chunks, self.prepare, self.dtype, num_components, self.sizes, devices)


class _Known(NamedTuple):
    """A fitted mixture in NumPy's arrays, for workers."""

    params: Parameters
    envelope: AbstractEnvelope
    scaling: Scaling
    order: Int[np.ndarray, " d"]


def _by_rows(function, known: _Known, x: np.ndarray) -> np.ndarray:
    """A compiled function of points for rows of X, in blocks of few shapes: chunks of any lengths share programs."""
    y = known.scaling.apply(x[:, known.order])
    num = len(known.params.time_loc)
    with precision(y.dtype):
        params = Parameters(*(jnp.asarray(z, y.dtype) for z in known.params))
        blocks = blocks_of([(y, np.ones(len(y), y.dtype))], len(y), num)
        made = [np.asarray(function(params, known.envelope, block)) for block in blocks]
    return np.concatenate(made)[: len(y)] if made else np.zeros((0, num), y.dtype)


def _log_prob(known: _Known, x: np.ndarray) -> np.ndarray:
    value = _by_rows(_scores, known, x)
    return (value if len(x) else value[:, 0]) - value.dtype.type(known.scaling.log_volume)


def _shares(known: _Known, x: np.ndarray) -> np.ndarray:
    return _by_rows(_responsibilities, known, x)


def _likeliest(known: _Known, x: np.ndarray) -> np.ndarray:
    return _shares(known, x).argmax(1)


def _total_log_prob(pieces: Iterable[Piece], known: _Known) -> tuple[float, int]:
    total, num = 0.0, 0
    for x, _ in pieces:
        total, num = total + float(_log_prob(known, x).sum(dtype=np.float64)), num + len(x)
    return total, num


# --- compiled -------------------------------------------------------------------------------------------------

_scores = eqx.filter_jit(scores)


@eqx.filter_jit
def _responsibilities(params: Parameters, envelope: AbstractEnvelope, points: Points):
    def of_chunk(x):
        log_density = pairs_of(params, envelope, x).log_density
        total = log_likelihoods(log_density)[:, None]
        reached = jnp.isfinite(total)  # out of all reach, the weights are what is known
        shares = jnp.exp(log_density - jnp.where(reached, total, 0))
        return jnp.where(reached, shares, jnp.exp(params.log_weights)[None])

    shares = lax.map(of_chunk, points.x.reshape(-1, *points.x.shape[2:]))
    return shares.reshape(-1, shares.shape[-1])


# --- columns, checks --------------------------------------------------------------------------------------------


def _order(column: int, num_columns: int) -> Int[np.ndarray, " d"]:
    """The columns of X with time last."""
    return np.append(np.delete(np.arange(num_columns), column), column)


def _time_last(X: np.ndarray, column: int) -> np.ndarray:
    return X if column == X.shape[1] - 1 else X[:, _order(column, X.shape[1])]


def _envelope(envelope) -> AbstractEnvelope:
    return _ENVELOPES[envelope]() if isinstance(envelope, str) else envelope


def _of_kind(params: Parameters, kind: str) -> Parameters:
    """A start whose covariances are of the kind that is fitted: EM's steps keep it, and rely on it."""
    tril = np.asarray(params.tril, np.float64)
    covariances, eye = tril @ tril.swapaxes(-1, -2), np.eye(tril.shape[-1])
    if kind == "full" or not np.isfinite(covariances).all():
        return params
    if kind == "tied":
        shares = np.exp(np.asarray(params.log_weights, np.float64))
        covariances = np.broadcast_to(np.einsum("k,kab->ab", shares / shares.sum(), covariances), covariances.shape)
    if kind == "diag":
        covariances = covariances * eye
    if kind == "spherical":
        covariances = np.trace(covariances, axis1=1, axis2=2)[:, None, None] / len(eye) * eye
    return params._replace(tril=jnp.asarray(np.linalg.cholesky(covariances), params.tril.dtype))


def _diagonals(matrices: Float[np.ndarray, "k d d"]) -> Float[np.ndarray, "k d"]:
    return np.diagonal(matrices, axis1=-2, axis2=-1)


def _shaped(name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    value = np.asarray(value, np.float64)
    if not np.isfinite(value).all():
        raise invalid(name, expected="finite numbers", got="NaN or infinity")
    if value.shape != shape:
        raise invalid(name, expected=f"shape {shape}", got=f"shape {value.shape}", cure="One entry per component.")
    return value


def _covariances(precisions, kind: str, num: int, dim: int) -> np.ndarray:
    """Covariances (k, d, d) from precisions in the shape that scikit-learn has for each kind."""
    shape = {"full": (num, dim, dim), "tied": (dim, dim), "diag": (num, dim), "spherical": (num,)}[kind]
    precisions = _shaped("precisions_init", precisions, shape)
    eye = np.eye(dim)
    if kind == "spherical":
        precisions = precisions[:, None, None] * eye
    if kind == "diag":
        precisions = precisions[:, :, None] * eye
    precisions = np.broadcast_to(precisions, (num, dim, dim))
    symmetric = np.allclose(precisions, precisions.swapaxes(-1, -2))
    if not (symmetric and (np.linalg.eigvalsh(precisions) > 0).all()):
        raise invalid(
            "precisions_init", expected="symmetric and positive definite", got="others", cure="Invert covariances."
        )
    return np.linalg.inv(precisions)


def _check_parameters(self) -> None:
    whole_or_auto = {"n_components": 1, "degree": 0}
    for name, least in whole_or_auto.items():
        value = getattr(self, name)
        if value != "auto" and not is_integer(value, least):
            raise invalid(name, expected=f'a whole number >= {least} or "auto"', got=repr(value))
    for name, least in {"max_components": 1, "max_degree": 0, "max_iter": 1, "n_init": 1, "devices": 1}.items():
        if not is_integer(getattr(self, name), least):
            raise invalid(name, expected=f"a whole number >= {least}", got=repr(getattr(self, name)))
    for name in ("tol", "reg_covar", "reg_relative"):
        if not is_within(getattr(self, name), "[0, inf)"):
            raise invalid(name, expected="a number >= 0", got=repr(getattr(self, name)))
    if not isinstance(self.warm_start, bool | np.bool_):
        raise invalid("warm_start", expected="True or False", got=repr(self.warm_start))
    if not isinstance(self.verbose, bool | np.bool_) and not is_integer(self.verbose, 0):
        raise invalid("verbose", expected="a whole number >= 0", got=repr(self.verbose), cure="0 says nothing.")
    if not is_within(self.annealing, "(0, 1]"):
        raise invalid("annealing", expected="a number in (0, 1]", got=repr(self.annealing), cure="1 is none.")
    check_one_of("covariance_type", self.covariance_type, _COVARIANCES)
    check_one_of("init_params", self.init_params, tuple(STARTS))
    check_one_of("criterion", self.criterion, ("bic", "aic"))
    if isinstance(self.envelope, str):
        check_one_of("envelope", self.envelope, tuple(_ENVELOPES))
    elif not isinstance(self.envelope, AbstractEnvelope):
        raise invalid("envelope", expected="an envelope or its name", got=repr(self.envelope), cure="as_envelope(f).")
    if self.devices > len(jax.devices()):
        raise invalid("devices", expected=f"at most {len(jax.devices())}", got=self.devices, cure="See jax.devices().")
    if self.n_components == "auto" and any(
        z is not None for z in (self.weights_init, self.means_init, self.precisions_init)
    ):
        raise invalid("n_components", expected="a number where starts are given", got='"auto"', cure="Give it.")


def _printed(number: int, values: np.ndarray) -> None:
    print(f"iteration {number}: mean log-likelihood {np.array2string(values, precision=6)} (scaled data)")
