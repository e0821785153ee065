"""The Folded-Gaussian FN(m, Sigma, a, f) (the paper's "Folded-Gaussians").

Not the |X| "folded normal" of scipy and numpyro: here a Gaussian's *centre* is bent along a curve in time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Key

from foldgauss._batch import (
    align,
    as_value,
    batch_of,
    broadcast,
    cast,
    check_event,
    check_positive,
    checked_batch,
    common_dtype,
    expand,
    fill,
    parts_of,
)
from foldgauss._checks import invalid
from foldgauss._factor import check_space, check_tril, checked_cholesky, the_one_given
from foldgauss.envelope import AbstractEnvelope, TimeLikelihood
from foldgauss.fold import AbstractFold, CallableFold, ZeroFold, as_fold
from foldgauss.gaussian import Gaussian, Normal

__all__ = ["FoldedGaussian", "Gaussian", "Normal"]


class FoldedGaussian(eqx.Module):
    """The Folded-Gaussian distribution of x = (s, t), space s in R^(d-1) and time t **last**.

        t     ~ N(time_loc, time_scale^2)
        s | t ~ N(loc + f(time_loc - t), a(t) Sigma),      Sigma = scale_tril scale_tril^T
        FN(x) = N(s | t) N(t)

    Mind the sign of the fold's argument. The default envelope is the paper's text, `TimeLikelihood(power=1)`;
    the paper's published code is `TimeLikelihood(power=2)`.

    **Shapes:** `loc` (*batch, d-1); `scale_tril` or `covariance_matrix` (*batch, d-1, d-1), exactly one of
    them; `time_loc`, `time_scale` (*batch,); leading dimensions broadcast. `event_shape == (d,)`. `fold` is a
    fold (None is `ZeroFold`) or any callable from one scalar u to (d-1,).

    **Units:** space for `loc` and `scale_tril`, time for `time_loc` and `time_scale`.

    **dtype:** that of `loc`, `scale_tril`, `time_loc`, `time_scale` (Python numbers follow); the leaves of
    fold and envelope are cast to it.

    **Example:**

        bend = PolynomialFold([[0.0], [1.0]])  # f(u) = u^2
        dist = FoldedGaussian([0.0], [[0.2]], time_loc=0.5, time_scale=0.3, fold=bend)
        x = dist.sample(jax.random.key(0), (1000,))  # (1000, 2)
        dist.condition_time(0.8).loc                 # [0.09] = f(0.5 - 0.8)

    **Source:** eq:foldgauss with eq:cond_dens. **Raises:** ValueError naming the parameter, on shapes always,
    on values (positive `time_scale`, a proper factor or covariance) unless traced or `validate_args=False`.
    """

    loc: Float[Array, "*#batch d-1"]
    scale_tril: Float[Array, "*#batch d-1 d-1"]
    time_loc: Float[Array, "*#batch"]
    time_scale: Float[Array, "*#batch"]
    fold: AbstractFold
    envelope: AbstractEnvelope

    def __init__(
        self,
        loc: ArrayLike,
        scale_tril: ArrayLike | None = None,
        *,
        covariance_matrix: ArrayLike | None = None,
        time_loc: ArrayLike,
        time_scale: ArrayLike,
        fold=None,
        envelope: AbstractEnvelope | None = None,
        validate_args: bool = True,
    ):
        name, matrix = the_one_given(scale_tril=scale_tril, covariance_matrix=covariance_matrix)
        dtype = common_dtype(loc, matrix, time_loc, time_scale)
        loc, matrix, time_loc, time_scale = (jnp.asarray(x, dtype) for x in (loc, matrix, time_loc, time_scale))
        check_space(loc, name, matrix)
        if validate_args:
            check_positive("time_scale", time_scale)
        if validate_args and name == "scale_tril":
            check_tril(matrix)
        tril = matrix if name == "scale_tril" else checked_cholesky(matrix, validate_args)
        fold = ZeroFold(loc.shape[-1]) if fold is None else as_fold(fold)
        fold = _checked_fold(cast(fold, dtype), loc)
        envelope = TimeLikelihood(power=1.0) if envelope is None else envelope
        envelope = cast(_checked_envelope(envelope), dtype)
        # Every leaf is given the whole batch, so that slices, `vmap` over the distribution, and an axis that
        # `vmap` over this constructor puts in front, are all well defined.
        parts = [(loc, 1), (tril, 2), (time_loc, 0), (time_scale, 0)]
        batch = checked_batch([*parts, *parts_of(fold), *parts_of(envelope)])
        self.loc, self.scale_tril, self.time_loc, self.time_scale = broadcast(parts, batch)
        self.envelope = fill(envelope, batch)
        # But a network's parameters are not copied per component: they keep axes of size 1.
        self.fold = expand(fold, len(batch)) if isinstance(fold, CallableFold) else fill(fold, batch)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return (self.loc.shape[-1] + 1,)

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (1, 2, 0, 0, *self.fold.leaf_ranks, *self.envelope.leaf_ranks)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Broadcast leading dimensions of all leaves, the fold's and the envelope's included."""
        return batch_of(parts_of(self))

    @property
    def time_marginal(self) -> Normal:
        """The distribution of t alone, N(time_loc, time_scale^2): a `Normal`, with `event_shape == ()`.

        **Source:** eq:integral_proof.
        """
        return Normal(self.time_loc, self.time_scale, validate_args=False)

    def condition_time(self, t: Float[Array, "*#batch"]) -> Gaussian:
        """The Gaussian of space at time t. This is the one home of the fold equation.

            s | t ~ N(loc + f(time_loc - t), a(t) Sigma)

        **Shapes:** t (*batch,), broadcast; the result has `event_shape == (d-1,)`.

        **Example:** `dist.condition_time(0.25).sample(key)`

        **Source:** eq:cond_dens, eq:cond_proof. **Raises:** nothing; a t far away only underflows
        `scale_tril`.
        """
        t = as_value(t, self.loc.dtype)
        dist = expand(self, t.ndim)
        (t,) = align([(t, 0)], dist.time_loc.ndim)
        shift = dist.fold(dist.time_loc - t)
        log_a = dist.envelope.log_a(t, time_loc=dist.time_loc, time_scale=dist.time_scale)
        largest = float(jnp.finfo(log_a.dtype).max) * 1e-3  # log a = -inf would make inf - inf of the density
        log_a = jnp.clip(log_a, -largest, largest)
        return Gaussian(dist.loc + shift, dist.scale_tril, log_scale=0.5 * log_a, validate_args=False)

    def log_prob(self, x: Float[Array, "*#batch d"]) -> Float[Array, "*#batch"]:
        """log FN(x) = log N(s | t) + log N(t), by the chain rule.

        **Shapes:** x (*sample, *batch, d), time last -> (*sample, *batch). **Units:** log of 1 / (space^(d-1)
        time).

        **Example:** `dist.log_prob(jnp.array([0.1, -0.2, 0.5]))`

        **Source:** eq:foldgauss. **Raises:** ValueError if the last dimension of x is not d.
        """
        x = as_value(x, self.loc.dtype)
        check_event("x", x, self.event_shape)
        s, t = x[..., :-1], x[..., -1]
        log_time = self.time_marginal.log_prob(t)
        overflown = jnp.isinf(self.condition_time(t).loc).any(-1)
        # Double where: at a time so far away that the fold overflows, gradients are taken at f(0) instead.
        near, time_loc = align([(t, 0), (self.time_loc, 0)], overflown.ndim)
        log_space = self.condition_time(jnp.where(overflown, time_loc, near)).log_prob(s)
        unreachable = overflown | jnp.isneginf(log_space) | jnp.isneginf(log_time)
        return jnp.where(unreachable, -jnp.inf, log_space + log_time)

    def pdf(self, x: Float[Array, "*#batch d"]) -> Float[Array, "*#batch"]:
        """FN(x), shapes as in `log_prob`. **Source:** eq:foldgauss."""
        return jnp.exp(self.log_prob(x))

    def sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Draws x = (s, t): first t, then s given t; differentiable in all parameters.

        **Shapes:** -> (*sample_shape, *batch, d), time last.

        **Example:** `dist.sample(jax.random.key(0), (1000,))`

        **Source:** eq:foldgauss, read as a recipe. **Raises:** nothing.
        """
        time_key, space_key = jax.random.split(key)
        # Every batch element draws its own t, also where only loc or the fold carries the batch.
        shape = (*sample_shape, *self.batch_shape)
        noise = jax.random.normal(time_key, shape, self.loc.dtype)
        noise, time_loc, time_scale = align([(noise, 0), (self.time_loc, 0), (self.time_scale, 0)])
        t = time_loc + time_scale * noise
        s = self.condition_time(t).sample(space_key)
        return jnp.concatenate([s, t[..., None]], axis=-1)


def _checked_fold(fold: AbstractFold, loc: Array) -> AbstractFold:
    shape = jax.eval_shape(fold, jax.ShapeDtypeStruct((), loc.dtype)).shape
    if shape[-1:] != loc.shape[-1:]:
        expected = f"shifts of shape (*batch, {loc.shape[-1]})"
        raise invalid("fold", expected=expected, got=f"shape {shape}", cure="It takes u to d-1 space coordinates.")
    return fold


def _checked_envelope(envelope: AbstractEnvelope) -> AbstractEnvelope:
    if not isinstance(envelope, AbstractEnvelope):
        cure = "Constant(), TimeLikelihood(power=...), or a subclass."
        raise invalid("envelope", expected="an AbstractEnvelope", got=repr(envelope), cure=cure)
    return envelope
