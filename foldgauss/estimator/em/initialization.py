"""Initial parameters of EM from responsibilities: by k-means, random curves grown along the points, or at random."""

import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import sklearn.cluster
from jaxtyping import Float, Int
from sklearn.exceptions import ConvergenceWarning

from foldgauss.envelope import Constant
from foldgauss.estimator.em.components import Parameters
from foldgauss.estimator.em.m_step import Model, update_components
from foldgauss.estimator.em.statistics import Points, accumulate, make_points

#: The largest subset of points that an initialization uses; EM itself uses all points.
_MAX_POINTS = 20_000
#: Starts of k-means, of which the best is taken: one alone ends in a poor optimum in a fifth of all draws.
_KMEANS_STARTS = 4
#: Curves tried for each component.
_CURVES = 12
#: Points that curves are tried on.
_CURVE_POINTS = 2_000
#: Steps in which each curve grows along the points.
_GROWTH_STEPS = 8


def initialize(
    kind: str, y: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"], model: Model, degree: int, rng
) -> Parameters:
    """Initial parameters for scaled points by one of `INITIALIZERS`; `rng` is NumPy's."""
    keep = np.flatnonzero(weights > 0)
    if (some := draw_subset(len(keep), rng)) is not None:
        keep = keep[some]
    # Points sorted and without duplicates: a weight of 2 gives the same result as a repeated point.
    y, which = np.unique(y[keep], axis=0, return_inverse=True)
    weights = np.bincount(which.ravel(), weights[keep]).astype(y.dtype)
    responsibilities = INITIALIZERS[kind](y.astype(np.float64), weights, len(model.degrees), degree, rng)
    return params_from_responsibilities(y, weights, responsibilities, model, degree)


def draw_subset(num: int, rng) -> Int[np.ndarray, " m"] | None:
    """Draw the indices, out of `num`, of the points that an initialization uses; None for all."""
    if num <= _MAX_POINTS:
        return None
    # Not by `rng`, which would permute all indices.
    return np.random.default_rng(rng.randint(np.iinfo(np.int32).max)).choice(num, _MAX_POINTS, replace=False)


def params_from_responsibilities(y, weights, responsibilities, model: Model, degree: int) -> Parameters:
    """Fit the components to points with given responsibilities (n, k)."""
    num = responsibilities.shape[1]
    points = make_points(y, weights, num)
    rows = points.x.shape[1] * points.x.shape[2]
    padded = np.zeros((rows, num), y.dtype)
    padded[: len(y)] = responsibilities
    padded = jnp.asarray(padded.reshape(*points.x.shape[:3], num))
    dim, dtype = y.shape[1] - 1, y.dtype
    params = Parameters(
        jnp.full(num, -np.log(num), dtype),
        jnp.zeros(num, dtype),
        jnp.ones(num, dtype),
        jnp.zeros((num, degree + 1, dim), dtype),
        jnp.broadcast_to(jnp.eye(dim, dtype=dtype)[None], (num, dim, dim)),
    )
    for _ in range(2):  # the second time relative to the fitted curves, for accuracy
        params = _maximize(params, points, padded, model)
    return params


@eqx.filter_jit
def _maximize(params: Parameters, points: Points, padded, model: Model) -> Parameters:
    return update_components(params, accumulate(params, Constant(), points, responsibilities=padded), model)[0]


def restrict_covariances(params: Parameters, kind: str) -> Parameters:
    """Replace the covariances by those of the kind that is fitted, which EM's updates then preserve."""
    tril = np.asarray(params.tril, np.float64)
    covariances, eye = tril @ tril.swapaxes(-1, -2), np.eye(tril.shape[-1])
    if kind == "full" or not np.isfinite(covariances).all():
        return params
    if kind == "tied":
        weights = np.exp(np.asarray(params.log_weights, np.float64))
        covariances = np.broadcast_to(np.einsum("k,kab->ab", weights / weights.sum(), covariances), covariances.shape)
    if kind == "diag":
        covariances = covariances * eye
    if kind == "spherical":
        covariances = np.trace(covariances, axis1=1, axis2=2)[:, None, None] / len(eye) * eye
    return params._replace(tril=jnp.asarray(np.linalg.cholesky(covariances), params.tril.dtype))


# --- responsibilities ---------------------------------------------------------------------------------------


def _one_hot(labels: Int[np.ndarray, " n"], num: int) -> Float[np.ndarray, "n k"]:
    return (labels[:, None] == np.arange(num)).astype(np.float64)


def _distances(y, centers) -> Float[np.ndarray, "n k"]:
    square = (y * y).sum(1)[:, None] - 2 * y @ centers.T + (centers * centers).sum(1)
    return np.maximum(square, 0)


def _assign_by_plus_plus(y, weights, num, degree, rng):
    centers = sklearn.cluster.kmeans_plusplus(y, min(num, len(y)), sample_weight=weights, random_state=rng)[0]
    return _one_hot(_distances(y, centers).argmin(1), num)


def _assign_by_k_means(y, weights, num, degree, rng):
    means = sklearn.cluster.KMeans(min(num, len(y)), n_init=_KMEANS_STARTS, random_state=rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # fewer distinct points than components: some stay empty
        return _one_hot(means.fit(y, sample_weight=weights).labels_, num)


def _assign_at_random(y, weights, num, degree, rng):
    fractions = rng.uniform(size=(len(y), num))
    return fractions / fractions.sum(1, keepdims=True)


def _assign_to_random_points(y, weights, num, degree, rng):
    there = rng.choice(len(y), num, replace=len(y) < num, p=weights / weights.sum() if len(y) < num else None)
    return _one_hot(_distances(y, y[there]).argmin(1), num)


def _assign_to_trajectories(y, weights, num, degree, rng):
    """Assign each point to the nearest of `num` curves, selected greedily from many by how many points they explain."""
    some = rng.choice(len(y), min(len(y), _CURVE_POINTS), replace=False)
    part, mass = y[some], weights[some]
    curves, widths = _grow_curves(part, mass, _CURVES * num, max(degree, 1), rng)
    square = _curve_distances(part, curves)
    near = np.exp(-0.5 * square / np.median(widths) ** 2) * mass[:, None]
    chosen, left = [], np.ones(len(part))
    for _ in range(num):
        gain = left @ near
        gain[chosen] = -1  # a curve selected twice would leave a component without points
        best = int(np.argmax(gain))
        chosen.append(best)
        left = left * (1 - near[:, best] / mass)
    return _one_hot(_curve_distances(y, curves[chosen]).argmin(1), num)


def _grow_curves(y, weights, num, degree, rng):
    """Grow polynomials of time (num, degree + 1, d-1), each along the points from a random one; also their widths.

    Each is fitted to a few neighbors first, then repeatedly to the points near it in a growing window of time.
    """
    t, s = y[:, -1], y[:, :-1]
    seed = rng.choice(len(y), num, replace=True)
    reach = np.ptp(t) or 1.0
    nearest = np.sort(_distances(y, y[seed]), axis=0)[min(len(y) - 1, max(8, len(y) // 50))]
    near = weights[:, None] * np.exp(-0.5 * _distances(y, y[seed]) / np.maximum(nearest, 1e-12))
    width = np.maximum(np.sqrt(nearest), 1e-3)
    ridge = 1e-3 * np.diag(np.arange(degree + 1) ** 2.0)  # penalizes curvature
    for step in range(_GROWTH_STEPS + 1):
        current = min(degree, 1 + step // 2)
        powers = t[:, None] ** np.arange(current + 1)
        normal = np.einsum("nc,ni,nj->cij", near, powers, powers) + ridge[: current + 1, : current + 1]
        right = np.einsum("nc,ni,nj->cij", near, powers, s)
        curves = np.zeros((num, degree + 1, s.shape[1]))
        curves[:, : current + 1] = np.linalg.solve(normal + 1e-9 * np.eye(current + 1), right)
        square = _curve_distances(y, curves)
        total = np.maximum(near.sum(0), 1e-300)
        width = np.clip(np.sqrt((near * square).sum(0) / total), 1e-3, width)
        window = reach * 2.0 ** (0.5 * (step + 1 - _GROWTH_STEPS))
        inside = np.abs(t[:, None] - t[seed]) <= window
        near = weights[:, None] * inside * np.exp(-0.5 * square / (1.5 * width) ** 2)
    return curves, width


def _curve_distances(y, curves) -> Float[np.ndarray, "n c"]:
    powers = y[:, -1:] ** np.arange(curves.shape[1])
    return ((y[:, None, :-1] - np.einsum("nj,cjp->ncp", powers, curves)) ** 2).sum(-1)


INITIALIZERS = {
    "kmeans": _assign_by_k_means,
    "k-means++": _assign_by_plus_plus,
    "random": _assign_at_random,
    "random_from_data": _assign_to_random_points,
    "trajectories": _assign_to_trajectories,
}
