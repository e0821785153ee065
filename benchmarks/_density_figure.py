"""The figure of `benchmarks.density`: densities of one split, and all methods' held-out log-densities."""

import warnings
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot as plt

from benchmarks._density_data import DATA, split
from benchmarks._density_methods import METHODS, OURS, Effort
from foldgauss.io._atomic import atomic_path

__all__ = ["draw"]

BLUE = "#2b5c8a"
RED = "#c2452d"
GREY = "#5a5f66"
DPI = 110
#: Methods whose densities are drawn, each beside the points.
DRAWN = ("GaussianMixture", "KernelDensity", "flow", OURS)
#: Points of the grid along each axis.
GRID = 160
#: Margin beyond the points, as a fraction of their range.
MARGIN = 0.06
#: Square roots of densities are drawn, so that tails show; above this quantile of all methods' they saturate.
BRIGHTEST = 0.995


def draw(path: Path, tables: dict[str, list[Any]], points: int, effort: Effort) -> None:
    """Rows are data sets: of two columns with their densities, of more with the dots alone."""
    matplotlib.use("Agg")
    methods = [method for method in DRAWN if any(row.method == method for rows in tables.values() for row in rows)]
    width = len(methods) + 1
    fig, axes = plt.subplots(
        len(tables),
        width + 1,
        figsize=(1.75 * width + 3.6, 1.75 * len(tables) + 0.3),
        width_ratios=[1] * width + [1.25],
        squeeze=False,
        layout="constrained",
    )
    for row, (data, rows) in zip(axes, tables.items(), strict=True):
        train, _ = split(DATA[data](points), 0)
        _points(row[0], train, data)
        _densities(row[1:width], train, methods, effort)
        _dots(row[width], rows)
    for ax, title in zip(axes[0], ["training points", *methods, "below the best (nats/point)"], strict=True):
        ax.set_title(title, fontsize=9, color=RED if title == OURS else "black")
    with atomic_path(path) as temporary:
        fig.savefig(temporary, dpi=DPI, format="png", facecolor="white")
    plt.close(fig)


def _points(ax: plt.Axes, x: np.ndarray, data: str) -> None:
    """The first column upwards, the last one, which is time in the measured sets, to the right."""
    ax.plot(x[:, -1], x[:, 0], ".", ms=1.2, color=GREY)
    ax.set_ylabel(data, fontsize=9)
    _frame(ax, x)


def _densities(axes: np.ndarray, x: np.ndarray, methods: list[str], effort: Effort) -> None:
    if x.shape[1] != 2:
        for ax in axes:
            ax.axis("off")
        if len(axes):
            note = axes[0].text(0, 0.5, "densities of three columns are not drawn", fontsize=8, color=GREY)
            note.set_in_layout(False)  # it may be wider than its column
        return
    across, up = (np.linspace(*_limits(x[:, column]), GRID) for column in (-1, 0))
    grid = np.stack([part.ravel() for part in np.meshgrid(up, across, indexing="ij")], -1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        roots = [
            np.exp(0.5 * METHODS[method](x, 0, effort).log_density(grid)).reshape(GRID, GRID) for method in methods
        ]
    brightest = np.quantile(np.concatenate(roots), BRIGHTEST)
    for ax, root in zip(axes, roots, strict=True):
        ax.pcolormesh(across, up, root, cmap="Blues", vmin=0, vmax=brightest, rasterized=True)
        _frame(ax, x)


def _dots(ax: plt.Axes, rows: list[Any]) -> None:
    """Differences to the best with one standard error of the paired differences, and parameters."""
    finite = [row for row in rows if np.isfinite(row.below)]
    for height, row in enumerate(reversed(finite)):
        color = RED if row.method == OURS else BLUE
        ax.errorbar(row.below, height, xerr=row.below_error, fmt="o", ms=3.5, lw=1, color=color)
    names = [f"{row.method} ({row.parameters:,.0f})" for row in reversed(finite)]
    ax.set_yticks(range(len(finite)), names, fontsize=6.5)
    for label, row in zip(ax.get_yticklabels(), reversed(finite), strict=True):
        label.set_color(RED if row.method == OURS else "black")
    ax.yaxis.tick_right()
    ax.axvline(0, lw=0.6, color=GREY)
    ax.set_ylim(-0.7, len(finite) - 0.3)
    ax.tick_params(axis="x", labelsize=6.5)
    ax.spines[["top", "left"]].set_visible(False)


def _frame(ax: plt.Axes, x: np.ndarray) -> None:
    ax.set(xticks=[], yticks=[], xlim=_limits(x[:, -1]), ylim=_limits(x[:, 0]))


def _limits(values: np.ndarray) -> tuple[float, float]:
    margin = MARGIN * np.ptp(values)
    return float(values.min() - margin), float(values.max() + margin)
