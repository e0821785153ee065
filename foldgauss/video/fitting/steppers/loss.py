r"""The loss of 3DGS and VeGaS with its gradient, in one pass over the image.

$$ L = (1 - \lambda)\,\mathrm{mean}|x - y| + \lambda\,(1 - \mathrm{mean}\,\mathrm{SSIM}(x, y)) $$

SSIM: Wang et al. 2004, with the published rasterizers' choices: 11 Gaussian taps of sigma 1.5, zero padding, population
covariance, data range 1. In XLA this loss costs more than the splats; here strips of rows pass through the cache once.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from foldgauss._runtime.checks import invalid
from foldgauss._runtime.kernels import inline, kernel
from foldgauss._runtime.threads import run_tasks

RADIUS = 5  # 11 taps
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2  # Wang et al. 2004: (K1 L)^2 and (K2 L)^2 with L = 1
#: Rows per task: enough that the 5 rows of halo above and below cost little, few enough to stay in the cache.
STRIP = 40

_taps = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(RADIUS + 1)]
#: Weights of the tap in the middle and of those 1 to RADIUS pixels away.
TAPS = tuple(np.float32(tap / (2 * sum(_taps) - _taps[0])) for tap in _taps)
_W0, _W1, _W2, _W3, _W4, _W5 = TAPS

_f, _u = nb.float32, nb.uint64


class ImageLoss(NamedTuple):
    """Value and gradient of the loss of one image, and the metrics computed along with it."""

    value: float
    gradient: np.ndarray  # (3, height, width), dL/d rendered
    mean_squared_error: float
    ssim: float | None  # None where its fraction of the loss is 0: not computed


@inline
def _blur(row, x):
    """The 11 taps around x of a row that carries RADIUS entries of padding on either side."""
    c = _u(x + _u(RADIUS))
    return (
        _W0 * row[c]
        + _W1 * (row[c - _u(1)] + row[c + _u(1)])
        + _W2 * (row[c - _u(2)] + row[c + _u(2)])
        + _W3 * (row[c - _u(3)] + row[c + _u(3)])
        + _W4 * (row[c - _u(4)] + row[c + _u(4)])
        + _W5 * (row[c - _u(5)] + row[c + _u(5)])
    )


@kernel
def _vertical_moments(x, y, row, moments):
    """Blur x, y, x^2, y^2, x y down the columns at one row, into the padded rows of `moments` (5, ...)."""
    height, width = x.shape
    m_x, m_y, m_xx, m_yy, m_xy = moments[0], moments[1], moments[2], moments[3], moments[4]
    moments[:] = 0.0
    for k in range(max(-RADIUS, -row), min(RADIUS, height - 1 - row) + 1):
        tap, x_row, y_row = TAPS[abs(k)], x[row + k], y[row + k]
        for c in range(_u(width)):
            p = c + _u(RADIUS)
            a, b = x_row[c], y_row[c]
            m_x[p] += tap * a
            m_y[p] += tap * b
            m_xx[p] += tap * a * a
            m_yy[p] += tap * b * b
            m_xy[p] += tap * a * b


@kernel
def _similarity_row(moments, ssim, d_mean, d_square, d_product):
    """SSIM along one row, and its derivatives by the blurs of x, x^2 and x y (into padded rows)."""
    b_x, b_y, b_xx, b_yy, b_xy = moments[0], moments[1], moments[2], moments[3], moments[4]
    c1, c2 = _f(C1), _f(C2)
    for c in range(_u(len(ssim))):
        mean_x, mean_y = _blur(b_x, c), _blur(b_y, c)
        var_x = _blur(b_xx, c) - mean_x * mean_x
        var_y = _blur(b_yy, c) - mean_y * mean_y
        cov = _blur(b_xy, c) - mean_x * mean_y
        top_mean, top_cov = _f(2) * mean_x * mean_y + c1, _f(2) * cov + c2
        low_mean, low_var = mean_x * mean_x + mean_y * mean_y + c1, var_x + var_y + c2
        inverse = _f(1) / (low_mean * low_var)
        value = top_mean * top_cov * inverse
        ssim[c] = value
        p = c + _u(RADIUS)
        by_square = -value * low_mean * inverse
        d_square[p] = by_square
        d_product[p] = _f(2) * top_mean * inverse
        d_mean[p] = (
            _f(2) * mean_y * (top_cov - top_mean) * inverse
            - _f(2) * mean_x * value * low_var * inverse
            - _f(2) * mean_x * by_square
        )


@kernel
def _blur_row(padded, out):
    for c in range(_u(len(out))):
        out[c] = _blur(padded, c)


@kernel
def _finish_row(x, y, row, top, blurred, scratch, scale_l1, scale_ssim, gradient):
    """Blur the derivatives down the columns and combine the gradient of one row."""
    height, width = x.shape
    s_mean, s_square, s_product = scratch[0], scratch[1], scratch[2]
    scratch[:] = 0.0
    for k in range(max(-RADIUS, -row), min(RADIUS, height - 1 - row) + 1):
        tap, slot = TAPS[abs(k)], row + k - top
        by_mean, by_square, by_product = blurred[0, slot], blurred[1, slot], blurred[2, slot]
        for c in range(_u(width)):
            s_mean[c] += tap * by_mean[c]
            s_square[c] += tap * by_square[c]
            s_product[c] += tap * by_product[c]
    for c in range(_u(width)):
        a, b = x[row, c], y[row, c]
        sign = _f(1) if a > b else (_f(-1) if a < b else _f(0))
        by_ssim = s_mean[c] + _f(2) * a * s_square[c] + b * s_product[c]
        gradient[row, c] = scale_l1 * sign - scale_ssim * by_ssim


@kernel
def _errors(x, y, start, stop):
    """Sums of |x - y| and (x - y)^2 over rows start..stop."""
    absolute, squared = 0.0, 0.0
    for r in range(start, stop):
        row_absolute, row_squared = _f(0), _f(0)
        for c in range(_u(x.shape[1])):
            d = x[r, c] - y[r, c]
            row_absolute += abs(d)
            row_squared += d * d
        absolute += row_absolute
        squared += row_squared
    return absolute, squared


@kernel
def _strip(x, y, start, stop, scale_l1, scale_ssim, gradient):
    """Gradient of rows start..stop of one plane; returns their sums of |x - y|, (x - y)^2 and SSIM."""
    height, width = x.shape
    top, bottom = max(0, start - RADIUS), min(height, stop + RADIUS)
    moments = np.empty((5, width + 2 * RADIUS), np.float32)
    padded = np.zeros((3, width + 2 * RADIUS), np.float32)
    blurred = np.empty((3, bottom - top, width), np.float32)
    ssim, scratch = np.empty(width, np.float32), np.empty((3, width), np.float32)
    total = 0.0
    for row in range(top, bottom):
        _vertical_moments(x, y, row, moments)
        _similarity_row(moments, ssim, padded[0], padded[1], padded[2])
        for k in range(3):
            _blur_row(padded[k], blurred[k, row - top])
        if start <= row < stop:
            total += ssim.sum()
    for row in range(start, stop):
        _finish_row(x, y, row, top, blurred, scratch, scale_l1, scale_ssim, gradient)
    absolute, squared = _errors(x, y, start, stop)
    return absolute, squared, total


@kernel
def _strip_l1(x, y, start, stop, scale, gradient):
    """As `_strip`, with no SSIM in the loss."""
    for r in range(start, stop):
        for c in range(_u(x.shape[1])):
            d = x[r, c] - y[r, c]
            gradient[r, c] = scale if d > _f(0) else (-scale if d < _f(0) else _f(0))
    absolute, squared = _errors(x, y, start, stop)
    return absolute, squared, 0.0


def image_loss(rendered: np.ndarray, target: np.ndarray, *, ssim_fraction: float = 0.2) -> ImageLoss:
    """(1 - fraction) L1 + fraction (1 - SSIM) of one image, with its gradient.

    `rendered`, `target`: float32, planar (channels, height, width), values about [0, 1].
    `ssim_fraction` in [0, 1] is the lambda of 3DGS (Kerbl et al. 2023, eq. 7). Raises ValueError on other shapes.
    """
    if rendered.shape != target.shape or rendered.ndim != 3:
        raise invalid(
            "rendered, target",
            expected="one shape (channels, height, width)",
            got=f"{rendered.shape}, {target.shape}",
        )
    gradient = np.empty_like(rendered)
    channels, height, _width = rendered.shape
    strips = [(c, r, min(r + STRIP, height)) for c in range(channels) for r in range(0, height, STRIP)]
    sums = np.zeros((len(strips), 3))
    by_l1 = np.float32((1 - ssim_fraction) / rendered.size)
    by_ssim = np.float32(ssim_fraction / rendered.size)

    def work(k: int) -> None:
        c, start, stop = strips[k]
        planes = rendered[c], target[c], start, stop
        if ssim_fraction > 0:
            sums[k] = _strip(*planes, by_l1, by_ssim, gradient[c])
        else:
            sums[k] = _strip_l1(*planes, by_l1, gradient[c])

    run_tasks(work, range(len(strips)))
    absolute, squared, similar = sums.sum(0) / rendered.size
    value = (1 - ssim_fraction) * absolute + (ssim_fraction * (1 - similar) if ssim_fraction > 0 else 0.0)
    return ImageLoss(float(value), gradient, float(squared), float(similar) if ssim_fraction > 0 else None)


def ssim_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """SSIM at every pixel of two float32 planes (height, width), zero padding: what the loss averages."""
    height, width = x.shape
    out = np.empty((height, width), np.float32)
    moments, padded = (
        np.empty((5, width + 2 * RADIUS), np.float32),
        np.zeros((3, width + 2 * RADIUS), np.float32),
    )
    for row in range(height):
        _vertical_moments(x, y, row, moments)
        _similarity_row(moments, out[row], padded[0], padded[1], padded[2])
    return out


#: Weight of the squared error: about the slope of the absolute one at some 30 dB, so that Adam's moments keep their
#: scale when the loss changes.
SQUARE_WEIGHT = 20.0


def squared_loss(rendered: np.ndarray, target: np.ndarray) -> ImageLoss:
    """`SQUARE_WEIGHT` times the mean squared error of planar float32 images, with its gradient."""
    difference = rendered - target
    error = float(np.vdot(difference, difference)) / difference.size
    difference *= np.float32(2 * SQUARE_WEIGHT / difference.size)
    return ImageLoss(SQUARE_WEIGHT * error, difference, error, None)
