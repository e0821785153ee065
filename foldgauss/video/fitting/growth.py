"""`Growth`: the settings and the schedule of adaptive densification, and the gradient statistics it is based on."""

import dataclasses
import math
from dataclasses import field
from typing import NamedTuple

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss._runtime.settings import check_settings, setting
from foldgauss.render.camera import FIELD_OF_VIEW

#: One unit of the published geometry in ours: there the image's half width is tan(FIELD_OF_VIEW / 2), here the longer
#: side, which is taken for the width, is 1.
PUBLISHED_UNIT = 1 / (2 * math.tan(FIELD_OF_VIEW / 2))
#: What the published code calls the scene's extent, 1.1 of its units.
EXTENT = 1.1 * PUBLISHED_UNIT
#: Steps of the published fit, which the steps of the schedule are meant for.
PUBLISHED_STEPS = 30_000
#: In plans however short, gradients are averaged over at least so many steps.
MIN_EVERY = 10
#: In plans however short, opacities have so many steps to recover between resets: at the published rate, 0.025 a step,
#: the logit of 0.01 needs 184 steps to that of 0.5.
MIN_RESET_EVERY = 200


@dataclasses.dataclass(frozen=True)
class Growth:
    """When Gaussians are cloned, split, pruned and reset. For a fit of `PUBLISHED_STEPS`, see `for_plan`.

    After `from_step` and before `until_step`, on every `every`-th step: a Gaussian whose mean screen gradient reaches
    its threshold is cloned if small and split in two if not; one whose mean time gradient does, is cloned if its
    sigma_t is at most `clone_below_time` and split if not. Then Gaussians that are faint or too big are pruned. Every
    `reset_every` steps, opacities above `reset_opacity` fall to it.

    * The screen gradient is |dL/dmean| in units of half the image's width and height, the largest of a step's
      batch; the time gradient is |dL/dm_t| by the raw m_t, before its sigmoid. L is the mean over the batch: with it
      the paper's own numbers of Gaussians fall as 1 / batch (table "Ablation study": 1.72, 0.62, 0.31 million for
      batches of 1, 3, 5). Means are over the steps in which a Gaussian was seen.
    * Lengths are in model space, where the frame's longer side is 1.

    Sources: Kerbl et al. 2023, section 5.2 and its published constants; VeGaS, "Implementation Details" and its
    published constants. Raises ValueError for values out of range.
    """

    from_step: int = field(default=500, metadata=setting("First step of densification"))
    until_step: int = field(default=15_000, metadata=setting("Last step of densification"))
    every: int = field(default=100, metadata=setting("Steps between densifications", least=1))
    screen_gradient: float = field(default=2e-4, metadata=setting("Screen gradient that densifies", bounds="(0, inf)"))
    time_gradient: float = field(
        default=2e-4,
        metadata=setting(
            "Time gradient that densifies",
            "The published code has one threshold for both. Few Gaussians pass by time alone: their median time "
            "gradient is a quarter of their screen gradient.",
            bounds="(0, inf)",
        ),
    )
    clone_below: float = field(
        default=0.01 * EXTENT, metadata=setting("Larger standard deviation up to which to clone", bounds="(0, inf)")
    )
    clone_below_time: float = field(
        default=1.0,
        metadata=setting("sigma_t up to which the time gradient clones, in durations of the clip", bounds="(0, inf)"),
    )
    shrinking: float = field(default=1.6, metadata=setting("Factor by which halves are smaller", bounds="[1, inf)"))
    prune_opacity: float = field(default=0.01, metadata=setting("Least opacity; 3DGS has 0.005", bounds="(0, 1)"))
    big_from: int = field(default=3000, metadata=setting("Step from which on big Gaussians are pruned"))
    prune_radius: float | None = field(
        default=None,
        metadata=setting(
            "Largest radius in pixels: 3 standard deviations at the Gaussian's own time",
            "3DGS states 20, but its code never applies it, as its authors say (issues 123 and 643 of its repository). "
            "Applied, it prunes what covers smooth areas, and the fit fails (`benchmarks.reproduce`).",
            bounds="(0, inf)",
            unset="no limit",
        ),
    )
    prune_scale: float = field(default=0.1 * EXTENT, metadata=setting("Largest standard deviation", bounds="(0, inf)"))
    reset_every: int = field(default=3000, metadata=setting("Steps between resets of opacity", least=1))
    reset_opacity: float = field(default=0.01, metadata=setting("Opacity after a reset", bounds="(0, 1)"))

    def __post_init__(self) -> None:
        check_settings(self, "strategy.growth.")
        require(
            self.reset_opacity >= self.prune_opacity,
            "strategy.growth.reset_opacity",
            expected=f"at least prune_opacity, {self.prune_opacity:g}",
            got=self.reset_opacity,
            cure="Otherwise a reset would prune every Gaussian.",
        )

    def for_plan(self, plan: int) -> "Growth":
        """The schedule of a fit of `plan` steps: all steps scaled by plan / `PUBLISHED_STEPS`.

        Densification is at least `MIN_EVERY` steps apart, resets at least `MIN_RESET_EVERY`, at steps of densification.
        """
        if plan == PUBLISHED_STEPS:
            return self
        scale = plan / PUBLISHED_STEPS
        every = max(MIN_EVERY, round(self.every * scale))
        apart = max(MIN_RESET_EVERY, self.reset_every * scale)
        scaled = {name: round(getattr(self, name) * scale) for name in ("from_step", "until_step", "big_from")}
        return dataclasses.replace(self, **scaled, every=every, reset_every=every * math.ceil(apart / every))

    def grows_at(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after this step (steps count from 1)."""
        return self.from_step < step < self.until_step and step % self.every == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities are reset after this step."""
        return step < self.until_step and step % self.reset_every == 0


class GradientStatistics(NamedTuple):
    """Sums over the steps since the last densification; (num,) each."""

    screen: np.ndarray  #: float32: of screen gradients
    time: np.ndarray  #: float32: of time gradients
    seen: np.ndarray  #: int32: steps in which the Gaussian was seen

    def add(self, screen: np.ndarray, by_time: np.ndarray) -> None:
        """Add a step: the largest screen gradient over its views, and dL/dm_t by the raw m_t over all; (num,) each.

        `screen` is negative for Gaussians that no view shows.
        """
        shown = screen >= 0
        np.add(self.screen, screen, out=self.screen, where=shown)
        np.add(self.time, np.abs(by_time), out=self.time, where=shown)
        np.add(self.seen, 1, out=self.seen, where=shown)
