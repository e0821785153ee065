"""The log-posterior density of frame times, as samplers call it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, UInt8

from foldgauss._runtime.checks import invalid, short_repr
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.uncertainty.posterior.exact import exact_posterior
from foldgauss.uncertainty.posterior.increments import Increments
from foldgauss.video.models.video_model import VideoModel


class FrameTimeLogProb:
    r"""Log-posterior density of the free frames' times up to a constant; batched and compiled.

    $$ \log p(t \mid y) = \sum_k \ell_k(t_k) + \log \mathrm{Dirichlet}(\Delta t) + \text{const} $$

    Conditioned on: the splats (positions, folds and colors), the times of held frames, and the noise.

    **Shapes:** called with free times (*batch, num_free), gives (*batch); -inf for times that do not increase.
    **Units:** nats. **Source:** VeGaS eq:frame_fitting. **Raises:** ValueError where the density is NaN, and for other
    shapes.
    """

    def __init__(self, curves: ProfileCurves, increments: Increments):
        if curves.num_frames != increments.num_frames:
            got = f"{curves.num_frames} profiles, {increments.num_frames} times"
            raise invalid("profiles", expected="as many as there are times", got=got)
        self.curves, self.increments = curves, increments

    def __call__(self, free: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch"]:
        times = self.increments.times(free)
        found = self.log_likelihood(times) + self.increments.log_prior(times)
        if np.isnan(found).any():
            cure = "Check curves and times for NaN."
            raise invalid("free", expected="times with a log-density", got="NaN", cure=cure)
        return found

    def log_likelihood(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch"]:
        """Joint log-likelihood of all frames at these times; 0 if every frame is at its mode."""
        return self.curves(times).sum(-1)


def frame_time_log_prob(
    profiles: LikelihoodProfiles, *, frames: Sequence[int] | None = None, concentration: float = 1.0
) -> FrameTimeLogProb:
    """The log-posterior density of the times of `frames` (default: all but the first and the last) given the profiles.

    All other frames are held at their posterior medians when all are free. `concentration`: of the Dirichlet prior on
    increments. Raises ValueError for frames out of the model's order, and settings out of range.
    """
    if not isinstance(profiles, LikelihoodProfiles):
        raise invalid("profiles", expected="the result of `likelihood_profiles`", got=short_repr(profiles))
    even = np.linspace(0.0, 1.0, profiles.curves.num_frames)
    increments = Increments(even, frames, concentration)
    if frames is not None:
        medians = exact_posterior(profiles.curves, Increments(even, None, concentration)).quantile(0.5)
        increments = Increments(medians, frames, concentration)
    return FrameTimeLogProb(profiles.curves, increments)


def rendered_log_likelihood(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    times: Float[np.ndarray, " num_frames"],
    noise: FrameNoise,
) -> Float64[np.ndarray, " num_frames"]:
    """Log-likelihoods of the frames at `times` from rendered images, without interpolation.

    A frame's profile is this less its maximum. Raises ValueError for a video of another size, and times that are not
    one per frame in [0, 1].
    """
    residuals, times = Residuals(model, video), np.asarray(times, np.float64)
    if times.shape != (len(video),) or not ((times >= 0) & (times <= 1)).all():
        raise invalid("times", expected=f"{len(video)} times in [0, 1], one per frame", got=f"shape {times.shape}")
    errors = [residuals.squared_errors(image, [k])[0] for k, image in enumerate(residuals.render_at(times))]
    return -noise.for_frames(len(video)).weight * np.array(errors)
