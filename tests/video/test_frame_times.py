"""Frame times: start 0, end 1, increasing, whatever the weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foldgauss.video import FrameTimes, interpolated_times, played_positions, remapped_positions, times_at
from foldgauss.video.models.frame_times import is_cut, make_time_logits, snap_to_shots


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-8, 8, width=32), min_size=1, max_size=200))
def test_start_end_and_order(logits):
    times = np.asarray(FrameTimes(jnp.asarray(logits, jnp.float32)).times())
    assert times[0] == 0
    assert times[-1] == 1
    assert len(times) == len(logits) + 1
    assert np.all(np.diff(times) >= 0)
    if len(logits) < 50 and np.ptp(logits) < 10:  # e^-10 / 50 is still well above the spacing of float32 at 1
        assert np.all(np.diff(times) > 0)


def test_cuts_of_frames():
    """The first interval counts, too; half of all intervals are too many to be told from others."""
    times = FrameTimes(make_time_logits(6, [1, 4]))
    assert make_time_logits(5, [1, 3]).tolist() == [0, 0, 0, 0]
    cuts = is_cut(np.asarray(times.times()))
    assert cuts.tolist() == [True, False, False, True, False]
    assert cuts.dtype == bool
    assert isinstance(cuts, np.ndarray)  # JAX would round float64


def test_gap_is_8_frames_and_3_times_the_longer_shot():
    shots = np.array([6, 3, 11])
    intervals = np.exp(make_time_logits(20, [6, 9]))
    np.testing.assert_allclose(intervals[[5, 8]], 8 + 3 * np.maximum(shots[:-1], shots[1:]), rtol=1e-6)
    np.testing.assert_array_equal(np.delete(intervals, [5, 8]), 1)


@pytest.mark.parametrize("arrays", [np, jnp])
def test_cut_is_an_interval_longer_than_6_median_ones(arrays):
    times = arrays.asarray(np.cumsum([0, 1, 6, 7, 1, 1]), np.float32)
    np.testing.assert_array_equal(is_cut(times), [False, False, True, False, False])


def test_a_single_frame_covers_all_times():
    one, some = FrameTimes.uniform(1), jnp.asarray([0.0, 0.3, 1.0])
    assert one.num_frames == 1
    assert FrameTimes.uniform(5).num_frames == 5
    assert is_cut(np.zeros(1)).shape == is_cut(one.times()).shape == (0,)
    np.testing.assert_array_equal(snap_to_shots(some, one.times()), 0)
    np.testing.assert_array_equal(snap_to_shots(some, FrameTimes.uniform(2).times()), some)
    with pytest.raises(ValueError, match=r"remap: expected at least two rows .* got \[\[0, nan\]"):
        remapped_positions([[0, float("nan")], [1, 1]], fps=25)


@pytest.mark.parametrize("extreme", [100.0, -100.0, 1e30])
def test_extreme_weights_stay_in_order(extreme):
    times = np.asarray(FrameTimes(jnp.asarray([0.0, extreme, 1.0])).times())
    assert np.all(np.isfinite(times))
    assert np.all(np.diff(times) >= 0)
    assert times[-1] == 1


def test_uniform_and_formula():
    np.testing.assert_allclose(FrameTimes.uniform(5).times(), np.arange(5) / 4, atol=1e-7)
    weights = jnp.asarray([0.3, -1.0, 2.0])
    share = np.exp(weights) / np.exp(weights).sum()
    np.testing.assert_allclose(FrameTimes(weights).times()[1:], np.cumsum(share), rtol=1e-6)


def test_gradient_is_finite():
    gradient = jax.jacobian(lambda w: FrameTimes(w).times())(jnp.asarray([0.0, 50.0, -50.0]))
    assert bool(jnp.all(jnp.isfinite(gradient)))
    np.testing.assert_array_equal(gradient[0], 0)


def test_interpolation():
    times = np.array([0.0, 0.2, 1.0], np.float32)
    np.testing.assert_allclose(interpolated_times(times, 4), [0, 0.05, 0.1, 0.15, 0.2, 0.4, 0.6, 0.8, 1], atol=1e-6)
    np.testing.assert_array_equal(interpolated_times(times, 1), times)


def test_times_snap_to_shots_at_a_cut():
    times = np.asarray(FrameTimes(make_time_logits(8, [3])).times())
    np.testing.assert_array_equal(np.flatnonzero(is_cut(times)), [2])
    assert times[3] - times[2] > 20 * (times[1] - times[0])
    between = interpolated_times(times, 4)[8:13]
    np.testing.assert_array_equal(between, times[[2, 2, 3, 3, 3]])
    np.testing.assert_array_equal(FrameTimes(make_time_logits(8, [])).times(), FrameTimes.uniform(8).times())
    assert not is_cut(np.array([0.0, 1.0])).any()
    t = np.array([0.0, times[1] / 2, times[2], 0.6 * times[2] + 0.4 * times[3], 0.4 * times[2] + 0.6 * times[3], 1.0])
    held = np.asarray(snap_to_shots(t, times))
    np.testing.assert_array_equal(held[[3, 4]], times[[2, 3]])
    np.testing.assert_array_equal(held[[0, 1, 2, 5]], t[[0, 1, 2, 5]].astype(np.float32))


def test_times_snap_at_the_first_and_the_last_interval_too():
    """The middle of a gap belongs to the later shot."""
    times = np.float32([0, 0.4375, 0.46875, 0.5, 0.53125, 0.5625, 1])
    np.testing.assert_array_equal(np.flatnonzero(is_cut(times)), [0, 5])
    t = np.arange(65, dtype=np.float32) / 64
    snapped = np.where(t < 0.21875, 0, np.where(t < 0.4375, 0.4375, np.where(t > 0.5625, 0.5625, t)))
    np.testing.assert_array_equal(snap_to_shots(t, times), np.where(t >= 0.78125, 1, snapped))


TWO = np.array([0.0, 1.0])
POINTS = [
    [[0, 0]],
    [[0, 0], [0, 1]],
    [[1, 0], [2, 1]],
    [[0, 0], [1, -1]],
    [[0, 0], [1, np.nan]],
    [0, 1],
    [[0, 0], [2, 1], [1, 2]],
]
WRONG = [
    (lambda: FrameTimes.uniform(0), "num_frames"),
    *((lambda own=own: interpolated_times(TWO, own), "upsample: expected a whole number") for own in (0, 2.5, "2")),
    *((lambda own=own: played_positions(4, 1.0, speed=own), "speed: expected") for own in (0.0, np.nan, np.inf)),
    *((lambda own=own: played_positions(4, own), "rate: expected a number > 0") for own in (0.0, np.nan, np.inf)),
    *((lambda own=own: remapped_positions(own, fps=2), "remap: expected") for own in POINTS),
    *(
        (lambda own=own: remapped_positions([[0, 0], [1, 1]], fps=own), "fps: expected a number > 0")
        for own in (0, -25.0)
    ),
    (lambda: remapped_positions([[0, 0], [1, 1]], fps=np.nan), "fps: expected a number > 0"),
]


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_invalid_input_is_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_positions_become_times():
    times = np.array([0.0, 0.2, 1.0], np.float32)
    np.testing.assert_allclose(times_at(times, np.array([0.5, 1.5, -3.0, 9.0])), [0.1, 0.6, 0, 1], atol=1e-7)
    cut = np.asarray(FrameTimes(make_time_logits(8, [3])).times())
    np.testing.assert_array_equal(times_at(cut, np.array([2.4, 2.6])), cut[[2, 3]])


HELD = [[0, 0], [1, 1], [3, 1], [4, 0.5]]


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (played_positions(4, 2.0), np.arange(7) / 2),
        (played_positions(4, 1.0, speed=0.5), np.arange(7) / 2),
        (played_positions(4, 1.0, speed=-1.5), [3, 1.5, 0]),
        (played_positions(251, 60 / 25), np.arange(601) / 2.4),  # the last frame is not lost to rounding
        (remapped_positions(HELD, fps=2), [0, 1, 2, 2, 2, 2, 2, 1.5, 1]),
        *(
            (remapped_positions([[0, 0], [2, 1]], fps=10, rate=rate), np.arange(20 * rate + 1) / rate / 2)
            for rate in (0.5, 2.0)
        ),
    ],
)
def test_positions_at_another_rate_or_speed_or_remapped(found, expected):
    np.testing.assert_allclose(found, expected)
