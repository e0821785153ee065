"""Spans found by seeking: each is, to the bit, what `read_video` gives, and little else is decoded for it.

Clips are made with ffmpeg, and skipped where there is none.
"""

import io
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import threading
import weakref

import numpy as np
import pytest
from made_clips import encode, encoded, images, one_line
from PIL import Image

from foldgauss.io import (
    FrameIndex,
    LazyFrames,
    OutputError,
    VideoError,
    index_video,
    read_indexed,
    read_video,
    write_frames,
    write_image,
)
from foldgauss.io.datasets import sample_clip
from foldgauss.io.media import decoder, indexing
from foldgauss.video.motion.optical_flow import CutFinder, Motion

HEIGHT, WIDTH = 48, 64


def _moving(num_frames, height=HEIGHT, width=WIDTH):
    """A texture that moves, so that no frame is like another and an encoder makes use of those around."""
    texture = np.random.default_rng(0).integers(0, 256, (16, 16, 3)).astype(np.uint8)
    texture = np.asarray(Image.fromarray(texture).resize((4 * width, 4 * height), Image.Resampling.BICUBIC))
    there_and_back = [(k % (6 * height), 2 * k % (6 * width)) for k in range(num_frames)]
    shifts = [(min(y, 6 * height - y), min(x, 6 * width - x)) for y, x in there_and_back]
    return np.stack([texture[top : top + height, left : left + width] for top, left in shifts])


X264 = ["-c:v", "libx264", "-preset", "veryfast", "-pix_fmt", "yuv420p"]
LONG = [*X264, "-g", "250", "-bf", "3"]
#: Of 120 frames. Names begin with what is odd about them.
KINDS = {
    "long.mp4": LONG,
    "open.mp4": [*X264, "-bf", "3", "-x264-params", "open-gop=1:keyint=24:min-keyint=24:scenecut=0"],
    "open.mkv": ["-c:v", "libx265", "-pix_fmt", "yuv420p", "-x265-params", "open-gop=1:keyint=24:log-level=none"],
    "refreshed.mp4": [*X264, "-x264-params", "intra-refresh=1:keyint=30", "-bf", "0"],
    "fragments.mp4": [*LONG, "-g", "40", "-movflags", "frag_keyframe+empty_moov"],
    "vp9.webm": ["-c:v", "libvpx-vp9", "-b:v", "300k", "-deadline", "realtime", "-cpu-used", "8"],
    "mpeg4.avi": ["-c:v", "mpeg4", "-g", "30", "-bf", "2"],
    "mjpeg.avi": ["-c:v", "mjpeg", "-pix_fmt", "yuvj420p"],
    "stream.ts": [*X264, "-g", "40", "-bf", "2"],
    "stream.mpg": ["-c:v", "mpeg2video", "-g", "15", "-bf", "2"],
    "raw.h264": [*X264, "-g", "25"],
    "late.mkv": [*X264, "-g", "30", "-output_ts_offset", "7.3"],
    "uneven.mp4": ["-vf", "setpts='PTS+30*eq(mod(N,5),4)/25/TB/50+gt(N,60)/TB'", "-vsync", "vfr", *X264, "-g", "30"],
    "turned.mp4": [*X264, "-g", "30", "-metadata:s:v", "rotate=90"],
}
SPANS = [(0, 7), (83, 84), (110, 120), (17, 30)]
#: A kind of group, codec, container and clock each; the long runs take the rest.
QUICK = ("long.mp4", "stream.ts", "uneven.mp4")


def _same(got, expected):
    assert got.frames.flags.c_contiguous
    np.testing.assert_array_equal(got.frames, expected.frames)
    assert (got.fps, got.num_declared, got.notes) == (expected.fps, expected.num_declared, expected.notes)
    assert got.source == expected.source
    np.testing.assert_array_equal(got.times, expected.times)


def _as_read(index, path, spans=SPANS, size=None, start=0, **options):
    """Each span is what `read_video` reads there."""
    for first, stop in spans:
        frames = (start + first, start + stop)
        _same(read_indexed(index, first, stop, size=size), read_video(path, frames=frames, size=size, **options))


def _described(index, clip):
    assert (index.num_frames, index.size, index.has_alpha) == (clip.num_frames, clip.size, clip.has_alpha)
    assert (index.fps, index.num_declared, index.notes) == (clip.fps, clip.num_declared, clip.notes)
    np.testing.assert_array_equal(index.times, clip.times)


@pytest.mark.parametrize("name", [pytest.param(k, marks=[] if k in QUICK else pytest.mark.slow) for k in KINDS])
def test_spans_are_what_decoding_from_the_start_gives(tmp_path, name):
    path = encoded(tmp_path / name, _moving(120), *KINDS[name], rate=25)
    clip, index = read_video(path), index_video(path)
    assert clip.num_frames == 120
    assert (clip.times is not None) == (name == "uneven.mp4")
    _described(index, clip)
    assert index.cuts == Motion.from_frames(clip.frames).cuts
    _as_read(index, path)
    _as_read(index, path, SPANS[1:2], size=(20, 30))
    np.testing.assert_array_equal(LazyFrames(index)[:], clip.frames)


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """620 frames, of which every 250th stands alone; another shot begins at 400."""
    frames = _moving(620)
    frames[400:] = 255 - frames[400:, :, ::-1]
    return encoded(tmp_path_factory.mktemp("long") / "long.mp4", frames, *LONG, "-sc_threshold", "0", rate=25)


@pytest.fixture(scope="module")
def long_index(long):
    return index_video(long)


class _Counting(decoder.VideoDecoder):
    """A decoder that counts what is asked of it."""

    decoded = converted = opened = 0

    def __init__(self, *arguments):
        super().__init__(*arguments)
        _Counting.opened += 1

    def frames(self):
        for frame in super().frames():
            _Counting.decoded += 1
            yield frame

    def to_array(self, frame):
        _Counting.converted += 1
        return super().to_array(frame)


@pytest.fixture
def counting(monkeypatch):
    _Counting.decoded = _Counting.converted = _Counting.opened = 0
    monkeypatch.setattr(indexing, "VideoDecoder", _Counting)
    return _Counting


@pytest.mark.slow
def test_a_span_late_in_a_clip_takes_few_frames(long, long_index, counting):
    found = read_indexed(long_index, 500, 520).frames
    assert counting.decoded <= 25
    assert counting.converted == 20
    np.testing.assert_array_equal(found, read_video(long, frames=(500, 520)).frames)


def test_going_forward_decodes_each_frame_once(long, long_index, counting):
    frames = LazyFrames(long_index, size=(24, 32))
    whole = read_video(long, size=(24, 32)).frames
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame, whole[k])
    assert counting.opened == 1
    assert counting.decoded == counting.converted == 620


def test_cuts_are_found_in_passing(long, long_index):
    assert long_index.cuts == [400]
    assert index_video(long, find_cuts=False).cuts == []


def test_cuts_of_a_stream_are_those_of_the_clip():
    """Fast, dark and noisy clips, with a cut at every third frame."""
    names = ("bunny", "bikes", "carphone")
    shots = [read_video(sample_clip(name), size=(90, 120), frames=(0, 116)).frames for name in names]
    mixed = np.stack([shots[k // 3 % 3][5 * k] for k in range(24)])
    noise = np.random.default_rng(0).normal(0, 15, mixed.shape)
    for frames in (mixed, mixed // 12, np.clip(mixed + noise, 0, 255).astype(np.uint8), shots[1][::9]):
        finder = CutFinder()
        for frame in frames:
            finder.add(frame)
        assert finder.found == Motion.from_frames(frames).cuts
        assert finder.found


def test_a_stream_without_times_is_read_on(tmp_path, counting):
    path = encoded(tmp_path / "a.h264", _moving(120), *KINDS["raw.h264"], rate=25)
    lazy, whole = LazyFrames(index_video(path)), read_video(path).frames
    for first in (3, 100):
        np.testing.assert_array_equal(lazy[first : first + 2], whole[first : first + 2])
    assert (counting.opened, counting.decoded) == (1, 102)


@pytest.mark.slow
def test_a_seek_that_lands_amid_blemishes_goes_further_back(tmp_path, counting):
    """Without frames that stand alone, a picture is whole only after a whole round of refreshing."""
    options = [*X264, "-x264-params", "intra-refresh=1:keyint=40", "-bf", "0"]
    path = encoded(tmp_path / "a.mp4", _moving(300, 120, 160), *options, rate=25)
    index = index_video(path)
    thrown_away = []
    for _ in range(2):
        counting.decoded = counting.converted = 0
        _same(read_indexed(index, 277, 279), read_video(path, frames=(277, 279)))
        assert counting.decoded < 200
        thrown_away.append(counting.converted - 2)
    assert thrown_away[0] > 0  # they were looked at, and are not as they should be
    assert thrown_away[1] == 0  # for the margin is kept that was needed


@pytest.mark.parametrize(
    "name",
    [
        "long.mp4",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("vp9.webm", "stream.ts", "open.mp4", "mpeg4.avi", "late.mkv")
        ),
    ],
)
def test_damaged_clips(tmp_path, name):
    path = encoded(tmp_path / name, _moving(120), *KINDS[name], *([] if name == "long.mp4" else ["-g", "20"]), rate=25)
    data = bytearray(path.read_bytes())
    middle = 2 * len(data) // 5
    data[middle : middle + 600] = np.random.default_rng(0).bytes(600)
    path.write_bytes(data)
    clip, index = read_video(path), index_video(path)
    _described(index, clip)
    num = clip.num_frames
    spans = [(first, min(stop, num)) for first, stop in SPANS if first < num]
    _as_read(index, path, [*spans, (50, 70), (0, num), (num - 1, num)])
    np.testing.assert_array_equal(LazyFrames(index, first=3)[:], clip.frames[3:])
    np.testing.assert_array_equal(read_indexed(index, 10, num - 5).frames, clip.frames[10:-5])


@pytest.mark.slow
def test_frames_that_damage_left_out_are_not_counted(tmp_path):
    path = encoded(tmp_path / "a.avi", _moving(40), "-c:v", "png", rate=25)
    data = path.read_bytes()
    starts = [at for at in range(len(data)) if data.startswith(b"\x89PNG", at)]
    broken = bytearray(data)
    for k in (10, 11):
        broken[starts[k] : starts[k] + 30] = bytes(30)
    path.write_bytes(broken)
    clip, index = read_video(path), index_video(path)
    assert index.num_frames == 37  # FFmpeg's parser passes by the one after a broken one, too
    _as_read(index, path, [(8, 12), (10, 11), (27, 37)])
    np.testing.assert_array_equal(LazyFrames(index)[9:12], clip.frames[9:12])


@pytest.mark.slow
def test_where_nothing_moves(tmp_path):
    """Frames are alike to the bit, then move: a seek is not led astray."""
    frames = np.concatenate([np.repeat(_moving(1), 60, 0), _moving(40)])
    path = encoded(tmp_path / "a.mkv", frames, *X264, "-qp", "0", "-g", "20", rate=25)
    index = index_video(path)
    assert len(np.unique(index.digests[:60], axis=0)) == 1
    _as_read(index, path, [(5, 8), (30, 50), (58, 64), (61, 63), (99, 100)])


def test_a_part_of_a_clip_counts_from_its_first_frame(long, counting):
    told, clip = [], read_video(long, frames=(100, 460))
    index = index_video(long, frames=(100, 460), on_frame=lambda: told.append(1))
    assert len(told) == 360
    _described(index, clip)
    assert index.cuts == [300]
    _as_read(index, long, [(0, 5), (200, 220), (350, 360)], start=100)
    assert counting.converted == 35  # those from the key frame before a span are only decoded
    np.testing.assert_array_equal(LazyFrames(index, first=350)[:], clip.frames[350:])
    with pytest.raises(VideoError, match="frames: expected A:B within 0:360"):
        read_indexed(index, 350, 361)


def _clear(num_frames, which):
    """RGBA frames, opaque but for the left edge of those named."""
    frames = np.concatenate([_moving(num_frames), np.full((num_frames, HEIGHT, WIDTH, 1), 255, np.uint8)], -1)
    for number in which:
        frames[number, :, :6, 3] = 40
    return frames


@pytest.mark.parametrize("which", [[], [7]])
def test_the_whole_clip_decides_on_alpha(tmp_path, which):
    path = images(tmp_path / "frames", _clear(12, which))
    clip, index = read_video(path), index_video(path)
    _described(index, clip)
    assert index.has_alpha == bool(which)
    found = read_indexed(index, 2, 5).frames
    np.testing.assert_array_equal(found, clip.frames[2:5])
    lazy = LazyFrames(index)
    assert lazy.shape == clip.frames.shape
    np.testing.assert_array_equal(lazy[:], clip.frames)
    for size in ((20, 20), (24, 32)):  # the first cuts the left edge off
        clip, lazy = read_video(path, size=size), LazyFrames(index, size)
        assert lazy.shape == clip.frames.shape
        np.testing.assert_array_equal(lazy[:], clip.frames)


def test_folders_are_read_by_the_names_indexed(tmp_path):
    path = write_frames(tmp_path / "frames", _moving(12))
    index = index_video(path, frames=(1, None))
    _as_read(index, path, [(0, 3), (8, 11)], start=1)
    write_image(path / "00000a.png", _moving(1)[0])
    clip = read_indexed(index, 3, 5)
    np.testing.assert_array_equal(clip.frames, _moving(12)[4:6])
    shutil.copy(path / "00002.png", path / "00006.png")
    with pytest.raises(VideoError, match="frame 5 differs"):
        read_indexed(index, 3, 8)
    (path / "00005.png").unlink()
    with pytest.raises(VideoError, match="frame 4 differs"):
        read_indexed(index, 3, 8)


@pytest.mark.parametrize("error", [ValueError, OSError, IndexError])
def test_an_error_of_the_caller_is_no_damage_of_an_animation(tmp_path, error):
    first, *rest = map(Image.fromarray, _moving(5))
    first.save(tmp_path / "a.gif", save_all=True, append_images=rest)

    def fail():
        raise error("the caller's own")

    with pytest.raises((error, VideoError), match="the caller's own"):
        index_video(tmp_path / "a.gif", on_frame=fail)


@pytest.mark.parametrize("name", ["a.gif", "a.png"])
def test_an_animation_that_lost_frames_is_refused(tmp_path, name):
    """A GIF does not promise a number of frames, a PNG does."""
    path = tmp_path / name
    first, *rest = map(Image.fromarray, _moving(12))
    first.save(path, save_all=True, append_images=rest)
    index = index_video(path)
    data = path.read_bytes()
    path.write_bytes(data[: 3 * len(data) // 4])
    np.testing.assert_array_equal(LazyFrames(index)[1:3], read_video(path).frames[1:3])
    with pytest.raises(VideoError, match="differs"):
        read_indexed(index, 3, 12)


def test_threads_take_turns(long, long_index, monkeypatch):
    """There is one decoder, at one place in the file."""
    lazy, real, waits, found = LazyFrames(long_index), LazyFrames._read, [], []

    def read(reel, *arguments):
        if not waits:
            other = threading.Thread(target=lambda: found.append(lazy[500]))
            waits.append(other)
            other.start()
            other.join(timeout=1.0)
            assert not found
        return real(reel, *arguments)

    monkeypatch.setattr(LazyFrames, "_read", read)
    np.testing.assert_array_equal(lazy[20], read_video(long, frames=(20, 21)).frames[0])
    waits[0].join(timeout=60)
    np.testing.assert_array_equal(found, read_video(long, frames=(500, 501)).frames)


@pytest.mark.parametrize(
    "name", ["a.ts", *(pytest.param(name, marks=pytest.mark.slow) for name in ("a.mp4", "b.mp4", "a.mkv"))]
)
def test_ranges_of_an_uneven_clip_end_where_the_next_frame_begins(tmp_path, name):
    """Of 40 frames, 30 a second, one is held for 10 s; with B-frames ("b.mp4"), which come in another order, too."""
    ticks = np.arange(40) + 300 * (np.arange(40) >= 20)
    context = {"max_b_frames": 2 if name[0] == "b" else 0}
    frames = _moving(40)
    encode(tmp_path / name, frames, "libx264", "yuv420p", given="rgb24", times=ticks, context=context, rate=30)
    index = index_video(tmp_path / name)
    for first, stop, end in [(25, 35, None), (0, 20, 320), (5, 19, None), (5, 30, 330), (0, 40, 340), (20, 40, None)]:
        clip = read_video(tmp_path / name, frames=(first, stop))
        part = index_video(tmp_path / name, frames=(first, stop))
        assert clip.first_second == pytest.approx(ticks[first] / 30, abs=2e-3)
        if end is None:
            assert (clip.times, clip.duration) == (None, None)
        else:
            np.testing.assert_allclose(clip.times, (ticks[first:stop] - ticks[first]) / 30, atol=2e-3)
            # The end of the last frame of all is not told by every container.
            assert clip.duration == pytest.approx((end - ticks[first]) / 30, abs=2e-3 if stop < 40 else 0.4)
        for other in (part, read_indexed(index, first, stop), read_indexed(part, 0, stop - first)):
            assert (other.fps, other.notes) == (clip.fps, clip.notes)
            assert other.duration == clip.duration
            np.testing.assert_array_equal(other.times, clip.times)
            assert other.first_second == pytest.approx(clip.first_second, abs=1e-9)


FORKING = """
import gc, os, sys, threading
from foldgauss.io import LazyFrames, index_video

read, other = (LazyFrames(index_video(sys.argv[1], frames=(0, 40), find_cuts=False)) for _ in range(2))
expected, others = read[20].sum(), other[30].sum()
holder = threading.Thread(target=read._lock.acquire)
holder.start()
holder.join()
child = os.fork()
if child:
    print(os.wait()[1], other[30].sum() == others)
else:
    del other
    gc.collect()
    same = read[20].sum() == expected and read[5:6].shape[1:] == read.shape[1:]
    read.close()
    os._exit(not same)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_opens_the_file_anew(long):
    """Though another thread of the parent held the lock when it forked, and without waiting for the decoders of what
    it deletes; the parent reads on."""
    command = [sys.executable, "-W", "ignore", "-c", FORKING, long]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (ran.stdout, ran.stderr) == ("0 True\n", "")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_frees_nothing_of_its_parent():
    """Decoders in cycles, which its garbage collector would free, would wait for threads that it has not."""
    code = "import gc, os, foldgauss.io.media.indexing\nif os.fork():\n    print(os.wait()[1])\nelse:\n"
    code += "    os._exit(gc.get_freeze_count() == 0)"
    ran = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=120)
    assert (ran.stdout, ran.stderr) == ("0\n", "")


# ---------------------------------------------------------------------------------------- refusals


def _bad(tmp_path):
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("no video " * 100)
    (tmp_path / "list.m3u8").write_text("#EXTM3U\nclip.mp4")
    (tmp_path / "nothing").mkdir()
    sizes = tmp_path / "sizes"
    sizes.mkdir()
    write_image(sizes / "0.png", _moving(1)[0])
    write_image(sizes / "1.png", _moving(1, 20, 30)[0])
    return [*(tmp_path / name for name in ("empty.mp4", "text.mp4", "list.m3u8", "nothing", "sizes")), tmp_path / "no"]


def test_what_is_refused_is_refused_alike(tmp_path, long):
    wrong = [{"frames": (5, 3)}, {"frames": (700, 800)}, {"frames": (-1, 3)}]
    for path, options in [*((path, {}) for path in _bad(tmp_path)), *((long, options) for options in wrong)]:
        with pytest.raises((VideoError, FileNotFoundError)) as expected:
            read_video(path, **options)
        with pytest.raises(expected.type, match=f"^{re.escape(str(expected.value))}$"):
            index_video(path, **options)


def test_a_file_that_is_another_is_refused(tmp_path, long):
    path = tmp_path / "a.mp4"
    shutil.copy(long, path)
    index = index_video(path, find_cuts=False)
    for other in (_moving(700)[::-1], _moving(30)):
        encoded(path, other, *LONG, rate=25)
        with one_line(VideoError, "expected the file that was indexed", "frame 500 differs", "index it again"):
            read_indexed(index, 500, 503)
        with pytest.raises(VideoError, match="differs"):
            LazyFrames(index)[500]
    path.write_text("no video")
    with pytest.raises(VideoError, match="does not open as a video"):
        read_indexed(index, 500, 503)
    path.unlink()
    with pytest.raises(FileNotFoundError):
        read_indexed(index, 500, 503)


def test_the_digest_tells_clips_apart(tmp_path, long, long_index):
    again = tmp_path / "another.mp4"
    shutil.copy(long, again)
    assert index_video(again, find_cuts=False).digest == long_index.digest
    assert index_video(long, frames=(0, 619), find_cuts=False).digest != long_index.digest


# ------------------------------------------------------------------------------------ index on the disk


def test_an_index_is_saved_and_sent(tmp_path, monkeypatch, long, long_index):
    monkeypatch.chdir(long.parent)
    index = index_video(long.name, frames=(30, 130))
    monkeypatch.chdir(tmp_path)  # where the name as given leads nowhere
    path = index.save(tmp_path / "clip.index")
    assert path.stat().st_size < 100 * 130
    for other in (FrameIndex.load(path), pickle.loads(pickle.dumps(index))):
        assert json.loads(json.dumps(other._about)) == json.loads(json.dumps(index._about))
        assert (other.digest, other.cuts, other.notes) == (index.digest, index.cuts, index.notes)
        assert (other.source, other.num_frames, other.size) == (long.name, 100, (HEIGHT, WIDTH))
        np.testing.assert_array_equal(read_indexed(other, 60, 65).frames, read_indexed(index, 60, 65).frames)


def with_array(data, **changes):
    """The file of an index with other arrays."""
    file = io.BytesIO()
    with np.load(io.BytesIO(data)) as arrays:
        np.savez(file, **{name: changes.get(name, lambda own: own)(own) for name, own in arrays.items()})
    return file.getvalue()


def _of_later_format(about):
    return np.frombuffer(json.dumps(json.loads(about.tobytes()) | {"format": 99}).encode(), np.uint8)


#: The file of an index, changed into none.
NO_INDEX = {
    "empty": lambda data: b"",
    "text": lambda data: b"no index",
    "cut": lambda data: data[: len(data) // 2],
    "zip": lambda data: b"PK\x03\x04" + bytes(50),
    "other": lambda data: with_array(data, about=lambda about: np.zeros(3, np.uint8)),
    "pickled": lambda data: with_array(data, about=lambda about: np.array([None])),
    "short": lambda data: with_array(data, digests=lambda digests: digests[:, :8]),
    "later": lambda data: with_array(data, about=_of_later_format),
}


@pytest.mark.parametrize("name", NO_INDEX)
def test_what_is_no_index_is_refused(tmp_path, long_index, name):
    path = long_index.save(tmp_path / "i.npz")
    with pytest.raises(OutputError):
        long_index.save(path / "a.npz")
    path.write_bytes(NO_INDEX[name](path.read_bytes()))
    with one_line(VideoError, "expected an index of a clip", "index_video"):
        FrameIndex.load(path)
    with pytest.raises(FileNotFoundError):
        FrameIndex.load(tmp_path / "missing")


# ------------------------------------------------------------------------------------------ as an array


def test_frames_as_an_array(long, long_index):
    whole = read_video(long, frames=(90, 200), size=(24, 40)).frames
    lazy = LazyFrames(long_index, (24, 40), 90, 200)
    assert (lazy.shape, lazy.dtype, lazy.ndim, len(lazy)) == (whole.shape, whole.dtype, 4, 110)
    for which in (
        slice(3, 9),
        slice(None, None, 40),
        slice(-5, None),
        slice(60, 20, -13),
        slice(7, 7),
        slice(200, 300),
    ):
        found = lazy[which]
        assert found.flags.c_contiguous
        np.testing.assert_array_equal(found, whole[which])
        assert found.dtype == np.uint8
    for k in (0, 17, 16, -1, np.int64(50)):
        assert lazy[k].flags.c_contiguous
        np.testing.assert_array_equal(lazy[k], whole[k])
    lazy[3][:] = 0  # a copy
    np.testing.assert_array_equal(lazy[3], whole[3])
    np.testing.assert_array_equal(np.asarray(lazy), whole)
    again = pickle.loads(pickle.dumps(lazy))
    np.testing.assert_array_equal(again[5:8], whole[5:8])
    lazy.close()
    np.testing.assert_array_equal(lazy[2], whole[2])


def test_a_closed_array_keeps_no_decoder(long_index):
    lazy = LazyFrames(long_index)
    first = lazy[0]
    held = weakref.ref(lazy._decoder)
    lazy.close()
    assert held() is None
    assert (lazy[0] == first).all()


def test_a_decoder_may_be_closed_while_it_is_read(long):
    video = decoder.VideoDecoder(long)
    frames = video.frames()
    next(frames)
    video.close()
    assert list(frames) == []  # FFmpeg would read memory that is freed


#: What is done with an index of 620 frames and an array of its last 20, and the error.
WRONG = [
    *((lambda index, lazy, k=k: lazy[k], IndexError, "20 frames") for k in (20, -21)),
    *(
        (lambda index, lazy, k=k: lazy[k], ValueError, "expected the number of a frame, or a slice")
        for k in ("a", 1.5, (1, 2), [1, 2])
    ),
    *(
        (lambda index, lazy, span=span: read_indexed(index, *span), VideoError, f"frames: expected A:B {text}")
        for span, text in (
            ((0, 621), "within 0:620, .* got 0:621"),
            ((620, 621), "within 0:620, .* got 620:621"),
            ((5, 5), "with at least 1 frame, got 5:5"),
            ((0, 0), "with at least 1 frame, got 0:0"),
            ((-2, 3), "counted from the start, got -2:3"),
        )
    ),
    *(
        (lambda index, lazy, options=options: LazyFrames(index, **options), VideoError, "expected")
        for options in ({"first": 5, "stop": 5}, {"stop": 621}, {"first": -1}, {"size": (0, 5)})
    ),
]


@pytest.mark.parametrize(("do", "error", "text"), WRONG)
def test_what_arrays_refuse_is_refused(long_index, do, error, text):
    with pytest.raises(error, match=text):
        do(long_index, LazyFrames(long_index, first=600))


_PEAK = """
import sys
from foldgauss.io import LazyFrames, index_video
from foldgauss.jobs.runner import peak_bytes
index_video(sys.argv[1], frames=(0, 20))
before = peak_bytes()
index = index_video(sys.argv[1], frames=(0, int(sys.argv[2])))
for frame in LazyFrames(index):
    pass
print(peak_bytes() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="kilobytes of the largest memory are Linux's")
def test_memory_does_not_grow_with_the_clip(tmp_path):
    """2,000 frames of 360x640 are 1.4 GB; the index and a pass through them take some MB more than a few frames do."""
    path = encoded(tmp_path / "a.mp4", np.tile(_moving(100, 360, 640), (20, 1, 1, 1)), *LONG, rate=25)
    grown = {}
    for num in (200, 2000):
        command = [sys.executable, "-c", _PEAK, path, str(num)]
        ran = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
        grown[num] = int(ran.stdout)
    assert grown[2000] < grown[200] + 40_000 * 1024, grown


@pytest.mark.slow
def test_cuts_of_a_long_clip():
    """Of so long a clip, `Motion` keeps smaller maps; it comes to the same cuts."""
    frames = np.concatenate([read_video(sample_clip(name), size=(136, 320)).frames for name in ("bikes", "bunny")] * 4)
    finder = CutFinder()
    for frame in frames:
        finder.add(frame)
    motion = Motion.from_frames(frames)
    assert motion.small.shape[2] < 320
    assert finder.found == motion.cuts
