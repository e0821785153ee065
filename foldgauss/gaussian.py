"""The Gaussians that a Folded-Gaussian consists of: of time, and of space at one time (eq:cond_dens).

Numerics: `a` is never computed, only `log a`. A log-density is finite or -inf for every finite input. Its gradient is 0
where the log-density is -inf. Elsewhere it is accurate where its parts are below `_numerics.batch.steepest`, 6e32 in
float32, and clipped or infinite beyond. With residuals of about one standard deviation it is accurate for |tau| <= 12
in float32, and for |tau| <= 34 in float64.
"""

import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, ArrayLike, Float, Key

from foldgauss._numerics.abstract import AbstractDistribution
from foldgauss._numerics.batch import (
    align,
    as_event,
    as_value,
    check_batch,
    check_finite,
    common_dtype,
    compile_eager,
    divide,
    steepest,
    vectorize,
    vectorized,
)
from foldgauss._numerics.factor import check_loc, check_matrix, check_rest, check_tril, marginal_tril, normalize_indices
from foldgauss._numerics.triangular import (
    UNROLLED_SIZE,
    Columns,
    join_columns,
    multiply_lower,
    solve_lower,
    solve_upper,
    split_columns,
)
from foldgauss._runtime.checks import require

__all__ = ["Gaussian"]

_LOG_2PI = float(np.log(2 * np.pi))
#: Standard deviations from the mean beyond which the cdf is 0 or 1 in float64.
_FAR = 40.0


class Gaussian(AbstractDistribution):
    """A Gaussian in any dimension, given by a triangular factor and a scale in log space.

        N(loc, exp(2 log_scale) L L^T),   L = base_tril

    `log_scale` serves Folded-Gaussians far from `time_loc`, where the product `exp(log_scale) L` (`scale_tril`)
    underflows and the log-density does not.

    **Shapes:** `loc` (*batch, dim), `scale_tril` (*batch, dim, dim) lower-triangular with a positive
    diagonal, `log_scale` (*batch,), all broadcast; `event_shape == (dim,)`.

    **Example:** `Gaussian(jnp.zeros(2), jnp.eye(2)).log_prob(jnp.zeros(2))  # -1.8379`

    **Source:** eq:cond_dens. **Raises:** ValueError on a wrong shape, an invalid factor, NaN or infinity.
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
        check_loc(loc)
        check_matrix("scale_tril", tril, loc.shape[-1])
        if validate_args:
            check_finite("loc", loc)
            check_finite("log_scale", log_scale)
            check_tril(tril)
        parts = [(loc, 1), (tril, 2), (log_scale, 0)]
        # Axes of size 1 instead of copies: one factor may serve a million points.
        self.loc, self.base_tril, self.log_scale = align(parts, len(check_batch(parts)))

    @property
    def event_shape(self) -> tuple[int, ...]:
        return self.loc.shape[-1:]

    @property
    def scale_tril(self) -> Float[Array, "*#batch dim dim"]:
        """Factor of the covariance, exp(log_scale) L, which may underflow to 0."""
        return jnp.exp(self.log_scale)[..., None, None] * self.base_tril

    @property
    def mean(self) -> Float[Array, "*batch dim"]:
        """`loc`, broadcast to the batch shape."""
        return jnp.broadcast_to(self.loc, (*self.batch_shape, *self.event_shape))

    @property
    def covariance_matrix(self) -> Float[Array, "*#batch dim dim"]:
        """exp(2 log_scale) L L^T, which may underflow to 0."""
        factor = self.scale_tril
        if factor.shape[-1] > UNROLLED_SIZE:
            return jnp.matmul(factor, jnp.swapaxes(factor, -1, -2))
        return (factor[..., :, None, :] * factor[..., None, :, :]).sum(-1)

    def moments(self) -> tuple[Float[Array, "*batch dim"], Float[Array, "*#batch dim dim"]]:
        """Mean (*batch, dim) and covariance matrix (*batch, dim, dim)."""
        dim = self.event_shape[0]
        return self.mean, jnp.broadcast_to(self.covariance_matrix, (*self.batch_shape, dim, dim))

    @property
    def variance(self) -> Float[Array, "*batch dim"]:
        """The diagonal of `covariance_matrix`."""
        return self.stddev**2

    @property
    def stddev(self) -> Float[Array, "*batch dim"]:
        """Standard deviations of the coordinates, which do not underflow where `variance` does."""
        unit = lax.stop_gradient(jnp.abs(self.base_tril).max(-1))  # squares may be out of the dtype's range
        unit = jnp.where((unit > 0) & jnp.isfinite(unit), unit, 1)
        length = unit * jnp.sqrt(((self.base_tril / unit[..., None]) ** 2).sum(-1))
        by_row = jnp.exp(self.log_scale)[..., None] * length
        return jnp.broadcast_to(by_row, (*self.batch_shape, *self.event_shape))

    def entropy(self) -> Float[Array, "*batch"]:
        """Differential entropy in nats, log det(Sigma) / 2 + dim (1 + log 2 pi) / 2."""
        dim = self.loc.shape[-1]
        return jnp.broadcast_to(half_log_det(self) + 0.5 * dim * (1 + _LOG_2PI), self.batch_shape)

    def cdf(self, x: Float[Array, "*#batch 1"]) -> Float[Array, "*#batch"]:
        """P(coordinate <= x), for a single coordinate. **Raises:** ValueError if there are several."""
        return vectorize(_normal_cdf, self._checked(x)[..., 0], *self._of_line())

    def icdf(self, q: Float[Array, "*#batch"]) -> Float[Array, "*#batch 1"]:
        """The quantile of a single coordinate, the inverse of `cdf`; NaN for q outside [0, 1]. **Raises:** as `cdf`."""
        quantile = vectorize(lambda q, loc, scale: loc + scale * ndtri(q), as_value(q, self.dtype), *self._of_line())
        return quantile[..., None]

    def _of_line(self) -> tuple[Float[Array, "*#batch"], Float[Array, "*#batch"]]:
        """Mean and standard deviation of the single coordinate."""
        require(
            self.event_shape == (1,),
            "cdf",
            expected="a single coordinate",
            got=f"event_shape {self.event_shape}",
            cure="Take marginal([i]) first.",
        )
        stddev = self.stddev[..., 0]  # 0 where it underflows, far from a component's time
        return self.loc[..., 0], jnp.maximum(stddev, float(jnp.finfo(stddev.dtype).tiny))

    @compile_eager
    def _log_prob(self, value: Array) -> Array:
        return vectorize(log_density, self, (value, 1))

    @compile_eager(static=("sample_shape",))
    def _sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...]) -> Array:
        return vectorize(Gaussian._transform, self, *self._draw_noise(key, (*sample_shape, *self.batch_shape)))

    def _draw_noise(self, key: Key[Array, ""], shape: tuple[int, ...]) -> list[tuple[Array, int]]:
        return [(jax.random.normal(key, (*shape, *self.event_shape), self.dtype), 1)]

    def _transform(self, noise: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """A standard normal point as a sample, of one Gaussian."""
        columns = multiply_lower(self.base_tril, split_columns(noise))
        return self.loc + join_columns([times_exp(y, self.log_scale) for y in columns])

    def _sample_from(self, key: Key[Array, ""], sample_shape: tuple[int, ...], component: Array) -> Array:
        return sample_components(self, key, component)

    def marginal(self, indices) -> "Gaussian":
        """The marginal distribution of the coordinates `indices`, in this order.

        **Raises:** ValueError on invalid indices.
        """
        indices = normalize_indices(indices, self.event_shape[0])
        tril = marginal_tril(self.base_tril, indices)
        return Gaussian(self.loc[..., np.array(indices)], tril, log_scale=self.log_scale, validate_args=False)

    def condition(self, indices, values: Float[Array, "*#batch n"]) -> "Gaussian":
        """The other coordinates, in ascending order, given these.

        **Shapes:** values (*batch, n), in the indices' order; for one coordinate a number will do.

        **Raises:** ValueError on invalid indices, all indices, or a wrong shape of values.
        """
        indices = normalize_indices(indices, self.event_shape[0])
        rest = tuple(i for i in range(self.event_shape[0]) if i not in indices)
        check_rest(rest)
        values = as_event("values", values, self.dtype, (len(indices),))
        return condition_on_first(self.marginal((*indices, *rest)), values)


def sample_components(components, key: Key[Array, ""], component: Array) -> Array:
    """A sample of each of the chosen components (*sample, *batch), by the parameters of that one only."""

    def one(components, component, *noise):
        own = jax.tree.map(lambda leaf: leaf[0 if len(leaf) == 1 else component], components)
        return own._transform(*noise)

    return vectorize(one, (components, 1), component, *components._draw_noise(key, component.shape))


def condition_on_first(dist: Gaussian, values: Float[Array, "*#batch given"]) -> Gaussian:
    """The later coordinates given the first ones: `loc_k + L_kg L_gg^-1 (values - loc_g)`, and the factor L_kk."""
    given = values.shape[-1]
    loc, tril = _mean_given_first(dist, values), dist.base_tril[..., given:, given:]
    return Gaussian(loc, tril, log_scale=dist.log_scale, validate_args=False)


@compile_eager
@vectorized(1)
def _mean_given_first(dist: Gaussian, values: Array) -> Array:
    given, loc, tril = values.size, dist.loc, dist.base_tril
    z = join_columns(solve_lower(tril[:given, :given], split_columns(values - loc[:given])))
    # One sum per coordinate instead of a matrix product: the matrices are many and small.
    return loc[given:] + (tril[given:, :given] * z[None]).sum(-1)


# --- densities ----------------------------------------------------------------------------------------------


def _normal_cdf(value: Array, loc: Array, scale: Array) -> Array:
    far = jnp.abs(value - loc) / _FAR > scale  # there quotients overflow, whose derivatives would be NaN
    z = jnp.where(far, jnp.sign(value - loc) * _FAR, divide(value - loc, jnp.where(far, 1, scale)))
    return ndtr(z)


def half_log_det(dist: Gaussian) -> Array:
    """log det(Sigma) / 2."""
    log_diagonal = jnp.log(jnp.diagonal(dist.base_tril, axis1=-2, axis2=-1)).sum(-1)
    return log_diagonal + dist.loc.shape[-1] * dist.log_scale


def log_density(dist: Gaussian, value: Float[Array, " dim"]) -> Float[Array, ""]:
    """log N(loc, exp(2 log_scale) L L^T)(value) of one Gaussian and point."""
    half_square = _half_mahalanobis(value, dist.loc, dist.base_tril, dist.log_scale)
    unreachable = jnp.isposinf(half_square)
    # Double where: 0 for the gradient of everything where the log-density is -inf.
    log_density = -jnp.where(unreachable, 0, half_square) - (half_log_det(dist) + 0.5 * value.size * _LOG_2PI)
    return jnp.where(unreachable, -jnp.inf, log_density)


@jax.custom_jvp
def _half_mahalanobis(value, loc, tril, log_scale):
    """|L^-1 (value - loc)|^2 exp(-2 log_scale) / 2."""
    residual = split_columns(value - loc)
    z = [times_exp(y, -log_scale[..., None]) for y in solve_lower(tril, residual)]
    # A residual that is infinite in one coordinate would give 0 * inf with zeros of L.
    beyond = functools.reduce(operator.or_, map(jnp.isinf, residual)).any(-1)
    return jnp.where(beyond, jnp.inf, _sum([0.5 * y * y for y in z]))


@_half_mahalanobis.defjvp
def _half_mahalanobis_jvp(primals, tangents):
    # d(|y|^2/2 e^2c) = g.(dr - dL y) + |y|^2 e^2c dc with y = L^-1 r, c = -log_scale, g = L^-T y e^2c. By hand, since
    # e^2c overflows long before g does, and because g must be 0, not inf * 0, where the result is inf. Where g
    # overflows, g dL y need not: it is computed as (L^-T z) dL z with z = y e^c. Derivatives by a
    # residual, by L and by log_scale are clipped, so that their products with those of the parameters do not overflow.
    value, loc, tril, log_scale = primals
    value_dot, loc_dot, tril_dot, log_scale_dot = tangents
    half = _half_mahalanobis(value, loc, tril, log_scale)
    unreachable, c = jnp.isposinf(half)[..., None], -log_scale[..., None]
    residual = [jnp.where(unreachable, 0, r) for r in split_columns(value - loc)]
    z = [times_exp(y, c) for y in solve_lower(tril, residual)]
    w = solve_upper(tril, z)
    limit = steepest(half.dtype)
    by_residual = [jnp.clip(times_exp(y, c), -limit, limit) for y in w]
    largest = functools.reduce(jnp.maximum, [jnp.abs(y).max(-1, keepdims=True) for y in z], 1)
    by_factor = [jnp.clip(y, -limit / largest, limit / largest) for y in w]
    by_log_scale = jnp.minimum(_sum([y * y for y in z]), limit)
    # The barrier separates the gradients of single coordinates from their concatenation. XLA on the CPU would fuse the
    # two and then select the coordinate again for every element: many times slower.
    residual_dot = lax.optimization_barrier(split_columns(value_dot - loc_dot))
    return half, (
        _sum([g * dr for g, dr in zip(by_residual, residual_dot, strict=True)])
        - _sum([g * dx for g, dx in zip(by_factor, multiply_lower(tril_dot, z), strict=True)])
        - by_log_scale * log_scale_dot
    )


def _sum(terms: Columns) -> Float[Array, "*#batch"]:
    return functools.reduce(operator.add, terms).sum(-1)


@jax.custom_jvp
def times_exp(y: Float[Array, "*#batch"], c: Float[Array, "*#batch"]):
    """y exp(c), infinite only where the product is, not where exp(c) is."""
    largest = float(np.log(jnp.finfo(y.dtype).max)) * 0.999  # slightly less: its exp must not round to inf
    # Where c is a constant, XLA would compute half * half first, which overflows; the barrier prevents it.
    half = lax.optimization_barrier(jnp.exp(0.5 * jnp.clip(c, -2 * largest, 2 * largest)))
    return y * half * half


@functools.partial(times_exp.defjvp, symbolic_zeros=True)
def _times_exp_jvp(primals, tangents):
    (y, c), (y_dot, c_dot) = primals, tangents
    product = times_exp(y, c)
    tangent = jnp.zeros_like(product) if isinstance(y_dot, SymbolicZero) else times_exp(y_dot, c)
    return product, tangent if isinstance(c_dot, SymbolicZero) else tangent + product * c_dot  # 0 inf would be NaN
