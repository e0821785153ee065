r"""The loss of 3DGS and VeGaS with its gradient, in one pass over the image.

$$ L = (1 - \lambda)\,\mathrm{mean}|x - y| + \lambda\,(1 - \mathrm{mean}\,\mathrm{SSIM}(x, y)) $$

SSIM: Wang et al. 2004, with the published rasterizers' choices: 11 Gaussian taps of sigma 1.5, zero padding, population
covariance, data range 1. In XLA this loss costs more than the splats; here strips of rows pass through the cache once.
"""

import functools
import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float32

from foldgauss._numerics.simd import LANES, broadcast, load, select, store, window
from foldgauss._runtime.checks import require
from foldgauss._runtime.kernels import inline, kernel
from foldgauss._runtime.threads import run_tasks

RADIUS = 5  # 11 taps
SIGMA = 1.5
#: Wang et al. 2004: (K1 L)^2 with L = 1.
C1 = 0.01**2
#: Wang et al. 2004: (K2 L)^2 with L = 1.
C2 = 0.03**2
#: Rows per task: enough that the 5 rows of halo above and below cost little, few enough to stay in the cache.
STRIP = 54

_taps = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(RADIUS + 1)]
#: Weights of the tap in the middle and of those 1 to RADIUS pixels away.
TAPS = tuple(np.float32(tap / (2 * sum(_taps) - _taps[0])) for tap in _taps)
_W0 = TAPS[0]
_W1 = TAPS[1]
_W2 = TAPS[2]
_W3 = TAPS[3]
_W4 = TAPS[4]
_W5 = TAPS[5]
_ALL_TAPS = np.array((*TAPS[:0:-1], *TAPS))

_f = nb.float32
_u = nb.uint64


class ImageLoss(NamedTuple):
    """Value and gradient of the loss of one image, and its mean squared error."""

    value: float
    gradient: np.ndarray  # (3, height, width), dL/d rendered
    mean_squared_error: float


@inline
def _blur(numbers, at, apart):
    """The 11 taps of 16 numbers, from `at` on, down the columns: rows are `apart`."""
    return (
        broadcast(_W0) * load(numbers, at)
        + broadcast(_W1) * (load(numbers, at - apart) + load(numbers, at + apart))
        + broadcast(_W2) * (load(numbers, at - _u(2) * apart) + load(numbers, at + _u(2) * apart))
        + broadcast(_W3) * (load(numbers, at - _u(3) * apart) + load(numbers, at + _u(3) * apart))
        + broadcast(_W4) * (load(numbers, at - _u(4) * apart) + load(numbers, at + _u(4) * apart))
        + broadcast(_W5) * (load(numbers, at - _u(5) * apart) + load(numbers, at + _u(5) * apart))
    )


@inline
def _blur_along(row, at):
    """The 11 taps of 16 numbers of a row, from `at` on. Neighbors are shuffled: loads across cache lines are slow."""
    before, here, after = load(row, at - _u(LANES)), load(row, at), load(row, at + _u(LANES))
    return (
        broadcast(_W0) * here
        + broadcast(_W1) * (window(before, here, 15) + window(here, after, 1))
        + broadcast(_W2) * (window(before, here, 14) + window(here, after, 2))
        + broadcast(_W3) * (window(before, here, 13) + window(here, after, 3))
        + broadcast(_W4) * (window(before, here, 12) + window(here, after, 4))
        + broadcast(_W5) * (window(before, here, 11) + window(here, after, 5))
    )


@inline
def _blur_moments(x, y, at, wide, taps, moments, pitch):
    """Blur x, y, x^2, y^2 and x y down the columns at the row that begins at `at`, into padded rows, `pitch` apart."""
    none, pitch = broadcast(_f(0)), _u(pitch)
    for c in range(_u(0), _u(wide), _u(LANES)):
        m_x, m_y, m_xx, m_yy, m_xy = none, none, none, none, none
        place = _u(at) + c - _u(RADIUS) * _u(wide)
        for k in range(_u(2 * RADIUS + 1)):
            a, b = load(x, place), load(y, place)
            by_a, by_b = broadcast(taps[k]) * a, broadcast(taps[k]) * b
            m_x, m_y = m_x + by_a, m_y + by_b
            m_xx, m_yy, m_xy = m_xx + by_a * a, m_yy + by_b * b, m_xy + by_a * b
            place += _u(wide)
        out = _u(LANES) + c
        store(moments, out, m_x)
        store(moments, out + pitch, m_y)
        store(moments, out + _u(2) * pitch, m_xx)
        store(moments, out + _u(3) * pitch, m_yy)
        store(moments, out + _u(4) * pitch, m_xy)


@inline
def _similarity_row(moments, wide, pitch, ssim, derivatives):
    """SSIM along one row, and its derivatives by the blurs of x, x^2 and x y (three padded rows, `pitch` apart)."""
    pitch, two, c1, c2 = _u(pitch), broadcast(_f(2)), broadcast(_f(C1)), broadcast(_f(C2))
    for c in range(_u(0), _u(wide), _u(LANES)):
        at = c + _u(LANES)
        mean_x, mean_y = _blur_along(moments, at), _blur_along(moments, at + pitch)
        var_x = _blur_along(moments, at + _u(2) * pitch) - mean_x * mean_x
        var_y = _blur_along(moments, at + _u(3) * pitch) - mean_y * mean_y
        cov = _blur_along(moments, at + _u(4) * pitch) - mean_x * mean_y
        top_mean, top_cov = two * mean_x * mean_y + c1, two * cov + c2
        low_mean, low_var = mean_x * mean_x + mean_y * mean_y + c1, var_x + var_y + c2
        inverse = broadcast(_f(1)) / (low_mean * low_var)
        value = top_mean * top_cov * inverse
        by_square = broadcast(_f(0)) - value * low_mean * inverse
        by_mean = two * mean_y * (top_cov - top_mean) * inverse
        store(ssim, c, value)
        store(derivatives, at, by_mean - two * mean_x * value * low_var * inverse - two * mean_x * by_square)
        store(derivatives, at + pitch, by_square)
        store(derivatives, at + _u(2) * pitch, two * top_mean * inverse)


@inline
def _finish_row(x, y, at, blurred, here, wide, scale_l1, scale_ssim, out):
    """Blur the derivatives down the columns and combine the gradient of one row, which begins at `at` of x and y."""
    none, two, line = broadcast(_f(0)), broadcast(_f(2)), _u(3) * _u(wide)
    positive, by_similarity = broadcast(scale_l1), broadcast(scale_ssim)
    for c in range(_u(0), _u(wide), _u(LANES)):
        a, b, place = load(x, _u(at) + c), load(y, _u(at) + c), _u(here) + c
        by_mean, by_square = _blur(blurred, place, line), _blur(blurred, place + _u(wide), line)
        by_product = _blur(blurred, place + _u(2) * _u(wide), line)
        by_l1 = select(a > b, positive, select(a < b, none - positive, none))
        store(out, c, by_l1 - by_similarity * (by_mean + two * a * by_square + b * by_product))


@inline
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
def _strip(x, y, start, stop, taps, scale_l1, scale_ssim, gradient):
    """Gradient of rows start..stop of one plane; returns their sums of |x - y|, (x - y)^2 and SSIM."""
    height, width = x.shape
    wide = (width + LANES - 1) // LANES * LANES
    pitch, total = wide + 2 * LANES, 0.0
    # Rows around the strip, and columns up to whole vectors, with zeros outside the image.
    first, num = start - 2 * RADIUS, stop - start + 4 * RADIUS
    own_x, own_y = np.zeros((num, wide), np.float32), np.zeros((num, wide), np.float32)
    for row in range(max(first, 0), min(first + num, height)):
        own_x[row - first, :width], own_y[row - first, :width] = x[row], y[row]
    flat_x, flat_y = own_x.reshape(-1), own_y.reshape(-1)
    moments, derivatives = np.zeros(5 * pitch, np.float32), np.zeros(3 * pitch, np.float32)
    blurred, ssim = np.zeros((num - 2 * RADIUS) * 3 * wide, np.float32), np.empty(wide, np.float32)
    for k in range(num - 2 * RADIUS):
        row = start - RADIUS + k
        if not 0 <= row < height:
            continue
        _blur_moments(flat_x, flat_y, (k + RADIUS) * wide, wide, taps, moments, pitch)
        _similarity_row(moments, wide, pitch, ssim, derivatives)
        for j in range(3):
            derivatives[j * pitch + LANES + width : (j + 1) * pitch] = 0.0
            for c in range(_u(0), _u(wide), _u(LANES)):
                out = _u(3 * k + j) * _u(wide) + c
                store(blurred, out, _blur_along(derivatives, _u(j) * _u(pitch) + _u(LANES) + c))
        if start <= row < stop:
            total += ssim[:width].sum()
    for row in range(start, stop):
        at = row - first
        _finish_row(flat_x, flat_y, at * wide, blurred, (at - RADIUS) * 3 * wide, wide, scale_l1, scale_ssim, ssim)
        gradient[row] = ssim[:width]
    absolute, squared = _errors(x, y, start, stop)
    return absolute, squared, total


def image_loss(rendered: np.ndarray, target: np.ndarray, *, ssim_fraction: float = 0.2) -> ImageLoss:
    """(1 - fraction) L1 + fraction (1 - SSIM) of one image, with its gradient.

    `rendered`, `target`: float32, planar (channels, height, width), values about [0, 1].
    `ssim_fraction` in [0, 1] is the lambda of 3DGS (Kerbl et al. 2023, eq. 7). Raises ValueError on other shapes.
    """
    require(
        rendered.shape == target.shape and rendered.ndim == 3,
        "rendered, target",
        expected="one shape (channels, height, width)",
        got=f"{rendered.shape}, {target.shape}",
    )
    if ssim_fraction == 0:
        difference = rendered - target
        gradient = np.sign(difference) * np.float32(1 / rendered.size)
        absolute, squared = (float(moment.mean(dtype=float)) for moment in (np.abs(difference), difference**2))
        return ImageLoss(absolute, gradient, squared)
    gradient = np.empty_like(rendered)
    channels, height, _width = rendered.shape
    strips = [(c, r, min(r + STRIP, height)) for c in range(channels) for r in range(0, height, STRIP)]
    sums = np.zeros((len(strips), 3))
    by_l1 = np.float32((1 - ssim_fraction) / rendered.size)
    by_ssim = np.float32(ssim_fraction / rendered.size)

    def work(k: int) -> None:
        c, start, stop = strips[k]
        sums[k] = _strip(rendered[c], target[c], start, stop, _ALL_TAPS, by_l1, by_ssim, gradient[c])

    run_tasks(work, range(len(strips)))
    absolute, squared, similar = sums.sum(0) / rendered.size
    value = (1 - ssim_fraction) * absolute + ssim_fraction * (1 - similar)
    return ImageLoss(float(value), gradient, float(squared))


#: Weight of the squared error: about the slope of the absolute one at some 30 dB, so that Adam's moments keep their
#: scale when the loss changes.
SQUARE_WEIGHT = 20.0


def squared_loss(rendered: np.ndarray, target: np.ndarray) -> ImageLoss:
    """`SQUARE_WEIGHT` times the mean squared error of planar float32 images, with its gradient."""
    difference = rendered - target
    error = float(np.vdot(difference, difference)) / difference.size
    difference *= np.float32(2 * SQUARE_WEIGHT / difference.size)
    return ImageLoss(SQUARE_WEIGHT * error, difference, error)


@functools.cache
def border_weights(height: int, width: int, weight: float) -> Float32[np.ndarray, "height width"]:
    """`weight` at the outermost pixels and 1 elsewhere: factors of the gradient of a loss by the image."""
    weights = np.full((height, width), weight, np.float32)
    weights[1:-1, 1:-1] = 1
    weights.flags.writeable = False
    return weights
