"""Speed against accuracy: variants of a fit along named axes, the Pareto front of their costs, and its knee."""

import dataclasses
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss._runtime.settings import replace_settings
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: A point of the front is better than all cheaper ones by more than this, in dB.
LEAST_GAIN = 0.01
#: Frames that are timed, at most.
_TIMED_FRAMES = 24
#: Rounds of timing, of which the fastest counts: other processes share the cores.
_ROUNDS = 8
#: Segments that are timed.
_TIMED_SEGMENTS = 3
#: Seconds after which no third round starts.
_LONG = 5.0


@dataclasses.dataclass(frozen=True)
class Variant:
    """One setting of an axis, as its differences from the base.

    `fit`: fields of `FitConfig`; `scale`: fields to multiply; `options`: fields of `RenderOptions`, for fit and
    rendering, or if `played` for rendering only. `value` is its name, with scaled fields in braces.
    """

    value: str
    fit: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    scale: Mapping[str, float] = dataclasses.field(default_factory=dict)
    options: Mapping[str, float] = dataclasses.field(default_factory=dict)
    played: bool = False


#: The axes in the order of their runs; docs/results.md lists them.
AXES: Mapping[str, tuple[Variant, ...]] = MappingProxyType(
    {
        "time": (
            Variant("{steps} steps", scale={"steps": 1 / 4}),
            Variant("{steps} steps", scale={"steps": 1 / 2}),
            Variant("{steps} steps", scale={"steps": 2}),
        ),
        "gaussians": (
            Variant("{num_gaussians}", scale={"num_gaussians": 1 / 4}),
            Variant("{num_gaussians}", scale={"num_gaussians": 1 / 2}),
            Variant("{num_gaussians}", scale={"num_gaussians": 2}),
        ),
        "degree": (
            Variant("0", fit={"degree": 0}),
            Variant("1", fit={"degree": 1}),
            Variant("7", fit={"degree": 7}),
        ),
        # Fewer steps with a larger batch: the number of frames seen is the same.
        "batch": (
            Variant("2", fit={"views.batch_size": 2}, scale={"steps": 1 / 2}),
            Variant("4", fit={"views.batch_size": 4}, scale={"steps": 1 / 4}),
        ),
        # For rendering only; and for the fit those that save the most time.
        "cutoff": (
            Variant("alpha 1/1024, played", options={"alpha_cutoff": 1 / 1024}, played=True),
            Variant("alpha 1/64, played", options={"alpha_cutoff": 1 / 64}, played=True),
            Variant("alpha 1/32, played", options={"alpha_cutoff": 1 / 32}, played=True),
            Variant("radius 2.5, played", options={"support_radius": 2.5}, played=True),
            Variant("radius 2, played", options={"support_radius": 2.0}, played=True),
            Variant("stop 0.01, played", options={"transmittance_stop": 0.01}, played=True),
            Variant("stop 0.1, played", options={"transmittance_stop": 0.1}, played=True),
            Variant("alpha 1/64, fitted", options={"alpha_cutoff": 1 / 64}),
            Variant("radius 2, fitted", options={"support_radius": 2.0}),
            Variant("stop 0.1, fitted", options={"transmittance_stop": 0.1}),
        ),
        "quality": tuple(Variant(f"{quality}", fit={"quality": quality}) for quality in (30, 50, 70, 90)),
        "power": (Variant("0", fit={"power": 0.0}), Variant("2", fit={"power": 2.0})),
        "compositing": (Variant("sum", fit={"compositing": "sum"}),),
        "ssim": (
            Variant("0", fit={"loss.ssim_fraction": 0.0}),
            Variant("0.5", fit={"loss.ssim_fraction": 0.5}),
        ),
    }
)


@dataclasses.dataclass(frozen=True)
class Point:
    """A setting to measure: `config` is fitted; or, if `played`, the base's model is rendered with its options."""

    axis: str
    value: str
    config: FitConfig
    played: bool = False

    @property
    def name(self) -> str:
        return f"{self.axis} {self.value}".rstrip()


def check_axes(names: Sequence[str]) -> tuple[str, ...]:
    """The axes named, in the order of `AXES`. Raises ValueError for an unknown name, a name given twice and none."""
    unknown = [name for name in names if name not in AXES]
    require(
        not unknown and names and len(set(names)) == len(names),
        "axes",
        expected="some of " + ", ".join(AXES) + ", each once",
        got=", ".join(unknown) if unknown else ", ".join(names) or "none",
    )
    return tuple(name for name in AXES if name in names)


def plan_points(base: FitConfig, axes: Sequence[str]) -> list[Point]:
    """The base and every variant of `axes`, one setting changed at a time.

    `base` must have numbers for `steps` and `num_gaussians`. Raises ValueError as `check_axes`.
    """
    variants = [_apply(variant, axis, base) for axis in check_axes(axes) for variant in AXES[axis]]
    return [Point("base", "", base), *variants]


def _apply(variant: Variant, axis: str, base: FitConfig) -> Point:
    scaled = {name: max(round(factor * getattr(base, name)), 1) for name, factor in variant.scale.items()}
    options = dataclasses.replace(base.options, **variant.options)
    config = replace_settings(base, variant.fit | scaled | {"options": options})
    return Point(axis, variant.value.format(**scaled), config, variant.played)


def pareto_front(cost: Sequence[float], quality: Sequence[float], least_gain: float = LEAST_GAIN) -> list[int]:
    """Indices of the Pareto front, the cheapest first: each is better by more than `least_gain` than all cheaper ones.

    **Shapes:** one cost and one quality per point. Points with NaN or infinities are left out; of points with the same
    cost and qualities within `least_gain`, the first one is taken.

    **Example:** `pareto_front([1, 2, 3], [30, 29, 33]) == [0, 2]`.
    """
    finite = [k for k in range(len(cost)) if math.isfinite(cost[k]) and math.isfinite(quality[k])]
    chosen, best = [], -math.inf
    for k in sorted(finite, key=lambda k: (cost[k], -quality[k])):
        if quality[k] > best + least_gain:
            least = max(quality[k] - least_gain, best + least_gain)
            chosen.append(next(j for j in finite if cost[j] == cost[k] and quality[j] >= least))
            best = quality[k]
    return chosen


def knee(cost: Sequence[float], quality: Sequence[float]) -> int | None:
    """Index of the knee of a Pareto front, costs rising: the point farthest above the chord between its ends.

    Both axes are logarithmic and scaled to [0, 1]: the cost, which must be positive, and the squared error, as quality
    in dB is. None for fewer than three points, and if none is above the chord.

    **Example:** `knee([1, 2, 16], [30, 36, 38]) == 1`.

    **Source:** the criterion of Satopaa et al. 2011, "Finding a Kneedle in a Haystack", without its smoothing.
    """
    if len(cost) < 3:
        return None
    x, y = np.log(np.asarray(cost, float)), np.asarray(quality, float)
    above = (y - y[0]) / (y[-1] - y[0]) - (x - x[0]) / (x[-1] - x[0])
    best = int(np.argmax(above))
    return best if above[best] > 1e-9 else None


def measure_frame_rate(model: VideoModel | EditedVideo | SegmentedVideo) -> float:
    """Frames rendered per second, at the video's own size and times, conditioning included.

    The fastest of several rounds counts for each frame. Of a video in segments, some segments are timed, each alone:
    without loading and fades.
    """
    if isinstance(model, SegmentedVideo):
        numbers = np.linspace(0, len(model.segments) - 1, _TIMED_SEGMENTS).round().astype(int)
        chosen = [model.segments[number] for number in np.unique(numbers)]
        rates = [measure_frame_rate(segment.model) for segment in chosen]
        return statistics.harmonic_mean(rates, [segment.num_frames for segment in chosen])
    renderer = VideoRenderer(model)
    numbers = np.unique(np.linspace(0, model.num_frames - 1, _TIMED_FRAMES).round().astype(int))
    times = np.asarray(model.frame_times.times())[numbers]
    renderer.frame(times[0])  # compiles the kernels
    best, started = np.full(len(times), np.inf), time.perf_counter()
    for done in range(_ROUNDS):
        if done >= 2 and time.perf_counter() - started > _LONG:
            break
        for k, t in enumerate(times):
            start = time.perf_counter()
            renderer.frame(t)
            best[k] = min(best[k], time.perf_counter() - start)
    return 1 / best.mean()
