"""Tracking by motion and color: carries labels of Gaussians to other frames, and grows a mask from a single pixel."""

from collections.abc import Iterable

import cv2
import numpy as np
import scipy
import skimage
from jaxtyping import Bool, Float, Float32, Int8

from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.selection.contributions import Contributions, FrameContributions

#: A frame is ignored for a Gaussian whose weights there sum to less than this fraction of the sum in its best frame: it
#: is occluded, or about to appear or vanish.
CLEAR = 0.5
#: Neighbors that vote on a label.
VOTERS = 16
#: One unit of difference of position, in longer sides of the frame.
PLACE = 0.03
#: One unit of difference of motion per frame, in longer sides of the frame.
MOTION = 0.004
#: One unit of difference of color, in Delta E.
COLOR = 10.0
#: Standard deviation, in pixels, of the filter after which the colors of an image are compared with a clicked one's: a
#: texture is one color.
BLUR = 1.0
UNKNOWN = -1
OUT = 0
IN = 1


def _render_motion(
    contributions: Contributions, k: int, frame: FrameContributions
) -> Float32[np.ndarray, "2 height width"]:
    """The motion that frame k shows at each pixel, in pixels per frame; 0 where nothing is rendered.

    It is that of the Gaussians' centers within one frame interval, averaged by their weights.
    """
    intervals = np.diff(contributions.times)
    half = intervals[max(k - 1, 0) : k + 1].min(initial=1.0) / 2  # the shorter interval: the other may be a cut
    before, after = (contributions.centers_at(frame.alive, contributions.times[k] + own) for own in (-half, half))
    everyone = frame.render(np.ones((len(frame.alive), 1)))
    return frame.render(after - before) / np.maximum(everyone, 1e-6)


def to_lab(color: Float[np.ndarray, "num 3"]) -> Float32[np.ndarray, "num 3"]:
    """CIELAB of RGB, clipped to [0, 1] as in images."""
    return skimage.color.rgb2lab(np.clip(color, 0, 1)[None]).astype(np.float32)[0]


def color_difference(one: Float[np.ndarray, "num 3"], other: Float[np.ndarray, "3"]) -> Float[np.ndarray, " num"]:
    """Delta E of CIELAB colors. Source: CIEDE2000."""
    return skimage.color.deltaE_ciede2000(one, np.broadcast_to(other, one.shape))


# ------------------------------------------------------------------------------------------------ labels


def propagate_labels(
    contributions: Contributions,
    label: Int8[np.ndarray, " num_gaussians"],
    frames: Iterable[int],
    best: Float[np.ndarray, " num_gaussians"],
) -> Int8[np.ndarray, " num_gaussians"]:
    """Carry labels from `frames` to the other frames of their shots, nearest frames first.

    In the first frame that shows it clearly, an unlabelled Gaussian takes the label of the labelled ones nearest to it
    in position, motion and color. `best`: the sum of each Gaussian's weights in its best frame.
    """
    label = label.copy()
    for k in _frames_outward(contributions, sorted(frames)):
        if (label != UNKNOWN).all():
            break
        if not (label[contributions.at_frame(k).alive] == UNKNOWN).any():
            continue
        frame = contributions.at_frame(k)
        shown, unit = frame.total > 0, max(contributions.size)
        index, total = frame.alive[shown], frame.total[shown]
        own = label[index]
        known, asked = own != UNKNOWN, (own == UNKNOWN) & (total >= CLEAR * best[index])
        if known.any() and asked.any():
            # Those seen where the Gaussian is; its own color may be anything where many overlap.
            motion, color = (
                frame.gather(image)[shown] / total[:, None]
                for image in (_render_motion(contributions, k, frame), frame.trace.image)
            )
            position = frame.splats.mean[shown]
            features = np.hstack([position / (PLACE * unit), motion / (MOTION * unit), to_lab(color) / COLOR])
            label[index[asked]] = _vote(features[known], own[known], features[asked])
    return label


def settle_labels(
    contributions: Contributions, label: Int8[np.ndarray, " num_gaussians"], frames: Iterable[int]
) -> Int8[np.ndarray, " num_gaussians"]:
    """Label the occluded rest by position among the labelled ones, in the frame nearest to each Gaussian's m_t."""
    label, first = label.copy(), label
    rest = np.flatnonzero(first == UNKNOWN)
    nearest = contributions.nearest_frame(rest)
    reached = set(_frames_outward(contributions, sorted(frames)))
    for k in np.unique(nearest):
        frame = contributions.at_frame(k)
        known = first[frame.alive] != UNKNOWN
        if k in reached and known.any():
            asked = rest[nearest == k]
            position = contributions.centers_at(asked, float(contributions.times[k]))
            label[asked] = _vote(frame.splats.mean[known], first[frame.alive[known]], position)
    return label


def _vote(known: np.ndarray, label: np.ndarray, asked: np.ndarray) -> Int8[np.ndarray, " num_asked"]:
    """The majority label of the nearest known points, weighted by inverse distance."""
    num = min(VOTERS, len(known))
    distance, neighbor = scipy.spatial.cKDTree(known).query(asked, list(range(1, num + 1)))
    weight = 1 / (distance + 1e-6)
    return np.where((weight * label[neighbor]).sum(1) > 0.5 * weight.sum(1), IN, OUT).astype(np.int8)


def _frames_outward(contributions: Contributions, frames: list[int]) -> list[int]:
    """The other frames of the shots of `frames`, nearest first."""
    shot = np.concatenate([[0], np.cumsum(np.asarray(is_cut(contributions.times)))])
    distance = {}
    for k in set(range(len(shot))) - set(frames):
        same = [abs(k - one) for one in frames if shot[one] == shot[k]]
        if same:
            distance[k] = min(same)
    return sorted(distance, key=lambda k: (distance[k], k))


# ------------------------------------------------------------------------------------------------ growing


def grow_from_pixel(
    contributions: Contributions, pixel: tuple[int, int], k: int, tolerance: float
) -> Bool[np.ndarray, "height width"] | None:
    """The pixels of frame k linked to one, (row, column), through pixels of its color that move as their neighbors do.

    At motion boundaries the motion seen changes from one object's to the other's within a pixel or two, where it links
    no pixels; those of the color that adjoin the linked ones are added. None if nothing is rendered at the pixel.
    """
    frame, (row, column) = contributions.at_frame(k), pixel
    if not frame.render(np.ones((len(frame.alive), 1)))[0, row, column] > 0:
        return None
    color = to_lab(cv2.GaussianBlur(np.moveaxis(frame.trace.image, 0, -1), (0, 0), BLUR).reshape(-1, 3))
    wanted = color[np.ravel_multi_index(pixel, contributions.size)]
    alike = (color_difference(color, wanted) <= tolerance).reshape(contributions.size)
    alike[row, column] = True
    motion, apart = _render_motion(contributions, k, frame), MOTION * max(contributions.size)
    image = np.ascontiguousarray(np.stack([*motion, np.zeros_like(motion[0])], -1))  # OpenCV takes three channels
    linked = np.pad(np.uint8(~alike), 1, constant_values=1)
    cv2.floodFill(image, linked, (column, row), 0, (apart,) * 3, (apart,) * 3, 4 | cv2.FLOODFILL_MASK_ONLY | 2 << 8)
    return alike & (cv2.dilate(np.uint8(linked == 2), np.ones((3, 3)))[1:-1, 1:-1] > 0)
