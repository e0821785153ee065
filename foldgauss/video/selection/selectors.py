"""Selections: sets of Gaussians, and functions that select them by region, color, time or a click."""

import dataclasses
import functools
import inspect
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Float32, Int, Int8

from foldgauss._runtime.checks import check_within, invalid, is_integer, require, short_repr
from foldgauss.render import cpu
from foldgauss.video.models.background import check_color
from foldgauss.video.models.renderer import check_time
from foldgauss.video.models.splats import SH_C0
from foldgauss.video.models.video_model import VideoModel, check_model
from foldgauss.video.motion.background_plate import SIDE
from foldgauss.video.motion.moving_object import LEAST_FRAMES, find_moving_object, nothing_moves
from foldgauss.video.selection.contributions import (
    Contributions,
    average_seen_colors,
    render_matte,
    sum_contributions,
)
from foldgauss.video.selection.regions import (
    Masks,
    Region,
    check_times,
    region_from_box,
    region_from_mask,
    region_from_polygon,
    resolve_frames,
)
from foldgauss.video.selection.tracking import (
    CLEAR,
    IN,
    OUT,
    UNKNOWN,
    color_difference,
    grow_from_pixel,
    propagate_labels,
    settle_labels,
    to_lab,
)

#: Fraction of a Gaussian's contribution that must lie inside a mask.
THRESHOLD = 0.5
#: Default tolerance in Delta E: a shade.
COLOR_TOLERANCE = 10.0
#: That of clicks, in Delta E: links between neighbors limit the set, too.
CLICK_TOLERANCE = 15.0


Mask = Bool[np.ndarray, "num"]


@dataclasses.dataclass(frozen=True, eq=False)
class Selection:
    """A set of Gaussians of one video, with the operations of sets: `|`, `&`, `-`, `^`, `~`, `==`, `len`, `in`.

    **Shapes:** `mask` is bool (num_gaussians,), in the model's array order, of segments and of layers one after
    another; it is copied and cannot be written to.

    **Example:** `moving = by_box(model, (10, 10, 50, 40), frame=0) - by_color(model, (0, 1, 0), tolerance=20)`.

    **Raises:** ValueError for a mask of another kind, and for sets of models with different numbers of Gaussians.
    """

    mask: Bool[np.ndarray, "num_gaussians"]

    def __post_init__(self) -> None:
        mask = np.array(self.mask)
        require(
            mask.ndim == 1 and mask.dtype == bool,
            "mask",
            expected="bool (num_gaussians,)",
            got=f"{mask.dtype} {mask.shape}",
            cure="For indices of Gaussians use Selection.of(model, indices).",
        )
        mask.setflags(write=False)
        object.__setattr__(self, "mask", mask)

    @classmethod
    def of(cls, model: VideoModel, indices: Int[np.ndarray, " num"]) -> "Selection":
        """The Gaussians with these indices. Raises ValueError for indices that the model does not have."""
        check_model(model)
        indices, mask = np.asarray(indices), np.zeros(model.splats.num_gaussians, bool)
        if indices.size:
            require(
                indices.ndim == 1 and indices.dtype.kind in "iu" and indices.min() >= 0 and indices.max() < len(mask),
                "indices",
                expected=f"whole numbers in [0, {len(mask)})",
                got=indices,
            )
            mask[indices] = True
        return cls(mask)

    @classmethod
    def all(cls, model: VideoModel) -> "Selection":
        """Every Gaussian."""
        return ~cls.none(model)

    @classmethod
    def none(cls, model: VideoModel) -> "Selection":
        """No Gaussian."""
        return cls.of(model, ())

    @property
    def indices(self) -> Int[np.ndarray, " num_selected"]:
        """Indices of the selected Gaussians, in array order."""
        return np.flatnonzero(self.mask)

    @property
    def num_gaussians(self) -> int:
        """The number of Gaussians of the model, selected or not."""
        return len(self.mask)

    def __len__(self) -> int:
        return int(self.mask.sum())

    def __contains__(self, index: int) -> bool:
        return is_integer(index, 0) and index < self.num_gaussians and bool(self.mask[index])

    def __or__(self, other: "Selection") -> "Selection":
        return Selection(self.mask | self._mask_of(other))

    def __and__(self, other: "Selection") -> "Selection":
        return Selection(self.mask & self._mask_of(other))

    def __sub__(self, other: "Selection") -> "Selection":
        return Selection(self.mask & ~self._mask_of(other))

    def __xor__(self, other: "Selection") -> "Selection":
        return Selection(self.mask ^ self._mask_of(other))

    def __invert__(self) -> "Selection":
        return Selection(~self.mask)

    def __eq__(self, other: object) -> bool:
        return np.array_equal(self.mask, other.mask) if isinstance(other, Selection) else NotImplemented

    def __repr__(self) -> str:
        return f"Selection({len(self):,} of {self.num_gaussians:,})"

    def _mask_of(self, other: "Selection") -> Bool[np.ndarray, "num_gaussians"]:
        if not isinstance(other, Selection):
            raise TypeError(f"expected a Selection, got {type(other).__name__}. Selection(mask) makes one of a mask.")
        require(
            other.num_gaussians == self.num_gaussians,
            "selection",
            expected=f"a selection of {self.num_gaussians:,} Gaussians",
            got=f"one of {other.num_gaussians:,}",
            cure="Is it another model's?",
        )
        return other.mask


def check_mask(selection: object, num: int) -> Mask:
    """The mask of a `Selection`, or a mask itself. Raises ValueError for anything but those of `num` Gaussians."""
    require(
        not isinstance(selection, str | os.PathLike),
        "selection",
        expected="a Selection or a mask",
        got=repr(selection),
        cure="Read indices with foldgauss.io.parse_indices(text, num_gaussians).",
    )
    mask = np.asarray(selection.mask if isinstance(selection, Selection) else selection)
    if mask.dtype == bool and mask.shape == (num,):
        return mask
    cure = "Is it another model's? For Gaussians after edits: select(lambda video: mask)."
    if mask.ndim > 1:
        cure = "For a mask of pixels: select(mask=mask, frame=k)."
    elif mask.dtype.kind in "iu":
        cure = "For indices of Gaussians: Selection.of(model, [...])."
    raise invalid(
        "selection", expected=f"a Selection or mask of {num:,} Gaussians", got=f"{mask.dtype} {mask.shape}", cure=cure
    )


def split_mask(mask: Mask, counts: Sequence[int]) -> list[Mask]:
    """The masks of several parts, from a mask over all."""
    return np.split(mask, np.cumsum(counts)[:-1])


def select(
    model: VideoModel,
    *,
    mask: Masks | None = None,
    box: tuple[float, float, float, float] | None = None,
    polygon: Float[ArrayLike, "corners 2"] | None = None,
    color: tuple[float, float, float] | None = None,
    click: tuple[float, float] | None = None,
    moving: bool = False,
    times: tuple[float, float] | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    tolerance: float | None = None,
    alive: bool = False,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """The Gaussians that meet every criterion given: those of `by_mask`, `by_box`, `by_polygon`, `by_color`,
    `by_click`, `by_motion` and `by_time`, intersected.

    - `frame`, or `frames` = (first, stop), half-open: the frames of mask, box, polygon and click, *not* a limit in
      time. Without any of these, they are a criterion of their own: `by_time`. `times` always is one.
    - `tolerance`: of `color` and `click`, in Delta E; None: their defaults.
    - `moving`: `by_motion`, from all frames. `alive`: of `by_time`.
    - `threshold`: of mask, box, polygon and `moving`. `follow`: of mask, box and polygon.

    **Units:** pixels of the model's own size, x right, y down; times in [0, 1]; colors in [0, 1].

    **Example:** `select(model, box=(200, 80, 420, 260), frame=0, color=(0.8, 0.1, 0.1), tolerance=25)`.

    **Raises:** ValueError without any criterion, for options of a criterion not given, and as the functions.
    """
    criteria = list_criteria(
        mask=mask,
        box=box,
        polygon=polygon,
        color=color,
        click=click,
        moving=moving,
        times=times,
        frame=frame,
        frames=frames,
        tolerance=tolerance,
        alive=alive,
        threshold=threshold,
        follow=follow,
    )
    return functools.reduce(Selection.__and__, [function(model, **options) for function, options in criteria])


#: The criteria that each option of `select` belongs to.
_OPTIONS = {
    "frame": ("mask", "box", "polygon", "click", "frames"),
    "frames": ("mask", "box", "polygon", "frames"),
    "threshold": ("mask", "box", "polygon", "moving"),
    "follow": ("mask", "box", "polygon"),
    "tolerance": ("color", "click"),
    "alive": ("times", "frames"),
}


def list_criteria(**arguments: Any) -> list[tuple[Callable[..., Selection], dict[str, Any]]]:
    """The criteria among the arguments of `select`: functions such as `by_mask`, each with its arguments, no model.

    Raises ValueError as `select`, where that does not depend on the model.
    """
    defaults = {name: parameter.default for name, parameter in inspect.signature(select).parameters.items()}
    arguments = {name: bool(value) if isinstance(value, np.bool_) else value for name, value in arguments.items()}
    given = {name: value for name, value in arguments.items() if value is not defaults[name]}
    require(
        isinstance(given.get("moving", True), bool), "moving", expected="True or False", got=repr(given.get("moving"))
    )
    functions = {
        "mask": by_mask,
        "box": by_box,
        "polygon": by_polygon,
        "moving": by_motion,
        "color": by_color,
        "click": by_click,
        "times": by_time,
    }
    found = {name: {name: given[name]} for name in functions if name in given}
    if not found.keys() & {"mask", "box", "polygon", "click"} and given.keys() & {"frame", "frames"}:
        found["frames"] = {}  # a criterion of its own
    require(found, "select", expected="at least one criterion", got="none", cure="Selection.all(model) is everything.")
    for option in given.keys() & _OPTIONS.keys():
        users = [name for name in _OPTIONS[option] if name in found]
        require(
            users,
            option,
            expected=f"one of {', '.join(_OPTIONS[option])} with it",
            got=short_repr(given[option]),
            cure="For the frame of a click: frame=k." if "click" in found else "",
        )
        for name in users:
            found[name][option] = given[option]
    require(
        "click" not in found or "frame" in given,
        "frame",
        expected="the frame that was clicked in",
        got="none",
        cure="Give frame=k.",
    )
    found.get("moving", {}).pop("moving", None)
    return [(functions.get(name, by_time), options) for name, options in found.items()]


def contribution(
    model: VideoModel, mask: Masks, *, frame: int | None = None, frames: tuple[int, int] | None = None
) -> tuple[Float[np.ndarray, " num_gaussians"], Float[np.ndarray, " num_gaussians"]]:
    r"""Each Gaussian's contribution to the image inside a mask, and everywhere.

    $$
    \sum_k \sum_p m_k(p)\, w_{ik}(p), \qquad \sum_k \sum_p w_{ik}(p),
    \qquad w_{ik}(p) = \alpha_{ik}(p) \prod_{j < i} (1 - \alpha_{jk}(p))
    $$

    with alpha alone for compositing "sum". `mask`, `frame` and `frames` are `by_mask`'s; k runs over its frames.

    **Shapes:** two arrays (num_gaussians,), float64. **Units:** pixels of the model's own size, summed over frames.

    **Raises:** ValueError as `by_mask`. **Source:** the weights of eq:colorblending.
    """
    return sum_contributions(Contributions(model), region_from_mask(model, mask, frame, frames))[:2]


def by_mask(
    model: VideoModel,
    mask: Masks,
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """The Gaussians whose *rendered contribution* to the masked frames lies inside the mask, to at least `threshold`.

    - `mask`: bool (height, width) for `frame`, or for each of `frames`; (num_frames, height, width), one for each of
      `frames` (default: all); or {frame: mask}. Any size of the model's aspect; values in [0, 1] are fractions.
    - `follow`: Gaussians that the masked frames hardly show are labeled where they are visible, frame by frame outwards
      within the shot, as their neighbors of similar motion and color. False: only Gaussians visible in the masked
      frames are selected.
    - Gaussians visible in no frame are labeled by their position at their own m_t in the nearest frame: by its mask, or
      with `follow` by their labeled neighbors.

    One mask selects a whole object; a few masks are better, and one for each frame is best.

    **Units:** pixels of the masks' own size. **Raises:** ValueError for empty masks, other aspects, dtypes, frames.

    **Example:** `by_mask(model, clip.masks == 1)`, with `clip = datasets.davis(...)`.
    """
    return _select_region(model, region_from_mask(model, mask, frame, frames), threshold, follow)


def by_box(
    model: VideoModel,
    box: tuple[float, float, float, float],
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """The Gaussians inside the box (x0, y0, x1, y1) of `frame`, or of each of `frames` (default: all): see `by_mask`.

    **Units:** pixels of the model's own size, x right, y down; a pixel is inside if its center (at +0.5) is.

    **Example:** `by_box(model, (200, 80, 420, 260), frame=0)`. **Raises:** ValueError for a box without pixels.
    """
    return _select_region(model, region_from_box(model, box, frame, frames), threshold, follow)


def by_polygon(
    model: VideoModel,
    polygon: Float[ArrayLike, "corners 2"],
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """The Gaussians inside the polygon of corners (x, y), closed automatically; otherwise as `by_box`.

    **Shapes:** `polygon` (corners, 2), 3 corners at least. **Units:** pixels of the model's own size.

    **Example:** `by_polygon(model, [(10, 10), (60, 12), (30, 50)], frame=0)`. **Raises:** ValueError as `by_box`.
    """
    return _select_region(model, region_from_polygon(model, polygon, frame, frames), threshold, follow)


def by_motion(model: VideoModel, *, threshold: float = THRESHOLD) -> Selection:
    """The Gaussians of the moving object: those whose rendered contribution lies inside the masks that
    `find_moving_object` finds in the model's own images, to at least `threshold`.

    It is the largest object that moves against the background, in each shot. It takes about a second per frame. Shots
    without one raise a warning.

    **Example:** `edit(model).select(moving=True).vanish()`. **Raises:** `NothingMoves`, a ValueError, if nothing moves,
    or no Gaussian belongs to what does; and as `by_mask`.
    """
    check_model(model)
    if model.num_frames < LEAST_FRAMES:
        raise nothing_moves(f"a video of {LEAST_FRAMES} frames at least", model.num_frames)
    scale = min(1.0, SIDE / max(model.size))
    size = tuple(max(1, round(side * scale)) for side in model.size)
    masks = find_moving_object(np.stack(list(model.frames(size=size))))
    found = by_mask(model, masks, threshold=threshold)
    if not len(found):
        area = int(masks.sum((1, 2)).max())
        got = f"one that covers up to {area:,} of {masks[0].size:,} pixels of a frame, but to which no Gaussian belongs"
        cure = f"Lower the threshold, {threshold:g}, or select by a mask, a box or a click."
        raise nothing_moves("an object that has Gaussians of its own", got, cure)
    return found


def by_color(
    model: VideoModel, color: tuple[float, float, float], *, tolerance: float = COLOR_TOLERANCE, seen: bool = True
) -> Selection:
    """The Gaussians that look like `color`, red, green and blue in [0, 1], to within `tolerance`.

    With `seen`, a Gaussian's color is the image's where it is visible, averaged over frames by its weights: where many
    overlap, its own color may be anything. Its own is used without `seen`, and for Gaussians that are never visible.

    **Units:** tolerance in CIELAB Delta E (CIEDE2000): 1 is just noticeable, 10 a shade, 30 another color.

    **Example:** `by_color(model, (0.9, 0.2, 0.1), tolerance=25)`. **Raises:** ValueError for an invalid color.
    """
    wanted = check_color("color", color)
    check_within("tolerance", tolerance, "[0, inf)", "a number in [0, inf)")
    contributions = Contributions(model)
    own = np.maximum(0.5 + SH_C0 * np.asarray(model.splats.color_dc), 0)
    if seen:
        color, visible = average_seen_colors(contributions)
        own[visible] = color[visible]
    return Selection(color_difference(to_lab(own), to_lab(wanted[None])[0]) <= tolerance)


def by_time(
    model: VideoModel,
    times: tuple[float, float] | None = None,
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    alive: bool = False,
) -> Selection:
    """The Gaussians whose m_t lies in `times`, both ends included; with `alive` those rendered at any time in it,
    which reach up to 3.03 sigma_t from m_t.

    Instead of `times`, `frames` = (first, stop) or `frame`: half a frame more on either side; with `alive`, exactly
    from the time of the first to that of the last.

    **Units:** times in [0, 1]. **Example:** `by_time(model, frames=(0, 24))`.

    **Raises:** ValueError unless exactly one valid span is given.
    """
    require(
        (times is not None) + (frame is not None) + (frames is not None) == 1,
        "times, frames, frame",
        expected="one of them",
        got="several or none",
    )
    contributions = Contributions(model)
    if times is not None:
        start, stop = check_times(times)
    else:
        chosen, last = resolve_frames(model.num_frames, frame, frames), model.num_frames - 1
        margin = 0.0 if alive else 0.5
        ends = (chosen[0] - margin, chosen[-1] + margin)
        # A single frame covers all times.
        start, stop = np.interp(ends, np.arange(last + 1), contributions.times) if last or alive else (0.0, 1.0)
    if alive:
        return Selection((contributions.prepared.window[:, 0] < stop) & (start < contributions.prepared.window[:, 1]))
    own = contributions.own_times
    return Selection((start <= own) & (own <= stop))


def by_click(
    model: VideoModel, click: tuple[float, float], *, frame: int, tolerance: float = CLICK_TOLERANCE
) -> Selection:
    """The object at a click at the pixel (x, y) of `frame`, grown along its motion, and followed as by `by_mask`.

    The pixels of the object are those that look like the clicked one, to within `tolerance`, and are linked to it by
    such pixels, each of which moves as its neighbor does. A static background of one color has no boundary: intersect
    with a box.

    **Units:** `click` in pixels of the model's own size, x right, y down; tolerance in CIELAB Delta E, as `by_color`.

    **Example:** `by_click(model, (320, 140), frame=0, tolerance=25)`.

    **Raises:** ValueError for a click outside the frame, or where nothing is rendered.
    """
    check_model(model)
    point, (height, width) = np.asarray(click), model.size
    require(
        point.shape == (2,) and point.dtype.kind in "fiu" and ((point >= 0) & (point < [width, height])).all(),
        "click",
        expected=f"(x, y) in pixels of a {height}x{width} frame",
        got=click,
    )
    check_within("tolerance", tolerance, "[0, inf)", "a number in [0, inf)")
    k = resolve_frames(model.num_frames, frame, None)[0]
    mask = grow_from_pixel(Contributions(model), (int(point[1]), int(point[0])), k, tolerance)
    require(mask is not None, "click", expected="a pixel where something is rendered", got=f"{click} of frame {k}")
    return by_mask(model, mask, frame=k)


def matte(model: VideoModel, selection: Selection, t: float) -> Float32[np.ndarray, "height width"]:
    """The selection's fraction of each pixel at time t: its weights over those of all Gaussians; 0 without any.

    **Units:** t in [0, 1]: frame k is at `model.frame_times.times()[k]`. **Shapes:** (height, width), in [0, 1].

    **Example:** `matte(model, selection, 0.5) > 0.5`. **Raises:** ValueError for a selection of another model.
    """
    contributions, mask = _prepare(model, selection)
    check_time(t)
    return render_matte(contributions, mask, t)


def influence(model: VideoModel, selection: Selection, t: float) -> Bool[np.ndarray, "height width"]:
    """The pixels that the selection can change at time t: removing it leaves all others the same.

    They are those where a Gaussian of it, visible or occluded, has an alpha above `RenderOptions.alpha_cutoff`.
    Shapes, units and errors as `matte`'s. Example: `influence(model, ball, 0.5).sum()`  pixels.
    """
    contributions, mask = _prepare(model, selection)
    check_time(t)
    splats = contributions.at(t).splats
    chosen = mask[splats.alive]
    white, black = np.ones((int(chosen.sum()), 3), np.float32), np.zeros(3, np.float32)
    # In a sum nothing is occluded.
    leaves = splats.mean[chosen], splats.factor[chosen], splats.opacity[chosen], white, black
    return cpu.forward(*leaves, model.size, compositing="sum", options=model.options).image[0] > 0


def _prepare(model: VideoModel, selection: Selection) -> tuple[Contributions, Bool[np.ndarray, " num_gaussians"]]:
    """The model's contributions, and the mask of a selection checked to fit the model."""
    contributions = Contributions(model)
    require(
        isinstance(selection, Selection),
        "selection",
        expected="a Selection",
        got=type(selection).__name__,
        cure="The order is (model, selection, t); Selection(mask) makes one of a mask.",
    )
    return contributions, (Selection.none(model) | selection).mask


def _select_region(model: VideoModel, region: Region, threshold: float, follow: bool) -> Selection:
    """The Gaussians with at least `threshold` of their contribution to the region's frames inside it, see `by_mask`."""
    check_within("threshold", threshold, "(0, 1]", "a number in (0, 1]")
    contributions = Contributions(model)
    inside, total, best = sum_contributions(contributions, region)
    direct = np.where(inside >= threshold * total, IN, OUT).astype(np.int8)
    direct[total == 0] = UNKNOWN
    label = direct
    if follow:
        overall = best.copy()
        for k in set(range(model.num_frames)) - set(region.frames):
            frame = contributions.at_frame(k)
            overall[frame.alive] = np.maximum(overall[frame.alive], frame.total)
        clear = np.where(best >= CLEAR * overall, direct, UNKNOWN)
        label = propagate_labels(contributions, clear, region.frames, overall)
        label = np.where(label == UNKNOWN, direct, label)
    label = _label_by_position(contributions, region, label)
    if follow:
        label = settle_labels(contributions, label, region.frames)
    return Selection(label == IN)


def _label_by_position(
    contributions: Contributions, region: Region, label: Int8[np.ndarray, " num_gaussians"]
) -> Int8[np.ndarray, " num_gaussians"]:
    """Decide the unknown by their centers at their own m_t, if the nearest frame has a mask."""
    label, unknown = label.copy(), np.flatnonzero(label == UNKNOWN)
    nearest = contributions.nearest_frame(unknown)
    for k in set(region.frames) & set(nearest.tolist()):
        own = unknown[nearest == k]
        column, row = np.floor(contributions.own_centers(own)).astype(np.int64).T
        height, width = contributions.size
        visible = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        fraction = region.at(k)[row.clip(0, height - 1), column.clip(0, width - 1)]
        label[own] = np.where(visible & (fraction >= 0.5), IN, OUT)
    return label
