"""A long clip through the commands: the largest memory of each, and the progress that a fit reports."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip

#: Bytes beside the frames that a command may take: the interpreter, JAX, compiled kernels, one frame's work. A fit
#: has its Gaussians and their moments beside.
BASE = 700 * 2**20
#: Of the frames' bytes: a fit holds them, and their motion in a quarter; evaluation holds them, drawing one at a time.
FRACTIONS = {"fit": 1.25, "evaluate": 1.0, "render": 0.0}
#: Runs the command that follows, and prints its peak resident set size in bytes at the end. It is a separate process,
#: because on Linux a child starts with the peak of its parent, and `RUSAGE_CHILDREN` includes all other children.
MEASURED = [
    *(sys.executable, "-c"),
    "import resource, subprocess, sys; status = subprocess.run(sys.argv[1:]).returncode; "
    "unit = 1 if sys.platform == 'darwin' else 1024; "
    "print(); print(unit * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss); sys.exit(status)",
]


class Ran(NamedTuple):
    """A command: seconds, largest resident set in bytes, and its lines of JSON."""

    seconds: float
    peak: int
    lines: list[dict[str, Any]]


def write_clip(path: Path, num: int, size: tuple[int, int]) -> None:
    """`num` frames of Bunny to and fro, moved by some pixels at each turn, in a quick codec."""
    frames = read_video(sample_clip("bunny"), size=size).frames
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, size[::-1])
    for k in range(num):
        turn, place = divmod(k, len(frames))
        own = frames[place if turn % 2 == 0 else len(frames) - 1 - place]
        writer.write(np.ascontiguousarray(np.roll(own, 3 * turn, axis=1)[..., ::-1]))
    writer.release()


def run(words: list[str]) -> Ran:
    """The command in a process of its own. Raises CalledProcessError where it fails."""
    begun, command = time.monotonic(), [*MEASURED, sys.executable, "-m", "foldgauss", *words]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    told = [json.loads(line) for line in lines if line.startswith("{")]
    return Ran(time.monotonic() - begun, int(lines[-1]), told)


def bound(command: str, frame_bytes: int, num_gaussians: int) -> int:
    """Bytes that `command` may take at most: a fraction of the frames' bytes, and what does not grow with them.

    A fit's Gaussians of degree 3 have 17 numbers each, in four copies (two moments, the gradient), and as much again
    while pictures are drawn.
    """
    own = 8 * 17 * 4 * num_gaussians if command == "fit" else 0
    return int(FRACTIONS[command] * frame_bytes) + BASE + own


def long_clip(clip: Path, folder: Path, gaussians: int, steps: int) -> dict[str, Ran]:
    """`fit`, `evaluate` and `render` of a clip in one process each."""
    model = folder / "long.safetensors"
    fit = ["fit", str(clip), "--out", str(model), "--gaussians", str(gaussians), "--steps", str(steps), "--log-json"]
    return {
        "fit": run(fit),
        "evaluate": run(["evaluate", str(model), str(clip), "--json", str(folder / "scores.json")]),
        "render": run(["render", str(model), "--out", str(folder / "long.mp4")]),
    }
