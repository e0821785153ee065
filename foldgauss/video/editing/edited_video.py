"""Edited videos: models in layers, with edits that no folded model holds, drawn as one."""

import dataclasses
import os
from collections.abc import Callable, Iterator
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from foldgauss._runtime import notebook_hooks
from foldgauss._runtime.checks import invalid, is_integer
from foldgauss.render import Camera, Gaussians3D, RenderOptions, Splats2D, pixels_per_unit, project
from foldgauss.video.editing.overlays import (
    AbstractOverlay,
    Retiming,
    SelectedGaussians,
    is_active,
    pad_rows,
    padded_size,
)
from foldgauss.video.models.background import BLACK
from foldgauss.video.models.frame_times import FrameTimes, is_cut, snap_to_shots
from foldgauss.video.models.prepared import PreparedModel
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel, check_time


class Layer(eqx.Module):
    """A model, the clocks of its objects and its edits, each in the order in which they were made.

    Raises ValueError for masks that are not of the model's Gaussians.
    """

    model: VideoModel
    overlays: tuple[AbstractOverlay, ...] = ()
    clocks: tuple[Retiming, ...] = ()

    def __check_init__(self) -> None:
        num = getattr(self.model.splats.loc, "shape", (None,))[0]
        for edit in (*self.overlays, *self.clocks):
            shape, dtype = getattr(edit.mask, "shape", None), getattr(edit.mask, "dtype", None)
            if shape is not None and num is not None and (shape != (num,) or dtype.kind != "b"):
                raise invalid("mask", expected=f"bool ({num},), the layer's Gaussians", got=f"{dtype} {shape}")

    @property
    def num_gaussians(self) -> int:
        return self.model.splats.num_gaussians

    @property
    def holds_frames(self) -> bool:
        """Whether a frame stands for times about it: beside a cut, where nothing is to be seen, or one frame alone."""
        times = self.model.frame_times.times()
        return len(times) == 1 or bool(np.asarray(is_cut(times)).any())


class EditedVideo(eqx.Module):
    """What edits and layers make: drawn, played and saved as a `VideoModel` is.

    `layers` from front to back, each a model with overlays and clocks; the number `timeline` says whose frame times,
    size and rate are the video's. `camera`: who looks at it, a `Camera` or a function of t (which cannot be saved);
    None is the front one, for which flat Gaussians are the picture as it was fitted.

    Gaussians cover one another in array order, front layer first. Once some are placed in space, all are sorted by
    their distance from the camera across the plane of the frame, |z - z_camera|, array order where it is equal: so any
    number of parallel planes cover one another as they should wherever they are seen from, and each keeps its order.

    **Units:** times are in [0, 1], of the video. **Example:** `edit(model).select(mask).move((0.1, 0)).video()`.

    **Raises:** ValueError for no layers, and layers of another aspect, compositing or `RenderOptions`.
    """

    layers: tuple[Layer, ...]
    camera: Camera | Callable[[float], Camera] | None = None
    timeline: int = eqx.field(static=True, default=-1)

    def __check_init__(self) -> None:
        if not self.layers:
            raise invalid("layers", expected="at least one", got="none")
        if not _numbers_one(self.timeline, len(self.layers)):
            raise invalid("timeline", expected=f"the number of one of {len(self.layers)} layers", got=self.timeline)
        _check_fitting([layer.model for layer in self.layers])

    @property
    def _lead(self) -> VideoModel:
        return self.layers[self.timeline].model

    @property
    def frame_times(self) -> FrameTimes:
        return self._lead.frame_times

    @property
    def num_frames(self) -> int:
        return self._lead.num_frames

    @property
    def size(self) -> tuple[int, int]:
        return self._lead.size

    @property
    def fps(self) -> float:
        return self._lead.fps

    @property
    def options(self) -> RenderOptions:
        return self._lead.options

    @property
    def compositing(self) -> str:
        return self._lead.compositing

    @property
    def num_gaussians(self) -> int:
        """Gaussians of all layers."""
        return sum(layer.num_gaussians for layer in self.layers)

    @property
    def degree(self) -> int:
        """The highest of the folds'."""
        return max(layer.model.splats.degree for layer in self.layers)

    @property
    def num_parameters(self) -> int:
        """Numbers stored, masks not counted."""
        return sum(layer.model.num_parameters for layer in self.layers)

    def with_options(self, options: RenderOptions) -> "EditedVideo":
        """The same, drawn with other constants: those of all layers."""
        own = (dataclasses.replace(layer, model=layer.model.with_options(options)) for layer in self.layers)
        return dataclasses.replace(self, layers=tuple(own))

    def prepare(self, size: tuple[int, int]) -> "PreparedEditedVideo":
        """Made ready to be conditioned many times, for pictures of `size`."""
        return PreparedEditedVideo(self, size)

    def at(self, t: float, size: tuple[int, int] | None = None) -> Splats2D:
        """The splats of time t, front to back, in pixels of a picture of `size` (default: its own); NumPy leaves."""
        return self.prepare(self.size if size is None else size).splats(float(t))

    def render(
        self,
        t: float,
        size: tuple[int, int] | None = None,
        *,
        background: tuple[float, float, float] = BLACK,
    ) -> Float[np.ndarray, "height width 3"]:
        """The picture at any time t in [0, 1], values about [0, 1], over `background`; of `VideoRenderer`, so NumPy."""
        check_time(t)
        return np.moveaxis(VideoRenderer(self, size, background=background).image(t), 0, -1)

    def frames(
        self,
        times: np.ndarray | None = None,
        size: tuple[int, int] | None = None,
        *,
        background: tuple[float, float, float] = BLACK,
    ) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """Pictures at `times` (default: the frame times) one by one, over `background`, uint8 (height, width, 3)."""
        yield from VideoRenderer(self, size, background=background).frames(times)

    def _repr_html_(self) -> str | None:
        """The player, in a notebook, as of a `VideoModel`; None where no folded model holds the edits."""
        return notebook_hooks.show("video", self)


def stack_layers(*videos: VideoModel | EditedVideo, timeline: int = -1) -> EditedVideo:
    """Videos of one piece each one over another: see `foldgauss.video.layers`."""
    parts = [as_edited(video) for video in videos]
    if not parts:
        raise invalid("videos", expected="at least one", got="none")
    if not _numbers_one(timeline, len(parts)):
        raise invalid("timeline", expected=f"the number of one of {len(parts)} videos", got=timeline)
    for part in parts:
        if part.camera is not None:
            cure = "Put the layers together first, then call edit(...).seen_from(camera)."
            raise invalid("videos", expected="videos without a camera", got="one with its own", cure=cure)
    timeline %= len(parts)
    before = sum(len(part.layers) for part in parts[:timeline])
    inner = parts[timeline].timeline % len(parts[timeline].layers)
    return EditedVideo(tuple(layer for part in parts for layer in part.layers), timeline=before + inner)


def as_edited(video: VideoModel | EditedVideo) -> EditedVideo:
    """A model as a video of one layer; an edited one as it is. Raises ValueError for anything else."""
    if isinstance(video, EditedVideo):
        return video
    if not isinstance(video, VideoModel):
        cure = "End a chain of edits with .video()."
        if isinstance(video, list | tuple):
            cure = "Put several together by layers(*videos)."
        elif isinstance(video, str | os.PathLike):
            cure = "Read a file with foldgauss.io.load_video_model(path)."
        elif type(video).__name__ == "SegmentedVideo":
            cure = ONE_SEGMENT
        raise invalid("video", expected="a VideoModel or an EditedVideo", got=type(video).__name__, cure=cure)
    return EditedVideo((Layer(video),), timeline=0)


def _numbers_one(number: object, num: int) -> bool:
    """Whether `number` says which of `num`, from the front or, below 0, from the back."""
    return is_integer(number, -num) and number < num


def _check_fitting(models: list[VideoModel]) -> None:
    first = models[0]
    for other in models[1:]:
        (height, width), (other_height, other_width) = first.size, other.size
        # Frames of one shape at two sizes differ by the rounding of a side, at most.
        if abs(height * other_width - width * other_height) > max(width, other_width, height, other_height):
            expected = f"frames of one shape, {height}x{width} (height x width)"
            cure = "Fit the layers from clips cropped to the same aspect."
            raise invalid("layers", expected=expected, got=f"{other_height}x{other_width}", cure=cure)
        for name in ("compositing", "options"):
            one, two = getattr(first, name), getattr(other, name)
            if one != two:
                cure = "A picture is blended in one way: fit both with the same."
                raise invalid("layers", expected=f"one {name} for all, {one!r}", got=repr(two), cure=cure)


class PreparedEditedVideo:
    """The splats of an edited video by time, in pixels of a picture of `size`, see `PreparedModel`."""

    def __init__(self, video: EditedVideo, size: tuple[int, int]):
        height, width = video.size
        self._size, self._camera = tuple(size), video.camera
        self._layers = [_PreparedLayer(layer, self._size, height / width) for layer in video.layers]
        self._front = partial(Camera.front, height / width)
        self._times = np.asarray(video.frame_times.times())

    def splats(self, t: float) -> Splats2D:
        """The splats of time t, front to back; NumPy leaves."""
        t = float(t)
        moments = [layer.at(t) for layer in self._layers]
        if self._camera is not None:
            for moment in moments:
                moment.lift_all()
        if not any(moment.in_space for moment in moments):
            return _together(moments)
        camera = self._camera_at(t)
        for moment in moments:
            moment.project(camera, self._size)
        depth = np.concatenate([moment.depth for moment in moments])
        nearest_first = np.argsort(np.abs(depth - float(camera.position[2])), kind="stable")
        return jax.tree.map(lambda leaf: leaf[nearest_first], _together(moments))

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """One picture, see `foldgauss.video.models.renderer.PreparedVideo`."""
        return [(1.0, self.splats(snap_to_shots(t, self._times)))]

    def _camera_at(self, t: float) -> Camera:
        camera = self._camera
        if camera is None or isinstance(camera, Camera):
            return self._front() if camera is None else camera
        seen = camera(t)
        if not isinstance(seen, Camera):
            raise invalid("camera(t)", expected="a Camera", got=type(seen).__name__)
        return seen


def _together(moments: list["_ConditionedLayer"]) -> Splats2D:
    parts = [(moment.mean, moment.factor, moment.opacity, moment.color) for moment in moments]
    return Splats2D(*(parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))))


class _PreparedLayer:
    """A layer made ready: who goes by which clock is known."""

    def __init__(self, layer: Layer, size: tuple[int, int], aspect: float):
        self._stage, self._layer = PreparedModel(layer.model, size, aspect=aspect), layer
        self._masks = [np.asarray(overlay.mask) for overlay in layer.overlays]
        self._times = np.asarray(layer.model.frame_times.times())
        self._holds_frames = layer.holds_frames
        self._groups = _by_clocks(layer)

    def at(self, t: float) -> "_ConditionedLayer":
        """The layer's Gaussians at the video's time t, edited."""
        moment = _ConditionedLayer(*self._conditioned(t), self._stage.spec.size, self._stage.spec.aspect)
        for overlay, mask in zip(self._layer.overlays, self._masks, strict=True):
            progress = overlay.progress(t)
            if is_active(overlay, progress):
                moment.edit(mask, partial(overlay, t=t, progress=progress))
        moment.drop_unseen()
        return moment

    def _conditioned(self, t: float) -> tuple[np.ndarray, ...]:
        """Index, mean, factor, opacity and colour of those alive, each by its clock, in array order."""
        parts = [self._stage.at(self._own_time(clocks, t), members) for clocks, members in self._groups]
        leaves = [(part.alive, part.mean, part.factor, part.opacity, part.color) for part in parts]
        if len(leaves) == 1:
            return leaves[0]
        order = np.argsort(np.concatenate([part.alive for part in parts]), kind="stable")
        return tuple(np.take(np.concatenate(leaf), order, axis=0) for leaf in zip(*leaves, strict=True))

    def _own_time(self, clocks: tuple[Retiming, ...], t: float) -> float:
        for clock in reversed(clocks):  # the last edit is asked first: it retimes all that the others made
            t = clock.own_time(t)
        return float(snap_to_shots(t, self._times)) if self._holds_frames else t


def _by_clocks(layer: Layer) -> list[tuple[tuple[Retiming, ...], Bool[np.ndarray, " num"] | None]]:
    """Groups of Gaussians that go by the same clocks."""
    if not layer.clocks:
        return [((), None)]
    masks = np.stack([np.asarray(clock.mask) for clock in layer.clocks])
    which, group = np.unique(masks, axis=1, return_inverse=True)
    group = group.reshape(-1)
    chains = [tuple(clock for clock, on in zip(layer.clocks, column, strict=True) if on) for column in which.T]
    return [(chain, group == k) for k, chain in enumerate(chains)]


class _ConditionedLayer:
    """A layer's Gaussians at one time, in pixels, on the way through the edits; those in space also in model space."""

    def __init__(self, index, mean, factor, opacity, color, size: tuple[int, int], aspect: float):
        self.index, self.mean, self.factor, self.opacity, self.color = index, mean, factor, opacity, color
        height, width = size
        self._unit = np.float32(pixels_per_unit(size, aspect=aspect))
        self._middle = np.float32([width / 2, height / 2])
        self._solid_mean = self._solid_factor = self._lifted = None  # of all, once one is in space

    def edit(self, mask: Bool[np.ndarray, " num"], change: Callable[[SelectedGaussians], SelectedGaussians]) -> None:
        """Change the masked ones; all others keep their bits."""
        chosen = np.flatnonzero(mask[self.index])
        if chosen.size:
            before = self._take(chosen)
            self._put(chosen, before, change(before))

    def drop_unseen(self) -> None:
        """Take out what an edit has made invisible."""
        seen = self.opacity > 0
        if seen.all():
            return
        for name in ("index", "mean", "factor", "opacity", "color", "_solid_mean", "_solid_factor", "_lifted"):
            leaf = getattr(self, name)
            setattr(self, name, None if leaf is None else leaf[seen])

    def lift_all(self) -> None:
        """Put all into space, flat ones in the plane of the frame."""
        self._make_space()
        self._lifted[:] = True

    def project(self, camera: Camera, size: tuple[int, int]) -> None:
        """Bring those in space back to pixels, as the camera sees them."""
        if not self.in_space:
            return
        which = np.flatnonzero(self._lifted)
        seen = _project(camera, size, self._solid_mean[which], self._solid_factor[which], self.opacity[which])
        self.mean[which], self.factor[which], self.opacity[which] = seen

    @property
    def in_space(self) -> bool:
        """Whether one of them is."""
        return self._lifted is not None

    @property
    def depth(self) -> Float[np.ndarray, " num"]:
        """z of each; 0 in the plane of the frame."""
        return self._solid_mean[:, 2] if self.in_space else np.zeros(len(self.index), np.float32)

    def _take(self, chosen: np.ndarray) -> SelectedGaussians:
        if not self.in_space:
            mean, factor = self._in_model_space(chosen)
        else:
            mean, factor = self._solid_mean[chosen], self._solid_factor[chosen]
        leaves = (self.index[chosen], mean, factor, self.opacity[chosen], self.color[chosen])
        for leaf in leaves:  # changed in place, it could not be told from unchanged
            leaf.setflags(write=False)
        return SelectedGaussians(*leaves)

    def _put(self, chosen: np.ndarray, before: SelectedGaussians, after: SelectedGaussians) -> None:
        for name in ("opacity", "color"):
            if getattr(after, name) is not getattr(before, name):
                getattr(self, name)[chosen] = getattr(after, name)
        if after.mean is before.mean and after.factor is before.factor:
            return
        if not self.in_space and after.mean.shape[1] == 2:
            self.mean[chosen] = after.mean * self._unit + self._middle
            self.factor[chosen] = after.factor * self._unit
            return
        after = after.in_space()
        self._make_space()
        self._solid_mean[chosen], self._solid_factor[chosen], self._lifted[chosen] = after.mean, after.factor, True

    def _make_space(self) -> None:
        if not self.in_space:
            num = len(self.index)
            self._solid_mean, self._solid_factor = np.zeros((num, 3), np.float32), np.zeros((num, 3, 2), np.float32)
            self._solid_mean[:, :2], self._solid_factor[:, :2] = self._in_model_space(slice(None))
            self._lifted = np.zeros(num, bool)

    def _in_model_space(self, chosen: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        return (self.mean[chosen] - self._middle) / self._unit, self.factor[chosen] / self._unit


def _project(camera: Camera, size: tuple[int, int], mean: np.ndarray, factor: np.ndarray, opacity: np.ndarray):
    """Mean, factor and opacity of what the camera sees, in pixels, in the order they come."""
    num = len(opacity)
    room = padded_size(num)
    seen = _projected(camera, size, pad_rows(mean, room), pad_rows(factor, room), pad_rows(opacity, room))
    return tuple(np.asarray(leaf)[:num] for leaf in seen)


@partial(jax.jit, static_argnums=1)
def _projected(
    camera: Camera,
    size: tuple[int, int],
    mean: Float[Array, "num 3"],
    factor: Float[Array, "num 3 2"],
    opacity: Float[Array, " num"],
) -> tuple[Array, Array, Array]:
    flat = Gaussians3D(mean, jnp.concatenate([factor, jnp.zeros_like(factor[..., :1])], -1), opacity, mean)
    splats = project(flat, camera, size, order="array")
    return splats.mean, splats.factor, splats.opacity
