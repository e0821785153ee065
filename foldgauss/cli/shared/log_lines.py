"""Lines that commands print while they work: what the library logs, and where shots begin."""

import contextlib
import logging
from collections.abc import Iterator

from foldgauss.cli.app.application import err, out, warn

#: So many starts of shots are printed.
LISTED_STARTS = 8


class _Printer(logging.Handler):
    """Prints the message of each record on one line, as a warning if it is one."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING:
            warn(record.getMessage())
        else:
            out.print(record.getMessage(), soft_wrap=True)


@contextlib.contextmanager
def print_log() -> Iterator[None]:
    """Print what the package logs at level INFO or above."""
    logger, handler = logging.getLogger("foldgauss"), _Printer()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def print_shots(starts: tuple[int, ...]) -> None:
    """Print where shots begin if there are several."""
    if len(starts) > 1:
        listed = ", ".join(map(str, starts[:LISTED_STARTS])) + (", ..." if len(starts) > LISTED_STARTS else "")
        err.print(f"{len(starts)} shots, each on its own; they begin at frames {listed}.")
