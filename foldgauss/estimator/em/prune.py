"""Removal of components and powers that do not lower an information criterion, one after another.

Arrays keep their shapes (a removed component has weight 0), so that one compiled program serves the whole search.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._numerics.regression import hermite_to_powers
from foldgauss._numerics.triangular import cholesky, inverse_lower, log_det
from foldgauss.envelope import AbstractEnvelope
from foldgauss.estimator.em.components import Parameters, evaluate_densities, to_powers
from foldgauss.estimator.em.loop import log_likelihood, run_em, select_best
from foldgauss.estimator.em.m_step import Model, residual_scatter
from foldgauss.estimator.em.statistics import (
    Blocks,
    Points,
    SufficientStatistics,
    accumulate,
    sum_chunks,
    sum_over_points,
)

#: Components whose removal is tried before the search stops.
_TRIALS = 3


class _Candidate(NamedTuple):
    params: Parameters
    model: Model
    score: float


def count_parameters(weights: np.ndarray, degrees: np.ndarray, dim: int, covariance: str) -> int:
    """Free parameters of the components of positive weight: curves, times, covariances, and weights less one."""
    alive = np.asarray(weights) > 0
    num = int(alive.sum())
    of_sigma = {"full": dim * (dim + 1) // 2, "tied": dim * (dim + 1) // 2, "diag": dim, "spherical": 1}[covariance]
    of_sigma = of_sigma if covariance == "tied" else num * of_sigma
    return int(dim * (np.asarray(degrees)[alive] + 1).sum()) + 2 * num + of_sigma + num - 1


def prune_mixture(
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
    """Remove components and powers as long as -2 log-likelihood + penalty * parameters decreases."""
    dim = params.tril.shape[-1]

    def score(params, model) -> _Candidate:
        weights = np.exp(np.asarray(params.log_weights))
        free = count_parameters(weights, model.degrees, dim, model.covariance)
        value = float(log_likelihood(params, points, envelope))
        return _Candidate(params, model, -2 * value + penalty * free if np.isfinite(value) else np.inf)

    def refit(params, model) -> _Candidate:
        starts = jax.tree.map(lambda z: z[None], params)
        runs = run_em(starts, points, envelope, model, total=total, tol=tol, max_steps=max_steps)
        return score(select_best(runs).params, model)

    best, changed = score(params, model), True
    while changed:
        changed = False
        # Powers first: superfluous powers would make a component look more expensive than it is.
        while powers and (less := _lower_degrees(best, points, envelope, refit, penalty)) is not None:
            best, changed = less, True
        while components and (less := _remove_component(best, points, envelope, refit, total)) is not None:
            best, changed = less, True
    return best.params, best.model


def drop_unused(params: Parameters, model: Model) -> tuple[Parameters, Model]:
    """Only the components of positive weight, and no more powers than they use."""
    alive = np.flatnonzero(np.asarray(params.log_weights) > -np.inf)
    degrees = np.asarray(model.degrees)[alive]
    log_weights, time_loc, time_scale, curve, tril = (jnp.asarray(np.asarray(z)[alive]) for z in params)
    params = Parameters(log_weights, time_loc, time_scale, curve[:, : int(degrees.max()) + 1], tril)
    return params, Model(jnp.asarray(degrees), model.floor, model.covariance)


def _remove_component(candidate: _Candidate, points, envelope, refit, total: float) -> _Candidate | None:
    """Remove one component if that lowers the score; first those whose points the others explain best."""
    log_weights = np.asarray(candidate.params.log_weights, np.float64)
    alive = np.flatnonzero(log_weights > -np.inf)
    if len(alive) < 2:
        return None
    without = np.asarray(sum_over_points(_log_likelihoods_without, points, candidate.params, envelope), np.float64)
    weights = np.exp(log_weights[alive])
    value = without[alive] - total * np.log1p(-np.minimum(weights, 1 - 1e-12))
    for k in alive[np.argsort(-value)[:_TRIALS]]:
        rest = log_weights.copy()
        rest[k] = -np.inf
        rest -= np.logaddexp.reduce(rest)
        trial = candidate.params._replace(log_weights=jnp.asarray(rest, candidate.params.log_weights.dtype))
        less = refit(trial, candidate.model)
        if less.score < candidate.score:
            return less
    return None


def _lower_degrees(candidate: _Candidate, points, envelope, refit, penalty: float) -> _Candidate | None:
    """Remove a power in every component where that should lower the score; if all together do not, in the first."""
    sums = sum_over_points(accumulate, points, candidate.params, envelope)
    losses = np.asarray(_degree_losses(sums, candidate.params, candidate.model), np.float64)
    degrees, dim = np.asarray(candidate.model.degrees), candidate.params.tril.shape[-1]
    superfluous = (2 * losses < penalty * dim) & (degrees > 0) & (np.asarray(candidate.params.log_weights) > -np.inf)
    first = np.arange(len(degrees)) == np.argmin(np.where(superfluous, losses, np.inf))
    for which in (superfluous, superfluous & first):
        if which.any() and (less := _refit_with_degrees(candidate, degrees - which, refit)).score < candidate.score:
            return less
    return None


def _refit_with_degrees(candidate: _Candidate, degrees: np.ndarray, refit) -> _Candidate:
    """Refit without the highest Hermite polynomials, which are nearly orthogonal to the others."""
    matrix = hermite_to_powers(candidate.params.degree)
    hermite = np.linalg.solve(matrix, np.asarray(candidate.params.curve, np.float64))
    hermite = np.where(np.arange(len(matrix))[None, :, None] <= degrees[:, None, None], hermite, 0)
    curve = to_powers(jnp.asarray(hermite, candidate.params.curve.dtype))
    model = Model(jnp.asarray(degrees, jnp.int32), candidate.model.floor, candidate.model.covariance)
    return refit(candidate.params._replace(curve=curve), model)


def _log_likelihoods_without(params: Parameters, envelope, points: Points) -> Float[Array, " k"]:
    """The log-likelihood without each component, up to normalizing the remaining weights."""

    def of_chunk(chunk):
        x, weights = chunk
        log_density = evaluate_densities(params, envelope, x).log_density
        total = jax.nn.logsumexp(log_density, axis=-1, keepdims=True)
        eps = jnp.finfo(total.dtype).eps
        rest = total + jnp.log(jnp.maximum(-jnp.expm1(jnp.minimum(log_density - total, 0)), eps))
        return jnp.where((weights > 0)[:, None], weights[:, None] * rest, 0).sum(0)

    return sum_chunks(of_chunk, (points.x, points.weights))


@eqx.filter_jit
def _degree_losses(sums: SufficientStatistics, params: Parameters, model: Model) -> Float[Array, " k"]:
    """The loss in expected log-likelihood without each component's highest power, for fixed responsibilities."""
    mass = jnp.where(sums.mass > 0, sums.mass, 1)

    whitening = inverse_lower(params.tril)
    floor = jnp.einsum("kab,b,kcb->kac", whitening, model.floor[:-1], whitening)

    def half_log_det(degrees):
        scatter = residual_scatter(sums, params, Model(degrees, model.floor, model.covariance))
        return 0.5 * log_det(cholesky(scatter / mass[:, None, None] + floor))  # as `_update_factor`

    lower = jnp.maximum(model.degrees - 1, 0)
    loss = mass * (half_log_det(lower) - half_log_det(model.degrees))
    return jnp.where((sums.mass > 0) & jnp.isfinite(loss), loss, jnp.inf)
