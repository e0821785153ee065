"""A long clip through the commands: what each takes at most, and whether a fit's progress is true."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.memory import MEASURED

#: Bytes beside the frames that a command may take: the interpreter, JAX, compiled kernels, one frame's work. A fit
#: has its Gaussians and their moments beside.
BASE = 700 * 2**20
#: Of the frames' bytes: a fit holds them, and their motion in a quarter; evaluation holds them, drawing one at a time.
SHARES = {"fit": 1.25, "evaluate": 1.0, "render": 0.0}


class Ran(NamedTuple):
    """A command: seconds, largest resident set in bytes, and its lines of JSON with the seconds at which they came."""

    seconds: float
    peak: int
    lines: list[tuple[float, dict[str, Any]]]


def run(words: list[str]) -> Ran:
    """The command in a process of its own. Raises CalledProcessError with what it said."""
    begun, lines, line = time.monotonic(), [], ""
    command = [*MEASURED, sys.executable, "-m", "foldgauss", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        said = []
        reader = threading.Thread(target=lambda: said.append(process.stderr.read()), daemon=True)
        reader.start()
        for line in process.stdout:
            if line.startswith("{"):
                lines.append((time.monotonic() - begun, json.loads(line)))
        reader.join()
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command, stderr=said[0])
    return Ran(time.monotonic() - begun, int(line), lines)


def bound(command: str, frame_bytes: int, num_gaussians: int) -> int:
    """Bytes that `command` may take at most: a share of the frames' bytes, and what does not grow with them.

    A fit's Gaussians of degree 3 have 17 numbers each, in four copies (two moments, the gradient), and as much again
    while pictures are drawn.
    """
    own = 8 * 17 * 4 * num_gaussians if command == "fit" else 0
    return int(SHARES[command] * frame_bytes) + BASE + own


def progress(lines: list[tuple[float, dict[str, Any]]]) -> dict[str, float]:
    """How true a fit's lines of progress were.

    `backwards`: how often the share done fell. `last`: the last one. `off_by`: the largest difference between the share
    of the steps done and that of the fit's own time. `left_off_by`: of the time left that was told from a fifth of the
    fit on, the median error as a share of the whole time.
    """
    told = [line for _, line in lines if line["event"] == "progress"]
    done, seconds = (np.array([line[name] for line in told], float) for name in ("progress", "seconds"))
    left = np.array([np.inf if line["seconds_left"] is None else line["seconds_left"] for line in told], float)
    begun, over = seconds[0], seconds[-1]
    passed = (seconds - begun) / (over - begun)
    late = (passed >= 0.2) & np.isfinite(left)
    wrong = np.abs(left - (over - seconds))[late] / (over - begun)
    return {
        "progress_lines": len(told),
        "progress_backwards": int((np.diff(done) < 0).sum()),
        "progress_last": float(done[-1]),
        "progress_off_by": float(np.abs(done - passed).max()),
        "left_off_by": float(np.median(wrong)) if late.any() else np.nan,
    }


def long_clip(clip: Path, folder: Path, gaussians: int, steps: int) -> dict[str, Ran]:
    """`fit`, `evaluate` and `render` of a clip in one process each."""
    model = folder / "long.safetensors"
    fit = ["fit", str(clip), "--out", str(model), "--gaussians", str(gaussians), "--steps", str(steps), "--log-json"]
    return {
        "fit": run(fit),
        "evaluate": run(["evaluate", str(model), str(clip), "--json", str(folder / "scores.json")]),
        "render": run(["render", str(model), "--out", str(folder / "long.mp4")]),
    }
