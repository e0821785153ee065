"""The smallest compact form of a model whose pictures lose no more than they may.

Each number's step is chosen by what its error does to the picture (`sensitivities`): in the optimum of coding theory,
where bits and errors trade at one rate, every number adds the same error. One factor scales all steps; it is found by
bisection, each try rendered and measured. Gaussians whose loss costs less than their bits are worth are left out, the
others put into an order that is cheap to tell (`ordering`), and what is not rounded yet is fitted to the clip anew
(`finish`), to make up for what is.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from foldgauss._runtime.checks import invalid, is_integer, is_within
from foldgauss.video.compression.finetune import COLOR, PATH_AND_COLOR, refitted
from foldgauss.video.compression.quantize import (
    ABSENT,
    AXES,
    COLORS,
    FEATURES,
    Described,
    Quantized,
    Rule,
    cells_for,
    cells_of,
    column_names,
    dequantize,
    describe,
    in_clip,
    is_whole,
    lower_paths,
    quantize,
    shades,
    values_of,
)
from foldgauss.video.compression.sensitivity import sensitivities
from foldgauss.video.compression.sort_order import free_order, overlaps
from foldgauss.video.models.background import BLACK, composite, random_background
from foldgauss.video.models.metrics import psnr as psnr_of
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.splats import SH_C0
from foldgauss.video.models.video_model import VideoModel, check_model
from foldgauss.video.selection.contributions import Contributions

#: Assumed of the fit where neither its clip nor its PSNR is known: few fits are better, and for worse ones the loss is
#: less than stated.
ASSUMED_PSNR = 40.0
#: dB of pictures that are right but for their rounding to 8 bits, an error of variance 1/12. Better frames, as black
#: ones are, count as these: or a loss that nobody sees in them would cost all others their bits.
EXACT_PSNR = 10 * math.log10(12 * 255**2)
#: Frames that a try is measured on; the one that is taken is measured on all.
TRIED_FRAMES = 24
#: Binary logarithms of the factor of all steps, in levels: the finest and the coarsest, and how close the search comes.
_FINEST, _COARSEST, _CLOSE = -8.0, 9.0, 0.05
#: A Gaussian is left out if that adds less error than this many times a number's own: its bits, times 2 ln 2.
_WORTH = 40.0
#: How much coarser the steps are, in powers of two, that mending is first tried with; and what such a power costs, dB.
_COARSER, _SLOPE = 1.7, 0.7
#: Tries with mending, each of passes / 2 + passes / 4 passes; and the share of the loss allowed that ends them.
_TRIES, _ENOUGH = 6, 0.9
#: Powers of two that a try goes beyond all before it, at most.
_FARTHER = 2.0
#: Of the loss allowed, what leaving Gaussians out may cost once the others are fitted anew; else the next try leaves
#: out as many as steps finer by so many powers of two would.
_MISSED, _FEWER = 0.4, 0.7
#: Of the squared error allowed, what new places in the order may add, were all pairs that are let go to change places;
#: and of the loss allowed, what they may cost.
_ORDERING = 0.3
#: Fewer Gaussians than this tell nothing of how steps follow geometry.
_FEW = 100
_NOTHING = 1e-4  # of sensitivity: of Gaussians that no picture shows
_SOLID = 0.03  # of light left: less is none


@dataclasses.dataclass(frozen=True)
class Compressed:
    """A model's compact form: `quantized`, the `model` it decodes to, and what was measured.

    `loss_db`: mean PSNR of the frames before (`psnr`) less after, dB, none counted as more than `EXACT_PSNR`.
    `measured_by`: "clip", or "model" where the loss
    is that of pictures at `psnr` dB from their clip that get an error independent of theirs. `num_dropped`: Gaussians
    left out.
    """

    quantized: Quantized
    model: VideoModel
    loss_db: float
    psnr: float
    measured_by: str
    num_dropped: int


def compress(
    model: VideoModel,
    frames: np.ndarray | None = None,
    *,
    max_loss_db: float = 0.2,
    psnr: float | None = None,
    passes: int = 8,
    on_step: Callable[[str, float], None] = lambda what, loss_db: None,
) -> Compressed:
    """Quantise `model` as coarsely as `max_loss_db`, in dB of the mean PSNR of all frames, allows.

    Frames beyond `EXACT_PSNR`, 58.9 dB, count as frames of that.

    `frames`: the clip, uint8 (num_frames, *model.size, 3), or with alpha (..., 4): the loss is measured against it.
    Without it the loss is that against a clip at `psnr` dB (default: `ASSUMED_PSNR`) from the model's own pictures.

    Gaussians change places in the order where that hardly shows. What they have not got (`FoldedSplats.degrees`,
    `lasting`, `solid`) stays away, and colours that several have in common stay so.

    With the clip, `passes` over its frames mend what is lost: all leaves once Gaussians have been left out; in half as
    many, paths and colours once geometry is rounded; in a quarter, colours once paths are. What is gained so allows for
    coarser steps. With 0 nothing is mended: every number is the model's own, rounded. `on_step(what, loss_db)` is
    called now and then, with NaN where nothing has been measured yet.

    Raises ValueError for anything but a `VideoModel` (bake edits first), for one with numbers that are not finite, with
    several envelopes or a degree above 15, for frames that do not fit, and for a loss out of reach.

    Example: `save_compact("clip.fgz", compress(model, clip.frames).quantized)`.
    """
    check_model(model)
    if not is_within(max_loss_db, "(0, 60]"):
        raise invalid("max_loss_db", expected="a loss in (0, 60] dB", got=max_loss_db, cure="0.2 is hardly seen.")
    if psnr is not None and not is_within(psnr, "(0, 100]"):
        raise invalid("psnr", expected="a PSNR in (0, 100] dB", got=psnr)
    if not is_integer(passes, 0):
        raise invalid("passes", expected="a whole number >= 0", got=passes)
    on_step("looking at what each number does", math.nan)
    loss = _Loss(model, frames, psnr)
    made = None
    if passes and frames is not None:
        plan = _Plan(model)
        rounded = _rounded(plan, loss, max_loss_db, on_step)
        factor = rounded.factor + _COARSER
        made = _mended(model, plan, factor, rounded.factor, loss, max_loss_db, passes, on_step)
    if made is None:
        made = _rounded(_Plan(_ordered(model, loss, max_loss_db)), loss, max_loss_db, on_step)
    dropped = model.num_gaussians - made.model.num_gaussians
    return Compressed(made.quantized, made.model, made.loss_db, loss.psnr, loss.measured_by, dropped)


@dataclasses.dataclass(frozen=True)
class _Try:
    factor: float
    quantized: Quantized
    model: VideoModel
    loss_db: float


def _rounded(plan: "_Plan", loss: "_Loss", most: float, on_step: Callable) -> _Try:
    """The coarsest steps that lose no more than `most`, nothing mended."""
    tried = np.unique(np.linspace(0, loss.num_frames - 1, TRIED_FRAMES).round().astype(int))

    def at(factor: float, which: Int[np.ndarray, " some"]) -> _Try:
        quantized = plan.at(factor, plan.kept(factor))
        model = dequantize(quantized)
        found = loss(model, which)
        on_step("rounding", found)
        return _Try(factor, quantized, model, found)

    fine, coarse = _FINEST, _COARSEST
    while coarse - fine > _CLOSE:
        middle = (fine + coarse) / 2
        fine, coarse = (middle, coarse) if at(middle, tried).loss_db <= most else (fine, middle)
    for _ in range(8):
        made = at(fine, np.arange(loss.num_frames))
        if made.loss_db <= most:
            return made
        fine -= 2 * _CLOSE
    cure = "Allow a greater loss, or keep the .safetensors file, which is exact."
    raise invalid("max_loss_db", expected=f"at least {made.loss_db:.3g} for this model", got=most, cure=cure)


def _mended(
    model: VideoModel,
    whole: "_Plan",
    factor: float,
    least: float,
    loss: "_Loss",
    most: float,
    passes: int,
    on_step: Callable,
) -> _Try | None:
    """The coarsest steps found that lose no more than `most` once mended, `factor` first; None if not above `least`."""
    every = np.arange(loss.num_frames)

    def mend(model: VideoModel, share: float, what: str, **how: object) -> VideoModel:
        def tell() -> None:
            on_step(what, math.nan)

        return refitted(model, loss.target, math.ceil(share * passes), on_pass=tell, **how)

    while True:
        left = _some(model, whole.kept(factor))
        left = mend(left, 1, "fitting without those left out", seed=0, shared=shades(left))
        found = loss(left, every)
        if found <= _MISSED * most or factor - _FEWER <= least:
            break
        factor -= _FEWER  # so many cannot be made up for
    plan = _Plan(_ordered(left, loss, most))
    best, tried = None, {}
    for _ in range(_TRIES):
        quantized = plan.at(factor)
        described = plan.described
        for what, free, share in (("paths and colours", PATH_AND_COLOR, 0.5), ("colours", COLOR, 0.25)):
            begun = _freed(quantized, described, path=free is PATH_AND_COLOR)
            again = mend(begun, share, f"mending {what}", free=free, seed=1, shared=described.shade)
            described = _settled(quantized, again, path=free is PATH_AND_COLOR, before=described)
            columns = quantized.columns
            quantized = quantize(described, columns["class"], quantized.rules, columns["cell"])
        decoded = dequantize(quantized)
        tried[factor] = found = loss(decoded, every)
        on_step("mended", found)
        if found <= most and (best is None or factor > best.factor):
            best = _Try(factor, quantized, decoded, found)
            if found > _ENOUGH * most:
                break
        factor = _next(tried, most, least)
        if factor is None:
            break
    return best


def _next(tried: dict[float, float], most: float, least: float) -> float | None:
    """Where to try next: between the tries on either side of `most`, or beyond the last one, but not far.

    The squared error is some of its own and that of rounding, which grows as 4^factor.
    """
    aim = 0.95 * most
    below = max((factor for factor, loss in tried.items() if loss <= most), default=None)
    above = min((factor for factor, loss in tried.items() if loss > most), default=None)
    if below is not None and above is not None:
        if above - below < 0.5 * _CLOSE:
            return None
        wanted, less, more = (10 ** (loss / 10) for loss in (aim, tried[below], tried[above]))
        share = (wanted - less) / max(more - less, 1e-9)
        factor = math.log(max(4.0**below + share * (4.0**above - 4.0**below), 1e-9), 4)
        return below + min(max(factor - below, 0.1 * (above - below)), 0.9 * (above - below))
    nearest, *others = sorted(tried, key=lambda factor: abs(tried[factor] - aim))
    slope = _SLOPE
    if others:
        slope = (tried[others[0]] - tried[nearest]) / (others[0] - nearest)
        slope = min(max(slope, 0.3 * _SLOPE), 2 * _SLOPE)
    factor = nearest + min((aim - tried[nearest]) / slope, _FARTHER)
    return factor if least < factor <= _COARSEST + 2 else None


def _ordered(model: VideoModel, loss: "_Loss", most: float) -> VideoModel:
    """Its Gaussians in an order that needs fewer bits, as long as that costs a small share of the loss allowed."""
    samples = 3 * model.num_frames * math.prod(model.size)
    room = _ORDERING * samples * (10 ** ((most - loss.psnr) / 10) - 10 ** (-loss.psnr / 10))
    cells, every = cells_of(describe(model)), np.arange(loss.num_frames)
    if model.compositing == "sum":  # which has no order
        return _some(model, np.argsort(cells, kind="stable"))
    before, found = loss(model, every), overlaps(Contributions(model))
    for share in (1.0, 0.1, 0.0):
        ordered = _some(model, free_order(cells, found, share * room))
        if loss(ordered, every) <= before + _ORDERING * most:
            return ordered
    return model


def _some(model: VideoModel, kept: Bool[np.ndarray, " num"] | Int[np.ndarray, " some"]) -> VideoModel:
    """Its Gaussians of a mask, or of these numbers."""
    num = model.num_gaussians

    def cut(leaf: np.ndarray) -> np.ndarray:
        return np.asarray(leaf)[kept] if np.shape(leaf)[:1] == (num,) else leaf

    splats = model.splats
    envelope = splats.envelope
    splats = eqx.tree_at(lambda s: s.envelope, jax.tree.map(cut, splats), envelope)
    return eqx.tree_at(lambda m: m.splats, model, splats)


def _freed(quantized: Quantized, described: Described, *, path: bool) -> VideoModel:
    """The model as decoded, but with colours, and paths if asked for, not rounded."""
    model = dequantize(quantized)
    color = np.stack([described.values[name] for name in COLORS], 1) @ AXES
    splats = eqx.tree_at(lambda s: s.color_dc, model.splats, color.astype(np.float32))
    if path:
        place = lower_paths(quantized, described).astype(np.float32)
        splats = eqx.tree_at(lambda s: (s.loc, s.coefficients), splats, (place[:, 0], place[:, 1:]))
    return eqx.tree_at(lambda m: m.splats, model, splats)


def _settled(quantized: Quantized, again: VideoModel, *, path: bool, before: Described) -> Described:
    """What is to be rounded next: the numbers that were rounded, which stay, and those of `again` for the others."""
    now, values = describe(again), values_of(quantized)
    values = {name: values[name] for name in before.values} | {name: now.values[name] for name in COLORS}
    values["time"] = in_clip(values["time"])
    # Paths that stay are rounded again from the same place, hence to the same numbers.
    place, time = (now.place, values["time"]) if path else (before.place, before.values["time"])
    return dataclasses.replace(before, values=values | {"time": time}, place=place)


class _Loss:
    """What quantization costs, in dB; and, given the clip, the pictures that mending aims at."""

    def __init__(self, model: VideoModel, frames: np.ndarray | None, reference: float | None):
        self._model, self._frames, self.num_frames = model, frames, model.num_frames
        pictures = list(VideoRenderer(model).frames())
        if frames is None:
            self.measured_by, self._shown = "model", pictures
            self.psnr = ASSUMED_PSNR if reference is None else min(reference, EXACT_PSNR)
            return
        expected = (model.num_frames, *model.size)
        if frames.ndim != 4 or frames.shape[:-1] != expected or frames.shape[-1] not in (3, 4):
            raise invalid("frames", expected=f"uint8 {(*expected, 3)}, or 4 with alpha", got=frames.shape)
        if frames.dtype != np.uint8:
            raise invalid("frames", expected="uint8", got=frames.dtype)
        self.measured_by = "clip"
        self._shown = frames if frames.shape[-1] == 3 else [composite(frame, np.float32(BLACK)) for frame in frames]
        self._before = np.array([psnr_of(*pair) for pair in zip(self._shown, pictures, strict=True)])
        self._before = np.minimum(self._before, EXACT_PSNR)
        self.psnr = float(self._before.mean())

    def __call__(self, model: VideoModel, which: Int[np.ndarray, " some"]) -> float:
        """Mean over the frames `which`."""
        pictures = VideoRenderer(model).frames(np.asarray(model.frame_times.times())[which])
        after = np.array([psnr_of(self._shown[k], picture) for k, picture in zip(which, pictures, strict=True)])
        if self.measured_by == "clip":
            return float((self._before[which] - np.minimum(after, EXACT_PSNR)).mean())
        # Errors that are independent add up: a share 10^((psnr - after) / 10) of the clip's own.
        share = np.where(after >= 100, 0.0, 10 ** ((self.psnr - after) / 10))
        return float(10 * np.log10(1 + share).mean())

    def target(self, k: int, step: int) -> tuple[Float32[np.ndarray, "3 height width"], Float32[np.ndarray, "3"]]:
        """Frame k over another colour in every step where it lets light through: see `finish.Target`."""
        summed = self._model.compositing == "sum"
        opaque = self._frames.shape[-1] == 3
        behind = np.zeros(3, np.float32) if summed or opaque else random_background(0, step)
        frame = self._frames[k]
        picture = frame if opaque else composite(frame, behind)
        return np.ascontiguousarray(np.moveaxis(picture, -1, 0) * np.float32(1 / 255)), behind


class _Plan:
    """Classes and rules of a model's numbers, but for the one factor."""

    def __init__(self, model: VideoModel):
        self.described = describe(model)
        sensitivity, best = sensitivities(Contributions(model), self.described)
        self._names = [name for name in column_names(self.described.facts.degree) if not is_whole(name)]
        self._seen = best > 0
        if not self._seen.any():
            cure = "There is nothing to see in it at any frame."
            raise invalid("model", expected="Gaussians that are seen", got="none", cure=cure)
        self._fit(sensitivity)
        opacity = 1 / (1 + np.exp(-self.described.values["opacity"]))
        # Without it: a change of -1 / (1 - opacity) in the logit, were the picture linear in it.
        own = sensitivity["opacity"] / np.maximum(1 - opacity, _SOLID) ** 2
        # Where it is solid, logits tell nothing: as if it stood a tenth of the range from what it hides.
        solid = np.where(opacity > 1 - _SOLID, sensitivity["luma"] * (0.1 / SH_C0) ** 2, 0)
        self._own = np.where(self._seen, np.maximum(own, solid), 0)

    def _fit(self, sensitivity: dict[str, Float[np.ndarray, " num"]]) -> None:
        """Logarithms of sensitivities as lines in the features; classes hold what all columns of a Gaussian share."""
        first = FEATURES[1:]
        raw = np.stack([self.described.values[name] for name in first], 1)
        for name in set(first) & set(ABSENT):
            raw[~self.described.has(name), first.index(name)] = ABSENT[name][2]
        # Beyond the bulk a line through it says nothing: steps of odd Gaussians would run away.
        features = np.clip(raw, *np.quantile(raw[self._seen], [0.001, 0.999], axis=0))
        levels = {name: 0.5 * np.log2(np.maximum(sensitivity[name], _NOTHING)) for name in self._names}
        design = np.concatenate([np.ones((len(features), 1)), features], 1)
        self._fits, rest = {}, []
        for name in self._names:
            fit, seen = np.zeros(design.shape[1]), self._seen & self.described.has(name)
            shows = seen & (sensitivity[name] > _NOTHING)  # by the others, as in black frames, lines would be steep
            if name in first or shows.sum() < _FEW:
                fit[0] = levels[name][seen].mean() if seen.any() else 0.0
            else:
                fit = np.linalg.lstsq(design[shows], levels[name][shows], rcond=None)[0]
            self._fits[name] = fit
            rest.append(np.where(seen, np.clip(levels[name] - design @ fit, -6, 6), np.nan))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of those that nobody sees
            self._classes = np.rint(np.nan_to_num(np.nanmean(rest, axis=0), nan=-6.0)).astype(np.int32)
        for name, fit in self._fits.items():
            # The same error from every column: the mean, not the typical, sensitivity by the square of the step.
            seen = self._seen & self.described.has(name)
            if not seen.any():
                continue
            told = np.concatenate([np.ones((len(raw), 1)), raw], 1) @ fit + self._classes
            fit[0] += 0.5 * np.log2(np.mean(sensitivity[name][seen] * 4.0 ** -np.clip(told[seen], -30, 30)) + 1e-30)
        if self.described.facts.shared:
            for name in COLORS:  # the steps of a colour that many share are those of one that shows as all of them do
                summed = np.bincount(self.described.shade, sensitivity[name])
                self._fits[name] = np.array([0.5 * np.log2(np.mean(summed) + 1e-30)])

    def kept(self, factor: float) -> Bool[np.ndarray, " num"]:
        """The Gaussians that are worth their bits at such steps; one at least."""
        kept = self._own > _WORTH * 4.0**factor / 12
        kept[np.argmax(self._own)] = True
        return kept

    def at(self, factor: float, kept: Bool[np.ndarray, " num"] | None = None) -> Quantized:
        """The Gaussians `kept` (None: all), steps times 2^factor; the error of a number is then about 4^factor / 12."""
        kept = np.ones(len(self._own), bool) if kept is None else kept
        described = subset(self.described, kept)
        rules, shared = {}, described.facts.shared
        for name in self._names:
            exponent, *slopes = np.round(self._fits[name], 4).tolist()
            given = described.values.get(name)
            if name in ABSENT:
                given = given[described.has(name)]
            # Stretch has its origin at 0, so that none is rounded below.
            origin = 0.0 if given is None or not given.size or name == "stretch" else round(float(np.median(given)), 4)
            slopes = (-1.0,) if name in FEATURES else (-1.0, *(-slope for slope in slopes))
            if name in COLORS and shared:
                slopes = ()
            rules[name] = Rule(origin, round(factor - exponent, 4), slopes)
        return quantize(described, self._classes[kept], rules)


def subset(described: Described, kept: Bool[np.ndarray, " num"]) -> Described:
    """Some of a model's Gaussians, in their order."""
    num = int(kept.sum())
    facts = dataclasses.replace(described.facts, num_gaussians=num, cells=cells_for(num, described.facts.size))
    values = {name: value[kept] for name, value in described.values.items()}
    shade = described.shade
    if shade is not None:
        used, shade = np.unique(shade[kept], return_inverse=True)
        facts, shade = dataclasses.replace(facts, shared=len(used)), shade.ravel().astype(np.int32)
    own = described.swapped[kept], described.turn[kept], described.without[kept], shade, values, described.place[kept]
    return Described(facts, *own, described.logits)
