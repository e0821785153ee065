"""The fit on small clips: quality, budgets, reproducible bits, resuming and starts from models."""

import dataclasses
import itertools
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from clips import moving_blobs
from skimage.data import coffee
from skimage.transform import resize
from soft_models import assert_same
from test_optical_flow import panning

from foldgauss._runtime import threads as _threads
from foldgauss.render import RenderOptions
from foldgauss.video import (
    FitConfig,
    LearningRates,
    Loss,
    Views,
    evaluate,
    fit,
    fit_steps,
    interpolated_times,
    psnr,
)
from foldgauss.video.fitting import loop as fit_module
from foldgauss.video.fitting.config import (
    MOST_PER_PIXEL,
    PRESETS,
    TYPICAL_LIFETIME,
    chosen_num_gaussians,
    planned_steps,
)
from foldgauss.video.fitting.loop import start, start_from, to_model
from foldgauss.video.fitting.steppers import cpu_stepper, interpolated_frames
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.fitting.steppers.loss import border_weights
from foldgauss.video.models.conditioning import PreparedModel

CONFIG = FitConfig(num_gaussians=800, steps=60)


def test_learns_a_clip():
    frames = moving_blobs()
    seen = []
    config = dataclasses.replace(CONFIG, steps=300)
    result = fit(frames, config, fps=12.5, observers=[lambda state, info: seen.append(info)])
    assert [info.step for info in seen] == list(range(1, 301))
    assert seen[-1].progress == 1
    assert seen[-1].seconds_left == 0
    assert len(result.history) == 30
    assert result.model.fps == 12.5
    scores = evaluate(result.model, frames)
    assert scores.mean_psnr > 34
    assert scores.mean_ssim > 0.95
    assert abs(result.history[-1].psnr - scores.mean_psnr) < 3  # what the bar says is what comes out


@pytest.mark.parametrize(
    "changes",
    [
        {"degree": 0},
        {"degree": 7},
        {"views.batch_size": 9},  # more than the clip has frames
        {"power": 1.0},
        {"loss.ssim_fraction": 0.0},
        {"rates.frame_times": 0.0},
        {"num_gaussians": 1},
        {"floor": 0.1},
        {"steps": None, "minutes": 0.005},
        {"initialization": "static"},
        {"rates.own_units": False},
        {"views.interpolation_fraction": 0.9, "views.batch_size": 2, "views.two_cameras": True, "psnr": 60.0},
        {"quality": 50.0},
        *(
            pytest.param(changes, marks=pytest.mark.slow)
            for changes in (
                {"views.batch_size": 3},
                {"rates.final": 0.0},
                {"loss.l2_fraction": 1.0},
                {"loss.l2_fraction": 0.0},
                {"views.interpolation_fraction": 0.5},
                {"size_mb": 0.006},
            )
        ),
    ],
    ids=str,
)
def test_every_setting_works(changes):
    frames = moving_blobs(height=33, width=41)
    model = fit(frames, CONFIG.replace(**({"steps": 30} | changes))).model
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
    if changes.get("num_gaussians") != 1:
        assert evaluate(model, frames).mean_psnr > 18


@pytest.mark.slow
def test_borders_of_a_pan():
    """No Gaussian starts beyond the frame, so the outermost pixels are covered from one side, and come out too dark."""
    image = resize(coffee(), (200, 300), anti_aliasing=True)
    picture = np.uint8(np.round(255 * image))
    frames, dark = np.stack([picture[60:108, 40 + 4 * k : 104 + 4 * k] for k in range(12)]), {}
    for weight in (1.0, FitConfig().loss.border_weight):
        model = fit(frames, FitConfig(num_gaussians=900, steps=120, loss=Loss(border_weight=weight))).model
        ends = np.stack(list(model.frames()))[[0, -1]].astype(float) - frames[[0, -1]]
        dark[weight] = -ends[:, border_weights(48, 64, 2.0) == 2].mean()
    assert dark[1.0] > 0.5  # levels
    assert abs(dark[FitConfig().loss.border_weight]) < 0.75 * dark[1.0]


def test_same_bits_for_any_number_of_threads():
    frames, models = moving_blobs(), []
    try:
        for count in (1, 2):
            _threads.set_num_threads(count)
            models.append(fit(frames, dataclasses.replace(CONFIG, num_gaussians=5000, steps=20)).model)
    finally:
        _threads.set_num_threads(None)
    assert_same(*models)


def test_a_frame_twice_in_a_batch_counts_twice(monkeypatch):
    frames, steps, seen = moving_blobs(), [], {}
    for batch in ([1], [1, 1]):
        config = CONFIG.replace(**{"views.batch_size": len(batch)})
        state = start(frames, config)
        monkeypatch.setattr(
            cpu_stepper, "update_frame_times", lambda w, m, by_time, rate: (seen.update(t=by_time) or w, m)
        )
        monkeypatch.setattr(interpolated_frames, "choose_views", lambda *given, batch=batch: np.array(batch))
        CpuStepper(frames, config, state).step(state, 0.0)
        steps.append((seen["t"], state.rows.copy()))
    assert abs(steps[0][0][1]) > 0
    np.testing.assert_allclose(steps[0][0], steps[1][0], rtol=1e-5)
    np.testing.assert_allclose(steps[0][1], steps[1][1], atol=1e-6)


def test_rates_decay():
    """The last step is as much shorter as `rates.final` says."""
    frames, moved = moving_blobs(), {}
    for final_rate in (1.0, 0.01):
        config = CONFIG.replace(**{"rates.final": final_rate})
        before = None
        for state, info in fit_steps(frames, config):
            if info.step == 60:
                moved[final_rate] = np.abs(state.rows - before).mean()
            before = state.rows.copy()
    assert moved[0.01] < 0.1 * moved[1.0]


def test_finished_state_yields_once():
    frames = moving_blobs()
    for state, _ in fit_steps(frames, CONFIG):
        pass
    again = list(fit_steps(frames, CONFIG, state))
    assert len(again) == 1
    assert again[0][1].progress == 1


@pytest.mark.slow
def test_interpolated_frames_are_learned():
    """Frames never seen come out better than without, and what is told is the quality at frames alone."""
    finer = panning(11, (2.0, 1.0), height=48, width=64)
    seen, never = np.ascontiguousarray(finer[::2]), finer[1::2]
    scores = {}
    for share in (0.0, 0.6):
        config = FitConfig(
            num_gaussians=600, steps=300, initialization="static", views=Views(interpolation_fraction=share)
        )
        config = config.replace(**{"views.interpolation_end": 1.0})
        result = fit(seen, config)
        times = interpolated_times(np.asarray(result.model.frame_times.times()), 2)[1::2]
        drawn = list(result.model.frames(times))
        scores[share] = np.mean([psnr(target, made) for target, made in zip(never, drawn, strict=True)])
    assert scores[0.6] > scores[0.0] + 0.5
    assert abs(result.history[-1].psnr - evaluate(result.model, seen).mean_psnr) < 2


def test_interpolation_ends():
    """After its last step, a fit goes on from where it is as one without interpolation would."""
    frames, models = moving_blobs(), []
    config = CONFIG.replace(**{"views.interpolation_fraction": 0.9, "views.interpolation_end": 0.5})
    for state, info in fit_steps(frames, config):
        if info.step == 30:
            break
    for fraction in (0.9, 0.0):
        again = config.replace(**{"views.interpolation_fraction": fraction})
        for last, _ in fit_steps(frames, again, jax.tree.map(np.array, state)):
            pass
        models.append(to_model(last, config, frames.shape[1:3], 25.0))
    assert_same(*models)


@pytest.mark.parametrize(
    ("changes", "alpha", "default"),
    [({}, False, 0.1), ({"initialization": "static"}, False, 0), ({}, True, 0)],
    ids=["motion", "no motion", "alpha"],
)
def test_interpolation_is_on_by_default_where_it_is_supported(changes, alpha, default):
    frames = np.zeros((3, 8, 8, 4 if alpha else 3), np.uint8)
    config = FitConfig().replace(**{"views.error_fraction": 0.0}, **changes)
    motion = SimpleNamespace(cuts=[], find_still=list)
    made = interpolated_frames.make_interpolated(frames, config, lambda: motion)
    assert (made.chance if made else 0) == default
    asked = config.replace(**{"views.interpolation_fraction": 0.2})
    assert interpolated_frames.make_interpolated(frames, asked, lambda: motion).chance == 0.2


def test_still_clip_is_not_interpolated():
    """Between equal frames there is nothing to learn: a fit has the bits of one without interpolation."""
    frames = np.repeat(moving_blobs()[:1], 4, axis=0)
    models = [
        fit(frames, CONFIG.replace(steps=20, **{"views.interpolation_fraction": fraction})).model
        for fraction in (0.5, 0.0)
    ]
    assert_same(*models)


def test_seed_matters():
    frames = moving_blobs()
    one, other = (fit(frames, dataclasses.replace(CONFIG, seed=seed, steps=2)).model for seed in (0, 1))
    assert not np.array_equal(one.splats.loc, other.splats.loc)


@pytest.mark.slow
def test_frame_times_are_learned():
    """Frames sampled unevenly in time: the learned times move towards the true ones."""
    frames = moving_blobs(num_frames=21)
    chosen = np.array([0, 1, 2, 3, 12, 20])
    config = FitConfig(num_gaussians=800, steps=700, degree=1, rates=LearningRates(frame_times=0.02))
    model = fit(frames[chosen], config).model
    times = np.asarray(model.frame_times.times())
    true, even = chosen / 20, np.linspace(0, 1, 6)
    assert np.all(np.diff(times) > 0)
    assert np.linalg.norm(times - true) < 0.9 * np.linalg.norm(even - true)


@pytest.mark.parametrize(
    ("config", "num_frames", "steps"),
    [
        (FitConfig(), 24, 3000),
        (FitConfig(), 1000, 20_000),
        (FitConfig(views=Views(batch_size=4)), 1000, 5000),
        (FitConfig(steps=7), 1000, 7),
        (FitConfig(minutes=1), 1000, None),
        (FitConfig(minutes=1, steps=9), 1000, 9),
        *((FitConfig.preset(name, minutes=2), 10, None) for name in PRESETS),
        *((FitConfig.preset(name, minutes=2, steps=7), 10, 7) for name in PRESETS),
    ],
)
def test_planned_steps(config, num_frames, steps):
    assert planned_steps(config, num_frames) == steps


@pytest.mark.parametrize(
    ("budgets", "binds"),
    [
        ({"steps": 7, "minutes": 10.0}, "steps"),
        ({"steps": 10**6, "minutes": 0.005}, "minutes"),
        pytest.param({"steps": 7, "psnr": 5.0}, "steps", marks=pytest.mark.slow),
        ({"steps": None, "minutes": 0.005, "quality": 50.0}, "minutes"),
    ],
    ids=str,
)
def test_the_first_budget_binds(budgets, binds):
    *before, (_, last) = fit_steps(moving_blobs(), CONFIG.replace(**budgets))
    assert last.stopped_by == binds
    assert last.progress == 1
    assert not any(info.stopped_by for _, info in before)
    if binds == "steps":
        assert last.step == 7


def test_a_fit_by_minutes_resumes_exactly():
    """A fit by minutes that was stopped goes on by the plan that it had: to the same bits as if it had not been."""
    frames, config = moving_blobs(), dataclasses.replace(CONFIG, steps=None, minutes=0.1)
    tick = lambda: itertools.count(step=1 / 128).__next__  # noqa: E731  every reading of the clock is 1/128 s later
    kept = None
    for state, info in fit_steps(frames, config, clock=tick()):
        if state.planned_step and kept is None:
            kept = jax.tree.map(np.array, state)
    assert state.seconds == pytest.approx(6, rel=0.02)
    assert state.plan == info.step
    assert kept.step < state.step
    for again, _ in fit_steps(frames, config, kept, clock=tick()):
        pass
    assert again.step == state.step
    np.testing.assert_array_equal(again.rows, state.rows)


def test_more_time_means_more_gaussians():
    """Up to a number for each pixel, and parameters of 16 bits as large as the frames; fewer pixels take fewer."""
    number = [chosen_num_gaussians(FitConfig(minutes=m), 80, 480, 854) for m in (0.1, 1.0, 10.0, 100.0, 1000.0)]
    assert number[0] < number[1] < number[2] <= number[3] == number[4]
    # Of so many alive in each pixel, each for as long as is assumed where no clip is known.
    assert number[-1] == pytest.approx(MOST_PER_PIXEL * 80 * 480 * 854 / TYPICAL_LIFETIME, rel=1e-4)
    large = FitConfig(minutes=1000.0, degree=15)
    assert chosen_num_gaussians(large, 80, 480, 854) * 2 * (11 + 2 * 15) == pytest.approx(80 * 480 * 854 * 3, rel=1e-4)
    by_steps = [chosen_num_gaussians(FitConfig(steps=n), 80, 480, 854) for n in (10, 1000, 10_000)]
    assert by_steps[0] < by_steps[1] < by_steps[2]
    both = chosen_num_gaussians(FitConfig(minutes=1000.0, steps=1000), 80, 480, 854)
    assert both == by_steps[1]
    half = chosen_num_gaussians(FitConfig(minutes=0.25), 80, 240, 427)
    fewer = chosen_num_gaussians(FitConfig(minutes=2.0), 80, 480, 854, threads=1)
    assert fewer == chosen_num_gaussians(FitConfig(minutes=1.0), 80, 480, 854, threads=2)
    assert half == pytest.approx(number[1] / 4, rel=0.01)
    assert chosen_num_gaussians(FitConfig(), 1, 1, 1) == 1


@pytest.mark.parametrize(
    ("goal", "values"), [("quality", (0, 20, 40)), ("size_mb", (0.01, 0.05, 0.1)), ("psnr", (25, 30, 35))]
)
def test_goals_of_compact_models_limit_the_number_of_gaussians(goal, values):
    """By default, and only downwards: the number that is asked for stays."""
    clip = 80, 160, 320
    number = [chosen_num_gaussians(FitConfig().replace(minutes=1000.0, **{goal: value}), *clip) for value in values]
    assert number == sorted(set(number))
    assert number[-1] < chosen_num_gaussians(FitConfig(minutes=1000.0), *clip)
    assert chosen_num_gaussians(FitConfig().replace(num_gaussians=10_000, **{goal: values[0]}), *clip) == 10_000
    both = FitConfig().replace(
        minutes=1000.0, quality=100.0, **{goal: values[0]} if goal != "quality" else {"size_mb": 1e-9}
    )
    assert chosen_num_gaussians(both, *clip) <= number[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_gaussians": 0}, "num_gaussians"),
        ({"degree": -1}, "degree"),
        ({"degree": 2.5}, "degree"),
        ({"steps": 0}, "steps"),
        ({"minutes": 0}, "minutes"),
        ({"minutes": float("nan")}, "minutes"),
        ({"psnr": 0}, "psnr"),
        ({"psnr": 101.0}, "psnr"),
        ({"size_mb": 0.0}, "size_mb"),
        ({"size_mb": float("inf")}, "size_mb"),
        ({"quality": -1.0}, "quality"),
        ({"quality": 100.5}, "quality"),
        ({"quality": "high"}, "quality"),
        ({"loss.l2_fraction": 1.5}, "l2_fraction"),
        ({"loss.border_weight": 0.5}, "border_weight"),
        ({"views.batch_size": 0}, "batch_size"),
        ({"power": -1.0}, "power"),
        ({"loss.ssim_fraction": 2.0}, "ssim_fraction"),
        ({"rates.final": float("inf")}, "rates.final"),
        ({"seed": -1}, "seed"),
        ({"degree": 99}, "degree"),
        ({"num_gaussians": 10**12}, "num_gaussians"),
        ({"power": "2"}, "power"),
        ({"minutes": "1"}, "minutes"),
        ({"floor": 1.0}, "floor"),
        ({"rates": 3}, "rates"),
        ({"options": None}, "options"),
        ({"rates.frame_times": "no"}, "rates.frame_times"),
        ({"views.interpolation_fraction": 1.0}, "interpolation_fraction"),
        *(({"rates.loc": rate}, r"rates\.loc") for rate in (-1.0, "fast", None)),
        ({"engine": "reference"}, "engine: expected one of"),
        ({"compositing": "under"}, r"^compositing: expected one of 'over', 'sum'"),
        ({"loss.name": "mine"}, r"loss.name: expected one of '3dgs', got 'mine'"),
        ({"max_gaussians": 0}, "max_gaussians"),
        ({"max_gaussians": 10**12}, "max_gaussians"),
        ({"initialization": "random"}, "initialization: expected one of 'flow', 'static', 'uniform'"),
        ({"rates.decayed": "none"}, "decayed: expected one of"),
        ({"views.two_cameras": 2}, "two_cameras"),
        ({"strategy.sparse_updates": None}, "sparse_updates"),
        ({"strategy.growth": True}, "growth: expected a Growth"),
    ],
    ids=str,
)
def test_bad_settings(changes, message):
    with pytest.raises(ValueError, match=message):
        FitConfig().replace(**changes)


def test_numpy_scalars_are_accepted():
    config = FitConfig(num_gaussians=np.int64(5), power=np.float32(1))
    assert (config.num_gaussians, config.power) == (5, 1.0)
    assert type(config.num_gaussians) is int


ALPHA = np.full((3, 20, 20, 4), 9, np.uint8)
WRONG_CALLS = [
    *((moving_blobs(), CONFIG, {"every": wrong}, "every") for wrong in (0, 2.5)),
    *((moving_blobs(), CONFIG, {"fps": fps}, "fps") for fps in (0, -25.0, np.nan, np.inf, "25")),
    (ALPHA, FitConfig(views=Views(interpolation_fraction=0.5)), {}, "interpolation_fraction"),
    (ALPHA, FitConfig(compositing="sum"), {}, "^compositing: expected 'over' for frames with alpha, got 'sum'"),
    (ALPHA, FitConfig(engine="xla"), {}, "engine: expected 'cpu' with frames that have alpha, got 'xla'"),
]


@pytest.mark.parametrize(("frames", "config", "options", "message"), WRONG_CALLS)
def test_wrong_calls_are_refused_before_the_fit(frames, config, options, message):
    with pytest.raises(ValueError, match=message):
        fit(frames, config, **options, observers=[lambda state, info: pytest.fail("a step was taken")])


def test_time_left_excludes_the_start(monkeypatch):
    """A start that takes its time says nothing about the steps: those of this clip take milliseconds each."""
    start = fit_module.start

    def slow(*given):
        state = start(*given)
        state.seconds += 1000
        return state

    monkeypatch.setattr(fit_module, "start", slow)
    infos = [info for _, info in fit_steps(moving_blobs(), dataclasses.replace(CONFIG, steps=20))]
    assert all(info.seconds_left == np.inf for info in infos[:5])  # not known yet
    assert all(0 < info.seconds_left < 200 for info in infos[5:-1])
    assert infos[-1].seconds_left == 0


def test_budgets_exclude_compilation(monkeypatch):
    """Kernels are ready before the first step, whatever the settings: no budget is spent on them."""
    seconds = []
    list(fit_steps(moving_blobs(), dataclasses.replace(CONFIG, steps=1)))  # the test's own process compiles them too
    monkeypatch.setattr(fit_module, "_warm_up", lambda *given: time.sleep(1.0))
    for _, info in fit_steps(moving_blobs(), dataclasses.replace(CONFIG, steps=2)):
        seconds.append(info.seconds)
    assert seconds[-1] < 1.0


@pytest.fixture(scope="module")
def fitted():
    frames = moving_blobs()
    return frames, fit(frames, CONFIG).model


def test_start_from_continues_a_model(fitted):
    frames, model = fitted
    before = jax.tree.map(np.array, model)
    steps = [info.step for state, info in fit_steps(frames, CONFIG, start_from(model, CONFIG, 90, 0.7))]
    assert steps == list(range(211, 301))  # rates are those from 70% of 300 steps on
    *_, (state, info) = fit_steps(frames, CONFIG, start_from(model, CONFIG, 90, 0.7))
    assert info.stopped_by == "steps"
    on = to_model(state, CONFIG, frames.shape[1:3], 25.0)
    assert evaluate(on, frames).mean_psnr > evaluate(model, frames).mean_psnr
    assert_same(before, model)  # it is not worked on


def test_start_from_reproduces_the_model(fitted):
    model = fitted[1]
    state = start_from(model, CONFIG, 10)
    assert (state.step, state.plan) == (0, 10)
    assert_same(to_model(state, CONFIG, model.size, model.fps), model)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"degree": 2}, r"config\.degree: expected the model's, 3, got 2"),
        ({"power": 2.0}, r"config\.power"),
        ({"floor": 0.1}, r"config\.floor"),
        ({"compositing": "sum"}, r"config\.compositing"),
        ({"options": RenderOptions.standard()}, r"config\.options"),
        ({"strategy.scale_cutoff": 1e-4}, r"config\.strategy\.scale_cutoff: expected the model's, 0\.0, got 0\.0001"),
    ],
    ids=str,
)
def test_start_from_refuses_configs_of_other_models(fitted, changes, told):
    with pytest.raises(ValueError, match=told):
        start_from(fitted[1], CONFIG.replace(**changes), 10)


def test_start_from_refuses_arguments_out_of_range(fitted):
    for steps, progress in ((0, 0.5), (1.5, 0.5), (10, 1.0), (10, -0.1), (10, np.nan)):
        with pytest.raises(ValueError, match="expected"):
            start_from(fitted[1], CONFIG, steps, progress)


@pytest.mark.slow
def test_gaussians_below_the_cutoff_of_scales_are_not_drawn():
    """In the fit as in the model that comes of it, which keeps the cutoff."""
    config, frames = CONFIG.replace(power=2.0, **{"strategy.scale_cutoff": 0.03}, steps=30), moving_blobs()
    result, whole = (fit(frames, one, every=1) for one in (config, config.replace(**{"strategy.scale_cutoff": 0.0})))
    model = result.model
    assert (model.scale_cutoff, whole.model.scale_cutoff) == (0.03, 0)
    assert max(info.num_alive for info in result.history) < 0.8 * min(info.num_alive for info in whole.history)
    again = start_from(model, config, 10)
    assert again.rows.shape[0] == model.num_gaussians
    time = float(model.frame_times.times()[1])
    drawn = np.asarray(model.splats.at(time, scale_cutoff=0.03).opacity) > 0
    assert len(PreparedModel(model, model.size).at(time).alive) == drawn.sum() < model.num_gaussians
