"""Maximum likelihood of a mixture by gradients: for folds and envelopes that EM has no closed form for."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PyTree

from foldgauss._runtime.checks import invalid, is_integer
from foldgauss._runtime.threads import check_not_forked
from foldgauss.envelope import CallableEnvelope
from foldgauss.estimator.em.loop import EMStatus
from foldgauss.mixture import FoldedMixture

__all__ = ["GradientFit", "fit_gradient"]

_LEARNING_RATE = 1e-2


class GradientFit(NamedTuple):
    """The mixture of the last step whose loss was a number; the mean log-likelihood before each step; how it ended:
    NOT_CONVERGED means that all steps were taken."""

    mixture: FoldedMixture
    log_likelihoods: np.ndarray
    status: EMStatus


class _Raw(NamedTuple):
    """What is optimised: free of constraints, and in units of each component's own scale at the start."""

    logits: Float[Array, " k"]
    loc: Float[Array, "k d-1"]
    log_diagonal: Float[Array, "k d-1"]
    below: Float[Array, "k d-1 d-1"]
    time_loc: Float[Array, " k"]
    log_time_scale: Float[Array, " k"]
    fold: PyTree
    envelope: PyTree


def fit_gradient(
    mixture: FoldedMixture,
    x: Float[ArrayLike, "n d"],
    *,
    sample_weight: Float[ArrayLike, " n"] | None = None,
    steps: int = 500,
    optimiser: optax.GradientTransformation | None = None,
    batch_size: int | None = None,
    key: Key[Array, ""] | None = None,
) -> GradientFit:
    """Climb the (weighted) mean log-likelihood of points x from a mixture, all its parameters together.

    Weights, centres, covariances, times and the fold's leaves are trained; of the envelope, those that a
    `CallableEnvelope` carries (a built-in envelope's power and floor are a choice, not parameters). A component of
    weight 0 stays without.

    **Shapes:** x (n, d), time last; the mixture has no batch but its components. `batch_size` points are drawn anew
    for each step with `key` (default: all points, every time). `optimiser` is optax's, default Adam at 0.01.

    **Example:**

        start = FoldedMixture(FoldedGaussian(loc, scale=scale, time_loc=t, time_scale=s, fold=network), weights=w)
        result = fit_gradient(start, x, steps=2000)

    **Source:** eq:foldgauss; Kingma and Ba 2015. **Raises:** ValueError naming the parameter; a loss that is no number
    ends the fit with `status` NOT_FINITE.
    """
    if not isinstance(mixture, FoldedMixture) or mixture.logits.ndim != 1:
        raise invalid("mixture", expected="one FoldedMixture", got=type(mixture).__name__, cure="No batch of mixtures.")
    if not is_integer(steps, 1):
        raise invalid("steps", expected="a whole number >= 1", got=repr(steps))
    check_not_forked()
    dtype = mixture.logits.dtype
    x = jnp.asarray(x, dtype)
    if x.ndim != 2 or x.shape[1:] != mixture.event_shape:
        raise invalid(
            "x", expected=f"shape (n, {mixture.event_shape[0]})", got=f"shape {x.shape}", cure="Time is last."
        )
    if not len(x):
        raise invalid("x", expected="at least one point", got="none")
    weights = jnp.ones(len(x), dtype) if sample_weight is None else jnp.asarray(sample_weight, dtype)
    if weights.shape != x.shape[:1] or not bool((weights >= 0).all()) or not bool(weights.sum() > 0):
        raise invalid("sample_weight", expected=f"{len(x)} numbers >= 0, not all 0", got=f"shape {weights.shape}")
    if batch_size is not None and not is_integer(batch_size, 1):
        raise invalid("batch_size", expected="a whole number >= 1 or None", got=repr(batch_size))
    optimiser = optax.adam(_LEARNING_RATE) if optimiser is None else optimiser
    key = jax.random.key(0) if key is None else key
    start = jax.tree.map(lambda z: z, mixture)
    raw = _raw_of(start)
    state, values, good = optimiser.init(raw), [], start
    for number in range(steps + 1):  # once more, since a step tells of the parameters it begins with
        step_key = jax.random.fold_in(key, number)
        new, state, value, here, finite = _step(raw, state, start, x, weights, step_key, optimiser, batch_size)
        if not finite:
            return GradientFit(good, np.array(values), EMStatus.NOT_FINITE)
        raw, good = new, here
        if number < steps:
            values.append(float(value))
    return GradientFit(good, np.array(values), EMStatus.NOT_CONVERGED)


def _is_finite(mixture: FoldedMixture) -> Bool[Array, ""]:
    """Whether all numbers are, but for logits of -inf."""
    leaves = jax.tree.leaves(eqx.filter(mixture.components, eqx.is_inexact_array))
    return jnp.stack([jnp.isfinite(z).all() for z in leaves]).all() & ~jnp.isnan(mixture.logits).any()


@eqx.filter_jit
def _step(raw, state, start, x, weights, key, optimiser, batch_size):
    if batch_size is not None:
        rows = jax.random.choice(key, x.shape[0], (batch_size,), p=weights / weights.sum())
        x, weights = x[rows], jnp.ones(batch_size, x.dtype)

    def loss(raw):
        present = weights > 0
        log_p = _mixture_of(raw, start).log_prob(jnp.where(present[:, None], x, 0))
        return -jnp.where(present, weights * log_p, 0).sum() / weights.sum()

    value, gradient = jax.value_and_grad(loss)(raw)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # the optimiser is not ours
        updates, state = optimiser.update(gradient, state, raw)
        new = optax.apply_updates(raw, updates)
    here = _mixture_of(raw, start)
    return new, state, -value, here, jnp.isfinite(value) & _is_finite(here)


def _raw_of(mixture: FoldedMixture) -> _Raw:
    components = mixture.components
    zero = jnp.zeros_like(components.loc)
    fold = eqx.filter(components.fold, eqx.is_inexact_array)
    envelope = components.envelope if isinstance(components.envelope, CallableEnvelope) else None
    return _Raw(
        jnp.zeros_like(mixture.logits),
        zero,
        zero,
        jnp.zeros_like(components.scale_tril),
        jnp.zeros_like(components.time_loc),
        jnp.zeros_like(components.time_loc),
        fold,
        eqx.filter(envelope, eqx.is_inexact_array),
    )


def _mixture_of(raw: _Raw, start: FoldedMixture) -> FoldedMixture:
    """The start, moved: centres by the factors of Sigma, times by sigma_t, scales by factors."""
    was = start.components
    diagonal = jnp.diagonal(was.scale_tril, axis1=1, axis2=2)
    eye = jnp.eye(diagonal.shape[-1], dtype=diagonal.dtype)[None]
    below = jnp.tril(was.scale_tril + diagonal[:, :, None] * raw.below, -1)
    leaves = (
        was.loc + diagonal * raw.loc,
        below + (diagonal * jnp.exp(raw.log_diagonal))[:, :, None] * eye,
        was.time_loc + was.time_scale * raw.time_loc,
        was.time_scale * jnp.exp(raw.log_time_scale),
        eqx.combine(raw.fold, was.fold),
        was.envelope if raw.envelope is None else eqx.combine(raw.envelope, was.envelope),
    )
    places = lambda m: (  # noqa: E731
        m.components.loc,
        m.components.scale_tril,
        m.components.time_loc,
        m.components.time_scale,
        m.components.fold,
        m.components.envelope,
        m.logits,
    )
    return eqx.tree_at(places, start, (*leaves, start.logits + raw.logits))
