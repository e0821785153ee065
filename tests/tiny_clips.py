"""Small clips: of a disc that moves, and of a small model, with one frame that is shown twice."""

import numpy as np
from soft_models import soft_model

from foldgauss.io import save_video_model, write_image
from foldgauss.video import FrameTimes, VideoModel

NUM_FRAMES, TWICE = 12, 6


def moving_disc(num_frames=6, size=(48, 64)):
    """uint8 (num_frames, *size, 3): a disc over a slope."""
    y, x = np.mgrid[: size[0], : size[1]]
    centers = np.linspace(0.2, 0.8, num_frames) * size[1]
    light = np.stack([np.exp(-((x - at) ** 2 + (y - size[0] / 2) ** 2) / 40) for at in centers])[..., None]
    slope = np.stack([x / size[1], y / size[0], 0 * x + 0.3], -1) * 0.6
    return np.rint(255 * (slope * (1 - light) + light * np.array([1, 0.2, 0.1]))).astype(np.uint8)


def model_of_12() -> VideoModel:
    soft = soft_model()
    return VideoModel(soft.splats, FrameTimes.uniform(NUM_FRAMES), soft.size, soft.fps, soft.options, soft.compositing)


def clip_of(model: VideoModel, times=None, noise=4.0, seed=0) -> np.ndarray:
    """What the model shows at `times`, with noise (gray levels); by default frame TWICE + 1 is TWICE again."""
    if times is None:
        times = np.linspace(0, 1, NUM_FRAMES)
        times[TWICE + 1] = times[TWICE]
    pictures = np.stack(list(model.frames(np.asarray(times, np.float32))))
    noisy = pictures + noise * np.random.default_rng(seed).standard_normal(pictures.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def write_both(folder, **options) -> None:
    """`model.safetensors` and the images `clip/` in `folder`."""
    model = model_of_12()
    save_video_model(folder / "model.safetensors", model)
    (folder / "clip").mkdir()
    for k, frame in enumerate(clip_of(model, **options)):
        write_image(folder / "clip" / f"{k:02}.png", frame)
