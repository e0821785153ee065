"""Targets: files of other programs, PLY and OBJ, and what lies beside them."""

import functools
import json
import struct
import tempfile
from pathlib import Path
from random import Random

import numpy as np

from foldgauss.io import (
    FormatError,
    read_3dgs_ply,
    read_pseudomesh,
    read_vegas_ply,
    write_3dgs_ply,
    write_pseudomesh,
    write_vegas_ply,
)
from foldgauss.io.exchange.pseudomesh import read_obj

from .models import tiny_model, written
from .mutate import by_chance, json_text_changed, one_of
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


# ---------------------------------------------------------------------------------------------- pseudomeshes


@functools.cache
def _mesh() -> dict[str, bytes]:
    """The files of a folder with one frame."""
    with tempfile.TemporaryDirectory() as folder:
        made = write_pseudomesh(Path(folder) / "mesh", tiny_model(), [0.5])
        return {path.name: path.read_bytes() for path in made.iterdir()}


def _beside(folder: Path, but: str) -> None:
    for name, data in _mesh().items():
        if name != but:
            (folder / name).write_bytes(data)


def _tool(data: bytes) -> bytes:
    """As a mesh tool writes it: groups, normals, comments, indices with slashes."""
    lines = [b"# a tool", b"mtllib a.mtl", b"o frame", b"vn 0 0 1", b"", b"s off"]
    for line in data.split(b"\n"):
        words = line.split()
        if line.startswith(b"v "):
            lines.append(b"v " + b" ".join(words[1:4]) + b" # a comment")
        elif line.startswith(b"f "):
            lines.append(b"f " + b" ".join(word + b"//1" for word in words[1:]))
    return b"\r\n".join(lines) + b"\r\n"


_LINES = (
    b"v 0 0 0", b"v nan 0 0", b"v 1e39 0 0", b"v 1e38 1e38 -1e38", b"v 1 2", b"v a b c", b"v", b"f 1 2 3", b"f 1 2 3 4",
    b"f 3 2 1", b"f 0 1 2", b"f -1 -2 -3", b"f 1/2/3 2 3", b"f 99999999999 1 2", b"f " + b"9" * 5000 + b" 1 2", b"f",
    b"vt 0 0", b"\\", b"v 1_0 0 0", b"v 0x1 0 0", b"f 1.0 2 3", "v １ 0 0".encode(), b"# " + b"a" * 100, b"v 1e-46 0 0",
    b"v -0 -0 -0",
)  # fmt: skip
_ENDS = (b"\\", b" \\", b"#", b" 1", b"\r\r", b"\x0b1", b"\x1c")


def _line(line: bytes, random: Random) -> bytes:
    """One of a kind that the format knows, or the same with another end."""
    return random.choice((random.choice(_LINES), random.choice(_LINES), line.rstrip(b"\r") + random.choice(_ENDS)))


def _read_mesh(path: Path) -> None:
    read_obj(path)
    assert read_pseudomesh(path.parent).num_frames == 1


OBJ = Target(
    "obj",
    ".obj",
    lambda: [_mesh()["frame_0000.obj"], _tool(_mesh()["frame_0000.obj"])],
    _read_mesh,
    (FormatError,),
    (one_of(_line),),
    prepare=lambda folder: _beside(folder, "frame_0000.obj"),
    file_name="frame_0000",
)


def _read_notes(path: Path) -> None:
    given = {} if chance(path) % 4 else {"size": (4, 6), "fps": 12}
    mesh = read_pseudomesh(path.parent, **given)
    assert mesh.fps > 0


NOTES = Target(
    "mesh-notes",
    ".json",
    lambda: [
        _mesh()["pseudomesh.json"],
        b'{"size": [4, 6]}',
        json.dumps({"size": [4, 6], "times": [0.5], "fps": 5, "extra": 1, "compositing": "sum"}).encode(),
    ],
    _read_notes,
    (FormatError,),
    (json_text_changed,),
    prepare=lambda folder: _beside(folder, "pseudomesh.json"),
    file_name="pseudomesh",
)

TARGETS = (VEGAS, SCENE, OBJ, NOTES)
