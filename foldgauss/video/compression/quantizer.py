"""Steps of quantization from the sensitivity of the images, and what each Gaussian is worth.

For a given number of bits, the squared error is least where every parameter adds the same (theory of rate and
distortion). The step of each parameter therefore follows from the sensitivity of the images to it
(`estimate_sensitivities`). A common factor, 2^coarseness, scales all steps and sets the price of a bit (`bit_price`). A
Gaussian is dropped if its removal adds less error than its bits cost.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._numerics.regression import shift_polynomial
from foldgauss._runtime.checks import require
from foldgauss.render import cpu
from foldgauss.video.compression.quantize import (
    AXES,
    FEATURES,
    ExactColumns,
    Quantized,
    Rule,
    clamp_unit,
    column_names,
    compute_columns,
    decode_values,
    dequantize,
    is_integral,
    quantize,
    trajectory_matrix,
)
from foldgauss.video.models.conditioning import backpropagate
from foldgauss.video.models.row_layout import GROUPS, columns
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.selection.contributions import Contributions, FrameContributions

#: The bits whose price a Gaussian has to be worth: about as many as it takes in a file.
BITS_PER_GAUSSIAN = 100.0
#: The background of clips without alpha.
BLACK = np.zeros(3, np.float32)
#: The background by which Gaussians of clips with alpha are judged: one that no color equals, since they may be shown
#: over any.
BEYOND_BLACK = np.full(3, -0.5, np.float32)
#: Least number of Gaussians from which steps are regressed on features.
_FEW = 100
#: By how much the binary logarithm of a step may be too large for a Gaussian: the finest step that one needs otherwise
#: determines the steps of all.
_TOO_COARSE = 1.5
_MIN_SENSITIVITY = 1e-4  # below, a Gaussian is not visible
#: Levels of an 8-bit image.
LEVELS = 255.0
#: An opaque Gaussian is assumed to differ from what it hides by this fraction of the range.
CONTRAST = 0.1
#: Opacities above this count as opaque: the renderer does not see what is behind.
OPAQUE = 0.97


def bit_price(coarseness: float) -> float:
    """The squared error, in levels of 8 bits summed over the clip, that a bit is worth at such steps.

    A step s adds s^2 / 12, and half of it takes one bit more: the price is -d(s^2 / 12) / d(bits).
    """
    return math.log(2) / 6 * 4.0**coarseness


class Worth:
    """What each Gaussian adds to the images, beside the price of its bits."""

    def __init__(self, model: VideoModel, background: Float32[np.ndarray, "3"] = BLACK):
        """`background` is what images are composited over: what equals it seems to be worth nothing."""
        self.removal = estimate_removal(Contributions(model, background))

    def are_worth(self, coarseness: float, fraction: float = 1.0) -> Bool[np.ndarray, " num"]:
        """The Gaussians that are worth this `fraction` of the price of their bits at such steps; at least one."""
        kept = self.removal > fraction * BITS_PER_GAUSSIAN * bit_price(coarseness)
        kept[np.argmax(self.removal)] = True
        return kept

    def coarseness_for(self, num: float, fraction: float = 1.0) -> float:
        """The coarseness at which about `num` Gaussians are worth this fraction of the price of their bits; -inf for
        all."""
        if num >= len(self.removal):
            return -math.inf
        place = max(round(num), 1)
        least = max(float(np.sort(self.removal)[-place]), _MIN_SENSITIVITY)
        return 0.5 * math.log2(least / (fraction * BITS_PER_GAUSSIAN * bit_price(0.0)))


class Quantizer:
    """Quantizes a model by rules that are fixed but for the coarseness."""

    def __init__(self, model: VideoModel, background: Float32[np.ndarray, "3"] = BLACK):
        """`background` is what images are composited over: they do not tell what equals it from nothing."""
        self.exact = compute_columns(model)
        sensitivity, self._seen = estimate_sensitivities(Contributions(model, background), self.exact)
        self._names = [name for name in column_names(self.exact.info.degree) if not is_integral(name)]
        require(self._seen.any(), "model", expected="visible Gaussians", got="none", cure="No frame shows anything.")
        self._fit(sensitivity)

    def _fit(self, sensitivity: dict[str, Float[np.ndarray, " num"]]) -> None:
        """Regress log-sensitivities on the features; a Gaussian's class is the mean residual of its columns."""
        first = FEATURES[1:]
        raw = np.stack([self.exact.values[name] for name in first], 1)
        # Outliers are clipped: a line through the bulk would extrapolate their steps without bound.
        features = np.clip(raw, *np.quantile(raw[self._seen], [0.001, 0.999], axis=0))
        levels = {name: 0.5 * np.log2(np.maximum(sensitivity[name], _MIN_SENSITIVITY)) for name in self._names}
        design, whole = (np.concatenate([np.ones((len(one), 1)), one], 1) for one in (features, raw))
        self._fits, rest = {}, []
        for name in self._names:
            fit = np.zeros(design.shape[1])
            # Others, as in black frames, would tilt the lines.
            shows = self._seen & (sensitivity[name] > _MIN_SENSITIVITY)
            if name in first or shows.sum() < _FEW:
                fit[0] = levels[name][self._seen].mean()
            else:
                fit = np.linalg.lstsq(design[shows], levels[name][shows], rcond=None)[0]
            self._fits[name] = fit
            rest.append(levels[name] - whole @ fit)
        # Of usual Gaussians at most 6. Beyond, the class makes up for the line where a Gaussian is unlike the others.
        most = np.where(np.all(raw == features, axis=1), 6, 60)
        classes = np.maximum(np.clip(rest, -most, most).mean(0), np.max(rest, 0) - _TOO_COARSE)
        self.classes = np.rint(np.where(self._seen, classes, -6.0)).astype(np.int32)
        # All columns are to add the same error: by mean, not typical, sensitivity times step^2.
        for name, fit in self._fits.items():
            predicted = np.clip((whole @ fit + self.classes)[self._seen], -30, 30)
            fit[0] += 0.5 * np.log2(np.mean(sensitivity[name][self._seen] * 4.0**-predicted) + 1e-30)

    def make_rules(self, coarseness: float) -> dict[str, Rule]:
        """The rules with steps times 2^coarseness.

        A parameter's squared error, summed over the clip, is about 4^coarseness / 12, in levels of 8 bits.
        """
        rules = {}
        for name in self._names:
            exponent, *slopes = np.round(self._fits[name], 4).tolist()
            given = self.exact.values.get(name)
            # Stretch is not negative: its origin is 0.
            origin = 0.0 if given is None or name == "stretch" else round(float(np.median(given)), 4)
            slopes = (-1.0,) if name in FEATURES else (-1.0, *(-slope for slope in slopes))
            rules[name] = Rule(origin, round(coarseness - exponent, 4), slopes)
        return rules

    def quantize(self, coarseness: float, chunks: Int[np.ndarray, " num"] | None = None) -> Quantized:
        """The model with the rules of `make_rules`, in these chunks (None: a single one)."""
        return quantize(self.exact, self.classes, self.make_rules(coarseness), chunks)


def round_groups(
    model: VideoModel,
    classes: Int32[np.ndarray, " num"],
    rules: dict[str, Rule],
    rounded: UInt8[np.ndarray, " num"],
) -> FoldedSplats:
    """The splats with the groups of leaves that the bits of `rounded` mark (`GROUPS`) rounded by the rules.

    Values that are rounded already stay as they are. Trajectories that are not rounded yet stay the same curves in time
    where m_t is.
    """
    exact = compute_columns(model)
    quantized = quantize(exact, classes, rules)
    decoded, v = dequantize(quantized).splats, exact.values
    is_rounded = {name: (rounded & bit) > 0 for group, bit in GROUPS.items() for name in group}
    time = clamp_unit(np.where(is_rounded["time_loc_logit"], decode_values(quantized)["time"], v["time"]))
    polynomials = np.stack(shift_polynomial(exact.polynomials, v["time"] - time), 1)
    leaves = {"loc": polynomials[:, 0], "coefficients": polynomials[:, 1:]}
    for name, which in is_rounded.items():
        own = leaves.get(name, np.asarray(getattr(model.splats, name)))
        leaves[name] = np.float32(np.where(which.reshape(-1, *[1] * (own.ndim - 1)), getattr(decoded, name), own))
    return dataclasses.replace(model.splats, **leaves)


# ------------------------------------------------------------------------------------------------ sensitivity


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
        # A later m_t with the same curve in time, see `shift_polynomial`.
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
