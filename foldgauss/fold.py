"""The fold f, by which the center of a Folded-Gaussian moves away from `time_loc` (eq:cond_dens).

A fold maps the scalar `u = time_loc - t` (note the sign) to R^(d-1).
"""

import warnings
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Float, Int

from foldgauss._numerics.batch import (
    BatchModule,
    FunctionModule,
    check_finite,
    check_positive,
    check_values,
    common_dtype,
    concrete_value,
    jvp_of_moving,
    vectorized,
)
from foldgauss._numerics.piecewise import locate
from foldgauss._numerics.triangular import join_columns, split_columns
from foldgauss._runtime.checks import check_signature, is_integer, require, short_repr

__all__ = [
    "AbstractFold",
    "CallableFold",
    "FourierFold",
    "PolynomialFold",
    "SharedPathFold",
    "SplineFold",
    "ZeroFold",
    "as_fold",
]


class AbstractFold(BatchModule):
    """A fold with batch dimensions: `fold(u)` maps u of shape (*batch,) to shifts (*batch, d-1).

    **Units:** u is time, f(u) is space.

    To extend: annotate arrays with their shapes (`Float[Array, "*batch degree d-1"]`), from which it is known what is
    batch. Write `__call__` for one fold and one number u; `_numerics.batch.vectorized(0)` maps it over batches. A
    function of one scalar needs no class: `as_fold` wraps it.
    """

    #: Whether it depends on its leaves only; a user's function may also close over tracers.
    is_closed: ClassVar[bool] = False
    #: Whether some leaves are the same for a whole batch, and then keep axes of size 1 instead of being copied.
    shares_leaves: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        """The shift f(u)."""

    @property
    def breaks(self) -> Float[Array, " breaks"]:
        """Where a single fold, not a batch, is not smooth: u at which quadrature divides the range."""
        return jnp.zeros(0)


class ZeroFold(AbstractFold):
    """No fold: `f(u) = 0`, a static center.

    **Shapes:** u (*batch,) -> (*batch, dim), with `dim = d - 1`.

    **Example:** `ZeroFold(2)(0.3)  # [0., 0.]`

    **Source:** the plain Gaussian of eq:gauss_2d. **Raises:** ValueError if `dim` is not an integer >= 1.
    """

    dim: int = eqx.field(static=True)

    is_closed = True

    def __init__(self, dim: int):
        require(is_integer(dim, 1), "dim", expected="an integer >= 1", got=repr(dim), cure="It is d - 1.")
        self.dim = int(dim)

    def __call__(self, u: Float[Array, "*batch"]) -> Float[Array, "*batch d-1"]:
        return jnp.zeros((*jnp.shape(u), self.dim), jnp.result_type(u))


class PolynomialFold(AbstractFold):
    """The paper's fold, a polynomial without constant term.

        f(u) = sum_{k=1..degree} c_k u^k

    **Shapes:** `coefficients` (*batch, degree, d-1), row `k - 1` is `c_k`; u (*batch,) -> (*batch, d-1),
    leading dimensions broadcast. Degree 0 is allowed and is the zero fold.

    **Units:** `c_k` is space / time^k, u is time. Coefficients below the smallest normal number count as 0, with a
    RuntimeWarning unless they are traced: JAX computes so. Choose a larger unit of time, or float64.

    **Example:** `PolynomialFold([[-1.0], [0.5]])(4.0)  # [-4 + 8] = [4.]`

    **Source:** f of eq:cond_dens, a polynomial as in the text after eq:cond_pdf_2d.
    **Raises:** ValueError if `coefficients` has fewer than two dimensions, no space coordinate, or is not finite.
    """

    coefficients: Float[Array, "*batch degree d-1"]

    is_closed = True

    def __init__(self, coefficients: ArrayLike):
        self.coefficients = _coefficient_rows("coefficients", coefficients, "degree", "Row k-1 holds c_k")
        known = concrete_value(self.coefficients)
        if known is not None and ((known != 0) & (np.abs(known) < (least := jnp.finfo(known.dtype).tiny))).any():
            text = f"PolynomialFold: coefficients below {least:.2g}, the smallest normal {known.dtype}, count as 0."
            warnings.warn(text, RuntimeWarning, stacklevel=2)

    @property
    def degree(self) -> int:
        """Highest power of u."""
        return self.coefficients.shape[-2]

    @vectorized(0)
    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        shift = jnp.zeros(self.coefficients.shape[-1], jnp.result_type(u, self.coefficients))
        for k in reversed(range(self.degree)):  # Horner's scheme
            shift = u * (shift + self.coefficients[k])
        return shift


class SplineFold(AbstractFold):
    """A B-spline with fixed knots: its coefficients act locally, and it stays bounded far from `time_loc`.

        f(u) = sum_i c_i B_i(v),   v = clip(u, knots[degree], knots[n])

    Outside its domain the fold keeps its value at the end (a continued polynomial would overflow where the time
    likelihood is not yet negligible). **f(0) is not constrained to 0:** the B_i sum to 1, so shifting all c_i equals
    shifting `loc`, and if both are fitted only their sum is determined.

    **Shapes:** `knots` (n + degree + 1,), fixed, not trained; `coefficients` (*batch, n, d-1); u (*batch,) ->
    (*batch, d-1), leading dimensions broadcast.

    **Units:** knots are times, measured as u = time_loc - t; coefficients are space.

    **Example:** `SplineFold([-1, -1, 0, 1, 1], [[2.0], [0.0], [1.0]], degree=1)(0.5)  # halfway: [0.5]`

    **Source:** the "suitably chosen" f of eq:transform_s; the recursion is that of Cox and de Boor. **Raises:**
    ValueError if `degree` is not an integer >= 0, the coefficients are not finite, or the knots decrease, are not
    finite, leave no domain, or are not n + degree + 1.
    """

    coefficients: Float[Array, "*batch n d-1"]
    knots: tuple[float, ...] = eqx.field(static=True)  # static: not trained
    degree: int = eqx.field(static=True)

    is_closed = True

    def __init__(self, knots: ArrayLike, coefficients: ArrayLike, *, degree: int = 3):
        self.coefficients = _coefficient_rows("coefficients", coefficients, "n", "Row i holds c_i")
        require(
            is_integer(degree, 0), "degree", expected="an integer >= 0", got=repr(degree), cure="3 is a cubic spline."
        )
        self.knots, self.degree = _check_knots(knots, self.coefficients.shape[-2], degree), int(degree)

    @vectorized(0)
    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        v = jnp.clip(u, self.knots[self.degree], self.knots[-1 - self.degree])
        terms = [b * c for b, c in zip(_spline_basis(v, self.knots, self.degree), self.coefficients, strict=True)]
        return sum(terms, 0 * v)  # 0 * v: a NaN propagates through degree 0, too

    @property
    def breaks(self) -> Float[Array, " breaks"]:
        return jnp.asarray(self.knots, self.coefficients.dtype)


class FourierFold(AbstractFold):
    """A periodic fold: a Fourier series without constant, so that f(0) = 0.

        f(u) = sum_{k=1..order} s_k sin(2 pi k u / period) + c_k (cos(2 pi k u / period) - 1)

    From 1 / eps periods on, where the phase is below floating-point resolution, f is 0.

    **Shapes:** `sine`, `cosine` (*batch, order, d-1), row `k - 1` is s_k, c_k; `period` (*batch,); u (*batch,) ->
    (*batch, d-1), leading dimensions broadcast.

    **Units:** coefficients are space, `period` and u are time.

    **Example:** `FourierFold([[1.0]], [[0.5]], period=4.0)(1.0)  # [1 - 0.5] = [0.5]`

    **Source:** the "suitably chosen" f of eq:transform_s. **Raises:** ValueError if sine and cosine differ in shape or
    are not finite, or `period` is not positive.
    """

    sine: Float[Array, "*batch order d-1"]
    cosine: Float[Array, "*batch order d-1"]
    period: Float[Array, "*batch"]

    is_closed = True

    def __init__(self, sine: ArrayLike, cosine: ArrayLike, *, period: ArrayLike):
        self.sine = _coefficient_rows("sine", sine, "order", "Row k-1 holds s_k")
        self.cosine = _coefficient_rows("cosine", cosine, "order", "Row k-1 holds c_k").astype(self.sine.dtype)
        self.period = jnp.asarray(period, self.sine.dtype)
        require(
            self.sine.shape == self.cosine.shape,
            "cosine",
            expected="the shape of sine",
            got=f"shapes {self.sine.shape} and {self.cosine.shape}",
            cure="Pass zeros for the one that is not used.",
        )
        check_positive("period", self.period, cure="It is a duration.")

    @property
    def order(self) -> int:
        """Number of harmonics."""
        return self.sine.shape[-2]

    @vectorized(0)
    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        u = u.astype(self.sine.dtype) if jnp.issubdtype(u.dtype, jnp.integer) else u
        far = jnp.abs(u) >= self.period / float(jnp.finfo(u.dtype).eps)
        half_phase = jnp.pi * jnp.where(far, 0, u) / jnp.where(far, 1, self.period)
        shift = jnp.zeros(self.sine.shape[-1], u.dtype)
        first = s, c = jnp.sin(half_phase), jnp.cos(half_phase)
        for k in range(self.order):
            shift = shift + 2 * s * (c * self.sine[k] - s * self.cosine[k])  # cos - 1 without cancellation
            s, c = s * first[1] + c * first[0], c * first[1] - s * first[0]  # the next harmonic, by one more turn
        return shift


class CallableFold(FunctionModule, AbstractFold):
    """Any function of one scalar, with or without parameters, as a fold: `f(u) = function(u)`.

    **Shapes:** `function` maps one scalar u to (d-1,); this class vmaps it, u (*batch,) -> (*batch, d-1).
    Arrays inside `function` (a pytree, say an `equinox.nn.MLP`) are leaves of the fold and are trained with it. They
    are the parameters of *one* fold; for a batch of parameters use `vmap` over the constructor.

    **Example:** `CallableFold(lambda u: jnp.stack([jnp.sin(u), u**2]))(jnp.zeros(5))  # shape (5, 2)`

    **Source:** the "suitably chosen" f of eq:transform_s. **Raises:** ValueError if `function` is not
    callable.
    """

    shares_leaves = True
    signature = "u -> (d-1,)"

    @vectorized(0)
    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        return self.evaluate(u)


class SharedPathFold(AbstractFold):
    """A path that many Folded-Gaussians share, such as the motion of a camera, and a fold of each one's own.

        f(u) = A(m_t - u) (q + g(u)) - A(m_t) q

    A is the path, an affine map of space for each time: linear between the knots, constant before the first and after
    the last. `anchor` is q, the place that the path moves, `time_loc` is m_t, and `fold` is g, with g(0) = 0. So
    f(0) = 0, and with `loc` = A(m_t) q (`home`) the center at time t is A(t) (q + g(m_t - t)).

    A fold moves centers only: that a path also turns and stretches the covariance is not represented.

    **Shapes:** `times` (paths, knots), which do not decrease, and `matrices` (paths, knots, d-1, d), rows (linear part
    | offset), usually without batch dimensions; `anchor` (*batch, d-1); `time_loc` (*batch,); `index` (*batch,), whole
    numbers: the path of each element from 1, 0 for none, f = g; u (*batch,) -> (*batch, d-1), leading dimensions
    broadcast. Paths are not copied for each element of a batch (as the parameters of a `CallableFold`), so `vmap` over
    a batch of distributions needs `in_axes=None` for them, or a call within of the constructor.

    **Units:** `anchor`, offsets and f are space, `times` and u time, linear parts have none.

    **Example:** `SharedPathFold(ZeroFold(1), [2.0], time_loc=0.5, index=1, times=[[0.0, 1.0]], matrices=[[[[1.0, 0.0]],
    [[3.0, 0.0]]]])(-0.5)  # from 2 * 2 to 3 * 2: [2.]`

    **Source:** the "suitably chosen" f of eq:transform_s. **Raises:** ValueError for shapes that do not fit, numbers
    that are not finite, times that decrease, and for paths that there are not.
    """

    fold: AbstractFold
    anchor: Float[Array, "*batch d-1"]
    time_loc: Float[Array, "*batch"]
    index: Int[Array, "*batch"]
    times: Float[Array, "*batch paths knots"]
    matrices: Float[Array, "*batch paths knots d-1 d"]

    shares_leaves = True

    def __init__(
        self,
        fold: AbstractFold | Callable,
        anchor: ArrayLike,
        *,
        time_loc: ArrayLike,
        index: ArrayLike,
        times: ArrayLike,
        matrices: ArrayLike,
    ):
        dtype = common_dtype(anchor, time_loc, times, matrices)
        self.fold, self.index = as_fold(fold), jnp.asarray(index, jnp.int32)
        self.anchor, self.time_loc, self.times, self.matrices = (
            jnp.asarray(x, dtype) for x in (anchor, time_loc, times, matrices)
        )
        self._check(np.shape(self.anchor)[-1:])

    def _check(self, space: tuple[int, ...]) -> None:
        dims = (*space, *(n + 1 for n in space))
        require(
            self.times.ndim >= 2 and dims and self.matrices.shape[-4:] == (*self.times.shape[-2:], *dims),
            "times, matrices",
            expected="times (paths, knots) and matrices (paths, knots, d-1, d)",
            got=f"{self.times.shape} and {self.matrices.shape}",
        )
        for name in ("anchor", "time_loc", "times", "matrices"):
            check_finite(name, getattr(self, name))
        check_values("times", self.times, lambda t: np.diff(t, prepend=-np.inf) >= 0, "times that do not decrease")
        most = self.times.shape[-2]
        check_values("index", self.index, lambda k: (k >= 0) & (k <= most), f"paths from 1 to {most}, or 0")

    @property
    def is_closed(self) -> bool:
        return self.fold.is_closed

    @vectorized(0)
    def maps(self, t: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1 d"]:
        """The maps A(t) of the elements at times t; the identity for those on no path."""
        path = jnp.maximum(self.index - 1, 0)
        before, after, fraction = locate(self.times, path, t)
        maps = (1 - fraction) * self.matrices[path, before] + fraction * self.matrices[path, after]
        return jnp.where(self.index > 0, maps, jnp.eye(*maps.shape, dtype=maps.dtype))

    @property
    def home(self) -> Float[Array, "*batch d-1"]:
        """A(m_t) q, the `loc` of the Folded-Gaussian."""
        return _apply_maps(self.maps(self.time_loc), self.anchor)

    @vectorized(0)
    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch d-1"]:
        shift = self.fold(u)
        moved = _apply_maps(self.maps(self.time_loc - u), self.anchor + shift) - self.home
        return jnp.where(self.index > 0, moved, shift)

    @property
    def breaks(self) -> Float[Array, " breaks"]:
        knots = self.times[jnp.maximum(self.index - 1, 0)]
        return jnp.concatenate([self.time_loc - knots, self.fold.breaks.astype(knots.dtype)])


def _apply_maps(maps: Float[Array, "*#batch d-1 d"], place: Float[Array, "*#batch d-1"]) -> Float[Array, "*#batch d-1"]:
    return (maps[..., :-1] * place[..., None, :]).sum(-1) + maps[..., -1]


def as_fold(fold: AbstractFold | Callable) -> AbstractFold:
    """`fold` itself if it is one, else a `CallableFold` of the callable, which vmaps it.

    **Shapes:** a callable maps one scalar u to (d-1,). **Raises:** ValueError if it is not callable.

    **Example:** `as_fold(lambda u: jnp.stack([u, u**2]))`
    """
    if isinstance(fold, AbstractFold):
        return fold
    require(
        callable(fold),
        "fold",
        expected="a fold or a callable u -> (d-1,)",
        got=short_repr(fold),
        cure="For coefficients use PolynomialFold(coefficients).",
    )
    check_signature("fold", fold, "u")
    return CallableFold(fold)


def evaluate_shift(fold: AbstractFold, u: Float[Array, ""]) -> Float[Array, " d-1"]:
    """`fold(u)` of one fold and number, with a derivative in u that is efficient for large batches.

    A fold is elementwise in u, so its slope is one forward derivative. Reverse-mode autodiff would sum over the d-1
    coordinates at each step of the recursion instead of once, in loops too short to be vectorized.
    """
    if not fold.is_closed:  # it may close over tracers, which a custom derivative would lose
        return fold(u)
    leaves, structure = jax.tree.flatten(fold)
    return _shift(structure, u, *leaves)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _shift(structure, u, *leaves):
    return jax.tree.unflatten(structure, leaves)(u)


@partial(_shift.defjvp, symbolic_zeros=True)
def _shift_jvp(structure, primals, tangents):
    u, *leaves = primals
    shift, moved = jvp_of_moving(lambda *leaves: jax.tree.unflatten(structure, leaves)(u), leaves, tangents[1:])
    if isinstance(tangents[0], SymbolicZero):
        return shift, moved
    slope = jax.jvp(lambda u: jax.tree.unflatten(structure, leaves)(u), (u,), (jnp.ones_like(u),))[1]
    return shift, moved + join_columns([column * tangents[0] for column in split_columns(slope)])


def _coefficient_rows(name: str, x: ArrayLike, count: str, rows: str) -> Float[Array, "*batch n d-1"]:
    x = jnp.asarray(x)
    require(
        x.ndim >= 2 and x.shape[-1] >= 1,
        name,
        expected=f"shape (*batch, {count}, d-1)",
        got=f"shape {x.shape}",
        cure=f"{rows}; a single space coordinate still needs its own axis.",
    )
    check_finite(name, x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)


def _check_knots(knots: ArrayLike, n: int, degree: int) -> tuple[float, ...]:
    knots = np.asarray(knots, np.float64)
    require(
        knots.shape == (n + degree + 1,) and n > degree,
        "knots",
        expected=f"shape (n + degree + 1,) = ({n + degree + 1},)",
        got=f"{knots.shape}",
        cure="There are n coefficients, n > degree; repeat the end knots degree + 1 times to clamp the ends.",
    )
    require(
        np.isfinite(knots).all() and (np.diff(knots) >= 0).all() and (knots[degree] < knots[n]),
        "knots",
        expected="finite, non-decreasing values",
        got=knots.tolist(),
        cure="Sort them, with knots[degree] < knots[n].",
    )
    return tuple(knots.tolist())


def _spline_basis(v: Array, knots: tuple[float, ...], degree: int) -> list[Array]:
    """B_i(v) for all i, by the Cox-de Boor recursion; empty intervals are skipped while tracing."""
    last = max(i for i in range(len(knots) - 1) if knots[i] < knots[i + 1] and knots[i + 1] <= knots[-degree - 1])
    inside = [(v >= a) & ((v <= b) if i == last else (v < b)) for i, (a, b) in enumerate(pairwise(knots))]
    basis = [jnp.where(here & (i <= last), 1, 0).astype(v.dtype) for i, here in enumerate(inside)]
    for k in range(1, degree + 1):
        ramps = [_ramp(v, knots[i], knots[i + k]) for i in range(len(basis))]
        basis = [ramps[i] * basis[i] + (1 - ramps[i + 1]) * basis[i + 1] for i in range(len(basis) - 1)]
    return basis


def _ramp(v: Array, start: float, end: float) -> Array:
    return (v - start) / (end - start) if start < end else jnp.zeros_like(v)


class RestrictedFold(AbstractFold):
    """Some coordinates of any fold, `f(u)[indices]`."""

    fold: AbstractFold
    indices: tuple[int, ...] = eqx.field(static=True)

    @property
    def is_closed(self) -> bool:
        return self.fold.is_closed

    @property
    def shares_leaves(self) -> bool:
        return self.fold.shares_leaves

    def __call__(self, u: Float[Array, "*#batch"]) -> Float[Array, "*#batch kept"]:
        return self.fold(u)[..., np.array(self.indices)]

    @property
    def breaks(self) -> Float[Array, " breaks"]:
        return self.fold.breaks


def restrict_fold(fold: AbstractFold, indices: tuple[int, ...]) -> AbstractFold:
    if isinstance(fold, ZeroFold):
        return ZeroFold(len(indices))
    if isinstance(fold, PolynomialFold):
        return jax.tree.map(lambda coefficients: coefficients[..., np.array(indices)], fold)
    return RestrictedFold(fold, indices)
