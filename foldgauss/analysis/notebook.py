"""Small figures of distributions and fits for notebooks; nothing is shown where one cannot be made, never an error."""

import functools
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from foldgauss.analysis.plot import plot_density, plot_history

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The largest number of space coordinates plotted.
_MAX_SPACES = 3
#: The largest number of components whose density is plotted: a grid of more takes seconds.
_MAX_COMPONENTS = 2000
#: Of the images, in pixels per inch, and their size in inches.
_DPI = 80
_WIDTH = 3.6
_HEIGHT = 2.8


def png_or_none(draw: Callable[..., "Figure"]) -> Callable[..., bytes | None]:
    """The figure as a PNG; None without matplotlib, and for values that are traced or not finite."""

    @functools.wraps(draw)
    def png(*arguments: Any) -> bytes | None:
        try:
            figure, file = draw(*arguments), io.BytesIO()
            figure.savefig(file, format="png", dpi=_DPI)
        except Exception:  # a display must not break the cell
            return None
        return file.getvalue()

    return png


@png_or_none
def density_png(dist: Any) -> "Figure":
    """The density of time and each of the first space coordinates, of a single distribution or mixture."""
    if getattr(dist, "num_components", 1) > _MAX_COMPONENTS:
        raise ValueError
    space_dim = dist.event_shape[0] - 1
    panels = min(space_dim, _MAX_SPACES)
    figure = _figure(panels)
    for j, ax in enumerate(np.atleast_1d(figure.subplots(1, panels))):
        plot_density(dist.marginal([j, -1]), ax)
        ax.set_ylabel("space s" if space_dim == 1 else f"space s[{j}]")
    figure.suptitle(f"{type(dist).__name__}, d = {space_dim + 1}", fontsize=9)
    return figure


@png_or_none
def history_png(history: Any) -> "Figure":
    """The course of a fit, against its seconds and its steps."""
    figure = _figure(2, height=2 * _HEIGHT - 1)
    plot_history(history, figure.subplots(2, 2, sharex="col", sharey="row"))
    return figure


def _figure(columns: int, height: float = _HEIGHT) -> "Figure":
    """Not pyplot's: a notebook would show that one, too."""
    from matplotlib.figure import Figure

    return Figure(figsize=(_WIDTH * columns + 0.4, height), layout="constrained")
