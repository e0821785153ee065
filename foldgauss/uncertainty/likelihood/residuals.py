"""Residuals of a video: its frames less the images that a model renders at given times."""

from collections.abc import Iterable, Iterator

import numba as nb
import numpy as np
import scipy.sparse
from jaxtyping import Float32, Float64, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import require, short_repr
from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.background import composite
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

_f = nb.float32
_d = nb.float64
_level = np.float32(1 / 255)
BINS = 512


def check_model(model: VideoModel) -> None:
    """ValueError for anything but a VideoModel."""
    cure = ""
    if isinstance(model, EditedVideo):
        cure = "Give the model that was edited, and the clip that it was fitted to; or fit a model to the edited video."
    elif isinstance(model, SegmentedVideo):
        cure = f"{ONE_SEGMENT} Its clip is that segment's frames."
    require(isinstance(model, VideoModel), "model", expected="a VideoModel", got=short_repr(model), cure=cure)


class Residuals:
    """A model and the frames it is compared with, both composited over black.

    Images are rendered as in the fit: without holding frames between shots, rounding or clipping. `frames`: uint8
    (num_frames, *model.size, 3), or with alpha (..., 4). Raises ValueError for anything else.
    """

    def __init__(self, model: VideoModel, frames: UInt8[np.ndarray, "num_frames height width channels"]):
        check_model(model)
        require(
            isinstance(frames, np.ndarray | list | tuple),
            "video",
            expected="an array of frames",
            got=short_repr(frames),
            cure="Of a file: read_video(path, size=model.size).frames.",
        )
        frames = np.asarray(frames)
        fits = frames.ndim == 4 and frames.shape[1:3] == model.size
        require(
            fits and frames.dtype == np.uint8 and frames.shape[3] in (3, 4),
            "video",
            expected="uint8 (frames, {}, {}, 3), as the model was fitted to, or 4 with alpha".format(*model.size),
            got=f"{frames.dtype} {frames.shape}",
            cure="Convert it to 8-bit color." if fits else "Read it at that size.",
        )
        if frames.shape[3] == 4:
            frames = np.stack([composite(frame, np.zeros(3, np.float32)) for frame in frames])
        self.model, self.frames = model, np.ascontiguousarray(frames)
        self.renderer = VideoRenderer(model)

    def render_at(self, times: Iterable[float]) -> Iterator[Float32[np.ndarray, "3 height width"]]:
        """The images of the model at each of `times` in [0, 1], one by one."""
        for t in times:
            yield self.renderer.image_of(self.renderer.splats(float(t)))

    def squared_errors(
        self, image: Float32[np.ndarray, "3 height width"], which: Iterable[int]
    ) -> Float64[np.ndarray, " which"]:
        """Sums over pixels and channels of (frame - image)^2, for the frames `which`."""
        which = np.asarray(which)
        sums = np.empty(len(which))

        def compare(n: int) -> None:
            sums[n] = _squared_error(image, self.frames[which[n]])

        run_tasks(compare, range(len(which)), serial=len(which) * image.size < 400_000)
        return sums

    def residual(self, k: int, image: Float32[np.ndarray, "3 height width"]) -> Float32[np.ndarray, "3 height width"]:
        """Frame k less the image."""
        return np.moveaxis(self.frames[k], -1, 0) * _level - image


def random_projection(num_values: int) -> scipy.sparse.csc_array:
    """A matrix (bins, num_values) that sums values into bins with random signs: it keeps distances to about 6%.

    **Source:** count sketch, Charikar, Chen and Farach-Colton 2002.
    """
    rng = make_generator(Stream.SKETCH)
    bins = rng.integers(0, BINS, num_values, dtype=np.int16)
    signs = rng.choice(np.array([-1, 1], np.float32), num_values)
    return scipy.sparse.csc_array((signs, bins, np.arange(num_values + 1)), (BINS, num_values))


@kernel
def _squared_error(image, frame):
    channels, height, width = image.shape
    total = _d(0)
    for y in range(height):
        row = _f(0)
        for x in range(width):
            for c in range(channels):
                miss = frame[y, x, c] * _level - image[c, y, x]
                row += miss * miss
        total += row
    return total
