"""One writer at a time: of a long work's output, and of what it keeps on the way."""

import hashlib
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from foldgauss._runtime.file_lock import LockHeld, hold_lock
from foldgauss.io._atomic import KEPT, OWNED, OutputError, check_writable, not_writable

#: Seconds after which an unfinished file beside an output is one that a killed process left.
LEFT = 3600.0


@contextmanager
def only_writer(path: Path, *, own: tuple[Path, ...] = (), what: str = "fit") -> Iterator[None]:
    """Keep others that ask likewise from writing `path`, until the block or the process ends, however it does.

    `what`: what a holder is called, in the message to others.

    `own`: files that nobody writes but who holds the lock. Unfinished ones of theirs, left by a kill, are removed, and
    so are those of `path` that a holder left; others of `path` once they are an hour old. Raises `OutputError` at once
    where another holds the lock, or one of the files cannot be written.
    """
    for target in (path, *own):
        check_writable(target)  # the lock would make a folder that is missing
    file = path.with_name(f".{_short(path.name)}.lock")
    with ExitStack() as stack:
        try:
            stack.enter_context(hold_lock(file))
        except LockHeld as error:
            raise OutputError(
                f"path: expected an output that nobody else is writing, got {str(path)!r}, which another {what} is. "
                "Wait for that one, or choose another name."
            ) from error
        except OSError as error:
            raise not_writable(path, error) from error
        for target in own:
            _remove_unfinished(target, "tmp", 0.0 if _is_told_whole(target) else LEFT)
        _remove_unfinished(path, "own", 0.0 if _is_told_whole(path) else LEFT)
        _remove_unfinished(path, "tmp", LEFT)
        stack.callback(OWNED.discard, path.absolute())
        OWNED.add(path.absolute())
        yield


def _remove_unfinished(path: Path, kind: str, age: float) -> None:
    """What `atomic_path(path)` left in a process that was killed, see `temporary_name`."""
    name = re.compile(rf"\.{re.escape(path.stem[:KEPT])}\.{kind}-[0-9a-f]{{8}}{re.escape(path.suffix)}")
    for found in path.parent.iterdir():
        with suppress(OSError):  # another was faster, or it is of another user, or a folder: no reason not to work
            if name.fullmatch(found.name) and time.time() - found.stat().st_mtime >= age:
                found.unlink()


def _is_told_whole(path: Path) -> bool:
    """Whether its unfinished files bear all of its name, and so are no other's."""
    return len(path.stem) <= KEPT


def _short(name: str) -> str:
    """A name that leaves room for more within the 255 bytes that file systems have."""
    return name if len(name.encode()) <= 240 else hashlib.sha256(name.encode()).hexdigest()[:32]
