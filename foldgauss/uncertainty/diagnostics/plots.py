"""Plots of the posterior of frame times; matplotlib is imported on first use.

The unit of times is one frame: the mean step between neighbors, cuts excluded; without cuts 1 / (num_frames - 1) of
the model's time. Traces and joint distributions are plotted by ArviZ from `FrameTimePosterior.to_arviz`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import require
from foldgauss._runtime.optional_imports import import_optional
from foldgauss.uncertainty.diagnostics.irregularities import (
    Irregularity,
    even_times,
    find_cuts,
    increment_intervals,
    irregularities,
)
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles
from foldgauss.uncertainty.likelihood.noise import LAST_CORRELATION, correlated_reach
from foldgauss.uncertainty.posterior.result import FrameTimePosterior

_BLUE = "#1f4e79"
_RED = "#d1242f"
_GRAY = "#57606a"
_ORANGE = "#bc4c00"
_FLAG = {"duplicated": (_RED, "v"), "dropped": (_ORANGE, "^")}


def plot_times(
    posterior: FrameTimePosterior,
    axes: np.ndarray | None = None,
    *,
    fitted: Float[np.ndarray, " num_frames"] | None = None,
    flagged: Sequence[Irregularity] | None = None,
) -> np.ndarray:
    """Plot times less even spacing within the shot (upper panel) and half widths of their intervals (lower panel).

    Upper panel, in frames: the posterior mean, its central 50 and 90% as bands, `fitted` (the model's own times) as a
    dotted line, and `flagged` intervals marked (default: `irregularities(posterior)`). Lower panel, on a logarithmic
    scale: half the width of the central 50 and 90% of the draws, and 90% by the exact posterior.

    **Shapes:** `axes`, given or made, are (2,). **Units:** frames.

    **Example:** `plot_times(posterior)[0].figure.savefig("times.png")`

    **Raises:** ImportError that names the extra if matplotlib is missing; ValueError for `fitted` of another length.
    """
    num_frames = posterior.times.shape[-1]
    require(
        fitted is None or np.shape(fitted) == (num_frames,),
        "fitted",
        expected=f"{num_frames} times",
        got=f"shape {np.shape(fitted)}",
    )
    if axes is None:
        pyplot = import_optional("matplotlib.pyplot", "plot")
        axes = pyplot.subplots(2, 1, sharex=True, layout="constrained", figsize=(9, 6))[1]
    flagged = irregularities(posterior) if flagged is None else flagged
    frames, (even, unit) = np.arange(num_frames), even_times(posterior)
    mean = (posterior.mean() - even) / unit
    inner, outer = ((np.stack(posterior.interval(level)) - even) / unit for level in (0.5, 0.9))
    upper, lower = axes
    upper.fill_between(frames, *outer, color=_BLUE, alpha=0.25, linewidth=0, label="90%")
    upper.fill_between(frames, *inner, color=_BLUE, alpha=0.45, linewidth=0, label="50%")
    upper.plot(frames, mean, color=_BLUE, linewidth=1.2, label="posterior mean")
    if fitted is not None:
        shown = (np.asarray(fitted, np.float64) - even) / unit
        upper.plot(frames, shown, ":", color=_GRAY, linewidth=1.4, label="as fitted")
    for kind, (color, marker) in _FLAG.items():
        at = np.array([one.frames for one in flagged if one.kind == kind])
        if len(at):
            upper.plot(at.mean(1), mean[at].mean(1), marker, color=color, markersize=6, label=kind, zorder=5)
    upper.axhline(0, color=_GRAY, linewidth=0.6)
    upper.set_ylabel("time less even spacing\n(frames)")
    upper.set_title("Frame times, given the splats")
    upper.legend(ncols=6, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.02), frameon=False)

    free = posterior.free
    for part, alpha, level in ((outer, 0.35, 90), (inner, 0.8, 50)):
        half = (part[1] - part[0])[free] / 2
        lower.vlines(free, 0, half, color=_BLUE, alpha=alpha, linewidth=_bar_width(num_frames), label=f"{level}%")
    exact = np.diff(posterior.exact.interval(0.9), axis=0)[0, free] / (2 * unit)
    lower.plot(free, exact, "_", color="black", markersize=6, markeredgewidth=1, label="exact, 90%")
    unknown = np.flatnonzero(~posterior.identified())
    if len(unknown):
        half = (outer[1] - outer[0])[unknown] / 2
        lower.plot(unknown, half * 1.15, "*", color=_RED, markersize=6, label="not identified")
    lower.set_yscale("log")
    least = min(((inner[1] - inner[0])[free] / 2).min(), exact.min())
    lower.set_ylim(bottom=0.6 * least)
    lower.set(
        xlabel="frame",
        ylabel="half width of the interval\n(frames)",
        xlim=(-0.01 * num_frames, 1.01 * (num_frames - 1)),
    )
    lower.legend(ncols=5, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.16), frameon=False)
    for ax in axes:
        ax.grid(alpha=0.25)
    return axes


def plot_increments(
    posterior: FrameTimePosterior,
    ax: Any = None,
    *,
    level: float = 0.95,
    flagged: Sequence[Irregularity] | None = None,
) -> Any:
    """Plot each increment in units of the median one, with its central interval; mark duplicated and dropped frames.

    Cuts are omitted. Raises as `plot_times` and `increment_intervals` do.
    """
    ax = _axes(ax, (9, 4))
    flagged = irregularities(posterior) if flagged is None else flagged
    found = increment_intervals(posterior, level)
    shown = np.flatnonzero(~find_cuts(posterior))
    at = shown + 0.5
    ax.axhline(1, color=_GRAY, linewidth=0.6)
    ax.vlines(at, found.low[shown], found.high[shown], color=_BLUE, alpha=0.45, linewidth=_bar_width(len(found.mean)))
    ax.plot(at, found.mean[shown], "o", color=_BLUE, markersize=2.5, label=f"mean and central {100 * level:.3g}%")
    for kind, (color, marker) in _FLAG.items():
        those = [one for one in flagged if one.kind == kind]
        if not those:
            continue
        k = np.array([one.frames[0] for one in those])
        ax.plot(k + 0.5, found.mean[k], marker, color=color, markersize=7, label=f"{kind}: {len(those)}")
        for one in those[:20]:
            ax.annotate(
                "{}-{}".format(*one.frames), (one.frames[0] + 0.5, found.mean[one.frames[0]]), (-2, 6),
                textcoords="offset points", ha="left", rotation=35, fontsize="x-small", color=color,
            )  # fmt: skip
    ax.set_ylim(min(-0.05, ax.get_ylim()[0]), 0.1 + 1.06 * max(found.high[shown].max(), found.mean[shown].max()))
    ax.set(
        xlabel="interval (its first frame + 1/2)",
        ylabel="increment / median increment",
        title="Playback speed of the clip",
    )
    ax.legend(fontsize="small", ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.17), frameon=False)
    ax.grid(alpha=0.25)
    return ax


def plot_correlation(profiles: LikelihoodProfiles, ax: Any = None) -> Any:
    """Plot the correlation of residuals by distance; the title states the effective number of independent values.

    White noise would fall from 1 to 0 within a pixel. **Units:** pixels.
    """
    ax = _axes(ax, (6, 3.6))
    correlation = np.asarray(profiles.residual_correlation)
    last = min(len(correlation), max(3 * correlated_reach(correlation), 12) + 1)
    ax.plot(np.arange(last), correlation[:last], "o-", color=_BLUE, markersize=3.5, linewidth=1.2)
    ax.axhline(0, color=_GRAY, linewidth=0.6)
    ax.axhline(LAST_CORRELATION, color=_RED, linewidth=0.8, linestyle="--")
    ax.text(last - 1, LAST_CORRELATION, f"{LAST_CORRELATION:g}: cutoff", color=_RED, fontsize="small",
            ha="right", va="bottom")  # fmt: skip
    text = profiles.noise.describe()
    ax.set_title(text[0].upper() + text[1:], fontsize="medium")
    ax.set(xlabel="distance (pixels)", ylabel="correlation of residuals", xlim=(-0.02 * last, last - 1))
    ax.grid(alpha=0.25)
    return ax


def _axes(ax, size: tuple[float, float]):
    if ax is not None:
        return ax
    return import_optional("matplotlib.pyplot", "plot").subplots(layout="constrained", figsize=size)[1]


def _bar_width(num: int) -> float:
    """Width of bars side by side in a figure of 9 inches, in points."""
    return float(np.clip(360 / num, 0.6, 4))
