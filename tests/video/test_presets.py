"""Presets: the published recipe, its initialization and its two cameras; drafts."""

import dataclasses

import jax
import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions, cpu
from foldgauss.video import FitConfig, LearningRates, Views, fit_steps
from foldgauss.video.fitting.config import PRESETS, Growth, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.initialize import initialize_uniform
from foldgauss.video.fitting.loop import start
from foldgauss.video.fitting.schedule import choose_views
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.models.conditioning import mirror
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.splats import SH_C0

FRAMES = moving_blobs(4, 24, 40)
TAN = np.tan(0.6911112 / 2)  # the published frame's half width, in its units


def test_standard_is_the_default():
    assert FitConfig.preset("standard") == FitConfig()


@pytest.mark.parametrize("name", PRESETS)
def test_changes_override_a_preset(name):
    config = FitConfig.preset(name, degree=5, seed=9)
    assert dataclasses.replace(FitConfig.preset(name), degree=5, seed=9) == config


def test_unknown_names():
    with pytest.raises(ValueError, match="preset: expected one of 'standard', 'draft', 'paper', got 'papers'"):
        FitConfig.preset("papers")
    with pytest.raises(ValueError, match="degrees: expected the name of a setting"):
        FitConfig.preset("paper", degrees=3)


def test_a_draft_is_smaller_than_the_standard():
    draft, standard = FitConfig.preset("draft"), FitConfig()
    assert planned_steps(draft, 24) < planned_steps(standard, 24) / 3
    assert chosen_num_gaussians(draft, 24, 160, 320) < chosen_num_gaussians(standard, 24, 160, 320) / 3


def test_the_published_numbers():
    paper = FitConfig.preset("paper")
    assert (paper.num_gaussians, paper.degree, paper.views.batch_size, paper.steps) == (500_000, 7, 3, 30_000)
    assert (paper.power, paper.loss.ssim_fraction, paper.loss.l2_fraction, paper.floor) == (2.0, 0.2, 0.0, 0.0)
    assert paper.loss.border_weight == 1
    assert paper.options == RenderOptions()
    assert paper.strategy.scale_cutoff == pytest.approx(1e-4 / (2 * TAN))
    assert paper.strategy.growth == Growth()
    assert (paper.rates.cooldown, paper.views.error_fraction, paper.strategy.relocated_fraction) == (0, 0, 0)
    rates = paper.rates
    # A published length is half a frame's width per tan; ours the whole: 1 / (2 tan).
    assert rates.loc == pytest.approx(1.6e-4 * 1.1 / (2 * TAN))
    assert rates.coefficients == pytest.approx(1e-3 / (2 * TAN))
    assert (rates.color_dc, rates.opacity_logit, rates.log_scale) == (2.5e-3, 2.5e-2, 5e-3)
    assert {rates.angle_logit, rates.time_loc_logit, rates.log_time_scale, rates.frame_times} == {1e-3}
    assert paper.strategy.growth.clone_below == pytest.approx(0.011 / (2 * TAN))


# -------------------------------------------------------------------------------------------------- starts


def uniform(num=5000, size=(24, 40), seed=0, degree=3):
    return initialize_uniform(num, size, degree=degree, envelope=TimeLikelihood(2.0), seed=seed)


def test_uniform_starts_are_as_published():
    splats = uniform()
    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731
    # Mean and variance of each uniform law, to five standard errors of 5000 draws or more.
    for values, low, high in (
        (splats.loc[:, 0], -0.5, 0.5),
        (splats.loc[:, 1], -0.5 * 0.6, 0.5 * 0.6),
        (sigmoid(splats.time_loc_logit), 0, 1),
        (sigmoid(splats.angle_logit), 0, 1),
        (np.exp(splats.log_time_scale), 0.01, 1),
        (splats.coefficients * 2 * TAN, -1, 1),
    ):
        wide, values = high - low, np.ravel(values)
        assert values.min() >= low - 1e-6
        assert values.max() <= high + 1e-6
        assert abs(values.mean() - (low + high) / 2) < 5 * wide / np.sqrt(12 * len(values))
        assert abs(values.var() - wide**2 / 12) < 5 * wide**2 / 12 * np.sqrt(0.8 / len(values))
    np.testing.assert_allclose(sigmoid(splats.opacity_logit), 0.1, rtol=1e-5)
    np.testing.assert_allclose(0.5 + SH_C0 * splats.color_dc, 127 / 255, rtol=1e-5)


def test_uniform_starts_are_as_wide_as_the_distance_to_neighbors():
    splats = uniform(60)
    square = np.sort(((splats.loc[:, None] - splats.loc[None]) ** 2).sum(-1), axis=1)[:, 1:4].mean(1)
    far = np.sqrt(square)
    np.testing.assert_allclose(np.exp(splats.log_scale), np.stack([far, far], -1), rtol=1e-4)


@pytest.mark.parametrize("num", [1, 2, 3])
def test_few_uniform_starts(num):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(uniform(num)))


def test_uniform_starts_depend_on_the_seed():
    assert np.array_equal(uniform().loc, uniform().loc)
    assert not np.array_equal(uniform().loc, uniform(seed=1).loc)


def test_the_config_chooses_the_starts():
    config = FitConfig(num_gaussians=50, initialization="uniform")
    rows = start(FRAMES, config).rows
    np.testing.assert_array_equal(rows[:, columns(3)["loc"]], uniform(50).loc)


# ------------------------------------------------------------------------------------------------- cameras


def splats_in_pixels(size, num=40):
    rng = np.random.default_rng(1)
    mean = rng.uniform(0, 1, (num, 2)) * size[::-1]
    leaves = mean, rng.normal(0, 3, (num, 2, 2)), rng.uniform(0.2, 0.9, num), rng.uniform(0, 1, (num, 3))
    return [np.float32(leaf) for leaf in leaves]


def test_opposite_camera_sees_the_mirrored_image():
    """As `Camera.opposing` does, see tests/render/test_camera.py."""
    size = (24, 40)
    mean, factor, *others = splats_in_pixels(size)
    front = cpu.forward(mean, factor, *others, np.zeros(3, np.float32), size)
    seen = mirror(mean, factor, 40)
    back = cpu.forward(*seen, *others, np.zeros(3, np.float32), size)
    np.testing.assert_allclose(back.image, front.image[:, :, ::-1], atol=2e-6)


def test_both_views_give_the_same_gradients():
    config = FitConfig(num_gaussians=200, steps=30)
    for state, _ in fit_steps(FRAMES, config):
        pass
    gradients, losses = [], []
    for mirrored in (False, True):
        step = CpuStepper(FRAMES, config, state)
        loss, _, by_time = step._differentiate(
            state,
            2,
            np.float32(0.6),
            step.spec,
            None,
            squared=False,
            mirrored=mirrored,
            screen=None,
            fraction=None,
        )
        gradients.append(np.append(step.grad, by_time))
        losses.append(loss.value)
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    assert np.abs(gradients[0]).max() > 1e-4
    np.testing.assert_allclose(*gradients, atol=1e-4 * np.abs(gradients[0]).max())


def test_a_pass_sees_every_frame_from_both_sides():
    config = FitConfig(num_gaussians=20, views=Views(two_cameras=True, batch_size=2, error_fraction=0))
    errors = np.ones(4)
    passes = [np.concatenate([choose_views(config, 4, 4 * k + i, errors) for i in range(4)]) for k in range(2)]
    assert sorted(passes[0]) == sorted(passes[1]) == list(range(8))
    assert passes[0].tolist() != passes[1].tolist()


# --------------------------------------------------------------------------------------------------- steps


def test_dense_updates_move_all_gaussians():
    short = {"num_gaussians": 300, "steps": 12, "rates": PRESETS["paper"]["rates"], "strategy.relocated_fraction": 0}
    for sparse_updates in (True, False):
        for state, info in fit_steps(
            FRAMES, FitConfig().replace(**{"strategy.sparse_updates": sparse_updates}, **short)
        ):
            assert info.num_alive <= 300
        assert (state.counts.min() < 12) == sparse_updates
        assert state.counts.max() <= 12


@pytest.mark.parametrize("decayed", ["all", "loc"])
def test_decayed_selects_the_rates(decayed):
    """Where the last step's rate is 0, only what does not fall still moves."""
    config = FitConfig(
        num_gaussians=300,
        steps=20,
        views=Views(batch_size=4, error_fraction=0),
        rates=LearningRates(final=0.0, decayed=decayed),
    )
    state = start(FRAMES, config)
    stepper, before = CpuStepper(FRAMES, config, state), state.rows.copy()
    times = state.time_logits.copy()
    stepper.step(state, 1.0)
    moved = {name: not np.array_equal(state.rows[:, at], before[:, at]) for name, at in columns(3).items()}
    assert not moved.pop("loc")
    assert set(moved.values()) == {decayed == "loc"}
    assert np.array_equal(np.asarray(state.time_logits), times) == (decayed == "all")
