"""Where EM starts: responsibilities from k-means, from random curves that follow the points, or at random."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from foldgauss.envelope import Constant
from foldgauss.estimator.em.components import Parameters
from foldgauss.estimator.em.statistics import Points, accumulate, points_of
from foldgauss.estimator.em.updates import Model, updated

__all__ = ["STARTS", "drawn", "from_joint", "from_responsibilities", "start"]

#: Points that a start looks at; EM itself sees all of them.
_MOST_POINTS = 20_000
#: Of more points than this, NumPy's draw without replacement, an order of all of them, would take memory of its own.
_MOST_ORDERED = 2**20
_LLOYD_STEPS = 10
#: Curves tried for each component, points that they are tried on, and steps in which each grows along the points.
_CURVES, _CURVE_POINTS, _GROWTH_STEPS = 12, 2_000, 8


def start(
    kind: str, y: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"], model: Model, degree: int, rng
) -> Parameters:
    """Parameters for scaled points from one of `STARTS`; `rng` is NumPy's."""
    keep = np.flatnonzero(weights > 0)
    if (some := drawn(len(keep), rng)) is not None:
        keep = keep[some]
    # Points in order and none twice: the same start for a weight of 2 and a point that is there twice.
    y, which = np.unique(y[keep], axis=0, return_inverse=True)
    weights = np.bincount(which.ravel(), weights[keep]).astype(y.dtype)
    responsibilities = STARTS[kind](y.astype(np.float64), weights, len(model.used), degree, rng)
    return from_responsibilities(y, weights, responsibilities, model, degree)


def drawn(num: int, rng) -> Int[np.ndarray, " m"] | None:
    """The numbers, out of `num`, of the points that a start looks at; None where it looks at all."""
    if num <= _MOST_POINTS:
        return None
    if num <= _MOST_ORDERED:
        return rng.choice(num, _MOST_POINTS, replace=False)
    # Twice as many as needed, hardly any of them twice; which of them are kept is fair again.
    return rng.choice(np.unique(rng.choice(num, 2 * _MOST_POINTS)), _MOST_POINTS, replace=False)


def from_responsibilities(y, weights, responsibilities, model: Model, degree: int) -> Parameters:
    """The components that fit points best, which belong to them in these shares (n, k)."""
    num = responsibilities.shape[1]
    points = points_of(y, weights, num)
    rows = points.x.shape[1] * points.x.shape[2]
    shares = np.zeros((rows, num), y.dtype)
    shares[: len(y)] = responsibilities
    shares = jnp.asarray(shares.reshape(*points.x.shape[:3], num))
    dim, dtype = y.shape[1] - 1, y.dtype
    params = Parameters(
        jnp.full(num, -np.log(num), dtype),
        jnp.zeros(num, dtype),
        jnp.ones(num, dtype),
        jnp.zeros((num, degree + 1, dim), dtype),
        jnp.broadcast_to(jnp.eye(dim, dtype=dtype)[None], (num, dim, dim)),
    )
    for _ in range(2):  # once more from there, where all is centred
        params = _fitted(params, points, shares, model)
    return params


@eqx.filter_jit
def _fitted(params: Parameters, points: Points, shares, model: Model) -> Parameters:
    return updated(params, accumulate(params, Constant(), points, responsibilities=shares), model)[0]


def from_joint(weights, means, covariances, degree: int, dtype) -> Parameters:
    """Components with linear folds from Gaussians of space and time together, in scaled units."""
    variance = covariances[:, -1, -1]
    slope = covariances[:, :-1, -1] / variance[:, None]
    conditional = covariances[:, :-1, :-1] - slope[:, :, None] * covariances[:, None, :-1, -1]
    curve = np.zeros((len(means), degree + 1, means.shape[1] - 1))
    curve[:, 0] = means[:, :-1]
    if degree:
        curve[:, 1] = -slope * np.sqrt(variance)[:, None]  # v runs against time
    parts = (np.log(weights), means[:, -1], np.sqrt(variance), curve, np.linalg.cholesky(conditional))
    return Parameters(*(jnp.asarray(z, dtype) for z in parts))


# --- shares of the points -----------------------------------------------------------------------------------


def _one_hot(labels: Int[np.ndarray, " n"], num: int) -> Float[np.ndarray, "n k"]:
    return (labels[:, None] == np.arange(num)).astype(np.float64)


def _distances(y, centres) -> Float[np.ndarray, "n k"]:
    square = (y * y).sum(1)[:, None] - 2 * y @ centres.T + (centres * centres).sum(1)
    return np.maximum(square, 0)


def _seeds(y, weights, num, rng) -> Float[np.ndarray, "k d"]:
    """Arthur and Vassilvitskii 2007: each next centre with probability by its squared distance to those there are."""
    chosen = [rng.choice(len(y), p=weights / weights.sum())]
    nearest = np.full(len(y), np.inf)
    for _ in range(1, num):
        nearest = np.minimum(nearest, ((y - y[chosen[-1]]) ** 2).sum(1))
        mass = weights * nearest
        chosen.append(rng.choice(len(y), p=mass / mass.sum() if mass.sum() > 0 else None))
    return y[chosen]


def _plus_plus(y, weights, num, degree, rng):
    return _one_hot(_distances(y, _seeds(y, weights, num, rng)).argmin(1), num)


def _k_means(y, weights, num, degree, rng):
    centres = _seeds(y, weights, num, rng)
    for _ in range(_LLOYD_STEPS):
        shares = _one_hot(_distances(y, centres).argmin(1), num) * weights[:, None]
        mass = shares.sum(0)
        moved = shares.T @ y / np.where(mass > 0, mass, 1)[:, None]
        moved = np.where((mass > 0)[:, None], moved, centres)
        if np.array_equal(moved, centres):
            break
        centres = moved
    return _one_hot(_distances(y, centres).argmin(1), num)


def _random(y, weights, num, degree, rng):
    shares = rng.uniform(size=(len(y), num))
    return shares / shares.sum(1, keepdims=True)


def _random_from_data(y, weights, num, degree, rng):
    there = rng.choice(len(y), num, replace=len(y) < num, p=weights / weights.sum() if len(y) < num else None)
    return _one_hot(_distances(y, y[there]).argmin(1), num)


def _trajectories(y, weights, num, degree, rng):
    """Each point to the nearest of `num` curves, taken greedily from many by how many points they explain."""
    some = rng.choice(len(y), min(len(y), _CURVE_POINTS), replace=False)
    part, mass = y[some], weights[some]
    curves, widths = _grown_curves(part, mass, _CURVES * num, max(degree, 1), rng)
    square = _curve_distances(part, curves)
    near = np.exp(-0.5 * square / np.median(widths) ** 2) * mass[:, None]
    chosen, left = [], np.ones(len(part))
    for _ in range(num):
        gain = left @ near
        gain[chosen] = -1  # a curve taken twice would leave a component without points
        best = int(np.argmax(gain))
        chosen.append(best)
        left = left * (1 - near[:, best] / mass)
    return _one_hot(_curve_distances(y, curves[chosen]).argmin(1), num)


def _grown_curves(y, weights, num, degree, rng):
    """Polynomials of time (num, degree + 1, d-1), each grown along the points from one of them, and their widths.

    From a few neighbours on: fit, take the points near the curve within a window of time that grows, fit again.
    """
    t, s = y[:, -1], y[:, :-1]
    home = rng.choice(len(y), num, replace=True)
    reach = np.ptp(t) or 1.0
    nearest = np.sort(_distances(y, y[home]), axis=0)[min(len(y) - 1, max(8, len(y) // 50))]
    near = weights[:, None] * np.exp(-0.5 * _distances(y, y[home]) / np.maximum(nearest, 1e-12))
    width = np.maximum(np.sqrt(nearest), 1e-3)
    ridge = 1e-3 * np.diag(np.arange(degree + 1) ** 2.0)  # curves are straight until points say that they bend
    for step in range(_GROWTH_STEPS + 1):
        used = min(degree, 1 + step // 2)
        powers = t[:, None] ** np.arange(used + 1)
        normal = np.einsum("nc,ni,nj->cij", near, powers, powers) + ridge[: used + 1, : used + 1]
        right = np.einsum("nc,ni,nj->cij", near, powers, s)
        curves = np.zeros((num, degree + 1, s.shape[1]))
        curves[:, : used + 1] = np.linalg.solve(normal + 1e-9 * np.eye(used + 1), right)
        square = _curve_distances(y, curves)
        total = np.maximum(near.sum(0), 1e-300)
        width = np.clip(np.sqrt((near * square).sum(0) / total), 1e-3, width)
        window = reach * 2.0 ** (0.5 * (step + 1 - _GROWTH_STEPS))
        inside = np.abs(t[:, None] - t[home]) <= window
        near = weights[:, None] * inside * np.exp(-0.5 * square / (1.5 * width) ** 2)
    return curves, width


def _curve_distances(y, curves) -> Float[np.ndarray, "n c"]:
    powers = y[:, -1:] ** np.arange(curves.shape[1])
    return ((y[:, None, :-1] - np.einsum("nj,cjp->ncp", powers, curves)) ** 2).sum(-1)


STARTS = {
    "kmeans": _k_means,
    "k-means++": _plus_plus,
    "random": _random,
    "random_from_data": _random_from_data,
    "trajectories": _trajectories,
}
