"""Lines that commands print while they work: what the library logs, and where shots begin."""

import contextlib
import logging
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from foldgauss.cli.app.application import err, out, warn
from foldgauss.video.models.frame_times import is_cut

#: So many numbers of frames are printed.
LISTED_FRAMES = 8


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
