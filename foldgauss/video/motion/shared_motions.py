"""Motions that many Gaussians of a fit share, estimated from optical flow: that of the camera, and of objects."""

import dataclasses
import itertools
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from foldgauss._runtime.threads import run_tasks
from foldgauss.video.motion.camera_path import INLIER, ITERATIONS, SIDE, fit_affine, pixels_to_model
from foldgauss.video.motion.optical_flow import Motion

#: The camera's maps are estimated from every so many cells of the flow's maps.
SPACING = 4
#: A point tells how something moves where the image has at least this slope, in levels of 255 per cell of the flow's
#: maps: elsewhere flow is interpolated. At least this fraction of the points must.
TEXTURE, LEAST_TEXTURED = 2.0, 0.1
#: RANSAC, in pixels: flow is less exact than this in small frames.
LEAST_INLIER = 0.3
#: Gaussians follow a camera whose motion changes from frame to frame by this, in units of the frame's longer side (the
#: median of second differences): folds follow steadier motion as well, without a map for each frame, which costs time
#: and can make up for frame times. (Gains: carphone 4e-3, car-shadow 2e-3, bear 3e-4; none: Bunny 8e-5.)
STEADY = 2.2e-4
#: The largest zoom (as its logarithm) and the largest distance, in units of the frame's longer side, between a frame
#: and the one in whose coordinates Gaussians are placed. Where the motion goes farther, it is forgotten by these
#: fractions in each frame; then Gaussians' own folds take over its slow part.
FARTHEST, FORGOTTEN = (1.0, 4.0), (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
#: Objects are found from tracks of points on a grid of every so many cells, in every so many frames, so many frames
#: long at most to either side; at most so many tracks.
TRACK_SPACING, TRACK_GAP, TRACK_REACH, MAX_TRACKS = 6, 4, 12, 20_000
#: Motions besides that of the camera.
MAX_OBJECTS = 1
#: At least this fraction of the tracks must be followed better than by the motions known so far.
LEAST_FOLLOWED = 0.02
#: A track is followed if it strays from its mean by less than this, in units of RANSAC's threshold.
STRAY = 1.5
#: An object's motion is estimated from the tracks that none of the others follows, then from those that it follows
#: itself within these multiples of `STRAY`.
ROUNDS = (3.0, 3.0, 3.0, 1.5, 1.5, 1.5)
#: The fewest tracks that tell an object's motion between two frames, and those of them that must agree.
FEWEST, AGREEING = 8, 6


def find_shared_motions(motion: Motion, max_objects: int = MAX_OBJECTS) -> Float[np.ndarray, "paths frames 2 3"] | None:
    """The maps from coordinates that follow the camera to each frame, then those of objects, in model space.

    None where the camera's motion is steady or unknown. In the middle frame of each shot coordinates are the frame's.
    Where a motion is unknown between two frames, it is taken to be the camera's, and that of the camera to be none. An
    object is what moves as a whole, in another way than the camera: also a background that is nearer or farther.

    Source: Fischler and Bolles 1981 (RANSAC), one motion after another; tracks decide which points belong to which.
    """
    clip = _Clip.of(motion)
    camera = clip.find_camera_steps()
    path = clip.chain_within_limits(camera)
    if path is None or clip.measure_unsteadiness(camera) <= STEADY:
        return None
    return np.stack([path, *_find_objects(clip, camera, max_objects)])[:, :, :2]


@dataclasses.dataclass(frozen=True)
class _Clip:
    """The flow of a clip, its shots, RANSAC's threshold in pixels, and the map of its pixels to model space."""

    motion: Motion
    shots: list[tuple[int, int]]
    inlier: float
    to_model: Float[np.ndarray, "3 3"]

    @classmethod
    def of(cls, motion: Motion) -> "_Clip":
        to_model = pixels_to_model(motion.size)
        to_model[:2, 2] -= 0.5 / max(motion.size)  # `Motion` has pixel centers at 0.5
        shots = list(itertools.pairwise([0, *motion.find_cuts(), len(motion.small)]))
        return cls(motion, shots, max(INLIER * max(motion.size) / SIDE, LEAST_INLIER), to_model)

    @property
    def pairs(self) -> list[int]:
        """The frames that have a next one in their shot."""
        return [k for first, stop in self.shots for k in range(first, stop - 1)]

    def in_model(self, affine: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
        """Maps of model space from maps of pixels."""
        return self.to_model @ affine @ np.linalg.inv(self.to_model)

    def find_textured(self, k: int, spacing: int) -> Bool[np.ndarray, " num"]:
        """Which points of the grid of frame k tell how something moves."""
        return self.motion.find_texture(k, spacing) > TEXTURE

    def find_camera_steps(self) -> Float[np.ndarray, "frames 3 3"]:
        """The map from the frame before to each frame that most of the image follows; the identity if unknown."""
        steps = np.tile(np.eye(3), (len(self.motion.small), 1, 1))

        def estimate(k: int) -> None:
            points, target, known = self.motion.match_grid(k, SPACING)
            textured = self.find_textured(k, SPACING)
            if textured.mean() < LEAST_TEXTURED:
                return
            found = fit_affine(points[textured], target[textured], known[textured], self.inlier)
            if found is not None:
                steps[k + 1] = self.in_model(found[0])

        run_tasks(estimate, self.pairs)
        return steps

    def chain(self, steps: Float[np.ndarray, "frames 3 3"], forgotten: float = 0.0) -> Float[np.ndarray, "frames 3 3"]:
        """The maps to each frame from the middle frame of its shot; in each, a fraction of the path is `forgotten`."""
        maps = np.tile(np.eye(3), (len(steps), 1, 1))
        for first, stop in self.shots:
            for k in range(first + 1, stop):
                maps[k] = steps[k] @ ((1 - forgotten) * maps[k - 1] + forgotten * np.eye(3))
            maps[first:stop] = maps[first:stop] @ np.linalg.inv(maps[(first + stop - 1) // 2])
        return maps

    def chain_within_limits(self, steps: Float[np.ndarray, "frames 3 3"]) -> Float[np.ndarray, "frames 3 3"] | None:
        """The maps of which as little is forgotten as `FARTHEST` allows; None if all had to be."""
        return next((maps for maps in (self.chain(steps, own) for own in FORGOTTEN) if _is_near(maps)), None)

    def measure_unsteadiness(self, steps: Float[np.ndarray, "frames 3 3"]) -> float:
        """The median over frames of the second difference of the places of four points: 0 at constant velocity."""
        height, width = np.array(self.motion.size) / max(self.motion.size)
        points = np.array([[0.35 * x * width, 0.35 * y * height, 1] for x in (-1, 1) for y in (-1, 1)])
        changes = [0.0]
        for first, stop in self.shots:
            for k in range(first + 1, stop - 1):
                before, after = points @ np.linalg.inv(steps[k]).T, points @ steps[k + 1].T
                change = (before - 2 * points + after)[:, :2]
                changes.append(float(np.sqrt((change**2).sum(1).mean())))
        return float(np.median(changes))


def _is_near(maps: Float[np.ndarray, "frames 3 3"]) -> bool:
    """Whether no map zooms or moves by more than `FARTHEST`."""
    both = np.concatenate([maps, np.linalg.inv(maps)])
    zooms = np.log(np.linalg.svd(both[:, :2, :2], compute_uv=False))
    return bool(np.abs(zooms).max() < FARTHEST[0] and np.abs(both[:, :2, 2]).max() < FARTHEST[1])


# ------------------------------------------------------------------------------------------------------- objects


def _find_objects(clip: _Clip, camera: Float[np.ndarray, "frames 3 3"], max_objects: int) -> list[np.ndarray]:
    """Maps to each frame, (frames, 3, 3), of up to `max_objects`: one after another, what moves otherwise."""
    points, limit = _Points.of(clip), STRAY * clip.inlier
    best, found = points.measure_stray(clip.chain(camera)), []
    for _ in range(max_objects):
        followed = left = best > limit
        for wide in ROUNDS:
            if followed.sum() < max(LEAST_FOLLOWED * len(followed), FEWEST):
                return found
            steps = points.estimate_steps(followed, camera)
            own = points.measure_stray(clip.chain(steps))
            followed = left & (own < best) & (own < wide * limit)
        maps = clip.chain_within_limits(steps)
        if maps is None or (left & (own < limit)).mean() < LEAST_FOLLOWED:
            return found
        found.append(maps)
        best = np.minimum(best, own)
    return found


@dataclasses.dataclass(frozen=True)
class _Points:
    """Tracks of points of textured places: `place` (num, steps, 2) in pixels of `frame`, where they are `known`."""

    clip: _Clip
    frame: Int[np.ndarray, "num steps"]
    place: Float[np.ndarray, "num steps 2"]
    known: Bool[np.ndarray, "num steps"]

    @classmethod
    def of(cls, clip: _Clip) -> "_Points":
        homes = clip.pairs[::TRACK_GAP]
        grids = [clip.motion.match_grid(k, TRACK_SPACING)[0][clip.find_textured(k, TRACK_SPACING)] for k in homes]
        home, position = np.repeat(homes, [len(grid) for grid in grids]), np.concatenate([np.zeros((0, 2)), *grids])
        if len(home) > MAX_TRACKS:
            drawn = np.sort(np.random.default_rng(0).choice(len(home), MAX_TRACKS, replace=False))
            home, position = home[drawn], position[drawn]
        tracks = clip.motion.follow(home, position.astype(np.float32), longest=TRACK_REACH)
        long = tracks.reach > 2
        last = len(clip.motion.small) - 1
        frame = np.clip(home[:, None] + np.arange(-TRACK_REACH, TRACK_REACH + 1), 0, last)
        return cls(clip, frame[long], (position[:, None] + tracks.shift)[long], tracks.known[long])

    def measure_stray(self, maps: Float[np.ndarray, "frames 3 3"]) -> Float[np.ndarray, " num"]:
        """The distance, pixels rms, of each track from its mean, in the coordinates that `maps` take to the frames."""
        inverse = (np.linalg.inv(self.clip.to_model) @ np.linalg.inv(maps) @ self.clip.to_model)[self.frame]
        place = np.einsum("nkij,nkj->nki", inverse[..., :2, :2], self.place) + inverse[..., :2, 2]
        known = self.known[..., None]
        mean = place.mean(1, keepdims=True, where=known)
        return np.sqrt(((place - mean) ** 2).sum(2).mean(1, where=self.known))

    def estimate_steps(
        self, which: Bool[np.ndarray, " num"], otherwise: Float[np.ndarray, "frames 3 3"]
    ) -> Float[np.ndarray, "frames 3 3"]:
        """The map from the frame before to each frame that most of the tracks `which` follow, or else the other's."""
        steps, by_frame = otherwise.copy(), self._pairs_of(which)
        for k in self.clip.pairs:
            one, other = by_frame(k)
            if len(one) < FEWEST:
                continue
            affine, used = cv2.estimateAffine2D(
                one, other, ransacReprojThreshold=self.clip.inlier, maxIters=ITERATIONS // 4, confidence=0.999
            )
            if affine is not None and used.sum() >= AGREEING and np.linalg.det(affine[:, :2]) > 0.1:
                steps[k + 1] = self.clip.in_model(np.vstack([affine, [0, 0, 1]]))
        return steps

    def _pairs_of(self, which: Bool[np.ndarray, " num"]) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
        """From a frame to the places of tracks `which` in it and in the next one."""
        row, step = np.nonzero(which[:, None] & self.known[:, :-1] & self.known[:, 1:])
        frame = self.frame[row, step]
        order = np.argsort(frame, kind="stable")
        row, step, ends = (
            row[order],
            step[order],
            np.searchsorted(frame[order], np.arange(len(self.clip.motion.small) + 1)),
        )

        def places(k: int) -> tuple[np.ndarray, np.ndarray]:
            part = slice(ends[k], ends[k + 1])
            return self.place[row[part], step[part]], self.place[row[part], step[part] + 1]

        return places
