"""Edited videos: layers of models with overlays and clocks, their edits, and their rendering as one video."""

import dataclasses
import os
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from foldgauss._runtime.checks import is_integer, require
from foldgauss.render import Camera, Gaussians3D, RenderOptions, Splats2D, pixels_per_unit, project
from foldgauss.video.editing.overlays import (
    IDENTITY,
    AbstractOverlay,
    Affine,
    Opacity,
    Recolor,
    Retiming,
    SelectedGaussians,
    TimedEdit,
    call_padded,
    is_active,
)
from foldgauss.video.models.conditioning import PreparedModel
from foldgauss.video.models.frame_times import is_cut, snap_to_shots
from foldgauss.video.models.renderer import FollowingVideo, PreparedVideo
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel
from foldgauss.video.selection.selectors import Mask

Bake = Callable[[FoldedSplats, Mask], FoldedSplats | None]


class Layer(eqx.Module):
    """A model with overlays and clocks, each in the order in which they were added.

    Raises ValueError for masks of another shape than (num_gaussians,).
    """

    model: VideoModel
    overlays: tuple[AbstractOverlay, ...] = ()
    clocks: tuple[Retiming, ...] = ()
    name: str = eqx.field(static=True, default="")  #: of the object, for `Edit.select`

    def __check_init__(self) -> None:
        num = getattr(self.model.splats.loc, "shape", (None,))[0]
        for edit in (*self.overlays, *self.clocks):
            shape, dtype = getattr(edit.mask, "shape", None), getattr(edit.mask, "dtype", None)
            require(
                shape is None or num is None or (shape == (num,) and dtype.kind == "b"),
                "mask",
                expected=f"bool ({num},), the layer's Gaussians",
                got=f"{dtype} {shape}",
            )

    @property
    def num_gaussians(self) -> int:
        return self.model.splats.num_gaussians

    @property
    def is_gone(self) -> bool:
        """Whether all of it is always hidden."""
        hides = (one for one in self.overlays if isinstance(one, Opacity) and one.span is None and one.factor == 0)
        return any(np.asarray(one.mask).all() for one in hides)

    @property
    def holds_frames(self) -> bool:
        """Whether some frame is shown for times around it: next to a cut, or where there is only one frame."""
        times = self.model.frame_times.times()
        return len(times) == 1 or bool(np.asarray(is_cut(times)).any())


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
    clocks = tuple(clock for clock in clocks if clock.mask.any())
    return dataclasses.replace(layer, model=model, overlays=tuple(overlays), clocks=clocks)


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
    if isinstance(overlay, Opacity | Recolor) or (isinstance(overlay, Affine) and overlay.is_translation):
        return False
    return getattr(overlay, "about", None) is None  # functions have none


def _overlaps_partly(overlay: AbstractOverlay, mask: Mask) -> bool:
    """Whether some, but not all, of an overlay's Gaussians are masked."""
    own = np.asarray(overlay.mask)
    return bool((own & mask).any() and (own & ~mask).any())


class EditedVideo(FollowingVideo, eqx.Module):
    """A video of layers with edits; it is rendered, played and saved as a `VideoModel` is.

    `layers` are ordered from front to back; frame times, size and frame rate are those of layer number `timeline`.
    `camera` is a `Camera`, a function of t (which cannot be saved) or None, the front camera, which sees flat Gaussians
    as they were fitted.

    The depth order is array order, front layer first. Once some Gaussians are in 3D space, all are sorted by their
    distance from the camera along z, |z - z_camera|, and by array order where it is equal: so parallel planes are
    ordered correctly for any camera, and each plane keeps its order.

    **Units:** times of the video are in [0, 1]. **Example:** `edit(model).select(mask).move((0.1, 0)).video()`.

    **Raises:** ValueError for no layers, and for layers of different aspect ratio, compositing or `RenderOptions`.
    """

    layers: tuple[Layer, ...]
    camera: Camera | Callable[[float], Camera] | None = None
    timeline: int = eqx.field(static=True, default=-1)

    def __check_init__(self) -> None:
        require(self.layers, "layers", expected="at least one", got="none")
        check_timeline(self.timeline, len(self.layers), "layers")
        _check_compatible([layer.model for layer in self.layers])

    @property
    def _lead(self) -> VideoModel:
        return self.layers[self.timeline].model

    @property
    def num_gaussians(self) -> int:
        """The number of Gaussians of all layers."""
        return sum(layer.num_gaussians for layer in self.layers)

    @property
    def degree(self) -> int:
        """The highest degree of the folds."""
        return max(layer.model.splats.degree for layer in self.layers)

    @property
    def num_parameters(self) -> int:
        """Numbers stored, masks not counted."""
        return sum(layer.model.num_parameters for layer in self.layers)

    def with_options(self, options: RenderOptions) -> "EditedVideo":
        """The same video, all layers rendered with other options."""
        layers = (dataclasses.replace(layer, model=layer.model.with_options(options)) for layer in self.layers)
        return dataclasses.replace(self, layers=tuple(layers))

    def prepare(self, size: tuple[int, int]) -> "PreparedEditedVideo":
        """The video prepared for conditioning on many times, for images of `size`."""
        return PreparedEditedVideo(self, size)


def stack_layers(*videos: VideoModel | EditedVideo, timeline: int = -1) -> EditedVideo:
    """The layers of several videos as one video, the front one first: see `foldgauss.video.layers`."""
    parts = [as_edited(video) for video in videos]
    require(parts, "videos", expected="at least one", got="none")
    check_timeline(timeline, len(parts), "videos")
    require(
        all(part.camera is None for part in parts),
        "videos",
        expected="videos without a camera",
        got="one with its own",
        cure="Stack the layers first, then call edit(...).seen_from(camera).",
    )
    timeline %= len(parts)
    before = sum(len(part.layers) for part in parts[:timeline])
    inner = parts[timeline].timeline % len(parts[timeline].layers)
    return EditedVideo(tuple(layer for part in parts for layer in part.layers), timeline=before + inner)


def as_edited(video: VideoModel | EditedVideo) -> EditedVideo:
    """A model as a video of one layer, an edited video as it is. Raises ValueError for anything else."""
    if isinstance(video, EditedVideo):
        return video
    kind = "path" if isinstance(video, str | os.PathLike) else type(video).__name__
    cures = {
        "Edit": "End a chain of edits with .video().",
        "SegmentedEdit": "End a chain of edits with .video().",
        "list": "Stack several with layers(*videos).",
        "tuple": "Stack several with layers(*videos).",
        "path": "Read a file with foldgauss.io.load_video_model(path).",
        "SegmentedVideo": ONE_SEGMENT,
        "StabilizedVideo": "Edit first, and stabilize the edited video.",
    }
    require(
        isinstance(video, VideoModel),
        "video",
        expected="a VideoModel or an EditedVideo",
        got=type(video).__name__,
        cure=cures.get(kind, ""),
    )
    return EditedVideo((Layer(video),), timeline=0)


def check_timeline(timeline: object, num: int, items: str) -> None:
    """Raise ValueError unless it is an index into `num` items; below 0 it counts from the end."""
    require(
        is_integer(timeline, -num) and timeline < num,
        "timeline",
        expected=f"the number of one of {num} {items}",
        got=timeline,
    )


def _check_compatible(models: list[VideoModel]) -> None:
    first = models[0]
    for other in models[1:]:
        (height, width), (other_height, other_width) = first.size, other.size
        # Frames of one aspect ratio at two sizes differ by the rounding of a side.
        require(
            abs(height * other_width - width * other_height) <= max(width, other_width, height, other_height),
            "layers",
            expected=f"frames of one aspect ratio, {height}x{width} (height x width)",
            got=f"{other_height}x{other_width}",
            cure="Fit the layers from clips cropped to the same aspect.",
        )
        for name in ("compositing", "options"):
            one, two = getattr(first, name), getattr(other, name)
            require(
                one == two,
                "layers",
                expected=f"one {name} for all, {one!r}",
                got=repr(two),
                cure="All layers are composited together: fit them alike.",
            )


class PreparedEditedVideo(PreparedVideo):
    """An edited video prepared for images of `size`, see `PreparedModel`."""

    def __init__(self, video: EditedVideo, size: tuple[int, int]):
        height, width = video.size
        self._size, self._camera = tuple(size), video.camera
        self._layers = [_PreparedLayer(layer, self._size, height / width) for layer in video.layers]
        self._front = partial(Camera.front, height / width)
        self.times = np.asarray(video.frame_times.times())

    def splats(self, t: float) -> Splats2D:
        """The splats of time t, front to back; NumPy leaves."""
        layers = [layer.condition(float(t)) for layer in self._layers]
        if self._camera is not None:
            for layer in layers:
                layer.lift_all()
        camera = self._camera_at(float(t)) if any(layer.in_space for layer in layers) else None
        if camera is not None:
            for layer in layers:
                layer.project(camera, self._size)
        parts = [layer.visible() for layer in layers]
        *leaves, depth = parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))
        if camera is not None:
            nearest_first = np.argsort(np.abs(depth - float(camera.position[2])), kind="stable")
            leaves = [leaf[nearest_first] for leaf in leaves]
        return Splats2D(*leaves)

    def _camera_at(self, t: float) -> Camera:
        camera = self._camera
        if callable(camera):
            camera = camera(t)
            require(isinstance(camera, Camera), "camera(t)", expected="a Camera", got=type(camera).__name__)
        return self._front() if camera is None else camera


class _PreparedLayer:
    """A layer prepared for conditioning: its Gaussians grouped by their clocks."""

    def __init__(self, layer: Layer, size: tuple[int, int], aspect: float):
        self._model, self._layer = PreparedModel(layer.model, size, aspect=aspect), layer
        self._masks = [np.asarray(overlay.mask) for overlay in layer.overlays]
        self._holds_frames = layer.holds_frames
        self._groups = _group_by_clocks(layer)

    def condition(self, t: float) -> "_ConditionedLayer":
        """The layer's Gaussians at the video's time t, with its overlays applied."""
        conditioned = _ConditionedLayer(*self._gaussians(t), self._model.spec.size, self._model.spec.aspect)
        for overlay, mask in zip(self._layer.overlays, self._masks, strict=True):
            progress = overlay.progress(t)
            if is_active(overlay, progress):
                conditioned.edit(mask, partial(overlay, t=t, progress=progress))
        return conditioned

    def _gaussians(self, t: float) -> tuple[np.ndarray, ...]:
        """Index, mean, factor, opacity and color of the Gaussians alive at their own times, in array order."""
        parts = [self._model.at(self._own_time(clocks, t), members) for clocks, members in self._groups]
        leaves = [(part.alive, part.mean, part.factor, part.opacity, part.color) for part in parts]
        if len(leaves) == 1:
            return leaves[0]
        order = np.argsort(np.concatenate([part.alive for part in parts]), kind="stable")
        return tuple(np.take(np.concatenate(leaf), order, axis=0) for leaf in zip(*leaves, strict=True))

    def _own_time(self, clocks: tuple[Retiming, ...], t: float) -> float:
        for clock in reversed(clocks):  # the last edit retimes the result of those before
            t = clock.own_time(t)
        return float(snap_to_shots(t, self._model.times)) if self._holds_frames else t


def _group_by_clocks(layer: Layer) -> list[tuple[tuple[Retiming, ...], Bool[np.ndarray, " num"] | None]]:
    """Groups of Gaussians with the same clocks: clocks and mask, None for all Gaussians."""
    if not layer.clocks:
        return [((), None)]
    masks = np.stack([np.asarray(clock.mask) for clock in layer.clocks])
    columns, group = np.unique(masks, axis=1, return_inverse=True)
    group = group.reshape(-1)
    chains = [tuple(clock for clock, used in zip(layer.clocks, column, strict=True) if used) for column in columns.T]
    return [(chain, group == k) for k, chain in enumerate(chains)]


class _ConditionedLayer:
    """The Gaussians of a layer at one time, to apply overlays to: in pixels, and their depths in model space."""

    def __init__(self, index, mean, factor, opacity, color, size: tuple[int, int], aspect: float):
        self.index, self.mean, self.factor, self.opacity, self.color = index, mean, factor, opacity, color
        height, width = size
        self._unit = np.float32(pixels_per_unit(size, aspect=aspect))
        self._middle = np.float32([width / 2, height / 2])
        # The third row of means and factors, and which Gaussians are in 3D space.
        self._depth, self._slant = np.zeros(len(index), np.float32), np.zeros((len(index), 2), np.float32)
        self._lifted = np.zeros(len(index), bool)

    def edit(self, mask: Bool[np.ndarray, " num"], change: Callable[[SelectedGaussians], SelectedGaussians]) -> None:
        """Edit the selected Gaussians; all others keep their bits."""
        selected = np.flatnonzero(mask[self.index])
        if not selected.size:
            return
        mean, factor = self._in_model_space(selected, in_space=self.in_space)
        leaves = self.index[selected], mean, factor, self.opacity[selected], self.color[selected]
        for leaf in leaves:  # a change in place would not be noticed
            leaf.setflags(write=False)
        before = SelectedGaussians(*leaves)
        after = change(before)
        for name in ("opacity", "color"):
            if getattr(after, name) is not getattr(before, name):
                getattr(self, name)[selected] = getattr(after, name)
        if after.mean is before.mean and after.factor is before.factor:
            return
        if self.in_space or after.mean.shape[1] == 3:
            after = after.in_space()
            self._depth[selected], self._slant[selected] = after.mean[:, 2], after.factor[:, 2]
            self._lifted[selected] = True
        if after.mean is not before.mean:
            self.mean[selected] = after.mean[:, :2] * self._unit + self._middle
        if after.factor is not before.factor:
            self.factor[selected] = after.factor[:, :2] * self._unit

    def visible(self) -> tuple[np.ndarray, ...]:
        """Mean, factor, opacity, color and depth, the z coordinate, of the Gaussians that are not transparent."""
        leaves, shown = (self.mean, self.factor, self.opacity, self.color, self._depth), self.opacity > 0
        return leaves if shown.all() else tuple(leaf[shown] for leaf in leaves)

    def lift_all(self) -> None:
        """Move all into 3D space, flat ones in the plane of the frame."""
        self._lifted[:] = True

    def project(self, camera: Camera, size: tuple[int, int]) -> None:
        """Project the Gaussians in 3D space to pixels of the camera."""
        if not self.in_space:
            return
        lifted = np.flatnonzero(self._lifted)
        leaves = (*self._in_model_space(lifted, in_space=True), self.opacity[lifted])
        projected = call_padded(partial(_project, camera, size), *leaves)
        self.mean[lifted], self.factor[lifted], self.opacity[lifted] = projected

    @property
    def in_space(self) -> bool:
        """Whether a Gaussian is in 3D space."""
        return bool(self._lifted.any())

    def _in_model_space(self, selected: np.ndarray, *, in_space: bool) -> tuple[np.ndarray, np.ndarray]:
        mean, factor = (self.mean[selected] - self._middle) / self._unit, self.factor[selected] / self._unit
        if not in_space:
            return mean, factor
        thirds = self._depth[selected, None], self._slant[selected, None]
        return tuple(np.concatenate(pair, 1) for pair in zip((mean, factor), thirds, strict=True))


@partial(jax.jit, static_argnums=1)
def _project(
    camera: Camera,
    size: tuple[int, int],
    mean: Float[Array, "num 3"],
    factor: Float[Array, "num 3 2"],
    opacity: Float[Array, " num"],
) -> tuple[Array, Array, Array]:
    flat = Gaussians3D(mean, jnp.concatenate([factor, jnp.zeros_like(factor[..., :1])], -1), opacity, mean)
    splats = project(flat, camera, size, order="array")
    return splats.mean, splats.factor, splats.opacity
