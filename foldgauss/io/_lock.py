"""A lock on an output, held by one process at a time, and the removal of temporary files of killed ones."""

import hashlib
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from foldgauss.io._atomic import KEPT, OutputError, check_writable, translate_output_errors

STALE_AGE = 3600.0


@contextmanager
def lock_output(path: Path, *, own: tuple[Path, ...] = (), what: str = "fit") -> Iterator[None]:
    """Hold the lock of `path` until the block or the process ends.

    `own`: files that only the holder of the lock writes. Their temporary files, left by a killed process, are removed,
    and those of `path` once they are an hour old. `what` names the holder in messages. Raises `OutputError` at once
    where another process holds the lock, or one of the files cannot be written.
    """
    for target in (path, *own):
        check_writable(target)  # the lock would create a missing folder
    name = path.name
    if len(name.encode()) > 240:  # a file name has at most 255 bytes, including '.' and '.lock'
        name = hashlib.sha256(name.encode()).hexdigest()[:32]
    file = path.with_name(f".{name}.lock")
    lock = FileLock(file, timeout=0)
    with translate_output_errors(path):
        try:
            lock.acquire()
        except Timeout as error:
            raise OutputError(
                f"path: expected an output that no other process is writing, got {str(path)!r}, which another "
                f"{what} is writing. Wait for it to end, or choose another name."
            ) from error
    try:
        for target in own:
            _remove_unfinished(target, 0.0)
        _remove_unfinished(path, STALE_AGE)
        yield
    finally:
        try:
            file.unlink(missing_ok=True)  # while held, so that no other process's file is removed
        finally:
            lock.release()


def _remove_unfinished(path: Path, age: float) -> None:
    """Remove temporary files of `path`, see `temporary_name`, that are at least `age` seconds old.

    Where the names contain a part of its stem, they may belong to another output: only stale ones are removed.
    """
    age = age if len(path.stem) <= KEPT else STALE_AGE
    name = re.compile(rf"\.{re.escape(path.stem[:KEPT])}\.tmp-[0-9a-f]{{8}}{re.escape(path.suffix)}")
    for found in path.parent.iterdir():
        with suppress(OSError):  # removed by another process, of another user, or a folder
            if name.fullmatch(found.name) and time.time() - found.stat().st_mtime >= age:
                found.unlink()
