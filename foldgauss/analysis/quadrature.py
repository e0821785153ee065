"""One-dimensional adaptive quadrature, of any log-density and of any function under a normal density.

The rule is Gauss-Kronrod (7, 15), halving the panels of the largest error a fixed number of times, so that it
compiles. Densities are logarithms, so that a mass of exp(-10^6) does not underflow. Derivatives are those of the sum,
not of the panels' edges. For polynomials, Gauss-Hermite is exact.
"""

import warnings
from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from foldgauss._numerics.batch import BatchModule, bisect, concrete_value

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

# The range of integrals over tau: beyond, a normal log-density is below -5e7.
REACH = 1e4
_BASE = np.r_[-REACH, -1e3, -1e2, -40.0, -20.0, np.linspace(-10, 10, 41), 20.0, 40.0, 1e2, 1e3, REACH]
# Peaks are searched for in steps of 0.05 where a normal has its mass, and in growing steps outside.
_TAIL = np.geomspace(10, REACH, 150)
SEARCH_GRID = np.r_[-_TAIL[::-1], np.linspace(-10, 10, 401)[1:-1], _TAIL]
_LADDER = 20.0 * 4.0 ** -np.arange(13)  # distances of panel edges around each peak
#: Rounds of halving.
_ROUNDS = 24
#: Panels halved in each round.
_SPLITS = 16
HALF_LOG_2PI = 0.5 * float(np.log(2 * np.pi))
_GOLDEN = float((np.sqrt(5) - 1) / 2)


@cache
def gauss_hermite(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights with `sum(w g(z)) = E g(z)`, z standard normal: exact for polynomials to 2 order - 1."""
    z, weights = np.polynomial.hermite_e.hermegauss(order)
    return z, weights / weights.sum()


class Panels(BatchModule):
    """Panels of an adaptive integral of exp(log_f), sorted, with log_f at the 15 nodes of each.

    A panel may be integrated in another variable, in which a narrow peak is smooth: `log_half` and `log_values` are of
    that variable; `left`, `right` and `nodes` are of x, where they may coincide.

    **Shapes:** `left`, `right` (*batch, panels), `nodes` (*batch, panels, 15), `log_half`, the log of half a panel's
    width, (*batch, panels), `log_values` (*batch, panels, 15).

    **Example:** `adaptive_panels(lambda x: -(x**2) / 2, jnp.zeros(1)).log_total  # log sqrt(2 pi)`

    **Source:** QUADPACK's rule and error estimate (Piessens et al. 1983).
    """

    left: Float[Array, "*batch panels"]
    right: Float[Array, "*batch panels"]
    nodes: Float[Array, "*batch panels 15"]
    log_half: Float[Array, "*batch panels"]
    log_values: Float[Array, "*batch panels 15"]

    @property
    def log_weights(self) -> Float[Array, "*batch panels 15"]:
        """log of (weight times value): they sum to `log_total`."""
        half = self.log_half[..., None]
        weights = jnp.asarray(np.log(_KRONROD), half.dtype)
        return self.log_values + lax.expand_dims(weights, range(half.ndim - 1)) + half

    @property
    def log_total(self) -> Float[Array, "*batch"]:
        """log of the integral."""
        return logsumexp(self.log_weights, axis=(-2, -1))

    @property
    def error_estimate(self) -> Float[Array, "*batch"]:
        """Relative error of the integral, as QUADPACK estimates it, at least the rounding of its sum and logarithm."""
        log_total, weights = self.log_total, self.weights
        kronrod = jnp.broadcast_to(jnp.asarray(_KRONROD, weights.dtype), weights.shape)
        error = _panel_errors(kronrod, weights / kronrod).sum(-1)
        size = jnp.abs(jnp.where(jnp.isfinite(log_total), log_total, 0))
        return jnp.maximum(error, 10 * jnp.finfo(error.dtype).eps * jnp.maximum(1, size))

    @property
    def weights(self) -> Float[Array, "*batch panels 15"]:
        """Fractions of the integral; their sum is 1, which exp(log_weights - log_total) misses for large log_total."""
        # XLA may compute one value twice, rounded differently: a log-weight of -1e20 would exceed its maximum by 1e13.
        return jax.nn.softmax(lax.optimization_barrier(self.log_weights), axis=(-2, -1))

    @property
    def probabilities(self) -> Float[Array, "*batch panels"]:
        """Each panel's fraction of the integral; NaN if that is 0."""
        return self.weights.sum(-1)

    def expectation(self, function: Float[Array, "panels 15 *event"]) -> Float[Array, "*event"]:
        """Mean of values given at `nodes` under the normalized density; one integral, not a batch."""
        weights = self.weights
        # Where there is no mass, a function may overflow: 0 * inf is 0 here.
        weighs = lax.expand_dims(weights > 0, range(2, function.ndim))
        return jnp.tensordot(weights, jnp.where(weighs, function, 0), axes=2)

    def expectation_error(self, function: Float[Array, "panels 15 *event"]) -> Float[Array, "*event"]:
        """Estimated error of `expectation` for values of the order of 1, as `error_estimate`."""
        values = jnp.where(lax.expand_dims(self.weights > 0, range(2, function.ndim)), function, 0)
        values = jnp.moveaxis(values, (0, 1), (-2, -1))
        error = _panel_errors(jnp.broadcast_to(self.weights, values.shape), values).sum(-1)
        return error + 10 * jnp.finfo(error.dtype).eps

    def cdf(self, x: Float[Array, ""]) -> Float[Array, ""]:
        """Fraction of the integral left of x; one integral, not a batch."""
        # Panels without width in x are atoms: right-continuous, P(X <= x).
        index = jnp.clip(jnp.searchsorted(self.right, x, side="right"), 0, self.right.size - 1)
        probabilities = self.probabilities
        below = (jnp.cumsum(probabilities) - probabilities)[index]
        inside = probabilities[index] * _series(self._share(index), self._within(index, x))
        total = jnp.clip(below + inside, 0, 1)
        return jnp.where(jnp.isnan(x), jnp.nan, jnp.where(jnp.isinf(x), (x > 0).astype(total.dtype), total))

    def icdf(self, q: Float[Array, ""]) -> Float[Array, ""]:
        """The inverse of `cdf`, by bisection in the right panel: -inf at 0, +inf at 1, NaN outside."""
        probabilities = self.probabilities
        total = jnp.cumsum(probabilities)
        target = q * total[-1]
        index = jnp.clip(jnp.searchsorted(total, target), 0, total.size - 1)
        share = (target - (total - probabilities)[index]) / probabilities[index]
        y = _solved(self._share(index), share)
        width = self.right[index] - self.left[index]
        x = self.left[index] + width * jnp.clip(_series(self._place(index), y), 0, 1)
        ends = jnp.where(q == 0, -jnp.inf, jnp.where(q == 1, jnp.inf, x))
        return jnp.where((q >= 0) & (q <= 1), ends, jnp.nan)

    def _share(self, index) -> Float[Array, "16"]:
        """Legendre coefficients of one panel's cumulative share, from 0 at -1 to 1 at 1."""
        values = self.log_values[index]
        largest = values.max()
        empty = jnp.isneginf(largest)
        values = jnp.where(empty, 1, jnp.exp(values - jnp.where(empty, 0, largest)))
        coefficients = jnp.asarray(_CUMULATIVE, values.dtype) @ values
        return coefficients / coefficients.sum()  # P_k(1) = 1

    def _place(self, index) -> Float[Array, "16"]:
        """Legendre coefficients of x in one panel, from 0 (left) to 1 (right)."""
        left, width = self.left[index], self.right[index] - self.left[index]
        places = (self.nodes[index] - left) / jnp.where(width > 0, width, 1)
        return jnp.append(jnp.asarray(_INTERPOLATING, places.dtype) @ places, 0)

    def _within(self, index, x) -> Float[Array, ""]:
        """Where x lies in one panel, -1 (left) to 1 (right)."""
        left, width = self.left[index], self.right[index] - self.left[index]
        place = (x - left) / jnp.where(width > 0, width, 1)
        return jnp.where(place <= 0, -1, jnp.where(place >= 1, 1, _solved(self._place(index), place)))


def normal_panels(
    function: Callable[[Float[Array, "panels 15"]], Float[Array, "panels 15 *event"]],
    edges: Float[Array, " edges"],
    dtype,
) -> Panels:
    """Panels of the standard normal density of z on which `function`, and its square, have small errors.

    `function` is without derivatives; expectations are then `panels.expectation(function(panels.nodes))`. `edges` are
    where it is not smooth; elsewhere it is at 15 nodes in each quarter of a deviation that peaks and steps are seen.
    """

    def panels_of(left, right):
        nodes = _nodes(left, right)
        return Panels(left, right, nodes, _log_width(left, right), -0.5 * nodes**2 - HALF_LOG_2PI)

    def values_at(panels, density):
        nodes = jnp.where(density > 0, panels.nodes, 0)  # the function may overflow elsewhere
        return function(nodes).reshape(*nodes.shape, -1)

    first = _initial_panels(jnp.zeros(0, dtype), lax.stop_gradient(edges), dtype)
    start = panels_of(*first)
    values = values_at(start, start.weights)
    mean = start.expectation(values)
    spread = jnp.sqrt(start.expectation((values - mean[None, None]) ** 2))
    unit = jnp.where(spread > 0, spread, 1)

    def estimates(left, right):
        panels = panels_of(left, right)
        density = jnp.exp(panels.log_values + panels.log_half[:, None])
        y = (values_at(panels, density) - mean[None, None]) / unit[None, None]
        contrast = density * jnp.asarray(_KRONROD - _GAUSS, dtype)[None]
        return jnp.log(jnp.abs(jnp.einsum("pn,pnk->pk", contrast, jnp.concatenate([y, y**2], -1))).sum(-1))

    return panels_of(*lax.stop_gradient(_halved(estimates, *first)))


def warn_of_error(name: str, error: Float[Array, "*batch"]) -> None:
    """Warn of an estimated error above the tolerance, 5e-7 in float64, if it is known, i.e. not traced."""
    concrete = concrete_value(error)
    if concrete is not None and (concrete > float(jnp.finfo(concrete.dtype).eps) ** 0.4).any():
        text = f"The quadrature of {name} has an estimated error of up to {concrete.max():.1g}."
        warnings.warn(text, RuntimeWarning, stacklevel=3)


def adaptive_panels(
    log_f: _Log,
    guides: Float[Array, " guides"],
    *,
    search: _Log | None = None,
    spikes: Panels | None = None,
    edges: Float[Array, " edges"] | None = None,
) -> Panels:
    """Panels for the integral of exp(log_f) over [-REACH, REACH], fine around `guides` (see `find_peaks`).

    `log_f` is elementwise. `search` is `log_f` without derivatives, if it has parameters to be differentiated. `spikes`
    (panels of shape (spikes, panels)) replace log_f, each from its first edge to its last. `edges` are where log_f is
    not smooth. See `diverges` for an integral that is infinite.
    """
    search, guides = log_f if search is None else search, lax.stop_gradient(guides)
    if spikes is None:
        edges = guides[:0] if edges is None else lax.stop_gradient(edges)
        left, right = _halved(partial(_estimates, search, None), *_initial_panels(guides, edges, guides.dtype))
        return Panels(left, right, _nodes(left, right), _log_width(left, right), log_f(_nodes(left, right)))
    holes = lax.stop_gradient((spikes.left[:, 0], spikes.right[:, -1]))
    borders = jnp.concatenate(holes)
    left, right = _halved(partial(_estimates, search, holes), *_initial_panels(guides, borders, guides.dtype))
    # Panels inside a hole shrink to its low edge, so that right edges stay sorted.
    middle = 0.5 * (left + right)[None]
    low = jnp.where((middle > holes[0][:, None]) & (middle < holes[1][:, None]), holes[0][:, None], -jnp.inf).max(0)
    left, right = (jnp.where(jnp.isneginf(low), edge, low) for edge in (left, right))
    nodes = _nodes(left, right)
    around = Panels(left, right, nodes, _log_width(left, right), log_f(nodes))
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), spikes)
    both = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), around, flat)
    order = jnp.argsort(lax.stop_gradient(both.left + both.right))
    return jax.tree.map(lambda x: x[order], both)


def diverges(log_f: _Log, panels: Panels) -> Array:
    """Whether the integral is infinite: the integrand does not decay towards the ends of the range."""
    ends = log_f(jnp.asarray([-REACH, REACH], panels.left.dtype)).max()
    # A finite integral has less than e^-20 of its total in ends of width REACH.
    return ends + float(np.log(REACH)) > panels.log_total - 20.0


def find_peaks(
    log_f: _Log, grid: Float[Array, " grid"], count: int, *, score: _Log | None = None
) -> Float[Array, " count"]:
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
        inner = _GOLDEN * (high - low)
        a, b = high - inner, low + inner
        at_a, at_b = jnp.split(log_f(jnp.concatenate([a, b])), 2)  # one call: half of it to compile
        left_wins = at_a >= at_b
        return jnp.where(left_wins, low, a), jnp.where(left_wins, b, high)

    low, high = lax.fori_loop(0, steps, shrink, (low, high))
    return 0.5 * (low + high)


def is_within_any(holes: tuple[Array, Array], x: Array) -> Array:
    """Whether x lies strictly inside one of the intervals."""
    low, high = (lax.expand_dims(edge, range(1, x.ndim + 1)) for edge in holes)
    return ((x[None] > low) & (x[None] < high)).any(0)


def _initial_panels(guides: Array, borders: Array, dtype) -> tuple[Array, Array]:
    """Left and right edges, fine around the guides; no panel crosses a border."""
    ladder = jnp.asarray(np.r_[0, _LADDER, -_LADDER], dtype)
    extra = (jnp.where(jnp.isnan(guides), 0, guides)[:, None] + ladder[None, :]).ravel()
    edges = jnp.concatenate([jnp.asarray(_BASE, dtype), extra, borders])
    edges = jnp.sort(jnp.clip(edges, -REACH, REACH))
    return edges[:-1], edges[1:]


def _halved(estimates: Callable[[Array, Array], Array], left: Array, right: Array) -> tuple[Array, Array]:
    """Left and right edges after all halvings of the panels of the largest error, sorted."""
    first_spare = left.size
    spare = jnp.full(_ROUNDS * _SPLITS, REACH, left.dtype)
    left, right = jnp.concatenate([left, spare]), jnp.concatenate([right, spare])
    log_error = estimates(left, right)

    def halve(round_, state):
        left, right, log_error = state
        worst = lax.top_k(log_error, _SPLITS)[1]
        new = (first_spare + round_ * _SPLITS + np.arange(_SPLITS)).astype(worst.dtype)
        middle = 0.5 * (left[worst] + right[worst])
        both = jnp.concatenate([worst, new])
        new_left = jnp.concatenate([left[worst], middle])
        new_right = jnp.concatenate([middle, right[worst]])
        put = lambda x, y: x.at[both].set(y)  # noqa: E731
        return put(left, new_left), put(right, new_right), put(log_error, estimates(new_left, new_right))

    left, right, _ = lax.fori_loop(0, _ROUNDS, halve, (left, right, log_error))
    order = jnp.argsort(left + right)
    return left[order], right[order]


def _panel_errors(weights: Float[Array, "*batch 15"], values: Float[Array, "*batch 15"]) -> Float[Array, "*batch"]:
    """Estimated errors of sums over the Kronrod nodes, whose `weights` include any density, as in QUADPACK.

    The difference to the Gauss rule, smaller where it is a small fraction of the values' mean deviation in the panel.
    """
    weight = weights.sum(-1, keepdims=True)
    center = (weights * values).sum(-1, keepdims=True) / jnp.where(weight > 0, weight, 1)
    spread = (weights * jnp.abs(values - center)).sum(-1)
    difference = jnp.abs((weights * values) @ jnp.asarray(1 - _GAUSS / _KRONROD, weights.dtype))
    return difference * jnp.minimum(1, (200 * difference / jnp.where(spread > 0, spread, 1)) ** 0.5)


def _estimates(log_f: _Log, holes, left: Array, right: Array) -> Array:
    log_error = _log_error(_log_width(left, right), log_f(_nodes(left, right)))
    return log_error if holes is None else jnp.where(is_within_any(holes, 0.5 * (left + right)), -jnp.inf, log_error)


def _log_error(log_half: Array, log_values: Array) -> Array:
    """log |Kronrod - Gauss| of each panel."""
    largest = log_values.max(-1)
    largest = jnp.where(jnp.isfinite(largest), largest, 0)
    difference = jnp.exp(log_values - largest[..., None]) @ jnp.asarray(_KRONROD - _GAUSS, log_values.dtype)
    return jnp.log(jnp.abs(difference)) + largest + log_half


def _nodes(left: Array, right: Array) -> Array:
    nodes = jnp.asarray(KRONROD_NODES, left.dtype).reshape((1,) * left.ndim + (15,))
    return 0.5 * (left + right)[..., None] + 0.5 * (right - left)[..., None] * nodes


def _log_width(left: Array, right: Array) -> Array:
    return jnp.log(0.5 * (right - left))


def _series(coefficients: Float[Array, "16"], y: Array) -> Array:
    """The Legendre series at y, by the recurrence of the polynomials."""
    before, now = jnp.ones_like(y), y
    total = coefficients[0] * before + coefficients[1] * now
    for k in range(1, 15):
        before, now = now, ((2 * k + 1) * y * now - k * before) / (k + 1)
        total = total + coefficients[k + 1] * now
    return total


def _solved(coefficients: Float[Array, "16"], value: Array) -> Array:
    """y in [-1, 1] where an increasing Legendre series has the value: bisection, and a Newton step for derivatives."""
    one = jnp.ones_like(value)
    low, high = bisect(lambda y: ~(_series(coefficients, y) > value), -one, one, 50)
    y = lax.stop_gradient(0.5 * (low + high))
    slope = lax.stop_gradient(jax.jvp(partial(_series, coefficients), (y,), (one,))[1])
    step = (value - _series(coefficients, y)) / jnp.where(slope > 0, slope, 1)
    return jnp.where(slope > 0, jnp.clip(y + step, -1, 1), y)


#: Values at the nodes -> Legendre coefficients of their interpolant.
_INTERPOLATING = np.linalg.inv(np.polynomial.legendre.legvander(KRONROD_NODES, 14))
#: Values at the nodes -> Legendre coefficients of its integral from -1.
_CUMULATIVE = np.stack([np.polynomial.legendre.legint(column, lbnd=-1) for column in _INTERPOLATING.T], axis=1)
