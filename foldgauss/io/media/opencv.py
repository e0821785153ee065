"""OpenCV's video decoder, silenced and restricted to one local file."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

# FFmpeg writes to stderr about every damaged packet; our errors are one line. OpenCV reads this variable when it first
# opens a video. -8 is AV_LOG_QUIET.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
import cv2
import numpy as np

from foldgauss.io.media.clip import VideoError, format_num_bytes, read_head, video_error
from foldgauss.io.media.format_detection import DEMUXERS, LIST, describe_kind, has_alpha_plane

MAX_PIXELS = 1 << 28  # of one image, 16384x16384: a header may claim any size
MAX_MISSES = 1000  # failed reads in a row after which a video has ended: damage is skipped, and the end costs no time
MAX_LOST_FRAMES = 1_000_000  # a time stamp that implies a larger gap counts as damaged
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"  # the variable from which OpenCV reads FFmpeg's options at each opening
#: OpenCV's LOG_LEVEL_SILENT, which has no name up to OpenCV 4.
_LOG_LEVEL_SILENT = 0
#: FFmpeg pixel formats with alpha, as OpenCV reports them: the packed ones, and the first two letters of planar ones,
#: whose third byte is a small number for the chroma sampling ("Y42B" is another format).
_PACKED_ALPHA, _PLANAR_ALPHA = (b"RGBA", b"BGRA", b"ARGB", b"ABGR"), (b"Y4", b"G4")
_opening = threading.Lock()


@contextmanager
def silence_opencv() -> Iterator[None]:
    """Silence OpenCV's own log (FFmpeg's is set above); the level is per process, so it is restored."""
    logging = getattr(cv2.utils, "logging", cv2)  # cv2 itself: up to OpenCV 4
    level = logging.getLogLevel()
    logging.setLogLevel(_LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)


def restricted_environment() -> dict[str, str]:
    """The environment variable that lets FFmpeg open one local file and nothing that the file refers to."""
    others, ours = os.environ.get(_OPTIONS), f"protocol_whitelist;file|format_whitelist;{DEMUXERS}"
    return {_OPTIONS: f"{others}|{ours}" if others else ours}


@contextmanager
def _restrict_ffmpeg() -> Iterator[None]:
    """Let FFmpeg open one local file: no address, no playlist, no sequence of images."""
    with _opening:
        before = os.environ.get(_OPTIONS)
        os.environ.update(restricted_environment())
        try:
            yield
        finally:
            if before is None:
                del os.environ[_OPTIONS]
            else:
                os.environ[_OPTIONS] = before


def open_video(path: Path, threads: int = 0) -> cv2.VideoCapture:
    """An opened decoder. Raises `VideoError` for a file that does not open, has alpha, or has too many pixels.

    `threads`: of FFmpeg's decoder, 0 for its default. How damaged frames decode depends on their number.
    """
    kind = describe_kind(read_head(path))
    if kind == LIST:
        raise video_error(
            "path",
            expected="a video file or a folder of images",
            got=f"{kind}, {str(path)!r}",
            cure="The files that it names are not opened: give the video itself.",
        )
    # FFmpeg only, and an absolute path: other backends take 'img01.png' for the first of a sequence, and FFmpeg takes
    # 'name:rest' for a protocol.
    options = [cv2.CAP_PROP_N_THREADS, threads] if threads else []
    with silence_opencv(), _restrict_ffmpeg():
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG, options)
    try:
        if not capture.isOpened():
            about = format_num_bytes(path) + (f", {kind}" if kind else "")
            raise video_error(
                "path",
                expected="a video file or a folder of images",
                got=f"{str(path)!r} ({about}), which does not open as a video",
                cure="Check that it is a video and that its copy or download is complete.",
            )
        _check_no_alpha(capture, path)
        check_num_pixels(path, (capture.get(cv2.CAP_PROP_FRAME_HEIGHT), capture.get(cv2.CAP_PROP_FRAME_WIDTH)))
    except VideoError:
        capture.release()
        raise
    return capture


@contextmanager
def open_silently(path: Path) -> Iterator[cv2.VideoCapture]:
    """An opened decoder that is silent, and released at the end."""
    with silence_opencv():
        capture = open_video(path)
        try:
            yield capture
        finally:
            capture.release()


def check_num_pixels(path: Path, size: tuple[float, float] | None) -> None:
    """Raise where a header claims more than `MAX_PIXELS`, before memory is allocated for them."""
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise video_error(
            "path",
            expected=f"images of at most {MAX_PIXELS:,} pixels",
            got=f"{size[0]:.0f}x{size[1]:.0f} (height x width) in the header of {str(path)!r}",
            cure="The file is damaged, or must be scaled down first.",
        )


def _check_no_alpha(capture: cv2.VideoCapture, path: Path) -> None:
    """Raise for a video with alpha, which decoding would drop silently."""
    pixel_format = (int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) & 0xFFFFFFFF).to_bytes(4, "little")
    # The fourth byte of uncompressed video is unused.
    packed = pixel_format in _PACKED_ALPHA and int(capture.get(cv2.CAP_PROP_FOURCC)) != 0
    planar = pixel_format[:2] in _PLANAR_ALPHA and pixel_format[2] < ord(" ")
    if packed or planar or has_alpha_plane(read_head(path)):
        raise video_error(
            "path",
            expected="a video without alpha",
            got=f"one with alpha, {str(path)!r}, which would be lost",
            cure="Unpack it to a folder of PNGs (ffmpeg -i VIDEO FOLDER/%05d.png), or flatten it.",
        )


class GrabbedFrame(NamedTuple):
    """A frame that decodes: its position in the file and its time stamp."""

    position: int
    milliseconds: float


def grab_frames(capture: cv2.VideoCapture, fps: float) -> Iterator[GrabbedFrame]:
    """The frames that decode, one by one. After damage, the number of lost frames is estimated from the time stamps."""
    position, before, misses = -1, -1000 / fps, 0
    while misses < MAX_MISSES:
        if not capture.grab():
            misses += 1
            continue
        now = capture.get(cv2.CAP_PROP_POS_MSEC)
        lost = (now - before) * fps / 1000 - 1 if misses else 0.0
        position += 1 + (round(lost) if 0 < lost < MAX_LOST_FRAMES else 0)
        before, misses = now, 0
        yield GrabbedFrame(position, now)


def decode_frames(
    capture: cv2.VideoCapture, fps: float, start: int, stop: int | None, grabbed: list[GrabbedFrame]
) -> Iterator[np.ndarray]:
    """The frames from `start` up to `stop`, BGR, that decode; every frame passed on the way is added to `grabbed`.

    Frames before `start` are decoded and dropped: seeking stops at key frames in some containers.
    """
    for frame in grab_frames(capture, fps):
        if stop is not None and frame.position >= stop:
            return
        if frame.position >= start:
            found, image = capture.retrieve()
            if not found:
                continue
        grabbed.append(frame)
        if frame.position >= start:
            yield image
        if stop is not None and frame.position == stop - 1:
            return
