"""Log-ratios of increments: round trips, the Jacobian, and a prior that is a density."""

import numpy as np
import pytest
import scipy.integrate
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from time_clips import free_times

from foldgauss.uncertainty import FrameTimeLogProb, Increments, ProfileCurves

HELD = np.array([0.0, 0.1, 0.25, 0.3, 0.55, 0.7, 1.0])


@settings(max_examples=50, deadline=None)
@given(z=st.lists(st.floats(-6, 6), min_size=5, max_size=5), frames=st.sets(st.integers(1, 5), min_size=1))
def test_times_and_coordinates_are_inverse(z, frames):
    increments = Increments.with_free(HELD, sorted(frames))
    coordinates = np.array(z[: len(frames)])
    times = increments.times(coordinates)
    assert (np.diff(times) > 0).all()
    held = ~increments.free
    np.testing.assert_array_equal(times[held], HELD[held])
    np.testing.assert_allclose(increments.coordinates(times), coordinates, atol=1e-7)


def test_runs_are_stretches_of_free_frames():
    increments = Increments.with_free(HELD, [1, 2, 4])
    assert increments.runs == [(1, 2), (4, 4)]
    assert increments.num_free == 3
    z = np.array([0.3, -0.2, 1.0])
    shares = np.exp([0.3, -0.2, 0.0]) / np.exp([0.3, -0.2, 0.0]).sum()
    expected = HELD.copy()
    expected[1:3] = 0.3 * np.cumsum(shares)[:2]
    expected[4] = 0.3 + 0.4 / (1 + np.exp(-1.0))
    np.testing.assert_allclose(increments.times(z), expected, rtol=1e-12)


@pytest.mark.parametrize("concentration", [0.5, 1.0, 4.0])
def test_prior_is_the_dirichlets_times_the_jacobian(concentration):
    increments, z = free_times(5, concentration), np.array([0.4, -1.0, 0.2])

    p = np.diff(increments.times(z))
    step = 1e-5 * np.eye(3)
    # Central differences of the first three increments, in rows.
    jacobian = np.diff(increments.times(z + step) - increments.times(z - step), axis=1)[:, :-1] / 2e-5
    expected = scipy.stats.dirichlet.logpdf(p / p.sum(), np.full(4, concentration)) + np.linalg.slogdet(jacobian)[1]
    assert increments.log_prior(z) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("concentration", [0.5, 1.0, 4.0])
def test_prior_integrates_to_one(concentration):
    increments, far = free_times(4, concentration), 60 / min(concentration, 1)
    z = np.linspace(-far, far, 1201)
    grid = np.stack(np.meshgrid(z, z, indexing="ij"), -1)
    density = np.exp(increments.log_prior(grid))
    assert scipy.integrate.trapezoid(scipy.integrate.trapezoid(density, z), z) == pytest.approx(1, abs=1e-5)


def test_prior_of_several_runs_is_their_product():
    both, one, other = (Increments.with_free(HELD, frames, 2.0) for frames in ([1, 2, 4], [1, 2], [4]))
    z = np.array([0.3, -0.2, 1.0])
    assert both.log_prior(z) == pytest.approx(one.log_prior(z[:2]) + other.log_prior(z[2:]))


def test_log_prior_is_what_draws_of_it_follow():
    # t_1 of 4 increments is Beta(a, 3a); false-alarm rate 1e-3.
    times = free_times(5, 2.0).draw_prior(np.random.default_rng(0), 5000)
    for k in (1, 2, 3):
        assert scipy.stats.kstest(times[:, k], scipy.stats.beta(2 * k, 8 - 2 * k).cdf).pvalue > 1e-3
    assert scipy.stats.kstest(times[:, 1], scipy.stats.beta(2.5, 7.5).cdf).pvalue < 1e-3


def test_logits_are_centered_and_give_the_times_back():
    increments = free_times(6)
    times = increments.times(np.random.default_rng(0).normal(size=(7, 4)))
    logits = increments.logits(times)
    np.testing.assert_allclose(logits.mean(-1), 0, atol=1e-12)
    weights = np.exp(logits)
    np.testing.assert_allclose(np.cumsum(weights / weights.sum(-1, keepdims=True), -1), times[:, 1:], rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"concentration": 0.0}, "concentration"),
        ({"concentration": np.nan}, "concentration"),
        ({"frames": []}, "frames"),
        ({"frames": [0, 1]}, "frames"),
        ({"frames": [6]}, "frames"),
        ({"frames": [1.5]}, "frames"),
        ({"frames": 3}, "frames"),
        ({"frames": [[1], [2]]}, "frames"),
        ({"frames": [[1], [2, 3]]}, "frames"),
        ({"frames": "12"}, "frames"),
        ({"frames": HELD > 0.5}, "frames"),
        ({"concentration": "a"}, "concentration"),
        ({"concentration": None}, "concentration"),
        ({"concentration": np.inf}, "concentration"),
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
        Increments.with_free(**{"held": HELD, "frames": [1, 2], "concentration": 1.0, **change})


def test_shapes_and_order_are_checked():
    increments = free_times(5)
    with pytest.raises(ValueError, match="coordinates"):
        increments.times(np.zeros(4))
    with pytest.raises(ValueError, match="times"):
        increments.coordinates(np.zeros(4))
    with pytest.raises(ValueError, match="increasing"):
        increments.coordinates(np.array([0, 0.5, 0.4, 0.6, 1.0]))


def test_times_of_free_frames_are_ignored():
    assert Increments.with_free([0, np.nan, -7, 0.3, 0.55, 0.7, 1.0], [1, 2]).runs == [(1, 2)]


@pytest.mark.parametrize("gap", [0.0, 1e-300, 1e-17])
def test_unresolved_increments_are_replaced_by_the_least(gap):
    increments = Increments.with_free(HELD, [1, 2])
    times = HELD.copy()
    times[1:3] = gap, 0.2
    found = increments.coordinates(times)
    np.testing.assert_allclose(found, np.log([0.3e-16 / 0.1, 0.2 / 0.1]), rtol=1e-12)
    assert np.isfinite(increments.log_prior(found))
    assert np.isfinite(increments.logits(times)).all()
    for wrong in (-1e-18, -0.1, np.nan):
        times[1] = wrong
        with pytest.raises(ValueError, match="increasing times"):
            increments.coordinates(times)


def test_low_concentrations_round_trip():
    increments = free_times(30, 0.05)
    times = increments.draw_prior(np.random.default_rng(0), 2000)
    assert (np.diff(times) >= 0).all()
    assert (np.diff(times) == 0).any()
    coordinates = increments.coordinates(times)
    assert np.isfinite(coordinates).all()
    again = increments.times(coordinates)
    assert (np.diff(again) >= 0).all()
    np.testing.assert_allclose(again, times, atol=1e-14)


def test_nan_coordinates_raise():
    nodes = np.linspace(0, 1, 5)
    log_prob = FrameTimeLogProb(ProfileCurves.from_nodes([nodes] * 4, [-nodes] * 4), free_times(4))
    assert np.isfinite(log_prob(np.zeros((3, 2)))).all()
    with pytest.raises(ValueError, match="NaN"):
        log_prob(np.array([[0.0, np.nan]]))
