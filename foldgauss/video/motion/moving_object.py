"""The moving object of a clip, as a mask of each frame, found by its motion against the background.

Two cues are combined: flow that is left after the frames are aligned, and the difference from a plate of the background
that the other frames show. GrabCut places the borders, the pieces are followed through the shot, the masks vote along
the flow, and pixels near them are assigned by their color.
"""

import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy
from jaxtyping import Bool, Float32, Int32, UInt8

from foldgauss._runtime.checks import ParameterError, invalid, require
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.motion.background_plate import (
    Alignment,
    Frames,
    Masks,
    check_frames,
    dilate,
    render_plate,
    resize_frames,
    warp_by,
)
from foldgauss.video.motion.optical_flow import both_flows, pixel_grid, warp_image

#: Motion is measured over so many frames: slow objects need more, fast ones are not found again after many.
GAPS = (1, 2, 4)
#: What moves by less than this many pixels is hardly evidence.
LEAST_MOTION = 0.7
#: What differs from the plate by fewer levels of 255 is hardly evidence.
LEAST_DIFFERENCE = 12.0
#: Nor is what moves, or differs, by less than this multiple of the image's median.
TIMES_MEDIAN = 4.0
#: Evidence of what moves as the background, only faster: it may stand still and be nearer than the background.
PARALLAX = 0.2
#: Evidence is motion to this power times difference to the rest. (car-shadow: 0.4 to 0.7 are alike.)
MOTION_POWER = 0.6
#: Evidence that may be of an object, relative to the frame's largest.
MAYBE = 0.3
#: Evidence that probably is of an object, relative to the frame's largest.
PROBABLY = 0.5
#: Evidence that certainly is of an object, relative to the frame's largest.
CERTAINLY = 0.8
#: The frame's largest evidence is this percentile of it,
TOP = 99.8
#: and at least this.
FAINTEST = 0.35
#: An object has so much evidence on average, not relative.
LEAST_EVIDENCE = 0.4
#: Votes of motion are passed on to the next frame at this rate.
MOTION_VOTE = 0.6
#: Votes of masks are passed on to the next frame at this rate.
MASK_VOTE = 0.8
#: There the flow must agree with the flow back within about so many pixels.
VOTE_MISS = 1.5
#: A shadow darkens all channels alike: logarithms of ratios differ by less than this.
HUE = 0.12
#: Their mean is below this where borders of a shadow are sought,
SLIGHT = -0.1
#: below this where shadow is cut off below an object,
STRONG = -0.6
#: and always above this.
DARKEST = -2.2
#: The smallest piece, a fraction of the image.
SMALLEST = 3e-4
#: A piece follows if this fraction of it is where the object is expected,
INSIDE = 0.5
#: or if it covers this fraction of that.
REFOUND = 0.4
#: The object is lost in a frame where its area is below this fraction of the usual one.
LOST = 0.1
#: It touches another object where its area is above this multiple of the usual one.
MERGED = 2.0
#: A lost object is sought this many pixels further in each frame,
SEARCH = 6
#: at most this fraction of the longer side away.
FARTHEST = 0.125
#: Objects are followed from every so many frames.
SEED_SPACING = 5
#: Colors are counted in so many bins of each channel,
BINS = 64
#: over the frames up to so many away,
COLOR_REACH = 10
#: of the object and of what is within so many pixels of it.
SURROUNDINGS = 60
#: A color counts up to this, for or against an object, by the difference of both frequencies over their sum.
COLOR_WEIGHT = 4.0
#: The largest log odds of votes.
VOTE_ODDS = 3.0
#: An object reaches at most so many pixels beyond votes of -VOTE_ODDS.
BEYOND = 4
#: A motion cannot be told from a camera's in fewer frames.
LEAST_FRAMES = 3
#: A click is at most this fraction of the longer side beside the object.
CLICK_REACH = 0.03
#: The cure of errors of selections, which can be made otherwise.
SELECT_OTHERWISE = "Select by a mask, a box or a click."


class NothingMoves(ParameterError):
    """No object moves on its own, or none that can be told from the background."""


def find_moving_object(
    frames: Frames,
    *,
    at: tuple[int, float, float] | None = None,
    alignment: Alignment | None = None,
) -> Masks:
    """Where the largest object is that moves on its own, in each frame: bool (num_frames, height, width).

    `frames` are uint8 (num_frames, height, width, 3), in which the background fills most of the image and moves as a
    plane does, about: a camera that turns, zooms, or passes a distant scene. Each shot has an object of its own, and
    objects that touch count as one. Masks are empty where it is hidden. `at` = (frame, x, y), in pixels, chooses the
    object there instead of the largest one, in its shot. `alignment` aligns the frames. By default it is estimated. A
    shot without an object gives a warning.

    It costs about half a second of processor time for each frame, of any size.

    Raises ValueError for frames of another type, and `NothingMoves`, which is one, if nothing moves on its own.
    Example: `by_mask(model, find_moving_object(clip.frames))`.
    Source: Papazoglou and Ferrari 2013 (motion against the camera, then appearance); Rother et al. 2004 (GrabCut).
    """
    check_frames(frames)
    alignment = Alignment.from_frames(frames) if alignment is None else alignment
    small = resize_frames(frames)
    height, width = frames.shape[1:3]
    inside = at is None or (0 <= at[0] < len(frames) and 0 <= at[1] < width and 0 <= at[2] < height)
    expected = f"(frame, x, y) below ({len(frames)}, {width}, {height})"
    require(inside, "at", expected=expected, got=at)
    masks = np.zeros((len(frames), height, width), bool)
    for first, stop in alignment.shots:
        if at is not None and not first <= at[0] < stop:
            continue
        place = None
        if at is not None:
            column, row = at[1] * small.shape[2] // width, at[2] * small.shape[1] // height
            place = at[0] - first, int(column), int(row)
        found = _find_in_shot(small[first:stop], alignment.of_shot(first, stop), place)
        for k, mask in zip(range(first, stop), found, strict=False):
            masks[k] = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
    if not masks.any():
        where = "" if at is None else " at {1:g},{2:g} in frame {0}".format(*at)
        raise nothing_moves(f"an object that moves against the background{where}", "none")
    missing = [f"{first}:{stop}" for first, stop in alignment.shots if not masks[first:stop].any()]
    if missing and at is None:
        warnings.warn(f"No moving object was found in the shots of frames {', '.join(missing)}.", stacklevel=2)
    return masks


def nothing_moves(expected: str, got: object, cure: str = SELECT_OTHERWISE) -> NothingMoves:
    """The error, to be raised."""
    return invalid("moving", expected=expected, got=got, cure=cure, kind=NothingMoves)


def _find_in_shot(frames: Frames, alignment: Alignment, place: tuple[int, int, int] | None) -> Masks | list:
    """The masks of a shot, all of the alignment, at the size of its images; none if nothing moves."""
    if len(frames) < LEAST_FRAMES:
        return []
    cues = measure_cues(frames, alignment)
    evidence = cues.moved**MOTION_POWER * cues.different ** (1 - MOTION_POWER)
    relative = [np.minimum(1, one / np.clip(np.percentile(one, TOP), FAINTEST, 1)) for one in evidence]
    pieces = run_all(lambda k: cut_out(frames[k], relative[k], cues.slight[k]), len(frames))
    masks = _track_best(pieces, relative, alignment, place)
    if masks is None or max(one[mask].mean() for one, mask in zip(evidence, masks, strict=True) if mask.any()) < (
        LEAST_EVIDENCE
    ):
        return []
    masks = np.stack([_clean(_cut_shadow(mask, dark)) for mask, dark in zip(masks, cues.strong, strict=True)])
    return _assign_by_color(frames, _vote(masks.astype(np.float32), alignment, MASK_VOTE))


def run_all(function: Callable[[int], Any], num: int) -> list:
    """`function(k)` for all k < num, by several threads."""
    results = [None] * num

    def run(k: int) -> None:
        results[k] = function(k)

    run_tasks(run, range(num))
    return results


# ------------------------------------------------------------------------------------------------------- evidence


class Cues(NamedTuple):
    """What tells an object of a shot from the background, of each pixel; the first two in [0, 1]."""

    moved: Float32[np.ndarray, "frames rows columns"]  #: how certain it is that it moves on its own
    different: Float32[np.ndarray, "frames rows columns"]  #: and differs from the background; else as `moved`
    slight: Masks  #: whether it is darker than the background, as a slight shadow,
    strong: Masks  #: and a strong one


def measure_cues(frames: Frames, alignment: Alignment) -> Cues:
    """The cues of the frames of a shot, all of the alignment."""
    moved = np.stack(run_all(lambda k: _measure_motion(alignment, k), len(frames)))
    moved, shot = _vote(moved, alignment, MOTION_VOTE), (0, len(frames))
    covered = np.stack([dilate(one > CERTAINLY, 9) for one in moved])

    def compare(k: int) -> tuple[np.ndarray, ...]:
        plate, count = render_plate(frames, covered, alignment, k, shot)
        different = np.where(count < 2, moved[k], _measure_difference(frames[k], plate, count >= 2))
        return different, *(_find_shadow(frames[k], plate, level) for level in (SLIGHT, STRONG))

    return Cues(moved, *map(np.stack, zip(*run_all(compare, len(frames)), strict=True)))


def _measure_motion(alignment: Alignment, k: int) -> Float32[np.ndarray, "rows columns"]:
    """How certain it is that each pixel moves against the background, in [0, 1]."""
    image = alignment.images[k]
    size, ones = image.shape[::-1], np.ones_like(image)
    found, nearer = [], []
    for gap in GAPS:
        lengths = []
        for j in (k - gap, k + gap):
            if not 0 <= j < len(alignment.images):
                continue
            matrix = alignment.between(k, j)
            inside = cv2.erode(warp_by(ones, matrix, size, cv2.BORDER_CONSTANT), np.ones((5, 5))) > 0
            flow = both_flows(image, warp_by(alignment.images[j], matrix, size))[0]
            length = np.hypot(flow[..., 0], flow[..., 1])
            lengths.append(np.where(inside, length, np.nan))
            if gap == 1:
                nearer.append(_measure_parallax(flow, length, matrix))
        if lengths:
            # What is visible in one of the two frames only has no flow to the other.
            found.append(_compare_to_median(np.fmin.reduce(lengths), LEAST_MOTION))
    mean = np.nansum(found, 0) / np.maximum((~np.isnan(found)).sum(0), 1)
    return np.float32(mean * (1 - (1 - PARALLAX) * np.mean(nearer, axis=0)))


def _measure_parallax(flow, length, matrix) -> Float32[np.ndarray, "rows columns"]:
    """How far a pixel moves as the background does, only faster, in [0, 1]."""
    grid = pixel_grid(*length.shape)
    camera = cv2.perspectiveTransform(grid.reshape(-1, 1, 2), matrix).reshape(grid.shape) - grid
    speed = np.hypot(camera[..., 0], camera[..., 1])
    cosine = (flow * camera).sum(-1) / (speed * length + 1e-6)
    return np.clip(2 * cosine - 1, 0, 1) * speed / (speed + 1)


def _measure_difference(
    image: UInt8[np.ndarray, "rows columns 3"], plate, known: Bool[np.ndarray, "rows columns"]
) -> Float32[np.ndarray, "rows columns"]:
    """How certain it is that a pixel is not of the plate, in [0, 1]; its neighbors there count as its own."""
    near = np.ones((3, 3))
    over, under = cv2.subtract(image, cv2.dilate(plate, near)), cv2.subtract(cv2.erode(plate, near), image)
    difference = np.where(known, np.maximum(over, under).max(-1), np.nan)
    return np.nan_to_num(_compare_to_median(difference, LEAST_DIFFERENCE))


def _compare_to_median(values, least: float) -> Float32[np.ndarray, "rows columns"]:
    """From 0 to 1, a half where a value is `TIMES_MEDIAN` of the median and `least`, whichever is larger."""
    known = values[~np.isnan(values)]
    unit = max(least, TIMES_MEDIAN * float(np.median(known))) if len(known) else least
    return np.float32(values**2 / (values**2 + unit**2))


def _find_shadow(image, plate, level: float) -> Bool[np.ndarray, "rows columns"]:
    """Where the image is a darker version of the plate."""
    here, there = (cv2.GaussianBlur(np.float32(one), (0, 0), 1) + 4 for one in (image, plate))
    ratio = np.log(here / there)
    mean = ratio.mean(-1)
    return (np.abs(ratio - mean[..., None]).max(-1) < HUE) & (mean < level) & (mean > DARKEST)


# -------------------------------------------------------------------------------------------------- masks of a frame


def cut_out(image, evidence, shadow: Bool[np.ndarray, "rows columns"]) -> Int32[np.ndarray, "rows columns"]:
    """Labels of the pieces that GrabCut finds, from 1; 0 elsewhere."""
    near = np.ones((3, 3))
    labels = np.full(evidence.shape, cv2.GC_BGD, np.uint8)
    labels[dilate(evidence > MAYBE, 7)] = cv2.GC_PR_BGD
    labels[evidence > PROBABLY] = cv2.GC_PR_FGD
    labels[cv2.erode(np.uint8(evidence > CERTAINLY), near) > 0] = cv2.GC_FGD
    labels[shadow & (labels != cv2.GC_BGD)] = cv2.GC_PR_BGD
    inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if inside.any() and not inside.all():
        cv2.setRNGSeed(0)  # its color models begin with k-means
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(np.ascontiguousarray(image), labels, None, *models, 2, cv2.GC_INIT_WITH_MASK)
        inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    num, pieces, table, _ = cv2.connectedComponentsWithStats(np.uint8(_clean(inside)))
    large = table[:, cv2.CC_STAT_AREA] >= SMALLEST * pieces.size
    large[0] = False
    return np.where(large, np.arange(num), 0)[pieces]


def _clean(mask: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """Without specks, gaps and holes."""
    small, large = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)) for size in (3, 7))
    opened = cv2.morphologyEx(np.uint8(mask), cv2.MORPH_OPEN, small)
    return scipy.ndimage.binary_fill_holes(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, large) > 0)


def _cut_shadow(mask, dark: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """The mask without shadow that has nothing else of the object below it."""
    solid = cv2.morphologyEx(np.uint8(mask & ~dark), cv2.MORPH_OPEN, np.ones((3, 3)))
    above_solid = np.maximum.accumulate(solid[::-1])[::-1] > 0
    return mask & (above_solid | ~dark)


# ------------------------------------------------------------------------------------------------------ through time


def _vote(values: Float32[np.ndarray, "frames rows columns"], alignment: Alignment, rate: float):
    """The mean of each pixel's values along the flow, both ways, those nearer in time with more weight."""
    total, weights = values.copy(), np.ones_like(values)
    for step in (1, -1):
        order = range(len(values))[::step]
        carried, weight = values[order[0]], np.ones_like(values[0])
        for k in order[1:]:
            ahead, back = alignment.flow(k, k - step)
            certain = rate * measure_agreement(ahead, back)
            carried, weight = (pull(one, ahead) * certain for one in (carried, weight))
            total[k] += carried
            weights[k] += weight
            carried, weight = carried + values[k], weight + 1
    return total / weights


def measure_agreement(there, back) -> Float32[np.ndarray, "rows columns"]:
    """1 where the flow back leads home again, to 0 where it misses by more than `VOTE_MISS` pixels, or out of sight."""
    rows, columns = there.shape[:2]
    target = pixel_grid(rows, columns) + there
    miss = there + warp_image(back, target, cv2.INTER_LINEAR)
    inside = ((target >= 0) & (target <= np.float32([columns - 1, rows - 1]))).all(-1)
    return inside * np.exp(-(miss**2).sum(-1) / VOTE_MISS**2)


def pull(image: Float32[np.ndarray, "rows columns"], flow) -> Float32[np.ndarray, "rows columns"]:
    """The image of the frame that the flow leads to, seen from here; 0 outside."""
    return cv2.remap(image, pixel_grid(*image.shape) + flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _assign_by_color(frames: Frames, votes: Float32[np.ndarray, "frames rows columns"]) -> Masks:
    """Masks of the pixels whose votes and colors are rather those of the object than of its surroundings."""
    judge = judge_colors(frames, votes > 0.5, range(len(frames)))

    def assign(k: int) -> Bool[np.ndarray, "rows columns"]:
        least = scipy.special.expit(-VOTE_ODDS)
        odds = judge(k) + scipy.special.logit(np.clip(votes[k], least, 1 - least))
        odds[~dilate(votes[k] > least, 2 * BEYOND + 1)] = -np.inf
        certain = cv2.ximgproc.guidedFilter(frames[k], np.float32(scipy.special.expit(odds)), 4, 1e-4 * 255**2)
        return _clean(certain > 0.5)

    return np.stack(run_all(assign, len(frames)))


def judge_colors(
    frames: Frames, masks: Masks, known: Iterable[int], reach: int = COLOR_REACH
) -> Callable[[int], Float32[np.ndarray, "rows columns"]]:
    """A function of a frame: how much the color of each pixel speaks for the object, as log odds.

    Colors are counted in the `known` frames up to `reach` away: in the masks, and in what surrounds them.
    """
    inside, outside, known = {}, {}, np.array(list(known))
    for k in known:
        bins, mask = _quantize(frames[k]), masks[k]
        outward, inward = (cv2.distanceTransform(np.uint8(one), cv2.DIST_L2, 3) for one in (~mask, mask))
        inside[k] = bins[inward > 1]
        outside[k] = bins[mask.any() & (outward > 2) & (outward < SURROUNDINGS)]

    def judge(k: int) -> Float32[np.ndarray, "rows columns"]:
        near = known[np.abs(known - k) <= reach]
        own, other = (_count(np.concatenate([one[j] for j in near])) for one in (inside, outside))
        return np.float32(COLOR_WEIGHT * (own - other) / (own + other))[_quantize(frames[k])]

    return judge


def _quantize(image: UInt8[np.ndarray, "rows columns 3"]) -> Int32[np.ndarray, "rows columns"]:
    """The bin of each pixel's color, in Lab."""
    channels = np.moveaxis(np.int32(cv2.cvtColor(image, cv2.COLOR_RGB2LAB)) * BINS // 256, -1, 0)
    return np.ravel_multi_index(tuple(channels), (BINS,) * 3).astype(np.int32)


def _count(bins: Int32[np.ndarray, " pixels"]) -> np.ndarray:
    """How frequent each color is, as a fraction, smoothed over neighboring bins, and never zero."""
    counts = np.bincount(bins, minlength=BINS**3) / max(len(bins), 1)
    return scipy.ndimage.gaussian_filter(counts.reshape((BINS,) * 3), 1.0, truncate=3).ravel() + 1e-6


def _track_best(pieces, evidence, alignment: Alignment, place: tuple[int, int, int] | None) -> Masks | None:
    """The object whose track has most evidence; tracks begin at the best piece of every `SEED_SPACING`-th frame.

    `place` = (frame, x, y): the object there.
    """
    if place is not None:
        k, x, y = place
        near = scipy.ndimage.distance_transform_edt(pieces[k] == 0, return_distances=False, return_indices=True)
        row, column = near[:, y, x]
        is_near = pieces[k].any() and np.hypot(row - y, column - x) <= CLICK_REACH * max(pieces[k].shape)
        return track(pieces, pieces[k] == pieces[k][row, column], k, alignment) if is_near else None
    best, best_score = None, 0.0
    for k in range(min(2, len(pieces) - 1), len(pieces), SEED_SPACING):
        scores = np.bincount(pieces[k].ravel(), evidence[k].ravel())
        scores[0] = 0
        seed = pieces[k] == scores.argmax()
        if not scores.any() or (best is not None and (best[k] & seed).sum() > INSIDE * seed.sum()):
            continue
        masks = track(pieces, seed, k, alignment)
        score = sum(float(one[mask].sum()) for one, mask in zip(evidence, masks, strict=True))
        if score > best_score:
            best, best_score = masks, score
    return best


def track(pieces: list, seed: Bool[np.ndarray, "rows columns"], start: int, alignment: Alignment) -> Masks:
    """The pieces of the object `seed` of frame `start` in all frames; while it is lost, it goes on at its speed."""
    masks = np.zeros((len(pieces), *seed.shape), bool)
    masks[start] = seed
    farthest = FARTHEST * max(seed.shape)
    for step in (1, -1):
        last, missed, area, speed = seed, 0, float(seed.sum()), np.zeros(2)
        for k in range(start + step, len(pieces) if step > 0 else -1, step):
            there, back = alignment.flow(k - step, k)
            if missed == 0:
                speed = 0.8 * speed + 0.2 * np.median(there[last], axis=0)
                expected = pull(last.astype(np.float32), back) > 0.5
            else:
                expected = scipy.ndimage.shift(last, speed[::-1], order=0)
            found = _choose_pieces(pieces[k], expected, min(1 + SEARCH * missed, farthest))
            if missed == 0 and found.sum() > MERGED * area:  # with another object
                found &= dilate(expected, 15)
            if found.sum() > LOST * area:
                masks[k], last, missed, area = found, found, 0, 0.8 * area + 0.2 * float(found.sum())
            elif expected.any():
                last, missed = expected, missed + 1
            else:
                break
    return masks


def _choose_pieces(
    labels, expected: Bool[np.ndarray, "rows columns"], reach: float
) -> Bool[np.ndarray, "rows columns"]:
    """The pieces that are mostly within `reach` pixels of where an object is expected, or cover much of it."""
    near = cv2.distanceTransform(np.uint8(~expected), cv2.DIST_L2, 3) <= reach
    num = labels.max() + 1
    area = np.bincount(labels.ravel(), minlength=num)
    hit = np.bincount(labels[near], minlength=num)
    chosen = (hit > INSIDE * area) | (hit > REFOUND * expected.sum())
    chosen[0] = False
    return chosen[labels]
