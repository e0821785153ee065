"""Videos as they come: each kind is read right, or refused in a line that says why.

Most are made here byte by byte: AVIs whose packets are PNGs or JPEGs, MP4s and WebMs whose boxes are changed. What only
an encoder makes is made with ffmpeg, and skipped where there is none.
"""

import contextlib
import gc
import itertools
import os
import struct
import zipfile
import zlib

import av
import cv2
import numpy as np
import pytest
from commands import write_tone
from made_clips import (
    CLIPS,
    SHOWN,
    SLOW,
    assert_read_as,
    avi,
    encode,
    exact_avi,
    ffmpeg,
    mp4,
    noise,
    png,
    put,
    refused,
    uneven_mp4,
    waves,
    webm,
    with_box,
)
from PIL import Image

from foldgauss.io import FrameIndex, VideoError, index_video, read_indexed, read_video
from foldgauss.io.media import clip as clip_module
from foldgauss.io.media import decoder


@pytest.mark.parametrize("name", [pytest.param(k, marks=pytest.mark.slow if k in SLOW else []) for k in CLIPS])
def test_a_clip_is_read_as_the_table_says_and_its_spans_are_those_of_the_whole(tmp_path, name):
    path = CLIPS[name].write(tmp_path)
    clip, index = read_video(path), index_video(path)
    assert_read_as(clip, CLIPS[name])
    assert clip.frames.flags.c_contiguous
    assert index.size == clip.size
    first, stop = clip.num_frames // 3, min(clip.num_frames, clip.num_frames // 3 + 4)
    part, span = read_video(path, frames=(first, stop)), read_indexed(index, first, stop)
    assert index.notes == clip.notes
    saved = FrameIndex.load(index.save(tmp_path / "index.npz"))
    for found, expected in ((index, clip), (saved, index), (span, part)):
        for fact in ("num_frames", "fps", "num_declared", "has_alpha", "duration"):
            assert getattr(found, fact) == getattr(expected, fact), fact
        np.testing.assert_array_equal(found.times, expected.times)
    np.testing.assert_array_equal(span.frames, part.frames)


# ------------------------------------------------------------------------------------------------ times


@pytest.mark.parametrize(
    ("options", "times", "fps"),
    [
        ({}, SHOWN, 7 / 1.6),
        ({"frames": (3, 6)}, [0, 0.1, 0.5], 4),
        ({"frames": (4, 8)}, None, 2.5),  # steady
        ({"fps": 12}, None, 12),
    ],
)
def test_uneven_times_are_told_and_no_frame_is_lost(tmp_path, options, times, fps):
    clip = read_video(put(tmp_path / "uneven.mp4", uneven_mp4()), **options)
    even = read_video(put(tmp_path / "even.mp4", mp4()), frames=options.get("frames"))
    np.testing.assert_array_equal(clip.frames, even.frames)
    assert (even.times, even.notes, even.fps) == (None, (), 10)
    assert clip.times == pytest.approx(times, abs=1e-3)
    assert clip.fps == pytest.approx(fps)
    if not options:
        (note,) = clip.notes
        assert "shown for 0.1 to 0.4 s" in note
        assert "4.375" in note


# ---------------------------------------------------------------------------------------- sizes and turns


def turned(*matrix):
    """The clip with another matrix of its track (tkhd)."""
    return with_box(mp4(), b"tkhd", lambda content: content[:40] + struct.pack(">9i", *matrix) + content[76:])


@pytest.mark.parametrize(("turns", "across"), [(1, 1), (2, 1), (3, 1), (0, -1), (1, -1), (2, -1), (3, -1)])
def test_videos_are_turned_upright(tmp_path, turns, across):
    """The matrix turns it clockwise, by quarters, and may mirror it; phones write that."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]
    matrix = (across * cos << 16, sin << 16, 0, across * -sin << 16, cos << 16, 0, 0, 0, 1 << 30)
    found = read_video(put(tmp_path / "turned.mp4", turned(*matrix))).frames
    stored = read_video(put(tmp_path / "a.mp4", mp4())).frames
    np.testing.assert_array_equal(found, np.rot90(stored, -turns, (1, 2))[:, :, ::across])


@pytest.mark.parametrize(("degrees", "beyond"), [(30, 30), (80, -10), (-30, -30)])
def test_other_rotations_are_told(tmp_path, degrees, beyond):
    cos, sin = (round(65536 * one(np.radians(degrees))) for one in (np.cos, np.sin))
    clip = read_video(put(tmp_path / "a.mp4", turned(cos, sin, 0, -sin, cos, 0, 0, 0, 1 << 30)))
    assert clip.size == ((48, 64) if abs(degrees) < 45 else (64, 48))
    assert clip.notes == (f"the file asks for a rotation by {beyond} degrees beyond multiples of 90; it is left out.",)


def test_decoded_frames_are_not_kept(tmp_path):
    """By cycles of references, which the garbage collector would find much later."""

    def count():
        # isinstance would follow a proxy whose object is gone.
        return sum(issubclass(type(one), av.VideoFrame) for one in gc.get_objects())

    (tmp_path / "a.mp4").write_bytes(mp4())
    with contextlib.closing(decoder.VideoDecoder(tmp_path / "a.mp4")) as video:
        before = count()
        assert len([video.to_array(frame) for _, frame in video.frames()]) > 5
        assert count() - before <= 2  # the first one's display matrix is read


def test_columns_at_the_left_are_cropped_to_the_pixel(tmp_path):
    """FFmpeg's decoders keep some of them by default, for the alignment of what is left."""
    whole, cropped = tmp_path / "whole.mp4", tmp_path / "cropped.mp4"
    ffmpeg("-c:v", "libx264", "-crf", "10", "-pix_fmt", "yuv420p", whole, frames=waves(5))
    cut = "h264_metadata=crop_left=8:crop_right=16:crop_top=4:crop_bottom=10"
    ffmpeg("-i", whole, "-c", "copy", "-bsf:v", cut, cropped)
    found, expected = read_video(cropped).frames, read_video(whole).frames[:, 4:-10, 8:-16]
    assert found.shape == expected.shape
    assert np.abs(found.astype(int) - expected)[:, 2:-2, 2:-2].max() <= 1  # chroma is interpolated across borders


def test_frames_of_another_size_are_stretched(tmp_path):
    """As calls are recorded, whose resolution follows the network."""
    for name, size in (("a.ts", (48, 64)), ("b.ts", (96, 128))):
        ffmpeg("-c:v", "mpeg2video", "-q:v", "1", tmp_path / name, frames=waves(6, *size), rate=25)
    (tmp_path / "c.ts").write_bytes(b"".join((tmp_path / name).read_bytes() for name in ("a.ts", "b.ts")))
    clip = read_video(tmp_path / "c.ts")
    assert clip.size == (48, 64)
    assert clip.num_frames in (11, 12)  # the last frame before may be lost in the decoder
    expected = [cv2.resize(frame, (64, 48), interpolation=cv2.INTER_AREA) for frame in waves(6, 96, 128)]
    assert np.abs(clip.frames[-6:].astype(int) - expected).mean() < 4
    assert clip.notes[-1].startswith("6 frames, the first of them ")
    assert clip.notes[-1].endswith("are of another size than the video, and stretched to it.")
    assert not any("another size" in note for note in read_video(tmp_path / "c.ts", frames=(0, 4)).notes)
    index = index_video(tmp_path / "c.ts")
    assert index.notes == clip.notes
    assert read_indexed(index, 0, 4).notes == read_video(tmp_path / "c.ts", frames=(0, 4)).notes


@pytest.fixture
def video(tmp_path):
    """An open decoder of frames of 48x64."""
    (tmp_path / "open.mp4").write_bytes(mp4())
    with contextlib.closing(decoder.VideoDecoder(tmp_path / "open.mp4")) as opened:
        yield opened


#: A kind of container each; the long runs take the rest.
QUICK = ("a.ts", "a.mp4", "a.mkv", "a.avi")
DAMAGED = {"a.ts": "mpeg2video", "b.ts": "libx264", "a.mp4": "libx264", "a.mkv": "libx264", "a.avi": "mpeg4"}
DAMAGED |= {"a.flv": "libx264", "a.mpg": "mpeg2video", "a.m2v": "mpeg2video", "b.flv": "flv"}
NAMES_OF_DAMAGED = [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in DAMAGED]


def _damaged(path, codec, first, last):
    """A clip whose bytes from one fraction to another are random, as if a copy had failed."""
    frames = np.clip(waves(50, 64, 96) + noise(50, 64, 96) // 8.0, 0, 255).astype(np.uint8)
    ffmpeg("-c:v", codec, "-pix_fmt", "yuv420p", "-g", "10", path, frames=frames, rate=25)
    data = path.read_bytes()
    low, high = int(first * len(data)), int(last * len(data))
    path.write_bytes(data[:low] + np.random.default_rng(0).bytes(high - low) + data[high:])


@pytest.mark.parametrize("name", NAMES_OF_DAMAGED)
def test_damage_in_the_middle_is_noted(tmp_path, name):
    _damaged(tmp_path / name, DAMAGED[name], 0.4, 0.42)
    clip = read_video(tmp_path / name)
    signs = ("damaged, and may show artifacts", "frames are shown for 0.04 to")
    told = [note for note in clip.notes if any(sign in note for sign in signs)]
    assert told
    assert not any(note in read_video(tmp_path / name, frames=(0, 3)).notes for note in told)
    index = index_video(tmp_path / name)
    assert (index.num_frames, index.notes) == (clip.num_frames, clip.notes)


@pytest.mark.parametrize("name", [case for case in NAMES_OF_DAMAGED if case.values != ("a.mp4",)])  # its index is there
def test_a_file_that_ends_in_random_bytes_is_noted(tmp_path, name):
    _damaged(tmp_path / name, DAMAGED[name], 0.7, 1.0)
    clip = read_video(tmp_path / name)
    assert clip.num_frames < 45
    ends = ("% of the file hold no frame that decodes.", "frames decode; those are used.", "may show artifacts.")
    assert any(note.endswith(ends) for note in clip.notes)
    early = read_video(tmp_path / name, frames=(0, 10)).notes
    assert [note for note in early if "no usable frame rate" not in note] == []


@pytest.mark.parametrize("name", ["a.ts", "a.mpg"])
def test_sound_that_is_longer_than_the_picture_is_no_damage(tmp_path, name):
    sound, context = ("mp2", np.zeros(5 * 48_000)), {"bit_rate": 100_000}
    encode(
        tmp_path / name,
        waves(10),
        "mpeg2video",
        "yuv420p",
        given="rgb24",
        context=context,
        rate=25,
        sound=sound,
    )
    clip = read_video(tmp_path / name)
    assert clip.num_frames == 10
    assert clip.notes == ()


def test_a_picture_that_ends_in_the_middle_of_its_sound_is_noted(tmp_path):
    """Packets of 188 bytes of a transport stream, whose later ones of the picture become padding."""
    sound, context = ("mp2", np.zeros(4 * 48_000)), {"bit_rate": 800_000}
    how = {"given": "rgb24", "context": context, "rate": 25, "sound": sound}
    path = encode(tmp_path / "a.ts", noise(100), "mpeg2video", "yuv420p", **how)
    packets = np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 188).copy()
    numbers = (packets[:, 1] & 31).astype(int) * 256 + packets[:, 2]
    picture = (numbers == np.bincount(numbers).argmax()) & (np.arange(len(packets)) > 0.45 * len(packets))
    packets[picture, 1:3] = 0x1F, 0xFF
    path.write_bytes(packets.tobytes())
    clip = read_video(path)
    assert clip.num_frames < 60
    assert any(note.endswith("of the file hold no frame that decodes.") for note in clip.notes)


def test_a_declared_size_that_cannot_be_converted_to_is_an_error(video):
    """Found by fuzzing a header: FFmpeg's conversion refuses to stretch so much."""
    video.stored_size = 63693, 2782
    with pytest.raises(VideoError, match=r"expected frames that FFmpeg converts to RGB, got .* 63693x2782\)"):
        video.to_array(av.VideoFrame(24, 16, "yuv420p"))


@pytest.mark.parametrize("pixel_format", ["gray16le", "rgb48le"])
def test_a_video_of_16_bits(tmp_path, pixel_format):
    values = waves().astype(np.uint16) * 257
    path = encode(tmp_path / "a.mkv", values if pixel_format == "rgb48le" else values[..., 0], "ffv1", pixel_format)
    np.testing.assert_array_equal(read_video(path).frames, waves())
    np.testing.assert_array_equal(read_indexed(index_video(path), 3, 6).frames, waves()[3:6])


@pytest.mark.parametrize("pixel_format", ["gray10le", "gray12le", "gbrp12le"])
def test_a_format_of_fewer_bits_is_scaled_by_them(tmp_path, pixel_format):
    bits = int(pixel_format[4:6])
    values = np.tile(np.arange(64, dtype=np.uint16) * (((1 << bits) - 1) // 63), (2, 48, 1))
    values = values if pixel_format.startswith("gray") else np.stack([values] * 3, -1)
    clip = read_video(encode(tmp_path / "a.mkv", values, "ffv1", pixel_format))
    assert clip.notes == ()
    assert np.abs(clip.frames[0, 0, :, 0] - np.linspace(0, 255, 64)).max() < 4


def _pq(light):
    power = (light / 10_000) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 4096 * 32 * power) / (1 + 2392 / 4096 * 32 * power)) ** (2523 / 4096 * 128)


def _primaries_to_xyz(*corners):
    """The matrix of linear red, green and blue, of white D65, to CIE XYZ; `corners`: x and y of the primaries."""
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in corners]).T
    return columns * np.linalg.solve(columns, [0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])


PRIMARIES = {
    9: _primaries_to_xyz((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: _primaries_to_xyz((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    1: _primaries_to_xyz((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),
}


def _as_sdr(light, primaries):
    """8-bit signals of BT.709 of light in cd/m2, in plain float64: BT.2390 and BT.1886."""
    light = light @ np.linalg.solve(PRIMARIES[1], PRIMARIES[primaries]).T
    highest = np.maximum(light.max(-1, keepdims=True), 1e-6)
    grid = 1000 * np.linspace(0, 1, 200_001) ** 4  # the curve is inverted by looking it up
    most = _pq(203) / _pq(1000)
    knee = 1.5 * most - 0.5
    t = (np.minimum(_pq(highest) / _pq(1000), 1) - knee) / (1 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    lowered = np.interp(np.where(t > 0, spline, knee + t * (1 - knee)) * _pq(1000), _pq(grid), grid)
    return 255 * np.clip(light * lowered / highest / 203, 0, 1) ** (1 / 2.4)


def _as_ycbcr(signal, bits, limited):
    """Codes of BT.2020's luma and color differences, each (height, width), and the signals that they stand for."""
    weights, scale = np.array([0.2627, 0.6780, 0.0593]), 1 << (bits - 8)
    black, white, span = (16 * scale, 219 * scale, 224 * scale) if limited else (0, 256 * scale - 1, 256 * scale - 1)
    luma = signal @ weights
    blue, red = (signal[..., 2] - luma) / 1.8814, (signal[..., 0] - luma) / 1.4746
    codes = [np.rint(luma * white + black), *(np.rint(one * span + 128 * scale) for one in (blue, red))]
    luma, blue, red = (codes[0] - black) / white, *((one - 128 * scale) / span for one in codes[1:])
    red, blue = luma + 1.4746 * red, luma + 1.8814 * blue
    green = (luma - weights[0] * red - weights[2] * blue) / weights[1]
    return [one.astype(np.uint16) for one in codes], np.clip(np.stack([red, green, blue], -1), 0, 1)


@pytest.mark.parametrize("transfer", ["PQ", "HLG"])
@pytest.mark.parametrize(
    ("kind", "primaries", "limited", "declared"),
    [
        ("gbrp16le", 9, False, True),
        ("gbrp16le", 12, False, True),
        ("gbrap16le", 9, False, True),
        ("yuv420p10le", 9, True, True),
        ("yuv420p10le", 9, True, False),  # BT.2020 is meant
        ("yuv420p10le", 9, False, True),
        ("yuv420p12le", 9, True, True),
        ("yuv444p10le", 9, True, True),
        ("gray10le", 9, True, True),
        *(
            pytest.param(f"gray{bits}le", 9, limited, True, marks=pytest.mark.slow)
            for bits, limited in ((10, False), (12, True), (12, False), (16, True), (16, False))
        ),
    ],
)
def test_hdr_is_tone_mapped(tmp_path, transfer, kind, primaries, limited, declared):
    """Patches of color, among them grays and saturated ones, as computed by the standards."""
    signal = np.random.default_rng(0).uniform(0, 0.9, (6, 8, 3))
    signal[0] = np.linspace(0, 1, 8)[:, None]
    signal[1, :3] = 0.7 * np.eye(3)
    signal = signal.repeat(8, 0).repeat(8, 1)
    if kind.startswith("gray"):
        signal[...] = signal[..., :1]
    if kind.startswith(("yuv", "gray")):
        planes, signal = _as_ycbcr(signal, int(kind.removesuffix("le")[-2:]), limited)
        side = 2 if "420" in kind else 1
        frame = av.VideoFrame(64, 48, kind)
        sampled = [planes[0], *(one[::side, ::side] for one in planes[1:])][: len(frame.planes)]
        for plane, codes in zip(frame.planes, sampled, strict=True):
            rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
            rows[:, : plane.width] = codes
            plane.update(rows.tobytes())
    else:
        pixels = np.rint(65535 * signal).astype(np.uint16)
        alpha = [np.full((48, 64, 1), 0x8080, np.uint16)] if kind == "gbrap16le" else []
        pixels = np.concatenate([pixels, *alpha], -1)
        frame = av.VideoFrame.from_ndarray(pixels, format="rgba64le" if alpha else "rgb48le")
    with av.open(tmp_path / "a.mkv", "w") as out:
        stream = out.add_stream("ffv1", rate=10, width=64, height=48, pix_fmt=kind)
        context = stream.codec_context
        context.color_trc, context.color_range = 16 if transfer == "PQ" else 18, 1 if limited else 2
        if declared:
            context.color_primaries, context.colorspace = primaries, 9 if kind.startswith("yuv") else 0
        out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    clip = read_video(tmp_path / "a.mkv")
    frames = clip.frames.astype(float)
    assert f"HDR ({transfer}), and are tone-mapped" in clip.notes[0]
    if transfer == "PQ":
        grid = 10_000 * np.linspace(0, 1, 200_001) ** 4
        light = np.interp(signal, _pq(grid), grid)
    else:
        scene = np.where(signal < 0.5, signal**2 / 3, (np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12)
        light = 1000 * scene * (scene @ [0.2627, 0.6780, 0.0593])[..., None] ** 0.2
    expected = _as_sdr(light, primaries)
    if kind == "gbrap16le":
        assert (frames[..., 3] == 128).all()
        expected *= 128 / 255
    assert frames.shape[:3] == (1, 48, 64)
    inside = np.ix_(range(4, 48, 8), range(4, 64, 8))  # of the patches: color differences are interpolated
    error = np.abs(frames[0, ..., :3] - expected)[inside]
    assert error.max() < (
        0.6 if kind != "gbrap16le" else 1.1
    )  # half a level is rounding; premultiplied, of two roundings


# --------------------------------------------------------------------------------------- gray, alpha, depth


@pytest.mark.parametrize("kind", ["bgra", "yuva444p", "yuva444p10le", "rgba64le"])
def test_alpha_of_hdr_is_kept(video, kind):
    """Of 8 bits, too, which tone mapping leaves out."""
    frame = av.VideoFrame.from_ndarray(np.full((48, 64, 4), 200, np.uint8), format="bgra").reformat(format=kind)
    frame.color_trc = 16  # PQ
    alpha = video.to_array(frame)[..., 3]
    assert np.abs(alpha.astype(int) - 200).max() <= 1


@pytest.mark.parametrize("kind", ["rgba64le", "gbrap10le", "gbrap12le", "gbrap16le", "ya16le"])
def test_deep_alpha_is_rounded_to_nearest(video, kind):
    """Alpha of 10 to 16 bits, the levels between those of 8 bits included."""
    bits = 10 if "10" in kind else 12 if "12" in kind else 16
    alpha = np.linspace(0, (1 << bits) - 1, 2048).round().astype(np.uint16)
    channels = {"rgba64le": 4, "ya16le": 2}.get(kind, 1)
    frame = av.VideoFrame(2048, 2, kind)
    for plane in frame.planes:  # the last one, or all channels of packed formats: alpha is their last
        rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
        rows[:, channels - 1 : channels * 2048 : channels] = alpha
        plane.update(rows)
    video.stored_size = 2, 2048
    found = video.to_array(frame)[0, :, 3]
    np.testing.assert_array_equal(found, np.floor(alpha / ((1 << bits) - 1) * 255 + 0.5))


# --------------------------------------------------------------------------------------------- interlaced


@pytest.mark.parametrize("codec", ["mpeg2video", "libx264"])
def test_interlaced_is_converted(tmp_path, codec):
    frames = waves(8, 64, 96)
    quality = ("-q:v", "1") if codec == "mpeg2video" else ("-crf", "5")
    ffmpeg("-c:v", codec, *quality, "-flags", "+ilme+ildct", tmp_path / "a.mkv", frames=frames, rate=25)
    for chosen in (None, (2, 3)):
        clip = read_video(tmp_path / "a.mkv", frames=chosen)
        assert clip.notes == ("interlaced frames are converted to progressive ones.",)
        expected = frames[slice(*chosen) if chosen else ...]
        assert clip.frames.shape == expected.shape
        assert (clip.fps, clip.times) == (25, None)
        assert np.abs(clip.frames - expected.astype(int)).mean() < 8


def test_frames_too_small_to_deinterlace_are_refused(tmp_path):
    options = ("-vf", "setfield=tff", "-c:v", "ffv1", "-flags", "+ildct")
    ffmpeg(*options, tmp_path / "a.mkv", frames=noise(2, 4, 2), rate=25)
    refused(tmp_path / "a.mkv", "bwdif", "4x2 (height x width)", "a.mkv")


def test_fields_of_different_times_are_separated(tmp_path):
    """A bar that moves between the fields is torn into a comb; converted, its rows agree."""
    rows = np.arange(64)
    frames = np.zeros((10, 64, 96, 3), np.uint8)
    for k in range(10):
        for field in range(2):
            frames[k, rows % 2 == field, 8 * k + 4 * field : 8 * k + 4 * field + 8] = 255
    options = ("-c:v", "mpeg2video", "-q:v", "1", "-flags", "+ilme+ildct", "-top", "1")
    ffmpeg(*options, tmp_path / "a.mkv", frames=frames, rate=25)
    clip = read_video(tmp_path / "a.mkv")
    teeth = lambda images: np.abs(np.diff(images[2:8, 8:56].astype(int), axis=1)).mean()  # noqa: E731
    assert clip.num_frames == 10
    assert teeth(clip.frames) < 0.3 * teeth(frames)


# ------------------------------------------------------------------------------------- counts and damage


def _cut_by_edits(mp4, first):
    """An MP4 of which cutting without encoding left its first frames in place, unseen."""
    at, clock = mp4.index(b"elst") + 4, mp4.index(b"mdhd") + 16
    (ticks,) = struct.unpack_from(">I", mp4, clock)  # of a second
    assert mp4[at] == 0
    (shown,) = struct.unpack_from(">I", mp4, at + 8)
    return mp4[: at + 8] + struct.pack(">II", shown * (8 - first) // 8, ticks * first // 10) + mp4[at + 16 :]


def test_frames_that_an_edit_list_hides_are_not_missed(tmp_path):
    (tmp_path / "a.mp4").write_bytes(mp4())
    (tmp_path / "cut.mp4").write_bytes(_cut_by_edits(mp4(), 3))
    whole, clip = read_video(tmp_path / "a.mp4"), read_video(tmp_path / "cut.mp4")
    assert (whole.num_declared, clip.num_declared, clip.fps, clip.times) == (8, 5, 10, None)
    np.testing.assert_array_equal(clip.frames, whole.frames[3:])
    clamped = read_video(tmp_path / "cut.mp4", frames=(0, 6))
    assert clamped.num_frames == clamped.num_declared == 5
    assert clamped.notes == ("frames 0:6 were asked for, and the clip ends at 5: 0:5 are used.",)
    with pytest.raises(VideoError, match="within 0:5"):
        read_video(tmp_path / "cut.mp4", frames=(5, 6))


def test_a_matroska_with_sound_that_breaks_off(tmp_path):
    ffmpeg("-f", "lavfi", "-i", "sine=d=0.8", "-c:v", "ffv1", tmp_path / "a.mkv", frames=noise())
    data = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "b.mkv").write_bytes(data[: len(data) // 2])
    whole, half = read_video(tmp_path / "a.mkv"), read_video(tmp_path / "b.mkv")
    assert (whole.num_frames, whole.num_declared) == (8, 8)
    assert 2 <= half.num_frames < half.num_declared == 8


def test_an_unknown_matrix_is_named(tmp_path):
    """That of its frames in the H.264 stream, YCgCo."""
    options = {"x264-params": "colormatrix=YCgCo"}
    encode(tmp_path / "a.mkv", waves(), "libx264", "yuv444p", given="rgb24", options=options)
    refused(tmp_path / "a.mkv", "frames that FFmpeg converts to RGB", "matrix 8 of", "zscale=matrix=709")


@pytest.mark.parametrize("kept", [1, 4, 7])
def test_a_tail_cut_off(tmp_path, kept):
    packets = [png(frame) for frame in noise()]
    data = avi(packets, 48, 64)
    end = data.index(packets[kept])
    (tmp_path / "a.avi").write_bytes(data[: end + len(packets[kept]) // 3])
    clip = read_video(tmp_path / "a.avi")
    assert clip.num_declared == 8
    np.testing.assert_array_equal(clip.frames[:kept], noise()[:kept])
    assert clip.num_frames <= kept + 1
    lost = (f"only {clip.num_frames} of 8 frames decode; those are used.",)
    assert clip.notes == (() if clip.num_frames == 8 else lost)


@pytest.mark.parametrize(
    "broken", [(0, 3), *(pytest.param(both, marks=pytest.mark.slow) for both in ((0, 1), (3, 4)))], ids=str
)
def test_broken_frames_are_left_out(tmp_path, broken):
    packets = [bytes(100) if k in broken else png(frame) for k, frame in enumerate(noise())]
    (tmp_path / "a.avi").write_bytes(avi(packets, 48, 64))
    clip = read_video(tmp_path / "a.avi")
    # FFmpeg's parser of PNGs passes by the frame after a broken one as well.
    sound = [k for k in range(8) if k not in broken and k - 1 not in broken]
    np.testing.assert_array_equal(clip.frames, noise()[sound])
    assert clip.num_declared == 8
    assert clip.notes[0] == f"only {len(sound)} of 8 frames decode; those are used."
    assert any("damaged, and may show artifacts" in note for note in clip.notes)
    shown = np.array(sound) / 10
    if np.ptp(np.diff(sound)):  # there is a gap in the middle
        np.testing.assert_allclose(clip.times, shown - shown[0], atol=1e-3)
    index = index_video(tmp_path / "a.avi")
    for span in itertools.combinations(range(len(sound) + 1), 2):  # of those that decode
        np.testing.assert_array_equal(read_video(tmp_path / "a.avi", frames=span).frames, clip.frames[slice(*span)])
        np.testing.assert_array_equal(read_indexed(index, *span).frames, clip.frames[slice(*span)])
    late = read_video(tmp_path / "a.avi", frames=(len(sound) - 1, len(sound)))
    assert late.notes == ()
    np.testing.assert_array_equal(late.frames, noise()[7:])


@pytest.mark.parametrize("name", ["a.gif", "a.png", "a.webp"])
def test_a_broken_animation(tmp_path, name):
    first, *rest = (Image.fromarray(frame) for frame in noise())
    first.save(tmp_path / name, save_all=True, append_images=rest, duration=100)
    data, whole = (tmp_path / name).read_bytes(), read_video(tmp_path / name)
    assert whole.num_frames == 8
    for eighth in range(8):
        (tmp_path / name).write_bytes(data[: len(data) * eighth // 8])
        try:
            clip = read_video(tmp_path / name)
        except VideoError:
            continue
        assert clip.num_frames < clip.num_declared <= 8
        assert clip.notes[0].startswith(f"only {clip.num_frames} of {clip.num_declared} frames decode")
        np.testing.assert_array_equal(clip.frames, whole.frames[: clip.num_frames])


def test_pages_of_a_tiff_are_refused_whatever_it_is_called(tmp_path):
    first, *rest = (Image.fromarray(frame) for frame in waves(3))
    first.save(tmp_path / "clip.mp4", "TIFF", save_all=True, append_images=rest)
    refused(tmp_path / "clip.mp4", "one image in a TIFF, got 3")


# ------------------------------------------------------------------------------------------- other things


def _zip(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "text")


OTHERS = {
    "nothing": (lambda path: path.write_bytes(b""), "an empty file"),
    "zeros": (lambda path: path.write_bytes(bytes(5000)), "5000 bytes"),
    "text": (lambda path: path.write_text("Dear diary,\n" * 40), "a text"),
    "audio": (lambda path: write_tone(path, 0.1), "audio"),
    "zip": (_zip, "a zip archive"),
    "model": (lambda path: path.write_bytes(struct.pack("<Q", 2) + b"{}"), "a model, which foldgauss render turns"),
    "compact": (
        lambda path: path.write_bytes(b"\x8bFGZ\r\n\x1a\n" + bytes(99)),
        "a model, which foldgauss render turns",
    ),
    "list": (lambda path: path.write_text("#EXTM3U\nother.ts\n"), "a list of other files"),
}


@pytest.mark.parametrize("make", OTHERS.values(), ids=OTHERS)
@pytest.mark.parametrize("name", ["clip.mp4", "clip.avi", "clip"])
def test_what_is_no_video_is_named(tmp_path, make, name):
    make[0](tmp_path / name)
    refused(tmp_path / name, make[1], name)


@pytest.mark.parametrize("length", [8, 40, 300])
def test_a_head_alone(tmp_path, length):
    for name, data in (
        ("a.mp4", mp4()),
        ("a.webm", webm(tmp_path / "b.webm").read_bytes()),
        ("a.avi", avi([png(noise(1)[0])], 48, 64)),
    ):
        (tmp_path / name).write_bytes(data[:length])
        refused(tmp_path / name, name)


def test_sound_with_a_cover_is_no_video(tmp_path):
    cover = tmp_path / "cover.png"
    cover.write_bytes(png(noise(1)[0]))
    given = ("-f", "lavfi", "-i", "sine=d=0.2", "-i", cover, "-map", "0", "-map", "1")
    ffmpeg(*given, "-c:a", "aac", "-c:v", "copy", "-disposition:v", "attached_pic", tmp_path / "a.m4a")
    refused(tmp_path / "a.m4a", "cover")
    ffmpeg("-f", "lavfi", "-i", "sine=d=0.2", "-c:a", "aac", tmp_path / "b.mp4")
    refused(tmp_path / "b.mp4", "audio")


def test_a_folder_called_as_a_video(tmp_path):
    folder = tmp_path / "clip.mp4"
    folder.mkdir()
    refused(folder, "png", "without any")
    (folder / "0.png").write_bytes(png(noise(1)[0]))
    assert read_video(folder).num_frames == 1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.timeout(120)
def test_pipes_and_devices_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "clip.mp4")
    refused(tmp_path / "clip.mp4", "a pipe or a device")
    if os.path.exists("/dev/zero"):
        refused("/dev/zero", "a pipe or a device")


NAMES = ["with spaces.mp4", "Größe 日本.mp4", "clip%03d.mp4", "-lead.mp4", "a" * 250 + ".mp4", "x:y.mp4"]


@pytest.mark.parametrize("name", NAMES, ids=lambda name: name[:20])
def test_names_are_taken_as_they_are(tmp_path, monkeypatch, name):
    """A pattern names one file, not a sequence; what looks like an option or a protocol is a name."""
    for number in range(3):
        (tmp_path / f"img{number:03d}.png").write_bytes(png(noise(3)[number]))
    (tmp_path / name).write_bytes(mp4())
    (tmp_path / "img%03d.png").write_bytes(png(noise(1)[0, :20]))
    assert read_video(tmp_path / "img%03d.png").frames.shape == (1, 20, 64, 3)
    assert read_video(tmp_path / name).num_frames == 8
    monkeypatch.chdir(tmp_path)
    assert read_video(name).num_frames == 8


@pytest.mark.skipif(os.name != "posix", reason="only POSIX has names that are no Unicode")
@pytest.mark.parametrize("made", ["video", "image", "folder"])
def test_names_that_are_no_unicode_are_read(tmp_path, made):
    name = os.fsdecode(os.fsencode(tmp_path) + b"/\xff")
    try:
        if made == "folder":
            os.mkdir(name)
        path = f"{name}/0.png" if made == "folder" else name
        with open(path, "wb") as file:
            file.write(mp4() if made == "video" else png(noise(1)[0]))
    except OSError as error:
        pytest.skip(f"this file system has no such names: {error}")
    assert read_video(name).num_frames == (8 if made == "video" else 1)


def test_a_pattern_is_no_file(tmp_path):
    for number in range(3):
        (tmp_path / f"img{number:03d}.png").write_bytes(png(noise(3)[number]))
    for name, told in {"img%03d.png": "missing", "*.png": "missing", "a" * 5000: "File name too long"}.items():
        with pytest.raises(FileNotFoundError, match=told):
            read_video(tmp_path / name)


@pytest.mark.parametrize(
    "address", ["http://127.0.0.1:9/a.mp4", "rtsp://127.0.0.1/a", "file:///a.mp4", "concat:/a.mp4"]
)
def test_addresses_are_not_fetched(address):
    with pytest.raises(FileNotFoundError, match=r"address.*Download it first"):
        read_video(address)


LISTS = {
    "ffconcat": "ffconcat version 1.0\nfile clip.avi\n",
    "m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:1,\nclip.ts\n#EXT-X-ENDLIST\n",
    "sdp": "v=0\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
    "mpd": '<?xml version="1.0"?><MPD profiles="urn:mpeg:dash:profile:isoff-live:2011"></MPD>',
    "asx": "<ASX><entry><ref href='clip.avi'/></entry></ASX>",
    "url": "http://127.0.0.1:9/clip.mp4\n",
}


@pytest.mark.parametrize("hidden", [False, True], ids=["by its first bytes", "by the decoder"])
@pytest.mark.parametrize("kind", LISTS)
@pytest.mark.parametrize("name", ["list.{}", "list.mp4"])
def test_lists_let_nothing_in(tmp_path, monkeypatch, kind, name, hidden):
    """Two doors: what such a file begins with; and the formats that FFmpeg may open, should the first fail."""
    path = tmp_path / name.format(kind)
    path.write_text(LISTS[kind])
    exact_avi(tmp_path / "clip.avi", noise())
    if hidden:
        monkeypatch.setattr(decoder, "describe_kind", lambda head: None)
    refused(path, "does not open as a video" if hidden else "are not opened")


# -------------------------------------------------------------------------------------------- huge claims


def _png_of(height, width):
    data = png(noise(1)[0])
    head = data[12:16] + struct.pack(">II", width, height) + data[24:29]
    return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]


def _jpeg_of(height, width, progressive=0):
    data = cv2.imencode(".jpg", noise(1)[0], [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    at = data.index(b"\xff\xc2" if progressive else b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


def _late_jpeg_of(height, width):
    """The size follows 130,000 bytes of application data."""
    data = _jpeg_of(height, width)
    return data[:2] + 2 * (b"\xff\xe1" + struct.pack(">H", 65_000) + bytes(64_998)) + data[2:]


def _tif_of(height, width):
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, 8)]
    entries = b"".join(struct.pack("<HHII", *tag) for tag in [*tags, (277, 3, 1, 1), (279, 4, 1, 16)])
    return b"II*\0" + struct.pack("<I", 24) + bytes(16) + struct.pack("<H", 8) + entries + bytes(4)


def _gif_of(height, width):
    return b"GIF89a" + struct.pack("<HH", width, height) + bytes(100)


def _webp_of(height, width):
    sides = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF" + struct.pack("<I", 100) + b"WEBPVP8X" + struct.pack("<II", 10, 0) + sides + bytes(80)


def _bmp_of(height, width):
    data = cv2.imencode(".bmp", noise(1)[0])[1].tobytes()
    return data[:18] + struct.pack("<ii", width, -height) + data[26:]


@pytest.mark.parametrize("made", [_png_of, _jpeg_of, _late_jpeg_of, _tif_of, _gif_of, _webp_of, _bmp_of])
@pytest.mark.parametrize("in_folder", [False, True])
def test_huge_images_are_refused_by_their_header(tmp_path, monkeypatch, made, in_folder):
    monkeypatch.setattr(cv2, "imdecode", None)  # as memory is taken there
    suffix = made.__name__[1:-3].removeprefix("late_")
    path = tmp_path / f"0.{suffix}"
    path.write_bytes(made(60_000, 65_000))
    words = "images that decode" if suffix == "gif" else "at most 178,956,970 pixels"
    refused(tmp_path if in_folder and suffix != "gif" else path, words, path.name)  # a folder's images are no GIFs


@pytest.mark.parametrize("made", [_png_of, _jpeg_of, lambda *size: _jpeg_of(*size, progressive=1)])
def test_images_with_more_pixels_than_their_bytes_can_hold(tmp_path, monkeypatch, made):
    monkeypatch.setattr(cv2, "imdecode", None)
    (tmp_path / "0.img").write_bytes(made(13_000, 13_000))
    refused(tmp_path / "0.img", "decode")


def test_huge_videos_are_refused_before_a_frame_is_decoded(tmp_path, monkeypatch):
    (tmp_path / "a.mp4").write_bytes(mp4())
    monkeypatch.setattr(clip_module, "MAX_PIXELS", 48 * 64 - 1)
    monkeypatch.setattr(decoder.VideoDecoder, "frames", None)
    refused(tmp_path / "a.mp4", "at most 3,071 pixels", "48x64", "a.mp4")
