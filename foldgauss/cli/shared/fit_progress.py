"""Observers of a running fit: a bar, lines in a log, JSON, its history."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import numpy as np

from foldgauss.cli.app.application import warn
from foldgauss.cli.shared.console import Display, show_progress
from foldgauss.io.history import HistoryFile, info_line
from foldgauss.video.fitting.loop import FitInfo
from foldgauss.video.fitting.state import FitState

Observer = Callable[[FitState, FitInfo], None]

JSON_SECONDS = 1.0


@contextmanager
def display_progress(display: Display, title: str, *, history: HistoryFile | None = None) -> Iterator[Observer]:
    """One observer that displays the fit and writes its `history`.

    An error of an observer that writes does not end the fit: it is printed, and that observer is no longer called.
    """
    with ExitStack() as stack:
        observers = [] if history is None else [_stop_on_error(stack.enter_context(history), "history")]
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
