"""Budgets of a fit: minutes planned as steps by the measured speed, and the PSNR while it runs."""

import dataclasses

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.video import FitConfig, fit_steps
from foldgauss.video.fitting import budget
from foldgauss.video.fitting.loop import start

CONFIG = FitConfig(num_gaussians=800, steps=60)
TIMED = dataclasses.replace(CONFIG, steps=None, minutes=100 / 60)


def run_by_clock(config, seconds_of, until=None):
    """A fit whose steps take `seconds_of(state)`: its state, and (step, progress) after every step."""
    planner, state, course = budget.StepPlanner(config), start(moving_blobs(), config), []
    state.plan, state.step, state.seconds = 0, 0, 0.0
    while not state.plan or state.step < state.plan:
        state.step += 1
        state.seconds += seconds_of(state)
        planner.update(state)
        course.append((state.step, budget.measure_progress(state, config)))
        if until is not None and until(state):
            break
    return state, course


@pytest.mark.parametrize(("early", "late", "until"), [(3.0, 1.0, 30), (1.0, 3.0, 30), (4.0, 1.0, 65)])
def test_minutes_are_used_up_whatever_the_machine_does(early, late, until):
    """The machine is busy at first, or later: the plan is corrected, and progress never falls, jumps or stops short."""
    state, course = run_by_clock(TIMED, lambda state: 0.05 * (early if state.seconds < until else late))
    assert state.seconds == pytest.approx(100, rel=0.02)
    progress = np.array([done for _, done in course])
    moved = np.diff(progress[progress > 0])
    assert progress[-1] == 1
    assert (moved[1:] > 0).all()
    assert moved.max() < 0.1  # at the first plan, which counts the steps before it; afterwards it is smooth


def test_a_resumed_fit_keeps_its_plan():
    """Stopped between two times of planning and continued by a new planner: as if uninterrupted."""
    stopped, _ = run_by_clock(TIMED, lambda state: 0.2, until=lambda state: state.seconds > 50)
    plan, course = stopped.plan, (stopped.planned_step, stopped.planned_progress)
    planner = budget.StepPlanner(TIMED)
    for _ in range(20):  # 54 s
        stopped.step += 1
        stopped.seconds += 0.2
        planner.update(stopped)
    assert (stopped.plan, stopped.planned_step, stopped.planned_progress) == (plan, *course)


def test_the_time_left_is_that_of_the_steps_left():
    """By the speed since the first steps, which are slow; at most what is left of the minutes."""
    state = start(moving_blobs(), CONFIG)
    left, estimates = budget.TimeLeft(state, CONFIG), []
    for state.step in range(1, 61):
        state.seconds += 5.0 if state.step <= budget.WARM_UP else 0.5
        estimates.append(left.estimate(state, state.step / 60))
    assert estimates[: budget.WARM_UP] == [np.inf] * budget.WARM_UP
    np.testing.assert_allclose(estimates[budget.WARM_UP :], 0.5 * np.arange(54, -1, -1), atol=1e-9)
    assert budget.TimeLeft(state, TIMED).estimate(state, 0.5) == 100 - state.seconds


def test_running_psnr_is_that_of_the_frames_as_last_seen():
    for state, info in fit_steps(moving_blobs(), CONFIG):
        seen = state.frame_errors[state.frame_errors > 0]
        assert info.psnr == pytest.approx(-10 * np.log10(seen.mean()), rel=1e-6)


@pytest.mark.parametrize("steps", [12, 100])
def test_ample_minutes_change_nothing(steps):
    """Rates fall although the pace is measured first."""
    frames = moving_blobs()
    config = dataclasses.replace(CONFIG, num_gaussians=300, steps=steps)
    alone, timed = (
        [info for _, info in fit_steps(frames, dataclasses.replace(config, minutes=minutes))]
        for minutes in (None, 60.0)
    )
    assert [info.step for info in timed] == [info.step for info in alone]
    assert [info.stopped_by for info in timed] == [info.stopped_by for info in alone]
    if steps == 100:
        assert abs(timed[-1].psnr - alone[-1].psnr) < 1
