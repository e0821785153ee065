"""Unconstrained coordinates of frame times: log-ratios of increments, run by run."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.special import gammaln

from foldgauss._runtime.checks import invalid, is_within, short_repr

#: Increments below this fraction of a run are replaced by it: float64 does not resolve smaller ones.
LEAST_FRACTION = 1e-16


class Increments:
    r"""Times of n frames, some of them free, parametrized by log-ratios of the increments between them.

    A *run* is a sequence of m free frames between two held ones; with its m + 1 increments p, as fractions of the time
    between the held frames, its coordinates are $z_i = \log p_i / p_m$. If all times but the
    first and the last are free, there is one run, and its coordinates are the model's softmax weights less the last.

    **Shapes:** `held` (num_frames,) times, ignored where `free`; coordinates (*batch, num_free).
    **Prior:** a symmetric Dirichlet on the increments of every run, of `concentration`; 1 is uniform over all ordered
    times. A flat prior on the softmax weights would be improper, since they are invariant to an added constant.

    **Source:** VeGaS eq:frame_fitting; additive log-ratios, Aitchison 1982.
    **Raises:** ValueError for held times outside [0, 1] or not increasing, a free first or last frame, a concentration
    that is not positive.
    """

    def __init__(
        self, held: Float[np.ndarray, "num_frames"], free: Bool[np.ndarray, "num_frames"], concentration: float = 1.0
    ):
        self.held, self.free = _as_times(held), np.asarray(free, bool)
        if not is_within(concentration, "(0, inf)"):
            cure = "1 is uniform over all ordered times; larger values favor equal spacing."
            raise invalid("concentration", expected="a number > 0", got=short_repr(concentration), cure=cure)
        self.concentration = float(concentration)
        if self.held.ndim != 1 or self.free.shape != self.held.shape or len(self.held) < 3:
            raise invalid(
                "held", expected="at least 3 times, and as many of `free`", got=f"{self.held.shape}, {self.free.shape}"
            )
        if self.free[0] or self.free[-1] or not self.free.any():
            cure = "The first frame is at 0 and the last at 1."
            raise invalid(
                "free",
                expected="frames between the first and the last",
                got=np.flatnonzero(self.free).tolist(),
                cure=cure,
            )
        edge = np.diff(np.concatenate([[0], self.free.astype(int), [0]]))
        self.runs = list(
            zip(np.flatnonzero(edge == 1).tolist(), (np.flatnonzero(edge == -1) - 1).tolist(), strict=True)
        )
        self._check_held()

    def _check_held(self) -> None:
        """Held times must lie in [0, 1] and increase; entries of free frames are ignored."""
        which = np.flatnonzero(~self.free)
        times = self.held[which]
        if not ((times >= 0) & (times <= 1)).all():
            wrong = which[~((times >= 0) & (times <= 1))][0]
            raise invalid("held", expected="times in [0, 1]", got=f"{self.held[wrong]:.6g} of frame {wrong}")
        down = np.flatnonzero(~(np.diff(times) > 0))
        if down.size:
            one, other = which[down[0] : down[0] + 2]
            got = f"{self.held[one]:.6g} of frame {one} and {self.held[other]:.6g} of frame {other}"
            raise invalid("held", expected="increasing times", got=got)

    @classmethod
    def with_free(
        cls, held: Float[np.ndarray, "num_frames"], frames: Sequence[int] | None = None, concentration: float = 1.0
    ) -> "Increments":
        """With `frames` free (default: all but the first and the last); ValueError for other frames."""
        held = _as_times(held)
        num_frames, free = held.size, np.zeros(held.size, bool)
        if frames is None:
            free[1:-1] = True
            return cls(held, free, concentration)
        try:
            frames = np.array(frames if isinstance(frames, np.ndarray) else list(frames))
        except (TypeError, ValueError) as error:
            expected = f"whole numbers from 1 to {num_frames - 2}, one or more"
            raise invalid("frames", expected=expected, got=short_repr(frames), cure="One frame is `[k]`.") from error
        if (
            frames.ndim != 1
            or frames.size == 0
            or frames.dtype.kind not in "iu"
            or (frames < 1).any()
            or (frames > num_frames - 2).any()
        ):
            cure = "The first frame is at 0 and the last at 1."
            raise invalid(
                "frames", expected=f"whole numbers from 1 to {num_frames - 2}", got=frames.tolist(), cure=cure
            )
        free[frames] = True
        return cls(held, free, concentration)

    @property
    def num_frames(self) -> int:
        return len(self.held)

    @property
    def num_free(self) -> int:
        return int(self.free.sum())

    def _slices(self):
        """For each run: the slice of its coordinates, its first and last frame."""
        start = 0
        for first, last in self.runs:
            stop = start + last - first + 1
            yield slice(start, stop), first, last
            start = stop

    def times(self, coordinates: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch num_frames"]:
        """The times of all frames."""
        coordinates = self._checked(coordinates)
        times = np.broadcast_to(self.held, (*coordinates.shape[:-1], self.num_frames)).copy()
        for part, first, last in self._slices():
            fractions = np.exp(_log_fractions(coordinates[..., part]))
            times[..., first : last + 1] = self._place(fractions, first, last)
        return times

    def coordinates(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch num_free"]:
        """The log-ratios of increasing times; the times of held frames are ignored.

        Increments below `LEAST_FRACTION` of a run, 0 included, are replaced by it: draws of a low concentration have
        them.
        """
        times = np.asarray(times, np.float64)
        if times.shape[-1:] != (self.num_frames,):
            raise invalid("times", expected=f"shape (..., {self.num_frames})", got=f"shape {times.shape}")
        found = np.empty((*times.shape[:-1], self.num_free))
        for part, first, last in self._slices():
            start, end = (np.broadcast_to(self.held[k], times.shape[:-1])[..., None] for k in (first - 1, last + 1))
            steps = np.diff(np.concatenate([start, times[..., first : last + 1], end], axis=-1), axis=-1)
            if not (steps >= 0).all():
                got = "NaN" if np.isnan(steps).any() else f"steps down to {steps.min():.3g}"
                raise invalid("times", expected="increasing times", got=got)
            logs = np.log(np.maximum(steps, LEAST_FRACTION * (end - start)))
            found[..., part] = logs[..., :-1] - logs[..., -1:]
        return found

    def log_prior(self, coordinates: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch"]:
        """Log-density of the coordinates: the Dirichlet density times the Jacobian, the product of the fractions."""
        coordinates, alpha = self._checked(coordinates), self.concentration
        total = np.zeros(coordinates.shape[:-1])
        for part, first, last in self._slices():
            num = last - first + 2
            total += (
                alpha * _log_fractions(coordinates[..., part]).sum(-1) + gammaln(alpha * num) - num * gammaln(alpha)
            )
        return total

    def logits(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch intervals"]:
        """The model's softmax weights w, centered to mean 0, since an added constant has no effect.

        Increments below `LEAST_FRACTION` are replaced by it.
        """
        logs = np.log(np.maximum(np.diff(np.asarray(times, np.float64), axis=-1), LEAST_FRACTION))
        return logs - logs.mean(-1, keepdims=True)

    def draw_prior(self, rng: np.random.Generator, num: int) -> Float64[np.ndarray, "num num_frames"]:
        """Draw times from the prior."""
        times = np.broadcast_to(self.held, (num, self.num_frames)).copy()
        for first, last in self.runs:
            fractions = rng.dirichlet(np.full(last - first + 2, self.concentration), num)
            times[:, first : last + 1] = self._place(fractions, first, last)
        return times

    def _place(self, fractions: np.ndarray, first: int, last: int) -> np.ndarray:
        """The times of a run whose increments are these fractions of it."""
        start, end = self.held[first - 1], self.held[last + 1]
        found = start + (end - start) * np.cumsum(fractions, axis=-1)[..., :-1]
        return np.minimum(found, end)  # rounding may exceed it

    def _checked(self, coordinates) -> np.ndarray:
        coordinates = np.asarray(coordinates, np.float64)
        if coordinates.shape[-1:] != (self.num_free,):
            raise invalid("coordinates", expected=f"shape (..., {self.num_free})", got=f"shape {coordinates.shape}")
        return coordinates


def _as_times(held) -> np.ndarray:
    try:
        return np.asarray(held, np.float64)
    except (TypeError, ValueError) as error:
        raise invalid("held", expected="times (num_frames,)", got=short_repr(held)) from error


def _log_fractions(coordinates: np.ndarray) -> np.ndarray:
    """Logarithms of all increments of a run, as fractions of it."""
    padded = np.concatenate([coordinates, np.zeros((*coordinates.shape[:-1], 1))], axis=-1)
    greatest = padded.max(-1, keepdims=True)
    return padded - greatest - np.log(np.exp(padded - greatest).sum(-1, keepdims=True))
