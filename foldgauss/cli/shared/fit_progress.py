"""Observers of a running fit: a bar, lines in a log, JSON, its history, a preview."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from foldgauss.cli.app.application import warn
from foldgauss.cli.shared.console import Display, show_progress
from foldgauss.cli.shared.contact_sheet import make_comparison_sheet
from foldgauss.io.history import HistoryFile, info_line
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.writing import write_image
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import FitInfo
from foldgauss.video.fitting.state import FitState, to_model
from foldgauss.video.models.metrics import psnr
from foldgauss.video.models.renderer import VideoRenderer

Observer = Callable[[FitState, FitInfo], None]

JSON_SECONDS = 1.0
PREVIEW_SECONDS = 10.0


@contextmanager
def display_progress(
    display: Display, title: str, *, history: HistoryFile | None = None, preview: Observer | None = None
) -> Iterator[Observer]:
    """One observer that displays the fit and writes its `history` and `preview`.

    An error of an observer that writes does not end the fit: it is printed, and that observer is no longer called.
    """
    with ExitStack() as stack:
        observers = [] if history is None else [_stop_on_error(stack.enter_context(history), "history")]
        observers += [] if preview is None else [_stop_on_error(preview, "preview")]
        if display == "json":
            observers.append(_at_intervals(JSON_SECONDS, lambda _, info: print_json("progress", info_line(info))))
        show = stack.enter_context(show_progress(display))
        if display == "bar":
            show(title, 0.0, 1.0, "estimating the motion, compiling")
        observers.append(lambda state, info: show(title, info.progress, 1.0, describe_step(info)))

        def observe(state: FitState, info: FitInfo) -> None:
            for one in observers:
                one(state, info)

        yield observe


def print_json(event: str, figures: dict[str, Any]) -> None:
    """One line of JSON on standard output, at once; where that is closed, the fit goes on."""
    with suppress(OSError):
        print(json.dumps({"event": event} | figures), flush=True)


def save_previews(path: Path, clip: Clip, config: FitConfig) -> Observer:
    """Writes original, reconstruction and error of the clip's middle frame to `path`, a PNG that is always complete.

    Written at the first step, every 10 s, and at the last step.
    """
    k = clip.num_frames // 2
    original = clip.frames[k, ..., :3]  # over black

    def save(state: FitState, info: FitInfo) -> None:
        model = to_model(state, config, clip.size, clip.fps)
        image = VideoRenderer(model).frame(np.asarray(model.frame_times.times())[k])
        caption = f"frame {k}, step {info.step}, {psnr(original, image):.1f} dB"
        write_image(path, make_comparison_sheet([original], [image], [caption]))

    return _at_intervals(PREVIEW_SECONDS, save)


def _at_intervals(seconds: float, show: Observer) -> Observer:
    """An observer that calls `show` at most once in `seconds`, and at the end."""
    due = time.monotonic()

    def observe(state: FitState, info: FitInfo) -> None:
        nonlocal due
        if time.monotonic() >= due or info.progress >= 1:
            due = time.monotonic() + seconds
            show(state, info)

    return observe


def _stop_on_error(observe: Observer, what: str) -> Observer:
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
            warn(f"no more {what} from step {info.step} on: {error}")

    return observe_until_error


def describe_step(info: FitInfo) -> str:
    """Step, loss, PSNR, number of Gaussians and time left of a fit."""
    left = f"{info.seconds_left:.0f} s left" if 0 < info.seconds_left < np.inf else ""
    return f"{info.step} steps  loss {info.loss:.4f}  {info.psnr:.2f} dB  {info.num_gaussians:,} Gaussians  {left}"
