"""Losses and density controls that a user brings."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.io import datasets
from foldgauss.video import DensityControl, FitConfig, Loss, fit, fit_steps, register_loss
from foldgauss.video.fitting.losses import LOSSES
from foldgauss.video.fitting.steppers.jax_loss import custom_loss
from foldgauss.video.fitting.steppers.loss import image_loss

CLIP = datasets.waves().frames
CONFIG = FitConfig(num_gaussians=30, steps=40, loss=Loss(ssim_fraction=0, l2_fraction=0))


@pytest.fixture(autouse=True)
def _forget_the_loss_of_other_tests(monkeypatch):
    monkeypatch.delitem(LOSSES, "l1", raising=False)


def mean_error(image, target):
    return jnp.abs(image - target).mean()


@pytest.mark.parametrize("engine", ["cpu", pytest.param("xla", marks=pytest.mark.slow)])
def test_an_own_loss_is_minimized_as_the_built_in_one(engine):
    """L1 by its own code and as a function: the same gradients, so the same fit to rounding."""
    register_loss("l1", mean_error)
    x, y = np.random.default_rng(0).random((2, 3, 20, 30), np.float32)
    own, built_in = custom_loss(x, y, mean_error), image_loss(x, y, ssim_fraction=0)
    np.testing.assert_allclose(own.gradient, built_in.gradient, rtol=1e-6)
    np.testing.assert_allclose(own[::2], built_in[::2], rtol=1e-5)
    config = dataclasses.replace(CONFIG, engine=engine)
    models = [fit(CLIP, config.replace(**{"loss.name": name})).model for name in ("3dgs", "l1")]
    images = [np.stack(list(model.frames())).astype(int) for model in models]
    assert np.abs(images[0] - images[1]).max() <= 1


def test_the_built_in_loss_cannot_be_replaced():
    with pytest.raises(ValueError, match=r"^name: expected one that is not built in, got '3dgs'"):
        register_loss("3dgs", mean_error)


@pytest.mark.parametrize(("quality", "default"), [(None, 0.7), (50, 0.3)])
def test_the_squared_error_begins_where_it_is_asked_to(quality, default):
    assert FitConfig(quality=quality).squared_from == default
    assert FitConfig(quality=quality, loss=Loss(l2_fraction=0)).squared_from == 1
    assert FitConfig(quality=quality, loss=Loss(l2_fraction=0.75)).squared_from == 0.25


class DropEverySecond(DensityControl):
    """After step 20."""

    def is_due(self, state):
        return state.step == 20

    def apply(self, state):
        assert isinstance(state.rows, np.ndarray)
        state.keep(np.arange(0, state.num_gaussians, 2))


@pytest.mark.parametrize("engine", ["cpu", pytest.param("xla", marks=pytest.mark.slow)])
def test_an_own_control_changes_the_gaussians(engine):
    config = dataclasses.replace(CONFIG, engine=engine)
    counts = [info.num_gaussians for _, info in fit_steps(CLIP, config, controls=[DropEverySecond()])]
    assert counts == [30] * 19 + [15] * 21


@pytest.mark.parametrize("engine", ["cpu", pytest.param("xla", marks=pytest.mark.slow)])
def test_an_observer_may_drop_gaussians(engine):
    for state, info in fit_steps(CLIP, dataclasses.replace(CONFIG, engine=engine)):
        if info.step == 20:
            state.fetch_all()
            state.keep(np.arange(0, 30, 2))
    assert state.rows.shape[0] == info.num_gaussians == 15


def test_a_state_of_other_frames_is_refused():
    state, _ = next(iter(fit_steps(CLIP, CONFIG)))
    with pytest.raises(ValueError, match=rf"^frames: expected as many as the state has, {len(CLIP)}, got 3"):
        next(fit_steps(CLIP[:3], CONFIG, state))


def test_leaves_are_views_of_the_rows():
    state, _ = next(iter(fit_steps(CLIP, CONFIG)))
    model = fit(CLIP, dataclasses.replace(CONFIG, steps=1)).model
    for name in ("loc", "opacity_logit", "log_time_scale", "color_dc"):
        expected = np.asarray(getattr(model.splats, name)).reshape(30, -1)
        assert state.leaf(name).shape == expected.shape
        assert np.shares_memory(state.leaf(name), state.rows)
