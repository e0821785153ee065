"""One pass through a video file: its frames, and what the container reports about them."""

import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from foldgauss.io.media.clip import ReadResult, check_range_within, format_size, no_frames_error, read_head, video_error
from foldgauss.io.media.format_detection import has_frame_count, has_reliable_duration, read_shown_seconds
from foldgauss.io.media.frame_rate import (
    DEFAULT_FPS,
    MAX_FPS,
    FrameRate,
    estimate_num_frames,
    estimate_rate,
    make_increasing,
    replace_unusable_rate,
)
from foldgauss.io.media.opencv import MAX_MISSES, GrabbedFrame, decode_frames, open_silently, restricted_environment
from foldgauss.io.media.resizing import copy_to_blocks


def read_video_file(path: Path, start: int, stop: int | None, prepare: Callable) -> ReadResult:
    """The frames of a video file."""
    kept, grabbed, report = decode_file(path, start, stop, lambda frames: copy_to_blocks(map(prepare, frames)))
    milliseconds, positions = [one.milliseconds for one in grabbed], [one.position for one in grabbed]
    return kept, *describe_span(report, milliseconds, positions, len(kept), start, stop)


class DecodeReport(NamedTuple):
    """What a pass through a video file finds besides its frames.

    `fps`: the container's rate, or the default in its place. `num_total`: number of frames, missing ones included.
    `notes`: about the shape of pixels. `seconds`: increasing times of all frames grabbed. `threads`: of the decoder.
    """

    fps: float
    num_total: int
    notes: tuple[str, ...]
    seconds: np.ndarray
    threads: int


def decode_file(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], list]
) -> tuple[list, list[GrabbedFrame], DecodeReport]:
    """Decode a video file once. Returns what `keep` makes of its BGR frames from `start` up to `stop`, all frames
    grabbed, and a report. Raises `VideoError` for a file that cannot be read."""
    grabbed: list[GrabbedFrame] = []
    with open_silently(path) as capture:
        num_declared, rate = _count_declared_frames(capture), capture.get(cv2.CAP_PROP_FPS)
        notes, threads = _describe_pixel_aspect(capture), round(capture.get(cv2.CAP_PROP_N_THREADS))
        fps = rate if 0 < rate <= MAX_FPS else DEFAULT_FPS
        repeats = _RepeatDetector(grabbed)
        watched = repeats.watch(decode_frames(capture, fps, start, stop, grabbed))
        kept = keep(_check_same_size(watched, path))
        if len(kept) == 1:  # decode another frame to compare it with
            list(repeats.watch(islice(decode_frames(capture, fps, 0, None, []), 1)))
    _check_decoded(path, len(grabbed), rate, repeats.last)
    seconds, head = make_increasing([one.milliseconds for one in grabbed], fps), read_head(path)
    num_reached = grabbed[-1].position + 1
    if num_declared and rate > 0 and not has_frame_count(head):
        reliable = has_reliable_duration(head, path.stat().st_size)
        num_declared = estimate_num_frames(seconds, num_declared / rate, fps, num_reached) if reliable else num_reached
    elif num_declared > num_reached:
        num_declared = _count_shown(path, num_declared, seconds, fps, num_reached)
    num_total = max(num_declared, num_reached)
    # The container's count may be an estimate, so the range is checked against the decoded frames as well.
    check_range_within(start, stop, num_total, path)
    if not kept:
        raise no_frames_error(start, stop, len(grabbed), num_total, path)
    return kept, grabbed, DecodeReport(fps, num_total, notes, seconds, threads)


def _check_decoded(path: Path, num_decoded: int, rate: float, last_repeat: int) -> None:
    """Raise `VideoError` for a file without frames, the cover image of an audio file, and unconverted interlacing."""
    if num_decoded == 0:
        raise video_error(
            "path",
            expected="a video with frames that decode",
            got=f"none in {str(path)!r}",
            cure="The file is damaged or its codec is unknown here; convert it with ffmpeg.",
        )
    if num_decoded == 1 and rate > MAX_FPS:  # FFmpeg's rate of a cover image
        got = f"audio with a cover image, {str(path)!r}"
        raise video_error("path", expected="a video", got=got, cure="Give a file with moving images.")
    if last_repeat and not _can_convert(path, last_repeat):
        raise video_error(
            "path",
            expected="a video of progressive frames",
            got=f"one of interlaced fields, {str(path)!r}, which OpenCV does not convert",
            cure="Deinterlace it: ffmpeg -i VIDEO -vf yadif NEW.mp4.",
        )


def _count_declared_frames(capture: cv2.VideoCapture) -> int:
    """The container's own count, 0 where it gives none (an image's is -2^63)."""
    count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    return round(count) if math.isfinite(count) and 0 < count < 2**31 else 0


def _count_shown(path: Path, num_declared: int, seconds: np.ndarray, fps: float, num_reached: int) -> int:
    """How many declared frames are to be shown: cutting an MP4 may leave others in the file, hidden by an edit list."""
    with open(path, "rb") as file:
        shown = read_shown_seconds(file)
    return num_declared if shown is None else min(num_declared, estimate_num_frames(seconds, shown, fps, num_reached))


def _check_same_size(frames: Iterable[np.ndarray], path: Path) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        shape = shape or frame.shape
        if frame.shape != shape:
            raise video_error(
                "path",
                expected=f"frames of one size, {format_size(shape)}",
                got=f"{format_size(frame.shape)} from frame {number} on in {str(path)!r}",
                cure="Cut the video there, or choose frames=(A, B).",
            )
        yield frame


# ------------------------------------------------------------------------------------------------ notes


def describe_span(
    report: DecodeReport,
    milliseconds: Sequence[float],
    positions: Sequence[int],
    num_kept: int,
    start: int,
    stop: int | None,
) -> tuple[int, FrameRate, tuple[str, ...]]:
    """Number of frames declared from `start` up to `stop`, their rate, and notes.

    `milliseconds` and `positions` are those of all frames grabbed up to `stop`, of which the last `num_kept` are kept.
    """
    num_grabbed = len(positions)
    rate = estimate_rate(report.seconds[num_grabbed - num_kept : num_grabbed], report.fps)
    rate = replace_unusable_rate(rate)
    if np.ptp(milliseconds) == 0 and num_grabbed > 1:  # a raw stream: the rate is FFmpeg's guess
        rate = rate._replace(guessed=True)
    gaps = _describe_gaps([start - 1, *positions[num_grabbed - num_kept :]])
    return (report.num_total if stop is None else stop) - start, rate, report.notes + gaps


def _describe_gaps(positions: list[int]) -> tuple[str, ...]:
    """A note about frames lost to damage before other frames."""
    gaps = [(before + 1, after) for before, after in pairwise(positions) if after - before > 1]
    if not gaps:
        return ()
    first, after = gaps[0]
    which = f"frame {first}" if after == first + 1 else f"frames {first} to {after - 1}"
    num = sum(after - first for first, after in gaps)
    intact = f"frames {positions[0] + 1}:{first} are intact" if first > positions[0] + 1 else "throughout"
    which = which if len(gaps) == 1 else f"{num} frames, the first of them {first},"
    return (f"{which} cannot be decoded and are left out; what follows may show artifacts, {intact}.",)


def _describe_pixel_aspect(capture: cv2.VideoCapture) -> tuple[str, ...]:
    """A note about pixels that are not square."""
    across, down = (capture.get(name) for name in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
    if not (across > 0 and down > 0 and abs(across / down - 1) > 0.01):
        return ()
    return (f"pixels are {across / down:.3g} times as wide as high; frames are kept as stored, not stretched.",)


# ------------------------------------------------------------------------------------------ interlacing


class _RepeatDetector:
    """Number of the last frame that equals the one before it.

    Where FFmpeg refuses to convert a frame, OpenCV (from 4.13 on) silently returns the previous content of its buffer;
    frames of static clips repeat, too.
    """

    def __init__(self, grabbed: list[GrabbedFrame]):
        self.last, self._grabbed, self._before = 0, grabbed, None

    def watch(self, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
        for frame in frames:
            if self._before is not None and np.array_equal(frame, self._before):
                self.last = len(self._grabbed)
            self._before = frame
            yield frame


#: Read the given number of frames and let FFmpeg print its errors.
_CONVERSION_TRIAL = """
import sys, cv2
capture, left, misses = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG), int(sys.argv[2]), int(sys.argv[3])
while left > 0 and misses > 0:
    left, misses = (left - 1, misses) if capture.read()[0] else (left, misses - 1)
"""


def _can_convert(path: Path, num_frames: int) -> bool:
    """Whether FFmpeg converts the first frames of a video; it refuses some interlaced fields.

    Only FFmpeg's log tells, and its level is fixed when a process first opens a video, so another process is used.
    """
    if getattr(sys, "frozen", False) or not sys.executable:
        return True
    environment = {
        **os.environ,
        **restricted_environment(),
        "OPENCV_FFMPEG_LOGLEVEL": "16",  # AV_LOG_ERROR
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    command = [sys.executable, "-c", _CONVERSION_TRIAL, str(path.resolve()), str(num_frames), str(MAX_MISSES)]
    try:
        ran = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, env=environment, check=False)
    except OSError:  # no process can be started, so it stays unknown
        return True
    return b"Cannot convert interlaced" not in ran.stdout + ran.stderr
