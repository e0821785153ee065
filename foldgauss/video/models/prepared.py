"""A model prepared for conditioning on many times, for images of one size: packed rows and their time windows."""

from typing import Any

import jax
import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import Splats2D
from foldgauss.render.splats import check_size
from foldgauss.video.models.conditioning import (
    ConditionedSplats,
    ConditioningSpec,
    condition,
    find_windows,
)
from foldgauss.video.models.renderer import PreparedVideo
from foldgauss.video.models.row_layout import pack
from foldgauss.video.models.shared_paths import check_paths


class PreparedModel(PreparedVideo):
    """The Gaussians of a `VideoModel`, ready to be conditioned on any time, in pixels of an image of `size`.

    `aspect` is the height / width of the frame that covers the image (default: the model's).

    **Example:** `PreparedModel(model, (160, 320)).splats(0.5)`.

    **Source:** VeGaS eq:vegas_equiv_cond. **Raises:** ValueError for an invalid size, and for a model with NaN or
    infinities or with several envelopes.
    """

    def __init__(self, model: Any, size: tuple[int, int], *, aspect: float | None = None):
        check_size(size)
        height, width = model.size
        self.rows = pack(model.splats)
        broken = int((~np.isfinite(self.rows)).any(-1).sum())
        require(
            not broken,
            "model",
            expected="finite numbers",
            got=f"others in {broken:,} Gaussians",
            cure="The fit diverged, or the model was edited: fit again.",
        )
        power, floor = (_common_value(model.splats.envelope, name) for name in ("power", "floor"))
        aspect = height / width if aspect is None else aspect
        check_paths(model.splats)
        paths = jax.tree.map(np.asarray, model.splats.paths)
        own = {"aspect": aspect, "paths": paths, "scale_cutoff": model.scale_cutoff}
        self.spec = ConditioningSpec(model.splats.degree, power, floor, tuple(size), **own)
        self.window = find_windows(self.rows, self.spec)
        self.times = np.asarray(model.frame_times.times())

    def at(self, t: float, members: np.ndarray | None = None) -> ConditionedSplats:
        """The Gaussians alive at time t, also outside [0, 1]; of `members`, bool (num_gaussians,), if given."""
        return condition(self.rows, self.window, t, self.spec, members)

    def splats(self, t: float) -> Splats2D:
        """The splats of the Gaussians alive at time t, front to back; NumPy leaves."""
        done = self.at(t)
        return Splats2D(done.mean, done.factor, done.opacity, done.color)


def _common_value(envelope: TimeLikelihood, name: str) -> float:
    """The value that all Gaussians have in common."""
    values = np.unique(np.asarray(getattr(envelope, name)))
    require(
        values.size == 1,
        f"model.splats.envelope.{name}",
        expected="one number for all Gaussians",
        got=f"{values.size} different ones",
        cure="Use VideoModel.render, which supports one envelope per Gaussian.",
    )
    return float(values[0])
