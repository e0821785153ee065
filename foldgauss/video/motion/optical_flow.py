"""Optical flow of a clip: tracks of points, folds fitted to them, cuts between shots, and images between frames.

Where the camera moves over texture, folds that start along tracks were worth 3 dB and more over starts at rest.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float16, Float32, Int, UInt8

from foldgauss._runtime.kernels import kernel
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.models.polynomial_folds import fit_powers

#: Tracks have at most so many frames to either side.
LONGEST = 36
#: A track ends where the color has changed by more than this (of 1, root mean square over the channels): it is another
#: object, or the point is occluded.
COLOR_CHANGE = 0.06
#: It also ends where forward and backward flow disagree by more than this many pixels of the image that the flow was
#: computed on,
MISS = 0.5
#: and this fraction of the distance.
MISS_FRACTION = 0.2
#: The longer side, in pixels, of the images that flow is computed on.
FLOW_SIDE = 640
#: The longer side of the flow maps: motion is smoother than images.
KEPT_SIDE = 320
#: What moves by fewer pixels between two frames stands still.
STILL = 0.1
#: Fixed-point iterations of the flow at a time between two frames.
FLOW_ITERATIONS = 2
#: Paths are bent as the flow of the intervals before and after says, where that agrees forward and backward within
#: about a pixel; a straight path has this weight.
STRAIGHT = 0.1
#: At a pixel of an image between two frames, the motions so far away on four sides are tried too, in pixels of the
#: images that flow is computed on: at edges of what moves, the flow at the pixel is often that of the other side.
ASIDE = 8
#: Two frames, moved, are compared by squared differences of colors (of 255), averaged with a Gaussian weight of this
#: width in pixels.
COMPARED_WIDTH = 7 / 3
#: A pixel that one of them lacks counts as this difference.
LACKING = 30.0
#: Motions weigh about the same if these differ by less than this,
ALIKE = 20.0
#: and this fraction of the least.
ALIKE_FRACTION = 0.5
#: The maps of long clips are smaller, so that they take no more bytes than this,
MAP_BYTES = 256e6
#: or than this fraction of the frames.
MAP_FRACTION = 0.25
#: Bytes of a cell of the maps.
BYTES_PER_CELL = 11
#: With fewer points than this per frame on average, the points of all frames are sampled at once.
FEW_POINTS = 16
#: There is a cut between two frames where less than this fraction of the points can be tracked.
CUT_FRACTION = 0.15
#: The longer side, in pixels, of images for the fast flow that rules out a cut.
FAST_SIDE = 160
#: Their least number of rows: OpenCV's fastest preset reads beyond wide images with fewer, and the process crashes.
FAST_ROWS = 32
#: There certainly is no cut where this fraction can be tracked by it.
SURE_FRACTION = 0.5


@dataclasses.dataclass(frozen=True)
class Tracks:
    """Tracks of points, relative to their starts.

    Shapes: `shift` (num, 2 longest + 1, 2) in pixels, x right and y down, 0 at the middle column, which is the frame of
    the start; `known` (num, 2 longest + 1), true along the track: one interval around the middle. `longest` is that of
    `Motion.follow`.
    """

    shift: Float32[np.ndarray, "num steps 2"]
    known: Bool[np.ndarray, "num steps"]

    @property
    def reach(self) -> Int[np.ndarray, " num"]:
        """Frames from the first to the last one of each track."""
        return self.known.sum(1) - 1

    def __getitem__(self, which) -> "Tracks":
        return Tracks(self.shift[which], self.known[which])


class Interpolated(NamedTuple):
    """An image between two frames, predicted from them.

    `image`: values about [0, 255]. `difference`, a measure of the image's error: the squared difference between the
    frames after they are moved to it, by the motion of those tried for which it is least; the mean over the channels
    and, with Gaussian weights, over a few pixels around. It is `LACKING` where one frame does not show the pixel.
    """

    image: Float32[np.ndarray, "rows columns 3"]
    difference: Float32[np.ndarray, "rows columns"]


@dataclasses.dataclass(frozen=True)
class Motion:
    """The optical flow between neighboring frames, forward and backward, on reduced maps.

    Source: Kroeger et al. 2016, Fast Optical Flow using Dense Inverse Search (OpenCV's DIS).
    """

    size: tuple[int, int]  # of the frames, whose pixels are the unit of all lengths
    small: UInt8[np.ndarray, "frames rows columns 3"]
    there: Float16[np.ndarray, "intervals rows columns 2"]
    back: Float16[np.ndarray, "intervals rows columns 2"]
    miss: float  # allowed between forward and backward flow, in pixels of the frames

    @classmethod
    def from_frames(
        cls, frames: UInt8[np.ndarray, "frames height width 3"], preset: int = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
    ) -> "Motion":
        num, height, width, _ = frames.shape
        flow_size = fit_size(_flow_side(height, width), height, width)
        cells = max(MAP_BYTES, MAP_FRACTION * frames.size) / (BYTES_PER_CELL * num)
        kept = fit_size(min(KEPT_SIDE, math.sqrt(cells * max(height, width) / min(height, width))), height, width)
        small = np.empty((num, *kept[::-1], 3), np.uint8)
        flows = np.empty((2, num - 1, *kept[::-1], 2), np.float16)
        unit = np.float32([width / flow_size[0], height / flow_size[1]])

        def gray(k: int) -> np.ndarray:
            return cv2.resize(cv2.cvtColor(frames[k], cv2.COLOR_RGB2GRAY), flow_size, interpolation=cv2.INTER_AREA)

        def shrink(k: int) -> None:
            small[k] = cv2.resize(cv2.GaussianBlur(frames[k], (0, 0), 1.0), kept, interpolation=cv2.INTER_AREA)

        def match(k: int) -> None:
            for way, flow in enumerate(both_flows(gray(k), gray(k + 1), preset)):
                flows[way, k] = cv2.resize(flow * unit, kept, interpolation=cv2.INTER_AREA)

        run_tasks(shrink, range(num))
        run_tasks(match, range(num - 1))
        return cls((height, width), small, flows[0], flows[1], MISS * float(unit.max()))

    @classmethod
    def join(cls, pairs: Sequence["Motion"]) -> "Motion":
        """The motion of a short clip from that of each pair of neighboring frames, of one pair at least."""
        small = [pairs[0].small, *(pair.small[1:] for pair in pairs[1:])]
        there, back = [pair.there for pair in pairs], [pair.back for pair in pairs]
        return cls(pairs[0].size, *map(np.concatenate, (small, there, back)), pairs[0].miss)

    @functools.cached_property
    def cuts(self) -> list[int]:
        """The frames, in order, that begin a new shot."""
        return [k + 1 for k, known in enumerate(self.measure_tracked()) if known < CUT_FRACTION]

    def find_still(self) -> list[int]:
        """The intervals, k for that between frames k and k + 1, in which nothing moves by `STILL` pixels."""
        return [k for k, flow in enumerate(self.there) if np.abs(flow).max() < STILL]

    def measure_tracked(self) -> list[float]:
        """The fraction of points on a grid that can be tracked from each frame to the next."""
        return [float(self.match_grid(k)[2].mean()) for k in range(len(self.there))]

    def grid(self, spacing: int) -> Float32[np.ndarray, "num 2"]:
        """Points on a grid of every `spacing`-th cell of the maps, in pixels, as for `follow`."""
        rows, columns = self.small.shape[1:3]
        first = spacing // 2
        y, x = np.meshgrid(np.arange(first, rows, spacing), np.arange(first, columns, spacing), indexing="ij")
        unit = np.float32([self.size[1] / columns, self.size[0] / rows])
        return ((np.stack([x.ravel(), y.ravel()], -1) + 0.5) * unit).astype(np.float32)

    def match_grid(
        self, k: int, spacing: int = 8
    ) -> tuple[Float32[np.ndarray, "num 2"], Float32[np.ndarray, "num 2"], Bool[np.ndarray, " num"]]:
        """The points of `grid` in frame k, their positions in frame k + 1, and which of these are reliable."""
        grid = self.grid(spacing)
        home = np.full(len(grid), k)
        return grid, *self._step(home, grid, 1, self._color(home, grid))

    def find_texture(self, k: int, spacing: int) -> Float32[np.ndarray, " num"]:
        """The slope of frame k, in levels per cell of the maps, at the points of `match_grid`."""
        gray, part = (
            cv2.cvtColor(self.small[k], cv2.COLOR_RGB2GRAY).astype(np.float32),
            slice(spacing // 2, None, spacing),
        )
        across, down = (cv2.Sobel(gray, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
        return cv2.GaussianBlur(np.hypot(across, down), (0, 0), 1.0)[part, part].ravel()

    def follow(
        self, home: Int[np.ndarray, " num"], position: Float32[np.ndarray, "num 2"], *, longest: int = LONGEST
    ) -> Tracks:
        """Track points, at `position` (x, y in pixels, centers at +0.5) in frame `home`, forward and backward.

        A track has at most `longest` frames to either side.
        """
        num, position = len(home), position.astype(np.float32)
        shift = np.zeros((num, 2 * longest + 1, 2), np.float32)
        known = np.zeros((num, 2 * longest + 1), bool)
        known[:, longest] = True
        color = self._color(home, position)
        for direction in (1, -1):
            on, here = np.arange(num), position
            for step in range(1, longest + 1):
                at = home[on] + direction * (step - 1)
                inside = (at + direction >= 0) & (at + direction < len(self.small))
                on, at, here = on[inside], at[inside], here[inside]
                if not len(on):
                    break
                there, sure = self._step(at, here, direction, color[on])
                on, here = on[sure], there[sure]
                column = longest + direction * step
                known[on, column] = True
                shift[on, column] = here - position[on]
        return Tracks(shift, known)

    def interpolate(
        self, frames: UInt8[np.ndarray, "frames height width 3"], k: int, fraction: float, size: tuple[int, int]
    ) -> Interpolated:
        """The image at a `fraction` of the way from frame k to k + 1, of `size` (height, width).

        Both frames are warped along the paths of their points and averaged, weighted by how near in time they are.
        Pixels from outside one of them are taken from the other. This is done for several motions, and the images are
        averaged with weights: where both frames agree better, a motion has a larger one.

        Source of the bent paths: Xu et al. 2019, Quadratic Video Interpolation; here cubic, from four frames.
        """
        rows, columns = size
        pair = [
            frame if frame.shape[:2] == size else cv2.resize(frame, (columns, rows), interpolation=cv2.INTER_AREA)
            for frame in frames[k : k + 2]
        ]
        flow_size = fit_size(_flow_side(rows, columns), rows, columns)
        small = [cv2.resize(image, flow_size, interpolation=cv2.INTER_AREA) for image in pair]
        motions = self._find_motions(small, k, fraction)
        differences = np.stack([_compare_moved(small, motion) for motion in motions])
        least = differences.min(0)
        weights = np.exp((least - differences) / (ALIKE + ALIKE_FRACTION * least))
        weights /= weights.sum(0)
        image = np.zeros((rows, columns, 3), np.float32)
        for motion, weight in zip(motions, weights, strict=True):
            motion = [_resize_flow(move, flow_size[::-1], size) for move in motion]
            moved, inside = _move(pair, motion, cv2.INTER_CUBIC)
            _add_average(*moved, *inside, np.float32(fraction), cv2.resize(weight, (columns, rows)), image)
        return Interpolated(image, cv2.resize(least, (columns, rows)))

    def _find_motions(self, pair: list[np.ndarray], k: int, fraction: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Motions that may be right at a pixel of the image between two: the ways from it to its place in each of them.

        All are (rows, columns, 2) in pixels of the images. First along the flow between the two, then along those of
        the intervals before and after, then as the first at pixels around.
        """
        rows, columns = pair[0].shape[:2]
        flow, past, ahead = self._interpolate_flow(pair, k, fraction), np.float32(fraction), np.float32(1 - fraction)
        grid, flows = pixel_grid(rows, columns), [flow]
        bend, total = np.zeros_like(flow), np.full((rows, columns, 1), STRAIGHT, np.float32)
        # The cubic through a point's places in four frames differs from the line through the inner two by -fraction
        # (1 - fraction) / 2 times the mean of both second differences, of weights 2 - fraction and 1 + fraction.
        for near, sign, origin in ((k - 1, -1, grid - past * flow), (k + 1, 1, grid + ahead * flow)):
            if not 0 <= near < len(self.there) or near + 1 in self.cuts:
                continue
            out, home = (self.there, self.back) if sign > 0 else (self.back, self.there)
            step = warp_image(_resize_flow(out[near], self.size, (rows, columns)), origin, cv2.INTER_LINEAR)
            home = _resize_flow(home[near], self.size, (rows, columns))
            returned = warp_image(home, origin + step, cv2.INTER_LINEAR)
            miss = step + returned
            trust = (1 + (past if sign > 0 else ahead)) * np.exp(-np.einsum("yxc,yxc->yx", miss, miss))[..., None]
            bend += trust * (step - sign * flow)
            total += trust
            flows.append(sign * step)
        bend *= -past * ahead / 2 / total
        motions = [(-bend - past * flow, ahead * flow - bend) for flow in flows]
        wide = [cv2.copyMakeBorder(move, *4 * [ASIDE], cv2.BORDER_REPLICATE) for move in motions[0]]
        for x, y in ((0, ASIDE), (2 * ASIDE, ASIDE), (ASIDE, 0), (ASIDE, 2 * ASIDE)):
            motions.append(tuple(move[y : y + rows, x : x + columns] for move in wide))
        return motions

    def _interpolate_flow(
        self, pair: list[np.ndarray], k: int, fraction: float
    ) -> Float32[np.ndarray, "rows columns 2"]:
        """The flow from one image to the other, in their pixels, at each pixel of the image between them.

        First it is looked up at the positions in either image that it leads here from; then the images are warped
        along it, and the remaining flow between them is added.
        """
        rows, columns = pair[0].shape[:2]
        there, back = (_resize_flow(own[k], self.size, (rows, columns)) for own in (self.there, self.back))
        grid, past, ahead = pixel_grid(rows, columns), np.float32(fraction), np.float32(1 - fraction)
        flow = ahead * there - past * back
        for _ in range(FLOW_ITERATIONS):
            from_there = warp_image(there, grid - past * flow, cv2.INTER_LINEAR)
            from_back = warp_image(back, grid + ahead * flow, cv2.INTER_LINEAR)
            flow = ahead * from_there - past * from_back
        met = warp_image(pair[0], grid - past * flow), warp_image(pair[1], grid + ahead * flow)
        search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        return flow + search.calc(*(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in met), None)

    def _step(self, at, here, direction: int, color) -> tuple[np.ndarray, np.ndarray]:
        """The positions of points of frames `at` in the next frame (or the one before), and which are reliable."""
        flows, opposite = (self.there, self.back) if direction > 0 else (self.back, self.there)
        between = at if direction > 0 else at - 1  # flow k lies between frames k and k + 1
        move = _sample(flows, between, here, self.size)
        there = here + move
        miss = move + _sample(opposite, between, there, self.size)
        inside = ((there >= 0) & (there < [self.size[1], self.size[0]])).all(1)
        change = self._color(at + direction, there) - color
        same = np.sqrt((change * change).mean(1)) < 255 * COLOR_CHANGE
        return there, inside & same & (np.hypot(*miss.T) < self.miss + MISS_FRACTION * np.hypot(*move.T))

    def _color(self, at, position) -> np.ndarray:
        return _sample(self.small, at, position, self.size)


class CutFinder:
    """`Motion.cuts` for a clip that is given frame by frame; two frames are kept.

    For most pairs a fast flow between small images rules out a cut. Any other pair is tested as a clip of its own, on
    maps as large as those of a short clip; those of a long one, for which `Motion` saves memory, may be smaller.
    """

    def __init__(self):
        self.found: list[int] = []  # the frames, in order, that begin a new shot
        self._num, self._before = 0, None

    def add(self, frame: UInt8[np.ndarray, "height width 3"]) -> None:
        """Add the next frame. It is kept until the one after it, so it must not change."""
        columns, rows = fit_size(FAST_SIDE, *frame.shape[:2])
        now = frame, cv2.resize(frame, (columns, max(rows, FAST_ROWS)), interpolation=cv2.INTER_AREA)
        if self._before is not None:
            large, small = zip(self._before, now, strict=True)
            (known,) = Motion.from_frames(np.stack(small), cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST).measure_tracked()
            if known < SURE_FRACTION and Motion.from_frames(np.stack(large)).cuts:
                self.found.append(self._num)
        self._before, self._num = now, self._num + 1


def motion_finder(frames: np.ndarray, motion: Motion | None = None) -> Callable[[], Motion]:
    """A function that computes the optical flow of `frames` (alpha is ignored) when first called; or gives `motion`."""

    @functools.cache
    def find_motion() -> Motion:
        return Motion.from_frames(np.ascontiguousarray(frames[..., :3])) if motion is None else motion

    return find_motion


def fit_size(side: float, height: int, width: int) -> tuple[int, int]:
    """(width, height) with the longer side at most `side`, and none below 16: the flow needs a patch."""
    scale = min(1.0, side / max(height, width))
    return max(16, round(width * scale)), max(16, round(height * scale))


def _flow_side(height: int, width: int) -> int:
    """The longer side of the images that flow is computed on."""
    return FLOW_SIDE if max(height, width) > FLOW_SIDE else FLOW_SIDE // 2


def both_flows(
    one: np.ndarray, other: np.ndarray, preset: int = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
) -> tuple[np.ndarray, np.ndarray]:
    """DIS flow between two gray images (rows, columns): (rows, columns, 2) each, in pixels."""
    search = cv2.DISOpticalFlow.create(preset)
    return search.calc(one, other, None), search.calc(other, one, None)


def match_points(there, back, spacing: int, miss: float, miss_fraction: float) -> tuple[np.ndarray, ...]:
    """Every `spacing`-th pixel of an image (num, 2), where flow leads it in the other one, and which are reliable.

    Those are whose target is inside, and from there the flow back misses by less than `miss` pixels plus this fraction
    of the distance.
    """
    rows, columns = there.shape[:2]
    part = slice(spacing // 2, None, spacing)
    points, flow = (of_pixels[part, part].reshape(-1, 2) for of_pixels in (pixel_grid(rows, columns), there))
    target = points + flow
    returned = warp_image(back, target[None], cv2.INTER_LINEAR)[0]
    inside = ((target >= 0) & (target <= np.float32([columns - 1, rows - 1]))).all(1)
    return points, target, inside & (np.hypot(*(flow + returned).T) < miss + miss_fraction * np.hypot(*flow.T))


@functools.lru_cache(maxsize=4)
def pixel_grid(rows: int, columns: int) -> Float32[np.ndarray, "rows columns 2"]:
    """(x, y) of every pixel, centers at whole numbers, as in OpenCV; the array is shared and read-only."""
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).astype(np.float32)
    grid.setflags(write=False)
    return grid


def warp_image(image, origin, order: int = cv2.INTER_CUBIC) -> np.ndarray:
    """The image sampled at `origin`; beyond the border, the nearest pixel of it."""
    return cv2.remap(image, origin, None, order, borderMode=cv2.BORDER_REPLICATE)


def _resize_flow(
    flow: np.ndarray, unit: tuple[int, int], size: tuple[int, int]
) -> Float32[np.ndarray, "rows columns 2"]:
    """A flow map for images of `size` (height, width), in their pixels; it is in pixels of images of size `unit`."""
    flow = flow.astype(np.float32, copy=False)
    flow = flow if flow.shape[:2] == size else cv2.resize(flow, size[::-1])
    return flow if unit == size else flow * np.float32([size[1] / unit[1], size[0] / unit[0]])


def _move(pair: list[np.ndarray], motion, order: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Both images, moved to the one between them, and where the pixels of it lie inside them: 255, else 0."""
    rows, columns = pair[0].shape[:2]
    origins = [pixel_grid(rows, columns) + move for move in motion]
    moved = [warp_image(image, origin, order) for image, origin in zip(pair, origins, strict=True)]
    return moved, [cv2.inRange(origin, (-0.5, -0.5), (columns - 0.5, rows - 0.5)) for origin in origins]


def _compare_moved(pair: list[np.ndarray], motion) -> Float32[np.ndarray, "rows columns"]:
    """How much two images differ around each pixel of the image between them, moved to it."""
    moved, inside = _move(pair, motion, cv2.INTER_LINEAR)
    difference = cv2.absdiff(*moved)
    square = cv2.transform(cv2.multiply(difference, difference, dtype=cv2.CV_32F), np.full((1, 3), 1 / 3))
    square[cv2.min(*inside) == 0] = LACKING
    return cv2.GaussianBlur(square, (0, 0), COMPARED_WIDTH)


@kernel
def _add_average(one, other, in_one, in_other, fraction, weight, image):
    """Add `weight` times the average of two moved images; pixels from outside one of them are taken from the other."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            outside = np.float32(1.0) if in_other[y, x] else np.float32(0.0)
            later = weight[y, x] * (fraction if in_one[y, x] == in_other[y, x] else outside)
            earlier = weight[y, x] - later
            for c in range(3):
                image[y, x, c] += earlier * one[y, x, c] + later * other[y, x, c]


def _sample(stack, index, position, size) -> np.ndarray:
    """Bilinear samples of `stack[index]`, maps over frames of `size` (height, width) pixels, at positions in pixels."""
    _, rows, columns, channels = stack.shape
    scaled = position * np.float32([columns / size[1], rows / size[0]]) - np.float32(0.5)
    order = np.argsort(index, kind="stable")
    frames, starts = np.unique(index[order], return_index=True)
    if len(index) < FEW_POINTS * len(frames):
        return _gather(stack, index, scaled)
    samples = np.empty((len(index), channels), np.float32)
    stops = np.append(starts[1:], len(order))

    def sample(n: int) -> None:
        which = order[starts[n] : stops[n]]
        image = stack[frames[n]].astype(np.float32)
        for first in range(0, len(which), 32_000):  # OpenCV's limit on the size of a map
            part = which[first : first + 32_000]
            found = cv2.remap(image, scaled[part][None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            samples[part] = found.reshape(len(part), channels)

    run_tasks(sample, range(len(frames)))
    return samples


def _gather(stack, index, scaled) -> np.ndarray:
    """As `_sample`, at positions in pixels of the maps, for all frames at once: reads only the samples' own pixels."""
    _, rows, columns, _ = stack.shape
    inside = np.clip(scaled, 0, np.float32([columns - 1, rows - 1]))
    left, top = np.minimum(inside.astype(np.int64), [columns - 2, rows - 2]).T
    right, low = (inside - np.stack([left, top], -1)).astype(np.float32).T[..., None]

    def row(y) -> np.ndarray:
        one, other = (stack[index, y, x].astype(np.float32) for x in (left, left + 1))
        return one + right * (other - one)

    above, below = row(top), row(top + 1)
    return above + low * (below - above)


#: Ridge on the coefficients, in frames at the edge of the window: a weak prior for rest, a stronger one against
#: curvature. Short tracks show neither.
RIDGES = np.array([0.03, 0.12, 0.48])
#: Width of the window in which a fold has to follow its track, in units of sigma_t: where the Gaussian is visible.
WINDOW = 1.2
#: A power is used only if the fold without it misses by more than this many pixels, see also `fit_powers`: beyond its
#: track a cubic leaves the frame.
NEEDED = 0.3
CHUNK = 256  # tracks per task


def fit_folds(
    tracks: Tracks, spread: Float32[np.ndarray, " num"], degree: int
) -> tuple[Float32[np.ndarray, "num degree 2"], Float32[np.ndarray, " num"]]:
    """Fit polynomials in u = own time - t to the tracks, within windows of width `spread` (num,), in frames.

    Returns coefficients (num, degree, 2), in pixels per frame^k, and the root mean square distance (num,) in pixels
    from the track. Least squares without a constant, with as many powers as the track needs; those above the third
    are 0, since tracks do not determine them.
    """
    (num, steps), highest = tracks.known.shape, min(degree, len(RIDGES))
    coefficients, miss = np.zeros((num, degree, 2), np.float32), np.empty(num, np.float32)
    u = np.arange(steps // 2, -(steps // 2) - 1, -1.0)
    orders, used = np.arange(2 * highest + 1), np.arange(1, highest + 1)
    powers = u[:, None] ** orders  # all tracks have the same times, so sums over these are matrix products

    def fit(start: int) -> None:
        part = slice(start, start + CHUNK)
        window = WINDOW * np.asarray(spread[part], np.float64)[:, None]
        shift = np.moveaxis(tracks.shift[part], 2, 0).astype(np.float64, order="C")
        unit = np.minimum(window, steps // 2) ** orders
        weight = np.exp(-0.5 * u**2 / window**2) * tracks.known[part]
        weighted, sums = weight * shift, weight @ powers / unit
        total = sums[:, :1]
        right = np.moveaxis(weighted @ powers[:, used] / unit[:, used] / total, 0, 2)
        squares = np.einsum("cns,cns->n", weighted, shift) / total[:, 0]
        normal = sums[:, used[:, None] + used] / total[..., None]
        found, miss[part] = fit_powers(normal, right, squares, RIDGES[:highest] / total, min(degree, 1), NEEDED)
        coefficients[part, :highest] = found / unit[:, used, None]

    run_tasks(fit, range(0, num, CHUNK))
    return coefficients, miss
