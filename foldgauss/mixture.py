"""Mixtures of Folded-Gaussians, and their conditional and marginal distributions.

At a time t a mixture of Folded-Gaussians is a mixture of Gaussians whose weights depend on t. Without time, or given
space but not time, it is a mixture of integrals over time. Labels such as eq:foldgauss are those of the LaTeX source
of the paper, arXiv:2411.11024. The results are of the class `Mixture`, with components of these classes:

| | of a `FoldedMixture` | of a mixture of `Gaussian` | of a mixture of `TimeMixture` |
|---|---|---|---|
| `condition`, time among the given | `Gaussian` | | `Gaussian` |
| `condition`, else | `TimeMixture` | `Gaussian` | `TimeMixture` |
| `marginal`, time kept | a `FoldedMixture` (of time alone: `Gaussian`) | | `TimeMixture` |
| `marginal`, else | `TimeMixture` | `Gaussian` | `TimeMixture` |
| `time_given_space` | `TimeMixture` | | |
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, Key

from foldgauss._numerics.abstract import AbstractDistribution
from foldgauss._numerics.batch import as_event, as_sample_shape, as_value, bisect, flatten_points, vectorize
from foldgauss._numerics.factor import normalize_indices
from foldgauss._runtime.checks import require
from foldgauss.analysis.conditional import TimeMixture
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

__all__ = ["FoldedMixture", "Mixture"]

#: Pairs of a point and a component that are evaluated together: as many as a core's cache holds.
_CHUNK = 1 << 19


class Mixture(AbstractDistribution):
    """A mixture `p(x) = sum_k w_k p_k(x)` of distributions of any class.

    **Shapes:** `components` one distribution with batch shape (*batch, k); exactly one of `logits` and `weights`
    (*batch, k), normalized by `log_weights`: scaling the weights, or adding a constant to the logits, changes nothing.
    A weight of 0 is a logit of -inf: that component contributes exactly nothing and receives no gradient. Points are
    (..., d), time last where there is time.

    **Example:** `Mixture(Gaussian([[0.0], [1.0]], jnp.eye(1)), weights=[0.3, 0.7]).log_prob([0.5])`

    **Raises:** ValueError that names the parameter: both or neither of logits and weights, wrong shapes, all weights 0,
    NaN.
    """

    components: AbstractDistribution
    logits: Float[Array, "*batch k"]

    has_rsample = False  #: the choice of a component is not reparameterized

    def __init__(
        self,
        components: AbstractDistribution,
        *,
        logits: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        validate_args: bool = True,
    ):
        require(
            components.batch_shape[-1:] not in ((), (0,)),
            "components",
            expected="batch shape (*batch, k)",
            got=components.batch_shape,
            cure="Give its parameters a leading dimension of k: jax.tree.map(lambda *x: jnp.stack(x), *components).",
        )
        self.components, self.logits = broadcast_weights(components, logits, weights, validate_args)

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (*(rank + 1 for rank in self.components.leaf_ranks), 1)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return self.components.event_shape

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return jnp.broadcast_shapes(self.components.batch_shape, self.logits.shape)[:-1]

    @property
    def dtype(self):
        return self.logits.dtype

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

    def _log_prob(self, value: Array) -> Array:
        return _reduce_pairs(log_density, self, value)

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

    def error_estimate(self, x: Float[Array, "*#batch n"]) -> Float[Array, "*#batch"]:
        """Estimated relative error of `pdf(x)`, if the components are integrals: theirs, by responsibility."""
        x = self._checked(x)
        return weighted_sum(self.responsibilities(x), self.components.error_estimate(_add_component_axis(self, x)))

    def cdf(self, value: Float[Array, "..."]) -> Float[Array, "*#batch"]:
        """P(coordinate <= x), of a single coordinate. **Raises:** ValueError if there are several."""
        return _cdf(self, self._checked(value))

    def icdf(self, q: Float[Array, "*#batch"]) -> Float[Array, "..."]:
        """The quantile of a single coordinate, by bisection; -inf at 0 and +inf at 1. It has no gradient.

        **Raises:** ValueError if there are several coordinates.
        """
        return _icdf(self, as_value(q, self.dtype))

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

    def moments(self) -> tuple[Float[Array, "*batch d"], Float[Array, "*batch d d"]]:
        """E x = sum_k w_k E_k x, and Cov x = sum_k w_k (Cov_k x + (E_k x - E x)(E_k x - E x)^T)."""
        return _mixture_moments(self.weights, *self.components.moments())

    # --- conditional distributions ----------------------------------------------------------------------------

    def marginal(self, indices) -> "Mixture":
        """The marginal mixture of the coordinates `indices`.

        If time is among them it is exact; otherwise it is integrated numerically, see the table of this module.

        **Shapes:** `indices`: integers in the order of the result, time last; -1 is time.

        **Example:** `mixture.marginal([0, -1])  # first space coordinate, and time`

        **Source:** eq:integral_proof. **Raises:** ValueError on invalid indices.
        """
        return _mixture_of(self.components.marginal(indices), self.logits)

    def condition(self, indices, values: ArrayLike) -> "Mixture":
        """The other coordinates given these: the conditional components, with weights `w_k p_k(values)`, normalized.

        If time is given it is exact, a mixture of Gaussians; otherwise it is integrated numerically.

        **Shapes:** `indices`: n integers, -1 is time; `values` (*batch, n) in the same order; the result has the
        other coordinates in ascending order. For one coordinate a number will do: `mixture.condition(-1, 0.5)`.

        **Example:** `mixture.condition([0], [0.3]).sample(key)  # the other space coordinates, and time`

        **Source:** eq:cond_dens and Bayes' rule. **Raises:** ValueError on invalid indices, all indices, or a wrong
        shape of values.
        """
        indices = normalize_indices(indices, self.event_shape[0])
        values = as_event("values", values, self.dtype, (len(indices),))[..., None, :]
        rest = self.components.condition(indices, values)
        log_evidence = self.components.log_evidence(indices, values, rest)
        return _mixture_of(rest, posterior_logits(self.log_weights, log_evidence))


class FoldedMixture(Mixture):
    """A mixture of Folded-Gaussians: `p(x) = sum_k w_k FN_k(x)`, x = (s, t), time last.

    **Shapes:** `components` a `FoldedGaussian` with batch shape (*batch, k), `logits` or `weights` (*batch, k), as in
    `Mixture`.

    **Example:**

        components = FoldedGaussian(jnp.zeros((2, 1)), scale=[[0.1], [0.2]], time_loc=[0.3, 0.7], time_scale=[0.2, 0.1])
        mixture = FoldedMixture(components, weights=[0.4, 0.6])
        x = mixture.sample(jax.random.key(0), (1000,))  # (1000, 2)
        mixture.condition_time(0.5).weights             # [0.83, 0.17]

    **Source:** a weighted sum of eq:foldgauss. **Raises:** ValueError as `Mixture`.
    """

    components: FoldedGaussian

    def __check_init__(self):
        require(
            isinstance(self.components, FoldedGaussian),
            "components",
            expected="one FoldedGaussian of batch shape (*batch, k)",
            got=type(self.components).__name__,
            cure="Mixture takes components of any class.",
        )

    def condition_time(self, t: Float[Array, "*#batch"]) -> Mixture:
        """Space at time t: the components at t, each with weight `w_k N(t; m_k, sigma_k^2)`, normalized.

        So far from all m_k that all of these underflow, the components keep their own weights. Its `mean` is E[s | t],
        the regression of space on time, and its `covariance_matrix` Cov[s | t].

        **Shapes:** t (*batch,), broadcast; the result has `event_shape == (d-1,)`.

        **Example:** `mixture.condition_time(0.25).pdf(jnp.zeros(2))`

        **Source:** eq:cond_dens and Bayes' rule.
        """
        return _at_time(self, as_value(t, self.dtype))

    def time_given_space(self, s: Float[Array, "*#batch d-1"]) -> Mixture:
        """The density of time given space, p(t | s) = sum_k P(k | s) p_k(t | s), by quadrature.

        `weights` are P(k | s). If p_k(s) diverges for some components, these share all the weight equally.

        **Shapes:** s (*batch, d-1); the result has `event_shape == (1,)`.

        **Example:** `mixture.time_given_space([0.1, -0.4]).mean`

        **Source:** Bayes' rule on eq:foldgauss. **Raises:** ValueError if the last dimension of s is not d-1.
        """
        dim = self.event_shape[0] - 1
        return self.condition(range(dim), as_event("s", s, self.dtype, (dim,)))


def _mixture_of(components: AbstractDistribution, logits: Array) -> Mixture:
    kind = FoldedMixture if isinstance(components, FoldedGaussian) else Mixture
    return kind(components, logits=logits, validate_args=False)


# --- densities -----------------------------------------------------------------------------------------------


def _reduce_pairs(function, mixture: Mixture, x: Array) -> Array:
    """Return `function(log w_k, log p_k(x), axis)` of `mixture_weights`. The components are along `axis`."""
    if isinstance(mixture.components, TimeMixture):  # whose integrals are programs of their own, which are shared
        log_components = mixture.components.log_prob(_add_component_axis(mixture, x))
        return _reduce_last(function, mixture.log_weights, log_components)
    return _map_pairs(function, mixture, x)


@eqx.filter_jit
def _reduce_last(function, log_weights: Array, log_components: Array) -> Array:
    return function(log_weights, log_components, -1)


@eqx.filter_jit
def _map_pairs(function, mixture: Mixture, x: Array) -> Array:
    """In chunks, of log weights (k, 1, *batch) and log p_k(x) (k, n, *batch); results start with (n, *batch)."""
    rank = len(mixture.batch_shape)
    rows, restore = flatten_points(x, mixture.batch_shape, mixture.event_shape)
    components = move_components_first(mixture.components, rank)
    log_weights = jnp.expand_dims(jnp.moveaxis(mixture.log_weights, rank, 0), 1)
    size = max(1, _CHUNK // (math.prod(mixture.batch_shape) * mixture.num_components))
    pairs = lambda rows: pair_log_prob(components, rows)  # noqa: E731
    return restore(map_in_chunks(pairs, lambda log_p: function(log_weights, log_p, 0), rows, size))


def _add_component_axis(mixture: Mixture, x: Array) -> Array:
    return x[..., None, :]


@eqx.filter_jit
def _at_time(mixture: FoldedMixture, t: Array) -> Mixture:
    t = t[..., None]
    logits = posterior_logits(mixture.log_weights, mixture.components.marginal([-1]).log_prob(t[..., None]))
    return Mixture(mixture.components.condition_time(t), logits=logits, validate_args=False)


@eqx.filter_jit
def _cdf(mixture: Mixture, x: Array) -> Array:
    return jnp.clip(weighted_sum(mixture.weights, mixture.components.cdf(_add_component_axis(mixture, x))), 0, 1)


def _to_ordinal(x: Array) -> Array:
    """Unsigned integers in the order of the floats x, of as many bits: neighbors differ by 1."""
    bits = lax.bitcast_convert_type(x, jnp.dtype(f"uint{8 * x.itemsize}"))
    return jnp.where(jnp.signbit(x), ~bits, bits | bits.dtype.type(1 << (8 * x.itemsize - 1)))


def _from_ordinal(ordinal: Array, dtype) -> Array:
    top = ordinal.dtype.type(1 << (8 * ordinal.itemsize - 1))
    return lax.bitcast_convert_type(jnp.where(ordinal >= top, ordinal ^ top, ~ordinal), dtype)


@eqx.filter_jit
def _icdf(mixture: Mixture, q: Array) -> Array:
    """Bisection between the least and the greatest of the components' quantiles, over all floats between them.

    Halving the interval itself would not get near a quantile about 0 between components that are far apart.
    """
    weights, quantiles = mixture.weights, lax.stop_gradient(mixture.components.icdf(q[..., None]))[..., 0]

    def ends(weights, quantiles):
        low, high = jnp.where(weights > 0, quantiles, jnp.inf).min(), jnp.where(weights > 0, quantiles, -jnp.inf).max()
        return low, high, jnp.isnan(weights).any()

    low, high, is_nan = vectorize(ends, (weights, 1), (quantiles, 1))
    q = jnp.broadcast_to(q, low.shape)

    inner, bits = jnp.isfinite(low) & jnp.isfinite(high), jnp.finfo(q.dtype).bits
    ends = (_to_ordinal(jnp.where(inner, end, 0)) for end in (low, high))
    found = bisect(lambda n: _cdf(mixture, _from_ordinal(n, q.dtype)[..., None]) < q, *ends, bits)[1]
    found = _from_ordinal(found, q.dtype)
    return lax.stop_gradient(jnp.where(is_nan, jnp.nan, jnp.where(inner, found, low)))[..., None]


@eqx.filter_jit
def _sample(mixture: Mixture, key, sample_shape: tuple[int, ...]):
    choice_key, key = jax.random.split(key)
    component = choose_components(choice_key, mixture.weights, (*sample_shape, *mixture.batch_shape))
    return mixture.components._sample_from(key, sample_shape, component), component


_mixture_moments = jax.jit(mixture_moments)
