"""Quantization of a model to integers, the content of a compact file, and the exact way back.

Each Gaussian is described by *columns*, parameters whose errors affect the image independently: size and stretch (mean
and half difference of the logarithms of its standard deviations, the longer axis first), duration, opacity, time, angle
modulo half a turn, color along fixed axes, and its trajectory, m_s + f(m_t - t), over the span of time in which it is
visible, as Legendre polynomials. A column's step follows from earlier columns by a rule stated in the file, so that
Gaussians that are hardly visible get coarse steps and need few bits. Powers above a trajectory's own degree are not
stored.

A model with shared paths (`SharedPaths`) has a column of their numbers; their maps are rounded in steps of model space
too fine to be seen.

Decoding uses only additions, multiplications, divisions and comparisons of float64, in a stated order. They are rounded
alike everywhere, so every decoder returns the same bits. See docs/format.md.
"""

import dataclasses
import functools
import math

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from foldgauss._numerics.regression import shift_polynomial
from foldgauss._runtime.checks import require
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.row_layout import MAX_DEGREE
from foldgauss.video.models.shared_paths import SharedPaths, check_paths
from foldgauss.video.models.splats import TAU_MAX, FoldedSplats
from foldgauss.video.models.video_model import VideoModel

#: Largest absolute value of a column's integers that the range coder accepts.
LARGEST = 2**30 - 1
#: Columns from which the steps of others may be computed.
FEATURES = ("class", "size", "stretch", "duration", "opacity")
#: Columns of plain integers: the cell of space and time, the class (how visible), the degree of the trajectory.
#: So is `path`, the number of the shared path.
INTEGER_COLUMNS = ("cell", "class", "degree")
COLORS = ("luma", "blue", "green")
#: Most bits of a cell.
MAX_CELL_BITS = 24
#: Most chunks of a model: to decode a chunk takes milliseconds, even one of a single Gaussian.
MAX_CHUNKS = 1024
#: Orthonormal color axes, as rows: brightness, blue against red, green against both.
AXES = np.array(
    [
        [0.5773502691896258, 0.5773502691896258, 0.5773502691896258],
        [-0.7071067811865476, 0.0, 0.7071067811865476],
        [-0.4082482904638630, 0.8164965809277261, -0.4082482904638630],
    ]
)
_LN2 = 0.6931471805599453
_SQRT2 = 1.4142135623730951
#: Least squared error, in steps, that the last power of a trajectory must save: its two coefficients need some eight
#: bits, and with fine steps a bit saves 2 ln 2 / 12.
POWER_WORTH = 0.9
#: Largest absolute exponent of sqrt(2) of a step.
_MAX_EXPONENT = 120
#: The exponent of sqrt(2) of the finest step, which float32 tells apart at 1: finer ones would leave less range.
FINEST_STEP = -48
#: The half turn of angles begins here, in turns: below a quarter, which float32 may decode to a little less.
_FIRST_ANGLE = 0.25 - 1e-6
#: Largest steps; those of time and angle (turns) keep their logits finite.
_MAX_STEP = {"time": 0.125, "angle": 0.125, "size": 0.35, "stretch": 0.5, "duration": 0.5, "opacity": 1.0}
#: Frame times are rounded to a fraction of 2^-TIME_BITS of each interval,
TIME_BITS = 10
#: or finer, with at most so many bits,
MAX_TIME_BITS = 24
#: so that no frame moves by more than this fraction of the median interval: the interval of a cut is some hundred
#: frames long.
TIME_ERROR = 0.005
#: Displacement by which rounding the maps may move Gaussians, in pixels of the model's size.
PATH_ERROR = 0.02
#: The most bits after the binary point that maps have.
MAX_PATH_BITS = 28
#: The step of the times of maps if these are not the frames'.
KNOT_STEP = 2.0**-24
#: Fraction of Gaussians on either side that may be outside of the cells.
_OUTSIDE = 0.005
#: The least extent of the cells.
_MIN_SIDE = 0.01


def column_names(degree: int, num_paths: int = 0) -> tuple[str, ...]:
    """The columns of a model in order."""
    trajectory = tuple(f"{axis}{k}" for k in range(degree + 1) for axis in "xy")
    path = ("path",) if num_paths else ()
    return (*INTEGER_COLUMNS, *path, *FEATURES[1:], "time", *trajectory, "angle", *COLORS)


def trajectory_power(name: str) -> int:
    """The power of a column of the trajectory; 0 for other columns."""
    return int(name[1:]) if name[0] in "xy" else 0


def is_integral(name: str) -> bool:
    """Whether a column holds plain integers, without a rule."""
    return name in (*INTEGER_COLUMNS, "path")


@dataclasses.dataclass(frozen=True)
class Rule:
    """Maps a column's integer q to the value `origin + q step`.

        log2 step = floor(2 (exponent + sum_j slopes_j feature_j) + 1/2) / 2,

    where the features are the columns `FEATURES` decoded before, in order.
    """

    origin: float
    exponent: float
    slopes: tuple[float, ...] = ()

    def half_exponents(self, features: list[np.ndarray], num: int) -> Int32[np.ndarray, " num"]:
        """2 log2 step of every Gaussian, an integer."""
        total = np.full(num, self.exponent)
        for slope, feature in zip(self.slopes, features, strict=False):
            total = total + slope * feature
        return np.clip(np.floor(2 * total + 0.5), FINEST_STEP, _MAX_EXPONENT).astype(np.int32)


def compute_steps(halves: Int32[np.ndarray, " num"], name: str = "") -> Float[np.ndarray, " num"]:
    """2^(halves / 2), with at most one rounding, limited to the column's largest step."""
    steps = np.ldexp(np.where(halves % 2, _SQRT2, 1.0), halves // 2)
    return np.minimum(steps, _MAX_STEP[name]) if name in _MAX_STEP else steps


@dataclasses.dataclass(frozen=True)
class PathsInfo:
    """Constants of shared paths, stored in the header.

    `at_frames`: knots are at the times of the frames, and not stored. `bits`: maps are in steps of 2^-bits.
    `middle`, `sides`: the rectangle that cells divide instead of the frame, since positions on a path may be outside.
    """

    num_paths: int
    num_knots: int
    at_frames: bool
    bits: int
    middle: tuple[float, float]
    sides: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class CompactInfo:
    """Constants of the model, stored in the header.

    `reach`: half-width of a trajectory's span of time, in sigma_t. The step of the frame times' logits is
    2^-`time_bits`.
    """

    degree: int
    power: float
    floor: float
    reach: float
    size: tuple[int, int]
    fps: float
    options: RenderOptions
    compositing: str
    scale_cutoff: float
    time_bits: int
    paths: PathsInfo | None = None

    @property
    def time_step(self) -> float:
        return 2.0**-self.time_bits

    @property
    def column_names(self) -> tuple[str, ...]:
        return column_names(self.degree, 0 if self.paths is None else self.paths.num_paths)


@dataclasses.dataclass(frozen=True)
class Chunk:
    """Some of a model's Gaussians, which are decoded by themselves.

    `cells`: binary logarithms of the numbers of cells along x, y and time.
    """

    cells: tuple[int, int, int]
    columns: dict[str, Int32[np.ndarray, " num"]]

    @property
    def num(self) -> int:
        return len(self.columns["class"])


@dataclasses.dataclass(frozen=True)
class Quantized:
    """A model as integers: equal integers are equal models, to the bit.

    `chunks` are in the order of the file, from back to front. `maps` are those of shared paths. `knots` are the times
    of the maps, unless these are at the frames.
    """

    info: CompactInfo
    rules: dict[str, Rule]
    chunks: tuple[Chunk, ...]
    intervals: Int32[np.ndarray, " intervals"]
    maps: Int32[np.ndarray, "paths knots 2 3"] | None = None
    knots: Int32[np.ndarray, "paths knots"] | None = None

    @property
    def num_gaussians(self) -> int:
        return sum(chunk.num for chunk in self.chunks)

    @property
    def columns(self) -> dict[str, Int32[np.ndarray, " num"]]:
        """The integers of all Gaussians, in the order of the model."""
        parts = [chunk.columns for chunk in reversed(self.chunks)]
        return {name: np.concatenate([part[name] for part in parts]) for name in self.info.column_names}


# ------------------------------------------------------------------------------------------ decoding


class ColumnDecoder:
    """Decodes a chunk's columns one after another, in order: a column's steps may depend on the values before."""

    def __init__(self, rules: dict[str, Rule], info: CompactInfo, cells: tuple[int, int, int], num: int):
        self._rules, self._info, self._cells, self._num = rules, info, cells, num
        self._features: list[np.ndarray] = []
        self.values: dict[str, np.ndarray] = {}

    def has(self, name: str) -> Bool[np.ndarray, " num"]:
        """Which Gaussians have a value in the next column; the others' integer is 0."""
        if power := trajectory_power(name):
            return self.values["degree"] >= power
        return np.ones(self._num, bool)

    def half_exponents(self, name: str) -> Int32[np.ndarray, " num"]:
        """2 log2 step of the next column."""
        if is_integral(name):
            return np.zeros(self._num, np.int32)
        return self._rules[name].half_exponents(self._features, self._num)

    def origin(self, name: str, steps: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
        """Values of integer 0 in the next column: the cell's center, if cells divide that axis.

        The center is rounded to a multiple of the step, so that values that are rounded already stay what they are,
        whichever cell they are in.
        """
        axis = {"x0": 0, "y0": 1, "time": 2}.get(name)
        if axis is not None and self._cells[axis]:
            center = cell_centers(self.values["cell"].astype(np.int64), self._info, self._cells)[axis]
            return np.floor(center / steps + 0.5) * steps
        return np.full(self._num, 0.0 if is_integral(name) else self._rules[name].origin)

    def add(self, name: str, numbers: Int32[np.ndarray, " num"], halves: Int32[np.ndarray, " num"]) -> None:
        steps = compute_steps(halves, name)
        value = self.origin(name, steps) + numbers * steps
        if name in FEATURES:
            self._features.append(value)
        if trajectory_power(name):
            value = np.where(self.has(name), value, 0.0)
        self.values[name] = value


def decode_values(quantized: Quantized) -> dict[str, Float[np.ndarray, " num"]]:
    """The values of all columns, for each Gaussian in the order of the model."""
    info, parts = quantized.info, []
    for chunk in reversed(quantized.chunks):
        decoder = ColumnDecoder(quantized.rules, info, chunk.cells, chunk.num)
        for name in info.column_names:
            decoder.add(name, chunk.columns[name], decoder.half_exponents(name))
        parts.append(decoder.values)
    return {name: np.concatenate([part[name] for part in parts]) for name in info.column_names}


# ------------------------------------------------------------------------------------------ cells


def _extents(info: CompactInfo) -> tuple[tuple[float, float], ...]:
    """Middle and side of what the cells divide along x, y and time: the image, or the rectangle of `PathsInfo`."""
    height, width = info.size
    longer = max(height, width)
    middle, sides = (0.0, 0.0), (width / longer, height / longer)
    if info.paths is not None:
        middle, sides = info.paths.middle, info.paths.sides
    return (*zip(middle, sides, strict=True), (0.5, 1.0))


def locate_cells(
    x: Float[np.ndarray, " num"],
    y: Float[np.ndarray, " num"],
    time: Float[np.ndarray, " num"],
    info: CompactInfo,
    cells: tuple[int, int, int],
) -> Int32[np.ndarray, " num"]:
    """Indices of the cells of these positions or of the nearest ones: bits of x, y, time in turns, lowest first."""
    out, bit = np.zeros(len(x), np.int64), 0
    along = []
    for value, (middle, side), bits in zip((x, y, time), _extents(info), cells, strict=True):
        index = np.floor(((value - middle) / side + 0.5) * 2**bits)
        along.append(np.clip(index, 0, 2**bits - 1).astype(np.int64))
    for k in range(max(cells)):
        for index, bits in zip(along, cells, strict=True):
            if k < bits:
                out |= ((index >> k) & 1) << bit
                bit += 1
    return out.astype(np.int32)


def cell_centers(
    cell: Int[np.ndarray, " num"], info: CompactInfo, cells: tuple[int, int, int]
) -> list[Float[np.ndarray, " num"]]:
    """The centers of cells along x, y and time."""
    along, bit = [np.zeros(len(cell), np.int64) for _ in range(3)], 0
    for k in range(max(cells)):
        for axis, bits in enumerate(cells):
            if k < bits:
                along[axis] |= ((cell >> bit) & 1) << k
                bit += 1
    out = []
    for index, (middle, side), bits in zip(along, _extents(info), cells, strict=True):
        out.append(middle + ((index + 0.5) / 2**bits - 0.5) * side)
    return out


def clamp_unit(time: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
    """m_t, or an angle in turns, clipped to where its logit is finite."""
    return np.minimum(np.maximum(time, 2.0**-24), 1 - 2.0**-24)


def dequantize(quantized: Quantized) -> VideoModel:
    """The decoded model, the same bits everywhere."""
    info, v = quantized.info, decode_values(quantized)
    time = clamp_unit(v["time"])
    polynomials = _monomials(v, time, info)
    log_scale = np.stack([v["size"] + v["stretch"], v["size"] - v["stretch"]], 1)
    luma, blue, green = v["luma"], v["blue"], v["green"]
    color = np.stack([luma * AXES[0, c] + blue * AXES[1, c] + green * AXES[2, c] for c in range(3)], 1)

    def single(array: np.ndarray) -> np.ndarray:
        return array.astype(np.float32) + np.float32(0)  # +0 instead of -0

    splats = FoldedSplats(
        loc=single(polynomials[:, 0]),
        log_scale=single(log_scale),
        angle_logit=single(_logit(clamp_unit(v["angle"]))),
        time_loc_logit=single(_logit(time)),
        log_time_scale=single(v["duration"]),
        coefficients=single(polynomials[:, 1:]),
        opacity_logit=single(v["opacity"]),
        color_dc=single(color),
        envelope=TimeLikelihood(np.float32(info.power), np.float32(info.floor)),
    )
    if info.paths is not None:
        knots, maps = decode_paths(info.paths, quantized.maps, quantized.knots, quantized.intervals * info.time_step)
        index = v["path"].astype(np.uint8)
        splats = dataclasses.replace(splats, path_index=index, paths=SharedPaths(single(knots), single(maps)))
    times = FrameTimes(single(quantized.intervals * info.time_step))
    shared = (info.size, info.fps, info.options, info.compositing, info.scale_cutoff)
    return VideoModel(splats, times, *shared)


def _log(x: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
    """Natural logarithm by elementary operations only, to 1e-13: libraries differ in the last bit."""
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


def trajectory_span(
    time: Float[np.ndarray, " num"], duration: Float[np.ndarray, " num"], reach: float
) -> tuple[Float[np.ndarray, " num"], Float[np.ndarray, " num"]]:
    """Middle and half-width of the span of time of a trajectory: `reach` sigma_t on either side, within the clip.

    sigma_t is rounded to a power of sqrt(2), which needs no exponential.
    """
    halves = np.clip(np.floor(2 * (duration * (1 / _LN2)) + 0.5), -_MAX_EXPONENT, _MAX_EXPONENT).astype(np.int32)
    wide = reach * compute_steps(halves)
    first, last = np.maximum(time - wide, 0.0), np.minimum(time + wide, 1.0)
    return (first + last) * 0.5, np.maximum((last - first) * 0.5, 2.0**-40)


@functools.cache
def legendre(degree: int) -> Float[np.ndarray, "degree+1 degree+1"]:
    """Coefficients of the Legendre polynomials: row k is P_k in powers of its argument. Exact: they are dyadic."""
    rows = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        for j in range(k // 2 + 1):
            numerator = (-1) ** j * math.comb(k, j) * math.comb(2 * k - 2 * j, k)
            rows[k, k - 2 * j] = numerator / 2**k
    return rows


def _monomials(
    v: dict[str, np.ndarray], time: Float[np.ndarray, " num"], info: CompactInfo
) -> Float[np.ndarray, "num degree+1 2"]:
    """Trajectories in powers of u = m_t - t: row 0 is m_s, row k is c_k."""
    degree, table = info.degree, legendre(info.degree)
    middle, half = trajectory_span(time, v["duration"], info.reach)
    out = np.empty((len(time), degree + 1, 2))
    at, scale = (time - middle) / half, -1.0 / half
    for axis in range(2):
        powers = []  # of w = (t - middle) / half
        for j in range(degree + 1):
            total = np.zeros(len(time))
            for k in range(j, degree + 1, 2):
                total = total + table[k, j] * v[f"{'xy'[axis]}{k}"]
            powers.append(total)
        # w = at + scale u: Horner's shift, then the scale.
        for j in range(degree):
            for k in range(degree - 1, j - 1, -1):
                powers[k] = powers[k] + at * powers[k + 1]
        factor = np.ones(len(time))
        for k in range(degree + 1):
            out[:, k, axis] = powers[k] * factor
            factor = factor * scale
    return out


# ------------------------------------------------------------------------------------------ encoding


@dataclasses.dataclass(frozen=True)
class ExactColumns:
    """A model's columns before rounding; trajectories are still `polynomials`, in powers of u."""

    info: CompactInfo
    swapped: Bool[np.ndarray, " num"]
    turn: Float[np.ndarray, " num"]
    values: dict[str, Float[np.ndarray, " num"]]
    polynomials: Float[np.ndarray, "num degree+1 2"]
    logits: Float[np.ndarray, " intervals"]
    path: Int32[np.ndarray, " num"] | None = None
    paths: SharedPaths | None = None


def compute_columns(model: VideoModel) -> ExactColumns:
    """The columns of a model, float64. Raises ValueError for a model that the format cannot hold."""
    info = _make_info(model)
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
        "angle": (turn + np.where(swapped, 0.25, 0.0) - _FIRST_ANGLE) % 0.5 + _FIRST_ANGLE,
    }
    values |= dict(zip(("luma", "blue", "green"), (leaf("color_dc") @ AXES.T).T, strict=True))
    polynomials = np.concatenate([leaf("loc")[:, None], leaf("coefficients")], 1)
    logits = np.asarray(model.frame_times.logits, np.float64)
    exact = ExactColumns(info, swapped, turn, values, polynomials, logits)
    if splats.paths is None:
        return exact
    check_paths(splats)
    info = dataclasses.replace(info, paths=describe_paths(model))
    return dataclasses.replace(exact, info=info, path=np.asarray(splats.path_index, np.int32), paths=splats.paths)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(0.5 * x))


def _make_info(model: VideoModel) -> CompactInfo:
    power, floor = float(model.splats.envelope.power), float(model.splats.envelope.floor)
    require(
        model.degree <= MAX_DEGREE,
        "model.degree",
        expected=f"at most {MAX_DEGREE}",
        got=model.degree,
        cure="Save as .safetensors.",
    )
    require(model.num_gaussians, "model", expected="at least one Gaussian", got="none")
    # A Gaussian's area is about exp(-power tau^2 / 2), of deviation 1 / sqrt(power); a uniform weight of the same
    # deviation reaches sqrt(3) times as far. Twice that takes the fewest bits, as measured.
    reach = min(TAU_MAX, math.sqrt(12 / max(power, 0.1)))
    return CompactInfo(
        degree=model.degree,
        power=power,
        floor=floor,
        reach=reach,
        size=tuple(map(int, model.size)),
        fps=float(model.fps),
        options=model.options,
        compositing=model.compositing,
        scale_cutoff=float(model.scale_cutoff),
        time_bits=choose_time_bits(np.asarray(model.frame_times.logits, np.float64)),
    )


def choose_cell_bits(num_gaussians: int, size: tuple[int, int]) -> tuple[int, int, int]:
    """Bits of cells along x, y and time: about eight Gaussians per cell, a quarter of the bits for time."""
    total = min(max(round(math.log2(num_gaussians / 8)), 0), MAX_CELL_BITS)
    of_time = total // 4
    fewer, more = (total - of_time) // 2, (total - of_time + 1) // 2
    height, width = size
    return (more, fewer, of_time) if width >= height else (fewer, more, of_time)


def trajectory_matrix(
    time: Float[np.ndarray, " num"], duration: Float[np.ndarray, " num"], info: CompactInfo
) -> Float[np.ndarray, "num degree+1 degree+1"]:
    """M with (m_s, c_1, ..) = M (trajectory's columns), by decoding unit vectors."""
    num, degree = len(time), info.degree
    out = np.empty((num, degree + 1, degree + 1))
    for k in range(degree + 1):
        unit = {f"{axis}{j}": np.full(num, float(j == k)) for j in range(degree + 1) for axis in "xy"}
        out[:, :, k] = _monomials(unit | {"duration": duration}, time, info)[:, :, 0]
    return out


def quantize(
    exact: ExactColumns,
    classes: Int32[np.ndarray, " num"],
    rules: dict[str, Rule],
    chunks: Int[np.ndarray, " num"] | None = None,
) -> Quantized:
    """Round every column by its rule; errors of earlier columns are corrected by later ones.

    `chunks`: the number of each Gaussian's chunk, which does not increase from front to back (default: a single one).
    """
    info = exact.info
    if chunks is None:
        chunks = np.zeros(len(classes), np.int8)
    require(
        (chunks[1:] <= chunks[:-1]).all(),  # otherwise the file would have another order
        "chunks",
        expected="numbers that do not increase from front to back",
        got="others",
    )
    made, numbers = [], np.unique(chunks)
    require(len(numbers) <= MAX_CHUNKS, "chunks", expected=f"at most {MAX_CHUNKS} of them", got=len(numbers))
    for number in numbers:
        part = chunks == number
        made.append(quantize_chunk(select_rows(exact, part), classes[part], rules))
    logits = exact.logits - exact.logits.max(initial=-np.inf)
    intervals = round_times(logits, info.time_bits)
    paths = {} if info.paths is None else round_paths(info.paths, exact.paths)
    return Quantized(info, rules, tuple(made), intervals, **paths)


def quantize_chunk(
    exact: ExactColumns,
    classes: Int32[np.ndarray, " num"],
    rules: dict[str, Rule],
    cells: Int32[np.ndarray, " num"] | None = None,
) -> Chunk:
    """Round the columns of one chunk.

    `cells`: the cells whose centers positions are relative to (default: those that they are in).
    """
    info, num = exact.info, len(classes)
    bits = choose_cell_bits(num, info.size)
    if cells is None:
        cells = find_cells(exact)
    values = exact.values | {"class": classes, "cell": cells, "path": exact.path}
    # The trajectory's degree is known only after rounding it.
    whole = {"degree": np.full(num, info.degree, np.int32)}
    columns, saved = _round_columns(values | whole, exact, ColumnDecoder(rules, info, bits, num))
    columns["degree"] = degrees = _choose_degrees(saved)
    for k in range(1, info.degree + 1):
        for axis in "xy":
            columns[f"{axis}{k}"] = np.where(degrees >= k, columns[f"{axis}{k}"], 0).astype(np.int32)
    return Chunk(bits, columns)


def select_rows(exact: ExactColumns, kept: Bool[np.ndarray, " num"] | Int[np.ndarray, " kept"]) -> ExactColumns:
    """Some of a model's Gaussians, in their order."""
    values = {name: value[kept] for name, value in exact.values.items()}
    path = None if exact.path is None else exact.path[kept]
    own = exact.swapped[kept], exact.turn[kept], values, exact.polynomials[kept]
    return ExactColumns(exact.info, *own, exact.logits, path, exact.paths)


def find_cells(exact: ExactColumns) -> Int32[np.ndarray, " num"]:
    """The cell of each Gaussian, from the middle of its trajectory."""
    values = exact.values
    columns = _compute_trajectories(exact, values)
    cells = choose_cell_bits(len(exact.turn), exact.info.size)
    return locate_cells(columns["x0"], columns["y0"], clamp_unit(values["time"]), exact.info, cells)


def _choose_degrees(saved: Float[np.ndarray, "degree+1 num"]) -> Int32[np.ndarray, " num"]:
    """The last power worth its bits; `saved` is the squared error that each power saves, in steps."""
    worth = np.arange(len(saved), dtype=np.int32)[:, None] * (saved > POWER_WORTH)
    return worth.max(axis=0, initial=0).astype(np.int32)


def _round_columns(
    values: dict[str, np.ndarray], exact: ExactColumns, decoder: ColumnDecoder
) -> tuple[dict[str, Int32[np.ndarray, " num"]], Float[np.ndarray, "degree+1 num"]]:
    """The integers of all columns, and the squared error, in steps, that the trajectory's powers save."""
    columns, saved = {}, np.zeros((exact.info.degree + 1, len(exact.turn)))
    for name in exact.info.column_names:
        if name == "x0":
            values = values | _compute_trajectories(exact, decoder.values)
        halves = decoder.half_exponents(name)
        steps = compute_steps(halves, name)
        origin = decoder.origin(name, steps)
        scaled = (values[name] - origin) / steps
        numbers = np.rint(scaled)
        if name == "angle":  # kept in its half turn, so that quantizing a decoded model changes nothing
            low, high = (np.ceil((end - origin) / steps) for end in (_FIRST_ANGLE, _FIRST_ANGLE + 0.5))
            numbers = np.minimum(np.maximum(numbers, low), high - 1)
        require(
            np.isfinite(numbers).all(),
            "model",
            expected="finite numbers",
            got=f"another {name} of Gaussian {int(np.argmin(np.isfinite(numbers)))}",
            cure="Remove it first.",
        )
        columns[name] = np.clip(numbers, -LARGEST, LARGEST).astype(np.int32)
        decoder.add(name, columns[name], halves)
        if trajectory_power(name):
            saved[trajectory_power(name)] += scaled**2 - (scaled - numbers) ** 2
    return columns, saved


def _compute_trajectories(exact: ExactColumns, decoded: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The trajectory's columns: the same curve in time, relative to the m_t and the span that are decoded."""
    time = clamp_unit(decoded["time"])
    polynomials = np.stack(shift_polynomial(exact.polynomials, exact.values["time"] - time), 1)
    matrix = trajectory_matrix(time, decoded["duration"], exact.info)
    size = np.abs(matrix).max(2, keepdims=True)  # rows differ greatly in size: c_k scales with a power of time
    solved = np.linalg.solve(matrix / size, polynomials / size)
    return {f"{axis}{k}": solved[:, k, a] for k in range(solved.shape[1]) for a, axis in enumerate("xy")}


# ------------------------------------------------------------------------------------------ frame times, shared paths


def choose_time_bits(logits: Float[np.ndarray, " intervals"]) -> int:
    """The fewest bits from `TIME_BITS` on with which rounding moves no frame by more than `TIME_ERROR` intervals."""
    if not len(logits):
        return TIME_BITS
    logits = logits - logits.max()
    median = np.median(np.exp(logits))
    for bits in range(TIME_BITS, MAX_TIME_BITS):
        moved = np.cumsum(np.exp(round_times(logits, bits) * 2.0**-bits) - np.exp(logits))
        moved -= moved[-1] * np.cumsum(np.exp(logits)) / np.exp(logits).sum()  # they end at 1
        if np.abs(moved).max() <= TIME_ERROR * median:
            return bits
    return MAX_TIME_BITS


def round_times(logits: Float[np.ndarray, " intervals"], bits: int) -> Int32[np.ndarray, " intervals"]:
    """Integers of logits up to 0, at least -`LARGEST`, which intervals that are 0 in float64 have."""
    return np.rint(np.maximum(logits, -1e5) * 2.0**bits).astype(np.int64).clip(-LARGEST).astype(np.int32)


def describe_paths(model: VideoModel) -> PathsInfo:
    """The constants for a model's paths."""
    low, high = np.quantile(np.asarray(model.splats.loc, np.float64), [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    middle, sides = ((low + high) / 2).round(4), np.maximum(high - low, _MIN_SIDE).round(4)
    paths, frames = model.splats.paths, np.asarray(model.frame_times.times(), np.float64)
    at_frames = paths.num_knots == len(frames) and np.abs(np.asarray(paths.times) - frames).max() <= 2.0**-20
    # Half a step of all six numbers of a map moves (x, y) by so much of a step.
    most = 0.5 * (1 + (np.abs(middle) + sides / 2).sum())
    bits = math.ceil(math.log2(most * max(model.size) / PATH_ERROR))
    extent = tuple(middle.tolist()), tuple(sides.tolist())
    return PathsInfo(paths.num_paths, paths.num_knots, bool(at_frames), min(max(bits, 0), MAX_PATH_BITS), *extent)


def round_paths(about: PathsInfo, paths: SharedPaths) -> dict[str, Int32[np.ndarray, "..."]]:
    """The integers of the maps and, unless they are at the frames, of their times.

    The integers, and the differences between them that the file stores, have magnitudes of at most `LARGEST`.
    """
    rounded = {"maps": np.rint(np.asarray(paths.matrices, np.float64) * 2.0**about.bits)}
    rounded |= {} if about.at_frames else {"knots": np.rint(np.asarray(paths.times, np.float64) / KNOT_STEP)}
    for name, numbers in rounded.items():
        first = np.eye(2, 3) * 2.0**about.bits if name == "maps" else 0.0
        require(
            all((np.abs(own) <= LARGEST).all() for own in (numbers, np.diff(numbers - first, axis=1, prepend=0))),
            "model",
            expected=f"shared paths whose {name} are within the range of their steps",
            got="others",
            cure="Save it as .safetensors.",
        )
    return {name: numbers.astype(np.int32) for name, numbers in rounded.items()}


def decode_paths(
    about: PathsInfo,
    maps: Int32[np.ndarray, "paths knots 2 3"],
    knots: Int32[np.ndarray, "paths knots"] | None,
    logits: Float[np.ndarray, " intervals"],
) -> tuple[Float[np.ndarray, "paths knots"], Float[np.ndarray, "paths knots 2 3"]]:
    """Times and maps; without `knots` the times are those of the frames, `FrameTimes(logits).times()`."""
    maps = maps * 2.0**-about.bits
    if knots is not None:
        return knots * KNOT_STEP, maps
    summed = np.cumsum(_exp(logits - logits.max(initial=-np.inf)))
    return np.tile(np.concatenate([[0.0], summed / summed[-1:]]), (about.num_paths, 1)), maps


def _exp(x: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
    """Exponential of numbers <= 0 by elementary operations only, to 1e-13 and not below e^-690."""
    x = np.maximum(x, -690.0)
    e = np.floor(x * (1 / _LN2) + 0.5)
    rest, total = x - e * _LN2, np.ones_like(x)
    for k in range(14, 0, -1):
        total = 1 + total * rest / k
    return np.ldexp(total, e.astype(np.int32))
