"""The training data of a fit, rows in memory or in chunks: their preparation, groups, dtype, and order of columns."""

import functools
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from sklearn.exceptions import ConvergenceWarning

from foldgauss._runtime.checks import invalid, require
from foldgauss.estimator.chunks import Chunks, Piece, RowSummary
from foldgauss.estimator.em.scaling import Scaling
from foldgauss.estimator.em.statistics import Blocks, Points, make_points

#: The highest degree fitted in float32. Beyond, with times far from normal, a curve's normal equations lose more digits
#: than float32 has: up to 1 nat a point at degree 10.
_MAX_SINGLE_DEGREE = 6
#: Rows from which the gaps between groups are measured; their median is precise to about 10%.
_GAP_ROWS = 200
#: Rows lie on smooth curves if the second differences of successive rows are less than this fraction of the first ones:
#: 1.7 for independent rows, 1.4 for a random walk, and 0.3 for curves with noise of an eighth of a step.
_SMOOTH = 0.3
#: Rows of which that is measured: the first ones.
SMOOTH_ROWS = 10_000
#: A component is narrow if its variance is less than this many squared gaps; one of them is added to every variance.
_NARROW = 1.25


class Rows(NamedTuple):
    """The rows of a fit in chunks, their summary from a first pass, and how they are prepared; one array is one chunk.

    Prepared are the rows of positive weight: time last, scaled, and the weights times `factor`.
    """

    chunks: Chunks
    summary: RowSummary
    order: Int[np.ndarray, " d"]
    dtype: np.dtype
    in_memory: bool
    scaling: Scaling
    factor: float = 1.0

    @property
    def total(self) -> float:
        return self.summary.total * self.factor

    @property
    def prepare(self) -> Callable:
        return functools.partial(_prepare, self.order, self.scaling, self.factor, self.dtype)

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Weighted mean and variance of each column."""
        return self.summary.mean[self.order], self.summary.variance[self.order]

    def take(self, subset: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The prepared rows with these indices (None: all) in ascending order, and their weights."""
        parts, first = [], 0
        for y, weights in map(self.prepare, self.chunks):
            here = slice(None)
            if subset is not None:
                here = np.sort(subset[(first <= subset) & (subset < first + len(y))]) - first
            parts.append((y[here], weights[here]))
            first += len(y)
        return tuple(map(np.concatenate, zip(*parts, strict=True)))

    def to_points(self, num_components: int, devices: int) -> Points | Blocks:
        if self.in_memory:
            return make_points(*self.take(), num_components, devices)
        return Blocks(self.chunks, self.prepare, self.dtype, num_components, self.summary.size, devices)


def _prepare(order: Int[np.ndarray, " d"], scaling: Scaling, factor: float, dtype: np.dtype, piece: Piece) -> tuple:
    """The rows of positive weight of a piece, columns in `order` and scaled, and their weights times `factor`."""
    kept = piece.weights > 0
    x, weights = (z.astype(dtype, copy=False) for z in (piece.x[kept][:, order], piece.weights[kept]))
    return scaling.apply(x), weights if factor == 1 else weights * dtype.type(factor)


def measure_gaps(x: Float[np.ndarray, "n d"], groups: Int[np.ndarray, " n"]) -> Float[np.ndarray, " d"]:
    """The median squared distance in each column to the nearest row of another group."""

    def one(row: int) -> np.ndarray:
        square = (x[groups != groups[row]] - x[row]) ** 2
        return square[square.sum(1).argmin()]

    return np.median([one(row) for row in np.unique(np.linspace(0, len(x) - 1, _GAP_ROWS).astype(int))], axis=0)


def choose_dtype(data: Rows, degree: int) -> np.dtype:
    """Return the dtype of the data, or float64 if float32 is too short."""
    if data.dtype == np.float32 and (degree > _MAX_SINGLE_DEGREE or _find_extreme(data, degree) is not None):
        data = data._replace(dtype=np.dtype(np.float64))
    if (column := _find_extreme(data, degree)) is not None:
        expected = f"columns whose spread to the power {degree + 1} float64 holds"
        cure = "Divide it by its standard deviation."
        raise invalid("X", expected=expected, got=f"another in column {data.order[column]}", cure=cure)
    return data.dtype


def _find_extreme(data: Rows, degree: int) -> int | None:
    """A column whose powers, in covariances and coefficients of this degree, are out of the dtype's range."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        mean, variance = data.moments()
        # A column is measured from its mean: the fit handles offsets, but not their squares beyond the range.
        size = (degree + 1) * np.abs(0.5 * np.log(variance))
        extreme = (size > np.log(float(np.finfo(data.dtype).max))) & (variance > 0) | ~np.isfinite(variance + mean**2)
    return int(extreme.argmax()) if extreme.any() else None


def check_groups(groups, present: Bool[np.ndarray, " n"] | None) -> Int[np.ndarray, " n"] | None:
    """The number of the group of each row that is present; `present` is None for chunks of rows, which have none."""
    if groups is None:
        return None
    require(present is not None, "groups", expected="None for chunks of rows", got="groups", cure="Or pass one array.")
    require(
        np.shape(groups) == present.shape,
        "groups",
        expected=f"shape {present.shape}",
        got=f"shape {np.shape(groups)}",
        cure="One per row.",
    )
    try:
        names, which = np.unique(np.asarray(groups)[present], return_inverse=True)
    except TypeError as error:  # None among strings
        raise invalid("groups", expected="numbers or strings", got="a mixture", cure="Name each track.") from error
    require(
        len(names) >= 2, "groups", expected="at least 2 groups", got=len(names), cure="Add tracks, or leave groups out."
    )
    return which


def warn_smooth(x: Float[np.ndarray, "n d"]) -> None:
    """Warn of successive rows on smooth curves in space, which count as one observation rather than as many."""
    if len(x) < 10:
        return
    space = np.asarray(x[:, :-1], np.float64)
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
            stacklevel=3,
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
            stacklevel=4,
        )


def order_columns(column: int, num_columns: int) -> Int[np.ndarray, " d"]:
    """The indices of the columns of X, with the time column last."""
    return np.append(np.delete(np.arange(num_columns), column), column)
