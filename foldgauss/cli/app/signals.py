"""SIGINT and SIGTERM during long work: noted, so that it stops between two steps."""

import dataclasses
import signal
from collections.abc import Iterator
from contextlib import contextmanager

from foldgauss.cli.app.application import Stopped


@dataclasses.dataclass
class StopRequest:
    """The name of the signal that asked to stop, and whether a step is done: later steps must not be interrupted."""

    signal: str = ""
    stepping: bool = False


@contextmanager
def note_signals() -> Iterator[StopRequest]:
    """Note SIGINT and SIGTERM, for the end of a step; before the first step, or a second time, they stop at once."""
    request, before = StopRequest(), {}

    def note(number, frame) -> None:
        request.signal = request.signal or signal.Signals(number).name
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if not request.stepping:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, note)
    try:
        yield request
    except KeyboardInterrupt as error:
        if request.stepping:
            raise
        raise Stopped(f"stopped by {request.signal} before the first step.") from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
