r"""The exact posterior of frame times, by the forward-backward algorithm on grids.

Given the splats, the likelihood factorizes over frames and the Dirichlet prior over increments: the times are a Markov
chain with transition densities $(t_{k+1} - t_k)^{\alpha - 1}$. Forward and backward passes over grids give all
marginals.

A forward message is stored as a logarithm relative to the prior: $\phi_k(t)$ is the mean of the likelihoods of the
frames up to k over the prior, conditional on frame k being at t. It is constant where frames carry no information, and

$$ \phi_{k+1}(t) = L_{k+1}(t) \, \mathbb{E}\, \phi_k(t B), \qquad B \sim \mathrm{Beta}(\alpha k, \alpha) $$

Messages are constant in each cell of a grid; the Beta distribution is integrated over the cells.
"""

import dataclasses

import numpy as np
from jaxtyping import Float64
from scipy.special import betainc, betaincc, logsumexp

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import check_within, invalid, require
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.posterior.log_prob import check_prior

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
    """Marginal posterior distributions of the frame times, and the evidence.

    `edges` and `masses`: for each frame but the first and the last, the edges of cells in time and the probability of
    each cell. `log_evidence`: logarithm of the likelihood averaged over the prior, in nats, relative to the zero of the
    profiles.
    """

    concentration: float
    edges: list[Float64[np.ndarray, " edges"]]
    masses: list[Float64[np.ndarray, " cells"]]
    log_evidence: float
    _forward: list[Float64[np.ndarray, " cells"]] = dataclasses.field(repr=False)

    def mean(self) -> Float64[np.ndarray, " num_frames"]:
        return self._collect(0.0, lambda edges, masses: masses @ middles(edges), 1.0)

    def std(self) -> Float64[np.ndarray, " num_frames"]:
        """Standard deviations; 0 for the first and the last frame."""

        def spread(edges: np.ndarray, masses: np.ndarray) -> float:
            places = middles(edges)
            return np.sqrt(masses @ (places - masses @ places) ** 2)

        return self._collect(0.0, spread, 0.0)

    def quantile(self, probability: float) -> Float64[np.ndarray, " num_frames"]:
        """Quantiles of the times of all frames."""
        check_within("probability", probability, "[0, 1]", "a number in [0, 1]")
        return self._collect(0.0, lambda edges, masses: np.interp(probability, sum_up(masses), edges), 1.0)

    def interval(self, level: float = 0.95) -> tuple[Float64[np.ndarray, " num_frames"], ...]:
        """(low, high) of the central intervals that contain the probability `level`."""
        check_within("level", level, "[0, 1]", "a number in [0, 1]")
        return self.quantile((1 - level) / 2), self.quantile((1 + level) / 2)

    def sample(self, num: int, seed: int = 0) -> Float64[np.ndarray, "num num_frames"]:
        """Independent draws from the joint posterior, by backward sampling."""
        rng = make_generator(Stream.POSTERIOR_DRAW, seed=seed)
        times = np.zeros((num, len(self.edges) + 2))
        times[:, -1] = 1.0
        for k in range(len(self.edges), 0, -1):
            draws = _draw(self.edges[k - 1], self._forward[k - 1], k, self.concentration, times[:, k + 1], rng)
            times[:, k] = np.maximum(np.minimum(draws, np.nextafter(times[:, k + 1], -np.inf)), 0.0)
        return times

    def _collect(self, first: float, statistic, last: float) -> Float64[np.ndarray, " num_frames"]:
        """A statistic of the marginals, between the values of the first and the last frame."""
        inner = [statistic(*each) for each in zip(self.edges, self.masses, strict=True)]
        return np.array([first, *inner, last])


def exact_posterior(curves: ProfileCurves, concentration: float = 1.0) -> ExactPosterior:
    r"""Compute the exact posterior given likelihood curves, to the precision of grids of 200 cells.

    The first frame is at time 0 and the last at 1. The increments have a Dirichlet prior of `concentration` >= 1. Grids
    are adapted to the marginals of the previous pass.

    **Source:** forward-backward smoothing, e.g. Rabiner 1989, for a chain of continuous states. **Raises:** ValueError
    for curves with NaN, and if the frames cannot be in order: of another video, or with too small a noise.

    **Example:** `exact_posterior(curves).interval(0.9)`.
    """
    check_prior(curves.num_frames, concentration)
    edges = _trim([likelihood_cells(curves, k)[0] for k in range(1, curves.num_frames - 1)])
    masses, *_ = _passes(curves, edges, concentration)
    for _ in range(ROUNDS):
        edges = _trim([divide(*each) for each in zip(edges, masses, strict=True)])
        masses, forward, log_evidence = _passes(curves, edges, concentration)
        if max(each.max() for each in masses) < COARSE:
            break
    log_evidence += float(curves[0]([0.0])[0] + curves[-1]([1.0])[0])
    return ExactPosterior(concentration, edges, masses, log_evidence, forward)


def likelihood_cells(
    curves: ProfileCurves, k: int
) -> tuple[Float64[np.ndarray, " edges"], Float64[np.ndarray, " cells"]]:
    """Cells for the likelihood of frame k alone in [0, 1], and their masses; likelihoods of 0 are left out."""
    nodes, _ = curves.nodes_and_values(k)
    low, high = max(0.0, nodes[0]), min(1.0, nodes[-1])
    require(
        low < high,
        "curves",
        expected="curves that extend between 0 and 1",
        got=f"frame {k} from {nodes[0]:.4g} to {nodes[-1]:.4g}",
    )
    edges = np.concatenate([[low], nodes[(nodes > low) & (nodes < high)], [high]])
    for _ in range(2):
        heights = curves[k](middles(edges)[:, None])[:, 0]
        require(not np.isnan(heights).any(), "curves", expected="log-likelihoods without NaN", got=f"NaN for frame {k}")
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


def _passes(curves: ProfileCurves, edges: list[np.ndarray], alpha: float):
    """Marginals, forward messages and the log-evidence of the frames between the first and the last."""
    num = len(edges)
    heights = [curves[k + 1](middles(grid)[:, None])[:, 0] for k, grid in enumerate(edges)]
    until = [1.0 - grid[::-1] for grid in edges]
    forward = [heights[0]]
    for n in range(1, num):
        forward.append(heights[n] + _predict(edges[n - 1], forward[-1], n, alpha, middles(edges[n])))
    log_evidence = float(_predict(edges[-1], forward[-1], num, alpha, np.ones(1))[0])
    # A backward pass is a forward pass in reversed time.
    backward = [np.zeros(len(heights[-1]))]
    for n in range(num - 2, -1, -1):
        message = heights[n + 1][::-1] + backward[-1]
        backward.append(_predict(until[n + 1], message, num - 1 - n, alpha, middles(until[n])))
    masses = []
    for n, message in enumerate(backward[::-1]):
        before, after = np.log(middles(edges[n])), np.log(middles(until[n])[::-1])
        prior = (alpha * (n + 1) - 1) * before + (alpha * (num - n) - 1) * after + np.log(np.diff(edges[n]))
        logs = forward[n] + message[::-1] + prior
        if not logs.max() > -np.inf:
            raise _out_of_order()
        masses.append(np.exp(logs - logsumexp(logs)))
    return masses, forward, log_evidence


def _out_of_order() -> ValueError:
    cure = "The frames are out of order or of another video, the noise is too small, or the concentration too large."
    return invalid("curves", expected="likely times that increase", got="some that cannot", cure=cure)


def _predict(edges: np.ndarray, message: np.ndarray, gaps: int, alpha: float, times: np.ndarray) -> np.ndarray:
    """Log of the mean of exp(message) at `times` B for B of Beta(alpha gaps, alpha): the predicted message."""
    return logsumexp(message + _log_weights(edges, gaps, alpha, times), axis=1)


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
