"""An index of a clip, made in one pass, by which any span of its frames is decoded without starting at the first."""

import hashlib
import json
import operator
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from foldgauss.io._atomic import PathLike, atomic_path, check_path
from foldgauss.io.media.clip import (
    Range,
    Reading,
    Size,
    Stretch,
    check_fps,
    check_range,
    check_range_within,
    check_readable,
    check_reading,
    translate_os_errors,
    video_error,
)
from foldgauss.io.media.frame_rate import FrameRate, describe_rate
from foldgauss.io.media.image_files import image_paths
from foldgauss.io.media.video_decoding import DecodeReport
from foldgauss.io.media.video_reading import read_frames
from foldgauss.video.motion.optical_flow import CutFinder

DIGEST_BYTES = 16
_FORMAT = 6


class FrameIndex:
    """The index of a clip; made by `index_video`.

    `source`: the path as given. `kind`: "video", "folder" or "pictures" (an animation, or one image). `num_frames`,
    `fps`, `times`, `duration`, `first_second`, `num_declared`, `notes`, `reading`, `stretched`: as in `Clip`. `size`:
    (height, width) of the frames. `has_alpha`: whether any frame is transparent anywhere. `cuts`: the frames, in order,
    that begin a new shot; empty where they were not searched for. `digest`: of all frames as stored, in hexadecimal; it
    shows whether a file is still the one that was indexed. `positions`: int64 (num_frames,), the position of each frame
    in the range: k for frame k, except in a clip that lost frames to damage.

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
        self.reading = Reading(**about["reading"])
        self.fixed_fps: float | None = about["fixed_fps"]
        self.fps: float = about["fps"]
        self.first_second: float = about["first_second"]
        self.duration: float | None = about["duration"]
        self.size: Size = tuple(about["size"])
        self.stretched: Stretch | None = about["report"] and about["report"]["stretched"]
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

    @property
    def report(self) -> DecodeReport:
        """That of a video file."""
        return DecodeReport(**self._about["report"] | {"positions": self.places, "stamps": self.stamps})

    def span(self, first: int, stop: int) -> tuple[int, int]:
        """The range, for `read_indexed`, of the frames `first` up to `stop` of those that decode: the same numbers
        except in a damaged clip. Raises `VideoError` for frames that do not exist."""
        first, stop = self.check_frames(first, stop)
        return int(self.positions[first]), int(self.positions[stop - 1]) + 1

    def check_frames(self, first: int, stop: int | None) -> tuple[int, int]:
        """A range of frames that decode. Raises `VideoError` for one that is empty or beyond the clip."""
        first, stop = check_range((operator.index(first), self.num_frames if stop is None else operator.index(stop)))
        check_range_within(first, stop, self.num_frames, self.source)
        return first, stop

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
        except Exception as error:  # its type depends on the damage
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
    deinterlace: str = "frames",
    levels: int | None = None,
) -> FrameIndex:
    """Decode a clip once, frame by frame, and return its index. Memory: a few frames, and some 100 bytes per frame.

    `path`, `fps`, `deinterlace` and `levels` as in `read_video`, with the same errors. `frames = (A, B)` restricts the
    clip to A <= i < B; the index counts from A. `on_frame()` is called after each frame that is kept. `find_cuts`:
    search for frames that begin a new shot, as `foldgauss.video.motion.optical_flow.Motion.cuts` does.

    Raises `FileNotFoundError` for a missing path, `VideoError` for everything else that cannot be read.
    """
    path = check_readable(path)
    start, stop = check_range(frames)
    reading = check_reading(deinterlace, levels)
    if fps is not None:
        check_fps(fps)
    digests, transparent, finder = bytearray(), bytearray(), CutFinder() if find_cuts else None

    def record(image: np.ndarray) -> Size:
        """Record what the index needs of a frame; its size."""
        digests.extend(digest_frame(image))
        transparent.append(int(image.shape[2] == 4 and image[..., 3].min() < 255))
        if finder is not None:
            finder.add(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB))
        on_frame()
        return image.shape[:2]

    with translate_os_errors(path):
        found, report = read_frames(path, start, stop, lambda images: list(map(record, images)), reading)
        names = [entry.name for entry in image_paths(path)[start:stop]] if path.is_dir() else []
    kept, num_declared, rate, notes = found
    rate = rate if fps is None else FrameRate(float(fps))
    about = {
        "source": str(path),
        "path": os.path.abspath(path),
        "kind": "video" if report else "folder" if names else "pictures",
        "start": start,
        "fixed_fps": None if fps is None else float(fps),
        "fps": float(rate.fps),
        "first_second": rate.first_second,
        "duration": rate.duration,
        "size": [int(side) for side in kept[-1]],
        "num_declared": int(num_declared),
        "notes": [*notes, *describe_rate(rate)],
        "cuts": [] if finder is None else finder.found,
        "names": names,
        "reading": reading.changed,
        "report": report and report._asdict() | {"positions": None, "stamps": None},  # which are arrays
    }
    arrays = {
        "stamps": report.stamps if report else np.zeros(len(kept), np.int64),
        "places": report.positions if report else np.arange(start, start + len(kept)),
        "digests": np.frombuffer(bytes(digests), np.uint8).reshape(-1, DIGEST_BYTES),
        "transparent": np.frombuffer(transparent, np.uint8).astype(bool),
    }
    return FrameIndex(about, arrays if rate.times is None else arrays | {"times": rate.times})
