"""Commands that are killed while they write, each with an older output in its place."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._dying import HIDDEN
from benchmarks._kills import Wrong, write_clip

FIT = ["--gaussians", "2000", "--steps", "60", "--quiet"]
SCRIPT = '[[edits]]\ndo = "move"\noffset = [0.1, 0.0]\n'
#: Commands by what they write; MODEL, CLIP and SCRIPT stand for files.
COMMANDS = {
    "v.mp4": ["render", "MODEL", "--out"],
    "frames": ["render", "MODEL", "--out"],
    "e.json": ["evaluate", "MODEL", "CLIP", "--json"],
    "c.fgz": ["compress", "MODEL", "--out"],
    "e.safetensors": ["edit", "MODEL", "SCRIPT", "--out"],
    "m.ply": ["export", "MODEL", "--format", "ply", "--out"],
    "meshes": ["export", "MODEL", "--format", "obj", "--out"],
    "page.html": ["view", "MODEL", "--out"],
}
#: Commands that fill a folder, file by file, and go on when called again: which of its files they are killed in.
FOLDERS = {
    "tradeoff": (["tradeoff", "CLIP", "--axes", "degree", "--steps", "12", "--out"], (".json", ".safetensors")),
    "uncertainty": (["uncertainty", "MODEL", "CLIP", "--steps", "400", "--out"], (".csv", ".nc", ".png")),
}
#: What files are named in folders that are written whole.
WITHIN = {"frames": "00000.png", "meshes": "frame_0000.obj"}
OLDER = b"older"


def run(seed: int, tell: Callable[[str], None], folder: Path) -> list[dict[str, Any]]:
    """A row for each kill. Raises `Wrong` for an output that is neither the older nor the whole new one."""
    rng, rows, places = np.random.default_rng(seed), [], _prepared(folder)
    for name, words in COMMANDS.items():
        words = [str(places.get(word, word)) for word in words]
        whole = folder / "whole" / name
        whole.parent.mkdir(exist_ok=True)
        _foldgauss([*words, str(whole)])
        ending = Path(WITHIN.get(name, name)).suffix
        for moment in ("written", "flushed", "named") if ending == ".mp4" else ("bytes", "bytes", "flushed", "named"):
            if name in WITHIN and moment != "bytes":
                continue  # their files are not flushed one by one
            place = folder / f"{len(rows)}"
            place.mkdir()
            _older(place / name)
            plan = {"ending": ending, "moment": moment}
            if moment == "bytes":
                plan["count"] = int(rng.integers(1, (whole / WITHIN[name] if name in WITHIN else whole).stat().st_size))
            code = _foldgauss([*words, str(place / name), "--overwrite"], plan)
            rows.append({"output": name, **plan, "found": _found(place, name, whole, code), "left": _left(place)})
            tell(str(rows[-1]))
    for name, (words, endings) in FOLDERS.items():
        words = [str(places.get(word, word)) for word in words]
        for ending in endings:
            place = folder / f"{name}{ending}"
            code = _foldgauss([*words, str(place)], {"ending": ending, "moment": "bytes", "count": 20})
            if code != -signal.SIGKILL:
                raise Wrong(f"{name} was not killed in {ending}: {code}")
            _foldgauss([*words, str(place)])
            rows.append({"output": name, "ending": ending, "moment": "bytes", "found": "went on to its end"})
            rows[-1]["left"] = _left(place)
            tell(str(rows[-1]))
    return rows


def _prepared(folder: Path) -> dict[str, Path]:
    """A clip, a model fitted to it and a script of edits."""
    places = {"CLIP": folder / "clip.mp4", "MODEL": folder / "model.safetensors", "SCRIPT": folder / "move.toml"}
    write_clip(places["CLIP"])
    places["SCRIPT"].write_text(SCRIPT)
    _foldgauss(["fit", str(places["CLIP"]), "--out", str(places["MODEL"]), *FIT])
    return places


def _foldgauss(words: list[str], plan: dict[str, Any] | None = None) -> int:
    """Exit code of the command, which `plan` ends; without a plan it must end well."""
    program = ["foldgauss"] if plan is None else ["benchmarks._dying", json.dumps(plan)]
    done = subprocess.run([sys.executable, "-m", *program, *words], capture_output=True, text=True)
    if plan is None and done.returncode:
        raise Wrong(f"{words}: {done.returncode}, {done.stderr[-500:]}")
    return done.returncode


def _older(path: Path) -> None:
    if path.suffix:
        path.write_bytes(OLDER)
    else:
        path.mkdir()
        (path / WITHIN[path.name]).write_bytes(OLDER)


def _found(place: Path, name: str, whole: Path, code: int) -> str:
    """Which output lies there after a kill."""
    if code != -signal.SIGKILL:
        raise Wrong(f"{name} was not killed: {code}")
    if _read(place / name) == _older_of(name):
        return "the older one"
    # What a file says of times and speeds differs from run to run: its length does not.
    new, there = _read(whole), _read(place / name)
    alike = new == there or (name == "e.json" and json.loads(there[""]).keys() == json.loads(new[""]).keys())
    if not alike:
        raise Wrong(f"{name} is neither the older one nor the whole new one")
    return "the new one"


def _read(path: Path) -> dict[str, bytes]:
    if path.is_file():
        return {"": path.read_bytes()}
    return {inner.name: inner.read_bytes() for inner in path.iterdir()}


def _older_of(name: str) -> dict[str, bytes]:
    return {WITHIN.get(name, ""): OLDER}


def _left(place: Path) -> list[str]:
    return sorted(path.name for path in place.iterdir() if HIDDEN.fullmatch(path.name))
