"""Log-likelihood of each frame as a piecewise cubic function of its own time, evaluated by compiled look-ups."""

import dataclasses
from collections.abc import Sequence

import numba as nb
import numpy as np
from jaxtyping import Float, Float64, Int

from foldgauss._runtime.checks import require
from foldgauss._runtime.kernels import inline, kernel

_d = nb.float64


@dataclasses.dataclass(frozen=True)
class ProfileCurves:
    r"""Functions $\ell_k(t)$, one per frame, piecewise cubic between nodes and -inf outside of them.

    Given the splats, the likelihood of frame k depends on t_k only, and the log-likelihood of all times is their sum.

    **Shapes:** `nodes`, `values`, `slopes` (num_frames, most), of which `count` (num_frames,) are used of each row.
    **Units:** times of the model, [0, 1]; nats.

    **Example:** `curves(times)` with times (*batch, num_frames) gives (*batch, num_frames).

    **Source:** VeGaS eq:frame_fitting, with the splats held. Cubic Hermite interpolation with second-order
    slopes: exact for parabolas, which log-likelihoods resemble near their maxima.
    """

    nodes: Float64[np.ndarray, "num_frames most"]
    values: Float64[np.ndarray, "num_frames most"]
    slopes: Float64[np.ndarray, "num_frames most"]
    count: Int[np.ndarray, "num_frames"]

    @classmethod
    def from_nodes(
        cls, nodes: Sequence[Float[np.ndarray, " nodes"]], values: Sequence[Float[np.ndarray, " nodes"]]
    ) -> "ProfileCurves":
        """From one increasing array of times and one of log-likelihoods per frame, at least three each.

        Raises ValueError for other shapes, times that do not increase, and log-likelihoods that are not finite.
        """
        count = np.array([len(each) for each in nodes])
        require(
            len(nodes) == len(values) and len(nodes) and (count >= 3).all(),
            "nodes",
            expected="for each frame at least three, and as many values",
            got=count.tolist(),
        )
        table = np.full((3, len(count), count.max()), np.nan)
        for k, (times, height) in enumerate(zip(nodes, values, strict=True)):
            times, height = np.asarray(times, np.float64), np.asarray(height, np.float64)
            require(
                times.shape == height.shape and times.ndim == 1 and (np.diff(times) > 0).all(),
                f"nodes[{k}]",
                expected=f"{height.size} increasing times",
                got=f"shape {times.shape}",
            )
            require(np.isfinite(height).all(), f"values[{k}]", expected="finite log-likelihoods", got=height.tolist())
            table[:, k, : count[k]] = times, height, np.gradient(height, times, edge_order=2)
        return cls(*table, count)

    @property
    def num_frames(self) -> int:
        return len(self.count)

    def __call__(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch num_frames"]:
        """Log-likelihoods of the frames at their `times`."""
        times = np.asarray(times, np.float64)
        require(
            times.shape[-1:] == (self.num_frames,),
            "times",
            expected=f"shape (..., {self.num_frames})",
            got=f"shape {times.shape}",
        )
        flat = np.ascontiguousarray(times.reshape(-1, self.num_frames))
        found = np.empty_like(flat)
        _look_up(flat, self.nodes, self.values, self.slopes, self.count, found)
        return found.reshape(times.shape)

    def nodes_and_values(self, k: int) -> tuple[Float64[np.ndarray, " nodes"], Float64[np.ndarray, " nodes"]]:
        """Nodes and values of frame k."""
        return self.nodes[k, : self.count[k]], self.values[k, : self.count[k]]

    def modes(self) -> Float64[np.ndarray, "num_frames"]:
        """The node with the largest value of each frame."""
        return self.nodes[np.arange(self.num_frames), np.nanargmax(self.values, axis=1)]

    def __getitem__(self, which) -> "ProfileCurves":
        """The curves of some frames."""
        which = np.atleast_1d(np.arange(self.num_frames)[which])
        return ProfileCurves(self.nodes[which], self.values[which], self.slopes[which], self.count[which])


@inline
def piece_of(value, knots, last):
    """Index of the interval of increasing `knots` that contains a value; the first and last are unbounded."""
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@inline
def value_at(t, nodes, values, slopes, last):
    """A curve at time t; `last` is the index of its last node. -inf outside, and for NaN."""
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
