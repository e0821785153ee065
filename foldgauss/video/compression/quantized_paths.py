"""Shared paths of a compact file: maps and their times as integers, in steps of model space too fine to be seen.

As in `quantize`, decoding uses only elementary operations of float64, in a stated order. See docs/format.md.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Int32

from foldgauss._runtime.checks import invalid
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.models.video_model import VideoModel

#: Displacement by which rounding the maps may move Gaussians, in pixels of the model's size.
PATH_ERROR = 0.02
#: The most bits after the binary point that maps have.
MAX_PATH_BITS = 28
#: The step of the times of maps if these are not the frames'.
KNOT_STEP = 2.0**-24
#: Fraction of Gaussians on either side that may be outside of the cells.
_OUTSIDE = 0.005
#: The least extent of the cells.
_MIN_SIDE = 0.01
_LN2 = 0.6931471805599453


@dataclasses.dataclass(frozen=True)
class PathsInfo:
    """Constants of shared paths, stored in the header.

    `at_frames`: knots are at the times of the frames, and not stored. `bits`: maps are in steps of 2^-bits.
    `middle`, `sides`: the rectangle that cells divide instead of the frame, since positions on a path may be outside.
    """

    num_paths: int
    num_knots: int
    at_frames: bool
    bits: int
    middle: tuple[float, float]
    sides: tuple[float, float]


def describe_paths(model: VideoModel) -> PathsInfo:
    """The constants for a model's paths."""
    low, high = np.quantile(np.asarray(model.splats.loc, np.float64), [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    middle, sides = ((low + high) / 2).round(4), np.maximum(high - low, _MIN_SIDE).round(4)
    paths, frames = model.splats.paths, np.asarray(model.frame_times.times(), np.float64)
    at_frames = paths.num_knots == len(frames) and np.abs(np.asarray(paths.times) - frames).max() <= 2.0**-20
    # Half a step of all six numbers of a map moves (x, y) by so much of a step.
    most = 0.5 * (1 + (np.abs(middle) + sides / 2).sum())
    bits = math.ceil(math.log2(most * max(model.size) / PATH_ERROR))
    extent = tuple(middle.tolist()), tuple(sides.tolist())
    return PathsInfo(paths.num_paths, paths.num_knots, bool(at_frames), min(max(bits, 0), MAX_PATH_BITS), *extent)


def round_paths(about: PathsInfo, paths: SharedPaths, largest: int) -> dict[str, Int32[np.ndarray, "..."]]:
    """The integers of the maps and, unless they are at the frames, of their times; magnitudes up to `largest`."""
    scaled = {"maps": np.asarray(paths.matrices, np.float64) * 2.0**about.bits}
    if not about.at_frames:
        scaled["knots"] = np.asarray(paths.times, np.float64) / KNOT_STEP
    for name, numbers in scaled.items():
        if not (np.abs(numbers) <= largest).all():
            expected = f"shared paths whose {name} are within the range of their steps"
            raise invalid("model", expected=expected, got="others", cure="Save it as .safetensors.")
    return {name: np.rint(numbers).astype(np.int32) for name, numbers in scaled.items()}


def decode_paths(
    about: PathsInfo,
    maps: Int32[np.ndarray, "paths knots 2 3"],
    knots: Int32[np.ndarray, "paths knots"] | None,
    logits: Float[np.ndarray, " intervals"],
) -> tuple[Float[np.ndarray, "paths knots"], Float[np.ndarray, "paths knots 2 3"]]:
    """Times and maps; without `knots` the times are those of the frames, `FrameTimes(logits).times()`."""
    maps = maps * 2.0**-about.bits
    if knots is not None:
        return knots * KNOT_STEP, maps
    summed = np.cumsum(_exp(logits - logits.max(initial=-np.inf)))
    return np.tile(np.concatenate([[0.0], summed / summed[-1:]]), (about.num_paths, 1)), maps


def _exp(x: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
    """Exponential of numbers <= 0 by elementary operations only, to 1e-13 and not below e^-690."""
    x = np.maximum(x, -690.0)
    e = np.floor(x * (1 / _LN2) + 0.5)
    rest, total = x - e * _LN2, np.ones_like(x)
    for k in range(14, 0, -1):
        total = 1 + total * rest / k
    return np.ldexp(total, e.astype(np.int32))
