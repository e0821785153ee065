"""Tracking by motion and color: carries labels of Gaussians to other frames, and grows a set from a single pixel."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import scipy
import skimage
from jaxtyping import Bool, Float, Float32, Int, Int8

from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.selection.contributions import Contributions, FrameContributions, weighted_mean

#: A frame is ignored for a Gaussian whose weights there sum to less than this fraction of the sum in its best frame: it
#: is occluded, or about to appear or vanish.
CLEAR = 0.5
#: Neighbors that vote on a label.
VOTERS = 16
#: Neighbors that may be linked.
NEIGHBORS = 8
#: One unit of difference of position, in longer sides of the frame.
PLACE = 0.03
#: One unit of difference of motion per frame, in longer sides of the frame.
MOTION = 0.004
#: One unit of difference of color, in Delta E.
COLOR = 10.0
#: Neighbors touch if their centers are within this many times the sum of their standard deviations, plus a pixel.
#: Those at the start of a fit are 0.4 such sums apart.
REACH = 1.5
#: Neighbors move alike if their motions differ by at most `MOTION` plus this fraction of the motion.
MOTION_FRACTION = 0.1
#: Most frames that a set is grown through; a Gaussian lives for several frames, and links them.
GROWN_FRAMES = 48
UNKNOWN = -1
OUT = 0
IN = 1


class Observations(NamedTuple):
    """The Gaussians visible in a frame, and the features that tell them apart.

    Colors and motions are those *seen* where the Gaussian is: the image's, averaged by its weights. The Gaussian's own
    values may be anything where many overlap. A large spread of the motion seen means a motion boundary.
    """

    frame: FrameContributions
    which: Int[np.ndarray, " num"]  # among those alive
    index: Int[np.ndarray, " num"]  # among all
    position: Float32[np.ndarray, "num 2"]  # px
    motion: Float32[np.ndarray, "num 2"]  # px per frame
    spread: Float32[np.ndarray, " num"]  # standard deviation of the motion seen, px per frame
    own_motion: Float32[np.ndarray, "num 2"]  # px per frame
    color: Float32[np.ndarray, "num 3"]  # CIELAB
    total: Float32[np.ndarray, " num"]  # px

    def keep(self, mask: Bool[np.ndarray, " num"]) -> "Observations":
        return Observations(self.frame, *(leaf[mask] for leaf in self[1:]))


def observe(contributions: Contributions, k: int) -> Observations:
    """The visible Gaussians of frame k."""
    frame = contributions.at_frame(k)
    which = np.flatnonzero(frame.total > 0)
    total = frame.total[which]
    everyone = frame.render(np.ones((len(frame.alive), 1)))
    own_motion = _motion(contributions, k, frame)
    flow = frame.render(own_motion) / np.maximum(everyone, 1e-6)
    *motion, square = (frame.gather(np.stack([*flow, (flow * flow).sum(0)]))[which] / total[:, None]).T
    motion = np.stack(motion, -1)
    spread = np.sqrt(np.maximum(square - (motion * motion).sum(1), 0))
    color = to_lab(frame.gather(frame.image)[which] / total[:, None])
    position, own_motion = frame.splats.mean[which], own_motion[which]
    return Observations(frame, which, frame.alive[which], position, motion, spread, own_motion, color, total)


def _motion(contributions: Contributions, k: int, frame: FrameContributions) -> Float32[np.ndarray, "num_alive 2"]:
    """Displacement of each Gaussian's center within one frame interval, in pixels."""
    intervals = np.diff(contributions.times)
    half = intervals[max(k - 1, 0) : k + 1].min(initial=1.0) / 2  # the shorter interval: the other may be a cut
    t = float(contributions.times[k])
    return contributions.centers_at(frame.alive, t + half) - contributions.centers_at(frame.alive, t - half)


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
        seen = observe(contributions, k)
        own = label[seen.index]
        known, asked = own != UNKNOWN, (own == UNKNOWN) & (seen.total >= CLEAR * best[seen.index])
        if known.any() and asked.any():
            unit = max(contributions.size)
            features = np.hstack([seen.position / (PLACE * unit), seen.motion / (MOTION * unit), seen.color / COLOR])
            label[seen.index[asked]] = _vote(features[known], own[known], features[asked])
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
    shot = _shot_numbers(contributions)
    distance = {}
    for k in set(range(len(shot))) - set(frames):
        same = [abs(k - one) for one in frames if shot[one] == shot[k]]
        if same:
            distance[k] = min(same)
    return sorted(distance, key=lambda k: (distance[k], k))


def _shot_numbers(contributions: Contributions) -> Int[np.ndarray, " num_frames"]:
    return np.concatenate([[0], np.cumsum(np.asarray(is_cut(contributions.times)))])


# ------------------------------------------------------------------------------------------------ growing


def grow_from_pixel(
    contributions: Contributions, pixel: tuple[int, int], k: int, tolerance: float
) -> Bool[np.ndarray, " num_gaussians"] | None:
    """The Gaussians of a pixel's color, linked to it (row, column, in frame k) through neighbors that move alike.

    None if nothing is rendered at the pixel.
    """
    here, (row, column) = contributions.at_frame(k), pixel
    point = np.zeros((1, *contributions.size), np.float32)
    point[0, row, column] = 1
    weight = here.gather(point)[:, 0]
    if not (weight > 0).any():
        return None
    seen = [observe(contributions, n) for n in _sample_frames(contributions, k)]
    wanted = to_lab(here.image[:, row, column][None])[0]
    observations = ((one.index, one.color, one.total) for one in seen)
    color, alike = weighted_mean(contributions.num_gaussians, observations)
    alike[alike] = color_difference(color[alike], wanted) <= tolerance
    of_color = np.where(alike[here.alive], weight, 0)
    seed = here.alive[np.argmax(of_color if of_color.any() else weight)]
    alike[seed] = True
    pairs = _find_pairs(contributions, seen, alike)
    inside = _find_linked(contributions.num_gaussians, pairs, seed)
    return inside | _assign_boundary(contributions.num_gaussians, pairs, inside)


def _sample_frames(contributions: Contributions, k: int) -> list[int]:
    """At most `GROWN_FRAMES` evenly spaced frames of the shot of frame k, including k."""
    shot = _shot_numbers(contributions)
    own = np.flatnonzero(shot == shot[k])
    step = -(-len(own) // GROWN_FRAMES)
    return list(range(own[0] + (k - own[0]) % step, own[-1] + 1, step))


class _Pairs(NamedTuple):
    """Indices of neighbors that touch, in both orders, of all frames in turn."""

    one: Int[np.ndarray, " num"]
    other: Int[np.ndarray, " num"]
    firm: Bool[np.ndarray, " num"]  # neither is at a motion boundary
    alike: Bool[np.ndarray, " num"]  # the motions seen are alike
    gap: Float32[np.ndarray, " num"]  # own motion of one to the other's, px per frame; NaN if other is at a boundary


def _find_linked(num: int, pairs: _Pairs, seed: int) -> Bool[np.ndarray, " num_gaussians"]:
    """The Gaussians linked to the seed by firm pairs that move alike in most of the frames in which they touch.

    Links do not pass through Gaussians at motion boundaries: there the motion seen changes gradually from one object's
    to the other's.
    """
    one, other = pairs.one[pairs.firm], pairs.other[pairs.firm]
    votes = scipy.sparse.coo_array(
        (np.where(pairs.alike[pairs.firm], 1.0, -1.0), (one, other)), shape=(num, num)
    ).tocsr()
    votes.data[votes.data < 0] = 0
    votes.eliminate_zeros()
    _, part = scipy.sparse.csgraph.connected_components(votes, directed=False)
    return part == part[seed]


def _assign_boundary(
    num: int, pairs: _Pairs, inside: Bool[np.ndarray, " num_gaussians"]
) -> Bool[np.ndarray, " num_gaussians"]:
    """Gaussians always at motion boundaries whose own motion is nearer to their neighbors' inside than outside."""
    free = np.ones(num, bool)
    free[pairs.one[pairs.firm]] = False
    gaps = []
    for side in (inside, ~inside):
        which = side[pairs.other] & ~np.isnan(pairs.gap)
        count = np.bincount(pairs.one[which], minlength=num)
        total = np.bincount(pairs.one[which], pairs.gap[which], minlength=num)
        gaps.append(np.divide(total, count, out=np.full(num, np.inf), where=count > 0))
    return free & (gaps[0] < gaps[1])


def _find_pairs(
    contributions: Contributions, seen: list[Observations], among: Bool[np.ndarray, " num_gaussians"]
) -> _Pairs:
    """All pairs of Gaussians of `among`, in the frames that show both clearly: motion seen is that of the front."""
    best = np.zeros(contributions.num_gaussians)
    for one in seen:
        best[one.index] = np.maximum(best[one.index], one.total)
    clear = (one.keep(among[one.index] & (one.total >= CLEAR * best[one.index])) for one in seen)
    found = [_find_touching(one, MOTION * max(contributions.size)) for one in clear if len(one.index)]
    return _Pairs(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _find_touching(seen: Observations, motion: float) -> _Pairs:
    """The pairs of one frame."""
    num = min(NEIGHBORS + 1, len(seen.index))  # each point is its own nearest neighbor
    radius = np.abs(np.linalg.det(seen.frame.splats.factor[seen.which])) ** 0.5
    distance, other = scipy.spatial.cKDTree(seen.position).query(seen.position, list(range(1, num + 1)))
    one = np.broadcast_to(np.arange(len(other))[:, None], other.shape)
    near = (distance <= REACH * (radius[one] + radius[other]) + 1) & (one != other)
    one, other = one[near], other[near]
    firm = seen.spread <= motion + MOTION_FRACTION * np.hypot(*seen.motion.T)
    alike = _moves_alike(seen.motion[one], seen.motion[other], motion)
    gap = np.where(firm[other], np.hypot(*(seen.own_motion[one] - seen.motion[other]).T), np.nan)
    return _Pairs(seen.index[one], seen.index[other], firm[one] & firm[other], alike, gap)


def _moves_alike(
    one: Float[np.ndarray, "num 2"], other: Float[np.ndarray, "num 2"], motion: float
) -> Bool[np.ndarray, " num"]:
    speed = np.maximum(np.hypot(*one.T), np.hypot(*other.T))
    return np.hypot(*(one - other).T) <= motion + MOTION_FRACTION * speed
