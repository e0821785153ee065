"""Marginals and conditionals of a Folded-Gaussian: exact ones, and those integrated over time."""

import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from foldgauss.conditional import TimeDensity, TimeMixture
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import PolynomialFold, ZeroFold
from foldgauss.gaussian import Gaussian
from foldgauss.quadrature import SEARCH_GRID, adaptive_panels, gauss_hermite, normal_rule, peaks

BEND = np.array([[0.8, -0.5, 0.3], [0.6, 0.9, -0.4]])
TRIL = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.1, 0.05, 0.25]])
LOC = np.array([0.1, -0.4, 0.2])

LOG_PROB = eqx.filter_jit(lambda dist, x: dist.log_prob(x))
CDF = eqx.filter_jit(lambda dist, x: dist.cdf(x))
SAMPLE = eqx.filter_jit(lambda dist, key, n: dist.sample(key, (n,)))


@pytest.fixture(autouse=True)
def _x64():
    with jax.enable_x64(True):
        yield


def _dist(dim=2, power=1.0, floor=0.0, **changes):
    parameters = {
        "loc": LOC[:dim],
        "scale_tril": TRIL[:dim, :dim],
        "time_loc": 0.4,
        "time_scale": 0.3,
        "fold": PolynomialFold(BEND[:, :dim]),
        "envelope": TimeLikelihood(power, floor),
    }
    return FoldedGaussian(**(parameters | changes))


def _points(dist, n=20, key=0):
    return SAMPLE(dist, jax.random.key(key), n)


# --- quadrature -------------------------------------------------------------------------------------------


def test_rules_integrate_against_a_normal():
    for z, weights in (gauss_hermite(20), normal_rule()):
        np.testing.assert_allclose([(weights * z**k).sum() for k in range(7)], [1, 0, 1, 0, 3, 0, 15], atol=1e-12)
    z, weights = normal_rule()
    np.testing.assert_allclose(weights @ np.abs(z), np.sqrt(2 / np.pi), rtol=1e-13)


def test_adaptive_panels_see_narrow_peaks_and_count_them_in_logarithms():
    @jax.jit
    def total(width, place, height):
        bump = lambda x: height - 0.5 * ((x - place) / width) ** 2 - jnp.log(width)  # noqa: E731
        log_f = lambda x: jnp.logaddexp(bump(x), height - 0.5 * x**2)  # noqa: E731
        guides = peaks(lambda x: -jnp.abs(x - place), jnp.asarray(SEARCH_GRID), 4)
        panels = adaptive_panels(log_f, guides)
        return panels.log_total - height, panels.error_estimate

    for width, place, height in [(1e-7, 7.0123, 0.0), (1e-3, -9.99, -1e6), (0.5, 30.0, 1e5)]:
        log_total, error = total(width, place, height)
        np.testing.assert_allclose(log_total, np.log(2 * np.sqrt(2 * np.pi)), rtol=2e-8 if width < 1e-6 else 1e-9)
        assert error < 1e-8


# --- exact ones -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fold", ["polynomial", "zero", "callable"])
def test_marginal_with_time_is_a_folded_gaussian(fold):
    bend = jnp.asarray(BEND)
    kinds = {"polynomial": PolynomialFold(BEND), "zero": ZeroFold(3), "callable": lambda u: u * bend[0]}
    dist = _dist(3, fold=kinds[fold])
    marginal = dist.marginal([2, 0, -1])
    assert isinstance(marginal, FoldedGaussian)
    at, part = dist.condition_time(0.7), marginal.condition_time(0.7)
    np.testing.assert_allclose(part.loc, at.loc[np.array([2, 0])], rtol=1e-14)
    np.testing.assert_allclose(part.covariance_matrix, at.covariance_matrix[np.ix_([2, 0], [2, 0])], rtol=1e-13)
    assert isinstance(dist.marginal([3]), Gaussian)
    np.testing.assert_allclose(dist.marginal([3]).log_prob(jnp.array([0.5])), dist.time_marginal.log_prob(0.5))


def test_conditioning_with_time_is_the_gaussian_of_the_book():
    dist = _dist(3)
    at = dist.condition_time(0.7)
    gaussian = dist.condition([1, -1, 0], [-0.3, 0.7, 0.2])
    sigma, mean = np.asarray(at.covariance_matrix), np.asarray(at.loc)
    gain = sigma[2:, :2] @ np.linalg.inv(sigma[:2, :2])
    assert isinstance(gaussian, Gaussian)
    np.testing.assert_allclose(gaussian.loc, mean[2:] + gain @ (np.array([0.2, -0.3]) - mean[:2]), rtol=1e-12)
    np.testing.assert_allclose(gaussian.covariance_matrix, sigma[2:, 2:] - gain @ sigma[:2, 2:], rtol=1e-11)
    np.testing.assert_allclose(dist.condition([3], [0.7]).loc, at.loc)


# --- time given space -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("power", "floor"), [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 0.01)])
def test_time_given_space_integrates_to_one(power, floor):
    for dim in (1, 2):
        dist = _dist(dim, power, floor)
        density = dist.time_given_space(jnp.concatenate([_points(dist)[:, :-1], jnp.full((1, dim), 3.0)]))
        assert isinstance(density, TimeDensity)
        assert (density.error_estimate < 1e-9).all()
        # Trapezoids on a grid of its own, denser around the highest mode, where the peak may be narrow.
        mode = density.modes()[:, 0]
        offsets = np.sinh(np.linspace(-np.arcsinh(3e5), np.arcsinh(3e5), 40_001)) * 1e-5
        total = jnp.zeros(21)
        modes = density.modes()
        if np.isnan(modes[:, 1:]).all():
            t = mode[None] + jnp.asarray(offsets)[:, None]
            p = jnp.exp(LOG_PROB(density, t))
            total = (0.5 * (p[1:] + p[:-1]) * (t[1:] - t[:-1])).sum(0)
            np.testing.assert_allclose(total, 1, atol=3e-6 if power == 2 and floor == 0 else 1e-6)
        np.testing.assert_allclose(density.panels.probabilities.sum(-1), 1, atol=1e-12)


def test_time_given_space_by_plain_quadrature():
    dist = _dist(2)
    density = dist.time_given_space(jnp.array([[0.1, -0.4], [0.6, -0.5], [-0.4, 0.3]]))
    nodes, weights = np.polynomial.legendre.leggauss(20)
    edges = np.linspace(-2.0, 2.8, 2001)
    half = 0.5 * (edges[1] - edges[0])
    t = (edges[:-1, None] + half * (1 + nodes)).ravel()
    mass = half * np.tile(weights, 2000)[:, None] * np.exp(LOG_PROB(density, jnp.asarray(t)[:, None]))
    np.testing.assert_allclose(mass.sum(0), 1, atol=1e-8)
    np.testing.assert_allclose(density.mean, t @ mass, atol=1e-8)
    np.testing.assert_allclose(density.cdf(edges[900]), mass[: 900 * 20].sum(0), atol=1e-8)


def test_chain_rule_both_ways():
    dist = _dist(2)
    x = _points(dist)
    space, time = dist.marginal([0, 1]), dist.time_given_space(x[:, :2])
    assert isinstance(space, TimeMixture)
    expected = LOG_PROB(dist, x)
    np.testing.assert_allclose(LOG_PROB(space, x[:, :2]) + LOG_PROB(time, x[:, 2]), expected, rtol=1e-12, atol=1e-12)
    as_mixture = dist.condition([0, 1], x[:, :2])
    np.testing.assert_allclose(as_mixture.log_prob(x[:, 2:]), time.log_prob(x[:, 2]), rtol=1e-12)
    np.testing.assert_allclose(as_mixture.cdf(x[:, 2:]), time.cdf(x[:, 2]), rtol=1e-12)


def test_modes_of_time_are_where_the_parabola_passes():
    # s = u^2 passes 0.09 at u = -0.3 and 0.3: two modes, at t = 0.4 -+ 0.3, pulled in a little.
    dist = _dist(1, 0.0, loc=[0.0], scale_tril=[[0.01]], fold=PolynomialFold([[0.0], [1.0]]))
    density = dist.time_given_space([0.09])
    modes = np.sort(density.modes()[:2])
    np.testing.assert_allclose(modes, [0.1, 0.7], atol=2e-3)
    assert np.isnan(density.modes()[2:]).all()
    slope = jax.vmap(jax.grad(lambda t: density.log_prob(t)))(jnp.asarray(modes))
    np.testing.assert_allclose(slope, 0, atol=1e-3)  # the square root of rounding, times a curvature of 4e3
    np.testing.assert_allclose(density.cdf(0.4), 0.5, atol=1e-10)
    np.testing.assert_allclose(density.mean, 0.4, atol=1e-10)


def test_quantiles_and_samples_of_time():
    dist = _dist(1, 0.0, loc=[0.0], scale_tril=[[0.02]], fold=PolynomialFold([[0.0], [1.0]]))
    density = dist.time_given_space(jnp.array([[0.09], [0.0], [1.0]]))
    q = jnp.linspace(0.001, 0.999, 50)[:, None]
    t = density.icdf(q)
    assert t.shape == (50, 3)
    np.testing.assert_allclose(density.cdf(t), jnp.broadcast_to(q, (50, 3)), atol=1e-10)
    draws = SAMPLE(density, jax.random.key(1), 50_000)
    for i in range(3):
        cdf = lambda x, i=i: np.asarray(density.cdf(jnp.asarray(x)[:, None]))[:, i]  # noqa: E731
        assert stats.kstest(np.asarray(draws[:, i]), cdf).pvalue > 1e-4
        shifted = np.asarray(draws[:, i]) + 0.03 * np.sqrt(density.variance[i])
        assert stats.kstest(shifted, cdf).pvalue < 1e-4  # it has power
    np.testing.assert_allclose(draws.mean(0), density.mean, atol=0.01)
    np.testing.assert_allclose(draws.var(0), density.variance, rtol=0.03)


# --- time integrated out ----------------------------------------------------------------------------------


def test_space_marginal_is_the_law_of_the_samples():
    dist = _dist(2)
    marginal = dist.marginal([0])
    draws = np.asarray(_points(dist, 20_000, key=3))[:, 0]
    grid = np.linspace(-3, 4, 201)
    cdf = np.asarray(CDF(marginal, jnp.asarray(grid)[:, None]))
    assert (np.diff(cdf) >= -1e-12).all()
    assert stats.kstest(draws, lambda x: np.interp(x, grid, cdf)).pvalue > 1e-4
    assert stats.kstest(draws + 0.02, lambda x: np.interp(x, grid, cdf)).pvalue < 1e-4
    own = np.asarray(SAMPLE(marginal, jax.random.key(7), 20_000))
    assert own.shape == (20_000, 1)
    assert stats.kstest(own[:, 0], lambda x: np.interp(x, grid, cdf)).pvalue > 1e-4
    np.testing.assert_allclose(marginal.mean, dist.mean[:1])
    np.testing.assert_allclose(marginal.variance, dist.variance[:1])


def test_density_is_the_slope_of_the_distribution_function():
    nodes, weights = np.polynomial.legendre.leggauss(60)
    for dist in (_dist(2).marginal([1]), _dist(2).condition([0], [0.3]).marginal([0])):
        x = jnp.asarray(0.25 * nodes)[:, None]
        mass = weights @ jnp.exp(LOG_PROB(dist, x)) * 0.25
        ends = CDF(dist, jnp.array([[-0.25], [0.25]]))
        np.testing.assert_allclose(mass, ends[1] - ends[0], atol=1e-9)
        assert (dist.error_estimate(x) < 1e-9).all()


def test_space_given_space_against_its_definition():
    dist = _dist(3)
    given = dist.condition([1], [-0.3])
    assert given.event_shape == (3,)
    x = SAMPLE(given, jax.random.key(0), 10)
    full = jnp.stack([x[:, 0], jnp.full(10, -0.3), x[:, 1], x[:, 2]], axis=-1)
    expected = LOG_PROB(dist, full) - LOG_PROB(dist.marginal([1]), jnp.array([-0.3]))
    np.testing.assert_allclose(LOG_PROB(given, x), expected, rtol=1e-11)
    draws = np.asarray(SAMPLE(given, jax.random.key(1), 50_000))
    error = draws.std(0) / np.sqrt(len(draws))
    assert (np.abs(draws.mean(0) - given.mean) < 5 * error).all()
    np.testing.assert_allclose(np.cov(draws.T), given.covariance_matrix, atol=3e-3)


def test_conditioning_and_marginals_commute():
    dist = _dist(3)
    x = _points(dist, 5)
    log_prob = {
        "condition, marginal": LOG_PROB(dist.condition([1], x[:, 1:2]).marginal([0, 2]), x[:, [0, 3]]),
        "marginal, condition": LOG_PROB(dist.marginal([0, 1, 3]).condition([1], x[:, 1:2]), x[:, [0, 3]]),
    }
    np.testing.assert_allclose(*log_prob.values(), rtol=1e-10, atol=1e-10)
    without_time = {
        "condition, marginal": LOG_PROB(dist.condition([1], x[:, 1:2]).marginal([0]), x[:, :1]),
        "marginal, condition": LOG_PROB(dist.marginal([0, 1]).condition([1], x[:, 1:2]), x[:, :1]),
        "ratio": LOG_PROB(dist.marginal([0, 1]), x[:, :2]) - LOG_PROB(dist.marginal([1]), x[:, 1:2]),
    }
    for other in list(without_time.values())[1:]:
        np.testing.assert_allclose(without_time["condition, marginal"], other, rtol=1e-10, atol=1e-10)
    stepwise = dist.condition([1], x[:, 1:2]).condition([0, -1], x[:, [0, 3]])
    at_once = dist.condition([0, 1, 3], x[:, [0, 1, 3]])
    assert isinstance(stepwise, Gaussian)
    np.testing.assert_allclose(stepwise.loc, at_once.loc, rtol=1e-10)
    np.testing.assert_allclose(stepwise.covariance_matrix, at_once.covariance_matrix, rtol=1e-10)
    twice = dist.condition([1], x[:, 1:2]).condition([0], x[:, :1])
    np.testing.assert_allclose(
        LOG_PROB(twice, x[:, 2:]), LOG_PROB(dist.condition([0, 1], x[:, :2]), x[:, 2:]), rtol=1e-10, atol=1e-10
    )


def test_without_fold_and_envelope_all_is_gaussian():
    dist = _dist(2, fold=ZeroFold(2), envelope=Constant())
    sigma = TRIL[:2, :2] @ TRIL[:2, :2].T
    x = jnp.array([[0.2, -0.1], [0.0, 0.3]])
    expected = stats.multivariate_normal(LOC[:2], sigma).logpdf(x)
    np.testing.assert_allclose(LOG_PROB(dist.marginal([0, 1]), x), expected, rtol=1e-12)
    time = dist.time_given_space(x)
    np.testing.assert_allclose(time.mean, 0.4, rtol=1e-12)
    np.testing.assert_allclose(time.variance, 0.09, rtol=1e-10)


def test_far_points_and_divergent_ones():
    dist = _dist(1, 1.0)
    far = jnp.array([[50.0], [-1e4], [1e6]])
    marginal = dist.marginal([0])
    log_prob = LOG_PROB(marginal, far)
    assert np.isfinite(log_prob).all()
    # At s = 50 the mass lies where the curve passes, at tau = 28: narrower there than numbers lie apart. It is said so.
    assert (marginal.error_estimate(far) > 0.5)[0]
    assert (marginal.error_estimate(jnp.array([[0.3], [3.0]])) < 1e-9).all()
    # On a ridge that stands still p(s) diverges for power (d-1) >= 2; next to it, it does not.
    still = _dist(2, 1.0, fold=ZeroFold(2)).marginal([0, 1])
    values = LOG_PROB(still, jnp.stack([jnp.asarray(LOC[:2]), jnp.asarray(LOC[:2]) + 1e-3]))
    assert np.isposinf(values[0])
    assert np.isfinite(values[1])
    assert np.isposinf(still.error_estimate(jnp.asarray(LOC[:2])))


def test_batches_transformations_and_round_trips():
    dist = _dist(2, loc=jnp.stack([LOC[:2], LOC[:2] + 0.1]))
    marginal, s = dist.marginal([0]), jnp.array([[0.2], [0.5]])
    together = LOG_PROB(marginal, s)
    assert marginal.batch_shape == together.shape == (2,)
    mapped = jax.jit(jax.vmap(lambda d, s: d.marginal([0]).log_prob(s)))(dist, s)
    np.testing.assert_allclose(mapped, together, rtol=1e-12)
    np.testing.assert_allclose(marginal.log_prob(s), together, rtol=1e-12)  # jit = eager
    many = jnp.linspace(-1, 2, 130)[:, None, None]  # more than one chunk
    assert LOG_PROB(marginal, many).shape == (130, 2)
    np.testing.assert_allclose(LOG_PROB(marginal, many)[40, 1], LOG_PROB(marginal, many[40])[1], rtol=1e-12)
    conditional = dist.condition([0], s)
    assert SAMPLE(conditional, jax.random.key(0), 7).shape == (7, 2, 2)
    again = pickle.loads(pickle.dumps(conditional))
    x = jnp.zeros((2, 2))
    np.testing.assert_array_equal(LOG_PROB(again, x), LOG_PROB(conditional, x))


def test_gradients_go_through_the_integral():
    log_prob = jax.jit(lambda loc, s: _dist(1, loc=loc[None]).marginal([0]).log_prob(s))
    loc, s, step = jnp.asarray(0.1), jnp.array([0.5]), 1e-5
    by_loc, by_s = jax.jit(jax.grad(log_prob, argnums=(0, 1)))(loc, s)
    np.testing.assert_allclose(by_loc, (log_prob(loc + step, s) - log_prob(loc - step, s)) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(by_s[0], -by_loc, rtol=1e-9)  # p(s) knows s - loc only


# --- doors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("indices", "expected"),
    [([], "whole"), ([0.5], "whole"), ("s", "whole"), ([3], "numbers from"), ([0, 0], "each"), ([2, -1], "each")],
)
def test_indices_are_checked(indices, expected):
    for call in (lambda: _dist().marginal(indices), lambda: _dist().condition(indices, [0.0] * len(indices))):
        with pytest.raises(ValueError, match=f"^indices: expected {expected}"):
            call()


def test_bad_requests_are_refused():
    dist = _dist()
    with pytest.raises(ValueError, match=r"^indices: expected time last, got "):
        dist.marginal([2, 0])
    with pytest.raises(ValueError, match=r"^indices: expected a coordinate left over, got all"):
        dist.condition([0, 1, 2], [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"^values: expected shape "):
        dist.condition([0], [0.0, 1.0])
    with pytest.raises(ValueError, match=r"^s: expected shape "):
        dist.time_given_space([0.0])
    with pytest.raises(ValueError, match=r"^cdf: expected one coordinate, got 2"):
        dist.marginal([0, 1]).cdf(jnp.zeros(2))
    with pytest.raises(ValueError, match=r"^x: expected shape "):
        dist.marginal([0, 1]).log_prob(jnp.zeros(3))
