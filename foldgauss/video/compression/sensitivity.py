"""Sensitivity of the rendered images to each parameter of a model, and to the removal of each Gaussian."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Float32

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.render import cpu
from foldgauss.video.compression.quantize import AXES, ExactColumns, trajectory_matrix
from foldgauss.video.models.conditioning import backpropagate
from foldgauss.video.models.row_layout import columns
from foldgauss.video.selection.contributions import Contributions, FrameContributions

#: Levels of an 8-bit image.
LEVELS = 255.0
#: An opaque Gaussian is assumed to differ from what it hides by this fraction of the range.
CONTRAST = 0.1
#: Opacities above this count as opaque: the renderer does not see what is behind.
OPAQUE = 0.97


def estimate_sensitivities(
    contributions: Contributions, exact: ExactColumns
) -> tuple[dict[str, Float[np.ndarray, " num"]], Bool[np.ndarray, " num"]]:
    """Squared change of the images per squared change of each parameter, and which Gaussians any frame shows.

    The change is in levels, summed over pixels, channels and frames: the diagonal of J^T J with J the derivative of all
    images with respect to the columns `exact`. It is estimated without bias by (J^T z)^2, with random signs z in every
    pixel and one draw per frame. Source: M. F. Hutchinson (1990), "A stochastic estimator of the trace".
    """
    num, prepared, to_columns = contributions.num_gaussians, contributions.prepared, _ColumnGradients(exact)
    total: dict[str, np.ndarray] = {name: np.zeros(num) for name in to_columns.names}
    seen, rows = np.zeros(num, bool), np.zeros((num, 11 + 2 * exact.info.degree), np.float32)
    for frame, gradients in _draw_gradients(contributions):
        backpropagate(prepared.rows, frame.splats, gradients, prepared.spec, rows)
        for name, gradient in to_columns(rows[frame.alive].astype(np.float64), frame.alive).items():
            total[name][frame.alive] += gradient**2
        rows[frame.alive] = 0
        seen[frame.alive] |= (gradients[3] != 0).any(1)  # also black ones, whose color cannot be darker
    return total, seen


def estimate_removal(contributions: Contributions) -> Float[np.ndarray, " num"]:
    """Squared change of the images, as of `estimate_sensitivities`, if each Gaussian alone were removed.

    Images are linear in the opacity of one Gaussian at the frame's time. What an opaque one hides is not known: those
    change them by at least `CONTRAST`.
    """
    removal, least = np.zeros((2, contributions.num_gaussians))
    for frame, (_, _, by_opacity, by_color) in _draw_gradients(contributions):
        opacity = frame.splats.opacity.astype(np.float64)
        removal[frame.alive] += (opacity * by_opacity) ** 2
        least[frame.alive] += np.where(opacity > OPAQUE, (CONTRAST * (by_color @ AXES[0])) ** 2, 0)
    return np.maximum(removal, least)


def _draw_gradients(
    contributions: Contributions,
) -> Iterator[tuple[FrameContributions, tuple[Float32[np.ndarray, "alive ..."], ...]]]:
    """Each frame that shows Gaussians, and J^T z by mean, factor, opacity and color."""
    rng, shape = make_generator(Stream.SENSITIVITY_PROBE), (3, *contributions.size)
    for k in range(len(contributions.times)):
        frame = contributions.at_frame(k)
        if len(frame.alive):
            signs = rng.integers(0, 2, shape, dtype=np.int8) * np.float32(2 * LEVELS) - np.float32(LEVELS)
            yield frame, cpu.backward(frame.trace, signs)


class _ColumnGradients:
    """Converts gradients with respect to packed rows to gradients with respect to columns."""

    def __init__(self, exact: ExactColumns):
        v, info = exact.values, exact.info
        self._exact, self._at = exact, columns(info.degree)
        self._matrix = trajectory_matrix(v["time"], v["duration"], info)
        self._flip = np.where(exact.swapped, -1.0, 1.0)
        k = np.arange(1, info.degree + 1)[:, None]
        # A later m_t with the same curve in time, see `shift_path`.
        self._by_time = np.concatenate([k * exact.polynomials[:, 1:], np.zeros((len(self._flip), 1, 2))], 1)
        trajectory = [f"{axis}{j}" for j in range(info.degree + 1) for axis in "xy"]
        self.names = ["size", "stretch", "duration", "opacity", "time", "angle", "luma", "blue", "green", *trajectory]

    def __call__(self, rows: Float[np.ndarray, "alive width"], alive: np.ndarray) -> dict[str, np.ndarray]:
        at, v = self._at, self._exact.values
        scale = rows[:, at["log_scale"]]
        polynomials = np.concatenate([rows[:, at["loc"]], rows[:, at["coefficients"]]], 1).reshape(len(rows), -1, 2)
        time, turn = v["time"][alive], self._exact.turn[alive]
        by_time = rows[:, at["time_loc_logit"].start] / np.maximum(time * (1 - time), 1e-12)
        made = {
            "size": scale[:, 0] + scale[:, 1],
            "stretch": (scale[:, 0] - scale[:, 1]) * self._flip[alive],
            "duration": rows[:, at["log_time_scale"].start],
            "opacity": rows[:, at["opacity_logit"].start],
            "time": by_time - (polynomials * self._by_time[alive]).sum((1, 2)),
            "angle": rows[:, at["angle_logit"].start] / np.maximum(turn * (1 - turn), 1e-12),
        }
        made |= dict(zip(("luma", "blue", "green"), AXES @ rows[:, at["color_dc"]].T, strict=True))
        by_power = np.einsum("njk,nja->nka", self._matrix[alive], polynomials)
        return made | {f"{axis}{k}": by_power[:, k, a] for k in range(by_power.shape[1]) for a, axis in enumerate("xy")}
