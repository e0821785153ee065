"""Edits of a clip in segments: one chain, whose calls each segment's model goes through when it is loaded."""

import dataclasses
import functools
import inspect
import operator
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Bool, Float32

from foldgauss._runtime.checks import check_signature, invalid, is_integer, short_repr
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.editing.chain import Edit, When, check_color, edit, mean_lightness, start_chain
from foldgauss.video.editing.clip_window import ClipWindow
from foldgauss.video.editing.edited_video import EditedVideo, as_edited
from foldgauss.video.editing.overlays import LUMINANCE_WEIGHTS
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import MAX_PREPARED, Segment, SegmentedVideo
from foldgauss.video.selection.contributions import Contributions, render_matte
from foldgauss.video.selection.regions import region_from_box, region_from_mask, region_from_polygon, resolve_frames
from foldgauss.video.selection.selectors import (
    THRESHOLD,
    Selection,
    by_box,
    by_click,
    by_color,
    by_mask,
    by_polygon,
    by_time,
    list_criteria,
    select,
)

#: A pixel of a shared frame shows the object where this share of its light is the object's.
_SHOWN = 0.5

_Mask = Bool[np.ndarray, " num_gaussians"]
_Picture = Bool[np.ndarray, "height width"]


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentedSelection:
    """Sets of Gaussians of a `SegmentedVideo`, one for each segment, with the operations of sets that `Selection` has.

    Made by `edit(video).select(...).selection`.

    **Example:** `edit(video).select(ball - shadow).vanish()`.

    **Raises:** ValueError for what is no selection, and for sets of videos with other segments.
    """

    parts: tuple[Selection, ...]

    def __post_init__(self) -> None:
        parts = tuple(self.parts)
        wrong = next((part for part in parts if not isinstance(part, Selection)), None)
        if not parts or wrong is not None:
            raise invalid("parts", expected="a Selection for each segment", got=short_repr(wrong) if parts else "none")
        object.__setattr__(self, "parts", parts)

    @property
    def num_gaussians(self) -> int:
        """Gaussians of all segments, selected or not."""
        return sum(part.num_gaussians for part in self.parts)

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def __or__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._with(other, operator.or_)

    def __and__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._with(other, operator.and_)

    def __sub__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._with(other, operator.sub)

    def __xor__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._with(other, operator.xor)

    def __invert__(self) -> "SegmentedSelection":
        return SegmentedSelection(tuple(~part for part in self.parts))

    def __eq__(self, other: object) -> bool:
        return self.parts == other.parts if isinstance(other, SegmentedSelection) else NotImplemented

    def __repr__(self) -> str:
        return f"SegmentedSelection({len(self):,} of {self.num_gaussians:,} in {len(self.parts)} segments)"

    def _with(self, other: "SegmentedSelection", combine: Callable[[Selection, Selection], Selection]):
        if not isinstance(other, SegmentedSelection):
            raise TypeError(f"expected a SegmentedSelection, got {type(other).__name__}.")
        if len(other.parts) != len(self.parts):
            expected, got = f"a selection in {len(self.parts)} segments", f"one in {len(other.parts)}"
            raise invalid("selection", expected=expected, got=got, cure="Is it another video's?")
        return SegmentedSelection(tuple(map(combine, self.parts, other.parts)))


@dataclasses.dataclass(frozen=True, eq=False)
class _Call:
    """A call of the chain: `act` takes a segment's `Edit` and the segment's number.

    Where nothing is selected it is left out, unless it is `for_all`. `place`: what its errors are told within.
    """

    act: Callable[[Edit, int], Edit]
    place: AbstractContextManager
    for_all: bool = False


def _record_method(name: str) -> Callable[..., "SegmentedEdit"]:
    """A method of `Edit` as one of the chain for all segments."""

    @functools.wraps(getattr(Edit, name))
    def recorded(self: "SegmentedEdit", *args: Any, **named: Any) -> "SegmentedEdit":
        return self._then(name, args, named)

    return recorded


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentedEdit:
    """A video in segments being edited as one, with the methods of `Edit`. Each method gives a new one.

    The calls are kept, and each segment's model goes through them when it is loaded: `video()` loads them one after
    another, and so does what `video()` gives whenever it is drawn or saved. What a call leaves alone, such as segments
    outside its span, keeps its bits.

    - Frames and times, of spans, clocks, cameras and functions, are those of the whole clip; an edit eased over a seam
      is as far along in both segments.
    - What is selected by place (`mask=`, `box=`, `polygon=`, `click=`) is asked of the segments that hold the frames
      named, and carried on from segment to segment: what it shows on the shared frames, at least half of a pixel's
      light, is the neighbour's mask for these frames. Across a cut, where no frame is shared, nothing is carried, nor
      with `follow=False`. `color=` and times are asked of every segment.
    - Objects go by clocks (`retime`, `freeze`, `delays=`) within a segment only: one that had to be shown as another
      segment has it is refused.

    **Units:** as `Edit`. **Example:** `edit(video).select(box=(200, 80, 420, 260), frame=120).move((0.1, 0)).video()`

    **Raises:** ValueError as `Edit`; what only the models tell (a part of what another edit takes as a whole, nobody
    left to edit) by `video()`.
    """

    _video: SegmentedVideo
    _stand_in: Edit = dataclasses.field(repr=False)  # one Gaussian in a clip as long: what is given is checked on it
    _steps: tuple[_Call, ...] = dataclasses.field(default=(), repr=False)
    _known: SegmentedSelection | None = dataclasses.field(default=None, repr=False)  # the selection, where it is known
    _gone: bool = dataclasses.field(default=False, repr=False)  # whether nothing can be selected
    _as_begun: bool = dataclasses.field(default=True, repr=False)  # whether all have the numbers that they began with
    _place: AbstractContextManager = dataclasses.field(default_factory=nullcontext, repr=False)

    def video(self) -> SegmentedVideo:
        """What has been made: each segment is edited again when it is loaded, so none is held in memory."""
        load = functools.lru_cache(maxsize=MAX_PREPARED)(lambda number: self._replayed(number).video())
        acted: set[int] = set()
        made = [
            self._segment(number, functools.partial(load, number), acted) for number in range(len(self._video.segments))
        ]
        for number, step in enumerate(self._steps):
            if number not in acted:
                with step.place:
                    _deselect_all(self._stand_in)._check_selected()
        return SegmentedVideo(made)

    def _segment(self, number: int, load: Callable[[], VideoModel | EditedVideo], acted: set[int]) -> Segment:
        segment = self._video.segments[number]
        before = self._begun(number)
        edited = self._through(before, number, acted)
        if _same(edited._video, before._video):
            return segment
        made = edited.video()
        facts = {name: getattr(made, name) for name in ("num_gaussians", "degree", "num_parameters")}
        return dataclasses.replace(segment, **facts, load=load)

    def __getattr__(self, name: str) -> object:
        """There is none; most likely `video()` was forgotten."""
        cure = " End the chain with .video()." if name in dir(SegmentedVideo) else ""
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}.{cure}", name=name, obj=self)

    def within(self, place: AbstractContextManager) -> "SegmentedEdit":
        """The same; what the calls from now on raise, also later by `video()`, is raised within a context.

        It is entered many times.
        """
        return dataclasses.replace(self, _place=place)

    # ------------------------------------------------------------------------------------------------- who

    @property
    def selection(self) -> SegmentedSelection:
        """Who is selected now; the models are loaded for it where it is not known."""
        if self._known is not None:
            return self._known
        return SegmentedSelection(tuple(self._replayed(number).selection for number in self._numbers))

    def select(
        self,
        selection: SegmentedSelection | Callable[[SegmentedVideo], SegmentedSelection] | None = None,
        *,
        layer: int | None = None,
        **criteria: Any,
    ) -> "SegmentedEdit":
        """Act on these Gaussians from now on, whatever was selected before; on all without arguments.

        As `Edit.select`; a selection is a `SegmentedSelection`, or a function of `video()` that gives one. Criteria are
        asked at once, of the models one after another.
        """
        if selection is not None and criteria:
            got = f"{type(selection).__name__} and {', '.join(criteria)}"
            raise invalid("selection", expected="a selection or criteria for one", got=got)
        if layer is not None and not is_integer(layer, 0):
            raise invalid("layer", expected="a whole number >= 0", got=layer)
        if criteria:
            inspect.signature(select).bind(None, **criteria)
            return self._chosen(self._answer(list_criteria(**criteria), layer))
        if selection is None:
            return self._selecting(lambda one, number: one.select(layer=layer), None)
        if callable(selection):
            check_signature("selection", selection, "video")
            return self._chosen(self._checked(selection(self.video())))
        self._checked(selection)
        known = selection if self._as_begun and layer is None else None
        return self._selecting(lambda one, number: one.select(selection.parts[number], layer=layer), known)

    def select_begun(self, selection: SegmentedSelection) -> "SegmentedEdit":
        """Act on these of the Gaussians that the chain was begun with, and on their copies: see `Edit.select_begun`."""
        self._checked(selection)
        known = selection if self._as_begun else None
        return self._selecting(lambda one, number: one.select_begun(selection.parts[number]), known)

    def _chosen(self, selection: SegmentedSelection) -> "SegmentedEdit":
        """With these of the Gaussians of now."""
        return self._selecting(
            lambda one, number: dataclasses.replace(one, selection=selection.parts[number]), selection
        )

    def _selecting(self, act: Callable[[Edit, int], Edit], known: SegmentedSelection | None) -> "SegmentedEdit":
        step = _Call(act, self._place, for_all=True)
        return dataclasses.replace(self, _steps=(*self._steps, step), _known=known, _gone=False)

    def _checked(self, selection: object) -> SegmentedSelection:
        if not isinstance(selection, SegmentedSelection):
            cure = "edit(video).select(...).selection is one."
            raise invalid("selection", expected="a SegmentedSelection", got=type(selection).__name__, cure=cure)
        if len(selection.parts) != len(self._video.segments):
            expected, got = f"one in {len(self._video.segments)} segments", f"one in {len(selection.parts)}"
            raise invalid("selection", expected=expected, got=got, cure="Is it another video's?")
        return selection

    @property
    def _numbers(self) -> range:
        return range(len(self._video.segments))

    # ------------------------------------------------------------------------------------------------ what

    move, scale, rotate, transform = map(_record_method, ("move", "scale", "rotate", "transform"))
    multiply, vanish, opacity = map(_record_method, ("multiply", "vanish", "opacity"))
    to_front, to_back, place = map(_record_method, ("to_front", "to_back", "place"))
    retime, freeze = map(_record_method, ("retime", "freeze"))
    apply, apply_triangles, seen_from = map(_record_method, ("apply", "apply_triangles", "seen_from"))

    @functools.wraps(Edit.recolor)
    def recolor(self, color: ArrayLike | None = None, **given: Any) -> "SegmentedEdit":
        """As `Edit.recolor`: by the mean lightness of the selection in all segments."""
        if color is None:
            return self._then("recolor", (), given)
        self._try("recolor", (color,), given)
        light = [one._light() for one in map(self._replayed, self._numbers) if len(one.selection)]
        if not light:
            _deselect_all(self._stand_in)._check_selected()
        when = {name: value for name, value in given.items() if name in When.__annotations__}
        matrix = np.outer(check_color(color), LUMINANCE_WEIGHTS)
        return self._then("recolor", (), {"gain": 1 / mean_lightness(light), "matrix": matrix, **when})

    def _then(self, name: str, args: Sequence[Any], named: dict[str, Any]) -> "SegmentedEdit":
        """With one more call of a method of `Edit`."""
        after = self._try(name, args, named)
        step = _Call(lambda one, number: getattr(one, name)(*args, **named), self._place, for_all=name == "seen_from")
        keeps = name not in ("multiply", "vanish", "opacity", "to_front", "to_back")
        return dataclasses.replace(
            self,
            _steps=(*self._steps, step),
            _known=self._known if keeps else None,
            _gone=self._gone or not len(after.selection),
            _as_begun=self._as_begun and keeps,
        )

    def _try(self, name: str, args: Sequence[Any], named: dict[str, Any]) -> Edit:
        """What is given, checked; warnings are told as if of the caller's caller."""
        nobody = self._gone or (self._known is not None and not len(self._known))
        trial = _deselect_all(self._stand_in) if nobody else self._stand_in
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            after = getattr(trial, name)(*args, **named)
        for warning in told:
            warnings.warn(warning.message, stacklevel=4)
        return dataclasses.replace(after, selection=after.selection - after.selection) if nobody else after

    def _replayed(self, number: int) -> Edit:
        """A segment, loaded, after all calls."""
        return self._through(self._begun(number), number, set())

    def _begun(self, number: int) -> Edit:
        segment = self._video.segments[number]
        model = segment.model
        times = np.asarray(model.frame_times.times(), np.float64)
        return start_chain(as_edited(model), ClipWindow(times, segment.first, self._video.num_frames))

    def _through(self, one: Edit, number: int, acted: set[int]) -> Edit:
        """After all calls; the numbers of those that had something to act on go to `acted`."""
        for count, step in enumerate(self._steps):
            if not (step.for_all or len(one.selection)):
                continue
            with step.place, warnings.catch_warnings():
                warnings.simplefilter("ignore")  # they were told when it was called
                one = step.act(one, number)
            acted.add(count)
        return one

    # ---------------------------------------------------------------------------------- what criteria find

    def _answer(
        self, asked: list[tuple[Callable[..., Selection], dict[str, Any]]], layer: int | None
    ) -> SegmentedSelection:
        """The answers to all criteria, intersected: those by place first, so that the others need ask fewer models."""
        found: SegmentedSelection | None = None
        for function, named in sorted(asked, key=lambda question: question[0] in (by_color, by_time)):
            if function in (by_color, by_time):
                answer = self._by_themselves(function, named, layer, found)
            else:
                answer = _RegionQuery(self, function, named, layer).selection()
            found = answer if found is None else found & answer
        return found

    def _by_themselves(
        self, function: Callable[..., Selection], named: dict[str, Any], layer: int | None, among: Any
    ) -> SegmentedSelection:
        """Asked of each segment alone: by colour, or by time."""
        spans = None if function is by_color else self._positions(**named)
        parts = []
        for number, segment in enumerate(self._video.segments):
            if among is not None and not len(among.parts[number]):
                parts.append(among.parts[number])
            elif spans is not None and not _reaches(spans, segment):
                parts.append(self._nothing(number))
            else:
                one = self._replayed(number)
                own = named if spans is None else _own_times(spans, segment, one._window, named)
                parts.append(_evaluate_by_layer(one, layer, lambda model, _, own=own: function(model, **own)))
        return SegmentedSelection(tuple(parts))

    def _nothing(self, number: int) -> Selection:
        """Of a segment; its model is loaded only where it must be to know how many Gaussians there are now."""
        if self._as_begun:
            return Selection(np.zeros(self._video.segments[number].num_gaussians, bool))
        return _empty_selection(self._replayed(number))

    def _positions(self, times: Any = None, frame: Any = None, frames: Any = None, alive: bool = False) -> Any:
        """First and last frame position, of times, or the range of frames."""
        if times is None:
            return resolve_frames(_model(self._stand_in), frame, frames)
        pair = np.asarray(times)
        if pair.shape != (2,) or pair.dtype.kind not in "fiu" or not 0 <= pair[0] <= pair[1] <= 1:
            raise invalid("times", expected="(start, stop) with 0 <= start <= stop <= 1", got=times)
        return tuple(float(t) * (self._video.num_frames - 1) for t in pair)


def _reaches(spans: Any, segment: Segment) -> bool:
    """Whether a range of frames, or first and last position, has something of a segment."""
    first, last = (spans.start, spans.stop - 1) if isinstance(spans, range) else spans
    return first <= segment.stop - 1 and segment.first <= last


def _own_times(spans: Any, segment: Segment, part: ClipWindow, named: dict[str, Any]) -> dict[str, Any]:
    """What `by_time` is asked of a segment that is reached."""
    if isinstance(spans, range):
        first, stop = max(spans.start, segment.first), min(spans.stop, segment.stop)
        return {"frames": (first - segment.first, stop - segment.first), "alive": named["alive"]}
    if part.is_whole:
        return named
    ends = np.clip(spans, part.first, part.last) - part.first
    times = np.interp(ends, np.arange(len(part.times)), part.times)
    return {"times": tuple(np.clip(times, 0.0, 1.0).tolist()), "alive": named["alive"]}


class _RegionQuery:
    """The answer to a question that names frames: asked where these are, carried over shared frames elsewhere."""

    def __init__(
        self, edits: SegmentedEdit, function: Callable[..., Selection], named: dict[str, Any], layer: int | None
    ):
        self._edits, self._function, self._named, self._layer = edits, function, named, layer
        self._segments = edits._video.segments
        stand_in = _model(edits._stand_in)
        where = {"frame": named["frame"], "frames": named.get("frames")}
        if function is by_click:
            self._frames = tuple(resolve_frames(stand_in, **where))
        else:
            regions = {
                by_mask: (region_from_mask, "mask"),
                by_box: (region_from_box, "box"),
                by_polygon: (region_from_polygon, "polygon"),
            }
            make, name = regions[function]
            self._region = make(stand_in, named[name], **where)
            self._frames = self._region.frames
        #: By segment and layer: what the neighbours show of it, by frames of the clip.
        self._shown: dict[int, list[dict[int, _Picture]]] = {}

    def selection(self) -> SegmentedSelection:
        """In all segments: those next to the asked ones first, so that each hears of all that know more."""
        asked = [number for number in self._edits._numbers if self._held(number)]
        waiting, found = deque(asked), {}
        reached = set(asked)
        while waiting:
            number = waiting.popleft()
            one = self._edits._replayed(number)
            found[number] = self._asked(one, number) if number in asked else self._from_neighbours(one, number)
            for other in self._next_to(number):
                if other in found or other in asked or not self._named.get("follow", True):
                    continue
                if len(found[number]) or number in asked:  # that it is not there is known there, too
                    self._show(one, found[number], number, other)
                if len(found[number]) and other not in reached:
                    reached.add(other)
                    waiting.append(other)
        parts = (found[k] if k in found else self._edits._nothing(k) for k in self._edits._numbers)
        return SegmentedSelection(tuple(parts))

    def _held(self, number: int) -> list[int]:
        """Which of the frames named a segment has."""
        segment = self._segments[number]
        return [k for k in self._frames if segment.first <= k < segment.stop]

    def _next_to(self, number: int) -> Iterable[int]:
        return (other for other in (number - 1, number + 1) if 0 <= other < len(self._segments))

    def _asked(self, one: Edit, number: int) -> Selection:
        first, held = self._segments[number].first, self._held(number)
        own = {name: value for name, value in self._named.items() if name not in ("frame", "frames")}
        if self._function is by_click:
            own["frame"] = held[0] - first
        elif self._function is by_mask:
            own["mask"] = {k - first: _share(self._region.at(k)) for k in held}
            if not any(mask.any() for mask in own["mask"].values()):
                return _empty_selection(one)
        else:
            own["frames"] = (held[0] - first, held[-1] + 1 - first)
        return _evaluate_by_layer(one, self._layer, lambda model, _: self._function(model, **own))

    def _show(self, one: Edit, found: Selection, number: int, other: int) -> None:
        """What is found in a segment, as masks of the frames that it shares with a neighbour."""
        here, there = self._segments[number], self._segments[other]
        layers, masks = one._video.layers, dataclasses.replace(one, selection=found)._parts()
        by_layer = self._shown.setdefault(other, [{} for _ in layers])
        for layer, mask, pictures in zip(layers, masks, by_layer, strict=False):
            lit = Contributions(layer.model) if mask.any() else None
            for k in range(max(here.first, there.first), min(here.stop, there.stop)):
                if lit is None:
                    pictures[k] = np.zeros(layer.model.size, bool)
                else:
                    pictures[k] = render_matte(lit, mask, float(one._window.times[k - here.first])) >= _SHOWN

    def _from_neighbours(self, one: Edit, number: int) -> Selection:
        first, shown = self._segments[number].first, self._shown[number]
        num_layers = len(one._video.layers)
        if len(shown) != num_layers:
            expected = f"{len(shown)} layers, as its neighbour has"
            raise invalid(f"segments[{number}]", expected=expected, got=num_layers)
        threshold = self._named.get("threshold", THRESHOLD)

        def ask(model: VideoModel, layer: int) -> Selection:
            masks = {k - first: picture for k, picture in shown[layer].items()}
            if not any(mask.any() for mask in masks.values()):
                return Selection.none(model)
            return by_mask(model, masks, threshold=threshold)

        return _evaluate_by_layer(one, self._layer, ask)


def _share(mask: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """Without what resizing leaves beyond [0, 1]."""
    return np.clip(mask, 0.0, 1.0)


def _evaluate_by_layer(one: Edit, layer: int | None, function: Callable[[VideoModel, int], Selection]) -> Selection:
    """What each layer's model answers, or layer number `layer` alone."""
    numbers = one._layer_numbers(layer)
    masks = [
        function(own.model, number).mask if number in numbers else np.zeros(own.num_gaussians, bool)
        for number, own in enumerate(one._video.layers)
    ]
    return Selection(np.concatenate(masks))


def _model(one: Edit) -> VideoModel:
    """Of the only layer."""
    return one._video.layers[0].model


def _same(one: EditedVideo, other: EditedVideo) -> bool:
    """Whether nothing was edited: what is, is another object."""
    pairs = zip(one.layers, other.layers, strict=True)
    return one.camera is other.camera and all(own is before for own, before in pairs)


def _empty_selection(one: Edit) -> Selection:
    return one.selection - one.selection


def _deselect_all(one: Edit) -> Edit:
    return dataclasses.replace(one, selection=_empty_selection(one))


@edit.register
def _(video: SegmentedVideo) -> SegmentedEdit:
    """One Gaussian, there throughout, of a grey that can be recoloured, stands in for all."""
    leaves = {
        "loc": (1, 2),
        "log_scale": (1, 2),
        "angle_logit": (1,),
        "time_loc_logit": (1,),
        "log_time_scale": (1,),
        "coefficients": (1, 0, 2),
        "opacity_logit": (1,),
        "color_dc": (1, 3),
    }
    splats = FoldedSplats(
        **{name: np.zeros(shape, np.float32) for name, shape in leaves.items()}, envelope=TimeLikelihood(2.0)
    )
    times = FrameTimes.uniform(video.num_frames)
    model = VideoModel(splats, times, video.size, video.fps, video.options, video.compositing)
    part = ClipWindow(np.arange(video.num_frames) / max(video.num_frames - 1, 1), 0, video.num_frames)
    return SegmentedEdit(video, start_chain(as_edited(model), part))
