"""Log-densities of many points under many components, in one loop over pairs that XLA vectorizes.

Derivatives are those of the distributions' own `log_prob`, which have a larger range.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from foldgauss._numerics.batch import align_leaves, jvp_of_moving, ranked_leaves
from foldgauss._numerics.triangular import UNROLLED_SIZE, solve_lower
from foldgauss.envelope import AbstractEnvelope, TimeLikelihood
from foldgauss.gaussian import Gaussian, half_log_det

_HALF_LOG_2PI = 0.5 * float(np.log(2 * np.pi))


class _QuickTimeLikelihood(AbstractEnvelope):
    """`TimeLikelihood` to an *absolute* error of rounding in log a, by fewer and plainer functions."""

    power: Float[Array, "*#batch"]
    floor: Float[Array, "*#batch"] | None  # None is 0

    def log_a(self, t, *, time_loc, time_scale):
        largest = float(jnp.finfo(t.dtype).max) * 1e-3  # avoids inf - inf and 0 * inf
        tau = (t - time_loc) / time_scale
        decay = -jnp.minimum(0.5 * self.power * jnp.minimum(tau * tau, largest), largest)
        if self.floor is None:
            return decay
        decay, log_floor = jnp.log1p(-self.floor) + decay, jnp.log(self.floor)
        share = jnp.exp(-jnp.abs(decay - log_floor))  # of the smaller term in the greater, at most 1
        return jnp.maximum(decay, log_floor) + jnp.log(1 + share)


def move_components_first(components, rank: int):
    """Move batch axes (*batch, k) to (k, 1, *batch), to broadcast against points (n, *batch); `rank` is that of *batch.

    With the components first, sums over them are vectorized over points.
    """
    in_front = lambda leaf: jnp.expand_dims(jnp.moveaxis(leaf, rank, 0), 1)  # noqa: E731
    return jax.tree.map(in_front, align_leaves(components, rank + 1))


def pair_log_prob(first, rows: Float[Array, "n *batch d"]) -> Float[Array, "k n *batch"]:
    """log p_k(x) of each point and component; `first` as `move_components_first` gives it."""
    is_folded = hasattr(first, "fold") and first.fold.is_closed and first.envelope.is_closed
    if not (is_folded or isinstance(first, Gaussian)) or rows.shape[-1] > UNROLLED_SIZE:
        return first.log_prob(rows[None])
    leaves, structure = jax.tree.flatten(first)
    return _pairs(structure, rows, *leaves)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _pairs(structure, rows: Array, *leaves: Array) -> Array:
    dist = jax.tree.unflatten(structure, leaves)
    if isinstance(dist, Gaussian) or not isinstance(dist.envelope, TimeLikelihood):
        return _values(dist, rows)
    power, floor = dist.envelope.power, dist.envelope.floor

    def having(floor):
        return _values(eqx.tree_at(lambda dist: dist.envelope, dist, _QuickTimeLikelihood(power, floor)), rows)

    # Without a floor log a needs no logarithm, which halves the time.
    return lax.cond((floor == 0).all(), lambda: having(None), lambda: having(floor))


def _values(dist, rows: Array) -> Array:
    x = [rows[None, ..., i] for i in range(rows.shape[-1])]
    if isinstance(dist, Gaussian):
        at, log_rest = dist, jnp.zeros((), rows.dtype)
    else:
        at = dist.condition_time(x[-1])
        tau = (x.pop() - dist.time_loc) / dist.time_scale
        log_rest = 0.5 * tau * tau + jnp.log(dist.time_scale) + _HALF_LOG_2PI
    residual = [(s - at.loc[..., i])[..., None] for i, s in enumerate(x)]
    # Twice the root: the product may be in range where 1 / scale is not.
    largest = 0.99 * float(np.log(jnp.finfo(rows.dtype).max))
    root = jnp.exp(jnp.clip(-0.5 * at.log_scale, -largest, largest))[..., None]
    z = [y * root * root for y in solve_lower(at.base_tril, residual)]
    half_square = sum(0.5 * y * y for y in z)[..., 0]
    log_density = -(half_square + log_rest) - (half_log_det(at) + len(x) * _HALF_LOG_2PI)
    # NaN from inf - inf or 0 * inf means far away, -inf; NaN of the input propagates.
    reached = jnp.where((half_square < jnp.inf) & (log_rest < jnp.inf), log_density, -jnp.inf)
    return reached + _nan_of([(rows[None], 1)]) + _nan_of(ranked_leaves(dist))


def _nan_of(parts: list[tuple[Array, int]]) -> Array:
    """NaN where one of the arrays has one, else 0."""
    found = [jnp.isnan(x).any(tuple(range(x.ndim - rank, x.ndim))) for x, rank in parts]
    return jnp.where(functools.reduce(jnp.logical_or, found), jnp.nan, 0).astype(parts[0][0].dtype)


@functools.partial(_pairs.defjvp, symbolic_zeros=True)
def _pairs_jvp(structure, primals, tangents):
    own = lambda rows, *leaves: jax.tree.unflatten(structure, leaves).log_prob(rows[None])  # noqa: E731
    return _pairs(structure, *primals), jvp_of_moving(own, primals, tangents)[1]


def map_in_chunks(pairs, finish, rows: Float[Array, "n ..."], size: int) -> Array:
    """`finish(pairs(rows))`, `size` rows at a time, rematerialized in gradients; `finish` moves the rows first."""
    if len(rows) <= size:
        return finish(pairs(rows))
    chunks = -(-len(rows) // size)
    padding = jnp.broadcast_to(rows[:1], (chunks * size - len(rows), *rows.shape[1:]))
    pieces = jnp.concatenate([rows, padding]).reshape(chunks, size, *rows.shape[1:])
    shape = jax.eval_shape(pairs, jax.ShapeDtypeStruct(pieces.shape[1:], rows.dtype))

    @jax.checkpoint
    def one(number, piece):
        # The condition always holds; it prevents XLA from fusing this loop with the slicing of the piece or with
        # `finish`, which would not be vectorized (on the CPU 3.9 instead of 1.1 ns a pair).
        empty = lambda piece: jnp.zeros(shape.shape, shape.dtype)  # noqa: E731
        return finish(lax.cond(number >= 0, pairs, empty, piece))

    result = lax.map(lambda numbered: one(*numbered), (jnp.arange(chunks), pieces))
    return result.reshape(chunks * size, *result.shape[2:])[: len(rows)]
