r"""The exact posterior of frame times, by the forward-backward algorithm on grids.

Given the splats, the likelihood factorizes over frames and the Dirichlet prior over increments: the times are a Markov
chain with transition densities $(t_{k+1} - t_k)^{\alpha - 1}$. Forward and backward passes over grids give all
marginals.

A forward message is stored as a logarithm relative to the prior: $\phi_k(t)$ is the mean of the likelihoods of the
frames up to k over the prior, conditional on frame k being at t. It is constant where frames carry no information, and

$$ \phi_{k+1}(t) = L_{k+1}(t) \, \mathbb{E}\, \phi_k(t B), \qquad B \sim \mathrm{Beta}(\alpha k, \alpha) $$

with times from the start of the run. Messages are constant in each cell of a grid; the Beta distribution is integrated
over the cells.
"""

import dataclasses

import numpy as np
from jaxtyping import Float64
from scipy.special import betainc, betaincc

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import check_within, invalid
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.posterior.increments import Increments

#: Cells per frame. Half of them have equal masses and half have equal widths.
CELLS = 200
#: Grids are adapted to the posterior at most so many times,
ROUNDS = 6
#: while a cell has a mass above this.
COARSE = 0.05
#: Outer cells with masses below this are dropped.
NEGLIGIBLE_MASS = 1e-13
#: Likelihoods this many nats below their maximum are dropped: they underflow in float64.
UNDERFLOW = 740.0


@dataclasses.dataclass(frozen=True)
class ExactPosterior:
    """Marginal posterior distributions of the free frames' times, and the evidence.

    `edges` and `masses`: for each free frame in order, the edges of cells in time and the probability of each cell.
    `log_evidence`: logarithm of the likelihood averaged over the prior, in nats, relative to the zero of the profiles.
    """

    increments: Increments
    edges: list[Float64[np.ndarray, " edges"]]
    masses: list[Float64[np.ndarray, " cells"]]
    log_evidence: float
    _forward: list[Float64[np.ndarray, " cells"]] = dataclasses.field(repr=False)

    def mean(self) -> Float64[np.ndarray, " num_frames"]:
        return self._fill(self.increments.held, lambda edges, masses: masses @ middles(edges))

    def std(self) -> Float64[np.ndarray, " num_frames"]:
        """Standard deviations; 0 for held frames."""

        def spread(edges: np.ndarray, masses: np.ndarray) -> float:
            places = middles(edges)
            return np.sqrt(masses @ (places - masses @ places) ** 2)

        return self._fill(np.zeros(self.increments.num_frames), spread)

    def quantile(self, probability: float) -> Float64[np.ndarray, " num_frames"]:
        """Quantiles of the times of all frames."""
        check_within("probability", probability, "[0, 1]", "a number in [0, 1]")
        return self._fill(self.increments.held, lambda edges, masses: np.interp(probability, sum_up(masses), edges))

    def interval(self, level: float = 0.95) -> tuple[Float64[np.ndarray, " num_frames"], ...]:
        """(low, high) of the central intervals that contain the probability `level`."""
        check_within("level", level, "[0, 1]", "a number in [0, 1]")
        return self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)

    def sample(self, num: int, seed: int = 0) -> Float64[np.ndarray, "num num_frames"]:
        """Independent draws from the joint posterior, by backward sampling."""
        rng, alpha = make_generator(Stream.POSTERIOR_DRAW, seed=seed), self.increments.concentration
        times = np.broadcast_to(self.increments.held, (num, self.increments.num_frames)).copy()
        which = {k: n for n, k in enumerate(np.flatnonzero(self.increments.free))}
        for first, last in self.increments.runs:
            start = self.increments.held[first - 1]
            for k in range(last, first - 1, -1):
                edges, message = self.edges[which[k]] - start, self._forward[which[k]]
                draws = start + _draw(edges, message, k - first + 1, alpha, times[:, k + 1] - start, rng)
                times[:, k] = np.maximum(np.minimum(draws, np.nextafter(times[:, k + 1], -np.inf)), start)
        return times

    def _fill(self, held: np.ndarray, statistic) -> np.ndarray:
        """A statistic of the marginals of the free frames, beside the values of the held ones."""
        found = np.array(held)
        found[self.increments.free] = [statistic(*each) for each in zip(self.edges, self.masses, strict=True)]
        return found


def exact_posterior(curves: ProfileCurves, increments: Increments) -> ExactPosterior:
    r"""Compute the exact posterior given likelihood curves, to the precision of grids of 200 cells.

    **Source:** forward-backward smoothing, e.g. Rabiner 1989, for a chain of continuous states. **Raises:** ValueError
    for curves of another number of frames, or NaN, and if the frames cannot be in order: of another video, or with too
    small a noise.

    **Example:** `exact_posterior(curves, Increments(np.linspace(0, 1, num_frames))).interval(0.9)`.
    """
    if curves.num_frames != increments.num_frames:
        got = f"{curves.num_frames} profiles, {increments.num_frames} times"
        raise invalid("curves", expected="as many as there are times", got=got)
    edges, masses, forward = [], [], []
    log_evidence = float(curves(increments.held)[~increments.free].sum())
    for first, last in increments.runs:
        ends = increments.held[first - 1], increments.held[last + 1]
        found = _solve_run(curves, range(first, last + 1), ends, increments.concentration)
        edges += found[0]
        masses += found[1]
        forward += found[2]
        log_evidence += found[3]
    return ExactPosterior(increments, edges, masses, log_evidence, forward)


def _solve_run(curves: ProfileCurves, frames: range, ends: tuple[float, float], alpha: float):
    """Grids, marginals, forward messages and the log-evidence of a run between two held times.

    Grids are adapted to the marginals of the previous pass.
    """
    edges = _trim([likelihood_cells(curves, k, *ends)[0] for k in frames])
    masses, *_ = _passes(curves, frames, edges, ends, alpha)
    for _ in range(ROUNDS):
        edges = _trim([divide(*each) for each in zip(edges, masses, strict=True)])
        masses, forward, log_evidence = _passes(curves, frames, edges, ends, alpha)
        if max(each.max() for each in masses) < COARSE:
            break
    return edges, masses, forward, log_evidence


def likelihood_cells(
    curves: ProfileCurves, k: int, start: float = 0.0, end: float = 1.0
) -> tuple[Float64[np.ndarray, " edges"], Float64[np.ndarray, " cells"]]:
    """Cells for the likelihood of frame k alone between two times, and their masses; likelihoods of 0 are left out."""
    nodes, _ = curves.nodes_and_values(k)
    low, high = max(start, nodes[0]), min(end, nodes[-1])
    if not low < high:
        got = f"frame {k} from {nodes[0]:.4g} to {nodes[-1]:.4g}, held between {start:.4g} and {end:.4g}"
        raise invalid("curves", expected="curves that extend between the held frames", got=got)
    edges = np.concatenate([[low], nodes[(nodes > low) & (nodes < high)], [high]])
    for _ in range(2):
        heights = curves[k](middles(edges)[:, None])[:, 0]
        if np.isnan(heights).any():
            raise invalid("curves", expected="log-likelihoods without NaN", got=f"NaN for frame {k}")
        some = np.flatnonzero(heights > heights.max() - UNDERFLOW)
        hull = slice(max(some[0] - 1, 0), some[-1] + 2)
        edges, heights = edges[hull.start : hull.stop + 1], heights[hull]
        edges = divide(edges, np.exp(heights - heights.max()) * np.diff(edges), 0.0)
    heights = curves[k](middles(edges)[:, None])[:, 0]
    return edges, np.exp(heights - heights.max()) * np.diff(edges)


def divide(
    edges: Float64[np.ndarray, " edges"], masses: Float64[np.ndarray, " cells"], negligible: float = NEGLIGIBLE_MASS
) -> Float64[np.ndarray, " edges"]:
    """Edges of new cells: half of them share the mass equally, half the range, without outer cells of no mass."""
    some = np.flatnonzero(masses >= negligible * masses.sum())
    hull = slice(max(some[0] - 1, 0), some[-1] + 2)
    edges, masses = edges[hull.start : hull.stop + 1], masses[hull]
    placed = masses / masses.sum() + np.diff(edges) / (edges[-1] - edges[0])
    return np.unique(np.interp(np.linspace(0, 2, CELLS + 1), sum_up(placed), edges))


def _trim(edges: list[np.ndarray]) -> list[np.ndarray]:
    """Leave out times at which a frame would be before an earlier one's grid or after a later one's."""
    lows = np.maximum.accumulate([each[0] for each in edges])
    highs = np.minimum.accumulate([each[-1] for each in edges[::-1]])[::-1]
    if not (lows < highs).all():
        raise _out_of_order()
    return [np.unique(each.clip(low, high)) for each, low, high in zip(edges, lows, highs, strict=True)]


def _passes(curves: ProfileCurves, frames: range, edges: list[np.ndarray], ends: tuple[float, float], alpha: float):
    """Marginals, forward messages and the log-evidence."""
    num, length = len(frames), ends[1] - ends[0]
    heights = [curves[k](middles(grid)[:, None])[:, 0] for k, grid in zip(frames, edges, strict=True)]
    since, until = [grid - ends[0] for grid in edges], [ends[1] - grid[::-1] for grid in edges]
    forward = [heights[0]]
    for n in range(1, num):
        forward.append(heights[n] + _predict(since[n - 1], forward[-1], n, alpha, middles(since[n])))
    log_evidence = float(_predict(since[-1], forward[-1], num, alpha, np.array([length]))[0])
    # A backward pass is a forward pass in reversed time.
    backward = [np.zeros(len(heights[-1]))]
    for n in range(num - 2, -1, -1):
        message = heights[n + 1][::-1] + backward[-1]
        backward.append(_predict(until[n + 1], message, num - 1 - n, alpha, middles(until[n])))
    masses = []
    for n, message in enumerate(backward[::-1]):
        before, after = np.log(middles(since[n])), np.log(middles(until[n])[::-1])
        prior = (alpha * (n + 1) - 1) * before + (alpha * (num - n) - 1) * after + np.log(np.diff(since[n]))
        logs = forward[n] + message[::-1] + prior
        if not logs.max() > -np.inf:
            raise _out_of_order()
        masses.append(np.exp(logs - _log_sum(logs)))
    return masses, forward, log_evidence


def _out_of_order() -> ValueError:
    cure = "The frames are out of order or of another video, the noise is too small, or the concentration too large."
    return invalid("curves", expected="likely times that increase", got="some that cannot", cure=cure)


def _predict(edges: np.ndarray, message: np.ndarray, gaps: int, alpha: float, times: np.ndarray) -> np.ndarray:
    """Log of the mean of exp(message) at `times` B for B of Beta(alpha gaps, alpha): the predicted message."""
    return _log_sum(message + _log_weights(edges, gaps, alpha, times))


def _log_weights(edges: np.ndarray, gaps: int, alpha: float, times: np.ndarray) -> Float64[np.ndarray, "times cells"]:
    """Log of the prior probabilities of cells, given that the next frame is at each of `times`."""
    fraction = np.minimum(edges / times[:, None], 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        if alpha == 1:
            below = gaps * np.log(fraction)
            inside = below[:, 1:] + np.log(-np.expm1(below[:, :-1] - below[:, 1:]))
        else:  # from the tail that is smaller, whose differences are precise
            below = betainc(alpha * gaps, alpha, fraction)
            upper = below[:, 1:] >= 0.5
            at_upper = np.pad(upper, ((0, 0), (0, 1))) | np.pad(upper, ((0, 0), (1, 0)))
            above = np.zeros_like(below)
            above[at_upper] = betaincc(alpha * gaps, alpha, fraction[at_upper])
            inside = np.log(np.where(upper, -np.diff(above), np.diff(below)))
    return np.where(np.isnan(inside), -np.inf, inside)


def _log_sum(logs: np.ndarray) -> np.ndarray:
    """log-sum-exp over the last axis."""
    top = np.maximum(logs.max(-1), -np.finfo(float).max)
    with np.errstate(divide="ignore"):
        return top + np.log(np.exp(logs - top[..., None]).sum(-1))


def _draw(
    edges: np.ndarray, message: np.ndarray, gaps: int, alpha: float, above: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Draw times below `above` (num,), given what the frames up to this one tell."""
    logs = message + _log_weights(edges, gaps, alpha, above)
    summed = np.cumsum(np.exp(logs - logs.max(1, keepdims=True)), axis=1)
    chance = rng.random((2, len(above)))
    cell = (summed < chance[0, :, None] * summed[:, -1:]).sum(1)
    low, high = edges[cell], np.minimum(edges[cell + 1], above)
    # Within the cell by the prior's power of the time, in units of the upper end, so that it does not underflow.
    power = alpha * gaps
    least = (low / high) ** power
    return high * (least + chance[1] * (1 - least)) ** (1 / power)


def middles(edges: Float64[np.ndarray, " edges"]) -> Float64[np.ndarray, " cells"]:
    return (edges[1:] + edges[:-1]) / 2


def sum_up(masses: Float64[np.ndarray, " cells"]) -> Float64[np.ndarray, " edges"]:
    """Cumulative masses at the edges."""
    return np.concatenate([[0.0], np.cumsum(masses)])
