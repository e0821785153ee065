"""The numpyro bridge: the same numbers in other clothes, and a short NUTS through it; scipy's twins."""

import copy
import pickle
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from foldgauss.analysis.interop import to_numpyro
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import Constant
from foldgauss.fold import PolynomialFold
from foldgauss.gaussian import Gaussian
from foldgauss.mixture import FoldedMixture, Mixture

COVARIANCE = np.array([[0.5, 0.2], [0.2, 0.4]])

# Jitted: called eagerly, a draw and its density are a hundred small compilations for each shape.
LOG_PROB = jax.jit(lambda dist, x: dist.log_prob(x))
SAMPLE = jax.jit(lambda dist, key, shape: dist.sample(key, shape), static_argnums=2)
MEAN_AND_VARIANCE = jax.jit(lambda dist: (dist.mean, dist.variance))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def numpyro():
    module = pytest.importorskip("numpyro", reason="numpyro is an optional extra")
    # numpyro's own code broadcasts and promotes freely; the house rules are for ours.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield module


def _dist(**changes):
    parameters = {"time_loc": 0.4, "time_scale": 0.3, "fold": PolynomialFold(jnp.array([[0.8, -0.5], [0.6, 0.9]]))}
    return FoldedGaussian([0.1, -0.4], [[0.3, 0.0], [0.1, 0.2]], **(parameters | changes))


def _plain():
    """f = 0, a = 1: scipy's multivariate normal."""
    dist = FoldedGaussian([0.1, -0.4], covariance_matrix=COVARIANCE, time_loc=0.4, time_scale=0.3, envelope=Constant())
    covariance = np.zeros((3, 3))
    covariance[:2, :2], covariance[2, 2] = COVARIANCE, 0.09
    return dist, stats.multivariate_normal([0.1, -0.4, 0.4], covariance)


# --- scipy --------------------------------------------------------------------------------------------------


def test_methods_agree_with_their_twins_in_scipy(x64):
    dist, twin = _plain()
    x = twin.rvs(50, random_state=0)
    np.testing.assert_allclose(dist.log_prob(x), twin.logpdf(x), rtol=1e-12)
    np.testing.assert_allclose(dist.pdf(x[0]), twin.pdf(x[0]), rtol=1e-12)
    np.testing.assert_allclose(dist.entropy(), twin.entropy(), rtol=1e-12)
    np.testing.assert_allclose(dist.mean, twin.mean, rtol=1e-12)
    np.testing.assert_allclose(dist.covariance_matrix, twin.cov, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("indices", [pytest.param([0], marks=pytest.mark.slow, id="space"), [2], [1, 2], [-1]])
def test_marginals_agree_with_their_twins_in_scipy(x64, indices):
    """Time integrated out, time alone, both; quick tests of the integral: test_distribution_conditional.py."""
    dist, twin = _plain()
    x = twin.rvs(20, random_state=0)[:, indices]
    own = stats.multivariate_normal(twin.mean[indices], twin.cov[np.ix_(indices, indices)])
    np.testing.assert_allclose(dist.marginal(indices).log_prob(x), own.logpdf(x), rtol=1e-7)


# --- numpyro ------------------------------------------------------------------------------------------------


def _mixture(**changes):
    components = FoldedGaussian(jnp.zeros((2, 1)), [[0.3]], time_loc=[0.3, 0.7], time_scale=[0.2, 0.1], **changes)
    return FoldedMixture(components, weights=[0.4, 0.6])


EVERY = {
    "folded": (_dist, True),
    "batched": (lambda: _dist(time_loc=jnp.array([0.2, 0.4])), True),
    "constant envelope": (lambda: _dist(envelope=Constant()), True),
    "space at a time": (lambda: _dist().condition_time(0.3), True),
    "space": (lambda: _dist().marginal((0, 1)), False),
    "time": (lambda: _dist().marginal((2,)), None),
    "normal": (lambda: Gaussian([0.5], jnp.array([[[0.1]], [[2.0]]])), True),
    "gaussian": (lambda: Gaussian(jnp.zeros((4, 2)), jnp.eye(2)), True),
    "mixture": (_mixture, False),
    "mixture at a time": (lambda: _mixture().condition_time(0.3), False),
}


#: Those tested in the quick suite; compiling takes the time.
QUICK = {"batched"}


@pytest.fixture(params=[pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in EVERY])
def each(request, numpyro):
    """A distribution as numpyro's, and itself."""
    dist = EVERY[request.param][0]()
    return to_numpyro(dist), dist


def test_numpyro_draws_of_mixtures_are_not_reparametrized(each, request):
    """has_rsample is true where a gradient through a draw is that of its mean, and only there."""
    bridge, dist = each
    expected = EVERY[request.node.callspec.params["each"]][1]
    assert bridge.has_rsample == (dist.has_rsample if expected is None else expected)
    assert not bridge.has_enumerate_support
    if not bridge.has_rsample:
        with pytest.raises(NotImplementedError):  # as numpyro's own
            bridge.rsample(jax.random.key(0))
        return

    @jax.jit
    def drawn(dist, key):
        bridge = to_numpyro(dist)
        by_leaves = jax.grad(lambda dist: to_numpyro(dist).rsample(key, (100,)).mean())(dist)
        return bridge.rsample(key, (100,)), bridge.sample(key, (100,)), by_leaves

    reparametrized, plain, by_leaves = drawn(dist, jax.random.key(0))
    np.testing.assert_array_equal(reparametrized, plain)
    total = sum(float(jnp.abs(leaf).sum()) for leaf in jax.tree.leaves(by_leaves))
    assert 0 < total < np.inf


def test_numpyro_shapes(each):
    """expand, to_event, mask, and draws and densities of any sample shape."""
    bridge, dist = each
    key, batch, event = jax.random.key(0), dist.batch_shape, dist.event_shape
    assert (bridge.batch_shape, bridge.event_shape, bridge.event_dim) == (batch, event, len(event))
    for shape in ((), (5,), (2, 3)):
        x = jax.eval_shape(lambda key, shape=shape: bridge.sample(key, shape), key)
        assert x.shape == bridge.shape(shape) == (*shape, *batch, *event)
        assert jax.eval_shape(bridge.log_prob, x).shape == (*shape, *batch)

    @jax.jit
    def drawn(bridge, key):
        expanded, joint, hidden = bridge.expand((3, *batch)), bridge.to_event(len(batch)), bridge.mask(False)
        assert expanded.has_rsample == bridge.has_rsample
        assert (joint.batch_shape, joint.event_shape) == ((), (*batch, *event))
        x, (y, intermediates) = expanded.sample(key, (2,)), bridge.sample_with_intermediates(key)
        assert intermediates == []
        assert joint.sample(key).shape == y.shape == (*batch, *event)
        log_probs = (expanded.log_prob(x), dist.log_prob(x)), (joint.log_prob(y), dist.log_prob(y).sum())
        return x, log_probs, hidden.log_prob(y), bridge.support(x)

    np.testing.assert_array_equal(SAMPLE(bridge, key, (5,)), SAMPLE(dist, key, (5,)))
    for ours, theirs in zip(MEAN_AND_VARIANCE(dist), MEAN_AND_VARIANCE(bridge), strict=True):
        np.testing.assert_allclose(theirs, ours)
    x, (of_expanded, of_joint), of_hidden, supported = drawn(bridge, key)
    assert x.shape == (2, 3, *batch, *event)
    assert supported.all()
    np.testing.assert_allclose(*of_expanded, rtol=1e-6, atol=2e-7)  # sums of terms about 1, which may cancel
    np.testing.assert_allclose(*of_joint, rtol=1e-5)
    np.testing.assert_array_equal(of_hidden, jnp.zeros(batch))


def test_numpyro_distributions_are_pytrees(each):
    """flatten, jit, vmap; a distribution built inside vmap has its new dimension."""
    from numpyro.distributions.batch_util import promote_batch_shape

    bridge, dist = each
    again = jax.tree.unflatten(jax.tree.structure(bridge), jax.tree.leaves(bridge))
    many = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), dist)
    made = promote_batch_shape(jax.vmap(to_numpyro)(many))
    if hasattr(dist, "leaf_ranks"):
        assert made.batch_shape == (2, *dist.batch_shape)

    @jax.jit
    def evaluated(again, made, key):
        x = again.sample(key, (4,))
        both = jax.vmap(lambda d: d.log_prob(x))(made)
        return dist.log_prob(x), again.log_prob(x), jax.vmap(again.log_prob)(x), *both

    log_prob, *others = evaluated(again, made, jax.random.key(0))
    assert len(others) == 4
    for other in others:
        np.testing.assert_allclose(other, log_prob, rtol=2e-5, atol=1e-5)


def _leaves_match(bridge, again):
    assert jax.tree.structure(again.base) == jax.tree.structure(bridge.base)
    for ours, theirs in zip(jax.tree.leaves(bridge), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(ours, theirs)


#: Those that are no integrals over time, not even their divergences: nothing takes long to compile.
CHEAP = {
    "folded": lambda: _dist(envelope=Constant(), time_loc=jnp.array([0.2, 0.4])),
    **{name: EVERY[name][0] for name in ("normal", "gaussian", "mixture")},
}


@pytest.fixture(params=CHEAP)
def cheap(request, numpyro):
    return to_numpyro(CHEAP[request.param]())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["deepcopy", "pickle"])
def test_numpyro_distributions_are_copied(cheap, copied):
    for bridge in (cheap, cheap.expand((3, *cheap.batch_shape))):
        again = copied(bridge)
        assert type(again) is type(bridge)
        assert (again.batch_shape, again.event_shape) == (bridge.batch_shape, bridge.event_shape)
    _leaves_match(cheap, copied(cheap))
    assert repr(cheap).startswith("<foldgauss.analysis.interop")


def test_numpyro_entropy_and_divergence(cheap):
    from numpyro.distributions import kl_divergence

    if isinstance(cheap.base, Mixture):
        told = "entropy: expected a distribution that has one"
        with pytest.raises(NotImplementedError, match=told):  # as numpyro's own
            cheap.entropy()
        with pytest.raises(NotImplementedError, match="Across classes, estimate it"):  # then numpyro estimates
            kl_divergence(cheap, cheap)
        return
    np.testing.assert_array_equal(cheap.entropy(), cheap.base.entropy())
    wide, joint = cheap.expand((3, *cheap.batch_shape)), cheap.to_event(len(cheap.batch_shape))
    divergence = lambda p, q: kl_divergence(p, q)  # noqa: E731  numpyro's dispatcher is no function to JAX
    np.testing.assert_allclose(jax.jit(divergence)(cheap, cheap), np.zeros(cheap.batch_shape), atol=1e-6)
    assert jax.eval_shape(divergence, wide, cheap).shape == wide.batch_shape
    assert jax.eval_shape(divergence, joint, joint).shape == ()


def test_numpyro_divergence_of_gaussians_is_numpyros(numpyro):
    distributions = numpyro.distributions
    ours = [to_numpyro(Gaussian([0.1], [[0.4]])), to_numpyro(Gaussian([0.5], [[1.2]]))]
    theirs = [distributions.Normal(0.1, 0.4), distributions.Normal(0.5, 1.2)]
    np.testing.assert_allclose(distributions.kl_divergence(*ours), distributions.kl_divergence(*theirs), rtol=1e-6)


def test_numpyro_cdf(cheap):
    bridge = cheap
    if bridge.event_shape != (1,):
        for name in ("cdf", "icdf"):
            told = f"{name}: expected a distribution that has one"
            with pytest.raises(NotImplementedError, match=told):  # as numpyro's own
                getattr(bridge, name)(0.3)
        return
    twin = stats.norm(bridge.mean, jnp.sqrt(bridge.variance))
    np.testing.assert_allclose(bridge.cdf(0.3)[:, None], twin.cdf(0.3), rtol=1e-5)
    np.testing.assert_allclose(bridge.icdf(0.3), twin.ppf(0.3), rtol=1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numpyro_warns_out_of_the_support(cheap, value):
    x = np.full((*cheap.batch_shape, *cheap.event_shape), value, np.float32)
    checked = to_numpyro(cheap.base, validate_args=True)
    with pytest.warns(UserWarning, match="Out-of-support values provided to log prob method"):
        assert np.isneginf(checked.log_prob(x)).all()
    to_numpyro(cheap.base, validate_args=False).log_prob(x)  # no warning, which would be an error in this suite


@pytest.mark.slow
def test_numpyro_model_under_nuts_finds_the_fold(numpyro):
    from numpyro import distributions
    from numpyro.infer import MCMC, NUTS

    x = _dist().sample(jax.random.key(0), (400,))

    def model(x):
        bend = numpyro.sample("bend", distributions.Normal(0, 1).expand([2, 2]).to_event(2))
        numpyro.sample("x", to_numpyro(_dist(fold=PolynomialFold(bend))), obs=x)
        # The same family as a latent variable, not only as a likelihood (a = 1: else it is a funnel).
        numpyro.sample("latent", to_numpyro(_dist(envelope=Constant())))

    mcmc = MCMC(NUTS(model), num_warmup=150, num_samples=200, progress_bar=False)
    mcmc.run(jax.random.key(1), x)
    draws = mcmc.get_samples()
    mean, error = draws["bend"].mean(0), draws["bend"].std(0)
    truth = np.array([[0.8, -0.5], [0.6, 0.9]])
    assert (np.abs(mean - truth) < 5 * error).all()
    assert (error < 0.1).all()
    # Power: a fold of the wrong sign lies far outside the posterior.
    assert (np.abs(mean + truth) > 5 * error).all()
    assert draws["latent"].shape == (200, 3)
    np.testing.assert_allclose(draws["latent"][:, 2].mean(), 0.4, atol=0.15)  # sd 0.02 to 0.03


def test_missing_numpyro_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "numpyro", None)
    with pytest.raises(ImportError, match=r"pip install 'foldgauss\[numpyro\]'"):
        to_numpyro(_dist())
