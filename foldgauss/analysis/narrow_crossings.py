"""The mass in time of narrow crossings: times at which a curve of small width passes a given space coordinate.

With one space coordinate and far from `time_loc`, a crossing may be shorter than the spacing of floating-point times,
so that quadrature over time misses it. Integrated over the standardized residual instead, it is smooth.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array

from foldgauss._numerics.batch import bisect
from foldgauss.analysis.quadrature import HALF_LOG_2PI, KRONROD_NODES, REACH, SEARCH_GRID, Panels
from foldgauss.gaussian import Gaussian

_TURNS = 8  # turning points of a curve
_SPIKES = 12  # narrow crossings of the curve, each on its own panels
_SPIKE_PANELS = 7  # odd: the middle is a node
_WIDEST = 9.0  # standard deviations to each side: exp(-40) of the mass is beyond
_NEWTON_STEPS = 6
_STEADY = 0.02  # a crossing is narrow if speed and phi(tau) vary by no more, relative, over all of it
ROUNDING = 64  # tolerance of a solved equation, in epsilons


def gaussian_at(parent, tau) -> Gaussian:
    return parent.condition_time(parent.time_loc + parent.time_scale * tau)


def crossing_panels(parent, s) -> tuple[Panels, Array]:
    """Panels (spikes, panels) where the curve of one space coordinate crosses s, in z instead of tau.

        p(s, tau) dtau = phi(z) phi(tau) / |dF / dtau| dz,   F(tau, z) = c(tau) + z width(tau) - s = 0

    with width^2 = a Sigma. A crossing that is narrow in tau is smooth in z at any width: as a goes to 0 its mass is
    phi(tau) / |dc / dtau|. Crossings where F is not nearly linear up to |z| = _WIDEST are left to panels in tau.

    Also returns the log mass of crossings beyond _SPIKES, which panels in tau may miss.
    """
    frozen = lax.stop_gradient((parent, s))
    tau, log_unseen = _crossings(*frozen)
    ends = np.linspace(-_WIDEST, _WIDEST, _SPIKE_PANELS + 1)
    half = _WIDEST / _SPIKE_PANELS
    inside = (ends[:-1] + half)[:, None] + half * KRONROD_NODES
    upwards = jnp.where(_crossing(*frozen, tau, 0.0)[1] > 0, -1, 1)  # tau is to increase along the panels
    z = upwards[:, None] * jnp.asarray(np.r_[ends, inside.ravel(), 0.0], s.dtype)[None]

    def newton(where, at, keep):
        gap, slope = _crossing(*where, at, z)
        moves = keep & (slope != 0)
        slope = jnp.where(moves, slope, 1)
        return at - jnp.where(moves, gap / slope, 0), slope

    at = jnp.broadcast_to(tau[:, None], z.shape)
    at = lax.fori_loop(0, _NEWTON_STEPS, lambda _, at: newton(frozen, at, True)[0], at)
    narrow = _is_narrow(*frozen, at, z)[:, None]
    at = jnp.where(narrow, at, 0)
    at, _ = newton((parent, s), at, narrow)  # one step gives derivatives to first order, two to third
    at, slope = newton((parent, s), at, narrow)
    at = jnp.where(narrow, at, REACH)
    log_values = -0.5 * (z**2 + at**2) - 2 * HALF_LOG_2PI - jnp.log(jnp.abs(slope))
    shape = (tau.size, _SPIKE_PANELS, KRONROD_NODES.size)
    nodes, log_values = (x[:, ends.size : -1].reshape(shape) for x in (lax.stop_gradient(at), log_values))
    edges = lax.cummax(lax.stop_gradient(at)[:, : ends.size], axis=1)
    spacing = 4 * jnp.finfo(s.dtype).eps * jnp.abs(edges)
    edges = edges.at[:, 0].add(-spacing[:, 0]).at[:, -1].add(spacing[:, -1])  # the rounding of Newton's method
    log_half = jnp.broadcast_to(jnp.where(narrow, float(np.log(half)), -jnp.inf), shape[:2])
    return Panels(edges[:, :-1], edges[:, 1:], nodes, log_half, log_values), log_unseen


def _crossing(parent, s, tau, z):
    """F(tau, z) of `crossing_panels`, and its slope in tau."""

    def gap(tau):
        at = gaussian_at(parent, tau)
        return at.loc[..., 0] - s[0] + z * (jnp.exp(at.log_scale) * parent.scale_tril[0, 0])

    return jax.jvp(gap, (tau,), (jnp.ones_like(tau),))


def _crossings(parent, s) -> tuple[Array, Array]:
    """tau where the curve of one space coordinate passes s, the _SPIKES of most mass; log of the mass of the others."""

    def gap(tau):
        return gaussian_at(parent, tau).loc[..., 0] - s[0]

    # With its turning points known, the curve passes once or not at all between one tau and the next.
    grid = jnp.asarray(SEARCH_GRID, s.dtype)
    speed = lambda tau: jax.jvp(gap, (tau,), (jnp.ones_like(tau),))[1]  # noqa: E731
    turns = _roots(speed, grid, _TURNS, lambda low, high, *_: -jnp.abs(low + high))[0]
    edges = jnp.sort(jnp.concatenate([grid, jnp.where(jnp.isnan(turns), 0, turns)]))

    def log_mass(low, high, before, after):
        rate = jnp.abs((after - before) / jnp.where(high > low, high - low, 1))
        return -0.5 * jnp.minimum(jnp.abs(low), jnp.abs(high)) ** 2 - HALF_LOG_2PI - jnp.log(rate)

    tau, others = _roots(gap, edges, _SPIKES, log_mass)
    return tau, logsumexp(others)


def _roots(function, edges, count: int, rank) -> tuple[Array, Array]:
    """Where the function changes its sign between edges: the `count` highest in rank, NaN where there are fewer.

    Also the ranks of the others, -inf where there are none. `rank(low, high, function(low), function(high))`.
    """
    values = function(edges)
    below = values < 0
    passes = below[1:] != below[:-1]
    ranks = jnp.where(passes, rank(edges[:-1], edges[1:], values[:-1], values[1:]), -jnp.inf)
    best, taken = lax.top_k(ranks, count)
    low, high, rises = edges[:-1][taken], edges[1:][taken], below[:-1][taken]

    low, high = bisect(lambda x: (function(x) < 0) == rises, low, high, jnp.finfo(edges.dtype).nmant + 10)
    return jnp.where(jnp.isneginf(best), jnp.nan, 0.5 * (low + high)), ranks.at[taken].set(-jnp.inf)


def _is_narrow(parent, s, at, z):
    """Whether F(tau, z) = 0 is solved, and linear enough: its slope and phi(tau) vary little.

    `at` (spikes, z) holds tau(z), at z = 0 last.
    """
    gap, slope = _crossing(parent, s, at, z)
    last = (slice(None), slice(-1, None))
    size = jnp.abs(s[0]) + jnp.abs(slope * at)
    solved = jnp.abs(gap) <= ROUNDING * jnp.finfo(s.dtype).eps * size
    steady = jnp.abs(slope - slope[last]) <= _STEADY * jnp.abs(slope[last])
    near = jnp.abs(at - at[last]) * jnp.maximum(1, jnp.abs(at[last])) <= _STEADY
    return (solved & steady & near & (slope != 0)).all(-1)  # False for NaN


def crossing_modes(parent, s, spikes: Panels):
    """tau and log-density of the peak of each spike: where z = 0, moved up the slope of phi(tau) / width."""
    tau = spikes.nodes[:, _SPIKE_PANELS // 2, 7]
    _, slope = _crossing(parent, s, tau, 0.0)
    log_scale, growth = jax.jvp(lambda tau: gaussian_at(parent, tau).log_scale, (tau,), (jnp.ones_like(tau),))
    per_z = jnp.exp(log_scale) * parent.scale_tril[0, 0] / jnp.where(slope == 0, 1, jnp.abs(slope))
    move = -(tau + growth) * per_z
    height = -0.5 * tau**2 + 0.5 * move**2 - 2 * HALF_LOG_2PI - log_scale - jnp.log(parent.scale_tril[0, 0])
    return tau + move * per_z, jnp.where(jnp.isneginf(spikes.log_half[:, 0]), -jnp.inf, height)
