"""Adam: all implementations agree with each other and with optax; rows that take no part stay."""

import math

import jax
import numpy as np
import pytest
import scipy

from foldgauss.video.fitting import adam
from foldgauss.video.fitting.adam import (
    FRAME_TIME_ADAM,
    masked_adam,
    sparse_adam,
    update_frame_times,
    update_paths,
)
from foldgauss.video.models.frame_times import FrameTimes, make_time_logits
from foldgauss.video.models.row_layout import columns

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
#: The standard deviations, in time and in the plane, at which learning rates are stated.
UNIT_TIME, UNIT_SIZE = 0.06, 0.005


def adam_step(grad, first, second, counts, rates, nu=1.0):
    """The rule: what to subtract from the parameters, and both moments; `counts` includes this step."""
    first = (BETA1 * first + (1 - BETA1) * grad).astype(first.dtype)
    second = (BETA2 * second + (1 - BETA2) * grad**2).astype(second.dtype)
    counts = counts.reshape(-1, *[1] * (grad.ndim - 1))
    mean, square = first / (1 - BETA1**counts), second / (1 - BETA2**counts)
    return rates * (nu * mean + (1 - nu) * grad) / (np.sqrt(square) + EPSILON), first, second


def take_step(rows, *others, nu=1.0, own_units=False):
    return sparse_adam(rows, *others, rounded=np.zeros(len(rows), np.uint8), nu=nu, own_units=own_units)


def test_untouched_rows_stay_and_each_row_counts_its_own_steps():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(100, 11)).astype(np.float32)
    before = rows.copy()
    first, second, counts = np.zeros_like(rows), np.zeros_like(rows), np.zeros(100, np.int32)
    rates = np.full(11, 0.1, np.float32)
    touched = np.array([3, 50, 99])
    grad = np.zeros_like(rows)
    grad[touched] = 1
    take_step(rows, grad, first, second, counts, touched, rates)
    others = np.setdiff1d(np.arange(100), touched)
    np.testing.assert_array_equal(rows[others], before[others])
    np.testing.assert_allclose(rows[touched], before[touched] - 0.1, atol=1e-5)  # a first step is the rate itself
    assert counts.sum() == 3
    grad[3] = 1
    take_step(rows, grad, first, second, counts, np.array([3]), rates)
    assert list(counts[touched]) == [2, 1, 1]


def test_zero_gradient_changes_nothing():
    rows = np.ones((4, 11), np.float32)
    moments = np.zeros_like(rows), np.zeros_like(rows)
    grad, others = np.zeros_like(rows), (*moments, np.zeros(4, np.int32), np.arange(4), np.ones(11, np.float32))
    assert take_step(rows, grad, *others)
    np.testing.assert_array_equal(rows, 1)
    grad[3] = np.nan
    assert not take_step(rows, grad, *others)  # reports rows that are not finite


@pytest.mark.parametrize("own_units", [False, True])
def test_rates_scale_with_duration_and_axes(own_units):
    """A first step is the rate itself: c_k moves by (unit / sigma_t)^k of it, m_t by sigma_t / unit; others as ever.

    m_s and c_k along each axis of the Gaussian also by its standard deviation; the angle by less if that is long.
    """
    degree, spread = 3, np.array([0.03, 0.06, 0.24], np.float32)
    scales = np.array([[0.01, 0.01], [0.02, 0.08], [0.001, 0.004]], np.float32)
    turns = np.array([0.5, 0.6, 0.07])
    angles = 2 * np.pi * turns if own_units else np.zeros(3)
    axes = np.stack([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]).transpose(2, 0, 1)
    lengths = scales / UNIT_SIZE if own_units else np.ones((3, 2))
    expected = np.einsum("nij,nj,nj->ni", axes, lengths, np.sign(np.einsum("nij,i->nj", axes, np.ones(2))))
    place = columns(degree)
    rows = np.zeros((3, place["coefficients"].stop), np.float32)
    rows[:, place["log_time_scale"].start] = np.log(spread)
    rows[:, place["log_scale"]] = np.log(scales)
    rows[:, place["angle_logit"].start] = scipy.special.logit(turns)
    before, grad, moments = rows.copy(), np.ones_like(rows), (np.zeros_like(rows), np.zeros_like(rows))
    rates = np.full(rows.shape[1], 1e-3, np.float32)
    slower = UNIT_TIME / spread if own_units else np.ones(3)
    take_step(rows, grad, *moments, np.zeros(3, np.int32), np.arange(3), rates, own_units=own_units)
    factor = (before - rows) / 1e-3
    for k in range(1, degree + 1):
        own = factor[:, place["coefficients"]].reshape(3, degree, 2)[:, k - 1]
        np.testing.assert_allclose(own, slower[:, None] ** k * expected, rtol=1e-3)
    np.testing.assert_allclose(factor[:, place["time_loc_logit"].start], 1 / slower, rtol=1e-4)
    np.testing.assert_allclose(factor[:, place["loc"]], expected, rtol=1e-3)
    stiff = [1, 4 - 1 / 4, 4 - 1 / 4] if own_units else np.ones(3)
    np.testing.assert_allclose(factor[:, place["angle_logit"].start], 1 / np.array(stiff), rtol=1e-3)
    np.testing.assert_allclose(factor[:, place["log_time_scale"]], 1, rtol=1e-3)


@pytest.mark.parametrize(("width", "nu"), [(11, 1.0), (17, 0.75), (25, 1.0)])
def test_all_implementations_take_the_same_steps(width, nu):
    """The rule in NumPy, its twins in Numba and JAX, and optax, over several steps."""
    rng, num = np.random.default_rng(0), 60
    rows = rng.normal(size=(num, width)).astype(np.float32)
    rates = rng.uniform(1e-3, 1e-1, width).astype(np.float32)
    zeros = np.zeros_like(rows), np.zeros_like(rows), np.zeros(num, np.int32)
    own, sparse, masked = ([rows.copy(), *(part.copy() for part in zeros)] for _ in range(3))
    by_optax, moments = rows.copy(), FRAME_TIME_ADAM.init(rows)
    for _ in range(4):
        grad = rng.normal(size=rows.shape).astype(np.float32)
        grad[::5] *= 1e-15  # where epsilon counts
        own[3] += 1
        change, *own[1:3] = adam_step(grad, *own[1:], rates, nu)
        own[0] -= change.astype(np.float32)
        emptied = grad.copy()
        take_step(sparse[0], emptied, *sparse[1:], np.arange(num), rates, nu=nu)
        assert not emptied.any()
        options = {"rounded": np.zeros(num, np.uint8), "nu": nu, "own_units": False}
        masked = masked_adam(masked[0], grad, *masked[1:], np.ones(num, bool), rates, **options)
        with jax.numpy_dtype_promotion("standard"):
            update, moments = FRAME_TIME_ADAM.update(grad, moments)
        by_optax -= rates * np.asarray(update)
    for one in (sparse, masked):
        for part, judge in zip(one, own, strict=True):
            np.testing.assert_allclose(part, judge, rtol=1e-5, atol=1e-5)
    if nu == 1:
        np.testing.assert_allclose(by_optax, own[0], atol=2e-5)  # its bias corrections are float32


def test_a_step_of_the_paths_moves_visited_frames_only():
    rng, shape = np.random.default_rng(0), (7, 2, 2, 3)
    maps, first, second, grad = (rng.normal(size=shape).astype(np.float32) for _ in range(4))
    for part in (first, second, grad):
        part[3] *= 1e-14  # where epsilon counts
    before, visited = (maps, first, second**2, np.array([3, 0, 0, 7, 1, 39, 12], np.int32)), np.arange(7) % 2 == 1
    got = update_paths(before, grad, visited, np.float32(0.1))
    change, *moments = adam_step(grad, *before[1:3], np.maximum(before[3] + visited, 1), np.float32(0.1))
    for one, judge, old in zip(got, (maps - change, *moments, before[3] + 1), before, strict=True):
        np.testing.assert_allclose(one[visited], judge[visited], rtol=2e-5, atol=1e-6)
        np.testing.assert_array_equal(one[~visited], old[~visited])


@pytest.mark.parametrize("own_units", [False, True])
def test_masked_adam_matches_sparse_adam(monkeypatch, own_units):
    """After any number of steps, in several tasks; rows that took no part stay to the bit."""
    monkeypatch.setattr(adam, "_CHUNK", 128)
    rng, num, width = np.random.default_rng(0), 400, 17
    rows, grad, first = (rng.normal(size=(num, width)).astype(np.float32) for _ in range(3))
    place = columns(3)  # sizes and durations about those that the rates are stated for
    rows[:, place["log_scale"]] += math.log(UNIT_SIZE)
    rows[:, place["log_time_scale"]] += math.log(UNIT_TIME)
    second = (first**2 + rng.normal(size=(num, width)) ** 2).astype(np.float32)  # a mean square is not below that
    counts = rng.integers(0, 30_000, num).astype(np.int32)
    counts[:50] = np.arange(50)
    touched, rates = rng.random(num) < 0.7, 0.1 * rng.random(width).astype(np.float32)
    arrays = rows, grad, first, second, counts
    rounded = rng.integers(0, 8, num).astype(np.uint8)
    options = {"rounded": rounded, "nu": 0.75, "own_units": own_units}
    own = jax.jit(lambda *arrays: masked_adam(*arrays, touched, rates, **options))(*arrays)
    judge = [array.copy() for array in arrays]
    assert sparse_adam(*judge, np.flatnonzero(touched), rates, **options)
    for one, other, before in zip(own, (judge[0], *judge[2:]), (rows, *arrays[2:]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(np.asarray(one)[~touched], before[~touched])


def test_the_gap_of_a_cut_moves_as_far_in_time_as_other_intervals():
    """Its weight alone is hundreds of frames long."""
    logits = make_time_logits(40, [20])
    before = np.diff(FrameTimes(logits).times())
    for by_time in np.eye(40, dtype=np.float32)[[5, 30]]:
        updated, _ = update_frame_times(logits, FRAME_TIME_ADAM.init(logits), by_time, 1e-3)
        assert FrameTimes(updated).times() @ by_time < FrameTimes(logits).times() @ by_time
        steps = np.abs(np.asarray(updated) - logits) * before
        assert steps[19] == pytest.approx(np.median(steps), rel=0.05)  # Adam's epsilon counts where gradients are small
    even = np.zeros(39, np.float32)
    updated, _ = update_frame_times(even, FRAME_TIME_ADAM.init(even), by_time, 1e-3)
    np.testing.assert_allclose(np.abs(np.asarray(updated)), 1e-3, rtol=1e-3)  # without cuts, Adam's own
    vanishing = np.where(np.arange(39) == 0, 0, -200).astype(np.float32)  # softmax is 0 in float32: so is the median
    assert np.isfinite(update_frame_times(vanishing, FRAME_TIME_ADAM.init(vanishing), by_time, 1e-3)[0]).all()
