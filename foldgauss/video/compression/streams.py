"""The streams of bytes that a compact file consists of, beside its header: frame times, shared paths, and columns."""

import numpy as np
from jaxtyping import Int

from foldgauss.video.compression import range_coder
from foldgauss.video.compression.column_contexts import ColumnContexts
from foldgauss.video.compression.quantize import Chunk, CompactInfo, PathsInfo, Quantized, Rule


def encode_motion(quantized: Quantized) -> list[bytes]:
    """The streams of what all chunks need: the intervals of the frame times, and of shared paths the knots and maps."""
    about, streams = quantized.info.paths, [_encode_plainly(quantized.intervals)]
    if about is None:
        return streams
    # Empty if knots are at the frames. Both are differences in time.
    knots = b"" if quantized.knots is None else _encode_plainly(np.diff(quantized.knots, axis=1, prepend=0).ravel())
    coded = np.diff(quantized.maps, axis=1, prepend=path_identities(about))
    return [*streams, knots, range_coder.encode(coded.ravel(), describe_maps(about))]


def encode_chunk(chunk: Chunk, rules: dict[str, Rule], info: CompactInfo) -> list[bytes]:
    """The streams of a chunk's columns, in their order."""
    contexts, streams = ColumnContexts(rules, info, chunk.cells, chunk.num), []
    for name in info.column_names:
        numbers = coded = chunk.columns[name]
        if name == "cell":  # from each to the next, around the end
            coded = np.diff(numbers, prepend=0) & last_cell(chunk.cells)
        streams.append(range_coder.encode(coded, contexts.describe_next(name)))
        contexts.add(name, numbers)
    return streams


def last_cell(cells: tuple[int, int, int]) -> int:
    """The largest number of a cell."""
    return (1 << sum(cells)) - 1


def path_identities(about: PathsInfo) -> Int[np.ndarray, "paths 1 2 3"]:
    """The integers of maps that do not move anything."""
    return np.tile(np.eye(2, 3, dtype=np.int64) << about.bits, (about.num_paths, 1, 1, 1))


def describe_maps(about: PathsInfo) -> range_coder.Column:
    """Contexts: which of a map's six numbers it is, and the same number of the knot before."""
    num = 6 * about.num_paths * about.num_knots
    place = np.arange(num, dtype=np.int32)
    near = np.where(place // 6 % about.num_knots > 0, place - 6, -1)
    contexts = np.stack([place % 6, np.zeros_like(place)], 1).astype(np.uint8)
    return range_coder.Column.without_contexts(num)._replace(contexts=contexts, near=near.astype(np.int32)[:, None])


def _encode_plainly(numbers: Int[np.ndarray, " num"]) -> bytes:
    return range_coder.encode(numbers, range_coder.Column.without_contexts(len(numbers)))
