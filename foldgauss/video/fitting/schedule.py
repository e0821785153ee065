"""What each step of a fit uses: its views of the clip, and its learning rates."""

import math

import cv2
import numpy as np

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.models.row_layout import columns

#: Frames whose errors tell how good the start is.
NUM_START_FRAMES = 16
#: Learning rates are divided by this whenever a diverged fit backs off.
BACKOFF_FACTOR = 4.0
#: The factor on the learning rates when they have cooled down.
COLD = 0.02


# ------------------------------------------------------------------------------------------------------ views


def num_views(config: FitConfig, num_frames: int) -> int:
    """Views of a pass: every frame, then with two cameras every frame mirrored."""
    return 2 * num_frames if config.views.two_cameras else num_frames


def steps_per_pass(config: FitConfig, num_frames: int) -> int:
    """Steps in which every view is seen at least once."""
    return math.ceil(num_views(config, num_frames) / (config.views.batch_size * (1 - config.views.error_fraction)))


def count_passes(config: FitConfig, num_frames: int, steps: int) -> float:
    """The number of passes over the frames in `steps` steps."""
    return steps * config.views.batch_size / num_frames


def choose_views(config: FitConfig, num_frames: int, step: int, errors: np.ndarray) -> np.ndarray:
    """The views of a step: in turn, and in between by the `errors` of the frames, (num_frames,), 0 where unknown.

    View k is frame k; from the number of frames on, frame k - num_frames, mirrored. The fraction `error_fraction` of
    the views, evenly among the others, is drawn in proportion to the errors; frames without one count as average. The
    others pass through all views, in an order that depends on the seed and the pass only.
    """
    num, (views, drawn) = num_views(config, num_frames), find_views_in_turn(config, num_frames, step)
    if drawn.any():
        rng = make_generator(Stream.ERROR_WEIGHTED_FRAME, step, seed=config.seed)
        views[drawn] = rng.choice(num, drawn.sum(), p=_chances(errors, num))
    return views


def find_views_in_turn(config: FitConfig, num_frames: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    """The views of a step if none were drawn by error, and which are drawn (they are the next ones in turn here)."""
    num, in_turn = num_views(config, num_frames), 1 - config.views.error_fraction
    positions = np.arange(step * config.views.batch_size, (step + 1) * config.views.batch_size)
    taken = np.floor(positions * in_turn).astype(int)
    orders = (make_generator(Stream.FRAME_ORDER, k // num, seed=config.seed).permutation(num) for k in taken)
    views = np.array([order[k % num] for order, k in zip(orders, taken, strict=True)])
    return views, np.floor((positions + 1) * in_turn).astype(int) == taken


def _chances(errors: np.ndarray, num: int) -> np.ndarray:
    """Probabilities of the views, (num,), in proportion to the errors of their frames."""
    known = (errors > 0) & np.isfinite(errors)
    chances = np.where(known, errors, errors[known].mean() if known.any() else 1.0).astype(float)
    return np.tile(chances / chances.sum(), num // len(errors)) * len(errors) / num


def choose_start_frames(num_frames: int) -> np.ndarray:
    """The frames whose errors tell how good the start is: evenly spaced, from the first to the last."""
    return np.unique(np.linspace(0, num_frames - 1, NUM_START_FRAMES).round().astype(int))


# ------------------------------------------------------------------------------------------ learning rates


def learning_rates(config: FitConfig, progress: float, backoffs: int) -> tuple[np.ndarray, np.float32, np.float32]:
    """Adam's learning rates at a fraction of a plan, and after back-offs.

    They are those of rows by column, float32 (width,), of frame times, and of the maps of shared paths.
    """
    rates, slower = config.rates, BACKOFF_FACTOR**-backoffs
    decay = rates.final**progress if rates.final > 0 else 1 - progress
    if 1 - progress < rates.cooldown:
        decay *= COLD + (1 - COLD) * ((1 - progress) / rates.cooldown)
    rows = np.empty(columns(config.fold_degree)["coefficients"].stop, np.float32)
    for name, place in columns(config.fold_degree).items():
        factor = np.float32(decay if rates.decayed in ("all", name) else 1.0)
        rows[place] = np.float32(getattr(rates, name)) * factor * np.float32(slower)
    times = rates.frame_times * (decay if rates.decayed == "all" else 1.0) * slower
    return rows, np.float32(times), np.float32(rates.paths * decay * slower)


# ------------------------------------------------------------------------------------------------- targets


def to_planes(frame: np.ndarray, background: np.ndarray) -> np.ndarray:
    """A frame of bytes as float planes (3, height, width), as the kernels take it; with alpha, over `background`."""
    out = np.empty((3, *frame.shape[:2]), np.float32)
    *colors, last = cv2.split(frame)
    for plane, own in zip(out, colors if frame.shape[2] == 4 else (*colors, last), strict=True):
        np.multiply(own, np.float32(1 / 255), out=plane)
    if frame.shape[2] == 4:
        out += background[:, None, None] * (1 - last * np.float32(1 / 255))
    return out
