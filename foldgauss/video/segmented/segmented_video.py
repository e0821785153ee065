"""Long clips as several models, each of a span of its frames, drawn as one video without a seam."""

import bisect
import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, UInt8

from foldgauss._runtime.checks import invalid, is_integer, short_repr
from foldgauss.render import RenderOptions, Splats2D
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.background import BLACK
from foldgauss.video.models.frame_times import check_frame_before, times_at
from foldgauss.video.models.renderer import PreparedVideo, VideoRenderer
from foldgauss.video.models.video_model import VideoModel, check_time

#: Models that are held ready at once; more only where more are seen: half way from the last frame of one fade to the
#: first of the next, if these are neighbours.
MAX_PREPARED = 2
#: Frames. A position so near to a frame is that frame: times k / (num_frames - 1) come back rounded.
_CLOSE = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Segment:
    """A model of the frames `first` up to, not including, `stop` of a longer clip; what is known without loading it.

    `load()` gives the model; a segment does not keep it. `metadata`: what was noted when the model was written.

    **Example:** `video.segments[3].model.render(0.5)`, an ordinary model whose times are its own.
    """

    first: int
    num_frames: int
    num_gaussians: int
    degree: int
    num_parameters: int
    size: tuple[int, int]
    fps: float
    options: RenderOptions
    compositing: str
    load: Callable[[], VideoModel | EditedVideo] = dataclasses.field(repr=False)
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict, repr=False)

    @classmethod
    def from_model(cls, first: int, model: VideoModel | EditedVideo) -> "Segment":
        """A model in memory, whose first frame is the whole clip's `first`. Raises ValueError for another type."""
        if not isinstance(model, VideoModel | EditedVideo):
            cure = "End a chain of edits with .video()." if type(model).__name__ == "Edit" else ""
            got = type(model).__name__
            raise invalid("model", expected="a VideoModel or an EditedVideo", got=got, cure=cure)
        facts = {field.name: getattr(model, field.name) for field in dataclasses.fields(cls)[1:9]}
        return cls(first, **facts, load=lambda: model)

    @property
    def stop(self) -> int:
        """The number, in the whole clip, of the frame after its last."""
        return self.first + self.num_frames

    @property
    def model(self) -> VideoModel | EditedVideo:
        """The model of its frames, an ordinary one: loaded whenever it is asked for.

        Raises ValueError where `load` gives one of other frames, and what it raises.
        """
        model = self.load()
        if (model.num_frames, tuple(model.size)) != (self.num_frames, tuple(self.size)):
            expected, got = (
                f"{one.num_frames} frames of {one.size[0]}x{one.size[1]} (height x width)" for one in (self, model)
            )
            raise invalid("segment.load()", expected=f"a model of {expected}", got=f"one of {got}")
        return model


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentedTimes:
    """Times of the frames of a clip in segments: evenly spaced in [0, 1]; one frame alone is at 0."""

    segments: tuple[Segment, ...] = dataclasses.field(repr=False)

    @property
    def num_frames(self) -> int:
        return self.segments[-1].stop

    def times(self) -> Float64[np.ndarray, " num_frames"]:
        """Frame k is at k / (num_frames - 1)."""
        return np.arange(self.num_frames) / max(self.num_frames - 1, 1)

    def cut_after(self, k: int) -> bool:
        """Whether between frames k and k + 1 nothing lies: segments meet there, or the segment has a cut of its own.

        Its model is loaded for that. Raises ValueError for a frame that is none, or the last.
        """
        check_frame_before(k, self.num_frames)
        number = bisect.bisect_right(self.segments, k, key=lambda segment: segment.first) - 1
        segment = self.segments[number]
        return k + 1 == segment.stop or segment.model.frame_times.cut_after(k - segment.first)


class SegmentedVideo:
    """Models of a clip's segments as one video: drawn, played and saved as a `VideoModel` is.

    Each segment's own frame times and cuts are kept: the time between frames k and k + 1 of the clip is that between
    these frames of the segment. Where neighbours share frames, a to b - 1, their pictures are faded one into the other:
    at frame position p the later one has the share (p - a + 1) / (b - a + 1), which rises from 0 at frame a - 1 to 1 at
    frame b. Before its first frame and after its last a model shows that frame. Where neighbours share nothing, they
    meet at a cut, and between the two frames the nearer one is shown.

    Models are loaded when they are drawn, and at most `MAX_PREPARED` of them are held ready.

    **Units:** times are in [0, 1], frame k of the clip at k / (num_frames - 1), float64.

    **Example:** `SegmentedVideo.from_models([(0, first), (95, second)]).render(0.5)`.

    **Raises:** ValueError for segments that leave a gap or are out of order, for one that reaches into the one after
    the next, and for those of another size, rate, compositing or `RenderOptions`.
    """

    def __init__(self, segments: Sequence[Segment]):
        self.segments = tuple(segments)
        _check_segments(self.segments)
        lead = self.segments[0]
        self.size: tuple[int, int] = tuple(lead.size)
        self.fps: float = lead.fps
        self.options: RenderOptions = lead.options
        self.compositing: str = lead.compositing

    @classmethod
    def from_models(cls, parts: Sequence[tuple[int, VideoModel | EditedVideo]]) -> "SegmentedVideo":
        """Of models in memory, each with the number of its first frame in the whole clip."""
        return cls([Segment.from_model(first, model) for first, model in parts])

    def __repr__(self) -> str:
        return f"SegmentedVideo({len(self.segments)} segments, {self.num_frames} frames)"

    @property
    def num_frames(self) -> int:
        """Of the whole clip."""
        return self.segments[-1].stop

    @property
    def num_gaussians(self) -> int:
        """Gaussians of all segments."""
        return sum(segment.num_gaussians for segment in self.segments)

    @property
    def degree(self) -> int:
        """The highest of the folds'."""
        return max(segment.degree for segment in self.segments)

    @property
    def num_parameters(self) -> int:
        """Numbers stored, of all segments."""
        return sum(segment.num_parameters for segment in self.segments)

    @property
    def frame_times(self) -> SegmentedTimes:
        return SegmentedTimes(self.segments)

    @property
    def cuts(self) -> list[int]:
        """The frames that begin a segment at a cut; cuts within segments are their models' own."""
        pairs = pairwise(self.segments)
        return [later.first for earlier, later in pairs if later.first == earlier.stop]

    def with_options(self, options: RenderOptions) -> "SegmentedVideo":
        """The same, drawn with other constants."""
        if options == self.options:
            return self

        def changed(segment: Segment) -> Segment:
            return dataclasses.replace(segment, options=options, load=lambda: segment.model.with_options(options))

        return SegmentedVideo([changed(segment) for segment in self.segments])

    def prepare(self, size: tuple[int, int]) -> "PreparedSegmentedVideo":
        """Made ready to be conditioned many times, for pictures of `size`."""
        return PreparedSegmentedVideo(self, size)

    def at(self, t: float, size: tuple[int, int] | None = None) -> Splats2D:
        """The splats of time t, front to back, in pixels of a picture of `size` (default: its own); NumPy leaves.

        In a fade they are those of the model that is seen more of.
        """
        check_time(t)
        return self.prepare(self.size if size is None else size).splats(float(t))

    def render(
        self,
        t: float,
        size: tuple[int, int] | None = None,
        *,
        background: tuple[float, float, float] = BLACK,
    ) -> Float[np.ndarray, "height width 3"]:
        """The picture at any time t in [0, 1], values about [0, 1], over `background`; of `VideoRenderer`, so NumPy."""
        check_time(t)
        return np.moveaxis(VideoRenderer(self, size, background=background).image(t), 0, -1)

    def frames(
        self,
        times: np.ndarray | None = None,
        size: tuple[int, int] | None = None,
        *,
        background: tuple[float, float, float] = BLACK,
    ) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """Pictures at `times` (default: the frame times) one by one, over `background`, uint8 (height, width, 3)."""
        yield from VideoRenderer(self, size, background=background).frames(times)

    def _repr_html_(self) -> str | None:
        """The player, in a notebook, as of a `VideoModel`; None where its page would be too large."""
        return VideoModel._repr_html_(self)

    def position(self, t: float) -> float:
        """The frame position of time t: 2.5 is half way from frame 2 to frame 3."""
        position = float(min(max(float(t), 0.0), 1.0) * (self.num_frames - 1))
        nearest = round(position)
        return float(nearest) if abs(position - nearest) < _CLOSE else position

    def weights(self, position: float) -> list[tuple[int, float]]:
        """Which segments are seen at a frame position, in order, and how much of each: the weights sum to 1.

        Raises ValueError for a position outside the clip.
        """
        if not 0 <= position <= self.num_frames - 1:
            raise invalid("position", expected=f"a frame position in [0, {self.num_frames - 1}]", got=position)
        number = bisect.bisect_left(self.segments, position + 1, key=lambda segment: segment.first) - 1
        position, seen, left = float(position), [], 1.0
        while left > 0:  # the later ones cover the earlier ones
            share = self._risen(number, position)
            if share > 0:
                seen.append((number, left * share))
            left, number = left * (1 - share), number - 1
        return seen[::-1]

    def _risen(self, number: int, position: float) -> float:
        """How far a segment has covered the one before: 0 until it is to be seen, then up to 1."""
        if number == 0:
            return 1.0
        first, stop = self.segments[number].first, self.segments[number - 1].stop
        if first == stop:  # a cut
            return float(position >= first - 0.5)
        return min(max((position - first + 1) / (stop - first + 1), 0.0), 1.0)


class PreparedSegmentedVideo:
    """The splats of a video in segments by time, in pixels of a picture of `size`, see `PreparedModel`."""

    def __init__(self, video: SegmentedVideo, size: tuple[int, int]):
        self._video, self._size = video, tuple(size)
        self._ready: OrderedDict[int, tuple[PreparedVideo, np.ndarray]] = OrderedDict()

    def splats(self, t: float) -> Splats2D:
        """The splats of time t, of the segment that is seen most; NumPy leaves."""
        position = self._video.position(t)
        number, _ = max(self._video.weights(position), key=lambda pair: pair[1])
        stage, time = self._at(number, position, MAX_PREPARED)
        return stage.splats(time)

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """The pictures of the segments that are seen at time t, see `foldgauss.video.models.renderer.PreparedVideo`."""
        position, parts = self._video.position(t), []
        weights = self._video.weights(position)
        for number, weight in weights:
            stage, time = self._at(number, position, max(len(weights), MAX_PREPARED))
            parts += [(weight * own, splats) for own, splats in stage.weighted_splats(time)]
        return parts

    def _at(self, number: int, position: float, most: int) -> tuple[PreparedVideo, np.ndarray]:
        """A segment made ready, one of at `most` so many, and its own time at a position in the whole clip."""
        stage, times = self._prepared(number, most)
        return stage, times_at(times, position - self._video.segments[number].first)

    def _prepared(self, number: int, most: int) -> tuple[PreparedVideo, np.ndarray]:
        if number not in self._ready:
            while len(self._ready) >= most:
                self._ready.popitem(last=False)  # before the next is loaded, so that there is room for it
            model = self._video.segments[number].model
            self._ready[number] = model.prepare(self._size), np.asarray(model.frame_times.times())
        self._ready.move_to_end(number)
        return self._ready[number]


def _check_segments(segments: tuple[Segment, ...]) -> None:
    """Raise unless they cover a clip in their order, at most two at a frame, and go together."""
    if not segments:
        raise invalid("segments", expected="at least one", got="none")
    for number, segment in enumerate(segments):
        if not isinstance(segment, Segment):
            cure = "Of models: SegmentedVideo.from_models([(first, model), ...])."
            raise invalid(f"segments[{number}]", expected="a Segment", got=short_repr(segment), cure=cure)
        if not is_integer(segment.first, 0):
            expected = "the number of a frame of the whole clip"
            raise invalid(f"segments[{number}].first", expected=expected, got=short_repr(segment.first))
    if segments[0].first != 0:
        cure = "Count frames from the first one's."
        raise invalid("segments", expected="the first one to begin at frame 0", got=segments[0].first, cure=cure)
    for number, (one, other) in enumerate(pairwise(segments)):
        _check_neighbours(number, one, other)
        _check_alike(number + 1, segments[0], other)
    for number, (one, other) in enumerate(zip(segments, segments[2:], strict=False)):
        if other.first < one.stop:
            expected = f"segment {number + 2} to begin at frame {one.stop} or later, where segment {number} has ended"
            cure = "At most two segments share a frame: leave one out, or let them overlap less."
            raise invalid("segments", expected=expected, got=f"frame {other.first}", cure=cure)


def _check_neighbours(number: int, one: Segment, other: Segment) -> None:
    if not (one.first < other.first and one.stop < other.stop):
        expected = f"segment {number + 1} to begin and to end after segment {number}, {one.first}:{one.stop}"
        cure = "Give them in the clip's order, none within another."
        raise invalid("segments", expected=expected, got=f"{other.first}:{other.stop}", cure=cure)
    if other.first > one.stop:
        expected = f"segment {number + 1} to begin at frame {one.stop} at the latest, where segment {number} ends"
        cure = f"Fit frames {one.stop}:{other.first}, too."
        raise invalid("segments", expected=expected, got=f"frame {other.first}", cure=cure)


def _check_alike(number: int, lead: Segment, other: Segment) -> None:
    for name in ("size", "fps", "compositing", "options"):
        one, two = getattr(lead, name), getattr(other, name)
        if one != two:
            expected = f"{one!r}, that of the first segment"
            cure = "All are drawn as one video: fit them alike."
            raise invalid(f"segments[{number}].{name}", expected=expected, got=repr(two), cure=cure)


def plan_segments(num_frames: int, cuts: Sequence[int], *, length: int, overlap: int) -> list[tuple[int, int]]:
    """Spans [first, stop) of frames that cover a clip: of about `length` frames, parted at cuts where there are any.

    `cuts` are the frames that begin another shot. From each start the cut nearest to `length` frames on, from half of
    that to one and a half, ends the segment, and the next begins with the shot: nothing is shared. Where there is
    none, the segment has `length` frames, and the next begins `overlap` frames before its end. None but one alone is
    shorter than half of `length`: the last two are evened out, and no cut leaves less.

    **Example:** `plan_segments(250, [90], length=100, overlap=5)` is `[(0, 90), (90, 190), (185, 250)]`.

    **Raises:** ValueError for no frames, a length below 2, cuts outside the clip, and an overlap that is not from 1 to
    half of the length.
    """
    if not is_integer(num_frames, 1):
        raise invalid("num_frames", expected="a whole number >= 1", got=short_repr(num_frames))
    if not is_integer(length, 2):
        raise invalid("length", expected="a whole number of frames >= 2", got=short_repr(length))
    if not (is_integer(overlap, 1) and 2 * overlap <= length):
        expected = f"a whole number of frames from 1 to {length // 2}, half of the length"
        raise invalid("overlap", expected=expected, got=short_repr(overlap))
    for cut in cuts:
        if not (is_integer(cut, 1) and cut < num_frames):
            expected = f"frames from 1 to {num_frames - 1} that begin a shot"
            raise invalid("cuts", expected=expected, got=short_repr(cut), cure="Count from the clip's first frame.")
    num_frames, length, overlap = int(num_frames), int(length), int(overlap)
    ordered, spans, first = sorted(map(int, cuts)), [], 0
    while (left := num_frames - first) > length:
        last_cut = min(first + 3 * length // 2, num_frames - -(-length // 2))
        near = ordered[bisect.bisect_left(ordered, first + -(-length // 2)) : bisect.bisect_right(ordered, last_cut)]
        if near:
            stop = next_first = min(near, key=lambda cut: abs(cut - first - length))
        else:
            shared, stop = overlap, first + length
            if 2 * (num_frames - stop + overlap) < length:  # what is left would be short
                shared = min(overlap, left - 2 * overlap)  # so that the last does not reach the one before these two
                stop = first + -(-(left + shared) // 2)
            next_first = stop - shared
        spans.append((first, stop))
        first = next_first
    return [*spans, (first, num_frames)]
