"""Births, deaths and resets between the steps of a fit, on the arrays of its state: what `growth` decides is done."""

import numpy as np

from foldgauss.render import pixels_per_unit
from foldgauss.video.fitting.codebook import Codebook
from foldgauss.video.fitting.config import FitConfig, most_gaussians
from foldgauss.video.fitting.growth import GradientStatistics, Growth, dim, grown
from foldgauss.video.fitting.state import FitState
from foldgauss.video.models.sparse_storage import find_kinds


def changes_at(growth: Growth, step: int) -> bool:
    """Whether any row is born, dropped or dimmed after this step of a plan that `growth` is scaled to."""
    return growth.grows_at(step) or growth.resets_at(step)


def grow(state: FitState, config: FitConfig, size: tuple[int, int]) -> bool:
    """Births, deaths and resets that are due now that the plan is known; after the last, statistics end.

    `size`: (height, width) of the frames. Returns whether there are other Gaussians now.
    """
    growth = config.growth.for_plan(state.plan)
    grows = growth.grows_at(state.step)
    if grows:
        _replace(state, config, growth, size)
    if growth.resets_at(state.step):
        dim(state.rows, state.first, state.second, growth, config.degree)
    if state.step + 1 >= growth.until_step:
        state.statistics = None
    return grows


def _replace(state: FitState, config: FitConfig, growth: Growth, size: tuple[int, int]) -> None:
    """Births and deaths: moments of those that stay are theirs, those of the new ones are zero."""
    stay, born = grown(
        state.rows,
        state.statistics,
        growth,
        degree=config.degree,
        pixels=pixels_per_unit(size),
        most=most_gaussians(config, len(state.frame_errors)),
        step=state.step,
        seed=config.seed,
    )
    state.rows = np.concatenate([state.rows[stay], born])
    state.first, state.second = (
        np.concatenate([part[stay], np.zeros_like(born)]) for part in (state.first, state.second)
    )
    state.counts = np.concatenate([state.counts[stay], np.zeros(len(born), np.int32)])
    state.kinds = np.concatenate([state.kinds[stay], find_kinds(born, config.degree)])
    state.young = np.concatenate([state.young[stay], np.zeros(len(born), bool)])
    state.colors, state.shapes = Codebook.of(None, 3), Codebook.of(None, 2)  # those born have their own
    state.statistics = GradientStatistics.zeros(len(state.rows))
