"""Profiles of a model's frame times: which times are drawn, and what comes of it."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64, UInt8

from foldgauss._checks import invalid
from foldgauss.uncertainty.noise import (
    LAST_CORRELATION,
    NOISES,
    FrameNoise,
    autocorrelation,
    effective_share,
    rings,
    score_share,
)
from foldgauss.uncertainty.profiles import Profiles
from foldgauss.uncertainty.screen import Screen
from foldgauss.video.model import VideoModel

#: Coarse nodes in each interval between two frame times.
COARSE = 4
#: A profile is drawn finer where it is within DEPTH nats of its maximum, until the cubic meets what is drawn half way
#: to MISS nats and MISS_SHARE of the distance from the maximum, or nodes are the share FINEST of a coarse step apart.
DEPTH, MISS, MISS_SHARE, FINEST = 25.0, 0.02, 0.02, 1 / 512
#: A frame shows nothing of its time where its profile rises by less than this many nats.
FLAT = 0.5
#: Adjoining nodes at the maximum differ by at most this many nats.
STEP = 1.0
#: Clips of up to so many frames are compared at all times, longer ones within REACH frames.
MOST_EVERYWHERE, REACH = 400, 100
#: Noise of rounding to 8 bits: no frame is known better.
LEAST_SCALE = 1 / (255 * np.sqrt(12))
#: Slopes are differences over this many of the finest steps to both sides.
SLOPE_STEP = 64
#: The least share of the frames' variance that a model of them explains.
EXPLAINED = 0.2


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What the pictures say of every frame's time: profiles, and the noise they were made with.

    `residual_correlation` (lags,): correlation of residuals by distance in pixels, mean over the frames.
    `num_drawn`: pictures drawn for it.
    """

    profiles: Profiles
    noise: FrameNoise
    residual_correlation: Float64[np.ndarray, "lags"]
    num_drawn: int


def evidence(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    *,
    noise: str | FrameNoise = "score",
    reach: int | None = None,
    on_picture: Callable[[int, int], None] | None = None,
) -> Evidence:
    """Draw the model at as many times as the profiles of all frames need.

    `video` need not be what the model was fitted to, nor have as many frames: every frame is looked for at every time,
    or only within `reach` frame times of its own. `noise`: "effective" or "score" (see `effective_share`,
    `score_share`), "independent", or a `FrameNoise`. `on_picture` is called with how many are drawn and how many there
    will be, as far as is known. Raises ValueError for a video of another size, one that the model does not explain, and
    one that shows nothing of its times.
    """
    screen = Screen(model, video)
    num_frames = len(screen.frames)
    if num_frames < 3:
        cure = "The first frame is at time 0 and the last at 1: others are needed."
        raise invalid("video", expected="at least 3 frames", got=num_frames, cure=cure)
    if isinstance(noise, FrameNoise):
        noise = noise.of(num_frames)
    elif noise not in NOISES:
        raise invalid("noise", expected=f"one of {', '.join(NOISES)}, or a FrameNoise", got=noise)
    _check_changes(screen.frames)
    drawn = Drawn(screen, reach, on_picture)
    drawn.coarse()
    _check_explained(screen.frames, drawn)
    seen = drawn.evidence(noise)
    _check_identified(seen.profiles)
    return seen


class Drawn:
    """Squared errors of every frame at the times drawn for it, and which times those are."""

    def __init__(self, screen: Screen, reach: int | None = None, on_picture: Callable[[int, int], None] | None = None):
        self.screen, self.on_picture, self.num_drawn, self.num_planned = screen, on_picture, 0, 0
        num_frames = len(screen.frames)
        self.model_times = np.asarray(screen.model.frame_times.times(), np.float64)
        self.finest = FINEST / COARSE * float(np.median(np.diff(self.model_times)))
        self.reach = (None if num_frames <= MOST_EVERYWHERE else REACH) if reach is None else reach
        if self.reach is not None and self.reach < 1:
            raise invalid("reach", expected="a whole number >= 1, or None", got=reach)
        self.samples = [_Samples() for _ in range(num_frames)]

    def _pictures(self, times):
        self.num_planned += len(times)
        for t, picture in zip(times, self.screen.pictures(times), strict=True):
            yield t, picture
            self.num_drawn += 1
            if self.on_picture is not None:
                self.on_picture(self.num_drawn, self.num_planned)

    def coarse(self) -> None:
        """Compare all frames with pictures over all the time, or the time within reach."""
        known, num_frames = self.model_times, len(self.screen.frames)
        times = np.interp(np.arange(COARSE * (len(known) - 1) + 1) / COARSE, np.arange(len(known)), known)
        times = np.unique(times)
        position = np.interp(times, known, np.arange(len(known))) * ((num_frames - 1) / (len(known) - 1))
        found = [([], []) for _ in range(num_frames)]
        for n, (t, picture) in enumerate(self._pictures(times)):
            near = np.arange(num_frames)
            if self.reach is not None:
                near = near[np.abs(near - position[n]) <= self.reach]
            for k, error in zip(near, self.screen.squared_errors(picture, near), strict=True):
                found[k][0].append(t)
                found[k][1].append(error)
        for each, (at, errors) in zip(self.samples, found, strict=True):
            each.begin(np.array(at), np.array(errors))

    def evidence(self, kind: str | FrameNoise) -> Evidence:
        """After `coarse`: the noise, and profiles as fine as it asks for."""
        noise, correlation = self.noise(kind)
        self.refine(noise)
        if not isinstance(kind, FrameNoise):  # once more, with the residuals where they are least
            noise, correlation = self.noise(kind)
            self.refine(noise)
        return Evidence(self.profiles(noise), noise, correlation, self.num_drawn)

    def refine(self, noise: FrameNoise) -> None:
        """Draw pictures between the nodes of every frame but the first and the last, whose times are fixed."""
        inner = range(1, len(self.samples) - 1)
        while wanted := [(t, k) for k in inner for t in self.samples[k].wanted(noise.weight[k], self.finest)]:
            errors = [
                self.screen.squared_errors(picture, [k])[0]
                for (_, k), (_, picture) in zip(wanted, self._pictures([t for t, _ in wanted]), strict=True)
            ]
            first = 0
            for k, group in itertools.groupby(wanted, key=lambda each: each[1]):
                size = len(list(group))
                self.samples[k].insert(errors[first : first + size], noise.weight[k])
                first += size

    def noise(self, kind: str | FrameNoise) -> tuple[FrameNoise, np.ndarray]:
        """Of the residuals of every frame where its error is least; and their correlation by distance."""
        num_frames = len(self.samples)
        modes = np.array([each.mode for each in self.samples])
        modes[[0, -1]] = self.model_times[[0, -1]]
        scale, share, correlations = np.empty(num_frames), np.ones(num_frames), []
        for k, (_, picture) in enumerate(self._pictures(modes)):
            residual = self.screen.residual(k, picture)
            scale[k] = max(float(np.sqrt(np.mean(np.square(residual, dtype=np.float64)))), LEAST_SCALE)
            correlations.append(rings(autocorrelation(residual)))
            if kind == "effective":
                share[k] = effective_share(residual)
            elif kind == "score":
                share[k] = self._score_share(k, residual, modes[k], correlations[-1])
        if isinstance(kind, FrameNoise):
            return kind, np.mean(correlations, axis=0)
        return FrameNoise(scale, share), np.mean(correlations, axis=0)

    def _score_share(self, k: int, residual: np.ndarray, t: float, correlation: np.ndarray) -> float:
        step = self.finest * SLOPE_STEP
        before, after = max(t - step, 0.0), min(t + step, 1.0)
        ends = list(self.screen.pictures([before, after]))
        below = np.flatnonzero(correlation < LAST_CORRELATION)
        bandwidth = 2 * int(below[0] if below.size else len(correlation) - 1)
        most = min(residual.shape[1:]) - 1
        return score_share(residual, (ends[1] - ends[0]) / (after - before), min(bandwidth, most))

    def profiles(self, noise: FrameNoise) -> Profiles:
        errors = [each.errors for each in self.samples]
        return Profiles.of(
            [each.times for each in self.samples],
            [-weight * (error - error.min()) for weight, error in zip(noise.weight, errors, strict=True)],
        )


class _Samples:
    """Squared errors of a frame at rising times, and which intervals between need none drawn."""

    def begin(self, times: np.ndarray, errors: np.ndarray) -> None:
        self.times, self.errors = times, errors
        self.settled = np.zeros(len(times) - 1, bool)
        self.asked = np.empty(0, int)

    @property
    def mode(self) -> float:
        return float(self.times[np.argmin(self.errors)])

    def wanted(self, weight: float, finest: float) -> np.ndarray:
        """Times half way of the intervals that have to be drawn."""
        below = weight * (self.errors - self.errors.min())
        near, step = below <= DEPTH, np.abs(np.diff(below))
        best = int(np.argmin(below))
        at_best = np.zeros_like(self.settled)
        at_best[max(best - 1, 0) : best + 1] = True
        matters = near[:-1] | near[1:]
        unknown = ~self.settled | (at_best & (step > STEP))
        # Two nodes may be as high as each other on two sides of a hill: then their slopes are not 0.
        slopes = weight * np.abs(np.gradient(self.errors, self.times, edge_order=2))
        width = np.diff(self.times)
        bent = np.maximum(step, np.maximum(slopes[:-1], slopes[1:]) * width / 4) > MISS
        self.asked = np.flatnonzero(matters & unknown & bent & (width > 2 * finest))
        return (self.times[self.asked] + self.times[self.asked + 1]) / 2

    def insert(self, errors: np.ndarray, weight: float) -> None:
        """Take in what was drawn at the times last asked for."""
        errors, left = np.asarray(errors), self.asked
        slopes = np.gradient(self.errors, self.times, edge_order=2)
        width = np.diff(self.times)[left]
        guess = (self.errors[left] + self.errors[left + 1]) / 2 + (slopes[left] - slopes[left + 1]) * width / 8
        depth = weight * np.maximum(errors - self.errors.min(), 0)
        met = weight * np.abs(errors - guess) <= MISS + MISS_SHARE * depth
        middles = (self.times[left] + self.times[left + 1]) / 2
        self.settled[left] = met
        self.settled = np.insert(self.settled, left, met)
        self.times = np.insert(self.times, left + 1, middles)
        self.errors = np.insert(self.errors, left + 1, errors)


def _check_changes(frames: np.ndarray) -> None:
    first = frames[0]
    if all(np.array_equal(first, frame) for frame in frames[1:]):
        cure = "There is nothing to be learned of times where nothing changes."
        raise invalid("video", expected="frames that differ", got=f"{len(frames)} equal frames", cure=cure)


def _check_explained(frames: np.ndarray, drawn: Drawn) -> None:
    variation = sum(float(frame.var(axis=(0, 1)).sum()) for frame in frames) * frames[0, ..., 0].size / 255**2
    left = sum(float(each.errors.min()) for each in drawn.samples)
    if left > (1 - EXPLAINED) * variation:
        got = f"a model that explains {100 * (1 - left / variation) if variation else 0:.0f}% of their variance"
        cure = "Give the model of this video, at its size and crop."
        raise invalid(
            "video", expected=f"frames of which the model explains {100 * EXPLAINED:.0f}%", got=got, cure=cure
        )


def _check_identified(profiles: Profiles) -> None:
    rises = np.nanmax(profiles.values, axis=1) - np.nanmin(profiles.values, axis=1)
    if (rises[1:-1] < FLAT).all():
        got = f"log-likelihoods that change by at most {rises[1:-1].max():.2g} over all times"
        cure = "The times are not identified: the model shows nothing that changes, or the noise is too great."
        raise invalid("video", expected="frames that tell their times", got=got, cure=cure)
