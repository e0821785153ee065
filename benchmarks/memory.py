"""Peak memory of a fit against the number of frames.

    python -m benchmarks.memory [--json FILE] [--frames N ...] [--size HxW] [--gaussians N] [--steps N]

Each clip is written to a video file (Bunny's frames, to and fro, shifted from turn to turn) and fitted by
`foldgauss fit` in a process of its own, whose largest resident set is read off: decoding, motion, the fit and its
evaluation included. Frames are held as bytes, motion in at most a quarter of that, so the line of best fit should rise
by little more than 1.25 times a frame's bytes; what a fit needs beside is its intercept.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip

FRAMES, SIZE, LIMIT = (125, 250, 500, 1000, 2000), (320, 640), 2 * 1024**3


#: Runs the command that follows, and prints its largest resident set in bytes at the end. It is a process of its own:
#: on Linux the largest of a process is never below that of the one that started it, and other children count as well.
MEASURED = [
    *(sys.executable, "-c"),
    "import resource, subprocess, sys; status = subprocess.run(sys.argv[1:]).returncode; "
    "unit = 1 if sys.platform == 'darwin' else 1024; "
    "print(); print(unit * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss); sys.exit(status)",
]


def write_clip(path: Path, num: int, size: tuple[int, int]) -> None:
    """`num` frames of Bunny to and fro, moved by some pixels at each turn, in a quick codec."""
    frames = read_video(sample_clip("bunny"), size=size).frames
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, size[::-1])
    for k in range(num):
        turn, place = divmod(k, len(frames))
        own = frames[place if turn % 2 == 0 else len(frames) - 1 - place]
        writer.write(np.ascontiguousarray(np.roll(own, 3 * turn, axis=1)[..., ::-1]))
    writer.release()


def peak_of(clip: Path, options) -> int:
    """Largest resident set, in bytes, of a fit of `clip` in another process."""
    command = [sys.executable, "-m", "foldgauss", "fit", str(clip), "--out", str(clip.with_suffix(".safetensors"))]
    command += ["--gaussians", str(options.gaussians), "--steps", str(options.steps), "--quiet"]
    done = subprocess.run([*MEASURED, *command], check=True, capture_output=True, text=True)
    return int(done.stdout.split()[-1])


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--frames", type=_common.whole, nargs="+", default=FRAMES, help="numbers of frames")
    parser.add_argument("--size", type=_common.size, metavar="HxW", default=SIZE, help="[320x640]")
    parser.add_argument("--gaussians", type=_common.whole, default=80_000, help="[80000]")
    parser.add_argument("--steps", type=_common.whole, default=60, help="[60]")
    options = _common.parse(parser, arguments)
    peaks, each = {}, 3 * options.size[0] * options.size[1]
    table = _common.table("peak memory", "frames", "MiB", "MiB of the frames as bytes")
    for num in options.frames:
        with tempfile.TemporaryDirectory() as folder:
            clip = Path(folder) / "clip.avi"
            write_clip(clip, num, options.size)
            peaks[num] = peak_of(clip, options)
        table.add_row(f"{num:,}", f"{peaks[num] / 2**20:.0f}", f"{num * each / 2**20:.0f}")
    console.print(table)
    figures = {f"peak_mib_{num}": peak / 2**20 for num, peak in peaks.items()}
    if len(peaks) > 1:
        slope, base = np.polyfit(list(peaks), list(peaks.values()), 1)
        figures |= {"bytes_per_frame_over_its_own": slope / each, "base_mib": base / 2**20}
    figures["within_2_gib"] = float(max(peaks.values()) <= LIMIT)
    _common.finish(options.json, figures, _common.describe_machine(), gaussians=options.gaussians, size=options.size)


if __name__ == "__main__":
    main()
