"""A model with shared paths as one with polynomial folds only, for formats that have no other motion."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from foldgauss._runtime.checks import is_integer, require
from foldgauss.video.models.splats import TAU_MAX, FoldedSplats, find_axes
from foldgauss.video.models.video_model import VideoModel, check_model

#: The highest degree that is tried: that of the published VeGaS code.
MAX_DEGREE = 7
#: A Gaussian gets another power only if it misses its path by more than this, in pixels, see `fit_powers`.
NEEDED = 0.1
#: A fit uses a power only if it misses by less than this fraction of the error without it.
GAINED = 0.8
#: Times in a Gaussian's life at which its place is fitted, besides those of the frames.
OWN_TIMES = 9
#: Added to the diagonal of normal equations whose greatest element is 1.
RIDGE = 1e-12
CHUNK = 1024  # Gaussians that are fitted at once


def without_paths(model: VideoModel, degree: int | None = None) -> tuple[VideoModel, Float[np.ndarray, " num"]]:
    """The model without shared paths: each Gaussian has a polynomial fold in place of its path and its own fold.

    Its place A(t) (q + p(m_t - t)) is fitted by least squares, weighted by the envelope, at the times of the frames
    that show it and at some between. Its place and its covariance at m_t are exact; how the path turns and stretches it
    at other times is left out. Gaussians on no path stay as they are.

    `degree`: of the folds. None: the model's, but at least 1, and up to 7 where that reduces the error.

    Returns the model, and the root mean square distance of each Gaussian from its place, (num,), with the weights of
    the fit, in pixels of the model's size. A model without paths is returned as it is.

    **Example:** `plain, error = without_paths(model)`

    **Source:** the fold of VeGaS eq:cond_dens. **Raises:** ValueError for anything but a `VideoModel`, and for a degree
    below 1 or below that of Gaussians on no path.
    """
    check_model(model)
    splats = model.splats
    if splats.paths is None:
        return model, np.zeros(model.num_gaussians)
    on_path = np.asarray(splats.path_index) > 0
    least = max(1, int(splats.degrees[~on_path].max(initial=0)))
    require(
        degree is None or is_integer(degree, least),
        "degree",
        expected=f"a whole number from {least}",
        got=repr(degree),
    )
    lowest = max(splats.degree, 1) if degree is None else int(degree)
    highest = max(lowest, MAX_DEGREE) if degree is None else lowest
    coefficients = np.zeros((model.num_gaussians, highest, 2))
    kept = min(splats.degree, highest)
    coefficients[:, :kept] = np.asarray(splats.coefficients)[:, :kept]
    error, pixels = np.zeros(model.num_gaussians), max(model.size)
    moved, arrays = np.flatnonzero(on_path), jax.tree.map(np.asarray, splats)
    frames = np.asarray(model.frame_times.times(), np.float64)
    for start in range(0, len(moved), CHUNK):
        which = moved[start : start + CHUNK]
        u, weight, shift = _sample_places(arrays, frames, which)
        unit = np.abs(u * (weight > 0)).max(1)[:, None]  # of u, so that powers are of one size
        powers = np.cumprod(np.broadcast_to((u / unit)[..., None], (*u.shape, highest)), -1)
        weighted = powers.mT * (weight / weight.sum(1, keepdims=True))[:, None]
        squares = (weight * (shift**2).sum(-1)).sum(1) / weight.sum(1)
        how = np.full((1, highest), RIDGE), lowest, NEEDED / pixels
        found, error[which] = fit_powers(weighted @ powers, weighted @ shift, squares, *how)
        coefficients[which] = found / unit[..., None] ** np.arange(1, highest + 1)[:, None]
    used = max(lowest, int(((coefficients != 0).any(2) * np.arange(1, highest + 1)).max()))
    gaussians = splats.gaussians()
    log_scale, angle = find_axes(gaussians.scale_tril)

    def put(new, old):
        return jnp.where(on_path.reshape(-1, *(1,) * (np.ndim(old) - 1)), new, old)

    plain = dataclasses.replace(
        splats,
        loc=put(gaussians.loc, splats.loc),
        log_scale=put(log_scale, splats.log_scale),
        angle_logit=put(jax.scipy.special.logit(angle / (2 * jnp.pi)), splats.angle_logit),
        coefficients=jnp.asarray(coefficients[:, :used], np.asarray(splats.coefficients).dtype),
        path_index=None,
        paths=None,
    )
    return dataclasses.replace(model, splats=plain), error * pixels


def _sample_places(
    splats: FoldedSplats, frames: Float[np.ndarray, " frames"], which: Int[np.ndarray, " num"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u = m_t - t, weight (num, times), 0 where a Gaussian is not shown, and the shift since m_t."""
    index = splats.path_index[which]
    time_loc = expit(splats.time_loc_logit[which].astype(np.float64))
    time_scale = np.exp(splats.log_time_scale[which].astype(np.float64))
    ends = np.clip([time_loc - TAU_MAX * time_scale, time_loc + TAU_MAX * time_scale], 0, 1)
    own = np.linspace(*ends, OWN_TIMES, axis=1)
    t = np.concatenate([np.broadcast_to(frames, (len(which), len(frames))), own], 1)
    u = time_loc[:, None] - t
    tau = u / time_scale[:, None]
    power, floor = float(splats.envelope.power), float(splats.envelope.floor)
    envelope = floor + (1 - floor) * np.exp(-0.5 * power * tau**2)
    weight = np.where((t >= ends[0][:, None]) & (t <= ends[1][:, None]), envelope, 0)
    place = np.broadcast_to(splats.loc[which, None].astype(np.float64), (*u.shape, 2))
    fold = sum(splats.coefficients[which, k, None] * u[..., None] ** (k + 1) for k in range(splats.degree))
    there = splats.paths.by_index(t, np.broadcast_to(index[:, None], t.shape))
    home = splats.paths.by_index(time_loc, index)[:, None]
    return u, weight, _apply(there, place + fold) - _apply(home, place)


def _apply(maps: np.ndarray, place: np.ndarray) -> np.ndarray:
    return (maps[..., :2] @ place[..., None])[..., 0] + maps[..., 2]


def fit_powers(
    normal: Float[np.ndarray, "num highest highest"],
    right: Float[np.ndarray, "num highest 2"],
    squares: Float[np.ndarray, " num"],
    ridges: Float[np.ndarray, "#num highest"],
    lowest: int,
    needed: float,
) -> tuple[Float[np.ndarray, "num highest 2"], Float[np.ndarray, " num"]]:
    """Weighted least squares of shifts by powers of u without a constant: coefficients, and root mean square errors.

    All use `lowest` powers, and those whose error is above `needed` as many more as reduce it, see `GAINED`; the other
    coefficients are 0. `normal`, `right` and `squares` are the weighted means of products of the powers, of powers with
    the shifts, and of squared shifts; `ridges` are added to the diagonal.
    """
    num, highest = right.shape[:2]
    coefficients, error = np.zeros((num, highest, 2)), np.full(num, np.inf)
    for used in range(lowest, highest + 1):
        off = np.flatnonzero(error > needed)
        own, target = normal[off, :used, :used], right[off, :used]
        ridge = np.broadcast_to(ridges, (num, highest))[off, :used, None] * np.eye(used)
        found = np.linalg.solve(own + ridge, target)
        left = np.sqrt(np.maximum(squares[off] + (found * (own @ found - 2 * target)).sum((1, 2)), 0))
        better = left < GAINED * error[off]
        coefficients[off[better], :used], error[off[better]] = found[better], left[better]
    return coefficients, error
