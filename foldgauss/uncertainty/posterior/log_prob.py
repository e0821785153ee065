"""The log-posterior density of frame times, as samplers call it."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float64, UInt8

from foldgauss._runtime.checks import check_one_of, invalid, short_repr
from foldgauss.uncertainty.likelihood.color_marginalization import marginalize_colors
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles, likelihood_profiles
from foldgauss.uncertainty.likelihood.noise import NOISES, FrameNoise
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.likelihood.residuals import Residuals, check_model
from foldgauss.uncertainty.posterior.exact import exact_posterior
from foldgauss.uncertainty.posterior.increments import Increments
from foldgauss.video.models.video_model import VideoModel

#: The default estimate of the noise.
DEFAULT_NOISE = "score"


class FrameTimeLogProb:
    r"""Log-posterior density of the free frames' log-ratios up to a constant; batched and compiled.

    $$ \log p(z \mid y) = \sum_k \ell_k(t_k(z)) + \log \mathrm{Dirichlet}(p(z)) + \log |dp/dz| + \text{const} $$

    Conditioned on: the splats (positions, folds and colors), the times of held frames, and the noise.

    **Shapes:** called with coordinates (*batch, num_free), gives (*batch). **Units:** nats.
    **Example:** `log_prob(log_prob.increments.coordinates(times))`.
    **Source:** VeGaS eq:frame_fitting. **Raises:** ValueError where the density is NaN, and for other shapes.
    """

    def __init__(self, curves: ProfileCurves, increments: Increments):
        if curves.num_frames != increments.num_frames:
            got = f"{curves.num_frames} profiles, {increments.num_frames} times"
            raise invalid("profiles", expected="as many as there are times", got=got)
        self.curves, self.increments = curves, increments

    @property
    def num_free(self) -> int:
        return self.increments.num_free

    def __call__(self, coordinates: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch"]:
        times = self.increments.times(coordinates)
        found = self.curves(times).sum(-1) + self.increments.log_prior(coordinates)
        if np.isnan(found).any():
            cure = "Check curves and coordinates for NaN."
            raise invalid("coordinates", expected="coordinates with a log-density", got="NaN", cure=cure)
        return found

    def log_likelihood(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch"]:
        """Joint log-likelihood of all frames at these times; 0 if every frame is at its mode."""
        return self.curves(times).sum(-1)


def rendered_log_likelihood(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    times: Float[np.ndarray, " num_frames"],
    noise: FrameNoise,
) -> Float64[np.ndarray, " num_frames"]:
    """Log-likelihoods of the frames at `times` from rendered images, without interpolation.

    A frame's profile is this less its maximum. Raises ValueError for a video of another size, times that are not one
    per frame in [0, 1], and a noise that is not a FrameNoise.
    """
    if not isinstance(noise, FrameNoise):
        cure = "For instance `likelihood_profiles(..).noise`."
        raise invalid("noise", expected="a FrameNoise", got=short_repr(noise), cure=cure)
    residuals = Residuals(model, video)
    num_frames, times = len(residuals.frames), _as_array("times", times)
    if times.shape != (num_frames,) or not ((times >= 0) & (times <= 1)).all():
        got = f"shape {times.shape}" if times.shape != (num_frames,) else f"{times.min():.3g} to {times.max():.3g}"
        raise invalid("times", expected=f"{num_frames} times in [0, 1], one per frame", got=got)
    noise = noise.for_frames(num_frames)
    errors = [residuals.squared_errors(image, [k])[0] for k, image in enumerate(residuals.render_at(times))]
    return -noise.weight * np.array(errors)


#: What the posterior is conditioned on: all splats, or all but their colors.
LEVELS = ("splats", "colors")


def condition_on_level(
    level: str,
    model: VideoModel,
    video: np.ndarray | None,
    profiles: LikelihoodProfiles,
    frames: Sequence[int] | None,
    on_frame: Callable[[int, int], None] | None = None,
) -> LikelihoodProfiles:
    """The profiles given all splats, or with the colors integrated out."""
    check_level(level, video)
    if level == "splats":
        return profiles
    curves = marginalize_colors(model, video, profiles, frames=frames, on_frame=on_frame)
    return dataclasses.replace(profiles, curves=curves, level=level)


def check_level(level: str, video: np.ndarray | None) -> None:
    """ValueError for an unknown level, or a missing video for one that requires it."""
    if level not in LEVELS:
        cure = "To refit the splats use refit_frame_times."
        raise invalid("level", expected=" or ".join(map(repr, LEVELS)), got=short_repr(level), cure=cure)
    if level == "colors" and video is None:
        raise invalid("video", expected="frames to integrate out the colors", got=None)


def check_profiles(
    profiles: LikelihoodProfiles, video: np.ndarray | None, noise: str | FrameNoise = DEFAULT_NOISE
) -> int:
    """The number of frames; ValueError if `video` or `noise` conflicts with the profiles."""
    if not isinstance(profiles, LikelihoodProfiles):
        raise invalid("profiles", expected="the result of `likelihood_profiles`", got=short_repr(profiles))
    num_frames = profiles.curves.num_frames
    if video is not None and (shape := np.shape(video))[:1] != (num_frames,):
        cure = "Give the video of these profiles, or leave one of the two out."
        raise invalid("video", expected=f"the {num_frames} frames of `profiles`", got=f"shape {shape}", cure=cure)
    if noise is not profiles.noise and not (isinstance(noise, str) and noise == DEFAULT_NOISE):
        cure = "Profiles include their noise: give one to `likelihood_profiles`, or scale the curves."
        raise invalid("noise", expected="none beside `profiles`", got=short_repr(noise), cure=cure)
    return num_frames


def check_request(
    model: VideoModel,
    video: np.ndarray | None,
    noise: str | FrameNoise,
    level: str,
    frames: Sequence[int] | None,
    concentration: float,
    profiles: LikelihoodProfiles | None,
) -> Increments:
    """Validate arguments before any image is rendered; returns the coordinates of the free frames."""
    check_model(model)
    check_level(level, video)
    if profiles is not None:
        num_frames = check_profiles(profiles, video, noise)
    elif video is None:
        raise invalid("video", expected="frames, or `profiles`", got=None)
    else:
        if not isinstance(noise, FrameNoise):
            check_one_of("noise", noise if isinstance(noise, str) else short_repr(noise), NOISES)
        if (num_frames := len(video) if np.ndim(video) else 0) < 3:
            cure = "The first frame is at time 0 and the last at 1; others are needed."
            raise invalid("video", expected="at least 3 frames", got=f"shape {np.shape(video)}", cure=cure)
    return Increments.with_free(np.linspace(0.0, 1.0, num_frames), frames, concentration)


def frame_time_log_prob(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"] | None = None,
    *,
    noise: str | FrameNoise = DEFAULT_NOISE,
    level: str = "splats",
    frames: Sequence[int] | None = None,
    concentration: float = 1.0,
    held: Float[np.ndarray, " num_frames"] | None = None,
    profiles: LikelihoodProfiles | None = None,
    on_render: Callable[[int, int], None] | None = None,
) -> FrameTimeLogProb:
    """The log-posterior density of the times of `frames` (default: all but the first and the last) given the splats.

    `video`: uint8 (num_frames, height, width, 3 or 4) at the model's size; it may be another cut of the same scene,
    with another number of frames. `noise`, `on_render`: see `likelihood_profiles`, whose result may be given as
    `profiles`, without a `noise`. `level`: "splats" conditions on all splats, "colors" integrates their colors out
    (`marginalize_colors`: minutes per frame for large models, so choose `frames`); to refit all splats use
    `refit_frame_times`. `concentration`: of the Dirichlet prior on increments. `held`: the times of all other frames
    (default: their posterior medians when all are free).

    Raises ValueError for a video of another size, scene or number of frames than the profiles, one that does not
    identify its times, frames out of the model's order, and settings out of range or in conflict with the profiles.
    """
    free = check_request(model, video, noise, level, frames, concentration, profiles)
    if held is not None:
        held = _as_array("held", held)
        if held.shape != (free.num_frames,):
            raise invalid("held", expected=f"{free.num_frames} times", got=f"shape {held.shape}")
        free = Increments(held, free.free, concentration)
    if profiles is None:
        profiles = likelihood_profiles(model, video, noise=noise, on_render=on_render)
    profiles = condition_on_level(level, model, video, profiles, frames)
    if held is None and frames is not None:
        everything = Increments.with_free(free.held, None, concentration)
        held = _separate(exact_posterior(profiles.curves, everything).quantile(0.5))
        free = Increments(held, free.free, concentration)
    return FrameTimeLogProb(profiles.curves, free)


def _separate(times: Float64[np.ndarray, " num_frames"]) -> Float64[np.ndarray, " num_frames"]:
    """Make medians strictly increasing by the spacing of float64: those of nearly equal frames may coincide."""
    if (np.diff(times) > 0).all():
        return times
    times = np.maximum.accumulate(times)
    least = np.spacing(1.0)
    places = np.arange(len(times)) * least
    return np.minimum(np.maximum.accumulate(times - places) + places, 1.0 - places[::-1])


def _as_array(name: str, values) -> np.ndarray:
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise invalid(name, expected="numbers", got=short_repr(values)) from error
