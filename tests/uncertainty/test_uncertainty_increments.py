"""The prior of frame times is a density of increasing times."""

import numpy as np
import pytest
import scipy.stats

from foldgauss.uncertainty import FrameTimeLogProb, ProfileCurves, exact_posterior
from foldgauss.uncertainty.posterior.log_prob import log_prior, logits_of


@pytest.mark.parametrize("concentration", [1.0, 1.5, 4.0])
def test_prior_is_the_dirichlet_of_the_increments(concentration):
    steps = scipy.stats.dirichlet(np.full(6, concentration))
    drawn = steps.rvs(4, random_state=0)
    times = np.pad(np.cumsum(drawn, axis=1), ((0, 0), (1, 0)))
    np.testing.assert_allclose(log_prior(times, concentration), [steps.logpdf(each) for each in drawn], rtol=1e-9)
    times[0, 1:3] = times[0, [2, 1]]
    times[1, 2] = times[1, 1]
    assert np.isneginf(log_prior(times, concentration)).tolist() == [True, True, False, False]


def test_logits_are_centered_and_give_the_times_back():
    steps = np.random.default_rng(0).dirichlet(np.ones(5), 7)
    times = np.pad(np.cumsum(steps, axis=1), ((0, 0), (1, 0)))
    logits = logits_of(times)
    np.testing.assert_allclose(logits.mean(-1), 0, atol=1e-12)
    weights = np.exp(logits)
    np.testing.assert_allclose(np.cumsum(weights / weights.sum(-1, keepdims=True), -1), times[:, 1:], rtol=1e-12)
    times[:, 2] = times[:, 1]
    assert np.isfinite(logits_of(times)).all()


@pytest.mark.parametrize("function", [FrameTimeLogProb, exact_posterior])
def test_what_is_refused(function):
    nodes = np.linspace(0, 1, 5)
    for value in (0.5, np.nan, "a", None, np.inf):
        with pytest.raises(ValueError, match="concentration"):
            function(ProfileCurves.from_nodes([nodes] * 4, [-nodes] * 4), value)
    with pytest.raises(ValueError, match="curves: expected at least 3 frames, got 2"):
        function(ProfileCurves.from_nodes([nodes] * 2, [-nodes] * 2))


def test_shapes_and_nan_are_checked():
    nodes = np.linspace(0, 1, 5)
    log_prob = FrameTimeLogProb(ProfileCurves.from_nodes([nodes] * 4, [-nodes] * 4))
    free = np.array([[0.3, 0.6], [0.1, 0.2]])
    assert np.isfinite(log_prob(free)).all()
    np.testing.assert_array_equal(log_prob.times(free), [[0, 0.3, 0.6, 1], [0, 0.1, 0.2, 1]])
    with pytest.raises(ValueError, match="free: expected shape"):
        log_prob(np.zeros(4))
    broken = ProfileCurves(nodes * np.ones((4, 1)), np.full((4, 5), np.nan), np.zeros((4, 5)), np.full(4, 5))
    with pytest.raises(ValueError, match="NaN"):
        FrameTimeLogProb(broken)(np.array([0.3, 0.6]))
