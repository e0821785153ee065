"""Origins: which Gaussians of the start of a chain of edits the current ones are, or are copies of."""

import dataclasses
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from foldgauss._runtime.checks import invalid
from foldgauss.video.selection.selectors import Selection

Mask = Bool[np.ndarray, "num"]


@dataclasses.dataclass(frozen=True, eq=False)
class Origins:
    """By layer: the number of Gaussians at the start, and for each current Gaussian the index of its original then."""

    counts: tuple[int, ...]
    sources: tuple[Int[np.ndarray, " num"], ...]

    @classmethod
    def from_counts(cls, counts: Sequence[int]) -> "Origins":
        """The start of a chain."""
        return cls(tuple(counts), tuple(map(np.arange, counts)))

    def gather(self, sources: Sequence[Int[np.ndarray, " num"]]) -> "Origins":
        """After the current Gaussians were gathered from the indices `sources`, by layer."""
        gathered = (old[new] for old, new in zip(self.sources, sources, strict=True))
        return dataclasses.replace(self, sources=tuple(gathered))

    def select_originals(self, selection: Selection | Mask) -> Mask:
        """The current Gaussians whose originals are in a selection from those of the start, of all layers."""
        mask = _as_mask(selection)
        if mask.dtype != bool or mask.shape != (sum(self.counts),):
            expected = f"a Selection or mask of {sum(self.counts):,} Gaussians"
            raise invalid("selection", expected=expected, got=f"{mask.dtype} {mask.shape}")
        parts = zip(split_mask(mask, self.counts), self.sources, strict=True)
        return np.concatenate([part[source] for part, source in parts])

    def select(self, selection: object, layers: Sequence[int], *, is_current: bool) -> list[Mask]:
        """The current Gaussians of `layers` in a selection, as one mask for each layer.

        A mask with the size of the start is over the Gaussians of the start, unless `is_current`. Raises ValueError
        where a mask could be over those or the current ones.
        """
        if isinstance(selection, str | os.PathLike):
            cure = "Read a file with foldgauss.io.load_selection(path, model)."
            raise invalid("selection", expected="a Selection or a mask", got=repr(selection), cure=cure)
        sources, counts = [self.sources[k] for k in layers], [self.counts[k] for k in layers]
        current = [len(source) for source in sources]
        mask = _as_mask(selection)
        if mask.dtype != bool or mask.shape not in ((sum(current),), (sum(current if is_current else counts),)):
            raise _wrong_mask(mask, sum(current))
        if is_current or len(mask) != sum(counts):
            return split_mask(mask, current)
        pairs = list(zip(sources, counts, strict=True))
        if sum(current) == sum(counts) and any(not np.array_equal(source, np.arange(num)) for source, num in pairs):
            cure = "For the Gaussians of the start: select_begun(mask). For the current: select(lambda video: mask)."
            raise invalid("selection", expected="a mask with one meaning", got="an ambiguous one", cure=cure)
        return [part[source] for part, source in zip(split_mask(mask, counts), sources, strict=True)]


def split_mask(mask: Mask, counts: Sequence[int]) -> list[Mask]:
    """One mask for each layer from a mask over all."""
    return np.split(mask, np.cumsum(counts)[:-1])


def _as_mask(selection: object) -> np.ndarray:
    return np.asarray(selection.mask if isinstance(selection, Selection) else selection)


def _wrong_mask(mask: np.ndarray, num: int) -> ValueError:
    cure = "For a mask of pixels: select(mask=mask, frame=k)." if mask.ndim > 1 else "Is it another model's?"
    if mask.dtype.kind in "iu" and mask.ndim <= 1:
        cure = "For indices of Gaussians: Selection.of(model, [...])."
    expected = f"a Selection or mask of {num:,} Gaussians"
    return invalid("selection", expected=expected, got=f"{mask.dtype} {mask.shape}", cure=cure)
