"""Frames with alpha: where light comes through, what lies behind is seen. The colour is premultiplied by alpha.

$$ C = c\\,\\alpha + (1 - \\alpha)\\, b $$

Fitted over another random background b in every step, splats learn alpha too: only where they let as much light
through as the frame does is the picture right over all of them.
"""

import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._runtime.checks import invalid

BLACK = (0.0, 0.0, 0.0)
_STREAM = 3  # of the seed's random numbers, after those of the starts, the order and the growth


def random_background(seed: int, step: int) -> Float[np.ndarray, "3"]:
    """The colour behind the frames of a step: a function of both, so that a fit goes on as if never stopped."""
    return np.random.default_rng([seed, _STREAM, step]).random(3, np.float32)


def composite(frame: UInt8[np.ndarray, "height width 4"], background: Float[np.ndarray, "3"]) -> UInt8[np.ndarray, ""]:
    """One frame over `background`, values in [0, 1], as it is shown: uint8 (height, width, 3), rounded."""
    light = 1 - frame[..., 3:] * np.float32(1 / 255)
    behind = 255 * np.asarray(background, np.float32)
    return np.minimum(frame[..., :3] + light * behind + 0.5, 255).astype(np.uint8)


def check_background(background: object, compositing: str = "over") -> Float[np.ndarray, "3"]:
    """As float32 (3,). Raises ValueError unless it is three numbers in [0, 1], and black for sums."""
    color = np.asarray(background)
    if color.shape != (3,) or color.dtype.kind not in "fiu" or not ((color >= 0) & (color <= 1)).all():
        raise invalid("background", expected="red, green and blue in [0, 1]", got=background)
    if compositing == "sum" and color.any():
        cure = "All of it would come through: sums know no alpha."
        raise invalid(
            "background", expected="black for a model fitted with compositing 'sum'", got=background, cure=cure
        )
    return color.astype(np.float32)
