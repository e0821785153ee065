"""The Folded-Gaussian FN(m, Sigma, a, f) and the Gaussians it is made of (the paper's "Folded-Gaussians").

Not the |X| "folded normal" of scipy and numpyro: here a Gaussian's *centre* is bent along a curve in time.

Numerics: `a` is never formed, only `log a`. A log-density is finite or -inf for every finite input. Its
gradient is 0 where it is -inf, and never NaN; the gradient with respect to the value saturates at the largest
finite number.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Key

from foldgauss._checks import invalid
from foldgauss.envelope import AbstractEnvelope, TimeLikelihood
from foldgauss.fold import AbstractFold, CallableFold, ZeroFold, as_fold

__all__ = ["FoldedGaussian", "Gaussian", "Normal"]

_ModuleT = TypeVar("_ModuleT", bound=eqx.Module)
_Vector = Float[Array, "*#batch dim"]
_Matrix = Float[Array, "*#batch dim dim"]

_LOG_2PI = float(np.log(2 * np.pi))
# Up to this size triangular systems are written out: XLA's CPU solver is called once per matrix and is 10x
# slower.
_UNROLLED_SIZE = 8
# Saturated gradients with respect to *parameters* stop this far below the largest finite number: chain rule
# factors (powers of u, 1/scale) and sums over a batch then still have room, where inf - inf would be NaN.
_CHAIN_HEADROOM = 2.0**-24


class Normal(eqx.Module):
    """A normal distribution on the line: what a Folded-Gaussian says about time alone.

        N(loc, scale^2)(t) = exp(-((t - loc) / scale)^2 / 2) / (sqrt(2 pi) scale)

    **Shapes:** `loc`, `scale` (*batch,), broadcast; `event_shape == ()`, so values have shape (*sample,
    *batch).

    **Example:** `Normal(0.0, 1.0).log_prob(0.0)  # -0.9189`

    **Source:** eq:normal_pdf. **Raises:** ValueError if `scale` is not positive.
    """

    loc: Float[Array, "*#batch"]
    scale: Float[Array, "*#batch"]

    def __init__(self, loc: ArrayLike, scale: ArrayLike, *, validate_args: bool = True):
        dtype = _common_dtype(loc, scale)
        self.loc, self.scale = _align([(jnp.asarray(loc, dtype), 0), (jnp.asarray(scale, dtype), 0)])
        if validate_args:
            _check_scale("scale", self.scale)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return ()

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (0, 0)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return _batch_shape(_parts(self))

    def log_prob(self, value: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """log N(loc, scale^2)(value)."""
        return _as_gaussian(self).log_prob(_value(value, self.loc.dtype)[..., None])

    def pdf(self, value: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """N(loc, scale^2)(value)."""
        return jnp.exp(self.log_prob(value))

    def sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Draws of shape (*sample_shape, *batch), differentiable in the parameters."""
        return _as_gaussian(self).sample(key, sample_shape)[..., 0]


class Gaussian(eqx.Module):
    """A Gaussian in any dimension, by its factor and a scale kept in log space.

        N(loc, exp(2 log_scale) L L^T),   L = base_tril

    `log_scale` is there for Folded-Gaussians seen far from their time, where the product `exp(log_scale) L`
    (given by `scale_tril`) is 0 in floating point and the density is not.

    **Shapes:** `loc` (*batch, dim), `scale_tril` (*batch, dim, dim) lower-triangular with a positive
    diagonal, `log_scale` (*batch,), all broadcast; `event_shape == (dim,)`.

    **Example:** `Gaussian(jnp.zeros(2), jnp.eye(2)).log_prob(jnp.zeros(2))  # -1.8379`

    **Source:** eq:cond_dens. **Raises:** ValueError on a wrong shape or a factor that is none.
    """

    loc: Float[Array, "*#batch dim"]
    base_tril: Float[Array, "*#batch dim dim"]
    log_scale: Float[Array, "*#batch"]

    def __init__(
        self,
        loc: ArrayLike,
        scale_tril: ArrayLike,
        *,
        log_scale: ArrayLike = 0.0,
        validate_args: bool = True,
    ):
        dtype = _common_dtype(loc, scale_tril, log_scale)
        loc, tril, log_scale = (jnp.asarray(x, dtype) for x in (loc, scale_tril, log_scale))
        _check_space(loc, "scale_tril", tril)
        if validate_args:
            _check_tril(tril)
        parts = [(loc, 1), (tril, 2), (log_scale, 0)]
        _checked_batch(parts)
        # Ones in front instead of copies: one factor may serve a million times.
        self.loc, self.base_tril, self.log_scale = _align(parts)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return self.loc.shape[-1:]

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (1, 2, 0)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return _batch_shape(_parts(self))

    @property
    def scale_tril(self) -> Float[Array, "*#batch dim dim"]:
        """Factor of the covariance, exp(log_scale) L: it may underflow to 0."""
        return jnp.exp(self.log_scale)[..., None, None] * self.base_tril

    @property
    def covariance_matrix(self) -> Float[Array, "*#batch dim dim"]:
        """exp(2 log_scale) L L^T: it may underflow to 0."""
        factor = self.scale_tril
        if factor.shape[-1] > _UNROLLED_SIZE:
            return jnp.matmul(factor, jnp.swapaxes(factor, -1, -2))
        return (factor[..., :, None, :] * factor[..., None, :, :]).sum(-1)

    def log_prob(self, value: Float[Array, "*#batch dim"]) -> Float[Array, "*#batch"]:
        """log N(loc, Sigma)(value)."""
        value = _value(value, self.loc.dtype)
        _check_event("value", value, self.event_shape)
        value, loc, tril, log_scale = _align([(value, 1), (self.loc, 1), (self.base_tril, 2), (self.log_scale, 0)])
        half_square = _half_mahalanobis(value, loc, tril, log_scale)
        dim = loc.shape[-1]
        half_log_det = jnp.log(jnp.diagonal(tril, axis1=-2, axis2=-1)).sum(-1) + dim * log_scale
        unreachable = jnp.isposinf(half_square)
        # Double where: 0 for the gradient of everything where the log-density is -inf.
        log_density = -jnp.where(unreachable, 0, half_square) - half_log_det - 0.5 * dim * _LOG_2PI
        return jnp.where(unreachable, -jnp.inf, log_density)

    def pdf(self, value: Float[Array, "*#batch dim"]) -> Float[Array, "*#batch"]:
        """N(loc, Sigma)(value)."""
        return jnp.exp(self.log_prob(value))

    def sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Draws of shape (*sample_shape, *batch, dim), differentiable in the parameters."""
        shape = (*sample_shape, *self.batch_shape, *self.event_shape)
        noise = jax.random.normal(key, shape, self.loc.dtype)
        noise, loc, tril, log_scale = _align([(noise, 1), (self.loc, 1), (self.base_tril, 2), (self.log_scale, 0)])
        return loc + jnp.exp(log_scale)[..., None] * _lower_times(tril, noise)


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
        name, matrix = _the_one_given(scale_tril=scale_tril, covariance_matrix=covariance_matrix)
        dtype = _common_dtype(loc, matrix, time_loc, time_scale)
        loc, matrix, time_loc, time_scale = (jnp.asarray(x, dtype) for x in (loc, matrix, time_loc, time_scale))
        _check_space(loc, name, matrix)
        if validate_args:
            _check_scale("time_scale", time_scale)
        if validate_args and name == "scale_tril":
            _check_tril(matrix)
        tril = matrix if name == "scale_tril" else _checked_cholesky(matrix, validate_args)
        fold = ZeroFold(loc.shape[-1]) if fold is None else as_fold(fold)
        fold = _checked_fold(_cast(fold, dtype), loc)
        envelope = TimeLikelihood(power=1.0) if envelope is None else envelope
        envelope = _cast(_checked_envelope(envelope), dtype)
        # Every leaf is given the whole batch, so that slices, `vmap` over the distribution, and an axis that
        # `vmap` over this constructor puts in front, are all well defined.
        parts = [(loc, 1), (tril, 2), (time_loc, 0), (time_scale, 0)]
        batch = _checked_batch([*parts, *_parts(fold), *_parts(envelope)])
        self.loc, self.scale_tril, self.time_loc, self.time_scale = _broadcast(parts, batch)
        self.envelope = _fill(envelope, batch)
        # But a network's parameters are not copied per component: they keep axes of size 1.
        self.fold = _expand(fold, len(batch)) if isinstance(fold, CallableFold) else _fill(fold, batch)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return (self.loc.shape[-1] + 1,)

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (1, 2, 0, 0, *self.fold.leaf_ranks, *self.envelope.leaf_ranks)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Broadcast leading dimensions of all leaves, the fold's and the envelope's included."""
        return _batch_shape(_parts(self))

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
        t = _value(t, self.loc.dtype)
        dist = _expand(self, t.ndim)
        (t,) = _align([(t, 0)], dist.time_loc.ndim)
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
        x = _value(x, self.loc.dtype)
        _check_event("x", x, self.event_shape)
        s, t = x[..., :-1], x[..., -1]
        log_time = self.time_marginal.log_prob(t)
        overflown = jnp.isinf(self.condition_time(t).loc).any(-1)
        # Double where: at a time so far away that the fold overflows, gradients are taken at f(0) instead.
        near, time_loc = _align([(t, 0), (self.time_loc, 0)], overflown.ndim)
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
        noise, time_loc, time_scale = _align([(noise, 0), (self.time_loc, 0), (self.time_scale, 0)])
        t = time_loc + time_scale * noise
        s = self.condition_time(t).sample(space_key)
        return jnp.concatenate([s, t[..., None]], axis=-1)


# --- densities ----------------------------------------------------------------------------------------------


def _as_gaussian(normal: Normal) -> Gaussian:
    return Gaussian(normal.loc[..., None], normal.scale[..., None, None], validate_args=False)


@jax.custom_jvp
def _half_mahalanobis(value, loc, tril, log_scale):
    """|L^-1 (value - loc)|^2 exp(-2 log_scale) / 2; all arguments of one batch rank."""
    z = _times_exp(_solve_lower(tril, value - loc), -log_scale)
    half = (0.5 * z * z).sum(-1)
    # A residual that is infinite in one coordinate meets zeros of L as 0 * inf; it is simply far away.
    return jnp.where(jnp.isinf(value - loc).any(-1), jnp.inf, half)


@_half_mahalanobis.defjvp
def _half_mahalanobis_jvp(primals, tangents):
    # d(|y|^2/2 e^2c) = g.(dr - dL y) + |y|^2 e^2c dc with y = L^-1 r, c = -log_scale, g = L^-T y e^2c. By
    # hand, since e^2c alone overflows long before g does, and because g must be 0, not inf * 0, where the
    # result is inf.
    value, loc, tril, log_scale = primals
    value_dot, loc_dot, tril_dot, log_scale_dot = tangents
    half = _half_mahalanobis(value, loc, tril, log_scale)
    unreachable = jnp.isposinf(half)[..., None]
    y = jnp.where(unreachable, 0, _solve_lower(tril, jnp.where(unreachable, 0, value - loc)))
    z = _times_exp(y, -log_scale)
    by_value = _times_exp(_saturated(_solve_upper(tril, z)), -log_scale)
    by_parameter = _saturated(by_value, _CHAIN_HEADROOM)
    by_log_scale = -_saturated((z * z).sum(-1), _CHAIN_HEADROOM)
    half_dot = (by_value * value_dot).sum(-1) - (by_parameter * (loc_dot + _lower_times(tril_dot, y))).sum(-1)
    return half, half_dot + by_log_scale * log_scale_dot


@jax.custom_jvp
def _times_exp(y: _Vector, c: Float[Array, "*#batch"]) -> _Vector:
    """y exp(c) where the product fits but exp(c) need not; saturates where the product does not fit."""
    largest = _log_largest(y.dtype)
    half = jnp.exp(0.5 * jnp.clip(c, -2 * largest, 2 * largest))[..., None]
    return _saturated(y * half * half)


@_times_exp.defjvp
def _times_exp_jvp(primals, tangents):
    (y, c), (y_dot, c_dot) = primals, tangents
    product = _times_exp(y, c)
    slope = jnp.exp(jnp.minimum(c, _log_largest(y.dtype)))[..., None]
    return product, slope * y_dot + _saturated(product, _CHAIN_HEADROOM) * c_dot[..., None]


def _log_largest(dtype) -> float:
    return float(np.log(jnp.finfo(dtype).max)) * 0.999  # a little less: exp of it must not round to inf


def _saturated(x: Array, fraction: float = 1.0) -> Array:
    largest = float(jnp.finfo(x.dtype).max) * fraction
    return jnp.clip(x, -largest, largest)


# --- small triangular algebra -------------------------------------------------------------------------------


def _solve_lower(tril: _Matrix, b: _Vector) -> _Vector:
    """L^-1 b by forward substitution."""
    dim = b.shape[-1]
    if dim > _UNROLLED_SIZE:
        return _solve_large(tril, b, transpose=False)
    x: list[Array] = []
    for i in range(dim):
        rest = b[..., i]
        for j in range(i):
            rest = rest - tril[..., i, j] * x[j]
        x.append(rest / tril[..., i, i])
    return jnp.stack(x, axis=-1)


def _solve_upper(tril: _Matrix, b: _Vector) -> _Vector:
    """L^-T b by back substitution."""
    dim = b.shape[-1]
    if dim > _UNROLLED_SIZE:
        return _solve_large(tril, b, transpose=True)
    x: list[Array] = []
    for i in reversed(range(dim)):
        rest = b[..., i]
        for j, known in zip(reversed(range(i + 1, dim)), x, strict=True):
            rest = rest - tril[..., j, i] * known
        x.append(rest / tril[..., i, i])
    return jnp.stack(x[::-1], axis=-1)


def _solve_large(tril, b, *, transpose: bool):
    """One solve with all of b as right-hand sides if there is one matrix, else a solve per matrix."""
    dim = b.shape[-1]
    solve = lambda a, b: lax.linalg.triangular_solve(a, b, left_side=True, lower=True, transpose_a=transpose)  # noqa: E731
    if all(size == 1 for size in tril.shape[:-2]):
        return solve(tril.reshape(dim, dim), b.reshape(-1, dim).T).T.reshape(b.shape)
    batch = jnp.broadcast_shapes(tril.shape[:-2], b.shape[:-1])
    tril, b = jnp.broadcast_to(tril, (*batch, dim, dim)), jnp.broadcast_to(b, (*batch, dim))
    return solve(tril, b[..., None])[..., 0]


def _lower_times(tril: _Matrix, x: _Vector) -> _Vector:
    """L x, reading the lower triangle only."""
    dim = x.shape[-1]
    if dim > _UNROLLED_SIZE:
        return jnp.matmul(jnp.tril(tril), x[..., None])[..., 0]
    rows = [sum(tril[..., i, j] * x[..., j] for j in range(i + 1)) for i in range(dim)]
    return jnp.stack(jnp.broadcast_arrays(*rows), axis=-1)


# --- batches: every leaf has a rank of its own, what stands in front of it is batch -------------------------


def _batch_rank(parts: list[tuple[Array, int]]) -> int:
    return max(x.ndim - event for x, event in parts)


def _align(parts: list[tuple[Array, int]], rank: int | None = None) -> list[Array]:
    """The arrays of (array, event rank) with equal batch ranks, by ones in front."""
    rank = _batch_rank(parts) if rank is None else rank
    return [lax.expand_dims(x, range(rank + event - x.ndim)) for x, event in parts]


def _broadcast(parts: list[tuple[Array, int]], batch: tuple[int, ...]) -> list[Array]:
    return [jnp.broadcast_to(x, batch + x.shape[x.ndim - event :]) for x, event in parts]


def _parts(module: eqx.Module) -> list[tuple[Array, int]]:
    """(leaf, event rank) of every leaf."""
    return list(zip(jax.tree.leaves(module), module.leaf_ranks, strict=True))


def _map_parts(function: Callable[[tuple[Array, int]], Array], module: _ModuleT) -> _ModuleT:
    return jax.tree.unflatten(jax.tree.structure(module), [function(part) for part in _parts(module)])


def _expand(module: _ModuleT, rank: int) -> _ModuleT:
    """`module` with at least `rank` batch dimensions on each leaf, by ones in front."""
    return _map_parts(lambda part: _align([part], max(rank, _batch_rank([part])))[0], module)


def _fill(module: _ModuleT, batch: tuple[int, ...]) -> _ModuleT:
    """`module` with every leaf broadcast to the whole batch."""
    return _map_parts(lambda part: _broadcast([part], batch)[0], module)


def _batch_shape(parts: list[tuple[Array, int]]) -> tuple[int, ...]:
    return jnp.broadcast_shapes(*(x.shape[: x.ndim - event] for x, event in parts))


# --- dtypes -------------------------------------------------------------------------------------------------


def _common_dtype(*inputs: ArrayLike):
    """The float type of the arrays among the inputs; Python numbers and lists follow, they do not lead."""
    dtypes = [x.dtype for x in inputs if hasattr(x, "dtype") and not isinstance(x, float)]
    floats = [dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.floating)]
    if not floats:
        return jnp.result_type(float)
    return jax.dtypes.canonicalize_dtype(np.result_type(*floats))


def _value(x: ArrayLike, dtype) -> Array:
    """A value as an array: float arrays keep their type, all else takes that of the distribution."""
    own = getattr(x, "dtype", None)
    keeps = own is not None and jnp.issubdtype(own, jnp.floating) and not isinstance(x, float)
    return jnp.asarray(x) if keeps else jnp.asarray(x, dtype)


def _cast(module: _ModuleT, dtype) -> _ModuleT:
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, module)


# --- checks: shapes always, values only where there are values ----------------------------------------------


def _value_of(x: Array) -> np.ndarray | None:
    """The numbers, in NumPy (nothing to compile); None under tracing, where there are none to look at."""
    return None if isinstance(x, jax.core.Tracer) else np.asarray(x)


def _the_one_given(**given: ArrayLike | None) -> tuple[str, ArrayLike]:
    present = [(name, x) for name, x in given.items() if x is not None]
    if len(present) != 1:
        names = " and ".join(given)
        got = "both" if present else "neither"
        raise invalid(names, expected="exactly one of them", got=got, cure="Sigma is one matrix, given one way.")
    return present[0]


def _check_space(loc: Array, name: str, matrix: Array) -> None:
    if loc.ndim < 1 or loc.shape[-1] < 1:
        cure = "A single space coordinate still needs its own axis."
        raise invalid("loc", expected="shape (*batch, d-1)", got=f"shape {loc.shape}", cure=cure)
    dim = loc.shape[-1]
    if matrix.ndim < 2 or matrix.shape[-2:] != (dim, dim):
        cure = "Its size must be that of loc; for scales per coordinate use jnp.diag(scale)."
        raise invalid(name, expected=f"shape (*batch, {dim}, {dim})", got=f"shape {matrix.shape}", cure=cure)


def _checked_batch(parts: list[tuple[Array, int]]) -> tuple[int, ...]:
    try:
        return _batch_shape(parts)
    except ValueError:
        shapes = ", ".join(str(x.shape[: x.ndim - event]) for x, event in parts)
        cure = "Batch dimensions come first in every parameter."
        raise invalid("batch", expected="leading dimensions that broadcast", got=shapes, cure=cure) from None


def _check_event(name: str, value: Array, event_shape: tuple[int, ...]) -> None:
    if value.shape[-1:] != event_shape:
        expected = f"shape (*batch, {event_shape[0]})"
        raise invalid(name, expected=expected, got=f"shape {value.shape}", cure="Time, if any, is last.")


def _check_scale(name: str, scale: Array) -> None:
    scale = _value_of(scale)
    if scale is not None and (scale <= 0).any():  # a NaN passes, and propagates
        got, cure = f"a least of {np.nanmin(scale)}", "It is a standard deviation."
        raise invalid(name, expected="positive numbers", got=got, cure=cure)


def _check_tril(tril: Array) -> None:
    tril = _value_of(tril)
    if tril is None:
        return
    if (np.triu(tril, 1) != 0).any():
        cure = "Take jnp.tril of it, or pass covariance_matrix."
        got = "entries above the diagonal"
        raise invalid("scale_tril", expected="lower-triangular matrices", got=got, cure=cure)
    diagonal = np.diagonal(tril, axis1=-2, axis2=-1)
    if (diagonal <= 0).any():
        got, cure = (
            f"a least entry of {np.nanmin(diagonal)}",
            "Flip the sign of its column: Sigma stays the same.",
        )
        raise invalid("scale_tril", expected="a positive diagonal", got=got, cure=cure)


def _checked_cholesky(covariance: Array, validate: bool) -> Array:
    tril, value = jnp.linalg.cholesky(covariance), _value_of(covariance)
    if not validate or value is None:
        return tril
    # Rounding of the user's own arithmetic is no asymmetry.
    tolerance = 1e3 * np.finfo(value.dtype).eps * np.abs(value).max((-1, -2), initial=0, keepdims=True)
    if (np.abs(value - np.swapaxes(value, -1, -2)) > tolerance).any():
        cure = "For a factor use scale_tril; against rounding use (C + C.T) / 2."
        raise invalid("covariance_matrix", expected="symmetric matrices", got="another", cure=cure)
    # NaN in, NaN out: only a NaN of Cholesky's own is an error.
    if (np.isnan(np.asarray(tril)).any((-1, -2)) & ~np.isnan(value).any((-1, -2))).any():
        cure = "Add a small multiple of the identity, or drop a coordinate that the others determine."
        raise invalid("covariance_matrix", expected="positive definite matrices", got="another", cure=cure)
    return tril


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
