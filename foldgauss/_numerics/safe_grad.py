"""Derivatives of log-densities that reach further than their dtype on the way.

Far from a component's time the slope of its log-density by space, z / sqrt(a), exceeds every floating-point number
long before the log-density does. Where it is then multiplied by something small (a power of a short time, a tiny
residual) the derivative asked for is an ordinary number; where it meets its own opposite, autodiff makes NaN of it.

So derivatives are taken plainly and, where one came out infinite or NaN, again of the log-density times root^2 for
smaller and smaller roots, the factor put in *before* anything can overflow; what comes out is scaled back, and held at
the largest number. Far away this costs some more evaluations, elsewhere a look at whether all is finite.

JAX has no rule that decides on a derivative *after* its transposition and still allows forward mode (`custom_vjp` does
not) and batches (`linear_call` does not), so there are two primitives here: `push`, forward, and `pull`, its transpose.
Derivatives of either are a `push` of the first derivative, so all orders decide, and all of a batch together.
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

try:
    from jax.extend.core import unmapped_aval
except ImportError:  # of older JAX
    from jax.core import unmapped_aval

__all__ = ["evaluate_with_safe_grad"]

#: `function(root, *arrays)` is root^2 times a list of arrays; root None is 1.
_Scaled = Callable[..., list[Array]]

#: log2 of the roots, in units of the dtype's largest exponent: in float32 the factors are 2^-24, 2^-48, .. 2^-240.
#: Neighbors are close, so that of a derivative that needs the one nothing is lost to underflow there.
_LADDER = -0.0945 * np.arange(1, 11)


def evaluate_with_safe_grad(function: Callable[..., Array], *arrays: Array, closed: bool = True) -> Array:
    """`function(None, *arrays)`, whose derivatives by `arrays` are true where they fit and saturate where not.

    `function(root, *arrays)` is root^2 times the same, and its derivatives overflow no sooner than root^2 times the
    true ones do. It depends on nothing else, unless `closed` is false: then it is looked through for tracers.

    A derivative that is a *sum* over points is true unless one of the points needs a root so small that the others'
    shares underflow beside it.
    """
    scaled = lambda root, *arrays: [function(root, *arrays)]  # noqa: E731
    captured = []
    if not closed:
        scaled, captured = _hoisted(scaled, arrays)
    return _far_reaching(scaled, *_alike([*arrays, *captured]))[0]


def _hoisted(function: _Scaled, arrays: tuple[Array, ...]) -> tuple[_Scaled, list[Array]]:
    """`function` with the tracers it closes over as further arguments, and those: custom derivatives lose them."""
    one = np.ones((), jnp.result_type(*arrays))  # of NumPy: no tracer
    traced = jax.make_jaxpr(function)(one, *arrays)
    is_captured = [isinstance(x, jax.core.Tracer) for x in traced.consts]
    if not any(is_captured):
        return function, []
    fixed = [None if hoist else x for hoist, x in zip(is_captured, traced.consts, strict=True)]
    captured = [jnp.asarray(x) for hoist, x in zip(is_captured, traced.consts, strict=True) if hoist]
    count, jaxpr = len(arrays), traced.jaxpr  # and no tracer is kept alive by the function below

    def hoisted(root, *arguments):
        given, own = arguments[:count], iter(arguments[count:])
        consts = [next(own) if hoist else x for hoist, x in zip(is_captured, fixed, strict=True)]
        scale = one if root is None else jnp.asarray(root, one.dtype)
        return jax.core.eval_jaxpr(jaxpr, consts, scale, *given)

    return hoisted, captured


def _alike(arrays: Sequence[Array]) -> list[Array]:
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
def _far_reaching(function: _Scaled, *arrays: Array) -> list[Array]:
    return function(None, *arrays)


@partial(_far_reaching.defjvp, symbolic_zeros=True)
def _far_reaching_jvp(function, primals, tangents):
    moving = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
    values = _far_reaching(function, *primals)
    return values, _push_along(function, primals, tangents, moving, values)


def _push_along(function: _Scaled, primals, tangents, moving: tuple[int, ...], values) -> list[Array]:
    avals = tuple(_strong(jax.typeof(x)) for x in values)
    return _push.bind(*primals, *(tangents[i] for i in moving), function=function, moving=moving, avals=avals)


def _strong(aval):
    return aval.update(weak_type=False)


# --- the derivatives -----------------------------------------------------------------------------------------


def _pushed(*arguments: Array, function: _Scaled, moving: tuple[int, ...], avals) -> list[Array]:
    """The derivatives along tangents of the arrays `moving`: arguments are all arrays, then these tangents."""
    del avals
    return _first_finite(lambda root: _pushed_at(root, *arguments, function=function, moving=moving))


def _pushed_at(root, *arguments: Array, function: _Scaled, moving: tuple[int, ...]) -> list[Array]:
    """root^2 times those, by plain autodiff."""
    arrays, tangents = arguments[: len(arguments) - len(moving)], arguments[len(arguments) - len(moving) :]
    return jax.jvp(_freed(partial(function, root), arrays, moving), [arrays[i] for i in moving], list(tangents))[1]


def _pulled(*arguments: Array, function: _Scaled, moving: tuple[int, ...], count: int) -> list[Array]:
    """The gradients by the arrays `moving`: arguments are `count` arrays, then the cotangents."""
    return _first_finite(lambda root: _pulled_at(root, *arguments, function=function, moving=moving, count=count))


def _pulled_at(root, *arguments: Array, function: _Scaled, moving: tuple[int, ...], count: int) -> list[Array]:
    """root^2 times those, by plain autodiff."""
    arrays, cotangents = arguments[:count], arguments[count:]
    free = _freed(partial(function, root), arrays, moving)
    return list(jax.vjp(free, *(arrays[i] for i in moving))[1](list(cotangents)))


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


# --- the two primitives --------------------------------------------------------------------------------------


def _primitive(name: str, implementation: Callable, derivative: Callable, avals: Callable) -> Primitive:
    """`implementation`, whose own derivative is a push of `derivative(root, *arguments, **how)`, root^2 times it."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(implementation)
    primitive.def_abstract_eval(avals)  # known without tracing the implementation, which is long
    mlir.register_lowering(primitive, mlir.lower_fun(implementation, multiple_results=True))

    def differentiated(primals, tangents, **how):
        how_much = {key: value for key, value in how.items() if key != "avals"}
        found = primitive.bind(*primals, **how)
        moving = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero))
        return found, _push_along(partial(derivative, **how_much), primals, tangents, moving, found)

    ad.primitive_jvps[primitive] = differentiated
    return primitive


def _pull_avals(*avals, function, moving, count):
    del function, count
    return [_strong(avals[i]) for i in moving]


_push = _primitive("far_push", _pushed, _pushed_at, lambda *_, avals, **how: list(avals))
_pull = _primitive("far_pull", _pulled, _pulled_at, _pull_avals)


def _transposed(cotangents, *arguments, function, moving, avals):
    del avals
    count = len(arguments) - len(moving)
    # A tangent that is known, not to be differentiated by, is left out.
    wanted = [ad.is_undefined_primal(x) for x in arguments[count:]]
    if all(isinstance(x, ad.Zero) for x in cotangents):
        return [None] * len(arguments)
    asked = tuple(i for i, want in zip(moving, wanted, strict=True) if want)
    given = [*arguments[:count], *map(ad.instantiate_zeros, cotangents)]
    found = iter(_pull.bind(*given, function=function, moving=asked, count=count))
    return [*[None] * count, *(next(found) if want else None for want in wanted)]


def _push_batched(arguments, dims, *, function, moving, avals):
    count, size = len(arguments) - len(moving), _batch_size(arguments, dims)
    is_batched = [d is not None for d in dims]
    for i, j in zip(moving, range(count, len(arguments)), strict=True):  # an array and its tangent go together
        is_batched[i] = is_batched[j] = is_batched[i] or is_batched[j]
    arguments = _to_front(arguments, dims, size, is_batched)
    over = _over_batch(function, is_batched[:count], size)
    avals = tuple(unmapped_aval(size, 0, aval) for aval in avals)
    return _push.bind(*arguments, function=over, moving=moving, avals=avals), [0] * len(avals)


def _pull_batched(arguments, dims, *, function, moving, count):
    size = _batch_size(arguments, dims)
    # Gradients per batch element are asked for, not their sum: the arrays they are taken by become a batch.
    is_batched = [d is not None or i in moving or i >= count for i, d in enumerate(dims)]
    arguments = _to_front(arguments, dims, size, is_batched)
    over = _over_batch(function, is_batched[:count], size)
    return _pull.bind(*arguments, function=over, moving=moving, count=count), [0] * len(moving)


def _over_batch(function: _Scaled, is_batched: list[bool], size: int) -> _Scaled:
    axes = tuple(0 if batched else None for batched in is_batched)
    return lambda root, *arrays: jax.vmap(partial(function, root), in_axes=axes, axis_size=size)(*arrays)


def _batch_size(arguments, dims) -> int:
    return next(x.shape[d] for x, d in zip(arguments, dims, strict=True) if d is not None)


def _to_front(arguments, dims, size: int, is_batched: list[bool]) -> list[Array]:
    """The batch in front of every argument that has one, or is to have one."""
    arguments = map(jnp.asarray, arguments)
    return [
        jnp.moveaxis(x, d, 0) if d is not None else jnp.broadcast_to(x, (size, *x.shape)) if batched else x
        for x, d, batched in zip(arguments, dims, is_batched, strict=True)
    ]


ad.primitive_transposes[_push] = _transposed
batching.primitive_batchers[_push] = _push_batched
batching.primitive_batchers[_pull] = _pull_batched
