"""Coordinates in which what follows a shared path stands still, such as the background, for the starts of a fit."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from foldgauss.video.models.shared_paths import SharedPaths, invert_maps
from foldgauss.video.motion.optical_flow import LONGEST, Tracks

#: A start follows a path if a fold follows its track for longer in these coordinates, by this factor, than in others.
LONGER = 1.1
#: Where both are alike, it follows the first path if it moves less in its coordinates, and another if it moves less by
#: this factor. (Else the background would be divided among paths that are nearly the same.)
SMALLER = 0.5


@dataclasses.dataclass(frozen=True)
class PathCoordinates:
    """Pixels of frames, (x, y) with centers at +0.5, in coordinates that follow a shared path, also in pixels.

    `inverse` (frames, 2, 3) are the maps from each frame's pixels.
    """

    inverse: Float32[np.ndarray, "frames 2 3"]

    @classmethod
    def of_each(
        cls, paths: SharedPaths | None, times: Float[np.ndarray, " frames"], size: tuple[int, int]
    ) -> list["PathCoordinates"]:
        """Those of each of `paths`, for frames at `times` of `size` (height, width)."""
        unit, found = max(size), []
        to_pixels = np.array([[unit, 0, size[1] / 2], [0, unit, size[0] / 2], [0, 0, 1]])
        for path in range(0 if paths is None else paths.num_paths):
            maps = np.tile(np.eye(3), (len(times), 1, 1))
            maps[:, :2] = paths.by_path(np.asarray(times, np.float32), np.full(len(times), path))
            found.append(cls(invert_maps((to_pixels @ maps @ np.linalg.inv(to_pixels))[:, :2])))
        return found

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


def prefers_path(
    folds: Float[np.ndarray, "num degree 2"],
    spread: Float[np.ndarray, " num"],
    by_path: Float[np.ndarray, "num degree 2"],
    path_spread: Float[np.ndarray, " num"],
    *,
    is_first: bool,
) -> Bool[np.ndarray, " num"]:
    """Which starts follow a path: folds and sigma_t of the same tracks in either coordinates, see `LONGER`."""

    def size(folds: np.ndarray, spread: np.ndarray) -> np.ndarray:
        powers = spread[:, None] ** np.arange(1, folds.shape[1] + 1)
        return (np.hypot(folds[..., 0], folds[..., 1]) * powers).sum(1)

    factor = 1.0 if is_first else SMALLER
    longer, alike = path_spread > LONGER * spread, path_spread * LONGER > spread
    return longer | (alike & (size(by_path, path_spread) < factor * size(folds, spread)))
