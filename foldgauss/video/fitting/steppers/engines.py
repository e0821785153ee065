"""The engines of a fit: which one computes it, and the stepper that belongs to it."""

from collections.abc import Callable

import jax
import numpy as np

from foldgauss._runtime.checks import require
from foldgauss._runtime.device import default_platform
from foldgauss.render import pallas
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import FitState
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.fitting.steppers.jax_stepper import JaxStepper
from foldgauss.video.motion.optical_flow import Motion


def choose_engine(frames: np.ndarray, config: FitConfig) -> str:
    """The engine of a fit to `frames`: "cpu", "xla" or "pallas".

    Raises ValueError for an engine that does not support the frames or the constants of the renderer.
    """
    if config.engine == "cpu" or (config.engine == "auto" and default_platform() == "cpu"):
        return "cpu"
    has_alpha = frames.shape[3] == 4
    if config.engine == "auto":
        return "cpu" if has_alpha else "pallas" if pallas.is_preferred(config.options) else "xla"
    require(
        not has_alpha,
        "engine",
        expected="'cpu' with frames that have alpha",
        got=repr(config.engine),
        cure="Give engine='cpu', which supports all settings.",
    )
    if config.engine == "pallas":
        pallas.check_options(config.options)
    return config.engine


def make_stepper(
    engine: str, frames: np.ndarray, config: FitConfig, state: FitState, find_motion: Callable[[], Motion]
) -> CpuStepper | JaxStepper:
    """The stepper of an engine; it takes over the arrays of `state`."""
    if engine == "cpu":
        return CpuStepper(frames, config, state, find_motion)
    return JaxStepper(frames, config, state, engine, find_motion)


def describe_device() -> str:
    """The name of the device that JAX engines compute on, as "NVIDIA H200"."""
    return jax.local_devices()[0].device_kind
