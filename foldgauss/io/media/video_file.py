"""Clips from video files and folders of images, and back: the one place where pixels meet the disk."""

import math
import mmap
import os
import re
import struct
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count, islice, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from foldgauss._runtime.checks import check_one_of, invalid, is_within
from foldgauss.io._atomic import OutputError, atomic_folder, atomic_path, check_replaceable, checked_path, not_writable
from foldgauss.io.media.containers import (
    FORMATS,
    HEAD_BYTES,
    LIST,
    claimed_size,
    counts_frames,
    fewest_bytes,
    has_alpha_beside,
    is_image,
    kind_of,
    may_move,
    shown_seconds,
    tells_duration,
)
from foldgauss.io.media.rates import FrameRate, pace_of, promised, risen

# FFmpeg writes to stderr about every damaged packet; our errors say it in one line. OpenCV reads this
# variable when it first opens a video, so it stands before the import. -8 is AV_LOG_QUIET.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
import cv2
from PIL import Image

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (".mp4", ".webm")  # what `write_video` makes; reading takes whatever OpenCV decodes
ANIMATION_SUFFIXES = (".gif", ".webp")
IMAGE_FORMATS = ("png", "webp")  # of folders of frames; both exact
MAX_WEBP_SIDE = 16_383
MAX_GIF_FPS = 50.0  # frames of less than 2 hundredths of a second are shown for 10 by browsers
WEBP_QUALITY = 90  # of an animated WebP, in its encoder's own measure
DEFAULT_FPS = 25.0  # of a folder of images, and of a container that gives no usable rate
MAX_FPS = 1000.0  # a container's time stamps are milliseconds
MAX_PIXELS = 1 << 28  # of one picture, 16384x16384: a header may claim any size
MISSES = 1000  # after so many times without a frame a video is over: damage is passed by, at its end it is instant
MOST_LOST = 1_000_000  # frames; what a damaged time stamp says beyond that is not believed
GIF_DELAY = 100.0  # milliseconds that browsers show a frame for that says nothing of its own

Range = tuple[int | None, int | None]
PathLike = str | os.PathLike


class VideoError(ValueError):
    """A clip cannot be read or written as asked; the message is one line: expected, got, cure."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames in memory.

    `frames`: uint8 RGB, shape (num_frames, height, width, 3), C-contiguous; of images with alpha RGBA, shape
    (num_frames, height, width, 4), the colour premultiplied by alpha: what is seen over black. `fps`: frames per
    second. `source`: the path as given. `num_declared`: frames that the container promised within the range asked
    for; larger than `num_frames` where a damaged file breaks off ("N of M frames decode"). `times`: when each
    frame is shown, float64 (num_frames,), in seconds from the first; None where that is evenly, at `fps`. Else `fps` is
    their mean rate. `notes`: what else there is to know of how the file was read, a line each.
    """

    frames: np.ndarray
    fps: float
    source: str
    num_declared: int
    times: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    @property
    def has_alpha(self) -> bool:
        return self.frames.shape[3] == 4

    @property
    def over_black(self) -> np.ndarray:
        """The frames without alpha, as seen over black: uint8 (num_frames, height, width, 3)."""
        return np.ascontiguousarray(self.frames[..., :3])

    @property
    def num_frames(self) -> int:
        return self.frames.shape[0]

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.frames.shape[1], self.frames.shape[2]


# ---------------------------------------------------------------------------------------------- reading


def read_video(
    path: PathLike,
    *,
    frames: Range | None = None,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    center_crop: tuple[int, int] | None = None,
) -> Clip:
    """Read a video file, a folder of images in natural order (img2 before img10), or one image: a clip of one frame.

    `frames = (A, B)` keeps frames A <= i < B, None for an open end. `size = (height, width)` cuts each
    frame to that aspect around its centre (to whole pixels), then resizes it, by area where it shrinks and
    by cubic interpolation where it grows: (160, 320) of a 1280x720 clip is rows 40 to 680. `fps` overrides
    the rate of the container (25 for images). `center_crop = (height, width)` first cuts that window around
    the centre as it is (an odd rest goes below and to the right). Decoding is frame by frame: the memory
    taken is the output's plus two source frames, and a clip that would take over a third of the machine's
    memory is refused.

    Images of 16 bits are scaled to 8, grey ones get three equal channels. Where any image of a folder, or any frame of
    an animated GIF, PNG or WebP, is transparent anywhere, the clip has alpha (see `Clip`), and the others are opaque.
    Other videos with alpha are refused, since decoding drops it, and interlaced ones where OpenCV does not convert
    them. Videos are turned upright. A damaged one yields the frames that decode; see `Clip.num_declared`. Frames of
    uneven times are all kept; see `Clip.times`.

    What a file is, its bytes tell, not its name. Nothing but `path` is opened: no address, and no file that another
    one names, as a playlist does. A picture of more than 16384x16384 pixels is refused by its header.

    Raises `FileNotFoundError` for a missing path, `VideoError` for everything else that cannot be read.
    """
    path = readable_path(path)
    start, stop = checked_range(frames)
    prepare = fit_to(checked_size(size), checked_size(center_crop, "center_crop"))
    if fps is not None:
        check_fps(fps)
    with unreadable_told(path):
        kept, num_declared, pace, notes = reader_of(path)(path, start, stop, prepare)
    clip_fps, times = (pace.fps, pace.times) if fps is None else (fps, None)
    if fps is None:
        notes += pace_notes(pace)
    kept = alike_frames(kept)
    return Clip(stacked(kept), float(clip_fps), str(path), num_declared, times, notes)


def readable_path(path: PathLike) -> Path:
    """`path` of a file or a folder that is there. Raises `FileNotFoundError`, or `VideoError` for pipes and devices."""
    address, path = str(path), checked_path(path)
    if not os.path.exists(path):
        raise FileNotFoundError(_missing(address))
    if not (path.is_dir() or path.is_file()):
        raise video_error(
            "path",
            expected="a video file or a folder of images",
            got=f"{str(path)!r}, a pipe or a device",
            cure="Save what comes out of it to a file.",
        )
    return path


#: (prepared frames, frames declared within the range, how they follow one another, notes)
_Read = tuple[list[np.ndarray], int, FrameRate, tuple[str, ...]]


@contextmanager
def unreadable_told(path: Path) -> Iterator[None]:
    """The system's refusals to read `path` as a `VideoError`."""
    try:
        yield
    except OSError as error:
        got = f"{str(path)!r} ({error.strerror or error})"
        raise video_error("path", expected="a file that can be read", got=got) from error


def _missing(address: str) -> str:
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", address):
        return f"path: expected a file or a folder, got the address {address!r}. Nothing is fetched: download it first."
    return (
        f"path: expected a video file or a folder of images, got {address!r}, which is missing. "
        "Check the spelling and the current folder."
    )


def reader_of(path: Path) -> Callable[..., _Read]:
    if path.is_dir():
        return read_folder
    if may_move(_head(path)):
        return _read_animation
    return _read_image_file if _is_image(path) else read_file


def _head(path: Path) -> bytes:
    """The first bytes of a file; raises for a name that OpenCV would crash of."""
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError as error:
        got, cure = f"{str(path)!a}, which is no Unicode", "Rename the file or its folder."
        raise video_error("path", expected="a name that OpenCV can open", got=got, cure=cure) from error
    with open(path, "rb") as file:
        return file.read(HEAD_BYTES)


def read_file(path: Path, start: int, stop: int | None, prepare: Callable) -> _Read:
    """The frames of a video file."""
    kept, seen, told = pass_through(path, start, stop, lambda frames: _in_blocks(map(prepare, frames)))
    milliseconds, positions = [one.milliseconds for one in seen], [one.position for one in seen]
    return kept, *told_of_span(told, milliseconds, positions, len(kept), start, stop)


class DecodeReport(NamedTuple):
    """What a pass through a video file tells beside its frames.

    `fps`: the container's rate, or what stands for it. `num_total`: frames in all, with those that are missing.
    `notes`: of the shape of its pixels. `seconds`: of each frame seen, rising. `threads`: of its decoder.
    """

    fps: float
    num_total: int
    notes: tuple[str, ...]
    seconds: np.ndarray
    threads: int


def pass_through(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], list]
) -> tuple[list, list["Seen"], DecodeReport]:
    """Decode a video file once: what `keep` makes of its frames from `start` up to `stop`, BGR, all frames seen, and
    what else is told. Raises `VideoError` for all that is refused."""
    seen: list[Seen] = []
    with _capture(path) as capture:
        declared, rate = _declared_frames(capture), capture.get(cv2.CAP_PROP_FPS)
        notes, threads = _shape_notes(capture), round(capture.get(cv2.CAP_PROP_N_THREADS))
        fps = rate if 0 < rate <= MAX_FPS else DEFAULT_FPS
        stays = _Stays(seen)
        watched = stays.watched(frames_decoded(capture, fps, start, stop, seen))
        kept = keep(_same_size(watched, path))
        if len(kept) == 1:  # nothing to compare it with yet
            list(stays.watched(islice(frames_decoded(capture, fps, 0, None, []), 1)))
    num_decoded = len(seen)
    if num_decoded == 0:
        raise video_error(
            "path",
            expected="a video with frames that decode",
            got=f"none in {str(path)!r}",
            cure="The file is damaged or its codec is unknown here; convert it with ffmpeg.",
        )
    if num_decoded == 1 and rate > MAX_FPS:  # the rate of one picture among sound
        got = f"sound with a picture of its cover, {str(path)!r}"
        raise video_error("path", expected="a video", got=got, cure="Give a file with moving pictures.")
    if stays.last and not _converts(path, stays.last):
        raise video_error(
            "path",
            expected="a video of whole pictures",
            got=f"one of interlaced fields, {str(path)!r}, which OpenCV does not convert",
            cure="Make whole pictures of them: ffmpeg -i VIDEO -vf yadif NEW.mp4.",
        )
    seconds, head, reached = risen([one.milliseconds for one in seen], fps), _head(path), seen[-1].position + 1
    if declared and rate > 0 and not counts_frames(head):
        tells = tells_duration(head, path.stat().st_size)
        declared = promised(seconds, declared / rate, fps, reached) if tells else reached
    elif declared > reached:
        declared = _shown_of(path, declared, seconds, fps, reached)
    num_total = max(declared, reached)
    # A container's count may be an estimate, so the range is judged against what decoded as well.
    _check_within(start, stop, num_total, path)
    if not kept:
        raise none_decodes(start, stop, num_decoded, num_total, path)
    return kept, seen, DecodeReport(fps, num_total, notes, seconds, threads)


def told_of_span(
    told: DecodeReport,
    milliseconds: Sequence[float],
    positions: Sequence[int],
    num_kept: int,
    start: int,
    stop: int | None,
) -> tuple[int, FrameRate, tuple[str, ...]]:
    """Frames declared from `start` up to `stop`, how they follow one another, and notes.

    `milliseconds` and `positions` are those of all frames seen up to there, of which the last `num_kept` are kept.
    """
    num_seen = len(positions)
    pace = _usable(pace_of(told.seconds[num_seen - num_kept : num_seen], told.fps))
    if np.ptp(milliseconds) == 0 and num_seen > 1:  # a raw stream: the rate is FFmpeg's guess
        pace = pace._replace(guessed=True)
    gaps = _gap_notes([start - 1, *positions[num_seen - num_kept :]])
    return (told.num_total if stop is None else stop) - start, pace, told.notes + gaps


def _shown_of(path: Path, declared: int, seconds: np.ndarray, fps: float, reached: int) -> int:
    """How many of the frames that a container counts are to be shown: cutting may leave others in an MP4, unseen."""
    with open(path, "rb") as file:
        shown = shown_seconds(file)
    return declared if shown is None else min(declared, promised(seconds, shown, fps, reached))


def _usable(pace: FrameRate) -> FrameRate:
    return pace if pace.fps <= MAX_FPS else FrameRate(DEFAULT_FPS, guessed=True)


def _gap_notes(positions: list[int]) -> tuple[str, ...]:
    """What is to be said of frames that damage left out before others."""
    gaps = [(before + 1, after) for before, after in pairwise(positions) if after - before > 1]
    if not gaps:
        return ()
    first, after = gaps[0]
    which = f"frame {first}" if after == first + 1 else f"frames {first} to {after - 1}"
    num = sum(after - first for first, after in gaps)
    sound = f"frames {positions[0] + 1}:{first} are sound" if first > positions[0] + 1 else "all of it"
    which = which if len(gaps) == 1 else f"{num} frames, the first of them {first},"
    return (f"{which} cannot be decoded, and are left out; what follows may be blemished, {sound}.",)


def pace_notes(pace: FrameRate) -> tuple[str, ...]:
    if pace.guessed:
        return (f"no rate is told that can be used; taken as {pace.fps:g} frames a second, unless fps says otherwise.",)
    if pace.times is None:
        return ()
    apart = np.diff(pace.times)
    return (
        f"frames are {apart.min():.3g} to {apart.max():.3g} s apart; all are kept, and taken as evenly spaced "
        f"at their mean rate, {pace.fps:.4g} a second.",
    )


def read_folder(folder: Path, start: int, stop: int | None, prepare: Callable) -> _Read:
    """The images of a folder."""
    images = image_paths(folder)
    if not images:
        raise video_error(
            "path",
            expected="a folder with images (" + ", ".join(s[1:] for s in IMAGE_SUFFIXES) + ")",
            got=f"{str(folder)!r} without any",
            cure="Give the folder that holds the frames, or a video file.",
        )
    _check_within(start, stop, len(images), folder)
    return read_pictures(images[start:stop], prepare)


def _is_image(path: Path) -> bool:
    """Whether a file is one image, whatever it is called."""
    if path.suffix.lower() not in IMAGE_SUFFIXES and not is_image(_head(path)):
        return False
    with quiet():
        num_images = cv2.imcount(str(path))
    if num_images > 1 and _head(path).startswith(
        (b"II*\0", b"MM\0*")
    ):  # a TIFF, of which that decoder sees the first alone
        got = f"{num_images} in {str(path)!r}"
        raise video_error("path", expected="one image in a TIFF", got=got, cure="Unpack it to a folder of images.")
    if path.suffix.lower() not in IMAGE_SUFFIXES and _is_followed(path):
        got, cure = (
            f"a bare sequence of JPEGs, {str(path)!r}",
            "Put it into a container: ffmpeg -i VIDEO -c copy NEW.avi.",
        )
        raise video_error("path", expected="a video in a container", got=got, cure=cure)
    return num_images == 1


def _is_followed(path: Path) -> bool:
    """Whether a JPEG stands right after another: a video without container, which OpenCV does not open.

    One that a camera keeps beside a picture, of other light or for the other eye, is announced ("MPF").
    """
    head = _head(path)
    if not head.startswith(b"\xff\xd8\xff") or b"MPF\0" in head:
        return False
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.find(b"\xff\xd9\xff\xd8\xff") >= 0


def _read_image_file(path: Path, start: int, stop: int | None, prepare: Callable) -> _Read:
    """As `read_folder`, of a file with one image."""
    _check_within(start, stop, 1, path)
    return read_pictures([path], prepare)


#: What Pillow raises of damaged files.
_BROKEN = (
    EOFError,
    OSError,
    SyntaxError,
    ValueError,
    IndexError,
    OverflowError,
    struct.error,
    Image.DecompressionBombError,
)


def _read_animation(path: Path, start: int, stop: int | None, prepare: Callable) -> _Read:
    """The frames of a GIF, PNG or WebP, which have alpha, times of their own, and no decoder in FFmpeg that keeps both.

    One that does not move is left to the decoder of images, which keeps its 16 bits.
    """
    _refuse_huge_image(path, _head(path))
    kept, delays, fault, size = [], [], False, None
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=("GIF", "PNG", "WEBP")) as animation:
            if animation.format != "GIF" and not getattr(animation, "is_animated", False):
                return _read_image_file(path, start, stop, prepare)
            num_promised = _promised_pictures(animation)
            for number in islice(count(), min(num_promised or MOST_LOST, stop or MOST_LOST)):
                animation.seek(number)
                animation.load()
                size = size or animation.size
                if animation.size != size:  # Pillow lets a damaged frame enlarge the picture
                    fault = True
                    break
                delays.append(animation.info.get("duration") or GIF_DELAY)
                if number >= start:
                    rgba = np.asarray(animation.convert("RGBA"))
                    kept.append(prepare(_premultiplied(cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))))
    except VideoError:
        raise
    except _BROKEN:
        fault = True
    if not delays:
        raise _undecoded(path)
    num_total = max(num_promised, len(delays) + fault)
    _check_within(start, stop, num_total, path)
    if not kept:
        raise none_decodes(start, stop, len(delays), num_total, path)
    shown = np.array(delays[start:])
    pace = pace_of(np.concatenate([[0], np.cumsum(shown)]) / 1000, 1000 * len(shown) / shown.sum())
    if pace.times is not None:
        pace = FrameRate(pace.fps, pace.times[:-1])
    pace = _usable(pace)
    return kept, (num_total if stop is None else stop) - start, pace, ()


def _promised_pictures(animation: Image.Image) -> int:
    """Their number as the file gives it; 0 of a damaged GIF, which is counted by reading it."""
    try:
        return animation.n_frames
    except _BROKEN:
        return 0


def read_pictures(chosen: list[Path], prepare: Callable) -> _Read:
    """Images of one size."""
    first_shape, kept = None, []
    for entry in chosen:
        image = read_picture(entry)
        first_shape = first_shape or image.shape[:2]
        if image.shape[:2] != first_shape:
            raise video_error(
                "path",
                expected=f"images of one size, {_shape_text(first_shape)} as in {chosen[0].name!r}",
                got=f"{_shape_text(image.shape)} in {entry.name!r}",
                cure="Resize the images, or choose others with frames=(A, B).",
            )
        kept.append(prepare(image))
    return kept, len(chosen), FrameRate(DEFAULT_FPS), ()


def alike_frames(frames: list[np.ndarray]) -> list[np.ndarray]:
    """All with alpha where one is transparent anywhere, else all without."""
    with_alpha = [frame.shape[2] == 4 for frame in frames]
    if not any(with_alpha):
        return frames
    if not any(has and frame[..., 3].min() < 255 for has, frame in zip(with_alpha, frames, strict=True)):
        return [frame[..., :3] for frame in frames]
    pairs = zip(with_alpha, frames, strict=True)
    return [frame if has else cv2.cvtColor(frame, cv2.COLOR_RGB2RGBA) for has, frame in pairs]


def image_paths(folder: Path) -> list[Path]:
    """The images in `folder` in the order in which `read_video` takes them."""
    images = (
        entry
        for entry in folder.iterdir()
        if entry.suffix.lower() in IMAGE_SUFFIXES and not entry.name.startswith(".") and entry.is_file()
    )
    return sorted(images, key=lambda entry: natural_order(entry.name))


def image_size(path: Path) -> tuple[int, int]:
    """(height, width) of an image, in pixels."""
    return read_picture(path).shape[:2]


def read_picture(path: Path) -> np.ndarray:
    """One image as uint8 BGR, shape (height, width, 3), or premultiplied BGRA, (height, width, 4)."""
    head = _head(path)
    _refuse_huge_image(path, head)
    # UNCHANGED shows a fourth channel; JPEG has none, and COLOR also applies its orientation.
    flags = cv2.IMREAD_COLOR if head.startswith(b"\xff\xd8") else cv2.IMREAD_UNCHANGED
    with quiet():
        try:
            image = cv2.imread(str(path), flags)
        except cv2.error:  # an absurd size in the header
            image = None
    if image is None:
        raise _undecoded(path)
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)  # 65535 = 255 * 257, to nearest
    if image.dtype != np.uint8:
        raise video_error(
            "path",
            expected="images of 8 or 16 bits",
            got=f"{image.dtype} in {str(path)!r}",
            cure="Convert it to an 8-bit PNG.",
        )
    if image.ndim == 3 and image.shape[2] == 4:
        return _premultiplied(image)
    return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def none_decodes(start: int, stop: int | None, num_decoded: int, num_total: int, path: Path) -> VideoError:
    """Of the frames asked for."""
    got = f"{_text(start, stop)}, while {num_decoded} of {num_total} frames decode in {str(path)!r}"
    return video_error("frames", expected="a range with frames that decode", got=got, cure="Ask for earlier frames.")


def _undecoded(path: Path) -> VideoError:
    got = f"{str(path)!r} ({_bytes_text(path)}), which does not"
    return video_error("path", expected="images that decode", got=got, cure="Replace or remove it.")


def _refuse_huge_image(path: Path, head: bytes) -> None:
    """Raise for an image whose header claims more pixels than are taken, or than its bytes can hold."""
    size = claimed_size(head)
    _refuse_huge(path, size)
    if size is not None and path.stat().st_size < fewest_bytes(head, size):
        raise _undecoded(path)


def _refuse_huge(path: Path, size: tuple[float, float] | None) -> None:
    """Raise for a picture that a header says is larger than any, before memory is taken for it."""
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise video_error(
            "path",
            expected=f"pictures of at most {MAX_PIXELS:,} pixels",
            got=f"{size[0]:.0f}x{size[1]:.0f} (height x width) in the header of {str(path)!r}",
            cure="The file is damaged, or must be scaled down first.",
        )


def _premultiplied(image: np.ndarray) -> np.ndarray:
    """Colours times alpha, to nearest: what the hidden pixels of a transparent image are does not matter then."""
    alpha = image[..., 3:].astype(np.uint16)
    return np.concatenate([((image[..., :3] * alpha + 127) // 255).astype(np.uint8), image[..., 3:]], axis=-1)


_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"  # where OpenCV takes FFmpeg's options from, at each opening
_opening = threading.Lock()


def _restricting(others: str | None) -> str:
    ours = f"protocol_whitelist;file|format_whitelist;{FORMATS}"
    return f"{others}|{ours}" if others else ours


@contextmanager
def _restricted() -> Iterator[None]:
    """Let FFmpeg open this one file and nothing that it names: no address, no playlist, no sequence of images."""
    with _opening:
        before = os.environ.get(_OPTIONS)
        os.environ[_OPTIONS] = _restricting(before)
        try:
            yield
        finally:
            if before is None:
                del os.environ[_OPTIONS]
            else:
                os.environ[_OPTIONS] = before


def open_video(path: Path, threads: int = 0) -> cv2.VideoCapture:
    """An opened decoder. Raises `VideoError` for what does not open, has alpha, or is huge.

    `threads`: of FFmpeg's decoder, 0 for its own choice. What it makes of damaged frames depends on their number.
    """
    kind = kind_of(_head(path))
    if kind == LIST:
        raise video_error(
            "path",
            expected="a video file or a folder of images",
            got=f"{kind}, {str(path)!r}",
            cure="What it names is never opened: give the video itself.",
        )
    # FFmpeg only, and an absolute path: other backends take 'img01.png' for the first of a sequence,
    # and FFmpeg takes 'name:rest' for a protocol.
    options = [cv2.CAP_PROP_N_THREADS, threads] if threads else []
    with quiet(), _restricted():
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG, options)
    try:
        if not capture.isOpened():
            raise video_error(
                "path",
                expected="a video file or a folder of images",
                got=f"{str(path)!r} ({_bytes_text(path)}{f', {kind}' if kind else ''}), which does not open as a video",
                cure="Check that it is a video and that its copy or download is complete.",
            )
        _refuse_alpha(capture, path)
        _refuse_huge(path, (capture.get(cv2.CAP_PROP_FRAME_HEIGHT), capture.get(cv2.CAP_PROP_FRAME_WIDTH)))
    except VideoError:
        capture.release()
        raise
    return capture


@contextmanager
def _capture(path: Path) -> Iterator[cv2.VideoCapture]:
    """An opened decoder, silent and released at the end."""
    with quiet():
        capture = open_video(path)
        try:
            yield capture
        finally:
            capture.release()


#: Pixel formats as FFmpeg names them to OpenCV, where there is alpha in every one: of packed pixels, and the first two
#: letters of planar ones, whose third says how colours are sampled (a small number; "Y42B" is another).
_PACKED_ALPHA, _PLANAR_ALPHA = (b"RGBA", b"BGRA", b"ARGB", b"ABGR"), (b"Y4", b"G4")


def _refuse_alpha(capture: cv2.VideoCapture, path: Path) -> None:
    """Raise for a video with alpha: decoding would drop it without a word."""
    kind = (int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) & 0xFFFFFFFF).to_bytes(4, "little")
    packed = kind in _PACKED_ALPHA and int(capture.get(cv2.CAP_PROP_FOURCC)) != 0  # raw video's fourth byte is idle
    if packed or (kind[:2] in _PLANAR_ALPHA and kind[2] < ord(" ")) or has_alpha_beside(_head(path)):
        raise video_error(
            "path",
            expected="a video without alpha",
            got=f"one with alpha, {str(path)!r}, which would be lost",
            cure="Unpack it to a folder of PNGs (ffmpeg -i VIDEO FOLDER/%05d.png), or flatten it.",
        )


def _shape_notes(capture: cv2.VideoCapture) -> tuple[str, ...]:
    """What is to be said of pixels that are not square."""
    across, down = (capture.get(name) for name in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
    if not (across > 0 and down > 0 and abs(across / down - 1) > 0.01):
        return ()
    return (f"pixels are {across / down:.3g} times as wide as high; frames are kept as stored, not stretched.",)


class Seen(NamedTuple):
    """A frame that decodes: which one of the file it is, and its time."""

    position: int
    milliseconds: float


def frames_grabbed(capture: cv2.VideoCapture, fps: float) -> Iterator[Seen]:
    """The frames that decode, one by one. Those lost before one, in damage, are counted by its time."""
    position, before, misses = -1, -1000 / fps, 0
    while misses < MISSES:
        if not capture.grab():
            misses += 1
            continue
        now = capture.get(cv2.CAP_PROP_POS_MSEC)
        lost = (now - before) * fps / 1000 - 1 if misses else 0.0
        position += 1 + (round(lost) if 0 < lost < MOST_LOST else 0)
        before, misses = now, 0
        yield Seen(position, now)


def frames_decoded(
    capture: cv2.VideoCapture, fps: float, start: int, stop: int | None, seen: list[Seen]
) -> Iterator[np.ndarray]:
    """The frames from `start` up to `stop`, BGR, that decode; all that are passed are added to `seen`.

    Those before `start` are decoded and dropped: seeking lands on key frames in some containers.
    """
    for one in frames_grabbed(capture, fps):
        if stop is not None and one.position >= stop:
            return
        if one.position >= start:
            found, frame = capture.retrieve()
            if not found:
                continue
        seen.append(one)
        if one.position >= start:
            yield frame
        if stop is not None and one.position == stop - 1:
            return


class _Stays:
    """Which frame was the last to equal the one before it.

    Where FFmpeg refuses to convert a frame, OpenCV (from 4.13 on) says nothing and hands out what its memory held, so
    it equals the one before; so do frames of clips in which nothing moves.
    """

    def __init__(self, seen: list[Seen]):
        self.last, self._seen, self._before = 0, seen, None

    def watched(self, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        for frame in frames:
            if self._before is not None and np.array_equal(frame, self._before):
                self.last = len(self._seen)
            self._before = frame
            yield frame


#: Read so many frames, and let FFmpeg tell its errors.
_TRIAL = """
import sys, cv2
capture, left, misses = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG), int(sys.argv[2]), int(sys.argv[3])
while left > 0 and misses > 0:
    left, misses = (left - 1, misses) if capture.read()[0] else (left, misses - 1)
"""


def _converts(path: Path, num_frames: int) -> bool:
    """Whether the first frames of a video become pictures: those of interlaced fields may not.

    Only FFmpeg's log says so, whose level is fixed when the process first opens a video; so another one asks.
    """
    if getattr(sys, "frozen", False) or not sys.executable:
        return True
    environment = os.environ | {
        "OPENCV_FFMPEG_LOGLEVEL": "16",  # AV_LOG_ERROR
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        _OPTIONS: _restricting(os.environ.get(_OPTIONS)),
    }
    command = [sys.executable, "-c", _TRIAL, str(path.resolve()), str(num_frames), str(MISSES)]
    try:
        ran = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, env=environment, check=False)
    except OSError:  # no more processes: then nothing can be said
        return True
    return b"Cannot convert interlaced" not in ran.stdout + ran.stderr


def _same_size(frames: Iterable[np.ndarray], path: Path) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        shape = shape or frame.shape
        if frame.shape != shape:
            raise video_error(
                "path",
                expected=f"frames of one size, {_shape_text(shape)}",
                got=f"{_shape_text(frame.shape)} from frame {number} on in {str(path)!r}",
                cure="Cut the video there, or choose frames=(A, B).",
            )
        yield frame


def _declared_frames(capture: cv2.VideoCapture) -> int:
    """The container's own count, 0 where it gives none (an image's is -2^63)."""
    count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    return round(count) if math.isfinite(count) and 0 < count < 2**31 else 0


def memory_limit() -> int:
    """Bytes that a clip may take: a third of the machine's memory, since a fit holds it twice."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 3
    except (AttributeError, ValueError, OSError):  # not POSIX
        return 8 << 30


def fit_to(size: tuple[int, int] | None, crop: tuple[int, int] | None = None) -> Callable[[np.ndarray], np.ndarray]:
    """BGR of any size -> RGB: the window `crop` around the centre, the aspect of `size`, then resize to that."""
    limit, taken, num_frames = memory_limit(), 0, 0

    def prepare(image: np.ndarray) -> np.ndarray:
        nonlocal taken, num_frames
        if crop is not None:
            image = image[centre_window(image.shape[:2], crop)]
        height, width = image.shape[:2] if size is None else size
        channels = image.shape[2]
        taken, num_frames = taken + channels * height * width, num_frames + 1
        if taken > limit:
            raise video_error(
                "size",
                expected=f"a clip of at most {limit / 2**30:.1f} GiB, a third of this machine's memory",
                got=f"more, at frame {num_frames} of {height}x{width}",
                cure="Take fewer frames or a smaller size.",
            )
        if size is not None and image.shape[:2] != size:
            image = _resized(image[aspect_window(image.shape[:2], size)], size)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if channels == 3 else cv2.COLOR_BGRA2RGBA)

    return prepare


def aspect_window(have: tuple[int, int], want: tuple[int, int]) -> tuple[slice, slice]:
    """The largest centred window of `have` with the aspect of `want`, to whole pixels."""
    height, width = have
    if width * want[0] > height * want[1]:
        cut = height, max(1, round(height * want[1] / want[0]))
    else:
        cut = max(1, round(width * want[0] / want[1])), width
    return centre_window(have, cut)


def centre_window(have: tuple[int, int], window: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of the `window` of (height, width) around the centre; `VideoError` where it does not fit."""
    if window[0] > have[0] or window[1] > have[1]:
        raise video_error(
            "center_crop",
            expected=f"at most the frame's {_shape_text(have)}",
            got=f"{window[0]}x{window[1]}",
            cure="Cut a smaller window, or enlarge with size=(height, width) instead.",
        )
    top, left = (have[0] - window[0]) // 2, (have[1] - window[1]) // 2
    return slice(top, top + window[0]), slice(left, left + window[1])


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if image.shape[:2] == size:
        return image
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    return cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


#: Larger than any piece of memory that the C library keeps for itself when it is freed.
BLOCK_BYTES = 64 << 20


def _in_blocks(frames: Iterable[np.ndarray]) -> list[np.ndarray]:
    """The frames, copied side by side into large blocks, each of which goes back to the system with its last frame."""
    kept, block, used = [], np.empty((0, 0), np.uint8), 0
    for frame in frames:
        if used == len(block) or block.shape[1:] != frame.shape:
            block, used = np.empty((max(1, BLOCK_BYTES // frame.nbytes), *frame.shape), np.uint8), 0
        block[used] = frame
        kept.append(block[used])
        used += 1
    return kept


def stacked(frames: list[np.ndarray]) -> np.ndarray:
    """np.stack that frees each frame as it goes, so the peak is one copy of the clip and not two."""
    clip = np.empty((len(frames), *frames[0].shape), np.uint8)
    for number in range(len(frames)):
        clip[number] = frames[number]
        frames[number] = None
    return clip


def natural_order(name: str) -> tuple:
    """Sort key: runs of digits compare as numbers; the name itself breaks ties (1.png, 01.png)."""
    parts = re.split(r"([0-9]+)", name.lower())
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], name


# ---------------------------------------------------------------------------------------------- writing


def write_video(
    path: PathLike,
    frames: Iterable[np.ndarray],
    fps: float,
    *,
    overwrite: bool = False,
    image_format: str = "png",
) -> Path:
    """Write frames, uint8 RGB of shape (height, width, 3), and return the path; nothing half-written stays.

    `.mp4` and `.webm` are VP9 (profile 0, 4:2:0), which browsers play: OpenCV's wheel has no H.264 encoder.
    4:2:0 halves the colour resolution. Bunny comes back at 35 dB at 160x320, the limit of 4:2:0 there, and
    at 40 dB at 640x1280 (OpenCV hands no quality setting to the encoder); a folder of images is exact. An odd
    height or width, which OpenCV would cut, gets its last row or column repeated once.

    `.gif` and `.webp` are animations that play again and again. A GIF has a palette of 256 colours for each frame,
    and times in hundredths of a second: frames last a whole number of them each, of two lengths where need be, so
    that the whole keeps its pace. Browsers slow down what is faster than 50 frames a second, which is refused. An
    animated WebP has 4:2:0 at quality 90. Both are held in memory until the last frame.

    A path without extension, or an existing folder, goes to `write_frames`, with `overwrite` and `image_format`; an
    existing *file* is replaced. `fps` is in (0, 1000].

    Raises `VideoError` for another extension, no frames, or frames of other kinds; `OutputError` where the
    path cannot be written.
    """
    path = checked_path(path, "path, frames, fps")
    check_fps(fps)
    if not isinstance(frames, Iterable):
        cure = "Of a model: model.frames()."
        raise video_error("frames", expected="pictures, one by one", got=type(frames).__name__, cure=cure)
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
            cure="One picture: write_image." if suffix == ".png" else "Rename the output.",
        )
    # OpenCV prints a warning for every VP9 tag in WebM, none in its superset Matroska, whose header is then
    # relabelled.
    with atomic_path(path, suffix=".mkv" if suffix == ".webm" else suffix) as temporary:
        num_frames = _encode(temporary, _checked_frames(frames), float(fps))
        _check_written(temporary, num_frames, path)
        if suffix == ".webm":
            _relabel_as_webm(temporary)
    return path


def write_frames(
    folder: PathLike, frames: Iterable[np.ndarray], *, overwrite: bool = False, image_format: str = "png"
) -> Path:
    """Write frames, uint8 RGB of shape (height, width, 3), as 00000.png, 00001.png, ...; returns the folder.

    With `image_format="webp"` as 00000.webp and so on: as exact as PNG, and smaller. The folder appears whole or not
    at all. One that holds files is refused unless `overwrite`, and even then if it holds anything but such numbered
    frames: what this package did not write it does not delete.

    Raises `VideoError` for no frames or frames of other kinds, `OutputError` where the folder is refused, ValueError
    for an unknown `image_format`.
    """
    check_one_of("image_format", image_format, IMAGE_FORMATS)
    folder, encode = Path(folder), _png if image_format == "png" else _webp
    check = partial(check_replaceable, folder, overwrite, pattern=r"[0-9]{5,}\.(png|webp)")
    check()
    with atomic_folder(folder, check=check) as temporary:
        for number, frame in enumerate(_checked_frames(frames)):
            (temporary / f"{number:05d}.{image_format}").write_bytes(encode(frame))
    return folder


def write_image(path: PathLike, image: np.ndarray) -> Path:
    """Write one uint8 RGB image of shape (height, width, 3) as PNG, whole or not at all; returns the path.

    Raises `VideoError` for another extension or kind of array, `OutputError` where it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise video_error("path", expected="a name ending in .png", got=repr(path.name), cure="Rename the output.")
    data = _png(_checked_frame(image, None, "image"))
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return path


def _write_animation(path: Path, suffix: str, frames: Iterable[np.ndarray], fps: float) -> Path:
    """Write an animated GIF or WebP that repeats without end."""
    if suffix == ".gif" and fps > MAX_GIF_FPS:
        raise video_error(
            "fps",
            expected=f"at most {MAX_GIF_FPS:g} for a GIF",
            got=f"{fps:g}",
            cure="Take fewer frames, or a .webp or .webm.",
        )
    with atomic_path(path) as temporary:
        pictures = [_as_picture(frame, suffix) for frame in _checked_frames(frames)]
        first, *rest = pictures
        shared = {"save_all": True, "append_images": rest, "loop": 0}
        try:
            if suffix == ".gif":
                first.save(temporary, "GIF", duration=_gif_durations(len(pictures), fps), optimize=False, **shared)
            else:
                first.save(temporary, "WEBP", duration=1000 / fps, quality=WEBP_QUALITY, **shared)
        except OSError as error:
            raise not_writable(path, error) from error
        except (OverflowError, RuntimeError, ValueError) as error:
            height, width = first.height, first.width
            expected, got = f"a size and a rate that {suffix} can hold", f"{height}x{width} at {fps:g} a second"
            raise video_error("frames", expected=expected, got=got, cure="Take an .mp4 or .webm.") from error
    return path


def _as_picture(frame: np.ndarray, suffix: str) -> Image.Image:
    picture = Image.fromarray(frame)
    return picture.quantize(256) if suffix == ".gif" else picture


def _gif_durations(num_frames: int, fps: float) -> list[int]:
    """Milliseconds of each frame, whole hundredths of a second, whose sums stay within a half of the true times."""
    ends = np.rint(100 * np.arange(num_frames + 1) / fps).astype(int)
    return [10 * int(lasts) for lasts in np.diff(ends)]


def _encode(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    """Encode in VP9 and return the number of frames; the container goes by the extension of `path`."""
    code = cv2.VideoWriter.fourcc(*("vp09" if path.suffix.lower() == ".mp4" else "VP90"))
    writer, num_frames = None, 0
    with quiet():
        try:
            for frame in frames:
                image = _for_encoder(frame)
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
    """Raise the system's OSError where not even a few bytes can be written: OpenCV does not say why it cannot."""
    path.write_bytes(bytes(4096))
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def _for_encoder(frame: np.ndarray) -> np.ndarray:
    """RGB -> the BGR of even size that OpenCV's writer encodes with the least error."""
    image = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    if image.shape[0] % 2 or image.shape[1] % 2:
        # OpenCV would drop the odd row or column.
        image = cv2.copyMakeBorder(image, 0, image.shape[0] % 2, 0, image.shape[1] % 2, cv2.BORDER_REPLICATE)
    # FFmpeg's scaler, as OpenCV calls it, rounds both colour planes down: on Bunny, Chromium shows red and
    # blue 1.3 (grey levels) too dark. One more of each leaves 0.3, and 0.5 dB at 640x1280. cv2.add saturates.
    return cv2.add(image, (1, 0, 1, 0))


def _check_written(path: Path, num_frames: int, target: Path) -> None:
    """OpenCV's writer reports no error, not even a full disk: count the frames that decode.

    The container's own count will not do, it can be right in a file that breaks off. Decoding takes a few
    hundredths of the time of encoding.
    """
    with quiet():
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
        num_decoded = sum(1 for _ in iter(capture.grab, False))
        capture.release()
    if num_decoded != num_frames:
        raise OutputError(
            f"path: expected {num_frames} frames in {str(target)!r}, got {num_decoded}. "
            "The disk may be full, or a size limit reached."
        )


def _relabel_as_webm(path: Path) -> None:
    """Matroska with VP9 *is* WebM but for the DocType; EBML pads a shorter string with zeros."""
    with open(path, "r+b") as file:
        start = file.read(64).index(b"matroska")
        file.seek(start)
        file.write(b"webm\0\0\0\0")


def _webp(frame: np.ndarray) -> bytes:
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101]  # above 100: lossless
    if max(frame.shape[:2]) > MAX_WEBP_SIDE:
        got = _shape_text(frame.shape)
        raise video_error("frames", expected=f"sides of at most {MAX_WEBP_SIDE:,} for WebP", got=got, cure="Take PNG.")
    return cv2.imencode(".webp", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), quality)[1].tobytes()


def _png(frame: np.ndarray) -> bytes:
    return cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))[1].tobytes()


# ----------------------------------------------------------------------------------------------- checks


def _checked_frames(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        frame = _checked_frame(frame, shape, f"frames[{number}]")
        shape = frame.shape
        yield frame
    if shape is None:
        raise video_error("frames", expected="at least 1 frame", got="none")


def _checked_frame(frame: np.ndarray, shape: tuple | None, parameter: str) -> np.ndarray:
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


def checked_range(frames: Range | None) -> tuple[int, int | None]:
    start, stop = (None, None) if frames is None else frames
    start = 0 if start is None else start
    if start < 0 or (stop is not None and stop < 0):
        raise video_error(
            "frames", expected="A:B counted from the start", got=_text(start, stop), cure="Use 0 or more."
        )
    if stop is not None and stop <= start:
        raise video_error("frames", expected="A:B with at least 1 frame", got=_text(start, stop), cure="Choose B > A.")
    return start, stop


def _check_within(start: int, stop: int | None, num_total: int, path: Path) -> None:
    if start >= num_total or (stop is not None and stop > num_total):
        raise video_error(
            "frames",
            expected=f"A:B within 0:{num_total}, the frames of {str(path)!r}",
            got=_text(start, stop),
            cure=f"Choose B <= {num_total} and A below it.",
        )


def checked_size(size: tuple[int, int] | None, parameter: str = "size") -> tuple[int, int] | None:
    if size is None:
        return None
    height, width = size
    if height != int(height) or width != int(width) or min(height, width) < 1:
        raise video_error(
            parameter,
            expected="height and width of whole pixels, at least 1",
            got=f"{height}x{width}",
            cure="Write it as HEIGHTxWIDTH, such as 160x320.",
        )
    return int(height), int(width)


def check_fps(fps: float) -> None:
    if not is_within(fps, f"(0, {MAX_FPS}]"):
        raise video_error("fps", expected=f"a rate in (0, {MAX_FPS:g}]", got=repr(fps), cure="Try 25.")


def video_error(parameter: str, *, expected: str, got: str, cure: str = "") -> VideoError:
    return VideoError(str(invalid(parameter, expected=expected, got=got, cure=cure)))


def _text(start: int, stop: int | None) -> str:
    return f"{start}:{'' if stop is None else stop}"


def _shape_text(shape: tuple) -> str:
    return f"{shape[0]}x{shape[1]} (height x width)"


def _bytes_text(path: Path) -> str:
    size = path.stat().st_size
    return "an empty file" if size == 0 else f"{size} bytes"


#: OpenCV's LOG_LEVEL_SILENT, which it has no name for up to OpenCV 4.
_LOG_LEVEL_SILENT = 0


@contextmanager
def quiet() -> Iterator[None]:
    """Silence OpenCV's own log (FFmpeg's is set above); the level is the whole process's, so restore it."""
    logging = getattr(cv2.utils, "logging", cv2)  # cv2 itself: up to OpenCV 4
    level = logging.getLogLevel()
    logging.setLogLevel(_LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)
