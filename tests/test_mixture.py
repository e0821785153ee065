"""Mixtures of Folded-Gaussians: against scipy, their own components, quadrature and samples; zero weights; far out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from foldgauss import mixture as mixture_module
from foldgauss.analysis.conditional import TimeMixture
from foldgauss.distribution import FoldedGaussian, Gaussian
from foldgauss.envelope import CallableEnvelope, Constant, TimeLikelihood
from foldgauss.fold import CallableFold, FourierFold, PolynomialFold, SplineFold, ZeroFold
from foldgauss.mixture import FoldedMixture, Mixture

WEIGHTS = [0.5, 0.2, 0.3]
TRIL = [[[0.3, 0.0], [0.1, 0.2]], [[0.2, 0.0], [-0.1, 0.4]], [[0.25, 0.0], [0.0, 0.3]]]
#: Standard errors that a statistic may be off: false alarms are one in 500 million.
ALARM = 6


def _components(**changes):
    parameters = {
        "loc": [[0.1, -0.4], [-0.5, 0.3], [0.6, 0.2]],
        "scale_tril": TRIL,
        "time_loc": [0.2, 0.5, 0.9],
        "time_scale": [0.3, 0.2, 0.4],
        "fold": PolynomialFold(np.random.default_rng(0).normal(size=(3, 2, 2))),
        "envelope": TimeLikelihood(power=1.0),
    }
    return FoldedGaussian(**(parameters | changes))


def _mixture(**changes):
    return FoldedMixture(_components(**changes), weights=WEIGHTS)


def _points(n):
    """Points about the components, by NumPy: nothing compiles."""
    return jnp.asarray(np.random.default_rng(1).normal([0, 0, 0.5], [0.6, 0.6, 0.3], (n, 3)))


# Most of a test's time would be compilation: densities and gradients are those of 8 or 40 points, draws are 200,000.
DRAWS = 200_000
OWN_LOG_PROB = eqx.filter_jit(lambda components, x: components.log_prob(x[:, None]))
GRADIENT = eqx.filter_jit(jax.grad(lambda parts: parts[0].log_prob(parts[1]).sum()))


def _naive_log_prob(mixture, x):
    """The definition, of the components' own densities."""
    with jax.numpy_rank_promotion("allow"):
        return jax.scipy.special.logsumexp(mixture.components.log_prob(x[..., None, :]) + mixture.log_weights, axis=-1)


# --- oracles -------------------------------------------------------------------------------------------------


def test_a_mixture_that_does_not_bend_is_scipys(x64):
    components = _components(fold=ZeroFold(2), envelope=Constant())
    mixture = FoldedMixture(components, weights=WEIGHTS)
    means = np.c_[components.loc, components.time_loc]
    covariances = np.zeros((3, 3, 3))
    covariances[:, :2, :2] = np.asarray(TRIL) @ np.swapaxes(TRIL, -1, -2)
    covariances[:, 2, 2] = np.asarray(components.time_scale) ** 2
    twins = [stats.multivariate_normal(m, c) for m, c in zip(means, covariances, strict=True)]
    x = np.random.default_rng(0).normal(size=(50, 3))
    density = sum(w * twin.pdf(x) for w, twin in zip(WEIGHTS, twins, strict=True))
    np.testing.assert_allclose(mixture.log_prob(x), np.log(density), rtol=1e-12)
    np.testing.assert_allclose(mixture.pdf(x), density, rtol=1e-12)
    shares = np.stack([w * twin.pdf(x) / density for w, twin in zip(WEIGHTS, twins, strict=True)], -1)
    np.testing.assert_allclose(mixture.responsibilities(x), shares, atol=1e-13)
    mean = np.asarray(WEIGHTS) @ means
    between = np.einsum("k,ki,kj->ij", WEIGHTS, means - mean, means - mean)
    expected = np.tensordot(WEIGHTS, covariances, 1) + between
    np.testing.assert_allclose(mixture.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(mixture.covariance_matrix, expected, rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(mixture.stddev, np.sqrt(np.diag(expected)), rtol=1e-11)
    # And at one time, with Bayes' rule by scipy.
    at = mixture.condition_time(0.3)
    weights = WEIGHTS * stats.norm.pdf(0.3, means[:, 2], np.asarray(components.time_scale))
    np.testing.assert_allclose(at.weights, weights / weights.sum(), rtol=1e-12)
    weights = weights / weights.sum()
    center = weights @ means[:, :2]
    np.testing.assert_allclose(mixture.condition_time(0.3).mean, center, rtol=1e-12)
    between = np.einsum("k,ki,kj->ij", weights, means[:, :2] - center, means[:, :2] - center)
    expected = np.tensordot(weights, covariances[:, :2, :2], 1) + between
    np.testing.assert_allclose(mixture.condition_time(0.3).covariance_matrix, expected, rtol=1e-11)


KINDS = {
    "floor": {"envelope": TimeLikelihood(power=2.0, floor=1e-3)},
    "plain": {"envelope": TimeLikelihood(power=1.0)},
    "own envelope": {"envelope": CallableEnvelope(lambda t, m, scale: -jnp.abs((t - m) / scale))},
    "own fold": {"fold": CallableFold(lambda u: jnp.stack([jnp.sin(u), u]))},
    "spline": {"fold": SplineFold(np.linspace(-2, 2, 9), np.random.default_rng(2).normal(size=(5, 2)))},
    "fourier": {"fold": FourierFold(*np.random.default_rng(3).normal(size=(2, 2, 2)), period=1.0)},
}


def _kinds():
    return [pytest.param(kind, marks=[] if kind == "spline" else pytest.mark.slow) for kind in KINDS]


@pytest.mark.parametrize("kind", _kinds())
def test_pairs_agree_with_the_components_own_densities(kind, x64):
    mixture = _mixture(**KINDS[kind])
    x = _points(40)
    own = np.asarray(OWN_LOG_PROB(mixture.components, x))
    np.testing.assert_allclose(mixture.component_log_prob(x), own, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(mixture.log_prob(x), special.logsumexp(own + np.log(WEIGHTS), axis=-1), rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
@pytest.mark.parametrize("floor", [0.0, 1e-3])
def test_pairs_agree_far_out_and_where_nothing_is_a_number(dtype, floor):
    with jax.enable_x64(dtype == np.float64):
        cast = lambda *x: [jnp.asarray(y, dtype) for y in x]  # noqa: E731
        loc, tril, time_loc, time_scale = cast([[0.1, -0.4], [1e4, 1e4]], TRIL[:2], [0.2, 0.5], [0.3, 1e-3])
        fold = PolynomialFold(jnp.ones((2, 2, 2), dtype))
        envelope = TimeLikelihood(2.0, floor)
        components = FoldedGaussian(loc, tril, time_loc=time_loc, time_scale=time_scale, fold=fold, envelope=envelope)
        mixture = FoldedMixture(components, weights=jnp.asarray([0.5, 0.5], dtype))
        ends = [0.0, 0.2, 0.51, 5.0, 1e4, -1e19, 1e30, float(jnp.finfo(dtype).max), np.inf, np.nan]
        s, t = (grid.ravel() for grid in np.meshgrid(ends, ends))
        x = jnp.asarray(np.stack([s, s, t], -1), dtype)
        pairs, own = (np.asarray(z) for z in (mixture.component_log_prob(x), OWN_LOG_PROB(components, x)))
    has_nan = np.isnan(x).any(-1)
    assert np.isnan(pairs[has_nan]).all()
    pairs, own = pairs[~has_nan], own[~has_nan]
    assert not np.isnan(pairs).any()
    np.testing.assert_array_equal(np.isneginf(pairs), np.isneginf(own))
    assert not np.isposinf(pairs).any()
    finite = np.isfinite(own)
    np.testing.assert_allclose(pairs[finite], own[finite], rtol=100 * np.finfo(dtype).eps)


def test_chunks_change_nothing(monkeypatch):
    mixture = _mixture()
    x = _points(40)
    whole = mixture.log_prob(x), mixture.responsibilities(x)
    monkeypatch.setattr(mixture_module, "_CHUNK", 3 * 16)
    x = jnp.concatenate([x, x[:1]])  # another shape: the programs above are not found again
    np.testing.assert_allclose(mixture.log_prob(x)[:40], whole[0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(mixture.responsibilities(x)[:40], whole[1], rtol=1e-5, atol=1e-6)


def test_chunks_hold_few_pairs_of_point_and_component(monkeypatch):
    seen = []

    def chunks(pairs, function, rows, size):
        seen.append(size)
        return function(pairs(rows))

    monkeypatch.setattr(mixture_module, "map_in_chunks", chunks)
    for pairs, num in ((100, 39), (2, 38)):  # other shapes: each is traced
        monkeypatch.setattr(mixture_module, "_CHUNK", pairs)
        jax.eval_shape(_mixture().log_prob, jax.ShapeDtypeStruct((num, 3), jnp.float32))
    assert seen == [100 // 3, 1]


# --- normalisation, draws and moments, each with what would be seen to be wrong ------------------------------


@pytest.fixture(scope="module")
def drawn():
    x, component = _mixture().sample(jax.random.key(0), (DRAWS,), return_component=True)
    return np.asarray(x), np.asarray(component)


def _deviations(draws, mean):
    """How many standard errors the draws' average is off, the largest of all coordinates."""
    draws = np.asarray(draws, np.float64)
    return np.abs((draws.mean(0) - np.asarray(mean)) / (draws.std(0) / np.sqrt(len(draws)))).max()


def test_draws_have_the_moments_and_the_weights(drawn):
    mixture, (x, component) = _mixture(), drawn
    assert not mixture.has_rsample
    assert x.shape == (DRAWS, 3)
    assert component.shape == (DRAWS,)
    one_hot = component[:, None] == np.arange(3)
    assert _deviations(one_hot, WEIGHTS) < ALARM
    assert _deviations(x, mixture.mean) < ALARM
    centered = x - np.asarray(mixture.mean)
    products = centered[:, :, None] * centered[:, None, :]
    assert _deviations(products, mixture.covariance_matrix) < ALARM
    # Power: without the centers' own spread the covariance is seen to be wrong, without weights the mean.
    within = np.tensordot(WEIGHTS, mixture.components.covariance_matrix, 1)
    assert _deviations(products, within) > ALARM
    assert _deviations(x, np.asarray(mixture.components.mean).mean(0)) > ALARM
    # Draws are of the component that is named.
    own = x[component == 1]
    assert _deviations(own, mixture.components.mean[1]) < ALARM
    np.testing.assert_array_equal(mixture.sample(jax.random.key(0), (DRAWS,)), x)


# --- parts: a joint is a marginal times a conditional ---------------------------------------------------------


_LONG = [pytest.param(given, marks=pytest.mark.slow, id=str(given)) for given in ([2, 1], [0], [1, 0])]


@pytest.mark.parametrize("given", [[0, 2], *_LONG])
def test_joint_is_marginal_times_conditional(given, x64):
    mixture = _mixture(envelope=TimeLikelihood(1.0, 0.05))
    x = _points(6)
    rest = [i for i in range(3) if i not in given]
    order = sorted(given)

    @eqx.filter_jit
    def log_prob_by_parts(mixture, x):
        first, then = mixture.marginal(order), mixture.condition(given, x[:, np.array(given)])
        assert isinstance(then.components, Gaussian if 2 in given else TimeMixture)
        stale = eqx.tree_at(lambda part: part.logits, then, jnp.broadcast_to(mixture.log_weights, then.logits.shape))
        at_first = first.log_prob(x[:, np.array(order)])
        return [at_first + part.log_prob(x[:, np.array(rest)]) for part in (then, stale)]

    log_joint, wrong = log_prob_by_parts(mixture, x)
    tolerance = 1e-10 if 2 in given else 1e-6
    np.testing.assert_allclose(log_joint, mixture.log_prob(x), rtol=tolerance, atol=tolerance)
    # Power: with the weights that were, not those that follow what is given, it fails.
    assert np.abs(wrong - mixture.log_prob(x)).max() > 1e-2


@pytest.mark.slow
def test_marginals_and_conditionals_know_their_own(x64):
    mixture = _mixture(envelope=TimeLikelihood(1.0, 0.05))
    x = _points(4)
    plane = mixture.marginal([1, -1])
    assert isinstance(plane, FoldedMixture)
    assert plane.event_shape == (2,)
    space = mixture.marginal([0, 1])
    assert isinstance(space.components, TimeMixture)
    np.testing.assert_allclose(space.mean, mixture.mean[:2], rtol=1e-7)
    np.testing.assert_allclose(space.covariance_matrix, mixture.covariance_matrix[:2, :2], rtol=1e-6)
    # Integrals over time, by a plain sum.
    t = np.linspace(-2, 3, 4001)
    joint = mixture.pdf(np.concatenate([np.broadcast_to(x[0, :2], (4001, 2)), t[:, None]], -1))
    np.testing.assert_allclose(space.pdf(x[0, :2]), np.asarray(joint).sum() * (t[1] - t[0]), rtol=1e-7)
    assert space.error_estimate(x[0, :2]) < 1e-6
    line = mixture.marginal([0])
    assert 0 < line.cdf(jnp.array([0.1])) < 1
    np.testing.assert_allclose(
        jax.grad(lambda s: line.cdf(s).sum())(jnp.array([0.1])), line.pdf(jnp.array([0.1]))[None], rtol=1e-5
    )


def test_a_mixture_of_mixtures_is_one_of_all_their_components():
    rng, weights = np.random.default_rng(0), np.array([[0.2, 0.3, 0.5], [0.6, 0.3, 0.1]])
    loc, tril = rng.normal(size=(6, 2)), np.broadcast_to(0.5 * np.eye(2), (6, 2, 2))
    flat = Mixture(Gaussian(loc, tril), weights=(weights * [[0.25], [0.75]]).ravel())
    inner = Mixture(Gaussian(loc.reshape(2, 3, 2), tril.reshape(2, 3, 2, 2)), weights=weights)
    outer, x = Mixture(inner, weights=[0.25, 0.75]), rng.normal(size=(8, 2)).astype(np.float32)
    np.testing.assert_allclose(outer.log_prob(x), flat.log_prob(x), rtol=1e-5)
    np.testing.assert_allclose(outer.covariance_matrix, flat.covariance_matrix, rtol=1e-5)
    given = [one.condition([0], [0.3]).log_prob(x[:, 1:]) for one in (outer, flat)]
    np.testing.assert_allclose(*given, rtol=1e-5)
    draws = outer.sample(jax.random.key(0), (20_000,))
    error = jnp.sqrt(flat.variance / len(draws))
    assert (jnp.abs(draws.mean(0) - flat.mean) < ALARM * error).all()


def test_one_point_of_space_has_the_density_of_its_components():
    line, s = _mixture().marginal([0]), jnp.array([0.2])
    expected = special.logsumexp(line.components.log_prob(s) + np.log(WEIGHTS))
    np.testing.assert_allclose(line.log_prob(s), expected, rtol=1e-5)


# --- weights of zero, and points far away ---------------------------------------------------------------------


def test_cdf_where_standard_deviations_underflow():
    """A step at the center: one half there, not 0 / 0; flat elsewhere."""

    def far(log_scale):
        components = FoldedGaussian([[0.5]], [jnp.exp(log_scale)], time_loc=[0.0], time_scale=1.0, validate_args=False)
        return FoldedMixture(components, weights=[1.0], validate_args=False).condition_time(20.0)

    log_scale = jnp.log(jnp.array([0.2]))
    assert (far(log_scale).components.stddev == 0).all()
    np.testing.assert_array_equal(far(log_scale).cdf(jnp.array([[0.4], [0.5], [0.6]])), [0, 0.5, 1])
    slope = jax.jit(jax.jacobian(lambda log_scale: far(log_scale).cdf(jnp.array([[0.4], [0.6]]))))(log_scale)
    np.testing.assert_array_equal(slope, np.zeros((2, 1)))


def test_a_mean_whose_components_are_too_far_apart():
    """Their difference exceeds float32."""
    apart = Mixture(Gaussian([[3e38], [-3e38]], np.ones((2, 1, 1), np.float32)), weights=[0.9, 0.1])
    np.testing.assert_allclose(apart.mean, [2.4e38], rtol=1e-6)


def test_the_mean_is_infinite_where_a_fold_overflows():
    """At t = 1e20 the widest component has all the weight; its fold, of degree 3, exceeds float32."""
    components = _components(fold=PolynomialFold(np.ones((3, 3, 2), np.float32)))
    mean = FoldedMixture(components, weights=WEIGHTS).condition_time(jnp.array([-1e20, 1e20], jnp.float32)).mean
    np.testing.assert_array_equal(mean, [[np.inf, np.inf], [-np.inf, -np.inf]])


def test_cdf_and_quantiles_of_a_gaussian_mixture(x64):
    weights, loc, scale = (
        np.array([0.3, 0.0, 0.7]),
        np.array([[-1.0, 50.0, 2.0], [0.0, 0.0, 0.0]]),
        np.array([0.5, 1.0, 2]),
    )
    one = Mixture(Gaussian(loc[..., None], scale[:, None, None] * np.eye(1)), weights=np.stack([weights] * 2))
    x = np.linspace(-4.0, 6.0, 21)
    expected = (weights * stats.norm.cdf(x[:, None, None], loc, scale)).sum(-1)
    np.testing.assert_allclose(one.cdf(jnp.asarray(x)[:, None, None]), expected, rtol=1e-12)
    levels = np.array([1e-6, 0.2, 0.5, 0.999])[:, None]
    quantiles = one.icdf(levels)
    assert quantiles.shape == (4, 2, 1)
    np.testing.assert_allclose(one.cdf(quantiles), np.broadcast_to(levels, (4, 2)), rtol=3e-14)
    assert np.isneginf(one.icdf(0.0)).all()
    # Between components far apart the quantile is 0 to 1e-15, not to the distance divided by 2^60.
    far = Mixture(Gaussian(np.array([[0.0], [1e30]]), np.ones((2, 1, 1))), weights=[0.5, 0.5])
    np.testing.assert_allclose(far.icdf(jnp.array([0.25, 0.75]))[:, 0], [0, 1e30], rtol=1e-15, atol=1e-15)
    half = Mixture(one.components, logits=np.log([[np.nan] * 3, [0.3, 0.4, 0.3]]), validate_args=False)
    np.testing.assert_array_equal(np.isnan(half.icdf(0.5)), [[True], [False]])
    pair = Mixture(Gaussian(np.zeros((2, 2)), np.eye(2)), weights=[0.5, 0.5])
    for function in (pair.icdf, lambda _: pair.cdf(jnp.zeros(2))):
        with pytest.raises(ValueError, match="expected a single coordinate"):
            function(0.5)


def test_a_component_without_weight_is_not_there():
    mixture = FoldedMixture(_components(), weights=[0.7, 0.0, 0.3])
    np.testing.assert_allclose(
        FoldedMixture(_components(), logits=[np.log(0.7), -np.inf, np.log(0.3)]).weights, mixture.weights, rtol=1e-6
    )
    np.testing.assert_array_equal(mixture.weights[1], 0)
    others = np.array([0, 2, 2])  # instead of two components, which would compile anew: one in two halves
    fewer = FoldedMixture(jax.tree.map(lambda leaf: leaf[others], mixture.components), weights=[0.7, 0.15, 0.15])
    x = _points(40)
    np.testing.assert_allclose(mixture.log_prob(x), fewer.log_prob(x), rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(mixture.responsibilities(x)[:, 1], 0)
    np.testing.assert_array_equal(mixture.condition_time(0.5).weights[1], 0)
    np.testing.assert_allclose(mixture.mean, fewer.mean, rtol=1e-6)
    np.testing.assert_allclose(mixture.covariance_matrix, fewer.covariance_matrix, rtol=1e-5, atol=1e-7)
    _, component = mixture.sample(jax.random.key(0), (DRAWS,), return_component=True)
    assert not (component == 1).any()
    assert (component == 2).any()
    gradient, _ = GRADIENT((mixture, x[:8]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert all((leaf[1] == 0).all() for leaf in jax.tree.leaves(gradient))
    assert np.abs(gradient.logits[0]) > 1e-3


def test_weights_of_zero_have_finite_gradients():
    components, x = _components(), _points(8)
    by_weights = lambda w: FoldedMixture(components, weights=w).log_prob(x).sum()  # noqa: E731
    gradient = jax.jit(jax.grad(by_weights))(jnp.array([0.7, 0.0, 0.3]))
    assert np.isfinite(gradient).all()
    by_time = lambda w: FoldedMixture(components, weights=w).condition_time(0.4).mean.sum()  # noqa: E731
    assert np.isfinite(jax.jit(jax.grad(by_time))(jnp.array([0.7, 0.0, 0.3]))).all()


def test_nothing_of_a_broken_component_without_weight_is_seen():
    components = _components(loc=[[0.1, -0.4], [np.nan, np.inf], [0.6, 0.2]], validate_args=False)
    mixture = FoldedMixture(components, weights=[0.7, 0.0, 0.3])
    x = jnp.zeros((8, 3))
    assert np.isfinite(mixture.log_prob(x)).all()
    assert np.isfinite(mixture.mean).all()
    np.testing.assert_allclose(mixture.responsibilities(x).sum(-1), 1, rtol=1e-6)
    line = Gaussian([[0.0], [np.nan], [1.0]], np.ones((3, 1, 1), np.float32), validate_args=False)
    np.testing.assert_allclose(Mixture(line, weights=[0.5, 0.0, 0.5]).icdf(0.5), [0.5], rtol=1e-5)
    # Where the distribution function is 0.5 from 6 to 94, the quantile is the least number at which it is.
    line = Gaussian([[0.0], [np.nan], [100.0]], np.ones((3, 1, 1), np.float32), validate_args=False)
    assert 4 < Mixture(line, weights=[0.5, 0.0, 0.5]).icdf(0.5) < 7


def test_far_points_and_offsets():
    mixture = _mixture()
    far = [[1e3, 0.0, 0.5], [0.0, 0.0, 3.0], [1e30, 1e30, 1e30], [0.0, np.inf, 0.0], [0.1, 0.1, -1e25]]
    far = jnp.array([*far, *np.zeros((3, 3))])
    log_p = np.asarray(mixture.log_prob(far))
    assert not np.isnan(log_p).any()
    assert not np.isposinf(log_p).any()
    assert np.isfinite(log_p[:2]).all()
    np.testing.assert_array_equal(log_p[2:4], -np.inf)
    shares = np.asarray(mixture.responsibilities(far))
    np.testing.assert_allclose(shares.sum(-1), 1, rtol=1e-6)
    np.testing.assert_allclose(shares[2], WEIGHTS, rtol=1e-6)
    gradient = GRADIENT((mixture, far))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert np.isnan(mixture.log_prob(jnp.array([np.nan, 0.0, 0.0])))
    for t in (1e3, -1e25, np.inf):
        np.testing.assert_allclose(mixture.condition_time(t).weights.sum(), 1, rtol=1e-6)
    # Far from the origin: the same numbers in float32, where E[x^2] - mu^2 would have no digit left.
    moved = _mixture(loc=np.asarray(_components().loc) + 1e4)
    offset = np.float32([1e4, 1e4, 0])
    x = np.resize(np.asarray(mixture.components.mean, np.float32), (8, 3)) + offset
    there = x - offset  # what is left of the points beside the offset: exact
    np.testing.assert_allclose(moved.log_prob(x), mixture.log_prob(there), atol=0.05)
    np.testing.assert_allclose(moved.covariance_matrix, mixture.covariance_matrix, rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(moved.mean - mixture.mean, [1e4, 1e4, 0], rtol=1e-6, atol=1e-6)


# --- shapes, jit, vmap, dtypes --------------------------------------------------------------------------------


def test_batches_of_mixtures():
    """Weights alone may carry the batch; one set of weights may serve all. Other laws: test_batch_shapes.py."""
    loc = np.random.default_rng(0).normal(size=(4, 3, 2))
    by_weights = FoldedMixture(_components(), logits=np.zeros((7, 3)))
    assert jax.eval_shape(lambda: by_weights.mean).shape == (7, 3)
    mixture = FoldedMixture(_components(loc=loc), logits=np.zeros(3))
    assert mixture.log_weights.shape == (4, 3)
    x = jnp.zeros((8, 4, 3))
    each = jax.jit(jax.vmap(FoldedMixture.log_prob, in_axes=(0, 1), out_axes=1))(mixture, x)
    np.testing.assert_allclose(each, mixture.log_prob(x), rtol=1e-5)


def test_axes_of_size_one_broadcast_with_the_points():
    """Densities of some points at some times: a batch of (5, 1) or (1, 5, 1) and points (7,)."""
    rng = np.random.default_rng(0)
    given = {"loc": rng.normal(size=(3, 2)), "scale_tril": 0.5 * np.eye(2), "time_loc": np.linspace(0, 1, 3)}
    mixture = FoldedMixture(FoldedGaussian(**given, time_scale=0.3), weights=np.ones(3) / 3)
    t, x = jnp.linspace(0, 1, 5), jnp.asarray(rng.normal(size=(2, 1, 5, 7, 2)), jnp.float32)
    each = [mixture.condition_time(one) for one in t]
    for shape in ((5, 1), (1, 5, 1)):
        at_times = mixture.condition_time(t.reshape(shape))
        for method in ("log_prob", "component_log_prob", "responsibilities"):
            found = getattr(at_times, method)(x)
            expected = np.stack([getattr(one, method)(x[:, :, k]) for k, one in enumerate(each)], 2)
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
        assert at_times.pdf(x[0, 0, 0]).shape == np.broadcast_shapes(shape, (7,))


def test_made_and_used_inside_transformations():
    components, x = _components(), _points(8)
    made = jax.jit(jax.vmap(lambda w: FoldedMixture(components, weights=w)))(jnp.array([WEIGHTS, [1.0, 1.0, 1.0]]))
    assert made.batch_shape == (2,)
    np.testing.assert_allclose(made.log_prob(x[:, None])[:, 0], _mixture().log_prob(x), rtol=1e-5)
    count = []

    @jax.jit
    def log_prob(mixture, x):
        count.append(1)
        return mixture.log_prob(x)

    np.testing.assert_allclose(log_prob(_mixture(), x), _mixture().log_prob(x), rtol=1e-5)
    log_prob(FoldedMixture(components, logits=[0.0, 1.0, 2.0]), x)
    assert len(count) == 1


@pytest.mark.parametrize("chunk", [mixture_module._CHUNK, pytest.param(3 * 4, marks=pytest.mark.slow)])
def test_gradients_are_those_of_the_definition(x64, monkeypatch, chunk):
    monkeypatch.setattr(mixture_module, "_CHUNK", chunk)
    mixture = _mixture(envelope=TimeLikelihood(1.0, 0.05))
    x = _points(5)
    of = lambda f: jax.jit(jax.grad(lambda mixture, x: f(mixture, x).sum(), argnums=(0, 1)))(mixture, x)  # noqa: E731
    found, expected = of(FoldedMixture.log_prob), of(_naive_log_prob)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_are_those_of_the_definition(x64):
    mixture = _mixture()
    x = _points(1)[0]
    of = lambda f: jax.jit(jax.hessian(lambda x: f(mixture, x)))(x)  # noqa: E731
    second, expected = of(FoldedMixture.log_prob), of(_naive_log_prob)
    np.testing.assert_allclose(second, expected, rtol=1e-8, atol=1e-8)


def test_float32_and_float64_are_kept():
    assert _mixture().log_prob(jnp.zeros(3)).dtype == jnp.float32
    with jax.enable_x64(True):
        assert _mixture().logits.dtype == jnp.float64
        single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), _components())
        mixture = FoldedMixture(single, weights=WEIGHTS)
        assert mixture.logits.dtype == jnp.float32
        assert mixture.log_prob(np.zeros((2, 3), np.float32)).dtype == jnp.float32


# --- errors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({}, "logits, weights"),
        ({"logits": [0.0] * 3, "weights": WEIGHTS}, "logits, weights"),
        ({"weights": [0.5, 0.5]}, "weights"),
        ({"weights": [0.5, -0.1, 0.6]}, "weights"),
        ({"weights": [0.0, 0.0, 0.0]}, "weights"),
        ({"weights": [np.nan, 0.5, 0.5]}, "weights"),
        ({"weights": [np.inf, 0.5, 0.5]}, "weights"),
        ({"logits": [np.inf, 0.0, 0.0]}, "logits"),
        ({"logits": [-np.inf] * 3}, "logits"),
        ({"logits": 0.0}, "logits"),
    ],
)
def test_wrong_weights_are_named(given, named):
    with pytest.raises(ValueError, match=f"^{named}: expected"):
        FoldedMixture(_components(), **given)


WRONG = {
    "components: Gaussian": lambda: FoldedMixture(Gaussian(np.zeros((3, 2)), np.eye(2)), weights=WEIGHTS),
    "components: one": lambda: FoldedMixture(
        FoldedGaussian([0.0], [[1.0]], time_loc=0.0, time_scale=1.0), weights=[1.0]
    ),
    "components: two times none": lambda: Mixture(Gaussian(np.zeros((2, 0, 1)), np.eye(1)), weights=np.zeros((2, 0))),
    "value: two": lambda: _mixture().log_prob(jnp.zeros(2)),
    "indices: all": lambda: _mixture().condition([0, 1, 2], jnp.zeros(3)),
    "indices: all of space": lambda: _mixture().condition_time(0.3).condition([0, 1], jnp.zeros(2)),
    "indices: none such": lambda: _mixture().marginal([3]),
    "values: too many": lambda: _mixture().condition([0], jnp.zeros(2)),
    "s: three": lambda: _mixture().time_given_space(jnp.zeros(3)),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_named(case):
    with pytest.raises(ValueError, match=f"^{case.split(':')[0]}: expected"):
        WRONG[case]()


# --- bridges --------------------------------------------------------------------------------------------------


def test_draws_are_of_their_component_where_the_fold_is_a_function():
    loc = np.array([[0.0, 1.0], [50.0, 2.0]])
    components = FoldedGaussian(
        loc, scale=np.full((2, 2), 1e-3), time_loc=[0.2, 0.8], time_scale=0.1, fold=lambda u: jnp.stack([u, u**2])
    )
    mixture = FoldedMixture(components, weights=[0.4, 0.6])
    x, component = (np.asarray(z) for z in mixture.sample(jax.random.key(0), (20,), return_component=True))
    assert set(component) == {0, 1}
    u = np.array([0.2, 0.8])[component] - x[:, 2]
    np.testing.assert_allclose(x[:, :2] - loc[component], np.stack([u, u**2], 1), atol=1e-2)


def test_nan_asked_is_nan_answered():
    assert jnp.isnan(_mixture().condition_time(jnp.nan).mean).all()
    assert jnp.isnan(_mixture().condition_time(jnp.nan).covariance_matrix).all()
    assert jnp.isnan(_mixture().condition([2], [jnp.nan]).weights).all()


@pytest.mark.slow
def test_nan_asked_of_time_is_nan_answered():
    mixture = FoldedMixture(
        FoldedGaussian(jnp.zeros((2, 2)), scale=jnp.ones((2, 2)), time_loc=[0.3, 0.7], time_scale=[0.2, 0.1]),
        weights=[0.4, 0.6],
    )

    @jax.jit
    def asked(s):
        when = mixture.time_given_space(s)
        return when.mean, when.cdf(0.5), when.icdf(0.5)

    assert all(np.isnan(answer).all() for answer in asked(jnp.array([0.1, jnp.nan])))
    assert all(np.isfinite(answer).all() for answer in asked(jnp.array([0.1, 0.2])))


def test_weights_that_jax_takes_for_zero_are_refused():
    components = FoldedGaussian([[0.0], [1.0]], scale=[[1.0], [1.0]], time_loc=[0.4, 0.6], time_scale=[0.2, 0.2])
    told = r"weights: expected a positive weight, of at least 1\.17549e-38, got .*divide by"
    with pytest.raises(ValueError, match=told):
        FoldedMixture(components, weights=[1e-40, 1e-42])
    assert jnp.isfinite(FoldedMixture(components, weights=[1e-30, 1e-42]).log_prob([0.5, 0.5]))


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_weights_of_half_precision_need_not_be_normal_numbers(dtype):
    """JAX computes with them in float32."""
    components = Gaussian(jnp.zeros((2, 1), dtype), jnp.ones((2, 1, 1), dtype))
    small = Mixture(components, weights=jnp.array([1e-5, 2e-5], dtype))
    assert float(small.log_prob(jnp.zeros(1, dtype))) == pytest.approx(-0.92, abs=0.02)
