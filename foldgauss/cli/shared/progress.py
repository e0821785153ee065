"""The display of progress: a bar on a terminal, lines now and then in a log, JSON, or nothing."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from foldgauss._runtime.checks import ParameterError
from foldgauss.cli.app.application import err

Display = Literal["bar", "lines", "json", "quiet"]

#: Seconds before the first line of a log, which is early since options may be mistyped.
FIRST_LINE_SECONDS = 10.0
#: Seconds between two lines of a log.
LINE_SECONDS = 30.0


def choose_display(quiet: bool = False, log_json: bool = False) -> Display:
    """How progress is displayed: as the options say, otherwise a bar on a terminal and lines in a log."""
    if quiet and log_json:
        raise ParameterError("--quiet", "expected one of --quiet and --log-json, got both. Leave one out.")
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
