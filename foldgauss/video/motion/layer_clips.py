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
    Masks,
    check_frames,
    check_masks,
    complete_background,
    cover,
    dilate,
    render_plate,
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
#: A shadow is within this distance of its object, a fraction of the longer side.
SHADOW_REACH = 0.15
#: It is wider than twice this fraction.
NARROWEST = 0.004
#: The logarithm of the light that is left is below this,
SHADED = -0.12
#: and in each channel within this of the mean of the three, times one more than the mean's size.
EVENNESS = 0.12
#: The name of the layer behind all objects.
BACKGROUND = "background"


def separate(
    frames: Frames,
    masks: Mapping[str, Bool[np.ndarray, "frames height width"]],
    *,
    shadows: bool = False,
    alignment: Alignment | None = None,
) -> tuple[dict[str, UInt8[np.ndarray, "frames height width channels"]], float]:
    """Take a clip apart into the objects of `masks`, by name, and what is behind them, from front to back.

    Returns the layers, which make up the clip when they are composited: objects have alpha, (..., 4), by which colors
    are premultiplied; the background has none. And the fraction of what objects hide that no frame shows, which is
    texture from elsewhere: see `complete_background`.

    Masks are hard. In a band around them alpha is found, so that hair and blurred edges are soft: from the color I of
    the clip, F of the object next to the band and B of the background behind it, alpha = (I - B)(F - B) / |F - B|^2, as
    far as F and B differ, else as the mask has it. The object's color is then what makes up the clip,
    I - (1 - alpha) B, premultiplied. Objects are in the order of `masks`, which should not overlap.

    With `shadows`, an object has the shadow that it casts, too: black pixels, of which alpha is what they take from the
    background. They are darker than other frames show them, by about the same factor in all channels, reach the object,
    and are at most `SHADOW_REACH` away. A shadow that stands still with its object is not found.

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
    alignment = Alignment.from_frames(frames) if alignment is None else alignment
    shades = {name: np.zeros(frames.shape[:3], np.uint8) for name in masks}
    if shadows:
        _find_shadows(frames, masks, covered, alignment, shades)
    shaded = np.any([one > 0 for one in shades.values()], axis=0)
    covered |= shaded
    background, unknown = complete_background(frames, covered, alignment)
    layers = {name: np.zeros((*frames.shape[:3], 4), np.uint8) for name in masks}

    def cut(k: int) -> None:
        if not whole[k].any():
            return
        image, behind = frames[k].astype(np.float32), background[k].astype(np.float32)
        # What differs in brightness at the border, such as the object's shadow, fades inwards.
        outside = (cv2.dilate(np.uint8(whole[k]), kernel) == 0) & ~shaded[k]
        border = np.float32(covered[k] & outside)
        shift = cv2.GaussianBlur(border[..., None] * (image - behind), (0, 0), spread)
        shift /= np.maximum(cv2.GaussianBlur(border, (0, 0), spread), 1e-6)[..., None]
        fade = np.minimum(2 * cv2.GaussianBlur(np.float32(outside), (0, 0), spread), 1)[..., None]
        behind = np.where(outside[..., None], image, np.clip(behind + fade * shift, 0, 255))
        background[k] = behind.round()
        front, seen = np.zeros_like(behind), np.ones_like(behind[..., :1])
        for name, mask in reversed(masks.items()):
            if mask[k].any():
                here = np.uint8(mask[k]), seen * behind + front, np.float32(shades[name][k]) / 255
                layers[name][k] = own = _cut_out(image, *here, kernel)
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
    shade: Float32[np.ndarray, "height width"],
    kernel: np.ndarray,
) -> UInt8[np.ndarray, "height width 4"]:
    """What a mask, 0 and 1, covers, with alpha, which is `shade` at least."""
    weights, spread = np.float32(cv2.erode(mask, kernel) + 1e-3 * mask), kernel.shape[0] / 2
    object_color = cv2.GaussianBlur(weights[..., None] * image, (0, 0), spread)
    object_color /= np.maximum(cv2.GaussianBlur(weights, (0, 0), spread), 1e-9)[..., None]
    contrast, prior = object_color - behind, 3 * COLOR_ERROR**2
    alpha = ((image - behind) * contrast).sum(-1) + prior * cv2.GaussianBlur(np.float32(mask), (0, 0), EDGE)
    alpha = np.clip(alpha / ((contrast**2).sum(-1) + prior), 0, 1)
    alpha = np.maximum(np.where(mask < cv2.dilate(mask, kernel), alpha, mask), shade)[..., None]
    color = np.clip(image - (1 - alpha) * behind, 0, 255 * alpha)
    return np.concatenate([color, 255 * alpha], -1).round().astype(np.uint8)


def _find_shadows(
    frames: Frames,
    masks: Mapping[str, Masks],
    covered: Masks,
    alignment: Alignment,
    shades: dict[str, UInt8[np.ndarray, "frames height width"]],
) -> None:
    """Write into `shades` which part of the light the shadow of each object takes, 255 for all."""
    side = max(frames.shape[1:3])
    narrow, reach = (2 * round(part * side) + 1 for part in (NARROWEST, 2 * SHADOW_REACH))
    square, blur = np.ones((narrow, narrow), np.uint8), max(NARROWEST * side, 1.5)

    def find(item: tuple[int, tuple[int, int]]) -> None:
        k, shot = item
        if not covered[k].any():
            return
        x, y, width, height = cv2.boundingRect(np.uint8(dilate(covered[k], reach)))
        box = slice(y, y + height), slice(x, x + width)
        plate, count = render_plate(frames, covered, alignment, k, shot, box)
        known = (count > 1) & ~np.any([mask[k][box] for mask in masks.values()], axis=0)
        # The means of what is known around each pixel, with a bit of light in the darkest ones.
        here, there = (
            cv2.GaussianBlur(np.float32(known[..., None] * one), (0, 0), blur) + 4 for one in (frames[k][box], plate)
        )
        ratio = np.log(here / there)
        light = ratio.mean(-1)
        is_even = np.abs(ratio - light[..., None]).max(-1) < EVENNESS * (1 - light)
        dark = cv2.morphologyEx(np.uint8(known & is_even & (light < SHADED)), cv2.MORPH_OPEN, square)
        dark = cv2.morphologyEx(dark, cv2.MORPH_CLOSE, square, iterations=3) * np.uint8(known & (light < SHADED))
        num, pieces, _, centers = cv2.connectedComponentsWithStats(dark)
        # Of the darkest channel and pixel around: the object's color makes up for the others.
        left = ((frames[k][box] + np.float32(4)) / (plate + np.float32(4))).min(-1)
        taken = np.clip(1 - cv2.erode(left, np.ones((3, 3))), 0, 1)
        for name, mask in masks.items():
            if not mask[k].any():
                continue
            touched = np.zeros(num, bool)
            touched[pieces[dilate(mask[k][box], narrow)]] = True
            # Not the background, nor what is higher than the object: dark things beside it.
            touched &= (np.arange(num) > 0) & (centers[:, 1] > np.mean(np.nonzero(mask[k][box])[0]))
            own = dilate(touched[pieces], narrow) & known
            pieces[own] = 0
            shades[name][k][box] = np.where(own, 255 * taken, 0).round()

    run_tasks(find, [(k, shot) for shot in alignment.shots for k in range(*shot)])
