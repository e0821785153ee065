"""The Gaussians that a Folded-Gaussian is made of: of time alone, and of space at one time (eq:cond_dens).

Numerics: `a` is never formed, only `log a`. A log-density is finite or -inf for every finite input. Its
gradient is 0 where it is -inf, and never NaN; the gradient with respect to the value saturates at the largest
finite number.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Key

from foldgauss._batch import (
    align,
    as_value,
    batch_of,
    check_event,
    check_positive,
    checked_batch,
    common_dtype,
    parts_of,
)
from foldgauss._factor import check_space, check_tril

__all__ = ["Gaussian", "Normal"]

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
        dtype = common_dtype(loc, scale)
        self.loc, self.scale = align([(jnp.asarray(loc, dtype), 0), (jnp.asarray(scale, dtype), 0)])
        if validate_args:
            check_positive("scale", self.scale)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return ()

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (0, 0)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return batch_of(parts_of(self))

    def log_prob(self, value: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
        """log N(loc, scale^2)(value)."""
        return _as_gaussian(self).log_prob(as_value(value, self.loc.dtype)[..., None])

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
        dtype = common_dtype(loc, scale_tril, log_scale)
        loc, tril, log_scale = (jnp.asarray(x, dtype) for x in (loc, scale_tril, log_scale))
        check_space(loc, "scale_tril", tril)
        if validate_args:
            check_tril(tril)
        parts = [(loc, 1), (tril, 2), (log_scale, 0)]
        checked_batch(parts)
        # Ones in front instead of copies: one factor may serve a million times.
        self.loc, self.base_tril, self.log_scale = align(parts)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return self.loc.shape[-1:]

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (1, 2, 0)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return batch_of(parts_of(self))

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
        value = as_value(value, self.loc.dtype)
        check_event("value", value, self.event_shape)
        value, loc, tril, log_scale = align([(value, 1), (self.loc, 1), (self.base_tril, 2), (self.log_scale, 0)])
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
        noise, loc, tril, log_scale = align([(noise, 1), (self.loc, 1), (self.base_tril, 2), (self.log_scale, 0)])
        return loc + jnp.exp(log_scale)[..., None] * _lower_times(tril, noise)


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
