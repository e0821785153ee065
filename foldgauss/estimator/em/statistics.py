"""The E-step: sufficient statistics of the components, summed over points in chunks and over devices.

For component k, with responsibilities r_i, frequency weights w_i and z_i = (He_0(v_i) .. He_q(v_i), e_i) with the
whitened residual e_i = L^-1 (s_i - curve):

    gram = sum_i w_i r_i / a_i z_i z_i'

holds the whole weighted regression of space on time. It is centered before it is squared: v is of order one, and the
residuals are whitened and relative to the component's current curve.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from foldgauss._numerics.batch import cast
from foldgauss._numerics.regression import hermite_columns
from foldgauss.envelope import AbstractEnvelope, Constant
from foldgauss.estimator.chunks import Chunks, Piece
from foldgauss.estimator.em.components import Densities, Parameters, evaluate_densities

#: Densities of point and component held at once. Arrays of this many numbers stay in a core's cache.
PAIRS_PER_CHUNK = 2**17
#: The smallest number of rows that a program is compiled for: small batches of any size share one.
_MIN_ROWS = 256
#: Of points that are read piece by piece, this many chunks are passed to one call of a program.
_CHUNKS_PER_BLOCK = 8


class Points(eqx.Module):
    """Points in chunks of equal size, the last one padded with rows of weight 0.

    The leading axis is that of devices; arrays sharded along it are summed by JAX's partitioner.
    """

    x: Float[Array, "devices chunks rows d"]
    weights: Float[Array, "devices chunks rows"]


class Times(NamedTuple):
    """time_loc and time_scale of each component, at which the envelope is evaluated."""

    loc: Float[Array, " k"]
    scale: Float[Array, " k"]


class SufficientStatistics(NamedTuple):
    """Sums over points. `log_a` and `gram` have a leading axis: the value, and with `order=2` its derivatives by the
    steps of the times (d0, d1, d00, d01, d11), see `step_times`."""

    log_likelihood: Float[Array, ""]
    mass: Float[Array, " k"]  # sum of w r
    first: Float[Array, " k"]  # of w r v
    second: Float[Array, " k"]  # of w r v^2
    log_a: Float[Array, "order k"]  # of w r log a
    gram: Float[Array, "order k m m"]


def make_points(
    x: np.ndarray, weights: np.ndarray, num_components: int, devices: int = 1, size: int | None = None
) -> Points:
    """Chunk points (n, d) and weights (n,), padded to `size` (default: n) and then to few distinct shapes, so that few
    programs are compiled."""
    per_device = -(-(len(x) if size is None else size) // devices)
    rows = min(_rows_per_chunk(num_components), _padded_rows(per_device))
    shape = (devices, -(-per_device // rows), rows)
    missing = math.prod(shape) - len(x)
    x = np.pad(x, ((0, missing), (0, 0))).reshape(*shape, x.shape[1])
    weights = np.pad(weights, (0, missing)).reshape(shape)
    if devices == 1:
        return Points(jnp.asarray(x), jnp.asarray(weights))
    mesh = jax.sharding.Mesh(np.asarray(jax.devices()[:devices]), ("points",))
    where = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("points"))
    return Points(jax.device_put(x, where), jax.device_put(weights, where))


def _rows_per_chunk(num_components: int) -> int:
    return max(2 ** int(math.log2(max(PAIRS_PER_CHUNK // num_components, 16))), 16)


def _padded_rows(num_rows: int) -> int:
    return max(2 ** math.ceil(math.log2(max(num_rows, 1))), _MIN_ROWS)


def map_leading(function: Callable, *arguments):
    """`jax.vmap`; of a single entry, without an axis of size one in every array."""
    if len(jax.tree.leaves(arguments)[0]) == 1:
        return jax.tree.map(lambda z: z[None], function(*jax.tree.map(lambda z: z[0], arguments)))
    return jax.vmap(function)(*arguments)


def sum_chunks(function: Callable, arrays):
    """The sum of a function of chunks over all of `arrays`, of leading axes (devices, chunks): on each device one at a
    time."""
    return jax.tree.map(lambda z: z.sum((0, 1)), map_leading(lambda chunks: lax.map(function, chunks), arrays))


# --- points that are read piece by piece ----------------------------------------------------------------------


class Blocks(NamedTuple):
    """Points that are read anew in every pass; `prepare` converts a piece to scaled points and weights."""

    chunks: Chunks
    prepare: Callable[[Piece], tuple[np.ndarray, np.ndarray]]
    dtype: np.dtype
    num_components: int
    size: int  # points in all chunks
    devices: int


def sum_over_points(function: Callable, points: Points | Blocks, *arguments):
    """`function(*arguments, points)`, compiled, of a function that is a sum over points; of blocks, in float64."""
    if isinstance(points, Points):
        return _compiled(function)(*arguments, points)
    total, last = None, None
    rows = map(points.prepare, points.chunks)
    for block in make_blocks(rows, points.size, points.num_components, points.devices):
        # JAX returns before the sums are computed: meanwhile the next block is read.
        last, before = _compiled(function)(*arguments, block), last
        total = _add(total, before)
    return jax.tree.map(lambda z: jnp.asarray(z, points.dtype), _add(total, last))


def _add(total, more):
    """Add pytrees of sums in float64; a total of None is zero. Where both are None, so is the sum."""
    more = jax.tree.map(lambda z: np.asarray(z, np.float64), more)
    return more if total is None else jax.tree.map(np.add, total, more)


def make_blocks(rows: Iterable[tuple], size: int, num_components: int, devices: int) -> Iterator[Points]:
    """Regroup `rows`, (points, weights) of any lengths, `size` in all, to blocks of one shape: compiled once."""
    most = devices * _CHUNKS_PER_BLOCK * _rows_per_chunk(num_components)
    size, held, count = min(devices * _padded_rows(-(-size // devices)), most), [], 0

    def block():
        return make_points(*map(np.concatenate, zip(*held, strict=True)), num_components, devices, size)

    for y, weights in rows:
        while len(y):
            taken = min(len(y), size - count)
            held.append((y[:taken], weights[:taken]))
            count, y, weights = count + taken, y[taken:], weights[taken:]
            if count == size:
                yield block()
                held, count = [], 0
    if held:
        yield block()


@functools.cache
def _compiled(function: Callable) -> Callable:
    return eqx.filter_jit(function)


def enable_dtype(dtype) -> contextlib.AbstractContextManager:
    """A context that enables float64 in JAX if the dtype is float64, and then restores the user's setting."""
    return jax.enable_x64(True) if dtype == np.float64 else contextlib.nullcontext()


# --- sums -----------------------------------------------------------------------------------------------------


def accumulate(
    params: Parameters,
    envelope: AbstractEnvelope,
    points: Points,
    *,
    times: Times | None = None,
    order: int = 0,
    inverse_temperature: Float[Array, ""] | None = None,
    responsibilities: Float[Array, "devices chunks rows k"] | None = None,
) -> SufficientStatistics:
    """Compute the sufficient statistics, with the envelope at `times` (default: those of the components).

    Responsibilities are those of `params` unless passed. With an inverse temperature b below 1 they are proportional
    to the densities to the power b.
    """
    envelope = cast(envelope, points.x.dtype)

    def of_chunk(chunk):
        x, weights, given = chunk
        pairs = evaluate_densities(params, envelope, x)
        log_likelihood, mass = _weigh_responsibilities(pairs.log_density, weights)
        if given is not None:
            mass = weights[:, None] * given
        elif inverse_temperature is not None:
            mass = _weigh_responsibilities(inverse_temperature * pairs.log_density, weights)[1]
        total = jnp.where(weights > 0, weights * log_likelihood, 0).sum()
        return _sum_chunk(params, envelope, x[:, -1:], pairs, mass, total, times, order)

    return sum_chunks(of_chunk, (points.x, points.weights, responsibilities))


def _weigh_responsibilities(log_density: Float[Array, "n k"], weights: Float[Array, " n"]):
    """log sum_k of every point, and its responsibilities times its weight, with one exponential a pair for both."""
    largest = log_density.max(-1)
    # Where all densities underflow, responsibilities are 0 and the log-likelihood is -inf.
    largest = jnp.where(jnp.isneginf(largest), 0, largest)
    density = jnp.exp(log_density - largest[:, None])
    total = density.sum(-1)
    share = weights / jnp.where(total == 0, 1, total)
    return jnp.log(total) + largest, density * share[:, None]


def _sum_chunk(params, envelope, t, pairs: Densities, mass, total, times, order) -> SufficientStatistics:
    degree, v = params.degree, pairs.v
    basis = hermite_columns(v, degree)
    if isinstance(envelope, Constant):
        weights = [mass]
        log_a = [jnp.zeros(mass.shape[1], v.dtype)]
    else:
        times = Times(params.time_loc, params.time_scale) if times is None else times
        log_as = _log_a_derivatives(envelope, t, times, order)
        log_a = [(mass * z).sum(0) for z in log_as]
        weights = _divide_by_a(mass, log_as)
    gram = jnp.stack([_gram(w, basis, pairs.whitened) for w in weights])
    if isinstance(envelope, Constant) and degree:  # He_0 = 1 and He_1 = v: the gram has these sums already
        mass, first, second = gram[0, :, 0, 0], gram[0, :, 0, 1], gram[0, :, 1, 1]
    else:
        mass, first, second = mass.sum(0), (mass * v).sum(0), (mass * v * v).sum(0)
    return SufficientStatistics(total, mass, first, second, jnp.stack(log_a), gram)


def _gram(weights, basis, whitened):
    """sum_i weights_ik z_ik z_ik', (k, m, m)."""
    if whitened[0].ndim == 3:
        z = jnp.concatenate([jnp.stack(basis, -1), whitened[0]], -1)
        return jnp.einsum("nk,nka,nkb->kab", weights, z, z)
    # The barrier keeps XLA from recomputing them in each of the sums.
    weights, basis, whitened = lax.optimization_barrier((weights, basis, whitened))
    z = basis + whitened
    upper = {}
    for a in range(len(z)):
        left = weights if a == 0 else weights * z[a]  # z[0] is 1
        for b in range(a, len(z)):
            upper[a, b] = (left if b == 0 else left * z[b]).sum(0)
    rows = [[upper[min(a, b), max(a, b)] for b in range(len(z))] for a in range(len(z))]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


# --- the envelope's derivatives by steps of the times -------------------------------------------------------


def step_times(times: Times, steps: Float[Array, "2 ..."]) -> Times:
    """Move time_loc to time_loc + time_scale d0 and time_scale to time_scale exp(d1): steps of natural size."""
    return Times(times.loc + times.scale * steps[0], times.scale * jnp.exp(steps[1]))


def _log_a_derivatives(envelope, t, times: Times, order: int) -> list[Float[Array, "n k"]]:
    """log a, with order 2 also its derivatives by d0, d1, d00, d01, d11 at 0."""

    def value(steps):
        at = step_times(times, steps)
        return envelope.log_a(t, time_loc=at.loc[None], time_scale=at.scale[None])

    zero = jnp.zeros((2, *times.loc.shape), times.loc.dtype)
    if order == 0:
        return [value(zero)]
    directions = [zero.at[j].set(1) for j in range(2)]
    slope = lambda j: lambda steps: jax.jvp(value, (steps,), (directions[j],))[1]  # noqa: E731
    curvature = lambda i, j: jax.jvp(slope(i), (zero,), (directions[j],))[1]  # noqa: E731
    return [value(zero), slope(0)(zero), slope(1)(zero), curvature(0, 0), curvature(0, 1), curvature(1, 1)]


def _divide_by_a(mass, log_a) -> list[Float[Array, "n k"]]:
    """mass / a and its derivatives: e^-l, -l_i e^-l, (l_i l_j - l_ij) e^-l."""
    largest = 0.95 * float(np.log(jnp.finfo(mass.dtype).max))
    # One exponential of the sum: 1/a alone may overflow where the responsibility is small.
    log_mass = jnp.log(jnp.where(mass > 0, mass, 1))
    weight = jnp.where(mass > 0, jnp.exp(jnp.minimum(log_mass - log_a[0], largest)), 0)
    if len(log_a) == 1:
        return [weight]
    _, l0, l1, l00, l01, l11 = log_a
    factors = [-l0, -l1, l0 * l0 - l00, l0 * l1 - l01, l1 * l1 - l11]
    return [weight, *(weight * factor for factor in factors)]
