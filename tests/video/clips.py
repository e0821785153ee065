"""Small synthetic clips: soft colored blobs that move over a gradient."""

import numpy as np


def moving_blobs(num_frames: int = 6, height: int = 48, width: int = 64) -> np.ndarray:
    """uint8 (num_frames, height, width, 3)."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    t = np.linspace(0, 1, num_frames)[:, None, None]
    frames = np.stack([x / width + 0 * t, y / height + 0 * t, 0.3 + 0 * (x + t)], axis=-1) * 0.6
    for center_x, center_y, color in (
        (0.2 + 0.5 * t, 0.5, (1, 0.2, 0.1)),
        (0.7, 0.2 + 0.5 * t**2, (0.1, 0.4, 1)),
    ):
        blob = np.exp(-((x - center_x * width) ** 2 + (y - center_y * height) ** 2) / 40)[..., None]
        frames = frames * (1 - blob) + blob * np.array(color)
    return (frames * 255).round().astype(np.uint8)
