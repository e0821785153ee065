"""Stabilization: a video as a steadier camera would show it."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Literal

import jax
import numpy as np
from jaxtyping import Bool, Float

from foldgauss._runtime.checks import is_within, require, short_repr
from foldgauss.render import Splats2D, pixels_per_unit
from foldgauss.video.models.renderer import FollowingVideo, PreparedVideo, RenderedVideo
from foldgauss.video.motion.camera_path import CameraPath, estimate_camera_path

Affine = Float[np.ndarray, "3 3"]
Border = Literal["crop", "fill", "keep"]
BORDERS = ("crop", "fill", "keep")
#: Standard deviation of the smoothed path, in seconds.
SMOOTHING = 1.0
#: Largest standard deviation, in frames: the memory of the filter grows with it.
MAX_SMOOTHING = 100_000
#: Largest zoom of a cropped video.
MAX_ZOOM = 2.0
#: Beyond the border frames at these distances are shown, the nearest in front.
FILL_DISTANCES = (1, 2, 4, 8, 16, 32, 64)
#: They begin inside the border by this fraction of the longer side.
OVERLAP = 0.004
#: Gaussians farther outside a frame than so many standard deviations are not seen in it, and were never compared with
#: the clip.
UNSEEN = 3.0


def stabilize(
    video: RenderedVideo,
    *,
    smoothing: float = SMOOTHING,
    fixed: bool = False,
    border: Border = "crop",
    path: CameraPath | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> "StabilizedVideo":
    """A video as a steadier camera would show it: its Gaussians move against the motion of the camera.

    `smoothing` is the standard deviation, in seconds, of the Gaussian that smooths the path of the camera; a `fixed`
    camera shows each shot as its middle frame does. Where frames end inside the image, `border` says what is shown:

    - `"crop"`: the image is enlarged until no border is visible, by at most `MAX_ZOOM`.
    - `"fill"`: what other frames of the shot show there, the nearest in time in front.
    - `"keep"`: the background.

    `path` is that of `estimate_camera_path(video)`, which takes a rendering of every frame (default: estimated here,
    with a call of `on_frame()` after each).

    Raises ValueError for anything but a video, smoothing that is not above 0, an unknown border, a path of another
    number of frames, a path that a crop by `MAX_ZOOM` does not suffice for, and a filled border with compositing "sum".
    Example: `stabilize(model, border="fill").render(frame=10)`.
    """
    require(
        hasattr(video, "prepare"),
        "video",
        expected="a model or another video of it",
        got=type(video).__name__,
        cure="Load one by foldgauss.io.load_video_model(path).",
    )
    require(is_within(smoothing, "(0, inf)"), "smoothing", expected="seconds > 0", got=short_repr(smoothing))
    require(
        fixed or smoothing * video.fps <= MAX_SMOOTHING,
        "smoothing",
        expected=f"at most {MAX_SMOOTHING / video.fps:g} seconds ({MAX_SMOOTHING:,} frames)",
        got=short_repr(smoothing),
        cure="For a still camera: fixed.",
    )
    require(border in BORDERS, "border", expected=f"one of {BORDERS}", got=short_repr(border))
    require(
        border != "fill" or video.compositing != "sum",
        "border",
        expected='"crop" or "keep" with compositing "sum"',
        got=border,
        cure="Choose crop or keep: sums of several frames have no order in depth.",
    )
    path = estimate_camera_path(video, on_frame=on_frame) if path is None else path
    require(
        path.num_frames == video.num_frames, "path", expected=f"that of {video.num_frames} frames", got=path.num_frames
    )
    maps = path.held() if fixed else path.smoothed(smoothing * video.fps)
    zoom = 1.0
    if border == "crop":
        zoom = _find_zoom(maps, video.size)
        require(
            zoom <= MAX_ZOOM,
            "border",
            expected=f"a path that a zoom of {MAX_ZOOM:g} suffices for",
            got="crop",
            cure="Fill or keep the borders" + ("." if fixed else ", or smooth less."),
        )
    return StabilizedVideo(video, np.diag([zoom, zoom, 1.0]) @ maps, path, border)


@dataclasses.dataclass(frozen=True)
class StabilizedVideo(FollowingVideo):
    """A video whose images are moved by one affine map for each frame, `maps` (num_frames, 3, 3) in model space.

    Between frames maps are interpolated linearly. It is rendered as any other video. Made by `stabilize`, which
    documents `border`.
    """

    video: RenderedVideo
    maps: Float[np.ndarray, "frames 3 3"]
    path: CameraPath
    border: Border = "keep"

    @property
    def _lead(self) -> RenderedVideo:
        return self.video

    @property
    def zoom(self) -> float:
        """By how much images are enlarged, on average over the frames."""
        return float(np.sqrt(np.linalg.det(self.maps[:, :2, :2])).mean())

    def _repr_html_(self) -> None:
        """None: the player's page has no moving camera."""

    def prepare(self, size: tuple[int, int]) -> "PreparedStabilizedVideo":
        """The video prepared for conditioning on many times, for images of `size`."""
        return PreparedStabilizedVideo(self, size)

    def map_at(self, t: float) -> Affine:
        """The map of the image at time t, in model space."""
        return self._interpolate(self.maps, t)

    def _interpolate(self, maps: Float[np.ndarray, "frames 3 3"], t: float) -> Affine:
        k, fraction = self._position(t)
        return maps[k] if fraction == 0 else (1 - fraction) * maps[k] + fraction * maps[k + 1]

    def nearby_frames(self, t: float) -> list[int]:
        """Frames of the shot that show what is beyond the borders at time t, the nearest first."""
        k, fraction = self._position(t)
        nearest = k + round(fraction)
        first, stop = next((first, stop) for first, stop in self.path.shots if first <= nearest < stop)
        found = itertools.chain.from_iterable((nearest + distance, nearest - distance) for distance in FILL_DISTANCES)
        return [j for j in found if first <= j < stop]

    def _position(self, t: float) -> tuple[int, float]:
        """The frame before t, and the fraction of the way to the next; between two shots, the nearer frame and 0."""
        position = float(np.interp(t, self.path.times, np.arange(self.path.num_frames)))
        k, fraction = int(position), position % 1
        if k + 1 in self.path.starts:
            return k + (fraction >= 0.5), 0.0  # half way the later one, as `snap_to_shots`
        return k, fraction


class PreparedStabilizedVideo(PreparedVideo):
    """A stabilized video prepared for images of `size`, see `PreparedVideo`."""

    def __init__(self, video: StabilizedVideo, size: tuple[int, int]):
        self._video, self._prepared = video, video.video.prepare(size)
        (own_height, own_width), (height, width) = video.size, size
        scale = pixels_per_unit(size, aspect=own_height / own_width)
        self._to_pixels = np.array([[scale, 0, width / 2], [0, scale, height / 2], [0, 0, 1]])
        self._to_model = np.linalg.inv(self._to_pixels)
        self._half = np.array([own_width, own_height]) / max(video.size) / 2

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """See `PreparedVideo`."""
        return [(weight, self._moved(splats, t)) for weight, splats in self._prepared.weighted_splats(t)]

    def _moved(self, splats: Splats2D, t: float) -> Splats2D:
        to_output = self._to_pixels @ self._video.map_at(t)
        if self._video.border == "crop":
            return _apply(to_output @ self._to_model, splats)
        seen = self._seen(splats)
        wide = _are_wide(seen)
        parts = [_apply(to_output, _choose(seen, ~wide))]
        if self._video.border == "fill":
            parts += self._beyond_borders(t, to_output)
        parts.append(_apply(to_output, _choose(seen, wide)))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    def _beyond_borders(self, t: float, to_output: Affine) -> list[Splats2D]:
        """What other frames show where the image at time t, and those in front of them, have ended."""
        video, parts, in_front = self._video, [], [np.eye(3)]
        here = np.linalg.inv(video._interpolate(video.path.matrices, t))
        for j in video.nearby_frames(t):
            to_frame = video.path.matrices[j] @ here  # from the image at t
            splats = _apply(np.linalg.inv(to_frame), self._seen(self._prepared.splats(float(video.path.times[j]))))
            inside = [(np.abs(_move_points(other, splats.mean)) < self._half - OVERLAP).all(1) for other in in_front]
            parts.append(_apply(to_output, _choose(splats, ~np.any(inside, axis=0) & ~_are_wide(splats))))
            in_front.append(to_frame)
        return parts

    def _seen(self, splats: Splats2D) -> Splats2D:
        """The splats of a frame that are seen in it, in model space."""
        splats = _apply(self._to_model, splats)
        reach = UNSEEN * np.linalg.norm(splats.factor, axis=(1, 2))
        return _choose(splats, (np.abs(splats.mean) < self._half + reach[:, None]).all(1))


def _are_wide(splats: Splats2D) -> Bool[np.ndarray, " num"]:
    """Which splats in model space are wider than a frame, as a backdrop: they would hide what other frames show."""
    return np.linalg.norm(splats.factor, axis=(1, 2)) > 1


def _choose(splats: Splats2D, which: Bool[np.ndarray, " num"]) -> Splats2D:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[which], splats)


def _apply(affine: Affine, splats: Splats2D) -> Splats2D:
    linear = np.float32(affine[:2, :2])
    return Splats2D(np.float32(_move_points(affine, splats.mean)), linear @ splats.factor, splats.opacity, splats.color)


def _move_points(affine: Affine, points: Float[np.ndarray, "num 2"]) -> Float[np.ndarray, "num 2"]:
    return points @ affine[:2, :2].T + affine[:2, 2]


def _find_zoom(maps: Float[np.ndarray, "frames 3 3"], size: tuple[int, int]) -> float:
    """The least zoom, to 0.1%, with which every moved image covers the output; above `MAX_ZOOM` if none does."""
    half, inverse = np.array([size[1], size[0]]) / max(size) / 2, np.linalg.inv(maps)
    corners = np.array([[1, 1], [1, -1]]) * half  # and their opposites
    reach = np.abs(np.einsum("nij,cj->nci", inverse[:, :2, :2], corners)).max(1)
    room = half - np.abs(inverse[:, :2, 2])
    zoom = max(1.0, (reach / np.maximum(room, 1e-9)).max())
    return float(1.001 ** np.ceil(np.log(zoom) / np.log(1.001) - 1e-6))
