"""An emcee move that updates one frame after the other; moves of all frames at once mix far worse (`notes`)."""

import numpy as np
from emcee.moves import Move
from emcee.state import State

from foldgauss._runtime.kernels import inline, kernel
from foldgauss.uncertainty.likelihood.profile_curves import piece_of, value_at
from foldgauss.uncertainty.posterior.exact import likelihood_cells, sum_up
from foldgauss.uncertainty.posterior.log_prob import FrameTimeLogProb

#: A frame is not updated if its likelihood between its neighbors is below this fraction of the whole (rounding).
LEAST_MASS = 1e-9
#: The least difference of two times: float64 does not resolve smaller ones.
LEAST_GAP = 1e-14


class FrameSweep(Move):
    r"""A Gibbs sweep: first the even frames, then the odd ones, which are independent given their neighbors.

    Each time is proposed from its own likelihood between its neighbors' times, which is approximated as constant in
    each cell of a grid, and accepted by the ratio to the exact density. So a frame moves between modes of its
    likelihood at any distance.

    **Source:** Metropolis within Gibbs, Tierney 1994.
    """

    def __init__(self, log_prob: FrameTimeLogProb):
        self.log_prob, self.frames = log_prob, np.arange(1, log_prob.num_free + 1)
        cells = [likelihood_cells(log_prob.curves, k) for k in self.frames]
        self._count = np.array([len(edges) for edges, _ in cells])
        self._edges, self._summed = np.zeros((2, len(cells), self._count.max()))
        for n, (edges, masses) in enumerate(cells):
            self._edges[n, : len(edges)], self._summed[n, : len(edges)] = edges, sum_up(masses)

    def propose(self, model, state: State) -> tuple[State, np.ndarray]:
        """One sweep of all walkers; a walker's acceptance is the fraction of its frames that moved."""
        times = self.log_prob.times(state.coords)
        curves, alpha = self.log_prob.curves, self.log_prob.concentration
        chance = model.random.random_sample((2, *state.coords.shape))
        moved = np.zeros(len(times))
        for parity in (0, 1):
            which = np.flatnonzero(self.frames % 2 == parity)
            moved += _update(
                times, which, self.frames, self._edges, self._summed, self._count, chance[0], np.log(chance[1]), alpha,
                curves.nodes, curves.values, curves.slopes, curves.count,
            )  # fmt: skip
        free = times[:, self.frames]
        return State(free, log_prob=model.compute_log_prob_fn(free)[0]), moved / len(self.frames)


@inline
def _interpolate(x, knots, values, last):
    low = piece_of(x, knots, last)
    high = low + 1
    return values[low] + (values[high] - values[low]) * (x - knots[low]) / (knots[high] - knots[low])


@inline
def _log_density(t, edges, summed, last):
    """Log of the proposal's density up to a constant."""
    low = piece_of(t, edges, last)
    high = low + 1
    return np.log((summed[high] - summed[low]) / (edges[high] - edges[low]))


@kernel
def _update(times, which, frames, edges, summed, cells, chance, threshold, alpha, nodes, values, slopes, count):
    """Propose each of the frames `which` of each walker between its neighbors; returns how many of each moved."""
    moved = np.zeros(len(times))
    for i in range(len(which)):
        n = which[i]
        k, knots, sums, last = frames[n], edges[n], summed[n], cells[n] - 1
        for walker in range(len(times)):
            start, now, end = times[walker, k - 1], times[walker, k], times[walker, k + 1]
            low = _interpolate(max(start, knots[0]), knots, sums, last)
            high = _interpolate(min(end, knots[last]), knots, sums, last)
            if not (high - low > LEAST_MASS * sums[last] and knots[0] < now and now < knots[last]):
                continue
            new = _interpolate(low + (high - low) * chance[walker, n], sums, knots, last)
            if not (new > start + LEAST_GAP and new < end - LEAST_GAP):
                continue
            change = value_at(new, nodes[k], values[k], slopes[k], count[k] - 1)
            change -= value_at(now, nodes[k], values[k], slopes[k], count[k] - 1)
            change += _log_density(now, knots, sums, last) - _log_density(new, knots, sums, last)
            change += (alpha - 1) * (np.log(new - start) + np.log(end - new) - np.log(now - start) - np.log(end - now))
            if change > threshold[walker, n]:
                times[walker, k] = new
                moved[walker] += 1
    return moved
