"""A fit that is killed again and again, and what lies on the disk after each kill."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks._dying import HIDDEN
from foldgauss.io import write_video
from foldgauss.io.datasets import bunny
from foldgauss.io.models.model_file import ModelFileError, load_model, read_header
from foldgauss.io.models.video_model import load_video_model

FRAMES = (0, 12)
SIZE = (80, 160)
#: Fits by name: what is kept of them differs. Frame times are learned in all. Checkpoints are of 2 to 4 MB.
FITS = {
    "plain": ["--gaussians", "20000", "--steps", "400"],
    "growth": [
        *("--preset", "paper", "--gaussians", "4000", "--max-gaussians", "20000"),
        *("--degree", "3", "--steps", "400"),
    ],
}
#: Seconds between two checkpoints, instead of 30.
EVERY = 0.2
#: Where kills are aimed at, in turn: at any time, into the writing of a checkpoint, into that of the model.
AIMS = ("time", "checkpoint", "time", "checkpoint", "time", "model")
#: Moments in the writing of a file, and their probabilities: most while bytes go out, else between that and its name.
MOMENTS = {"bytes": 0.55, "written": 0.15, "flushed": 0.15, "named": 0.15}


class Wrong(AssertionError):
    """A file is damaged, lost or other than it should be."""


class Uninterrupted(NamedTuple):
    """The model and the cost of a fit that is not interrupted."""

    model: bytes
    seconds: float
    num_checkpoints: int
    checkpoint_bytes: int  # of the smallest


def write_clip(path: Path) -> None:
    """Some frames of Bunny, small."""
    clip = bunny(frames=FRAMES, size=SIZE)
    write_video(path, clip.frames, clip.fps)


def command(plan: dict[str, Any], clip: Path, target: Path, options: list[str]) -> list[str]:
    """The fit in a process that kills itself as `plan` says, see `benchmarks._dying`."""
    words = [sys.executable, "-m", "benchmarks._dying", json.dumps(plan | {"every": EVERY})]
    return [*words, "fit", str(clip), "--out", str(target), "--quiet", *options]


def uninterrupted(clip: Path, options: list[str], folder: Path) -> Uninterrupted:
    target = folder / "whole.safetensors"
    begun = time.monotonic()
    words = command({"ending": ".checkpoint"}, clip, target, options)
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    seconds = time.monotonic() - begun
    num, least = map(int, done.stderr.split()[-2:])
    return Uninterrupted(target.read_bytes(), seconds, num, least)


def run(
    name: str, num: int, seed: int, folder: Path, tell: Callable[[str], None] = print
) -> tuple[list[dict[str, Any]], int]:
    """One row for each of `num` kills of the fit `name`, and how many fits came to their end among them; the last does.

    Raises `Wrong` where a file is damaged, the fit goes back, or a model differs from that of the fit left in peace.
    """
    clip, place, alone = folder / "clip.mp4", folder / name, folder / f"{name}-alone"
    place.mkdir()
    alone.mkdir()
    write_clip(clip)
    whole = uninterrupted(clip, FITS[name], alone)
    tell(f"{name}: {whole.seconds:.0f} s and {whole.num_checkpoints} checkpoints left in peace")
    rng, rows, ended, step, hidden = np.random.default_rng(seed), [], 0, None, set()
    target, kept = place / "m.safetensors", place / "m.safetensors.checkpoint"
    while True:
        aim = AIMS[len(rows) % len(AIMS)] if len(rows) < num else "none"
        plan, delay = _aimed(aim, rng, whole)
        code = _run(command(plan, clip, target, FITS[name]), delay)
        if code not in (0, -signal.SIGKILL):
            raise Wrong(f"{name}: the fit ended with {code} after {rows[-1:]}")
        if code:
            step = _check_files(target, kept, step)
            found = {path.name for path in place.iterdir() if HIDDEN.fullmatch(path.name)}
            in_write = sorted(Path(new).suffix for new in found - hidden)
            rows.append({"fit": name, "aim": aim, "step": step, "in_write": in_write})
            hidden |= found
            tell(f"{name} {len(rows)}: {rows[-1]}")
        if code == 0 or (target.exists() and not kept.exists()):
            _check_end(target, whole, code)
            ended, step = ended + 1, None
            if len(rows) >= num:
                return rows, ended
            for left in place.iterdir():
                left.unlink()


def _aimed(aim: str, rng: np.random.Generator, whole: Uninterrupted) -> tuple[dict[str, Any], float | None]:
    """The plan of the process, and after how many seconds it is killed from outside."""
    if aim == "time":
        return {"ending": ".checkpoint"}, float(rng.uniform(0, whole.seconds))
    if aim == "none":
        return {"ending": ".checkpoint"}, None
    size, most, ending = len(whole.model), 1, ".safetensors"
    if aim == "checkpoint":
        size, most, ending = whole.checkpoint_bytes, max(whole.num_checkpoints // 2, 1), ".checkpoint"
    plan = {"ending": ending, "moment": str(rng.choice(list(MOMENTS), p=list(MOMENTS.values())))}
    return plan | {"number": int(rng.integers(1, most + 1)), "count": int(rng.integers(1, size))}, None


def _run(words: list[str], delay: float | None) -> int:
    """Exit code of a process, which is killed after `delay` seconds."""
    process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        process.kill()
    return process.wait()


def _check_files(target: Path, kept: Path, before: int | None) -> int | None:
    """The step of the checkpoint after a kill. Raises `Wrong` for a damaged file, or a checkpoint that went back."""
    for path, load in ((target, load_video_model), (kept, load_model)):
        if path.exists():
            try:
                load(path)
            except ModelFileError as error:
                raise Wrong(f"{path.name} after a kill: {error}") from error
    if not kept.exists():
        if before is not None and not target.exists():
            raise Wrong(f"the checkpoint of step {before} is gone, and there is no model")
        return None
    step = read_header(kept)["header"]["counters"]["step"]
    if before is not None and step < before:
        raise Wrong(f"the checkpoint went back from step {before} to {step}")
    return step


def _check_end(target: Path, whole: Uninterrupted, code: int) -> None:
    """The model must be that of the fit left in peace; after an end in peace nothing else may be there."""
    if target.read_bytes() != whole.model:
        raise Wrong("the model differs from that of a fit that was never killed")
    beside = sorted(path.name for path in target.parent.iterdir() if path != target)
    if code == 0 and beside:
        raise Wrong(f"left beside the model: {beside}")
