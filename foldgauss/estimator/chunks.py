"""Chunks of rows, for data larger than memory: read anew in every pass, one piece at a time.

A source of chunks is a dask array, or an iterable of arrays that can be iterated repeatedly (a list of `np.memmap`, an
object whose `__iter__` reads files). A pass runs a task, a function of pieces. That of a dask array runs once for each
of its chunks, by dask's scheduler; results come in the order of the rows. dask is imported only if the rows are a dask
array.
"""

import functools
import itertools
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
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
    """Whether X is chunks of rows rather than rows, decided without reading any and without importing dask."""
    if _is_dask(X):
        return True
    if any(hasattr(X, name) for name in ("__array__", "__array_interface__", "__dataframe__", "shape")):
        return False
    if isinstance(X, Sequence) and not isinstance(X, str | bytes):
        return len(X) > 0 and len(getattr(X[0], "shape", ())) == 2
    return isinstance(X, Iterable) and not isinstance(X, str | bytes | Mapping | Set)


def open_chunks(X, sample_weight=None, width: int | None = None) -> "IterableChunks | DaskChunks":
    """The source of the chunks X; `width` is the number of columns if it is known.

    `sample_weight` has the chunks of X. For a dask array it may also be a single array.

    **Raises:** ValueError if X can be iterated only once, or is a dask array whose chunks are unknown or split rows.
    """
    return (DaskChunks if _is_dask(X) else IterableChunks)(X, sample_weight, width)


class IterableChunks:
    """Chunks from an iterable of arrays, read in a single part.

    `run(task, *arguments, each)` runs `task(pieces, *arguments)`, or `task(pieces, each[part], *arguments)`, on every
    part; results in order. `map(function, fitted)` applies `function(fitted, x)`, of shape (n_i,) or
    (n_i, num_columns), to each chunk.
    """

    concurrent = False  # whether several parts run at a time, perhaps in other processes

    def __init__(self, X, sample_weight, width):
        _check_iterable("X", X)
        if sample_weight is not None:
            _check_iterable("sample_weight", sample_weight)
        self._chunks, self._weights, self.width, self._num_rows = X, sample_weight, width, None

    def run(self, task, *arguments, each=None):
        own = () if each is None else (each[0],)
        yield task(self._read(), *own, *arguments)

    def map(self, function, fitted, *, num_columns=None, dtype=None):
        return (_map_chunk(function, fitted, self.width, x, number) for number, x in enumerate(self._chunks))

    def _read(self) -> Iterator[Piece]:
        """The pieces of all chunks, after checking that weights match and that passes have equal numbers of rows."""
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


class DaskChunks:
    """Chunks of a dask array, each a part, with `run` and `map` as those of `IterableChunks`.

    dask's scheduler runs the parts: threads, or workers if a `dask.distributed` client is active. `map` returns a dask
    array of `dtype`, by default float32 of float32 chunks and else float64.
    """

    concurrent = True

    def __init__(self, X, sample_weight, width):
        import dask.array

        _check_dask(X)
        require(
            width in (None, X.shape[1]),
            "X",
            expected=f"{width} columns",
            got=X.shape[1],
            cure="Pass the columns of the fit.",
        )
        weights = dask.array.ones(len(X)) if sample_weight is None else dask.array.asanyarray(sample_weight)
        require(
            weights.shape == X.shape[:1], "sample_weight", expected=f"shape {X.shape[:1]}", got=f"shape {weights.shape}"
        )
        self._array, self.width = X, X.shape[1]
        pairs = (X.to_delayed().ravel(), weights.rechunk(X.chunks[:1]).to_delayed())
        self._delayed = list(zip(*pairs, strict=True))

    def run(self, task, *arguments, each=None):
        import dask

        own = [() if each is None else (each[number],) for number in range(len(self._delayed))]
        calls = (functools.partial(_run_part, task, k, self.width, own[k], arguments) for k in range(len(own)))
        pairs = zip(calls, self._delayed, strict=True)
        return iter(dask.compute(*(dask.delayed(call, traverse=False)(*data) for call, data in pairs)))

    def map(self, function, fitted, *, num_columns=None, dtype=None):
        one = functools.partial(_map_block, function, fitted, self.width)
        dtype = np.dtype(dtype or (np.float32 if self._array.dtype == np.float32 else np.float64))
        if num_columns is None:
            return self._array.map_blocks(one, dtype=dtype, drop_axis=1, meta=np.zeros(0, dtype))
        chunks = (self._array.chunks[0], (num_columns,))
        return self._array.map_blocks(one, dtype=dtype, chunks=chunks, meta=np.zeros((0, 0), dtype))


# --- dask -----------------------------------------------------------------------------------------------------


def _is_dask(X) -> bool:
    """Whether X is a dask collection, in which case dask is imported already."""
    return "dask" in sys.modules and hasattr(X, "__dask_graph__")


def _check_dask(X) -> None:
    import dask.array

    require(
        isinstance(X, dask.array.Array),
        "X",
        expected="a dask array",
        got=f"dask's {type(X).__name__}",
        cure="For a dask DataFrame: .to_dask_array(lengths=True).",
    )
    require(X.ndim == 2, "X", expected="a dask array (n, d)", got=f"{X.ndim} dimensions")
    require(
        not np.isnan(X.shape).any(),
        "X",
        expected="a dask array of known chunks",
        got="unknown sizes",
        cure="X.compute_chunk_sizes() first.",
    )
    require(
        X.numblocks[1] == 1,
        "X",
        expected="a dask array chunked along rows alone",
        got=f"{X.numblocks[1]} chunks along the columns",
        cure="X.rechunk({1: -1}) makes rows whole.",
    )


def _run_part(task, number, width, own, arguments, x, weights):
    return task(_split_chunk(number, x, weights, width), *own, *arguments)


def _map_block(function, fitted, width, x, block_info=None):
    return _map_chunk(function, fitted, width, x, block_info[0]["chunk-location"][0])


# --- iterables ------------------------------------------------------------------------------------------------


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


def _map_chunk(function, fitted, width: int, x, number: int):
    parts = [function(fitted, part) for part, _ in _split_chunk(number, x, None, width)]
    return np.concatenate(parts) if parts else function(fitted, np.zeros((0, width)))


# --- tasks ----------------------------------------------------------------------------------------------------


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
def summarize_rows(chunks: IterableChunks | DaskChunks) -> tuple[RowSummary, list[int]]:
    """Summarize all rows in one pass; also the number of rows of positive weight in each part."""
    parts = list(chunks.run(_summarize))
    pieces = list(itertools.chain(*parts))
    require(pieces, "X", expected="at least one chunk with rows", got="none", cure=_SOURCES)
    num_rows, sizes, totals, means, variances, single = map(np.array, zip(*pieces, strict=True))
    total = totals.sum()
    fractions = totals / total if total > 0 else totals
    mean = fractions @ means
    variance = fractions @ (variances + (means - mean) ** 2)  # within pieces and between them
    summary = RowSummary(int(num_rows.sum()), int(sizes.sum()), float(total), mean, variance, bool(single.all()))
    return summary, [sum(piece.size for piece in part) for part in parts]


@np.errstate(over="ignore", invalid="ignore")  # units out of range are refused elsewhere
def _summarize(pieces: Iterable[Piece]) -> list[RowSummary]:
    """A summary of each piece."""
    summaries = []
    for x, weights in pieces:
        present, total = weights > 0, float(weights.sum(dtype=np.float64))
        moments = weighted_moments(x[present], weights[present]) if total > 0 else np.zeros((2, x.shape[1]))
        summaries.append(RowSummary(len(x), int(present.sum()), total, *moments, x.dtype == np.float32))
    return summaries


def collect_rows(chunks, sizes: Sequence[int], indices: Int[np.ndarray, " m"] | None, prepare) -> tuple:
    """The prepared rows with these indices among rows of positive weight (None: all), in ascending order."""
    each = [None] * len(sizes)
    if indices is not None:
        firsts, indices = np.cumsum((0, *sizes)), np.sort(indices)
        each = [indices[(a <= indices) & (indices < b)] - a for a, b in itertools.pairwise(firsts)]
    parts = [part for parts in chunks.run(_collect, prepare, each=each) for part in parts]
    return tuple(map(np.concatenate, zip(*parts, strict=True)))


def _collect(pieces, indices, prepare):
    parts, first = [], 0
    for y, weights in map(prepare, pieces):
        here = slice(None)
        if indices is not None:
            here = indices[(first <= indices) & (indices < first + len(y))] - first
        parts.append((y[here], weights[here]))
        first += len(y)
    return parts
