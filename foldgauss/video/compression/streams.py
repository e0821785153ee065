"""The streams of bytes that a compact file consists of, beside its header: columns, frame times, and shared paths."""

import dataclasses

import numpy as np
from jaxtyping import Int

from foldgauss.video.compression import range_coder
from foldgauss.video.compression.column_contexts import ColumnContexts
from foldgauss.video.compression.quantize import CompactInfo, Quantized
from foldgauss.video.compression.quantized_paths import PathsInfo

#: The streams of shared paths.
PATH_STREAMS = "knots", "maps"


def encode_streams(quantized: Quantized) -> dict[str, bytes]:
    """The streams by name, in the order of the file: columns, "intervals", and of shared paths "knots" and "maps"."""
    info, contexts, streams = quantized.info, ColumnContexts(quantized.rules, quantized.info), {}
    for name in info.column_names:
        numbers = coded = quantized.columns[name]
        if name == "cell":  # from each to the next, around the end
            coded = np.diff(numbers, prepend=0) & last_cell(info)
        streams[name] = range_coder.encode(coded, contexts.describe_next(name))
        contexts.add(name, numbers)
    streams["intervals"] = _encode_plainly(quantized.intervals)
    if info.paths is None:
        return streams
    # Empty if knots are at the frames. Both are differences in time.
    knots = b"" if quantized.knots is None else _encode_plainly(np.diff(quantized.knots, axis=1, prepend=0).ravel())
    coded = np.diff(quantized.maps, axis=1, prepend=path_identities(info.paths))
    return streams | {"knots": knots, "maps": range_coder.encode(coded.ravel(), describe_maps(info.paths))}


def last_cell(info: CompactInfo) -> int:
    """The largest number of a cell."""
    return (1 << sum(info.cells)) - 1


def path_identities(about: PathsInfo) -> Int[np.ndarray, "paths 1 2 3"]:
    """The integers of maps that do not move anything."""
    return np.tile(np.eye(2, 3, dtype=np.int64) << about.bits, (about.num_paths, 1, 1, 1))


def describe_maps(about: PathsInfo) -> range_coder.Column:
    """Contexts: which of a map's six numbers it is, and the same number of the knot before."""
    num = 6 * about.num_paths * about.num_knots
    place = np.arange(num, dtype=np.int32)
    near = np.where(place // 6 % about.num_knots > 0, place - 6, -1)
    contexts = np.stack([place % 6, np.zeros_like(place)], 1).astype(np.uint8)
    return dataclasses.replace(
        range_coder.Column.without_contexts(num), contexts=contexts, near=near.astype(np.int32)[:, None]
    )


def _encode_plainly(numbers: Int[np.ndarray, " num"]) -> bytes:
    return range_coder.encode(numbers, range_coder.Column.without_contexts(len(numbers)))
