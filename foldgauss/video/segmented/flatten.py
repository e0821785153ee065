"""Flatten an edited video to a plain model: layers without overlays become one array of Gaussians."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.video.editing.edited_video import EditedVideo, Layer
from foldgauss.video.models.shared_paths import join_paths
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

_CURE = "Render it to a video file: foldgauss render, or write_video(path, video.frames(), video.fps)."


def flatten_video(video: VideoModel | EditedVideo | SegmentedVideo) -> VideoModel:
    """The plain model that renders the same at all times: its array has the layers from front to back.

    Raises ValueError if no folded model represents the video, because of edits over a span, clocks, functions or a
    camera; for layers of several envelopes, with cuts of their own or with too many shared paths, and for a video in
    segments.

    Example: `flatten_video(layers(person, street))`.
    """
    if isinstance(video, VideoModel):
        return video
    require(
        not isinstance(video, SegmentedVideo),
        "model",
        expected="a model without segments",
        got=repr(video),
        cure=ONE_SEGMENT,
    )
    require(
        video.camera is None and not any(layer.overlays or layer.clocks for layer in video.layers),
        "model",
        expected="a plain model, or edits that could be baked",
        got="one with edits that no folded model represents",
        cure=_CURE,
    )
    lead = video.layers[video.timeline].model
    _check_alike(video.layers, lead)
    if len(video.layers) == 1:
        return lead
    return dataclasses.replace(lead, splats=_concatenate([layer.model.splats for layer in video.layers]))


def _check_alike(layers: tuple[Layer, ...], lead: VideoModel) -> None:
    for layer in layers:
        model = layer.model
        own, other = (jax.tree.map(lambda leaf: np.unique(leaf).tolist(), one.splats.envelope) for one in (model, lead))
        require(
            own == other and (len(layers) <= 1 or not any(len(values) > 1 for values in (own.power, own.floor))),
            "model",
            expected="layers with one envelope",
            got="several",
            cure=_CURE,
        )
        require(
            model.scale_cutoff == lead.scale_cutoff,
            "model",
            expected="layers with one scale_cutoff",
            got="several",
            cure=_CURE,
        )
        require(
            model is lead or not layer.holds_frames,
            "model",
            expected="layers without cuts",
            got="one that has its own",
            cure=_CURE,
        )


def _concatenate(parts: list[FoldedSplats]) -> FoldedSplats:
    """The Gaussians of all parts; folds of a lower degree are padded with zero coefficients, see also `join_paths`."""
    degree = max(part.degree for part in parts)

    def gather(name: str) -> list:
        leaves = [jnp.asarray(getattr(part, name)) for part in parts]
        if name == "coefficients":
            return [jnp.pad(leaf, ((0, 0), (0, degree - leaf.shape[1]), (0, 0))) for leaf in leaves]
        return leaves

    path_index, paths = join_paths(parts)
    envelope = parts[0].envelope
    if len(parts) > 1:  # it has the same values for all Gaussians, see `_check_alike`
        envelope = jax.tree.map(lambda leaf: jnp.ravel(leaf)[0], envelope)
    shared = {"envelope": envelope, "path_index": path_index, "paths": paths}
    names = [field.name for field in dataclasses.fields(FoldedSplats) if field.name not in shared]
    return FoldedSplats(**{name: jnp.concatenate(gather(name)) for name in names}, **shared)
