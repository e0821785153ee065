"""The fit: a loop of steps, each yielding (state, info). It knows arrays only; files and bars watch from outside."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from foldgauss._runtime import notebook_hooks
from foldgauss._runtime.checks import invalid, is_integer, is_within
from foldgauss._runtime.threads import check_not_forked
from foldgauss.render import cpu
from foldgauss.video.fitting.adam import sparse_adam
from foldgauss.video.fitting.codebook import Codebook
from foldgauss.video.fitting.config import UNIT_TIME, FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.densify import grow
from foldgauss.video.fitting.divergence import Guard
from foldgauss.video.fitting.economy import MIN_PASSES_PER_ROUND
from foldgauss.video.fitting.growth import GradientStatistics
from foldgauss.video.fitting.initialize import START_OPACITY, SUMMED_OPACITY, initialize, initialize_uniform
from foldgauss.video.fitting.optical_flow import Motion
from foldgauss.video.fitting.pruning.description_length import frame_weights
from foldgauss.video.fitting.pruning.pruner import Pruner
from foldgauss.video.fitting.schedule import (
    Level,
    Rates,
    level_at,
    levels,
    looked_at,
    shrunk,
    steps_per_pass,
    views_of,
    work_done,
)
from foldgauss.video.fitting.state import (
    TIME_ADAM,
    FitState,
    envelope_of,
    frame_times,
    mean_psnr,
    planar,
    running_psnr,
    to_model,
)
from foldgauss.video.fitting.state import update_times as _update_times
from foldgauss.video.fitting.steppers.engines import choose_engine
from foldgauss.video.fitting.steppers.jax_stepper import DeviceStepper
from foldgauss.video.fitting.steppers.loss import ImageLoss, image_loss, squared_loss
from foldgauss.video.models.background import random_background
from foldgauss.video.models.conditioning import (
    ConditionedSplats,
    ConditioningSpec,
    backpropagate,
    condition,
    update_windows,
)
from foldgauss.video.models.frame_times import FrameTimes, make_time_logits
from foldgauss.video.models.row_layout import columns, pack
from foldgauss.video.models.sparse_storage import find_initial_kinds, find_kinds
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel


class FitInfo(NamedTuple):
    """What one step tells its observers: loss of its batch, running PSNR in dB, counts, seconds."""

    step: int  #: steps done
    progress: float  #: share of the plan that is done, in [0, 1]
    loss: float  #: of this step's batch
    psnr: float  #: dB, running mean over about one pass through the frames, at the size they are seen at
    num_gaussians: int
    num_alive: int  #: Gaussians that took part in this step
    seconds: float  #: spent fitting so far
    seconds_left: float  #: by the pace so far
    stopped_by: str | None  #: at the last step, what bound: "steps", "minutes", "target_psnr" or "smallest_at_psnr"


@dataclasses.dataclass(frozen=True)
class FitResult:
    """What `fit` returns: the `model`, and as `history` the `FitInfo` of every `every`-th step and the last one."""

    model: VideoModel
    history: list[FitInfo]

    def __repr__(self) -> str:
        model, last = self.model, self.history[-1] if self.history else None
        height, width = model.size
        told = f"{model.num_frames} frames of {height}x{width}, {model.num_gaussians:,} Gaussians"
        if last is not None:
            told += f"; {last.psnr:.2f} dB after {last.step:,} steps, {last.seconds:.1f} s"
        return f"{type(self).__name__}({told})"

    def _repr_png_(self) -> bytes | None:
        """What a notebook shows: the course of the fit."""
        return notebook_hooks.show("history", self.history)


def fit(
    frames: np.ndarray,
    config: FitConfig | None = None,
    *,
    fps: float = 25.0,
    observers: Iterable[Callable[[FitState, FitInfo], None]] = (),
    every: int = 10,
) -> FitResult:
    """Fit a video of folded Gaussians to `frames`, uint8 (num_frames, height, width, 3), or with alpha (..., 4).

    Alpha, to which colours are premultiplied, is learned by drawing frames and splats over random backgrounds: `psnr`
    and `loss` are then those over these, and the model is drawn over black unless told otherwise.

    `observers` are called with (state, info) after every step: progress bars, checkpoints. Raises ValueError for
    frames or settings that cannot be fitted. No budget counts the compiling of kernels, some 20 s when they are used
    for the first time. Without `minutes` the bits are the same for any number of threads.

    Example: `fit(frames, FitConfig(steps=1000)).model.render(0.5)`. Source: VeGaS, section 4.
    """
    config = FitConfig() if config is None else config
    observers, history = list(observers), []
    if every < 1:
        raise invalid("every", expected="a whole number >= 1", got=every)
    for state, info in fit_steps(frames, config):
        for observe in observers:
            observe(state, info)
        if info.step % every == 0 or info.progress >= 1:
            history.append(info)
    return FitResult(to_model(state, config, frames.shape[1:3], fps), history)


def fit_steps(
    frames: np.ndarray, config: FitConfig, state: FitState | None = None, *, motion: Motion | None = None
) -> Iterator[tuple[FitState, FitInfo]]:
    """The steps of a fit, from the start or from a kept `state`: yields (state, info) after each one.

    `motion`: the frames' own, where it is known from before; finding it takes some hundredths of a second a frame.
    """
    check_not_forked()
    check_frames(frames)
    if frames.shape[3] == 4 and config.compositing == "sum":
        cure = "Sums let all light through: drop the alpha, or take 'over'."
        raise invalid("compositing", expected="'over' for frames with alpha", got="'sum'", cure=cure)
    if frames.shape[3] == 4 and config.interpolation_fraction > 0:
        cure = "Leave it out: the flow knows nothing of what is behind."
        raise invalid(
            "interpolation_fraction", expected="0 for frames with alpha", got=config.interpolation_fraction, cure=cure
        )
    engine = choose_engine(frames, config, state)
    _warm_up(frames, config, engine)
    flow = _Flow(frames, motion)
    state = _started(frames, config, None, flow) if state is None else state
    step = _Stepper(frames, config, state, flow) if engine == "cpu" else DeviceStepper(frames, config, state, engine)
    pace = _StepPlanner(config, [level.share for level in step.levels], len(frames))
    outlook = _Outlook(state, config, step.levels)
    guard = Guard(state, config, step.steps_per_pass, alpha=frames.shape[3] == 4)
    if state.step == 0 and guard.comparable and config.initialization == "clip":
        state.start_errors = tuple(step.errors_at_start(state).items())
    stopped_by = _stopped_by(state, config, frames)
    if stopped_by:  # a kept state that needs no more steps
        yield state, _info(state, config, outlook, math.nan, 0, stopped_by)
    while not stopped_by:
        begun = time.perf_counter()
        level = _level(state, step.levels)
        loss, squared_error, num_alive = step(state, _progress(state, config), level)
        another = state.plan > 0 and level != level_at(step.levels, (state.step - 1) / state.plan)
        memory = max(1 - config.batch_size / len(frames), 0.5) if state.error and not another else 0.0
        error_before = state.error
        if not math.isnan(squared_error) or not math.isfinite(loss):
            state.error = memory * state.error + (1 - memory) * squared_error
        state.step += 1
        if another or not state.plan:  # without a plan yet, levels take turns
            guard.restart(state)
            state.best_error = 0.0
        fault = guard.fault(state, loss)
        if fault:
            guard.back_off(state, fault, error_before)
            step = step.anew(state)
        else:
            guard.remember(state)
        if state.growing and state.plan:
            step.grow(state)
        if config.economy is not None and state.plan:
            step.take_stock(state)
        passed = time.perf_counter() - begun
        state.seconds += passed
        if not state.plan:
            state.plan = pace.plan(state, level, passed)
        begun = time.perf_counter()
        stopped_by = _stopped_by(state, config, frames)
        if stopped_by == "smallest_at_psnr":
            step.stock.trim(state)
        if stopped_by:
            guard.finish(state)
        state.seconds += time.perf_counter() - begun
        yield state, _info(state, config, outlook, loss, num_alive, stopped_by)


def _warm_up(frames: np.ndarray, config: FitConfig, engine: str) -> None:
    """Compile the kernels, or load them, on a corner of the clip, before any clock runs: the first time takes 20 s."""
    looks = config.target_psnr is not None or (config.economy is not None and config.economy.psnr is not None)
    if engine != "cpu" and not looks:
        return
    tiny = dataclasses.replace(config, num_gaussians=8, max_gaussians=None, max_size_mb=None, steps=1, minutes=None)
    tiny = dataclasses.replace(tiny, interpolation_fraction=0.0)
    corner = np.ascontiguousarray(frames[:2, :32, :32])
    state = start(corner, dataclasses.replace(tiny, follow_motion=False))
    for progress in (0.0, 1.0) if engine == "cpu" else ():  # with either loss
        _Stepper(corner, tiny, state)(state, progress)
    if looks:
        mean_psnr(state, tiny, corner)


class _StepPlanner:
    """Turns minutes into a number of steps, once: everything else in a fit is a function of steps, so that one which
    was stopped goes on as if it had not been."""

    def __init__(self, config: FitConfig, shares: list[float], num_frames: int):
        self.config, self.shares, self.count = config, shares, 0
        rounds = 0 if config.economy is None else config.economy.rounds
        self.taken = ROUND * rounds * num_frames / config.batch_size  # steps that taking stock is worth, at most
        self.seconds = [[] for _ in shares]  # of steps, by level

    def plan(self, state: FitState, level: int, seconds: float) -> int:
        """Steps of the whole fit, or 0 while the pace is not known yet; `seconds`: those of this step, at `level`."""
        if state.step == self.config.steps:
            return state.step
        budget = 60 * self.config.minutes
        if state.seconds >= budget:
            return state.step
        self.count += 1
        if self.count > WARM_UP * len(self.shares):
            self.seconds[level].append(seconds)
        enough = sum(map(sum, self.seconds)) >= budget * MEASURED
        enough |= self.config.steps is not None and state.step >= self.config.steps * MEASURED
        if min(map(len, self.seconds)) < LEAST_STEPS or not enough:
            return 0
        seconds = [np.mean(own) for own in self.seconds]
        # The steps so far count as steps of the first level, which this many are still left of.
        left = (budget - state.seconds) / SLOWER + state.step * seconds[0]
        if self.taken:
            left = left / GROWN - min(self.taken * seconds[-1], left * ROUND / (ROUND + MIN_PASSES_PER_ROUND))
        planned = max(int(left / np.dot(self.shares, seconds)), state.step)
        return min(planned, self.config.steps or planned)


def _progress(state: FitState, config: FitConfig) -> float:
    """Share of the plan that is done, above 1 in overtime; while there is none, of the steps asked for, or 0."""
    plan = state.plan or config.steps
    return state.step / plan if plan else 0.0


def _level(state: FitState, levels: list[Level]) -> int:
    """The level of the next step; while the pace is measured, all in turn."""
    return level_at(levels, state.step / state.plan) if state.plan else state.step % len(levels)


def _stopped_by(state: FitState, config: FitConfig, frames: np.ndarray) -> str | None:
    """The budget that binds now."""
    if config.target_psnr is not None and _reaches(config.target_psnr, state, config, frames):
        return "target_psnr"
    # The pace that minutes are planned by is that of the Gaussians at the start, and of steps alone: where they grow,
    # or frames are looked at between steps, the clock decides.
    by_clock = config.growth is not None or config.target_psnr is not None or config.economy is not None
    late = by_clock and config.minutes is not None and state.seconds >= 60 * config.minutes
    wanted = None if config.economy is None else config.economy.psnr
    if wanted is not None and state.plan:
        over = late or state.step >= OVERTIME * state.plan
        if not over and (state.step < state.plan or (state.step - state.plan) % len(frames)):
            return None
        if np.isfinite(state.rows).all() and mean_psnr(state, config, frames) >= wanted:
            return "smallest_at_psnr"
        if not over:
            return None
    if late:
        return "minutes"
    if not state.plan or state.step < state.plan:
        return None
    return "minutes" if config.minutes is not None and state.plan != config.steps else "steps"


def _reaches(target: float, state: FitState, config: FitConfig, frames: np.ndarray) -> bool:
    """Whether the mean PSNR over all frames is `target`, looked at once in `LOOK_PASSES` passes.

    The running one says little of it: it lags, is that of a mean over unlike frames, and with alpha one over random
    backgrounds.
    """
    steps = steps_per_pass(config, len(frames))
    due = state.step > 0 and state.step % (LOOK_PASSES * steps) == 0
    return due and bool(np.isfinite(state.rows).all()) and mean_psnr(state, config, frames) >= target


class _Outlook:
    """How long a fit will still take, by the pace of the steps since it began or went on, but for the first few."""

    def __init__(self, state: FitState, config: FitConfig, levels: list[Level]):
        self.config, self.levels, self.first = config, levels, state.step + WARM_UP
        self.seconds, self.work = math.nan, math.inf

    def seconds_left(self, state: FitState, progress: float) -> float:
        """At most what is left of the minutes, where there are any."""
        most = math.inf if self.config.minutes is None else max(60 * self.config.minutes - state.seconds, 0.0)
        work = work_done(self.levels, progress)
        if state.step <= self.first or not state.plan:
            self.seconds, self.work = state.seconds, work
        known = work > self.work
        return min((state.seconds - self.seconds) * (1 - work) / (work - self.work), most) if known else most


def _info(
    state: FitState, config: FitConfig, outlook: _Outlook, loss: float, num_alive: int, stopped_by: str | None
) -> FitInfo:
    done = 1.0 if stopped_by else min(_progress(state, config), 0.999)  # a PSNR asked for may take overtime
    left = 0.0 if stopped_by else outlook.seconds_left(state, done)
    num = state.num_gaussians
    return FitInfo(state.step, done, loss, running_psnr(state), num, num_alive, state.seconds, left, stopped_by)


def start(frames: np.ndarray, config: FitConfig, logits: np.ndarray | None = None) -> FitState:
    """State before the first step; frame times start at softmax weights `logits`, or by default evenly in each shot."""
    return _started(frames, config, logits, _Flow(frames))


def _started(frames: np.ndarray, config: FitConfig, logits: np.ndarray | None, flow: "_Flow") -> FitState:
    frames = np.ascontiguousarray(frames[..., :3])  # as seen over black, where there is alpha
    begun, num_frames = time.perf_counter(), len(frames)
    motion = flow.motion if config.follow_motion else None
    if logits is None:
        logits = make_time_logits(num_frames, motion.cuts() if motion is not None else [])
    logits = np.array(logits, np.float32)
    rows = pack(_splats(frames, config, logits, motion))
    return FitState(
        rows=rows,
        first=np.zeros_like(rows),
        second=np.zeros_like(rows),
        counts=np.zeros(len(rows), np.int32),
        kinds=find_initial_kinds(rows, config.degree),
        young=np.zeros(len(rows), bool),
        colors=Codebook.of(None, 3),
        shapes=Codebook.of(None, 2),
        frame_errors=np.zeros(num_frames, np.float32),
        time_logits=logits,
        time_moments=TIME_ADAM.init(jnp.asarray(logits)),
        statistics=None if config.growth is None else GradientStatistics.zeros(len(rows)),
        step=0,
        plan=0 if config.minutes is not None else planned_steps(config, num_frames),
        seconds=time.perf_counter() - begun,
        error=0.0,
    )


def start_from(model: VideoModel, config: FitConfig, steps: int, progress: float = 0.0) -> FitState:
    """State from which `fit_steps` goes on with a fitted model: the last `steps` of a plan of which a share is done.

    So rates, sizes and loss are those of the schedule from `progress`, in [0, 1), to its end. Arrays are copied,
    moments start at zero, and no Gaussians are born. Raises ValueError for a model that `config` could not have fitted,
    and anything else out of range.

    Example: `for state, info in fit_steps(frames, config, start_from(model, config, 300, 0.7)): ...`
    """
    if not is_integer(steps, 1):
        raise invalid("steps", expected="a whole number >= 1", got=repr(steps))
    if not is_within(progress, "[0, 1)"):
        raise invalid("progress", expected="a number in [0, 1)", got=repr(progress))
    _check_config(model, config)
    rows, logits = pack(model.splats), np.array(model.frame_times.logits, np.float32)
    done = round(steps * progress / (1 - progress))
    return FitState(
        rows=rows,
        first=np.zeros_like(rows),
        second=np.zeros_like(rows),
        counts=np.zeros(len(rows), np.int32),
        kinds=find_kinds(rows, config.degree),
        young=np.zeros(len(rows), bool),
        colors=Codebook.of(None, 3),
        shapes=Codebook.of(None, 2),
        frame_errors=np.zeros(model.num_frames, np.float32),
        time_logits=logits,
        time_moments=TIME_ADAM.init(jnp.asarray(logits)),
        statistics=None,
        step=done,
        plan=done + steps,
        seconds=0.0,
        error=0.0,
    )


def _check_config(model: VideoModel, config: FitConfig) -> None:
    """Raise unless a fit with `config` ends with a model of this kind."""
    envelope = model.splats.envelope
    pairs = {
        "degree": (config.degree, model.degree),
        "power": (np.float32(config.power), np.float32(envelope.power)),
        "floor": (np.float32(config.floor), np.float32(envelope.floor)),
        "compositing": (config.compositing, model.compositing),
        "options": (config.options, model.options),
    }
    for name, (got, expected) in pairs.items():
        if not np.all(got == expected):
            cure = "Give the config that the model was fitted with."
            raise invalid(f"config.{name}", expected=f"the model's, {expected}", got=got, cure=cure)
    if model.scale_cutoff != 0:
        cure = "Imported videos with one cannot be fitted further."
        raise invalid("model.scale_cutoff", expected="0", got=model.scale_cutoff, cure=cure)


def _splats(frames: np.ndarray, config: FitConfig, logits: np.ndarray, motion: Motion | None) -> FoldedSplats:
    """Where the Gaussians start."""
    num, shape = chosen_num_gaussians(config, *frames.shape[:3]), {"degree": config.degree, "seed": config.seed}
    if config.initialization == "uniform":
        return initialize_uniform(num, frames.shape[1:3], envelope=envelope_of(config), **shape)
    times = np.asarray(FrameTimes(logits).times())
    opacity = SUMMED_OPACITY if config.compositing == "sum" else START_OPACITY
    clip = {"times": times, "motion": motion, "opacity": opacity, "lasting": config.economy is not None}
    return initialize(frames, num, envelope=envelope_of(config), **clip, **shape)


def check_frames(frames: np.ndarray) -> None:
    """Raise ValueError unless `frames` is a uint8 array (num_frames, height, width, 3 or 4), none of them 0."""
    shape, dtype = getattr(frames, "shape", None), getattr(frames, "dtype", None)
    if shape is None or len(shape) != 4 or shape[3] not in (3, 4) or dtype != np.uint8 or 0 in shape:
        got = type(frames).__name__ if shape is None else f"{dtype} {shape}"
        expected = "a uint8 array (num_frames, height, width, 3 or 4)"
        raise invalid("frames", expected=expected, got=got, cure=_cure_of_frames(frames, shape, dtype))


def _cure_of_frames(frames: object, shape: tuple[int, ...] | None, dtype: np.dtype | None) -> str:
    """What makes frames of an array that is none; pixels are never scaled unasked, since no array says of what."""
    if shape is None:
        return "Stack them: np.stack(frames). Of a file: read_video(path).frames."
    if dtype == np.uint16:
        return "From 16 bits: np.rint(frames / 257).astype(np.uint8)."
    if dtype is not None and dtype.kind == "f":
        bad = np.argwhere(~np.isfinite(np.asarray(frames)))
        if len(bad):
            where = ", ".join(map(str, bad[0]))
            return f"{len(bad):,} of its numbers are NaN or infinite, the first at frames[{where}]: replace them."
        return "From floats in [0, 1]: np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)."
    if len(shape) == 3:
        return "One picture: frames[None]. Grey ones: np.repeat(frames[..., None], 3, axis=-1)."
    return ""


class _Flow:
    """The motion of a clip, found when it is first asked for."""

    def __init__(self, frames: np.ndarray, motion: Motion | None = None):
        self._frames, self._motion = frames, motion

    @property
    def motion(self) -> Motion:
        if self._motion is None:
            self._motion = Motion.of(np.ascontiguousarray(self._frames[..., :3]))
        return self._motion


class _Stepper:
    """One step of the fit: buffers and constants that every step shares."""

    def __init__(self, frames: np.ndarray, config: FitConfig, state: FitState, flow: _Flow | None = None):
        self.frames, self.config = frames, config
        self.background = np.zeros(3, np.float32)  # another in every step for frames with alpha
        self.num_frames, height, width, _ = frames.shape
        self.levels = levels(config, (height, width))
        own = config.degree, config.power, config.floor
        self.shapes = [ConditioningSpec(*own, level.size, aspect=height / width) for level in self.levels[:-1]]
        self.shapes.append(ConditioningSpec(*own, (height, width)))
        self.rates = Rates(config)
        self.flow = _Flow(frames) if flow is None else flow
        self.between = _Between(frames, config, self.flow.motion) if config.interpolation_fraction > 0 else None
        if config.economy is not None:
            coarse = 1 - self.levels[-1].share
            self.stock = Pruner(frames, config, self.shapes[-1], coarse, lambda: self.flow.motion)
        self._make_room(state)

    def _make_room(self, state: FitState) -> None:
        """Buffers as long as the state's arrays."""
        self.grad = np.zeros_like(state.rows)
        self.window = np.empty((len(state.rows), 2), np.float32)
        update_windows(state.rows, np.arange(len(state.rows)), self.window)

    def __call__(self, state: FitState, progress: float, level: int = -1) -> tuple[float, float, int]:
        """Advance `state` by frames of a level; returns loss, mean squared error and how many Gaussians took part.

        The error is that of frames; NaN where all the batch lies between frames.
        """
        if self.frames.shape[3] == 4:
            self.background = random_background(self.config.seed, state.step)
        times = np.asarray(frame_times(state.time_logits))
        by_time = np.zeros_like(times)
        losses, alive, squared, errors = [], [], progress >= 1 - self.config.l2_fraction, []
        views = None if state.statistics is None else []
        for view in self._batch(state.step):
            k = int(view) % self.num_frames
            mirrored = int(view) >= self.num_frames
            share = None if self.between is None else self.between.share(state.step, k)
            how = {"squared": squared, "mirrored": mirrored, "views": views, "share": share}
            t = times[k] if share is None else (1 - share) * times[k] + share * times[k + 1]
            loss, done, d_time = self._frame(state, k, t, self.shapes[level], **how)
            if share is None:
                by_time[k] += d_time  # a batch may hold a frame twice
                errors.append(loss.mean_squared_error)
            losses.append(loss)
            alive.append(done.alive)
        if state.statistics is not None:
            state.statistics.add(views, self.grad[:, columns(self.config.degree)["time_loc_logit"]][:, 0])
        touched = alive[0] if len(alive) == 1 else np.unique(np.concatenate(alive))
        num_alive = len(touched)
        if not self.config.sparse_updates:
            touched = np.arange(len(state.rows))
        rates, rate_of_times = self.rates.at(progress, state.backoffs)
        moments = state.first, state.second, state.counts
        unit = UNIT_TIME if self.config.scale_rates_by_duration else 0.0
        for name, palette in (("color_dc", state.colors), ("log_scale", state.shapes)):
            at = columns(self.config.degree)[name]
            palette.step(state.rows[:, at], self.grad[:, at], touched, rates[at])
        sparse_adam(state.rows, self.grad, *moments, touched, rates, kinds=state.kinds, unit_time=unit)
        update_windows(state.rows, touched, self.window)
        if self.config.learn_frame_times and self.num_frames > 2:
            moved = _update_times(state.time_logits, state.time_moments, by_time, rate_of_times)
            state.time_logits, state.time_moments = moved
        squared_error = float(np.mean(errors)) if errors else math.nan
        return float(np.mean([loss.value for loss in losses])), squared_error, num_alive

    @property
    def steps_per_pass(self) -> int:
        return steps_per_pass(self.config, self.num_frames)

    def anew(self, state: FitState) -> "_Stepper":
        """For a state whose arrays are others now."""
        return _Stepper(self.frames, self.config, state, self.flow)

    def errors_at_start(self, state: FitState) -> dict[int, float]:
        """Mean squared errors of some frames at full size, by frame; takes time, which is the fit's."""
        begun, shape, errors = time.perf_counter(), self.shapes[-1], {}
        times = np.asarray(frame_times(state.time_logits))
        for k in looked_at(self.num_frames):
            image = self._drawn(condition(state.rows, self.window, times[k], shape), shape).image
            errors[int(k)] = float(np.mean(np.square(image - planar(self.frames[k], self.background))))
        state.seconds += time.perf_counter() - begun
        return errors

    def grow(self, state: FitState) -> None:
        """Births, deaths and resets that are due."""
        if grow(state, self.config, self.shapes[-1].size):
            self._make_room(state)

    def _weight(self, errors: np.ndarray, k: int) -> float:
        """Of frame k's loss. For the mean PSNR what counts is by how many dB a frame gets better."""
        wanted = self.config.economy is not None and self.config.economy.psnr is not None
        return float(frame_weights(errors)[k]) if wanted else 1.0

    def take_stock(self, state: FitState) -> None:
        if self.stock.take(state):
            self._make_room(state)

    def _batch(self, step: int) -> np.ndarray:
        return views_of(self.config, self.num_frames, step)

    def _frame(
        self,
        state: FitState,
        k: int,
        t: np.float32,
        shape: ConditioningSpec,
        *,
        squared: bool,
        mirrored: bool,
        views: list[tuple[np.ndarray, np.ndarray]] | None,
        share: float | None = None,
    ) -> tuple[ImageLoss, ConditionedSplats, float]:
        """Loss of frame k, or of what lies `share` of the way to the next; gradients are added to `self.grad`, dL/dt is
        returned.

        To `views`, where asked for, comes what `GradientStatistics.add` wants.
        """
        if share is None:
            target = planar(shrunk(self.frames[k], shape.size), self.background)
        else:
            target = self.between.target(k, share, shape.size)
        rows = state.rows
        done = condition(rows, self.window, t, shape)
        mean, factor = done.mean, done.factor
        if mirrored:
            target = np.ascontiguousarray(target[:, :, ::-1])
            mean, factor = _mirrored(mean, factor, shape.size[1])
        trace = self._drawn(dataclasses.replace(done, mean=mean, factor=factor), shape)
        if squared:
            loss = squared_loss(trace.image, target)
        else:
            loss = image_loss(trace.image, target, ssim_fraction=self.config.ssim_fraction)
        weight = 1.0
        if share is None:
            state.frame_errors[k] = loss.mean_squared_error
            weight = self._weight(state.frame_errors, k)
        d_mean, d_factor, *others, _ = cpu.backward(trace, loss.gradient * np.float32(weight / self.config.batch_size))
        if mirrored:
            d_mean, d_factor = _mirrored(d_mean, d_factor, 0)
        if views is not None:
            seen = trace.visible
            half = np.float32(shape.size[::-1]) / 2
            views.append((done.alive[seen], cpu.screen_gradient(d_mean[seen] * half)))
        return loss, done, backpropagate(rows, done, (d_mean, d_factor, *others), shape, self.grad)

    def _drawn(self, done: ConditionedSplats, shape: ConditioningSpec) -> cpu.Trace:
        return cpu.forward(
            done.mean,
            done.factor,
            done.opacity,
            done.color,
            self.background,
            shape.size,
            compositing=self.config.compositing,
            options=self.config.options,
        )


class _Between:
    """What a fit learns of the times between frames: which ones, and what is to be seen there."""

    def __init__(self, frames: np.ndarray, config: FitConfig, motion: Motion):
        self.frames, self.config = np.ascontiguousarray(frames[..., :3]), config
        self.motion = motion
        self.last_of_shots = {*(k - 1 for k in self.motion.cuts()), len(frames) - 1}

    def share(self, step: int, k: int) -> float | None:
        """How far from frame k to the next the time of a step lies; None for the frame itself."""
        rng = np.random.default_rng([self.config.seed, 2, step, k])
        chosen, share = rng.random() < self.config.interpolation_fraction, rng.uniform(0.1, 0.9)
        return share if chosen and step and k not in self.last_of_shots else None

    def target(self, k: int, share: float, size: tuple[int, int]) -> np.ndarray:
        """Planes (3, height, width)."""
        guess = self.motion.between(self.frames, k, share, size)
        return np.ascontiguousarray(np.moveaxis(guess, -1, 0) * np.float32(1 / 255))


def _mirrored(mean: np.ndarray, factor: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Splats as the camera opposite sees them, in pixels, left for right; its transpose, for gradients, at width 0."""
    other = np.float32([-1, 1])
    return mean * other + np.float32([width, 0]), factor * other[:, None]


#: A fit to a target looks at all frames once in so many passes, which is a tenth of its time.
LOOK_PASSES = 4
#: A fit that is to be the smallest at a PSNR, and has not reached that, goes on to so many times its plan.
OVERTIME = 1.5
#: Births make steps slower by this much, at first.
GROWN = 1.15
#: Taking stock of a frame costs as much as so many steps with it: a pass forward and four back.
ROUND = 2.0
#: The pace is measured after so many steps, in which kernels are compiled or loaded, over at least so many and this
#: share of the time.
WARM_UP, LEAST_STEPS, MEASURED = 5, 10, 0.05
#: Steps of the whole fit are slower than the first ones by this: Gaussians grow longer in time.
SLOWER = 1.05
