"""Writing clips: videos, animations, folders of images and single images."""

import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import av
import cv2
import numpy as np
from PIL import Image

from foldgauss._runtime.checks import check_one_of, short_repr
from foldgauss.io._atomic import PathLike, atomic_folder, atomic_path, check_path, output_error
from foldgauss.io.media.clip import check_fps, format_size, video_error
from foldgauss.io.media.encoder import VIDEO_SUFFIXES, Sound, check_sound, choose_encoding, encode_video, straighten
from foldgauss.io.media.frame_rate import MAX_SECONDS, are_rising_seconds, count_ticks

ANIMATION_SUFFIXES = (".gif", ".webp")
IMAGE_FORMATS = ("png", "webp")  # of folders of frames; both lossless
#: Pattern of the names of the files in them.
FRAME_NAMES = r"[0-9]{5,}\.(png|webp)"
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
    codec: str | None = None,
    crf: int | None = None,
    pixel_format: str | None = None,
    sound: Sound | None = None,
    times: Sequence[float] | None = None,
) -> Path:
    """Write frames, uint8 RGB of shape (height, width, 3), and return the path. No partial file is left on errors.

    The extension selects the container, and unless `codec` is given the codec: `.mp4` H.264, which plays everywhere,
    `.webm` VP9, `.mov` ProRes, `.mkv` FFV1, which is lossless. `codec` is "h264", "h265", "av1", "vp9", "prores" or
    "ffv1". `crf` is the constant rate factor: a smaller one makes better and larger files; 16 by default for H.264.
    `pixel_format` is FFmpeg's name; by default "yuv420p" (half the color resolution) except for ProRes and FFV1. An odd
    height or width is then padded by repeating its last row or column. Colors are those of BT.709, and the file says
    so. An MP4 can be played while it is loaded (faststart).

    `times`: seconds at which the frames are shown, rising from 0, such as `Clip.times`, and if there is one more, the
    end, such as `Clip.duration`; otherwise the last frame is shown for 1 / fps. By default frames are evenly spaced. A
    folder of images holds no times.

    `sound`: that of another file, as `Sound("clip.mp4", start=2.0, speed=0.5)`; stored as AAC, in .webm as Opus.

    Frames with alpha, shape (height, width, 4) with colors premultiplied as in `Clip`, go to "vp9" in .webm or .mkv,
    "prores" and "ffv1".

    `.gif` and `.webp` are animations that repeat forever, held in memory until the last frame. A GIF has a palette of
    256 colors for each frame and durations in hundredths of a second, rounded so that the total is kept; more than 50
    frames per second, which browsers slow down, are refused. An animated WebP has 4:2:0 at quality 90.

    A path without extension, or an existing folder, goes to `write_frames`, with `overwrite` and `image_format`; an
    existing *file* is replaced. `fps` is in [1e-5, 1000].

    Raises `VideoError` for another extension, no frames, or frames of other shapes or types, or which the codec does
    not take; ValueError for options that do not fit together; `OutputError` where the path cannot be written.
    """
    path = check_path(path, "path, frames, fps")
    check_fps(fps)
    if not isinstance(frames, Iterable):
        cure = "For a model: model.frames()."
        raise video_error("frames", expected="an iterable of images", got=type(frames).__name__, cure=cure)
    check_one_of("image_format", image_format, IMAGE_FORMATS)
    if times is not None:
        if not are_rising_seconds(times):
            expected = f"seconds that rise from 0 to at most {MAX_SECONDS:,.0f}, one for each frame"
            raise video_error("times", expected=expected, got=short_repr(times))
        times = np.array(times, np.float64)
        frames = _match_times(frames, len(times))
    suffix = path.suffix.lower()
    options = {"codec": codec, "crf": crf, "pixel_format": pixel_format, "sound": sound}
    given = [name for name, value in options.items() if value is not None]
    if given and suffix not in VIDEO_SUFFIXES:
        got, cure = repr(path.name), f"Take {', '.join(VIDEO_SUFFIXES)}."
        raise video_error(given[0], expected="a video file for it", got=got, cure=cure)
    if os.path.isdir(path) or not path.suffix:  # not Path's, which raises for a name that is too long
        return write_frames(path, frames, overwrite=overwrite, image_format=image_format)
    if suffix in ANIMATION_SUFFIXES:
        return _write_animation(path, suffix, frames, float(fps), times)
    if suffix not in VIDEO_SUFFIXES:
        expected = "a name ending in .mp4, .webm, .mov, .mkv, .gif or .webp, or a folder (no extension) for images"
        cure = "For one image: write_image." if suffix == ".png" else "Rename the output."
        raise video_error("path", expected=expected, got=repr(path.name), cure=cure)
    frames = _check_frames(frames)
    first = next(frames)
    encoding = choose_encoding(suffix, codec, crf, pixel_format, first.shape)
    if sound is not None:
        check_sound(sound)
    with atomic_path(path) as temporary:
        try:
            encode_video(temporary, chain([first], frames), float(fps), encoding, sound, times)
        except av.FFmpegError as error:  # an OSError of making the frames is none of these
            if isinstance(error, OSError):
                raise output_error(path, error) from error
            expected, got = f"frames that {encoding.codec.encoder} takes", f"{format_size(first.shape)} at {fps:g} fps"
            cure = f"It says: {error.strerror}. Take another size, rate or codec."
            raise video_error("frames", expected=expected, got=got, cure=cure) from error
    return path


def write_frames(
    folder: PathLike, frames: Iterable[np.ndarray], *, overwrite: bool = False, image_format: str = "png"
) -> Path:
    """Write frames as 00000.png, 00001.png, ...; returns the folder.

    Frames are uint8 RGB of shape (height, width, 3), or premultiplied RGBA of shape (height, width, 4).

    With `image_format="webp"` as 00000.webp and so on: lossless like PNG, and smaller. The folder appears whole or not
    at all. A folder that holds files is refused unless `overwrite`, and in any case if it holds anything but such
    numbered frames.

    Raises `VideoError` for no frames or frames of other shapes or types, `OutputError` where the folder is refused,
    ValueError for an unknown `image_format`.
    """
    check_one_of("image_format", image_format, IMAGE_FORMATS)
    folder = Path(folder)
    with atomic_folder(folder, overwrite, pattern=FRAME_NAMES) as temporary:
        for number, frame in enumerate(_check_frames(frames)):
            (temporary / f"{number:05d}.{image_format}").write_bytes(_encode_image(frame, image_format))
    return folder


def write_image(path: PathLike, image: np.ndarray) -> Path:
    """Write one image as PNG, whole or not at all; returns the path.

    It is uint8 RGB of shape (height, width, 3), or premultiplied RGBA of shape (height, width, 4).

    Raises `VideoError` for another extension or kind of array, `OutputError` where it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise video_error("path", expected="a name ending in .png", got=repr(path.name), cure="Rename the output.")
    data = _encode_image(_check_frame(image, None, "image"))
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return path


def _match_times(frames: Iterable[np.ndarray], num: int) -> Iterator[np.ndarray]:
    """The frames. Raises `VideoError` unless there are as many as times, `num`, or one fewer: the last is the end."""
    count = 0
    for frame in frames:
        count += 1
        if count > num:
            break
        yield frame
    if not num - 1 <= count <= num:
        got = f"more than {num}" if count > num else f"{count}"
        raise video_error("frames", expected=f"{num}, as many as times, or one fewer", got=got)


def _check_frames(frames: Iterable[np.ndarray], channels: tuple[int, ...] = (3, 4)) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        frame = _check_frame(frame, shape, f"frames[{number}]", channels)
        shape = frame.shape
        yield frame
    if shape is None:
        raise video_error("frames", expected="at least 1 frame", got="none")


def _check_frame(frame: np.ndarray, shape: tuple | None, parameter: str, channels=(3, 4)) -> np.ndarray:
    frame = np.asarray(frame)
    fits = frame.ndim == 3 and frame.shape[2] in channels and min(frame.shape) > 0 and frame.dtype == np.uint8
    if not fits or (shape is not None and frame.shape != shape):
        cure = ""
        if frame.dtype != np.uint8:
            cure = "For floats in [0, 1]: np.rint(255 * np.clip(frame, 0, 1)).astype(np.uint8)."
        elif frame.ndim == 3 and frame.shape[2] == 4:
            cure = "Composite it over a color, or take a kind of file that has alpha: .webm, .mov, .mkv or images."
        expected, got = f"uint8 RGB of shape {shape or '(height, width, 3)'}", f"{frame.dtype} of shape {frame.shape}"
        raise video_error(parameter, expected=expected, got=got, cure=cure)
    return np.ascontiguousarray(frame)


def _encode_image(frame: np.ndarray, image_format: str = "png") -> bytes:
    """Without loss; with alpha, colors become straight."""
    if image_format == "webp" and max(frame.shape[:2]) > MAX_WEBP_SIDE:
        got = format_size(frame.shape)
        raise video_error("frames", expected=f"sides of at most {MAX_WEBP_SIDE:,} for WebP", got=got, cure="Take PNG.")
    rgba = frame.shape[2] == 4
    image = cv2.cvtColor(straighten(frame), cv2.COLOR_RGBA2BGRA) if rgba else cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101] if image_format == "webp" else []  # above 100: lossless
    return cv2.imencode(f".{image_format}", image, quality)[1].tobytes()


# ------------------------------------------------------------------------------------------- animations


def _write_animation(
    path: Path, suffix: str, frames: Iterable[np.ndarray], fps: float, times: np.ndarray | None
) -> Path:
    """Write an animated GIF or WebP that repeats forever."""
    if suffix == ".gif" and fps > MAX_GIF_FPS:
        expected, cure = f"at most {MAX_GIF_FPS:g} for a GIF", "Take fewer frames, or a .webp or .webm."
        raise video_error("fps", expected=expected, got=f"{fps:g}", cure=cure)
    with atomic_path(path) as temporary:
        images = map(Image.fromarray, _check_frames(frames, channels=(3,)))
        first, *rest = (image.quantize(256) for image in images) if suffix == ".gif" else images
        shared = {"save_all": True, "append_images": rest, "loop": 0}
        ends = np.arange(len(rest) + 2) / fps
        if times is not None:
            ends = np.append(times, times[-1] + 1 / fps)[: len(ends)]
        try:
            if suffix == ".gif":
                # Milliseconds, in whole hundredths of a second, whose sums are the true times rounded.
                durations = (10 * np.diff(count_ticks(100 * ends, least=2))).tolist()
                first.save(temporary, "GIF", duration=durations, optimize=False, **shared)
            else:
                durations = 1000 / fps if times is None else np.diff(count_ticks(1000 * ends)).tolist()
                first.save(temporary, "WEBP", duration=durations, quality=WEBP_QUALITY, **shared)
        except OSError as error:
            raise output_error(path, error) from error
        except (OverflowError, RuntimeError, ValueError) as error:
            longest, expected = np.diff(ends).max(), f"a size and times that {suffix} can hold"
            got = f"{first.height}x{first.width}, shown for up to {longest:g} s"
            raise video_error("frames", expected=expected, got=got, cure="Take an .mp4 or .webm.") from error
    return path
