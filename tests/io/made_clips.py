"""Clips of every kind, made byte by byte, by PyAV, by Pillow or by FFmpeg's command, and what each must be read as."""

import functools
import io
import math
import shutil
import struct
import subprocess
from collections.abc import Callable
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from foldgauss.io import VideoError, read_video, write_frames, write_video
from foldgauss.io.media.writing import open_with_own_priority


def noise(num_frames=8, height=48, width=64, channels=3):
    return np.random.default_rng(0).integers(0, 256, (num_frames, height, width, channels)).astype(np.uint8)


def waves(num_frames=8, height=48, width=64):
    """Gray pictures that a lossy encoder keeps; no two are alike."""
    y, x = np.mgrid[:height, :width]
    frames = [128 + 100 * np.sin(0.05 * x + 0.5 * k) * np.cos(0.06 * y) for k in range(num_frames)]
    return np.repeat(np.rint(frames).astype(np.uint8)[..., None], 3, -1)


def moving(num_frames=8, height=48, width=64):
    """A smooth, moving color pattern, whose frames can still be identified after lossy compression (VP9, 4:2:0)."""
    y, x = np.mgrid[:height, :width]
    k = np.arange(num_frames)[:, None, None]
    red, green = 128 + 100 * np.sin(0.05 * x + 0.5 * k), 128 + 90 * np.cos(0.06 * y - 0.4 * k)
    blue = 128 + 60 * np.sin(0.04 * (x + y)) + 0 * k
    return np.rint(np.stack([red + 0 * y, green + 0 * x, blue], -1)).astype(np.uint8)


def rgba(colors):
    """Colors with alpha in three bands; hidden colors where alpha is 0."""
    alpha = np.zeros((*colors.shape[:3], 1), np.uint8)
    alpha[:, :24], alpha[:, 24:36] = 255, 51
    return np.concatenate([colors, alpha], -1)


def weighed(frames):
    """Colors times alpha, not rounded."""
    return np.concatenate([frames[..., :3] * (frames[..., 3:] / 255), frames[..., 3:]], -1)


def premultiplied(frames):
    return np.rint(weighed(frames)).astype(np.uint8)


# ------------------------------------------------------------------------------------------------ writers


def bgr(frame):
    """An image as OpenCV has it."""
    return frame if frame.ndim == 2 else frame[..., [2, 1, 0, 3][: frame.shape[-1]]]


def png(frame):
    return cv2.imencode(".png", bgr(frame))[1].tobytes()


def avi(packets, height, width, *, num=None, fourcc=b"MPNG"):
    """An AVI of such packets, 10 a second; `num`: the frames that its header counts."""

    def chunk(name, *parts):
        data = b"".join(parts)
        return name + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2)

    num = len(packets) if num is None else num
    main = struct.pack("<14I", 100_000, 0, 0, 0, num, 0, 1, 0, width, height, 0, 0, 0, 0)
    stream = b"vids" + fourcc
    stream += struct.pack("<IHHIIIIIIIIHHHH", 0, 0, 0, 0, 1, 10, 0, num, 0, 0, 0, 0, 0, width, height)
    kind = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, fourcc, 0, 0, 0, 0, 0)
    described = chunk(b"LIST", b"strl", chunk(b"strh", stream), chunk(b"strf", kind))
    head = chunk(b"LIST", b"hdrl", chunk(b"avih", main), described)
    return chunk(b"RIFF", b"AVI ", head, chunk(b"LIST", b"movi", *[chunk(b"00dc", packet) for packet in packets]))


def put(path, data):
    path.write_bytes(data)
    return path


def exact_avi(path, frames, **options):
    """An AVI of PNGs, whose pixels are read as they are."""
    return put(path, avi([png(frame) for frame in frames], *frames[0].shape[:2], **options))


_HOLDERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")


def with_box(data, name, change):
    """An MP4 whose index stands last, with `change` made to the content of its boxes `name`."""
    made = b""
    while data:
        size, kind = int.from_bytes(data[:4], "big"), data[4:8]
        content, data = data[8:size], data[size:]
        if kind in _HOLDERS:
            content = with_box(content, name, change)
        elif kind == name:
            content = change(content)
        made += struct.pack(">I", 8 + len(content)) + kind + content
    return made


def encode(path, frames, codec, pixel_format, *, given=None, times=None, context=None, rate=10, sound=None, **options):
    """Encode by PyAV. `given`: the format of `frames`; `times`: in units of a frame; `context`: of the codec.

    `sound`: a codec, samples in [-1, 1] of one channel, 48,000 a second, and the second of the first of them.
    """
    with av.open(path if isinstance(path, io.BytesIO) else str(path), "w", format=options.pop("format", None)) as out:
        stream = out.add_stream(codec, rate=rate, **options)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixel_format
        for name, value in (context or {}).items():
            setattr(stream.codec_context, name, value)
        if codec == "libsvtav1":
            open_with_own_priority(stream.codec_context)
        heard = sound and out.add_stream(sound[0], rate=SOUND_RATE, layout="mono")
        for number, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format=given or pixel_format)
            if times is not None:
                frame.pts, frame.time_base = int(times[number]), Fraction(1, rate)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
        if sound:
            mux_sound(out, heard, *sound[1:])
    return path


SOUND_RATE = 48_000


def mux_sound(container, stream, samples, start=0.0):
    """Encode one channel of samples, in as many as the stream has."""
    channels = np.float32(samples)[None].repeat(stream.channels, 0)
    frame = av.AudioFrame.from_ndarray(channels, format="fltp", layout=stream.layout.name)
    frame.sample_rate, frame.pts = stream.rate, round(stream.rate * start)
    container.mux([*stream.encode(frame), *stream.encode()])


@functools.cache
def mp4():
    """8 frames of 48x64, 10 a second; its index stands last, unlike that of `write_video`."""
    file, options = io.BytesIO(), {"crf": "5", "bf": "0"}
    data = encode(file, waves(), "libx264", "yuv420p", given="rgb24", options=options, format="mp4").getvalue()
    assert data.rindex(b"moov") > data.rindex(b"mdat")
    return data


@functools.cache
def uneven_mp4():
    """The same whose frames are shown for 0.1 s, from the fifth on for 0.4 s: a table of sample times (stts)."""

    def change(content):
        tick = int.from_bytes(content[12:16], "big")
        entries = b"".join(struct.pack(">II", 1, tick * ticks) for ticks in TICKS)
        return content[:4] + struct.pack(">I", len(TICKS)) + entries

    return with_box(mp4(), b"stts", change).replace(b"edts", b"free")  # an edit list, which would cut it short


def webm(path, old=b"", new=b""):
    """A WebM of `waves()`, with other bytes for the first of these."""
    data = write_video(path, waves(), 10).read_bytes()
    assert old in data
    return put(path, data.replace(old, new, 1))


def webm_of_duration(path, seconds):
    """A WebM with another duration, stored in milliseconds."""
    data = webm(path).read_bytes()
    at = data.index(b"\x44\x89\x88") + 3
    return put(path, data[:at] + struct.pack(">d", 1000 * seconds) + data[at + 8 :])


def ffmpeg(*arguments, frames=None, rate=10):
    """What ffmpeg writes to its output, given `frames` if any; skips where there is none, or none with that encoder."""
    if shutil.which("ffmpeg") is None:
        pytest.skip("ffmpeg is not installed, and nothing else here encodes this")
    given = ["-nostdin"]
    if frames is not None:
        height, width = frames.shape[1:3]
        kind = {3: "rgb24", 4: "rgba"}[frames.shape[3]]
        given = ["-f", "rawvideo", "-pix_fmt", kind, "-s", f"{width}x{height}", "-r", str(rate), "-i", "-"]
    command = ["ffmpeg", "-v", "error", "-y", *given, *map(str, arguments)]
    sent = None if frames is None else frames.tobytes()
    ran = subprocess.run(command, input=sent, capture_output=True, check=False, timeout=120)
    if b"Unknown encoder" in ran.stderr:
        pytest.skip(f"this ffmpeg lacks an encoder: {ran.stderr.decode().splitlines()[0]}")
    assert ran.returncode == 0, ran.stderr.decode()
    return ran.stdout


def encoded(path, frames, *options, rate=10):
    """The file that ffmpeg encodes."""
    ffmpeg(*options, path, frames=frames, rate=rate)
    return path


def animation(path, frames, **options):
    """Frames by Pillow."""
    first, *rest = map(Image.fromarray, frames)
    first.save(path, save_all=True, append_images=rest, **options)
    return path


def delays(rate, num=20):
    """Milliseconds of frames in whole hundredths, as FFmpeg writes them; its last one may be longer than the others."""
    found = np.diff(np.rint(100 * np.arange(num + 1) / rate)) * 10
    found[-1] += 20
    return found.astype(int).tolist()


def picture(path, kind):
    Image.fromarray(waves(1)[0]).save(path, kind)
    return path


def packets_of(frames, suffix):
    return [cv2.imencode(suffix, one, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes() for one in frames]


def gif_with_holes(path):
    """A square that walks, transparent around it."""
    pictures = []
    for k in range(3):
        pictures.append(Image.new("P", (64, 48), 0))
        pictures[k].putpalette([0, 0, 0, 200, 30, 30])
        pictures[k].paste(1, (8 * k, 8, 8 * k + 16, 24))
    shared = {"save_all": True, "append_images": pictures[1:], "duration": 100, "transparency": 0, "disposal": 2}
    pictures[0].save(path, **shared)
    return path


def square_that_walks():
    frames = np.zeros((3, 48, 64, 4), np.uint8)
    for k in range(3):
        frames[k, 8:24, 8 * k : 8 * k + 16] = (200, 30, 30, 255)
    return frames


def images(folder, frames, suffix=".png"):
    """A folder of images by OpenCV."""
    folder.mkdir(exist_ok=True)
    for number, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / f"{number}{suffix}"), bgr(frame))
    return folder


# ------------------------------------------------------------------------------------------------ the table


class Made(NamedTuple):
    """A clip to be written into a folder, what its frames must be, and facts of the clip that is read."""

    write: Callable[[Path], Path]
    frames: np.ndarray | None
    facts: dict
    #: Largest error in levels, of each channel, each pixel or all; by default 0, and any where the mean is bounded.
    near: float | list[float] | np.ndarray | None = None
    mean: float = math.inf


TICKS = [1, 1, 1, 1, 4, 4, 4, 4]  # of 0.1 s, which each frame lasts
SHOWN = np.array([0, 0.1, 0.2, 0.3, 0.4, 0.8, 1.2, 1.6])
_SETPTS = "+".join(rf"gte(N\,{k})*{ticks}" for k, ticks in enumerate(TICKS[:-1], 1))
_UNEVENLY = ("-vf", f"settb=1/1000,setpts=100*({_SETPTS})", "-vsync", "vfr", "-c:v", "png")
#: Seconds at which 8 frames of a clip with an uneven rate are shown, and the end.
UNEVEN = np.array([0, 0.1, 0.1634, 0.4, 0.5, 0.5334, 0.8, 0.9, 1.3])
NEAR = np.array([0, 1e-7, 2e-7, 0.1, 0.2, 0.5, 0.6, 0.7])
RED = np.broadcast_to(np.uint8([200, 0, 0]), (4, 32, 32, 3))
COUNTED = {"num_frames": 8, "num_declared": 8}
EVEN = {"times": None, "duration": None, "notes": ()}
_PALE = np.repeat(np.arange(0, 256, 4, dtype=np.uint8)[None, None, :, None], 3, -1).repeat(48, 1).repeat(2, 0)
_LUMA = np.tile(np.linspace(16, 235, 64).round(), (1, 48, 1))
_RATES = (20, 24000 / 1001, 30)
_RAMP = np.broadcast_to(np.arange(256, dtype=np.uint8), (2, 64, 256))
_LEVELS = np.stack([_RAMP // 2, _RAMP // 2, _RAMP // 2, _RAMP], -1)
_BLACK = np.broadcast_to(np.uint8(0), (1, 1500, 1500, 3))
_ALPHA = np.concatenate([moving(4), moving(4)[..., :1]], -1)
_CRF_5 = ("libx264", "-crf", "5", "-pix_fmt", "yuv420p")
_ALL = np.arange(65536, dtype=np.uint16).reshape(256, 256)
#: Errors where nothing may be seen.
_CLEAR = np.where(np.arange(48) < 40, 255, 0)[:, None, None]
_COLORS = [[200, 30, 30], [30, 200, 30], [30, 30, 200], [128, 128, 128], [250, 250, 250], [5, 5, 5]]
_COLORS = np.array([*_COLORS, [220, 180, 40], [90, 20, 140]], np.uint8)
_BANDS = np.broadcast_to(_COLORS.repeat(16, 0), (2, 48, 128, 3))
#: Within a band, in the second frame.
_INSIDE = np.zeros((2, 48, 128, 1), bool)
_INSIDE[1, 5:43] = ((np.arange(128) % 16 >= 5) & (np.arange(128) % 16 < 11))[:, None]
#: Of 12 frames, those that a file stores which repeats frame 3 three times.
_KEPT = np.array([0, 1, 2, 3, 7, 8, 9, 10, 11])

CLIPS = {
    # Times. Matroska does not count its frames: 22 were once promised of these 8.
    **{
        f"uneven times: {name}": Made(
            lambda folder, name=name: encoded(folder / name, noise(), *_UNEVENLY),
            noise(),
            {"times": pytest.approx(SHOWN, abs=2e-3), "num_declared": 8, "fps": pytest.approx(7 / 1.6, rel=1e-3)},
        )
        for name in ("clip.mkv", "clip.nut", "clip.mov")
    },
    **{
        f"rounded time stamps: {fps} {name}": Made(
            lambda folder, name=name, fps=fps: write_video(folder / name, waves(31), fps),
            None,
            {"times": None, "notes": (), "fps": pytest.approx(fps, rel=5e-3)},  # half a hundredth of a second
        )
        for fps, name in ((29.97, "a.webm"), (23.976, "a.mp4"), (60, "a.webm"), (29.97, "a.gif"))
    },
    **{
        f"an animation with times of its own: {name}": Made(
            lambda folder, name=name: animation(folder / name, waves(4), duration=[100, 100, 400, 200]),
            None,
            {"times": pytest.approx([0, 0.1, 0.2, 0.6], rel=1e-7), "fps": pytest.approx(5), "notes": ["shown for"]},
        )
        for name in ("a.gif", "a.png", "a.webp")
    },
    **{
        f"delays in hundredths: {rate:.3f}": Made(
            lambda folder, rate=rate: animation(folder / "a.gif", waves(20), duration=delays(rate)),
            None,
            {"num_frames": 20, "fps": pytest.approx(rate, rel=0.01), **EVEN},
        )
        for rate in _RATES
    },
    **{
        f"written times: {name} {codec}": Made(
            lambda folder, name=name, codec=codec: write_video(
                folder / name, moving(8, 64, 64), 7 / 0.9, times=UNEVEN, codec=codec
            ),
            None,
            {
                "num_frames": 8,
                "times": pytest.approx(UNEVEN[:-1], abs=near),
                "duration": pytest.approx(UNEVEN[-1], abs=near),
                # The rate of animations is that of the durations.
                **({} if name.endswith((".gif", ".webp")) else {"fps": pytest.approx(7 / 0.9, rel=1e-3)}),
            },
        )
        for name, codec, near in (
            ("a.mp4", None, 1e-5), ("a.mp4", "h265", 1e-5), ("a.mp4", "av1", 1e-5), ("a.webm", None, 6e-4),
            ("a.mov", None, 1e-5), ("a.mkv", None, 6e-4), ("a.gif", None, 6e-3), ("a.webp", None, 6e-4),
        )
    },
    **{  # They stay in order.
        f"times too near for the clock: {name}": Made(
            lambda folder, name=name: write_video(folder / name, moving(), 10, times=NEAR),
            None,
            {"times": pytest.approx(NEAR, abs=near)},
        )
        for name, near in (("a.mp4", 5e-5), ("a.mkv", 3e-3), ("a.webm", 3e-3))
    },
    **{
        f"frames too quick for an animation: {name}": Made(
            lambda folder, name=name, least=least: write_video(
                folder / name, moving(), 8, times=[*(np.arange(7) * least / 3), 1.0, 1.2]
            ),
            None,
            {"times": pytest.approx([*(np.arange(7) * least), 1.0], abs=1e-9), "duration": pytest.approx(1.2)},
        )
        for name, least in (("a.gif", 0.02), ("a.webp", 0.001))
    },
    "a rate by the names of the stream": Made(
        lambda folder: encoded(folder / "a.h264", waves(), "-c:v", "libx264", "-crf", "5"),
        None,
        {"num_frames": 8, "fps": 10, "notes": ["no usable frame rate; 10 frames per second are assumed"]},
    ),
    "a rate above 1000": Made(
        lambda folder: encoded(folder / "fast.mp4", waves(), "-c:v", "libx264", "-crf", "5", rate=1200),
        None,
        {"num_frames": 8, "fps": 25, "notes": ["no usable frame rate; 25 frames per second are assumed"]},
    ),
    "raw AV1": Made(
        lambda folder: encode(
            folder / "a.obu", waves(8, 64, 64), "libsvtav1", "yuv420p", given="rgb24", options={"preset": "12"}
        ),
        None,
        {"num_frames": 8, "notes": ["records no usable frame rate"]},
    ),
    **{
        f"the last frame is held: {name} {hold}": Made(
            lambda folder, name=name, hold=hold: write_video(
                folder / name, moving(), 10, times=[*(0.1 * np.arange(8)), 0.7 + hold]
            ),
            None,
            COUNTED
            | {"duration": None if hold == 0.1 else pytest.approx(1.7)}
            | ({} if name.endswith((".gif", ".webp")) else {"fps": pytest.approx(10)}),
        )
        for name in ("a.mp4", "a.webm", "a.mov", "a.mkv", "a.gif", "a.webp")
        for hold in (0.1, 1.0)
    },
    # Frame 3 is shown for four tenths; the file counts 12, and stores 9.
    **{
        f"frames that an AVI repeats: {codec}": Made(
            lambda folder, codec=codec, kind=kind: encode(
                folder / "a.avi", waves(12)[_KEPT], codec, kind, given="rgb24", times=_KEPT, options={"q": "2"}
            ),
            None,
            {
                "num_frames": 9,
                "num_declared": 9,
                "duration": pytest.approx(1.2),
                "times": pytest.approx(_KEPT / 10, abs=1e-6),
                "notes": ["shown for"],
            },
        )
        for codec, kind in (("mjpeg", "yuvj420p"), ("mpeg4", "yuv420p"))
    },
    # Sizes and colors.
    **{
        f"size {size}": Made(
            lambda folder, size=size: exact_avi(folder / "a.avi", noise(3, *size)), noise(3, *size), {"fps": 10}
        )
        for size in ((1, 1), (2, 2), (35, 51), (3, 4097))
    },
    **{
        f"images of {size}": Made(
            lambda folder, size=size: write_video(folder / "clip", noise(2, *size), 25), noise(2, *size), {"fps": 25.0}
        )
        for size in ((1, 1), (8, 8), (1, 4096), (4096, 1))
    },
    **{
        f"red {name}": Made(lambda folder, name=name: write_video(folder / name, RED, 25), RED, {}, near=6)
        for name in ("a.mp4", "a.webm", "a")
    },
    **{
        f"images {suffix}": Made(
            lambda folder, suffix=suffix: images(folder / "a", moving(2), suffix), moving(2), {"notes": ()}, mean=4
        )
        for suffix in (".png", ".JPG", ".jpeg", ".bmp", ".tif", ".webp")
    },
    **{  # Large images of one color have few bytes.
        f"black {suffix}": Made(
            lambda folder, suffix=suffix: images(folder / "a", _BLACK, suffix), _BLACK, {"num_frames": 1}
        )
        for suffix in (".png", ".jpg")
    },
    **{
        f"gray {suffix}": Made(
            lambda folder, suffix=suffix, fourcc=fourcc: put(
                folder / "gray.avi", avi(packets_of(waves(4)[..., 0], suffix), 48, 64, fourcc=fourcc)
            ),
            waves(4),
            {},
            near=near,
        )
        for suffix, fourcc, near in ((".png", b"MPNG", 0), (".jpg", b"MJPG", 2))
    },
    **{
        f"{kind} of {'limited' if limited else 'full'} range": Made(
            lambda folder, kind=kind, scale=scale, limited=limited: encode(
                folder / "a.mkv",
                (scale * _LUMA).astype(np.uint8 if scale == 1 else np.uint16),
                "ffv1",
                kind,
                context={"color_range": 1 if limited else 2},
            ),
            ((_LUMA - 16) * 255 / 219 if limited else _LUMA)[..., None].repeat(3, -1),
            {},
            near=1,
        )
        for kind, scale in (("gray", 1), ("gray10le", 4))
        for limited in (True, False)
    },
    # MPEG-2 stores only a few aspects of the image, which is 4:3 or 16:9 then: 64 columns of 4/3 each.
    **{
        f"pixels of {aspect} become square: {name} {codec}": Made(
            lambda folder, name=name, aspect=aspect, options=(codec, *quality), rate=rate: encoded(
                folder / name, waves(), "-vf", f"setsar={aspect}", "-c:v", *options, rate=rate
            ),
            np.array([cv2.resize(frame, size[::-1], interpolation=cv2.INTER_LINEAR) for frame in waves()]),
            {"notes": [f"times as wide as high; frames are {shown}", *notes]},
            mean=3,
        )
        for name, (codec, *quality), aspect, size, rate, shown, *notes in (
            ("a.mkv", ("ffv1",), "2/1", (48, 128), 10, "stretched to 48x128"),
            ("a.mkv", ("ffv1",), "16/15", (48, 68), 10, "stretched to 48x68"),
            ("a.mp4", _CRF_5, "16/15", (48, 68), 10, "stretched to 48x68"),
            ("a.mp4", _CRF_5, "1/2", (96, 64), 10, "stretched to 96x64"),
            ("a.mp4", _CRF_5, "30/1", (48, 64), 10, "kept as stored"),
            ("a.h264", _CRF_5, "2/1", (48, 128), 10, "stretched to 48x128", "no usable frame rate"),
            ("a.ts", ("mpeg2video", "-q:v", "1"), "4/3", (48, 85), 25, "stretched to 48x85"),
        )
    },
    # Ten bits are not clipped, a full range not stretched; colors are those of their matrix.
    **{
        f"bands of color: {name} {' '.join(options)}": Made(
            lambda folder, name=name, options=options: encoded(folder / name, _BANDS, *options),
            _BANDS,
            {},
            near=np.where(_INSIDE, near, 255),
        )
        for name, near, options in (
            ("a.mkv", 2, ("-c:v", "ffv1", "-pix_fmt", "yuv444p")),
            ("a.mkv", 3, ("-c:v", "ffv1", "-pix_fmt", "yuv420p10le")),
            ("a.mkv", 3, ("-c:v", "ffv1", "-pix_fmt", "yuv420p16le")),
            ("a.mkv", 1, ("-c:v", "ffv1", "-pix_fmt", "gbrp10le")),
            ("a.mkv", 1, ("-c:v", "ffv1", "-pix_fmt", "rgb48le")),
            ("a.mov", 3, ("-c:v", "prores_ks", "-pix_fmt", "yuv422p10le")),
            ("a.mp4", 3, ("-c:v", "libx264", "-crf", "1", "-pix_fmt", "yuv420p10le")),
            ("a.mp4", 3, ("-c:v", "libx265", "-crf", "1", "-pix_fmt", "yuv420p10le", "-x265-params", "log-level=none")),
            ("a.webm", 3, ("-c:v", "libvpx-vp9", "-crf", "1", "-pix_fmt", "yuv420p10le")),
            ("a.mkv", 3, ("-vf", "scale=out_range=full", "-color_range", "pc", "-c:v", "ffv1", "-pix_fmt", "yuv420p")),
            ("a.mkv", 3, ("-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709", "-c:v", "ffv1")),
        )
    },
    "images of 16 bits": Made(
        lambda folder: images(folder / "a", [_ALL, _ALL[..., None].repeat(3, -1)]),
        np.broadcast_to(np.rint(_ALL / 257)[..., None], (2, 256, 256, 3)),
        {},
    ),
    "ten bits of gray": Made(
        lambda folder: encoded(folder / "a.mkv", _PALE, "-c:v", "ffv1", "-pix_fmt", "gray10le"), _PALE, {}, near=2
    ),
    # Alpha.
    **{
        f"alpha of an animation: {name}": Made(
            lambda folder, name=name, options=options: animation(folder / name, rgba(waves(4)), duration=50, **options),
            premultiplied(rgba(waves(4))),
            {"has_alpha": True, "fps": 20, "num_declared": 4},
            near=[1, 1, 1, 0],
        )
        for name, options in (("a.png", {}), ("a.webp", {"lossless": True}))
    },
    **{
        f"every level of alpha: {name} {options}": Made(
            lambda folder, name=name, options=options: write_video(folder / name, _LEVELS, 10, **options),
            _LEVELS,
            {"has_alpha": True},
            near=[255, 255, 255, 0],
        )
        for name, options in (
            ("a.mov", {}), ("a.mkv", {}), ("a.webm", {"crf": 0}), ("a.mov", {"pixel_format": "yuva444p10le"})
        )
    },
    **{
        f"alpha of videos: {name} {' '.join(options)}": Made(
            lambda folder, name=name, options=options: encoded(folder / name, rgba(waves(4)), *options),
            weighed(rgba(waves(4))),
            {"has_alpha": True},
            near=_CLEAR,
            mean=3,
        )
        for name, options in (
            ("a.webm", ("-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p")),
            ("a.mov", ("-c:v", "qtrle", "-pix_fmt", "argb")),
            ("a.mov", ("-c:v", "png", "-pix_fmt", "rgba")),
            ("a.mov", ("-c:v", "prores_ks", "-profile:v", "4444", "-pix_fmt", "yuva444p10le")),
            ("a.mkv", ("-c:v", "ffv1", "-pix_fmt", "bgra")),
            ("a.mkv", ("-c:v", "ffv1", "-pix_fmt", "yuva420p")),
            ("a.avi", ("-c:v", "utvideo", "-pix_fmt", "gbrap")),
        )
    },
    **{
        f"alpha of images: {depth}": Made(
            lambda folder, depth=depth, scale=scale: images(folder / "a", rgba(moving(3)).astype(depth) * scale),
            weighed(rgba(moving(3))),
            {"has_alpha": True},
            near=[0.51, 0.51, 0.51, 0],
        )
        for depth, scale in (("uint8", 1), ("uint16", 257))
    },
    "one image with alpha and 16 bits": Made(
        lambda folder: images(folder / "a", rgba(moving(1)).astype(np.uint16) * 257) / "0.png",
        weighed(rgba(moving(1))),
        {"has_alpha": True, "fps": 25.0, "num_declared": 1},
        near=[0.51, 0.51, 0.51, 0],
    ),
    "alpha of 254 everywhere": Made(
        lambda folder: write_video(folder / "a.mov", np.full_like(_LEVELS, 254), 10),
        np.full_like(_LEVELS, 254),
        {"has_alpha": True},
        near=[255, 255, 255, 0],
    ),
    "alpha of a GIF": Made(lambda folder: gif_with_holes(folder / "a.gif"), square_that_walks(), {"has_alpha": True}),
    **{
        f"alpha as written: {name}": Made(
            lambda folder, name=name: write_video(folder / name, premultiplied(_ALPHA), 10),
            premultiplied(_ALPHA),
            {"has_alpha": True},
            mean=mean,
        )
        for name, mean in (("a.webm", 1.5), ("a.mkv", 1e-9), ("a.mov", 0.8))
    },
    **{
        f"alpha of images as written: {kind}": Made(
            lambda folder, kind=kind: write_frames(folder / "out", premultiplied(_ALPHA), image_format=kind),
            premultiplied(_ALPHA),
            {"has_alpha": True},
            near=[1, 1, 1, 0],
        )
        for kind in ("png", "webp")
    },
    "alpha that is opaque everywhere": Made(
        lambda folder: exact_avi(folder / "a.avi", np.insert(noise(3), 3, 255, -1)), noise(3), {"has_alpha": False}
    ),
    "noise with alpha": Made(
        lambda folder: exact_avi(folder / "a.avi", noise(3, channels=4)),
        weighed(noise(3, channels=4)),
        {"has_alpha": True},
        near=[0.51, 0.51, 0.51, 0],
    ),
    # Counts. 2^30 is what ffmpeg declares of an AVI that it writes to a pipe.
    **{
        f"a count of {num}": Made(
            lambda folder, num=num: exact_avi(folder / "a.avi", noise(), num=num),
            noise(),
            {"num_declared": num if 8 < num < 2**30 else 8},
        )
        for num in (0, 3, 1000, 2**30 - 1, 2**30, 2**31 - 2, 2**32 - 1)
    },
    **{
        f"a duration of {seconds} s": Made(
            lambda folder, seconds=seconds: webm_of_duration(folder / "a.webm", seconds),
            None,
            {"num_frames": 8, "num_declared": declared, "fps": 10},
        )
        for seconds, declared in ((0.8, 8), (0.1, 8), (0.0, 8), (float("nan"), 8), (2.0, 20))
    },
    # As a stream has it that is written while it is sent: the element of the duration made void.
    "no count": Made(lambda folder: webm(folder / "a.webm", b"\x44\x89\x88", b"\xec\x40\x08"), None, COUNTED),
    **{
        f"no edit list: {name}": Made(
            lambda folder, name=name: put(folder / "a.mp4", mp4().replace(name, b"free", 1)), None, COUNTED
        )
        for name in (b"elst", b"edts")
    },
    **{  # Their duration is the sound's: of these 8 frames 50 were once missed.
        f"sound that lasts longer: {name}": Made(
            lambda folder, name=name, codec=codec, options=options: encoded(
                folder / name, waves(), "-f", "lavfi", "-i", "sine=d=2", "-c:v", codec, "-q:v", "2", *options, rate=25
            ),
            None,
            COUNTED | {"times": None},
        )
        for name, codec, options in (
            ("a.mkv", "ffv1", ()), ("a.webm", "libvpx-vp9", ()), ("a.ts", "mpeg2video", ()), ("a.ogv", "libtheora", ()),
            ("a.m2ts", "mpeg2video", ()), ("a.mpg", "mpeg2video", ()), ("a.wmv", "wmv2", ()),
            ("fragments.mp4", "libx264", ("-movflags", "frag_keyframe+empty_moov")),
        )
    },
    # An AVI has no times of its own, and B-frames are decoded before those that they follow.
    "B-frames of an AVI": Made(
        lambda folder: encoded(folder / "a.avi", waves(12), "-c:v", "libx264", "-crf", "5", "-bf", "2"),
        waves(12),
        {"num_declared": 12, "fps": 10, "times": None},
        mean=3,
    ),
    **{
        f"from a pipe: {kind}": Made(
            lambda folder, kind=kind, codec=codec, live=live: put(
                folder / f"clip.{kind}",
                ffmpeg("-c:v", codec, "-q:v", "1", *live, "-f", kind, "-", frames=waves(), rate=25),
            ),
            waves(),
            COUNTED | {"times": None},
            mean=10,
        )
        for kind, codec, live in (
            ("matroska", "ffv1", ()), ("webm", "libvpx-vp9", ("-live", "1")), ("mpegts", "mpeg2video", ()),
            ("flv", "flv", ()),
        )
    },
    # What is written.
    "WebP as written": Made(
        lambda folder: write_video(folder / "a.webp", waves(), 20),
        waves(),
        {"fps": 20, "has_alpha": False},
        mean=4,
    ),
    "GIF as written": Made(
        lambda folder: write_video(folder / "a.gif", moving(9), 20), moving(9), {"fps": pytest.approx(20)}, mean=4
    ),
    "one frame": Made(
        lambda folder: write_video(folder / "one.webm", moving(1), 25), moving(1), {"num_declared": 1}, mean=4
    ),
    "one image": Made(
        lambda folder: write_video(folder / "one", moving(1), 25), moving(1), {"num_declared": 1, "fps": 25.0}
    ),
    "frames as written": Made(
        lambda folder: write_video(folder / "out", iter(moving(12, 33, 35)), 25), moving(12, 33, 35), {}
    ),
    "frames as WebP": Made(
        lambda folder: write_video(folder / "out", moving(3, 33, 35), 25, image_format="webp"), moving(3, 33, 35), {}
    ),
    # Names say nothing.
    **{
        f"a picture called {name}: {kind}": Made(
            lambda folder, name=name, kind=kind: picture(folder / name, kind),
            waves(1),
            {"size": (48, 64), "fps": 10 if kind == "GIF" else 25},
            mean=4,
        )
        for name in ("clip.mp4", "clip")
        for kind in ("PNG", "JPEG", "GIF", "WEBP", "TIFF")
    },
    **{
        f"a sequence of JPEGs called {name}": Made(
            lambda folder, name=name: put(folder / name, b"".join(packets_of(waves(3), ".jpg"))), waves(3), {}, mean=4
        )
        for name in ("a.mjpeg", "a")
    },
    **{
        f"a JPEG and more called {name}": Made(
            lambda folder, name=name: put(folder / name, packets_of(waves(1), ".jpg")[0] + b"more"),
            waves(1),
            {},
            mean=4,
        )
        for name in ("a.mjpeg", "a")
    },
    "a photo with another in its file": Made(
        lambda folder: put(folder / "photo.jpg", b"".join(packets_of(waves(3), ".jpg"))), waves(1), {}, mean=4
    ),
    **{
        f"a video called {name}": Made(lambda folder, name=name: put(folder / name, mp4()), None, COUNTED)
        for name in ("a.png", "a.gif", "a.safetensors", "a.txt", "a")
    },
}  # fmt: skip
#: Others of the table are read by the same code; the long runs take these.
SLOW = {
    *(f"the last frame is held: {name}" for name in ("a.webp 0.1", "a.gif 1.0")),
    "frames too quick for an animation: a.gif",
    "a rate above 1000",
    "raw AV1",
    "pixels of 2/1 become square: a.mkv ffv1",
    "bands of color: a.mkv -c:v ffv1 -pix_fmt yuv444p",
    "alpha of videos: a.mov -c:v qtrle -pix_fmt argb",
    "alpha of videos: a.mkv -c:v ffv1 -pix_fmt yuva420p",
    "alpha of images as written: webp",
    "alpha of 254 everywhere",
    "alpha as written: a.mov",
    "a count of 3",
    "a duration of 2.0 s",
    "sound that lasts longer: a.mkv",
    "from a pipe: flv",
    "one image",
    "frames as WebP",
    "images .webp",
    "images .tif",
    "WebP as written",
    *(f"uneven times: clip.{kind}" for kind in ("nut", "mov")),
    "rounded time stamps: 23.976 a.mp4",
    "rounded time stamps: 60 a.webm",
    *(f"an animation with times of its own: a.{kind}" for kind in ("png", "webp")),
    "delays in hundredths: 20.000",
    "delays in hundredths: 30.000",
    *(f"written times: {case}" for case in ("a.mp4 h265", "a.mp4 av1", "a.mov None", "a.mkv None", "a.webp None")),
    *(f"times too near for the clock: a.{kind}" for kind in ("mp4", "webm")),
    *(f"the last frame is held: a.{kind} 0.1" for kind in ("webm", "mov", "mkv", "gif")),
    *(f"the last frame is held: a.{kind} 1.0" for kind in ("mp4", "mov", "webm")),
    "frames that an AVI repeats: mpeg4",
    "size (2, 2)",
    "size (35, 51)",
    "red a",
    "red a.webm",
    "black .jpg",
    *(f"images of {size}" for size in ((1, 1), (8, 8), (4096, 1))),
    *(f"images {kind}" for kind in (".png", ".jpeg", ".bmp")),
    "gray .png",
    "gray of limited range",
    "gray10le of full range",
    "ten bits of gray",
    *(f"pixels of {case}" for case in ("16/15 become square: a.mkv ffv1", "16/15 become square: a.mp4 libx264")),
    "pixels of 4/3 become square: a.ts mpeg2video",
    *(f"bands of color: a.mkv -c:v ffv1 -pix_fmt {kind}" for kind in ("yuv420p16le", "gbrp10le", "rgb48le")),
    "bands of color: a.mov -c:v prores_ks -pix_fmt yuv422p10le",
    "bands of color: a.mp4 -c:v libx264 -crf 1 -pix_fmt yuv420p10le",
    "bands of color: a.mp4 -c:v libx265 -crf 1 -pix_fmt yuv420p10le -x265-params log-level=none",
    "bands of color: a.webm -c:v libvpx-vp9 -crf 1 -pix_fmt yuv420p10le",
    "alpha of an animation: a.webp",
    "every level of alpha: a.mkv {}",
    "alpha of images: uint8",
    "every level of alpha: a.mov {'pixel_format': 'yuva444p10le'}",
    "alpha of videos: a.mov -c:v png -pix_fmt rgba",
    "alpha of videos: a.mov -c:v prores_ks -profile:v 4444 -pix_fmt yuva444p10le",
    *(f"alpha of videos: a.{kind}" for kind in ("mkv -c:v ffv1 -pix_fmt bgra", "avi -c:v utvideo -pix_fmt gbrap")),
    "alpha as written: a.webm",
    "alpha as written: a.mkv",
    "alpha of images as written: png",
    *(f"a count of {num}" for num in (0, 2**30 - 1, 2**31 - 2, 2**32 - 1)),
    "a duration of 0.8 s",
    "a duration of 0.1 s",
    "a duration of 0.0 s",
    "no edit list: b'edts'",
    *(f"sound that lasts longer: a.{kind}" for kind in ("webm", "ogv", "m2ts", "mpg", "wmv")),
    "from a pipe: mpegts",
    "from a pipe: matroska",
    "frames as written",
    *(f"a picture called clip.mp4: {kind}" for kind in ("JPEG", "TIFF", "WEBP")),
    *(f"a picture called clip: {kind}" for kind in ("PNG", "GIF", "WEBP")),
    "a sequence of JPEGs called a",
    "a JPEG and more called a",
    *(f"a video called a.{kind}" for kind in ("gif", "safetensors", "txt")),
}


def assert_read_as(clip, made):
    """The clip has the frames and the facts of the table."""
    if made.frames is not None:
        assert clip.frames.shape == made.frames.shape
        error = np.abs(clip.frames.astype(float) - made.frames)
        assert error.mean() < made.mean
        near = (0 if made.mean == math.inf else 255) if made.near is None else made.near
        assert (error <= near).all()
    for name, value in made.facts.items():
        found = getattr(clip, name)
        if name == "notes" and value:
            assert len(found) == len(value)
            assert all(text in note for text, note in zip(value, found, strict=True))
        else:
            assert found == value, name


@contextmanager
def one_line(error, *words):
    """What is in it raises an error of one line, with these words."""
    with pytest.raises(error) as caught:
        yield
    text = str(caught.value)
    assert "\n" not in text
    assert [word for word in words if word not in text] == [], text


def refused(path, *words):
    """Reading a path fails with one line."""
    with one_line(VideoError, "expected", *words):
        read_video(path)
