"""The log-likelihood of each frame as a function of its own time alone, drawn once and then looked up."""

import dataclasses
from collections.abc import Sequence

import numba as nb
import numpy as np
from jaxtyping import Float, Float64, Int

from foldgauss._runtime.checks import invalid
from foldgauss._runtime.kernels import inline, kernel

_d = nb.float64


@dataclasses.dataclass(frozen=True)
class Profiles:
    r"""Functions $\ell_k(t)$, piecewise cubic between nodes; -inf outside of a frame's first and last node.

    Given the splats, frame k's likelihood depends on t_k only: the log-likelihood of all times is the sum of these.

    **Shapes:** `nodes`, `values`, `slopes` (num_frames, most), of which `count` (num_frames,) are used of each row.
    **Units:** times of the model, [0, 1]; nats.

    **Example:** `profiles(times)` with times (*batch, num_frames) gives (*batch, num_frames).

    **Source:** VeGaS eq:frame_fitting, with the splats held. Hermite's cubics, with slopes of second order: exact for
    parabolas, which likelihoods are near their maxima.
    """

    nodes: Float64[np.ndarray, "num_frames most"]
    values: Float64[np.ndarray, "num_frames most"]
    slopes: Float64[np.ndarray, "num_frames most"]
    count: Int[np.ndarray, "num_frames"]

    @classmethod
    def of(
        cls, nodes: Sequence[Float[np.ndarray, " nodes"]], values: Sequence[Float[np.ndarray, " nodes"]]
    ) -> "Profiles":
        """From one rising array of times and one of log-likelihoods a frame, at least three each.

        Raises ValueError for other shapes, times that do not rise, and NaN.
        """
        count = np.array([len(each) for each in nodes])
        if len(nodes) != len(values) or not len(nodes) or (count < 3).any():
            raise invalid("nodes", expected="for each frame at least three, and as many values", got=count.tolist())
        table = np.full((3, len(count), count.max()), np.nan)
        for k, (times, height) in enumerate(zip(nodes, values, strict=True)):
            times, height = np.asarray(times, np.float64), np.asarray(height, np.float64)
            if times.shape != height.shape or times.ndim != 1 or not (np.diff(times) > 0).all():
                raise invalid(f"nodes[{k}]", expected=f"{height.size} rising times", got=f"shape {times.shape}")
            if not np.isfinite(height).all():
                raise invalid(f"values[{k}]", expected="finite log-likelihoods", got=height[~np.isfinite(height)][0])
            table[:, k, : count[k]] = times, height, np.gradient(height, times, edge_order=2)
        return cls(*table, count)

    @property
    def num_frames(self) -> int:
        return len(self.count)

    def __call__(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch num_frames"]:
        """Log-likelihoods of the frames at their `times`."""
        times = np.asarray(times, np.float64)
        if times.shape[-1:] != (self.num_frames,):
            raise invalid("times", expected=f"shape (..., {self.num_frames})", got=f"shape {times.shape}")
        flat = np.ascontiguousarray(times.reshape(-1, self.num_frames))
        found = np.empty_like(flat)
        _look_up(flat, self.nodes, self.values, self.slopes, self.count, found)
        return found.reshape(times.shape)

    def one(self, k: int) -> tuple[Float64[np.ndarray, " nodes"], Float64[np.ndarray, " nodes"]]:
        """Nodes and values of frame k."""
        return self.nodes[k, : self.count[k]], self.values[k, : self.count[k]]

    def modes(self) -> Float64[np.ndarray, "num_frames"]:
        """The nodes with the greatest values."""
        return self.nodes[np.arange(self.num_frames), np.nanargmax(self.values, axis=1)]

    def __getitem__(self, which) -> "Profiles":
        """Of some frames."""
        which = np.atleast_1d(np.arange(self.num_frames)[which])
        return Profiles(self.nodes[which], self.values[which], self.slopes[which], self.count[which])

    def scaled(self, factor: Float[np.ndarray, "num_frames"] | float) -> "Profiles":
        """With all log-likelihoods times `factor`, a number > 0 or one a frame: for another noise of the same pictures.

        Raises ValueError for factors that are not finite and above 0, and for another number of them.
        """
        factor = np.asarray(factor)
        if factor.dtype.kind not in "iuf" or factor.shape not in ((), (1,), (self.num_frames,)):
            expected, got = f"a number, or {self.num_frames} of them", f"{factor.dtype} of shape {factor.shape}"
            raise invalid("factor", expected=expected, got=got)
        if not (np.isfinite(factor) & (factor > 0)).all():
            raise invalid("factor", expected="numbers > 0", got=f"one of {factor.min():.3g}")
        factor = np.broadcast_to(factor.astype(np.float64), self.num_frames)[:, None]
        return dataclasses.replace(self, values=self.values * factor, slopes=self.slopes * factor)


@inline
def piece_of(value, rising, last):
    """Number of the piece, between an entry of `rising` and the next, that a value is in; the end ones go on."""
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if rising[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@inline
def value_at(t, nodes, values, slopes, last):
    """A profile at time t; `last` is the number of its last node. -inf outside, and for NaN."""
    if not (t >= nodes[0] and t <= nodes[last]):
        return -np.inf
    low = piece_of(t, nodes, last)
    high = low + 1
    width = nodes[high] - nodes[low]
    u = (t - nodes[low]) / width
    v = _d(1) - u
    return v * v * ((_d(1) + _d(2) * u) * values[low] + u * width * slopes[low]) + u * u * (
        (_d(1) + _d(2) * v) * values[high] - v * width * slopes[high]
    )


@kernel
def _look_up(times, nodes, values, slopes, count, found):
    rows, frames = times.shape
    for k in range(frames):
        for row in range(rows):
            found[row, k] = value_at(times[row, k], nodes[k], values[k], slopes[k], count[k] - 1)
