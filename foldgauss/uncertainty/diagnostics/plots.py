"""Plots of the posterior of frame times; matplotlib is imported on first use.

The unit of times is one frame: the mean step between neighbors, cuts excluded; without cuts 1 / (num_frames - 1) of
the model's time.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import invalid
from foldgauss.analysis.plot import import_pyplot
from foldgauss.uncertainty.diagnostics.irregularities import (
    Irregularity,
    even_times,
    find_cuts,
    increment_intervals,
    irregularities,
)
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles
from foldgauss.uncertainty.likelihood.noise import LAST_CORRELATION
from foldgauss.uncertainty.posterior.result import FrameTimePosterior

__all__ = ["plot_correlation", "plot_increments", "plot_pairs", "plot_times", "plot_trace"]

_BLUE, _RED, _GRAY, _ORANGE, _GREEN = "#1f4e79", "#d1242f", "#57606a", "#bc4c00", "#1a7f37"
_FLAG = {"duplicated": (_RED, "v"), "dropped": (_ORANGE, "^")}
_MOST_PAIRS, _POINTS, _STEPS_SHOWN = 6, 2000, 1000
_COLORS = (_BLUE, _ORANGE, _GREEN, _RED, "#8250df", _GRAY)


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
    scale: half the width of the central 50 and 90% of the draws, and 90% by Laplace's approximation and the exact
    posterior.

    **Shapes:** `axes`, given or made, are (2,). **Units:** frames.

    **Example:** `plot_times(posterior)[0].figure.savefig("times.png")`

    **Raises:** ImportError that names the extra if matplotlib is missing; ValueError for `fitted` of another length.
    """
    num_frames = posterior.times.shape[-1]
    if fitted is not None and np.shape(fitted) != (num_frames,):
        raise invalid("fitted", expected=f"{num_frames} times", got=f"shape {np.shape(fitted)}")
    if axes is None:
        pyplot = import_pyplot("plot_times")
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
    laplace = 1.6449 * posterior.laplace.std[free] / unit
    exact = np.diff(posterior.exact.interval(0.9), axis=0)[0, free] / (2 * unit)
    lower.plot(free, laplace, "x", color=_ORANGE, markersize=4, markeredgewidth=1, label="Laplace, 90%")
    lower.plot(free, exact, "_", color="black", markersize=6, markeredgewidth=1, label="exact, 90%")
    unknown = np.flatnonzero(~posterior.identified())
    if len(unknown):
        half = (outer[1] - outer[0])[unknown] / 2
        lower.plot(unknown, half * 1.15, "*", color=_RED, markersize=6, label="not identified")
    lower.set_yscale("log")
    least = min(((inner[1] - inner[0])[free] / 2).min(), exact.min(), laplace.min())
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
    ax = _axes(ax, "plot_increments", (9, 4))
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


def plot_pairs(
    posterior: FrameTimePosterior, frames: Sequence[int] | None = None, axes: np.ndarray | None = None
) -> np.ndarray:
    """A corner plot of the joint distribution of a few frames' times, in frames from their means.

    `frames`: at most six free frames (default: four around the frame with the widest posterior). On the diagonal the
    draws (filled), the exact marginal (line) and Laplace's approximation (dashed); below it draws and correlations.

    **Shapes:** `axes` (len(frames), len(frames)). Raises ValueError for held frames, or too many.
    """
    frames = _frames_around_widest(posterior) if frames is None else _check_frames(posterior, frames)
    num = len(frames)
    if num > _MOST_PAIRS:
        raise invalid("frames", expected=f"at most {_MOST_PAIRS}", got=num)
    if axes is None:
        pyplot = import_pyplot("plot_pairs")
        size = max(1.9 * num, 3.5)
        axes = pyplot.subplots(num, num, sharex="col", layout="constrained", figsize=(size, size), squeeze=False)[1]
    (_, unit), draws = even_times(posterior), posterior.draws
    mean = posterior.mean()
    shown = (draws - mean)[np.unique(np.linspace(0, len(draws) - 1, _POINTS).astype(int))] / unit
    everything = (draws[:, frames] - mean[frames]) / unit
    correlation = np.atleast_2d(np.corrcoef(everything, rowvar=False))
    reach = np.abs(np.quantile(everything, [0.0015, 0.9985], axis=0)).max(0) * 1.15
    for row, k in enumerate(frames):
        for column, j in enumerate(frames):
            ax = axes[row, column]
            if column > row:
                ax.axis("off")
                continue
            ax.set_xlim(-reach[column], reach[column])
            ax.tick_params(labelsize="x-small")
            ax.locator_params(nbins=4)
            if row == column:
                _marginal(posterior, ax, k, everything[:, row], unit, reach[row])
                ax.set_title(f"frame {k}", fontsize="small")
            else:
                ax.plot(shown[:, j], shown[:, k], ".", color=_BLUE, markersize=1.5, alpha=0.35, rasterized=True)
                ax.set_ylim(-reach[row], reach[row])
                text = f"r = {correlation[row, column]:.2f}"
                ax.text(0.04, 0.94, text, transform=ax.transAxes, fontsize="x-small", va="top")
                if column:
                    ax.tick_params(labelleft=False)
            if row == num - 1:
                ax.set_xlabel(f"$t_{{{j}}}$ (frames)", fontsize="small")
            if column == 0 and row:
                ax.set_ylabel(f"$t_{{{k}}}$ (frames)", fontsize="small")
    figure = axes[0, 0].figure
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if num > 1:
        axes[0, 1].legend(handles, labels, loc="center left", fontsize="small", frameon=False)
    else:
        axes[0, 0].legend(fontsize="x-small")
    figure.suptitle("Times from their means, given the splats", fontsize="medium")
    return axes


def plot_trace(
    posterior: FrameTimePosterior, frames: Sequence[int] | None = None, axes: np.ndarray | None = None
) -> np.ndarray:
    """Trace plot, one color per ensemble: mean over its walkers (bold lines) and their central 90% (thin lines).

    `frames`: default the two with the largest R-hat and autocorrelation time. Converged ensembles overlap without
    drift. To the right the draws of each ensemble as a histogram: these should agree.

    **Shapes:** `axes` (len(frames), 2). **Units:** frames from the mean; kept states.
    """
    if frames is None:
        worst = [posterior.free[np.argmax(posterior.r_hat)], posterior.free[np.argmax(posterior.tau)]]
        frames = list(dict.fromkeys(int(k) for k in worst))
    frames = _check_frames(posterior, frames)
    if axes is None:
        pyplot = import_pyplot("plot_trace")
        axes = pyplot.subplots(
            len(frames), 2, sharex="col", sharey="row", layout="constrained", squeeze=False,
            figsize=(9, 0.6 + 2.2 * len(frames)), width_ratios=(4, 1),
        )[1]  # fmt: skip
    (_, unit), mean = even_times(posterior), posterior.mean()
    order = posterior.free.tolist()
    for k, (left, right) in zip(frames, axes, strict=True):
        draws = (posterior.times[..., k] - mean[k]) / unit
        stride = max(draws.shape[1] // _STEPS_SHOWN, 1)
        edges = np.linspace(*np.quantile(draws, [0.001, 0.999]), 41)
        for n, walkers in enumerate(draws):
            color, some = _COLORS[n % len(_COLORS)], walkers[::stride]
            at = np.arange(len(some)) * stride
            low, high = np.quantile(some, [0.05, 0.95], axis=1)
            left.plot(at, low, color=color, alpha=0.35, linewidth=0.5)
            left.plot(at, high, color=color, alpha=0.35, linewidth=0.5)
            left.plot(at, some.mean(1), color=color, linewidth=0.9, label=f"ensemble {n}")
            counts, _ = np.histogram(walkers, edges, density=True)
            right.stairs(counts, edges, orientation="horizontal", color=color, linewidth=1)
        n = order.index(k)
        text = f"R-hat {posterior.r_hat[n]:.4f}, tau {posterior.tau[n]:,.0f} steps, ESS {posterior.ess[n]:,.0f}"
        left.set_title(f"frame {k}: {text}", fontsize="small")
        left.set_ylabel(f"$t_{{{k}}}$ from its mean\n(frames)")
        left.set_xlim(0, draws.shape[1])
        left.grid(alpha=0.25)
        right.set_xticks([])
    axes[-1, 0].set_xlabel("kept states after burn-in (bold: mean of the walkers; thin: their central 90%)")
    axes[-1, 1].set_xlabel("density")
    axes[0, 0].legend(ncols=4, fontsize="x-small", loc="upper right")
    return axes


def plot_correlation(profiles: LikelihoodProfiles, ax: Any = None) -> Any:
    """Plot the correlation of residuals by distance; the title states the effective number of independent values.

    White noise would fall from 1 to 0 within a pixel. **Units:** pixels.
    """
    ax = _axes(ax, "plot_correlation", (6, 3.6))
    correlation = np.asarray(profiles.residual_correlation)
    below = np.flatnonzero(correlation < LAST_CORRELATION)
    reach = int(below[0]) if below.size else len(correlation) - 1
    last = min(len(correlation), max(3 * reach, 12) + 1)
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


def _axes(ax, caller: str, size: tuple[float, float]):
    return import_pyplot(caller).subplots(layout="constrained", figsize=size)[1] if ax is None else ax


def _bar_width(num: int) -> float:
    """Width of bars side by side in a figure of 9 inches, in points."""
    return float(np.clip(360 / num, 0.6, 4))


def _check_frames(posterior: FrameTimePosterior, frames: Sequence[int]) -> list[int]:
    frames = [int(k) for k in frames]
    if not frames or len(set(frames)) < len(frames) or not set(frames) <= set(posterior.free.tolist()):
        raise invalid("frames", expected="frames whose times were sampled, each once", got=frames)
    return frames


def _frames_around_widest(posterior: FrameTimePosterior) -> list[int]:
    """The free frame with the widest posterior and its neighbors, four in all if there are as many."""
    free = posterior.free
    widest = int(np.argmax(posterior.std()[free]))
    first = int(np.clip(widest - 1, 0, max(len(free) - 4, 0)))
    return free[first : first + 4].tolist()


def _marginal(posterior: FrameTimePosterior, ax, k: int, draws: np.ndarray, unit: float, reach: float) -> None:
    n = posterior.free.tolist().index(k)
    mean, grid = posterior.mean()[k], posterior.exact.grids[n]
    ax.hist(draws, np.linspace(-reach, reach, 41), density=True, color=_BLUE, alpha=0.35, label="emcee")
    ax.plot((grid - mean) / unit, posterior.exact.densities[n] * unit, color="black", linewidth=1, label="exact")
    mode, std = (posterior.laplace.mode[k] - mean) / unit, posterior.laplace.std[k] / unit
    at = np.linspace(-reach, reach, 201)
    bell = np.exp(-0.5 * ((at - mode) / std) ** 2) / (std * np.sqrt(2 * np.pi))
    ax.plot(at, bell, "--", color=_ORANGE, linewidth=1, label="Laplace")
    ax.set_yticks([])
