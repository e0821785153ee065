"""The moving object: how well `find_moving_object` agrees with true masks, without any input.

    python -m benchmarks.moving_objects --clips FOLDER --masks FOLDER [--only NAME ...] [--sheets FOLDER] [--json FILE]

Each subfolder of --clips holds the frames of a clip, and the subfolder of --masks of the same name its masks, as
`JPEGImages/480p` and `Annotations/480p` of DAVIS do; clips without masks are left out. Intersection over union is of
each frame, its mean over all of them.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks import _common
from benchmarks._clips import ClipSource, folder_sources
from benchmarks._common import console
from foldgauss.io import read_masks, write_image
from foldgauss.video import find_moving_object

#: Frames of a sheet, and the width of each.
SHOWN, WIDTH = 8, 480


def measure_overlap(masks: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Intersection over union of each frame; 1 where both are empty."""
    both, either = (masks & truth).sum((1, 2)), (masks | truth).sum((1, 2))
    return np.where(either == 0, 1.0, both / np.maximum(either, 1))


def draw_sheet(frames: np.ndarray, masks: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Some frames, two in a row: dark outside of the mask, with its border in red and the true one in green."""
    pictures = []
    for k in np.linspace(0, len(frames) - 1, SHOWN).round().astype(int):
        picture = np.where(masks[k][..., None], frames[k], frames[k] // 3)
        for mask, color in ((truth[k], (0, 255, 0)), (masks[k], (255, 0, 0))):
            contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(picture, contours, -1, color, 1)
        pictures.append(cv2.resize(picture, (WIDTH, round(WIDTH * frames.shape[1] / frames.shape[2]))))
    return np.concatenate([np.concatenate(pictures[n : n + 2], 1) for n in range(0, SHOWN, 2)])


def measure(source: ClipSource, truth: np.ndarray, sheets: Path | None) -> tuple[np.ndarray, float]:
    """Intersections over union, and seconds of processor time for each frame."""
    frames = source.read().frames
    begun = time.process_time()
    try:
        masks = find_moving_object(frames)
    except ValueError as error:
        console.print(f"{source.name}: {error}")
        masks = np.zeros_like(truth)
    seconds = (time.process_time() - begun) / len(frames)
    if sheets is not None:
        sheets.mkdir(parents=True, exist_ok=True)
        write_image(sheets / f"{source.name}.png", draw_sheet(frames, masks, truth))
    return measure_overlap(masks, truth), seconds


def main(arguments: list[str] | None = None) -> None:
    options = _common.parse(_parser(), arguments)
    sources = [one for one in folder_sources(options.clips) if (options.masks / one.name).is_dir()]
    if options.only:
        sources = [one for one in sources if one.name in options.only]
    if not sources:
        raise SystemExit(f"--masks: expected masks of a clip in {options.clips}, {options.masks} has none.")
    columns = "clip", "frames", "mean", "worst frame", "frames above 0.5", "CPU s per frame"
    table, figures, frames = _common.table("Intersection over union", *columns), {}, {}
    for source in sources:
        truth = read_masks(options.masks / source.name)
        overlap, seconds = measure(source, truth, options.sheets)
        table.add_row(
            source.name,
            str(len(overlap)),
            f"{overlap.mean():.3f}",
            f"{overlap.min():.2f}",
            f"{(overlap > 0.5).mean():.0%}",
            f"{seconds:.2f}",
        )
        figures |= {f"overlap of {source.name}": overlap.mean(), f"CPU seconds per frame of {source.name}": seconds}
        frames[source.name] = [round(float(one), 3) for one in overlap]
    mean = float(np.mean([value for name, value in figures.items() if name.startswith("overlap")]))
    table.add_section()
    table.add_row("mean", "", f"{mean:.3f}")
    figures["mean overlap"] = mean
    console.print(table)
    _common.finish(options.json, figures, _common.describe_machine(), overlap_of_frames=frames)


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    parser.add_argument("--clips", type=Path, required=True, metavar="FOLDER", help="its subfolders are clips")
    parser.add_argument("--masks", type=Path, required=True, metavar="FOLDER", help="its subfolders hold their masks")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these clips alone")
    parser.add_argument("--sheets", type=Path, metavar="FOLDER", help="pictures go here, one for each clip (PNG)")
    return parser


if __name__ == "__main__":
    main()
