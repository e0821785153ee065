"""Derivatives of log-densities that reach further than their dtype on the way.

Far from a component's time the slope of its log-density by space, z / sqrt(a), exceeds every floating-point number
long before the log-density does. Where it is then multiplied by something small (a power of a short time, a tiny
residual) the derivative asked for is an ordinary number; where it meets its own opposite, autodiff makes NaN of it.

So derivatives are taken plainly and, where one came out infinite or NaN, again of the log-density times root^2 for
smaller and smaller roots, the factor put in *before* anything can overflow; what comes out is scaled back, and held at
the largest number. Far away this costs some more evaluations, elsewhere a look at whether all is finite.

JAX has no rule that decides on a derivative *after* its transposition and still allows forward mode (`custom_vjp` does
not) and batches (`linear_call` does not), so there are two primitives here, each other's transpose.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive, unmapped_aval
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

__all__ = ["far_reaching"]

#: `function(root, *arrays)` is root^2 times an array; root None is 1.
_Scaled = Callable[..., Array]

#: log2 of the roots, in units of the dtype's largest exponent: in float32 the factors are 2^-24, 2^-48, .. 2^-240.
#: Neighbours are close, so that of a derivative that needs the one nothing is lost to underflow there.
_LADDER = -0.0945 * np.arange(1, 11)


def far_reaching(function: _Scaled, *arrays: Array, closed: bool = True) -> Array:
    """`function(None, *arrays)`, whose first derivatives by `arrays` are true where they fit and saturate where not.

    `function(root, *arrays)` is root^2 times the same, and its derivatives overflow no sooner than root^2 times the
    true ones do. It depends on nothing else, unless `closed` is false: then it is looked through for tracers.

    A derivative that is a *sum* over points is true unless one of the points needs a root so small that the others'
    shares underflow beside it.
    """
    arrays = _alike(arrays)
    if closed:
        return _far_reaching(function, *arrays)
    traced = jax.make_jaxpr(partial(function, None))(*arrays)
    captured = [jnp.asarray(x) for x in traced.consts if isinstance(x, jax.core.Tracer)]
    # A tracer inside a user's function becomes an argument: a custom derivative loses those it closes over.
    if not captured:
        return _far_reaching(function, *arrays)
    return _far_reaching(_hoisted(function, arrays), *_alike([*arrays, *captured]))


def _hoisted(function: _Scaled, arrays: tuple[Array, ...]) -> _Scaled:
    """`function` with the tracers it closes over as further arguments."""
    one = np.ones((), jnp.result_type(*arrays))  # of NumPy: no tracer
    traced = jax.make_jaxpr(function)(one, *arrays)
    is_captured = [isinstance(x, jax.core.Tracer) for x in traced.consts]
    fixed = [None if hoist else x for hoist, x in zip(is_captured, traced.consts, strict=True)]
    count, jaxpr = len(arrays), traced.jaxpr  # and no tracer is kept alive by the function below

    def hoisted(root, *arguments):
        given, captured = arguments[:count], iter(arguments[count:])
        consts = [next(captured) if hoist else x for hoist, x in zip(is_captured, fixed, strict=True)]
        scale = one if root is None else jnp.asarray(root, one.dtype)
        return jax.core.eval_jaxpr(jaxpr, consts, scale, *given)[0]

    return hoisted


def _alike(arrays) -> list[Array]:
    """The arrays as varying, all of them, over the mesh axes that any of them varies over (inside `shard_map`).

    Else JAX would cast within, and its transpose, a sum over devices, would stand in a branch that not all take.
    """
    arrays = [jnp.asarray(x) for x in arrays]
    axes = frozenset().union(*map(_varying_axes, arrays))
    if not axes:
        return arrays
    lacking = [tuple(axes - _varying_axes(x)) for x in arrays]
    return [_cast_varying(x, axes) if axes else x for x, axes in zip(arrays, lacking, strict=True)]


def _varying_axes(x: Array) -> frozenset:
    aval = jax.typeof(x)
    return frozenset(aval.vma if hasattr(aval, "vma") else aval.manual_axis_type.varying)


def _cast_varying(x: Array, axes: tuple) -> Array:
    return lax.pcast(x, axes, to="varying") if hasattr(lax, "pcast") else lax.pvary(x, axes)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _far_reaching(function: _Scaled, *arrays: Array) -> Array:
    return function(None, *arrays)


@partial(_far_reaching.defjvp, symbolic_zeros=True)
def _far_reaching_jvp(function, primals, tangents):
    moving = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
    value, moved = function(None, *primals), [tangents[i] for i in moving]
    return value, _push.bind(*primals, *moved, function=function, moving=moving, aval=_strong(jax.typeof(value)))


# --- the two primitives --------------------------------------------------------------------------------------


def _pushed(*arguments: Array, function: _Scaled, moving: tuple[int, ...], aval) -> Array:
    """The derivative along tangents of the arrays `moving`: arguments are all arrays, then these tangents."""
    del aval
    count = len(arguments) - len(moving)
    arrays, tangents = arguments[:count], arguments[count:]

    def at(root):
        free = _freed(partial(function, root), arrays, moving)
        return [jax.jvp(free, tuple(arrays[i] for i in moving), tuple(tangents))[1]]

    return _first_finite(at)[0]


def _pulled(*arguments: Array, function: _Scaled, moving: tuple[int, ...]) -> list[Array]:
    """The gradients by the arrays `moving`: arguments are all arrays, then the cotangent."""
    arrays, cotangent = arguments[:-1], arguments[-1]

    def at(root):
        free = _freed(partial(function, root), arrays, moving)
        return list(jax.vjp(free, *(arrays[i] for i in moving))[1](cotangent))

    return _first_finite(at)


def _freed(function: Callable, arrays, moving: tuple[int, ...]) -> Callable:
    """`function` of the arrays `moving` alone."""
    return lambda *moved: function(*(moved[moving.index(i)] if i in moving else x for i, x in enumerate(arrays)))


def _first_finite(at: Callable[[Array | None], list[Array]]) -> list[Array]:
    """Each number from the first root where it is finite, scaled back."""
    plain = at(None)
    missing = _missing(plain)
    if not isinstance(missing, jax.core.Tracer):  # not compiled: then no branch need be compiled either
        return _climbed(at, plain) if missing else plain
    return lax.cond(missing > 0, partial(_climbed, at), lambda plain: plain, plain)


def _missing(found: list[Array]) -> Array:
    return sum(jnp.sum(~jnp.isfinite(x)) for x in found)


def _climbed(at: Callable[[Array | None], list[Array]], plain: list[Array]) -> list[Array]:
    narrowest = min((jnp.finfo(x.dtype) for x in plain), key=lambda known: known.maxexp)
    roots = np.exp2(np.round(_LADDER * narrowest.maxexp)).astype(jnp.result_type(*plain))

    def climb(root, found):
        again = [_scaled_back(x, root) for x in at(root)]
        return [jnp.where(jnp.isfinite(x), x, y) for x, y in zip(found, again, strict=True)]

    def step(found, root):
        return lax.cond(_missing(found) > 0, climb, lambda root, found: found, root, found), None

    if any(isinstance(x, jax.core.Tracer) for x in plain):
        found = lax.scan(step, plain, jnp.asarray(roots))[0]
    else:  # not compiled: a scan would be, anew each time
        found = plain
        for root in roots:
            found = climb(jnp.asarray(root), found) if _missing(found) else found
    # An infinity that is left is one further out than all roots reach, and has its sign.
    return [_held(x, jnp.finfo(x.dtype).max) for x in found]


def _scaled_back(x: Array, root: Array) -> Array:
    """x / root^2, held at the largest number where x is finite."""
    root, largest = root.astype(x.dtype), jnp.finfo(x.dtype).max
    return jnp.where(jnp.isfinite(x), _held(_held(x / root, largest), largest * root) / root, x)


def _held(x: Array, largest) -> Array:
    return jnp.clip(x, -largest, largest)  # a NaN stays one


def _primitive(name: str, implementation: Callable, shape_of: Callable, *, several: bool) -> Primitive:
    primitive = Primitive(name)
    primitive.multiple_results = several
    primitive.def_impl(implementation)
    primitive.def_abstract_eval(shape_of)  # known without tracing the implementation, which is long
    mlir.register_lowering(primitive, mlir.lower_fun(implementation, multiple_results=several))
    ad.primitive_jvps[primitive] = partial(_differentiated, implementation)
    return primitive


def _push_shape(*avals, function, moving, aval):
    return aval


def _pull_shapes(*avals, function, moving):
    return [_strong(avals[i]) for i in moving]


def _strong(aval):
    return aval.update(weak_type=False)


def _differentiated(implementation, primals, tangents, **how):
    """Second derivatives: plain autodiff of the first."""
    tangents = [ad.instantiate_zeros(t) for t in tangents]
    return jax.jvp(partial(implementation, **how), tuple(primals), tuple(tangents))


_push = _primitive("far_push", _pushed, _push_shape, several=False)
_pull = _primitive("far_pull", _pulled, _pull_shapes, several=True)


def _transposed(cotangent, *arguments, function, moving, aval):
    del aval
    count = len(arguments) - len(moving)
    nothing = [None] * count
    if isinstance(cotangent, ad.Zero):
        return [*nothing, *[None] * len(moving)]
    # A tangent that is known, not to be differentiated by, is left out.
    wanted = [ad.is_undefined_primal(x) for x in arguments[count:]]
    asked = tuple(i for i, want in zip(moving, wanted, strict=True) if want)
    found = iter(_pull.bind(*arguments[:count], cotangent, function=function, moving=asked))
    return [*nothing, *(next(found) if want else None for want in wanted)]


def _push_batched(arguments, dims, *, function, moving, aval):
    count = len(arguments) - len(moving)
    size = next(x.shape[d] for x, d in zip(arguments, dims, strict=True) if d is not None)
    is_batched = [d is not None for d in dims]
    for i, j in zip(moving, range(count, len(arguments)), strict=True):  # an array and its tangent go together
        is_batched[i] = is_batched[j] = is_batched[i] or is_batched[j]
    arguments = [_to_front(x, d, size, b) for x, d, b in zip(arguments, dims, is_batched, strict=True)]
    axes = tuple(0 if b else None for b in is_batched[:count])
    over = _over_batch(function, axes)
    return _push.bind(*arguments, function=over, moving=moving, aval=unmapped_aval(size, 0, aval)), 0


def _pull_batched(arguments, dims, *, function, moving):
    size = next(x.shape[d] for x, d in zip(arguments, dims, strict=True) if d is not None)
    # Gradients per batch element are asked for, not their sum: the arrays they are taken by become a batch.
    is_batched = [d is not None or i in moving for i, d in enumerate(dims)]
    is_batched[-1] = True
    arguments = [_to_front(x, d, size, b) for x, d, b in zip(arguments, dims, is_batched, strict=True)]
    axes = tuple(0 if b else None for b in is_batched[:-1])
    results = _pull.bind(*arguments, function=_over_batch(function, axes, size), moving=moving)
    return results, [0] * len(results)


def _over_batch(function: _Scaled, axes, size: int | None = None) -> _Scaled:
    return lambda root, *arrays: jax.vmap(partial(function, root), in_axes=axes, axis_size=size)(*arrays)


def _to_front(x: Array, dim: int | None, size: int, wanted: bool) -> Array:
    x = jnp.asarray(x)
    if dim is not None:
        return jnp.moveaxis(x, dim, 0)
    return jnp.broadcast_to(x, (size, *x.shape)) if wanted else x


ad.primitive_transposes[_push] = _transposed
batching.primitive_batchers[_push] = _push_batched
batching.primitive_batchers[_pull] = _pull_batched
