"""Relocation: the Gaussians that matter least to the frames move to where the errors are largest.

The number of Gaussians stays the same. Source: relocation of dead Gaussians in 3DGS-MCMC
(Kheradmand et al. 2024); the choice of Gaussians and their new parameters are ours.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import scipy
from jaxtyping import Float, Float32, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.render import cpu
from foldgauss.video.fitting.adam import BETA2
from foldgauss.video.fitting.budget import measure_progress
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.density_control import DensityControl
from foldgauss.video.fitting.initialize import (
    SCALE_FACTOR,
    START_OPACITY,
    SUMMED_OPACITY,
    draw_positions,
    make_splats,
)
from foldgauss.video.fitting.schedule import steps_per_pass, to_planes
from foldgauss.video.fitting.state import FitState, envelope_of, frame_times, paths_of, spec_of
from foldgauss.video.models.background import random_background
from foldgauss.video.models.conditioning import condition, find_windows
from foldgauss.video.models.row_layout import columns, pack
from foldgauss.video.motion.optical_flow import Motion

#: The size of newborns relative to that of evenly spread Gaussians: errors have finer detail than the present image.
SMALLER = 0.6
#: The fractions of the plan after which Gaussians are relocated.
RELOCATED_AT = (0.2, 0.35, 0.5)
#: Fewer are not relocated: where there are few Gaussians, estimates of what each adds are too noisy.
_LEAST_RELOCATED = 10
#: Gaussians with fewer steps than this are not judged yet.
_MIN_COUNT = 5


def relocates(config: FitConfig) -> bool:
    """Whether a fit relocates Gaussians: densification adds Gaussians itself.

    Where Adam updates all Gaussians in every step, its moments do not tell which ones matter.
    """
    strategy = config.strategy
    return strategy.relocated_fraction > 0 and strategy.growth is None and strategy.sparse_updates


class Relocation(DensityControl):
    """Relocation at the fractions `RELOCATED_AT` of the plan, after a pass at least, in fits that have not diverged."""

    def __init__(self, frames: np.ndarray, config: FitConfig, find_motion: Callable[[], Motion | None]):
        self.frames, self.config, self.find_motion = frames, config, find_motion

    def is_due(self, state: FitState) -> bool:
        if not state.plan:
            return False
        before, after = (measure_progress(state, self.config, step) for step in (state.step - 1, state.step))
        return any(before < part <= after for part in RELOCATED_AT) and errors_are_known(state, self.config)

    def apply(self, state: FitState) -> None:
        relocate(state, self.frames, self.config, self.find_motion())


def errors_are_known(state: FitState, config: FitConfig) -> bool:
    """Whether all frames were seen, by a fit that has not diverged."""
    return (
        state.step >= steps_per_pass(config, len(state.frame_errors))
        and bool(state.frame_errors.any())
        and not state.backoffs
        and state.is_finite("rows")
        and state.is_finite("second")
    )


def relocate(state: FitState, frames: np.ndarray, config: FitConfig, motion: Motion | None) -> None:
    """Move the fraction `relocated_fraction` of the Gaussians that can be judged."""
    times, window = frame_times(state.time_logits), find_windows(state.rows, spec_of(config, frames.shape[1:3]))
    influence = measure_influence(state, window, np.asarray(times), config.fold_degree)
    num = round(config.strategy.relocated_fraction * np.isfinite(influence).sum())
    if num >= _LEAST_RELOCATED:
        add(num, state, frames, config, motion, instead_of=np.argsort(influence, kind="stable")[:num])


def add(
    num: int,
    state: FitState,
    frames: np.ndarray,
    config: FitConfig,
    motion: Motion | None,
    instead_of: Sequence[int] = (),
) -> None:
    """Add `num` Gaussians whose frames and pixels are drawn by squared error. Their moments start at zero.

    `instead_of`: indices of Gaussians that are removed.
    """
    new = make_newborns(num, state, frames, config, motion)
    state.keep(np.delete(np.arange(state.num_gaussians), instead_of))
    at = columns(config.fold_degree)["time_loc_logit"].start  # depth: among those of their time, which are in its order
    place = np.searchsorted(np.sort(state.rows[:, at]), new[:, at])
    order = np.argsort(np.concatenate([np.arange(len(state.rows)) + 0.5, place]), kind="stable")
    state.extend(new)
    state.keep(order)
    # A newborn is in the chunk of the one behind it: chunks stay together. They differ only where a long step is taken.
    state.chunks = np.maximum.accumulate(state.chunks[::-1])[::-1]


def measure_influence(
    state: FitState, window: Float32[np.ndarray, "num 2"], times: Float[np.ndarray, " num_frames"], degree: int
) -> Float[np.ndarray, " num"]:
    """How much the frames depend on each Gaussian, up to a common factor; infinite where that is not known.

    Adam's second moment of the opacity is the mean square of dL/do over the frames where the Gaussian is alive. The
    signs of the errors in it are about random, so o^2 times it estimates what the Gaussian adds to a frame, without
    another pass over the frames. Gaussians with few steps are not judged; those alive in no frame have none.
    """
    at = columns(degree)["opacity_logit"].start
    opacity = scipy.special.expit(state.rows[:, at].astype(float))
    square = state.second[:, at] / np.maximum(1 - BETA2 ** state.counts.astype(float), np.finfo(float).tiny)
    life = np.searchsorted(times, window[:, 1]) - np.searchsorted(times, window[:, 0])
    influence = life * square / np.maximum(1 - opacity, 1e-6) ** 2  # dL/do = dL/dlogit / (o (1 - o))
    influence[(state.counts < _MIN_COUNT) & (life > 0)] = np.inf
    return influence


def make_newborns(
    num: int,
    state: FitState,
    frames: UInt8[np.ndarray, "num_frames height width channels"],
    config: FitConfig,
    motion: Motion | None,
) -> Float32[np.ndarray, "num width"]:
    """Packed rows of `num` Gaussians, at frames and positions drawn by squared error, with the colors of the clip."""
    rng = make_generator(Stream.BIRTH, state.step, seed=config.seed)
    times, paths, spec = np.asarray(frame_times(state.time_logits)), paths_of(state), spec_of(config, frames.shape[1:3])
    window, errors = find_windows(state.rows, spec), state.frame_errors.astype(float)
    spec, colors = dataclasses.replace(spec, paths=paths), np.ascontiguousarray(frames[..., :3])
    home = np.sort(rng.choice(len(frames), num, p=errors / errors.sum()))
    seen = frames[..., 3] > 0 if frames.shape[3] == 4 else np.ones(frames.shape[:3], bool)

    def density_of(k: int) -> np.ndarray:
        # With alpha over a random color, always the same for the frame.
        background = random_background(config.seed, k) if frames.shape[3] == 4 else np.zeros(3, np.float32)
        done = condition(state.rows, window, times[k], spec)
        leaves = done.mean, done.factor, done.opacity, done.color, background
        image = cpu.forward(*leaves, spec.size, compositing=config.compositing, options=config.options).image
        squares = ((image - to_planes(frames[k], background)) ** 2).sum(0)
        smooth = (cv2.GaussianBlur(squares.astype(np.float64), (0, 0), 1.0) + 1e-12) * np.maximum(seen[k], 1e-9)
        return smooth / smooth.sum()

    position, _ = draw_positions(home, density_of, rng)
    opacity = SUMMED_OPACITY if config.compositing == "sum" else START_OPACITY
    shape = config.fold_degree, envelope_of(config)
    splats, _ = make_splats(colors, home, position, times, *shape, motion, rng, opacity, paths)
    rows = pack(splats)
    alive = float(np.mean([((window[:, 0] < t) & (t < window[:, 1])).sum() for t in times]))  # in a frame
    size, at = frames.shape[1:3], columns(config.fold_degree)["log_scale"]
    apart = math.sqrt(math.prod(size) * max(seen.mean(), 1e-9) / max(alive, 1.0)) / max(size)
    larger = 0.0 if paths is None else rows[:, at] + np.log(max(size))  # by the path's zoom
    rows[:, at] = np.log(SMALLER * SCALE_FACTOR * apart) + larger
    return rows
