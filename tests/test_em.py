"""EM on arrays: its density against the distribution's, its steps against their promises, and hard data."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from foldgauss.envelope import Constant, TimeLikelihood, plain_envelope
from foldgauss.estimator.em import components, loop, statistics
from foldgauss.estimator.em.loop import EMStatus, run_em, select_best
from foldgauss.estimator.em.m_step import (
    _MAX_STEP,
    _MIN_CURVATURE,
    Model,
    newton_step,
    profile_log_likelihood,
    update_components,
)
from foldgauss.estimator.em.scaling import Scaling, to_mixture
from foldgauss.estimator.em.statistics import (
    Times,
    accumulate,
    make_points,
    step_times,
)

K, N, DEGREE = 3, 200, 2
ENVELOPES = {"0": Constant(), "1": TimeLikelihood(1.0, 1e-3), "2": TimeLikelihood(2.0, 1e-2)}


def _params(seed=0, dim=2):
    rng = np.random.default_rng(seed)
    tril = np.tril(rng.normal(size=(K, dim, dim)) * 0.2) + 0.6 * np.eye(dim)
    parts = (
        np.log([0.2, 0.5, 0.3]),
        rng.normal(size=K),
        rng.uniform(0.5, 1.5, K),
        rng.normal(size=(K, DEGREE + 1, dim)),
        tril,
    )
    return components.Parameters(*map(jnp.asarray, parts))


def _data(dim=2):
    return np.random.default_rng(1).normal(size=(N, dim + 1)) * np.append(np.arange(dim) + 1.0, 1.0)


def _model(covariance="full", floor=0.0, degree=DEGREE):
    return Model(jnp.broadcast_to(jnp.asarray(degree, jnp.int32), (K,)), jnp.full(3, floor), covariance)


densities = eqx.filter_jit(components.evaluate_densities)
# The sums are the same for all kinds of covariances: they are compiled once.
SUMS = eqx.filter_jit(accumulate)
STEPPED = jax.jit(step_times)
PROFILE = jax.jit(profile_log_likelihood, static_argnums=2)


def log_density(params, envelope, x):
    return special.logsumexp(densities(params, envelope, x).log_density, axis=-1)


def _run(points, params, envelope, model, total=N, **options):
    starts = jax.tree.map(lambda z: z[None], params)
    return run_em(starts, points, envelope, model, total=total, **options)[0]


# --- oracles ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("power", "dim"), [*((power, 2) for power in ENVELOPES), ("0", 9)])
def test_density_matches_mixture(x64, power, dim):
    params, x = _params(dim=dim), _data(dim)
    mixture = to_mixture(params, Scaling(np.zeros(dim + 1), np.ones(dim + 1)), ENVELOPES[power])
    density = log_density(params, ENVELOPES[power], jnp.asarray(x))
    np.testing.assert_allclose(density, mixture.log_prob(jnp.asarray(x)), rtol=1e-12)


@pytest.mark.parametrize("dim", [2, 9])
def test_gram_is_the_sum_over_pairs(x64, dim):
    """Chunks, padding, weights: against the sum written out in NumPy."""
    params, x, weights = _params(dim=dim), _data(dim=dim), np.random.default_rng(2).uniform(0, 2, N)
    sums = SUMS(params, ENVELOPES["1"], make_points(x, weights, K))
    pairs = densities(params, ENVELOPES["1"], jnp.asarray(x))
    shares = weights[:, None] * special.softmax(pairs.log_density, axis=1)
    v = np.asarray(pairs.v)
    hermite = np.stack([np.ones_like(v), v, (v * v - 1) / np.sqrt(2)], -1)
    z = np.concatenate([hermite, np.stack(pairs.whitened, -1).reshape(N, K, dim)], -1)
    np.testing.assert_allclose(sums.mass, shares.sum(0), rtol=1e-12)
    assert len(sums.gram) == 1  # without derivatives
    gram = np.einsum("nk,nka,nkb->kab", shares * np.exp(-np.asarray(pairs.log_a)), z, z)
    np.testing.assert_allclose(sums.gram[0], gram, rtol=1e-10, atol=1e-9)
    split = SUMS(params, ENVELOPES["1"], make_points(x, weights, 2**13))  # 16 rows a chunk
    np.testing.assert_allclose(split.gram, sums.gram, rtol=1e-10, atol=1e-9)


def test_a_point_of_weight_zero_adds_nothing_however_far(x64):
    far, weights = _data(), np.append(np.ones(N - 1), 0.0)
    far[-1, 0] = 1e200  # its density is 0, whose logarithm is infinite
    sums = [SUMS(_params(), Constant(), make_points(x, weights, K)) for x in (far, _data())]
    jax.tree.map(np.testing.assert_array_equal, *sums)


@pytest.mark.parametrize("devices", [1, 3])
def test_pieces_of_any_lengths_fill_one_block_where_they_fit(monkeypatch, devices):
    monkeypatch.setattr(statistics, "make_points", lambda x, weights, *rest: (x, weights, rest[-1]))
    x, weights = np.arange(4096.0)[:, None], np.arange(4096.0)
    pieces = [(x[a:b], weights[a:b]) for a, b in ((0, 5), (5, 5), (5, 3000), (3000, 4096))]
    ((whole, same, size),) = statistics.make_blocks(pieces, 4096, K, devices)
    np.testing.assert_array_equal(whole, x)
    np.testing.assert_array_equal(same, weights)
    assert 4096 <= size < 2 * 4096


@pytest.mark.parametrize(("dtype", "expected"), [(np.float64, np.float64), (np.float32, np.float32)])
def test_only_float64_changes_the_users_setting(dtype, expected):
    with statistics.enable_dtype(dtype):
        assert jnp.ones(()).dtype == expected


@pytest.mark.parametrize("covariance", ["full", "diag", "spherical", "tied"])
def test_floor_is_added_to_variances(x64, covariance):
    params = _params()._replace(tril=0.7 * jnp.broadcast_to(jnp.eye(2)[None], (K, 2, 2)))
    sums, degrees = SUMS(params, Constant(), make_points(_data(), np.ones(N), K)), _model().degrees
    update = jax.jit(lambda floor: update_components(params, sums, Model(degrees, floor, covariance))[0])
    floor = np.array([0.1, 0.3, 0.5])
    plain, floored = update(0 * floor), update(floor)
    sigma = [one.tril @ one.tril.swapaxes(1, 2) for one in (plain, floored)]
    added = np.diag(floor[:2]) if covariance != "spherical" else 0.2 * np.eye(2)
    np.testing.assert_allclose(sigma[1] - sigma[0], np.broadcast_to(added, (K, 2, 2)), atol=1e-12)
    np.testing.assert_allclose(floored.time_scale**2 - plain.time_scale**2, 0.5)


@pytest.mark.parametrize(
    ("stuck_mass", "rejected", "status"),
    [(0.0, 0.0, EMStatus.CONVERGED), (1.0, 0.0, EMStatus.SINGULAR), (0.0, 1e-3, EMStatus.NOT_CONVERGED)],
)
def test_end_of_a_run(x64, monkeypatch, stuck_mass, rejected, status):
    """A component without mass may be stuck; a rejected gain of `tol` is one that may still be had."""
    info = loop.Info(*(jnp.asarray(z) for z in ([1.0], [[stuck_mass, 1.0]], [[True, False]], [rejected])))
    monkeypatch.setattr(loop, "step", lambda states, *rest: (states, info))
    observed = []
    run = _run(None, _params(), Constant(), _model(), 1.0, tol=1e-3, max_steps=4, observe=lambda *z: observed.append(z))
    assert run.status == status
    assert [number for number, _ in observed] == list(range(1, len(run.history) + 1))
    assert len(run.history) == (4 if status == EMStatus.NOT_CONVERGED else 2)


def test_each_restart_ends_for_itself(x64, monkeypatch):
    """Converged at once, not finite at the second step, and converged after some steps."""
    values = np.array([[1.0, 1.0, 0.0], [1.0, np.nan, 1.0], [5.0, 1.0, 2.0], [6.0, 1.0, 2.0]])
    numbers = iter(range(4))

    def step(states, *rest):
        info = loop.Info(values[next(numbers)], np.ones((3, K)), np.zeros((3, K), bool), np.zeros(3))
        later = states.params._replace(time_loc=states.params.time_loc + 1)
        return states._replace(params=later), jax.tree.map(jnp.asarray, info)

    monkeypatch.setattr(loop, "step", step)
    starts = jax.tree.map(lambda z: jnp.stack([z] * 3), _params())
    runs = run_em(starts, None, Constant(), _model(), total=1.0, tol=1e-3, max_steps=9)
    assert [len(run.history) for run in runs] == [2, 2, 4]
    assert [run.status for run in runs] == [EMStatus.CONVERGED, EMStatus.NOT_FINITE, EMStatus.CONVERGED]
    assert [run.log_likelihood for run in runs] == [1.0, 1.0, 2.0]
    # The second goes back to what its last finite likelihood was of.
    moved = [run.params.time_loc - _params().time_loc for run in runs]
    np.testing.assert_allclose(moved, np.repeat([[2.0], [0.0], [4.0]], K, 1), rtol=1e-12)


def test_a_run_whose_start_has_no_likelihood_ends_without_a_warning(x64, monkeypatch):
    values = iter(jnp.array([[-np.inf, 0.0], [-np.inf, 1.0], [-np.inf, 1.0]]))
    rest = jnp.ones((2, K)), jnp.zeros((2, K), bool), jnp.zeros(2)
    monkeypatch.setattr(loop, "step", lambda states, *_: (states, loop.Info(next(values), *rest)))
    starts = jax.tree.map(lambda z: jnp.stack([z] * 2), _params())
    runs = run_em(starts, None, Constant(), _model(), total=1.0)
    assert [run.status for run in runs] == [EMStatus.NOT_FINITE, EMStatus.CONVERGED]


def _steps_with_mass(monkeypatch, *masses):
    """`loop.step` leaves the components as they are, and finds these masses."""
    left = iter(masses)

    def step(states, *rest):
        mass = jnp.asarray([next(left)])
        return states, loop.Info(jnp.ones(1), mass, jnp.zeros(mass.shape, bool), jnp.zeros(1))

    monkeypatch.setattr(loop, "step", step)


def test_an_empty_component_is_reset_to_half_of_the_heaviest(x64, monkeypatch):
    """Both are shifted apart by a standard deviation along its longest axis. The next one takes half of a half."""
    _steps_with_mass(monkeypatch, [0.6, 0.25, 0.0, 0.0], [0.25] * 4)
    params = jax.tree.map(lambda z: jnp.concatenate([z, z[:1]]), _params())
    run = _run(None, params, Constant(), _model(), 1.0, least_mass=0.01, max_steps=2)
    weights = np.exp(params.log_weights)
    np.testing.assert_allclose(np.exp(run.params.log_weights), [*weights[:2] / [4, 1], *weights[0] / [2, 4]])
    for name in ("time_loc", "time_scale", "tril"):
        np.testing.assert_array_equal(getattr(run.params, name), getattr(params, name)[jnp.array([0, 1, 0, 0])])
    shift = run.params.curve[:, 0] - params.curve[jnp.array([0, 1, 0, 0]), 0]
    np.testing.assert_allclose(shift[0], -2 * shift[2], atol=1e-12)
    np.testing.assert_allclose([shift[1], shift[3]], 0, atol=1e-12)
    variances, axes = np.linalg.eigh(params.tril[0] @ params.tril[0].T)
    np.testing.assert_allclose(np.abs(axes.T @ shift[2]), [0, 0.5 * np.sqrt(variances[1])], atol=1e-12)


def test_components_are_reset_as_often_as_there_are_some(x64, monkeypatch):
    _steps_with_mass(monkeypatch, *[[0.6, 0.4, 0.0]] * 9)
    run = _run(None, _params(), Constant(), _model(), 1.0, least_mass=0.01, max_steps=9)
    assert len(run.history) == K + 1  # without a reset it has converged


def test_only_annealing_moves_components_that_coincide(x64, monkeypatch):
    for annealing in (1.0, 0.5):
        _steps_with_mass(monkeypatch, *[[0.5] * K] * 9)
        run = _run(None, _params(), Constant(), _model(), 1.0, annealing=annealing, max_steps=9, tol=0.0)
        assert (run.params.curve == _params().curve).all() == (annealing == 1.0)


def test_a_rejected_step_of_times_is_repeated_at_a_quarter(x64, monkeypatch):
    monkeypatch.setattr(loop, "_ARMIJO", 1e9)  # more than any step gains
    params = jax.tree.map(lambda z: jnp.concatenate([z, z[:2]])[None], _params())  # a shape that no other test compiles
    model = Model(jnp.full(5, DEGREE, jnp.int32), jnp.zeros(3), "full")
    states = loop.State(params, jnp.full((1, 5), 0.5))
    new, info = loop.step(states, make_points(_data(), np.ones(N), 5), ENVELOPES["1"], model)
    np.testing.assert_array_equal(new.step_fraction, np.full((1, 5), 0.125))
    assert info.rejected > 0


def test_a_run_that_is_not_finite_is_selected_last():
    broken = loop.Run(_params(), [-1.0, np.nan], EMStatus.NOT_FINITE)
    whole = loop.Run(_params(), [-5.0], EMStatus.NOT_CONVERGED)
    assert select_best([broken, whole]) is whole


def test_temperatures_of_annealing(x64, monkeypatch):
    """From the first one to 1 in as many steps as stated, evenly in the logarithm."""
    seen = []

    def step(states, points, envelope, model, inverse_temperature):
        seen.append(inverse_temperature)
        return states, loop.Info(jnp.ones(1), jnp.ones((1, K)), jnp.zeros((1, K), bool), jnp.zeros(1))

    monkeypatch.setattr(loop, "step", step)
    run = _run(None, _params(), Constant(), _model(), 1.0, annealing=0.5, max_steps=200)
    num = loop.ANNEALING_STEPS
    np.testing.assert_allclose(np.array(seen[:num], float), 0.5 ** (1 - np.arange(num) / num), rtol=1e-6)
    assert set(seen[num:]) == {None}
    assert len(run.history) == num + loop.SETTLING_STEPS


@pytest.mark.parametrize("covariance", ["full", "diag", "spherical", "tied"])
def test_newton_step_matches_finite_differences(x64, covariance):
    """Slopes and curvatures by differences of the profile; curvatures are lifted, and steps have a longest length."""
    params, model = _params(), _model(covariance)
    if covariance != "full":
        params = params._replace(tril=0.7 * jnp.broadcast_to(jnp.eye(2)[None], (K, 2, 2)))
    points, envelope = make_points(_data(), np.ones(N), K), ENVELOPES["1"]

    here = SUMS(params, envelope, points, order=2)
    steps, promise = jax.jit(newton_step, static_argnums=2)(here, model, DEGREE)

    def value(moved):
        there = SUMS(params, envelope, points, times=STEPPED(Times(params.time_loc, params.time_scale), moved))
        return PROFILE(here, model, DEGREE, moved, there.gram[0], there.log_a[0])

    np.testing.assert_allclose((value(1e-5 * steps) - value(-1e-5 * steps)) / 2e-5, promise, rtol=1e-5)
    h = 1e-4
    at = {(i, j): np.asarray(value(h * np.repeat([i, j], K).reshape(2, K))) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    slopes = np.stack([at[1, 0] - at[-1, 0], at[0, 1] - at[0, -1]]) / (2 * h)
    mixed = (at[1, 1] - at[1, -1] - at[-1, 1] + at[-1, -1]) / 4
    second = [at[1, 0] - 2 * at[0, 0] + at[-1, 0], mixed, mixed, at[0, 1] - 2 * at[0, 0] + at[0, -1]]
    for k, mass in enumerate(here.mass):
        negative = -np.array(second)[:, k].reshape(2, 2) / h**2
        lift = max(_MIN_CURVATURE * mass - np.linalg.eigvalsh(negative)[0], 0)
        step = np.linalg.solve(negative + lift * np.eye(2), slopes[:, k])
        step *= min(1, _MAX_STEP / np.abs(step).max())
        np.testing.assert_allclose(steps[:, k], step, rtol=1e-5, atol=1e-7)


# --- laws ---------------------------------------------------------------------------------------------------


def test_a_run_ends_where_another_step_of_times_gains_nothing(x64):
    envelope, model, points = ENVELOPES["1"], _model(), make_points(_data(), np.ones(N), K)
    params = _run(points, _params(), envelope, model, tol=1e-8, max_steps=60).params
    promise = jax.jit(lambda sums: newton_step(sums, model, DEGREE)[1])(SUMS(params, envelope, points, order=2))
    assert (promise < 1e-4).all()


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
        assert len(run.history) == len(alone.history)
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
