"""Fused Numba version of `FoldedSplats.at` and its gradient, on packed rows of the Gaussians alive at one time.

The fold equation is defined by `FoldedGaussian.condition_time` and repeated here for speed: these kernels touch only
the Gaussians alive, whose number changes with every frame, unlike XLA's fixed shapes. A test checks that values and
gradients agree. Folds, shared paths and the envelope are those that `FoldedSplats` has.
"""

import collections
import dataclasses
import math
from typing import Any

import jax
import numba as nb
import numpy as np

from foldgauss._numerics.simd import LANES, broadcast, cos_and_sin, exp, load, select, sigmoid, sqrt, store
from foldgauss._runtime.checks import require
from foldgauss._runtime.kernels import inline, kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import Splats2D, pixels_per_unit
from foldgauss.render.splats import check_size
from foldgauss.video.models.renderer import PreparedVideo
from foldgauss.video.models.row_layout import columns, has_path_column, pack
from foldgauss.video.models.shared_paths import (
    SharedPaths,
    check_paths,
    from_pixel_gradient,
    invert_maps,
    to_pixel_maps,
)
from foldgauss.video.models.splats import SH_C0, TAU_MAX

CHUNK = 4096  # Gaussians per task

_f = nb.float32
_u = nb.uint64
#: Outputs of conditioning for each Gaussian: mean 2, factor 4, opacity, color 3, kept 3.
_NUM_OUT = 13


#: Columns of a row by the leaf that begins there, and constants of the model, passed to the kernels as an argument: see
#: `kernels.kernel`.
_Layout = collections.namedtuple("_Layout", [*columns(0), "tau_max", "sh_c0"])
_LAYOUT = _Layout(*(place.start for place in columns(0).values()), np.float32(TAU_MAX), np.float32(SH_C0))


@inline
def _sigmoid(x):
    return _f(1.0) / (_f(1.0) + math.exp(-x))


@kernel
def _windows(at, start, stop, indices, rows, power, floor, cuts, log_cutoff, window):
    """The time windows in which these Gaussians are rendered; `cuts`: those below the cutoff of scales are left out."""
    for k in range(start, stop):
        i, tau = indices[k], at.tau_max
        if cuts:
            smaller = min(rows[i, at.log_scale], rows[i, at.log_scale + 1])
            tau = min(tau, _longest(smaller - log_cutoff, power, floor))
        center, reach = _sigmoid(rows[i, at.time_loc_logit]), tau * math.exp(rows[i, at.log_time_scale])
        window[i, 0] = center - reach
        window[i, 1] = center + reach


@inline
def _longest(margin, power, floor):
    """The largest |tau| with log a(tau) > -2 margin: 0 if no tau satisfies it, infinity if every tau does.

    That is (1 - floor) exp(-power tau^2 / 2) > exp(-2 margin) - floor.
    """
    if margin <= 0:
        return _f(0)
    square = 2 * margin
    if floor > 0:
        # Infinite where the envelope never gets so small.
        square = math.log((1 - floor) / max(math.exp(-2 * margin) - floor, _f(0.0)))
    return _f(math.sqrt(2 * square / power))


@kernel
def _condition(
    at,
    start,
    stop,
    alive,
    rows,
    degree,
    t,
    unit,
    cx,
    cy,
    power,
    floor,
    mean,
    factor,
    opacity,
    color,
    kept,
):
    """Sixteen Gaussians at a time: rows are transposed to vectors, and the results back to rows."""
    width = rows.shape[1]
    columns, out = np.zeros(width * LANES, np.float32), np.empty(_NUM_OUT * LANES, np.float32)
    for begin in range(start, stop, LANES):
        num = _u(min(LANES, stop - begin))
        for e in range(num):
            row = rows[alive[begin + e]]
            for c in range(_u(width)):
                columns[c * _u(LANES) + e] = row[c]
        _condition_vectors(at, columns, degree, t, unit, cx, cy, power, floor, out)
        for e in range(num):
            k = begin + e
            mean[k, 0], mean[k, 1] = out[e], out[_u(LANES) + e]
            factor[k, 0, 0], factor[k, 0, 1] = out[_u(2 * LANES) + e], out[_u(3 * LANES) + e]
            factor[k, 1, 0], factor[k, 1, 1] = out[_u(4 * LANES) + e], out[_u(5 * LANES) + e]
            opacity[k] = out[_u(6 * LANES) + e]
            for c in range(_u(3)):
                color[k, c], kept[k, c] = out[(_u(7) + c) * _u(LANES) + e], out[(_u(10) + c) * _u(LANES) + e]


@inline
def _column(columns, c):
    return load(columns, _u(c) * _u(LANES))


@kernel
def _condition_vectors(at, columns, degree, t, unit, cx, cy, power, floor, out):
    none, scale = broadcast(_f(0.0)), broadcast(unit)
    center, spread = sigmoid(_column(columns, at.time_loc_logit)), exp(_column(columns, at.log_time_scale))
    u = center - broadcast(t)
    x, y = none, none
    for j in range(degree - 1, -1, -1):  # Horner
        x = u * (x + _column(columns, at.coefficients + 2 * j))
        y = u * (y + _column(columns, at.coefficients + 2 * j + 1))
    store(out, _u(0), (_column(columns, at.loc) + x) * scale + broadcast(cx))
    store(out, _u(LANES), (_column(columns, at.loc + 1) + y) * scale + broadcast(cy))
    tau = u / spread
    exponent = broadcast(_f(-0.25) * power) * tau * tau  # of sqrt(a) without the floor
    if floor == _f(0.0):
        first = exp(_column(columns, at.log_scale) + exponent) * scale
        second = exp(_column(columns, at.log_scale + 1) + exponent) * scale
    else:
        shrink = sqrt(broadcast(floor) + broadcast(_f(1.0) - floor) * exp(exponent + exponent)) * scale
        first, second = exp(_column(columns, at.log_scale)) * shrink, exp(_column(columns, at.log_scale + 1)) * shrink
    turn = sigmoid(_column(columns, at.angle_logit))
    cos, sin = cos_and_sin(turn)
    store(out, _u(2 * LANES), cos * first)
    store(out, _u(3 * LANES), none - sin * second)
    store(out, _u(4 * LANES), sin * first)
    store(out, _u(5 * LANES), cos * second)
    store(out, _u(6 * LANES), sigmoid(_column(columns, at.opacity_logit)))
    for c in range(_u(3)):
        value = broadcast(_f(0.5)) + broadcast(at.sh_c0) * _column(columns, at.color_dc + c)
        store(out, (_u(7) + c) * _u(LANES), select(value < none, none, value))
    store(out, _u(10 * LANES), center)
    store(out, _u(11 * LANES), spread)
    store(out, _u(12 * LANES), turn)


@kernel
def _pull_back(
    at,
    start,
    stop,
    alive,
    rows,
    degree,
    t,
    unit,
    power,
    floor,
    factor,
    opacity,
    color,
    kept,
    d_mean,
    d_factor,
    d_opacity,
    d_color,
    grad,
):
    """Add the gradient of each Gaussian's row to `grad`; returns dL/dt over start..stop."""
    d_time = 0.0
    for k in range(start, stop):
        i = alive[k]
        row, out = rows[i], grad[i]
        gx, gy = d_mean[k, 0] * unit, d_mean[k, 1] * unit
        out[at.loc] += gx
        out[at.loc + 1] += gy
        center, spread, turn = kept[k, 0], kept[k, 1], kept[k, 2]
        u = center - t
        # Fold: dL/dc_j = g u^j, and dL/du by the derivative of the polynomial.
        d_u, u_power = _f(0.0), _f(1.0)
        for j in range(degree):
            d_u += _f(j + 1) * u_power * (gx * row[at.coefficients + 2 * j] + gy * row[at.coefficients + 2 * j + 1])
            u_power *= u
            out[at.coefficients + 2 * j] += gx * u_power
            out[at.coefficients + 2 * j + 1] += gy * u_power
        # Scales and angle, from the columns of F = R diag(scales).
        by_first = d_factor[k, 0, 0] * factor[k, 0, 0] + d_factor[k, 1, 0] * factor[k, 1, 0]
        by_second = d_factor[k, 0, 1] * factor[k, 0, 1] + d_factor[k, 1, 1] * factor[k, 1, 1]
        out[at.log_scale] += by_first
        out[at.log_scale + 1] += by_second
        by_angle = d_factor[k, 1, 0] * factor[k, 0, 0] - d_factor[k, 0, 0] * factor[k, 1, 0]
        by_angle += d_factor[k, 1, 1] * factor[k, 0, 1] - d_factor[k, 0, 1] * factor[k, 1, 1]
        out[at.angle_logit] += by_angle * _f(2 * math.pi) * turn * (_f(1.0) - turn)
        # Envelope: -tau^2/2 moves with u and with the spread.
        tau = u / spread
        square, slope = tau * tau, _f(0.5) * power
        if floor > _f(0.0):
            decay = (_f(1.0) - floor) * math.exp(_f(-0.5) * power * square)
            slope *= decay / (floor + decay)
        by_exponent = (by_first + by_second) * slope
        out[at.log_time_scale] += by_exponent * square
        d_u -= by_exponent * tau / spread
        out[at.time_loc_logit] += d_u * center * (_f(1.0) - center)
        d_time -= d_u
        out[at.opacity_logit] += d_opacity[k] * opacity[k] * (_f(1.0) - opacity[k])
        for c in range(3):
            if color[k, c] > _f(0.0):
                out[at.color_dc + c] += d_color[k, c] * at.sh_c0
    return d_time


@kernel
def _move(start, stop, alive, rows, maps, mean, factor):
    """Move splats by the maps of their paths, in place."""
    place = rows.shape[1] - 1
    for k in range(start, stop):
        path = _u(rows[alive[k], place])
        if path == 0:
            continue
        m = maps[path]
        x, y = mean[k, 0], mean[k, 1]
        mean[k, 0] = m[0, 0] * x + m[0, 1] * y + m[0, 2]
        mean[k, 1] = m[1, 0] * x + m[1, 1] * y + m[1, 2]
        for c in range(2):
            x, y = factor[k, 0, c], factor[k, 1, c]
            factor[k, 0, c] = m[0, 0] * x + m[0, 1] * y
            factor[k, 1, c] = m[1, 0] * x + m[1, 1] * y


@kernel
def _move_back(start, stop, alive, rows, maps, inverse, moved_mean, moved_factor, factor, d_mean, d_factor, by_map):
    """Gradients of splats before `_move`, and those by the maps; factors as they were before.

    `d_mean` and `d_factor` come in as gradients of the moved splats, and are changed in place.
    """
    place, summed = rows.shape[1] - 1, _u(0)
    xx, xy, x1, yx, yy, y1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # by the map of the path `summed`
    for k in range(start, stop):
        path = _u(rows[alive[k], place])
        gx, gy = d_mean[k, 0], d_mean[k, 1]
        fxx, fxy, fyx, fyy = d_factor[k, 0, 0], d_factor[k, 0, 1], d_factor[k, 1, 0], d_factor[k, 1, 1]
        m, w = maps[path], inverse[path]
        x, y = moved_mean[k, 0], moved_mean[k, 1]
        x, y = w[0, 0] * x + w[0, 1] * y + w[0, 2], w[1, 0] * x + w[1, 1] * y + w[1, 2]
        a, b, c, d = moved_factor[k, 0, 0], moved_factor[k, 0, 1], moved_factor[k, 1, 0], moved_factor[k, 1, 1]
        a, c = w[0, 0] * a + w[0, 1] * c, w[1, 0] * a + w[1, 1] * c
        b, d = w[0, 0] * b + w[0, 1] * d, w[1, 0] * b + w[1, 1] * d
        factor[k, 0, 0], factor[k, 0, 1], factor[k, 1, 0], factor[k, 1, 1] = a, b, c, d
        if path != summed:
            out = by_map[summed]
            out[0, 0], out[0, 1], out[0, 2] = out[0, 0] + xx, out[0, 1] + xy, out[0, 2] + x1
            out[1, 0], out[1, 1], out[1, 2] = out[1, 0] + yx, out[1, 1] + yy, out[1, 2] + y1
            xx, xy, x1, yx, yy, y1, summed = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, path
        xx, xy, x1 = xx + gx * x + fxx * a + fxy * b, xy + gx * y + fxx * c + fxy * d, x1 + gx
        yx, yy, y1 = yx + gy * x + fyx * a + fyy * b, yy + gy * y + fyx * c + fyy * d, y1 + gy
        d_mean[k, 0], d_mean[k, 1] = m[0, 0] * gx + m[1, 0] * gy, m[0, 1] * gx + m[1, 1] * gy
        d_factor[k, 0, 0], d_factor[k, 0, 1] = m[0, 0] * fxx + m[1, 0] * fyx, m[0, 0] * fxy + m[1, 0] * fyy
        d_factor[k, 1, 0], d_factor[k, 1, 1] = m[0, 1] * fxx + m[1, 1] * fyx, m[0, 1] * fxy + m[1, 1] * fyy
    out = by_map[summed]
    out[0, 0], out[0, 1], out[0, 2] = out[0, 0] + xx, out[0, 1] + xy, out[0, 2] + x1
    out[1, 0], out[1, 1], out[1, 2] = out[1, 0] + yx, out[1, 1] + yy, out[1, 2] + y1


@dataclasses.dataclass(frozen=True)
class ConditionedSplats:
    """Splats of one time, in pixels, of the Gaussians `alive` (indices, in array order)."""

    alive: np.ndarray
    t: np.float32
    unit: np.float32
    mean: np.ndarray
    factor: np.ndarray
    opacity: np.ndarray
    color: np.ndarray
    kept: np.ndarray  # (num, 3), for the gradient: m_t, sigma_t and the angle in turns
    maps: np.ndarray | None = None  # (paths + 1, 2, 3), by which those on a path were moved


@dataclasses.dataclass(frozen=True)
class ConditioningSpec:
    """Constants of conditioning: the fold's degree, the envelope's power and floor, and the image's size.

    `aspect` is the model frame's height / width (default: the image's own), see `Splats2D.to_pixels`. `paths`: NumPy
    arrays, for rows with a column of `path_index`. `scale_cutoff`: Gaussians are alive only where both standard
    deviations, shrunk by the envelope, exceed it, in model units.
    """

    degree: int
    power: float
    floor: float
    size: tuple[int, int]
    aspect: float | None = None
    paths: SharedPaths | None = None
    scale_cutoff: float = 0.0


def update_windows(rows: np.ndarray, indices: np.ndarray, window: np.ndarray, spec: ConditioningSpec) -> None:
    """Write the time windows of the rows `indices` into `window` (num, 2)."""
    num, cuts = len(indices), spec.scale_cutoff > 0
    own = spec.power, spec.floor, cuts, math.log(spec.scale_cutoff) if cuts else 0.0
    run_tasks(
        lambda start: _windows(_LAYOUT, start, min(start + CHUNK, num), indices, rows, *own, window),
        range(0, num, CHUNK),
    )


def find_windows(rows: np.ndarray, spec: ConditioningSpec) -> np.ndarray:
    """The time windows of all rows, float32 (num, 2)."""
    window = np.empty((len(rows), 2), np.float32)
    update_windows(rows, np.arange(len(rows)), window, spec)
    return window


def condition(
    rows: np.ndarray, window: np.ndarray, t: float, spec: ConditioningSpec, members: np.ndarray | None = None
) -> ConditionedSplats:
    """The Gaussians whose window holds t, of those with `members` (num,) if given, conditioned on t, in pixels."""
    t = np.float32(t)
    near = (window[:, 0] < t) & (t < window[:, 1])
    alive = np.flatnonzero(near if members is None else near & members)
    num, (height, width) = len(alive), spec.size
    unit = np.float32(pixels_per_unit(spec.size, aspect=spec.aspect))
    mean, factor = np.empty((num, 2), np.float32), np.empty((num, 2, 2), np.float32)
    opacity, (color, kept) = np.empty(num, np.float32), np.empty((2, num, 3), np.float32)
    constants = np.float32([width / 2, height / 2, spec.power, spec.floor])
    moves = spec.paths is not None and has_path_column(rows, spec.degree)
    maps = to_pixel_maps(spec.paths.at(float(t)), float(unit), np.array([width / 2, height / 2])) if moves else None

    def work(start: int) -> None:
        stop = min(start + CHUNK, num)
        splats = (mean, factor, opacity, color, kept)
        _condition(_LAYOUT, start, stop, alive, rows, spec.degree, t, unit, *constants, *splats)
        if maps is not None:
            _move(start, stop, alive, rows, maps, mean, factor)

    run_tasks(work, range(0, num, CHUNK))
    return ConditionedSplats(alive, t, unit, mean, factor, opacity, color, kept, maps)


def mirror(mean: np.ndarray, factor: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Splats in pixels as the opposite camera sees them, left for right; with width 0 the transpose, for gradients."""
    return np.stack([np.float32(width) - mean[:, 0], mean[:, 1]], 1), factor * np.float32([[-1], [1]])


def backpropagate(
    rows: np.ndarray,
    done: ConditionedSplats,
    gradients: tuple[np.ndarray, ...],
    spec: ConditioningSpec,
    grad: np.ndarray,
    path_grad: np.ndarray | None = None,
) -> float:
    """Add the gradients of mean, factor, opacity and color, as gradients of rows, to `grad`; returns dL/dt.

    dL/dt is that with the maps of shared paths as they are at t. Gradients by these maps, in model space, are added to
    `path_grad` (paths, 2, 3).
    """
    num, starts = len(done.alive), range(0, len(done.alive), CHUNK)
    by_time = np.zeros(len(starts))
    power, floor = np.float32(spec.power), np.float32(spec.floor)
    factor, (d_mean, d_factor, *others) = done.factor, gradients
    if done.maps is not None:
        factor = np.empty_like(done.factor)
        d_mean, d_factor = np.array(d_mean, np.float32), np.array(d_factor, np.float32)
        by_map, inverse = np.zeros((len(by_time), *done.maps.shape)), invert_maps(done.maps)

    def work(start: int) -> None:
        stop = min(start + CHUNK, num)
        if done.maps is not None:
            own, by = (factor, d_mean, d_factor), by_map[start // CHUNK]
            _move_back(start, stop, done.alive, rows, done.maps, inverse, done.mean, done.factor, *own, by)
        by_time[start // CHUNK] = _pull_back(
            _LAYOUT,
            start,
            stop,
            done.alive,
            rows,
            spec.degree,
            done.t,
            done.unit,
            power,
            floor,
            factor,
            done.opacity,
            done.color,
            done.kept,
            d_mean,
            d_factor,
            *others,
            grad,
        )

    run_tasks(work, starts)
    if done.maps is not None and path_grad is not None:
        height, width = spec.size
        path_grad += from_pixel_gradient(by_map.sum(0), float(done.unit), np.array([width / 2, height / 2]))
    return float(by_time.sum())


def check_renderable(model: Any, num_broken: int) -> None:
    """Raise ValueError if frame times or any Gaussian have NaN or infinities, for envelopes, and as `check_paths`."""
    require(
        not num_broken and np.isfinite(model.frame_times.logits).all(),
        "model",
        expected="finite numbers",
        got=f"others in {num_broken:,} Gaussians" if num_broken else "others in its frame times",
        cure="The fit diverged, or the model was edited: fit again.",
    )
    dataclasses.replace(model.splats, envelope=dataclasses.replace(model.splats.envelope))  # which have their checks
    check_paths(model.splats)


class PreparedModel(PreparedVideo):
    """The Gaussians of a `VideoModel`, ready to be conditioned on any time, in pixels of an image of `size`.

    `aspect` is the height / width of the frame that covers the image (default: the model's).

    **Example:** `PreparedModel(model, (160, 320)).splats(0.5)`.

    **Source:** VeGaS eq:vegas_equiv_cond. **Raises:** ValueError for an invalid size, and for a model with NaN or
    infinities.
    """

    def __init__(self, model: Any, size: tuple[int, int], *, aspect: float | None = None):
        check_size(size)
        height, width = model.size
        self.rows = pack(model.splats)
        check_renderable(model, int((~np.isfinite(self.rows)).any(-1).sum()))
        self.spec = ConditioningSpec(
            model.splats.degree,
            float(model.splats.envelope.power),
            float(model.splats.envelope.floor),
            tuple(size),
            aspect=height / width if aspect is None else aspect,
            paths=jax.tree.map(np.asarray, model.splats.paths),
            scale_cutoff=model.scale_cutoff,
        )
        self.window = find_windows(self.rows, self.spec)
        self.times = np.asarray(model.frame_times.times())

    def at(self, t: float, members: np.ndarray | None = None) -> ConditionedSplats:
        """The Gaussians alive at time t, also outside [0, 1]; of `members`, bool (num_gaussians,), if given."""
        return condition(self.rows, self.window, t, self.spec, members)

    def splats(self, t: float) -> Splats2D:
        """The splats of the Gaussians alive at time t, front to back; NumPy leaves."""
        done = self.at(t)
        return Splats2D(done.mean, done.factor, done.opacity, done.color)
