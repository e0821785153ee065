"""Videos in segments: one model per span of frames of a long clip, blended over shared frames."""

import bisect
import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64

from foldgauss._runtime.checks import is_integer, require, short_repr
from foldgauss.render import RenderOptions, Splats2D
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.frame_times import times_at
from foldgauss.video.models.renderer import FollowingVideo, PreparedVideo
from foldgauss.video.models.video_model import VideoModel

#: Models that are kept prepared at once; as many as are visible, where more are (between the last frame of one fade and
#: the first frame of the next).
MAX_PREPARED = 2
#: Frames. A position this close to a frame is that frame: times k / (num_frames - 1) are rounded.
_FRAME_TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Segment:
    """A model of the frames from `first` up to, not including, `stop` of a longer clip, and its properties.

    `load()` returns the model; a segment does not keep it. `metadata`: of the model's file.

    **Example:** `video.segments[3].model.render(0.5)`, a model with its own times in [0, 1].
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
        """A segment of a model in memory, from frame `first` of the clip on. Raises ValueError for other types."""
        require(
            isinstance(model, VideoModel | EditedVideo),
            "model",
            expected="a VideoModel or an EditedVideo",
            got=type(model).__name__,
            cure="End a chain of edits with .video()." if type(model).__name__ == "Edit" else "",
        )
        properties = {field.name: getattr(model, field.name) for field in dataclasses.fields(cls)[1:9]}
        return cls(first, **properties, load=lambda: model)

    def with_model(self, model: VideoModel | EditedVideo, load: Callable[[], VideoModel | EditedVideo]) -> "Segment":
        """The segment with another model of its frames, which `load` returns."""
        properties = {name: getattr(model, name) for name in ("num_gaussians", "degree", "num_parameters")}
        return dataclasses.replace(self, **properties, load=load)

    @property
    def stop(self) -> int:
        """The clip's number of the frame after its last."""
        return self.first + self.num_frames

    @property
    def model(self) -> VideoModel | EditedVideo:
        """The model, loaded on each access. Raises ValueError if it has other frames, and the errors of `load`."""
        model = self.load()
        require(
            (model.num_frames, tuple(model.size)) == (self.num_frames, tuple(self.size)),
            "segment.load()",
            expected=f"a model of {self.num_frames} frames of {self.size[0]}x{self.size[1]} (height x width)",
            got=f"one of {model.num_frames} frames of {model.size[0]}x{model.size[1]} (height x width)",
        )
        return model


@dataclasses.dataclass(frozen=True)
class SegmentedTimes:
    """Frame times of a clip in segments: evenly spaced in [0, 1]; the frame of a clip with one frame is at 0."""

    num_frames: int

    def times(self) -> Float64[np.ndarray, " num_frames"]:
        """Frame k is at k / (num_frames - 1)."""
        return np.arange(self.num_frames) / max(self.num_frames - 1, 1)


class SegmentedVideo(FollowingVideo):
    """The models of a clip's segments as one video; it is rendered, played and saved as a `VideoModel` is.

    Each segment keeps its own frame times and cuts: times between frames k and k + 1 of the clip are interpolated
    between those of the segment. Where neighbors share frames, a to b - 1, they are cross-faded: at frame position p
    the later one has weight (p - a + 1) / (b - a + 1), which rises from 0 at frame a - 1 to 1 at frame b. Before its
    first frame and after its last a model shows that frame. Neighbors that share no frame meet at a cut, and between
    the two frames the nearer one is shown.

    Models are loaded when they are rendered, and at most `MAX_PREPARED` of them are kept.

    **Units:** times are in [0, 1], frame k of the clip at k / (num_frames - 1), float64.

    **Example:** `SegmentedVideo.from_models([(0, first), (95, second)]).render(0.5)`.

    **Raises:** ValueError for segments that leave a gap or are out of order, for more than two segments at one frame,
    and for segments of different size, frame rate, compositing or `RenderOptions`.
    """

    def __init__(self, segments: Sequence[Segment]):
        self.segments = tuple(segments)
        _check_segments(self.segments)

    @property
    def _lead(self) -> Segment:
        return self.segments[0]

    @classmethod
    def from_models(cls, parts: Sequence[tuple[int, VideoModel | EditedVideo]]) -> "SegmentedVideo":
        """A video of models in memory, each with the clip's number of its first frame."""
        return cls([Segment.from_model(first, model) for first, model in parts])

    def __repr__(self) -> str:
        return f"SegmentedVideo({len(self.segments)} segments, {self.num_frames} frames)"

    @property
    def num_frames(self) -> int:
        """The number of frames of the whole clip."""
        return self.segments[-1].stop

    @property
    def num_gaussians(self) -> int:
        """The number of Gaussians of all segments."""
        return sum(segment.num_gaussians for segment in self.segments)

    @property
    def degree(self) -> int:
        """The highest degree of the folds."""
        return max(segment.degree for segment in self.segments)

    @property
    def num_parameters(self) -> int:
        """Numbers stored, of all segments."""
        return sum(segment.num_parameters for segment in self.segments)

    @property
    def frame_times(self) -> SegmentedTimes:
        return SegmentedTimes(self.num_frames)

    @property
    def cuts(self) -> list[int]:
        """The first frames of segments that begin at a cut, without the cuts within segments."""
        pairs = pairwise(self.segments)
        return [later.first for earlier, later in pairs if later.first == earlier.stop]

    def with_options(self, options: RenderOptions) -> "SegmentedVideo":
        """The same video, rendered with other options."""
        if options == self.options:
            return self

        def replace(segment: Segment) -> Segment:
            return dataclasses.replace(segment, options=options, load=lambda: segment.model.with_options(options))

        return SegmentedVideo(list(map(replace, self.segments)))

    def prepare(self, size: tuple[int, int]) -> "PreparedSegmentedVideo":
        """The video prepared for conditioning on many times, for images of `size`."""
        return PreparedSegmentedVideo(self, size)

    def position(self, t: float) -> float:
        """The frame position at time t: 2.5 is half way from frame 2 to frame 3."""
        position = float(min(max(float(t), 0.0), 1.0) * (self.num_frames - 1))
        nearest = round(position)
        return float(nearest) if abs(position - nearest) < _FRAME_TOLERANCE else position

    def weights(self, position: float) -> list[tuple[int, float]]:
        """The segments that are visible at a frame position, in order, with their weights, which sum to 1.

        Raises ValueError for a position outside the clip.
        """
        require(
            0 <= position <= self.num_frames - 1,
            "position",
            expected=f"a frame position in [0, {self.num_frames - 1}]",
            got=position,
        )
        number = bisect.bisect_left(self.segments, position + 1, key=lambda segment: segment.first) - 1
        position, visible, left = float(position), [], 1.0
        while left > 0:  # from the last segment to earlier ones
            weight = self._fade_weight(number, position)
            if weight > 0:
                visible.append((number, left * weight))
            left, number = left * (1 - weight), number - 1
        return visible[::-1]

    def _fade_weight(self, number: int, position: float) -> float:
        """The weight of a segment over the one before: 0 before the frames that they share, 1 after."""
        if number == 0:
            return 1.0
        first, stop = self.segments[number].first, self.segments[number - 1].stop
        if first == stop:  # a cut
            return float(position >= first - 0.5)
        return min(max((position - first + 1) / (stop - first + 1), 0.0), 1.0)


class PreparedSegmentedVideo(PreparedVideo):
    """A video in segments prepared for images of `size`, see `PreparedModel`; models are loaded when needed."""

    def __init__(self, video: SegmentedVideo, size: tuple[int, int]):
        self._video, self._size = video, tuple(size)
        self._kept: OrderedDict[int, tuple[PreparedVideo, np.ndarray]] = OrderedDict()

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """The splats of the segments that are visible at time t, see `PreparedVideo`."""
        position, parts = self._video.position(t), []
        weights = self._video.weights(position)
        for number, weight in weights:
            prepared, time = self._prepare_at(number, position, max(len(weights), MAX_PREPARED))
            parts += [(weight * own, splats) for own, splats in prepared.weighted_splats(time)]
        return parts

    def _prepare_at(self, number: int, position: float, max_kept: int) -> tuple[PreparedVideo, np.ndarray]:
        """A prepared segment, one of at most `max_kept`, and its own time at a frame position of the clip."""
        segment = self._video.segments[number]
        if number not in self._kept:
            while len(self._kept) >= max_kept:
                self._kept.popitem(last=False)  # before the next one is loaded, to free its memory
            model = segment.model
            self._kept[number] = model.prepare(self._size), np.asarray(model.frame_times.times())
        self._kept.move_to_end(number)
        prepared, times = self._kept[number]
        return prepared, times_at(times, position - segment.first)


def _check_segments(segments: tuple[Segment, ...]) -> None:
    """Raise unless they cover a clip in their order, at most two at a frame, and are rendered alike."""
    require(segments, "segments", expected="at least one", got="none")
    first_low, first_high, last_stop = 0, 0, 0  # of the next segment
    for number, segment in enumerate(segments):
        name = f"segments[{number}]"
        require(
            isinstance(segment, Segment),
            name,
            expected="a Segment",
            got=short_repr(segment),
            cure="From models: SegmentedVideo.from_models([(first, model), ...]).",
        )
        require(
            is_integer(segment.first, first_low) and segment.first <= first_high and segment.stop > last_stop,
            f"{name}.first",
            expected=f"one that begins at frame {first_low} to {first_high} of the clip and ends after {last_stop}",
            got=f"{short_repr(segment.first)}, and {segment.num_frames} frames",
            cure="Segments begin at frame 0, leave no gap, and at most two share a frame.",
        )
        for prop in ("size", "fps", "compositing", "options"):
            one, two = getattr(segments[0], prop), getattr(segment, prop)
            require(
                one == two,
                f"{name}.{prop}",
                expected=f"{one!r}, as in the first segment",
                got=repr(two),
                cure="They are rendered as one video: fit them alike.",
            )
        first_low, first_high, last_stop = max(segment.first + 1, last_stop), segment.stop, segment.stop


def plan_segments(num_frames: int, cuts: Sequence[int], *, length: int, overlap: int) -> list[tuple[int, int]]:
    """Spans [first, stop) of frames that cover a clip, of about `length` frames each, split at cuts where possible.

    `cuts` are the first frames of shots. A segment ends at the cut nearest to `length` frames from its start, between
    half and one and a half of that, and the next segment starts there without an overlap. Without such a cut it has
    `length` frames, and the next one starts `overlap` frames before its end. No segment of several is shorter than half
    of `length`: the last two are balanced, and cuts that leave less are not used.

    **Example:** `plan_segments(250, [90], length=100, overlap=5)` is `[(0, 90), (90, 190), (185, 250)]`.

    **Raises:** ValueError for no frames, a length below 2, cuts outside the clip, and an overlap outside 1 to half of
    the length.
    """
    require(is_integer(num_frames, 1), "num_frames", expected="a whole number >= 1", got=short_repr(num_frames))
    require(is_integer(length, 2), "length", expected="a whole number of frames >= 2", got=short_repr(length))
    require(
        is_integer(overlap, 1) and 2 * overlap <= length,
        "overlap",
        expected=f"a whole number of frames from 1 to {length // 2}, half of the length",
        got=short_repr(overlap),
    )
    for cut in cuts:
        require(
            is_integer(cut, 1) and cut < num_frames,
            "cuts",
            expected=f"first frames of shots, from 1 to {num_frames - 1}",
            got=short_repr(cut),
            cure="Count from the clip's first frame.",
        )
    num_frames, length, overlap = int(num_frames), int(length), int(overlap)
    ordered, spans, first = sorted(map(int, cuts)), [], 0
    while (left := num_frames - first) > length:
        last_cut = min(first + 3 * length // 2, num_frames - -(-length // 2))
        near = ordered[bisect.bisect_left(ordered, first + -(-length // 2)) : bisect.bisect_right(ordered, last_cut)]
        if near:
            stop = next_first = min(near, key=lambda cut: abs(cut - first - length))
        else:
            shared, stop = overlap, first + length
            if 2 * (num_frames - stop + overlap) < length:  # the last segment would be short
                shared = min(overlap, left - 2 * overlap)  # the last does not reach the one before these two
                stop = first + -(-(left + shared) // 2)
            next_first = stop - shared
        spans.append((first, stop))
        first = next_first
    return [*spans, (first, num_frames)]
