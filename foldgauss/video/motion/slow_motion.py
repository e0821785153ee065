"""Images between frames: the video's own, averaged with what optical flow predicts from its images at the frames."""

import functools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, UInt8

from foldgauss.video.models.background import BLACK, Background
from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.models.renderer import RenderedVideo, VideoRenderer
from foldgauss.video.motion.optical_flow import Motion

#: Weight of the prediction by optical flow where both frames agree. Its errors and those of the video's own image are
#: different, so an average is better than each, or as good.
FLOW_WEIGHT = 0.75
#: Mean squared difference of the frames at which the weight is half of that.
HALVING_DIFFERENCE = 4000.0
#: So near to a frame, in intervals, its own image is shown.
NEAR = 1e-3
#: OpenCV moves images with fewer pixels than this on each side.
MAX_SIDE = 2**15 - 1


def interpolate_frames(
    video: RenderedVideo,
    times: Float[np.ndarray, " shown"] | None = None,
    size: tuple[int, int] | None = None,
    *,
    background: Background = BLACK,
) -> Iterator[UInt8[np.ndarray, "height width channels"]]:
    """As `video.frames`, but coherent between frames: slow motion.

    An image between two frames is a weighted average of the video's own and of one that is predicted by optical flow
    from its images at the four frames around. The latter has weight 3/4, and less where the two images beside it, moved
    to it, differ. At frames, at cuts, for images with alpha (`background=None`) and with sides of `MAX_SIDE` pixels or
    more, the image is the video's own. Images between the same two frames should follow each other: the images and the
    flow of an interval and of those beside it are kept.

    Raises ValueError as `VideoRenderer` does. Example: `interpolate_frames(model, interpolated_times(times, 4))`.
    """
    renderer = VideoRenderer(video, size, background=background)
    frame_times = np.asarray(video.frame_times.times(), np.float64)
    shown = frame_times if times is None else np.asarray(times)
    cuts = is_cut(frame_times)
    render = functools.lru_cache(maxsize=4)(lambda k: renderer.frame(frame_times[k]))
    find_flow = functools.lru_cache(maxsize=3)(lambda k: Motion.from_frames(np.stack([render(k), render(k + 1)])))

    @functools.lru_cache(maxsize=1)
    def frames_around(k: int) -> tuple[int, np.ndarray, Motion]:
        """The first of the frames around interval k, these frames, and the flow between them."""
        around = range(max(k - 1, 0), min(k + 3, len(frame_times)))
        return around[0], np.stack(list(map(render, around))), Motion.join(list(map(find_flow, around[:-1])))

    for t, image in zip(shown, renderer.frames(times), strict=True):
        k = min(max(int(np.searchsorted(frame_times, t, side="right")) - 1, 0), len(frame_times) - 1)
        fraction = 0.0
        if image.shape[2] == 3 and max(image.shape) < MAX_SIDE and k + 1 < len(frame_times) and not cuts[k]:
            fraction = (t - frame_times[k]) / (frame_times[k + 1] - frame_times[k])
        if NEAR < fraction < 1 - NEAR:
            first, frames, motion = frames_around(k)
            if k + 1 - first not in motion.cuts:
                predicted = motion.interpolate(frames, k - first, fraction, image.shape[:2])
                weight = (FLOW_WEIGHT / (1 + predicted.difference / HALVING_DIFFERENCE))[..., None]
                image = np.rint(image + weight * (np.clip(predicted.image, 0, 255) - image)).astype(np.uint8)
        yield image
