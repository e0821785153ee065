"""The factor of a space covariance from whichever matrix the caller has."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from foldgauss._batch import known
from foldgauss._checks import invalid


def the_one_given(**given: ArrayLike | None) -> tuple[str, ArrayLike]:
    present = [(name, x) for name, x in given.items() if x is not None]
    if len(present) != 1:
        names = " and ".join(given)
        got = "both" if present else "neither"
        raise invalid(names, expected="exactly one of them", got=got, cure="Sigma is one matrix, given one way.")
    return present[0]


def check_space(loc: Array, name: str, matrix: Array) -> None:
    if loc.ndim < 1 or loc.shape[-1] < 1:
        cure = "A single space coordinate still needs its own axis."
        raise invalid("loc", expected="shape (*batch, d-1)", got=f"shape {loc.shape}", cure=cure)
    dim = loc.shape[-1]
    if matrix.ndim < 2 or matrix.shape[-2:] != (dim, dim):
        cure = "Its size must be that of loc; for scales per coordinate use jnp.diag(scale)."
        raise invalid(name, expected=f"shape (*batch, {dim}, {dim})", got=f"shape {matrix.shape}", cure=cure)


def check_tril(tril: Array) -> None:
    tril = known(tril)
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


def checked_cholesky(covariance: Array, validate: bool) -> Array:
    tril, value = jnp.linalg.cholesky(covariance), known(covariance)
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
