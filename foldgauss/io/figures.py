"""Figures of `foldgauss.analysis.plot` as files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from foldgauss._runtime.optional_imports import import_optional
from foldgauss.io._atomic import PathLike, atomic_path

DPI = 110


def write_figure(path: PathLike, draw: Callable[[Any], object], size: tuple[float, float]) -> Path:
    """Write what `draw(figure)` plots as a PNG of `size` inches, whole or not at all.

    Raises ImportError without matplotlib (`foldgauss[plot]`).
    """
    figures = import_optional("matplotlib.figure", "plot")  # not pyplot, which may need a display
    figure = figures.Figure(figsize=size, dpi=DPI, layout="constrained")
    draw(figure)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)
    return Path(path)
