"""Cholesky factors and their inverses for batches of small matrices, by products only.

The factor of a singular matrix is NaN. See `foldgauss._numerics.triangular` on jaxlib's own solver for batches.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from foldgauss._numerics.triangular import UNROLLED_SIZE, Matrix


def cholesky(matrix: Matrix) -> Matrix:
    """L with L L' = matrix, column by column; NaN where a pivot is not positive."""
    dim = matrix.shape[-1]

    def column(j, tril):
        rest = matrix[..., :, j] - jnp.einsum("...ab,...b->...a", tril, tril[..., j, :])
        pivot = rest[..., j]
        root = jnp.sqrt(jnp.where(pivot > 0, pivot, jnp.nan))
        below = jnp.where(jnp.arange(dim) >= j, 1, 0).astype(matrix.dtype)
        return tril.at[..., :, j].set(rest * below.reshape((1,) * (rest.ndim - 1) + (dim,)) / root[..., None])

    return _loop(column, jnp.zeros_like(matrix))


def inverse_lower(tril: Matrix) -> Matrix:
    """L^-1, row by row."""
    eye = jnp.eye(tril.shape[-1], dtype=tril.dtype)

    def row(i, inverse):
        new = -jnp.einsum("...b,...bc->...c", tril[..., i, :], inverse)
        new = new + jnp.broadcast_to(eye[i], new.shape)
        return inverse.at[..., i, :].set(new / tril[..., i, i, None])

    return _loop(row, jnp.zeros_like(tril))


def log_det(tril: Matrix) -> Float[Array, "*#batch"]:
    """log |L L'|."""
    return 2 * jnp.log(jnp.diagonal(tril, axis1=-2, axis2=-1)).sum(-1)


def _loop(body, start):
    dim = start.shape[-1]
    if dim > UNROLLED_SIZE:
        return lax.fori_loop(0, dim, body, start)
    for j in range(dim):
        start = body(j, start)
    return start
