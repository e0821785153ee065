"""PLY files as tables of numbers: the container format, independent of the meaning of its columns.

Files are not trusted: every count is checked against the size of the file before anything is allocated, and invalid
content raises only `FormatError`.

Source of the layout: G. Turk, "The PLY Polygon File Format" (1994).
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import invalid
from foldgauss.io._atomic import PathLike, atomic_path, check_input

_SIZES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
#: Bytes; a header names each frame of a VeGaS video in about 30, so this allows some 100,000 frames.
MAX_HEADER = 4 << 20
_END_OF_HEADER = re.compile(rb"^[ \t]*end_header[ \t\r]*\n", re.MULTILINE)
#: Prefix of our metadata in a comment of the header, which other programs skip.
NOTE = "foldgauss "
#: Characters of the longest accepted number.
LONGEST_WORD = 64


class FormatError(ValueError):
    """A file of another program's format cannot be read or written; the message is one line."""


def format_error(path: object, *, expected: str, got: str, cure: str = "") -> FormatError:
    """The error for a file; `path` is its name, optionally with the position in it."""
    return FormatError(str(invalid(str(path), expected=expected, got=got, cure=cure)))


def facts_error(path: object, error: Exception) -> FormatError:
    """The error for invalid metadata, with the text of `error` where it is one of our messages."""
    text = " ".join(str(error).split())[:300]
    if ": expected " in text:
        return FormatError(f"{path}: {text}")
    got = f"others ({type(error).__name__}: {text})"
    return format_error(path, expected="metadata as foldgauss writes them", got=got, cure="Remove them.")


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]  # (name, type code); of a list "count type, item type"


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

    def error(self, expected: str, got: str, cure: str = "") -> FormatError:
        """The error for what it holds."""
        return format_error(self.path, expected=expected, got=got, cure=cure)

    def to_float32(self, name: str, leaf: np.ndarray) -> np.ndarray:
        """The leaf in float32, contiguous. Raises `FormatError` where a change of units overflows it."""
        with np.errstate(over="ignore"):
            leaf = np.ascontiguousarray(leaf, np.float32)
        if not np.isfinite(leaf).all():
            raise self.error(f"a {name} that float32 can represent in model space", "a larger one")
        return leaf

    def describe_vertices(self) -> str:
        """The properties of the element `vertex`, for an error message."""
        return "properties " + ", ".join(self.names("vertex")[:20]) if self.names("vertex") else "no element 'vertex'"

    def columns(self, element: str, names: Sequence[str]) -> Float[np.ndarray, "rows names"]:
        """The named properties side by side, float64. Raises `FormatError` for one that is missing or not finite."""
        found = self.names(element)
        missing = [name for name in names if name not in found]
        if missing:
            raise self.error(
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
            raise self.error(
                expected="numbers that float32 can represent",
                got=f"{columns[row, place]} in {names[place]} of {element} {row}",
                cure="Drop that row.",
            )
        return columns


# ---------------------------------------------------------------------------------------------- reading


def read_ply(path: PathLike, wanted: Iterable[str]) -> Ply:
    """Read the `wanted` elements of a PLY file, those of them that it has: text or binary, of either byte order.

    Other elements, lists among them, are skipped. Raises `FileNotFoundError` for a missing path and `FormatError` for
    a file that is not PLY, breaks off, declares more rows than it holds, or has lists in a wanted element.
    """
    path = Path(path)
    data = read_bytes(path)
    header, start = _split_header(path, data)
    order, elements, comments = _parse_header(path, header)
    wanted = set(wanted)
    body = _Body(path, memoryview(data)[start:], order)
    found = {}
    for element in elements:
        if wanted <= found.keys():
            break
        if element.name not in wanted:
            body.skip(element)
            continue
        lists = [name for name, code in element.properties if "," in code]
        if lists:
            raise format_error(
                path,
                expected=f"plain numbers only in element {element.name!r}",
                got=f"the list {lists[0]!r}",
                cure="It is a mesh, or made by another program.",
            )
        found[element.name] = body.read(element)
    return Ply(path, found, comments)


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
    if data[:4] not in (b"ply\n", b"ply\r"):
        raise format_error(
            path,
            expected="a PLY file, which starts with 'ply'",
            got="an empty file" if not data else f"one that starts with {data[:8]!r}",
            cure="Check the path.",
        )
    found = _END_OF_HEADER.search(data[:MAX_HEADER])
    if found is None:
        raise format_error(
            path,
            expected="a line 'end_header'",
            got=f"none in {min(len(data), MAX_HEADER)} bytes",
            cure="Copy the file again.",
        )
    return data[: found.start()].decode("ascii", errors="replace").split("\n")[1:-1], found.end()


def _parse_header(path: Path, lines: list[str]) -> tuple[str, list[_Element], tuple[str, ...]]:
    """(byte order, elements, comments); see `_ORDERS`."""
    order, comments = None, []
    elements: list[_Element] = []
    for number, line in enumerate(lines, start=2):
        word, *rest = line.split() or [""]
        where = f"{path}, line {number}"
        if word == "comment":
            comments.append(line.strip()[len("comment ") :])
        elif word in ("obj_info", ""):
            continue
        elif word == "format" and order is None and len(rest) == 2 and rest[0] in _ORDERS and rest[1] == "1.0":
            order = _ORDERS[rest[0]]
        elif word == "element" and len(rest) == 2 and _is_count(rest[1]):
            if any(rest[0] == known.name for known in elements):
                raise format_error(where, expected="elements of different names", got=f"{rest[0]!r} twice")
            elements.append(_Element(rest[0], int(rest[1]), []))
        elif word == "property" and elements:
            elements[-1].properties.append(_parse_property(where, rest))
        else:
            expected = "format ascii|binary_little_endian|binary_big_endian 1.0, element NAME COUNT, property TYPE NAME"
            raise format_error(where, expected=expected, got=repr(line.rstrip()[:80]), cure="The header is damaged.")
    if order is None:
        raise format_error(path, expected="a line 'format ...' in the header", got="none", cure="Copy it again.")
    for element in elements:
        names = [name for name, _ in element.properties]
        if len(set(names)) < len(names) or not names:
            raise format_error(
                path,
                expected=f"different properties of element {element.name!r}",
                got="none" if not names else f"{max(names, key=names.count)!r} twice",
            )
    return order, elements, tuple(comments)


def _parse_property(where: str, words: list[str]) -> tuple[str, str]:
    """(name, type code) of what follows "property"."""
    if len(words) == 2 and words[0] in _SIZES:
        return words[1], _SIZES[words[0]]
    if len(words) == 4 and words[0] == "list" and words[2] in _SIZES and _SIZES.get(words[1], "f")[0] in "iu":
        return words[3], f"{_SIZES[words[1]]},{_SIZES[words[2]]}"
    raise format_error(
        where,
        expected="property TYPE NAME or property list COUNT_TYPE TYPE NAME, of known types",
        got=repr(" ".join(["property", *words])[:80]),
    )


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 15


class _Body:
    """Rows element after element: of bytes in an `order`, or of a text's words where it is empty."""

    def __init__(self, path: Path, data: memoryview, order: str):
        self.path, self.order, self.at = path, order, 0
        self.values = data if order else bytes(data).split()

    def read(self, element: _Element) -> np.ndarray:
        values = self._take(element, element.count * sum(self._sizes(element)))
        if not self.order:
            return self._parse(element, values)
        return np.frombuffer(values, [(name, self.order + code) for name, code in element.properties])

    def skip(self, element: _Element) -> None:
        sizes = self._sizes(element)
        items = [np.dtype(code.split(",")[1]).itemsize if "," in code else 0 for _, code in element.properties]
        if not any(items):
            self._take(element, element.count * sum(sizes))
            return
        self._need(element, element.count * sum(sizes))
        for _ in range(element.count):
            for (_, code), size, item in zip(element.properties, sizes, items, strict=True):
                first = self._take(element, size)
                if item:
                    self._take(element, self._length(element, first, code) * (item if self.order else 1))

    def _sizes(self, element: _Element) -> list[int]:
        """Bytes or words of each property; of a list those of its length."""
        return [np.dtype(code.split(",")[0]).itemsize if self.order else 1 for _, code in element.properties]

    def _length(self, element: _Element, first: memoryview | list[bytes], code: str) -> int:
        """The number of items of a list."""
        if self.order:
            number = str(np.frombuffer(first, self.order + code.split(",")[0])[0])
        else:
            number = first[0].decode("ascii", errors="replace")
        if not _is_count(number):
            raise format_error(self.path, expected=f"lengths of lists in {element.name!r}", got=repr(number[:40]))
        return int(number)

    def _parse(self, element: _Element, words: list[bytes]) -> np.ndarray:
        width = len(element.properties)
        long = next((word for word in words if len(word) > LONGEST_WORD), None)
        if long is not None:  # an array of words gives each the room of the longest
            raise format_error(self.path, expected="numbers", got=f"a word of {len(long)} characters")
        try:
            values = np.array(words, dtype=np.bytes_).astype(np.float64).reshape(element.count, width)
        except ValueError:
            place = next(place for place, word in enumerate(words) if not _is_number(word))
            name, where = element.properties[place % width][0], f"{element.name} {place // width}"
            raise format_error(
                self.path,
                expected="numbers",
                got=f"{words[place][:40]!r} in {name} of {where}",
                cure="The file is damaged.",
            ) from None
        return values.view([(name, "f8") for name, _ in element.properties])[:, 0]

    def _take(self, element: _Element, num: int) -> memoryview | list[bytes]:
        self._need(element, num)
        self.at += num
        return self.values[self.at - num : self.at]

    def _need(self, element: _Element, num: int) -> None:
        left, unit = len(self.values) - self.at, "bytes" if self.order else "numbers"
        if num > left:
            raise format_error(
                self.path,
                expected=f"{element.count} rows of element {element.name!r}, {num} {unit} or more",
                got=f"{left} {unit}",
                cure="The file is truncated.",
            )


def _is_number(word: bytes) -> bool:
    try:
        np.array([word]).astype(np.float64)
    except ValueError:
        return False
    return True


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
