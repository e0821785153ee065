"""Clips in memory, what a pass through a clip finds, and the checks that readers and writers of clips share."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from foldgauss._runtime.checks import ParameterError, invalid, is_within, require
from foldgauss.io._atomic import PathLike, check_input, check_path
from foldgauss.io.media.frame_rate import MAX_FPS, MIN_FPS, FrameRate, describe_rate, estimate_rate, make_increasing

HEAD_BYTES = 1 << 16  # by which the format of a file is detected
MAX_PIXELS = 178_956_970  # of one image, Pillow's limit: a header may claim any size
VIDEO = "a video file or a folder of images"
Range = tuple[int | None, int | None]
Size = tuple[int, int]  # (height, width)


class VideoError(ParameterError):
    """A clip cannot be read or written as requested; the one-line message says what was expected, what was got, and
    how to correct it."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames and when they are shown.

    `frames`: uint8 RGB, shape (num_frames, height, width, 3), C-contiguous; for images with alpha RGBA, shape
    (num_frames, height, width, 4), with colors premultiplied by alpha (the image over black). Commands also use
    `LazyFrames`, of these shapes, which cannot be taken `over_black`. `fps`: frames per second.
    `source`: the path as given. `num_declared`: number of frames that the container declares within the requested
    range; larger than `num_frames` where a damaged file is truncated. `times`: display times of the frames, float64
    (num_frames,), in seconds from the first one; None where frames are evenly spaced at `fps`, otherwise `fps` is their
    mean rate. `duration`: seconds to the end of the last one, where there are `times`. `notes`: remarks on how the file
    was read, one line each. `first_second`: when the first frame of a range is shown, in seconds from the first frame
    of the video file; 0 of images, and where `fps` was given.
    """

    frames: np.ndarray
    fps: float
    source: str
    num_declared: int
    times: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    first_second: float = 0.0
    duration: float | None = None

    @property
    def has_alpha(self) -> bool:
        return self.frames.shape[3] == 4

    @property
    def over_black(self) -> np.ndarray:
        """The frames composited over black: uint8 (num_frames, height, width, 3)."""
        return np.ascontiguousarray(self.frames[..., :3])

    @property
    def num_frames(self) -> int:
        return self.frames.shape[0]

    @property
    def size(self) -> Size:
        """(height, width) in pixels."""
        return self.frames.shape[1], self.frames.shape[2]


# ------------------------------------------------------------------------------------------------ paths


def check_readable(path: PathLike) -> Path:
    """The path of an existing file or folder. Raises `FileNotFoundError`, or `VideoError` for pipes and devices."""
    path = check_path(path)
    check_input(path, VIDEO, VideoError)
    return path


@contextmanager
def translate_os_errors(path: Path) -> Iterator[None]:
    """Raise an OSError of reading `path` as a `VideoError`."""
    try:
        yield
    except OSError as error:
        raise video_error(
            "path", expected="a file that can be read", got=f"{str(path)!r} ({error.strerror or error})"
        ) from error


def read_head(path: Path) -> bytes:
    """The first bytes of a file."""
    with open(path, "rb") as file:
        return file.read(HEAD_BYTES)


# ----------------------------------------------------------------------------------------------- checks


def check_range(frames: Range | None) -> tuple[int, int | None]:
    start, stop = (None, None) if frames is None else frames
    start = 0 if start is None else start
    got = format_range(start, stop)
    require(
        start >= 0 and (stop is None or stop >= 0),
        "frames",
        expected="A:B counted from the start",
        got=got,
        cure="Use 0 or more.",
        kind=VideoError,
    )
    require(
        stop is None or stop > start,
        "frames",
        expected="A:B with at least 1 frame",
        got=got,
        cure="Choose B > A.",
        kind=VideoError,
    )
    return start, stop


def check_range_within(start: int, stop: int | None, num_total: int, path: Path) -> None:
    require(
        start < num_total and (stop is None or stop <= num_total),
        "frames",
        expected=f"A:B within 0:{num_total}, the frames of {str(path)!r}",
        got=format_range(start, stop),
        cure=f"Choose B <= {num_total} and A below it.",
        kind=VideoError,
    )


def check_frame_size(size: Size | None, parameter: str = "size") -> Size | None:
    if size is None:
        return None
    sides = tuple(size) if isinstance(size, tuple | list | np.ndarray) else ()
    require(
        len(sides) == 2 and all(is_within(side, "[1, inf)") and side == int(side) for side in sides),
        parameter,
        expected="height and width of whole pixels, at least 1",
        got=f"{sides[0]}x{sides[1]}" if len(sides) == 2 else repr(size),
        cure="Write it as HEIGHTxWIDTH, such as 160x320.",
        kind=VideoError,
    )
    return int(sides[0]), int(sides[1])


def clamp_stop(start: int, stop: int | None, num_total: int, path: Path) -> int:
    """The end of a range in a clip of `num_total` frames, which may end before. Raises `VideoError` if empty."""
    check_range_within(start, None, num_total, path)
    return num_total if stop is None else min(stop, num_total)


def check_fps(fps: float) -> None:
    require(
        is_within(fps, f"[{MIN_FPS}, {MAX_FPS}]"),
        "fps",
        expected=f"a rate in [{MIN_FPS:g}, {MAX_FPS:g}]",
        got=repr(fps),
        cure="Try 25.",
        kind=VideoError,
    )


def check_num_pixels(path: Path, size: Size) -> None:
    """Raise where a header claims more than `MAX_PIXELS`, before memory is allocated for them."""
    require(
        size[0] * size[1] <= MAX_PIXELS,
        "path",
        expected=f"images of at most {MAX_PIXELS:,} pixels",
        got=f"{format_size(size)} in the header of {str(path)!r}",
        cure="The file is damaged, or must be scaled down first.",
        kind=VideoError,
    )


def video_error(parameter: str, *, expected: str, got: str, cure: str = "") -> VideoError:
    return invalid(parameter, expected=expected, got=got, cure=cure, kind=VideoError)


def check_decoded(num_kept: int, start: int, stop: int | None, num_decoded: int, num_total: int, path: Path) -> None:
    """Raise `VideoError` for a range beyond the `num_total` frames that a clip declares, or in which none decodes."""
    check_range_within(start, None, num_total, path)
    require(
        num_kept,
        "frames",
        expected="a range with frames that decode",
        got=f"{format_range(start, stop)}, while {num_decoded} of {num_total} frames decode in {str(path)!r}",
        cure="Choose earlier frames.",
        kind=VideoError,
    )


def format_range(start: int, stop: int | None) -> str:
    return f"{start}:{'' if stop is None else stop}"


def format_size(shape: tuple) -> str:
    return f"{shape[0]}x{shape[1]} (height x width)"


def format_num_bytes(path: Path) -> str:
    size = path.stat().st_size
    return "an empty file" if size == 0 else f"{size} bytes"


@dataclass(frozen=True, eq=False)
class ClipFacts:
    """What a pass finds.

    `kind`: a video, a folder of images, or an animation or one image ("pictures"). `fps`: the rate that the clip
    declares, or a default; None where its frames have durations of their own. `num_total`: the number of frames that
    the clip declares. `stamps`: of all frames decoded, from the first of the file on, in units of `time_base` seconds.
    `end`: when the last of these ends, in seconds; 0 where that is unknown. `notes`: about the whole clip. `threads`:
    of the decoder. `damaged`: the numbers of frames at or before which data do not decode without errors. `resized`:
    the numbers of frames whose size differs from the video's. `names`: file names of the images of a folder.
    """

    kind: Literal["video", "folder", "pictures"]
    fps: float | None
    num_total: int
    stamps: Int[np.ndarray, " num_decoded"] | Float[np.ndarray, " num_decoded"]
    time_base: float
    end: float = 0.0
    notes: list[str] = field(default_factory=list)
    threads: int = 0
    damaged: list[int] = field(default_factory=list)
    resized: list[int] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def describe_span(
        self, start: int, end: int, stop: int | None, fps: float | None = None
    ) -> tuple[int, FrameRate, tuple[str, ...]]:
        """Number of frames that the clip declares from `start` up to `stop`, their rate, unless `fps` is given, and
        notes. Those that decode are `start` up to `end`."""
        stop_within = self.num_total if stop is None else min(stop, self.num_total)
        num_declared, notes, within = stop_within - start, [], range(start, end)
        if stop is not None and stop > stop_within:
            used = f"the clip ends at {stop_within}: {format_range(start, stop_within)} are used."
            notes.append(f"frames {format_range(start, stop)} were asked for, and {used}")
        if len(within) < num_declared:
            notes.append(f"only {len(within)} of {num_declared} frames decode; those are used.")
        notes += self.notes
        notes += _describe_few([one for one in self.damaged if one in within], "damaged, and may show artifacts")
        resized = [one for one in self.resized if one in within]
        notes += _describe_few(resized, "of another size than the video, and stretched to it")
        rate = self._find_rate(start, end) if fps is None else FrameRate(fps)
        return num_declared, rate, (*notes, *describe_rate(rate))

    def _find_rate(self, first: int, end: int) -> FrameRate:
        """The rate of the frames with the numbers `first` up to `end`."""
        seconds, last = make_increasing((self.stamps * self.time_base).tolist(), self.fps), self.end
        if end < len(seconds):  # until the next one is shown
            last = float(seconds[end])
        fps = self.fps or (end - first) / (last - seconds[first])
        rate = estimate_rate(seconds[first:end], fps, last)
        if self.kind == "video":
            rate = rate._replace(first_second=float(seconds[first] - seconds[0]))
        if np.ptp(self.stamps[:end]) == 0 and end > 1:  # a raw stream: the rate is FFmpeg's guess
            rate = rate._replace(guessed=True)
        return rate


def _describe_few(positions: list[int], what: str) -> tuple[str, ...]:
    """A note about frames of these numbers; `what`: their property, as a predicate without its verb."""
    if not positions:
        return ()
    which = f"frame {positions[0]} is"
    which = which if len(positions) == 1 else f"{len(positions):,} frames, the first of them {positions[0]}, are"
    return (f"{which} {what}.",)
