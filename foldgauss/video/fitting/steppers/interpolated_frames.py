"""Training images between frames: which steps have one, and what the optical flow predicts there.

Without them, what a fit shows between two frames is not determined: Gaussians that are visible in one frame only add
what that frame lacks, and are wrong half way to the next. Only the steps before `Views.interpolation_end` have
interpolated frames; the others recover the quality at the frames, and lose a part only of what was gained between.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from jaxtyping import Float32

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.threads import num_threads
from foldgauss.video.fitting.config import INTERPOLATION_FRACTION, FitConfig
from foldgauss.video.fitting.schedule import choose_views, find_views_in_turn
from foldgauss.video.fitting.state import FitState
from foldgauss.video.motion.optical_flow import Motion

#: Times lie at least this fraction of an interval away from both of its frames.
MARGIN = 0.1


class InterpolatedFrames:
    """The interpolated frames of a fit, made when they are needed."""

    def __init__(self, frames: np.ndarray, config: FitConfig, chance: float, motion: Motion):
        self.frames, self.config, self.chance, self.motion = frames, config, chance, motion
        self.left_out = {*(k - 1 for k in motion.cuts), *motion.find_still(), len(frames) - 1}

    def choose(self, step: int, progress: float, k: int) -> float | None:
        """At which fraction of the way from frame k to the next the time of a step lies; None for the frame itself."""
        if progress >= self.config.views.interpolation_end or k in self.left_out or not step:
            return None
        rng = make_generator(Stream.INTERPOLATED_FRAME, step, k, seed=self.config.seed)
        chosen, fraction = rng.random() < self.chance, rng.uniform(MARGIN, 1 - MARGIN)
        return fraction if chosen else None

    def interpolate(self, k: int, fraction: float) -> Float32[np.ndarray, "height width 3"]:
        """The image at a fraction of the way from frame k to the next; values about [0, 1]."""
        return self.motion.interpolate(self.frames, k, fraction, self.frames.shape[1:3]).image * np.float32(1 / 255)


def choose_targets(
    interpolation: InterpolatedFrames | None, config: FitConfig, num_frames: int, state: FitState, progress: float
) -> tuple[np.ndarray, list[float | None]]:
    """The views of a step, and for each the fraction of `InterpolatedFrames.choose`.

    Interpolated ones are views in turn, never drawn by error: so they are known before the steps until then.
    """
    views = choose_views(config, num_frames, state.step, state.frame_errors)
    if interpolation is None:
        return views, [None] * len(views)
    _, drawn = find_views_in_turn(config, num_frames, state.step)
    given = zip(views % num_frames, drawn, strict=True)
    return views, [None if by_error else interpolation.choose(state.step, progress, int(k)) for k, by_error in given]


class Prefetcher:
    """Makes images of later steps on threads, while a device computes; the same bits as without."""

    def __init__(self, interpolation: InterpolatedFrames, most: int | None = None):
        """At most `most` images are kept, by default two for each thread: a process that ends waits for them."""
        self.interpolation, self._most = interpolation, 2 * num_threads() if most is None else most
        self._pool = ThreadPoolExecutor(num_threads(), thread_name_prefix="foldgauss-interpolation")
        self.images: dict[tuple[int, int], Future] = {}  # made or being made, by step and frame

    def prepare(self, step: int, progress: float, frames: Iterable[int]) -> bool:
        """Start to make the images that a step needs if these are its frames; False if no more are kept."""
        for k in frames:
            fraction = self.interpolation.choose(step, progress, k)
            if fraction is not None and (step, k) not in self.images:
                if len(self.images) >= self._most:
                    return False
                future = self._pool.submit(self.interpolation.interpolate, k, fraction)
                self.images[step, k] = future
        return True

    def interpolate(self, step: int, k: int, fraction: float) -> np.ndarray:
        """`InterpolatedFrames.interpolate` of a frame of a step, which was prepared or is made now."""
        future = self.images.get((step, k))
        return self.interpolation.interpolate(k, fraction) if future is None else future.result()

    def drop(self, step: int) -> None:
        """Forget the images of this step and of those before it."""
        for key in [key for key in self.images if key[0] <= step]:
            self.images.pop(key).cancel()


def make_interpolated(
    frames: np.ndarray, config: FitConfig, find_motion: Callable[[], Motion]
) -> InterpolatedFrames | None:
    """The interpolated frames of a fit to `frames`; None where it has none, and so needs no optical flow for them."""
    chance = config.views.interpolation_fraction
    if chance is None:  # by default only where optical flow is used, and tells what is there (not behind alpha)
        chance = INTERPOLATION_FRACTION if config.follows_motion and frames.shape[3] == 3 else 0.0
    chance = min(chance / (1 - config.views.error_fraction), 1.0) if len(frames) > 1 else 0.0
    return InterpolatedFrames(frames, config, chance, find_motion()) if chance > 0 else None
