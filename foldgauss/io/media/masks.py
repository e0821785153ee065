"""Masks of one object from files: an image, a folder of images, or a video."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from foldgauss._runtime.checks import invalid, is_integer, is_within
from foldgauss.io._atomic import checked_path
from foldgauss.io.media.labels import VOID, read_labels
from foldgauss.io.media.video_file import IMAGE_SUFFIXES, aspect_window, image_paths, read_video
from foldgauss.render.splats import check_size

Range = tuple[int | None, int | None]

DARK_LEVEL = 0.5  # of white: what is darker in a video is no mask


def read_masks(
    path: str | os.PathLike,
    *,
    label: int | None = None,
    frames: Range | None = None,
    size: tuple[int, int] | None = None,
    level: float = DARK_LEVEL,
) -> Bool[np.ndarray, "height width"] | Bool[np.ndarray, "num_frames height width"]:
    """The masks of an object, ready for `foldgauss.video.by_mask`.

    - An image (palette or grey, as the annotations of DAVIS): bool (height, width). A folder of them, in natural order:
      bool (num_frames, height, width). `label` is the object's number; None: all objects, so whatever is not 0
      (background) and not 255 (void). Black and white images have the one object 1.
    - A video: bool (num_frames, height, width), where the brightest channel is at least `level` of white.

    `frames = (A, B)` keeps A <= i < B of a folder or video, None for an open end. `size` = (height, width) cuts the
    masks to that aspect around the centre, as `read_video` does with frames: give it where the fit was given it.

    **Example:** `by_mask(model, read_masks("DAVIS/Annotations/480p/bear", label=1))`.

    **Raises:** `FileNotFoundError`; ValueError for images that are no masks, a label that is in none of them, options
    that do not apply, and as `read_video`.
    """
    path = checked_path(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"path: expected an image, a folder or a video, got {str(path)!r}, which is missing.")
    if label is not None and not (is_integer(label, 1) and label < VOID):
        raise invalid("label", expected=f"an object's number, 1 to {VOID - 1}", got=repr(label))
    masks = _read(path, label, frames, level)
    if size is None:
        return masks
    check_size(size)
    return np.ascontiguousarray(masks[..., *aspect_window(masks.shape[-2:], size)])


def _read(path: Path, label: int | None, frames: Range | None, level: float) -> Bool[np.ndarray, "*num height width"]:
    """The masks as they are."""
    if level != DARK_LEVEL and (path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES):
        raise invalid("level", expected="a video with it", got=f"images, {str(path)!r}", cure="They have labels.")
    if path.is_dir():
        return _of_label(_images(path, frames), label, path)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        if frames is not None:
            raise invalid("frames", expected="a folder or a video with them", got=f"the image {str(path)!r}")
        return _of_label([path], label, path)[0]
    if label is not None:
        cure = "Leave label out, or give a folder of PNGs."
        raise invalid("label", expected="images with labels", got=f"the video {str(path)!r}", cure=cure)
    if not is_within(level, "(0, 1]"):
        raise invalid("level", expected="a share of white in (0, 1]", got=repr(level))
    return read_video(path, frames=frames).over_black.max(-1) >= 255 * level


def _images(folder: Path, frames: Range | None) -> list[Path]:
    images = image_paths(folder)
    start, stop = frames if frames is not None else (None, None)
    for name, k in (("start", start), ("stop", stop)):
        if k is not None and not (is_integer(k, 0) and k <= len(images)):
            raise invalid("frames", expected=f"a range in {len(images)} images", got=f"{name} {k!r}")
    if not images[start:stop]:
        raise invalid("path", expected="a folder with images in it", got=f"{str(folder)!r}, {len(images)} images")
    return images[start:stop]


def _of_label(paths: list[Path], label: int | None, source: Path) -> Bool[np.ndarray, "num_frames height width"]:
    labels = read_labels(paths)
    there = sorted(set(np.unique(labels).tolist()) - {0, VOID})
    if label is not None and label not in there:
        expected = f"one of {there} in {str(source)!r}" if there else f"masks with objects in {str(source)!r}"
        raise invalid("label", expected=expected, got=label)
    return (labels != 0) & (labels != VOID) if label is None else labels == label
