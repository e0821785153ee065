"""Where the Gaussians start: drawn from the clip's own detail, with its own colours."""

import cv2
import numpy as np

from foldgauss.envelope import TimeLikelihood
from foldgauss.video.model import SH_C0, TAU_MAX, FoldedSplats

#: Share of the starts that is spread evenly, so that flat parts are covered too.
EVEN_SHARE = 0.15
#: Starting standard deviation in units of the distance to the neighbours alive at the same time.
SCALE_FACTOR = 1.3
START_OPACITY = 0.3
#: sigma_t is drawn log-uniformly between these, in units of the clip's duration.
TIME_SCALES = (0.02, 0.4)


def initialize(
    frames: np.ndarray, num_gaussians: int, *, degree: int, envelope: TimeLikelihood, seed: int
) -> FoldedSplats:
    """Starting splats for `frames`, uint8 (num_frames, height, width, 3).

    Positions are drawn by image gradient within each frame, m_t at that frame, sigma_t log-uniformly, sizes by the
    local density of starts, colours from the pixel, folds at rest.
    """
    rng = np.random.default_rng([seed, 0])
    num_frames, height, width, _ = frames.shape
    home = np.sort(rng.integers(num_frames, size=num_gaussians))
    pixel, density = np.empty(num_gaussians, np.int64), np.empty(num_gaussians)
    color = np.empty((num_gaussians, 3), np.float32)
    for k in np.unique(home):
        here = np.flatnonzero(home == k)
        share = detail(frames[k]).ravel()
        pixel[here] = _draw(share, rng.random(len(here)))
        density[here] = share[pixel[here]]
        color[here] = frames[k].reshape(-1, 3)[pixel[here]] / np.float32(255)
    y, x = np.divmod(pixel, width)
    position = np.stack([x, y], -1) + rng.random((num_gaussians, 2)) - [width / 2, height / 2]
    shortest = max(TIME_SCALES[0], 1 / (num_frames - 1))
    spread = np.exp(rng.uniform(np.log(shortest), np.log(max(TIME_SCALES[1], shortest)), num_gaussians))
    time = np.clip((home + rng.uniform(-0.5, 0.5, num_gaussians)) / (num_frames - 1), 1e-3, 1 - 1e-3)
    alive = _mean_alive(time, spread)
    scale = SCALE_FACTOR / np.sqrt(alive * density)
    unit = max(height, width)
    order = rng.permutation(num_gaussians)  # depth has nothing to do with time

    def leaf(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(values[order], dtype=np.float32)

    return FoldedSplats(
        loc=leaf(position / unit),
        log_scale=leaf(np.log(np.stack([scale, scale], -1) / unit)),
        angle_logit=leaf(_logit(rng.uniform(0.01, 0.99, num_gaussians))),
        time_loc_logit=leaf(_logit(time)),
        log_time_scale=leaf(np.log(spread)),
        coefficients=np.zeros((num_gaussians, degree, 2), np.float32),
        opacity_logit=leaf(_logit(np.full(num_gaussians, START_OPACITY))),
        color_dc=leaf((color - 0.5) / SH_C0),
        envelope=envelope,
    )


def detail(frame: np.ndarray) -> np.ndarray:
    """Density of starts over one frame's pixels (height, width), summing to 1: gradient, and an even share."""
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)).astype(np.float64)
    slope = cv2.GaussianBlur(slope, (0, 0), 1.0)
    even = np.full(slope.shape, 1 / slope.size)
    total = slope.sum()
    return EVEN_SHARE * even + (1 - EVEN_SHARE) * (slope / total if total > 0 else even)


def _draw(share: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Indices distributed as `share`, by inversion."""
    summed = np.cumsum(share)
    return np.minimum(np.searchsorted(summed, uniform * summed[-1], side="right"), len(share) - 1)


def _mean_alive(time: np.ndarray, spread: np.ndarray) -> float:
    """Gaussians alive at a time, averaged over [0, 1]."""
    first, last = time - TAU_MAX * spread, time + TAU_MAX * spread
    return float((np.minimum(last, 1) - np.maximum(first, 0)).sum())


def _logit(p: np.ndarray) -> np.ndarray:
    return np.log(p) - np.log1p(-p)
