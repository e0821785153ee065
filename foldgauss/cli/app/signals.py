"""Ctrl-C and SIGTERM while something long is done: noted, for a place where it can be left."""

import dataclasses
import signal
from collections.abc import Iterator
from contextlib import contextmanager

from foldgauss.cli.app.application import Stopped


@dataclasses.dataclass
class Asked:
    """The signal that asked a fit to stop; and whether it had taken a step by then, which must not be cut in half."""

    name: str = ""
    stepping: bool = False


@contextmanager
def noted_signals() -> Iterator[Asked]:
    """Note SIGINT and SIGTERM, for the end of a step; before the first step they stop at once, as a second SIGINT."""
    asked, before = Asked(), {}

    def note(number, frame) -> None:
        asked.name = asked.name or signal.Signals(number).name
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if not asked.stepping:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, note)
    try:
        yield asked
    except KeyboardInterrupt as error:
        if asked.stepping:
            raise
        raise Stopped(f"stopped by {asked.name} before the first step.") from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
