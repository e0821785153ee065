"""Edits of one layer: bake an edit or add it as an overlay, reorder, copy and delete Gaussians with their edits."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Int

from foldgauss._runtime.checks import require
from foldgauss.video.editing.edited_video import Layer
from foldgauss.video.editing.overlays import (
    IDENTITY,
    AbstractOverlay,
    Affine,
    GaussianFunction,
    Place,
    Retiming,
    TimedEdit,
    TriangleFunction,
)
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.selection.selectors import Mask

Bake = Callable[[FoldedSplats, Mask], FoldedSplats | None]


def apply_edit(layer: Layer, edit: TimedEdit, bake: Bake | None = None) -> Layer:
    """Bake an edit into the layer's model where `bake` can, else add it as an overlay or a clock."""
    mask = np.asarray(edit.mask)
    if not mask.any():
        return layer
    for overlay in layer.overlays if isinstance(edit, Retiming) else ():
        require(
            not _depends_on_all(overlay) or not _overlaps_partly(overlay, mask),
            "selection",
            expected="all Gaussians of an edit about their own center, or none of them",
            got="a part of them",
            cure="Retime it before that edit.",
        )
    splats = bake(layer.model.splats, mask) if bake is not None and _may_bake(layer, edit) else None
    if splats is None:
        return add_edit(layer, edit)
    return dataclasses.replace(layer, model=dataclasses.replace(layer.model, splats=splats))


def add_edit(layer: Layer, edit: TimedEdit) -> Layer:
    """Add an overlay or a clock after those of the layer, if it has Gaussians."""
    if not np.asarray(edit.mask).any():
        return layer
    name = "clocks" if isinstance(edit, Retiming) else "overlays"
    return dataclasses.replace(layer, **{name: (*getattr(layer, name), edit)})


def gather_layer(
    layer: Layer, source: Int[np.ndarray, " num_new"], selected: Mask, copy: Int[np.ndarray, " num_new"] | None = None
) -> Layer:
    """A layer of the Gaussians at the indices `source`, with their edits; `copy`: 0 for originals, k for a k-th copy.

    An overlay of `selected` Gaussians becomes one overlay for each copy, since each copy has its own center.
    """
    copy = np.zeros(len(source), int) if copy is None else copy
    overlays = []
    for overlay in layer.overlays:
        mask = np.asarray(overlay.mask)
        numbers = range(copy.max(initial=0) + 1) if (mask & selected).any() else [None]
        masks = [mask[source] if k is None else mask[source] & (copy == k) for k in numbers]
        overlays += [dataclasses.replace(overlay, mask=one) for one in masks if one.any()]
    clocks = [dataclasses.replace(clock, mask=np.asarray(clock.mask)[source]) for clock in layer.clocks]
    model = dataclasses.replace(layer.model, splats=layer.model.splats.take(source))
    return Layer(model, tuple(overlays), tuple(clock for clock in clocks if clock.mask.any()))


def can_delete(layer: Layer, mask: Mask) -> bool:
    """Whether the edits of the remaining Gaussians stay the same: each overlay is of masked Gaussians only, or none."""
    return not any(_overlaps_partly(overlay, mask) for overlay in layer.overlays)


def _may_bake(layer: Layer, edit: TimedEdit) -> bool:
    """Whether the parameters may be changed: always, before other edits of the same Gaussians are applied."""
    if isinstance(edit, Affine) and edit.stretch != IDENTITY and layer.model.scale_cutoff > 0:
        return False  # the cutoff would leave out Gaussians at other times
    earlier = layer.clocks if isinstance(edit, Retiming) else layer.overlays
    return edit.span is None and not any((np.asarray(other.mask) & edit.mask).any() for other in earlier)


def _depends_on_all(overlay: AbstractOverlay) -> bool:
    """Whether the edit of one Gaussian depends on the others of the overlay."""
    if isinstance(overlay, Affine):
        return overlay.about is None and not overlay.is_translation
    return isinstance(overlay, GaussianFunction | TriangleFunction) or (
        isinstance(overlay, Place) and overlay.about is None
    )


def _overlaps_partly(overlay: AbstractOverlay, mask: Mask) -> bool:
    """Whether some, but not all, of an overlay's Gaussians are masked."""
    own = np.asarray(overlay.mask)
    return bool((own & mask).any() and (own & ~mask).any())
