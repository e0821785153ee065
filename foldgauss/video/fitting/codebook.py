"""Codebooks: values that Gaussians share (colors, pairs of standard deviations), stored once with an index each."""

import dataclasses
import math

import jax
import numpy as np
import scipy
from jaxtyping import Float, Float32, Int, Int32

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.video.fitting.adam import adam_step

#: Rounds of Lloyd's algorithm, and the sizes of codebooks that are tried.
_LLOYD_ROUNDS, _SIZES = 12, tuple(2**k for k in range(3, 17))
#: Of the squared error that sharing adds, the fraction that remains after the other parameters have adapted; and the
#: fraction of the plan that they need for it.
_REMAINING_ERROR, _ADAPTATION = 0.3, 0.1


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Codebook:
    """Which Gaussians share the values of a leaf, and Adam's moments of each shared value, which is learned as one.

    `index` is the entry of each Gaussian; of length 0 where nothing is shared. The values are in the Gaussians' rows.
    """

    index: Int32[np.ndarray, " num"]
    first: Float32[np.ndarray, "entries width"]
    second: Float32[np.ndarray, "entries width"]
    counts: Int32[np.ndarray, " entries"]

    @classmethod
    def create(cls, index: Int[np.ndarray, " num"] | None, width: int) -> "Codebook":
        """A codebook whose moments are zero; `index` None: nothing is shared."""
        index = np.zeros(0, np.int32) if index is None else index.astype(np.int32)
        moments = np.zeros((int(index.max(initial=-1)) + 1, width), np.float32)
        return cls(index, moments, moments.copy(), np.zeros(len(moments), np.int32))

    def keep(self, stay: Int[np.ndarray, " left"]) -> "Codebook":
        """The codebook of the Gaussians `stay`."""
        return dataclasses.replace(self, index=self.index[stay]) if len(self.index) else self

    def step(
        self,
        values: Float32[np.ndarray, "num width"],
        grad: Float32[np.ndarray, "num width"],
        touched: Int[np.ndarray, " touched"],
        rates: Float32[np.ndarray, " width"],
    ) -> None:
        """A step of Adam on the entries of the Gaussians `touched`, by the sums of their gradients; in place.

        Gradients are set to zero.
        """
        if not len(self.index):
            return
        index, num = self.index[touched], len(self.counts)
        total = np.stack([np.bincount(index, column, num) for column in grad[touched].T], 1)
        there = np.flatnonzero(np.bincount(index, minlength=num))
        self.counts[there] += 1
        moved = np.zeros_like(self.first)
        moved[there], self.first[there], self.second[there] = adam_step(
            total[there], self.first[there], self.second[there], self.counts[there], rates
        )
        values -= moved[self.index]
        grad[touched] = 0


def find_clusters(
    values: Float32[np.ndarray, "num width"],
    weight: Float[np.ndarray, "num width"],
    price: float,
    seed: int,
    *,
    progress: float = 0.0,
    max_error: float = math.inf,
) -> Int[np.ndarray, " num"] | None:
    """The cluster of each row, whose members are to share their values; None where sharing does not pay.

    `weight` is what the square of an error of a value adds to the squared error of the fit, `price` the squared error
    that a stored parameter has to save, `progress` the fraction of the fit that is done: the rest of it compensates
    part of the error, which is at most `max_error` before. Lloyd's algorithm (1982), weighted by the mean of each
    row's weights, for codebooks of several sizes.
    """
    num, width = values.shape
    remaining = 1 - (1 - _REMAINING_ERROR) * min((1 - progress) / _ADAPTATION, 1.0)
    best, lowest = None, width * num * price
    for size in (size for size in _SIZES if size < num):
        index = _cluster(values.astype(float), weight.mean(1), size, seed)
        error = float((weight * (values - average_clusters(values, index)) ** 2).sum())
        if error > max_error:
            continue
        stored = len(np.unique(index)) * width + num * (1 if size <= 256 else 2) / 4
        cost = remaining * error + stored * price
        if cost < lowest:
            best, lowest = index, cost
        elif best is not None and size != 512:  # from there on indices are longer
            break
    return best


def average_clusters(
    values: Float32[np.ndarray, "num width"], index: Int[np.ndarray, " num"]
) -> Float32[np.ndarray, "num width"]:
    """Each row replaced by the mean of its cluster, of equal bits within a cluster."""
    count = np.maximum(np.bincount(index), 1)
    sums = np.stack([np.bincount(index, column) for column in values.T], 1)
    return (sums / count[:, None]).astype(np.float32)[index]


def _cluster(values: np.ndarray, weight: np.ndarray, size: int, seed: int) -> np.ndarray:
    """Weighted k-means: the cluster of each value."""
    rng = make_generator(Stream.CODEBOOK, seed=seed)
    chance = np.maximum(weight, 1e-9 * weight.max() + 1e-300)
    center = values[rng.choice(len(values), size, replace=False, p=chance / chance.sum())]
    for _ in range(_LLOYD_ROUNDS):
        index = scipy.spatial.cKDTree(center).query(values)[1]
        total = np.bincount(index, chance, size)
        sums = np.stack([np.bincount(index, chance * column, size) for column in values.T], 1)
        center = np.where(total[:, None] > 0, sums / np.maximum(total, 1e-300)[:, None], center)
    return scipy.spatial.cKDTree(center).query(values)[1]
