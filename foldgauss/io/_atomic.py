"""Atomic writes: files and folders that appear whole or not at all, and locks on outputs."""

import errno
import hashlib
import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from foldgauss._runtime.checks import ParameterError, invalid, require, short_repr

PathLike = str | os.PathLike
Result = TypeVar("Result")
#: Characters of an output's name that the name of its temporary file repeats.
KEPT = 40
#: Errors that free space cures: a full disk, a quota, a limit on the size of files.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class MissingInput(ParameterError, FileNotFoundError):
    """An input does not exist."""


class OutputError(OSError):
    """An output path cannot be written; the one-line message says how to correct it."""


class OutputRefused(OutputError):
    """An existing output must not be replaced; found before any work is done."""


def check_path(path: object, order: str = "") -> Path:
    """`path` as a Path. Raises ValueError for another type, with `order`, the order of the arguments, as a hint."""
    require(
        isinstance(path, PathLike),
        "path",
        expected="a path",
        got=short_repr(path),
        cure=f"The order is ({order})." if order else "",
    )
    return Path(path)


def missing_error(path: PathLike, expected: str) -> MissingInput:
    """The error for an input that does not exist."""
    got, cure = f"{str(path)!r}, {describe_missing(path)}", "Check the spelling and the current folder."
    if address := re.fullmatch("([A-Za-z][A-Za-z0-9+.-]+):/+(.*)", str(path)):  # of whose slashes Path keeps one
        got, cure = f"the address {'://'.join(address.groups())!r}", "Download it first."
    return invalid("path", expected=expected, got=got, cure=cure, kind=MissingInput)


def describe_missing(path: PathLike) -> str:
    """Why a path does not exist for this process, as "which is missing"."""
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return "which is missing"
    except OSError as error:  # in a folder without permission, a link to itself, a name that is too long
        return f"which cannot be reached ({error.strerror})"
    return "which is missing"  # it has come meanwhile


def check_input(path: Path, expected: str, kind: type[ParameterError] = ParameterError) -> None:
    """Raise MissingInput for an input that is missing, `kind` for a pipe or a device: opening may not end."""
    if not os.path.exists(path):
        raise missing_error(path, expected)
    require(
        os.path.isfile(path) or os.path.isdir(path),
        "path",
        expected=expected,
        got=f"{str(path)!r}, a pipe or a device",
        cure="Save its output to a file.",
        kind=kind,
    )


def resolve(path: PathLike) -> Path:
    """The absolute path without symbolic links; unlike Path.resolve() also of a link to itself."""
    return Path(os.path.realpath(path))


def _check_target(path: Path) -> None:
    """Make the folder of `path`, and raise where a rename to it would fail, before any work is done."""
    if not path.name:
        raise OutputError(f"path: expected the name of a file, got {str(path)!r}. Add a file name.")
    if os.path.exists(path.parent) and not path.parent.is_dir():
        raise OutputError(f"path: expected a folder, got the file {str(path.parent)!r}. Choose another path.")
    with translate_output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with translate_output_errors(path), suppress(FileNotFoundError):
        os.lstat(path)  # raises for a name that is too long for `path`, though not for the temporary file


def temporary_name(path: Path, suffix: str) -> Path:
    """A new hidden name beside `path`, so that the rename stays within one file system.

    It contains "own" instead of "tmp" where this process holds the lock of `path`: the next holder may then remove it
    as a remnant of a killed process.
    """
    kind = "own" if path.absolute() in _LOCKED else "tmp"
    # The stem is shortened: file systems limit names to 255 bytes.
    return path.with_name(f".{path.stem[:KEPT]}.{kind}-{secrets.token_hex(4)}{suffix}")


def output_error(path: Path, error: OSError) -> OutputError:
    """The one-line form of an OSError on writing `path`."""
    reason = error.strerror or str(error)
    if error.errno in _NO_ROOM:
        return OutputError(
            f"path: expected free space for {str(path)!r}, got none ({reason}). Free some, or choose another path."
        )
    return OutputError(f"path: expected a writable path, got {str(path)!r} ({reason}). Choose another output path.")


@contextmanager
def translate_output_errors(path: Path) -> Iterator[None]:
    """Raise an OSError of writing `path` in its one-line form."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        raise output_error(path, error) from error


@contextmanager
def _name_output(path: Path, temporary: Path) -> Iterator[None]:
    """Make errors during a write name `path`: those of a full disk name no file, or the temporary one."""
    try:
        yield
    except OutputError as error:  # of a file in a folder, or of an input
        raise OutputError(str(error).replace(str(temporary), str(path))) from error
    except OSError as error:
        ours = error.filename is None or str(error.filename).startswith(str(temporary))
        if error.errno in _NO_ROOM and ours:
            raise output_error(path, error) from error
        raise


def _new_file(path: Path) -> Path:
    """Create the empty temporary file that is to become `path`."""
    _check_target(path)
    # os.path, not Path: it returns False for any OSError, and opening then reports the reason.
    if os.path.exists(path) and not os.path.isfile(path):
        raise OutputError(f"path: expected a file's path, got {str(path)!r}, which is not a regular file.")
    temporary = temporary_name(path, path.suffix)
    with translate_output_errors(path):
        # O_EXCL and mode 0o666: no clash, and the user's umask holds (mkstemp would give 0o600).
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    return temporary


def check_writable(path: PathLike) -> None:
    """Check before long work whether `atomic_path(path)` will succeed; makes its folder. Raises `OutputError`."""
    _new_file(Path(path)).unlink(missing_ok=True)  # the holder of the lock may have removed it


@contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """Provide a temporary path in the folder of `path`, and rename it to `path` when the block ends without an error.

    The temporary file exists (empty) when the block starts and keeps the extension of `path`, since some writers choose
    the format by it. It is flushed to disk before the rename.
    On any exception, including `KeyboardInterrupt`, it is removed and an existing `path` stays unchanged.

    Missing folders are made. Raises `OutputError` if the folder is not writable, or if `path` is not a regular file.
    """
    path = Path(path)
    temporary = _new_file(path)
    try:
        with _name_output(path, temporary):
            yield temporary
            with open(temporary, "rb") as file:
                os.fsync(file.fileno())
        with translate_output_errors(path):
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_or_keep(path: Path, write: Callable[[Path], Result]) -> Result:
    """Write the result of a long computation by `write(path)`; if that fails, to the folder for temporary files.

    Returns what `write` does.

    Raises `OutputError`, which says where the result is, if it is in the folder for temporary files; and
    `OutputRefused` as `write(path)`.
    """
    try:
        return write(path)
    except OutputRefused:
        raise
    except OSError as error:
        failure = error
    folder, name = None, Path(os.path.abspath(path)).name  # "..", too, has a name of its own
    try:
        folder = Path(tempfile.mkdtemp(prefix="foldgauss-"))
        write(folder / name)
    except BaseException as error:  # Ctrl-C, too, leaves nothing half-written
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        if not isinstance(error, OSError):
            raise
        raise OutputError(f"{failure} In the folder for temporary files, too: the result is lost.") from failure
    raise OutputError(f"{failure} It is kept in {folder / name}: move it to a place of yours.") from failure


@contextmanager
def atomic_folder(folder: PathLike, overwrite: bool = False, *, pattern: str, what: str = "frames") -> Iterator[Path]:
    """Provide a temporary folder beside `folder`, and rename it to `folder` when the block ends without an error.

    An existing folder is moved aside first and deleted last, so at any moment one of the two is whole. It is refused,
    before the block and again after it, since that may have taken hours, unless it is empty, or contains only `what`
    and `overwrite` is given. `pattern` matches the names of `what`; other files are never deleted.

    Missing parents are made. Raises `OutputError` if the folder is refused, or its parent is not writable.
    """
    given, folder = Path(folder), resolve(folder)
    check_replaceable(given, overwrite, pattern=pattern, what=what)
    _check_target(folder)
    temporary, aside = temporary_name(folder, ""), temporary_name(folder, "")
    with translate_output_errors(folder):
        temporary.mkdir()
    try:
        with _name_output(folder, temporary):
            yield temporary
        try:
            try:
                check_replaceable(given, overwrite, pattern=pattern, what=what)
            except OutputRefused as refusal:  # of what has come meanwhile
                raise OutputError(str(refusal)) from refusal
            if folder.exists():
                os.replace(folder, aside)
            os.replace(temporary, folder)
        except BaseException:  # Ctrl-C, too, between the two
            if aside.exists() and not folder.exists():
                os.replace(aside, folder)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(aside, ignore_errors=True)


def check_replaceable(folder: Path, overwrite: bool, *, pattern: str, what: str = "frames") -> None:
    """Raise `OutputRefused` unless `atomic_folder` may replace `folder`."""
    if not os.path.exists(folder):
        return
    if not folder.is_dir():
        raise OutputRefused(f"path: expected a folder for {what}, got the file {str(folder)!r}. Choose another name.")
    with translate_output_errors(folder):
        names = [entry.name for entry in folder.iterdir()]
    foreign = [name for name in names if not re.fullmatch(pattern, name)]
    if foreign:
        raise OutputRefused(
            f"path: expected an empty folder or one of numbered {what}, got {str(folder)!r} with "
            f"{min(foreign)!r} in it. Choose another folder."
        )
    if names and not overwrite:
        raise OutputRefused(
            f"path: expected a new or empty folder, got {str(folder)!r} with {len(names)} {what}. "
            "Choose another folder, or overwrite it."
        )


STALE_AGE = 3600.0
#: Outputs that this process has locked, see `lock_output`.
_LOCKED: set[Path] = set()


@contextmanager
def lock_output(path: Path, *, own: tuple[Path, ...] = (), what: str = "fit", wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of `path` until the block or the process ends.

    `own`: files that only the holder of the lock writes. Their temporary files, left by a killed process, are removed,
    and so are those of `path` written under the lock; others of `path` once they are an hour old. `what` names the
    holder in messages. Raises `OutputError` where another process holds the lock for `wait` seconds, or one of the
    files cannot be written.
    """
    for target in (path, *own):
        check_writable(target)  # the lock would create a missing folder
    name = path.name
    if len(name.encode()) > 240:  # a file name has at most 255 bytes, including '.' and '.lock'
        name = hashlib.sha256(name.encode()).hexdigest()[:32]
    file = path.with_name(f".{name}.lock")
    lock = FileLock(file, timeout=wait)
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
            _remove_unfinished(target, "tmp", 0.0)
        _remove_unfinished(path, "own", 0.0)
        _remove_unfinished(path, "tmp", STALE_AGE)
        _LOCKED.add(path.absolute())
        yield
    finally:
        _LOCKED.discard(path.absolute())
        try:
            file.unlink(missing_ok=True)  # while held, so that no other process's file is removed
        finally:
            lock.release()


def _remove_unfinished(path: Path, kind: str, age: float) -> None:
    """Remove temporary files of `path`, see `temporary_name`, of this `kind` that are at least `age` seconds old.

    Where the names contain a part of its stem, they may belong to another output: only stale ones are removed.
    """
    age = age if len(path.stem) <= KEPT else STALE_AGE
    name = re.compile(rf"\.{re.escape(path.stem[:KEPT])}\.{kind}-[0-9a-f]{{8}}{re.escape(path.suffix)}")
    for found in path.parent.iterdir():
        with suppress(OSError):  # removed by another process, of another user, or a folder
            if name.fullmatch(found.name) and time.time() - found.stat().st_mtime >= age:
                found.unlink()
