"""Layers of videos in segments: each segment with the Gaussians of the others; and layers merged into one model."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.video.editing.edited_video import (
    EditedVideo,
    Layer,
    as_edited,
    check_timeline,
    gather_layer,
    stack_layers,
)
from foldgauss.video.editing.overlays import AbstractOverlay, GaussianFunction, Retiming, is_active
from foldgauss.video.editing.timing import NEVER, TimeMap, frame_times_of
from foldgauss.video.models.shared_paths import join_paths
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel
from foldgauss.video.segmented.segmented_video import MAX_PREPARED, SegmentedVideo
from foldgauss.video.selection.selectors import by_time

Video = VideoModel | EditedVideo | SegmentedVideo

_CURE = "Render it to a video file: foldgauss render, or write_video(path, video.frames(), video.fps)."
#: Clip time. Gaussians that are alive within this margin around a segment are kept.
_MARGIN = 1e-4


def layers(*videos: Video, timeline: int = -1) -> EditedVideo | SegmentedVideo:
    """Stack videos, the front one first; they are rendered together, and what is in front covers what is behind.

    Where the front video is not opaque, through the alpha that it was fitted with or where its Gaussians end, the next
    one shows. Each video keeps its own model time, [0, 1] from its first frame to its last, unless it has a clock: see
    `Edit.retime` and `Edit.freeze`. Their sizes in pixels, envelopes and degrees may differ. The video numbered
    `timeline` (default: the last, the background) determines frame times, size and frame rate.

    A `SegmentedVideo` has to be the one numbered `timeline`: each of its segments gets the Gaussians of the other
    videos that are alive in it. Other videos in segments need the same segments.

    **Example:** `layers(person, edit(street).freeze(10).video())`.

    **Raises:** ValueError for no videos, for videos of different aspect ratio (to a pixel), compositing or
    `RenderOptions`, and for a video with a camera, since a camera is for all layers.
    """
    if not any(isinstance(video, SegmentedVideo) for video in videos):
        return stack_layers(*videos, timeline=timeline)
    check_timeline(timeline, len(videos), "videos")
    timeline %= len(videos)
    lead = videos[timeline]
    require(
        isinstance(lead, SegmentedVideo),
        "timeline",
        expected="the number of the video in segments",
        got=f"a {type(lead).__name__} beside one in segments",
        cure="Give its number as timeline=.",
    )
    for number, video in enumerate(videos):
        if not isinstance(video, SegmentedVideo):
            as_edited(video)
            continue
        require(
            _bounds(video) == _bounds(lead),
            "videos",
            expected=f"the segments of video {timeline}, {_format_bounds(lead)}",
            got=f"{_format_bounds(video)} in video {number}",
        )

    @functools.lru_cache(maxsize=MAX_PREPARED)
    def load(number: int) -> EditedVideo:
        return _stack_segment(videos, timeline, number)

    return SegmentedVideo(
        [segment.with_model(load(k), functools.partial(load, k)) for k, segment in enumerate(lead.segments)]
    )


def _stack_segment(videos: tuple[Video, ...], timeline: int, number: int) -> EditedVideo:
    """The layers of segment `number` of the video `timeline`, all in its time."""
    lead = videos[timeline]
    segment = lead.segments[number]
    model = segment.model
    clip_times = lead.frame_times.times()[segment.first : segment.stop]
    parts = []
    for k, video in enumerate(videos):
        if k == timeline:
            parts.append(model)
            continue
        other = video.segments[number].model if isinstance(video, SegmentedVideo) else video
        whole = frame_times_of(other) if isinstance(video, SegmentedVideo) else clip_times
        parts.append(_convert(as_edited(other), TimeMap(frame_times_of(model), whole)))
    return stack_layers(*parts, timeline=timeline)


def _bounds(video: SegmentedVideo) -> list[tuple[int, int]]:
    return [(segment.first, segment.stop) for segment in video.segments]


def _format_bounds(video: SegmentedVideo) -> str:
    bounds = [f"{first}:{stop}" for first, stop in _bounds(video)]
    return ", ".join(bounds if len(bounds) <= 6 else [*bounds[:5], "..."])


def _convert(other: EditedVideo, time_map: TimeMap) -> EditedVideo:
    """The other video in the segment's time; unchanged if the times are the same."""
    if time_map.is_identity:
        return other
    return dataclasses.replace(other, layers=tuple(_convert_layer(layer, time_map) for layer in other.layers))


def _convert_layer(layer: Layer, time_map: TimeMap) -> Layer:
    layer = _drop_unseen(layer, time_map)
    overlays = (_convert_overlay(overlay, time_map) for overlay in layer.overlays)
    # The last clock is applied first.
    retiming = Retiming(np.ones(layer.num_gaussians, bool), None, time_map.to_whole)
    overlays = tuple(one for one in overlays if one is not None)
    return dataclasses.replace(layer, overlays=overlays, clocks=(*layer.clocks, retiming))


def _drop_unseen(layer: Layer, time_map: TimeMap) -> Layer:
    """Without the Gaussians that are not alive in the segment, unless a clock or a function may show them."""
    functions = any(isinstance(overlay, GaussianFunction) for overlay in layer.overlays)
    if layer.clocks or functions or layer.holds_frames:
        return layer
    times = np.clip(time_map.whole[[0, -1]] + [-_MARGIN, _MARGIN], 0.0, 1.0)
    alive = by_time(layer.model, times, alive=True).indices
    if not len(alive):
        alive = np.arange(1)
    num = layer.num_gaussians
    return gather_layer(layer, alive, np.zeros(num, bool)) if len(alive) < num else layer


def _convert_overlay(overlay: AbstractOverlay, time_map: TimeMap) -> AbstractOverlay | None:
    """The overlay in the segment's time; None if it has no effect there."""
    if isinstance(overlay, GaussianFunction):
        overlay = dataclasses.replace(overlay, function=time_map.convert_function(overlay.function))
    if overlay.span is None:
        return overlay
    span = time_map.convert_span(overlay.span)
    return None if span is NEVER and not is_active(overlay, 0.0) else dataclasses.replace(overlay, span=span)


# ------------------------------------------------------------------------------------------------- flattening


def flatten_video(video: Video) -> VideoModel:
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
        require(
            jax.tree.leaves(model.splats.envelope) == jax.tree.leaves(lead.splats.envelope),
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

    def pad(part: FoldedSplats) -> FoldedSplats:
        coefficients = jnp.pad(part.coefficients, ((0, 0), (0, degree - part.degree), (0, 0)))
        return dataclasses.replace(part, coefficients=coefficients, path_index=None, paths=None)

    path_index, paths = join_paths(parts)
    # All parts have the same envelope, see `_check_alike`.
    joined = jax.tree.map(lambda one, *others: jnp.concatenate([one, *others]) if one.ndim else one, *map(pad, parts))
    return dataclasses.replace(joined, path_index=path_index, paths=paths)
