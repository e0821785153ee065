"""Masks of objects from images: numbers, not colours."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from foldgauss._runtime.checks import invalid

#: Kinds of image whose stored numbers are the labels: palette ("P"), grey ("L") and black and white ("1").
_NUMBERED = ("P", "L", "1")
_COLORED = ("RGB", "RGBA")
#: Others are not decoded, whatever the name says: Pillow would hand some, as PostScript, to other programs.
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
#: Pixels of a mask: so many, 8K, or as many for each byte of its file as deflate can make of it, 1 bit each.
MOST_PIXELS, MOST_PER_BYTE = 2**25, 8 * 1032
_WHITE = 255
#: The label of pixels that may be anything.
VOID = 255


class _TooLarge(Exception):
    """More pixels than the file can hold."""


def read_labels(paths: Sequence[Path]) -> np.ndarray:
    """Masks as uint8 (num_masks, height, width): 0 is the background, k the object k, 255 what is void.

    A palette image gives the *index* of each pixel, whatever colour it is shown in (OpenCV gives the colour, hence
    Pillow here); a grey one its level, also where that is stored as three equal colours. Masks that are black and white
    throughout, as those of DAVIS 2016, become 0 and 1. Raises ValueError for an image that does not decode, has colours
    instead of numbers, or differs in size.
    """
    masks, grey = [], True
    for path in paths:
        mask, mode = _read(path)
        grey = grey and mode != "P"
        if masks and mask.shape != masks[0].shape:
            raise invalid(
                "path",
                expected=f"masks of one size, {_text(masks[0].shape)} as in {paths[0].name!r}",
                got=f"{_text(mask.shape)} in {str(path)!r}",
            )
        masks.append(mask)
    labels = np.stack(masks)
    if grey and set(np.unique(labels)) <= {0, _WHITE}:
        labels = (labels == _WHITE).astype(np.uint8)
    return labels


def _read(path: Path) -> tuple[np.ndarray, str]:
    """(numbers, kind of image) of one mask."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about damage: it decodes or it does not
            mode, pixels = _decoded(path)
    except (_TooLarge, Image.DecompressionBombError) as error:
        most = max(MOST_PIXELS, MOST_PER_BYTE * path.stat().st_size)
        most = min(most, 2 * (Image.MAX_IMAGE_PIXELS or most))  # Pillow's own limit
        raise invalid(
            "path",
            expected=f"a mask of at most {most:,} pixels, as its file has {path.stat().st_size:,} bytes",
            got=f"more in {str(path)!r}",
            cure="Is it a mask? If so, cut it, or store it uncompressed.",
        ) from error
    except Exception as error:  # Pillow's decoders raise what comes: SyntaxError, struct.error, zlib.error, IndexError
        raise invalid(
            "path", expected="masks that decode", got=f"{str(path)!r}, which does not", cure="Copy it again."
        ) from error
    if mode in _COLORED and (pixels[..., :3] == pixels[..., :1]).all():  # grey all the same, as paint programs write it
        mode, pixels = "L", pixels[..., 0]
    if mode not in _NUMBERED:
        raise invalid(
            "path",
            expected="masks with a number per pixel (palette or grey)",
            got=f"an image of kind {mode!r} in {str(path)!r}",
            cure="Its colours were stored in place of the labels; take the original PNG.",
        )
    return pixels.astype(np.uint8) * (_WHITE if mode == "1" else 1), mode


def _decoded(path: Path) -> tuple[str, np.ndarray]:
    """(kind of image, what is stored of its pixels); its size is judged before there is room for it."""
    with Image.open(path, formats=_FORMATS) as image:
        width, height = image.size
        if width * height > max(MOST_PIXELS, MOST_PER_BYTE * path.stat().st_size):
            raise _TooLarge
        return image.mode, np.array(image)


def _text(shape: tuple[int, ...]) -> str:
    return f"{shape[0]}x{shape[1]} (height x width)"
