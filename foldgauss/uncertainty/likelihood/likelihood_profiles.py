"""Likelihood profiles of frame times: adaptive choice of the times at which the model is rendered and compared."""

import dataclasses
import itertools
import warnings
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64, UInt8

from foldgauss._runtime.checks import require
from foldgauss.uncertainty.likelihood.noise import (
    NOISES,
    FrameNoise,
    autocorrelation,
    covariances,
    rings,
    score_fraction,
)
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.likelihood.residuals import Residuals, random_projection
from foldgauss.video.models.video_model import VideoModel

#: Coarse nodes in each interval between two frame times.
COARSE = 4
#: A profile is refined wherever it can come within so many nats of its maximum,
DEPTH = 25.0
#: until the cubic predicts the value half way to so many nats
MISS = 0.02
#: plus this fraction of the distance from the maximum,
MISS_FRACTION = 0.02
#: and images of adjacent nodes differ by at most so many nats,
TRAVEL = 4.0
#: or until nodes are this fraction of a coarse step apart.
FINEST = 1 / 512
#: Factor on distances of sketches, which have errors of about 6%.
CAUTION = 1.2
#: A profile that rises by less than this many nats does not identify the time of its frame.
FLAT = 0.5
#: Clips of up to this many frames are compared at all times,
MOST_EVERYWHERE = 400
#: longer ones at first within so many frames.
REACH = 100
#: Standard deviation of rounding to 8 bits, the lower bound of the noise.
LEAST_SCALE = 1 / (255 * np.sqrt(12))
#: Slopes dR/dt are central differences over this many of the finest steps.
SLOPE_STEP = 64
#: A model must explain this fraction of the frames' variance.
EXPLAINED = 0.2
#: A warning is given if a frame's squared error exceeds this multiple of the mean frame's, as that of a model of
#: another clip of the same scene may.
WORSE_THAN_MEAN = 1.5
_RIGHT_MODEL = "Give the model of this video, at its size and crop."
#: A warning is given if the first or last frame fits better by so many nats
PINNED = 10.0
#: at a time so many frames from 0 or 1.
AWAY = 0.5


@dataclasses.dataclass(frozen=True)
class LikelihoodProfiles:
    """Log-likelihood curves of all frames as functions of their times, and the noise that they assume.

    `log_likelihood` (num_frames,): of each frame at the mode of its curve, where the curve is 0, in nats, without the
    normalizing constant of the noise. `residual_correlation` (lags,): correlation of residuals by distance in pixels,
    averaged over frames. `num_rendered`: number of rendered images. `notes`: texts of the warnings.
    """

    curves: ProfileCurves
    noise: FrameNoise
    log_likelihood: Float64[np.ndarray, " num_frames"]
    residual_correlation: Float64[np.ndarray, " lags"]
    num_rendered: int
    notes: tuple[str, ...] = ()


def likelihood_profiles(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    *,
    noise: str | FrameNoise = "score",
    on_render: Callable[[int, int], None] | None = None,
) -> LikelihoodProfiles:
    """Compute the likelihood profiles of all frames by rendering the model at adaptively chosen times.

    `video` need not be the clip that the model was fitted to, nor have as many frames: each frame is compared at all
    times, of more than 400 frames first within 100 frame times of its own, widened as needed. But its first frame is at
    time 0 of the model and its last at 1; a warning is given if that does not fit, if the model may be of another clip
    of the same scene, and if Gaussians follow shared paths, which may absorb the times.
    `noise`: "score" (see `score_fraction`), "independent", or a `FrameNoise`.
    `on_render` is called with the numbers of images rendered and planned so far.

    Raises ValueError for a video of another size, one that the model does not explain, and one that does not identify
    its times.
    """
    residuals = Residuals(model, video)
    num_frames = len(residuals.frames)
    require(
        num_frames >= 3,
        "video",
        expected="at least 3 frames",
        got=num_frames,
        cure="The first frame is at time 0 and the last at 1: others are needed.",
    )
    given = isinstance(noise, FrameNoise)
    require(
        given or (isinstance(noise, str) and noise in NOISES),
        "noise",
        expected=f"one of {', '.join(NOISES)}, or a FrameNoise",
        got=noise,
    )
    noise = noise.for_frames(num_frames) if given else noise
    require(
        any((frame != residuals.frames[0]).any() for frame in residuals.frames),
        "video",
        expected="frames that differ",
        got=f"{num_frames} equal frames",
        cure="Times cannot be inferred where nothing changes.",
    )
    builder = ProfileBuilder(residuals, on_render)
    builder.compare_coarse()
    notes = _check_paths(model) + _check_explained(residuals.frames, builder)
    profiles = builder.build(noise)
    _check_identified(profiles.curves)
    notes += _check_ends(profiles.curves, builder.model_times)
    for note in notes:
        warnings.warn(note, UserWarning, stacklevel=2)
    return dataclasses.replace(profiles, notes=tuple(notes))


class ProfileBuilder:
    """Squared errors of all frames at the times compared so far, refined where the profiles require it."""

    def __init__(self, residuals: Residuals, on_render: Callable[[int, int], None] | None = None):
        self.residuals, self.on_render, self.num_rendered, self.num_planned = residuals, on_render, 0, 0
        num_frames = len(residuals.frames)
        self.model_times = np.asarray(residuals.model.frame_times.times(), np.float64)
        self.finest = FINEST / COARSE * float(np.median(np.diff(self.model_times)))
        self.reach = num_frames if num_frames <= MOST_EVERYWHERE else REACH
        self.projection = random_projection(residuals.frames[0].size)
        self.samples = [_Samples() for _ in range(num_frames)]

    def _render(self, times):
        self.num_planned += len(times)
        for t, image in zip(times, self.residuals.render_at(times), strict=True):
            yield t, image
            self.num_rendered += 1
            if self.on_render is not None:
                self.on_render(self.num_rendered, self.num_planned)

    def compare_coarse(self) -> None:
        """Compare all frames with images at coarse steps over all times, or the times within reach."""
        known = self.model_times
        times = np.interp(np.arange(COARSE * (len(known) - 1) + 1) / COARSE, np.arange(len(known)), known)
        while not self._compare(np.unique(times)):
            self.reach *= 2

    def _compare(self, times: np.ndarray) -> bool:
        """False if the best time of a frame is at the end of its reach."""
        known, num_frames = self.model_times, len(self.residuals.frames)
        position = np.interp(times, known, np.arange(len(known))) * ((num_frames - 1) / (len(known) - 1))
        found = [([], [], []) for _ in range(num_frames)]
        for n, (t, image) in enumerate(self._render(times)):
            near = np.flatnonzero(np.abs(np.arange(num_frames) - position[n]) <= self.reach)
            sketch = self.projection @ image.ravel()
            for k, error in zip(near, self.residuals.squared_errors(image, near), strict=True):
                for each, value in zip(found[k], (t, error, sketch), strict=True):
                    each.append(value)
        if min(len(times_of_frame) for times_of_frame, *_ in found) < 3:  # too few for a curve
            return False
        for each, columns in zip(self.samples, found, strict=True):
            each.set_coarse(*map(np.array, columns))
        return not any(each.best_at_end(times) for each in self.samples)

    def build(self, kind: str | FrameNoise) -> LikelihoodProfiles:
        """After `compare_coarse`: estimate the noise and refine the profiles accordingly."""
        noise, correlation = self.estimate_noise(kind)
        self.refine(noise)
        if not isinstance(kind, FrameNoise):  # again, with the residuals at the refined modes
            noise, correlation = self.estimate_noise(kind)
            self.refine(noise)
        best = -noise.weight * np.array([each.errors.min() for each in self.samples])
        return LikelihoodProfiles(self.curves(noise), noise, best, correlation, self.num_rendered)

    def refine(self, noise: FrameNoise) -> None:
        """Insert nodes into the profiles of all frames but the first and the last, whose times are fixed."""
        inner = range(1, len(self.samples) - 1)
        while wanted := [(t, k) for k in inner for t in self.samples[k].wanted(noise.weight[k], self.finest)]:
            compared = [
                (self.residuals.squared_errors(image, [k])[0], self.projection @ image.ravel())
                for (_, k), (_, image) in zip(wanted, self._render([t for t, _ in wanted]), strict=True)
            ]
            first = 0
            for k, group in itertools.groupby(wanted, key=lambda each: each[1]):
                last = first + len(list(group))
                self.samples[k].insert(*map(np.array, zip(*compared[first:last], strict=True)), noise.weight[k])
                first = last

    def estimate_noise(self, kind: str | FrameNoise) -> tuple[FrameNoise, np.ndarray]:
        """The noise from the residuals at every frame's mode, and their mean correlation by distance."""
        num_frames = len(self.samples)
        modes = [each.mode for each in self.samples]
        scale, fraction, together, correlations = np.empty(num_frames), np.ones(num_frames), 0.0, 0.0
        for k, (_, image) in enumerate(self._render(modes)):
            residual = self.residuals.residual(k, image)
            scale[k] = max(float(np.sqrt(np.mean(np.square(residual, dtype=np.float64)))), LEAST_SCALE)
            covariance = covariances(residual)
            together = together + covariance / scale[k] ** 2
            correlations = correlations + rings(autocorrelation(covariance))
        if kind == "score":
            step = self.finest * SLOPE_STEP
            times = [np.clip([t - step, t, t + step], 0.0, 1.0) for t in modes]
            images = self._render(np.concatenate(times))
            for k, (before, _, after) in enumerate(times):
                one, middle, other = (next(images)[1] for _ in range(3))
                slope = (other - one) / np.float32(after - before)
                fraction[k] = score_fraction(self.residuals.residual(k, middle), slope, together)
        found = kind if isinstance(kind, FrameNoise) else FrameNoise(scale, fraction)
        return found, correlations / num_frames

    def curves(self, noise: FrameNoise) -> ProfileCurves:
        errors = [each.errors for each in self.samples]
        return ProfileCurves.from_nodes(
            [each.times for each in self.samples],
            [-weight * (error - error.min()) for weight, error in zip(noise.weight, errors, strict=True)],
        )


class _Samples:
    """Squared errors of one frame at increasing times, sketches of the images there, and settled intervals."""

    def set_coarse(self, times: np.ndarray, errors: np.ndarray, sketches: np.ndarray) -> None:
        self.times, self.errors, self.sketches = times, errors, sketches
        self.settled = np.zeros(len(times) - 1, bool)
        self.asked = np.empty(0, int)

    @property
    def mode(self) -> float:
        return float(self.times[np.argmin(self.errors)])

    def best_at_end(self, times: np.ndarray) -> bool:
        """Whether the error is least at the first or last time of this frame that is not an end of all `times`."""
        best = int(np.argmin(self.errors))
        at_start = best <= 1 and self.times[0] > times[0]
        return at_start or (best >= len(self.times) - 2 and self.times[-1] < times[-1])

    def wanted(self, weight: float, finest: float) -> np.ndarray:
        """Midpoints of the intervals that must be refined."""
        below = weight * (self.errors - self.errors.min())
        apart = CAUTION * weight * np.square(np.diff(self.sketches, axis=0)).sum(1)
        # Bound on the maximum in an interval, if the image moves directly towards the frame.
        nearest = np.sqrt(np.minimum(below[:-1], below[1:]))
        reached = np.maximum(nearest - np.sqrt(apart), 0.0) ** 2 <= DEPTH
        slopes = weight * np.abs(np.gradient(self.errors, self.times, edge_order=2))
        width = np.diff(self.times)
        # Two nodes on both sides of a mode may have equal values: then their slopes are not 0.
        bent = np.maximum(np.abs(np.diff(below)), np.maximum(slopes[:-1], slopes[1:]) * width / 4) > MISS
        open_ones = (apart > TRAVEL) | (bent & ~self.settled)
        self.asked = np.flatnonzero(reached & open_ones & (width > 2 * finest))
        return (self.times[self.asked] + self.times[self.asked + 1]) / 2

    def insert(self, errors: np.ndarray, sketches: np.ndarray, weight: float) -> None:
        """Insert the values at the midpoints last requested."""
        left = self.asked
        slopes = np.gradient(self.errors, self.times, edge_order=2)
        width = np.diff(self.times)[left]
        guess = (self.errors[left] + self.errors[left + 1]) / 2 + (slopes[left] - slopes[left + 1]) * width / 8
        depth = weight * np.maximum(errors - self.errors.min(), 0)
        met = weight * np.abs(errors - guess) <= MISS + MISS_FRACTION * depth
        middles = (self.times[left] + self.times[left + 1]) / 2
        self.settled[left] = met
        self.settled = np.insert(self.settled, left, met)
        self.times = np.insert(self.times, left + 1, middles)
        self.errors = np.insert(self.errors, left + 1, errors)
        self.sketches = np.insert(self.sketches, left + 1, sketches, axis=0)


def check_explained(left: float, variance: float) -> None:
    """Raise ValueError unless the model's squared error `left` is small enough beside the frames' variance."""
    require(
        not left > (1 - EXPLAINED) * variance,
        "video",
        expected=f"frames of which the model explains {100 * EXPLAINED:.0f}%",
        got=f"a model that explains {(100 * (1 - left / variance) if variance else 0):.0f}% of their variance",
        cure=_RIGHT_MODEL,
    )


def _check_explained(frames: np.ndarray, builder: ProfileBuilder) -> list[str]:
    """Raises if the model explains too little of the variance over space and time; warns by the variance over time."""
    mean = np.mean(frames, axis=0, dtype=np.float64)
    over_time = sum(float(np.square(frame - mean).sum()) for frame in frames) / 255**2
    over_all = over_time + len(frames) * float(np.square(mean - mean.mean((0, 1))).sum()) / 255**2
    left = sum(float(each.errors.min()) for each in builder.samples)
    check_explained(left, over_all)
    if left <= WORSE_THAN_MEAN * over_time:
        return []
    worse = left / over_time if over_time else np.inf
    return [
        f"The model's errors are {worse:.1f} times those of the mean frame: nearly nothing moves in this video, or the"
        f" model is of another one. {_RIGHT_MODEL}"
    ]


def _check_identified(curves: ProfileCurves) -> None:
    rises = np.nanmax(curves.values, axis=1) - np.nanmin(curves.values, axis=1)
    require(
        not (rises[1:-1] < FLAT).all(),
        "video",
        expected="frames that identify their times",
        got=f"log-likelihoods that change by at most {rises[1:-1].max():.2g} over all times",
        cure="The times are not identified: nothing changes, or the noise is too great (5 gray levels: 5 / 255).",
    )


def _check_paths(model: VideoModel) -> list[str]:
    """A warning for Gaussians on paths: their maps, one for each frame, can explain what its time would."""
    splats = model.splats
    if splats.paths is None or not (num_on_path := np.count_nonzero(splats.path_index)):
        return []
    fraction = num_on_path / len(splats.path_index)
    return [
        f"{fraction:.0%} of the Gaussians follow shared paths, whose maps of each frame can absorb what its time would "
        "tell. Fit the model with --no-follow-camera (FitConfig(follow_camera=False)) to study frame times."
    ]


def _check_ends(curves: ProfileCurves, model_times: np.ndarray) -> list[str]:
    """Warnings for a first or last frame that fits better at other times than 0 and 1."""
    step, notes = np.median(np.diff(model_times)), []
    for k, end in ((0, 0.0), (curves.num_frames - 1, 1.0)):
        best = curves.modes()[k]
        lost = -float(curves[k](np.array([end]))[0])
        if lost > PINNED and abs(best - end) > AWAY * step:
            notes.append(
                f"Frame {k} is held at time {end:g}, but {best:.4f}, {abs(best - end) / step:.1f} frames away, is"
                f" better by {lost:.0f}: a video must begin and end as its model does, or nearby times will be wrong."
            )
    return notes
