"""Writing clips: videos with PyAV, that is FFmpeg's encoders, animations, folders of images and single images."""

import math
import os
import sys
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import av
import cv2
import numpy as np
from av.filter import Graph
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, VideoReformatter
from PIL import Image

from foldgauss._runtime.checks import check_one_of, check_within, is_integer, require, short_repr
from foldgauss.io._atomic import PathLike, atomic_folder, atomic_path, check_path, output_error
from foldgauss.io.media.clip import VideoError, check_fps, check_readable, format_size, video_error
from foldgauss.io.media.decoder import (
    CONVERSION,
    SOUND_DEMUXERS,
    VideoDecoder,
    filter_frame,
    open_container,
    round_alpha,
)
from foldgauss.io.media.frame_rate import MAX_SECONDS, are_rising_seconds, count_ticks

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
#: Colors of the frames of YUV; ProRes writes those of its frames into the file.
_BT709 = {
    "dst_colorspace": Colorspace.ITU709,
    "dst_color_primaries": ColorPrimaries.BT709,
    "dst_color_trc": ColorTrc.BT709,
}
SAMPLE_RATE = 48_000
#: Units of the time stamps of unevenly spaced frames, as parts of a second; Matroska counts milliseconds.
CLOCKS = {".mp4": 90_000, ".mov": 90_000, ".mkv": 1000, ".webm": 1000}
#: Seconds of the source by which atempo is early, measured below speed 1: clicks by 12 +- 8 ms, noise 15, tones 7.
TEMPO_LEAD = 0.012
VIDEO_SUFFIXES = tuple(DEFAULT_CODECS)
ANIMATION_SUFFIXES = (".gif", ".webp")
IMAGE_FORMATS = ("png", "webp")  # of folders of frames; both lossless
#: Pattern of the names of the files in them.
FRAME_NAMES = r"[0-9]{5,}\.(png|webp)"
MAX_WEBP_SIDE = 16_383
MAX_GIF_FPS = 50.0  # browsers show frames of less than 2 hundredths of a second for 10
WEBP_QUALITY = 90  # of an animated WebP, in its encoder's own measure


class Sound(NamedTuple):
    """The sound of a video: that of the file `path` from second `start` on, counted from the first frame of the video
    in that file, or from its first sound if it has none. Silence fills what is before the first sound.

    `speed`: the video is played that many times as fast as that file; the sound is stretched, its pitch kept. It ends
    with the video or with the file, whichever is first.
    """

    path: PathLike
    start: float = 0.0
    speed: float = 1.0


def write_video(
    path: PathLike,
    frames: Iterable[np.ndarray],
    fps: float,
    *,
    overwrite: bool = False,
    image_format: str = "png",
    codec: str | None = None,
    crf: int | None = None,
    pixel_format: str | None = None,
    sound: Sound | None = None,
    times: Sequence[float] | None = None,
) -> Path:
    """Write frames, uint8 RGB of shape (height, width, 3), and return the path. No partial file is left on errors.

    The extension selects the container, and unless `codec` is given the codec: `.mp4` H.264, which plays everywhere,
    `.webm` VP9, `.mov` ProRes, `.mkv` FFV1, which is lossless. `codec` is "h264", "h265", "av1", "vp9", "prores" or
    "ffv1". `crf` is the constant rate factor: a smaller one makes better and larger files; 16 by default for H.264.
    `pixel_format` is FFmpeg's name; by default "yuv420p" (half the color resolution) except for ProRes and FFV1. An odd
    height or width is then padded by repeating its last row or column. Colors are those of BT.709, and the file says
    so. An MP4 can be played while it is loaded (faststart).

    `times`: seconds at which the frames are shown, rising from 0, such as `Clip.times`, and if there is one more, the
    end, such as `Clip.duration`; otherwise the last frame is shown for 1 / fps. By default frames are evenly spaced. A
    folder of images holds no times.

    `sound`: that of another file, as `Sound("clip.mp4", start=2.0, speed=0.5)`; stored as AAC, in .webm as Opus.

    Frames with alpha, shape (height, width, 4) with colors premultiplied as in `Clip`, go to "vp9" in .webm or .mkv,
    "prores" and "ffv1".

    `.gif` and `.webp` are animations that repeat forever, held in memory until the last frame. A GIF has a palette of
    256 colors for each frame and durations in hundredths of a second, rounded so that the total is kept; more than 50
    frames per second, which browsers slow down, are refused. An animated WebP has 4:2:0 at quality 90.

    A path without extension, or an existing folder, goes to `write_frames`, with `overwrite` and `image_format`; an
    existing *file* is replaced. `fps` is in [1e-5, 1000].

    Raises `VideoError` for another extension, no frames, or frames of other shapes or types, or which the codec does
    not take; ValueError for options that do not fit together; `OutputError` where the path cannot be written.
    """
    path = check_path(path, "path, frames, fps")
    check_fps(fps)
    require(
        isinstance(frames, Iterable),
        "frames",
        expected="an iterable of images",
        got=type(frames).__name__,
        cure="For a model: model.frames().",
        kind=VideoError,
    )
    check_one_of("image_format", image_format, IMAGE_FORMATS)
    if times is not None:
        require(
            are_rising_seconds(times),
            "times",
            expected=f"seconds that rise from 0 to at most {MAX_SECONDS:,.0f}, one for each frame",
            got=short_repr(times),
            kind=VideoError,
        )
        times = np.array(times, np.float64)
        frames = _match_times(frames, len(times))
    suffix = path.suffix.lower()
    options = {"codec": codec, "crf": crf, "pixel_format": pixel_format, "sound": sound}
    given = [name for name, value in options.items() if value is not None]
    if given and suffix not in VIDEO_SUFFIXES:
        raise video_error(
            given[0], expected="a video file for it", got=repr(path.name), cure=f"Take {', '.join(VIDEO_SUFFIXES)}."
        )
    if os.path.isdir(path) or not path.suffix:  # not Path's, which raises for a name that is too long
        return write_frames(path, frames, overwrite=overwrite, image_format=image_format)
    if suffix in ANIMATION_SUFFIXES:
        return _write_animation(path, suffix, frames, float(fps), times)
    require(
        suffix in VIDEO_SUFFIXES,
        "path",
        expected="a name ending in .mp4, .webm, .mov, .mkv, .gif or .webp, or a folder (no extension) for images",
        got=repr(path.name),
        cure="For one image: write_image." if suffix == ".png" else "Rename the output.",
        kind=VideoError,
    )
    frames = _check_frames(frames)
    first = next(frames)
    encoding = choose_encoding(suffix, codec, crf, pixel_format, first.shape)
    if sound is not None:
        check_sound(sound)
    with atomic_path(path) as temporary:
        try:
            encode_video(temporary, chain([first], frames), float(fps), encoding, sound, times)
        except av.FFmpegError as error:  # an OSError of making the frames is none of these
            if isinstance(error, OSError):
                raise output_error(path, error) from error
            raise video_error(
                "frames",
                expected=f"frames that {encoding.codec.encoder} takes",
                got=f"{format_size(first.shape)} at {fps:g} fps",
                cure=f"It says: {error.strerror}. Take another size, rate or codec.",
            ) from error
    return path


def write_frames(
    folder: PathLike, frames: Iterable[np.ndarray], *, overwrite: bool = False, image_format: str = "png"
) -> Path:
    """Write frames as 00000.png, 00001.png, ...; returns the folder.

    Frames are uint8 RGB of shape (height, width, 3), or premultiplied RGBA of shape (height, width, 4).

    With `image_format="webp"` as 00000.webp and so on: lossless like PNG, and smaller. The folder appears whole or not
    at all. A folder that holds files is refused unless `overwrite`, and in any case if it holds anything but such
    numbered frames.

    Raises `VideoError` for no frames or frames of other shapes or types, `OutputError` where the folder is refused,
    ValueError for an unknown `image_format`.
    """
    check_one_of("image_format", image_format, IMAGE_FORMATS)
    folder = Path(folder)
    with atomic_folder(folder, overwrite, pattern=FRAME_NAMES) as temporary:
        for number, frame in enumerate(_check_frames(frames)):
            (temporary / f"{number:05d}.{image_format}").write_bytes(_encode_image(frame, image_format))
    return folder


def write_image(path: PathLike, image: np.ndarray) -> Path:
    """Write one image as PNG, whole or not at all; returns the path.

    It is uint8 RGB of shape (height, width, 3), or premultiplied RGBA of shape (height, width, 4).

    Raises `VideoError` for another extension or kind of array, `OutputError` where it cannot be written.
    """
    path = Path(path)
    require(
        path.suffix.lower() == ".png",
        "path",
        expected="a name ending in .png",
        got=repr(path.name),
        cure="Rename the output.",
        kind=VideoError,
    )
    data = _encode_image(_check_frame(image, None, "image"))
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return path


def _match_times(frames: Iterable[np.ndarray], num: int) -> Iterator[np.ndarray]:
    """The frames. Raises `VideoError` unless there are as many as times, `num`, or one fewer: the last is the end."""
    count = 0
    for count, frame in enumerate(islice(frames, num + 1), 1):
        if count <= num:
            yield frame
    require(
        num - 1 <= count <= num,
        "frames",
        expected=f"{num}, as many as times, or one fewer",
        got=f"more than {num}" if count > num else f"{count}",
        kind=VideoError,
    )


def _check_frames(frames: Iterable[np.ndarray], channels: tuple[int, ...] = (3, 4)) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        frame = _check_frame(frame, shape, f"frames[{number}]", channels)
        shape = frame.shape
        yield frame
    require(
        shape is not None,
        "frames",
        expected="at least 1 frame",
        got="none",
        kind=VideoError,
    )


def _check_frame(frame: np.ndarray, shape: tuple | None, parameter: str, channels=(3, 4)) -> np.ndarray:
    frame = np.asarray(frame)
    fits = frame.ndim == 3 and frame.shape[2] in channels and min(frame.shape) > 0 and frame.dtype == np.uint8
    if not fits or (shape is not None and frame.shape != shape):
        cure = ""
        if frame.dtype != np.uint8:
            cure = "For floats in [0, 1]: np.rint(255 * np.clip(frame, 0, 1)).astype(np.uint8)."
        elif frame.ndim == 3 and frame.shape[2] == 4:
            cure = "Composite it over a color, or take a kind of file that has alpha: .webm, .mov, .mkv or images."
        raise video_error(
            parameter,
            expected=f"uint8 RGB of shape {shape or '(height, width, 3)'}",
            got=f"{frame.dtype} of shape {frame.shape}",
            cure=cure,
        )
    return np.ascontiguousarray(frame)


def _encode_image(frame: np.ndarray, image_format: str = "png") -> bytes:
    """Without loss; with alpha, colors become straight."""
    require(
        image_format != "webp" or max(frame.shape[:2]) <= MAX_WEBP_SIDE,
        "frames",
        expected=f"sides of at most {MAX_WEBP_SIDE:,} for WebP",
        got=format_size(frame.shape),
        cure="Take PNG.",
        kind=VideoError,
    )
    rgba = frame.shape[2] == 4
    image = cv2.cvtColor(straighten(frame), cv2.COLOR_RGBA2BGRA) if rgba else cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101] if image_format == "webp" else []  # above 100: lossless
    return cv2.imencode(f".{image_format}", image, quality)[1].tobytes()


# ------------------------------------------------------------------------------------------- animations


def _write_animation(
    path: Path, suffix: str, frames: Iterable[np.ndarray], fps: float, times: np.ndarray | None
) -> Path:
    """Write an animated GIF or WebP that repeats forever."""
    require(
        suffix != ".gif" or fps <= MAX_GIF_FPS,
        "fps",
        expected=f"at most {MAX_GIF_FPS:g} for a GIF",
        got=f"{fps:g}",
        cure="Take fewer frames, or a .webp or .webm.",
        kind=VideoError,
    )
    with atomic_path(path) as temporary:
        images = map(Image.fromarray, _check_frames(frames, channels=(3,)))
        first, *rest = (image.quantize(256) for image in images) if suffix == ".gif" else images
        ends = np.arange(len(rest) + 2) / fps
        if times is not None:
            ends = np.append(times, times[-1] + 1 / fps)[: len(ends)]
        # In milliseconds, for a GIF in whole hundredths of a second, whose sums are the true times rounded.
        step, least, kind = (10, 2, {"optimize": False}) if suffix == ".gif" else (1, 1, {"quality": WEBP_QUALITY})
        durations = (step * np.diff(count_ticks(1000 / step * ends, least=least))).tolist()
        try:
            kind |= {"save_all": True, "append_images": rest, "loop": 0, "duration": durations}
            first.save(temporary, suffix.removeprefix("."), **kind)
        except OSError as error:
            raise output_error(path, error) from error
        except (OverflowError, RuntimeError, ValueError) as error:
            longest, expected = np.diff(ends).max(), f"a size and times that {suffix} can hold"
            raise video_error(
                "frames",
                expected=expected,
                got=f"{first.height}x{first.width}, shown for up to {longest:g} s",
                cure="Take an .mp4 or .webm.",
            ) from error
    return path


# -------------------------------------------------------------------------------------------- encoders


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
    require(
        suffix in chosen.suffixes,
        "codec",
        expected=f"{name} in one of {', '.join(chosen.suffixes)}",
        got=suffix,
        cure=f"For {suffix} take {', '.join(other for other, one in CODECS.items() if suffix in one.suffixes)}.",
    )
    require(
        min(shape[:2]) >= chosen.min_side,
        "frames",
        expected=f"at least {chosen.min_side}x{chosen.min_side} for {name}",
        got=format_size(shape),
        cure="Take h264, vp9 or ffv1.",
        kind=VideoError,
    )
    if crf is not None:
        require(
            chosen.crf is not None,
            "crf",
            expected=f"none for {name}, which has no such factor",
            got=f"{crf}",
        )
        require(
            is_integer(crf, 0) and crf <= chosen.crf[1],
            "crf",
            expected=f"a whole number from 0 to {chosen.crf[1]} for {name}",
            got=repr(crf),
        )
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
    colors = {} if pixel_format.is_rgb else _BT709
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
                if colors:
                    context = stream.codec_context
                    context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
                    context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
                stream.codec_context.time_base = clock
                if ticks is not None:  # with B-frames, an MP4 does not say for how long the last frame is shown
                    stream.codec_context.max_b_frames = 0
                open_with_own_priority(stream.codec_context)
            given = av.VideoFrame.from_ndarray(image, format="rgba" if image.shape[2] == 4 else "rgb24")
            given = converter.reformat(given, format=pixel_format.name, interpolation=CONVERSION, **colors)
            if image.shape[2] == 4 and len(given.planes) == 4:
                _set_alpha(given.planes[3], image[..., 3], (1 << pixel_format.components[3].bits) - 1)
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
            of_file, graph = source.streams.best("audio"), None
            begin = _first_shown(Path(sound.path), of_file) + sound.start
            for frame in chain(_decode_sound(source, of_file), [None]):
                if graph is None and frame is not None:
                    graph = _make_sound_graph(frame, of_file.time_base, begin, sound.speed, stream)
                for filtered in filter_frame(graph, frame):
                    yield from stream.encode(filtered)
            yield from stream.encode()
    except av.FFmpegError as error:
        raise video_error(
            "sound",
            expected="sound that FFmpeg converts",
            got=f"{str(sound.path)!r} ({error.strerror})",
            cure="Convert it with ffmpeg, or leave it out.",
        ) from error


def _make_sound_graph(
    frame: av.AudioFrame, clock: Fraction, begin: float, speed: float, stream: av.AudioStream
) -> Graph:
    """A filter of sound like `frame`, with times in units of `clock`, from second `begin` on, for the encoder of
    `stream`."""
    # FFmpeg's conversion of one channel to two makes it quieter, as if it were in the middle of others.
    steps = [("pan", "stereo|c0=c0|c1=c0")] if frame.layout.nb_channels == 1 else []
    steps += [("aformat", f"sample_fmts=fltp:sample_rates={SAMPLE_RATE}:channel_layouts=stereo")]
    # atempo takes factors from 0.5 to 100; at 1 it would still shift the sound.
    num = 0 if speed == 1 else max(1, math.ceil(-math.log2(speed)))
    begin -= TEMPO_LEAD if num else 0
    steps += [("asettb", f"1/{SAMPLE_RATE}"), ("atrim", f"start={begin:.6f}"), ("asetpts", f"PTS-({begin:.6f})/TB")]
    steps += [("aresample", "async=1:first_pts=0")]  # silence where there is no sound
    steps += [("atempo", f"{speed ** (1 / max(num, 1)):.9f}")] * num
    steps += [("aformat", f"sample_fmts={stream.format.name}"), ("abuffersink",)]
    graph = Graph()
    kind = {"sample_rate": frame.sample_rate, "format": frame.format.name, "layout": frame.layout.name}
    graph.link_nodes(graph.add_abuffer(**kind, time_base=clock), *(graph.add(*step) for step in steps)).configure()
    if stream.codec_context.frame_size:
        graph.set_audio_frame_size(stream.codec_context.frame_size)
    return graph


def _first_shown(path: Path, of_file: av.AudioStream) -> float:
    """The time stamp in seconds of the first frame that decodes, or of the first sound where there is no video."""
    with suppress(VideoError, StopIteration), closing(VideoDecoder(path)) as decoder:
        return float(next(decoder.frames())[0] * decoder.time_base)
    return float((of_file.start_time or 0) * of_file.time_base)


def _decode_sound(source: av.container.InputContainer, stream: av.AudioStream) -> Iterator[av.AudioFrame]:
    """The frames of sound that decode, each with its time stamp."""
    end = None
    for packet in source.demux(stream):
        found = []
        with suppress(av.FFmpegError):
            found = packet.decode()
        for frame in found:
            if frame.pts is None:  # of a packet's frames only the first may have a time stamp
                frame.pts = end
            if frame.pts is not None:
                end = frame.pts + round(Fraction(frame.samples, frame.sample_rate) / stream.time_base)
            yield frame


def check_sound(sound: Sound) -> None:
    """Raise `VideoError` for a file without sound, ValueError for other values that are refused."""
    require(
        isinstance(sound, Sound),
        "sound",
        expected="a foldgauss.io.Sound",
        got=type(sound).__name__,
        cure="Write Sound('clip.mp4').",
    )
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
