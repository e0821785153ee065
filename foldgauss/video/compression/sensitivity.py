"""What a change of each number of a model does to its pictures."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from foldgauss.render import cpu
from foldgauss.video.compression.quantize import AXES, Described, path_matrix
from foldgauss.video.models.conditioning import backpropagate
from foldgauss.video.models.row_layout import columns
from foldgauss.video.selection.contributions import Contributions

_SEED = 0
#: Levels of an 8-bit picture.
LEVELS = 255.0


def sensitivities(
    lit: Contributions, described: Described, on_frame: Callable[[], None] = lambda: None
) -> tuple[dict[str, Float[np.ndarray, " num"]], Float[np.ndarray, " num"]]:
    """Squared change of the pictures, in levels, summed over pixels, channels and frames, by the square of each number.

    That is the diagonal of J^T J with J the derivative of all pictures by the columns of `described`; and what each
    Gaussian adds in its best frame, in pixels. Estimated without bias by (J^T z)^2 with random signs z in every pixel,
    one draw a frame. Source: M. F. Hutchinson (1990), "A stochastic estimator of the trace".
    """
    rng, shape = np.random.default_rng(_SEED), (3, *lit.size)
    degree, num = described.facts.degree, lit.num_gaussians
    to_columns = _Columns(described)
    total: dict[str, np.ndarray] = {name: np.zeros(num) for name in to_columns.names}
    best = np.zeros(num)
    for k in range(len(lit.times)):
        light = lit.at_frame(k)
        if len(light.alive):
            signs = rng.integers(0, 2, shape, dtype=np.int8) * np.float32(2 * LEVELS) - np.float32(LEVELS)
            rows = np.zeros((num, 11 + 2 * degree), np.float32)
            stage = lit.prepared
            backpropagate(stage.rows, light.splats, cpu.backward(light.trace, signs)[:4], stage.spec, rows)
            for name, gradient in to_columns(rows[light.alive].astype(np.float64), light.alive).items():
                total[name][light.alive] += gradient**2
            best[light.alive] = np.maximum(best[light.alive], light.total)
        on_frame()
    return total, best


class _Columns:
    """Gradients of a model's rows to those of its columns."""

    def __init__(self, described: Described):
        v, facts = described.values, described.facts
        self._described, self._at = described, columns(facts.degree)
        self._matrix = path_matrix(v["time"], v["duration"], facts)
        self._flip = np.where(described.swapped, -1.0, 1.0)
        k = np.arange(1, facts.degree + 1)[:, None]
        # A later m_t with the same path in time: see `shift_path`.
        self._by_time = np.concatenate([k * described.place[:, 1:], np.zeros((len(self._flip), 1, 2))], 1)
        path = [f"{axis}{j}" for j in range(facts.degree + 1) for axis in "xy"]
        self.names = ["size", "stretch", "duration", "opacity", "time", "angle", "luma", "blue", "green", *path]

    def __call__(self, rows: Float[np.ndarray, "alive width"], alive: np.ndarray) -> dict[str, np.ndarray]:
        at, v = self._at, self._described.values
        scale = rows[:, at["log_scale"]]
        place = np.concatenate([rows[:, at["loc"]], rows[:, at["coefficients"]]], 1).reshape(len(rows), -1, 2)
        time, turn = v["time"][alive], self._described.turn[alive]
        by_time = rows[:, at["time_loc_logit"].start] / np.maximum(time * (1 - time), 1e-12)
        made = {
            "size": scale[:, 0] + scale[:, 1],
            "stretch": (scale[:, 0] - scale[:, 1]) * self._flip[alive],
            "duration": rows[:, at["log_time_scale"].start],
            "opacity": rows[:, at["opacity_logit"].start],
            "time": by_time - (place * self._by_time[alive]).sum((1, 2)),
            "angle": rows[:, at["angle_logit"].start] / np.maximum(turn * (1 - turn), 1e-12),
        }
        made |= dict(zip(("luma", "blue", "green"), AXES @ rows[:, at["color_dc"]].T, strict=True))
        path = np.einsum("njk,nja->nka", self._matrix[alive], place)
        return made | {f"{axis}{k}": path[:, k, a] for k in range(path.shape[1]) for a, axis in enumerate("xy")}
