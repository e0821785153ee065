"""Compact model files, .fgz: quantized, entropy-coded, checked, and decoded to the same bits everywhere.

The layout is in docs/format.md. Files are not trusted: a checksum detects damage, counts are checked
against the size of the file, and invalid content raises only `ModelFileError`.
"""

import dataclasses
import io
import json
import os
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from foldgauss._runtime.checks import check_one_of, invalid, is_integer, is_within
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
from foldgauss.video.compression.column_contexts import ColumnContexts
from foldgauss.video.compression.quantize import (
    FEATURES,
    LARGEST,
    MAX_CELL_BITS,
    CompactInfo,
    Quantized,
    Rule,
    dequantize,
    is_integral,
)
from foldgauss.video.compression.quantized_paths import MAX_PATH_BITS, PathsInfo
from foldgauss.video.compression.quantized_times import MAX_TIME_BITS
from foldgauss.video.compression.streams import PATH_STREAMS, describe_maps, encode_streams, last_cell, path_identities
from foldgauss.video.models.row_layout import MAX_DEGREE
from foldgauss.video.models.shared_paths import MAX_PATHS
from foldgauss.video.models.video_model import VideoModel

COMPACT_SUFFIX = ".fgz"
#: As in PNG: a byte that is not ASCII, line ends of both kinds, which a transfer as text would change, an end of file.
MAGIC = b"\x8bFGZ\r\n\x1a\n"
VERSION = 5
#: Magic, version, length of the header, checksum of all that follows.
_FIXED = len(MAGIC) + 12
#: Limit of numbers per byte, so that a small file cannot claim much memory; files are padded with spaces. Clips need 1.
_MOST_PER_BYTE = 32
#: Bytes of metadata that sizes of files are planned for, see `video.fitting.rate.HEADER_BYTES`.
_METADATA_BYTES = 1000
_SIDE = 1 << 20  # largest side of an image: a decoder holds it in memory


def save_compact(path: PathLike, quantized: Quantized, *, metadata: dict | None = None) -> Path:
    """Write a quantized model whole or not at all; equal ones give equal bytes. See `foldgauss.video.compress`.

    Raises ValueError for a name that does not end in .fgz, `OutputError` where it cannot be written.
    """
    path = check_path(path, "path, quantized")
    check_compact_name(path)
    data = pack_compact(quantized, metadata)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return path


def leave_room(size_mb: float | None, metadata: dict) -> float | None:
    """The size of a file, in 10^6 bytes, without its metadata where these are longer than usual."""
    excess = len(to_json("metadata", to_json_types(metadata))) - _METADATA_BYTES
    return size_mb if size_mb is None or excess <= 0 else max(size_mb - 1e-6 * excess, 1e-6)


def check_compact_name(path: Path, parameter: str = "path") -> None:
    """Raise ValueError for a name that is not a compact file's."""
    if path.suffix.lower() != COMPACT_SUFFIX:
        raise invalid(parameter, expected=f"a name ending in {COMPACT_SUFFIX}", got=repr(str(path)))


def pack_compact(quantized: Quantized, metadata: dict | None = None) -> bytes:
    """The bytes of the file."""
    info, streams, descriptions = quantized.info, encode_streams(quantized), []
    for name in info.column_names:
        rule = quantized.rules.get(name)
        own = [] if is_integral(name) else [rule.origin, rule.exponent, *rule.slopes]
        descriptions.append([len(streams[name]), *own])
    header = dataclasses.asdict(info) | {
        "num_frames": len(quantized.intervals) + 1,
        "columns": descriptions,
        "intervals": len(streams["intervals"]),
        "metadata": to_json_types(metadata or {}),
    }
    num_values = info.num_gaussians * len(descriptions) + header["num_frames"] + _count_path_numbers(info)
    if info.paths is None:
        del header["paths"]
    else:
        header["paths"] |= {name: len(streams[name]) for name in PATH_STREAMS}
    text = to_json("header", header).encode()
    data = b"".join(streams.values())
    text += b" " * (-(-num_values // _MOST_PER_BYTE) - len(text) - len(data))
    body = text + data
    numbers = (VERSION, len(text), zlib.crc32(body))
    return MAGIC + b"".join(number.to_bytes(4, "little") for number in numbers) + body


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


def load_compact(path: PathLike) -> Quantized:
    """The quantized model in a compact file, for `foldgauss.video.compression.quantize.dequantize`.

    Raises `ModelFileError` for a file that is damaged, cut off, of a later version or of another kind.
    """
    path = check_path(path)
    data = path.read_bytes()
    header, body = _read_header(path, data)
    try:
        return _decode(header, body, len(data))
    except HEADER_ERRORS as error:
        got = f"one that does not fit together ({type(error).__name__}: {one_line(error)})"
        raise _unreadable(path, got) from error


def load_compact_model(path: Path) -> VideoModel:
    """The model in a compact file. Raises as `load_compact`, also for values beyond float32."""
    with np.errstate(over="ignore", invalid="ignore"):
        model = dequantize(load_compact(path))
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model)):
        raise _unreadable(path, "one with values beyond float32")
    return model


def compact_metadata(path: Path) -> dict:
    """The `metadata` that `save_compact` stored. Raises as `load_compact`."""
    return _read_header(path, path.read_bytes())[0]["metadata"]


def _read_header(path: Path, data: bytes) -> tuple[dict, bytes]:
    """The header and the bytes after it, once the checksum is verified."""
    if not data.startswith(MAGIC):
        got = "one that a transfer as text has changed" if data.startswith(MAGIC[:4]) else "a file of another kind"
        raise _unreadable(path, got)
    if len(data) < _FIXED:
        raise _unreadable(path, f"one cut off after {len(data)} bytes")
    version, length, checksum = (int.from_bytes(data[k : k + 4], "little") for k in range(len(MAGIC), _FIXED, 4))
    if version != VERSION:
        expected = f"a compact model of version {VERSION}, which this program reads"
        cure = "Compress the model again." if version < VERSION else "Update foldgauss."
        raise model_file_error("path", expected=expected, got=f"version {version} in {str(path)!r}", cure=cure)
    body = data[_FIXED:]
    if length > len(body) or zlib.crc32(body) != checksum:
        raise _unreadable(path, "one that is cut off or damaged (its checksum is another)")
    try:
        header = json.loads(body[:length], parse_constant=_reject_constant)
        if not isinstance(header, dict) or not isinstance(header["metadata"], dict):
            raise ValueError("it is not an object")
    except (ValueError, KeyError, RecursionError) as error:
        raise _unreadable(path, "one whose header is not JSON of a model") from error
    return header, body[length:]


def _reject_constant(name: str) -> None:
    raise ValueError(f"{name} is not valid JSON")


def _decode(header: dict, body: bytes, whole_length: int) -> Quantized:
    info = _parse_info(header)
    num, num_frames = info.num_gaussians, header["num_frames"]
    _check(is_integer(num_frames, 1), "num_frames", num_frames)
    names = info.column_names
    num_values = num * len(names) + num_frames + _count_path_numbers(info)
    _check(num_values <= _MOST_PER_BYTE * whole_length, "num_gaussians", num)
    descriptions = header["columns"]
    _check(isinstance(descriptions, list) and len(descriptions) == len(names), "columns", "others")
    of_paths = [header["paths"][name] for name in ("knots", "maps")] if info.paths else [0, 0]
    lengths = [own[0] for own in descriptions] + [header["intervals"]]
    right = all(is_integer(own, 1) for own in lengths) and all(is_integer(own, 0) for own in of_paths)
    _check(right and sum(lengths + of_paths) == len(body), "bytes", "others")
    described = dict(zip(names, (own[1:] for own in descriptions), strict=True))
    rules = {name: _parse_rule(name, numbers) for name, numbers in described.items() if not is_integral(name)}
    _check(not any(described[name] for name in names if is_integral(name)), "rule", "none")
    contexts, streams = ColumnContexts(rules, info), io.BytesIO(body)
    most = {"degree": info.degree, "path": info.paths.num_paths if info.paths else 0}  # used as indices
    for name, length in zip(names, lengths[:-1], strict=True):
        numbers = range_coder.decode(streams.read(length), contexts.describe_next(name))
        if name == "cell":
            numbers = (np.cumsum(numbers, dtype=np.int64) & last_cell(info)).astype(np.int32)
        if name in most:
            _check(numbers.min() >= 0 and numbers.max() <= most[name], name, "numbers out of range")
        contexts.add(name, numbers)
    intervals = range_coder.decode(streams.read(lengths[-1]), range_coder.Column.without_contexts(num_frames - 1))
    paths = _decode_paths(info.paths, *map(streams.read, of_paths)) if info.paths else {}
    return Quantized(info, rules, contexts.columns, intervals, **paths)


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
    size, degree, cells, num = (header[key] for key in ("size", "degree", "cells", "num_gaussians"))
    _check(isinstance(size, list) and len(size) == 2, "size", size)
    _check(all(is_integer(side, 1) and side <= _SIDE for side in size), "size", size)
    _check(is_integer(num, 1), "num_gaussians", num)
    _check(is_integer(degree, 0) and degree <= MAX_DEGREE, "degree", degree)
    _check(isinstance(cells, list) and len(cells) == 3 and all(is_integer(n, 0) for n in cells), "cells", cells)
    _check(sum(cells) <= MAX_CELL_BITS and 1 << max(sum(cells), 2 * max(cells[:2])) <= num, "cells", cells)
    bounds = {"power": "[0, 1e30]", "floor": "[0, 1)", "reach": "(0, 100]", "fps": "(0, 1e9]", "scale_cutoff": "[0, 1]"}
    for name, interval in bounds.items():
        _check(is_within(header[name], interval), name, header[name])
    check_one_of("compositing", header["compositing"], COMPOSITINGS)
    time_bits = header["time_bits"]
    _check(is_integer(time_bits, 0) and time_bits <= MAX_TIME_BITS, "time_bits", time_bits)
    known = {field.name: header[field.name] for field in dataclasses.fields(CompactInfo) if field.name != "paths"}
    made = {"size": tuple(size), "cells": tuple(cells), "options": RenderOptions(**header["options"])}
    made["paths"] = _parse_paths(header["paths"], header["num_frames"]) if "paths" in header else None
    return CompactInfo(**known | made)


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


def _parse_rule(name: str, numbers: list) -> Rule:
    known = FEATURES.index(name) if name in FEATURES else len(FEATURES)
    _check(2 <= len(numbers) <= 2 + known and all(is_within(x, "[-1e9, 1e9]") for x in numbers), "rule", name)
    return Rule(numbers[0], numbers[1], tuple(numbers[2:]))


def _check(right: bool, name: str, got: Any) -> None:
    if not right:
        raise invalid(name, expected="what a compact model can have", got=got)


def _unreadable(path: Path, got: str) -> ModelFileError:
    cure = "Copy it again, or compress again."
    return model_file_error("path", expected="a compact model", got=f"{got}: {str(path)!r}", cure=cure)
