"""Chunks of rows, for data larger than memory: read anew in every pass, one piece at a time.

A source of chunks is an iterable of arrays that can be iterated repeatedly: a list of `np.memmap`, the blocks of a dask
array, an object whose `__iter__` reads files.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from sklearn.utils import assert_all_finite, check_array

from foldgauss._runtime.checks import require
from foldgauss.estimator.parameter_checks import check_real

#: The largest number of rows of a piece: it bounds temporary arrays, whatever the chunks are.
_PIECE_ROWS = 2**16
_SOURCES = "Pass a list of arrays, or an object whose __iter__ reads files."


class Piece(NamedTuple):
    """Checked rows of a chunk, float32 or float64, and weights of the same dtype."""

    x: Float[np.ndarray, "n d"]
    weights: Float[np.ndarray, " n"]


def is_chunked(X) -> bool:
    """Whether X is chunks of rows rather than rows, decided without reading any.

    Raises ValueError for a dask array, which would be read into memory as a whole.
    """
    cure = "Its blocks, X.blocks.ravel(), are chunks."
    require(not hasattr(X, "__dask_graph__"), "X", expected="rows, or chunks of rows", got="a dask array", cure=cure)
    if any(hasattr(X, name) for name in ("__array__", "__array_interface__", "__dataframe__", "shape")):
        return False
    if isinstance(X, Sequence) and not isinstance(X, str | bytes):
        return len(X) > 0 and len(getattr(X[0], "shape", ())) == 2
    return isinstance(X, Iterable) and not isinstance(X, str | bytes | Mapping | Set)


class Chunks:
    """Rows in chunks and their weights: iteration is a pass over all rows, in pieces.

    `width` is the number of columns if it is known. `sample_weight` has the chunks of X. Raises ValueError if X can be
    iterated only once, and in a pass if weights do not match or the number of rows has changed.
    """

    def __init__(self, X, sample_weight=None, width: int | None = None):
        _check_iterable("X", X)
        if sample_weight is not None:
            _check_iterable("sample_weight", sample_weight)
        self._chunks, self._weights, self.width, self._num_rows = X, sample_weight, width, None

    def __iter__(self) -> Iterator[Piece]:
        row, of_chunks = 0, iter(() if self._weights is None else self._weights)
        for number, x in enumerate(self._chunks):
            own = None if self._weights is None else next(of_chunks, ())
            for piece in _split_chunk(number, x, own, self.width):
                self.width = piece.x.shape[1]
                yield piece
            row += len(x)
        require(next(of_chunks, None) is None, "sample_weight", expected="as many chunks as X", got="more")
        require(
            self._num_rows in (None, row),
            "X",
            expected="the same rows in each pass",
            got=f"{self._num_rows} at first and {row} now",
            cure=f"Each pass reads them anew. {_SOURCES}",
        )
        self._num_rows = row

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> Iterator[np.ndarray]:
        """A function of rows applied to each chunk."""
        for number, x in enumerate(self._chunks):
            parts = [function(part) for part, _ in _split_chunk(number, x, None, self.width)]
            yield np.concatenate(parts) if parts else function(np.zeros((0, self.width)))


def _check_iterable(name: str, chunks) -> None:
    """Raise unless `chunks` can be iterated repeatedly."""
    require(isinstance(chunks, Iterable), name, expected="chunks of rows", got=type(chunks).__name__, cure=_SOURCES)
    require(
        iter(chunks) is not chunks,
        name,
        expected="chunks that can be read again in each pass",
        got=f"{type(chunks).__name__}, which can be read only once",
        cure=_SOURCES,
    )


def _split_chunk(number: int, x, weights, width: int | None) -> Iterator[Piece]:
    """Split a chunk to pieces of checked values; weights of None are 1."""
    name = f"X, chunk {number}"
    check_real(name, x)
    x = np.asarray(x) if hasattr(x, "__array__") else x  # a block of a dask array is computed once
    require(
        weights is None or np.shape(weights)[:1] == (len(x),),
        f"sample_weight, chunk {number}",
        expected=f"{len(x)} weights",
        got=f"{len(weights)}" if np.ndim(weights) else "a number",
        cure="Divide the weights as X: an array for each chunk.",
    )
    for row in range(0, len(x), _PIECE_ROWS):
        rows = slice(row, row + _PIECE_ROWS)
        part = check_array(x[rows], dtype=[np.float64, np.float32], ensure_all_finite=False, input_name=name)
        require(
            width in (None, part.shape[1]),
            name,
            expected=f"{width} columns",
            got=part.shape[1],
            cure="All chunks have the columns of the first, or of the fit.",
        )
        own = np.ones(len(part), part.dtype) if weights is None else np.asarray(weights[rows], part.dtype)
        require(
            (np.isfinite(own) & (own >= 0)).all(),
            f"sample_weight, chunk {number}",
            expected="finite numbers >= 0",
            got=f"between {own.min()} and {own.max()}",
            cure="0 leaves a row out.",
        )
        assert_all_finite(part[own > 0], input_name=name)
        width = part.shape[1]
        yield Piece(part, own)


class RowSummary(NamedTuple):
    """Summary of all rows from one pass; rows of weight 0 count in `num_rows` only."""

    num_rows: int
    size: int  # rows with weight
    total: float  # of the weights
    mean: Float[np.ndarray, " d"]
    variance: Float[np.ndarray, " d"]
    single: bool  # all are float32


def weighted_moments(x: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and variance per coordinate, in float64."""
    weights = (weights / weights.sum(dtype=np.float64)).astype(np.float64)
    mean = weights @ x
    centered = x - mean
    correction = weights @ centered
    return mean + correction, weights @ (centered - correction) ** 2


@np.errstate(over="ignore", invalid="ignore")  # units out of range are refused elsewhere
def summarize_rows(chunks: Chunks) -> RowSummary:
    """Summarize all rows in one pass."""
    pieces = []
    for x, weights in chunks:
        present, total = weights > 0, float(weights.sum(dtype=np.float64))
        moments = weighted_moments(x[present], weights[present]) if total > 0 else np.zeros((2, x.shape[1]))
        pieces.append(RowSummary(len(x), int(present.sum()), total, *moments, x.dtype == np.float32))
    require(pieces, "X", expected="at least one chunk with rows", got="none", cure=_SOURCES)
    num_rows, sizes, totals, means, variances, single = map(np.array, zip(*pieces, strict=True))
    total = totals.sum()
    fractions = totals / total if total > 0 else totals
    mean = fractions @ means
    variance = fractions @ (variances + (means - mean) ** 2)  # within pieces and between them
    return RowSummary(int(num_rows.sum()), int(sizes.sum()), float(total), mean, variance, bool(single.all()))
