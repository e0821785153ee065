"""PLY files as tables of numbers: the container format, independent of the meaning of its columns.

Files are not trusted: every count is checked against the size of the file before anything is allocated, and invalid
content raises only `FormatError`.

Source of the layout: G. Turk, "The PLY Polygon File Format" (1994).
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import ParameterError, invalid, require
from foldgauss.io._atomic import PathLike, atomic_path, check_input

_SIZES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_LIST = "list"
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
#: Bytes; a header names each frame of a VeGaS video in about 30, so this allows some 100,000 frames.
MAX_HEADER = 4 << 20
_END_OF_HEADER = re.compile(rb"^[ \t]*end_header[ \t\r]*\n", re.MULTILINE)
#: Prefix of our metadata in a comment of the header, which other programs skip.
NOTE = "foldgauss "


class FormatError(ParameterError):
    """A file of another program's format cannot be read or written; the message is one line."""


def format_error(path: object, *, expected: str, got: str, cure: str = "") -> FormatError:
    """The error for a file; `path` is its name, optionally with the position in it."""
    return invalid(str(path), expected=expected, got=got, cure=cure, kind=FormatError)


def parse_notes(path: object, text: str) -> dict:
    """Metadata that foldgauss wrote as JSON. Raises `FormatError` for another text."""
    try:
        notes = json.loads(text)
    except (ValueError, RecursionError):
        notes = None
    require(
        isinstance(notes, dict),
        str(path),
        expected="metadata as foldgauss writes them",
        got=repr(text[:60]),
        cure="Remove them, and give the size.",
        kind=FormatError,
    )
    return notes


def facts_error(path: object, error: Exception) -> FormatError:
    """The error for invalid metadata, with the text of `error` where it is one of our messages."""
    text = " ".join(str(error).split())[:300]
    if isinstance(error, ParameterError):
        return FormatError(str(path), text)
    got = f"others ({type(error).__name__}: {text})"
    return format_error(path, expected="metadata as foldgauss writes them", got=got, cure="Remove them.")


@dataclass(frozen=True)
class Ply:
    """What a PLY file holds: structured arrays by element, the comments of its header, and where it came from."""

    path: Path
    elements: Mapping[str, np.ndarray]
    comments: tuple[str, ...]

    def names(self, element: str) -> tuple[str, ...]:
        """The properties of an element in their order; none where it is missing."""
        return self.elements[element].dtype.names if element in self.elements else ()

    def is_vegas(self) -> bool:
        """Whether it is a published VeGaS video, by the columns that only those have."""
        return {"m_0", "sigma_0", "rot_0"} <= set(self.names("vertex"))

    def is_3dgs(self) -> bool:
        """Whether it is a 3DGS scene, by the columns that distinguish it from meshes and from VeGaS."""
        return {"f_dc_0", "opacity", "scale_2", "rot_3"} <= set(self.names("vertex"))

    def require(self, condition: object, expected: str, got: str, cure: str = "") -> None:
        """Raise `FormatError`, for what it holds, unless `condition` is true."""
        require(condition, str(self.path), expected=expected, got=got, cure=cure, kind=FormatError)

    def to_float32(self, name: str, leaf: np.ndarray) -> np.ndarray:
        """The leaf in float32, contiguous. Raises `FormatError` where a change of units overflows it."""
        with np.errstate(over="ignore"):
            leaf = np.ascontiguousarray(leaf, np.float32)
        self.require(
            np.isfinite(leaf).all(),
            f"a {name} that float32 can represent in model space",
            "a larger one",
        )
        return leaf

    def describe_vertices(self) -> str:
        """The properties of the element `vertex`, for an error message."""
        return "properties " + ", ".join(self.names("vertex")[:20]) if self.names("vertex") else "no element 'vertex'"

    def columns(self, element: str, names: Sequence[str]) -> Float[np.ndarray, "rows names"]:
        """The named properties side by side, float64. Raises `FormatError` for one that is missing or not finite."""
        found = self.names(element)
        missing = [name for name in names if name not in found]
        self.require(
            not missing,
            expected=f"properties {', '.join(missing)} of element {element!r}",
            got="the properties " + ", ".join(found[:40]) if found else "no such element",
            cure="It holds another kind of data.",
        )
        rows = self.elements[element]
        columns = np.empty((len(rows), len(names)), np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            for place, name in enumerate(names):
                columns[:, place] = rows[name]
            wrong = np.argwhere(~np.isfinite(columns.astype(np.float32)))
        if len(wrong):
            row, place = wrong[0]
            raise format_error(
                self.path,
                expected="numbers that float32 can represent",
                got=f"{columns[row, place]} in {names[place]} of {element} {row}",
                cure="Drop that row.",
            )
        return columns


# ---------------------------------------------------------------------------------------------- reading


def read_ply(path: PathLike, wanted: Iterable[str]) -> Ply:
    """Read the `wanted` elements of a PLY file, those of them that it has: text or binary, of either byte order.

    Others are skipped. Raises `FileNotFoundError` for a missing path and `FormatError` for a file that is not PLY,
    breaks off, declares more rows than it holds, or has lists in a wanted element or before one.
    """
    path, wanted = Path(path), set(wanted)
    data = read_bytes(path)
    header, at = _split_header(path, data)
    order, elements, comments = _parse_header(path, header)
    values = data if order else data[at:].split()
    at = at if order else 0
    found = {}
    for name, (count, columns) in elements.items():
        if wanted <= found.keys():
            break
        lists = [column for column, code in columns.items() if code == _LIST]
        require(
            not lists,
            str(path),
            expected=f"plain numbers only in element {name!r}",
            got=f"the list {', '.join(map(repr, lists))}",
            cure="It is a mesh, or made by another program.",
            kind=FormatError,
        )
        row = np.dtype([(column, order + code if order else "f8") for column, code in columns.items()])
        first, at = at, at + count * (row.itemsize if order else len(columns))
        require(
            at <= len(values),
            str(path),
            expected=f"{count} rows of element {name!r}, {at - first} {'bytes' if order else 'numbers'} or more",
            got=str(len(values) - first),
            cure="The file is truncated.",
            kind=FormatError,
        )
        if name in wanted:
            rows = values[first:at] if order else _parse_numbers(path, values[first:at])
            found[name] = np.frombuffer(rows, row)
    return Ply(path, found, comments)


def _parse_numbers(path: Path, words: list[bytes]) -> np.ndarray:
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise format_error(path, expected="numbers", got=str(error)[:80], cure="The file is damaged.") from None


def read_bytes(path: Path) -> bytes:
    """The content of a file. Raises as `check_input`, and `FormatError` where it cannot be read."""
    check_input(path, "a file")
    try:
        return path.read_bytes()
    except OSError as error:
        raise format_error(
            path, expected="a file that can be read", got=error.strerror or str(error), cure="Give the path of a file."
        ) from error


def _split_header(path: Path, data: bytes) -> tuple[list[str], int]:
    """The lines between "ply" and "end_header", and where the rows start."""
    require(
        data[:4] in (b"ply\n", b"ply\r"),
        str(path),
        expected="a PLY file, which starts with 'ply'",
        got="an empty file" if not data else f"one that starts with {data[:8]!r}",
        cure="Check the path.",
        kind=FormatError,
    )
    found = _END_OF_HEADER.search(data[:MAX_HEADER])
    require(
        found,
        str(path),
        expected="a line 'end_header'",
        got=f"none in {min(len(data), MAX_HEADER)} bytes",
        cure="Copy the file again.",
        kind=FormatError,
    )
    return data[: found.start()].decode("ascii", errors="replace").split("\n")[1:-1], found.end()


def _parse_header(path: Path, lines: list[str]) -> tuple[str, dict[str, tuple[int, dict[str, str]]], tuple[str, ...]]:
    """(byte order, elements, comments): see `_ORDERS`; of each element the number of rows, and type codes by column."""
    order, comments, elements = None, [], {}
    for number, line in enumerate(lines, start=2):
        word, *rest = line.split() or [""]
        if word == "comment":
            comments.append(line.strip()[len("comment ") :])
        elif word in ("obj_info", ""):
            continue
        elif word == "format" and order is None and len(rest) == 2 and rest[0] in _ORDERS and rest[1] == "1.0":
            order = _ORDERS[rest[0]]
        elif word == "element" and len(rest) == 2 and rest[0] not in elements and re.fullmatch("[0-9]{1,15}", rest[1]):
            columns = {}
            elements[rest[0]] = int(rest[1]), columns
        elif word == "property" and elements and rest and rest[-1] not in columns and rest[0] in (*_SIZES, _LIST):
            columns[rest[-1]] = _SIZES.get(rest[0], _LIST)
        else:
            raise format_error(
                f"{path}, line {number}",
                expected="format ascii|binary_little_endian|binary_big_endian 1.0, element NAME COUNT, "
                "property TYPE NAME, with names that differ",
                got=repr(line.rstrip()[:80]),
                cure="The header is damaged.",
            )
    require(
        order is not None,
        str(path),
        expected="a line 'format ...' in the header",
        got="none",
        cure="Copy it again.",
        kind=FormatError,
    )
    empty = ", ".join(name for name, (_, columns) in elements.items() if not columns)
    require(
        not empty,
        str(path),
        expected=f"properties of element {empty!r}",
        got="none",
        cure="Copy it again.",
        kind=FormatError,
    )
    return order, elements, tuple(comments)


# ---------------------------------------------------------------------------------------------- writing


def write_ply(
    path: PathLike, elements: Mapping[str, Mapping[str, np.ndarray]], *, comments: Sequence[str] = ()
) -> Path:
    """Write columns of numbers, float32, binary and little-endian as viewers expect; whole or not at all.

    `elements` by name, each with its columns by name, in the order given. Raises `OutputError` where the path cannot
    be written.
    """
    path = Path(path)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines(_encode(elements, comments))
    return path


def _encode(elements: Mapping[str, Mapping[str, np.ndarray]], comments: Sequence[str]) -> Iterator[bytes]:
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, columns in elements.items():
        lines.append(f"element {name} {len(next(iter(columns.values())))}")
        lines.extend(f"property float {column}" for column in columns)
    # Comments are last: some viewers expect the vertices in the third line.
    lines.extend(f"comment {comment}" for comment in comments)
    yield ("\n".join(lines) + "\nend_header\n").encode("ascii")
    for columns in elements.values():
        yield np.stack([np.asarray(column, "<f4") for column in columns.values()], axis=1).tobytes()
