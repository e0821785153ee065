"""Fits by one compiled JAX program per step: equal to the CPU's, without calls to the host."""

import copy
import dataclasses
import json
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from clips import moving_blobs
from commands import run

from benchmarks import gpu
from foldgauss.io import write_image
from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.io.models.video_model import load_video_model
from foldgauss.render import RenderOptions, api
from foldgauss.video import (
    DivergenceWarning,
    FitConfig,
    FitDiverged,
    Growth,
    LearningRates,
    Strategy,
    Views,
    evaluate,
    fit,
    fit_steps,
)
from foldgauss.video.fitting import divergence
from foldgauss.video.fitting.loop import start
from foldgauss.video.fitting.state import FitState, paths_of
from foldgauss.video.fitting.steppers import jax_stepper
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.fitting.steppers.engines import choose_engine
from foldgauss.video.fitting.steppers.interpolated_frames import (
    InterpolatedFrames,
    Prefetcher,
    choose_targets,
    make_interpolated,
)
from foldgauss.video.fitting.steppers.jax_loss import compute_losses, ssim
from foldgauss.video.fitting.steppers.jax_step import _splats, find_alive, lower_step
from foldgauss.video.fitting.steppers.jax_stepper import HeldArrays, JaxStepper
from foldgauss.video.fitting.steppers.loss import image_loss, squared_loss, ssim_map
from foldgauss.video.models.conditioning import ConditioningSpec, condition, find_windows
from foldgauss.video.models.row_layout import columns
from foldgauss.video.motion.optical_flow import motion_finder

#: Nothing in it is black: at a color of 0 the slope is one thing or another by rounding.
FRAMES = moving_blobs(height=32, width=40) // 2 + 40
CONFIG = FitConfig(num_gaussians=150, steps=100, engine="xla", views=Views(interpolation_fraction=0.0))
#: As the paper's: batches, both cameras, Adam for all, growth, here within few steps.
GROWTH = Growth(
    from_step=1,
    until_step=29_000,
    big_from=30_000,
    screen_gradient=1e-5,
    time_gradient=1e-5,
    clone_below=0.35,
    reset_every=14_000,
)
GROWING = FitConfig(
    num_gaussians=60,
    max_gaussians=250,
    steps=34,
    views=Views(batch_size=4, two_cameras=True, interpolation_fraction=0.0),
    power=2.0,
    strategy=Strategy(scale_cutoff=0.004, sparse_updates=False, growth=GROWTH),
    rates=LearningRates(by_size=False),
    engine="xla",
)


@pytest.fixture(autouse=True, scope="module")
def _compiled_quickly():
    """Compiling steps is most of the time here, and nobody looks at how fast they are."""
    compiling = jax.stages.Lowered.compile
    with pytest.MonkeyPatch.context() as patch:
        options = {"xla_backend_optimization_level": 0}
        patch.setattr(jax.stages.Lowered, "compile", lambda self: compiling(self, options))
        yield


def warm_state(config: FitConfig, steps: int = 20) -> FitState:
    """A state with moments: Adam's first steps go by the signs of gradients, which are rounding's where they are 0."""
    state = start(FRAMES, config)
    step = CpuStepper(FRAMES, config, state)
    for _ in range(steps):
        step.step(state, 0.1)
        state.step += 1
    return state


def close(one, other, share=1e-5):
    """By the size of the largest number."""
    one, other = np.asarray(one), np.asarray(other)
    np.testing.assert_allclose(one, other, atol=share * max(np.abs(other).max(initial=0), 1e-12), rtol=1e-4)


def compare_steps(config: FitConfig, progress: float, outside: int = 0):
    """By the CPU and by XLA; the first Gaussians `outside` the picture."""
    here, there = warm_state(config), warm_state(config)
    for state in (here, there):
        state.rows[:outside, columns(config.fold_degree)["loc"]] = 5.0
    figures = CpuStepper(FRAMES, config, here).step(here, progress)
    stepper = JaxStepper(FRAMES, config, there, "xla")
    own = stepper.step(there, progress)
    close(own, figures, share=1e-6)
    assert own[2] == figures[2]
    for name in ("rows", "first", "second", "frame_errors", "time_logits", "path_maps", "path_first", "path_second"):
        close(getattr(there, name), getattr(here, name))
    np.testing.assert_array_equal(there.counts, here.counts)
    for name in ("time_count", "time_first", "time_second"):
        close(getattr(there, name), getattr(here, name), share=1e-4)
    return here, there


@pytest.mark.parametrize("progress", [0.1, 0.8], ids=["image loss", "squared loss"])
def test_step_matches_the_cpu(progress):
    _, there = compare_steps(CONFIG, progress)
    assert there.statistics is None
    assert np.abs(there.rows - warm_state(CONFIG).rows).max() > 1e-3  # it did step


@pytest.mark.slow
@pytest.mark.parametrize("progress", [0.1, 0.8], ids=["mixed", "frames alone"])
def test_step_with_interpolated_frames_matches_the_cpu(progress):
    """A batch of frames and of images between frames, and later one of frames alone."""
    config = CONFIG.replace(**{"views.batch_size": 4, "views.interpolation_fraction": 0.5})
    state = warm_state(config)
    interpolation = CpuStepper(FRAMES, config, start(FRAMES, config)).interpolation
    _, fractions = choose_targets(interpolation, config, len(FRAMES), state, 0.1)
    assert 0 < sum(fraction is not None for fraction in fractions) < 4
    _, there = compare_steps(config, progress)
    assert np.abs(there.rows - warm_state(config).rows).max() > 1e-3  # it did step


def test_prepared_images_are_the_same_and_are_dropped():
    config = FitConfig(views=Views(interpolation_fraction=0.9))
    interpolation = make_interpolated(FRAMES, config, motion_finder(FRAMES))
    chosen = [interpolation.choose(step, 0.0, k) is not None for step in (3, 4) for k in range(len(FRAMES))]
    prefetcher, made = Prefetcher(interpolation, most=sum(chosen)), []
    for step in (3, 4):
        assert prefetcher.prepare(step, 0.0, range(len(FRAMES)))
    assert not prefetcher.prepare(5, 0.0, [*range(len(FRAMES))] * 9)  # no more are kept
    prefetcher.drop(1)
    assert prefetcher.num_prepared == sum(chosen) > 0
    direct, interpolation.interpolate = interpolation.interpolate, lambda *call: made.append(call)
    for step in (3, 4):
        for k in range(len(FRAMES)):
            fraction = interpolation.choose(step, 0.0, k)
            if fraction is not None:
                image = prefetcher.interpolate(step, k, fraction)
                np.testing.assert_array_equal(image, direct(k, fraction))
        prefetcher.drop(step)
    assert not made
    prefetcher.drop(6)
    assert prefetcher.num_prepared == 0
    prefetcher.interpolate(5, 0, 0.5)  # not prepared
    assert made == [(0, 0.5)]


def test_interpolated_views_do_not_depend_on_errors():
    """So that they can be prepared before the steps until then."""
    config = FitConfig(views=Views(interpolation_fraction=0.4, error_fraction=0.5, two_cameras=True, batch_size=3))
    interpolation, seen = make_interpolated(FRAMES, config, motion_finder(FRAMES)), []
    for errors in np.random.default_rng(0).uniform(0.1, 1, (2, len(FRAMES))):
        state = warm_state(CONFIG)
        state.frame_errors = errors
        seen.append([])
        for state.step in range(1, 60):
            chosen = choose_targets(interpolation, config, len(FRAMES), state, 0.1)
            seen[-1] += [(state.step, int(view), fraction) for view, fraction in zip(*chosen, strict=True)]
    interpolated = [[given for given in views if given[2] is not None] for views in seen]
    assert interpolated[0] == interpolated[1]
    assert 0.3 < len(interpolated[0]) / len(seen[0]) < 0.4
    assert {view // len(FRAMES) for _, view, _ in interpolated[0]} == {0, 1}  # mirrored ones, too
    assert seen[0] != seen[1]  # others do
    _, without = choose_targets(None, config, len(FRAMES), state, 0.1)
    assert without == [None] * 3


def test_a_fit_prepares_its_interpolated_frames(monkeypatch):
    """All of them, and with the result that it has without."""
    config, made = CONFIG.replace(steps=30, **{"views.interpolation_fraction": 0.5, "views.interpolation_end": 1.0}), []
    with monkeypatch.context() as patch:
        patch.setattr(jax_stepper, "STEPS_AHEAD", 0)
        expected = fit(FRAMES, config, every=1)
    direct = InterpolatedFrames.interpolate

    def note(self, *call):
        made.append(threading.current_thread() is threading.main_thread())
        return direct(self, *call)

    monkeypatch.setattr(InterpolatedFrames, "interpolate", note)
    found = fit(FRAMES, config, every=1)
    assert [info.loss for info in found.history] == [info.loss for info in expected.history]
    assert len(made) > 5
    assert not any(made)


@pytest.mark.slow
def test_step_of_growing_batches_matches_the_cpu():
    """Twice the views of a pass, all rows by momentum, statistics, and rows that are not in use."""
    here, there = compare_steps(GROWING, 0.1, outside=7)
    for one, other in zip(there.statistics, here.statistics, strict=True):
        close(one, other)
    assert here.statistics.seen[7:].max() == 21
    assert there.statistics.seen[:7].max() == 20  # who is outside is alive, but not seen
    arrays = there.held.arrays
    assert arrays.rows.shape == (250, here.rows.shape[1])
    for array in (arrays.rows, arrays.first, arrays.second, arrays.screen_gradients):
        assert not np.asarray(array)[60:].any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"degree": 0},
        {"floor": 0.1, "power": 0.5},
        {"rates.by_duration": False, "rates.frame_times": 0.0},
        {"loss.ssim_fraction": 0.0},
        {"compositing": "sum", "options": RenderOptions()},
    ],
    ids=str,
)
def test_steps_of_other_settings_match_the_cpu(changes):
    compare_steps(CONFIG.replace(**changes), 0.1)


@pytest.mark.slow
def test_a_clip_of_one_frame():
    result = fit(FRAMES[:1], dataclasses.replace(CONFIG, steps=60))
    assert evaluate(result.model, FRAMES[:1]).mean_psnr > 25


def pictures_of(seed=0, shape=(2, 23, 31, 3)):
    rng = np.random.default_rng(seed)
    smooth = np.cumsum(rng.normal(size=shape), axis=2) / 20 + 0.5
    return [np.float32(smooth + 0.1 * rng.normal(size=shape)) for _ in range(2)]


@pytest.mark.parametrize(("ssim_fraction", "squared"), [(0.2, False), (0.0, False), (0.2, True)])
def test_losses_match_the_cpu(ssim_fraction, squared):
    """Values, errors and gradients."""
    rendered, target = pictures_of()
    rendered[0, 3:9, 4:9] = target[0, 3:9, 4:9]  # where |x - y| has a kink

    def total(rendered):
        own, errors = compute_losses(rendered, target, jnp.bool_(squared), ssim_fraction)
        return jnp.sum(own), (own, errors)

    gradient, (values, errors) = jax.jit(jax.grad(total, has_aux=True))(rendered)
    for k in range(2):
        planes = [np.ascontiguousarray(np.moveaxis(one[k], -1, 0)) for one in (rendered, target)]
        judge = squared_loss(*planes) if squared else image_loss(*planes, ssim_fraction=ssim_fraction)
        assert float(values[k]) == pytest.approx(judge.value, rel=1e-5)
        assert float(errors[k]) == pytest.approx(judge.mean_squared_error, rel=1e-5)
        close(np.moveaxis(gradient[k], -1, 0), judge.gradient)


def test_ssim_matches_the_cpu():
    rendered, target = (np.ascontiguousarray(one[0, ..., 0]) for one in pictures_of())
    own = jax.jit(ssim)(rendered[..., None], target[..., None])
    close(own[..., 0], ssim_map(rendered, target))


@pytest.mark.parametrize(("power", "floor", "cutoff"), [(1.0, 0.0, 0.0), (2.0, 0.1, 0.0), (2.0, 0.0, 0.02)])
def test_conditioning_matches_the_cpu(power, floor, cutoff):
    """The fold equation's home, `FoldedGaussian.condition_time`, as the step calls it, against the fused twin."""
    config = dataclasses.replace(CONFIG, power=power, floor=floor)
    state = warm_state(config, steps=5)
    step = JaxStepper(FRAMES, CONFIG, copy.deepcopy(state), "xla")  # of whose program only the sizes count
    program = dataclasses.replace(step.program, power=power, floor=floor, scale_cutoff=cutoff)
    paths = paths_of(state)
    spec = ConditioningSpec(3, power, floor, program.size, paths=paths, scale_cutoff=cutoff)
    window = find_windows(state.rows, spec)

    @jax.jit
    def conditioned(rows, maps, t):
        alive = find_alive(program, rows, np.int32(150), t)
        return alive, _splats(program, rows, maps, t, alive, jnp.bool_(False))

    for t in np.float32([0.0, 0.37, 1.0]):
        alive, splats = conditioned(state.rows, paths.at(t), t)
        judge = condition(state.rows, window, t, spec)
        np.testing.assert_array_equal(np.flatnonzero(alive), judge.alive)
        splats = jax.tree.map(lambda leaf, keep=judge.alive: np.asarray(leaf)[keep], splats)
        close(splats.mean, judge.mean)
        close(splats.opacity, judge.opacity)
        close(splats.color, judge.color)
        own, twin = (factor @ factor.swapaxes(1, 2) for factor in (splats.factor, judge.factor))
        close(own, twin)
        assert not np.asarray(find_alive(program, state.rows, np.int32(7), t))[7:].any()


@pytest.mark.slow
def test_quality_matches_the_cpu():
    scores = {
        engine: evaluate(fit(FRAMES, dataclasses.replace(CONFIG, engine=engine)).model, FRAMES).mean_psnr
        for engine in ("xla", "cpu")
    }
    assert scores["cpu"] > 30
    assert abs(scores["xla"] - scores["cpu"]) < 0.3


@pytest.mark.slow
def test_pallas_step_matches_xla():
    """Interpreted here; the same step but for the engine."""
    own = {}
    for engine in ("pallas", "xla"):
        state = warm_state(CONFIG)
        step = JaxStepper(FRAMES, CONFIG, state, engine)
        for _ in range(2):
            step.step(state, 0.1)
            state.step += 1
        own[engine] = state.fetch_all() or state
    for name in ("rows", "first", "second", "frame_errors", "time_logits", "path_maps", "path_first", "path_second"):
        close(getattr(own["pallas"], name), getattr(own["xla"], name), share=1e-4)


# ------------------------------------------------------------------------------------------- on the device


def test_step_donates_its_arrays():
    state = start(FRAMES, CONFIG)
    step = JaxStepper(FRAMES, CONFIG, state, "xla")
    before = jax.tree.leaves(state.held.arrays)
    step.step(state, 0.0)
    assert before
    assert all(leaf.is_deleted() for leaf in before)
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(state.held.arrays))
    assert not any(leaf.is_deleted() for leaf in step.images)
    assert step.images[-1].dtype == np.uint8


@pytest.mark.parametrize(
    ("engine", "config"),
    [
        pytest.param("pallas", CONFIG, id="pallas-plain"),
        pytest.param("xla", CONFIG, id="xla-plain"),
        pytest.param("pallas", GROWING, id="pallas-growing", marks=pytest.mark.slow),
        pytest.param("xla", GROWING, id="xla-growing", marks=pytest.mark.slow),
    ],
)
def test_step_does_not_call_the_host(engine, config):
    """For a GPU the whole step is one program: triton's are the only calls out of it."""
    step = JaxStepper(FRAMES, config, start(FRAMES, config), "xla")
    program = dataclasses.replace(step.program, engine=engine)
    text = lower_step(program, ("cuda",)).as_text()
    assert "callback" not in text
    assert "infeed" not in text
    assert "outfeed" not in text
    calls = {line.split("@")[1].split("(")[0] for line in text.splitlines() if "custom_call @" in line}
    triton = {"__gpu$xla.gpu.triton", "xla.gpu.triton"}
    assert calls <= {*triton, "Sharding", "mhlo.erf"}, calls
    assert (engine == "pallas") == bool(calls & triton)


def compiled_by(function) -> int:
    """How many programs were compiled meanwhile."""
    count, counting = [], [True]

    def note(event: str, duration: float, **_) -> None:
        if counting and event.endswith("backend_compile_duration"):
            count.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        function()
    finally:
        counting.clear()
    return len(count)


@pytest.mark.slow
def test_densification_compiles_nothing():
    steps, numbers = fit_steps(FRAMES, GROWING), []
    numbers.append(next(steps)[0].num_gaussians)

    def rest() -> None:
        for state, info in steps:
            numbers.append(state.num_gaussians)
            assert info.num_gaussians == state.num_gaussians

    assert compiled_by(rest) == 0
    assert 60 < numbers[-1] <= 250  # some were born
    assert len(set(numbers)) > 2
    assert compiled_by(lambda: jax.jit(lambda x: x + 17)(1.0)) == 1  # it would have been seen


@pytest.mark.slow
def test_densification_matches_the_cpu():
    """From one state, at the step of the first births: clones, halves at the same places, and moments that are 0."""
    kept, after = None, {}
    for state, _ in fit_steps(FRAMES, dataclasses.replace(GROWING, engine="cpu")):
        if state.step == 9:
            kept = jax.tree.map(np.array, state)
            break
    for engine in ("cpu", "xla"):
        own = fit_steps(FRAMES, dataclasses.replace(GROWING, engine=engine), jax.tree.map(np.array, kept))
        after[engine] = jax.tree.map(np.array, next(own)[0])
    assert after["xla"].num_gaussians == after["cpu"].num_gaussians > 60
    for name in ("rows", "first", "second"):
        close(getattr(after["xla"], name), getattr(after["cpu"], name))
    np.testing.assert_array_equal(after["xla"].counts, after["cpu"].counts)
    assert not after["xla"].statistics.seen.any()
    born = after["xla"].counts == 0
    assert 0 < born.sum() < len(born)
    assert not after["xla"].first[born].any()
    assert after["xla"].first[~born].any(axis=1).all()


def test_only_arrays_that_are_read_are_fetched(monkeypatch):
    fetched, fetch = [], HeldArrays.fetch
    monkeypatch.setattr(HeldArrays, "fetch", lambda self, name: fetched.append(name) or fetch(self, name))
    steps = fit_steps(FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0}))
    state, _ = next(steps)
    fetched.clear()
    for _ in range(60):  # in which the guard remembers a state, on the device
        next(steps)
    assert set(fetched) == {"frame_errors", "time_logits", "path_maps"}  # which every step tells, and the guard tests
    before = state.rows
    assert fetched[-1] == "rows"
    next(steps)
    assert not np.array_equal(state.rows, before)  # what was fetched is a copy
    with pytest.raises(AttributeError, match="rowz"):
        state.rowz  # noqa: B018


def test_assigned_arrays_are_used():
    steps = fit_steps(FRAMES, CONFIG)
    state, _ = next(steps)
    place = columns(CONFIG.fold_degree)["loc"]
    rows = state.rows
    rows[:, place] += 3.0  # a copy: nobody knows of that
    next(steps)
    assert np.abs(state.rows[:, place]).max() < 2
    rows, first = state.rows, state.first
    rows[:, place] += 3.0
    state.rows = rows
    next(steps)
    assert state.rows[:, place].min() > 2
    assert np.abs(state.first - first).max() < 1e-2  # all else is as it was
    assert not state.changed


# ---------------------------------------------------------------------------------------------- the door


def test_auto_is_the_cpu_without_a_gpu(monkeypatch):
    assert choose_engine(FRAMES, FitConfig()) == "cpu"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert choose_engine(FRAMES, FitConfig()) == "pallas"
    assert choose_engine(FRAMES, FitConfig(options=RenderOptions(alpha_ceiling=1.0))) == "xla"
    assert choose_engine(FRAMES, FitConfig(engine="cpu")) == "cpu"
    assert choose_engine(FRAMES, FitConfig(engine="pallas")) == "pallas"
    for device in (jax.devices("cpu")[0], "cpu"):
        with jax.default_device(device):
            assert choose_engine(FRAMES, FitConfig()) == "cpu"
            assert api.choose_engine(RenderOptions(), np.dtype(np.float32)) == "cpu"
    assert api.choose_engine(RenderOptions(), np.dtype(np.float32)) == "pallas"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"engine": "pallas", "options": RenderOptions(alpha_ceiling=1.0)}, "alpha_ceiling"),
        ({"engine": "pallas", "options": RenderOptions(tile_size=12)}, "tile_size"),
    ],
    ids=str,
)
def test_unsupported_settings_are_refused(changes, message):
    """Before anything is computed."""
    with pytest.raises(ValueError, match=message):
        choose_engine(FRAMES, CONFIG.replace(**changes))


def test_alpha_is_refused(monkeypatch):
    """Before anything is computed; where the engine is chosen, the CPU takes it."""
    monkeypatch.setattr(sys.modules["foldgauss.video.fitting.loop"], "_warm_up", lambda *_: pytest.fail("too late"))
    frames = np.concatenate([FRAMES, FRAMES[..., :1]], axis=-1)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert choose_engine(frames, FitConfig()) == "cpu"
    with pytest.raises(ValueError, match="engine: expected 'cpu' with frames that have alpha, got 'xla'"):
        next(fit_steps(frames, CONFIG))


def test_unknown_engines_are_refused():
    with pytest.raises(ValueError, match="engine: expected one of"):
        FitConfig(engine="reference")


@pytest.mark.parametrize(
    "config", [pytest.param(CONFIG, id="plain"), pytest.param(GROWING, id="growing", marks=pytest.mark.slow)]
)
def test_resuming_keeps_the_bits(config, tmp_path):
    """From a checkpoint, written while the arrays are on the device."""
    path = tmp_path / "kept.safetensors"
    config = dataclasses.replace(config, steps=min(config.steps, 40))
    for state, _ in fit_steps(FRAMES, config):
        if state.step == 23:
            save_checkpoint(path, state, config=config, source={})
    for again, info in fit_steps(FRAMES, config, load_checkpoint(path, config=config, source={})):
        pass
    assert info.step == config.steps
    one, other = (jax.tree.map(np.array, own) for own in (state, again))
    for name in ("rows", "first", "second", "counts", "time_logits", "frame_errors"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_relocation():
    """As by the CPU: at the stated steps, of as many Gaussians as before."""
    for state, info in fit_steps(FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0.2})):
        if info.step in (20, 35, 50):
            assert (state.counts == 0).sum() >= 15
    assert state.num_gaussians == 150
    assert np.isfinite(state.rows).all()


def test_diverging_fit_backs_off(monkeypatch):
    config = dataclasses.replace(CONFIG, rates=LearningRates(log_scale=3e38), steps=12)
    with pytest.warns(DivergenceWarning, match="the fit diverged at step"):
        done = [(np.isfinite(state.rows).all(), info.step) for state, info in fit_steps(FRAMES, config)]
    assert all(finite for finite, _ in done)
    assert done[-1][1] == 12
    monkeypatch.setattr(divergence, "MAX_BACKOFFS", 0)
    with pytest.raises(FitDiverged, match="The state is that of step 0") as caught:
        list(fit_steps(FRAMES, config))
    assert np.isfinite(caught.value.state.rows).all()


def test_minutes_are_planned():
    by_clock = dataclasses.replace(CONFIG, steps=None, minutes=0.02)
    *_, (_, info) = fit_steps(FRAMES, by_clock)
    assert info.stopped_by == "minutes"


def test_capacity_doubles_where_it_is_not_enough():
    """Without a bound of the user's there is room for some times as many, then for twice that."""
    config = dataclasses.replace(GROWING, max_gaussians=None)
    stepper = JaxStepper.__new__(JaxStepper)
    stepper.config, stepper.num_frames, stepper.size = config, 6, (32, 40)
    assert [stepper._choose_capacity(num) for num in (60, 121, 240, 241, 900)] == [120, 240, 240, 480, 960]
    stepper.config = GROWING
    assert stepper._choose_capacity(60) == 250
    stepper.config = CONFIG
    assert stepper._choose_capacity(123) == 123
    stepper.config = dataclasses.replace(CONFIG, quality=50)  # whose Gaussians become fewer
    assert [stepper._choose_capacity(num) for num in (1, 123, 110, 105, 64)] == [1, 128, 128, 108, 64]


def test_the_command(tmp_path, capsys):
    (tmp_path / "clip").mkdir()
    for k, frame in enumerate(FRAMES):
        write_image(tmp_path / "clip" / f"{k:02}.png", frame)
    model = tmp_path / "model.safetensors"
    options = ["--gaussians", "150", "--steps", "40", "--interpolation-fraction", "0", "--out", str(model)]
    assert run("fit", tmp_path / "clip", *options, "--engine", "xla") == 0
    assert "engine xla on " in capsys.readouterr().out
    assert evaluate(load_video_model(model), FRAMES).mean_psnr > 25
    assert run("fit", tmp_path / "clip", *options, "--overwrite", "--engine", "gpu") == 2
    assert "--engine: expected one of" in capsys.readouterr().err


# -------------------------------------------------------------------------------------- its own benchmark


def test_gpu_benchmark_requires_a_gpu(capsys):
    with pytest.raises(SystemExit):
        gpu.main([])
    assert "expected a GPU that JAX sees, got none" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        gpu.main(["--anyway"])


def test_floors_are_those_of_the_device():
    """An H200 moves bytes faster and computes as fast as an H100."""
    few, many = 10_000, 10_000_000_000
    for pairs, faster in ((few, 4.8 / 3.35), (many, 1.0)):
        one, other = (gpu.floors(100_000, (640, 1280), pairs, f"NVIDIA {name}") for name in ("H100 80GB", "H200"))
        assert one["forward"] / other["forward"] == pytest.approx(faster)
        assert one["both"] > one["forward"]
    assert gpu.floors(100_000, (640, 1280), many, "NVIDIA H200")["forward"] == pytest.approx(1e3 * many * 23 / 67e12)
    assert gpu.floors(1, (1, 1), 1, "cpu") == {}


@pytest.mark.slow
def test_the_benchmark_runs(tmp_path):
    path = tmp_path / "gpu.json"
    gpu.main(["--anyway", "--tiny", "--json", str(path)])
    figures = json.loads(path.read_text())["figures"]
    for name in ("quality_xla_psnr", "quality_pallas_steps", "playback_pallas_fps", "playback_xla_fps"):
        assert figures[name] > 0
    assert figures["engines_200_24x40_xla_over_pallas_both"] > 0
