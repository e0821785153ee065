"""The choice of the engine that computes the steps of a fit."""

import jax
import numpy as np

from foldgauss._runtime.checks import invalid
from foldgauss.render import pallas
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import FitState


def choose_engine(frames: np.ndarray, config: FitConfig, state: FitState | None = None) -> str:
    """ "cpu", "xla" or "pallas": what computes a fit to `frames`, on from `state`.

    Raises ValueError where an engine is asked for that does not know a setting.
    """
    if config.engine == "cpu" or (config.engine == "auto" and jax.default_backend() == "cpu"):
        return "cpu"
    unknown = _unknown(frames, config, state)
    if config.engine == "auto":
        return "cpu" if unknown else "xla"
    if unknown:
        cure = "Give engine='cpu', which knows all settings."
        raise invalid("engine", expected=f"'cpu' with {unknown}", got=repr(config.engine), cure=cure)
    if config.engine == "pallas":
        pallas.check_options(config.options)
    return config.engine


def describe_device() -> str:
    """The device that steps are computed on where they are not on the CPU's kernels, as "NVIDIA H200"."""
    first, *others = jax.local_devices()
    return f"{len(others) + 1} times {first.device_kind}" if others else first.device_kind


def _unknown(frames: np.ndarray, config: FitConfig, state: FitState | None) -> str:
    """What steps on a device do not know, in words; empty where there is nothing."""
    if config.economy is not None:
        return "an economy"
    if config.interpolation_fraction > 0:
        return f"interpolation_fraction {config.interpolation_fraction:g}"
    if frames.shape[3] == 4:
        return "frames that have alpha"
    if state is not None and (len(state.colors.index) or len(state.shapes.index)):
        return "a state whose Gaussians share numbers"
    return ""
