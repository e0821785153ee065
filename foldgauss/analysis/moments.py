"""Moments, entropy and mode of a Folded-Gaussian: in closed form where one exists, else by quadrature over time."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from foldgauss._numerics.batch import broadcast_leaves, concrete_value, expand_leaves, map_over_batch
from foldgauss._runtime.checks import invalid
from foldgauss.analysis.quadrature import find_peaks, normal_panels
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import FoldMoments

__all__ = ["Moments", "entropy", "mean_envelope", "mean_log_envelope", "mode", "moments"]

_LOG_2PI_E = float(np.log(2 * np.pi * np.e))
# The mode is not unique if the density elsewhere on the ridge is as high up to this relative difference.
_TIE = 1e-6


class Moments(NamedTuple):
    """Mean and covariance of x = (s, t), time last, and an estimate of their error.

    `error_estimate` (*batch,) is the largest error of E f(u), E[f(u) u / time_scale] and Cov f(u), relative to the root
    mean square of f, or to its square. For closed forms it is one rounding.
    """

    mean: Float[Array, "*batch d"]
    covariance: Float[Array, "*batch d d"]
    error_estimate: Float[Array, "*batch"]


def moments(dist) -> Moments:
    """The first two moments of a Folded-Gaussian: see `FoldedGaussian.moments`."""
    dist = broadcast_leaves(dist, dist.batch_shape)
    (mean_f, cov_f, cross), error = _fold_moments(dist)
    mean = jnp.concatenate([dist.loc + mean_f, dist.time_loc[..., None]], axis=-1)
    sigma = dist.scale_tril @ jnp.swapaxes(dist.scale_tril, -1, -2)
    space = mean_envelope(dist)[..., None, None] * sigma + cov_f
    last = jnp.concatenate([-cross, (dist.time_scale**2)[..., None]], axis=-1)
    upper = jnp.concatenate([space, -cross[..., :, None]], axis=-1)
    return Moments(mean, jnp.concatenate([upper, last[..., None, :]], axis=-2), error)


def entropy(dist) -> Float[Array, "*batch"]:
    """Differential entropy in nats, (*batch,): see `FoldedGaussian.entropy`."""
    dist = broadcast_leaves(dist, dist.batch_shape)
    dim = dist.loc.shape[-1]
    log_det = jnp.log(jnp.diagonal(dist.scale_tril, axis1=-2, axis2=-1)).sum(-1)
    gaussian = 0.5 * (dim + 1) * _LOG_2PI_E + jnp.log(dist.time_scale) + log_det
    return gaussian + 0.5 * dim * mean_log_envelope(dist)


def mean_envelope(dist) -> Float[Array, "*batch"]:
    """E[a(t)] in (0, 1]: 1, or floor + (1 - floor) / sqrt(1 + power), or by quadrature (eq:a_func_2d)."""
    envelope = dist.envelope
    if isinstance(envelope, Constant):
        return jnp.ones_like(dist.time_loc)
    if isinstance(envelope, TimeLikelihood):
        return envelope.floor + (1 - envelope.floor) / jnp.sqrt(1 + envelope.power)
    return _expected_envelope(dist)[0]


def mean_log_envelope(dist) -> Float[Array, "*batch"]:
    """E[log a(t)] <= 0: 0, or -power / 2 without a floor, or by quadrature."""
    envelope = dist.envelope
    if isinstance(envelope, Constant):
        return jnp.zeros_like(dist.time_loc)
    if not isinstance(envelope, TimeLikelihood):
        return _expected_envelope(dist)[1]
    floor = concrete_value(envelope.floor)
    if floor is not None and not floor.any():
        return -0.5 * envelope.power
    return jnp.where(envelope.floor == 0, -0.5 * envelope.power, _expected_envelope(dist)[1])


def mode(dist) -> Float[Array, "*batch d"]:
    """The maximum of the density, (*batch, d), time last, if it is unique: see `FoldedGaussian.mode`."""
    envelope, batch = dist.envelope, dist.batch_shape
    if isinstance(envelope, Constant):
        return _ridge(dist, dist.time_loc)
    if not isinstance(envelope, TimeLikelihood):
        return _ridge(dist, _highest_time(dist))
    filled = broadcast_leaves(dist, batch)
    envelope, dim = filled.envelope, dist.loc.shape[-1]
    # On the ridge the log density is about tau^2 (growth - 2) / 4 near tau = 0: the envelope narrows, the time decays.
    growth = envelope.power * dim * (1 - envelope.floor)
    unique = jnp.where(envelope.floor > 0, growth <= 2, growth < 2)
    _refuse_no_mode(unique, envelope, dim)
    return jnp.where(unique[..., None], _ridge(filled, filled.time_loc), jnp.nan)


def _fold_moments(dist) -> tuple[FoldMoments, Array]:
    """The moments of f(u) for u ~ N(0, time_scale^2), and their error relative to the root mean square of f."""
    closed = dist.fold.closed_moments(dist.time_scale)
    if closed is not None:
        return closed, jnp.full_like(dist.time_loc, jnp.finfo(dist.time_loc.dtype).eps)
    return map_over_batch(_integrate_fold, dist)


def _integrate_fold(dist):
    """`_fold_moments` of one distribution by adaptive quadrature."""
    frozen = lax.stop_gradient(dist)
    breaks = (frozen.fold.breakpoints() / frozen.time_scale).astype(dist.time_loc.dtype)
    panels = normal_panels(lambda tau: frozen.fold(frozen.time_scale * tau), breaks)
    shift = dist.fold(dist.time_scale * panels.nodes)
    mean = panels.expectation(shift)
    centered = shift - mean[None, None]
    products, tilted = centered[..., :, None] * centered[..., None, :], shift * panels.nodes[..., None]
    found = FoldMoments(mean, panels.expectation(products), panels.expectation(tilted) * dist.time_scale)
    square = panels.expectation(jnp.square(shift).sum(-1))
    square = jnp.where(square > 0, square, 1)
    errors = [panels.expectation_error(values).max() for values in (shift, tilted)]
    error = jnp.maximum(jnp.stack(errors).max() / jnp.sqrt(square), panels.expectation_error(products).max() / square)
    return found, lax.stop_gradient(error)


def _expected_envelope(dist) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """E[a(t)] and E[log a(t)] by adaptive quadrature."""
    return map_over_batch(_integrate_envelope, dist)


def _integrate_envelope(dist):
    """`_expected_envelope` of one distribution."""
    log_a = lambda dist, tau: _log_envelope(dist, tau.ravel()).reshape(tau.shape)  # noqa: E731
    frozen = lax.stop_gradient(dist)
    panels = normal_panels(lambda tau: log_a(frozen, tau)[..., None], jnp.zeros(0, dist.time_loc.dtype))
    values = log_a(dist, panels.nodes)
    return panels.expectation(jnp.exp(values)), panels.expectation(values)


def _log_envelope(dist, tau: Float[Array, " tau"]) -> Float[Array, " tau *batch"]:
    dist = broadcast_leaves(dist, dist.batch_shape)
    rank = dist.time_loc.ndim + 1
    tau = tau.reshape(-1, *(1,) * (rank - 1))
    if isinstance(dist.envelope, TimeLikelihood):  # depends on tau only, which t = time_loc + ... may round
        zero, one = jnp.zeros_like(dist.time_loc)[None], jnp.ones_like(dist.time_scale)[None]
        return expand_leaves(dist.envelope, rank).log_a(tau, time_loc=zero, time_scale=one)
    t = dist.time_loc[None] + dist.time_scale[None] * tau
    envelope = expand_leaves(dist.envelope, rank)
    return envelope.log_a(t, time_loc=dist.time_loc[None], time_scale=dist.time_scale[None])


def _ridge(dist, t) -> Float[Array, "*batch d"]:
    at = dist.condition_time(t)
    return jnp.concatenate([at.loc, jnp.broadcast_to(t, at.loc.shape[:-1])[..., None]], axis=-1)


def _refuse_no_mode(unique, envelope, dim: int) -> None:
    """Raise if concrete values show that the mode is not unique."""
    unique, power, floor = (concrete_value(x) for x in (unique, envelope.power, envelope.floor))
    if unique is None or unique.all():
        return
    power, floor = np.broadcast_arrays(power, floor)
    power, floor = power[~unique][0], floor[~unique][0]
    expected, excess = "a unique mode: power (d-1) < 2", f"power (d-1) = {power * dim:g}"
    if floor > 0:
        got = f"{excess} with floor {floor:g}: two modes, on the ridge before and after time_loc"
    elif power * dim == 2:
        got = f"{excess}: every point of the ridge s = loc + f(u) is a mode"
    else:
        got = f"{excess}: the density is unbounded along the ridge s = loc + f(u)"
    raise invalid("mode", expected=expected, got=got, cure="Use a smaller power, or mean.")


def _highest_time(dist) -> Float[Array, "*batch"]:
    """The time of the highest point of the ridge for any envelope, searched for in tau from -40 to 40."""
    tau, tied = map_over_batch(_highest_tau, dist)
    refused = concrete_value(tied)
    if refused is not None and refused.any():
        got = "an envelope whose ridge is as high, or higher, elsewhere"
        raise invalid("mode", expected="a unique mode", got=got, cure="Use mean.")
    return dist.time_loc + dist.time_scale * jnp.where(tied, jnp.nan, tau)


def _highest_tau(dist):
    """tau of the highest point of the ridge, and whether another is as high; one distribution, not a batch."""
    grid, dim = jnp.asarray(np.linspace(-40, 40, 3201), dist.loc.dtype), dist.loc.shape[-1]

    def log_ridge(tau):
        return -0.5 * tau**2 - 0.5 * dim * _log_envelope(dist, tau)

    best = find_peaks(log_ridge, grid, 2)
    heights = jnp.where(jnp.isnan(best), -jnp.inf, log_ridge(jnp.where(jnp.isnan(best), 0, best)))
    ends = log_ridge(grid[:: grid.size - 1]).max()
    return best[0], jnp.maximum(heights[1], ends) > heights[0] - _TIE
