"""Compression search: the coarsest quantization of a model within a stated loss of PSNR.

Each parameter's step is chosen by the sensitivity of the images to it (`estimate_sensitivities`): by rate-distortion
theory, every parameter then adds the same error. A common factor 2^coarseness scales all steps; the coarseness is found
by bisection, and each try is rendered and measured. Gaussians whose removal costs less than their bits are dropped, the
others are reordered (`sort_order`), and parameters that are not rounded yet are fine-tuned to the clip (`finetune`) to
compensate for those that are.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Bool, Float, Float32, Int

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import invalid, is_integer, is_within
from foldgauss.video.compression.finetune import finetune_model
from foldgauss.video.compression.quantize import (
    AXES,
    COLORS,
    FEATURES,
    ExactColumns,
    Quantized,
    Rule,
    choose_cell_bits,
    clamp_unit,
    column_names,
    compute_columns,
    decode_values,
    dequantize,
    estimate_bits,
    find_cells,
    is_integral,
    quantize,
    unrounded_trajectories,
)
from foldgauss.video.compression.sensitivity import estimate_sensitivities
from foldgauss.video.compression.sort_order import find_overlaps, sort_by_cell
from foldgauss.video.models.background import BLACK, composite, random_background
from foldgauss.video.models.metrics import check_frames
from foldgauss.video.models.metrics import psnr as psnr_of
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.row_layout import shift_path
from foldgauss.video.models.splats import SH_C0
from foldgauss.video.models.video_model import VideoModel, check_model
from foldgauss.video.selection.contributions import Contributions

#: PSNR assumed of the fit if neither its clip nor its PSNR is given. If the true one is lower, the loss is less than
#: stated.
ASSUMED_PSNR = 40.0
#: PSNR of an image that differs only by rounding to 8 bits, an error of variance 1/12. Better frames, such as black
#: ones, count as this: an invisible loss in them would otherwise cost all others their bits.
EXACT_PSNR = 10 * math.log10(12 * 255**2)
#: Frames that a try is measured on; the result is measured on all.
TRIED_FRAMES = 24
#: Coarseness, the binary logarithm of the common factor of all steps: the finest, the coarsest, and the tolerance of
#: the search.
_FINEST, _COARSEST, _CLOSE = -8.0, 9.0, 0.05
#: A Gaussian is dropped if that adds less error than this multiple of a parameter's own: its bits, times 2 ln 2.
_WORTH = 40.0
#: How much greater the coarseness of the first try with fine-tuning is; and the loss per power of two, dB.
_COARSER, _SLOPE = 1.7, 0.7
#: Gaussians are dropped in stages, each with passes / 2 passes of fine-tuning, after which the model should have lost
#: this fraction of the allowed loss.
_STAGES, _STAGES_OF_PASSES, _DROPPING = 5, 2, 0.75
#: How many dB a stage drops, at most `_MOST_DROPPED`: as many as fine-tuning is expected to make up for. Fine-tuning
#: leaves the fraction `_LEFT` of what was dropped; beside that it gains some dB, at first about `_FIRST_GAINED`, and in
#: each stage `_FADING` times as many as in the one before.
_FIRST_GAINED, _FADING, _LEFT, _MOST_DROPPED = 0.35, 0.8, 0.13, 6.0
#: How much greater or less than that of rounding alone the coarseness may be at which a Gaussian is not worth its bits.
_DROPPED_RANGE = 24.0
#: Leaves of `FoldedSplats` that are rounded together. Stages of rounding: the group, the fraction of the Gaussians
#: whose leaves of it are rounded then or earlier, and the passes that fine-tune everything else, as a fraction of
#: `passes`.
SHAPE = ("log_scale", "angle_logit", "time_loc_logit", "log_time_scale", "opacity_logit")
TRAJECTORY, COLOR = ("loc", "coefficients"), ("color_dc",)
_GROUPS = SHAPE, TRAJECTORY, COLOR
_RoundingStages = tuple[tuple[tuple[str, ...], float, float], ...]
_ROUNDING: _RoundingStages = (
    *((SHAPE, 0.4, 0.15), (SHAPE, 0.75, 0.15), (SHAPE, 1.0, 0.1)),
    *((TRAJECTORY, 0.5, 0.1), (TRAJECTORY, 1.0, 0.075)),
    (COLOR, 0.5, 0.05),
)
#: The same with fewer than so many passes, of which each of those stages would have one or two.
_ROUNDING_SHORT, _FEW_PASSES = ((SHAPE, 1.0, 0.25), (TRAJECTORY, 1.0, 0.125)), 24
#: Tries with fine-tuning; the fraction of the allowed loss that they aim at, and the one that ends them.
_TRIES, _AIM, _ENOUGH = 6, 0.97, 0.94
#: How many powers of two finer than without fine-tuning the steps may be where half of the Gaussians are dropped: for
#: each, a Gaussian needs about a fifth more bits.
_FINER = 4.0
#: Most powers of two by which a try may extrapolate.
_MAX_EXTRAPOLATION = 2.0
#: Fraction of the allowed squared error that reordering may add if all pairs whose order is given up are swapped; and
#: fraction of the allowed loss that it may cost.
_ORDERING = 0.3
#: Squared error that reordering may add before the fine-tuning of a stage, as a fraction of the model's own: with so
#: many passes and so large a loss allowed, and with more; in proportion to fewer passes, which compensate for less of
#: it, and to the square of a smaller loss. It is divided by so much where a stage loses too much.
_FIRST_ORDERING, _WITH_PASSES, _WITH_LOSS, _LESS_ORDERING = 1.0, 48, 0.2, 20
#: Least number of Gaussians from which steps are regressed on features.
_FEW = 100
_MIN_SENSITIVITY = 1e-4  # below, a Gaussian is not visible
_MIN_TRANSMITTANCE = 0.03  # below, a Gaussian counts as opaque


@dataclasses.dataclass(frozen=True)
class Compressed:
    """A model's compact form: `quantized`, the `model` it decodes to, and what was measured.

    `loss_db`: mean PSNR of the frames before (`psnr`) less after, dB, each at most `EXACT_PSNR`. `measured_by`: "clip";
    or "model" if there was no clip, and the loss is that of images at `psnr` dB from their clip to which independent
    errors are added. `num_dropped`: Gaussians left out.
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
    passes: int = 48,
    on_step: Callable[[str, float], None] = lambda what, loss_db: None,
) -> Compressed:
    """Quantize `model` as coarsely as `max_loss_db` allows, in dB of the mean PSNR of all frames.

    `frames`: the clip, uint8 (num_frames, *model.size, 3), or with alpha (..., 4): the loss is measured against it.
    Without it, the loss is that against a clip at `psnr` dB (default: `ASSUMED_PSNR`) from the model's own images.
    Frames beyond `EXACT_PSNR`, 58.9 dB, count as that. Gaussians are reordered. Shared paths stay as they are, to about
    a fiftieth of a pixel.

    With the clip, fine-tuning compensates for losses and allows coarser steps. Each of five stages of pruning is
    followed by `passes / 2` passes over the clip. Each try of a coarseness of the steps takes another 5/8 `passes`
    (3/8 of fewer than 24), in which parameters are rounded group by group while the others adapt. More passes make
    smaller files. Without the clip, or with 0 passes, Gaussians that are not worth their bits are dropped, and the
    parameters of the others are rounded.
    `on_step(what, loss_db)` is called now and then, with NaN before anything has been measured.

    Raises ValueError for anything but a `VideoModel` (bake edits first), for NaN or infinities, several envelopes, a
    degree above 15, frames that do not fit, and a loss out of reach.

    Example: `save_compact("clip.fgz", compress(model, clip.frames).quantized)`.
    """
    check_model(model)
    if not is_within(max_loss_db, "(0, 60]"):
        raise invalid("max_loss_db", expected="a loss in (0, 60] dB", got=max_loss_db, cure="0.2 is hardly visible.")
    if psnr is not None and not is_within(psnr, "(0, 100]"):
        raise invalid("psnr", expected="a PSNR in (0, 100] dB", got=psnr)
    if not is_integer(passes, 0):
        raise invalid("passes", expected="a whole number >= 0", got=passes)
    on_step("measuring sensitivities", math.nan)
    loss = _Loss(model, frames, psnr)
    found = None
    if passes and frames is not None:
        quantizer = _Quantizer(model)
        rounded = _search_rounded(quantizer, loss, max_loss_db, on_step)
        found = _search_finetuned(model, quantizer, rounded.coarseness, loss, max_loss_db, passes, on_step)
    if found is None:
        found = _search_rounded(_Quantizer(_reorder(model, loss, max_loss_db)), loss, max_loss_db, on_step)
    dropped = model.num_gaussians - found.model.num_gaussians
    return Compressed(found.quantized, found.model, found.loss_db, loss.psnr, loss.measured_by, dropped)


@dataclasses.dataclass(frozen=True)
class _Try:
    """A model quantized with steps times 2^`coarseness`, what it decodes to, and its loss in dB."""

    coarseness: float
    quantized: Quantized
    model: VideoModel
    loss_db: float


def _search_rounded(quantizer: "_Quantizer", loss: "_Loss", max_loss: float, on_step: Callable) -> _Try:
    """The coarsest steps that lose at most `max_loss`, without fine-tuning."""

    def attempt(coarseness: float, which: Int[np.ndarray, " some"]) -> _Try:
        quantized = quantizer.quantize(coarseness, quantizer.keep(coarseness))
        model = dequantize(quantized)
        measured = loss(model, which)
        on_step("rounding", measured)
        return _Try(coarseness, quantized, model, measured)

    fine, coarse = _FINEST, _COARSEST
    while coarse - fine > _CLOSE:
        middle = (fine + coarse) / 2
        fine, coarse = (middle, coarse) if attempt(middle, loss.sampled_frames).loss_db <= max_loss else (fine, middle)
    for _ in range(8):
        found = attempt(fine, loss.all_frames)
        if found.loss_db <= max_loss:
            return found
        fine -= 2 * _CLOSE
    cure = "Allow a greater loss, or keep the .safetensors file, which is exact."
    raise invalid("max_loss_db", expected=f"at least {found.loss_db:.3g} for this model", got=max_loss, cure=cure)


def _search_finetuned(
    model: VideoModel,
    complete: "_Quantizer",
    base: float,
    loss: "_Loss",
    max_loss: float,
    passes: int,
    on_step: Callable,
) -> _Try | None:
    """The smallest model found that loses at most `max_loss` after fine-tuning; None if rounding alone is as small.

    `base`: the coarseness that rounding alone allows.
    """

    def finetune(model: VideoModel, fraction: float, what: str, **how: object) -> VideoModel:
        return finetune_model(
            model, loss.target, math.ceil(fraction * passes), on_pass=lambda: on_step(what, math.nan), **how
        )

    ordering = _FIRST_ORDERING * min(passes / _WITH_PASSES, 1) * min(max_loss / _WITH_LOSS, 1) ** 2
    smaller = _drop_in_stages(model, complete, base, loss, max_loss, ordering, finetune, on_step)
    rounding = _ROUNDING if passes >= _FEW_PASSES else _ROUNDING_SHORT

    def search(one: VideoModel) -> _Try | None:
        least = max(base - _FINER * (model.num_gaussians / one.num_gaussians - 1), _FINEST)
        quantizer = _Quantizer(_reorder(one, loss, max_loss))
        return _search_coarseness(quantizer, base, least, loss, max_loss, rounding, finetune, on_step)

    # Where the last stage leaves too little of the loss for rounding, the one before.
    found = next(filter(None, map(search, reversed(smaller))), None)
    # Where few Gaussians could be dropped, coarser steps for all of them may need fewer bits.
    if found is not None and model.num_gaussians / 2 < found.model.num_gaussians < model.num_gaussians:
        candidates = filter(None, (found, search(model)))
        found = min(candidates, key=lambda one: estimate_bits(one.quantized))
    return found


def _drop_in_stages(
    model: VideoModel,
    quantizer: "_Quantizer",
    base: float,
    loss: "_Loss",
    max_loss: float,
    ordering: float,
    finetune: Callable,
    on_step: Callable,
) -> list[VideoModel]:
    """The model, then models with ever fewer Gaussians, fine-tuned, that lose at most `max_loss`.

    `ordering`: what reordering may add to the squared error before fine-tuning, as a fraction of the model's own.
    """
    kept, current, so_far, gained, most = [(model, 0.0)], model, 0.0, _FIRST_GAINED, _MOST_DROPPED
    for stage in range(_STAGES + 1):  # where the last one loses too much, another one that drops none
        stages_left = max(_STAGES - 1 - stage, 0)
        dropped = min(max((_DROPPING * max_loss - so_far + _FADING * gained) / _LEFT, 0.0), most)
        if dropped:
            own = quantizer if current is model else _Quantizer(current)
            current = _drop(current, own, loss, base, so_far + dropped)
        current = _Sorting(current)(ordering * loss.error)
        what = "fine-tuning after dropping Gaussians"
        current = finetune(current, 1 / _STAGES_OF_PASSES, what, seed=stage)
        before, so_far = so_far, loss(current, loss.all_frames)
        on_step("dropped", so_far)
        gained = _LEFT * dropped + before - so_far
        if so_far <= max_loss:
            kept.append((current, so_far))
            if not stages_left:
                break
        elif so_far - stages_left * _FADING * gained > max_loss:  # too many to make up for
            current, so_far = kept[-1]
            most, ordering = (most / 2, ordering / _LESS_ORDERING) if stages_left else (0.0, ordering)
    return [model for model, _ in kept]


def _search_coarseness(
    quantizer: "_Quantizer",
    base: float,
    least: float,
    loss: "_Loss",
    max_loss: float,
    stages: _RoundingStages,
    finetune: Callable,
    on_step: Callable,
) -> _Try | None:
    """As `_search_finetuned`, without dropping Gaussians; `stages` of rounding as `_ROUNDING`.

    None where no coarseness above `least` is found.
    """
    best, tried, coarseness = None, {}, base + _COARSER
    for _ in range(_TRIES):
        quantized = _round_in_stages(quantizer, coarseness, finetune, stages)
        decoded = dequantize(quantized)
        tried[coarseness] = measured = loss(decoded, loss.all_frames)
        on_step("fine-tuned", measured)
        if measured <= max_loss and (best is None or coarseness > best.coarseness):
            best = _Try(coarseness, quantized, decoded, measured)
            if measured > _ENOUGH * max_loss:
                break
        coarseness = _next_coarseness(tried, max_loss, least)
        if coarseness is None:
            break
    return best


def _next_coarseness(tried: dict[float, float], max_loss: float, least: float) -> float | None:
    """The next coarseness to try, greater than `least`; None if there is none.

    It is between those on either side of `max_loss`, or a bounded step beyond the last one.
    The squared error is modelled as a constant plus that of rounding, which grows as 4^coarseness.
    """
    aim = _AIM * max_loss
    below = max((coarseness for coarseness, loss in tried.items() if loss <= max_loss), default=None)
    above = min((coarseness for coarseness, loss in tried.items() if loss > max_loss), default=None)
    if below is not None and above is not None:
        if above - below < 0.5 * _CLOSE:
            return None
        wanted, less, more = (10 ** (loss / 10) for loss in (aim, tried[below], tried[above]))
        fraction = (wanted - less) / max(more - less, 1e-9)
        coarseness = math.log(max(4.0**below + fraction * (4.0**above - 4.0**below), 1e-9), 4)
        return below + min(max(coarseness - below, 0.1 * (above - below)), 0.9 * (above - below))
    nearest, *others = sorted(tried, key=lambda coarseness: abs(tried[coarseness] - aim))
    slope = _SLOPE
    if others:
        slope = (tried[others[0]] - tried[nearest]) / (others[0] - nearest)
        slope = min(max(slope, 0.3 * _SLOPE), 2 * _SLOPE)
    coarseness = nearest + min((aim - tried[nearest]) / slope, _MAX_EXTRAPOLATION)
    return coarseness if least < coarseness <= _COARSEST + 2 else None


def _drop(model: VideoModel, quantizer: "_Quantizer", loss: "_Loss", base: float, most: float) -> VideoModel:
    """The model without as many of the Gaussians that matter least as costs at most `most` dB."""
    fine, coarse = base - _DROPPED_RANGE, base + _DROPPED_RANGE
    while coarse - fine > 2 * _CLOSE:
        middle = (fine + coarse) / 2
        lost = loss(_take(model, quantizer.keep(middle)), loss.sampled_frames)
        fine, coarse = (middle, coarse) if lost <= most else (fine, middle)
    return _take(model, quantizer.keep(fine))


def _reorder(model: VideoModel, loss: "_Loss", max_loss: float) -> VideoModel:
    """The model with its Gaussians in an order that needs fewer bits, if that costs little of the allowed loss."""
    budget = _ORDERING * loss.error * (10 ** (max_loss / 10) - 1)
    before, sort = loss(model, loss.all_frames), _Sorting(model)
    for fraction in (1.0, 0.1, 0.0):
        reordered = sort(fraction * budget)
        if loss(reordered, loss.all_frames) <= before + _ORDERING * max_loss:
            return reordered
    return model


class _Sorting:
    """Sorts a model's Gaussians by cell; see `sort_by_cell` for the budget."""

    def __init__(self, model: VideoModel):
        self._model, self._cells = model, find_cells(compute_columns(model))
        self._overlaps = None if model.compositing == "sum" else find_overlaps(Contributions(model))

    def __call__(self, budget: float) -> VideoModel:
        if self._overlaps is None:  # any order gives the same image
            return _take(self._model, np.argsort(self._cells, kind="stable"))
        return _take(self._model, sort_by_cell(self._cells, self._overlaps, budget))


def _take(model: VideoModel, which: Bool[np.ndarray, " num"] | Int[np.ndarray, " some"]) -> VideoModel:
    return dataclasses.replace(model, splats=model.splats.take(which))


#: By the name of a group, which Gaussians' leaves of it are rounded for good.
_Fixed = dict[tuple[str, ...], Bool[np.ndarray, " num"]]


def _round_in_stages(
    quantizer: "_Quantizer", coarseness: float, finetune: Callable, stages: _RoundingStages
) -> Quantized:
    """The model quantized with steps times 2^coarseness, in `stages` as those of `_ROUNDING`."""
    quantized, exact = quantizer.quantize(coarseness), quantizer.exact
    num, rng = exact.info.num_gaussians, make_generator(Stream.ROUNDING_ORDER)
    ranks = dict.fromkeys(_GROUPS, rng.permutation(num) / num)
    fixed = {group: np.zeros(num, bool) for group in _GROUPS}
    for group, rounded, fraction in stages:
        fixed[group] = ranks[group] < rounded
        start = _round_fixed(quantized, exact, fixed)
        frozen = {name: which for group, which in fixed.items() for name in group}
        tuned = finetune(start, fraction, "fine-tuning the rest", fixed=frozen, seed=1)
        exact = _keep_fixed(quantized, exact, tuned, fixed)
        columns = quantized.columns
        cells = np.where(fixed[SHAPE], columns["cell"], find_cells(exact))
        quantized = quantize(exact, columns["class"], quantized.rules, cells)
    return quantized


def _round_fixed(quantized: Quantized, exact: ExactColumns, fixed: _Fixed) -> VideoModel:
    """The model whose leaves are decoded where they are `fixed`, and exact elsewhere."""
    model, v = dequantize(quantized), exact.values
    time = clamp_unit(np.where(fixed[SHAPE], decode_values(quantized)["time"], v["time"]))
    moved = shift_path(exact.polynomials, time - v["time"])
    polynomials = np.where(fixed[SHAPE][:, None, None], unrounded_trajectories(quantized, exact), moved)
    leaves = {
        "log_scale": np.stack([v["size"] + v["stretch"], v["size"] - v["stretch"]], 1),
        "angle_logit": scipy.special.logit(clamp_unit(v["angle"])),
        "time_loc_logit": scipy.special.logit(time),
        "log_time_scale": v["duration"],
        "opacity_logit": v["opacity"],
        "loc": polynomials[:, 0],
        "coefficients": polynomials[:, 1:],
        "color_dc": np.stack([v[name] for name in COLORS], 1) @ AXES,
    }
    for group, which in fixed.items():
        for name in group:
            own = np.asarray(getattr(model.splats, name))
            leaves[name] = np.where(which.reshape(-1, *[1] * (own.ndim - 1)), own, leaves[name])
    splats = dataclasses.replace(model.splats, **{name: np.float32(leaf) for name, leaf in leaves.items()})
    return dataclasses.replace(model, splats=splats)


def _keep_fixed(quantized: Quantized, exact: ExactColumns, tuned: VideoModel, fixed: _Fixed) -> ExactColumns:
    """The columns to quantize next: decoded values where they are `fixed`, and `tuned`'s for the others."""
    now, decoded = compute_columns(tuned), decode_values(quantized)
    of = {name: fixed[COLOR if name in COLORS else SHAPE] for name in now.values}
    values = {name: np.where(of[name], decoded[name], now.values[name]) for name in now.values}
    # Rounded trajectories are rounded again from the same exact ones, hence to the same integers.
    polynomials = np.where(fixed[TRAJECTORY][:, None, None], exact.polynomials, now.polynomials)
    return dataclasses.replace(exact, values=values | {"time": clamp_unit(values["time"])}, polynomials=polynomials)


class _Loss:
    """The loss of PSNR by quantization, in dB; and, given the clip, the targets of fine-tuning."""

    def __init__(self, model: VideoModel, frames: np.ndarray | None, reference: float | None):
        self._compositing, self._frames, self.num_frames = model.compositing, frames, model.num_frames
        self.all_frames = np.arange(model.num_frames)
        self.sampled_frames = np.unique(np.linspace(0, model.num_frames - 1, TRIED_FRAMES).round().astype(int))
        images = list(VideoRenderer(model).frames())
        if frames is None:
            self.measured_by, self._targets = "model", images
            self.psnr = ASSUMED_PSNR if reference is None else min(reference, EXACT_PSNR)
            return
        check_frames(model, frames)
        self.measured_by = "clip"
        self._targets = frames if frames.shape[-1] == 3 else [composite(frame, np.float32(BLACK)) for frame in frames]
        self._before = np.array([psnr_of(*pair) for pair in zip(self._targets, images, strict=True)])
        self._before = np.minimum(self._before, EXACT_PSNR)
        self.psnr = float(self._before.mean())

    @property
    def error(self) -> float:
        """The model's squared error at `psnr`, colors in [0, 1], summed over frames, pixels and channels."""
        return self._targets[0].size * self.num_frames * 10 ** (-self.psnr / 10)

    def __call__(self, model: VideoModel, which: Int[np.ndarray, " some"]) -> float:
        """Mean over the frames `which`."""
        images = VideoRenderer(model).frames(np.asarray(model.frame_times.times())[which])
        after = np.array([psnr_of(self._targets[k], image) for k, image in zip(which, images, strict=True)])
        if self.measured_by == "clip":
            return float((self._before[which] - np.minimum(after, EXACT_PSNR)).mean())
        # Independent squared errors add up: this one is a fraction 10^((psnr - after) / 10) of the clip's own.
        fraction = np.where(after >= 100, 0.0, 10 ** ((self.psnr - after) / 10))
        return float(10 * np.log10(1 + fraction).mean())

    def target(self, k: int, step: int) -> tuple[Float32[np.ndarray, "3 height width"], Float32[np.ndarray, "3"]]:
        """Frame k; with alpha, over another background in every step. See `finetune.Target`."""
        without_alpha = self._frames.shape[-1] == 3
        fixed = self._compositing == "sum" or without_alpha
        background = np.zeros(3, np.float32) if fixed else random_background(0, step)
        image = self._frames[k] if without_alpha else composite(self._frames[k], background)
        return np.ascontiguousarray(np.moveaxis(image, -1, 0) * np.float32(1 / 255)), background


class _Quantizer:
    """Quantizes a model by rules that are fixed but for the coarseness."""

    def __init__(self, model: VideoModel):
        self.exact = compute_columns(model)
        sensitivity, best = estimate_sensitivities(Contributions(model), self.exact)
        self._names = [name for name in column_names(self.exact.info.degree) if not is_integral(name)]
        self._seen = best > 0
        if not self._seen.any():
            cure = "No frame shows anything."
            raise invalid("model", expected="visible Gaussians", got="none", cure=cure)
        self._fit(sensitivity)
        opacity = 1 / (1 + np.exp(-self.exact.values["opacity"]))
        # Removal: a change of the logit by -1 / (1 - opacity), if the image were linear in the logit.
        loss = sensitivity["opacity"] / np.maximum(1 - opacity, _MIN_TRANSMITTANCE) ** 2
        # Opaque ones are insensitive to the logit: assume that they differ by a tenth of the range from what they hide.
        opaque = np.where(opacity > 1 - _MIN_TRANSMITTANCE, sensitivity["luma"] * (0.1 / SH_C0) ** 2, 0)
        self._removal = np.where(self._seen, np.maximum(loss, opaque), 0)

    def _fit(self, sensitivity: dict[str, Float[np.ndarray, " num"]]) -> None:
        """Regress log-sensitivities on the features; a Gaussian's class is the mean residual of its columns."""
        first = FEATURES[1:]
        raw = np.stack([self.exact.values[name] for name in first], 1)
        # Outliers are clipped: a line through the bulk would extrapolate their steps without bound.
        features = np.clip(raw, *np.quantile(raw[self._seen], [0.001, 0.999], axis=0))
        levels = {name: 0.5 * np.log2(np.maximum(sensitivity[name], _MIN_SENSITIVITY)) for name in self._names}
        design = np.concatenate([np.ones((len(features), 1)), features], 1)
        self._fits, rest = {}, []
        for name in self._names:
            fit = np.zeros(design.shape[1])
            shows = self._seen & (
                sensitivity[name] > _MIN_SENSITIVITY
            )  # others, as in black frames, would tilt the lines
            if name in first or shows.sum() < _FEW:
                fit[0] = levels[name][self._seen].mean()
            else:
                fit = np.linalg.lstsq(design[shows], levels[name][shows], rcond=None)[0]
            self._fits[name] = fit
            rest.append(np.clip(levels[name] - design @ fit, -6, 6))
        self._classes = np.rint(np.where(self._seen, np.mean(rest, axis=0), -6.0)).astype(np.int32)
        self._match_errors(sensitivity, np.concatenate([np.ones((len(raw), 1)), raw], 1))

    def _match_errors(self, sensitivity: dict[str, Float[np.ndarray, " num"]], design: np.ndarray) -> None:
        """Shift the fits so that all columns add the same error: by mean, not typical, sensitivity times step^2."""
        for name, fit in self._fits.items():
            predicted = np.clip((design @ fit + self._classes)[self._seen], -30, 30)
            fit[0] += 0.5 * np.log2(np.mean(sensitivity[name][self._seen] * 4.0**-predicted) + 1e-30)

    def keep(self, coarseness: float) -> Bool[np.ndarray, " num"]:
        """The Gaussians that are worth their bits at such steps; at least one."""
        kept = self._removal > _WORTH * 4.0**coarseness / 12
        kept[np.argmax(self._removal)] = True
        return kept

    def quantize(self, coarseness: float, kept: Bool[np.ndarray, " num"] | None = None) -> Quantized:
        """The Gaussians `kept` (None: all), with steps times 2^coarseness.

        A parameter's squared error, summed over the clip, is about 4^coarseness / 12, in levels of 8 bits.
        """
        kept = np.ones(len(self._removal), bool) if kept is None else kept
        exact = _select_rows(self.exact, kept)
        rules = {}
        for name in self._names:
            exponent, *slopes = np.round(self._fits[name], 4).tolist()
            given = exact.values.get(name)
            # Stretch is not negative: its origin is 0.
            origin = 0.0 if given is None or name == "stretch" else round(float(np.median(given)), 4)
            slopes = (-1.0,) if name in FEATURES else (-1.0, *(-slope for slope in slopes))
            rules[name] = Rule(origin, round(coarseness - exponent, 4), slopes)
        return quantize(exact, self._classes[kept], rules)


def _select_rows(exact: ExactColumns, kept: Bool[np.ndarray, " num"]) -> ExactColumns:
    """Some of a model's Gaussians, in their order."""
    num = int(kept.sum())
    info = dataclasses.replace(exact.info, num_gaussians=num, cells=choose_cell_bits(num, exact.info.size))
    values = {name: value[kept] for name, value in exact.values.items()}
    path = None if exact.path is None else exact.path[kept]
    own = exact.swapped[kept], exact.turn[kept], values, exact.polynomials[kept]
    return ExactColumns(info, *own, exact.logits, path, exact.paths)
