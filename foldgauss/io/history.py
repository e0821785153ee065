"""The history of a fit: a file with one line of JSON per step, and its curves as a PNG."""

import json
import math
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from foldgauss._runtime.checks import invalid, is_integer, require
from foldgauss.analysis.plot import plot_history
from foldgauss.io._atomic import PathLike, atomic_path, translate_output_errors
from foldgauss.io.figures import write_figure
from foldgauss.video.fitting.loop import FitInfo, FitState

#: Values that null stands for, since JSON has no NaN or infinity.
_NULL = {"loss": math.nan, "psnr": math.nan, "seconds_left": math.inf}
_DIGITS = 7  # the precision of float32
_START = '{"step":'


class HistoryFile:
    """Appends one line per step to `path` and flushes it, so that it can be followed and survives a killed fit.

    An observer of a fit, and a context manager. Each line is `info_line` of the step. An existing file is replaced at
    the first step. With `resumed_at`, the step of the checkpoint that a fit continues from, and its running `psnr`,
    later lines are removed (the fit repeats those steps), and so is an incomplete last line.

    Raises `OutputError` where the file cannot be written, ValueError where `resumed_at` is given and the file is not
    the history of that fit.

    Example: `with HistoryFile("fit.jsonl") as history: fit(frames, observers=[history])`.
    """

    def __init__(self, path: PathLike, resumed_at: int | None = None, psnr: float | None = None):
        self.path, self._file, self._last, self._append = Path(path), None, 0, False
        if resumed_at is not None and self.path.exists():
            self._append, kept = True, [info_line(one) for one in read_history(self.path) if one.step <= resumed_at]
            self._last = kept[-1]["step"] if kept else 0
            same = psnr is None or (kept and kept[-1]["psnr"] == _to_json(psnr))
            require(
                self._last == resumed_at and same,
                "history",
                expected=f"that of the fit which is resumed at step {resumed_at}",
                got=f"{str(self.path)!r} of another, or with that step missing",
                cure="Give a new name, or the file that the fit wrote before.",
            )
            with atomic_path(self.path) as temporary:
                temporary.write_text("".join(json.dumps(line) + "\n" for line in kept))

    def __call__(self, state: FitState, info: FitInfo) -> None:
        if info.step <= self._last:
            return  # a finished checkpoint reports its last step again
        self._last = info.step
        with translate_output_errors(self.path):
            self._file = self._file or self.path.open("a" if self._append else "w", encoding="utf-8")
            self._file.write(json.dumps(info_line(info)) + "\n")
            self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            with suppress(OSError):  # a full disk, reported when the line was written
                self._file.close()


def info_line(info: FitInfo) -> dict[str, Any]:
    """The fields of `FitInfo` as JSON types: numbers to 7 digits, null for NaN and infinities."""
    return {name: _to_json(value) for name, value in info._asdict().items()}


def read_history(path: PathLike) -> list[FitInfo]:
    """The steps of a history file, which may belong to a running fit: its last line may be incomplete.

    Raises ValueError for another file.
    """
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    found = [_parse_line(line) for line in text.split("\n")[:-1]]
    if None in found or not _START.startswith(text[: len(_START)]):
        broken = found.index(None) + 1 if None in found else 1
        raise invalid(
            "history",
            expected="one JSON object with a step per line",
            got=f"something else in line {broken} of {str(path)!r}",
            cure="Choose another path, or remove the file.",
        )
    return found


def write_curves(path: PathLike, history: Iterable[FitInfo]) -> Path:
    """`plot_history` as a PNG, whole or not at all. Raises ImportError without matplotlib (`foldgauss[plot]`)."""

    def draw(figure: Any) -> None:
        plot_history(list(history), figure.subplots(2, 2, sharex="col", sharey="row"))

    return write_figure(path, draw, (10, 6))


def _to_json(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None


def _parse_line(text: str) -> FitInfo | None:
    """One line, or None where it is invalid."""
    try:
        info = FitInfo(**json.loads(text))
    except (ValueError, TypeError, RecursionError):
        return None
    info = info._replace(**{name: value for name, value in _NULL.items() if getattr(info, name) is None})
    *numbers, stopped_by = info
    valid = is_integer(info.step, 0) and all(isinstance(value, int | float) for value in numbers)
    return info if valid and isinstance(stopped_by, str | None) else None
