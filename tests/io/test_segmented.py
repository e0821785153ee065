"""Segments in one file: the bits of the files that they came from, read when they are wanted."""

import dataclasses
import json
import os
import shutil
import tracemalloc

import jax
import numpy as np
import pytest
from soft_models import NUM, assert_same, soft_model

from foldgauss.io import (
    ModelFileError,
    OutputError,
    html_page,
    join_segments,
    load_video_model,
    read_vegas_ply,
    save_compact,
    save_video_model,
    write_3dgs_ply,
    write_vegas_segments,
)
from foldgauss.io.models import segmented
from foldgauss.io.models.compact import MAGIC
from foldgauss.io.models.model_file import read_header
from foldgauss.io.models.video_model import read_metadata
from foldgauss.io.page.player_page import quantize_finely
from foldgauss.video import FrameTimes, SegmentedVideo, edit, layers
from foldgauss.video.models.renderer import VideoRenderer

FIRSTS, LENGTHS = (0, 4, 13), (7, 9, 5)


def models():
    plain, other, last = (soft_model(seed=k, num_frames=num) for k, num in enumerate(LENGTHS))
    logits = 0.3 * np.random.default_rng(0).standard_normal(8).astype(np.float32)
    edited = edit(other).select(np.arange(NUM) < 12).move((0.1, 0.0), times=(0.2, 0.7)).video()
    edited = layers(edited, dataclasses.replace(soft_model(seed=9, num_frames=9), frame_times=FrameTimes(logits)))
    return [plain, edited, last]


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """a, b and c.safetensors, joined into long.safetensors."""
    folder = tmp_path_factory.mktemp("work")
    for name, first, model in zip("abc", FIRSTS, models(), strict=True):
        save_video_model(folder / f"{name}.safetensors", model, metadata={"mean_psnr": 30.0 + first, "seed": first})
    join_segments(folder / "long.safetensors", sources(folder), metadata={"clip": "long.mp4"})
    return folder


def sources(folder):
    return [(first, folder / f"{name}.safetensors") for name, first in zip("abc", FIRSTS, strict=True)]


def test_each_segment_is_the_model_of_its_file_to_the_bit(work):
    video = load_video_model(work / "long.safetensors")
    assert isinstance(video, SegmentedVideo)
    for (first, file), segment in zip(sources(work), video.segments, strict=True):
        own = load_video_model(file)
        assert_same(own, segment.model)
        for name in (
            "num_frames",
            "num_gaussians",
            "degree",
            "num_parameters",
            "size",
            "fps",
            "options",
            "compositing",
        ):
            assert getattr(segment, name) == getattr(own, name), name
        assert (segment.first, dict(segment.metadata)) == (first, {"mean_psnr": 30.0 + first, "seed": first})
    assert read_metadata(work / "long.safetensors") == {"clip": "long.mp4"}
    assert (video.num_frames, video.cuts) == (18, [13])


def test_a_file_of_one_segment_plays_as_the_model(work, tmp_path):
    join_segments(tmp_path / "one.safetensors", [(0, work / "c.safetensors")])
    one, model = load_video_model(tmp_path / "one.safetensors"), load_video_model(work / "c.safetensors")
    np.testing.assert_array_equal(list(one.frames()), list(model.frames()))
    np.testing.assert_array_equal(VideoRenderer(one).image(0.33), VideoRenderer(model).image(np.float32(0.33)))


def test_saved_again_it_has_the_same_bytes(work, tmp_path):
    long = (work / "long.safetensors").read_bytes()
    video = load_video_model(work / "long.safetensors")
    save_video_model(tmp_path / "again.safetensors", video, metadata={"clip": "long.mp4"})
    assert (tmp_path / "again.safetensors").read_bytes() == long
    join_segments(tmp_path / "joined.safetensors", sources(work), metadata={"clip": "long.mp4"})
    assert (tmp_path / "joined.safetensors").read_bytes() == long
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.safetensors", "joined.safetensors"]
    in_memory = SegmentedVideo.from_models(list(zip(FIRSTS, models(), strict=True)))
    save_video_model(tmp_path / "made.safetensors", in_memory)
    for one, other in zip(load_video_model(tmp_path / "made.safetensors").segments, video.segments, strict=True):
        assert_same(one.model, other.model)


def test_more_than_ten_segments_keep_their_order(tmp_path):
    files = []
    for k in range(12):
        files.append((6 * k, tmp_path / f"{k}.safetensors"))
        save_video_model(files[-1][1], soft_model(seed=k), metadata={"k": k})
    join_segments(tmp_path / "long.safetensors", files)
    video = load_video_model(tmp_path / "long.safetensors")
    assert [segment.metadata["k"] for segment in video.segments] == list(range(12))
    for (_, file), segment in zip(files, video.segments, strict=True):
        assert_same(segment.model, load_video_model(file))


# ------------------------------------------------------------------------------------------------ laziness


@pytest.fixture
def loaded(monkeypatch):
    """The prefixes of the models as they are read."""
    found, load = [], segmented.load_part

    def noted(path, about, prefix=""):
        found.append(prefix)
        return load(path, about, prefix)

    monkeypatch.setattr(segmented, "load_part", noted)
    return found


def test_segments_are_read_when_they_are_wanted(work, loaded):
    video = load_video_model(work / "long.safetensors")
    assert (video.num_gaussians, video.num_frames) == (4 * NUM, 18)
    assert loaded == []
    next(video.frames())
    assert loaded == ["segments.0."]
    list(video.frames(np.linspace(0, 1, 53)))
    assert loaded == ["segments.0.", "segments.1.", "segments.2."]
    assert video.segments[2].model is video.segments[2].model  # the last ones are at hand
    list(video.frames())
    assert loaded == [f"segments.{number}." for number in (0, 1, 2, 0, 1, 2)]


def test_joining_takes_the_memory_of_one_tensor(tmp_path):
    num, count, soft = 60_000, 6, soft_model(degree=0)
    rows = np.random.default_rng(0).integers(0, NUM, num)
    big = jax.tree.map(lambda leaf: np.asarray(leaf)[rows] if np.ndim(leaf) else leaf, soft.splats)
    own = np.random.default_rng(1).random((num, 3)).astype(np.float32)  # shared they would be small
    big = dataclasses.replace(big, color_dc=own, log_scale=own[:, :2] - 3)
    file = tmp_path / "big.safetensors"
    save_video_model(file, dataclasses.replace(soft, splats=big))
    largest = max(4 * int(np.prod(spec["shape"])) for spec in read_header(file)["tensors"].values())
    join_segments(tmp_path / "warm.safetensors", [(0, file)])
    tracemalloc.start()
    try:
        join_segments(tmp_path / "long.safetensors", [(7 * k, file) for k in range(count)])
        video = load_video_model(tmp_path / "long.safetensors")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert video.num_gaussians == num * count
    assert (tmp_path / "long.safetensors").stat().st_size > 4 * 3 * largest
    assert peak < 4 * largest + 200_000  # an array, its bytes, the library's own


def test_a_file_that_changed_since_is_told(work, tmp_path):
    path = tmp_path / "long.safetensors"
    join_segments(path, sources(work))
    video = load_video_model(path)
    join_segments(path, sources(work)[:2])
    with pytest.raises(
        ModelFileError, match=r"^path: expected the file as it was opened, got a changed .*Load it again"
    ):
        list(video.frames())


# ------------------------------------------------------------------------------------------------ refusals


def test_what_is_no_ordinary_model_is_refused(work, tmp_path):
    (tmp_path / "small.fgz").write_bytes(MAGIC)
    (tmp_path / "noise.safetensors").write_bytes(os.urandom(500))
    for name, message in (
        (work / "long.safetensors", r"got one of kind 'segmented-video'.*Join the files that it was made of"),
        (tmp_path / "small.fgz", "got one cut off after 8 bytes"),
        (tmp_path / "noise.safetensors", "expected a foldgauss-model file"),
    ):
        with pytest.raises(ModelFileError, match=message):
            join_segments(tmp_path / "out.safetensors", [(0, name)])
    with pytest.raises(FileNotFoundError):
        join_segments(tmp_path / "out.safetensors", [(0, work / "missing.safetensors")])
    assert not (tmp_path / "out.safetensors").exists()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda header, outer: outer.update({"splats.more": outer.pop("splats.angle_logit")}), "angle_logit"),
        (lambda header, outer: header.update({"fps": float("inf")}), "fps: expected a rate above 0, got"),
    ],
)
def test_a_source_that_does_not_fit_its_header_is_refused(change, text, work, tmp_path):
    path = shutil.copy(work / "a.safetensors", tmp_path / "a.safetensors")
    rewritten(path, change)
    with pytest.raises(ModelFileError, match=text):
        join_segments(tmp_path / "out.safetensors", [(0, path)])
    assert not (tmp_path / "out.safetensors").exists()


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ([], "^segments: expected at least one"),
        ([(0, "a"), (8, "b")], r"^segments\[1\]\.first: expected one that begins at frame 1 to 7"),
        ([(4, "b"), (0, "a")], "begin at frame 0"),
        (["a"], r"^sources\[0\]: expected \(number of its first frame, model file\)"),
        ([("a", 0)], r"^sources\[0\]: expected \(number of its first frame, model file\), got \('a', 0\)"),
        ([(0, 7)], "^path: expected a path"),
    ],
)
def test_sources_that_make_no_clip_are_refused(chosen, message, work, tmp_path):
    given = [(one[0], work / f"{one[1]}.safetensors") if one[1:] in (("a",), ("b",)) else one for one in chosen]
    with pytest.raises(ValueError, match=message):
        join_segments(tmp_path / "out.safetensors", given)
    assert list(tmp_path.iterdir()) == []


def rewritten(path, change):
    """The file with another header, by `change(header of ours)`."""
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    outer = json.loads(data[8 : 8 + length])
    header = json.loads(outer["__metadata__"]["header"])
    change(header, outer)
    outer["__metadata__"]["header"] = json.dumps(header)
    text = json.dumps(outer).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + length :])


def setting(*keys, to):
    """A change of one place in the header."""

    def change(header, outer):
        del outer
        for key in keys[:-1]:
            header = header[key]
        header[keys[-1]] = to

    return change


#: Changes of a file of three segments; of those of one segment, others would not go together with it.
SENSELESS = [
    setting("segments", to={}),
    setting("segments", to=[]),
    setting("segments", 1, to=7),
    setting("segments", 1, "first", to=9),
    setting("segments", 1, "first", to=True),
    setting("segments", 1, "kind", to="segmented-video"),
    setting("segments", 1, "kind", to="fit-checkpoint"),
    setting("segments", 1, "metadata", to=[1]),
    setting("segments", 0, "header", "num_frames", to=10**30),
    setting("segments", 2, "header", "num_frames", to=10**30),
    setting("segments", 0, "header", "num_gaussians", to=10**30),
    setting("segments", 0, "header", "degree", to=10**400),
    setting("segments", 0, "header", "degree", to=-1),
    setting("segments", 0, "header", "size", to=[0, 5]),
    setting("segments", 0, "header", "size", to=5),
    setting("segments", 0, "header", "fps", to=float("inf")),
    setting("segments", 0, "header", "fps", to="fast"),
    setting("segments", 0, "header", "compositing", to="none"),
    setting("segments", 0, "header", "options", to={"low_pass": -1.0}),
    setting("segments", 2, "header", "envelope", to="Other"),
    setting("segments", 2, "header", "degree", to=4),
    lambda header, outer: outer.update({"segments.2.splats.more": outer.pop("segments.2.splats.angle_logit")}),
    setting("segments", 1, "header", "timeline", to=7),
    setting("segments", 1, "header", "layers", to=[]),
    lambda header, outer: outer.update({"more": outer.pop("segments.0.splats.loc")}),
    lambda header, outer: outer.update({"segments.3.splats.loc": outer.pop("segments.0.splats.loc")}),
    lambda header, outer: outer.update({"segments.00.splats.loc": outer.pop("segments.0.splats.loc")}),
]
SENSELESS_ALONE = [
    setting("segments", 0, "header", name, to=value)
    for name, value in {
        "fps": float("inf"),
        "compositing": "none",
        "size": [0, 5],
        "options": {"low_pass": -1.0},
    }.items()
]


@pytest.mark.parametrize(
    ("chosen", "change", "text"),
    [
        *(("abc", change, "expected") for change in SENSELESS),
        *(("a", change, "does not describe it") for change in SENSELESS_ALONE),
        ("a", setting("segments", 0, "header", "fps", to=-1.0), "does not describe it"),
    ],
)
def test_headers_that_make_no_sense_are_refused(chosen, change, text, work, tmp_path):
    path = join_segments(tmp_path / "long.safetensors", sources(work)[: len(chosen)])
    rewritten(path, lambda header, outer: None)
    load_video_model(path)  # the writing itself is sound
    rewritten(path, change)
    with pytest.raises(ModelFileError, match=text) as caught:
        load_video_model(path)
    assert len(str(caught.value)) < 600


# ------------------------------------------------------------------------------------------------- exports


def test_vegas_files_are_one_for_each_segment(tmp_path):
    parts = [soft_model(seed=k, num_frames=num) for k, num in enumerate(LENGTHS)]
    video = SegmentedVideo.from_models(list(zip(FIRSTS, parts, strict=True)))
    write_vegas_segments(tmp_path / "out", video)
    names = [f"segment-{number:03d}.ply" for number in range(3)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    for name, model in zip(names, parts, strict=True):
        again = read_vegas_ply(tmp_path / "out" / name)
        assert again.num_frames == model.num_frames
        np.testing.assert_allclose(again.render(0.4), model.render(0.4), atol=1e-3)
    with pytest.raises(OutputError, match="3 segments"):
        write_vegas_segments(tmp_path / "out", video)
    write_vegas_segments(tmp_path / "out", video, overwrite=True)
    (tmp_path / "out" / "notes.txt").touch()
    with pytest.raises(OutputError, match=r"notes\.txt"):
        write_vegas_segments(tmp_path / "out", video, overwrite=True)


def test_frames_go_out_as_they_are_played(tmp_path):
    parts = [soft_model(seed=k, num_frames=num) for k, num in enumerate(LENGTHS)]
    video = SegmentedVideo.from_models(list(zip(FIRSTS, parts, strict=True)))
    t = 15 / 17
    write_3dgs_ply(tmp_path / "scene.ply", video, t)
    write_3dgs_ply(tmp_path / "own.ply", parts[2], 0.5)
    assert (tmp_path / "scene.ply").read_bytes() == (tmp_path / "own.ply").read_bytes()


# ------------------------------------------------------------------------------------ compact segments


def test_compact_segments_are_stored_as_their_files(tmp_path):
    """Beside others: the bytes of the file, the model that it decodes to, and its page."""
    whole = models()
    path = tmp_path / "a.safetensors"
    save_video_model(path, whole[0])
    compact = [
        save_compact(tmp_path / f"{k}.fgz", quantize_finely(soft_model(seed=k, num_frames=n)))
        for k, n in ((1, 9), (2, 5))
    ]
    long = join_segments(
        tmp_path / "long.fgz", list(zip(FIRSTS, [path, *compact], strict=True)), metadata={"clip": "x"}
    )
    assert segmented.is_segmented(long)
    video = load_video_model(long)
    assert [segment.num_frames for segment in video.segments] == list(LENGTHS)
    assert video.num_gaussians == 3 * NUM
    for segment, file in zip(video.segments[1:], compact, strict=True):
        assert_same(segment.model, load_video_model(file))
        assert segment.num_parameters == segment.model.num_parameters
    for file in compact:
        assert file.read_bytes() in long.read_bytes()
    assert html_page(long).count('id="model-') == 3
    assert long.stat().st_size < 4000 * 3 + sum(file.stat().st_size for file in (path, *compact))


@pytest.fixture
def compact(tmp_path):
    """A file of one compact segment."""
    file = save_compact(tmp_path / "m.fgz", quantize_finely(soft_model(num_frames=7)))
    return join_segments(tmp_path / "long.fgz", [(0, file)])


@pytest.mark.parametrize(("before", "after"), [(b'num_parameters\\":', b'num_parameters\\":-'), (b"U8", b"I8")])
def test_odd_facts_of_a_compact_segment_are_refused(compact, before, after):
    data = compact.read_bytes()
    assert before in data
    compact.write_bytes(data.replace(before, after))
    with pytest.raises(ModelFileError):
        load_video_model(compact)


def test_a_damaged_compact_segment_is_told(compact):
    data = compact.read_bytes()
    compact.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ModelFileError, match=r"1 of its 1 chunks is cut off or damaged.*long.fgz, segment 1"):
        _ = load_video_model(compact).segments[0].model
