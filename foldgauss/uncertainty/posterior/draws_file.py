"""The HDF5 file of draws from which an interrupted sampling run resumes: atomic updates, checksum, validation."""

import contextlib
import errno
import hashlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from foldgauss._runtime.checks import invalid, is_integer
from foldgauss._runtime.file_lock import LockHeld, hold_lock
from foldgauss.uncertainty.posterior.optional_imports import import_optional

#: Disk space that an HDF5 file needs beside its draws, since its last chunks are only partly used.
SPARE, SPARE_BYTES = 1.2, 4 << 20
#: Size of the block before the HDF5 part, and its beginning, which is followed by the SHA-256 of the rest of the file.
_BLOCK, _SEAL = 512, b"foldgauss draws, SHA-256 "


class DrawsFile:
    """An HDF5 file of all ensembles that is complete at any time: sampling writes to a copy, which then replaces it.

    The HDF5 library opens the file only if its checksum matches, since it may hang on a damaged file.
    """

    def __init__(self, path: Path, fingerprint: str, shape: tuple[int, int, int]):
        """`shape`: ensembles, walkers of each, free frames."""
        self.path = path
        self.live = _running_path(path)
        if path.exists() and read_fingerprint(path, fingerprint, shape) != fingerprint:
            cure = "Choose another file, or give the same model, video and settings."
            got = f"{self.path}, of another run"
            raise invalid("backend", expected="the file of this very run", got=got, cure=cure)
        self.check_space(path.stat().st_size if path.exists() else 0)
        with self.convert_errors():
            if path.exists():
                _copy_as_new(self.path, self.live)
            else:
                self.live.unlink(missing_ok=True)
                with import_optional("h5py").File(self.live, "x", userblock_size=_BLOCK) as file:
                    file.attrs["fingerprint"] = fingerprint

    def backend(self, n: int):
        """emcee's backend for ensemble n."""
        import emcee

        return emcee.backends.HDFBackend(str(self.live), name=f"ensemble_{n}")

    def save(self) -> None:
        """Replace the file by what has been written so far."""
        copy = self.path.with_name(f".{self.path.name}.new")
        try:
            with self.convert_errors():
                _copy_as_new(self.live, copy)
                _seal(copy)
                os.replace(copy, self.path)
        finally:
            copy.unlink(missing_ok=True)

    def close(self) -> None:
        """Discard what has not been saved."""
        self.live.unlink(missing_ok=True)

    def check_space(self, num_bytes: int) -> None:
        """Raise OSError if the disk lacks space for `num_bytes` more and a copy: HDF5 may crash on a full disk."""
        present = self.live.stat().st_size if self.live.exists() else 0
        required = SPARE * (2 * num_bytes + present) + SPARE_BYTES
        if shutil.disk_usage(self.path.parent).free < required:
            self.raise_system_error(OSError(errno.ENOSPC, f"{required / 1e6:.0f} MB are needed"))

    @contextlib.contextmanager
    def convert_errors(self) -> Iterator[None]:
        """Turn errors of the operating system into an OSError that names the file; other errors pass."""
        try:
            yield
        except (OSError, RuntimeError) as error:
            self.raise_system_error(error)
            raise

    def raise_system_error(self, error: Exception) -> None:
        """Raise an OSError if the error has a system error number, also within the long text of an HDF5 error."""
        match = re.search(r"errno = (\d+)", str(error))
        number = int(match[1]) if match else getattr(error, "errno", None)
        if number is None:
            return
        self.live.unlink(missing_ok=True)
        raise OSError(number, os.strerror(number), str(self.path)) from error


@contextlib.contextmanager
def lock_draws(backend: Path | None) -> Iterator[None]:
    """Lock the file against other runs until the block or the process ends.

    Raises BlockingIOError at once if another run, also one of this process, is writing it.
    """
    with contextlib.ExitStack() as stack:
        if backend is not None:
            try:
                stack.enter_context(hold_lock(_running_path(backend, ".lock")))
            except LockHeld as error:
                raise BlockingIOError(
                    f"backend: expected a file that no other run is writing, got {str(backend)!r}, which one is. "
                    "Wait for that one, or choose another file."
                ) from error
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(backend)) from error
        yield


def _running_path(backend: Path, ending: str = "") -> Path:
    """A hidden file beside the file of draws that exists while a run writes."""
    return backend.with_name(f".{backend.name}.running{ending}")


def _copy_as_new(source: Path, target: Path) -> None:
    """Copy into a newly created file: an existing target may be a symbolic link, which is not followed."""
    target.unlink(missing_ok=True)
    target.touch(exist_ok=False)
    shutil.copyfile(source, target)


def _seal(path: Path) -> None:
    """Write the checksum of the file's contents into its first bytes."""
    with open(path, "r+b") as file:
        file.seek(_BLOCK)
        seal = _SEAL + hashlib.file_digest(file, "sha256").hexdigest().encode()
        file.seek(0)
        file.write(seal)
        file.flush()
        os.fsync(file.fileno())


def is_sealed(path: Path) -> bool:
    """Whether the file is a file of draws whose checksum matches."""
    with open(path, "rb") as file:
        block = file.read(_BLOCK)
        return block.startswith(_SEAL + hashlib.file_digest(file, "sha256").hexdigest().encode())


def read_fingerprint(path: Path, wanted: str | None = None, shape: tuple[int, int, int] = (0, 0, 0)) -> str:
    """The fingerprint of the run in a file, which may be untrusted; if it is `wanted`, all ensembles are validated."""
    if not is_sealed(path):  # outside of `try`: a file that cannot be read is not damaged
        raise _damaged(path)
    try:
        with import_optional("h5py").File(path) as file:
            found = file.attrs.get("fingerprint", "")
            complete = isinstance(found, str)
            if complete and found == wanted:
                num, *each = shape
                complete = all(_is_valid(file, f"ensemble_{n}", *each, path.stat().st_size) for n in range(num))
    except Exception as error:  # the type depends on where the library meets the damage
        raise _damaged(path) from error
    if not complete:
        raise _damaged(path)
    return found


def _damaged(path: Path) -> ValueError:
    cure = "Remove it, or choose another."
    return invalid("backend", expected="a file of draws, or none yet", got=f"{path}, damaged", cure=cure)


def _is_valid(file, name: str, walkers: int, free: int, size: int) -> bool:
    """Whether an ensemble is as emcee writes it, within this file of `size` bytes, and can be read with as many."""
    h5py = import_optional("h5py")
    links = [name, *(f"{name}/{part}" for part in ("chain", "log_prob", "accepted"))]
    if not all(isinstance(file.get(link, getlink=True), h5py.HardLink) for link in links):
        return False
    group, *parts = (file[link] for link in links)
    done, rows = group.attrs["iteration"], parts[0].shape[0]
    shapes = (rows, walkers, free), (rows, walkers), (walkers,)
    for part, want in zip(parts, shapes, strict=True):
        plain = part.dtype == np.float64 and part.external is None and not part.is_virtual and part.compression is None
        if not (plain and part.shape == want and part.id.get_storage_size() <= size):
            return False
    sizes = [group.attrs[name] for name in ("nwalkers", "ndim")]
    integers = (
        is_integer(done, 0) and all(is_integer(size, 0) for size in sizes) and np.shape(group.attrs["has_blobs"]) == ()
    )
    if not integers or done > rows or sizes != [walkers, free] or bool(group.attrs["has_blobs"]):
        return False
    needs = 8 * int(done) * walkers * free, 8 * int(done) * walkers
    if any(part.id.get_storage_size() < need for part, need in zip(parts[:2], needs, strict=True)):
        return False
    return done == 0 or (bool(np.isfinite(parts[0][done - 1]).all()) and _is_random_state(group.attrs))


def _is_random_state(attributes) -> bool:
    """Whether NumPy can be given this state: it does not check the position within the keys."""
    kind, keys, position, has_gauss, gauss = (attributes[f"random_state_{k}"] for k in range(5))
    integers = is_integer(position, 0) and position <= 624 and is_integer(has_gauss, 0) and has_gauss <= 1
    return (
        integers
        and isinstance(gauss, float)
        and np.isfinite(gauss)
        and isinstance(kind, str)
        and (kind, keys.shape, keys.dtype) == ("MT19937", (624,), np.uint32)
    )
