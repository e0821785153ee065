r"""Adam (Kingma and Ba 2015): its constants, its rule, and the implementations of it that fits use.

With gradient $g$, moments $m, v$, learning rate $\eta$ and $n$ the number of steps taken:

$$ m \gets \beta_1 m + (1 - \beta_1) g, \quad v \gets \beta_2 v + (1 - \beta_2) g^2, \quad
   \theta \gets \theta - \eta\, \frac{m / (1 - \beta_1^n)}{\sqrt{v / (1 - \beta_2^n)} + \epsilon} $$

`sparse_adam` (Numba) and its twin `masked_adam` (JAX) are for the rows of Gaussians, `update_paths` (JAX) for the maps
of shared paths, and `FRAME_TIME_ADAM` (optax) for frame times; tests compare them with the rule in NumPy. Each row
counts its own steps, so that its bias correction is right however seldom the Gaussian is alive.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numba as nb
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.models.frame_times import CUT_RATIO, FrameTimes
from foldgauss.video.models.row_layout import columns, group_bits

#: Decay of the first moment.
BETA1 = 0.9
#: Decay of the second moment.
BETA2 = 0.999
#: As in the published 3DGS.
EPSILON = 1e-15
#: 1 / (1 - beta^n) for both betas, by the number n of steps; beyond the table it is 1 in float32. (Computing the powers
#: for each row took a third of a step's optimizer.)
BIAS_CORRECTIONS = np.ones((20_000, 2), np.float32)
BIAS_CORRECTIONS[1:] = 1 / (1 - np.array([BETA1, BETA2]) ** np.arange(1, len(BIAS_CORRECTIONS))[:, None])
FRAME_TIME_ADAM = optax.scale_by_adam(BETA1, BETA2, EPSILON)

_CHUNK = 2048  # rows per task
_f = nb.float32
_u = nb.uint64


class RateUnits(NamedTuple):
    """The sigma_t and size at which the learning rates of positions, folds and m_t are stated; 0: they are absolute.

    A Gaussian's size is the geometric mean of its two standard deviations. See `config.LearningRates`.
    """

    time: float = 0.0
    size: float = 0.0


ABSOLUTE = RateUnits()


# ----------------------------------------------------------------------------------- rows of Gaussians, Numba


@kernel
def _update(start, stop, touched, rows, grad, first, second, counts, rounded, bits, rates, units, at, corrections):
    beta1, beta2 = _f(BETA1), _f(BETA2)
    own = rates.copy()
    loc, scale, spread, time, fold = at
    width = _u(fold + 2 * ((rows.shape[1] - fold) // 2))  # without the column of paths, which is not trained
    total = 0.0
    for k in range(start, stop):
        i = touched[k]
        counts[i] += 1
        taken = min(counts[i], len(corrections) - 1)
        correction1, correction2 = corrections[taken, 0], corrections[taken, 1]
        row, g, m, v = rows[i], grad[i], first[i], second[i]
        size, short = _f(1.0), _f(1.0)
        if units.size > _f(0.0):
            size = math.exp(_f(0.5) * (row[scale] + row[scale + 1])) / units.size
            own[loc], own[loc + 1] = rates[loc] * size, rates[loc + 1] * size
        if units.time > _f(0.0):
            wide = math.exp(row[spread]) / units.time
            own[time] = rates[time] * wide
            short = _f(1.0) / wide
        power = size
        for c in range(fold, width, 2):
            power *= short
            own[c], own[c + 1] = rates[c] * power, rates[c + 1] * power
        if rounded[i]:
            for c in range(width):
                if rounded[i] & bits[c]:
                    g[c] = _f(0.0)
        for c in range(width):
            gradient = g[c]
            g[c] = _f(0.0)
            m[c] = beta1 * m[c] + (_f(1.0) - beta1) * gradient
            v[c] = beta2 * v[c] + (_f(1.0) - beta2) * gradient * gradient
            row[c] -= own[c] * m[c] * correction1 / (math.sqrt(v[c] * correction2) + _f(EPSILON))
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
    rounded: np.ndarray | None = None,
    units: RateUnits = ABSOLUTE,
) -> bool:
    """One step on the rows `touched`, in place; their gradients are set to zero. Returns whether they are finite.

    `rows`, `grad` and the moments `first`, `second`: float32 (num, width); `counts`: int32 (num,), steps taken by each
    row; `rates`: float32 (width,), learning rates by column. `rounded`, uint8 (num,): bits of the groups of leaves
    (`row_layout.GROUPS`) whose gradients are ignored. `units`: how rates are scaled by each Gaussian's duration and
    size.
    """
    place = columns(0)  # the fold comes last, so its degree does not shift these
    names = ("loc", "log_scale", "log_time_scale", "time_loc_logit", "coefficients")
    at = tuple(place[name].start for name in names)
    num = len(touched)
    units = RateUnits(*np.float32(units))
    rounded = np.zeros(len(rows), np.uint8) if rounded is None else rounded
    bits = group_bits((rows.shape[1] - at[-1]) // 2)
    sums = np.zeros(-(-num // _CHUNK))

    def work(start: int) -> None:
        stop = min(start + _CHUNK, num)
        arrays = touched, rows, grad, first, second, counts, rounded, bits
        sums[start // _CHUNK] = _update(start, stop, *arrays, rates, units, at, BIAS_CORRECTIONS)

    run_tasks(work, range(0, num, _CHUNK))
    return math.isfinite(sums.sum())


# ------------------------------------------------------------------------------------- rows of Gaussians, JAX


def masked_adam(rows, grad, first, second, counts, touched, rates, *, rounded, units: RateUnits):
    """`sparse_adam` in JAX: rows, moments and counts after a step on the rows where `touched`, bool (num,), is true."""
    degree = (rows.shape[1] - columns(0)["coefficients"].start) // 2
    bits = np.zeros(rows.shape[1], np.uint8)
    bits[: columns(degree)["coefficients"].stop] = group_bits(degree)
    grad = jnp.where((rounded[:, None] & bits[None]) > 0, np.float32(0), grad)
    counts = counts + touched.astype(counts.dtype)
    corrections = jnp.asarray(BIAS_CORRECTIONS)[jnp.minimum(counts, len(BIAS_CORRECTIONS) - 1)]
    beta1, beta2, one = np.float32(BETA1), np.float32(BETA2), np.float32(1)
    mean = beta1 * first + (one - beta1) * grad
    square = beta2 * second + (one - beta2) * grad * grad
    own = rates[None, :] * _rate_factors(rows, degree, units)
    moved = rows - own * mean * corrections[:, :1] / (jnp.sqrt(square * corrections[:, 1:]) + np.float32(EPSILON))
    chosen = touched[:, None]
    return jnp.where(chosen, moved, rows), jnp.where(chosen, mean, first), jnp.where(chosen, square, second), counts


def _rate_factors(rows, degree: int, units: RateUnits) -> Float[Array, "num width"]:
    """The factors by which each Gaussian's size and duration scale its learning rates, see `config.LearningRates`."""
    place, (of_size, of_time) = columns(degree), np.zeros((2, rows.shape[1]), np.float32)
    of_size[place["loc"]] = of_size[place["coefficients"]] = 1
    of_time[place["time_loc_logit"]], of_time[place["coefficients"]] = 1, -np.repeat(np.arange(1, degree + 1), 2)
    size = time = jnp.zeros_like(rows[:, 0])  # logarithms
    if units.size > 0:
        size = rows[:, place["log_scale"]].mean(axis=1) - np.float32(math.log(units.size))
    if units.time > 0:
        time = rows[:, place["log_time_scale"].start] - np.float32(math.log(units.time))
    return jnp.exp(size[:, None] * of_size[None] + time[:, None] * of_time[None])


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
