"""The arrays of a running fit, and what they amount to."""

import dataclasses
import functools
import math
from typing import Any, ClassVar, Protocol

import cv2
import jax
import numpy as np
import optax

from foldgauss.envelope import TimeLikelihood
from foldgauss.video.fitting.codebook import Codebook
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.growth import GradientStatistics
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.metrics import psnr
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.row_layout import unpack
from foldgauss.video.models.video_model import VideoModel

TIME_ADAM = optax.scale_by_adam(eps=1e-15)


class Held(Protocol):
    """Arrays of a fit that are elsewhere, on a device: fetched only where somebody asks for them."""

    num: int  #: Gaussians
    growing: bool  #: whether statistics of growth are kept

    def fetch(self, name: str) -> Any:
        """A field of `FitState`, as an array of NumPy's, a copy."""

    def finite(self, name: str) -> bool:
        """Whether all numbers of a field are, by a look on the device."""

    def copied(self) -> "Held":
        """A copy that later steps leave as it is, on the device as well."""


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "rows",
        "first",
        "second",
        "counts",
        "kinds",
        "young",
        "colors",
        "shapes",
        "frame_errors",
        "time_logits",
        "time_moments",
        "statistics",
        "sound",
    ],
    meta_fields=[
        "step",
        "plan",
        "seconds",
        "error",
        "best_error",
        "backoffs",
        "settled",
        "should_be_better",
        "start_errors",
    ],
)
@dataclasses.dataclass
class FitState:
    """The arrays of a running fit. A step consumes its state: as with donated buffers, arrays are updated in place.

    Those of a fit on a device are `held` there, and fetched anew, as copies, whenever they are read; who sets one has
    it taken over by the next step.
    """

    rows: np.ndarray  # float32 (num, width): see `packing`
    first: np.ndarray  # Adam's moments, likewise
    second: np.ndarray
    counts: np.ndarray  # int32 (num,): steps each Gaussian has taken
    kinds: np.ndarray  # uint8 (num,): which numbers each Gaussian has, see `sparse_storage.find_kinds`
    young: np.ndarray  # bool (num,): born the last time that stock was taken
    colors: Codebook  # which colours are one and the same
    shapes: Codebook  # likewise of the two standard deviations
    frame_errors: np.ndarray  # float32 (num_frames,): mean squared error when last seen, 0 before
    time_logits: np.ndarray  # float32 (num_frames - 1,)
    time_moments: optax.OptState
    statistics: GradientStatistics | None  # what growth is decided by; None where Gaussians do not grow, or no longer
    step: int
    plan: int  # steps of the whole fit; 0 until the pace is known that minutes are planned by
    seconds: float
    error: float  # running mean of the squared error
    best_error: float = 0.0  # the least one that a later one is compared with, see `guard`; 0: none known
    backoffs: int = 0  # how often the fit was taken back, and its rates lowered
    # What else `guard` goes by; kept, so that a fit that was stopped comes apart, and back, as if it had not been.
    sound: "FitState | None" = None  # the last sound state, which has none of its own; None: none known
    settled: int = 0  # steps from which on errors are compared with the best one, and with those of the start
    should_be_better: int = 0
    start_errors: tuple[tuple[int, float], ...] = ()  # frames, and their mean squared errors before the first step
    held: ClassVar[Held | None] = None  # of a fit on a device, an attribute of the instance

    def __getattr__(self, name: str) -> Any:
        """An array that is not here is fetched."""
        held = self.__dict__.get("held")
        if held is None or name not in ARRAYS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return held.fetch(name)

    @property
    def num_gaussians(self) -> int:
        return len(self.rows) if self.held is None else self.held.num

    @property
    def growing(self) -> bool:
        """Whether births and deaths are still to come."""
        return self.statistics is not None if self.held is None else self.held.growing

    def finite(self, name: str) -> bool:
        """Whether all numbers of an array are, by their sum: a third of the time of looking at each."""
        if self.held is not None:
            return self.held.finite(name)
        with np.errstate(invalid="ignore", over="ignore"):
            return bool(np.isfinite(getattr(self, name).sum()))

    def hold(self, held: Held) -> None:
        """From now on all arrays are those of `held`."""
        for name in ARRAYS:
            self.__dict__.pop(name, None)
        self.held = held

    def land(self) -> None:
        """Fetch all arrays, but for those that were set since; nothing is held any more."""
        if self.held is not None:
            arrays = {name: getattr(self, name) for name in ARRAYS}
            self.held = None
            self.__dict__.update(arrays)

    @property
    def changed(self) -> bool:
        """Whether an array was set since arrays are held."""
        return self.held is not None and not self.__dict__.keys().isdisjoint(ARRAYS)


#: The fields of a `FitState` that are arrays, or trees of them.
_OTHERS = ("step", "plan", "seconds", "error", "best_error", "backoffs", "sound", "settled", "should_be_better")
ARRAYS = tuple(field.name for field in dataclasses.fields(FitState) if field.name not in (*_OTHERS, "start_errors"))


def to_model(state: FitState, config: FitConfig, size: tuple[int, int], fps: float) -> VideoModel:
    """The model as it stands in `state` (arrays are copied)."""
    return VideoModel(
        splats=unpack(state.rows, config.degree, envelope_of(config)),
        frame_times=FrameTimes(state.time_logits.copy()),
        size=tuple(int(n) for n in size),
        fps=float(fps),
        options=config.options,
        compositing=config.compositing,
    )


def running_psnr(state: FitState) -> float:
    """dB, by the running mean of the squared error; at most 100, as of pictures that are equal (`psnr`)."""
    return -10 * math.log10(max(state.error, 1e-10))


def mean_psnr(state: FitState, config: FitConfig, frames: np.ndarray) -> float:
    """dB, mean over all frames as they are shown, over black."""
    playback = VideoRenderer(to_model(state, config, frames.shape[1:3], 1.0))
    return float(np.mean([psnr(frame[..., :3], shown) for frame, shown in zip(frames, playback.frames(), strict=True)]))


def envelope_of(config: FitConfig) -> TimeLikelihood:
    return TimeLikelihood(power=np.float32(config.power), floor=np.float32(config.floor))


@jax.jit
def frame_times(logits):
    return FrameTimes(logits).times()


@jax.jit
def update_times(logits, moments, by_time, rate):
    """Adam on the softmax weights, given dL/dt_k."""
    _, pull = jax.vjp(lambda w: FrameTimes(w).times(), logits)
    with jax.numpy_dtype_promotion("standard"):  # optax raises Python floats to integer counts
        update, moments = TIME_ADAM.update(pull(by_time)[0], moments)
    return logits - rate * update, moments


def planar(frame: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Bytes (height, width, 3) as floats (3, height, width), as the kernels want them; with alpha over `background`."""
    out = np.empty((3, *frame.shape[:2]), np.float32)
    *colors, last = cv2.split(frame)
    for plane, own in zip(out, colors if frame.shape[2] == 4 else (*colors, last), strict=True):
        np.multiply(own, np.float32(1 / 255), out=plane)
    if frame.shape[2] == 4:
        out += background[:, None, None] * (1 - last * np.float32(1 / 255))
    return out
