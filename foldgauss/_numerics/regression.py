"""Polynomials of time: weighted regression of space on time, by QR in Hermite polynomials, and shifts of time."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import hermite_e

from foldgauss._numerics.triangular import solve_upper_matrix

_Points = Float[Array, "n d-1"]


class Regression(NamedTuple):
    """Least squares of rows with variances `exp(log_a) Sigma` and frequency weights w.

    With B the Hermite design and W = diag(w / a): `B' W B = exp(2 log_unit) R' R`.
    """

    coefficients: Float[Array, "k d-1"]  # of the Hermite polynomials
    fitted: _Points
    triangle: Float[Array, "k k"]  # R
    log_unit: Float[Array, ""]  # largest log sqrt(1/a): rows are scaled by it, so that no 1/a overflows
    rank_deficient: Float[Array, ""]


def hermite(v: Float[Array, "*batch"], degree: int) -> Float[Array, "*batch k"]:
    """He_k(v) / sqrt(k!), k = 0..degree: orthonormal under the standard normal.

    **Source:** the three-term recurrence of the probabilists' Hermite polynomials.
    """
    return jnp.stack(hermite_columns(v, degree), axis=-1)


def hermite_columns(v: Float[Array, "*batch"], degree: int) -> list[Float[Array, "*batch"]]:
    """The columns of `hermite` as a list."""
    columns = [jnp.ones_like(v), v][: degree + 1]
    for k in range(1, degree):
        columns.append((v * columns[k] - math.sqrt(k) * columns[k - 1]) / math.sqrt(k + 1))
    return columns


def hermite_to_powers(degree: int) -> np.ndarray:
    """The matrix from coefficients of `hermite` to coefficients of powers of v: integers over sqrt(k!)."""
    matrix = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        matrix[: k + 1, k] = hermite_e.herme2poly(np.eye(degree + 1)[k][: k + 1]) / math.sqrt(math.factorial(k))
    return matrix


def shift_polynomial(
    coefficients: Float[Array, "*batch k dim"], shift: Float[Array, "*batch"]
) -> list[Float[Array, "*batch dim"]]:
    """Coefficients of p(v + shift), given those of p. Row j belongs to v^j. Arrays are of JAX or NumPy."""
    rows = [coefficients[..., j, :] for j in range(coefficients.shape[-2])]
    for start in range(len(rows) - 1):  # Taylor's shift by Horner's scheme
        for j in reversed(range(start, len(rows) - 1)):
            rows[j] = rows[j] + shift[..., None] * rows[j + 1]
    return rows


def weighted_regression(
    v: Float[Array, " n"],
    y: _Points,
    log_a: Float[Array, " n"],
    weights: Float[Array, " n"],
    degree: int,
) -> Regression:
    """argmin over polynomials g of `sum_i w_i |y_i - g(v_i)|^2 / a_i`, the same for every Sigma.

    With the same design and weights in every coordinate, least squares per coordinate equals generalized least squares
    with a full Sigma (Zellner's theorem).
    """
    design = hermite(v, degree)
    present = weights > 0
    log_unit = jnp.max(jnp.where(present, -0.5 * log_a, -jnp.inf))
    row = jnp.where(present, jnp.sqrt(weights) * jnp.exp(-0.5 * log_a - log_unit), 0)[:, None]
    q, r = jnp.linalg.qr(row * design)
    diagonal = jnp.abs(jnp.diagonal(r))
    length = jnp.sqrt((r * r).sum(0))  # of the columns, to which diagonal entries are compared
    rank_deficient = (diagonal <= 8 * degree * jnp.finfo(v.dtype).eps * length).any() | (length == 0).any()
    safe = jnp.where(rank_deficient, jnp.eye(degree + 1, dtype=r.dtype), r)
    coefficients = solve_upper_matrix(safe, jnp.matmul(q.T, row * y))
    return Regression(coefficients, jnp.matmul(design, coefficients), safe, log_unit, rank_deficient)
