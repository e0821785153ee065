"""A model made ready to be conditioned many times, for pictures of one size."""

from typing import Protocol

import numpy as np

from foldgauss._runtime.checks import invalid
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import Splats2D
from foldgauss.render.splats import check_size
from foldgauss.video.models.conditioning import (
    ConditionedSplats,
    ConditioningSpec,
    apply_scale_cutoff,
    condition,
    update_windows,
)
from foldgauss.video.models.frame_times import FrameTimes, snap_to_shots
from foldgauss.video.models.row_layout import pack
from foldgauss.video.models.splats import FoldedSplats


class _Model(Protocol):
    """What is read of a `VideoModel`, which is built upon this module."""

    splats: FoldedSplats
    frame_times: FrameTimes
    size: tuple[int, int]
    scale_cutoff: float


class PreparedModel:
    """The Gaussians of a model by time, in pixels of a picture of `size`: rows packed, spans of time known.

    `aspect` is the height / width of the frame that covers the picture (default: the model's).

    **Example:** `PreparedModel(model, (160, 320)).splats(0.5)`.

    **Source:** VeGaS eq:vegas_equiv_cond. **Raises:** ValueError for a size that is none, and for a model
    with NaN or infinities in it (its pictures would have holes) or with several envelopes.
    """

    def __init__(self, model: _Model, size: tuple[int, int], *, aspect: float | None = None):
        check_size(size)
        height, width = model.size
        self.rows = pack(model.splats)
        _check_finite(self.rows)
        self.shape = _shape_of(model.splats, tuple(size), height / width if aspect is None else aspect)
        self.window = np.empty((len(self.rows), 2), np.float32)
        update_windows(self.rows, np.arange(len(self.rows)), self.window)
        apply_scale_cutoff(self.rows, self.window, self.shape, model.scale_cutoff)
        self._times = np.asarray(model.frame_times.times())

    def at(self, t: float, members: np.ndarray | None = None) -> ConditionedSplats:
        """The Gaussians alive at time t, any number; of `members`, bool (num_gaussians,), if given."""
        return condition(self.rows, self.window, t, self.shape, members)

    def splats(self, t: float) -> Splats2D:
        """The splats of the Gaussians alive at time t, front to back; NumPy leaves."""
        done = self.at(t)
        return Splats2D(done.mean, done.factor, done.opacity, done.color)

    def weighted_splats(self, t: float) -> list[tuple[float, Splats2D]]:
        """One picture, see `foldgauss.video.models.renderer.Prepared`."""
        return [(1.0, self.splats(snap_to_shots(t, self._times)))]


def _check_finite(rows: np.ndarray) -> None:
    broken = int((~np.isfinite(rows)).any(-1).sum())
    if broken:
        got, cure = f"{broken:,} Gaussians that have none", "The fit diverged, or the model was edited: fit again."
        raise invalid("model", expected="finite numbers", got=got, cure=cure)


def _shape_of(splats: FoldedSplats, size: tuple[int, int], aspect: float) -> ConditioningSpec:
    power, floor = (_the_one(splats.envelope, name) for name in ("power", "floor"))
    return ConditioningSpec(splats.degree, power, floor, size, aspect=aspect)


def _the_one(envelope: TimeLikelihood, name: str) -> float:
    """The number that all Gaussians share."""
    values = np.unique(np.asarray(getattr(envelope, name)))
    if values.size != 1:
        got = f"{values.size} different ones"
        cure = "Use VideoModel.render, which knows an envelope of each Gaussian's own."
        raise invalid(f"model.splats.envelope.{name}", expected="one number for all Gaussians", got=got, cure=cure)
    return float(values[0])
