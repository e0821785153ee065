"""What commands print: progress, lines of a log, and results as tables and JSON."""

import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from foldgauss._runtime.checks import require
from foldgauss.cli.app.application import err, out, warn
from foldgauss.io._atomic import atomic_path
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.models.metrics import Evaluation
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: Most frame numbers that a message prints.
LISTED_FRAMES = 8


def print_shots(starts: tuple[int, ...], times: Float[np.ndarray, " frames"]) -> None:
    """Print where shots begin if there are several, and warn of those that no cut between frame times explains."""
    if len(starts) > 1:
        err.print(f"{len(starts)} shots, each on its own; they begin at frames {list_frames(starts)}.")
    lost = sorted(set(starts[1:]) - set(1 + np.flatnonzero(is_cut(times))))
    if lost:
        warn(
            f"The motion of the camera was not found before frames {list_frames(lost)}, and the model has no cut "
            "there: the picture may jump. A longer fit shows more to follow, above all where contrast is low."
        )


def list_frames(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames[:LISTED_FRAMES])) + (", ..." if len(frames) > LISTED_FRAMES else "")


#: What a model file may contain.
Video = VideoModel | EditedVideo | SegmentedVideo
Display = Literal["bar", "lines", "json", "quiet"]

#: Seconds before the first line of a log, which is early since options may be mistyped.
FIRST_LINE_SECONDS = 10.0
#: Seconds between two lines of a log.
LINE_SECONDS = 30.0


def choose_display(quiet: bool = False, log_json: bool = False) -> Display:
    """How progress is displayed: as the options say, otherwise a bar on a terminal and lines in a log."""
    require(
        not (quiet and log_json), "--quiet", expected="one of --quiet and --log-json", got="both", cure="Leave one out."
    )
    if quiet or log_json:
        return "quiet" if quiet else "json"
    return "bar" if err.is_terminal else "lines"


@contextmanager
def show_status(text: str) -> Iterator[None]:
    """What is being done: shown on a terminal while it lasts, elsewhere printed once if it takes long."""
    if err.is_terminal:
        with err.status(text):
            yield
        return
    timer = threading.Timer(FIRST_LINE_SECONDS, lambda: err.print(f"{text} ...", soft_wrap=True))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def show_progress(display: Display) -> Iterator[Callable[..., None]]:
    """Yields show(title, done, total, text): a bar for each title, or lines now and then; `json` and `quiet`: nothing.

    `text` describes the state; by default it is "1 of 3". A given one is also printed at the end.
    """
    columns = TextColumn("{task.description}", markup=False), BarColumn(bar_width=16)
    columns += TextColumn("{task.fields[text]}", markup=False), TimeElapsedColumn()
    columns += TextColumn("left"), TimeRemainingColumn()
    with Progress(*columns, console=err, disable=display != "bar") as bars:
        tasks: dict[str, Any] = {}
        due = time.monotonic() + FIRST_LINE_SECONDS

        def show(title: str, done: float, total: float, text: str = "") -> None:
            nonlocal due
            state = text or f"{done:,} of {total:,}"
            if title not in tasks:
                tasks[title] = bars.add_task(title, total=total, text=state)
            bars.update(tasks[title], completed=done, total=total, text=state)
            if display == "lines" and (time.monotonic() >= due or (text and done >= total)):
                due = time.monotonic() + LINE_SECONDS
                err.print(f"{title} {done / total:4.0%}  {state}".rstrip(), soft_wrap=True)

        yield show


@contextmanager
def progress_bar(title: str, total: int, shown: bool = True) -> Iterator[Callable[[], None]]:
    """As `show_progress`, with one bar; yields the function that advances it."""
    done = itertools.count(1)
    with show_progress(choose_display(quiet=not shown)) as show:
        show(title, 0, total)
        yield lambda: show(title, next(done), total)


def summarize_scores(model: Video, scores: Evaluation) -> dict[str, Any]:
    """Mean and lowest scores, and the model's size, as results show them."""
    return {
        "mean_psnr": round(scores.mean_psnr, 3),
        "mean_ssim": round(scores.mean_ssim, 4),
        "lowest_psnr": round(min(scores.psnr), 3),
        "num_frames": model.num_frames,
        "height": model.size[0],
        "width": model.size[1],
        "num_gaussians": model.num_gaussians,
        "degree": model.degree,
    }


_LABELS = {
    "mean_psnr": ("mean PSNR", "{:.2f} dB"),
    "mean_psnr_on_white": ("mean PSNR over white", "{:.2f} dB"),
    "mean_ssim": ("mean SSIM", "{:.4f}"),
    "lowest_psnr": ("lowest PSNR of a frame", "{:.2f} dB"),
    "num_frames": ("frames", "{:,}"),
    "height": ("height", "{:,} px"),
    "width": ("width", "{:,} px"),
    "num_gaussians": ("Gaussians", "{:,}"),
    "degree": ("degree of the folds", "{}"),
    "fit_seconds": ("fitting time", "{:.1f} s"),
    "wall_seconds": ("total time", "{:.1f} s"),
    "peak_mib": ("peak memory of a process", "{:,} MiB"),
    "num_segments": ("segments", "{:,}"),
    "steps": ("steps", "{:,}"),
    "stopped_by": ("stopped by", "{}"),
    "loss_db": ("loss", "{:.3f} dB"),
    "num_dropped": ("Gaussians removed", "{:,}"),
    "bytes_before": ("before", "{:,} bytes"),
    "file_bytes": ("model file", "{:,} bytes"),
    "frames_per_second": ("rendering speed", "{:.0f} frames per second"),
    "ratio": ("compression factor", "{:.2f}"),
    "bits_per_pixel": ("bits per pixel", "{:.3f}"),
}


def print_figures(title: str, figures: dict[str, Any]) -> None:
    table = Table(title=title, show_header=False)
    for name, value in figures.items():
        label, form = _LABELS[name]
        table.add_row(label, form.format(value))
    out.print(table)


def format_count(count: int, noun: str) -> str:
    """A count with its noun, as "1 frame" or "1,200 frames"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def write_json(path: Path, figures: dict[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n")
