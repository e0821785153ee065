"""Chains of edits: `edit(model).select(mask=mask).move((0.1, 0.0)).video()`."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Unpack

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from foldgauss._runtime.checks import (
    check_signature,
    check_within,
    invalid,
    is_integer,
    require,
    short_repr,
    warn_if_degrees,
)
from foldgauss.render import Camera
from foldgauss.video.editing.arguments import (
    broadcast_numbers,
    check_array,
    check_color_map,
    check_number,
    check_numbers,
    check_one_or_more,
    check_select_arguments,
    missing_attribute,
    warn_if_outside_clip,
)
from foldgauss.video.editing.bake import (
    apply_affine,
    apply_recolor,
    apply_retiming,
    mean_lightness,
    opacities_and_colors,
    scale_opacity,
)
from foldgauss.video.editing.edited_video import (
    Bake,
    EditedVideo,
    Layer,
    add_edit,
    apply_edit,
    as_edited,
    can_delete,
    gather_layer,
)
from foldgauss.video.editing.overlays import (
    IDENTITY,
    LUMINANCE_WEIGHTS,
    Affine,
    GaussianFunction,
    Opacity,
    Place,
    Recolor,
    Retiming,
    SelectedGaussians,
    TimedEdit,
    polar_decompose,
)
from foldgauss.video.editing.timing import NEVER, Clock, Span, TimeMap, When, frame_times_of, make_span
from foldgauss.video.models.background import check_color
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.selection.selectors import Mask, Selection, check_mask, select, split_mask

#: A point or an offset beyond this many frame sizes is probably given in pixels.
MAX_DISTANCE = 10.0


@functools.singledispatch
def edit(model: VideoModel | EditedVideo) -> "Edit":
    """Start a chain of edits with all Gaussians selected. Raises ValueError for anything but a video.

    For a `SegmentedVideo` it is a `SegmentedEdit`, which has the same methods.

    **Example:** `edit(model).select(ball).move((0.1, 0)).video()`.
    """
    return start_chain(as_edited(model))


def start_chain(
    video: EditedVideo,
    clip_times: Float[np.ndarray, " num_frames"] | None = None,
    time_map: TimeMap | None = None,
) -> "Edit":
    """As `edit`; for a segment, frames and times of edits are those of the clip with frame times `clip_times`."""
    counts = tuple(layer.num_gaussians for layer in video.layers)
    times = frame_times_of(video) if clip_times is None else clip_times
    return Edit(video, Selection(np.ones(sum(counts), bool)), counts, tuple(map(np.arange, counts)), times, time_map)


@dataclasses.dataclass(frozen=True, eq=False)
class Edit:
    """A video being edited, and the selection that the next edit applies to. Each method returns a new `Edit`.

    Edits apply in the order of the calls, each to the result of those before. An edit that a folded model represents
    exactly at all times is **baked** into its parameters: translations; affine maps about a fixed point; opacities that
    stay below 1; colors; deletion and copies; retiming within the clip. All others are kept as
    **overlays**, applied to the conditioned Gaussians at each time: edits over a span, edits about the selection's own
    center, clocks, functions, depth. `video()` is a plain `VideoModel` if all edits could be baked. Gaussians that are
    not selected stay the same to the bit, and an edit that changes nothing (a factor 1, an angle 0) is skipped.

    Each edit takes `frame=`, `frames=` or `times=`, with `ease=` and `curve=`, as `make_span`; without, it always
    applies. Frame numbers are those of `video().frame_times`, and spans are in the video's time, whatever clocks its
    objects have.

    **Units:** model space: the origin is the frame's center, x right, y down, the frame's longer side 1; the clip's
    time is [0, 1]; angles in radians, clockwise on the screen.

    **Example:** `edit(model).select(mask=mask, frame=0).multiply([(0.2, 0), (0.4, 0)]).scale(0.8).video()`

    **Source:** VeGaS, "modification of videos"; eq:cond_dens for what can be baked. **Raises:** ValueError from every
    method for invalid arguments, and from edits with an empty selection. Values that are probably in degrees, pixels or
    frames raise a warning.
    """

    _video: EditedVideo
    selection: Selection
    #: By layer: the number of Gaussians at the start of the chain, and for each current one the index of its original.
    _counts: tuple[int, ...] = dataclasses.field(repr=False)
    _sources: tuple[Int[np.ndarray, " num"], ...] = dataclasses.field(repr=False)
    #: To which frames and spans refer, and the map from the video's own time, where that is another.
    _frame_times: Float[np.ndarray, " num_frames"] = dataclasses.field(repr=False)
    _time_map: TimeMap | None = dataclasses.field(repr=False)

    def video(self) -> VideoModel | EditedVideo:
        """The edited video: a folded model if all edits could be baked, else an `EditedVideo`.

        Layers of which `vanish` left nothing are left out, but for the one that determines the frame times.
        """
        video = self._video
        lead = video.layers[video.timeline]
        layers = tuple(layer for layer in video.layers if layer is lead or not layer.is_gone)
        video = dataclasses.replace(video, layers=layers, timeline=layers.index(lead) - len(layers))
        plain = len(video.layers) == 1 and video.camera is None
        layer = video.layers[0]
        return layer.model if plain and not layer.overlays and not layer.clocks else video

    def __getattr__(self, name: str) -> object:
        """Raise AttributeError, with a hint for attributes of the video."""
        raise missing_attribute(self, name, EditedVideo)

    # ------------------------------------------------------------------------------------------- selection

    def select(
        self,
        selection: "Selection | Mask | Callable[[VideoModel | EditedVideo], Selection] | None" = None,
        *,
        layer: int | str | None = None,
        **criteria: object,
    ) -> "Edit":
        """Choose the Gaussians that the next edits apply to, from all Gaussians; without arguments, all of them.

        `selection`: a `Selection` or a mask bool (num_gaussians,) over the Gaussians at the start of the chain, which
        are selected wherever they are now, together with their copies; or a function of `video()` that returns one over
        the current Gaussians. Else `criteria` as `foldgauss.video.select` takes them (`mask=`, `box=`, `color=`, ...),
        evaluated on each layer's model, or on the layers with the number or name `layer` only; on the model without
        overlays, so with baked edits only. Masks are over the Gaussians of all layers, front layer first, or of
        `layer`.
        """
        check_select_arguments(selection, criteria)
        layers, numbers = self._video.layers, self._layer_numbers(layer)
        if criteria:
            selected = [select(layers[k].model, **criteria).mask for k in numbers]
        else:
            selected = self._resolve(selection, numbers)
        masks = [np.zeros(one.num_gaussians, bool) for one in layers]
        for k, mask in zip(numbers, selected, strict=True):
            masks[k] = mask
        return dataclasses.replace(self, selection=Selection(np.concatenate(masks)))

    def _layer_numbers(self, layer: int | str | None) -> Sequence[int]:
        """The numbers of the layers with a number or a name, or of all."""
        names = [one.name for one in self._video.layers]
        chosen = layer if is_integer(layer, 0) else None
        numbers = [k for k, name in enumerate(names) if layer is None or k == chosen or (name and name == layer)]
        require(
            numbers,
            "layer",
            expected=" or ".join([f"a whole number in [0, {len(names) - 1}]", *map(repr, filter(None, names))]),
            got=repr(layer),
        )
        return numbers

    def _resolve(self, selection: object, numbers: Sequence[int]) -> list[Mask]:
        """A mask over the current Gaussians for each of the layers `numbers`."""
        current, begun = ([counts[k] for k in numbers] for counts in (self._layer_sizes(), self._counts))
        if selection is None:
            return [np.ones(num, bool) for num in current]
        if callable(selection):
            check_signature("selection", selection, "video")
            return split_mask(check_mask(selection(self.video()), sum(current)), current)
        masks = split_mask(check_mask(selection, sum(begun)), begun)
        return [mask[self._sources[k]] for k, mask in zip(numbers, masks, strict=True)]

    # ------------------------------------------------------------------------------ position in the plane

    def move(self, offset: ArrayLike, **when: Unpack[When]) -> "Edit":
        """Translate by `offset` (x, y). Baked without a span."""
        return self._map(0.0, IDENTITY, self._point("offset", offset), None, when)

    def scale(self, factor: ArrayLike, *, about: ArrayLike | None = None, **when: Unpack[When]) -> "Edit":
        """Enlarge by `factor`, one number or (along x, along y), all > 0.

        `about`: the fixed point (x, y); then baked without a span. None: the selection's own center at each time.
        """
        factors = check_one_or_more("factor", factor)
        require(
            len(factors) in (1, 2) and min(factors) > 0,
            "factor",
            expected="one or two numbers > 0",
            got=factor,
            cure="Mirror with transform(), delete with vanish().",
        )
        return self._map(0.0, ((factors[0], 0.0), (0.0, factors[-1])), (0.0, 0.0), self._fixed_point(about), when)

    def rotate(self, angle: float, *, about: ArrayLike | None = None, **when: Unpack[When]) -> "Edit":
        """Rotate by `angle` in radians, clockwise on the screen; an eased angle may be several turns.

        `about`: the fixed point (x, y); then baked without a span. None: the selection's own center at each time.
        """
        angle = check_number("angle", angle)
        warn_if_degrees("angle", angle)
        return self._map(angle, IDENTITY, (0.0, 0.0), self._fixed_point(about), when)

    def transform(
        self,
        matrix: ArrayLike,
        offset: ArrayLike = (0.0, 0.0),
        *,
        about: ArrayLike | None = None,
        **when: Unpack[When],
    ) -> "Edit":
        """Map by m -> c + A (m - c) + b with an invertible A = `matrix` (2, 2), which may mirror, and b = `offset`.

        `about`: c, (x, y); then baked without a span. None: the selection's own center at each time. Easing
        interpolates the rotation and the symmetric part of A, see `Affine`.
        """
        rows = check_array("matrix", matrix, 2, 2)
        # By its formula: LAPACK's elimination divides by zero where a pivot is subnormal.
        determinant = rows[0, 0] * rows[1, 1] - rows[0, 1] * rows[1, 0]
        require(
            abs(determinant) > 1e-12 * np.abs(rows).max() ** 2,
            "matrix",
            expected="an invertible matrix",
            got=rows.tolist(),
            cure="See vanish().",
        )
        offset = self._point("offset", offset)
        return self._map(*polar_decompose(rows), offset, self._fixed_point(about), when)

    def _fixed_point(self, about: ArrayLike | None) -> tuple[float, ...] | None:
        return None if about is None else self._point("about", about, stacklevel=4)

    def _point(self, parameter: str, value: ArrayLike, *, stacklevel: int = 3) -> tuple[float, ...]:
        """(x, y) in model space; warns of points far outside the frame."""
        point = check_numbers(parameter, value, 2)
        if max(map(abs, point)) > MAX_DISTANCE:
            side = max(self._video.size)
            text = f"{parameter}: expected units of the frame's longer side, got {value}, far outside the frame."
            warnings.warn(f"{text} For pixels divide by {side}.", stacklevel=stacklevel)
        return point

    def _map(self, angle: float, stretch, offset: tuple, about: tuple | None, when: When) -> "Edit":
        make = partial(Affine, angle=angle, stretch=stretch, offset=offset, about=about)
        identity = make(mask=np.zeros(0, bool), span=None).is_identity
        return self._apply(make, when, lambda splats, mask: apply_affine(splats, mask, make(mask, None)), skip=identity)

    # ------------------------------------------------------------------- copies, order, opacity and color

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
        """Add one copy for each of `offsets` (num, 2). The copies become the selection, with `originals` if True.

        Each copy is scaled and rotated about `about` (None: its own center), then translated, and delayed (see
        `retime`): one number for all copies or one for each. A copy has the depth of its original and stands directly
        behind it. Over a span copies exist only within; with easing they start at the original and fade in.

        Copies have the edits of their originals, each about its own center, even if the edit was of a larger selection.
        """
        # By `map`: a list comprehension is a frame of its own in Python 3.11, at which warnings would point.
        shifts = list(map(partial(self._point, "offsets"), check_array("offsets", offsets, None, 2).tolist()))
        about = self._fixed_point(about)
        named = (("delays", delays), ("scale", scale), ("angle", angle))
        delays, sizes, angles = (broadcast_numbers(name, values, len(shifts)) for name, values in named)
        require(shifts, "offsets", expected="at least one pair", got="none")
        require(min(sizes) > 0, "scale", expected="numbers > 0", got=scale, cure="Mirror with transform().")
        require(
            isinstance(originals, bool | np.bool_), "originals", expected="True or False", got=short_repr(originals)
        )
        warn_if_degrees("angle", *angles)
        for delay in delays:
            warn_if_outside_clip("delays", delay, 1.0, 0.0, len(self._frame_times))
        span = self._span(when)
        if span is NEVER:  # the copies would never be visible
            self._check_selected()
            return self if originals else dataclasses.replace(self, selection=self.selection - self.selection)
        copied, copies = self._add_copies(len(shifts))
        for size, turn, shift, delay, mask in zip(sizes, angles, shifts, delays, copies, strict=True):
            one = dataclasses.replace(copied, selection=Selection(mask))
            one = one._map(turn, ((size, 0.0), (0.0, size)), shift, about, when)
            one = one._retime_linearly(delay, 1.0, 0.0, when, "delays")
            if span is not None:
                one = one._edit_layers(lambda layer, mask: add_edit(layer, Opacity(mask, span, factor=1.0, before=0.0)))
            copied = dataclasses.replace(one, selection=copied.selection)
        selected = copied.selection.mask if originals else np.any(copies, axis=0)
        return dataclasses.replace(copied, selection=Selection(selected))

    def _add_copies(self, num: int) -> tuple["Edit", list[Mask]]:
        """Add `num` copies behind each selected Gaussian, all selected; and the masks of the copies."""
        self._check_selected()
        sources, copies = [], []
        for mask in self._masks():
            counts = np.where(mask, num + 1, 1)
            source = np.repeat(np.arange(len(mask)), counts)
            sources.append(source)
            copies.append(np.arange(len(source)) - np.repeat(np.cumsum(counts) - counts, counts))  # 0: the original
        copy = np.concatenate(copies)
        return self._gather(sources, copies), [copy == k for k in range(1, num + 1)]

    def vanish(self, **when: Unpack[When]) -> "Edit":
        """Remove the selection. Without a span the Gaussians are deleted, and the selection is empty.

        An overlay hides them instead where they are all of a layer, or only a part of those of an earlier overlay.
        """
        if self._span(when) is not None:
            return self.opacity(0.0, **when)
        self._check_selected()
        layers, sources = [], []
        for layer, mask in zip(self._video.layers, self._masks(), strict=True):
            delete = mask.any() and not mask.all() and can_delete(layer, mask)
            source = np.flatnonzero(~mask) if delete else np.arange(len(mask))
            layers.append(gather_layer(layer, source, mask) if delete else add_edit(layer, Opacity(mask, None, 0.0)))
            sources.append(source)
        return self._replace_layers(layers, np.zeros(sum(map(len, sources)), bool), sources)

    def to_front(self) -> "Edit":
        """Move before all other Gaussians of the layer, in the same order. Baked, since array order is depth order.

        After a fit, Gaussians of the background may stand before an object where they do not overlap it. Bring the
        object to the front before it is moved, copied or enlarged, or they cover it at its new place.
        """
        return self._gather([np.argsort(~mask, kind="stable") for mask in self._masks()])

    def to_back(self) -> "Edit":
        """Move behind all other Gaussians of the layer, in the same order. Baked, as `to_front`."""
        return self._gather([np.argsort(mask, kind="stable") for mask in self._masks()])

    def opacity(self, factor: float, **when: Unpack[When]) -> "Edit":
        """Multiply the opacity by `factor` >= 0, clipped at 1. Baked without a span if it stays below 1; 0 deletes."""
        factor = check_number("factor", factor)
        if factor == 0 and self._span(when) is None:
            return self.vanish()
        make = partial(Opacity, factor=factor)
        make(np.zeros(0, bool), None)  # checks the factor
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
        """Change the colors in one of three ways, clipped at 0 from below. Baked without a span.

        - `color` (3,): the object takes this color and keeps its shading: `color` times each Gaussian's lightness over
          the mean lightness of the selection, weighted by opacity.
        - `hue` in turns, 0 red, 1/3 green, 2/3 blue: lightness and distance from gray are kept.
        - c' = gain * (M c) + offset with `matrix` M (3, 3); `gain`, `offset` one number or (3,).

        **Units:** red, green and blue about [0, 1].
        """
        linear = any(x is not None for x in (gain, offset, matrix))
        require(
            (color is not None) + (hue is not None) + linear == 1,
            "color, hue, gain",
            expected="color, hue, or gain, offset and matrix",
            got="none of them, or several",
        )
        if hue is not None:
            check_within("hue", hue, "[0, 1]", "turns in [0, 1], degrees over 360")
        if color is not None:
            rgb = check_color("color", color)
            self._check_selected()
            matrix, gain = np.outer(rgb, LUMINANCE_WEIGHTS), 1 / mean_lightness([self._sum_lightness()])
        hue = None if hue is None else check_number("hue", hue)
        rows, shift = check_color_map(gain, offset, matrix)
        make = partial(Recolor, matrix=rows, offset=shift, hue=hue)
        skip = hue is None and (rows, shift) == check_color_map(None, None, None)
        return self._apply(make, when, lambda splats, mask: apply_recolor(splats, mask, make(mask, None)), skip=skip)

    def _sum_lightness(self) -> tuple[float, float]:
        """The sum of the selection's lightness weighted by opacity, and the sum of the weights."""
        parts = zip(self._video.layers, self._masks(), strict=True)
        leaves = [opacities_and_colors(layer.model.splats, mask) for layer, mask in parts]
        opacity, color = (np.concatenate(leaf) for leaf in zip(*leaves, strict=True))
        return float(opacity @ (color @ LUMINANCE_WEIGHTS)), float(opacity.sum())

    # ---------------------------------------------------------------------------------------------- timing

    def retime(
        self,
        *,
        shift: float = 0.0,
        stretch: float = 1.0,
        about: float = 0.0,
        clock: Clock | None = None,
        **when: Unpack[When],
    ) -> "Edit":
        """Change the selection's timing: what it shows at t it shows at `about + shift + stretch (t - about)`.

        A positive shift is later; a stretch above 1 is slower, below 0 backwards (`stretch=-1, about=0.5` reverses the
        clip). Before it begins and after it ends the selection stands still, as its first or last frame shows it. Baked
        without a span if it never stands still and all time locations stay within (0, 1), else done by a clock. Or give
        any `clock`.

        A clock changes the model's own time: spans of earlier edits stay where they are.

        **Units:** times in [0, 1]; n evenly timed frames lie 1 / (n - 1) apart.
        """
        if clock is not None:
            line = (shift, stretch, about)
            require(line == (0, 1, 0), "clock", expected="a clock, or shift, stretch and about", got="both")
            cure = "Clock(times, own_times) is linear between knots." if callable(clock) else ""
            require(isinstance(clock, Clock), "clock", expected="a Clock", got=type(clock).__name__, cure=cure)
            return self._retime_by_clock(clock, when, "clock")
        Clock.shifted(shift, stretch, about=about)  # checks them
        warn_if_outside_clip("shift", shift, stretch, about, len(self._frame_times))
        return self._retime_linearly(shift, stretch, about, when, "shift")

    def _retime_by_clock(self, clock: Clock, when: When, parameter: str) -> "Edit":
        """Add a clock; in a segment it runs between two that convert the times, of which the last is applied first."""
        time_map = self._time_map
        if time_map is None or self._span(when) is NEVER:
            return self._apply(partial(Retiming, clock=clock), when)
        self._check_selected()
        span, edited = make_span(self._frame_times, **when), self
        time_map.check_clock(clock, span, parameter, len(self._frame_times))
        for own_span, own_clock in ((None, time_map.to_own), (span, clock), (None, time_map.to_whole)):
            make = partial(Retiming, span=own_span, clock=own_clock)
            edited = edited._edit_layers(lambda layer, mask, make=make: apply_edit(layer, make(mask)))
        return edited

    def _retime_linearly(self, shift: float, stretch: float, about: float, when: When, parameter: str) -> "Edit":
        """Show t at about + shift + stretch (t - about), baked where possible."""
        clock = Clock.shifted(shift, stretch, about=about)
        identity = (shift, stretch) == (0, 1)
        if self._time_map is not None and not identity:
            return self._retime_by_clock(clock, when, parameter)
        bake = partial(apply_retiming, shift=float(shift), stretch=float(stretch), about=float(about))
        never_holds = clock.times[0] <= 0 and clock.times[-1] >= 1
        # Between shots a clock shows the nearer frame, which parameters cannot represent.
        bakes = never_holds and not any(layer.holds_frames for layer in self._video.layers)
        return self._apply(partial(Retiming, clock=clock), when, bake if bakes else None, skip=identity)

    def freeze(self, at: float, **when: Unpack[When]) -> "Edit":
        """Hold the selection as it is at frame `at`, or at a position between two frames."""
        times = self._frame_times
        position = check_number("at", at)
        require(0 <= position <= len(times) - 1, "at", expected=f"a frame in [0, {len(times) - 1}]", got=at)
        clock = Clock.frozen(float(np.interp(position, np.arange(len(times)), times)))
        return self._retime_by_clock(clock, when, "at")

    # ------------------------------------------------------------------------------------------- functions

    def apply(self, function: Callable[[SelectedGaussians, float], SelectedGaussians], **when: Unpack[When]) -> "Edit":
        """Apply any function of the conditioned selected Gaussians and the time t that returns them changed.

        Its input is read-only; arrays that are returned as they were stay the same to the bit. Easing interpolates
        linearly between before and after. Always an overlay, which can be rendered and played, but **not saved**, since
        files contain no code.

        **Example:** `edit(model).apply(lambda g, t: dataclasses.replace(g, mean=g.mean * (1 + t)))`
        """
        require(callable(function), "function", expected="a function", got=type(function).__name__)
        check_signature("function", function, "gaussians", "t")
        function = function if self._time_map is None else self._time_map.convert_function(function)
        return self._apply(partial(GaussianFunction, function=function), when)

    # -------------------------------------------------------------------------------------------- 3D space

    def place(
        self,
        *,
        depth: float = 0.0,
        rotate: ArrayLike = (0.0, 0.0, 0.0),
        about: ArrayLike | None = None,
        **when: Unpack[When],
    ) -> "Edit":
        """Rotate the flat selection in 3D about (x, y) (None: its own center), then move it in depth. An overlay.

        `depth` > 0 is away from the viewer, so behind everything in the image plane; < 0 is nearer. See `EditedVideo`.
        `rotate`: an axis (x right, y down, z away) times an angle in radians.

        **Source:** MiraGe; VeGaS eq:mirage.
        """
        depth, rotation = check_number("depth", depth), check_numbers("rotate", rotate, 3)
        about = self._fixed_point(about)
        warn_if_degrees("rotate", *rotation)
        make = partial(Place, depth=depth, rotation=rotation, about=about)
        return self._apply(make, when, skip=not depth and not any(rotation))

    def seen_from(self, camera: Camera | Callable[[float], Camera] | None) -> "Edit":
        """Set the camera of the whole video: a `Camera`, a function of t (which cannot be saved) or None, the front.

        **Example:** `edit(model).seen_from(lambda t: Camera.front(0.5).orbit(0.3 * t)).video()`
        """
        if isinstance(camera, Camera):
            require(
                camera.position.ndim == 1,
                "camera",
                expected="one camera",
                got=f"positions of shape {camera.position.shape}",
            )
        elif callable(camera):
            check_signature("camera", camera, "t")
            camera = camera if self._time_map is None else self._time_map.convert_function(camera)
        elif camera is not None:
            raise invalid("camera", expected="a Camera, a function of t or None", got=type(camera).__name__)
        return dataclasses.replace(self, _video=dataclasses.replace(self._video, camera=camera))

    # ------------------------------------------------------------------------------------ shared by the edits

    def _apply(
        self,
        make: Callable[..., TimedEdit],
        when: When,
        bake: Bake | None = None,
        *,
        skip: bool = False,
    ) -> "Edit":
        """Bake the edit `make(mask, span)` into each layer, or add it as an overlay; `skip` an edit without effect."""
        span = self._span(when)
        self._check_selected()
        if skip or span is NEVER:
            return self
        return self._edit_layers(lambda layer, mask: apply_edit(layer, make(mask, span), bake))

    def _check_selected(self) -> None:
        require(
            len(self.selection),
            "selection",
            expected="at least one Gaussian",
            got="none",
            cure="The selection found nothing, or vanish() removed it: call select() again.",
        )

    def _edit_layers(self, change: Callable[[Layer, Mask], Layer]) -> "Edit":
        """Replace each layer that has selected Gaussians by `change(layer, mask)`."""
        pairs = zip(self._video.layers, self._masks(), strict=True)
        layers = [change(layer, mask) if mask.any() else layer for layer, mask in pairs]
        return self._replace_layers(layers, self.selection.mask)

    def _gather(
        self, sources: Sequence[Int[np.ndarray, " num"]], copies: Sequence[Int[np.ndarray, " num"]] | None = None
    ) -> "Edit":
        """Reorder and copy the Gaussians of each layer, see `gather_layer`; the selection follows."""
        self._check_selected()
        masks, copies = self._masks(), copies or [None] * len(sources)
        layers = list(map(gather_layer, self._video.layers, sources, masks, copies))
        selected = [mask[source] for mask, source in zip(masks, sources, strict=True)]
        return self._replace_layers(layers, np.concatenate(selected), sources)

    def _replace_layers(
        self, layers: Sequence[Layer], selected: Mask, sources: Sequence[Int[np.ndarray, " num"]] | None = None
    ) -> "Edit":
        """Replace the layers and the selection; `sources`: by layer, the indices that their Gaussians have now."""
        video = dataclasses.replace(self._video, layers=tuple(layers))
        own = self._sources
        if sources is not None:
            own = tuple(old[new] for old, new in zip(own, sources, strict=True))
        return dataclasses.replace(self, _video=video, selection=Selection(selected), _sources=own)

    def _masks(self) -> list[Mask]:
        """The selection by layers."""
        return split_mask(self.selection.mask, self._layer_sizes())

    def _layer_sizes(self) -> list[int]:
        return [layer.num_gaussians for layer in self._video.layers]

    def _span(self, when: When) -> Span | None:
        """The span in the video's own time."""
        span = make_span(self._frame_times, **when)
        return span if span is None or self._time_map is None else self._time_map.convert_span(span)
