r"""Uncertainty of frame times by refitting splats and times together.

The posterior given likelihood profiles takes the splats as known. Here they are refitted together with the times: to
resampled frames (method="pixels"), or once more to the same frames (method="order").

Times are not identified absolutely: for any increasing g, times g(t_k) and splats whose m_t, sigma_t and folds follow g
show the same frames. Only $t_0 = 0$ and $t_{n-1} = 1$ are fixed, so absolute times spread the more the longer the fit;
`RefitTimes.local` measures what a smooth warp hardly changes, each frame's time relative to its neighbors. The number
of Gaussians and their depth order are held, too.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import scipy.stats
from jaxtyping import Float, Float64, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator, seed_sequence
from foldgauss._runtime.checks import check_one_of, invalid, is_integer, is_within
from foldgauss.uncertainty.likelihood.likelihood_profiles import check_explained
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video.fitting.config import FitConfig, planned_steps
from foldgauss.video.fitting.loop import fit_steps, start_from, to_model
from foldgauss.video.models.video_model import VideoModel

METHODS = ("pixels", "order")
#: A refit repeats the schedule from this fraction on, with its last learning rates and loss.
START_AT = 0.7
#: The least `LearningRates.cooldown` of refits: the spread is that of the estimate, not of its last steps.
COOLDOWN_FRACTION = 0.2


@dataclasses.dataclass(frozen=True)
class Refit:
    """One replicate: the refitted model and its frame times.

    `times` (num_frames,): times of all frames of the video, in [0, 1] and never decreasing; `unseen` (num_frames,):
    the frames that were left out, whose times were found afterwards. `psnr`: dB over the fitted frames, as the last
    steps of the fit report it.
    """

    number: int
    times: Float64[np.ndarray, " num_frames"]
    unseen: Bool[np.ndarray, " num_frames"]
    model: VideoModel
    psnr: float


@dataclasses.dataclass(frozen=True)
class RefitTimes:
    """Frame times of all replicates, and the model's own.

    **Shapes:** `times`, `unseen` (replicates, num_frames), see `Refit`; `own` (num_frames,). **Units:** times of the
    model, [0, 1].

    A frame's `std` is the standard deviation of its times over the replicates; with frames left out, all frames share
    one: the root mean square difference from the model's times, of which most is the splats' error without that frame.
    """

    times: Float64[np.ndarray, "replicates num_frames"]
    unseen: Bool[np.ndarray, "replicates num_frames"]
    own: Float64[np.ndarray, " num_frames"]

    @classmethod
    def from_refits(cls, model: VideoModel, refits: Sequence[Refit]) -> "RefitTimes":
        """Collect replicates of `iter_refits`. Raises ValueError for fewer than two, or duplicates."""
        numbers = [each.number for each in refits]
        if len(numbers) < 2 or len(set(numbers)) < len(numbers):
            raise invalid("refits", expected="two or more, without duplicates", got=f"numbers {numbers}")
        own = np.asarray(model.frame_times.times(), np.float64)
        return cls(np.stack([each.times for each in refits]), np.stack([each.unseen for each in refits]), own)

    @property
    def replicates(self) -> int:
        return len(self.times)

    @property
    def by_frames(self) -> bool:
        """Whether frames were left out."""
        return bool(self.unseen.any())

    @property
    def mean(self) -> Float64[np.ndarray, " num_frames"]:
        """Mean time of each frame; with frames left out, the time found where it was unseen."""
        if not self.by_frames:
            return self.times.mean(0)
        return np.where(self.unseen.any(0), np.where(self.unseen, self.times, 0).sum(0), self.own)

    @property
    def std(self) -> Float64[np.ndarray, " num_frames"]:
        """Standard deviation of each frame's time, 0 for the first and the last."""
        return self._std(self.times, self.own)

    @property
    def spread(self) -> Float64[np.ndarray, " num_frames"]:
        """`std` in frames: of the times interpolated to positions among the model's own times."""
        places = np.arange(len(self.own), dtype=np.float64)
        increasing = self.own + places * np.finfo(np.float64).eps  # float32 times may coincide
        return self._std(np.interp(self.times, increasing, places), places)

    @property
    def local(self) -> Float64[np.ndarray, " num_frames"]:
        r"""Standard deviation of $t_k - (t_{k-1} + t_{k+1}) / 2$, which a smooth warp hardly changes.

        For independent times of standard deviation sigma it is sqrt(3/2) sigma. 0 for the first and last frame.
        """
        return self._std(_second_difference(self.times), _second_difference(self.own))

    def _std(self, values: np.ndarray, own: np.ndarray) -> np.ndarray:
        if not self.by_frames:
            return values.std(0, ddof=1)
        found = self.unseen.any(0)
        return np.where(found, np.sqrt(np.mean((values - own)[self.unseen] ** 2)), 0.0)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of each standard deviation."""
        return int(self.unseen.sum()) if self.by_frames else self.replicates - 1

    def interval(self, level: float = 0.95) -> tuple[Float64[np.ndarray, " num_frames"], ...]:
        """(low, high) of each frame's time, in [0, 1]: the model's own less and plus Student's quantile times `std`.

        Raises ValueError for a level outside (0, 1).
        """
        if not is_within(level, "(0, 1)"):
            raise invalid("level", expected="a number in (0, 1)", got=repr(level))
        reach = scipy.stats.t.ppf((1 + level) / 2, self.freedom) * self.std
        return np.clip(self.own - reach, 0.0, 1.0), np.clip(self.own + reach, 0.0, 1.0)

    def ratio_to(self, std: Float[np.ndarray, " num_frames"]) -> float:
        """Ratio to another `std`: root mean square over frames, except the first and the last.

        `std` (num_frames,), or one number, in the model's time: for instance the posterior's given the splats.
        """
        std = np.asarray(std, np.float64)
        if std.shape not in ((), self.own.shape) or not (np.broadcast_to(std, self.own.shape)[1:-1] > 0).all():
            expected = f"values > 0, one or {len(self.own)}"
            raise invalid("std", expected=expected, got=f"shape {std.shape}" if std.ndim else std)
        std = np.broadcast_to(std, self.own.shape)
        if self.by_frames:
            missed = (self.times - self.own) / np.where(std > 0, std, 1.0)
            return float(np.sqrt(np.mean(missed[self.unseen] ** 2)))
        return float(np.sqrt(np.mean((self.std[1:-1] / std[1:-1]) ** 2)))


def _second_difference(times: np.ndarray) -> np.ndarray:
    """Times less the mean of their neighbors', 0 at both ends."""
    found = np.zeros_like(times)
    found[..., 1:-1] = times[..., 1:-1] - (times[..., :-2] + times[..., 2:]) / 2
    return found


def refit_frame_times(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    config: FitConfig,
    *,
    replicates: int = 20,
    method: str = "pixels",
    block: int = 16,
    seed: int = 0,
    steps: int | None = None,
    start: str | None = None,
    on_replicate: Callable[[Refit], None] | None = None,
) -> RefitTimes:
    """Frame times of `replicates` refits; arguments and errors as for `iter_refits`.

    `on_replicate` is called with every `Refit` once it is complete. Example:
    `refit_frame_times(model, frames, config, replicates=8).ratio_to(std_given_the_splats)`.
    """
    if not is_integer(replicates, 2):
        raise invalid("replicates", expected="a whole number >= 2", got=repr(replicates))
    found = []
    how = {"method": method, "block": block, "seed": seed, "steps": steps, "start": start}
    for each in iter_refits(model, video, config, replicates=replicates, **how):
        if on_replicate is not None:
            on_replicate(each)
        found.append(dataclasses.replace(each, model=model))  # do not keep all models in memory
    return RefitTimes.from_refits(model, found)


def iter_refits(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    config: FitConfig,
    *,
    replicates: int = 20,
    first: int = 0,
    method: str = "pixels",
    block: int = 16,
    seed: int = 0,
    steps: int | None = None,
    start: str | None = None,
) -> Iterator[Refit]:
    """Refit the model `replicates` times, from replicate `first` on, and yield each result.

    Replicate i depends on `seed` and i only, so that saved replicates need not be repeated.

    * method="pixels": residual bootstrap; the model's images plus resampled residuals, see `resample_frames`. The
      times spread around the model's own, which are the truth of the bootstrap.
    * method="frames": cross-validation; without frames i + 1, i + 1 + replicates, ... Their times are afterwards
      estimated, between their neighbors, by maximum likelihood given the refitted splats. Frame times start at the
      model's own, all else from scratch.
    * method="order": to the unchanged frames. The order of frames differs and, from scratch, the initial Gaussians:
      this is the spread of the optimizer, which the other methods include.

    `video`: the clip that `model` was fitted to with `config`. `start`: "model" continues from it with the learning
    rates of the end of the schedule (`START_AT`), the default for pixels and order; "scratch" is a whole fit with
    another seed, the only option for frames. `steps` of each: by default those of `config`, or of the end of its
    schedule; `config.minutes` and a compact model that it asks for are ignored.

    Source: Wu 1986 (random signs), Efron and Tibshirani 1993, chapters 9 and 17.
    Raises ValueError for a video that is not the model's, a config that could not have fitted it, and settings out of
    range.
    """
    check_one_of("method", method, METHODS)
    start = ("scratch" if method == "frames" else "model") if start is None else start
    check_one_of("start", start, STARTS)
    if method == "frames" and start == "model":
        cure = "The model was fitted to the frames that are to be left out."
        raise invalid("start", expected="'scratch' for frames", got=repr(start), cure=cure)
    for name, value, least in (("replicates", replicates, 1), ("first", first, 0), ("seed", seed, 0)):
        if not is_integer(value, least):
            raise invalid(name, expected=f"a whole number >= {least}", got=repr(value))
    video = np.asarray(video)
    residuals = _check_video(model, video, method)
    if method == "frames" and not 2 <= replicates <= len(video) - 2:
        cure = "Each frame but the first and the last is left out once."
        raise invalid("replicates", expected=f"from 2 to {len(video) - 2} for frames", got=replicates, cure=cure)
    if not is_integer(block, 1) or block > min(model.size):
        raise invalid("block", expected=f"a whole number from 1 to {min(model.size)}", got=repr(block))
    config = _fix_steps(config, len(video), start, steps)
    start_from(model, config, 1)  # raises if the config does not match the model
    for number in range(first, replicates):
        own = dataclasses.replace(config, seed=int(seed_sequence(Stream.REFIT, number, seed=seed).generate_state(1)[0]))
        if method == "frames":
            yield _leave_out_frames(model, video, own, number, replicates)
            continue
        frames = video
        if method == "pixels":
            rng = make_generator(Stream.RESAMPLED_FRAME, number, seed=seed)
            frames = resample_frames(residuals, block, rng)
        state = start_from(model, own, own.steps, START_AT) if start == "model" else None
        fitted, psnr = _fit(frames, own, model.fps, state)
        times = np.asarray(fitted.frame_times.times(), np.float64)
        yield Refit(number, times, np.zeros(len(times), bool), fitted, psnr)


def _check_video(model: VideoModel, video: np.ndarray, method: str) -> Residuals:
    residuals = Residuals(model, video)
    if len(video) != model.num_frames:
        expected = f"the {model.num_frames} frames that the model was fitted to"
        raise invalid("video", expected=expected, got=f"{len(video)} frames")
    if len(video) < 3:
        cure = "The first frame is at time 0 and the last at 1; others are needed."
        raise invalid("video", expected="at least 3 frames", got=len(video), cure=cure)
    if method == "pixels" and video.shape[3] == 4:
        cure = "Fit it without alpha, or leave frames out."
        raise invalid(
            "video", expected="frames without alpha for pixels", got=f"{video.dtype} {video.shape}", cure=cure
        )
    images = residuals.render_at(np.asarray(model.frame_times.times()))
    left = sum(float(np.square(residuals.residual(k, each), dtype=np.float64).sum()) for k, each in enumerate(images))
    variation = sum(float(frame.var(axis=(0, 1)).sum()) for frame in residuals.frames) * math.prod(model.size) / 255**2
    check_explained(left, variation)
    return residuals


def _fix_steps(config: FitConfig, num_frames: int, start: str, steps: int | None) -> FitConfig:
    """The config with the fixed number of steps of a refit."""
    if not config.learns_frame_times:
        raise invalid(
            "config.rates.frame_times", expected="a number > 0", got=0, cure="Fixed frame times have no spread."
        )
    if steps is None:
        if config.steps is None and config.minutes is not None:
            cure = "A fit that ends by the clock cannot be repeated."
            raise invalid("steps", expected="a number for a config with minutes alone", got=None, cure=cure)
        steps = planned_steps(dataclasses.replace(config, minutes=None), num_frames)
        steps = steps if start == "scratch" else max(1, round((1 - START_AT) * steps))
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


def _fit(frames: np.ndarray, config: FitConfig, fps: float, state: FitState | None) -> tuple[VideoModel, float]:
    *_, (state, info) = fit_steps(frames, config, state)  # every step yields the same state
    return to_model(state, config, frames.shape[1:3], fps), info.psnr

