"""Rendering of a video's frames on the CPU: 8-bit images at any times.

Conditioning uses the fused kernels (`conditioning`) and blending the CPU engine: no XLA, and no work for Gaussians that
are not alive.
"""

from collections.abc import Iterator
from typing import Protocol

import numba as nb
import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._runtime.checks import invalid, short_repr
from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import RenderOptions, Splats2D, cpu
from foldgauss.render.splats import check_size
from foldgauss.video.models.background import BLACK, Background, check_background

ROWS = 64  # of pixels per task

_f = nb.float32
_byte = nb.uint8


class PreparedVideo(Protocol):
    """A video prepared for images of one size, by its `prepare(size)`."""

    def splats(self, t: float) -> Splats2D:
        """The splats of time t, front to back; NumPy leaves."""

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """The splats of the images whose weighted sum is the frame at time t, with the weights, which sum to 1.

        In the gap of a cut they are those of the nearer shot.
        """


class RenderableVideo(Protocol):
    """The interface of all videos: `VideoModel`, `EditedVideo`, `SegmentedVideo`."""

    size: tuple[int, int]
    fps: float
    options: RenderOptions
    compositing: str
    num_frames: int

    def prepare(self, size: tuple[int, int]) -> PreparedVideo:
        """Prepared for conditioning on many times, for images of `size`."""


class VideoRenderer:
    """Renders a video at one size and many times: a model, an edited video, or one in segments.

    **Shapes:** images are uint8 (height, width, 3), or (height, width, 4) without a background. **Units:** times are
    those of the model, in [0, 1].

    `background`: red, green and blue in [0, 1] behind all splats; black, as in a fit of frames without alpha; None for
    images with alpha, whose colors are premultiplied.

    **Example:** `for image in VideoRenderer(model).frames(): ...`

    **Source:** VeGaS eq:vegas_equiv_cond. **Raises:** ValueError for an invalid size, and for a model with NaN or
    infinities or with several envelopes.
    """

    def __init__(
        self,
        model: RenderableVideo,
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
        """The splats of the Gaussians alive at time t, in pixels of an image of `size`; NumPy leaves."""
        return self._prepared.splats(t)

    def dominant_splats(self, t: float) -> Splats2D:
        """As `splats`, but of the nearer shot in the gap of a cut, and of the heavier image in a fade."""
        return max(self._prepared.weighted_splats(t), key=lambda part: part[0])[1]

    def frame(self, t: float) -> UInt8[np.ndarray, "height width channels"]:
        """The image at time t; in the gap of a cut the nearer shot's."""
        return to_bytes(self.image(t))

    def frames(
        self, times: Float[np.ndarray, "frames"] | None = None
    ) -> Iterator[UInt8[np.ndarray, "height width channels"]]:
        """The images at `times` (default: the model's frame times), one by one."""
        chosen = np.asarray(self.model.frame_times.times() if times is None else times)
        close = 1e-6  # rounding of summed steps
        if chosen.ndim != 1 or chosen.dtype.kind not in "fiu" or not ((chosen >= -close) & (chosen <= 1 + close)).all():
            cure = "Frame k is at frame_times.times()[k]."
            raise invalid("times", expected="a list of times in [0, 1]", got=short_repr(times), cure=cure)
        for t in chosen:
            yield self.frame(t)

    def image(self, t: float) -> Float[np.ndarray, "channels height width"]:
        """The image at time t before rounding to 8 bits: planar float32, about [0, 1]."""
        (first, splats), *others = self._prepared.weighted_splats(t)
        image = self._render(splats)
        if others:
            image = np.float32(first) * image
            for weight, splats in others:
                image += np.float32(weight) * self._render(splats)
        return image

    def _render(self, splats: Splats2D) -> Float[np.ndarray, "channels height width"]:
        color = splats.color
        if len(self._background) > color.shape[-1]:
            color = np.pad(color, ((0, 0), (0, 1)), constant_values=1)  # alpha is the image of ones over zero
        leaves = splats.mean, splats.factor, splats.opacity, color
        model = self.model
        return cpu.forward(
            *leaves, self._background, self.size, compositing=model.compositing, options=model.options
        ).image


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
