"""Fits whose steps stay on a JAX device: which engine computes a fit, and the stepper that holds arrays and frames.

Between two steps only `device_step.Figures` are fetched, some hundred numbers. All arrays are fetched where somebody
reads them of the state, and where Gaussians are born and die, which `population` does on the host.
"""

import time

import jax
import numpy as np

from foldgauss.video.fitting.codebook import Codebook
from foldgauss.video.fitting.config import UNIT_TIME, FitConfig, chosen_num_gaussians, most_gaussians
from foldgauss.video.fitting.densify import changes_at, grow
from foldgauss.video.fitting.growth import GradientStatistics
from foldgauss.video.fitting.schedule import Rates, levels, looked_at, shrunk, steps_per_pass, views_of
from foldgauss.video.fitting.state import FitState, frame_times
from foldgauss.video.fitting.steppers.jax_step import Arrays, Control, Figures, Plan, everywhere, look, program

#: Of a fit that grows without a bound that it could reach: room for so many times the Gaussians of its start, and
#: twice as much whenever that is not enough, for which steps are compiled anew.
ROOM = 4


def _seen_at(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Frames at a level's size."""
    return frames if frames.shape[1:3] == size else np.stack([shrunk(frame, size) for frame in frames])


class OnDevice:
    """What a `FitState` holds on a device: `state.Held`. The next step consumes it."""

    def __init__(self, arrays: Arrays, num: int, growing: bool, figures: Figures | None):
        self.arrays, self.num, self.growing, self.figures = arrays, num, growing, figures
        self._here: dict[str, object] = {}  # what is small, and asked for in every step

    def fetch(self, name: str) -> object:
        if name == "young":
            return np.zeros(self.num, bool)
        if name in ("colors", "shapes"):
            return Codebook.of(None, 3 if name == "colors" else 2)
        if name == "statistics" and not self.growing:
            return None
        if self.figures is not None and name in Figures._fields:
            return np.array(getattr(self.figures, name))
        if name in ("time_logits", "time_moments", "frame_errors"):
            if name not in self._here:
                self._here[name] = jax.tree.map(np.array, getattr(self.arrays, name))
            return jax.tree.map(np.array, self._here[name])
        return jax.tree.map(lambda leaf: np.array(leaf)[: self.num].copy(), getattr(self.arrays, name))

    def finite(self, name: str) -> bool:
        if self.figures is not None and name in ("rows", "second"):
            return bool(getattr(self.figures, f"finite_{name}"))
        return bool(np.isfinite(self.fetch(name)).all())

    def copied(self) -> "OnDevice":
        arrays = jax.tree.map(lambda leaf: leaf.copy(), self.arrays)
        return OnDevice(arrays, self.num, self.growing, self.figures)


class DeviceStepper:
    """Steps of a fit on JAX's default device, or on several where the batch can be shared out evenly.

    As `fit._Stepper`, of a state whose arrays it takes over: programs for all levels are compiled at once, before any
    clock runs, and frames are held on the device at the sizes of all levels, as bytes.
    """

    def __init__(self, frames: np.ndarray, config: FitConfig, state: FitState, engine: str):
        self.frames, self.config, self.engine = frames, config, engine
        self.num_frames, *size = frames.shape[:3]
        self.size = tuple(size)
        self.levels, self.rates = levels(config, self.size), Rates(config)
        self.capacity = 0
        self._adopt(state)
        place = everywhere(self.plans[-1])
        self.pictures = [jax.device_put(_seen_at(frames, level.size), place) for level in self.levels]

    def _adopt(self, state: FitState) -> None:
        """Take a state's arrays over, with room for as many Gaussians as there may be."""
        growing, num = state.growing, len(state.rows)
        capacity = self._room(num)
        if capacity != self.capacity:
            self.capacity = capacity
            self.plans = [self._plan(level.size) for level in self.levels]
            for plan in self.plans:
                program(plan)  # compiled here, or known

        def padded(array: np.ndarray) -> np.ndarray:
            out = np.zeros((capacity, *array.shape[1:]), array.dtype)
            out[:num] = array
            return out

        statistics = None
        if self.config.growth is not None:  # also after the last births: else steps were to be compiled anew
            statistics = state.statistics if growing else GradientStatistics.zeros(num)
        arrays = Arrays(
            *(padded(getattr(state, name)) for name in ("rows", "first", "second", "counts", "kinds")),
            np.array(state.frame_errors),
            np.array(state.time_logits),
            jax.tree.map(np.array, state.time_moments),
            jax.tree.map(padded, statistics),
        )
        # Copied, since arrays that are donated must be the device's own.
        arrays = jax.tree.map(lambda leaf: leaf.copy(), jax.device_put(arrays, everywhere(self.plans[-1])))
        state.hold(OnDevice(arrays, num, growing, None))

    def _room(self, num: int) -> int:
        """Rows of the arrays: a function of the number of Gaussians, so that a fit that goes on has the same."""
        if self.config.growth is None:
            return num
        config = self.config
        most = max(most_gaussians(config, self.num_frames), num)
        if config.max_gaussians is not None or config.max_size_mb is not None:
            return most
        room = ROOM * chosen_num_gaussians(config, self.num_frames, *self.size)
        while room < num:
            room *= 2
        return min(room, most)

    def _plan(self, size: tuple[int, int]) -> Plan:
        config, devices = self.config, len(jax.local_devices())
        shares = [n for n in range(1, min(devices, config.batch_size) + 1) if config.batch_size % n == 0]
        return Plan(
            capacity=self.capacity,
            num_frames=self.num_frames,
            size=size,
            aspect=self.size[0] / self.size[1],
            degree=config.degree,
            power=config.power,
            floor=config.floor,
            compositing=config.compositing,
            options=config.options,
            engine=self.engine,
            ssim_fraction=config.ssim_fraction,
            batch_size=config.batch_size,
            sparse_updates=config.sparse_updates,
            unit_time=UNIT_TIME if config.scale_rates_by_duration else 0.0,
            learns_times=config.learn_frame_times and self.num_frames > 2,
            grows=config.growth is not None,
            num_devices=max(shares),
        )

    def __call__(self, state: FitState, progress: float, level: int = -1) -> tuple[float, float, int]:
        """Advance `state`, whose arrays are consumed; returns loss, mean squared error and how many took part."""
        if state.changed:  # by who watches the fit
            state.land()
            self._adopt(state)
        held, config = state.held, self.config
        rates, rate_of_times = self.rates.at(progress, state.backoffs)
        control = Control(
            views=views_of(config, self.num_frames, state.step).astype(np.int32),
            num=np.int32(held.num),
            squared=np.bool_(progress >= 1 - config.l2_fraction),
            rates=rates,
            rate_of_times=rate_of_times,
        )
        arrays, figures = program(self.plans[level])(held.arrays, self.pictures[level], control)
        figures = jax.device_get(figures)
        state.hold(OnDevice(arrays, held.num, held.growing, figures))
        return float(figures.loss), float(figures.error), int(figures.num_alive)

    @property
    def steps_per_pass(self) -> int:
        return steps_per_pass(self.config, self.num_frames)

    def anew(self, state: FitState) -> "DeviceStepper":
        """For a state whose arrays are others now, and not on the device."""
        self._adopt(state)
        return self

    def grow(self, state: FitState) -> None:
        """Births, deaths and resets that are due: on the host, with the room on the device as it was."""
        growth = self.config.growth.for_plan(state.plan)
        if changes_at(growth, state.step):
            state.land()
            grow(state, self.config, self.size)
            self._adopt(state)
        elif state.step + 1 >= growth.until_step:
            state.held.growing = False

    def errors_at_start(self, state: FitState) -> dict[int, float]:
        """As `fit._Stepper.errors_at_start`."""
        plan, arrays = self.plans[-1], state.held.arrays
        times, num = np.asarray(frame_times(state.time_logits)), np.int32(state.held.num)
        error = look(plan)  # compiled, before the clock runs
        begun = time.perf_counter()
        errors = {int(k): float(error(arrays.rows, num, times[k], self.frames[k])) for k in looked_at(self.num_frames)}
        state.seconds += time.perf_counter() - begun
        return errors
