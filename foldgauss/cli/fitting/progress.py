"""Observers of a running fit: a bar, lines in a log, JSON, its history, a preview."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn

from foldgauss.cli.shared.contact_sheet import make_comparison_sheet
from foldgauss.cli.shared.log_lines import FIRST_LINE_SECONDS, LINE_SECONDS
from foldgauss.io.history import HistoryFile, info_line
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.writing import write_image
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import FitInfo
from foldgauss.video.fitting.state import FitState, to_model
from foldgauss.video.models.metrics import psnr
from foldgauss.video.models.renderer import VideoRenderer

Observer = Callable[[FitState, FitInfo], None]
Display = Literal["bar", "lines", "json", "quiet"]

BAR_SECONDS = 0.1
JSON_SECONDS = 1.0
PREVIEW_SECONDS = 10.0


@contextmanager
def display_progress(
    display: Display, console: Console, *, history: HistoryFile | None = None, preview: Observer | None = None
) -> Iterator[Observer]:
    """One observer that displays the fit and writes its `history` and `preview`.

    Bar, lines and warnings go to `console`, JSON to standard output. An error of an observer that writes does not end
    the fit: it is printed, and that observer is no longer called.
    """
    with ExitStack() as stack:
        observers = [] if history is None else [_stop_on_error(stack.enter_context(history), "history", console)]
        observers += [] if preview is None else [_stop_on_error(preview, "preview", console)]
        if display == "bar":
            observers.append(stack.enter_context(_bar(console)))
        elif display == "lines":
            observers.append(_lines(console))
        elif display == "json":
            observers.append(_stop_on_error(_json_lines(), "progress", console))

        def observe(state: FitState, info: FitInfo) -> None:
            for one in observers:
                one(state, info)

        yield observe


def print_json(event: str, figures: dict) -> None:
    """One line of JSON on standard output, at once."""
    print(json.dumps({"event": event} | figures), flush=True)


def save_previews(path: Path, clip: Clip, config: FitConfig) -> Observer:
    """Writes original, reconstruction and error of the clip's middle frame to `path`, a PNG that is always complete.

    Written at the first step, every 10 s, and at the last step.
    """
    is_due, k = _Timer(PREVIEW_SECONDS, first=0.0), clip.num_frames // 2
    original = clip.frames[k, ..., :3]  # over black

    def observe(state: FitState, info: FitInfo) -> None:
        if not (is_due() or info.progress >= 1):
            return
        model = to_model(state, config, clip.size, clip.fps)
        image = VideoRenderer(model).frame(np.asarray(model.frame_times.times())[k])
        caption = f"frame {k}, step {info.step}, {psnr(original, image):.1f} dB"
        write_image(path, make_comparison_sheet([original], [image], [caption]))

    return observe


class _Timer:
    """True every so many `seconds`, for the first time after `first`."""

    def __init__(self, seconds: float, first: float):
        self.seconds, self.next = seconds, time.monotonic() + first

    def __call__(self) -> bool:
        now = time.monotonic()
        if now < self.next:
            return False
        self.next = now + self.seconds
        return True


def _stop_on_error(observe: Observer, what: str, console: Console) -> Observer:
    """An observer whose first error, as of a full disk, is printed, and which is not called again."""
    broken = False

    def observe_until_error(state: FitState, info: FitInfo) -> None:
        nonlocal broken
        if broken:
            return
        try:
            observe(state, info)
        except (OSError, ValueError) as error:
            broken = True
            console.print(f"warning: no more {what} from step {info.step} on: {error}", soft_wrap=True)

    return observe_until_error


class _FitColumn(ProgressColumn):
    """Step, loss, PSNR, number of Gaussians and time left of a fit."""

    def render(self, task) -> str:
        info: FitInfo | None = task.fields.get("info")
        if info is None:
            return "estimating the motion, compiling" if not task.finished else ""
        return _describe(info)


def _describe(info: FitInfo) -> str:
    left = f"{info.seconds_left:.0f} s left" if 0 < info.seconds_left < np.inf else ""
    return f"{info.step} steps  loss {info.loss:.4f}  {info.psnr:.2f} dB  {info.num_gaussians:,} Gaussians  {left}"


@contextmanager
def _bar(console: Console) -> Iterator[Observer]:
    with Progress(TextColumn("Fitting"), BarColumn(bar_width=12), _FitColumn(), console=console) as progress:
        task, is_due = progress.add_task("fit", total=1.0), _Timer(BAR_SECONDS, first=0.0)

        def observe(state: FitState, info: FitInfo) -> None:
            if is_due() or info.progress >= 1:
                progress.update(task, completed=info.progress, info=info)

        yield observe


def _lines(console: Console) -> Observer:
    """Plain lines for a log: after 10 s, every 30 s, and at the end."""
    is_due = _Timer(LINE_SECONDS, first=FIRST_LINE_SECONDS)

    def observe(state: FitState, info: FitInfo) -> None:
        if is_due() or info.progress >= 1:
            console.print(f"Fitting {info.progress:4.0%}  {_describe(info)}".rstrip(), soft_wrap=True)

    return observe


def _json_lines() -> Observer:
    is_due = _Timer(JSON_SECONDS, first=0.0)

    def observe(state: FitState, info: FitInfo) -> None:
        if is_due() or info.progress >= 1:
            print_json("progress", info_line(info))

    return observe
