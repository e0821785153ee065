"""Laplace's approximation of the posterior of frame times."""

import dataclasses

import numpy as np
import scipy.linalg
from jaxtyping import Float, Float64

from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.posterior.increments import Increments

#: Newton steps at most, and the gain in nats below which they end.
MAX_STEPS, MIN_GAIN = 60, 1e-9
#: Finite differences span this many standard deviations: curves are rough on smaller scales, where splats appear and
#: disappear.
REACH = 1.5


@dataclasses.dataclass(frozen=True)
class LaplaceApproximation:
    """A Gaussian at the mode of the density of the log-ratios, transformed to times.

    **Shapes:** `mode`, `std` (num_frames,), `std` 0 for held frames. `precision`: for each run the main and
    the upper diagonal (2, frames) of the tridiagonal precision of its times.
    """

    increments: Increments
    mode: Float64[np.ndarray, " num_frames"]
    std: Float64[np.ndarray, " num_frames"]
    precision: list[Float64[np.ndarray, "2 frames"]]

    def sample(self, num: int, seed: int | np.random.Generator = 0) -> Float64[np.ndarray, "num num_frames"]:
        """Draw times; those out of order are contracted towards the mode."""
        rng = np.random.default_rng(seed)
        times = np.broadcast_to(self.mode, (num, len(self.mode))).copy()
        for (first, last), bands in zip(self.increments.runs, self.precision, strict=True):
            noise = rng.standard_normal((last - first + 1, num))
            upper = scipy.linalg.cholesky_banded(_banded(bands))
            times[:, first : last + 1] += scipy.linalg.solve_banded((0, 1), upper, noise).T
        for _ in range(60):
            wrong = (np.diff(times, axis=1) <= 0).any(1)
            if not wrong.any():
                break
            times[wrong] = self.mode + (times[wrong] - self.mode) * 0.7
        return times


def laplace_approximation(
    curves: ProfileCurves, increments: Increments, start: Float[np.ndarray, " num_frames"]
) -> LaplaceApproximation:
    """Newton's method for the mode of the density of the log-ratios, from increasing times `start`.

    Slopes and curvatures are differences over `REACH` standard deviations to both sides.
    """
    mode, std, precision = np.array(start, np.float64), np.zeros(len(start)), []
    for first, last in increments.runs:
        frames = np.arange(first, last + 1)
        bands = _maximize(curves[frames], mode, first, last, increments.concentration)
        precision.append(bands)
        upper = scipy.linalg.cholesky_banded(_banded(bands))
        inverse = scipy.linalg.cho_solve_banded((upper, False), np.eye(len(frames)))
        std[frames] = np.sqrt(np.diag(inverse))
    return LaplaceApproximation(increments, mode, std, precision)


def _maximize(curves: ProfileCurves, times: np.ndarray, first: int, last: int, alpha: float) -> np.ndarray:
    """Maximize in place; returns the bands of the negative Hessian at the mode."""
    part = slice(first, last + 1)
    step = np.diff(times)[first - 1 : last].copy() * 0.1

    def height(inner: np.ndarray) -> float:
        gaps = np.diff(np.concatenate([[times[first - 1]], inner, [times[last + 1]]]))
        return float(curves(inner).sum() + alpha * np.log(gaps).sum()) if (gaps > 0).all() else -np.inf

    now = height(times[part])
    for _ in range(MAX_STEPS):
        slope, bands = _derivatives(curves, times, first, last, alpha, step)
        step = REACH / np.sqrt(bands[0])
        # Not `solveh_banded`, which SciPy cannot do for one unknown.
        move = scipy.linalg.cho_solve_banded((scipy.linalg.cholesky_banded(_banded(bands)), False), slope)
        for _ in range(40):
            raised = height(times[part] + move)
            if raised >= now:
                break
            move = move / 2
        else:
            break
        times[part] += move
        gained, now = raised - now, raised
        if gained < MIN_GAIN:
            break
    return _derivatives(curves, times, first, last, alpha, step)[1]


def _derivatives(curves: ProfileCurves, times, first: int, last: int, alpha: float, step: np.ndarray):
    """Gradient and bands of the negative Hessian, positive since each frame's curvature is clamped at 0."""
    inner = times[first : last + 1]
    gaps = np.diff(times[first - 1 : last + 2])
    low = np.maximum(inner - step, curves.nodes[:, 0])
    high = np.minimum(inner + step, curves.nodes[np.arange(len(inner)), curves.count - 1])
    left, middle, right = curves(np.stack([low, inner, high]))
    before, after = np.maximum(inner - low, 1e-300), np.maximum(high - inner, 1e-300)
    rise, fall = (middle - left) / before, (right - middle) / after
    slope = (rise * after + fall * before) / (before + after)
    curvature = np.maximum(2 * (rise - fall) / (before + after), 0.0)
    slope = slope + alpha / gaps[:-1] - alpha / gaps[1:]
    bands = np.stack([curvature + alpha / gaps[:-1] ** 2 + alpha / gaps[1:] ** 2, -alpha / gaps[1:] ** 2])
    return slope, bands


def _banded(bands: np.ndarray) -> np.ndarray:
    """Main and upper diagonal in SciPy's upper banded form."""
    return np.stack([np.concatenate([[0.0], bands[1, :-1]]), bands[0]])
