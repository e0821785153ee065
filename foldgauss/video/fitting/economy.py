"""`Economy`: the settings of pruning, and the steps of a fit after which it prunes."""

import dataclasses

import numpy as np
from jaxtyping import Int

from foldgauss._runtime.checks import invalid, is_integer, is_within

#: A round of pruning costs as much as two passes over the frames: at most one in so many passes of the plan.
MIN_PASSES_PER_ROUND = 5


@dataclasses.dataclass(frozen=True)
class Economy:
    """Pruning by description length at `rounds` points of the plan, evenly from `first_fraction` to `last_fraction`.

    * Without `psnr`: a Gaussian, a power of its path, a beginning and an end of its life, its opacity, a colour and a
      shape of its own stay if they save more than `bits` for each of their numbers. (Compact files hold a number in
      8 bits on the average.)
      With `grows`, a `BIRTHS` share of Gaussians are born where the error is, as long as half of them stay.
    * With `psnr`, dB: what is dropped is what costs the least, until the mean over all frames is that; where it seems
      out of reach, Gaussians are born.

    A round drops at most a share `most_dropped` of the Gaussians: then the others take over what is missed. Short plans
    have fewer rounds.
    Raises ValueError for numbers out of range.
    """

    psnr: float | None = None
    bits: float = 8.0
    rounds: int = 8
    first_fraction: float = 0.15
    last_fraction: float = 0.88
    most_dropped: float = 0.3
    grows: bool = True

    def __post_init__(self) -> None:
        bounds = {"bits": "(0, inf)", "first_fraction": "(0, 1)", "last_fraction": "(0, 1)", "most_dropped": "(0, 1]"}
        if self.psnr is not None:
            bounds["psnr"] = "(0, 100]"
        for name, interval in bounds.items():
            if not is_within(getattr(self, name), interval):
                raise invalid(f"economy.{name}", expected=f"a number in {interval}", got=repr(getattr(self, name)))
            object.__setattr__(self, name, float(getattr(self, name)))
        if not is_integer(self.rounds, 1):
            raise invalid("economy.rounds", expected="a whole number >= 1", got=repr(self.rounds))
        object.__setattr__(self, "rounds", int(self.rounds))
        if not isinstance(self.grows, bool):
            raise invalid("economy.grows", expected="True or False", got=repr(self.grows))
        if self.first_fraction > self.last_fraction:
            got = f"{self.first_fraction:g} and {self.last_fraction:g}"
            raise invalid("economy.first_fraction, last_fraction", expected="in this order", got=got)

    def steps(self, plan: int, *, passes: float, coarse: float) -> Int[np.ndarray, "rounds"]:
        """After which of `plan` steps stock is taken; a share `coarse` at the beginning says nothing yet.

        The plan's steps are `passes` over the frames. Of a plan too short for all rounds some are left out.
        """
        first = max(self.first_fraction, min(coarse + 0.05, self.last_fraction))
        num = max(min(self.rounds, int(passes / MIN_PASSES_PER_ROUND)), 1)
        shares = np.linspace(first, self.last_fraction, num) if num > 1 else np.array([self.last_fraction])
        return np.clip(np.rint(shares * plan), 1, plan).astype(int)
