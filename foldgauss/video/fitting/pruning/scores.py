"""What each Gaussian, each power of its path and its end in time do to the pictures, in squared error.

One pass over the frames. To second order: the change of the squared error when a part is left out, all else staying.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32

from foldgauss.render import RenderOptions, cpu
from foldgauss.video.models.conditioning import ConditioningSpec, condition
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.splats import SH_C0, TAU_MAX

#: Squared error of rounding to 8 bits.
ROUNDING = 1 / (12 * 255.0**2)
#: Draws of random signs: so many a frame, and in all for short clips. With few, estimates scatter, and what is unlucky
#: in one of several rounds is dropped.
DRAWS, LEAST_DRAWS = 3, 96
#: Of the trace, on the diagonal of the paths' equations: a Gaussian seen in few frames leaves some of them open.
_RIDGE = 1e-6

#: Planes (3, height, width) of frame k, and the colour (3,) behind it.
Target = Callable[[int], tuple[Float32[np.ndarray, "3 height width"], Float32[np.ndarray, "3"]]]


@dataclasses.dataclass(frozen=True)
class PruningScores:
    """Sums over all frames, pixels and channels; colours are about [0, 1], lengths pixels, float64.

    * `errors` (num_frames,): squared error of each frame; `num_samples`: numbers that the pictures have; `weights`
      (num_frames,): how much a frame's errors count in all that follows, 1 on the average.
    * `alike` (3,): correlation of the errors of neighbours in time, along columns and along rows.
    * `slope` (num,): its change by leaving a Gaussian out, to first order; `own` (num,): to second, which is what the
      Gaussian adds to the pictures, squared.
    * `by_path` (num, 2 degree + 1, 3): sum over frames of (u / span)^m M, M the second derivatives (xx, xy, yy) by the
      Gaussian's place, halved; `span` (num,): a length of time to measure u = m_t - t by.
    * `by_color` (num,): half the second derivative by any of a Gaussian's `color_dc`; `by_axes` (num, 2): by the
      logarithms of its standard deviations.
    * `by_size` (num, 3): sums of S, S l and S l^2, S the second derivative by the logarithm of the Gaussian's size,
      halved, at its size at its own time, and l = log a(t) / 2; `misses` (num,): frames at which it is not alive.
    """

    errors: Float[np.ndarray, " num_frames"]
    weights: Float[np.ndarray, " num_frames"]
    num_samples: int
    size: tuple[int, int]
    alike: Float[np.ndarray, "3"]
    slope: Float[np.ndarray, " num"]
    own: Float[np.ndarray, " num"]
    by_path: Float[np.ndarray, "num moments 3"]
    span: Float[np.ndarray, " num"]
    by_color: Float[np.ndarray, " num"]
    by_axes: Float[np.ndarray, "num 2"]
    by_size: Float[np.ndarray, "num 3"]
    misses: Float[np.ndarray, " num"]

    @property
    def squared_error(self) -> float:
        """Weighted by frames."""
        return float(self.weights @ self.errors)

    @property
    def psnr(self) -> float:
        """dB, mean over the frames."""
        samples = self.num_samples / len(self.errors)
        return float(np.mean(-10 * np.log10(np.maximum(self.errors / samples, 1e-10))))

    @property
    def effective_samples(self) -> float:
        """Of how many numbers the error costs bits, beyond those of rounding to 8 bits.

        Errors are coded given their neighbours in time and in the picture, as a first-order autoregression: what is
        new in each has the variance v = e (1 - r^2) (1 - ..) .., e their mean square. Its bits are
        log2(1 + (v / q)^2) / 4, q the variance of rounding: none where pictures are rounded to the same, and
        log2(v / q) / 2 beyond. So a number counts v^2 / (v^2 + q^2), and a picture that stands still is paid for once.
        """
        mean = float(self.errors.sum()) / self.num_samples
        in_time, *in_space = 1 - np.clip(self.alike, 0, 1) ** 2
        once = mean * float(np.prod(in_space))
        each = once * float(in_time)
        own, first = (v**2 / (v**2 + ROUNDING**2) for v in (each, once))
        frames = len(self.errors)
        return max(self.num_samples * (first + (frames - 1) * own) / frames, 1.0)

    @property
    def removed(self) -> Float[np.ndarray, " num"]:
        """Squared error that leaving a Gaussian out adds."""
        return self.slope + self.own

    def lower(
        self, place: Float[np.ndarray, "num degree+1 2"], degree: int, which: np.ndarray
    ) -> tuple[Float[np.ndarray, " some"], Float[np.ndarray, "some degree+1 2"]]:
        """The squared error that a path of lower degree adds to the Gaussians `which`; and that path, the best there.

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
        wanted = across @ own
        moved = np.linalg.solve(within + _RIDGE * size * np.eye(within.shape[1]), wanted)
        added = (own * (above @ own)).sum((1, 2)) - (wanted * moved).sum((1, 2))
        path[:, low] += moved.reshape(len(path), -1, 2)
        path[:, high] = 0
        return np.maximum(added, 0), path / scale

    def lasting(self, grown: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
        """Squared error that an end to waxing and waning adds, where the logarithm of a Gaussian's size is `grown`.

        Least by `mean_log_envelope`. Infinite where it is not alive at every frame, where there is another picture
        behind it.
        """
        total, first, second = self.by_size.T
        added = second - 2 * grown * first + grown**2 * total
        return np.where(self.misses > 0, np.inf, np.maximum(added, 0))

    def solid(self, opacity: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
        """Squared error that Gaussians of this `opacity` add where no light comes through them any more.

        Pictures are linear in one opacity, so this is exact for each alone.
        """
        more = 1 / np.maximum(opacity, np.finfo(float).tiny) - 1
        return np.maximum(more * (more * self.own - self.slope), 0)

    @property
    def mean_log_envelope(self) -> Float[np.ndarray, " num"]:
        """The mean of log a(t) / 2 where it is seen: what the logarithm of a lasting one's size should change by."""
        total, first, _ = self.by_size.T
        return first / np.maximum(total, np.finfo(float).tiny)


def _normal(moments: np.ndarray, rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Blocks (2, 2) of second derivatives by coefficients `rows` and `others`, as one matrix per Gaussian."""
    xx, xy, yy = np.moveaxis(moments[:, rows[:, None] + others], -1, 0)
    blocks = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    return blocks.transpose(0, 1, 3, 2, 4).reshape(len(moments), 2 * len(rows), 2 * len(others))


def measured(
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
    on_frame: Callable[[], None] = lambda: None,
) -> PruningScores:
    """The ledger of packed rows against frames, whose errors count by `weights`; None: all the same.

    Squares of the pictures' derivatives are estimated without bias by random signs, as in `sensitivities`.
    """
    num, place, rng = len(rows), columns(shape.degree), np.random.default_rng([seed, 4])
    centre = 1 / (1 + np.exp(-rows[:, place["time_loc_logit"]][:, 0].astype(float)))
    spread = np.exp(rows[:, place["log_time_scale"]][:, 0].astype(float))
    span = np.minimum(TAU_MAX * spread, 1.0)
    slope, own, misses, by_color = np.zeros((4, num))
    by_path, by_size, by_axes = np.zeros((num, 2 * shape.degree + 1, 3)), np.zeros((num, 3)), np.zeros((num, 2))
    weights = np.ones(len(times)) if weights is None else weights
    draws = max(DRAWS, -(-LEAST_DRAWS // len(times)))
    errors, products, before = np.zeros(len(times)), np.zeros(3), None
    signs_shape = (3, *shape.size)
    for k, t in enumerate(times):
        wanted, behind = target(k)
        done = condition(rows, window, t, shape)
        alive = done.alive
        misses += 1
        misses[alive] -= 1
        leaves = done.mean, done.factor, done.opacity, done.color, behind
        trace = cpu.forward(*leaves, shape.size, compositing=compositing, options=options)
        residual = trace.image - wanted
        errors[k] = np.vdot(residual, residual)
        products += _products(residual, before)
        before = residual
        on_frame()
        if not len(alive):
            continue
        slope[alive] -= 2 * weights[k] * done.opacity * cpu.backward(trace, residual)[2]
        u = centre[alive] - t
        powers = (u / span[alive])[:, None] ** np.arange(2 * shape.degree + 1)
        narrowed = _log_envelope(u / spread[alive], shape) / 2
        # By the logarithm of its size, at the size that it would have: that grows as its square.
        by_narrowed = np.exp(-2 * narrowed)[:, None] * np.stack([np.ones_like(narrowed), narrowed, narrowed**2], 1)
        share = weights[k] / draws
        for _ in range(draws):
            signs = rng.integers(0, 2, signs_shape, dtype=np.int8) * np.float32(2) - np.float32(1)
            d_mean, d_factor, d_opacity, d_color, _ = cpu.backward(trace, signs)
            own[alive] += share * (done.opacity * d_opacity).astype(float) ** 2
            by_path[alive] += share * powers[:, :, None] * _outer(d_mean.astype(float))[:, None]
            by_scale = (done.factor * d_factor).sum(1).astype(float)  # by the logarithms
            by_size[alive] += share * by_narrowed * by_scale.sum(1, keepdims=True) ** 2
            by_axes[alive] += share * by_scale**2
            by_color[alive] += share * SH_C0**2 * (d_color.astype(float) ** 2).mean(1)
    num_samples = len(times) * 3 * math.prod(shape.size)
    lines = np.array([len(times), *shape.size])
    alike = products * lines / np.maximum(lines - 1, 1) / max(errors.sum(), np.finfo(float).tiny)
    facts = errors, weights, num_samples, shape.size, alike
    return PruningScores(*facts, slope, own, by_path, span, by_color, by_axes, by_size, misses)


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
    """v v^T as (xx, xy, yy), half of it made round: a mean over few frames would call some direction free."""
    x, y = vectors.T
    round_part = 0.25 * (x * x + y * y)
    return np.stack([0.5 * x * x + round_part, 0.5 * x * y, 0.5 * y * y + round_part], 1)
