"""Pictures of a fitted video one after another, as fast as the CPU gives them.

Conditioning by the fused twin (`stage`, `conditioning`), blending by the CPU engine, 8-bit pictures in one more pass:
no XLA, and no work for Gaussians that are not alive.
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
from foldgauss.video.models.background import BLACK, check_background

ROWS = 64  # of pixels per task

_f, _byte = nb.float32, nb.uint8


class Prepared(Protocol):
    """A video made ready for pictures of one size, as its `prepare(size)` gives it."""

    def splats(self, t: float) -> Splats2D:
        """The splats of time t, front to back; NumPy leaves."""

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """The pictures whose weighted sum is seen at time t, each as weight and splats; the weights sum to 1.

        Between two shots they are the nearer one's.
        """


class RenderableVideo(Protocol):
    """What all videos have: `VideoModel`, `EditedVideo`, `SegmentedVideo`."""

    size: tuple[int, int]
    fps: float
    options: RenderOptions
    compositing: str
    num_frames: int

    def prepare(self, size: tuple[int, int]) -> Prepared:
        """Made ready to be conditioned many times, for pictures of `size`."""


class VideoRenderer:
    """A video made ready to be drawn many times, at one size: a model, an edited one, or one of segments.

    **Shapes:** pictures are uint8 (height, width, 3). **Units:** times are those of the model, in [0, 1].

    `background`: red, green and blue in [0, 1] behind all splats; black as the fit had it, where frames have no alpha.

    **Example:** `for picture in Playback(model).frames(): ...`

    **Source:** VeGaS eq:vegas_equiv_cond. **Raises:** ValueError for a size that is none, and for a model
    with NaN or infinities in it (its pictures would have holes) or with several envelopes.
    """

    def __init__(
        self,
        model: RenderableVideo,
        size: tuple[int, int] | None = None,
        *,
        background: tuple[float, float, float] = BLACK,
    ):
        self.model = model
        size = model.size if size is None else size
        check_size(size)
        self.size = tuple(size)
        self._prepared = model.prepare(self.size)
        self._background = check_background(background, model.compositing)

    def splats(self, t: float) -> Splats2D:
        """The splats of the Gaussians alive at time t, in pixels of a picture of `size`; NumPy leaves."""
        return self._prepared.splats(t)

    def dominant_splats(self, t: float) -> Splats2D:
        """As `splats`, of what is seen: between two shots the nearer one; in a fade, what is seen more of."""
        return max(self._prepared.weighted_splats(t), key=lambda part: part[0])[1]

    def frame(self, t: float) -> UInt8[np.ndarray, "height width 3"]:
        """The picture at time t; between two shots the nearer one's."""
        return to_bytes(self.image(t))

    def frames(self, times: Float[np.ndarray, "frames"] | None = None) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """The pictures at `times` (default: the model's frame times), one by one."""
        shown = np.asarray(self.model.frame_times.times() if times is None else times)
        close = 1e-6  # sums of steps miss the ends by their rounding
        if shown.ndim != 1 or shown.dtype.kind not in "fiu" or not ((shown >= -close) & (shown <= 1 + close)).all():
            cure = "Frame k is at frame_times.times()[k]."
            raise invalid("times", expected="a list of times in [0, 1]", got=short_repr(times), cure=cure)
        for t in shown:
            yield self.frame(t)

    def image(self, t: float) -> Float[np.ndarray, "3 height width"]:
        """The picture at time t before it is rounded to 8 bits: planar float32, about [0, 1]."""
        (first, splats), *others = self._prepared.weighted_splats(t)
        image = self._drawn(splats)
        if others:
            image = np.float32(first) * image
            for weight, splats in others:
                image += np.float32(weight) * self._drawn(splats)
        return image

    def _drawn(self, splats: Splats2D) -> Float[np.ndarray, "3 height width"]:
        leaves = splats.mean, splats.factor, splats.opacity, splats.color
        drawn = {"compositing": self.model.compositing, "options": self.model.options}
        return cpu.forward(*leaves, self._background, self.size, **drawn).image


def to_bytes(image: Float[np.ndarray, "3 height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """Planar float32 about [0, 1] to interleaved uint8, rounded and clipped; NaN is 0."""
    _, height, width = image.shape
    picture = np.empty((height, width, 3), np.uint8)
    run_tasks(lambda top: _to_bytes(image, picture, top, min(top + ROWS, height)), range(0, height, ROWS))
    return picture


@kernel
def _to_bytes(image, picture, top, bottom):
    for y in range(top, bottom):
        for x in range(image.shape[2]):
            for c in range(3):
                level = image[c, y, x] * _f(255) + _f(0.5)
                picture[y, x, c] = _byte(nb.int32(min(max(level, _f(0)), _f(255))))
