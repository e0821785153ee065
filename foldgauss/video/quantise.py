"""A model as whole numbers: what a compact file holds, and the exact way back.

Each Gaussian is described by numbers that matter to the picture each on its own, in *columns*: its size and stretch
(mean and half difference of the logarithms of its standard deviations, the longer axis first), duration, opacity, time,
angle modulo half a turn, colour along fixed axes, and its path over the span of time in which it is seen, as Legendre
polynomials. A column's step follows from columns before it, by a rule that the file states, so Gaussians that are
hardly seen get coarse steps and need few bits.

The way back uses additions, multiplications, divisions and comparisons of float64 alone, in a stated order: they are
rounded alike everywhere, so every decoder gives the same bits. See docs/format.md.
"""

import dataclasses
import functools
import math

import numpy as np
from jaxtyping import Bool, Float, Int32

from foldgauss._checks import invalid
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video.frame_times import FrameTimes
from foldgauss.video.model import TAU_MAX, FoldedSplats, VideoModel

#: Above, sums of Legendre polynomials lose digits; no fit here goes beyond 7.
MAX_DEGREE = 15
#: Numbers of a column stay below this in size: what the coder takes.
LARGEST = 2**30 - 1
#: Columns that the steps of others may follow.
FEATURES = ("class", "size", "stretch", "duration", "opacity")
_FIRST = (*FEATURES, "time", "angle", "luma", "blue", "green")
#: Orthonormal axes of colour, rows: brightness, blue against red, green against both.
AXES = np.array(
    [
        [0.5773502691896258, 0.5773502691896258, 0.5773502691896258],
        [-0.7071067811865476, 0.0, 0.7071067811865476],
        [-0.4082482904638630, 0.8164965809277261, -0.4082482904638630],
    ]
)
_LN2, _SQRT2 = 0.6931471805599453, 1.4142135623730951
#: Steps of frame times' weights: a thousandth of an interval.
TIME_STEP = 2.0**-10
#: The farthest power of sqrt(2) that a step may be.
_FARTHEST = 120
#: Largest steps of time and angle (turns): a step keeps them where their logits are finite.
_WIDEST = {"time": 0.125, "angle": 0.125, "size": 0.35, "stretch": 0.5, "duration": 0.5, "opacity": 1.0}


def column_names(degree: int) -> tuple[str, ...]:
    """The columns of a model in their order."""
    return _FIRST + tuple(f"{axis}{k}" for k in range(degree + 1) for axis in "xy")


@dataclasses.dataclass(frozen=True)
class Rule:
    """How a column's whole number q becomes a value: `origin + q step`.

        log2 step = floor(2 (exponent + sum_j slopes_j feature_j) + 1/2) / 2,

    the features (`FEATURES`) being columns decoded before, in their order.
    """

    origin: float
    exponent: float
    slopes: tuple[float, ...] = ()

    def halves(self, features: list[np.ndarray], num: int) -> Int32[np.ndarray, "num"]:
        """2 log2 step of every Gaussian, whole numbers."""
        total = np.full(num, self.exponent)
        for slope, feature in zip(self.slopes, features, strict=False):
            total = total + slope * feature
        return np.clip(np.floor(2 * total + 0.5), -_FARTHEST, _FARTHEST).astype(np.int32)


def steps_of(halves: Int32[np.ndarray, "num"], name: str = "") -> Float[np.ndarray, "num"]:
    """2^(halves / 2), exact but for one rounding, and no wider than a step of the column may be."""
    steps = np.ldexp(np.where(halves % 2, _SQRT2, 1.0), halves // 2)
    return np.minimum(steps, _WIDEST[name]) if name in _WIDEST else steps


@dataclasses.dataclass(frozen=True)
class Facts:
    """What all Gaussians share."""

    num_gaussians: int
    degree: int
    power: float
    floor: float
    reach: float
    size: tuple[int, int]
    fps: float
    options: RenderOptions
    compositing: str
    scale_cutoff: float


@dataclasses.dataclass(frozen=True)
class Quantised:
    """A model as whole numbers: equal numbers are equal models, to the bit."""

    facts: Facts
    rules: dict[str, Rule]
    columns: dict[str, Int32[np.ndarray, "num"]]
    intervals: Int32[np.ndarray, "intervals"]


# ------------------------------------------------------------------------------------------ the way back


class Unrolling:
    """Columns to values, one after another in their order: each step may follow the values before."""

    def __init__(self, rules: dict[str, Rule], num: int):
        self._rules, self._num = rules, num
        self._features: list[np.ndarray] = []
        self.values: dict[str, np.ndarray] = {}

    def halves(self, name: str) -> Int32[np.ndarray, "num"]:
        """2 log2 step of the column that comes next."""
        return self._rules[name].halves(self._features, self._num)

    def add(self, name: str, numbers: Int32[np.ndarray, "num"], halves: Int32[np.ndarray, "num"]) -> None:
        self.values[name] = self._rules[name].origin + numbers * steps_of(halves, name)
        if name in FEATURES:
            self._features.append(self.values[name])


def values_of(quantised: Quantised) -> dict[str, Float[np.ndarray, "num"]]:
    """The values of all columns."""
    unrolling = Unrolling(quantised.rules, quantised.facts.num_gaussians)
    for name in column_names(quantised.facts.degree):
        unrolling.add(name, quantised.columns[name], unrolling.halves(name))
    return unrolling.values


def in_clip(time: Float[np.ndarray, "num"]) -> Float[np.ndarray, "num"]:
    """m_t, or an angle in turns, held where its logit is finite."""
    return np.minimum(np.maximum(time, 2.0**-24), 1 - 2.0**-24)


def dequantise(quantised: Quantised) -> VideoModel:
    """The model, the same bits everywhere."""
    facts, v = quantised.facts, values_of(quantised)
    time = in_clip(v["time"])
    place = _monomials(v, time, facts)
    log_scale = np.stack([v["size"] + v["stretch"], v["size"] - v["stretch"]], 1)
    luma, blue, green = v["luma"], v["blue"], v["green"]
    color = np.stack([luma * AXES[0, c] + blue * AXES[1, c] + green * AXES[2, c] for c in range(3)], 1)

    def single(array: np.ndarray) -> np.ndarray:
        return array.astype(np.float32)

    splats = FoldedSplats(
        loc=single(place[:, 0]),
        log_scale=single(log_scale),
        angle_logit=single(_logit(in_clip(v["angle"]))),
        time_loc_logit=single(_logit(time)),
        log_time_scale=single(v["duration"]),
        coefficients=single(place[:, 1:]),
        opacity_logit=single(v["opacity"]),
        color_dc=single(color),
        envelope=TimeLikelihood(np.float32(facts.power), np.float32(facts.floor)),
    )
    times = FrameTimes(single(quantised.intervals * TIME_STEP))
    shared = (facts.size, facts.fps, facts.options, facts.compositing, facts.scale_cutoff)
    return VideoModel(splats, times, *shared)


def _log(x: Float[np.ndarray, "num"]) -> Float[np.ndarray, "num"]:
    """Natural logarithm by elementary operations alone, to 1e-13: libraries' differ in the last bit."""
    m, e = np.frexp(x)
    small = m < 0.7071067811865476
    m, e = np.where(small, 2 * m, m), np.where(small, e - 1, e)
    s = (m - 1) / (m + 1)
    z = s * s
    total = np.zeros_like(z)
    for k in range(17, 0, -2):
        total = total * z + 1 / k
    return e * _LN2 + 2 * s * total


def _logit(x: Float[np.ndarray, "num"]) -> Float[np.ndarray, "num"]:
    return _log(x) - _log(1 - x)


def span_of(
    time: Float[np.ndarray, "num"], duration: Float[np.ndarray, "num"], reach: float
) -> tuple[Float[np.ndarray, "num"], Float[np.ndarray, "num"]]:
    """Middle and half-width of the span of time over which a path is described: `reach` durations, within the clip.

    sigma_t is rounded to a power of sqrt(2), which needs no exponential.
    """
    halves = np.clip(np.floor(2 * (duration * (1 / _LN2)) + 0.5), -_FARTHEST, _FARTHEST).astype(np.int32)
    wide = reach * steps_of(halves)
    first, last = np.maximum(time - wide, 0.0), np.minimum(time + wide, 1.0)
    return (first + last) * 0.5, np.maximum((last - first) * 0.5, 2.0**-40)


@functools.cache
def legendre(degree: int) -> Float[np.ndarray, "degree+1 degree+1"]:
    """Coefficients of the Legendre polynomials: row k is P_k in powers of its argument. Dyadic numbers, exact."""
    rows = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        for j in range(k // 2 + 1):
            numerator = (-1) ** j * math.comb(k, j) * math.comb(2 * k - 2 * j, k)
            rows[k, k - 2 * j] = numerator / 2**k
    return rows


def _monomials(
    v: dict[str, np.ndarray], time: Float[np.ndarray, "num"], facts: Facts
) -> Float[np.ndarray, "num degree+1 2"]:
    """Paths in powers of u = m_t - t: row 0 is m_s, row k is c_k."""
    degree, table = facts.degree, legendre(facts.degree)
    middle, half = span_of(time, v["duration"], facts.reach)
    out = np.empty((facts.num_gaussians, degree + 1, 2))
    at, scale = (time - middle) / half, -1.0 / half
    for axis in range(2):
        powers = []  # of w = (t - middle) / half
        for j in range(degree + 1):
            total = np.zeros(facts.num_gaussians)
            for k in range(j, degree + 1, 2):
                total = total + table[k, j] * v[f"{'xy'[axis]}{k}"]
            powers.append(total)
        # w = at + scale u: Horner's shift, then the scale.
        for j in range(degree):
            for k in range(degree - 1, j - 1, -1):
                powers[k] = powers[k] + at * powers[k + 1]
        factor = np.ones(facts.num_gaussians)
        for k in range(degree + 1):
            out[:, k, axis] = powers[k] * factor
            factor = factor * scale
    return out


# ------------------------------------------------------------------------------------------ the way there


@dataclasses.dataclass(frozen=True)
class Described:
    """A model's Gaussians by the values of columns, before they are rounded; the path as powers of u until then."""

    facts: Facts
    swapped: Bool[np.ndarray, "num"]
    turn: Float[np.ndarray, "num"]
    values: dict[str, Float[np.ndarray, "num"]]
    place: Float[np.ndarray, "num degree+1 2"]
    logits: Float[np.ndarray, "intervals"]


def describe(model: VideoModel) -> Described:
    """The values of every column but the path's, float64. Raises ValueError for what the format cannot hold."""
    facts = _facts_of(model)
    splats = model.splats

    def leaf(name: str) -> np.ndarray:
        return np.asarray(getattr(splats, name), np.float64)

    first, second = leaf("log_scale").T
    swapped = first < second
    turn = _sigmoid(leaf("angle_logit"))
    values = {
        "size": (first + second) / 2,
        "stretch": np.abs(first - second) / 2,
        "duration": leaf("log_time_scale"),
        "opacity": leaf("opacity_logit"),
        "time": _sigmoid(leaf("time_loc_logit")),
        "angle": (turn + np.where(swapped, 0.0, -0.25)) % 0.5 + 0.25,
    }
    values |= dict(zip(("luma", "blue", "green"), (leaf("color_dc") @ AXES.T).T, strict=True))
    place = np.concatenate([leaf("loc")[:, None], leaf("coefficients")], 1)
    return Described(facts, swapped, turn, values, place, np.asarray(model.frame_times.logits, np.float64))


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(0.5 * x))


def _facts_of(model: VideoModel) -> Facts:
    power, floor = (np.unique(np.asarray(getattr(model.splats.envelope, name))) for name in ("power", "floor"))
    if power.size != 1 or floor.size != 1:
        cure = "Save it as .safetensors, which holds an envelope of each Gaussian's own."
        raise invalid("model.splats.envelope", expected="one for all Gaussians", got="several", cure=cure)
    if model.degree > MAX_DEGREE:
        raise invalid("model.degree", expected=f"at most {MAX_DEGREE}", got=model.degree, cure="Save as .safetensors.")
    if model.num_gaussians < 1:
        raise invalid("model", expected="at least one Gaussian", got="none")
    # Where a path matters: the area of a Gaussian is about exp(-power tau^2 / 2), of deviation 1 / sqrt(power);
    # an even weight of the same deviation reaches sqrt(3) times as far. Twice that was measured to need the fewest bits
    # (Bunny, 160x320: 1.0 times 527 kB, 1.6 516, 2.0 509, 2.4 510): what is small may still be seen.
    power = float(power[0])
    reach = min(TAU_MAX, math.sqrt(12 / max(power, 0.1)))
    return Facts(
        num_gaussians=model.num_gaussians,
        degree=model.degree,
        power=power,
        floor=float(floor[0]),
        reach=reach,
        size=tuple(map(int, model.size)),
        fps=float(model.fps),
        options=model.options,
        compositing=model.compositing,
        scale_cutoff=float(model.scale_cutoff),
    )


def path_matrix(
    time: Float[np.ndarray, "num"], duration: Float[np.ndarray, "num"], facts: Facts
) -> Float[np.ndarray, "num degree+1 degree+1"]:
    """M with (m_s, c_1, ..) = M (path's columns): by the way back, of unit vectors."""
    num, degree = len(time), facts.degree
    facts = dataclasses.replace(facts, num_gaussians=num)
    out = np.empty((num, degree + 1, degree + 1))
    for k in range(degree + 1):
        unit = {f"{axis}{j}": np.full(num, float(j == k)) for j in range(degree + 1) for axis in "xy"}
        out[:, :, k] = _monomials(unit | {"duration": duration}, time, facts)[:, :, 0]
    return out


def moved_to(
    place: Float[np.ndarray, "num degree+1 2"], shift: Float[np.ndarray, "num"]
) -> Float[np.ndarray, "num degree+1 2"]:
    """The same path in powers of u + shift: its Gaussian's m_t is later by `shift`."""
    place, degree = place.copy(), place.shape[1] - 1
    for j in range(degree):
        for k in range(degree - 1, j - 1, -1):
            place[:, k] -= shift[:, None] * place[:, k + 1]
    return place


def quantise(described: Described, classes: Int32[np.ndarray, "num"], rules: dict[str, Rule]) -> Quantised:
    """Round every column by its rule; each is rounded against what is decoded of those before it."""
    facts, columns = described.facts, {}
    unrolling = Unrolling(rules, facts.num_gaussians)
    values = described.values | {"class": classes.astype(np.float64)}
    for name in column_names(facts.degree):
        if name == "x0":
            values |= _paths(described, unrolling.values)
        halves = unrolling.halves(name)
        numbers = (values[name] - rules[name].origin) / steps_of(halves, name)
        numbers = np.rint(numbers)
        if name == "angle":  # held within its half turn, so that what is decoded is rounded to itself
            low, high = (np.ceil((end - rules[name].origin) / steps_of(halves, name)) for end in (0.25, 0.75))
            numbers = np.minimum(np.maximum(numbers, low), high - 1)
        if not (np.abs(numbers) <= LARGEST).all():
            worst = int(np.argmax(~(np.abs(numbers) <= LARGEST)))
            got = f"{name} {values[name][worst]:g} of Gaussian {worst}"
            raise invalid("model", expected="numbers within the reach of their steps", got=got, cure="Remove it first.")
        columns[name] = numbers.astype(np.int32)
        unrolling.add(name, columns[name], halves)
    logits = described.logits - described.logits.max(initial=-np.inf)
    return Quantised(facts, rules, columns, np.rint(np.maximum(logits, -1e5) / TIME_STEP).astype(np.int32))


def _paths(described: Described, decoded: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The path's columns: the same path in time, seen from the time and over the span that the decoder will have."""
    time = in_clip(decoded["time"])
    place = moved_to(described.place, time - described.values["time"])
    matrix = path_matrix(time, decoded["duration"], described.facts)
    size = np.abs(matrix).max(2, keepdims=True)  # rows of very different size: c_k has a power of time in it
    path = np.linalg.solve(matrix / size, place / size)
    return {f"{axis}{k}": path[:, k, a] for k in range(path.shape[1]) for a, axis in enumerate("xy")}
