"""Random access to the frames of an indexed clip, equal to the bit to sequential reading."""

import operator
from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np

from foldgauss.io.media.clip import (
    Clip,
    Levels,
    RangeFacts,
    Size,
    VideoError,
    check_frame_size,
    check_range,
    check_range_within,
    check_readable,
    no_frames_error,
    translate_os_errors,
    video_error,
)
from foldgauss.io.media.decoder import DecodedFrame, VideoDecoder
from foldgauss.io.media.frame_index import FrameIndex, digest_frame
from foldgauss.io.media.frame_rate import DEFAULT_FPS, FrameRate, describe_rate
from foldgauss.io.media.image_files import describe_missing, read_images
from foldgauss.io.media.resizing import convert_channels, describe_crop, make_resizer
from foldgauss.io.media.video_reading import read_frames

#: Frames before the wanted one at which a seek aims, in turn: after a seek into the middle of a stream, frames may show
#: artifacts until the next key frame.
MARGINS = (0, 16, 64, 256, 1024, 4096, 16384)
#: Distance in frames up to which an open decoder reads on instead of seeking.
NEAR = 64


def read_indexed(index: FrameIndex, first: int, stop: int | None, *, size: Size | None = None) -> Clip:
    """Frames `first` up to `stop` of an indexed clip, without decoding from the start: equal to the bit to
    `read_video(path, frames=(first, stop), size=size)`.

    The range counts positions in the clip, as that of `read_video` does: frames lost to damage are missing from the
    result (`FrameIndex.span` converts from numbers of decoded frames). `stop=None`: to the end. An index made with
    `frames=(A, B)` counts from A. Where any frame of the whole clip is transparent, the result has alpha, even if none
    of its own frames is. Every frame is compared with the index.

    Raises `FileNotFoundError` for a missing path; `VideoError` for a range outside the clip, one in which no frame
    decodes, and a file that is not the one indexed.
    """
    first, stop = check_range((operator.index(first), None if stop is None else operator.index(stop)))
    check_range_within(first, stop, max(index.num_positions, index.num_declared), index.source)
    path = check_readable(index.path)
    size = check_frame_size(size)
    low, high = np.searchsorted(index.positions, [first, index.num_positions if stop is None else stop]).tolist()
    if low == high:
        raise no_frames_error(first, stop, index.num_frames, index.num_positions, path)
    with translate_os_errors(path), closing(IndexedReader(index)) as reader:
        frames, num_declared, rate, notes = reader.read(low, high, size)
    if index.kind == "video":
        before, end = index.num_before, index.start + (index.num_declared if stop is None else stop)
        num_declared, rate, notes = index.report.describe_span(before + low, before + high, index.start + first, end)
    elif stop is None:
        num_declared = index.num_declared - first
    crop = () if size is None else describe_crop([index.size], size)
    if index.fixed_fps is not None:
        rate = FrameRate(index.fixed_fps)
    notes += describe_rate(rate) + crop
    about = index.source, num_declared, rate.times, notes, rate.first_second, rate.duration, index.reading
    return Clip(frames, float(rate.fps), *about, index.stretched)


class IndexedReader:
    """An open indexed clip, whose frames are found by their numbers."""

    def __init__(self, index: FrameIndex):
        self.index = index
        self._decoder: VideoDecoder | None = None
        self._frames: Iterator[DecodedFrame] = iter(())
        self._last: int | None = None  # number of the frame decoded last, among all frames of the file; None: unknown

    def close(self) -> None:
        if self._decoder is not None:
            self._decoder.close()
        self._decoder, self._frames, self._last = None, iter(()), None  # the frames hold the decoder and its threads

    def read(self, first: int, stop: int, size: Size | None) -> tuple[np.ndarray, *RangeFacts]:
        """Frames `first` up to `stop` of those that decode, as `Clip.frames`, and the rest of a `ReadResult`."""
        channels, prepare = 4 if self.has_alpha(size) else 3, make_resizer(size)
        frames = np.empty((stop - first, *(size or self.index.size), channels), np.uint8)
        rows = iter(frames)

        def take(image: np.ndarray) -> None:
            next(rows)[:] = convert_channels(prepare(image), channels)

        return frames, *self._read_each(first, stop, take)

    def has_alpha(self, size: Size | None) -> bool:
        """Whether any frame of the whole clip is transparent anywhere within the crop to `size`."""
        index = self.index
        if size is None or not index.has_alpha:
            return index.has_alpha
        if size not in index.alpha_at_size:
            candidates = np.flatnonzero(index.transparent).tolist()
            index.alpha_at_size[size] = any(self._is_transparent(number, size) for number in candidates)
        return index.alpha_at_size[size]

    def _is_transparent(self, number: int, size: Size) -> bool:
        found, prepare = [], make_resizer(size)
        self._read_each(number, number + 1, lambda image: found.append(prepare(image)[..., 3].min() < 255))
        return bool(found[0])

    def _read_each(self, first: int, stop: int, take: Callable[[np.ndarray], object]) -> RangeFacts:
        """Pass the frames as stored to `take`, one by one; returns the rest of a `ReadResult`."""
        index = self.index
        if index.kind == "video":
            for image in self._decode_video(first, stop):
                take(image)
            return stop - first, FrameRate(index.fps), ()

        def take_all(images: Iterator[np.ndarray]) -> list[object]:
            return [take(self._check(number, image)) for number, image in enumerate(images, first)]

        if index.kind == "folder":
            paths = [index.path / name for name in index.names[first:stop]]
            for number, path in enumerate(paths, first):
                if not path.is_file():
                    raise _changed_error(index, number)
            levels = Levels(index.reading.levels)
            taken = take_all(read_images(paths, levels))
            facts = len(paths), FrameRate(DEFAULT_FPS), describe_missing(paths)
        else:
            span = index.start + first, index.start + stop
            found, _ = read_frames(index.path, *span, take_all, index.reading)
            taken, facts = found[0], found[1:]
        if len(taken) < stop - first:
            raise _changed_error(index, first + len(taken))
        return facts

    def _check(self, number: int, image: np.ndarray) -> np.ndarray:
        if not self._is_frame(number, image):
            raise _changed_error(self.index, number)
        return image

    def _is_frame(self, number: int, image: np.ndarray) -> bool:
        return digest_frame(image) == self.index.digests[number].tobytes()

    def _decode_video(self, first: int, stop: int) -> Iterator[np.ndarray]:
        """BGR or BGRA frames of a video file, each equal to the indexed one."""
        index, wanted = self.index, first
        for margin in self._margins(first):
            if margin is not None:
                self._restart(index.num_before + wanted - margin)
            for frame in self._frames:
                number = self._last = self._find_number(frame.stamp)
                if number is None or number < index.num_before + wanted:
                    continue
                image = frame.to_array()
                if number > index.num_before + wanted or not self._is_frame(wanted, image):
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
        target = index.num_before + first
        ahead = target - self._last if self._last is not None else -1
        can_seek = np.ptp(index.stamps) > 0  # a raw stream has no time stamps
        if 0 < ahead <= NEAR or (ahead > 0 and not can_seek):
            yield None
        if can_seek:
            yield from (margin for margin in MARGINS if index.last_margin <= margin < target)
        yield len(index.places)

    def _restart(self, target: int) -> None:
        """Seek to a frame of the file; from the start where `target` is not positive."""
        index = self.index
        if target <= 0 or self._decoder is None:
            self.close()
            self._decoder = VideoDecoder(index.path, index.report.threads, index.reading)
            self._last = -1
        if target > 0:
            self._decoder.seek(int(index.stamps[target]))
            self._last = None
        self._frames = self._decoder.frames()

    def _find_number(self, stamp: int) -> int | None:
        """Number of the frame with that time stamp among all frames; where several have it, the next one."""
        known = self.index.stamps
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
