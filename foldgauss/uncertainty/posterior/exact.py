r"""The exact posterior of frame times, by the forward-backward algorithm on grids.

Given the splats, the likelihood factorizes over frames and the Dirichlet prior over increments: the times are a Markov
chain with transition densities $(t_{k+1} - t_k)^{\alpha - 1}$. Forward and backward passes over grids give all
marginals.

A forward message is stored as a logarithm relative to the prior: $\phi_k(t)$ is the mean of the likelihoods of the
frames up to k over the prior, conditional on frame k being at t. It is constant where frames carry no information, and

$$ \phi_{k+1}(t) = L_{k+1}(t) \, \mathbb{E}\, \phi_k(t B), \qquad B \sim \mathrm{Beta}(\alpha k, \alpha) $$

with times from the start of the run. Between grid points, logarithms are linear.
"""

import dataclasses

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaln

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import invalid, is_within
from foldgauss._runtime.kernels import inline, kernel
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.posterior.increments import Increments

#: Grid points per interval between nodes of a profile, where it is within NEAR nats of its maximum.
FINER, NEAR = 8, 30.0
#: Cells of a frame's grid have at most 1 / POINTS of its mass and at most WIDTH standard deviations; outer cells with
#: a mass below NEGLIGIBLE_MASS are dropped.
POINTS, WIDTH, NEGLIGIBLE_MASS = 300, 1 / 12, 1e-13
#: Points of the initial grids; grids are refined, at most ROUNDS times, while a cell has a mass above COARSE.
FIRST, ROUNDS, COARSE = 400, 6, 0.1
#: Grids are graded towards held times where the density is infinite: number of halvings, and points per halving.
HALVINGS, STEPS = 40, 4
#: Grids are refined at the means of frames at most AROUND away whose spread is below NARROW of the frame's own: its
#: density may be infinite, or discontinuous, there.
NARROW, AROUND = 0.1, 5
#: Likelihoods this many nats below their maximum underflow in float64.
UNDERFLOW = 740.0
#: Cells whose log-integral is this much below another's are omitted from sums.
NEGLIGIBLE = 40.0
#: Rejection sampling within a cell: number of proposals, after which the last is accepted.
MAX_PROPOSALS = 1000
#: Gauss-Legendre quadrature on [0, 1].
_NODES, _WEIGHTS = (np.polynomial.legendre.leggauss(8)[0] + 1) / 2, np.polynomial.legendre.leggauss(8)[1] / 2


@dataclasses.dataclass(frozen=True)
class ExactPosterior:
    """Marginal posterior densities of the free frames' times, and the evidence.

    `grids` and `densities`: for each free frame in order, times and the posterior density there.
    `log_evidence`: logarithm of the likelihood averaged over the prior, in nats, relative to the zero of the profiles.
    """

    increments: Increments
    grids: list[Float64[np.ndarray, " points"]]
    densities: list[Float64[np.ndarray, " points"]]
    log_evidence: float
    _forward: list[Float64[np.ndarray, " points"]] = dataclasses.field(repr=False)

    def mean(self) -> Float64[np.ndarray, " num_frames"]:
        return self._filled([_moment(*each, 0.0, 1) for each in zip(self.grids, self.densities, strict=True)])

    def std(self) -> Float64[np.ndarray, " num_frames"]:
        """Standard deviations; 0 for held frames."""
        found = np.zeros(self.increments.num_frames)
        means = self.mean()[self.increments.free]
        pairs = zip(self.grids, self.densities, means, strict=True)
        found[self.increments.free] = [np.sqrt(_moment(grid, density, mean, 2)) for grid, density, mean in pairs]
        return found

    def quantile(self, probability: float) -> Float64[np.ndarray, " num_frames"]:
        """Quantiles of the times of all frames."""
        if not 0 <= probability <= 1:
            raise invalid("probability", expected="a number in [0, 1]", got=probability)
        return self._filled([_quantile(*each, probability) for each in zip(self.grids, self.densities, strict=True)])

    def interval(self, level: float = 0.95) -> tuple[Float64[np.ndarray, " num_frames"], ...]:
        """(low, high) of the central intervals that contain the probability `level`."""
        if not is_within(level, "[0, 1]"):
            raise invalid("level", expected="a number in [0, 1]", got=level)
        return self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)

    def sample(self, num: int, seed: int = 0) -> Float64[np.ndarray, "num num_frames"]:
        """Independent draws from the joint posterior, by backward sampling."""
        rng, alpha = make_generator(Stream.POSTERIOR_DRAW, seed=seed), self.increments.concentration
        times = np.broadcast_to(self.increments.held, (num, self.increments.num_frames)).copy()
        which = {k: n for n, k in enumerate(np.flatnonzero(self.increments.free))}
        for first, last in self.increments.runs:
            start = self.increments.held[first - 1]
            for k in range(last, first - 1, -1):
                message = _Message(self.grids[which[k]] - start, self._forward[which[k]], k - first + 1, alpha)
                draws = start + message.draw(times[:, k + 1] - start, rng)
                times[:, k] = np.maximum(np.minimum(draws, np.nextafter(times[:, k + 1], -np.inf)), start)
        return times

    def _filled(self, values) -> np.ndarray:
        found = self.increments.held.copy()
        found[self.increments.free] = values
        return found


def exact_posterior(curves: ProfileCurves, increments: Increments) -> ExactPosterior:
    r"""Compute the exact posterior given likelihood curves, to the precision of grids of some 300 to 800 points.

    **Precision:** means and 5% quantiles to 5e-3 standard deviations, standard deviations to a relative 3e-3, the
    evidence to 1e-2 nats for a hundred frames; for concentrations from 0.2 to 20, and likelihoods from flat to much
    narrower than the distance of frames. Worst for the smallest concentrations, whose densities are infinite beside
    frames with narrow likelihoods.
    **Cost:** for n frames, O(n) grids at concentration 1, else about n 500^2 powers.
    **Raises:** ValueError if no ordered times have positive likelihood, that is, if the likelihoods of frames exceed
    exp(-740) of their maxima only in the wrong order; NaN in the curves.
    """
    grids, densities, forwards, log_evidence = [], [], [], 0.0
    for first, last in increments.runs:
        ends = increments.held[first - 1], increments.held[last + 1]
        found = _solve_run(curves, range(first, last + 1), ends, increments.concentration)
        grids += found[0]
        densities += found[1]
        forwards += found[2]
        log_evidence += found[3]
    held = ~increments.free
    log_evidence += float(curves(increments.held)[held].sum())
    return ExactPosterior(increments, grids, densities, log_evidence, forwards)


def _solve_run(curves: ProfileCurves, frames: range, ends: tuple[float, float], alpha: float):
    """Grids, marginal densities, forward messages and the log-evidence of a run between two held times.

    Grids are adapted to the densities of the previous pass.
    """
    grids = []
    for n, k in enumerate(frames):
        grid = _thin(curves, k, profile_grid(curves, k, *ends, finer=2))
        grids.append(_grade(grid, ends, alpha * (n + 1) < 1, alpha * (len(frames) - n) < 1))
    densities, *_ = _passes(curves, frames, grids, ends, alpha)
    for _ in range(ROUNDS):
        refined = [_refine(*each) for each in zip(grids, densities, strict=True)]
        coarse = [each[1] for each in refined]
        grids = _refine_at_narrow_frames(grids, densities, [each[0] for each in refined], alpha)
        densities, forward, log_evidence = _passes(curves, frames, grids, ends, alpha)
        if max(coarse) < COARSE:
            break
    return grids, densities, forward, log_evidence


def _thin(curves: ProfileCurves, k: int, grid: np.ndarray) -> np.ndarray:
    """About FIRST points of a grid: half of them by the change of the likelihood, half by time."""
    if len(grid) <= FIRST:
        return grid
    heights = _on_grid(curves, k, grid)
    change = np.abs(np.diff(np.exp(heights - heights.max())))
    time = np.diff(grid) / (grid[-1] - grid[0])
    passed = np.concatenate([[0.0], np.cumsum(time + change / max(change.sum(), 1.0))])
    return grid[np.unique(np.searchsorted(passed, np.linspace(0, passed[-1], FIRST)).clip(0, len(grid) - 1))]


def _grade(grid: np.ndarray, ends: tuple[float, float], at_start: bool, at_end: bool) -> np.ndarray:
    """Subdivide the cell beside a held time geometrically, if requested and if the grid extends to it."""
    halves = 0.5 ** (np.arange(STEPS * HALVINGS, 0, -1) / STEPS)
    parts = [grid]
    if at_start and grid[0] == ends[0]:
        parts.append(grid[0] + (grid[1] - grid[0]) * halves)
    if at_end and grid[-1] == ends[1]:
        parts.append(grid[-1] - (grid[-1] - grid[-2]) * halves)
    return np.unique(np.concatenate(parts))


def _refine(grid: np.ndarray, density: np.ndarray) -> tuple[np.ndarray, float]:
    """The part of a grid with mass, subdivided so that no cell has much of it or is wide; and the largest cell mass."""
    mass = (density[1:] + density[:-1]) / 2 * np.diff(grid)
    mass = mass / mass.sum()
    some = np.flatnonzero(mass > NEGLIGIBLE_MASS)
    first, last = max(some[0] - 1, 0), min(some[-1] + 1, len(mass) - 1)
    spread = np.sqrt(_moment(grid, density, _moment(grid, density, 0.0, 1), 2))
    cuts = np.ceil(np.maximum(POINTS * mass, np.diff(grid) / (WIDTH * spread))).astype(int)
    return np.unique(_cut(grid[first : last + 2], cuts[first : last + 1])), float(mass.max())


def _refine_at_narrow_frames(
    grids: list[np.ndarray], densities: list[np.ndarray], refined: list[np.ndarray], alpha: float
) -> list[np.ndarray]:
    """Add geometrically spaced points to the `refined` grids around the means of nearby frames of much smaller spread.

    For concentrations below 2: after a frame of known time the density of the j-th next frame is the power
    alpha j - 1 of the distance.
    """
    if alpha >= 2:
        return refined
    means = [_moment(grid, density, 0.0, 1) for grid, density in zip(grids, densities, strict=True)]
    moments = zip(grids, densities, means, strict=True)
    spreads = [np.sqrt(_moment(grid, density, mean, 2)) for grid, density, mean in moments]
    reach, found = min(max(int(1 / alpha), 1), AROUND), []
    for n, points in enumerate(refined):
        parts = [points]
        for j in range(max(n - reach, 0), min(n + reach + 1, len(refined))):
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
        forward.append(heights[n] + _check_positive(message.predict(grids[n] - ends[0]), frames[n]))
    last = _Message(grids[-1] - ends[0], forward[-1], num, alpha)
    log_evidence = float(_check_positive(last.predict(np.array([length])), frames[-1])[0])
    # A backward pass is a forward pass in reversed time.
    backward = [np.zeros_like(grids[-1])]
    for n in range(num - 2, -1, -1):
        logs = (heights[n + 1] + backward[-1])[::-1]
        message = _Message(ends[1] - grids[n + 1][::-1], logs, num - 1 - n, alpha)
        backward.append(_check_positive(message.predict(ends[1] - grids[n][::-1])[::-1], frames[n]))
    densities = []
    for n, (grid, one, other) in enumerate(zip(grids, forward, reversed(backward), strict=True)):
        shapes = alpha * (n + 1), alpha * (num - n)
        densities.append(_density(grid, _check_positive(one + other, frames[n]), ends, shapes))
    return densities, forward, log_evidence


def _check_positive(logs: np.ndarray, k: int) -> np.ndarray:
    """The logarithms, if any is that of a positive number; else raise ValueError."""
    if logs.max() == -np.inf:
        cure = "The frames are out of order or of another video, or the noise is too small."
        raise invalid(
            "video",
            expected="frames in the model's order",
            got=f"no time for frame {k} after the one before",
            cure=cure,
        )
    return logs


def _density(
    grid: np.ndarray, messages: np.ndarray, ends: tuple[float, float], shapes: tuple[float, float]
) -> np.ndarray:
    """A marginal: exp(messages) times the prior's Beta density of these shapes between the ends."""
    since, until = grid - ends[0], ends[1] - grid
    with np.errstate(divide="ignore", invalid="ignore"):
        since, until = ((shape - 1) * np.log(away) if shape != 1 else 0.0 for shape, away in
                        zip(shapes, (since, until), strict=True))  # fmt: skip
        logs = messages + since + until
    finite = np.where(logs < np.inf, logs, -np.inf)
    density = np.exp(finite - finite.max())
    # At an end where the density is infinite or has infinite slope: the value that gives the cell its integral.
    for end, inner, shape in ((0, 1, shapes[0]), (-1, -2, shapes[1])):
        if grid[end] == ends[end] and shape < 2 and shape != 1 and np.isfinite(messages[end]):
            density[end] = density[inner] * (2 / shape - 1)
    return density / float(np.trapezoid(density, grid))


def profile_grid(
    curves: ProfileCurves, k: int, start: float, end: float, finer: int = FINER
) -> Float64[np.ndarray, " points"]:
    """Times from `start` to `end` with the density of frame k's nodes, and `finer` times that near its maximum."""
    nodes, _ = curves.nodes_and_values(k)
    low, high = max(start, nodes[0]), min(end, nodes[-1])
    if not low < high:
        got = f"frame {k} from {nodes[0]:.4g} to {nodes[-1]:.4g}, held between {start:.4g} and {end:.4g}"
        raise invalid("curves", expected="curves that extend between the held frames", got=got)
    inside = (nodes > low) & (nodes < high)
    here = np.concatenate([[low], nodes[inside], [high]])
    heights = curves[k](here[:, None])[:, 0]
    if np.isnan(heights).any():
        raise invalid("curves", expected="log-likelihoods without NaN", got=f"NaN for frame {k}")
    some = np.flatnonzero(heights > heights.max() - UNDERFLOW)
    hull = slice(max(some[0] - 1, 0), some[-1] + 2)
    here, heights = here[hull], heights[hull]
    near = heights > heights.max() - NEAR
    return _cut(here, np.where(near[:-1] | near[1:], finer, 1))


def _cut(grid: np.ndarray, cuts: np.ndarray) -> np.ndarray:
    """A grid with each of its cells divided into a number of equal parts."""
    number = np.arange(cuts.sum()) - np.repeat(np.cumsum(cuts) - cuts, cuts)
    points = np.repeat(grid[:-1], cuts) + number * np.repeat(np.diff(grid) / cuts, cuts)
    return np.concatenate([points, grid[-1:]])


def _on_grid(curves: ProfileCurves, k: int, grid: np.ndarray) -> np.ndarray:
    return curves[k](grid[:, None])[:, 0]


class _Message:
    """exp(logs) on a grid of times since the start of a run, multiplied by the prior density of these times.

    The prior is t^(alpha gaps - 1), the density of a sum of `gaps` increments, up to a factor.
    """

    def __init__(self, grid: np.ndarray, logs: np.ndarray, gaps: int, alpha: float):
        self.grid, self.logs, self.gaps, self.alpha = grid, np.ascontiguousarray(logs), gaps, alpha
        self.power = alpha * gaps - 1
        cells = np.arange(len(grid) - 1)
        points, heights = self._quadrature(cells, np.ones(len(cells)))
        self.masses = _log_sum(heights)
        with np.errstate(invalid="ignore"):
            weights = np.nan_to_num(np.exp(heights - self.masses[:, None]))
        self.means = (weights * (points - grid[:-1, None])).sum(1)
        self.variances = (weights * (points - grid[:-1, None] - self.means[:, None]) ** 2).sum(1)
        self.means += grid[:-1]
        self.summed = np.concatenate([[-np.inf], np.logaddexp.accumulate(self.masses)])

    def predict(self, here: np.ndarray) -> np.ndarray:
        """Log of the mean of exp(logs) at times `here` B, for B of Beta(alpha gaps, alpha): the predicted message."""
        if self.alpha == 1:
            cell, fraction = self._locate(here)
            found = np.logaddexp(self.summed[cell], _log_sum(self._quadrature(cell, fraction)[1]))
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
        """Draw times below `above` (num,), of densities proportional to the message times (above - t)^(alpha - 1)."""
        chance = rng.random(len(above))
        if self.alpha == 1:
            cell, fraction = self._locate(above)
            goal = np.log(chance) + np.logaddexp(self.summed[cell], _log_sum(self._quadrature(cell, fraction)[1]))
            cell = np.minimum(np.searchsorted(self.summed, goal, side="right") - 1, cell)
        else:
            cell = np.empty(len(above), np.int64)
            _cells(above, chance, *self._tables(), cell)
        low, high = self.grid[cell], np.minimum(self.grid[cell + 1], above)
        found, waiting = high.copy(), np.flatnonzero(high > low)
        for _ in range(MAX_PROPOSALS):
            if not len(waiting):
                break
            found[waiting], kept = self._propose(cell[waiting], low[waiting], high[waiting], above[waiting], rng)
            waiting = waiting[~kept]
        return found

    def _propose(self, cell, low, high, above, rng) -> tuple[np.ndarray, np.ndarray]:
        """Proposals in cells, between `low` and `high`, and whether to accept them (rejection sampling)."""
        alpha, power, num = self.alpha, self.power, len(cell)
        chance, threshold = rng.random(num), np.log(rng.random(num))
        # Proposed by the power of the distance to `above`, which may be singular; the rest is smooth unless low is 0.
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

    def _locate(self, above: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The cells that contain times, and the fraction of these below them; beyond the grid: all of the last cell."""
        cell = np.clip(np.searchsorted(self.grid, above, side="left") - 1, 0, len(self.grid) - 2)
        fraction = (above - self.grid[cell]) / (self.grid[cell + 1] - self.grid[cell])
        return cell, np.clip(fraction, 0.0, 1.0)

    def _quadrature(self, cell: np.ndarray, fraction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Quadrature points in the first `fraction` of cells, and the logarithm of each term of the integral."""
        low, width = self.grid[cell][:, None], np.diff(self.grid)[cell][:, None] * fraction[:, None]
        first = low == 0
        inside = np.where(first, _NODES ** (1 / (self.power + 1)), _NODES)
        points = low + width * inside
        with np.errstate(divide="ignore", invalid="ignore"):
            measure = np.where(
                first,
                (self.power + 1) * np.log(width) - np.log(self.power + 1),
                np.log(width) + self.power * np.log(points),
            )
            logs = _between(self.logs[cell][:, None], self.logs[cell + 1][:, None], fraction[:, None] * inside)
        return points, logs + measure + np.log(_WEIGHTS)

    def _tables(self) -> tuple:
        tables = self.grid, self.logs, self.masses, self.means, self.variances
        return *tables, float(self.power), float(self.alpha), _NODES, _WEIGHTS


def _between(left: np.ndarray, right: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Linear interpolation of logarithms; where one of the two is -inf, that of their exponentials."""
    logs = left * (1 - fraction) + right * fraction
    logs = np.where(left == -np.inf, right + np.log(fraction), logs)
    logs = np.where(right == -np.inf, left + np.log1p(-fraction), logs)
    return np.where((left == -np.inf) & (right == -np.inf), -np.inf, logs)


def _log_sum(logs: np.ndarray) -> np.ndarray:
    """log-sum-exp over the last axis."""
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
    """Logarithms of the quadrature terms over [low, high] of the message times (t - s)^(alpha - 1)."""
    near, far = (t - high) ** alpha, (t - low) ** alpha
    for n in range(len(nodes)):
        if alpha < 1:  # substitute (t - s)^alpha, which removes the singularity
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
    """Log-integrals over the cells below t of the message times (t - s)^(alpha - 1); returns their number.

    Cells far from t use a second-order expansion about their mean; others quadrature in two parts, with the
    substitutions s^(power + 1) near 0 and (t - s)^alpha near t, which remove the singularities.
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
    """The cells that contain draws, given uniform numbers `chance`."""
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


def _moment(grid: np.ndarray, density: np.ndarray, center: float, power: int) -> float:
    """Integral of (t - center)^power, power 1 or 2, over a piecewise linear density: Simpson's rule is exact."""
    middle, half = (grid[1:] + grid[:-1]) / 2, (density[1:] + density[:-1]) / 2
    ends = density * (grid - center) ** power
    return float(((ends[:-1] + ends[1:] + 4 * half * (middle - center) ** power) / 6 * np.diff(grid)).sum())


def _quantile(grid: np.ndarray, density: np.ndarray, probability: float) -> float:
    """A quantile of a piecewise linear density."""
    masses = (density[1:] + density[:-1]) / 2 * np.diff(grid)
    summed = np.concatenate([[0.0], np.cumsum(masses)])
    goal = probability * summed[-1]
    piece = int(np.clip(np.searchsorted(summed, goal, side="right") - 1, 0, len(masses) - 1))
    left, right, width, rest = density[piece], density[piece + 1], grid[piece + 1] - grid[piece], goal - summed[piece]
    # rest = left x + (right - left) x^2 / (2 width); this form of the root holds for right = left, too.
    root = np.sqrt(max(left**2 + 2 * (right - left) * rest / width, 0.0))
    step = 2 * rest / (left + root) if left + root > 0 else 0.0
    return float(grid[piece] + np.clip(step, 0.0, width))
