"""EM on arrays: its density against the distribution's, its steps against their promises, and hard data."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, special

from foldgauss.envelope import Constant, TimeLikelihood, plain_envelope
from foldgauss.estimator.em import components, loop, statistics
from foldgauss.estimator.em.loop import EMStatus, run_em, select_best
from foldgauss.estimator.em.m_step import (
    Model,
    newton_step,
    profile_log_likelihood,
    residual_scatter,
    update_components,
)
from foldgauss.estimator.em.scaling import Scaling, to_mixture
from foldgauss.estimator.em.statistics import (
    SufficientStatistics,
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
NEWTON = jax.jit(newton_step, static_argnums=2)
UPDATE = jax.jit(update_components)


def log_density(params, envelope, x):
    return special.logsumexp(densities(params, envelope, x).log_density, axis=-1)


def _weigh(params, envelope, x, weights=1.0):
    """Responsibilities times weights (n, k)."""
    log_shares = special.log_softmax(densities(params, envelope, jnp.asarray(x)).log_density, axis=1)
    return np.reshape(weights, (-1, 1)) * np.exp(log_shares)


def _of_degrees(params, degrees):
    """Without powers above the degree of each component."""
    return params._replace(curve=jnp.where(np.arange(DEGREE + 1)[:, None] <= degrees[:, None, None], params.curve, 0))


def _curves(params, t):
    """The curves of the components (k, n, d-1) at times (n,)."""
    v = (np.asarray(params.time_loc)[:, None] - t) / np.asarray(params.time_scale)[:, None]
    return np.einsum("knj,kja->kna", v[..., None] ** np.arange(DEGREE + 1), params.curve)


def _regress(x, weights, degree):
    """NumPy's weighted least squares of space on time: the curve at the times, and the scatter of the residuals."""
    curve = np.stack(
        [
            np.polynomial.Polynomial.fit(x[:, -1], column, degree, w=np.sqrt(weights))(x[:, -1])
            for column in x[:, :-1].T
        ],
        1,
    )
    return curve, np.einsum("n,na,nb->ab", weights, x[:, :-1] - curve, x[:, :-1] - curve)


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


@pytest.mark.parametrize(("dim", "beta"), [(2, None), (9, 0.3)])
def test_gram_is_the_sum_over_pairs(x64, dim, beta):
    """Chunks, padding, weights: against the sum written out in NumPy. Responsibilities depend on the temperature."""
    params, x, weights = _params(dim=dim), _data(dim=dim), np.random.default_rng(2).uniform(0, 2, N)
    sums = SUMS(params, ENVELOPES["1"], make_points(x, weights, K), inverse_temperature=beta)
    pairs = densities(params, ENVELOPES["1"], jnp.asarray(x))
    log_density, v, log_a = (np.asarray(z) for z in (pairs.log_density, pairs.v, pairs.log_a))
    shares = weights[:, None] * special.softmax((beta or 1.0) * log_density, axis=1)
    np.testing.assert_allclose(sums.log_likelihood, weights @ special.logsumexp(log_density, axis=1), rtol=1e-12)
    expected = [(shares * z).sum(0) for z in (v, v * v, log_a)]
    np.testing.assert_allclose([sums.first, sums.second, sums.log_a[0]], expected, rtol=1e-10, atol=1e-10)
    hermite = np.stack([np.ones_like(v), v, (v * v - 1) / np.sqrt(2)], -1)
    z = np.concatenate([hermite, np.stack(pairs.whitened, -1).reshape(N, K, dim)], -1)
    np.testing.assert_allclose(sums.mass, shares.sum(0), rtol=1e-12)
    assert len(sums.gram) == 1  # without derivatives
    gram = np.einsum("nk,nka,nkb->kab", shares * np.exp(-log_a), z, z)
    np.testing.assert_allclose(sums.gram[0], gram, rtol=1e-10, atol=1e-9)
    split = SUMS(params, ENVELOPES["1"], make_points(x, weights, 2**13), inverse_temperature=beta)  # 16 rows a chunk
    np.testing.assert_allclose(split.gram, sums.gram, rtol=1e-10, atol=1e-9)


def test_a_point_of_weight_zero_adds_nothing_however_far(x64):
    far, weights = _data(), np.append(np.ones(N - 1), 0.0)
    far[-1, 0] = 1e200  # its density is 0, whose logarithm is infinite
    sums = [SUMS(_params(), Constant(), make_points(x, weights, K)) for x in (far, _data())]
    jax.tree.map(np.testing.assert_array_equal, *sums)


def test_given_responsibilities_replace_those_of_the_components(x64):
    points, given = make_points(_data(), np.full(N, 0.5), K), np.random.default_rng(0).uniform(size=(1, 1, 256, K))
    sums = SUMS(_params(), Constant(), points, responsibilities=jnp.asarray(given))
    v = np.asarray(densities(_params(), Constant(), jnp.asarray(_data())).v)
    expected = [0.5 * (given[0, 0, :N] * v**power).sum(0) for power in range(3)]
    np.testing.assert_allclose([sums.mass, sums.first, sums.second], expected, rtol=1e-12)


def test_sums_are_finite_where_one_over_the_envelope_overflows(x64):
    """A point on the curve of a component, 60 time scales away, where a = exp(-1800)."""
    params, x = _params()._replace(curve=jnp.zeros((K, DEGREE + 1, 2))), _data()
    x[0] = 0, 0, 60 * params.time_scale.max()
    assert np.isfinite(SUMS(params, TimeLikelihood(1.0), make_points(x, np.ones(N), K)).gram).all()


@pytest.mark.parametrize(
    ("num", "components", "devices", "size", "shape"),
    [
        (2**18, 2, 1, None, (1, 4, 2**16)),  # 2^17 densities at once
        (1, 3, 1, None, (1, 1, 256)),  # the smallest program
        (100, 2**15, 1, None, (1, 7, 16)),  # at least 16 rows a chunk
        (300, 3, 3, None, (3, 1, 256)),
        (5, 3, 1, 257, (1, 1, 512)),  # rows are padded to a power of 2
    ],
)
def test_shapes_of_points(num, components, devices, size, shape):
    x = np.arange(2.0 * num, dtype=np.float32).reshape(num, 2)
    points = make_points(x, np.ones(num), components, devices, size)
    assert points.weights.shape == shape
    np.testing.assert_array_equal(np.reshape(points.x, (-1, 2))[:num], x)
    np.testing.assert_array_equal(np.ravel(points.weights), np.arange(np.prod(shape)) < num)
    assert isinstance(points.x.sharding, jax.sharding.NamedSharding) == (devices > 1)


@pytest.mark.parametrize(
    ("devices", "components", "lengths"),
    [(1, K, [4096]), (3, K, [4096]), (1, 2**13, [128] * 32), (3, 2**13, [384] * 10 + [256])],
)
def test_pieces_of_any_lengths_fill_blocks_of_eight_chunks(monkeypatch, devices, components, lengths):
    monkeypatch.setattr(statistics, "make_points", lambda x, weights, *rest: (x, weights, rest[-1]))
    x, weights = np.arange(4096.0)[:, None], np.arange(4096.0)
    pieces = [(x[a:b], weights[a:b]) for a, b in ((0, 5), (5, 5), (5, 3000), (3000, 4096))]
    blocks, masses, sizes = zip(*statistics.make_blocks(pieces, 4096, components, devices), strict=True)
    assert [len(block) for block in blocks] == lengths
    np.testing.assert_array_equal(np.concatenate(blocks), x)
    np.testing.assert_array_equal(np.concatenate(masses), weights)
    assert all(lengths[0] <= size < 2 * lengths[0] for size in sizes)


@pytest.mark.parametrize(("dtype", "expected"), [(np.float64, np.float64), (np.float32, np.float32)])
def test_only_float64_changes_the_users_setting(dtype, expected):
    with statistics.enable_dtype(dtype):
        assert jnp.ones(()).dtype == expected


@pytest.mark.parametrize("covariance", ["full", "diag", "spherical", "tied"])
def test_floor_is_added_to_variances(x64, covariance):
    params = _params()._replace(tril=0.7 * jnp.broadcast_to(jnp.eye(2)[None], (K, 2, 2)))
    sums, degrees = SUMS(params, Constant(), make_points(_data(), np.ones(N), K)), _model().degrees
    floor = np.array([0.1, 0.3, 0.5])
    plain, floored = (UPDATE(params, sums, Model(degrees, jnp.asarray(z), covariance))[0] for z in (0 * floor, floor))
    sigma = [one.tril @ one.tril.swapaxes(1, 2) for one in (plain, floored)]
    added = np.diag(floor[:2]) if covariance != "spherical" else 0.2 * np.eye(2)
    np.testing.assert_allclose(sigma[1] - sigma[0], np.broadcast_to(added, (K, 2, 2)), atol=1e-12)
    np.testing.assert_allclose(floored.time_scale**2 - plain.time_scale**2, 0.5)


@pytest.mark.parametrize("covariance", ["full", "diag", "spherical", "tied"])
def test_m_step_is_weighted_least_squares(x64, covariance):
    """Against NumPy's moments of time, polynomials and residuals; of small weights, and of different degrees."""
    degrees, floor, eye = np.arange(K), np.array([0.1, 0.3, 0.5]), np.eye(2)
    params = _of_degrees(_params(), degrees)
    tril = {"full": params.tril, "tied": jnp.stack([params.tril[0]] * K)}.get(covariance, params.tril * eye[None])
    params, model = params._replace(tril=tril), Model(jnp.asarray(degrees, jnp.int32), jnp.asarray(floor), covariance)
    x, weights = _data(), 1e-6 * np.random.default_rng(2).uniform(0, 2, N)
    sums, shares = SUMS(params, Constant(), make_points(x, weights, K)), _weigh(params, Constant(), x, weights)
    mass = shares.sum(0)
    time_loc = x[:, -1] @ shares / mass
    variance = (shares * (x[:, -1:] - time_loc) ** 2).sum(0) / mass
    curves, scatter = zip(*(_regress(x, shares[:, k], degrees[k]) for k in range(K)), strict=True)
    sigma = np.array(scatter) / mass[:, None, None]
    sigma = {
        "full": sigma,
        "diag": sigma * eye,
        "spherical": sigma.trace(axis1=1, axis2=2)[:, None, None] / 2 * eye,
        "tied": np.broadcast_to(np.sum(scatter, 0) / mass.sum(), sigma.shape),
    }[covariance] + np.diag([0.2, 0.2] if covariance == "spherical" else floor[:2])
    steps = np.array([[0.3, -0.2, 0.1], [0.2, -5.0, 0.1]])
    times = params.time_loc + params.time_scale * steps[0], np.maximum(params.time_scale * np.exp(steps[1]), 0.5**0.5)
    for step, expected in (((), (time_loc, np.sqrt(variance + 0.5))), ((jnp.asarray(steps),), times))[
        : 2 if covariance == "full" else 1
    ]:
        new, stuck = UPDATE(params, sums, model, *step)
        assert not stuck.any()
        np.testing.assert_allclose(np.exp(new.log_weights), mass / mass.sum(), rtol=1e-10)
        np.testing.assert_allclose([new.time_loc, new.time_scale], expected, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(_curves(new, x[:, -1]), curves, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(new.tril @ new.tril.swapaxes(1, 2), sigma, rtol=1e-9, atol=1e-12)


def test_a_component_without_a_maximum_keeps_its_parameters(x64):
    """Without mass, with points at one time, with a singular Sigma, and with a curve that overflows."""
    params, points = _params(), make_points(_data(), np.ones(N), K)
    sums = SUMS(params, Constant(), points)
    empty = params._replace(log_weights=params.log_weights.at[1].set(-np.inf))
    still = sums._replace(first=sums.first.at[1].set(0), second=sums.second.at[1].set(0))
    singular = sums._replace(gram=sums.gram.at[0, 1, -1].set(0).at[0, 1, :, -1].set(0))
    infinite = params._replace(curve=params.curve.at[1, 0, 0].set(np.inf))
    for old, found, floor in (
        (empty, SUMS(empty, Constant(), points), 0.1),
        (params, still, 0.0),
        (params, singular, 0.0),
        (infinite, sums, 0.0),
    ):
        new, stuck = UPDATE(old, found, _model(floor=floor))
        assert stuck.tolist() == [False, True, False]
        np.testing.assert_allclose(np.exp(new.log_weights), found.mass / found.mass.sum(), rtol=1e-12)
        for z, before in zip(new[1:], old[1:], strict=True):
            np.testing.assert_array_equal(z[1], before[1])


def test_a_regression_that_overflows_leaves_the_curve_as_it_is(x64):
    params, t = _params(), np.linspace(-1, 1, 5)
    sums = SUMS(params, Constant(), make_points(_data(), np.ones(N), K))
    gram = np.array(sums.gram)
    gram[0, 1, :3] = np.hstack([1e-300 * np.eye(3), np.full((3, 1), 1e10), np.zeros((3, 1))])
    new, stuck = UPDATE(params, sums._replace(gram=jnp.asarray(gram)), _model())
    assert not stuck.any()
    np.testing.assert_allclose(_curves(new, t)[1], _curves(params, t)[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("weight", [1e-8, 1e8])
def test_a_polynomial_that_the_times_do_not_determine_changes_least(x64, weight):
    """All points at t = 0, where v = 1: of the Hermite polynomials 1, v and v^2 - 1 the first two change alike."""
    params, x, t = _params()._replace(time_loc=jnp.ones(K), time_scale=jnp.ones(K)), _data(), np.linspace(-1, 1, 5)
    x[:, -1] = 0
    sums = SUMS(params, Constant(), make_points(x, np.full(N, weight), K))
    shares = _weigh(params, Constant(), x, weight)
    missed = (shares.T @ x[:, :-1])[:, None] / shares.sum(0)[:, None, None] - _curves(params, np.zeros(1))
    new, _ = UPDATE(params, sums, _model(floor=0.1))
    np.testing.assert_allclose(_curves(new, np.zeros(1)), _curves(params, np.zeros(1)) + missed, atol=1e-9)
    np.testing.assert_allclose(
        _curves(new, t) - _curves(params, t), missed * (2 - t[:, None]) / 2, atol=0.1 * np.abs(missed).max()
    )


def test_residual_scatter_is_of_the_best_curves_of_lower_degrees(x64):
    params, x = _params(), _data()
    sums, shares = SUMS(params, Constant(), make_points(x, np.ones(N), K)), _weigh(params, Constant(), x)
    found = jax.jit(residual_scatter)(sums, params, _model(degree=np.arange(K)))
    scatter = params.tril @ found @ params.tril.swapaxes(1, 2)
    expected = [_regress(x, shares[:, k], k)[1] for k in range(K)]
    np.testing.assert_allclose(scatter, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("stuck_mass", "rejected", "status"),
    [
        (0.0, 1.5e-3, EMStatus.CONVERGED),
        (1.0, 0.0, EMStatus.SINGULAR),
        (0.0, 2e-3, EMStatus.NOT_CONVERGED),
    ],
)
def test_end_of_a_run(x64, monkeypatch, stuck_mass, rejected, status):
    """A component without mass may be stuck; a rejected gain of `tol` per weight is one that may still be had."""
    info = loop.Info(*(jnp.asarray(z) for z in ([1.0], [[stuck_mass, 1.0]], [[True, False]], [rejected])))
    monkeypatch.setattr(loop, "step", lambda states, *rest: (states, info))
    observed = []
    run = _run(None, _params(), Constant(), _model(), 2.0, tol=1e-3, max_steps=4, observe=lambda *z: observed.append(z))
    assert run.status == status
    assert [number for number, _ in observed] == list(range(1, len(run.history) + 1))
    assert len(run.history) == (4 if status == EMStatus.NOT_CONVERGED else 2)


def test_statuses_keep_their_numbers():
    """As `status_` of fits that are saved."""
    assert {status.name: status.value for status in EMStatus} == {
        "CONVERGED": 0,
        "NOT_CONVERGED": 1,
        "NOT_FINITE": 2,
        "SINGULAR": 3,
    }


def test_each_restart_ends_for_itself(x64, monkeypatch):
    """Converged at once, not finite at the second step, and converged after some steps. What has ended is not reset."""
    values = np.array([[1.0, 1.0, 0.0], [1.0, np.nan, 1.0], [1.0, 1.0, 2.0], [6.0, 1.0, 2.0]])
    numbers = iter(range(4))

    def step(states, *rest):
        number = next(numbers)
        mass, stuck = np.ones((3, K)), np.zeros((3, K), bool)
        mass[:2, 0], stuck[0] = np.array([number < 2, number < 1]), number > 1
        info = loop.Info(values[number], mass, stuck, np.zeros(3))
        later = states.params._replace(time_loc=states.params.time_loc + 1)
        return states._replace(params=later), jax.tree.map(jnp.asarray, info)

    monkeypatch.setattr(loop, "step", step)
    starts = jax.tree.map(lambda z: jnp.stack([z] * 3), _params())
    runs = run_em(starts, None, Constant(), _model(), total=1.0, tol=1e-3, max_steps=9, least_mass=0.01)
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


@pytest.mark.parametrize(("rise", "length"), [(1.001e-3, 100), (0.999e-3, 2)])
def test_by_default_a_run_ends_after_100_steps_or_a_change_below_a_thousandth(x64, monkeypatch, rise, length):
    values = iter(rise * np.arange(200.0))
    info = loop.Info(None, jnp.full((1, K), 0.5), jnp.zeros((1, K), bool), jnp.zeros(1))
    monkeypatch.setattr(loop, "step", lambda states, *_: (states, info._replace(log_likelihood=[next(values)])))
    assert len(_run(None, _params(), Constant(), _model(), 1.0).history) == length


def _steps_with_mass(monkeypatch, *masses):
    """`loop.step` leaves the components as they are, and finds these masses."""
    left = iter(masses)

    def step(states, *rest):
        mass = jnp.asarray([next(left)])
        return states, loop.Info(jnp.ones(1), mass, jnp.zeros(mass.shape, bool), jnp.zeros(1))

    monkeypatch.setattr(loop, "step", step)


def test_an_empty_component_is_reset_to_half_of_the_heaviest(x64, monkeypatch):
    """Both are shifted apart by a standard deviation along its longest axis. Halves take part in what follows."""
    _steps_with_mass(monkeypatch, [0.25, 0.6, 0.4, 0.0, 0.0, 0.0], [0.25] * 6)
    params = jax.tree.map(lambda z: jnp.concatenate([z, z]), _params())
    run = _run(None, params, Constant(), _model(), 1.0, least_mass=0.25, max_steps=2)
    weights, donors = np.exp(params.log_weights), jnp.array([0, 1, 2, 1, 2, 1])
    np.testing.assert_allclose(np.exp(run.params.log_weights), weights[donors] / [1, 4, 2, 2, 2, 4])
    for name in ("time_loc", "time_scale", "tril"):
        np.testing.assert_array_equal(getattr(run.params, name), getattr(params, name)[donors])
    np.testing.assert_array_equal(run.params.curve[:, 1:], params.curve[donors, 1:])
    shift = run.params.curve[:, 0] - params.curve[donors, 0]
    np.testing.assert_allclose(shift[1:3], [-2 * shift[3], -shift[4]], atol=1e-12)
    np.testing.assert_allclose(shift[::5], 0, atol=1e-12)
    for donor, moved in zip(donors[3:5], shift[3:5], strict=True):
        variances, axes = np.linalg.eigh(params.tril[donor] @ params.tril[donor].T)
        np.testing.assert_allclose(np.abs(axes.T @ moved), [0, 0.5 * np.sqrt(variances[1])], atol=1e-12)


def test_components_are_reset_as_often_as_there_are_some(x64, monkeypatch):
    _steps_with_mass(monkeypatch, *[[0.6, 0.4, 0.0]] * 9)
    run = _run(None, _params(), Constant(), _model(), 1.0, least_mass=0.01, max_steps=9)
    assert len(run.history) == K + 1  # without a reset it has converged
    _steps_with_mass(monkeypatch, [0.6, 0.4, 0.0])
    # In the last step there is none: no step follows that could adapt what is reset.
    run = _run(None, _params(), Constant(), _model(), 1.0, least_mass=0.01, max_steps=1)
    assert (run.params.log_weights == _params().log_weights).all()


def test_only_annealing_moves_components_that_coincide(x64, monkeypatch):
    for annealing in (1.0, 0.5):
        _steps_with_mass(monkeypatch, *[[0.5] * K] * 9)
        run = _run(None, _params(), Constant(), _model(), 1.0, annealing=annealing, max_steps=9, tol=0.0)
        assert len(run.history) == 9  # with tol = 0 all steps are taken
        moved = run.params.curve - _params().curve
        assert (moved != 0).any((0, 2)).tolist() == [annealing != 1.0, False, False]
    assert 0.05 < np.linalg.solve(_params().tril, moved[:, 0, :, None]).std() < 0.4  # nine times 0.05: 0.15


def test_a_rejected_step_of_times_is_repeated_at_a_quarter(x64):
    """Armijo's condition: the gain must reach 1e-4 of what is predicted. The first component gains half of that, the
    second twice that, and the third has no points, and so nothing to gain."""
    params, x, model, envelope = _params(), _data(), _model("tied"), ENVELOPES["1"]
    params = params._replace(log_weights=params.log_weights.at[2].set(-np.inf))
    points, times = make_points(x, np.full(N, 1e-3), K), Times(params.time_loc, params.time_scale)
    here = SUMS(params, envelope, points, order=2)
    (direction, predicted), start = NEWTON(here, model, DEGREE), (here.gram[0], here.log_a[0])

    def gain(fraction):
        steps = fraction * direction
        there = SUMS(params, envelope, points, times=STEPPED(times, steps))
        ends = (PROFILE(here, model, DEGREE, *z) for z in ((0 * steps, *start), (steps, there.gram[0], there.log_a[0])))
        return -np.subtract(*ends)

    fractions = np.full(K, 0.3)
    for k, part in ((0, 0.5e-4), (1, 2e-4)):
        fractions[k] = optimize.brentq(lambda f, k, part: gain(f)[k] - part * f * predicted[k], 1.0, 30.0, (k, part))
    states = jax.tree.map(lambda z: z[None], loop.State(params, jnp.asarray(fractions)))
    new, info = loop.step(states, points, envelope, model)
    np.testing.assert_allclose(new.step_fraction[0], [0.25 * fractions[0], 1, 0.6], rtol=1e-12)
    np.testing.assert_allclose(info.rejected, predicted[:1], rtol=1e-10)
    stepped = step_times(times, jnp.asarray(fractions * [0, 1, 0])[None] * direction)
    np.testing.assert_allclose([new.params.time_loc[0], new.params.time_scale[0]], stepped, rtol=1e-10)
    # Space is the regression with weights 1 / a, at the new times where the step is accepted.
    log_a = densities(params._replace(time_loc=stepped.loc, time_scale=stepped.scale), envelope, jnp.asarray(x)).log_a
    shares = _weigh(params, envelope, x) * np.exp(-log_a)
    curves = _curves(jax.tree.map(lambda z: z[0], new.params), x[:, -1])[:2]
    np.testing.assert_allclose(curves, [_regress(x, shares[:, k], DEGREE)[0] for k in (0, 1)], rtol=1e-8, atol=1e-8)


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
    num = 50
    np.testing.assert_allclose(np.array(seen[:num], float), 0.5 ** (1 - np.arange(num) / num), rtol=1e-6)
    assert set(seen[num:]) == {None}
    assert len(run.history) == num + 20  # at temperature 1


def _newton(negative, slopes, mass):
    """The step of negative second derivatives (2, 2), which are lifted to a fifth of the mass, at most 0.5 long."""
    step = np.linalg.solve(negative + max(0.2 * mass - np.linalg.eigvalsh(negative)[0], 0) * np.eye(2), slopes)
    return step * min(1, 0.5 / np.abs(step).max())


def _newton_of(slopes, negative, mass):
    """`newton_step` of sums for which the tied profile has these slopes (2, k) and negative second derivatives (3, k)
    by 00, 01 and 11: the residuals depend on no step, and `first` is 0."""
    zero, mass = np.zeros(K), np.asarray(mass)
    log_a = np.stack([zero, *-np.asarray(slopes), *(np.asarray(negative) - [mass, zero, 2 * mass])])
    gram = np.eye(5) * (np.arange(6) == 0)[:, None, None, None] * np.ones((K, 1, 1))
    parts = jnp.zeros(()), *(jnp.asarray(z) for z in (mass, zero, mass, log_a, gram))
    return NEWTON(SufficientStatistics(*parts), _model("tied"), DEGREE)


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_newton_step_of_known_derivatives(x64, size):
    rng = np.random.default_rng(3)
    slopes, (h00, h01, h11), mass = size * rng.normal(size=(2, K)), rng.normal(size=(3, K)), rng.uniform(size=K)
    steps, promise = _newton_of(slopes, (h00, h01, h11), mass)
    for k in range(K):
        negative = np.array([[h00[k], h01[k]], [h01[k], h11[k]]])
        np.testing.assert_allclose(steps[:, k], _newton(negative, slopes[:, k], mass[k]), rtol=1e-9)
    np.testing.assert_allclose(promise, (slopes * steps).sum(0), rtol=1e-12)


def test_a_newton_step_that_is_not_determined_is_zero(x64):
    """Of a singular matrix, and of derivatives that overflow."""
    slopes, negative = [[1, 1e200, 0.1], [0, 0, 0.1]], [[1, 1, 1], [1, 0, 0], [1, 1e200, 1]]
    steps, promise = _newton_of(slopes, negative, [0.0, 1.0, 1.0])
    np.testing.assert_allclose(steps, [[0, 0, 0.1], [0, 0, 0.1]], rtol=1e-12)
    np.testing.assert_allclose(promise, [0, 0, 0.02], rtol=1e-12)


@pytest.mark.parametrize("covariance", ["full", "diag", "spherical", "tied"])
def test_newton_step_matches_finite_differences(x64, covariance):
    """Slopes and curvatures by differences of the profile; curvatures are lifted, and steps have a longest length."""
    params, model = _params(), _model(covariance, degree=np.arange(K))
    if covariance != "full":
        params = params._replace(tril=0.7 * jnp.broadcast_to(jnp.eye(2)[None], (K, 2, 2)))
    points, envelope = make_points(_data(), np.full(N, 4e-3), K), ENVELOPES["1"]

    here = SUMS(params, envelope, points, order=2)
    steps, promise = NEWTON(here, model, DEGREE)

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
        np.testing.assert_allclose(steps[:, k], _newton(negative, slopes[:, k], mass), rtol=1e-5, atol=1e-7)

    empty = SUMS(params._replace(log_weights=params.log_weights.at[0].set(-jnp.inf)), envelope, points, order=2)
    steps, promise = NEWTON(empty, model, DEGREE)
    np.testing.assert_array_equal([*steps[:, 0], promise[0]], 0)
    # A step of a component without points is no loss.
    assert covariance == "full" or PROFILE(empty, model, DEGREE, steps, empty.gram[0], empty.log_a[0])[0] >= 0


# --- laws ---------------------------------------------------------------------------------------------------


def test_a_run_ends_where_another_step_of_times_gains_nothing(x64):
    envelope, model, points = ENVELOPES["1"], _model(), make_points(_data(), np.ones(N), K)
    params = _run(points, _params(), envelope, model, tol=1e-8, max_steps=60).params
    promise = jax.jit(lambda sums: newton_step(sums, model, DEGREE)[1])(SUMS(params, envelope, points, order=2))
    assert (promise < 1e-4).all()


def test_coefficients_above_the_degree_stay_zero(x64):
    degrees = np.array([0, 1, 2])
    params = _of_degrees(_params(), degrees)
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
