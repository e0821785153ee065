"""Rendering of edited and segmented videos: the methods that both have, on top of `VideoRenderer`."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._runtime import notebook_hooks
from foldgauss.video.models.background import BLACK, Background
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import choose_time


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

    def _repr_html_(self) -> str | None:
        """The player, in a notebook; None if its page would be too large or no folded model represents the edits."""
        return notebook_hooks.show("video", self)
