"""Pictures of a fitted video one after another, as fast as the CPU gives them.

Conditioning by the fused twin (`conditioning`), blending by the CPU engine, 8-bit pictures in one more pass: no XLA,
and no work for Gaussians that are not alive.
"""

from collections.abc import Iterator

import numba as nb
import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._checks import invalid
from foldgauss._kernels import kernel
from foldgauss._threads import run_tasks
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import Splats2D, cpu
from foldgauss.render.splats import check_size
from foldgauss.video.alpha import BLACK, checked_background
from foldgauss.video.conditioning import Shape, condition, update_windows
from foldgauss.video.model import VideoModel
from foldgauss.video.packing import pack
from foldgauss.video.shots import out_of_cuts

ROWS = 64  # of pixels per task

_f, _byte = nb.float32, nb.uint8


class Playback:
    """A model made ready to be drawn many times, at one size.

    **Shapes:** pictures are uint8 (height, width, 3). **Units:** times are those of the model, in [0, 1].

    `background`: red, green and blue in [0, 1] behind all splats; black as the fit had it, where frames have no alpha.

    **Example:** `for picture in Playback(model).frames(): ...`

    **Source:** VeGaS eq:vegas_equiv_cond. **Raises:** ValueError for a size that is none, and for a model
    with NaN or infinities in it (its pictures would have holes) or with several envelopes.
    """

    def __init__(
        self,
        model: VideoModel,
        size: tuple[int, int] | None = None,
        *,
        background: tuple[float, float, float] = BLACK,
    ):
        self.model = model
        size = model.size if size is None else size
        check_size(size)
        self.size = tuple(size)
        self._rows = pack(model.splats)
        broken = int((~np.isfinite(self._rows)).any(-1).sum())
        if broken:
            got, cure = f"{broken:,} Gaussians that have none", "The fit diverged, or the model was edited: fit again."
            raise invalid("model", expected="finite numbers", got=got, cure=cure)
        power, floor = (_the_one(model.splats.envelope, name) for name in ("power", "floor"))
        height, width = model.size
        self._shape = Shape(model.splats.degree, power, floor, self.size, aspect=height / width)
        self._window = np.empty((len(self._rows), 2), np.float32)
        update_windows(self._rows, np.arange(len(self._rows)), self._window)
        self._times = np.asarray(model.frame_times.times())
        self._background = checked_background(background, model.compositing)

    def splats(self, t: float) -> Splats2D:
        """The splats of the Gaussians alive at time t, in pixels of a picture of `size`; NumPy leaves."""
        done = condition(self._rows, self._window, t, self._shape)
        return Splats2D(done.mean, done.factor, done.opacity, done.color)

    def frame(self, t: float) -> UInt8[np.ndarray, "height width 3"]:
        """The picture at time t; between two shots the nearer one's."""
        return to_bytes(self._image(out_of_cuts(t, self._times)))

    def frames(self, times: Float[np.ndarray, "frames"] | None = None) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """The pictures at `times` (default: the model's frame times), one by one."""
        for t in np.asarray(self._times if times is None else times):
            yield self.frame(t)

    def _image(self, t: float) -> Float[np.ndarray, "3 height width"]:
        splats = self.splats(t)
        leaves = splats.mean, splats.factor, splats.opacity, splats.color
        drawn = {"compositing": self.model.compositing, "options": self.model.options}
        return cpu.forward(*leaves, self._background, self.size, **drawn).image


def _the_one(envelope: TimeLikelihood, name: str) -> float:
    """The number that all Gaussians share."""
    values = np.unique(np.asarray(getattr(envelope, name)))
    if values.size != 1:
        got = f"{values.size} different ones"
        cure = "Use VideoModel.render, which knows an envelope of each Gaussian's own."
        raise invalid(f"model.splats.envelope.{name}", expected="one number for all Gaussians", got=got, cure=cure)
    return float(values[0])


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
