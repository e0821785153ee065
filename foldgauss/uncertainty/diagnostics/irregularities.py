"""What drawn frame times say of a clip: its pace, frames shown twice or left out; and a comparison of models' times."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from foldgauss._runtime.checks import invalid, is_within
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles, evidence
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.posterior.exact import exact_times
from foldgauss.uncertainty.posterior.increments import Increments
from foldgauss.uncertainty.posterior.log_prob import drawn_log_likelihood
from foldgauss.uncertainty.posterior.sampling import FrameTimePosterior
from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.models.video_model import VideoModel

#: An increment is measured by the median of those up to this many intervals before and after it.
REACH = 4
#: So many draws, evenly spaced among all, tell a probability to 1%.
ENOUGH = 4000


@dataclasses.dataclass(frozen=True)
class IncrementIntervals:
    """Increments between frames in units of the median one: 1 is the clip's own pace.

    **Shapes:** `mean`, `low`, `high` (num_frames - 1,); `low` to `high` holds `level` of the draws. Cuts are counted
    out of the median.
    """

    mean: Float64[np.ndarray, "intervals"]
    low: Float64[np.ndarray, "intervals"]
    high: Float64[np.ndarray, "intervals"]
    level: float


@dataclasses.dataclass(frozen=True)
class Irregularity:
    """An interval between two frames that is far shorter or longer than its neighbours.

    `frames`: the two frames. `kind`: "duplicated", the second shows what the first did, or "dropped", others were left
    out between them. `probability`: share of the draws in which it is so. `size`: mean increment in units of the local
    median, `low` to `high` its central 90%. About `size` - 1 frames were left out of a "dropped" one.
    """

    frames: tuple[int, int]
    kind: Literal["duplicated", "dropped"]
    probability: float
    size: float
    low: float
    high: float


def intervals(posterior: FrameTimePosterior, level: float = 0.9) -> IncrementIntervals:
    """Means and central intervals of all increments, each draw in units of its own median increment.

    An increment between two frames whose times were held varies with the median alone. Raises ValueError for a level
    out of (0, 1).
    """
    if not is_within(level, "(0, 1)"):
        raise invalid("level", expected="a number in (0, 1)", got=level)
    steps = np.diff(_some(posterior), axis=1)
    steps /= np.median(steps[:, ~cuts(posterior)], axis=1, keepdims=True)
    low, high = np.quantile(steps, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return IncrementIntervals(steps.mean(0), low, high, level)


def judged(posterior: FrameTimePosterior) -> Bool[np.ndarray, "intervals"]:
    """Intervals that `irregularities` looks at: no cuts, a free frame at an end, and ends that tell their time."""
    free, told = posterior.log_prob.increments.free, posterior.identified()
    return ~cuts(posterior) & (free[:-1] | free[1:]) & told[:-1] & told[1:]


def irregularities(
    posterior: FrameTimePosterior,
    duplicate: float = 0.25,
    dropped: float = 1.75,
    *,
    probability: float = 0.5,
    reach: int = REACH,
) -> list[Irregularity]:
    """Intervals that are no part of an even pace: below `duplicate`, or above `dropped`, times the local median.

    Told are those that are so in at least the share `probability` of the draws. The local median is that of the `reach`
    intervals before and after, as far as the shot goes, in the same draw: a pace that changes smoothly, in the clip or
    as learned, is even. Cuts (`frame_times.is_cut`) are not flagged, and end the neighbourhood. Intervals
    between two frames whose times were held are not judged, nor are those of a frame that does not tell its time
    (`FrameTimePosterior.identified`).

    Raises ValueError for bounds that are not 0 < duplicate < 1 < dropped, a probability out of (0, 1], reach < 1.

    **Example:** `[one.frames for one in irregularities(posterior) if one.kind == "duplicated"]`.
    """
    if not is_within(duplicate, "(0, 1)"):
        raise invalid("duplicate", expected="a number in (0, 1)", got=duplicate)
    if not (np.isfinite(dropped) and dropped > 1):
        raise invalid("dropped", expected="a number > 1", got=dropped)
    if not is_within(probability, "(0, 1]"):
        raise invalid("probability", expected="a number in (0, 1]", got=probability)
    if reach < 1:
        raise invalid("reach", expected="a whole number >= 1", got=reach)
    steps, asked, found = np.diff(_some(posterior), axis=1), judged(posterior), []
    for k, near in _neighbours(cuts(posterior), reach):
        if not asked[k]:
            continue
        size = steps[:, k] / np.median(steps[:, near], axis=1)
        for kind, so in (("duplicated", size < duplicate), ("dropped", size > dropped)):
            if so.mean() >= probability:
                low, high = np.quantile(size, [0.05, 0.95])
                one = Irregularity((k, k + 1), kind, float(so.mean()), float(size.mean()), float(low), float(high))
                found.append(one)
    return found


@dataclasses.dataclass(frozen=True)
class ComparedTimes:
    """What a video says of one model's frame times; log-likelihoods in nats, under the noise that all rows share.

    `at_own`: at the model's own times. `at_even`: the same splats at evenly spaced times. `log_evidence`: logarithm of
    the likelihood's mean over the prior of times, of all but the first and the last, the splats held. `mean_psnr`: in
    dB, at its own times.
    """

    name: str
    at_own: float
    at_even: float
    log_evidence: float
    mean_psnr: float


def compare_times(
    models: Mapping[str, VideoModel],
    video: UInt8[np.ndarray, "num_frames height width channels"],
    *,
    noise: str | FrameNoise = "score",
    concentration: float = 1.0,
) -> list[ComparedTimes]:
    """A row for each model of `video`, as of one fitted with learned and one with evenly spaced times.

    All likelihoods need the same noise to be compared: a `FrameNoise`, or that which `noise` names, estimated with the
    model whose residuals are least. Their normalising constant, the same in all rows, is left out. The splats are held
    and were fitted to the same frames: differences say how well each model's splats and times agree with the video, and
    are no Bayes factors of the two ways to fit.

    Raises ValueError for no models, models of another number of frames, and whatever `evidence` refuses.
    """
    if not models:
        raise invalid("models", expected="at least one, by name", got="none")
    for name, model in models.items():
        if model.num_frames != len(video):
            raise invalid(f"models[{name!r}]", expected=f"{len(video)} frames, as the video", got=model.num_frames)
    seen = {name: evidence(model, video, noise=noise) for name, model in models.items()}
    if not isinstance(noise, FrameNoise):
        common = min(seen.values(), key=lambda one: float(np.mean(one.noise.scale**2))).noise
        for name, model in models.items():
            if seen[name].noise is not common:
                seen[name] = evidence(model, video, noise=common)
    return [_compared(name, model, video, seen[name], concentration) for name, model in models.items()]


def _compared(name: str, model: VideoModel, video, seen: LikelihoodProfiles, concentration: float) -> ComparedTimes:
    num_frames = len(video)
    even = np.linspace(0.0, 1.0, num_frames)
    # Profiles are 0 at their modes; what they are there is drawn.
    zero = float(drawn_log_likelihood(model, video, seen.profiles.modes(), seen.noise).sum())
    found = exact_times(seen.profiles, Increments.among(even, None, concentration))
    own = np.asarray(model.frame_times.times(), np.float64)
    return ComparedTimes(
        name,
        float(drawn_log_likelihood(model, video, own, seen.noise).sum()),
        float(drawn_log_likelihood(model, video, even, seen.noise).sum()),
        found.log_evidence + zero,
        evaluate(model, np.asarray(video)).mean_psnr,
    )


def _some(posterior: FrameTimePosterior) -> Float64[np.ndarray, "draws num_frames"]:
    """At most ENOUGH draws, evenly spaced."""
    draws = posterior.draws
    return draws[np.unique(np.linspace(0, len(draws) - 1, ENOUGH).astype(int))]


def cuts(posterior: FrameTimePosterior) -> Bool[np.ndarray, "intervals"]:
    """Which intervals are cuts, by the posterior means (`foldgauss.video.models.frame_times.is_cut`)."""
    return np.asarray(is_cut(posterior.mean().astype(np.float32)))


def even_pace(posterior: FrameTimePosterior) -> tuple[Float64[np.ndarray, " num_frames"], float]:
    """Evenly spaced times between the first and the last frame of every shot, and what one frame is: their mean step.

    Without cuts: k / (num_frames - 1), and 1 / (num_frames - 1).
    """
    mean, cut = posterior.mean(), cuts(posterior)
    even = mean.copy()
    ends = np.concatenate([[-1], np.flatnonzero(cut), [len(mean) - 1]])
    for before, last in itertools.pairwise(ends):
        even[before + 1 : last + 1] = np.linspace(mean[before + 1], mean[last], last - before)
    return even, float(np.diff(mean)[~cut].mean())


def _neighbours(cut: np.ndarray, reach: int) -> Iterator[tuple[int, list[int]]]:
    """Each interval that is no cut, with those near it in the same shot, of which there are two at least."""
    shot = np.cumsum(cut)
    for k in np.flatnonzero(~cut):
        around = range(max(k - reach, 0), min(k + reach + 1, len(cut)))
        near = [j for j in around if j != k and not cut[j] and shot[j] == shot[k]]
        if len(near) >= 2:
            yield int(k), near
