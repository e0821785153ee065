"""Growth as in 3D Gaussian Splatting: Gaussians are cloned, split and pruned as their gradients ask, and dimmed.

VeGaS takes this schedule over (Kerbl et al. 2023, section 5.2) and adds a criterion of its own, the gradient of m_t.
Nothing here draws at random but the places of split halves, by a seed and the step's number: a fit that was stopped
goes on to the same bits.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from foldgauss._runtime.checks import invalid, is_integer, is_within
from foldgauss.render.camera import FIELD_OF_VIEW
from foldgauss.video.models.row_layout import columns

#: One unit of the published geometry in ours: there a picture's half width is tan(FIELD_OF_VIEW / 2), here the longer
#: side, which is taken for the width, is 1.
PUBLISHED_UNIT = 1 / (2 * math.tan(FIELD_OF_VIEW / 2))
#: What the published code calls the scene's extent, 1.1 of its units.
EXTENT = 1.1 * PUBLISHED_UNIT
#: Steps of the published fit, which the steps of the schedule are meant for.
PUBLISHED_STEPS = 30_000
#: However short the plan, means are taken over so many steps; and after a reset there is time to come back: at the
#: published rate, 0.025 a step, the logit of 0.01 needs 184 steps to that of 0.5.
LEAST_EVERY, LEAST_RESET = 10, 200
#: The published code draws, and so measures, a splat within this many standard deviations.
RADIUS = 3.0


@dataclasses.dataclass(frozen=True)
class Growth:
    """When Gaussians are born and die. Steps are those of a fit of `PUBLISHED_STEPS`; `for_plan` scales them.

    After `from_step` and before `until_step`, on every `every`-th step: where the mean screen gradient or the mean time
    gradient of a Gaussian reaches its threshold, it is cloned if small and split in two if not; then those that are
    faint or too big are pruned. Every `reset_every` steps, opacities above `reset_opacity` fall to it.

    * The screen gradient is |dL/dmean| in units of half the picture's width and height, the largest of a step's
      batch; the time gradient is |dL/dm_t| by the raw m_t, before its sigmoid. L is the mean over the batch: with it
      the paper's own numbers of Gaussians fall as 1 / batch (table "Ablation study": 1.72, 0.62, 0.31 million for
      batches of 1, 3, 5). Means are over the steps in which a Gaussian was seen.
    * Lengths are in model space, where the frame's longer side is 1.

    Sources: Kerbl et al. 2023, section 5.2 and its published constants; VeGaS, "Implementation Details" and its
    published constants. Raises ValueError for numbers out of range.
    """

    from_step: int = 500  #: 3DGS
    until_step: int = 15_000  #: 3DGS
    every: int = 100  #: 3DGS
    screen_gradient: float = 2e-4  #: 3DGS
    #: VeGaS; its value is not in the paper. The screen's own is the plainest reading of "by either". Few Gaussians
    #: then pass by time alone: the median time gradient is a quarter of the median screen gradient (Bunny, 80x160).
    time_gradient: float = 2e-4
    clone_below: float = 0.01 * EXTENT  #: the larger standard deviation; 3DGS
    shrinking: float = 1.6  #: halves of a split are smaller by this; 3DGS
    prune_opacity: float = 0.01  #: VeGaS; 3DGS has 0.005
    big_from: int = 3000  #: after this step the big are pruned, too: 3DGS
    #: In pixels, 3 standard deviations at a Gaussian's own time, where it is largest: 3DGS.
    prune_radius: float = 20.0
    prune_scale: float = 0.1 * EXTENT  #: the larger standard deviation; 3DGS
    reset_every: int = 3000  #: 3DGS
    reset_opacity: float = 0.01  #: 3DGS

    def __post_init__(self) -> None:
        for name, least in {"from_step": 0, "until_step": 0, "every": 1, "big_from": 0, "reset_every": 1}.items():
            value = getattr(self, name)
            if not is_integer(value, least):
                raise invalid(f"growth.{name}", expected=f"a whole number >= {least}", got=repr(value))
            object.__setattr__(self, name, int(value))
        ranges = dict.fromkeys(
            ("screen_gradient", "time_gradient", "clone_below", "prune_radius", "prune_scale"), "(0, inf)"
        )
        ranges |= {"shrinking": "[1, inf)", "prune_opacity": "(0, 1)", "reset_opacity": "(0, 1)"}
        for name, bounds in ranges.items():
            value = getattr(self, name)
            if not is_within(value, bounds):
                raise invalid(f"growth.{name}", expected=f"a number in {bounds}", got=repr(value))
            object.__setattr__(self, name, float(value))
        if self.reset_opacity < self.prune_opacity:
            raise invalid(
                "growth.reset_opacity",
                expected=f"at least prune_opacity, {self.prune_opacity:g}",
                got=self.reset_opacity,
                cure="Else a reset is the end of every Gaussian.",
            )

    def for_plan(self, plan: int) -> "Growth":
        """The schedule of a fit of `plan` steps: all its steps scaled by plan / `PUBLISHED_STEPS`.

        Births stand no closer than `LEAST_EVERY` steps, resets than `LEAST_RESET`, and on steps of births as before.
        """
        if plan == PUBLISHED_STEPS:
            return self
        share = plan / PUBLISHED_STEPS
        every = max(LEAST_EVERY, round(self.every * share))
        apart = max(LEAST_RESET, self.reset_every * share)
        scaled = {name: round(getattr(self, name) * share) for name in ("from_step", "until_step", "big_from")}
        return dataclasses.replace(self, **scaled, every=every, reset_every=every * math.ceil(apart / every))

    def grows_at(self, step: int) -> bool:
        """Whether Gaussians are born and pruned after this step (steps count from 1)."""
        return self.from_step < step < self.until_step and step % self.every == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities fall after this step."""
        return step < self.until_step and step % self.reset_every == 0


class GradientStatistics(NamedTuple):
    """Sums of the steps since the last births; (num,) each."""

    screen: np.ndarray  #: float32: of screen gradients
    time: np.ndarray  #: float32: of time gradients
    seen: np.ndarray  #: int32: steps in which the Gaussian was seen

    @classmethod
    def zeros(cls, num: int) -> "GradientStatistics":
        return cls(np.zeros(num, np.float32), np.zeros(num, np.float32), np.zeros(num, np.int32))

    def add(self, views: Sequence[tuple[np.ndarray, np.ndarray]], by_time: np.ndarray) -> None:
        """Count a step in: for each of its views the Gaussians seen there (each once) and their screen gradients.

        `by_time` (num,) is dL/dm_t by the raw m_t, over all views.
        """
        largest = np.full(len(self.screen), -1, np.float32)
        for indices, screen in views:
            largest[indices] = np.maximum(largest[indices], screen)
        seen = np.flatnonzero(largest >= 0)
        self.screen[seen] += largest[seen]
        self.time[seen] += np.abs(by_time[seen])
        self.seen[seen] += 1


def grown(
    rows: np.ndarray,
    statistics: GradientStatistics,
    growth: Growth,
    *,
    degree: int,
    pixels: float,
    most: int,
    step: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """What births and pruning after `step` leave: indices of the rows that stay, in order, and the new rows.

    `rows` is float32 (num, width), see `packing`; `pixels` a picture's pixels along one unit of model space. Never more
    than `most` rows are left by births: where there is no room for all, those go first whose gradients exceed their
    thresholds by most. At least one row is left. New rows belong at the array's end: behind all others.
    Source: Kerbl et al. 2023, section 5.2.
    """
    place, num = columns(degree), len(rows)
    chosen = _restless(statistics, growth, most - num)
    small = np.exp(rows[chosen, place["log_scale"]].max(axis=1)) <= growth.clone_below
    clones, parents = rows[chosen[small]], chosen[~small]
    rng = np.random.default_rng([seed, 2, step])
    halves = [_half(rows[parents], rng, growth.shrinking, place) for _ in range(2)]
    stays = np.ones(num, bool)
    stays[parents] = False
    born = np.concatenate([clones, *halves])
    fit_old, fit_born = (_fit_to_live(part, growth, place, pixels, step) for part in (rows, born))
    stays &= fit_old
    if not (stays.any() or fit_born.any()):
        stays[np.argmax(rows[:, place["opacity_logit"]])] = True
    return np.flatnonzero(stays), born[fit_born]


def dim(rows: np.ndarray, first: np.ndarray, second: np.ndarray, growth: Growth, degree: int) -> None:
    """Let opacities fall to `reset_opacity`, in place; Adam's moments `first` and `second` forget theirs."""
    place = columns(degree)["opacity_logit"]
    rows[:, place] = np.minimum(rows[:, place], _logit(growth.reset_opacity))
    first[:, place] = 0
    second[:, place] = 0


def _restless(statistics: GradientStatistics, growth: Growth, room: int) -> np.ndarray:
    """Indices, in order, of at most `room` Gaussians whose gradients reach a threshold."""
    steps = np.maximum(statistics.seen, 1).astype(np.float32)
    excess = np.maximum(
        statistics.screen / (steps * np.float32(growth.screen_gradient)),
        statistics.time / (steps * np.float32(growth.time_gradient)),
    )
    wanted = np.flatnonzero(excess >= 1)
    first = np.argsort(-excess[wanted], kind="stable")[: max(room, 0)]
    return np.sort(wanted[first])


def _half(parents: np.ndarray, rng: np.random.Generator, shrinking: float, place: dict[str, slice]) -> np.ndarray:
    """A smaller Gaussian for each parent, at a place drawn from it; all the rest is its parent's."""
    rows = parents.copy()
    along = np.exp(parents[:, place["log_scale"]]) * rng.standard_normal((len(parents), 2), np.float32)
    angle = np.float32(2 * np.pi) / (1 + np.exp(-parents[:, place["angle_logit"]][:, 0]))
    cos, sin = np.cos(angle), np.sin(angle)
    rows[:, place["loc"]] += np.stack([cos * along[:, 0] - sin * along[:, 1], sin * along[:, 0] + cos * along[:, 1]], 1)
    rows[:, place["log_scale"]] -= np.float32(np.log(shrinking))
    return rows


def _fit_to_live(rows: np.ndarray, growth: Growth, place: dict[str, slice], pixels: float, step: int) -> np.ndarray:
    """Which rows are neither too faint nor, late enough, too big."""
    lives = rows[:, place["opacity_logit"]][:, 0] >= _logit(growth.prune_opacity)
    if step > growth.big_from:
        widest = min(growth.prune_scale, growth.prune_radius / (RADIUS * pixels))
        lives &= rows[:, place["log_scale"]].max(axis=1) <= np.float32(np.log(widest))
    return lives


def _logit(p: float) -> np.float32:
    return np.float32(math.log(p) - math.log1p(-p))
