"""Batch dimensions, dtypes and checks of modules whose `leaf_ranks` are their leaves' ranks without batch axes."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import ClassVar, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, PyTree

from foldgauss._runtime.checks import invalid, is_integer, require, short_repr

_ModuleT = TypeVar("_ModuleT", bound=eqx.Module)


class BatchModule(eqx.Module):
    """A module with leading batch dimensions on all leaves, whose fields are annotated with their shapes."""

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        """Rank of each leaf (in the order of `jax.tree.leaves`) without batch dimensions.

        By the annotations: `Float[Array, "*batch degree d-1"]` has rank 2, a field that is a module the ranks of its
        own leaves; static fields and None have none. Override it for fields of other types.
        """
        ranks = []
        for name, rank in _declared_ranks(type(self)):
            value = getattr(self, name)
            if isinstance(value, eqx.Module):
                ranks += value.leaf_ranks
            elif value is not None:
                require(
                    rank is not None,
                    type(self).__name__,
                    expected='annotated as Float[Array, "*batch ..."]',
                    got=f"field {name} without its shape",
                    cure="Or override leaf_ranks.",
                )
                ranks.append(rank)
        return tuple(ranks)


@functools.cache
def _declared_ranks(cls: type) -> list[tuple[str, int | None]]:
    """Names of the fields that are not static, and the ranks in their annotations without batch dimensions."""
    found = []
    for field in dataclasses.fields(cls):
        if not field.metadata.get("static"):
            kinds = [kind for kind in (field.type, *get_args(field.type)) if hasattr(kind, "dim_str")]
            names = [name for kind in kinds for name in kind.dim_str.split() if not name.startswith(("*", "..."))]
            found.append((field.name, len(names) if kinds else None))
    return found


class FunctionModule(BatchModule):
    """A user's function of scalars, with or without parameters: arrays inside it (a pytree) are leaves."""

    parameters: PyTree
    static: PyTree = eqx.field(static=True)
    # Set at construction, from the arrays of a single function, so that the axes of a later vmap are known to be batch.
    parameter_ranks: tuple[int, ...] = eqx.field(static=True)

    signature: ClassVar[str]  # of the function, for errors

    def __init__(self, function: Callable):
        require(callable(function), "function", expected=f"a callable {self.signature}", got=repr(function))
        self.parameters, self.static = eqx.partition(function, eqx.is_array)
        self.parameter_ranks = tuple(x.ndim for x in jax.tree.leaves(self.parameters))

    @property
    def leaf_ranks(self) -> tuple[int, ...]:
        return self.parameter_ranks

    def evaluate(self, *scalars: Array) -> Array:
        """The function's value, of one set of parameters."""
        return jnp.asarray(eqx.combine(self.parameters, self.static)(*scalars))


def ranked_leaves(module: eqx.Module) -> list[tuple[Array, int]]:
    """(leaf, event rank) of every leaf."""
    return list(zip(jax.tree.leaves(module), module.leaf_ranks, strict=True))


def align(parts: list[tuple[Array, int]], rank: int) -> list[Array]:
    """The arrays of (array, event rank) with at least `rank` batch axes, by ones in front."""
    return [lax.expand_dims(x, range(max(rank + event - x.ndim, 0))) for x, event in parts]


def align_leaves(module: _ModuleT, rank: int) -> _ModuleT:
    """`module` with at least `rank` batch axes on every leaf."""
    return jax.tree.unflatten(jax.tree.structure(module), align(ranked_leaves(module), rank))


def broadcast_leaves(module: _ModuleT, batch: tuple[int, ...]) -> _ModuleT:
    """`module` with every leaf broadcast to the whole batch."""
    leaves = [jnp.broadcast_to(x, batch + x.shape[x.ndim - event :]) for x, event in ranked_leaves(module)]
    return jax.tree.unflatten(jax.tree.structure(module), leaves)


def batch_shape_of(parts: list[tuple[Array, int]]) -> tuple[int, ...]:
    return jnp.broadcast_shapes(*(x.shape[: x.ndim - event] for x, event in parts))


def flatten_points(x: Array, batch: tuple[int, ...], event: tuple[int, ...]) -> tuple[Array, Callable[[Array], Array]]:
    """Points as (n, *batch, *event), and the function from results (n, *batch, ...) to those of the points' own shape.

    Where the batch has an axis of size 1 and the points more, these are among the n.
    """
    shape = jnp.broadcast_shapes(x.shape[: x.ndim - len(event)], batch)
    wide = [axis for axis, n in enumerate(batch, len(shape) - len(batch)) if n != shape[axis]]
    points = jnp.moveaxis(jnp.broadcast_to(x, (*shape, *event)), wide, front := tuple(range(len(wide))))
    own = points.shape[: len(shape)]

    def restore(result: Array) -> Array:
        return jnp.moveaxis(result.reshape(*own, *result.shape[1 + len(batch) :]), front, wide)

    return points.reshape(math.prod(own[: len(own) - len(batch) + len(wide)]), *batch, *event), restore


# --- vectorization ------------------------------------------------------------------------------------------


def _parts(item) -> tuple[eqx.Module | Array, list[tuple[Array, int]]]:
    inner, extra = item if isinstance(item, tuple) else (item, 0)
    inner = inner if isinstance(inner, eqx.Module) else jnp.asarray(inner)
    parts = ranked_leaves(inner) if isinstance(inner, eqx.Module) else [(inner, 0)]
    return inner, [(x, rank + extra) for x, rank in parts]


def vectorize(function: Callable, *items):
    """`function` of single items, over all their batch axes, which broadcast.

    An item is a module with `leaf_ranks` or an array of numbers, or a pair of one of them and the number of further
    axes that are not batch. An axis of size 1 is not copied for the others: one factor may serve a million points.
    """
    inner, own = zip(*map(_parts, items), strict=True)
    parts = [part for more in own for part in more]
    batch, structure = check_batch(parts), jax.tree.structure(inner)
    leaves, wide = [], []
    for x, rank in parts:
        sizes = (1,) * (len(batch) + rank - x.ndim) + x.shape[: x.ndim - rank]
        leaves.append(x.reshape(*(n for n in sizes if n != 1), *x.shape[x.ndim - rank :]))
        wide.append([n != 1 for n, whole in zip(sizes, batch, strict=True) if whole != 1])
    mapped = lambda *leaves: function(*jax.tree.unflatten(structure, leaves))  # noqa: E731
    for axes in reversed(list(zip(*wide, strict=True))):
        mapped = jax.vmap(mapped, in_axes=tuple(0 if is_wide else None for is_wide in axes))
    rank = len(wide[0])
    return jax.tree.map(lambda y: y.reshape(*batch, *y.shape[rank:]), mapped(*leaves))


def vectorized(*ranks: int):
    """Decorate a method, written for one module without batch axes and single arguments of these ranks."""

    def decorate(method: Callable) -> Callable:
        @functools.wraps(method)
        def call(module, *arguments):
            return vectorize(method, module, *zip(arguments, ranks, strict=True))

        return call

    return decorate


# --- dtypes -------------------------------------------------------------------------------------------------


def common_dtype(*inputs: ArrayLike):
    """The float dtype of the arrays among the inputs; Python numbers and lists do not affect it."""
    dtypes = [x.dtype for x in inputs if hasattr(x, "dtype") and not isinstance(x, float)]
    floats = [dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.floating)]
    if not floats:
        return jnp.result_type(float)
    return jax.dtypes.canonicalize_dtype(np.result_type(*floats))


def as_value(x: ArrayLike, dtype) -> Array:
    """A value as an array: float arrays keep their dtype, others get `dtype`."""
    own = getattr(x, "dtype", None)
    keeps = own is not None and jnp.issubdtype(own, jnp.floating) and not isinstance(x, float)
    return jnp.asarray(x) if keeps else jnp.asarray(x, dtype)


def cast(module: _ModuleT, dtype) -> _ModuleT:
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, module)


# --- checks: of shapes always, of values unless they are traced ---------------------------------------------


def concrete_value(x: Array) -> np.ndarray | None:
    """The values as a NumPy array; None under tracing."""
    return None if isinstance(x, jax.core.Tracer) else np.asarray(x)


def check_batch(parts: list[tuple[Array, int]]) -> tuple[int, ...]:
    try:
        return batch_shape_of(parts)
    except ValueError:
        shapes = ", ".join(str(x.shape[: x.ndim - event]) for x, event in parts)
        cure = "Batch dimensions come first in every parameter."
        raise invalid("batch", expected="leading dimensions that broadcast", got=shapes, cure=cure) from None


def as_event(name: str, x: ArrayLike, dtype, event_shape: tuple[int, ...]) -> Array:
    """`as_value` of shape (*batch, *event_shape), checked; a single coordinate may be a number."""
    value = as_value(x, dtype)
    value = value.reshape(1) if value.ndim == 0 and event_shape == (1,) else value
    require(
        value.shape[-1:] == event_shape,
        name,
        expected=f"shape (*batch, {event_shape[0]})",
        got=f"shape {value.shape}",
        cure="Time, if any, is last.",
    )
    return value


def as_sample_shape(sample_shape: int | Sequence[int]) -> tuple[int, ...]:
    """The shape as a tuple; a whole number is that of one axis."""
    shape = sample_shape if isinstance(sample_shape, Sequence) else (sample_shape,)
    require(
        all(is_integer(n, 0) for n in shape),
        "sample_shape",
        expected="whole numbers >= 0",
        got=short_repr(sample_shape),
        cure="For n samples pass n or (n,).",
    )
    return tuple(int(n) for n in shape)


def check_values(name: str, x: Array, holds: Callable[[np.ndarray], np.ndarray], expected: str, cure: str = "") -> None:
    """Raise with the first entry for which `holds` is false, unless the values are traced."""
    value = concrete_value(x)
    if value is not None and not (fine := holds(value)).all():
        index = tuple(np.argwhere(~fine)[0].tolist())
        raise invalid(name, expected=expected, got=f"{value[index]}{f' at index {index}' * bool(index)}", cure=cure)


def check_finite(name: str, x: Array) -> None:
    """Raise if an entry is NaN or infinite, unless the values are traced."""
    check_values(name, x, np.isfinite, "finite numbers")


def check_positive(name: str, x: Array, cure: str = "It is a standard deviation.") -> None:
    """Raise if an entry is not positive and finite, unless the values are traced."""
    check_finite(name, x)
    check_values(name, x, lambda value: value > 0, "positive numbers", cure)


# --- searching ------------------------------------------------------------------------------------------------


def bisect(is_below: Callable[[Array], Array], low: Array, high: Array, steps: int) -> tuple[Array, Array]:
    """Halve the intervals from `low`, where `is_below` is true, to `high`, where it is not: floats or unsigned ints."""

    def halve(_, bounds):
        low, high = bounds
        middle = low + lax.div(high - low, jnp.full_like(high, 2))
        below = is_below(middle)
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    return lax.fori_loop(0, steps, halve, (low, high))


# --- compilation ----------------------------------------------------------------------------------------------


def compile_eager(function: Callable | None = None, *, static: tuple[str, ...] = ()):
    """Compile a function of modules and arrays where it is called eagerly: its many small kernels become one program.

    Inside other transformations, and for user functions, which may close over tracers or over what changes, it is
    called as it is. `static` names the parameters that are no arrays.
    """
    if function is None:
        return functools.partial(compile_eager, static=static)
    compiled = jax.jit(function, static_argnames=static)

    @functools.wraps(function)
    def call(*args, **kwargs):
        return (compiled if _is_eager((args, kwargs)) else function)(*args, **kwargs)

    return call


def _is_eager(arguments) -> bool:
    """Whether no argument is traced, and none contains a user's function."""
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(arguments)):
        return False
    parts = jax.tree.leaves(arguments, is_leaf=lambda x: hasattr(x, "is_closed"))
    return all(getattr(x, "is_closed", True) for x in parts)


# Batch elements that are evaluated at once, which limits memory.
_CHUNK = 64
# Eager batches are filled up to one of these sizes: as many programs serve all batches.
_SIZES = (1, 8, _CHUNK)
# Programs that are kept. An integral over time takes some 100 of the 65,530 memory maps that a Linux process may have.
_PROGRAMS = 32
# XLA's older code generator for the CPU, one module a program: a third of the memory maps, two thirds of the time to
# compile, and integrals are as fast. Only where programs are many and large: it is slower for samples of many points.
_COMPACT = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}


def map_over_batch(function: Callable, *items):
    """`function` of unbatched items, mapped over all their batch dimensions; compiled.

    `function` must be defined at module level, since a new closure would be compiled each time. Items are as those of
    `vectorize`, of which this differs by the number and size of programs: for integrals, which compile for seconds.
    """
    inner, own = zip(*map(_parts, items), strict=True)
    parts = [part for more in own for part in more]
    batch, structure = check_batch(parts), jax.tree.structure(inner)
    traced = any(isinstance(x, jax.core.Tracer) for x, _ in parts)
    xp, outer = jnp if traced else np, batch or (1,)  # NumPy compiles nothing
    wide = [xp.broadcast_to(xp.asarray(x), (*outer, *x.shape[x.ndim - rank :])) for x, rank in parts]
    if traced or not math.prod(batch):
        flat = [x.reshape(math.prod(outer), *x.shape[len(outer) :]) for x in wide]
        result = _map_flat(function, structure, flat)
    else:
        result = _map_eager(function, structure, wide, outer)
    return jax.tree.map(lambda x: jnp.asarray(x.reshape((*batch, *x.shape[1:]))), result)


def _map_eager(function: Callable, structure, wide: list[np.ndarray], batch: tuple[int, ...]):
    """In chunks of one of few sizes, so that batches of any size share a compiled program.

    The arrays of `wide` are views. Values that the batch shares, such as a path, are copied for one chunk at a time.
    """
    size = math.prod(batch)
    width = next((n for n in _SIZES if size <= n), _CHUNK)
    shapes = tuple(jax.ShapeDtypeStruct((width, *x.shape[len(batch) :]), x.dtype) for x in wide)
    program = _compile_flat(function, structure, shapes)
    # Values are waited for; tracers, of what a user's function closes over, stay.
    settle = lambda x: x if isinstance(x, jax.core.Tracer) else np.asarray(x)  # noqa: E731
    results = []
    for start in range(0, size, width):  # not at once: jaxlib's solver for batches can deadlock (`solve_upper_matrix`)
        rows = np.unravel_index(np.minimum(np.arange(start, start + width), size - 1), batch)
        results.append(jax.tree.map(settle, program([x[rows] for x in wide])))
    join = lambda *parts: (np if isinstance(parts[0], np.ndarray) else jnp).concatenate(parts)[:size]  # noqa: E731
    return jax.tree.map(join, *results)


@functools.lru_cache(maxsize=_PROGRAMS)
def _compile_flat(function: Callable, structure, shapes: tuple[jax.ShapeDtypeStruct, ...]) -> Callable:
    """The program for these shapes, as a function of its own, which is dropped with all that it holds."""
    program, arguments = jax.jit(functools.partial(_map_flat.__wrapped__, function, structure)), list(shapes)
    captured = jax.make_jaxpr(program)(arguments).consts  # tracers that a user's function closes over
    if any(isinstance(x, jax.core.Tracer) for x in captured):
        return program  # a part of another program, which takes no options
    return program.lower(arguments).compile(compiler_options=_known_options())


@functools.cache
def _known_options() -> dict[str, bool | int] | None:
    """`_COMPACT`, or None if this version of XLA has no such options."""
    try:
        jax.jit(jnp.zeros_like).lower(np.float32(0)).compile(compiler_options=_COMPACT)
    except jax.errors.JaxRuntimeError:
        return None
    return _COMPACT


@functools.partial(jax.jit, static_argnums=(0, 1))
def _map_flat(function: Callable, structure, flat: list[Array]):
    one = lambda leaves: function(*jax.tree.unflatten(structure, leaves))  # noqa: E731
    size = len(flat[0])
    if size <= _CHUNK:
        return jax.vmap(one)(flat)
    # Filled up to whole chunks, since a last smaller one would be compiled apart.
    fill = [lax.stop_gradient(jnp.broadcast_to(x[-1:], (-size % _CHUNK, *x.shape[1:]))) for x in flat]
    full = [jnp.concatenate(pair) for pair in zip(flat, fill, strict=True)]
    return jax.tree.map(lambda x: x[:size], lax.map(one, full, batch_size=_CHUNK))


def jvp_of_moving(function: Callable, primals, tangents):
    """`jax.jvp`, where arguments whose tangents are `SymbolicZero` are constants."""
    moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]

    def of_moving(*moved):
        return function(*(moved[moving.index(i)] if i in moving else x for i, x in enumerate(primals)))

    return jax.jvp(of_moving, [primals[i] for i in moving], [tangents[i] for i in moving])


def steepest(dtype) -> float:
    """The largest number to the power 0.85, 6e32 in float32: parts of derivatives of log-densities are clipped to it.

    Products of them with other derivatives then rarely overflow.
    """
    return float(jnp.finfo(dtype).max) ** 0.85


@jax.custom_jvp
def divide(x: Array, scale: Array) -> Array:
    """x / scale, whose derivative does not divide by scale^2, which underflows."""
    return x / scale


@divide.defjvp
def _divide_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    quotient = divide(*primals)
    return quotient, divide(tangents[0] - quotient * tangents[1], primals[1])
