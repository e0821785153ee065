"""Numbers that many Gaussians share: colours, and pairs of standard deviations. Stored once, with an index each."""

import dataclasses
import functools
import math

import jax
import numpy as np
import scipy
from jaxtyping import Float, Float32, Int, Int32

from foldgauss.video.fitting.adam import BETA1, BETA2, EPSILON

#: Rounds of Lloyd's algorithm, and sizes of palettes tried.
_LLOYD, _PALETTES = 12, tuple(2**k for k in range(3, 17))
#: Of the error that sharing adds, what is left once the others have made up for it; and the share of the plan that they
#: need for that.
_LEFT, _MENDED_IN = 0.3, 0.1


@functools.partial(jax.tree_util.register_dataclass, data_fields=["index", "first", "second", "counts"], meta_fields=[])
@dataclasses.dataclass
class Codebook:
    """Rows of numbers that many Gaussians share, and Adam's moments of each: what is shared learns as one.

    `index` is the number of each Gaussian's row; of length 0 where none is shared. The rows are the Gaussians' own.
    """

    index: Int32[np.ndarray, " num"]
    first: Float32[np.ndarray, "entries width"]
    second: Float32[np.ndarray, "entries width"]
    counts: Int32[np.ndarray, " entries"]

    @classmethod
    def of(cls, index: Int[np.ndarray, " num"] | None, width: int) -> "Codebook":
        """One that has not learned yet; None: nothing is shared."""
        index = np.zeros(0, np.int32) if index is None else index.astype(np.int32)
        moments = np.zeros((int(index.max(initial=-1)) + 1, width), np.float32)
        return cls(index, moments, moments.copy(), np.zeros(len(moments), np.int32))

    def kept(self, stay: Int[np.ndarray, " left"]) -> "Codebook":
        """That of the Gaussians that stay."""
        return dataclasses.replace(self, index=self.index[stay]) if len(self.index) else self

    def step(
        self,
        values: Float32[np.ndarray, "num width"],
        grad: Float32[np.ndarray, "num width"],
        touched: Int[np.ndarray, " touched"],
        rate: Float32[np.ndarray, " width"],
    ) -> None:
        """One of Adam's, by the sums of gradients, on the rows that took part: `values` change in place.

        Gradients are set to zero.
        """
        if not len(self.index):
            return
        index, num = self.index[touched], len(self.counts)
        total = np.stack([np.bincount(index, column, num) for column in grad[touched].T], 1)
        there = np.flatnonzero(np.bincount(index, minlength=num))
        self.counts[there] += 1
        taken, total = self.counts[there, None], total[there]
        self.first[there] = BETA1 * self.first[there] + (1 - BETA1) * total
        self.second[there] = BETA2 * self.second[there] + (1 - BETA2) * total**2
        mean, square = self.first[there] / (1 - BETA1**taken), self.second[there] / (1 - BETA2**taken)
        moved = np.zeros_like(self.first)
        moved[there] = rate * mean / (np.sqrt(square) + EPSILON)
        values -= moved[self.index]
        grad[touched] = 0


def shared(
    values: Float32[np.ndarray, "num width"],
    weight: Float[np.ndarray, "num width"],
    price: float,
    seed: int,
    *,
    progress: float = 0.0,
    most: float = math.inf,
) -> Int[np.ndarray, " num"] | None:
    """Which rows share their values: the number of each one's in a palette; None where sharing does not pay.

    `weight` is what the square of an error of a value adds to the squared error, `price` what a stored number has to
    save, `progress` the share of the fit that is done: what is left of it mends part of the error, which is
    `most` at most before. Clusters by Lloyd's algorithm (1982), weighted by the mean of a row's weights, for palettes
    of several sizes.
    """
    num, width = values.shape
    left = 1 - (1 - _LEFT) * min((1 - progress) / _MENDED_IN, 1.0)
    best, least = None, width * num * price
    for size in (size for size in _PALETTES if size < num):
        index = _clustered(values.astype(float), weight.mean(1), size, seed)
        error = float((weight * (values - averaged(values, index)) ** 2).sum())
        if error > most:
            continue
        stored = len(np.unique(index)) * width + num * (1 if size <= 256 else 2) / 4
        cost = left * error + stored * price
        if cost < least:
            best, least = index, cost
        elif best is not None and size != 512:  # indices are longer from there on
            break
    return best


def averaged(
    values: Float32[np.ndarray, "num width"], index: Int[np.ndarray, " num"]
) -> Float32[np.ndarray, "num width"]:
    """Each row's mean with those of its number: of equal bits for equal numbers."""
    count = np.maximum(np.bincount(index), 1)
    sums = np.stack([np.bincount(index, column) for column in values.T], 1)
    return (sums / count[:, None]).astype(np.float32)[index]


def _clustered(values: np.ndarray, weight: np.ndarray, size: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 5])
    chance = np.maximum(weight, 1e-9 * weight.max() + 1e-300)
    centre = values[rng.choice(len(values), size, replace=False, p=chance / chance.sum())]
    for _ in range(_LLOYD):
        index = scipy.spatial.cKDTree(centre).query(values)[1]
        total = np.bincount(index, chance, size)
        sums = np.stack([np.bincount(index, chance * column, size) for column in values.T], 1)
        centre = np.where(total[:, None] > 0, sums / np.maximum(total, 1e-300)[:, None], centre)
    return scipy.spatial.cKDTree(centre).query(values)[1]
