"""One at a time, whoever dies: the system gives a lock back with its process."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


class LockHeld(BlockingIOError):
    """Another holds the lock."""


@contextmanager
def hold_lock(file: Path) -> Iterator[None]:
    """Hold the lock `file`, made here and removed afterwards, until the block or the process ends, however it does.

    Raises `LockHeld` at once where another holds it, of this process too, and OSError where it cannot be made.
    """
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise LockHeld(f"{file} is held by another") from error
    try:
        yield
    finally:
        try:
            file.unlink(missing_ok=True)  # while it is held: who opened it before finds that it is another's or none's
        finally:
            lock.release()
