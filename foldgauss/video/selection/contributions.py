"""Contribution of each Gaussian to a rendered image: the weights w_i(p) = alpha_i(p) times the transmittance at i.

An image is A c: linear in the colors, with A the weights. The renderer's two passes therefore apply A and its
transpose: the forward pass renders any three values per Gaussian, the backward pass sums any image times the weights
over pixels. There are always three channels, the number for which the fit has compiled its kernels.
"""

import dataclasses
import functools
import math

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.special import expit

from foldgauss.render import cpu
from foldgauss.video.models.conditioning import ConditionedSplats, PreparedModel, condition
from foldgauss.video.models.frame_times import snap_to_shots
from foldgauss.video.models.video_model import VideoModel, check_model
from foldgauss.video.selection.regions import Region

_BLACK = np.zeros(3, np.float32)


class Contributions:
    """A model prepared to compute, at any time and at its own size, what each Gaussian adds to the image.

    `background`, (3,), is what traces are composited over.

    **Raises:** ValueError for anything but a `VideoModel`, and for NaN or infinities.
    """

    def __init__(self, model: VideoModel, background: Float32[np.ndarray, "3"] = _BLACK):
        check_model(model)
        self.model, self.size, self.background = model, model.size, background
        self.prepared = PreparedModel(model, model.size)
        self.times = np.asarray(model.frame_times.times())

    @property
    def num_gaussians(self) -> int:
        return self.model.num_gaussians

    def at_frame(self, k: int) -> "FrameContributions":
        return self.at(float(self.times[k]))

    def at(self, t: float) -> "FrameContributions":
        """The contributions at time t; in the gap of a cut those at the nearer frame, as in rendering."""
        return FrameContributions(self, self.prepared.at(float(snap_to_shots(t, self.times))))

    def centers_at(self, indices: Int[np.ndarray, " num"], t: float) -> Float32[np.ndarray, "num 2"]:
        """Centers of these Gaussians at time t, in pixels, alive or not."""
        always = np.broadcast_to(np.float32([-math.inf, math.inf]), (len(indices), 2))
        return condition(self.prepared.rows[indices], always, t, self.prepared.spec).mean

    def own_centers(self, indices: Int[np.ndarray, " num"]) -> Float[np.ndarray, "num 2"]:
        """Centers of these Gaussians at their own m_t, where the fold is 0, in pixels."""
        (height, width), splats = self.size, self.model.splats
        loc = np.asarray(splats.loc, np.float64)[indices]
        if splats.paths is not None:
            maps = self.prepared.spec.paths.by_index(self.own_times[indices], np.asarray(splats.path_index)[indices])
            loc = np.einsum("nij,nj->ni", maps[..., :2], loc) + maps[..., 2]
        return loc * max(self.size) + [width / 2, height / 2]

    @functools.cached_property
    def own_times(self) -> Float[np.ndarray, "num_gaussians"]:
        """m_t of every Gaussian."""
        return expit(np.asarray(self.model.splats.time_loc_logit, np.float64))

    def nearest_frame(self, indices: Int[np.ndarray, " num"]) -> Int[np.ndarray, " num"]:
        """The frame nearest to the m_t of each of these Gaussians."""
        return np.searchsorted((self.times[1:] + self.times[:-1]) / 2, self.own_times[indices])


@dataclasses.dataclass(frozen=True, eq=False)
class FrameContributions:
    """The Gaussians alive at one time, and their weights in the image."""

    source: Contributions
    splats: ConditionedSplats

    @property
    def alive(self) -> Int[np.ndarray, " num_alive"]:
        """Indices of the Gaussians alive, in array order."""
        return self.splats.alive

    @functools.cached_property
    def trace(self) -> cpu.Trace:
        return self._forward(self.splats.color, self.source.background)

    @functools.cached_property
    def total(self) -> Float32[np.ndarray, " num_alive"]:
        """Sum of each Gaussian's weights over pixels, in pixels."""
        return self.gather(np.ones((1, *self.source.size), np.float32))[:, 0]

    def render(self, values: Float[np.ndarray, "num_alive channels"]) -> Float32[np.ndarray, "channels height width"]:
        """A v: the image of up to three values per Gaussian in place of its color."""
        return self._forward(_pad_to_three(values, 1), _BLACK).image[: values.shape[1]]

    def gather(self, images: Float[np.ndarray, "channels height width"]) -> Float32[np.ndarray, "num_alive channels"]:
        """A^T y: up to three images times the weights, summed over pixels."""
        return cpu.backward(self.trace, _pad_to_three(images, 0))[3][:, : len(images)]

    def _forward(self, color: Float32[np.ndarray, "num_alive 3"], background: Float32[np.ndarray, "3"]) -> cpu.Trace:
        splats, model = self.splats, self.source.model
        leaves = splats.mean, splats.factor, splats.opacity, color, background
        return cpu.forward(*leaves, self.source.size, compositing=model.compositing, options=model.options)


def _pad_to_three(values: np.ndarray, axis: int) -> np.ndarray:
    """As float32, with zeros up to three along the axis."""
    pad = [(0, 0)] * values.ndim
    pad[axis] = (0, 3 - values.shape[axis])
    return np.ascontiguousarray(np.pad(values.astype(np.float32), pad))


def sum_contributions(
    contributions: Contributions, region: Region
) -> tuple[
    Float[np.ndarray, " num_gaussians"], Float[np.ndarray, " num_gaussians"], Float[np.ndarray, " num_gaussians"]
]:
    """Each Gaussian's weights over a region's frames: summed inside it, in all, and in its best frame; px, float64."""
    inside, total, best = np.zeros((3, contributions.num_gaussians))
    everywhere = np.ones(contributions.size, np.float32)
    for k in region.frames:
        frame = contributions.at_frame(k)
        own_inside, own = frame.gather(np.stack([region.at(k), everywhere])).T
        inside[frame.alive] += own_inside
        total[frame.alive] += own
        best[frame.alive] = np.maximum(best[frame.alive], own)
    return inside, total, best


def average_seen_colors(
    contributions: Contributions,
) -> tuple[Float[np.ndarray, "num_gaussians 3"], Bool[np.ndarray, " num_gaussians"]]:
    """The rendered color where each Gaussian is visible, averaged over all frames; and which are visible at all."""

    color, total = np.zeros((contributions.num_gaussians, 3)), np.zeros((contributions.num_gaussians, 1))
    for k in range(len(contributions.times)):
        frame = contributions.at_frame(k)
        color[frame.alive] += frame.gather(frame.trace.image)
        total[frame.alive] += frame.total[:, None]
    return np.divide(color, total, out=color, where=total > 0), total[:, 0] > 0


def render_matte(
    contributions: Contributions, mask: Bool[np.ndarray, " num_gaussians"], t: float
) -> Float32[np.ndarray, "height width"]:
    """The fraction of each pixel's weights at time t that belongs to the Gaussians of `mask`; 0 without any."""
    frame = contributions.at(t)
    chosen = mask[frame.alive]
    own, everyone = frame.render(np.stack([chosen, np.ones_like(chosen)], 1))
    return np.divide(own, everyone, out=np.zeros_like(own), where=everyone > 0)
