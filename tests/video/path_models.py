"""Models whose Gaussians follow shared paths, and what they are made of."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from soft_models import NUM, soft_model

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video import FoldedSplats, FrameTimes, VideoModel
from foldgauss.video.models.shared_paths import SharedPaths

SCENE_SIZE, SCENE_FRAMES, SCENE_FPS = (96, 160), 12, 12.0
#: A third of the Gaussians, of the object and of the background, on each of two paths, and a third on none.
INDEX = (np.arange(NUM) % 3).astype(np.uint8)


def random_splats(num=300, degree=3, power=2.0, floor=0.0, seed=0) -> FoldedSplats:
    rng = np.random.default_rng(seed)

    def normal(*shape, scale=1.0):
        return jnp.asarray(rng.normal(size=(num, *shape)) * scale, jnp.float32)

    return FoldedSplats(
        loc=normal(2, scale=0.3),
        log_scale=normal(2, scale=0.5) - 3,
        angle_logit=normal(),
        time_loc_logit=normal(),
        log_time_scale=normal(scale=0.7) - 1.5,
        coefficients=normal(degree, 2),
        opacity_logit=normal(),
        color_dc=normal(3),
        envelope=TimeLikelihood(power, floor),
    )


def random_paths(num_paths=2, num_knots=5, seed=3) -> SharedPaths:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.random((num_paths, num_knots)), 1).astype(np.float32)
    matrices = np.eye(2, 3) + 0.2 * rng.normal(size=(num_paths, num_knots, 2, 3))
    return SharedPaths(times, matrices.astype(np.float32))


def moving_splats(num=300, seed=0, **settings) -> FoldedSplats:
    index = np.random.default_rng(seed).integers(0, 3, num).astype(np.uint8)
    return dataclasses.replace(random_splats(num, seed=seed, **settings), path_index=index, paths=random_paths())


def moving_model(splats=None) -> VideoModel:
    splats = moving_splats() if splats is None else splats
    return VideoModel(splats, FrameTimes.uniform(4), (48, 80), 25.0, RenderOptions())


def scene(frame_times=None, num=1500, wide=2.0, scales=(0.01, 0.05), compositing="over"):
    """Static Gaussians of random colors on a plane `wide` times the frame."""
    rng = np.random.default_rng(3)
    logit = lambda p: np.log(p / (1 - p))  # noqa: E731
    leaves = {
        "loc": rng.uniform(-wide / 2, wide / 2, (num, 2)) * [1, SCENE_SIZE[0] / SCENE_SIZE[1]],
        "log_scale": np.log(rng.uniform(*scales, (num, 2))),
        "angle_logit": rng.normal(size=num),
        "time_loc_logit": np.zeros(num),
        "log_time_scale": np.full(num, np.log(1024)),
        "coefficients": np.zeros((num, 1, 2)),
        "opacity_logit": np.full(num, logit(0.98)),
        "color_dc": rng.normal(size=(num, 3)),
    }
    splats = FoldedSplats(
        **{key: jnp.asarray(leaf, jnp.float32) for key, leaf in leaves.items()}, envelope=TimeLikelihood()
    )
    times = FrameTimes.uniform(SCENE_FRAMES) if frame_times is None else frame_times
    return VideoModel(splats, times, SCENE_SIZE, SCENE_FPS, RenderOptions(), compositing)


def affine(turn=0.0, zoom=1.0, shift=(0.0, 0.0)):
    cos, sin = zoom * np.cos(turn), zoom * np.sin(turn)
    return np.array([[cos, -sin, shift[0]], [sin, cos, shift[1]], [0, 0, 1]])


def path_model(num_paths=2, num_knots=6, seed=5, **settings) -> VideoModel:
    rng, model = np.random.default_rng(seed), soft_model(**settings)
    times = np.sort(rng.random((num_paths, num_knots)), 1).astype(np.float32)
    matrices = np.eye(2, 3) + 0.08 * rng.normal(size=(num_paths, num_knots, 2, 3))
    splats = dataclasses.replace(model.splats, path_index=INDEX, paths=SharedPaths(times, matrices.astype(np.float32)))
    return dataclasses.replace(model, splats=splats)
