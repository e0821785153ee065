"""Selection criteria of a video in segments: evaluated per segment, and propagated over the frames that they share."""

import dataclasses
import operator
import warnings
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool

from foldgauss._runtime.checks import require
from foldgauss.video.editing.chain import Edit
from foldgauss.video.editing.timing import frame_times_of
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion.moving_object import NothingMoves
from foldgauss.video.segmented.segmented_video import Segment
from foldgauss.video.selection.contributions import Contributions, render_matte
from foldgauss.video.selection.regions import (
    check_times,
    region_from_box,
    region_from_mask,
    region_from_polygon,
    resolve_frames,
)
from foldgauss.video.selection.selectors import (
    Selection,
    by_box,
    by_click,
    by_color,
    by_mask,
    by_motion,
    by_polygon,
    by_time,
)

#: A pixel of a shared frame shows an object if at least this fraction of its color is the object's contribution.
_MIN_CONTRIBUTION = 0.5

#: Selectors that are evaluated on each segment on its own.
_OF_EACH = (by_color, by_motion, by_time)

#: A selector such as `by_mask`, and its arguments.
Criterion = tuple[Callable[..., Selection], dict[str, Any]]
_Image = Bool[np.ndarray, "height width"]


@dataclasses.dataclass(frozen=True, eq=False)
class CriteriaEvaluator:
    """Evaluates criteria on the edited segments of a clip, on all layers or on layer number `layer` only.

    `stand_in`: any model with the clip's size and number of frames, to check arguments. `replay(number)` loads and
    edits a segment, `select_none(number)` is its empty selection.
    """

    segments: tuple[Segment, ...]
    stand_in: VideoModel
    replay: Callable[[int], Edit]
    select_none: Callable[[int], Selection]
    layer: int | None

    def evaluate(self, criteria: list[Criterion]) -> list[Selection]:
        """The intersection of all criteria, by segment: regions first, so that fewer segments are evaluated."""
        found: list[Selection] | None = None
        for function, arguments in sorted(criteria, key=lambda criterion: criterion[0] in _OF_EACH):
            if function in _OF_EACH:
                selection = self._evaluate_each(function, arguments, found)
            else:
                selection = _RegionCriterion(self, function, arguments).evaluate()
            found = selection if found is None else list(map(operator.and_, found, selection))
        return found

    def evaluate_segment(self, one: Edit, function: Callable[[VideoModel, int], Selection]) -> Selection:
        """`function(model, layer number)` of the layers of one segment."""
        numbers = one._layer_numbers(self.layer)
        masks = [
            function(layer.model, number).mask if number in numbers else np.zeros(layer.num_gaussians, bool)
            for number, layer in enumerate(one._video.layers)
        ]
        return Selection(np.concatenate(masks))

    def _evaluate_each(
        self, function: Callable[..., Selection], arguments: dict[str, Any], within: list[Selection] | None
    ) -> list[Selection]:
        """By color, motion or time, on each segment that is not yet known to be without selected Gaussians.

        Raises `NothingMoves` if nothing moves in any of them.
        """
        positions = self._positions(**arguments) if function is by_time else None
        first, last = positions or (0, self.stand_in.num_frames)
        parts, motionless = [], {}
        for number, segment in enumerate(self.segments):
            if within is not None and not len(within[number]):
                parts.append(within[number])
            elif first > segment.stop - 1 or segment.first > last:  # at other times
                parts.append(self.select_none(number))
            else:
                one = self.replay(number)
                own = arguments if positions is None else _own_arguments(positions, segment, one, **arguments)
                try:
                    parts.append(self.evaluate_segment(one, lambda model, _, own=own: function(model, **own)))
                except NothingMoves as error:
                    motionless[number] = error
                    parts.append(self.select_none(number))
        if motionless and len(motionless) == len(parts):
            raise motionless[min(motionless)]
        for number, error in motionless.items():
            first = self.segments[number].first
            warnings.warn(f"Segment {number}, from frame {first} on: {error}", stacklevel=2)
        return parts

    def _positions(
        self, times: Any = None, frame: Any = None, frames: Any = None, alive: bool = False
    ) -> tuple[float, float]:
        """The first and the last frame position of the arguments of `by_time`."""
        if times is not None:
            return tuple(t * (self.stand_in.num_frames - 1) for t in check_times(times))
        chosen, margin = resolve_frames(self.stand_in.num_frames, frame, frames), 0.0 if alive else 0.5
        return chosen[0] - margin, chosen[-1] + margin


def _own_arguments(
    positions: tuple[float, float], segment: Segment, one: Edit, *, alive: bool = False, **_: Any
) -> dict[str, Any]:
    """The arguments of `by_time` in a segment's own time; a single frame covers all times."""
    knots = [-0.5, *range(segment.num_frames), segment.num_frames - 0.5]
    own_times = np.interp(np.subtract(positions, segment.first), knots, [0, *frame_times_of(one._video), 1])
    return {"times": own_times, "alive": alive}


#: How the regions of criteria are made, and the argument that describes them.
_REGIONS = {
    by_mask: (region_from_mask, "mask"),
    by_box: (region_from_box, "box"),
    by_polygon: (region_from_polygon, "polygon"),
}


class _RegionCriterion:
    """A criterion that names frames: evaluated on the segments of these, propagated over shared frames to others."""

    def __init__(self, context: CriteriaEvaluator, function: Callable[..., Selection], arguments: dict[str, Any]):
        self._context, self._function, self._segments = context, function, context.segments
        self._options = dict(arguments)
        where = {name: self._options.pop(name, None) for name in ("frame", "frames")}
        if function is by_click:
            self._frames = tuple(resolve_frames(context.stand_in.num_frames, **where))
        else:
            make, name = _REGIONS[function]
            self._region = make(context.stand_in, self._options.pop(name), **where)
            self._frames = self._region.frames
        #: By segment: the frames named that it has.
        self._named = [[k for k in self._frames if one.first <= k < one.stop] for one in self._segments]
        #: By segment and layer: masks of what the neighbors show, by frames of the clip.
        self._masks: dict[int, list[dict[int, _Image]]] = {}

    def evaluate(self) -> list[Selection]:
        """The selection in each segment, breadth first from those that have the frames named."""
        numbers = range(len(self._segments))
        named = [number for number in numbers if self._named[number]]
        waiting, reached, found = deque(named), set(named), {}
        while waiting:
            number = waiting.popleft()
            one = self._context.replay(number)
            found[number] = self._evaluate_named(one, number) if number in named else self._propagate(one, number)
            for other in sorted({number - 1, number + 1} & set(numbers) - found.keys() - set(named)):
                if not self._options.get("follow", True):
                    continue
                if len(found[number]) or number in named:  # an empty selection is information for the neighbor, too
                    self._render_masks(one, found[number], number, other)
                if len(found[number]) and other not in reached:
                    reached.add(other)
                    waiting.append(other)
        return [found[k] if k in found else self._context.select_none(k) for k in numbers]

    def _evaluate_named(self, one: Edit, number: int) -> Selection:
        """In a segment that has some of the frames named."""
        first, frames = self._segments[number].first, self._named[number]
        if self._function is by_click:
            options = self._options | {"frame": frames[0] - first}
            return self._context.evaluate_segment(one, lambda model, _: by_click(model, **options))
        masks = {k - first: np.clip(self._region.at(k), 0.0, 1.0) for k in frames}  # resizing overshoots
        return self._select_masks(one, lambda layer: masks, self._options)

    def _select_masks(
        self, one: Edit, masks_of: Callable[[int], dict[int, np.ndarray]], options: dict[str, Any]
    ) -> Selection:
        """By masks of each layer, by frames of the segment; nothing where all are empty."""

        def select(model: VideoModel, layer: int) -> Selection:
            masks = masks_of(layer)
            if not any(mask.any() for mask in masks.values()):
                return Selection.none(model)
            return by_mask(model, masks, **options)

        return self._context.evaluate_segment(one, select)

    def _render_masks(self, one: Edit, found: Selection, number: int, other: int) -> None:
        """Render the selection of a segment as masks of the frames that it shares with a neighbor."""
        here, there = self._segments[number], self._segments[other]
        layers, selected = one._video.layers, dataclasses.replace(one, selection=found)._masks()
        by_layer = self._masks.setdefault(other, [{} for _ in layers])
        for layer, mask, images in zip(layers, selected, by_layer, strict=False):
            contributions = Contributions(layer.model) if mask.any() else None
            for k in range(max(here.first, there.first), min(here.stop, there.stop)):
                if contributions is None:
                    images[k] = np.zeros(layer.model.size, bool)
                else:
                    own_time = float(frame_times_of(one._video)[k - here.first])
                    images[k] = render_matte(contributions, mask, own_time) >= _MIN_CONTRIBUTION

    def _propagate(self, one: Edit, number: int) -> Selection:
        """In a segment with none of the frames named: by the masks that its neighbors show."""
        first, by_layer = self._segments[number].first, self._masks[number]
        require(
            len(by_layer) == len(one._video.layers),
            f"segments[{number}]",
            expected=f"{len(by_layer)} layers, as its neighbor has",
            got=len(one._video.layers),
        )
        options = {name: value for name, value in self._options.items() if name == "threshold"}
        return self._select_masks(
            one, lambda layer: {k - first: image for k, image in by_layer[layer].items()}, options
        )
