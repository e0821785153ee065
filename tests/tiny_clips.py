"""Small clips: of a disc that moves, and of a small model, one frame of which is shown twice; and masks."""

import numpy as np
from PIL import Image
from soft_models import soft_model

from foldgauss.io import save_video_model, write_frames
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
    write_frames(folder / "clip", clip_of(model, **options))


MASK_SIZE = (40, 60)
#: DAVIS' own first colors: an OpenCV reader sees 128s where the labels are 1 and 2.
PALETTE = [0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0]


def labels(k):
    """A mask: object 1 walks to the right, object 2 stands, a corner is void."""
    mask = np.zeros(MASK_SIZE, np.uint8)
    mask[10:20, 10 + k : 20 + k] = 1
    mask[25:35, 40:50] = 2
    mask[:2, :2] = 255
    return mask


def write_mask(path, mask, palette=PALETTE):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(mask)
    if palette is not None:
        image = image.convert("L")
        image.putpalette(palette + [0, 0, 0] * (256 - len(palette) // 3))
    image.save(path)
