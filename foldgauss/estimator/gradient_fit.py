"""Maximum likelihood of a mixture by gradient ascent, for folds and envelopes without closed-form EM updates."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Bool, Float

from foldgauss._runtime.checks import is_integer, require
from foldgauss.envelope import CallableEnvelope
from foldgauss.estimator.em.scaling import check_time_resolution
from foldgauss.estimator.parameter_checks import check_real
from foldgauss.mixture import FoldedMixture

_LEARNING_RATE = 1e-2


class GradientFit(NamedTuple):
    """The mixture of the last step with a finite loss, the mean log-likelihood before each step, and how it ended.

    `success` and `message` are those of `scipy.optimize.OptimizeResult`: success means that all steps were taken.
    """

    mixture: FoldedMixture
    log_likelihoods: np.ndarray
    success: bool
    message: str


def fit_gradient(
    mixture: FoldedMixture,
    x: Float[ArrayLike, "n d"],
    *,
    sample_weight: Float[ArrayLike, " n"] | None = None,
    steps: int = 500,
    optimizer: optax.GradientTransformation | None = None,
) -> GradientFit:
    """Maximize the (weighted) mean log-likelihood of points x over all parameters of a mixture, starting from it.

    Trained are weights, centers, covariances, times and the fold's leaves; of the envelope, those of a
    `CallableEnvelope` (a built-in envelope's power and floor are fixed). A component of weight 0 keeps it.

    **Shapes:** x (n, d), time last; the mixture has no batch axes. `optimizer` is optax's, by default Adam with
    learning rate 0.01.

    **Example:**

        start = FoldedMixture(FoldedGaussian(loc, scale=scale, time_loc=t, time_scale=s, fold=network), weights=w)
        result = fit_gradient(start, x, steps=2000)

    **Source:** eq:foldgauss; Kingma and Ba 2015. **Raises:** ValueError naming the parameter. A loss that is not finite
    ends the fit without `success`.
    """
    require(
        isinstance(mixture, FoldedMixture) and mixture.logits.ndim == 1,
        "mixture",
        expected="one FoldedMixture",
        got=type(mixture).__name__,
        cure="No batch of mixtures.",
    )
    require(is_integer(steps, 1), "steps", expected="a whole number >= 1", got=repr(steps))
    dtype = mixture.logits.dtype
    check_real("x", x)
    check_time_resolution("x", x, dtype)
    x = jnp.asarray(x, dtype)
    require(
        x.ndim == 2 and x.shape[1:] == mixture.event_shape,
        "x",
        expected=f"shape (n, {mixture.event_shape[0]})",
        got=f"shape {x.shape}",
        cure="Time is last.",
    )
    require(len(x), "x", expected="at least one point", got="none")
    weights = jnp.ones(len(x), dtype) if sample_weight is None else jnp.asarray(sample_weight, dtype)
    require(
        weights.shape == x.shape[:1] and bool((weights >= 0).all()) and bool(weights.sum() > 0),
        "sample_weight",
        expected=f"{len(x)} numbers >= 0, not all 0",
        got=f"shape {weights.shape}",
    )
    optimizer = optax.adam(_LEARNING_RATE) if optimizer is None else optimizer
    raw = _init_raw(mixture)
    state, values, last = optimizer.init(raw), [], mixture
    for number in range(steps + 1):  # once more, since a step evaluates the parameters before it
        new, state, value, current, finite = _step(raw, state, mixture, x, weights, optimizer)
        if not finite:
            message = f"The loss or a parameter was not finite in step {number + 1}: lower the learning rate."
            return GradientFit(last, np.array(values), False, message)
        raw, last = new, current
        if number < steps:
            values.append(float(value))
    return GradientFit(last, np.array(values), True, f"All {steps} steps were taken.")


def _is_finite(mixture: FoldedMixture) -> Bool[Array, ""]:
    """Whether all parameters are finite, except for logits of -inf."""
    leaves = jax.tree.leaves(eqx.filter(mixture.components, eqx.is_inexact_array))
    return jnp.stack([jnp.isfinite(z).all() for z in leaves]).all() & ~jnp.isnan(mixture.logits).any()


@eqx.filter_jit
def _step(raw, state, start, x, weights, optimizer):
    def loss(raw):
        present = weights > 0
        log_p = _build_mixture(raw, start).log_prob(jnp.where(present[:, None], x, 0))
        return -jnp.where(present, weights * log_p, 0).sum() / weights.sum()

    value, gradient = jax.value_and_grad(loss)(raw)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # third-party code
        updates, state = optimizer.update(gradient, state, raw)
        new = optax.apply_updates(raw, updates)
    current = _build_mixture(raw, start)
    return new, state, -value, current, jnp.isfinite(value) & _is_finite(current)


def _parts(mixture: FoldedMixture) -> tuple:
    components = mixture.components
    times = (components.time_loc, components.time_scale)
    return (mixture.logits, components.loc, components.scale_tril, *times, components.fold, components.envelope)


def _init_raw(mixture: FoldedMixture) -> tuple:
    """The optimized parameters, one of each part: unconstrained, and in units of each component's initial scales."""
    *arrays, fold, envelope = _parts(mixture)
    trained = envelope if isinstance(envelope, CallableEnvelope) else None
    return (*map(jnp.zeros_like, arrays), *(eqx.filter(z, eqx.is_inexact_array) for z in (fold, trained)))


def _build_mixture(raw: tuple, start: FoldedMixture) -> FoldedMixture:
    """Apply `raw` to the start: it shifts centers in units of Sigma's factor, times in units of sigma_t."""
    logits, loc, factor, time_loc, log_time_scale, fold, envelope = raw
    initial = start.components
    diagonal, log_diagonal = (jnp.diagonal(z, axis1=1, axis2=2) for z in (initial.scale_tril, factor))
    eye = jnp.eye(diagonal.shape[-1], dtype=diagonal.dtype)[None]
    lower = jnp.tril(initial.scale_tril + diagonal[:, :, None] * factor, -1)
    parts = (
        start.logits + logits,
        initial.loc + diagonal * loc,
        lower + (diagonal * jnp.exp(log_diagonal))[:, :, None] * eye,
        initial.time_loc + initial.time_scale * time_loc,
        initial.time_scale * jnp.exp(log_time_scale),
        eqx.combine(fold, initial.fold),
        initial.envelope if envelope is None else eqx.combine(envelope, initial.envelope),
    )
    return eqx.tree_at(_parts, start, parts)
