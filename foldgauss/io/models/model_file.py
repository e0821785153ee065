"""One model, one file: safetensors with a versioned header, every array leaf, exact to the bit."""

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from safetensors import SafetensorError, safe_open

from foldgauss._runtime.checks import ParameterError, invalid, require
from foldgauss.io._atomic import PathLike, atomic_path, missing_error

FORMAT = "foldgauss-model"
VERSION = "1"  # increased when older programs cannot read the file

# NumPy's names for the element types of safetensors that a model may hold.
_DTYPES = {
    "float64": "F64", "float32": "F32", "float16": "F16", "bfloat16": "BF16", "bool": "BOOL",
    "int64": "I64", "int32": "I32", "int16": "I16", "int8": "I8",
    "uint64": "U64", "uint32": "U32", "uint16": "U16", "uint8": "U8",
}  # fmt: skip
#: Bytes of an element of each.
_ITEM_BYTES = {code: jax.numpy.dtype(name).itemsize for name, code in _DTYPES.items()}
_LONGEST_HEADER = 100_000_000  # bytes; the limit of the safetensors library
_PREFIX = 8  # bytes: the length of the JSON header, little-endian, opens a safetensors file
_RESERVED = "__metadata__"  # reserved by safetensors
#: What functions raise that are given a header with other types or values.
HEADER_ERRORS = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)
_MAGIC = {
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"ply": "a PLY file",
    b"PK": "a zip archive",
}


class ModelFileError(ParameterError):
    """A model cannot be saved to or loaded from this file; the message is one line."""


@dataclass(frozen=True)
class Kind:
    """A type of models that files can hold, under the name `name`.

    `to_header(model)` returns the static fields as a JSON-compatible dict. `from_header(dict)` returns the skeleton:
    the same pytree with a `jax.ShapeDtypeStruct` for every array leaf. The dict is not trusted, so `from_header` must
    not allocate memory in proportion to its values.

    `check` raises ValueError for a model whose leaves have inconsistent values.
    """

    name: str
    model_type: type
    to_header: Callable[[Any], dict]
    from_header: Callable[[dict], Any]
    check: Callable[[Any], None] = lambda model: None


_KINDS: dict[str, Kind] = {}


def register_model(kind: Kind) -> None:
    """Register a kind for saving and loading. Raises `ValueError` if its name is already that of another type."""
    known = _KINDS.setdefault(kind.name, kind)
    require(
        known.model_type is kind.model_type,
        "kind",
        expected="a free name",
        got=f"{kind.name!r}, taken by {known.model_type.__name__}",
    )
    _KINDS[kind.name] = kind


# ----------------------------------------------------------------------------------------------- saving


def save_model(path: PathLike, model: Any, *, metadata: dict | None = None) -> Path:
    """Write `model` whole or not at all; returns the path. Equal models and metadata give equal bytes.

    Every array leaf of the pytree, JAX or NumPy, is stored under its path in the tree ("splats.loc"). `metadata` is
    any provenance for `read_header` (clip, configuration, metrics); NaN and infinities become null. The header is
    checked to describe the model before anything is written.

    Raises `ModelFileError` for an unregistered type, a leaf that would be lost (a plain number, a PRNG key)
    or a header that does not describe the model; `OutputError` where the path cannot be written.
    """
    kind = next((kind for kind in _KINDS.values() if type(model) is kind.model_type), None)
    require(
        kind is not None,
        "model",
        expected="one of the registered types " + ", ".join(sorted(_KINDS)),
        got=type(model).__name__,
        cure="Register it with register_model.",
        kind=ModelFileError,
    )
    arrays = {key: _to_numpy(key, leaf) for key, leaf in _array_leaves(model).items()}
    header = kind.to_header(model)
    _check_described(kind, model, to_json("header", header))
    about = {"kind": kind.name, "header": header, "metadata": metadata or {}}
    return write_tensors(Path(path), _get_specs(arrays), lambda keys: (arrays[key] for key in keys), about)


def write_tensors(
    path: Path, specs: Mapping[str, dict], tensors: Callable[[list[str]], Iterable[np.ndarray]], about: dict
) -> Path:
    """Write a model file, whole or not at all: tensors with `specs` as in `read_header`; returns the path.

    `tensors(keys)` yields them in that order, little-endian. `about` has `kind`, `header` and `metadata`, likewise.
    Raises as `save_model`.
    """
    strings = {
        "format": FORMAT,
        "version": VERSION,
        "kind": about["kind"],
        "header": to_json("header", about["header"]),
        "metadata": to_json("metadata", to_json_types(about["metadata"])),
    }
    # Not written by the library, whose header has a random order: equal models must give equal bytes.
    order = sorted(specs, key=lambda key: (-_ITEM_BYTES[specs[key]["dtype"]], key))  # so every tensor is aligned
    entries: dict[str, Any] = {_RESERVED: strings}
    end = 0
    for key in order:
        start, end = end, end + math.prod(specs[key]["shape"]) * _ITEM_BYTES[specs[key]["dtype"]]
        entries[key] = specs[key] | {"data_offsets": [start, end]}
    text = json.dumps(entries, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    require(
        len(text) <= _LONGEST_HEADER,
        "path",
        expected=f"a header of at most {_LONGEST_HEADER:,} bytes",
        got=f"one of {len(text):,} bytes for {len(specs):,} tensors",
        cure="Write the clip as several files.",
        kind=ModelFileError,
    )
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(len(text).to_bytes(_PREFIX, "little") + text)
        for array in tensors(order):
            file.write(array.tobytes())
    return path


def _array_leaves(tree: Any) -> dict[str, Any]:
    """Array leaves, or their `ShapeDtypeStruct`s, by path. A leaf that would be lost in silence raises."""
    found: dict[str, Any] = {}
    for keys, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        key = jax.tree_util.keystr(keys, simple=True, separator=".")
        require(
            not isinstance(leaf, bool | int | float | complex) or isinstance(leaf, np.generic),
            key,
            expected="an array or a static field",
            got=f"the plain number {leaf!r}",
            cure="Make it an array, or a static field that the header holds.",
            kind=ModelFileError,
        )
        if not isinstance(leaf, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct):
            continue  # a function or a name, which the skeleton contains
        require(
            key not in found and key != _RESERVED,
            key,
            expected="one leaf per path",
            got="a clash",
            cure="Rename the field or dictionary key.",
            kind=ModelFileError,
        )
        found[key] = leaf
    return found


def _to_numpy(key: str, leaf: Any) -> np.ndarray:
    """Little-endian, of a type that the format holds; nothing is converted but the byte order."""
    require(
        leaf.dtype.name in _DTYPES,
        key,
        expected="a real, integer or boolean array",
        got=f"dtype {leaf.dtype}",
        cure="Store complex numbers as two arrays and PRNG keys by jax.random.key_data.",
        kind=ModelFileError,
    )
    # In any strides: tobytes gives C order.
    return np.asarray(leaf).astype(leaf.dtype.newbyteorder("<"), copy=False)


def _check_described(kind: Kind, model: Any, header: str) -> None:
    """Raise unless the header alone gives back the model's tree, static fields, shapes and types."""
    skeleton = kind.from_header(json.loads(header))
    _check_tensors(_get_specs(_array_leaves(model)), _get_specs(_array_leaves(skeleton)), "model")
    have, want = jax.tree_util.tree_structure(skeleton), jax.tree_util.tree_structure(model)
    require(
        have == want,
        "header",
        expected=f"every static field of the model of kind {kind.name!r}",
        got="a skeleton of another structure",
        cure="Let to_header and from_header carry each static field.",
        kind=ModelFileError,
    )


def to_json(parameter: str, value: Any) -> str:
    """JSON, the same for the same value. Raises `ModelFileError` for what it cannot hold."""
    try:
        return json.dumps(value, allow_nan=False, sort_keys=True, default=_encode_scalar)
    except (TypeError, ValueError, RecursionError) as error:
        raise model_file_error(
            parameter, expected="a dict that JSON can hold", got=str(error), cure="Use plain types."
        ) from error


def _encode_scalar(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"a {type(value).__name__}")


def to_json_types(value: Any) -> Any:
    """Metadata as JSON types: NaN and infinities, such as the PSNR of a perfect frame, become null."""
    if isinstance(value, dict):
        return {str(key): to_json_types(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_types(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


# ---------------------------------------------------------------------------------------------- loading


def load_model(path: PathLike) -> Any:
    """Read the model that `save_model` wrote, equal to the bit. Nothing in the file is executed.

    Leaves are JAX arrays, except 64-bit ones without JAX's x64 mode, which stay NumPy arrays. Memory: at most twice the
    file's size, plus the skeleton.

    Raises `FileNotFoundError` for a missing file, `ModelFileError` for one of another kind or version, a
    damaged one, or one whose tensors differ from what its header describes.
    """
    return load_part(Path(path), read_header(path))


def load_part(path: Path, about: dict, prefix: str = "") -> Any:
    """The model that `about`, with the keys of `read_header`, describes: its tensors have `prefix` before their keys.

    Raises `ModelFileError` as `load_model`.
    """
    kind, skeleton = match_kind(path, about)
    filled = _read_leaves(skeleton, path, prefix)
    try:
        kind.check(filled)
    except ValueError as error:
        raise model_file_error(
            "path", expected="tensors that fit each other", got=f"others in {str(path)!r} ({one_line(error)})"
        ) from error
    return filled


def match_kind(path: Path, about: dict) -> tuple[Kind, Any]:
    """The kind of model, and the skeleton made from the header, checked against the tensors, of which none is read."""
    kind = _KINDS.get(about["kind"])
    require(
        kind is not None,
        "path",
        expected="a model of kind " + " or ".join(map(repr, sorted(_KINDS))),
        got=f"kind {about['kind']!r} in {str(path)!r}",
        cure="Load it with the program that wrote it.",
        kind=ModelFileError,
    )
    with translate_header_errors(path, kind.name):
        skeleton = kind.from_header(about["header"])
    _check_tensors(about["tensors"], _get_specs(_array_leaves(skeleton)), str(path))
    return kind, skeleton


@contextmanager
def translate_header_errors(path: Path, kind: str) -> Iterator[None]:
    """Raise the errors of making a model of a header, which is not trusted, as `ModelFileError`."""
    try:
        yield
    except ModelFileError:
        raise
    except HEADER_ERRORS as error:
        raise model_file_error(
            "path",
            expected=f"the header of a model of kind {kind!r}",
            got=f"one that does not describe it in {str(path)!r} ({type(error).__name__}: {one_line(error)})",
        ) from error


def read_header(path: PathLike) -> dict:
    """The header of a file, without reading its tensors.

    Keys: `format`, `version`, `kind` (strings), `header` and `metadata` (dicts), and `tensors`, which maps
    each key to `{"dtype": "F32", "shape": [..]}`.

    Raises as `load_model` does, but takes a kind that is not registered.
    """
    path = Path(path)
    _check_container(path)
    with open_tensors(path) as file:
        strings = file.metadata() or {}
        parts = {key: file.get_slice(key) for key in file.keys()}  # noqa: SIM118 - it is not a dict
        tensors = {key: {"dtype": part.get_dtype(), "shape": list(part.get_shape())} for key, part in parts.items()}
    _check_version(path, strings)
    about = {name: strings[name] for name in ("format", "version", "kind")}
    about |= {name: _parse_json(path, name, strings[name]) for name in ("header", "metadata")}
    return about | {"tensors": tensors}


def _check_container(path: Path) -> None:
    """Check the first bytes against the file's size, before the library allocates memory."""
    if not os.path.exists(path):
        raise missing_error(path, "a model file")
    if not path.is_file():
        raise _unreadable_error(path, "a folder" if path.is_dir() else "a device or a pipe")
    size = path.stat().st_size
    with open(path, "rb") as file:
        first = file.read(_PREFIX + 1)
    length = int.from_bytes(first[:_PREFIX], "little")
    if size < _PREFIX + 2 or not first[_PREFIX:].startswith(b"{"):
        names = (name for magic, name in _MAGIC.items() if first.startswith(magic))
        unknown = "a file of another kind, or one cut off within its first bytes" if first else "an empty file"
        raise _unreadable_error(path, next(names, unknown))
    if length > size - _PREFIX:
        raise _unreadable_error(path, f"a file of {size} bytes whose header claims {length}: it is cut off or damaged")


def _check_version(path: Path, strings: dict[str, str]) -> None:
    if strings.get("format") != FORMAT:
        raise _unreadable_error(path, f"a safetensors file of format {strings.get('format', 'unknown')!r}")
    require(
        strings.get("version") == VERSION,
        "path",
        expected=f"a model file of version {VERSION}, which this program reads",
        got=f"version {strings.get('version')} in {str(path)!r}",
        cure="Update foldgauss, or load it with the one that wrote it.",
        kind=ModelFileError,
    )
    for name in ("kind", "header", "metadata"):
        if name not in strings:
            raise _unreadable_error(path, f"one without the field {name!r}")


def _parse_json(path: Path, name: str, text: str) -> dict:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _unreadable_error(path, f"one whose field {name!r} is not JSON ({one_line(error)})") from error
    if not isinstance(value, dict):
        raise _unreadable_error(path, f"one whose field {name!r} is not a JSON object")
    return value


def _get_specs(leaves: dict[str, Any]) -> dict[str, dict]:
    return {
        key: {"dtype": _DTYPES.get(leaf.dtype.name, leaf.dtype.name), "shape": list(leaf.shape)}
        for key, leaf in leaves.items()
    }


def _check_tensors(kept: dict[str, dict], described: dict[str, dict], where: str) -> None:
    """Raise unless the tensors have the keys, shapes and types that the header describes."""
    for key in sorted(kept.keys() | described.keys()):
        have, want = kept.get(key), described.get(key)
        require(
            have == want,
            f"tensor {key!r} of {where!r}",
            expected=_spec_text(want),
            got=_spec_text(have),
            kind=ModelFileError,
        )


def _read_leaves(skeleton: Any, path: Path, prefix: str) -> Any:
    """The skeleton with each `ShapeDtypeStruct` replaced by its tensor."""
    with open_tensors(path) as file:

        def fill(keys: tuple, leaf: Any) -> Any:
            if not isinstance(leaf, jax.ShapeDtypeStruct):
                return leaf
            key = jax.tree_util.keystr(keys, simple=True, separator=".")
            array = file.get_tensor(prefix + key)
            most = array.view(np.uint8).max(initial=0) if array.dtype == np.bool_ else 0
            require(most <= 1, key, expected="booleans 0 or 1", got=f"the byte {most}", kind=ModelFileError)
            if jax.dtypes.canonicalize_dtype(array.dtype) == array.dtype:
                return jax.device_put(array)  # jnp.asarray compiles, and keeps, a program for every shape
            return np.array(array)

        return jax.tree_util.tree_map_with_path(fill, skeleton)


@contextmanager
def open_tensors(path: Path) -> Iterator[Any]:
    """Open a safetensors file: `get_tensor(key)` reads one. Raises `ModelFileError` for a damaged file."""
    try:
        with safe_open(path, framework="numpy") as file:
            yield file
    except SafetensorError as error:
        raise _unreadable_error(path, f"a damaged or truncated file ({one_line(error)})") from error


def model_file_error(parameter: str, *, expected: str, got: object, cure: str = "") -> ModelFileError:
    """The error with the text of `invalid`."""
    return invalid(parameter, expected=expected, got=got, cure=cure, kind=ModelFileError)


def _unreadable_error(path: Path, got: str) -> ModelFileError:
    cure = "Give a file that `foldgauss fit` wrote."
    if got == _MAGIC[b"ply"]:
        cure = "Convert it to a model first: foldgauss import PLY. The commands and the player open that."
    return model_file_error("path", expected=f"a {FORMAT} file", got=f"{got}: {str(path)!r}", cure=cure)


def _spec_text(spec: dict | None) -> str:
    return "no such tensor" if spec is None else f"{spec['dtype']} of shape {spec['shape']}"


def one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]
