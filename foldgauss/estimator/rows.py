"""The training data of a fit: rows in memory or in chunks, under one interface, and the order of their columns."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from foldgauss.estimator.chunks import Chunks, RowSummary, collect_rows, weighted_moments
from foldgauss.estimator.em.scaling import RowTransform, Scaling
from foldgauss.estimator.em.statistics import Blocks, Points, make_points

__all__ = ["ChunkedRows", "Rows", "order_columns"]


class Rows(NamedTuple):
    """Rows of positive weight in memory, time last."""

    x: Float[np.ndarray, "n d"]
    weights: Float[np.ndarray, " n"]

    @property
    def dtype(self) -> np.dtype:
        return self.x.dtype

    @property
    def size(self) -> int:
        return len(self.weights)

    @property
    def total(self) -> float:
        return float(self.weights.sum(dtype=np.float64))

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Weighted mean and variance of each column."""
        return weighted_moments(self.x, self.weights)

    def reweight(self, factor: float) -> "Rows":
        return self._replace(weights=self.weights * self.dtype.type(factor))

    def rescale(self, scaling: Scaling) -> "Rows":
        return self._replace(x=scaling.apply(self.x))

    def take(self, subset: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The rows with these indices (None: all), and their weights."""
        return (self.x, self.weights) if subset is None else (self.x[subset], self.weights[subset])

    def to_points(self, num_components: int, devices: int) -> Points:
        return make_points(self.x, self.weights, num_components, devices)


class ChunkedRows(NamedTuple):
    """Rows in chunks, and their summary from a first pass."""

    chunks: Chunks
    summary: RowSummary
    sizes: list[int]
    order: Int[np.ndarray, " d"]
    dtype: np.dtype
    factor: float = 1.0
    scaling: Scaling | None = None

    @property
    def size(self) -> int:
        return self.summary.size

    @property
    def total(self) -> float:
        return self.summary.total * self.factor

    @property
    def transform(self) -> RowTransform:
        return RowTransform(self.order, self.scaling, self.factor, self.dtype)

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Weighted mean and variance of each column."""
        return self.summary.mean[self.order], self.summary.scatter[self.order] / self.summary.total

    def reweight(self, factor: float) -> "ChunkedRows":
        return self._replace(factor=factor)

    def rescale(self, scaling: Scaling) -> "ChunkedRows":
        return self._replace(scaling=scaling)

    def take(self, subset: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The rows with these indices (None: all), and their weights."""
        return collect_rows(self.chunks, self.sizes, subset, self.transform)

    def to_points(self, num_components: int, devices: int) -> Blocks:
        return Blocks(self.chunks, self.transform, self.dtype, num_components, self.sizes, devices)


def order_columns(column: int, num_columns: int) -> Int[np.ndarray, " d"]:
    """The indices of the columns of X, with the time column last."""
    return np.append(np.delete(np.arange(num_columns), column), column)
