"""Sparse Adam against optax, and its sparsity."""

import jax
import numpy as np
import optax
import pytest

from foldgauss.video.fitting.adam import BETA1, BETA2, EPSILON, sparse_adam
from foldgauss.video.models.row_layout import columns


@pytest.mark.parametrize("width", [11, 17, 25])
def test_agrees_with_optax_where_all_rows_take_part(width):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(5000, width)).astype(np.float32)
    rates = rng.uniform(1e-3, 1e-1, width).astype(np.float32)
    first, second, counts = np.zeros_like(rows), np.zeros_like(rows), np.zeros(len(rows), np.int32)
    truth, adam = rows.astype(np.float64), optax.scale_by_adam(BETA1, BETA2, EPSILON)
    with jax.enable_x64(True):
        state = adam.init(truth)
    for _ in range(5):
        grad = rng.normal(size=rows.shape).astype(np.float32)
        with jax.numpy_dtype_promotion("standard"), jax.enable_x64(True):
            update, state = adam.update(grad.astype(np.float64), state)
        truth = truth - rates * np.asarray(update)
        sparse_adam(rows, grad, first, second, counts, np.arange(len(rows)), rates)
        assert not grad.any()  # handed back empty
    np.testing.assert_allclose(rows, truth, atol=2e-5)


def test_rows_that_take_no_part_are_untouched_and_count_their_own_steps():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(100, 11)).astype(np.float32)
    before = rows.copy()
    first, second, counts = np.zeros_like(rows), np.zeros_like(rows), np.zeros(100, np.int32)
    rates = np.full(11, 0.1, np.float32)
    touched = np.array([3, 50, 99])
    grad = np.zeros_like(rows)
    grad[touched] = 1
    sparse_adam(rows, grad, first, second, counts, touched, rates)
    others = np.setdiff1d(np.arange(100), touched)
    np.testing.assert_array_equal(rows[others], before[others])
    np.testing.assert_allclose(rows[touched], before[touched] - 0.1, atol=1e-5)  # a first step is the rate itself
    assert counts.sum() == 3
    grad[3] = 1
    sparse_adam(rows, grad, first, second, counts, np.array([3]), rates)
    assert list(counts[touched]) == [2, 1, 1]


def test_zero_gradient_is_no_step():
    rows = np.ones((4, 11), np.float32)
    moments = np.zeros_like(rows), np.zeros_like(rows)
    sparse_adam(rows, np.zeros_like(rows), *moments, np.zeros(4, np.int32), np.arange(4), np.ones(11, np.float32))
    np.testing.assert_array_equal(rows, 1)


def test_rates_in_units_of_own_time():
    """A first step is the rate itself: c_k moves by (unit / sigma_t)^k of it, m_t by sigma_t / unit, others as ever."""
    degree, unit, spread = 3, 0.06, np.array([0.03, 0.06, 0.24], np.float32)
    place = columns(degree)
    rows = np.zeros((3, place["coefficients"].stop), np.float32)
    rows[:, place["log_time_scale"].start] = np.log(spread)
    before, grad, moments = rows.copy(), np.ones_like(rows), (np.zeros_like(rows), np.zeros_like(rows))
    rates = np.full(rows.shape[1], 1e-3, np.float32)
    sparse_adam(rows, grad, *moments, np.zeros(3, np.int32), np.arange(3), rates, unit_time=unit)
    factor = (before - rows) / 1e-3
    for k in range(1, degree + 1):
        own = factor[:, place["coefficients"]].reshape(3, degree, 2)[:, k - 1]
        np.testing.assert_allclose(own, ((unit / spread) ** k)[:, None] * np.ones(2), rtol=1e-4)
    np.testing.assert_allclose(factor[:, place["time_loc_logit"].start], spread / unit, rtol=1e-4)
    np.testing.assert_allclose(factor[:, place["loc"]], 1, rtol=1e-4)
    np.testing.assert_allclose(factor[:, place["log_time_scale"]], 1, rtol=1e-3)
