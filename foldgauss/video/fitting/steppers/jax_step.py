"""One step of a fit as a function of arrays, in pure JAX: what `fit._Stepper` does on the CPU, for any device.

Arrays are as long as the most Gaussians that there may be; rows behind the first `num` are in nobody's way: they draw
nothing and do not learn. A step is one program, whose state is donated to it; nothing in it asks the host. Frames of a
batch are shared out over the devices of a mesh, each of which keeps the whole state.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, UInt8

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions, Splats2D, render
from foldgauss.render.tiles import find_visible
from foldgauss.video.fitting.adam import BETA1, BETA2, EPSILON, LASTING_TIME, UNBIAS
from foldgauss.video.fitting.growth import GradientStatistics
from foldgauss.video.fitting.state import TIME_ADAM, frame_times, update_times
from foldgauss.video.fitting.steppers.jax_loss import losses
from foldgauss.video.models.row_layout import columns, unpack
from foldgauss.video.models.sparse_storage import DEGREE_MASK, OPAQUE_BIT, STATIC_BIT
from foldgauss.video.models.splats import TAU_MAX

#: The axis of the mesh that views are shared out over.
VIEWS = "views"


class Arrays(NamedTuple):
    """What a step consumes and gives anew; rows are those of `FitState`, and unused ones."""

    rows: Float[Array, "capacity width"]
    first: Float[Array, "capacity width"]
    second: Float[Array, "capacity width"]
    counts: Int[Array, " capacity"]
    kinds: UInt8[Array, " capacity"]
    frame_errors: Float[Array, " num_frames"]
    time_logits: Float[Array, " intervals"]
    time_moments: optax.OptState
    statistics: GradientStatistics | None  # (capacity,) each; None where Gaussians never grow


class Control(NamedTuple):
    """What a step is told."""

    views: Int[Array, " batch"]  # of `schedule.views_of`
    num: Int[Array, ""]  # rows in use
    squared: Bool[Array, ""]  # which loss
    rates: Float[Array, " width"]
    rate_of_times: Float[Array, ""]


class Figures(NamedTuple):
    """What a step tells, all that is fetched after each."""

    loss: Float[Array, ""]
    error: Float[Array, ""]  # mean squared
    num_alive: Int[Array, ""]
    finite_rows: Bool[Array, ""]
    finite_second: Bool[Array, ""]
    frame_errors: Float[Array, " num_frames"]
    time_logits: Float[Array, " intervals"]


@dataclasses.dataclass(frozen=True)
class Plan:
    """All that a step is compiled for."""

    capacity: int
    num_frames: int
    size: tuple[int, int]  # of the pictures
    aspect: float  # of the frames: height / width
    degree: int
    power: float
    floor: float
    compositing: str
    options: RenderOptions
    engine: str
    ssim_fraction: float
    batch_size: int
    sparse_updates: bool
    unit_time: float  # of `sparse_adam`
    learns_times: bool
    grows: bool
    num_devices: int

    @property
    def width(self) -> int:
        """Of a row."""
        return columns(self.degree)["coefficients"].stop


def mesh_of(plan: Plan) -> Mesh | None:
    """The devices that views are shared out over; None where there is but one."""
    if plan.num_devices == 1:
        return None
    return Mesh(np.array(jax.local_devices()[: plan.num_devices]), (VIEWS,))


def everywhere(plan: Plan) -> NamedSharding | None:
    """The place of arrays that every device has."""
    mesh = mesh_of(plan)
    return None if mesh is None else NamedSharding(mesh, PartitionSpec())


@functools.lru_cache(maxsize=8)
def program(plan: Plan) -> jax.stages.Compiled:
    """The step of a plan, compiled: `program(plan)(arrays, frames, control)` gives `(arrays, figures)`.

    `arrays` are donated: they are no more after the call. `frames` is uint8 (num_frames, *plan.size, 3).
    """
    return lowered(plan).compile()


def lowered(plan: Plan, platforms: tuple[str, ...] | None = None) -> jax.stages.Lowered:
    """The program of a step before it is compiled; for `platforms`, by default those that are here."""
    place = everywhere(plan)
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), _shapes(plan))
    how = {} if place is None else {"out_shardings": place}
    traced = jax.jit(functools.partial(step, plan), donate_argnums=0, **how).trace(*shapes)
    return traced.lower(lowering_platforms=platforms)


def _shapes(plan: Plan) -> tuple[Arrays, jax.ShapeDtypeStruct, Control]:
    def of(*shape: int, dtype=np.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, dtype)

    num, rows, logits = plan.capacity, of(plan.capacity, plan.width), of(plan.num_frames - 1)
    counts = of(num, dtype=np.int32)
    arrays = Arrays(
        rows=rows,
        first=rows,
        second=rows,
        counts=counts,
        kinds=of(num, dtype=np.uint8),
        frame_errors=of(plan.num_frames),
        time_logits=logits,
        time_moments=jax.eval_shape(TIME_ADAM.init, logits),
        statistics=GradientStatistics(of(num), of(num), counts) if plan.grows else None,
    )
    views, one = of(plan.batch_size, dtype=np.int32), of(dtype=np.int32)
    control = Control(views, one, of(dtype=np.bool_), of(plan.width), of())
    return arrays, of(plan.num_frames, *plan.size, 3, dtype=np.uint8), control


# --------------------------------------------------------------------------------------------- the step


def step(plan: Plan, arrays: Arrays, frames: UInt8[Array, "frames height width 3"], control: Control):
    """The arrays after a step, and its `Figures`."""
    times = frame_times(arrays.time_logits)
    seen = _shared_out(plan)(arrays.rows, times, frames, control)
    statistics = arrays.statistics
    if statistics is not None:
        by_time = seen.by_rows[:, columns(plan.degree)["time_loc_logit"].start]
        statistics = _counted(statistics, seen.screen, by_time)
    used = jnp.arange(plan.capacity, dtype=jnp.int32) < control.num
    touched = seen.alive if plan.sparse_updates else used
    moments = arrays.first, arrays.second, arrays.counts
    rows, *moments = adam(
        arrays.rows, seen.by_rows, *moments, touched, control.rates, kinds=arrays.kinds, unit_time=plan.unit_time
    )
    logits, time_moments = arrays.time_logits, arrays.time_moments
    if plan.learns_times:
        logits, time_moments = update_times(logits, time_moments, seen.by_times, control.rate_of_times)
    errors = jnp.where(seen.errors >= 0, seen.errors, arrays.frame_errors)
    figures = Figures(
        loss=seen.loss,
        error=seen.error,
        num_alive=jnp.sum(seen.alive, dtype=jnp.int32),
        finite_rows=jnp.all(jnp.isfinite(rows)),
        finite_second=jnp.all(jnp.isfinite(moments[1])),
        frame_errors=errors,
        time_logits=logits,
    )
    return Arrays(rows, *moments, arrays.kinds, errors, logits, time_moments, statistics), figures


class Seen(NamedTuple):
    """What the views of a batch come to."""

    loss: Float[Array, ""]  # means over the batch
    error: Float[Array, ""]
    by_rows: Float[Array, "capacity width"]
    by_times: Float[Array, " num_frames"]
    errors: Float[Array, " num_frames"]  # -1 of frames that are not in the batch
    alive: Bool[Array, " capacity"]
    screen: Float[Array, " capacity"]  # largest screen gradient; -1 of Gaussians that no view shows


def _shared_out(plan: Plan):
    """`_look`, on one device or on all of them, each with its views."""
    mesh, here = mesh_of(plan), functools.partial(_look, plan)
    if mesh is None:
        return here
    whole, views = PartitionSpec(), PartitionSpec(VIEWS)

    def on_each(rows, times, frames, control):
        own = here(rows, times, frames, control)
        total = functools.partial(jax.lax.psum, axis_name=VIEWS)
        largest = functools.partial(jax.lax.pmax, axis_name=VIEWS)
        return Seen(
            *map(total, (own.loss, own.error, own.by_rows, own.by_times)),
            largest(own.errors),
            largest(own.alive.astype(jnp.int32)) > 0,
            largest(own.screen),
        )

    own = Control(views=views, num=whole, squared=whole, rates=whole, rate_of_times=whole)
    # Its loops make arrays of their own, which the check of what is equal everywhere cannot follow.
    return jax.shard_map(on_each, mesh=mesh, in_specs=(whole, whole, whole, own), out_specs=whole, check_vma=False)


def _look(plan: Plan, rows, times, frames, control: Control) -> Seen:
    """Draw the views, and carry their losses' gradients back to rows and times; sums of a share of the batch."""
    k, mirrored = control.views % plan.num_frames, control.views >= plan.num_frames
    alive = _over(len(k), lambda t: alive_at(plan, rows, control.num, t), times[k])
    target = frames[k].astype(jnp.float32) * np.float32(1 / 255)
    target = jnp.where(mirrored[:, None, None, None], target[:, :, ::-1], target)

    def conditioned(rows, t):
        return _over(len(k), functools.partial(_splats, plan, rows), t, alive, mirrored)

    splats, to_rows = jax.vjp(conditioned, rows, times[k])
    pictures, to_splats = jax.vjp(functools.partial(_over, len(k), functools.partial(_drawn, plan)), splats)

    def mean_loss(pictures):
        own, errors = losses(pictures, target, control.squared, plan.ssim_fraction)
        return jnp.sum(own) / plan.batch_size, errors

    (loss, errors), by_pictures = jax.value_and_grad(mean_loss, has_aux=True)(pictures)
    (by_splats,) = to_splats(by_pictures)
    by_rows, by_t = to_rows(by_splats)
    return Seen(
        loss,
        jnp.sum(errors) / plan.batch_size,
        by_rows,
        jnp.zeros_like(times).at[k].add(by_t),  # a batch may hold a frame twice
        jnp.full_like(times, -1.0).at[k].set(errors),
        jnp.any(alive, axis=0),
        _screen_gradient(plan, splats, by_splats, alive) if plan.grows else jnp.zeros_like(rows[:, 0]),
    )


def _over(num: int, function, *batches):
    """`function` of each of `num` views; of one alone without `vmap`, which would compute both sides of branches."""
    if num == 1:
        out = function(*jax.tree.map(lambda leaf: leaf[0], batches))
        return jax.tree.map(lambda leaf: leaf[None], out)
    return jax.vmap(function)(*batches)


def alive_at(plan: Plan, rows, num, t) -> Bool[Array, " capacity"]:
    """Which Gaussians take part at t: rows in use, whose window holds t, as `conditioning.update_windows` has it."""
    place = columns(plan.degree)
    centre = jax.nn.sigmoid(rows[:, place["time_loc_logit"].start])
    reach = np.float32(TAU_MAX) * jnp.exp(rows[:, place["log_time_scale"].start])
    used = jnp.arange(plan.capacity, dtype=jnp.int32) < num
    return used & (centre - reach < t) & (t < centre + reach)


def _splats(plan: Plan, rows, t, alive, mirrored) -> Splats2D:
    """The Gaussians of time t in pixels, of opacity 0 but for those alive: `FoldedSplats.at`, home of the equation."""
    # Rows of others are replaced, so that what underflows far away in time is in no gradient.
    rows = jnp.where(alive[:, None], rows, jnp.zeros_like(rows))
    envelope = TimeLikelihood(power=np.float32(plan.power), floor=np.float32(plan.floor))
    splats = unpack(rows, plan.degree, envelope).at(t).to_pixels(plan.size, aspect=plan.aspect)
    # The camera opposite sees left for right.
    sign = jnp.where(mirrored, jnp.float32([-1, 1]), jnp.float32([1, 1]))
    offset = jnp.where(mirrored, jnp.float32([plan.size[1], 0]), jnp.float32([0, 0]))
    mean, factor = splats.mean * sign[None, :] + offset[None, :], splats.factor * sign[None, :, None]
    return Splats2D(mean, factor, jnp.where(alive, splats.opacity, jnp.zeros_like(splats.opacity)), splats.color)


def _drawn(plan: Plan, splats: Splats2D) -> Float[Array, "height width 3"]:
    return render(splats, plan.size, compositing=plan.compositing, engine=plan.engine, options=plan.options)


def _screen_gradient(plan: Plan, splats: Splats2D, by_splats: Splats2D, alive) -> Float[Array, " capacity"]:
    """Of `GradientStatistics.add`: the largest over the views; -1 where none shows a Gaussian."""
    half = np.float32(plan.size[::-1]) / 2
    size = jnp.hypot(by_splats.mean[..., 0] * half[0], by_splats.mean[..., 1] * half[1])
    shows = jax.vmap(lambda own: find_visible(own.mean, own.factor, own.opacity, plan.size, plan.options))(splats)
    return jnp.max(jnp.where(shows & alive, size, jnp.full_like(size, -1.0)), axis=0)


def _counted(statistics: GradientStatistics, screen, by_time) -> GradientStatistics:
    """As `GradientStatistics.add`."""
    seen = screen >= 0
    return GradientStatistics(
        statistics.screen + jnp.where(seen, screen, jnp.zeros_like(screen)),
        statistics.time + jnp.where(seen, jnp.abs(by_time), jnp.zeros_like(by_time)),
        statistics.seen + seen.astype(jnp.int32),
    )


def adam(rows, grad, first, second, counts, touched, rates, *, kinds, unit_time: float):
    """`sparse_adam` in JAX: rows, moments and counts after a step on the rows `touched`, (num,) bool.

    `rows`, `grad`, `first`, `second`: float32 (num, width); `counts`: int32 (num,); `rates`: float32 (width,); `kinds`:
    uint8 (num,).
    """
    degree = (rows.shape[1] - columns(0)["coefficients"].start) // 2
    grad = jnp.where(_learns(kinds, degree), grad, jnp.zeros_like(grad))
    counts = counts + touched.astype(counts.dtype)
    unbias = jnp.asarray(UNBIAS)[jnp.minimum(counts, len(UNBIAS) - 1)]
    beta1, beta2, one = np.float32(BETA1), np.float32(BETA2), np.float32(1)
    mean = beta1 * first + (one - beta1) * grad
    square = beta2 * second + (one - beta2) * grad * grad
    own = rates[None, :] * _in_own_time(rows, kinds, degree, unit_time)
    moved = rows - own * mean * unbias[:, :1] / (jnp.sqrt(square * unbias[:, 1:]) + np.float32(EPSILON))
    chosen = touched[:, None]
    return jnp.where(chosen, moved, rows), jnp.where(chosen, mean, first), jnp.where(chosen, square, second), counts


def _learns(kinds: UInt8[Array, " num"], degree: int) -> Bool[Array, "num width"]:
    """Which numbers each row has."""
    place = columns(degree)
    kinds = kinds.astype(jnp.int32)[:, None]
    column = np.arange(place["coefficients"].stop, dtype=np.int32)[None, :]
    of_time = (column == place["time_loc_logit"].start) | (column == place["log_time_scale"].start)
    gone = of_time & ((kinds & STATIC_BIT) > 0)
    gone |= (column == place["opacity_logit"].start) & ((kinds & OPAQUE_BIT) > 0)
    return ~(gone | (column >= place["coefficients"].start + 2 * (kinds & DEGREE_MASK)))


def _in_own_time(rows, kinds, degree: int, unit_time: float) -> Float[Array, "num width"]:
    """What rates are multiplied by: see `config.LearningRates`."""
    factors, place = jnp.ones_like(rows), columns(degree)
    if unit_time == 0:
        return factors
    is_static = (kinds.astype(jnp.int32) & STATIC_BIT) > 0
    spread = jnp.exp(rows[:, place["log_time_scale"].start])
    wide = jnp.where(is_static, np.float32(LASTING_TIME), spread) / np.float32(unit_time)
    factors, power = factors.at[:, place["time_loc_logit"].start].set(wide), jnp.ones_like(wide)
    for column in range(place["coefficients"].start, place["coefficients"].stop, 2):
        power = power * (1 / wide)
        factors = factors.at[:, column : column + 2].set(power[:, None])
    return factors


# ---------------------------------------------------------------------------------------------- looking


@functools.lru_cache(maxsize=8)
def look(plan: Plan) -> jax.stages.Compiled:
    """`look(plan)(rows, num, t, frame)`: the mean squared error of the picture of time t against a frame, compiled."""
    place = everywhere(plan)
    shapes = (plan.capacity, plan.width), (), (), (*plan.size, 3)
    dtypes = np.float32, np.int32, np.float32, np.uint8
    given = (jax.ShapeDtypeStruct(*own, sharding=place) for own in zip(shapes, dtypes, strict=True))
    return jax.jit(functools.partial(_error, plan)).lower(*given).compile()


def _error(plan: Plan, rows, num, t, frame: UInt8[Array, "height width 3"]) -> Float[Array, ""]:
    alive = alive_at(plan, rows, num, t)
    picture = _drawn(plan, _splats(plan, rows, t, alive, jnp.bool_(False)))
    difference = picture - frame.astype(jnp.float32) * np.float32(1 / 255)
    return jnp.mean(jnp.mean(difference * difference, axis=1))
