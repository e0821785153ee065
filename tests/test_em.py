"""EM on arrays: its density against the distribution's, its steps against their promises, and hard data."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from foldgauss.envelope import Constant, TimeLikelihood, plain_envelope
from foldgauss.estimator.em import components, loop
from foldgauss.estimator.em.loop import EMStatus, broadcast_degrees, run_em, select_best
from foldgauss.estimator.em.m_step import (
    _MAX_STEP,
    _MIN_CURVATURE,
    Model,
    _profile_derivatives,
    newton_step,
    profile_log_likelihood,
    update_components,
)
from foldgauss.estimator.em.online import change_reference
from foldgauss.estimator.em.scaling import Scaling, to_mixture
from foldgauss.estimator.em.statistics import (
    Points,
    Times,
    _divide_by_a,
    accumulate,
    log_densities,
    make_points,
    step_times,
)

K, N, DEGREE = 3, 200, 2
NO_SCALING = Scaling(np.zeros(3), np.ones(3))
ENVELOPES = {"0": Constant(), "1": TimeLikelihood(1.0, 1e-3), "2": TimeLikelihood(2.0, 1e-2)}


def _from_mixture(mixture, scaling, degree, dtype):
    """The components of a mixture with polynomial folds of at most this degree."""
    parts = mixture.components
    space, time = scaling.scale[:-1], scaling.scale[-1]
    loc, tril, time_loc, time_scale = (
        np.asarray(z, np.float64) for z in (parts.loc, parts.scale_tril, parts.time_loc, parts.time_scale)
    )
    curve = np.zeros((len(loc), degree + 1, loc.shape[1]))
    curve[:, 0] = (loc - scaling.shift[:-1]) / space
    if hasattr(parts.fold, "coefficients"):
        rows = np.asarray(parts.fold.coefficients, np.float64)
        used = rows.shape[1]
        curve[:, 1 : used + 1] = rows * time_scale[:, None, None] ** np.arange(1, used + 1)[None, :, None] / space
    arrays = (
        np.asarray(mixture.log_weights, np.float64),
        (time_loc - scaling.shift[-1]) / time,
        time_scale / time,
        curve,
        tril / space[:, None],
    )
    return components.Parameters(*(jnp.asarray(z, dtype) for z in arrays))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _params(dtype=np.float64, seed=0):
    rng = np.random.default_rng(seed)
    tril = np.tril(rng.normal(size=(K, 2, 2)) * 0.2) + 0.6 * np.eye(2)
    parts = (
        np.log([0.2, 0.5, 0.3]),
        rng.normal(size=K),
        rng.uniform(0.5, 1.5, K),
        rng.normal(size=(K, DEGREE + 1, 2)),
        tril,
    )
    return components.Parameters(*(jnp.asarray(z, dtype) for z in parts))


def _data(seed=1):
    return np.random.default_rng(seed).normal(size=(N, 3)) * [1.0, 2.0, 1.0]


def _model(covariance="full", floor=0.0, degree=DEGREE, dtype=np.float64):
    return Model(broadcast_degrees(degree, K), jnp.full(3, floor, dtype), covariance)


densities = eqx.filter_jit(components.evaluate_densities)
SUMS = eqx.filter_jit(accumulate)


def log_density(params, envelope, x):
    return special.logsumexp(densities(params, envelope, x).log_density, axis=-1)


def _run(points, params, envelope, model, total=N, **options):
    starts = jax.tree.map(lambda z: z[None], params)
    return run_em(starts, points, envelope, model, total=total, **options)[0]


# --- oracles ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", ENVELOPES)
def test_density_matches_mixture(x64, power):
    params, x = _params(), _data()
    mixture = to_mixture(params, NO_SCALING, ENVELOPES[power])
    density = log_density(params, ENVELOPES[power], jnp.asarray(x))
    np.testing.assert_allclose(density, mixture.log_prob(jnp.asarray(x)), rtol=1e-12)
    again = _from_mixture(mixture, NO_SCALING, DEGREE, np.float64)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), again, params)


def test_density_and_gram_in_many_space_dimensions(x64):
    rng = np.random.default_rng(0)
    tril = np.tril(rng.normal(size=(2, 9, 9))) * 0.1 + np.eye(9)
    parts = (np.log([0.4, 0.6]), np.zeros(2), np.ones(2), rng.normal(size=(2, 3, 9)), tril)
    params, x = components.Parameters(*map(jnp.asarray, parts)), rng.normal(size=(5, 10))
    mixture = to_mixture(params, Scaling(np.zeros(10), np.ones(10)), Constant())
    np.testing.assert_allclose(log_density(params, Constant(), jnp.asarray(x)), mixture.log_prob(x), rtol=1e-12)
    sums, pairs = SUMS(params, Constant(), make_points(x, np.ones(5), 2)), densities(params, Constant(), jnp.asarray(x))
    shares, v = special.softmax(pairs.log_density, axis=1), np.asarray(pairs.v)
    z = np.concatenate([np.stack([np.ones_like(v), v, (v * v - 1) / np.sqrt(2)], -1), pairs.whitened[0]], -1)
    np.testing.assert_allclose(sums.gram[0], np.einsum("nk,nka,nkb->kab", shares, z, z), rtol=1e-9, atol=1e-12)


def test_gram_is_the_sum_over_pairs(x64):
    """Chunks, padding, weights: against the sum written out in NumPy."""
    params, x, weights = _params(), _data(), np.random.default_rng(2).uniform(0, 2, N)
    sums = SUMS(params, ENVELOPES["1"], make_points(x, weights, K))
    pairs = densities(params, ENVELOPES["1"], jnp.asarray(x))
    log_density = np.asarray(pairs.log_density)
    shares = weights[:, None] * np.exp(log_density - np.logaddexp.reduce(log_density, axis=1)[:, None])
    v = np.asarray(pairs.v)
    z = np.stack([np.ones_like(v), v, (v * v - 1) / np.sqrt(2), *map(np.asarray, pairs.whitened)], -1)
    np.testing.assert_allclose(sums.mass, shares.sum(0), rtol=1e-12)
    gram = np.einsum("nk,nka,nkb->kab", shares * np.exp(-np.asarray(pairs.log_a)), z, z)
    np.testing.assert_allclose(sums.gram[0], gram, rtol=1e-10, atol=1e-9)
    split = SUMS(params, ENVELOPES["1"], make_points(x, weights, 2**13))  # 16 rows a chunk
    np.testing.assert_allclose(split.gram, sums.gram, rtol=1e-10, atol=1e-9)


def test_points_are_padded_to_few_shapes():
    assert [make_points(np.zeros((n, 3)), np.ones(n), K).x.shape[:3] for n in (5, 256, 257, 600)] == [
        (1, 1, 256),
        (1, 1, 256),
        (1, 1, 512),
        (1, 1, 1024),
    ]
    many = make_points(np.zeros((3 * 2**15, 3)), np.ones(3 * 2**15), K)
    assert many.x.shape[:3] == (1, 3, 2**15)


def test_log_densities_of_points_on_two_devices(x64):
    """In the order of the rows; the arrays of both devices are on one here."""
    params, x = _params(), _data()
    one = make_points(x, np.ones(N), K)
    two = Points(*(z.reshape(2, 1, 128, *z.shape[3:]) for z in (one.x, one.weights)), N)
    expected = log_density(params, ENVELOPES["1"], one.x[0, 0])
    found = eqx.filter_jit(log_densities)(params, ENVELOPES["1"], two)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("covariance", ["full", "diag", "spherical", "tied"])
def test_floor_is_added_to_variances(x64, covariance):
    params = _params()._replace(tril=0.7 * jnp.broadcast_to(jnp.eye(2)[None], (K, 2, 2)))
    sums, degrees = SUMS(params, Constant(), make_points(_data(), np.ones(N), K)), broadcast_degrees(DEGREE, K)
    update = jax.jit(lambda floor: update_components(params, sums, Model(degrees, floor, covariance))[0])
    floor = np.array([0.1, 0.3, 0.5])
    plain, floored = update(0 * floor), update(floor)
    sigma = [one.tril @ one.tril.swapaxes(1, 2) for one in (plain, floored)]
    added = np.diag(floor[:2]) if covariance != "spherical" else 0.2 * np.eye(2)
    np.testing.assert_allclose(sigma[1] - sigma[0], np.broadcast_to(added, (K, 2, 2)), atol=1e-12)
    np.testing.assert_allclose(floored.time_scale**2 - plain.time_scale**2, 0.5)


def test_mass_divided_by_a_and_its_derivatives(x64):
    """Against JAX's own derivatives of mass / a, with log a quadratic in the steps."""
    linear, square = jnp.array([0.3, -0.7]), jnp.array([[0.4, 0.25], [0.25, -0.6]])

    def log_a(steps):
        return 0.2 + linear @ steps + 0.5 * steps @ square @ steps

    zero, mass = jnp.zeros(2), jnp.array([[0.8]])
    terms = [log_a(zero), *linear, square[0, 0], square[0, 1], square[1, 1]]
    found = _divide_by_a(mass, [jnp.reshape(term, (1, 1)) for term in terms])
    value = lambda steps: mass[0, 0] * jnp.exp(-log_a(steps))  # noqa: E731
    hessian = jax.hessian(value)(zero)
    expected = [value(zero), *jax.grad(value)(zero), hessian[0, 0], hessian[0, 1], hessian[1, 1]]
    np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-12)


def test_jitter_has_its_size_and_changes_with_every_step(x64):
    """It moves centers alone, by `_JITTER` standard deviations of the component, and differently at each step."""
    params = _params()
    state = loop.State(jax.tree.map(lambda z: z[None], params), jnp.ones((1, K)))
    shifts = [loop._jitter(state, number).params.curve[0] - params.curve for number in (1, 2)]
    for shift in shifts:
        np.testing.assert_array_equal(shift[:, 1:], 0)
        whitened = jnp.linalg.solve(params.tril, shift[:, 0, :, None])
        assert 0.2 * loop._JITTER < np.abs(whitened).max() < 4 * loop._JITTER
    assert (shifts[0][:, 0] != shifts[1][:, 0]).all()


def test_last_finite_of_a_history_without_one_is_minus_infinity():
    assert loop._last_finite([1.0, 2.0, np.nan]) == 2.0
    assert loop._last_finite([np.nan, np.inf]) == -np.inf


@pytest.mark.parametrize(
    ("stuck_mass", "rejected", "status"),
    [(0.0, 0.0, EMStatus.CONVERGED), (1.0, 0.0, EMStatus.SINGULAR), (0.0, 1e-3, EMStatus.NOT_CONVERGED)],
)
def test_end_of_a_run(x64, monkeypatch, stuck_mass, rejected, status):
    """A component without mass may be stuck; a rejected gain of `tol` is one that may still be had."""
    info = loop.Info(*(jnp.asarray(z) for z in ([1.0], [[stuck_mass, 1.0]], [[True, False]], [rejected])))
    monkeypatch.setattr(loop, "_step_restarts", lambda states, *rest: (states, info))
    observed = []
    run = _run(None, _params(), Constant(), _model(), 1.0, tol=1e-3, max_steps=4, observe=lambda *z: observed.append(z))
    assert run.status == status
    assert [number for number, _ in observed] == list(range(1, run.num_steps + 1))
    assert run.num_steps == (4 if status == EMStatus.NOT_CONVERGED else 2)


def test_each_restart_ends_for_itself(x64, monkeypatch):
    """Converged at once, not finite at the second step, and converged after some steps."""
    values = np.array([[1.0, 1.0, 0.0], [1.0, np.nan, 1.0], [5.0, 1.0, 2.0], [6.0, 1.0, 2.0]])
    numbers = iter(range(4))

    def step(states, *rest):
        info = loop.Info(values[next(numbers)], np.ones((3, K)), np.zeros((3, K), bool), np.zeros(3))
        return states, jax.tree.map(jnp.asarray, info)

    monkeypatch.setattr(loop, "_step_restarts", step)
    starts = jax.tree.map(lambda z: jnp.stack([z] * 3), _params())
    runs = run_em(starts, None, Constant(), _model(), total=1.0, tol=1e-3, max_steps=9)
    assert [run.num_steps for run in runs] == [len(run.history) for run in runs] == [2, 2, 4]
    assert [run.status for run in runs] == [EMStatus.CONVERGED, EMStatus.NOT_FINITE, EMStatus.CONVERGED]
    assert [run.log_likelihood for run in runs] == [1.0, 1.0, 2.0]


def test_temperatures_of_annealing(x64, monkeypatch):
    """From the first one to 1 in as many steps as stated, evenly in the logarithm."""
    seen = []

    def step(states, frozen, points, envelope, model, inverse_temperature):
        seen.append(inverse_temperature)
        return states, loop.Info(jnp.ones(1), jnp.ones((1, K)), jnp.zeros((1, K), bool), jnp.zeros(1))

    monkeypatch.setattr(loop, "_step_restarts", step)
    run = _run(None, _params(), Constant(), _model(), 1.0, annealing=0.5, max_steps=200)
    num = loop.ANNEALING_STEPS
    np.testing.assert_allclose(np.array(seen[:num], float), 0.5 ** (1 - np.arange(num) / num), rtol=1e-6)
    assert set(seen[num:]) == {None}
    assert run.num_steps == num + loop.SETTLING_STEPS


def test_reset_halves_the_heaviest_and_shifts_both_along_its_longest_axis(x64):
    params = _params()
    state = loop.State(jax.tree.map(lambda z: z[None], params), jnp.ones((1, K)))
    empty, mass = np.array([True, False, False]), np.array([1e9, 5.0, 3.0])
    new = jax.tree.map(lambda z: z[0], loop._reset_components(state, 0, empty, mass).params)
    np.testing.assert_allclose(np.exp(new.log_weights), [0.25, 0.25, 0.3])
    for one, old in zip(new[1:], params[1:], strict=True):
        one, old = (np.asarray(z)[:, 1:] if z is new.curve or z is params.curve else np.asarray(z) for z in (one, old))
        np.testing.assert_array_equal(one, old[[1, 1, 2]])
    np.testing.assert_allclose((new.curve[0, 0] + new.curve[1, 0]) / 2, params.curve[1, 0])
    apart, sigma = new.curve[1, 0] - new.curve[0, 0], params.tril[1] @ params.tril[1].T
    longest = np.linalg.eigvalsh(sigma).max()
    np.testing.assert_allclose(apart @ apart, longest)
    np.testing.assert_allclose(sigma @ apart, longest * apart)


@pytest.mark.parametrize("covariance", ["full", "diag", "spherical", "tied"])
def test_newton_step_matches_profile_derivatives(x64, covariance):
    """Slopes, curvatures and the step's promise, g . step, against differences of the profile_log_likelihood itself."""
    params, model = _params(), _model(covariance)
    if covariance != "full":
        params = params._replace(tril=0.7 * jnp.broadcast_to(jnp.eye(2)[None], (K, 2, 2)))
    points, envelope = make_points(_data(), np.ones(N), K), ENVELOPES["1"]

    @jax.jit
    def propose():
        here = accumulate(params, envelope, points, order=2)
        return here, newton_step(here, model, DEGREE), _profile_derivatives(here, model, DEGREE)

    here, (steps, promise), (slopes, curvatures) = propose()

    @jax.jit
    def value(moved):
        times = step_times(Times(params.time_loc, params.time_scale), moved)
        there = accumulate(params, envelope, points, times=times)
        return profile_log_likelihood(here, model, DEGREE, moved, there.gram[0], there.log_a[0])

    np.testing.assert_allclose((value(1e-5 * steps) - value(-1e-5 * steps)) / 2e-5, promise, rtol=1e-5)
    assert (np.asarray(promise) > 0).all()
    (g0, g1), (h00, h01, h11), h = slopes, curvatures, 1e-3
    for direction, slope, curvature in (([1, 0], g0, h00), ([0, 1], g1, h11), ([1, 1], g0 + g1, h00 + 2 * h01 + h11)):
        up, middle, down = (value(h * sign * np.repeat(direction, K).reshape(2, K)) for sign in (1, 0, -1))
        np.testing.assert_allclose((up - down) / (2 * h), slope, rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose((up - 2 * middle + down) / h**2, curvature, rtol=1e-4, atol=1e-3)
    # The step of each component: eigenvalues are lifted to a fraction of its mass, and it has a longest length.
    for k, mass in enumerate(here.mass):
        negative = -np.array([[h00[k], h01[k]], [h01[k], h11[k]]])
        lift = max(_MIN_CURVATURE * mass - np.linalg.eigvalsh(negative)[0], 0)
        step = np.linalg.solve(negative + lift * np.eye(2), slopes[:, k])
        step *= min(1, _MAX_STEP / np.abs(step).max())
        np.testing.assert_allclose(steps[:, k], step, rtol=1e-7)


def test_changing_the_reference_equals_recomputing(x64):
    """A linear map of the sums equals sums made there, with the same shares."""
    here, there, points = _params(), _params(seed=5), make_points(_data(), np.ones(N), K)
    shares = jnp.asarray(np.random.default_rng(3).dirichlet(np.ones(K), points.x.shape[:3]))
    made = eqx.filter_jit(lambda params: accumulate(params, Constant(), points, responsibilities=shares))
    mapped = jax.jit(change_reference)(made(here), here, there)._replace(log_likelihood=made(there).log_likelihood)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), mapped, made(there))


# --- laws ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("power", "covariance"),
    [
        ("1", "full"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("2", "full"),
                ("0", "full"),
                ("0", "tied"),
                ("1", "tied"),
                ("0", "diag"),
                ("1", "diag"),
                ("1", "spherical"),
                ("2", "tied"),
            ]
        ),
    ],
)
def test_likelihood_never_decreases(x64, power, covariance):
    params = _params()._replace(tril=jnp.broadcast_to(jnp.eye(2)[None], (K, 2, 2)))
    run = _run(make_points(_data(), np.ones(N), K), params, ENVELOPES[power], _model(covariance), tol=0, max_steps=60)
    history = np.array(run.history)
    assert len(history) == 60
    assert history[-1] > history[0] + 0.1  # it did work
    assert (np.diff(history) >= -1e-10 * np.abs(history[1:])).all()


def test_moment_updates_of_time_can_decrease_the_likelihood(x64):
    """Power check of the test above: from its end, plain moments of time go down."""
    envelope, model, points = ENVELOPES["1"], _model(), make_points(_data(), np.ones(N), K)
    params = _run(points, _params(), envelope, model, tol=1e-8, max_steps=60).params
    promise = jax.jit(lambda sums: newton_step(sums, model, DEGREE)[1])(SUMS(params, envelope, points, order=2))
    assert (promise < 1e-4).all()  # the times are where another step gains nothing

    @jax.jit
    def by_moments(params):
        sums = accumulate(params, envelope, points)
        return update_components(params, sums, model)[0], sums.log_likelihood

    params, before = by_moments(params)
    assert by_moments(params)[1] < before - 1e-3


def test_coefficients_above_the_degree_stay_zero(x64):
    degrees = np.array([0, 1, 2])
    params = _params()._replace(
        curve=_params().curve * jnp.asarray(1.0 * (np.arange(3)[None, :, None] <= degrees[:, None, None]))
    )
    run = _run(make_points(_data(), np.ones(N), K), params, ENVELOPES["1"], _model(degree=degrees), tol=0, max_steps=10)
    curve = np.asarray(run.params.curve)
    assert (curve[0, 1:] == 0).all()
    assert (curve[1, 2:] == 0).all()
    assert (curve[2] != 0).all()


def test_vectorized_restarts_equal_single_runs(x64):
    points, options = make_points(_data(), np.ones(N), K), {"total": N, "tol": 1e-6, "max_steps": 60}
    starts = [_params(seed=s) for s in (0, 1)]
    both = run_em(jax.tree.map(lambda *z: jnp.stack(z), *starts), points, Constant(), _model(), **options)
    for run, start in zip(both, starts, strict=True):
        alone = _run(points, start, Constant(), _model(), tol=1e-6, max_steps=60)
        assert run.num_steps == alone.num_steps
        np.testing.assert_allclose(run.history, alone.history, rtol=1e-9)
        assert run.history[-1] > run.history[0] + 0.1  # it did work, and never fell
        assert (np.diff(run.history) >= -1e-10 * np.abs(run.history[1:])).all()
        np.testing.assert_allclose(run.params.curve, alone.params.curve, rtol=1e-6, atol=1e-9)
    assert select_best(both).log_likelihood == max(run.log_likelihood for run in both)


def test_custom_envelope_can_be_fitted(x64):
    """A user's own envelope, equal to the built-in: the same run."""
    own = plain_envelope(lambda t, m, s: 1e-3 + (1 - 1e-3) * jnp.exp(-0.5 * ((t - m) / s) ** 2))
    points = make_points(_data(), np.ones(N), K)
    runs = [_run(points, _params(), envelope, _model(), tol=0, max_steps=10) for envelope in (own, ENVELOPES["1"])]
    np.testing.assert_allclose(runs[0].history, runs[1].history, rtol=1e-9)


# --- data that determine nothing ----------------------------------------------------------------------------


def test_empty_component_is_reset(x64):
    params = _params()
    params = params._replace(time_loc=params.time_loc.at[0].set(1e3))  # out of reach: no mass
    points, model = make_points(_data(), np.ones(N), K), _model(floor=1e-6)
    left = _run(points, params, Constant(), model, tol=1e-4, max_steps=30)
    assert np.exp(np.asarray(left.params.log_weights))[0] == 0
    assert left.num_resets == 0
    run = _run(points, params, Constant(), model, tol=1e-4, max_steps=30, least_mass=1.0)
    assert run.num_resets >= 1
    assert (np.exp(np.asarray(run.params.log_weights)) > 0.01).all()
    assert run.log_likelihood > left.log_likelihood


def test_nan_is_never_convergence(x64):
    points = make_points(_data(), np.ones(N), K)
    params = _params()
    broken = params._replace(curve=params.curve.at[0].set(jnp.nan))
    run = _run(points, broken, Constant(), _model(), tol=1e6, max_steps=30)
    assert run.status == EMStatus.NOT_FINITE
    assert select_best([run, run._replace(status=EMStatus.NOT_CONVERGED, log_likelihood=-1e9)]).log_likelihood == -1e9


def test_singular_component_sets_status(x64):
    x = np.repeat(_data()[:K], 20, axis=0)  # three points, many times
    points = make_points(x, np.ones(len(x)), K)
    params = _params()
    apart = params._replace(
        curve=params.curve * 0, time_scale=params.time_scale * 0 + 0.5, time_loc=jnp.asarray(x[::20, 2])
    )
    apart = apart._replace(curve=apart.curve.at[:, 0].set(jnp.asarray(x[::20, :2])))
    run = _run(points, apart, Constant(), _model(), total=len(x), tol=1e-3, max_steps=30)
    assert run.status == EMStatus.SINGULAR
    assert all(np.isfinite(z).all() for z in run.params)
    floored = _run(points, apart, Constant(), _model(floor=1e-4), total=len(x), max_steps=30)
    assert floored.status == EMStatus.CONVERGED
