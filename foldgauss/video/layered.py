"""Fits in layers: each object of a clip, and the background behind them, has Gaussians of its own."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from foldgauss.video.editing.edited_video import EditedVideo, Layer
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import FitInfo, FitResult, finish, fit_steps
from foldgauss.video.fitting.state import FitState
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion.background_plate import Alignment, Frames
from foldgauss.video.motion.layer_clips import BACKGROUND, separate
from foldgauss.video.motion.optical_flow import motion_finder

#: Bytes for a pixel of an object, relative to a pixel of the background. Objects deform; the background moves with the
#: camera.
OBJECT_SHARE = 3.0
#: The least time for all objects together, relative to the time for the background.
LEAST_SHARE = 0.25
#: The mean squared error in objects, relative to the background, in fits of a given PSNR.
OBJECT_ERROR = 3.0


class LayerPlan(NamedTuple):
    """What is fitted as one layer."""

    name: str
    frames: np.ndarray  #: uint8 (num_frames, height, width, 4) of an object, (..., 3) of the background
    config: FitConfig
    cuts: Sequence[int] | None = None  #: of the clip: all layers have the same frame times; None: to be found
    unknown: float = 0.0  #: fraction of what is behind objects that no frame shows, of the background


def plan_layers(
    frames: Frames,
    masks: Mapping[str, Bool[np.ndarray, "frames height width"]],
    config: FitConfig,
    *,
    shadows: bool = False,
    alignment: Alignment | None = None,
) -> list[LayerPlan]:
    """The layers of a clip, from front to back: see `separate`, which takes `shadows` and `alignment`, too.

    Frame times are not learned, so that they are the same in all layers. `minutes` are divided by the roots of the
    areas of the layers, since a step takes some time whatever the area, and `size_mb` by the areas, where a pixel of an
    object counts `OBJECT_SHARE`. `psnr` is the goal of the composited video. The goals of the layers follow from it:
    the squared error is `OBJECT_ERROR` times as large in objects, and transparent pixels have none. Without masks, the
    background is the only layer.
    """
    parts, unknown = (
        separate(frames, masks, shadows=shadows, alignment=alignment) if masks else ({BACKGROUND: frames}, 0.0)
    )
    cuts = motion_finder(frames)().cuts
    areas = np.array([mask.mean() for mask in masks.values()])
    least = LEAST_SHARE / max(len(areas), 1)
    shares = {"minutes": [*np.maximum(np.sqrt(areas), least), 1.0], "size_mb": [*OBJECT_SHARE * areas, 1.0]}
    plans = []
    for number, (name, own) in enumerate(parts.items()):
        changes: dict[str, float] = {"rates.frame_times": 0.0}
        for key, of in shares.items():
            if getattr(config, key) is not None:
                changes[key] = float(getattr(config, key) * of[number] / sum(of))
        if own.shape[3] == 4:
            changes["views.interpolation_fraction"] = 0.0
        if config.psnr is not None:
            error = OBJECT_ERROR * areas[number] if own.shape[3] == 4 else 1.0
            db = config.psnr - 10 * math.log10(error / (1 + (OBJECT_ERROR - 1) * areas.sum()))
            changes["psnr"] = min(round(db, 2), 99.0)
        plans.append(LayerPlan(name, own, config.replace(**changes), cuts, unknown * (own.shape[3] == 3)))
    return plans


def stack(models: Mapping[str, VideoModel]) -> EditedVideo:
    """The video of named layers, from front to back."""
    return EditedVideo(tuple(Layer(model, name=name) for name, model in models.items()))


def fit_layers(
    frames: Frames,
    masks: Mapping[str, Bool[np.ndarray, "frames height width"]],
    config: FitConfig | None = None,
    *,
    shadows: bool = False,
    fps: float = 25.0,
    observers: Iterable[Callable[[FitState, FitInfo], None]] = (),
) -> tuple[EditedVideo, dict[str, FitResult]]:
    """Fit each object of `masks`, and the background without them, with Gaussians of its own.

    The layers composited are the clip. An object keeps its outline wherever it is moved, and the background is whole
    behind it. With `shadows`, objects have theirs. Returns the video, whose layers have the names of the masks and
    "background", and the result of each layer. Other arguments as of `fit`. Raises as `fit` and `separate`.

    Example: `fit_layers(clip.frames, {"ball": masks}, FitConfig(steps=1000))[0].render(0.5)`. Source: VeGaS, section 4.
    """
    observers, results = list(observers), {}
    for plan in plan_layers(frames, masks, FitConfig() if config is None else config, shadows=shadows):
        for state, info in fit_steps(plan.frames, plan.config, cuts=plan.cuts):
            for observe in observers:
                observe(state, info)
        model, quantized = finish(state, plan.frames, plan.config, fps)
        results[plan.name] = FitResult(model, [info], quantized)
    return stack({name: result.model for name, result in results.items()}), results
