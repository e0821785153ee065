"""Edited videos as plain models, where they are no more than that: layers without edits, put into one array."""

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss._runtime.checks import invalid
from foldgauss.video.editing.edited_video import EditedVideo, Layer
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

_CURE = "Draw it as a video: foldgauss render, or write_video(path, video.frames(), video.fps)."


def flatten_video(video: VideoModel | EditedVideo | SegmentedVideo) -> VideoModel:
    """The plain model that draws the same pictures at all times: layers become one array, the front one first.

    Raises ValueError for what no folded model holds: edits of some times only, clocks, functions, a camera; and for
    layers of several envelopes or with cuts of their own, and for a video in segments.

    Example: `flatten_video(layers(person, street))`.
    """
    if isinstance(video, VideoModel):
        return video
    if isinstance(video, SegmentedVideo):
        got = f"one of {len(video.segments)} segments"
        raise invalid("model", expected="a model of one piece", got=got, cure=ONE_SEGMENT)
    if video.camera is not None or any(layer.overlays or layer.clocks for layer in video.layers):
        got = "one with edits that no folded model holds"
        raise invalid("model", expected="a plain model, or edits that could be baked", got=got, cure=_CURE)
    lead = video.layers[video.timeline].model
    _check_alike(video.layers, lead)
    if len(video.layers) == 1:
        return lead
    splats = _joined([layer.model.splats for layer in video.layers])
    shared = (lead.size, lead.fps, lead.options, lead.compositing, lead.scale_cutoff)
    return VideoModel(splats, lead.frame_times, *shared)


def _check_alike(layers: tuple[Layer, ...], lead: VideoModel) -> None:
    for layer in layers:
        model = layer.model
        if jax.tree.map(_number, model.splats.envelope) != jax.tree.map(_number, lead.splats.envelope):
            raise invalid("model", expected="layers of one envelope", got="several", cure=_CURE)
        if model.scale_cutoff != lead.scale_cutoff:
            raise invalid("model", expected="layers of one scale_cutoff", got="several", cure=_CURE)
        if model is not lead and layer.holds_frames:
            raise invalid("model", expected="layers without cuts", got="one that has its own", cure=_CURE)


def _number(leaf) -> tuple[float, ...]:
    return tuple(np.unique(np.asarray(leaf)).tolist())


def _joined(parts: list[FoldedSplats]) -> FoldedSplats:
    """Their Gaussians one after another; paths of a lower degree get powers of 0."""
    degree = max(part.degree for part in parts)

    def coefficients(part: FoldedSplats):
        return jnp.pad(jnp.asarray(part.coefficients), ((0, 0), (0, degree - part.degree), (0, 0)))

    names = ("loc", "log_scale", "angle_logit", "time_loc_logit", "log_time_scale", "opacity_logit", "color_dc")
    leaves = {name: jnp.concatenate([jnp.asarray(getattr(part, name)) for part in parts]) for name in names}
    return FoldedSplats(**leaves, coefficients=jnp.concatenate([*map(coefficients, parts)]), envelope=parts[0].envelope)
