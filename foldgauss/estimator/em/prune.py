"""Only what the data require: components and powers that do not pay for themselves are taken away, one after another.

Arrays keep their shapes (a component taken away has weight 0), so that one compiled program serves the whole search.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from foldgauss._numerics.regression import hermite_to_powers
from foldgauss.envelope import AbstractEnvelope
from foldgauss.estimator.em.cholesky import cholesky, inverse_lower, log_det
from foldgauss.estimator.em.components import Parameters, log_likelihoods, pairs_of, to_powers
from foldgauss.estimator.em.loop import best, expectation_maximisation, log_likelihood
from foldgauss.estimator.em.statistics import Blocks, Points, Statistics, accumulate, summed
from foldgauss.estimator.em.updates import Model, residual_scatter

__all__ = ["compressed", "num_parameters", "pruned"]

#: Components tried before it is believed that none can go.
_TRIALS = 3


class _Found(NamedTuple):
    params: Parameters
    model: Model
    score: float


def num_parameters(weights: np.ndarray, degrees: np.ndarray, dim: int, covariance: str) -> int:
    """Free parameters of the components with weight: curves, times, covariances, and weights less one."""
    alive = np.asarray(weights) > 0
    num = int(alive.sum())
    of_sigma = {"full": dim * (dim + 1) // 2, "tied": dim * (dim + 1) // 2, "diag": dim, "spherical": 1}[covariance]
    of_sigma = of_sigma if covariance == "tied" else num * of_sigma
    return int(dim * (np.asarray(degrees)[alive] + 1).sum()) + 2 * num + of_sigma + num - 1


def pruned(
    params: Parameters,
    points: Points | Blocks,
    envelope: AbstractEnvelope,
    model: Model,
    *,
    penalty: float,
    components: bool,
    powers: bool,
    total: float,
    tol: float,
    max_steps: int,
) -> tuple[Parameters, Model]:
    """Fewer components and lower degrees, as long as -2 log-likelihood + penalty * parameters falls."""
    dim = params.tril.shape[-1]

    def scored(params, model) -> _Found:
        weights = np.exp(np.asarray(params.log_weights))
        free = num_parameters(weights, model.used, dim, model.covariance)
        value = float(log_likelihood(params, points, envelope))
        return _Found(params, model, -2 * value + penalty * free if np.isfinite(value) else np.inf)

    def fitted(params, model) -> _Found:
        starts = jax.tree.map(lambda z: z[None], params)
        options = {"total": total, "tol": tol, "max_steps": max_steps}
        return scored(best(expectation_maximisation(starts, points, envelope, model, **options)).params, model)

    found, moves = scored(params, model), True
    while moves:
        moves = False
        # Powers first: a component is worth more beside others than its share of powers that nobody needs.
        while powers and (less := _lower(found, points, envelope, fitted, penalty)) is not None:
            found, moves = less, True
        while components and (less := _fewer(found, points, envelope, fitted, total)) is not None:
            found, moves = less, True
    return found.params, found.model


def compressed(params: Parameters, model: Model) -> tuple[Parameters, Model]:
    """The components with weight alone, and no more powers than they use."""
    alive = np.flatnonzero(np.asarray(params.log_weights) > -np.inf)
    used = np.asarray(model.used)[alive]
    log_weights, time_loc, time_scale, curve, tril = (jnp.asarray(np.asarray(z)[alive]) for z in params)
    params = Parameters(log_weights, time_loc, time_scale, curve[:, : int(used.max()) + 1], tril)
    return params, Model(jnp.asarray(used), model.floor, model.covariance)


def _fewer(found: _Found, points, envelope, fitted, total: float) -> _Found | None:
    """One component less, if that pays: those are tried first whose points the others explain best."""
    log_weights = np.asarray(found.params.log_weights, np.float64)
    alive = np.flatnonzero(log_weights > -np.inf)
    if len(alive) < 2:
        return None
    without = np.asarray(summed(_without, points, found.params, envelope), np.float64)
    share = np.exp(log_weights[alive])
    value = without[alive] - total * np.log1p(-np.minimum(share, 1 - 1e-12))
    for k in alive[np.argsort(-value)[:_TRIALS]]:
        rest = log_weights.copy()
        rest[k] = -np.inf
        rest -= np.logaddexp.reduce(rest)
        trial = found.params._replace(log_weights=jnp.asarray(rest, found.params.log_weights.dtype))
        less = fitted(trial, found.model)
        if less.score < found.score:
            return less
    return None


def _lower(found: _Found, points, envelope, fitted, penalty: float) -> _Found | None:
    """A power less in every component where it does not pay; if that was too much at once, in the first of them."""
    sums = summed(_sums, points, found.params, envelope)
    losses = np.asarray(_losses(sums, found.params, found.model), np.float64)
    used, dim = np.asarray(found.model.used), found.params.tril.shape[-1]
    idle = (2 * losses < penalty * dim) & (used > 0) & (np.asarray(found.params.log_weights) > -np.inf)
    first = np.arange(len(used)) == np.argmin(np.where(idle, losses, np.inf))
    for which in (idle, idle & first):
        if which.any() and (less := _with_degrees(found, used - which, fitted)).score < found.score:
            return less
    return None


def _with_degrees(found: _Found, used: np.ndarray, fitted) -> _Found:
    """Fitted again without the highest Hermite polynomials, which are nearly orthogonal to the others."""
    matrix = hermite_to_powers(found.params.degree)
    hermite = np.linalg.solve(matrix, np.asarray(found.params.curve, np.float64))
    hermite = np.where(np.arange(len(matrix))[None, :, None] <= used[:, None, None], hermite, 0)
    curve = to_powers(jnp.asarray(hermite, found.params.curve.dtype))
    model = Model(jnp.asarray(used, jnp.int32), found.model.floor, found.model.covariance)
    return fitted(found.params._replace(curve=curve), model)


def _sums(params: Parameters, envelope, points: Points) -> Statistics:
    return accumulate(params, envelope, points)


def _without(params: Parameters, envelope, points: Points) -> Float[Array, " k"]:
    """The log-likelihood without each component, the others as they are, but for the weights' sum."""

    def of_chunk(chunk):
        x, weights = chunk
        log_density = pairs_of(params, envelope, x).log_density
        total = log_likelihoods(log_density)[:, None]
        eps = jnp.finfo(total.dtype).eps
        rest = total + jnp.log(jnp.maximum(-jnp.expm1(jnp.minimum(log_density - total, 0)), eps))
        return jnp.where((weights > 0)[:, None], weights[:, None] * rest, 0).sum(0)

    chunks = jax.tree.map(lambda z: z.reshape(-1, *z.shape[2:]), (points.x, points.weights))
    return lax.map(of_chunk, chunks).sum(0)


@eqx.filter_jit
def _losses(sums: Statistics, params: Parameters, model: Model) -> Float[Array, " k"]:
    """What each component's highest power is worth in expected log-likelihood, its responsibilities held."""
    mass = jnp.where(sums.mass > 0, sums.mass, 1)

    whitening = inverse_lower(params.tril)
    floor = jnp.einsum("kab,b,kcb->kac", whitening, model.floor[:-1], whitening)

    def half_log_det(used):
        scatter = residual_scatter(sums, params, Model(used, model.floor, model.covariance))
        return 0.5 * log_det(cholesky(scatter / mass[:, None, None] + floor))  # as the covariance is made of it

    lower = jnp.maximum(model.used - 1, 0)
    loss = mass * (half_log_det(lower) - half_log_det(model.used))
    return jnp.where((sums.mass > 0) & jnp.isfinite(loss), loss, jnp.inf)
