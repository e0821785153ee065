"""Motions that many Gaussians of a fit share, estimated from optical flow: that of the camera, and of objects."""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Bool, Float, Int

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.threads import run_tasks
from foldgauss.video.motion.camera_path import INLIER, LEAST_INLIERS, SIDE, fit_affine, pixels_to_model
from foldgauss.video.motion.optical_flow import Motion

#: The camera's maps are estimated from every so many cells of the flow's maps.
SPACING = 4
#: A point tells how something moves where the image has at least this slope, in levels of 255 per cell of the flow's
#: maps: elsewhere flow is interpolated.
TEXTURE = 2.0
#: At least this fraction of the points must.
LEAST_TEXTURED = 0.1
#: RANSAC, in pixels: flow is less exact than this in small frames.
LEAST_INLIER = 0.3
#: Gaussians follow the camera in shots in which it is unsteadier than this: the mean of the fourth differences of its
#: path, which are 0 for cubics, in units of the frame's longer side and of those of noise whose second differences are
#: 1. Folds follow steadier motion as well, without a map for each frame, which costs time. (Unsteady: carphone 3.1e-3,
#: bear 2.9e-4; steady: Bunny 8e-5, a rotation by 40 degrees in a second 7e-5. A camera that shakes for a while counts,
#: and so do missing frames: one of 30 in a pan costs 4 dB without a path, more than learned frame times make up for.)
STEADY = 1.6e-4
#: But not by less than this many pixels: flow is not as exact. (Steady pans of 64x96: up to 0.027.)
LEAST_UNSTEADY = 0.03
#: Where they do not follow the camera, they follow an object that is unsteadier than this: a step with any path takes a
#: tenth longer. (Bunny: 2.9e-4, as good as without at equal steps.)
SMOOTH = 1.1e-3
#: The largest zoom (as its logarithm) and the largest distance, in units of the frame's longer side, between a frame
#: and the one in whose coordinates Gaussians are placed.
FARTHEST = (1.0, 4.0)
#: Where the motion goes farther, it is forgotten by these fractions in each frame; then Gaussians' own folds take over
#: its slow part.
FORGOTTEN = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
#: Objects are found from tracks of points on a grid of every so many cells,
TRACK_SPACING = 6
#: in every so many frames,
TRACK_GAP = 4
#: so many frames long at most to either side;
TRACK_REACH = 12
#: at most so many tracks.
MAX_TRACKS = 20_000
#: An object's path follows at least this fraction of all tracks, of those that the camera's path does not.
LEAST_FOLLOWED = 0.02
#: A path follows a track that strays from its mean by less than this, in units of RANSAC's threshold. Distances are
#: those of the coordinates that follow the path: pixels in the middle of each shot.
STRAY = 1.5
#: An object's motion is estimated so many times: from the tracks that no path follows yet, and then from those of them
#: that stray less from it than from the others,
ROUNDS = 4
#: and by at most this multiple of `STRAY`.
WIDER = 3.0
#: The fewest tracks that tell an object's motion between two frames.
FEWEST = 8
#: Those of them that must agree.
AGREEING = 6


def find_shared_motions(motion: Motion, *, steady: bool = False) -> Float[np.ndarray, "paths frames 2 3"] | None:
    """The maps from coordinates that follow the camera to each frame, then those of objects, in model space.

    Those that move steadily are left out, unless `steady` asks for that of the camera; None if all are. In the middle
    frame of each shot coordinates are the frame's, and so they are in shots whose camera moves steadily. Where a motion
    is unknown between two frames, it is taken to be the camera's, and that of the camera to be none. An object is what
    moves as a whole, in another way than the camera: also a background that is nearer or farther.

    Source: Fischler and Bolles 1981 (RANSAC), one motion after another; tracks decide which points belong to which.
    """
    clip = _Clip.of(motion)
    steps = clip.find_camera_steps()
    camera = np.where(np.isnan(steps), np.eye(3), steps)
    path = clip.chain_within_limits(camera if steady else clip.keep_unsteady(steps, camera))
    found = [path] if path is not None and (path != np.eye(3)).any() else []
    path = _find_object(clip, camera, smooth=None if found else SMOOTH)
    found += [] if path is None else [path]
    return np.stack(found)[:, :, :2] if found else None


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
        shots = list(itertools.pairwise([0, *motion.cuts, len(motion.small)]))
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
        """The map from the frame before to each frame that most of the image follows; NaN if unknown."""
        steps = np.full((len(self.motion.small), 3, 3), np.nan)

        def estimate(k: int) -> None:
            points, target, known = self.motion.match_grid(k, SPACING)
            textured = self.find_textured(k, SPACING)
            if textured.mean() < LEAST_TEXTURED:
                return
            known &= textured
            found = fit_affine(points[known], target[known], self.inlier, LEAST_INLIERS * textured.sum())
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

    def keep_unsteady(
        self, steps: Float[np.ndarray, "frames 3 3"], camera: Float[np.ndarray, "frames 3 3"]
    ) -> Float[np.ndarray, "frames 3 3"]:
        """The steps of the `camera`, none in shots where the unsteadiness of the known `steps` is at most `STEADY`."""
        height, width = np.array(self.motion.size) / max(self.motion.size)
        corners = [[0.35 * x * width, 0.35 * y * height] for x in (-1, 1) for y in (-1, 1)]
        kept = camera.copy()
        changes = self.measure_changes(steps, np.tile(corners, (len(steps), 1, 1)))
        for first, stop in self.shots:
            if not _are_larger(changes[first:stop], max(STEADY, LEAST_UNSTEADY / max(self.motion.size))):
                kept[first:stop] = np.eye(3)
        return kept

    def measure_changes(
        self, steps: Float[np.ndarray, "frames 3 3"], places: Float[np.ndarray, "frames num 2"]
    ) -> Float[np.ndarray, " frames"]:
        """The fourth differences of points at `places` in each frame, as of `STEADY`, rms over the points.

        NaN in frames less than two from the ends of a shot, and where steps or places are NaN, which is unknown.
        """
        weights, changes = np.array([1, -4, 6, -4, 1]), np.full(len(steps), np.nan)
        for first, stop in self.shots:
            for k in range(first + 2, stop - 2):
                points = np.concatenate([places[k], np.ones((len(places[k]), 1))], 1)
                before = points @ np.linalg.inv(steps[k]).T
                after = points @ steps[k + 1].T
                path = [before @ np.linalg.inv(steps[k - 1]).T, before, points, after, after @ steps[k + 2].T]
                change = np.einsum("i,inj->nj", weights, path)[:, :2]
                changes[k] = np.sqrt((change**2).sum(1).mean())
        return changes * np.sqrt(6 / 70)  # the sums of the squared weights of second and of fourth differences


def _are_larger(changes: Float[np.ndarray, " frames"], least: float) -> bool:
    """Whether the mean of those that are known is larger."""
    known = changes[~np.isnan(changes)]
    return len(known) > 0 and bool(known.mean() > least)


def _is_near(maps: Float[np.ndarray, "frames 3 3"]) -> bool:
    """Whether no map zooms or moves by more than `FARTHEST`."""
    both = np.concatenate([maps, np.linalg.inv(maps)])
    zooms = np.log(np.linalg.svd(both[:, :2, :2], compute_uv=False))
    return bool(np.abs(zooms).max() < FARTHEST[0] and np.abs(both[:, :2, 2]).max() < FARTHEST[1])


# ------------------------------------------------------------------------------------------------------- objects


def _find_object(
    clip: _Clip, camera: Float[np.ndarray, "frames 3 3"], smooth: float | None
) -> Float[np.ndarray, "frames 3 3"] | None:
    """Maps to each frame of what moves otherwise than the camera; None if nothing does, or not unsteadily.

    It has to be unsteadier than `smooth`, if given.
    """
    points, limit = _Points.of(clip), STRAY * clip.inlier
    by_camera = points.measure_stray(clip.chain(camera))
    followed = left = by_camera > limit
    for _ in range(ROUNDS):
        if not points.are_enough(followed):
            return None
        steps = points.estimate_steps(followed)
        known = np.where(np.isnan(steps), camera, steps)
        own = points.measure_stray(clip.chain(known))
        followed = left & (own < by_camera) & (own < WIDER * limit)
    maps = clip.chain_within_limits(known)
    if maps is None:
        return None
    followed = left & (points.measure_stray(maps) < limit)
    if not points.are_enough(followed):
        return None
    if smooth is not None and not _are_larger(clip.measure_changes(steps, points.find_middle(followed)), smooth):
        return None
    return maps


@dataclasses.dataclass(frozen=True)
class _Points:
    """Tracks of points of textured places: `place` (num, steps, 2) in pixels of `frame`, where they are `known`."""

    clip: _Clip
    frame: Int[np.ndarray, "num steps"]
    place: Float[np.ndarray, "num steps 2"]
    known: Bool[np.ndarray, "num steps"]

    @classmethod
    def of(cls, clip: _Clip) -> "_Points":
        homes = np.array(clip.pairs[::TRACK_GAP], int)
        grid = clip.motion.grid(TRACK_SPACING)
        textured = [clip.find_textured(k, TRACK_SPACING) for k in homes]
        home = np.repeat(homes, [which.sum() for which in textured])
        position = np.concatenate([np.zeros((0, 2)), *(grid[which] for which in textured)])
        if len(home) > MAX_TRACKS:
            drawn = np.sort(make_generator(Stream.TRACK).choice(len(home), MAX_TRACKS, replace=False))
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

    def are_enough(self, which: Bool[np.ndarray, " num"]) -> bool:
        """Whether these tracks are an object."""
        return which.sum() >= max(LEAST_FOLLOWED * len(which), FEWEST)

    def find_middle(self, which: Bool[np.ndarray, " num"]) -> Float[np.ndarray, "frames 1 2"]:
        """The mean place of these tracks in each frame, in model space; NaN where there are none."""
        known = which[:, None] & self.known
        frame, place, num = self.frame[known], self.place[known], len(self.clip.motion.small)
        count = np.bincount(frame, minlength=num)
        summed = np.stack([np.bincount(frame, axis, num) for axis in place.T], 1)
        middle = np.full((num, 2), np.nan)
        middle[count > 0] = summed[count > 0] / count[count > 0, None]
        return (middle @ self.clip.to_model[:2, :2].T + self.clip.to_model[:2, 2])[:, None]

    def estimate_steps(self, which: Bool[np.ndarray, " num"]) -> Float[np.ndarray, "frames 3 3"]:
        """The map from the frame before to each frame that most of these tracks agree on; NaN if unknown."""
        row, step = np.nonzero(which[:, None] & self.known[:, :-1] & self.known[:, 1:])
        order = np.argsort(self.frame[row, step], kind="stable")
        row, step = row[order], step[order]
        ends = np.searchsorted(self.frame[row, step], np.arange(len(self.clip.motion.small) + 1))
        steps = np.full((len(self.clip.motion.small), 3, 3), np.nan)

        def estimate(k: int) -> None:
            on, at = (index[ends[k] : ends[k + 1]] for index in (row, step))
            if len(on) >= FEWEST:
                found = fit_affine(self.place[on, at], self.place[on, at + 1], self.clip.inlier, AGREEING)
                if found is not None:
                    steps[k + 1] = self.clip.in_model(found[0])

        run_tasks(estimate, self.clip.pairs)
        return steps
