"""Gaussians born where a running fit has the largest errors, drawn and moved like those of the start."""

import dataclasses
import math

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.render import cpu
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.initialize import (
    SCALE_FACTOR,
    START_OPACITY,
    SUMMED_OPACITY,
    draw_positions,
    make_splats,
)
from foldgauss.video.fitting.schedule import to_planes
from foldgauss.video.fitting.state import FitState, envelope_of, frame_times, paths_of
from foldgauss.video.models.background import random_background
from foldgauss.video.models.conditioning import ConditioningSpec, condition, find_windows
from foldgauss.video.models.row_layout import columns, pack
from foldgauss.video.motion.optical_flow import Motion

#: The size of newborns relative to that of evenly spread Gaussians: errors have finer detail than the present image.
SMALLER = 0.6


def make_newborns(
    num: int,
    state: FitState,
    frames: UInt8[np.ndarray, "num_frames height width channels"],
    errors: Float[np.ndarray, " num_frames"],
    config: FitConfig,
    spec: ConditioningSpec,
    motion: Motion | None,
) -> Float32[np.ndarray, "num width"]:
    """Packed rows of `num` Gaussians, at frames and positions drawn by squared error, with the colors of the clip.

    `errors` are the squared errors of the frames, up to a common factor; `spec` is that of whole frames.
    """
    rng = make_generator(Stream.BIRTH, state.step, seed=config.seed)
    times, window, paths = np.asarray(frame_times(state.time_logits)), find_windows(state.rows, spec), paths_of(state)
    spec, colors = dataclasses.replace(spec, paths=paths), np.ascontiguousarray(frames[..., :3])
    home = np.sort(rng.choice(len(frames), num, p=errors / errors.sum()))

    def density_of(k: int) -> np.ndarray:
        squares = _measure_squares(state.rows, window, times[k], *_make_target(frames, k, config), spec, config)
        smooth = cv2.GaussianBlur(squares.astype(np.float64), (0, 0), 1.0) + 1e-12
        return smooth / smooth.sum()

    position, _ = draw_positions(home, density_of, rng)
    opacity = SUMMED_OPACITY if config.compositing == "sum" else START_OPACITY
    shape = config.degree, envelope_of(config)
    splats, _ = make_splats(colors, home, position, times, *shape, motion, rng, opacity, paths)
    rows = pack(splats)
    alive = float(np.mean([((window[:, 0] < t) & (t < window[:, 1])).sum() for t in times]))  # in a frame
    size, at = frames.shape[1:3], columns(config.degree)["log_scale"]
    apart = math.sqrt(math.prod(size) / max(alive, 1.0)) / max(size)
    larger = 0.0 if paths is None else rows[:, at] + np.log(max(size))  # by the path's zoom
    rows[:, at] = np.log(SMALLER * SCALE_FACTOR * apart) + larger
    return rows


def _make_target(
    frames: UInt8[np.ndarray, "num_frames height width channels"], k: int, config: FitConfig
) -> tuple[Float32[np.ndarray, "3 height width"], Float[np.ndarray, "3"]]:
    """Frame k and the background: with alpha, a random color that is always the same for the frame."""
    background = random_background(config.seed, k) if frames.shape[3] == 4 else np.zeros(3, np.float32)
    return to_planes(frames[k], background), background


def _measure_squares(
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
