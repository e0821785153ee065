"""Random access to the frames of a clip, equal to the bit to sequential reading: an index made in one pass, by which
any span is decoded without starting at the first frame, and an array of frames that are decoded on access."""

import ctypes
import gc
import hashlib
import json
import operator
import os
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from foldgauss._runtime.checks import short_repr
from foldgauss.io._atomic import PathLike, atomic_path, check_path
from foldgauss.io.media.clip import (
    Clip,
    ClipFacts,
    Range,
    Size,
    VideoError,
    check_frame_size,
    check_range,
    check_range_within,
    check_readable,
    translate_os_errors,
    video_error,
)
from foldgauss.io.media.decoder import VideoDecoder
from foldgauss.io.media.images import read_images
from foldgauss.io.media.reading import describe_crop, resize_frame, scan_clip, stack_frames
from foldgauss.video.motion.optical_flow import CutFinder

DIGEST_BYTES = 16
_FORMAT = 8
#: Frames before the wanted one at which a seek aims, in turn: after a seek into the middle of a stream, frames may show
#: artifacts until the next key frame.
MARGINS = (0, 16, 64, 256, 1024, 4096, 16384)
#: Distance in frames up to which an open decoder reads on instead of seeking.
NEAR = 64
#: Frames that are decoded together for access to single ones.
RUN = 32


# ------------------------------------------------------------------------------------------------ index


class FrameIndex:
    """The index of a clip; made by `index_video`.

    `source`: the path as given. `kind`: "video", "folder" or "pictures" (an animation, or one image). `num_frames`,
    `fps`, `times`, `duration`, `first_second`, `num_declared`, `notes`: as in `Clip`. `size`: (height, width)
    of the frames. `has_alpha`: whether any frame is transparent anywhere. `cuts`: the frames, in order,
    that begin a new shot; empty where they were not searched for. `digest`: of all frames as stored, in hexadecimal; it
    shows whether a file is still the one that was indexed.

    About 40 bytes per frame. It can be pickled, and saved with `save`.
    """

    # Beyond these, for the reader: `path`, absolute; `start`, the first frame of the range in the file; `facts` of all
    # frames decoded, from the file's first on; `digests` of those indexed.

    def __init__(self, about: dict, facts: ClipFacts, digests: UInt8[np.ndarray, "num_frames 16"]):
        """`about`: JSON types."""
        self._about, self.facts, self.digests = about, facts, digests
        self.source: str = about["source"]
        self.path = Path(about["path"])
        self.start: int = about["start"]
        self.stop: int | None = about["stop"]
        self.size: Size = tuple(about["size"])
        self.has_alpha: bool = about["has_alpha"]
        self.cuts: list[int] = list(about["cuts"])
        self.kind = facts.kind
        self.num_frames, end = len(digests), len(facts.stamps)
        self.num_declared, rate, self.notes = facts.describe_span(self.start, end, self.stop)
        self.fps, self.times, self.first_second = float(rate.fps), rate.times, rate.first_second
        self.duration = rate.duration
        self.last_margin = 0  # of the reader's last seek, in frames

    def __repr__(self) -> str:
        height, width = self.size
        return f"FrameIndex({self.source!r}, {self.num_frames} frames, {height}x{width}, {len(self.cuts)} cuts)"

    @property
    def digest(self) -> str:
        whole = hashlib.blake2b(np.array(self.size, np.int64).tobytes(), digest_size=DIGEST_BYTES)
        whole.update(self.digests.tobytes())
        return whole.hexdigest()

    def check_frames(self, first: int, stop: int | None) -> tuple[int, int]:
        """A range of the frames indexed. Raises `VideoError` for one that is empty or beyond the clip."""
        first, stop = check_range((operator.index(first), self.num_frames if stop is None else operator.index(stop)))
        check_range_within(first, stop, self.num_frames, self.source)
        return first, stop

    def save(self, path: PathLike) -> Path:
        """Write to a file (.npz), whole or not at all; returns the path. Raises `OutputError`."""
        path, facts = check_path(path), vars(self.facts)
        about = {"format": _FORMAT, **self._about, "facts": {k: v for k, v in facts.items() if k != "stamps"}}
        about = np.frombuffer(json.dumps(about).encode(), np.uint8)
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, about=about, digests=self.digests, stamps=self.facts.stamps)
        return path

    @classmethod
    def load(cls, path: PathLike) -> "FrameIndex":
        """What `save` wrote. Raises `FileNotFoundError`, and `VideoError` for another file."""
        path = check_path(path)
        try:
            # The file is opened here, because NumPy leaves a damaged one open.
            with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
                about, digests, stamps = (file[k] for k in ("about", "digests", "stamps"))
            about = json.loads(about.tobytes())
            is_whole = 0 < len(digests) <= len(stamps) and digests.shape[1] == DIGEST_BYTES
            if about.pop("format") != _FORMAT or not is_whole:
                raise ValueError("format")
            return cls(about, ClipFacts(**about.pop("facts"), stamps=stamps), digests)
        except FileNotFoundError:
            raise
        except Exception as error:  # its type depends on the damage
            raise video_error(
                "path",
                expected="an index of a clip, as FrameIndex.save writes it",
                got=repr(str(path)),
                cure="Make it again: index_video(CLIP).save(PATH).",
            ) from error


def _digest_frame(image: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image), digest_size=DIGEST_BYTES).digest()


def index_video(
    path: PathLike,
    *,
    frames: Range | None = None,
    on_frame: Callable[[], object] = lambda: None,
    find_cuts: bool = True,
) -> FrameIndex:
    """Decode a clip once, frame by frame, and return its index. Memory: a few frames, and some 100 bytes per frame.

    `path` as in `read_video`, with the same errors. `frames = (A, B)` restricts the clip to A <= i < B; the index
    counts from A. `on_frame()` is called after each frame that is kept. `find_cuts`: search for frames that begin a new
    shot, as `foldgauss.video.motion.optical_flow.Motion.cuts` does.

    Raises `FileNotFoundError` for a missing path, `VideoError` for everything else that cannot be read.
    """
    path = check_readable(path)
    start, stop = check_range(frames)
    digests, has_alpha, finder = bytearray(), False, CutFinder() if find_cuts else None

    def record(image: np.ndarray) -> Size:
        """Record what the index needs of a frame; its size."""
        nonlocal has_alpha
        digests.extend(_digest_frame(image))
        has_alpha |= image.shape[2] == 4
        if finder is not None:
            finder.add(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB))
        on_frame()
        return image.shape[:2]

    with translate_os_errors(path):
        sizes, facts = scan_clip(path, start, stop, lambda images: list(map(record, images)))
    about = {
        "source": str(path),
        "path": os.path.abspath(path),
        "start": start,
        "stop": stop,
        "size": sizes[-1],
        "has_alpha": has_alpha,
        "cuts": [] if finder is None else finder.found,
    }
    return FrameIndex(about, facts, np.frombuffer(bytes(digests), np.uint8).reshape(-1, DIGEST_BYTES))


# ----------------------------------------------------------------------------------------------- access


def read_indexed(
    index: FrameIndex, first: int, stop: int | None = None, *, size: Size | None = None, lazy: bool = False
) -> Clip:
    """Frames `first` up to `stop` of an indexed clip, without decoding from the start: equal to the bit to
    `read_video(path, frames=(first, stop), size=size)`, counted from the index's first frame on.

    `stop=None`: to the end. Where any frame of the whole clip is transparent, the result has alpha, even if none of its
    own frames is. Every frame is compared with the index. `lazy`: the frames are `LazyFrames`.

    Raises `FileNotFoundError` for a missing path; `VideoError` for a range outside the clip, and a file that is not
    the one indexed.
    """
    first, stop = index.check_frames(first, stop)
    frames = LazyFrames(index, size, first, stop)
    if not lazy:
        with closing(frames) as opened:
            frames = opened[:]
    span = index.start + first, index.start + stop
    num_declared, rate, notes = index.facts.describe_span(*span, span[1])
    crop = () if size is None else describe_crop([index.size], size)
    about = index.source, num_declared, rate.times, notes + crop, rate.first_second, rate.duration
    return Clip(frames, float(rate.fps), *about)


_ALIVE: weakref.WeakSet["LazyFrames"] = weakref.WeakSet()


def _begin_child() -> None:
    """In a forked process never free the parent's decoders, which would wait for threads that a fork does not copy."""
    gc.freeze()
    for frames in list(_ALIVE):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(frames._decoder))
        frames._open()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_child)


class LazyFrames:
    """The frames of an indexed clip as an array that is decoded on access.

    uint8 (num_frames, height, width, 3), or 4 channels where the clip has alpha: those of
    `read_video(path, size=size).frames`, from `first` up to `stop`.

    `frames[k]` and `frames[a:b]` return C-contiguous copies. Forward access decodes each frame about once; some frames
    are cached for access to single ones. The object can be pickled, and read by several threads. A forked process opens
    the file anew; spawned ones are safer, since a fork copies no threads. The file stays open until `close()` or until
    the object is deleted. Reading raises what `read_indexed` does.
    """

    dtype, ndim = np.dtype(np.uint8), 4

    def __init__(self, index: FrameIndex, size: Size | None = None, first: int = 0, stop: int | None = None):
        self._first, self._stop = index.check_frames(first, stop)
        self.index, self._size = index, check_frame_size(size)
        self.shape = self._stop - self._first, *(self._size or index.size), 4 if index.has_alpha else 3
        self._open()
        _ALIVE.add(self)

    def _open(self) -> None:
        self._decoder: VideoDecoder | None = None
        self._frames: Iterator = iter(())
        self._last: int | None = None  # number of the frame decoded last, among all frames of the file; None: unknown
        self._cache, self._cache_start = None, 0
        self._lock = threading.RLock()  # one decoder has one position in the file

    def __reduce__(self) -> tuple:
        return LazyFrames, (self.index, self._size, self._first, self._stop)

    def close(self) -> None:
        """Close the file and drop the cache; the next access opens it again."""
        with self._lock:
            if self._decoder is not None:
                self._decoder.close()
            # The frames hold the decoder and its threads.
            self._decoder, self._frames, self._last, self._cache = None, iter(()), None, None

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, which: int | slice) -> np.ndarray:
        if isinstance(which, slice):
            chosen = range(len(self))[which]
            if chosen and chosen.step == 1:
                return self._read(chosen.start, chosen.stop)
            return np.array([self[number] for number in chosen], np.uint8).reshape(-1, *self.shape[1:])
        try:
            number = operator.index(which)
        except TypeError as error:
            raise video_error(
                "frames[...]",
                expected="the number of a frame, or a slice",
                got=short_repr(which),
                cure="For other indices use np.stack([frames[k] for k in ...]).",
            ) from error
        if not -len(self) <= number < len(self):
            raise IndexError(f"frames[{number}]: expected a number within {len(self)} frames.")
        number %= len(self)
        with self._lock:
            if self._cache is None or not 0 <= number - self._cache_start < len(self._cache):
                start = number - number % RUN
                self._cache = None  # freed before others are read
                self._cache, self._cache_start = self._read(start, min(start + RUN, len(self))), start
            return self._cache[number - self._cache_start].copy()

    def _read(self, first: int, stop: int) -> np.ndarray:
        """Frames `first` up to `stop`, each compared with the index."""
        index, first, stop = self.index, self._first + first, self._first + stop

        def keep(images: Iterator[np.ndarray]) -> np.ndarray:
            return stack_frames((resize_frame(image, self._size) for image in images), self.shape[3])

        def check(images: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
            for number, image in enumerate(images, first):
                if not self._is_frame(number, image):
                    raise _changed_error(index, number)
                yield image

        check_readable(index.path)
        with self._lock, translate_os_errors(index.path):
            if index.kind == "video":
                return keep(self._decode_video(first, stop))
            if index.kind == "folder":
                names = index.facts.names[index.start + first : index.start + stop]
                paths = [index.path / name for name in names if (index.path / name).is_file()]
                frames = keep(check(read_images(paths)))
            else:
                span = index.start + first, index.start + stop
                frames, _ = scan_clip(index.path, *span, lambda images: keep(check(images)))
        if len(frames) < stop - first:
            raise _changed_error(index, first + len(frames))
        return frames

    def _is_frame(self, number: int, image: np.ndarray) -> bool:
        return _digest_frame(image) == self.index.digests[number].tobytes()

    def _decode_video(self, first: int, stop: int) -> Iterator[np.ndarray]:
        """BGR or BGRA frames of a video file, each equal to the indexed one."""
        index, wanted = self.index, first
        for margin in self._margins(first):
            if margin is not None:
                self._restart(index.start + wanted - margin)
            for stamp, frame in self._frames:
                number = self._last = self._find_number(stamp)
                if number is None or number < index.start + wanted:
                    continue
                image = self._decoder.to_array(frame)
                if number > index.start + wanted or not self._is_frame(wanted, image):
                    break
                yield image
                wanted += 1
                if wanted == stop:
                    index.last_margin = margin or index.last_margin
                    return
        self.close()
        raise _changed_error(index, wanted)

    def _margins(self, first: int) -> Iterator[int | None]:
        """Ways to reach a frame, fastest first: None (read on), or the number of frames before it at which to seek."""
        index = self.index
        target = index.start + first
        ahead = target - self._last if self._last is not None else -1
        can_seek = np.ptp(index.facts.stamps) > 0  # a raw stream has no time stamps
        if 0 < ahead <= NEAR or (ahead > 0 and not can_seek):
            yield None
        if can_seek:
            yield from (margin for margin in MARGINS if index.last_margin <= margin < target)
        yield len(index.facts.stamps)

    def _restart(self, target: int) -> None:
        """Seek to a frame of the file; from the start where `target` is not positive."""
        index = self.index
        if target <= 0 or self._decoder is None:
            self.close()
            self._decoder = VideoDecoder(index.path, index.facts.threads)
            self._last = -1
        if target > 0:
            self._decoder.seek(int(index.facts.stamps[target]))
            self._last = None
        self._frames = self._decoder.frames()

    def _find_number(self, stamp: int) -> int | None:
        """Number of the frame with that time stamp among all frames; where several have it, the next one."""
        known = self.index.facts.stamps
        after = 0 if self._last is None else self._last + 1
        if after < len(known) and known[after] == stamp:  # mostly, and then no search is needed
            return after
        near = np.flatnonzero(known[after:] == stamp)
        return after + int(near[0]) if len(near) else None


def _changed_error(index: FrameIndex, number: int) -> VideoError:
    expected = f"the file that was indexed, {index.num_frames} frames with the digest {index.digest}"
    got = f"{str(index.path)!r}, in which frame {number} differs"
    cure = "It has changed, or another FFmpeg decodes it: index it again with index_video, or restore the file."
    return video_error("path", expected=expected, got=got, cure=cure)
