"""Object masks from images, folders of images and videos."""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from foldgauss._runtime.checks import check_within, is_integer, require
from foldgauss.io._atomic import PathLike, check_input, check_path
from foldgauss.io.media.clip import Range, Size, check_range, format_size
from foldgauss.io.media.images import IMAGE_SUFFIXES, choose_images, open_image, undecodable_error
from foldgauss.io.media.reading import aspect_window, read_video
from foldgauss.render.splats import check_size

MASK_LEVEL = 0.5  # fraction of white from which a pixel of a video belongs to the mask
#: Pillow modes whose stored values are labels: palette, grayscale of 8 and of 16 bits, and black and white.
_LABEL_MODES = ("P", "L", "1", "I;16", "I;16B", "I")
_COLOR_MODES = {"RGB": 3, "RGBA": 3, "LA": 1}  # channels besides alpha
#: The label of pixels without annotation.
VOID = 255


def read_masks(
    path: PathLike,
    *,
    label: int | None = None,
    frames: Range | None = None,
    size: Size | None = None,
    level: float = MASK_LEVEL,
) -> Bool[np.ndarray, "height width"] | Bool[np.ndarray, "num_frames height width"]:
    """The masks of an object, as `foldgauss.video.by_mask` takes them.

    - An image (palette or grayscale, as the annotations of DAVIS): bool (height, width). A folder of them, in natural
      order: bool (num_frames, height, width). `label` is the object's label; None selects all objects, which is
      everything except 0 (background) and 255 (void). Black and white images have one object with label 1.
      Labels of 16 bits are read as those of 8; of black and white ones, white may have any value above 255.
    - A video: bool (num_frames, height, width), True where the brightest channel is at least `level` of white.

    `frames = (A, B)` keeps A <= i < B of a folder or video, None for an open end, as `read_video`. `size` = (height,
    width) crops the masks to that aspect around the center, as `read_video` crops frames, without resizing them: use
    the same value as for the fit. Where pixels of the clip are not square, masks are of the size at which they are.

    **Example:** `by_mask(model, read_masks("DAVIS/Annotations/480p/bear", label=1))`.

    **Raises:** `FileNotFoundError`; ValueError for images that are not masks, a label that none of them has, options
    that do not apply, and as `read_video`.
    """
    path = check_path(path)
    check_input(path, "an image, a folder or a video")
    require(
        label is None or (is_integer(label, 1) and label < VOID),
        "label",
        expected=f"an object's label, 1 to {VOID - 1}",
        got=repr(label),
    )
    is_image = path.suffix.lower() in IMAGE_SUFFIXES
    require(
        level == MASK_LEVEL or not (path.is_dir() or is_image),
        "level",
        expected="a video with it",
        got=f"images, {str(path)!r}",
        cure="They have labels.",
    )
    if path.is_dir():
        masks = _select_label(choose_images(path, *check_range(frames)), label, path)
    elif is_image:
        require(
            frames is None,
            "frames",
            expected="a folder or a video with them",
            got=f"the image {str(path)!r}",
        )
        masks = _select_label([path], label, path)[0]
    else:
        require(
            label is None,
            "label",
            expected="images with labels",
            got=f"the video {str(path)!r}",
            cure="Leave label out, or give a folder of PNGs.",
        )
        check_within("level", level, "(0, 1]", "a fraction of white in (0, 1]")
        clip = read_video(path, frames=frames)
        for note in clip.notes:
            warnings.warn(f"{path}: {note}", stacklevel=2)
        masks = clip.over_black.max(-1) >= 255 * level
    if size is None:
        return masks
    check_size(size)
    return np.ascontiguousarray(masks[..., *aspect_window(masks.shape[-2:], size)])


def read_object_masks(
    path: PathLike, first: int, num_frames: int, size: Size, *, names: Sequence[str] = (), crop: bool = True
) -> dict[str, dict[int, Bool[np.ndarray, "height width"]]]:
    """The masks of each object, by name and frame, for `num_frames` frames of `size`, from frame `first` of a clip on.

    A folder of label images, or one: objects are called "object", or "object 1", "object 2" by their labels; a video
    has one. Masks are of all frames of the clip or of the part, or they are images of some frames. `names` are the
    names of the clip's images. An image with one of these names belongs to that frame. Any other image belongs to the
    frame whose number its name ends with, or to the first frame. Masks of another aspect than `size` are cropped around
    the center, or refused if `crop` is False. Then they are resized. Objects without pixels are left out, and so are
    their masks of single frames.

    Raises as `read_masks`, and ValueError for fewer frames of a video, and where no object is in the masks.
    """
    path = check_path(path)
    check_input(path, "a folder, an image or a video")
    files = choose_images(path, 0, None) if path.is_dir() else [path] * (path.suffix.lower() in IMAGE_SUFFIXES)
    labels = read_labels(files) if files else np.uint8(read_masks(path))
    numbers = sorted(set(np.unique(labels).tolist()) - {0, VOID})
    require(numbers, "masks", expected="an object in them", got=f"none in {str(path)!r}")
    if len(labels) >= num_frames:
        labels = labels[first:] if len(labels) >= first + num_frames else labels
        frames = dict(enumerate(labels[:num_frames]))
    else:
        require(files, "masks", expected=f"one for each of {num_frames} frames", got=f"{len(labels)} in {str(path)!r}")
        frames = {_find_frame(file, names) - first: own for file, own in zip(files, labels, strict=True)}
        frames = {k: own for k, own in frames.items() if 0 <= k < num_frames}
        require(
            frames,
            "masks",
            expected=f"one of a frame from {first} to {first + num_frames - 1}",
            got=f"others in {str(path)!r}",
            cure="The name of an image ends with the number of its frame.",
        )
    height, width = labels.shape[1:]
    require(
        crop or abs(height * size[1] - width * size[0]) <= max(height, width, *size),
        "masks",
        expected=f"the aspect of the clip, {format_size(size)}",
        got=format_size((height, width)),
    )
    window, found = aspect_window((height, width), size), {}
    for number in numbers:
        own = {
            k: cv2.resize(np.uint8(label[window] == number), size[::-1], interpolation=cv2.INTER_NEAREST) > 0
            for k, label in frames.items()
            if len(frames) == num_frames or (label == number).any()
        }
        if any(mask.any() for mask in own.values()):
            found[f"object {number}" if len(numbers) > 1 else "object"] = own
    return found


def _find_frame(file: Path, names: Sequence[str]) -> int:
    digits = re.search("[0-9]*$", file.stem)[0]
    return names.index(file.stem) if file.stem in names else int(digits or 0)


def _select_label(paths: list[Path], label: int | None, source: Path) -> Bool[np.ndarray, "num_frames height width"]:
    labels = read_labels(paths)
    present = sorted(set(np.unique(labels).tolist()) - {0, VOID})
    require(
        label is None or label in present,
        "label",
        expected=f"one of {present} in {str(source)!r}" if present else f"masks with objects in {str(source)!r}",
        got=label,
    )
    return (labels != 0) & (labels != VOID) if label is None else labels == label


# ----------------------------------------------------------------------------------------------- labels


def read_labels(paths: Sequence[Path]) -> UInt8[np.ndarray, "num_masks height width"]:
    """Label images: 0 is the background, k the object k, 255 void.

    A palette image gives the *index* of each pixel, whatever its color (OpenCV gives the color, hence Pillow here); a
    grayscale one its level, also where that is stored as three equal channels or with alpha, which is ignored. Masks
    that are all black and white, as those of DAVIS 2016, become 0 and 1. Raises ValueError for an image that does not
    decode, has colors or larger numbers instead of labels, or differs in size.
    """
    masks, modes = [], set()
    for path in paths:
        mask, mode = _read_label_image(path)
        modes.add(mode)
        shape = masks[0].shape if masks else mask.shape
        require(
            mask.shape == shape,
            "path",
            expected=f"masks of one size, {format_size(shape)} as in {paths[0].name!r}",
            got=f"{format_size(mask.shape)} in {str(path)!r}",
        )
        masks.append(mask)
    labels = np.stack(masks)
    values = np.unique(labels).tolist()
    if "P" not in modes and values[-1] >= VOID and set(values) <= {0, values[-1]}:
        return (labels > 0).astype(np.uint8)
    require(
        values[-1] <= VOID,
        "path",
        expected=f"masks with labels up to {VOID}",
        got=f"labels up to {values[-1]:,} in {str(paths[0].parent)!r}",
        cure="Renumber them, or store one object in black and white.",
    )
    return labels.astype(np.uint8)


def _read_label_image(path: Path) -> tuple[np.ndarray, str]:
    """(labels, Pillow mode) of one mask."""
    # Warnings are about damage: the image either decodes or raises.
    with warnings.catch_warnings(action="ignore"), open_image(path) as image:
        try:
            mode, pixels = image.mode, np.array(image)
        except Exception as error:  # Pillow's decoders raise anything
            raise undecodable_error(path) from error
    channels = _COLOR_MODES.get(mode)  # grayscale as paint programs store it, and one mask of bear in DAVIS
    if channels is not None and (pixels[..., :channels] == pixels[..., :1]).all():
        mode, pixels = "L", pixels[..., 0]
    require(
        mode in _LABEL_MODES,
        "path",
        expected="masks with a label per pixel (palette or grayscale)",
        got=f"an image of mode {mode!r} in {str(path)!r}",
        cure="Its colors were stored in place of the labels; use the original PNG.",
    )
    return pixels * np.uint8(VOID) if mode == "1" else pixels, mode
