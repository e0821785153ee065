"""Figures of a Folded-Gaussian, of a fit's history and of speed against accuracy; matplotlib is imported on use."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from foldgauss._runtime.checks import require
from foldgauss._runtime.optional_imports import import_optional

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Panel", "plot_density", "plot_history", "plot_tradeoff"]

_RED = "#d1242f"
_BLUE = "#1f4e79"
_DENSITY = "Blues"
_MASS = (0.3, 0.6, 0.9)  # probability inside the contour lines
_GRID = 240
_REACH = 3.2  # time shown, in time_scales on either side
_MARKERS = "osD^vPX"  # of axes, colors being ten
_STEPS_DRAWN = 5000  # of a history: more than a picture has columns
_LOG_PROB = jax.jit(lambda dist, x: dist.log_prob(x))


def plot_density(
    dist,
    ax: "Axes | None" = None,
    *,
    slices: int | Sequence[float] = 3,
    t_limits: tuple[float, float] | None = None,
    s_limits: tuple[float, float] | None = None,
) -> "Axes":
    """The density of a Folded-Gaussian or a mixture of d = 2, with conditional distributions s | t in red.

    Contour lines enclose 30, 60 and 90% of the probability shown. The red curve at each of `slices` is `N(s | t)`,
    rotated and scaled to the same height, with a dot at its mean, `loc + f(time_loc - t)` for a Folded-Gaussian.

    **Shapes:** `dist` has `event_shape == (2,)` and no batch; `slices` is their number, or the times themselves.

    **Units:** time and space of `dist`, for the limits as well.

    **Example:** `plot_density(dist, ax).set_title("f(u) = u^2")`

    **Source:** VeGaS, fig:2D_dist. **Raises:** ImportError that names the extra if matplotlib is missing; ValueError if
    `dist` is not a single distribution in the plane.
    """
    _check_plane(dist)
    pyplot = import_optional("matplotlib.pyplot", "plot")
    ax = pyplot.subplots()[1] if ax is None else ax
    loc, scale = _time_moments(dist)
    t_limits = (loc - _REACH * scale, loc + _REACH * scale) if t_limits is None else t_limits
    s_limits = _space_limits(dist, t_limits) if s_limits is None else s_limits
    times = loc + scale * np.linspace(-1.5, 1.5, slices) if isinstance(slices, int) else np.asarray(slices, float)
    _draw_density(dist, ax, t_limits, s_limits)
    _draw_slices(dist, ax, times, s_limits, width=_bell_width(times, t_limits))
    ax.set(xlim=t_limits, ylim=s_limits, xlabel="time t", ylabel="space s")
    return ax


def plot_history(history: Sequence[Any], axes: "np.ndarray | None" = None) -> np.ndarray:
    """The course of a fit: PSNR above, loss below, against seconds on the left and steps on the right.

    A step's loss is that of its few frames: it is plotted faintly, with its running median over 2% of the history. It
    jumps where the fit changes to larger frames (by default at 20% and 60%) and to the squared error (at 70%).

    **Shapes:** `history` has at least one step (of `foldgauss.video.FitInfo`); `axes`, given or made, are (2, 2).

    **Units:** dB, seconds of fitting, the loss on a logarithmic scale unless it is 0 throughout.

    **Example:** `plot_history(fit(frames).history)[0, 0].figure.savefig("fit.png")`

    **Raises:** ImportError that names the extra if matplotlib is missing; ValueError for an empty history.
    """
    require(len(history), "history", expected="at least one step", got="none")
    if axes is None:
        axes = import_optional("matplotlib.pyplot", "plot").subplots(
            2, 2, sharex="col", sharey="row", layout="constrained"
        )[1]
    drawn = history[:: max(len(history) // _STEPS_DRAWN, 1)]
    steps, seconds, loss, psnr = np.array([(i.step, i.seconds, i.loss, i.psnr) for i in drawn], float).T
    median = scipy.ndimage.median_filter(loss, 2 * max(len(loss) // 100, 1) + 1, mode="nearest")
    for x, name, (upper, lower) in ((seconds, "seconds", axes[:, 0]), (steps, "steps", axes[:, 1])):
        upper.plot(x, psnr, "o" if len(x) == 1 else "-", color=_BLUE, linewidth=1.6)
        lower.plot(x, loss, "o" if len(x) == 1 else "-", color=_RED, linewidth=0.6, alpha=0.3, label="each step")
        lower.plot(x, median, color=_RED, linewidth=1.6, label="running median")
        lower.set(xlabel=name, yscale="log" if (loss > 0).any() else "linear")  # 0 throughout for a black clip
        lower.set_xlim(left=0)  # initialization takes time too
        for ax in (upper, lower):
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("PSNR (dB)")
    axes[1, 0].set_ylabel("loss")
    axes[1, 0].legend()
    return axes


class Panel(NamedTuple):
    """One kind of cost: its label, the cost of each point, indices of the Pareto front and of its knee."""

    label: str
    cost: Sequence[float]
    front: Sequence[int]
    knee: int | None


def plot_tradeoff(
    panels: Sequence[Panel],
    quality: Sequence[float],
    names: Sequence[tuple[str, str]],
    axes: "np.ndarray | None" = None,
) -> np.ndarray:
    """Quality against cost, a panel for each kind of cost, with the Pareto front as a line and a ring at its knee.

    Each axis has a color; points of the axis "base" are stars. Points of a Pareto front are labeled where labels do
    not overlap, the knee always.

    **Shapes:** `quality` and every cost have one number per point, `names` its axis and value; `axes`, given or made,
    are (len(panels),).

    **Units:** dB; costs on logarithmic scales.

    **Example:** `plot_tradeoff([Panel("seconds", [1, 2], [0, 1], None)], [30, 33], [("base", ""), ("time", "2")])`

    **Raises:** ImportError that names the extra if matplotlib is missing.
    """
    if axes is None:
        made = import_optional("matplotlib.pyplot", "plot").subplots(
            1, len(panels), sharey=True, squeeze=False, layout="constrained"
        )
        axes = made[1][0]
    axes = np.atleast_1d(axes)
    groups = list(dict.fromkeys(axis for axis, _ in names))
    quality = np.asarray(quality, float)
    for panel, ax in zip(panels, axes, strict=True):
        cost, chosen = np.asarray(panel.cost, float), list(panel.front)
        ax.plot(cost[chosen], quality[chosen], "-", color="0.55", linewidth=1.2, zorder=1, label="_front")
        for number, group in enumerate(groups):
            own = [k for k, (axis, _) in enumerate(names) if axis == group]
            marker, color = ("*", "black") if group == "base" else (_MARKERS[number % len(_MARKERS)], f"C{number % 10}")
            size = 13 if group == "base" else 6.5
            label = group if ax is axes[0] else f"_{group}"
            ax.plot(cost[own], quality[own], marker, color=color, markersize=size, alpha=0.9, label=label, zorder=3)
        if panel.knee is not None:
            at = cost[panel.knee], quality[panel.knee]
            ax.plot(*at, "o", color=_RED, markerfacecolor="none", markersize=17, markeredgewidth=2, zorder=2)
        ax.set(xlabel=panel.label, xscale="log")
        ax.xaxis.set_minor_formatter("")
        _few_ticks(ax, cost)
        ax.margins(x=0.16, y=0.1)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("PSNR (dB)")
    figure = axes[0].figure
    figure.legend(loc="outside lower center", ncols=min(len(groups), 6), frameon=False)
    figure.draw_without_rendering()  # from here on positions are known in pixels
    for panel, ax in zip(panels, axes, strict=True):
        _name_points(ax, panel, quality, [f"{axis} {value}".rstrip() for axis, value in names])
    return axes


def _few_ticks(ax, cost: np.ndarray) -> None:
    """Plain tick labels; also at 2 and 5 times powers of ten if the range is less than 100."""
    from matplotlib.ticker import LogLocator

    subs = (1, 2, 5) if cost.max() < 100 * cost.min() else (1,)
    ax.xaxis.set_major_locator(LogLocator(subs=subs))
    ax.xaxis.set_major_formatter("{x:,g}")


def _name_points(ax, panel: Panel, quality: np.ndarray, names: Sequence[str]) -> None:
    """Label points of the front, the knee first; a label that would overlap an earlier one is left out."""
    taken = []
    for k in sorted(panel.front, key=lambda k: (k != panel.knee, -quality[k])):
        text, color = (f"knee: {names[k]}", _RED) if k == panel.knee else (names[k], "0.15")
        place = float(panel.cost[k]), float(quality[k])
        how = {"textcoords": "offset points", "in_layout": False, "va": "top", "fontsize": 9, "zorder": 5}
        note = ax.annotate(text, place, (8, -8), color=color, **how)
        if note.get_window_extent().count_overlaps(taken):
            note.remove()
        else:
            taken.append(note.get_window_extent())


def _draw_density(dist, ax, t_limits, s_limits) -> None:
    t, s = (np.linspace(*limits, _GRID) for limits in (t_limits, s_limits))
    points = np.stack(np.broadcast_arrays(s[:, None], t[None, :]), axis=-1)
    density = np.exp(np.asarray(_LOG_PROB(dist, _as_values(dist, points)), float))
    # The square root keeps the tails visible beside the peak.
    shade = np.sqrt(density / density.max())
    ax.pcolormesh(t, s, shade, cmap=_DENSITY, vmin=0, vmax=1.6, shading="gouraud", rasterized=True)
    levels = _mass_levels(density)
    if len(levels):
        ax.contour(t, s, density, levels=levels, colors=_BLUE, linewidths=0.8, alpha=0.8)


def _mass_levels(density: np.ndarray) -> np.ndarray:
    """Densities that enclose the given fractions of the probability, ascending and distinct, as contours need them."""
    ordered = np.sort(density.ravel())[::-1]
    mass = np.cumsum(ordered) / ordered.sum()
    return np.unique(ordered[np.searchsorted(mass, _MASS)])


def _draw_slices(dist, ax, times, s_limits, width: float) -> None:
    for t in times:
        gaussian = dist.condition_time(_as_values(dist, t))
        center, spread = _conditional(dist, np.array([t]))
        s = np.linspace(center[0] - 3.5 * spread[0], center[0] + 3.5 * spread[0], 201)
        height = np.exp(np.asarray(gaussian.log_prob(_as_values(dist, s[:, None])), float))
        bell = t + width * height / height.max()
        ax.fill_betweenx(s, t, bell, color=_RED, alpha=0.25, linewidth=0, zorder=3)
        ax.plot(bell, s, color=_RED, linewidth=1.4, zorder=4)
        ax.plot([t, t], s_limits, color=_RED, linewidth=0.7, alpha=0.55, zorder=2)
        ax.plot([t], center, "o", color=_RED, markersize=3, zorder=5)


def _bell_width(times, t_limits) -> float:
    """The height of the conditional densities, less than the gap to the next time."""
    gap = np.diff(np.sort(times)).min() if len(times) > 1 else np.inf
    return min(0.75 * gap, 0.16 * (t_limits[1] - t_limits[0]))


def _conditional(dist, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of s | t."""
    gaussian = dist.condition_time(_as_values(dist, t))
    return np.asarray(gaussian.mean, float)[..., 0], np.sqrt(np.asarray(gaussian.variance, float)[..., 0])


def _as_values(dist, x: np.ndarray) -> jax.Array:
    """x in the dtype of the distribution."""
    return jnp.asarray(x, jax.tree.leaves(dist)[0].dtype)


def _time_moments(dist) -> tuple[float, float]:
    """Mean and standard deviation of t."""
    time = dist.marginal([-1])
    return time.mean.item(), math.sqrt(time.variance.item())


def _space_limits(dist, t_limits) -> tuple[float, float]:
    """The range of s of about 99% of the probability."""
    loc, scale = _time_moments(dist)
    t = np.linspace(max(t_limits[0], loc - 2.2 * scale), min(t_limits[1], loc + 2.2 * scale), 101)
    center, spread = _conditional(dist, t)
    low, high = (center - 3.2 * spread).min(), (center + 3.2 * spread).max()
    return float(low), float(high)


def _check_plane(dist) -> None:
    require(
        dist.batch_shape == () and dist.event_shape == (2,),
        "dist",
        expected="batch_shape () and event_shape (2,)",
        got=f"batch_shape {dist.batch_shape} and event_shape {dist.event_shape}",
        cure="Take one element of a batch, or a marginal of one space coordinate and time.",
    )
