"""Clips in memory, what a pass through a clip finds, and the checks that readers and writers of clips share."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Int

from foldgauss._runtime.checks import ParameterError, check_one_of, invalid, is_integer, is_within, require
from foldgauss.io._atomic import PathLike, check_input, check_path
from foldgauss.io.media.frame_rate import MAX_FPS, MIN_FPS, FrameRate, describe_rate, estimate_rate, make_increasing

HEAD_BYTES = 1 << 16  # by which the format of a file is detected
MAX_PIXELS = 178_956_970  # of one image, Pillow's limit: a header may claim any size
VIDEO = "a video file or a folder of images"
#: What becomes of an interlaced frame: one frame, one for each of its two fields, or an error.
DEINTERLACE = ("frames", "fields", "refuse")
WHITE = (1 << 16) - 1  # the value of white in data of 16 bits
DEPTHS = (8, 10, 12, 14)  # bits of cameras and microscopes whose values are stored in 16
Range = tuple[int | None, int | None]
Size = tuple[int, int]  # (height, width)
Stretch = tuple[Size, Size]  # the size of frames as stored, and that to which they are stretched


class VideoError(ParameterError):
    """A clip cannot be read or written as requested; the one-line message says what was expected, what was got, and
    how to correct it."""


class Reading(NamedTuple):
    """Options of `read_video` that decide which frames a file has, and their colors; see there."""

    deinterlace: str = "frames"
    levels: int | None = None

    @property
    def changed(self) -> dict[str, Any]:
        """The options that differ from their defaults."""
        return {name: value for name, value in self._asdict().items() if value != self._field_defaults[name]}


AS_STORED = Reading()


class Levels:
    """Converts values of 16 bits to 8. `white`: the value that becomes 255, None for 65535. `most`: the largest value;
    -1 where none was converted."""

    def __init__(self, white: int | None = None):
        self.white, self.most = white, -1

    def convert(self, image: np.ndarray) -> np.ndarray:
        """uint8 from uint16, to nearest. The last of four channels is alpha, whose values are not recorded."""
        self.most = max(self.most, int(image[..., :3].max()) if image.ndim == 3 else int(image.max()))
        white = self.white or WHITE
        return ((np.minimum(image, white).astype(np.uint32) * 255 + white // 2) // white).astype(np.uint8)

    def describe(self, path: Path, kind: str = "a clip of fewer bits") -> tuple[str, ...]:
        """A note where the values that were converted seem to have fewer bits, or are clipped.

        Raises `VideoError` where `white` is given, but applies to no frame of `path`, a clip of this `kind`.
        """
        require(
            self.white is None or self.most >= 0,
            "levels",
            expected="images or videos of 16 bits, in RGB or gray",
            got=f"{kind}, {str(path)!r}",
            cure="Leave levels out.",
            kind=VideoError,
        )
        if self.white is not None:
            clipped = f"values of up to {self.most:,} are above levels={self.white} and become white."
            return (clipped,) if self.most > self.white else ()
        whites = ((1 << bits) - 1 for bits in DEPTHS)
        white = next((white for white in whites if 0 < self.most <= white), None)
        if white is None:
            return ()
        found = f"the largest value is {self.most:,} of {WHITE:,}, as in data of {white.bit_length()} bits"
        return (f"{found}, which look dark; levels={white} (foldgauss fit --levels {white}) makes {white} white.",)


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
    of the video file; 0 of images, and where `fps` was given. `reading`: the options by which it was read.
    `stretched`: of a video whose pixels are not square, the size of its frames as stored, upright, and that with square
    pixels, before `size` applies; otherwise None.
    """

    frames: np.ndarray
    fps: float
    source: str
    num_declared: int
    times: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    first_second: float = 0.0
    duration: float | None = None
    reading: Reading = AS_STORED
    stretched: Stretch | None = None

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


def check_reading(deinterlace: str, levels: int | None) -> Reading:
    check_one_of("deinterlace", deinterlace, DEINTERLACE)
    require(
        levels is None or (is_integer(levels, 1) and levels <= WHITE),
        "levels",
        expected=f"the value of white, 1 to {WHITE}",
        got=repr(levels),
        cure="Of data of 12 bits it is 4095.",
        kind=VideoError,
    )
    return Reading(deinterlace, levels)


def check_num_pixels(path: Path, size: Size) -> None:
    """Raise where a header claims more than `MAX_PIXELS`, before memory is allocated for them."""
    if size[0] * size[1] > MAX_PIXELS:
        raise video_error(
            "path",
            expected=f"images of at most {MAX_PIXELS:,} pixels",
            got=f"{format_size(size)} in the header of {str(path)!r}",
            cure="The file is damaged, or must be scaled down first.",
        )


def video_error(parameter: str, *, expected: str, got: str, cure: str = "") -> VideoError:
    return invalid(parameter, expected=expected, got=got, cure=cure, kind=VideoError)


def no_frames_error(start: int, stop: int | None, num_decoded: int, num_total: int, path: Path) -> VideoError:
    """The error for a range in which no frame decodes."""
    got = f"{format_range(start, stop)}, while {num_decoded} of {num_total} frames decode in {str(path)!r}"
    return video_error("frames", expected="a range with frames that decode", got=got, cure="Choose earlier frames.")


def format_range(start: int, stop: int | None) -> str:
    return f"{start}:{'' if stop is None else stop}"


def format_size(shape: tuple) -> str:
    return f"{shape[0]}x{shape[1]} (height x width)"


def format_num_bytes(path: Path) -> str:
    size = path.stat().st_size
    return "an empty file" if size == 0 else f"{size} bytes"


@dataclass(frozen=True, eq=False)
class ClipFacts:
    """What a pass finds; positions count the frames of the file, those lost to damage included.

    `kind`: a video, a folder of images, or an animation or one image ("pictures"). `fps`: the rate that the clip
    declares, or a default; None where its frames have durations of their own. `num_total`: the number of frames, lost
    ones included. Of all frames decoded, from the first of the file on, `positions`, and `stamps` in units of
    `time_base` seconds. `end`: when the last of these ends, in seconds; 0 where that is unknown. `notes`: about the
    whole clip. `threads`: of the decoder. `damaged`, `resized`: the positions of frames that decode with errors, and of
    those of another size than the video. `stretched`: as of `Clip`. `names`: of the images of a folder.
    """

    kind: Literal["video", "folder", "pictures"]
    fps: float | None
    num_total: int
    positions: Int[np.ndarray, " num_decoded"]
    stamps: Int[np.ndarray, " num_decoded"]
    time_base: float
    end: float = 0.0
    notes: list[str] = field(default_factory=list)
    threads: int = 0
    damaged: list[int] = field(default_factory=list)
    resized: list[int] = field(default_factory=list)
    stretched: Stretch | None = None
    names: list[str] = field(default_factory=list)

    def describe_span(
        self, first: int, end: int, start: int, stop: int | None, fps: float | None = None
    ) -> tuple[int, FrameRate, tuple[str, ...]]:
        """Number of frames that the clip has from position `start` up to `stop`, their rate, unless `fps` is given, and
        notes. Those that decode are the numbers `first` up to `end` of all frames decoded."""
        stop_within = self.num_total if stop is None else min(stop, self.num_total)
        places, num_declared, notes = self.positions[first:end], stop_within - start, []
        if stop is not None and stop > stop_within:
            used = f"the clip ends at {stop_within}: {format_range(start, stop_within)} are used."
            notes.append(f"frames {format_range(start, stop)} were asked for, and {used}")
        if end - first < num_declared:
            notes.append(f"only {end - first} of {num_declared} frames decode; those are used.")
        notes += self.notes
        lost = np.setdiff1d(np.arange(start, places[-1]), places).tolist()
        within = range(places[0], places[-1] + 1)
        notes += _describe_few(lost, "lost to damage and left out; what follows may show artifacts")
        notes += _describe_few([one for one in self.damaged if one in within], "damaged, and may show artifacts")
        resized = [one for one in self.resized if one in within]
        notes += _describe_few(resized, "of another size than the video, and stretched to it")
        rate = self._find_rate(first, end) if fps is None else FrameRate(fps)
        return num_declared, rate, (*notes, *describe_rate(rate))

    def _find_rate(self, first: int, end: int) -> FrameRate:
        """The rate of the frames with the numbers `first` up to `end`."""
        seconds, last = make_increasing((self.stamps * self.time_base).tolist(), self.fps), self.end
        if end < len(seconds):  # until the next one is shown, unless others were lost before it
            last = float(seconds[end]) if self.positions[end] == self.positions[end - 1] + 1 else 0.0
        fps = self.fps or (end - first) / (last - seconds[first])
        rate = estimate_rate(seconds[first:end], fps, last)
        if self.kind == "video":
            rate = rate._replace(first_second=float(seconds[first] - seconds[0]))
        if np.ptp(self.stamps[:end]) == 0 and end > 1:  # a raw stream: the rate is FFmpeg's guess
            rate = rate._replace(guessed=True)
        return rate


def _describe_few(positions: list[int], what: str) -> tuple[str, ...]:
    """A note about frames at these positions; `what`: their property, as a predicate without its verb."""
    if not positions:
        return ()
    which = f"frame {positions[0]} is"
    which = which if len(positions) == 1 else f"{len(positions):,} frames, the first of them {positions[0]}, are"
    return (f"{which} {what}.",)
