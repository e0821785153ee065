"""Targets: files of other programs, PLY."""

import functools
import struct
from pathlib import Path
from random import Random

import numpy as np

from foldgauss.io import (
    FormatError,
    read_3dgs_ply,
    read_vegas_ply,
    write_3dgs_ply,
    write_vegas_ply,
)

from .models import tiny_model, written
from .mutate import by_chance, json_text_changed
from .target import Target, chance


def _text_of(data: bytes, order: str = "ascii") -> bytes:
    """A binary PLY of single precision, as text or in the other byte order."""
    head, body = data.split(b"end_header\n", 1)
    numbers = np.frombuffer(body, "<f4")
    head = head.replace(b"binary_little_endian", order.encode())
    if order != "ascii":
        return head + b"end_header\n" + numbers.astype(">f4").tobytes()
    return head + b"end_header\n" + b" ".join(f"{x:.9g}".encode() for x in numbers) + b"\n"


def _with_lists(data: bytes, order: str = "<") -> bytes:
    """With an element that is skipped before the others, and one of lists after."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.split(b"\n", 2)
    lines[2] = b"element extra 1\nproperty double a\nproperty short flag\n" + lines[2]
    lines[2] += b"element face 1\nproperty list uchar int vertex\n"
    rows = b"1.5 -3\n" if order == "" else struct.pack("<dh", 1.5, -3)
    return b"\n".join(lines) + b"end_header\n" + rows + body + b"\0"


def _ply_body(data: bytes) -> int:
    at = data.find(b"end_header\n")
    return at + 11 if at >= 0 else 0


def note_changed(data: bytes, random: Random) -> bytes:
    """One of our own facts, in a comment of the header."""
    before, note = data.split(b"comment foldgauss ", 1)
    note, rest = note.split(b"\n", 1)
    note = json_text_changed(note, random).replace(b"\n", b" ")
    return before + b"comment foldgauss " + note + b"\n" + rest


@functools.cache
def _vegas() -> bytes:
    return written(lambda path: write_vegas_ply(path, tiny_model()), ".ply")


@functools.cache
def _scene() -> bytes:
    return written(lambda path: write_3dgs_ply(path, tiny_model(), 0.5, sh_degree=0), ".ply")


def _read_vegas(path: Path) -> None:
    given = {} if chance(path) % 3 else {"size": (4, 6), "fps": 12}
    model = read_vegas_ply(path, **given)
    assert model.num_frames >= 2


_PLY_MUTATIONS = (by_chance, note_changed)

VEGAS = Target(
    "ply-vegas",
    ".ply",
    lambda: [
        _vegas(), _text_of(_vegas()), _text_of(_vegas(), "binary_big_endian"), _with_lists(_vegas()),
        _with_lists(_text_of(_vegas()), ""),
    ],
    _read_vegas,
    (FormatError,),
    _PLY_MUTATIONS,
    _ply_body,
)  # fmt: skip

SCENE = Target(
    "ply-3dgs",
    ".ply",
    lambda: [
        _scene(), _text_of(_scene()), _text_of(_scene(), "binary_big_endian"), _with_lists(_scene()),
        written(lambda path: write_3dgs_ply(path, tiny_model(), 0.5, axes="y-up", sh_degree=1), ".ply"),
    ],
    lambda path: read_3dgs_ply(path, axes="y-up" if chance(path) % 2 else "y-down"),
    (FormatError,),
    _PLY_MUTATIONS,
    _ply_body,
)  # fmt: skip


TARGETS = (VEGAS, SCENE)
