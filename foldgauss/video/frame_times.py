"""Learned occurrence times of the frames (eq:frame_fitting)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._checks import invalid
from foldgauss.video.shots import is_cut


class FrameTimes(eqx.Module):
    r"""Times of n frames in [0, 1], learned through n - 1 softmax weights.

    .. math:: t_k = \sum_{i \le k} \frac{e^{w_i}}{\sum_j e^{w_j}}, \qquad t_0 = 0,\; t_{n-1} = 1

    `logits` has shape (n - 1,); equal logits are equally spaced frames. The order of the frames cannot change.

    Source: VeGaS, eq:frame_fitting.
    """

    logits: Float[Array, "intervals"]

    @classmethod
    def uniform(cls, num_frames: int) -> "FrameTimes":
        """Equally spaced times. Raises ValueError below two frames."""
        if num_frames < 2:
            raise invalid("num_frames", expected="at least 2", got=num_frames)
        return cls(np.zeros(num_frames - 1, np.float32))

    @property
    def num_frames(self) -> int:
        return self.logits.shape[0] + 1

    def times(self) -> Float[Array, "num_frames"]:
        """The times t_k: 0 at the first frame, exactly 1 at the last, never decreasing.

        Neighbours are equal only where a weight is too small for the dtype to show.
        """
        summed = jnp.cumsum(jax.nn.softmax(jnp.asarray(self.logits)))
        return jnp.concatenate([jnp.zeros(1, summed.dtype), summed / summed[-1]])


def interpolated_times(times: np.ndarray, upsample: int) -> np.ndarray:
    """`upsample` frames per original interval, evenly spaced between t_k and t_{k+1}, and the last frame.

    At a cut nothing lies between: the first half of the frames there is the one before it, the rest the one after.
    Shape ((n - 1) * upsample + 1,). Source: VeGaS, the sentence after eq:frame_fitting.
    """
    if upsample < 1:
        raise invalid("upsample", expected="a whole number >= 1", got=upsample)
    times = np.asarray(times)
    position = np.arange((len(times) - 1) * upsample + 1) / upsample
    interval = np.minimum(position.astype(int), len(times) - 2)
    position = np.where(np.asarray(is_cut(times))[interval], np.floor(position + 0.5), position)
    return np.interp(position, np.arange(len(times)), times).astype(times.dtype)
