"""Relocation of Gaussians, views drawn by error, and the end of the schedule of learning rates."""

import dataclasses

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.render import cpu
from foldgauss.video import FitConfig, evaluate, fit, fit_steps
from foldgauss.video.fitting.loop import start
from foldgauss.video.fitting.optical_flow import motion_finder
from foldgauss.video.fitting.pruning.relocation import RELOCATED_AT, is_relocation_due, measure_influence, relocate
from foldgauss.video.fitting.schedule import COLD, RateSchedule, choose_views
from foldgauss.video.fitting.state import frame_times
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.models.conditioning import ConditioningSpec, condition
from foldgauss.video.models.row_layout import columns

FRAMES = moving_blobs()
CONFIG = FitConfig(num_gaussians=300, steps=120)
SPEC = ConditioningSpec(CONFIG.degree, CONFIG.power, CONFIG.floor, FRAMES.shape[1:3])


def fitted_state(step: int = 40, config: FitConfig = CONFIG):
    for state, info in fit_steps(FRAMES, dataclasses.replace(config, relocated_fraction=0)):
        if info.step == step:
            return state
    raise AssertionError


def render(rows: np.ndarray, window: np.ndarray, t: float) -> np.ndarray:
    done = condition(rows, window, np.float32(t), SPEC)
    leaves = done.mean, done.factor, done.opacity, done.color, np.zeros(3, np.float32)
    return cpu.forward(*leaves, SPEC.size, compositing="over", options=CONFIG.options).image


# ---------------------------------------------------------------------------------------------- relocation


def test_gaussians_of_little_influence_are_invisible():
    """The tenth of least influence changes the images at most a tenth as much as the tenth of most influence."""
    state = fitted_state()
    window, times = CpuStepper(FRAMES, CONFIG, state).window, np.asarray(frame_times(state.time_logits))
    order, changed = np.argsort(measure_influence(state, window, times, CONFIG.degree)), []
    opacity = columns(CONFIG.degree)["opacity_logit"].start
    for which in (order[:30], order[-30:]):
        hidden = state.rows.copy()
        hidden[which, opacity] = -30
        differences = [render(state.rows, window, t) - render(hidden, window, t) for t in times]
        changed.append(float(np.square(differences).sum()))
    assert 0 < changed[0] < 0.1 * changed[1]


def test_new_gaussians_are_where_errors_are():
    """All error is put into one frame: there they start, as many as there were, and the others keep their order."""
    state, before = fitted_state(), None
    before = state.copy()
    state.frame_errors[:] = 1e-12
    state.frame_errors[4] = 0.1
    relocate(state, FRAMES, dataclasses.replace(CONFIG, relocated_fraction=0.1), SPEC, motion_finder(FRAMES)())
    assert state.num_gaussians == CONFIG.num_gaussians
    new = state.counts == 0
    assert new.sum() == 30
    at = columns(CONFIG.degree)["time_loc_logit"].start
    home = 1 / (1 + np.exp(-state.rows[new, at]))
    np.testing.assert_allclose(home, np.asarray(frame_times(state.time_logits))[4], atol=0.01)
    kept = [row.tobytes() for row in state.rows[~new]]
    place = {row.tobytes(): k for k, row in enumerate(before.rows)}
    assert (np.diff([place[row] for row in kept]) > 0).all()
    assert np.isfinite(state.rows).all()
    assert not state.first[new].any()
    assert not state.second[new].any()


def test_opaque_and_unseen_gaussians_stay():
    state = fitted_state()
    opacity = columns(CONFIG.degree)["opacity_logit"].start
    state.kinds[:290] |= 64
    state.rows[:290, opacity] = 30
    state.counts[290:295] = 0
    before = state.rows.copy()
    relocate(state, FRAMES, dataclasses.replace(CONFIG, relocated_fraction=0.5), SPEC, None)
    kept = {row.tobytes() for row in state.rows}
    assert all(row.tobytes() in kept for row in before[:295])
    assert sum(row.tobytes() in kept for row in before) == 295


@pytest.mark.parametrize(
    ("changes", "times"),
    [({}, 3), ({"relocated_fraction": 0.0}, 0), ({"steps": 4}, 0), ({"two_cameras": True, "batch_size": 2}, 3)],
)
def test_when_relocation_is_due(changes, times):
    """At the stated fractions of the plan, once all frames have been seen."""
    config = dataclasses.replace(CONFIG, **changes)
    steps = [state.step for state, _ in fit_steps(FRAMES, config) if is_relocation_due(state, config)]
    assert steps == [round(fraction * config.steps) for fraction in RELOCATED_AT][:times]


def test_resuming_across_relocations_keeps_the_bits():
    whole = [(state.rows.copy(), info.psnr) for state, info in fit_steps(FRAMES, CONFIG)]
    for stop in (23, 24, 41, 42):  # before and after the first two
        for state, _ in fit_steps(FRAMES, CONFIG):
            if state.step == stop:
                break
        for resumed, info in fit_steps(FRAMES, CONFIG, state.copy()):
            rows, psnr = whole[info.step - 1]
            np.testing.assert_array_equal(resumed.rows, rows)
            assert info.psnr == psnr


def test_a_fit_by_a_device_relocates_too():
    config = dataclasses.replace(CONFIG, engine="xla", steps=40, relocated_fraction=0.2)
    for state, info in fit_steps(FRAMES, config):
        if info.step in (8, 14, 20):
            assert (state.counts == 0).sum() >= 60
    assert state.num_gaussians == 300
    assert np.isfinite(state.rows).all()


def test_relocation_finds_what_the_start_missed():
    """Colored rectangles flash in one frame: moved Gaussians improve it by 2 dB and more."""
    frames, rng = moving_blobs(8), np.random.default_rng(0)
    frames[5, 8:40, 14:50] = rng.integers(0, 255, (4, 3, 3)).astype(np.uint8).repeat(8, 0).repeat(12, 1)
    worst = {}
    for fraction in (0.0, 0.1):
        config = FitConfig(num_gaussians=150, steps=600, relocated_fraction=fraction, error_fraction=0)
        worst[fraction] = min(evaluate(fit(frames, config).model, frames).psnr)
    assert worst[0.1] > worst[0.0] + 1


# ------------------------------------------------------------------------------------------- views by error


def test_views_are_drawn_by_error():
    """Shares of views over many steps: 0.7 / 5 for each frame, and 0.3 in proportion to the errors, within 4 sigma."""
    config, errors, num = FitConfig(num_gaussians=20), np.array([1, 2, 3, 4, 90.0]), 4000
    assert choose_views(config, 5, 3, errors) == choose_views(config, 5, 3)  # the first pass
    views = np.concatenate([choose_views(config, 5, step, errors) for step in range(5, 5 + num)])
    share = 0.7 / 5 + 0.3 * errors / errors.sum()
    got = np.bincount(views, minlength=5) / num
    assert (np.abs(got - share) < 4 * np.sqrt(share / num)).all()
    np.testing.assert_array_equal(choose_views(config, 5, 77, errors), choose_views(config, 5, 77, errors))


def test_views_by_error_are_of_both_cameras():
    config = FitConfig(num_gaussians=20, two_cameras=True, error_fraction=0.9)
    errors = np.array([1e-9, 1.0])
    views = np.concatenate([choose_views(config, 2, step, errors) for step in range(4, 400)])
    assert np.bincount(views, minlength=4).argsort()[-2:].tolist() in ([1, 3], [3, 1])


@pytest.mark.parametrize("errors", [np.zeros(4), np.full(4, np.inf), np.full(4, np.nan)])
def test_errors_that_say_nothing_change_no_view(errors):
    config = FitConfig(num_gaussians=20, error_fraction=0.9)
    for step in range(4, 40):
        np.testing.assert_array_equal(choose_views(config, 4, step, errors), choose_views(config, 4, step))


# ------------------------------------------------------------------------------------------ learning rates


def test_rates_cool_down():
    """As without a cooldown until it begins, continuous there, and almost 0 at the end and in overtime."""
    warm, cool = (RateSchedule(FitConfig(final_rate=0.25, cooldown_fraction=part)) for part in (0.0, 0.2))
    for progress in (0.0, 0.5, 0.8):
        np.testing.assert_allclose(cool.at(progress, 0)[0], warm.at(progress, 0)[0], rtol=1e-6)
    np.testing.assert_allclose(cool.at(0.9, 0)[0], (COLD + 0.5 * (1 - COLD)) * warm.at(0.9, 0)[0], rtol=1e-5)
    for progress in (1.0, 1.4):
        np.testing.assert_allclose(cool.at(progress, 0)[0], COLD * warm.at(progress, 0)[0], rtol=1e-5)


def test_the_published_recipe_has_none_of_it():
    config = FitConfig.preset("paper")
    assert (config.cooldown_fraction, config.error_fraction, config.relocated_fraction) == (0, 0, 0)
    assert start(FRAMES, dataclasses.replace(config, num_gaussians=50)).num_gaussians == 50
