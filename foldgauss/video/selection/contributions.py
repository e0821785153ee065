"""Who adds what to the picture: the weights w_i(p) = alpha_i(p) times the light that reaches Gaussian i at pixel p.

A picture is A c: linear in the colours, with A the weights. So the renderer's two passes give both ways through A:
forward, what any three numbers of each Gaussian look like; backward, the sums over pixels of any picture times the
weights. Three channels always, since the kernels for three are those that the fit and playback have compiled.
"""

import dataclasses
import functools
import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.special import expit

from foldgauss.render import cpu
from foldgauss.video.models.conditioning import ConditionedSplats, condition
from foldgauss.video.models.frame_times import snap_to_shots
from foldgauss.video.models.prepared import PreparedModel
from foldgauss.video.models.video_model import VideoModel, check_model
from foldgauss.video.selection.regions import Region

_DARK = np.zeros(3, np.float32)


class Contributions:
    """A model ready to be asked, at any time and its own size, what its Gaussians add to the picture.

    **Raises:** ValueError for what is no `VideoModel`, for numbers that are not finite, and for several envelopes.
    """

    def __init__(self, model: VideoModel):
        check_model(model)
        self.model, self.size = model, model.size
        self.stage = PreparedModel(model, model.size)
        self.times = np.asarray(model.frame_times.times())

    @property
    def num_gaussians(self) -> int:
        return self.model.num_gaussians

    @property
    def window(self) -> Float32[np.ndarray, "num_gaussians 2"]:
        """First and last time at which each Gaussian is drawn."""
        return self.stage.window

    def frame(self, k: int) -> "Light":
        """The light of frame k."""
        return self.at(float(self.times[k]))

    def at(self, t: float) -> "Light":
        """The light at time t; between two shots the nearer one's, as pictures are drawn."""
        return Light(self, self.stage.at(float(snap_to_shots(t, self.times))))

    def position(self, indices: Int[np.ndarray, " num"], t: float) -> Float32[np.ndarray, "num 2"]:
        """Centres of the named Gaussians, in pixels, at any time, alive or not."""
        ever = np.broadcast_to(np.float32([-math.inf, math.inf]), (len(indices), 2))
        return condition(self.stage.rows[indices], ever, t, self.stage.shape).mean

    def own_place(self, indices: Int[np.ndarray, " num"]) -> Float[np.ndarray, "num 2"]:
        """Centres of the named Gaussians at their own times, in pixels: there the fold is 0."""
        height, width = self.size
        return np.asarray(self.model.splats.loc, np.float64)[indices] * max(self.size) + [width / 2, height / 2]

    @functools.cached_property
    def own_times(self) -> Float[np.ndarray, "num_gaussians"]:
        """m_t of every Gaussian."""
        return expit(np.asarray(self.model.splats.time_loc_logit, np.float64))

    def nearest_frame(self, indices: Int[np.ndarray, " num"]) -> Int[np.ndarray, " num"]:
        """The frame next to each named Gaussian's own time."""
        return np.searchsorted((self.times[1:] + self.times[:-1]) / 2, self.own_times[indices])


@dataclasses.dataclass(frozen=True, eq=False)
class Light:
    """One time of a model: the Gaussians alive, and the weights by which they make the picture."""

    lit: Contributions
    splats: ConditionedSplats

    @property
    def alive(self) -> Int[np.ndarray, " num_alive"]:
        """Numbers of the Gaussians alive, in array order."""
        return self.splats.alive

    @functools.cached_property
    def trace(self) -> cpu.Trace:
        return self._forward(self.splats.color)

    @property
    def picture(self) -> Float32[np.ndarray, "3 height width"]:
        """What is seen, over black."""
        return self.trace.image

    @functools.cached_property
    def total(self) -> Float32[np.ndarray, " num_alive"]:
        """Sum over pixels of the weights, in pixels."""
        return self.gathered(np.ones((1, *self.lit.size), np.float32))[:, 0]

    def drawn(self, values: Float[np.ndarray, "num_alive channels"]) -> Float32[np.ndarray, "channels height width"]:
        """A v: the picture of up to three numbers per Gaussian, as if they were its colours."""
        return self._forward(_three(values, 1)).image[: values.shape[1]]

    def gathered(self, planes: Float[np.ndarray, "channels height width"]) -> Float32[np.ndarray, "num_alive channels"]:
        """A^T y: sums over pixels of up to three pictures times the weights."""
        return cpu.backward(self.trace, _three(planes, 0))[3][:, : len(planes)]

    def _forward(self, color: Float32[np.ndarray, "num_alive 3"]) -> cpu.Trace:
        splats, model = self.splats, self.lit.model
        leaves = splats.mean, splats.factor, splats.opacity, color, _DARK
        return cpu.forward(*leaves, self.lit.size, compositing=model.compositing, options=model.options)


def _three(values: np.ndarray, axis: int) -> np.ndarray:
    """float32, filled up with zeros to three along the axis."""
    pad = [(0, 0)] * values.ndim
    pad[axis] = (0, 3 - values.shape[axis])
    return np.ascontiguousarray(np.pad(values.astype(np.float32), pad))


def contributions(
    lit: Contributions, region: Region
) -> tuple[
    Float[np.ndarray, " num_gaussians"], Float[np.ndarray, " num_gaussians"], Float[np.ndarray, " num_gaussians"]
]:
    """What each Gaussian adds over the frames of a region: inside it, in all, and in its best frame; px, float64."""
    inside, total, best = np.zeros((3, lit.num_gaussians))
    everywhere = np.ones(lit.size, np.float32)
    for k in region.frames:
        light = lit.frame(k)
        own_inside, own = light.gathered(np.stack([region.at(k), everywhere])).T
        inside[light.alive] += own_inside
        total[light.alive] += own
        best[light.alive] = np.maximum(best[light.alive], own)
    return inside, total, best


def best_frames(
    lit: Contributions, frames: Iterable[int], best: Float[np.ndarray, " num_gaussians"]
) -> Float[np.ndarray, " num_gaussians"]:
    """What each Gaussian adds in its best frame, of `frames` too, if that is more than `best`."""
    best = best.copy()
    for k in frames:
        light = lit.frame(k)
        best[light.alive] = np.maximum(best[light.alive], light.total)
    return best


def seen_colors(
    lit: Contributions,
) -> tuple[Float[np.ndarray, "num_gaussians 3"], Bool[np.ndarray, " num_gaussians"]]:
    """The picture's colour where each Gaussian is seen, the mean over all frames; and which are seen at all."""

    def parts():
        for k in range(len(lit.times)):
            light = lit.frame(k)
            seen = light.total > 0
            total = light.total[seen]
            yield light.alive[seen], light.gathered(light.picture)[seen] / total[:, None], total

    return weighted_mean(lit.num_gaussians, parts())


def weighted_mean(
    num: int, parts: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> tuple[Float[np.ndarray, "num 3"], Bool[np.ndarray, " num"]]:
    """Means of (index, value, weight) of several frames; and which of `num` there were any of."""
    value, total = np.zeros((num, 3)), np.zeros((num, 1))
    for index, own, weight in parts:
        value[index] += weight[:, None] * own
        total[index] += weight[:, None]
    there = total[:, 0] > 0
    return np.divide(value, total, out=value, where=there[:, None]), there


def drawn_share(
    lit: Contributions, mask: Bool[np.ndarray, " num_gaussians"], t: float
) -> Float32[np.ndarray, "height width"]:
    """The share of a set of Gaussians in each pixel at time t: sum of their weights over that of all; 0 where none."""
    light = lit.at(t)
    chosen = mask[light.alive]
    own, everyone = light.drawn(np.stack([chosen, np.ones_like(chosen)], 1))
    return np.divide(own, everyone, out=np.zeros_like(own), where=everyone > 0)


def reached(lit: Contributions, mask: Bool[np.ndarray, " num_gaussians"], t: float) -> Bool[np.ndarray, "height width"]:
    """The pixels at time t that a set of Gaussians reaches: where the alpha of one is not cut off, seen or hidden."""
    splats = lit.at(t).splats
    chosen = mask[splats.alive]
    leaves = splats.mean[chosen], splats.factor[chosen], splats.opacity[chosen]
    bright = np.ones((int(chosen.sum()), 3), np.float32)
    # Added up: nothing hides behind anything then.
    drawn = cpu.forward(*leaves, bright, _DARK, lit.size, compositing="sum", options=lit.model.options)
    return drawn.image[0] > 0
