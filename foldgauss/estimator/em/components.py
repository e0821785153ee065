"""Mixture components as arrays, and their densities at many points: points by rows, components by columns.

In fitting, the curve of component k is a polynomial in its own dimensionless v = (time_loc - t) / time_scale:

    loc + f(time_loc - t) = sum_j curve_j v^j

so that all parameters are of order one once the points are centered and scaled. Tests compare this with
`FoldedGaussian.condition_time`, where the fold equation is defined.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._numerics.batch import cast
from foldgauss._numerics.regression import hermite_to_powers, shift_polynomial
from foldgauss._numerics.triangular import UNROLLED_SIZE, inverse_lower, log_det
from foldgauss.envelope import AbstractEnvelope, Constant

_LOG_2PI = math.log(2 * math.pi)


class Parameters(NamedTuple):
    """K components; vmap adds a leading axis for restarts."""

    log_weights: Float[Array, " k"]
    time_loc: Float[Array, " k"]
    time_scale: Float[Array, " k"]
    curve: Float[Array, "k q+1 d-1"]  # row j multiplies v^j
    tril: Float[Array, "k d-1 d-1"]

    @property
    def degree(self) -> int:
        return self.curve.shape[-2] - 1


class Densities(NamedTuple):
    """The density of every pair of point and component, and its terms. Few space coordinates are a list of columns:
    stacking them would be another pass over memory (see `foldgauss._numerics.triangular`)."""

    v: Float[Array, "n k"]
    whitened: list[Array]  # L^-1 (s - curve): d-1 arrays (n, k), or one (n, k, d-1)
    log_a: Float[Array, "n k"] | None  # None where a = 1
    log_density: Float[Array, "n k"]  # with the weight of the component


def evaluate_densities(params: Parameters, envelope: AbstractEnvelope, x: Float[Array, "n d"]) -> Densities:
    """log (w_k FN_k(x_i)) of every pair (eq:foldgauss), and its terms."""
    envelope, dim = cast(envelope, x.dtype), params.tril.shape[-1]
    t = x[:, -1:]
    v = (params.time_loc[None] - t) * (1 / params.time_scale)[None]
    inverse = inverse_lower(params.tril)
    if dim <= UNROLLED_SIZE:
        residual = [x[:, j : j + 1] - _evaluate_polynomial(params.curve[:, :, j], v) for j in range(dim)]
        whitened = [sum(inverse[None, :, a, b] * residual[b] for b in range(a + 1)) for a in range(dim)]
        square = sum(e * e for e in whitened)
    else:
        fitted = _evaluate_polynomial(params.curve, v[..., None])
        whitened = [jnp.einsum("kab,nkb->nka", inverse, x[:, None, :-1] - fitted)]
        square = (whitened[0] * whitened[0]).sum(-1)
    constant = params.log_weights - 0.5 * log_det(params.tril) - jnp.log(params.time_scale) - 0.5 * (dim + 1) * _LOG_2PI
    if isinstance(envelope, Constant):
        return Densities(v, whitened, None, constant[None] - 0.5 * (square + v * v))
    log_a = envelope.log_a(t, time_loc=params.time_loc[None], time_scale=params.time_scale[None])
    # exp(-log_a) overflows only where the density underflows; 0 * inf would be NaN.
    over_a = square * jnp.exp(jnp.minimum(-log_a, 0.95 * float(np.log(jnp.finfo(v.dtype).max))))
    return Densities(v, whitened, log_a, constant[None] - 0.5 * (over_a + v * v + dim * log_a))


def change_variable(curve: Float[Array, "*batch q+1 dim"], shift, ratio) -> Float[Array, "*batch q+1 dim"]:
    """The same curve in powers of v' where v = shift + ratio v'."""
    powers = [jnp.ones_like(ratio)]
    for _ in range(curve.shape[-2] - 1):
        powers.append(powers[-1] * ratio)
    rows = shift_polynomial(curve, shift)
    return jnp.stack([row * power[..., None] for row, power in zip(rows, powers, strict=True)], axis=-2)


def to_powers(coefficients: Float[Array, "*batch k dim"]) -> Float[Array, "*batch k dim"]:
    """Convert coefficients of `hermite` to coefficients of powers."""
    matrix = jnp.asarray(hermite_to_powers(coefficients.shape[-2] - 1), coefficients.dtype)
    return jnp.einsum("jk,...kd->...jd", matrix, coefficients)


def _evaluate_polynomial(
    coefficients: Float[Array, "k q+1 *dim"], v: Float[Array, "n k *one"]
) -> Float[Array, "n k *dim"]:
    value = coefficients[None, :, -1]
    for j in reversed(range(coefficients.shape[1] - 1)):
        value = value * v + coefficients[None, :, j]
    return value
