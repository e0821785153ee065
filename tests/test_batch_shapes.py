"""Every class and method over batches with axes of size 1 and mixtures of one component, against single elements."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.analysis.interop import to_numpyro
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood
from foldgauss.fold import CallableFold, PolynomialFold, SharedPathFold, ZeroFold
from foldgauss.mixture import FoldedMixture

SHAPES = [(), (1,), (1, 1), (4, 1)]
#: (batch shape, number of components). One by default: plain batches and several components
#: have tests of their own.
CASES = [
    pytest.param(shape, num, marks=[] if (shape, num) == ((4, 1), 1) else pytest.mark.slow)
    for num in (1, 3)
    for shape in SHAPES
]
DRAWS = 400
#: Standard errors by which a mean of draws may be off: false alarms are one in 500 million.
ALARM = 6


def _mixture(batch, num, **changes):
    rng = np.random.default_rng(len(batch) + num)
    shape = (*batch, num)
    parameters = {
        "loc": rng.normal(size=(*shape, 2)),
        "scale_tril": np.tril(0.1 * rng.normal(size=(*shape, 2, 2)), -1) + 0.3 * np.eye(2),
        "time_loc": rng.uniform(0.3, 0.7, shape),
        "time_scale": rng.uniform(0.2, 0.3, shape),
        "fold": PolynomialFold(0.5 * rng.normal(size=(*shape, 2, 2))),
        "envelope": TimeLikelihood(1.0, 0.1),
    }
    return FoldedMixture(FoldedGaussian(**(parameters | changes)), logits=0.3 * rng.normal(size=shape))


def _points(batch):
    return jnp.asarray(np.random.default_rng(9).normal(0.3, 0.5, (2, *batch, 3)), jnp.float32)


def _densities(dist, x):
    return [dist.log_prob(x), dist.pdf(x)]


def _pairs(mixture, x):
    return [*_densities(mixture, x), mixture.component_log_prob(x), mixture.responsibilities(x)]


def _moments(dist):
    return [dist.mean, dist.variance, dist.covariance_matrix]


def _of_mixture(m, x):
    t = x[..., 2]
    return [*_pairs(m, x), *m.condition_time(t).moments(), m.marginal([1, -1]).log_prob(x[..., 1:])]


def _of_mixture_at_times(m, x):
    s, t = x[..., :2], x[..., 2]
    found = []
    for given in (m.condition_time(t), m.condition(-1, x[..., 2:])):
        found += [*_pairs(given, s), *_moments(given), given.stddev, given.weights]
    for line in (m.condition([2, 0], x[..., [2, 0]]), m.condition_time(t).condition(0, x[..., :1])):
        found += [*_pairs(line, s[..., 1:]), *_moments(line), line.cdf(s[..., 1:]), line.icdf(jax.nn.sigmoid(t))]
    return found


def _of_components(m, x):
    folded, x = m.components, x[..., None, :]
    t = x[..., 2]
    at, time = folded.condition_time(t), folded.marginal([-1])
    found = [*_densities(folded, x), folded.normal_to_fold(x), *_densities(folded.marginal([1, -1]), x[..., 1:])]
    found += [*_densities(at, x[..., :2]), *_moments(at), at.entropy(), *_moments(at.marginal(1))]
    return [*found, *_densities(time, x[..., 2:]), time.cdf(x[..., 2:]), time.icdf(jax.nn.sigmoid(t))]


def _of_integrated(m, x):
    space, line = m.marginal([0, 1]), m.marginal(0)
    return [*_pairs(space, x[..., :2]), space.error_estimate(x[..., :2]), line.cdf(x[..., :1])]


def _of_integrated_given_space(m, x):
    rest = m.condition(0, x[..., :1])
    found = [*_pairs(rest, x[..., 1:]), *_moments(rest), rest.weights, rest.marginal(0).cdf(x[..., 1:2])]
    found += _moments(m.marginal([0, 1]).condition(0, x[..., :1]))
    return [*found, *_moments(rest.condition(-1, x[..., 2:]))]


def _of_time(m, x):
    time, t = m.time_given_space(x[..., :2]), x[..., 2:]
    found = [*_pairs(time, t), *_moments(time), time.stddev, time.error_estimate(t), time.weights]
    return [*found, time.cdf(t), time.icdf(jax.nn.sigmoid(t[..., 0])), time.components.modes()]


def _in_batch(m):
    space, time, folded = m.marginal([0, 1]), m.marginal(-1), m.components
    found = [*_moments(m), m.stddev, m.weights, m.log_weights, *_moments(time), time.weights]
    found += [*_moments(space), space.weights]
    return [*found, *_moments(folded), folded.mode, folded.entropy(), folded.marginal([-1]).entropy()]


EXACT = [_of_mixture, _of_mixture_at_times, _of_components]
#: Each compiles for seconds; batches of other distributions: test_distribution.py and test_mixture.py.
QUICK = [_of_mixture_at_times]
INTEGRATED = [_of_integrated, _of_integrated_given_space, _of_time]


def _element(mixture, index):
    return jax.tree.map(lambda leaf: leaf[index], mixture)


@pytest.mark.parametrize(("batch", "num"), CASES)
@pytest.mark.parametrize(
    "function", [pytest.param(f, marks=[pytest.mark.slow] * (f not in QUICK)) for f in (*EXACT, *INTEGRATED)]
)
def test_batches_at_points_equal_single_elements(function, batch, num):
    mixture, x, each = _mixture(batch, num), _points(batch), eqx.filter_jit(function)
    found = each(mixture, x)
    for index in np.ndindex(batch):
        expected = each(_element(mixture, index), x[(slice(None), *index)])
        for i, (ours, theirs) in enumerate(zip(found, expected, strict=True)):
            assert ours.shape == (2, *batch, *theirs.shape[1:]), i
            np.testing.assert_allclose(ours[(slice(None), *index)], theirs, rtol=1e-3, atol=1e-4, err_msg=str(i))


@pytest.mark.parametrize(("batch", "num"), CASES)
def test_batches_equal_single_elements(batch, num):
    mixture, each = _mixture(batch, num, envelope=TimeLikelihood(0.5)), eqx.filter_jit(_in_batch)
    found = each(mixture)
    for index in np.ndindex(batch):
        for i, (ours, theirs) in enumerate(zip(found, each(_element(mixture, index)), strict=True)):
            assert ours.shape == (*batch, *theirs.shape), i
            np.testing.assert_allclose(ours[index], theirs, rtol=1e-4, atol=1e-5, err_msg=str(i))


@pytest.mark.slow
@pytest.mark.parametrize("function", INTEGRATED)
def test_shapes_of_integrals(function):
    shapes = [eqx.filter_eval_shape(function, _mixture(shape, 1), _points(shape)) for shape in ((), (4, 1))]
    for one, found in zip(*shapes, strict=True):
        assert found.shape == (2, 4, 1, *one.shape[1:])


@pytest.mark.parametrize("function", [_of_mixture, pytest.param(_of_mixture_at_times, marks=pytest.mark.slow)])
def test_a_mixture_of_one_component_is_the_component(function):
    """Compared with two equal components, of which one has no weight."""
    one, x = _mixture((), 1), _points(())
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), one.components)
    two = FoldedMixture(twice, logits=[0.0, -jnp.inf])
    for ours, theirs in zip(*(eqx.filter_jit(function)(m, x) for m in (one, two)), strict=True):
        theirs = theirs if ours.shape == theirs.shape else theirs[..., :1]
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


# --- samples -------------------------------------------------------------------------------------------------

SAMPLED = {
    "FoldedMixture": lambda m: m,
    "FoldedMixture, a network as fold": lambda m: m,
    "FoldedMixture on a path": lambda m: m,
    "Mixture at a time": lambda m: m.condition_time(0.4),
    "Mixture by condition": lambda m: m.condition(-1, 0.4),
    "Mixture given space": lambda m: m.condition([0, 2], jnp.array([0.1, 0.4])),
    "Mixture of time": lambda m: m.marginal(-1),
    "Mixture of integrals": lambda m: m.marginal([1, 0]),
    "Mixture of integrals given space": lambda m: m.condition(0, 0.1),
    "Mixture of time given space": lambda m: m.time_given_space(jnp.array([0.1, 0.2])),
    "FoldedGaussian": lambda m: m.components,
    "Gaussian": lambda m: m.components.condition_time(0.4),
    "Gaussian of time": lambda m: m.components.marginal([-1]),
    "TimeMixture": lambda m: m.components.marginal([0, 1]),
    "TimeMixture given space": lambda m: m.components.condition(0, 0.1),
    "Time given space": lambda m: m.components.time_given_space(jnp.array([0.1, 0.2])),
}
BY_QUADRATURE = {
    "Mixture of integrals given space",
    "Mixture of time given space",
    "TimeMixture given space",
    "Time given space",
}
#: A network: test_mixture.py; `condition` of time is `condition_time`.
SAMPLED_ELSEWHERE = {"FoldedMixture, a network as fold", "Mixture by condition"}
PATH = {"times": [[0.0, 1.0]], "matrices": [[[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]]]]}


def _to_sample(kind, batch, num):
    if kind == "FoldedMixture, a network as fold":
        return _mixture(batch, num, fold=CallableFold(eqx.nn.MLP("scalar", 2, 3, 1, key=jax.random.key(0))))
    if kind == "FoldedMixture on a path":
        anchor = np.ones((*batch, num, 2))
        return _mixture(batch, num, fold=SharedPathFold(ZeroFold(2), anchor, time_loc=0.5, index=1, **PATH))
    return SAMPLED[kind](_mixture(batch, num))


def _check_samples(dist, x):
    """All differ, over the batch too, and the mean is that of the distribution."""
    assert x.shape == (DRAWS, *dist.batch_shape, *dist.event_shape)
    first = x.reshape(*x.shape[: 1 + len(dist.batch_shape)], -1)[..., 0]
    assert len(np.unique(first)) > 0.99 * first.size
    error = np.abs(np.asarray(x.mean(0) - dist.mean)) / np.asarray(x.std(0) / np.sqrt(DRAWS))
    assert (error < ALARM).all(), error.max()


@pytest.mark.parametrize("kind", [*(k for k in SAMPLED if k not in BY_QUADRATURE | SAMPLED_ELSEWHERE)])
def test_samples_differ_and_have_the_mean(kind):
    dist = _to_sample(kind, (4, 1), 1)
    _check_samples(dist, jax.jit(lambda dist: dist.sample(jax.random.key(1), DRAWS))(dist))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "num"), [(kind, num) for kind in SAMPLED for num in (1, 3)])
@pytest.mark.parametrize("batch", SHAPES)
def test_samples_of_several_components_and_by_quadrature(kind, batch, num):
    dist = _to_sample(kind, batch, num)
    _check_samples(dist, dist.sample(jax.random.key(1), DRAWS))


#: Components of mixtures by quadrature, which are traced with these.
OF_COMPONENTS = BY_QUADRATURE & {"TimeMixture given space", "Time given space"}


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in OF_COMPONENTS)) for kind in SAMPLED]
)
def test_shapes_of_samples(kind):
    dist = eqx.filter_eval_shape(_to_sample, kind, (4, 1), 1)

    def sample(shape):
        return eqx.filter_eval_shape(lambda dist: dist.sample(jax.random.key(1), shape), dist)

    for given, shape in {(2, 3): (2, 3), np.int64(5): (5,)}.items():
        assert sample(given).shape == (*shape, *dist.batch_shape, *dist.event_shape)
    for wrong in (-1, (-1,), 2.0, (2.0,), "2", None):
        with pytest.raises(ValueError, match=r"^sample_shape: expected whole numbers >= 0, got "):
            sample(wrong)


@pytest.mark.parametrize("num", [1, 3])
def test_samples_are_of_their_component(num):
    batch = (4, 1)
    far = 100.0 * np.arange(4 * num).reshape(*batch, num)
    mixture = _mixture(batch, num, time_loc=far, fold=None)
    x, component = mixture.sample(jax.random.key(0), (DRAWS,), return_component=True)
    assert component.shape == (DRAWS, *batch)
    place = np.take_along_axis(np.broadcast_to(far, (DRAWS, *far.shape)), np.asarray(component)[..., None], -1)[..., 0]
    assert np.abs(np.asarray(x[..., 2]) - place).max() < 50


def test_one_component_in_numpyro():
    pytest.importorskip("numpyro", reason="numpyro is an optional extra")
    x = to_numpyro(_mixture((), 1)).sample(jax.random.key(0), (9,))
    assert x.shape == (9, 3)
    assert len(np.unique(x, axis=0)) == 9
