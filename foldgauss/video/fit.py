"""The fit: a loop of steps, each yielding (state, info). It knows arrays only; files and bars watch from outside."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from numbers import Integral, Real
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from foldgauss._checks import invalid
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions, cpu
from foldgauss.video.conditioning import Conditioned, Shape, condition, pull_back, update_windows
from foldgauss.video.frame_times import FrameTimes
from foldgauss.video.initialize import initialize
from foldgauss.video.loss import ImageLoss, image_loss
from foldgauss.video.model import VideoModel
from foldgauss.video.packing import columns, pack, unpack
from foldgauss.video.sparse_adam import sparse_adam


@dataclasses.dataclass(frozen=True)
class LearningRates:
    """Adam rates at the first step, by leaf; model space (the frame's longer side is 1)."""

    loc: float = 6.9e-4
    coefficients: float = 4e-3
    log_scale: float = 0.06
    angle_logit: float = 0.06
    opacity_logit: float = 0.15
    color_dc: float = 0.06
    time_loc_logit: float = 0.02
    log_time_scale: float = 0.1
    frame_times: float = 3e-3

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise invalid(f"rates.{name}", expected="a finite number >= 0", got=value)


#: Beyond, powers of u and their gradients no longer tell the coefficients apart in float32.
MAX_DEGREE = 16
#: 0.1 px^2 of low pass fits finer detail than the usual 0.3.
FINE = RenderOptions(low_pass=0.1)


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Everything a fit depends on beside the frames.

    At most one of `steps` and `minutes` is given; with neither, `DEFAULT_STEPS` or more for long clips.
    """

    num_gaussians: int | None = None  # None: by the size of the frames, `default_num_gaussians`
    degree: int = 3
    steps: int | None = None
    minutes: float | None = None
    batch_size: int = 1
    power: float = 2.0  # of the envelope: 1 as in the paper's text, 2 as in its code
    floor: float = 0.0  # of the envelope
    ssim_share: float = 0.2
    seed: int = 0
    learn_frame_times: bool = True
    rates: LearningRates = LearningRates()
    final_rate: float = 0.07  # all rates fall exponentially to this share of themselves
    options: RenderOptions = FINE

    def __post_init__(self) -> None:
        whole = {"num_gaussians": 1, "degree": 0, "steps": 1, "batch_size": 1, "seed": 0}
        for name, least in whole.items():
            value = getattr(self, name)
            if value is None and name in ("num_gaussians", "steps"):
                continue
            if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
                raise invalid(name, expected=f"a whole number >= {least}", got=repr(value))
            object.__setattr__(self, name, int(value))  # NumPy's integers have no place in a checkpoint
        if self.degree > MAX_DEGREE:
            raise invalid("degree", expected=f"at most {MAX_DEGREE}", got=self.degree)
        if self.steps is not None and self.minutes is not None:
            raise invalid("steps, minutes", expected="at most one of them", got="both")
        # "[" includes the bound, "(" does not.
        ranges = {
            "minutes": "(0, inf)",
            "power": "[0, 16]",
            "floor": "[0, 1)",
            "ssim_share": "[0, 1]",
            "final_rate": "[0, 1]",
        }
        for name, bounds in ranges.items():
            value = getattr(self, name)
            if value is None and name == "minutes":
                continue
            if not _within(value, bounds):
                raise invalid(name, expected=f"a number in {bounds}", got=repr(value))
            object.__setattr__(self, name, float(value))
        kinds = {"learn_frame_times": bool, "rates": LearningRates, "options": RenderOptions}
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):
                raise invalid(name, expected=f"a {kind.__name__}", got=repr(getattr(self, name)))


def _within(value: object, bounds: str) -> bool:
    """Whether `value` is a finite number in an interval written as "[0, 1)"."""
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        return False
    low, high = (float(part) for part in bounds[1:-1].split(","))
    return (low < value or (bounds[0] == "[" and low == value)) and (
        value < high or (bounds[-1] == "]" and value == high)
    )


#: Steps where neither steps nor minutes are given: this many, and at least so many visits to every frame.
DEFAULT_STEPS, DEFAULT_VISITS = 3000, 12


class FitInfo(NamedTuple):
    """What one step tells its observers."""

    step: int  # steps done
    progress: float  # share of the plan that is done, in [0, 1]
    loss: float  # of this step's batch
    psnr: float  # dB, running mean over about one pass through the frames
    num_gaussians: int
    num_alive: int  # Gaussians that took part in this step
    seconds: float  # spent fitting so far
    seconds_left: float  # by the pace so far


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["rows", "first", "second", "counts", "time_logits", "time_moments"],
    meta_fields=["step", "seconds", "error"],
)
@dataclasses.dataclass
class FitState:
    """The arrays of a running fit. A step consumes its state: as with donated buffers, arrays are updated in place."""

    rows: np.ndarray  # float32 (num, width): see `packing`
    first: np.ndarray  # Adam's moments, likewise
    second: np.ndarray
    counts: np.ndarray  # int32 (num,): steps each Gaussian has taken
    time_logits: np.ndarray  # float32 (num_frames - 1,)
    time_moments: optax.OptState
    step: int
    seconds: float
    error: float  # running mean of the squared error


@dataclasses.dataclass(frozen=True)
class FitResult:
    """The fitted model, and the info of the steps that were kept (every `every`-th)."""

    model: VideoModel
    history: list[FitInfo]


def default_num_gaussians(height: int, width: int) -> int:
    """40,000 for 160x320, growing as the square root of the pixels: larger frames are smoother per pixel."""
    return round(177 * math.sqrt(height * width))


def fit(
    frames: np.ndarray,
    config: FitConfig | None = None,
    *,
    fps: float = 25.0,
    observers: Iterable[Callable[[FitState, FitInfo], None]] = (),
    every: int = 10,
) -> FitResult:
    """Fit a video of folded Gaussians to `frames`, uint8 (num_frames, height, width, 3).

    `observers` are called with (state, info) after every step: progress bars, checkpoints. Raises ValueError for
    frames or settings that cannot be fitted. A `config` with `steps` gives the same bits for any number of threads.

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
    frames: np.ndarray, config: FitConfig, state: FitState | None = None
) -> Iterator[tuple[FitState, FitInfo]]:
    """The steps of a fit, from the start or from a kept `state`: yields (state, info) after each one."""
    check_frames(frames)
    state = start(frames, config) if state is None else state
    planes = np.ascontiguousarray(np.moveaxis(frames, -1, 1))  # planar, as the kernels want them
    step = _Stepper(planes, config, state)
    progress = _progress(state, config, len(frames))
    if progress >= 1:  # a kept state that needs no more steps
        yield state, _info(state, progress, loss=math.nan, num_alive=0)
    while progress < 1:
        begun = time.perf_counter()
        loss, squared_error, num_alive = step(state, progress)
        memory = max(1 - config.batch_size / len(frames), 0.5) if state.step else 0.0
        state.error = memory * state.error + (1 - memory) * squared_error
        state.step += 1
        state.seconds += time.perf_counter() - begun
        progress = _progress(state, config, len(frames))
        yield state, _info(state, progress, loss, num_alive)


def _info(state: FitState, progress: float, loss: float, num_alive: int) -> FitInfo:
    left = state.seconds * (1 - progress) / progress if progress > 0 else math.inf
    psnr = -10 * math.log10(max(state.error, 1e-12))
    return FitInfo(state.step, progress, loss, psnr, len(state.rows), num_alive, state.seconds, left)


def start(frames: np.ndarray, config: FitConfig) -> FitState:
    """State before the first step."""
    num_frames, height, width, _ = frames.shape
    splats = initialize(
        frames,
        config.num_gaussians or default_num_gaussians(height, width),
        degree=config.degree,
        envelope=_envelope(config),
        seed=config.seed,
    )
    rows, time_logits = pack(splats), np.asarray(FrameTimes.uniform(num_frames).logits)
    return FitState(
        rows=rows,
        first=np.zeros_like(rows),
        second=np.zeros_like(rows),
        counts=np.zeros(len(rows), np.int32),
        time_logits=time_logits,
        time_moments=TIME_ADAM.init(jnp.asarray(time_logits)),
        step=0,
        seconds=0.0,
        error=0.0,
    )


def to_model(state: FitState, config: FitConfig, size: tuple[int, int], fps: float) -> VideoModel:
    """The model as it stands in `state` (arrays are copied)."""
    return VideoModel(
        splats=unpack(state.rows, config.degree, _envelope(config)),
        frame_times=FrameTimes(state.time_logits.copy()),
        size=tuple(int(n) for n in size),
        fps=float(fps),
        options=config.options,
    )


def check_frames(frames: np.ndarray) -> None:
    """Raise ValueError unless `frames` is a uint8 array (num_frames >= 2, height, width, 3)."""
    shape, dtype = getattr(frames, "shape", None), getattr(frames, "dtype", None)
    if shape is None or len(shape) != 4 or shape[3] != 3 or shape[0] < 2 or dtype != np.uint8 or 0 in shape:
        raise invalid(
            "frames",
            expected="a uint8 array (num_frames >= 2, height, width, 3)",
            got=f"{dtype} {shape}",
        )


class _Stepper:
    """One step of the fit: buffers and constants that every step shares."""

    def __init__(self, planes: np.ndarray, config: FitConfig, state: FitState):
        self.planes, self.config = planes, config
        num_frames, _, height, width = planes.shape
        self.num_frames = num_frames
        self.shape = Shape(config.degree, config.power, config.floor, (height, width))
        self.rates = np.empty(state.rows.shape[1], np.float32)
        for name, place in columns(config.degree).items():
            self.rates[place] = getattr(config.rates, name)
        self.black = np.zeros(3, np.float32)
        self.grad = np.zeros_like(state.rows)
        self.window = np.empty((len(state.rows), 2), np.float32)
        update_windows(state.rows, np.arange(len(state.rows)), self.window)

    def __call__(self, state: FitState, progress: float) -> tuple[float, float, int]:
        """Advance `state`; returns loss, mean squared error and the number of Gaussians that took part."""
        decay = self.config.final_rate**progress if self.config.final_rate > 0 else 1 - progress
        times = np.asarray(_frame_times(state.time_logits))
        by_time = np.zeros_like(times)
        losses, alive = [], []
        for k in self._batch(state.step):
            loss, done, d_time = self._frame(state.rows, int(k), times[k])
            by_time[k] += d_time  # a batch may hold a frame twice
            losses.append(loss)
            alive.append(done.alive)
        touched = alive[0] if len(alive) == 1 else np.unique(np.concatenate(alive))
        rates = self.rates * np.float32(decay)
        sparse_adam(state.rows, self.grad, state.first, state.second, state.counts, touched, rates)
        update_windows(state.rows, touched, self.window)
        if self.config.learn_frame_times and self.num_frames > 2:
            rate = np.float32(self.config.rates.frame_times * decay)
            state.time_logits, state.time_moments = _update_times(state.time_logits, state.time_moments, by_time, rate)
        mean = np.mean([(loss.value, loss.mean_squared_error) for loss in losses], axis=0)
        return float(mean[0]), float(mean[1]), len(touched)

    def _batch(self, step: int) -> np.ndarray:
        """Frames of a step: every pass visits all frames once, in an order that depends on seed and pass only."""
        first = step * self.config.batch_size
        positions = np.arange(first, first + self.config.batch_size)
        return np.array([self._order(p // self.num_frames)[p % self.num_frames] for p in positions])

    def _order(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.config.seed, 1, epoch]).permutation(self.num_frames)

    def _frame(self, rows: np.ndarray, k: int, t: np.float32) -> tuple[ImageLoss, Conditioned, float]:
        """Loss of frame k; its gradients are added to `self.grad`, dL/dt_k is returned."""
        target = np.multiply(self.planes[k], np.float32(1 / 255), dtype=np.float32)
        done = condition(rows, self.window, t, self.shape)
        trace = cpu.forward(
            done.mean,
            done.factor,
            done.opacity,
            done.color,
            self.black,
            self.shape.size,
            options=self.config.options,
        )
        loss = image_loss(trace.image, target, ssim_share=self.config.ssim_share)
        *gradients, _ = cpu.backward(trace, loss.gradient / np.float32(self.config.batch_size))
        return loss, done, pull_back(rows, done, tuple(gradients), self.shape, self.grad)


def planned_steps(config: FitConfig, num_frames: int) -> int | None:
    """Steps of the whole fit; None where time, not steps, ends it."""
    if config.minutes is not None:
        return None
    return config.steps or max(DEFAULT_STEPS, -(-DEFAULT_VISITS * num_frames // config.batch_size))


def _progress(state: FitState, config: FitConfig, num_frames: int) -> float:
    steps = planned_steps(config, num_frames)
    share = state.seconds / (60 * config.minutes) if steps is None else state.step / steps
    return min(share, 1.0)


def _envelope(config: FitConfig) -> TimeLikelihood:
    return TimeLikelihood(power=np.float32(config.power), floor=np.float32(config.floor))


TIME_ADAM = optax.scale_by_adam(eps=1e-15)


@jax.jit
def _frame_times(logits):
    return FrameTimes(logits).times()


@jax.jit
def _update_times(logits, moments, by_time, rate):
    """Adam on the softmax weights, given dL/dt_k."""
    _, pull = jax.vjp(lambda w: FrameTimes(w).times(), logits)
    with jax.numpy_dtype_promotion("standard"):  # optax raises Python floats to integer counts
        update, moments = TIME_ADAM.update(pull(by_time)[0], moments)
    return logits - rate * update, moments
