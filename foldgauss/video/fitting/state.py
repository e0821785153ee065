"""`FitState`: the arrays and counters of a running fit; and the model, the error and the PSNR that follow from them.

A new array is one line in `FitState`. Its metadata, a `StateArray`, says how it is built, cut and extended;
starting, pruning, densification, copies, checkpoints and devices all go by it.
"""

import collections
import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from foldgauss.envelope import TimeLikelihood
from foldgauss.video.fitting.adam import UNIT_SIZE
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.models.conditioning import ConditioningSpec
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.row_layout import columns, unpack
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.models.video_model import VideoModel

#: Every so many Gaussians are looked at for their mean size.
SIZE_STRIDE = 64

# ------------------------------------------------------------------------------------------------ metadata


class Sizes(NamedTuple):
    """The sizes from which the shapes of all arrays of a `FitState` follow."""

    num_gaussians: int
    width: int  # of a row
    num_frames: int
    growing: bool = False  # whether there are gradient statistics
    paths: int = 0  # shared paths

    @property
    def num_intervals(self) -> int:
        """Intervals between two frames."""
        return self.num_frames - 1

    @property
    def num_measured(self) -> int:
        """Gaussians with gradient statistics."""
        return self.num_gaussians if self.growing else 0


@dataclasses.dataclass(frozen=True)
class StateArray:
    """The metadata of an array: its type, its shape, in which strings name `Sizes`, and the value of new entries."""

    dtype: type
    shape: tuple[int | str, ...] = ()
    fill: float = 0

    @property
    def per_gaussian(self) -> bool:
        """Whether there is one row for each Gaussian."""
        return self.shape[:1] == ("num_gaussians",)

    def spec(self, sizes: Sizes) -> jax.ShapeDtypeStruct:
        shape = (getattr(sizes, length) if isinstance(length, str) else length for length in self.shape)
        return jax.ShapeDtypeStruct(tuple(shape), self.dtype)

    def build(self, sizes: Sizes) -> np.ndarray:
        """The value that a fit starts with."""
        return np.full(self.spec(sizes).shape, self.fill, self.dtype)


def _array(dtype: type, *shape: int | str) -> dict[str, Any]:
    return {"arrays": StateArray(dtype, shape)}


def _decode_rules(rows: Any) -> tuple[tuple[str, float, float, tuple[float, ...]], ...]:
    return tuple((str(name), float(origin), float(exponent), tuple(slopes)) for name, origin, exponent, slopes in rows)


#: The metadata of fields that are no arrays: `decode` restores them from JSON.
_FLAG = {"static": True, "decode": bool}
_COUNT = {"static": True, "decode": int}
_NUMBER = {"static": True, "decode": float}
_ERRORS = {"static": True, "decode": lambda pairs: tuple((int(frame), float(error)) for frame, error in pairs)}
_RULES = {"static": True, "decode": _decode_rules}
_NUMBERS = {"static": True, "decode": tuple}
#: The names of the maps of shared paths, of their moments, and of the frames' counts of steps.
PATH_ARRAYS = ("path_maps", "path_first", "path_second", "frame_counts")
#: The names of the sums of `GradientStatistics`.
STATISTICS = ("screen_gradients", "time_gradients", "seen")


# --------------------------------------------------------------------------------------------------- state


class GradientStatistics(NamedTuple):
    """Sums over the steps since the last densification; (num,) each."""

    screen: np.ndarray  #: float32: of screen gradients
    time: np.ndarray  #: float32: of time gradients
    seen: np.ndarray  #: int32: steps in which the Gaussian was seen

    def add(self, screen: np.ndarray, by_time: np.ndarray) -> None:
        """Add a step: the largest screen gradient over its views, and dL/dm_t by the raw m_t over all; (num,) each.

        `screen` is negative for Gaussians that no view shows.
        """
        shown = screen >= 0
        np.add(self.screen, screen, out=self.screen, where=shown)
        np.add(self.time, np.abs(by_time), out=self.time, where=shown)
        np.add(self.seen, 1, out=self.seen, where=shown)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(repr=False)
class FitState:
    """The arrays and counters of a running fit. A step consumes its state: arrays are updated in place.

    The arrays of a fit on a device are `held` there until `fetch_all`: reading another one than those that every step
    fetches (`frame_errors`, `time_logits`, `path_maps`, which are then read-only) raises AttributeError. An array that
    is assigned is used from the next step on.
    """

    rows: np.ndarray = field(metadata=_array(np.float32, "num_gaussians", "width"))  # parameters, see `row_layout`
    first: np.ndarray = field(metadata=_array(np.float32, "num_gaussians", "width"))  # Adam's moments
    second: np.ndarray = field(metadata=_array(np.float32, "num_gaussians", "width"))
    counts: np.ndarray = field(metadata=_array(np.int32, "num_gaussians"))  # steps each Gaussian has taken
    rounded: np.ndarray = field(metadata=_array(np.uint8, "num_gaussians"))  # the groups of leaves that are, see `rate`
    classes: np.ndarray = field(metadata=_array(np.int8, "num_gaussians"))  # how visible, by which steps are chosen
    chunks: np.ndarray = field(metadata=_array(np.uint16, "num_gaussians"))  # of the file; they decrease
    frame_errors: np.ndarray = field(
        metadata=_array(np.float32, "num_frames")
    )  # mean squared error when last seen, 0 before
    time_logits: np.ndarray = field(metadata=_array(np.float32, "num_intervals"))
    time_count: np.ndarray = field(metadata=_array(np.int32))  # steps that the frame times have taken
    time_first: np.ndarray = field(metadata=_array(np.float32, "num_intervals"))  # their moments
    time_second: np.ndarray = field(metadata=_array(np.float32, "num_intervals"))
    path_maps: np.ndarray = field(
        metadata=_array(np.float32, "num_frames", "paths", 2, 3)
    )  # of each frame, in model space
    path_first: np.ndarray = field(metadata=_array(np.float32, "num_frames", "paths", 2, 3))  # their moments
    path_second: np.ndarray = field(metadata=_array(np.float32, "num_frames", "paths", 2, 3))
    frame_counts: np.ndarray = field(metadata=_array(np.int32, "num_frames"))  # steps that each frame's maps have taken
    screen_gradients: np.ndarray = field(metadata=_array(np.float32, "num_measured"))  # see `GradientStatistics`
    time_gradients: np.ndarray = field(metadata=_array(np.float32, "num_measured"))
    seen: np.ndarray = field(metadata=_array(np.int32, "num_measured"))
    growing: bool = field(default=False, metadata=_FLAG)  # whether densification is still to come
    step: int = field(default=0, metadata=_COUNT)
    plan: int = field(default=0, metadata=_COUNT)  # steps of the whole fit; 0 until minutes have been planned
    planned_step: int = field(default=0, metadata=_COUNT)  # where the plan was last changed, and the fraction of the
    planned_progress: float = field(default=0.0, metadata=_NUMBER)  # fit that was over there
    rate_actions: int = field(default=0, metadata=_COUNT)  # actions of `rate` that are done
    coarseness: float = field(default=0.0, metadata=_NUMBER)  # of the steps of rounding; 0 before it is chosen
    # For a fit to a PSNR: that of some frames before and after Gaussians were last dropped.
    last_drop: tuple[float, ...] = field(default=(), metadata=_NUMBERS)
    rules: tuple[tuple, ...] = field(default=(), metadata=_RULES)  # by which parameters are rounded, once any are
    seconds: float = field(default=0.0, metadata=_NUMBER)
    # What `divergence.Guard` decides by; stored, so that a resumed fit diverges and recovers as if uninterrupted.
    best_error: float = field(default=0.0, metadata=_NUMBER)  # the lowest one that others are compared with; 0: none
    backoffs: int = field(default=0, metadata=_COUNT)  # how often the fit returned to `last_finite`, with lower rates
    compare_from: int = field(default=0, metadata=_COUNT)  # the step from which on errors are compared with the best,
    improve_by: int = field(default=0, metadata=_COUNT)  # and with those of the start
    start_errors: tuple[tuple[int, float], ...] = field(default=(), metadata=_ERRORS)  # (frame, error) at the start
    last_finite: "FitState | None" = None  # the last state known to be good, which has none of its own
    held: ClassVar[Any] = None  # `HeldArrays` of a fit on a device, an attribute of the instance

    @classmethod
    def array_fields(cls) -> Mapping[str, StateArray]:
        """The metadata of the fields that are arrays, by name."""
        return {one.name: one.metadata["arrays"] for one in dataclasses.fields(cls) if "arrays" in one.metadata}

    @classmethod
    def counter_fields(cls) -> Mapping[str, Callable]:
        """The functions that restore the other fields from JSON, by name."""
        return {one.name: one.metadata["decode"] for one in dataclasses.fields(cls) if "decode" in one.metadata}

    @classmethod
    def create(cls, rows: np.ndarray, time_logits: np.ndarray, **fields: Any) -> "FitState":
        """A state with these Gaussians and frame times; all other arrays as a fit starts with, but for `fields`."""
        paths = fields["path_maps"].shape[1] if "path_maps" in fields else 0
        sizes = Sizes(*rows.shape, len(time_logits) + 1, fields.get("growing", False), paths)
        fields |= {"rows": rows, "time_logits": time_logits}
        arrays = {name: kind.build(sizes) for name, kind in cls.array_fields().items() if name not in fields}
        return cls(**arrays, **fields)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(step {self.step}, {self.num_gaussians} Gaussians)"

    def __getattr__(self, name: str) -> Any:
        # An array that is held, or a property that reads one.
        cure = ", on the host: call its fetch_all() first" if name in ARRAYS or hasattr(type(self), name) else ""
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}{cure}", name=name, obj=self)

    @property
    def num_gaussians(self) -> int:
        return len(self.rows) if self.held is None else self.held.num

    @property
    def statistics(self) -> GradientStatistics | None:
        """The sums by which Gaussians grow; None without densification to come."""
        return GradientStatistics(*(getattr(self, name) for name in STATISTICS)) if self.growing else None

    def restart_statistics(self) -> None:
        """Sums begin anew; unless `growing` there are none."""
        for name in STATISTICS:
            setattr(self, name, self.array_fields()[name].build(self.sizes))

    @property
    def sizes(self) -> Sizes:
        return Sizes(*self.rows.shape, len(self.frame_errors), self.growing, self.path_maps.shape[1])

    def leaf(self, name: str) -> np.ndarray:
        """A leaf of `FoldedSplats` in `rows`: a view (num_gaussians, width), where width is 1 for a number."""
        return self.rows[:, columns((self.rows.shape[1] - columns(0)["coefficients"].stop) // 2)[name]]

    def is_finite(self, name: str) -> bool:
        """Whether all values of an array are finite, by their sum: a third of the time of testing each.

        Of those held on a device, this is known of `rows` and `second`.
        """
        if name not in self.__dict__ and self.held is not None and name in self.held.finite:
            return self.held.finite[name]
        with np.errstate(invalid="ignore", over="ignore"):
            return bool(np.isfinite(getattr(self, name).sum()))

    # ---------------------------------------------------------------------------------- which Gaussians there are

    def keep(self, index: np.ndarray) -> None:
        """Drop all Gaussians but those of `index`, or reorder them."""
        for name, kind in self.array_fields().items():
            if kind.per_gaussian:
                setattr(self, name, getattr(self, name)[index])
        self.restart_statistics()

    def extend(self, rows: np.ndarray) -> None:
        """Add Gaussians at the end: their rows; in all other fields they are as at a start."""
        born = Sizes(*rows.shape, len(self.frame_errors))
        for name, kind in self.array_fields().items():
            if kind.per_gaussian:
                new = rows if name == "rows" else kind.build(born)
                setattr(self, name, np.concatenate([getattr(self, name), new]))
        self.restart_statistics()

    # --------------------------------------------------------------------------------------- copies, and devices

    def copy(self) -> "FitState":
        """A copy of all but `last_finite`; on the device where arrays are held there."""
        if self.held is None:
            return jax.tree.map(np.array, dataclasses.replace(self, last_finite=None))
        other = copy.copy(self)
        other.last_finite, other.held = None, self.held.copy()
        return other

    def restore(self) -> None:
        """Take the arrays of `last_finite` back, as copies."""
        self.fetch_all()
        for name in ARRAYS:
            setattr(self, name, np.array(getattr(self.last_finite, name)))

    def hold(self, held: Any) -> None:
        """From now on all arrays are those of `held`."""
        for name in ARRAYS:
            self.__dict__.pop(name, None)
        self.__dict__.update(held.on_host, held=held)

    def fetch_all(self) -> None:
        """Fetch the arrays of this state and of `last_finite`. An array that was assigned is kept instead.

        The next step sends them to the device again. Without a device there is nothing to do.
        """
        if self.held is not None:
            own = vars(self)
            arrays = {name: np.array(own[name]) if name in own else self.held.fetch(name) for name in ARRAYS}
            self.__dict__.update(arrays, held=None)
        if self.last_finite is not None:
            self.last_finite.fetch_all()

    @property
    def changed(self) -> bool:
        """Whether an array was assigned since arrays are held."""
        return self.held is not None and any(vars(self).get(name) is not self.held.on_host.get(name) for name in ARRAYS)


#: The names of the arrays of a `FitState`.
ARRAYS = tuple(FitState.array_fields())
#: The arrays as a device keeps them.
DeviceArrays = collections.namedtuple("DeviceArrays", ARRAYS)


# ------------------------------------------------------------------------------------ what follows from a state


class StepResult(NamedTuple):
    """What one step reports."""

    loss: float  #: mean over the batch
    num_alive: int  #: Gaussians that took part
    finite: bool = True  #: whether the parameters of these are finite after the step


def to_model(state: FitState, config: FitConfig, size: tuple[int, int], fps: float) -> VideoModel:
    """The model as it stands in `state`, whose arrays are fetched (`FitState.fetch_all`) and copied."""
    state.fetch_all()
    return VideoModel(
        splats=unpack(state.rows, config.fold_degree, envelope_of(config), paths_of(state)),
        frame_times=FrameTimes(state.time_logits.copy()),
        size=tuple(int(n) for n in size),
        fps=float(fps),
        options=config.options,
        compositing=config.compositing,
        scale_cutoff=config.strategy.scale_cutoff,
    )


def paths_of(state: FitState, times: Float32[np.ndarray, " frames"] | None = None) -> SharedPaths | None:
    """The shared paths as they stand in `state` (copies); None where there are none. `times`: its frame times."""
    if not state.path_maps.shape[1]:
        return None
    times = np.tile(
        np.asarray(frame_times(state.time_logits)) if times is None else times, (state.path_maps.shape[1], 1)
    )
    return SharedPaths(times, np.swapaxes(state.path_maps, 0, 1).copy())


@functools.partial(jax.jit, static_argnames="own_units")
def measure_relative_size(
    log_scales: Float[Array, "num 2"], used: Bool[Array, " num"], *, own_units: bool
) -> Float[Array, ""]:
    """The size of Gaussians, in units of that at which the learning rate of paths is stated; 1 if it is absolute.

    Their geometric mean, at most that of the frame, of those that are `used`: every `SIZE_STRIDE`-th of a fit.
    """
    if not own_units:
        return jnp.float32(1)
    sizes = jnp.where(used, jnp.mean(log_scales, axis=1), 0)
    mean = jnp.sum(sizes) / jnp.sum(used).astype(jnp.float32)
    return jnp.where(jnp.isfinite(mean), jnp.exp(jnp.minimum(mean, 0)) / np.float32(UNIT_SIZE), 1)


def running_psnr(state: FitState) -> float:
    """dB, by the mean squared error of the frames as last seen; at most 100, as `psnr` has for equal images."""
    seen = state.frame_errors[state.frame_errors != 0]
    errors = seen if len(seen) else [error for _, error in state.start_errors] or [0.0]
    return -10 * math.log10(max(float(np.mean(errors)), 1e-10))


def spec_of(config: FitConfig, size: tuple[int, int]) -> ConditioningSpec:
    """How the Gaussians of a fit are conditioned, for frames of `size` (height, width)."""
    cutoff = config.strategy.scale_cutoff
    return ConditioningSpec(config.fold_degree, config.power, config.floor, tuple(size), scale_cutoff=cutoff)


def envelope_of(config: Any) -> TimeLikelihood:
    """The envelope of the settings. `config` may be any object with `power` and `floor`."""
    return TimeLikelihood(power=np.float32(config.power), floor=np.float32(config.floor))


@jax.jit
def frame_times(logits):
    """The times t_k of softmax weights `logits`."""
    return FrameTimes(logits).times()
