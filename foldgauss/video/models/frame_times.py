"""Occurrence times of the frames (eq:frame_fitting): learned inside a shot, with a gap at every cut between two shots.

The gap keeps a Gaussian of one shot from being alive in the next one.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Float32

from foldgauss._runtime.checks import is_integer, is_within, require, short_repr

#: Length of the gap between two shots, in frames: this,
GAP = 8.0
#: plus this times the longer shot. A Gaussian in the middle of a shot has vanished in the next one for sigma_t up to
#: 1.15 shots, whose envelope shrinks it by at most a tenth at the ends of its own shot.
GAP_SHOTS = 3.0
#: An interval longer than the median one by this factor is a cut. Learned times move neighbors less than that.
CUT_RATIO = 6.0


class FrameTimes(eqx.Module):
    r"""Times of n frames in [0, 1], learned through n - 1 softmax weights; a single frame is at 0.

    $$ t_k = \sum_{i \le k} \frac{e^{w_i}}{\sum_j e^{w_j}}, \qquad t_0 = 0,\; t_{n-1} = 1 $$

    `logits` has shape (n - 1,); equal logits are equally spaced frames. The order of the frames cannot change.

    Source: VeGaS, eq:frame_fitting.
    """

    logits: Float[Array, " intervals"]

    @classmethod
    def uniform(cls, num_frames: int) -> "FrameTimes":
        """Equally spaced times. Raises ValueError for no frames."""
        require(num_frames >= 1, "num_frames", expected="at least 1", got=num_frames)
        return cls(np.zeros(num_frames - 1, np.float32))

    @property
    def num_frames(self) -> int:
        return self.logits.shape[0] + 1

    def times(self) -> Float[Array, "num_frames"]:
        """The times t_k: 0 at the first frame, exactly 1 at the last, never decreasing.

        Neighbors are equal only where a weight is too small for the dtype.
        """
        return _cumulate(jnp.asarray(self.logits))


@jax.jit  # one program in place of one for each operation
def _cumulate(logits: Float[Array, " intervals"]) -> Float[Array, " num_frames"]:
    summed = jnp.cumsum(jax.nn.softmax(logits))
    return jnp.concatenate([jnp.zeros(1, summed.dtype), summed / summed[-1:]])


def make_time_logits(num_frames: int, cuts: Sequence[int]) -> Float32[np.ndarray, " intervals"]:
    """Softmax weights (num_frames - 1,) of evenly spaced frame times with a gap before each of the frames `cuts`.

    There are no gaps if at least half of the intervals are cuts (a slide show): the gap would be the median interval,
    and `is_cut` could not detect it.
    """
    logits = np.zeros(num_frames - 1, np.float32)
    if 2 * len(cuts) >= num_frames - 1:
        return logits
    lengths = np.diff([0, *cuts, num_frames])
    for cut, before, after in zip(cuts, lengths[:-1], lengths[1:], strict=True):
        logits[cut - 1] = np.log(GAP + GAP_SHOTS * max(before, after))
    return logits


def is_cut(times: Float[ArrayLike, " num_frames"]) -> Bool[Array, " intervals"]:
    """Which intervals between frame times are cuts: a NumPy array for NumPy times (JAX would round float64)."""
    arrays = jnp if isinstance(times, jax.Array) else np
    intervals = arrays.diff(arrays.asarray(times))
    return intervals > CUT_RATIO * arrays.median(intervals) if len(intervals) else arrays.zeros(0, bool)


@jax.jit
def snap_to_shots(t: Float[ArrayLike, "*batch"], times: Float[ArrayLike, " num_frames"]) -> Float[Array, "*batch"]:
    """t, or the nearer frame's time where t lies in the gap of a cut. A single frame covers all times."""
    t, times = jnp.asarray(t), jnp.asarray(times)
    if len(times) == 1:
        return jnp.full_like(t, times[0])
    k = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    nearer = jnp.where(t - times[k] < times[k + 1] - t, times[k], times[k + 1])
    return jnp.where(is_cut(times)[k] & (t < times[k + 1]), nearer, t)


def interpolated_times(times: np.ndarray, upsample: int) -> np.ndarray:
    """`upsample` frames per original interval, evenly spaced between t_k and t_{k+1}, and the last frame.

    At a cut the first half of the new frames repeats the frame before it, the second half the frame after it.
    Shape ((n - 1) * upsample + 1,). Source: VeGaS, the sentence after eq:frame_fitting.
    """
    require(is_integer(upsample, 1), "upsample", expected="a whole number >= 1", got=short_repr(upsample))
    return times_at(times, np.arange((len(times) - 1) * upsample + 1) / upsample)


def times_at(
    times: Float[np.ndarray, " num_frames"], positions: Float[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch"]:
    """The times of continuous frame positions: 2.5 is half way from frame 2 to frame 3.

    Positions are clipped to the clip; those in the gap of a cut get the nearer frame's time. Shapes: as `positions`.
    """
    times, positions = np.asarray(times), np.clip(np.asarray(positions, np.float64), 0, len(times) - 1)
    cut = np.append(np.asarray(is_cut(times)), False)  # no interval follows the last frame
    positions = np.where(cut[positions.astype(int)], np.floor(positions + 0.5), positions)
    return np.interp(positions, np.arange(len(times)), times).astype(times.dtype)


def played_positions(num_frames: int, rate: float, *, speed: float = 1.0) -> Float[np.ndarray, " shown"]:
    """Frame positions of the output frames, from the first frame to the last; backwards for speed < 0.

    `rate` is the output's frame rate over the clip's, `speed` the playback speed: 0.25 is slow motion. The last frame
    is included only if a step lands on it. Raises ValueError unless rate > 0 and speed is finite and not 0.
    """
    check_rate("rate", rate)
    require(
        np.isfinite(speed) and speed != 0,
        "speed",
        expected="a number other than 0",
        got=speed,
        cure="0.25 is slow motion, -1 backwards.",
    )
    step = abs(speed) / rate
    positions = np.arange(int(np.floor((num_frames - 1) / step + 1e-9)) + 1) * step
    return positions if speed > 0 else num_frames - 1 - positions


def remapped_positions(
    remap: Float[ArrayLike, "points 2"], fps: float, rate: float = 1.0
) -> Float[np.ndarray, " shown"]:
    """Frame positions of the output frames if the clip's time is a piecewise linear function of the output's time.

    `remap` has rows (second of the output, second of the clip), the first column rising from 0; `fps` is the clip's,
    `rate` as in `played_positions`. Raises ValueError for anything else.
    Example: `remapped_positions([[0, 0], [1, 1], [3, 1], [4, 2]], fps=25)` holds second 1 for two seconds.
    """
    check_rate("fps", fps)
    check_rate("rate", rate)
    points = np.asarray(remap, np.float64)
    require(
        points.ndim == 2 and points.shape[1:] == (2,) and len(points) >= 2 and np.isfinite(points).all(),
        "remap",
        expected="at least two rows (second shown, second of the clip)",
        got=f"shape {points.shape}" if np.isfinite(points).all() else remap,
    )
    shown, of_clip = points.T
    require(
        shown[0] == 0 and (np.diff(shown) > 0).all(),
        "remap",
        expected="seconds shown that rise from 0",
        got=shown.tolist(),
    )
    require(of_clip.min() >= 0, "remap", expected="seconds of the clip >= 0", got=of_clip.tolist())
    seconds = np.arange(int(np.floor(shown[-1] * fps * rate + 1e-9)) + 1) / (fps * rate)
    return np.interp(seconds, shown, of_clip) * fps


def check_rate(name: str, rate: float) -> None:
    """Raise ValueError unless a number of frames a second, or a ratio of two, is positive and finite."""
    require(is_within(rate, "(0, inf)"), name, expected="a number > 0", got=short_repr(rate))
