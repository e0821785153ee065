"""Marginals and conditionals of a Folded-Gaussian: exact ones, and those integrated over time."""

import pickle
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folded import BEND, CONDITION_TIME, LOC, LOG_PROB, SAMPLE, TRIL, folded
from scipy import stats

from foldgauss.analysis.conditional import TimeMixture, _guides, _log_joint_frozen, _mixture_moments, _same_top
from foldgauss.analysis.quadrature import SEARCH_GRID, adaptive_panels, find_peaks, gauss_hermite, normal_panels
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import CallableEnvelope, TimeLikelihood
from foldgauss.fold import PolynomialFold, ZeroFold
from foldgauss.gaussian import Gaussian
from foldgauss.mixture import FoldedMixture

CDF = eqx.filter_jit(lambda dist, x: dist.cdf(x))
MEAN_AND_VARIANCE = eqx.filter_jit(lambda dist: (dist.mean, dist.variance))
# An integral over time takes seconds to compile for each shape: what is given has this many points in most tests, as
# many as one of the sizes of `map_over_batch`, which evaluates no more of them then.
MANY = 8


pytestmark = pytest.mark.usefixtures("x64")


def _points(dist, n=20, key=0):
    return SAMPLE(dist, jax.random.key(key), (n,))


def _repeated(*values):
    """MANY points, one after the other and again: (MANY, 1) of numbers."""
    points = jnp.asarray(values).reshape(len(values), -1)
    return jnp.resize(points, (MANY, points.shape[-1]))


def _density_of_one(dist, s):
    """p(s) of one space coordinate in NumPy, by trapezoids over time."""
    tau = np.linspace(-9, 9, 200_001)
    at = dist.time_loc, dist.time_scale, *dist.fold.coefficients[:, 0], dist.loc[0], dist.scale_tril[0, 0]
    _, width, c1, c2, loc, scale = (float(x) for x in at)
    u, spread = -width * tau, scale * np.exp(-float(dist.envelope.power) * tau**2 / 4)
    space = stats.norm.pdf(s, loc + c1 * u + c2 * u**2, spread)
    return (space * stats.norm.pdf(tau)).sum() * (tau[1] - tau[0])


# --- quadrature -------------------------------------------------------------------------------------------


def test_rules_integrate_against_a_normal():
    panels = jax.jit(lambda: normal_panels(jnp.abs, jnp.zeros(0), jnp.float64))()
    for z, weights in (gauss_hermite(20), (panels.nodes, panels.weights)):
        np.testing.assert_allclose([(weights * z**k).sum() for k in range(7)], [1, 0, 1, 0, 3, 0, 15], atol=1e-12)
    np.testing.assert_allclose((panels.weights * np.abs(panels.nodes)).sum(), np.sqrt(2 / np.pi), rtol=1e-13)


def test_adaptive_panels_see_narrow_peaks_and_count_them_in_logarithms():
    @jax.jit
    def total(width, place, height):
        bump = lambda x: height - 0.5 * ((x - place) / width) ** 2 - jnp.log(width)  # noqa: E731
        log_f = lambda x: jnp.logaddexp(bump(x), height - 0.5 * x**2)  # noqa: E731
        guides = find_peaks(lambda x: -jnp.abs(x - place), jnp.asarray(SEARCH_GRID), 4)
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
    kinds = {"polynomial": PolynomialFold(BEND[:2]), "zero": ZeroFold(3), "callable": lambda u: u * bend[0]}
    dist = folded(3, fold=kinds[fold])
    marginal = dist.marginal([2, 0, -1])
    assert isinstance(marginal, FoldedGaussian)
    at, part = CONDITION_TIME(dist, 0.7), CONDITION_TIME(marginal, 0.7)
    np.testing.assert_allclose(part.loc, at.loc[np.array([2, 0])], rtol=1e-14)
    np.testing.assert_allclose(part.covariance_matrix, at.covariance_matrix[np.ix_([2, 0], [2, 0])], rtol=1e-13)
    assert isinstance(dist.marginal([3]), Gaussian)
    np.testing.assert_allclose(dist.marginal([3]).log_prob(0.5), stats.norm(0.4, 0.3).logpdf(0.5))
    assert dist.marginal([0, 1]).event_shape == (2,)
    assert dist.marginal(range(4)) is dist


def test_conditioning_with_time_is_the_gaussian_of_the_book():
    dist = folded(3)
    at = CONDITION_TIME(dist, 0.7)
    gaussian = eqx.filter_jit(lambda dist: dist.condition([1, -1, 0], [-0.3, 0.7, 0.2]))(dist)
    sigma, mean = np.asarray(at.covariance_matrix), np.asarray(at.loc)
    gain = sigma[2:, :2] @ np.linalg.inv(sigma[:2, :2])
    assert isinstance(gaussian, Gaussian)
    np.testing.assert_allclose(gaussian.loc, mean[2:] + gain @ (np.array([0.2, -0.3]) - mean[:2]), rtol=1e-12)
    np.testing.assert_allclose(gaussian.covariance_matrix, sigma[2:, 2:] - gain @ sigma[:2, 2:], rtol=1e-11)
    np.testing.assert_allclose(dist.condition([3], [0.7]).loc, at.loc)
    in_turn = dist.condition(1, [-0.3]).condition([0, -1], [0.2, 0.7])
    np.testing.assert_allclose(in_turn.loc, gaussian.loc, rtol=1e-12)
    np.testing.assert_allclose(in_turn.covariance_matrix, gaussian.covariance_matrix, rtol=1e-11)


def test_a_marginal_of_a_conditional_is_a_conditional_of_a_marginal():
    dist, x = folded(3), np.array([[0.4, 0.5], [0.1, 0.9]])
    one, other = dist.condition(1, [-0.3]).marginal([1, -1]), dist.marginal([1, 2, 3]).condition(0, [-0.3])
    assert one.event_shape == (2,)
    np.testing.assert_allclose(one.log_prob(x), other.log_prob(x), rtol=1e-12)


# --- time given space -------------------------------------------------------------------------------------


def _edges(modes):
    """Ends of intervals for an integral over t that has narrow peaks at `modes`: from 4 down to 1e-7 away from each."""
    ladder = 4.0 * 2.0 ** -np.arange(26)
    around = modes[:, None] + np.r_[0, ladder, -ladder]
    edges = np.unique(np.clip(np.r_[np.linspace(-3.2, 4.0, 60), around.ravel()], -3.2, 4.0))
    return np.r_[edges, np.full(500 - edges.size, edges[-1])]


ENVELOPES = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 0.01)]  # power and floor


@pytest.mark.parametrize(
    ("dim", "cases", "num"),
    [(1, ENVELOPES[1::2], MANY), *(pytest.param(dim, ENVELOPES, 21, marks=pytest.mark.slow) for dim in (1, 2))],
)
def test_time_given_space_integrates_to_one(dim, cases, num):
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for power, floor in cases:
        dist = folded(dim, power, floor)
        # At s = 1.5 and 1.95 the curve of one space coordinate passes at tau = 6.7 and 7.5, too, in widths of 1e-5;
        # just above -0.16, where it turns back, the density has a flat top.
        s = jnp.concatenate([_points(dist, num - 3)[:, :-1], jnp.outer(jnp.array([1.5, 1.95, -0.15]), jnp.ones(dim))])
        density = dist.time_given_space(s)
        assert isinstance(density, TimeMixture)
        assert (density.time.error_estimate < 1e-9).all()
        modes = np.asarray(density.modes())
        edges = np.stack([_edges(m[np.isfinite(m)]) for m in modes], axis=-1)
        half = 0.5 * np.diff(edges, axis=0)[:, None]
        t = edges[:-1, None] + half * (1 + nodes[:, None])
        log_p = np.asarray(LOG_PROB(density, jnp.concatenate([t.reshape(-1, num), modes.T])[..., None]))
        for own, height in zip(modes, log_p[-modes.shape[1] :].T, strict=True):  # highest first, and apart
            assert (np.diff(height[height > -20]) < 0.01).all()
            assert (np.diff(np.sort(own[np.isfinite(own)])) > 1e-4).all()
        p = np.exp(log_p[: -modes.shape[1]]).reshape(t.shape)
        np.testing.assert_allclose((half * weights[:, None] * p).sum((0, 1)), 1, rtol=1e-8)
        assert power == 0 or dim == 2 or (np.isfinite(modes).sum(-1) > 1).any()  # bimodal ones are among them
        np.testing.assert_allclose(density.time.panels.probabilities.sum(-1), 1, atol=1e-12)


def test_moments_with_an_own_envelope_equal_those_with_the_same_built_in():
    """An own envelope may depend on t itself, so that times are not centered."""
    own = CallableEnvelope(lambda t, m, scale: -0.5 * ((t - m) / scale) ** 2)
    density = folded(1).time_given_space(_repeated(0.3))
    panels = jax.tree.map(lambda leaf: leaf[0], density.time.panels)
    mean, covariance = eqx.filter_jit(_mixture_moments)(folded(1, envelope=own), jnp.array([0.3]), panels)
    np.testing.assert_allclose(mean, density.mean[0], rtol=1e-12)
    np.testing.assert_allclose(covariance[0], density.variance[0], rtol=1e-9)


def test_modes_of_time_are_where_the_parabola_passes():
    # s = u^2 passes at u = -sqrt(s) and sqrt(s): two modes, pulled in a little, by the slope of the density of time.
    dist = folded(1, 0.0, loc=[0.0], scale_tril=[[0.01]], fold=PolynomialFold([[0.0], [1.0]]))
    s = jnp.linspace(0.09, 0.5, MANY)[:, None]
    density = dist.time_given_space(s)
    away = np.sqrt(s - 0.01**2 / (2 * 0.3**2))
    modes = density.modes()
    # Accurate to the square root of rounding.
    np.testing.assert_allclose(np.sort(modes[:, :2]), 0.4 + away * np.array([[-1, 1]]), atol=2e-7)
    assert modes.shape == (MANY, 8)
    assert np.isnan(modes[:, 2:]).all()
    np.testing.assert_allclose(density.cdf(jnp.full((7, 1, 1), 0.4)), 0.5, atol=1e-10)
    np.testing.assert_allclose(density.mean, 0.4, atol=1e-10)


def test_times_at_which_a_ridge_comes_near_are_solved_to_rounding():
    """Whitened, the residuals are r / scale and (offset - r / 2) / scale: their squares are least at r = 0.4 offset."""
    scale, offset = 1e-3, 1e-6
    tril = scale * np.array([[1.0, 0.0], [0.5, 1.0]])

    @jax.jit
    def find(s, end):
        """In a wave that ends at some distance from time_loc."""
        fold = lambda u: jnp.stack([jnp.sin(2 * jnp.pi * jnp.clip(u, -end, end)), 0 * u])  # noqa: E731
        dist = FoldedGaussian(np.zeros(2), tril, time_loc=0.0, time_scale=1.0, fold=fold)
        return _guides(dist, s, _log_joint_frozen(dist, s))

    turn = np.arcsin(0.5 - 0.4 * offset) / (2 * np.pi)
    expected = np.ravel(np.arange(-20.0, 20)[:, None] - [turn, 0.5 - turn])
    expected = expected[np.argsort(np.abs(expected))]
    for end in (np.inf, 4.0):  # more times than are kept, and fewer: the others are NaN
        guides, near = find(jnp.array([0.5, offset]), jnp.asarray(end))
        # The 10 of most mass come first, whatever their density, and then 6 maxima of the density.
        np.testing.assert_allclose(guides[:10], expected[:10], rtol=1e-13, atol=1e-14)
        assert guides.size == 10 + 6
        found = np.sort(near)[:24] if end == np.inf else np.sort(near[:16])
        np.testing.assert_allclose(found, np.sort(expected[: found.size]), rtol=1e-13, atol=1e-14)
        assert near.size == 24


def test_maxima_with_no_valley_between_them_are_one():
    """Pairs of maxima, each with a valley halfway, whose depth is in tolerances and distance in its limit."""
    eps = np.finfo(np.float64).eps
    depth = np.array([0.7, 1.5, 0.0, 0.7, 1.5, 0.0, 0.7, 1.5])
    distance = np.array([0.8, 0.8, 1.3, 0.8, 0.8, 1.3, 0.8, 0.8])
    place, height = np.array([0.0, 1.0, -2.0, 7.0, 8.0, 9.0, 30.0, 40.0]), np.r_[np.repeat([0.1, -100.0], 3), 0.5, -7.0]
    first, second = place, place + distance * eps**0.25 * (1 + np.abs(place))
    tolerance = 64 * eps * np.maximum(1, np.abs(height))

    def log_f(x):
        middle, part, top, low = jnp.array([0.5 * (first + second), second - first, height, depth * tolerance])
        of = jnp.abs(x[..., None] - middle).argmin(-1)
        return top[of] - jnp.where(jnp.abs(x - middle[of]) < 0.1 * part[of], low[of], 0)

    found, heights = np.ravel([first, second], "F"), np.repeat(height, 2)
    with jax.numpy_rank_promotion("allow"):
        same = jax.jit(partial(_same_top, log_f))(np.append(found, np.nan), np.append(heights, -np.inf))
    is_one = (depth < 1) & (distance < 1)
    np.testing.assert_array_equal(same, np.append(np.ravel([np.zeros_like(is_one), is_one], "F"), False))


@pytest.mark.slow  # it compiles for long
def test_quantiles_and_samples_of_time():
    dist = folded(1, 0.0, loc=[0.0], scale_tril=[[0.02]], fold=PolynomialFold([[0.0], [1.0]]))
    density = dist.time_given_space(jnp.array([[0.09], [0.0], [1.0]]))
    q = jnp.linspace(0.001, 0.999, 50)[:, None]
    t = density.icdf(q)
    assert t.shape == (50, 3, 1)
    np.testing.assert_allclose(density.cdf(t), jnp.broadcast_to(q, (50, 3)), atol=1e-10)
    draws = SAMPLE(density, jax.random.key(1), (50_000,))[..., 0]
    for i in range(3):
        cdf = lambda x, i=i: np.asarray(density.cdf(jnp.asarray(x)[:, None, None]))[:, i]  # noqa: E731
        assert stats.kstest(np.asarray(draws[:, i]), cdf).pvalue > 1e-4
        shifted = np.asarray(draws[:, i]) + 0.03 * np.sqrt(density.variance[i, 0])
        assert stats.kstest(shifted, cdf).pvalue < 1e-4  # it has power
    np.testing.assert_allclose(draws.mean(0), density.mean[:, 0], atol=0.01)
    np.testing.assert_allclose(draws.var(0), density.variance[:, 0], rtol=0.03)


# --- time integrated out ----------------------------------------------------------------------------------


def test_the_cdf_of_space_goes_from_zero_to_one():
    marginal = folded(1).marginal([0])
    found = CDF(marginal, jnp.array([[-jnp.inf], [-30.0], [0.1], [30.0], [jnp.inf]]))
    np.testing.assert_allclose(np.delete(found, 2), [0, 0, 1, 1], atol=1e-9)
    assert 0.01 < found[2] < 0.99


@pytest.mark.slow
def test_space_marginal_is_the_law_of_the_samples():
    dist = folded(2)
    marginal = dist.marginal([0])
    draws = np.asarray(_points(dist, 20_000, key=3))[:, 0]
    grid = np.linspace(-3, 4, 192)  # three times 64, compiled as one
    cdf = np.asarray(CDF(marginal, jnp.asarray(grid)[:, None]))
    assert (np.diff(cdf) >= -1e-12).all()
    assert stats.kstest(draws, lambda x: np.interp(x, grid, cdf)).pvalue > 1e-4
    assert stats.kstest(draws + 0.02, lambda x: np.interp(x, grid, cdf)).pvalue < 1e-4
    own = np.asarray(SAMPLE(marginal, jax.random.key(7), (20_000,)))
    assert own.shape == (20_000, 1)
    assert stats.kstest(own[:, 0], lambda x: np.interp(x, grid, cdf)).pvalue > 1e-4
    for own, whole in zip(MEAN_AND_VARIANCE(marginal), MEAN_AND_VARIANCE(dist), strict=True):
        np.testing.assert_allclose(own, whole[:1])


@pytest.mark.parametrize("given", [*(pytest.param(k, marks=pytest.mark.slow) for k in (0, 1)), 2])
def test_density_is_the_slope_of_the_distribution_function(given):
    dist = folded(given + 1).marginal(range(given + 1))
    dist = dist.condition(range(given), [0.3, -0.1][:given]) if given else dist
    nodes, weights = np.polynomial.legendre.leggauss(60)
    x = jnp.asarray(0.25 * nodes)[:, None]
    mass = weights @ jnp.exp(LOG_PROB(dist, x)) * 0.25
    ends = CDF(dist, jnp.array([[-0.25], [0.25]]))
    np.testing.assert_allclose(mass, ends[1] - ends[0], atol=1e-9)
    assert (dist.error_estimate(x) < 1e-9).all()


def test_space_given_space_against_its_definition():
    dist = folded(3)
    given = dist.condition([1], _repeated(-0.3))
    assert given.event_shape == (3,)
    draws = SAMPLE(given, jax.random.key(1), (50_000 // MANY,))
    x = draws[0]
    full = jnp.stack([x[:, 0], jnp.full(MANY, -0.3), x[:, 1], x[:, 2]], axis=-1)
    alone = folded(1, loc=LOC[1:2], scale_tril=np.linalg.norm(TRIL[1])[None, None], fold=PolynomialFold(BEND[:2, 1:2]))
    expected = LOG_PROB(dist, full) - np.log(_density_of_one(alone, -0.3))
    np.testing.assert_allclose(LOG_PROB(given, x), expected, rtol=1e-11)
    np.testing.assert_array_equal(LOG_PROB(pickle.loads(pickle.dumps(given)), x), LOG_PROB(given, x))
    draws = np.asarray(draws).reshape(-1, 3)
    error = draws.std(0) / np.sqrt(len(draws))
    assert (np.abs(draws.mean(0) - given.mean[0]) < 5 * error).all()
    np.testing.assert_allclose(np.cov(draws.T), given.covariance_matrix[0], atol=3e-3)
    np.testing.assert_array_equal(given.variance, np.diagonal(given.covariance_matrix, axis1=1, axis2=2))
    space = dist.marginal([0, 1, 2]).condition([1], _repeated(-0.3))
    assert space.event_shape == (2,)
    np.testing.assert_allclose(space.mean, given.mean[:, :2], rtol=1e-12)


def test_what_is_given_adds_its_own_error_to_that_of_every_point():
    given = folded(2).condition(0, [0.1])
    expected = np.full((3, 5), given.time.error_estimate)
    np.testing.assert_array_equal(given.error_estimate(np.zeros((3, 5, 2))), expected, strict=True)
    assert np.isneginf(given.log_prob([np.inf, 0.5]))
    assert given.marginal(0).event_shape == (1,)
    assert not given.has_rsample  # times are drawn by quantiles, which have no gradient


@pytest.mark.slow  # it compiles for long
@pytest.mark.parametrize(
    ("one", "other", "rest"),
    [
        (lambda d, x: d.condition(1, x[:, 1:2]).marginal([0, 2]), lambda d, x: _line(d, x, [0, 1, 3]), [0, 3]),
        (lambda d, x: d.condition(1, x[:, 1:2]).marginal([0]), lambda d, x: _line(d, x, [0, 1]), [0]),
        (lambda d, x: _line(d, x, [0, 1, 2]).condition(0, x[:, :1]), lambda d, x: _given(d, x).marginal([0]), [2]),
        (lambda d, x: d.condition(1, x[:, 1:2]).condition(0, x[:, :1]), lambda d, x: _given(d, x), [2, 3]),
        (lambda d, x: _given(d, x).condition(-1, x[:, 3:]), lambda d, x: d.condition([0, 3, 1], x[:, [0, 3, 1]]), [2]),
        (lambda d, x: _given(d, x).condition(-1, x[:, 3:]), lambda d, x: _given(d.condition_time(x[:, 3]), x), [2]),
    ],
)
@pytest.mark.parametrize("mixed", [False, True])
def test_conditioning_and_marginals_commute(one, other, rest, mixed):
    dist = folded(3)
    x = _points(dist, 5)
    if mixed:
        dist = FoldedMixture(folded(3, loc=[LOC, LOC + 0.2], time_loc=[0.4, 0.6]), weights=[0.3, 0.7])
    found, expected = (LOG_PROB(make(dist, x), x[:, rest]) for make in (one, other))
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


def _line(dist, x, kept):
    """Some coordinates, given the second."""
    return dist.marginal(kept).condition(1, x[:, 1:2])


def _given(dist, x):
    return dist.condition([0, 1], x[:, :2])


def _parabola(s, scale, power, dtype):
    """log p(s) where s = 0.1 + 0.8 u + 0.6 u^2, u = -0.3 tau, by trapezoids in long double.

    Around each crossing in the distance from it, of which the residual is an exact polynomial; the rest in tau.
    """
    c1, c2, width, s = (np.longdouble(dtype(x)) for x in (0.8, 0.6, 0.3, s))
    c1, c2, s = -c1 * width, c2 * width**2, s - np.longdouble(dtype(0.1))
    root = np.sqrt(c1 * c1 + 4 * c2 * s)
    roots = (-c1 + np.array([-1, 1]) * root) / (2 * c2)
    log_width = lambda tau: np.log(np.longdouble(dtype(scale))) - np.longdouble(power) * tau * tau / 4  # noqa: E731

    def log_integral(tau, residual, step, where=True):
        with np.errstate(over="ignore"):
            z = residual * np.exp(np.minimum(-log_width(tau), 11000))
        log_f = np.where(where, -0.5 * (z * z + tau * tau) - log_width(tau) - np.log(2 * np.longdouble(np.pi)), -np.inf)
        top = log_f.max()
        return top + np.log(np.exp(log_f - top).sum() * step)

    tau = np.linspace(-14, 14, 1_400_001).astype(np.longdouble)
    own = np.exp(log_width(roots)) / root  # standard deviations in tau
    rest, parts = np.ones(tau.size, bool), []
    for place, sd, speed in zip(roots, own, np.array([-1, 1]) * root, strict=True):
        if sd < 1e-3:
            offset = np.linspace(-12, 12, 4001).astype(np.longdouble) * sd
            parts.append(log_integral(place + offset, (speed + c2 * offset) * offset, sd * 24 / 4000))
            rest &= np.abs(tau - place) > 12 * sd
    parts.append(log_integral(tau, c1 * tau + c2 * tau * tau - s, np.longdouble(28) / 1_400_000, rest))
    return float(np.logaddexp.reduce(parts))


# Relative errors of p allowed, per unit of log p: those of a sum of 1e3 numbers, and the digits of log p itself.
_ACCURACY = {np.float64: 2e-13, np.float32: 2e-5}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_mass_on_a_curve_narrower_than_numbers_lie_apart(dtype):
    s = np.array([-0.15, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 50.0])
    scales, powers = np.array([0.3, 1e-4, 1e-7, 1e-12]), np.array([1.0, 1.0, 2.0, 1.0])
    marginal = FoldedGaussian(
        np.full((4, 1), 0.1, dtype),
        scales[:, None, None].astype(dtype),
        time_loc=dtype(0.4),
        time_scale=dtype(0.3),
        fold=PolynomialFold([[0.8], [0.6]]),
        envelope=TimeLikelihood(powers),
    ).marginal([0])
    x = jnp.asarray(s, dtype)[:, None, None]
    log_prob, error = np.asarray(LOG_PROB(marginal, x)), np.asarray(marginal.error_estimate(x))
    assert log_prob.dtype == dtype
    for i in range(4):
        expected = np.array([_parabola(y, scales[i], powers[i], dtype) for y in s])
        allowed = _ACCURACY[dtype] * np.maximum(1, np.abs(expected))
        np.testing.assert_array_less(np.abs(log_prob[:, i] - expected), allowed)
        assert (error[:, i] < 50 * allowed).all()
        # The error is no smaller than it says, but for a factor.
        assert (np.abs(log_prob[:, i] - expected) < 10 * error[:, i]).all()


@pytest.mark.parametrize(
    ("dtype", "scale", "s"),
    [
        (np.float64, 1e-17, 0.09),
        pytest.param(np.float32, 1e-9, 0.09, marks=pytest.mark.slow),
        pytest.param(np.float64, 0.3, 30.0, marks=pytest.mark.slow),
    ],
)
def test_time_where_space_tells_it_to_the_last_digit(dtype, scale, s):
    # s = u^2 passes twice, with half the mass at 0.4 - sqrt(s) and half at 0.4 + sqrt(s).
    s = dtype(s)
    dist = FoldedGaussian(
        np.zeros(1, dtype), [[scale]], time_loc=dtype(0.4), time_scale=dtype(0.3), fold=PolynomialFold([[0.0], [1.0]])
    )
    given = _repeated(s)
    density, root = dist.time_given_space(given), np.sqrt(s)
    eps = float(np.finfo(dtype).eps)
    assert (density.time.error_estimate < 5e4 * eps).all()
    near = {"rtol": 20 * eps, "atol": 20 * eps * root}
    modes = np.sort(density.modes()[:, :2])
    np.testing.assert_allclose(modes, np.broadcast_to([0.4 - root, 0.4 + root], modes.shape), **near)
    np.testing.assert_allclose(density.mean, 0.4, **near)
    np.testing.assert_allclose(density.variance, s, rtol=1e2 * eps)
    small = 100 * eps * (1 + root)
    t = np.array([-np.inf, 0.4 - root - small, 0.4 - root + small, 0.4, 0.4 + root - small, 0.4 + root + small, np.inf])
    t, share = jnp.asarray(t, dtype)[:, None], np.array([0, 0, 0.5, 0.5, 0.5, 1, 1])[:, None]
    np.testing.assert_allclose(density.cdf(t[..., None]), np.repeat(share, MANY, 1), atol=1e2 * eps)
    q = np.array([0, 0.1, 0.4, 0.6, 0.9, 1])
    places = np.array([-np.inf, 0.4 - root, 0.4 - root, 0.4 + root, 0.4 + root, np.inf])
    quantiles = density.icdf(jnp.asarray(np.tile(q, 8), dtype)[:, None])[..., 0]
    np.testing.assert_allclose(quantiles, np.tile(places, (MANY, 8)).T, **near)
    draws = np.asarray(density.sample(jax.random.key(0), (1008 // MANY,)))
    np.testing.assert_allclose(np.abs(draws - 0.4), root, rtol=20 * eps * (1 + 1 / root))
    # Binomial, 5 sd: p = 6e-7. Power: an atom of another share is off by sqrt(1000) times twice the difference.
    assert abs(np.mean(draws > 0.4) - 0.5) < 5 * 0.5 / np.sqrt(draws.size)
    joint = dist.condition([0], given)  # the same, as a mixture
    np.testing.assert_allclose(joint.mean, np.full((MANY, 1), 0.4), **near)
    np.testing.assert_allclose(joint.cdf(t[..., None]), np.repeat(share, MANY, 1), atol=1e2 * eps)


@pytest.mark.slow
def test_the_other_coordinate_where_time_is_known_to_the_last_digit():
    # Two curves (u^2, u + u^2): given s_1 = 0.09, s_2 is -0.21 or 0.39, half each, though s_2 | t is 1e-17 wide.
    fold = PolynomialFold([[0.0, 1.0], [1.0, 1.0]])
    dist = FoldedGaussian(np.zeros(2), scale=np.full(2, 1e-17), time_loc=0.4, time_scale=0.3, fold=fold)
    given = dist.condition([0], _repeated(0.09))
    np.testing.assert_allclose(given.mean, np.tile([0.09, 0.4], (MANY, 1)), atol=1e-15)
    np.testing.assert_allclose(given.variance, np.full((MANY, 2), 0.09), rtol=1e-13)
    at, share = _repeated(-jnp.inf, -0.22, -0.2, 0.3, 0.4, jnp.inf), [0, 0, 0.5, 0.5, 1, 1]
    np.testing.assert_allclose(CDF(given.marginal([0]), at), np.resize(share, MANY), atol=1e-13)


@pytest.mark.slow
def test_far_points():
    dist = folded(1, 1.0)
    marginal, far, t = dist.marginal([0]), jnp.array([[50.0], [-1e4], [1e6]]), jnp.full((3, 1), 0.3)
    log_prob, time = LOG_PROB(marginal, far), dist.time_given_space(far)
    assert np.isfinite(log_prob).all()
    np.testing.assert_allclose(time.time.log_normalizer, log_prob, rtol=1e-12)
    # Not at the modes: there the curve is narrower than times lie apart, and the density hangs on their rounding.
    log_time = LOG_PROB(time, t)
    assert np.isfinite(log_time).all()
    np.testing.assert_allclose(log_prob + log_time, LOG_PROB(dist, jnp.concatenate([far, t], -1)), rtol=1e-12)
    assert np.isfinite([time.mean, time.variance, time.icdf(0.5)]).all()
    near = jnp.array([[0.3], [3.0]])
    assert (marginal.error_estimate(near) < 1e-9).all()
    assert (dist.time_given_space(near).time.error_estimate < 1e-9).all()


def test_without_fold_density_is_gaussian_or_diverges():
    # On a ridge that stands still p(s) diverges for power (d-1) >= 2; next to it, or without an envelope, it does not.
    still = folded(2, jnp.array([1.0, 0.0]), fold=ZeroFold(2)).marginal([0, 1])
    x = LOC[:2] + np.array([[[0.0]], [[1e-3]]])
    values, error = still.log_prob(x), still.error_estimate(x)
    np.testing.assert_array_equal(np.isposinf(values), [[True, False], [False, False]])
    assert np.isfinite(values[1, 0])
    np.testing.assert_array_equal(np.isposinf(error), np.isposinf(values))
    gaussian = stats.multivariate_normal(LOC[:2], TRIL[:2, :2] @ TRIL[:2, :2].T)
    np.testing.assert_allclose(values[:, 1], gaussian.logpdf(x[:, 0]), rtol=1e-12)


def _far_quantities(dist, s, tau):
    """log p(s), its error; mean, median, P(time <= ...) of time given s, in tau; the first coordinate alone."""
    s, tau = jnp.asarray(s), jnp.asarray(tau)
    time, first = dist.time_given_space(s), dist.marginal([0])
    t = dist.time_loc + dist.time_scale * tau
    in_tau = lambda t: (t - dist.time_loc[None]) / dist.time_scale[None]  # noqa: E731
    return {
        "log p": time.time.log_normalizer,
        "error": time.time.error_estimate,
        "mean": in_tau(time.mean[..., 0]),
        "median": in_tau(time.icdf(0.5)[..., 0]),
        "cdf": time.cdf(t[..., None]),
        "first": first.log_prob(s[..., :1]),
        "first error": first.error_estimate(s[..., :1]),
        "first cdf": first.cdf(s[..., :1]),
    }


@pytest.mark.parametrize("num", [7, pytest.param(32, marks=pytest.mark.slow)])
def test_estimated_errors_near_a_ridge_are_no_smaller_than_the_errors(num):
    """In float32, where s - c(tau) rounds: on the curve and next to it, for wide ridges and for narrow ones."""
    rng, scales = np.random.default_rng(0), np.array([1e-2, 1e-3, 1e-7])
    with jax.enable_x64(False):
        narrow = FoldedGaussian(
            np.tile(np.float32([0.1, -0.4]), (3, 1)),
            np.float32([[1.0, 0.0], [0.3, 0.7]]) * scales[:, None, None].astype(np.float32),
            time_loc=np.float32([0.4] * 3),
            time_scale=np.float32([0.3] * 3),
            fold=PolynomialFold(np.float32([[0.8, -0.5], [0.6, 0.9]])),
            envelope=TimeLikelihood(),
        )
        center = np.asarray(narrow.condition_time(np.float32(rng.normal(0.4, 0.6, size=(num, 3)))).loc)
        away = 1 + np.float32([0, 6e-8, 2e-6])[:, None, None, None] * rng.normal(size=(3, *center.shape))
        s = np.float32(center * away)
        here = narrow.time_given_space(s).time  # the integrals of log_prob and of error_estimate are one
        log_p, estimate = np.asarray(here.log_normalizer), np.asarray(here.error_estimate)
    exact = jax.tree.map(lambda x: np.asarray(x, np.float64), narrow).time_given_space(np.float64(s)).time
    error = np.abs(log_p - np.asarray(exact.log_normalizer))
    assert log_p.dtype == np.float32
    assert (error <= estimate).all()
    typical = np.median(estimate, (0, 1)) / np.median(error, (0, 1))
    assert (typical < [60, 60, 300]).all()  # and no larger than they have to be; measured: 21, 22, 136


def test_the_estimated_error_near_a_ridge_is_the_effect_of_rounding():
    """At whitened distance z the rounding q changes log p by q (z + q), where the mass near this time is p(s).

    The ridge is a straight line, which is passed once (u) or twice (u^2).
    """
    tril, speed, eps = np.array([[1.0, 0.0], [0.3, 0.7]]), 0.3 * np.array([0.8, -0.5]), np.finfo(np.float64).eps
    cases = np.stack(np.meshgrid([1e-11, 1e-9, 1e-4, 3e-3], [0.5, -3.0], [0, 0.8, 4], [0.0, 1.0], 1), -1).reshape(-1, 5)
    rare = [[1e-18, 0.5, 0, 0, 1], [1e-17, 1, 0, 1, 1], [2e-19, 0, 0, 1, 1], [1e-9, 0, 0, 1, 1], [1e-4, 40, 0, 1, 1]]
    rare += [[1e-11, 1, 0, 0, 2], [1e-14, 1, 1, 0, 2], [1e-14, 1, 3, 0, 2]]
    scale, tau, z, power, times = np.concatenate([cases, rare]).T
    inverse, sharp, column = np.linalg.inv(tril) / scale[:, None, None], np.exp(power * tau**2 / 4), tau[:, None]
    place = (-column) ** times[:, None] * speed
    moved = times[:, None] * column ** (times[:, None] - 1) * speed
    rate = (inverse @ moved[..., None])[..., 0]
    side = np.stack([-rate[:, 1], rate[:, 0]], -1) / np.linalg.norm(rate, axis=-1)[:, None]
    s = place + (scale * z / sharp)[:, None] * (side @ tril.T)
    dist = FoldedGaussian(
        np.zeros((len(s), 2)),
        tril * scale[:, None, None],
        time_loc=0.4,
        time_scale=0.3,
        fold=PolynomialFold((times[:, None] == [1, 2])[..., None] * np.stack([speed / 0.3, speed / 0.09])),
        envelope=TimeLikelihood(power),
    )
    found = dist.time_given_space(s).time
    log_p, error = np.asarray(found.log_normalizer), np.asarray(found.error_estimate)
    size = np.abs(s) + np.abs(place) + np.abs(column * moved)
    q = eps * sharp * np.linalg.norm((np.abs(inverse) @ size[..., None])[..., 0], axis=-1)
    on, log_width = z <= 2 * q, -np.log(sharp * np.linalg.norm(rate, axis=-1))
    log_density = 2 * np.log(sharp / scale) - np.log(2 * np.pi * 0.7) - 0.5 * (tau**2 + np.where(on, 0, z) ** 2)
    log_part = log_density + log_width - log_p
    log_part -= np.where(log_width < -7, 0, 0.5 * np.log(2 * np.pi))  # a wide ridge bends
    np.testing.assert_allclose(log_part[scale == 1e-9], 0, atol=1e-5)  # all of the mass is there, and found
    with np.errstate(over="ignore"):  # far out nothing is known of log p
        change = q * (z + q + 0.1)
    reached = np.minimum(0, log_part + np.where(on, np.log(np.maximum(1, q)), 2 * change))
    expected = times * (change * np.exp(reached) + np.where(on & (log_part > 0.1), log_part, 0))
    rounding = 20 * eps * np.maximum(1, np.abs(log_p))
    assert (error > 0.97 * np.minimum(expected, 1e50)).all()
    assert (error < 1.08 * expected + rounding).all()
    assert (expected > 3 * rounding).sum() > 40  # and the errors of the other points are not larger
    # In one coordinate rounding moves a crossing, and changes the mass only where the curve turns back: to 0 or twice.
    line = folded(1, 0.0, loc=[0.0], scale_tril=[[1e-17]], fold=PolynomialFold([[0.8], [0.6]]))
    at_turn = line.time_given_space(_repeated(-(0.8**2) / 2.4)).time.error_estimate
    np.testing.assert_allclose(at_turn, np.full(MANY, 1.05), atol=0.05)


def test_the_density_of_space_does_not_depend_on_time_loc():
    density = folded(1, time_loc=np.array([0.4, 0.0, -3e3, 1e9, 7e12, 1.0, 2.0, 3.0])).time_given_space([0.3])
    log_p = np.asarray(density.time.log_normalizer)
    np.testing.assert_allclose(log_p, np.full(MANY, log_p[0]), rtol=1e-14)


@pytest.mark.slow
def test_a_ridge_that_quadrature_misses_is_said_to_be():
    """Panels are wider than a ridge of 1e-13. The estimated error is the mass of that ridge, a Gaussian integral."""
    for scale in (1e-10, 1e-13, 1e-16):
        dist = folded(2, power=1.0, scale_tril=scale * TRIL[:2, :2])
        speed = np.linalg.solve(TRIL[:2, :2], 0.3 * BEND[0, :2])  # in units of the ridge's width, per time_scale
        truth = -np.log(2 * np.pi * scale * TRIL[0, 0] * TRIL[1, 1] * np.linalg.norm(speed))
        marginal = dist.marginal([0, 1])
        error = abs(float(marginal.log_prob(LOC[:2])) - truth)
        np.testing.assert_allclose(marginal.error_estimate(LOC[:2]), error, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [1, 2])
def test_float32_far_out_agrees_with_float64(dim):
    # name: offset of space and time, time_scale, scale of space, power, floor
    cases = {
        "plain": (0.0, 0.3, 0.3, 1.0, 0.0),
        "short": (0.0, 1e-12, 0.3, 1.0, 0.0),
        "long": (0.0, 1e6, 0.3, 1.0, 0.0),
        "offset": (1e4, 0.3, 0.3, 1.0, 0.0),
        "power 2": (0.0, 0.3, 0.3, 2.0, 0.0),
        "floor": (0.0, 0.3, 0.3, 2.0, 0.01),
        "narrow": (0.0, 0.3, 1e-6, 1.0, 0.0),
        "wide": (0.0, 0.3, 1e6, 1.0, 0.0),
    }
    offset, time_scale, scale, power, floor = (np.asarray(x) for x in zip(*cases.values(), strict=True))
    tril = np.array([[1.0, 0.0], [0.2, 1.0]])[:dim, :dim] * scale[:, None, None]
    bend = np.array([[0.24, -0.15], [0.18, 0.27]])[:, :dim] / time_scale[:, None, None] ** np.array([[1.0], [2.0]])
    with jax.enable_x64(False):
        narrow = FoldedGaussian(
            np.repeat(offset[:, None], dim, 1),
            tril,
            time_loc=offset,
            time_scale=time_scale,
            fold=PolynomialFold(bend),
            envelope=TimeLikelihood(power, floor),
        )
        narrow = jax.tree.map(lambda x: x.astype(jnp.float32), narrow)
        # On the curve at tau, and next to it: 8 points of 8 cases, which are integrated together, compiled once.
        tau = np.array([0.0, -1.0, 3.0, 10.0, -1.0, -30.0, 1e3, 0.0])
        residual = np.array([0.0, 0.5, 0.0, 0.0, -2.0, 1e3, -1e10, 1e20])
        at = narrow.time_loc[None] + narrow.time_scale[None] * tau[:, None].astype(np.float32)
        s = np.asarray(narrow.condition_time(at).loc) + residual[:, None, None].astype(np.float32)
        when = np.float32(0.3)
        here = jax.tree.map(np.asarray, _far_quantities(narrow, s, when))
    exact = jax.tree.map(lambda x: np.asarray(x, np.float64), narrow)
    there = jax.tree.map(np.asarray, _far_quantities(exact, s.astype(np.float64), np.float64(when)))
    assert all(x.dtype == np.float32 for x in here.values())
    assert all((np.isfinite(x) | np.isneginf(x)).all() for x in (here["log p"], here["first"]))
    assert np.isfinite(here["first cdf"]).all()
    assert not np.isnan([here["error"], here["first error"]]).any()
    reached = np.isfinite(here["log p"])
    assert reached.mean() > 0.7
    assert np.isposinf(here["error"][~reached]).all()
    assert all(np.isfinite(here[k][reached]).all() for k in ("mean", "median", "cdf"))
    # log p to 2 digits less than stored, wherever the error does not say that it hangs on the rounding of s.
    for name, error in (("log p", "error"), ("first", "first error")):
        good = np.isfinite(here[name]) & (here[error] < 1e-4 * np.maximum(1, np.abs(there[name])))
        assert good.mean() > (0.6 if dim == 1 or name == "first" else 0.5)
        np.testing.assert_allclose(here[name][good], there[name][good], rtol=1e-5, atol=1e-5)
        if name == "log p":
            sharp = good & (here[error] < 1e-4)
            assert sharp.mean() > 0.25
    # Times at an offset of 1e4 are multiples of 1e-3, here 3e-3 time scales.
    spacing = np.broadcast_to(2.0**-23 * offset / time_scale, sharp.shape)
    for name in ("mean", "cdf", "median"):
        allowed = 1e-4 * (1 + np.abs(there[name])) + spacing
        assert (np.abs(here[name] - there[name]) < allowed)[sharp].all(), name
    np.testing.assert_allclose(here["first cdf"], there["first cdf"], atol=1e-4)


@pytest.mark.slow  # it compiles for long
def test_points_at_infinity():
    dist = folded(2)
    space, line, time = dist.marginal([0, 1]), dist.marginal([0]), dist.time_given_space([0.1, -0.4])
    for sign in (-1, 1):
        assert np.isneginf(LOG_PROB(line, jnp.array([sign * jnp.inf])))
        assert np.isneginf(LOG_PROB(space, jnp.array([0.3, sign * jnp.inf])))
        assert np.isneginf(LOG_PROB(time, sign * jnp.inf))
        assert np.isneginf(LOG_PROB(dist.condition([0], [0.3]), jnp.array([sign * jnp.inf, 0.5])))
        assert float(CDF(line, jnp.array([sign * jnp.inf]))) == (sign > 0)
        assert float(CDF(dist.condition([0], [0.3]).marginal([0]), jnp.array([sign * jnp.inf]))) == (sign > 0)
        assert float(CDF(time, sign * jnp.inf)) == (sign > 0)
    np.testing.assert_array_equal(time.icdf(jnp.array([0.0, 1.0, -0.1, 1.1]))[:, 0], [-np.inf, np.inf, np.nan, np.nan])
    assert np.isfinite(time.icdf(jnp.array([1e-300, 1 - 1e-16]))).all()


def test_gradients_go_through_the_integral():
    log_prob = lambda loc, s: folded(1, loc=loc[None]).marginal([0]).log_prob(s)  # noqa: E731
    both = jax.jit(jax.value_and_grad(log_prob, argnums=(0, 1)))
    loc, s, step = jnp.asarray(0.1), jnp.array([0.5]), 1e-5
    value, (by_loc, by_s) = both(loc, s)
    np.testing.assert_allclose(value, np.log(_density_of_one(folded(1), 0.5)), rtol=1e-10)
    np.testing.assert_allclose(by_loc, (both(loc + step, s)[0] - both(loc - step, s)[0]) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(by_s[0], -by_loc, rtol=1e-9)  # p(s) knows s - loc only


# --- doors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("indices", "expected"),
    [
        *(([], "whole"), ([0.5], "whole"), ([np.inf], "whole"), ("s", "whole"), ([True, False], "whole")),
        *(([3], "numbers from"), ([0, 0], "each"), ([2, -1], "each")),
    ],
)
def test_indices_are_checked(indices, expected):
    for call in (lambda: folded().marginal(indices), lambda: folded().condition(indices, [0.0] * len(indices))):
        with pytest.raises(ValueError, match=f"^indices: expected {expected}"):
            call()


@pytest.mark.parametrize(
    ("request_of", "message"),
    [
        (lambda dist: dist.marginal([2, 0]), "indices: expected time last, got "),
        (lambda _: folded(3).condition(0, [0.1]).marginal([0, 2, 1]), "indices: expected time last, got "),
        (
            lambda dist: dist.condition([0, 1, 2], np.zeros(3)),
            "indices: expected at least one coordinate that is not given, got all",
        ),
        (lambda dist: dist.condition([0], [0.0, 1.0]), "values: expected shape "),
        (lambda dist: dist.time_given_space([0.0]), "s: expected shape "),
        (lambda dist: dist.marginal([0, 1]).cdf(np.zeros(2)), "cdf: expected one coordinate, got 2"),
        (
            lambda dist: dist.marginal([0, 1]).modes(),
            "modes: expected the distribution of time given space, got 2 coordinates",
        ),
        (
            lambda dist: dist.condition(0, [0.1]).icdf(0.5),
            "icdf: expected the distribution of time given space, got 2 coordinates",
        ),
        (lambda dist: dist.marginal([0, 1]).log_prob(np.zeros(3)), "value: expected shape "),
    ],
)
def test_bad_requests_are_refused(request_of, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        request_of(folded())
