"""How fast a long clip is indexed, and a span of it read by seeking, against decoding from the start.

    python -m benchmarks.reading [--json FILE] [--video FILE] [--frames N] [--rounds N]

Without --video, the clip is made with ffmpeg: Bunny's 132 frames of 720x1280 again and again, H.264 with a frame that
stands alone every 250 and three B-frames between others, the worst usual case. A span is the first second of frames at
the start, in the middle and at the end, as it is in the file; both ways give the same bits, which is checked. Seconds
are medians over rounds.
"""

import argparse
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import FrameIndex, LazyFrames, index_video, read_indexed, read_video
from foldgauss.io.datasets import sample_clip

FRAMES, ROUNDS = 2112, 3
_ENCODER = ["-an", "-c:v", "libx264", "-preset", "veryfast", "-pix_fmt", "yuv420p", "-g", "250", "-bf", "3"]


def write_clip(path: Path, num: int) -> None:
    """`num` frames of Bunny, from its first one again and again."""
    if shutil.which("ffmpeg") is None:
        raise SystemExit("--video: expected a clip, as ffmpeg is not installed to make one, got none.")
    source = ["ffmpeg", "-v", "error", "-nostdin", "-y", "-stream_loop", "-1", "-i", str(sample_clip("bunny"))]
    subprocess.run([*source, "-frames:v", str(num), *_ENCODER, str(path)], check=True)


def seconds_of(task: Callable[[], object]) -> tuple[float, object]:
    begun = time.perf_counter()
    result = task()
    return time.perf_counter() - begun, result


def measured(video: Path, rounds: int) -> tuple[dict[str, float], FrameIndex]:
    """Figures by name; raises where the two ways differ."""
    figures: dict[str, float] = {}
    taken, _ = seconds_of(lambda: index_video(video, find_cuts=False))
    whole, index = seconds_of(lambda: index_video(video))
    num = index.num_frames
    figures["frames"] = num
    figures["index, frames a second"] = num / whole
    figures["index without cuts, frames a second"] = num / taken
    span = max(1, min(round(index.fps), num // 3))
    places = {"start": 0, "middle": num // 2, "end": num - span}
    for place, first in places.items():
        range_ = first, first + span
        by_index, by_decoding = [], []
        for _ in range(rounds):
            lasted, found = seconds_of(lambda range_=range_: read_indexed(index, *range_))
            by_index.append(lasted)
            lasted, expected = seconds_of(lambda range_=range_: read_video(video, frames=range_))
            by_decoding.append(lasted)
            if not np.array_equal(found.frames, expected.frames):
                raise SystemExit(f"{place}: the frames differ")
        figures[f"{place}, by seeking, s"] = statistics.median(by_index)
        figures[f"{place}, from the start, s"] = statistics.median(by_decoding)
    lazy = LazyFrames(index, size=(160, 320))
    lasted, _ = seconds_of(lambda: [None for _ in lazy])
    figures["LazyFrames at 160x320, frames a second"] = num / lasted
    return figures, index


def main(arguments: list[str] | None = None) -> None:
    parser: argparse.ArgumentParser = _common.parser(__doc__)
    parser.add_argument("--video", type=Path, metavar="FILE", help="a clip of your own")
    parser.add_argument("--frames", type=_common.whole, default=FRAMES, help=f"of the clip that is made [{FRAMES}]")
    parser.add_argument("--rounds", type=_common.whole, default=ROUNDS, help=f"of each span [{ROUNDS}]")
    options = _common.parse(parser, arguments)
    with tempfile.TemporaryDirectory() as folder:
        video = options.video
        if video is None:
            video = Path(folder) / "clip.mp4"
            write_clip(video, options.frames)
        figures, index = measured(video, options.rounds)
    table = _common.table(
        f"a second of frames of {index.num_frames:,} of {index.size[0]}x{index.size[1]}",
        "place",
        "by seeking, s",
        "from the start, s",
    )
    for place in ("start", "middle", "end"):
        ways = (figures[f"{place}, {way}, s"] for way in ("by seeking", "from the start"))
        table.add_row(place, *(f"{value:.2f}" for value in ways))
    console.print(table)
    _common.finish(options.json, figures, _common.describe_machine(), cuts=index.cuts)


if __name__ == "__main__":
    main()
