"""Frames from image files, folders of images and animations."""

import io
import mmap
import re
import warnings
from collections.abc import Callable, Iterator, Sized
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from PIL import Image

from foldgauss._runtime.checks import require
from foldgauss.io.media.clip import (
    MAX_PIXELS,
    ClipFacts,
    VideoError,
    check_decoded,
    clamp_stop,
    format_num_bytes,
    format_size,
    video_error,
)
from foldgauss.io.media.frame_rate import DEFAULT_FPS

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
GIF_DELAY = 100.0  # milliseconds for which browsers show a frame that has no duration of its own
MAX_FRAMES = 1_000_000  # of an animation
FORMATS = ("PNG", "GIF", "JPEG", "TIFF", "BMP", "WEBP")
#: First bytes of all but WebP.
_MAGIC = (b"\x89PNG\r\n\x1a\n", b"GIF8", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"BM")
#: Most pixels that a byte of a file can hold: the largest ratio of deflate at one bit per pixel, a bit per 8x8 block.
_PIXELS_PER_BYTE = {"PNG": 8 * 1032, "JPEG": 8 * 64}
#: OpenCV's LOG_LEVEL_SILENT, which has no name up to OpenCV 4.
_LOG_LEVEL_SILENT = 0
#: Tag of a TIFF: bits per sample.
_BITS = 258
#: Tag of a TIFF: the kinds of further samples.
_EXTRA_SAMPLES = 338


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
    require(
        images,
        "path",
        expected="a folder with images (" + ", ".join(s[1:] for s in IMAGE_SUFFIXES) + ")",
        got=f"{str(folder)!r} without any",
        cure="Give the folder that holds the frames, or a video file.",
        kind=VideoError,
    )
    return images[start : clamp_stop(start, stop, len(images), folder)]


def image_paths(folder: Path) -> list[Path]:
    """The images in `folder` in the order in which `read_video` reads them."""
    visible = (entry for entry in folder.iterdir() if not entry.name.startswith("."))
    images = (entry for entry in visible if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file())
    return sorted(images, key=lambda entry: natural_sort_key(entry.name))


def natural_sort_key(name: str) -> tuple:
    """Sort key by which runs of digits compare as numbers; the name itself breaks ties (1.png, 01.png)."""
    parts = re.split(r"([0-9]+)", name.lower())
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], name


def scan_folder(
    folder: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], Sized]
) -> tuple[Sized, ClipFacts]:
    """What `keep` makes of the images of a folder from `start` up to `stop`, and the facts."""
    names = [path.name for path in choose_images(folder, 0, None)]
    end = clamp_stop(start, stop, len(names), folder)
    kept = keep(read_images([folder / name for name in names[start:end]]))
    return kept, ClipFacts("folder", DEFAULT_FPS, len(names), np.arange(end), 1 / DEFAULT_FPS, names=names)


# ----------------------------------------------------------------------------------------- single images


def is_image(head: bytes) -> bool:
    """Whether these first bytes are those of an image or an animation."""
    return head.startswith(_MAGIC) or (head[:4] == b"RIFF" and head[8:12] == b"WEBP")


def is_bare_jpegs(path: Path, head: bytes) -> bool:
    """Whether one JPEG directly follows another: a video without container, which image decoders see as one image.

    Additional images of a camera, such as another exposure or a stereo view, are announced by "MPF" in the header, or
    stand in a file that is called an image.
    """
    is_called_image = path.suffix.lower() in IMAGE_SUFFIXES
    if is_called_image or not head.startswith(b"\xff\xd8\xff") or b"MPF\0" in head:
        return False
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.find(b"\xff\xd9\xff\xd8\xff") >= 0


def read_images(paths: list[Path]) -> Iterator[np.ndarray]:
    """Images of one size."""
    first_shape = None
    for path in paths:
        image = read_image(path)
        first_shape = first_shape or image.shape[:2]
        require(
            image.shape[:2] == first_shape,
            "path",
            expected=f"images of one size, {format_size(first_shape)} as in {paths[0].name!r}",
            got=f"{format_size(image.shape)} in {path.name!r}",
            cure="Resize the images, or choose others with frames=(A, B).",
            kind=VideoError,
        )
        yield image


def open_image(path: Path, file: BinaryIO | None = None) -> Image.Image:
    """An image, or an animation, whose header is read; `file`: its content, where that is in memory.

    Raises `VideoError` where the header claims more pixels than are accepted, or than the file can hold.
    """
    try:
        image = Image.open(file or path, formats=FORMATS)
    except Image.DecompressionBombError as error:
        raise video_error(
            "path",
            expected=f"images of at most {MAX_PIXELS:,} pixels",
            got=f"more in the header of {str(path)!r}",
            cure="The file is damaged, or must be scaled down first.",
        ) from error
    except Exception as error:  # Pillow's decoders raise anything
        raise undecodable_error(path) from error
    most = _PIXELS_PER_BYTE.get(image.format)
    if most is not None and image.width * image.height >= most * (path.stat().st_size + 1):
        image.close()
        raise undecodable_error(path)
    return image


def read_image(path: Path) -> np.ndarray:
    """One image as uint8 BGR, shape (height, width, 3), or premultiplied BGRA, (height, width, 4), if any pixel is
    transparent."""
    data = path.read_bytes()
    # The rest of an image that does not decode is None, or raises anything.
    with silence_opencv(), warnings.catch_warnings(action="ignore"), open_image(path, io.BytesIO(data)) as header:
        tags = getattr(header, "tag_v2", {})
        is_transparent_gray = header.mode in ("1", "L") and "transparency" in header.info
        try:
            if header.mode in ("La", "LA") or is_transparent_gray:  # OpenCV drops this alpha
                return premultiply(np.asarray(header.convert("LA").convert("RGBA")))
            # UNCHANGED keeps a fourth channel; JPEG has none, and COLOR also applies its orientation.
            flags = cv2.IMREAD_COLOR if header.format in ("JPEG", "MPO") else cv2.IMREAD_UNCHANGED
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except Exception as error:
            raise undecodable_error(path) from error
    if image is None:
        raise undecodable_error(path)
    if image.dtype == np.uint16:
        image = to_8_bits(image)
    require(
        image.dtype == np.uint8,
        "path",
        expected="images of 8 or 16 bits",
        got=f"{image.dtype} in {str(path)!r}",
        cure="Convert it to an 8-bit PNG.",
        kind=VideoError,
    )
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    # OpenCV returns colors times alpha for a TIFF that declares it, unless it is straight and of 16 bits.
    extra = tags.get(_EXTRA_SAMPLES)
    is_premultiplied = extra == (1,) or (extra == (2,) and tags.get(_BITS, (8,))[0] == 8)
    return drop_opaque(image) if is_premultiplied else premultiply(image)


def to_8_bits(image: np.ndarray) -> np.ndarray:
    """uint8 from uint16, to nearest."""
    return ((image.astype(np.uint32) * 255 + 32767) // 65535).astype(np.uint8)


def drop_opaque(image: np.ndarray) -> np.ndarray:
    """The image, without its alpha where that is opaque."""
    is_opaque = image.shape[2] == 3 or image[..., 3].min() == 255
    return np.ascontiguousarray(image[..., :3]) if is_opaque else image


def premultiply(image: np.ndarray) -> np.ndarray:
    """Colors times alpha, to nearest, so that those of transparent pixels have no effect; opaque alpha is dropped."""
    image = drop_opaque(image)
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:].astype(np.uint16)
    return np.concatenate([((image[..., :3] * alpha + 127) // 255).astype(np.uint8), image[..., 3:]], axis=-1)


def undecodable_error(path: Path) -> VideoError:
    got = f"{str(path)!r} ({format_num_bytes(path)}), which does not"
    return video_error("path", expected="images that decode", got=got, cure="Replace or remove it.")


# -------------------------------------------------------------------------------------------- animations


def scan_picture(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], Sized]
) -> tuple[Sized, ClipFacts]:
    """What `keep` makes of an image, or of the frames of an animation from `start` up to `stop`, and the facts.

    Animations are read with Pillow: no decoder in FFmpeg keeps both their alpha and their times.
    """
    with warnings.catch_warnings(action="ignore"), open_image(path) as image:
        num = 0  # of images; unknown in a damaged GIF, whose frames are counted by reading them
        with suppress(Exception):
            num = getattr(image, "n_frames", 1)
        require(
            image.format != "TIFF" or num <= 1,
            "path",
            expected="one image in a TIFF",
            got=f"{num} in {str(path)!r}",
            cure="Unpack it to a folder of images.",
            kind=VideoError,
        )
        if image.format == "GIF" or (image.format in ("PNG", "WEBP") and num > 1):
            return _scan_animation(image, num, path, start, stop, keep)
    clamp_stop(start, stop, 1, path)
    kept = keep(read_images([path]))
    return kept, ClipFacts("pictures", DEFAULT_FPS, 1, np.zeros(1, np.int64), 1.0)


def _scan_animation(animation, num_declared, path, start, stop, keep) -> tuple[Sized, ClipFacts]:
    delays: list[float] = []
    kept = keep(_decode_animation(animation, start, min(num_declared or MAX_FRAMES, stop or MAX_FRAMES), delays))
    if not delays:
        raise undecodable_error(path)
    num_total = num_declared or len(delays) + (len(delays) < (stop or MAX_FRAMES))
    check_decoded(len(kept), start, stop, len(delays), num_total, path)
    ends = np.rint(1000 * np.cumsum([0, *delays])).astype(np.int64)  # microseconds
    return kept, ClipFacts("pictures", None, num_total, ends[:-1], 1e-6, end=float(ends[-1]) * 1e-6)


def _decode_animation(animation: Image.Image, start: int, stop: int, delays: list[float]) -> Iterator[np.ndarray]:
    """The frames from `start` up to `stop`, or to damage; `delays` receives those of the frames before, too."""
    size = animation.size
    for number in range(stop):
        try:
            animation.seek(number)
            animation.load()
            rgba = np.asarray(animation.convert("RGBA")) if number >= start else None
        except MemoryError:
            raise
        except Exception:
            return
        if animation.size != size:  # Pillow lets a damaged frame enlarge the image
            return
        delays.append(animation.info.get("duration") or GIF_DELAY)
        if rgba is not None:
            yield premultiply(cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
