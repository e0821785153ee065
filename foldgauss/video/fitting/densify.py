"""Densification as in 3D Gaussian Splatting: Gaussians are cloned, split, pruned and reset, by their gradients.

VeGaS takes this over (Kerbl et al. 2023, section 5.2) and adds a criterion of its own, the gradient of m_t. Only the
positions of split halves are random, drawn by the seed and the step, so a resumed fit continues to the same bits.
"""

import math

import numpy as np

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.render import pixels_per_unit
from foldgauss.video.fitting.config import FitConfig, Growth, most_gaussians
from foldgauss.video.fitting.density_control import DensityControl
from foldgauss.video.fitting.state import FitState, GradientStatistics
from foldgauss.video.models.row_layout import columns

#: The published code renders, and so measures, a splat within this many standard deviations.
_RADIUS = 3.0


class Densification(DensityControl):
    """Densification, pruning and resets by the schedule of `Growth`, for frames of `size` (height, width)."""

    def __init__(self, config: FitConfig, size: tuple[int, int]):
        self.config, self.size = config, size

    def is_due(self, state: FitState) -> bool:
        if not (state.growing and state.plan):
            return False
        growth = self.config.strategy.growth.for_plan(state.plan)
        return growth.grows_at(state.step) or growth.resets_at(state.step) or state.step + 1 >= growth.until_step

    def apply(self, state: FitState) -> None:
        """What is due at the state's step; after the last, statistics end."""
        config = self.config
        growth = config.strategy.growth.for_plan(state.plan)
        if growth.grows_at(state.step):
            stay, born = densify(
                state.rows,
                state.statistics,
                growth,
                degree=config.fold_degree,
                pixels=pixels_per_unit(self.size),
                max_num=most_gaussians(config),
                step=state.step,
                seed=config.seed,
            )
            state.keep(stay)
            state.extend(born)
        if growth.resets_at(state.step):
            reset_opacities(state.rows, state.first, state.second, growth, config.fold_degree)
        if state.step + 1 >= growth.until_step:
            state.growing = False
            state.restart_statistics()


def densify(
    rows: np.ndarray,
    statistics: GradientStatistics,
    growth: Growth,
    *,
    degree: int,
    pixels: float,
    max_num: int,
    step: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The result of densification and pruning after `step`: indices of the rows that stay, in order, and the new rows.

    `rows` is float32 (num, width), see `row_layout`; `pixels` is the number of pixels along one unit of model space.
    Births do not exceed `max_num` rows: where there is no room for all, those come first whose gradients exceed their
    thresholds by most. At least one row stays. New rows belong at the end of the array: behind all others.
    Source: Kerbl et al. 2023, section 5.2.
    """
    place, num = columns(degree), len(rows)
    cloned, parents = _choose_parents(rows, statistics, growth, place, max_num - num)
    clones = rows[cloned]
    rng = make_generator(Stream.SPLIT, step, seed=seed)
    halves = [_draw_half(rows[parents], rng, growth.shrinking, place) for _ in range(2)]
    stays = np.ones(num, bool)
    stays[parents] = False
    born = np.concatenate([clones, *halves])
    good, good_born = (_survives(part, growth, place, pixels, step) for part in (rows, born))
    stays &= good
    if not (stays.any() or good_born.any()):
        stays[np.argmax(rows[:, place["opacity_logit"]])] = True
    return np.flatnonzero(stays), born[good_born]


def reset_opacities(rows: np.ndarray, first: np.ndarray, second: np.ndarray, growth: Growth, degree: int) -> None:
    """Lower opacities to `reset_opacity`, in place; their moments `first` and `second` become zero."""
    place = columns(degree)["opacity_logit"]
    rows[:, place] = np.minimum(rows[:, place], _logit(growth.reset_opacity))
    first[:, place] = 0
    second[:, place] = 0


def _choose_parents(
    rows: np.ndarray, statistics: GradientStatistics, growth: Growth, place: dict[str, slice], max_births: int
) -> tuple[np.ndarray, np.ndarray]:
    """Indices, in order, of the Gaussians to be cloned and of those to be split, at most `max_births` together.

    Those come first whose mean gradients exceed their thresholds by most. One may be both, by either gradient.
    """
    small = np.exp(rows[:, place["log_scale"]].max(axis=1)) <= growth.clone_below
    brief = np.exp(rows[:, place["log_time_scale"]][:, 0]) <= growth.clone_below_time
    steps = np.maximum(statistics.seen, 1).astype(np.float32)
    screen = statistics.screen / (steps * np.float32(growth.screen_gradient))
    time = statistics.time / (steps * np.float32(growth.time_gradient))
    excess = np.concatenate([np.maximum(screen * one, time * two) for one, two in ((small, brief), (~small, ~brief))])
    wanted = np.flatnonzero(excess >= 1)
    first = np.sort(wanted[np.argsort(-excess[wanted], kind="stable")[: max(max_births, 0)]])
    return first[first < len(rows)], first[first >= len(rows)] - len(rows)


def _draw_half(parents: np.ndarray, rng: np.random.Generator, shrinking: float, place: dict[str, slice]) -> np.ndarray:
    """A smaller Gaussian for each parent, at a position drawn from it; all else is copied from the parent."""
    rows = parents.copy()
    along = np.exp(parents[:, place["log_scale"]]) * rng.standard_normal((len(parents), 2), np.float32)
    angle = np.float32(2 * np.pi) / (1 + np.exp(-parents[:, place["angle_logit"]][:, 0]))
    cos, sin = np.cos(angle), np.sin(angle)
    rows[:, place["loc"]] += np.stack([cos * along[:, 0] - sin * along[:, 1], sin * along[:, 0] + cos * along[:, 1]], 1)
    rows[:, place["log_scale"]] -= np.float32(np.log(shrinking))
    return rows


def _survives(rows: np.ndarray, growth: Growth, place: dict[str, slice], pixels: float, step: int) -> np.ndarray:
    """Which rows are neither too faint nor, after `big_from`, too big."""
    lives = rows[:, place["opacity_logit"]][:, 0] >= _logit(growth.prune_opacity)
    if step > growth.big_from:
        radius = math.inf if growth.prune_radius is None else growth.prune_radius
        widest = min(growth.prune_scale, radius / (_RADIUS * pixels))
        lives &= rows[:, place["log_scale"]].max(axis=1) <= np.float32(np.log(widest))
    return lives


def _logit(p: float) -> np.float32:
    return np.float32(math.log(p) - math.log1p(-p))
