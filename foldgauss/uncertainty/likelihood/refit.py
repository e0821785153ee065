r"""The outer check of how sure frame times are: the whole model, splats and times, fitted again and again.

What is drawn from profiles takes the splats as known. Here they are fitted anew, together with the times: to pictures
that might as well have been seen (of="pixels"), to all frames but some (of="frames"), or just once more (of="order").

What is still conditioned on. Time and folds trade against each other: with any rising g, times g(t_k) and splats whose
m_t, sigma_t and folds follow g show the same frames, as far as folds of the model's degree can follow. Only
$t_0 = 0$ and $t_{n-1} = 1$ are fixed by definition; all else that holds a smooth warp is where the fit
starts and how far it goes. So absolute times spread the more the longer the fit, without end in principle, and
`RefitTimes.local` gives what hardly any smooth warp changes, each frame's time between its neighbours'. Few steps hold
times back where they start, so that they spread less than they might. Also given are the number of Gaussians and, with
start="model", their order in depth and the optimum that the model is near. From scratch most of what is found is not
the pictures' noise, but where another order of steps leads to: compare "order".
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from foldgauss._runtime.checks import check_one_of, invalid, is_integer, is_within
from foldgauss.uncertainty.likelihood.likelihood_profiles import EXPLAINED
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video.fitting.config import FitConfig, planned_steps
from foldgauss.video.fitting.loop import FitState, fit_steps, start_from, to_model
from foldgauss.video.fitting.loop import start as start_anew
from foldgauss.video.models.video_model import VideoModel

METHODS, STARTS, PLACES = ("pixels", "frames", "order"), ("model", "scratch"), ("kept", "moved")
#: A fit that goes on from the model goes through the plan again from here: with the rates, and the loss, of its end.
AGAIN_FROM = 0.7
#: Streams of the seed's random numbers: one for pictures, one for the seeds of fits.
_PICTURES, _FITS = 0, 1
#: An unseen frame is looked for at so many times between its neighbours, then so many around the best one, and so on.
LOOKS, ROUNDS = 33, 3


@dataclasses.dataclass(frozen=True)
class Refit:
    """One replicate: the model as fitted again, and its frame times.

    `times` (num_frames,): those of all frames of the video, in [0, 1] and never falling; `unseen` (num_frames,): which
    of them were found afterwards, by splats that never saw the frame. `psnr`: dB at the frames it was fitted to, as
    the fit's last steps saw it.
    """

    number: int
    times: Float64[np.ndarray, " num_frames"]
    unseen: Bool[np.ndarray, " num_frames"]
    model: VideoModel
    psnr: float


@dataclasses.dataclass(frozen=True)
class RefitTimes:
    """Frame times of all replicates, beside the model's own.

    **Shapes:** `times`, `unseen` (replicates, num_frames), see `Refit`; `own` (num_frames,). **Units:** times of the
    model, [0, 1].

    A frame's `std` is that of its times in the replicates. Where frames were left out, each but the first and the last
    is unseen in one replicate only, so all of these have one `std` together: the root mean square of how far from the
    model's time they are found. Most of it is what splats get wrong at times that no frame has taught them, which a
    frame they were fitted to does not suffer from.
    """

    times: Float64[np.ndarray, "replicates num_frames"]
    unseen: Bool[np.ndarray, "replicates num_frames"]
    own: Float64[np.ndarray, " num_frames"]

    @classmethod
    def from_refits(cls, model: VideoModel, refits: Sequence[Refit]) -> "RefitTimes":
        """From what `refits` gave. Raises ValueError for fewer than two, or one given twice."""
        numbers = [each.number for each in refits]
        if len(numbers) < 2 or len(set(numbers)) < len(numbers):
            raise invalid("refits", expected="two or more, none of them twice", got=f"numbers {numbers}")
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
        """`std` in frames: of the positions that the times have among the model's own."""
        places = np.arange(len(self.own), dtype=np.float64)
        rising = self.own + places * np.finfo(np.float64).eps  # where float32 has two at one time
        return self._std(np.interp(self.times, rising, places), places)

    @property
    def local(self) -> Float64[np.ndarray, " num_frames"]:
        r"""Standard deviation of $t_k - (t_{k-1} + t_{k+1}) / 2$, which hardly a smooth warp changes.

        Times that are independent with the same deviation sigma have sqrt(3/2) sigma here. 0 for the first and last.
        """
        return self._std(_bent(self.times), _bent(self.own))

    def _std(self, values: np.ndarray, own: np.ndarray) -> np.ndarray:
        if not self.by_frames:
            return values.std(0, ddof=1)
        found = self.unseen.any(0)
        return np.where(found, np.sqrt(np.mean((values - own)[self.unseen] ** 2)), 0.0)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of each standard deviation."""
        return int(self.unseen.sum()) if self.by_frames else self.replicates - 1

    def interval(self, level: float = 0.9) -> Float64[np.ndarray, "2 num_frames"]:
        """Bounds of each frame's time: the model's own, and Student's quantile times `std` to both sides, in [0, 1].

        Raises ValueError for a level outside (0, 1).
        """
        if not is_within(level, "(0, 1)"):
            raise invalid("level", expected="a number in (0, 1)", got=repr(level))
        reach = scipy.stats.t.ppf((1 + level) / 2, self.freedom) * self.std
        return np.clip(np.stack([self.own - reach, self.own + reach]), 0.0, 1.0)

    def ratio_to(self, std: Float[np.ndarray, " num_frames"]) -> float:
        """How many times as unsure as `std` says: root mean square over frames, but for the first and the last.

        `std` (num_frames,), or one number, in the model's time: for instance that given the splats.
        """
        std = np.asarray(std, np.float64)
        if std.shape not in ((), self.own.shape) or not (np.broadcast_to(std, self.own.shape)[1:-1] > 0).all():
            expected = f"numbers > 0, one or {len(self.own)}"
            raise invalid("std", expected=expected, got=f"shape {std.shape}" if std.ndim else std)
        std = np.broadcast_to(std, self.own.shape)
        if self.by_frames:
            missed = (self.times - self.own) / np.where(std > 0, std, 1.0)
            return float(np.sqrt(np.mean(missed[self.unseen] ** 2)))
        return float(np.sqrt(np.mean((self.std[1:-1] / std[1:-1]) ** 2)))


def _bent(times: np.ndarray) -> np.ndarray:
    """Times less the mean of their neighbours', 0 at both ends."""
    bent = np.zeros_like(times)
    bent[..., 1:-1] = times[..., 1:-1] - (times[..., :-2] + times[..., 2:]) / 2
    return bent


def refit_frame_times(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    config: FitConfig,
    *,
    replicates: int = 20,
    method: str = "pixels",
    block: int = 16,
    place: str = "kept",
    seed: int = 0,
    steps: int | None = None,
    start: str | None = None,
    on_replicate: Callable[[Refit], None] | None = None,
) -> RefitTimes:
    """The frame times of `replicates` models fitted again; arguments and errors as for `refits`.

    `on_replicate` is called with every `Refit` as it is ready. Example:
    `refit_frame_times(model, frames, config, replicates=8).ratio_to(std_given_the_splats)`.
    """
    if not is_integer(replicates, 2):
        raise invalid("replicates", expected="a whole number >= 2", got=repr(replicates))
    found = []
    how = {"method": method, "block": block, "place": place, "seed": seed, "steps": steps, "start": start}
    for each in iter_refits(model, video, config, replicates=replicates, **how):
        if on_replicate is not None:
            on_replicate(each)
        found.append(dataclasses.replace(each, model=model))  # of all those models one is kept
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
    place: str = "kept",
    seed: int = 0,
    steps: int | None = None,
    start: str | None = None,
) -> Iterator[Refit]:
    """Fit the model again, `replicates` times, from replicate `first` on: yields each one.

    Replicate i depends on `seed` and i only, so that what was saved need not be done again.

    * of="pixels": to the model's own pictures with residuals put together anew, see `resample_frames`. Frames are the
      bootstrap's "truth" exactly: the times spread around the model's own.
    * of="frames": without frames i + 1, i + 1 + replicates, ..., whose place in time is left open; their times are then
      those between their neighbours' at which these splats, that have never seen them, come nearest to them, which is
      where their likelihood is greatest. Frame times start at the model's own, all else from scratch.
    * of="order": to the frames as they are. What differs is the order of frames and, from scratch, where Gaussians
      start: the optimiser's own spread, which is part of what the others find.

    `video`: what `model` was fitted to with `config`. `start`: "model" goes on from it, with the rates of the end of
    the schedule (`AGAIN_FROM`), by default for pixels and order; "scratch" is a whole fit with another seed, and the
    only way for frames. `steps` of each: by default those of `config`, or of its end; `config.minutes` and
    `target_psnr` are left out.

    Source: Kuensch 1989 for blocks, Wu 1986 for residuals that keep their place, Efron and Tibshirani 1993, chapters 9
    and 17. Raises ValueError for a video that is not the model's, a config that could not have fitted it, and settings
    out of range.
    """
    check_one_of("method", method, METHODS)
    check_one_of("place", place, PLACES)
    start = ("scratch" if method == "frames" else "model") if start is None else start
    check_one_of("start", start, STARTS)
    if method == "frames" and start == "model":
        cure = "The model has seen the frames that are to be left out."
        raise invalid("start", expected="'scratch' for frames", got=repr(start), cure=cure)
    for name, value, least in (("replicates", replicates, 1), ("first", first, 0), ("seed", seed, 0)):
        if not is_integer(value, least):
            raise invalid(name, expected=f"a whole number >= {least}", got=repr(value))
    residuals = _checked(model, video, method)
    if method == "frames" and not 2 <= replicates <= len(video) - 2:
        cure = "Each of the others is left out once."
        raise invalid("replicates", expected=f"from 2 to {len(video) - 2} for frames", got=replicates, cure=cure)
    if not is_integer(block, 1) or block > min(model.size):
        raise invalid("block", expected=f"a whole number from 1 to {min(model.size)}", got=repr(block))
    config = _with_steps(config, len(video), start, steps)
    start_from(model, config, 1)  # raises for a config that is not the model's
    for number in range(first, replicates):
        own = dataclasses.replace(config, seed=int(np.random.SeedSequence([seed, _FITS, number]).generate_state(1)[0]))
        if method == "frames":
            yield _without_frames(model, video, own, number, replicates)
            continue
        frames = video
        if method == "pixels":
            frames = resample_frames(residuals, block, np.random.default_rng([seed, _PICTURES, number]), place=place)
        state = start_from(model, own, own.steps, AGAIN_FROM) if start == "model" else None
        fitted, psnr = _fitted(frames, own, model.fps, state)
        times = np.asarray(fitted.frame_times.times(), np.float64)
        yield Refit(number, times, np.zeros(len(times), bool), fitted, psnr)


def _checked(model: VideoModel, video: np.ndarray, method: str) -> Residuals:
    residuals = Residuals(model, video)
    if len(video) != model.num_frames:
        expected = f"the {model.num_frames} frames that the model was fitted to"
        raise invalid("video", expected=expected, got=f"{len(video)} frames")
    if len(video) < 3:
        cure = "The first frame is at time 0 and the last at 1: others are needed."
        raise invalid("video", expected="at least 3 frames", got=len(video), cure=cure)
    if method == "pixels" and video.shape[3] == 4:
        cure = "Fit it without alpha, or leave frames out."
        raise invalid(
            "video", expected="frames without alpha for pixels", got=f"{video.dtype} {video.shape}", cure=cure
        )
    left = sum(float(np.square(each, dtype=np.float64).sum()) for each in _residuals(residuals))
    variation = sum(float(frame.var(axis=(0, 1)).sum()) for frame in residuals.frames) * math.prod(model.size) / 255**2
    if left > (1 - EXPLAINED) * variation:
        got = f"a model that explains {100 * (1 - left / variation) if variation else 0:.0f}% of their variance"
        expected = f"frames of which the model explains {100 * EXPLAINED:.0f}%"
        raise invalid("video", expected=expected, got=got, cure="Give the model of this video, at its size and crop.")
    return residuals


def _residuals(residuals: Residuals) -> Iterator[Float32[np.ndarray, "3 height width"]]:
    for k, picture in enumerate(residuals.render_at(np.asarray(residuals.model.frame_times.times()))):
        yield residuals.residual(k, picture)


def _with_steps(config: FitConfig, num_frames: int, start: str, steps: int | None) -> FitConfig:
    """The same with a fixed number of steps: those of the refit."""
    if not config.learn_frame_times:
        raise invalid(
            "config.learn_frame_times", expected="True", got=False, cure="Times that are given have no spread."
        )
    if steps is None:
        if config.steps is None and config.minutes is not None:
            cure = "A fit that ends by the clock cannot be repeated."
            raise invalid("steps", expected="a number for a config with minutes alone", got=None, cure=cure)
        steps = planned_steps(dataclasses.replace(config, minutes=None), num_frames)
        steps = steps if start == "scratch" else max(1, round((1 - AGAIN_FROM) * steps))
    own = {"economy": None} if start == "model" else {}  # a model's Gaussians stay
    return dataclasses.replace(config, steps=steps, minutes=None, target_psnr=None, **own)


def resample_frames(
    residuals: Residuals, block: int, rng: np.random.Generator, *, place: str = "kept"
) -> UInt8[np.ndarray, "num_frames height width 3"]:
    """Frames that might have been seen: the model's pictures, and residuals in blocks with signs drawn anew.

    Every frame is cut into blocks of `block` pixels, by a grid that lies at random, and the residuals of a block, of
    all channels, are multiplied by 1 or -1. With place="kept" they stay where they are: edges, where residuals are
    great, keep great ones. With "moved" they are those of another place of the same frame, drawn at random with the
    frame continued around its borders; so they are equally great everywhere. Either way the mean is the model's
    picture; the variance is the pixel's squared residual where they are kept, and the frame's mean one where they are
    moved. The first is what `score_fraction` counts on, the second `effective_fraction`. Residuals of one frame have nothing
    to do with the next one's. Values are rounded to 8 bits and clipped, as a camera's are.
    """
    frames = np.empty(residuals.frames.shape, np.uint8)
    times = np.asarray(residuals.model.frame_times.times())
    for k, picture in enumerate(residuals.render_at(times)):
        drawn = picture + resample_blocks(residuals.residual(k, picture), block, rng, place=place)
        frames[k] = np.moveaxis(np.clip(np.rint(255 * drawn), 0, 255), 0, -1)
    return frames


def resample_blocks(
    residual: Float[np.ndarray, "channels height width"], block: int, rng: np.random.Generator, *, place: str = "kept"
) -> Float[np.ndarray, "channels height width"]:
    """Residuals in blocks with random signs, see `resample_frames`."""
    _, height, width = residual.shape
    origin = rng.integers(0, block, 2)
    row, column = (np.arange(size) + shift for size, shift in zip((height, width), origin, strict=True))
    tile = (row // block)[:, None], (column // block)[None, :]
    shape = tile[0].max() + 1, tile[1].max() + 1
    sign = rng.choice(np.array([-1, 1], residual.dtype), shape)[tile]
    if place == "kept":
        return sign * residual
    down, right = rng.integers(0, height, shape)[tile], rng.integers(0, width, shape)[tile]
    y, x = (np.arange(height)[:, None] + down) % height, (np.arange(width)[None, :] + right) % width
    return sign * residual[:, y, x]


def _without_frames(model: VideoModel, video: np.ndarray, config: FitConfig, number: int, folds: int) -> Refit:
    """Every `folds`-th frame is left out, and looked for afterwards."""
    unseen = np.zeros(len(video), bool)
    unseen[number + 1 : -1 : folds] = True
    kept = np.ascontiguousarray(video[~unseen])
    state = start_anew(kept, config, merge_logits(np.asarray(model.frame_times.logits), unseen))
    fitted, psnr = _fitted(kept, config, model.fps, state)
    times, residuals = np.empty(len(video)), Residuals(fitted, video)
    times[~unseen] = np.asarray(fitted.frame_times.times(), np.float64)
    for k in np.flatnonzero(unseen):
        times[k] = _nearest(residuals, k, times[k - 1], times[k + 1])
    return Refit(number, times, unseen, fitted, psnr)


def _fitted(frames: np.ndarray, config: FitConfig, fps: float, state: FitState | None) -> tuple[VideoModel, float]:
    *_, (state, info) = fit_steps(frames, config, state)  # every step yields the same state
    return to_model(state, config, frames.shape[1:3], fps), info.psnr


def merge_logits(
    logits: Float[np.ndarray, " intervals"], unseen: Bool[np.ndarray, " num_frames"]
) -> Float32[np.ndarray, " fewer"]:
    """Softmax weights of the frames but the `unseen` ones, at the same times: the gaps they leave stay open."""
    kept = np.flatnonzero(~unseen)
    return np.logaddexp.reduceat(np.asarray(logits, np.float64), kept[:-1]).astype(np.float32)


def _nearest(residuals: Residuals, k: int, low: float, high: float) -> float:
    """The time from `low` to `high` whose picture has the least squared error to frame k; the middle of equal ones."""
    for _ in range(ROUNDS):
        times = np.linspace(low, high, LOOKS)
        errors = np.array([residuals.squared_errors(picture, [k])[0] for picture in residuals.render_at(times)])
        ties = np.flatnonzero(errors == errors.min())
        best = ties[len(ties) // 2]
        low, high = times[max(best - 1, 0)], times[min(best + 1, LOOKS - 1)]
    return float(times[best])
