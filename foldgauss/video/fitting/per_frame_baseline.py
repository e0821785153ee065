"""The per-frame baseline: every frame has its own flat Gaussians, and nothing is shared over time (eq:miragevideo)."""

import dataclasses
import time
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import UInt8

from foldgauss._runtime.checks import invalid, is_integer
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.fitting.config import FitConfig, LearningRates
from foldgauss.video.fitting.initialize import START_OPACITY, SUMMED_OPACITY, initialize
from foldgauss.video.fitting.loop import check_frames, fit_steps, start_from, to_model
from foldgauss.video.models.background import BLACK
from foldgauss.video.models.frame_times import FrameTimes, check_rate
from foldgauss.video.models.video_model import VideoModel

#: Parameters of a Gaussian without time: position 2, scales 2, angle, opacity, color 3.
PARAMETERS = 9
#: Factors of the fit's learning rates, which are meant for Gaussians that many frames act on; the second of positions.
#: (Frames of Bunny 160x320 and bikes 272x640, 560 Gaussians, 200 steps: 26.8 and 35.2 dB with half of these, 27.4 and
#: 36.3 with these, 27.1 and 36.1 with twice all; 400 steps: 27.7 and 37.1, 27.8 and 37.3, 27.8 and 37.2.)
RATE_FACTOR, LOC_RATE_FACTOR = 4.0, 8.0
#: Steps of each frame where neither steps nor minutes are given, and those by which the speed is measured first.
DEFAULT_STEPS, PILOT_STEPS = 500, 30


@dataclasses.dataclass(frozen=True)
class IndependentFrames:
    """A clip as one model per frame: a video without folds, times or anything shared between frames.

    `models` are video models of one frame each; `steps` and `seconds` are totals over all fits. `frames`, `size`,
    `num_frames`, `num_gaussians` and `num_parameters` are as a video model's, so `evaluate` accepts either.
    """

    models: tuple[VideoModel, ...]
    fps: float
    steps: int
    seconds: float

    @property
    def size(self) -> tuple[int, int]:
        return self.models[0].size

    @property
    def num_frames(self) -> int:
        return len(self.models)

    @property
    def num_gaussians(self) -> int:
        return sum(model.num_gaussians for model in self.models)

    @property
    def num_parameters(self) -> int:
        """Numbers that must be stored: `PARAMETERS` for each Gaussian. No m_t, sigma_t or fold, and no frame times."""
        return PARAMETERS * self.num_gaussians

    def frames(
        self, size: tuple[int, int] | None = None, *, background: tuple[float, float, float] = BLACK
    ) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """The frames one by one; there is nothing between them."""
        for model in self.models:
            yield from model.frames(size=size, background=background)


def independent_frames(
    frames: UInt8[np.ndarray, "num_frames height width channels"],
    num_parameters: int,
    config: FitConfig | None = None,
    *,
    fps: float = 25.0,
    on_frame: Callable[[int, VideoModel], None] = lambda k, model: None,
) -> IndependentFrames:
    r"""Fit each frame alone, with as many Gaussians in all as `num_parameters` parameters allow.

    $$ \mathcal G^{t_1}_{\mathrm{MiraGe}} \cup \dots \cup \mathcal G^{t_n}_{\mathrm{MiraGe}} $$

    **Shapes:** `frames` uint8 (num_frames, height, width, 3), or with alpha (..., 4), as for `fit`. Frames get
    `num_parameters` // 9 Gaussians in equal parts, the first ones what is left over.

    `config` is that of each frame's fit: starts, loss, rates (see `RATE_FACTOR`), compositing. Its
    `steps` are of each frame (default `DEFAULT_STEPS`); its `minutes` are for all, divided evenly by measured speed.
    Settings about time (`degree`, `power`, `floor`, `learn_frame_times`, `follow_motion`, `follow_camera`,
    `scale_rates_by_duration`, `scale_rates_by_size`) have no meaning here and are ignored. `on_frame` is called with
    number and model of each frame that is done.

    **Raises** ValueError for frames that cannot be fitted, for fewer parameters than a Gaussian in each frame has, and
    for settings that would change the numbers of Gaussians, or that need other frames.

    **Example:** `independent_frames(frames, model.num_parameters, FitConfig(minutes=2))`.

    **Source:** VeGaS, eq:miragevideo: the family that folds are to improve on.
    """
    check_frames(frames)
    check_rate("fps", fps)
    config = FitConfig() if config is None else config
    _check_config(config)
    num_frames, least = len(frames), PARAMETERS * len(frames)
    if not is_integer(num_parameters, least):
        expected = f"a whole number >= {least:,}, one Gaussian in each frame"
        raise invalid("num_parameters", expected=expected, got=repr(num_parameters))
    each, more = divmod(int(num_parameters) // PARAMETERS, num_frames)
    budget, models, steps = _StepBudget(config, num_frames), [], 0
    alone = dataclasses.replace(config, degree=0, power=0.0, floor=0.0, minutes=None, steps=None)
    rates = {name: RATE_FACTOR * rate for name, rate in dataclasses.asdict(config.rates).items()}
    alone = dataclasses.replace(alone, rates=LearningRates(**rates | {"loc": LOC_RATE_FACTOR * config.rates.loc}))
    alone = dataclasses.replace(alone, learn_frame_times=False, follow_motion=False)
    alone = dataclasses.replace(alone, scale_rates_by_duration=False, scale_rates_by_size=False)
    if config.minutes is not None:  # the result is not used, but its seconds count
        budget.record(PILOT_STEPS, _fit_frame(frames[0], each, alone, PILOT_STEPS, 0, fps)[1])
    for k, frame in enumerate(frames):
        planned = budget.plan(k)
        model, seconds = _fit_frame(frame, each + (k < more), alone, planned, k, fps)
        budget.record(planned, seconds)
        models.append(model)
        steps += planned
        on_frame(k, model)
    return IndependentFrames(tuple(models), float(fps), steps, budget.spent)


def _check_config(config: FitConfig) -> None:
    """Raise ValueError for settings that have no meaning for frames with a given number of Gaussians."""
    for name in ("num_gaussians", "max_gaussians", "quality", "size_mb", "psnr", "growth"):
        value = getattr(config, name)
        if value is not None:
            raise invalid(
                f"config.{name}", expected="None", got=value, cure="num_parameters sets the number of Gaussians."
            )
    if config.interpolation_fraction:
        cure = "Frames that share nothing cannot be interpolated."
        raise invalid("config.interpolation_fraction", expected="0", got=config.interpolation_fraction, cure=cure)
    if config.initialization != "clip":
        raise invalid("config.initialization", expected="'clip'", got=repr(config.initialization))


class _StepBudget:
    """The number of steps of each frame: as many as configured, and as the minutes left allow at the last speed."""

    def __init__(self, config: FitConfig, num_frames: int):
        default = DEFAULT_STEPS if config.minutes is None else None
        self.most, self.num_frames = config.steps or default, num_frames
        self.budget = None if config.minutes is None else 60 * config.minutes
        self.spent, self.seconds_per_step = 0.0, 0.0

    def record(self, steps: int, seconds: float) -> None:
        """Count the steps and the time of a frame, its start included."""
        self.spent += seconds
        self.seconds_per_step = seconds / steps

    def plan(self, k: int) -> int:
        """The steps of frame k."""
        if self.budget is None:
            return self.most
        seconds = max(self.budget - self.spent, 0.0) / (self.num_frames - k)
        planned = max(int(seconds / self.seconds_per_step), 1)
        return min(planned, self.most or planned)


def _fit_frame(
    frame: np.ndarray, num: int, config: FitConfig, steps: int, k: int, fps: float
) -> tuple[VideoModel, float]:
    """Frame k as `num` Gaussians, and the seconds that it took."""
    begun, single = time.perf_counter(), np.ascontiguousarray(frame[None])
    opacity = SUMMED_OPACITY if config.compositing == "sum" else START_OPACITY
    envelope = TimeLikelihood(power=np.float32(0), floor=np.float32(0))
    colors = np.ascontiguousarray(single[..., :3])
    how = {"degree": 0, "envelope": envelope, "seed": config.seed + k, "opacity": opacity}
    splats = initialize(colors, num, **how)
    size = tuple(int(length) for length in frame.shape[:2])
    at_start = VideoModel(splats, FrameTimes.uniform(1), size, float(fps), config.options, config.compositing)
    config = dataclasses.replace(config, num_gaussians=num, seed=config.seed + k)
    started, seconds = start_from(at_start, config, steps), time.perf_counter() - begun
    for state, info in fit_steps(single, config, started):
        pass
    return to_model(state, config, size, fps), seconds + info.seconds
