"""The background of a clip: homographies between its frames, and images of it in which nothing is in front."""

import dataclasses
import itertools

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, UInt8

from foldgauss._runtime.checks import require
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.motion.optical_flow import both_flows, match_points

#: The longer side, in pixels, of the images that flow is computed on.
SIDE = 480
#: The distance of the points in these images, in pixels.
SPACING = 6
#: A point is used where forward and backward flow agree within this many pixels,
MISS = 1.0
#: and this fraction of the distance.
MISS_FRACTION = 0.1
#: Another shot begins where a smaller fraction of the points is used.
LEAST_KNOWN = 0.3
#: MAGSAC: the largest scale of noise, in pixels.
NOISE = 0.5
#: MAGSAC: iterations at most.
ITERATIONS = 2000
#: Frames are aligned with one that is further away, so that errors do not add up, while this fraction of the points
#: follows one homography.
KEY_INLIERS = 0.35
#: A homography has 8 parameters, of which a point gives two.
LEAST_POINTS = 8
#: A plate is the median of at most so many frames,
PLATE_FRAMES = 14
#: of those at most so many frames away.
PLATE_REACH = 40
#: Holes of a plate are filled from frames in which at least this fraction of a pixel is uncovered.
UNCOVERED = 250 / 255
#: Texture is made anew where more than this fraction of what is unknown in a frame was in no other frame.
NEW_TEXTURE = 0.1
#: Texture is made in a window reduced to this longer side, in pixels. At half of the size it takes a fifth to a tenth
#: of the time.
TEXTURE_SIDE = 240
#: What an object covers is replaced with this margin, a fraction of the longer side.
MARGIN = 0.012

Frames = UInt8[np.ndarray, "frames height width 3"]
Masks = Bool[np.ndarray, "frames height width"]


@dataclasses.dataclass(frozen=True)
class Alignment:
    """How the background of each frame moves to the others, on images whose longer side is `SIDE`.

    `images` are the frames of that size, in gray; `there` and `back` the flow between neighbors, both ways;
    `matrices` (frames, 3, 3) homographies from the first frame of a shot to each frame of it, in pixels of the images,
    whose centers are whole numbers. A shot begins at each of `starts`.

    Source: Kroeger et al. 2016 (DIS flow); Barath et al. 2019 (MAGSAC).
    """

    images: UInt8[np.ndarray, "frames rows columns"]
    there: Float16[np.ndarray, "intervals rows columns 2"]
    back: Float16[np.ndarray, "intervals rows columns 2"]
    matrices: Float[np.ndarray, "frames 3 3"]
    starts: tuple[int, ...]

    @classmethod
    def from_frames(cls, frames: Frames) -> "Alignment":
        images = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in resize_frames(frames)])
        flows = np.empty((2, len(images) - 1, *images.shape[1:], 2), np.float16)

        def match(k: int) -> None:
            flows[0, k], flows[1, k] = both_flows(images[k], images[k + 1])

        run_tasks(match, range(len(images) - 1))
        matrices, starts = _chain(images, *flows)
        return cls(images, *flows, matrices, starts)

    @property
    def shots(self) -> list[tuple[int, int]]:
        """The first frame of each shot and the one after its last."""
        return list(itertools.pairwise([*self.starts, len(self.images)]))

    def of_shot(self, first: int, stop: int) -> "Alignment":
        """The alignment of the frames of a shot alone."""
        between = slice(first, stop - 1)
        return Alignment(
            self.images[first:stop], self.there[between], self.back[between], self.matrices[first:stop], (0,)
        )

    def between(self, frame: int, other: int) -> Float[np.ndarray, "3 3"]:
        """The map of points of the background in one frame to another of the same shot."""
        return self.matrices[other] @ np.linalg.inv(self.matrices[frame])

    def flow(self, frame: int, other: int) -> tuple[Float32[np.ndarray, "rows columns 2"], ...]:
        """The flow from a frame to one of its neighbors, and the flow back."""
        pair = (self.there, self.back) if other > frame else (self.back, self.there)
        return tuple(one[min(frame, other)].astype(np.float32) for one in pair)


def resize_frames(frames: Frames) -> UInt8[np.ndarray, "frames rows columns 3"]:
    """The frames with a longer side of `SIDE` pixels: small ones are enlarged, so that all lengths are of one unit."""
    height, width = frames.shape[1:3]
    scale = SIDE / max(height, width)
    size = max(16, round(width * scale)), max(16, round(height * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.stack([cv2.resize(frame, size, interpolation=how) for frame in frames])


def check_frames(frames: np.ndarray, least: int = 3) -> None:
    """Raise ValueError unless these are color frames, three of them at least or as many as given."""
    shape, dtype = np.shape(frames), getattr(frames, "dtype", None)
    require(
        len(shape) == 4 and shape[0] >= least and shape[-1] == 3 and 0 not in shape and dtype == np.uint8,
        "frames",
        expected=f"uint8 (num_frames, height, width, 3) of {least} or more frames",
        got=f"{type(frames).__name__ if dtype is None else dtype} {shape}",
    )


def check_masks(frames: Frames, masks: np.ndarray) -> None:
    """Raise ValueError unless there is one mask for each frame, of its size."""
    shape, dtype = np.shape(masks), np.asarray(masks).dtype
    require(
        shape == frames.shape[:3] and dtype.kind == "b",
        "masks",
        expected=f"bool {frames.shape[:3]}",
        got=f"{dtype} {shape}",
    )


def cover(masks: Masks, margin: float = MARGIN) -> Masks:
    """The masks grown by a fraction of the longer side: what is outside `MARGIN` is taken to be background."""
    diameter = 2 * round(margin * max(masks.shape[1:])) + 1
    return np.stack([dilate(mask, diameter) for mask in masks])


def complete_background(frames: Frames, covered: Masks, alignment: Alignment | None = None) -> tuple[Frames, float]:
    """The frames with the background in place of what is `covered`, and the fraction of it that no frame shows.

    A pixel is the median of the frames that show it, up to `PLATE_REACH` frames away within its shot. One that no frame
    shows is filled with texture in one frame of its shot and moved with the background to the others, so that it keeps
    still.

    Source: He and Sun 2012, statistics of patch offsets (OpenCV's `xphoto`); Telea 2004 for small rests.
    """
    alignment = Alignment.from_frames(frames) if alignment is None else alignment
    plates, unknown = frames.copy(), np.zeros_like(covered)

    def fill(item: tuple[int, tuple[int, int]]) -> None:
        k, shot = item
        if covered[k].any():
            x, y, width, height = cv2.boundingRect(covered[k].astype(np.uint8))
            window = slice(y, y + height), slice(x, x + width)
            plate, count = render_plate(frames, covered, alignment, k, shot, box=window)
            inside = covered[k][window]
            plates[k][window][inside] = plate[inside]
            unknown[k][window] = inside & (count == 0)

    run_tasks(fill, [(k, shot) for shot in alignment.shots for k in range(*shot)])
    fraction = float(unknown.sum() / max(covered.sum(), 1))
    for first, stop in alignment.shots:
        _fill_unknown(plates, unknown, alignment, range(first, stop))
    return plates, fraction


def _fill_unknown(plates: Frames, unknown: Masks, alignment: Alignment, shot: range) -> None:
    """Fill what no frame of a shot shows, from its middle on, in place."""
    size = plates.shape[2], plates.shape[1]
    to_image = _scale_pixels(plates.shape[1:3], alignment.images.shape[1:])
    filled: list[int] = []
    for k in sorted(shot, key=lambda k: abs(k - shot[len(shot) // 2])):
        rest = unknown[k].copy()
        for other in filled:
            if not rest.any():
                break
            to_other = np.linalg.inv(to_image) @ alignment.between(k, other) @ to_image
            known = rest & (warp_by(np.uint8(unknown[other]), to_other, size, cv2.BORDER_CONSTANT) > 0)
            plates[k][known] = warp_by(plates[other], to_other, size)[known]
            rest &= ~known
        if not rest.any():
            continue
        if rest.sum() > NEW_TEXTURE * unknown[k].sum():
            filled.append(k)
            fill_with_texture(plates[k], rest)
        else:
            plates[k] = cv2.inpaint(plates[k], np.uint8(rest), 3, cv2.INPAINT_TELEA)


def fill_with_texture(image: UInt8[np.ndarray, "height width 3"], unknown: Bool[np.ndarray, "height width"]) -> None:
    """Fill what is unknown in the image with texture from its surroundings, in place."""
    x, y, width, height = cv2.boundingRect(np.uint8(unknown))
    around = max(width, height) // 2 + 8
    window = slice(max(y - around, 0), y + height + around), slice(max(x - around, 0), x + width + around)
    whole, scale = image[window].shape[1::-1], min(1.0, TEXTURE_SIDE / (max(width, height) + 2 * around))
    size = max(round(scale * whole[0]), 1), max(round(scale * whole[1]), 1)
    lab = cv2.cvtColor(cv2.resize(image[window], size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2LAB)
    missing = cv2.resize(np.float32(unknown[window]), size, interpolation=cv2.INTER_AREA) > 0
    found = np.zeros_like(lab)
    cv2.setRNGSeed(0)
    cv2.xphoto.inpaint(lab, np.uint8(255 * ~missing), found, cv2.xphoto.INPAINT_SHIFTMAP)
    found = cv2.resize(cv2.cvtColor(found, cv2.COLOR_LAB2RGB), whole, interpolation=cv2.INTER_CUBIC)
    image[unknown] = found[unknown[window]]


def render_plate(
    frames: Frames,
    covered: Masks,
    alignment: Alignment,
    k: int,
    shot: tuple[int, int],
    box: tuple[slice, slice] | None = None,
) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"]]:
    """The background of frame k, black where it is unknown, and how many frames show each of its pixels.

    `box`: only this part. Frames and masks may be larger than the alignment's images.
    """
    height, width = frames.shape[1:3]
    rows, columns = (slice(0, height), slice(0, width)) if box is None else box
    size = columns.stop - columns.start, rows.stop - rows.start
    to_box = np.array([[1, 0, columns.start], [0, 1, rows.start], [0, 0, 1]], float)
    to_image = _scale_pixels((height, width), alignment.images.shape[1:])
    first, last = max(shot[0], k - PLATE_REACH), min(shot[1] - 1, k + PLATE_REACH)
    others = np.unique(np.linspace(first, last, min(PLATE_FRAMES, last - first + 1)).round().astype(int))
    stack, known = np.empty((len(others), size[1], size[0], 3), np.uint8), np.empty((len(others), *size[::-1]), bool)
    for n, j in enumerate(others):
        to_other = np.linalg.inv(to_image) @ alignment.between(k, j) @ to_image @ to_box
        stack[n] = warp_by(frames[j], to_other, size)
        known[n] = warp_by(255 * np.uint8(~covered[j]), to_other, size, cv2.BORDER_CONSTANT) >= 255 * UNCOVERED
    count = known.sum(0, dtype=np.uint8)
    ordered = np.sort(np.where(known[..., None], stack, 255), axis=0)  # what is unknown comes last
    lower_median = np.take_along_axis(ordered, (np.maximum(count, 1)[None, ..., None] - 1) // 2, 0)[0]
    return np.where(count[..., None] > 0, lower_median, np.uint8(0)), count


def warp_by(image, matrix: Float[np.ndarray, "3 3"], size: tuple[int, int], border: int = cv2.BORDER_REPLICATE):
    """The image whose point p shows the point `matrix` p of the given one; `size` is (width, height)."""
    return cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=border)


def dilate(mask: Bool[np.ndarray, "height width"], diameter: int) -> Bool[np.ndarray, "height width"]:
    """The mask, grown by half of the diameter on all sides."""
    return cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))) > 0


def _chain(images, there, back) -> tuple[Float[np.ndarray, "frames 3 3"], tuple[int, ...]]:
    """Homographies from the first frame of each shot to its frames, and the starts of shots.

    A frame is aligned with the last key frame, not with its neighbor only, so that errors add up at key frames alone.
    """
    matrices, starts = np.tile(np.eye(3), (len(images), 1, 1)), [0]
    key, from_key = 0, np.eye(3)
    for k in range(1, len(images)):
        step = find_homography(there[k - 1].astype(np.float32), back[k - 1].astype(np.float32))
        if step is None:
            key, from_key = k, np.eye(3)
            starts.append(k)
            continue
        rest = _align(images[key], images[k], step[0] @ from_key)
        if rest is None or rest[1] < KEY_INLIERS:
            key, from_key = k - 1, np.eye(3)
            rest = _align(images[key], images[k], step[0])
        from_key = step[0] @ from_key if rest is None else rest[0]
        from_key = from_key / from_key[2, 2]
        matrices[k] = from_key @ matrices[key]
        matrices[k] /= matrices[k, 2, 2]
    return matrices, tuple(starts)


def _align(one, other, start: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "3 3"], float] | None:
    """The homography between two images, and the fraction of points that follow it, from one that is about right."""
    size = one.shape[::-1]
    inside = cv2.erode(warp_by(np.ones_like(other), start, size, cv2.BORDER_CONSTANT), np.ones((7, 7))) > 0
    found = find_homography(*both_flows(one, warp_by(other, start, size)), inside)
    return None if found is None else (start @ found[0], found[1])


def find_homography(there, back, inside=None) -> tuple[Float[np.ndarray, "3 3"], float] | None:
    """The homography that most points follow, and their fraction; None if the flow is that of two different scenes."""
    points, target, known = match_points(there, back, SPACING, MISS, MISS_FRACTION)
    if inside is not None:
        part = slice(SPACING // 2, None, SPACING)
        points, target, known = (leaf[inside[part, part].ravel()] for leaf in (points, target, known))
    if known.sum() < max(LEAST_POINTS, LEAST_KNOWN * len(points)):
        return None
    cv2.setRNGSeed(0)
    matrix, used = cv2.findHomography(
        points[known], target[known], cv2.USAC_MAGSAC, NOISE, maxIters=ITERATIONS, confidence=0.9999
    )
    if matrix is None or np.linalg.det(matrix) <= 0:
        return np.eye(3), 0.0
    return matrix, float(used.sum() / len(points))


def _scale_pixels(size: tuple[int, int], to: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """The map of pixels of images of one size to those of another, with centers at whole numbers."""
    x, y = to[1] / size[1], to[0] / size[0]
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
