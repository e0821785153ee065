"""`Economy`: the settings of pruning, and the steps of a fit after which it prunes."""

import dataclasses
from dataclasses import field

import numpy as np
from jaxtyping import Int

from foldgauss._runtime.checks import invalid
from foldgauss._runtime.settings import check_settings, setting

#: A round of pruning costs as much as two passes over the frames: at most one in so many passes of the plan.
MIN_PASSES_PER_ROUND = 5


@dataclasses.dataclass(frozen=True)
class Economy:
    """Pruning by description length in `rounds` over the plan, evenly from `first_fraction` to `last_fraction`.

    * Without `psnr`: a Gaussian, a power of its fold, its m_t and sigma_t, its opacity, a color and a shape of its own
      are kept if they save more than `bits` for each of their parameters. (Compact files take 8 bits for a parameter on
      average.) With `grows`, Gaussians are born where errors are large, as long as half of them survive.
    * With `psnr`, dB: the Gaussians and parameters of least cost are dropped until the mean over all frames is that;
      where it seems out of reach, Gaussians are born.

    A round drops at most a fraction `most_dropped` of the Gaussians, so that the others can compensate. Short plans
    have fewer rounds. Raises ValueError for values out of range.
    """

    psnr: float | None = field(
        default=None,
        metadata=setting(
            "Fit the smallest model whose mean PSNR is this, in dB; takes up to half as many steps more than given",
            bounds="(0, 100]",
            option="--smallest-at-psnr",
            group="model",
        ),
    )
    bits: float = field(default=8.0, metadata=setting("Bits that a parameter must save", bounds="(0, inf)"))
    rounds: int = field(default=8, metadata=setting("Rounds of pruning", least=1))
    first_fraction: float = field(default=0.15, metadata=setting("First round, fraction of the plan", bounds="(0, 1)"))
    last_fraction: float = field(default=0.88, metadata=setting("Last round, fraction of the plan", bounds="(0, 1)"))
    most_dropped: float = field(
        default=0.3, metadata=setting("Largest fraction of the Gaussians that a round prunes", bounds="(0, 1]")
    )
    grows: bool = field(default=True, metadata=setting("Gaussians are also added where errors are largest"))

    def __post_init__(self) -> None:
        check_settings(self, "economy.")
        if self.first_fraction > self.last_fraction:
            got = f"{self.first_fraction:g} and {self.last_fraction:g}"
            raise invalid("economy.first_fraction, last_fraction", expected="in this order", got=got)

    def steps(self, plan: int, *, passes: float, coarse: float) -> Int[np.ndarray, "rounds"]:
        """The steps of a plan after which there is a round; a fraction `coarse` at its beginning is too early.

        The `plan` steps are `passes` over the frames. A plan too short for all rounds has fewer.
        """
        first = max(self.first_fraction, min(coarse + 0.05, self.last_fraction))
        num = max(min(self.rounds, int(passes / MIN_PASSES_PER_ROUND)), 1)
        fractions = np.linspace(first, self.last_fraction, num) if num > 1 else np.array([self.last_fraction])
        return np.clip(np.rint(fractions * plan), 1, plan).astype(int)
