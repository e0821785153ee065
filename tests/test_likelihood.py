"""Maximum likelihood: against NumPy's least squares, known truths, exact coverage, and data that determine nothing."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from foldgauss._numerics.regression import hermite, hermite_to_powers
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.estimator import likelihood
from foldgauss.estimator.likelihood import FitStatus, _student_quantile, bootstrap
from foldgauss.estimator.profile_likelihood import Ascent, Profile, _step
from foldgauss.fold import PolynomialFold

BEND = [[0.8, -0.5], [0.6, 0.9]]  # odd and even powers, so that each sign mistake shows
TRIL = [[0.3, 0.0], [0.1, 0.2]]
LOC, TIME_LOC, TIME_SCALE = [0.1, -0.4], 0.4, 0.3
#: The points' own envelope, where a test gives no other.
fit = functools.partial(likelihood.fit, envelope="time_likelihood")
select_degree = functools.partial(likelihood.select_degree, envelope="time_likelihood")


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _dist(power=1.0, floor=1e-3, bend=BEND):
    return FoldedGaussian(
        jnp.asarray(LOC),
        jnp.asarray(TRIL),
        time_loc=TIME_LOC,
        time_scale=TIME_SCALE,
        fold=PolynomialFold(jnp.asarray(bend)),
        envelope=TimeLikelihood(power, floor),
    )


def _points(n=60, seed=0, **changes):
    return _dist(**changes).sample(jax.random.key(seed), (n,))


def _numpy_fit(x, weights, degree, time_loc, time_scale, power, floor):
    """The book's generalised least squares, in plain powers of u."""
    x, weights = np.asarray(x, float), np.asarray(weights, float)
    s, u = x[:, :-1], time_loc - x[:, -1]
    a = floor + (1 - floor) * np.exp(-0.5 * power * (u / time_scale) ** 2)
    design, w = np.vander(u, degree + 1, increasing=True), weights / a
    beta = np.linalg.lstsq(np.sqrt(w)[:, None] * design, np.sqrt(w)[:, None] * s, rcond=None)[0]
    residual = s - design @ beta
    scatter = (w[:, None] * residual).T @ residual
    unbiased = np.diag(scatter) / (weights.sum() - degree - 1)
    inverse = np.linalg.inv(design.T @ (w[:, None] * design))
    return beta, scatter / weights.sum(), np.sqrt(np.outer(np.diag(inverse), unbiased))


# --- oracles ------------------------------------------------------------------------------------------------


def test_hermite_polynomials_convert_to_powers():
    v = np.linspace(-3, 3, 7)
    for degree in (0, 1, 2, 12):
        powers = np.vander(v, degree + 1, increasing=True) @ hermite_to_powers(degree)
        np.testing.assert_allclose(hermite(jnp.asarray(v, jnp.float32), degree), powers, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("covariance_type", ["full", "diag"])
def test_closed_form_is_generalised_least_squares(x64, covariance_type):
    x, weights = _points(), jnp.linspace(0.5, 2.0, 60)
    result = fit(x, degree=3, weights=weights, time_loc=0.35, time_scale=0.28, covariance_type=covariance_type).check()
    beta, sigma, errors = _numpy_fit(x, weights, 3, 0.35, 0.28, 1.0, 1e-3)
    sigma = np.diag(np.diag(sigma)) if covariance_type == "diag" else sigma
    dist, close = result.distribution, lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    close(dist.loc, beta[0])
    close(dist.fold.coefficients, beta[1:])
    close(dist.scale_tril @ dist.scale_tril.T, sigma)
    close(np.vstack([result.standard_errors.loc, result.standard_errors.coefficients]), errors)
    close(result.log_likelihood, (weights * dist.log_prob(x)).sum())
    assert (dist.time_loc, dist.time_scale) == (0.35, 0.28)


def test_own_estimates_of_time_are_mean_and_standard_deviation(x64):
    x, weights = _points(), jnp.linspace(0.5, 2.0, 60)
    dist = fit(x, degree=2, weights=weights).check().distribution
    mean = np.average(x[:, -1], weights=weights)
    np.testing.assert_allclose(dist.time_loc, mean, rtol=1e-14)
    scale = np.sqrt(np.average((x[:, -1] - mean) ** 2, weights=weights))
    np.testing.assert_allclose(dist.time_scale, scale, rtol=1e-14)


def test_true_parameters_are_recovered_in_float32():
    dist = fit(_points(20_000), degree=2).check().distribution
    np.testing.assert_allclose(dist.loc, LOC, atol=0.02)
    np.testing.assert_allclose(dist.fold.coefficients, BEND, atol=0.03)
    np.testing.assert_allclose(dist.scale_tril, TRIL, atol=0.01)


def test_weights_equal_repetitions_and_rows_of_weight_zero_may_be_nan(x64):
    x = _points(12)
    weights = jnp.array([1, 2, 3, 1, 2, 1, 1, 1, 4, 1, 0, 0])
    repeated = fit(jnp.asarray(np.repeat(x, weights, axis=0)), degree=1).check()
    weighted = fit(x.at[10:].set(jnp.nan), degree=1, weights=weights).check()
    for a, b in zip(jax.tree.leaves(weighted), jax.tree.leaves(repeated), strict=True):
        np.testing.assert_allclose(np.abs(a), np.abs(b), rtol=1e-10, atol=1e-12)  # a QR is unique up to signs


def test_fit_is_equivariant_to_units():
    x = _points(20_000)
    dist = fit(x, degree=2).distribution
    stretch, shift = jnp.array([1e18, 1e-12, 1e4]), jnp.array([1e18, 1e-12, 1e7])
    moved = fit(x * stretch[None] + shift[None], degree=2).check()
    # Offsets of 1e3 time scales cost 10 bits of t, no more.
    np.testing.assert_allclose((moved.distribution.loc - shift[:2]) / stretch[:2], dist.loc, atol=2e-3)
    bend = moved.distribution.fold.coefficients / stretch[None, :2] * stretch[2] ** jnp.array([[1.0], [2.0]])
    np.testing.assert_allclose(bend, dist.fold.coefficients, atol=2e-2)
    assert jnp.isfinite(moved.log_likelihood)


# --- coverage -----------------------------------------------------------------------------------------------


@eqx.filter_jit
def _covered(keys, power, floor):
    """Whether each 95% interval covers: (replicates, 3 rows of loc and coefficients, 2); and the curve's at t."""
    truth = _dist(power, floor)
    t = jnp.array([-0.2, 0.5])

    def one(key):
        x = truth.sample(key, (20,))
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

    return jax.vmap(one)(keys)


@pytest.mark.parametrize(("power", "floor"), [(1.0, 1e-3), (2.0, 0.0)])
def test_intervals_have_stated_coverage(x64, power, floor):
    # 16,000 replicates: sd of a rate 0.17%. Ten rates of a correct method leave 4.5 sd with p < 1e-4, and 1.96 instead
    # of Student's 2.11 (a rate of 93.3%) is 9 sd off.
    n = 16_000
    keys = jax.random.split(jax.random.key(0), n)
    right, mirrored, curve, status = _covered(keys, jnp.asarray(power), jnp.asarray(floor))
    assert (status == FitStatus.OK).all()
    rates = np.asarray([*right.mean(0, dtype=float).ravel(), *curve.mean(0, dtype=float).ravel()])
    assert (np.abs(rates - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / n)).all()
    # Power: u = t - time_loc instead of time_loc - t turns the odd coefficients round, and must be caught.
    assert (mirrored.mean(0)[1] < 0.5).all()


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-8), (jnp.float32, 2e-4)])
def test_half_widths_match_student_t(x64, dtype, tolerance):
    # 17 degrees of freedom matter: 1.96 instead of 2.11 would cover 93.3%.
    freedom = jnp.array([1, 2, 17, 400, 1e6, 0], dtype)
    for level in (0.5, 0.95, 0.999):
        width = _student_quantile(level, freedom)
        assert width.dtype == dtype
        np.testing.assert_allclose(width[:5], stats.t.ppf(0.5 + level / 2, freedom[:5]), rtol=tolerance)
        assert jnp.isnan(width[5])


# --- joint time ---------------------------------------------------------------------------------------------


def _profile(x, degree=2):
    s = x[:, :-1]
    weights = jnp.full(x.shape[0], 1 / x.shape[0])
    return Profile(
        x[:, -1], s - s.mean(0, keepdims=True), weights, TimeLikelihood(1.0, 1e-3), jnp.int32(degree), degree, False
    )


def test_profile_gradient_matches_finite_differences(x64):
    profile = _profile(_points())
    value = jax.jit(lambda z: profile.space(z[0], z[1]).value)
    z, step = jnp.array([0.3, 0.35]), 1e-5
    slope = [(value(z + step * e) - value(z - step * e)) / (2 * step) for e in jnp.eye(2)]
    np.testing.assert_allclose(jax.jit(jax.grad(value))(z), slope, rtol=1e-7)


def test_joint_fit_is_a_local_maximum(x64):
    x = _points(60)
    joint = fit(x, degree=2, time="joint").check()
    near = jnp.linspace(-0.3, 0.3, 13)
    loc, log_scale = (z.ravel() for z in jnp.meshgrid(near, near))
    dist = joint.distribution
    given = jax.jit(jax.vmap(lambda m, s: fit(x, degree=2, time_loc=m, time_scale=s).log_likelihood))
    values = given(dist.time_loc + dist.time_scale * loc, dist.time_scale * jnp.exp(log_scale))
    assert values.max() <= joint.log_likelihood + 1e-9
    assert int(values.argmax()) == 6 * 13 + 6
    np.testing.assert_allclose(values[6 * 13 + 6], joint.log_likelihood, rtol=1e-12)


def test_time_search_never_decreases(x64):
    profile = _profile(_points(40, seed=4))
    evaluate = jax.value_and_grad(lambda z: profile.space(z[0], jnp.exp(z[1])).value)

    @jax.jit
    def search(theta):
        start = Ascent(theta, *evaluate(theta), jnp.diag(jnp.array([0.01, 0.5])), jnp.array(1.0), jnp.int32(0))
        end, values = jax.lax.scan(lambda state, _: (_step(state, evaluate), state.value), start, length=40)
        return values, end.converged()

    values, converged = search(jnp.array([1.2, jnp.log(0.8)]))  # far off: the truth is 0.4 and 0.3
    assert (jnp.diff(values) >= 0).all()
    assert values[-1] > values[0]
    assert converged


def test_unbounded_joint_fit_raises():
    with pytest.raises(ValueError, match=r"envelope: expected a floor above 0 where power \(d-1\) > 2"):
        fit(_points(), time="joint", envelope=TimeLikelihood(2.0))


def test_a_floor_bounds_the_ridge(x64):
    # Three far times: without a floor the curve may run through them, and their likelihood has no end.
    x = jnp.concatenate([_points(40), jnp.array([[1.0, 2.0, 40.0], [0.0, 1.0, -35.0], [2.0, 0.0, 60.0]])])
    result = fit(x, degree=2, envelope=TimeLikelihood(2.0, 1e-3), time="joint")
    assert jnp.isfinite(result.log_likelihood)
    assert result.success
    assert result.message == "The fit succeeded."
    assert result.distribution.time_scale > 0.1


# --- bootstrap ----------------------------------------------------------------------------------------------


def test_bootstrap_matches_known_standard_errors(x64):
    n = 50
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
    fits = jax.jit(jax.vmap(lambda key: fit(_dist().sample(key, (80,)), degree=2, time="joint")))
    fresh = fits(jax.random.split(jax.random.key(1), 1000)).distribution
    truth = fit(_points(5000), degree=2, time="joint").check()
    again = eqx.tree_at(lambda r: r.num_points, truth, jnp.asarray(80.0))
    errors = bootstrap(again, jax.random.key(2), 1000, batch_size=200).standard_errors
    for name in ("time_loc", "time_scale", "loc"):
        np.testing.assert_allclose(errors[name], getattr(fresh, name).std(0), rtol=0.15)


def test_bootstrap_of_a_failed_fit_raises():
    failed = fit(jnp.zeros((12, 3)), degree=1)
    with pytest.raises(ValueError, match="SINGULAR_TIME"):
        bootstrap(failed, jax.random.key(0))


# --- degenerate data ----------------------------------------------------------------------------------------


def _degenerate():
    x, one = np.array(_points(12)), np.ones(12)
    t = x[:, -1]
    curve = np.stack([0.3 + t - t**2, t + 2 * t**2, t], axis=-1)
    return {
        FitStatus.OK: (x, one),
        FitStatus.NOT_FINITE: (np.where(np.arange(12)[:, None] == 3, np.nan, x), one),
        FitStatus.TOO_FEW_POINTS: (x, np.where(np.arange(12) < 4, 1.0, 0.0)),
        FitStatus.SINGULAR_TIME: (np.column_stack([x[:, :2], np.full(12, 0.7)]), one),
        FitStatus.SINGULAR_DESIGN: (np.column_stack([x[:, :2], np.arange(12) % 2]), one),
        FitStatus.SINGULAR_COVARIANCE: (curve, one),
        "collinear": (np.column_stack([x[:, 0], 2 * x[:, 0] + 1, t]), one),
    }


def test_degenerate_data_have_a_status_and_nan(x64):
    cases = _degenerate()
    x, weights = (jnp.asarray(np.stack(z)) for z in zip(*cases.values(), strict=True))
    results = jax.jit(jax.vmap(lambda x, w: fit(x, degree=2, weights=w)))(x, weights)
    expected = [FitStatus.SINGULAR_COVARIANCE if key == "collinear" else key for key in cases]
    assert [FitStatus(int(s)) for s in results.status] == expected
    assert results.success.tolist() == [status == FitStatus.OK for status in expected]
    dist = results.distribution
    for leaf in (dist.loc, dist.scale_tril, dist.time_loc, dist.fold.coefficients, results.log_likelihood):
        assert jnp.isfinite(leaf[0]).all()
        assert jnp.isnan(leaf[1:]).all()


def test_check_names_the_remedy():
    with pytest.raises(ValueError, match=r"TOO_FEW_POINTS.*Lower degree"):
        fit(jnp.zeros((1, 3)), degree=2).check()
    empty = fit(jnp.zeros((0, 3)), degree=2)
    assert int(empty.status) == FitStatus.TOO_FEW_POINTS
    assert not empty.success
    assert empty.message.startswith("TOO_FEW_POINTS: degree + d points")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"x": np.zeros(3)}, "x: expected shape"),
        ({"degree": -1}, "degree: expected a whole number"),
        ({"degree": 1.5}, "degree: expected a whole number"),
        ({"time": "later"}, "time: expected one of"),
        ({"covariance_type": "diagonal"}, "covariance_type: expected one of"),
        ({"time_loc": 0.5}, "time_loc, time_scale: expected both or none"),
        ({"weights": np.ones(3)}, "weights: expected shape"),
        ({"weights": -np.ones(5)}, "weights: expected numbers >= 0"),
        ({"envelope": "flat"}, "envelope: expected one of"),
        ({"envelope": 1.0}, "envelope: expected an envelope or one of constant, time_likelihood, got 1.0"),
    ],
)
def test_invalid_arguments_raise(options, message):
    with pytest.raises(ValueError, match=message):
        fit(**({"x": np.zeros((5, 3))} | options))


# --- the degree ---------------------------------------------------------------------------------------------


def test_the_default_envelope_is_constant(x64):
    """As that of `FoldedGaussianMixture`, and not the paper's: see `foldgauss.envelope`."""
    result = likelihood.fit(_points(), degree=1).check()
    assert isinstance(result.distribution.envelope, Constant)
    beta, _, errors = _numpy_fit(_points(), np.ones(60), 1, *_own_time(_points()), 0.0, 0.0)
    np.testing.assert_allclose(result.distribution.loc, beta[0], rtol=1e-10)
    np.testing.assert_allclose(result.standard_errors.loc, errors[0], rtol=1e-10)


def _own_time(x):
    return float(x[:, -1].mean()), float(x[:, -1].std())


@pytest.mark.slow  # it compiles for long
def test_select_degree_returns_scores_and_fit(x64):
    for criterion in ("bic", "aic", "cv"):
        choice = select_degree(_points(300), 3, criterion)
        assert choice.fit.degree == choice.degree == choice.scores.argmin()
        assert choice.scores.shape == (4,)
        if criterion != "cv":
            np.testing.assert_allclose(choice.scores[choice.degree], getattr(choice.fit, criterion), rtol=1e-12)


def _false_degree_rate(penalty, n):
    """P(a needless degree pays): its two coefficients gain n log(1 + T^2 / freedom) > penalty, T^2 Hotelling's."""
    freedom = n - 4
    hotelling = freedom * np.expm1(penalty / n)
    return stats.f.sf(hotelling * (freedom - 1) / (2 * freedom), 2, freedom - 1)


@pytest.mark.slow
def test_select_degree_finds_the_true_degree_as_often_as_it_should(x64):
    # With (time_loc, time_scale) given the law of the choice between degrees 2 (the truth) and 3 is exact.
    n, replicates = 300, 1000
    points = jax.jit(jax.vmap(lambda key: _dist().sample(key, (n,))))(jax.random.split(jax.random.key(0), replicates))
    time = {"time_loc": TIME_LOC, "time_scale": TIME_SCALE}
    chosen = {c: np.array([select_degree(x, 3, c, **time).degree for x in points]) for c in ("bic", "aic", "cv")}
    share = {c: (degree == 3).mean() for c, degree in chosen.items()}
    assert all((degree >= 2).all() for degree in chosen.values())  # a degree too few never explains these points
    # AIC: 14.0%, sd 1.1%, left by 4.5 sd with p = 7e-6. Power: one parameter too few for a degree would give 37%.
    rate = _false_degree_rate(4, n)
    assert abs(share["aic"] - rate) < 4.5 * np.sqrt(rate * (1 - rate) / replicates)
    assert _false_degree_rate(2, n) > rate + 20 * np.sqrt(rate * (1 - rate) / replicates)
    # BIC: 0.37%, 3.7 of 1000; more than 15 with p = 4e-6. Power: half its penalty would give 58 of 1000.
    assert share["bic"] <= 0.015
    assert replicates * _false_degree_rate(np.log(n), n) > 50
    # Held-out points choose as AIC does, roughly (Stone 1977): no exact law, but a score on the points fitted (which
    # never prefers the lower degree), or one that knows the truth, is far off.
    assert 0.08 < share["cv"] < 0.25


def test_cross_validation_matches_a_loop_over_folds(x64):
    x = _points(60)
    scores = select_degree(x, 1, "cv").scores
    parts, total = jax.random.permutation(jax.random.key(0), jnp.arange(len(x)) % 5), 0.0
    for part in range(5):
        trained = fit(x, degree=1, weights=jnp.where(parts == part, 0.0, 1.0)).distribution
        total -= 2 * trained.log_prob(x[parts == part]).sum()
    np.testing.assert_allclose(scores[1], total, rtol=1e-10)


def test_degree_that_cannot_be_fitted_is_not_selected():
    choice = select_degree(_points(5), 3)
    assert np.isinf(choice.scores[3])
    assert choice.degree < 3
    with pytest.raises(ValueError, match="SINGULAR_TIME"):
        select_degree(jnp.zeros((5, 3)), 3)


def test_select_degree_checks_arguments():
    with pytest.raises(ValueError, match="criterion: expected one of"):
        select_degree(_points(), 1, "dic")
    with pytest.raises(ValueError, match="degree: expected no such option"):
        select_degree(_points(), 1, degree=2)
    with pytest.raises(ValueError, match="options: expected options of fit, got envelop"):
        select_degree(_points(), 1, envelop=2)
