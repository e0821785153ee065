"""Selections of Gaussians of a video in segments: one `Selection` for each segment."""

import dataclasses
import operator
from collections.abc import Callable

from foldgauss._runtime.checks import invalid, short_repr
from foldgauss.video.selection.selectors import Selection


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentedSelection:
    """A set of Gaussians of a `SegmentedVideo`, one `Selection` for each segment, with the set operations of those.

    `edit(video).select(...).selection` is one.

    **Example:** `edit(video).select(ball - shadow).vanish()`.

    **Raises:** ValueError for parts that are no selections, and for sets of videos with other segments.
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
        """The number of Gaussians of all segments, selected or not."""
        return sum(part.num_gaussians for part in self.parts)

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def __or__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._combine(other, operator.or_)

    def __and__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._combine(other, operator.and_)

    def __sub__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._combine(other, operator.sub)

    def __xor__(self, other: "SegmentedSelection") -> "SegmentedSelection":
        return self._combine(other, operator.xor)

    def __invert__(self) -> "SegmentedSelection":
        return SegmentedSelection(tuple(~part for part in self.parts))

    def __eq__(self, other: object) -> bool:
        return self.parts == other.parts if isinstance(other, SegmentedSelection) else NotImplemented

    def __repr__(self) -> str:
        return f"SegmentedSelection({len(self):,} of {self.num_gaussians:,} in {len(self.parts)} segments)"

    def check_segments(self, num: int) -> None:
        """Raise ValueError unless it is of `num` segments."""
        if len(self.parts) != num:
            expected, got = f"a selection in {num} segments", f"one in {len(self.parts)}"
            raise invalid("selection", expected=expected, got=got, cure="Is it another video's?")

    def _combine(self, other: "SegmentedSelection", operation: Callable[[Selection, Selection], Selection]):
        if not isinstance(other, SegmentedSelection):
            raise TypeError(f"expected a SegmentedSelection, got {type(other).__name__}.")
        other.check_segments(len(self.parts))
        return SegmentedSelection(tuple(map(operation, self.parts, other.parts)))
