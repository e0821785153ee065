"""The log-posterior of frame times, as samplers ask for it."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float64, UInt8

from foldgauss._checks import invalid
from foldgauss.uncertainty.colors import evidence_without_colors
from foldgauss.uncertainty.drawing import Evidence, evidence
from foldgauss.uncertainty.exact import exact_times
from foldgauss.uncertainty.increments import Increments
from foldgauss.uncertainty.noise import FrameNoise
from foldgauss.uncertainty.profiles import Profiles
from foldgauss.uncertainty.screen import Screen
from foldgauss.video.model import VideoModel


class FrameTimeLogProb:
    r"""Log-posterior density of the free frames' log-ratios, up to the evidence; batched, by compiled look-ups.

    .. math:: \log p(z \mid y) = \sum_k \ell_k(t_k(z)) + \log \mathrm{Dirichlet}(p(z)) + \log |dp/dz| + \text{const}

    Conditioned on: the splats (their places, folds and colours), the times of frames that are held, and the noise.

    **Shapes:** called with coordinates (*batch, num_free), gives (*batch). **Units:** nats.
    **Example:** `log_prob(log_prob.increments.coordinates(times))`.
    **Source:** VeGaS eq:frame_fitting. **Raises:** ValueError where the density is NaN, and for other shapes.
    """

    def __init__(self, profiles: Profiles, increments: Increments):
        if profiles.num_frames != increments.num_frames:
            got = f"{profiles.num_frames} profiles, {increments.num_frames} times"
            raise invalid("profiles", expected="as many as there are times", got=got)
        self.profiles, self.increments = profiles, increments

    @property
    def num_free(self) -> int:
        return self.increments.num_free

    def __call__(self, coordinates: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch"]:
        times = self.increments.times(coordinates)
        found = self.profiles(times).sum(-1) + self.increments.log_prior(coordinates)
        if np.isnan(found).any():
            cure = "Look for NaN in profiles or coordinates."
            raise invalid("coordinates", expected="numbers with a log-density", got="NaN", cure=cure)
        return found

    def log_likelihood(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch"]:
        """Of all frames at these times, looked up; 0 is every frame at its best."""
        return self.profiles(times).sum(-1)


def drawn_log_likelihood(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    times: Float[np.ndarray, "num_frames"],
    noise: FrameNoise,
) -> Float64[np.ndarray, "num_frames"]:
    """The frames' log-likelihoods at `times`, drawn, without a look-up: what profiles are compared with.

    A frame's profile is this less its value where it is greatest.
    """
    screen = Screen(model, video)
    noise = noise.of(len(screen.frames))
    errors = [screen.squared_errors(picture, [k])[0] for k, picture in enumerate(screen.pictures(times))]
    return -noise.weight * np.array(errors)


#: What frame times are conditioned on.
LEVELS = ("splats", "colors")


def at_level(
    level: str,
    model: VideoModel,
    video: np.ndarray | None,
    seen: Evidence,
    frames: Sequence[int] | None,
    on_frame: Callable[[int, int], None] | None = None,
) -> Evidence:
    """What is seen given the splats, or with the colours of these integrated out."""
    if level not in LEVELS:
        cure = "Refitted splats are another thing: see refit_frame_times."
        raise invalid("level", expected=" or ".join(LEVELS), got=level, cure=cure)
    if level == "splats":
        return seen
    if video is None:
        raise invalid("video", expected="frames, where colours are integrated out", got=None)
    profiles = evidence_without_colors(model, video, seen, frames=frames, on_frame=on_frame)
    return dataclasses.replace(seen, profiles=profiles)


def frame_time_log_prob(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"] | None = None,
    *,
    noise: str | FrameNoise = "score",
    level: str = "splats",
    frames: Sequence[int] | None = None,
    concentration: float = 1.0,
    held: Float[np.ndarray, "num_frames"] | None = None,
    seen: Evidence | None = None,
    on_picture: Callable[[int, int], None] | None = None,
) -> FrameTimeLogProb:
    """The log-posterior of the times of `frames` (default: of all but the first and the last), given the splats.

    `video`: uint8 (num_frames, height, width, 3 or 4) at the model's size; it may be another cut of the same scene,
    with another number of frames. `noise`, `on_picture`: see `evidence`, whose result may be handed in as `seen`.
    `level`: what else is unknown: "splats" holds them all, "colors" integrates their colours out
    (`evidence_without_colors`: minutes a frame for large models, so choose `frames`); refitting all of them is another
    thing, `refit_frame_times`. `concentration`: of the Dirichlet prior on increments. `held`: the times of all other
    frames (default: the posterior medians of all).

    Raises ValueError for a video of another size or scene, one that shows nothing of its times, frames out of the
    model's order, and settings out of range.
    """
    if seen is None:
        if video is None:
            raise invalid("video", expected="frames, or what was `seen`", got=None)
        seen = evidence(model, video, noise=noise, on_picture=on_picture)
    seen = at_level(level, model, video, seen, frames)
    num_frames = seen.profiles.num_frames
    if held is None:
        ends = np.linspace(0.0, 1.0, num_frames)
        everything = Increments.among(ends, None, concentration)
        if frames is None:
            return FrameTimeLogProb(seen.profiles, everything)
        held = exact_times(seen.profiles, everything).quantile(0.5)
    if np.shape(held) != (num_frames,):
        raise invalid("held", expected=f"{num_frames} times", got=f"shape {np.shape(held)}")
    return FrameTimeLogProb(seen.profiles, Increments.among(held, frames, concentration))
