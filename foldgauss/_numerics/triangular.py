"""Triangular algebra for many systems: small vectors as lists of columns, which XLA fuses to one loop."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Vector = Float[Array, "*#batch dim"]
Matrix = Float[Array, "*#batch dim dim"]
#: A small vector is one array (*batch, 1) per coordinate, since XLA does not fuse loops across stacking them. A large
#: one is one array (*batch, dim), since separate coordinates would take minutes to compile.
Columns = list[Array]

#: Up to this size triangular systems are written out: XLA's CPU solver is called once per matrix and is 10x slower.
UNROLLED_SIZE = 8


def split_columns(x: Vector) -> Columns:
    dim = x.shape[-1]
    return [x] if dim > UNROLLED_SIZE else [x[..., i : i + 1] for i in range(dim)]


def join_columns(columns: Columns) -> Vector:
    return columns[0] if len(columns) == 1 else jnp.concatenate(jnp.broadcast_arrays(*columns), axis=-1)


def solve_lower(tril: Matrix, b: Columns) -> Columns:
    """L^-1 b by forward substitution."""
    if tril.shape[-1] > UNROLLED_SIZE:
        return [_solve_large(tril, b[0], transpose=False)]
    x: Columns = []
    for i, rest in enumerate(b):
        for j in range(i):
            rest = rest - tril[..., i, j, None] * x[j]
        x.append(rest / tril[..., i, i, None])
    return x


def solve_upper(tril: Matrix, b: Columns) -> Columns:
    """L^-T b by back substitution."""
    if tril.shape[-1] > UNROLLED_SIZE:
        return [_solve_large(tril, b[0], transpose=True)]
    x: Columns = []
    for i in reversed(range(len(b))):
        rest = b[i]
        for j, known in zip(reversed(range(i + 1, len(b))), x, strict=True):
            rest = rest - tril[..., j, i, None] * known
        x.append(rest / tril[..., i, i, None])
    return x[::-1]


def solve_upper_matrix(upper: Float[Array, "dim dim"], b: Float[Array, "dim columns"]) -> Float[Array, "dim columns"]:
    """R^-1 B for one upper triangle; many by `jax.vmap`.

    Unrolled not only for speed: jaxlib 0.10's solver for batches waits, on a worker of XLA's pool, for other workers
    of that pool, so that two independent solves can deadlock on two cores.
    """
    if upper.shape[-1] > UNROLLED_SIZE:
        return lax.linalg.triangular_solve(upper, b, left_side=True, lower=False)
    rows = solve_upper(upper.T[None], [row[:, None] for row in b])
    return jnp.concatenate([row.T for row in rows])


def multiply_lower(tril: Matrix, x: Columns) -> Columns:
    """L x, reading the lower triangle only."""
    if tril.shape[-1] > UNROLLED_SIZE:
        return [jnp.matmul(jnp.tril(tril), x[0][..., None])[..., 0]]
    return [
        sum((tril[..., i, j, None] * x[j] for j in range(1, i + 1)), tril[..., i, 0, None] * x[0])
        for i in range(len(x))
    ]


def _solve_large(tril: Matrix, b: Vector, *, transpose: bool) -> Vector:
    """One solve with all of b as right-hand sides if there is one matrix, else a solve per matrix."""
    dim = b.shape[-1]
    solve = lambda a, b: lax.linalg.triangular_solve(a, b, left_side=True, lower=True, transpose_a=transpose)  # noqa: E731
    if all(size == 1 for size in tril.shape[:-2]):
        return solve(tril.reshape(dim, dim), b.reshape(-1, dim).T).T.reshape(b.shape)
    batch = jnp.broadcast_shapes(tril.shape[:-2], b.shape[:-1])
    tril, b = jnp.broadcast_to(tril, (*batch, dim, dim)), jnp.broadcast_to(b, (*batch, dim))
    return solve(tril, b[..., None])[..., 0]


# --- batches of small matrices, by products only (see `solve_upper_matrix` on jaxlib's own solver) ------------------


def cholesky(matrix: Matrix) -> Matrix:
    """L with L L' = matrix, column by column; NaN where a pivot is not positive."""
    dim = matrix.shape[-1]

    def column(j, tril):
        rest = matrix[..., :, j] - jnp.einsum("...ab,...b->...a", tril, tril[..., j, :])
        pivot = rest[..., j]
        root = jnp.sqrt(jnp.where(pivot > 0, pivot, jnp.nan))
        below = jnp.where(jnp.arange(dim) >= j, 1, 0).astype(matrix.dtype)
        return tril.at[..., :, j].set(rest * below.reshape((1,) * (rest.ndim - 1) + (dim,)) / root[..., None])

    return _each_column(column, jnp.zeros_like(matrix))


def inverse_lower(tril: Matrix) -> Matrix:
    """L^-1, row by row."""
    eye = jnp.eye(tril.shape[-1], dtype=tril.dtype)

    def row(i, inverse):
        new = -jnp.einsum("...b,...bc->...c", tril[..., i, :], inverse)
        new = new + jnp.broadcast_to(eye[i], new.shape)
        return inverse.at[..., i, :].set(new / tril[..., i, i, None])

    return _each_column(row, jnp.zeros_like(tril))


def log_det(tril: Matrix) -> Float[Array, "*#batch"]:
    """log |L L'|."""
    return 2 * jnp.log(jnp.diagonal(tril, axis1=-2, axis2=-1)).sum(-1)


def _each_column(body, start):
    dim = start.shape[-1]
    if dim > UNROLLED_SIZE:
        return lax.fori_loop(0, dim, body, start)
    for j in range(dim):
        start = body(j, start)
    return start
