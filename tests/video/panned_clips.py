"""Clips of an object before a background, both in motion, of which everything is known."""

import cv2
import numpy as np

SIZE, NUM_FRAMES, RADIUS = (90, 160), 6, 17.0


def texture(seed: int, size: tuple[int, int] = (140, 320), fine: float = 1.5) -> np.ndarray:
    """Colored noise, smoothed, float32 (*size, 3) about [0, 255]."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(*size, 3)).astype(np.float32), (0, 0), fine)
    return 128 + 45 * noise / noise.std()


def panned(ground: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    """What a camera sees of the ground."""
    matrix = np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    return cv2.warpAffine(ground, matrix, SIZE[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def disc_clip(pan: float = 3.0, speed: float = 2.0, seed: int = 0, disc: bool = True, num_frames: int = NUM_FRAMES):
    """A textured disc over a textured ground, both in motion: frames, masks, and frames without the disc."""
    ground, skin = texture(seed), texture(seed + 1, fine=2.0) * [0.5, 0.7, 1.5]
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    frames, masks, empty = [], [], []
    for k in range(num_frames):
        behind = panned(ground, (20 + pan * k, 15 + 0.3 * pan * k))
        center = 60 + speed * k, 42 + 0.5 * k
        alpha = np.clip(RADIUS - np.hypot(x - center[0], y - center[1]) + 0.5, 0, 1)[..., None] * disc
        front = panned(skin, (80 - center[0], 60 - center[1]))
        frames.append(alpha * front + (1 - alpha) * behind)
        masks.append(alpha[..., 0] > 0.5)
        empty.append(behind)
    return *(np.clip(np.stack(one), 0, 255).round().astype(np.uint8) for one in (frames, empty)), np.stack(masks)
