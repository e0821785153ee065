"""The smallest compact form of a model whose pictures lose no more than they may.

Each number's step is chosen by what its error does to the picture (`sensitivities`): in the optimum of coding theory,
where bits and errors trade at one rate, every number adds the same error. One factor scales all steps; it is found by
bisection, each try rendered and measured. Gaussians whose loss costs less than their bits are worth are left out.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int32

from foldgauss._checks import invalid, within
from foldgauss.video.alpha import BLACK, composited
from foldgauss.video.light import LitModel
from foldgauss.video.metrics import psnr
from foldgauss.video.model import VideoModel, check_model
from foldgauss.video.playback import Playback
from foldgauss.video.quantise import (
    FEATURES,
    Described,
    Quantised,
    Rule,
    column_names,
    dequantise,
    describe,
    quantise,
)
from foldgauss.video.sensitivity import sensitivities

#: Assumed of the fit where neither its clip nor its PSNR is known: few fits are better, and for worse ones the loss is
#: less than stated.
ASSUMED_PSNR = 40.0
#: Frames that a try is measured on; the one that is taken is measured on all.
TRIED_FRAMES = 24
#: Binary logarithms of the factor of all steps, in levels: the finest and the coarsest, and how close the search comes.
_FINEST, _COARSEST, _CLOSE = -14.0, 8.0, 0.06
#: A Gaussian is left out if that adds less error than this many times a number's own: its bits, times 2 ln 2.
_WORTH = 40.0
#: Fewer Gaussians than this tell nothing of how steps follow geometry.
_FEW = 100
_NOTHING = 1e-4  # of sensitivity: of Gaussians that no picture shows


@dataclasses.dataclass(frozen=True)
class Compressed:
    """A model's compact form: `quantised`, the `model` it decodes to, and what was measured.

    `loss_db`: mean PSNR of the frames before (`psnr`) less after, dB. `measured_by`: "clip", or "model" where the loss
    is that of pictures at `psnr` dB from their clip that get an error independent of theirs. `num_dropped`: Gaussians
    left out.
    """

    quantised: Quantised
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
    on_try: Callable[[float, float], None] = lambda factor, loss: None,
) -> Compressed:
    """Quantise `model` as coarsely as `max_loss_db`, in dB of the mean PSNR of all frames, allows.

    `frames`: the clip, uint8 (num_frames, *model.size, 3), or with alpha (..., 4): the loss is measured against it.
    Without it the loss is that against a clip at `psnr` dB (default: `ASSUMED_PSNR`) from the model's own pictures.
    `on_try(log2_step, loss_db)` is called after each try.

    Raises ValueError for anything but a `VideoModel` (bake edits first), for one with numbers that are not finite, with
    several envelopes or a degree above 15, for frames that do not fit, and for a loss out of reach.

    Example: `save_compact("clip.fgz", compress(model, clip.frames).quantised)`.
    """
    check_model(model)
    if not (within(max_loss_db, "(0, 60]")):
        raise invalid("max_loss_db", expected="a loss in (0, 60] dB", got=max_loss_db, cure="0.2 is hardly seen.")
    if psnr is not None and not within(psnr, "(0, 100]"):
        raise invalid("psnr", expected="a PSNR in (0, 100] dB", got=psnr)
    lit, described = LitModel(model), describe(model)
    loss = _Loss(model, frames, psnr)
    plan = _Plan(model, described, *sensitivities(lit, described))
    tried = np.unique(np.linspace(0, model.num_frames - 1, TRIED_FRAMES).round().astype(int))

    def measured(factor: float, which: np.ndarray) -> tuple[Quantised, VideoModel, float]:
        quantised = plan.at(factor)
        decoded = dequantise(quantised)
        found = loss(decoded, which)
        on_try(factor, found)
        return quantised, decoded, found

    fine, coarse = _FINEST, _COARSEST
    while coarse - fine > _CLOSE:
        # Losses grow fourfold with a doubled step: from a guess by that law, bisection closes in fast.
        middle = (fine + coarse) / 2
        found = measured(middle, tried)[2]
        fine, coarse = (middle, coarse) if found <= max_loss_db else (fine, middle)
    everything = np.arange(model.num_frames)
    for _ in range(12):
        quantised, decoded, found = measured(fine, everything)
        if found <= max_loss_db:
            dropped = model.num_gaussians - decoded.num_gaussians
            return Compressed(quantised, decoded, found, loss.psnr, loss.measured_by, dropped)
        fine -= _CLOSE if fine > _FINEST + 1 else 1.0
    cure = "Allow a greater loss, or keep the .safetensors file, which is exact."
    raise invalid("max_loss_db", expected=f"at least {found:.3g} for this model", got=max_loss_db, cure=cure)


class _Loss:
    """What quantisation costs, in dB."""

    def __init__(self, model: VideoModel, frames: np.ndarray | None, reference: float | None):
        pictures = list(Playback(model).frames())
        self._times = np.asarray(model.frame_times.times())
        if frames is None:
            self.measured_by = "model"
            self.psnr = ASSUMED_PSNR if reference is None else reference
            self._targets = pictures
        else:
            expected = (model.num_frames, *model.size)
            if frames.ndim != 4 or frames.shape[:-1] != expected or frames.shape[-1] not in (3, 4):
                raise invalid("frames", expected=f"uint8 {(*expected, 3)}, or 4 with alpha", got=frames.shape)
            self.measured_by = "clip"
            self._targets = frames if frames.shape[-1] == 3 else [composited(frame, BLACK) for frame in frames]
            self._before = np.array([psnr(*pair) for pair in zip(self._targets, pictures, strict=True)])
            self.psnr = float(self._before.mean())

    def __call__(self, model: VideoModel, which: Int32[np.ndarray, "some"]) -> float:
        pictures = Playback(model).frames(np.asarray(model.frame_times.times())[which])
        after = np.array([psnr(self._targets[k], picture) for k, picture in zip(which, pictures, strict=True)])
        if self.measured_by == "clip":
            return float((self._before[which] - after).mean())
        # Errors that are independent add up: a share 10^((reference - after) / 10) of the clip's own.
        return float(10 * np.log10(1 + 10 ** ((self.psnr - np.where(after >= 100, np.inf, after)) / 10)).mean())


class _Plan:
    """Classes and rules of a model's numbers, but for the one factor."""

    def __init__(
        self,
        model: VideoModel,
        described: Described,
        sensitivity: dict[str, Float[np.ndarray, "num"]],
        best: Float[np.ndarray, "num"],
    ):
        self._described = described
        names = [name for name in column_names(described.facts.degree) if name != "class"]
        seen = best > 0
        if not seen.any():
            cure = "There is nothing to see in it at any frame."
            raise invalid("model", expected="Gaussians that are seen", got="none", cure=cure)
        self._names, first = names, FEATURES[1:]
        # Beyond the bulk a line through it says nothing: steps of odd Gaussians would run away.
        raw = np.stack([described.values[name] for name in first], 1)
        features = np.clip(raw, *np.quantile(raw[seen], [0.001, 0.999], axis=0))
        levels = {name: 0.5 * np.log2(np.maximum(sensitivity[name], _NOTHING)) for name in names}
        design = np.concatenate([np.ones((len(features), 1)), features], 1)
        self._fits, rest = {}, []
        for name in names:
            fit = np.zeros(design.shape[1])
            if name in first or seen.sum() < _FEW:
                fit[0] = levels[name][seen].mean()
            else:
                fit = np.linalg.lstsq(design[seen], levels[name][seen], rcond=None)[0]
            self._fits[name] = fit
            rest.append(np.clip(levels[name] - design @ fit, -6, 6))
        self._classes = np.rint(np.mean(rest, axis=0)).astype(np.int32)
        for name, fit in self._fits.items():
            # The same error from every column: the mean, not the typical, sensitivity by the square of the step.
            told = np.concatenate([np.ones((len(raw), 1)), raw], 1) @ fit + self._classes
            fit[0] += 0.5 * np.log2(np.mean(sensitivity[name][seen] * 4.0 ** -np.clip(told[seen], -30, 30)) + 1e-30)
        opacity = 1 / (1 + np.exp(-described.values["opacity"]))
        # Without it: a change of -1 / (1 - opacity) in the logit, were the picture linear in it.
        self._own = np.where(seen, sensitivity["opacity"] / np.maximum(1 - opacity, 1e-3) ** 2, 0)

    def at(self, factor: float) -> Quantised:
        """The model with all steps times 2^factor; the error of a number is then about 4^factor / 12."""
        kept = self._own > _WORTH * 4.0**factor / 12
        if not kept.any():
            kept[np.argmax(self._own)] = True
        described = subset(self._described, kept)
        rules = {"class": Rule(0.0, 0.0)}
        for name in self._names:
            exponent, *slopes = np.round(self._fits[name], 4).tolist()
            given = described.values.get(name)
            origin = 0.0 if given is None else round(float(np.median(given)), 4)
            slopes = () if name in FEATURES else tuple(-slope for slope in slopes)
            rules[name] = Rule(origin, round(factor - exponent, 4), (-1.0, *slopes))
        return quantise(described, self._classes[kept], rules)


def subset(described: Described, kept: np.ndarray) -> Described:
    """Some of a model's Gaussians, in their order."""
    facts = dataclasses.replace(described.facts, num_gaussians=int(kept.sum()))
    values = {name: value[kept] for name, value in described.values.items()}
    own = described.swapped[kept], described.turn[kept], values, described.place[kept]
    return Described(facts, *own, described.logits)
