"""Adam on the rows that took part in a step, and on no others (Kingma and Ba 2015).

Each row counts its own steps, so that its bias correction is right however seldom it is alive.
"""

import math

import numba as nb
import numpy as np

from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.sparse_storage import DEGREE_MASK, OPAQUE_BIT, STATIC_BIT

CHUNK = 2048  # rows per task
#: The unit of time of Gaussians that last, whose sigma_t says nothing: the standard deviation of all times of a clip.
LASTING_TIME = 0.29
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15  # epsilon as in the published 3DGS

_f, _u = nb.float32, nb.uint64

#: 1 / (1 - beta^n) for both betas, by the number n of steps; beyond the table it is 1 in float32. (Powers taken anew
#: for each row were a third of a step's optimiser.)
UNBIAS = np.ones((20_000, 2), np.float32)
UNBIAS[1:] = 1 / (1 - np.array([BETA1, BETA2]) ** np.arange(1, len(UNBIAS))[:, None])


@kernel
def _update(start, stop, touched, rows, grad, first, second, counts, kinds, bits, rates, unit, at, unbias):
    beta1, beta2 = _f(BETA1), _f(BETA2)
    width, own = _u(rows.shape[1]), rates.copy()
    spread, time, opacity, fold = at
    lasting, solid, degrees = bits
    for k in range(start, stop):
        i = touched[k]
        counts[i] += 1
        taken = min(counts[i], len(unbias) - 1)
        unbias1, unbias2 = unbias[taken, 0], unbias[taken, 1]
        row, g, m, v = rows[i], grad[i], first[i], second[i]
        is_static, powers = kinds[i] & lasting, kinds[i] & degrees
        if is_static:  # its times stay
            g[time], g[spread] = _f(0.0), _f(0.0)
        if kinds[i] & solid:
            g[opacity] = _f(0.0)
        for c in range(fold + 2 * powers, width):
            g[c] = _f(0.0)
        if unit > _f(0.0):
            wide = (_f(LASTING_TIME) if is_static else math.exp(row[spread])) / unit
            own[time] = rates[time] * wide
            short, power = _f(1.0) / wide, _f(1.0)
            for c in range(fold, width, 2):
                power *= short
                own[c], own[c + 1] = rates[c] * power, rates[c + 1] * power
        for c in range(width):
            gradient = g[c]
            g[c] = _f(0.0)
            m[c] = beta1 * m[c] + (_f(1.0) - beta1) * gradient
            v[c] = beta2 * v[c] + (_f(1.0) - beta2) * gradient * gradient
            row[c] -= own[c] * m[c] * unbias1 / (math.sqrt(v[c] * unbias2) + _f(EPSILON))


def sparse_adam(
    rows: np.ndarray,
    grad: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    counts: np.ndarray,
    touched: np.ndarray,
    rates: np.ndarray,
    *,
    kinds: np.ndarray | None = None,
    unit_time: float = 0.0,
) -> None:
    """One step on rows `touched`, in place; their gradients are set back to zero.

    `rows`, `grad` and the moments `first`, `second`: float32 (num, width); `counts`: int32 (num,), steps each row
    has taken; `rates`: float32 (width,), learning rates by column. `kinds` uint8 (num,): which columns a row has, by
    `sparse_storage.find_kinds` (default: all); the others stay. With `unit_time` > 0 the rates of m_t and of the
    fold are those at sigma_t = `unit_time`, and others' as `config.LearningRates` says.
    """
    place = columns(0)  # the fold comes last, so its degree moves none of these
    at = tuple(place[name].start for name in ("log_time_scale", "time_loc_logit", "opacity_logit", "coefficients"))
    num = len(touched)
    if kinds is None:
        kinds = np.full(len(rows), (rows.shape[1] - at[-1]) // 2, np.uint8)

    def work(start: int) -> None:
        _update(
            start,
            min(start + CHUNK, num),
            touched,
            rows,
            grad,
            first,
            second,
            counts,
            kinds,
            (STATIC_BIT, OPAQUE_BIT, DEGREE_MASK),
            rates,
            np.float32(unit_time),
            at,
            UNBIAS,
        )

    run_tasks(work, range(0, num, CHUNK))
