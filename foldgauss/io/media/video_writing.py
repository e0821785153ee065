"""Writing clips: VP9 videos, animations, folders of images and single images."""

import os
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from foldgauss._runtime.checks import check_one_of
from foldgauss.io._atomic import OutputError, atomic_folder, atomic_path, check_path, check_replaceable, output_error
from foldgauss.io.media.clip import PathLike, check_fps, format_size, video_error
from foldgauss.io.media.opencv import silence_opencv

VIDEO_SUFFIXES = (".mp4", ".webm")  # what `write_video` encodes; reading accepts whatever OpenCV decodes
ANIMATION_SUFFIXES = (".gif", ".webp")
IMAGE_FORMATS = ("png", "webp")  # of folders of frames; both lossless
MAX_WEBP_SIDE = 16_383
MAX_GIF_FPS = 50.0  # browsers show frames of less than 2 hundredths of a second for 10
WEBP_QUALITY = 90  # of an animated WebP, in its encoder's own measure


def write_video(
    path: PathLike,
    frames: Iterable[np.ndarray],
    fps: float,
    *,
    overwrite: bool = False,
    image_format: str = "png",
) -> Path:
    """Write frames, uint8 RGB of shape (height, width, 3), and return the path. No partial file is left on errors.

    `.mp4` and `.webm` are VP9 (profile 0, 4:2:0: half the color resolution), which browsers play: OpenCV's wheel has no
    H.264 encoder. An odd height or width is padded by repeating its last row or column.

    `.gif` and `.webp` are animations that repeat forever, held in memory until the last frame. A GIF has a palette of
    256 colors for each frame and durations in hundredths of a second, rounded so that the total is kept; more than 50
    frames per second, which browsers slow down, are refused. An animated WebP has 4:2:0 at quality 90.

    A path without extension, or an existing folder, goes to `write_frames`, with `overwrite` and `image_format`; an
    existing *file* is replaced. `fps` is in (0, 1000].

    Raises `VideoError` for another extension, no frames, or frames of other shapes or types; `OutputError` where the
    path cannot be written.
    """
    path = check_path(path, "path, frames, fps")
    check_fps(fps)
    if not isinstance(frames, Iterable):
        cure = "For a model: model.frames()."
        raise video_error("frames", expected="an iterable of images", got=type(frames).__name__, cure=cure)
    check_one_of("image_format", image_format, IMAGE_FORMATS)
    if path.is_dir() or not path.suffix:
        return write_frames(path, frames, overwrite=overwrite, image_format=image_format)
    suffix = path.suffix.lower()
    if suffix in ANIMATION_SUFFIXES:
        return _write_animation(path, suffix, frames, float(fps))
    if suffix not in VIDEO_SUFFIXES:
        raise video_error(
            "path",
            expected="a name ending in .mp4, .webm, .gif or .webp, or a folder (no extension) for images",
            got=repr(path.name),
            cure="For one image: write_image." if suffix == ".png" else "Rename the output.",
        )
    # OpenCV prints a warning for every VP9 tag in WebM, but none in its superset Matroska, whose header is then
    # relabeled.
    with atomic_path(path, suffix=".mkv" if suffix == ".webm" else suffix) as temporary:
        num_frames = _encode(temporary, _check_frames(frames), float(fps))
        _check_written(temporary, num_frames, path)
        if suffix == ".webm":
            _relabel_as_webm(temporary)
    return path


def write_frames(
    folder: PathLike, frames: Iterable[np.ndarray], *, overwrite: bool = False, image_format: str = "png"
) -> Path:
    """Write frames, uint8 RGB of shape (height, width, 3), as 00000.png, 00001.png, ...; returns the folder.

    With `image_format="webp"` as 00000.webp and so on: lossless like PNG, and smaller. The folder appears whole or not
    at all. A folder that holds files is refused unless `overwrite`, and in any case if it holds anything but such
    numbered frames.

    Raises `VideoError` for no frames or frames of other shapes or types, `OutputError` where the folder is refused,
    ValueError for an unknown `image_format`.
    """
    check_one_of("image_format", image_format, IMAGE_FORMATS)
    folder, encode = Path(folder), _encode_png if image_format == "png" else _encode_webp
    check = partial(check_replaceable, folder, overwrite, pattern=r"[0-9]{5,}\.(png|webp)")
    check()
    with atomic_folder(folder, check=check) as temporary:
        for number, frame in enumerate(_check_frames(frames)):
            (temporary / f"{number:05d}.{image_format}").write_bytes(encode(frame))
    return folder


def write_image(path: PathLike, image: np.ndarray) -> Path:
    """Write one uint8 RGB image of shape (height, width, 3) as PNG, whole or not at all; returns the path.

    Raises `VideoError` for another extension or kind of array, `OutputError` where it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise video_error("path", expected="a name ending in .png", got=repr(path.name), cure="Rename the output.")
    data = _encode_png(_check_frame(image, None, "image"))
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return path


def _check_frames(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        frame = _check_frame(frame, shape, f"frames[{number}]")
        shape = frame.shape
        yield frame
    if shape is None:
        raise video_error("frames", expected="at least 1 frame", got="none")


def _check_frame(frame: np.ndarray, shape: tuple | None, parameter: str) -> np.ndarray:
    frame = np.asarray(frame)
    fits = frame.ndim == 3 and frame.shape[2] == 3 and min(frame.shape) > 0 and frame.dtype == np.uint8
    if not fits or (shape is not None and frame.shape != shape):
        raise video_error(
            parameter,
            expected=f"uint8 RGB of shape {shape or '(height, width, 3)'}",
            got=f"{frame.dtype} of shape {frame.shape}",
            cure="For floats in [0, 1]: np.rint(255 * np.clip(frame, 0, 1)).astype(np.uint8).",
        )
    return np.ascontiguousarray(frame)


def _encode_png(frame: np.ndarray) -> bytes:
    return cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))[1].tobytes()


def _encode_webp(frame: np.ndarray) -> bytes:
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101]  # above 100: lossless
    if max(frame.shape[:2]) > MAX_WEBP_SIDE:
        got = format_size(frame.shape)
        raise video_error("frames", expected=f"sides of at most {MAX_WEBP_SIDE:,} for WebP", got=got, cure="Take PNG.")
    return cv2.imencode(".webp", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), quality)[1].tobytes()


# ------------------------------------------------------------------------------------------- animations


def _write_animation(path: Path, suffix: str, frames: Iterable[np.ndarray], fps: float) -> Path:
    """Write an animated GIF or WebP that repeats forever."""
    if suffix == ".gif" and fps > MAX_GIF_FPS:
        raise video_error(
            "fps",
            expected=f"at most {MAX_GIF_FPS:g} for a GIF",
            got=f"{fps:g}",
            cure="Take fewer frames, or a .webp or .webm.",
        )
    with atomic_path(path) as temporary:
        images = [_to_pillow(frame, suffix) for frame in _check_frames(frames)]
        first, *rest = images
        shared = {"save_all": True, "append_images": rest, "loop": 0}
        try:
            if suffix == ".gif":
                first.save(temporary, "GIF", duration=_gif_durations(len(images), fps), optimize=False, **shared)
            else:
                first.save(temporary, "WEBP", duration=1000 / fps, quality=WEBP_QUALITY, **shared)
        except OSError as error:
            raise output_error(path, error) from error
        except (OverflowError, RuntimeError, ValueError) as error:
            expected, got = f"a size and a rate that {suffix} can hold", f"{first.height}x{first.width} at {fps:g} fps"
            raise video_error("frames", expected=expected, got=got, cure="Take an .mp4 or .webm.") from error
    return path


def _to_pillow(frame: np.ndarray, suffix: str) -> Image.Image:
    image = Image.fromarray(frame)
    return image.quantize(256) if suffix == ".gif" else image


def _gif_durations(num_frames: int, fps: float) -> list[int]:
    """Milliseconds of each frame, in whole hundredths of a second, whose sums are the true times rounded."""
    ends = np.rint(100 * np.arange(num_frames + 1) / fps).astype(int)
    return [10 * int(duration) for duration in np.diff(ends)]


# -------------------------------------------------------------------------------------------------- VP9


def _encode(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    """Encode in VP9 and return the number of frames; the extension of `path` selects the container."""
    code = cv2.VideoWriter.fourcc(*("vp09" if path.suffix.lower() == ".mp4" else "VP90"))
    writer, num_frames = None, 0
    with silence_opencv():
        try:
            for frame in frames:
                image = _prepare_for_encoder(frame)
                if writer is None:
                    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, image.shape[1::-1])
                if not writer.isOpened():
                    _check_room(path)
                    raise OutputError(
                        "path: expected an OpenCV with FFmpeg's VP9 encoder, got one without. "
                        "Install opencv-contrib-python-headless from PyPI, or write to a folder."
                    )
                writer.write(image)
                num_frames += 1
        finally:
            if writer is not None:
                writer.release()
    return num_frames


def _check_room(path: Path) -> None:
    """Raise the system's OSError where not even a few bytes can be written: OpenCV does not report the reason."""
    path.write_bytes(bytes(4096))
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def _prepare_for_encoder(frame: np.ndarray) -> np.ndarray:
    """RGB -> the BGR of even size that OpenCV's writer encodes with the least error."""
    image = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    if image.shape[0] % 2 or image.shape[1] % 2:
        # OpenCV would drop the odd row or column.
        image = cv2.copyMakeBorder(image, 0, image.shape[0] % 2, 0, image.shape[1] % 2, cv2.BORDER_REPLICATE)
    # FFmpeg's scaler, as OpenCV calls it, rounds both chroma planes down, which makes red and blue some 1.3 gray levels
    # too dark: add one level to each. cv2.add saturates.
    return cv2.add(image, (1, 0, 1, 0))


def _check_written(path: Path, num_frames: int, target: Path) -> None:
    """Count the frames that decode: OpenCV's writer reports no error, not even a full disk.

    The container's own count may be right in a truncated file. Decoding takes a few hundredths of the encoding time.
    """
    with silence_opencv():
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
        num_decoded = sum(1 for _ in iter(capture.grab, False))
        capture.release()
    if num_decoded != num_frames:
        raise OutputError(
            f"path: expected {num_frames} frames in {str(target)!r}, got {num_decoded}. "
            "The disk may be full, or a size limit reached."
        )


def _relabel_as_webm(path: Path) -> None:
    """Matroska with VP9 *is* WebM except for the DocType; EBML pads a shorter string with zeros."""
    with open(path, "r+b") as file:
        start = file.read(64).index(b"matroska")
        file.seek(start)
        file.write(b"webm\0\0\0\0")
