"""The form of a video model in a file: plain tensors of float32, each parameter of each Gaussian once."""

import jax
import numpy as np
import pytest
from commands import call
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from soft_models import assert_same

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import ModelFileError, load_video_model, save_video_model
from foldgauss.io.models.model_file import read_header
from foldgauss.render import RenderOptions
from foldgauss.video import FrameTimes, Selection, VideoModel, edit, layers
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.row_layout import unpack

NUM, NUM_FRAMES = 50, 5


def random_model(degrees, degree=None, *, seed=0) -> VideoModel:
    """Random Gaussians whose folds are of these `degrees` (num,)."""
    rng, degrees = np.random.default_rng(seed), np.asarray(degrees)
    degree = int(degrees.max(initial=0)) if degree is None else degree
    rows = rng.normal(size=(len(degrees), 11 + 2 * degree)).astype(np.float32)
    splats = unpack(rows, degree, TimeLikelihood(1.7, 0.01))
    splats.coefficients[np.arange(degree) >= degrees[:, None]] = 0
    times = FrameTimes(rng.normal(size=NUM_FRAMES - 1).astype(np.float32))
    return VideoModel(splats, times, (48, 80), 29.97, RenderOptions(low_pass=0.123))


def tensor_bytes(path) -> int:
    data = path.read_bytes()
    return len(data) - 8 - int.from_bytes(data[:8], "little")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(num=st.integers(1, 70), degree=st.integers(0, 16), seed=st.integers(0, 1000))
def test_round_trip_law(tmp_path, num, degree, seed):
    """The same model to the bit, in four bytes for each parameter and for both of the envelope."""
    degrees = np.random.default_rng(seed).integers(0, degree + 1, num)
    model = random_model(degrees, degree, seed=seed)
    np.testing.assert_array_equal(model.splats.degrees, degrees)
    path = save_video_model(tmp_path / "m", model)
    again = load_video_model(path)
    assert_same(model, again)
    assert (again.size, again.fps, again.options) == (model.size, model.fps, model.options)
    assert model.num_parameters == again.num_parameters == num * (11 + 2 * degree) + NUM_FRAMES - 1
    assert tensor_bytes(path) == 4 * (model.num_parameters + 2)


def test_tensors(tmp_path):
    about = read_header(save_video_model(tmp_path / "m", random_model(np.arange(NUM) % 4)))
    assert {name: (part["dtype"], part["shape"]) for name, part in about["tensors"].items()} == {
        "splats.loc": ("F32", [NUM, 2]),
        "splats.log_scale": ("F32", [NUM, 2]),
        "splats.angle_logit": ("F32", [NUM]),
        "splats.time_loc_logit": ("F32", [NUM]),
        "splats.log_time_scale": ("F32", [NUM]),
        "splats.coefficients": ("F32", [NUM, 3, 2]),
        "splats.opacity_logit": ("F32", [NUM]),
        "splats.color_dc": ("F32", [NUM, 3]),
        "splats.envelope.power": ("F32", []),
        "splats.envelope.floor": ("F32", []),
        "frame_times.logits": ("F32", [NUM_FRAMES - 1]),
    }


def test_layers_of_edited_videos(tmp_path):
    """Each layer's model by itself, masks untouched."""
    still, moving = random_model(np.zeros(NUM, int), degree=1), random_model(np.arange(30) % 5, seed=2)
    chain = edit(layers(still, moving, still)).select(Selection(np.arange(30) < 9), layer=1)
    video = chain.recolor((1, 0, 0)).video()
    assert isinstance(video, EditedVideo)
    path = save_video_model(tmp_path / "m", video)
    assert_same(video, load_video_model(path))
    assert video.num_parameters == 2 * still.num_parameters + moving.num_parameters


def test_a_model_whose_leaves_do_not_fit_is_not_written(tmp_path):
    model = random_model(np.zeros(NUM, int), degree=2)
    for leaf in ("coefficients", "log_time_scale", "color_dc", "log_scale"):
        splats = jax.tree_util.tree_map(lambda array: array, model.splats)
        object.__setattr__(splats, leaf, getattr(splats, leaf)[:-1])
        broken = VideoModel(splats, model.frame_times, model.size, model.fps, model.options)
        with pytest.raises(ModelFileError, match=f"splats.{leaf}"):
            save_video_model(tmp_path / "m", broken)
    assert not list(tmp_path.iterdir())


def test_info_tells_of_lower_degrees(tmp_path):
    path = save_video_model(tmp_path / "m.safetensors", random_model(np.where(np.arange(NUM) < 20, 3, 0)))
    parameters, size = f"{load_video_model(path).num_parameters:,}", f"{path.stat().st_size:,} bytes"
    call("info", path, out=["30 Gaussians of degree 0, 20 Gaussians of degree 3", parameters, size])
    whole = save_video_model(tmp_path / "whole.safetensors", random_model(np.full(NUM, 3)))
    assert "degrees" not in call("info", whole).out


def test_no_shape_of_a_model_is_compiled_for(tmp_path, caplog):
    """Compiled programs stay: a process that loads models of many sizes would grow without end."""
    for num in (67, 71):
        model = random_model(np.arange(num) % 4)
        save_video_model(tmp_path / "m.safetensors", model)
        with jax.log_compiles():
            found = load_video_model(tmp_path / "m.safetensors")
        assert "Compiling" not in caplog.text
        assert "tracing" in caplog.text  # of the skeleton: the log is seen
        assert_same(found, model)
