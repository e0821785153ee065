"""Pictures for people: what was asked for, what came out, and where they differ."""

import cv2
import numpy as np

#: Errors are this much magnified; 255 / 8 = 32 levels off show as full brightness.
ERROR_GAIN = 8
_MARGIN, _BAND, _INK, _PAPER = 8, 26, (40, 40, 40), 250


def comparison(originals: list[np.ndarray], reconstructions: list[np.ndarray], captions: list[str]) -> np.ndarray:
    """One row per frame: original, reconstruction, and their absolute difference magnified.

    Pictures are uint8 RGB of one size; `captions` stand above each row. Returns uint8 (height, width, 3).
    """
    rows, titles = [], []
    for original, picture, caption in zip(originals, reconstructions, captions, strict=True):
        error = np.abs(original.astype(np.int16) - picture)
        rows.append([original, picture, np.clip(error * ERROR_GAIN, 0, 255).astype(np.uint8)])
        titles.append([f"original, {caption}", "reconstruction", f"error x {ERROR_GAIN}"])
    return sheet(rows, titles)


def sheet(rows: list[list[np.ndarray]], titles: list[list[str]]) -> np.ndarray:
    """Rows of pictures, uint8 RGB of one size, as many in each row, and a line of text above each picture.

    Returns uint8 (height, width, 3).
    """
    lines = [
        np.concatenate([_titled(*pair) for pair in zip(row, above, strict=True)], axis=1)
        for row, above in zip(rows, titles, strict=True)
    ]
    return np.pad(np.concatenate(lines), ((0, _MARGIN), (0, _MARGIN), (0, 0)), constant_values=_PAPER)


def _titled(picture: np.ndarray, title: str) -> np.ndarray:
    """The picture with a line of text above it; the text shrinks where the picture is narrow."""
    height, width, _ = picture.shape
    tile = np.full((height + _BAND, width + _MARGIN, 3), _PAPER, np.uint8)
    tile[_BAND:, _MARGIN:] = picture
    scale = 0.45
    while scale > 0.1 and cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width - 3:  # its rim
        scale *= 0.95  # step by step: the width of small letters is not in proportion to their scale
    cv2.putText(tile, title, (_MARGIN, _BAND - 9), cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
    return tile
