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
            self._append, kept = True, [line for line in _read_lines(self.path) if line["step"] <= resumed_at]
            self._last = kept[-1]["step"] if kept else 0
            same = psnr is None or (kept and kept[-1].get("psnr") == _to_json(psnr))
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
    """The steps of a history file, which may belong to a running fit. Raises ValueError for another file."""
    lines = [{name: value for name, value in line.items() if value is not None} for line in _read_lines(Path(path))]
    return [FitInfo(*(line.get(name, _NULL.get(name)) for name in FitInfo._fields)) for line in lines]


def write_curves(path: PathLike, history: Iterable[FitInfo]) -> Path:
    """`plot_history` as a PNG, whole or not at all. Raises ImportError without matplotlib (`foldgauss[plot]`)."""

    def draw(figure: Any) -> None:
        plot_history(list(history), figure.subplots(2, 2, sharex="col", sharey="row"))

    return write_figure(path, draw, (10, 6))


def _to_json(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None


def _read_lines(path: Path) -> list[dict[str, Any]]:
    """The complete lines of a history; the last may be incomplete after a killed process."""
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = [_parse_line(line) for line in text.split("\n")[:-1]]
    if None in lines or not _START.startswith(text[: len(_START)]):
        broken = lines.index(None) + 1 if None in lines else 1
        raise invalid(
            "history",
            expected="one JSON object with a step per line",
            got=f"something else in line {broken} of {str(path)!r}",
            cure="Choose another path, or remove the file.",
        )
    return lines


def _parse_line(text: str) -> dict[str, Any] | None:
    """One line, or None where it is invalid. Fields may be missing, or added by a later version."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(line, dict) or not is_integer(line.get("step"), 0):
        return None
    numbers = (line.get(name) for name in FitInfo._fields if name != "stopped_by")
    valid = all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in numbers)
    return line if valid and isinstance(line.get("stopped_by"), str | None) else None
