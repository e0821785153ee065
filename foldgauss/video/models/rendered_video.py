"""Rendering of videos: the methods that models, edited and segmented videos have, on top of `VideoRenderer`."""

import math
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._numerics.batch import concrete_value
from foldgauss._runtime import notebook_hooks
from foldgauss._runtime.checks import invalid, is_integer, is_within, short_repr
from foldgauss.render import RenderOptions, Splats2D
from foldgauss.video.models.background import BLACK, Background
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.renderer import RenderableVideo, VideoRenderer


def check_time(t: float, name: str = "t", cure: str = "Frame k is at frame_times.times()[k].") -> None:
    """Raise ValueError unless t is one time, in [0, 1] if its value is known."""
    try:
        time = jnp.asarray(t)
        value = concrete_value(time)
    except (TypeError, ValueError):
        raise invalid(name, expected="a time in [0, 1]", got=short_repr(t)) from None
    if time.ndim:
        raise invalid(name, expected="one time in [0, 1]", got=short_repr(t))
    if value is not None and not 0 <= value <= 1:
        raise invalid(name, expected="a time in [0, 1]", got=value, cure=cure)


def choose_time(video: RenderableVideo, time: float | None, frame: int | None, seconds: float | None) -> float:
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
        if not is_integer(frame, -math.inf):
            raise invalid("frame", expected="the number of a frame", got=short_repr(frame), cure=cure)
        if not -num <= frame < num:
            raise IndexError(f"frame: expected a number from {-num} to {num - 1} of {num} frames, got {frame}.")
        position = float(frame % num)
    else:
        if not is_within(seconds, f"[0, {num / video.fps}]"):
            expected = f"seconds in [0, {num / video.fps:g}], as {num} frames at {video.fps:g} a second last"
            raise invalid("seconds", expected=expected, got=short_repr(seconds))
        position = float(min(seconds * video.fps, num - 1))
    times, before = video.frame_times.times(), int(position)
    return times[before] + (position - before) * (times[min(before + 1, num - 1)] - times[before])


class RenderedVideo:
    """A video rendered by `VideoRenderer`; a subclass is a `RenderableVideo`."""

    def render(
        self: Any,
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
        self: Any,
        times: np.ndarray | None = None,
        size: tuple[int, int] | None = None,
        *,
        background: Background = BLACK,
    ) -> Iterator[UInt8[np.ndarray, "height width channels"]]:
        """Images at `times` (default: the frame times) one by one, over `background`, uint8 (height, width, 3);
        (height, width, 4), with premultiplied colors, where it is None."""
        yield from VideoRenderer(self, size, background=background).frames(times)

    def at(self: Any, t: float, size: tuple[int, int] | None = None) -> Splats2D:
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

    _lead: Any

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
