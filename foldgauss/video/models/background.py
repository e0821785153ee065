"""Frames with alpha over a background. Colors are premultiplied by alpha.

$$ C = c\\,\\alpha + (1 - \\alpha)\\, b $$

A fit with another random background b in every step learns alpha too: the image is right over all backgrounds only if
the splats' transmittance is that of the frame.
"""

import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import require

BLACK = (0.0, 0.0, 0.0)
WHITE = (1.0, 1.0, 1.0)
#: Red, green and blue in [0, 1]; None: transparent, images get alpha.
Background = tuple[float, float, float] | None


def random_background(seed: int, step: int) -> Float[np.ndarray, "3"]:
    """The background color of a step: it depends on nothing else, so that a resumed fit repeats it."""
    return make_generator(Stream.BACKGROUND, step, seed=seed).random(3, np.float32)


def composite(
    frame: UInt8[np.ndarray, "height width 4"], background: Float[np.ndarray, "3"]
) -> UInt8[np.ndarray, "height width 3"]:
    """One frame over `background`, with values in [0, 1]: uint8 (height, width, 3), rounded."""
    transmittance = 1 - frame[..., 3:] * np.float32(1 / 255)
    behind = 255 * np.asarray(background, np.float32)
    return np.minimum(frame[..., :3] + transmittance * behind + 0.5, 255).astype(np.uint8)


def check_color(parameter: str, color: object) -> Float[np.ndarray, "3"]:
    """Red, green and blue as an array. Raises ValueError unless they are numbers in [0, 1]."""
    array = np.asarray(color)
    is_color = array.shape == (3,) and array.dtype.kind in "fiu" and ((array >= 0) & (array <= 1)).all()
    require(is_color, parameter, expected="red, green and blue in [0, 1]", got=color)
    return array


def check_background(background: object, compositing: str = "over") -> Float[np.ndarray, " channels"]:
    """The background as float32 (3,), or zeros (4,) for None. Raises ValueError unless it is a color in [0, 1] or None,
    and black for "sum"."""
    if background is None and compositing != "sum":
        return np.zeros(4, np.float32)
    color = check_color("background", BLACK if background is None else background)
    require(
        compositing != "sum" or (background is not None and not color.any()),
        "background",
        expected="black for a model fitted with compositing 'sum'",
        got=background,
        cure="Sums have no alpha: all of it would show.",
    )
    return color.astype(np.float32)
