"""Compact model files, .fgz: quantized, entropy-coded, checked, and decoded to the same bits everywhere.

The layout is in docs/format.md. Files are not trusted: checksums detect damage, counts are checked
against the size of the file, and invalid content raises only `ModelFileError`. A chunk that is damaged or has not
arrived is left out, with a warning.
"""

import dataclasses
import io
import json
import math
import os
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from foldgauss._runtime.checks import check_one_of, is_integer, is_within, require, short_repr
from foldgauss.io._atomic import PathLike, atomic_path, check_path
from foldgauss.io.models.model_file import (
    HEADER_ERRORS,
    ModelFileError,
    model_file_error,
    one_line,
    to_json,
    to_json_types,
)
from foldgauss.render import COMPOSITINGS, RenderOptions
from foldgauss.video.compression import range_coder
from foldgauss.video.compression.chunks import visible_spans
from foldgauss.video.compression.column_contexts import ColumnContexts
from foldgauss.video.compression.quantize import (
    FEATURES,
    LARGEST,
    MAX_CELL_BITS,
    MAX_CHUNKS,
    MAX_PATH_BITS,
    MAX_TIME_BITS,
    Chunk,
    CompactInfo,
    PathsInfo,
    Quantized,
    Rule,
    decode_values,
    dequantize,
    is_integral,
)
from foldgauss.video.compression.streams import (
    describe_maps,
    encode_chunk,
    encode_motion,
    last_cell,
    path_identities,
)
from foldgauss.video.editing.edited_video import EditedVideo, Layer
from foldgauss.video.models.row_layout import MAX_DEGREE
from foldgauss.video.models.shared_paths import MAX_PATHS
from foldgauss.video.models.video_model import VideoModel

COMPACT_SUFFIX = ".fgz"
#: As in PNG: a byte that is not ASCII, line ends of both kinds, which a transfer as text would change, an end of file.
MAGIC = b"\x8bFGZ\r\n\x1a\n"
VERSION = 6
#: Magic, version, length of the header, checksum of the header.
_FIXED = len(MAGIC) + 12
#: Limit of numbers per byte of a block, so that a small file cannot claim much memory. Clips need 1. What blocks lack,
#: all together, the header has: it is padded with spaces.
_MOST_PER_BYTE = 32
#: Bytes of metadata that sizes of files are planned for, see `video.fitting.rate.HEADER_BYTES`.
_METADATA_BYTES = 1000
_ROUNDING = 1e-6  # by which the times of a model, float32, may differ from those computed here
_SIDE = 1 << 20  # largest side of an image: a decoder holds it in memory


def save_compact(
    path: PathLike, quantized: Quantized | Mapping[str, Quantized], *, metadata: dict | None = None
) -> Path:
    """Write a quantized model whole or not at all; equal ones give equal bytes. See `foldgauss.video.compress`.

    Layers are given by name, from front to back. The file has them one after another, the last one first.

    Raises ValueError for a name that does not end in .fgz, `OutputError` where it cannot be written.
    """
    path = check_path(path, "path, quantized")
    check_compact_name(path)
    layers = quantized if isinstance(quantized, Mapping) else {"": quantized}
    data = [pack_compact(one, {} if n else metadata, name) for n, (name, one) in enumerate(reversed(layers.items()))]
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"".join(data))
    return path


def leave_room(size_mb: float | None, metadata: dict) -> float | None:
    """The size of a file, in 10^6 bytes, without its metadata where these are longer than usual."""
    excess = len(to_json("metadata", to_json_types(metadata))) - _METADATA_BYTES
    return size_mb if size_mb is None or excess <= 0 else max(size_mb - 1e-6 * excess, 1e-6)


def check_compact_name(path: Path, parameter: str = "path") -> None:
    """Raise ValueError for a name that is not a compact file's."""
    require(
        path.suffix.lower() == COMPACT_SUFFIX,
        parameter,
        expected=f"a name ending in {COMPACT_SUFFIX}",
        got=repr(str(path)),
    )


def pack_compact(quantized: Quantized, metadata: dict | None = None, layer: str = "") -> bytes:
    """The bytes of the file, or of a layer in it."""
    info, names = quantized.info, quantized.info.column_names
    header = dataclasses.asdict(info) | {"num_frames": len(quantized.intervals) + 1, "rules": []}
    for name in names:
        rule = quantized.rules.get(name)
        header["rules"].append([] if is_integral(name) else [rule.origin, rule.exponent, *rule.slopes])
    if info.paths is None:
        del header["paths"]
    motion, parts, counts = encode_motion(quantized), [], [header["num_frames"] + _count_path_numbers(info)]
    header["motion"] = _describe_streams(motion)
    header["chunks"] = []
    for chunk in quantized.chunks:
        streams = encode_chunk(chunk, quantized.rules, info)
        own = {"num_gaussians": chunk.num, "cells": chunk.cells, "visible": _find_visible_span(quantized, chunk)}
        header["chunks"].append(own | _describe_streams(streams))
        parts.append(b"".join(streams))
        counts.append(chunk.num * len(names))
    header |= {"metadata": to_json_types(metadata or {})} | ({"layer": layer} if layer else {})
    text, blocks = to_json("header", header).encode(), [b"".join(motion), *parts]
    lacking = sum(_count_lacking(count, len(block)) for count, block in zip(counts, blocks, strict=True))
    text += b" " * (lacking - len(text))
    numbers = (VERSION, len(text), zlib.crc32(text))
    return MAGIC + b"".join(number.to_bytes(4, "little") for number in numbers) + text + b"".join(blocks)


def _describe_streams(streams: list[bytes]) -> dict[str, Any]:
    return {"streams": [len(stream) for stream in streams], "crc": zlib.crc32(b"".join(streams))}


def _count_lacking(num_values: int, num_bytes: int) -> int:
    """The bytes that the header has instead of a block that is shorter than its numbers need."""
    return max(-(-num_values // _MOST_PER_BYTE) - num_bytes, 0)


def _find_visible_span(quantized: Quantized, chunk: Chunk) -> list[float]:
    """Times, in [0, 1], before and after which nothing of a chunk is visible."""
    values = decode_values(dataclasses.replace(quantized, chunks=(chunk,)))
    first, last = visible_spans(values["time"], values["duration"])
    low, high = first.min() - _ROUNDING, last.max() + _ROUNDING
    return [max(math.floor(1e4 * low) / 1e4, 0.0), min(math.ceil(1e4 * high) / 1e4, 1.0)]


def _count_path_numbers(info: CompactInfo) -> int:
    own = info.paths
    return 0 if own is None else own.num_paths * own.num_knots * (6 if own.at_frames else 7)


# ---------------------------------------------------------------------------------------------- reading


def is_compact(path: PathLike) -> bool:
    """Whether a file starts with the magic bytes of compact files; False for one that cannot be read."""
    if not os.path.isfile(path):  # to open a pipe may not end
        return False
    try:
        with open(path, "rb") as file:
            return file.read(4) == MAGIC[:4]
    except OSError:
        return False


def load_compact(path: PathLike, *, visible: tuple[float, float] = (0.0, 1.0)) -> Quantized:
    """The quantized model in a compact file, for `foldgauss.video.compression.quantize.dequantize`.

    `visible`: the first and the last time that the model is needed for, in [0, 1]. Chunks of which nothing is visible
    then are not decoded, and their Gaussians are missing; but the first chunk always is.

    A chunk that is damaged or cut off is left out, with a warning. Raises `ModelFileError` for a file of which no chunk
    can be read, of another version or of another kind, ValueError for other times.
    """
    path = check_path(path)
    right = isinstance(visible, tuple | list) and len(visible) == 2 and all(is_within(t, "[0, 1]") for t in visible)
    require(
        right and visible[0] <= visible[1],
        "visible",
        expected="the first and the last time, in [0, 1]",
        got=short_repr(visible),
    )
    return _load(path, path.read_bytes(), visible, stacklevel=3)[0]


def load_compact_model(path: Path, data: bytes | None = None) -> VideoModel | EditedVideo:
    """The model in a compact file, or in `data`, the bytes of one that is a part of a file; or its layers.

    Raises as `load_compact`, also for values beyond float32. Warnings point at the caller of the function that calls
    this one, `load_video_model`.
    """
    rest, layers = path.read_bytes() if data is None else data, []
    while rest:
        try:
            quantized, name, rest = _load(path, rest, stacklevel=4)
        except ModelFileError:
            if not layers:
                raise
            told = f"what follows layer {len(layers)} is no layer that can be read, but cut off or damaged"
            warnings.warn(f"{str(path)!r}: {told}. Copy it again.", stacklevel=3)
            break
        with np.errstate(over="ignore", invalid="ignore"):
            model = dequantize(quantized)
        finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
        _check_file(finite, path, "one with values beyond float32")
        layers.insert(0, Layer(model, name=name))
    return EditedVideo(tuple(layers)) if layers[-1].name else layers[-1].model


def _load(
    path: Path, data: bytes, visible: tuple[float, float] = (0.0, 1.0), *, stacklevel: int
) -> tuple[Quantized, str, bytes]:
    """The first layer in `data`, or the only one; its name; and the bytes after it."""
    header = _read_header(path, data)
    try:
        quantized, note, size = _decode(path, header, data, visible)
        name = header.get("layer", "")
        _check(isinstance(name, str), "layer", short_repr(name))
    except HEADER_ERRORS as error:
        if isinstance(error, ModelFileError):
            raise
        raise _unreadable(
            path, f"one that does not fit together ({type(error).__name__}: {one_line(error)})"
        ) from error
    if note:
        warnings.warn(note, stacklevel=stacklevel)
    return quantized, name, data[size:]


def compact_metadata(path: Path) -> dict:
    """The `metadata` that `save_compact` stored. Raises as `load_compact`."""
    return _read_header(path, path.read_bytes())["metadata"]


def has_layers(path: PathLike) -> bool:
    """Whether a compact file holds a video of layers."""
    return "layer" in _read_header(Path(path), Path(path).read_bytes())


def measure_chunks(path: Path) -> tuple[list[int], int]:
    """Sizes of the chunks and of the file in bytes, as the header states them. The file itself may be cut off."""
    header = _read_header(path, path.read_bytes())
    sizes = [sum(own["streams"]) for own in header["chunks"]]
    return sizes, _FIXED + header["header_bytes"] + sum(header["motion"]["streams"]) + sum(sizes)


def _read_header(path: Path, data: bytes) -> dict:
    """The header of a file with this `data`, once its checksum is verified."""
    other = "one that a transfer as text has changed" if data.startswith(MAGIC[:4]) else "a file of another kind"
    _check_file(data.startswith(MAGIC), path, other)
    _check_file(len(data) >= _FIXED, path, f"one cut off after {len(data)} bytes")
    version, length, checksum = (int.from_bytes(data[k : k + 4], "little") for k in range(len(MAGIC), _FIXED, 4))
    require(
        version == VERSION,
        "path",
        expected=f"a compact model of version {VERSION}, which this program reads",
        got=f"version {version} in {str(path)!r}",
        cure="Compress the model again." if version < VERSION else "Update foldgauss.",
        kind=ModelFileError,
    )
    text = data[_FIXED : _FIXED + length]
    is_whole = length == len(text) and zlib.crc32(text) == checksum
    _check_file(is_whole, path, "one that is cut off or damaged (the checksum of its header is another)")
    try:
        header = json.loads(text, parse_constant=_reject_constant)
        if not isinstance(header, dict) or not isinstance(header["metadata"], dict):
            raise ValueError("it is not an object")
    except (ValueError, KeyError, RecursionError) as error:
        raise _unreadable(path, "one whose header is not JSON of a model") from error
    return header | {"header_bytes": length}


def _reject_constant(name: str) -> None:
    raise ValueError(f"{name} is not valid JSON")


def _decode(path: Path, header: dict, data: bytes, visible: tuple[float, float]) -> tuple[Quantized, str, int]:
    """The model without the chunks that are not visible or cannot be read; a warning of the latter, or ""; its size."""
    info, num_frames = _parse_info(header), header["num_frames"]
    _check(is_integer(num_frames, 1), "num_frames", num_frames)
    _check_blocks(header, info)
    start = _FIXED + header["header_bytes"]
    motion = _read_streams(data, header["motion"], start)
    _check_file(motion is not None, path, "one whose frame times are cut off or damaged")
    intervals = range_coder.decode(motion[0], range_coder.Column.without_contexts(num_frames - 1))
    paths = {} if info.paths is None else _decode_paths(info.paths, *motion[1:])
    rules = _parse_rules(header["rules"], info)
    chunks, missing, after = [], [], header["motion"]
    for own in header["chunks"]:
        start, after = start + sum(after["streams"]), own
        if chunks or missing:  # the first one is always read
            first, last = own["visible"]
            if first > visible[1] or last < visible[0]:
                continue
        streams = _read_streams(data, own, start)
        if streams is None:
            missing.append(own)
        else:
            chunks.append(_decode_chunk(streams, rules, info, own))
    lost = _describe_missing(header["chunks"], missing)
    _check_file(chunks, path, f"one without a chunk that can be read ({lost})")
    note = f"{str(path)!r}: {lost}. Copy it again." if missing else ""
    return Quantized(info, rules, tuple(chunks), intervals, **paths), note, start + sum(after["streams"])


def _describe_missing(chunks: list[dict], missing: list[dict]) -> str:
    """`missing`: the chunks that cannot be read."""
    num, total = (sum(own["num_gaussians"] for own in some) for some in (missing, chunks))
    how = f"{len(missing)} of its {len(chunks)} chunks {'is' if len(missing) == 1 else 'are'} cut off or damaged"
    first = ", among them the largest" if missing and missing[0] is chunks[0] else ""
    return f"{how}; {num:,} of {total:,} Gaussians are missing{first}"


def _check_blocks(header: dict, info: CompactInfo) -> None:
    """Raise ValueError unless the header describes blocks that can be, before any memory is claimed for them."""
    chunks, num_frames = header["chunks"], header["num_frames"]
    _check(isinstance(chunks, list) and 1 <= len(chunks) <= MAX_CHUNKS, "chunks", short_repr(chunks))
    count = num_frames + _count_path_numbers(info)
    room = header["header_bytes"] - _check_streams(header["motion"], 1 if info.paths is None else 3, count)
    _check(room >= 0, "num_frames", num_frames)
    num_columns = len(info.column_names)
    for own in chunks:
        num, visible = own["num_gaussians"], own["visible"]
        _check(is_integer(num, 1), "num_gaussians", short_repr(num))
        room -= _check_streams(own, num_columns, num * num_columns)
        _check(room >= 0, "num_gaussians", num)
        right = isinstance(visible, list) and len(visible) == 2 and all(is_within(t, "[0, 1]") for t in visible)
        _check(right and visible[0] <= visible[1], "visible", short_repr(visible))
        _parse_cells(own["cells"], num)


def _check_streams(own: dict, num: int, num_values: int) -> int:
    """Check the numbers of bytes of a block's streams; returns how many bytes the header has to have instead."""
    lengths = own["streams"]
    right = isinstance(lengths, list) and len(lengths) == num and all(is_integer(one, 0) for one in lengths)
    _check(right, "streams", short_repr(lengths))
    return _count_lacking(num_values, sum(lengths))


def _read_streams(data: bytes, own: dict, start: int) -> list[bytes] | None:
    """The streams of the block that begins at the byte `start`; None where they are cut off or damaged."""
    size = sum(own["streams"])
    block = data[start : start + size]
    if len(block) < size or zlib.crc32(block) != own["crc"]:
        return None
    streams = io.BytesIO(block)
    return [streams.read(length) for length in own["streams"]]


def _decode_chunk(streams: list[bytes], rules: dict[str, Rule], info: CompactInfo, own: dict) -> Chunk:
    cells = _parse_cells(own["cells"], own["num_gaussians"])
    contexts = ColumnContexts(rules, info, cells, own["num_gaussians"])
    most = {"degree": info.degree, "path": info.paths.num_paths if info.paths else 0}  # used as indices
    for name, stream in zip(info.column_names, streams, strict=True):
        numbers = range_coder.decode(stream, contexts.describe_next(name))
        if name == "cell":
            numbers = (np.cumsum(numbers, dtype=np.int64) & last_cell(cells)).astype(np.int32)
        if name in most:
            _check(numbers.min() >= 0 and numbers.max() <= most[name], name, "numbers out of range")
        contexts.add(name, numbers)
    return Chunk(cells, contexts.columns)


def _decode_paths(about: PathsInfo, knots: bytes, maps: bytes) -> dict[str, np.ndarray]:
    shape = about.num_paths, about.num_knots
    coded = range_coder.decode(maps, describe_maps(about)).reshape(*shape, 2, 3)
    made = {"maps": np.cumsum(coded, axis=1, dtype=np.int64) + path_identities(about)}
    if about.at_frames:
        _check(not knots, "knots", "some")
    else:
        coded = range_coder.decode(knots, range_coder.Column.without_contexts(shape[0] * shape[1])).reshape(shape)
        _check((coded[:, 1:] >= 0).all(), "knots", "times that decrease")
        made["knots"] = np.cumsum(coded, axis=1, dtype=np.int64)
    for name, numbers in made.items():
        _check(np.abs(numbers).max() <= LARGEST, name, "numbers out of range")
    return {name: numbers.astype(np.int32) for name, numbers in made.items()}


def _parse_info(header: dict) -> CompactInfo:
    size, degree = header["size"], header["degree"]
    right = isinstance(size, list) and len(size) == 2 and all(is_integer(side, 1) and side <= _SIDE for side in size)
    _check(right, "size", size)
    _check(is_integer(degree, 0) and degree <= MAX_DEGREE, "degree", degree)
    bounds = {"power": "[0, 1e30]", "floor": "[0, 1)", "reach": "(0, 100]", "fps": "(0, 1e9]", "scale_cutoff": "[0, 1]"}
    for name, interval in bounds.items():
        _check(is_within(header[name], interval), name, header[name])
    check_one_of("compositing", header["compositing"], COMPOSITINGS)
    time_bits = header["time_bits"]
    _check(is_integer(time_bits, 0) and time_bits <= MAX_TIME_BITS, "time_bits", time_bits)
    known = {field.name: header[field.name] for field in dataclasses.fields(CompactInfo) if field.name != "paths"}
    made = {"size": tuple(size), "options": RenderOptions(**header["options"])}
    made["paths"] = _parse_paths(header["paths"], header["num_frames"]) if "paths" in header else None
    return CompactInfo(**known | made)


def _parse_cells(cells: list, num: int) -> tuple[int, int, int]:
    _check(isinstance(cells, list) and len(cells) == 3 and all(is_integer(n, 0) for n in cells), "cells", cells)
    _check(sum(cells) <= MAX_CELL_BITS and 1 << max(sum(cells), 2 * max(cells[:2])) <= num, "cells", cells)
    return tuple(cells)


def _parse_paths(own: dict, num_frames: int) -> PathsInfo:
    num_paths, num_knots, at_frames, bits = (own[name] for name in ("num_paths", "num_knots", "at_frames", "bits"))
    _check(is_integer(num_paths, 1) and num_paths <= MAX_PATHS, "num_paths", num_paths)
    _check(is_integer(num_knots, 1), "num_knots", num_knots)
    _check(at_frames is False or (at_frames is True and num_knots == num_frames), "at_frames", at_frames)
    _check(is_integer(bits, 0) and bits <= MAX_PATH_BITS, "bits", bits)
    for name, interval in (("middle", "[-1e9, 1e9]"), ("sides", "[1e-6, 1e9]")):
        right = isinstance(own[name], list) and len(own[name]) == 2 and all(is_within(x, interval) for x in own[name])
        _check(right, name, own[name])
    return PathsInfo(num_paths, num_knots, at_frames, bits, tuple(own["middle"]), tuple(own["sides"]))


def _parse_rules(described: list, info: CompactInfo) -> dict[str, Rule]:
    names = info.column_names
    _check(isinstance(described, list) and len(described) == len(names), "rules", short_repr(described))
    described = dict(zip(names, described, strict=True))
    _check(not any(described[name] for name in names if is_integral(name)), "rules", "some of columns of integers")
    rules = {}
    for name in (name for name in names if not is_integral(name)):
        numbers, known = described[name], FEATURES.index(name) if name in FEATURES else len(FEATURES)
        _check(2 <= len(numbers) <= 2 + known and all(is_within(x, "[-1e9, 1e9]") for x in numbers), "rule", name)
        rules[name] = Rule(numbers[0], numbers[1], tuple(numbers[2:]))
    return rules


def _check(right: bool, name: str, got: Any) -> None:
    require(right, name, expected="what a compact model can have", got=got)


def _check_file(right: object, path: Path, got: str) -> None:
    """Raise `ModelFileError` unless the file is `right`; `got` describes it."""
    if not right:
        raise _unreadable(path, got)


def _unreadable(path: Path, got: str) -> ModelFileError:
    return model_file_error(
        "path", expected="a compact model", got=f"{got}: {str(path)!r}", cure="Copy it again, or compress again."
    )
