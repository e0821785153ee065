"""Conditional and marginal distributions outside the family: time integrated out, or space given and time unknown.

Given t they are Gaussian, so they are mixtures over time, integrated numerically with an error estimate (`quadrature`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, Key

from foldgauss._numerics.abstract import AbstractDistribution
from foldgauss._numerics.batch import (
    BatchModule,
    as_event,
    as_value,
    compile_eager,
    map_over_batch,
    vectorize,
    vectorized,
)
from foldgauss._numerics.factor import check_rest, normalize_indices
from foldgauss._runtime.checks import require
from foldgauss.analysis.narrow_crossings import ROUNDING, crossing_modes, crossing_panels, gaussian_at
from foldgauss.analysis.quadrature import (
    HALF_LOG_2PI,
    REACH,
    SEARCH_GRID,
    Panels,
    adaptive_panels,
    diverges,
    find_peaks,
    is_within_any,
)
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.gaussian import Gaussian, condition_on_first

_CROSSINGS = 24  # candidate times at which the ridge comes near
_BEST = 10  # of them, around which panels are refined
_MAXIMA = 6  # peaks of the density around which panels are refined
_MODES = 8
_LOG_NARROW = -7.0  # width of a ridge over which log a and the density of time hardly change
_MISSED = 0.1  # quadrature missed a ridge if log of its mass exceeds log of the integral by more than this
_AVERAGED = 0.1  # of the rounding at some 100 nodes across the ridge, where the residual is about 1


class TimeIntegral(BatchModule):
    """p(t | values) of a Folded-Gaussian, by quadrature over tau = (t - time_loc) / time_scale."""

    panels: Panels
    log_normalizer: Float[Array, "*batch"]  # log p(values), +inf where it diverges
    error_estimate: Float[Array, "*batch"]  # relative, of p(values); inf where it diverges or log p(values) is -inf


class TimeMixture(AbstractDistribution):
    """Some coordinates of a Folded-Gaussian, given none or some of its space coordinates, t integrated numerically.

        p(y | g) = integral p(y | g, t) p(t | g) dt          (or without the integral, if t is one of y)

    Made by `FoldedGaussian.marginal` (time dropped), `condition` (time not given) and `time_given_space`. A peak of
    p(t | s) narrower than the spacing of floating-point times (one space coordinate and a small `scale_tril` or a large
    |tau|) counts with its whole mass in probabilities, quantiles and moments; the density at exactly t may miss it.
    Where p(g) diverges (`power (d-1) >= 2` and g on a static ridge) or underflows, quantiles and moments are NaN.

    **Shapes:** `event_shape == (n,)`, n coordinates kept, time (if kept) last.

    **Example:** `dist.marginal([0]).cdf(jnp.array([0.3]))`

    **Source:** eq:foldgauss, integrated. **Raises:** ValueError on a wrong shape, and from `cdf`
    unless n is 1, from `icdf` and `modes` unless time is the only coordinate.
    """

    parent: AbstractDistribution  # of (given, kept, time), in this order
    values: Float[Array, "*#batch given"]
    time: TimeIntegral | None  # p(t | given); None if nothing is given, and t has its own normal
    keeps_time: bool = eqx.field(static=True)

    has_rsample = False

    @property
    def event_shape(self) -> tuple[int, ...]:
        return (self._space_dim + int(self.keeps_time),)

    def _log_prob(self, value: Array) -> Array:
        joint = self.parent.log_prob(_append(self.values, value)) if self.keeps_time else self._integrate(value)[0]
        return self._given(joint)

    def error_estimate(self, x: Float[Array, "*#batch n"]) -> Float[Array, "*#batch"]:
        """Estimated relative error of `pdf(x)`: that of its integrals over time.

        It is large where p depends on the rounding of x: in two or more space coordinates at points on a curve that is
        narrower than their rounding (far from `time_loc`, or with a small `scale_tril`); in one space coordinate only
        at a turning point of the curve.
        """
        x = self._checked(x)
        own = jnp.zeros(x.shape[:-1], self.dtype) if self.keeps_time else self._integrate(x)[1]
        return own if self.time is None else vectorize(jnp.add, own, self.time.error_estimate)

    def cdf(self, value: Float[Array, "*#batch 1"]) -> Float[Array, "*#batch"]:
        """P(coordinate <= x | given), where there is only one coordinate."""
        require(
            self.event_shape == (1,),
            "cdf",
            expected="one coordinate",
            got=f"{self.event_shape[0]}",
            cure="Use marginal([i]).cdf.",
        )
        value = self._checked(value)
        if self.keeps_time:
            return _time_cdf(self.time.panels, value[..., 0], self.parent.time_loc, self.parent.time_scale)
        near = jnp.where(jnp.isinf(value), 0, value)
        log_mass = self._given(map_over_batch(_log_space_cdf, self.parent, (_append(self.values, near), 1)))

        def bound(value, log_mass):
            mass = jnp.clip(jnp.exp(log_mass), 0, 1)
            return jnp.where(jnp.isinf(value), (value > 0).astype(mass.dtype), mass)

        return vectorize(bound, value[..., 0], log_mass)

    def icdf(self, q: Float[Array, "*#batch"]) -> Float[Array, "*#batch 1"]:
        """The quantile of time given space, the inverse of `cdf`: -inf at 0 and +inf at 1."""
        self._check_time_alone("icdf")
        q = as_value(q, self.dtype)
        return _time_icdf(self.time.panels, q, self.parent.time_loc, self.parent.time_scale)[..., None]

    def modes(self) -> Float[Array, "*batch modes"]:
        """The local maxima of p(t | s), highest first, at most 8; NaN where there are fewer."""
        self._check_time_alone("modes")
        return map_over_batch(_modes, self.parent, (self.values, 1), self.time.panels)

    def _check_time_alone(self, name: str) -> None:
        require(
            self.keeps_time and not self._space_dim,
            name,
            expected="the distribution of time given space",
            got=f"{self.event_shape[0]} coordinates",
        )

    @compile_eager(static=("sample_shape",))
    def _sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...]) -> Array:
        time_key, space_key = jax.random.split(key)
        if self.time is None:
            t = self.parent.marginal([-1]).sample(time_key, sample_shape)[..., 0]
        else:
            smallest = float(jnp.finfo(self.dtype).tiny)  # not 0, whose quantile is -inf
            q = jax.random.uniform(time_key, (*sample_shape, *self.batch_shape), self.dtype, minval=smallest)
            t = _time_icdf(self.time.panels, q, self.parent.time_loc, self.parent.time_scale)
        if not self._space_dim:
            return t[..., None]
        s = conditional_gaussian(self.parent, self.values, t).sample(space_key)
        return jnp.concatenate([s, t[..., None]], axis=-1) if self.keeps_time else s

    def moments(self) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch n n"]]:
        """Mean and covariance matrix of x given the values."""
        if self.time is None:
            mean, covariance = self.parent.moments()
        else:
            mean, covariance = map_over_batch(_mixture_moments, self.parent, (self.values, 1), self.time.panels)
        (end,) = self.event_shape
        return mean[..., :end], covariance[..., :end, :end]

    def marginal(self, indices) -> "TimeMixture":
        """Some of the coordinates; the indices are kept."""
        indices, dim = normalize_indices(indices, self.event_shape[0]), self._space_dim
        require(
            dim not in indices[:-1],
            "indices",
            expected="time last",
            got=repr(indices),
            cure="Time is the last coordinate.",
        )
        num_given = self.values.shape[-1]
        keep = (*range(num_given), *(num_given + i for i in indices if i < dim), num_given + dim)
        return TimeMixture(self.parent.marginal(keep), self.values, self.time, dim in indices)

    def condition(self, indices, values) -> "TimeMixture | Gaussian":
        """The other coordinates, given these: exact, a Gaussian, if time is among the given."""
        indices, num_given = normalize_indices(indices, self.event_shape[0]), self.values.shape[-1]
        both = _append(self.values, as_event("values", values, self.dtype, (len(indices),)))
        given = (*range(num_given), *(num_given + i for i in indices))
        if self.keeps_time:
            return self.parent.condition(given, both)
        kept = tuple(i for i in range(num_given + self._space_dim) if i not in given)
        check_rest(kept)
        return time_mixture(self.parent, kept, given, both, keeps_time=False)

    def log_evidence(self, indices: tuple[int, ...], values: Array, rest: "TimeMixture | Gaussian") -> Array:
        """The log-density of the values of these coordinates; `rest` is the distribution given them."""
        if isinstance(rest, TimeMixture):  # holds the integral already, over these values and those given before
            return self._given(rest.time.log_normalizer)
        return super().log_evidence(indices, values, rest)

    @property
    def _space_dim(self) -> int:
        return self.parent.event_shape[0] - 1 - self.values.shape[-1]

    def _integrate(self, x: Array) -> tuple[Array, Array]:
        """log of the joint density of x and the values, and its estimated error."""
        return map_over_batch(_log_space_density, self.parent, (_append(self.values, x), 1))

    def _given(self, log_joint: Array) -> Array:
        """The logarithm of the joint density divided by the density of the values."""
        return log_joint if self.time is None else _divide(log_joint, self.time.log_normalizer)


def time_mixture(parent, kept, given, values, *, keeps_time: bool) -> TimeMixture:
    """The distribution of the space coordinates `kept` (and of time) given `values` of the coordinates `given`."""
    time = parent.event_shape[0] - 1
    ordered = parent.marginal((*given, *kept, time))
    if not given:
        return TimeMixture(ordered, values, None, keeps_time)
    found = TimeIntegral(*map_over_batch(_space_panels, parent.marginal((*given, time)), (values, 1)))
    return TimeMixture(ordered, _over(values, found.log_normalizer.shape), found, keeps_time)


def conditional_gaussian(parent, values: Float[Array, "*#batch given"], t: Float[Array, "*#batch"]) -> Gaussian:
    """The Gaussian of the remaining space coordinates, given t and the first ones."""
    at = parent.condition_time(t)
    return condition_on_first(at, values) if values.shape[-1] else at


@compile_eager
@vectorized(0, 0, 0)
def _time_cdf(panels: Panels, t, time_loc, time_scale) -> Array:
    return panels.cdf((t - time_loc) / time_scale)


@compile_eager
@vectorized(0, 0, 0)
def _time_icdf(panels: Panels, q, time_loc, time_scale) -> Array:
    return time_loc + time_scale * panels.icdf(q)


@compile_eager
def _append(values: Array, x: Array) -> Array:
    """The values that are given, then x."""
    return vectorize(jnp.append, (values, 1), (x, 1))


@compile_eager
def _divide(log_joint: Array, log_given: Array) -> Array:
    return vectorize(lambda a, b: jnp.where(jnp.isneginf(a), -jnp.inf, a - b), log_joint, log_given)


def _over(x: Array, batch: tuple[int, ...]) -> Array:
    return jnp.broadcast_to(x, (*batch, x.shape[-1]))


# --- one at a time: parents and values without batch --------------------------------------------------------


def _centered(parent, s):
    """The parent and s, both centered at the parent's loc (and its time at 0), so that offsets cause no rounding."""
    offset = parent.loc[: s.size]
    parent = eqx.tree_at(lambda dist: dist.loc, parent, jnp.zeros_like(parent.loc))
    if isinstance(parent.envelope, Constant | TimeLikelihood):  # others may depend on t itself
        parent = eqx.tree_at(lambda dist: dist.time_loc, parent, jnp.zeros_like(parent.time_loc))
    return parent, s - offset


def _log_joint(parent, s):
    """tau -> log of the density of (s, tau), elementwise."""

    def log_f(tau):
        x = vectorize(jnp.append, (s, 1), parent.time_loc + parent.time_scale * tau)
        return parent.log_prob(x) + jnp.log(parent.time_scale)

    return log_f


def _log_joint_frozen(parent, s):
    """The same without derivatives, and less to compile."""
    parent, s = lax.stop_gradient((parent, s))
    return lambda tau: gaussian_at(parent, tau).log_prob(_over(s, tau.shape)) - 0.5 * tau**2 - HALF_LOG_2PI


def _guides(parent, s, log_f):
    """Candidate peaks in tau: where the ridge comes near (too narrow for a grid), and peaks of the density on a grid.

    Also all points where the ridge comes near, by their distance from 0, NaN where there are fewer.
    """
    grid = jnp.asarray(SEARCH_GRID, s.dtype)

    def nearness(tau):
        here = gaussian_at(parent, tau)
        return Gaussian(here.loc, here.base_tril, validate_args=False).log_prob(_over(s, tau.shape))

    near = find_peaks(nearness, grid, _CROSSINGS, score=lambda tau: -(tau**2))
    # The minimum of a square is accurate to half the digits; Gauss-Newton on the residual gives all of them.
    near = lax.fori_loop(0, 3, lambda _, tau: _nearer(parent, s, tau), near)
    there = jnp.where(jnp.isnan(near), 0, near)
    # Ranked by mass, not by density: a narrow ridge has a high density, by the factor a^(-(d-1)/2).
    mass = jnp.where(jnp.isnan(near), -jnp.inf, log_f(there) + s.size * gaussian_at(parent, there).log_scale)
    return jnp.concatenate([near[lax.top_k(mass, _BEST)[1]], find_peaks(log_f, grid, _MAXIMA)]), near


def _nearer(parent, s, tau):
    """A Gauss-Newton step from tau to where the ridge is nearest to s; long steps are not taken."""
    place, speed = jax.jvp(lambda tau: gaussian_at(parent, tau).loc[..., : s.size], (tau,), (jnp.ones_like(tau),))
    tril = parent.scale_tril[: s.size, : s.size]
    solve = lambda rows: lax.linalg.triangular_solve(tril, rows.T, left_side=True, lower=True)  # noqa: E731
    residual, rate = solve(_over(s, tau.shape) - place), solve(speed)
    step = (residual * rate).sum(0) / (rate * rate).sum(0)
    return jnp.where(jnp.abs(step) < 1e-3 * (1 + jnp.abs(tau)), tau + step, tau)


def _space_panels(parent, s) -> tuple[Panels, Array, Array]:
    """Panels of p(s, tau) over tau, log p(s), and its estimated relative error."""
    parent, s = _centered(parent, s)
    frozen, log_f = lax.stop_gradient((parent, s)), _log_joint_frozen(parent, s)
    guides, near = _guides(*frozen, log_f)
    spikes, log_unseen = crossing_panels(parent, s) if s.size == 1 else (None, jnp.asarray(-jnp.inf, s.dtype))
    panels = adaptive_panels(_log_joint(parent, s), guides, search=log_f, spikes=spikes)
    log_total = panels.log_total
    log_size = jnp.where(jnp.isneginf(log_total), 0, log_total)
    error = panels.error_estimate + jnp.exp(log_unseen - log_size) + _rounding(*frozen, near, spikes, log_size)
    infinite = diverges(log_f, panels)
    error = jnp.where(infinite | jnp.isneginf(log_total), jnp.inf, error)
    return panels, jnp.where(infinite, jnp.inf, log_total), lax.stop_gradient(error)


def _rounding(parent, s, near, spikes: Panels | None, log_total):
    """The relative error of p(s) from the rounding of s - c(tau), where the ridge comes that close.

    The density has a factor exp(-z^2 / 2) of the whitened residual z, whose rounding q changes its logarithm by at most
    q (z + q), and by their average over the width of the ridge: estimates above 1 are errors of log p. For z <= 2 q the
    point may be on the ridge. Crossings on their own panels (`spikes`) are integrated exactly and excluded.
    """
    tau = jnp.where(jnp.isnan(near), 0, near)
    eps, tril = jnp.finfo(s.dtype).eps, parent.scale_tril[: s.size, : s.size]

    def curve(tau):
        at = gaussian_at(parent, tau)
        return at.loc[..., : s.size], at.log_scale

    (place, log_scale), (speed, _) = jax.jvp(curve, (tau,), (jnp.ones_like(tau),))
    inverse = lax.linalg.triangular_solve(tril, jnp.eye(s.size, dtype=s.dtype), left_side=True, lower=True)
    length = lambda rows, matrix: jnp.sqrt(((rows @ matrix.T) ** 2).sum(-1))  # noqa: E731
    sharp = jnp.exp(jnp.minimum(-log_scale, 0.4 * float(np.log(jnp.finfo(s.dtype).max))))
    residual = _over(s, tau.shape) - place
    size = jnp.abs(_over(s, tau.shape)) + jnp.abs(place) + jnp.abs(speed * tau[:, None])
    z, q = length(residual, inverse) * sharp, eps * length(size, jnp.abs(inverse)) * sharp
    rate = length(speed, inverse)
    log_width = jnp.minimum(0, log_scale - jnp.log(jnp.where(rate > 0, rate, 1)))
    log_det = jnp.log(jnp.diagonal(tril)).sum() + s.size * (log_scale + HALF_LOG_2PI)
    close, change = z <= 2 * q, q * (z + q + _AVERAGED)
    if s.size == 1:  # a crossing that rounding moves stays one, but where the curve turns back
        change = jnp.where(close, jnp.minimum(1, change), change)
    # log_share is log of the mass near this point divided by p(s). Points that may be on the ridge count as on it.
    # The mass of a narrow ridge is that of a Gaussian. A wide ridge may have less mass, since the curve bends.
    log_share = -0.5 * (tau**2 + jnp.where(close, 0, z) ** 2) - log_det + log_width - log_total
    log_share = log_share - jnp.where(log_width < _LOG_NARROW, 0, HALF_LOG_2PI)
    # Quadrature may find q times the mass of a ridge, since rounded residuals are 0 over q times its width.
    reach = log_share + jnp.where(close, jnp.log(jnp.maximum(1, q)), 2 * change)
    error = change * jnp.exp(jnp.minimum(0, reach)) + jnp.where(close & (log_share > _MISSED), log_share, 0)
    counts = ~jnp.isnan(near) & jnp.isfinite(log_share + change)
    if spikes is not None:
        counts = counts & ~is_within_any((spikes.left[:, 0], spikes.right[:, -1]), tau)
    return jnp.where(counts, error, 0).sum()


def _modes(parent, values, panels: Panels):
    own, s = _centered(parent, values)
    log_f = _log_joint_frozen(own, s)
    grid = jnp.unique(panels.nodes.ravel(), size=panels.nodes.size, fill_value=REACH)
    found = find_peaks(log_f, grid, 2 * _MODES)
    height = jnp.where(jnp.isnan(found), -jnp.inf, log_f(jnp.where(jnp.isnan(found), 0, found)))
    if s.size == 1:
        spikes, _ = crossing_panels(own, s)
        holes = spikes.left[:, 0], spikes.right[:, -1]
        peak, peak_height = crossing_modes(own, s, spikes)
        height = jnp.concatenate([jnp.where(is_within_any(holes, found), -jnp.inf, height), peak_height])
        found = jnp.concatenate([found, peak])
    height, order = lax.top_k(height, height.size)
    found = jnp.where(jnp.isneginf(height), jnp.nan, found[order])
    shown = jnp.isfinite(found) & ~_same_top(log_f, found, height)
    best = lax.top_k(jnp.where(shown, height, -jnp.inf), _MODES)[1]
    return parent.time_loc + parent.time_scale * jnp.where(shown, found, jnp.nan)[best]


def _same_top(log_f, found, height):
    """Which maxima (highest first) are duplicates of a higher one: a top that is flat up to rounding has many."""
    a, b = jnp.where(jnp.isnan(found), REACH, found)[:, None], found[None]
    eps = jnp.finfo(found.dtype).eps
    valley = log_f(0.5 * (a + b)) < height[None] - ROUNDING * eps * jnp.maximum(1, jnp.abs(height[None]))
    close = jnp.abs(a - b) < eps**0.25 * (1 + jnp.abs(b))
    earlier = jnp.arange(found.size)[:, None] < jnp.arange(found.size)[None]
    return (close & ~valley & earlier).any(0)


def _log_space_density(parent, s):
    _, log_total, error = _space_panels(parent, s)
    return log_total, error


def _log_space_cdf(parent, s):
    """log of p(first coordinates) P(last coordinate <= its value | the first)."""
    parent, s = _centered(parent, s)
    given, frozen = s.size - 1, lax.stop_gradient((parent, s))
    keep = (*range(given), s.size)

    def log_share(parent, s, tau):
        t = parent.time_loc + parent.time_scale * tau
        one = conditional_gaussian(parent, _over(s[:-1], t.shape), t)
        residual = (s[-1] - one.loc[..., 0]) / parent.scale_tril[-1, -1]
        return log_ndtr(residual * jnp.exp(jnp.minimum(-one.log_scale, 0.9 * float(np.log(jnp.finfo(s.dtype).max)))))

    def make(log_joint, parent, s):
        if not given:
            return lambda tau: log_share(parent, s, tau) - 0.5 * tau**2 - HALF_LOG_2PI
        first = log_joint(parent.marginal(keep), s[:-1])
        return lambda tau: log_share(parent, s, tau) + first(tau)

    log_f, search = make(_log_joint, parent, s), make(_log_joint_frozen, *frozen)
    spikes = None
    if given == 1:
        spikes, _ = crossing_panels(parent.marginal(keep), s[:-1])
        shares = log_share(parent, s, spikes.nodes)
        spikes = eqx.tree_at(lambda panels: panels.log_values, spikes, spikes.log_values + shares)
    guides, _ = _guides(*frozen, _log_joint_frozen(*frozen))
    return adaptive_panels(log_f, guides, search=search, spikes=spikes).log_total


def _mixture_moments(parent, values, panels: Panels):
    """Mean and covariance of (kept, time) given the values, by the laws of total mean and covariance."""
    offset = jnp.append(parent.loc[values.size :], parent.time_loc)
    own, s = _centered(parent, values)
    t = own.time_loc + own.time_scale * panels.nodes
    offset = offset.at[-1].add(-own.time_loc)
    dim = parent.event_shape[0] - 1 - values.size
    if not dim:
        y, within = t[..., None], jnp.zeros((1, 1), t.dtype)
    else:
        at = conditional_gaussian(own, _over(s, t.shape), t)
        y = jnp.concatenate([at.loc, t[..., None]], axis=-1)
        tril = parent.scale_tril[values.size :, values.size :]
        mean_a = panels.expectation(jnp.exp(2 * at.log_scale))
        within = jnp.pad(mean_a * tril @ tril.T, ((0, 1), (0, 1)))
    mean = panels.expectation(y)
    centered = y - mean[None, None]
    return offset + mean, within + panels.expectation(centered[..., :, None] * centered[..., None, :])
