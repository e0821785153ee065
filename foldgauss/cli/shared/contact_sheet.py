"""Contact sheets: images side by side in one image, with a caption above each."""

import cv2
import numpy as np

#: Factor by which errors are magnified: a difference of 255 / 8 = 32 levels shows as full brightness.
ERROR_GAIN = 8
#: Pixels between images, and height of the band of a title.
_MARGIN = 8
_BAND = 26
#: Colors of text, and of the background.
_INK = (40, 40, 40)
_PAPER = 250


def make_comparison_sheet(
    originals: list[np.ndarray], reconstructions: list[np.ndarray], captions: list[str]
) -> np.ndarray:
    """One row per frame: original, reconstruction, and their magnified absolute difference.

    Images are uint8 RGB of one size; `captions` stand above the rows. Returns uint8 (height, width, 3).
    """
    rows = []
    for original, image, caption in zip(originals, reconstructions, captions, strict=True):
        error = np.clip(np.abs(original.astype(np.int16) - image) * ERROR_GAIN, 0, 255).astype(np.uint8)
        titled = (original, f"original, {caption}"), (image, "reconstruction"), (error, f"error x {ERROR_GAIN}")
        rows.append(np.concatenate([_add_title(*pair) for pair in titled], axis=1))
    return np.pad(np.concatenate(rows), ((0, _MARGIN), (0, _MARGIN), (0, 0)), constant_values=_PAPER)


def _add_title(image: np.ndarray, title: str) -> np.ndarray:
    """The image with a line of text above it; the text shrinks to the width of a narrow image."""
    height, width, _ = image.shape
    tile = np.full((height + _BAND, width + _MARGIN, 3), _PAPER, np.uint8)
    tile[_BAND:, _MARGIN:] = image
    scale = 0.45
    while scale > 0.1 and cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width - 3:
        scale *= 0.95  # in steps, because the width of small letters is not proportional to their scale
    cv2.putText(tile, title, (_MARGIN, _BAND - 9), cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
    return tile
