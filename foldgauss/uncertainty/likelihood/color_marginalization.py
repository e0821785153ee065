"""Likelihood profiles of frame times with the colors of the splats integrated out.

Given the splats, the effect of a frame on their colors makes its time look too precise. Images are linear in the
colors, so all of these are integrated out in closed form, with every other frame at its most likely time.
"""

import bisect
import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float64, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import is_integer, is_within, require
from foldgauss.uncertainty.likelihood.color_normal_equations import ColorEquations, FrameAt, solve_conjugate_gradient
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.likelihood.residuals import Residuals, check_frames
from foldgauss.video.models.video_model import VideoModel

#: Profiles extend until the base has fallen by so many nats,
REACH = 12.0
#: then until they have fallen by so many nats themselves.
FALL = 8.0
#: Nodes are inserted between two that differ by more nats than this.
STEP = 1.5
#: The most nodes.
MAX_NODES = 13
#: Relative residual of the solver: the error of the quadratic form, some 1e5 nats, is of the order of its square.
TOLERANCE = 1e-5
#: Relative residual for traces: the error of the change of the log-determinant, some nats, is of its order.
TRACE_TOLERANCE = 1e-3


def marginalize_colors(
    model: VideoModel,
    video: UInt8[np.ndarray, "num_frames height width channels"],
    base: LikelihoodProfiles,
    *,
    frames: Sequence[int] | None = None,
    prior_scale: float = 0.5,
    most_dense: int = 3000,
    probes: int = 4,
    seed: int = 0,
    on_frame: Callable[[int, int], None] | None = None,
) -> LikelihoodProfiles:
    r"""Integrate out the colors in the profiles of `frames` (default: all but the first and the last); keep the others.

    $$
    \ell_k(t) = -\tfrac12 r^T C^{-1} r - \tfrac12 \log\det C, \quad C = s_k^2 I + A(t) P A(t)^T,
    \quad r = y_k - A(t) \hat c
    $$

    summed over channels, where $N(\hat c, P)$ is the posterior of the colors given all frames but k at the modes of
    `base`, and $s_k^2$ = scale^2 / fraction. It is computed as the evidence of all frames less that of the others: with
    H the precision of the colors given all frames, b the right-hand side and d the residuals of the model's own colors,
    $-\tfrac12 (d^T d / s_k^2 - b^T H^{-1} b) - \tfrac12 \log\det H$ up to a constant.

    **Held:** shapes, folds and opacities, the other frames' times, the noise. **Neglected:** that colors are not below
    0 (the model clamps them; offsets start from the clamped colors). **Prior:** each color channel is normal about the
    model's own with standard deviation `prior_scale`, in units of the pixels' range; as it tends to 0, so does the
    difference to `base`.

    **Width:** the information of a time, g^T C^{-1} g with g = dR/dt, never exceeds that with colors held, g^T g / s^2,
    at equal colors. Here they are optimal for the other frames, so the profile may be shifted and narrower than `base`.

    Up to `most_dense` Gaussians the result is exact (Cholesky). Beyond, the quadratic form is solved by conjugate
    gradients, to about 1e-3 nats, and differences of log det are integrated from traces estimated with `probes` random
    sign vectors of `seed`. `on_frame` is called with the numbers of frames done and to do. Beyond the new nodes the
    profile continues as `base`, scaled to the same initial slope and never above the value at the junction.

    **Shapes and units:** as `ProfileCurves`; nats, the maximum of each new profile is 0.

    **Raises:** ValueError for a video, base or frames that do not match, and values out of range.

    **Source:** linear Gaussian models; Woodbury's identity and Sylvester's for determinants; traces: Hutchinson 1990.
    """
    residuals = Residuals(model, video)
    num_frames = len(residuals.frames)
    _check(base, num_frames, prior_scale, most_dense, probes)
    chosen = check_frames(frames, num_frames)
    times = base.curves.modes()
    times[[0, -1]] = np.asarray(model.frame_times.times(), np.float64)[[0, -1]]
    equations = ColorEquations(residuals, base.noise, times, float(prior_scale))
    nodes, values = (list(each) for each in zip(*map(base.curves.nodes_and_values, range(num_frames)), strict=True))
    for done, k in enumerate(chosen):
        if equations.num <= most_dense:
            curve: _Dense | _Estimated = _Dense(equations, k)
        else:
            signs = make_generator(Stream.COLOR_PROBE, k, seed=seed).choice(
                [-1.0, 1.0], size=(int(np.prod(model.size)), probes)
            )
            curve = _Estimated(equations, k, signs)
        _refine(curve, nodes[k], values[k], *_neighbor_times(times, k))
        nodes[k], values[k] = _join(*curve.profile(), nodes[k], values[k])
        if on_frame is not None:
            on_frame(done + 1, len(chosen))
    unknown = np.full_like(base.log_likelihood, np.nan)  # of the modes with integrated colors
    curves = ProfileCurves.from_nodes(nodes, values)
    return dataclasses.replace(base, curves=curves, log_likelihood=unknown, level="colors")


def _check(base: LikelihoodProfiles, num_frames: int, prior_scale: float, most_dense: int, probes: int) -> None:
    require(
        isinstance(base, LikelihoodProfiles),
        "base",
        expected="LikelihoodProfiles",
        got=type(base).__name__,
        cure="Call likelihood_profiles(model, video).",
    )
    require(
        base.curves.num_frames == num_frames,
        "base",
        expected=f"profiles of {num_frames} frames, as the video has",
        got=f"{base.curves.num_frames} frames",
        cure="Call likelihood_profiles with this video.",
    )
    require(
        is_within(prior_scale, "(0, inf)"),
        "prior_scale",
        expected="a number > 0",
        got=prior_scale,
        cure="Colors are in about [0, 1].",
    )
    for name, value, least in (("most_dense", most_dense, 0), ("probes", probes, 1)):
        require(is_integer(value, least), name, expected=f"a whole number >= {least}", got=value)


def _neighbor_times(times: Float64[np.ndarray, " num_frames"], k: int) -> tuple[float, float]:
    """The neighbors' times, or 0 and 1 where those are out of order."""
    low, high = times[k - 1], times[k + 1]
    return (low if low < times[k] else 0.0), (high if high > times[k] else 1.0)


class _Curve:
    """The log-likelihood of a frame at the times evaluated so far, in increasing order."""

    def __init__(self, equations: ColorEquations, k: int):
        self.equations, self.k = equations, k
        self.times: list[float] = []
        self.points: list = []

    def evaluate(self, t: float) -> None:
        if t not in self.times:
            point = self.point(FrameAt(self.equations, self.k, t))
            place = bisect.bisect(self.times, t)
            self.times.insert(place, t)
            self.points.insert(place, point)

    def profile(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and log-likelihoods, with maximum 0."""
        values = self.values()
        return np.array(self.times), values - values.max()


class _Dense(_Curve):
    """Exact, by a Cholesky factorization at every time."""

    def point(self, at: FrameAt) -> float:
        factor = scipy.linalg.cholesky(at.dense(), lower=True, overwrite_a=True, check_finite=False)
        whitened = scipy.linalg.solve_triangular(factor, at.rhs, lower=True, check_finite=False)
        left = (at.residual**2).sum() / at.variance - (whitened**2).sum()
        return -left / 2 - at.rhs.shape[1] * np.log(factor.diagonal()).sum()

    def values(self) -> np.ndarray:
        return np.array(self.points)


class _Point(NamedTuple):
    log_likelihood: float  # without the determinant
    solution: np.ndarray  # H^-1 applied to the right-hand sides and `projected`: (num, 3 + probes)
    projected: np.ndarray  # A^T z / s of the probes z: (num, probes)


class _Estimated(_Curve):
    """By conjugate gradients, and a stochastic estimate of the determinant."""

    def __init__(self, equations: ColorEquations, k: int, signs: Float64[np.ndarray, "pixels probes"]):
        super().__init__(equations, k)
        self.signs = signs

    def point(self, at: FrameAt) -> _Point:
        projected = at.weights.T @ self.signs / np.sqrt(at.variance)
        rhs = np.concatenate([at.rhs, projected], axis=1)
        tolerance = np.where(np.arange(rhs.shape[1]) < at.rhs.shape[1], TOLERANCE, TRACE_TOLERANCE)
        start = self._guess(at.t, rhs)
        found = solve_conjugate_gradient(at.__matmul__, self.equations.precondition, rhs, start, tolerance)
        colors = found[:, : at.rhs.shape[1]]
        # A lower bound whose error is second order in that of the solution, independent of the start.
        explained = (colors * (2 * at.rhs - at @ colors)).sum()
        left = (at.residual**2).sum() / at.variance - explained
        return _Point(-left / 2, found, projected)

    def _guess(self, t: float, rhs: np.ndarray) -> np.ndarray:
        """Linear extrapolation from the two solutions nearest in time."""
        if not self.points:
            own = self.equations.solution
            return np.concatenate([own, np.zeros((len(rhs), rhs.shape[1] - own.shape[1]))], axis=1)
        near = sorted(range(len(self.times)), key=lambda n: abs(self.times[n] - t))[:2]
        if len(near) == 1:
            return self.points[near[0]].solution
        (one, first), (other, second) = ((self.times[n], self.points[n].solution) for n in near)
        fraction = (t - one) / (other - one)
        return first + fraction * (second - first) if abs(fraction) < 2 else first

    def values(self) -> np.ndarray:
        # d log det H = tr(H^-1 dH), dH = (dA^T A + A^T dA) / s^2, E z z^T = I.
        channels = self.points[0].solution.shape[1] - self.signs.shape[1]  # the other columns are those of the probes
        rises = [
            ((after.projected - before.projected) * (after.solution + before.solution)[:, channels:]).sum()
            / self.signs.shape[1]
            for before, after in zip(self.points[:-1], self.points[1:], strict=True)
        ]
        log_det = np.concatenate([[0.0], np.cumsum(rises)])
        return np.array([each.log_likelihood for each in self.points]) - channels * log_det / 2


def _refine(curve: _Curve, base_nodes: np.ndarray, base_values: np.ndarray, low: float, high: float) -> None:
    """Evaluate a profile between `low` and `high`: first outwards as far as required, then in between."""
    best = int(np.argmax(base_values))
    mode, below = float(base_nodes[best]), base_values - base_values[best]
    left = _time_of_fall(base_nodes[best::-1], below[best::-1])
    right = _time_of_fall(base_nodes[best:], below[best:])
    for t in (mode, max(left, low), min(right, high)):
        curve.evaluate(t)
    for end, limit in ((0, low), (-1, high)):
        while curve.profile()[1][end] > -FALL and curve.times[end] != limit:
            times = curve.times
            step = max(abs(times[end] - mode), (times[-1] - times[0]) / 4)
            further = times[end] + (2 * end + 1) * -step
            curve.evaluate(max(further, low) if end == 0 else min(further, high))
    while len(curve.times) < MAX_NODES:
        times, values = curve.profile()
        matters = np.maximum(values[1:], values[:-1]) > -REACH
        steps = np.where(matters, np.minimum(np.abs(np.diff(values)), REACH), 0)
        steps[max(int(np.argmax(values)) - 1, 0) : int(np.argmax(values)) + 1] *= 2
        widest = int(np.argmax(steps))
        if steps[widest] <= STEP and len(times) >= 5:
            break
        if steps[widest] <= STEP:
            widest = int(np.argmax(np.diff(times)))
        curve.evaluate(float(times[widest] + times[widest + 1]) / 2)
    curve.evaluate(_vertex(*curve.profile()))


def _vertex(times: np.ndarray, values: np.ndarray) -> float:
    """Vertex of the parabola through the maximum and its neighbors; a midpoint if that is a node."""
    middle = int(np.clip(np.argmax(values), 1, len(times) - 2))
    (a, b, c), (left, top, right) = times[middle - 1 : middle + 2], values[middle - 1 : middle + 2]
    rise, fall = (top - left) / (b - a), (right - top) / (c - b)
    bend = (fall - rise) / (c - a)
    if bend < 0:
        t = float(np.clip((a + b) / 2 - rise / (2 * bend), a, c))
        if np.abs(times - t).min() > 1e-3 * (c - a):
            return t
    return float((a + b) / 2 if left > right else (b + c) / 2)


def _time_of_fall(times: np.ndarray, values: np.ndarray) -> float:
    """The time at which values, 0 at first, have fallen by REACH; or the last of `times`."""
    beyond = np.flatnonzero(values <= -REACH)
    if not beyond.size:
        return float(times[-1])
    pair = slice(beyond[0] - 1, beyond[0] + 1)
    return float(np.interp(REACH, -values[pair], times[pair]))


def _join(
    times: np.ndarray, values: np.ndarray, base_nodes: np.ndarray, base_values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Continue the profile on both sides by the base's nodes."""
    after, high = _continue(times, values, base_nodes, base_values)
    before, low = _continue(-times[::-1], values[::-1], -base_nodes[::-1], base_values[::-1])
    return np.concatenate([-before[::-1], times, after]), np.concatenate([low[::-1], values, high])


def _continue(
    times: np.ndarray, values: np.ndarray, base_nodes: np.ndarray, base_values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The base's nodes after the profile, at least its last one, and values there."""
    spacing = times[-1] - times[-2]
    beyond = base_nodes > times[-1] + spacing
    beyond[-1] = base_nodes[-1] > times[-1]
    nodes = base_nodes[beyond]
    falls = ProfileCurves.from_nodes([base_nodes], [base_values])(times[-1:]) - base_values[beyond]
    if len(nodes) and falls[0] > 0:
        steepness = max(values[-2] - values[-1], 1.0) / spacing
        falls = falls * min(1.0, steepness * (nodes[0] - times[-1]) / falls[0])
    return nodes, values[-1] - np.maximum(falls, 0)
