"""Small models made by hand: some tens of smooth Gaussians, an object among them."""

import dataclasses

import equinox as eqx
import jax
import numpy as np

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video import FoldedSplats, FrameTimes, SegmentedVideo, VideoModel
from foldgauss.video.models.shared_paths import SharedPaths

SIZE, NUM, NUM_FRAMES = (40, 64), 40, 7
#: The object: the first dozen, which stand about (-0.15, 0); all others are background.
OBJECT = np.arange(NUM) < 12


def soft_model(
    *, power=2.0, floor=0.0, options=None, size=SIZE, degree=3, seed=0, compositing="over", num_frames=NUM_FRAMES
) -> VideoModel:
    rng = np.random.default_rng(seed)

    def normal(*shape, scale=1.0):
        return (rng.normal(size=(NUM, *shape)) * scale).astype(np.float32)

    loc = np.where(OBJECT[:, None], np.array([-0.15, 0.0]) + normal(2, scale=0.04), normal(2, scale=0.25))
    splats = FoldedSplats(
        loc=loc.astype(np.float32),
        log_scale=np.where(OBJECT[:, None], -3.2, -2.2).astype(np.float32) + normal(2, scale=0.3),
        angle_logit=normal(),
        time_loc_logit=normal(scale=0.5),
        log_time_scale=normal(scale=0.2) - np.float32(0.5),
        coefficients=normal(degree, 2, scale=0.05),
        opacity_logit=normal(),
        color_dc=normal(3),
        envelope=TimeLikelihood(power, floor),
    )
    options = RenderOptions.exact() if options is None else options
    return VideoModel(splats, FrameTimes.uniform(num_frames), size, 25.0, options, compositing)


def learned(model, seed=0) -> VideoModel:
    """The model with frame times of its own."""
    logits = 0.3 * np.random.default_rng(seed).standard_normal(model.num_frames - 1).astype(np.float32)
    return dataclasses.replace(model, frame_times=FrameTimes(logits))


def soft_segments(firsts=(0, 4, 10), lengths=(7, 9, 6), *, evenly=False, seed=0) -> SegmentedVideo:
    """Segments that are independent of each other, with frame times of their own or even ones."""
    models = [soft_model(seed=seed + k, num_frames=length) for k, length in enumerate(lengths)]
    models = models if evenly else [learned(model, seed + k) for k, model in enumerate(models)]
    return SegmentedVideo.from_models(list(zip(firsts, models, strict=True)))


def on_paths(model, *, at_frames=True, reach=1.0, seed=7) -> VideoModel:
    """The model with half of its Gaussians on a path, a quarter on another: they pan, turn and enlarge, unevenly."""
    rng, splats = np.random.default_rng(seed), model.splats
    times = np.asarray(model.frame_times.times())
    if not at_frames:
        times = np.sort(np.linspace(-0.1, 1.2, 5) + 0.05 * rng.normal(size=5)).astype(np.float32)
    num = len(times)
    steps = rng.normal(size=(2, num, 2, 3)) * np.array([0.02, 0.02, 0.05]) * reach
    matrices = np.eye(2, 3) + np.cumsum(steps, 1)
    index = np.array([1, 0, 1, 2])[np.arange(splats.num_gaussians) % 4]
    paths = SharedPaths(np.tile(times, (2, 1)).astype(np.float32), matrices.astype(np.float32))
    splats = dataclasses.replace(splats, path_index=index.astype(np.uint8), paths=paths)
    return dataclasses.replace(model, splats=splats)


def of_degrees(model, seed=0) -> VideoModel:
    """The model with folds of several degrees."""
    degrees = np.random.default_rng(seed).integers(0, model.degree + 1, model.num_gaussians)
    kept = (np.arange(model.degree) < degrees[:, None])[..., None]
    leaf = np.where(kept, np.asarray(model.splats.coefficients), np.float32(0))
    return eqx.tree_at(lambda m: m.splats.coefficients, model, leaf)


def crowd(model, copies=10, seed=1) -> VideoModel:
    """The model with more Gaussians, like its own."""
    rng = np.random.default_rng(seed)

    def more(leaf):
        leaf = np.asarray(leaf)
        if not leaf.ndim:
            return leaf
        return (np.repeat(leaf, copies, 0) + 0.1 * rng.normal(size=(copies * len(leaf), *leaf.shape[1:]))).astype("f4")

    return eqx.tree_at(lambda m: m.splats, model, jax.tree.map(more, model.splats))


def only(model, keep) -> VideoModel:
    """The model with these Gaussians, in this order."""

    def cut(leaf):
        return leaf[keep] if np.ndim(leaf) else leaf

    return eqx.tree_at(lambda m: m.splats, model, jax.tree.map(cut, model.splats))


def assert_same(one, other) -> None:
    """Trees of the same structure, whose leaves have the same bits."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert (np.asarray(a).dtype, np.shape(a)) == (np.asarray(b).dtype, np.shape(b))
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
