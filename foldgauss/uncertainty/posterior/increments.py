"""Frame times, some of them free, and their prior: a Dirichlet distribution of the increments between them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import gammaln

from foldgauss._runtime.checks import invalid, is_within, short_repr
from foldgauss.uncertainty.likelihood.residuals import check_frames

#: Increments below this fraction are replaced by it before logarithms are taken: float64 does not resolve smaller ones.
LEAST_FRACTION = 1e-16


class Increments:
    r"""Times of n frames, of which `frames` are free (default: all but the first and the last), and their prior.

    A *run* is a sequence of m free frames between two held ones. The m + 1 increments of a run, as fractions of the
    time between its held frames, have a symmetric Dirichlet prior of `concentration` >= 1; 1 is uniform over all
    ordered times. A flat prior on the model's softmax weights would be improper, since they are invariant to an added
    constant.

    **Shapes:** `held` (num_frames,) times, ignored where free.
    **Source:** VeGaS eq:frame_fitting. **Raises:** ValueError for held times outside [0, 1] or not increasing, frames
    other than those between the first and the last, and a concentration below 1.
    """

    def __init__(
        self, held: Float[np.ndarray, " num_frames"], frames: Sequence[int] | None = None, concentration: float = 1.0
    ):
        self.held = _as_times(held)
        if not is_within(concentration, "[1, inf)"):
            cure = "1 is uniform over all ordered times; larger values favor equal spacing."
            raise invalid("concentration", expected="a number >= 1", got=short_repr(concentration), cure=cure)
        self.concentration = float(concentration)
        self.free = np.zeros(self.num_frames, bool)
        self.free[check_frames(frames, self.num_frames)] = True
        self._check_held()
        edge = np.diff(np.concatenate([[0], self.free.astype(int), [0]]))
        #: First and last frame of each run.
        self.runs = list(zip(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) - 1, strict=True))

    def _check_held(self) -> None:
        """Held times must lie in [0, 1] and increase; entries of free frames are ignored."""
        which = np.flatnonzero(~self.free)
        times = self.held[which]
        outside = which[~((times >= 0) & (times <= 1))]
        if len(outside):
            raise invalid("held", expected="times in [0, 1]", got=f"{self.held[outside[0]]:.6g} of frame {outside[0]}")
        down = np.flatnonzero(~(np.diff(times) > 0))
        if len(down):
            one, other = which[down[0] : down[0] + 2]
            got = f"{self.held[one]:.6g} of frame {one} and {self.held[other]:.6g} of frame {other}"
            raise invalid("held", expected="increasing times", got=got)

    @property
    def num_frames(self) -> int:
        return len(self.held)

    @property
    def num_free(self) -> int:
        return int(self.free.sum())

    def times(self, free: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch num_frames"]:
        """The times of all frames, given those of the free ones."""
        free = np.asarray(free, np.float64)
        if free.shape[-1:] != (self.num_free,):
            raise invalid("free", expected=f"shape (..., {self.num_free})", got=f"shape {free.shape}")
        times = np.broadcast_to(self.held, (*free.shape[:-1], self.num_frames)).copy()
        times[..., self.free] = free
        return times

    def log_prior(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch"]:
        """Log-density of the free times, -inf for times that do not increase."""
        alpha, steps = self.concentration, np.diff(times, axis=-1)
        increase = (steps > 0).all(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(steps)
        total = np.zeros(steps.shape[:-1])
        for first, last in self.runs:
            num, length = last - first + 2, self.held[last + 1] - self.held[first - 1]
            total += (alpha - 1) * logs[..., first - 1 : last + 1].sum(-1) if alpha > 1 else 0.0
            total += gammaln(alpha * num) - num * gammaln(alpha) - (alpha * num - 1) * np.log(length)
        return np.where(increase, total, -np.inf)

    def draw_prior(self, rng: np.random.Generator, num: int) -> Float64[np.ndarray, "num num_frames"]:
        """Draw times from the prior."""
        times = np.broadcast_to(self.held, (num, self.num_frames)).copy()
        for first, last in self.runs:
            fractions = rng.dirichlet(np.full(last - first + 2, self.concentration), num)
            start, end = self.held[first - 1], self.held[last + 1]
            placed = start + (end - start) * np.cumsum(fractions, axis=1)[:, :-1]
            times[:, first : last + 1] = np.minimum(placed, end)  # rounding may exceed it
        return times


def logits_of(times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch intervals"]:
    """The model's softmax weights w, centered to mean 0, since an added constant has no effect.

    Increments below `LEAST_FRACTION` are replaced by it.
    """
    logs = np.log(np.maximum(np.diff(np.asarray(times, np.float64), axis=-1), LEAST_FRACTION))
    return logs - logs.mean(-1, keepdims=True)


def _as_times(held) -> np.ndarray:
    try:
        times = np.asarray(held, np.float64)
    except (TypeError, ValueError) as error:
        raise invalid("held", expected="times (num_frames,)", got=short_repr(held)) from error
    if times.ndim != 1 or len(times) < 3:
        raise invalid("held", expected="at least 3 times", got=f"shape {times.shape}")
    return times
