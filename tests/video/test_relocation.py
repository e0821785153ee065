"""Relocation of Gaussians, views drawn by error, and the end of the schedule of learning rates."""

import dataclasses

import jax
import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.render import cpu
from foldgauss.video import FitConfig, Growth, LearningRates, Strategy, Views, evaluate, fit, fit_steps
from foldgauss.video.fitting.relocation import RELOCATED_AT, Relocation, add, measure_influence, relocate
from foldgauss.video.fitting.schedule import COLD, choose_views, learning_rates, steps_per_pass
from foldgauss.video.fitting.state import frame_times
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.models.conditioning import ConditioningSpec, condition
from foldgauss.video.models.row_layout import columns
from foldgauss.video.motion.optical_flow import motion_finder

FRAMES = moving_blobs()
CONFIG = FitConfig(num_gaussians=300, steps=120)
SPEC = ConditioningSpec(CONFIG.fold_degree, CONFIG.power, CONFIG.floor, FRAMES.shape[1:3])


def fitted_state(step: int = 40, config: FitConfig = CONFIG):
    for state, info in fit_steps(FRAMES, config.replace(**{"strategy.relocated_fraction": 0})):
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
    order, changed = np.argsort(measure_influence(state, window, times, CONFIG.fold_degree)), []
    opacity = columns(CONFIG.fold_degree)["opacity_logit"].start
    for which in (order[:30], order[-30:]):
        hidden = state.rows.copy()
        hidden[which, opacity] = -30
        differences = [render(state.rows, window, t) - render(hidden, window, t) for t in times]
        changed.append(float(np.square(differences).sum()))
    assert 0 < changed[0] < 0.1 * changed[1]


def test_new_gaussians_are_where_errors_are():
    """All error is put into one frame: there they start, as many as there were, and the others keep their order."""
    state = fitted_state()
    before = state.copy()
    state.frame_errors[:] = 1e-12
    state.frame_errors[4] = 0.1
    relocate(state, FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0.2}), motion_finder(FRAMES)())
    assert state.num_gaussians == CONFIG.num_gaussians
    new = state.counts == 0
    assert new.sum() == 60
    logits = state.rows[:, columns(CONFIG.fold_degree)["time_loc_logit"].start]
    home = 1 / (1 + np.exp(-logits[new]))
    np.testing.assert_allclose(home, np.asarray(frame_times(state.time_logits))[4], atol=0.01)
    for place in np.flatnonzero(new):  # among those of their time
        assert (~new[:place]).sum() == np.searchsorted(np.sort(logits[~new]), logits[place])
    kept = [row.tobytes() for row in state.rows[~new]]
    place = {row.tobytes(): k for k, row in enumerate(before.rows)}
    assert (np.diff([place[row] for row in kept]) > 0).all()
    assert np.isfinite(state.rows).all()
    assert not state.first[new].any()
    assert not state.second[new].any()


def test_new_gaussians_are_in_the_chunk_of_those_behind_them():
    """Where a long step leads past both the sorting into chunks and the relocation."""
    state = fitted_state()
    state.chunks = np.repeat(np.array([7, 3, 0], np.uint16), 100)
    relocate(state, FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0.1}), None)
    new = np.flatnonzero(state.counts == 0)
    assert len(new) == 30
    assert state.chunks.dtype == np.uint16
    assert (state.chunks[1:] <= state.chunks[:-1]).all()
    assert len(set(state.chunks[new])) == 3


def test_gaussians_can_be_added_beside_the_others():
    state = fitted_state()
    before = [row.tobytes() for row in state.rows]
    add(30, state, FRAMES, CONFIG, None)
    new = state.counts == 0
    assert (state.num_gaussians, new.sum()) == (330, 30)
    assert [row.tobytes() for row in state.rows[~new]] == before


def test_only_gaussians_that_can_be_judged_move():
    """Of 20, half; those with few steps stay."""
    state = fitted_state()
    state.counts[:280] = 4
    before = state.rows.copy()
    relocate(state, FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0.5}), None)
    kept = {row.tobytes() for row in state.rows}
    assert all(row.tobytes() in kept for row in before[:280])
    assert sum(row.tobytes() in kept for row in before) == 290


def test_few_gaussians_are_not_relocated():
    state = fitted_state()
    before = state.rows.copy()
    relocate(state, FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0.01}), None)
    np.testing.assert_array_equal(state.rows, before)


def test_gaussians_alive_in_no_frame_move_first():
    state, at = fitted_state(), columns(CONFIG.fold_degree)
    between = [3, 77, 150]
    state.rows[between, at["log_time_scale"].start] = np.log(1e-4)
    state.rows[between, at["time_loc_logit"].start] = 0  # t = 0.5 lies between two frames
    state.counts[between] = 0
    before = state.rows[between].copy()
    relocate(state, FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0.05}), None)
    kept = {row.tobytes() for row in state.rows}
    assert not any(row.tobytes() in kept for row in before)


@pytest.mark.parametrize(
    ("changes", "times"),
    [
        ({}, 3),
        ({"strategy.relocated_fraction": 0.0}, 0),
        ({"steps": 20}, 1),  # a pass takes 9 steps
        ({"strategy.sparse_updates": False}, 0),
        pytest.param({"views.two_cameras": True, "views.batch_size": 2}, 3, marks=pytest.mark.slow),
        pytest.param({"views.interpolation_fraction": 0.5}, 3, marks=pytest.mark.slow),
        pytest.param({"compositing": "sum"}, 3, marks=pytest.mark.slow),
        pytest.param({"strategy.growth": Growth()}, 0, marks=pytest.mark.slow),
        ({"rates": LearningRates(color_dc=1e5)}, 0),  # it diverges
    ],
)
@pytest.mark.filterwarnings("ignore::foldgauss.video.DivergenceWarning")
def test_when_gaussians_are_relocated(changes, times, monkeypatch):
    """At the stated fractions of the plan, after a pass at least, in fits that converge."""
    config, steps, whole = CONFIG.replace(**changes), [], Relocation.apply
    spy = lambda self, state: steps.append(state.step) or whole(self, state)  # noqa: E731
    monkeypatch.setattr(Relocation, "apply", spy)
    model = fit(FRAMES, config).model
    expected = [round(fraction * config.steps) for fraction in RELOCATED_AT]
    assert steps == expected[len(expected) - times :]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model.splats))


def test_minutes_relocate_three_times_whatever_the_plan(monkeypatch):
    """Where the plan is corrected, each fraction of it is passed once."""
    steps, whole, now = [], Relocation.apply, [0.0]
    spy = lambda self, state: steps.append(state.step) or whole(self, state)  # noqa: E731
    monkeypatch.setattr(Relocation, "apply", spy)

    def clock() -> float:
        now[0] += 0.006 if 0.5 < now[0] < 2.0 else 0.018
        return now[0]

    config = dataclasses.replace(CONFIG, steps=None, minutes=6 / 60)
    for state, info in fit_steps(FRAMES, config, clock=clock):
        pass
    assert info.stopped_by == "minutes"
    assert len(steps) == 3
    assert 0.1 < steps[0] / state.step < steps[1] / state.step < steps[2] / state.step < 0.7


@pytest.mark.slow
def test_relocation_finds_what_the_start_missed():
    """Colored rectangles flash in one frame: moved Gaussians improve it by 2 to 3 dB."""
    frames, rng = moving_blobs(), np.random.default_rng(0)
    frames[4, 8:40, 14:50] = rng.integers(0, 255, (4, 3, 3)).astype(np.uint8).repeat(8, 0).repeat(12, 1)
    worst = {}
    for fraction in (0.0, 0.1):
        config = FitConfig(
            num_gaussians=150, steps=600, strategy=Strategy(relocated_fraction=fraction), views=Views(error_fraction=0)
        )
        worst[fraction] = min(evaluate(fit(frames, config).model, frames).psnr)
    assert worst[0.1] > worst[0.0] + 1


# ------------------------------------------------------------------------------------------- views by error


def all_views(config: FitConfig, errors: np.ndarray, steps: int) -> np.ndarray:
    return np.concatenate([choose_views(config, len(errors), step, errors) for step in range(steps)])


@pytest.mark.parametrize("batch_size", [1, 3])
def test_views_are_drawn_by_error(batch_size):
    """Shares of views: 0.7 / 5 for each frame in turn, and 0.3 in proportion to the errors, within 4 sigma."""
    config, errors = FitConfig(num_gaussians=20, views=Views(batch_size=batch_size)), np.array([1, 2, 3, 4, 90.0])
    views = all_views(config, errors, 4000 // batch_size)
    by_error = errors / errors.sum()
    got = np.bincount(views, minlength=5) / len(views)
    assert (np.abs(got - (0.7 / 5 + 0.3 * by_error)) < 4 * np.sqrt(0.3 * by_error / len(views)) + 2e-3).all()
    np.testing.assert_array_equal(all_views(config, errors, 40), all_views(config, errors, 40))


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.3, 0.75])
@pytest.mark.parametrize("two_cameras", [False, True])
@pytest.mark.parametrize("batch_size", [1, 3])
def test_every_pass_sees_all_views(fraction, two_cameras, batch_size):
    """In any `steps_per_pass` steps from a pass's beginning, whatever the errors."""
    config = FitConfig(
        num_gaussians=20, views=Views(error_fraction=fraction, two_cameras=two_cameras, batch_size=batch_size)
    )
    errors, length = np.array([1e-9] * 6 + [1.0]), steps_per_pass(config, 7)
    views = all_views(config, errors, length)
    assert set(views) == set(range(14 if two_cameras else 7))
    assert len(views) <= (14 if two_cameras else 7) / (1 - fraction) + batch_size + 1


def test_views_by_error_are_of_both_cameras():
    config = FitConfig(num_gaussians=20, views=Views(two_cameras=True, error_fraction=0.9))
    counts = np.bincount(all_views(config, np.array([1e-9, 1.0]), 400), minlength=4)
    assert min(counts[1], counts[3]) > 120
    assert max(counts[0], counts[2]) < 30


@pytest.mark.parametrize("unknown", [0.0, np.nan, pytest.param(np.inf, marks=pytest.mark.slow)])
def test_frames_without_an_error_count_as_average(unknown):
    config = FitConfig(num_gaussians=20, views=Views(error_fraction=0.9))
    views = all_views(config, np.array([unknown, 1.0, 3.0, unknown]), 2000)
    got = np.bincount(views, minlength=4) / len(views)
    np.testing.assert_allclose(got, 0.025 + 0.9 * np.array([2, 1, 3, 2]) / 8, atol=0.04)
    assert len(all_views(config, np.full(4, unknown), 20)) == 20


# ------------------------------------------------------------------------------------------ learning rates


def test_rates_cool_down():
    """As without a cooldown until it begins, continuous there, and almost 0 at the end."""
    warm, cool = (FitConfig(rates=LearningRates(final=0.25, cooldown=part)) for part in (0.0, 0.2))
    for progress, factor in [(0.0, 1), (0.5, 1), (0.7999, 1), (0.9, COLD + 0.5 * (1 - COLD)), (1.0, COLD)]:
        got, whole = (learning_rates(config, progress, 0)[0] for config in (cool, warm))
        np.testing.assert_allclose(got, factor * whole, rtol=1e-6 if factor == 1 else 1e-5)
