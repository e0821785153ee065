"""The sparse matrix A of compositing weights: image = A colors + transmittance x background."""

import math

import numba as nb
import numpy as np
import scipy.sparse

from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import _cpu_kernels as kernels
from foldgauss.render.cpu import TILE, Trace

_f = nb.float32
_i = nb.int64
_LN2 = math.log(2)
#: Columns of the geometry, passed as an argument: see `kernel`.
_COLUMNS = (kernels._X, kernels._Y, kernels._P, kernels._Q, kernels._R, kernels._LOG, kernels._LEAST)


def build_weight_matrix(trace: Trace) -> scipy.sparse.csr_array:
    r"""The weight of each splat at each pixel, alpha times transmittance: (height * width, num), float32.

    $$ A_{pi} = \alpha_i(p) \prod_{j < i} (1 - \alpha_j(p)) $$

    Rows are pixels in reading order; within a row splats are in array order, front to back. With compositing "sum" the
    product is 1. Cutoff, ceiling and stop are those of the trace, so that `A @ color + transmittance * background` is
    its image up to rounding, which may decide whether a weight at the cutoff is kept.

    **Example:** `build_weight_matrix(cpu.forward(mean, factor, opacity, color, background, size))`.

    **Source:** Kerbl et al. 2023, 3D Gaussian Splatting, eq. 3, which is linear in the colors.
    """
    size = trace.transmittance.shape
    num_pixels = size[0] * size[1]
    row_start, entries = trace.buckets[:2]

    def walk(part: int, *outputs) -> None:
        begin, _ = trace.parts[part]
        lists = begin, entries[row_start[begin] :], *trace.lists[part][:3]
        _walk(_COLUMNS, TILE, *size, *lists, trace.geometry, *trace.constants[1:], *outputs)

    parts = range(len(trace.parts))
    indptr = np.zeros(num_pixels + 1, np.int64)
    run_tasks(lambda part: walk(part, indptr[1:], None, None), parts)
    np.cumsum(indptr, out=indptr)
    indices, values = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32)
    run_tasks(lambda part: walk(part, indptr, indices, values), parts)
    if indptr[-1] < np.iinfo(np.int32).max:  # SciPy's own choice: products of mixed index widths are copied first
        indptr = indptr.astype(np.int32)
    matrix = scipy.sparse.csr_array((values, indices, indptr), shape=(num_pixels, len(trace.geometry)))
    matrix.has_sorted_indices = True
    return matrix


@kernel
def _walk(
    columns,
    tile,
    height,
    width,
    begin,
    entries,
    tile_start,
    listed,
    used,
    geometry,
    over,
    ceiling,
    stop,
    at,
    indices,
    values,
):
    """Composite front to back the splats of every pixel of the rows of tiles from `begin` on.

    Without `indices`, the number of weights of each pixel is written to `at`; with it, the weights, from at[pixel] on.
    """
    x_, y_, p_, q_, r_, log_, least_ = columns
    across = (width + tile - 1) // tile
    most = 0
    for n in range(len(used)):
        most = max(most, used[n] - tile_start[n])
    which, on_row = np.empty(most, np.int32), np.empty((most, 4), np.float32)
    for n in range(len(used)):
        top, left = (begin + n // across) * tile, n % across * tile
        for y in range(top, min(top + tile, height)):
            num = 0  # splats of the tile that reach this row of pixels: few
            for k in range(tile_start[n], used[n]):
                one = geometry[entries[listed[k]]]
                dy = _f(y) + _f(0.5) - one[y_]
                bound = one[log_] - one[r_] * dy * one[r_] * dy
                if bound >= one[least_]:
                    which[num] = entries[listed[k]]
                    on_row[num] = one[p_], one[q_] * dy + one[p_] * (_f(left) + _f(0.5) - one[x_]), bound, one[least_]
                    num += 1
            for x in range(left, min(left + tile, width)):
                pixel, transmittance, found = y * width + x, _f(1), _i(0)
                for k in range(num):
                    sheared = on_row[k, 0] * _f(x - left) + on_row[k, 1]
                    power = on_row[k, 2] - sheared * sheared
                    if power < on_row[k, 3]:
                        continue
                    if not transmittance > stop:
                        break
                    weight = min(math.exp(_f(_LN2) * power), ceiling) * transmittance
                    if indices is not None:
                        indices[at[pixel] + found] = which[k]
                        values[at[pixel] + found] = weight
                    found += 1
                    if over:
                        transmittance -= weight
                if indices is None:
                    at[pixel] = found
