"""The history of a fit: one line of JSON per step, there while the fit runs, and its curves as a picture."""

import json
import math
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self, TextIO

from foldgauss._runtime.checks import invalid, is_integer
from foldgauss.analysis.plot import plot_history
from foldgauss.io._atomic import atomic_path, output_error
from foldgauss.io.figures import write_figure
from foldgauss.video.fitting.loop import FitInfo, FitState

#: What JSON has no number for is written as null, and means this.
_NULL = {"loss": math.nan, "psnr": math.nan, "seconds_left": math.inf}
_DIGITS = 7  # all that float32 has
_START = '{"step":'


class HistoryFile:
    """Appends one line per step to `path` and hands each to the system at once: `tail -f` and a killed fit see it.

    An observer of a fit, and a context. Each line is `info_line` of the step. A new history replaces what was there
    at its first step, not before. With `resumed_at`, the step that a kept fit goes on from, and its running `psnr`
    there, lines beyond it are cut off (the fit takes those steps again), and so is a last line that was not written to
    its end.

    Raises `OutputError` where the file cannot be written, ValueError where `resumed_at` finds another kind of file or
    the history of another fit.

    Example: `with HistoryFile("fit.jsonl") as history: fit(frames, observers=[history])`.
    """

    def __init__(self, path: str | os.PathLike, resumed_at: int | None = None, psnr: float | None = None):
        self.path, self._file, self._last, self._append = Path(path), None, 0, False
        if resumed_at is not None and self.path.exists():
            self._append, kept = True, [line for line in _lines(self.path) if line["step"] <= resumed_at]
            self._last = kept[-1]["step"] if kept else 0
            same = psnr is None or (kept and kept[-1].get("psnr") == _plain(psnr))
            if self._last != resumed_at or not same:
                raise invalid(
                    "history",
                    expected=f"that of the fit which is resumed at step {resumed_at}",
                    got=f"{str(self.path)!r} of another, or with that step missing",
                    cure="Give a new name, or the file that the fit wrote before.",
                )
            with atomic_path(self.path) as temporary:
                temporary.write_text("".join(_text(line) for line in kept))

    def __call__(self, state: FitState, info: FitInfo) -> None:
        if info.step <= self._last:
            return  # a kept fit that needs no more steps tells its last one again
        self._last = info.step
        try:
            self._file = self._file or self._opened()
            self._file.write(_text(info_line(info)))
            self._file.flush()
        except OSError as error:
            raise output_error(self.path, error) from error

    def _opened(self) -> TextIO:
        return open(self.path, "a" if self._append else "w", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            with suppress(OSError):  # a full disk, said when the line was written
                self._file.close()


def info_line(info: FitInfo) -> dict[str, Any]:
    """The fields of `FitInfo` as JSON has them: numbers to 7 digits, null for what is not finite."""
    return {name: _plain(value) for name, value in info._asdict().items()}


def read_history(path: str | os.PathLike) -> list[FitInfo]:
    """The steps of a history file, of a running fit too. Raises ValueError where it is none."""
    return [FitInfo(*(_value(line, name) for name in FitInfo._fields)) for line in _lines(Path(path))]


def write_curves(path: str | os.PathLike, history: Iterable[FitInfo]) -> Path:
    """`plot_history` as a PNG, whole or not at all. Raises ImportError without matplotlib (`foldgauss[plot]`)."""
    steps = list(history)
    return write_figure(
        path, lambda figure: plot_history(steps, figure.subplots(2, 2, sharex="col", sharey="row")), (10, 6)
    )


def _plain(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None


def _value(line: dict[str, Any], name: str) -> Any:
    value = line.get(name)
    return _NULL.get(name) if value is None else value


def _text(line: dict[str, Any]) -> str:
    return json.dumps(line) + "\n"


def _lines(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a history; the last may have been cut off by the end of its process."""
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = [_parsed(line) for line in text.split("\n")[:-1]]
    if None in lines or not _START.startswith(text[: len(_START)]):
        broken = lines.index(None) + 1 if None in lines else 1
        raise invalid(
            "history",
            expected="one JSON object with a step per line",
            got=f"something else in line {broken} of {str(path)!r}",
            cure="Choose another path, or remove the file.",
        )
    return lines


def _parsed(text: str) -> dict[str, Any] | None:
    """One line; None for what no fit writes. There may be more fields, of a later version, and fewer."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(line, dict) or not is_integer(line.get("step"), 0):
        return None
    numbers = (line.get(name) for name in FitInfo._fields if name != "stopped_by")
    sound = all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in numbers)
    return line if sound and isinstance(line.get("stopped_by"), str | None) else None
