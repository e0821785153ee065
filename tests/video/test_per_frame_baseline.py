"""The per-frame baseline: every frame has its own Gaussians, and parameters are counted as stored."""

import dataclasses

import jax
import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.render import RenderOptions
from foldgauss.video import FitConfig, Growth, evaluate, fit, independent_frames, psnr
from foldgauss.video.fitting.per_frame_baseline import PARAMETERS, _StepBudget

FRAMES = moving_blobs(5, 24, 40)
QUICK = FitConfig(steps=60)


@pytest.fixture(scope="module")
def made():
    return independent_frames(FRAMES, 5 * PARAMETERS * 40 + PARAMETERS * 2 + 5, QUICK, fps=12.0)


def test_parameters_are_counted_as_stored(made):
    """What a Gaussian has that is not what it would have anyway, by the leaves; the budget is used up to a rest."""
    leaves = ("loc", "log_scale", "angle_logit", "opacity_logit", "color_dc")
    counted = sum(np.size(getattr(model.splats, name)) for model in made.models for name in leaves)
    assert made.num_parameters == counted == 5 * PARAMETERS * 40 + PARAMETERS * 2
    assert [model.num_gaussians for model in made.models] == [41, 41, 40, 40, 40]
    for model in made.models:
        assert model.degree == 0
        assert model.num_parameters == 11 * model.num_gaussians


def test_result_evaluates_like_a_video_model(made):
    scores = evaluate(made, FRAMES)
    by_hand = [psnr(frame, next(model.frames())) for frame, model in zip(FRAMES, made.models, strict=True)]
    assert scores.psnr == tuple(by_hand)
    assert scores.mean_psnr > 30
    assert (made.num_frames, made.size, made.fps, made.steps) == (5, (24, 40), 12.0, 5 * 60)
    assert made.num_gaussians == 202
    for time in (0.0, 0.4, 1.0):  # a picture knows no time
        np.testing.assert_array_equal(made.models[2].render(time), made.models[2].render(0.0))
    assert [picture.shape for picture in made.frames((12, 20))] == [(12, 20, 3)] * 5


def test_frames_share_nothing():
    """Another third frame changes the third model alone, to the bit."""
    other = FRAMES.copy()
    other[2] = 255 - other[2]
    quick = FitConfig(steps=8)
    pairs = zip(*(independent_frames(frames, 5 * 9 * 20, quick).models for frames in (FRAMES, other)), strict=True)
    equal = [
        all(np.array_equal(one, two) for one, two in zip(*map(jax.tree.leaves, pair), strict=True)) for pair in pairs
    ]
    assert equal == [True, True, False, True, True]


def test_settings_reach_the_fits():
    plain = independent_frames(FRAMES[:1], 9 * 30, FitConfig(steps=8)).models[0]
    for change in ({"seed": 3}, {"ssim_fraction": 1.0}, {"options": RenderOptions()}, {"compositing": "sum"}):
        other = independent_frames(FRAMES[:1], 9 * 30, FitConfig(steps=8, **change)).models[0]
        assert not np.array_equal(other.splats.loc, plain.splats.loc), change
        assert other.compositing == change.get("compositing", "over")
    timed = {"degree": 7, "power": 2.0, "scale_rates_by_duration": False, "follow_motion": False}
    same = independent_frames(FRAMES[:1], 9 * 30, FitConfig(steps=8, **timed)).models[0]
    np.testing.assert_array_equal(same.splats.loc, plain.splats.loc)


def test_alpha():
    alpha = np.full((2, 24, 40, 1), 255, np.uint8)
    alpha[..., 20:, :] = 0
    clear = np.concatenate([np.where(alpha > 0, FRAMES[:2], 0), alpha], axis=-1).astype(np.uint8)
    made = independent_frames(clear, 2 * 9 * 60, FitConfig(steps=150))
    assert evaluate(made, clear, background=(1.0, 1.0, 1.0)).mean_psnr > 18  # over black it would be 5 to the right


def test_minutes_are_divided_by_the_last_speed():
    budget = _StepBudget(FitConfig(minutes=1), 3)
    budget.record(30, 3.0)  # the pilot: 0.1 s a step
    assert budget.plan(0) == 190
    budget.record(190, 38.0)  # twice as slow: 19 s are left for two frames
    assert budget.plan(1) == 47
    budget.record(47, 30.0)
    assert budget.plan(2) == 1  # nothing is left, but every frame has a model
    assert _StepBudget(FitConfig(), 3).plan(1) == 500
    both = _StepBudget(FitConfig(minutes=1, steps=20), 3)
    both.record(30, 3.0)
    assert both.plan(0) == 20


@pytest.mark.slow
def test_minutes_end_the_fits():
    done = []
    made = independent_frames(FRAMES, 9 * 100, FitConfig(minutes=0.02), on_frame=lambda k, model: done.append(k))
    assert done == [0, 1, 2, 3, 4]
    assert made.seconds < 12  # ten times what was asked for: a machine may be busy
    assert made.steps > 5


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"num_gaussians": 5}, "num_gaussians"),
        ({"quality": 50.0}, "quality"),
        ({"size_mb": 1.0}, "size_mb"),
        ({"psnr": 30.0}, "psnr"),
        ({"growth": Growth()}, "growth"),
        ({"interpolation_fraction": 0.1}, "interpolation_fraction"),
        ({"initialization": "uniform", "follow_motion": False}, "initialization"),
    ],
)
def test_settings_without_meaning_are_refused(change, named):
    with pytest.raises(ValueError, match=f"config.{named}: expected"):
        independent_frames(FRAMES, 9000, dataclasses.replace(QUICK, **change))


@pytest.mark.parametrize("num", [44, 0, -9, 100.5, "900"])
def test_too_few_parameters(num):
    with pytest.raises(ValueError, match="num_parameters: expected a whole number >= 45, one Gaussian in each frame"):
        independent_frames(FRAMES, num, QUICK)


def test_bad_frames():
    with pytest.raises(ValueError, match="frames: expected a uint8 array"):
        independent_frames(FRAMES[0], 9000, QUICK)


@pytest.mark.slow
def test_folds_pay_where_things_move():
    """What the paper says of eq:miragevideo: at equal numbers it does worse, knowing nothing of other frames."""
    frames = moving_blobs(24, 48, 64)
    model = fit(frames, FitConfig(num_gaussians=300, steps=2400)).model
    alone = independent_frames(frames, model.num_parameters, FitConfig(steps=300))
    assert alone.num_parameters <= model.num_parameters
    assert evaluate(model, frames).mean_psnr > evaluate(alone, frames).mean_psnr + 3
