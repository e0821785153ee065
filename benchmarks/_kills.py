"""A fit that is killed again and again, and what lies on the disk after each kill."""

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks._dying import HIDDEN
from foldgauss.io import write_video
from foldgauss.io.datasets import bunny
from foldgauss.io.models.model_file import ModelFileError, load_model, read_header
from foldgauss.io.models.video_model import load_video_model, read_metadata, save_video_model

FRAMES, SIZE = (0, 12), (80, 160)
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
#: In the writing of a file: most while bytes go out, else between that and its name.
MOMENTS, WEIGHTS = ("bytes", "written", "flushed", "named"), (0.55, 0.15, 0.15, 0.15)
ENDINGS = {"checkpoint": ".checkpoint", "model": ".safetensors"}


class Wrong(AssertionError):
    """A file is damaged, lost or other than it should be."""


class Uninterrupted(NamedTuple):
    """A fit that nobody disturbs: its model, also as it is before its scores are known; and what it took."""

    model: bytes
    before_scores: bytes
    seconds: float
    num_checkpoints: int
    checkpoint_bytes: int


def write_clip(path: Path) -> None:
    """Some frames of Bunny, small."""
    clip = bunny(frames=FRAMES, size=SIZE)
    write_video(path, clip.frames, clip.fps)


def command(plan: dict[str, Any], clip: Path, target: Path, options: list[str]) -> list[str]:
    """The fit in a process that strikes itself down as `plan` says, see `benchmarks._dying`."""
    words = [sys.executable, "-m", "benchmarks._dying", json.dumps(plan | {"every": EVERY})]
    return [*words, "fit", str(clip), "--out", str(target), "--quiet", *options]


def uninterrupted(clip: Path, options: list[str], folder: Path) -> Uninterrupted:
    target = folder / "whole.safetensors"
    begun = time.monotonic()
    words = command({"ending": ".checkpoint"}, clip, target, options)
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    seconds = time.monotonic() - begun
    about = {name: value for name, value in read_metadata(target).items() if name not in ("mean_psnr", "mean_ssim")}
    save_video_model(folder / "unscored.safetensors", load_video_model(target), metadata=about)
    num = int(done.stderr.split()[-1])
    # Sizes change as Gaussians come and go; the first one tells where a write may be cut.
    size = _first_checkpoint(clip, options, folder)
    return Uninterrupted(target.read_bytes(), (folder / "unscored.safetensors").read_bytes(), seconds, num, size)


def _first_checkpoint(clip: Path, options: list[str], folder: Path) -> int:
    target = folder / "first.safetensors"
    plan = {"ending": ".checkpoint", "moment": "named"}
    subprocess.run(command(plan, clip, target, options), check=False, capture_output=True)
    kept = target.with_name(f"{target.name}.checkpoint")
    size = kept.stat().st_size
    kept.unlink()
    return size


def killed(
    name: str, num: int, seed: int, clip: Path, tell: Callable[[str], None], folder: Path
) -> tuple[list[dict[str, Any]], int]:
    """One row for each of `num` kills of the fit `name`, and how many fits came to their end among them; the last does.

    Raises `Wrong` where a file is damaged, the fit goes back, or a model differs from that of the fit left in peace.
    """
    options, place, alone = FITS[name], folder / name, folder / f"{name}-alone"
    place.mkdir()
    alone.mkdir()
    whole = uninterrupted(clip, options, alone)
    tell(f"{name}: {whole.seconds:.0f} s and {whole.num_checkpoints} checkpoints left in peace")
    rng, rows, ended, before = np.random.default_rng(seed), [], 0, None  # before: the step that is kept
    target = place / "m.safetensors"
    while len(rows) < num or rows[-1]["goes_on_from"] != "the end":
        aim = AIMS[len(rows) % len(AIMS)] if len(rows) < num else "none"
        plan, delay = _aimed(aim, rng, whole)
        code, passed = _run(command(plan, clip, target, [*options, *_going_on(target)]), delay)
        if code not in (0, -signal.SIGKILL):
            raise Wrong(f"{name}: the fit ended with {code} after {rows[-1:]}")
        if code == 0 or not _unfinished(target):
            _check_end(target, whole, code)
            ended += 1
        if code == 0 and aim == "none":
            break
        if code != 0:
            rows.append({"fit": name, "aim": aim, "seconds": round(passed, 2), **_seen(target, rows, before)})
            before = rows[-1]["step"]
            rows[-1] |= {key: plan[key] for key in ("moment", "number", "count") if aim != "time" and key in plan}
            tell(f"{name} {len(rows)}: {rows[-1]}")
        if code == 0 or not _unfinished(target):
            before = None
            for left in place.iterdir():
                left.unlink()
    return rows, ended


def _aimed(aim: str, rng: np.random.Generator, whole: Uninterrupted) -> tuple[dict[str, Any], float | None]:
    """What the process is told, and after how many seconds it is killed from outside."""
    if aim not in ENDINGS:
        return {"ending": ".checkpoint"}, float(rng.uniform(0, whole.seconds)) if aim == "time" else None
    if aim == "model":
        size, most = len(whole.before_scores), 2  # without its scores, and with them
    else:
        size, most = whole.checkpoint_bytes, max(whole.num_checkpoints // 2, 1)
    plan = {"ending": ENDINGS[aim], "moment": str(rng.choice(MOMENTS, p=WEIGHTS))}
    return plan | {"number": int(rng.integers(1, most + 1)), "count": int(rng.integers(1, size))}, None


def _run(words: list[str], delay: float | None) -> tuple[int, float]:
    """Exit code and seconds of a process, which is killed after `delay`."""
    begun = time.monotonic()
    process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        process.kill()
    return process.wait(), time.monotonic() - begun


def _kept(target: Path) -> Path:
    return target.with_name(f"{target.name}.checkpoint")


def _going_on(target: Path) -> list[str]:
    return ["--resume"] * _kept(target).exists() + ["--overwrite"] * target.exists()


def _unfinished(target: Path) -> bool:
    return _kept(target).exists() or not target.exists()


def _seen(target: Path, rows: list[dict[str, Any]], before: int | None) -> dict[str, Any]:
    """What lies there after a kill. Raises `Wrong` for a damaged file, or a checkpoint that went back."""
    hidden = [path for path in target.parent.iterdir() if HIDDEN.fullmatch(path.name)]
    hit = [f"{path.suffix[1:]}, {_state_of(path)}" for path in hidden if path.stat().st_mtime > _last(rows)]
    kept, step = _kept(target), None
    for path, load in ((target, load_video_model), (kept, load_model)):
        if path.exists():
            try:
                load(path)
            except ModelFileError as error:
                raise Wrong(f"{path.name} after a kill: {error}") from error
    if kept.exists():
        step = read_header(kept)["header"]["counters"]["step"]
    if before is not None and kept.exists() and step < before:
        raise Wrong(f"the checkpoint went back from step {before} to {step}")
    if before is not None and not kept.exists() and not target.exists():
        raise Wrong(f"the checkpoint of step {before} is gone, and there is no model")
    goes_on = "its checkpoint" if kept.exists() else "the end" if target.exists() else "the start"
    return {"in_write": hit, "step": step, "goes_on_from": goes_on, "looked_at": time.time()}


def _last(rows: list[dict[str, Any]]) -> float:
    return rows[-1]["looked_at"] if rows else 0.0


def _state_of(hidden: Path) -> str:
    """How far a hidden file had come."""
    if hidden.stat().st_size == 0:
        return "empty"
    try:
        load_model(hidden)
    except ModelFileError:
        return "cut off"
    return "whole, without its name"


def _check_end(target: Path, whole: Uninterrupted, code: int) -> None:
    """The model must be that of the fit left in peace; after an end in peace nothing else may be there."""
    found = target.read_bytes()
    if found != whole.model and (code == 0 or found != whole.before_scores):
        raise Wrong("the model differs from that of a fit that was never killed")
    beside = sorted(path.name for path in target.parent.iterdir() if path != target)
    if code == 0 and beside:
        raise Wrong(f"left beside the model: {beside}")


def run(kills: dict[str, int], seed: int, tell: Callable[[str], None]) -> dict[str, Any]:
    """All fits of `kills` with their numbers of kills; rows, ends and counts of what was hit."""
    rows, ended = [], 0
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.mp4"
        write_clip(clip)
        for name, num in kills.items():
            own, ends = killed(name, num, seed, clip, tell, Path(folder))
            rows, ended = rows + own, ended + ends
    hits = Counter(hit for row in rows for hit in row["in_write"])
    return {"rows": rows, "ended": ended, "hits": dict(hits)}
