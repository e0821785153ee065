"""Clips in and out: what is read is what the file holds, and bad input says so in one line."""

import os
import struct
import subprocess
import sys
import zlib

import av
import cv2
import numpy as np
import pytest
from made_clips import UNEVEN, encode, images, moving, mux_sound, one_line, rgba
from PIL import Image

from foldgauss.io import (
    Sound,
    VideoError,
    read_video,
    write_image,
    write_video,
)
from foldgauss.io._atomic import OutputError
from foldgauss.io.datasets import sample_clip
from foldgauss.io.media import reading


def _psnr(a, b):
    return 10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2))


@pytest.fixture(scope="module")
def clip_file(tmp_path_factory):
    """8 frames of 48x64 at 12 fps; WebM, whose head can be read without its tail."""
    return write_video(tmp_path_factory.mktemp("clip") / "clip.webm", moving(), 12.0)


@pytest.fixture
def folder(tmp_path):
    """Five frames, one gray level each, named so that only natural order is the right one."""
    place = tmp_path / "frames"
    place.mkdir()
    for number in (1, 2, 9, 10, 11):
        write_image(place / f"img{number}.png", np.full((20, 30, 3), 10 * number, np.uint8))
    return place


def test_center_crop_cuts_first_and_resizes_then(clip_file):
    whole = read_video(clip_file).frames
    np.testing.assert_array_equal(read_video(clip_file, center_crop=(21, 32)).frames, whole[:, 13:34, 16:48])
    both = read_video(clip_file, center_crop=(40, 40), size=(20, 20)).frames
    middle = whole[:, 4:44, 12:52].reshape(8, 20, 2, 20, 2, 3).mean((2, 4))  # by area
    np.testing.assert_allclose(both, middle, atol=1)
    with one_line(VideoError, "center_crop: expected at most the frame's 48x64", "49x20"):
        read_video(clip_file, center_crop=(49, 20))
    with pytest.raises(VideoError, match="center_crop: expected height and width of whole pixels"):
        read_video(clip_file, center_crop=(0, 20))


# ------------------------------------------------------------------------------------- reading a video


@pytest.mark.parametrize(
    ("frames", "first", "count"),
    [(None, 0, 8), ((2, None), 2, 6), ((None, 3), 0, 3), ((3, 7), 3, 4), ((6, 8), 6, 2)],
)
def test_frame_range_is_half_open(clip_file, frames, first, count):
    whole = read_video(clip_file).frames
    clip = read_video(clip_file, frames=frames)
    assert clip.num_frames == clip.num_declared == count
    np.testing.assert_array_equal(clip.frames, whole[first : first + count])


@pytest.mark.parametrize(
    ("have", "want", "window"),
    [
        ((720, 1280), (160, 320), (40, 680, 0, 1280)),
        ((720, 1280), (360, 640), (0, 720, 0, 1280)),
        ((720, 1280), (100, 100), (0, 720, 280, 1000)),
        ((144, 176), (160, 320), (28, 116, 0, 176)),
        ((1, 5000), (5000, 16), (0, 1, 2499, 2500)),
    ],
)
def test_aspect_window(have, want, window):
    rows, columns = reading.aspect_window(have, want)
    assert (rows.start, rows.stop, columns.start, columns.stop) == window


def test_a_size_that_crops_much_is_reported(clip_file):
    """The clip is of 48x64, or another 3:4."""
    height, width = read_video(clip_file).size
    assert read_video(clip_file, size=(height // 2, width // 2)).notes == ()
    (note,) = read_video(clip_file, size=(width // 2, height // 4)).notes
    assert note.endswith("keeps all of them.")
    whole = tuple(int(side) for side in note.split()[-5].split("x"))
    assert read_video(clip_file, size=whole).notes == ()
    assert abs(whole[0] / whole[1] - height / width) < 0.05


def test_enlarging_is_cubic_and_centered(clip_file):
    whole = read_video(clip_file).frames[0]
    large = read_video(clip_file, size=(96, 128)).frames[0]
    np.testing.assert_array_equal(large, cv2.resize(whole, (128, 96), interpolation=cv2.INTER_CUBIC))


@pytest.mark.parametrize(
    "times",
    [UNEVEN[1:], UNEVEN[:-2], [*UNEVEN, 2.0], UNEVEN[::-1], [[0.0]], [], [0, np.nan], [0, 1e9], "abc", [0, [1]], 3],
    ids=str,
)
@pytest.mark.parametrize("name", ["a.mp4", "a.webp", "folder"])
def test_times_that_do_not_fit_are_refused(tmp_path, times, name):
    with pytest.raises(VideoError, match=r"times: expected seconds that rise from 0|frames: expected \d+, as many"):
        write_video(tmp_path / name, moving(), 10, times=times)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_damaged_video_tells_what_was_promised(tmp_path):
    data = bytearray(sample_clip("bunny").read_bytes())
    data[200_000:260_000] = np.random.default_rng(0).bytes(60_000)
    path = tmp_path / "damaged.mp4"
    path.write_bytes(data)
    clip = read_video(path, size=(16, 32))
    assert 2 <= clip.num_frames < clip.num_declared == 132
    with one_line(VideoError, "126:128", "125 of 132 frames decode"):
        read_video(path, size=(16, 32), frames=(126, 128))
    assert clip.notes[0] == "only 125 of 132 frames decode; those are used."
    assert any("damaged, and may show artifacts" in note for note in clip.notes)
    late = read_video(path, size=(16, 32), frames=(113, 123))  # of those that decode
    assert late.num_frames == late.num_declared == 10
    np.testing.assert_array_equal(late.frames, clip.frames[113:123])


# ----------------------------------------------------------------------------------- reading a folder


def test_folder_is_sorted_naturally(folder):
    (folder / "notes.txt").write_text("not an image")
    (folder / ".hidden.png").write_text("not shown")
    clip = read_video(folder)
    assert clip.frames[:, 0, 0, 0].tolist() == [10, 20, 90, 100, 110]
    assert (clip.fps, clip.num_declared, clip.frames.flags.c_contiguous) == (25.0, 5, True)
    assert read_video(folder, frames=(1, 3)).frames[:, 0, 0, 0].tolist() == [20, 90]


def test_gray_and_16_bit_images(tmp_path):
    levels = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    cv2.imwrite(str(tmp_path / "0.png"), levels)
    cv2.imwrite(str(tmp_path / "1.png"), np.repeat(levels[..., None], 3, 2))
    frames = read_video(tmp_path).frames
    expected = np.rint(levels / 257).astype(np.uint8)[..., None]
    np.testing.assert_array_equal(frames[0], np.repeat(expected, 3, 2))
    np.testing.assert_array_equal(frames[1], frames[0])


@pytest.mark.parametrize(
    ("name", "options", "quality"),
    [
        ("a.mp4", {"codec": "h265"}, 34),
        ("a.mp4", {"codec": "av1"}, 34),
        ("a.mp4", {"codec": "vp9", "pixel_format": "yuv444p"}, 38),
        ("a.mp4", {"pixel_format": "yuv420p10le", "crf": 5}, 40),
        ("a.mkv", {}, np.inf),
        ("a.mkv", {"pixel_format": "yuv444p"}, 48),
        ("a.mov", {}, 40),
        ("a.mov", {"codec": "prores", "pixel_format": "yuv444p10le"}, 45),
    ],
)
def test_codecs_and_pixel_formats(tmp_path, name, options, quality):
    frames = moving(5, 64, 96)
    path = write_video(tmp_path / name, frames, 29.97, **options)
    with av.open(str(path)) as container:
        first = next(container.decode(video=0))
        tags = first.colorspace, first.color_primaries, first.color_trc  # 1: BT.709
        assert first.format.is_rgb or tags == (1, 1, 1)
    clip = read_video(path)
    assert (clip.num_frames, clip.times, clip.notes) == (5, None, ())
    assert clip.fps == pytest.approx(29.97, rel=1e-3)
    with np.errstate(divide="ignore"):
        assert _psnr(clip.frames, frames) >= quality


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads are read from /proc")
def test_encoders_keep_the_priority_of_the_process(tmp_path):
    """SVT-AV1 makes the threads of root real-time threads; they are looked at while it encodes, and after."""

    def policies():
        return {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}

    def frames():
        for frame in moving(4, 64, 96):
            yield frame
            seen.extend(policies())

    seen, before = [], policies()
    write_video(tmp_path / "a.mp4", frames(), 25, codec="av1")
    assert {*seen, *policies()} == before


def test_a_smaller_crf_is_better_and_larger(tmp_path):
    paths = [write_video(tmp_path / f"{crf}.mp4", moving(), 10, crf=crf) for crf in (0, 16, 40)]
    sizes, errors = (
        [path.stat().st_size for path in paths],
        [_psnr(read_video(path).frames, moving()) for path in paths],
    )
    assert sizes[0] > sizes[1] > sizes[2]
    assert errors[0] > errors[1] > errors[2]


def _samples(path):
    with av.open(str(path)) as container:
        resampler = av.AudioResampler(format="flt", layout="mono", rate=48_000)
        parts = [part.to_ndarray() for frame in container.decode(audio=0) for part in resampler.resample(frame)]
    return np.concatenate(parts, 1)[0]


def _tones(path, at):
    """Seconds of sound, and the frequency in Hz at each of the given seconds."""
    samples = _samples(path)
    chosen = [samples[int(48_000 * second) :][:9600] for second in at]
    return len(samples) / 48_000, [5 * int(np.abs(np.fft.rfft(part * np.hanning(9600))).argmax()) for part in chosen]


@pytest.fixture(scope="module")
def sound_file(tmp_path_factory):
    """Half a second of 440 Hz, then 1.5 s of 880 Hz."""
    seconds = np.arange(96_000) / 48_000
    samples = 0.3 * np.sin(2 * np.pi * seconds * np.where(seconds < 0.5, 440, 880))
    return write_sound(tmp_path_factory.mktemp("sound") / "sound.m4a", "aac", samples)


def write_sound(path, codec, samples, layout="mono", **options):
    """A file of sound alone."""
    with av.open(str(path), "w", **options) as container:
        mux_sound(container, container.add_stream(codec, rate=48_000, layout=layout), samples)
    return path


@pytest.mark.parametrize(
    ("name", "start", "speed", "seconds", "tones"),
    [
        ("a.webm", 0.3, 1.0, 1.0, {0.0: 440, 0.4: 880}),
        ("a.mp4", 0.5, 4.0, 0.4, {0.1: 880}),
        pytest.param("a.mp4", 0.0, 1.0, 1.0, {0.2: 440, 0.7: 880}, marks=pytest.mark.slow),
        pytest.param("a.mov", 0.0, 0.6, 1.0, {0.1: 440, 0.5: 440}, marks=pytest.mark.slow),
        pytest.param("a.mkv", 0.0, 0.2, 1.0, {0.1: 440, 0.7: 440}, marks=pytest.mark.slow),
    ],
)
def test_sound_is_added_and_stretched_at_its_pitch(tmp_path, sound_file, name, start, speed, seconds, tones):
    path = write_video(tmp_path / name, moving(10), 10, sound=Sound(sound_file, start, speed))
    found, heard = _tones(path, tones)
    assert found == pytest.approx(seconds, abs=0.08)
    assert heard == pytest.approx(list(tones.values()), abs=10)
    assert read_video(path).num_frames == read_video(path).num_declared == 10


@pytest.mark.parametrize(("video_from", "sound_from"), [(0.0, 0.5), (0.5, 0.0)])
def test_sound_stays_with_the_frames_where_one_of_them_begins_later(tmp_path, video_from, sound_from):
    """A tone of 880 Hz from 1 s on, in a file whose first frame, or first sound, is half a second late."""
    seconds = np.arange(round(48_000 * sound_from), 96_000) / 48_000
    sound = ("pcm_s16le", 0.3 * np.sin(2 * np.pi * seconds * np.where(seconds < 1, 440, 880)), sound_from)
    source, times = tmp_path / "a.mkv", np.arange(20) + round(10 * video_from)
    encode(source, moving(20), "ffv1", "bgr0", given="rgb24", times=times, sound=sound)
    assert read_video(source).num_frames == read_video(source).num_declared == 20
    path = write_video(tmp_path / "b.mp4", moving(20), 10, sound=Sound(source))
    before, after = 0.7 - video_from, 1.05 - video_from
    assert _tones(path, [before, after])[1] == pytest.approx([440, 880], abs=10)


def test_sound_of_a_stream_cut_between_key_frames_stays_with_the_frames(tmp_path):
    """The tone rises at 3 s; the first frame that decodes is that at 2 s."""
    seconds, options = np.arange(4 * 48_000) / 48_000, {"g": "20", "x264-params": "scenecut=0"}
    sound = ("aac", 0.3 * np.sin(2 * np.pi * seconds * np.where(seconds < 3, 440, 880)))
    source = tmp_path / "a.ts"
    encode(source, moving(40), "libx264", "yuv420p", given="rgb24", options=options, sound=sound)
    data = source.read_bytes()
    source.write_bytes(data[188 * (len(data) // 188 // 3) :])
    frames = read_video(source).frames
    assert len(frames) == 20
    path = write_video(tmp_path / "b.mp4", frames, 10, sound=Sound(source))
    assert _tones(path, [0.7, 1.1])[1] == pytest.approx([440, 880], abs=10)


@pytest.mark.parametrize("speed", [0.5, *(pytest.param(speed, marks=pytest.mark.slow) for speed in (1.0, 0.25))])
def test_stretched_sound_stays_with_the_frames(tmp_path, speed):
    """Clicks, on average within 6 ms of the source, in which they are 83 ms apart."""
    clicks, samples = 0.2 + np.arange(20) / 12, np.zeros(96_000)
    samples[np.rint(48_000 * clicks).astype(int)] = 0.98
    source = write_sound(tmp_path / "a.wav", "pcm_s16le", samples)
    path = write_video(tmp_path / "a.mp4", moving(int(20 / speed)), 10, sound=Sound(source, 0.0, speed))
    heard = np.abs(_samples(path))
    windows = [(int(48_000 * (click - 0.04) / speed), int(48_000 * (click + 0.04) / speed)) for click in clicks]
    found = np.array([first + heard[first:stop].argmax() for first, stop in windows]) / 48_000
    assert abs((speed * found - clicks).mean()) < 0.006


def test_one_channel_is_as_loud_as_two(tmp_path):
    tone, heard = 0.3 * np.sin(2 * np.pi * 440 * np.arange(48_000) / 48_000), []
    for layout in ("mono", "stereo"):
        source = write_sound(tmp_path / f"{layout}.aac", "aac", tone, layout, format="adts")
        path = write_video(tmp_path / f"{layout}.mp4", moving(8), 10, sound=Sound(source))
        with av.open(str(path)) as container:
            samples = np.concatenate([frame.to_ndarray() for frame in container.decode(audio=0)], axis=1)
        heard.append(np.sqrt(2 * np.mean(samples[:, 12_000:24_000] ** 2, axis=1)))
    np.testing.assert_allclose(heard, 0.3, rtol=0.05)


def test_sound_whose_packets_hold_several_frames_is_carried_over(tmp_path):
    """Only the first of them has a time stamp."""
    tone = 0.3 * np.sin(2 * np.pi * 440 * np.arange(96_000) / 48_000)
    source = write_sound(tmp_path / "a.wav", "adpcm_ima_wav", tone)
    path = write_video(tmp_path / "a.mp4", moving(16), 10, sound=Sound(source))
    assert _tones(path, [0.3, 1.2])[1] == pytest.approx([440, 440], abs=10)


def test_sound_that_is_none_is_refused(tmp_path, sound_file, clip_file):
    out, unknown = tmp_path / "a.mp4", tmp_path / "b.mkv"
    write_sound(unknown, "pcm_s16le", np.zeros(8000))
    unknown.write_bytes(unknown.read_bytes().replace(b"A_PCM/INT/LIT", b"A_XYZ/INT/LIT"))
    for sound, words in (
        (Sound(unknown), ("sound: expected a file with sound", "whose codec is known")),
        (Sound(tmp_path), ("sound: expected a file with sound", "does not open")),
        (Sound(clip_file), ("sound: expected a file with sound", "clip.webm")),
        (Sound(__file__), ("sound: expected a file with sound", "does not open")),
        (Sound(sound_file, -1.0), ("sound.start", "-1.0")),
        (str(sound_file), ("sound: expected a foldgauss.io.Sound", "str")),
        (Sound(sound_file, 0.0, 0.001), ("sound.speed", "0.01 to 100")),
    ):
        with one_line(ValueError, "expected", *words):
            write_video(out, moving(), 10, sound=sound)
    with pytest.raises(FileNotFoundError):
        write_video(out, moving(), 10, sound=Sound(tmp_path / "missing.mp4"))
    assert not out.exists()


def test_an_error_of_making_frames_is_not_taken_for_one_of_writing(tmp_path):
    def frames():
        yield from moving(2)
        (tmp_path / "missing.png").read_bytes()

    with pytest.raises(FileNotFoundError, match=r"missing\.png"):
        write_video(tmp_path / "a.mp4", frames(), 10)
    assert not list(tmp_path.iterdir())


def test_alpha_that_an_mp4_would_lose_is_refused(tmp_path):
    frames = np.concatenate([moving(2), moving(2)[..., :1]], -1)
    with pytest.raises(VideoError, match=r"expected RGB for vp9 in \.mp4, .* got RGBA\. Take vp9 in a \.webm"):
        write_video(tmp_path / "a.mp4", frames, 10, codec="vp9")
    with pytest.raises(VideoError, match=r"got RGBA\. Take yuva420p\."):
        write_video(tmp_path / "a.webm", frames, 10, pixel_format="yuv420p")


def test_a_relative_name_may_have_a_colon(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert read_video(write_video("a:b.mp4", moving(2), 10)).num_frames == 2


def test_an_mp4_can_be_played_while_it_is_loaded(tmp_path):
    data = write_video(tmp_path / "a.mp4", moving(), 10).read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.mp4", {"codec": "divx"}, ("codec", "h264", "divx")),
        ("a.mp4", {"codec": "prores"}, ("codec", ".mov", "got .mp4", "take h264")),
        ("a.mp4", {"crf": 52}, ("crf", "0 to 51", "52")),
        ("a.mp4", {"crf": 16.5}, ("crf", "whole number", "16.5")),
        ("a.mkv", {"crf": 16}, ("crf", "none for ffv1")),
        ("a.mp4", {"pixel_format": "rgb24"}, ("pixel_format", "yuv420p", "rgb24")),
        ("a.mp4", {"codec": "h265"}, ("frames", "at least 64x64 for h265", "48x64", "h264")),
        ("a.mp4", {"codec": "av1"}, ("frames", "at least 64x64 for av1", "48x64", "h264")),
        ("a.gif", {"crf": 3}, ("crf: expected a video file", "a.gif")),
        ("a", {"codec": "h264"}, ("codec: expected a video file", "'a'")),
        ("a", {"image_format": "bmp"}, ("image_format",)),
        ("a", {"image_format": ""}, ("image_format",)),
        ("out.gif", {"fps": 60}, ("fps", "50")),
        *(("out.mp4", {"fps": fps}, ("fps",)) for fps in (0, 1e-6, -1, float("nan"), float("inf"))),
        *((name, {}, (".mp4", ".webm", "folder", name)) for name in ("out.avi", "out.png", "out.mp4.tmp")),
    ],
)
def test_encodings_that_do_not_fit_are_refused(tmp_path, name, options, words):
    with one_line(ValueError, "expected", *words):
        write_video(tmp_path / name, moving(), **({"fps": 10} | options))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("mode", "associated"), [("RGBA", 0), ("RGBA", 1), ("LA", 0), ("LA", 1)])
def test_alpha_of_tiffs_is_premultiplied_once(tmp_path, mode, associated):
    Image.new(mode, (4, 4), (100 if associated else 200,) * (len(mode) - 1) + (128,)).save(tmp_path / "a.tif")
    tag = struct.pack("<HHI", 338, 3, 1)  # ExtraSamples: 2 is straight alpha, 1 is associated
    data = (tmp_path / "a.tif").read_bytes()
    assert data.count(tag + b"\2") == 1
    (tmp_path / "a.tif").write_bytes(data.replace(tag + b"\2", tag + bytes([2 - associated])))
    assert (read_video(tmp_path / "a.tif").frames == [100, 100, 100, 128]).all()


def test_alpha_of_gray_pngs_with_a_transparent_level_is_kept(tmp_path):
    Image.fromarray(np.array([[200, 100]], np.uint8)).save(tmp_path / "a.png", transparency=200)
    assert read_video(tmp_path / "a.png").frames.tolist() == [[[[0] * 4, [100, 100, 100, 255]]]]


def test_a_gray_png_of_16_bits_with_a_transparent_level_keeps_its_levels(tmp_path):
    """Its alpha is lost; Pillow, which could tell it, would clip the levels."""
    cv2.imwrite(str(tmp_path / "a.png"), np.array([[0, 10_000, 60_000]], np.uint16))
    data = (tmp_path / "a.png").read_bytes()
    body, at = b"tRNS" + bytes(2), data.index(b"IDAT") - 4
    chunk = struct.pack(">I", 2) + body + struct.pack(">I", zlib.crc32(body))
    (tmp_path / "a.png").write_bytes(data[:at] + chunk + data[at:])
    assert read_video(tmp_path / "a.png").frames[0, 0].tolist() == [[0] * 3, [39] * 3, [233] * 3]


def test_alpha_is_resized_with_the_color_it_weighs(tmp_path):
    """A red pixel beside a hidden green one: half of the light, all of it red."""
    image = np.zeros((32, 32, 4), np.uint8)
    image[:, ::2], image[:, 1::2] = (255, 0, 0, 255), (0, 255, 0, 0)
    images(tmp_path, [image, image])
    small = read_video(tmp_path, size=(16, 16)).frames
    np.testing.assert_allclose(small, np.broadcast_to([128, 0, 0, 128], small.shape), atol=1)


def test_opaque_alpha_is_none_and_images_without_are_opaque(tmp_path):
    opaque = rgba(moving(3))
    opaque[..., 3] = 255
    images(tmp_path, [*opaque[:2], opaque[2][..., :3]])
    clip = read_video(tmp_path)
    assert not clip.has_alpha
    np.testing.assert_array_equal(clip.frames, moving(3))
    np.testing.assert_array_equal(clip.over_black, moving(3))
    images(tmp_path, [rgba(moving(3))[0], *opaque[1:, ..., :3]])
    clip = read_video(tmp_path)
    assert clip.has_alpha
    np.testing.assert_array_equal(clip.frames[1:], opaque[1:])
    np.testing.assert_array_equal(clip.frames[0, ..., 3], rgba(moving(3))[0, ..., 3])


def _add_image(image):
    return lambda folder: cv2.imwrite(str(folder / "img99.png"), image)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_add_image(np.zeros((20, 31, 3), np.uint8)), ("20x30", "img1.png", "20x31", "img99.png")),
        (lambda folder: (folder / "img5.png").write_bytes(b"\x89PNG\r\n"), ("img5.png", "decode")),
        (
            lambda folder: cv2.imwrite(str(folder / "z.tif"), np.zeros((20, 30), np.float32)),
            ("float32", "z.tif"),
        ),
    ],
)
def test_folder_with_a_bad_image(folder, change, words):
    change(folder)
    with one_line(VideoError, *words):
        read_video(folder)


# ------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("options", "words"),
    [
        *(({"frames": one}, ("frames: expected", f"{one[0]}:")) for one in ((8, None), (20, 30), (3, 3), (5, 2))),
        *(({"frames": one}, ("frames: expected", f"{one[0]}:")) for one in ((-3, None), (0, -1))),
        *(({"size": one}, ("size: expected", f"{one[0]}x{one[1]}")) for one in ((0, 0), (-16, 32), (0, 32), (32, 0))),
        ({"size": (32.5, 32)}, ("size: expected", "32.5x32")),
        *(({"fps": one}, ("fps",)) for one in (0, 1e-6, -1, float("nan"), float("inf"))),
    ],
    ids=str,
)
def test_wrong_options_are_refused(clip_file, folder, options, words):
    for path in (clip_file, folder, folder / "img1.png"):
        with one_line(VideoError, *words):
            read_video(path, **options)


def test_bad_files_print_nothing(tmp_path, clip_file):
    """Neither OpenCV nor FFmpeg writes to stderr, in a fresh process with nothing else set up."""
    (tmp_path / "text.mp4").write_text("no video" * 200)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    (tmp_path / "bad" / "1.jpg").write_bytes(b"\xff\xd8\xff" + bytes(100))
    (tmp_path / "cut.webm").write_bytes(clip_file.read_bytes()[:-900])
    damaged = bytearray(sample_clip("carphone").read_bytes())
    damaged[20_000:40_000] = bytes(20_000)
    (tmp_path / "damaged.mp4").write_bytes(damaged)
    program = """
import sys, contextlib, numpy, pathlib
from foldgauss.io import VideoError, read_video, write_video
for path in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    with contextlib.suppress(VideoError):
        read_video(path, frames=(0, 60))
frames = numpy.zeros((3, 33, 35, 3), numpy.uint8)
for name in ("out.webm", "out.mp4"):
    write_video(pathlib.Path(sys.argv[1]) / name, frames, 25)
"""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV")}
    ran = subprocess.run(
        [sys.executable, "-c", program, tmp_path], capture_output=True, text=True, env=environment, timeout=60
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")


# -------------------------------------------------------------------------------------------- writing


@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".MP4"])
@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 65)])
def test_written_video_reads_back(tmp_path, suffix, height, width):
    frames = moving(5, height, width)
    path = write_video(tmp_path / f"out{suffix}", iter(frames), 29.97)
    clip = read_video(path)
    assert clip.frames.shape == (5, height + height % 2, width + width % 2, 3)
    assert clip.fps == pytest.approx(29.97, abs=0.01)
    assert clip.num_declared == 5
    for frame, decoded in zip(frames, clip.frames, strict=True):
        assert _psnr(frame, decoded[:height, :width]) > 34
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_webm_says_that_it_is_webm(clip_file):
    head = clip_file.read_bytes()[:64]
    assert b"webm" in head
    assert b"matroska" not in head


def test_color_error_of_the_encoder_is_centered(tmp_path):
    """FFmpeg's default conversion rounds down, which costs each channel about a level both in writing and reading."""
    gray = np.repeat(np.arange(40, 216, 11, dtype=np.uint8), 4)
    frames = np.repeat(np.repeat(gray[None, None, :, None], 32, 1), 3, 3)
    frames = np.repeat(frames, 3, 0)
    error = read_video(write_video(tmp_path / "gray.mp4", frames, 25)).frames.astype(int) - frames
    assert np.abs(error.mean((0, 1, 2))).max() < 0.3


@pytest.mark.parametrize(("name", "quality"), [("out.gif", 31), ("out.webp", 33)])
@pytest.mark.parametrize("fps", [29.97, *(pytest.param(fps, marks=pytest.mark.slow) for fps in (12.5, 50))])
def test_animations_keep_their_pace(tmp_path, name, quality, fps):
    frames = moving(9, 33, 35)
    path = write_video(tmp_path / name, iter(frames), fps)
    with Image.open(path) as image:
        assert (image.n_frames, image.info["loop"]) == (9, 0)
        durations, pictures = [], []
        for number in range(9):
            image.seek(number)
            pictures.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    assert _psnr(np.stack(pictures), frames) > quality
    assert sum(durations) == pytest.approx(9000 / fps, abs=5)
    assert max(durations) - min(durations) <= 10
    assert list(tmp_path.iterdir()) == [path]


def _failing():
    yield from moving(3)
    raise RuntimeError("the renderer failed")


@pytest.mark.parametrize("name", ["out.mp4", "out.webm", "out.gif", "out"])
def test_failure_leaves_what_was_there(tmp_path, name):
    old = write_video(tmp_path / name, moving(2), 25)
    for entry in (old, *old.glob("*")):
        os.utime(entry, (1, 1))
    with pytest.raises(RuntimeError, match="renderer"):
        write_video(old, _failing(), 25, overwrite=True)
    assert list(tmp_path.iterdir()) == [old]
    assert old.stat().st_mtime == 1
    assert read_video(old).num_frames == 2


_BAD_FRAMES = {
    "none": [],
    "floats": [np.zeros((32, 32, 3))],
    "gray": [np.zeros((32, 32), np.uint8)],
    "alpha": [np.zeros((32, 32, 4), np.uint8)],
    "sizes": [np.zeros((32, 32, 3), np.uint8), np.zeros((32, 34, 3), np.uint8)],
}


@pytest.mark.parametrize("frames", _BAD_FRAMES.values(), ids=_BAD_FRAMES)
@pytest.mark.parametrize("name", ["out.mp4", "out.gif", "out.webp", "out"])
def test_bad_frames(tmp_path, name, frames):
    if name == "out" and len(frames) and frames[0].shape[-1] == 4:
        return  # images have alpha
    with one_line(VideoError, "frames", "expected"):
        write_video(tmp_path / name, frames, 25)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["file/out.webm", "file", 256 * "n", 256 * "n" + ".mp4"])
def test_output_that_cannot_be_written(tmp_path, name):
    (tmp_path / "file").write_text("a file")
    with one_line(OutputError, "hoose"):
        write_video(tmp_path / name, moving(), 25)
    assert (tmp_path / "file").read_text() == "a file"
    assert len(list(tmp_path.iterdir())) == 1


def test_write_image_round_trip_and_refusals(tmp_path):
    image = moving(1)[0]
    path = write_image(tmp_path / "a.png", image)
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], image)
    with pytest.raises(VideoError, match=r"\.png"):
        write_image(tmp_path / "a.jpg", image)
    with pytest.raises(VideoError, match="image: expected uint8"):
        write_image(tmp_path / "b.png", image / 255)
    with pytest.raises(OutputError):
        write_image(path / "a.png", image)
    assert list(tmp_path.iterdir()) == [path]


def test_frames_of_many_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "BLOCK_BYTES", 3 * 20 * 24 * 3)
    frames = np.random.default_rng(0).integers(0, 256, (8, 20, 24, 3), np.uint8)
    np.testing.assert_array_equal(reading.stack_frames(frames), frames)
    rgba = np.concatenate([frames[4:], frames[:4, ..., :1]], -1)
    found = reading.stack_frames([*frames[:4], *rgba])
    np.testing.assert_array_equal(found, np.concatenate([np.insert(frames[:4], 3, 255, -1), rgba]))
    assert len(reading.stack_frames(iter(()))) == 0
