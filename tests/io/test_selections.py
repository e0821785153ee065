"""Selections on disk: exact, and refused for any other model."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import ModelFileError, load_selection, load_video_model, save_selection, save_video_model
from foldgauss.io.models.model_file import read_header
from foldgauss.render import RenderOptions
from foldgauss.video import FrameTimes, Selection, VideoModel
from foldgauss.video.models.row_layout import unpack


def model(num=50, seed=0):
    rows = np.random.default_rng(seed).normal(size=(num, 17)).astype(np.float32)
    splats = unpack(rows, 3, TimeLikelihood(1.7, 0.01))
    return VideoModel(splats, FrameTimes.uniform(5), (48, 80), 29.97, RenderOptions())


@pytest.fixture
def selection():
    return Selection(np.random.default_rng(1).random(50) < 0.4)


def test_round_trip(tmp_path, selection):
    path = save_selection(tmp_path / "s.safetensors", selection, model())
    assert load_selection(path, model()) == selection
    save_video_model(tmp_path / "m", model())
    assert load_selection(path, load_video_model(tmp_path / "m")) == selection
    for one in (Selection.none(model()), Selection.all(model())):
        assert load_selection(save_selection(path, one, model()), model()) == one
    assert read_header(path)["header"]["num_gaussians"] == 50


def test_what_is_not_the_gaussians_may_change(tmp_path, selection):
    path = save_selection(tmp_path / "s", selection, model())
    other = dataclasses.replace(model(), fps=50.0, options=RenderOptions.fast(), size=(96, 160))
    assert load_selection(path, other) == selection


@pytest.mark.parametrize("name", ["loc", "color_dc", "coefficients", "opacity_logit", "envelope"])
def test_another_model_is_refused(tmp_path, selection, name):
    path = save_selection(tmp_path / "s", selection, model())
    changed = eqx.tree_at(
        lambda m: m.splats.envelope.power if name == "envelope" else getattr(m.splats, name),
        model(),
        replace_fn=lambda leaf: leaf + np.float32(1e-3),
    )
    with pytest.raises(ValueError, match=r"^path: expected a selection of this model, got another's"):
        load_selection(path, changed)


def test_other_numbers_and_files_are_refused(tmp_path, selection):
    path = tmp_path / "s"
    with pytest.raises(ValueError, match=r"^selection: expected one of the model's 51 Gaussians, got 50"):
        save_selection(path, selection, model(51))
    assert not path.exists()
    save_selection(path, selection, model())
    with pytest.raises(ValueError, match=r"^path: expected a selection of the model's 51 Gaussians, got one of 50"):
        load_selection(path, model(51))
    save_video_model(path, model())
    with pytest.raises(ModelFileError, match="expected a selection, got 'video'"):
        load_selection(path, model())
    with pytest.raises(FileNotFoundError):
        load_selection(tmp_path / "none", model())
