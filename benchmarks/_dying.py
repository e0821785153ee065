"""The command, in a process that ends itself with SIGKILL at a chosen moment of writing a file.

    python -m benchmarks._dying '{"ending": ".checkpoint", "number": 3, "moment": "bytes", "count": 4711}' fit ...

Of the files written in hidden names beside their place (`foldgauss.io._atomic`), those whose place ends in `ending`
count; in the writing of the `number`-th (from 1) the process dies: `bytes` once `count` of them are with the system,
`written` before they are flushed to the disk, `flushed` before the file gets its name, `named` right after that.
`every`: seconds between two checkpoints of a fit, instead of its own 30. With the moment `never` it lives, and at its
end tells how many such files it wrote, and the bytes of the smallest (`files 17 4711`, on standard error).
"""

import builtins
import io
import json
import os
import re
import signal
import sys

#: Names of files that are being written.
HIDDEN = re.compile(r"\..*\.(tmp|own)-[0-9a-f]{8}(\.\w+)?")


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


class _Raw(io.FileIO):
    """A file whose process dies in the midst of a write."""

    def __init__(self, path: str, mode: str, left: int):
        super().__init__(path, mode)
        self.left = left

    def write(self, data) -> int:
        view = memoryview(data).cast("B")
        if len(view) >= self.left:
            super().write(view[: self.left])
            die()
        self.left -= len(view)
        return super().write(view)


class Plan:
    """Counts the files of one ending and strikes at the moment asked for."""

    def __init__(self, ending: str, moment: str = "never", number: int = 1, count: int = 1, every: float | None = None):
        self.ending, self.moment, self.number, self.count, self.every = ending, moment, number, count, every
        self.begun, self.sizes = 0, []  # files that were begun, and bytes of those that have got their names
        self.path = None  # the hidden file that counts now
        self._open, self._fsync, self._replace = builtins.open, os.fsync, os.replace

    def arm(self) -> None:
        builtins.open = io.open = self.open
        os.fsync, os.replace = self.fsync, self.replace

    def _is_hidden(self, path) -> bool:
        if not isinstance(path, str | os.PathLike):
            return False
        folder, name = os.path.split(os.fspath(path))
        hidden = HIDDEN.fullmatch(name) or HIDDEN.fullmatch(os.path.basename(folder))  # a file, or one of a folder
        return hidden is not None and name.endswith(self.ending)

    def _due(self) -> bool:
        return self.begun == self.number

    def open(self, file, mode="r", *arguments, **options):
        if "w" not in mode or not self._is_hidden(file):
            return self._open(file, mode, *arguments, **options)
        if os.fspath(file) != self.path:
            self.path = os.fspath(file)
            self.begun += 1
        if self.moment != "bytes" or not self._due():
            return self._open(file, mode, *arguments, **options)
        raw = _Raw(os.fspath(file), "w+" if "+" in mode else "w", self.count)
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, options.get("encoding"))

    def fsync(self, file) -> None:
        own = self._is_ours(file)
        if own and self.moment == "written" and self._due():
            die()
        self._fsync(file)
        if own and self.moment == "flushed" and self._due():
            die()

    def _is_ours(self, file) -> bool:
        """Whether an open file is the hidden one that counts, or a new one that was not written by Python (a video)."""
        number = file if isinstance(file, int) else file.fileno()
        path = os.readlink(f"/proc/self/fd/{number}")
        if self._is_hidden(path) and os.path.realpath(path) != os.path.realpath(self.path or ""):
            self.path = path
            self.begun += 1
        return self._is_hidden(path)

    def replace(self, source, target, **options) -> None:
        own = self._is_hidden(source)
        self._replace(source, target, **options)
        if own:
            self.sizes.append(os.path.getsize(target))
        if own and self.moment == "named" and self._due():
            die()


def main(arguments: list[str]) -> None:
    plan = Plan(**json.loads(arguments[0]))
    from foldgauss import cli
    from foldgauss.jobs import runner

    if plan.every is not None:
        runner.CHECKPOINT_SECONDS = plan.every
    plan.arm()
    try:
        cli.main(arguments[1:])
    finally:
        if plan.moment == "never":
            print(f"files {len(plan.sizes)} {min(plan.sizes, default=0)}", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
