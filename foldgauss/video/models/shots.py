"""Cuts: where a clip jumps to another shot, its frame times jump too, so that no Gaussian need stand in both."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Float32

#: Time between two shots, in frames: this many, and this many times the longer one. A Gaussian in the middle of a shot
#: has vanished at the next one for sigma_t up to 1.15 shots, whose envelope takes but a tenth off its size at the ends.
GAP, GAP_SHARE = 8.0, 3.0
#: An interval so many times longer than the clip's median one is a cut. Learned times move neighbours less than that.
CUT_RATIO = 6.0


def time_logits(num_frames: int, cuts: Sequence[int]) -> Float32[np.ndarray, " intervals"]:
    """Softmax weights (num_frames - 1,) of frame times evenly spaced but for a gap before each of the frames `cuts`.

    Where no fewer than half of the intervals are cuts, as between pictures of many things, there are no gaps: they
    would be the usual interval, which nothing tells from a cut.
    """
    logits = np.zeros(num_frames - 1, np.float32)
    if 2 * len(cuts) >= num_frames - 1:
        return logits
    lengths = np.diff([0, *cuts, num_frames])
    for cut, before, after in zip(cuts, lengths[:-1], lengths[1:], strict=True):
        logits[cut - 1] = np.log(GAP + GAP_SHARE * max(before, after))
    return logits


def is_cut(times: Float[ArrayLike, " num_frames"]) -> Bool[Array, " intervals"]:
    """Which intervals between frame times are cuts."""
    # By NumPy what is NumPy's: JAX would round float64.
    arrays = jnp if isinstance(times, jax.Array) else np
    intervals = arrays.diff(arrays.asarray(times))
    return intervals > CUT_RATIO * arrays.median(intervals) if len(intervals) else arrays.zeros(0, bool)


@jax.jit
def out_of_cuts(t: Float[ArrayLike, "*batch"], times: Float[ArrayLike, " num_frames"]) -> Float[Array, "*batch"]:
    """t; or where it lies between two shots, where there is nothing to see, the nearer frame's time.

    One frame alone is there at all times.
    """
    t, times = jnp.asarray(t), jnp.asarray(times)
    if len(times) == 1:
        return jnp.full_like(t, times[0])
    k = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    nearer = jnp.where(t - times[k] < times[k + 1] - t, times[k], times[k + 1])
    return jnp.where(is_cut(times)[k] & (t < times[k + 1]), nearer, t)
