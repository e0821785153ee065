"""`JaxStepper`: the steps of a fit on JAX's default device, where arrays and frames stay between steps.

After each step only `jax_step.Report` is fetched, some hundred numbers. All arrays are fetched by `FitState.fetch_all`
alone: for controls, such as densification and relocation, which run on the host, for checkpoints and for models.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss.video.fitting.config import FitConfig, chosen_num_gaussians, most_gaussians
from foldgauss.video.fitting.losses import LOSSES
from foldgauss.video.fitting.schedule import (
    choose_start_frames,
    find_views_in_turn,
    learning_rates,
)
from foldgauss.video.fitting.state import STATISTICS, DeviceArrays, FitState, StepResult, frame_times
from foldgauss.video.fitting.steppers.interpolated_frames import Prefetcher, choose_targets, make_interpolated
from foldgauss.video.fitting.steppers.jax_step import (
    Control,
    InterpolatedViews,
    Program,
    array_specs,
    compile_error,
    compile_step,
)
from foldgauss.video.motion.optical_flow import Motion, motion_finder

#: A fit whose growth has no limit that it could reach has capacity for so many times the Gaussians of its start; where
#: that is not enough it doubles, and steps are compiled anew.
CAPACITY_FACTOR = 2
#: Capacities of compact fits for each doubling of the number of Gaussians.
CAPACITY_STEPS = 4
#: Interpolated frames are prepared so many steps ahead: one takes some tenths of a second, a step on a GPU some ms.
STEPS_AHEAD = 64
#: Arrays of a state that every step fetches: they are small, and it is by them that a fit is watched.
ON_HOST = ("frame_errors", "time_logits", "path_maps")
_FIELDS = FitState.array_fields()


class HeldArrays:
    """The arrays of a `FitState` on a device. The next step consumes them.

    `on_host`: the arrays named in `ON_HOST`, on the host; they are read-only, since the next step would discard a
    change in place. `finite`: whether all values of `rows` and of `second` are finite.
    """

    def __init__(
        self,
        arrays: DeviceArrays,
        num: int,
        growing: bool,
        on_host: dict[str, np.ndarray],
        finite: dict[str, bool],
    ):
        self.arrays, self.num, self.growing, self.on_host, self.finite = arrays, num, growing, on_host, finite

    def fetch(self, name: str) -> np.ndarray:
        """A field of `FitState`, a copy."""
        array = np.array(getattr(self.arrays, name))
        if name in STATISTICS:
            return array[: self.num if self.growing else 0].copy()
        return array[: self.num].copy() if _FIELDS[name].per_gaussian else array

    def copy(self) -> "HeldArrays":
        """A copy on the device, which later steps do not change."""
        return HeldArrays(
            jax.tree.map(lambda leaf: leaf.copy(), self.arrays), self.num, self.growing, self.on_host, self.finite
        )


class JaxStepper:
    """The methods of `CpuStepper` on JAX's default device.

    The program is compiled when it is made, before any clock runs, and the frames are kept on the device, as bytes.
    """

    def __init__(
        self,
        frames: np.ndarray,
        config: FitConfig,
        state: FitState,
        engine: str,
        find_motion: Callable[[], Motion] | None = None,
    ):
        self.frames, self.config, self.engine = frames, config, engine
        self.num_frames, *size = frames.shape[:3]
        self.size = tuple(size)
        self.interpolation = make_interpolated(frames, config, find_motion or motion_finder(frames))
        self.prefetcher = None if self.interpolation is None else Prefetcher(self.interpolation)
        self._prepared = 0  # steps
        self._no_targets: jax.Array | None = None
        self.capacity = 0
        self.adopt(state)
        self.images = jax.device_put(frames)

    def adopt(self, state: FitState) -> None:
        """Move a state's arrays to the device, padded to the capacity."""
        num = state.num_gaussians
        self.num_paths = state.path_maps.shape[1]
        capacity = self._choose_capacity(num)
        if capacity != self.capacity:
            self.capacity = capacity
            self.program = self._make_program()
            compile_step(self.program)
            if state.step == 0 and self.config.initialization != "uniform":
                compile_error(self.program)
        # Where growth has ended there are statistics nevertheless: without, steps would be compiled anew.
        specs = array_specs(self.program)._asdict()
        arrays = DeviceArrays(*(_pad(getattr(state, name), spec) for name, spec in specs.items()))
        # Copied, since arrays that are donated must be the device's own.
        arrays = jax.tree.map(lambda leaf: leaf.copy(), jax.device_put(arrays))
        held = HeldArrays(
            arrays,
            num,
            state.growing,
            on_host={name: np.asarray(jnp.array(getattr(state, name))) for name in ON_HOST},
            finite={name: state.is_finite(name) for name in ("rows", "second")},
        )
        state.hold(held)

    def step(self, state: FitState, progress: float) -> StepResult:
        if state.held is None or state.changed:  # by an observer of the fit
            state.fetch_all()
            self.adopt(state)
        held, config = state.held, self.config
        rates, time_rate, path_rate = learning_rates(config, progress, state.backoffs)
        views, fractions = choose_targets(self.interpolation, config, self.num_frames, state, progress)
        control = Control(
            views=views.astype(np.int32),
            num=np.int32(held.num),
            squared=np.bool_(progress >= config.squared_from),
            rates=rates,
            time_rate=time_rate,
            path_rate=path_rate,
            interpolated=self._interpolate(views, fractions, state.step),
        )
        self._prepare(state, progress)
        arrays, report = compile_step(self.program)(held.arrays, self.images, control)
        report = jax.device_get(report)
        held = HeldArrays(
            arrays,
            held.num,
            state.growing,
            on_host={name: getattr(report, name) for name in ON_HOST},
            finite={"rows": bool(report.finite_rows), "second": bool(report.finite_second)},
        )
        state.hold(held)
        return StepResult(float(report.loss), int(report.num_alive), held.finite["rows"])

    def _interpolate(self, views: np.ndarray, chosen: list[float | None], step: int) -> InterpolatedViews | None:
        """The interpolated targets of a step; None if the fit has none at all."""
        if self.interpolation is None:
            return None
        fractions = np.full(len(views), -1.0, np.float32)
        targets = np.zeros((len(views), *self.size, 3), np.float32)
        for n, (k, fraction) in enumerate(zip(views % self.num_frames, chosen, strict=True)):
            if fraction is not None:
                fractions[n], targets[n] = fraction, self.prefetcher.interpolate(step, int(k), fraction)
        if (fractions < 0).all():  # the device has zeros already
            if self._no_targets is None:
                self._no_targets = jax.device_put(targets)
            targets = self._no_targets
        return InterpolatedViews(fractions, targets)

    def _prepare(self, state: FitState, progress: float) -> None:
        """Have the interpolated frames of the next steps prepared."""
        if self.prefetcher is None:
            return
        self.prefetcher.drop(state.step)
        self._prepared = max(state.step + 1, self._prepared)
        for step in range(self._prepared, state.step + 1 + STEPS_AHEAD):
            views, drawn = find_views_in_turn(self.config, self.num_frames, step)
            if not self.prefetcher.prepare(step, progress, (views[~drawn] % self.num_frames).tolist()):
                break
            self._prepared = step + 1

    def measure_start(self, state: FitState) -> dict[int, float]:
        arrays, num = state.held.arrays, np.int32(state.held.num)
        times = np.asarray(frame_times(state.time_logits))
        error = compile_error(self.program)
        chosen = choose_start_frames(self.num_frames)
        return {int(k): float(error(arrays.rows, arrays.path_maps[k], num, times[k], self.frames[k])) for k in chosen}

    def _choose_capacity(self, num: int) -> int:
        """Rows of the arrays: a function of the number of Gaussians, so that a resumed fit has the same."""
        config = self.config
        if config.strategy.growth is None:
            if not config.is_compact:
                return num
            # Gaussians that are not worth their bits are dropped: not each time a program for another number.
            return math.ceil(2 ** (math.ceil(CAPACITY_STEPS * math.log2(num)) / CAPACITY_STEPS))
        most = max(most_gaussians(config), num)
        if config.max_gaussians is not None:
            return most
        capacity = CAPACITY_FACTOR * chosen_num_gaussians(config, self.num_frames, *self.size)
        while capacity < num:
            capacity *= 2
        return min(capacity, most)

    def _make_program(self) -> Program:
        config = self.config
        return Program(
            capacity=self.capacity,
            num_frames=self.num_frames,
            size=self.size,
            degree=config.fold_degree,
            power=config.power,
            floor=config.floor,
            scale_cutoff=config.strategy.scale_cutoff,
            compositing=config.compositing,
            options=config.options,
            engine=self.engine,
            loss=config.loss,
            own_loss=LOSSES[config.loss.name],
            batch_size=config.views.batch_size,
            sparse_updates=config.strategy.sparse_updates,
            nu=config.rates.nu,
            own_units=config.rates.own_units,
            learns_times=config.learns_frame_times and self.num_frames > 2,
            grows=config.strategy.growth is not None,
            interpolates=self.interpolation is not None,
            num_paths=self.num_paths,
        )


def _pad(array: np.ndarray, spec: jax.ShapeDtypeStruct) -> np.ndarray:
    """The array with zero rows up to the capacity."""
    out = np.zeros(spec.shape, spec.dtype)
    out[tuple(map(slice, array.shape))] = array
    return out
