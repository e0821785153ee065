"""Chains of edits of a video in segments: the calls are recorded and replayed on each segment when it is loaded."""

import dataclasses
import functools
import inspect
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from foldgauss._runtime.checks import check_signature
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.editing.arguments import check_select_arguments, missing_attribute
from foldgauss.video.editing.bake import mean_lightness
from foldgauss.video.editing.chain import Edit, edit, start_chain
from foldgauss.video.editing.edited_video import EditedVideo, as_edited
from foldgauss.video.editing.overlays import LUMINANCE_WEIGHTS
from foldgauss.video.editing.timing import TimeMap, When, frame_times_of
from foldgauss.video.models.background import check_color
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.criteria import CriteriaEvaluator
from foldgauss.video.segmented.segmented_video import MAX_PREPARED, Segment, SegmentedVideo
from foldgauss.video.selection.selectors import Mask, Selection, check_mask, list_criteria, select, split_mask

#: The methods that may change the number or the order of the Gaussians, or hide some of them.
_CHANGE_INDICES = ("multiply", "vanish", "opacity", "to_front", "to_back")


@dataclasses.dataclass(frozen=True, eq=False)
class _Call:
    """A recorded call: `act(edit, number)` applies it to the `Edit` of a segment.

    It is skipped for an empty selection, unless `always`. Errors are raised within `context`.
    """

    act: Callable[[Edit, int], Edit]
    context: AbstractContextManager
    always: bool = False


def _record_method(name: str) -> Callable[..., "SegmentedEdit"]:
    """A method of `SegmentedEdit` that records a call of the method of `Edit`."""

    @functools.wraps(getattr(Edit, name))
    def method(self: "SegmentedEdit", *args: Any, **kwargs: Any) -> "SegmentedEdit":
        return self._record(name, args, kwargs)

    return method


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentedEdit:
    """A video in segments being edited as one, with the methods of `Edit`. Each method returns a new chain.

    The calls are recorded and replayed on each segment's model when it is loaded: by `video()`, one after another, and
    whenever the edited video is rendered or saved. Segments that a call does not apply to, such as those outside its
    span, stay the same to the bit.

    - Frames and times, of spans, clocks, cameras and functions, are those of the whole clip; at a seam an eased edit
      has the same progress in both segments.
    - Regions (`mask=`, `box=`, `polygon=`, `click=`) are evaluated on the segments that have the frames named, and
      propagated from segment to segment: where the selection contributes at least half of a pixel of a shared frame,
      that pixel is in the neighbor's mask. There is no propagation across a cut, where no frame is shared, nor with
      `follow=False`. `color=`, `moving=` and times are evaluated on every segment.
    - Clocks (`retime`, `freeze`, `delays=`) work within one segment only: a clock that would show frames of another
      segment raises ValueError.

    **Units:** as `Edit`. **Example:** `edit(video).select(box=(200, 80, 420, 260), frame=120).move((0.1, 0)).video()`

    **Raises:** ValueError as `Edit`; what depends on the models (an edit of a part of what another edit takes as a
    whole, an empty selection) is raised by `video()`.
    """

    _video: SegmentedVideo
    # Of one Gaussian in a clip as long, selected unless the selection is known to be empty: checks arguments.
    _stand_in: Edit = dataclasses.field(repr=False)
    _calls: tuple[_Call, ...] = dataclasses.field(default=(), repr=False)
    _known: tuple[Selection, ...] | None = dataclasses.field(default=None, repr=False)  # by segment, where it is known
    _same_indices: bool = dataclasses.field(default=True, repr=False)  # as at the start of the chain
    _context: AbstractContextManager = dataclasses.field(default_factory=nullcontext, repr=False)

    def video(self) -> SegmentedVideo:
        """The edited video; its segments are edited again whenever they are loaded, so none is kept in memory."""
        load = functools.lru_cache(maxsize=MAX_PREPARED)(lambda number: self._replay(number).video())
        acted: set[int] = set()
        segments = [self._edit_segment(k, functools.partial(load, k), acted) for k in self._numbers]
        for number, call in enumerate(self._calls):
            if number not in acted:
                with call.context:
                    _deselect_all(self._stand_in)._check_selected()
        return SegmentedVideo(segments)

    def _edit_segment(self, number: int, load: Callable[[], VideoModel | EditedVideo], acted: set[int]) -> Segment:
        segment = self._video.segments[number]
        before = self._start(number)
        after = self._replay_calls(before, number, acted)
        pairs = zip(after._video.layers, before._video.layers, strict=True)  # what is edited is another object
        same = after._video.camera is before._video.camera and all(layer is old for layer, old in pairs)
        return segment if same else segment.with_model(after.video(), load)

    def __getattr__(self, name: str) -> object:
        """Raise AttributeError, with a hint for attributes of the video."""
        raise missing_attribute(self, name, SegmentedVideo)

    def with_error_context(self, context: AbstractContextManager) -> "SegmentedEdit":
        """Raise the errors of the following calls within a context, also those that `video()` raises later.

        The context is entered many times.
        """
        return dataclasses.replace(self, _context=context)

    # ------------------------------------------------------------------------------------------- selection

    @property
    def selection(self) -> Selection:
        """The current selection, of one segment after another; the models are loaded if it is not known."""
        known = (self._replay(number).selection for number in self._numbers) if self._known is None else self._known
        return Selection(np.concatenate([part.mask for part in known]))

    def select(
        self,
        selection: Selection | Mask | Callable[[SegmentedVideo], Selection] | None = None,
        *,
        layer: int | str | None = None,
        **criteria: Any,
    ) -> "SegmentedEdit":
        """Choose the Gaussians that the next edits apply to, from all Gaussians; without arguments, all of them.

        As `Edit.select`, but segments may lack the `layer` with a name; a mask is over the Gaussians of one segment
        after another. Criteria are evaluated at once, on one model after another.
        """
        check_select_arguments(selection, criteria)
        if criteria:
            inspect.signature(select).bind(None, **criteria)
            segments, stand_in = self._video.segments, self._stand_in._video.layers[0].model
            evaluator = CriteriaEvaluator(segments, stand_in, self._replay, self._select_none, layer)
            return self._select_current(evaluator.evaluate(list_criteria(**criteria)))
        if selection is None:
            return self._record_selection(lambda one, number: _select_layer(one, layer), None)
        if callable(selection):
            check_signature("selection", selection, "video")
            video = self.video()
            return self._select_current(_split_selection(selection(video), _segment_sizes(video)))
        if layer is None:
            counts = _segment_sizes(self._video)
        else:
            starts = [self._start(number) for number in self._numbers]
            counts = [sum(one._counts[k] for k in one._layer_numbers(layer)) for one in starts]
        parts = _split_selection(selection, counts)
        known = parts if self._same_indices and layer is None else None
        return self._record_selection(lambda one, number: one.select(parts[number], layer=layer), known)

    def _select_current(self, parts: Sequence[Selection]) -> "SegmentedEdit":
        """Select from the current Gaussians."""
        return self._record_selection(lambda one, number: dataclasses.replace(one, selection=parts[number]), parts)

    def _record_selection(self, act: Callable[[Edit, int], Edit], known: Sequence[Selection] | None) -> "SegmentedEdit":
        call, is_empty = _Call(act, self._context, always=True), known is not None and not any(map(len, known))
        stand_in = _deselect_all(self._stand_in) if is_empty else self._stand_in.select()
        return dataclasses.replace(self, _stand_in=stand_in, _calls=(*self._calls, call), _known=known)

    def _select_none(self, number: int) -> Selection:
        """The empty selection of a segment; its model is loaded only if the number of Gaussians may have changed."""
        if self._same_indices:
            return Selection(np.zeros(self._video.segments[number].num_gaussians, bool))
        return _deselect_all(self._replay(number)).selection

    @property
    def _numbers(self) -> range:
        return range(len(self._video.segments))

    # ----------------------------------------------------------------------------------------------- edits

    move, scale, rotate, transform = map(_record_method, ("move", "scale", "rotate", "transform"))
    multiply, vanish, opacity = map(_record_method, ("multiply", "vanish", "opacity"))
    to_front, to_back, place = map(_record_method, ("to_front", "to_back", "place"))
    retime, freeze = map(_record_method, ("retime", "freeze"))
    apply, seen_from = map(_record_method, ("apply", "seen_from"))

    @functools.wraps(Edit.recolor)
    def recolor(self, color: ArrayLike | None = None, **kwargs: Any) -> "SegmentedEdit":
        """As `Edit.recolor`; the mean lightness is that of the selection in all segments."""
        if color is None:
            return self._record("recolor", (), kwargs)
        self._try("recolor", (color,), kwargs)
        sums = [one._sum_lightness() for one in map(self._replay, self._numbers) if len(one.selection)]
        if not sums:
            _deselect_all(self._stand_in)._check_selected()
        when = {name: value for name, value in kwargs.items() if name in When.__annotations__}
        matrix = np.outer(check_color("color", color), LUMINANCE_WEIGHTS)
        return self._record("recolor", (), {"gain": 1 / mean_lightness(sums), "matrix": matrix, **when})

    def _record(self, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> "SegmentedEdit":
        """Check a call of a method of `Edit`, and add it to the chain."""
        after = self._try(name, args, kwargs)
        call = _Call(lambda one, number: getattr(one, name)(*args, **kwargs), self._context, name == "seen_from")
        keeps_indices = name not in _CHANGE_INDICES
        return dataclasses.replace(
            self,
            _calls=(*self._calls, call),
            _known=self._known if keeps_indices else None,
            _stand_in=self._stand_in if len(after.selection) else _deselect_all(self._stand_in),
            _same_indices=self._same_indices and keeps_indices,
        )

    def _try(self, name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> Edit:
        """Make a call on the stand-in, to check its arguments; its warnings are raised for the user's line."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            after = getattr(self._stand_in, name)(*args, **kwargs)
        for warning in caught:
            warnings.warn(warning.message, stacklevel=4)
        return after

    def _replay(self, number: int) -> Edit:
        """Load a segment and replay all calls on it."""
        return self._replay_calls(self._start(number), number, set())

    def _start(self, number: int) -> Edit:
        segment = self._video.segments[number]
        video, clip_times = as_edited(segment.model), self._video.frame_times.times()
        time_map = TimeMap(frame_times_of(video), clip_times[segment.first : segment.stop])
        if len(clip_times) == segment.num_frames and time_map.is_identity:
            return start_chain(video)
        return start_chain(video, clip_times, time_map)

    def _replay_calls(self, one: Edit, number: int, acted: set[int]) -> Edit:
        """The chain of a segment after all calls; the numbers of the calls that were not skipped go to `acted`."""
        for count, call in enumerate(self._calls):
            if not (call.always or len(one.selection)):
                continue
            with call.context, warnings.catch_warnings():
                warnings.simplefilter("ignore")  # they were raised when the call was recorded
                one = call.act(one, number)
            acted.add(count)
        return one


def _segment_sizes(video: SegmentedVideo) -> list[int]:
    return [segment.num_gaussians for segment in video.segments]


def _split_selection(selection: object, counts: list[int]) -> list[Selection]:
    """By segment, from a selection in all."""
    return list(map(Selection, split_mask(check_mask(selection, sum(counts)), counts)))


def _select_layer(one: Edit, layer: int | str | None) -> Edit:
    """A layer of a segment; nothing where an object is not in it."""
    lacks = isinstance(layer, str) and layer not in (own.name for own in one._video.layers)
    return _deselect_all(one) if lacks else one.select(layer=layer)


def _deselect_all(one: Edit) -> Edit:
    return dataclasses.replace(one, selection=one.selection - one.selection)


@edit.register
def _(video: SegmentedVideo) -> SegmentedEdit:
    """Start with a stand-in of one gray Gaussian that is always alive."""
    shapes = {
        "loc": (1, 2),
        "log_scale": (1, 2),
        "angle_logit": (1,),
        "time_loc_logit": (1,),
        "log_time_scale": (1,),
        "coefficients": (1, 0, 2),
        "opacity_logit": (1,),
        "color_dc": (1, 3),
    }
    leaves = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    splats = FoldedSplats(**leaves, envelope=TimeLikelihood(2.0))
    times = FrameTimes.uniform(video.num_frames)
    model = VideoModel(splats, times, video.size, video.fps, video.options, video.compositing)
    return SegmentedEdit(video, edit(model))
