"""Signal handling: Ctrl-C while modules are imported, and SIGTERM while a command runs."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

#: Seconds within which a second SIGTERM counts as the first: `timeout` signals the process, then its process group.
REPEAT_SECONDS = 5.0
#: Exit status of a process that SIGTERM ended, as shells report it.
TERMINATED = 128 + signal.SIGTERM


class SigtermReceived(KeyboardInterrupt):
    """SIGTERM, raised so that the same cleanup runs as after Ctrl-C."""


class _SigtermHandler:
    """The first SIGTERM raises `SigtermReceived`; a later one ends the process at once."""

    def __init__(self) -> None:
        self.first: float | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.first is None:
            self.first = now
            raise SigtermReceived("ended by SIGTERM")
        if now - self.first > REPEAT_SECONDS:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)


@contextmanager
def raise_on_sigterm() -> Iterator[None]:
    """Inside the block SIGTERM raises `SigtermReceived`, unless it has a handler; the process then exits with 143.

    The default handler would leave unfinished files behind.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    handler = _SigtermHandler()
    signal.signal(signal.SIGTERM, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if handler.first is not None:  # whatever became of the exception
            raise SystemExit(TERMINATED)


@contextmanager
def use_default_signals() -> Iterator[None]:
    """Inside the block Ctrl-C and SIGTERM end the process by default, unless they have other handlers.

    For imports: native libraries may crash at a KeyboardInterrupt or swallow it, and no file is open yet.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ours = {
        number: handler
        for number, handler in handlers.items()
        if handler is signal.default_int_handler or isinstance(handler, _SigtermHandler)
    }
    for number in ours:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
