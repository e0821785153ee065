"""Files hold of each Gaussian what it has: the same model to the bit, in the bytes that this comes to."""

import json

import jax
import numpy as np
import pytest
from commands import run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import ModelFileError, load_selection, load_video_model, save_selection, save_video_model
from foldgauss.io.models.model_file import read_header
from foldgauss.render import RenderOptions
from foldgauss.video import FrameTimes, Selection, VideoModel, edit, layers
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.row_layout import unpack
from foldgauss.video.models.splats import OPAQUE_LOGIT, STATIC_LOG_TIME_SCALE

NUM, NUM_FRAMES = 50, 5
#: Bytes of a Gaussian besides coefficients, times, color and shape; those of frame times and envelope.
PLAIN, SHARED = 4 * 4, 4 * (NUM_FRAMES - 1 + 2)


def ragged_model(
    degrees, lasting=False, num_colors=None, num_shapes=None, *, solid=False, degree=None, seed=0
) -> VideoModel:
    """Random Gaussians of these `degrees` (num,), of which those of `lasting` last, in so many colors and shapes.

    No light comes through those of `solid`.
    """
    rng = np.random.default_rng(seed)
    degrees = np.asarray(degrees)
    num, degree = len(degrees), int(degrees.max(initial=0)) if degree is None else degree
    rows = rng.normal(size=(num, 11 + 2 * degree)).astype(np.float32)
    splats = unpack(rows, degree, TimeLikelihood(1.7, 0.01))
    splats.coefficients[np.arange(degree) >= degrees[:, None]] = 0
    splats.time_loc_logit[np.broadcast_to(lasting, num)] = 0
    splats.log_time_scale[np.broadcast_to(lasting, num)] = STATIC_LOG_TIME_SCALE
    splats.opacity_logit[np.broadcast_to(solid, num)] = OPAQUE_LOGIT
    for leaf, rows in ((splats.color_dc, num_colors), (splats.log_scale, num_shapes)):
        if rows is not None:
            own = rng.normal(size=(rows, leaf.shape[1])).astype(np.float32)
            leaf[:] = own[rng.permutation(np.arange(num) % rows)]
    times = FrameTimes(rng.normal(size=NUM_FRAMES - 1).astype(np.float32))
    return VideoModel(splats, times, (48, 80), 29.97, RenderOptions(low_pass=0.123))


def same(one, other) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert (np.asarray(a).dtype, np.shape(a)) == (np.asarray(b).dtype, np.shape(b))
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def tensor_bytes(path) -> int:
    data = path.read_bytes()
    return len(data) - 8 - int.from_bytes(data[:8], "little")


def mixed(num: int, degree: int, *, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, degree + 1, num), rng.random(num) < 0.4


ALTERNATING, SEVENTEEN = np.arange(NUM) % 2 == 0, np.arange(NUM) % 17
# Name: degrees, who lasts, colors, shapes; stored bytes of coefficients, times, colors, shapes, kinds with indices.
CASES = {
    "all whole": (np.full(NUM, 3), False, None, None, (24 * NUM, 8 * NUM, 12 * NUM, 8 * NUM, 0)),
    "degree 0, all timed": (np.zeros(NUM, int), False, None, None, (0, 8 * NUM, 12 * NUM, 8 * NUM, 0)),
    "none moves, all last, one color": (np.zeros(NUM, int), True, 1, None, (0, 0, 12, 8 * NUM, 2 * NUM)),
    "all last": (np.full(NUM, 3), True, None, None, (24 * NUM, 0, 12 * NUM, 8 * NUM, NUM)),
    "half last": (np.full(NUM, 2), ALTERNATING, None, None, (16 * NUM, 4 * NUM, 12 * NUM, 8 * NUM, NUM)),
    "half stand still": (2 * ALTERNATING, False, None, None, (8 * NUM, 8 * NUM, 12 * NUM, 8 * NUM, NUM)),
    "one stands still": (
        np.where(np.arange(NUM) == 7, 2, 3),
        False,
        None,
        None,
        (24 * NUM, 8 * NUM, 12 * NUM, 8 * NUM, 0),
    ),
    "few colors": (np.full(NUM, 1), False, 6, None, (8 * NUM, 8 * NUM, 12 * 6, 8 * NUM, NUM)),
    "too many colors": (np.full(NUM, 1), False, NUM - 1, None, (8 * NUM, 8 * NUM, 12 * NUM, 8 * NUM, 0)),
    "256 colors": (np.ones(600, int), False, 256, None, (8 * 600, 8 * 600, 12 * 256, 8 * 600, 600)),
    "257 colors": (np.ones(600, int), False, 257, None, (8 * 600, 8 * 600, 12 * 257, 8 * 600, 2 * 600)),
    "one Gaussian": ([0], True, None, None, (0, 0, 12, 8, 1)),
    "highest degree": (SEVENTEEN, ALTERNATING, 5, None, (8 * SEVENTEEN.sum(), 4 * NUM, 12 * 5, 8 * NUM, 2 * NUM)),
    "few shapes": (np.full(NUM, 1), False, None, 6, (8 * NUM, 8 * NUM, 12 * NUM, 8 * 6, NUM)),
    "too many shapes": (np.full(NUM, 1), False, None, NUM - 1, (8 * NUM, 8 * NUM, 12 * NUM, 8 * NUM, 0)),
    "257 shapes": (np.ones(900, int), False, None, 257, (8 * 900, 8 * 900, 12 * 900, 8 * 257, 2 * 900)),
    "few of all": (ALTERNATING, ALTERNATING, 5, 7, (4 * NUM, 4 * NUM, 12 * 5, 8 * 7, 3 * NUM)),
}


@pytest.mark.parametrize("name", CASES)
def test_the_same_model_in_the_bytes_that_it_needs(tmp_path, name):
    degrees, lasting, num_colors, num_shapes, parts = CASES[name]
    degrees = np.asarray(degrees).astype(int)
    model = ragged_model(degrees, lasting, num_colors, num_shapes)
    np.testing.assert_array_equal(model.splats.degrees, degrees)
    np.testing.assert_array_equal(model.splats.static, np.broadcast_to(lasting, len(degrees)))
    path = save_video_model(tmp_path / "m.safetensors", model)
    again = load_video_model(path)
    same(model, again)
    assert (again.size, again.fps, again.options) == (model.size, model.fps, model.options)
    assert tensor_bytes(path) == PLAIN * len(degrees) + SHARED + sum(parts)
    assert 0 <= 4 * model.num_parameters - tensor_bytes(path) < 4 * 3  # kinds and indices, each rounded up
    assert model.num_parameters == again.num_parameters
    first = path.read_bytes()
    assert save_video_model(path, again).read_bytes() == first


@pytest.mark.parametrize("solid", [True, ALTERNATING], ids=["all", "half"])
def test_no_opacity_of_those_that_are_solid(tmp_path, solid):
    model = ragged_model(np.full(NUM, 3), solid=solid)
    np.testing.assert_array_equal(model.splats.opaque, np.broadcast_to(solid, NUM))
    path = save_video_model(tmp_path / "m.safetensors", model)
    same(model, load_video_model(path))
    clear = NUM - np.broadcast_to(solid, NUM).sum()
    assert tensor_bytes(path) == (PLAIN - 4 + 24 + 8 + 12 + 8) * NUM + 4 * clear + NUM + SHARED


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    num=st.integers(1, 70),
    degree=st.integers(0, 16),
    share=st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]),
    num_colors=st.none() | st.integers(1, 20),
    num_shapes=st.none() | st.integers(1, 20),
    seed=st.integers(0, 1000),
)
def test_round_trip_law(tmp_path, num, degree, share, num_colors, num_shapes, seed):
    """Any mixture, its dense degree above what any Gaussian has, and never more bytes than one by one."""
    rng = np.random.default_rng(seed)
    degrees = np.where(rng.random(num) < share, rng.integers(0, degree + 1, num), 0)
    model = ragged_model(degrees, rng.random(num) < share, num_colors, num_shapes, degree=degree, seed=seed)
    model.splats.opacity_logit[rng.random(num) < share] = OPAQUE_LOGIT
    path = save_video_model(tmp_path / "m", model)
    same(model, load_video_model(path))
    assert tensor_bytes(path) <= (PLAIN + 28 + 8 * degree) * num + SHARED
    assert 0 <= 4 * model.num_parameters - tensor_bytes(path) < 4 * 3


@pytest.mark.parametrize(
    ("leaf", "value"),
    [
        ("coefficients", -0.0),
        ("coefficients", 1e-45),
        ("time_loc_logit", -0.0),
        ("time_loc_logit", 1e-45),
        ("log_time_scale", np.nextafter(STATIC_LOG_TIME_SCALE, np.float32(0))),
        ("color_dc", -0.0),
        ("log_scale", -0.0),
        ("opacity_logit", np.nextafter(OPAQUE_LOGIT, np.float32(0))),
    ],
)
def test_what_differs_in_a_bit_is_kept(tmp_path, leaf, value):
    """Gaussian 3 is all but one of those that have nothing but a place: the bit is not lost with theirs."""
    model = ragged_model(np.zeros(NUM, int), True, 1, solid=True, degree=2)
    model.splats.color_dc[:] = model.splats.log_scale[:] = 0
    without = model.num_parameters
    getattr(model.splats, leaf)[3] = value
    path = save_video_model(tmp_path / "m", model)
    same(model, load_video_model(path))
    assert "kinds" in str(read_header(path)["tensors"].keys())
    assert model.num_parameters > without


def test_no_kinds_beyond_their_room(tmp_path):
    """Six bits hold a degree up to 63."""
    for degree, header in ((63, {"powers": 9, "timed": NUM, "clear": NUM}), (64, None)):
        model = ragged_model(np.arange(NUM) < 9, degree=degree)
        path = save_video_model(tmp_path / f"{degree}", model)
        same(model, load_video_model(path))
        assert read_header(path)["header"].get("stored") == header


def test_the_largest_index(tmp_path):
    """More than 65,536 colors: four bytes for each."""
    num, num_colors = 110_000, 65_537
    model = ragged_model(np.zeros(num, int), False, num_colors)
    path = save_video_model(tmp_path / "m", model)
    assert read_header(path)["tensors"]["splats.color_index"]["dtype"] == "U32"
    same(model, load_video_model(path))


def test_a_whole_model_is_stored_as_ever(tmp_path):
    """The layout before there were kinds, which loads as it did: no new name in the header or among the tensors."""
    about = read_header(save_video_model(tmp_path / "m", ragged_model(np.full(NUM, 3))))
    assert "stored" not in about["header"]
    assert {name: part["shape"] for name, part in about["tensors"].items()} == {
        "splats.loc": [NUM, 2],
        "splats.log_scale": [NUM, 2],
        "splats.angle_logit": [NUM],
        "splats.time_loc_logit": [NUM],
        "splats.log_time_scale": [NUM],
        "splats.coefficients": [NUM, 3, 2],
        "splats.opacity_logit": [NUM],
        "splats.color_dc": [NUM, 3],
        "splats.envelope.power": [],
        "splats.envelope.floor": [],
        "frame_times.logits": [NUM_FRAMES - 1],
    }


def test_an_old_file_of_a_model_that_could_be_smaller(tmp_path):
    """Dense tensors with zeros in them, as they were written before, load too."""
    old = ragged_model(np.full(NUM, 3))
    path = save_video_model(tmp_path / "m", old)
    zeroed = old.splats.coefficients.tobytes()
    data = path.read_bytes()
    assert data.count(zeroed) == 1
    path.write_bytes(data.replace(zeroed, bytes(len(zeroed))))
    again = load_video_model(path)
    assert not again.splats.degrees.any()
    save_video_model(path, again)
    assert len(data) - len(path.read_bytes()) > 24 * NUM - NUM - 200  # the header grows by less than 200 bytes


def test_layers_of_edited_videos(tmp_path):
    """Each layer's model by itself, masks untouched."""
    still = ragged_model(np.zeros(NUM, int), True, 4, degree=1)
    moving = ragged_model(*mixed(30, 4), seed=2)
    chain = edit(layers(still, moving, still)).select(Selection(np.arange(30) < 9), layer=1)
    video = chain.recolor((1, 0, 0)).video()
    assert isinstance(video, EditedVideo)
    path = save_video_model(tmp_path / "m", video)
    same(video, load_video_model(path))
    described = [layer["model"].get("stored") for layer in read_header(path)["header"]["layers"]]
    assert described[0] == described[2] == {"powers": 0, "timed": 0, "clear": NUM, "colors": 4}
    assert described[1].keys() == {"powers", "timed", "clear"}
    assert video.num_parameters == 2 * still.num_parameters + moving.num_parameters


def test_a_selection_fits_the_model_before_and_after(tmp_path):
    model = ragged_model(*mixed(NUM, 3), 5)
    again = load_video_model(save_video_model(tmp_path / "m", model))
    chosen = Selection(np.arange(NUM) < 20)
    save_selection(tmp_path / "s", chosen, model)
    np.testing.assert_array_equal(load_selection(tmp_path / "s", again).mask, chosen.mask)


def test_a_model_whose_leaves_do_not_fit_is_not_written(tmp_path):
    model = ragged_model(np.zeros(NUM, int), True, 1, degree=2)
    for leaf in ("coefficients", "log_time_scale", "color_dc", "log_scale"):
        splats = jax.tree_util.tree_map(lambda array: array, model.splats)
        object.__setattr__(splats, leaf, getattr(splats, leaf)[:-1])
        broken = VideoModel(splats, model.frame_times, model.size, model.fps, model.options)
        with pytest.raises(ModelFileError, match=f"splats.{leaf}"):
            save_video_model(tmp_path / "m", broken)
    assert not list(tmp_path.iterdir())


# ----------------------------------------------------------------------------------------------------- files that lie


def rewritten(path, header=None, **tensors) -> None:
    """The file with numbers in its header's "stored", and bytes of tensors of the splats, changed."""
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    about, body = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
    described = json.loads(about["__metadata__"]["header"])
    (header or (lambda _: None))(described)
    about["__metadata__"]["header"] = json.dumps(described)
    for name, change in tensors.items():
        start, stop = about[f"splats.{name}"]["data_offsets"]
        array = np.frombuffer(body[start:stop], np.uint8).copy()
        change(array)
        body[start:stop] = array.tobytes()
    text = json.dumps(about).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(body))


def put(**numbers):
    return lambda header: header["stored"].update(numbers)


HEADERS = {
    "more powers": put(powers=61),
    "fewer powers": put(powers=59),
    "powers below 0": put(powers=-1),
    "more powers than there is room for": put(powers=10**15),
    "powers that are no whole number": put(powers=60.0),
    "timed that is no whole number": put(timed=25.0),
    "more timed": put(timed=26),
    "timed beyond all": put(timed=NUM + 1),
    "more clear": put(clear=41),
    "clear that is no whole number": put(clear=40.0),
    "no clear": lambda header: header["stored"].pop("clear"),
    "no powers": lambda header: header["stored"].pop("powers"),
    "no timed": lambda header: header["stored"].pop("timed"),
    "no colors": put(colors=0),
    "other colors": put(colors=7),
    "colors beyond all": put(colors=NUM + 1),
    "colors that are no number": put(colors="many"),
    "colors beyond any index": lambda h: h.update(num_gaussians=10**13, stored={"colors": 10**12}),
    "no shapes": put(shapes=0),
    "other shapes": put(shapes=5),
    "shapes beyond all": put(shapes=NUM + 1),
    "shapes, undescribed": lambda header: header["stored"].pop("shapes"),
    "kinds, undescribed": lambda header: header.update(stored={"colors": 6, "shapes": 4}),
    "palette, undescribed": lambda header: header["stored"].pop("colors"),
    "nothing described": lambda header: header.pop("stored"),
    "no dictionary": lambda header: header.update(stored=[60, 25, 6, 4]),
    "null": lambda header: header.update(stored=None),
    "another word": put(normals=3),
    "degree beyond the bits": lambda header: header.update(degree=64),
    "degree below the Gaussians'": lambda header: header.update(
        degree=1, stored={"powers": 50, "timed": 25, "clear": 40}
    ),
}


@pytest.fixture
def hostile(tmp_path):
    """A good file, to be made a bad one: 50 Gaussians, 60 powers, 25 timed, 40 clear, 6 colors, 4 shapes."""
    degrees = np.where(np.arange(NUM) < 20, 3, 0)
    path = save_video_model(tmp_path / "m", ragged_model(degrees, ALTERNATING, 6, 4, solid=np.arange(NUM) < 10))
    assert read_header(path)["header"]["stored"] == {"powers": 60, "timed": 25, "clear": 40, "colors": 6, "shapes": 4}
    load_video_model(path)
    return path


@pytest.mark.parametrize("name", HEADERS)
def test_headers_that_lie(hostile, name):
    rewritten(hostile, HEADERS[name])
    with pytest.raises(ModelFileError) as caught:
        load_video_model(hostile)
    assert "\n" not in str(caught.value)


def _at(place, value):
    def change(array):
        array[place] = value

    return change


@pytest.mark.parametrize(
    ("tensors", "match"),
    [
        ({"kinds": _at(0, 4 + 64 + 128)}, "greatest degree in kinds: expected a whole number from 0 to 3, got 4"),
        ({"kinds": _at(slice(None), 255)}, "greatest degree in kinds"),
        ({"kinds": _at(0, 2 + 64 + 128)}, "expected 60 powers, as many as are stored, got 59"),
        ({"kinds": _at(slice(None), 3)}, "expected 60 powers, as many as are stored, got 150"),
        ({"kinds": _at(0, 3 + 128)}, "expected 40 Gaussians that are not opaque, as many as are stored, got 41"),
        ({"kinds": _at(0, 3 + 64)}, "expected 25 Gaussians that are not static, as many as are stored, got 26"),
        ({"color_index": _at(-1, 6)}, "color_index: expected a whole number from 0 to 5, got 6"),
        ({"color_index": _at(0, 255)}, "color_index: .* got 255"),
        ({"shape_index": _at(7, 4)}, "shape_index: expected a whole number from 0 to 3, got 4"),
    ],
)
def test_tensors_that_do_not_fit_each_other(hostile, tensors, match):
    rewritten(hostile, **tensors)
    with pytest.raises(ModelFileError, match=match) as caught:
        load_video_model(hostile)
    assert "\n" not in str(caught.value)
    assert str(hostile) in str(caught.value)


def test_any_changed_byte_gives_a_model_or_an_error(hostile):
    """Every byte of the header's JSON, and of kinds and indices."""
    data = bytearray(hostile.read_bytes())
    rng, tail = np.random.default_rng(0), 3 * NUM  # kinds and indices, of one byte each, end the file
    length = int.from_bytes(data[:8], "little")
    loaded = 0
    for place in (*rng.choice(8 + length, 150, replace=False), *range(len(data) - tail, len(data))):
        mutant = data.copy()
        mutant[place] ^= int(rng.integers(1, 256))
        hostile.write_bytes(mutant)
        try:
            assert load_video_model(hostile).num_gaussians == NUM
            loaded += 1
        except ModelFileError:
            continue
    assert loaded < 150


# ----------------------------------------------------------------------------------------------------------- the shell


def test_info_tells_what_gaussians_do_without(tmp_path, capsys):
    degrees = np.where(np.arange(NUM) < 20, 3, 0)
    path = save_video_model(
        tmp_path / "m.safetensors", ragged_model(degrees, ALTERNATING, 6, 4, solid=np.arange(NUM) < 10)
    )
    assert run("info", path) == 0
    told = capsys.readouterr().out
    assert "0 of 30 Gaussians, 3 of 20 Gaussians" in told
    assert "25 of 50 Gaussians, throughout the clip" in told
    assert "6, shared by 50 Gaussians" in told
    assert "4, shared by 50 Gaussians" in told
    assert "10 of 50 Gaussians, without transmittance" in told
    assert f"{load_video_model(path).num_parameters:,}" in told
    assert f"{path.stat().st_size:,} bytes" in told
    run("info", save_video_model(tmp_path / "whole.safetensors", ragged_model(np.full(NUM, 3))))
    told = capsys.readouterr().out
    assert not any(name in told for name in ("degrees", "static", "colors", "shapes", "opaque"))


def test_no_shape_of_a_ragged_model_is_compiled_for(tmp_path, caplog):
    """Compiled programs stay: a process that loads models of many sizes would grow without end."""
    for num in (67, 71):
        model = ragged_model(np.arange(num) % 4, np.arange(num) % 2 == 0, num_colors=3, num_shapes=2)
        save_video_model(tmp_path / "m.safetensors", model)
        with jax.log_compiles():
            found = load_video_model(tmp_path / "m.safetensors")
        assert "Compiling" not in caplog.text
        assert "tracing" in caplog.text  # of the skeleton: the log is seen
        same(found, model)
