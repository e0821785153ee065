r"""Quasi-hyperbolic Adam (Ma and Yarats 2019): its constants, its rule, and the implementations that fits use.

With gradient $g$, moments $m, v$, learning rate $\eta$ and $n$ the number of steps taken:

$$ m \gets \beta_1 m + (1 - \beta_1) g, \quad v \gets \beta_2 v + (1 - \beta_2) g^2, \quad
   \theta \gets \theta - \eta\, \frac{\nu\, m / (1 - \beta_1^n) + (1 - \nu) g}
   {\sqrt{v / (1 - \beta_2^n)} + \epsilon} $$

With $\nu = 1$ it is Adam (Kingma and Ba 2015). `sparse_adam` (Numba) and its twin `masked_adam` (JAX) are for the rows
of Gaussians. Adam itself is used for the maps of shared paths (`update_paths`, JAX) and for frame times
(`FRAME_TIME_ADAM`, optax). Tests compare them with the rule in NumPy. Each row counts its own steps, so that its bias
correction is right however seldom the Gaussian is alive.
"""

import math

import jax
import jax.numpy as jnp
import numba as nb
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from foldgauss._runtime.kernels import inline, kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.models.frame_times import CUT_RATIO, FrameTimes
from foldgauss.video.models.row_layout import columns, group_bits

#: Decay of the first moment.
BETA1 = 0.9
#: Decay of the second moment.
BETA2 = 0.999
#: As in the published 3DGS.
EPSILON = 1e-15
FRAME_TIME_ADAM = optax.scale_by_adam(BETA1, BETA2, EPSILON)

_CHUNK = 2048  # rows per task
_f = nb.float32
_u = nb.uint64

#: The sigma_t at which the learning rates of positions, folds and m_t are stated.
UNIT_TIME = 0.06
#: The standard deviation at which they are stated, in units of the frame's longer side.
UNIT_SIZE = 0.005
#: 1 / (1 - beta^n) for both betas, by the number n of steps; beyond the table it is 1 in float32. (Computing the powers
#: for each row took a third of a step's optimizer.)
BIAS_CORRECTIONS = np.ones((20_000, 2), np.float32)
BIAS_CORRECTIONS[1:] = 1 / (1 - np.array([BETA1, BETA2]) ** np.arange(1, len(BIAS_CORRECTIONS))[:, None])


def _find_degree(rows) -> int:
    return (rows.shape[1] - columns(0)["coefficients"].start) // 2


def _vector_columns(degree: int) -> np.ndarray:
    """The first columns of m_s and of each c_k, which a second one follows."""
    place = columns(degree)
    return np.array([place["loc"].start, *range(place["coefficients"].start, place["coefficients"].stop, 2)])


# ----------------------------------------------------------------------------------- rows of Gaussians, Numba


@inline
def _turn(row, at, cos, sin):
    """Turn the pairs of columns that begin at `at` by an angle, in place."""
    for c in at:
        x, y = row[c], row[c + 1]
        row[c], row[c + 1] = cos * x - sin * y, sin * x + cos * y


@kernel
def _update(
    start, stop, touched, rows, grad, first, second, counts, rounded, bits, rates, nu, own_units, at, vectors, factors
):
    beta1, beta2 = _f(BETA1), _f(BETA2)
    own = rates.copy()
    scale, angle, spread, time = at
    width = _u(len(bits))  # without the column of paths, which is not trained
    total = 0.0
    for k in range(start, stop):
        i = touched[k]
        counts[i] += 1
        taken = min(counts[i], len(factors) - 1)
        correction1, correction2 = factors[taken, 0], factors[taken, 1]
        row, g, m, v = rows[i], grad[i], first[i], second[i]
        along, across, cos, sin, power, short = _f(1.0), _f(1.0), _f(1.0), _f(0.0), _f(1.0), _f(1.0)
        if own_units:
            along, across = math.exp(row[scale]) / _f(UNIT_SIZE), math.exp(row[scale + 1]) / _f(UNIT_SIZE)
            own[angle] = rates[angle] / max(abs(along / across - across / along), _f(1.0))
            turned = _f(2 * math.pi) / (_f(1.0) + math.exp(-row[angle]))
            cos, sin = math.cos(turned), math.sin(turned)
            wide = math.exp(row[spread]) / _f(UNIT_TIME)
            own[time] = rates[time] * wide
            short = _f(1.0) / wide
        for c in vectors:
            own[c], own[c + 1] = rates[c] * along * power, rates[c + 1] * across * power
            power *= short
        if rounded[i]:
            for c in range(width):
                if rounded[i] & bits[c]:
                    g[c] = _f(0.0)
        _turn(g, vectors, cos, -sin)
        for c in range(width):
            m[c] = beta1 * m[c] + (_f(1.0) - beta1) * g[c]
            v[c] = beta2 * v[c] + (_f(1.0) - beta2) * g[c] * g[c]
            g[c] = own[c] * (nu * m[c] * correction1 + (_f(1.0) - nu) * g[c])
            g[c] /= math.sqrt(v[c] * correction2) + _f(EPSILON)
        _turn(g, vectors, cos, sin)
        for c in range(width):
            row[c] -= g[c]
            g[c] = _f(0.0)
            total += row[c]
    return total


def sparse_adam(
    rows: np.ndarray,
    grad: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    counts: np.ndarray,
    touched: np.ndarray,
    rates: np.ndarray,
    *,
    rounded: np.ndarray,
    nu: float,
    own_units: bool,
) -> bool:
    """One step on the rows `touched`, in place; their gradients are set to zero. Returns whether they are finite.

    `rows`, `grad` and the moments `first`, `second`: float32 (num, width); `counts`: int32 (num,), steps taken by each
    row; `rates`: float32 (width,), learning rates by column. `rounded`, uint8 (num,): bits of the groups of leaves
    (`row_layout.GROUPS`) whose gradients are ignored. `nu` and `own_units`: see `config.LearningRates`.
    """
    degree = _find_degree(rows)
    names = ("log_scale", "angle_logit", "log_time_scale", "time_loc_logit")
    at = tuple(columns(degree)[name].start for name in names)
    num, vectors = len(touched), _vector_columns(degree)
    bits = group_bits(degree)
    sums = np.zeros(-(-num // _CHUNK))

    def work(start: int) -> None:
        stop = min(start + _CHUNK, num)
        arrays = touched, rows, grad, first, second, counts, rounded, bits
        sums[start // _CHUNK] = _update(start, stop, *arrays, rates, _f(nu), own_units, at, vectors, BIAS_CORRECTIONS)

    run_tasks(work, range(0, num, _CHUNK))
    return math.isfinite(sums.sum())


# ------------------------------------------------------------------------------------- rows of Gaussians, JAX


def masked_adam(rows, grad, first, second, counts, touched, rates, *, rounded, nu: float, own_units: bool):
    """`sparse_adam` in JAX: rows, moments and counts after a step on the rows where `touched`, bool (num,), is true."""
    degree = _find_degree(rows)
    bits = np.zeros(rows.shape[1], np.uint8)
    bits[: columns(degree)["coefficients"].stop] = group_bits(degree)
    grad = jnp.where((rounded[:, None] & bits[None]) > 0, np.float32(0), grad)
    counts = counts + touched.astype(counts.dtype)
    corrections = jnp.asarray(BIAS_CORRECTIONS)[jnp.minimum(counts, len(BIAS_CORRECTIONS) - 1)]
    beta1, beta2, one = np.float32(BETA1), np.float32(BETA2), np.float32(1)
    factors, angle = _own_units(rows, degree) if own_units else (jnp.ones_like(rows), jnp.zeros_like(rows[:, 0]))
    grad = _turn_vectors(grad, degree, -angle)
    mean = beta1 * first + (one - beta1) * grad
    square = beta2 * second + (one - beta2) * grad * grad
    change = rates[None, :] * factors * (np.float32(nu) * mean * corrections[:, :1] + np.float32(1 - nu) * grad)
    change /= jnp.sqrt(square * corrections[:, 1:]) + np.float32(EPSILON)
    moved, chosen = rows - _turn_vectors(change, degree, angle), touched[:, None]
    return jnp.where(chosen, moved, rows), jnp.where(chosen, mean, first), jnp.where(chosen, square, second), counts


def _turn_vectors(rows, degree: int, angle: Float[Array, " num"]) -> Float[Array, "num width"]:
    at, cos, sin = _vector_columns(degree), jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    x, y = rows[:, at], rows[:, at + 1]
    return rows.at[:, at].set(cos * x - sin * y).at[:, at + 1].set(sin * x + cos * y)


def _own_units(rows, degree: int) -> tuple[Float[Array, "num width"], Float[Array, " num"]]:
    """The factors of the learning rates by each Gaussian's own units, and the angle of its axes."""
    place, at = columns(degree), _vector_columns(degree)
    axes = jnp.exp(rows[:, place["log_scale"]]) / np.float32(UNIT_SIZE)
    wide = jnp.exp(rows[:, place["log_time_scale"]]) / np.float32(UNIT_TIME)
    ratio, short = axes[:, :1] / axes[:, 1:], wide ** -np.arange(len(at), dtype=np.float32)[None]
    factors = jnp.ones_like(rows).at[:, place["angle_logit"]].set(1 / jnp.maximum(jnp.abs(ratio - 1 / ratio), 1))
    factors = factors.at[:, place["time_loc_logit"]].set(wide)
    factors = factors.at[:, at].set(axes[:, :1] * short).at[:, at + 1].set(axes[:, 1:] * short)
    return factors, 2 * math.pi * jax.nn.sigmoid(rows[:, place["angle_logit"].start])


# ------------------------------------------------------------------------------------- shared paths, frame times


@jax.jit
def update_paths(
    arrays: tuple[Array, ...], grad: Float[Array, "frames paths 2 3"], visited: Bool[Array, " frames"], rate
) -> tuple[Array, ...]:
    """The maps of shared paths, both moments and the frames' counts of steps, after a step on the frames `visited`."""
    *before, counts = arrays
    counts = counts + visited.astype(counts.dtype)
    taken = jnp.maximum(counts, 1).astype(np.float32)[:, None, None, None]
    beta1, beta2, one = np.float32(BETA1), np.float32(BETA2), np.float32(1)
    first = beta1 * before[1] + (one - beta1) * grad
    second = beta2 * before[2] + (one - beta2) * grad * grad
    mean, square = first / (one - beta1**taken), second / (one - beta2**taken)
    maps = before[0] - rate * mean / (jnp.sqrt(square) + np.float32(EPSILON))
    chosen = visited[:, None, None, None]
    return *(jnp.where(chosen, new, old) for new, old in zip((maps, first, second), before, strict=True)), counts


@jax.jit
def update_frame_times(logits, moments, by_time, rate):
    """The softmax weights of the frame times and their moments (count, first, second) after a step, given dL/dt_k.

    The interval of a cut is some hundred frames long: its weight moves by as much less, as otherwise a step that moves
    other frames by a thousandth of a frame would move all frames after the cut by a tenth.
    """
    intervals = jax.nn.softmax(logits)
    median = jnp.median(intervals)
    slower = jnp.where(intervals > CUT_RATIO * median, median / intervals, 1)
    _, pull = jax.vjp(lambda weights: FrameTimes(weights).times(), logits)
    with jax.numpy_dtype_promotion("standard"):  # optax raises Python floats to integer counts
        update, moments = FRAME_TIME_ADAM.update(pull(by_time)[0], optax.ScaleByAdamState(*moments))
    return logits - rate * slower * update, tuple(moments)
