"""A sweep of emcee moves over blocks of frames, for more frames than one move can take."""

from collections.abc import Iterator

import numba as nb
import numpy as np
from emcee.moves import Move
from emcee.state import State

from foldgauss._kernels import kernel
from foldgauss.uncertainty.log_prob import FrameTimeLogProb
from foldgauss.uncertainty.profiles import value_at

_d = nb.float64

#: Frames in a block. Walkers must be at least twice as many.
BLOCK = 6
#: Share of stretch moves; the others go along the difference of two walkers (differential evolution).
STRETCH = 0.3
#: Share of the latter that go the whole difference: from one hill to another.
WHOLE = 0.05
_stretch = 2.0  # a of Goodman and Weare


class BlockSweep(Move):
    r"""Gibbs sweeps: frames are cut into blocks between frames that stay, and every block moves, given these.

    Half of the walkers move at a time, guided by the other half, as in emcee's own red-blue moves; but each block is
    proposed and accepted by itself, since given the frames between them blocks are independent. The cuts are drawn anew
    for every half sweep. In a block of m frames, in its log-ratios z, and with partners c, d of the other half:

    .. math:: z' = z_c + \zeta (z - z_c), \quad g(\zeta) \propto \zeta^{-1/2} \text{ on } [1/2, 2]
       \qquad\text{or}\qquad z' = z + \gamma (z_c - z_d) + \epsilon

    accepted by the density of z, times :math:`\zeta^{m-1}` for the first.

    **Source:** Goodman and Weare 2010; ter Braak 2006; emcee, Foreman-Mackey et al. 2013, algorithm 3.
    """

    def __init__(self, log_prob: FrameTimeLogProb, block: int = BLOCK):
        self.log_prob, self.block = log_prob, block

    def propose(self, model, state: State) -> tuple[State, np.ndarray]:
        """One sweep of all walkers; a walker's acceptance is the share of its blocks that moved."""
        log_prob = self.log_prob
        times = log_prob.increments.times(state.coords)
        num = len(times)
        order = model.random.permutation(num)
        moved = np.zeros(num)
        for movers, others in ((order[: num // 2], order[num // 2 :]), (order[num // 2 :], order[: num // 2])):
            blocks = np.array(list(_blocks(log_prob.increments.runs, self.block, model.random)))
            shape = len(movers), len(blocks)
            first = model.random.randint(len(others), size=shape)
            second = (first + 1 + model.random.randint(len(others) - 1, size=shape)) % len(others)
            stretched = model.random.random_sample(shape) < STRETCH
            root = np.sqrt(1 / _stretch) + (np.sqrt(_stretch) - np.sqrt(1 / _stretch)) * model.random.random_sample(
                shape
            )
            size = np.diff(blocks, axis=1)[:, 0] + 1.0
            along = 2.38 / np.sqrt(2 * size) * (1 + 0.1 * model.random.standard_normal(shape))
            along[model.random.random_sample(shape) < WHOLE] = 1.0
            factor = np.where(stretched, root**2, along)
            jitter = 1e-5 * model.random.standard_normal((*shape, int(size.max())))
            threshold = np.log(model.random.random_sample(shape))
            found = log_prob.profiles
            tables = found.nodes, found.values, found.slopes, found.count
            moved[movers] += _sweep(
                times, movers, others[first], others[second], stretched, factor, jitter, threshold, blocks,
                log_prob.increments.concentration, *tables,
            )  # fmt: skip
        coordinates = log_prob.increments.coordinates(times)
        values, _ = model.compute_log_prob_fn(coordinates)
        return State(coordinates, log_prob=values), moved


def _blocks(runs: list[tuple[int, int]], block: int, random) -> Iterator[tuple[int, int]]:
    """First and last frames of blocks, one frame left between two; runs that are no longer than a block are whole."""
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
    """Move the blocks of `movers`, in place; returns the share of its blocks that each moved."""
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
            # Its own log-ratios, and what its density loses.
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
            # Its density; in order as float64 shows it, or not at all.
            change -= alpha * normal
            t = start
            ordered = True
            for m in range(size):
                change += alpha * (new[m] - normal)
                after = t + (end - start) * np.exp(new[m] - normal)
                ordered = ordered and after > t
                t = after
                logs[m] = t
                k = low + m
                change += value_at(t, nodes[k], values[k], slopes[k], count[k] - 1)
            ordered = ordered and t < end
            if ordered and change > threshold[n, b]:
                for m in range(size):
                    times[walker, low + m] = logs[m]
                moved[n] += _d(1) / len(blocks)
    return moved
