"""Rendering of edited and segmented videos: the methods that both have, on top of `VideoRenderer`."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._runtime import notebook_hooks
from foldgauss.render import RenderOptions, Splats2D
from foldgauss.video.models.background import BLACK, Background
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import check_time, choose_time


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
