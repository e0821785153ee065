"""A video decoder restricted to one local file: PyAV, that is FFmpeg's libraries."""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.codec.context import Flags
from av.filter import Graph
from av.stream import Disposition
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter

from foldgauss.io._atomic import resolve
from foldgauss.io.media.clip import (
    AS_STORED,
    VIDEO,
    WHITE,
    Levels,
    Reading,
    Size,
    VideoError,
    check_num_pixels,
    format_num_bytes,
    read_head,
    video_error,
)
from foldgauss.io.media.format_detection import DEMUXERS, LIST, describe_kind
from foldgauss.io.media.frame_rate import DEFAULT_FPS
from foldgauss.io.media.image_files import premultiply
from foldgauss.io.media.tone_mapping import HDR, LIMITED_WHITE, map_tones

MAX_ERRORS = 1000  # packets in a row that cannot be read after which a video has ended
MAX_FRAMES = 1 << 30  # a container that declares as many does not know, or is damaged
MAX_LOST_FRAMES = 1_000_000  # a time stamp that implies a larger gap counts as damaged
MAX_THREADS = 16
MAX_DELAY = MAX_THREADS + 16  # frames that the decoder holds when it meets damage: one for each thread, and reordering
MAX_ASPECT = 10.0  # width by height of a pixel, or the inverse; a larger one counts as damaged
EQUAL_ASPECT = 0.01  # by which pixels that count as square may differ: containers round
#: Chroma is interpolated, and rounded to nearest: FFmpeg's default repeats it and rounds it down, which makes each
#: channel about 1 level too dark.
CONVERSION = (
    Interpolation.BILINEAR
    | Interpolation.ACCURATE_RND
    | Interpolation.FULL_CHR_H_INT
    | Interpolation.FULL_CHR_H_INP
    | Interpolation.BITEXACT
)
#: Luma of limited range as that of full range: FFmpeg's conversion takes all gray video for full range.
_EXPANDED = np.rint(np.clip((np.arange(256) - 16) * (255 / 219), 0, 255)).astype(np.uint8)
#: Likewise in 16 bits, up to the white that FFmpeg makes of color video of limited range.
_EXPANDED_DEEP = np.rint(np.clip((np.arange(1 << 16) - 16 * 256) * (LIMITED_WHITE / (219 * 256)), 0, WHITE))
_EXPANDED_DEEP = _EXPANDED_DEEP.astype(np.uint16)
_UNSPECIFIED = 2  # FFmpeg's number of a matrix that is not declared
#: FFmpeg's decoders of VP8 and VP9 drop alpha; these are the ones that keep it.
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}


@dataclass(frozen=True)
class DecodedFrame:
    """A frame that decodes. `position`: in the file, with the frames lost to damage counted. `stamp`: in units of
    `VideoDecoder.time_base`; 0 for a stream without time stamps. `size`: (height, width) of the video with square
    pixels, to which each frame is stretched. `matrix`: (a, b, c, d), right is shown along (a, b), down along (c, d), in
    units of 2^-16. `converters`, to 8 bits and to 16: the same for all frames, since FFmpeg takes longer to prepare one
    than to convert a small frame. `levels` converts frames of 16 bits."""

    position: int
    stamp: int
    decoded: av.VideoFrame
    size: Size
    matrix: tuple[int, int, int, int] = (1 << 16, 0, 0, 1 << 16)
    converters: tuple[VideoReformatter, VideoReformatter] = field(
        default_factory=lambda: (VideoReformatter(), VideoReformatter())
    )
    levels: Levels = field(default_factory=Levels)

    @property
    def hdr(self) -> str | None:
        """The transfer function of a frame in HDR, "PQ" or "HLG"; None for others."""
        return HDR.get(self.decoded.color_trc)

    @property
    def is_turned(self) -> bool:
        """Whether rows of the frame are columns of the upright image."""
        return abs(self.matrix[1]) > abs(self.matrix[0])

    def to_array(self) -> np.ndarray:
        """Upright and uint8: BGR of shape (height, width, 3), or premultiplied BGRA of shape (height, width, 4).

        HDR is tone-mapped. Raises `VideoError` for what FFmpeg cannot convert, such as the extreme
        sizes of a damaged file.
        """
        alpha_bits = min(next((part.bits for part in self.decoded.format.components if part.is_alpha), 0), 16)
        kind, deep = self.decoded.format, None
        has_levels = kind.components[0].bits == 16 and (kind.is_rgb or kind.name.startswith(("gray", "ya")))
        if self.hdr is not None or alpha_bits > 8 or has_levels:
            deep = self._convert("gbrap16le" if alpha_bits else "gbrp16le")
        is_limited_gray = kind.name.startswith("gray") and self.decoded.color_range == ColorRange.MPEG
        if self.hdr is not None:
            image = map_tones(self.decoded, _EXPANDED_DEEP[deep] if is_limited_gray else deep, self.hdr)
        elif has_levels:
            image = cv2.cvtColor(self.levels.convert(deep), cv2.COLOR_RGBA2BGRA if alpha_bits else cv2.COLOR_RGB2BGR)
        else:
            image = self._convert("bgra" if alpha_bits else "bgr24")
        if is_limited_gray and self.hdr is None:
            image = _EXPANDED[image]
        if alpha_bits and deep is not None and self.levels.white is None:
            image[..., 3] = round_alpha(deep[..., 3] >> (16 - alpha_bits), (1 << alpha_bits) - 1, 255)
        if alpha_bits:
            opaque = image[..., 3].min() == 255
            image = np.ascontiguousarray(image[..., :3]) if opaque else premultiply(image)
        a, b, c, d = self.matrix
        if self.is_turned:
            image, a, d = image.swapaxes(0, 1), c, b
        return np.ascontiguousarray(image[:: 1 if d >= 0 else -1, :: 1 if a >= 0 else -1])

    def _convert(self, kind: str) -> np.ndarray:
        """The frame as FFmpeg converts it to `kind`: of 8 bits, or planar and of 16, where 4:2:0 becomes wrong in
        packed formats of FFmpeg 8. Raises `VideoError` where FFmpeg cannot."""
        height, width = self.size
        matrix = Colorspace.BT2020 if self.hdr is not None and self.decoded.colorspace == _UNSPECIFIED else None
        how = {"src_colorspace": matrix, "interpolation": CONVERSION}
        try:
            return self.converters["16" in kind].reformat(self.decoded, width, height, kind, **how).to_ndarray()
        except av.FFmpegError as error:
            frame = self.decoded
            given = f"{frame.format.name}, {frame.height}x{frame.width}, matrix {frame.colorspace} of ITU-T H.273"
            got = f"one that it cannot ({given}, to be shown at {height}x{width})"
            cure = "The file is damaged, or of an unknown matrix: ffmpeg -i IN -vf zscale=matrix=709 OUT."
            raise video_error("path", expected="frames that FFmpeg converts to RGB", got=got, cure=cure) from error


def round_alpha(alpha: np.ndarray, largest: int, wanted: int) -> np.ndarray:
    """Alpha from 0 to `largest` in the range from 0 to `wanted`, to nearest: FFmpeg rounds part of it up."""
    return (alpha.astype(np.uint32) * (2 * wanted) + largest) // (2 * largest)


class VideoDecoder:
    """An open video file, which is to be closed.

    `threads`: of FFmpeg's decoder, 0 for its default. How damaged frames decode depends on their number.
    `reading`: as of `read_video`; interlaced frames are converted to progressive ones by FFmpeg's bwdif.

    Raises `VideoError` for a file that does not open, or has too many pixels.
    """

    def __init__(self, path: Path, threads: int = 0, reading: Reading = AS_STORED):
        self._path, self._deinterlace, self._container = path, reading.deinterlace, open_container(path)
        self._per_stored = 2 if self._deinterlace == "fields" else 1  # frames that each stored one becomes
        self.levels = Levels(reading.levels)
        try:
            self._stream = _choose_stream(self._container, path)
            self.pixel_aspect = float(self._stream.sample_aspect_ratio or 1) or 1.0  # width by height; 1 where unknown
            check_num_pixels(path, self._find_size(self._stream.height, self._stream.width))
            self._codec = self._choose_codec(threads)
        except VideoError:
            self.close()
            raise
        self.time_base = (self._stream.time_base or Fraction(1, 1000)) / self._per_stored
        self._rate = (self._stream.guessed_rate or 0) * self._per_stored
        self.fps = float(self._rate)  # that the container declares; 0 where there is none
        #: Whether an edit list may hide frames that the container counts.
        self.hides_frames = self._container.format.name.startswith("mov")
        self._is_avi = self._container.format.name == "avi"
        self._num_repeated = 0  # frames that an AVI counts, but does not store: the one before is shown again
        self.has_converted = False  # whether any frame was interlaced
        self.tilt = 0  # degrees by which a frame is to be rotated beyond a multiple of 90
        self._closed = False
        self._has_sought = False
        self.stored_size = self._codec.height, self._codec.width  # which frames of another size are stretched to
        self._read_bytes = 0  # up to the end of the last packet that decodes
        self._at_end = False
        self._converters = VideoReformatter(), VideoReformatter()
        self._angle: int | None = None  # of the display matrix
        self._last = -1  # position of the frame decoded last
        self._before: int | None = None  # the largest time stamp
        self._num_suspect = 0  # frames before which others may have been lost to damage

    def close(self) -> None:
        """Close the file; `frames` that are being read end."""
        self._closed = True
        self._container.close()

    @property
    def threads(self) -> int:
        return self._codec.thread_count

    @property
    def num_declared(self) -> int:
        """The number of frames that the container counts, including those that an edit list hides; 0 where it does not
        count them. Of an AVI those that it does not store are known only once they are passed."""
        num = self._stream.frames - self._num_repeated if 0 < self._stream.frames < MAX_FRAMES else 0
        return num * self._per_stored

    @property
    def unread_fraction(self) -> float:
        """The fraction of the file after the last packet that decodes, once the end is reached; 0 where the container
        declares frames or a duration, which tell more."""
        if not (self._at_end and self._read_bytes) or self.num_declared or self.declared_seconds is not None:
            return 0.0
        return 1 - self._read_bytes / self._path.stat().st_size

    @property
    def size(self) -> Size:
        """(height, width) of frames with square pixels, before they are turned upright."""
        return self._find_size(*self.stored_size)

    def _find_size(self, height: int, width: int) -> Size:
        """The size at which pixels are square: one side is kept, and the other is enlarged."""
        aspect = self.pixel_aspect
        if abs(aspect - 1) <= EQUAL_ASPECT or not 1 / MAX_ASPECT <= aspect <= MAX_ASPECT:
            return height, width
        return (height, round(width * aspect)) if aspect > 1 else (round(height / aspect), width)

    @property
    def declared_seconds(self) -> float | None:
        """How long the video is by its container, frames that an edit list hides left out; None where that is unknown.

        The duration of a whole file may be that of its sound. Streams and Ogg derive it from their last packets, and
        Flash videos declare up to 2 frames more.
        """
        kind, stream = self._container.format.name, self._stream
        if kind in ("flv", "live_flv", "ogg", "mpeg", "mpegts") or (kind == "asf" and self._container.streams.audio):
            return None
        if stream.duration and stream.duration > 0:
            return float(stream.duration * stream.time_base)
        if not self._container.duration or self._container.duration < 0:
            return None
        seconds = self._container.duration / av.time_base
        if "matroska" not in kind:
            return None if self._container.streams.audio else seconds
        # Matroska counts to the end of the last frame from 0, where another stream may begin; FFmpeg writes the
        # duration of each stream, too.
        begin = float((stream.start_time or 0) * stream.time_base)
        if len(self._container.streams) == 1:
            return seconds - begin
        try:
            hours, minutes, own = stream.metadata.get("DURATION", "").split(":")
            return min(seconds, 3600 * int(hours) + 60 * int(minutes) + float(own)) - begin
        except (ValueError, OverflowError):
            return None

    def find_last_duration(self, duration: int, elapsed: float, num_frames: int) -> float:
        """Seconds for which the last of `num_frames`, `elapsed` seconds after the first, is shown; 0 if it is unknown.

        `duration` is that of the decoder, in units of `time_base`: in an MP4 that of another frame where frames are
        stored in another order, in Matroska often a default.
        """
        if self.hides_frames or self._is_avi:
            is_known = self.declared_seconds is not None and self.num_declared in (0, num_frames)
            return max(self.declared_seconds - elapsed, 0.0) if is_known else 0.0
        if "matroska" not in self._container.format.name:
            return 0.0
        seconds, rates = duration * self.time_base, (self._stream.average_rate, self._stream.guessed_rate)
        is_default = any(abs(seconds - 1 / rate / self._per_stored) <= 1.5 * self.time_base for rate in rates if rate)
        return 0.0 if is_default else float(max(seconds, 0))

    def seek(self, stamp: int) -> None:
        """Continue at the last key frame up to `stamp`; positions are counted from there."""
        with suppress(av.FFmpegError):  # a damaged index: continue where the decoder is
            self._container.seek(stamp // self._per_stored, stream=self._stream)
        self._codec.flush_buffers()
        self._has_sought = True
        self._last, self._before, self._num_suspect = -1, None, 0

    def frames(self) -> Iterator[DecodedFrame]:
        """The frames that decode, in the order in which they are shown. Raises `VideoError` for interlaced ones that
        are not to be converted."""
        for frame in self._convert_interlaced(self._decode()):
            stamp = self._find_stamp(frame)
            self._num_suspect = MAX_DELAY if frame.is_corrupt else self._num_suspect
            self._last = self._find_position(stamp)
            self.stored_size = self.stored_size if all(self.stored_size) else (frame.height, frame.width)
            matrix = self._find_matrix(frame)
            yield DecodedFrame(self._last, stamp or 0, frame, self.size, matrix, self._converters, self.levels)
            if self._closed:  # FFmpeg would read on in memory that is freed
                return

    def _find_matrix(self, frame: av.VideoFrame) -> tuple[int, int, int, int]:
        """The display matrix of the frame, read anew where its angle is another: to read it keeps the frame in memory
        until the next collection of garbage."""
        if frame.rotation != self._angle:
            data = frame.side_data.get("DISPLAYMATRIX")
            numbers = [1 << 16, 0, 0, 0, 1 << 16] if data is None else np.frombuffer(data, np.int32)[:5].tolist()
            self._angle, self._matrix = frame.rotation, (numbers[0], numbers[1], numbers[3], numbers[4])
            a, b = self._matrix[:2]
            self.tilt = self.tilt or 45 - (45 - round(math.degrees(math.atan2(b, a)))) % 90
        return self._matrix

    def _decode(self) -> Iterator[av.VideoFrame]:
        for packet in self._read_packets():
            try:
                found = self._codec.decode(packet)
            except av.FFmpegError:
                self._num_suspect = MAX_DELAY
                continue
            self._read_bytes = max(self._read_bytes, (packet.pos or 0) + packet.size)
            yield from map(self._stamp, found)
        self._at_end = True
        # A damaged frame may end the decoding of those buffered; each call passes one.
        for _ in range(MAX_DELAY):
            try:
                yield from map(self._stamp, self._codec.decode(None))
                return
            except av.EOFError:
                return
            except av.FFmpegError:
                self._num_suspect = MAX_DELAY

    def _read_packets(self) -> Iterator[av.Packet]:
        """The packets of the stream, of which those that cannot be read are left out."""
        num_errors, before = 0, (self._stream.start_time or 0) - 1
        while num_errors < MAX_ERRORS:
            try:
                for packet in self._container.demux(self._stream):
                    if packet.is_corrupt:
                        self._num_suspect = MAX_DELAY
                    if packet.size:
                        if self._is_avi and packet.dts is not None:
                            self._num_repeated += max(packet.dts - before - 1, 0)
                            before = packet.dts
                        num_errors = 0
                        yield packet
                return
            except av.FFmpegError:
                self._num_suspect, num_errors = MAX_DELAY, num_errors + 1

    def _convert_interlaced(self, frames: Iterator[av.VideoFrame]) -> Iterator[av.VideoFrame]:
        """Interlaced frames converted to progressive ones, each to one of the same time; others are passed on.

        With "fields" each stored frame becomes two; a video that does not begin with an interlaced one is refused.
        """
        graph, of_graph = None, None
        for frame in frames:
            follows = self._deinterlace == "fields" and self._has_sought  # interlaced ones before the place sought
            if graph is None and not frame.interlaced_frame and not follows:
                if self._deinterlace == "fields":
                    got, cure = f"a progressive one in {str(self._path)!r}", "Leave deinterlace='fields' out."
                    raise video_error("deinterlace", expected="a first frame of two fields", got=got, cure=cure)
                yield frame
                continue
            if self._deinterlace == "refuse":
                got = f"one of interlaced fields, {str(self._path)!r}"
                cure = "Convert it while reading, with deinterlace='frames' or 'fields'."
                raise video_error("path", expected="a video of progressive frames", got=got, cure=cure)
            kind = frame.height, frame.width, frame.format.name
            if graph is None or kind != of_graph:
                yield from filter_frame(graph, None)
                try:
                    graph = _make_deinterlacer(frame, self.time_base, self._per_stored)
                    of_graph, self.has_converted = kind, True
                except av.FFmpegError as error:  # bwdif takes at least 3 rows and columns of each channel
                    got = f"interlaced ones of {frame.height}x{frame.width} (height x width) in {str(self._path)!r}"
                    cure = "Convert it with ffmpeg."
                    raise video_error("path", expected="frames that bwdif takes", got=got, cure=cure) from error
            yield from filter_frame(graph, frame)
        yield from filter_frame(graph, None)

    def _stamp(self, frame: av.VideoFrame) -> av.VideoFrame:
        """The frame with its time. AVI stores none: FFmpeg numbers its packets, in the order of decoding. Of raw AV1 it
        makes times up."""
        if self._is_avi or self._container.format.name in ("obu", "av1"):
            frame.pts = frame.dts if self._is_avi else None
        return frame

    def _find_stamp(self, frame: av.VideoFrame) -> int | None:
        return self._before + 1 if self._is_avi and frame.pts is None and self._before is not None else frame.pts

    def _find_position(self, stamp: int | None) -> int:
        """The position of the next frame; the number of frames lost before it to damage is estimated by time stamps."""
        lost, frame = 0, 1 / (self._rate or Fraction(DEFAULT_FPS)) / self.time_base
        if self._num_suspect and stamp is not None:
            start = (self._stream.start_time or 0) * self._per_stored
            before = self._before if self._before is not None else start - frame
            lost = round((stamp - before) / frame) - 1
        self._num_suspect = max(self._num_suspect - 1, 0)
        if stamp is not None and (self._before is None or stamp > self._before):  # damage may disorder frames
            self._before = stamp
        return self._last + 1 + (lost if 0 < lost < MAX_LOST_FRAMES else 0)

    def _choose_codec(self, threads: int) -> av.VideoCodecContext:
        codec = self._stream.codec_context
        name = _ALPHA_DECODERS.get(codec.name)
        if self._stream.metadata.get("alpha_mode") == "1" and name is not None:
            codec = av.CodecContext.create(name, "r")
        codec.thread_type = "AUTO"
        codec.flags |= Flags.unaligned  # crop to the pixel: else columns are kept at the left, for alignment
        codec.thread_count = threads or min(MAX_THREADS, cv2.getNumberOfCPUs())
        return codec


def open_container(path: Path, demuxers: str = DEMUXERS) -> av.container.InputContainer:
    """An open file, restricted to itself. Raises `VideoError`."""
    kind = describe_kind(read_head(path))
    if kind == LIST:
        got, cure = f"{kind}, {str(path)!r}", "The files that it names are not opened: give the video itself."
        raise video_error("path", expected=VIDEO, got=got, cure=cure)
    # An absolute path, because FFmpeg takes 'name:rest' for a protocol. One local file and nothing that it refers to.
    options = {"protocol_whitelist": "file", "format_whitelist": demuxers}
    try:
        return av.open(f"file:{resolve(path)}", options=options, metadata_errors="replace")
    except (av.FFmpegError, ValueError) as error:
        about = format_num_bytes(path) + (f", {kind}" if kind else "")
        got = f"{str(path)!r} ({about}), which does not open as a video"
        cure = "Check that it is a video and that its copy or download is complete."
        raise video_error("path", expected=VIDEO, got=got, cure=cure) from error


def _choose_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    known = [one for one in container.streams.video if one.codec_context is not None]
    if container.streams.video and not known:
        got, cure = f"an unknown one in {str(path)!r}", "Convert it with ffmpeg."
        raise video_error("path", expected="a video whose codec is known here", got=got, cure=cure)
    streams = [one for one in known if not one.disposition & Disposition.attached_pic]
    if streams:
        best = container.streams.best("video")
        return best if best in streams else streams[0]
    if container.streams.video:
        got = f"audio with a cover image, {str(path)!r}"
        raise video_error("path", expected="a video", got=got, cure="Give a file with moving images.")
    got = f"{str(path)!r} ({'audio' if container.streams.audio else 'no video stream'}), which does not open as a video"
    raise video_error("path", expected=VIDEO, got=got)


def _make_deinterlacer(frame: av.VideoFrame, clock: Fraction, num: int) -> Graph:
    """A filter that makes `num` frames, 1 or 2, of each: of two fields, or one of each field. `clock`: theirs."""
    graph = Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=clock * num)
    filtered = graph.add("bwdif", "mode=send_field:deint=all" if num == 2 else "mode=send_frame:deint=interlaced")
    same_clock = graph.add("settb", f"{clock.numerator}/{clock.denominator}")  # bwdif's would be twice as fast
    graph.link_nodes(source, filtered, same_clock, graph.add("buffersink")).configure()
    return graph


def filter_frame(
    graph: Graph | None, frame: av.VideoFrame | av.AudioFrame | None
) -> Iterator[av.VideoFrame | av.AudioFrame]:
    """The frames that a graph of filters, if there is one, has ready after another frame; None ends them."""
    if graph is not None:
        graph.push(frame)
        while True:
            try:
                yield graph.pull()
            except (av.BlockingIOError, av.EOFError):
                return
