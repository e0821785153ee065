"""One-dimensional integrals: against a normal by fixed rules, and of any log-density adaptively around its mass.

The adaptive rule is Gauss-Kronrod (7, 15) on panels that are halved where their error is largest, a fixed number
of times, so that it compiles. It works with logarithms: neither a mass of exp(-10^6) nor a peak 1e-9 wide is lost.
Where the panels lie is not differentiated, what they sum up to is.
"""

from collections.abc import Callable
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

__all__ = ["Panels", "adaptive_panels", "diverges", "gauss_hermite", "normal_rule", "peaks"]

_Log = Callable[[Float[Array, "..."]], Float[Array, "..."]]

# Gauss-Kronrod: half of the 15 nodes with their weights, and the weights of the 7 Gauss nodes among them.
_NODES = [
    0.991455371120812639206854697526329,
    0.949107912342758524526189684047851,
    0.864864423359769072789712788640926,
    0.741531185599394439863864773280788,
    0.586087235467691130294144838258730,
    0.405845151377397166906606412076961,
    0.207784955007898467600689403773245,
    0.0,
]
_WEIGHTS = [
    0.022935322010529224963732008058970,
    0.063092092629978553290700663189204,
    0.104790010322250183839876322541518,
    0.140653259715525918745189590510238,
    0.169004726639267902826583426598550,
    0.190350578064785409913256402421014,
    0.204432940075298892414161999234649,
    0.209482141084727828012999174891714,
]
_GAUSS_WEIGHTS = [
    0.129484966168869693270611432679082,
    0.279705391489276667901467771423780,
    0.381830050505118944950369775488975,
    0.417959183673469387755102040816327,
]
KRONROD_NODES = np.r_[-np.array(_NODES), np.array(_NODES[-2::-1])]
_KRONROD = np.r_[_WEIGHTS, _WEIGHTS[-2::-1]]
_GAUSS = np.zeros(15)
_GAUSS[1::2] = [*_GAUSS_WEIGHTS, *_GAUSS_WEIGHTS[-2::-1]]

# Where an integral over tau ends: a log-density of -5e7 is behind it.
REACH = 1e4
_BASE = np.r_[-REACH, -1e3, -1e2, -40.0, -20.0, np.linspace(-10, 10, 41), 20.0, 40.0, 1e2, 1e3, REACH]
# Peaks are looked for in steps of 0.05 where a normal has its mass, and in growing steps outside.
_TAIL = np.geomspace(10, REACH, 150)
SEARCH_GRID = np.r_[-_TAIL[::-1], np.linspace(-10, 10, 401)[1:-1], _TAIL]
_LADDER = 20.0 * 4.0 ** -np.arange(13)  # distances of panel edges around each peak
_ROUNDS, _SPLITS = 24, 16  # halvings, and panels halved in each
_GOLDEN = (np.sqrt(5) - 1) / 2


@cache
def gauss_hermite(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights with `sum(w g(z)) = E g(z)`, z standard normal: exact for polynomials to 2 order - 1."""
    z, weights = np.polynomial.hermite_e.hermegauss(order)
    return z, weights / weights.sum()


@cache
def normal_rule() -> tuple[np.ndarray, np.ndarray]:
    """The like of `gauss_hermite` for functions that are no polynomials: Gauss-Legendre on panels of width 1/4."""
    y, weights = np.polynomial.legendre.leggauss(12)
    centres = np.arange(-12, 12, 0.25)[:, None] + 0.125
    z = (centres + 0.125 * y).ravel()
    weights = np.tile(0.125 * weights, len(centres)) * np.exp(-0.5 * z * z)
    return z, weights / weights.sum()


class Panels(eqx.Module):
    """Panels of an adaptive integral of exp(log_f), sorted, with log_f at the 15 nodes of each.

    **Shapes:** `left`, `right` (*batch, panels), `log_values` (*batch, panels, 15).

    **Example:** `adaptive_panels(lambda x: -(x**2) / 2, jnp.zeros(1)).log_total  # log sqrt(2 pi)`

    **Source:** QUADPACK's rule and error estimate (Piessens et al. 1983).
    """

    left: Float[Array, "*batch panels"]
    right: Float[Array, "*batch panels"]
    log_values: Float[Array, "*batch panels 15"]

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (1, 1, 2)

    @property
    def nodes(self) -> Float[Array, "*batch panels 15"]:
        return _nodes(self.left, self.right)

    @property
    def log_weights(self) -> Float[Array, "*batch panels 15"]:
        """log of (weight times value): they sum to `log_total`."""
        half = _log_width(self.left, self.right)[..., None]
        weights = jnp.asarray(np.log(_KRONROD), half.dtype)
        return self.log_values + lax.expand_dims(weights, range(half.ndim - 1)) + half

    @property
    def log_total(self) -> Float[Array, "*batch"]:
        """log of the integral."""
        return logsumexp(self.log_weights, axis=(-2, -1))

    @property
    def error_estimate(self) -> Float[Array, "*batch"]:
        """Relative error of the integral, as QUADPACK estimates it, at least the rounding of its sum."""
        log_error = _log_error(self.left, self.right, self.log_values) - self.log_total[..., None]
        error = jnp.exp(log_error).sum(-1)
        return jnp.maximum(error * jnp.minimum(1, (200 * error) ** 0.5), 10 * jnp.finfo(error.dtype).eps)

    @property
    def probabilities(self) -> Float[Array, "*batch panels"]:
        """Each panel's share of the integral."""
        return jnp.exp(logsumexp(self.log_weights, axis=-1) - self.log_total[..., None])

    def expectation(self, function: Float[Array, "panels 15 *event"]) -> Float[Array, "*event"]:
        """Mean of values given at `nodes` under the normalised density; one integral, not a batch."""
        weights = jnp.exp(self.log_weights - self.log_total)
        # Far out, where no mass is, a function may overflow: 0 * inf is 0 here.
        weighs = lax.expand_dims(weights > 0, range(2, function.ndim))
        return jnp.tensordot(weights, jnp.where(weighs, function, 0), axes=2)

    def cdf(self, x: Float[Array, ""]) -> Float[Array, ""]:
        """Share of the integral left of x; one integral, not a batch."""
        index = jnp.clip(jnp.searchsorted(self.right, x), 0, self.right.size - 1)
        below = (jnp.cumsum(self.probabilities) - self.probabilities)[index]
        width = self.right[index] - self.left[index]
        y = 2 * (x - self.left[index]) / jnp.where(width > 0, width, 1) - 1
        inside = self.probabilities[index] * _share(self._shape(index), jnp.clip(y, -1, 1))
        return jnp.clip(below + inside, 0, 1)

    def icdf(self, q: Float[Array, ""]) -> Float[Array, ""]:
        """The inverse of `cdf`, by bisection in the right panel."""
        total = jnp.cumsum(self.probabilities)
        q = q * total[-1]
        index = jnp.clip(jnp.searchsorted(total, q), 0, total.size - 1)
        share = (q - (total - self.probabilities)[index]) / self.probabilities[index]
        shape = self._shape(index)

        def halve(_, bounds):
            low, high = bounds
            middle = 0.5 * (low + high)
            above = _share(shape, middle) > share
            return jnp.where(above, low, middle), jnp.where(above, middle, high)

        one = jnp.ones((), q.dtype)
        low, high = lax.fori_loop(0, 50, halve, (-one, one))
        return self.left[index] + (self.right[index] - self.left[index]) * 0.5 * (1 + 0.5 * (low + high))

    def _shape(self, index) -> Float[Array, "16"]:
        """Legendre coefficients of one panel's cumulative share, from 0 at -1 to 1 at 1."""
        values = self.log_values[index]
        largest = values.max()
        values = jnp.exp(values - jnp.where(jnp.isfinite(largest), largest, 0))
        coefficients = jnp.asarray(_CUMULATIVE, values.dtype) @ values
        return coefficients / coefficients.sum()  # P_k(1) = 1


def adaptive_panels(log_f: _Log, guides: Float[Array, "guides"], *, search: _Log | None = None) -> Panels:
    """Panels for the integral of exp(log_f) over [-REACH, REACH], fine around `guides` (see `peaks`).

    `search` is `log_f` without derivatives, where `log_f` has parameters to be differentiated.

    **Shapes:** `log_f` is elementwise. **Raises:** nothing; see `diverges` for a mass that does not fall off.
    """
    left, right = _found_panels(log_f if search is None else search, lax.stop_gradient(guides))
    return Panels(left, right, log_f(_nodes(left, right)))


def diverges(log_f: _Log, panels: Panels) -> Array:
    """Whether the integral's mass reaches the ends of the line."""
    ends = log_f(jnp.asarray([-REACH, REACH], panels.left.dtype)).max()
    # e^-20 of the total at the ends, were they as wide as they are far, is no tail of a finite integral here.
    return ends + np.log(REACH) > panels.log_total - 20.0


def peaks(log_f: _Log, grid: Float[Array, "grid"], count: int, *, score: _Log | None = None) -> Float[Array, "count"]:
    """The `count` best local maxima of `log_f` (by `score`, if given), found on a grid and refined to rounding.

    NaN where there are fewer. **Shapes:** `log_f` is elementwise.
    """
    values = log_f(grid)
    lower, upper = values[:-2], values[2:]
    is_peak = (values[1:-1] >= lower) & (values[1:-1] > upper) & jnp.isfinite(values[1:-1])
    rank = jnp.where(is_peak, values[1:-1] if score is None else score(grid[1:-1]), -jnp.inf)
    rank, index = lax.top_k(rank, min(count, rank.size))
    found = _golden(log_f, grid[index], grid[index + 2])
    return jnp.where(jnp.isneginf(rank), jnp.nan, found)


def _golden(log_f: _Log, low: Array, high: Array) -> Array:
    """Golden section, to the rounding of the argument."""
    steps = 80 if low.dtype == jnp.float64 else 40

    def shrink(_, bounds):
        low, high = bounds
        a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        left_wins = log_f(a) >= log_f(b)
        return jnp.where(left_wins, low, a), jnp.where(left_wins, b, high)

    low, high = lax.fori_loop(0, steps, shrink, (low, high))
    return 0.5 * (low + high)


def _found_panels(log_f: _Log, guides: Array) -> tuple[Array, Array]:
    """Left and right edges after all halvings, sorted."""
    dtype = guides.dtype
    ladder = jnp.asarray(np.r_[0, _LADDER, -_LADDER], dtype)
    extra = (jnp.where(jnp.isnan(guides), 0, guides)[:, None] + ladder[None, :]).ravel()
    edges = jnp.sort(jnp.clip(jnp.concatenate([jnp.asarray(_BASE, dtype), extra]), -REACH, REACH))
    spare = jnp.full(_ROUNDS * _SPLITS, REACH, dtype)
    left, right = jnp.concatenate([edges[:-1], spare]), jnp.concatenate([edges[1:], spare])
    log_mass, log_error = _estimates(log_f, left, right)
    first_spare = edges.size - 1

    def halve(round_, state):
        left, right, log_mass, log_error = state
        worst = lax.top_k(log_error, _SPLITS)[1]
        new = (first_spare + round_ * _SPLITS + np.arange(_SPLITS)).astype(worst.dtype)
        middle = 0.5 * (left[worst] + right[worst])
        both = jnp.concatenate([worst, new])
        new_left = jnp.concatenate([left[worst], middle])
        new_right = jnp.concatenate([middle, right[worst]])
        mass, error = _estimates(log_f, new_left, new_right)
        put = lambda x, y: x.at[both].set(y)  # noqa: E731
        return put(left, new_left), put(right, new_right), put(log_mass, mass), put(log_error, error)

    left, right, *_ = lax.fori_loop(0, _ROUNDS, halve, (left, right, log_mass, log_error))
    order = jnp.argsort(left + right)
    return left[order], right[order]


def _estimates(log_f: _Log, left: Array, right: Array) -> tuple[Array, Array]:
    values = log_f(_nodes(left, right))
    weights = jnp.asarray(np.log(_KRONROD), values.dtype)[None]
    return logsumexp(values + weights, axis=-1) + _log_width(left, right), _log_error(left, right, values)


def _log_error(left: Array, right: Array, log_values: Array) -> Array:
    """log |Kronrod - Gauss| of each panel."""
    largest = log_values.max(-1)
    largest = jnp.where(jnp.isfinite(largest), largest, 0)
    difference = jnp.exp(log_values - largest[..., None]) @ jnp.asarray(_KRONROD - _GAUSS, log_values.dtype)
    return jnp.log(jnp.abs(difference)) + largest + _log_width(left, right)


def _nodes(left: Array, right: Array) -> Array:
    nodes = jnp.asarray(KRONROD_NODES, left.dtype).reshape((1,) * left.ndim + (15,))
    return 0.5 * (left + right)[..., None] + 0.5 * (right - left)[..., None] * nodes


def _log_width(left: Array, right: Array) -> Array:
    return jnp.log(0.5 * (right - left))


def _share(coefficients: Float[Array, "16"], y: Array) -> Array:
    """The Legendre series at y, by the recurrence of the polynomials."""
    before, now = jnp.ones_like(y), y
    total = coefficients[0] * before + coefficients[1] * now
    for k in range(1, 15):
        before, now = now, ((2 * k + 1) * y * now - k * before) / (k + 1)
        total = total + coefficients[k + 1] * now
    return total


def _cumulative_matrix() -> np.ndarray:
    """Values at the nodes -> Legendre coefficients of their interpolant's integral from -1."""
    legendre = np.polynomial.legendre
    coefficients = np.linalg.inv(legendre.legvander(KRONROD_NODES, 14))
    return np.stack([legendre.legint(column, lbnd=-1) for column in coefficients.T], axis=1)


_CUMULATIVE = _cumulative_matrix()
