"""The fold f: where a Folded-Gaussian's centre goes as time moves away from its own time (eq:cond_dens).

A fold is a function of `u = time_loc - t` (note the sign), from a scalar to R^(d-1).
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, PyTree

from foldgauss._checks import invalid

__all__ = ["AbstractFold", "CallableFold", "PolynomialFold", "ZeroFold", "as_fold"]


class AbstractFold(eqx.Module):
    """A fold with batch dimensions: `fold(u)` takes u of shape (*batch,) to shifts (*batch, d-1).

    To extend: let further leading dimensions of the leaves broadcast against those of `u`, and say in
    `leaf_ranks` where they begin. A function of one scalar needs no class: `as_fold` wraps it.
    """

    @property
    @abstractmethod
    def leaf_ranks(self) -> tuple[int, ...]:
        """Rank of each leaf (in the order of `jax.tree.leaves`) for one fold; what is in front is batch."""

    @abstractmethod
    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        """The shift f(u)."""


class ZeroFold(AbstractFold):
    """No fold: `f(u) = 0`, the centre stands still.

    **Shapes:** u (*batch,) -> (*batch, dim), with `dim = d - 1`.

    **Example:** `ZeroFold(2)(0.3)  # [0., 0.]`

    **Source:** the plain Gaussian of eq:gauss_2d. **Raises:** ValueError if `dim` is no whole number >= 1.
    """

    dim: int = eqx.field(static=True)

    def __init__(self, dim: int):
        if not isinstance(dim, int) or dim < 1:
            raise invalid("dim", expected="a whole number >= 1", got=repr(dim), cure="It is d - 1.")
        self.dim = dim

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return ()

    def __call__(self, u: Float[Array, "*batch"]) -> Float[Array, "*batch d-1"]:
        return jnp.zeros((*jnp.shape(u), self.dim), jnp.result_type(u))


class PolynomialFold(AbstractFold):
    """The paper's fold, a polynomial without constant term.

        f(u) = sum_{k=1..degree} c_k u^k

    **Shapes:** `coefficients` (*batch, degree, d-1), row `k - 1` is `c_k`; u (*batch,) -> (*batch, d-1),
    leading dimensions broadcast. Degree 0 is allowed and is the zero fold.

    **Units:** `c_k` is space / time^k, u is time.

    **Example:** `PolynomialFold([[-1.0], [0.5]])(4.0)  # [-4 + 8] = [4.]`

    **Source:** f of eq:cond_dens, a polynomial as in the text after eq:cond_pdf_2d.
    **Raises:** ValueError if `coefficients` has fewer than two dimensions or no space coordinate.
    """

    coefficients: Float[Array, "*batch degree d-1"]

    def __init__(self, coefficients: ArrayLike):
        coefficients = jnp.asarray(coefficients)
        if coefficients.ndim < 2 or coefficients.shape[-1] < 1:
            raise invalid(
                "coefficients",
                expected="shape (*batch, degree, d-1)",
                got=f"shape {coefficients.shape}",
                cure="Row k-1 holds c_k; a single space coordinate still needs its own axis.",
            )
        floating = jnp.issubdtype(coefficients.dtype, jnp.floating)
        self.coefficients = coefficients if floating else coefficients.astype(float)

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return (2,)

    @property
    def degree(self) -> int:
        """Highest power of u."""
        return self.coefficients.shape[-2]

    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        u = jnp.asarray(u)
        rank = max(u.ndim, self.coefficients.ndim - 2)
        coefficients, u = _with_rank(self.coefficients, rank + 2), _with_rank(u, rank)[..., None]
        batch = jnp.broadcast_shapes(u.shape[:-1], coefficients.shape[:-2])
        shift = jnp.zeros((*batch, coefficients.shape[-1]), jnp.result_type(u, coefficients))
        for k in reversed(range(self.degree)):  # Horner: no power of u is ever formed
            shift = u * (shift + coefficients[..., k, :])
        return shift


class CallableFold(AbstractFold):
    """Any function of one scalar, with or without parameters, as a fold: `f(u) = function(u)`.

    **Shapes:** `function` takes one scalar u to (d-1,); this class vmaps it, u (*batch,) -> (*batch, d-1).
    Arrays inside `function` (a pytree, say an `equinox.nn.MLP`) are leaves of the fold and are trained with
    it. They are the parameters of *one* fold; a batch of parameters comes from `vmap` over the constructor.

    **Example:** `CallableFold(lambda u: jnp.stack([jnp.sin(u), u**2]))(jnp.zeros(5))  # shape (5, 2)`

    **Source:** the "suitably chosen" f of eq:transform_s. **Raises:** ValueError if `function` is not
    callable.
    """

    parameters: PyTree
    static: PyTree = eqx.field(static=True)
    # Taken at construction, where there is one fold, so that a later vmap cannot blur where its axes begin.
    parameter_ranks: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, function: Callable[[Float[Array, ""]], Float[Array, "d-1"]]):
        if not callable(function):
            raise invalid("function", expected="a callable u -> (d-1,)", got=repr(function))
        self.parameters, self.static = eqx.partition(function, eqx.is_array)
        self.parameter_ranks = tuple(x.ndim for x in jax.tree.leaves(self.parameters))

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return self.parameter_ranks

    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        leaves, treedef = jax.tree.flatten(self.parameters)
        events = [x.shape[x.ndim - r :] for x, r in zip(leaves, self.parameter_ranks, strict=True)]
        own = [x.shape[: x.ndim - r] for x, r in zip(leaves, self.parameter_ranks, strict=True)]
        batch = jnp.broadcast_shapes(jnp.shape(u), *own)
        flat_u, axis = jnp.broadcast_to(u, batch).reshape(-1), None
        if any(size != 1 for shape in own for size in shape):  # else one set serves all: no copies of it
            leaves, axis = [jnp.broadcast_to(x, batch + e) for x, e in zip(leaves, events, strict=True)], 0
        to = () if axis is None else (flat_u.size,)
        parameters = [x.reshape(to + e) for x, e in zip(leaves, events, strict=True)]
        one = lambda leaves, u: eqx.combine(jax.tree.unflatten(treedef, leaves), self.static)(u)  # noqa: E731
        shift = jax.vmap(one, in_axes=(axis, 0))(parameters, flat_u)
        return shift.reshape(batch + shift.shape[1:])


def as_fold(fold: AbstractFold | Callable) -> AbstractFold:
    """`fold` itself if it is one, else the callable wrapped (and so vmapped) by `CallableFold`."""
    return fold if isinstance(fold, AbstractFold) else CallableFold(fold)


def _with_rank(x: Array, rank: int) -> Array:
    """`x` with ones in front up to `rank` dimensions: broadcasting said aloud, and free under jit."""
    return lax.expand_dims(x, range(rank - x.ndim))
