"""Maximum likelihood for one Folded-Gaussian: fit, standard errors, bootstrap.

Not the |X| "folded normal" of scipy and numpyro: here a Gaussian's *center* follows a curve in time.
"""

from collections.abc import Callable
from enum import IntEnum
from statistics import NormalDist
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key

from foldgauss._numerics.batch import bisect, cast, check_values
from foldgauss._numerics.regression import Regression, hermite, hermite_to_powers, weighted_regression
from foldgauss._numerics.triangular import solve_upper_matrix
from foldgauss._runtime.checks import check_one_of, invalid, is_integer, require
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import AbstractEnvelope
from foldgauss.estimator.em.scaling import check_time_resolution
from foldgauss.estimator.parameter_checks import check_real, make_envelope
from foldgauss.fold import PolynomialFold

__all__ = ["CenterParameters", "Fit", "FitStatus", "Replicates", "bootstrap", "fit"]

_LOG_2PI = 1.8378770664093453


class FitStatus(IntEnum):
    """How a fit ended. With any status but OK all parameters are NaN."""

    OK = 0
    NOT_FINITE = 1
    TOO_FEW_POINTS = 2
    SINGULAR_TIME = 3
    SINGULAR_DESIGN = 4
    SINGULAR_COVARIANCE = 5


_CURES = {
    FitStatus.NOT_FINITE: "x or weights hold NaN or infinity. Drop those rows, or give them weight 0.",
    FitStatus.TOO_FEW_POINTS: "degree + d points of positive weight are needed (degree + 2 if diagonal). Lower degree.",
    FitStatus.SINGULAR_TIME: "all times are equal, or time_scale is not positive: the fold is undetermined.",
    FitStatus.SINGULAR_DESIGN: "the times do not determine the polynomial (too few distinct ones). Lower degree.",
    FitStatus.SINGULAR_COVARIANCE: "the points lie on the curve, or a space coordinate is determined by the others. "
    "Drop it, use covariance_type='diag', or lower degree.",
}


class CenterParameters(NamedTuple):
    """A value for every parameter of the center's curve: `loc` (d-1,), `coefficients` (degree, d-1)."""

    loc: Float[Array, " d-1"]
    coefficients: Float[Array, "degree d-1"]


class Fit(eqx.Module):
    """A maximum-likelihood fit: the distribution, and the uncertainty of its center.

    **Standard errors** are those of weighted least squares *given the observed times and (time_loc, time_scale)*:

        Cov(beta_j | t) = Sigma_jj (B' W B)^-1,   W = diag(w / a(t)),   Sigma unbiased on `degrees_of_freedom`

    so `interval` (Student's t) has exact coverage for any n. The *expected* Fisher information of loc and f cannot be
    used: it is infinite for a time likelihood without a floor, as `E[1/a] = inf`, although t is ancillary and the
    information given t finite. No such formula holds for estimated `time_loc` and `time_scale` either: `1/a` weights
    the tails so heavily that a few outermost points dominate the curvature. For those, and for loc and f with the
    uncertainty of time included, use `bootstrap`.

    **Shapes:** `status`, `log_likelihood`, `num_points` (the sum of weights) are scalars, `residual_scale` (d-1,).

    **Example:** `result = fit(x, degree=2); low, high = result.interval(0.95)`

    **Source:** eq:cond_dens read as a regression.
    """

    distribution: FoldedGaussian
    log_likelihood: Float[Array, ""]
    num_points: Float[Array, ""]
    status: Int[Array, ""]
    # Cov of the Hermite coefficients of column j is residual_scale_j^2 triangle^-1 triangle^-T.
    triangle_inverse: Float[Array, "k k"]
    residual_scale: Float[Array, " d-1"]
    time_given: bool = eqx.field(static=True)
    covariance_type: str = eqx.field(static=True)

    @property
    def degree(self) -> int:
        return self.triangle_inverse.shape[-1] - 1

    @property
    def degrees_of_freedom(self) -> Float[Array, ""]:
        """Sum of weights less the coefficients per coordinate, `n - degree - 1`; errors need it positive."""
        return self.num_points - (self.degree + 1)

    @property
    def num_parameters(self) -> int:
        """Free parameters: the curve, Sigma, and time unless it was given."""
        dim = self.residual_scale.shape[-1]
        of_sigma = dim if self.covariance_type == "diag" else dim * (dim + 1) // 2
        return (self.degree + 1) * dim + of_sigma + (0 if self.time_given else 2)

    @property
    def bic(self) -> Float[Array, ""]:
        """-2 log-likelihood + parameters * log n: smaller is better."""
        return -2 * self.log_likelihood + self.num_parameters * jnp.log(self.num_points)

    @property
    def aic(self) -> Float[Array, ""]:
        """-2 log-likelihood + 2 * parameters: smaller is better."""
        return -2 * self.log_likelihood + 2 * self.num_parameters

    @property
    def standard_errors(self) -> CenterParameters:
        """Of loc and the fold's coefficients, given the times and (time_loc, time_scale)."""
        to_powers = jnp.asarray(hermite_to_powers(self.degree), self.triangle_inverse.dtype)
        length = jnp.linalg.norm(jnp.matmul(to_powers, self.triangle_inverse), axis=-1)
        errors = length[:, None] * self.residual_scale[None]
        return CenterParameters(errors[0], errors[1:] / _powers(self.distribution.time_scale, self.degree))

    def interval(self, level: float = 0.95) -> tuple[CenterParameters, CenterParameters]:
        """(lower, upper) ends of exact Student-t intervals for loc and the coefficients, each by itself."""
        quantile, errors = _student_quantile(_check_level(level), self.degrees_of_freedom), self.standard_errors
        center = CenterParameters(self.distribution.loc, self.distribution.fold.coefficients)
        lower = jax.tree.map(lambda c, e: c - quantile * e, center, errors)
        return lower, jax.tree.map(lambda c, e: c + quantile * e, center, errors)

    def center_interval(self, t: Float[Array, "*m"], level: float = 0.95) -> tuple[Array, Array]:
        """(lower, upper) for the curve loc + f(time_loc - t), exact at each t: shapes (*m, d-1)."""
        dist, t = self.distribution, jnp.asarray(t, self.residual_scale.dtype)
        rows = hermite((dist.time_loc - t) / dist.time_scale, self.degree)
        error = jnp.linalg.norm(jnp.matmul(rows, self.triangle_inverse), axis=-1)[..., None]
        half = _student_quantile(_check_level(level), self.degrees_of_freedom) * error
        half = half * lax.expand_dims(self.residual_scale, range(t.ndim))
        center = dist.condition_time(t).loc
        return center - half, center + half

    @property
    def success(self) -> Bool[Array, ""]:
        """Whether `status` is OK."""
        return self.status == FitStatus.OK

    @property
    def message(self) -> str:
        """What `status` means, and what to do about it; of a single fit, not under tracing."""
        status = FitStatus(int(self.status))
        return f"{status.name}: {_CURES[status]}" if status else "The fit succeeded."

    def check(self) -> "Fit":
        """Return this fit if its status is OK. **Raises:** ValueError with the status and a remedy."""
        if not self.success:
            got, cure = self.message.split(": ", 1)
            raise invalid("x", expected="points that determine the fit", got=got, cure=cure)
        return self


def fit(
    x: Float[ArrayLike, "n d"],
    *,
    degree: int = 1,
    envelope: AbstractEnvelope | Callable | str = "constant",
    time_loc: ArrayLike | None = None,
    time_scale: ArrayLike | None = None,
    weights: Float[ArrayLike, " n"] | None = None,
    covariance_type: str = "full",
) -> Fit:
    """Fit a Folded-Gaussian with a polynomial fold by maximum (weighted) likelihood.

        maximize sum_i w_i [ log N(s_i | loc + f(u_i), a(t_i) Sigma) + log N(t_i | time_loc, time_scale^2) ]

    Given time, `loc`, `f` and `Sigma` are weighted least squares (weights `w / a`) in closed form, by QR in
    Hermite polynomials of `u / time_scale`. The parameters of time are fixed if `time_loc` and `time_scale` are passed,
    else their marginal estimates, weighted mean and standard deviation of t. For the maximum of the joint likelihood,
    which is another one unless a = 1, fit a `FoldedGaussianMixture` of one component.

    `envelope` is "constant", "time_likelihood" (`TimeLikelihood(power=1, floor=1e-3)`), any envelope, or a
    function as in `as_envelope`. It is not fitted. Why the default is not the paper's: see `foldgauss.envelope`. A
    floor is a *modeling* choice, and kept in the fitted distribution: without one the density on the ridge is unbounded
    where `power (d-1) > 2`.

    **Shapes:** x (n, d), time last; `weights` (n,), frequency weights: 2 repeats a point, 0 leaves it out (such a row
    may hold NaN). A single fit; use `jax.vmap` for many. `covariance_type` is "full" or "diag" (the paper's).

    **dtype:** that of x. **Units:** those of x.

    **Example:** `fit(x, degree=2).check().distribution`

    **Source:** eq:foldgauss. **Raises:** ValueError on unknown options, wrong shapes, and negative weights. Problems of
    the *data* do not raise but set `Fit.status`, also under `jit` and `vmap`; see `Fit.check`.
    """
    require(is_integer(degree, 0), "degree", expected="a whole number >= 0", got=repr(degree))
    check_one_of("covariance_type", covariance_type, ("full", "diag"))
    x = _check_points(x)
    weights = _check_weights(weights, x)
    envelope = cast(make_envelope(envelope), x.dtype)
    given = _check_time(time_loc, time_scale, x.dtype)
    return _fit(x, weights, given, envelope, int(degree), covariance_type)


# --- the fit ------------------------------------------------------------------------------------------------


class _Data(NamedTuple):
    """Points centered and scaled: `s = shift + scale * y`; weights of sum 1; rows of weight 0 moved to the center."""

    t: Float[Array, " n"]
    y: Float[Array, "n d-1"]
    shift: Float[Array, " d-1"]
    scale: Float[Array, " d-1"]
    weights: Float[Array, " n"]
    total: Float[Array, ""]
    count: Int[Array, ""]
    finite: Bool[Array, ""]


class _Space(NamedTuple):
    """The maximum over space given time; `exp(2 log_unit) tril tril'` is the covariance."""

    regression: Regression
    tril: Float[Array, "d-1 d-1"]
    value: Float[Array, ""]  # log-likelihood per point
    singular: Bool[Array, ""]


@eqx.filter_jit
def _fit(x, weights, given, envelope: AbstractEnvelope, degree: int, covariance_type: str) -> Fit:
    data = _prepare_data(x, weights, degree)
    time_loc, time_scale = _estimate_time(data) if given is None else given
    singular_time = ~(time_scale > 0)
    time_scale = jnp.where(singular_time, 1, time_scale)
    space = _maximize_over_space(data, time_loc, time_scale, envelope, degree, covariance_type)
    needed = degree + (2 if covariance_type == "diag" else x.shape[1])
    status = _status(data, space, needed, singular_time)
    triangle = space.regression.triangle
    result = Fit(
        distribution=_to_distribution(data, space, time_loc, time_scale, envelope),
        log_likelihood=data.total * (space.value - jnp.log(data.scale).sum()),
        num_points=data.total,
        status=status,
        triangle_inverse=solve_upper_matrix(triangle, jnp.eye(degree + 1, dtype=triangle.dtype)),
        residual_scale=_residual_scale(data, space, degree),
        time_given=given is not None,
        covariance_type=covariance_type,
    )
    failed = status != FitStatus.OK
    return jax.tree.map(lambda leaf: jnp.where(failed, jnp.nan, leaf) if eqx.is_inexact_array(leaf) else leaf, result)


def _maximize_over_space(data: _Data, time_loc, time_scale, envelope, degree: int, covariance_type: str) -> _Space:
    """Fold, loc and Sigma by weighted least squares, and the log-likelihood there (eq:foldgauss)."""
    log_a, tau = envelope.log_a(data.t, time_loc=time_loc, time_scale=time_scale), (time_loc - data.t) / time_scale
    regression = weighted_regression(tau, data.y, log_a, data.weights, degree)
    root = jnp.where(data.weights > 0, jnp.exp(-0.5 * log_a - regression.log_unit), 0)[:, None]
    tril, singular = _factorize(root * (data.y - regression.fitted), root * data.y, data.weights, covariance_type)
    dim, mean = data.y.shape[1], lambda z: (data.weights * z).sum()
    log_det = 2 * jnp.log(jnp.where(singular, 1, jnp.diagonal(tril))).sum() + 2 * regression.log_unit * dim
    value = -0.5 * mean(tau * tau) - jnp.log(time_scale) - 0.5 * _LOG_2PI
    value = value - 0.5 * dim * (mean(log_a) + _LOG_2PI + 1) - 0.5 * log_det
    return _Space(regression, tril, value, singular)


def _factorize(residual, total, weights, covariance_type: str) -> tuple[Float[Array, "d-1 d-1"], Bool[Array, ""]]:
    """Cholesky factor of the residuals' covariance, and whether that is singular to working precision."""
    eps = jnp.finfo(residual.dtype).eps
    variance, size = ((weights[:, None] * z * z).sum(0) for z in (residual, total))
    singular = (variance <= (64 * eps) ** 2 * size).any()
    scale = jnp.sqrt(jnp.where(singular, 1, variance))
    if covariance_type == "diag":
        return jnp.diag(scale), singular
    z = jnp.sqrt(weights)[:, None] * residual / scale[None]
    tril = jnp.linalg.cholesky(jnp.matmul(z.T, z))
    return scale[:, None] * tril, singular | ~(jnp.diagonal(tril) ** 2 > 64 * eps).all()  # true for NaN pivots


def _prepare_data(x, weights, degree: int) -> _Data:
    missing = max(degree + 1 - x.shape[0], 0)  # a QR needs as many rows as columns; padding has no weight
    x, weights = jnp.pad(x, ((0, missing), (0, 0))), jnp.pad(weights, (0, missing))
    present = weights > 0
    finite = jnp.isfinite(jnp.where(present[:, None], x, 0)).all() & jnp.isfinite(weights).all()
    x = jnp.where(present[:, None] & finite, x, 0)
    total = weights.sum()
    count = present.sum(dtype=jnp.int32)
    weights = jnp.where(finite & (total > 0), weights / jnp.where(total > 0, total, 1), 0)
    shift = _mean(x, weights)
    centered = jnp.where(present[:, None], x - shift[None], 0)
    scale = jnp.abs(centered).max(0)
    scale = jnp.where(scale > 0, scale, 1)
    t = jnp.where(present, x[:, -1], shift[-1])
    return _Data(t, (centered / scale[None])[:, :-1], shift[:-1], scale[:-1], weights, total, count, finite)


def _mean(x, weights):
    first = (weights[:, None] * x).sum(0)
    return first + (weights[:, None] * (x - first[None])).sum(0)  # corrects the rounding of large offsets


def _estimate_time(data: _Data):
    loc = _mean(data.t[:, None], data.weights)[0]
    centered = jnp.where(data.weights > 0, data.t - loc, 0)
    largest = jnp.abs(centered).max()
    unit = jnp.where(largest > 0, largest, 1)
    # All times are equal if they differ by no more than the rounding of their mean.
    flat = largest <= 4 * jnp.finfo(data.t.dtype).eps * jnp.abs(data.t).max()
    scale = unit * jnp.sqrt((data.weights * (centered / unit) ** 2).sum())
    return loc, jnp.where(flat, 0, scale)


def _status(data: _Data, space: _Space, needed: int, singular_time) -> Int[Array, ""]:
    """The first problem found; later ones follow from it."""
    problems = [
        (~data.finite, FitStatus.NOT_FINITE),
        (data.count < needed, FitStatus.TOO_FEW_POINTS),
        (singular_time, FitStatus.SINGULAR_TIME),
        (space.regression.rank_deficient, FitStatus.SINGULAR_DESIGN),
        (space.singular, FitStatus.SINGULAR_COVARIANCE),
        (~jnp.isfinite(space.value), FitStatus.NOT_FINITE),
    ]
    conditions, codes = zip(*problems, strict=True)
    return jnp.select(conditions, [jnp.int32(code) for code in codes], jnp.int32(FitStatus.OK))


def _to_distribution(data: _Data, space: _Space, time_loc, time_scale, envelope) -> FoldedGaussian:
    """The maximum in the units of the points."""
    coefficients = space.regression.coefficients
    degree = len(coefficients) - 1
    powers = jnp.matmul(jnp.asarray(hermite_to_powers(degree), data.t.dtype), coefficients) * data.scale[None]
    return FoldedGaussian(
        data.shift + powers[0],
        jnp.exp(space.regression.log_unit) * space.tril * data.scale[:, None],
        time_loc=time_loc,
        time_scale=time_scale,
        fold=PolynomialFold(powers[1:] / _powers(time_scale, degree)),
        envelope=envelope,
        validate_args=False,
    )


def _residual_scale(data: _Data, space: _Space, degree: int) -> Float[Array, " d-1"]:
    """Unbiased standard deviations at a = exp(-2 log_unit), in the units of the points; NaN without freedom."""
    freedom = data.total - (degree + 1)
    unbiased = jnp.sqrt(jnp.where(freedom > 0, 1 / jnp.where(freedom > 0, freedom, 1), jnp.nan))
    return unbiased * jnp.linalg.norm(space.tril, axis=-1) * data.scale


def _powers(time_scale, degree: int) -> Float[Array, "degree 1"]:
    """time_scale^k, k = 1..degree."""
    return jnp.cumprod(jnp.broadcast_to(time_scale, (degree,)))[:, None]


def _student_quantile(level: float, freedom):
    """Half-width of the central interval of Student's t, in standard errors; NaN unless freedom > 0."""
    many = freedom > 300  # where the incomplete beta function loses digits, and the series has 9
    n = jnp.where((freedom > 0) & ~many, freedom, 1)
    # P(|T| > q) = I_x(n/2, 1/2) with x = n / (n + q^2): bisection over log q.
    tail = lambda z: jax.scipy.special.betainc(0.5 * n, 0.5 * jnp.ones_like(n), n / (n + jnp.exp(2 * z)))  # noqa: E731

    low, _ = bisect(lambda z: tail(z) > 1 - level, jnp.full_like(n, -20), jnp.full_like(n, 40), 60)
    quantile = jnp.exp(low)
    quantile = jnp.where(many, _student_series(level, jnp.where(many, freedom, 1)), quantile)
    return jnp.where(freedom > 0, quantile, jnp.nan)


def _student_series(level: float, n):
    """The same for many degrees of freedom (Abramowitz and Stegun 26.7.5)."""
    z = NormalDist().inv_cdf(0.5 + 0.5 * level)
    first, second = (z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96
    return z + (first + (second + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384 / n) / n) / n


# --- bootstrap ----------------------------------------------------------------------------------------------


class Replicates(eqx.Module):
    """Parameters refitted to samples of a fitted distribution; the leading axis is that of replicates.

    Failed replicates hold NaN (see `status`) and are excluded from the summaries.
    """

    distribution: FoldedGaussian
    status: Int[Array, " replicates"]

    @property
    def parameters(self) -> dict[str, Array]:
        """By name, each of shape (replicates, ...)."""
        dist = self.distribution
        names = ("loc", "scale_tril", "time_loc", "time_scale")
        return {name: getattr(dist, name) for name in names} | {"coefficients": dist.fold.coefficients}

    @property
    def standard_errors(self) -> dict[str, Array]:
        """Standard deviations over the replicates, by parameter name."""
        return {name: jnp.nanstd(value, axis=0, ddof=1) for name, value in self.parameters.items()}

    def interval(self, level: float = 0.95) -> tuple[dict[str, Array], dict[str, Array]]:
        """(lower, upper) percentiles over the replicates, by parameter name."""
        ends = ((1 - _check_level(level)) / 2, (1 + level) / 2)
        lower, upper = ({k: jnp.nanquantile(v, p, axis=0) for k, v in self.parameters.items()} for p in ends)
        return lower, upper


def bootstrap(result: Fit, key: Key[Array, ""], num_replicates: int = 200, *, batch_size: int = 25) -> Replicates:
    """Parametric bootstrap: repeatedly sample as many points from the fit and fit them in the same way.

    For estimated time_loc and time_scale, and for loc and f with their uncertainty included (see `Fit` on the Fisher
    information). The bootstrap assumes the model; its percentile intervals have approximate coverage.

    **Shapes:** `num_replicates` fits of `round(sum of weights)` points, `batch_size` of them at a time in memory.

    **Example:** `bootstrap(fit(x), jax.random.key(0)).standard_errors["time_loc"]`

    **Source:** Efron and Tibshirani, An Introduction to the Bootstrap, section 6.5.
    **Raises:** ValueError if the fit failed, or `num_replicates` is below 2.
    """
    require(
        is_integer(num_replicates, 2),
        "num_replicates",
        expected="a whole number >= 2",
        got=num_replicates,
        cure="200 is usual.",
    )
    result.check()
    keys, num_points = jax.random.split(key, num_replicates), max(round(float(result.num_points)), 1)
    return _bootstrap(result, keys, num_points, min(batch_size, num_replicates))


@eqx.filter_jit
def _bootstrap(result: Fit, keys, num_points: int, batch_size: int) -> Replicates:
    dist, degree = result.distribution, result.degree
    given = (dist.time_loc, dist.time_scale) if result.time_given else None
    weights = jnp.ones(num_points, dist.loc.dtype)

    def replicate(key):
        x = dist.sample(key, (num_points,))
        refit = _fit(x, weights, given, dist.envelope, degree, result.covariance_type)
        return Replicates(refit.distribution, refit.status)

    return lax.map(replicate, keys, batch_size=batch_size)


# --- checks -------------------------------------------------------------------------------------------------


def _check_points(x) -> Float[Array, "n d"]:
    check_real("x", x)
    check_time_resolution("x", x, jax.dtypes.canonicalize_dtype(getattr(x, "dtype", float)))
    x = jnp.asarray(x)
    x = x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)
    require(
        x.ndim == 2 and x.shape[1] >= 2,
        "x",
        expected="shape (n, d) with d >= 2",
        got=f"shape {x.shape}",
        cure="Rows are points, time is the last column; for many sets of points use jax.vmap.",
    )
    return x


def _check_weights(weights, x) -> Float[Array, " n"]:
    if weights is None:
        return jnp.ones(x.shape[0], x.dtype)
    weights = jnp.asarray(weights).astype(x.dtype)
    require(
        weights.shape == x.shape[:1],
        "weights",
        expected=f"shape {x.shape[:1]}",
        got=f"shape {weights.shape}",
        cure="One per row of x.",
    )
    check_values("weights", weights, lambda value: ~(value < 0), "numbers >= 0", "0 drops a row.")
    return weights


def _check_time(time_loc, time_scale, dtype):
    require(
        (time_loc is None) == (time_scale is None),
        "time_loc, time_scale",
        expected="both or none",
        got="time_loc alone" if time_scale is None else "time_scale alone",
        cure="Pass both, or none for those of the times themselves.",
    )
    return None if time_loc is None else tuple(jnp.asarray(z).astype(dtype) for z in (time_loc, time_scale))


def _check_level(level: float) -> float:
    require(0 < level < 1, "level", expected="a number between 0 and 1", got=level, cure="0.95 is usual.")
    return level
