"""Maximum likelihood: against NumPy's least squares, known truths, exact coverage, and data that determine nothing."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood
from foldgauss.estimator import likelihood
from foldgauss.estimator.likelihood import FitStatus, _student_quantile, bootstrap
from foldgauss.fold import PolynomialFold

BEND = [[0.8, -0.5], [0.6, 0.9]]  # odd and even powers, so that each sign mistake shows
TRIL = [[0.3, 0.0], [0.1, 0.2]]
LOC, TIME_LOC, TIME_SCALE = [0.1, -0.4], 0.4, 0.3
#: The points' own envelope, where a test gives no other.
fit = functools.partial(likelihood.fit, envelope="time_likelihood")


def _dist(power=1.0, floor=1e-3, bend=BEND):
    return FoldedGaussian(
        jnp.asarray(LOC),
        jnp.asarray(TRIL),
        time_loc=TIME_LOC,
        time_scale=TIME_SCALE,
        fold=PolynomialFold(jnp.asarray(bend)),
        envelope=TimeLikelihood(power, floor),
    )


def _points(n=60, seed=0, power=1.0, floor=1e-3):
    """Draws by NumPy, of the book's definition: nothing compiles. Sixty, where it does not matter: one program."""
    normal = np.random.default_rng(seed).normal(size=(n, 3))
    u = TIME_SCALE * normal[:, 2]
    center = LOC + np.stack([u, u**2], 1) @ BEND
    s = center + np.sqrt(_envelope(u, TIME_SCALE, power, floor))[:, None] * (normal[:, :2] @ np.transpose(TRIL))
    return np.column_stack([s, TIME_LOC - u])


def _envelope(u, time_scale, power, floor, xp=np):
    return floor + (1 - floor) * xp.exp(-0.5 * power * (u / time_scale) ** 2)


class NumpyFit:
    """The book's generalised least squares, in plain powers of u; by default at the times' own mean and deviation."""

    def __init__(self, x, weights, degree, time=None, envelope=(1.0, 1e-3), diagonal=False):
        weights = np.asarray(weights, float)
        mean = np.average(x[:, -1], weights=weights)
        own = mean, np.sqrt(np.average((x[:, -1] - mean) ** 2, weights=weights))
        self.degree, self.envelope, (self.time_loc, self.time_scale) = degree, envelope, own if time is None else time
        s, design, a = self._parts(x)
        w = weights / a
        self.beta = np.linalg.lstsq(np.sqrt(w)[:, None] * design, np.sqrt(w)[:, None] * s, rcond=None)[0]
        residual = s - design @ self.beta
        scatter = (w[:, None] * residual).T @ residual
        self.sigma = (np.diag(np.diag(scatter)) if diagonal else scatter) / weights.sum()
        unbiased = np.diag(scatter) / (weights.sum() - degree - 1)
        self.errors = np.sqrt(np.outer(np.diag(np.linalg.inv(design.T @ (w[:, None] * design))), unbiased))
        self.log_likelihood = weights @ self.log_prob(x)

    def _parts(self, x):
        u = self.time_loc - x[:, -1]
        return x[:, :-1], np.vander(u, self.degree + 1, increasing=True), _envelope(u, self.time_scale, *self.envelope)

    def log_prob(self, x):
        s, design, a = self._parts(x)
        unit = (s - design @ self.beta) / np.sqrt(a)[:, None]
        space = stats.multivariate_normal(cov=self.sigma).logpdf(unit) - 0.5 * s.shape[1] * np.log(a)
        return space + stats.norm.logpdf(x[:, -1], self.time_loc, self.time_scale)


# --- oracles ------------------------------------------------------------------------------------------------


def _own_envelope(t, time_loc, time_scale):
    return jnp.log(_envelope(t - time_loc, time_scale, 1.0, 1e-3, jnp))


@pytest.mark.parametrize(
    ("covariance_type", "time", "envelope"),
    [
        ("full", None, {"envelope": "time_likelihood"}),
        ("diag", (0.35, 0.28), {"envelope": "time_likelihood"}),
        ("full", None, {"envelope": _own_envelope}),
        ("full", None, {}),  # constant, and not the paper's: see `foldgauss.envelope`
    ],
)
def test_closed_form_is_generalised_least_squares(x64, covariance_type, time, envelope):
    """At times that are given, and at their weighted mean and standard deviation."""
    x, weights = _points(), np.linspace(0.5, 2.0, 60)
    given = {} if time is None else {"time_loc": time[0], "time_scale": time[1]}
    result = likelihood.fit(x, degree=2, weights=weights, covariance_type=covariance_type, **given, **envelope).check()
    shape = (1.0, 1e-3) if envelope else (0.0, 0.0)
    expected = NumpyFit(x, weights, 2, time, shape, diagonal=covariance_type == "diag")
    dist, close = result.distribution, lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    close(dist.loc, expected.beta[0])
    close(dist.fold.coefficients, expected.beta[1:])
    close(np.asarray(dist.scale_tril) @ np.asarray(dist.scale_tril).T, expected.sigma)
    close(np.vstack([result.standard_errors.loc, result.standard_errors.coefficients]), expected.errors)
    close(result.log_likelihood, expected.log_likelihood)
    free = 6 + (3 if covariance_type == "full" else 2) + (2 if time is None else 0)
    close([result.aic, result.bic], -2 * expected.log_likelihood + free * np.array([2, np.log(weights.sum())]))
    tolerance = 1e-14 if time is None else 0
    np.testing.assert_allclose(dist.time_loc, expected.time_loc, rtol=tolerance)
    np.testing.assert_allclose(dist.time_scale, expected.time_scale, rtol=tolerance)


@pytest.mark.slow
def test_bic_has_its_least_value_at_the_true_degree():
    assert min((fit(_points(300), degree=degree) for degree in range(4)), key=lambda fit: fit.bic).degree == 2


def test_weights_equal_repetitions_and_rows_of_weight_zero_may_be_nan(x64):
    x, weights = _points(), np.repeat([0, 1, 2, 3, 4], [25, 18, 12, 2, 3])  # of sum 60: one program for both
    weighted = fit(np.where(weights[:, None] > 0, x, np.nan), degree=2, weights=weights).check()
    repeated = fit(np.repeat(x, weights, axis=0), degree=2).check()
    for a, b in zip(jax.tree.leaves(weighted), jax.tree.leaves(repeated), strict=True):
        np.testing.assert_allclose(np.abs(a), np.abs(b), rtol=1e-10, atol=1e-12)  # a QR is unique up to signs


def test_fit_in_float32_recovers_the_truth_and_is_equivariant_to_units():
    x = np.float32(_points(20_000))
    dist = fit(x, degree=2).check().distribution
    np.testing.assert_allclose(dist.loc, LOC, atol=0.02)
    np.testing.assert_allclose(dist.fold.coefficients, BEND, atol=0.03)
    np.testing.assert_allclose(dist.scale_tril, TRIL, atol=0.01)
    stretch, shift = np.float32([1e18, 1e-12, 1e4]), np.float32([1e18, 1e-12, 1e7])
    moved = fit(x * stretch + shift, degree=2).check()
    # Offsets of 1e3 time scales cost 10 bits of t, no more.
    np.testing.assert_allclose((np.asarray(moved.distribution.loc) - shift[:2]) / stretch[:2], dist.loc, atol=2e-3)
    bend = np.asarray(moved.distribution.fold.coefficients) / stretch[:2] * stretch[2] ** np.array([[1], [2]])
    np.testing.assert_allclose(bend, dist.fold.coefficients, atol=2e-2)
    assert np.isfinite(moved.log_likelihood)


# --- coverage -----------------------------------------------------------------------------------------------


@eqx.filter_jit
def _covered(points, power, floor):
    """Whether each 95% interval covers: (replicates, 3 rows of loc and coefficients, 2); and the curve's at t."""
    truth = _dist(power, floor)
    t = jnp.array([-0.2, 0.5])

    def one(x):
        result = fit(x, degree=2, envelope=truth.envelope, time_loc=TIME_LOC, time_scale=TIME_SCALE)
        inside = lambda low, value, high: (low <= value) & (value <= high)  # noqa: E731
        stack = lambda p: jnp.concatenate([p.loc[None], p.coefficients])  # noqa: E731
        low, high = map(stack, result.interval(0.95))
        bend = jnp.asarray(BEND)
        loc = jnp.asarray(LOC)[None]
        right = inside(low, jnp.concatenate([loc, bend]), high)
        mirrored = inside(low, jnp.concatenate([loc, bend * jnp.array([[-1.0], [1.0]])]), high)
        low, high = result.center_interval(t)
        return right, mirrored, inside(low, truth.condition_time(t).loc, high), result.status

    return jax.vmap(one)(points)


@pytest.mark.parametrize(("power", "floor"), [(1.0, 1e-3), pytest.param(2.0, 0.0, marks=pytest.mark.slow)])
def test_intervals_have_stated_coverage(x64, power, floor):
    # 16,000 replicates: sd of a rate 0.17%. Ten rates of a correct method leave 4.5 sd with p < 1e-4, and 1.96 instead
    # of Student's 2.11 (a rate of 93.3%) is 9 sd off.
    n = 16_000
    points = _points(20 * n, power=power, floor=floor).reshape(n, 20, 3)
    right, mirrored, curve, status = map(np.asarray, _covered(points, np.asarray(power), np.asarray(floor)))
    assert (status == FitStatus.OK).all()
    rates = np.asarray([*right.mean(0, dtype=float).ravel(), *curve.mean(0, dtype=float).ravel()])
    assert (np.abs(rates - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / n)).all()
    # Power: u = t - time_loc instead of time_loc - t turns the odd coefficients round, and must be caught.
    assert (mirrored.mean(0)[1] < 0.5).all()


@pytest.mark.parametrize(
    ("dtype", "tolerance", "level"), [(np.float64, 1e-8, 0.5), (np.float64, 1e-8, 0.95), (np.float32, 2e-4, 0.999)]
)
def test_half_widths_match_student_t(x64, dtype, tolerance, level):
    # 17 degrees of freedom matter: 1.96 instead of 2.11 would cover 93.3%.
    freedom = np.array([1, 2, 17, 400, 1e6, 0], dtype)
    width = jax.jit(_student_quantile, static_argnums=0)(level, freedom)
    assert width.dtype == dtype
    np.testing.assert_allclose(width[:5], stats.t.ppf(0.5 + level / 2, freedom[:5]), rtol=tolerance)
    assert np.isnan(width[5])


# --- bootstrap ----------------------------------------------------------------------------------------------


def test_bootstrap_matches_known_standard_errors(x64):
    n = 60
    result = fit(_points(n, power=0.0), degree=1, envelope="constant").check()  # own is joint where a = 1
    replicates = bootstrap(result, jax.random.key(0), 300)
    scale = float(result.distribution.time_scale)
    errors = replicates.standard_errors
    assert (replicates.status == FitStatus.OK).all()
    # sd of a bootstrap error from 300 replicates: 4%; the formula itself is off by about 1/n.
    np.testing.assert_allclose(errors["time_loc"], scale / np.sqrt(n), rtol=0.2)
    np.testing.assert_allclose(errors["time_scale"], scale / np.sqrt(2 * n), rtol=0.2)
    lower, upper = replicates.interval(0.9)
    share = (replicates.parameters["time_loc"] >= lower["time_loc"]) & (
        replicates.parameters["time_loc"] <= upper["time_loc"]
    )
    assert 0.88 <= share.mean() <= 0.92


@pytest.mark.slow
def test_bootstrap_agrees_with_fresh_data(x64):
    fits = jax.jit(jax.vmap(lambda key: fit(_dist().sample(key, (80,)), degree=2)))
    fresh = fits(jax.random.split(jax.random.key(1), 1000)).distribution
    truth = fit(_points(5000), degree=2).check()
    again = eqx.tree_at(lambda r: r.num_points, truth, jnp.asarray(80.0))
    errors = bootstrap(again, jax.random.key(2), 1000, batch_size=200).standard_errors
    for name in ("time_loc", "time_scale", "loc"):
        np.testing.assert_allclose(errors[name], getattr(fresh, name).std(0), rtol=0.15)


@pytest.mark.parametrize("number", [-1, 1, 2.5])
def test_the_number_of_replicates_is_checked(number):
    with pytest.raises(ValueError, match=r"^num_replicates: expected a whole number >= 2, got "):
        bootstrap(None, jax.random.key(0), number)


def test_bootstrap_of_a_failed_fit_raises(x64):
    failed = fit(np.zeros((60, 3)), degree=2)
    with pytest.raises(ValueError, match="SINGULAR_TIME"):
        bootstrap(failed, jax.random.key(0))


# --- degenerate data ----------------------------------------------------------------------------------------


def _degenerate():
    x, one, row = _points(), np.ones(60), np.arange(60)
    t = x[:, -1]
    curve = np.stack([0.3 + t - t**2, t + 2 * t**2, t], axis=-1)
    return {
        FitStatus.OK: (x, one),
        FitStatus.NOT_FINITE: (np.where(row[:, None] == 3, np.nan, x), one),
        FitStatus.TOO_FEW_POINTS: (x, np.where(row < 4, 1.0, 0.0)),
        FitStatus.SINGULAR_TIME: (np.column_stack([x[:, :2], np.full(60, 0.7)]), one),
        FitStatus.SINGULAR_DESIGN: (np.column_stack([x[:, :2], row % 2]), one),
        FitStatus.SINGULAR_COVARIANCE: (curve, one),
        "collinear": (np.column_stack([x[:, 0], 2 * x[:, 0] + 1, t]), one),
    }


@pytest.mark.parametrize("case", _degenerate(), ids=str)
def test_degenerate_data_have_a_status_and_nan(x64, case):
    x, weights = _degenerate()[case]
    result = fit(x, degree=2, weights=weights)
    assert FitStatus(int(result.status)) == (FitStatus.SINGULAR_COVARIANCE if case == "collinear" else case)
    assert result.success == (case == FitStatus.OK)
    dist = result.distribution
    for leaf in (dist.loc, dist.scale_tril, dist.time_loc, dist.fold.coefficients, result.log_likelihood):
        assert np.isfinite(leaf).all() if case == FitStatus.OK else np.isnan(leaf).all()
    assert result.message == "The fit succeeded." or case != FitStatus.OK


def test_check_names_the_remedy():
    empty = fit(np.zeros((0, 3)), degree=2)
    with pytest.raises(ValueError, match=r"TOO_FEW_POINTS.*Lower degree"):
        empty.check()
    assert empty.message.startswith("TOO_FEW_POINTS: degree + d points")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"x": np.zeros(3)}, "x: expected shape"),
        ({"degree": -1}, "degree: expected a whole number"),
        ({"degree": 1.5}, "degree: expected a whole number"),
        ({"covariance_type": "diagonal"}, "covariance_type: expected one of"),
        ({"time_loc": 0.5}, "time_loc, time_scale: expected both or none"),
        ({"weights": np.ones(3)}, "weights: expected shape"),
        ({"weights": -np.ones(5)}, "weights: expected numbers >= 0"),
        ({"envelope": "flat"}, "envelope: expected one of"),
        ({"envelope": 1.0}, "envelope: expected an envelope, a function .* one of constant, time_likelihood, got 1.0"),
        ({"envelope": None}, "envelope: expected an envelope, a function .*, got None"),
        ({"envelope": lambda t, m, scale: jnp.exp(-jnp.abs(t - m))}, "^envelope: expected log a <= 0 .*plain_envelope"),
    ],
)
def test_invalid_arguments_raise(options, message):
    with pytest.raises(ValueError, match=message):
        fit(**({"x": np.zeros((5, 3))} | options))


# --- envelopes ----------------------------------------------------------------------------------------------
