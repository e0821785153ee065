"""A model made compact: the last part of a fit, started from the model."""

import dataclasses
import math
from collections.abc import Callable, Iterable

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.video.compression.quantize import dequantize
from foldgauss.video.fitting.config import DEFAULT_QUALITY, FitConfig, Strategy, Views, planned_steps
from foldgauss.video.fitting.loop import FitInfo, FitResult, check_frames, fit, start_from
from foldgauss.video.fitting.rate import COMPRESSION_START, RateControl
from foldgauss.video.fitting.state import FitState
from foldgauss.video.models.background import BLACK
from foldgauss.video.models.metrics import check_frames as check_frames_of
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import VideoModel, check_model

#: The quality without a clip, where nothing compensates for rounding.
ROUNDING_QUALITY = 80.0


def compress(
    model: VideoModel,
    frames: np.ndarray | None = None,
    *,
    quality: float | None = None,
    size_mb: float | None = None,
    psnr: float | None = None,
    steps: int | None = None,
    minutes: float | None = None,
    observers: Iterable[Callable[[FitState, FitInfo], None]] = (),
) -> FitResult:
    """Make a model compact: drop Gaussians that are not worth their bits, and round the parameters of the others.

    `frames`: the clip, uint8 (num_frames, *model.size, 3), or with alpha (..., 4), to which the model is fitted further
    meanwhile. `FitConfig` explains `quality`, `size_mb` and `psnr`. Without any, the quality is `DEFAULT_QUALITY`,
    or `ROUNDING_QUALITY` without the clip. `steps` and `minutes` are budgets (default: two thirds of the steps of a
    fit). `observers` are called after every step, as by `fit`. Gaussians are reordered. Shared paths remain, to about
    a fiftieth of a pixel. The result has the compact model, `quantized`, and the `model` that it decodes to.

    Without the clip, nothing makes up for what is dropped and rounded, and there is no `psnr`, nor a budget.

    Raises ValueError for anything but a `VideoModel` (bake edits first), for NaN or infinities, a
    degree above 15, and frames that do not fit.

    Example: `save_compact("clip.fgz", compress(model, clip.frames, quality=60).quantized)`.
    """
    check_model(model)
    config = FitConfig(
        degree=model.degree,
        power=float(model.splats.envelope.power),
        floor=float(model.splats.envelope.floor),
        quality=quality,
        size_mb=size_mb,
        psnr=psnr,
        steps=steps,
        minutes=minutes,
        compositing=model.compositing,
        options=model.options,
        strategy=Strategy(relocated_fraction=0.0, scale_cutoff=model.scale_cutoff),
        views=Views(interpolation_fraction=0.0),
    )
    if not config.is_compact:
        config = dataclasses.replace(config, quality=ROUNDING_QUALITY if frames is None else DEFAULT_QUALITY)
    if frames is None:
        for name, value in (("psnr", psnr), ("steps", steps), ("minutes", minutes)):
            require(value is None, name, expected="none without the clip", got=value, cure="Give the clip, too.")
        return _round_only(model, config)
    check_frames_of(model, frames)
    check_frames(frames)
    budget = planned_steps(dataclasses.replace(config, minutes=None), len(frames))
    state = start_from(model, config, steps or math.ceil((1 - COMPRESSION_START) * budget), COMPRESSION_START)
    config = dataclasses.replace(config, steps=state.plan if steps else None)
    RateControl(frames, config).check_size(state)
    return fit(frames, config, fps=model.fps, state=state, observers=observers)


def _round_only(model: VideoModel, config: FitConfig) -> FitResult:
    background = None if model.compositing == "over" else BLACK  # alpha is kept, whatever clip the model is of
    control = RateControl(np.stack(list(VideoRenderer(model, background=background).frames())), config)
    state = start_from(model, config, 1)
    control.check_size(state)
    control.round_only(state)
    quantized = control.finish(state, model.fps)
    return FitResult(dequantize(quantized), [], quantized)
