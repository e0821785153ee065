"""The loop of a fit: `fit` and `fit_steps`, and the states that they start from.

Each step yields (state, info). Frames are arrays; files and progress bars belong to the observers.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from foldgauss._runtime.checks import is_integer, is_within, require
from foldgauss.video.compression.chunks import arrange
from foldgauss.video.compression.quantize import Quantized, dequantize
from foldgauss.video.fitting.budget import StepPlanner, TimeLeft, find_limit, measure_progress
from foldgauss.video.fitting.config import DEFAULT_QUALITY, FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.densify import Densification
from foldgauss.video.fitting.density_control import DensityControl
from foldgauss.video.fitting.divergence import Guard
from foldgauss.video.fitting.initialize import (
    START_OPACITY,
    SUMMED_OPACITY,
    initialize,
    initialize_uniform,
    with_backdrop,
)
from foldgauss.video.fitting.rate import RateControl, count_bytes, count_past
from foldgauss.video.fitting.relocation import Relocation, relocates
from foldgauss.video.fitting.schedule import steps_per_pass
from foldgauss.video.fitting.state import FitState, StepResult, envelope_of, running_psnr, to_model
from foldgauss.video.fitting.steppers.engines import choose_engine, make_stepper
from foldgauss.video.models.frame_times import FrameTimes, check_rate, make_time_logits
from foldgauss.video.models.row_layout import pack
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion.optical_flow import Motion, motion_finder
from foldgauss.video.motion.shared_motions import find_shared_motions


class FitInfo(NamedTuple):
    """What each step reports to observers."""

    step: int  #: steps done
    progress: float  #: fraction of the plan that is done, in [0, 1]
    loss: float  #: of this step's batch
    psnr: float  #: dB, of the mean squared error of the frames seen so far, each as it was when last seen
    num_gaussians: int
    num_alive: int  #: Gaussians that took part in this step
    seconds: float  #: spent fitting so far
    seconds_left: float  #: estimated from the speed so far
    stopped_by: str | None  #: at the last step, which budget ended the fit: "steps" or "minutes"


@dataclasses.dataclass(frozen=True)
class FitResult:
    """The result of `fit`: the `model`, and as `history` the `FitInfo` of every `every`-th step and the last one.

    `quantized` is the compact model, where one was asked for: `model` is what it decodes to.
    """

    model: VideoModel
    history: list[FitInfo]
    quantized: Quantized | None = None

    def __repr__(self) -> str:
        model, last = self.model, self.history[-1] if self.history else None
        height, width = model.size
        text = f"{model.num_frames} frames of {height}x{width}, {model.num_gaussians:,} Gaussians"
        if last is not None:
            text += f"; {last.psnr:.2f} dB after {last.step:,} steps, {last.seconds:.1f} s"
        return f"{type(self).__name__}({text})"


def fit(
    frames: np.ndarray,
    config: FitConfig | None = None,
    *,
    fps: float = 25.0,
    state: FitState | None = None,
    controls: Iterable[DensityControl] = (),
    observers: Iterable[Callable[[FitState, FitInfo], None]] = (),
    every: int = 10,
) -> FitResult:
    """Fit a video of folded Gaussians to `frames`, uint8 (num_frames, height, width, 3), or with alpha (..., 4).

    Alpha, by which colors are premultiplied, is learned by compositing frames and splats over random backgrounds:
    `psnr` and `loss` are measured over these. The model is rendered over black by default.

    `fps`: frames per second. `state`: what to start from, see `start_from`. `controls` change the Gaussians between
    steps, after those of the settings: see `DensityControl`. `observers` are called with (state, info) after every
    step: progress bars, checkpoints. With an engine of JAX, `state.fetch_all()` brings the arrays of the state first.
    `every`: the history keeps every so many steps, and the last. Raises ValueError for frames or settings that cannot
    be fitted. A fit that diverges warns by `DivergenceWarning` and goes on from its last finite state with lower
    learning rates; it raises `FitDiverged` where that does not help. No budget includes the compilation of kernels,
    some 20 s when they are used for the first time. Without `minutes` the bits are the same for any number of threads.

    Example: `fit(frames, FitConfig(steps=1000)).model.render(0.5)`. Source: VeGaS, section 4.
    """
    config = FitConfig() if config is None else config
    observers, history = list(observers), []
    require(is_integer(every, 1), "every", expected="a whole number >= 1", got=repr(every))
    check_rate("fps", fps)
    for state, info in fit_steps(frames, config, state, controls=controls):  # noqa: B020
        for observe in observers:
            observe(state, info)
        if info.step % every == 0 or info.progress >= 1:
            history.append(info)
    model, quantized = finish(state, frames, config, fps)
    return FitResult(model, history, quantized)


def finish(state: FitState, frames: np.ndarray, config: FitConfig, fps: float) -> tuple[VideoModel, Quantized | None]:
    """The model of a fit to `frames` after its last step, and the compact one where the settings ask for it."""
    if not config.is_compact:
        return to_model(state, config, frames.shape[1:3], fps), None
    quantized = RateControl(frames, config).finish(state, fps)
    return dequantize(quantized), quantized


def fit_steps(
    frames: np.ndarray,
    config: FitConfig,
    state: FitState | None = None,
    *,
    controls: Iterable[DensityControl] = (),
    motion: Motion | None = None,
    cuts: Sequence[int] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[tuple[FitState, FitInfo]]:
    """The steps of a fit to `frames`, as of `fit`, from the start or resumed from `state`: yields (state, info).

    The state is updated in place: take `state.copy()` of one to keep. `controls`, raises and warns as `fit`.

    `motion`: the optical flow of the frames, where it is already known; computing it takes some hundredths of a second
    per frame. `cuts`: the frames with which shots begin, if they are not to be found. `clock` gives seconds, of which
    `FitConfig.minutes` is a budget: with `time.process_time` and one thread, fits beside other work are comparable.
    """
    check_frames(frames)
    has_alpha, interpolated = frames.shape[3] == 4, config.views.interpolation_fraction
    require(
        not has_alpha or config.compositing != "sum",
        "compositing",
        expected="'over' for frames with alpha",
        got="'sum'",
        cure="Sums are never opaque: drop the alpha, or give 'over'.",
    )
    require(
        not has_alpha or not interpolated,
        "views.interpolation_fraction",
        expected="0 for frames with alpha",
        got=interpolated,
        cure="Leave it out: optical flow does not determine what is behind.",
    )
    engine = choose_engine(frames, config)
    _warm_up(frames, config, engine)
    find_motion = motion_finder(frames, motion)
    if state is None:
        state = start(frames, config, find_motion, clock, cuts)
        if config.is_compact:
            RateControl(frames, config).check_size(state)
    require(
        len(state.frame_errors) == len(frames),
        "frames",
        expected=f"as many as the state has, {len(state.frame_errors)}",
        got=len(frames),
    )
    planner, time_left = StepPlanner(config), TimeLeft(state, config)
    guard = Guard(state, config, steps_per_pass(config, len(frames)), alpha=has_alpha)
    controls = [*_make_controls(frames, config, find_motion), *controls]
    stopped_by = find_limit(state, config)
    if stopped_by:  # a resumed state that needs no more steps
        yield state, _make_info(state, config, time_left, StepResult(math.nan, 0), stopped_by)
        return
    stepper = make_stepper(engine, frames, config, state, find_motion)
    if state.step == 0 and guard.comparable and config.initialization != "uniform":
        begun = clock()
        state.start_errors = tuple(stepper.measure_start(state).items())
        state.seconds += clock() - begun
    while not stopped_by:
        begun = clock()
        result = stepper.step(state, measure_progress(state, config))
        state.step += 1
        fault = guard.find_fault(state, result)
        if fault:
            guard.back_off(state, fault)
            stepper.adopt(state)
        else:
            guard.keep_good(state)
            for control in controls:
                before = clock()
                if control.is_due(state):
                    state.fetch_all()
                    control.apply(state)
                    stepper.adopt(state)
                    guard.replace_good(state)
                    if control.plans_time:
                        control.seconds = max(control.seconds, clock() - before)
                        planner.skip(clock() - before, sum(one.reserve(state) for one in controls if one.plans_time))
        state.seconds += clock() - begun
        planner.update(state)
        begun = clock()
        stopped_by = find_limit(state, config)
        if stopped_by:
            guard.finish(state)
            state.fetch_all()
        state.seconds += clock() - begun
        yield state, _make_info(state, config, time_left, result, stopped_by)


def _make_controls(frames: np.ndarray, config: FitConfig, find_motion: Callable[[], Motion]) -> list[DensityControl]:
    """What the settings ask for."""
    controls: list[DensityControl] = []
    followed = find_motion if config.follows_motion else lambda: None
    if config.is_compact:
        controls.append(RateControl(frames, config, followed))
    if relocates(config):
        controls.append(Relocation(frames, config, followed))
    if config.strategy.growth is not None:
        controls.append(Densification(config, frames.shape[1:3]))
    return controls


def _make_info(
    state: FitState, config: FitConfig, time_left: TimeLeft, result: StepResult, stopped_by: str | None
) -> FitInfo:
    done = 1.0 if stopped_by else measure_progress(state, config)
    return FitInfo(
        step=state.step,
        progress=done,
        loss=result.loss,
        psnr=running_psnr(state),
        num_gaussians=state.num_gaussians,
        num_alive=result.num_alive,
        seconds=state.seconds,
        seconds_left=0.0 if stopped_by else time_left.estimate(state, done),
        stopped_by=stopped_by,
    )


def _warm_up(frames: np.ndarray, config: FitConfig, engine: str) -> None:
    """Compile or load the kernels, on a corner of the clip, before any clock runs: the first time takes 20 s."""
    if engine != "cpu" and not config.is_compact and not relocates(config):
        return
    changes = {"views.interpolation_fraction": 0.0, "loss.name": "3dgs"}  # another loss may need the clip's size
    tiny = config.replace(num_gaussians=8, max_gaussians=None, steps=1, minutes=None, **changes)
    if config.is_compact:
        tiny = dataclasses.replace(tiny, quality=DEFAULT_QUALITY, size_mb=None, psnr=None)
    corner = np.ascontiguousarray(frames[:2, :32, :32])
    state = start(corner, dataclasses.replace(tiny, initialization="static"))
    for progress in (0.0, 1.0) if engine == "cpu" else ():  # with either loss
        make_stepper("cpu", corner, tiny, state, motion_finder(corner)).step(state, progress)
    if engine == "cpu" and config.follow_camera:
        rows = np.pad(state.rows, ((0, 0), (0, 1)), constant_values=1)
        maps = np.tile(np.eye(2, 3, dtype=np.float32), (len(corner), 1, 1, 1))
        state = FitState.create(rows, state.time_logits, path_maps=maps)
        make_stepper("cpu", corner, tiny, state, motion_finder(corner)).step(state, 0.0)
    if config.is_compact:
        arrange(to_model(state, tiny, corner.shape[1:3], 25.0), 0.0)
        count_bytes(RateControl(corner, tiny).finish(state))


# ------------------------------------------------------------------------------------------------ starts


def start(
    frames: np.ndarray,
    config: FitConfig,
    find_motion: Callable[[], Motion] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    cuts: Sequence[int] | None = None,
) -> FitState:
    """State before the first step; frame times start evenly in each shot."""
    find_motion = find_motion or motion_finder(frames)
    has_alpha = frames.shape[3] == 4
    begun, num_frames = clock(), len(frames)
    motion = find_motion() if config.follows_motion else None
    cuts = cuts if cuts is not None else motion.cuts if motion is not None else []
    logits = np.array(make_time_logits(num_frames, cuts), np.float32)
    choose_num = functools.partial(chosen_num_gaussians, config, *frames.shape[:3])
    shape = {"degree": config.fold_degree, "seed": config.seed, "envelope": envelope_of(config)}
    if config.initialization == "uniform":
        splats = initialize_uniform(choose_num(), frames.shape[1:3], **shape)
    else:
        times = np.asarray(FrameTimes(logits).times())
        opacity, paths = SUMMED_OPACITY if config.compositing == "sum" else START_OPACITY, None
        if motion is not None and config.follow_camera:
            # Also where the camera moves steadily if that takes no bits.
            maps = find_shared_motions(motion, steady=config.is_compact)
            if maps is not None:
                paths = SharedPaths(np.tile(np.float32(times), (len(maps), 1)), np.float32(maps))
        clip = {"times": times, "motion": motion, "opacity": opacity, "paths": paths}
        splats = initialize(frames, lambda life: choose_num(lifetime=life), **clip, **shape)
    if config.is_compact and config.compositing == "over" and not has_alpha and config.initialization != "uniform":
        splats = with_backdrop(splats, frames)
    rows = pack(splats)
    return FitState.create(
        rows,
        logits,
        **_path_fields(splats, logits),
        growing=config.strategy.growth is not None,
        plan=0 if config.minutes is not None else planned_steps(config, num_frames),
        seconds=clock() - begun,
    )


def start_from(model: VideoModel, config: FitConfig, steps: int, progress: float = 0.0) -> FitState:
    """State from which `fit_steps` continues a fitted model: the last `steps` of a plan, a fraction of which is done.

    Learning rates and loss are those of the schedule from `progress`, in [0, 1), to its end. Arrays are
    copied, moments start at zero, and no Gaussians are added. Raises ValueError for a model that `config` could not
    have fitted, and for other arguments out of range.

    Example: `for state, info in fit_steps(frames, config, start_from(model, config, 300, 0.7)): ...`
    """
    require(is_integer(steps, 1), "steps", expected="a whole number >= 1", got=repr(steps))
    require(is_within(progress, "[0, 1)"), "progress", expected="a number in [0, 1)", got=repr(progress))
    _check_config(model, config)
    rows, logits = pack(model.splats), np.array(model.frame_times.logits, np.float32)
    done = round(steps * progress / (1 - progress))
    fields = {"rate_actions": count_past(progress)} | _path_fields(model.splats, logits)
    return FitState.create(rows, logits, step=done, plan=done + steps, **fields)


def _check_config(model: VideoModel, config: FitConfig) -> None:
    """Raise ValueError unless a fit with `config` could have produced the model."""
    envelope = model.splats.envelope
    pairs = {
        "degree": (config.fold_degree, model.degree),
        "power": (np.float32(config.power), np.float32(envelope.power)),
        "floor": (np.float32(config.floor), np.float32(envelope.floor)),
        "compositing": (config.compositing, model.compositing),
        "options": (config.options, model.options),
        "strategy.scale_cutoff": (config.strategy.scale_cutoff, model.scale_cutoff),
    }
    for name, (got, expected) in pairs.items():
        require(
            np.all(got == expected),
            f"config.{name}",
            expected=f"the model's, {expected}",
            got=got,
            cure="Give the config that the model was fitted with.",
        )


def _path_fields(splats: FoldedSplats, logits: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of a state that hold shared paths, at its frame times."""
    if splats.paths is None:
        return {}
    paths, times = jax.tree.map(np.asarray, splats.paths), np.asarray(FrameTimes(logits).times())
    return {"path_maps": np.stack([paths.at(t) for t in times]).astype(np.float32)}


# ------------------------------------------------------------------------------------------------ checks


def check_frames(frames: np.ndarray) -> None:
    """Raise ValueError unless `frames` is a uint8 array (num_frames, height, width, 3 or 4), none of them 0."""
    shape, dtype = getattr(frames, "shape", None), getattr(frames, "dtype", None)
    require(
        shape is not None and len(shape) == 4 and shape[3] in (3, 4) and dtype == np.uint8 and 0 not in shape,
        "frames",
        expected="a uint8 array (num_frames, height, width, 3 or 4)",
        got=type(frames).__name__ if shape is None else f"{dtype} {shape}",
        cure=_cure_of_frames(frames, shape, dtype),
    )


def _cure_of_frames(frames: object, shape: tuple[int, ...] | None, dtype: np.dtype | None) -> str:
    """How to convert what was given to frames; no array is scaled automatically, since its range is unknown."""
    if shape is None:
        return "Stack them: np.stack(frames). From a file: read_video(path).frames."
    if dtype == np.uint16:
        return "From 16 bits: np.rint(frames / 257).astype(np.uint8)."
    if dtype is not None and dtype.kind == "f":
        bad = np.argwhere(~np.isfinite(np.asarray(frames)))
        if len(bad):
            where = ", ".join(map(str, bad[0]))
            return f"{len(bad):,} of its values are NaN or infinite, the first at frames[{where}]: replace them."
        return "From floats in [0, 1]: np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)."
    if len(shape) == 3:
        return "One frame: frames[None]. Gray frames: np.repeat(frames[..., None], 3, axis=-1)."
    return ""
