r"""The posterior of frame times without sampling: a Markov chain on grids, and Laplace's approximation.

Given the splats, likelihoods factorise over frames and a Dirichlet prior over increments: the times are a Markov chain
with transitions :math:`(t_{k+1} - t_k)^{\alpha - 1}`. Forward and backward passes over grids give all marginals.
"""

import dataclasses

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaln

from foldgauss._checks import invalid
from foldgauss.uncertainty.increments import Increments
from foldgauss.uncertainty.profiles import Profiles

#: Grid points between two nodes of a profile, where it is within NEAR nats of its maximum.
FINER, NEAR = 8, 30.0
#: Pieces of a frame's grid have less than this share of its mass, and reach as far as it has more than NOTHING.
POINTS, NOTHING = 300, 1e-13
#: Likelihoods so many nats below their maximum are 0 in float64.
UNDERFLOW = 740.0


@dataclasses.dataclass(frozen=True)
class ExactTimes:
    """Marginals of the free frames' times, and the evidence.

    `grids` and `densities`: for each frame that is free, in order, times and the posterior density there.
    `log_evidence`: logarithm of the likelihood's mean over the prior, in nats, with the profiles' own zero.
    """

    increments: Increments
    grids: list[Float64[np.ndarray, "points"]]
    densities: list[Float64[np.ndarray, "points"]]
    log_evidence: float
    _forward: list[Float64[np.ndarray, "points"]] = dataclasses.field(repr=False)

    def mean(self) -> Float64[np.ndarray, "num_frames"]:
        return self._filled([_moment(*each, 0.0, 1) for each in zip(self.grids, self.densities, strict=True)])

    def std(self) -> Float64[np.ndarray, "num_frames"]:
        """Standard deviations; 0 for frames that are held."""
        found = np.zeros(self.increments.num_frames)
        means = self.mean()[self.increments.free]
        pairs = zip(self.grids, self.densities, means, strict=True)
        found[self.increments.free] = [np.sqrt(_moment(grid, density, mean, 2)) for grid, density, mean in pairs]
        return found

    def quantile(self, share: float) -> Float64[np.ndarray, "num_frames"]:
        """The times below which each frame lies with probability `share`."""
        if not 0 <= share <= 1:
            raise invalid("share", expected="a number in [0, 1]", got=share)
        return self._filled([_quantile(*each, share) for each in zip(self.grids, self.densities, strict=True)])

    def interval(self, level: float) -> Float64[np.ndarray, "2 num_frames"]:
        """Ends of the central intervals that hold `level` of the probability."""
        return np.stack([self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)])

    def sample(self, num: int, seed: int = 0) -> Float64[np.ndarray, "num num_frames"]:
        """Independent draws of all times together, from the last frame of a run to its first."""
        rng, alpha = np.random.default_rng(seed), self.increments.concentration
        times = np.broadcast_to(self.increments.held, (num, self.increments.num_frames)).copy()
        which = {k: n for n, k in enumerate(np.flatnonzero(self.increments.free))}
        for first, last in self.increments.runs:
            for k in range(last, first - 1, -1):
                grid, forward = self.grids[which[k]], self._forward[which[k]]
                times[:, k] = _draw(grid, forward, times[:, k + 1], alpha, rng.random(num))
        return times

    def _filled(self, values) -> np.ndarray:
        found = self.increments.held.copy()
        found[self.increments.free] = values
        return found


def exact_times(profiles: Profiles, increments: Increments) -> ExactTimes:
    """The exact posterior given profiles, to the grids' precision (some 1e-3 of a standard deviation).

    Raises ValueError where no ordered times have any likelihood that a float64 can hold.
    """
    grids, densities, forwards, log_evidence = [], [], [], 0.0
    for first, last in increments.runs:
        ends = increments.held[first - 1], increments.held[last + 1]
        found = _run(profiles, range(first, last + 1), ends, increments.concentration)
        grids += found[0]
        densities += found[1]
        forwards += found[2]
        log_evidence += found[3]
    held = ~increments.free
    log_evidence += float(profiles(increments.held)[held].sum())
    return ExactTimes(increments, grids, densities, log_evidence, forwards)


def _run(profiles: Profiles, frames: range, ends: tuple[float, float], alpha: float):
    """Grids, marginal densities, forward messages and the log-evidence of a run between two held times.

    Twice: where the first pass finds next to nothing there is nothing to be looked at, and elsewhere it is finer.
    """
    grids = [profile_grid(profiles, k, *ends, finer=2) for k in frames]
    densities, *_ = _passes(profiles, frames, grids, ends, alpha)
    grids = [_regridded(*each) for each in zip(grids, densities, strict=True)]
    densities, forward, log_evidence = _passes(profiles, frames, grids, ends, alpha)
    return grids, densities, forward, log_evidence


def _regridded(grid: np.ndarray, density: np.ndarray) -> np.ndarray:
    """The part of a grid with any mass, cut so that no piece has more than a POINTS-th of it."""
    mass = (density[1:] + density[:-1]) / 2 * np.diff(grid)
    some = np.flatnonzero(mass > NOTHING * mass.sum())
    first, last = max(some[0] - 1, 0), min(some[-1] + 1, len(mass) - 1)
    cuts = np.maximum(np.ceil(POINTS * mass / mass.sum()).astype(int), 1)
    points = [np.linspace(grid[n], grid[n + 1], cuts[n] + 1)[:-1] for n in range(first, last + 1)]
    return np.concatenate([*points, [grid[last + 1]]])


def _passes(profiles: Profiles, frames: range, grids: list[np.ndarray], ends: tuple[float, float], alpha: float):
    """Marginal densities, forward messages and the log-evidence."""
    heights = [_on_grid(profiles, k, grid) for k, grid in zip(frames, grids, strict=True)]
    peaks = [height.max() for height in heights]
    likelihoods = [np.exp(height - peak) for height, peak in zip(heights, peaks, strict=True)]
    forward, log_total = [likelihoods[0] * _from_end(grids[0], ends[0], alpha)], float(np.sum(peaks))
    for n in range(1, len(frames)):
        log_total += _rescale(forward[-1], frames[n - 1])
        forward.append(likelihoods[n] * (_hats(grids[n - 1], grids[n], alpha) @ forward[-1]))
    backward = [_from_end(-grids[-1][::-1], -ends[1], alpha)[::-1].copy()]
    log_total += _rescale(forward[-1], frames[-1])
    log_total += float(np.log(_integral(grids[-1], forward[-1] * backward[-1])))
    for n in range(len(frames) - 2, -1, -1):
        ahead = likelihoods[n + 1] * backward[-1]
        _rescale(ahead, frames[n + 1])
        backward.append((_hats(-grids[n + 1][::-1], -grids[n][::-1], alpha) @ ahead[::-1])[::-1].copy())
    densities = []
    for k, grid, one, other in zip(frames, grids, forward, reversed(backward), strict=True):
        density = one * other
        _rescale(density, k)
        densities.append(density / _integral(grid, density))
    num, length = len(frames) + 1, ends[1] - ends[0]
    log_total += gammaln(alpha * num) - num * gammaln(alpha) - (alpha * num - 1) * np.log(length)
    return densities, forward, float(log_total)


def profile_grid(
    profiles: Profiles, k: int, start: float, end: float, finer: int = FINER
) -> Float64[np.ndarray, "points"]:
    """Times from `start` to `end`, as dense as frame k's profile is known, and `finer` times as dense near its top."""
    nodes, _ = profiles.one(k)
    low, high = max(start, nodes[0]), min(end, nodes[-1])
    if not low < high:
        got = f"frame {k} known from {nodes[0]:.4g} to {nodes[-1]:.4g}, to lie between {start:.4g} and {end:.4g}"
        raise invalid("profiles", expected="profiles that reach between the frames that are held", got=got)
    inside = (nodes > low) & (nodes < high)
    here = np.concatenate([[low], nodes[inside], [high]])
    heights = profiles[k](here[:, None])[:, 0]
    if np.isnan(heights).any():
        raise invalid("profiles", expected="log-likelihoods that are numbers", got=f"NaN for frame {k}")
    some = np.flatnonzero(heights > heights.max() - UNDERFLOW)
    hull = slice(max(some[0] - 1, 0), some[-1] + 2)
    here, heights = here[hull], heights[hull]
    near = heights > heights.max() - NEAR
    points = [
        np.linspace(a, b, (finer if close else 1) + 1)[:-1]
        for a, b, close in zip(here[:-1], here[1:], near[:-1] | near[1:], strict=True)
    ]
    return np.concatenate([*points, here[-1:]])


def _on_grid(profiles: Profiles, k: int, grid: np.ndarray) -> np.ndarray:
    return profiles[k](grid[:, None])[:, 0]


def _from_end(grid: np.ndarray, end: float, alpha: float) -> np.ndarray:
    """(t - end)^(alpha - 1) on a grid above `end`; where that is infinite, what gives the first piece its integral."""
    away = grid - end
    if away[0] > 0:
        return away ** (alpha - 1)
    first = away[1]
    return np.concatenate([[max(2 / alpha - 1, 0.0) * first ** (alpha - 1)], away[1:] ** (alpha - 1)])


def _hats(behind: np.ndarray, here: np.ndarray, alpha: float) -> np.ndarray:
    """Integrals of the hat function of each point of `behind` against (t - s)_+^(alpha - 1), t on `here`.

    Exact for piecewise linear messages, however near the two grids are: infinity at s = t is integrated by hand.
    """
    away = np.maximum(here[:, None] - behind[None, :], 0.0)
    first = away if alpha == 1 else away**alpha / alpha
    above = first * away / (alpha + 1)
    chords = np.diff(above, axis=1) / np.diff(behind)
    inner = np.concatenate([np.zeros_like(chords[:, :1]), chords, np.zeros_like(chords[:, :1])], axis=1)
    hats = inner[:, 1:] - inner[:, :-1]
    # The first and the last hat are halves: their outer chord is the tangent there.
    hats[:, 0] += first[:, 0]
    hats[:, -1] -= first[:, -1]
    return np.maximum(hats, 0.0)


def _rescale(message: np.ndarray, k: int) -> float:
    """Divide by the greatest value, in place; returns its logarithm."""
    greatest = float(message.max())
    if not (greatest > 0 and np.isfinite(greatest)):
        cure = "Frames are out of order, or of another video; or let the noise count for less."
        raise invalid(
            "video",
            expected="frames in the model's order",
            got=f"no time for frame {k} after the one before",
            cure=cure,
        )
    message /= greatest
    return float(np.log(greatest))


def _integral(grid: np.ndarray, density: np.ndarray) -> float:
    return float(np.trapezoid(density, grid))


def _moment(grid: np.ndarray, density: np.ndarray, centre: float, power: int) -> float:
    """Integral of (t - centre)^power, power 1 or 2, over a piecewise linear density: Simpson's rule is exact."""
    middle, half = (grid[1:] + grid[:-1]) / 2, (density[1:] + density[:-1]) / 2
    ends = density * (grid - centre) ** power
    return float(((ends[:-1] + ends[1:] + 4 * half * (middle - centre) ** power) / 6 * np.diff(grid)).sum())


def _quantile(grid: np.ndarray, density: np.ndarray, share: float) -> float:
    """Of a piecewise linear density."""
    return float(_inverted(grid, density[None], np.array([share]))[0])


def _inverted(grid: np.ndarray, density: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Times below which `share` (num,) lies of densities (num or 1, points), piecewise linear."""
    masses = (density[:, 1:] + density[:, :-1]) / 2 * np.diff(grid)
    summed = np.concatenate([np.zeros((len(masses), 1)), np.cumsum(masses, axis=1)], axis=1)
    goal = share * summed[:, -1]
    piece = np.clip((summed <= goal[:, None]).sum(1) - 1, 0, len(grid) - 2)
    row = np.arange(len(goal)) if len(density) > 1 else np.zeros(len(goal), int)
    left, right = density[row, piece], density[row, piece + 1]
    width, rest = (grid[1:] - grid[:-1])[piece], goal - summed[row, piece]
    # rest = left x + (right - left) x^2 / (2 width); this form of the root holds for right = left, too.
    root = np.sqrt(np.maximum(left**2 + 2 * (right - left) * rest / width, 0.0))
    step = np.divide(2 * rest, left + root, out=np.zeros_like(rest), where=left + root > 0)
    return grid[piece] + np.clip(step, 0.0, width)


def _draw(grid: np.ndarray, forward: np.ndarray, above: np.ndarray, alpha: float, share: np.ndarray) -> np.ndarray:
    """Times below `above` (num,), with densities in proportion to the message times (above - t)^(alpha - 1)."""
    found = np.empty(len(above))
    for first in range(0, len(above), 500):
        part = slice(first, first + 500)
        ceiling = above[part, None]
        away = ceiling - grid
        if alpha == 1:
            density = np.where(away > 0, forward, 0.0)
        else:
            step = np.gradient(grid) / 2
            density = np.where(away > 0, forward * np.maximum(away, step) ** (alpha - 1), 0.0)
        found[part] = np.minimum(_inverted(grid, density, share[part]), np.nextafter(above[part], -np.inf))
    return found
