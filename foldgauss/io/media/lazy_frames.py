"""Frames of an indexed clip as an array that is decoded on access."""

import ctypes
import gc
import hashlib
import operator
import os
import threading
import weakref
from functools import cached_property

import numpy as np

from foldgauss._runtime.checks import short_repr
from foldgauss.io.media.clip import Size, check_frame_size, check_readable, translate_os_errors, video_error
from foldgauss.io.media.frame_index import DIGEST_BYTES, FrameIndex
from foldgauss.io.media.indexed_reader import IndexedReader

RUN = 32
_ALIVE: weakref.WeakSet["LazyFrames"] = weakref.WeakSet()


def _begin_child() -> None:
    """In a forked process never free the parent's decoders, which would wait for threads that a fork does not copy."""
    gc.freeze()
    for frames in list(_ALIVE):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(frames._reader))
        frames._open()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_child)


class LazyFrames:
    """The frames of an indexed clip as an array that is decoded on access.

    uint8 (num_frames, height, width, 3), or 4 channels where the clip has alpha: those of
    `read_video(path, size=size).frames`, from `first` up to `stop`, which count frames that decode.

    `frames[k]` and `frames[a:b]` return C-contiguous copies. Forward access decodes each frame about once; `run`
    frames are cached for access to single ones. The object can be pickled, and read by several threads. A forked
    process opens the file anew; spawned ones are safer, since a fork copies no threads. The file stays open until
    `close()` or until the object is deleted. Reading raises what `read_indexed` does.
    """

    dtype, ndim = np.dtype(np.uint8), 4

    def __init__(
        self,
        index: FrameIndex,
        size: Size | None = None,
        first: int = 0,
        stop: int | None = None,
        run: int = RUN,
    ):
        first, stop = index.check_frames(first, stop)
        run = operator.index(run)
        if run < 1:
            raise video_error("run", expected="a whole number >= 1", got=str(run), cure=f"Try {RUN}.")
        self.index, self._size = index, check_frame_size(size)
        self._first, self._stop, self._run = first, stop, run
        self._open()
        _ALIVE.add(self)

    def _open(self) -> None:
        self._reader, self._cache, self._cache_start = IndexedReader(self.index), None, 0
        self._lock = threading.RLock()  # one decoder has one position in the file

    def __reduce__(self) -> tuple:
        return LazyFrames, (self.index, self._size, self._first, self._stop, self._run)

    def __repr__(self) -> str:
        return f"LazyFrames({self.index.source!r}, shape={self.shape})"

    def close(self) -> None:
        """Close the file and drop the cache; the next access opens it again."""
        with self._lock:
            self._reader.close()
            self._cache = None

    @cached_property
    def shape(self) -> tuple[int, int, int, int]:
        with self._lock, translate_os_errors(self.index.path):
            channels = 4 if self._reader.has_alpha(self._size) else 3
        return len(self), *(self._size or self.index.size), channels

    def __len__(self) -> int:
        return self._stop - self._first

    @property
    def nbytes(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    def __getitem__(self, which: int | slice) -> np.ndarray:
        if isinstance(which, slice):
            chosen = range(len(self))[which]
            if chosen and chosen.step == 1:
                return self._read(chosen.start, chosen.stop)
            frames = np.empty((len(chosen), *self.shape[1:]), np.uint8)
            for place, number in enumerate(chosen):
                frames[place] = self._read_one(number)
            return frames
        try:
            number = operator.index(which)
        except TypeError as error:
            got, cure = short_repr(which), "For other indices use np.stack([frames[k] for k in ...])."
            expected = "the number of a frame, or a slice"
            raise video_error("frames[...]", expected=expected, got=got, cure=cure) from error
        if not -len(self) <= number < len(self):
            raise IndexError(f"frames[{number}]: expected a number within {len(self)} frames.")
        return self._read_one(number % len(self))

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        if copy is False:
            raise ValueError("copy: expected True or None for frames that are read from a file, got False.")
        return np.asarray(self[:], dtype)

    def _read_one(self, number: int) -> np.ndarray:
        """A copy of one frame, by way of the cache."""
        with self._lock:
            if self._cache is None or not 0 <= number - self._cache_start < len(self._cache):
                start = number - number % self._run
                self._cache = None  # freed before others are read
                self._cache, self._cache_start = self._read(start, min(start + self._run, len(self))), start
            return self._cache[number - self._cache_start].copy()

    def _read(self, first: int, stop: int) -> np.ndarray:
        with self._lock, translate_os_errors(self.index.path):
            check_readable(self.index.path)
            return self._reader.read(self._first + first, self._first + stop, self._size)[0]

    def digest(self) -> str:
        """blake2b of 16 bytes over the bytes of all frames in order, in hexadecimal; computed a run at a time."""
        whole = hashlib.blake2b(digest_size=DIGEST_BYTES)
        for first in range(0, len(self), self._run):
            whole.update(self._read(first, min(first + self._run, len(self))))
        return whole.hexdigest()
