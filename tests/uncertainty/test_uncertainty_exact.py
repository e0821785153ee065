"""The forward-backward algorithm, against quadrature and Gaussians."""

import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from time_clips import parabolas

from foldgauss.uncertainty import FrameTimeLogProb, ProfileCurves, exact_posterior

#: Far from each other, in standard deviations: the order does not constrain them, and the posterior is Gaussian.
FAR = np.array([0.2, 0.4, 0.55, 0.8]), np.array([0.01, 0.02, 0.015, 0.01])


def flat_except(num_frames: int, known: tuple[int, ...] = (), at: float = 0.4, width: float = 1e-6) -> ProfileCurves:
    """Flat profiles, except for the frames `known`, at `at` with standard deviation `width`."""
    vague = np.linspace(0, 1, 4 * num_frames)
    near = np.concatenate([[0], at + width * np.linspace(-40, 40, 801), [1]])
    nodes = [near if k in known else vague for k in range(num_frames)]
    values = [-(((near - at) / width) ** 2) / 2 if k in known else 0 * vague for k in range(num_frames)]
    return ProfileCurves.from_nodes(nodes, values)


def assert_near(found, frames, priors, starts, lengths):
    """Marginals of `frames` are Beta densities, each stretched to its length."""
    for k, prior, start, length in zip(frames, priors, starts, lengths, strict=True):
        std = prior.std() * length
        assert found.mean()[k] == pytest.approx(start + length * prior.mean(), abs=5e-3 * std)
        assert found.std()[k] == pytest.approx(std, rel=3e-3)
        np.testing.assert_allclose(
            np.stack(found.interval(0.9))[:, k], start + length * prior.ppf([0.05, 0.95]), atol=5e-3 * std
        )


def by_quadrature(curves, concentration, far: float, points: int):
    """Mean and covariance of the free times, and the log-evidence, by sums over a grid of log-ratios of increments."""
    num = curves.num_frames - 2
    z = np.linspace(-far, far, points)
    grid = np.stack(np.meshgrid(*[z] * num, indexing="ij"), -1).reshape(-1, num)
    fractions = scipy.special.softmax(np.concatenate([grid, np.zeros((len(grid), 1))], 1), axis=1)
    times = np.cumsum(fractions, axis=1)[:, :-1]
    heights = FrameTimeLogProb(curves, concentration)(times) + np.log(fractions).sum(1)  # the Jacobian
    weights = np.exp(heights - heights.max())
    mean = weights @ times / weights.sum()
    covariance = (times - mean).T @ ((times - mean) * weights[:, None]) / weights.sum()
    return mean, covariance, np.log(weights.sum()) + heights.max() + num * np.log(z[1] - z[0])


@pytest.mark.parametrize("concentration", [1.0, 1.5, 20.0])
@pytest.mark.parametrize("means", [(0.4, 0.6), (0.5, 0.52), (0.62, 0.45), (0.1, 0.9)])
def test_two_frames_agree_with_quadrature(concentration, means):
    # Also where frames are so near, or so far out of order, that only their order separates them.
    curves = parabolas(means, (0.06, 0.1), 401)
    mean, covariance, likelihood_profiles = by_quadrature(curves, concentration, 14, 501)
    found = exact_posterior(curves, concentration)
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.mean()[1:-1], mean, atol=2e-3 * std.min())
    np.testing.assert_allclose(found.std()[1:-1], std, rtol=2e-3)
    assert found.log_evidence == pytest.approx(likelihood_profiles, abs=1e-3)


@pytest.mark.parametrize("concentration", [1.0, 4.0])
def test_three_frames_agree_with_quadrature(concentration):
    curves = parabolas((0.3, 0.42, 0.6), (0.06, 0.08, 0.07), 401)
    mean, covariance, likelihood_profiles = by_quadrature(curves, concentration, 10.0, 91)
    found = exact_posterior(curves, concentration)
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.mean()[1:-1], mean, atol=2e-3 * std.min())
    np.testing.assert_allclose(found.std()[1:-1], std, rtol=2e-3)
    assert found.log_evidence == pytest.approx(likelihood_profiles, abs=2e-3)


def test_draws_have_the_quadratures_covariance():
    curves = parabolas((0.5, 0.52), (0.06, 0.1), 401)
    _, covariance, _ = by_quadrature(curves, 1.0, 14, 501)
    draws = exact_posterior(curves).sample(10_000, 1)[:, 1:-1]
    found = np.corrcoef(draws.T)[0, 1]
    assert found == pytest.approx(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]), abs=0.02)
    np.testing.assert_allclose(np.cov(draws.T).diagonal(), covariance.diagonal(), rtol=0.03)
    assert (np.diff(draws) > 0).all()


def test_frames_far_apart_are_gaussian():
    means, widths = FAR
    found = exact_posterior(parabolas(*FAR, 801))
    np.testing.assert_allclose(found.mean()[1:-1], means, atol=1e-5)
    np.testing.assert_allclose(found.std()[1:-1], widths, rtol=2e-3)
    normal = scipy.stats.norm(means, widths)
    for level in (0.5, 0.9):
        np.testing.assert_allclose(
            np.stack(found.interval(level))[:, 1:-1], normal.interval(level), atol=5e-3 * widths.min()
        )
    # The evidence: each Gaussian's integral, and the prior's constant 5!.
    constant = np.log(widths * np.sqrt(2 * np.pi)).sum() + np.log(24)
    assert found.log_evidence == pytest.approx(constant, abs=5e-3)


def test_draws_follow_the_known_marginals():
    means, widths = FAR
    found = exact_posterior(parabolas(*FAR, 801))
    draws = found.sample(5000, 3)
    for k in range(4):  # false-alarm rate 1e-3 each; power: a width wrong by a fifth fails
        assert scipy.stats.kstest(draws[:, k + 1], scipy.stats.norm(means[k], widths[k]).cdf).pvalue > 1e-3
        assert scipy.stats.kstest(draws[:, k + 1], scipy.stats.norm(means[k], 1.2 * widths[k]).cdf).pvalue < 1e-3
    np.testing.assert_array_equal(draws, found.sample(5000, 3))
    assert (draws != found.sample(5000, 4)).any()


@pytest.mark.parametrize("concentration", [1.0, 4.0, pytest.param(20.0, marks=pytest.mark.slow)])
def test_draws_follow_the_exact_marginals_where_order_ties(concentration):
    found = exact_posterior(parabolas((0.45, 0.47, 0.6), (0.08, 0.08, 0.1), 401), concentration)
    draws = found.sample(4000, 0)
    for n, (edges, masses) in enumerate(zip(found.edges, found.masses, strict=True)):
        summed = np.concatenate([[0], np.cumsum(masses)])

        def cdf(t, edges=edges, summed=summed):
            return np.interp(t, edges, summed)

        assert scipy.stats.kstest(draws[:, n + 1], cdf).pvalue > 1e-3


LONG = [
    pytest.param(n, a, marks=pytest.mark.slow) for n, a in ((30, 3.0), (30, 20.0), (150, 1.0), (150, 3.0), (150, 20.0))
]


@pytest.mark.parametrize(("num", "concentration"), [(4, 1.0), (4, 3.0), (4, 20.0), (30, 1.0), *LONG])
def test_flat_profiles_give_the_prior(num, concentration):
    found = exact_posterior(flat_except(num), concentration)
    frames = sorted({1, 2, num // 3, num // 2, num - 2})
    priors = [scipy.stats.beta(concentration * k, concentration * (num - 1 - k)) for k in frames]
    assert_near(found, frames, priors, [0] * len(frames), [1] * len(frames))
    assert found.log_evidence == pytest.approx(0, abs=5e-3 if num > 100 else 1e-3)


@pytest.mark.parametrize("concentration", [1.0, 3.0, 20.0])
def test_known_frame_splits_the_prior_in_two(concentration):
    # Its time is known to 1e-6, all others are flat: Beta densities on both sides.
    num, known = 12, 5
    found = exact_posterior(flat_except(num, (known,)), concentration)
    before, after = [1, 2, known - 1], [known + 1, known + 2, num - 2]
    priors = [scipy.stats.beta(concentration * k, concentration * (known - k)) for k in before]
    assert_near(found, before, priors, [0] * 3, [0.4] * 3)
    priors = [scipy.stats.beta(concentration * (k - known), concentration * (num - 1 - k)) for k in after]
    assert_near(found, after, priors, [0.4] * 3, [0.6] * 3)
    assert found.std()[known] == pytest.approx(1e-6, rel=2e-3)
    likelihood_profiles = scipy.stats.beta(concentration * known, concentration * (num - 1 - known)).logpdf(0.4)
    assert found.log_evidence == pytest.approx(likelihood_profiles + np.log(1e-6 * np.sqrt(2 * np.pi)), abs=3e-3)


@pytest.mark.parametrize(
    ("gap", "concentration"),
    [
        *[(1e-4, 1.0), (1e-4, 20.0), (0.2, 1.0)],
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((1e-4, 3.0), (0.2, 3.0), (0.2, 20.0))),
    ],
)
def test_evidence_of_increments_that_the_prior_hardly_allows(gap, concentration):
    num, known, width = 30, 12, 1e-7
    parts = [flat_except(num, (known + n,), 0.4 + n * gap, width)[known + n] for n in (0, 1)]
    flat = flat_except(num)
    curves = [parts[k - known] if k in (known, known + 1) else flat[k] for k in range(num)]
    curves = ProfileCurves.from_nodes(*zip(*(each.nodes_and_values(0) for each in curves), strict=True))
    found = exact_posterior(curves, concentration)
    grouped = concentration * np.array([known, 1, num - 2 - known])
    expected = scipy.stats.dirichlet.logpdf([0.4, gap, 0.6 - gap], grouped) + 2 * np.log(width * np.sqrt(2 * np.pi))
    assert found.log_evidence == pytest.approx(expected, abs=0.02)
    np.testing.assert_allclose(found.mean()[[known, known + 1]], [0.4, 0.4 + gap], atol=3 * width)


@pytest.mark.slow
def test_many_flat_profiles_need_few_grid_points():
    found = exact_posterior(flat_except(300))
    assert max(map(len, found.edges)) < 1000
    assert_near(found, [150], [scipy.stats.beta(150, 149)], [0], [1])


# Draws of a concentration other than 1 take long. Of 500 draws the test of an increment finds half of the errors of its
# distribution function of 0.09, of 3,000 draws half of those of 0.04.
@pytest.mark.parametrize(
    ("concentration", "many", "known"),
    [
        *[(1.0, 3000, ()), (1.0, 3000, (5,)), (1.5, 500, (5,)), pytest.param(1.5, 500, (), marks=pytest.mark.slow)],
        *(pytest.param(c, 3000, k, marks=pytest.mark.slow) for c in (1.5, 3.0, 20.0) for k in ((), (5,))),
    ],
)
def test_increments_of_draws_follow_the_prior(concentration, many, known):
    num = 12
    draws = exact_posterior(flat_except(num, known), concentration).sample(many, 5)
    steps = np.diff(draws)
    assert (steps > 0).all()
    for k in (0, 1, 3, 7, 10):
        if known:
            start, stop = (0, 5) if k < 5 else (5, 11)
        else:
            start, stop = 0, 11
        length = {(0, 5): 0.4, (5, 11): 0.6, (0, 11): 1.0}[start, stop]
        prior = scipy.stats.beta(concentration, concentration * (stop - start - 1))
        assert scipy.stats.kstest(steps[:, k] / length, prior.cdf).pvalue > 1e-3
        if not known:
            marginal = scipy.stats.beta(concentration * (k + 1), concentration * (10 - k)) if k < 10 else None
            assert marginal is None or scipy.stats.kstest(draws[:, k + 1], marginal.cdf).pvalue > 1e-3


def test_levels_are_checked():
    found = exact_posterior(parabolas(np.array([0.5]), np.array([0.1])), 1.0)
    with pytest.raises(ValueError, match=r"^level: expected a number in \[0, 1\], got 1.5"):
        found.interval(1.5)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), concentration=st.sampled_from([1.0, 1.5, 3.0]))
def test_densities_integrate_to_one_and_means_increase(seed, concentration):
    rng = np.random.default_rng(seed)
    num = int(rng.integers(1, 6))
    curves = parabolas(np.sort(rng.uniform(0.1, 0.9, num)), rng.uniform(0.02, 0.3, num))
    found = exact_posterior(curves, concentration)
    for edges, masses in zip(found.edges, found.masses, strict=True):
        assert (masses >= 0).all()
        assert masses.sum() == pytest.approx(1)
        assert (np.diff(edges) > 0).all()
    assert (np.diff(found.mean()) > 0).all()
    assert (np.diff(found.quantile(0.5)) > 0).all()
    assert (found.interval(0.5)[0] >= found.interval(0.9)[0]).all()
    assert (np.diff(found.sample(20)) >= 0).all()


def test_narrow_profiles_out_of_order_raise():
    with pytest.raises(ValueError, match="order"):
        exact_posterior(parabolas((0.7, 0.3), (1e-3, 1e-3), 2001))


def test_probabilities_of_quantiles_are_checked():
    found = exact_posterior(parabolas([0.5], [0.1]))
    with pytest.raises(ValueError, match="probability"):
        found.quantile(1.5)
