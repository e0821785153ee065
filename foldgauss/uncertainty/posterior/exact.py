r"""The posterior of frame times without sampling: a Markov chain on grids, and Laplace's approximation.

Given the splats, likelihoods factorise over frames and a Dirichlet prior over increments: the times are a Markov chain
with transitions $(t_{k+1} - t_k)^{\alpha - 1}$. Forward and backward passes over grids give all marginals.

What a pass carries is a logarithm, less that of the prior: $\phi_k(t)$ is the mean of the likelihoods of the
frames up to k, over the prior given that frame k is at t. It is constant where frames tell nothing, and

$$ \phi_{k+1}(t) = L_{k+1}(t) \, \mathbb{E}\, \phi_k(t B), \qquad B \sim \mathrm{Beta}(\alpha k, \alpha) $$

with times from the start of the run. Between grid points, logarithms are linear.
"""

import dataclasses

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaln

from foldgauss._runtime.checks import invalid
from foldgauss._runtime.kernels import inline, kernel
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.posterior.increments import Increments

#: Grid points between two nodes of a profile, where it is within NEAR nats of its maximum.
FINER, NEAR = 8, 30.0
#: Pieces of a frame's grid have at most 1 / POINTS of its mass, are WIDTH standard deviations wide at most, and reach
#: as far as they have more than NOTHING.
POINTS, WIDTH, NOTHING = 300, 1 / 12, 1e-13
#: Points of a frame's grid at first; grids are cut again, at most ROUNDS times, while a piece has more than COARSE.
FIRST, ROUNDS, COARSE = 400, 6, 0.1
#: Halvings of a grid's pieces beside held times where the density is infinite; each in so many steps.
HALVINGS, STEPS = 40, 4
#: A frame's density may be infinite, or jump, where a near frame is that has less than NARROW of its spread;
#: near: at most AROUND frames away.
NARROW, AROUND = 0.1, 5
#: Likelihoods so many nats below their maximum are 0 in float64.
UNDERFLOW = 740.0
#: Cells whose logarithm is so much below another's are left out of sums.
NEGLIGIBLE = 40.0
#: Proposals for a draw within a piece, after which the last is taken.
TRIES = 1000
#: Gauss and Legendre's rule on [0, 1].
_NODES, _WEIGHTS = (np.polynomial.legendre.leggauss(8)[0] + 1) / 2, np.polynomial.legendre.leggauss(8)[1] / 2


@dataclasses.dataclass(frozen=True)
class ExactPosterior:
    """Marginals of the free frames' times, and the evidence.

    `grids` and `densities`: for each frame that is free, in order, times and the posterior density there.
    `log_evidence`: logarithm of the likelihood's mean over the prior, in nats, with the profiles' own zero.
    """

    increments: Increments
    grids: list[Float64[np.ndarray, " points"]]
    densities: list[Float64[np.ndarray, " points"]]
    log_evidence: float
    _forward: list[Float64[np.ndarray, " points"]] = dataclasses.field(repr=False)

    def mean(self) -> Float64[np.ndarray, " num_frames"]:
        return self._filled([_moment(*each, 0.0, 1) for each in zip(self.grids, self.densities, strict=True)])

    def std(self) -> Float64[np.ndarray, " num_frames"]:
        """Standard deviations; 0 for frames that are held."""
        found = np.zeros(self.increments.num_frames)
        means = self.mean()[self.increments.free]
        pairs = zip(self.grids, self.densities, means, strict=True)
        found[self.increments.free] = [np.sqrt(_moment(grid, density, mean, 2)) for grid, density, mean in pairs]
        return found

    def quantile(self, fraction: float) -> Float64[np.ndarray, " num_frames"]:
        """The times below which each frame lies with probability `share`."""
        if not 0 <= fraction <= 1:
            raise invalid("fraction", expected="a number in [0, 1]", got=fraction)
        return self._filled([_quantile(*each, fraction) for each in zip(self.grids, self.densities, strict=True)])

    def interval(self, level: float) -> Float64[np.ndarray, "2 num_frames"]:
        """Ends of the central intervals that hold `level` of the probability."""
        return np.stack([self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)])

    def sample(self, num: int, seed: int = 0) -> Float64[np.ndarray, "num num_frames"]:
        """Independent draws of all times together, from the last frame of a run to its first."""
        rng, alpha = np.random.default_rng(seed), self.increments.concentration
        times = np.broadcast_to(self.increments.held, (num, self.increments.num_frames)).copy()
        which = {k: n for n, k in enumerate(np.flatnonzero(self.increments.free))}
        for first, last in self.increments.runs:
            start = self.increments.held[first - 1]
            for k in range(last, first - 1, -1):
                message = _Message(self.grids[which[k]] - start, self._forward[which[k]], k - first + 1, alpha)
                drawn = start + message.draw(times[:, k + 1] - start, rng)
                times[:, k] = np.maximum(np.minimum(drawn, np.nextafter(times[:, k + 1], -np.inf)), start)
        return times

    def _filled(self, values) -> np.ndarray:
        found = self.increments.held.copy()
        found[self.increments.free] = values
        return found


def exact_posterior(curves: ProfileCurves, increments: Increments) -> ExactPosterior:
    r"""The exact posterior given profiles, to the precision of grids of some 300 to 800 points a frame.

    **Precision:** means and 5 % quantiles to 5e-3 of a standard deviation, standard deviations to 3e-3 of their own,
    the evidence to 1e-2 nats for some hundred frames; for concentrations from 0.2 to 20, whether frames are known far
    better than they are apart, or not at all. Worst for the smallest concentrations, whose densities are infinite
    beside frames that are known.
    **Cost:** for n frames and concentration 1, O(n) with n grids; otherwise of the order of n 500^2 powers (150 frames
    that nothing is known of: about 1 s, and 6 s).
    **Raises:** ValueError where no ordered times have any likelihood: frames whose likelihoods are above exp(-740) of
    their greatest only in the wrong order; NaN in profiles.
    """
    grids, densities, forwards, log_evidence = [], [], [], 0.0
    for first, last in increments.runs:
        ends = increments.held[first - 1], increments.held[last + 1]
        found = _run(curves, range(first, last + 1), ends, increments.concentration)
        grids += found[0]
        densities += found[1]
        forwards += found[2]
        log_evidence += found[3]
    held = ~increments.free
    log_evidence += float(curves(increments.held)[held].sum())
    return ExactPosterior(increments, grids, densities, log_evidence, forwards)


def _run(curves: ProfileCurves, frames: range, ends: tuple[float, float], alpha: float):
    """Grids, marginal densities, forward messages and the log-evidence of a run between two held times.

    Again and again: where a pass finds next to nothing there is nothing to be looked at, and elsewhere it is finer.
    """
    grids = []
    for n, k in enumerate(frames):
        grid = _thinned(curves, k, profile_grid(curves, k, *ends, finer=2))
        grids.append(_graded(grid, ends, alpha * (n + 1) < 1, alpha * (len(frames) - n) < 1))
    densities, *_ = _passes(curves, frames, grids, ends, alpha)
    for _ in range(ROUNDS):
        cut = [_regridded(*each) for each in zip(grids, densities, strict=True)]
        grids, coarse = _around(grids, densities, [each[0] for each in cut], alpha), [each[1] for each in cut]
        densities, forward, log_evidence = _passes(curves, frames, grids, ends, alpha)
        if max(coarse) < COARSE:
            break
    return grids, densities, forward, log_evidence


def _thinned(curves: ProfileCurves, k: int, grid: np.ndarray) -> np.ndarray:
    """Some FIRST points of a grid: half of them by the change of the likelihood, half by time."""
    if len(grid) <= FIRST:
        return grid
    heights = _on_grid(curves, k, grid)
    change = np.abs(np.diff(np.exp(heights - heights.max())))
    time = np.diff(grid) / (grid[-1] - grid[0])
    passed = np.concatenate([[0.0], np.cumsum(time + change / max(change.sum(), 1.0))])
    return grid[np.unique(np.searchsorted(passed, np.linspace(0, passed[-1], FIRST)).clip(0, len(grid) - 1))]


def _graded(grid: np.ndarray, ends: tuple[float, float], at_start: bool, at_end: bool) -> np.ndarray:
    """With the piece beside a held time halved again and again, if asked for and if the grid reaches as far."""
    halves = 0.5 ** (np.arange(STEPS * HALVINGS, 0, -1) / STEPS)
    parts = [grid]
    if at_start and grid[0] == ends[0]:
        parts.append(grid[0] + (grid[1] - grid[0]) * halves)
    if at_end and grid[-1] == ends[1]:
        parts.append(grid[-1] - (grid[-1] - grid[-2]) * halves)
    return np.unique(np.concatenate(parts))


def _regridded(grid: np.ndarray, density: np.ndarray) -> tuple[np.ndarray, float]:
    """The part of a grid with any mass, cut so that no piece has much of it, or is wide; and the most that one had."""
    mass = (density[1:] + density[:-1]) / 2 * np.diff(grid)
    mass = mass / mass.sum()
    some = np.flatnonzero(mass > NOTHING)
    first, last = max(some[0] - 1, 0), min(some[-1] + 1, len(mass) - 1)
    spread = np.sqrt(_moment(grid, density, _moment(grid, density, 0.0, 1), 2))
    cuts = np.ceil(np.maximum(POINTS * mass, np.diff(grid) / (WIDTH * spread))).astype(int)
    return np.unique(_cut(grid[first : last + 2], cuts[first : last + 1])), float(mass.max())


def _around(
    grids: list[np.ndarray], densities: list[np.ndarray], cut: list[np.ndarray], alpha: float
) -> list[np.ndarray]:
    """Grids `cut` with points, ever further apart, around where frames are that are known far better than their own.

    For concentrations below 2: above a frame that is known the next one has a density of the distance's power
    alpha - 1, and the j-th after it of alpha j - 1.
    """
    if alpha >= 2:
        return cut
    means = [_moment(grid, density, 0.0, 1) for grid, density in zip(grids, densities, strict=True)]
    moments = zip(grids, densities, means, strict=True)
    spreads = [np.sqrt(_moment(grid, density, mean, 2)) for grid, density, mean in moments]
    reach, found = min(max(int(1 / alpha), 1), AROUND), []
    for n, points in enumerate(cut):
        parts = [points]
        for j in range(max(n - reach, 0), min(n + reach + 1, len(cut))):
            if 0 < spreads[j] < NARROW * spreads[n]:
                halvings = np.arange(-2, np.log2((points[-1] - points[0]) / spreads[j]), 0.5)
                steps = spreads[j] * 2.0**halvings
                parts += [means[j] - steps, means[j] + steps]
        every = np.unique(np.concatenate(parts))
        found.append(every[(every >= points[0]) & (every <= points[-1])])
    return found


def _passes(curves: ProfileCurves, frames: range, grids: list[np.ndarray], ends: tuple[float, float], alpha: float):
    """Marginal densities, forward messages and the log-evidence."""
    num, length = len(frames), ends[1] - ends[0]
    heights = [_on_grid(curves, k, grid) for k, grid in zip(frames, grids, strict=True)]
    forward = [heights[0]]
    for n in range(1, num):
        message = _Message(grids[n - 1] - ends[0], forward[-1], n, alpha)
        forward.append(heights[n] + _some(message.ahead(grids[n] - ends[0]), frames[n]))
    last = _Message(grids[-1] - ends[0], forward[-1], num, alpha)
    log_evidence = float(_some(last.ahead(np.array([length])), frames[-1])[0])
    # Backward passes are forward passes of time that runs from the end.
    backward = [np.zeros_like(grids[-1])]
    for n in range(num - 2, -1, -1):
        logs = (heights[n + 1] + backward[-1])[::-1]
        message = _Message(ends[1] - grids[n + 1][::-1], logs, num - 1 - n, alpha)
        backward.append(_some(message.ahead(ends[1] - grids[n][::-1])[::-1], frames[n]))
    densities = []
    for n, (grid, one, other) in enumerate(zip(grids, forward, reversed(backward), strict=True)):
        shapes = alpha * (n + 1), alpha * (num - n)
        densities.append(_density(grid, _some(one + other, frames[n]), ends, shapes))
    return densities, forward, log_evidence


def _some(logs: np.ndarray, k: int) -> np.ndarray:
    """Logarithms, if any is that of more than nothing."""
    if logs.max() == -np.inf:
        cure = "Frames are out of order, or of another video; or let the noise count for less."
        raise invalid(
            "video",
            expected="frames in the model's order",
            got=f"no time for frame {k} after the one before",
            cure=cure,
        )
    return logs


def _density(grid: np.ndarray, told: np.ndarray, ends: tuple[float, float], shapes: tuple[float, float]) -> np.ndarray:
    """A marginal: exp(told) times the prior's Beta density, of these shapes, between the ends."""
    since, until = grid - ends[0], ends[1] - grid
    with np.errstate(divide="ignore", invalid="ignore"):
        since, until = ((shape - 1) * np.log(away) if shape != 1 else 0.0 for shape, away in
                        zip(shapes, (since, until), strict=True))  # fmt: skip
        logs = told + since + until
    finite = np.where(logs < np.inf, logs, -np.inf)
    density = np.exp(finite - finite.max())
    # Beside an end where it is infinite, or rises from 0 ever more slowly, what gives that piece its integral.
    for end, inner, shape in ((0, 1, shapes[0]), (-1, -2, shapes[1])):
        if grid[end] == ends[end] and shape < 2 and shape != 1 and np.isfinite(told[end]):
            density[end] = density[inner] * (2 / shape - 1)
    return density / _integral(grid, density)


def profile_grid(
    curves: ProfileCurves, k: int, start: float, end: float, finer: int = FINER
) -> Float64[np.ndarray, " points"]:
    """Times from `start` to `end`, as dense as frame k's profile is known, and `finer` times as dense near its top."""
    nodes, _ = curves.nodes_and_values(k)
    low, high = max(start, nodes[0]), min(end, nodes[-1])
    if not low < high:
        got = f"frame {k} known from {nodes[0]:.4g} to {nodes[-1]:.4g}, to lie between {start:.4g} and {end:.4g}"
        raise invalid("profiles", expected="profiles that reach between the frames that are held", got=got)
    inside = (nodes > low) & (nodes < high)
    here = np.concatenate([[low], nodes[inside], [high]])
    heights = curves[k](here[:, None])[:, 0]
    if np.isnan(heights).any():
        raise invalid("profiles", expected="log-likelihoods that are numbers", got=f"NaN for frame {k}")
    some = np.flatnonzero(heights > heights.max() - UNDERFLOW)
    hull = slice(max(some[0] - 1, 0), some[-1] + 2)
    here, heights = here[hull], heights[hull]
    near = heights > heights.max() - NEAR
    return _cut(here, np.where(near[:-1] | near[1:], finer, 1))


def _cut(grid: np.ndarray, cuts: np.ndarray) -> np.ndarray:
    """A grid with each of its pieces cut into so many."""
    number = np.arange(cuts.sum()) - np.repeat(np.cumsum(cuts) - cuts, cuts)
    points = np.repeat(grid[:-1], cuts) + number * np.repeat(np.diff(grid) / cuts, cuts)
    return np.concatenate([points, grid[-1:]])


def _on_grid(curves: ProfileCurves, k: int, grid: np.ndarray) -> np.ndarray:
    return curves[k](grid[:, None])[:, 0]


class _Message:
    """exp(logs) on a grid of times since a run's start, times that power of them which is the prior's.

    The prior's: times^(alpha gaps - 1), the density of a sum of `gaps` increments, up to a factor.
    """

    def __init__(self, grid: np.ndarray, logs: np.ndarray, gaps: int, alpha: float):
        self.grid, self.logs, self.gaps, self.alpha = grid, np.ascontiguousarray(logs), gaps, alpha
        self.power = alpha * gaps - 1
        cells = np.arange(len(grid) - 1)
        places, heights = self._within(cells, np.ones(len(cells)))
        self.masses = _log_sum(heights)
        with np.errstate(invalid="ignore"):
            weights = np.nan_to_num(np.exp(heights - self.masses[:, None]))
        self.means = (weights * (places - grid[:-1, None])).sum(1)
        self.variances = (weights * (places - grid[:-1, None] - self.means[:, None]) ** 2).sum(1)
        self.means += grid[:-1]
        self.summed = np.concatenate([[-np.inf], np.logaddexp.accumulate(self.masses)])

    def ahead(self, here: np.ndarray) -> np.ndarray:
        """Log of the mean of exp(logs) at times `here` times B, for B of Beta(alpha gaps, alpha)."""
        if self.alpha == 1:
            cell, fraction = self._last(here)
            found = np.logaddexp(self.summed[cell], _log_sum(self._within(cell, fraction)[1]))
            found[here <= self.grid[0]] = -np.inf
        else:
            found = np.empty(len(here))
            _sums(here, *self._tables(), found)
        constant = gammaln(self.power + 1 + self.alpha) - gammaln(self.power + 1) - gammaln(self.alpha)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = found - (self.power + self.alpha) * np.log(here) + constant
        at_start = self.logs[0] if self.grid[0] == 0 else -np.inf
        return np.where(here > 0, found, at_start)

    def draw(self, above: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Times below `above` (num,), with densities in proportion to the message times (above - t)^(alpha - 1)."""
        chance = rng.random(len(above))
        if self.alpha == 1:
            cell, fraction = self._last(above)
            goal = np.log(chance) + np.logaddexp(self.summed[cell], _log_sum(self._within(cell, fraction)[1]))
            cell = np.minimum(np.searchsorted(self.summed, goal, side="right") - 1, cell)
        else:
            cell = np.empty(len(above), np.int64)
            _cells(above, chance, *self._tables(), cell)
        low, high = self.grid[cell], np.minimum(self.grid[cell + 1], above)
        found, waiting = high.copy(), np.flatnonzero(high > low)
        for _ in range(TRIES):
            if not len(waiting):
                break
            some = waiting
            found[some], kept = self._propose(cell[some], low[some], high[some], above[some], rng)
            waiting = some[~kept]
        return found

    def _propose(self, cell, low, high, above, rng) -> tuple[np.ndarray, np.ndarray]:
        """Times in cells, between `low` and `high`; and whether to keep them: draws by rejection."""
        alpha, power, num = self.alpha, self.power, len(cell)
        chance, threshold = rng.random(num), np.log(rng.random(num))
        # By the distance to `above`, whose power may be infinite at its end; all else is smooth, unless low is 0.
        near, far = (above - high) ** alpha, (above - low) ** alpha
        found = np.clip(above - (near + chance * (far - near)) ** (1 / alpha), low, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = np.maximum(self.logs[cell], self.logs[cell + 1])
            kept = power * np.log(found) - np.maximum(power * np.log(low), power * np.log(high))
            first = low == 0
            apart = first & (above > 2 * high)
            found[apart] = high[apart] * chance[apart] ** (1 / (power + 1))
            kernel = (alpha - 1) * np.log(np.stack([above - found, above, above - high]))
            kept[apart] = (kernel[0] - np.maximum(kernel[1], kernel[2]))[apart]
            both = first & ~apart
            found[both] = above[both] * rng.beta(power + 1, alpha, both.sum())
            kept[both] = np.where(found <= high, 0.0, -np.inf)[both]
            fraction = np.clip((found - low) / (self.grid[cell + 1] - low), 0.0, 1.0)
            kept += _between(self.logs[cell], self.logs[cell + 1], fraction) - bound
        return found, kept >= threshold

    def _last(self, above: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The cells that times are in, and how much of these is below them; beyond the grid: all of the last."""
        cell = np.clip(np.searchsorted(self.grid, above, side="left") - 1, 0, len(self.grid) - 2)
        fraction = (above - self.grid[cell]) / (self.grid[cell + 1] - self.grid[cell])
        return cell, np.clip(fraction, 0.0, 1.0)

    def _within(self, cell: np.ndarray, fraction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes in the first `share` of cells, and the logarithms of what each adds to the integral."""
        low, width = self.grid[cell][:, None], np.diff(self.grid)[cell][:, None] * fraction[:, None]
        first = low == 0
        inside = np.where(first, _NODES ** (1 / (self.power + 1)), _NODES)
        places = low + width * inside
        with np.errstate(divide="ignore", invalid="ignore"):
            measure = np.where(
                first,
                (self.power + 1) * np.log(width) - np.log(self.power + 1),
                np.log(width) + self.power * np.log(places),
            )
            logs = _between(self.logs[cell][:, None], self.logs[cell + 1][:, None], fraction[:, None] * inside)
        return places, logs + measure + np.log(_WEIGHTS)

    def _tables(self) -> tuple:
        tables = self.grid, self.logs, self.masses, self.means, self.variances
        return *tables, float(self.power), float(self.alpha), _NODES, _WEIGHTS


def _between(left: np.ndarray, right: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Logarithms at a share of the way; where one of two is that of nothing, it is the numbers that are linear."""
    logs = left * (1 - fraction) + right * fraction
    logs = np.where(left == -np.inf, right + np.log(fraction), logs)
    logs = np.where(right == -np.inf, left + np.log1p(-fraction), logs)
    return np.where((left == -np.inf) & (right == -np.inf), -np.inf, logs)


def _log_sum(logs: np.ndarray) -> np.ndarray:
    """Over the last axis."""
    top = logs.max(-1)
    with np.errstate(divide="ignore"):
        return top + np.log(np.exp(logs - np.where(top == -np.inf, 0.0, top)[..., None]).sum(-1))


@inline
def _log_at(fraction, left, right):
    if left == -np.inf:
        return right + np.log(fraction)
    if right == -np.inf:
        return left + np.log1p(-fraction)
    return left + fraction * (right - left)


@kernel
def _piece(t, low, high, first, width, left, right, power, alpha, nodes, weights, terms):
    """Logarithms of what nodes in [low, high] add to the integral of message times (t - s)^(alpha - 1)."""
    near, far = (t - high) ** alpha, (t - low) ** alpha
    for n in range(len(nodes)):
        if alpha < 1:  # in (t - s)^alpha, where it is smooth
            s = t - (near + (far - near) * nodes[n]) ** (1 / alpha)
            log = np.log((far - near) * weights[n] / alpha)
        else:
            s = low + (high - low) * nodes[n]
            log = np.log((high - low) * weights[n]) + (alpha - 1) * np.log(t - s)
        fraction = min(max((s - first) / width, 0.0), 1.0)
        terms[n] = log + power * np.log(s) + _log_at(fraction, left, right)


@kernel
def _log_total(terms, num):
    top = -np.inf
    for n in range(num):
        top = max(top, terms[n])
    if top == -np.inf:
        return top
    total = 0.0
    for n in range(num):
        total += np.exp(terms[n] - top)
    return top + np.log(total)


@kernel
def _terms(t, grid, logs, masses, means, variances, power, alpha, nodes, weights, parts, terms):
    """Log-integrals over the cells below t of message times (t - s)^(alpha - 1); returns how many these are.

    Of cells far from t by mean and variance, else by quadrature in two parts: from 0 in s^(power + 1), smooth there,
    and up to t in (t - s)^alpha.
    """
    num = min(np.searchsorted(grid, t), len(grid) - 1)
    second = (alpha - 1) * (alpha - 2) / 2
    top = -np.inf
    for j in range(num):
        low, width = grid[j], grid[j + 1] - grid[j]
        if masses[j] == -np.inf or (alpha > 1 and masses[j] + (alpha - 1) * np.log(t - low) < top - NEGLIGIBLE):
            terms[j] = -np.inf
        elif t - grid[j + 1] >= (4 + alpha) * width:
            away = t - means[j]
            terms[j] = masses[j] + (alpha - 1) * np.log(away) + np.log1p(second * variances[j] / (away * away))
        else:
            high, middle, count = min(grid[j + 1], t), low, 0
            if low == 0:
                middle, count = high / 2, len(nodes)
                for n in range(len(nodes)):
                    s = middle * nodes[n] ** (1 / (power + 1))
                    scale = (power + 1) * np.log(middle) + np.log(weights[n] / (power + 1))
                    parts[n] = scale + (alpha - 1) * np.log(t - s) + _log_at(s / width, logs[j], logs[j + 1])
            _piece(t, middle, high, low, width, logs[j], logs[j + 1], power, alpha, nodes, weights, parts[count:])
            terms[j] = _log_total(parts, count + len(nodes))
        top = max(top, terms[j])
    return num


@kernel
def _sums(here, grid, logs, masses, means, variances, power, alpha, nodes, weights, found):
    parts, terms = np.empty(2 * len(nodes)), np.empty(len(grid))
    for i in range(len(here)):
        num = _terms(here[i], grid, logs, masses, means, variances, power, alpha, nodes, weights, parts, terms)
        found[i] = _log_total(terms, num)


@kernel
def _cells(above, chance, grid, logs, masses, means, variances, power, alpha, nodes, weights, found):
    """The cells in which draws are, given uniform numbers."""
    parts, terms = np.empty(2 * len(nodes)), np.empty(len(grid))
    for i in range(len(above)):
        num = _terms(above[i], grid, logs, masses, means, variances, power, alpha, nodes, weights, parts, terms)
        total, summed = _log_total(terms, num), 0.0
        found[i] = max(num - 1, 0)
        for j in range(num):
            summed += np.exp(terms[j] - total)
            if summed > chance[i]:
                found[i] = j
                break


def _integral(grid: np.ndarray, density: np.ndarray) -> float:
    return float(np.trapezoid(density, grid))


def _moment(grid: np.ndarray, density: np.ndarray, centre: float, power: int) -> float:
    """Integral of (t - centre)^power, power 1 or 2, over a piecewise linear density: Simpson's rule is exact."""
    middle, half = (grid[1:] + grid[:-1]) / 2, (density[1:] + density[:-1]) / 2
    ends = density * (grid - centre) ** power
    return float(((ends[:-1] + ends[1:] + 4 * half * (middle - centre) ** power) / 6 * np.diff(grid)).sum())


def _quantile(grid: np.ndarray, density: np.ndarray, fraction: float) -> float:
    """The time below which `share` lies of a piecewise linear density."""
    masses = (density[1:] + density[:-1]) / 2 * np.diff(grid)
    summed = np.concatenate([[0.0], np.cumsum(masses)])
    goal = fraction * summed[-1]
    piece = int(np.clip(np.searchsorted(summed, goal, side="right") - 1, 0, len(masses) - 1))
    left, right, width, rest = density[piece], density[piece + 1], grid[piece + 1] - grid[piece], goal - summed[piece]
    # rest = left x + (right - left) x^2 / (2 width); this form of the root holds for right = left, too.
    root = np.sqrt(max(left**2 + 2 * (right - left) * rest / width, 0.0))
    step = 2 * rest / (left + root) if left + root > 0 else 0.0
    return float(grid[piece] + np.clip(step, 0.0, width))
