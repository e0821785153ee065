"""Adam on the rows that took part in a step, and on no others (Kingma and Ba 2015).

Each row counts its own steps, so that its bias correction is right however seldom it is alive.
"""

import math

import numba as nb
import numpy as np

from foldgauss._kernels import kernel
from foldgauss._threads import run_tasks

CHUNK = 2048  # rows per task
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15  # epsilon as in the published 3DGS

_f, _u = nb.float32, nb.uint64


@kernel
def _update(start, stop, touched, rows, grad, first, second, counts, rates):
    beta1, beta2 = _f(BETA1), _f(BETA2)
    width = _u(rows.shape[1])
    for k in range(start, stop):
        i = touched[k]
        counts[i] += 1
        unbias1 = _f(1.0) / (_f(1.0) - beta1 ** _f(counts[i]))
        unbias2 = _f(1.0) / (_f(1.0) - beta2 ** _f(counts[i]))
        row, g, m, v = rows[i], grad[i], first[i], second[i]
        for c in range(width):
            gradient = g[c]
            g[c] = _f(0.0)
            m[c] = beta1 * m[c] + (_f(1.0) - beta1) * gradient
            v[c] = beta2 * v[c] + (_f(1.0) - beta2) * gradient * gradient
            row[c] -= rates[c] * m[c] * unbias1 / (math.sqrt(v[c] * unbias2) + _f(EPSILON))


def sparse_adam(
    rows: np.ndarray,
    grad: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    counts: np.ndarray,
    touched: np.ndarray,
    rates: np.ndarray,
) -> None:
    """One step on rows `touched`, in place; their gradients are set back to zero.

    `rows`, `grad` and the moments `first`, `second`: float32 (num, width); `counts`: int32 (num,), steps each row
    has taken; `rates`: float32 (width,), learning rates by column.
    """
    num = len(touched)

    def work(start: int) -> None:
        _update(start, min(start + CHUNK, num), touched, rows, grad, first, second, counts, rates)

    run_tasks(work, range(0, num, CHUNK))
