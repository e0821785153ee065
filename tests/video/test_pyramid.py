"""Coarse to fine: which steps use frames of which size, step planning by level, and sum compositing."""

import dataclasses

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.video import Economy, FitConfig, evaluate, fit, fit_steps
from foldgauss.video.fitting import budget
from foldgauss.video.fitting import loop as fit_module
from foldgauss.video.fitting.loop import start, to_model
from foldgauss.video.fitting.schedule import Level, find_level, plan_levels, shrink_frame, work_after
from foldgauss.video.fitting.steppers import cpu_stepper

HALF = FitConfig(num_gaussians=800, steps=60, quarter_fraction=0.0, half_fraction=0.5)


def test_too_small_level_gives_its_fraction_to_the_next():
    config = FitConfig(quarter_fraction=0.15, half_fraction=0.25)
    assert [(round(share, 6), size) for share, size in plan_levels(config, (640, 1280))] == [
        (0.15, (160, 320)),
        (0.25, (320, 640)),
        (0.6, (640, 1280)),
    ]
    assert [(round(share, 6), size) for share, size in plan_levels(config, (272, 640))] == [
        (0.4, (136, 320)),
        (0.6, (272, 640)),
    ]
    assert plan_levels(config, (160, 320)) == [(1.0, (160, 320))]
    assert plan_levels(dataclasses.replace(config, half_fraction=0.0), (640, 1280))[0].size == (160, 320)
    assert [size for _, size in plan_levels(config, (481, 853))] == [(120, 213), (240, 426), (481, 853)]


def test_progress_determines_the_level():
    made = plan_levels(FitConfig(quarter_fraction=0.25, half_fraction=0.25), (640, 1280))
    assert [find_level(made, k / 8) for k in range(9)] == [0, 0, 1, 1, 2, 2, 2, 2, 2]
    assert find_level(plan_levels(FitConfig(quarter_fraction=0.5, half_fraction=0.5), (640, 1280)), 1.0) == 2


def test_shrunk_pixel_is_the_mean_of_its_area():
    frame = np.random.default_rng(0).integers(0, 256, (8, 12, 3), np.uint8)
    mean = frame.reshape(4, 2, 6, 2, 3).mean((1, 3))
    assert np.abs(shrink_frame(frame, (4, 6)) - mean).max() <= 0.5
    assert shrink_frame(frame, (8, 12)) is frame


@pytest.fixture
def small(monkeypatch):
    """Levels for clips of a few dozen pixels; only the fit's own steps."""
    monkeypatch.setattr("foldgauss.video.fitting.schedule.MIN_SIDE", 8)
    monkeypatch.setattr(fit_module, "_warm_up", lambda *given: None)  # spies would see it


def test_steps_use_the_size_of_their_level(small, monkeypatch):
    frames, sizes, forward = moving_blobs(), [], cpu_stepper.cpu.forward
    monkeypatch.setattr(cpu_stepper.cpu, "forward", lambda *a, **k: sizes.append(a[5]) or forward(*a, **k))
    fit(frames, dataclasses.replace(HALF, relocated_fraction=0))
    full = frames.shape[1:3]
    before = [full] * len(frames)  # how good the start is
    assert sizes == before + [tuple(n // 2 for n in full)] * 30 + [full] * 30


@pytest.mark.parametrize("size", [(24, 40), (25, 41)])
def test_levels_neither_shift_nor_scale_the_model(small, size):
    """Fitted at half size alone, it is right at full size, too: nothing is shifted or scaled."""
    frames = moving_blobs(height=size[0], width=size[1])
    config = dataclasses.replace(HALF, steps=300, half_fraction=1.0)
    model = fit(frames, config).model
    assert evaluate(model, frames).mean_psnr > 28
    shifted = np.roll(frames, 1, axis=2)
    assert evaluate(model, shifted).mean_psnr < evaluate(model, frames).mean_psnr - 2


LEVELS = [Level(0.5, (24, 32)), Level(0.5, (48, 64))]


def run_by_clock(config, levels, seconds_of, num_frames=6, until=None):
    """A fit whose steps take `seconds_of(state, level)`: its state, and (step, progress) after every step."""
    planner, state, course = budget.StepPlanner(config, levels, num_frames), start(moving_blobs(), config), []
    state.plan, state.step, state.seconds = 0, 0, 0.0
    while not state.plan or state.step < state.plan:
        level = budget.next_level(state, config, levels)
        state.step += 1
        state.seconds += seconds_of(state, level)
        planner.update(state, level)
        course.append((state.step, budget.measure_progress(state, config)))
        if until is not None and until(state):
            break
    return state, course


def test_minutes_are_planned_by_the_speed_of_all_levels():
    """Steps of 0.1 s at half and 0.4 s at full size, measured in turn, fill the time together."""
    config = dataclasses.replace(HALF, steps=None, minutes=100 / 60)
    state, _ = run_by_clock(config, LEVELS, lambda state, level: (0.1, 0.4)[level])
    assert state.seconds == pytest.approx(100, rel=0.01)


@pytest.mark.parametrize(("early", "late", "until"), [(3.0, 1.0, 30), (1.0, 3.0, 30), (4.0, 1.0, 65)])
def test_minutes_are_used_up_whatever_the_machine_does(early, late, until):
    """The machine is busy at first, or later: the plan is corrected, and progress never falls, jumps or stops short."""
    config = dataclasses.replace(HALF, steps=None, minutes=100 / 60)
    pace = lambda state, level: 0.05 * (early if state.seconds < until else late)  # noqa: E731
    state, course = run_by_clock(config, [Level(1.0, (48, 64))], pace)
    assert state.seconds == pytest.approx(100, rel=0.02)
    progress = np.array([done for _, done in course])
    moved = np.diff(progress[progress > 0])
    assert progress[-1] == 1
    assert (moved[1:] > 0).all()
    assert moved.max() < 0.1  # at the first plan, which counts the steps before it; afterwards it is smooth


def test_a_resumed_fit_keeps_its_plan():
    """Stopped between two times of planning and continued by a new planner: as if uninterrupted."""
    config = dataclasses.replace(HALF, steps=None, minutes=100 / 60)
    stopped, _ = run_by_clock(config, LEVELS, lambda state, level: 0.2, until=lambda state: state.seconds > 50)
    plan, course = stopped.plan, (stopped.planned_step, stopped.planned_progress)
    planner = budget.StepPlanner(config, LEVELS, 6)
    for _ in range(20):  # 54 s
        stopped.step += 1
        stopped.seconds += 0.2
        planner.update(stopped, 1)
    assert (stopped.plan, stopped.planned_step, stopped.planned_progress) == (plan, *course)


def test_minutes_include_rounds_of_pruning():
    """Ten seconds at 0.01 s a step: an eighth of it goes to two rounds over six frames, at most."""
    plans = []
    for economy in (None, Economy(rounds=2)):
        config = FitConfig(num_gaussians=50, minutes=10 / 60, economy=economy)
        planned = lambda state: state.plan > 0  # noqa: E731
        state, _ = run_by_clock(config, [Level(1.0, (48, 64))], lambda state, level: 0.01, until=planned)
        plans.append(state.plan)
    plain, economical = plans
    rounds = budget.STEPS_PER_ROUND * 2 * 6
    assert economical == pytest.approx(plain / budget.BIRTH_SLOWDOWN - rounds, rel=0.05)


def test_resuming_at_a_coarse_level_keeps_the_bits(small, tmp_path):
    frames = moving_blobs()
    *_, (whole, _) = fit_steps(frames, HALF)
    rows = whole.rows.copy()
    for state, info in fit_steps(frames, HALF):
        if info.step == 20:
            break
    save_checkpoint(tmp_path / "kept", state, config=HALF, source={})
    *_, (again, _) = fit_steps(frames, HALF, load_checkpoint(tmp_path / "kept", config=HALF, source={}))
    np.testing.assert_array_equal(again.rows, rows)


def test_target_psnr_is_evaluated_at_full_size(small):
    frames = moving_blobs()
    config = dataclasses.replace(HALF, steps=400, target_psnr=5.0, error_fraction=0)
    assert [level.size for level in plan_levels(config, (48, 64))] == [(48, 64)]
    *_, (_, last) = fit_steps(frames, config)
    assert (last.stopped_by, last.step) == ("target_psnr", 4 * len(frames))


def test_running_psnr_is_that_of_the_frames_as_last_seen(small):
    """After a pass at full size nothing of the errors at half the size is left."""
    frames, errors = moving_blobs(), {}
    for state, info in fit_steps(frames, dataclasses.replace(HALF, relocated_fraction=0, error_fraction=0)):
        errors[info.step] = state.frame_errors.copy()
        seen = state.frame_errors[state.frame_errors > 0]
        assert info.psnr == pytest.approx(-10 * np.log10(seen.mean()), rel=1e-6)
    assert (errors[35] == errors[30]).sum() == 1
    assert (errors[36] != errors[30]).all()


def test_work_is_proportional_to_area():
    made = plan_levels(FitConfig(quarter_fraction=0.0, half_fraction=0.5), (640, 1280))
    whole = work_after(made, 0.0)
    assert whole == pytest.approx(0.5 * 0.25 + 0.5)
    assert work_after(made, 0.5) == pytest.approx(0.8 * whole)
    assert work_after(made, 0.75) == pytest.approx(0.4 * whole)
    assert work_after(made, 1.0) == 0


@pytest.mark.parametrize("steps", [12, 300])
def test_ample_minutes_change_nothing(small, steps):
    """Rates fall and frames grow, although the pace is measured first."""
    frames = moving_blobs()
    config = dataclasses.replace(HALF, steps=steps)
    alone, timed = (
        [info for _, info in fit_steps(frames, dataclasses.replace(config, minutes=minutes))]
        for minutes in (None, 60.0)
    )
    assert [info.step for info in timed] == [info.step for info in alone]
    assert [info.stopped_by for info in timed] == [info.stopped_by for info in alone]
    if steps == 300:
        assert abs(timed[-1].psnr - alone[-1].psnr) < 1


def test_sums_are_fitted_and_rendered_as_sums(tmp_path):
    frames = moving_blobs()
    config = FitConfig(num_gaussians=800, steps=300, compositing="sum")
    model = fit(frames, config).model
    assert model.compositing == "sum"
    assert evaluate(model, frames).mean_psnr > 30
    over = dataclasses.replace(model, compositing="over")
    assert evaluate(over, frames).mean_psnr < 28
    np.testing.assert_allclose(
        np.clip(np.asarray(model.render(0.5)) * 255, 0, 255), next(iter(model.frames(np.array([0.5])))), atol=1.01
    )
    order = np.random.default_rng(0).permutation(800)
    state = start(frames, config)
    shuffled = dataclasses.replace(state, rows=state.rows[order])
    one, other = (np.asarray(to_model(each, config, frames.shape[1:3], 25.0).render(0.3)) for each in (state, shuffled))
    np.testing.assert_allclose(one, other, atol=1e-5)


def test_sums_are_rendered_over_black_only():
    model = to_model(start(moving_blobs(), HALF), dataclasses.replace(HALF, compositing="sum"), (48, 64), 25.0)
    for draw in (lambda: model.render(0.5, background=(1, 1, 1)), lambda: next(model.frames(background=(1, 1, 1)))):
        with pytest.raises(ValueError, match=r"^background: expected black for a model fitted with compositing 'sum'"):
            draw()


def test_sums_cannot_have_alpha():
    frames = np.zeros((3, 8, 8, 4), np.uint8)
    with pytest.raises(ValueError, match=r"^compositing: expected 'over' for frames with alpha, got 'sum'"):
        next(fit_steps(frames, FitConfig(compositing="sum")))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"half_fraction": -0.1}, r"^half_fraction: expected a number in \[0, 1\]"),
        (
            {"half_fraction": 0.7, "quarter_fraction": 0.7},
            "^quarter_fraction, half_fraction: expected at most 1 together",
        ),
        ({"compositing": "under"}, "^compositing: expected one of 'over', 'sum'"),
    ],
)
def test_bad_settings(changes, message):
    with pytest.raises(ValueError, match=message):
        FitConfig(**changes)
