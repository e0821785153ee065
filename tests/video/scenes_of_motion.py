"""Small clips of which it is known what they require: a still, a disc on a path, a cut, noise."""

from collections.abc import Callable

import numpy as np

SIZE = (48, 80)


def picture(size: tuple[int, int] = SIZE) -> np.ndarray:
    """uint8 (*size, 3): smooth waves in three colors."""
    y, x = np.mgrid[: size[0], : size[1]]
    red, green = np.sin(0.3 * x) * np.cos(0.2 * y), np.cos(0.1 * x + 0.25 * y)
    return np.stack([128 + 60 * red, 128 + 60 * green, 128 + 50 * np.sin(0.4 * y)], -1).round().astype(np.uint8)


def still(num_frames: int) -> np.ndarray:
    return np.repeat(picture()[None], num_frames, 0)


def disc(path: Callable[[float], tuple[float, float]], num_frames: int = 24, radius: float = 9) -> np.ndarray:
    """uint8 frames of a disc whose center (x, y) is `path(s)`, s from 0 to 1, over one color."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    frames = []
    for s in np.linspace(0, 1, num_frames):
        center_x, center_y = path(s)
        alpha = np.clip(radius - np.hypot(x - center_x, y - center_y) + 0.5, 0, 1)[..., None]
        frames.append(alpha * np.array([230, 80, 40]) + (1 - alpha) * np.array([60, 90, 120]))
    return np.stack(frames).round().astype(np.uint8)


def cut(num_frames: int = 12) -> np.ndarray:
    """Two stills, one after the other."""
    one = picture()
    return np.repeat(np.stack([one, one[::-1, ::-1]]), num_frames, 0)


def noise(num_frames: int = 16) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (num_frames, *SIZE, 3), np.uint8)
