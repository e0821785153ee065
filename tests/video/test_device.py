"""Fits by one compiled JAX program per step: equal to the CPU's, without calls to the host."""

import dataclasses
import threading

import jax
import numpy as np
import pytest
from clips import moving_blobs
from commands import run

from foldgauss.io import write_image
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
from foldgauss.video.fitting.state import ARRAYS, FitState, to_model
from foldgauss.video.fitting.steppers import jax_stepper
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.fitting.steppers.engines import choose_engine
from foldgauss.video.fitting.steppers.interpolated_frames import (
    InterpolatedFrames,
    Prefetcher,
    make_interpolated,
)
from foldgauss.video.fitting.steppers.jax_step import lower_step
from foldgauss.video.fitting.steppers.jax_stepper import ON_HOST, HeldArrays, JaxStepper
from foldgauss.video.models.row_layout import columns
from foldgauss.video.motion.optical_flow import motion_finder

#: Nothing in it is black: at a color of 0 the slope is one thing or another by rounding.
FRAMES = moving_blobs(height=32, width=40) // 2 + 40
CONFIG = FitConfig(num_gaussians=150, steps=100, engine="xla", views=Views(interpolation_fraction=0.5))
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
    rates=LearningRates(own_units=False),
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
    arrays = there.held.arrays
    there.fetch_all()
    close(own, figures, share=1e-6)
    assert own[2] == figures[2]
    for name in ("rows", "first", "second", "frame_errors", "time_logits", "path_maps", "path_first", "path_second"):
        close(getattr(there, name), getattr(here, name))
    np.testing.assert_array_equal(there.counts, here.counts)
    for name in ("time_count", "time_first", "time_second"):
        close(getattr(there, name), getattr(here, name), share=1e-4)
    return here, there, arrays


STEPS = [
    pytest.param({}, 0.1, id="image loss"),
    pytest.param({}, 0.8, id="squared loss"),
    *(
        pytest.param(changes, progress, id=f"{changes} {progress}", marks=pytest.mark.slow)
        for changes, progress in [
            ({"power": 2.0, "strategy.scale_cutoff": 0.02}, 0.1),
            ({"views.batch_size": 4}, 0.1),  # frames, and images between them
            ({"views.batch_size": 4}, 0.8),  # frames alone
            ({"views.interpolation_fraction": 0.0}, 0.1),
            ({"degree": 0}, 0.1),
            ({"floor": 0.1, "power": 0.5}, 0.1),
            ({"rates.own_units": False, "rates.frame_times": 0.0}, 0.1),
            ({"loss.ssim_fraction": 0.0}, 0.1),
            ({"compositing": "sum", "options": RenderOptions()}, 0.1),
        ]
    ),
]


@pytest.mark.parametrize(("changes", "progress"), STEPS)
def test_step_matches_the_cpu(changes, progress):
    config = CONFIG.replace(**changes)
    _, there, _ = compare_steps(config, progress)
    assert there.statistics is None
    assert np.abs(there.rows - warm_state(config).rows).max() > 1e-3  # it did step


def test_so_many_images_are_prepared_and_they_are_dropped():
    config = FitConfig(views=Views(interpolation_fraction=0.9))
    interpolation = make_interpolated(FRAMES, config, motion_finder(FRAMES))
    chosen = [interpolation.choose(step, 0.0, k) is not None for step in (3, 4) for k in range(len(FRAMES))]
    prefetcher = Prefetcher(interpolation, most=sum(chosen))
    for step in (3, 4):
        assert prefetcher.prepare(step, 0.0, range(len(FRAMES)))
    assert not prefetcher.prepare(5, 0.0, [*range(len(FRAMES))] * 9)  # no more are kept
    prefetcher.drop(1)
    assert len(prefetcher.images) == sum(chosen) > 0
    prefetcher.drop(6)
    assert not prefetcher.images


def test_a_fit_prepares_its_interpolated_frames(monkeypatch):
    """All of them, and with the result that it has without."""
    config, made = CONFIG.replace(steps=20, **{"views.interpolation_end": 1.0}), []
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
    here, there, arrays = compare_steps(GROWING, 0.1, outside=7)
    for one, other in zip(there.statistics, here.statistics, strict=True):
        close(one, other)
    assert here.statistics.seen[7:].max() == 21
    assert there.statistics.seen[:7].max() == 20  # who is outside is alive, but not seen
    assert arrays.rows.shape == (250, here.rows.shape[1])
    for array in (arrays.rows, arrays.first, arrays.second, arrays.screen_gradients):
        assert not np.asarray(array)[60:].any()


@pytest.mark.slow
def test_a_clip_of_one_frame():
    result = fit(FRAMES[:1], CONFIG.replace(steps=60, **{"views.interpolation_fraction": 0.0}))
    assert evaluate(result.model, FRAMES[:1]).mean_psnr > 25


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


@pytest.mark.slow
def test_densification_compiles_nothing(caplog):
    steps, numbers = fit_steps(FRAMES, GROWING), []
    next(steps)
    with jax.log_compiles():
        for state, info in steps:
            numbers.append(state.num_gaussians)
            assert info.num_gaussians == state.num_gaussians
        assert not [one for one in caplog.records if "ompil" in one.getMessage()]
        jax.jit(lambda x: x + 17)(1.0)
        assert caplog.records  # it would have been seen
    assert 60 < numbers[-1] <= 250  # some were born
    assert len(set(numbers)) > 2


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
        after[engine] = next(own)[0].copy()
        after[engine].fetch_all()
    assert after["xla"].num_gaussians == after["cpu"].num_gaussians > 60
    for name in ("rows", "first", "second"):
        close(getattr(after["xla"], name), getattr(after["cpu"], name))
    np.testing.assert_array_equal(after["xla"].counts, after["cpu"].counts)
    assert not after["xla"].statistics.seen.any()
    born = after["xla"].counts == 0
    assert 0 < born.sum() < len(born)
    assert not after["xla"].first[born].any()
    assert after["xla"].first[~born].any(axis=1).all()


def test_arrays_are_fetched_when_asked(monkeypatch):
    fetched, fetch = [], HeldArrays.fetch
    monkeypatch.setattr(HeldArrays, "fetch", lambda self, name: fetched.append(name) or fetch(self, name))
    steps = fit_steps(FRAMES, CONFIG.replace(**{"strategy.relocated_fraction": 0}))
    state, _ = next(steps)
    for _ in range(60):  # in which the guard remembers a state, on the device
        next(steps)
    assert not fetched
    for name in set(ARRAYS) - set(ON_HOST):
        with pytest.raises(AttributeError, match=rf"{name}.*fetch_all"):
            getattr(state, name)
    for reads_one in (lambda: state.sizes, lambda: state.is_finite("first")):
        with pytest.raises(AttributeError, match="fetch_all"):
            reads_one()
    for name in ON_HOST:
        with pytest.raises(ValueError, match="read-only"):
            getattr(state, name)[...] = 0
    with pytest.raises(AttributeError, match=r"'rowz'$"):
        state.rowz  # noqa: B018
    state.fetch_all()
    assert set(fetched) == set(ARRAYS) - set(ON_HOST)
    before = state.rows
    next(steps)
    state.fetch_all()
    assert not np.array_equal(state.rows, before)  # what was fetched is a copy


def test_fetching_changes_no_step():
    """A fit whose state is fetched after every step has the same bits."""
    found = []
    for looks in (False, True):
        for state, _ in fit_steps(FRAMES, CONFIG.replace(steps=12)):
            if looks:
                to_model(state, CONFIG, FRAMES.shape[1:3], 25.0)
        found.append(state)  # the last one, fetched
    for name in ARRAYS:
        np.testing.assert_array_equal(*(getattr(state, name) for state in found))


@pytest.mark.parametrize("name", ["rows", "frame_errors"])
def test_assigned_arrays_are_used(name):
    """Whether all arrays were fetched before or not."""
    steps = fit_steps(FRAMES, CONFIG)
    state, _ = next(steps)
    kept = state.copy()
    kept.fetch_all()
    place = columns(CONFIG.fold_degree)["loc"] if name == "rows" else slice(None)
    value = getattr(kept, name).copy()
    value[..., place] += 3
    setattr(state, name, value)
    next(steps)
    assert not state.changed
    state.fetch_all()
    unchanged = np.abs(getattr(state, name) - value) < 0.3
    assert unchanged.all() if name == "rows" else unchanged.any()
    assert np.abs(state.first - kept.first).max() < 1e-2  # all else is as it was


# ---------------------------------------------------------------------------------------------- the door


def test_auto_is_the_cpu_without_a_gpu(monkeypatch):
    assert choose_engine(FRAMES, FitConfig()) == "cpu"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert choose_engine(FRAMES, FitConfig()) == "pallas"
    assert choose_engine(np.concatenate([FRAMES, FRAMES[..., :1]], axis=-1), FitConfig()) == "cpu"
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


def test_diverging_fit_backs_off(monkeypatch):
    config = dataclasses.replace(CONFIG, rates=LearningRates(log_scale=3e38), steps=12)
    with pytest.warns(DivergenceWarning, match="the fit diverged at step"):
        done = [(state.is_finite("rows"), state) for state, _ in fit_steps(FRAMES, config)]
    assert all(finite for finite, _ in done)
    state = done[-1][1]
    assert np.isfinite(state.rows).all()
    assert state.step == 12
    monkeypatch.setattr(divergence, "MAX_BACKOFFS", 0)
    with pytest.raises(FitDiverged, match="The state is that of step 0") as caught:
        list(fit_steps(FRAMES, config))
    assert np.isfinite(caught.value.state.rows).all()


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
    options = ["--gaussians", "150", "--steps", "40", "--interpolation-fraction", "0.5", "--out", str(model)]
    assert run("fit", tmp_path / "clip", *options, "--engine", "xla") == 0
    assert "engine xla on " in capsys.readouterr().out
    assert evaluate(load_video_model(model), FRAMES).mean_psnr > 25
    assert run("fit", tmp_path / "clip", *options, "--overwrite", "--engine", "gpu") == 2
    assert "--engine: expected one of" in capsys.readouterr().err
