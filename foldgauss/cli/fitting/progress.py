"""What a running fit shows and leaves behind: a bar, lines, JSON, its history, a preview. Observers, one per noun."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn

from foldgauss.io.history import HistoryFile, info_line
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.contact_sheet import make_comparison_sheet
from foldgauss.io.media.video_writing import write_image
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import FitInfo, FitState, to_model
from foldgauss.video.models.metrics import psnr
from foldgauss.video.models.renderer import VideoRenderer

Observer = Callable[[FitState, FitInfo], None]
Manner = Literal["bar", "lines", "json", "quiet"]

BAR_SECONDS = 0.1
#: In a log file a line now and then tells that a fit lives; the first one soon, since it may be misspelt.
FIRST_LINE_SECONDS, LINE_SECONDS = 10.0, 30.0
JSON_SECONDS = 1.0
PREVIEW_SECONDS = 10.0


@contextmanager
def watching(
    manner: Manner, console: Console, *, history: HistoryFile | None = None, preview: Observer | None = None
) -> Iterator[Observer]:
    """One observer that shows the fit in the given `manner` and writes its `history` and `preview`.

    Bar, lines and warnings go to `console`, JSON to standard output. None but the bar may end the fit: the first error
    of an observer that writes is told, and that one is left out from then on.
    """
    with ExitStack() as stack:
        observers = [] if history is None else [_forgiven(stack.enter_context(history), "history", console)]
        observers += [] if preview is None else [_forgiven(preview, "preview", console)]
        if manner == "bar":
            observers.append(stack.enter_context(_bar(console)))
        elif manner == "lines":
            observers.append(_lines(console))
        elif manner == "json":
            observers.append(_forgiven(_json_lines(), "progress", console))

        def observe(state: FitState, info: FitInfo) -> None:
            for one in observers:
                one(state, info)

        yield observe


def print_json(event: str, figures: dict) -> None:
    """One line of JSON on standard output, at once."""
    print(json.dumps({"event": event} | figures), flush=True)


def previewing(path: Path, clip: Clip, config: FitConfig) -> Observer:
    """Keeps original, reconstruction and error of the clip's middle frame in `path`, a PNG that is always whole.

    Written at the first step, every 10 s, and at the last step.
    """
    rings, k = _Clock(PREVIEW_SECONDS, first=0.0), clip.num_frames // 2
    original = clip.frames[k, ..., :3]  # over black, where there is alpha

    def observe(state: FitState, info: FitInfo) -> None:
        if not (rings() or info.progress >= 1):
            return
        model = to_model(state, config, clip.size, clip.fps)
        picture = VideoRenderer(model).frame(np.asarray(model.frame_times.times())[k])
        caption = f"frame {k}, step {info.step}, {psnr(original, picture):.1f} dB"
        write_image(path, make_comparison_sheet([original], [picture], [caption]))

    return observe


class _Clock:
    """Tells whether it is time again: every so many seconds, at first after `first`."""

    def __init__(self, seconds: float, first: float):
        self.seconds, self.next = seconds, time.monotonic() + first

    def __call__(self) -> bool:
        now = time.monotonic()
        if now < self.next:
            return False
        self.next = now + self.seconds
        return True


def _forgiven(observe: Observer, what: str, console: Console) -> Observer:
    """A full disk, or a model that cannot be drawn, is no reason to lose the fit: say so once, and go on without."""
    broken = False

    def forgiven(state: FitState, info: FitInfo) -> None:
        nonlocal broken
        if broken:
            return
        try:
            observe(state, info)
        except (OSError, ValueError) as error:
            broken = True
            console.print(f"warning: no more {what} from step {info.step} on: {error}", soft_wrap=True)

    return forgiven


class _FitColumn(ProgressColumn):
    """Step, loss, PSNR, Gaussians and time left of a fit."""

    def render(self, task) -> str:
        info: FitInfo | None = task.fields.get("info")
        if info is None:
            return "following the motion, compiling" if not task.finished else ""
        return _told(info)


def _told(info: FitInfo) -> str:
    left = f"{info.seconds_left:.0f} s left" if 0 < info.seconds_left < np.inf else ""
    return f"{info.step} steps  loss {info.loss:.4f}  {info.psnr:.2f} dB  {info.num_gaussians:,} Gaussians  {left}"


@contextmanager
def _bar(console: Console) -> Iterator[Observer]:
    with Progress(TextColumn("Fitting"), BarColumn(bar_width=12), _FitColumn(), console=console) as progress:
        task, rings = progress.add_task("fit", total=1.0), _Clock(BAR_SECONDS, first=0.0)

        def observe(state: FitState, info: FitInfo) -> None:
            if rings() or info.progress >= 1:
                progress.update(task, completed=info.progress, info=info)

        yield observe


def _lines(console: Console) -> Observer:
    """Plain lines for a log: after 10 s, every 30 s, and at the end."""
    rings = _Clock(LINE_SECONDS, first=FIRST_LINE_SECONDS)

    def observe(state: FitState, info: FitInfo) -> None:
        if rings() or info.progress >= 1:
            console.print(f"Fitting {info.progress:4.0%}  {_told(info)}".rstrip(), soft_wrap=True)

    return observe


def _json_lines() -> Observer:
    rings = _Clock(JSON_SECONDS, first=0.0)

    def observe(state: FitState, info: FitInfo) -> None:
        if rings() or info.progress >= 1:
            print_json("progress", info_line(info))

    return observe
