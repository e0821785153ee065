"""A lock file that only one process holds; the system releases it when the process ends."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


class LockHeld(BlockingIOError):
    """The lock is held already."""


@contextmanager
def hold_lock(file: Path) -> Iterator[None]:
    """Hold the lock `file`, created here and removed afterwards, until the block or the process ends.

    Raises `LockHeld` at once if it is held, by this process too, and OSError if it cannot be created.
    """
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise LockHeld(f"{file} is held elsewhere") from error
    try:
        yield
    finally:
        try:
            file.unlink(missing_ok=True)  # while held, so that no other process's file is removed
        finally:
            lock.release()
