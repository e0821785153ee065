"""The forward-backward algorithm, against quadrature and Gaussians."""

import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from time_clips import exact_cdfs, free_times, parabolas

from foldgauss.uncertainty import FrameTimeLogProb, Increments, ProfileCurves, exact_posterior

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


def by_quadrature(curves, increments, far: float, points: int):
    """Mean and covariance of the free times, and the log-evidence, by sums over a grid of log-ratios of increments."""
    num = increments.num_free
    z = np.linspace(-far, far, points)
    grid = np.stack(np.meshgrid(*[z] * num, indexing="ij"), -1).reshape(-1, num)
    fractions = scipy.special.softmax(np.concatenate([grid, np.zeros((len(grid), 1))], 1), axis=1)
    times = np.cumsum(fractions, axis=1)[:, :-1]
    heights = FrameTimeLogProb(curves, increments)(times) + np.log(fractions).sum(1)  # the Jacobian
    weights = np.exp(heights - heights.max())
    mean = weights @ times / weights.sum()
    covariance = (times - mean).T @ ((times - mean) * weights[:, None]) / weights.sum()
    return mean, covariance, np.log(weights.sum()) + heights.max() + num * np.log(z[1] - z[0])


#: Means of two frames, also where these are so near, or so far out of order, that only their order separates them.
TWO = (0.4, 0.6), (0.5, 0.52), (0.62, 0.45), (0.1, 0.9)


@pytest.mark.parametrize(
    ("means", "widths", "concentration", "grid", "tolerance"),
    [
        *((means, (0.06, 0.1), a, (14, 501), 1e-3) for a in (1.0, 1.5, 20.0) for means in TWO),
        *(((0.3, 0.42, 0.6), (0.06, 0.08, 0.07), a, (10.0, 91), 2e-3) for a in (1.0, 4.0)),
    ],
)
def test_few_frames_agree_with_quadrature(means, widths, concentration, grid, tolerance):
    curves, increments = parabolas(means, widths, 401), free_times(len(means) + 2, concentration)
    mean, covariance, log_evidence = by_quadrature(curves, increments, *grid)
    found = exact_posterior(curves, increments)
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.mean()[1:-1], mean, atol=2e-3 * std.min())
    np.testing.assert_allclose(found.std()[1:-1], std, rtol=2e-3)
    assert found.log_evidence == pytest.approx(log_evidence, abs=tolerance)


def test_draws_have_the_quadratures_covariance():
    curves, increments = parabolas((0.5, 0.52), (0.06, 0.1), 401), free_times(4)
    _, covariance, _ = by_quadrature(curves, increments, 14, 501)
    draws = exact_posterior(curves, increments).sample(10_000, 1)[:, 1:-1]
    found = np.corrcoef(draws.T)[0, 1]
    assert found == pytest.approx(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]), abs=0.02)
    np.testing.assert_allclose(np.cov(draws.T).diagonal(), covariance.diagonal(), rtol=0.03)
    assert (np.diff(draws) > 0).all()


def test_frames_far_apart_are_gaussian():
    means, widths = FAR
    found = exact_posterior(parabolas(*FAR, 801), free_times(6))
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


def p_values(draws, found):
    return [scipy.stats.kstest(own, cdf).pvalue for own, cdf in zip(draws.T[1:-1], exact_cdfs(found), strict=True)]


@pytest.mark.parametrize("concentration", [1.0, 4.0, 20.0])
def test_draws_follow_the_exact_marginals_where_order_ties(concentration):
    found = exact_posterior(parabolas((0.45, 0.47, 0.6), (0.08, 0.08, 0.1), 401), free_times(5, concentration))
    assert min(p_values(found.sample(4000, 0), found)) > 1e-3


def test_draws_follow_the_exact_marginals_and_reproduce():
    found, wide = (exact_posterior(parabolas(FAR[0], scale * FAR[1], 801), free_times(6)) for scale in (1, 1.2))
    draws = found.sample(5000, 3)
    assert min(p_values(draws, found)) > 1e-3  # false-alarm rate 1e-3 each
    assert max(p_values(draws, wide)) < 1e-3  # power: a width wrong by a fifth fails
    np.testing.assert_array_equal(draws, found.sample(5000, 3))
    assert (draws != found.sample(5000, 4)).any()


LONG = [pytest.param(150, a, marks=pytest.mark.slow) for a in (1.0, 3.0, 20.0)]


@pytest.mark.parametrize(("num", "concentration"), [*[(n, a) for n in (4, 30) for a in (1.0, 3.0, 20.0)], *LONG])
def test_flat_profiles_give_the_prior(num, concentration):
    found = exact_posterior(flat_except(num), free_times(num, concentration))
    frames = sorted({1, 2, num // 3, num // 2, num - 2})
    priors = [scipy.stats.beta(concentration * k, concentration * (num - 1 - k)) for k in frames]
    assert_near(found, frames, priors, [0] * len(frames), [1] * len(frames))
    assert found.log_evidence == pytest.approx(0, abs=5e-3 if num > 100 else 1e-3)


@pytest.mark.parametrize("concentration", [1.0, 3.0, 20.0])
def test_known_frame_splits_the_prior_in_two(concentration):
    # Its time is known to 1e-6, all others are flat: Beta densities on both sides.
    num, known = 12, 5
    found = exact_posterior(flat_except(num, (known,)), free_times(num, concentration))
    before, after = [1, 2, known - 1], [known + 1, known + 2, num - 2]
    priors = [scipy.stats.beta(concentration * k, concentration * (known - k)) for k in before]
    assert_near(found, before, priors, [0] * 3, [0.4] * 3)
    priors = [scipy.stats.beta(concentration * (k - known), concentration * (num - 1 - k)) for k in after]
    assert_near(found, after, priors, [0.4] * 3, [0.6] * 3)
    assert found.std()[known] == pytest.approx(1e-6, rel=2e-3)
    likelihood_profiles = scipy.stats.beta(concentration * known, concentration * (num - 1 - known)).logpdf(0.4)
    assert found.log_evidence == pytest.approx(likelihood_profiles + np.log(1e-6 * np.sqrt(2 * np.pi)), abs=3e-3)


@pytest.mark.parametrize("concentration", [1.0, 3.0, 20.0])
@pytest.mark.parametrize("gap", [1e-4, 0.2])
def test_evidence_of_increments_that_the_prior_hardly_allows(concentration, gap):
    num, known, width = 30, 12, 1e-7
    parts = [flat_except(num, (known + n,), 0.4 + n * gap, width)[known + n] for n in (0, 1)]
    flat = flat_except(num)
    curves = [parts[k - known] if k in (known, known + 1) else flat[k] for k in range(num)]
    curves = ProfileCurves.from_nodes(*zip(*(each.nodes_and_values(0) for each in curves), strict=True))
    found = exact_posterior(curves, free_times(num, concentration))
    grouped = concentration * np.array([known, 1, num - 2 - known])
    expected = scipy.stats.dirichlet.logpdf([0.4, gap, 0.6 - gap], grouped) + 2 * np.log(width * np.sqrt(2 * np.pi))
    assert found.log_evidence == pytest.approx(expected, abs=0.02)
    np.testing.assert_allclose(found.mean()[[known, known + 1]], [0.4, 0.4 + gap], atol=3 * width)


def test_many_flat_profiles_need_few_grid_points():
    found = exact_posterior(flat_except(300), free_times(300))
    assert max(map(len, found.edges)) < 1000
    assert_near(found, [150], [scipy.stats.beta(150, 149)], [0], [1])


# Draws of a concentration other than 1 take long. Of 500 draws the test of an increment finds half of the errors of its
# distribution function of 0.09, of 3,000 draws half of those of 0.04.
@pytest.mark.parametrize(
    ("concentration", "num", "many"),
    [(1.0, 12, 3000), (1.5, 7, 500), *(pytest.param(c, 12, 3000, marks=pytest.mark.slow) for c in (1.5, 3.0, 20.0))],
)
@pytest.mark.parametrize("known", [False, True])
def test_increments_of_draws_follow_the_prior(concentration, num, many, known):
    last, middle = num - 1, num // 2 - 1
    found = exact_posterior(flat_except(num, (middle,) if known else ()), free_times(num, concentration))
    steps = np.diff(found.sample(many, 5))
    assert (steps > 0).all()
    runs = [(0, middle, 0.4), (middle, last, 0.6)] if known else [(0, last, 1.0)]
    for k in (0, 1, 3, num - 5, num - 2):
        start, stop, length = next(run for run in runs if k < run[1])
        prior = scipy.stats.beta(concentration, concentration * (stop - start - 1))
        assert scipy.stats.kstest(steps[:, k] / length, prior.cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    ("method", "message"),
    [("interval", r"^level: expected a number in \[0, 1\], got 1.5"), ("quantile", "probability")],
)
def test_levels_are_checked(method, message):
    found = exact_posterior(parabolas([0.5], [0.1]), free_times(3))
    with pytest.raises(ValueError, match=message):
        getattr(found, method)(1.5)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), concentration=st.sampled_from([1.0, 1.5, 3.0]))
def test_densities_integrate_to_one_and_means_increase(seed, concentration):
    rng = np.random.default_rng(seed)
    num = int(rng.integers(1, 6))
    curves = parabolas(np.sort(rng.uniform(0.1, 0.9, num)), rng.uniform(0.02, 0.3, num))
    found = exact_posterior(curves, free_times(num + 2, concentration))
    for edges, masses in zip(found.edges, found.masses, strict=True):
        assert (masses >= 0).all()
        assert masses.sum() == pytest.approx(1)
        assert (np.diff(edges) > 0).all()
    assert (np.diff(found.mean()) > 0).all()
    assert (np.diff(found.quantile(0.5)) > 0).all()
    assert (found.interval(0.5)[0] >= found.interval(0.9)[0]).all()
    assert (np.diff(found.sample(20)) >= 0).all()


def test_runs_are_independent():
    held = np.array([0, 0.2, 0.4, 0.55, 0.8, 1])
    curves = parabolas(*FAR, 801)
    part = exact_posterior(curves, Increments(held, [1, 3, 4]))
    np.testing.assert_allclose(part.std()[[0, 2, 5]], 0)
    np.testing.assert_allclose(part.std()[[1, 3, 4]], FAR[1][[0, 2, 3]], rtol=5e-3)
    np.testing.assert_array_equal(part.sample(5)[:, 2], 0.4)


def test_narrow_profiles_out_of_order_raise():
    with pytest.raises(ValueError, match="order"):
        exact_posterior(parabolas((0.7, 0.3), (1e-3, 1e-3), 2001), free_times(4))
