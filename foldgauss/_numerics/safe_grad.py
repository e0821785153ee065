"""Derivatives of log-densities whose intermediate values overflow.

Far from a component's time the slope of its log-density in space, z / sqrt(a), overflows long before the log-density
does, although its product with a small factor may be in range, and opposite infinities give NaN.

Derivatives are therefore taken plainly and, where one is not finite, again of the log-density times root^2 for smaller
and smaller roots, a factor applied *before* anything can overflow; the result is scaled back, and clipped to the
largest number. Where all derivatives are finite, the only cost is the test that they are.

JAX has no rule that acts on a derivative *after* its transposition and still supports forward mode (unlike
`custom_vjp`) and batches (unlike `linear_call`), hence two primitives: `push`, forward, and `pull`, its transpose.
Derivatives of either are a `push` of the first derivative, so this holds for all orders.
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
#: They are close enough that a derivative that needs one of them does not underflow there.
_LADDER = -0.0945 * np.arange(1, 11)


def evaluate_with_safe_grad(function: Callable[..., Array], *arrays: Array, closed: bool = True) -> Array:
    """`function(None, *arrays)`, whose derivatives in `arrays` are accurate where in range and saturate elsewhere.

    `function(root, *arrays)` is root^2 times the same, and its derivatives overflow only where root^2 times the true
    ones do. If `closed` is false, it may also close over tracers. A derivative that *sums* over points is inaccurate if
    one of them needs a root so small that the terms of others underflow.
    """
    scaled = lambda root, *arrays: [function(root, *arrays)]  # noqa: E731
    captured = []
    if not closed:
        scaled, captured = _hoist_tracers(scaled, arrays)
    return _far_reaching(scaled, *_unify_varying_axes([*arrays, *captured]))[0]


def _hoist_tracers(function: _Scaled, arrays: tuple[Array, ...]) -> tuple[_Scaled, list[Array]]:
    """`function` with the tracers it closes over as further arguments, which custom derivatives would lose."""
    one = np.ones((), jnp.result_type(*arrays))  # NumPy: not a tracer
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


def _unify_varying_axes(arrays: Sequence[Array]) -> list[Array]:
    """Cast all arrays to vary over the mesh axes that any of them varies over (inside `shard_map`).

    Otherwise JAX would cast inside, and the transpose, a sum over devices, would be in a branch that not all take.
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


def _push_values(*arguments: Array, function: _Scaled, moving: tuple[int, ...], avals) -> list[Array]:
    """The derivatives along tangents of the arrays `moving`: arguments are all arrays, then these tangents."""
    del avals
    return _first_finite(lambda root: _push_values_at(root, *arguments, function=function, moving=moving))


def _push_values_at(root, *arguments: Array, function: _Scaled, moving: tuple[int, ...]) -> list[Array]:
    """root^2 times those, by plain autodiff."""
    arrays, tangents = arguments[: len(arguments) - len(moving)], arguments[len(arguments) - len(moving) :]
    return jax.jvp(
        _restrict_arguments(partial(function, root), arrays, moving), [arrays[i] for i in moving], list(tangents)
    )[1]


def _pull_values(*arguments: Array, function: _Scaled, moving: tuple[int, ...], count: int) -> list[Array]:
    """The gradients by the arrays `moving`: arguments are `count` arrays, then the cotangents."""
    return _first_finite(lambda root: _pull_values_at(root, *arguments, function=function, moving=moving, count=count))


def _pull_values_at(root, *arguments: Array, function: _Scaled, moving: tuple[int, ...], count: int) -> list[Array]:
    """root^2 times those, by plain autodiff."""
    arrays, cotangents = arguments[:count], arguments[count:]
    free = _restrict_arguments(partial(function, root), arrays, moving)
    return list(jax.vjp(free, *(arrays[i] for i in moving))[1](list(cotangents)))


def _restrict_arguments(function: Callable, arrays, moving: tuple[int, ...]) -> Callable:
    """`function` of the arrays `moving` alone."""
    return lambda *moved: function(*(moved[moving.index(i)] if i in moving else x for i, x in enumerate(arrays)))


def _first_finite(at: Callable[[Array | None], list[Array]]) -> list[Array]:
    """Each value from the first root where it is finite, scaled back."""
    plain = at(None)
    missing = _count_nonfinite(plain)
    if not isinstance(missing, jax.core.Tracer):  # eager: no branch to compile
        return _retry_with_roots(at, plain) if missing else plain
    return lax.cond(missing > 0, partial(_retry_with_roots, at), lambda plain: plain, plain)


def _count_nonfinite(found: list[Array]) -> Array:
    return sum(jnp.sum(~jnp.isfinite(x)) for x in found)


def _retry_with_roots(at: Callable[[Array | None], list[Array]], plain: list[Array]) -> list[Array]:
    narrowest = min((jnp.finfo(x.dtype) for x in plain), key=lambda known: known.maxexp)
    roots = np.exp2(np.round(_LADDER * narrowest.maxexp)).astype(jnp.result_type(*plain))

    def climb(root, found):
        again = [_scale_back(x, root) for x in at(root)]
        return [jnp.where(jnp.isfinite(x), x, y) for x, y in zip(found, again, strict=True)]

    def step(found, root):
        return lax.cond(_count_nonfinite(found) > 0, climb, lambda root, found: found, root, found), None

    if any(isinstance(x, jax.core.Tracer) for x in plain):
        found = lax.scan(step, plain, jnp.asarray(roots))[0]
    else:  # eager: a scan would be compiled each time
        found = plain
        for root in roots:
            found = climb(jnp.asarray(root), found) if _count_nonfinite(found) else found
    # An infinity that is left is beyond the range of all roots; its sign is right.
    return [_clip_symmetric(x, jnp.finfo(x.dtype).max) for x in found]


def _scale_back(x: Array, root: Array) -> Array:
    """x / root^2, clipped to the largest number where x is finite."""
    root, largest = root.astype(x.dtype), jnp.finfo(x.dtype).max
    return jnp.where(jnp.isfinite(x), _clip_symmetric(_clip_symmetric(x / root, largest), largest * root) / root, x)


def _clip_symmetric(x: Array, largest) -> Array:
    return jnp.clip(x, -largest, largest)  # NaN propagates


# --- the two primitives --------------------------------------------------------------------------------------


def _primitive(name: str, implementation: Callable, derivative: Callable, avals: Callable) -> Primitive:
    """`implementation`, whose own derivative is a push of `derivative(root, *arguments, **how)`, root^2 times it."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(implementation)
    primitive.def_abstract_eval(avals)  # without tracing the implementation, which is slow
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


_push = _primitive("far_push", _push_values, _push_values_at, lambda *_, avals, **how: list(avals))
_pull = _primitive("far_pull", _pull_values, _pull_values_at, _pull_avals)


def _transposed(cotangents, *arguments, function, moving, avals):
    del avals
    count = len(arguments) - len(moving)
    # Tangents that are not differentiated are left out.
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
    # Gradients are per batch element, not summed: the arrays they are taken in become batched.
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
    """Move or broadcast the batch axis to the front of every argument that is to be batched."""
    arguments = map(jnp.asarray, arguments)
    return [
        jnp.moveaxis(x, d, 0) if d is not None else jnp.broadcast_to(x, (size, *x.shape)) if batched else x
        for x, d, batched in zip(arguments, dims, is_batched, strict=True)
    ]


ad.primitive_transposes[_push] = _transposed
batching.primitive_batchers[_push] = _push_batched
batching.primitive_batchers[_pull] = _pull_batched
