"""Entropy and divergence by Monte Carlo, with standard errors, where no formula exists: mixtures, across classes."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from foldgauss._runtime.checks import invalid, is_integer

__all__ = ["Estimate", "entropy_bounds", "estimate_entropy", "estimate_kl_divergence"]


class Estimate(NamedTuple):
    """A Monte Carlo estimate and its standard error, (*batch,) each."""

    value: Float[Array, "*batch"]
    standard_error: Float[Array, "*batch"]


def estimate_entropy(dist, key: Key[Array, ""], num_samples: int = 10_000) -> Estimate:
    """The differential entropy -E log p(x) in nats, by the mean over samples.

    **Shapes:** `dist` with batch (*batch,) -> (*batch,). **Example:** `estimate_entropy(mixture, jax.random.key(0))`

    **Source:** Huber et al. 2008. **Raises:** ValueError for fewer than two samples.
    """
    _check_num_samples(num_samples)
    return _mean_of(-dist.log_prob(dist.sample(key, (num_samples,))))


def estimate_kl_divergence(p, q, key: Key[Array, ""], num_samples: int = 10_000) -> Estimate:
    """KL(p, q) = E_p[log p(x) - log q(x)] in nats, by the mean over samples of p; +inf where q is 0 at one of them.

    For any two distributions of one event shape. The error of the mean underestimates that of the estimate where q has
    much lighter tails than p.

    **Shapes:** batches broadcast -> (*batch,). **Raises:** ValueError for different event shapes or fewer than two
    samples.
    """
    _check_num_samples(num_samples)
    if p.event_shape != q.event_shape:
        raise invalid("q", expected=f"the event shape of p, {p.event_shape}", got=q.event_shape)
    x = p.sample(key, (num_samples,))
    extra = max(len(q.batch_shape) - len(p.batch_shape), 0)
    x = x.reshape(num_samples, *(1,) * extra, *x.shape[1:])  # samples lead, whatever the batch of q
    return _mean_of(p.log_prob(x) - q.log_prob(x))


def entropy_bounds(mixture) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Bounds of the differential entropy of a mixture, in nats, by the entropies H_k of its components.

        sum_k w_k H_k <= H <= sum_k w_k (H_k - log w_k)

    Equal to the lower bound where all components are the same, to the upper one where they do not overlap.

    **Shapes:** a mixture with batch (*batch,) -> (*batch,) each. **Source:** the entropy is concave; Huber et al. 2008.
    """
    weights, components = mixture.weights, mixture.components
    lower = (weights * components.entropy()).sum(-1)
    return lower, lower - (weights * jnp.where(weights > 0, mixture.log_weights, 0)).sum(-1)


def _mean_of(values: Float[Array, "num_samples ..."]) -> Estimate:
    return Estimate(values.mean(0), values.std(0, ddof=1) / jnp.sqrt(jnp.asarray(len(values), values.dtype)))


def _check_num_samples(num_samples: int) -> None:
    if not is_integer(num_samples, 2):
        raise invalid("num_samples", expected="a whole number >= 2", got=repr(num_samples))
