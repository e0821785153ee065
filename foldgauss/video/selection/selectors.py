"""Which Gaussians: sets of them, and the ways to point at what is seen."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Float32, Int, Int8

from foldgauss._runtime.checks import invalid, is_integer
from foldgauss.video.models.splats import SH_C0
from foldgauss.video.models.video_model import VideoModel, check_model, check_time
from foldgauss.video.selection.contributions import (
    Contributions,
    best_frames,
    contributions,
    drawn_share,
    reached,
    seen_colors,
)
from foldgauss.video.selection.regions import (
    Masks,
    Region,
    box_region,
    checked_share,
    chosen_frames,
    mask_region,
    polygon_region,
)
from foldgauss.video.selection.tracking import CLEAR, IN, OUT, UNKNOWN, difference, followed, grown, lab, settled

#: Share of what a Gaussian adds that has to lie inside a mask.
THRESHOLD = 0.5
#: Delta E: a shade for all of the clip; and, where a chain of neighbours holds it together, more.
COLOR_TOLERANCE, CLICK_TOLERANCE = 10.0, 15.0


@dataclasses.dataclass(frozen=True, eq=False)
class Selection:
    """A set of Gaussians of one model, with the operations of sets: `|`, `&`, `-`, `^`, `~`, `==`, `len`, `in`.

    **Shapes:** `mask` is bool (num_gaussians,), in the model's array order; it is copied and cannot be written to.

    **Example:** `moving = by_box(model, (10, 10, 50, 40), frame=0) - by_color(model, (0, 1, 0), tolerance=20)`.

    **Raises:** ValueError for a mask of another kind, and for sets of models with different numbers of Gaussians.
    """

    mask: Bool[np.ndarray, "num_gaussians"]

    def __post_init__(self) -> None:
        mask = np.array(self.mask)
        if mask.ndim != 1 or mask.dtype != bool:
            cure = "For numbers of Gaussians use Selection.of(model, indices)."
            raise invalid("mask", expected="bool (num_gaussians,)", got=f"{mask.dtype} {mask.shape}", cure=cure)
        mask.setflags(write=False)
        object.__setattr__(self, "mask", mask)

    @classmethod
    def of(cls, model: VideoModel, indices: Int[np.ndarray, " num"]) -> "Selection":
        """The Gaussians of these numbers. Raises ValueError for numbers that the model has not."""
        check_model(model)
        indices, num = np.asarray(indices), model.splats.num_gaussians
        if indices.size == 0:
            return cls.none(model)
        if indices.ndim != 1 or indices.dtype.kind not in "iu" or indices.min() < 0 or indices.max() >= num:
            raise invalid("indices", expected=f"whole numbers in [0, {num})", got=indices)
        mask = np.zeros(num, bool)
        mask[indices] = True
        return cls(mask)

    @classmethod
    def all(cls, model: VideoModel) -> "Selection":
        """Every Gaussian."""
        check_model(model)
        return cls(np.ones(model.splats.num_gaussians, bool))

    @classmethod
    def none(cls, model: VideoModel) -> "Selection":
        """No Gaussian."""
        check_model(model)
        return cls(np.zeros(model.splats.num_gaussians, bool))

    @property
    def indices(self) -> Int[np.ndarray, " num_selected"]:
        """Numbers of the selected Gaussians, in array order."""
        return np.flatnonzero(self.mask)

    @property
    def num_gaussians(self) -> int:
        """Gaussians of the model, selected or not."""
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
        if other.num_gaussians != self.num_gaussians:
            expected = f"a selection of {self.num_gaussians:,} Gaussians"
            raise invalid(
                "selection", expected=expected, got=f"one of {other.num_gaussians:,}", cure="Is it another model's?"
            )
        return other.mask


def select(
    model: VideoModel,
    *,
    mask: Masks | None = None,
    box: tuple[float, float, float, float] | None = None,
    polygon: Float[ArrayLike, "corners 2"] | None = None,
    color: tuple[float, float, float] | None = None,
    click: tuple[float, float] | None = None,
    times: tuple[float, float] | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    tolerance: float | None = None,
    alive: bool = False,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """The Gaussians that meet every criterion given: those of `by_mask`, `by_box`, `by_polygon`, `by_color`,
    `by_click` and `by_time`, intersected.

    - `frame`, or `frames` = (first, stop), half-open: those on which mask, box, polygon and click are looked at, and
      *not* a limit in time. With none of these they are one: `by_time`, as `times` always is.
    - `tolerance`: of `color` and `click`, in Delta E; None: their own.
    - `alive`: of `by_time`. `threshold`, `follow`: of mask, box and polygon.

    **Units:** pixels of the model's own size, x right, y down; times in [0, 1]; colours in [0, 1].

    **Example:** `select(model, box=(200, 80, 420, 260), frame=0, color=(0.8, 0.1, 0.1), tolerance=25)`.

    **Raises:** ValueError without any criterion, for options of a criterion that is not there, and as the functions.
    """
    given = {"mask": mask, "box": box, "polygon": polygon, "color": color, "click": click, "times": times}
    where = {"frame": frame, "frames": frames, "tolerance": tolerance}
    asked = questions(**given, **where, alive=alive, threshold=threshold, follow=follow)
    return functools.reduce(Selection.__and__, [function(model, **named) for function, named in asked])


def questions(
    *,
    mask: Masks | None = None,
    box: tuple[float, float, float, float] | None = None,
    polygon: Float[ArrayLike, "corners 2"] | None = None,
    color: tuple[float, float, float] | None = None,
    click: tuple[float, float] | None = None,
    times: tuple[float, float] | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    tolerance: float | None = None,
    alive: bool = False,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> list[tuple[Callable[..., Selection], dict[str, Any]]]:
    """What `select` asks a model, whose answers are intersected: functions such as `by_mask`, and their arguments.

    Raises ValueError as `select` for what needs no model to be told.
    """
    where = {"frame": frame, "frames": frames}
    own_tolerance = {} if tolerance is None else {"tolerance": tolerance}
    found: list[tuple[Callable[..., Selection], dict[str, Any]]] = []
    for name, value, function in (("mask", mask, by_mask), ("box", box, by_box), ("polygon", polygon, by_polygon)):
        if value is not None:
            found.append((function, {name: value, **where, "threshold": threshold, "follow": follow}))
    placed = bool(found) or click is not None
    regional, timed = bool(found), times is not None or not (placed or (frame is None and frames is None))
    for name, given, wanted in (
        ("threshold", threshold != THRESHOLD and not regional, "a mask, box or polygon with it"),
        ("follow", not follow and not regional, "a mask, box or polygon with it"),
        ("alive", alive and not timed, "times or frames with it"),
        ("frames", click is not None and frames is not None, "frame, the one that was clicked in"),
    ):
        if given:
            raise invalid(name, expected=wanted, got="none")
    if tolerance is not None and color is None and click is None:
        raise invalid("tolerance", expected="color or click with it", got="neither")
    if color is not None:
        found.append((by_color, {"color": color, **own_tolerance}))
    if click is not None:
        if frame is None:
            raise invalid("frame", expected="the frame that was clicked in", got="none", cure="Give frame=k.")
        found.append((by_click, {"click": click, "frame": frame, **own_tolerance}))
    if times is not None:
        found.append((by_time, {"times": times, "alive": alive}))
    if not placed and (frame is not None or frames is not None):
        found.append((by_time, {**where, "alive": alive}))
    if not found:
        cure = "Selection.all(model) is everything."
        raise invalid("select", expected="at least one criterion", got="none", cure=cure)
    return found


def contribution(
    model: VideoModel, mask: Masks, *, frame: int | None = None, frames: tuple[int, int] | None = None
) -> tuple[Float[np.ndarray, " num_gaussians"], Float[np.ndarray, " num_gaussians"]]:
    r"""What each Gaussian adds to the picture inside a mask, and everywhere.

    $$
    \sum_k \sum_p m_k(p)\, w_{ik}(p), \qquad \sum_k \sum_p w_{ik}(p),
    \qquad w_{ik}(p) = \alpha_{ik}(p) \prod_{j < i} (1 - \alpha_{jk}(p))
    $$

    with alpha alone for compositing "sum". `mask`, `frame` and `frames` are `by_mask`'s; k runs over its frames.

    **Shapes:** two arrays (num_gaussians,), float64. **Units:** pixels of the model's own size, summed over frames.

    **Raises:** ValueError as `by_mask`. **Source:** the weights of eq:colorblending, as gradients of the colours.
    """
    return contributions(Contributions(model), mask_region(model, mask, frame, frames))[:2]


def by_mask(
    model: VideoModel,
    mask: Masks,
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """The Gaussians of what a mask shows, by their *rendered contribution*: those that add at least `threshold` of all
    they add to the masked frames inside the mask.

    - `mask`: bool (height, width) for `frame`, or for each of `frames`; (num_frames, height, width), one for each of
      `frames` (default: all); or {frame: mask}. Of any size of the model's aspect; numbers in [0, 1] are shares.
    - `follow`: Gaussians that show too little of themselves on the masked frames (not alive yet, or hidden) are decided
      where they are seen: frame by frame outwards from the masked ones, within the shot, they join the known ones
      around them that move alike and look alike. False: nobody is selected that the masked frames do not show.
    - Those seen in no frame at all, as they stand behind others or live between two frames, go by their place at their
      own time, in the frame next to it: by its mask, or with `follow` by the known ones around.

    So a whole object comes with one mask, better with a few, best with one on each frame.

    **Units:** pixels of the masks' own size. **Raises:** ValueError for empty masks, other aspects, dtypes, frames.

    **Example:** `by_mask(model, clip.masks == 1)`, with `clip = datasets.davis(...)`.
    """
    return _inside(model, mask_region(model, mask, frame, frames), threshold, follow)


def by_box(
    model: VideoModel,
    box: tuple[float, float, float, float],
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """What stands in the box (x0, y0, x1, y1) of `frame`, or all along `frames` (default: all): see `by_mask`.

    **Units:** pixels of the model's own size, x right, y down; a pixel is inside if its centre (at +0.5) is.

    **Example:** `by_box(model, (200, 80, 420, 260), frame=0)`. **Raises:** ValueError for a box without pixels.
    """
    return _inside(model, box_region(model, box, frame, frames), threshold, follow)


def by_polygon(
    model: VideoModel,
    polygon: Float[ArrayLike, "corners 2"],
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    threshold: float = THRESHOLD,
    follow: bool = True,
) -> Selection:
    """What stands in the polygon of corners (x, y), closed by itself; else as `by_box`.

    **Shapes:** `polygon` (corners, 2), 3 corners at least. **Units:** pixels of the model's own size.

    **Example:** `by_polygon(model, [(10, 10), (60, 12), (30, 50)], frame=0)`. **Raises:** ValueError as `by_box`.
    """
    return _inside(model, polygon_region(model, polygon, frame, frames), threshold, follow)


def by_color(
    model: VideoModel, color: tuple[float, float, float], *, tolerance: float = COLOR_TOLERANCE, seen: bool = True
) -> Selection:
    """What looks like `color`, red, green and blue in [0, 1], to within `tolerance`.

    With `seen` a Gaussian's colour is the picture's where it is seen, averaged over frames by its weights: where many
    overlap, single ones have any colour. Without, and for those that are never seen, its own.

    **Units:** tolerance in CIELAB Delta E (CIEDE2000): 1 is just noticeable, 10 a shade, 30 another colour.

    **Example:** `by_color(model, (0.9, 0.2, 0.1), tolerance=25)`. **Raises:** ValueError for what is no colour.
    """
    wanted = np.asarray(color)
    if wanted.shape != (3,) or wanted.dtype.kind not in "fiu" or not ((wanted >= 0) & (wanted <= 1)).all():
        raise invalid("color", expected="red, green and blue in [0, 1]", got=color)
    tolerance = checked_share("tolerance", tolerance, "[0, inf)")
    lit = Contributions(model)
    own = np.maximum(0.5 + SH_C0 * np.asarray(model.splats.color_dc), 0)
    if seen:
        looks, shown = seen_colors(lit)
        own[shown] = looks[shown]
    return Selection(difference(lab(own), lab(wanted[None])[0]) <= tolerance)


def by_time(
    model: VideoModel,
    times: tuple[float, float] | None = None,
    *,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    alive: bool = False,
) -> Selection:
    """The Gaussians whose own time m_t lies in `times`, both ends included; or with `alive` those drawn at any time
    of it, which is up to 3.03 sigma_t from m_t.

    Instead of `times`, `frames` = (first, stop) or `frame`: half a frame more to either side; with `alive`, exactly
    from the first one's time to the last one's.

    **Units:** times in [0, 1]. **Example:** `by_time(model, frames=(0, 24))`.

    **Raises:** ValueError unless one span is given, and for one that is none.
    """
    if (times is not None) + (frame is not None) + (frames is not None) != 1:
        raise invalid("times, frames, frame", expected="one of them", got="several or none")
    lit = Contributions(model)
    start, stop = _span(lit, times, frame, frames, widened=not alive)
    if alive:
        return Selection((lit.window[:, 0] < stop) & (start < lit.window[:, 1]))
    own = lit.own_times
    return Selection((start <= own) & (own <= stop))


def by_click(
    model: VideoModel, click: tuple[float, float], *, frame: int, tolerance: float = CLICK_TOLERANCE
) -> Selection:
    """What a click points at: grown from the greatest contributor at the pixel (x, y) of `frame`, along its motion.

    A Gaussian is in if it *looks* like the pixel, to within `tolerance`, and a chain of such neighbours leads to it
    that touch and move alike in most of the frames in which they touch. So the set goes on through time, up to the cuts
    of the shot, and ends where another colour or another motion begins: what is of one colour and at rest all over the
    frame is told apart by neither, so intersect it with a box. Gaussians that are seen in none of the frames looked at
    (48 at most) are left out.

    **Units:** `click` in pixels of the model's own size, x right, y down; tolerance in CIELAB Delta E, as `by_color`.

    **Example:** `by_click(model, (320, 140), frame=0, tolerance=25)`.

    **Raises:** ValueError for a click beyond the frame, or where nothing is drawn.
    """
    point, (height, width) = np.asarray(click), model.size
    if point.shape != (2,) or point.dtype.kind not in "fiu" or not ((point >= 0) & (point < [width, height])).all():
        raise invalid("click", expected=f"(x, y) in pixels of a {height}x{width} frame", got=click)
    tolerance = checked_share("tolerance", tolerance, "[0, inf)")
    k = chosen_frames(model, frame, None)[0]
    found = grown(Contributions(model), (int(point[1]), int(point[0])), k, tolerance)
    if found is None:
        raise invalid("click", expected="a place where something is drawn", got=f"{click} of frame {k}")
    return Selection(found)


def matte(model: VideoModel, selection: Selection, t: float) -> Float32[np.ndarray, "height width"]:
    """The selection's share in each pixel at time t: its weights over those of all Gaussians; 0 where nothing is.

    **Units:** t in [0, 1]: frame k is at `model.frame_times.times()[k]`. **Shapes:** (height, width), in [0, 1].

    **Example:** `matte(model, selection, 0.5) > 0.5`. **Raises:** ValueError for a selection of another model.
    """
    lit, mask = _known(model, selection)
    check_time(t)
    return drawn_share(lit, mask, t)


def influence(model: VideoModel, selection: Selection, t: float) -> Bool[np.ndarray, "height width"]:
    """The pixels that the selection reaches at time t, seen or hidden: without it all others are the same.

    Reached is where a Gaussian's alpha is not cut off (`RenderOptions.alpha_cutoff`). Shapes, units and errors as
    `matte`'s. Example: `influence(model, ball, 0.5).sum()`  pixels.
    """
    lit, mask = _known(model, selection)
    check_time(t)
    return reached(lit, mask, t)


def _known(model: VideoModel, selection: Selection) -> tuple[Contributions, Bool[np.ndarray, " num_gaussians"]]:
    """The model, ready to be asked, and the mask of a selection that fits it."""
    lit = Contributions(model)
    if not isinstance(selection, Selection):
        cure = "The order is (model, selection, t); Selection(mask) makes one of a mask."
        raise invalid("selection", expected="a Selection", got=type(selection).__name__, cure=cure)
    return lit, (Selection.none(model) | selection).mask


def _inside(model: VideoModel, region: Region, threshold: float, follow: bool) -> Selection:
    """Those with at least `threshold` of what they add to the region's frames in it; see `by_mask`."""
    threshold, lit = checked_share("threshold", threshold), Contributions(model)
    inside, total, best = contributions(lit, region)
    by_share = np.where(inside >= threshold * total, IN, OUT).astype(np.int8)
    by_share[total == 0] = UNKNOWN
    label = by_share
    if follow:
        overall = best_frames(lit, set(range(model.num_frames)) - set(region.frames), best)
        label = followed(lit, np.where(best >= CLEAR * overall, by_share, UNKNOWN), region.frames, overall)
        label = np.where(label == UNKNOWN, by_share, label)
    label = _by_place(lit, region, label)
    if follow:
        label = settled(lit, label, region.frames)
    return Selection(label == IN)


def _by_place(
    lit: Contributions, region: Region, label: Int8[np.ndarray, " num_gaussians"]
) -> Int8[np.ndarray, " num_gaussians"]:
    """Decide the unknown by their centres at their own time, where the frame next to it has a mask."""
    label, unknown = label.copy(), np.flatnonzero(label == UNKNOWN)
    home = lit.nearest_frame(unknown)
    for k in set(region.frames) & set(home.tolist()):
        own = unknown[home == k]
        column, row = np.floor(lit.own_place(own)).astype(np.int64).T
        height, width = lit.size
        there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        share = region.at(k)[row.clip(0, height - 1), column.clip(0, width - 1)]
        label[own] = np.where(there & (share >= 0.5), IN, OUT)
    return label


def _span(
    lit: Contributions,
    times: tuple[float, float] | None,
    frame: int | None,
    frames: tuple[int, int] | None,
    *,
    widened: bool,
) -> tuple[float, float]:
    """The span of time that is meant, from first to last; frames `widened` by half a frame to either side."""
    if times is None:
        chosen = chosen_frames(lit.model, frame, frames)
        if widened and len(lit.times) == 1:
            return 0.0, 1.0  # one frame alone lasts all the time
        ends = np.array([chosen[0], chosen[-1]]) + (np.array([-0.5, 0.5]) if widened else 0)
        return tuple(np.interp(ends, np.arange(len(lit.times)), lit.times))
    pair = np.asarray(times)
    if pair.shape != (2,) or pair.dtype.kind not in "fiu" or not 0 <= pair[0] <= pair[1] <= 1:
        raise invalid("times", expected="(start, stop) with 0 <= start <= stop <= 1", got=times)
    return float(pair[0]), float(pair[1])
