"""Videos and the rendering of their frames on the CPU: images at any times.

`RenderedVideo` is the base class of all videos. Conditioning uses the fused kernels (`conditioning`) and blending the
CPU engine: no XLA, and no work for Gaussians that are not alive.
"""

import math
from collections.abc import Iterator
from operator import attrgetter

import jax
import jax.numpy as jnp
import numba as nb
import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._runtime import notebook_hooks
from foldgauss._runtime.checks import invalid, is_integer, is_within, require, short_repr
from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import RenderOptions, Splats2D, cpu
from foldgauss.render.splats import check_size
from foldgauss.video.models.background import BLACK, Background, check_background
from foldgauss.video.models.frame_times import FrameTimes, snap_to_shots

ROWS = 64  # of pixels per task

_f = nb.float32
_byte = nb.uint8


class PreparedVideo:
    """A video prepared for images of one size, by its `prepare(size)`.

    A subclass has `splats` and the `times` of its frames, or `weighted_splats`.
    """

    times: Float[np.ndarray, " frames"]

    def splats(self, t: float) -> Splats2D:
        """The splats of time t, front to back; NumPy leaves. In a fade, the splats with the larger weight."""
        return max(self.weighted_splats(t), key=lambda part: part[0])[1]

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """The splats of the images whose weighted sum is the frame at time t, with the weights, which sum to 1.

        In the gap of a cut they are those of the nearer shot.
        """
        return [(1.0, self.splats(snap_to_shots(t, self.times)))]


def check_time(t: float, name: str = "t", cure: str = "Frame k is at frame_times.times()[k].") -> None:
    """Raise ValueError unless t is one time, in [0, 1] if its value is known."""
    traced, close = isinstance(t, jax.core.Tracer), 1e-6  # rounding of summed steps
    try:
        time = t if traced else np.asarray(t)
    except ValueError:
        raise invalid(name, expected="a time in [0, 1]", got=short_repr(t)) from None
    fits = not time.ndim and (time.dtype.kind in "iu" or jnp.issubdtype(time.dtype, jnp.floating))
    require(fits, name, expected=f"{'one' if time.ndim else 'a'} time in [0, 1]", got=short_repr(t))
    require(traced or -close <= time <= 1 + close, name, expected="a time in [0, 1]", got=short_repr(t), cure=cure)


def choose_time(video: "RenderedVideo", time: float | None, frame: int | None, seconds: float | None) -> float:
    """The time in [0, 1] of the one argument that is not None; `VideoModel.render` documents them and the errors."""
    given = [name for name, value in (("time", time), ("frame", frame), ("seconds", seconds)) if value is not None]
    if len(given) != 1:
        raise TypeError(
            f"render: expected exactly one of time, frame and seconds, got {' and '.join(given) or 'none'}."
        )
    if time is not None:
        check_time(time, "time", "Frame k is render(frame=k), second s of the clip render(seconds=s).")
        return time
    num, cure = video.num_frames, "For what lies between frames use time or seconds."
    if frame is not None:
        require(
            is_integer(frame, -math.inf), "frame", expected="the number of a frame", got=short_repr(frame), cure=cure
        )
        if not -num <= frame < num:
            raise IndexError(f"frame: expected a number from {-num} to {num - 1} of {num} frames, got {frame}.")
        position = float(frame % num)
    else:
        require(
            is_within(seconds, f"[0, {num / video.fps}]"),
            "seconds",
            expected=f"seconds in [0, {num / video.fps:g}], as {num} frames at {video.fps:g} a second last",
            got=short_repr(seconds),
        )
        position = float(min(seconds * video.fps, num - 1))
    times, before = video.frame_times.times(), int(position)
    return times[before] + (position - before) * (times[min(before + 1, num - 1)] - times[before])


class RenderedVideo:
    """A video, which `VideoRenderer` renders: `VideoModel`, `EditedVideo`, `SegmentedVideo`, `StabilizedVideo`."""

    size: tuple[int, int]
    fps: float
    options: RenderOptions
    compositing: str
    num_frames: int
    frame_times: FrameTimes

    def prepare(self, size: tuple[int, int]) -> PreparedVideo:
        """Prepared for conditioning on many times, for images of `size`."""
        raise NotImplementedError  # a base class: every kind of video has its own

    def render(
        self,
        time: float | None = None,
        size: tuple[int, int] | None = None,
        *,
        frame: int | None = None,
        seconds: float | None = None,
        background: Background = BLACK,
    ) -> Float[np.ndarray, "height width channels"]:
        """The image at one moment, values about [0, 1], over `background`; as `VideoRenderer`, in NumPy.

        Exactly one of `time`, `frame` and `seconds` says which, as for `VideoModel.render`, which has the errors, too.
        """
        t = choose_time(self, time, frame, seconds)
        return np.moveaxis(VideoRenderer(self, size, background=background).image(t), 0, -1)

    def frames(
        self,
        times: np.ndarray | None = None,
        size: tuple[int, int] | None = None,
        *,
        background: Background = BLACK,
    ) -> Iterator[UInt8[np.ndarray, "height width channels"]]:
        """Images at `times` (default: the frame times) one by one, over `background`, uint8 (height, width, 3);
        (height, width, 4), with premultiplied colors, where it is None."""
        return VideoRenderer(self, size, background=background).frames(times)

    def at(self, t: float, size: tuple[int, int] | None = None) -> Splats2D:
        """The splats of time t, front to back, in pixels of an image of `size` (default: its own); NumPy leaves.

        In a cross-fade of segments they are those of the model with the larger weight.
        """
        check_time(t)
        return self.prepare(self.size if size is None else size).splats(float(t))

    def _repr_html_(self) -> str | None:
        """The player, in a notebook; None if its page would be too large or no folded model represents the edits."""
        return notebook_hooks.show("video", self)


class FollowingVideo(RenderedVideo):
    """A video whose frames are those of another, `_lead`."""

    frame_times = property(attrgetter("_lead.frame_times"))
    num_frames = property(attrgetter("_lead.num_frames"))
    size = property(attrgetter("_lead.size"))
    fps = property(attrgetter("_lead.fps"))
    options = property(attrgetter("_lead.options"))
    compositing = property(attrgetter("_lead.compositing"))


class VideoRenderer:
    """Renders a video at one size and many times: a model, an edited video, or one in segments.

    **Shapes:** images are uint8 (height, width, 3), or (height, width, 4) without a background. **Units:** times are
    those of the model, in [0, 1].

    `background`: red, green and blue in [0, 1] behind all splats; black, as in a fit of frames without alpha; None for
    images with alpha, whose colors are premultiplied.

    **Example:** `for image in VideoRenderer(model).frames(): ...`

    **Source:** VeGaS eq:vegas_equiv_cond. **Raises:** ValueError for an invalid size, and for a model with NaN or
    infinities.
    """

    def __init__(
        self,
        model: RenderedVideo,
        size: tuple[int, int] | None = None,
        *,
        background: Background = BLACK,
    ):
        self.model = model
        size = model.size if size is None else size
        check_size(size)
        self.size = tuple(size)
        self._prepared = model.prepare(self.size)
        self._background = check_background(background, model.compositing)

    def splats(self, t: float) -> Splats2D:
        """The splats of the Gaussians alive at time t, in pixels of an image of `size`; NumPy leaves.

        In the gap of a cut, the nearer shot is shown. In a fade, these are the splats of the image with more weight.
        """
        return max(self._prepared.weighted_splats(t), key=lambda part: part[0])[1]

    def frame(self, t: float) -> UInt8[np.ndarray, "height width channels"]:
        """The image at time t; in the gap of a cut the nearer shot's."""
        return to_bytes(self.image(t))

    def frames(
        self, times: Float[np.ndarray, "frames"] | None = None
    ) -> Iterator[UInt8[np.ndarray, "height width channels"]]:
        """The images at `times` (default: the model's frame times), one by one."""
        chosen = np.asarray(self.model.frame_times.times() if times is None else times)
        require(chosen.ndim == 1, "times", expected="a list of times in [0, 1]", got=short_repr(times))
        for t in chosen:
            check_time(t, "times")
        return (self.frame(float(t)) for t in chosen)

    def image(self, t: float) -> Float[np.ndarray, "channels height width"]:
        """The image at time t before rounding to 8 bits: planar float32, about [0, 1]."""
        check_time(t)
        first, *others = (self.image_of(splats, weight) for weight, splats in self._prepared.weighted_splats(t))
        return sum(others, start=first)

    def image_of(self, splats: Splats2D, weight: float = 1.0) -> Float[np.ndarray, "channels height width"]:
        """The image of these splats, as `image`, times a weight."""
        color = splats.color
        if len(self._background) > color.shape[-1]:
            color = np.pad(color, ((0, 0), (0, 1)), constant_values=1)  # alpha is the image of ones over zero
        leaves = splats.mean, splats.factor, splats.opacity, color, self._background
        how = {"compositing": self.model.compositing, "options": self.model.options}
        image = cpu.forward(*leaves, self.size, **how).image
        return image if weight == 1 else np.float32(weight) * image


def to_bytes(image: Float[np.ndarray, "channels height width"]) -> UInt8[np.ndarray, "height width channels"]:
    """Planar float32 about [0, 1] to interleaved uint8, rounded and clipped; NaN is 0."""
    channels, height, width = image.shape
    out = np.empty((height, width, channels), np.uint8)
    run_tasks(lambda top: _to_bytes(image, out, top, min(top + ROWS, height)), range(0, height, ROWS))
    return out


@kernel
def _to_bytes(image, out, top, bottom):
    for y in range(top, bottom):
        for x in range(image.shape[2]):
            for c in range(image.shape[0]):
                level = image[c, y, x] * _f(255) + _f(0.5)
                out[y, x, c] = _byte(nb.int32(min(max(level, _f(0)), _f(255))))
