"""Chunks of rows, for data larger than memory: read anew in every pass, one piece at a time.

A source of chunks is a dask array, or an iterable of arrays that can be iterated repeatedly (a list of `np.memmap`, an
object whose `__iter__` reads files). A pass runs a task, a function of pieces. Those of a dask array run by parts, on
workers if a `dask.distributed` client is active; results come in the order of the rows. dask is imported only if the
rows are a dask array.
"""

import abc
import functools
import itertools
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from numbers import Real
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from foldgauss._runtime.checks import invalid

__all__ = [
    "Chunks",
    "Piece",
    "RowSummary",
    "collect_rows",
    "is_chunked",
    "open_chunks",
    "summarize_rows",
    "weighted_moments",
]

#: The largest number of rows of a piece: it bounds temporary arrays, whatever the chunks are.
_PIECE_ROWS = 2**16
#: Tasks submitted ahead of the one that is waited for, for each of the workers' threads.
_TASKS_PER_THREAD = 2
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


def open_chunks(X, sample_weight=None, width: int | None = None) -> "Chunks":
    """The source of the chunks X; `width` is the number of columns if it is known.

    `sample_weight` is chunked as X is, or an array of one weight a row, or a number for all.

    **Raises:** ValueError if X can be iterated only once, or is a dask array whose chunks are unknown or split rows.
    """
    return (_DaskChunks if _is_dask(X) else _IterableChunks)(X, sample_weight, width)


class Chunks(abc.ABC):
    """Chunks of rows that can be read repeatedly, in a pass of `num_parts` tasks."""

    num_parts: int
    width: int | None
    on_workers = False

    @abc.abstractmethod
    def run(self, task: Callable, *arguments, each: Sequence | None = None) -> Iterator:
        """Run `task(pieces, *arguments)` or `task(pieces, each[part], *arguments)` on every part; results in order."""

    @abc.abstractmethod
    def map(self, function: Callable, fitted, *, num_columns: int | None = None, dtype=None):
        """Apply `function(fitted, x)`, of shape (n_i,) or (n_i, num_columns), to each chunk: an iterator or dask array.

        `dtype` is that of the results, by default float32 of float32 chunks and else float64.
        """


class _IterableChunks(Chunks):
    """An iterable of arrays: a single part."""

    num_parts = 1

    def __init__(self, X, sample_weight, width):
        _check_iterable("X", X)
        self._chunks, self._weights, self.width = X, sample_weight, width
        self._num_rows = None
        if _is_array(sample_weight):
            self._weights = np.asarray(sample_weight)
        elif not (sample_weight is None or isinstance(sample_weight, Real)):
            _check_iterable("sample_weight", sample_weight)

    def run(self, task, *arguments, each=None):
        own = () if each is None else (each[0],)
        yield task(_split_pieces(self._read(), self.width), *own, *arguments)

    def map(self, function, fitted, *, num_columns=None, dtype=None):
        return (_map_chunk(function, fitted, self.width, x, number) for number, x in enumerate(self._chunks))

    def _read(self):
        """Number, rows and weights of every chunk, after checking that they match and equal those of earlier passes."""
        row, own = 0, self._weights
        weights = None if own is None or isinstance(own, Real | np.ndarray) else iter(own)
        for number, x in enumerate(self._chunks):
            x = _check_chunk(number, x, self.width)
            self.width, stop = x.shape[1], row + len(x)
            if weights is not None:
                own = next(weights, _MISSING)
            of_chunk = own[row:stop] if weights is None and isinstance(own, np.ndarray) else own
            yield number, x, _check_weights(number, of_chunk, len(x))
            row = stop
        if self._num_rows is None:
            self._check_end(weights, row)
            self._num_rows = row
        if row != self._num_rows:
            got, cure = f"{self._num_rows} at first and {row} now", f"Each pass reads them anew. {_SOURCES}"
            raise invalid("X", expected="the same rows in each pass", got=got, cure=cure)

    def _check_end(self, weights: Iterator | None, num_rows: int) -> None:
        if weights is not None and next(weights, _MISSING) is not _MISSING:
            raise invalid("sample_weight", expected="as many chunks as X", got="more")
        if isinstance(self._weights, np.ndarray) and len(self._weights) != num_rows:
            got = len(self._weights)
            raise invalid("sample_weight", expected=f"{num_rows} weights, one for each row", got=got)


class _DaskChunks(Chunks):
    """A dask array, chunked along its rows: small chunks are combined to one part."""

    def __init__(self, X, sample_weight, width):
        _check_dask(X)
        if width not in (None, X.shape[1]):
            raise invalid("X", expected=f"{width} columns", got=X.shape[1], cure="Pass the columns of the fit.")
        self._array, self.width, self._sizes = X, X.shape[1], X.chunks[0]
        self._delayed, rows = X.to_delayed().ravel().tolist(), np.cumsum((0, *self._sizes))
        self._weights = self._split_weights(X, sample_weight, rows)
        parts, first = [], 0
        for k in range(len(self._sizes)):
            if rows[k + 1] - rows[first] >= _PIECE_ROWS or k + 1 == len(self._sizes):
                parts.append((first, k + 1))
                first = k + 1
        self._parts, self.num_parts = parts, len(parts)
        self._client = _active_client()
        self.on_workers = self._client is not None

    def _split_weights(self, X, weights, rows) -> list:
        """Weights by chunk: None, a number, an array, or a delayed one."""
        if weights is None or isinstance(weights, Real):
            return [weights] * len(self._sizes)
        if _is_dask(weights):
            self._check_weight_count(X, weights)
            return weights.rechunk((self._sizes,)).to_delayed().ravel().tolist()
        if not _is_array(weights):
            got = type(weights).__name__
            raise invalid("sample_weight", expected="a dask or NumPy array, a number or None", got=got)
        weights = np.asarray(weights)
        self._check_weight_count(X, weights)
        return [weights[a:b] for a, b in itertools.pairwise(rows)]

    def _check_weight_count(self, X, weights) -> None:
        if weights.shape != X.shape[:1]:
            raise invalid("sample_weight", expected=f"shape {X.shape[:1]}", got=f"shape {weights.shape}")

    def run(self, task, *arguments, each=None):
        calls = (
            functools.partial(_run_part, task, first, self.width, () if each is None else (each[k],), arguments)
            for k, (first, _) in enumerate(self._parts)
        )
        data = ((self._delayed[a:b], self._weights[a:b]) for a, b in self._parts)
        if self.on_workers:
            yield from _run_on_workers(self._client, calls, data)
        else:
            for call, (chunks, weights) in zip(calls, data, strict=True):
                yield call(_compute_each(chunks), _compute_each(weights))

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

    if not isinstance(X, dask.array.Array):
        cure = "For a dask DataFrame: .to_dask_array(lengths=True)."
        raise invalid("X", expected="a dask array", got=f"dask's {type(X).__name__}", cure=cure)
    if X.ndim != 2:
        raise invalid("X", expected="a dask array (n, d)", got=f"{X.ndim} dimensions")
    if np.isnan(X.shape).any():
        raise invalid(
            "X", expected="a dask array of known chunks", got="unknown sizes", cure="X.compute_chunk_sizes() first."
        )
    if X.numblocks[1] != 1:
        got, cure = f"{X.numblocks[1]} chunks along the columns", "X.rechunk({1: -1}) makes rows whole."
        raise invalid("X", expected="a dask array chunked along rows alone", got=got, cure=cure)


def _active_client():
    """The `dask.distributed` client of this thread, or None."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return distributed.get_client()
    except ValueError:
        return None


def _run_on_workers(client, calls, data) -> Iterator:
    """The calls' results in order; the number of pending calls is limited, so that not all data are in memory."""
    import dask

    most = _TASKS_PER_THREAD * max(1, sum(client.nthreads().values()))
    waiting = deque()
    for call, (chunks, weights) in zip(calls, data, strict=True):
        waiting.append(client.compute(dask.delayed(call, traverse=False)(chunks, weights)))
        if len(waiting) >= most:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def _compute_each(chunks) -> Iterator:
    """Compute one after another, by dask's configured scheduler."""
    return (chunk.compute() if _is_dask(chunk) else chunk for chunk in chunks)


def _run_part(task, first, width, own, arguments, chunks, weights):
    """Run a task on one part's chunks, in order."""

    def read():
        for number, (x, w) in enumerate(zip(chunks, weights, strict=True), first):
            x = _check_chunk(number, x, None)
            yield number, x, _check_weights(number, w, len(x))

    return task(_split_pieces(read(), width), *own, *arguments)


def _map_block(function, fitted, width, x, block_info=None):
    return _map_chunk(function, fitted, width, x, block_info[0]["chunk-location"][0])


# --- iterables ------------------------------------------------------------------------------------------------

_MISSING = object()


def _check_iterable(name: str, chunks) -> None:
    """Raise unless `chunks` can be iterated repeatedly."""
    if not isinstance(chunks, Iterable):
        raise invalid(name, expected="chunks of rows", got=type(chunks).__name__, cure=_SOURCES)
    if iter(chunks) is chunks:
        got = f"{type(chunks).__name__}, which can be read only once"
        raise invalid(name, expected="chunks that can be read again in each pass", got=got, cure=_SOURCES)


def _is_array(value) -> bool:
    """Whether `value` is one array of rows, such as a list of numbers."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return len(value) > 0 and isinstance(value[0], Real)
    return not isinstance(value, Real) and (hasattr(value, "__array__") or hasattr(value, "shape"))


def _check_weights(number: int, weights, num: int) -> np.ndarray:
    """The weights of the `num` rows of a chunk, given as an array, as a number for all, or as None for 1."""
    if weights is _MISSING:
        raise invalid("sample_weight", expected=f"as many chunks as X, at least {number + 1}", got=number)
    if weights is None or isinstance(weights, Real):
        return np.broadcast_to(np.float64(1 if weights is None else weights), (num,))
    weights = np.asarray(weights)
    if weights.shape != (num,):
        cure = "One weight for each row of X."
        raise invalid(
            f"sample_weight, chunk {number}", expected=f"shape ({num},)", got=f"shape {weights.shape}", cure=cure
        )
    return weights


# --- checks ---------------------------------------------------------------------------------------------------


def _check_chunk(number: int, x, width: int | None):
    """The chunk as a two-dimensional array, or as a lazy one that is read when sliced."""
    if not all(hasattr(x, name) for name in ("dtype", "shape", "__array__")):
        x = np.asarray(x)
    name = f"X, chunk {number}"
    if len(x.shape) != 2:
        got = f"{type(x).__name__} of shape {tuple(x.shape)}"
        raise invalid(name, expected="an array (n, d)", got=got, cure="One row alone is x[None].")
    if getattr(x.dtype, "kind", "O") not in "biuf":
        raise invalid(name, expected="real numbers", got=f"dtype {x.dtype}", cure="Convert it by astype(np.float64).")
    if width is not None and x.shape[1] != width:
        raise invalid(name, expected=f"{width} columns", got=x.shape[1], cure="All chunks have the same columns.")
    return x


def _split_pieces(chunks: Iterable[tuple], width: int | None) -> Iterator[Piece]:
    """Split chunks to checked pieces; `width` None means that of the first chunk."""
    for number, x, weights in chunks:
        x = _check_chunk(number, x, width)
        width = x.shape[1]
        for row in range(0, len(x), _PIECE_ROWS):
            rows = slice(row, row + _PIECE_ROWS)
            part = np.asarray(x[rows])
            part = part if part.dtype == np.float32 else part.astype(np.float64, copy=False)
            yield Piece(part, _check_values(number, row, part, weights[rows]))


def _map_chunk(function, fitted, width: int, x, number: int):
    pieces = _split_pieces([(number, x, np.broadcast_to(1.0, len(x)))], width)
    parts = [function(fitted, part) for part, _ in pieces]
    return np.concatenate(parts) if parts else function(fitted, np.zeros((0, width)))


def _check_values(number: int, row: int, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The weights in the dtype of x. **Raises:** ValueError on NaN, infinity, and negative weights."""
    finite = np.isfinite(x).all(1) | (weights == 0)
    if not finite.all():
        got = f"NaN or infinity in its row {row + int(np.argmin(finite))}"
        raise invalid(f"X, chunk {number}", expected="finite numbers", got=got, cure="Remove such rows.")
    if weights.dtype.kind not in "biuf":
        raise invalid(f"sample_weight, chunk {number}", expected="real numbers", got=f"dtype {weights.dtype}")
    valid = np.isfinite(weights) & (weights >= 0)
    if not valid.all():
        k = int(np.argmin(valid))
        got = f"{weights[k]} in its row {row + k}"
        raise invalid(f"sample_weight, chunk {number}", expected="numbers >= 0", got=got, cure="0 leaves a row out.")
    return weights.astype(x.dtype)


# --- tasks ----------------------------------------------------------------------------------------------------


class RowSummary(NamedTuple):
    """Summary of all rows from one pass; rows of weight 0 count in `num_rows` only."""

    num_rows: int
    size: int  # rows with weight
    total: float  # of the weights
    mean: Float[np.ndarray, " d"] | None
    scatter: Float[np.ndarray, " d"] | None  # sum of w (x - mean)^2
    single: bool  # all are float32

    def merge(self, other: "RowSummary") -> "RowSummary":
        """The summary of both sets of rows, from their centered sums of squares.

        **Source:** Chan, Golub and LeVeque 1983, Algorithms for computing the sample variance.
        """
        counts = (self.num_rows + other.num_rows, self.size + other.size, self.total + other.total)
        single = self.single and other.single
        if not (self.size and other.size):
            present = self if self.size else other
            return RowSummary(*counts, present.mean, present.scatter, single)
        fraction, shift = other.total / counts[2], other.mean - self.mean
        scatter = self.scatter + other.scatter + (self.total * fraction) * shift**2
        return RowSummary(*counts, self.mean + fraction * shift, scatter, single)


def weighted_moments(x: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and variance per coordinate, in float64."""
    weights = (weights / weights.sum(dtype=np.float64)).astype(np.float64)
    mean = weights @ x
    centered = x - mean
    correction = weights @ centered
    return mean + correction, weights @ (centered - correction) ** 2


def summarize_rows(chunks: Chunks) -> tuple[RowSummary, list[int]]:
    """Summarize all rows in one pass; also the number of rows of positive weight in each part."""
    parts = list(chunks.run(_summarize))
    if not any(part.num_rows for part in parts):
        raise invalid("X", expected="at least one chunk with rows", got="none", cure=_SOURCES)
    return functools.reduce(RowSummary.merge, parts), [part.size for part in parts]


def _summarize(pieces: Iterable[Piece]) -> RowSummary:
    whole = RowSummary(0, 0, 0.0, None, None, True)
    for x, weights in pieces:
        present = weights > 0
        one = RowSummary(len(x), int(present.sum()), 0.0, None, None, x.dtype == np.float32)
        if one.size:
            total = float(weights.sum(dtype=np.float64))
            mean, variance = weighted_moments(x[present], weights[present])
            one = one._replace(total=total, mean=mean, scatter=total * variance)
        whole = whole.merge(one)
    return whole


def collect_rows(chunks: Chunks, sizes: Sequence[int], indices: Int[np.ndarray, " m"] | None, prepare) -> tuple:
    """The prepared rows with these indices among rows of positive weight (None: all), in ascending order."""
    firsts = np.cumsum((0, *sizes))
    each = [None] * len(sizes)
    if indices is not None:
        indices = np.sort(indices)
        each = [indices[(a <= indices) & (indices < b)] - a for a, b in itertools.pairwise(firsts)]
    parts = [part for parts in chunks.run(_collect, prepare, each=each) for part in parts]
    return np.concatenate([y for y, _ in parts]), np.concatenate([weights for _, weights in parts])


def _collect(pieces, indices, prepare):
    parts, first = [], 0
    for piece in pieces:
        y, weights = prepare(piece)
        if indices is not None:
            local = indices[(first <= indices) & (indices < first + len(y))] - first
            first += len(y)
            y, weights = y[local], weights[local]
        if len(y):
            parts.append((y, weights))
    return parts
