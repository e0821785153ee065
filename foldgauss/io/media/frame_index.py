"""Spans of long clips: one pass leaves a small index, by which any frames are found again without decoding from the
start, exact to the bit."""

import hashlib
import json
import operator
import os
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from foldgauss._runtime.checks import short_repr
from foldgauss.io._atomic import atomic_path, checked_path
from foldgauss.io.media.rates import FrameRate, risen
from foldgauss.io.media.video_file import (
    Clip,
    DecodeReport,
    PathLike,
    Range,
    Seen,
    VideoError,
    check_fps,
    checked_range,
    checked_size,
    fit_to,
    frames_decoded,
    frames_grabbed,
    image_paths,
    none_decodes,
    open_video,
    pace_notes,
    pass_through,
    quiet,
    read_file,
    read_folder,
    read_pictures,
    readable_path,
    reader_of,
    told_of_span,
    unreadable_told,
    video_error,
)
from foldgauss.video.fitting.optical_flow import CutFinder

DIGEST_BYTES = 16
#: Frames before the one wanted at which a seek aims, one after the other: what follows a place in the midst of a stream
#: may be blemished until a frame that stands alone.
MARGINS = (1, 16, 64, 256, 1024, 4096, 16384)
#: Frames ahead to which an open decoder goes on instead of seeking.
NEAR = 64
#: Milliseconds within which two times are one.
SAME_TIME = 1e-3
#: Frames of a run that `LazyFrames` holds.
RUN = 32
_START, _STEPS = "from the start", "from the start, every frame looked at"
_FORMAT = 1
#: What NumPy raises of other files, and we of other arrays.
_NO_INDEX = (
    OSError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    NotImplementedError,  # zipfile: of a compression that it does not know
    zipfile.BadZipFile,
    zlib.error,
)


def _checked(**arrays: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of an index; raises ValueError where they do not belong together."""
    num, seen = len(arrays["transparent"]), len(arrays["places"])
    shapes = arrays["digests"].shape, arrays["milliseconds"].shape
    if not 0 < num <= seen or shapes != ((num, DIGEST_BYTES), (seen,)):
        raise ValueError("shapes")
    return arrays


class FrameIndex:
    """What one pass through a clip leaves; made by `index_video`.

    `source`: the path as given. `kind`: "video", "folder" or "pictures" (an animation, or one image). `num_frames`,
    `fps`, `times`, `num_declared`, `notes`: as `Clip` has them. `size`: (height, width) of the frames as they are.
    `has_alpha`: whether any frame is transparent anywhere. `cuts`: the frames, in order, that begin another shot; empty
    where none were looked for. `digest`: of all frames as they are, a hexadecimal text; it tells whether a file is
    still the one that was indexed. `positions`: int64 (num_frames,), where in the range each frame stands: k for frame
    k, but in a clip that lost frames to damage.

    Some 40 bytes a frame. It can be pickled, and saved with `save`.
    """

    def __init__(
        self,
        about: dict,
        milliseconds: np.ndarray,
        places: np.ndarray,
        digests: np.ndarray,
        transparent: np.ndarray,
        times: np.ndarray | None,
    ):
        self._about = about
        self._milliseconds, self._places = milliseconds, places  # of all frames seen, from the file's first
        self._digests, self._transparent = digests, transparent  # of those indexed
        self.times = times
        self.source: str = about["source"]
        self.kind: str = about["kind"]
        self.fps: float = about["fps"]
        self.size: tuple[int, int] = tuple(about["size"])
        self.num_declared: int = about["num_declared"]
        self.notes: tuple[str, ...] = tuple(about["notes"])
        self.cuts: list[int] = list(about["cuts"])
        self.num_frames = len(digests)
        self.has_alpha = bool(transparent.any())
        self.positions = places[len(places) - len(digests) :] - about["start"]
        self._alpha_at: dict[tuple[int, int], bool] = {}
        self._margin = 0  # that was last needed, a place in MARGINS

    def __repr__(self) -> str:
        height, width = self.size
        return f"FrameIndex({self.source!r}, {self.num_frames} frames, {height}x{width}, {len(self.cuts)} cuts)"

    @property
    def digest(self) -> str:
        whole = hashlib.blake2b(np.array(self.size, np.int64).tobytes(), digest_size=DIGEST_BYTES)
        whole.update(self._digests.tobytes())
        return whole.hexdigest()

    @property
    def num_positions(self) -> int:
        """Frames in the range, with those that damage left out between others."""
        return int(self.positions[-1]) + 1

    def span(self, first: int, stop: int) -> tuple[int, int]:
        """The range, for `read_indexed`, of the frames `first` up to `stop` of those that decode: the same numbers but
        in a damaged clip. Raises `VideoError` for frames that there are not."""
        first, stop = _checked_numbers(self, first, stop)
        return int(self.positions[first]), int(self.positions[stop - 1]) + 1

    def save(self, path: PathLike) -> Path:
        """Write to a file (.npz), whole or not at all; returns the path. Raises `OutputError`."""
        path = checked_path(path)
        about = np.frombuffer(json.dumps({"format": _FORMAT, **self._about}).encode(), np.uint8)
        arrays = {name: array for name, array in self._arrays().items() if array is not None}
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, about=about, **arrays)
        return path

    @classmethod
    def load(cls, path: PathLike) -> "FrameIndex":
        """What `save` wrote. Raises `FileNotFoundError`, and `VideoError` for another file."""
        path = checked_path(path)
        try:
            # The file is opened here, for NumPy leaves that of a broken one open.
            with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
                about = json.loads(arrays.pop("about").tobytes())
                if about.pop("format") != _FORMAT:
                    raise ValueError("format")
                return cls(about, times=arrays.pop("times", None), **_checked(**arrays))
        except FileNotFoundError:
            raise
        except _NO_INDEX as error:
            raise video_error(
                "path",
                expected="an index of a clip, as FrameIndex.save writes it",
                got=f"{str(path)!r}",
                cure="Make it again: index_video(CLIP).save(PATH).",
            ) from error

    def _arrays(self) -> dict[str, np.ndarray | None]:
        return {
            "milliseconds": self._milliseconds,
            "places": self._places,
            "digests": self._digests,
            "transparent": self._transparent,
            "times": self.times,
        }

    @cached_property
    def _told(self) -> DecodeReport:
        about = self._about
        seconds = risen(self._milliseconds.tolist(), about["rate"])
        return DecodeReport(about["rate"], about["num_total"], tuple(about["shape_notes"]), seconds, about["threads"])

    @property
    def _path(self) -> Path:
        return Path(self._about["path"])

    @property
    def _before(self) -> int:
        """Frames seen before the first one indexed."""
        return len(self._places) - self.num_frames


# --------------------------------------------------------------------------------------------- indexing


class _Recorder:
    """Takes frames one by one and keeps of each what the index needs."""

    def __init__(self, find_cuts: bool, on_frame: Callable[[], object]):
        self.digests, self.transparent, self.size = bytearray(), bytearray(), (0, 0)
        self._cuts, self._on_frame = CutFinder() if find_cuts else None, on_frame

    def __call__(self, image: np.ndarray) -> int:
        self.size = image.shape[:2]
        self.digests += _digest(image)
        self.transparent.append(int(image.shape[2] == 4 and image[..., 3].min() < 255))
        if self._cuts is not None:
            self._cuts.add(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB))
        self._on_frame()
        return len(self.transparent)

    @property
    def cuts(self) -> list[int]:
        return [] if self._cuts is None else self._cuts.found


def _digest(image: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image), digest_size=DIGEST_BYTES).digest()


def index_video(
    path: PathLike,
    *,
    frames: Range | None = None,
    fps: float | None = None,
    on_frame: Callable[[], object] = lambda: None,
    find_cuts: bool = True,
) -> FrameIndex:
    """Decode a clip once, frame by frame, and return its index. Memory: a few frames, and some 100 bytes a frame.

    `path` and `fps` as `read_video` has them, and refused alike. `frames = (A, B)` restricts the clip to frames
    A <= i < B; the index counts from A. `on_frame()` is called after each frame that is kept. `find_cuts`: look for
    frames that begin another shot, as `foldgauss.video.fitting.optical_flow.Motion.find_cuts` does.

    Raises `FileNotFoundError` for a missing path, `VideoError` for everything else that cannot be read.
    """
    path = readable_path(path)
    start, stop = checked_range(frames)
    if fps is not None:
        check_fps(fps)
    record, seen, told, names = _Recorder(find_cuts, on_frame), None, None, []
    with unreadable_told(path):
        reader = reader_of(path)
        if reader is read_file:
            kept, seen, told = pass_through(path, start, stop, lambda decoded: list(map(record, decoded)))
        else:
            kept, num_declared, pace, notes = reader(path, start, stop, record)
            if reader is read_folder:
                names = [entry.name for entry in image_paths(path)[start:stop]]
    if told is None:
        seen = [Seen(start + k, 0.0) for k in range(len(kept))]
    milliseconds, places = np.array([one.milliseconds for one in seen]), np.array([one.position for one in seen])
    if told is not None:
        num_declared, pace, notes = told_of_span(told, milliseconds, places.tolist(), len(kept), start, stop)
    if fps is None:
        notes += pace_notes(pace)
    about = {
        "source": str(path),
        "path": os.path.abspath(path),
        "kind": "video" if told else "folder" if names else "pictures",
        "start": start,
        "fixed_fps": None if fps is None else float(fps),
        "fps": float(pace.fps if fps is None else fps),
        "size": [int(side) for side in record.size],
        "num_declared": int(num_declared),
        "notes": list(notes),
        "cuts": record.cuts,
        "names": names,
        "rate": float(told.fps if told else pace.fps),
        "num_total": int(told.num_total) if told else 0,
        "threads": max(told.threads, 0) if told else 0,
        "shape_notes": list(told.notes) if told else [],
    }
    digests = np.frombuffer(bytes(record.digests), np.uint8).reshape(-1, DIGEST_BYTES)
    transparent = np.frombuffer(bytes(record.transparent), np.uint8).astype(bool)
    return FrameIndex(about, milliseconds, places, digests, transparent, pace.times if fps is None else None)


# ---------------------------------------------------------------------------------------------- reading


def read_indexed(index: FrameIndex, first: int, stop: int | None, *, size: tuple[int, int] | None = None) -> Clip:
    """Frames `first` up to `stop` of an indexed clip, without decoding from the start: to the bit what
    `read_video(path, frames=(first, stop), size=size)` gives.

    The range is one of places in the clip, as that of `read_video` is: where damage left frames out, so many fewer come
    (`FrameIndex.span` tells the range of frames counted as they decode). `stop=None`: to the end. An index made with
    `frames=(A, B)` counts from A. Where any frame of the whole clip is transparent, the span has alpha, though none of
    its own may be. Every frame is compared with the index.

    Raises `FileNotFoundError` for a missing path; `VideoError` for a range outside the clip, one in which no frame
    decodes, and a file that is not the one indexed.
    """
    first, stop = _checked_span(index, first, stop)
    path, start = _readable(index), index._about["start"]
    size = checked_size(size)
    low, high = np.searchsorted(index.positions, [first, index.num_positions if stop is None else stop]).tolist()
    if low == high:
        raise none_decodes(first, stop, index.num_frames, index.num_positions, path)
    with unreadable_told(path):
        reel = _Reel(index)
        try:
            frames, num_declared, pace, notes = reel.read(low, high, size)
        finally:
            reel.close()
    if index.kind == "video":
        last = index._before + high
        seen, places = index._milliseconds[:last], index._places[:last].tolist()
        end = index._about["start"] + stop if stop is not None else start + index.num_declared
        num_declared, pace, notes = told_of_span(index._told, seen, places, high - low, start + first, end)
    elif stop is None:
        num_declared = index.num_declared - first
    fixed = index._about["fixed_fps"]
    if fixed is not None:
        return Clip(frames, fixed, index.source, num_declared, None, notes)
    return Clip(frames, float(pace.fps), index.source, num_declared, pace.times, notes + pace_notes(pace))


def _checked_span(index: FrameIndex, first: int, stop: int | None) -> tuple[int, int | None]:
    first, stop = checked_range((operator.index(first), None if stop is None else operator.index(stop)))
    num = max(index.num_positions, index.num_declared)
    if first >= num or (stop is not None and stop > num):
        raise video_error(
            "first, stop",
            expected=f"a range within 0:{num}, the frames indexed of {index.source!r}",
            got=f"{first}:{'' if stop is None else stop}",
            cure=f"Choose stop <= {num} and first below it.",
        )
    return first, stop


def _checked_numbers(index: FrameIndex, first: int, stop: int | None) -> tuple[int, int]:
    """Of frames that decode."""
    first, stop = operator.index(first), index.num_frames if stop is None else operator.index(stop)
    if not 0 <= first < stop <= index.num_frames:
        raise video_error(
            "first, stop",
            expected=f"a range within 0:{index.num_frames}, the frames of {index.source!r}",
            got=f"{first}:{stop}",
            cure="Choose first < stop.",
        )
    return first, stop


def _readable(index: FrameIndex) -> Path:
    return readable_path(index._path)


class _Reel:
    """An indexed clip held open, whose frames are found by their numbers."""

    def __init__(self, index: FrameIndex):
        self.index = index
        self._capture: cv2.VideoCapture | None = None
        self._at: int | None = None  # of all frames seen, the one last grabbed
        self._done = 0

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
        self._capture, self._at = None, None

    def read(
        self, first: int, stop: int, size: tuple[int, int] | None
    ) -> tuple[np.ndarray, int, FrameRate, tuple[str, ...]]:
        """Frames `first` up to `stop`, of those that decode, as `Clip.frames`; and what else `read_video` tells."""
        with_alpha, prepare, kept = self.has_alpha(size), fit_to(size), _Sheets(stop - first)

        def take(image: np.ndarray) -> None:
            kept.add(_with_channels(prepare(image), 4 if with_alpha else 3))

        told = self._pass(first, stop, take)
        return kept.frames, *told

    def has_alpha(self, size: tuple[int, int] | None) -> bool:
        """Whether any frame of the whole clip is transparent anywhere, at that size: what is cut off does not count."""
        index = self.index
        if size is None or not index.has_alpha:
            return index.has_alpha
        if size not in index._alpha_at:
            suspects = np.flatnonzero(index._transparent).tolist()
            index._alpha_at[size] = any(self._is_transparent(number, size) for number in suspects)
        return index._alpha_at[size]

    def _is_transparent(self, number: int, size: tuple[int, int]) -> bool:
        found, prepare = [], fit_to(size)
        self._pass(number, number + 1, lambda image: found.append(prepare(image)[..., 3].min() < 255))
        return bool(found[0])

    def _pass(
        self, first: int, stop: int, take: Callable[[np.ndarray], object]
    ) -> tuple[int, FrameRate, tuple[str, ...]]:
        """Hand the frames to `take`, as they are in the file."""
        index = self.index
        if index.kind == "video":
            for image in self._frames(first, stop):
                take(image)
            return stop - first, FrameRate(index.fps), ()
        numbers = iter(range(first, stop))

        def checked(image: np.ndarray) -> object:
            number = next(numbers)
            if _digest(image) != index._digests[number].tobytes():
                raise _changed(index, number)
            return take(image)

        if index.kind == "folder":
            paths = [index._path / name for name in index._about["names"][first:stop]]
            for number, path in enumerate(paths, first):
                if not path.is_file():
                    raise _changed(index, number)
            told = read_pictures(paths, checked)[1:]
        else:
            start = index._about["start"]
            told = reader_of(index._path)(index._path, start + first, start + stop, checked)[1:]
        missing = next(numbers, None)
        if missing is not None:
            raise _changed(index, missing)
        return told

    def _frames(self, first: int, stop: int) -> Iterator[np.ndarray]:
        """Frames of a video file, BGR, each as it was when it was indexed."""
        self._done = first
        for way in self._ways(first):
            yield from self._by(way, stop)
            if self._done == stop:
                if isinstance(way, int):
                    self.index._margin = way
                return
        self.close()
        raise _changed(self.index, self._done)

    def _ways(self, first: int) -> Iterator[int | str | None]:
        """How to get to a frame, the quickest first: going on, seeking with a margin of MARGINS, or from the start."""
        index = self.index
        ahead = index._before + first - self._at if self._at is not None else -1
        if 0 < ahead <= NEAR or (ahead > 0 and not self.seeks):
            yield None
        if self.seeks:
            for number in range(index._margin, len(MARGINS)):
                if index._before + self._done - MARGINS[number] <= 0:
                    break
                yield number
        yield _START
        yield _STEPS

    @property
    def seeks(self) -> bool:
        """Whether it is worth while: a raw stream has no times."""
        return np.ptp(self.index._milliseconds) > 0

    def _by(self, way: int | str | None, stop: int) -> Iterator[np.ndarray]:
        """Frames from the next wanted one on, as far as they come that way."""
        index = self.index
        target = index._before + self._done
        with quiet():
            if way in (_START, _STEPS):
                self.close()
                self._capture, self._at = open_video(index._path, index._about["threads"]), -1
            elif way is not None:
                if self._capture is None:
                    self._capture = open_video(index._path, index._about["threads"])
                self._capture.set(cv2.CAP_PROP_POS_MSEC, index._milliseconds[target - MARGINS[way]])
                self._at = None
        if way == _STEPS:
            yield from self._by_steps(stop)
            return
        grabbed = frames_grabbed(self._capture, index._about["rate"])
        while self._done < stop:
            image = self._next(grabbed)
            if image is None:
                self._at = None
                return
            self._done += 1
            yield image

    def _next(self, grabbed: Iterator[Seen]) -> np.ndarray | None:
        """The next wanted frame; None where it does not come."""
        index = self.index
        target = index._before + self._done
        with quiet():
            for one in grabbed:
                number = self._number(one.milliseconds)
                if number is None:
                    if one.milliseconds > index._milliseconds[target] + SAME_TIME:
                        break
                    continue
                self._at = number
                if number < target:
                    continue
                if number > target:
                    break
                found, image = self._capture.retrieve()
                same = found and _digest(image) == index._digests[self._done].tobytes()
                return image if same else None
        return None

    def _by_steps(self, stop: int) -> Iterator[np.ndarray]:
        """As the index was made."""
        index = self.index
        start, end = index._about["start"], index._about["start"] + int(index.positions[stop - 1]) + 1
        seen: list[Seen] = []
        decoded = frames_decoded(self._capture, index._about["rate"], start, end, seen)
        number = 0
        while self._done < stop:
            with quiet():
                image = next(decoded, None)
            if image is None:
                return
            number += 1
            if number <= self._done:
                continue
            if _digest(image) != index._digests[self._done].tobytes():
                return
            self._at = len(seen) - 1
            self._done += 1
            yield image

    def _number(self, milliseconds: float) -> int | None:
        """Of all frames seen, the one of that time; where several have it, the next one, or the first."""
        known = self.index._milliseconds
        after = 0 if self._at is None else self._at + 1
        if self._at is not None and after < len(known) and abs(known[after] - milliseconds) <= SAME_TIME:
            return after
        near = np.flatnonzero(np.abs(known[after:] - milliseconds) <= SAME_TIME)
        return after + int(near[0]) if len(near) else None


def _with_channels(frame: np.ndarray, channels: int) -> np.ndarray:
    if frame.shape[2] == channels:
        return frame
    return cv2.cvtColor(frame, cv2.COLOR_RGB2RGBA) if channels == 4 else frame[..., :3]


class _Sheets:
    """An array filled frame by frame."""

    def __init__(self, num_frames: int):
        self._num, self._filled, self.frames = num_frames, 0, np.empty((0, 0, 0, 0), np.uint8)

    def add(self, frame: np.ndarray) -> None:
        if not self._filled:
            self.frames = np.empty((self._num, *frame.shape), np.uint8)
        self.frames[self._filled] = frame
        self._filled += 1


def _changed(index: FrameIndex, number: int) -> VideoError:
    return video_error(
        "path",
        expected=f"the file that was indexed, {index.num_frames} frames with the digest {index.digest}",
        got=f"{str(index._path)!r}, in which frame {number} is another",
        cure="It has changed, or another OpenCV decodes it: index it again with index_video, or bring back the file.",
    )


class LazyFrames:
    """The frames of an indexed clip as an array that is read when it is asked for.

    uint8 (num_frames, height, width, 3), or 4 channels where the clip has alpha: those of
    `read_video(path, size=size).frames`, from `first` up to `stop`, which count frames that decode.

    `frames[k]` and `frames[a:b]` give C-contiguous arrays of their own. Going forward decodes each frame about once;
    `run` frames are held for single ones. It can be pickled, and read by several
    threads. The file stays open until `close()`, or until the object goes. Reading raises what `read_indexed` does.
    """

    dtype, ndim = np.dtype(np.uint8), 4

    def __init__(
        self,
        index: FrameIndex,
        size: tuple[int, int] | None = None,
        first: int = 0,
        stop: int | None = None,
        run: int = RUN,
    ):
        first, stop = _checked_numbers(index, first, stop)
        run = operator.index(run)
        if run < 1:
            raise video_error("run", expected="a whole number >= 1", got=str(run), cure=f"Try {RUN}.")
        self.index, self._size = index, checked_size(size)
        self._first, self._stop, self._run = first, stop, run
        self._reel = _Reel(index)
        self._held, self._held_from = None, 0
        self._one_at_a_time = threading.RLock()  # one decoder, one place in the file

    def __getstate__(self) -> dict:
        return {"index": self.index, "size": self._size, "first": self._first, "stop": self._stop, "run": self._run}

    def __setstate__(self, state: dict) -> None:
        self.__init__(**state)

    def __repr__(self) -> str:
        return f"LazyFrames({self.index.source!r}, shape={self.shape})"

    def close(self) -> None:
        """Let the file go, and the frames held; reading opens it again."""
        with self._one_at_a_time:
            self._reel.close()
            self._held = None

    @cached_property
    def shape(self) -> tuple[int, int, int, int]:
        with unreadable_told(self.index._path):
            channels = 4 if self._reel.has_alpha(self._size) else 3
        return len(self), *(self._size or self.index.size), channels

    def __len__(self) -> int:
        return self._stop - self._first

    @property
    def nbytes(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    def __getitem__(self, which: int | slice) -> np.ndarray:
        if isinstance(which, slice):
            chosen = range(len(self))[which]
            if not chosen:
                return np.empty((0, *self.shape[1:]), np.uint8)
            if chosen.step == 1:
                return self._read(chosen.start, chosen.stop)
            taken = np.empty((len(chosen), *self.shape[1:]), np.uint8)
            for place, number in enumerate(chosen):
                taken[place] = self._one(number)
            return taken
        try:
            number = operator.index(which)
        except TypeError as error:
            cure = "Of others take np.stack([frames[k] for k in ...])."
            got = short_repr(which)
            raise video_error(
                "frames[...]", expected="the number of a frame, or a slice", got=got, cure=cure
            ) from error
        if not -len(self) <= number < len(self):
            raise IndexError(f"frames[{number}]: expected a number within {len(self)} frames.")
        return self._one(number % len(self))

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def _one(self, number: int) -> np.ndarray:
        """A frame of its own memory."""
        with self._one_at_a_time:
            if self._held is None or not 0 <= number - self._held_from < len(self._held):
                first = number - number % self._run
                self._held = None  # before others are read
                self._held, self._held_from = self._read(first, min(first + self._run, len(self))), first
            return self._held[number - self._held_from].copy()

    def _read(self, first: int, stop: int) -> np.ndarray:
        with self._one_at_a_time, unreadable_told(self.index._path):
            _readable(self.index)
            return self._reel.read(self._first + first, self._first + stop, self._size)[0]

    def digest(self) -> str:
        """blake2b of 16 bytes over all bytes of the frames in order, as a hexadecimal text; a run at a time."""
        whole = hashlib.blake2b(digest_size=DIGEST_BYTES)
        for first in range(0, len(self), self._run):
            whole.update(self._read(first, min(first + self._run, len(self))))
        return whole.hexdigest()
