"""ProfileCurves of frame times with the colours of the splats integrated out: level (b), between splats held and a refit.

Given the splats, a frame's own imprint on their colours makes its time look surer than it is. Pictures are linear in
colours, so these are integrated out in closed form, all of them, with every other frame at its most likely time.
"""

import bisect
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float64, UInt8

from foldgauss._runtime.checks import invalid, is_integer, is_within
from foldgauss.uncertainty.likelihood.color_normal_equations import ColorEquations, FrameAt, solve_conjugate_gradient
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video.models.video_model import VideoModel

#: ProfileCurves reach as far as the given ones fall by REACH nats, then until they have fallen by FALL nats themselves.
REACH, FALL = 12.0, 8.0
#: Nodes are put between two that differ by more than STEP nats, until there are MOST of them.
STEP, MOST = 1.5, 13
#: How far residuals of the equations are brought down: an error of the square of it in the quadratic form, 1e-8 of
#: some 1e5 nats; and one of its size in the change of the determinant, some nats.
TOLERANCE, TRACE_TOLERANCE = 1e-5, 1e-3


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
) -> ProfileCurves:
    r"""ProfileCurves of `frames` (default: all but the first and the last) with colours integrated out; of others, `base`'s.

    $$
    \ell_k(t) = -\tfrac12 r^T C^{-1} r - \tfrac12 \log\det C, \quad C = s_k^2 I + A(t) P A(t)^T,
    \quad r = y_k - A(t) \hat c
    $$

    summed over channels, where $N(\hat c, P)$ are the colours given all frames but k, at the times where `base`
    is greatest, and $s_k^2$ = scale^2 / share. It is taken as what all frames say together less what the others
    do: with H the precision of the colours given all of them, b their right-hand side and d the residuals of the
    model's own colours, $-\tfrac12 (d^T d / s_k^2 - b^T H^{-1} b) - \tfrac12 \log\det H$ up to a constant.

    **What is held:** shapes, folds and opacities, the other frames' times, the noise. **What is left out:** that
    colours are not below 0 (the model clamps them; offsets start from the clamped ones). **Prior:** each channel of
    each colour about the model's own with standard deviation `prior_scale`, in units of the pixels' range; towards 0
    `base` comes back.

    **How much wider:** at the same colours a time's information g^T C^{-1} g, with g = dR/dt, never exceeds that with
    colours held, g^T g / s^2. The profile may still be narrower than `base`'s and stand elsewhere: its colours are the
    best for the other frames, which those of a fit, stopped early and clamped, are not.

    Up to `most_dense` Gaussians everything is exact (Cholesky). Beyond, the quadratic form is by conjugate gradients,
    to about 1e-3 nats, and differences of log det by the trapezoidal rule over traces estimated with `probes` random
    signs, drawn from `seed` and the same at all times of a frame. 40,000 Gaussians at 160x320, 132 frames, one core:
    80 s for the equations, then 30 to 55 s a frame. `on_frame` is called with how many are done, and how
    many there are.

    Where the base profile has nodes further out, the new one goes on as that does, scaled so that it falls as steeply
    at first, and is nowhere greater than where it is joined.

    **Shapes and units:** as `ProfileCurves`; nats, the greatest value of each new profile 0.

    **Raises:** ValueError for a video, base or frames that do not fit, and numbers out of range.

    **Source:** linear Gaussian models; Woodbury's identity and Sylvester's for determinants; traces: Hutchinson 1990.
    """
    residuals = Residuals(model, video)
    num_frames = len(residuals.frames)
    _check(base, num_frames, prior_scale, most_dense, probes)
    chosen = _chosen(frames, num_frames)
    times = base.curves.modes()
    times[[0, -1]] = np.asarray(model.frame_times.times(), np.float64)[[0, -1]]
    equations = ColorEquations(residuals, base.noise, times, float(prior_scale))
    nodes, values = (list(each) for each in zip(*map(base.curves.nodes_and_values, range(num_frames)), strict=True))
    for done, k in enumerate(chosen):
        if equations.num <= most_dense:
            curve: _Dense | _Estimated = _Dense(equations, k)
        else:
            signs = np.random.default_rng([seed, k]).choice([-1.0, 1.0], size=(int(np.prod(model.size)), probes))
            curve = _Estimated(equations, k, signs)
        _draw(curve, nodes[k], values[k], *_between(times, k))
        nodes[k], values[k] = _joined(*curve.profile(), nodes[k], values[k])
        if on_frame is not None:
            on_frame(done + 1, len(chosen))
    return ProfileCurves.from_nodes(nodes, values)


def _check(base: LikelihoodProfiles, num_frames: int, prior_scale: float, most_dense: int, probes: int) -> None:
    if not isinstance(base, LikelihoodProfiles):
        raise invalid("base", expected="an Evidence", got=type(base).__name__, cure="Call evidence(model, video).")
    if base.curves.num_frames != num_frames:
        got, cure = f"one of {base.curves.num_frames}", "Call evidence with this video."
        raise invalid("base", expected=f"evidence of {num_frames} frames, as the video has", got=got, cure=cure)
    if not is_within(prior_scale, "(0, inf)"):
        cure = "Colours are about [0, 1]."
        raise invalid("prior_scale", expected="a number > 0", got=prior_scale, cure=cure)
    for name, value, least in (("most_dense", most_dense, 0), ("probes", probes, 1)):
        if not is_integer(value, least):
            raise invalid(name, expected=f"a whole number >= {least}", got=value)


def _chosen(frames: Sequence[int] | None, num_frames: int) -> list[int]:
    if frames is None:
        return list(range(1, num_frames - 1))
    chosen = list(frames)
    if not all(is_integer(k, 1) and k < num_frames - 1 for k in chosen) or len({*chosen}) < len(chosen):
        cure = "The first and the last frame's times are fixed."
        raise invalid("frames", expected=f"different frames from 1 to {num_frames - 2}", got=chosen, cure=cure)
    return [int(k) for k in chosen]


def _between(times: Float64[np.ndarray, " num_frames"], k: int) -> tuple[float, float]:
    """The neighbours' times, or the clip's ends where those are on the wrong side."""
    low, high = times[k - 1], times[k + 1]
    return (low if low < times[k] else 0.0), (high if high > times[k] else 1.0)


class _Curve:
    """A frame's log-likelihood at the times drawn so far, in their order."""

    def __init__(self, equations: ColorEquations, k: int):
        self.equations, self.k = equations, k
        self.times: list[float] = []
        self.points: list = []

    def draw(self, t: float) -> None:
        if t not in self.times:
            place = bisect.bisect(self.times, t)
            point = self.point(self.equations.at(self.k, t), place)
            self.times.insert(place, t)
            self.points.insert(place, point)

    def profile(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and log-likelihoods, the greatest 0."""
        values = self.values()
        return np.array(self.times), values - values.max()


class _Dense(_Curve):
    """Exact, by a Cholesky factor at every time."""

    def point(self, at: FrameAt, place: int) -> float:
        factor = scipy.linalg.cholesky(at.dense(), lower=True, overwrite_a=True, check_finite=False)
        whitened = scipy.linalg.solve_triangular(factor, at.rhs, lower=True, check_finite=False)
        left = (at.misses**2).sum() / at.variance - (whitened**2).sum()
        return -left / 2 - at.rhs.shape[1] * np.log(factor.diagonal()).sum()

    def values(self) -> np.ndarray:
        return np.array(self.points)


class _Point(NamedTuple):
    log_likelihood: float  # without the determinant
    solution: np.ndarray  # H^-1 of the right-hand sides, and of `seen`: (num, 3 + probes)
    seen: np.ndarray  # A^T z / s of the probes z: (num, probes)


class _Estimated(_Curve):
    """By conjugate gradients, and random probes of the determinant."""

    def __init__(self, equations: ColorEquations, k: int, signs: Float64[np.ndarray, "pixels probes"]):
        super().__init__(equations, k)
        self.signs = signs

    def point(self, at: FrameAt, place: int) -> _Point:
        seen = at.weights.T @ self.signs / np.sqrt(at.variance)
        rhs = np.concatenate([at.rhs, seen], axis=1)
        tolerance = np.where(np.arange(rhs.shape[1]) < at.rhs.shape[1], TOLERANCE, TRACE_TOLERANCE)
        start = self._guess(at.t, place, rhs)
        found = solve_conjugate_gradient(at.__matmul__, self.equations.precondition, rhs, start, tolerance)
        colours = found[:, : at.rhs.shape[1]]
        # A bound from below whose error is second order in the solution's, wherever solving began.
        explained = (colours * (2 * at.rhs - at @ colours)).sum()
        left = (at.misses**2).sum() / at.variance - explained
        return _Point(-left / 2, found, seen)

    def _guess(self, t: float, place: int, rhs: np.ndarray) -> np.ndarray:
        """From the solutions nearest in time, on the straight line through two."""
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
        skip = self.points[0].solution.shape[1] - self.signs.shape[1]
        rises = [
            ((after.seen - before.seen) * (after.solution + before.solution)[:, skip:]).sum() / self.signs.shape[1]
            for before, after in zip(self.points[:-1], self.points[1:], strict=True)
        ]
        log_det = np.concatenate([[0.0], np.cumsum(rises)])
        return np.array([each.log_likelihood for each in self.points]) - skip * log_det / 2


def _draw(curve: _Curve, base_nodes: np.ndarray, base_values: np.ndarray, low: float, high: float) -> None:
    """Draw a profile between `low` and `high`: as far as it matters, then in between."""
    best = int(np.argmax(base_values))
    mode, below = float(base_nodes[best]), base_values - base_values[best]
    left = _reached(base_nodes[best::-1], below[best::-1])
    right = _reached(base_nodes[best:], below[best:])
    for t in (mode, max(left, low), min(right, high)):
        curve.draw(t)
    for end, limit in ((0, low), (-1, high)):
        while curve.profile()[1][end] > -FALL and curve.times[end] != limit:
            times = curve.times
            step = max(abs(times[end] - mode), (times[-1] - times[0]) / 4)
            further = times[end] + (2 * end + 1) * -step
            curve.draw(max(further, low) if end == 0 else min(further, high))
    while len(curve.times) < MOST:
        times, values = curve.profile()
        matters = np.maximum(values[1:], values[:-1]) > -REACH
        steps = np.where(matters, np.minimum(np.abs(np.diff(values)), REACH), 0)
        steps[max(int(np.argmax(values)) - 1, 0) : int(np.argmax(values)) + 1] *= 2
        widest = int(np.argmax(steps))
        if steps[widest] <= STEP and len(times) >= 5:
            break
        if steps[widest] <= STEP:
            widest = int(np.argmax(np.diff(times)))
        curve.draw(float(times[widest] + times[widest + 1]) / 2)
    curve.draw(_vertex(*curve.profile()))


def _vertex(times: np.ndarray, values: np.ndarray) -> float:
    """Where the parabola through the greatest value and its neighbours is highest; half way where that is a node."""
    middle = int(np.clip(np.argmax(values), 1, len(times) - 2))
    (a, b, c), (left, top, right) = times[middle - 1 : middle + 2], values[middle - 1 : middle + 2]
    rise, fall = (top - left) / (b - a), (right - top) / (c - b)
    bend = (fall - rise) / (c - a)
    if bend < 0:
        t = float(np.clip((a + b) / 2 - rise / (2 * bend), a, c))
        if np.abs(times - t).min() > 1e-3 * (c - a):
            return t
    return float((a + b) / 2 if left > right else (b + c) / 2)


def _reached(times: np.ndarray, values: np.ndarray) -> float:
    """Where values, 0 at first, fall by REACH; or the last of `times`."""
    beyond = np.flatnonzero(values <= -REACH)
    if not beyond.size:
        return float(times[-1])
    n = beyond[0]
    fraction = (values[n - 1] + REACH) / (values[n - 1] - values[n])
    return float(times[n - 1] + fraction * (times[n] - times[n - 1]))


def _joined(
    times: np.ndarray, values: np.ndarray, base_nodes: np.ndarray, base_values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The profile with what the base has beyond it, on both sides."""
    base = ProfileCurves.from_nodes([base_nodes], [base_values])
    sides = []
    for end, inward in ((0, 1), (-1, -2)):
        spacing = abs(times[inward] - times[end])
        beyond = base_nodes < times[end] - spacing if end == 0 else base_nodes > times[end] + spacing
        if not beyond.any():  # at least the base's own end
            beyond[end] = base_nodes[end] < times[end] if end == 0 else base_nodes[end] > times[end]
        nodes = base_nodes[beyond]
        falls = float(base(times[[end]])[0]) - base_values[beyond]
        if len(nodes):
            first = -1 if end == 0 else 0
            steepness = max(values[inward] - values[end], 1.0) / spacing
            wanted = steepness * abs(nodes[first] - times[end])
            fraction = min(1.0, wanted / falls[first]) if falls[first] > 0 else 1.0
            sides.append((nodes, values[end] - np.maximum(fraction * falls, 0)))
        else:
            sides.append((nodes, falls))
    (before, low), (after, high) = sides
    return np.concatenate([before, times, after]), np.concatenate([low, values, high])
