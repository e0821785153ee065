"""Image quality: PSNR and SSIM of frames, by scikit-image."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import skimage

from foldgauss._runtime.checks import require
from foldgauss._runtime.threads import num_threads, run_tasks
from foldgauss.video.models.background import BLACK, check_background, composite
from foldgauss.video.models.renderer import RenderedVideo


def psnr(target: np.ndarray, image: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of two uint8 images; equal images give 100 dB, not infinity.

    Shapes: any, but equal. Raises ValueError where they differ.
    Example: `psnr(clip.frames[0], next(model.frames()))`. Source: scikit-image.
    """
    if np.array_equal(target, image):
        return 100.0
    return float(skimage.metrics.peak_signal_noise_ratio(target, image, data_range=255))


#: Side of SSIM's window in pixels.
SSIM_WINDOW = 11
#: The distance from the window's center to its edge.
SSIM_REACH = 5
#: Pixels of the images that are compared at the same time: SSIM takes 130 bytes for each.
PIXELS_AT_ONCE = 5_000_000


def ssim(target: np.ndarray, image: np.ndarray) -> float:
    """Mean SSIM of two uint8 images (height, width, 3), with the weights of Wang et al. 2004.

    1 is equal. The mean is over pixels whose window of 11 px lies inside the image; shorter sides are mirrored. Raises
    ValueError where sizes differ. Example: `ssim(clip.frames[0], next(model.frames()))`.
    """
    short = [(SSIM_REACH, SSIM_REACH) if length < SSIM_WINDOW else (0, 0) for length in target.shape[:2]]
    pair = (np.pad(one, [*short, (0, 0)], mode="symmetric") for one in (target, image))
    return float(
        skimage.metrics.structural_similarity(
            *pair,
            data_range=255,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            channel_axis=-1,
        )
    )


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Quality of every frame of a model, one entry per frame: `psnr` in dB, `ssim` up to 1, and their means."""

    psnr: tuple[float, ...]
    ssim: tuple[float, ...]

    @property
    def mean_psnr(self) -> float:
        return float(np.mean(self.psnr))

    @property
    def mean_ssim(self) -> float:
        return float(np.mean(self.ssim))


def evaluate(
    model: RenderedVideo,
    frames: np.ndarray,
    on_frame: Callable[[np.ndarray], None] | None = None,
    *,
    background: tuple[float, float, float] = BLACK,
) -> Evaluation:
    """Compare `model` at its frame times with `frames`, uint8 (num_frames, *model.size, 3), or with alpha (..., 4).

    Both are composited over `background`: errors in alpha do not show over black, but over white. Images are rounded to
    8 bits first. `on_frame` is called with each image. `model` is any video; `frames` may also be read lazily, such as
    `foldgauss.io.LazyFrames`. Raises ValueError if the number or size of the frames differs from the model's.

    Example: `evaluate(model, clip.frames).mean_psnr`.
    """
    check_frames(model, frames)
    scores = np.zeros((model.num_frames, 2))

    def score(k: int) -> None:
        scores[k] = psnr(*pairs[k]), ssim(*pairs[k])

    pairs = {}
    at_once = min(num_threads(), max(PIXELS_AT_ONCE // math.prod(model.size), 1))
    for k, image in enumerate(model.frames(background=background)):
        target = np.asarray(frames[k])
        target = target if target.shape[-1] == 3 else composite(target, check_background(background))
        pairs[k] = target, image
        if on_frame is not None:
            on_frame(image)
        if len(pairs) == at_once or k == model.num_frames - 1:
            run_tasks(score, pairs)
            pairs.clear()
    return Evaluation(*map(tuple, scores.T.tolist()))


def check_frames(model: RenderedVideo, frames: np.ndarray) -> None:
    """Raise unless `frames` are uint8 frames of the model's number and size, with or without alpha."""
    expected = (model.num_frames, *model.size)
    shape, dtype = getattr(frames, "shape", None), getattr(frames, "dtype", None)
    require(
        shape is not None and tuple(shape[:-1]) == expected and shape[-1] in (3, 4) and dtype == np.uint8,
        "frames",
        expected=f"uint8 {(*expected, 3)}, or 4 with alpha",
        got=type(frames).__name__ if shape is None else f"{dtype} {shape}",
    )
