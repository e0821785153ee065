"""The training data of a fit: rows in memory or in chunks, under one interface, and the order of their columns."""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from sklearn.exceptions import ConvergenceWarning

from foldgauss._runtime.checks import invalid
from foldgauss.estimator.chunks import Chunks, RowSummary, collect_rows, weighted_moments
from foldgauss.estimator.em.scaling import RowTransform, Scaling
from foldgauss.estimator.em.statistics import Blocks, Points, make_points

__all__ = [
    "ChunkedRows",
    "Rows",
    "check_groups",
    "choose_dtype",
    "order_columns",
    "refuse_groups",
    "warn_narrow",
    "warn_smooth",
]

#: The highest degree fitted in float32. Beyond, with times far from normal, a curve's normal equations lose more digits
#: than float32 has: up to 1 nat a point at degree 10.
_MAX_SINGLE_DEGREE = 6
#: Rows from which the gaps between groups are measured; their median is precise to about 10%.
_GAP_ROWS = 200
#: Rows lie on smooth curves if the second differences of successive rows are less than this fraction of the first ones:
#: 1.7 for independent rows, 1.4 for a random walk, and 0.3 for curves with noise of an eighth of a step.
_SMOOTH = 0.3
#: A component is narrow if its variance is less than this many squared gaps; one of them is added to every variance.
_NARROW = 1.25


class Rows(NamedTuple):
    """Rows of positive weight in memory, time last."""

    x: Float[np.ndarray, "n d"]
    weights: Float[np.ndarray, " n"]
    groups: Int[np.ndarray, " n"] | None = None

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

    def astype(self, dtype: np.dtype) -> "Rows":
        return self._replace(x=self.x.astype(dtype, copy=False), weights=self.weights.astype(dtype, copy=False))

    def reweight(self, factor: float) -> "Rows":
        return self._replace(weights=self.weights * self.dtype.type(factor))

    def rescale(self, scaling: Scaling) -> "Rows":
        return self._replace(x=scaling.apply(self.x))

    @property
    def num_groups(self) -> int | None:
        return None if self.groups is None else len(np.unique(self.groups))

    def gaps(self) -> Float[np.ndarray, " d"] | float:
        """The median squared distance in each column to the nearest row of another group; 0 without groups."""
        if self.groups is None:
            return 0.0

        def one(row: int) -> np.ndarray:
            square = (self.x[self.groups != self.groups[row]] - self.x[row]) ** 2
            return square[square.sum(1).argmin()]

        return np.median([one(row) for row in np.unique(np.linspace(0, self.size - 1, _GAP_ROWS).astype(int))], axis=0)

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
    num_groups = None

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

    def gaps(self) -> float:
        return 0.0

    def astype(self, dtype: np.dtype) -> "ChunkedRows":
        return self._replace(dtype=dtype)

    def reweight(self, factor: float) -> "ChunkedRows":
        return self._replace(factor=factor)

    def rescale(self, scaling: Scaling) -> "ChunkedRows":
        return self._replace(scaling=scaling)

    def take(self, subset: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The rows with these indices (None: all), and their weights."""
        return collect_rows(self.chunks, self.sizes, subset, self.transform)

    def to_points(self, num_components: int, devices: int) -> Blocks:
        return Blocks(self.chunks, self.transform, self.dtype, num_components, self.sizes, devices)


def choose_dtype(data: Rows | ChunkedRows, degree: int, order: Int[np.ndarray, " d"]) -> np.dtype:
    """Return the dtype of the data, or float64 if float32 is too short. Column i of the data is order[i] of X."""
    if data.dtype == np.float32 and (degree > _MAX_SINGLE_DEGREE or _find_extreme(data, degree) is not None):
        data = data.astype(np.dtype(np.float64))
    if (column := _find_extreme(data, degree)) is not None:
        expected = f"columns whose spread to the power {degree + 1} float64 holds"
        cure = "Divide it by its standard deviation."
        raise invalid("X", expected=expected, got=f"another in column {order[column]}", cure=cure)
    return data.dtype


def _find_extreme(data: Rows | ChunkedRows, degree: int) -> int | None:
    """A column whose powers, in covariances and coefficients of this degree, are out of the dtype's range."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        mean, variance = data.moments()
        # A column is measured from its mean: the fit handles offsets, but not their squares beyond the range.
        size = (degree + 1) * np.abs(0.5 * np.log(variance))
        extreme = (size > np.log(float(np.finfo(data.dtype).max))) & (variance > 0) | ~np.isfinite(variance + mean**2)
    return int(extreme.argmax()) if extreme.any() else None


def check_groups(groups, present: np.ndarray) -> Int[np.ndarray, " n"] | None:
    """The number of the group of each row that is present."""
    if groups is None:
        return None
    if np.shape(groups) != present.shape:
        raise invalid("groups", expected=f"shape {present.shape}", got=f"shape {np.shape(groups)}", cure="One per row.")
    try:
        names, which = np.unique(np.asarray(groups)[present], return_inverse=True)
    except TypeError as error:  # None among strings
        raise invalid("groups", expected="numbers or strings", got="a mixture", cure="Name each track.") from error
    if len(names) < 2:
        raise invalid("groups", expected="at least 2 groups", got=len(names), cure="Add tracks, or leave groups out.")
    return which


def refuse_groups(groups) -> None:
    """Raise if there are groups, for chunks of rows."""
    if groups is not None:
        raise invalid("groups", expected="None for chunks of rows", got="groups", cure="Or pass one array.")


def warn_smooth(x: Float[np.ndarray, "n d"]) -> None:
    """Warn of successive rows on smooth curves in space, which count as one observation rather than as many."""
    if len(x) < 10:
        return
    space = np.asarray(x[:10_000, :-1], np.float64)
    with np.errstate(all="ignore"):  # units out of range are refused elsewhere
        scale = space.std(0)
        step = np.diff(space / np.where(scale > 0, scale, 1), axis=0)
        first, second = (np.median(np.linalg.norm(y, axis=1)) for y in (step, np.diff(step, axis=0)))
    if 1e-6 * first < second < _SMOOTH * first:  # not steps that are all the same: a grid of points
        warnings.warn(
            f"Successive rows lie on smooth curves (second differences are {second / first:.0%} of the first ones), so "
            "that components may collapse onto single curves. Pass the curve of each row as groups, and hold out "
            "whole curves to compare mixtures.",
            UserWarning,
            stacklevel=4,
        )


def warn_narrow(tril: Float[np.ndarray, "k d-1 d-1"], gaps: Float[np.ndarray, " d"] | float) -> None:
    """Warn of components most of whose variance, in some direction of space, is the gap between groups."""
    if not np.any(gaps):
        return
    whitened = np.asarray(tril, np.float64) / np.sqrt(np.maximum(gaps[:-1], np.finfo(np.float64).tiny))[:, None]
    narrow = int((np.linalg.svd(whitened, compute_uv=False)[:, -1] ** 2 < _NARROW).sum())
    if narrow:
        warnings.warn(
            f"{narrow} of {len(whitened)} components are as narrow as the gap between groups and may each describe one "
            "group only. Lower n_components or max_components, or fit more groups.",
            ConvergenceWarning,
            stacklevel=5,
        )


def order_columns(column: int, num_columns: int) -> Int[np.ndarray, " d"]:
    """The indices of the columns of X, with the time column last."""
    return np.append(np.delete(np.arange(num_columns), column), column)
