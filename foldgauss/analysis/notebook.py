"""Small figures of distributions and fits for notebooks; nothing is shown where one cannot be made, never an error."""

import functools
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss._numerics.batch import ranked_leaves
from foldgauss.analysis.plot import plot_density, plot_history

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The largest number of components plotted.
_MAX_COMPONENTS = 48
#: The largest number of space coordinates plotted.
_MAX_SPACES = 3
#: Points of the grid along each axis.
_GRID = 120
#: Half the range of time, in time_scales.
_TIME_RANGE = 2.6
#: Half the range of space, in standard deviations.
_SPACE_RANGE = 3.0
#: Half the range of paths, in time_scales.
_PATH_RANGE = 1.5
#: Of the images, in pixels per inch, and their size in inches.
_DPI = 80
_WIDTH = 3.6
_HEIGHT = 2.8
_RED = "#d1242f"


class _Bells(NamedTuple):
    """Normal distributions of time, and at each time of each space coordinate; (num,), (times, num, spaces)."""

    weight: np.ndarray
    time_loc: np.ndarray
    time_scale: np.ndarray
    t: np.ndarray
    center: np.ndarray
    scale: np.ndarray


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
def distribution_png(dist) -> "Figure":
    """Of one space coordinate the density; of more, each against time, and paths in space; of a batch, some."""
    if dist.batch_shape == () and dist.event_shape == (2,):
        figure = _figure(1)
        plot_density(dist, figure.subplots()).set_title(_name(dist), fontsize=9)
        return figure
    size = int(np.prod(dist.batch_shape))
    chosen = np.unique(np.linspace(0, size - 1, min(size, _MAX_COMPONENTS)).round().astype(int))
    note = "" if len(chosen) == size else f", {len(chosen)} of them drawn"
    batch = f", batch {dist.batch_shape}{note}" if dist.batch_shape else ""
    return _drawn(_part(dist, dist.batch_shape, chosen), np.full(len(chosen), 1 / len(chosen)), _name(dist) + batch)


@png_or_none
def mixture_png(mixture: Any) -> "Figure":
    """As of one distribution; of many components the heaviest, of a batch of mixtures the first."""
    weights = np.asarray(mixture.weights, float)
    first = weights.reshape(-1, weights.shape[-1])[0]
    chosen = np.sort(np.argsort(-first, kind="stable")[:_MAX_COMPONENTS])
    text = f"{_name(mixture)}, {len(first):,} components"
    if len(chosen) < len(first):
        text += f", the {len(chosen)} heaviest: {first[chosen].sum():.0%}"
    if mixture.batch_shape:
        text += f", the first of batch {mixture.batch_shape}"
    return _drawn(_part(mixture.components, (*mixture.batch_shape, len(first)), chosen), first[chosen], text)


@png_or_none
def history_png(history: Any) -> "Figure":
    """The course of a fit, against its seconds and its steps."""
    figure = _figure(2, height=2 * _HEIGHT - 1)
    plot_history(history, figure.subplots(2, 2, sharex="col", sharey="row"))
    return figure


def _name(dist: Any) -> str:
    return f"{type(dist).__name__}, d = {dist.event_shape[0]}"


def _figure(columns: int, height: float = _HEIGHT) -> "Figure":
    """Not pyplot's: a notebook would show that one, too."""
    from matplotlib.figure import Figure

    return Figure(figsize=(_WIDTH * columns + 0.4, height), layout="constrained")


def _part(dist, batch: tuple[int, ...], chosen: np.ndarray):
    """Those elements of a batch, counted row by row."""
    batch = batch or (1,)
    at = np.unravel_index(chosen, batch)
    leaves = [
        jnp.asarray(np.broadcast_to(np.asarray(leaf), batch + leaf.shape[leaf.ndim - event :])[at])
        for leaf, event in ranked_leaves(dist)
    ]
    return jax.tree.unflatten(jax.tree.structure(dist), leaves)


def _drawn(dist, weights: np.ndarray, title: str) -> "Figure":
    bells = _bells(dist, weights)
    spaces = bells.center.shape[-1]
    panels = min(spaces, _MAX_SPACES) + (spaces > 1)
    figure = _figure(panels)
    axes = np.atleast_1d(figure.subplots(1, panels))
    for j, ax in zip(range(min(spaces, _MAX_SPACES)), axes, strict=False):
        _draw_time(bells, j, ax)
    if spaces > 1:
        _draw_paths(bells, axes[-1])
    left = f" (the first {_MAX_SPACES} of {spaces} space coordinates)" if spaces > _MAX_SPACES else ""
    figure.suptitle(title + left, fontsize=9)
    return figure


def _bells(dist, weights: np.ndarray) -> _Bells:
    loc, scale = np.asarray(dist.time_loc, float), np.asarray(dist.time_scale, float)
    t = np.linspace((loc - _TIME_RANGE * scale).min(), (loc + _TIME_RANGE * scale).max(), _GRID)
    given = _given(dist, jnp.asarray(t[:, None], dist.loc.dtype))
    return _Bells(weights, loc, scale, t, *(np.asarray(part, float) for part in given))


@jax.jit
def _given(dist, t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Centers and deviations of all space coordinates at times t."""
    gaussian = dist.condition_time(t)
    tril = gaussian.scale_tril
    return gaussian.loc, jnp.sqrt(jnp.sum(tril**2, axis=-1))


def _alive(bells: _Bells, reach: float) -> np.ndarray:
    return np.abs(bells.t[:, None] - bells.time_loc) <= reach * bells.time_scale


def _limits(bells: _Bells, j: int) -> tuple[float, float]:
    alive = _alive(bells, 2.0)
    low, high = (bells.center[..., j] + side * _SPACE_RANGE * bells.scale[..., j] for side in (-1, 1))
    return low[alive].min(), high[alive].max()


def _draw_time(bells: _Bells, j: int, ax: Any) -> None:
    """The density of (t, s_j), exactly: sums of products of normal densities. Its root keeps the tails visible."""
    low, high = _limits(bells, j)
    s, density = np.linspace(low, high, _GRID), np.zeros((_GRID, _GRID))
    for k, weight in enumerate(bells.weight):
        of_time = _normal(bells.t, bells.time_loc[k], bells.time_scale[k])
        density += weight * of_time * _normal(s[:, None], bells.center[:, k, j], bells.scale[:, k, j])
    shade = np.sqrt(density / max(density.max(), 1e-300))
    ax.pcolormesh(bells.t, s, shade, cmap="Blues", vmin=0, vmax=1.3, shading="gouraud", rasterized=True)
    path = np.where(_alive(bells, _PATH_RANGE), bells.center[..., j], np.nan)
    ax.plot(bells.t, path, color=_RED, linewidth=0.9, alpha=0.7)
    name = "space s" if bells.center.shape[-1] == 1 else f"space s[{j}]"
    ax.set(xlabel="time t", ylabel=name, ylim=(low, high), xlim=(bells.t[0], bells.t[-1]))


def _draw_paths(bells: _Bells, ax: Any) -> None:
    """Centers in the plane of the first two space coordinates, darker as time goes by; crosses: one deviation."""
    for k in range(len(bells.weight)):
        alive = _alive(bells, _PATH_RANGE)[:, k]
        x, y = bells.center[alive, k, 0], bells.center[alive, k, 1]
        if not len(x):  # shorter than the grid is fine
            continue
        ax.scatter(x, y, c=bells.t[alive], cmap="Reds", vmin=2 * bells.t[0] - bells.t[-1], vmax=bells.t[-1], s=3)
        now = np.argmin(np.abs(bells.t - bells.time_loc[k]))
        center, scale = bells.center[now, k], bells.scale[now, k]
        ax.errorbar(center[0], center[1], yerr=scale[1], xerr=scale[0], color="#1f4e79", linewidth=0.8)
    ax.set(xlabel="space s[0]", ylabel="space s[1]", title="paths, darker later")
    ax.title.set_fontsize(8)
    ax.margins(0.08)


def _normal(x: np.ndarray, loc: np.ndarray, scale: np.ndarray) -> np.ndarray:
    scale = np.maximum(scale, 1e-30)
    return np.exp(-0.5 * ((x - loc) / scale) ** 2) / scale
