"""The moving object: how well `find_moving_object` agrees with true masks, without any input.

    python -m benchmarks.moving_objects --clips FOLDER --masks FOLDER [--only NAME ...] [--given N] [--json FILE]

Each subfolder of --clips holds the frames of a clip, and the subfolder of --masks of the same name its masks, as
`JPEGImages/480p` and `Annotations/480p` of DAVIS do; clips without masks are left out. Intersection over union is of
each frame, its mean over all of them. With --given, the true masks of N frames are given, evenly spaced from the first
to the last (1: the first). `follow_object` then finds the object in the other frames, over which the mean is taken.
"""

import time
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._clips import ClipSource, folder_sources
from benchmarks._common import console
from foldgauss.io import read_masks
from foldgauss.video import find_moving_object, follow_object


def measure_overlap(masks: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Intersection over union of each frame; 1 where both are empty."""
    both, either = (masks & truth).sum((1, 2)), (masks | truth).sum((1, 2))
    return np.where(either == 0, 1.0, both / np.maximum(either, 1))


def measure(source: ClipSource, truth: np.ndarray, num_given: int) -> tuple[np.ndarray, float]:
    """Intersections over union, and seconds of processor time for each frame."""
    frames = source.read().frames
    given = np.linspace(0, len(frames) - 1, num_given).round().astype(int)
    begun = time.process_time()
    try:
        masks = follow_object(frames, {k: truth[k] for k in given}) if num_given else find_moving_object(frames)
    except ValueError as error:
        console.print(f"{source.name}: {error}")
        masks = np.zeros_like(truth)
    overlap = np.delete(measure_overlap(masks, truth), given)
    return overlap, (time.process_time() - begun) / len(frames)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--clips", type=Path, required=True, metavar="FOLDER", help="its subfolders are clips")
    parser.add_argument("--masks", type=Path, required=True, metavar="FOLDER", help="its subfolders hold their masks")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these clips alone")
    parser.add_argument("--given", type=int, default=0, metavar="N", help="masks of N frames are given [0]")
    options = _common.parse(parser, arguments)
    sources = [one for one in folder_sources(options.clips) if (options.masks / one.name).is_dir()]
    sources = [one for one in sources if one.name in (options.only or [one.name])]
    if not sources:
        raise SystemExit(f"--masks: expected masks of a clip in {options.clips}, {options.masks} has none.")
    found = {source.name: measure(source, read_masks(options.masks / source.name), options.given) for source in sources}
    rows, figures = [], {"mean overlap": np.mean([overlap.mean() for overlap, _ in found.values()])}
    for name, (overlap, seconds) in found.items():
        shown = f"{overlap.mean():.3f}", f"{overlap.min():.2f}", f"{(overlap > 0.5).mean():.0%}", f"{seconds:.2f}"
        rows.append((name, len(overlap), *shown))
        figures |= {f"overlap of {name}": overlap.mean(), f"CPU seconds per frame of {name}": seconds}
    columns = "clip", "frames", "mean", "worst frame", "frames above 0.5", "CPU s per frame"
    _common.print_table("Intersection over union", columns, rows)
    of_frames = {name: [round(float(one), 3) for one in overlap] for name, (overlap, _) in found.items()}
    _common.finish(options.json, figures, overlap_of_frames=of_frames)


if __name__ == "__main__":
    main()
