"""What a parser promises about any file, and whether it kept its word on one."""

import contextlib
import resource
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from .mutate import Mutation, by_chance, spliced

#: Bytes that every parser may take whatever the file: what libraries set up once, caches, messages.
CONSTANT = 8 << 20


def chance(path: Path) -> int:
    """A number that follows from the content of a file: it decides what a parser is asked for beside it."""
    return zlib.crc32(path.read_bytes()) if path.is_file() else 1


@dataclass(frozen=True)
class Target:
    """A parser, as a user meets it.

    `seeds`: small valid files of all its kinds. `parse`: reads a file, and uses the result where that is cheap.
    `errors`: what it may raise, with a text that `says` one of these. `mutations`: those that know the format.
    `body`: where the header ends. `memory`: bytes that a file of a size may take. `prepare`: puts into the folder what
    the file stands beside.
    """

    name: str
    suffix: str
    seeds: Callable[[], list[bytes]]
    parse: Callable[[Path], object]
    errors: tuple[type[Exception], ...]
    mutations: tuple[Mutation, ...]
    body: Callable[[bytes], int] = lambda data: 0
    memory: Callable[[int], int] = lambda size: 2 * CONSTANT + 400 * size
    prepare: Callable[[Path], None] = lambda folder: None
    says: tuple[str, ...] = ("expected",)

    def path(self, folder: Path) -> Path:
        return folder / f"case{self.suffix}"

    def mutant(self, random: Random, corpus: list[bytes]) -> bytes:
        """A bad file: half by a mutation that knows the format, half by chance, most of these behind the header."""
        data, other, how = random.choice(corpus), random.choice(corpus), random.random()
        if how < 0.5:
            with contextlib.suppress(Exception):  # where an earlier mutation has left nothing of the format
                return random.choice(self.mutations)(data, random)
        start = self.body(data) if how < 0.85 else 0
        if how < 0.58:
            return data[:start] + spliced(data[start:], other[start:], random)
        return by_chance(data, random, start)


class Broken(AssertionError):
    """A parser did what it must not."""


def judge(target: Target, path: Path, *, traced: bool = False) -> str:
    """The outcome of one file: "accepted" or the documented error. Raises `Broken` for anything else.

    `traced`: the memory that Python allocates is measured too, which takes time; that of the process always is.
    """
    size = path.stat().st_size
    bound = target.memory(size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if traced:
        tracemalloc.start()
    try:
        outcome = _outcome(target, path)
        peak = tracemalloc.get_traced_memory()[1] if traced else 0
    finally:
        tracemalloc.stop()
    # A high-water mark: it moves for what takes more than all before, in whatever library.
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    if max(peak, grown - CONSTANT) > bound:
        raise Broken(f"memory: {max(peak, grown):,} bytes for a file of {size:,}, bound {bound:,}")
    return outcome


def _outcome(target: Target, path: Path) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            target.parse(path)
    except target.errors as error:
        text = str(error)
        if not any(words in text for words in target.says) or "\n" in text or len(text) > 4000:
            raise Broken(f"an accidental {type(error).__name__}: {text[:300]!r}") from error
        return next(kind.__name__ for kind in target.errors if isinstance(error, kind))
    except Exception as error:
        raise Broken(f"{type(error).__name__}: {' '.join(str(error).split())[:300]}") from error
    return "accepted"
