"""Moments, entropy and mode of a Folded-Gaussian: in closed form where one exists, else by quadrature over time."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from foldgauss._numerics.batch import broadcast_leaves, compile_eager, concrete_value, map_over_batch, vectorized
from foldgauss._runtime.checks import invalid, require
from foldgauss.analysis.quadrature import find_peaks, gauss_hermite, normal_panels, warn_of_error
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import FourierFold, PolynomialFold, ZeroFold, evaluate_shift

__all__ = ["entropy", "mean_log_envelope", "mode", "moments"]

_LOG_2PI_E = float(np.log(2 * np.pi * np.e))
# The mode is not unique if the density elsewhere on the ridge is as high up to this relative difference.
_TIE = 1e-6


def moments(dist, *, with_error: bool = False) -> tuple[Array, ...]:
    """Mean (*batch, d) and covariance (*batch, d, d) of x = (s, t), time last: see `FoldedGaussian.moments`."""
    fold, envelope = dist.fold, dist.envelope
    if not isinstance(fold, ZeroFold | PolynomialFold | FourierFold):
        fold = map_over_batch(_integrated_fold, fold, (dist.time_scale, 0))
    if not isinstance(envelope, Constant | TimeLikelihood):
        envelope = _integrate_envelope(dist)[0]
    mean, covariance, error = _moments(dist.loc, dist.scale_tril, dist.time_loc, dist.time_scale, fold, envelope)
    warn_of_error("moments", error)
    return (mean, covariance, error) if with_error else (mean, covariance)


@compile_eager
def _moments(loc, scale_tril, time_loc, time_scale, fold, envelope) -> tuple[Array, Array, Array]:
    """Return the moments and their error. `fold` and `envelope` have closed forms, or are tuples of integrals."""
    mean_f, cov_f, cross, error_f = fold if isinstance(fold, tuple) else _fold_moments(fold, time_scale)
    mean_a, error_a = envelope if isinstance(envelope, tuple) else (_mean_envelope(envelope, time_loc), 0)
    mean = jnp.concatenate([loc + mean_f, time_loc[..., None]], axis=-1)
    sigma = scale_tril @ jnp.swapaxes(scale_tril, -1, -2)
    space = mean_a[..., None, None] * sigma + cov_f
    last = jnp.concatenate([-cross, (time_scale**2)[..., None]], axis=-1)
    upper = jnp.concatenate([space, -cross[..., :, None]], axis=-1)
    covariance = jnp.concatenate([upper, last[..., None, :]], axis=-2)
    return mean, covariance, lax.stop_gradient(jnp.maximum(error_f, error_a))


def entropy(dist, *, with_error: bool = False) -> Array | tuple[Array, Array]:
    """Differential entropy in nats, (*batch,): see `FoldedGaussian.entropy`."""
    value, error, relative = _entropy(dist.scale_tril, dist.time_scale, mean_log_envelope(dist))
    warn_of_error("entropy", relative)
    return (value, error) if with_error else value


@compile_eager
def _entropy(scale_tril, time_scale, mean_log) -> tuple[Array, Array, Array]:
    """Return the entropy, its estimated error, and the estimated error of E[log a] relative to max(1, |E[log a]|)."""
    dim, (mean_log_a, error) = scale_tril.shape[-1], mean_log
    log_det = jnp.log(jnp.diagonal(scale_tril, axis1=-2, axis2=-1)).sum(-1)
    gaussian = 0.5 * (dim + 1) * _LOG_2PI_E + jnp.log(time_scale) + log_det
    return gaussian + 0.5 * dim * mean_log_a, 0.5 * dim * error, error / jnp.maximum(1, jnp.abs(mean_log_a))


def mean_log_envelope(dist) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """E[log a(t)] <= 0, and its estimated error: exact, 0 or -power / 2, but for floors and other envelopes."""
    envelope, zero = dist.envelope, jnp.zeros_like(dist.time_loc)
    if isinstance(envelope, Constant):
        return zero, zero
    if not isinstance(envelope, TimeLikelihood):
        return _integrate_envelope(dist)[1]
    plain, floor = (-0.5 * envelope.power, zero), concrete_value(envelope.floor)
    if floor is not None and not floor.any():
        return plain
    floored = _integrate_envelope(dist)[1]
    return tuple(jnp.where(envelope.floor == 0, a, b) for a, b in zip(plain, floored, strict=True))


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


def _mean_envelope(envelope, time_loc: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """E[a(t)]: 1, or floor + (1 - floor) / sqrt(1 + power) (eq:a_func_2d)."""
    if isinstance(envelope, Constant):
        return jnp.ones_like(time_loc)
    return envelope.floor + (1 - envelope.floor) / jnp.sqrt(1 + envelope.power)


def _integrate_envelope(dist):
    """(E[a(t)], its estimated error) and (E[log a(t)], its estimated error); one program for all folds."""
    return map_over_batch(_integrated_envelope, dist.envelope, (dist.time_loc, 0), (dist.time_scale, 0))


def _integrated_envelope(*parts):
    """As `_integrate_envelope`, of one envelope with its `time_loc` and `time_scale`, by quadrature."""

    def values(parts, tau):
        log_a = _log_envelope(*parts, tau)
        return jnp.stack([jnp.exp(log_a), log_a], -1)

    frozen, dtype = lax.stop_gradient(parts), parts[1].dtype
    panels = normal_panels(lambda tau: values(frozen, tau), jnp.zeros(0, dtype), dtype)
    found = panels.expectation(values(parts, panels.nodes))
    unit = lax.stop_gradient(jnp.stack([jnp.ones_like(found[1]), jnp.maximum(1, jnp.abs(found[1]))]))
    error = unit * panels.expectation_error(values(frozen, panels.nodes) / unit[None, None])
    return (found[0], error[0]), (found[1], error[1])


def _log_envelope(envelope, time_loc, time_scale, tau: Float[Array, "*tau"]) -> Float[Array, "*tau"]:
    """log a at standardized times; one envelope, not a batch."""
    if isinstance(envelope, TimeLikelihood):  # depends on tau only, which t = time_loc + ... may round
        return envelope.log_a(tau, time_loc=jnp.zeros_like(time_loc), time_scale=jnp.ones_like(time_loc))
    return envelope.log_a(time_loc + time_scale * tau, time_loc=time_loc, time_scale=time_scale)


@vectorized(0)
def _fold_moments(fold, scale):
    """E f(u), Cov f(u), E[f(u) u] for u ~ N(0, time_scale^2), and no error: of one fold that has closed forms."""
    if isinstance(fold, FourierFold):
        return *_fourier_moments(fold, scale), 0 * scale
    # Gauss-Hermite quadrature is exact for polynomials, here those of up to twice the degree.
    z, weights = (jnp.asarray(x, scale.dtype) for x in gauss_hermite(getattr(fold, "degree", 0) + 1))
    y = jax.vmap(lambda u: evaluate_shift(fold, u))(scale * z)
    mean = weights @ y
    centered = y - mean[None]
    return mean, (weights[:, None] * centered).T @ centered, scale * ((weights * z) @ y), 0 * scale


def _fourier_moments(fold: FourierFold, scale: Float[Array, ""]):
    """Exact, by E e^(iaz) = e^(-a^2/2), with Cov(sin az, sin bz) and Cov(cos az, cos bz) without cancellation."""
    a = 2 * jnp.pi * (scale / fold.period) * jnp.arange(1, fold.order + 1, dtype=scale.dtype)
    product, near = a[:, None] * a[None], 0.5 * jnp.exp(-0.5 * (a[:, None] - a[None]) ** 2)
    sines, cosines = -near * jnp.expm1(-2 * product), near * jnp.expm1(-product) ** 2
    covariance = fold.sine.T @ sines @ fold.sine + fold.cosine.T @ cosines @ fold.cosine
    return jnp.expm1(-0.5 * a**2) @ fold.cosine, covariance, scale * ((a * jnp.exp(-0.5 * a**2)) @ fold.sine)


def _integrated_fold(fold, scale):
    """As `_fold_moments`, of one fold of any kind, by quadrature, with the estimated error in standard deviations."""

    def values(z):
        return jax.vmap(fold)((z * scale).ravel()).reshape(*z.shape, -1)

    edges = fold.breaks.astype(scale.dtype) / scale
    panels = normal_panels(lambda z: lax.stop_gradient(values(z)), edges, scale.dtype)
    y = values(panels.nodes)
    mean = panels.expectation(y)
    unit = lax.stop_gradient(jnp.sqrt(panels.expectation((y - mean[None, None]) ** 2)))
    unit = jnp.where(unit > 0, unit, 1)
    y = (y - mean[None, None]) / unit[None, None]  # whose squares do not overflow
    products = y[..., :, None] * jnp.concatenate([y, panels.nodes[..., None]], -1)[..., None, :]
    found, error = panels.expectation(products), panels.expectation_error(products).max()
    error = jnp.maximum(error, panels.expectation_error(y).max())
    return mean, found[:, :-1] * unit[:, None] * unit[None], found[:, -1] * unit * scale, error


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
    require(
        refused is None or not refused.any(),
        "mode",
        expected="a unique mode",
        got="an envelope whose ridge is as high, or higher, elsewhere",
        cure="Use mean.",
    )
    return dist.time_loc + dist.time_scale * jnp.where(tied, jnp.nan, tau)


def _highest_tau(dist):
    """tau of the highest point of the ridge, and whether another is as high; one distribution, not a batch."""
    grid, dim = jnp.asarray(np.linspace(-40, 40, 3201), dist.loc.dtype), dist.loc.shape[-1]

    def log_ridge(tau):
        return -0.5 * tau**2 - 0.5 * dim * _log_envelope(dist.envelope, dist.time_loc, dist.time_scale, tau)

    best = find_peaks(log_ridge, grid, 2)
    heights = jnp.where(jnp.isnan(best), -jnp.inf, log_ridge(jnp.where(jnp.isnan(best), 0, best)))
    ends = log_ridge(grid[:: grid.size - 1]).max()
    return best[0], jnp.maximum(heights[1], ends) > heights[0] - _TIE
