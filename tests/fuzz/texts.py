"""Targets: texts that people and programs write, TOML and JSON."""

import dataclasses
import io
import json
import warnings
from pathlib import Path
from random import Random

import numpy as np
from PIL import Image

from foldgauss._runtime.checks import ParameterError
from foldgauss.cli.measuring.tradeoff import check_settings
from foldgauss.io import HistoryFile, read_history, save_video_model
from foldgauss.io.edit_script import EditScriptError, read_edit_script
from foldgauss.io.history import info_line
from foldgauss.video import edit
from foldgauss.video.fitting.loop import FitInfo
from foldgauss.video.segmented.segmented_video import SegmentedVideo

from .models import tiny_model, written
from .mutate import by_chance, json_text_changed, one_of
from .target import Target, chance

_SCRIPT = b"""\
# an edit
[selections.one]
box = [0, 0, 3, 3]
frame = 1

[selections.lively]
times = [0.0, 1.0]
alive = true

[selections."two words"]
indices = "0,2"

[selections.both]
any = ["one", "two words"]
without = ["one"]

[[edits]]
do = "move"
select = "one"
offset = [0.1, -0.05]
frames = "1:"
ease = 0.2

[[edits]]
do = "recolor"
gain = [1.0, 0.9, 0.8]
matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
times = [0.0, 0.5]

[[edits]]
do = "place"
degrees = [0.0, 20.0, 0.0]
depth = 0.1

[[layers]]
model = "other.safetensors"
where = "front"
freeze = 0

[camera]
azimuth = 10.0
"""
_OTHER = b"""\
selections = { left = { polygon = [[0, 0], [3, 0], [0, 3]], tolerance = 1.5, times = [0.0, 1.0] } }
edits = [
  { do = "vanish", select = "left" },  # gone
  { do = 'scale', factor = 1.5, about = [0.0, 0.0] },
]
camera.elevation = 5
layers = [{ model = "other.safetensors", script = "again.toml" }]
"""
_THIRD = b'''\
[[edits]]
do = """multiply"""
offsets = [[0.1, 0.0], [0.2, 0.0]]
degrees = [10.0, 20.0]
"delays" = 0.1
originals = false
[[edits]]
do = "retime"
shift = 0.1
[[edits]]
do = "to_front"
[[edits]]
do = "rotate"
degrees = 30
curve = "linear"
frame = 1
[[edits]]
do = "freeze"
at = 0.5
'''
_FOURTH = b"""\
[selections.m]
mask = "mask.png"
label = 1
frame = 0
[selections.f]
indices = "0,2"
[selections.g]
box = [0, 0, 6, 4]
frames = [0, 2]
[selections.every]
all = ["m", "f"]
[selections.rest]
without = ["m"]
[[edits]]
do = "opacity"
factor = 0.5
[[layers]]
model = "other.safetensors"
script = "more.toml"
freeze = 0.5
[camera]
elevation = 5
"""
_FIFTH = b"""\
[selections.most]
mask = "masks"
[selections.some]
mask = "masks"
frames = [0, 2]
[selections.now]
mask = "masks"
frame = 1
[[edits]]
do = "vanish"
select = "most"
[[layers]]
model = "other.safetensors"
"""
_SIXTH = b"""\
[selections.brushed]
indices = "0-1"
num_gaussians = 3
[selections.painted]
indices = "1"
[[edits]]
do = "opacity"
select = "brushed"
factor = 0.5
[[edits]]
do = "vanish"
select = "brushed"
"""
_SEVENTH = b"""\
[selections.parted]
indices = "0-1"
num_gaussians = 3
segment = 1
[[edits]]
do = "opacity"
select = "parted"
factor = 0.5
"""
_EIGHTH = b"""\
# of a segment
[selections.left]
box = [0, 0, 6, 4]
[selections.parted]
indices = "0-1"
segment = 1
"""
_KEYS = (
    b"indices",
    b"segment",
    b"num_gaussians",
    b"do",
    b"select",
    b"offset",
    b"frames",
    b"mask",
    b"file",
    b"label",
    b"any",
    b"model",
    b"script",
    b"degrees",
    b"x",
)
_LINES = (
    b'indices = "0,2"', b"segment = 7", b"num_gaussians = 7", b"box = [90, 90, 91, 91]", b"[selections]", b"[[edits]]",
    b"[layers]", b"[[layers]]", b"[camera]", b"[a.b.c]", b"[selections.one]", b"[x]", b"[[camera]]",
    b'where = "beside"',
    *(b".".join([b"a"] * num) + b" = 1" for num in (2, 3, 15, 17, 5000)),
)  # fmt: skip
_MADE = (
    b"[0, 1]", b'"10:"', b'"a"', b"true", b"-1", b"1e300", b"nan", b"inf", b"1979-05-27T07:32:00Z", b"[[1.0, 2.0]]",
    b"7", b"{}", b"{a.b = 1}", b"[" * 500, b"0x" + b"f" * 4000, b"1" * 4400, b'"""a\nb"""', b"'''", b'"\\u0000"',
    b'"a\\u0000b"', b"[]", b'"0,2"', b'"case.toml"', b'"again.toml"', b'"mask.png"', b'"none"',
    b'"rest"', b'"/"',
    b"1_000", b'["one"]', b'["none"]', b"{ do = 1 }",
)  # fmt: skip


def _line(line: bytes, random: Random) -> bytes:
    """The key with a value of another kind, the value of another key, another pair, a header or keys in a row."""
    key, _, value = line.partition(b" = ")
    other, made = random.choice(_KEYS), random.choice(_MADE)
    pairs = [(key, made), (key, made), (other, made), (other, value or made)]
    return random.choice((*(b" = ".join(pair) for pair in pairs), random.choice(_LINES)))


def _apply_script(path: Path) -> None:
    """What the script asks for, too: selections, masks, other models, a camera."""
    video = tiny_model()
    if b"segment" in path.read_bytes():
        video = SegmentedVideo.from_models([(0, video), (video.num_frames - 1, tiny_model(seed=1))])
    elif chance(path) % 8 == 0:
        video = edit(video).opacity(0.5, frames=(0, 1)).video()  # of layers, or overlays, which files do not fit to
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of units that look mistaken
        read_edit_script(path).apply(video)


def _beside_scripts(folder: Path) -> None:
    (folder / "other.safetensors").write_bytes(written(lambda path: save_video_model(path, tiny_model(seed=1))))
    more = b'[[edits]]\ndo = "vanish"\nframe = 1\n'
    (folder / "more.toml").write_bytes(more)
    (folder / "again.toml").write_bytes(more + b'[[layers]]\nmodel = "other.safetensors"\nscript = "case.toml"\n')
    mask = io.BytesIO()
    Image.fromarray(np.tile(np.uint8([0, 1, 1, 2, 1, 1]), (4, 1))).save(mask, "PNG")
    (folder / "mask.png").write_bytes(mask.getvalue())
    (folder / "masks").mkdir(exist_ok=True)
    for k in range(tiny_model().num_frames):
        (folder / "masks" / f"{k}.png").write_bytes(mask.getvalue())


SCRIPT = Target(
    "edit-script",
    ".toml",
    lambda: [
        _SCRIPT,
        _FOURTH,
        _THIRD,
        _SIXTH,
        _OTHER.replace(b', script = "again.toml"', b""),
        b"",
        b"\xef\xbb\xbf" + _THIRD,
    ],
    read_edit_script,
    (EditScriptError,),
    (one_of(_line), by_chance),
    prepare=_beside_scripts,
)

#: What is done by a script; the models are small and the same, and XLA's programs for them are the most of the memory.
APPLIED = dataclasses.replace(
    SCRIPT,
    name="edit-applied",
    seeds=lambda: [_SCRIPT, _FOURTH, _THIRD, _FIFTH, _SIXTH, _SEVENTH, _EIGHTH],
    parse=_apply_script,
    errors=(EditScriptError, FileNotFoundError),
    memory=lambda size: (256 << 20) + 400 * size,
)


# ---------------------------------------------------------------------------------------------- histories


def _infos() -> list[FitInfo]:
    first = FitInfo(1, 0.1, 0.5, float("nan"), 10, 9, 0.2, float("inf"), None)
    return [first, first._replace(step=2, psnr=20.5, loss=0.25), first._replace(step=5, psnr=21.5, stopped_by="steps")]


def _history() -> bytes:
    return b"".join(json.dumps(info_line(info)).encode() + b"\n" for info in _infos())


def _read_history(path: Path) -> None:
    for info in read_history(path):
        assert f"{info.step:d} {info.psnr:.2f}"
    if chance(path) % 2:
        HistoryFile(path, resumed_at=5, psnr=21.5)


HISTORY = Target(
    "history",
    ".jsonl",
    lambda: [_history(), b"", _history() + b'{"step": 9, "prog'],
    _read_history,
    (ValueError,),
    (one_of(json_text_changed),),
)


# ---------------------------------------------------------------------------------------------- trade-offs


def _record() -> bytes:
    texts = {"axis": "steps", "command": "a", "settings": {"steps": 100}}
    rows = [
        dict.fromkeys(("psnr", "ssim", "seconds", "bytes", "floats", "gaussians"), 1) | texts | {"value": value}
        for value in ("100", "200")
    ]
    kept = {
        "settings": {"a": 1, "b": [1, 2]},
        "machine": {"cpu": "x", "cores": 2},
        "left_out": {},
        "fronts": {},
    }
    return json.dumps(kept | {"points": rows}).encode()


TRADEOFF = Target(
    "tradeoff",
    ".json",
    lambda: [_record()],
    lambda path: check_settings(path, {"a": 1, "b": [1, 2]}),
    (ParameterError,),
    (json_text_changed,),
)

TARGETS = (SCRIPT, APPLIED, HISTORY, TRADEOFF)
