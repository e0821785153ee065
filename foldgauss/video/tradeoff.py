"""Speed against accuracy: the axes along which a fit is turned, one at a time; the Pareto front, and its knee."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from foldgauss._runtime.checks import invalid
from foldgauss.render import RenderOptions
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.economy import Economy
from foldgauss.video.fitting.schedule import plan_levels
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.sparse_storage import to_stored
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: How a model's numbers are kept: as they are, rounded to 16 bits, or in a compact file (`foldgauss.video.compress`)
#: with that many passes over the clip, at a loss of at most `MAX_LOSS_DB`.
FLOAT32, FLOAT16 = "float32", "float16"
PASSES: Mapping[str, int] = MappingProxyType({"compact": 0, "compact, finetuned": 4})
MAX_LOSS_DB = 0.2
#: What compressing takes, in steps of a fit per frame: about what was measured.
_COMPRESSING = {FLOAT32: 0.0, FLOAT16: 0.0, "compact": 4.0, "compact, finetuned": 18.0}
#: Fewer steps show nothing of what a setting is worth.
LEAST_STEPS = 200
#: A point of the front is better than all cheaper ones by more than this, in dB: what is told of a PSNR.
LEAST_GAIN = 0.01
#: Playing is timed on so many frames at most, and each so many times, of which the fastest counts: others share cores.
_SHOWN, _ROUNDS = 24, 8
#: Segments that are timed.
_SEGMENTS_SHOWN = 3
#: Seconds after which it is not drawn again, but for a second time.
_LONG = 5.0


@dataclasses.dataclass(frozen=True)
class Variant:
    """One setting of an axis, as what it changes of the base.

    `fit`: fields of `FitConfig`; `scale`: fields to be multiplied; `options`: constants of `RenderOptions`, fitted with
    or, if `played`, only drawn with; `stored`: how numbers are kept. `work`: about how many fits of the base this takes
    on two cores, to plan by. `value` names it, with what is scaled in braces.
    """

    value: str
    fit: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    scale: Mapping[str, float] = dataclasses.field(default_factory=dict)
    options: Mapping[str, float] = dataclasses.field(default_factory=dict)
    played: bool = False
    stored: str = FLOAT32
    work: float = 1.0


def _cutoffs() -> tuple[Variant, ...]:
    """Constants drawn with, and those of them fitted with that save the most time."""
    values = {
        "alpha_cutoff": ("alpha", (("1/1024", 1 / 1024), ("1/64", 1 / 64), ("1/32", 1 / 32))),
        "support_radius": ("radius", (("2.5", 2.5), ("2", 2.0))),
        "transmittance_stop": ("stop", (("0.01", 0.01), ("0.1", 0.1))),
    }
    played, fitted = [], []
    for name, (shown, each) in values.items():
        played += [Variant(f"{shown} {text}, played", options={name: value}, played=True) for text, value in each]
        text, value = each[1]
        fitted.append(Variant(f"{shown} {text}, fitted", options={name: value}, work=0.85))
    return (*played, *fitted)


#: The axes, in the order they are run in; see docs/tradeoff.md for what each buys and costs.
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
        # As many frames are seen: of a batch's steps there are fewer.
        "batch": (
            Variant("2", fit={"batch_size": 2}, scale={"steps": 1 / 2}),
            Variant("4", fit={"batch_size": 4}, scale={"steps": 1 / 4}),
        ),
        "schedule": (
            Variant("full size", fit={"quarter_fraction": 0.0, "half_fraction": 0.0}, work=1.8),
            Variant("half 0.4", fit={"quarter_fraction": 0.0, "half_fraction": 0.4}, work=1.3),
            Variant("quarter 0.4, half 0.5", fit={"quarter_fraction": 0.4, "half_fraction": 0.5}, work=0.7),
        ),
        "cutoff": _cutoffs(),
        "precision": tuple(Variant(stored, stored=stored) for stored in (FLOAT16, *PASSES)),
        "power": (Variant("0", fit={"power": 0.0}), Variant("2", fit={"power": 2.0})),
        "compositing": (Variant("sum", fit={"compositing": "sum"}, work=0.85),),
        "ssim": (Variant("0", fit={"ssim_fraction": 0.0}, work=0.85), Variant("0.5", fit={"ssim_fraction": 0.5})),
        "economy": (Variant("on", fit={"economy": Economy()}, work=1.5),),
    }
)


@dataclasses.dataclass(frozen=True)
class Point:
    """A setting to be measured: `config` is fitted, drawn with `played` where that is given, and kept as `stored`."""

    axis: str
    value: str
    config: FitConfig
    played: RenderOptions | None = None
    stored: str = FLOAT32
    work: float = 1.0

    @property
    def name(self) -> str:
        return f"{self.axis} {self.value}".rstrip()

    @property
    def of_base(self) -> bool:
        """Whether it is the base's model, drawn or kept in another way."""
        return self.played is not None or self.stored != FLOAT32


class Skipped(NamedTuple):
    """A turn that is left out, and why."""

    name: str
    why: str


def check_axes(names: Sequence[str]) -> tuple[str, ...]:
    """The axes named, in the order of `AXES`. Raises ValueError for an unknown name, a name given twice and none."""
    unknown = [name for name in names if name not in AXES]
    if unknown or not names or len(set(names)) < len(names):
        got = ", ".join(unknown) if unknown else ", ".join(names) or "none"
        raise invalid("axes", expected="some of " + ", ".join(AXES) + ", each once", got=got)
    return tuple(name for name in AXES if name in names)


def points(
    base: FitConfig, axes: Sequence[str], num_frames: int, size: tuple[int, int], *, has_alpha: bool = False
) -> tuple[list[Point], list[Skipped]]:
    """The base and every turn of `axes` about it, one setting changed at a time; and the turns left out.

    Left out are those that this clip cannot have, or that change nothing for it. `base` has numbers for `steps` and
    `num_gaussians`. Raises ValueError as `check_axes`.
    """
    made, left = [Point("base", "", base)], []
    for axis in check_axes(axes):
        for turn in AXES[axis]:
            point = _turned(base, axis, turn)
            why = _why_not(point, base, num_frames, size, has_alpha)
            if why:
                left.append(Skipped(point.name, why))
            else:
                made.append(point)
    return made, left


def _turned(base: FitConfig, axis: str, turn: Variant) -> Point:
    scaled = {name: max(round(factor * getattr(base, name)), 1) for name, factor in turn.scale.items()}
    options = dataclasses.replace(base.options, **turn.options)
    fitted = base.options if turn.played else options
    config = dataclasses.replace(base, **turn.fit, **scaled, options=fitted)
    return Point(axis, turn.value.format(**scaled), config, options if turn.played else None, turn.stored, turn.work)


def _why_not(point: Point, base: FitConfig, num_frames: int, size: tuple[int, int], has_alpha: bool) -> str:
    if has_alpha and point.config.compositing == "sum":
        return "sums let all light through, and the frames have alpha"
    if point.config.batch_size > num_frames:
        return f"there are {num_frames} frames"
    if point.of_base:
        return ""
    shares = {"quarter_fraction": base.quarter_fraction, "half_fraction": base.half_fraction}
    same = dataclasses.replace(point.config, **shares) == base
    same = same and plan_levels(point.config, size) == plan_levels(base, size)
    return f"it changes nothing at {size[0]}x{size[1]}" if same else ""


class Throughput(NamedTuple):
    """Seconds: of what comes before a fit's first step, of a step of the base, and of looking at a model."""

    start: float
    step: float
    look: float


def seconds_of(made: Sequence[Point], steps: int, pace: Throughput, num_frames: int) -> float:
    """What measuring the points takes, about, if the base has so many steps."""
    fixed, each = _costs(made, pace, num_frames)
    return fixed + each * steps


def steps_within(seconds: float, made: Sequence[Point], pace: Throughput, num_frames: int) -> int:
    """Steps of the base with which measuring the points takes so many seconds; below 1 where none are left for it."""
    fixed, each = _costs(made, pace, num_frames)
    return math.floor((seconds - fixed) / each)


def _costs(made: Sequence[Point], pace: Throughput, num_frames: int) -> tuple[float, float]:
    """Seconds that steps do not change, and seconds for each step of the base."""
    fits = [point for point in made if not point.of_base]
    compressing = sum(_COMPRESSING[point.stored] for point in made) * num_frames * pace.step
    return (
        len(fits) * pace.start + len(made) * pace.look + compressing,
        sum(point.work for point in fits) * pace.step,
    )


def front(cost: Sequence[float], quality: Sequence[float], least_gain: float = LEAST_GAIN) -> list[int]:
    """Indices of the Pareto front, the cheapest first: each is better by more than `least_gain` than all cheaper ones.

    **Shapes:** one cost and one quality per point. Points with a number that is not finite are left out; of those that
    cost the same and differ by no more than `least_gain`, the first one stands.

    **Example:** `front([1, 2, 3], [30, 29, 33]) == [0, 2]`.
    """
    known = [k for k in range(len(cost)) if math.isfinite(cost[k]) and math.isfinite(quality[k])]
    chosen, best = [], -math.inf
    for k in sorted(known, key=lambda k: (cost[k], -quality[k])):
        if quality[k] > best + least_gain:
            least = max(quality[k] - least_gain, best + least_gain)
            chosen.append(next(j for j in known if cost[j] == cost[k] and quality[j] >= least))
            best = quality[k]
    return chosen


def knee(cost: Sequence[float], quality: Sequence[float]) -> int | None:
    """Index of the knee of a front, costs rising: where it is farthest above the chord between its two ends.

    Both axes are logarithms, scaled to [0, 1]: of the cost, which must be above 0, and of the squared error, which a
    quality in dB is. None for fewer than three points, and where none is above the chord.

    **Example:** `knee([1, 2, 16], [30, 36, 38]) == 1`.

    **Source:** the criterion of Satopaa et al. 2011, "Finding a Kneedle in a Haystack", without its smoothing.
    """
    if len(cost) < 3:
        return None
    x, y = np.log(np.asarray(cost, float)), np.asarray(quality, float)
    above = (y - y[0]) / (y[-1] - y[0]) - (x - x[0]) / (x[-1] - x[0])
    best = int(np.argmax(above))
    return best if above[best] > 1e-9 else None


def halved(model: VideoModel) -> VideoModel:
    """The model to be stored with 16-bit numbers, in about half the bytes.

    Its splats have the form that they are stored in (`to_stored`) and leaves of NumPy's float16, which
    `foldgauss.io.save_video_model` keeps and a file's reader widens again. Frame times, the envelope and leaves with
    numbers beyond 65,504, as coefficients of Gaussians that live for a frame have them, stay as they are.
    """
    splats, short = to_stored(model.splats), {}
    for field in dataclasses.fields(splats):
        leaf = getattr(splats, field.name)
        if field.name == "envelope" or getattr(leaf, "dtype", None) != np.float32:
            continue
        with np.errstate(over="ignore"):
            half = np.asarray(leaf).astype(np.float16)
        if np.isfinite(half).all():
            short[field.name] = half
    return dataclasses.replace(model, splats=dataclasses.replace(splats, **short))


def seconds_per_frame(*models: VideoModel | EditedVideo) -> list[float]:
    """How long each video takes to draw a frame at its own size and times, conditioning included.

    They are drawn in turn, frame by frame, and of each frame the fastest of a few rounds counts: so what else the
    machine does tells on all alike.
    """
    playbacks = [VideoRenderer(model) for model in models]
    num_frames = min(model.num_frames for model in models)
    shown = np.unique(np.linspace(0, num_frames - 1, _SHOWN).round().astype(int))
    times = [np.asarray(model.frame_times.times())[shown] for model in models]
    for playback, own in zip(playbacks, times, strict=True):
        playback.frame(own[0])  # kernels are there from here on
    best, started = np.full((len(models), len(shown)), np.inf), time.perf_counter()
    for done in range(_ROUNDS):
        if done >= 2 and time.perf_counter() - started > _LONG:
            break
        for k in range(len(shown)):
            for number, playback in enumerate(playbacks):
                begun = time.perf_counter()
                playback.frame(times[number][k])
                best[number, k] = min(best[number, k], time.perf_counter() - begun)
    return best.mean(1).tolist()


def frames_per_second(model: VideoModel | EditedVideo | SegmentedVideo) -> float:
    """How fast a video is drawn, see `seconds_per_frame`.

    Of one in segments some are drawn, each alone: neither loading nor fades count.
    """
    if not isinstance(model, SegmentedVideo):
        return 1 / seconds_per_frame(model)[0]
    numbers = np.linspace(0, len(model.segments) - 1, _SEGMENTS_SHOWN).round().astype(int)
    chosen = [model.segments[number] for number in np.unique(numbers)]
    seconds = [segment.num_frames * seconds_per_frame(segment.model)[0] for segment in chosen]
    return sum(segment.num_frames for segment in chosen) / sum(seconds)
