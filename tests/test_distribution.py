"""The Folded-Gaussian: against scipy, a NumPy twin, quadrature and its own samples; and far out."""

import pickle
from functools import partial

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from folded import BEND, CONDITION_TIME, LOC, LOG_PROB, SAMPLE, TRIL, folded
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from foldgauss._numerics.batch import steepest
from foldgauss.distribution import FoldedGaussian, Gaussian
from foldgauss.envelope import AbstractEnvelope, CallableEnvelope, TimeLikelihood, plain_envelope
from foldgauss.fold import CallableFold, FourierFold, PolynomialFold, SharedPathFold, SplineFold, ZeroFold
from foldgauss.mixture import FoldedMixture, Mixture

TAUS = [0.0, 5.0, 13.3, 14.0, 19.0, 40.0, 1e3]


def _batched(leading, key=0, degree=2):
    k = jax.random.split(jax.random.key(key), 5)
    tril = jnp.tril(jax.random.uniform(k[0], (*leading, 2, 2), minval=0.2, maxval=0.5))
    return FoldedGaussian(
        jax.random.normal(k[1], (*leading, 2)),
        tril,
        time_loc=jax.random.uniform(k[2], leading),
        time_scale=jax.random.uniform(k[3], leading, minval=0.3, maxval=0.5),
        fold=PolynomialFold(jax.random.normal(k[4], (*leading, degree, 2))),
    )


def _column(u):
    return u[None]


def _close(actual, desired, tolerance):
    np.testing.assert_allclose(actual, desired, rtol=tolerance, atol=tolerance)


def _twin_log_prob(s, t, *, loc, tril, time_loc, time_scale, coefficients, power, floor):
    """eq:foldgauss from the book, with scipy's densities, of one point."""
    u = time_loc - t
    shift = sum((c * u ** (k + 1) for k, c in enumerate(coefficients)), np.zeros(len(loc)))
    a = floor + (1 - floor) * np.exp(-power * u**2 / (2 * time_scale**2))
    space = stats.multivariate_normal(loc + shift, a * tril @ tril.T).logpdf(s)
    return space + stats.norm(time_loc, time_scale).logpdf(t)


# --- oracles ----------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(
    dim_and_degree=st.sampled_from([(1, 1), (2, 4), (10, 0)]),
    power=st.sampled_from([0.0, 1.0, 2.0]),
    floor=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 2**20),
)
def test_log_prob_equals_the_paper_written_out(dim_and_degree, power, floor, seed):
    rng, (dim, degree) = np.random.default_rng(seed), dim_and_degree
    tril, coefficients = np.tril(rng.uniform(0.3, 1.0, (dim, dim))), rng.normal(size=(degree, dim))
    loc, time_loc, time_scale = rng.normal(size=dim), rng.normal(), rng.uniform(0.3, 2)
    x = np.c_[rng.normal(size=(10, dim)), time_loc + 1.5 * time_scale * rng.uniform(-1, 1, 10)]
    own = {"loc": loc, "time_loc": time_loc, "time_scale": time_scale}
    twin = {"tril": tril, "coefficients": coefficients, "power": power, "floor": floor, **own}
    with jax.enable_x64(True):
        fold, envelope = PolynomialFold(coefficients), TimeLikelihood(power, floor)
        dist = FoldedGaussian(**own, scale_tril=tril, fold=fold, envelope=envelope)
        expected = [_twin_log_prob(s, t, **twin) for *s, t in x]
        np.testing.assert_allclose(LOG_PROB(dist, x), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.usefixtures("x64")
def test_chain_rule():
    dist = folded()
    x = np.random.default_rng(3).normal(size=(20, 3))
    conditional, marginal = CONDITION_TIME(dist, x[:, -1]), dist.marginal([-1])
    assert conditional.batch_shape == (20,)
    assert conditional.event_shape == (2,)
    assert isinstance(marginal, Gaussian)
    assert (marginal.batch_shape, marginal.event_shape) == ((), (1,))
    parts = eqx.filter_jit(lambda s, t: conditional.log_prob(s) + marginal.log_prob(t))(x[:, :-1], x[:, -1:])
    _close(LOG_PROB(dist, x), parts, 1e-12)


# --- samples ----------------------------------------------------------------------------------------------


def _smallest_p_value(x, *, loc, tril, time_loc, time_scale, coefficients, power):
    """Undo the fold in NumPy: each whitened coordinate is standard normal, overall and in time slices."""
    s, u = x[:, :-1], time_loc - x[:, -1]
    tau = -u / time_scale
    shift = sum(c * u[:, None] ** (k + 1) for k, c in enumerate(coefficients))
    white = np.linalg.solve(tril, (s - loc - shift).T) * np.exp(power * tau**2 / 4)
    slices = [tau < -1, np.abs(tau) <= 1, tau > 1]
    samples = [tau, *white, *(row[keep] for row in white for keep in slices)]
    p_values = [stats.kstest(sample, "norm", method="asymp").pvalue for sample in samples]
    return min(p_values) * len(samples)  # Bonferroni


RIGHT = {
    "loc": LOC[:2],
    "tril": TRIL[:2, :2],
    "time_loc": 0.4,
    "time_scale": 0.3,
    "coefficients": BEND[:2, :2],
    "power": 1.0,
}


@pytest.fixture(scope="module")
def draws():
    return np.asarray(SAMPLE(folded(), jax.random.key(11), (100_000,)), np.float64)


def test_unfolded_samples_are_standard_normal(draws):
    # Fixed seed; for a fresh one the rate of false alarms is 1e-4.
    assert draws.shape == (100_000, 3)
    assert _smallest_p_value(draws, **RIGHT) > 1e-4


@pytest.mark.parametrize(
    "wrong",
    [
        {"coefficients": -RIGHT["coefficients"]},
        {"coefficients": RIGHT["coefficients"] * np.array([[-1], [1]])},  # f(t - m_t): the sign of t
        {"coefficients": RIGHT["coefficients"] * 1.02},
        {"power": 2.0},
        {"power": 0.0},
        {"power": 1.1},
        {"tril": RIGHT["tril"].T},
        {"time_loc": 0.41},
    ],
    ids=["sign of f", "sign of t", "f 2% off", "power 2", "power 0", "power 10% off", "transposed", "time"],
)
def test_the_sample_test_has_power(draws, wrong):
    assert _smallest_p_value(draws, **(RIGHT | wrong)) < 1e-4


def test_samples_have_pathwise_gradients():
    def mean(dist):
        return dist.sample(jax.random.key(0), (5,)).mean()

    assert FoldedGaussian.has_rsample
    grad = jax.jit(jax.grad(mean))(folded())
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(grad))
    _close(grad.loc, np.full(2, 1 / 3), 1e-6)


# --- gradients and extremes -------------------------------------------------------------------------------


# Forward mode takes long to compile; in the quick suite test_distribution_moments.py uses it.
@pytest.mark.parametrize(
    ("dim", "forward"),
    [(2, False), pytest.param(2, True, marks=pytest.mark.slow), pytest.param(10, False, marks=pytest.mark.slow)],
)
@pytest.mark.usefixtures("x64")
def test_gradients_equal_finite_differences(dim, forward):
    rng = np.random.default_rng(0)
    tril = jnp.asarray(np.tril(rng.uniform(0.3, 0.6, (dim, dim))) + np.eye(dim))
    fold = PolynomialFold(rng.normal(size=(2, dim)))
    dist = folded(dim, floor=0.1, fold=fold, loc=np.linspace(0.1, -0.4, dim), scale_tril=tril)
    vector, rebuild = jax.flatten_util.ravel_pytree((dist, jnp.append(dist.loc + 0.2, 0.6)))
    free = jnp.asarray(rng.normal(size=vector.size))
    free = jax.flatten_util.ravel_pytree(  # a direction that leaves the factor lower-triangular
        eqx.tree_at(lambda pair: pair[0].scale_tril, rebuild(free), replace_fn=jnp.tril)
    )[0]
    log_prob = lambda e: (lambda dist, x: dist.log_prob(x))(*rebuild(vector + e * free))  # noqa: E731

    @jax.jit
    def derivatives(e):
        (first, second), value = jax.jacrev(lambda e: jax.value_and_grad(log_prob)(e))(e), log_prob(e)
        return value, first, second

    step = 1e-5
    (_, first, second), (up, first_up, _), (down, first_down, _) = map(derivatives, (0.0, step, -step))
    np.testing.assert_allclose(first, (up - down) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(second, (first_up - first_down) / (2 * step), rtol=1e-6)
    if forward:
        _close(jax.jit(jax.jacfwd(lambda e: jax.value_and_grad(log_prob)(e)))(0.0), (first, second), 1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.slow)])
def test_extremes_are_finite_or_minus_infinity_and_never_nan(dtype):
    axes = ([1.0, 2.0], [0.0, 1e-3], TAUS + [-tau for tau in TAUS], [0, 1e-30, 1e-12, 1e-2, 1, 1e20])
    with jax.enable_x64(dtype == jnp.float64):
        cases = [axis.ravel().astype(dtype) for axis in np.meshgrid(*axes)]

        def log_prob(power, floor, tau, residual, dist, moved):
            dist = eqx.tree_at(lambda d: d.envelope, dist, TimeLikelihood(power, floor))
            t = dist.time_loc + tau * dist.time_scale
            s = dist.condition_time(t).loc + residual * jnp.array([1.0, -1.0], dtype)
            return dist.log_prob(jax.lax.stop_gradient(jnp.append(s, t)) + moved)

        over = jax.vmap(jax.value_and_grad(log_prob, argnums=(0, 4, 5)), in_axes=(0, 0, 0, 0, None, None))
        values, grads = jax.tree.map(np.asarray, jax.jit(over)(*cases, folded(), jnp.zeros(3, dtype)))
        assert values.dtype == dtype
        assert (np.isfinite(values) | np.isneginf(values)).all()
        for grad in jax.tree.leaves(grads):
            assert not np.isnan(grad).any()
            assert (grad[np.isneginf(values)] == 0).all()
        # On the ridge nothing is far away: the log-density is representable at every tau.
        assert np.isfinite(values[np.asarray(cases[3]) == 0]).all()


def test_gradient_is_clipped_where_it_overflows():
    at = Gaussian(jnp.zeros(2), jnp.eye(2), log_scale=-49.0)
    # 1e-3 e^98 is beyond float32, the density is not.
    log_prob, grad = jax.jit(jax.value_and_grad(Gaussian.log_prob, argnums=1))(at, jnp.array([1e-3, -1e-4]))
    assert np.isfinite(log_prob)
    limit = np.float32(steepest(jnp.float32))
    np.testing.assert_allclose(grad, [-limit, limit], rtol=1e-6)


def test_far_points_do_not_spoil_a_networks_gradient():
    network = CallableFold(eqx.nn.MLP("scalar", 1, 4, 1, key=jax.random.key(0)))
    dist = FoldedGaussian([0.0], [[1.0]], time_loc=0.0, time_scale=1.0, fold=network)
    t = np.array([0.3, 14.0], np.float32)
    s = np.asarray(jax.jit(lambda dist: dist.condition_time(t).loc)(dist)) + np.array([[0.1], [1e-9]], np.float32)
    x = np.concatenate([s, t[:, None]], -1)
    for leaf in jax.tree.leaves(jax.jit(jax.grad(lambda d, x: d.log_prob(x).sum()))(dist, x)):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("changes", [{}, pytest.param({"fold": ZeroFold(2)}, marks=pytest.mark.slow)])
def test_absurd_times_are_minus_infinity(changes):
    both = jax.jit(jax.vmap(jax.value_and_grad(FoldedGaussian.log_prob, argnums=(0, 1)), in_axes=(None, 0)))
    x = jnp.array([[0.0, 1.0, t] for t in (1e20, -1e30, 3e38, 1e10)])
    one = PolynomialFold([[0.0, 0.0], [1e30, 0.0]])  # at 1e10 it overflows in one coordinate
    for dist in (folded(**changes), folded(fold=one)):
        values, grads = both(dist, x)
        assert np.isneginf(values).all()
        assert all((np.asarray(g) == 0).all() for g in jax.tree.leaves(grads))


def test_nan_in_nan_out():
    assert np.isnan(LOG_PROB(folded(), jnp.array([0.0, jnp.nan, 0.3])))
    assert np.isnan(LOG_PROB(folded(), jnp.array([0.0, 0.0, jnp.nan])))
    for changes in ({"loc": jnp.array([0.0, jnp.nan])}, {"time_scale": jnp.nan}):
        assert np.isnan(LOG_PROB(folded(**changes, validate_args=False), jnp.zeros(3)))


def test_an_envelope_of_minus_infinity_is_no_nan():
    class Nothing(AbstractEnvelope):
        def log_a(self, t, *, time_loc, time_scale):
            return jnp.where(jnp.abs(t - time_loc) < jnp.inf, -jnp.inf, jnp.zeros_like(t))

    dist = folded(envelope=Nothing())
    assert np.isneginf(LOG_PROB(dist, jnp.array([1.0, 1.0, 0.0])))
    assert np.isfinite(LOG_PROB(dist, jnp.append(dist.loc, dist.time_loc)))  # on the ridge


# --- transformations and batches --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"loc": jnp.zeros((5, 2))},
        {"scale_tril": jnp.broadcast_to(jnp.eye(2), (5, 2, 2))},
        {"time_loc": jnp.zeros(5)},
        {"time_scale": jnp.ones(5)},
        {"fold": PolynomialFold(jnp.ones((5, 3, 2)))},
        {"envelope": TimeLikelihood(jnp.ones(5))},
        {"loc": jnp.zeros((5, 1, 2)), "time_loc": jnp.zeros(3)},
    ],
)
def test_any_parameter_may_carry_the_batch(changes):
    dist = folded(**changes, validate_args=False)
    batch = (5, 3) if len(changes) == 2 else (5,)
    shape = lambda call: jax.eval_shape(call).shape  # noqa: E731
    key = jax.random.key(0)
    assert dist.batch_shape == batch
    assert all(leaf.shape[: len(batch)] == batch for leaf in jax.tree.leaves(dist))  # slices are distributions
    assert shape(lambda: dist.log_prob(jnp.zeros(3))) == batch
    assert shape(lambda: dist.sample(key, (2,))) == (2, *batch, 3)
    assert jax.eval_shape(lambda: dist.condition_time(0.1)).batch_shape == batch
    assert shape(lambda: dist.condition_time(0.1).sample(key)) == (*batch, 2)


def test_batch_shape_is_true_under_vmap():
    make = lambda loc, time_loc: folded(loc=loc, time_loc=time_loc)  # noqa: E731
    mapped = jax.vmap(make)(jnp.zeros((6, 4, 2)), jnp.linspace(0.0, 1.0, 6))  # inner batch 4 in loc alone
    assert mapped.batch_shape == (6, 4)
    assert jax.vmap(jax.vmap(make))(jnp.zeros((7, 6, 2)), jnp.zeros((7, 6))).batch_shape == (7, 6)
    x = jax.random.normal(jax.random.key(0), (6, 4, 3))
    times = np.linspace(0.0, 1.0, 6, dtype=np.float32)
    loop = [LOG_PROB(make(jnp.zeros((4, 2)), m), v) for m, v in zip(times, np.asarray(x), strict=True)]
    _close(LOG_PROB(mapped, x), loop, 1e-5)
    inside = []
    jax.vmap(lambda d: inside.append(d.batch_shape))(_batched((3, 4)))
    assert inside == [(4,)]


def test_empty_batches():
    dist = _batched((0,))
    assert LOG_PROB(dist, jnp.zeros((0, 3))).shape == (0,)
    assert jax.eval_shape(lambda: dist.condition_time(0.2).covariance_matrix).shape == (0, 2, 2)
    assert jax.jit(lambda d: d.sample(jax.random.key(0), (0,)))(folded()).shape == (0, 3)


@pytest.mark.parametrize("dist", [_batched((5,)), folded(), folded(1, fold=CallableFold(_column))])
def test_round_trips(dist):
    x = jnp.full(dist.event_shape, 0.2)
    leaves, treedef = jax.tree.flatten(dist)
    np.testing.assert_array_equal(LOG_PROB(jax.tree.unflatten(treedef, leaves), x), LOG_PROB(dist, x))
    np.testing.assert_array_equal(LOG_PROB(pickle.loads(pickle.dumps(dist)), x), LOG_PROB(dist, x))
    assert jax.tree.structure(jax.tree.unflatten(treedef, [object()] * len(leaves))) == treedef
    assert len(leaves) == len(dist.leaf_ranks)


@pytest.mark.parametrize("call", [lambda d: d.log_prob(jnp.zeros(3)), lambda d: d.condition_time(0.3)])
def test_compiles_once(call):
    traces = []

    @jax.jit
    def counted(dist):
        traces.append(1)
        return call(dist)

    for key in range(3):
        jax.block_until_ready(counted(_batched((5,), key)))
    assert len(traces) == 1


def test_callables_are_folds():
    slope = jnp.array([0.5, -1.0])

    def log_prob(slope):
        return folded(fold=lambda u: slope * u).log_prob(jnp.array([0.1, 0.2, 0.6]))

    def polynomial(slope):
        return folded(fold=PolynomialFold(slope[None])).log_prob(jnp.array([0.1, 0.2, 0.6]))

    both = [jax.jit(lambda s, f=f: (f(s), jax.grad(f)(s), jax.hessian(f)(s)))(slope) for f in (log_prob, polynomial)]
    jax.tree.map(lambda a, b: _close(a, b, 1e-5), *both)  # derivatives also through a closure
    network = eqx.nn.MLP("scalar", 2, 4, 1, key=jax.random.key(0))
    dist = folded(fold=network)
    assert jax.jit(lambda d: d.log_prob(jnp.zeros(3)))(dist).shape == ()
    copies = [leaf.shape[0] for leaf in jax.tree.leaves(folded(fold=network, loc=jnp.zeros((3, 2))).fold)]
    assert set(copies) == {1}  # parameters of a callable are not copied for each component
    stack = jax.jit(jax.vmap(lambda loc: folded(fold=network, loc=loc)))(jnp.zeros((3, 2)))
    alone = LOG_PROB(folded(fold=network, loc=jnp.zeros(2)), jnp.zeros(3))
    _close(LOG_PROB(stack, jnp.zeros(3)), jnp.full(3, alone), 1e-5)


def test_callables_are_envelopes():
    x = jnp.array([0.1, 0.2, 0.6])
    expected = LOG_PROB(folded(), x)
    log_a = lambda t, m, scale: -0.5 * ((t - m) / scale) ** 2  # noqa: E731
    _close(LOG_PROB(folded(envelope=log_a), x), expected, 1e-6)
    _close(LOG_PROB(folded(envelope=plain_envelope(lambda *args: jnp.exp(log_a(*args)))), x), expected, 1e-5)


def test_degree_zero_and_none_are_the_zero_fold():
    x = jax.random.normal(jax.random.key(0), (4, 3))
    plain = LOG_PROB(folded(fold=ZeroFold(2)), x)
    np.testing.assert_array_equal(LOG_PROB(folded(fold=PolynomialFold(jnp.zeros((0, 2)))), x), plain)
    default = FoldedGaussian(LOC[:2], TRIL[:2, :2], time_loc=0.4, time_scale=0.3)
    np.testing.assert_array_equal(LOG_PROB(default, x), plain)
    assert isinstance(default.fold, ZeroFold)
    assert default.envelope.power == 1  # the paper's text


def test_dtype_follows_the_arrays():
    assert FoldedGaussian([0], [[1]], time_loc=0, time_scale=1).loc.dtype == jnp.float32
    with jax.enable_x64(True):
        assert FoldedGaussian([0], [[1]], time_loc=0, time_scale=1).time_loc.dtype == jnp.float64
        single = FoldedGaussian(
            np.zeros(1, np.float32), [[1]], time_loc=0.5, time_scale=1, fold=PolynomialFold([[1.0]])
        )
        assert jax.eval_shape(lambda: single.log_prob([0.0, 0.0])).dtype == jnp.float32
        assert jax.eval_shape(single.sample, jax.random.key(0)).dtype == jnp.float32
    assert FoldedGaussian(np.zeros(1), [[1.0]], time_loc=0.0, time_scale=1.0).loc.dtype == jnp.float32  # no x64


# --- doors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"time_scale": 0.0}, "time_scale"),
        ({"time_scale": jnp.array([1.0, -1.0])}, "time_scale"),
        ({"scale_tril": jnp.ones((2, 2))}, "scale_tril"),
        ({"scale_tril": jnp.diag(jnp.array([1.0, -1.0]))}, "scale_tril"),
        ({"scale_tril": jnp.eye(3)}, "scale_tril"),
        ({"scale_tril": None}, "scale_tril, covariance_matrix, precision_matrix, scale"),
        (
            {"scale_tril": jnp.eye(2), "covariance_matrix": jnp.eye(2)},
            "scale_tril, covariance_matrix, precision_matrix, scale",
        ),
        ({"scale_tril": None, "covariance_matrix": jnp.eye(3)}, "covariance_matrix"),
        ({"scale_tril": None, "covariance_matrix": jnp.array([[1.0, 0.5], [0.0, 1.0]])}, "covariance_matrix"),
        ({"scale_tril": None, "covariance_matrix": jnp.array([[1.0, 2.0], [2.0, 1.0]])}, "covariance_matrix"),
        ({"scale_tril": None, "precision_matrix": jnp.eye(3)}, "precision_matrix"),
        ({"scale_tril": None, "precision_matrix": jnp.array([[1.0, 2.0], [2.0, 1.0]])}, "precision_matrix"),
        ({"scale_tril": None, "scale": jnp.ones(3)}, "scale"),
        ({"scale_tril": None, "scale": jnp.array([1.0, 0.0])}, "scale"),
        ({"loc": 0.0}, "loc"),
        ({"loc": jnp.zeros((3, 2)), "time_loc": jnp.zeros(4)}, "batch"),
        ({"fold": PolynomialFold(jnp.ones((3, 1)))}, "fold"),
        ({"fold": lambda u: u}, "fold"),
        ({"fold": 3}, "fold"),
        ({"fold": [[0.1, 0.2]]}, "fold"),
        ({"fold": lambda u, v: u}, "fold"),
        ({"envelope": "time"}, "envelope"),
        ({"envelope": TimeLikelihood}, "envelope"),
        ({"envelope": lambda t: -t}, "envelope"),
    ],
)
def test_bad_input_names_the_parameter(changes, name):
    with pytest.raises(ValueError, match=f"^{name}: expected .*, got "):
        folded(**changes)


PATH = {"anchor": [0.0], "time_loc": 0.5, "index": 1, "times": [[0.0, 1.0]], "matrices": [[[[1.0, 0.0]], [[2.0, 0.0]]]]}
#: Every parameter of every public class, by a function that constructs the class with this value in it.
NUMBERS = {
    "loc": [
        lambda x: folded(loc=[0.0, x]),
        lambda x: Gaussian([0.0, x], jnp.eye(2)),
    ],
    "scale_tril": [
        lambda x: folded(scale_tril=[[1.0, 0.0], [x, 1.0]]),
        lambda x: folded(scale_tril=[[1.0, 0.0], [0.0, x]]),
        lambda x: Gaussian([0.0, 1.0], [[1.0, 0.0], [x, 1.0]]),
    ],
    "covariance_matrix": [lambda x: folded(scale_tril=None, covariance_matrix=[[x, 0.0], [0.0, 1.0]])],
    "precision_matrix": [lambda x: folded(scale_tril=None, precision_matrix=[[1.0, x], [x, 1.0]])],
    "scale": [lambda x: folded(scale_tril=None, scale=[x, 1.0])],
    "log_scale": [lambda x: Gaussian([0.0], [[1.0]], log_scale=x)],
    "time_loc": [lambda x: folded(time_loc=x), lambda x: SharedPathFold(ZeroFold(1), **(PATH | {"time_loc": x}))],
    "time_scale": [lambda x: folded(time_scale=x)],
    "weights": [lambda x: FoldedMixture(_batch(), weights=[1.0, x])],
    "logits": [
        lambda x: FoldedMixture(_batch(), logits=[0.0, abs(x)]),
        lambda x: Mixture(_batch().condition_time(0.2), logits=[0.0, abs(x)]),
    ],
    "coefficients": [
        lambda x: PolynomialFold([[0.1], [x]]),
        lambda x: SplineFold([-1, -1, 0, 1, 1], [[2.0], [x], [1.0]], degree=1),
    ],
    "knots": [lambda x: SplineFold([-1, -1, 0, 1, x], [[2.0], [0.0], [1.0]], degree=1)],
    "sine": [lambda x: FourierFold([[x]], [[0.0]], period=1.0)],
    "cosine": [lambda x: FourierFold([[0.0]], [[x]], period=1.0)],
    "period": [lambda x: FourierFold([[1.0]], [[1.0]], period=x)],
    "anchor": [lambda x: SharedPathFold(ZeroFold(1), **(PATH | {"anchor": [x]}))],
    "times": [lambda x: SharedPathFold(ZeroFold(1), **(PATH | {"times": [[0.0, x]]}))],
    "matrices": [lambda x: SharedPathFold(ZeroFold(1), **(PATH | {"matrices": [[[[x, 0.0]], [[1.0, 0.0]]]]}))],
    "power": [lambda x: TimeLikelihood(power=x)],
    "floor": [lambda x: TimeLikelihood(floor=x)],
}


def _batch():
    return folded(loc=jnp.zeros((2, 2)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", NUMBERS)
def test_parameters_that_are_not_finite_are_refused(name, value):
    for make in NUMBERS[name]:
        with pytest.raises(ValueError, match=f"^{name}: expected .*, got "):
            make(value)


def test_values_are_not_looked_at_under_tracing_or_on_request():
    jax.eval_shape(lambda scale: folded(time_scale=scale).log_prob(jnp.zeros(3)), -1.0)
    own = lambda t, m, scale: jnp.exp(-jnp.abs(t - m) / scale)  # noqa: E731
    jax.eval_shape(lambda scale: folded(time_scale=scale, envelope=own).log_prob(jnp.zeros(3)), 1.0)
    broken = folded(time_scale=-1.0, loc=jnp.full(2, jnp.nan), envelope=own, validate_args=False)
    assert np.isnan(broken.condition_time(0.3).loc).all()
    assert np.isnan(broken.marginal([0, -1]).loc).all()
    assert broken.marginal([-1]).loc == jnp.float32(0.4)


def test_a_function_that_returns_a_instead_of_its_logarithm_is_refused():
    class Plain(AbstractEnvelope):
        def log_a(self, t, *, time_loc, time_scale):
            return jnp.exp(-jnp.abs(t - time_loc) / time_scale)

    plain = lambda t, m, scale: 1 / (1 + ((t - m) / scale) ** 2)  # noqa: E731
    for envelope in (plain, CallableEnvelope(plain), Plain()):
        told = r"^envelope: expected log a <= 0 at time_loc, got 1\.0 at index \(0,\)\. .*plain_env"
        with pytest.raises(ValueError, match=told):
            folded(envelope=envelope, time_loc=jnp.array([0.1, 5.0]))
    rounded = lambda t, m, scale: 1e-6 - jnp.abs(t - m)  # noqa: E731
    for envelope in (plain_envelope(plain), rounded, lambda t, m, scale: -jnp.abs(t - m), lambda t, m, scale: -jnp.inf):
        folded(envelope=envelope)


def test_a_number_is_the_value_of_a_single_coordinate():
    dist, mixture = folded(), FoldedMixture(_batch(), logits=[0.0, 0.0])
    for one in (dist.condition_time(0.2), mixture.condition_time(0.2)):
        for index in (0, -1):
            assert jax.eval_shape(partial(one.condition, index), 0.2).batch_shape == ()
    for one in (dist, mixture):
        assert jax.eval_shape(partial(one.condition, -1), 0.2).batch_shape == ()
    for one in (dist.marginal(-1), mixture.marginal(-1), mixture.condition_time(0.2).marginal(1)):
        assert jax.eval_shape(one.log_prob, 0.2).shape == ()
    np.testing.assert_array_equal(mixture.marginal(-1).cdf(0.2), mixture.marginal(-1).cdf([0.2]))
    with pytest.raises(ValueError, match=r"^value: expected shape \(\*batch, 3\), got shape \(\)"):
        dist.log_prob(0.2)


@pytest.mark.slow  # an integral is traced for seconds
def test_a_number_is_the_value_of_a_single_coordinate_of_an_integral():
    lines = FoldedMixture(FoldedGaussian([[0.0]], [[1.0]], time_loc=0.5, time_scale=1.0), logits=[0.0])
    given = FoldedMixture(_batch(), logits=[0.0, 0.0]).marginal([0, 1]).condition
    for call in (partial(folded().condition, 0), partial(given, 0), lines.time_given_space):
        assert jax.eval_shape(call, 0.2).batch_shape == ()
    assert jax.eval_shape(lines.marginal(0).log_prob, 0.2).shape == ()
