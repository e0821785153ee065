"""Coordinates in which the background stands still while the camera moves, for the starts of a fit."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from foldgauss.video.models.shared_paths import SharedPaths, invert_maps
from foldgauss.video.motion.optical_flow import LONGEST, Tracks

#: A start follows the camera if a fold follows its track for longer in these coordinates, by this factor, than in those
#: of the frame; where both are alike, if it moves less.
LONGER = 1.1


@dataclasses.dataclass(frozen=True)
class CameraCoordinates:
    """Pixels of frames, (x, y) with centers at +0.5, in coordinates that follow the camera, also in pixels.

    `inverse` (frames, 2, 3) are the maps from each frame's pixels.
    """

    inverse: Float32[np.ndarray, "frames 2 3"]

    @classmethod
    def from_paths(cls, paths: SharedPaths, times: Float[np.ndarray, " frames"], size: tuple[int, int]):
        """Those of the first of `paths`, for frames at `times` of `size` (height, width)."""
        maps = np.tile(np.eye(3), (len(times), 1, 1))
        maps[:, :2] = paths.by_path(np.asarray(times, np.float32), np.zeros(len(times), int))
        unit = max(size)
        to_pixels = np.array([[unit, 0, size[1] / 2], [0, unit, size[0] / 2], [0, 0, 1]])
        pixels = to_pixels @ maps @ np.linalg.inv(to_pixels)
        return cls(invert_maps(pixels[:, :2]))

    def place(self, frame: Int[np.ndarray, " num"], position: Float[np.ndarray, "num 2"]) -> Float[np.ndarray, "num 2"]:
        """Positions in frames."""
        maps = self.inverse[frame]
        return np.einsum("nij,nj->ni", maps[:, :, :2], position) + maps[:, :, 2]

    def log_scales(self, frame: Int[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
        """Logarithms of the factor by which lengths change."""
        return 0.5 * np.log(np.linalg.det(self.inverse[:, :, :2].astype(float)))[frame]

    def turns(self, frame: Int[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
        """Angles by which directions turn."""
        return np.arctan2(self.inverse[:, 1, 0], self.inverse[:, 0, 0])[frame]

    def place_tracks(
        self, tracks: Tracks, home: Int[np.ndarray, " num"], position: Float[np.ndarray, "num 2"]
    ) -> Tracks:
        """Tracks that start at `position` in frames `home`."""
        frame = np.clip(home[:, None] + np.arange(-LONGEST, LONGEST + 1), 0, len(self.inverse) - 1)
        maps, own = self.inverse[frame], position.astype(np.float32)[:, None] + tracks.shift
        moved = np.einsum("nkij,nkj->nki", maps[..., :2], own) + maps[..., 2] - self.place(home, position)[:, None]
        return Tracks(np.where(tracks.known[..., None], moved, 0).astype(np.float32), tracks.known)


def prefers_camera(
    folds: Float[np.ndarray, "num degree 2"],
    spread: Float[np.ndarray, " num"],
    by_camera: Float[np.ndarray, "num degree 2"],
    camera_spread: Float[np.ndarray, " num"],
) -> Bool[np.ndarray, " num"]:
    """Which starts follow the camera: folds and sigma_t of the same tracks in either coordinates, see `LONGER`."""

    def size(folds: np.ndarray, spread: np.ndarray) -> np.ndarray:
        powers = spread[:, None] ** np.arange(1, folds.shape[1] + 1)
        return (np.hypot(folds[..., 0], folds[..., 1]) * powers).sum(1)

    longer, alike = camera_spread > LONGER * spread, camera_spread * LONGER > spread
    return longer | (alike & (size(by_camera, camera_spread) < size(folds, spread)))
