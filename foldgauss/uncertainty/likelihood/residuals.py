"""Residuals of a video: its frames less the images that a model renders at given times."""

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numba as nb
import numpy as np
import scipy.sparse
from jaxtyping import Float32, Float64, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import invalid, is_integer, short_repr
from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.render import cpu
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.background import BLACK, composite
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

_f = nb.float32
_d = nb.float64
_level = np.float32(1 / 255)
_behind = np.asarray(BLACK, np.float32)
BINS = 512
BATCH = 8  # images rendered at once, for fewer synchronizations of threads


def _batched(times: Iterable[float]) -> Iterator[tuple[float, ...]]:
    """`itertools.batched`, which Python 3.11 lacks."""
    times = iter(times)
    while some := tuple(itertools.islice(times, BATCH)):
        yield some


def check_model(model: VideoModel) -> None:
    """ValueError for anything but a VideoModel."""
    if isinstance(model, VideoModel):
        return
    cure = ""
    if isinstance(model, EditedVideo):
        cure = "Give the model that was edited, and the clip that it was fitted to; or fit a model to the edited video."
    elif isinstance(model, SegmentedVideo):
        cure = f"{ONE_SEGMENT} Its clip is that segment's frames."
    raise invalid("model", expected="a VideoModel", got=short_repr(model), cure=cure)


def check_frames(frames: Sequence[int] | None, num_frames: int) -> list[int]:
    """Different frames between the first and the last one, whose times are fixed; None: all of them."""
    inner = range(1, num_frames - 1)
    if frames is None:
        return list(inner)
    chosen = list(frames) if isinstance(frames, Sequence | np.ndarray) else []
    if not chosen or not all(is_integer(k, 1) and k in inner for k in chosen) or len({*chosen}) < len(chosen):
        cure = "The first frame is at 0 and the last at 1. One frame is `[k]`."
        raise invalid("frames", expected=f"different frames from 1 to {inner[-1]}", got=short_repr(frames), cure=cure)
    return chosen


class Residuals:
    """A model and the frames it is compared with, both composited over black.

    Images are rendered as in the fit: without holding frames between shots, rounding or clipping. `frames`: uint8
    (num_frames, *model.size, 3), or with alpha (..., 4). Raises ValueError for anything else.
    """

    def __init__(self, model: VideoModel, frames: UInt8[np.ndarray, "num_frames height width channels"]):
        check_model(model)
        if not isinstance(frames, np.ndarray | list | tuple):
            cure = "Of a file: read_video(path, size=model.size).frames."
            raise invalid("video", expected="an array of frames", got=short_repr(frames), cure=cure)
        frames = np.asarray(frames)
        if (
            frames.dtype != np.uint8
            or frames.ndim != 4
            or frames.shape[1:3] != model.size
            or frames.shape[3] not in (3, 4)
        ):
            expected = (
                f"uint8 (frames, {model.size[0]}, {model.size[1]}, 3), as the model was fitted to, or 4 with alpha"
            )
            fits = frames.ndim == 4 and frames.shape[1:3] == model.size
            cure = "Convert it to 8-bit color." if fits else "Read it at that size."
            raise invalid("video", expected=expected, got=f"{frames.dtype} {frames.shape}", cure=cure)
        if frames.shape[3] == 4:
            frames = np.stack([composite(frame, np.zeros(3, np.float32)) for frame in frames])
        self.model, self.frames = model, np.ascontiguousarray(frames)
        self.renderer = VideoRenderer(model)

    @property
    def num_values(self) -> int:
        """Values per frame: pixels times channels."""
        return int(np.prod(self.frames.shape[1:]))

    def render_at(self, times: Iterable[float]) -> Iterator[Float32[np.ndarray, "3 height width"]]:
        """The images of the model at each of `times` in [0, 1], one by one."""
        how = {"compositing": self.model.compositing, "options": self.model.options}
        for some in _batched(times):
            alive = [self.renderer.splats(float(t)) for t in some]
            images = {}

            def draw(k: int, alive=alive, images=images) -> None:
                one = alive[k]
                leaves = one.mean, one.factor, one.opacity, one.color, _behind
                images[k] = cpu.forward(*leaves, self.model.size, **how).image

            run_tasks(draw, range(len(alive)))
            yield from (images[k] for k in range(len(alive)))

    def squared_errors(
        self, image: Float32[np.ndarray, "3 height width"], which: Iterable[int]
    ) -> Float64[np.ndarray, " which"]:
        """Sums over pixels and channels of (frame - image)^2, for the frames `which`."""
        which = np.asarray(which)
        sums = np.empty(len(which))

        def compare(n: int) -> None:
            sums[n] = _squared_error(image, self.frames[which[n]])

        run_tasks(compare, range(len(which)), serial=len(which) * self.num_values < 400_000)
        return sums

    def residual(self, k: int, image: Float32[np.ndarray, "3 height width"]) -> Float32[np.ndarray, "3 height width"]:
        """Frame k less the image."""
        return np.moveaxis(self.frames[k], -1, 0) * _level - image


class Sketches:
    """Random projections of images that keep distances to about 6%: values are summed into bins with random signs.

    **Source:** count sketch, Charikar, Chen and Farach-Colton 2002.
    """

    def __init__(self, num_values: int):
        rng = make_generator(Stream.SKETCH)
        bins = rng.integers(0, BINS, num_values, dtype=np.int16)
        signs = rng.choice(np.array([-1, 1], np.float32), num_values)
        self._projection = scipy.sparse.csc_array((signs, bins, np.arange(num_values + 1)), (BINS, num_values))

    def sketch(self, image: Float32[np.ndarray, "3 height width"]) -> Float32[np.ndarray, " bins"]:
        return self._projection @ image.reshape(-1)


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
