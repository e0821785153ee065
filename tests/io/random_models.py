"""Random video models for the formats of other programs."""

import equinox as eqx
import numpy as np

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video import FrameTimes, VideoModel
from foldgauss.video.models.row_layout import unpack


def random_model(num=60, *, seed=0, size=(48, 80), degree=3, power=2.0, floor=0.0, compositing="over") -> VideoModel:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(num, 11 + 2 * degree)).astype(np.float32)
    splats = unpack(rows, degree, TimeLikelihood(np.float32(power), np.float32(floor)))
    leaves = rng.uniform(-4, -2, (num, 2)).astype(np.float32), rng.uniform(-0.5, 0.5, (num, 2)).astype(np.float32)
    splats = eqx.tree_at(lambda s: (s.log_scale, s.loc), splats, leaves)
    options = RenderOptions(low_pass=0.1)
    return VideoModel(splats, FrameTimes(time_weights(seed)), size, 29.97, options, compositing)


def time_weights(seed=0):
    """Logits of five frame times."""
    return np.random.default_rng(seed).normal(0, 0.5, 4).astype(np.float32)
