"""A clip taken apart: each object with soft edges, and the whole background behind them."""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from foldgauss._runtime.checks import require
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.motion.background_plate import (
    MARGIN,
    Alignment,
    Frames,
    check_frames,
    check_masks,
    complete_background,
    cover,
)

#: Width of the band around a mask in which alpha is found, a fraction of the longer side.
BAND = 0.0025
#: How far the colors of background and object may be off there, in levels of 255: where they differ by less, alpha
#: follows the mask,
COLOR_ERROR = 50.0
#: blurred by a filter with this standard deviation, in pixels.
EDGE = 0.7
#: A background of which less than this fraction is seen stays as other frames show it.
LEAST_SEEN = 0.1
#: The name of the layer behind all objects.
BACKGROUND = "background"


def separate(
    frames: Frames, masks: Mapping[str, Bool[np.ndarray, "frames height width"]], *, alignment: Alignment | None = None
) -> tuple[dict[str, UInt8[np.ndarray, "frames height width channels"]], float]:
    """Take a clip apart into the objects of `masks`, by name, and what is behind them, from front to back.

    Returns the layers, which make up the clip when they are composited: objects have alpha, (..., 4), by which colors
    are premultiplied; the background has none. And the fraction of what objects hide that no frame shows, which is
    texture from elsewhere: see `complete_background`.

    Masks are hard. In a band around them alpha is found, so that hair and blurred edges are soft: from the color I of
    the clip, F of the object next to the band and B of the background behind it, alpha = (I - B)(F - B) / |F - B|^2, as
    far as F and B differ, else as the mask has it. The object's color is then what makes up the clip,
    I - (1 - alpha) B, premultiplied. Objects are in the order of `masks`, which should not overlap.

    Source: the compositing equation with a known background (Smith and Blinn 1996). Raises ValueError for frames of
    another type, masks of another size, and for no object.

    Example: `separate(clip.frames, {"ball": masks})[0]["ball"]`.
    """
    check_frames(frames, 1)
    require(
        masks and BACKGROUND not in masks, "masks", expected="at least one, not called 'background'", got=list(masks)
    )
    for mask in masks.values():
        check_masks(frames, mask)
        require(mask.any(), "masks", expected="masks that are not empty", got="an empty one")
    side = max(frames.shape[1:3])
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(round(BAND * side), 1) + 1,) * 2)
    whole = np.any(list(masks.values()), axis=0)
    covered, spread = cover(whole), MARGIN * side
    background, unknown = complete_background(frames, covered, alignment)
    layers = {name: np.zeros((*frames.shape[:3], 4), np.uint8) for name in masks}

    def cut(k: int) -> None:
        if not whole[k].any():
            return
        image, behind = frames[k].astype(np.float32), background[k].astype(np.float32)
        # What differs in brightness at the border, such as the object's shadow, fades inwards.
        outside = cv2.dilate(np.uint8(whole[k]), kernel) == 0
        border = np.float32(covered[k] & outside)
        shift = cv2.GaussianBlur(border[..., None] * (image - behind), (0, 0), spread)
        shift /= np.maximum(cv2.GaussianBlur(border, (0, 0), spread), 1e-6)[..., None]
        fade = np.minimum(2 * cv2.GaussianBlur(np.float32(outside), (0, 0), spread), 1)[..., None]
        behind = np.where(outside[..., None], image, np.clip(behind + fade * shift, 0, 255))
        background[k] = behind.round()
        front, seen = np.zeros_like(behind), np.ones_like(behind[..., :1])
        for name, mask in reversed(masks.items()):
            if mask[k].any():
                layers[name][k] = own = _cut_out(image, np.uint8(mask[k]), seen * behind + front, kernel)
                transmitted = 1 - own[..., 3:] / np.float32(255)
                front, seen = own[..., :3] + transmitted * front, transmitted * seen
        # Where the object's color cannot make up for the background, the background is changed.
        rest = np.clip((image - front) / np.maximum(seen, LEAST_SEEN), 0, 255).round().astype(np.uint8)
        background[k] = np.where(seen > LEAST_SEEN, rest, background[k])

    run_tasks(cut, range(len(frames)))
    return layers | {BACKGROUND: background}, unknown


def _cut_out(
    image: Float32[np.ndarray, "height width 3"],
    mask: UInt8[np.ndarray, "height width"],
    behind: Float32[np.ndarray, "height width 3"],
    kernel: np.ndarray,
) -> UInt8[np.ndarray, "height width 4"]:
    """What a mask, 0 and 1, covers, with alpha."""
    weights, spread = np.float32(cv2.erode(mask, kernel) + 1e-3 * mask), kernel.shape[0] / 2
    object_color = cv2.GaussianBlur(weights[..., None] * image, (0, 0), spread)
    object_color /= np.maximum(cv2.GaussianBlur(weights, (0, 0), spread), 1e-9)[..., None]
    contrast, prior = object_color - behind, 3 * COLOR_ERROR**2
    alpha = ((image - behind) * contrast).sum(-1) + prior * cv2.GaussianBlur(np.float32(mask), (0, 0), EDGE)
    alpha = np.clip(alpha / ((contrast**2).sum(-1) + prior), 0, 1)
    alpha = np.where(mask < cv2.dilate(mask, kernel), alpha, mask)[..., None]
    color = np.clip(image - (1 - alpha) * behind, 0, 255 * alpha)
    return np.concatenate([color, 255 * alpha], -1).round().astype(np.uint8)
