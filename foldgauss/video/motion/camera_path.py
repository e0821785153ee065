"""The path of the camera: affine maps between the frames of a video, estimated from optical flow."""

import dataclasses
import itertools
from collections.abc import Callable

import cv2
import numpy as np
import scipy.linalg
from jaxtyping import Float

from foldgauss._runtime.checks import is_within, require
from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.models.renderer import RenderedVideo, VideoRenderer
from foldgauss.video.motion.optical_flow import both_flows, fit_size, match_points

#: The longer side, in pixels, of the images that flow is computed on.
SIDE = 480
#: The distance of the points in these images, in pixels.
SPACING = 6
#: A point is used where forward and backward flow agree within this many pixels,
MISS = 0.3
#: and this fraction of the distance.
MISS_FRACTION = 0.05
#: RANSAC: a point follows the camera within this many pixels.
INLIER = 0.7
#: RANSAC: iterations at most.
ITERATIONS = 2000
#: The largest zoom from one frame to the next, and its inverse.
MOST_ZOOM = 2.0
#: The camera's motion between two frames is unknown where less than this fraction of the points is tracked and agrees.
#: (Between frames of two clips it was 0.02 at most; in a walk through a room, past people close by, 0.2 at least.)
LEAST_INLIERS = 0.08
#: Smoothing reaches so many standard deviations to either side.
REACH = 3.0


@dataclasses.dataclass(frozen=True)
class CameraPath:
    """The motion of the background through the frames of a video, as seen in the image.

    Shapes: `matrices` (num_frames, 3, 3), affine maps of points (x, y, 1) of the first frame of a shot to each frame of
    it, so that the identity begins each shot; `inliers` (num_frames,), the fraction of the points of a grid that follow
    the map from the frame before, 1 for the first frame of a shot; `times` (num_frames,) in [0, 1]. A shot begins at
    each of `starts`: at the first frame, after cuts, and where the motion from the frame before is unknown.
    Units: model space, where the frame's center is the origin and its longer side has length 1.
    """

    matrices: Float[np.ndarray, "frames 3 3"]
    inliers: Float[np.ndarray, " frames"]
    times: Float[np.ndarray, " frames"]
    starts: tuple[int, ...] = (0,)

    @property
    def num_frames(self) -> int:
        return len(self.times)

    @property
    def shots(self) -> list[tuple[int, int]]:
        """The first frame of each shot and the one after its last."""
        return list(itertools.pairwise([*self.starts, self.num_frames]))

    def between(self, frame: int, other: int) -> Float[np.ndarray, "3 3"]:
        """The map of points of one frame to another of the same shot."""
        return self.matrices[other] @ np.linalg.inv(self.matrices[frame])

    def held(self) -> Float[np.ndarray, "frames 3 3"]:
        """The maps of each frame to the middle frame of its shot: the camera stands still."""
        pairs = ((k, (first + stop - 1) // 2) for first, stop in self.shots for k in range(first, stop))
        return np.stack([self.between(*pair) for pair in pairs])

    def smoothed(self, frames: float) -> Float[np.ndarray, "frames 3 3"]:
        """The maps of each frame to where a smoother path would show it.

        The logarithms of the maps from frame to frame are summed, and convolved with a Gaussian of `frames` standard
        deviation. Beyond the ends of a shot they are continued by point reflection: a camera that moves, turns and
        zooms at constant speed is left as it is. Raises ValueError unless `frames` > 0.
        Source: Liu et al. 2013, Bundled Camera Paths, without their mesh.
        """
        require(is_within(frames, "(0, inf)"), "frames", expected="a number > 0", got=frames)
        reach = int(np.ceil(REACH * frames))
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / frames) ** 2)
        weights /= weights.sum()
        maps = np.empty_like(self.matrices)
        for first, stop in self.shots:
            logarithms = (np.real(scipy.linalg.logm(self.between(k - 1, k))) for k in range(first + 1, stop))
            path = np.cumsum([np.zeros((3, 3)), *logarithms], axis=0)
            longer = np.pad(path, ((reach, reach), (0, 0), (0, 0)), mode="reflect", reflect_type="odd")
            smooth = np.stack([np.tensordot(weights, longer[k : k + len(weights)], 1) for k in range(len(path))])
            maps[first:stop] = scipy.linalg.expm(smooth - path)
        return maps


def estimate_camera_path(video: RenderedVideo, *, on_frame: Callable[[], None] = lambda: None) -> CameraPath:
    """The path of the camera in a video, from the optical flow between its own images at the frame times.

    The camera is what most of the image agrees on: affine maps by RANSAC, so that objects that move on their own and
    cover less than half of the image have no effect. Where too few points agree, another shot begins. `on_frame` is
    called after each frame.

    **Example:** `estimate_camera_path(model).smoothed(frames=12)`.
    **Source:** Kroeger et al. 2016 (DIS flow); Fischler and Bolles 1981 (RANSAC).
    """
    size = fit_size(SIDE, *video.size)[::-1]
    times = np.asarray(video.frame_times.times(), np.float64)
    cut = np.asarray(is_cut(times))
    matrices, inliers, starts = np.tile(np.eye(3), (len(times), 1, 1)), np.ones(len(times)), []
    to_model = pixels_to_model(size)
    to_pixels = np.linalg.inv(to_model)
    before = None
    for k, image in enumerate(VideoRenderer(video, size).frames(times.astype(np.float32))):
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found = None
        if k and not cut[k - 1]:
            points, target, known = match_points(*both_flows(before, gray), SPACING, MISS, MISS_FRACTION)
            found = fit_affine(points[known], target[known], INLIER, LEAST_INLIERS * len(points))
        if found is None:
            starts.append(k)
        else:
            inliers[k] = found[1] / len(points)
            matrices[k] = to_model @ found[0] @ to_pixels @ matrices[k - 1]
        before = gray
        on_frame()
    return CameraPath(matrices, inliers, times, tuple(starts))


def fit_affine(
    points: Float[np.ndarray, "num 2"], target: Float[np.ndarray, "num 2"], inlier: float, least: float
) -> tuple[Float[np.ndarray, "3 3"], int] | None:
    """The affine map that most points follow to `target` within a distance of `inlier`, and how many do.

    None if fewer than `least` do, or if the map mirrors or zooms by more than `MOST_ZOOM`.
    """
    if len(points) < max(least, 3):
        return None
    affine, used = cv2.estimateAffine2D(
        points, target, ransacReprojThreshold=inlier, maxIters=ITERATIONS, confidence=0.9999
    )
    if affine is None or not np.isfinite(affine).all() or used.sum() < least:  # NaN: all points on a line
        return None
    zooms = np.linalg.svd(affine[:, :2], compute_uv=False)
    if np.linalg.det(affine[:, :2]) <= 0 or zooms.max() > MOST_ZOOM or zooms.min() < 1 / MOST_ZOOM:
        return None
    return np.vstack([affine, [0, 0, 1]]), int(used.sum())


def pixels_to_model(size: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """The map of OpenCV's pixels, whose centers are whole numbers, to model space."""
    height, width = size
    unit = max(size)
    return np.array([[1, 0, 0.5 - width / 2], [0, 1, 0.5 - height / 2], [0, 0, unit]]) / unit
