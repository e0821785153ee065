"""Pictures of a Folded-Gaussian and of a fit's history; matplotlib is imported when one is drawn."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss._checks import invalid
from foldgauss.distribution import FoldedGaussian

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_density", "plot_history"]

_RED = "#d1242f"
_BLUE = "#1f4e79"
_DENSITY = "Blues"
_MASS = (0.3, 0.6, 0.9)  # probability inside the contour lines
_GRID = 240
_REACH = 3.2  # time shown, in time_scales on either side
_STEPS_DRAWN = 5000  # of a history: more than a picture has columns
_LOG_PROB = jax.jit(lambda dist, x: dist.log_prob(x))


def plot_density(
    dist: FoldedGaussian,
    ax: "Axes | None" = None,
    *,
    slices: int | Sequence[float] = 3,
    t_limits: tuple[float, float] | None = None,
    s_limits: tuple[float, float] | None = None,
) -> "Axes":
    """The density of a Folded-Gaussian of d = 2, with conditional distributions s | t in red: the paper's figure.

    Time runs to the right, space upwards; contour lines hold 30, 60 and 90% of the probability shown. A red bell
    stands on each chosen time: `N(s | t)` drawn sideways, all to the same height (a narrow one would be tall), its
    foot at that time, a dot at its centre `loc + f(time_loc - t)`.

    **Shapes:** `dist` has `event_shape == (2,)` and no batch; `slices` is their number, or the times themselves.

    **Units:** time and space of `dist`, for the limits as well.

    **Example:** `plot_density(dist, ax).set_title("f(u) = u^2")`

    **Source:** fig:2D_dist. **Raises:** ImportError that names the extra if matplotlib is missing; ValueError if
    `dist` is not a single distribution in the plane.
    """
    _check_plane(dist)
    pyplot = needed_pyplot("plot_density")
    ax = pyplot.subplots()[1] if ax is None else ax
    loc, scale = float(dist.time_loc), float(dist.time_scale)
    t_limits = (loc - _REACH * scale, loc + _REACH * scale) if t_limits is None else t_limits
    s_limits = _space_limits(dist, t_limits) if s_limits is None else s_limits
    times = loc + scale * np.linspace(-1.5, 1.5, slices) if isinstance(slices, int) else np.asarray(slices, float)
    _draw_density(dist, ax, t_limits, s_limits)
    _draw_slices(dist, ax, times, s_limits, width=_bell_width(times, t_limits))
    ax.set(xlim=t_limits, ylim=s_limits, xlabel="time t", ylabel="space s")
    return ax


class _Step(Protocol):
    """What is drawn of a step of a fit: `foldgauss.video.FitInfo`, or anything with these."""

    step: int
    seconds: float
    loss: float
    psnr: float


def plot_history(history: Sequence[_Step], axes: "np.ndarray | None" = None) -> np.ndarray:
    """The course of a fit: PSNR above, loss below, against seconds on the left and steps on the right.

    A step's loss is that of its few frames: it is drawn faint, with its running median over 2% of the history. It
    changes its meaning where the fit turns to larger frames (by default at 20% and 60% of the plan) and to the squared
    error (at 70%): jumps there are no accident.

    **Shapes:** `history` has at least one step; `axes`, given or made, are (2, 2).

    **Units:** dB, seconds of fitting, the loss on a logarithmic scale unless it is 0 throughout.

    **Example:** `plot_history(fit(frames).history)[0, 0].figure.savefig("fit.png")`

    **Raises:** ImportError that names the extra if matplotlib is missing; ValueError for an empty history.
    """
    if not len(history):
        raise invalid("history", expected="at least one step", got="none")
    if axes is None:
        axes = needed_pyplot("plot_history").subplots(2, 2, sharex="col", sharey="row", layout="constrained")[1]
    drawn = history[:: max(len(history) // _STEPS_DRAWN, 1)]
    steps, seconds, loss, psnr = np.array([(i.step, i.seconds, i.loss, i.psnr) for i in drawn], float).T
    for x, name, (upper, lower) in ((seconds, "seconds", axes[:, 0]), (steps, "steps", axes[:, 1])):
        upper.plot(x, psnr, "o" if len(x) == 1 else "-", color=_BLUE, linewidth=1.6)
        lower.plot(x, loss, "o" if len(x) == 1 else "-", color=_RED, linewidth=0.6, alpha=0.3, label="each step")
        lower.plot(x, _running_median(loss), color=_RED, linewidth=1.6, label="running median")
        lower.set(xlabel=name, yscale="log" if (loss > 0).any() else "linear")  # a black clip's is 0 from the start
        lower.set_xlim(left=0)  # the start takes its seconds too
        for ax in (upper, lower):
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("PSNR (dB)")
    axes[1, 0].set_ylabel("loss")
    axes[1, 0].legend()
    return axes


def _running_median(values: np.ndarray) -> np.ndarray:
    """Of each value and those around it, 2% of them all; fewer at the ends."""
    reach = max(len(values) // 100, 1)
    padded = np.pad(values, reach, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    known = (window[~np.isnan(window)] for window in windows)
    return np.array([np.median(window) if window.size else np.nan for window in known])


def _draw_density(dist, ax, t_limits, s_limits) -> None:
    t, s = (np.linspace(*limits, _GRID) for limits in (t_limits, s_limits))
    points = np.stack(np.broadcast_arrays(s[:, None], t[None, :]), axis=-1)
    density = np.exp(np.asarray(_LOG_PROB(dist, jnp.asarray(points, dist.loc.dtype)), float))
    # The square root keeps the tails visible beside the peak.
    shade = np.sqrt(density / density.max())
    ax.pcolormesh(t, s, shade, cmap=_DENSITY, vmin=0, vmax=1.6, shading="gouraud", rasterized=True)
    levels = _mass_levels(density)
    if len(levels):
        ax.contour(t, s, density, levels=levels, colors=_BLUE, linewidths=0.8, alpha=0.8)


def _mass_levels(density: np.ndarray) -> np.ndarray:
    """Densities above which the given shares of the probability lie, rising and distinct, as contours need them."""
    ordered = np.sort(density.ravel())[::-1]
    mass = np.cumsum(ordered) / ordered.sum()
    return np.unique(ordered[np.searchsorted(mass, _MASS)])


def _draw_slices(dist, ax, times, s_limits, width: float) -> None:
    for t in times:
        centre, scale = _conditional(dist, np.array([t]))
        s = np.linspace(centre[0] - 3.5 * scale[0], centre[0] + 3.5 * scale[0], 201)
        bell = t + width * np.exp(-0.5 * ((s - centre[0]) / scale[0]) ** 2)
        ax.fill_betweenx(s, t, bell, color=_RED, alpha=0.25, linewidth=0, zorder=3)
        ax.plot(bell, s, color=_RED, linewidth=1.4, zorder=4)
        ax.plot([t, t], s_limits, color=_RED, linewidth=0.7, alpha=0.55, zorder=2)
        ax.plot([t], centre, "o", color=_RED, markersize=3, zorder=5)


def _bell_width(times, t_limits) -> float:
    """Bells must not reach the next time."""
    gap = np.diff(np.sort(times)).min() if len(times) > 1 else np.inf
    return min(0.75 * gap, 0.16 * (t_limits[1] - t_limits[0]))


def _conditional(dist, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and standard deviation of s | t."""
    gaussian = dist.condition_time(jnp.asarray(t, dist.loc.dtype))
    return np.asarray(gaussian.loc, float)[..., 0], np.asarray(gaussian.scale_tril, float)[..., 0, 0]


def _space_limits(dist, t_limits) -> tuple[float, float]:
    """Where s is with a probability of about 99%: the curve's far ends carry no mass and need no room."""
    loc, scale = float(dist.time_loc), float(dist.time_scale)
    t = np.linspace(max(t_limits[0], loc - 2.2 * scale), min(t_limits[1], loc + 2.2 * scale), 101)
    centre, spread = _conditional(dist, t)
    low, high = (centre - 3.2 * spread).min(), (centre + 3.2 * spread).max()
    return float(low), float(high)


def _check_plane(dist) -> None:
    if dist.batch_shape != () or dist.event_shape != (2,):
        got = f"batch_shape {dist.batch_shape} and event_shape {dist.event_shape}"
        cure = "Take one element of a batch, or a marginal of one space coordinate and time."
        raise invalid("dist", expected="batch_shape () and event_shape (2,)", got=got, cure=cure)


def needed_pyplot(caller: str):
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise ImportError(f"{caller} needs matplotlib: pip install 'foldgauss[plot]'.") from error
    return pyplot
