"""What a parser promises about any file, and whether it kept its word on one."""

import resource
import signal
import tracemalloc
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random

#: Seconds after which a small file that is still being read counts as a hang; a busy machine is far from it.
TIME_LIMIT = 60.0
#: Bytes that every parser may take whatever the file: what libraries set up once, caches, messages.
CONSTANT = 8 << 20


def chance(path: Path) -> int:
    """A number that follows from what is in a file, for what a parser is told beside it."""
    return zlib.crc32(path.read_bytes()) if path.is_file() else 1


Mutation = Callable[[bytes, Random], bytes]


@dataclass(frozen=True)
class Target:
    """A parser, as a user meets it.

    `seeds`: small valid files of all its kinds. `parse`: reads a file, and uses what comes of it where that is cheap.
    `errors`: what it may raise, with a text that `says` one of these. `modules`: whose branches count, each with the
    functions in it that are no part of reading, or `ONLY` those that are. `body`: where what tells the kind of file
    ends. `memory`: bytes that a file of a size may take.
    `mutations`: those that know the format; `past_header` says how many of them, the first ones, leave the header as
    it is. `prepare`: puts into the folder what the file stands beside. `share`: of all cases, in parts.
    """

    name: str
    suffix: str
    seeds: Callable[[], list[bytes]]
    parse: Callable[[Path], object]
    errors: tuple[type[Exception], ...]
    modules: dict[str, tuple[str, ...]]
    body: Callable[[bytes], int] = lambda data: 0
    memory: Callable[[int], int] = lambda size: CONSTANT + 64 * size
    mutations: tuple[Mutation, ...] = ()
    past_header: int = 0
    prepare: Callable[[Path], None] = lambda folder: None
    share: float = 1.0
    file_name: str = "case"
    says: tuple[str, ...] = ("expected",)
    environment: tuple[tuple[str, str], ...] = ()

    def path(self, folder: Path) -> Path:
        return folder / f"{self.file_name}{self.suffix}"


class Broken(AssertionError):
    """A parser did what it must not."""


class _Hang(BaseException):
    """Time is up."""


def judge(target: Target, path: Path, *, weighed: bool = False) -> str:
    """The outcome of one file: "accepted" or the documented error. Raises `Broken` for anything else.

    `weighed`: Python's memory is measured too, which takes time; the process's is always.
    """
    size = path.stat().st_size
    bound = target.memory(size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if weighed:
        tracemalloc.start()
    try:
        outcome = _outcome(target, path)
        peak = tracemalloc.get_traced_memory()[1] if weighed else 0
    finally:
        if weighed:
            tracemalloc.stop()
    # A high-water mark: it moves for what takes more than all before, in whatever library.
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    if max(peak, grown - CONSTANT) > bound:
        raise Broken(f"memory: {max(peak, grown):,} bytes for a file of {size:,}, bound {bound:,}")
    Weighed.most = max(Weighed.most, peak / bound)
    return outcome


class Weighed:
    """The largest share of its bound that a case took."""

    most = 0.0


def _outcome(target: Target, path: Path) -> str:
    try:
        with _time_limit(), warnings.catch_warnings():
            warnings.simplefilter("error")
            target.parse(path)
    except target.errors as error:
        text = str(error)
        if not any(words in text for words in target.says) or "\n" in text or len(text) > 4000:
            raise Broken(f"an accidental {type(error).__name__}: {text[:300]!r}") from error
        return next(kind.__name__ for kind in target.errors if isinstance(error, kind))
    except _Hang:
        raise Broken(f"hang: {TIME_LIMIT:g} s were not enough") from None
    except Exception as error:
        raise Broken(f"{type(error).__name__}: {' '.join(str(error).split())[:300]}") from error
    return "accepted"


@contextmanager
def _time_limit() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise _Hang

    if not hasattr(signal, "setitimer"):  # no POSIX: the test runner's own limit stands
        yield
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
