"""Relocation: the Gaussians that matter least to the frames move to where the errors are largest.

The number of Gaussians stays the same. Source: relocation of dead Gaussians in 3DGS-MCMC
(Kheradmand et al. 2024); the choice of Gaussians and their new parameters are ours.
"""

import numpy as np
import scipy
from jaxtyping import Float, Float32

from foldgauss.video.fitting.adam import BETA2
from foldgauss.video.fitting.births import make_newborns
from foldgauss.video.fitting.budget import measure_progress
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.schedule import steps_per_pass
from foldgauss.video.fitting.state import FitState, frame_times
from foldgauss.video.models.conditioning import ConditioningSpec, find_windows
from foldgauss.video.models.row_layout import columns
from foldgauss.video.motion.optical_flow import Motion

#: The fractions of the plan after which Gaussians are relocated.
RELOCATED_AT = (0.2, 0.35, 0.5)
#: Gaussians with fewer steps than this are not judged yet.
_MIN_COUNT = 5


def relocates(config: FitConfig) -> bool:
    """Whether a fit relocates Gaussians: densification adds Gaussians itself.

    Where Adam updates all Gaussians in every step, its moments do not tell which ones matter.
    """
    return config.relocated_fraction > 0 and config.growth is None and config.sparse_updates


def is_relocation_due(state: FitState, config: FitConfig) -> bool:
    """Whether Gaussians are to be relocated after the state's step: at `RELOCATED_AT`, after a pass at least."""
    if not relocates(config) or not state.plan:
        return False
    num_frames = len(state.frame_errors)
    before, after = (measure_progress(state, config, step) for step in (state.step - 1, state.step))
    crossed = any(before < fraction <= after for fraction in RELOCATED_AT)
    return crossed and state.step >= steps_per_pass(config, num_frames) and bool(state.frame_errors.any())


def relocate(
    state: FitState, frames: np.ndarray, config: FitConfig, spec: ConditioningSpec, motion: Motion | None
) -> None:
    """Move the fraction `config.relocated_fraction` of the Gaussians that can be judged; their moments start at zero.

    Frames and pixels of the new ones are drawn by squared error. `spec` is that of whole frames.
    """
    times = np.asarray(frame_times(state.time_logits))
    influence = measure_influence(state, find_windows(state.rows, spec), times, config.degree)
    num = round(config.relocated_fraction * np.isfinite(influence).sum())
    if num == 0:
        return
    stay = np.ones(len(state.rows), bool)
    stay[np.argsort(influence, kind="stable")[:num]] = False
    new = make_newborns(num, state, frames, state.frame_errors.astype(float), config, spec, motion)
    state.keep(np.flatnonzero(stay))
    at = columns(config.degree)["time_loc_logit"].start  # depth: among those of their time, which are in its order
    place = np.searchsorted(np.sort(state.rows[:, at]), new[:, at])
    order = np.argsort(np.concatenate([np.arange(len(state.rows)) + 0.5, place]), kind="stable")
    state.extend(new)
    state.keep(order)


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
