"""Frames from image files, folders of images and animations."""

import mmap
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from foldgauss.io.media.clip import (
    Levels,
    ReadResult,
    VideoError,
    check_num_pixels,
    clamp_stop,
    describe_lost,
    format_num_bytes,
    format_size,
    no_frames_error,
    read_head,
    video_error,
)
from foldgauss.io.media.format_detection import is_image_format, min_file_bytes, parse_image_size
from foldgauss.io.media.frame_rate import estimate_rate

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
GIF_DELAY = 100.0  # milliseconds for which browsers show a frame that has no duration of its own
MAX_FRAMES = 1_000_000  # of an animation
#: OpenCV's LOG_LEVEL_SILENT, which has no name up to OpenCV 4.
_LOG_LEVEL_SILENT = 0
_WIDTH, _HEIGHT, _BITS, _EXTRA_SAMPLES = 256, 257, 258, 338  # tags of a TIFF


@contextmanager
def silence_opencv() -> Iterator[None]:
    """Silence OpenCV's log; the level is per process, so it is restored."""
    logging = getattr(cv2.utils, "logging", cv2)  # cv2 itself: up to OpenCV 4
    level = logging.getLogLevel()
    logging.setLogLevel(_LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)


# ---------------------------------------------------------------------------------------------- folders


def choose_images(folder: Path, start: int, stop: int | None) -> list[Path]:
    """The images of a folder from `start` up to `stop`. Raises `VideoError` where there are none."""
    images = image_paths(folder)
    if not images:
        expected = "a folder with images (" + ", ".join(s[1:] for s in IMAGE_SUFFIXES) + ")"
        got, cure = f"{str(folder)!r} without any", "Give the folder that holds the frames, or a video file."
        raise video_error("path", expected=expected, got=got, cure=cure)
    return images[start : clamp_stop(start, stop, len(images), folder)]


def image_paths(folder: Path) -> list[Path]:
    """The images in `folder` in the order in which `read_video` reads them."""
    visible = (entry for entry in folder.iterdir() if not entry.name.startswith("."))
    images = (entry for entry in visible if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file())
    return sorted(images, key=lambda entry: natural_sort_key(entry.name))


def describe_missing(images: list[Path]) -> tuple[str, ...]:
    """A note if numbers are missing in the names of a sequence, such as f7.png, f8.png, f10.png.

    Names of a sequence differ in their last number only.
    """
    parts = [re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", image.stem, re.DOTALL) for image in images]
    if len(images) < 3 or not all(parts) or len({part.group(1, 3) for part in parts}) > 1:
        return ()
    steps = np.diff(np.array([int(part[2]) for part in parts], object))  # of any size
    usual = min(steps)
    if usual < 1 or (steps == usual).sum() < len(steps) / 2 or (steps % usual).any():
        return ()  # not a sequence
    first, num = int(np.argmax(steps > usual)), int((steps // usual - 1).sum())
    if not 0 < num <= len(images):  # with more, the numbers are dates, or images were picked
        return ()
    what = "1 number is" if num == 1 else f"{num:,} numbers are"
    where = f"the first after {images[first].name}"
    return (f"{what} missing in the names, {where}; frames are taken to be evenly spaced.",)


def natural_sort_key(name: str) -> tuple:
    """Sort key by which runs of digits compare as numbers; the name itself breaks ties (1.png, 01.png)."""
    parts = re.split(r"([0-9]+)", name.lower())
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], name


# ----------------------------------------------------------------------------------------- single images


def is_image_file(path: Path) -> bool:
    """Whether a file is one image, by its content."""
    head, known_suffix = read_head(path), path.suffix.lower() in IMAGE_SUFFIXES
    if not known_suffix and not is_image_format(head):
        return False
    with silence_opencv():
        num_images = cv2.imcount(str(path))
    if num_images > 1 and head.startswith((b"II*\0", b"MM\0*")):  # OpenCV's video decoder sees only the first
        got = f"{num_images} in {str(path)!r}"
        raise video_error("path", expected="one image in a TIFF", got=got, cure="Unpack it to a folder of images.")
    if not known_suffix and _is_jpeg_sequence(path, head):
        got = f"a bare sequence of JPEGs, {str(path)!r}"
        cure = "Put it into a container: ffmpeg -i VIDEO -c copy NEW.avi."
        raise video_error("path", expected="a video in a container", got=got, cure=cure)
    return num_images == 1


def _is_jpeg_sequence(path: Path, head: bytes) -> bool:
    """Whether one JPEG directly follows another: a video without container, which OpenCV does not open.

    Additional images of a camera, such as another exposure or a stereo view, are announced by "MPF" in the header.
    """
    if not head.startswith(b"\xff\xd8\xff") or b"MPF\0" in head:
        return False
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.find(b"\xff\xd9\xff\xd8\xff") >= 0


def read_images(paths: list[Path], levels: Levels) -> Iterator[np.ndarray]:
    """Images of one size."""
    first_shape = None
    for path in paths:
        image = read_image(path, levels)
        first_shape = first_shape or image.shape[:2]
        if image.shape[:2] != first_shape:
            expected = f"images of one size, {format_size(first_shape)} as in {paths[0].name!r}"
            got = f"{format_size(image.shape)} in {path.name!r}"
            cure = "Resize the images, or choose others with frames=(A, B)."
            raise video_error("path", expected=expected, got=got, cure=cure)
        yield image


def read_image(path: Path, levels: Levels) -> np.ndarray:
    """One image as uint8 BGR, shape (height, width, 3), or premultiplied BGRA, (height, width, 4).

    `levels` converts those of 16 bits, and then records their largest value.
    """
    head = read_head(path)
    tags = _check_image_header(path, head)
    # UNCHANGED keeps a fourth channel; JPEG has none, and COLOR also applies its orientation.
    flags = cv2.IMREAD_COLOR if head.startswith(b"\xff\xd8") else cv2.IMREAD_UNCHANGED
    with silence_opencv():
        try:
            image = cv2.imread(str(path), flags)
        except cv2.error:  # an absurd size in the header
            image = None
    if image is None:
        raise _undecodable_error(path)
    if image.dtype == np.uint16:
        image = levels.convert(image)
    if image.dtype != np.uint8:
        got, cure = f"{image.dtype} in {str(path)!r}", "Convert it to an 8-bit PNG."
        raise video_error("path", expected="images of 8 or 16 bits", got=got, cure=cure)
    if image.ndim == 2:
        with_alpha = _read_gray_with_alpha(path)
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if with_alpha is None else with_alpha
    # OpenCV returns colors times alpha for a TIFF that declares it, unless it is straight and of 16 bits.
    extra = tags.get(_EXTRA_SAMPLES)
    is_premultiplied = extra == [1] or (extra == [2] and tags.get(_BITS, [8])[0] == 8)
    return image if image.shape[2] == 3 or is_premultiplied else premultiply(image)


def _read_gray_with_alpha(path: Path) -> np.ndarray | None:
    """Premultiplied BGRA of a gray PNG or TIFF with alpha, which OpenCV drops; None without alpha, or of 16 bits, which
    Pillow cannot read with alpha."""
    with (
        suppress(Exception),  # Pillow's decoders raise anything
        warnings.catch_warnings(action="ignore"),
        Image.open(path, formats=("PNG", "TIFF")) as image,
    ):
        if image.mode in ("La", "LA") or (image.mode in ("1", "L") and "transparency" in image.info):
            return premultiply(np.asarray(image.convert("LA").convert("RGBA")))
    return None


def _read_tiff_tags(path: Path) -> dict[int, list[int]]:
    """What the first directory of a TIFF says of size, bits and alpha; empty for other files."""
    with suppress(Exception), warnings.catch_warnings(action="ignore"), open(path, "rb") as file:
        head = file.read(8)
        directory = ImageFileDirectory_v2(head if head[2:3] != b"+" else head + file.read(8))  # "+": BigTIFF
        file.seek(directory.next)
        directory.load(file)
        known = [tag for tag in (_WIDTH, _HEIGHT, _BITS, _EXTRA_SAMPLES) if tag in directory]
        return {tag: np.ravel(directory[tag]).astype(int).tolist() for tag in known}
    return {}


def premultiply(image: np.ndarray) -> np.ndarray:
    """Colors times alpha, to nearest, so that the colors of transparent pixels have no effect."""
    alpha = image[..., 3:].astype(np.uint16)
    return np.concatenate([((image[..., :3] * alpha + 127) // 255).astype(np.uint8), image[..., 3:]], axis=-1)


def _check_image_header(path: Path, head: bytes) -> dict[int, list[int]]:
    """Raise for an image whose header claims more pixels than are accepted, or than its bytes can hold; returns the
    tags of a TIFF."""
    tags = _read_tiff_tags(path)
    if {_HEIGHT, _WIDTH} <= tags.keys():
        size = tags[_HEIGHT][0], tags[_WIDTH][0]
    else:  # the size of a JPEG may follow any number of bytes about the camera
        size = parse_image_size(path.read_bytes() if head.startswith(b"\xff\xd8") else head)
    check_num_pixels(path, size)
    if size is not None and path.stat().st_size < min_file_bytes(head, size):
        raise _undecodable_error(path)
    return tags


def _undecodable_error(path: Path) -> VideoError:
    got = f"{str(path)!r} ({format_num_bytes(path)}), which does not"
    return video_error("path", expected="images that decode", got=got, cure="Replace or remove it.")


# ------------------------------------------------------------------------------------------- animations


def read_animation(path: Path, start: int, stop: int | None, keep: Callable) -> ReadResult | None:
    """The frames of a GIF, PNG or WebP with their alpha and times, which no decoder in FFmpeg keeps both.

    None for a PNG or WebP that is not animated: it is left to the image decoder, which keeps 16 bits.
    """
    _check_image_header(path, read_head(path))
    delays, num_declared = [], 0
    with warnings.catch_warnings(action="ignore"):
        try:
            animation = Image.open(path, formats=("GIF", "PNG", "WEBP"))
        except Exception as error:
            raise _undecodable_error(path) from error
        with animation:
            if animation.format != "GIF" and not getattr(animation, "is_animated", False):
                return None
            with suppress(Exception):  # a damaged GIF, whose frames are counted by reading them
                num_declared = animation.n_frames
            num = min(num_declared or MAX_FRAMES, stop or MAX_FRAMES)
            kept = keep(_decode_animation(animation, start, num, delays))
    if not delays:
        raise _undecodable_error(path)
    num_total = num_declared or len(delays) + (len(delays) < (stop or MAX_FRAMES))
    stop = clamp_stop(start, stop, num_total, path)
    if not kept:
        raise no_frames_error(start, stop, len(delays), num_total, path)
    shown = np.cumsum([0, *delays[start:]]) / 1000
    rate = estimate_rate(shown[:-1], (len(shown) - 1) / shown[-1], float(shown[-1]))
    num = stop - start
    return kept, num, rate, describe_lost(len(kept), num)


def _decode_animation(animation: Image.Image, start: int, stop: int, delays: list[float]) -> Iterator[np.ndarray]:
    """The frames from `start` up to `stop`, or to damage; `delays` receives those of the frames before, too."""
    size = None
    for number in range(stop):
        try:
            animation.seek(number)
            animation.load()
            rgba = np.asarray(animation.convert("RGBA")) if number >= start else None
        except MemoryError:
            raise
        except Exception:
            return
        size = size or animation.size
        if animation.size != size:  # Pillow lets a damaged frame enlarge the image
            return
        delays.append(animation.info.get("duration") or GIF_DELAY)
        if rgba is not None:
            yield premultiply(cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
