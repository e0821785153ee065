"""Files that appear whole or not at all."""

import errno
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from foldgauss._runtime.checks import invalid, short_repr

#: Characters of an output's name that its temporary file bears.
KEPT = 40
#: Refusals of the system that more room cures: a full disk, a quota, a limit to the size of files.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Outputs that this process alone may write, see `_lock.only_writer`.
OWNED: set[Path] = set()


class OutputError(OSError):
    """An output path cannot be written; the message is one line and says what to do."""


def checked_path(path: object, order: str = "") -> Path:
    """`path` as a Path. Raises ValueError for what is none; `order` says how the arguments follow one another."""
    if not isinstance(path, str | os.PathLike):
        cure = f"The order is ({order})." if order else ""
        raise invalid("path", expected="a path", got=short_repr(path), cure=cure)
    return Path(path)


def _check_target(path: Path) -> None:
    """Refuse what a rename could not put in place, before any work is done."""
    if not path.name:
        raise OutputError(f"path: expected the name of a file, got {str(path)!r}. Add a file name.")
    if not os.path.exists(path.parent):
        raise OutputError(
            f"path: expected an existing folder, got {str(path.parent)!r}, which is missing. "
            "Create it first, or choose another output path."
        )
    if not path.parent.is_dir():
        raise OutputError(f"path: expected a folder, got the file {str(path.parent)!r}. Choose another path.")


def temporary_name(path: Path, suffix: str) -> Path:
    """A fresh hidden name beside `path`: the rename then stays within one file system.

    "own" instead of "tmp" in it: who holds the lock of `path` knows it for what a killed one left.
    """
    kind = "own" if path.absolute() in OWNED else "tmp"
    # The stem is cut: with a long one the random part would pass the file system's limit of 255 bytes.
    return path.with_name(f".{path.stem[:KEPT]}.{kind}-{secrets.token_hex(4)}{suffix}")


def not_writable(path: Path, error: OSError) -> OutputError:
    """The one-line form of a refusal by the operating system."""
    reason = error.strerror or str(error)
    if error.errno in _NO_ROOM:
        return OutputError(
            f"path: expected room for {str(path)!r}, got none ({reason}). Make room, or choose another output path."
        )
    return OutputError(f"path: expected a writable place, got {str(path)!r} ({reason}). Choose another output path.")


@contextmanager
def _told_where(path: Path, temporary: Path) -> Iterator[None]:
    """A disk that is full in the midst of a write: the system's error names no file, or a hidden one, and no cure."""
    try:
        yield
    except OutputError as error:  # of a file in a folder, or of what a file is made from
        raise OutputError(str(error).replace(str(temporary), str(path))) from error
    except OSError as error:
        own = error.filename is None or str(error.filename).startswith(str(temporary))
        if error.errno in _NO_ROOM and own:
            raise not_writable(path, error) from error
        raise


def _new_file(path: Path, suffix: str) -> Path:
    """Make the empty temporary file that is to become `path`."""
    _check_target(path)
    try:
        os.lstat(path)
    except FileNotFoundError:
        pass
    except OSError as error:  # a name that is too long for `path`, though not for the temporary file
        raise not_writable(path, error) from error
    # os.path, not Path: it takes any refusal (a name too long) for "no", and opening then says why.
    if os.path.exists(path) and not os.path.isfile(path):
        raise OutputError(f"path: expected a file's path, got {str(path)!r}, which is not a plain file.")
    temporary = temporary_name(path, suffix)
    try:
        # O_EXCL and mode 0o666: no clash, and the user's umask holds (mkstemp would give 0o600).
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        raise not_writable(path, error) from error
    return temporary


def check_writable(path: str | os.PathLike) -> None:
    """Find out before long work, not after it, whether `atomic_path(path)` will work. Raises `OutputError`."""
    path = Path(path)
    _new_file(path, path.suffix).unlink(missing_ok=True)  # who holds the lock may have tidied up


@contextmanager
def atomic_path(path: str | os.PathLike, *, suffix: str | None = None) -> Iterator[Path]:
    """Lend a temporary path in the folder of `path`; rename it to `path` when the block ends well.

    The temporary file exists (empty) when the block starts and keeps the extension of `path`, or `suffix`
    where given, since some writers choose the format by it. It is flushed to the disk before the rename.
    On any exception, `KeyboardInterrupt` included, it is removed and an existing `path` stays as it was.

    Raises `OutputError` if the parent folder is missing or not writable, or if `path` is not a plain file.
    """
    path = Path(path)
    temporary = _new_file(path, path.suffix if suffix is None else suffix)
    try:
        with _told_where(path, temporary):
            yield temporary
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
        try:
            os.replace(temporary, path)
        except OSError as error:
            raise not_writable(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: str | os.PathLike, *, check: Callable[[], object] = lambda: None) -> Iterator[Path]:
    """Lend a temporary folder beside `folder`; it takes that name, and the old one's place, at the end.

    The old folder is moved aside first and deleted last, so at any moment one of the two is whole.
    Whether it *may* be replaced is the caller's question: `check`, asked just before, raises where it may not; the
    work between may have taken hours.

    Raises `OutputError` if the parent folder is missing or not writable.
    """
    folder = Path(folder).resolve()
    _check_target(folder)
    temporary, aside = temporary_name(folder, ""), temporary_name(folder, "")
    try:
        temporary.mkdir()
    except OSError as error:
        raise not_writable(folder, error) from error
    try:
        with _told_where(folder, temporary):
            yield temporary
        try:
            check()
            if folder.exists():
                os.replace(folder, aside)
            os.replace(temporary, folder)
        except BaseException:  # Ctrl-C too, before, between and after the two
            if aside.exists() and not folder.exists():
                os.replace(aside, folder)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(aside, ignore_errors=True)


def check_replaceable(folder: Path, overwrite: bool, *, pattern: str, what: str = "frames") -> None:
    """Raise `OutputError` unless `folder` is missing, empty, or holds `what` alone, which `overwrite` gives up.

    Names that match `pattern` are such: what this package did not write it does not delete.
    """
    if not os.path.exists(folder):
        return
    if not folder.is_dir():
        raise OutputError(f"path: expected a folder for {what}, got the file {str(folder)!r}. Choose another name.")
    try:
        names = [entry.name for entry in folder.iterdir()]
    except OSError as error:
        raise not_writable(folder, error) from error
    foreign = [name for name in names if not re.fullmatch(pattern, name)]
    if foreign:
        raise OutputError(
            f"path: expected an empty folder or one of numbered {what}, got {str(folder)!r} with "
            f"{min(foreign)!r} in it. Choose another folder."
        )
    if names and not overwrite:
        raise OutputError(
            f"path: expected a new or empty folder, got {str(folder)!r} with {len(names)} {what}. "
            "Choose another folder, or allow overwriting."
        )
