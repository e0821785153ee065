"""Gaussians born where a running fit has the largest errors, drawn and moved like those of the start."""

import math
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import cpu
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.initialize import SCALE_FACTOR, draw_positions, find_constant, make_splats, make_static
from foldgauss.video.fitting.schedule import to_planes
from foldgauss.video.models.background import random_background
from foldgauss.video.models.conditioning import ConditioningSpec, condition
from foldgauss.video.models.row_layout import columns, pack
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.motion.optical_flow import Motion

#: The size of newborns relative to that of evenly spread Gaussians: errors have finer detail than the present image.
SMALLER = 0.6


def make_newborns(
    num: int,
    frames: UInt8[np.ndarray, "num_frames height width 3"],
    times: Float[np.ndarray, " num_frames"],
    errors: Float[np.ndarray, " num_frames"],
    measure_squares: Callable[[int], Float32[np.ndarray, "height width"]],
    alive: float,
    *,
    degree: int,
    envelope: TimeLikelihood,
    motion: Motion | None,
    paths: SharedPaths | None,
    opacity: float,
    with_static: bool,
    seed: tuple[int, ...],
) -> Float32[np.ndarray, "num width"]:
    """Packed rows of `num` Gaussians, at frames and positions drawn by squared error, with the colors of the clip.

    `errors` are those of the frames, `measure_squares(k)` gives those of the pixels of frame k; `alive` is the mean
    number of Gaussians alive in a frame. With `with_static`, those whose pixel never changes are static.
    """
    rng = np.random.default_rng(seed)
    home = np.sort(rng.choice(len(frames), num, p=errors / errors.sum()))

    def density_of(k: int) -> np.ndarray:
        smooth = cv2.GaussianBlur(measure_squares(k).astype(np.float64), (0, 0), 1.0) + 1e-12
        return smooth / smooth.sum()

    position, _ = draw_positions(home, density_of, rng)
    splats, _ = make_splats(frames, home, position, times, degree, envelope, motion, rng, opacity, paths)
    rows = pack(make_static(splats, find_constant(frames, home, position)) if with_static else splats)
    size = frames.shape[1:3]
    apart = math.sqrt(math.prod(size) / max(alive, 1.0)) / max(size)
    larger = 0.0 if paths is None else rows[:, columns(degree)["log_scale"]] + np.log(max(size))  # by the path's zoom
    rows[:, columns(degree)["log_scale"]] = np.log(SMALLER * SCALE_FACTOR * apart) + larger
    return rows


def make_target(
    frames: UInt8[np.ndarray, "num_frames height width channels"], k: int, config: FitConfig
) -> tuple[Float32[np.ndarray, "3 height width"], Float[np.ndarray, "3"]]:
    """Frame k and the background: with alpha, a random color that is always the same for the frame."""
    background = random_background(config.seed, k) if frames.shape[3] == 4 else np.zeros(3, np.float32)
    return to_planes(frames[k], background), background


def measure_squares(
    rows: Float32[np.ndarray, "num width"],
    window: Float32[np.ndarray, "num 2"],
    t: float,
    target: Float32[np.ndarray, "3 height width"],
    background: Float[np.ndarray, "3"],
    spec: ConditioningSpec,
    config: FitConfig,
) -> Float32[np.ndarray, "height width"]:
    """Squared errors of the pixels of the image at time t, summed over the channels."""
    done = condition(rows, window, t, spec)
    leaves = done.mean, done.factor, done.opacity, done.color, background
    image = cpu.forward(*leaves, spec.size, compositing=config.compositing, options=config.options).image
    return ((image - target) ** 2).sum(0)


def shuffle_into(num_old: int, num_new: int, rng: np.random.Generator) -> Int[np.ndarray, "all"]:
    """A random order of old rows followed by new ones, in which the old rows keep theirs."""
    place = np.concatenate([np.arange(num_old) + 0.5, rng.uniform(0, num_old, num_new)])
    return np.argsort(place, kind="stable")
