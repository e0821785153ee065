"""What moves together: sets of Gaussians followed into frames that nobody marked, or grown from a single one."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import scipy
import skimage
from jaxtyping import Bool, Float, Float32, Int, Int8

from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.selection.contributions import Contributions, Light, weighted_mean

#: A frame in which a Gaussian's weights sum to less than this share of what they come to in its best frame shows too
#: little of it to judge it by: it is behind others there, or about to come or go.
CLEAR = 0.5
#: Neighbours that are asked for a label, and those that may be linked.
VOTERS, NEIGHBOURS = 16, 8
#: What counts as one unit of difference: of place and of motion per frame, in longer sides of the frame; of colour, in
#: Delta E.
PLACE, MOTION, COLOR = 0.03, 0.004, 10.0
#: Neighbours touch where their centres are no farther apart than this many times the sum of their standard deviations,
#: and a pixel. Those of a fit start 0.4 such sums apart.
REACH = 1.5
#: Neighbours move alike where their motion differs by `MOTION`, and this share of itself.
MOTION_SHARE = 0.1
#: Frames that a set is grown through, at most: growing passes through Gaussians, which live for some frames.
GROWN_FRAMES = 48
UNKNOWN, OUT, IN = -1, 0, 1


class Traits(NamedTuple):
    """The Gaussians seen in a frame, and what they are told apart by.

    Colours and motions are those *seen* where the Gaussian is: the picture's, averaged by its weights. Its own may be
    anything where many Gaussians overlap. Where the motion seen is not one, the Gaussian stands at a border.
    """

    light: Light
    which: Int[np.ndarray, " num"]  # of those alive
    index: Int[np.ndarray, " num"]  # of all
    position: Float32[np.ndarray, "num 2"]  # px
    motion: Float32[np.ndarray, "num 2"]  # px per frame
    spread: Float32[np.ndarray, " num"]  # of the motion seen: its standard deviation, px per frame
    own_motion: Float32[np.ndarray, "num 2"]  # px per frame
    color: Float32[np.ndarray, "num 3"]  # CIELAB
    total: Float32[np.ndarray, " num"]  # px

    def those(self, keep: Bool[np.ndarray, " num"]) -> "Traits":
        """Some of them."""
        return Traits(self.light, *(leaf[keep] for leaf in self[1:]))


def traits(lit: Contributions, k: int) -> Traits:
    """What is seen in frame k."""
    light = lit.frame(k)
    which = np.flatnonzero(light.total > 0)
    total = light.total[which]
    everyone = light.drawn(np.ones((len(light.alive), 1)))
    own_motion = _motion(lit, k, light)
    flow = light.drawn(own_motion) / np.maximum(everyone, 1e-6)
    *motion, square = (light.gathered(np.stack([*flow, (flow * flow).sum(0)]))[which] / total[:, None]).T
    motion = np.stack(motion, -1)
    spread = np.sqrt(np.maximum(square - (motion * motion).sum(1), 0))
    color = lab(light.gathered(light.picture)[which] / total[:, None])
    position, own_motion = light.splats.mean[which], own_motion[which]
    return Traits(light, which, light.alive[which], position, motion, spread, own_motion, color, total)


def _motion(lit: Contributions, k: int, light: Light) -> Float32[np.ndarray, "num_alive 2"]:
    """How far each Gaussian's centre goes in the time of a frame, in pixels."""
    intervals = np.diff(lit.times)
    half = intervals[max(k - 1, 0) : k + 1].min(initial=1.0) / 2  # not that of a cut
    t = float(lit.times[k])
    return lit.position(light.alive, t + half) - lit.position(light.alive, t - half)


def lab(color: Float[np.ndarray, "num 3"]) -> Float32[np.ndarray, "num 3"]:
    """CIELAB of RGB as shown: held to [0, 1], as pictures are."""
    return skimage.color.rgb2lab(np.clip(color, 0, 1)[None]).astype(np.float32)[0]


def difference(one: Float[np.ndarray, "num 3"], other: Float[np.ndarray, "3"]) -> Float[np.ndarray, " num"]:
    """Delta E of CIELAB colours. Source: CIEDE2000."""
    return skimage.color.deltaE_ciede2000(one, np.broadcast_to(other, one.shape))


# ------------------------------------------------------------------------------------------------ following


def followed(
    lit: Contributions,
    label: Int8[np.ndarray, " num_gaussians"],
    frames: Iterable[int],
    best: Float[np.ndarray, " num_gaussians"],
) -> Int8[np.ndarray, " num_gaussians"]:
    """Labels carried on from `frames` to the other ones of the same shots, the nearest first.

    Whoever is unknown, once seen clearly, joins those known that are most like it in place, motion and colour there.
    `best`: the sum of each Gaussian's weights in its best frame.
    """
    label = label.copy()
    for k in _outward(lit, sorted(frames)):
        if (label != UNKNOWN).all():
            break
        if not (label[lit.frame(k).alive] == UNKNOWN).any():
            continue
        seen = traits(lit, k)
        own = label[seen.index]
        known, asked = own != UNKNOWN, (own == UNKNOWN) & (seen.total >= CLEAR * best[seen.index])
        if known.any() and asked.any():
            unit = max(lit.size)
            like = np.hstack([seen.position / (PLACE * unit), seen.motion / (MOTION * unit), seen.color / COLOR])
            label[seen.index[asked]] = _voted(like[known], own[known], like[asked])
    return label


def settled(
    lit: Contributions, label: Int8[np.ndarray, " num_gaussians"], frames: Iterable[int]
) -> Int8[np.ndarray, " num_gaussians"]:
    """The rest of the labels, of those hidden: by the place of those known, in the frame next to their own time."""
    label, first = label.copy(), label
    rest = np.flatnonzero(first == UNKNOWN)
    home = lit.nearest_frame(rest)
    reached = set(_outward(lit, sorted(frames)))
    for k in np.unique(home):
        light = lit.frame(k)
        known = first[light.alive] != UNKNOWN
        if k in reached and known.any():
            asked = rest[home == k]
            place = lit.position(asked, float(lit.times[k]))
            label[asked] = _voted(light.splats.mean[known], first[light.alive[known]], place)
    return label


def _voted(known: np.ndarray, label: np.ndarray, asked: np.ndarray) -> Int8[np.ndarray, " num_asked"]:
    """The label of most of the nearest of those known, the nearer the more."""
    num = min(VOTERS, len(known))
    distance, who = scipy.spatial.cKDTree(known).query(asked, list(range(1, num + 1)))
    weight = 1 / (distance + 1e-6)
    return np.where((weight * label[who]).sum(1) > 0.5 * weight.sum(1), IN, OUT).astype(np.int8)


def _outward(lit: Contributions, frames: list[int]) -> list[int]:
    """The frames beside `frames`, in their shots, nearest first."""
    shot = _shots(lit)
    away = {}
    for k in set(range(len(shot))) - set(frames):
        same = [abs(k - one) for one in frames if shot[one] == shot[k]]
        if same:
            away[k] = min(same)
    return sorted(away, key=lambda k: (away[k], k))


def _shots(lit: Contributions) -> Int[np.ndarray, " num_frames"]:
    """The number of each frame's shot."""
    return np.concatenate([[0], np.cumsum(np.asarray(is_cut(lit.times)))])


# -------------------------------------------------------------------------------------------------- growing


def grown(
    lit: Contributions, pixel: tuple[int, int], k: int, tolerance: float
) -> Bool[np.ndarray, " num_gaussians"] | None:
    """What is connected to a pixel (row, column) of frame k through neighbours that move alike, and of its colour.

    None where nothing is drawn at the pixel.
    """
    here, (row, column) = lit.frame(k), pixel
    point = np.zeros((1, *lit.size), np.float32)
    point[0, row, column] = 1
    weight = here.gathered(point)[:, 0]
    if not (weight > 0).any():
        return None
    seen = [traits(lit, n) for n in _sampled(lit, k)]
    wanted = lab(here.picture[:, row, column][None])[0]
    parts = ((one.index, one.color, one.total) for one in seen)
    color, alike = weighted_mean(lit.num_gaussians, parts)
    alike[alike] = difference(color[alike], wanted) <= tolerance
    of_color = np.where(alike[here.alive], weight, 0)
    seed = here.alive[np.argmax(of_color if of_color.any() else weight)]
    alike[seed] = True
    pairs = _pairs(lit, seen, alike)
    inside = _connected(lit.num_gaussians, pairs, seed)
    return inside | _joining(lit.num_gaussians, pairs, inside)


def _sampled(lit: Contributions, k: int) -> list[int]:
    """Frames of the shot of frame k, evenly apart, with k itself."""
    shot = _shots(lit)
    own = np.flatnonzero(shot == shot[k])
    step = -(-len(own) // GROWN_FRAMES)
    return list(range(own[0] + (k - own[0]) % step, own[-1] + 1, step))


class _Pairs(NamedTuple):
    """Neighbours that touch in a frame, frame after frame, both ways round, by number."""

    one: Int[np.ndarray, " num"]
    other: Int[np.ndarray, " num"]
    firm: Bool[np.ndarray, " num"]  # neither stands at a border
    alike: Bool[np.ndarray, " num"]  # they move alike, as seen
    gap: Float32[np.ndarray, " num"]  # of one's *own* motion and the other's, px per frame; NaN if that is at a border


def _connected(num: int, pairs: _Pairs, seed: int) -> Bool[np.ndarray, " num_gaussians"]:
    """Whom a chain of links leads to: firm pairs that move alike in most of the frames in which they touch.

    Chains do not go through those at borders: there the motion seen changes little by little, from one to the other.
    """
    one, other = pairs.one[pairs.firm], pairs.other[pairs.firm]
    votes = scipy.sparse.coo_array(
        (np.where(pairs.alike[pairs.firm], 1.0, -1.0), (one, other)), shape=(num, num)
    ).tocsr()
    votes.data[votes.data < 0] = 0
    votes.eliminate_zeros()
    _, part = scipy.sparse.csgraph.connected_components(votes, directed=False)
    return part == part[seed]


def _joining(num: int, pairs: _Pairs, inside: Bool[np.ndarray, " num_gaussians"]) -> Bool[np.ndarray, " num_gaussians"]:
    """Those at borders in all frames whose own motion is more like that of their neighbours inside than outside."""
    free = np.ones(num, bool)
    free[pairs.one[pairs.firm]] = False
    gaps = []
    for side in (inside, ~inside):
        which = side[pairs.other] & ~np.isnan(pairs.gap)
        count = np.bincount(pairs.one[which], minlength=num)
        total = np.bincount(pairs.one[which], pairs.gap[which], minlength=num)
        gaps.append(np.divide(total, count, out=np.full(num, np.inf), where=count > 0))
    return free & (gaps[0] < gaps[1])


def _pairs(lit: Contributions, seen: list[Traits], among: Bool[np.ndarray, " num_gaussians"]) -> _Pairs:
    """All pairs among some, in each frame those seen clearly: of one that is hidden one sees what is in front."""
    best = np.zeros(lit.num_gaussians)
    for one in seen:
        best[one.index] = np.maximum(best[one.index], one.total)
    clear = (one.those(among[one.index] & (one.total >= CLEAR * best[one.index])) for one in seen)
    found = [_touching(one, MOTION * max(lit.size)) for one in clear if len(one.index)]
    return _Pairs(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _touching(seen: Traits, motion: float) -> _Pairs:
    """The pairs of one frame."""
    num = min(NEIGHBOURS + 1, len(seen.index))  # with oneself
    radius = np.abs(np.linalg.det(seen.light.splats.factor[seen.which])) ** 0.5
    distance, other = scipy.spatial.cKDTree(seen.position).query(seen.position, list(range(1, num + 1)))
    one = np.broadcast_to(np.arange(len(other))[:, None], other.shape)
    near = (distance <= REACH * (radius[one] + radius[other]) + 1) & (one != other)
    one, other = one[near], other[near]
    firm = seen.spread <= motion + MOTION_SHARE * np.hypot(*seen.motion.T)
    alike = _move_alike(seen.motion[one], seen.motion[other], motion)
    gap = np.where(firm[other], np.hypot(*(seen.own_motion[one] - seen.motion[other]).T), np.nan)
    return _Pairs(seen.index[one], seen.index[other], firm[one] & firm[other], alike, gap)


def _move_alike(
    one: Float[np.ndarray, "num 2"], other: Float[np.ndarray, "num 2"], motion: float
) -> Bool[np.ndarray, " num"]:
    speed = np.maximum(np.hypot(*one.T), np.hypot(*other.T))
    return np.hypot(*(one - other).T) <= motion + MOTION_SHARE * speed
