"""What leaves the family: a Folded-Gaussian without its time, or with space known and time not.

Given t everything is Gaussian, so all of it is a mixture over time, and time is one-dimensional: it is integrated
numerically, adaptively around the mass (`quadrature`), with an error estimate.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Array, Float, Key

from foldgauss._batch import as_value, batch_of, check_event, over_batch, parts_of
from foldgauss._checks import invalid
from foldgauss._restrict import checked_indices
from foldgauss.gaussian import Gaussian
from foldgauss.quadrature import REACH, SEARCH_GRID, Panels, adaptive_panels, diverges, peaks

__all__ = ["TimeDensity", "TimeMixture", "conditional_gaussian", "time_density", "time_mixture"]

_HALF_LOG_2PI = 0.5 * float(np.log(2 * np.pi))
_CROSSINGS = 24  # points where the ridge comes near: looked at
_BEST = 10  # and integrated around
_MAXIMA = 6
_MODES = 8


class TimeDensity(eqx.Module):
    """The density of t given (some of) space, p(t | s) = FN(s, t) / p(s), by quadrature.

    Made by `FoldedGaussian.time_given_space`.

    **Shapes:** `event_shape == ()`: values have shape (*sample, *batch). `log_normalizer` (*batch,) is log p(s).
    It is +inf where p(s) diverges (`power (d-1) >= 2` and s on a ridge that stands still).

    **Example:** `dist.time_given_space([0.3, 0.1]).mean`

    **Source:** Bayes' rule on eq:foldgauss.
    """

    parent: eqx.Module
    values: Float[Array, "*#batch d-1"]
    panels: Panels
    log_normalizer: Float[Array, "*batch"]

    @property
    def event_shape(self) -> tuple[int, ...]:
        return ()

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self.log_normalizer.shape

    @property
    def error_estimate(self) -> Float[Array, "*batch"]:
        """Estimated relative error of every density and probability of this distribution."""
        return jnp.where(jnp.isposinf(self.log_normalizer), jnp.inf, self.panels.error_estimate)

    def log_prob(self, t: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """log p(t | s)."""
        t = as_value(t, self.values.dtype)
        shape = jnp.broadcast_shapes(t.shape, self.batch_shape)
        t = jnp.broadcast_to(t, shape)[..., None]
        joint = self.parent.log_prob(jnp.concatenate([_over(self.values, shape), t], axis=-1))
        return joint - jnp.broadcast_to(self.log_normalizer, shape)

    def pdf(self, t: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """p(t | s)."""
        return jnp.exp(self.log_prob(t))

    def cdf(self, t: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """P(time <= t | s)."""
        return self._elementwise(Panels.cdf, self._tau(as_value(t, self.values.dtype)))

    def icdf(self, q: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """The quantile: the inverse of `cdf`."""
        return self._time(self._elementwise(Panels.icdf, as_value(q, self.values.dtype)))

    def sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Draws of shape (*sample_shape, *batch), by the quantile function."""
        shape = (*sample_shape, *self.batch_shape)
        return self.icdf(jax.random.uniform(key, shape, self.values.dtype))

    @property
    def mean(self) -> Float[Array, "*batch"]:
        """E[t | s]."""
        return self._time(self._moments()[0])

    @property
    def variance(self) -> Float[Array, "*batch"]:
        """Var[t | s]."""
        return self._moments()[1] * jnp.broadcast_to(self.parent.time_scale, self.batch_shape) ** 2

    def modes(self) -> Float[Array, "*batch modes"]:
        """The local maxima of p(t | s), highest first, at most 8; NaN where there are fewer."""

        return over_batch(_modes, self.parent, (self.values, 1), self.panels)

    def _moments(self):
        return over_batch(_tau_moments, self.panels)

    def _elementwise(self, function, x):
        """function(panels, x) for x of shape (*sample, *batch), without a copy of the panels for each sample."""
        batch, rank = self.batch_shape, len(self.batch_shape)
        shape = jnp.broadcast_shapes(x.shape, batch)
        flat = jnp.broadcast_to(x, shape).reshape(-1, int(np.prod(batch)))
        panels = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[rank:]), self.panels)
        return _each(function, panels, flat).reshape(shape)

    def _tau(self, t):
        shape = jnp.broadcast_shapes(t.shape, self.batch_shape)
        loc, scale = (jnp.broadcast_to(x, shape) for x in (self.parent.time_loc, self.parent.time_scale))
        return (jnp.broadcast_to(t, shape) - loc) / scale

    def _time(self, tau):
        loc, scale = (jnp.broadcast_to(x, tau.shape) for x in (self.parent.time_loc, self.parent.time_scale))
        return loc + scale * tau


class TimeMixture(eqx.Module):
    """Some coordinates of a Folded-Gaussian, given none or some of its space coordinates, t integrated numerically.

        p(y | g) = integral p(y | g, t) p(t | g) dt          (or without the integral, if t is one of y)

    Made by `FoldedGaussian.marginal` (time dropped) and `FoldedGaussian.condition` (time not given).

    **Shapes:** `event_shape == (n,)`, n coordinates kept, time (if kept) last.

    **Example:** `dist.marginal([0]).cdf(jnp.array([0.3]))`

    **Source:** eq:foldgauss, integrated. **Raises:** ValueError on a wrong shape, and from `cdf` unless n is 1.
    """

    parent: eqx.Module  # of (given, kept, time), in this order
    values: Float[Array, "*#batch given"]
    time: TimeDensity | None  # p(t | given); None if nothing is given, and t has its own normal
    keeps_time: bool = eqx.field(static=True)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return (self._space_dim + int(self.keeps_time),)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return batch_of([*parts_of(self.parent), (self.values, 1)])

    def log_prob(self, x: Float[Array, "*#batch n"]) -> Float[Array, "*#batch"]:
        """log p(x | given)."""
        x = self._checked(x)
        if self.keeps_time:
            log_joint = self.parent.log_prob(self._with_values(x))
        else:
            log_joint = self._space_integral(x)[0]
        return log_joint - jnp.broadcast_to(self._log_normalizer, log_joint.shape)

    def pdf(self, x: Float[Array, "*#batch n"]) -> Float[Array, "*#batch"]:
        """p(x | given)."""
        return jnp.exp(self.log_prob(x))

    def error_estimate(self, x: Float[Array, "*#batch n"]) -> Float[Array, "*#batch"]:
        """Estimated relative error of `pdf(x)`: that of its integrals over time.

        In one space dimension it counts mass far out (|tau| > 8 in float32 and 12 in float64 at power 1) where the
        curve is narrower than floating-point times lie apart, and so is missed: then it is 1 and more.
        """
        x = self._checked(x)
        shape = jnp.broadcast_shapes(x.shape[:-1], self.batch_shape)
        given = jnp.zeros(shape, x.dtype) if self.time is None else jnp.broadcast_to(self.time.error_estimate, shape)
        return given if self.keeps_time else given + self._space_integral(x)[1]

    def cdf(self, x: Float[Array, "*#batch 1"]) -> Float[Array, "*#batch"]:
        """P(coordinate <= x | given), where there is only one coordinate."""
        if self.event_shape != (1,):
            raise invalid("cdf", expected="one coordinate", got=f"{self.event_shape[0]}", cure="Use marginal([i]).cdf.")
        x = self._checked(x)
        if self.keeps_time:
            return self.time.cdf(x[..., 0])
        log_mass = over_batch(_log_space_cdf, self.parent, (self._with_values(x), 1))
        return jnp.clip(jnp.exp(log_mass - jnp.broadcast_to(self._log_normalizer, log_mass.shape)), 0, 1)

    def sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Draws of shape (*sample_shape, *batch, n): t first, then space given t."""
        time_key, space_key = jax.random.split(key)
        shape = (*sample_shape, *self.batch_shape)
        if self.time is None:
            noise = jax.random.normal(time_key, shape, self.values.dtype)
            loc, scale = (jnp.broadcast_to(x, shape) for x in (self.parent.time_loc, self.parent.time_scale))
            t = loc + scale * noise
        else:
            t = self.time.sample(time_key, sample_shape)
        time = t[..., None]
        if not self._space_dim:
            return time
        s = conditional_gaussian(self.parent, _over(self.values, shape), t).sample(space_key)
        return jnp.concatenate([s, time], axis=-1) if self.keeps_time else s

    @property
    def mean(self) -> Float[Array, "*batch n"]:
        """E[x | given]."""
        return self._moments()[0]

    @property
    def variance(self) -> Float[Array, "*batch n"]:
        """Var[x | given], per coordinate."""
        return jnp.diagonal(self._moments()[1], axis1=-2, axis2=-1)

    @property
    def covariance_matrix(self) -> Float[Array, "*batch n n"]:
        """Cov[x | given]."""
        return self._moments()[1]

    def marginal(self, indices) -> "TimeMixture":
        """Some of the coordinates; the indices are kept."""
        space, keeps_time = self._split(checked_indices(indices, self.event_shape[0]))
        keep = (*range(self._num_given), *(self._num_given + i for i in space))
        parent = self.parent.marginal((*keep, self.parent.event_shape[0] - 1))
        return TimeMixture(parent, self.values, self.time, keeps_time)

    def condition(self, indices, values) -> "TimeMixture | Gaussian":
        """The other coordinates, given these: exact, a Gaussian, if time is among the given."""
        indices = checked_indices(indices, self.event_shape[0])
        offset = self._num_given
        values = as_value(values, self.values.dtype)
        check_event("values", values, (len(indices),))
        shape = jnp.broadcast_shapes(values.shape[:-1], self.batch_shape)
        both = jnp.concatenate([_over(self.values, shape), _over(values, shape)], axis=-1)
        given = (*range(offset), *(offset + i for i in indices))
        if self.keeps_time:
            return self.parent.condition(given, both)
        kept = tuple(i for i in range(offset + self._space_dim) if i not in given)
        if not kept:
            raise invalid("indices", expected="a coordinate left over", got="all", cure="That is log_prob.")
        return time_mixture(self.parent, kept, given, both, keeps_time=False)

    @property
    def _num_given(self) -> int:
        return self.values.shape[-1]

    @property
    def _space_dim(self) -> int:
        return self.parent.event_shape[0] - 1 - self._num_given

    @property
    def _log_normalizer(self) -> Array:
        return jnp.zeros((), self.values.dtype) if self.time is None else self.time.log_normalizer

    def _checked(self, x):
        x = as_value(x, self.values.dtype)
        check_event("x", x, self.event_shape)
        return x

    def _with_values(self, x):
        shape = jnp.broadcast_shapes(x.shape[:-1], self.values.shape[:-1])
        return jnp.concatenate([_over(self.values, shape), _over(x, shape)], axis=-1)

    def _space_integral(self, x):
        return over_batch(_log_space_density, self.parent, (self._with_values(x), 1))

    def _split(self, indices):
        keeps_time = self.keeps_time and self._space_dim in indices
        if keeps_time and indices[-1] != self._space_dim:
            raise invalid("indices", expected="time last", got=repr(indices), cure="Time is the last coordinate.")
        return indices[: len(indices) - int(keeps_time)], keeps_time

    def _moments(self):
        if self.time is None:
            mean, covariance = self.parent.moments()
            return mean[..., :-1], covariance[..., :-1, :-1]
        mean, covariance = over_batch(_mixture_moments, self.parent, (self.values, 1), self.time.panels)
        end = self.event_shape[0]
        return mean[..., :end], covariance[..., :end, :end]


def time_density(parent, values: Float[Array, "*#batch d-1"]) -> TimeDensity:
    """p(t | s = values) of a Folded-Gaussian."""
    panels, log_normalizer = over_batch(_space_panels, parent, (values, 1))
    values = _over(values, log_normalizer.shape)
    return TimeDensity(parent, values, panels, log_normalizer)


def time_mixture(parent, kept, given, values, *, keeps_time: bool) -> TimeMixture:
    """Coordinates `kept` (and time) of a Folded-Gaussian given `values` of the space coordinates `given`."""
    time = parent.event_shape[0] - 1
    ordered = parent.marginal((*given, *kept, time))
    density = time_density(parent.marginal((*given, time)), values) if given else None
    return TimeMixture(ordered, values, density, keeps_time)


def conditional_gaussian(parent, values: Float[Array, "*#batch given"], t: Float[Array, "*#batch"]) -> Gaussian:
    """The later space coordinates given t and the first ones: exact, all of it is Gaussian given t."""
    at, given = parent.condition_time(t), values.shape[-1]
    if not given:
        return at
    batch = jnp.broadcast_shapes(at.batch_shape, values.shape[:-1])
    loc, tril = jnp.broadcast_to(at.loc, (*batch, at.loc.shape[-1])), at.base_tril
    gain = _gain(tril, given)
    residual = _over(values, batch) - loc[..., :given]
    mean = loc[..., given:] + (gain * residual[..., None, :]).sum(-1)
    return Gaussian(mean, tril[..., given:, given:], log_scale=at.log_scale, validate_args=False)


def _gain(tril: Float[Array, "*batch dim dim"], given: int) -> Float[Array, "*batch kept given"]:
    """Regression of the later coordinates on the first: L_kg L_gg^-1."""
    return lax.linalg.triangular_solve(tril[..., :given, :given], tril[..., given:, :given], lower=True)


@eqx.filter_jit
def _each(function, panels: Panels, x: Float[Array, "sample batch"]) -> Float[Array, "sample batch"]:
    return jax.vmap(jax.vmap(function, in_axes=(None, 0)), in_axes=(0, 1), out_axes=1)(panels, x)


def _over(x: Array, batch: tuple[int, ...]) -> Array:
    return jnp.broadcast_to(x, (*batch, x.shape[-1]))


# --- one at a time: parents and values without batch --------------------------------------------------------


def _log_joint(parent, s):
    """tau -> log of the density of (s, tau), elementwise."""

    def log_f(tau):
        t = parent.time_loc + parent.time_scale * tau
        x = jnp.concatenate([_over(s, t.shape), t[..., None]], axis=-1)
        return parent.log_prob(x) + jnp.log(parent.time_scale)

    return log_f


def _guides(parent, s):
    """tau where mass may be: where the ridge passes s (peaks too narrow for a grid), and where the density peaks."""
    log_f, grid = _log_joint(parent, s), jnp.asarray(SEARCH_GRID, s.dtype)

    def at(tau):
        return parent.condition_time(parent.time_loc + parent.time_scale * tau)

    def nearness(tau):
        here = at(tau)
        return Gaussian(here.loc, here.base_tril, validate_args=False).log_prob(_over(s, tau.shape))

    near = peaks(nearness, grid, _CROSSINGS, score=lambda tau: -(tau**2))
    there = jnp.where(jnp.isnan(near), 0, near)
    # A ridge far out is high because it is narrow: its mass goes without the factor a^(-(d-1)/2).
    mass = jnp.where(jnp.isnan(near), -jnp.inf, log_f(there) + s.size * at(there).log_scale)
    return jnp.concatenate([near[lax.top_k(mass, _BEST)[1]], peaks(log_f, grid, _MAXIMA)])


def _space_panels(parent, s) -> tuple[Panels, Array]:
    log_f, search = _log_joint(parent, s), _log_joint(*lax.stop_gradient((parent, s)))
    panels = adaptive_panels(log_f, _guides(*lax.stop_gradient((parent, s))), search=search)
    return panels, jnp.where(diverges(search, panels), jnp.inf, panels.log_total)


def _modes(parent, s, panels: Panels):
    log_f = _log_joint(parent, s)
    grid = jnp.unique(panels.nodes.ravel(), size=panels.nodes.size, fill_value=REACH)
    found = peaks(log_f, grid, 2 * _MODES)
    height = jnp.where(jnp.isnan(found), -jnp.inf, log_f(jnp.where(jnp.isnan(found), 0, found)))
    return parent.time_loc + parent.time_scale * found[lax.top_k(height, _MODES)[1]]


def _tau_moments(panels: Panels):
    mean = panels.expectation(panels.nodes)
    return mean, panels.expectation((panels.nodes - mean) ** 2)


def _log_space_density(parent, s):
    panels, log_total = _space_panels(parent, s)
    error = panels.error_estimate + jnp.exp(_unresolved(*lax.stop_gradient((parent, s))) - log_total)
    return log_total, jnp.where(jnp.isposinf(log_total), jnp.inf, error)


def _unresolved(parent, s):
    """log of the mass where one space coordinate's curve passes s and is narrower than numbers lie apart.

    As a goes to 0 space is a curve, and the mass is that of tau over its speed: N(tau) / |ds / dtau|.
    """
    if s.size > 1:  # a curve in more dimensions passes a point by, at a distance; then no mass is there
        return jnp.asarray(-jnp.inf, s.dtype)

    def centre(tau):
        at = parent.condition_time(parent.time_loc + parent.time_scale * tau)
        return at.loc[..., 0], at.log_scale

    near = peaks(lambda tau: -jnp.abs(s[0] - centre(tau)[0]), jnp.asarray(SEARCH_GRID, s.dtype), _CROSSINGS)
    tau = jnp.where(jnp.isnan(near), 0, near)
    (place, log_scale), (speed, _) = jax.jvp(centre, (tau,), (jnp.ones_like(tau),))
    eps = jnp.finfo(s.dtype).eps
    width = jnp.exp(log_scale) * parent.scale_tril[0, 0] / jnp.abs(speed)
    passes = ~jnp.isnan(near) & (jnp.abs(s[0] - place) <= 1e3 * eps * (jnp.abs(s[0]) + jnp.abs(speed * tau)))
    log_mass = -0.5 * tau**2 - _HALF_LOG_2PI - jnp.log(jnp.abs(speed))
    return logsumexp(jnp.where(passes & (width < 1e3 * eps * jnp.abs(tau)), log_mass, -jnp.inf))


def _log_space_cdf(parent, s):
    """log of p(first coordinates) P(last coordinate <= its value | the first)."""

    def make(parent, s):
        given, tril = s.size - 1, parent.scale_tril
        first = parent.marginal((*range(given), s.size)) if given else None

        def log_f(tau):
            t = parent.time_loc + parent.time_scale * tau
            log_w = -0.5 * tau**2 - _HALF_LOG_2PI if first is None else _log_joint(first, s[:-1])(tau)
            one = conditional_gaussian(parent, _over(s[:-1], t.shape), t)
            residual = (s[-1] - one.loc[..., 0]) / tril[-1, -1]
            z = residual * jnp.exp(jnp.minimum(-one.log_scale, 0.9 * float(np.log(jnp.finfo(s.dtype).max))))
            return log_w + log_ndtr(z)

        return log_f

    frozen = lax.stop_gradient((parent, s))
    guides = _guides(*frozen)
    return adaptive_panels(make(parent, s), guides, search=make(*frozen)).log_total


def _mixture_moments(parent, values, panels: Panels):
    """Mean and covariance of (kept, time) given the values, by the laws of total mean and covariance."""
    t = parent.time_loc + parent.time_scale * panels.nodes
    dim = parent.event_shape[0] - 1 - values.size
    if not dim:
        y, within = t[..., None], jnp.zeros((1, 1), t.dtype)
    else:
        at = conditional_gaussian(parent, _over(values, t.shape), t)
        y = jnp.concatenate([at.loc, t[..., None]], axis=-1)
        tril = parent.scale_tril[values.size :, values.size :]
        mean_a = panels.expectation(jnp.exp(2 * at.log_scale))
        within = jnp.pad(mean_a * tril @ tril.T, ((0, 1), (0, 1)))
    mean = panels.expectation(y)
    centred = y - mean[None, None]
    return mean, within + panels.expectation(centred[..., :, None] * centred[..., None, :])
