"""How files go bad: by chance, and as somebody would make them who knows the format."""

import json
import math
import struct
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


Mutation = Callable[[bytes, Random], bytes]


def by_chance(data: bytes, random: Random, start: int = 0) -> bytes:
    """One to a few plain changes from `start` on."""
    body = data[start:]
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        separator = random.choice((b"", b"", b"\n", b" "))
        body = _bytes_changed(body, random) if separator == b"" else _parts_changed(body, separator, random)
    return data[:start] + body


def _bytes_changed(body: bytes, random: Random) -> bytes:
    """Some bytes go, are inserted, or are overwritten by others; or the file ends there."""
    at, other, width = random.randrange(len(body) + 1), random.randrange(len(body) + 1), random.choice((1, 2, 4, 8))
    if random.randrange(10) == 0:
        return body[:at]
    number = (random.choice(_NUMBERS) + random.choice((0, 0, -1, 1))) % 2 ** (8 * width)
    piece = random.choice(
        (
            b"",
            random.randbytes(1),
            random.choice(_TEXTS),
            body[other : other + random.randrange(1, 65)] * random.choice((1, 1, 2, 16)),
            number.to_bytes(width, random.choice(("little", "big"))),
            struct.pack(random.choice(("<f", ">f", "<d")), random.choice(_FLOATS)),
        )
    )
    if random.randrange(2):
        at -= at % width
    return body[:at] + piece + body[at + random.choice((0, len(piece), len(piece), width)) :]


def _parts_changed(body: bytes, separator: bytes, random: Random) -> bytes:
    """A line or a word goes, is inserted, or becomes another."""
    parts = body.split(separator)
    at = random.randrange(len(parts))
    number = str(random.choice(_NUMBERS)).encode()
    parts[at : at + random.randrange(2)] = random.choice(
        ([], [random.choice(_TEXTS)], [number], [random.choice(parts)], [random.choice(parts)])
    )
    return separator.join(parts)


#: First bytes of files of other kinds.
MAGICS = (
    b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"ply\n", b"PK\x03\x04", b"{", b"\x8bFGZ", b"\x8bFGZ\n", b"GIF89a",
    b"%!PS",     b"\x89HDF\r\n\x1a\n", b"\xff" * 8 + b"{", b"<html>", b"\x00" * 9, b"\xef\xbb\xbf", b"\xfe\xff",
)  # fmt: skip


def one_of(lines: Callable[[bytes, Random], bytes]) -> Mutation:
    """A line goes, is inserted, or becomes another, by a function of the line as it was."""

    def changed(data: bytes, random: Random) -> bytes:
        parts = data.split(b"\n")
        at = random.randrange(len(parts))
        parts[at : at + random.randrange(2)] = [lines(parts[at], random)]
        return b"\n".join(parts)

    return changed


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
    (holder, key), (other, place) = random.choice(places), random.choice(places)
    new = random.choice((random.choice(_VALUES), random.choice(_VALUES), json.loads(json.dumps(other[place]))))
    old = holder.pop(key)
    near = (old + 1, -old, float(old), old / 3) if type(old) in (int, float) else (old,)
    for one in random.choice(((), (new,), (new,), (new,), (random.choice(near),), (old, new))):
        if isinstance(holder, list):
            holder.insert(key, one)
        else:
            holder[key if key not in holder else key + random.choice(("x", "_", " "))] = one
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
    return json.dumps(json_changed(json.loads(data), random)).encode("utf-8", "surrogatepass")


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
    """A PNG with one of its chunks changed, or twice, its pixels inside of their compression, and right checksums."""
    chunks = png_chunks(data)
    at = random.randrange(len(chunks))
    kind, own = chunks[at]
    if kind == b"IDAT" and random.randrange(4):
        own = zlib.compress(by_chance(zlib.decompress(own), random))
    else:
        own = by_chance(own, random)
    chunks[at : at + random.choice((0, 1, 1, 1, 1))] = [(kind, own)]
    return png_of(chunks)
