"""A small model and a clip of it, one frame of which is shown twice: for what is said of frame times."""

import numpy as np
from soft_models import soft_model

from foldgauss.io import save_video_model, write_image
from foldgauss.video import FrameTimes, VideoModel

NUM_FRAMES, TWICE = 12, 6


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
