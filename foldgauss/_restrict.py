"""Some of the space coordinates: of a fold, of a factor."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._checks import invalid
from foldgauss.fold import AbstractFold, PolynomialFold, ZeroFold


class RestrictedFold(AbstractFold):
    """Some coordinates of a fold of any class, `f(u)[indices]`."""

    fold: AbstractFold
    indices: tuple[int, ...] = eqx.field(static=True)

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return self.fold.leaf_ranks

    @property
    def is_closed(self) -> bool:
        return self.fold.is_closed

    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch kept"]:
        return self.fold(u)[..., np.array(self.indices)]


def restricted_fold(fold: AbstractFold, indices: tuple[int, ...]) -> AbstractFold:
    if isinstance(fold, ZeroFold):
        return ZeroFold(len(indices))
    if isinstance(fold, PolynomialFold):
        return PolynomialFold(fold.coefficients[..., np.array(indices)])
    return RestrictedFold(fold, indices)


def restricted_tril(tril: Float[Array, "*batch dim dim"], indices: tuple[int, ...]) -> Float[Array, "*batch kept kept"]:
    """Factor of the covariance of some coordinates, in any order, by QR: the covariance is never formed."""
    if indices == tuple(range(len(indices))):
        return tril[..., : len(indices), : len(indices)]
    rows = tril[..., np.array(indices), :]
    upper = jnp.linalg.qr(jnp.swapaxes(rows, -1, -2), mode="r")
    sign = jnp.where(jnp.diagonal(upper, axis1=-2, axis2=-1) < 0, -1, 1).astype(upper.dtype)
    return jnp.tril(jnp.swapaxes(upper * sign[..., :, None], -1, -2))


def checked_indices(indices, dim: int) -> tuple[int, ...]:
    """Coordinates counted from 0, each once, from any integers (negative ones count from the end)."""
    cure = f"The coordinates are 0 to {dim - 1}, time is {dim - 1} (or -1)."
    try:
        given = [int(i) for i in np.atleast_1d(np.asarray(indices)) if i == int(i)]
    except (TypeError, ValueError):
        given = None
    if given is None or len(given) != np.size(indices) or not given:
        raise invalid("indices", expected="whole numbers, at least one", got=repr(indices), cure=cure)
    if any(not -dim <= i < dim for i in given):
        raise invalid("indices", expected=f"numbers from {-dim} to {dim - 1}", got=repr(indices), cure=cure)
    result = tuple(i % dim for i in given)
    if len(set(result)) != len(result):
        raise invalid("indices", expected="each coordinate once", got=repr(indices), cure=cure)
    return result
