"""Rows in chunks, for data larger than memory: read anew in every pass, one piece at a time.

A source of chunks is a dask array, an iterable of arrays that can be gone through again (a list of `np.memmap`, an
object whose `__iter__` reads files), or a function that returns a fresh iterator. What is done in a pass is a task, a
function of pieces: of a dask array it is done by parts, on workers where a `dask.distributed` client is active, and
the results come in the order of the rows. dask is imported only if the rows are a dask array.
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

__all__ = ["Chunks", "Piece", "Survey", "chunks_of", "is_chunked", "picked", "survey", "variances_of"]

#: Rows that are looked at together: temporary arrays are no larger than this, whatever the chunks are.
_PIECE_ROWS = 2**16
#: Tasks given to the workers before the first of them is waited for, for each of their threads.
_TASKS_PER_THREAD = 2
_FORMS = "A list of arrays, an object whose __iter__ reads files, or a function that returns a fresh iterator."


class Piece(NamedTuple):
    """Some rows of a chunk, checked: float32 as they were, or float64; weights of the same dtype."""

    x: Float[np.ndarray, "n d"]
    weights: Float[np.ndarray, " n"]


def is_chunked(X) -> bool:
    """Whether X is chunks of rows rather than rows: decided without reading any, and without importing dask."""
    if _dask_kind(X):
        return True
    if any(hasattr(X, name) for name in ("__array__", "__array_interface__", "__dataframe__", "shape")):
        return False
    if isinstance(X, Sequence) and not isinstance(X, str | bytes):
        return len(X) > 0 and len(getattr(X[0], "shape", ())) == 2
    return callable(X) or (isinstance(X, Iterable) and not isinstance(X, str | bytes | Mapping | Set))


def chunks_of(X, sample_weight=None, width: int | None = None) -> "Chunks":
    """The source of the chunks X; `width` is the number of columns, where it is known before.

    `sample_weight` is chunked as X is, or an array of one weight a row, or a number for all.

    **Raises:** ValueError where X can be read only once, or is a dask array of unknown or unfit chunks.
    """
    return (_DaskChunks if _dask_kind(X) else _Stream)(X, sample_weight, width)


class Chunks(abc.ABC):
    """Chunks that can be gone through again and again. `num_parts` tasks make a pass."""

    num_parts: int
    width: int | None
    on_workers = False

    @abc.abstractmethod
    def run(self, task: Callable, *arguments, each: Sequence | None = None) -> Iterator:
        """`task(pieces, *arguments)` of every part, or `task(pieces, each[part], *arguments)`; in order."""

    @abc.abstractmethod
    def mapped(self, function: Callable, known, *, num_columns: int | None = None, dtype=None):
        """`function(known, x)` of each chunk, (n_i,) or (n_i, num_columns): an iterator, or a dask array.

        `dtype` is that of the results, by default float32 of float32 chunks and else float64.
        """


class _Stream(Chunks):
    """An iterable of arrays, or a function that returns one: a single part."""

    num_parts = 1

    def __init__(self, X, sample_weight, width):
        self._rows, self._weights, self.width = _again("X", X), sample_weight, width
        self._num_rows = None
        if _is_array(sample_weight):
            self._weights = np.asarray(sample_weight)
        elif not (sample_weight is None or isinstance(sample_weight, Real)):
            self._weights = _again("sample_weight", sample_weight)

    def run(self, task, *arguments, each=None):
        given = () if each is None else (each[0],)
        yield task(_pieces(self._chunks(), self.width), *given, *arguments)

    def mapped(self, function, known, *, num_columns=None, dtype=None):
        return (_of_chunk(function, known, self.width, x, number) for number, x in enumerate(self._rows()))

    def _chunks(self):
        weights, row = _weights_by_chunk(self._weights), 0
        for number, x in enumerate(self._rows()):
            x = _shaped(number, x, self.width)
            self.width = x.shape[1]
            yield number, x, next(weights)(number, row, len(x))
            row += len(x)
        if self._num_rows is None:
            _check_end(self._weights, weights, row)
            self._num_rows = row
        if row != self._num_rows:
            got, cure = f"{self._num_rows} at first and {row} now", f"Each pass reads them anew. {_FORMS}"
            raise invalid("X", expected="the same rows in each pass", got=got, cure=cure)


class _DaskChunks(Chunks):
    """A dask array, chunked along its rows: small chunks are taken together, as one part."""

    def __init__(self, X, sample_weight, width):
        _check_dask(X)
        if width not in (None, X.shape[1]):
            raise invalid("X", expected=f"{width} columns", got=X.shape[1], cure="Those of the fit.")
        self._array, self.width, self._sizes = X, X.shape[1], X.chunks[0]
        self._delayed, rows = X.to_delayed().ravel().tolist(), np.cumsum((0, *self._sizes))
        self._weights = self._weights_of(X, sample_weight, rows)
        parts, first = [], 0
        for k in range(len(self._sizes)):
            if rows[k + 1] - rows[first] >= _PIECE_ROWS or k + 1 == len(self._sizes):
                parts.append((first, k + 1))
                first = k + 1
        self._parts, self.num_parts = parts, len(parts)
        self._client = _active_client()
        self.on_workers = self._client is not None

    def _weights_of(self, X, weights, rows) -> list:
        """Weights by chunk: None, a number, an array, or what dask will compute."""
        if weights is None or isinstance(weights, Real):
            return [weights] * len(self._sizes)
        if _dask_kind(weights):
            if weights.shape != X.shape[:1]:
                raise invalid("sample_weight", expected=f"shape {X.shape[:1]}", got=f"shape {weights.shape}")
            return weights.rechunk((self._sizes,)).to_delayed().ravel().tolist()
        if not _is_array(weights):
            got = type(weights).__name__
            raise invalid("sample_weight", expected="a dask or NumPy array, a number or None", got=got)
        weights = np.asarray(weights)
        if weights.shape != X.shape[:1]:
            raise invalid("sample_weight", expected=f"shape {X.shape[:1]}", got=f"shape {weights.shape}")
        return [weights[a:b] for a, b in itertools.pairwise(rows)]

    def run(self, task, *arguments, each=None):
        calls = (
            functools.partial(_part, task, first, self.width, () if each is None else (each[k],), arguments)
            for k, (first, _) in enumerate(self._parts)
        )
        data = ((self._delayed[a:b], self._weights[a:b]) for a, b in self._parts)
        if self.on_workers:
            yield from _by_workers(self._client, calls, data)
        else:
            for call, (chunks, weights) in zip(calls, data, strict=True):
                yield call(_computed(chunks), _computed(weights))

    def mapped(self, function, known, *, num_columns=None, dtype=None):
        one = functools.partial(_of_block, function, known, self.width)
        dtype = np.dtype(dtype or (np.float32 if self._array.dtype == np.float32 else np.float64))
        if num_columns is None:
            return self._array.map_blocks(one, dtype=dtype, drop_axis=1, meta=np.zeros(0, dtype))
        chunks = (self._array.chunks[0], (num_columns,))
        return self._array.map_blocks(one, dtype=dtype, chunks=chunks, meta=np.zeros((0, 0), dtype))


# --- dask -----------------------------------------------------------------------------------------------------


def _dask_kind(X) -> bool:
    """Whether X is dask's: then dask was imported by whoever made it."""
    return "dask" in sys.modules and hasattr(X, "__dask_graph__")


def _check_dask(X) -> None:
    import dask.array

    if not isinstance(X, dask.array.Array):
        cure = "Of a dask DataFrame: .to_dask_array(lengths=True)."
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
    """The client of `dask.distributed` that this thread would use, None where there is none."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return distributed.get_client()
    except ValueError:
        return None


def _by_workers(client, calls, data) -> Iterator:
    """The calls' results in order; only some are under way at once, so that their data are not all held."""
    import dask

    most = _TASKS_PER_THREAD * max(1, sum(client.nthreads().values()))
    waiting = deque()
    for call, (chunks, weights) in zip(calls, data, strict=True):
        waiting.append(client.compute(dask.delayed(call, traverse=False)(chunks, weights)))
        if len(waiting) >= most:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def _computed(chunks) -> Iterator:
    """One after another, by the scheduler that dask is set to."""
    return (chunk.compute() if _dask_kind(chunk) else chunk for chunk in chunks)


def _part(task, first, width, given, arguments, chunks, weights):
    """A task on one part's chunks, in order."""

    def numbered():
        for number, (x, w) in enumerate(zip(chunks, weights, strict=True), first):
            x = _shaped(number, x, None)
            yield number, x, _weights_of_chunk(w)(number, 0, len(x))

    return task(_pieces(numbered(), width), *given, *arguments)


def _of_block(function, known, width, x, block_info=None):
    return _of_chunk(function, known, width, x, block_info[0]["chunk-location"][0])


# --- iterables ------------------------------------------------------------------------------------------------


def _again(name: str, chunks) -> Callable[[], Iterator]:
    """A function that begins a new pass."""
    if isinstance(chunks, Iterable):
        if iter(chunks) is chunks:
            got = f"{type(chunks).__name__}, which can be read but once"
            raise invalid(name, expected="chunks that can be read again in each pass", got=got, cure=_FORMS)
        made = lambda: chunks  # noqa: E731
    elif callable(chunks):
        made = chunks
    else:
        raise invalid(name, expected="chunks of rows", got=type(chunks).__name__, cure=_FORMS)

    def begin():
        found = made()
        if _is_array(found) or not isinstance(found, Iterable):
            raise invalid(name, expected="an iterable of chunks", got=type(found).__name__, cure=_FORMS)
        return iter(found)

    return begin


def _is_array(value) -> bool:
    """One array of rows: a list of numbers is one too."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return len(value) > 0 and isinstance(value[0], Real)
    return hasattr(value, "__array__") or hasattr(value, "shape")


def _weights_by_chunk(weights) -> Iterator[Callable]:
    """For each chunk a function (number, first row, rows) of its weights."""
    if not callable(weights):
        while True:
            yield _weights_of_chunk(weights, whole=True)
    for one in weights():
        yield _weights_of_chunk(one)
    while True:
        yield _no_weights


def _no_weights(number, row, num):
    raise invalid("sample_weight", expected=f"as many chunks as X, at least {number + 1}", got=number)


def _weights_of_chunk(weights, whole: bool = False) -> Callable:
    def of_chunk(number, row, num):
        if weights is None or isinstance(weights, Real):
            return np.broadcast_to(np.float64(1 if weights is None else weights), (num,))
        found = weights[row : row + num] if whole else np.asarray(weights)
        if found.shape != (num,):
            cure = "One weight for each row of X."
            raise invalid(
                f"sample_weight, chunk {number}", expected=f"shape ({num},)", got=f"shape {found.shape}", cure=cure
            )
        return found

    return of_chunk


def _check_end(weights, left: Iterator, row: int) -> None:
    if callable(weights):
        if next(left) is not _no_weights:
            raise invalid("sample_weight", expected="as many chunks as X", got="more")
    elif isinstance(weights, np.ndarray) and len(weights) != row:
        raise invalid("sample_weight", expected=f"{row} weights, one for each row", got=len(weights))


# --- checks ---------------------------------------------------------------------------------------------------


def _shaped(number: int, x, width: int | None):
    """The chunk as something of two dimensions that can be sliced: an array, or a file's that is read when sliced."""
    if not all(hasattr(x, name) for name in ("dtype", "shape", "__array__")):
        x = np.asarray(x)
    name = f"X, chunk {number}"
    if len(x.shape) != 2:
        got = f"{type(x).__name__} of shape {tuple(x.shape)}"
        raise invalid(name, expected="an array (n, d)", got=got, cure="One row alone is x[None].")
    if getattr(x.dtype, "kind", "O") not in "biuf":
        raise invalid(name, expected="real numbers", got=f"dtype {x.dtype}", cure="astype(np.float64), say.")
    if width is not None and x.shape[1] != width:
        raise invalid(name, expected=f"{width} columns", got=x.shape[1], cure="All chunks have the same columns.")
    return x


def _pieces(chunks: Iterable[tuple], width: int | None) -> Iterator[Piece]:
    """Chunks cut and checked; `width` is that of the first chunk where it is None."""
    for number, x, weights in chunks:
        _shaped(number, x, width)
        width = x.shape[1]
        for row in range(0, len(x), _PIECE_ROWS):
            rows = slice(row, row + _PIECE_ROWS)
            part = np.asarray(x[rows])
            part = part if part.dtype == np.float32 else part.astype(np.float64, copy=False)
            yield Piece(part, _checked(number, row, part, weights[rows]))


def _of_chunk(function, known, width: int, x, number: int):
    parts = [function(known, part) for part, _ in _pieces([(number, x, np.broadcast_to(1.0, len(x)))], width)]
    return np.concatenate(parts) if parts else function(known, np.zeros((0, width)))


def _checked(number: int, row: int, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The weights in the dtype of x. **Raises:** ValueError on NaN or infinity, and weights below 0."""
    finite = np.isfinite(x).all(1)
    if not finite.all():
        got = f"NaN or infinity in its row {row + int(np.argmin(finite))}"
        raise invalid(f"X, chunk {number}", expected="finite numbers", got=got, cure="Take such rows out.")
    if weights.dtype.kind not in "biuf":
        raise invalid(f"sample_weight, chunk {number}", expected="real numbers", got=f"dtype {weights.dtype}")
    fit = np.isfinite(weights) & (weights >= 0)
    if not fit.all():
        k = int(np.argmin(fit))
        got = f"{weights[k]} in its row {row + k}"
        raise invalid(f"sample_weight, chunk {number}", expected="numbers >= 0", got=got, cure="0 takes a row out.")
    return weights.astype(x.dtype)


# --- what passes find -----------------------------------------------------------------------------------------


class Survey(NamedTuple):
    """What one pass tells of all rows; those without weight count in `num_rows` alone."""

    num_rows: int
    size: int  # rows with weight
    total: float  # of the weights
    mean: Float[np.ndarray, " d"] | None
    scatter: Float[np.ndarray, " d"] | None  # sum of w (x - mean)^2
    single: bool  # all are float32

    def merged(self, other: "Survey") -> "Survey":
        """Both together: squares are of numbers centred before, here and there.

        **Source:** Chan, Golub and LeVeque 1983, Algorithms for computing the sample variance.
        """
        counts = (self.num_rows + other.num_rows, self.size + other.size, self.total + other.total)
        single = self.single and other.single
        if not (self.size and other.size):
            known = self if self.size else other
            return Survey(*counts, known.mean, known.scatter, single)
        share, apart = other.total / counts[2], other.mean - self.mean
        scatter = self.scatter + other.scatter + (self.total * share) * apart**2
        return Survey(*counts, self.mean + share * apart, scatter, single)


def variances_of(x: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and variance per coordinate, in float64."""
    share = (weights / weights.sum(dtype=np.float64)).astype(np.float64)
    mean = share @ x
    centred = x - mean
    correction = share @ centred
    return mean + correction, share @ (centred - correction) ** 2


def survey(chunks: Chunks) -> tuple[Survey, list[int]]:
    """One pass: what there is, and how many rows with weight each part has. The columns are those of X."""
    found = list(chunks.run(_surveyed))
    if not any(part.num_rows for part in found):
        raise invalid("X", expected="at least one chunk with rows", got="none", cure=_FORMS)
    return functools.reduce(Survey.merged, found), [part.size for part in found]


def _surveyed(pieces: Iterable[Piece]) -> Survey:
    whole = Survey(0, 0, 0.0, None, None, True)
    for x, weights in pieces:
        there = weights > 0
        one = Survey(len(x), int(there.sum()), 0.0, None, None, x.dtype == np.float32)
        if one.size:
            total = float(weights.sum(dtype=np.float64))
            mean, variance = variances_of(x[there], weights[there])
            one = one._replace(total=total, mean=mean, scatter=total * variance)
        whole = whole.merged(one)
    return whole


def picked(chunks: Chunks, sizes: Sequence[int], numbers: Int[np.ndarray, " m"] | None, prepare) -> tuple:
    """The rows with these numbers, in ascending order, counted among those with weight (None: all), prepared."""
    firsts = np.cumsum((0, *sizes))
    each = [None] * len(sizes)
    if numbers is not None:
        numbers = np.sort(numbers)
        each = [numbers[(a <= numbers) & (numbers < b)] - a for a, b in itertools.pairwise(firsts)]
    parts = [part for parts in chunks.run(_picked, prepare, each=each) for part in parts]
    return np.concatenate([y for y, _ in parts]), np.concatenate([weights for _, weights in parts])


def _picked(pieces, numbers, prepare):
    parts, first = [], 0
    for piece in pieces:
        y, weights = prepare(piece)
        if numbers is not None:
            here = numbers[(first <= numbers) & (numbers < first + len(y))] - first
            first += len(y)
            y, weights = y[here], weights[here]
        if len(y):
            parts.append((y, weights))
    return parts
