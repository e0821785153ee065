"""Coordinates of frame times in which all of them are free: log-ratios of increments, run by run."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.special import gammaln

from foldgauss._runtime.checks import invalid, is_within, short_repr

#: Increments of less than this share of a run count as that: float64 has lost the smaller ones.
LEAST_SHARE = 1e-16


class Increments:
    r"""Times of n frames, some of them free, as log-ratios of the increments between them.

    A *run* is a stretch of m free frames between two whose times are held; with its m + 1 increments p, as shares of
    the time between those two, its coordinates are $z_i = \log p_i / p_m$. All times free but the first and the
    last: one run, whose coordinates are the model's softmax weights less the last of them.

    **Shapes:** `held` (num_frames,) times of which those at `free` do not count; coordinates (*batch, num_free).
    **Prior:** a symmetric Dirichlet on the increments of every run, of `concentration`; 1 is uniform over all ordered
    times. A flat prior on the softmax weights would be improper: they do not notice a number added to all.

    **Source:** VeGaS eq:frame_fitting; additive log-ratios, Aitchison 1982.
    **Raises:** ValueError for held times outside [0, 1] or not rising, free first or last frames, a concentration not
    above 0.
    """

    def __init__(
        self, held: Float[np.ndarray, "num_frames"], free: Bool[np.ndarray, "num_frames"], concentration: float = 1.0
    ):
        self.held, self.free = _times(held), np.asarray(free, bool)
        if not is_within(concentration, "(0, inf)"):
            cure = "1 is uniform over all ordered times; more draws them towards equal spacing."
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
        """What lies between held frames is their own; the times at free ones do not count."""
        which = np.flatnonzero(~self.free)
        times = self.held[which]
        if not ((times >= 0) & (times <= 1)).all():
            wrong = which[~((times >= 0) & (times <= 1))][0]
            raise invalid("held", expected="times in [0, 1]", got=f"{self.held[wrong]:.6g} of frame {wrong}")
        down = np.flatnonzero(~(np.diff(times) > 0))
        if down.size:
            one, other = which[down[0] : down[0] + 2]
            got = f"{self.held[one]:.6g} of frame {one} and {self.held[other]:.6g} of frame {other}"
            raise invalid("held", expected="rising times", got=got)

    @classmethod
    def with_free(
        cls, held: Float[np.ndarray, "num_frames"], frames: Sequence[int] | None = None, concentration: float = 1.0
    ) -> "Increments":
        """With `frames` free, or all but the first and the last; ValueError for frames that are not between these."""
        held = _times(held)
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
        """For each run: its coordinates, its first and last frame."""
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
            shares = np.exp(_log_shares(coordinates[..., part]))
            start, end = self.held[first - 1], self.held[last + 1]
            found = start + (end - start) * np.cumsum(shares, axis=-1)[..., :-1]
            times[..., first : last + 1] = np.minimum(found, end)  # what rounding adds
        return times

    def coordinates(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch num_free"]:
        """The log-ratios of times that rise; the times of frames that are held are not looked at.

        Increments below `LEAST_SHARE` of a run, 0 included, count as that: draws of a low concentration have them.
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
                raise invalid("times", expected="times that rise", got=got)
            logs = np.log(np.maximum(steps, LEAST_SHARE * (end - start)))
            found[..., part] = logs[..., :-1] - logs[..., -1:]
        return found

    def log_prior(self, coordinates: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch"]:
        """Log-density of the coordinates: the Dirichlet's times the Jacobian, which is the product of the shares."""
        coordinates, alpha = self._checked(coordinates), self.concentration
        total = np.zeros(coordinates.shape[:-1])
        for part, first, last in self._slices():
            num = last - first + 2
            total += alpha * _log_shares(coordinates[..., part]).sum(-1) + gammaln(alpha * num) - num * gammaln(alpha)
        return total

    def logits(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch intervals"]:
        """The model's softmax weights w, centred: their mean is 0, as a number added to all changes nothing.

        Of increments of at least `LEAST_SHARE`.
        """
        logs = np.log(np.maximum(np.diff(np.asarray(times, np.float64), axis=-1), LEAST_SHARE))
        return logs - logs.mean(-1, keepdims=True)

    def draw_prior(self, rng: np.random.Generator, num: int) -> Float64[np.ndarray, "num num_frames"]:
        """Times from the prior."""
        times = np.broadcast_to(self.held, (num, self.num_frames)).copy()
        for first, last in self.runs:
            shares = rng.dirichlet(np.full(last - first + 2, self.concentration), num)
            start, end = self.held[first - 1], self.held[last + 1]
            found = start + (end - start) * np.cumsum(shares, axis=1)[:, :-1]
            times[:, first : last + 1] = np.minimum(found, end)
        return times

    def _checked(self, coordinates) -> np.ndarray:
        coordinates = np.asarray(coordinates, np.float64)
        if coordinates.shape[-1:] != (self.num_free,):
            raise invalid("coordinates", expected=f"shape (..., {self.num_free})", got=f"shape {coordinates.shape}")
        return coordinates


def _times(held) -> np.ndarray:
    try:
        return np.asarray(held, np.float64)
    except (TypeError, ValueError) as error:
        raise invalid("held", expected="times (num_frames,)", got=short_repr(held)) from error


def _log_shares(coordinates: np.ndarray) -> np.ndarray:
    """Logarithms of all increments of a run, as shares of it."""
    padded = np.concatenate([coordinates, np.zeros((*coordinates.shape[:-1], 1))], axis=-1)
    greatest = padded.max(-1, keepdims=True)
    return padded - greatest - np.log(np.exp(padded - greatest).sum(-1, keepdims=True))
