"""Edits, chained: who, then what, then the video. `edit(model).select(mask=...).move((0.1, 0.0)).video()`."""

import dataclasses
import difflib
import functools
import os
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypedDict, Unpack

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from foldgauss._runtime.checks import check_signature, invalid, is_integer, is_within, short_repr, warn_if_degrees
from foldgauss.render import Camera
from foldgauss.video.editing.bake import (
    apply_affine,
    apply_recolor,
    apply_retiming,
    gather_splats,
    opacities_and_colors,
    scale_opacity,
)
from foldgauss.video.editing.clip_window import ClipWindow
from foldgauss.video.editing.clock import NEVER, Clock, Span, check_number, check_numbers, make_span
from foldgauss.video.editing.edited_video import EditedVideo, Layer, as_edited
from foldgauss.video.editing.overlays import (
    IDENTITY,
    LUMINANCE_WEIGHTS,
    MIN_LIGHTNESS,
    AbstractOverlay,
    Affine,
    GaussianFunction,
    Opacity,
    Place,
    Recolor,
    Retiming,
    SelectedGaussians,
    TriangleFunction,
)
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.selection.selectors import Selection, select

Mask = Bool[np.ndarray, "num"]
Bake = Callable[[FoldedSplats, Mask], FoldedSplats | None]

#: A place or a shift this many frames away is one in pixels, most likely.
FAR = 10.0


class When(TypedDict, total=False):
    """When an edit acts, as `make_span` takes it: over one frame, frames or times, eased in and out; else always."""

    frame: int
    frames: tuple[int | None, int | None]
    times: tuple[float, float]
    ease: float | tuple[float, float]
    curve: str


@functools.singledispatch
def edit(model: VideoModel | EditedVideo) -> "Edit":
    """The start of a chain of edits, everything selected. Raises ValueError for what is no video.

    Example: `edit(model).select(ball).move((0.1, 0)).video()`; the methods are those of `Edit`. Of a `SegmentedVideo`
    it is a `SegmentedEdit`, which has the same.
    """
    return start_chain(as_edited(model))


def start_chain(video: EditedVideo, part: ClipWindow | None = None) -> "Edit":
    """As `edit`; of a `part` of a longer clip, whose frames and times all edits are then given in."""
    counts = tuple(layer.num_gaussians for layer in video.layers)
    return Edit(video, Selection(np.ones(sum(counts), bool)), counts, tuple(map(np.arange, counts)), part)


@dataclasses.dataclass(frozen=True, eq=False)
class Edit:
    """A video being edited, and the selection that the next edit acts on. Each method gives a new one.

    Edits act in the order in which they are called, each on what the ones before have made. Those that a folded model
    holds exactly over all time are **baked** into its leaves: shifts; affine maps about a fixed point; opacities that
    stay below 1; colours; deletion and copies; retiming whose own times stay within (0, 1). All others stay
    **overlays**, applied to the conditioned Gaussians of each time: all edits over a span, those about the selection's
    own centre, clocks, functions, depth. `video()` is a plain `VideoModel` where all could be baked. What an edit
    leaves alone keeps its bits, and an edit that changes nothing (a factor 1, an angle 0) is none.

    Every edit takes `frame=`, `frames=` or `times=`, `ease=` and `curve=`, as in `make_span`; without, it acts always.
    Frame numbers are those of `video().frame_times`. Spans are of the video's time, whatever clocks its objects have.

    **Units:** model space: the frame's centre is the origin, x right, y down, the frame's longer side 1; [0, 1] is the
    clip's time; angles in radians, clockwise as one sees it.

    **Example:** `edit(model).select(mask=mask, frame=0).multiply([(0.2, 0), (0.4, 0)]).scale(0.8).video()`

    **Source:** VeGaS, "modification of videos"; eq:cond_dens for what can be baked. **Raises:** ValueError from every
    method for numbers that make no sense, and for an edit of nothing. Numbers that seem to be of other units, degrees,
    pixels or frames, are warned of.
    """

    _video: EditedVideo
    selection: Selection
    # By layer: how many Gaussians the chain was begun with, and which of those each one is now, or is a copy of.
    _begun_with: tuple[int, ...] = dataclasses.field(repr=False)
    _sources: tuple[Int[np.ndarray, " num"], ...] = dataclasses.field(repr=False)
    _window: ClipWindow | None = dataclasses.field(default=None, repr=False)

    def video(self) -> VideoModel | EditedVideo:
        """What has been made: a folded model if all edits could be baked, else an edited video."""
        video = self._video
        plain = len(video.layers) == 1 and video.camera is None
        layer = video.layers[0]
        return layer.model if plain and not layer.overlays and not layer.clocks else video

    def __getattr__(self, name: str) -> object:
        """There is none; most likely `video()` was forgotten."""
        cure = " End the chain with .video()." if name in dir(EditedVideo) else ""
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}.{cure}", name=name, obj=self)

    # ------------------------------------------------------------------------------------------------- who

    def select(
        self,
        selection: "Selection | Mask | Callable[[VideoModel | EditedVideo], Selection] | None" = None,
        *,
        layer: int | None = None,
        **criteria: object,
    ) -> "Edit":
        """Act on these Gaussians from now on, whatever was selected before; on all without arguments.

        `selection`: a `Selection`, a mask bool (num_gaussians,) or a function of `video()` that gives one of the two.
        Else `criteria` as `foldgauss.video.select` takes them (`mask=`, `box=`, `color=`, ...), asked of each
        layer's model, or of layer number `layer` alone, as it is without overlays: edits that could be baked are seen,
        others not. Masks count the Gaussians of all layers, front layer first, or of `layer`: those that the chain was
        begun with, whose copies then go along; or, where there are more or fewer, those that there are now. A mask that
        could be either is refused: see `select_begun`.
        """
        if selection is not None and criteria:
            got = f"{type(selection).__name__} and {', '.join(criteria)}"
            raise invalid("selection", expected="a selection or criteria for one", got=got)
        layers, numbers = self._video.layers, self._layer_numbers(layer)
        if criteria:
            chosen = [select(layers[k].model, **criteria).mask for k in numbers]
        else:
            chosen = self._given(selection, numbers)
        masks = [np.zeros(one.num_gaussians, bool) for one in layers]
        for k, mask in zip(numbers, chosen, strict=True):
            masks[k] = mask
        return dataclasses.replace(self, selection=Selection(np.concatenate(masks)))

    def _layer_numbers(self, layer: int | None) -> Sequence[int]:
        """Of one layer, or of all."""
        num = len(self._video.layers)
        if layer is not None and not (is_integer(layer, 0) and layer < num):
            raise invalid("layer", expected=f"a whole number in [0, {num - 1}]", got=layer)
        return range(num) if layer is None else [layer]

    def select_begun(self, selection: "Selection | Mask") -> "Edit":
        """Act on these of the Gaussians that the chain was begun with, wherever they are now, and on their copies.

        As `select`, and never in doubt: there a mask is refused where as many Gaussians were copied as deleted, or
        their order was changed. Raises ValueError for a mask of another number.
        """
        mask = np.asarray(selection.mask if isinstance(selection, Selection) else selection)
        if mask.dtype != bool or mask.shape != (sum(self._begun_with),):
            expected = f"a Selection or mask of {sum(self._begun_with):,} Gaussians"
            raise invalid("selection", expected=expected, got=f"{mask.dtype} {mask.shape}")
        parts = zip(_split(mask, list(self._begun_with)), self._sources, strict=True)
        return dataclasses.replace(self, selection=Selection(np.concatenate([part[new] for part, new in parts])))

    def _given(self, selection: object, numbers: Sequence[int]) -> list[Mask]:
        """A mask by layers, of those that there are now."""
        sources = [self._sources[k] for k in numbers]
        counts, before = [len(source) for source in sources], [self._begun_with[k] for k in numbers]
        if selection is None:
            return [np.ones(count, bool) for count in counts]
        if callable(selection):  # it is asked now, so it answers for now
            check_signature("selection", selection, "video")
            selection, before = selection(self.video()), counts
            sources = [np.arange(count) for count in counts]
        if isinstance(selection, str | os.PathLike):
            cure = "Read a file with foldgauss.io.load_selection(path, model)."
            raise invalid("selection", expected="a Selection or a mask", got=repr(selection), cure=cure)
        mask = np.asarray(selection.mask if isinstance(selection, Selection) else selection)
        if mask.dtype != bool or mask.shape not in ((sum(counts),), (sum(before),)):
            expected = f"a Selection or mask of {sum(counts):,} Gaussians"
            cure = "For a mask of pixels: select(mask=mask, frame=k)." if mask.ndim > 1 else "Is it another model's?"
            if mask.dtype.kind in "iu" and mask.ndim <= 1:
                cure = "For numbers of Gaussians: Selection.of(model, [...])."
            got = f"{mask.dtype} {mask.shape}"
            raise invalid("selection", expected=expected, got=got, cure=cure)
        if len(mask) != sum(before) or selection is self.selection:
            return _split(mask, counts)
        moved = any(not np.array_equal(source, np.arange(count)) for source, count in zip(sources, before, strict=True))
        if moved and sum(counts) == sum(before):
            cure = "Of what the chain was begun with: select_begun(mask). Of now: select(lambda video: mask)."
            raise invalid("selection", expected="a mask that can mean but one thing", got="one of two", cure=cure)
        return [part[source] for part, source in zip(_split(mask, before), sources, strict=True)]

    # ------------------------------------------------------------------------------------- where, in the plane

    def move(self, offset: ArrayLike, **when: Unpack[When]) -> "Edit":
        """Shift by `offset` (x, y). Baked without a span."""
        return self._map(0.0, IDENTITY, self._point("offset", offset), None, when)

    def scale(self, factor: ArrayLike, *, about: ArrayLike | None = None, **when: Unpack[When]) -> "Edit":
        """Larger by `factor`, one number or (along x, along y), all > 0.

        `about`: the point (x, y) that stays; baked then, without a span. None: the selection's own centre at each time.
        """
        given = _listed("factor", factor)
        if len(given) not in (1, 2) or min(given) <= 0:
            cure = "Mirror with transform(), delete with vanish()."
            raise invalid("factor", expected="one or two numbers > 0", got=factor, cure=cure)
        about = None if about is None else self._point("about", about)
        return self._map(0.0, ((given[0], 0.0), (0.0, given[-1])), (0.0, 0.0), about, when)

    def rotate(self, angle: float, *, about: ArrayLike | None = None, **when: Unpack[When]) -> "Edit":
        """Turn by `angle` in radians, clockwise as one sees it; more than a turn is one, where it is eased.

        `about`: the point (x, y) that stays; baked then, without a span. None: the selection's own centre at each time.
        """
        angle = check_number("angle", angle)
        warn_if_degrees("angle", angle)
        about = None if about is None else self._point("about", about)
        return self._map(angle, IDENTITY, (0.0, 0.0), about, when)

    def transform(
        self,
        matrix: ArrayLike,
        offset: ArrayLike = (0.0, 0.0),
        *,
        about: ArrayLike | None = None,
        **when: Unpack[When],
    ) -> "Edit":
        """Map by m -> c + A (m - c) + b, A = `matrix` (2, 2), b = `offset` (2,); A has an inverse, and may mirror.

        `about`: c, (x, y); baked then, without a span. None: the selection's own centre at each time. Eased, A goes by
        its rotation and its symmetric part, see `Affine`.
        """
        rows = _square("matrix", matrix, 2)
        if not abs(np.linalg.det(rows)) > 1e-12 * np.abs(rows).max() ** 2:
            raise invalid("matrix", expected="a matrix that has an inverse", got=rows.tolist(), cure="See vanish().")
        offset, about = self._point("offset", offset), None if about is None else self._point("about", about)
        return self._map(*_polar(rows), offset, about, when)

    def _point(self, parameter: str, value: ArrayLike, *, stacklevel: int = 3) -> tuple[float, ...]:
        """(x, y) in model space; what is far beyond the frame is warned of."""
        point = check_numbers(parameter, value, 2)
        if max(map(abs, point)) > FAR:
            side = max(self._video.size)
            text = f"{parameter}: expected units of the frame's longer side, got {value}, far beyond it."
            warnings.warn(f"{text} For pixels divide by {side}.", stacklevel=stacklevel)
        return point

    def _map(self, angle: float, stretch, offset: tuple, about: tuple | None, when: When) -> "Edit":
        make = partial(Affine, angle=angle, stretch=stretch, offset=offset, about=about)
        identity = make(mask=np.zeros(0, bool), span=None).is_identity
        return self._apply(make, when, lambda splats, mask: apply_affine(splats, mask, make(mask, None)), skip=identity)

    # ------------------------------------------------------------------------------------------ how many, how seen

    def multiply(
        self,
        offsets: Sequence[ArrayLike],
        *,
        delays: float | Sequence[float] = 0.0,
        scale: float | Sequence[float] = 1.0,
        angle: float | Sequence[float] = 0.0,
        about: ArrayLike | None = None,
        originals: bool = False,
        **when: Unpack[When],
    ) -> "Edit":
        """Copies, one for each of `offsets` (num, 2), which become the selection, with `originals` along with them.

        Each copy is scaled and turned about `about` (None: its own centre), then shifted, and comes later by its delay
        (see `retime`): one number for all or one for each. A copy has the depth of what it is a copy of: it stands
        directly behind it. Over a span copies are there only within; eased, they come out of the original and fade in.

        Copies have the edits of their originals, each about its own centre, even if the edit was of a wider selection.
        """
        shifts = [self._point("offsets", offset) for offset in _rows("offsets", offsets)]
        about = None if about is None else self._point("about", about)
        named = (("delays", delays), ("scale", scale), ("angle", angle))
        each = {name: _one_each(name, values, len(shifts)) for name, values in named}
        if min(each["scale"]) <= 0:
            raise invalid("scale", expected="numbers > 0", got=scale, cure="Mirror with transform().")
        if not isinstance(originals, bool | np.bool_):
            raise invalid("originals", expected="True or False", got=short_repr(originals))
        warn_if_degrees("angle", *each["angle"])
        for delay in each["delays"]:
            _warn_of_frames("delays", delay, 1.0, 0.0, self._num_frames)
        span = self._span(when)
        if span is NEVER:  # no copy is ever seen
            self._check_selected()
            return self if originals else dataclasses.replace(self, selection=self.selection - self.selection)
        copied, copies = self._copied(len(shifts))
        for k, (shift, mask) in enumerate(zip(shifts, copies, strict=True)):
            one = dataclasses.replace(copied, selection=Selection(mask))
            size, still = each["scale"][k], (0.0, 0.0)
            one = one._map(0.0, ((size, 0.0), (0.0, size)), still, about, when)
            one = one._map(each["angle"][k], IDENTITY, still, about, when)._map(0.0, IDENTITY, shift, None, when)
            one = one._by_line(each["delays"][k], 1.0, 0.0, "continue", when, "delays")
            if span is not None:
                one = one._overlaid(partial(Opacity, factor=1.0, before=0.0), span)
            copied = dataclasses.replace(one, selection=copied.selection)
        chosen = copied.selection.mask if originals else np.any(copies, axis=0)
        return dataclasses.replace(copied, selection=Selection(chosen))

    def _copied(self, num: int) -> tuple["Edit", list[Mask]]:
        """With `num` copies behind each selected Gaussian, all selected; and masks of each copy."""
        self._check_selected()
        made, chosen, copies, sources = [], [], [], []
        for layer, mask in zip(self._video.layers, self._parts(), strict=True):
            counts = np.where(mask, num + 1, 1)
            source = np.repeat(np.arange(len(mask)), counts)
            copy = np.arange(len(source)) - np.repeat(np.cumsum(counts) - counts, counts)  # 0: the original
            made.append(gather_layer(layer, source, mask, copy))
            chosen.append(mask[source])
            copies.append(copy)
            sources.append(source)
        copy = np.concatenate(copies)
        copied = self._with(made, Selection(np.concatenate(chosen)), sources)
        return copied, [copy == k for k in range(1, num + 1)]

    def vanish(self, **when: Unpack[When]) -> "Edit":
        """Gone. Baked without a span: the Gaussians are deleted, and nothing is selected any more."""
        if self._span(when) is not None:
            return self.opacity(0.0, **when)
        self._check_selected()
        made, sources = [], []
        for layer, mask in zip(self._video.layers, self._parts(), strict=True):
            delete = mask.any() and not mask.all() and _can_lose(layer, mask)
            source = np.flatnonzero(~mask) if delete else np.arange(len(mask))
            if delete:
                layer = gather_layer(layer, source, mask, np.zeros(len(source), int))
            elif mask.any():
                layer = _with_overlay(layer, Opacity(mask, None, 0.0))
            made.append(layer)
            sources.append(source)
        return self._with(made, Selection(np.zeros(sum(map(len, sources)), bool)), sources)

    def to_front(self) -> "Edit":
        """Before all other Gaussians of its layer, in their own order. Baked: the array's order is that of depth.

        After a fit, Gaussians of the ground stand before an object, where they do not touch it: it has to come forward
        before it is moved, copied or enlarged, or they cover it at its new place.
        """
        return self._reordered(front=True)

    def to_back(self) -> "Edit":
        """Behind all other Gaussians of its layer, in their own order. Baked, as `to_front`."""
        return self._reordered(front=False)

    def _reordered(self, *, front: bool) -> "Edit":
        self._check_selected()
        parts = self._parts()
        sources = [np.argsort(~mask if front else mask, kind="stable") for mask in parts]
        made = [
            gather_layer(layer, source, mask, np.zeros(len(source), int))
            for layer, source, mask in zip(self._video.layers, sources, parts, strict=True)
        ]
        chosen = [mask[source] for mask, source in zip(parts, sources, strict=True)]
        return self._with(made, Selection(np.concatenate(chosen)), sources)

    def opacity(self, factor: float, **when: Unpack[When]) -> "Edit":
        """Opacity times `factor` >= 0, held at 1. Baked without a span, where it stays below 1; 0 is `vanish`."""
        factor = check_number("factor", factor)
        if factor == 0 and self._span(when) is None:
            return self.vanish()
        make = partial(Opacity, factor=factor)
        make(np.zeros(0, bool), None)  # the checks
        return self._apply(make, when, lambda splats, mask: scale_opacity(splats, mask, factor), skip=factor == 1)

    def recolor(
        self,
        color: ArrayLike | None = None,
        *,
        hue: float | None = None,
        gain: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        matrix: ArrayLike | None = None,
        **when: Unpack[When],
    ) -> "Edit":
        """Other colours, in one of three ways, baked without a span; never below 0.

        - `color` (3,): the object becomes this colour on the whole and keeps its shading: each Gaussian's lightness
          over the selection's mean, by opacity, times `color`.
        - `hue` in turns, 0 red, 1/3 green, 2/3 blue: lightness and colourfulness stay.
        - c' = gain * (M c) + offset with `matrix` (3, 3); `gain`, `offset` one number or (3,).

        **Units:** red, green and blue about [0, 1].
        """
        linear = any(x is not None for x in (gain, offset, matrix))
        if (color is not None) + (hue is not None) + linear != 1:
            raise invalid("color, hue, gain", expected="one way to recolour", got="none, or several")
        if hue is not None and not is_within(hue, "[0, 1]"):
            raise invalid("hue", expected="turns in [0, 1]", got=repr(hue), cure="Degrees over 360.")
        if color is not None:
            target = check_color(color)
            self._check_selected()
            matrix, gain = np.outer(target, LUMINANCE_WEIGHTS), 1 / mean_lightness([self._light()])
        make = _recolor(gain, offset, matrix, None if hue is None else check_number("hue", hue))
        identity = make(np.zeros(0, bool), None) == _recolor(None, None, None, None)(np.zeros(0, bool), None)
        bake = lambda splats, mask: apply_recolor(splats, mask, make(mask, None))  # noqa: E731
        return self._apply(make, when, bake, skip=bool(identity))

    def _light(self) -> tuple[float, float]:
        """What the selection's Gaussians have of lightness, by their opacity, and their opacity, in all."""
        parts = zip(self._video.layers, self._parts(), strict=True)
        looks = [opacities_and_colors(layer.model.splats, mask) for layer, mask in parts]
        opacity, color = (np.concatenate(leaves) for leaves in zip(*looks, strict=True))
        return float(opacity @ (color @ LUMINANCE_WEIGHTS)), float(opacity.sum())

    # ------------------------------------------------------------------------------------------------------- when

    def retime(
        self,
        *,
        shift: float = 0.0,
        stretch: float = 1.0,
        about: float = 0.0,
        outside: str = "continue",
        clock: Clock | None = None,
        **when: Unpack[When],
    ) -> "Edit":
        """Another time for the selection: what it does at t it does at `about + shift + stretch (t - about)`.

        A positive shift is later; a stretch above 1 slower, below 0 backwards (`stretch=-1, about=0.5` is the clip in
        reverse). Baked, without a span, where all m_t stay within (0, 1), and else the same pictures by a clock. Before
        the first frame and after the last, folds go on as they are (`outside` "continue": no frame was seen there, so
        for short ways only) or the selection stands still ("hold", always a clock). Or any `clock` in place of numbers.

        A clock tells the model's own time: spans of edits before this one stay where they are.

        **Units:** times in [0, 1]; n evenly timed frames lie 1 / (n - 1) apart.
        """
        if clock is not None and (shift, stretch, about) != (0, 1, 0):
            raise invalid("clock", expected="a clock, or shift, stretch and about", got="both")
        if clock is not None and outside != "continue":
            raise invalid("outside", expected="a clock that has its own", got=outside, cure="Clock(..., outside=...).")
        if clock is not None and not isinstance(clock, Clock):
            cure = "Clock(times, own_times) goes straight between knots." if callable(clock) else ""
            raise invalid("clock", expected="a Clock", got=type(clock).__name__, cure=cure)
        if clock is not None:
            return self._by_clock(clock, when, "clock")
        Clock.shifted(shift, stretch, about=about, outside=outside)  # the checks
        _warn_of_frames("shift", shift, stretch, about, self._num_frames)
        return self._by_line(shift, stretch, about, outside, when, "shift")

    def _by_clock(self, clock: Clock, when: When, parameter: str) -> "Edit":
        """By another clock; always laid over."""
        if self._window is not None:
            self._window.check_own(clock, parameter, **when)
            clock = self._window.clock(clock)
        return self._apply(partial(Retiming, clock=clock), when)

    def _by_line(self, shift: float, stretch: float, about: float, outside: str, when: When, parameter: str) -> "Edit":
        """What it does at t at about + shift + stretch (t - about): baked where it can be."""
        line = Clock.shifted(shift, stretch, about=about, outside=outside)
        identity = (shift, stretch) == (0, 1) and outside == "continue"
        if self._window is not None and not identity:
            own_line = self._window.line(shift, stretch, about)
            if own_line is None:
                return self._by_clock(line, when, parameter)
            self._window.check_own(line, parameter, **when)
            shift, stretch, about = own_line
            line = self._window.clock(line)
        bake = partial(apply_retiming, shift=float(shift), stretch=float(stretch), about=float(about))
        # Between shots a clock shows the nearer one, of one frame alone that frame: no leaves say so.
        bakes = outside == "continue" and not any(layer.holds_frames for layer in self._video.layers)
        return self._apply(partial(Retiming, clock=line), when, bake if bakes else None, skip=identity)

    def freeze(self, at: float, **when: Unpack[When]) -> "Edit":
        """The selection stands still as it is at frame `at`, or a position between two."""
        times = self._frame_times()
        position = check_number("at", at)
        if not 0 <= position <= len(times) - 1:
            raise invalid("at", expected=f"a frame in [0, {len(times) - 1}]", got=at)
        clock = Clock.frozen(float(np.interp(position, np.arange(len(times)), times)))
        return self._by_clock(clock, when, "at")

    # ------------------------------------------------------------------------------------------------ any function

    def apply(self, function: Callable[[SelectedGaussians, float], SelectedGaussians], **when: Unpack[When]) -> "Edit":
        """Any function of the conditioned Gaussians selected and the time t; it returns them changed.

        They are handed over read-only; leaves that come back as they were keep their bits. Eased, leaves go straight
        from before to after. Always an overlay. It draws and plays; **it cannot be saved**, since files hold no code.

        **Example:** `edit(model).apply(lambda g, t: dataclasses.replace(g, mean=g.mean * (1 + t)))`
        """
        return self._apply_function(GaussianFunction, function, "gaussians", when)

    def apply_triangles(
        self,
        function: Callable[[Float[np.ndarray, "num 3 3"], float], Float[np.ndarray, "num 3 3"]],
        **when: Unpack[When],
    ) -> "Edit":
        """Any function of the selection's triangles and the time t, vertices in, vertices out: (num, 3, 3), (x, y, z).

        A Gaussian's face is V = [m, m + s1 r1, m + s2 r2]; its vertices moved, it follows. Faces that leave the plane
        z = 0 are seen by the video's camera. As `apply` for the rest, saving included.

        **Source:** VeGaS eq:traingle_face, eq:gaussrecons1; GaMeS. **Raises:** ValueError, when drawn, for faces
        without area and numbers that are not finite.
        """
        return self._apply_function(TriangleFunction, function, "vertices", when)

    def _apply_function(self, kind: type[AbstractOverlay], function: object, of: str, when: When) -> "Edit":
        if not callable(function):
            raise invalid("function", expected="a function", got=type(function).__name__)
        check_signature("function", function, of, "t")
        if self._window is not None:
            function = self._window.by_clip_time(function)
        return self._apply(partial(kind, function=function), when)

    # --------------------------------------------------------------------------------------------------- in space

    def place(
        self,
        *,
        depth: float = 0.0,
        rotate: ArrayLike = (0.0, 0.0, 0.0),
        about: ArrayLike | None = None,
        **when: Unpack[When],
    ) -> "Edit":
        """Turn the flat selection in space about (x, y) (None: its own centre), then move it in depth; an overlay.

        `depth` > 0 is away from the viewer, so behind all that stays in the plane, < 0 nearer, see `EditedVideo`.
        `rotate`: an axis (x right, y down, z away) times an angle in radians.

        **Source:** MiraGe; VeGaS eq:mirage.
        """
        fields = {
            "depth": check_number("depth", depth),
            "rotation": check_numbers("rotate", rotate, 3),
            "about": None if about is None else self._point("about", about),
        }
        warn_if_degrees("rotate", *fields["rotation"])
        return self._apply(partial(Place, **fields), when, skip=not fields["depth"] and not any(fields["rotation"]))

    def seen_from(self, camera: Camera | Callable[[float], Camera] | None) -> "Edit":
        """The whole video from another camera: a `Camera`, or a function of t (which cannot be saved); None: the front.

        **Example:** `edit(model).seen_from(lambda t: Camera.front(0.5).orbit(0.3 * t)).video()`
        """
        if camera is not None and not isinstance(camera, Camera) and not callable(camera):
            raise invalid("camera", expected="a Camera, a function of t or None", got=type(camera).__name__)
        if camera is not None and not isinstance(camera, Camera):
            check_signature("camera", camera, "t")
        if isinstance(camera, Camera) and camera.position.ndim != 1:
            raise invalid("camera", expected="one camera", got=f"positions of shape {camera.position.shape}")
        if self._window is not None and camera is not None and not isinstance(camera, Camera):
            camera = self._window.by_clip_time(camera)
        return dataclasses.replace(self, _video=dataclasses.replace(self._video, camera=camera))

    # ---------------------------------------------------------------------------------------------------- the works

    def _apply(
        self,
        make: Callable[..., AbstractOverlay | Retiming],
        when: When,
        bake: Bake | None = None,
        *,
        skip: bool = False,
    ) -> "Edit":
        """Bake the edit into each layer, or lay it over; nothing at all if it is known to change nothing."""
        span = self._span(when)
        self._check_selected()
        if skip or span is NEVER:
            return self
        made = []
        for layer, mask in zip(self._video.layers, self._parts(), strict=True):
            if not mask.any():
                made.append(layer)
                continue
            made_so = make(mask, span)
            if isinstance(made_so, Retiming):
                _check_apart(layer, mask)
            before = layer.clocks if isinstance(made_so, Retiming) else layer.overlays
            free = span is None and not any((np.asarray(other.mask) & mask).any() for other in before)
            if layer.model.scale_cutoff > 0 and isinstance(made_so, Affine) and made_so.stretch != IDENTITY:
                free = False  # other sizes would be left out at other times
            baked = bake(layer.model.splats, mask) if bake is not None and free else None
            made.append(_with_overlay(layer, made_so) if baked is None else _with_splats(layer, baked))
        return self._with(made, self.selection)

    def _check_selected(self) -> None:
        if not len(self.selection):
            cure = "The selection found nothing, or vanish() was before: call select() again."
            raise invalid("selection", expected="at least one Gaussian", got="none", cure=cure)

    def _overlaid(self, make: Callable[..., AbstractOverlay], span: Span) -> "Edit":
        made = [
            _with_overlay(layer, make(mask, span)) if mask.any() else layer
            for layer, mask in zip(self._video.layers, self._parts(), strict=True)
        ]
        return self._with(made, self.selection)

    def _with(
        self, layers: list[Layer], selection: Selection, sources: list[Int[np.ndarray, " num"]] | None = None
    ) -> "Edit":
        """With other layers, whose Gaussians are those `sources` of now, by layer."""
        made = {"_video": dataclasses.replace(self._video, layers=tuple(layers)), "selection": selection}
        if sources is not None:
            made["_sources"] = tuple(old[new] for old, new in zip(self._sources, sources, strict=True))
        return dataclasses.replace(self, **made)

    def _parts(self) -> list[Mask]:
        """The selection by layers."""
        return _split(self.selection.mask, [layer.num_gaussians for layer in self._video.layers])

    def _span(self, when: When) -> Span | None:
        for name in when:
            if name not in When.__annotations__:
                near = difflib.get_close_matches(name, When.__annotations__, 1)
                expected, cure = "one of " + ", ".join(When.__annotations__), f"Did you mean {near[0]}?" if near else ""
                raise invalid("when", expected=expected, got=name, cure=cure)
        return make_span(self._frame_times(), **when) if self._window is None else self._window.span(**when)

    @property
    def _num_frames(self) -> int:
        return self._video.num_frames if self._window is None else self._window.num_frames

    def _frame_times(self) -> Float[np.ndarray, " num_frames"]:
        """Of the clip."""
        if self._window is not None:
            return self._window.frame_times
        return np.asarray(self._video.frame_times.times(), np.float64)


def check_color(color: ArrayLike) -> tuple[float, ...]:
    """Red, green and blue. Raises ValueError unless all are in [0, 1]."""
    target = check_numbers("color", color, 3)
    if min(target) < 0 or max(target) > 1:
        raise invalid("color", expected="red, green and blue in [0, 1]", got=target)
    return target


def mean_lightness(light: Sequence[tuple[float, float]]) -> float:
    """The mean of what `Edit` has of light, of one chain or several. Raises ValueError where it is dark."""
    of_light, opacity = (sum(parts) for parts in zip(*light, strict=True))
    mean = of_light / max(opacity, np.finfo(float).tiny)
    if mean < MIN_LIGHTNESS:
        cure = "It is black, without shading: use offset=."
        raise invalid("color", expected="an object with some light", got=f"lightness {mean:g}", cure=cure)
    return mean


def _split(mask: Mask, counts: Sequence[int]) -> list[Mask]:
    return np.split(mask, np.cumsum(counts)[:-1])


def gather_layer(
    layer: Layer, source: Int[np.ndarray, " num_new"], chosen: Mask, copy: Int[np.ndarray, " num_new"]
) -> Layer:
    """A layer of the Gaussians `source`, with all edits that they had; those of `copy` k are its k-th copies.

    An edit of some of the `chosen` becomes one for each copy, as its own centre is each one's own.
    """
    overlays = []
    for overlay in layer.overlays:
        mask = np.asarray(overlay.mask)
        numbers = range(copy.max(initial=0) + 1) if (mask & chosen).any() else [None]
        masks = [mask[source] if k is None else mask[source] & (copy == k) for k in numbers]
        overlays += [dataclasses.replace(overlay, mask=one) for one in masks if one.any()]
    clocks = [dataclasses.replace(clock, mask=np.asarray(clock.mask)[source]) for clock in layer.clocks]
    model = dataclasses.replace(layer.model, splats=gather_splats(layer.model.splats, source))
    return Layer(model, tuple(overlays), tuple(clock for clock in clocks if clock.mask.any()))


def _check_apart(layer: Layer, mask: Mask) -> None:
    """Refuse another time for a part of what an edit takes as a whole: its rest would act otherwise."""
    for overlay in layer.overlays:
        own = np.asarray(overlay.mask)
        whole_of_it = isinstance(overlay, GaussianFunction | TriangleFunction) or (
            isinstance(overlay, Affine | Place)
            and overlay.about is None
            and not getattr(overlay, "is_translation", False)
        )
        if whole_of_it and (own & mask).any() and (own & ~mask).any():
            expected = "another time for all Gaussians of an edit about their centre, or for none of them"
            raise invalid("selection", expected=expected, got="a part of them", cure="Retime it before that edit.")


def _can_lose(layer: Layer, mask: Mask) -> bool:
    """Whether no edit would act otherwise on what is left: each has all of its Gaussians masked, or none."""
    own = [np.asarray(overlay.mask) for overlay in layer.overlays]
    return all(not (one & mask).any() or not (one & ~mask).any() for one in own)


def _with_overlay(layer: Layer, edit: AbstractOverlay | Retiming) -> Layer:
    name = "clocks" if isinstance(edit, Retiming) else "overlays"
    return dataclasses.replace(layer, **{name: (*getattr(layer, name), edit)})


def _with_splats(layer: Layer, splats: FoldedSplats) -> Layer:
    return dataclasses.replace(layer, model=dataclasses.replace(layer.model, splats=splats))


def _polar(matrix: Float[np.ndarray, "2 2"]) -> tuple[float, tuple[tuple[float, float], tuple[float, float]]]:
    """Angle and symmetric part of A = R S; where A mirrors, S does."""
    if np.array_equal(matrix, matrix.T) and np.trace(matrix) >= 0:
        return 0.0, tuple(map(tuple, matrix.tolist()))  # as it is, to the bit
    left, sizes, right = np.linalg.svd(matrix)
    flip = np.diag([1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ flip @ right
    stretch = right.T @ (flip * sizes) @ right
    cross = float(stretch[0, 1])
    rows = ((float(stretch[0, 0]), cross), (cross, float(stretch[1, 1])))
    return float(np.arctan2(turn[1, 0], turn[0, 0])), rows


def _recolor(gain, offset, matrix, hue: float | None) -> Callable[..., Recolor]:
    rows = np.eye(3) if matrix is None else _square("matrix", matrix, 3)
    gains = _one_each("gain", 1.0 if gain is None else gain, 3)
    shift = _one_each("offset", 0.0 if offset is None else offset, 3)
    table = tuple(map(tuple, (np.array(gains)[:, None] * rows).tolist()))
    return partial(Recolor, matrix=table, offset=shift, hue=hue)


def _rows(parameter: str, values: object) -> list:
    try:
        rows = list(values)
    except TypeError:
        rows = []
    if not rows or any(not np.iterable(row) for row in rows):
        raise invalid(parameter, expected="pairs, as [(0.1, 0.0), (0.2, 0.0)]", got=repr(values))
    return rows


def _warn_of_frames(parameter: str, shift: float, stretch: float, about: float, num_frames: int) -> None:
    """Warn of a time at which nothing of the clip is left."""
    ends = [about + shift + stretch * (own - about) for own in (0.0, 1.0)]
    if max(ends) < 0 or min(ends) > 1:
        text = f"{parameter}: expected times of a clip of [0, 1], got {shift:g}: nothing of it is left there."
        warnings.warn(f"{text} For frames divide by {max(num_frames - 1, 1)}.", stacklevel=3)


def _listed(parameter: str, values: ArrayLike) -> tuple[float, ...]:
    """Numbers, or one number alone, as a tuple."""
    several = isinstance(values, (list, tuple)) or getattr(values, "ndim", 0) > 0
    return check_numbers(parameter, values) if several else (check_number(parameter, values),)


def _square(parameter: str, values: ArrayLike, side: int) -> Float[np.ndarray, "side side"]:
    try:
        return np.array([check_numbers(parameter, row, side) for row in values]).reshape(side, side)
    except (TypeError, ValueError):
        expected = f"finite numbers of shape ({side}, {side})"
        raise invalid(parameter, expected=expected, got=short_repr(values)) from None


def _one_each(parameter: str, values: ArrayLike, num: int) -> tuple[float, ...]:
    """`num` numbers: as given, or one for all."""
    given = _listed(parameter, values)
    if len(given) not in (1, num):
        raise invalid(parameter, expected=f"one number or {num}", got=f"{len(given)}")
    return given if len(given) == num else given * num
