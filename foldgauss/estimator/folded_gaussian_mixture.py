"""`FoldedGaussianMixture`: a mixture of Folded-Gaussians as a scikit-learn estimator.

Where scikit-learn's GaussianMixture has ellipsoids, this has tubes that bend over time; with `degree=1` it is the same
model. Needs scikit-learn: `pip install "foldgauss[sklearn]"`.
"""

import warnings
from numbers import Integral, Real

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, DensityMixin, TransformerMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data

from foldgauss._runtime.checks import is_integer, require, short_repr
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.estimator.chunks import Chunks, is_chunked, summarize_rows
from foldgauss.estimator.em.components import Parameters
from foldgauss.estimator.em.initialization import INITIALIZERS, draw_subset, initialize, restrict_covariances
from foldgauss.estimator.em.loop import EMStatus, Run, run_em, select_best
from foldgauss.estimator.em.m_step import Model
from foldgauss.estimator.em.prune import count_parameters, drop_unused, prune_mixture
from foldgauss.estimator.em.scaling import Scaling, check_export, compute_scaling, from_mixture, to_mixture
from foldgauss.estimator.em.statistics import Blocks, Points, enable_dtype
from foldgauss.estimator.parameter_checks import (
    check_column,
    check_parameters,
    check_real,
    check_sizes,
    check_start,
    make_envelope,
)
from foldgauss.estimator.prediction import evaluate_rows
from foldgauss.estimator.rows import (
    SMOOTH_ROWS,
    Rows,
    check_groups,
    choose_dtype,
    measure_gaps,
    order_columns,
    warn_narrow,
    warn_smooth,
)
from foldgauss.mixture import FoldedMixture

_CURES = {
    EMStatus.NOT_CONVERGED: "Raise max_iter or tol, or scale the data.",
    EMStatus.NOT_FINITE: "A component collapsed, or the densities of a point underflow: raise reg_covar or the "
    "envelope's floor, or lower n_components or degree.",
    EMStatus.SINGULAR: "A component's points lie on its curve, at one time, or in a plane: raise reg_covar, or lower "
    "n_components or degree.",
}
#: Distance of the times of a start from the mean of the data, in standard deviations of their times, above which it is
#: refused if all components are so far.
_FARTHEST_START = 100.0
#: With "auto", the initial number of components is at most the number of points divided by this.
_POINTS_PER_COMPONENT = 8


class FoldedGaussianMixture(ClassNamePrefixFeaturesOutMixin, TransformerMixin, DensityMixin, BaseEstimator):
    """A mixture of Folded-Gaussians, fitted by expectation maximisation.

        p(x) = sum_k w_k N(t | m_k, sigma_k^2) N(s | loc_k + f_k(m_k - t), a_k(t) Sigma_k),   x = (s, t)

    Parameters and fitted attributes have the names of scikit-learn's GaussianMixture where they mean the same. `start`
    replaces its initial values and `warm_start`. With the default envelope a = 1, `degree=1` *is* its model with
    `covariance_type="full"` and `degree=0` with `covariance_type="diag"` its "diag".

    **Data larger than memory:** in place of rows (n, d), X may be chunks of rows: an iterable of arrays (n_i, d) that
    can be iterated repeatedly (such as a list; of a dask array, `X.blocks.ravel()`). `sample_weight` is then chunked
    likewise. Every iteration reads all chunks once (twice with an envelope other than "constant"), one after another.
    Up to rounding, the result is the same as for a single array with all rows.

    **Parameters:**

    * `n_components`: K, or "auto": starting from `max_components`, components are removed while `criterion` decreases.
    * `degree`: of every component's polynomial f, or "auto": chosen per component, up to `max_degree`.
    * `covariance_type`: of Sigma_k, "full", "diag", "spherical" or "tied". Each component has its own variance of time.
    * `envelope`: "constant" (a = 1), "time_likelihood" (the paper's, `TimeLikelihood(power=1, floor=1e-3)`), any
      envelope, or a function as in `as_envelope`. It is not fitted; see `gradient_fit` for that.
    * `time_column`: the column of X that is time, an index or a data frame's name; by default the last one.
    * `tol`, `max_iter`, `n_init`, `reg_covar`, `random_state`, `verbose`: as in GaussianMixture. `reg_covar` is added
      to the variances of each Sigma_k and of time, in the units of X.
    * `start`: a `FoldedMixture` from which EM starts in place of `init_params`, time last, with polynomial folds of at
      most `degree`; its envelope is ignored. `to_mixture()` of an earlier fit continues that fit.
    * `reg_relative`: this fraction of each column's own variance is added as well.
    * `init_params`: "kmeans", "k-means++", "random", "random_from_data", or "trajectories" (random curves grown along
      the points: for crossing tracks).
    * `annealing`: the initial inverse temperature of EM, raised to 1 in 50 steps; 1 is no annealing. 0.1 separates
      crossing tracks from almost any start; well separated clusters are fitted better without.
    * `criterion`: "bic" or "aic", for "auto".
    * `devices`: the number of JAX devices that the points are distributed over.

    **dtype:** float32 data are fitted in float32, those with degrees above 6 or of units whose powers float32 does not
    hold, and all others, in float64, whatever JAX's default is.

    **Fitted:** `weights_` (K,), `means_` (K, d) and `covariances_` (K, d, d) of whole components, columns as
    in X, `locs_` (K, d-1), `space_covariances_` (K, d-1, d-1), `time_means_`, `time_scales_` (K,), `fold_coefficients_`
    (K, q, d-1) with row j - 1 for u^j, u = m_k - t, `degrees_` (K,), `lower_bound_`, `lower_bounds_`, `n_iter_`,
    `converged_`, `status_` (`EMStatus`), `n_features_in_`.

    `precisions_` (K, d, d) are the inverses of `covariances_`, and `precisions_cholesky_` (K, d, d) upper-triangular U
    with U U^T = `precisions_`: scikit-learn's for "full", whatever the `covariance_type`, as components bend.

    **Example:**

        mixture = FoldedGaussianMixture(3, degree=3, init_params="trajectories", n_init=5).fit(x)
        mixture.predict(x), mixture.score_samples(x), mixture.condition(-1, 0.5).mean

    **Source:** eq:vegas and eq:foldgauss; Dempster, Laird and Rubin 1977. **Raises:** ValueError naming the parameter.
    """

    _parameter_constraints = {  # noqa: RUF012  scikit-learn's, which checks them
        "n_components": [Interval(Integral, 1, None, closed="left"), StrOptions({"auto"})],
        "degree": [Interval(Integral, 0, None, closed="left"), StrOptions({"auto"})],
        "covariance_type": [StrOptions({"full", "diag", "spherical", "tied"})],
        "init_params": [StrOptions(set(INITIALIZERS))],
        "criterion": [StrOptions({"bic", "aic"})],
        "tol": [Interval(Real, 0, None, closed="left")],
        "reg_covar": [Interval(Real, 0, None, closed="left")],
        "reg_relative": [Interval(Real, 0, None, closed="left")],
        "annealing": [Interval(Real, 0, 1, closed="right")],
        "max_components": [Interval(Integral, 1, None, closed="left")],
        "max_degree": [Interval(Integral, 0, None, closed="left")],
        "max_iter": [Interval(Integral, 0, None, closed="left")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "devices": [Interval(Integral, 1, None, closed="left")],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

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
        start=None,
        max_components=10,
        max_degree=3,
        criterion="bic",
        random_state=None,
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
        self.start = start
        self.max_components = max_components
        self.max_degree = max_degree
        self.criterion = criterion
        self.random_state = random_state
        self.verbose = verbose
        self.devices = devices

    # --- fitting --------------------------------------------------------------------------------------------

    def fit(self, X, y=None, sample_weight=None, groups=None):
        """Fit to rows of X (n, d); `sample_weight` (n,) are frequency weights: 2 repeats a point, 0 leaves it out.

        `groups` (n,) are the independent units of dependent rows, such as the track of each row. Then the total weight
        in `criterion` is their number G, the effective sample size n / (1 + (m - 1) rho) of groups of m = n / G rows
        for correlation rho = 1 within a group: -2 G mean log p + parameters log G. To the variances is added the
        squared gap between groups: in each column, the median squared distance to the nearest row of another group. A
        narrower component would hold rows of one group only. A warning is given if components are as narrow as that.

        **Source:** Kish 1965, Survey Sampling, for the effective sample size.

        **Raises:** ValueError on invalid parameters, NaN or infinity, fewer points than components, and chunks whose
        columns differ, that can be iterated only once, or that change from one pass to the next. Warns
        (ConvergenceWarning) if EM did not converge, see `status_`.
        """
        check_parameters(self)
        data, present = self._check_rows(X, sample_weight)
        groups = check_groups(groups, present)
        if data.in_memory and groups is None and self.n_components != 1:
            warn_smooth(data.take(np.arange(min(data.summary.size, SMOOTH_ROWS)))[0])
        data = data._replace(dtype=choose_dtype(data, self.max_degree if self.degree == "auto" else self.degree))
        with enable_dtype(data.dtype):
            run, model = self._run(data, groups)
        self._set_fitted(run, model)
        if run.status != EMStatus.CONVERGED:
            warnings.warn(
                f"EM ended as {run.status.name} after {self.n_iter_} iterations. {_CURES[run.status]}",
                ConvergenceWarning,
                stacklevel=2,
            )
        return self

    def fit_predict(self, X, y=None, sample_weight=None, groups=None) -> Int[np.ndarray, " n"]:
        """Fit, and return the most likely component of each row, as `predict`."""
        return self.fit(X, y, sample_weight, groups).predict(X)

    def _check_rows(self, X, sample_weight) -> tuple[Rows, Bool[np.ndarray, " n"] | None]:
        """The rows after a first pass over them, and which of them have weight; None for chunks."""
        if chunked := is_chunked(X):
            vars(self).pop("feature_names_in_", None)
            chunks, present = Chunks(X, sample_weight), None
        else:
            check_real("X", X)
            options = {"dtype": [np.float64, np.float32], "ensure_min_samples": 2}
            X = validate_data(self, X, ensure_all_finite=sample_weight is None, **options)
            weights = _check_sample_weight(sample_weight, X, dtype=X.dtype, ensure_non_negative=True)
            chunks, present = Chunks([X], [weights]), weights > 0
        summary = summarize_rows(chunks)
        require(not chunked or summary.num_rows >= 2, "X", expected="at least 2 rows", got=summary.num_rows)
        width = chunks.width
        least = 1 if self.n_components == "auto" else self.n_components
        check_sizes(width, summary.size, summary.total, least)
        self.n_features_in_ = width
        dtype = np.dtype(np.float32 if summary.single else np.float64)
        unscaled = Scaling(np.zeros(width), np.ones(width))
        return Rows(chunks, summary, self._order_columns(width), dtype, not chunked, unscaled), present

    def _order_columns(self, num_columns: int) -> Int[np.ndarray, " d"]:
        return order_columns(self._time_index(num_columns), num_columns)

    def _time_index(self, num_columns: int) -> int:
        return check_column(self.time_column, num_columns, getattr(self, "feature_names_in_", None))

    def _run(self, data: Rows, groups: Int[np.ndarray, " n"] | None) -> tuple[Run, Model]:
        auto, size = "auto" in (self.n_components, self.degree), data.summary.size
        if groups is not None:
            data = data._replace(factor=(int(groups.max()) + 1) / data.total)
        elif auto and data.total < size:  # normalized weights: information criteria need the number of points
            data = data._replace(factor=size / data.total)
        mean, variance = data.moments()
        total, envelope = data.total, make_envelope(self.envelope)
        scaling = compute_scaling(mean, variance, envelope, self.covariance_type)
        num, degree = self._sizes(size, len(mean))
        data = data._replace(scaling=scaling)
        gaps = 0.0 if groups is None else measure_gaps(data.take()[0], groups)
        floor = (self.reg_covar + self.reg_relative * variance) / scaling.scale**2 + gaps
        model = Model(jnp.full(num, degree, jnp.int32), jnp.asarray(floor, data.dtype), self.covariance_type)
        starts = self._starts(data, model, degree)
        points = data.to_points(num * len(starts.time_loc), self.devices)
        run = select_best(
            run_em(
                starts,
                points,
                envelope,
                model,
                total=total,
                least_mass=0.5 * total / size,
                tol=self.tol,
                max_steps=self.max_iter,
                annealing=self.annealing,
                observe=_print_progress if self.verbose else None,
            )
        )
        if auto and run.status != EMStatus.NOT_FINITE:
            run, model = self._prune(run, points, envelope, model, total)
        self._scaling, self._envelope = scaling, envelope
        warn_narrow(run.params.tril, gaps)
        return run, model

    def _prune(self, run: Run, points: Points | Blocks, envelope, model: Model, total: float) -> tuple[Run, Model]:
        params, model = prune_mixture(
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
        params, model = drop_unused(params, model)
        starts = jax.tree.map(lambda z: z[None], params)
        last = run_em(starts, points, envelope, model, total=total, tol=self.tol, max_steps=self.max_iter)[0]
        return last._replace(history=run.history + last.history), model

    def _sizes(self, num_points: int, num_columns: int) -> tuple[int, int]:
        """The numbers of components and of powers to start with."""
        degree = self.max_degree if self.degree == "auto" else self.degree
        if self.start is not None:
            check_start(self.start, self.n_components, degree, num_columns)
            return self.start.num_components, degree
        if self.n_components != "auto":
            return self.n_components, degree
        return max(1, min(self.max_components, num_points // _POINTS_PER_COMPONENT)), degree

    def _starts(self, data: Rows, model: Model, degree: int) -> Parameters:
        """Initial parameters, with a leading axis of `n_init`."""
        if self.start is not None:
            start = from_mixture(self.start, data.scaling, degree, data.dtype)
            require(
                np.abs(start.time_loc).min() <= _FARTHEST_START,
                "start",
                expected="times like those of X",
                got=f"others, {short_repr(np.asarray(self.start.components.time_loc))}",
                cure="`to_mixture()` without time_origin has such times, with float64 enabled where they are large.",
            )
            return jax.tree.map(lambda z: z[None], restrict_covariances(start, self.covariance_type))
        rng = check_random_state(self.random_state)
        made, whole = [], None
        for _ in range(self.n_init):
            subset = draw_subset(data.summary.size, rng)
            if subset is None and whole is None:
                whole = data.take()
            one = initialize(self.init_params, *(whole if subset is None else data.take(subset)), model, degree, rng)
            made.append(restrict_covariances(one, self.covariance_type))
        return jax.tree.map(lambda *z: jnp.stack(z), *made)

    @property
    def precisions_cholesky_(self) -> np.ndarray:
        """Upper-triangular factors U of `precisions_` (K, d, d) = U U^T. Raises LinAlgError for a singular one."""
        check_is_fitted(self)
        inverse = np.linalg.inv(np.linalg.cholesky(self.covariances_))
        return np.tril(inverse).swapaxes(-1, -2)  # some LAPACKs leave rounding above the diagonal

    @property
    def precisions_(self) -> np.ndarray:
        """Inverses of `covariances_`, (K, d, d). Raises LinAlgError for a singular one."""
        factor = self.precisions_cholesky_
        return factor @ factor.swapaxes(-1, -2)

    def _set_fitted(self, run: Run, model: Model) -> None:
        """Set the fitted attributes, in NumPy."""
        params = Parameters(*(np.asarray(z) for z in run.params))
        self._params = params
        with enable_dtype(params.curve.dtype):
            unscaled = Scaling(np.zeros(len(self._scaling.scale)), np.ones(len(self._scaling.scale)))
            self._scaled = jax.tree.map(np.asarray, to_mixture(params, unscaled, self._envelope))
            mixture = to_mixture(params, self._scaling, self._envelope)
            means, covariances = mixture.components.moments()
            order = self._order_columns(means.shape[-1])
            back = np.argsort(order)
            self.means_ = np.asarray(means)[:, back]
            self.covariances_ = np.asarray(covariances)[:, back][:, :, back]
            components = mixture.components
            self.locs_, tril = np.asarray(components.loc), np.asarray(components.scale_tril)
            self.time_means_, self.time_scales_ = np.asarray(components.time_loc), np.asarray(components.time_scale)
            self.fold_coefficients_ = np.asarray(components.fold.coefficients)
        self.space_covariances_ = tril @ tril.swapaxes(-1, -2)
        self.weights_ = np.exp(params.log_weights) / np.exp(params.log_weights).sum()
        self.degrees_ = np.asarray(model.degrees)
        self.status_, self.converged_ = run.status, run.status == EMStatus.CONVERGED
        self.n_iter_, self.lower_bound_ = len(run.history), run.log_likelihood - self._scaling.log_volume
        self.lower_bounds_ = [value - self._scaling.log_volume for value in run.history]

    # --- prediction: for chunks an iterator of arrays -----------------------------------------------------------

    def score_samples(self, X) -> Float[np.ndarray, " n"]:
        """log p(x) of each row, in the units of X; an iterator of arrays for chunks."""

        def log_prob(x):
            value = self._call(FoldedMixture.log_prob, x)
            return value - value.dtype.type(self._scaling.log_volume)

        return self._map_rows(log_prob, X)

    def score(self, X, y=None) -> float:
        """The mean of `score_samples`, over all chunks."""
        return self._mean_score(X)[0]

    def predict(self, X) -> Int[np.ndarray, " n"]:
        """The most likely component of each row; an iterator of arrays for chunks."""
        return self._map_rows(lambda x: self._call(FoldedMixture.responsibilities, x).argmax(1), X)

    def predict_proba(self, X) -> Float[np.ndarray, "n k"]:
        """P(component | x) of each row; an iterator of arrays for chunks."""
        return self._map_rows(lambda x: self._call(FoldedMixture.responsibilities, x), X)

    def transform(self, X) -> Float[np.ndarray, "n k"]:
        """`predict_proba` of rows, as features named foldedgaussianmixture0, ... in the container of `set_output`."""
        require(not is_chunked(X), "X", expected="rows", got="chunks", cure="predict_proba takes chunks.")
        return self.predict_proba(X)

    @property
    def _n_features_out(self) -> int:
        return len(self.weights_)

    def _call(self, method, x: np.ndarray) -> np.ndarray:
        """Call a method of the fitted mixture at rows of X, which are scaled first."""
        ordered = x[:, self._order_columns(x.shape[1])].astype(np.result_type(x, self._scaled.logits))
        return evaluate_rows(method, self._scaled, self._scaling.apply(ordered))

    def _map_rows(self, function, X):
        """Apply a function to the rows, or to each chunk."""
        check_is_fitted(self)
        if is_chunked(X):
            return Chunks(X, width=self.n_features_in_).map(function)
        check_real("X", X)
        return function(validate_data(self, X, dtype=[np.float64, np.float32], reset=False))

    def _mean_score(self, X, groups=None) -> tuple[float, int]:
        """The mean log p(x), and the number of rows, or of groups."""
        values = self.score_samples(X)
        parts = [values] if hasattr(values, "shape") else values
        sums = np.array([(float(part.sum(dtype=np.float64)), len(part)) for part in parts]).reshape(-1, 2)
        total, num = sums.sum(0)
        require(num, "X", expected="at least one chunk with rows", got="none")
        which = check_groups(groups, None if is_chunked(X) else np.ones(int(num), bool))
        return float(total / num), int(num) if which is None else int(which.max()) + 1

    def bic(self, X, groups=None) -> float:
        """-2 log-likelihood + parameters log n: smaller is better. `groups` as in `fit`: n is their number."""
        mean, num = self._mean_score(X, groups)
        return -2 * mean * num + self._n_parameters() * float(np.log(num))

    def aic(self, X, groups=None) -> float:
        """-2 log-likelihood + 2 parameters: smaller is better. `groups` as in `fit`: their number replaces n."""
        mean, num = self._mean_score(X, groups)
        return -2 * mean * num + 2 * self._n_parameters()

    def _n_parameters(self) -> int:
        check_is_fitted(self)
        return count_parameters(self.weights_, self.degrees_, self.locs_.shape[1], self.covariance_type)

    # --- the mixture --------------------------------------------------------------------------------------------

    def to_mixture(self, time_origin: float = 0.0) -> FoldedMixture:
        """The fitted `FoldedMixture`, **time last**; in float32 unless JAX has float64 enabled.

        Its times are those of X less `time_origin`, as Unix times require in float32.

        **Raises:** ValueError if times in that dtype are too coarse for how fast the components move, or their powers
        out of its range.
        """
        check_is_fitted(self)
        require(
            time_origin == 0 or isinstance(self._envelope, Constant | TimeLikelihood),
            "time_origin",
            expected="0 with a function as envelope",
            got=time_origin,
        )
        dtype = jax.dtypes.canonicalize_dtype(self._params.curve.dtype)
        if dtype != self._params.curve.dtype:
            check_export(self._params, self._scaling, dtype, time_origin)
        params = Parameters(*(jnp.asarray(z, dtype) for z in self._params))
        return to_mixture(params, self._scaling, self._envelope, time_origin)

    def sample(self, n_samples=1) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
        """(X, components): draws from the fitted mixture; deterministic for an integer `random_state`."""
        require(is_integer(n_samples, 1), "n_samples", expected="a whole number >= 1", got=repr(n_samples))
        check_is_fitted(self)
        seed = check_random_state(self.random_state).randint(np.iinfo(np.int32).max)
        with enable_dtype(self._params.curve.dtype):
            x, component = self.to_mixture().sample(jax.random.key(seed), (n_samples,), return_component=True)
            x, component = np.asarray(x), np.asarray(component)
        return x[:, np.argsort(self._order_columns(x.shape[1]))], component

    def condition(self, columns, values):
        """The mixture of the other columns, **time last**, given values of these: `FoldedMixture.condition`.

        Columns are indices, or names if the fit was to a data frame.

        **Example:** `fitted.condition(-1, 0.5)  # space at time 0.5`

        **Raises:** ValueError as `to_mixture` if time is not given, and is too coarse in the dtype of the result.
        """
        check_is_fitted(self)
        num, names = self.n_features_in_, getattr(self, "feature_names_in_", None)
        columns = [columns] if isinstance(columns, str) or np.ndim(columns) == 0 else columns
        columns = [check_column(column, num, names, "columns") for column in columns]
        if self._time_index(num) not in columns:
            check_export(self._params, self._scaling, jax.dtypes.canonicalize_dtype(self._params.curve.dtype), None)
        order = self._order_columns(num).tolist()
        values = np.atleast_1d(np.asarray(values, np.float64))
        require(np.isfinite(values).all(), "values", expected="finite numbers", got=values.tolist())
        with enable_dtype(self._params.curve.dtype):  # times far from zero need float64
            mixture = self.to_mixture().condition([order.index(column) for column in columns], values)
        return jax.tree.map(lambda z: jnp.asarray(z, jax.dtypes.canonicalize_dtype(z.dtype)), mixture)


def _print_progress(number: int, values: np.ndarray) -> None:
    print(f"iteration {number}: mean log-likelihood {np.array2string(values, precision=6)} (scaled data)")
