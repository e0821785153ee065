r"""Uncertainty of frame times by refitting splats and times together.

The posterior given likelihood profiles takes the splats as known. Here they are refitted together with the times, to
resampled frames.

Times are not identified absolutely: for any increasing g, times g(t_k) and splats whose m_t, sigma_t and folds follow g
show the same frames. Only $t_0 = 0$ and $t_{n-1} = 1$ are fixed, so absolute times spread the more the longer the fit;
`RefitTimes.local` measures what a smooth warp hardly changes, each frame's time relative to its neighbors. The number
of Gaussians and their depth order are held, too.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float64, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator, seed_sequence
from foldgauss._runtime.checks import is_integer, require
from foldgauss.uncertainty.likelihood.likelihood_profiles import check_explained
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video.fitting.config import FitConfig, planned_steps
from foldgauss.video.fitting.loop import fit_steps, start_from, to_model
from foldgauss.video.models.video_model import VideoModel

#: A refit repeats the schedule from this fraction on, with its last learning rates and loss.
START_AT = 0.7
#: The least `LearningRates.cooldown` of refits: the spread is that of the estimate, not of its last steps.
COOLDOWN_FRACTION = 0.2


@dataclasses.dataclass(frozen=True)
class RefitTimes:
    """Frame times of all replicates, and the model's own.

    **Shapes:** `times` (replicates, num_frames), never decreasing; `own` (num_frames,). **Units:** times of the model,
    [0, 1].
    """

    times: Float64[np.ndarray, "replicates num_frames"]
    own: Float64[np.ndarray, " num_frames"]

    @property
    def std(self) -> Float64[np.ndarray, " num_frames"]:
        """Standard deviation of each frame's time, 0 for the first and the last."""
        return self.times.std(0, ddof=1)

    @property
    def spread(self) -> Float64[np.ndarray, " num_frames"]:
        """`std` in frames: of the times interpolated to positions among the model's own times."""
        places = np.arange(len(self.own), dtype=np.float64)
        increasing = self.own + places * np.finfo(np.float64).eps  # float32 times may coincide
        return np.interp(self.times, increasing, places).std(0, ddof=1)

    @property
    def local(self) -> Float64[np.ndarray, " num_frames"]:
        r"""Standard deviation of $t_k - (t_{k-1} + t_{k+1}) / 2$, which a smooth warp hardly changes.

        For independent times of standard deviation sigma it is sqrt(3/2) sigma. 0 for the first and last frame.
        """
        difference = np.zeros_like(self.times)
        difference[:, 1:-1] = self.times[:, 1:-1] - (self.times[:, :-2] + self.times[:, 2:]) / 2
        return difference.std(0, ddof=1)

    def ratio_to(self, std: Float[np.ndarray, " num_frames"]) -> float:
        """Ratio to another `std`: root mean square over frames, except the first and the last.

        `std` (num_frames,), or one number, in the model's time: for instance the posterior's given the splats.
        """
        std = np.asarray(std, np.float64)
        require(
            std.shape in ((), self.own.shape) and (np.broadcast_to(std, self.own.shape)[1:-1] > 0).all(),
            "std",
            expected=f"values > 0, one or {len(self.own)}",
            got=f"shape {std.shape}" if std.ndim else std,
        )
        inner = np.broadcast_to(std, self.own.shape)[1:-1]
        return float(np.sqrt(np.mean((self.std[1:-1] / inner) ** 2)))


def refit_frame_times(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    config: FitConfig,
    *,
    replicates: int = 20,
    block: int = 16,
    seed: int = 0,
    steps: int | None = None,
    on_replicate: Callable[[int, VideoModel], None] | None = None,
) -> RefitTimes:
    """Frame times of `replicates` refits, which continue from the model with the learning rates of the schedule's end.

    A residual bootstrap: each refit is to the model's images plus resampled residuals, see `resample_frames`. The times
    spread around the model's own, which are the truth of the bootstrap. The optimizer's own spread is included.

    `video`: the clip that `model` was fitted to with `config`. `steps` of each refit: by default those of the end of
    the schedule of `config` (from `START_AT` on); `config.minutes` and a compact model that it asks for are ignored.
    Replicate i depends on `seed` and i only. `on_replicate` is called with the number of every replicate and its model.

    Source: Wu 1986 (random signs), Efron and Tibshirani 1993, chapters 9 and 17.
    Raises ValueError for a video that is not the model's, a config that could not have fitted it, and settings out of
    range. Example: `refit_frame_times(model, frames, config, replicates=8).ratio_to(std_given_the_splats)`.
    """
    for name, value, least in (("replicates", replicates, 2), ("seed", seed, 0)):
        require(is_integer(value, least), name, expected=f"a whole number >= {least}", got=repr(value))
    video = np.asarray(video)
    residuals = _check_video(model, video)
    require(
        is_integer(block, 1) and block <= min(model.size),
        "block",
        expected=f"a whole number from 1 to {min(model.size)}",
        got=repr(block),
    )
    config = _fix_steps(config, len(video), steps)
    times = []
    for number in range(replicates):
        own = dataclasses.replace(config, seed=int(seed_sequence(Stream.REFIT, number, seed=seed).generate_state(1)[0]))
        rng = make_generator(Stream.RESAMPLED_FRAME, number, seed=seed)
        frames = resample_frames(residuals, block, rng)
        *_, (state, _) = fit_steps(frames, own, start_from(model, own, own.steps, START_AT))  # steps share one state
        refitted = to_model(state, own, model.size, model.fps)
        times.append(np.asarray(refitted.frame_times.times(), np.float64))
        if on_replicate is not None:
            on_replicate(number, refitted)
    return RefitTimes(np.stack(times), np.asarray(model.frame_times.times(), np.float64))


def _check_video(model: VideoModel, video: np.ndarray) -> Residuals:
    residuals = Residuals(model, video)
    require(
        len(video) == model.num_frames,
        "video",
        expected=f"the {model.num_frames} frames that the model was fitted to",
        got=f"{len(video)} frames",
    )
    require(
        len(video) >= 3,
        "video",
        expected="at least 3 frames",
        got=len(video),
        cure="The first frame is at time 0 and the last at 1; others are needed.",
    )
    require(
        video.shape[3] != 4,
        "video",
        expected="frames without alpha",
        got=f"{video.dtype} {video.shape}",
        cure="Fit it without alpha.",
    )
    images = residuals.render_at(np.asarray(model.frame_times.times()))
    left = sum(float(np.square(residuals.residual(k, each), dtype=np.float64).sum()) for k, each in enumerate(images))
    variation = sum(float(frame.var(axis=(0, 1)).sum()) for frame in residuals.frames) * math.prod(model.size) / 255**2
    check_explained(left, variation)
    return residuals


def _fix_steps(config: FitConfig, num_frames: int, steps: int | None) -> FitConfig:
    """The config with the fixed number of steps of a refit."""
    require(
        config.learns_frame_times,
        "config.rates.frame_times",
        expected="a number > 0",
        got=0,
        cure="Fixed frame times have no spread.",
    )
    if steps is None:
        require(
            config.steps is not None or config.minutes is None,
            "steps",
            expected="a number for a config with minutes alone",
            got=None,
            cure="A fit that ends by the clock cannot be repeated.",
        )
        planned = planned_steps(dataclasses.replace(config, minutes=None), num_frames)
        steps = max(1, round((1 - START_AT) * planned))
    rates = dataclasses.replace(config.rates, cooldown=max(config.rates.cooldown, COOLDOWN_FRACTION))
    float32 = {"quality": None, "size_mb": None, "psnr": None}
    return dataclasses.replace(config, steps=steps, minutes=None, rates=rates, **float32)


def resample_frames(
    residuals: Residuals, block: int, rng: np.random.Generator
) -> UInt8[np.ndarray, "num_frames height width 3"]:
    """Bootstrap frames: the model's images plus residuals in blocks with random signs.

    A randomly placed grid divides every frame into blocks of `block` pixels, whose residuals are multiplied by 1 or -1.
    The variance is the pixel's squared residual, as `score_fraction` assumes. Values are rounded to 8 bits and clipped.
    """
    frames = np.empty(residuals.frames.shape, np.uint8)
    times = np.asarray(residuals.model.frame_times.times())
    for k, image in enumerate(residuals.render_at(times)):
        resampled = image + resample_blocks(residuals.residual(k, image), block, rng)
        frames[k] = np.moveaxis(np.clip(np.rint(255 * resampled), 0, 255), 0, -1)
    return frames


def resample_blocks(
    residual: Float[np.ndarray, "channels height width"], block: int, rng: np.random.Generator
) -> Float[np.ndarray, "channels height width"]:
    """Residuals in blocks with random signs, see `resample_frames`."""
    _, height, width = residual.shape
    origin = rng.integers(0, block, 2)
    row, column = (np.arange(size) + shift for size, shift in zip((height, width), origin, strict=True))
    tile = (row // block)[:, None], (column // block)[None, :]
    shape = tile[0].max() + 1, tile[1].max() + 1
    return rng.choice(np.array([-1, 1], residual.dtype), shape)[tile] * residual
