"""A model as whole numbers: what a compact file holds, and the exact way back.

Each Gaussian is described by numbers that matter to the picture each on its own, in *columns*: its size and stretch
(mean and half difference of the logarithms of its standard deviations, the longer axis first), duration, opacity, time,
angle modulo half a turn, colour along fixed axes, and its path over the span of time in which it is seen, as Legendre
polynomials. A column's step follows from columns before it, by a rule that the file states, so Gaussians that are
hardly seen get coarse steps and need few bits. What a Gaussian has not got is in no column: powers of its path above
its own degree, times of one that lasts; and colours that many share are described once.

The way back uses additions, multiplications, divisions and comparisons of float64 alone, in a stated order: they are
rounded alike everywhere, so every decoder gives the same bits. See docs/format.md.
"""

import dataclasses
import functools
import math

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from foldgauss._runtime.checks import invalid
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.row_layout import shift_path
from foldgauss.video.models.splats import OPAQUE_LOGIT, STATIC_LOG_TIME_SCALE, TAU_MAX, FoldedSplats
from foldgauss.video.models.video_model import VideoModel

#: Above, sums of Legendre polynomials lose digits; no fit here goes beyond 7.
MAX_DEGREE = 15
#: Numbers of a column stay below this in size: what the coder takes.
LARGEST = 2**30 - 1
#: Columns that the steps of others may follow.
FEATURES = ("class", "size", "stretch", "duration", "opacity")
#: Columns of plain whole numbers: the cell of space and time, how much it shows, what it is without, its path's degree.
WHOLE = ("cell", "class", "without", "degree")
_FIRST = (*WHOLE, *FEATURES[1:], "time")
COLORS = ("luma", "blue", "green")
#: Columns that a bit of `without` says a Gaussian has no number in: the bit, the value that it has instead, and what
#: that counts as among the features (sigma_t = 1, the clip's length; an opacity of 0.98).
ABSENT = {
    "duration": (1, float(STATIC_LOG_TIME_SCALE), 0.0),
    "time": (1, 0.5, 0.0),
    "opacity": (2, float(OPAQUE_LOGIT), 4.0),
}
#: More shared colours than this are not told apart from colours of each one's own; cells have no more bits.
MOST_SHARED, MOST_CELL_BITS = 4096, 24
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
#: The squared error, in steps, that a path's last power must save: its two numbers need some eight bits, and where
#: steps are fine a bit saves 2 ln 2 / 12.
POWER_WORTH = 0.9
#: The farthest power of sqrt(2) that a step may be.
_FARTHEST = 120
#: Largest steps of time and angle (turns): a step keeps them where their logits are finite.
_WIDEST = {"time": 0.125, "angle": 0.125, "size": 0.35, "stretch": 0.5, "duration": 0.5, "opacity": 1.0}


def column_names(degree: int, shared: int = 0) -> tuple[str, ...]:
    """The columns of a model in their order; `shared` is the number of colours, if they are shared."""
    path = tuple(f"{axis}{k}" for k in range(degree + 1) for axis in "xy")
    return (*_FIRST, *path, "angle", *(("shade",) if shared else ()), *COLORS)


def power_of(name: str) -> int:
    """The power of a path's column; 0 for others."""
    return int(name[1:]) if name[0] in "xy" else 0


def is_whole(name: str) -> bool:
    """Whether a column's numbers are meant as they are: it has no rule."""
    return name in WHOLE or name == "shade"


@dataclasses.dataclass(frozen=True)
class Rule:
    """How a column's whole number q becomes a value: `origin + q step`.

        log2 step = floor(2 (exponent + sum_j slopes_j feature_j) + 1/2) / 2,

    the features (`FEATURES`) being columns decoded before, in their order.
    """

    origin: float
    exponent: float
    slopes: tuple[float, ...] = ()

    def halves(self, features: list[np.ndarray], num: int) -> Int32[np.ndarray, " num"]:
        """2 log2 step of every Gaussian, whole numbers."""
        total = np.full(num, self.exponent)
        for slope, feature in zip(self.slopes, features, strict=False):
            total = total + slope * feature
        return np.clip(np.floor(2 * total + 0.5), -_FARTHEST, _FARTHEST).astype(np.int32)


def steps_of(halves: Int32[np.ndarray, " num"], name: str = "") -> Float[np.ndarray, " num"]:
    """2^(halves / 2), exact but for one rounding, and no wider than a step of the column may be."""
    steps = np.ldexp(np.where(halves % 2, _SQRT2, 1.0), halves // 2)
    return np.minimum(steps, _WIDEST[name]) if name in _WIDEST else steps


@dataclasses.dataclass(frozen=True)
class Facts:
    """What all Gaussians share.

    `cells`: binary logarithms of the numbers of cells along x, y and time. `shared`: the number of colours, where
    Gaussians share them; 0 where each has its own.
    """

    num_gaussians: int
    degree: int
    cells: tuple[int, int, int]
    shared: int
    power: float
    floor: float
    reach: float
    size: tuple[int, int]
    fps: float
    options: RenderOptions
    compositing: str
    scale_cutoff: float


@dataclasses.dataclass(frozen=True)
class Quantized:
    """A model as whole numbers: equal numbers are equal models, to the bit."""

    facts: Facts
    rules: dict[str, Rule]
    columns: dict[str, Int32[np.ndarray, " num"]]
    intervals: Int32[np.ndarray, " intervals"]


# ------------------------------------------------------------------------------------------ the way back


class Unrolling:
    """Columns to values, one after another in their order: each step may follow the values before."""

    def __init__(self, rules: dict[str, Rule], facts: Facts):
        self._rules, self._facts = rules, facts
        self._features: list[np.ndarray] = []
        self.values: dict[str, np.ndarray] = {}

    def has(self, name: str) -> Bool[np.ndarray, "rows"]:
        """Who has a number in the column that comes next; the others' is 0."""
        if name in ABSENT:
            return (self.values["without"].astype(np.int32) & ABSENT[name][0]) == 0
        if power := power_of(name):
            return self.values["degree"] >= power
        return np.ones(self.rows(name), bool)

    def rows(self, name: str) -> int:
        return self._facts.shared if name in COLORS and self._facts.shared else self._facts.num_gaussians

    def halves(self, name: str) -> Int32[np.ndarray, "rows"]:
        """2 log2 step of the column that comes next."""
        if is_whole(name):
            return np.zeros(self.rows(name), np.int32)
        features = [] if name in COLORS and self._facts.shared else self._features
        return self._rules[name].halves(features, self.rows(name))

    def origin(self, name: str) -> Float[np.ndarray, "rows"]:
        """What numbers of the column that comes next count from: the middle of the cell, if that says."""
        axis = {"x0": 0, "y0": 1, "time": 2}.get(name)
        if axis is not None and self._facts.cells[axis]:
            return cell_middles(self.values["cell"].astype(np.int64), self._facts)[axis]
        return np.full(self.rows(name), 0.0 if is_whole(name) else self._rules[name].origin)

    def add(self, name: str, numbers: Int32[np.ndarray, "rows"], halves: Int32[np.ndarray, "rows"]) -> None:
        value = self.origin(name) + numbers * steps_of(halves, name)
        feature = value
        if name in ABSENT:
            _, instead, counts_as = ABSENT[name]
            value, feature = (np.where(self.has(name), value, other) for other in (instead, counts_as))
        if name in FEATURES:
            self._features.append(feature)
        if power_of(name):
            value = np.where(self.has(name), value, 0.0)
        self.values[name] = value


def values_of(quantized: Quantized) -> dict[str, Float[np.ndarray, " num"]]:
    """The values of all columns, of each Gaussian."""
    facts, unrolling = quantized.facts, Unrolling(quantized.rules, quantized.facts)
    for name in column_names(facts.degree, facts.shared):
        unrolling.add(name, quantized.columns[name], unrolling.halves(name))
    values = unrolling.values
    if facts.shared:
        values |= {name: values[name][quantized.columns["shade"]] for name in COLORS}
    return values


# ------------------------------------------------------------------------------------------ cells


def _sides(facts: Facts) -> tuple[float, float, float]:
    """Extent of the picture along x and y in model space, and of time."""
    height, width = facts.size
    longer = max(height, width)
    return width / longer, height / longer, 1.0


def cells_at(
    x: Float[np.ndarray, " num"], y: Float[np.ndarray, " num"], time: Float[np.ndarray, " num"], facts: Facts
) -> Int32[np.ndarray, " num"]:
    """Numbers of the cells that places lie in, or next to; bits of x, y and time in turns, the lowest first."""
    out, place = np.zeros(len(x), np.int64), 0
    along = []
    for value, middle, side, bits in zip((x, y, time), (0.0, 0.0, 0.5), _sides(facts), facts.cells, strict=True):
        index = np.floor(((value - middle) / side + 0.5) * 2**bits)
        along.append(np.clip(index, 0, 2**bits - 1).astype(np.int64))
    for k in range(max(facts.cells)):
        for index, bits in zip(along, facts.cells, strict=True):
            if k < bits:
                out |= ((index >> k) & 1) << place
                place += 1
    return out.astype(np.int32)


def cell_middles(cell: Int[np.ndarray, " num"], facts: Facts) -> list[Float[np.ndarray, " num"]]:
    """The middles of cells along x, y and time."""
    along, place = [np.zeros(len(cell), np.int64) for _ in range(3)], 0
    for k in range(max(facts.cells)):
        for axis, bits in enumerate(facts.cells):
            if k < bits:
                along[axis] |= ((cell >> place) & 1) << k
                place += 1
    out = []
    for index, middle, side, bits in zip(along, (0.0, 0.0, 0.5), _sides(facts), facts.cells, strict=True):
        out.append(middle + ((index + 0.5) / 2**bits - 0.5) * side)
    return out


def in_clip(time: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
    """m_t, or an angle in turns, held where its logit is finite."""
    return np.minimum(np.maximum(time, 2.0**-24), 1 - 2.0**-24)


def dequantize(quantized: Quantized) -> VideoModel:
    """The model, the same bits everywhere."""
    facts, v = quantized.facts, values_of(quantized)
    time = in_clip(v["time"])
    place = _monomials(v, time, facts)
    log_scale = np.stack([v["size"] + v["stretch"], v["size"] - v["stretch"]], 1)
    luma, blue, green = v["luma"], v["blue"], v["green"]
    color = np.stack([luma * AXES[0, c] + blue * AXES[1, c] + green * AXES[2, c] for c in range(3)], 1)

    def single(array: np.ndarray) -> np.ndarray:
        return array.astype(np.float32) + np.float32(0)  # no -0: what is absent is 0

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
    times = FrameTimes(single(quantized.intervals * TIME_STEP))
    shared = (facts.size, facts.fps, facts.options, facts.compositing, facts.scale_cutoff)
    return VideoModel(splats, times, *shared)


def _log(x: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
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


def _logit(x: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
    return _log(x) - _log(1 - x)


def span_of(
    time: Float[np.ndarray, " num"], duration: Float[np.ndarray, " num"], reach: float
) -> tuple[Float[np.ndarray, " num"], Float[np.ndarray, " num"]]:
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
    v: dict[str, np.ndarray], time: Float[np.ndarray, " num"], facts: Facts
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
    swapped: Bool[np.ndarray, " num"]
    turn: Float[np.ndarray, " num"]
    without: Int32[np.ndarray, " num"]
    shade: Int32[np.ndarray, " num"] | None
    values: dict[str, Float[np.ndarray, " num"]]
    place: Float[np.ndarray, "num degree+1 2"]
    logits: Float[np.ndarray, " intervals"]

    def has(self, name: str) -> Bool[np.ndarray, " num"]:
        """Who has a number in a column of one number each."""
        return (self.without & ABSENT.get(name, (0,))[0]) == 0


def describe(model: VideoModel) -> Described:
    """The values of every column but the path's, float64. Raises ValueError for what the format cannot hold."""
    facts = _facts_of(model)
    splats, shade = model.splats, shades(model)
    if shade is not None:
        facts = dataclasses.replace(facts, shared=int(shade.max()) + 1)

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
    own = swapped, turn, splats.static + 2 * splats.opaque.astype(np.int32), shade
    return Described(facts, *own, values, place, np.asarray(model.frame_times.logits, np.float64))


def shades(model: VideoModel) -> Int32[np.ndarray, " num"] | None:
    """The number of each Gaussian's colour among those that there are, dark ones first; None if few share one."""
    color = np.asarray(model.splats.color_dc, np.float64)
    found, index = np.unique(color, axis=0, return_inverse=True)
    if 2 * len(found) > len(color) or len(found) > MOST_SHARED:
        return None
    rank = np.empty(len(found), np.int32)
    rank[np.argsort(found @ AXES[0], kind="stable")] = np.arange(len(found))
    return rank[index.ravel()]


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
        cells=cells_for(model.num_gaussians, model.size),
        shared=0,
        power=power,
        floor=float(floor[0]),
        reach=reach,
        size=tuple(map(int, model.size)),
        fps=float(model.fps),
        options=model.options,
        compositing=model.compositing,
        scale_cutoff=float(model.scale_cutoff),
    )


def cells_for(num_gaussians: int, size: tuple[int, int]) -> tuple[int, int, int]:
    """Some eight Gaussians a cell; a quarter of the bits for time."""
    total = min(max(round(math.log2(num_gaussians / 8)), 0), MOST_CELL_BITS)
    of_time = total // 4
    fewer, more = (total - of_time) // 2, (total - of_time + 1) // 2
    height, width = size
    return (more, fewer, of_time) if width >= height else (fewer, more, of_time)


def path_matrix(
    time: Float[np.ndarray, " num"], duration: Float[np.ndarray, " num"], facts: Facts
) -> Float[np.ndarray, "num degree+1 degree+1"]:
    """M with (m_s, c_1, ..) = M (path's columns): by the way back, of unit vectors."""
    num, degree = len(time), facts.degree
    facts = dataclasses.replace(facts, num_gaussians=num)
    out = np.empty((num, degree + 1, degree + 1))
    for k in range(degree + 1):
        unit = {f"{axis}{j}": np.full(num, float(j == k)) for j in range(degree + 1) for axis in "xy"}
        out[:, :, k] = _monomials(unit | {"duration": duration}, time, facts)[:, :, 0]
    return out


def quantize(
    described: Described,
    classes: Int32[np.ndarray, " num"],
    rules: dict[str, Rule],
    cells: Int32[np.ndarray, " num"] | None = None,
) -> Quantized:
    """Round every column by its rule; each is rounded against what is decoded of those before it.

    `cells`: where to count places from (default: the cells that they are in).
    """
    facts = described.facts
    if cells is None:
        cells = cells_of(described)
    values = described.values | {"class": classes, "cell": cells, "without": described.without}
    if facts.shared:
        first = np.unique(described.shade, return_index=True)[1]
        values |= {name: values[name][first] for name in COLORS} | {"shade": described.shade}
    # The path comes first: its degree is that of what is left of it when it is rounded.
    names = column_names(facts.degree, facts.shared)
    whole = {"degree": np.full(facts.num_gaussians, facts.degree, np.int32)}
    columns, saved = _rounded(names, values | whole, described, rules)
    columns["degree"] = degrees = _degrees(saved)
    for k in range(1, facts.degree + 1):
        for axis in "xy":
            columns[f"{axis}{k}"] = np.where(degrees >= k, columns[f"{axis}{k}"], 0).astype(np.int32)
    logits = described.logits - described.logits.max(initial=-np.inf)
    return Quantized(facts, rules, columns, np.rint(np.maximum(logits, -1e5) / TIME_STEP).astype(np.int32))


def cells_of(described: Described) -> Int32[np.ndarray, " num"]:
    """The cells that Gaussians are in, by the middles of their paths."""
    values = described.values
    path = _paths(described, values)
    return cells_at(path["x0"], path["y0"], in_clip(values["time"]), described.facts)


def _degrees(saved: Float[np.ndarray, "degree+1 num"]) -> Int32[np.ndarray, " num"]:
    """The last power that is worth its bits; `saved` is the squared error that each one saves, in steps."""
    worth = np.arange(len(saved), dtype=np.int32)[:, None] * (saved > POWER_WORTH)
    return worth.max(axis=0, initial=0).astype(np.int32)


def lower_paths(quantized: Quantized, described: Described) -> Float[np.ndarray, "num degree+1 2"]:
    """Paths not rounded, seen from the times that a decoder has, as powers of u; of the degrees that are stored."""
    facts, values = quantized.facts, values_of(quantized)
    path = _paths(described, values)
    place = np.stack([np.stack([path[f"{axis}{k}"] for axis in "xy"], 1) for k in range(facts.degree + 1)], 1)
    place[np.arange(facts.degree + 1) > quantized.columns["degree"][:, None]] = 0
    return path_matrix(in_clip(values["time"]), values["duration"], facts) @ place


def _rounded(
    names: tuple[str, ...], values: dict[str, np.ndarray], described: Described, rules: dict[str, Rule]
) -> tuple[dict[str, Int32[np.ndarray, " rows"]], Float[np.ndarray, "degree+1 num"]]:
    """The numbers of all columns; and the squared error, in steps, that the path's powers save."""
    unrolling, columns = Unrolling(rules, described.facts), {}
    saved = np.zeros((described.facts.degree + 1, described.facts.num_gaussians))
    for name in names:
        if name == "x0":
            values = values | _paths(described, unrolling.values)
        halves = unrolling.halves(name)
        origin, steps = unrolling.origin(name), steps_of(halves, name)
        exact = np.where(unrolling.has(name), (values[name] - origin) / steps, 0)
        numbers = np.rint(exact)
        if name == "angle":  # held within its half turn, so that what is decoded is rounded to itself
            low, high = (np.ceil((end - origin) / steps) for end in (0.25, 0.75))
            numbers = np.minimum(np.maximum(numbers, low), high - 1)
        if not (np.abs(numbers) <= LARGEST).all():
            worst = int(np.argmax(~(np.abs(numbers) <= LARGEST)))
            got = f"{name} {values[name][worst]:g} of Gaussian {worst}"
            raise invalid("model", expected="numbers within the reach of their steps", got=got, cure="Remove it first.")
        columns[name] = numbers.astype(np.int32)
        unrolling.add(name, columns[name], halves)
        if power_of(name):
            saved[power_of(name)] += exact**2 - (exact - numbers) ** 2
    return columns, saved


def _paths(described: Described, decoded: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The path's columns: the same path in time, seen from the time and over the span that the decoder will have."""
    time = in_clip(decoded["time"])
    place = shift_path(described.place, time - described.values["time"])
    matrix = path_matrix(time, decoded["duration"], described.facts)
    size = np.abs(matrix).max(2, keepdims=True)  # rows of very different size: c_k has a power of time in it
    path = np.linalg.solve(matrix / size, place / size)
    return {f"{axis}{k}": path[:, k, a] for k in range(path.shape[1]) for a, axis in enumerate("xy")}
