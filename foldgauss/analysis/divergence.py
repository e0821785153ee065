"""The Kullback-Leibler divergence between Folded-Gaussians, and between Gaussians."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from foldgauss._numerics.batch import broadcast_leaves, compile_eager, concrete_value, map_over_batch
from foldgauss._numerics.triangular import log_det
from foldgauss._runtime.checks import require
from foldgauss.analysis.moments import mean_log_envelope
from foldgauss.analysis.quadrature import (
    HALF_LOG_2PI,
    SEARCH_GRID,
    adaptive_panels,
    diverges,
    find_peaks,
    gauss_hermite,
    normal_panels,
    warn_of_error,
)
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import PolynomialFold, ZeroFold
from foldgauss.gaussian import Gaussian, times_exp

__all__ = ["kl_divergence"]

# Centers closer than this many roundings of their own size are one curve, written in two ways.
_SAME_CURVE = 64
_PEAKS = 8


def kl_divergence(p, q, *, with_error: bool = False) -> Array | tuple[Array, Array]:
    """KL(p, q) = E_p[log p(x) - log q(x)], +inf where the integral diverges.

        KL = KL(t) + E[KL(p(s | t), q(s | t))],
        2 E[KL(s | t)] = |L_q^-1 L_p|^2 E[a_p / a_q] - (d-1) + log det Sigma_q / Sigma_p + (d-1) E[log a_q / a_p]
                         + E[|L_q^-1 (center_p - center_q)|^2 / a_q]

    Exact for constant and time-likelihood envelopes where that of q has no floor: 1 / a_q only tilts the Gaussian of
    t. Then E[a_p / a_q] is finite iff `(1 + power_p) scale_q^2 > power_q scale_p^2` and, if the centers differ, the
    last term iff `scale_q^2 > power_q scale_p^2` (time scales). Else (a floor in q, other envelopes; the last term of
    folds that are no polynomials) by adaptive quadrature over t, to about 1e-10 in float64. `with_error` appends the
    estimated error. A RuntimeWarning is raised if it exceeds 5e-7 of max(1, KL), 1.7e-3 in float32, unless traced.

    **Shapes:** batches broadcast -> (*batch,). **Example:** `kl_divergence(dist, dist)  # 0.`

    **Source:** the chain rule of eq:foldgauss. **Raises:** ValueError unless both are FoldedGaussian or both Gaussian,
    of one dimension.
    """
    _check_pair(p, q)
    batch = jnp.broadcast_shapes(p.batch_shape, q.batch_shape)
    p, q = broadcast_leaves(p, batch), broadcast_leaves(q, batch)
    if isinstance(p, Gaussian):
        value, error = _kl_gaussian(p, q), 0
    else:
        p, q = _from_time_zero(p, q)
        value, error = _chain_rule(p, q, *_expectations(p, q))
    error = lax.stop_gradient(jnp.broadcast_to(jnp.asarray(error, value.dtype), value.shape))
    warn_of_error("kl_divergence", jnp.where(jnp.isinf(value), 0, error / jnp.maximum(1, jnp.abs(value))))
    return (value, error) if with_error else value


@compile_eager
def _chain_rule(p, q, found, errors):
    """Return the divergence and its estimated error. `found` are expectations over time, with `errors`."""
    dim, (ratio, mahalanobis, log_ratio) = p.loc.shape[-1], found
    trace, log_det = _trace_and_log_det(p.scale_tril, q.scale_tril)
    space = 0.5 * (trace * ratio - dim + log_det + dim * log_ratio + mahalanobis)
    error = 0.5 * (trace * errors[0] + errors[1] + dim * errors[2])
    return _kl_gaussian(p.marginal([-1]), q.marginal([-1])) + space, error


def _check_pair(p, q) -> None:
    # A `FoldedGaussian`, which is built upon this module's package, has an envelope.
    same = all(isinstance(x, Gaussian) for x in (p, q)) or all(hasattr(x, "envelope") for x in (p, q))
    require(
        same and p.event_shape == q.event_shape,
        "p, q",
        expected="two distributions of one class and dimension",
        got=" and ".join(f"{type(x).__name__} of {getattr(x, 'event_shape', 'no')} coordinates" for x in (p, q)),
        cure="Across classes, estimate it: the mean of p.log_prob - q.log_prob over samples of p.",
    )


def _from_time_zero(p, q):
    """Both with time counted from that of p, so that no offset rounds it; unless an envelope knows more of t."""
    if not all(isinstance(x.envelope, Constant | TimeLikelihood) for x in (p, q)):
        return p, q
    moved = lambda x: eqx.tree_at(lambda dist: dist.time_loc, x, x.time_loc - p.time_loc)  # noqa: E731
    return moved(p), moved(q)


def _kl_gaussian(p: Gaussian, q: Gaussian):
    dim, log_ratio = p.loc.shape[-1], q.log_scale - p.log_scale
    trace, log_det = _trace_and_log_det(p.base_tril, q.base_tril)
    whitened = times_exp(_solve(q.base_tril, (p.loc - q.loc)[..., None]), -q.log_scale[..., None, None])
    return 0.5 * (trace * jnp.exp(-2 * log_ratio) - dim + log_det + (whitened**2).sum((-2, -1))) + dim * log_ratio


def _trace_and_log_det(tril_p, tril_q):
    """|L_q^-1 L_p|^2, the trace of Sigma_q^-1 Sigma_p, and log det Sigma_q - log det Sigma_p."""
    return (_solve(tril_q, tril_p) ** 2).sum((-2, -1)), log_det(tril_q) - log_det(tril_p)


def _solve(tril, b):
    return lax.linalg.triangular_solve(tril, b, left_side=True, lower=True)


def _expectations(p, q):
    """E[a_p / a_q], E[|center difference|^2 / a_q], E[log a_q / a_p] under t of p; and their estimated errors."""
    own, other = _time_likelihood(p), _time_likelihood(q)
    if own is None or other is None:
        return map_over_batch(_integrals, p, q)
    floor = concrete_value(other[1])
    if floor is not None and not floor.any():
        return _exact(p, q, own, other[0])
    if floor is not None and floor.all():
        return map_over_batch(_integrals, p, q)
    choose = lambda a, b: jnp.where(other[1] == 0, a, b)  # noqa: E731
    return jax.tree.map(choose, _exact(p, q, own, other[0]), map_over_batch(_integrals, p, q))


def _time_likelihood(dist):
    """(power, floor) of an envelope that has them, else None."""
    envelope, zero = dist.envelope, jnp.zeros_like(dist.time_loc)
    if isinstance(envelope, Constant):
        return zero, zero
    return (envelope.power, envelope.floor) if isinstance(envelope, TimeLikelihood) else None


def _exact(p, q, own, power_q):
    """Gaussian integrals: 1 / a_q is the exponential of a square, so it tilts the normal of t into another."""
    plain = _tilted(p, q, jnp.ones_like(power_q), power_q)
    return _exact_expectations(p, q, own, power_q, plain, _mean_square_distance(p, q, *plain[1:]), mean_log_envelope(p))


@compile_eager
def _exact_expectations(p, q, own, power_q, plain, distance, log_p):
    power_p, floor_p = own
    peaked = _tilted(p, q, 1 + power_p, power_q)
    # a_p = floor + (1 - floor) exp(..): without a floor its first term must not count, not even if infinite.
    ratio = (1 - floor_p) * peaked[0] + jnp.where(floor_p > 0, floor_p * plain[0], 0)
    mass, (distance, error), (mean_log_p, error_log) = plain[0], distance, log_p
    finite = jnp.isfinite(mass)
    # Centers that are the same count as such, even if the mass is infinite.
    mahalanobis, error = (jnp.where(finite, jnp.where(finite, mass, 1) * x, jnp.inf) for x in (distance, error))
    mahalanobis, error = (jnp.where(distance == 0, 0, x) for x in (mahalanobis, error))
    offset = (p.time_loc - q.time_loc) / q.time_scale
    mean_log_q = -0.5 * power_q * ((p.time_scale / q.time_scale) ** 2 + offset**2)
    return (ratio, mahalanobis, mean_log_q - mean_log_p), (jnp.zeros_like(ratio), error, error_log)


def _mean_square_distance(p, q, mean, scale):
    """E |L_q^-1 (center_p - center_q)|^2 under t ~ N(mean, scale^2), 0 if only rounding, and its estimated error."""
    if not all(isinstance(x.fold, ZeroFold | PolynomialFold) for x in (p, q)):
        return map_over_batch(_integrated_distance, p, q, (mean, 0), (scale, 0))
    return _polynomial_distance(p, q, mean, scale)


@compile_eager
def _polynomial_distance(p, q, mean, scale):
    """As `_mean_square_distance`, exact."""
    degree = max(x.fold.degree if isinstance(x.fold, PolynomialFold) else 0 for x in (p, q))
    z, weights = (jnp.asarray(x, mean.dtype).reshape(-1, *(1,) * mean.ndim) for x in gauss_hermite(degree + 2))
    log_square, same = _center_distance(p, q, mean[None] + scale[None] * z)
    distance = (weights * jnp.exp(log_square)).sum(0)
    return jnp.where(same.all(0), 0, distance), jnp.zeros_like(distance)


def _integrated_distance(p, q, mean, scale):
    """As `_mean_square_distance`, by quadrature; one pair, not a batch."""

    def log_term(p, q, mean, scale):
        def log_f(z):
            log_square, _ = _center_distance(p, q, (mean + scale * z).ravel())
            return log_square.reshape(z.shape) - 0.5 * z**2 - HALF_LOG_2PI

        return log_f

    frozen = lax.stop_gradient((p, q, mean, scale))
    return _integral(log_term(p, q, mean, scale), log_term(*frozen), (_break_times(p, q) - mean) / scale)


def _break_times(p, q) -> Float[Array, " breaks"]:
    """Times at which a fold is not smooth; one pair, not a batch."""
    return jnp.concatenate([x.time_loc - x.fold.breaks.astype(x.time_loc.dtype) for x in (p, q)])


@compile_eager
def _tilted(p, q, sharpness, power_q):
    """Mass, mean and scale of N(t; p) exp(-(sharpness - 1) tau_p^2 / 2 + power_q tau_q^2 / 2); +inf mass if none."""
    # In units of p's time_scale, whose square may not fit the dtype.
    a, b = sharpness, power_q * (p.time_scale / q.time_scale) ** 2
    finite = a > b
    rest = jnp.where(finite, a - b, 1)
    offset = (p.time_loc - q.time_loc) / p.time_scale
    mass = jnp.exp(0.5 * a * b * offset**2 / rest) / jnp.sqrt(rest)
    mean = p.time_loc + p.time_scale * jnp.where(finite, b * offset / rest, 0)
    return jnp.where(finite, mass, jnp.inf), mean, p.time_scale / jnp.sqrt(rest)


def _center_distance(p, q, t):
    """log |L_q^-1 (center_p - center_q)|^2 at t (one axis in front of the batch), and whether it is only rounding."""
    here, there = (x.condition_time(t).loc for x in (p, q))
    difference = here - there
    size = jnp.abs(here) + jnp.abs(there) + jnp.abs(p.loc)[None] + jnp.abs(q.loc)[None]
    same = (jnp.abs(difference) <= _SAME_CURVE * jnp.finfo(size.dtype).eps * size).all(-1)
    tril = jnp.broadcast_to(q.scale_tril, (*difference.shape, difference.shape[-1]))
    difference = jnp.where(same[..., None], 1, difference)
    unit = jnp.abs(difference).max(-1)
    unit = jnp.where(unit > 0, unit, 1)
    length = (_solve(tril, (difference / unit[..., None])[..., None]) ** 2).sum((-2, -1))
    return jnp.where(same, -jnp.inf, jnp.log(length) + 2 * jnp.log(unit)), same


def _integrals(p, q):
    """As `_expectations`, by quadrature over tau = (t - time_loc_p) / time_scale_p; one pair, not a batch."""
    log_a = lambda dist, t: dist.envelope.log_a(t, time_loc=dist.time_loc, time_scale=dist.time_scale)  # noqa: E731

    def functions(p, q):
        time = lambda tau: p.time_loc + p.time_scale * tau  # noqa: E731
        log_over_q = lambda tau: -0.5 * tau**2 - HALF_LOG_2PI - log_a(q, time(tau))  # noqa: E731

        def log_ratio(tau):
            return log_a(p, time(tau)) - log_a(q, time(tau))

        def log_mahalanobis(tau):
            log_square, _ = _center_distance(p, q, time(tau).ravel())
            return log_square.reshape(tau.shape) + log_over_q(tau)

        return lambda tau: log_a(p, time(tau)) + log_over_q(tau), log_mahalanobis, log_ratio

    mine, frozen = functions(p, q), functions(*lax.stop_gradient((p, q)))
    edges = (_break_times(p, q) - p.time_loc) / p.time_scale
    found = [_integral(log_f, search, edges) for log_f, search in zip(mine[:2], frozen[:2], strict=True)]
    panels = normal_panels(frozen[2], edges[:0], edges.dtype)
    log_ratio = panels.expectation(mine[2](panels.nodes))
    unit = lax.stop_gradient(jnp.maximum(1, jnp.abs(log_ratio)))
    found.append((-log_ratio, unit * panels.expectation_error(frozen[2](panels.nodes) / unit)))
    return tuple(zip(*found, strict=True))


def _integral(log_f, search, edges):
    """The integral of exp(log_f), +inf if it diverges, and its estimated error."""
    grid = jnp.asarray(SEARCH_GRID, edges.dtype)
    panels = adaptive_panels(log_f, find_peaks(search, grid, _PEAKS), search=search, edges=edges)
    empty, infinite = jnp.isneginf(panels.log_total), diverges(search, panels)
    total = jnp.where(empty, 0, jnp.exp(panels.log_total))
    error = jnp.where(empty, 0, total * panels.error_estimate)
    return jnp.where(infinite, jnp.inf, total), jnp.where(infinite, jnp.inf, error)
