"""Relocation: the Gaussians that matter least to the frames move to where the errors are largest.

The number of Gaussians, and so the size of the model, stays the same. Source: relocation of dead Gaussians in 3DGS-MCMC
(Kheradmand et al. 2024); the choice of Gaussians and their new parameters are ours.
"""

import numpy as np
import scipy
from jaxtyping import Float, Float32

from foldgauss.video.fitting.adam import BETA2
from foldgauss.video.fitting.budget import measure_progress
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.initialize import START_OPACITY, SUMMED_OPACITY
from foldgauss.video.fitting.optical_flow import Motion
from foldgauss.video.fitting.pruning.births import make_newborns, make_target, measure_squares
from foldgauss.video.fitting.state import FitState, envelope_of, frame_times
from foldgauss.video.models.conditioning import ConditioningSpec, update_windows
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.sparse_storage import find_initial_kinds, is_opaque, is_static

#: The fractions of the plan after which Gaussians are relocated.
RELOCATED_AT = (0.2, 0.35, 0.5)
#: Gaussians with fewer steps than this are not judged yet.
_MIN_COUNT = 5


def is_relocation_due(state: FitState, config: FitConfig) -> bool:
    """Whether Gaussians are to be relocated after the state's step."""
    if config.relocated_fraction == 0 or config.growth is not None or config.economy is not None or not state.plan:
        return False
    before, after = (measure_progress(state, config, step) for step in (state.step - 1, state.step))
    return any(before < fraction <= after for fraction in RELOCATED_AT) and bool((state.frame_errors > 0).all())


def relocate(
    state: FitState, frames: np.ndarray, config: FitConfig, spec: ConditioningSpec, motion: Motion | None
) -> None:
    """Move the fraction `config.relocated_fraction` of the Gaussians, in place; their moments start at zero.

    Frames and pixels of the new ones are drawn by squared error. In depth they lie among those of their time. Some are
    static where some Gaussians are already. `spec` is that of whole frames.
    """
    num, times = round(config.relocated_fraction * state.num_gaussians), np.asarray(frame_times(state.time_logits))
    window = np.empty((len(state.rows), 2), np.float32)
    update_windows(state.rows, np.arange(len(state.rows)), window)
    influence = measure_influence(state, window, times, config.degree)
    out = np.argsort(influence, kind="stable")[:num]
    out = out[np.isfinite(influence[out])]
    if not len(out):
        return
    rows = state.rows
    alive = [((window[:, 0] < t) & (t < window[:, 1])).sum() for t in times]
    new = make_newborns(
        len(out),
        np.ascontiguousarray(frames[..., :3]),
        times,
        state.frame_errors.astype(float),
        lambda k: measure_squares(rows, window, times[k], *make_target(frames, k, config), spec, config),
        float(np.mean(alive)),
        degree=config.degree,
        envelope=envelope_of(config),
        motion=motion,
        opacity=SUMMED_OPACITY if config.compositing == "sum" else START_OPACITY,
        with_static=bool(is_static(state.kinds).any()),
        seed=(config.seed, 3, state.step),
    )
    stay = np.ones(len(rows), bool)
    stay[out] = False
    at = columns(config.degree)["time_loc_logit"].start
    place = np.searchsorted(np.sort(rows[stay, at]), new[:, at])  # Gaussians are in order of time
    order = np.argsort(np.concatenate([np.arange(stay.sum()) + 0.5, place]), kind="stable")
    state.keep(np.flatnonzero(stay))
    state.extend(new, find_initial_kinds(new, config.degree))
    state.keep(order)


def measure_influence(
    state: FitState, window: Float32[np.ndarray, "num 2"], times: Float[np.ndarray, " num_frames"], degree: int
) -> Float[np.ndarray, " num"]:
    """How much the frames depend on each Gaussian, up to a common factor; infinite for those that must stay.

    Adam's second moment of the opacity is the mean square of dL/do over the frames where the Gaussian is alive. The
    signs of the errors in it are about random, so o^2 times it estimates what the Gaussian adds to a frame, as
    `PruningScores.second_order` does, for no work at all.
    """
    at = columns(degree)["opacity_logit"].start
    opacity = scipy.special.expit(state.rows[:, at].astype(float))
    square = state.second[:, at] / np.maximum(1 - BETA2 ** state.counts.astype(float), np.finfo(float).tiny)
    life = np.searchsorted(times, window[:, 1]) - np.searchsorted(times, window[:, 0])
    influence = life * square / np.maximum(1 - opacity, 1e-6) ** 2  # dL/do = dL/dlogit / (o (1 - o))
    influence[(state.counts < _MIN_COUNT) | is_opaque(state.kinds)] = np.inf
    return influence
