"""Which Gaussians: sets of them, and the ways to point at what is seen."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from foldgauss._checks import invalid
from foldgauss.video.model import VideoModel


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
    def of(cls, model: VideoModel, indices: Int[np.ndarray, "num"]) -> "Selection":
        """The Gaussians of these numbers. Raises ValueError for numbers that the model has not."""
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
        return cls(np.ones(model.splats.num_gaussians, bool))

    @classmethod
    def none(cls, model: VideoModel) -> "Selection":
        """No Gaussian."""
        return cls(np.zeros(model.splats.num_gaussians, bool))

    @property
    def indices(self) -> Int[np.ndarray, "num_selected"]:
        """Numbers of the selected Gaussians, in array order."""
        return np.flatnonzero(self.mask)

    @property
    def num_gaussians(self) -> int:
        """Gaussians of the model, selected or not."""
        return len(self.mask)

    def __len__(self) -> int:
        return int(self.mask.sum())

    def __contains__(self, index: int) -> bool:
        return bool(self.mask[index])

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
            raise TypeError(f"expected a Selection, got {type(other).__name__}")
        if other.num_gaussians != self.num_gaussians:
            expected = f"a selection of {self.num_gaussians:,} Gaussians"
            raise invalid(
                "selection", expected=expected, got=f"one of {other.num_gaussians:,}", cure="Is it another model's?"
            )
        return other.mask


Masks = Bool[np.ndarray, "height width"] | Bool[np.ndarray, "num_frames height width"] | Mapping[int, np.ndarray]


def select(
    model: VideoModel,
    *,
    mask: Masks | None = None,
    box: tuple[float, float, float, float] | None = None,
    polygon: Any = None,
    color: tuple[float, float, float] | None = None,
    click: tuple[float, float] | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    times: tuple[float, float] | None = None,
    tolerance: float | None = None,
    threshold: float = 0.5,
    follow: bool = True,
) -> Selection:
    """The Gaussians that meet every criterion given."""
    raise NotImplementedError


def by_mask(model, mask, *, frame=None, frames=None, threshold=0.5, follow=True) -> Selection:
    raise NotImplementedError


def by_box(model, box, *, frame=None, frames=None, threshold=0.5, follow=True) -> Selection:
    raise NotImplementedError


def by_polygon(model, polygon, *, frame=None, frames=None, threshold=0.5, follow=True) -> Selection:
    raise NotImplementedError


def by_color(model, color, *, tolerance=10.0) -> Selection:
    raise NotImplementedError


def by_time(model, times=None, *, frames=None, alive=False) -> Selection:
    raise NotImplementedError


def by_click(model, click, *, frame, tolerance=20.0) -> Selection:
    raise NotImplementedError
