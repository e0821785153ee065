"""How files go bad: by chance, and as somebody would make them who knows the format."""

import json
import math
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

_NUMBERS = (0, 1, -1, 2, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**53 + 1, 2**63 - 1, 2**64)
_TEXTS = (
    b"0", b"-1", b"1e999", b"-1e39", b"nan", b"inf", b"1e-320", b"99999999999999999999", b"0x10", b"1_0", b"\xff\xfe",
    b"\x00", b"\n", b"\r", b" ", b"\\", b'"', b"'", b"[", b"]", b"{", b"}", b"#", b"/", b",", b".", b"=", b":",
    b"1" * 70,     b"\xe2\x80\xa8", b"\xed\xa0\x80", b"true", b"null",
)  # fmt: skip
_FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-45, 1e-39, 3.4e38, -3.4e38, 1e30, -1e30, 88.8, -104.0, 1.0)


def by_chance(data: bytes, random: Random, start: int = 0) -> bytes:
    """One to a few plain changes from `start` on."""
    head, body = data[:start], bytearray(data[start:])
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        body = random.choice(_PLAIN)(body, random)
    return head + bytes(body)


def _place(body: bytearray, random: Random) -> int:
    return random.randrange(len(body)) if body else 0


def _flip(body: bytearray, random: Random) -> bytearray:
    if body:
        body[_place(body, random)] ^= 1 << random.randrange(8)
    return body


def _byte(body: bytearray, random: Random) -> bytearray:
    if body:
        body[_place(body, random)] = random.choice((0, 1, 0x7F, 0x80, 0xFF, random.randrange(256)))
    return body


def _cut(body: bytearray, random: Random) -> bytearray:
    return body[: _place(body, random)]


def _drop(body: bytearray, random: Random) -> bytearray:
    at = _place(body, random)
    del body[at : at + random.randrange(1, 9)]
    return body


def _twice(body: bytearray, random: Random) -> bytearray:
    at = _place(body, random)
    part = body[at : at + random.randrange(1, 65)]
    body[at:at] = part * random.choice((1, 1, 2, 16))
    return body


def _moved(body: bytearray, random: Random) -> bytearray:
    at, to = _place(body, random), _place(body, random)
    part = body[at : at + random.randrange(1, 33)]
    body[to : to + len(part)] = part
    return body


def _text(body: bytearray, random: Random) -> bytearray:
    at = _place(body, random)
    body[at : at + random.randrange(3)] = random.choice(_TEXTS)
    return body


def _integer(body: bytearray, random: Random) -> bytearray:
    width, at = random.choice((1, 2, 4, 8)), _place(body, random)
    number = random.choice(_NUMBERS) + random.choice((0, 0, -1, 1))
    body[at : at + width] = (number % 2 ** (8 * width)).to_bytes(width, random.choice(("little", "big")))
    return body


def _float(body: bytearray, random: Random) -> bytearray:
    kind = random.choice(("<f", "<f", ">f", "<d", ">d"))
    width = struct.calcsize(kind)
    at = random.randrange(max(1, len(body) // width)) * width
    body[at : at + width] = struct.pack(kind, random.choice(_FLOATS))
    return body


def _line(body: bytearray, random: Random) -> bytearray:
    """A line goes, comes twice, or two change places."""
    lines = bytes(body).split(b"\n")
    at, to = random.randrange(len(lines)), random.randrange(len(lines))
    how = random.randrange(4)
    if how == 0:
        del lines[at]
    elif how == 1:
        lines.insert(to, lines[at])
    elif how == 2:
        lines[at], lines[to] = lines[to], lines[at]
    else:
        lines[at] = lines[at] + lines[to]
    return bytearray(b"\n".join(lines))


def _word(body: bytearray, random: Random) -> bytearray:
    """A word of a line goes, comes twice, or becomes another."""
    lines = bytes(body).split(b"\n")
    at = random.randrange(len(lines))
    words = lines[at].split(b" ")
    place = random.randrange(len(words))
    how = random.randrange(3)
    if how == 0:
        del words[place]
    elif how == 1:
        words.insert(place, words[place])
    else:
        words[place] = random.choice((*_TEXTS, str(random.choice(_NUMBERS)).encode()))
    lines[at] = b" ".join(words)
    return bytearray(b"\n".join(lines))


_PLAIN: tuple[Callable[[bytearray, Random], bytearray], ...] = (
    _flip, _byte, _cut, _drop, _twice, _moved, _text, _integer, _float, _line, _word,
)  # fmt: skip


_MAGICS = (
    b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"ply\n", b"PK\x03\x04", b"{", b"\x8bFGZ", b"\x8bFGZ\n", b"GIF89a",
    b"%!PS",     b"\x89HDF\r\n\x1a\n", b"\xff" * 8 + b"{", b"<html>", b"\x00" * 9, b"\xef\xbb\xbf", b"\xfe\xff",
)  # fmt: skip


def foreign(data: bytes, random: Random) -> bytes:
    """A file that starts as another kind does, or is cut off within its first bytes."""
    how = random.randrange(3)
    if how == 0:
        return data[: random.randrange(24)]
    start = random.choice(_MAGICS)
    return start + data[len(start) if how == 1 else len(data) :]


def spliced(one: bytes, other: bytes, random: Random, start: int = 0) -> bytes:
    """The beginning of one file and the end of another."""
    return one[: max(start, random.randrange(len(one) + 1))] + other[random.randrange(len(other) + 1) :]


# ---------------------------------------------------------------------------------------------- JSON

_VALUES = (
    None, True, False, 0, -1, 1, 2**31, 2**40, 2**63, 10**30, 0.5, -0.5, 1e308, 1e-320, math.nan, math.inf, -math.inf,
    "", "x", "over", "sum", "\ud800", "\x00", [], [1], [[]], [0] * 40, {}, {"": 0},
)  # fmt: skip


def json_changed(value: Any, random: Random) -> Any:
    """The value with one thing in it changed; what was given stays as it is."""
    value = json.loads(json.dumps(value))
    places = list(_places(value))
    if not places:
        return random.choice(_VALUES)
    holder, key = random.choice(places)
    how = random.randrange(8)
    if how <= 3:
        holder[key] = random.choice(_VALUES)
    elif how == 4:
        del holder[key]
    elif how == 5 and isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
        holder[key] = random.choice(
            (holder[key] + 1, holder[key] - 1, -holder[key], float(holder[key]), holder[key] / 3)
        )
    elif how == 6:
        other, name = random.choice(places)
        holder[key] = json.loads(
            json.dumps(other.get(name) if isinstance(other, dict) else other[0] if other else None)
        )
    elif isinstance(holder, dict):
        holder[key + random.choice(("x", "_", " "))] = holder.pop(key)
    else:
        holder.append(holder[key])
    return value


def _places(value: Any):
    """Every (holder, key) in a value."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in list(pairs):
        yield value, key
        yield from _places(part)


def json_text_changed(data: bytes, random: Random) -> bytes:
    """A file that is one JSON value, with one thing in it changed; or nested without an end."""
    if random.randrange(50) == 0:
        return random.choice((b"[", b'{"a":')) * 100_000
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return by_chance(data, random)
    return json.dumps(json_changed(value, random)).encode("utf-8", "surrogatepass")


# ---------------------------------------------------------------------------------------------- checksums


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """(kind, content) of the chunks of a PNG, as far as they go."""
    found, at = [], 8
    while at + 8 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        found.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def png_of(chunks: list[tuple[bytes, bytes]]) -> bytes:
    """A PNG of chunks, with right checksums."""
    parts = [
        len(own).to_bytes(4, "big") + kind + own + zlib.crc32(kind + own).to_bytes(4, "big") for kind, own in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def png_resealed(data: bytes, random: Random) -> bytes:
    """A PNG with one of its chunks changed, its pixels inside of their compression, and right checksums."""
    chunks = png_chunks(data)
    if not data.startswith(b"\x89PNG") or len(chunks) < 2:
        return by_chance(data, random, 8)
    at = random.randrange(1, len(chunks))
    kind, own = chunks[at]
    if kind == b"IDAT" and random.randrange(4):
        try:
            own = zlib.compress(by_chance(zlib.decompress(own), random))
        except zlib.error:
            own = by_chance(own, random)
    else:
        own = by_chance(own, random)
    how = random.randrange(8)
    chunks[at] = kind, own
    if how == 0:
        chunks.insert(random.randrange(1, len(chunks)), chunks[at])
    elif how == 1:
        del chunks[at]
    return png_of(chunks)


def png_sized(data: bytes, random: Random) -> bytes:
    """A PNG whose header tells another size or kind, with a right checksum."""
    chunks = png_chunks(data)
    if not data.startswith(b"\x89PNG") or not chunks or len(chunks[0][1]) != 13:
        return by_chance(data, random)
    width, height, *rest = struct.unpack(">IIBBBBB", chunks[0][1])
    sizes = (0, 1, 2, 7, 4096, 20_000, 2**16, 2**20, 2**31 - 1, 2**32 - 1)
    how = random.randrange(4)
    if how == 0:
        width = random.choice(sizes)
    elif how == 1:
        height = random.choice(sizes)
    elif how == 2:
        width, height = random.choice(sizes), random.choice(sizes)
    else:
        rest[random.randrange(5)] = random.randrange(18)
    chunks[0] = b"IHDR", struct.pack(">IIBBBBB", width, height, *rest)
    return png_of(chunks)


#: What `zipfile` raises of damaged archives; a RuntimeError, too, of encryption and of packing that it does not know.
_BAD_ZIP = (zipfile.BadZipFile, ValueError, OSError, EOFError, RuntimeError, zlib.error)


def npy_changed(data: bytes, random: Random) -> bytes:
    """An array of NumPy's own format whose header tells another type or shape."""
    length = int.from_bytes(data[8:10], "little")
    header, rest = data[10 : 10 + length].decode("latin1"), data[10 + length :]
    shapes = ("()", "(0,)", "(1,)", "(3, 0)", f"({2**40},)", f"({2**33}, {2**33})", "(-1,)", "(2, 2, 2)", "'x'")
    types = (
        "'<f8'",
        "'|O'",
        "'<i8'",
        "'|S1099511627776'",
        "'<c16'",
        "'|b1'",
        "'<U3'",
        "[('a', '<f8')]",
        "'<M8[s]'",
        "None",
    )
    if random.randrange(2):
        at = header.find("'shape': ") + 9
        header = header[:at] + random.choice(shapes) + "}"
    else:
        at, end = header.find("'descr': ") + 9, header.find(", 'fortran")
        header = header[:at] + random.choice(types) + header[end:]
    header = header.rstrip() + "\n"
    return data[:8] + len(header).to_bytes(2, "little") + header.encode("latin1", "replace") + rest
