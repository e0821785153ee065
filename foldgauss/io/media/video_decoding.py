"""One pass through a video file: its frames, and what the container reports about them."""

from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from foldgauss.io.media.clip import (
    RangeFacts,
    Reading,
    ReadResult,
    Stretch,
    clamp_stop,
    describe_few,
    describe_lost,
    no_frames_error,
    video_error,
)
from foldgauss.io.media.decoder import EQUAL_ASPECT, MAX_FRAMES, DecodedFrame, VideoDecoder
from foldgauss.io.media.frame_rate import DEFAULT_FPS, MAX_FPS, MAX_LAST_DURATION, estimate_rate, make_increasing

#: Fraction of a file after its last frame, above which it is reported; sound may follow the last frame.
MAX_UNREAD = 0.2


class DecodeReport(NamedTuple):
    """What a pass through a video file finds besides its frames.

    `fps`: the container's rate, or the default in its place. `num_total`: number of frames, missing ones included.
    `notes`: about the shape of pixels, HDR and interlacing. Of all frames decoded `positions`, and `stamps` in units of
    `time_base` seconds. `threads`: of the decoder. `end`: when the last of these ends, in seconds as well; 0 where that
    is unknown. `damaged`: the positions of frames that decode with errors. `resized`: of those of another size than the
    video, `stored_size`. `stretched`: as of `Clip`.
    """

    fps: float
    num_total: int
    notes: list[str]
    positions: np.ndarray
    stamps: np.ndarray
    time_base: float
    threads: int
    end: float
    damaged: list[int]
    resized: list[int]
    stored_size: list[int]
    stretched: Stretch | None

    def describe_span(self, first: int, end: int, start: int, stop: int | None) -> RangeFacts:
        """Number of frames declared from position `start` up to `stop`, their rate, and notes.

        Those that decode are the numbers `first` up to `end` of all frames decoded.
        """
        seconds, last = make_increasing((self.stamps * self.time_base).tolist(), self.fps), self.end
        if end < len(seconds):  # until the next one is shown, unless others were lost before it
            last = float(seconds[end]) if self.positions[end] == self.positions[end - 1] + 1 else 0.0
        rate = estimate_rate(seconds[first:end], self.fps, last)
        rate = rate._replace(first_second=float(seconds[first] - seconds[0]))
        if np.ptp(self.stamps[:end]) == 0 and end > 1:  # a raw stream: the rate is FFmpeg's guess
            rate = rate._replace(guessed=True)
        places = self.positions[first:end].tolist()
        gaps, of_span = _describe_gaps([start - 1, *places]), range(places[0], places[-1] + 1)
        gaps += describe_few([one for one in self.damaged if one in of_span], "damaged, and may show artifacts")
        height, width = self.stored_size
        what = f"of another size than the video's {height}x{width}, and stretched to it"
        gaps += describe_few([one for one in self.resized if one in of_span], what)
        num_declared = (self.num_total if stop is None else stop) - start
        return num_declared, rate, (*describe_lost(end - first, num_declared), *self.notes, *gaps)


def decode_file(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], list], reading: Reading
) -> tuple[ReadResult, DecodeReport]:
    """Decode a video file once; `keep` makes the list of its BGR or BGRA frames from `start` up to `stop`.

    Raises `VideoError` for a file that cannot be read.
    """
    places, ticks, following, transfers, duration = [], [], [], set(), 0
    damaged, resized, is_turned = [], [], False

    def select(frames: Iterator[DecodedFrame]) -> Iterator[np.ndarray]:
        """The frames from `start` up to `stop`; all that are decoded are recorded, and so is the next one.

        Frames before `start` are decoded and dropped: seeking stops at key frames.
        """
        nonlocal duration, is_turned
        for frame in frames:
            if stop is not None and frame.position >= stop:
                if places and frame.position == places[-1] + 1:
                    following.append(frame.stamp)
                return
            places.append(frame.position)
            ticks.append(frame.stamp)
            duration, is_turned = frame.decoded.duration or 0, frame.is_turned
            if frame.decoded.is_corrupt:
                damaged.append(frame.position)
            if (frame.decoded.height, frame.decoded.width) != decoder.stored_size:
                resized.append(frame.position)
            if frame.position >= start:
                transfers.add(frame.hdr)
                yield frame.to_array()

    with closing(VideoDecoder(path, reading=reading)) as decoder:
        fps = decoder.fps if 0 < decoder.fps <= MAX_FPS else DEFAULT_FPS
        kept = keep(select(decoder.frames()))
        if not places:
            cure = "The file is damaged or its codec is unknown here; convert it with ffmpeg."
            got = f"none in {str(path)!r}"
            raise video_error("path", expected="a video with frames that decode", got=got, cure=cure)
        positions, stamps = np.array(places, np.int64), np.array(ticks, np.int64)
        time_base, num_reached = float(decoder.time_base), places[-1] + 1
        seconds = make_increasing((np.append(stamps, following) * time_base).tolist(), fps)
        seconds, end = seconds[: len(stamps)], float(seconds[-1])
        if not following:
            last = decoder.find_last_duration(duration, seconds[-1] - seconds[0], num_reached)
            end = float(seconds[-1] + last) if last else 0.0
        last = max(end - seconds[-1], 0.0)
        num_total = max(_count_declared(decoder, seconds, fps, num_reached, last), num_reached)
        notes, aspect, threads = [], decoder.pixel_aspect, decoder.threads
        if abs(aspect - 1) > EQUAL_ASPECT:
            (height, width), is_kept = decoder.size, decoder.size == decoder.stored_size
            shown = "kept as stored" if is_kept else f"stretched to {height}x{width}"
            notes.append(f"pixels are {aspect:.3g} times as wide as high; frames are {shown}.")
        if hdr := sorted(transfers - {None}):
            notes.append(f"colors are HDR ({' and '.join(hdr)}), and are tone-mapped to SDR.")
        if decoder.tilt:
            turn = f"{decoder.tilt} degrees beyond multiples of 90"
            notes.append(f"the file asks for a rotation by {turn}; it is left out.")
        if decoder.has_converted:
            by_field = reading.deinterlace == "fields"
            each = "one of each field" if by_field else "one of each; foldgauss fit --deinterlace fields makes two"
            notes.append(f"interlaced frames are converted to progressive ones, {each}.")
        if (unread := decoder.unread_fraction) > MAX_UNREAD:
            notes.append(f"the last {unread:.0%} of the file hold no frame that decodes.")
        kind = {"kind": "HDR, whose tone mapping defines white"} if hdr else {}
        notes += decoder.levels.describe(path, **kind) if kept else ()
        stored_size, order = list(decoder.stored_size), -1 if is_turned else 1
        stretched = decoder.stored_size[::order], decoder.size[::order]
    # The container's count may be an estimate, so the range is checked against the decoded frames as well.
    end_of_range = clamp_stop(start, stop, num_total, path)
    if not kept:
        raise no_frames_error(start, stop, len(stamps), num_total, path)
    about = positions, stamps, time_base, threads, end, damaged, resized, stored_size
    about += (stretched if stretched[0] != stretched[1] else None,)
    report = DecodeReport(fps, num_total, notes, *about)
    return (kept, *report.describe_span(len(stamps) - len(kept), len(stamps), start, end_of_range)), report


def _count_declared(decoder: VideoDecoder, seconds: np.ndarray, fps: float, num_reached: int, last: float) -> int:
    """The number of frames that the container declares, where frame `num_reached` is shown at seconds[-1] for `last`.

    Its own count includes frames that an edit list hides, as in an MP4 that was cut without encoding; where it has
    none, the number follows from its duration.
    """
    shown, num_declared = decoder.declared_seconds, decoder.num_declared
    if num_declared and not decoder.hides_frames:
        return num_declared
    if shown is None:
        return num_declared or num_reached
    left, intervals, estimated = shown - (seconds[-1] - seconds[0]), np.diff(seconds), num_reached
    if left > MAX_LAST_DURATION * max(1 / fps, intervals.max(initial=0.0), last):
        estimated += round(left / (intervals.mean() if len(intervals) else 1 / fps)) - 1
    if estimated >= MAX_FRAMES:  # a damaged header
        return num_reached
    return min(num_declared, estimated) if num_declared else estimated


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
    are = "is" if num == 1 else "are"
    return (f"{which} cannot be decoded and {are} left out; what follows may show artifacts, {intact}.",)
