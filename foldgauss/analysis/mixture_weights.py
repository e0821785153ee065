"""Weights of mixture components: checks, posterior weights, weighted sums and random choice.

A component is absent if its weight is 0 (a logit of -inf). Whatever its density or its moments are, it contributes
nothing, and it receives no gradient.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike

from foldgauss._numerics.batch import align, broadcast_leaves, check_batch, check_values, ranked_leaves
from foldgauss._runtime.checks import require


def broadcast_weights(components, logits: ArrayLike | None, weights: ArrayLike | None, validate: bool):
    """Components and logits, both broadcast to the common batch shape."""
    require(
        (logits is None) != (weights is None),
        "logits, weights",
        expected="exactly one of them",
        got="none" if logits is None else "both",
        cure="logits are log weights.",
    )
    name, given = ("weights", weights) if logits is None else ("logits", logits)
    given = jnp.asarray(given, components.dtype)
    require(
        given.shape[-1:] == components.batch_shape[-1:],
        name,
        expected=f"shape (*batch, {components.batch_shape[-1]})",
        got=f"shape {given.shape}",
        cure="One value for each component.",
    )
    if validate:
        _check_weights(name, given)
    batch = check_batch([*ranked_leaves(components), (given, 0)])
    if batch != components.batch_shape:
        components = broadcast_leaves(components, batch)
    given = jnp.broadcast_to(given, batch)
    return components, given if name == "logits" else _log_weights(given)


def _check_weights(name: str, given: Array) -> None:
    least, expected = (0, "finite values >= 0") if name == "weights" else (-np.inf, "values below infinity")
    cure = "A component without weight has weight 0, or a logit of -inf."
    check_values(name, given, lambda x: (x >= least) & (x < np.inf), expected, cure)
    # JAX computes with those below as with 0; with float16 and bfloat16 it computes in float32.
    normal = float(min(jnp.finfo(given.dtype).tiny, jnp.finfo(jnp.float32).tiny))
    cure = "Weights are relative: divide by the largest; all equal means 1/k."
    present = lambda x: (x >= normal if name == "weights" else x > least).any(-1)  # noqa: E731
    check_values(name, given, present, f"a positive weight, of at least {normal:g}", cure)


def _log_weights(weights: Array) -> Array:
    """log w, -inf at 0 with no gradient there."""
    present = weights > 0
    return jnp.where(present, jnp.log(jnp.where(present, weights, 1)), -jnp.inf)


def _log_joint(log_weights: Array, log_components: Array) -> Array:
    """log w_k p_k, -inf where the component is absent, whatever its density."""
    (log_weights,) = align([(log_weights, 0)], log_components.ndim)
    absent = jnp.isneginf(log_weights)
    # Double where: an absent component passes no gradient.
    return jnp.where(absent, -jnp.inf, jnp.where(absent, 0, log_weights) + jnp.where(absent, 0, log_components))


def posterior_logits(log_weights: Array, log_evidence: Array, axis: int = -1) -> Array:
    """log w_k p_k; log w_k where all p_k are 0. Where some p_k are infinite, they share all the weight equally."""
    joint = _log_joint(log_weights, log_evidence)
    infinite = jnp.isposinf(joint)
    joint = jnp.where(infinite.any(axis, keepdims=True), jnp.where(infinite, 0, -jnp.inf), joint)
    all_zero = jnp.isneginf(joint).all(axis, keepdims=True)
    (log_weights,) = align([(log_weights, 0)], joint.ndim)
    return jnp.where(all_zero, log_weights, joint)


def _log_sum_exp(joint: Array, axis: int) -> Array:
    """logsumexp whose gradient is 0 where all terms are -inf; +inf stays +inf."""
    largest = lax.stop_gradient(joint.max(axis, keepdims=True))
    usable = jnp.isfinite(largest)
    shifted = jnp.where(usable, joint - jnp.where(usable, largest, 0), 0)
    return jnp.where(usable, jnp.log(jnp.exp(shifted).sum(axis, keepdims=True)) + largest, largest).squeeze(axis)


def log_component_densities(log_weights: Array, log_components: Array, axis: int) -> Array:
    """log p_k, with the components last."""
    return jnp.moveaxis(log_components, axis, -1)


def log_density(log_weights: Array, log_components: Array, axis: int) -> Array:
    """log sum_k w_k p_k."""
    return _log_sum_exp(_log_joint(log_weights, log_components), axis)


def responsibilities(log_weights: Array, log_components: Array, axis: int) -> Array:
    """w_k p_k / sum_j w_j p_j, with the components last."""
    joint = posterior_logits(log_weights, log_components, axis)
    return jnp.moveaxis(jax.nn.softmax(joint, axis=axis), axis, -1)


def weighted_sum(weights: Array, values: Array, event_rank: int = 0) -> Array:
    """sum_k w_k x_k over values (*batch, k, *event). Absent components are ignored; a weight of NaN gives NaN."""
    weights = lax.expand_dims(weights, range(weights.ndim, weights.ndim + event_rank))
    (weights,) = align([(weights, 0)], values.ndim)
    return jnp.where(weights == 0, 0, weights * values).sum(-1 - event_rank)


def mixture_moments(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean and covariance by the laws of total mean and covariance, from those of the components."""
    mean = weighted_sum(weights, means, 1)
    # A second pass on centered means: otherwise the rounding error of the weights is multiplied by the offset.
    error = weighted_sum(weights, means - mean[..., None, :], 1)
    mean = jnp.where(jnp.isfinite(error), mean + error, mean)  # not where differences overflow
    centered = means - mean[..., None, :]
    return mean, weighted_sum(weights, covariances + centered[..., :, None] * centered[..., None, :], 2)


def choose_components(key, weights: Array, shape: tuple[int, ...]) -> Array:
    """Random component indices k with probabilities w_k; an absent component is never chosen."""
    cumulative = jnp.cumsum(weights, axis=-1)
    (cumulative,) = align([(cumulative, 0)], len(shape) + 1)
    level = jax.random.uniform(key, shape, weights.dtype) * cumulative[..., -1]
    return (level[..., None] >= cumulative).sum(-1)
