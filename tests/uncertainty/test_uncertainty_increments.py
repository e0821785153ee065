"""Free and held times, and a prior that is a density."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from time_clips import free_times

from foldgauss.uncertainty import FrameTimeLogProb, Increments, ProfileCurves
from foldgauss.uncertainty.posterior.increments import logits_of

HELD = np.array([0.0, 0.1, 0.25, 0.3, 0.55, 0.7, 1.0])


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), frames=st.sets(st.integers(1, 5), min_size=1))
def test_free_times_are_placed_among_held_ones(seed, frames):
    increments = Increments(HELD, sorted(frames))
    drawn = increments.draw_prior(np.random.default_rng(seed), 3)
    assert (np.diff(drawn) > 0).all()
    np.testing.assert_array_equal(drawn[:, ~increments.free], np.broadcast_to(HELD, drawn.shape)[:, ~increments.free])
    np.testing.assert_array_equal(increments.times(drawn[:, increments.free]), drawn)
    assert np.isfinite(increments.log_prior(drawn)).all()
    assert increments.num_free == len(frames) == sum(last - first + 1 for first, last in increments.runs)


def test_runs_are_stretches_of_free_frames():
    assert Increments(HELD, [1, 2, 4]).runs == [(1, 2), (4, 4)]
    assert Increments([0, np.nan, -7, 0.3, 0.55, 0.7, 1.0], [1, 2]).runs == [(1, 2)]  # times of free frames are ignored


@pytest.mark.parametrize("concentration", [1.0, 1.5, 4.0])
def test_prior_is_the_dirichlet_of_each_run(concentration):
    increments = Increments(HELD, [1, 2, 4], concentration)
    times = increments.draw_prior(np.random.default_rng(0), 4)
    expected = 0.0
    for run, length in ((slice(0, 4), 0.3), (slice(3, 6), 0.4)):
        steps = np.diff(times[:, run]) / length
        density = scipy.stats.dirichlet(np.full(steps.shape[1], concentration)).logpdf
        expected = expected + np.array([density(each) for each in steps]) - (steps.shape[1] - 1) * np.log(length)
    np.testing.assert_allclose(increments.log_prior(times), expected, rtol=1e-9)
    times[0, 1:3] = times[0, [2, 1]]
    times[1, 2] = times[1, 1]
    assert np.isneginf(increments.log_prior(times)).tolist() == [True, True, False, False]


def test_log_prior_is_what_draws_of_it_follow():
    # t_1 of 4 increments is Beta(a, 3a); false-alarm rate 1e-3.
    times = free_times(5, 2.0).draw_prior(np.random.default_rng(0), 5000)
    for k in (1, 2, 3):
        assert scipy.stats.kstest(times[:, k], scipy.stats.beta(2 * k, 8 - 2 * k).cdf).pvalue > 1e-3
    assert scipy.stats.kstest(times[:, 1], scipy.stats.beta(2.5, 7.5).cdf).pvalue < 1e-3


def test_logits_are_centered_and_give_the_times_back():
    times = free_times(6).draw_prior(np.random.default_rng(0), 7)
    logits = logits_of(times)
    np.testing.assert_allclose(logits.mean(-1), 0, atol=1e-12)
    weights = np.exp(logits)
    np.testing.assert_allclose(np.cumsum(weights / weights.sum(-1, keepdims=True), -1), times[:, 1:], rtol=1e-12)
    times[:, 2] = times[:, 1]
    assert np.isfinite(logits_of(times)).all()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        *[({"concentration": value}, "concentration") for value in (0.5, np.nan, "a", None, np.inf)],
        *[
            ({"frames": value}, "frames")
            for value in ([], [0, 1], [6], [1.5], 3, [[1], [2]], [[1], [2, 3]], "12", HELD > 0.5)
        ],
        ({"held": HELD[::-1].copy()}, "held"),
        ({"held": HELD + 0.1}, "held: expected times in .*1.1 of frame 6"),
        ({"held": HELD - 0.1}, "held"),
        ({"held": np.where(HELD == 0.55, 0.9, HELD)}, "held: expected increasing times.*frame 4 .*frame 5"),
        ({"held": np.where(HELD == 0.55, 0.7, HELD)}, "held"),
        ({"held": np.full(7, np.nan)}, "held"),
        ({"held": "x"}, "held"),
        ({"held": HELD[:2], "frames": None}, "held"),
    ],
)
def test_what_is_refused(change, word):
    with pytest.raises(ValueError, match=word):
        Increments(**{"held": HELD, "frames": [1, 2], "concentration": 1.0, **change})


def test_shapes_and_nan_are_checked():
    nodes = np.linspace(0, 1, 5)
    log_prob = FrameTimeLogProb(ProfileCurves.from_nodes([nodes] * 4, [-nodes] * 4), free_times(4))
    assert np.isfinite(log_prob(np.array([[0.3, 0.6], [0.1, 0.2]]))).all()
    with pytest.raises(ValueError, match="free: expected shape"):
        log_prob(np.zeros(4))
    broken = ProfileCurves(nodes * np.ones((4, 1)), np.full((4, 5), np.nan), np.zeros((4, 5)), np.full(4, 5))
    with pytest.raises(ValueError, match="NaN"):
        FrameTimeLogProb(broken, free_times(4))(np.array([0.3, 0.6]))
