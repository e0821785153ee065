"""The triangular factor of a space covariance from any of its representations, and checks of it."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from foldgauss._numerics.batch import check_finite, check_positive, check_values, concrete_value
from foldgauss._runtime.checks import is_integer, require


def resolve_scale_tril(given: dict[str, ArrayLike | None], *, dim: int, dtype, validate: bool) -> Array:
    """The lower-triangular factor L of Sigma = L L^T, from the one matrix (or scales) that is given."""
    names = [name for name, x in given.items() if x is not None]
    require(
        len(names) == 1,
        ", ".join(given),
        expected="exactly one of them",
        got=" and ".join(names) or "none",
        cure="Sigma is one matrix, given one way.",
    )
    name, matrix = names[0], jnp.asarray(given[names[0]], dtype)
    if name == "scale":
        return _diagonal(matrix, dim, validate)
    check_matrix(name, matrix, dim)
    if name == "scale_tril":
        if validate:
            check_tril(matrix)
        return matrix
    if name == "covariance_matrix":
        return check_and_factorize(name, matrix, validate)
    # P = U^T U with U lower is a Cholesky factorization from the last coordinate on; then L = U^-1.
    upper = check_and_factorize(name, matrix[..., ::-1, ::-1], validate)[..., ::-1, ::-1]
    identity = jnp.broadcast_to(jnp.eye(dim, dtype=dtype), matrix.shape)
    return jnp.tril(lax.linalg.triangular_solve(jnp.swapaxes(upper, -1, -2), identity, left_side=True, lower=True))


def check_loc(loc: Array) -> None:
    require(
        loc.ndim >= 1 and loc.shape[-1] >= 1,
        "loc",
        expected="shape (*batch, d-1)",
        got=f"shape {loc.shape}",
        cure="A single space coordinate still needs its own axis.",
    )


def check_matrix(name: str, matrix: Array, dim: int) -> None:
    require(
        matrix.ndim >= 2 and matrix.shape[-2:] == (dim, dim),
        name,
        expected=f"shape (*batch, {dim}, {dim})",
        got=f"shape {matrix.shape}",
        cure="Its size must be that of loc; scales per coordinate are `scale`.",
    )


def _diagonal(scale: Array, dim: int, validate: bool) -> Array:
    require(
        scale.ndim >= 1 and scale.shape[-1] == dim,
        "scale",
        expected=f"shape (*batch, {dim})",
        got=f"shape {scale.shape}",
        cure="It is a standard deviation for each coordinate of loc.",
    )
    if validate:
        check_positive("scale", scale)
    # Where, not times: an infinite scale must not put NaN off the diagonal.
    return jnp.where(jnp.eye(dim, dtype=bool)[(None,) * (scale.ndim - 1)], scale[..., None], 0)


def check_tril(tril: Array) -> None:
    check_finite("scale_tril", tril)
    cure = "Take jnp.tril of it, or pass covariance_matrix."
    check_values("scale_tril", tril, lambda x: np.triu(x, 1) == 0, "lower-triangular matrices", cure)
    cure = "Flip the sign of its column: Sigma stays the same."
    check_values("scale_tril", tril, lambda x: (x > 0) | ~np.eye(x.shape[-1], dtype=bool), "a positive diagonal", cure)


def check_and_factorize(name: str, covariance: Array, validate: bool) -> Array:
    tril, value = jnp.linalg.cholesky(covariance), concrete_value(covariance)
    if not validate or value is None:
        return tril
    check_finite(name, covariance)
    # Asymmetry of the size of rounding is allowed.
    tolerance = 1e3 * np.finfo(value.dtype).eps * np.abs(value).max((-1, -2), initial=0, keepdims=True)
    require(
        (np.abs(value - np.swapaxes(value, -1, -2)) <= tolerance).all(),
        name,
        expected="symmetric matrices",
        got="another",
        cure="For a factor use scale_tril; against rounding use (C + C.T) / 2.",
    )
    require(
        not np.isnan(np.asarray(tril)).any(),
        name,
        expected="positive definite matrices",
        got="another",
        cure="Add a small multiple of the identity, or drop a coordinate that the others determine.",
    )
    return tril


def marginal_tril(tril: Float[Array, "*batch dim dim"], indices: tuple[int, ...]) -> Float[Array, "*batch kept kept"]:
    """Factor of the covariance of some coordinates, in any order, by QR: the covariance is never formed."""
    if indices == tuple(range(len(indices))):
        return tril[..., : len(indices), : len(indices)]
    rows = tril[..., np.array(indices), :]
    upper = jnp.linalg.qr(jnp.swapaxes(rows, -1, -2), mode="r")
    sign = jnp.where(jnp.diagonal(upper, axis1=-2, axis2=-1) < 0, -1, 1).astype(upper.dtype)
    return jnp.tril(jnp.swapaxes(upper * sign[..., :, None], -1, -2))


def normalize_indices(indices, dim: int) -> tuple[int, ...]:
    """Coordinates counted from 0, each once, from any integers (negative ones count from the end)."""
    cure = f"The coordinates are 0 to {dim - 1}, time is {dim - 1} (or -1)."
    given = np.atleast_1d(np.asarray(indices, object)).tolist()
    require(
        given and all(is_integer(i, -np.inf) for i in given),  # a mask is not indices
        "indices",
        expected="whole numbers, at least one",
        got=repr(indices),
        cure=cure,
    )
    require(
        all(-dim <= i < dim for i in given),
        "indices",
        expected=f"numbers from {-dim} to {dim - 1}",
        got=repr(indices),
        cure=cure,
    )
    result = tuple(int(i) % dim for i in given)
    require(len(set(result)) == len(result), "indices", expected="each coordinate once", got=repr(indices), cure=cure)
    return result


def check_rest(rest: tuple[int, ...]) -> None:
    """Raise unless some coordinates are left once others are given."""
    require(
        rest,
        "indices",
        expected="at least one coordinate that is not given",
        got="all",
        cure="For the density use log_prob.",
    )
