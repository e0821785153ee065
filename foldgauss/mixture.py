"""Mixtures of Folded-Gaussians, and their conditional and marginal distributions.

At a time t a mixture of Folded-Gaussians is a mixture of Gaussians whose weights depend on t. Without time, or given
space but not time, it is a mixture of integrals over time. Labels such as eq:foldgauss are those of the LaTeX source
of the paper, arXiv:2411.11024. All classes share the methods of `AbstractMixture`:

| | `FoldedMixture` | `GaussianMixture` | `IntegratedMixture` |
|---|---|---|---|
| `condition`, time among the given | `GaussianMixture` | | `GaussianMixture` |
| `condition`, else | `IntegratedMixture` | `GaussianMixture` | `IntegratedMixture` |
| `marginal`, time kept | `FoldedMixture` (of time alone: `GaussianMixture`) | | `IntegratedMixture` |
| `marginal`, else | `IntegratedMixture` | `GaussianMixture` | `IntegratedMixture` |
| `time_given_space` | `TimePosterior` | | |
"""

import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, Key

from foldgauss._numerics.batch import (
    align,
    as_event,
    as_sample_shape,
    as_value,
    broadcast_leaves,
    expand_leaves,
    flatten_points,
)
from foldgauss._numerics.factor import normalize_indices
from foldgauss._runtime import notebook_hooks
from foldgauss._runtime.checks import invalid
from foldgauss.analysis.conditional import TimeDensity, TimeMixture
from foldgauss.analysis.interop import to_numpyro, to_scipy
from foldgauss.analysis.mixture_weights import (
    broadcast_weights,
    choose_components,
    log_component_densities,
    log_density,
    mixture_moments,
    posterior_logits,
    responsibilities,
    weighted_sum,
)
from foldgauss.analysis.pair_densities import map_in_chunks, move_components_first, pair_log_prob
from foldgauss.distribution import FoldedGaussian
from foldgauss.fold import CallableFold
from foldgauss.gaussian import Gaussian, Normal

__all__ = ["AbstractMixture", "FoldedMixture", "GaussianMixture", "IntegratedMixture", "TimePosterior"]

#: Pairs of a point and a component that are evaluated together: as many as a core's cache holds.
_CHUNK = 1 << 19


class AbstractMixture(eqx.Module):
    """A mixture `p(x) = sum_k w_k p_k(x)`: the methods that all mixture classes share.

    The last batch dimension of the components is k.

    **Shapes:** `components` with batch (*batch, k), `logits` (*batch, k); points are (..., d), time last where there is
    time.
    """

    components: eqx.AbstractVar[eqx.Module]
    logits: eqx.AbstractVar[Float[Array, "*batch k"]]

    has_rsample = False  #: the choice of a component is not reparameterized

    @property
    def event_shape(self) -> tuple[int, ...]:
        return self.components.event_shape

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return jnp.broadcast_shapes(self.components.batch_shape, self.logits.shape)[:-1]

    @property
    def num_components(self) -> int:
        """Number of components."""
        return self.logits.shape[-1]

    @property
    def log_weights(self) -> Float[Array, "*batch k"]:
        """Normalized log w_k, -inf where a weight is 0."""
        return jax.nn.log_softmax(self.logits, axis=-1)

    @property
    def weights(self) -> Float[Array, "*batch k"]:
        """w_k, which sum to 1."""
        return jnp.exp(self.log_weights)

    # --- densities ------------------------------------------------------------------------------------------

    def log_prob(self, value: Float[Array, "*#batch d"]) -> Float[Array, "*#batch"]:
        """log p(x) = log sum_k w_k p_k(x), finite or -inf. Many points are evaluated in chunks.

        **Shapes:** value (*sample, *batch, d), time (if any) last -> (*sample, *batch).

        **Example:** `mixture.log_prob(jnp.array([0.1, -0.2, 0.5]))`

        **Raises:** ValueError if the last dimension of value is not d.
        """
        return _reduce_pairs(log_density, self, self._checked(value))

    def pdf(self, value: Float[Array, "*#batch d"]) -> Float[Array, "*#batch"]:
        """p(x), shapes as in `log_prob`."""
        return jnp.exp(self.log_prob(value))

    def component_log_prob(self, value: Float[Array, "*#batch d"]) -> Float[Array, "*#batch k"]:
        """log p_k(x) of each component, without its weight. **Raises:** as `log_prob`.

        **Shapes:** value (*sample, *batch, d) -> (*sample, *batch, k).
        """
        return _reduce_pairs(log_component_densities, self, self._checked(value))

    def responsibilities(self, value: Float[Array, "*#batch d"]) -> Float[Array, "*#batch k"]:
        """P(component k | x) = w_k p_k(x) / p(x): they sum to 1.

        Where every component's density underflows, they equal the weights.

        **Shapes:** value (*sample, *batch, d) -> (*sample, *batch, k).

        **Example:** `mixture.responsibilities(x).argmax(-1)  # the likeliest component of each point`

        **Source:** Bayes' rule. **Raises:** as `log_prob`.
        """
        return _reduce_pairs(responsibilities, self, self._checked(value))

    def sample(
        self, key: Key[Array, ""], sample_shape: int | tuple[int, ...] = (), return_component: bool = False
    ) -> Float[Array, "..."] | tuple[Float[Array, "..."], Int[Array, "..."]]:
        """Random samples: first a component, then x from it; differentiable in the components' parameters.

        **Shapes:** -> (*sample_shape, *batch, d), and with `return_component` the component indices
        (*sample_shape, *batch); a number n as `sample_shape` is (n,).

        **Example:** `x, component = mixture.sample(jax.random.key(0), 1000, return_component=True)`
        """
        x, component = _sample(self, key, as_sample_shape(sample_shape))
        return (x, component) if return_component else x

    # --- moments --------------------------------------------------------------------------------------------

    @property
    def mean(self) -> Float[Array, "*batch d"]:
        """E x = sum_k w_k E_k x."""
        mean = _moments(self)[0]
        return mean if self.event_shape else mean[..., 0]

    @property
    def covariance_matrix(self) -> Float[Array, "*batch d d"]:
        """Cov x = sum_k w_k (Cov_k x + (E_k x - E x)(E_k x - E x)^T)."""
        return _moments(self)[1]

    @property
    def variance(self) -> Float[Array, "*batch d"]:
        """Var x per coordinate, as `covariance_matrix`."""
        variance = jnp.diagonal(self.covariance_matrix, axis1=-2, axis2=-1)
        return variance if self.event_shape else variance[..., 0]

    @property
    def stddev(self) -> Float[Array, "*batch d"]:
        """Standard deviations of the coordinates."""
        return jnp.sqrt(self.variance)

    def _checked(self, x) -> Array:
        return as_event("value", x, self.logits.dtype, self.event_shape)

    # --- interoperability -------------------------------------------------------------------------------------

    def to_numpyro(self, *, validate_args: bool | None = None):
        """This mixture as a numpyro distribution: see `foldgauss.analysis.interop.to_numpyro`."""
        return to_numpyro(self, validate_args=validate_args)

    def to_scipy(self):
        """This mixture as a frozen scipy distribution: see `foldgauss.analysis.interop.to_scipy`."""
        return to_scipy(self)


class _WeightedMixture(AbstractMixture):
    """A mixture that is constructed from components of the class `kind` and their weights."""

    kind: eqx.AbstractClassVar[type]

    def __init__(
        self,
        components: FoldedGaussian | Gaussian,
        *,
        logits: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        validate_args: bool = True,
    ):
        _check_components(components, self.kind)
        self.components, self.logits = broadcast_weights(components, logits, weights, validate_args)

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (*(rank + 1 for rank in self.components.leaf_ranks), 1)


class FoldedMixture(_WeightedMixture):
    """A mixture of Folded-Gaussians: `p(x) = sum_k w_k FN_k(x)`, x = (s, t), time last.

    **Shapes:** `components` a `FoldedGaussian` with batch shape (*batch, k); exactly one of `logits` and `weights`
    (*batch, k), normalized by `log_weights`: scaling the weights, or adding a constant to the logits, changes nothing.
    A weight of 0 is a logit of -inf: that component contributes exactly nothing and receives no gradient.

    **Example:**

        components = FoldedGaussian(jnp.zeros((2, 1)), scale=[[0.1], [0.2]], time_loc=[0.3, 0.7], time_scale=[0.2, 0.1])
        mixture = FoldedMixture(components, weights=[0.4, 0.6])
        x = mixture.sample(jax.random.key(0), (1000,))  # (1000, 2)
        mixture.condition_time(0.5).weights             # [0.83, 0.17]

    **Source:** a weighted sum of eq:foldgauss. **Raises:** ValueError that names the
    parameter: both or neither of logits and weights, wrong shapes, all weights 0, NaN.
    """

    components: FoldedGaussian
    logits: Float[Array, "*batch k"]
    kind: ClassVar[type] = FoldedGaussian

    def _repr_png_(self) -> bytes | None:
        """Notebook display: the density over time and space, by coordinates if there are several."""
        return notebook_hooks.show("distribution", self)

    def condition_time(self, t: Float[Array, "*#batch"]) -> "GaussianMixture":
        """Space at time t: the components at t, each with weight `w_k N(t; m_k, sigma_k^2)`, normalized.

        So far from all m_k that all of these underflow, the components keep their own weights.

        **Shapes:** t (*batch,), broadcast; the result has `event_shape == (d-1,)`.

        **Example:** `mixture.condition_time(0.25).pdf(jnp.zeros(2))`

        **Source:** eq:cond_dens and Bayes' rule.
        """
        return _at_time(self, as_value(t, self.logits.dtype))

    def expected_space(self, t: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        """E[s | t], the regression of space on time.

            E[s | t] = sum_k w_k(t) (m_k + f_k(m_t,k - t)),   w_k(t) ~ w_k N(t; m_t,k, sigma_k^2)

        **Shapes:** t (*sample, *batch) -> (*sample, *batch, d-1).

        **Example:** `mixture.expected_space(jnp.linspace(0.0, 1.0, 100))`

        **Source:** eq:cond_dens, by total expectation.
        """
        return self.condition_time(t).mean

    def space_covariance(self, t: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1 d-1"]:
        """Cov[s | t]: the mean covariance of the components at t, plus the covariance of their centers.

        **Shapes:** t (*sample, *batch) -> (*sample, *batch, d-1, d-1).

        **Example:** `mixture.space_covariance(0.25)`

        **Source:** eq:cond_dens, by total covariance.
        """
        return self.condition_time(t).covariance_matrix

    def marginal(self, indices) -> "FoldedMixture | GaussianMixture | IntegratedMixture":
        """The marginal mixture of the coordinates `indices`.

        If time is among them it is exact, a FoldedMixture (time alone: a GaussianMixture); otherwise it is integrated
        numerically.

        **Shapes:** `indices`: integers in the order of the result, time last; -1 is time.

        **Example:** `mixture.marginal([0, -1])  # first space coordinate, and time`

        **Source:** eq:integral_proof. **Raises:** ValueError on invalid indices.
        """
        return _mixture_of(self.components.marginal(indices), self.logits)

    def condition(self, indices, values: ArrayLike) -> "GaussianMixture | IntegratedMixture":
        """The other coordinates given these: the conditional components, with weights `w_k p_k(values)`, normalized.

        If time is given it is exact, a GaussianMixture; otherwise it is integrated numerically.

        **Shapes:** `indices`: n integers, -1 is time; `values` (*batch, n) in the same order; the result has the
        other coordinates in ascending order. For one coordinate a number will do: `mixture.condition(-1, 0.5)`.

        **Example:** `mixture.condition([0], [0.3]).sample(key)  # the other space coordinates, and time`

        **Source:** eq:cond_dens and Bayes' rule. **Raises:** ValueError on invalid indices, all indices, or a wrong
        shape of values.
        """
        return _condition(self, indices, values)

    def time_given_space(self, s: Float[Array, "*#batch d-1"]) -> "TimePosterior":
        """The density of time given space, p(t | s), by quadrature.

        **Shapes:** s (*batch, d-1); the result has `event_shape == ()`.

        **Example:** `mixture.time_given_space([0.1, -0.4]).mean`

        **Source:** Bayes' rule on eq:foldgauss. **Raises:** ValueError if the last dimension of s is not d-1.
        """
        s = as_event("s", s, self.logits.dtype, (self.event_shape[0] - 1,))
        components = self.components.time_given_space(s[..., None, :])
        return TimePosterior(components, posterior_logits(self.log_weights, components.log_normalizer))


class GaussianMixture(_WeightedMixture):
    """A mixture of Gaussians: a `FoldedMixture` at one time.

    **Shapes:** `components` a `Gaussian` with batch shape (*batch, k); exactly one of `logits` and `weights`
    (*batch, k), as in `FoldedMixture`.

    **Example:** `mixture.condition_time(0.5).sample(jax.random.key(0), (1000,))`

    **Source:** eq:cond_dens for each component, with Bayes' rule. **Raises:** as `FoldedMixture`.
    """

    components: Gaussian
    logits: Float[Array, "*batch k"]
    kind: ClassVar[type] = Gaussian

    def marginal(self, indices) -> "GaussianMixture":
        """The marginal mixture of the coordinates `indices`, as `FoldedMixture.marginal`; exact."""
        return _mixture_of(self.components.marginal(indices), self.logits)

    def condition(self, indices, values: ArrayLike) -> "GaussianMixture":
        """The other coordinates, in ascending order, given these; exact. As `FoldedMixture.condition`."""
        return _condition(self, indices, values)

    def cdf(self, x: Float[Array, "*#batch 1"]) -> Float[Array, "*#batch"]:
        """P(coordinate <= x), for a single coordinate. **Raises:** ValueError if there are several."""
        return _cdf(self.weights, _as_normal(self.components), self._checked(x)[..., 0])

    def icdf(self, q: Float[Array, "*#batch"]) -> Float[Array, "*#batch 1"]:
        """The quantile of a single coordinate, the inverse of `cdf`, as `TimePosterior.icdf`. **Raises:** as `cdf`."""
        return _icdf(self.weights, _as_normal(self.components), as_value(q, self.logits.dtype))[..., None]


class IntegratedMixture(AbstractMixture):
    """A mixture of `TimeMixture`: some coordinates of a `FoldedMixture`, its time integrated out numerically.

    Made by `FoldedMixture.marginal` (time dropped) and `FoldedMixture.condition` (time not given).

    **Shapes:** `components` with batch shape (*batch, k), `logits` (*batch, k); `event_shape == (n,)`, n coordinates
    kept, time (if kept) last.

    **Example:** `mixture.marginal([0]).cdf(jnp.array([0.3]))`

    **Source:** eq:foldgauss, integrated, for each component. **Raises:** as `TimeMixture`.
    """

    components: TimeMixture
    logits: Float[Array, "*batch k"]

    def cdf(self, value: Float[Array, "*#batch 1"]) -> Float[Array, "*#batch"]:
        """P(coordinate <= x | given), for a single coordinate. **Raises:** ValueError if there are several."""
        return weighted_sum(self.weights, self.components.cdf(_add_component_axis(self, self._checked(value))))

    def error_estimate(self, x: Float[Array, "*#batch n"]) -> Float[Array, "*#batch"]:
        """Estimated relative error of `pdf(x)`: those of the components, weighted by responsibility."""
        x = self._checked(x)
        return weighted_sum(self.responsibilities(x), self.components.error_estimate(_add_component_axis(self, x)))

    def marginal(self, indices) -> "IntegratedMixture":
        """The marginal mixture of the coordinates `indices`. **Raises:** ValueError on invalid indices."""
        return _mixture_of(self.components.marginal(indices), self.logits)

    def condition(self, indices, values: ArrayLike) -> "IntegratedMixture | GaussianMixture":
        """The other coordinates given these, as `FoldedMixture.condition`; exact if time is given."""
        return _condition(self, indices, values)


class TimePosterior(AbstractMixture):
    """The density of t given space, `p(t | s) = sum_k P(k | s) p_k(t | s)`: a mixture of `TimeDensity`.

    Made by `FoldedMixture.time_given_space`; `weights` are P(k | s). If p_k(s) diverges for some components, these
    share all the weight equally.

    **Shapes:** `components` with batch shape (*batch, k), `logits` (*batch, k); `event_shape == ()`: values have shape
    (*sample, *batch); mean and variance (*batch,), `covariance_matrix` is (*batch, 1, 1).

    **Example:** `mixture.time_given_space([0.3, 0.1]).icdf(0.5)  # the median`

    **Source:** Bayes' rule on eq:foldgauss.
    """

    components: TimeDensity
    logits: Float[Array, "*batch k"]

    @property
    def error_estimate(self) -> Float[Array, "*batch"]:
        """Estimated relative error of p(s), and hence of every density and probability."""
        return weighted_sum(self.weights, self.components.error_estimate)

    def cdf(self, value: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """P(time <= t | s)."""
        return _cdf(self.weights, self.components, self._checked(value))

    def icdf(self, q: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """The quantile, the inverse of `cdf`, by bisection; -inf at 0 and +inf at 1. It has no gradient."""
        return _icdf(self.weights, self.components, self._checked(q))


def _mixture_of(components, logits: Array) -> AbstractMixture:
    """The mixture class that fits the components."""
    if isinstance(components, FoldedGaussian | Gaussian):
        kind = FoldedMixture if isinstance(components, FoldedGaussian) else GaussianMixture
        return kind(components, logits=logits, validate_args=False)
    return IntegratedMixture(components, logits)


# --- construction --------------------------------------------------------------------------------------------


def _check_components(components, kind: type) -> None:
    if not isinstance(components, kind):
        expected = f"one {kind.__name__} of batch shape (*batch, k)"
        cure = "Its last batch dimension is the components."
        raise invalid("components", expected=expected, got=type(components).__name__, cure=cure)
    if components.batch_shape[-1:] in ((), (0,)):
        cure = "Give its parameters a leading dimension of k: jax.tree.map(lambda *x: jnp.stack(x), *components)."
        raise invalid("components", expected="batch shape (*batch, k)", got=components.batch_shape, cure=cure)


# --- densities -----------------------------------------------------------------------------------------------


def _reduce_pairs(function, mixture: AbstractMixture, x: Array) -> Array:
    """Return `function(log w_k, log p_k(x), axis)` of `mixture_weights`. The components are along `axis`."""
    if isinstance(mixture.components, TimeMixture):  # whose integrals are programs of their own, which are shared
        log_components = mixture.components.log_prob(_add_component_axis(mixture, x))
        return _reduce_last(function, mixture.log_weights, log_components)
    return _map_pairs(function, mixture, x)


@eqx.filter_jit
def _reduce_last(function, log_weights: Array, log_components: Array) -> Array:
    return function(log_weights, log_components, -1)


@eqx.filter_jit
def _map_pairs(function, mixture: AbstractMixture, x: Array) -> Array:
    """In chunks, of log weights (k, 1, *batch) and log p_k(x) (k, n, *batch); results start with (n, *batch)."""
    rank, components = len(mixture.batch_shape), mixture.components
    rows, restore = flatten_points(x, mixture.batch_shape, mixture.event_shape)
    if isinstance(components, FoldedGaussian | Gaussian):
        components = move_components_first(components, rank)
        pairs = lambda rows: pair_log_prob(components, rows)  # noqa: E731
    else:
        pairs = lambda rows: jnp.moveaxis(components.log_prob(_add_component_axis(mixture, rows)), -1, 0)  # noqa: E731
    log_weights = jnp.expand_dims(jnp.moveaxis(mixture.log_weights, rank, 0), 1)
    size = max(1, _CHUNK // (math.prod(mixture.batch_shape) * mixture.num_components))
    return restore(map_in_chunks(pairs, lambda log_p: function(log_weights, log_p, 0), rows, size))


def _add_component_axis(mixture: AbstractMixture, x: Array) -> Array:
    return jnp.expand_dims(x, x.ndim - len(mixture.event_shape))


# --- conditional distributions -------------------------------------------------------------------------------


@eqx.filter_jit
def _at_time(mixture: FoldedMixture, t: Array) -> GaussianMixture:
    t = t[..., None]
    log_time = mixture.components.time_marginal.log_prob(t)
    logits = posterior_logits(mixture.log_weights, log_time)
    return GaussianMixture(mixture.components.condition_time(t), logits=logits, validate_args=False)


def _condition(mixture: AbstractMixture, indices, values: ArrayLike):
    indices = normalize_indices(indices, mixture.event_shape[0])
    values = as_event("values", values, mixture.logits.dtype, (len(indices),))[..., None, :]
    rest = mixture.components.condition(indices, values)
    log_evidence = _log_evidence(mixture.components, rest, indices, values)
    return _mixture_of(rest, posterior_logits(mixture.log_weights, log_evidence))


def _log_evidence(components, rest, indices: tuple[int, ...], values: Array) -> Array:
    """log p_k(values); `rest` is the components given the values."""
    if isinstance(rest, TimeMixture):  # holds the integral already, over these values and those given before
        log_given = rest.time.log_normalizer
        if not isinstance(components, TimeMixture) or components.time is None:
            return log_given
        before = components.time.log_normalizer
        return jnp.where(jnp.isneginf(log_given), -jnp.inf, log_given - jnp.broadcast_to(before, log_given.shape))
    order = np.argsort(indices)  # puts time last
    return components.marginal(tuple(indices[i] for i in order)).log_prob(values[..., order])


def _as_normal(components: Gaussian) -> Normal:
    if components.event_shape != (1,):
        got = f"event_shape {components.event_shape}"
        raise invalid("mixture", expected="a single coordinate", got=got, cure="Take marginal([i]) first.")
    stddev = components.stddev[..., 0]  # 0 where it underflows, far from a component's time
    return Normal(components.loc[..., 0], jnp.maximum(stddev, float(jnp.finfo(stddev.dtype).tiny)), validate_args=False)


@eqx.filter_jit
def _cdf(weights: Array, components: Normal | TimeDensity, t: Array) -> Array:
    return jnp.clip(weighted_sum(weights, components.cdf(t[..., None])), 0, 1)


@eqx.filter_jit
def _icdf(weights: Array, components: Normal | TimeDensity, q: Array) -> Array:
    """Bisection between the least and the greatest of the components' quantiles."""
    quantiles = lax.stop_gradient(components.icdf(q[..., None]))
    (aligned,) = align([(weights, 0)], quantiles.ndim)
    low = jnp.where(aligned > 0, quantiles, jnp.inf).min(-1)
    high = jnp.where(aligned > 0, quantiles, -jnp.inf).max(-1)
    q = jnp.broadcast_to(q, low.shape)

    def halve(_, bounds):
        low, high = bounds
        middle = low + 0.5 * (high - low)
        below = _cdf(weights, components, middle) < q
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    steps = jnp.finfo(q.dtype).nmant + 8
    inner = jnp.isfinite(low) & jnp.isfinite(high)
    found = lax.fori_loop(0, steps, halve, (jnp.where(inner, low, 0), jnp.where(inner, high, 0)))[1]
    return lax.stop_gradient(jnp.where(jnp.isnan(aligned).any(-1), jnp.nan, jnp.where(inner, found, low)))


# --- sampling ------------------------------------------------------------------------------------------------


@eqx.filter_jit
def _sample(mixture: AbstractMixture, key, sample_shape: tuple[int, ...]):
    choice_key, key = jax.random.split(key)
    component = choose_components(choice_key, mixture.weights, (*sample_shape, *mixture.batch_shape))
    return _sample_from(mixture, key, sample_shape, component), component


def _sample_from(mixture: AbstractMixture, key, sample_shape, component: Array) -> Array:
    """One sample from each of the chosen components."""
    components, batch = mixture.components, mixture.batch_shape
    single = mixture.num_components == 1
    if isinstance(components, FoldedGaussian | Gaussian) and not single and not _shares_parameters(components):
        if isinstance(components, Gaussian) or not components.fold.shares_leaves:
            components = broadcast_leaves(components, (*batch, mixture.num_components))
        return _take_components(components, component, batch).sample(key)
    every = components.sample(key, sample_shape)
    event = every.ndim - component.ndim - 1
    index = jnp.expand_dims(component, range(component.ndim, every.ndim))
    return jnp.take_along_axis(every, index, axis=every.ndim - event - 1).squeeze(every.ndim - event - 1)


def _shares_parameters(components) -> bool:
    """Whether gathering one component's parameters per sample would copy a network each time."""
    return isinstance(getattr(components, "fold", None), CallableFold)


def _take_components(components, component: Array, batch: tuple[int, ...]):
    """The components at the indices `component`, of batch shape `component.shape`; shared leaves stay as they are."""
    size, rank = math.prod(batch), len(batch)
    flat = component.reshape(-1, size)
    place = jnp.arange(size)[None]

    def pick(leaf):
        if set(leaf.shape[: rank + 1]) == {1}:
            return leaf.reshape(*(1,) * component.ndim, *leaf.shape[rank + 1 :])
        rows = jnp.broadcast_to(leaf, (*batch, *leaf.shape[rank:])).reshape(size, *leaf.shape[rank:])
        return rows[jnp.broadcast_to(place, flat.shape), flat].reshape(*component.shape, *leaf.shape[rank + 1 :])

    return jax.tree.map(pick, expand_leaves(components, rank + 1))


# --- moments -------------------------------------------------------------------------------------------------


def _moments(mixture: AbstractMixture) -> tuple[Array, Array]:
    components = mixture.components
    if isinstance(components, Gaussian):
        return _gaussian_moments(mixture)
    if isinstance(components, FoldedGaussian):
        found = components.moments()
    elif isinstance(components, TimeDensity):
        found = components.mean[..., None], components.variance[..., None, None]
    else:
        found = components.mean, components.covariance_matrix
    return _mixture_moments(mixture.weights, *found)


_mixture_moments = jax.jit(mixture_moments)


@eqx.filter_jit
def _gaussian_moments(mixture: AbstractMixture) -> tuple[Array, Array]:
    return mixture_moments(mixture.weights, mixture.components.mean, mixture.components.covariance_matrix)
