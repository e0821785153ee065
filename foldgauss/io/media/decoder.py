"""A video decoder restricted to one local file: PyAV, that is FFmpeg's libraries."""

import math
from collections.abc import Callable, Iterator, Sized
from contextlib import closing, suppress
from fractions import Fraction
from itertools import chain, repeat
from pathlib import Path

import av
import cv2
import numpy as np
from av.codec.context import Flags
from av.filter import Graph
from av.stream import Disposition
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter

from foldgauss._runtime.checks import require
from foldgauss.io._atomic import resolve
from foldgauss.io.media.clip import (
    VIDEO,
    ClipFacts,
    Size,
    VideoError,
    check_decoded,
    check_num_pixels,
    format_num_bytes,
    read_head,
    video_error,
)
from foldgauss.io.media.frame_rate import DEFAULT_FPS, MAX_FPS, MAX_LAST_DURATION, make_increasing
from foldgauss.io.media.images import premultiply, to_8_bits
from foldgauss.io.media.tone_mapping import HDR, map_tones

MAX_ERRORS = 1000  # packets in a row that cannot be read after which a video has ended
MAX_FRAMES = 1 << 30  # a container that declares as many does not know, or is damaged
MAX_THREADS = 16
MAX_DELAY = MAX_THREADS + 16  # frames that the decoder holds at the end: one for each thread, and reordering
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
_UNSPECIFIED = 2  # FFmpeg's number of a matrix that is not declared
#: FFmpeg's decoders of VP8 and VP9 drop alpha; these are the ones that keep it.
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}
#: Fraction of a file after its last frame or sound that decodes, above which it is reported.
MAX_UNREAD = 0.2

#: FFmpeg's demuxers that read one file and nothing else. Playlists (hls, dash), lists (concat), stream descriptions
#: (sdp) and image sequences are left out, because they open other files or addresses.
DEMUXERS = (
    "mov,matroska,avi,flv,live_flv,asf,asf_o,mpeg,mpegts,mpegvideo,m4v,h261,h263,h264,hevc,vvc,evc,obu,av1,ivf,ogg,"
    "yuv4mpegpipe,nut,dv,mxf,mxf_opatom,rm,swf,wtv,nsv,gxf,dirac,vc1,vc1test,mjpeg,flic,smk,bink,avs2,avs3"
)
SOUND_DEMUXERS = f"{DEMUXERS},wav,mp3,flac,aac"

_PLAYLISTS = (b"#EXTM3U", b"ffconcat", b"v=0", b"[playlist]", b"[Reference]", b"<ASX", b"<asx", b"RTSPtext")
_ADDRESS = (b"http://", b"https://", b"rtsp://", b"rtmp://", b"udp://", b"file://")
LIST = "a list of other files or addresses"
_KINDS = {
    b"PK\x03\x04": "a zip archive",
    b"\x1f\x8b": "a gzip archive",
    b"%PDF": "a PDF",
    b"\x8bFGZ": "a model, which foldgauss render turns into a video",
    b"\x89HDF": "an HDF5 file",
    b"ply\n": "a PLY file",
    b"ID3": "audio",
    b"\xff\xfb": "audio",
    b"fLaC": "audio",
    b"OggS": "audio",
}


def round_alpha(alpha: np.ndarray, largest: int, wanted: int) -> np.ndarray:
    """Alpha from 0 to `largest` in the range from 0 to `wanted`, to nearest: FFmpeg rounds part of it up."""
    return (alpha.astype(np.uint32) * (2 * wanted) + largest) // (2 * largest)


class VideoDecoder:
    """An open video file, which is to be closed.

    `threads`: of FFmpeg's decoder, 0 for its default. How damaged frames decode depends on their number. Interlaced
    frames are converted to progressive ones by FFmpeg's bwdif.

    Raises `VideoError` for a file that does not open, or has too many pixels.
    """

    def __init__(self, path: Path, threads: int = 0):
        self._path, self._container = path, open_container(path)
        try:
            self._stream = _choose_stream(self._container, path)
            self.pixel_aspect = float(self._stream.sample_aspect_ratio or 1) or 1.0  # width by height; 1 where unknown
            check_num_pixels(path, self._find_size(self._stream.height, self._stream.width))
            self._codec = self._choose_codec(threads)
        except VideoError:
            self.close()
            raise
        self.time_base = self._stream.time_base or Fraction(1, 1000)
        self.fps = float(self._stream.guessed_rate or 0)  # that the container declares; 0 where there is none
        self._kind = self._container.format.name
        self._num_repeated = 0  # frames that an AVI counts, but does not store: the one before is shown again
        self.has_converted = False  # whether any frame was interlaced
        self.tilt = 0  # degrees by which a frame is to be rotated beyond a multiple of 90
        self._closed = False
        self.stored_size = self._codec.height, self._codec.width  # which frames of another size are stretched to
        #: To 8 bits and to 16: FFmpeg takes longer to prepare a conversion than to convert a small frame.
        self._converters = VideoReformatter(), VideoReformatter()
        self._angle: int | None = None  # of the display matrix
        self._matrix = 1 << 16, 0, 0, 1 << 16  # right is shown along the first two, down along the others
        self._stamp = -1  # of the frame decoded last from an AVI
        self.read_bytes = 0  # up to the end of the last packet that decodes
        self.others: list[tuple[int, int]] = []  # after it, place and size of packets of other streams, such as sound
        self.is_damaged = False  # whether data did not decode, or decoded with errors, since the frame before

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
        return self._stream.frames - self._num_repeated if 0 < self._stream.frames < MAX_FRAMES else 0

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
        kind, stream = self._kind, self._stream
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
        if self._kind.startswith(("mov", "avi")):
            is_known = self.declared_seconds is not None and self.num_declared in (0, num_frames)
            return max(self.declared_seconds - elapsed, 0.0) if is_known else 0.0
        if "matroska" not in self._kind:
            return 0.0
        seconds, rates = duration * self.time_base, (self._stream.average_rate, self._stream.guessed_rate)
        is_default = any(abs(seconds - 1 / rate) <= 1.5 * self.time_base for rate in rates if rate)
        return 0.0 if is_default else float(max(seconds, 0))

    def count_declared(self, seconds: np.ndarray, fps: float, last: float, is_damaged: bool) -> int:
        """The number of frames that the container declares, at least those shown at `seconds`, the last for `last`.

        Its own count includes frames that an edit list hides, as in an MP4 that was cut without encoding; where it has
        none, the number follows from its duration.
        """
        shown, num_reached = self.declared_seconds, len(seconds)
        if is_damaged and 0 < self._stream.frames < MAX_FRAMES:  # a gap in time may be frames that are lost
            return max(self._stream.frames, num_reached)
        if shown is None or (self.num_declared and not self._kind.startswith("mov")):
            return max(self.num_declared, num_reached)
        left, intervals, estimated = shown - (seconds[-1] - seconds[0]), np.diff(seconds), num_reached
        if left > MAX_LAST_DURATION * max(1 / fps, intervals.max(initial=0.0), last):
            estimated += round(left / (intervals.mean() if len(intervals) else 1 / fps)) - 1
        if estimated >= MAX_FRAMES:  # a damaged header
            return num_reached
        return max(min(self.num_declared or estimated, estimated), num_reached)

    def seek(self, stamp: int) -> None:
        """Continue at the last key frame up to `stamp`."""
        with suppress(av.FFmpegError):  # a damaged index: continue where the decoder is
            self._container.seek(stamp, stream=self._stream)
        self._codec.flush_buffers()
        self.is_damaged = False

    def frames(self) -> Iterator[tuple[int, av.VideoFrame]]:
        """The frames that decode, in the order in which they are shown: each with its stamp in units of `time_base`; 0
        for a stream without time stamps. `is_damaged` tells whether it, or what is before it, is damaged.
        """
        for frame in self._convert_interlaced(self._decode()):
            self.is_damaged |= frame.is_corrupt
            self.stored_size = self.stored_size if all(self.stored_size) else (frame.height, frame.width)
            self._find_matrix(frame)
            yield frame.pts or 0, frame
            if self._closed:  # FFmpeg would read on in memory that is freed
                return
            self.is_damaged = False

    def _find_matrix(self, frame: av.VideoFrame) -> None:
        """Read the display matrix of the frame, where its angle is another than before: to read it keeps the frame in
        memory until the next collection of garbage."""
        if frame.rotation != self._angle:
            data = frame.side_data.get("DISPLAYMATRIX")
            numbers = [1 << 16, 0, 0, 0, 1 << 16] if data is None else np.frombuffer(data, np.int32)[:5].tolist()
            self._angle, self._matrix = frame.rotation, (numbers[0], numbers[1], numbers[3], numbers[4])
            self.tilt = self.tilt or 45 - (45 - round(math.degrees(math.atan2(numbers[1], numbers[0])))) % 90

    def to_array(self, frame: av.VideoFrame) -> np.ndarray:
        """The frame decoded last, upright and uint8: BGR of shape (height, width, 3), or premultiplied BGRA of shape
        (height, width, 4) if any pixel is transparent.

        HDR is tone-mapped. Raises `VideoError` for what FFmpeg cannot convert, such as the extreme sizes of a damaged
        file.
        """
        kind, hdr = frame.format, HDR.get(frame.color_trc)
        alpha_bits = next((min(part.bits, 16) for part in kind.components if part.is_alpha), 0)
        has_alpha = alpha_bits > 0
        is_deep = kind.components[0].bits == 16 and (kind.is_rgb or kind.name.startswith(("gray", "ya")))
        image = self._convert(frame, bool(hdr or is_deep), has_alpha)
        if kind.name.startswith("gray") and frame.color_range == ColorRange.MPEG:  # FFmpeg takes it for full range
            step, bits = (256, kind.components[0].bits) if image.dtype == np.uint16 else (1, 8)
            largest = ((1 << bits) - 1) * step >> (bits - 8)
            expanded = (image.astype(np.float32) - 16 * step) * (largest / (219 * step))
            image = np.rint(np.clip(expanded, 0, largest)).astype(image.dtype)
        if hdr:
            shown = map_tones(frame, image[..., :3], hdr)
            image = np.concatenate([shown, to_8_bits(image[..., 3:])], -1) if has_alpha else shown
        elif is_deep:
            image = to_8_bits(image)
        if hdr or is_deep:
            image = cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA if has_alpha else cv2.COLOR_RGB2BGR)
        if alpha_bits > 8:  # to nearest, which FFmpeg's conversion to 8 bits is not
            deep = self._convert(frame, True, True)[..., 3] >> (16 - alpha_bits)
            image[..., 3] = round_alpha(deep, (1 << alpha_bits) - 1, 255)
        image = premultiply(image)
        a, b, c, d = self._matrix
        if abs(b) > abs(a):  # rows of the frame are columns of the upright image
            image, a, d = image.swapaxes(0, 1), c, b
        return np.ascontiguousarray(image[:: 1 if d >= 0 else -1, :: 1 if a >= 0 else -1])

    def _convert(self, frame: av.VideoFrame, is_deep: bool, has_alpha: bool) -> np.ndarray:
        """The frame as FFmpeg converts it to BGR of 8 bits, or RGB of 16: planar, since 4:2:0 becomes wrong in packed
        formats of FFmpeg 8. Raises `VideoError` where FFmpeg cannot."""
        height, width = self.size
        wanted = f"gbr{'a' * has_alpha}p16le" if is_deep else "bgra" if has_alpha else "bgr24"
        matrix = Colorspace.BT2020 if frame.color_trc in HDR and frame.colorspace == _UNSPECIFIED else None
        how = {"src_colorspace": matrix, "interpolation": CONVERSION}
        try:
            return self._converters[is_deep].reformat(frame, width, height, wanted, **how).to_ndarray()
        except av.FFmpegError as error:
            given = f"{frame.format.name}, {frame.height}x{frame.width}, matrix {frame.colorspace} of ITU-T H.273"
            raise video_error(
                "path",
                expected="frames that FFmpeg converts to RGB",
                got=f"one that it cannot ({given}, to be shown at {height}x{width})",
                cure="The file is damaged, or of an unknown matrix: ffmpeg -i IN -vf zscale=matrix=709 OUT.",
            ) from error

    def _decode(self) -> Iterator[av.VideoFrame]:
        """The frames that decode. None ends them; a damaged frame may end those buffered, and each call passes one."""
        for packet in chain(self._read_packets(), repeat(None, MAX_DELAY)):
            try:
                found = self._codec.decode(packet)
            except av.EOFError:
                return
            except av.FFmpegError:
                self.is_damaged = True
                continue
            if packet is not None:
                self.read_bytes = max(self.read_bytes, (packet.pos or 0) + packet.size)
                self.others = [other for other in self.others if other[0] > self.read_bytes]
            yield from map(self._set_time, found)
            if packet is None:
                return

    def _read_packets(self) -> Iterator[av.Packet]:
        """The packets of the stream, of which those that cannot be read are left out."""
        num_errors, before, place = 0, (self._stream.start_time or 0) - 1, 0
        while num_errors < MAX_ERRORS:
            try:
                for packet in self._container.demux():
                    if packet.stream_index != self._stream.index:
                        place = packet.pos or place  # several packets may stand at one place
                        self.others.append((place, packet.size))
                        continue
                    self.is_damaged |= packet.is_corrupt
                    if packet.size:
                        if self._kind == "avi" and packet.dts is not None:
                            self._num_repeated += max(packet.dts - before - 1, 0)
                            before = packet.dts
                        num_errors = 0
                        yield packet
                return
            except av.FFmpegError:
                self.is_damaged, num_errors = True, num_errors + 1

    def _convert_interlaced(self, frames: Iterator[av.VideoFrame]) -> Iterator[av.VideoFrame]:
        """Interlaced frames converted to progressive ones, each to one of the same time; others are passed on."""
        graph, of_graph = None, None
        for frame in frames:
            if graph is None and not frame.interlaced_frame:
                yield frame
                continue
            kind = frame.height, frame.width, frame.format.name
            if graph is None or kind != of_graph:
                yield from filter_frame(graph, None)
                try:
                    graph, of_graph = _make_deinterlacer(frame, self.time_base), kind
                except av.FFmpegError as error:  # bwdif takes at least 3 rows and columns of each channel
                    raise video_error(
                        "path",
                        expected="frames that bwdif takes",
                        got=f"interlaced ones of {frame.height}x{frame.width} (height x width) in {str(self._path)!r}",
                        cure="Convert it with ffmpeg.",
                    ) from error
                self.has_converted = True
            yield from filter_frame(graph, frame)
        yield from filter_frame(graph, None)

    def _set_time(self, frame: av.VideoFrame) -> av.VideoFrame:
        """The frame with its time. AVI stores none: FFmpeg numbers its packets, in the order of decoding. Of raw AV1 it
        makes times up."""
        if self._kind == "avi":
            self._stamp = frame.pts = self._stamp + 1 if frame.dts is None else frame.dts
        elif self._kind in ("obu", "av1"):
            frame.pts = None
        return frame

    def _choose_codec(self, threads: int) -> av.VideoCodecContext:
        codec = self._stream.codec_context
        name = _ALPHA_DECODERS.get(codec.name)
        if self._stream.metadata.get("alpha_mode") == "1" and name is not None:
            codec = av.CodecContext.create(name, "r")
        codec.thread_type = "AUTO"
        codec.flags |= Flags.unaligned  # crop to the pixel: else columns are kept at the left, for alignment
        codec.thread_count = threads or min(MAX_THREADS, cv2.getNumberOfCPUs())
        return codec


def scan_video(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], Sized]
) -> tuple[Sized, ClipFacts]:
    """What `keep` makes of the frames of a video file from `start` up to `stop`, and the facts about the file.

    Raises `VideoError` for a file that cannot be read.
    """
    ticks, following, transfers, duration = [], [], set(), 0
    damaged, resized = [], []

    def select() -> Iterator[np.ndarray]:
        """The frames from `start` up to `stop`; all that are decoded are recorded, and so is the next one.

        Frames before `start` are decoded and dropped: seeking stops at key frames.
        """
        nonlocal duration
        for number, (stamp, frame) in enumerate(decoder.frames()):
            if number == stop:
                following.append(stamp)
                return
            ticks.append(stamp)
            duration = frame.duration or 0
            if decoder.is_damaged:
                damaged.append(number)
            if (frame.height, frame.width) != decoder.stored_size:
                resized.append(number)
            if number >= start:
                transfers.add(HDR.get(frame.color_trc))
                yield decoder.to_array(frame)

    with closing(VideoDecoder(path)) as decoder:
        fps = decoder.fps if 0 < decoder.fps <= MAX_FPS else DEFAULT_FPS
        kept = keep(select())
        require(
            ticks,
            "path",
            expected="a video with frames that decode",
            got=f"none in {str(path)!r}",
            cure="The file is damaged or its codec is unknown here; convert it with ffmpeg.",
            kind=VideoError,
        )
        time_base = float(decoder.time_base)
        seconds = make_increasing((np.array(ticks + following) * time_base).tolist(), fps)
        seconds, end = seconds[: len(ticks)], float(seconds[-1])
        if not following:
            last = decoder.find_last_duration(duration, seconds[-1] - seconds[0], len(ticks))
            end = float(seconds[-1] + last) if last else 0.0
        num_total = decoder.count_declared(seconds, fps, max(end - seconds[-1], 0.0), is_damaged=bool(damaged))
        notes = _describe_video(decoder, sorted(transfers - {None})) if len(kept) else []
        is_whole = not following and not decoder.num_declared and decoder.declared_seconds is None
        unread = 1 - (decoder.read_bytes + sum(size for _, size in decoder.others)) / path.stat().st_size
        if is_whole and decoder.read_bytes and unread > MAX_UNREAD:
            notes.append(f"the last {unread:.0%} of the file hold no frame that decodes.")
    # The container's count may be an estimate, so the range is checked against the decoded frames as well.
    check_decoded(len(kept), start, stop, len(ticks), num_total, path)
    return kept, ClipFacts(
        *("video", fps, num_total, np.array(ticks, np.int64), time_base, end, notes),
        threads=decoder.threads,
        damaged=damaged,
        resized=resized,
    )


def _describe_video(decoder: VideoDecoder, hdr: list[str]) -> list[str]:
    """Notes about a video that was read, whose frames in HDR have these transfer functions."""
    notes = []
    if abs(decoder.pixel_aspect - 1) > EQUAL_ASPECT:
        (height, width), is_kept = decoder.size, decoder.size == decoder.stored_size
        shown = "kept as stored" if is_kept else f"stretched to {height}x{width}"
        notes.append(f"pixels are {decoder.pixel_aspect:.3g} times as wide as high; frames are {shown}.")
    if hdr:
        notes.append(f"colors are HDR ({' and '.join(hdr)}), and are tone-mapped to SDR.")
    if decoder.tilt:
        turn = f"{decoder.tilt} degrees beyond multiples of 90"
        notes.append(f"the file asks for a rotation by {turn}; it is left out.")
    if decoder.has_converted:
        notes.append("interlaced frames are converted to progressive ones.")
    return notes


def open_container(path: Path, demuxers: str = DEMUXERS) -> av.container.InputContainer:
    """An open file, restricted to itself. Raises `VideoError`."""
    kind = describe_kind(read_head(path))
    require(
        kind != LIST,
        "path",
        expected=VIDEO,
        got=f"{kind}, {str(path)!r}",
        cure="The files that it names are not opened: give the video itself.",
        kind=VideoError,
    )
    # An absolute path, because FFmpeg takes 'name:rest' for a protocol. One local file and nothing that it refers to.
    options = {"protocol_whitelist": "file", "format_whitelist": demuxers}
    try:
        return av.open(f"file:{resolve(path)}", options=options, metadata_errors="replace")
    except (av.FFmpegError, ValueError) as error:
        about = format_num_bytes(path) + (f", {kind}" if kind else "")
        raise video_error(
            "path",
            expected=VIDEO,
            got=f"{str(path)!r} ({about}), which does not open as a video",
            cure="Check that it is a video and that its copy or download is complete.",
        ) from error


def _choose_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    stream = container.streams.best("video")
    kind = "audio" if container.streams.audio else "no video stream"
    require(
        stream is not None,
        "path",
        expected=VIDEO,
        got=f"{str(path)!r} ({kind}), which does not open as a video",
        kind=VideoError,
    )
    require(
        stream.codec_context is not None,
        "path",
        expected="a video whose codec is known here",
        got=f"an unknown one in {str(path)!r}",
        cure="Convert it with ffmpeg.",
        kind=VideoError,
    )
    require(
        not stream.disposition & Disposition.attached_pic,
        "path",
        expected="a video",
        got=f"audio with a cover image, {str(path)!r}",
        cure="Give a file with moving images.",
        kind=VideoError,
    )
    return stream


def _make_deinterlacer(frame: av.VideoFrame, clock: Fraction) -> Graph:
    """A filter that makes a progressive frame of each interlaced one, with time stamps in units of `clock`."""
    graph = Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=clock)
    filtered = graph.add("bwdif", "mode=send_frame:deint=interlaced")
    same_clock = graph.add("settb", f"{clock.numerator}/{clock.denominator}")  # bwdif's is twice as fast
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


def describe_kind(head: bytes) -> str | None:
    """What a file that is not a video seems to be, by its first bytes; None where they are unknown."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((*_PLAYLISTS, *_ADDRESS)) or (text.startswith(b"<") and b"<MPD" in text):
        return LIST
    found = next((kind for magic, kind in _KINDS.items() if head.startswith(magic)), None)
    is_wave = head[:4] == b"RIFF" and head[8:12] == b"WAVE"
    if found or is_wave or (head[4:8] == b"ftyp" and b"soun" in head and b"vide" not in head):
        return found or "audio"
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 100_000_000:
        return "a .safetensors file, probably a model, which foldgauss render turns into a video"
    return "a text" if head and not any(byte < 9 or 13 < byte < 32 for byte in head[:4096]) else None
