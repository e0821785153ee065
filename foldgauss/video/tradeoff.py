"""Speed against accuracy: variants of a fit along named axes, the Pareto front of their costs, and its knee."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss._runtime.settings import replace_settings
from foldgauss.render import RenderOptions
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: Fewer steps do not show what a setting is worth.
LEAST_STEPS = 200
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
    rendering, or if `played` for rendering only. `work`: estimated cost in fits of the base on two cores, for planning.
    `value` is its name, with scaled fields in braces.
    """

    value: str
    fit: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    scale: Mapping[str, float] = dataclasses.field(default_factory=dict)
    options: Mapping[str, float] = dataclasses.field(default_factory=dict)
    played: bool = False
    work: float = 1.0


#: The axes in the order of their runs; docs/results.md lists them.
AXES: Mapping[str, tuple[Variant, ...]] = MappingProxyType(
    {
        "time": (
            Variant("{steps} steps", scale={"steps": 1 / 4}, work=0.25),
            Variant("{steps} steps", scale={"steps": 1 / 2}, work=0.5),
            Variant("{steps} steps", scale={"steps": 2}, work=2.0),
        ),
        "gaussians": (
            Variant("{num_gaussians}", scale={"num_gaussians": 1 / 4}, work=0.5),
            Variant("{num_gaussians}", scale={"num_gaussians": 1 / 2}, work=0.7),
            Variant("{num_gaussians}", scale={"num_gaussians": 2}, work=1.6),
        ),
        "degree": (
            Variant("0", fit={"degree": 0}, work=0.75),
            Variant("1", fit={"degree": 1}, work=0.9),
            Variant("7", fit={"degree": 7}, work=1.1),
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
            Variant("alpha 1/64, fitted", options={"alpha_cutoff": 1 / 64}, work=0.85),
            Variant("radius 2, fitted", options={"support_radius": 2.0}, work=0.85),
            Variant("stop 0.1, fitted", options={"transmittance_stop": 0.1}, work=0.85),
        ),
        "quality": tuple(
            Variant(f"{quality}", fit={"quality": quality}, work=work)
            for quality, work in ((30, 0.8), (50, 1.1), (70, 1.4), (90, 1.6))
        ),
        "power": (Variant("0", fit={"power": 0.0}), Variant("2", fit={"power": 2.0})),
        "compositing": (Variant("sum", fit={"compositing": "sum"}, work=0.85),),
        "ssim": (
            Variant("0", fit={"loss.ssim_fraction": 0.0}, work=0.85),
            Variant("0.5", fit={"loss.ssim_fraction": 0.5}),
        ),
    }
)


@dataclasses.dataclass(frozen=True)
class Point:
    """A setting to measure: `config` is fitted; or the base's model is rendered with `played`, if given."""

    axis: str
    value: str
    config: FitConfig
    played: RenderOptions | None = None
    work: float = 1.0

    @property
    def name(self) -> str:
        return f"{self.axis} {self.value}".rstrip()


class Skipped(NamedTuple):
    """A setting that is not measured, and why."""

    name: str
    why: str


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


def plan_points(
    base: FitConfig, axes: Sequence[str], num_frames: int, *, has_alpha: bool = False
) -> tuple[list[Point], list[Skipped]]:
    """The base and every variant of `axes`, one setting changed at a time; and the variants skipped.

    Skipped are variants that do not apply to this clip or change nothing for it. `base` must have numbers for `steps`
    and `num_gaussians`. Raises ValueError as `check_axes`.
    """
    points, skipped = [Point("base", "", base)], []
    for axis in check_axes(axes):
        for variant in AXES[axis]:
            point = _apply(variant, axis, base)
            why = _why_skipped(point, base, num_frames, has_alpha)
            if why:
                skipped.append(Skipped(point.name, why))
            else:
                points.append(point)
    return points, skipped


def _apply(variant: Variant, axis: str, base: FitConfig) -> Point:
    scaled = {name: max(round(factor * getattr(base, name)), 1) for name, factor in variant.scale.items()}
    options = dataclasses.replace(base.options, **variant.options)
    fitted = base.options if variant.played else options
    config = replace_settings(base, variant.fit | scaled | {"options": fitted})
    played = options if variant.played else None
    return Point(axis, variant.value.format(**scaled), config, played, variant.work)


def _why_skipped(point: Point, base: FitConfig, num_frames: int, has_alpha: bool) -> str:
    if has_alpha and point.config.compositing == "sum":
        return "sums have no alpha, but the frames do"
    if point.config.views.batch_size > num_frames:
        return f"there are {num_frames} frames"
    return "it changes nothing" if point.played is None and point.config == base else ""


class Throughput(NamedTuple):
    """Seconds for the start of a fit, for one step of the base, and for evaluating a model."""

    start: float
    step: float
    evaluation: float


def estimate_seconds(points: Sequence[Point], steps: int, throughput: Throughput) -> float:
    """Estimated time to measure the points if the base has this many steps."""
    fixed, each = _costs(points, throughput)
    return fixed + each * steps


def estimate_steps(seconds: float, points: Sequence[Point], throughput: Throughput) -> int:
    """Steps of the base so that measuring the points takes this many seconds; below 1 if there is no time."""
    fixed, each = _costs(points, throughput)
    return math.floor((seconds - fixed) / each)


def _costs(points: Sequence[Point], throughput: Throughput) -> tuple[float, float]:
    """Seconds independent of steps, and seconds per step of the base."""
    fits = [point for point in points if point.played is None]
    return (
        len(fits) * throughput.start + len(points) * throughput.evaluation,
        sum(point.work for point in fits) * throughput.step,
    )


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


def measure_frame_seconds(*models: VideoModel | EditedVideo) -> list[float]:
    """Mean time to render a frame of each video at its own size and times, conditioning included.

    The videos are rendered in turn, frame by frame, and the fastest of several rounds counts for each frame: other load
    on the machine then affects all videos alike.
    """
    renderers = [VideoRenderer(model) for model in models]
    num_frames = min(model.num_frames for model in models)
    chosen = np.unique(np.linspace(0, num_frames - 1, _TIMED_FRAMES).round().astype(int))
    times = [np.asarray(model.frame_times.times())[chosen] for model in models]
    for renderer, own in zip(renderers, times, strict=True):
        renderer.frame(own[0])  # compiles the kernels
    best, started = np.full((len(models), len(chosen)), np.inf), time.perf_counter()
    for done in range(_ROUNDS):
        if done >= 2 and time.perf_counter() - started > _LONG:
            break
        for k in range(len(chosen)):
            for number, renderer in enumerate(renderers):
                start = time.perf_counter()
                renderer.frame(times[number][k])
                best[number, k] = min(best[number, k], time.perf_counter() - start)
    return best.mean(1).tolist()


def measure_frame_rate(model: VideoModel | EditedVideo | SegmentedVideo) -> float:
    """Frames rendered per second, see `measure_frame_seconds`.

    Of a video in segments, some segments are timed, each alone: without loading and fades.
    """
    if not isinstance(model, SegmentedVideo):
        return 1 / measure_frame_seconds(model)[0]
    numbers = np.linspace(0, len(model.segments) - 1, _TIMED_SEGMENTS).round().astype(int)
    chosen = [model.segments[number] for number in np.unique(numbers)]
    seconds = [segment.num_frames * measure_frame_seconds(segment.model)[0] for segment in chosen]
    return sum(segment.num_frames for segment in chosen) / sum(seconds)
