"""Pruning scores: how much squared error it adds to remove or simplify each Gaussian, all others unchanged.

Estimated to second order, in one pass over the frames.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.render import RenderOptions, cpu
from foldgauss.video.models.conditioning import ConditioningSpec, condition
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.splats import SH_C0, TAU_MAX

#: Squared error of rounding to 8 bits.
ROUNDING = 1 / (12 * 255.0**2)
#: Samples of random signs per frame, and in all for short clips. With few, estimates scatter, and Gaussians with an
#: unlucky estimate in one of several rounds are pruned.
SAMPLES, MIN_SAMPLES = 3, 96
#: Ridge on the equations of paths, as a fraction of the trace: a Gaussian seen in few frames leaves some undetermined.
_RIDGE = 1e-6

#: Planes (3, height, width) of frame k, and the background color (3,).
Target = Callable[[int], tuple[Float32[np.ndarray, "3 height width"], Float32[np.ndarray, "3"]]]


@dataclasses.dataclass(frozen=True)
class PruningScores:
    """Sums over all frames, pixels and channels, float64; colors are about [0, 1], lengths in pixels.

    * `errors` (num_frames,): squared error of each frame; `num_samples`: values in all frames; `weights` (num_frames,):
      the weights of the frames in all that follows, 1 on average.
    * `correlation` (3,): of the errors of neighbors in time, along columns and along rows.
    * `first_order` (num,): the change of the squared error by removing a Gaussian, to first order; `second_order`
      (num,): the term of second order, the square of what the Gaussian adds to the frames.
    * `by_path` (num, 2 degree + 1, 3): sum over frames of (u / span)^m M, M the second derivatives (xx, xy, yy) by the
      Gaussian's position, halved; `span` (num,): the unit of u = m_t - t.
    * `by_color` (num,): half the second derivative by any of a Gaussian's `color_dc`; `by_axes` (num, 2): by the
      logarithms of its standard deviations.
    * `by_size` (num, 3): sums of S, S l and S l^2, S the second derivative by the logarithm of the Gaussian's size,
      halved, at its size at its own time, and l = log a(t) / 2; `misses` (num,): frames at which it is not alive.
    """

    errors: Float[np.ndarray, " num_frames"]
    weights: Float[np.ndarray, " num_frames"]
    num_samples: int
    correlation: Float[np.ndarray, "3"]
    first_order: Float[np.ndarray, " num"]
    second_order: Float[np.ndarray, " num"]
    by_path: Float[np.ndarray, "num moments 3"]
    span: Float[np.ndarray, " num"]
    by_color: Float[np.ndarray, " num"]
    by_axes: Float[np.ndarray, "num 2"]
    by_size: Float[np.ndarray, "num 3"]
    misses: Float[np.ndarray, " num"]

    @property
    def squared_error(self) -> float:
        """Of all frames, weighted."""
        return float(self.weights @ self.errors)

    @property
    def psnr(self) -> float:
        """dB, mean over the frames."""
        samples = self.num_samples / len(self.errors)
        return float(np.mean(-10 * np.log10(np.maximum(self.errors / samples, 1e-10))))

    @property
    def effective_samples(self) -> float:
        """The number of values whose error costs bits, beyond those of rounding to 8 bits.

        Errors are coded given their neighbors in time and in the frame, as a first-order autoregression: the innovation
        of each has the variance v = e (1 - r^2) (1 - ..) .., e their mean square. Its bits are log2(1 + (v / q)^2) / 4,
        q the variance of rounding: none where rounding gives equal frames, and log2(v / q) / 2 beyond. So a value
        counts v^2 / (v^2 + q^2), and a static image counts once.
        """
        mean = float(self.errors.sum()) / self.num_samples
        in_time, *in_space = 1 - np.clip(self.correlation, 0, 1) ** 2
        once = mean * float(np.prod(in_space))
        each = once * float(in_time)
        own, first = (v**2 / (v**2 + ROUNDING**2) for v in (each, once))
        frames = len(self.errors)
        return max(self.num_samples * (first + (frames - 1) * own) / frames, 1.0)

    @property
    def added_by_removal(self) -> Float[np.ndarray, " num"]:
        """The squared error that removing a Gaussian adds."""
        return self.first_order + self.second_order

    def lower_degree(
        self, place: Float[np.ndarray, "num degree+1 2"], degree: int, which: np.ndarray
    ) -> tuple[Float[np.ndarray, " some"], Float[np.ndarray, "some degree+1 2"]]:
        """The squared error that a path of lower degree adds for the Gaussians `which`; and the best such path.

        `place`: m_s and c_k in pixels.
        """
        scale = self.span[which][:, None, None] ** np.arange(place.shape[1])[:, None]
        path, moments = place[which] * scale, self.by_path[which]
        low, high = slice(0, degree + 1), slice(degree + 1, place.shape[1])
        lows, highs = np.arange(place.shape[1])[low], np.arange(place.shape[1])[high]
        within, across, above = (
            _normal(moments, rows, others) for rows, others in ((lows, lows), (lows, highs), (highs, highs))
        )
        own = path[:, high].reshape(len(path), -1, 1)
        size = np.trace(within, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
        target = across @ own
        moved = np.linalg.solve(within + _RIDGE * size * np.eye(within.shape[1]), target)
        added = (own * (above @ own)).sum((1, 2)) - (target * moved).sum((1, 2))
        path[:, low] += moved.reshape(len(path), -1, 2)
        path[:, high] = 0
        return np.maximum(added, 0), path / scale

    def added_by_static(self, log_growth: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
        """The squared error that making a Gaussian static adds, where its log size changes by `log_growth`.

        Lowest for `mean_log_envelope`. Infinite where the Gaussian is not alive at every frame: what it would hide
        there is not known.
        """
        total, first, second = self.by_size.T
        added = second - 2 * log_growth * first + log_growth**2 * total
        return np.where(self.misses > 0, np.inf, np.maximum(added, 0))

    def added_by_opaque(self, opacity: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
        """The squared error that making Gaussians of this `opacity` opaque adds.

        Frames are linear in one opacity, so this is exact for each alone.
        """
        more = 1 / np.maximum(opacity, np.finfo(float).tiny) - 1
        return np.maximum(more * (more * self.second_order - self.first_order), 0)

    @property
    def mean_log_envelope(self) -> Float[np.ndarray, " num"]:
        """The mean of log a(t) / 2 where it is visible: the best change of the log size of a Gaussian made static."""
        total, first, _ = self.by_size.T
        return first / np.maximum(total, np.finfo(float).tiny)


def _normal(moments: np.ndarray, rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Blocks (2, 2) of second derivatives by coefficients `rows` and `others`, as one matrix per Gaussian."""
    xx, xy, yy = np.moveaxis(moments[:, rows[:, None] + others], -1, 0)
    blocks = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    return blocks.transpose(0, 1, 3, 2, 4).reshape(len(moments), 2 * len(rows), 2 * len(others))


def measure_scores(
    rows: Float32[np.ndarray, "num width"],
    window: Float32[np.ndarray, "num 2"],
    times: Float[np.ndarray, " num_frames"],
    shape: ConditioningSpec,
    target: Target,
    *,
    compositing: str,
    options: RenderOptions,
    weights: Float[np.ndarray, " num_frames"] | None = None,
    seed: int = 0,
) -> PruningScores:
    """The scores of packed rows against frames with `weights`; None: all 1.

    Squares of the frames' derivatives are estimated without bias by random signs, as in `compression.sensitivity`.
    """
    num, place, rng = len(rows), columns(shape.degree), make_generator(Stream.PRUNING_PROBE, seed=seed)
    center = 1 / (1 + np.exp(-rows[:, place["time_loc_logit"]][:, 0].astype(float)))
    spread = np.exp(rows[:, place["log_time_scale"]][:, 0].astype(float))
    span = np.minimum(TAU_MAX * spread, 1.0)
    first_order, second_order, misses, by_color = np.zeros((4, num))
    by_path, by_size, by_axes = np.zeros((num, 2 * shape.degree + 1, 3)), np.zeros((num, 3)), np.zeros((num, 2))
    weights = np.ones(len(times)) if weights is None else weights
    samples = max(SAMPLES, -(-MIN_SAMPLES // len(times)))
    errors, products, before = np.zeros(len(times)), np.zeros(3), None
    signs_shape = (3, *shape.size)
    for k, t in enumerate(times):
        wanted, background = target(k)
        done = condition(rows, window, t, shape)
        alive = done.alive
        misses += 1
        misses[alive] -= 1
        leaves = done.mean, done.factor, done.opacity, done.color, background
        trace = cpu.forward(*leaves, shape.size, compositing=compositing, options=options)
        residual = trace.image - wanted
        errors[k] = np.vdot(residual, residual)
        products += _products(residual, before)
        before = residual
        if not len(alive):
            continue
        first_order[alive] -= 2 * weights[k] * done.opacity * cpu.backward(trace, residual)[2]
        u = center[alive] - t
        powers = (u / span[alive])[:, None] ** np.arange(2 * shape.degree + 1)
        narrowed = _log_envelope(u / spread[alive], shape) / 2
        # The second derivative by the log size is proportional to the squared size that the Gaussian would have.
        by_narrowed = np.exp(-2 * narrowed)[:, None] * np.stack([np.ones_like(narrowed), narrowed, narrowed**2], 1)
        weight = weights[k] / samples
        for _ in range(samples):
            signs = rng.integers(0, 2, signs_shape, dtype=np.int8) * np.float32(2) - np.float32(1)
            d_mean, d_factor, d_opacity, d_color = cpu.backward(trace, signs)
            second_order[alive] += weight * (done.opacity * d_opacity).astype(float) ** 2
            by_path[alive] += weight * powers[:, :, None] * _outer(d_mean.astype(float))[:, None]
            by_scale = (done.factor * d_factor).sum(1).astype(float)  # by the logarithms
            by_size[alive] += weight * by_narrowed * by_scale.sum(1, keepdims=True) ** 2
            by_axes[alive] += weight * by_scale**2
            by_color[alive] += weight * SH_C0**2 * (d_color.astype(float) ** 2).mean(1)
    num_samples = len(times) * 3 * math.prod(shape.size)
    lines = np.array([len(times), *shape.size])
    correlation = products * lines / np.maximum(lines - 1, 1) / max(errors.sum(), np.finfo(float).tiny)
    of_frames = errors, weights, num_samples, correlation
    orders = first_order, second_order
    return PruningScores(*of_frames, *orders, by_path, span, by_color, by_axes, by_size, misses)


def _products(residual: np.ndarray, before: np.ndarray | None) -> list[float]:
    """Sums of products of errors with those one frame, one row and one column before."""
    in_time = 0.0 if before is None else float(np.vdot(residual, before))
    down = float(np.einsum("chw,chw->", residual[:, 1:], residual[:, :-1]))
    along = float(np.einsum("chw,chw->", residual[:, :, 1:], residual[:, :, :-1]))
    return [in_time, down, along]


def _log_envelope(tau: np.ndarray, shape: ConditioningSpec) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.logaddexp(np.log(shape.floor), np.log1p(-shape.floor) - 0.5 * shape.power * tau**2)


def _outer(vectors: Float[np.ndarray, "num 2"]) -> Float[np.ndarray, "num 3"]:
    """v v^T as (xx, xy, yy), half of it made isotropic: a mean over few frames would leave a direction undetermined."""
    x, y = vectors.T
    round_part = 0.25 * (x * x + y * y)
    return np.stack([0.5 * x * x + round_part, 0.5 * x * y, 0.5 * y * y + round_part], 1)
