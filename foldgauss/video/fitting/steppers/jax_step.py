"""One step of a fit as a function of arrays, in pure JAX: the twin of `CpuStepper.step` for any device.

Arrays have rows for the largest number of Gaussians that there may be; rows after the first `num` are unused: they
render nothing and do not learn. A step is one program, to which the arrays are donated; nothing in it calls the host.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from foldgauss.render import RenderOptions, Splats2D, render
from foldgauss.render.tiles import find_visible
from foldgauss.video.fitting.adam import masked_adam, update_frame_times, update_paths
from foldgauss.video.fitting.config import Loss
from foldgauss.video.fitting.state import (
    PATH_ARRAYS,
    SIZE_STRIDE,
    DeviceArrays,
    FitState,
    Sizes,
    envelope_of,
    frame_times,
    measure_relative_size,
)
from foldgauss.video.fitting.steppers.jax_loss import compute_losses
from foldgauss.video.fitting.steppers.loss import border_weights
from foldgauss.video.models.row_layout import columns, unpack
from foldgauss.video.models.shared_paths import move_splats
from foldgauss.video.models.splats import TAU_MAX


class Control(NamedTuple):
    """What differs between steps."""

    views: Int[Array, " batch"]  # of `schedule.choose_views`
    num: Int[Array, ""]  # rows in use
    squared: Bool[Array, ""]  # which loss
    rates: Float[Array, " width"]
    time_rate: Float[Array, ""]
    path_rate: Float[Array, ""]
    interpolated: "InterpolatedViews | None" = None  # where the fit interpolates frames


class InterpolatedViews(NamedTuple):
    """The views of a step whose targets are interpolated, see `interpolated_frames`."""

    fractions: Float[Array, " batch"]  # of the way from frame k to the next; negative: the view is the frame itself
    targets: Float[Array, "batch height width 3"]  # values in [0, 1]


class Report(NamedTuple):
    """What is fetched after each step."""

    loss: Float[Array, ""]
    num_alive: Int[Array, ""]
    finite_rows: Bool[Array, ""]
    finite_second: Bool[Array, ""]
    frame_errors: Float[Array, " num_frames"]
    time_logits: Float[Array, " intervals"]
    path_maps: Float[Array, "num_frames paths 2 3"]


@dataclasses.dataclass(frozen=True)
class Program:
    """All that a step is compiled for."""

    capacity: int
    num_frames: int
    size: tuple[int, int]  # of the images
    degree: int
    power: float
    floor: float
    scale_cutoff: float
    compositing: str
    options: RenderOptions
    engine: str
    loss: Loss
    own_loss: Callable[[Array, Array], Array] | None  # of `register_loss`
    batch_size: int
    sparse_updates: bool
    nu: float
    own_units: bool
    learns_times: bool
    grows: bool
    interpolates: bool
    num_paths: int = 0  # that Gaussians share

    @property
    def num_trained(self) -> int:
        """Columns of a row that learn."""
        return columns(self.degree)["coefficients"].stop

    @property
    def width(self) -> int:
        """Of a row."""
        return self.num_trained + (self.num_paths > 0)


@functools.lru_cache(maxsize=8)
def compile_step(program: Program) -> jax.stages.Compiled:
    """The compiled step: called with `(arrays, frames, control)` it returns `(arrays, report)`.

    `arrays` are donated: they cannot be used after the call. `frames` is uint8 (num_frames, *program.size, 3).
    """
    return lower_step(program).compile()


def lower_step(program: Program, platforms: tuple[str, ...] | None = None) -> jax.stages.Lowered:
    """The step before it is compiled; for `platforms`, by default those of this machine."""
    traced = jax.jit(functools.partial(step, program), donate_argnums=0).trace(*_specs(program))
    return traced.lower(lowering_platforms=platforms)


def array_specs(program: Program) -> DeviceArrays:
    """Shapes and types of the arrays."""
    sizes = Sizes(program.capacity, program.width, program.num_frames, program.grows, paths=program.num_paths)
    return DeviceArrays(*(kind.spec(sizes) for kind in FitState.array_fields().values()))


def _specs(program: Program) -> tuple[DeviceArrays, jax.ShapeDtypeStruct, Control]:
    def spec(*shape: int, dtype=np.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, dtype)

    views, num = spec(program.batch_size, dtype=np.int32), spec(dtype=np.int32)
    interpolated = None
    if program.interpolates:
        interpolated = InterpolatedViews(spec(program.batch_size), spec(program.batch_size, *program.size, 3))
    control = Control(views, num, spec(dtype=np.bool_), spec(program.num_trained), spec(), spec(), interpolated)
    return array_specs(program), spec(program.num_frames, *program.size, 3, dtype=np.uint8), control


# --------------------------------------------------------------------------------------------- the step


def step(program: Program, arrays: DeviceArrays, frames: UInt8[Array, "frames height width 3"], control: Control):
    """The arrays after a step, and its `Report`."""
    times = frame_times(arrays.time_logits)
    seen = _differentiate(program, arrays.rows, arrays.path_maps, times, frames, control)
    if program.grows:
        shown, at = seen.screen >= 0, columns(program.degree)["time_loc_logit"].start  # as `GradientStatistics.add`
        arrays = arrays._replace(
            screen_gradients=arrays.screen_gradients + jnp.where(shown, seen.screen, 0),
            time_gradients=arrays.time_gradients + jnp.where(shown, jnp.abs(seen.by_rows[:, at]), 0),
            seen=arrays.seen + shown.astype(jnp.int32),
        )
    used = jnp.arange(program.capacity, dtype=jnp.int32) < control.num
    touched = seen.alive if program.sparse_updates else used
    moments, before = (arrays.first, arrays.second, arrays.counts), arrays.rows
    rates = jnp.pad(control.rates, (0, program.width - program.num_trained))
    options = {"rounded": arrays.rounded, "nu": program.nu, "own_units": program.own_units}
    rows, first, second, counts = masked_adam(arrays.rows, seen.by_rows, *moments, touched, rates, **options)
    logits, of_times = arrays.time_logits, (arrays.time_count, arrays.time_first, arrays.time_second)
    if program.learns_times:
        logits, of_times = update_frame_times(logits, of_times, seen.by_times, control.time_rate)
    errors = jnp.where(seen.errors >= 0, seen.errors, arrays.frame_errors)
    if program.num_paths:
        scales = before[::SIZE_STRIDE, columns(program.degree)["log_scale"]]
        of_stride = jnp.arange(0, program.capacity, SIZE_STRIDE, dtype=jnp.int32) < control.num
        rate = control.path_rate * measure_relative_size(scales, of_stride, own_units=program.own_units)
        of_paths = tuple(getattr(arrays, name) for name in PATH_ARRAYS)
        of_paths = update_paths(of_paths, seen.by_paths, seen.errors >= 0, rate)
        arrays = arrays._replace(**dict(zip(PATH_ARRAYS, of_paths, strict=True)))
    report = Report(
        loss=seen.loss,
        num_alive=jnp.sum(seen.alive, dtype=jnp.int32),
        finite_rows=jnp.all(jnp.isfinite(rows)),
        finite_second=jnp.all(jnp.isfinite(second)),
        frame_errors=errors,
        time_logits=logits,
        path_maps=arrays.path_maps,
    )
    arrays = arrays._replace(rows=rows, first=first, second=second, counts=counts, frame_errors=errors)
    count, first, second = of_times
    return arrays._replace(time_logits=logits, time_count=count, time_first=first, time_second=second), report


class Gradients(NamedTuple):
    """The loss of a batch, its gradients, and which Gaussians it shows."""

    loss: Float[Array, ""]  # mean over the batch
    by_rows: Float[Array, "capacity width"]
    by_paths: Float[Array, "num_frames paths 2 3"]
    by_times: Float[Array, " num_frames"]
    errors: Float[Array, " num_frames"]  # -1 of frames that are not in the batch
    alive: Bool[Array, " capacity"]
    screen: Float[Array, " capacity"]  # largest screen gradient; -1 of Gaussians that no view shows


def _differentiate(program: Program, rows, path_maps, times, frames, control: Control) -> Gradients:
    """Render the views and differentiate their losses by rows, the frames' maps of paths, and times."""
    k, mirrored = control.views % program.num_frames, control.views >= program.num_frames
    t, target, whole = times[k], frames[k].astype(jnp.float32) * np.float32(1 / 255), jnp.ones(len(k), bool)
    maps = path_maps[k]
    if control.interpolated is not None:
        fractions, targets = control.interpolated
        whole = fractions < 0
        after = jnp.minimum(k + 1, program.num_frames - 1)
        t = jnp.where(whole, t, (1 - fractions) * t + fractions * times[after])
        share = jnp.where(whole, 0, fractions)[:, None, None, None]
        maps = (1 - share) * maps + share * path_maps[after]
        target = jnp.where(whole[:, None, None, None], target, targets)
    alive = jax.vmap(lambda t: find_alive(program, rows, control.num, t))(t)
    target = jnp.where(mirrored[:, None, None, None], target[:, :, ::-1], target)

    def condition(rows, maps, t):
        return jax.vmap(functools.partial(_splats, program, rows))(maps, t, alive, mirrored)

    splats, to_rows = jax.vjp(condition, rows, maps, t)
    # One after another: `vmap` would compute both sides of the engine's branches, a third more time.
    images, to_splats = jax.vjp(functools.partial(jax.lax.map, functools.partial(_render, program)), splats)

    def mean_loss(images):
        own, errors = compute_losses(images, target, control.squared, program.loss.ssim_fraction, program.own_loss)
        return jnp.sum(own) / program.batch_size, errors

    (loss, errors), by_images = jax.value_and_grad(mean_loss, has_aux=True)(images)
    (by_splats,) = to_splats(by_images * border_weights(*program.size, program.loss.border_weight)[None, :, :, None])
    by_rows, by_maps, by_t = to_rows(by_splats)
    return Gradients(
        loss,
        by_rows,
        jnp.zeros_like(path_maps).at[k].add(jnp.where(whole[:, None, None, None], by_maps, 0)),
        jnp.zeros_like(times).at[k].add(jnp.where(whole, by_t, 0)),  # a batch may hold a frame twice
        jnp.full_like(times, -1.0).at[k].max(jnp.where(whole, errors, -1)),
        jnp.any(alive, axis=0),
        _screen_gradient(program, splats, by_splats, alive) if program.grows else jnp.zeros_like(rows[:, 0]),
    )


def find_alive(program: Program, rows, num, t) -> Bool[Array, " capacity"]:
    """Which Gaussians are alive at t: rows in use whose window contains t, see `conditioning.update_windows`."""
    place = columns(program.degree)
    center = jax.nn.sigmoid(rows[:, place["time_loc_logit"].start])
    reach = np.float32(TAU_MAX) * jnp.exp(rows[:, place["log_time_scale"].start])
    alive = (jnp.arange(program.capacity, dtype=jnp.int32) < num) & (center - reach < t) & (t < center + reach)
    if program.scale_cutoff > 0:
        spread = jnp.exp(rows[:, place["log_time_scale"].start])
        log_a = envelope_of(program).log_a(t, time_loc=center, time_scale=spread)
        alive &= rows[:, place["log_scale"]].min(axis=1) + log_a / 2 > math.log(program.scale_cutoff)
    return alive


def _splats(program: Program, rows, maps, t, alive, mirrored) -> Splats2D:
    """The Gaussians at time t in pixels, by `FoldedSplats.at`; those not alive have opacity 0."""
    # The rows of those are replaced, so that their underflow far away in time is in no gradient.
    rows = jnp.where(alive[:, None], rows, jnp.zeros_like(rows))
    splats = unpack(rows, program.degree, envelope_of(program)).at(t)
    if program.num_paths:
        splats = move_splats(splats, rows[:, -1].astype(jnp.int32), maps)
    splats = splats.to_pixels(program.size)
    # The opposite camera sees left for right.
    sign = jnp.where(mirrored, jnp.float32([-1, 1]), jnp.float32([1, 1]))
    offset = jnp.where(mirrored, jnp.float32([program.size[1], 0]), jnp.float32([0, 0]))
    mean, factor = splats.mean * sign[None, :] + offset[None, :], splats.factor * sign[None, :, None]
    return Splats2D(mean, factor, jnp.where(alive, splats.opacity, jnp.zeros_like(splats.opacity)), splats.color)


def _render(program: Program, splats: Splats2D) -> Float[Array, "height width 3"]:
    return render(splats, program.size, compositing=program.compositing, engine=program.engine, options=program.options)


def _screen_gradient(program: Program, splats: Splats2D, by_splats: Splats2D, alive) -> Float[Array, " capacity"]:
    """The largest screen gradient over the views, see `GradientStatistics`; -1 where no view shows the Gaussian."""
    half = np.float32(program.size[::-1]) / 2
    size = jnp.hypot(by_splats.mean[..., 0] * half[0], by_splats.mean[..., 1] * half[1])
    shows = jax.vmap(lambda own: find_visible(own.mean, own.factor, own.opacity, program.size, program.options))(splats)
    return jnp.max(jnp.where(shows & alive, size, jnp.full_like(size, -1.0)), axis=0)


# -------------------------------------------------------------------------------------------------- errors


@functools.lru_cache(maxsize=8)
def compile_error(program: Program) -> jax.stages.Compiled:
    """Compiled: called with `(rows, maps, num, t, frame)`, the mean squared error of the image at t against a frame.

    `maps` (paths, 2, 3) are those of the shared paths at t.
    """
    shapes = (program.capacity, program.width), (program.num_paths, 2, 3), (), (), (*program.size, 3)
    dtypes = np.float32, np.float32, np.int32, np.float32, np.uint8
    specs = (jax.ShapeDtypeStruct(*spec) for spec in zip(shapes, dtypes, strict=True))
    return jax.jit(functools.partial(_measure_error, program)).lower(*specs).compile()


def _measure_error(program: Program, rows, maps, num, t, frame: UInt8[Array, "height width 3"]) -> Float[Array, ""]:
    alive = find_alive(program, rows, num, t)
    image = _render(program, _splats(program, rows, maps, t, alive, jnp.bool_(False)))
    difference = image - frame.astype(jnp.float32) * np.float32(1 / 255)
    return jnp.mean(jnp.mean(difference * difference, axis=1))
