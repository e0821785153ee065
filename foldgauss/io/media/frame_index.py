"""An index of a clip, made in one pass, by which any span of its frames is decoded without starting at the first."""

import hashlib
import json
import operator
import os
import zipfile
import zlib
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from foldgauss.io._atomic import PathLike, atomic_path, check_path
from foldgauss.io.media.clip import (
    Range,
    Size,
    VideoError,
    check_fps,
    check_range,
    check_readable,
    format_range,
    translate_os_errors,
    video_error,
)
from foldgauss.io.media.frame_rate import describe_rate, make_increasing
from foldgauss.io.media.image_files import image_paths, read_folder
from foldgauss.io.media.video_decoding import DecodeReport, decode_file, read_video_file
from foldgauss.io.media.video_reading import choose_reader
from foldgauss.video.motion.optical_flow import CutFinder

DIGEST_BYTES = 16
_FORMAT = 3
#: What NumPy raises for other files, and our own checks for other arrays.
_LOAD_ERRORS = (
    OSError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    NotImplementedError,  # zipfile: an unknown compression method
    zipfile.BadZipFile,
    zlib.error,
)


class FrameIndex:
    """The index of a clip; made by `index_video`.

    `source`: the path as given. `kind`: "video", "folder" or "pictures" (an animation, or one image). `num_frames`,
    `fps`, `times`, `duration`, `first_second`, `num_declared`, `notes`: as in `Clip`. `size`: (height, width) of the
    frames as stored. `has_alpha`: whether any frame is transparent anywhere. `cuts`: the frames, in order, that begin a
    new shot; empty where they were not searched for. `digest`: of all frames as stored, in hexadecimal; it shows
    whether a file is still the one that was indexed. `positions`: int64 (num_frames,), the position of each frame in
    the range: k for frame k, except in a clip that lost frames to damage.

    About 40 bytes per frame. It can be pickled, and saved with `save`.
    """

    # Beyond these, for the reader: `path`, absolute; `start`, the first frame of the range in the file; of all frames
    # decoded from the file's first on `stamps` and `places`; of those indexed `digests` and `transparent`.

    def __init__(self, about: dict, arrays: dict[str, np.ndarray]):
        """`about`, JSON types, and `arrays` are what a file holds."""
        self._about, self._arrays = about, arrays
        self.stamps, self.places = arrays["stamps"], arrays["places"]
        self.digests, self.transparent = arrays["digests"], arrays["transparent"]
        self.times: np.ndarray | None = arrays.get("times")
        self.source: str = about["source"]
        self.path = Path(about["path"])
        self.kind: str = about["kind"]
        self.start: int = about["start"]
        self.names: list[str] = about["names"]
        self.deinterlace: bool = about["deinterlace"]
        self.fixed_fps: float | None = about["fixed_fps"]
        self.fps: float = about["fps"]
        self.first_second: float = about["first_second"]
        self.duration: float | None = about["duration"]
        self.size: Size = tuple(about["size"])
        self.num_declared: int = about["num_declared"]
        self.notes: tuple[str, ...] = tuple(about["notes"])
        self.cuts: list[int] = list(about["cuts"])
        self.num_frames = len(self.digests)
        self.has_alpha = bool(self.transparent.any())
        self.num_before = len(self.places) - self.num_frames  # frames decoded before the first one indexed
        self.positions = self.places[self.num_before :] - self.start
        self.alpha_at_size: dict[Size, bool] = {}  # found by the reader
        self.last_margin = 0  # of the reader's last seek, in frames

    def __repr__(self) -> str:
        height, width = self.size
        return f"FrameIndex({self.source!r}, {self.num_frames} frames, {height}x{width}, {len(self.cuts)} cuts)"

    @property
    def digest(self) -> str:
        whole = hashlib.blake2b(np.array(self.size, np.int64).tobytes(), digest_size=DIGEST_BYTES)
        whole.update(self.digests.tobytes())
        return whole.hexdigest()

    @property
    def num_positions(self) -> int:
        """Frames in the range, including those lost to damage between others."""
        return int(self.positions[-1]) + 1

    @cached_property
    def report(self) -> DecodeReport:
        about = self._about
        time_base, notes = about["time_base"], tuple(about["shape_notes"])
        seconds = make_increasing((self.stamps * time_base).tolist(), about["rate"])
        arrays = self.places, self.stamps, seconds
        return DecodeReport(
            about["rate"], about["num_total"], notes, *arrays, time_base, about["threads"], about["end"]
        )

    def span(self, first: int, stop: int) -> tuple[int, int]:
        """The range, for `read_indexed`, of the frames `first` up to `stop` of those that decode: the same numbers
        except in a damaged clip. Raises `VideoError` for frames that do not exist."""
        first, stop = self.check_frames(first, stop)
        return int(self.positions[first]), int(self.positions[stop - 1]) + 1

    def check_frames(self, first: int, stop: int | None) -> tuple[int, int]:
        """A range of frames that decode. Raises `VideoError` for one that is empty or beyond the clip."""
        first, stop = operator.index(first), self.num_frames if stop is None else operator.index(stop)
        if not 0 <= first < stop <= self.num_frames:
            raise self.range_error(first, stop, self.num_frames)
        return first, stop

    def range_error(self, first: int, stop: int | None, num: int) -> VideoError:
        """The error for a range that is empty or beyond the `num` frames of the clip."""
        expected = f"a range within 0:{num}, the frames of {self.source!r}"
        cure = f"Choose stop <= {num} and first below it."
        return video_error("first, stop", expected=expected, got=format_range(first, stop), cure=cure)

    def save(self, path: PathLike) -> Path:
        """Write to a file (.npz), whole or not at all; returns the path. Raises `OutputError`."""
        path, about = check_path(path), json.dumps({"format": _FORMAT, **self._about})
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, about=np.frombuffer(about.encode(), np.uint8), **self._arrays)
        return path

    @classmethod
    def load(cls, path: PathLike) -> "FrameIndex":
        """What `save` wrote. Raises `FileNotFoundError`, and `VideoError` for another file."""
        path = check_path(path)
        try:
            # The file is opened here, because NumPy leaves a damaged one open.
            with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
                about = json.loads(arrays.pop("about").tobytes())
                if about.pop("format") != _FORMAT:
                    raise ValueError("format")
                num, num_passed = len(arrays["transparent"]), len(arrays["places"])
                shapes = arrays["digests"].shape, arrays["stamps"].shape
                if not 0 < num <= num_passed or shapes != ((num, DIGEST_BYTES), (num_passed,)):
                    raise ValueError("shapes")
                return cls(about, arrays)
        except FileNotFoundError:
            raise
        except _LOAD_ERRORS as error:
            expected, got = "an index of a clip, as FrameIndex.save writes it", repr(str(path))
            cure = "Make it again: index_video(CLIP).save(PATH)."
            raise video_error("path", expected=expected, got=got, cure=cure) from error


# --------------------------------------------------------------------------------------------- indexing


def digest_frame(image: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image), digest_size=DIGEST_BYTES).digest()


def index_video(
    path: PathLike,
    *,
    frames: Range | None = None,
    fps: float | None = None,
    on_frame: Callable[[], object] = lambda: None,
    find_cuts: bool = True,
    deinterlace: bool = True,
) -> FrameIndex:
    """Decode a clip once, frame by frame, and return its index. Memory: a few frames, and some 100 bytes per frame.

    `path`, `fps` and `deinterlace` as in `read_video`, with the same errors. `frames = (A, B)` restricts the clip to
    A <= i < B; the index counts from A. `on_frame()` is called after each frame that is kept. `find_cuts`: search for
    frames that begin a new shot, as `foldgauss.video.motion.optical_flow.Motion.cuts` does.

    Raises `FileNotFoundError` for a missing path, `VideoError` for everything else that cannot be read.
    """
    path = check_readable(path)
    start, stop = check_range(frames)
    if fps is not None:
        check_fps(fps)
    digests, transparent, finder = bytearray(), bytearray(), CutFinder() if find_cuts else None
    report, names = None, []

    def record(image: np.ndarray) -> Size:
        """Record what the index needs of a frame; its size."""
        digests.extend(digest_frame(image))
        transparent.append(int(image.shape[2] == 4 and image[..., 3].min() < 255))
        if finder is not None:
            finder.add(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB))
        on_frame()
        return image.shape[:2]

    with translate_os_errors(path):
        reader = choose_reader(path)
        if reader is read_video_file:
            found, report = decode_file(path, start, stop, lambda decoded: list(map(record, decoded)), deinterlace)
        else:
            found = reader(path, start, stop, record)
            if reader is read_folder:
                names = [entry.name for entry in image_paths(path)[start:stop]]
    kept, num_declared, rate, notes = found
    if fps is None:
        notes += describe_rate(rate)
    about = {
        "source": str(path),
        "path": os.path.abspath(path),
        "kind": "video" if report else "folder" if names else "pictures",
        "start": start,
        "fixed_fps": None if fps is None else float(fps),
        "fps": float(rate.fps if fps is None else fps),
        "first_second": rate.first_second if fps is None else 0.0,
        "duration": rate.duration if fps is None else None,
        "end": report.end if report else 0.0,
        "size": [int(side) for side in kept[-1]],
        "num_declared": int(num_declared),
        "notes": list(notes),
        "cuts": [] if finder is None else finder.found,
        "names": names,
        "rate": float(report.fps if report else rate.fps),
        "num_total": int(report.num_total) if report else 0,
        "time_base": report.time_base if report else 0.0,
        "threads": report.threads if report else 0,
        "deinterlace": bool(deinterlace),
        "shape_notes": list(report.notes) if report else [],
    }
    arrays = {
        "stamps": report.stamps if report else np.zeros(len(kept), np.int64),
        "places": report.positions if report else np.arange(start, start + len(kept)),
        "digests": np.frombuffer(bytes(digests), np.uint8).reshape(-1, DIGEST_BYTES),
        "transparent": np.frombuffer(transparent, np.uint8).astype(bool),
    }
    return FrameIndex(about, arrays if fps is not None or rate.times is None else arrays | {"times": rate.times})
