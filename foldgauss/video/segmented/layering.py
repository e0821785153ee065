"""Layers of clips in segments: what stands before or behind each, in its own time."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float64

from foldgauss._runtime.checks import invalid, is_integer
from foldgauss.video.editing.chain import gather_layer
from foldgauss.video.editing.clock import NEVER, Clock, Span
from foldgauss.video.editing.edited_video import EditedVideo, Layer, as_edited, stack_layers
from foldgauss.video.editing.overlays import AbstractOverlay, GaussianFunction, Opacity, Retiming, TriangleFunction
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import MAX_PREPARED, SegmentedVideo
from foldgauss.video.selection.selectors import by_time

Video = VideoModel | EditedVideo | SegmentedVideo

#: Frames. Times so near to those of a straight line are on it.
_STRAIGHT = 1e-3
#: Of the clip. A Gaussian that is seen so near to a segment's ends is kept.
_MARGIN = 1e-4


def layers(*videos: Video, timeline: int = -1) -> EditedVideo | SegmentedVideo:
    """Videos one over another, the front one first: drawn in one pass, what is in front covers what is behind.

    Where the front lets light through, by an alpha that it was fitted with or where its Gaussians end, the next shows.
    Each keeps its own model time, [0, 1] from its first frame to its last, unless it has a clock: see `Edit.retime` and
    `Edit.freeze`. Sizes may differ in pixels, envelopes and degrees in all. The video numbered `timeline` (default: the
    last, the background) gives frame times, size and rate.

    Of a `SegmentedVideo`, which has to be the one numbered `timeline`, each segment has of the others what is seen
    while it lasts; others in segments need the same ones.

    **Example:** `layers(person, edit(street).freeze(10).video())`.

    **Raises:** ValueError for no videos, those of another aspect (to a pixel), compositing or `RenderOptions`, and for
    one with a camera: a camera sees all layers.
    """
    if not any(isinstance(video, SegmentedVideo) for video in videos):
        return stack_layers(*videos, timeline=timeline)
    if not (is_integer(timeline, -len(videos)) and timeline < len(videos)):
        raise invalid("timeline", expected=f"the number of one of {len(videos)} videos", got=timeline)
    timeline %= len(videos)
    lead = videos[timeline]
    if not isinstance(lead, SegmentedVideo):
        cure = "Give its number as timeline=."
        got = f"a {type(lead).__name__} beside one in segments"
        raise invalid("timeline", expected="the number of the video in segments", got=got, cure=cure)
    for number, video in enumerate(videos):
        if not isinstance(video, SegmentedVideo):
            as_edited(video)
        elif _spans(video) != _spans(lead):
            expected = f"the segments of video {timeline}, {_told(lead)}"
            raise invalid("videos", expected=expected, got=f"{_told(video)} in video {number}")

    @functools.lru_cache(maxsize=MAX_PREPARED)
    def made(number: int) -> EditedVideo:
        segment = lead.segments[number]
        model = segment.model
        times = np.asarray(model.frame_times.times(), np.float64)
        parts = []
        for k, video in enumerate(videos):
            if k == timeline:
                parts.append(model)
            elif isinstance(video, SegmentedVideo):
                other = video.segments[number].model
                own = np.asarray(other.frame_times.times(), np.float64)
                parts.append(_Alongside(times, own).video(as_edited(other)))
            else:
                own = lead.frame_times.times()[segment.first : segment.stop]
                parts.append(_Alongside(times, own).video(as_edited(video)))
        return stack_layers(*parts, timeline=timeline)

    segments = []
    for number, segment in enumerate(lead.segments):
        facts = {name: getattr(made(number), name) for name in ("num_gaussians", "degree", "num_parameters")}
        segments.append(dataclasses.replace(segment, **facts, load=functools.partial(made, number)))
    return SegmentedVideo(segments)


def _spans(video: SegmentedVideo) -> list[tuple[int, int]]:
    return [(segment.first, segment.stop) for segment in video.segments]


def _told(video: SegmentedVideo) -> str:
    spans = [f"{first}:{stop}" for first, stop in _spans(video)]
    return ", ".join(spans if len(spans) <= 6 else [*spans[:5], "..."])


@dataclasses.dataclass(frozen=True, eq=False)
class _Alongside:
    """Another video in the time of a segment: `times` are those of the segment's frames, `own` the other's then."""

    times: Float64[np.ndarray, " num_frames"]
    own: Float64[np.ndarray, " num_frames"]

    def video(self, other: EditedVideo) -> EditedVideo:
        """In the segment's time; the same where that is its own."""
        if self._is_straight(0.0, 1.0):
            return other
        return dataclasses.replace(other, layers=tuple(map(self._layer, other.layers)))

    def _is_straight(self, first: float, last: float) -> bool:
        """Whether times go evenly from the segment's to `first` ... `last`."""
        apart = np.abs(first + self.times * (last - first) - self.own).max()
        return bool(apart * max(len(self.own) - 1, 1) <= _STRAIGHT * abs(last - first))

    def _layer(self, layer: Layer) -> Layer:
        layer = self._seen(layer)
        overlays = tuple(moved for moved in map(self._overlay, layer.overlays) if moved is not None)
        clock = Retiming(np.ones(layer.num_gaussians, bool), None, self._clock())  # the last is asked first
        return Layer(layer.model, overlays, (*layer.clocks, clock))

    def _seen(self, layer: Layer) -> Layer:
        """Without those that are never there meanwhile, where no clock and no function could tell."""
        functions = any(isinstance(overlay, GaussianFunction | TriangleFunction) for overlay in layer.overlays)
        if layer.clocks or functions or layer.holds_frames:
            return layer
        first, last = np.clip([self.own[0] - _MARGIN, self.own[-1] + _MARGIN], 0.0, 1.0)
        there = by_time(layer.model, (first, last), alive=True).indices
        if not len(there):
            there = np.arange(1)
        nobody = np.zeros(layer.num_gaussians, bool)
        return gather_layer(layer, there, nobody, np.zeros(len(there), int)) if len(there) < len(nobody) else layer

    def _clock(self) -> Clock:
        first, last = float(self.own[0]), float(self.own[-1])
        if len(self.own) == 1:
            return Clock.frozen(first)
        if self._is_straight(first, last):
            return Clock((0.0, 1.0), (first, last))
        apart = np.concatenate([np.diff(self.times) > 0, [True]])
        return Clock(tuple(self.times[apart].tolist()), tuple(self.own[apart].tolist()))

    def _overlay(self, overlay: AbstractOverlay) -> AbstractOverlay | None:
        if isinstance(overlay, GaussianFunction | TriangleFunction):
            overlay = dataclasses.replace(overlay, function=_InTime(overlay.function, self))
        if overlay.span is None:
            return overlay
        span = self._span(overlay.span)
        if span is NEVER and not (isinstance(overlay, Opacity) and overlay.before != 1):
            return None
        return dataclasses.replace(overlay, span=span)

    def _span(self, span: Span) -> Span:
        first, last = float(self.own[0]), float(self.own[-1])
        if (span.start is not None and span.start > last) or (span.stop is not None and span.stop <= first):
            return NEVER
        start = None if span.start is None or span.start <= first else self._of(span.start)
        stop = None if span.stop is None or span.stop > last else self._of(span.stop)
        if not span.times:
            return Span(start, stop, curve=span.curve)
        corners = np.unique(np.clip([first, last, *span.times, *self.own], first, last))
        times, values = np.interp(corners, self.own, self.times), np.interp(corners, span.times, span.values)
        apart = np.concatenate([np.diff(times) > 0, [True]])
        return Span(start, stop, tuple(times[apart].tolist()), tuple(values[apart].tolist()), span.curve)

    def _of(self, own_time: float) -> float:
        return float(np.interp(own_time, self.own, self.times))

    def own_time(self, t: float) -> float:
        """The other's time at the segment's time t."""
        return float(np.interp(t, self.times, self.own))


@dataclasses.dataclass(frozen=True, eq=False)
class _InTime:
    """A function whose last argument is the other's time, as one of the segment's."""

    function: Callable[..., Any]
    alongside: _Alongside

    def __call__(self, gaussians: Any, t: float) -> Any:
        return self.function(gaussians, self.alongside.own_time(t))
