"""Scenes in which it is known what belongs to what: a clip with masks, and a model whose Gaussians have names."""

import numpy as np
from scipy.special import logit

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video import FoldedSplats, FrameTimes, VideoModel
from foldgauss.video.models.splats import SH_C0

SIZE, NUM_FRAMES = (64, 96), 16
BACKGROUND, DISC, BOX = 0, 1, 2


def textured_clip(num_frames: int = NUM_FRAMES, size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """A striped disc and a chequered box that cross a textured ground, the disc in front.

    Returns frames, uint8 (num_frames, height, width, 3), and labels, uint8 (num_frames, height, width).
    """
    height, width = size
    y, x = np.mgrid[0:height, 0:width] + 0.5
    ground = 0.45 + 0.12 * np.sin(x / 5) * np.cos(y / 7) + 0.08 * np.sin((x + 2 * y) / 4)
    ground = np.stack([0.5 * ground, ground, 0.6 * ground], -1)
    frames, labels = np.empty((num_frames, height, width, 3)), np.zeros((num_frames, height, width), np.uint8)
    for k, t in enumerate(np.linspace(0, 1, num_frames)):
        frames[k] = ground
        for label, inside, texture in (_box(x, y, t, size), _disc(x, y, t, size)):
            frames[k][inside] = texture[inside]
            labels[k][inside] = label
    return (255 * frames).round().clip(0, 255).astype(np.uint8), labels


def _disc(x, y, t, size):
    u, v = x - (0.22 + 0.5 * t) * size[1], y - (0.36 + 0.25 * t**2) * size[0]
    stripe = 0.75 + 0.2 * np.sin((u + v) / 2)
    return DISC, u**2 + v**2 < (0.21 * size[0]) ** 2, np.stack([stripe, 0.35 * stripe, 0.15 * stripe], -1)


def _box(x, y, t, size):
    u, v = x - (0.78 - 0.12 * t) * size[1], y - (0.62 - 0.2 * t) * size[0]
    chequer = 0.75 + 0.2 * np.sin(u / 2) * np.sin(v / 2)
    inside = np.maximum(np.abs(u), np.abs(v)) < 0.17 * size[0]
    return BOX, inside, np.stack([0.25 * chequer, 0.35 * chequer, chequer], -1)


#: Half of the side of a named model's objects, in model units; and where they are, as (x, y) at time 0 and per time.
HALF_SIDE = 0.1
START = {DISC: np.array([-0.25, -0.05]), BOX: np.array([0.2, 0.12])}
SPEED = {BACKGROUND: np.array([0.0, 0.0]), DISC: np.array([0.4, 0.1]), BOX: np.array([0.1, -0.25])}
COLOR = {BACKGROUND: (0.2, 0.5, 0.3), DISC: (0.9, 0.3, 0.1), BOX: (0.2, 0.3, 0.9)}


def named_model(
    num_frames: int = 12, size: tuple[int, int] = (48, 72), *, compositing: str = "over", each: int = 300, seed: int = 0
) -> tuple[VideoModel, np.ndarray]:
    """A model made by hand: two square clouds of small Gaussians that move across a wall of others.

    The wall is there all the time, most of the clouds' Gaussians come or go on the way. Those of the "disc" are in
    front, then the box, then the wall. Returns the model and labels (num_gaussians,): what each Gaussian was made for.
    """
    rng = np.random.default_rng(seed)
    bricks = _bricks(0.035, 0.5 * size[0] / size[1])
    label = np.repeat([DISC, BOX, BACKGROUND], [each, each, len(bricks)])
    time = rng.uniform(0.01, 0.99, len(label))
    loc = np.concatenate([np.empty((2 * each, 2)), bricks])
    for name in (DISC, BOX):
        own = label == name
        loc[own] = START[name] + time[own, None] * SPEED[name] + rng.uniform(-HALF_SIDE, HALF_SIDE, (own.sum(), 2))
    wall = label == BACKGROUND
    scale = np.where(wall, 0.021, 0.012)
    color = np.array([COLOR[name] for name in label]) + rng.uniform(-0.04, 0.04, (len(label), 3))
    leaves = {
        "loc": loc,
        "log_scale": np.log(np.stack([scale, scale], -1)),
        "angle_logit": np.zeros(len(label)),
        "time_loc_logit": logit(time),
        "log_time_scale": np.log(np.where(wall, 10, 0.25)),
        "coefficients": -np.array([SPEED[name] for name in label])[:, None],
        "opacity_logit": logit(np.full(len(label), 0.8 if compositing == "over" else 0.1)),
        "color_dc": (color - 0.5) / SH_C0,
    }
    splats = FoldedSplats(
        **{name: np.float32(leaf) for name, leaf in leaves.items()}, envelope=TimeLikelihood(2.0, 0.3)
    )
    return VideoModel(splats, FrameTimes.uniform(num_frames), size, 25.0, RenderOptions(), compositing), label


def _bricks(apart: float, half_height: float) -> np.ndarray:
    """Places on a grid that covers the frame, (num, 2)."""
    x, y = np.arange(-0.5, 0.5 + apart, apart), np.arange(-half_height, half_height + apart, apart)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def square(model: VideoModel, name: int, k: int) -> np.ndarray:
    """Where an object of `named_model` is in frame k: bool (height, width), its Gaussians' centers' square."""
    height, width = model.size
    t = k / (model.num_frames - 1)
    x, y = np.arange(width) + 0.5 - width / 2, np.arange(height)[:, None] + 0.5 - height / 2
    center = max(model.size) * (START[name] + t * SPEED[name])
    half = max(model.size) * (HALF_SIDE + 0.02)  # and what they reach beyond
    return (np.abs(x - center[0]) < half) & (np.abs(y - center[1]) < half)
