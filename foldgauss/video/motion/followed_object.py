"""An object whose mask is given in some frames of a clip, followed to the others.

From each frame to the next the mask moves along the optical flow. Pixels near it are then judged by their colors at
their places in the object, and by their motion against the background. What of each speaks for the object is learned
from the masks so far.
"""

import itertools
import math
import warnings
from collections.abc import Iterator, Mapping

import cv2
import numpy as np
import scipy
from jaxtyping import Bool, Float32, Int, UInt8
from scipy.special import expit, logit

from foldgauss._runtime.checks import is_integer, require
from foldgauss.video.motion.background_plate import Alignment, Frames, Masks, check_frames, dilate, resize_frames
from foldgauss.video.motion.moving_object import (
    Cues,
    cut_out,
    judge_colors,
    measure_agreement,
    measure_cues,
    pull,
    run_all,
    track,
)
from foldgauss.video.motion.optical_flow import motion_finder, pixel_grid

#: The number of bins of lightness, and of each color axis of Lab.
COLOR_BINS = 14
#: The width of a bin of a color axis, in levels of 255.
HUE_BIN = 7
#: Colors are counted after a blur of this standard deviation, in pixels.
COLOR_BLUR = 0.7
#: Places relative to the center of the object are counted in square cells of this side, in pixels.
CELL = 24
#: The number of cells along each axis. Places farther out count in the outermost cells.
CELLS = 17
#: The number of bins of each cue of motion.
MOTION_BINS = 12
#: Counts are smoothed over neighboring bins by a Gaussian of this standard deviation, in bins.
SMOOTHING = 0.8
#: This is added to the counts of colors on both sides, in pixels.
LEAST_COUNT = 0.01
#: This is added to the frequencies of motion on both sides.
LEAST_PART = 2e-3
#: The surroundings of an object, from which the background is learned, have this width in pixels.
SURROUNDINGS = 60
#: The largest distance between an object and the place that the flow predicts, in pixels.
REACH = 24
#: This distance grows by as much for each frame in which the object is hidden.
SEARCH = 6
#: Appearance is learned from the given mask, with weight 2, and from this number of frames before.
MEMORY = 5
#: The largest log odds of each cue.
MOST_ODDS = 3.0
#: The log odds of pixels out of reach.
FAR_ODDS = -6.0
#: The blur of the predicted place, in pixels.
BLUR = 2.0
#: Pixels are within reach of predictions above this probability.
PERHAPS = 0.3
#: The rate at which the speed of an object follows the flow. A hidden object moves on at this speed.
SPEED_RATE = 0.3
#: The weight of the predicted place where forward and backward flow disagree.
LEAST_TRUST = 0.3
#: The weight of edge-preserving smoothing of probabilities.
EDGE_SMOOTHING = 300.0
#: Differences of color above this count as edges there, in levels of 255.
EDGE_LEVELS = 6.0
#: An object counts as hidden where its area is below this fraction of the usual area.
HIDDEN = 0.35
#: An object counts as seen whole where its area is above this fraction of the usual area.
WHOLE = 0.7
#: The rate at which the usual area follows the area of each frame.
AREA_RATE = 0.15
#: Pieces of fewer pixels are dropped.
SMALLEST = 12
#: Pieces are kept if at least this fraction of their pixels is predicted.
LEAST_EXPECTED = 0.05
#: The probability of pieces by which a hidden object is found again.
REFOUND = 0.6

#: How certainly each pixel belongs to the object, in [0, 1].
Probability = Float32[np.ndarray, "rows columns"]


def follow_object(
    frames: Frames, masks: Mapping[int, Bool[np.ndarray, "height width"]], *, alignment: Alignment | None = None
) -> Masks:
    """The masks of an object in all frames, from its `masks` in some, by frame: bool (num_frames, height, width).

    `frames` are uint8 (num_frames, height, width, 3). A given mask stays as it is. Between two of them the object is
    followed from both. It is found again after it was hidden, mostly. Masks are empty in shots in which none is given;
    there is a warning then. `alignment` aligns the frames. By default it is estimated.

    It costs about a second of processor time for each frame, of any size. Lengths are in pixels of images whose longer
    side is `background_plate.SIDE`.

    Raises ValueError for frames of another type, for masks of another size or frame, and without a mask.
    Example: `follow_object(clip.frames, {0: first_mask})`.
    Source: Bai et al. 2009, Video SnapCut (colors by place); Min et al. 2014 (fast global smoother).
    """
    check_frames(frames)
    for k, mask in masks.items():
        require(
            is_integer(k, 0) and k < len(frames), "masks", expected=f"frames from 0 to {len(frames) - 1}", got=repr(k)
        )
        require(
            np.shape(mask) == frames.shape[1:3] and np.asarray(mask).dtype == bool,
            "masks",
            expected=f"bool {frames.shape[1:3]}",
            got=f"{np.asarray(mask).dtype} {np.shape(mask)} for frame {k}",
        )
    given = {int(k): np.asarray(mask) for k, mask in sorted(masks.items()) if np.any(mask)}
    require(given, "masks", expected="one that is not empty, at least", got="none")
    alignment = Alignment.from_frames(frames) if alignment is None else alignment
    small, found, shots = resize_frames(frames), np.zeros(frames.shape[:3], bool), alignment.shots
    followed: dict[int, list[Probability]] = {}  # by the first frame of a shot

    def follow(first: int, stop: int, own: dict[int, Probability]) -> None:
        followed[first] = _follow_in_shot(small[first:stop], alignment.of_shot(first, stop), own)

    for first, stop in shots:
        own = {k - first: _resize(mask, small.shape[1:3]) for k, mask in given.items() if first <= k < stop}
        if own:
            follow(first, stop, own)
    # What moves fast may hide the background's motion: then a shot of the alignment does not begin with a cut.
    cuts = motion_finder(frames)().cuts if len(followed) < len(shots) else []
    for (first, middle), (_, stop) in itertools.pairwise(shots):
        if middle not in cuts and first in followed and middle not in followed:
            follow(middle, stop, {0: pull(followed[first][-1], alignment.flow(middle, middle - 1)[0])})
    for (first, middle), _ in reversed(list(itertools.pairwise(shots))):
        if middle not in cuts and middle in followed and first not in followed:
            last = pull(followed[middle][0], alignment.flow(middle - 1, middle)[0])
            follow(first, middle, {middle - first - 1: last})
    for first, inside in followed.items():
        found[first : first + len(inside)] = [_resize(one, frames.shape[1:3]) > 0.5 for one in inside]
    for k, mask in given.items():
        found[k] = mask
    missing = [f"{first}:{stop}" for first, stop in shots if first not in followed]
    if missing:
        warnings.warn(f"No mask is given in the shots of frames {', '.join(missing)}: none is found.", stacklevel=2)
    return found


def _resize(mask: np.ndarray, size: tuple[int, int]) -> Probability:
    how = cv2.INTER_AREA if mask.shape[0] > size[0] else cv2.INTER_LINEAR
    return cv2.resize(mask.astype(np.float32), size[::-1], interpolation=how)


def _follow_in_shot(frames: Frames, alignment: Alignment, given: Mapping[int, Probability]) -> list[Probability]:
    """The object in all frames of a shot, which are all of the alignment."""
    num = len(frames)
    if num == 1:
        return list(given.values())
    cues, masks = measure_cues(frames, alignment), np.zeros(frames.shape[:3], bool)
    clues = _Clues(frames, cues)
    for k, inside in given.items():
        masks[k] = inside > 0.5
        clues.learn(k, inside)
    color = judge_colors(frames, masks, given, num)
    nowhere = np.zeros(frames.shape[1:3], bool)
    pieces = run_all(lambda k: cut_out(frames[k], expit(color(k) + clues.judge_motion(k)), nowhere), num)
    total, weights = np.zeros((num, *frames.shape[1:3]), np.float32), np.zeros((num, 1, 1), np.float32)
    for start, inside in given.items():
        tracked = track(pieces, masks[start], start, alignment)
        before, after = (
            max([k for k in given if k < start], default=-1),
            min([k for k in given if k > start], default=num),
        )
        for order in (range(start, after), range(start, before, -1)):
            for k, one in zip(order, _follow(_Clues(frames, cues), alignment, order, inside, tracked), strict=True):
                weight = 1 / max(abs(k - start), 1e-3)
                total[k] += weight * one
                weights[k] += weight
    return list(total / weights)


def _follow(
    clues: "_Clues", alignment: Alignment, order: range, inside: Probability, tracked: Masks
) -> Iterator[Probability]:
    """The object in the frames of `order`, from the given mask `inside` of the first one on."""
    clues.learn(order[0], inside)
    yield inside
    usual, hidden, whole, speed, moved = inside.sum(), 0, inside > 0.5, np.zeros(2), np.zeros(2)
    for before, k in itertools.pairwise(order):
        ahead, back = alignment.flow(k, before)
        expected, trust = pull(inside, ahead), LEAST_TRUST + (1 - LEAST_TRUST) * measure_agreement(ahead, back)
        if (inside > 0.5).sum() > WHOLE * usual:
            whole, moved = inside > 0.5, np.zeros(2)
            own = np.median(alignment.flow(before, k)[0][whole], axis=0)
            speed = (1 - SPEED_RATE) * speed + SPEED_RATE * own if speed.any() else own
        moved = moved + speed
        if hidden and tracked[k].any():
            expected = np.maximum(expected, REFOUND * tracked[k])
        elif hidden:
            expected = np.maximum(expected, 0.5 * scipy.ndimage.shift(np.float32(whole), moved[::-1], order=0))
        reach = REACH + SEARCH * hidden * (not tracked[k].any())
        odds = _limit_odds(cv2.GaussianBlur(expected, (0, 0), BLUR)) * trust / (1 + hidden)
        odds += clues.judge_color(k, _find_center(expected)) + clues.judge_motion(k)
        odds[~dilate(expected > PERHAPS, 2 * reach + 1)] = FAR_ODDS
        inside = _keep_expected(_smooth(clues.frames[k], expit(odds)), expected > PERHAPS)
        area = (inside > 0.5).sum()
        if area < HIDDEN * usual:
            hidden += 1
        else:
            hidden, usual = 0, (1 - AREA_RATE) * usual + AREA_RATE * area
            clues.learn(k, inside)
        yield inside


def _limit_odds(probability: np.ndarray) -> np.ndarray:
    least = expit(-MOST_ODDS)
    return logit(np.clip(probability, least, 1 - least))


def _smooth(image: UInt8[np.ndarray, "rows columns 3"], inside: Probability) -> Probability:
    """The probabilities, smoothed between the edges of the image; the certain ones count more."""
    weight = np.float32(np.abs(2 * inside - 1) + 0.05)
    smooth = [
        cv2.ximgproc.fastGlobalSmootherFilter(image, one, EDGE_SMOOTHING, EDGE_LEVELS)
        for one in (np.float32(inside * weight), weight)
    ]
    return np.clip(smooth[0] / np.maximum(smooth[1], 1e-6), 0, 1)


def _keep_expected(inside: Probability, expected: Bool[np.ndarray, "rows columns"]) -> Probability:
    """The pieces that are large enough and reach where the object is expected, with steeper edges."""
    solid = cv2.morphologyEx(np.uint8(inside > 0.5), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    num, pieces, table, _ = cv2.connectedComponentsWithStats(solid)
    hit = np.bincount(pieces[expected], minlength=num) > LEAST_EXPECTED * table[:, cv2.CC_STAT_AREA]
    kept = hit & (table[:, cv2.CC_STAT_AREA] >= SMALLEST) & (np.arange(num) > 0)
    return np.float32(np.clip(2 * inside - 0.5, 0, 1) * dilate(kept[pieces], 3))


def _find_center(inside: Probability) -> tuple[float, float]:
    """(x, y); that of the image for none."""
    moments = cv2.moments(inside)
    if moments["m00"] <= 0:
        return inside.shape[1] / 2, inside.shape[0] / 2
    return moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]


class _Clues:
    """What the color of a pixel at its place, and its motion, say of it. It is learned from masks."""

    def __init__(self, frames: Frames, cues: Cues):
        self.frames, self.cues = frames, (cues.moved, cues.different)
        self.learned: list[tuple[np.ndarray, ...]] = []

    def learn(self, k: int, inside: Probability) -> None:
        near = dilate(inside > 0.5, 2 * SURROUNDINGS + 1)
        bins = self._color_bins(k, _find_center(np.float32(inside > 0.5))), *self._motion_bins(k)
        self.learned.append((*(one[near] for one in bins), inside[near]))
        del self.learned[1 : len(self.learned) - MEMORY]

    def judge_color(self, k: int, center: tuple[float, float]) -> np.ndarray:
        """Log odds of each pixel of a frame, in which the object's center is known."""
        shape, bins = (COLOR_BINS,) * 3 + (CELLS,) * 2, self._color_bins(k, center)
        own, other = (
            scipy.ndimage.gaussian_filter(table.reshape(shape), SMOOTHING, truncate=2).ravel()[bins] + LEAST_COUNT
            for table in self._count(0, math.prod(shape))
        )
        return np.clip(np.log(own / other), -MOST_ODDS, MOST_ODDS)

    def judge_motion(self, k: int) -> np.ndarray:
        odds = np.zeros(self.frames.shape[1:3], np.float32)
        for what, bins in enumerate(self._motion_bins(k), 1):
            own, other = (
                scipy.ndimage.gaussian_filter1d(table / max(table.sum(), 1), SMOOTHING, mode="nearest") + LEAST_PART
                for table in self._count(what, MOTION_BINS)
            )
            odds += np.clip(np.log(own / other), -MOST_ODDS, MOST_ODDS)[bins]
        return odds

    def _count(self, what: int, num: int) -> list[Float32[np.ndarray, " bins"]]:
        """How often each bin is in the object and outside; the first mask counts twice."""
        tables = np.zeros((2, num), np.float32)
        for count, entry in enumerate(self.learned):
            for table, weights in zip(tables, (entry[-1], 1 - entry[-1]), strict=True):
                table += (1 + (count == 0)) * np.bincount(entry[what], weights, num)
        return list(tables)

    def _color_bins(self, k: int, center: tuple[float, float]) -> Int[np.ndarray, "rows columns"]:
        lab = cv2.cvtColor(cv2.GaussianBlur(self.frames[k], (0, 0), COLOR_BLUR), cv2.COLOR_RGB2LAB)
        light, *axes = np.moveaxis(lab.astype(int), -1, 0)
        grid = pixel_grid(*light.shape)
        places = ((grid - np.float32(center)) / CELL + CELLS / 2).astype(int)
        colors = [light * COLOR_BINS // 256, *((axis - 128) // HUE_BIN + COLOR_BINS // 2 for axis in axes)]
        shape = (COLOR_BINS,) * 3 + (CELLS,) * 2
        return np.ravel_multi_index((*colors, places[..., 1], places[..., 0]), shape, mode="clip")

    def _motion_bins(self, k: int) -> list[Int[np.ndarray, "rows columns"]]:
        return [np.minimum((one[k] * MOTION_BINS).astype(int), MOTION_BINS - 1) for one in self.cues]
