"""An emcee move that updates blocks of frames in turn, for more frames than one move can update."""

from collections.abc import Iterator

import numba as nb
import numpy as np
from emcee.moves import Move
from emcee.state import State

from foldgauss._runtime.kernels import inline, kernel
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves, piece_of, value_at
from foldgauss.uncertainty.posterior.exact import profile_grid
from foldgauss.uncertainty.posterior.log_prob import FrameTimeLogProb
from foldgauss.uncertainty.posterior.settings import BLOCK

_d = nb.float64

#: Probability of stretch moves; the others are differential evolution moves.
STRETCH = 0.3
#: Probability that the latter use the whole difference, which connects modes.
WHOLE = 0.05
#: Probability of sweeps that update single frames.
SINGLES = 0.5
#: A frame is not updated if its likelihood between its neighbors is below this fraction of the whole (rounding).
LEAST_MASS = 1e-9
#: The least difference of two times: float64 does not resolve smaller ones.
LEAST_GAP = 1e-14
_stretch = 2.0  # a of Goodman and Weare


class BlockSweep(Move):
    r"""Gibbs sweeps over blocks of frames, which are conditionally independent given the frames between them.

    Half of the walkers move at a time, with partners from the other half, as in emcee's red-blue moves; but each block
    is proposed and accepted separately. The partition into blocks is drawn anew for every half sweep. For a block of m
    frames with log-ratios z, and partners c, d of the other half:

    $$
    z' = z_c + \zeta (z - z_c), \quad g(\zeta) \propto \zeta^{-1/2} \text{ on } [1/2, 2]
    \qquad\text{or}\qquad z' = z + \gamma (z_c - z_d) + \epsilon
    $$

    accepted by the density of z, times $\zeta^{m-1}$ for the first.

    Half of the sweeps update single frames instead, first the even, then the odd ones: each time is proposed from its
    own likelihood between its neighbors' times, approximated on a grid, and accepted by the ratio to the exact one.
    So a frame moves between modes of its likelihood at any distance.

    **Source:** Goodman and Weare 2010; ter Braak 2006; emcee, Foreman-Mackey et al. 2013, algorithm 3.
    """

    def __init__(self, log_prob: FrameTimeLogProb, block: int = BLOCK):
        self.log_prob, self.block = log_prob, block
        self._grids = _proposals(log_prob)

    def propose(self, model, state: State) -> tuple[State, np.ndarray]:
        """One sweep of all walkers; a walker's acceptance is the fraction of its blocks that moved."""
        times = self.log_prob.increments.times(state.coords)
        sweep = self._singles if model.random.random_sample() < SINGLES else self._by_blocks
        moved = sweep(times, model.random)
        coordinates = self.log_prob.increments.coordinates(times)
        values, _ = model.compute_log_prob_fn(coordinates)
        return State(coordinates, log_prob=values), moved

    def _singles(self, times: np.ndarray, random) -> np.ndarray:
        """Update every frame of every walker separately, in place; returns the fraction of frames that moved."""
        moved = np.zeros(len(times))
        free = np.flatnonzero(self.log_prob.increments.free)
        tables, alpha = _tables(self.log_prob.curves), self.log_prob.increments.concentration
        for parity in (0, 1):
            frames = free[free % 2 == parity]
            chance = random.random_sample((2, len(times), len(frames)))
            moved += _single(times, frames, *self._grids, chance[0], np.log(chance[1]), alpha, *tables)
        return moved / len(free)

    def _by_blocks(self, times: np.ndarray, random) -> np.ndarray:
        """Update every block of every walker, in place; returns the fraction of blocks that moved."""
        log_prob, num = self.log_prob, len(times)
        order = random.permutation(num)
        moved = np.zeros(num)
        for movers, others in ((order[: num // 2], order[num // 2 :]), (order[num // 2 :], order[: num // 2])):
            blocks = np.array(list(_blocks(log_prob.increments.runs, self.block, random)))
            shape = len(movers), len(blocks)
            first = random.randint(len(others), size=shape)
            second = (first + 1 + random.randint(len(others) - 1, size=shape)) % len(others)
            stretched = random.random_sample(shape) < STRETCH
            root = np.sqrt(1 / _stretch) + (np.sqrt(_stretch) - np.sqrt(1 / _stretch)) * random.random_sample(shape)
            size = np.diff(blocks, axis=1)[:, 0] + 1.0
            along = 2.38 / np.sqrt(2 * size) * (1 + 0.1 * random.standard_normal(shape))
            along[random.random_sample(shape) < WHOLE] = 1.0
            factor = np.where(stretched, root**2, along)
            jitter = 1e-5 * random.standard_normal((*shape, int(size.max())))
            threshold = np.log(random.random_sample(shape))
            moved[movers] += _sweep(
                times, movers, others[first], others[second], stretched, factor, jitter, threshold, blocks,
                log_prob.increments.concentration, *_tables(log_prob.curves),
            )  # fmt: skip
        return moved


def _tables(curves: ProfileCurves) -> tuple[np.ndarray, ...]:
    return curves.nodes, curves.values, curves.slopes, curves.count


def _proposals(log_prob: FrameTimeLogProb) -> tuple[np.ndarray, ...]:
    """Grids of all frames, likelihoods there, and their integrals, (num_frames, most) each; and the grids' lengths."""
    found = []
    for k in range(log_prob.curves.num_frames):
        grid = profile_grid(log_prob.curves, k, 0.0, 1.0)
        heights = log_prob.curves[k](grid[:, None])[:, 0]
        likelihood = np.exp(heights - heights.max())
        masses = (likelihood[1:] + likelihood[:-1]) / 2 * np.diff(grid)
        found.append((grid, likelihood, np.concatenate([[0.0], np.cumsum(masses)])))
    count = np.array([len(grid) for grid, *_ in found])
    tables = np.zeros((3, len(found), count.max()))
    for k, each in enumerate(found):
        tables[:, k, : count[k]] = each
    return *tables, count


def _blocks(runs: list[tuple[int, int]], block: int, random) -> Iterator[tuple[int, int]]:
    """First and last frames of blocks with one frame between two; runs no longer than a block are one block."""
    for first, last in runs:
        if last - first < block:
            yield first, last
            continue
        start = first - random.randint(block + 1)
        while start <= last:
            low, high = max(start, first), min(start + block - 1, last)
            if low <= high:
                yield low, high
            start += block + 1


@kernel
def _sweep(
    times, movers, first, second, stretched, factor, jitter, threshold, blocks, alpha, nodes, values, slopes, count
):
    """Update the blocks of `movers`, in place; returns the fraction of its blocks that each moved."""
    moved = np.zeros(len(movers))
    most = jitter.shape[2]
    z, new, logs = np.empty(most), np.empty(most), np.empty(most + 1)
    for n in range(len(movers)):
        walker = movers[n]
        for b in range(len(blocks)):
            low, high = blocks[b]
            size = high - low + 1
            start, end = times[walker, low - 1], times[walker, high + 1]
            change = _d(0)
            # The current log-ratios and log-density.
            closing = np.log(end - times[walker, high])
            before, summed = start, closing
            for m in range(size):
                t = times[walker, low + m]
                step = np.log(t - before)
                z[m] = step - closing
                summed += step
                before = t
                k = low + m
                change -= value_at(t, nodes[k], values[k], slopes[k], count[k] - 1)
            change -= alpha * (summed - (size + 1) * np.log(end - start))
            # The proposal.
            one, two = first[n, b], second[n, b]
            one_before, two_before = times[one, low - 1], times[two, low - 1]
            one_closing = np.log(times[one, high + 1] - times[one, high])
            two_closing = np.log(times[two, high + 1] - times[two, high])
            greatest = _d(0)
            for m in range(size):
                t, other = times[one, low + m], times[two, low + m]
                z_one = np.log(t - one_before) - one_closing
                z_two = np.log(other - two_before) - two_closing
                one_before, two_before = t, other
                if stretched[n, b]:
                    new[m] = z_one + factor[n, b] * (z[m] - z_one)
                else:
                    new[m] = z[m] + factor[n, b] * (z_one - z_two) + jitter[n, b, m]
                greatest = max(greatest, new[m])
            if stretched[n, b]:
                change += (size - 1) * np.log(factor[n, b])
            total = np.exp(-greatest)
            for m in range(size):
                total += np.exp(new[m] - greatest)
            normal = greatest + np.log(total)
            # Its log-density; times must be in order in float64.
            change -= alpha * normal
            t = start
            ordered = True
            for m in range(size):
                change += alpha * (new[m] - normal)
                after = t + (end - start) * np.exp(new[m] - normal)
                ordered = ordered and after > t + LEAST_GAP
                t = after
                logs[m] = t
                k = low + m
                change += value_at(t, nodes[k], values[k], slopes[k], count[k] - 1)
            ordered = ordered and t < end - LEAST_GAP
            if ordered and change > threshold[n, b]:
                for m in range(size):
                    times[walker, low + m] = logs[m]
                moved[n] += _d(1) / len(blocks)
    return moved


@inline
def _mass_below(t, grid, likelihood, summed, last):
    """Integral of the piecewise linear likelihood up to t."""
    low = piece_of(t, grid, last)
    high = low + 1
    step = t - grid[low]
    slope = (likelihood[high] - likelihood[low]) / (grid[high] - grid[low])
    return summed[low] + step * (likelihood[low] + slope * step / 2)


@inline
def _density(t, grid, likelihood, last):
    low = piece_of(t, grid, last)
    high = low + 1
    return likelihood[low] + (likelihood[high] - likelihood[low]) * (t - grid[low]) / (grid[high] - grid[low])


@inline
def _time_of(mass, grid, likelihood, summed, last):
    """The time up to which the piecewise linear likelihood has this integral."""
    low = piece_of(mass, summed, last)
    high = low + 1
    left, width, rest = likelihood[low], grid[high] - grid[low], mass - summed[low]
    root = np.sqrt(max(left * left + _d(2) * (likelihood[high] - left) * rest / width, _d(0)))
    if left + root <= 0:
        return grid[low]
    return grid[low] + min(_d(2) * rest / (left + root), width)


@kernel
def _single(times, frames, grids, likelihoods, summed, counts, chance, threshold, alpha, nodes, values, slopes, count):
    """Propose each of `frames` of each walker between its neighbors; returns how many of each walker moved."""
    moved = np.zeros(len(times))
    for f in range(len(frames)):
        k = frames[f]
        grid, likelihood, sums, last = grids[k], likelihoods[k], summed[k], counts[k] - 1
        for walker in range(len(times)):
            start, now, end = times[walker, k - 1], times[walker, k], times[walker, k + 1]
            low = _mass_below(max(start, grid[0]), grid, likelihood, sums, last)
            high = _mass_below(min(end, grid[last]), grid, likelihood, sums, last)
            here = _density(now, grid, likelihood, last)
            if not (high - low > LEAST_MASS * sums[last] and here > 0):
                continue
            new = _time_of(low + (high - low) * chance[walker, f], grid, likelihood, sums, last)
            there = _density(new, grid, likelihood, last)
            if not (new > start + LEAST_GAP and new < end - LEAST_GAP and there > 0):
                continue
            change = value_at(new, nodes[k], values[k], slopes[k], count[k] - 1) - np.log(there)
            change -= value_at(now, nodes[k], values[k], slopes[k], count[k] - 1) - np.log(here)
            change += (alpha - 1) * (np.log(new - start) + np.log(end - new) - np.log(now - start) - np.log(end - now))
            if change > threshold[walker, f]:
                times[walker, k] = new
                moved[walker] += 1
    return moved
