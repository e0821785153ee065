"""The vectors' functions against NumPy in double precision."""

import numba as nb
import numpy as np
import pytest

from foldgauss._numerics import simd as _vectors
from foldgauss._numerics.simd import LANES, load, store
from foldgauss._runtime.kernels import _OPTIONS

WIDE = np.linspace(-87, 87, 1 << 14)
NEAR = np.linspace(-5, 5, 1 << 14)


def apply(function, x):
    """`function` of vectors on all of x, whose length is a multiple of 16."""

    @nb.njit(**_OPTIONS)  # not kept on disk: it is another function every time
    def work(x, y):
        for k in range(np.uint64(0), np.uint64(len(x)), np.uint64(LANES)):
            store(y, k, function(load(x, k)))

    x = x.astype(np.float32)
    y = np.empty_like(x)
    work(x, y)
    return x.astype(np.float64), y


def cosine(x):
    return _vectors.cos_and_sin(x)[0]


def sine(x):
    return _vectors.cos_and_sin(x)[1]


cosine, sine = (_vectors.inline(function) for function in (cosine, sine))


@pytest.mark.parametrize(
    ("function", "truth", "x", "bounds"),
    [
        (_vectors.exp, np.exp, NEAR, {"rtol": 4e-7}),
        (_vectors.exp, np.exp, WIDE, {"rtol": 1e-5}),
        (_vectors.exp2, np.exp2, np.linspace(-30, 0, 1 << 16), {"rtol": 2.5e-7}),
        (_vectors.sigmoid, lambda x: 1 / (1 + np.exp(-x)), NEAR, {"rtol": 5e-7}),
        (_vectors.sqrt, np.sqrt, abs(WIDE), {"rtol": 2e-7}),
        (cosine, lambda x: np.cos(2 * np.pi * x), NEAR, {"atol": 5e-7}),
        (sine, lambda x: np.sin(2 * np.pi * x), NEAR, {"atol": 5e-7}),
    ],
)
def test_functions(function, truth, x, bounds):
    x, y = apply(function, x)
    np.testing.assert_allclose(y, truth(x), **({"atol": 0, "rtol": 0} | bounds))


def test_what_float32_cannot_hold():
    """Exponentials stay among the normal numbers; NaN stays NaN."""
    x = np.array([-np.inf, -1e30, -100, 100, 1e30, np.inf, np.nan, 0] * 2)
    _, y = apply(_vectors.exp, x)
    lowest, highest = np.repeat([0, 8e37], 3), np.repeat([2e-38, np.inf], 3)
    assert ((lowest < y[:6]) & (y[:6] < highest)).all()
    np.testing.assert_array_equal(y[6:8], [np.nan, 1])
    _, y = apply(_vectors.sigmoid, x)
    np.testing.assert_allclose(y[:8], [0, 0, 0, 1, 1, 1, np.nan, 0.5], atol=1e-37)


def test_window_of_two_vectors():
    @nb.njit
    def work(x, y):
        before, after = load(x, np.uint64(0)), load(x, np.uint64(LANES))
        store(y, np.uint64(0), _vectors.window(before, after, 5))

    x, y = np.arange(2 * LANES, dtype=np.float32), np.zeros(LANES, np.float32)
    work(x, y)
    np.testing.assert_array_equal(y, x[5 : 5 + LANES])
