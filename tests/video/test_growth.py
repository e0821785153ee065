"""Densification: each criterion clones, splits, prunes or resets the Gaussians that meet it, and no others."""

import dataclasses

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.video import FitConfig, Loss, Strategy, Views, fit_steps
from foldgauss.video.fitting.budget import StepPlanner
from foldgauss.video.fitting.config import EXTENT, PUBLISHED_STEPS, Growth, chosen_num_gaussians
from foldgauss.video.fitting.densify import densify, reset_opacities
from foldgauss.video.fitting.loop import start
from foldgauss.video.fitting.schedule import choose_views
from foldgauss.video.fitting.state import GradientStatistics
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.models.row_layout import columns

DEGREE, PLACE = 2, columns(2)
GROWTH = Growth()
PIXELS = 100.0
SMALL, LARGE = 0.5 * GROWTH.clone_below, 2 * GROWTH.clone_below


def gaussians(num=5, scale=SMALL, opacity_logit=1.0):
    rows = np.random.default_rng(0).normal(size=(num, 11 + 2 * DEGREE)).astype(np.float32)
    rows[:, PLACE["log_scale"]] = np.log(scale)
    rows[:, PLACE["log_time_scale"]] = np.log(0.1)
    rows[:, PLACE["opacity_logit"]] = opacity_logit
    return rows


def statistics(num=5, screen=(), time=(), steps=4):
    """Means over `steps` steps: for the named Gaussians as given, 0 for others."""
    sums = GradientStatistics(*np.zeros((2, num), np.float32), np.zeros(num, np.int32))
    for part, means in ((sums.screen, screen), (sums.time, time)):
        for index, mean in dict(means).items():
            part[index] = steps * mean
    sums.seen[:] = steps
    return sums


def change(rows, sums, *, growth=GROWTH, max_num=1000, step=600, seed=0):
    return densify(rows, sums, growth, degree=DEGREE, pixels=PIXELS, max_num=max_num, step=step, seed=seed)


EVERYBODY = [SMALL] * 5
WIDE, MIXED = [LARGE] * 5, [SMALL, SMALL, [SMALL, LARGE], SMALL, SMALL]
#: Scales, lifetime, mean gradients, who is cloned, who is split.
CRITERIA = {
    "below the thresholds": (EVERYBODY, 0.1, {"screen": {1: 1.9e-4}, "time": {2: 1.9e-4}}, [], []),
    "small, on the screen": (EVERYBODY, 0.1, {"screen": {3: 2.1e-4}}, [3], []),
    "wide, on the screen": (WIDE, 0.9, {"screen": {1: 2.1e-4}}, [], [1]),
    "wide along one axis": (MIXED, 0.1, {"screen": {2: 1e-3}}, [], [2]),
    "no longer than the clip, in time": (WIDE, 0.1, {"time": {3: 2.1e-4}}, [3], []),
    "longer than the clip, in time": (WIDE, 1.1, {"time": {1: 2.1e-4}}, [], [1]),
    "both": (WIDE, 0.1, {"screen": {2: 3e-4}, "time": {2: 3e-4}}, [2], [2]),
}


@pytest.mark.parametrize("name", CRITERIA)
def test_criteria_clone_and_split(name):
    """By the screen gradient those that are small or wide, by the time gradient those that live short or long."""
    scales, lifetime, means, cloned, split = CRITERIA[name]
    rows = gaussians()
    for row, scale in zip(rows, scales, strict=True):
        row[PLACE["log_scale"]] = np.log(scale)
    rows[:, PLACE["log_time_scale"]] = np.log(lifetime)
    stay, born = change(rows, statistics(**means))
    assert stay.tolist() == [k for k in range(5) if k not in split]
    np.testing.assert_array_equal(born[: len(cloned)], rows[cloned])
    halves, parents = born[len(cloned) :], rows[split * 2]
    np.testing.assert_allclose(halves[:, PLACE["log_scale"]], parents[:, PLACE["log_scale"]] - np.log(1.6), atol=1e-5)
    others = [c for name in PLACE if name not in ("loc", "log_scale") for c in range(*PLACE[name].indices(99))]
    np.testing.assert_array_equal(halves[:, others], parents[:, others])
    assert len(np.unique(halves[:, PLACE["loc"]], axis=0)) == 2 * len(split)


def test_halves_are_drawn_from_their_parent():
    """Many halves of one Gaussian: their covariance is the parent's, turned as it is."""
    num, angle, scales = 20_000, 0.7, np.array([0.1, 0.06])
    rows = np.repeat(gaussians(1), num, axis=0)
    share = angle / (2 * np.pi)
    rows[:, PLACE["angle_logit"]] = np.log(share / (1 - share))
    rows[:, PLACE["log_scale"]] = np.log(scales)
    _, born = change(rows, statistics(num, screen=dict.fromkeys(range(num), 1.0)), max_num=10**6)
    away = born[:, PLACE["loc"]] - rows[0, PLACE["loc"]]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = turn @ np.diag(scales**2) @ turn.T
    # Standard error of a covariance of 40,000: 1 / sqrt(20,000) of it; five of them.
    np.testing.assert_allclose(np.cov(away.T), expected, atol=5 * scales[0] ** 2 / np.sqrt(num))
    np.testing.assert_allclose(away.mean(0), 0, atol=5 * scales[0] / np.sqrt(2 * num))


def test_gradients_are_averaged_over_steps_in_which_it_was_seen():
    sums = GradientStatistics(*np.zeros((2, 3), np.float32), np.zeros(3, np.int32))
    by_time = np.float32([-4e-4, 4e-4, 0])
    sums.add(np.float32([3e-4, -1, -1]), by_time)
    sums.add(np.float32([1e-4, -1, 7e-4]), -by_time)
    np.testing.assert_allclose(sums.screen, [4e-4, 0, 7e-4], rtol=1e-5)
    np.testing.assert_allclose(sums.time, [8e-4, 0, 0], rtol=1e-5)  # signs do not cancel; unseen, nothing counts
    assert sums.seen.tolist() == [2, 0, 1]
    _, born = change(gaussians(3), sums)
    assert len(born) == 2  # 0 by 4e-4 / 2 of the screen's and by time's 4e-4; 2 by 7e-4 / 1


def test_faint_gaussians_are_pruned():
    rows = gaussians()
    rows[[1, 4], PLACE["opacity_logit"]] = np.log(0.0099 / 0.9901)
    rows[2, PLACE["opacity_logit"]] = np.log(0.0101 / 0.9899)
    stay, born = change(rows, statistics(screen={1: 1.0}))
    assert stay.tolist() == [0, 2, 3]
    assert len(born) == 0  # its clone is as faint


def test_big_gaussians_are_pruned_late():
    rows = gaussians()
    rows[0, PLACE["log_scale"]] = np.log([SMALL, 1.01 * 0.1 * EXTENT])
    rows[1, PLACE["log_scale"]] = np.log([SMALL, 1.01 * 20 / 3 / PIXELS])
    rows[2, PLACE["log_scale"]] = np.log([SMALL, 0.99 * 20 / 3 / PIXELS])
    assert change(rows, statistics(), step=3000)[0].tolist() == [0, 1, 2, 3, 4]
    assert change(rows, statistics(), step=3100)[0].tolist() == [1, 2, 3, 4]
    narrow = dataclasses.replace(GROWTH, prune_radius=20.0)
    assert change(rows, statistics(), step=3000, growth=narrow)[0].tolist() == [0, 1, 2, 3, 4]
    assert change(rows, statistics(), step=3100, growth=narrow)[0].tolist() == [2, 3, 4]


def test_largest_gradients_come_first_at_the_limit():
    rows = gaussians(6)
    rows[4, PLACE["log_scale"]] = np.log(LARGE)
    wanted = statistics(6, screen={0: 3e-4, 2: 9e-4, 4: 8e-4}, time={3: 5e-4})
    stay, born = change(rows, wanted, max_num=8)
    assert stay.tolist() == [0, 1, 2, 3, 5]
    assert len(stay) + len(born) == 8
    np.testing.assert_array_equal(born[0], rows[2])
    for most in (6, 3):  # full, or more than full
        assert len(change(rows, wanted, max_num=most)[1]) == 0


def test_one_gaussian_always_stays():
    rows = gaussians(opacity_logit=-9.0)
    rows[3, PLACE["opacity_logit"]] = -8
    assert change(rows, statistics())[0].tolist() == [3]


def test_halves_depend_on_seed_and_step_alone():
    def born(**options):
        return change(gaussians(scale=LARGE), statistics(screen={1: 1.0}), **options)[1]

    np.testing.assert_array_equal(born(), born())
    assert not np.array_equal(born(), born(seed=1))
    assert not np.array_equal(born(), born(step=700))


def test_reset_lowers_opacities_and_clears_moments():
    rows, moments = gaussians(), [np.ones((5, 11 + 2 * DEGREE), np.float32) for _ in range(2)]
    rows[2, PLACE["opacity_logit"]] = -7
    before = rows.copy()
    reset_opacities(rows, *moments, GROWTH, DEGREE)
    opacity = 1 / (1 + np.exp(-rows[:, PLACE["opacity_logit"]][:, 0]))
    np.testing.assert_allclose(opacity, [0.01, 0.01, 1 / (1 + np.exp(7)), 0.01, 0.01], rtol=1e-4)
    before[:, PLACE["opacity_logit"]] = rows[:, PLACE["opacity_logit"]]
    np.testing.assert_array_equal(before, rows)
    for part in moments:
        assert (part[:, PLACE["opacity_logit"]] == 0).all()
        assert part.sum() == part.size - 5
    rows = rows[rows[:, PLACE["opacity_logit"]][:, 0] > -6]
    assert len(change(rows, statistics(len(rows)))[0]) == len(rows)  # those reset are not at once too faint


def test_the_published_schedule():
    growth = GROWTH.for_plan(PUBLISHED_STEPS)
    assert growth == GROWTH
    grows = [step for step in range(1, 30_001) if growth.grows_at(step)]
    assert (grows[0], grows[-1], len(grows)) == (600, 14_900, 144)
    assert [step for step in range(1, 30_001) if growth.resets_at(step)] == [3000, 6000, 9000, 12_000]


def test_the_schedule_scales_with_the_plan():
    tenth = GROWTH.for_plan(3000)
    assert [getattr(tenth, name) for name in ("from_step", "until_step", "every", "big_from", "reset_every")] == [
        50,
        1500,
        10,
        300,
        300,
    ]
    double = GROWTH.for_plan(60_000)
    assert (double.from_step, double.every, double.reset_every) == (1000, 200, 6000)
    short = GROWTH.for_plan(300)  # means over 10 steps still; no reset from which there is no way back
    assert (short.until_step, short.every, short.reset_every) == (150, 10, 200)


@pytest.mark.parametrize(
    "changes",
    [
        {"from_step": -1},
        {"until_step": 1.5},
        {"every": 0},
        {"reset_every": 0},
        {"big_from": True},
        {"screen_gradient": 0.0},
        {"time_gradient": float("nan")},
        {"clone_below": "1"},
        {"shrinking": 0.5},
        {"prune_opacity": 1.0},
        {"prune_radius": 0},
        {"prune_scale": -1},
        {"reset_opacity": 0.001},
    ],
    ids=str,
)
def test_bad_growth(changes):
    with pytest.raises(ValueError, match=rf"growth\.{next(iter(changes))}: expected"):
        Growth(**changes)


# ------------------------------------------------------------------------------------------------ in a fit

FRAMES = moving_blobs(5, 24, 40)
#: Every birth and reset within 60 steps; thresholds that a small clip reaches.
QUICK = Growth(
    from_step=1,
    until_step=45,
    every=10,
    screen_gradient=1e-3,
    time_gradient=1.0,
    clone_below=0.05,
    big_from=25,
    prune_scale=10.0,
    reset_every=20,
)
CONFIG = FitConfig(num_gaussians=150, steps=60, degree=2, views=Views(batch_size=2), strategy=Strategy(growth=QUICK))


@pytest.fixture
def unscaled(monkeypatch):
    """Steps of the schedule as they stand."""
    monkeypatch.setattr(Growth, "for_plan", lambda self, plan: self)


def grown_numbers(config):
    """Numbers of Gaussians by step."""
    return [info.num_gaussians for _, info in fit_steps(FRAMES, config)]


@pytest.mark.usefixtures("unscaled")
def test_births_and_resets_are_on_schedule():
    numbers, highest = [], []
    for state, info in fit_steps(FRAMES, CONFIG):
        numbers.append(info.num_gaussians)
        highest.append(state.rows[:, PLACE["opacity_logit"]].max())
    assert set(np.flatnonzero(np.diff(numbers)) + 2) <= {10, 20, 30, 40}
    assert numbers[-1] > 200
    assert state.statistics is None
    assert (state.counts == 60).sum() < len(state.counts)
    for step in (20, 40):
        assert highest[step - 2] > -4
        assert highest[step - 1] == pytest.approx(np.log(0.01 / 0.99), rel=1e-5)
    assert highest[59] > highest[39] + 0.3
    assert max(grown_numbers(dataclasses.replace(CONFIG, max_gaussians=170))) == 170


@pytest.mark.usefixtures("unscaled")
@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["screen_gradient", "time_gradient"])
def test_either_gradient_alone_densifies(criterion):
    off = {"screen_gradient": 1e9, "time_gradient": 1e9, "reset_every": 1000}
    growth = dataclasses.replace(QUICK, **off)
    assert max(grown_numbers(CONFIG.replace(**{"strategy.growth": growth}))) == 150
    on = dataclasses.replace(growth, **{criterion: 1e-5})
    assert max(grown_numbers(CONFIG.replace(**{"strategy.growth": on}))) > 200


def test_limits_bound_the_start():
    config = FitConfig(num_gaussians=500, max_gaussians=300)
    assert chosen_num_gaussians(config, 5, 24, 40) == 300
    by_size = dataclasses.replace(config, num_gaussians=None, size_mb=1e-4)
    assert chosen_num_gaussians(by_size, 5, 24, 40) == 100
    assert chosen_num_gaussians(dataclasses.replace(config, max_gaussians=None), 5, 24, 40) == 500
    assert len(start(FRAMES, config).rows) == 300


def test_screen_gradient_is_in_units_of_half_the_image():
    """Against finite differences: the loss as one Gaussian's mean moves by a share of half the picture."""
    config = FitConfig(
        num_gaussians=1,
        degree=0,
        seed=3,
        loss=Loss(ssim_fraction=0.0, border_weight=1.0),
        strategy=Strategy(growth=Growth()),
        initialization="static",
    )
    frames = moving_blobs(2, 24, 40)

    def stepper_of(state):
        return CpuStepper(frames, config, state)

    state = start(frames, config)
    state.rows[:, PLACE["log_scale"]] = np.log(0.1)
    state.rows[:, PLACE["log_time_scale"]] = 1.0
    unit, k = 40.0, choose_views(config, len(frames), 0, np.zeros(len(frames)))[0]

    def loss(dx, dy):
        rows = state.rows.copy()
        rows[0, PLACE["loc"]] += np.float32([dx * 20 / unit, dy * 12 / unit])
        step = stepper_of(state)
        moved = dataclasses.replace(state, rows=rows)
        options = {"squared": False, "mirrored": False, "screen": None, "fraction": None}
        return step._differentiate(moved, k, np.float32(k), step.spec, None, **options)[0].value

    small = 0.02
    slope = [(loss(small, 0) - loss(-small, 0)) / (2 * small), (loss(0, small) - loss(0, -small)) / (2 * small)]
    stepper_of(state).step(state, 0.0)
    assert state.statistics.seen.tolist() == [1]
    assert state.statistics.screen[0] == pytest.approx(np.hypot(*slope), rel=0.05)


def test_gaussians_outside_the_image_are_not_seen():
    config = CONFIG.replace(**{"strategy.growth": Growth()}, initialization="uniform")
    state = start(FRAMES, config)
    state.rows[:, PLACE["coefficients"]] = 0
    state.rows[:, PLACE["log_time_scale"]] = 1.0
    state.rows[:5, PLACE["loc"]] = 3.0
    assert CpuStepper(FRAMES, config, state).step(state, 0.0).num_alive == 150
    assert state.statistics.seen[:5].tolist() == [0] * 5
    assert state.statistics.seen[5:].mean() > 0.8


def test_growth_waits_for_the_plan():
    """By minutes, the pace is measured first; the schedule is that of the plan."""
    growth = dataclasses.replace(QUICK, from_step=0, every=1, until_step=PUBLISHED_STEPS, reset_every=PUBLISHED_STEPS)
    config = CONFIG.replace(steps=None, minutes=0.02, **{"strategy.growth": growth})
    without = 0
    for state, info in fit_steps(FRAMES, config):
        without += not state.plan
        if info.num_gaussians != 150:
            break
        assert state.statistics.seen.max() > info.step / 2  # gradients count from the first step on
    assert without > 10
    assert state.plan > 0
    assert info.step % 10 == 0  # every = 1 of 30,000 is held at `MIN_EVERY`


def test_minutes_bind_while_gaussians_grow(monkeypatch):
    """The pace at the start says nothing of ten times as many."""
    config = FitConfig.preset("paper", num_gaussians=20, degree=1, steps=None, minutes=0.01)
    monkeypatch.setattr(StepPlanner, "update", lambda self, state: setattr(state, "plan", 10**6))
    *_, (state, last) = fit_steps(FRAMES, config)
    assert last.stopped_by == "minutes"
    assert state.seconds < 5
