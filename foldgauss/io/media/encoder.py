"""Video encoders of PyAV, that is of FFmpeg's libraries, and what each of them takes."""

import math
import os
import sys
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import av
import numpy as np
from av.filter import Graph
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, VideoReformatter

from foldgauss._runtime.checks import check_one_of, check_within, invalid, is_integer
from foldgauss.io._atomic import PathLike
from foldgauss.io.media.clip import VideoError, check_readable, video_error
from foldgauss.io.media.decoder import CONVERSION, VideoDecoder, filter_frame, open_container, round_alpha
from foldgauss.io.media.format_detection import SOUND_DEMUXERS
from foldgauss.io.media.frame_rate import count_ticks

os.environ.setdefault("SVT_LOG", "1")  # errors only: SVT-AV1 writes to stderr


class Codec(NamedTuple):
    """`crf`: its default constant rate factor and the largest one; None for codecs without. `pixel_formats`: those
    offered, the default first, and the first with alpha for frames with alpha. `min_side`: the least height and width;
    with less x265 ends the process, and SVT-AV1 waits forever."""

    encoder: str
    suffixes: tuple[str, ...]
    pixel_formats: tuple[str, ...]
    crf: tuple[int, int] | None = None
    options: Mapping[str, str] = MappingProxyType({})
    min_side: int = 1


CODECS = {
    "h264": Codec("libx264", (".mp4", ".mov", ".mkv"), ("yuv420p", "yuv444p", "yuv420p10le"), crf=(16, 51)),
    "h265": Codec(
        "libx265",
        (".mp4", ".mov", ".mkv"),
        ("yuv420p", "yuv444p", "yuv420p10le"),
        crf=(18, 51),
        options={"x265-params": "log-level=none"},
        min_side=64,
    ),
    "av1": Codec(
        "libsvtav1",
        (".mp4", ".webm", ".mkv"),
        ("yuv420p", "yuv420p10le"),
        crf=(20, 63),
        options={"preset": "6"},
        min_side=64,
    ),
    "vp9": Codec(
        "libvpx-vp9",
        (".webm", ".mp4", ".mkv"),
        ("yuv420p", "yuv444p", "yuva420p"),
        (18, 63),
        {"b": "0", "row-mt": "1", "deadline": "good", "cpu-used": "4"},
    ),
    "prores": Codec("prores_ks", (".mov", ".mkv"), ("yuv422p10le", "yuv444p10le", "yuva444p10le")),
    "ffv1": Codec("ffv1", (".mkv",), ("bgr0", "bgra", "yuv420p", "yuv444p")),
}
#: The codec of each extension unless one is given.
DEFAULT_CODECS = {".mp4": "h264", ".webm": "vp9", ".mov": "prores", ".mkv": "ffv1"}
SAMPLE_RATE = 48_000
#: Units of the time stamps of unevenly spaced frames, as parts of a second; Matroska counts milliseconds.
CLOCKS = {".mp4": 90_000, ".mov": 90_000, ".mkv": 1000, ".webm": 1000}
#: Seconds of the source by which atempo is early, measured below speed 1: clicks by 12 +- 8 ms, noise 15, tones 7.
TEMPO_LEAD = 0.012
VIDEO_SUFFIXES = tuple(DEFAULT_CODECS)


class Sound(NamedTuple):
    """The sound of a video: that of the file `path` from second `start` on, counted from the first frame of the video
    in that file, or from its first sound if it has none. Silence fills what is before the first sound.

    `speed`: the video is played that many times as fast as that file; the sound is stretched, its pitch kept. It ends
    with the video or with the file, whichever is first.
    """

    path: PathLike
    start: float = 0.0
    speed: float = 1.0


class Encoding(NamedTuple):
    """How a video is encoded, checked by `choose_encoding`."""

    codec: Codec
    crf: int | None
    pixel_format: str


def choose_encoding(
    suffix: str, codec: str | None, crf: int | None, pixel_format: str | None, shape: tuple[int, int, int]
) -> Encoding:
    """The encoding of a video file with this extension, for frames of (height, width, channels) `shape`.

    Raises ValueError for options that do not fit together, `VideoError` for frames that the codec does not take.
    """
    has_alpha = shape[2] == 4
    name = codec or DEFAULT_CODECS[suffix]
    check_one_of("codec", name, CODECS)
    chosen = CODECS[name]
    if suffix not in chosen.suffixes:
        fitting = [other for other, one in CODECS.items() if suffix in one.suffixes]
        cure = f"For {suffix} take {', '.join(fitting)}."
        raise invalid("codec", expected=f"{name} in one of {', '.join(chosen.suffixes)}", got=f"{suffix}", cure=cure)
    if min(shape[:2]) < chosen.min_side:
        expected, got = f"at least {chosen.min_side}x{chosen.min_side} for {name}", f"{shape[0]}x{shape[1]}"
        raise video_error("frames", expected=expected, got=f"{got} (height x width)", cure="Take h264, vp9 or ffv1.")
    if crf is not None:
        if chosen.crf is None:
            raise invalid("crf", expected=f"none for {name}, which has no such factor", got=f"{crf}")
        if not (is_integer(crf, 0) and crf <= chosen.crf[1]):
            raise invalid("crf", expected=f"a whole number from 0 to {chosen.crf[1]} for {name}", got=repr(crf))
    with_alpha = [one for one in chosen.pixel_formats if av.VideoFormat(one).components[-1].is_alpha]
    if pixel_format is None:
        pixel_format = (with_alpha if has_alpha and with_alpha else chosen.pixel_formats)[0]
    check_one_of("pixel_format", pixel_format, chosen.pixel_formats)
    if has_alpha and (suffix == ".mp4" or pixel_format not in with_alpha):  # an MP4 has no place for the alpha of VP9
        cure = "Take vp9 in a .webm, prores in a .mov or ffv1 in a .mkv, or composite the frames over a color."
        if with_alpha and suffix != ".mp4":
            cure = f"Take {with_alpha[0]}."
        raise video_error("frames", expected=f"RGB for {name} in {suffix}, {pixel_format}", got="RGBA", cure=cure)
    return Encoding(chosen, crf if crf is not None else chosen.crf and chosen.crf[0], pixel_format)


def encode_video(
    path: Path,
    frames: Iterator[np.ndarray],
    fps: float,
    encoding: Encoding,
    sound: Sound | None = None,
    times: np.ndarray | None = None,
) -> None:
    """Encode RGB frames, or premultiplied RGBA ones, which are stored with straight alpha.

    `times`: seconds at which the frames are shown, and the end if there is one more; None where they are evenly spaced.
    Colors are converted by BT.709 in limited range, and the file says so. An odd height or width is padded by repeating
    the last row or column where the pixel format has half the color resolution.
    """
    rate = Fraction(fps).limit_denominator(100_000)
    suffix = path.suffix.lower()
    clock = 1 / rate if times is None else Fraction(1, CLOCKS[suffix])
    ticks = None if times is None else count_ticks(np.append(times, times[-1] + 1 / fps) / float(clock)).tolist()
    options = dict(encoding.codec.options) | ({} if encoding.crf is None else {"crf": str(encoding.crf)})
    pixel_format = av.VideoFormat(encoding.pixel_format, 64, 64)
    matrix = None if pixel_format.is_rgb else Colorspace.ITU709
    steps = 64 // pixel_format.chroma_height(), 64 // pixel_format.chroma_width()
    container = av.open(f"file:{path}", "w", options={"movflags": "+faststart"} if suffix in (".mp4", ".mov") else {})
    with container:
        stream = container.add_stream(encoding.codec.encoder, rate=rate, options=options)
        stream.pix_fmt = encoding.pixel_format
        packets, waiting, converter = iter(()), None, VideoReformatter()
        if sound is not None:
            codec = "libopus" if suffix == ".webm" else "aac"
            packets = _encode_sound(container.add_stream(codec, rate=SAMPLE_RATE, layout="stereo"), sound)
        for number, frame in enumerate(frames):
            image = _pad(frame, steps)
            if image.shape[2] == 4:
                image = straighten(image)
            if number == 0:
                stream.height, stream.width = image.shape[:2]
                if matrix is not None:
                    context = stream.codec_context
                    context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
                    context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
                stream.codec_context.time_base = clock
                if ticks is not None:  # with B-frames, an MP4 does not say for how long the last frame is shown
                    stream.codec_context.max_b_frames = 0
                open_with_own_priority(stream.codec_context)
            given = av.VideoFrame.from_ndarray(image, format="rgba" if image.shape[2] == 4 else "rgb24")
            given = converter.reformat(given, format=pixel_format.name, dst_colorspace=matrix, interpolation=CONVERSION)
            if image.shape[2] == 4 and len(given.planes) == 4:
                _set_alpha(given.planes[3], image[..., 3], (1 << pixel_format.components[3].bits) - 1)
            if matrix is not None:  # ProRes writes those of its frames
                given.color_primaries, given.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
            begin, end = (number, number + 1) if ticks is None else ticks[number : number + 2]
            given.pts, given.time_base = begin, clock
            container.mux(_set_durations(stream.encode(given), ticks))
            while (waiting := waiting or next(packets, None)) and waiting.pts * waiting.time_base < end * clock:
                container.mux(waiting)
                waiting = None
        container.mux(_set_durations(stream.encode(), ticks))


def _set_durations(packets: list[av.Packet], ticks: list[int] | None) -> list[av.Packet]:
    """The packets; those of unevenly spaced frames with the durations that follow from their time stamps."""
    if ticks is not None:
        for packet in packets:
            place = bisect_left(ticks, packet.pts)
            packet.duration = ticks[place + 1] - ticks[place]
    return packets


def _encode_sound(stream: av.AudioStream, sound: Sound) -> Iterator[av.Packet]:
    """The packets of the sound, as they are asked for. Raises `VideoError` where FFmpeg cannot convert it."""
    try:
        with open_container(Path(sound.path), SOUND_DEMUXERS) as source:
            of_file = source.streams.best("audio")
            # atempo takes factors from 0.5 to 100; at 1 it would still shift the sound.
            num = 0 if sound.speed == 1 else max(1, math.ceil(-math.log2(sound.speed)))
            tempo = [("atempo", f"{sound.speed ** (1 / max(num, 1)):.9f}")] * num
            begin = _first_shown(Path(sound.path), of_file) + sound.start - (TEMPO_LEAD if num else 0)
            steps = [("atrim", f"start={begin:.6f}"), ("asetpts", f"PTS-({begin:.6f})/TB")]
            steps += [("aresample", "async=1:first_pts=0"), *tempo]  # silence where there is none
            steps += [("aformat", f"sample_fmts={stream.format.name}")]
            graph = _link_sound_filters(steps, SAMPLE_RATE, "fltp", "stereo", Fraction(1, SAMPLE_RATE))
            if stream.codec_context.frame_size:
                graph.set_audio_frame_size(stream.codec_context.frame_size)
            for frame in chain(_unify_sound(source, of_file), [None]):
                for filtered in filter_frame(graph, frame):
                    yield from stream.encode(filtered)
            yield from stream.encode()
    except av.FFmpegError as error:
        got, cure = f"{str(sound.path)!r} ({error.strerror})", "Convert it with ffmpeg, or leave it out."
        raise video_error("sound", expected="sound that FFmpeg converts", got=got, cure=cure) from error


def _link_sound_filters(steps: list[tuple[str, str]], rate: int, kind: str, layout: str, clock: Fraction) -> Graph:
    graph = Graph()
    source = graph.add_abuffer(sample_rate=rate, format=kind, layout=layout, time_base=clock)
    graph.link_nodes(source, *(graph.add(*step) for step in (*steps, ("abuffersink",)))).configure()
    return graph


def _first_shown(path: Path, of_file: av.AudioStream) -> float:
    """The time stamp in seconds of the first frame that decodes, or of the first sound where there is no video."""
    with suppress(VideoError, StopIteration), closing(VideoDecoder(path)) as decoder:
        return float(next(decoder.frames()).stamp * decoder.time_base)
    return float((of_file.start_time or 0) * of_file.time_base)


def _unify_sound(source: av.container.InputContainer, stream: av.AudioStream) -> Iterator[av.AudioFrame]:
    """The frames of sound that decode, in one format, though that of the file may change."""
    graph, of_graph, end = None, None, None
    steps = [("aformat", f"sample_fmts=fltp:sample_rates={SAMPLE_RATE}:channel_layouts=stereo")]
    steps += [("asettb", f"1/{SAMPLE_RATE}")]
    for packet in source.demux(stream):
        found = []
        with suppress(av.FFmpegError):
            found = packet.decode()
        for frame in found:
            if frame.pts is None:  # of a packet's frames only the first may have a time stamp
                frame.pts = end
            if frame.pts is not None:
                end = frame.pts + round(Fraction(frame.samples, frame.sample_rate) / stream.time_base)
            kind = frame.sample_rate, frame.format.name, frame.layout.name
            if kind != of_graph:
                yield from filter_frame(graph, None)
                # FFmpeg's conversion of one channel to two makes it quieter, as if it were in the middle of others.
                both = [("pan", "stereo|c0=c0|c1=c0")] if frame.layout.nb_channels == 1 else []
                graph, of_graph = _link_sound_filters([*both, *steps], *kind, stream.time_base), kind
            yield from filter_frame(graph, frame)
    yield from filter_frame(graph, None)


def check_sound(sound: Sound) -> None:
    """Raise `VideoError` for a file without sound, ValueError for other values that are refused."""
    if not isinstance(sound, Sound):
        cure = "Write Sound('clip.mp4')."
        raise invalid("sound", expected="a foldgauss.io.Sound", got=type(sound).__name__, cure=cure)
    check_within("sound.start", sound.start, "[0, 1e9]", "seconds from 0 to 1e9")
    check_within("sound.speed", sound.speed, "[0.01, 100]", "a speed from 0.01 to 100")
    got = f"{str(sound.path)!r}, which does not open"
    path = check_readable(sound.path)
    with suppress(VideoError, IsADirectoryError, PermissionError), open_container(path, SOUND_DEMUXERS) as source:
        if getattr(source.streams.best("audio"), "codec_context", None) is not None:
            return
        got = f"{str(sound.path)!r}, which has none{' whose codec is known here' if source.streams.audio else ''}"
    raise video_error("sound", expected="a file with sound", got=got, cure="Leave it out.")


def open_with_own_priority(context: av.VideoCodecContext) -> None:
    """Open an encoder whose threads are scheduled as the caller is.

    SVT-AV1 makes its threads and its caller real-time threads where it may, as root, and they would starve all others.
    """
    if sys.platform != "linux":  # no other has such priorities
        context.open()
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    context.open()
    for thread in map(int, os.listdir("/proc/self/task")):
        with suppress(OSError):  # it has ended
            if os.sched_getscheduler(thread) != policy:
                os.sched_setscheduler(thread, policy, parameters)


def _set_alpha(plane: av.video.plane.VideoPlane, alpha: np.ndarray, largest: int) -> None:
    """Write alpha of 8 bits to a plane from 0 to `largest`, to nearest, which FFmpeg's conversion is not."""
    kind = np.uint8 if largest < 256 else np.uint16
    rows = np.zeros((plane.height, plane.line_size // kind().itemsize), kind)
    rows[:, : plane.width] = round_alpha(alpha, 255, largest)
    plane.update(rows)


def _pad(frame: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """The frame with its last row and column repeated up to multiples of `steps`."""
    rows, columns = (-side % step for side, step in zip(frame.shape, steps, strict=False))
    return np.pad(frame, ((0, rows), (0, columns), (0, 0)), mode="edge") if rows or columns else frame


def straighten(image: np.ndarray) -> np.ndarray:
    """Colors divided by alpha, to nearest; 0 where alpha is 0."""
    alpha = image[..., 3:].astype(np.uint16)
    colors = (image[..., :3].astype(np.uint16) * 255 + alpha // 2) // np.maximum(alpha, 1)
    return np.concatenate([np.minimum(colors, 255).astype(np.uint8), image[..., 3:]], axis=-1)
