"""Moments, entropy and mode of a Folded-Gaussian: in closed form where one exists, else by quadrature over time."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._numerics.batch import broadcast_leaves, compile_eager, concrete_value, expand_leaves, map_over_batch
from foldgauss._runtime.checks import invalid
from foldgauss.analysis.quadrature import find_peaks, gauss_hermite, normal_rule
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import PolynomialFold, ZeroFold

__all__ = ["entropy", "mean_envelope", "mean_log_envelope", "mode", "moments"]

_LOG_2PI_E = float(np.log(2 * np.pi * np.e))
# The mode is not unique if the density elsewhere on the ridge is as high up to this relative difference.
_TIE = 1e-6


@compile_eager(static=("order",))
def moments(dist, order: int) -> tuple[Float[Array, "*batch d"], Float[Array, "*batch d d"]]:
    """Mean (*batch, d) and covariance (*batch, d, d) of x = (s, t), time last: see `FoldedGaussian.moments`."""
    dist = broadcast_leaves(dist, dist.batch_shape)
    mean_f, cov_f, cross = _fold_moments(dist, order)
    mean = jnp.concatenate([dist.loc + mean_f, dist.time_loc[..., None]], axis=-1)
    sigma = dist.scale_tril @ jnp.swapaxes(dist.scale_tril, -1, -2)
    space = mean_envelope(dist)[..., None, None] * sigma + cov_f
    last = jnp.concatenate([-cross, (dist.time_scale**2)[..., None]], axis=-1)
    upper = jnp.concatenate([space, -cross[..., :, None]], axis=-1)
    return mean, jnp.concatenate([upper, last[..., None, :]], axis=-2)


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
    return _expected_envelope(dist, jnp.exp)


def mean_log_envelope(dist) -> Float[Array, "*batch"]:
    """E[log a(t)] <= 0: 0, or -power / 2 without a floor, or by quadrature."""
    envelope = dist.envelope
    if isinstance(envelope, Constant):
        return jnp.zeros_like(dist.time_loc)
    if not isinstance(envelope, TimeLikelihood):
        return _expected_envelope(dist, lambda log_a: log_a)
    floor = concrete_value(envelope.floor)
    if floor is not None and not floor.any():
        return -0.5 * envelope.power
    floored = _expected_envelope(dist, lambda log_a: log_a)
    return jnp.where(envelope.floor == 0, -0.5 * envelope.power, floored)


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


def _fold_moments(dist, order: int):
    """E f(u), Cov f(u), E[f(u) u] for u ~ N(0, time_scale^2)."""
    if isinstance(dist.fold, ZeroFold):
        zero = jnp.zeros_like(dist.loc)
        return zero, jnp.zeros_like(dist.scale_tril), zero
    if isinstance(dist.fold, PolynomialFold):
        return _polynomial_moments(dist.fold.coefficients, dist.time_scale)
    z, weights = (jnp.asarray(x, dist.loc.dtype) for x in gauss_hermite(order))
    z = z.reshape(-1, *(1,) * dist.time_scale.ndim)
    values = expand_leaves(dist.fold, dist.time_scale.ndim + 1)(z * dist.time_scale[None])
    mean = jnp.tensordot(weights, values, axes=1)
    centered = values - mean[None]
    covariance = jnp.tensordot(weights, centered[..., :, None] * centered[..., None, :], axes=1)
    cross = jnp.tensordot(weights, values * z[..., None], axes=1) * dist.time_scale[..., None]
    return mean, covariance, cross


def _polynomial_moments(coefficients: Float[Array, "*batch degree dim"], scale: Float[Array, "*batch"]):
    """Exact, by E z^k = (k - 1)!! for even k, with the powers of the scale put into the coefficients."""
    degree, dtype = coefficients.shape[-2], coefficients.dtype
    normal = np.array([_normal_moment(k) for k in range(2 * degree + 2)])
    k = np.arange(1, degree + 1)
    covariances = normal[k[:, None] + k] - np.outer(normal[k], normal[k])
    powers = scale[..., None] ** jnp.asarray(k, dtype).reshape((1,) * scale.ndim + (degree,))
    scaled = coefficients * powers[..., None]
    mean = jnp.einsum("k,...ki->...i", jnp.asarray(normal[k], dtype), scaled)
    covariance = jnp.einsum("...ki,kl,...lj->...ij", scaled, jnp.asarray(covariances, dtype), scaled)
    cross = jnp.einsum("k,...ki->...i", jnp.asarray(normal[k + 1], dtype), scaled) * scale[..., None]
    return mean, covariance, cross


def _normal_moment(k: int) -> float:
    return 0.0 if k % 2 else float(np.prod(np.arange(k - 1, 0, -2, dtype=float)))


def _expected_envelope(dist, function) -> Float[Array, "*batch"]:
    """E function(log a(t))."""
    z, weights = (jnp.asarray(x, dist.loc.dtype) for x in normal_rule())
    return jnp.tensordot(weights, function(_log_envelope(dist, z)), axes=1)


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
