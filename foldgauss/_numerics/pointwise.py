"""Functions of scalars, with or without parameters, called for every element of a batch."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


def split_parameters(function: Callable) -> tuple[PyTree, PyTree, tuple[int, ...]]:
    """The arrays of a callable pytree, the rest of it, and the rank of each array for one function."""
    parameters, static = eqx.partition(function, eqx.is_array)
    return parameters, static, tuple(x.ndim for x in jax.tree.leaves(parameters))


def call_elementwise(parameters: PyTree, static: PyTree, ranks: tuple[int, ...], *scalars: Array) -> Array:
    """`function(*scalars)` elementwise; dimensions of the parameters in front of their ranks are batch."""
    leaves, treedef = jax.tree.flatten(parameters)
    events = [x.shape[x.ndim - r :] for x, r in zip(leaves, ranks, strict=True)]
    own = [x.shape[: x.ndim - r] for x, r in zip(leaves, ranks, strict=True)]
    batch = jnp.broadcast_shapes(*map(jnp.shape, scalars), *own)
    flat, axis = [jnp.broadcast_to(x, batch).reshape(-1) for x in scalars], None
    if any(size != 1 for shape in own for size in shape):  # else one set serves all: no copies of it
        leaves, axis = [jnp.broadcast_to(x, batch + e) for x, e in zip(leaves, events, strict=True)], 0
    to = () if axis is None else (flat[0].size,)
    parameters = [x.reshape(to + e) for x, e in zip(leaves, events, strict=True)]

    def one(leaves, *scalars):
        return jnp.asarray(eqx.combine(jax.tree.unflatten(treedef, leaves), static)(*scalars))

    result = jax.vmap(one, in_axes=(axis, *[0] * len(flat)))(parameters, *flat)
    return result.reshape(batch + result.shape[1:])
