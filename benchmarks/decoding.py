"""How fast videos are decoded to RGB frames in memory, against OpenCV and `ffmpeg -f null`.

    python -m benchmarks.decoding [--json FILE] [--rounds N]

*Bunny* as it is (720p, H.264) and enlarged to 1080p (H.264, by ffmpeg). `foldgauss`: `read_video`; `foldgauss at
160x320`: with `size`, as fits read clips; `OpenCV`: `cv2.VideoCapture.read` of every frame, which repeats chroma and
rounds down; `ffmpeg to RGB`: `-pix_fmt rgb24 -f rawvideo` to nowhere; `ffmpeg`: `-f null`, without any conversion.
Frames a second, medians over rounds in turn.
"""

import argparse
import shutil
import statistics
import subprocess
import tempfile
from pathlib import Path

import cv2

from benchmarks import _common
from benchmarks._common import Task, console
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip

ROUNDS = 5


def read_by_opencv(path: Path) -> int:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    num = sum(1 for _ in iter(lambda: capture.read()[0], False))
    capture.release()
    return num


def _ffmpeg(path: Path, *options: str) -> None:
    subprocess.run(["ffmpeg", "-v", "error", "-nostdin", "-i", str(path), "-an", *options], check=True)


def make_tasks(path: Path) -> dict[str, Task]:
    return {
        "foldgauss": Task(lambda: read_video(path)),
        "foldgauss at 160x320": Task(lambda: read_video(path, size=(160, 320))),
        "OpenCV": Task(lambda: read_by_opencv(path)),
        "ffmpeg to RGB": Task(lambda: _ffmpeg(path, "-pix_fmt", "rgb24", "-f", "rawvideo", "-y", "/dev/null")),
        "ffmpeg": Task(lambda: _ffmpeg(path, "-f", "null", "-")),
    }


def main(arguments: list[str] | None = None) -> None:
    parser: argparse.ArgumentParser = _common.parser(__doc__)
    parser.add_argument("--rounds", type=_common.whole, default=ROUNDS, help=f"of all ways in turn [{ROUNDS}]")
    options = _common.parse(parser, arguments)
    if shutil.which("ffmpeg") is None:
        raise SystemExit("expected ffmpeg on the PATH, got none. Install it.")
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        clips = {"720p": sample_clip("bunny"), "1080p": Path(folder) / "clip.mp4"}
        _ffmpeg(clips["720p"], "-vf", "scale=1920:1080", "-c:v", "libx264", "-crf", "18", str(clips["1080p"]))
        for name, path in clips.items():
            num = read_by_opencv(path)
            for way, seconds in _common.interleaved(make_tasks(path), options.rounds).items():
                figures[f"{name}, {way}"] = num / statistics.median(seconds)
    table = _common.table("frames a second", "way", *clips)
    for way in make_tasks(Path()):
        table.add_row(way, *(f"{figures[f'{name}, {way}']:.0f}" for name in clips))
    console.print(table)
    _common.finish(options.json, figures, _common.describe_machine())


if __name__ == "__main__":
    main()
