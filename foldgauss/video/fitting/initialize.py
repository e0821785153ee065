"""The initial Gaussians of a fit: drawn from the detail and the colors of the clip; or uniformly, as published."""

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import scipy
from jaxtyping import Float, Float32, UInt8

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.threads import run_tasks
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.fitting.config import PUBLISHED_UNIT
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.models.splats import SH_C0, TAU_MAX, FoldedSplats
from foldgauss.video.motion.optical_flow import Motion, Tracks, fit_folds
from foldgauss.video.motion.path_coordinates import PathCoordinates, prefers_path

#: Logarithm of the ratio of the longer axis of a start on a straight edge to the geometric mean of both.
ELONGATION = 0.7
#: The width, in pixels, of the window in which edges are measured.
TENSOR_WIDTH = 1.5
#: Fraction of the starts that is spread evenly, so that flat regions are covered too.
EVEN_FRACTION = 0.15
#: Initial standard deviation in units of the distance to the neighbors alive at the same time.
SCALE_FACTOR = 1.3
START_OPACITY = 0.3
#: With compositing "sum": neighboring contributions then add up to 1.
SUMMED_OPACITY = 1 / (2 * np.pi * SCALE_FACTOR**2)
#: sigma_t of a start at rest is drawn log-uniformly between these, in units of the clip's duration.
TIME_SCALES = (0.02, 0.4)
#: sigma_t of a start that follows its track, in units of half the track.
TRACK_FRACTIONS = (0.25, 1.2)
#: The least sigma_t of such a start, in frames.
MIN_FRAMES = 0.9
#: sigma_t, in frames, of a start that cannot be tracked to either neighbor: with an envelope of power 1 it is then a
#: quarter as wide there. (Two alternating images, 120 steps: 19.5 dB with 0.6, 22.3 with this; bikes, 80x160: 31.65 and
#: 31.70.)
UNTRACKED_FRAMES = 0.42
#: Where the fold misses the track by more than this many pixels, sigma_t is shortened,
MISS = 0.7
#: by this factor,
SHORTENING = 0.6
#: so often at most.
SHORTENINGS = 4
#: Gaussians alive in a frame, for each pixel, below which those that follow a path live longer than a fold alone
#: could follow their track. With more of them, they reproduce what differs from frame to frame, such as motion blur,
#: less well. (40 frames of bus, 180x320, 800 steps, as long as possible and as a fold alone: 15,000 Gaussians 33.9 and
#: 31.0 dB, 40,000 36.6 and 34.7, 100,000 38.5 and 38.0; 60 s of one core, 200,000: 39.9 and 42.2.)
FEW_ALIVE = 0.35
CHUNK = 12_000  # tracks held by a thread: some 3 kB each on the way
AT_ONCE = 8 * CHUNK  # tracks held by all threads
#: Trial starts per frame, from which follows how long starts are visible.
PILOT = 32
#: A start is visible so many sigma_t to either side.
CORE = 1.5
#: Rounds of the search for sigma_t.
ROUNDS = 50
#: The most trial starts in all: in long clips they would take longer than the fit.
MAX_PILOTS = 40_000
#: With fewer starts than this per frame, their frames are drawn at even distances.
FEW_STARTS = 16
#: Fraction of the starts that is spread so that all frames are covered equally, however short the tracks there. With
#: more, the worst frames get better and the mean worse.
EVEN_FRAMES = 0.2
#: Bounds of sigma_t of uniform starts (VeGaS).
UNIFORM_TIME_SCALES = (0.01, 1.0)
#: Largest fold coefficient of uniform starts, in published units (VeGaS).
UNIFORM_FOLD = 1.0
#: Opacity of uniform starts (VeGaS).
UNIFORM_OPACITY = 0.1
#: Color of uniform starts: gray, which the published code stores in 8 bits.
UNIFORM_COLOR = 127 / 255
#: The scale of a uniform start is the root mean square distance to so many neighbors (3DGS).
NEIGHBORS = 3


#: The center of the backdrop, in units of the frame's longer side: far from the frame, where no region selects it.
BACKDROP_PLACE = (0.0, 4.0)
#: Its standard deviations, in the same units: so wide that it is even within the frame.
BACKDROP_SCALE = 16.0
#: Its sigma_t, in units of the clip's length: so long that it is even in time.
BACKDROP_TIME_SCALE = 4.0
#: Its opacity: nearly opaque, with a finite logit.
BACKDROP_OPACITY = 0.9975


def initialize(
    frames: np.ndarray,
    num_gaussians: int | Callable[[float], int],
    *,
    degree: int,
    envelope: TimeLikelihood,
    seed: int,
    times: np.ndarray | None = None,
    motion: Motion | None = None,
    paths: SharedPaths | None = None,
    opacity: float = START_OPACITY,
) -> FoldedSplats:
    """Initial splats for `frames`, uint8 (num_frames, height, width, 3), at `times` (default: evenly spaced).

    With alpha, (..., 4), there are none where frames are transparent.
    Positions are drawn by image gradient within each frame, m_t is that frame's time, sizes follow from the local
    density of starts, colors from the pixel. With `motion`, folds follow the optical flow, and sigma_t is drawn as a
    fraction of the length of the track; without, folds are at rest and sigma_t is log-uniform. Where one of `paths`,
    the camera's and those of objects, describes the motion better than a fold alone, starts follow it. `num_gaussians`
    may be a function of their mean lifetime in frames.
    """
    rng = make_generator(Stream.INITIALIZATION, seed=seed)
    num_frames = len(frames)
    times = np.linspace(0, 1, num_frames) if times is None else np.asarray(times, np.float64)
    seen = frames[..., 3] > 0 if frames.shape[3] == 4 else None
    frames = np.ascontiguousarray(frames[..., :3])  # as seen over black
    density_of = lambda k: measure_detail(frames[k], None if seen is None else seen[k])  # noqa: E731
    make = lambda home, position, longer=1.0: make_splats(  # noqa: E731
        frames, home, position, times, degree, envelope, motion, rng, opacity, paths, longer
    )
    chance, lifetime = _try_starts(times, make, density_of, rng)
    if seen is not None and seen.any():
        chance *= seen.any((1, 2))
        chance /= chance.sum()
    if callable(num_gaussians):
        num_gaussians = num_gaussians(lifetime)
    area = frames[..., 0].size if seen is None else seen.sum()
    longer = max(FEW_ALIVE * area / max(num_gaussians * lifetime, 1), 1.0)
    if num_gaussians < FEW_STARTS * num_frames:  # random frames would leave out whole intervals
        home = _draw(chance, (np.arange(num_gaussians) + rng.random()) / num_gaussians)
    else:
        home = np.sort(rng.choice(num_frames, num_gaussians, p=chance))
    position, density = draw_positions(home, density_of, rng)
    splats, spread = make(home, position, longer)
    alive = count_alive(times[home], spread, times)[home]
    scale = SCALE_FACTOR / np.sqrt(alive * density) / max(frames.shape[1:3])
    # The order in depth is that of `home`, so that the Gaussians alive at a time lie side by side in memory: steps take
    # a third less time than in random order, for 0.2 dB after as many steps.
    angle, coherence = sample_orientations(frames, home, position)
    log_scale = np.log(scale)[:, None] + ELONGATION * coherence[:, None] * [1, -1]
    if paths is not None:
        log_scale += splats.log_scale + np.log(max(frames.shape[1:3]))  # by the path's zoom
        for number, coordinates in enumerate(PathCoordinates.of_each(paths, times, frames.shape[1:3]), 1):
            angle += np.where(splats.path_index == number, coordinates.turns(home), 0)
        angle = (angle - np.pi / 2) % np.pi + np.pi / 2
    shape = {"log_scale": np.float32(log_scale), "angle_logit": np.float32(_logit(angle / (2 * np.pi)))}
    return dataclasses.replace(splats, **shape)


def with_backdrop(splats: FoldedSplats, frames: UInt8[np.ndarray, "num_frames height width 3"]) -> FoldedSplats:
    """The splats with a backdrop in place of the last one: opaque, far wider than the frame, in the clip's mean color.

    What other Gaussians do not cover would be black.
    """
    color = frames.reshape(-1, 3).mean(0) / 255
    leaves = {
        "loc": BACKDROP_PLACE,
        "log_scale": np.log(BACKDROP_SCALE),
        "angle_logit": 0.0,
        "time_loc_logit": 0.0,
        "log_time_scale": np.log(BACKDROP_TIME_SCALE),
        "coefficients": 0.0,
        "opacity_logit": _logit(BACKDROP_OPACITY),
        "color_dc": (color - 0.5) / SH_C0,
    } | ({} if splats.paths is None else {"path_index": 0})
    made = {name: np.array(getattr(splats, name)) for name in leaves}
    for name, value in leaves.items():
        made[name][-1] = value
    return dataclasses.replace(splats, **made)


def _try_starts(
    times: np.ndarray,
    make: Callable[[np.ndarray, np.ndarray], tuple[FoldedSplats, np.ndarray]],
    density_of: Callable[[int], np.ndarray],
    rng: np.random.Generator,
) -> tuple[np.ndarray, float]:
    """The chance of a start in each frame, and the mean lifetime of starts in frames, from some trial starts."""
    num_frames = len(times)
    pilot = np.repeat(np.arange(num_frames), max(min(PILOT, MAX_PILOTS // num_frames), 1))
    _, spread = make(pilot, draw_positions(pilot, density_of, rng)[0])
    chance = EVEN_FRAMES * _even_chance(pilot, spread, times) + (1 - EVEN_FRAMES) / num_frames
    first, last = find_lifetimes(times[pilot], spread, times)
    return chance, float(np.average(last - first, weights=chance[pilot]))


def initialize_uniform(
    num_gaussians: int, size: tuple[int, int], *, degree: int, envelope: TimeLikelihood, seed: int
) -> FoldedSplats:
    """The published initial splats for frames of `size` (height, width): uniform, whatever the clip shows.

    Positions lie in the frame, m_t in (0, 1), sigma_t, folds and angles likewise uniformly; Gaussians are round, as
    wide as the distance to their `NEIGHBORS` nearest, faint and gray.
    Source: VeGaS, "Implementation Details", and constants of its published code.
    """
    rng = make_generator(Stream.INITIALIZATION, seed=seed)
    frame = np.array(size[::-1]) / max(size)
    loc = rng.uniform(-0.5, 0.5, (num_gaussians, 2)) * frame
    near = min(NEIGHBORS, num_gaussians - 1)
    # The nearest is the point itself; a single one is as wide as the frame.
    away = scipy.spatial.cKDTree(loc).query(loc, near + 1)[0][:, 1:] if near else np.ones((1, 1))
    scale = np.sqrt(np.mean(away**2, axis=1))
    limit = UNIFORM_FOLD * PUBLISHED_UNIT
    unit = lambda: rng.uniform(1e-6, 1 - 1e-6, num_gaussians)  # noqa: E731
    leaves = {
        "loc": loc,
        "log_scale": np.log(np.stack([scale, scale], -1)),
        "angle_logit": _logit(unit()),
        "time_loc_logit": _logit(unit()),
        "log_time_scale": np.log(rng.uniform(*UNIFORM_TIME_SCALES, num_gaussians)),
        "coefficients": rng.uniform(-limit, limit, (num_gaussians, degree, 2)),
        "opacity_logit": _logit(np.full(num_gaussians, UNIFORM_OPACITY)),
        "color_dc": np.full((num_gaussians, 3), (UNIFORM_COLOR - 0.5) / SH_C0),
    }
    return FoldedSplats(**{name: np.float32(leaf) for name, leaf in leaves.items()}, envelope=envelope)


def draw_positions(
    home: np.ndarray, density_of: Callable[[int], np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (num, 2) in pixels, one for each of the frames `home`, and the density, per pixel, there.

    `density_of(k)` is the density over the pixels of frame k, (height, width), summing to 1.
    """
    position, density = np.empty((len(home), 2)), np.empty(len(home))
    for k in np.unique(home):
        here, own = np.flatnonzero(home == k), density_of(k)
        pixel = _draw(own.ravel(), rng.random(len(here)))
        density[here] = own.ravel()[pixel]
        position[here] = np.stack(np.divmod(pixel, own.shape[1])[::-1], -1)
    return position + rng.random(position.shape), density


def make_splats(
    frames: np.ndarray,
    home: np.ndarray,
    position: np.ndarray,
    times: np.ndarray,
    degree: int,
    envelope: TimeLikelihood,
    motion: Motion | None,
    rng: np.random.Generator,
    opacity: float,
    paths: SharedPaths | None = None,
    longer: float = 1.0,
) -> tuple[FoldedSplats, np.ndarray]:
    """Splats at `position` in frames `home`, one pixel wide, with the colors of the frames; and their sigma_t.

    `longer` is that of `follow_tracks`.
    """
    num, (height, width) = len(home), frames.shape[1:3]
    coordinates = PathCoordinates.of_each(paths, times, (height, width))
    follows = np.zeros(num, np.uint8)
    interval = np.diff(times).min(initial=1.0)  # a single frame lasts the whole clip
    if motion is None:
        time = times[home] + rng.uniform(-0.5, 0.5, num) * interval
        coefficients = np.zeros((num, degree, 2), np.float32)
        shortest = max(TIME_SCALES[0], interval)
        spread = np.exp(rng.uniform(np.log(shortest), np.log(max(TIME_SCALES[1], shortest)), num))
    else:
        time = times[home]
        coefficients, spread, follows = follow_tracks(motion, home, position, degree, rng, coordinates, longer)
        coefficients /= np.float32(interval) ** np.arange(1, degree + 1)[:, None]
        spread = spread * interval
    column, row = np.floor(position).astype(np.int64).clip(0, [width - 1, height - 1]).T
    color, unit = frames[home, row, column] / np.float32(255), max(height, width)
    log_scale = np.full(num, -np.log(unit))
    for number, own in enumerate(coordinates, 1):
        here = follows == number
        position = np.where(here[:, None], own.place(home, position), position)
        log_scale += np.where(here, own.log_scales(home), 0)
    leaves = {
        "loc": (position - [width / 2, height / 2]) / unit,
        "log_scale": np.stack([log_scale, log_scale], 1),
        "angle_logit": _logit(rng.uniform(0.01, 0.99, num)),
        "time_loc_logit": _logit(np.clip(time, 1e-3, 1 - 1e-3)),
        "log_time_scale": np.log(spread),
        "coefficients": coefficients / unit,
        "opacity_logit": _logit(np.full(num, opacity)),
        "color_dc": (color - 0.5) / SH_C0,
    }
    splats = FoldedSplats(**{name: np.float32(leaf) for name, leaf in leaves.items()}, envelope=envelope)
    return splats if paths is None else dataclasses.replace(splats, path_index=follows, paths=paths), spread


def follow_tracks(
    motion: Motion,
    home: np.ndarray,
    position: np.ndarray,
    degree: int,
    rng: np.random.Generator,
    coordinates: Sequence[PathCoordinates] = (),
    longer: float = 1.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Folds (num, degree, 2), in pixels per frame^k, and sigma_t (num,) in frames, of points at `home`.

    And which path they follow, (num,), numbered from 1, 0 for none: their folds are in its `coordinates`. Their sigma_t
    is at most `longer` times the one with which a fold alone follows the track.
    """
    coefficients, spread = np.empty((len(home), degree, 2), np.float32), np.empty(len(home))
    follows = np.zeros(len(home), np.uint8)
    fractions = np.exp(rng.uniform(*np.log(TRACK_FRACTIONS), len(home)))

    def follow(start: int) -> None:
        part = slice(start, start + CHUNK)
        tracks = motion.follow(home[part], position[part].astype(np.float32))
        folds, wide = _fit_tracks(tracks, fractions[part], degree)
        alone, number = wide.copy(), np.zeros(len(wide), np.uint8)
        placed = [own.place_tracks(tracks, home[part], position[part]) for own in coordinates]
        for path, moved in enumerate(placed, 1):
            by_path, path_wide = _fit_tracks(moved, fractions[part], degree)
            better = prefers_path(folds, wide, by_path, path_wide, is_first=path == 1)
            folds[better], wide[better], number[better] = by_path[better], path_wide[better], path
        for path, moved in enumerate(placed, 1):
            on = number == path
            wide[on] = np.clip(wide, alone, longer * alone)[on]
            folds[on] = fit_folds(moved[on], wide[on], degree)[0]
        coefficients[part], spread[part], follows[part] = folds, wide, number

    for first in range(0, len(home), AT_ONCE):
        run_tasks(follow, range(first, min(first + AT_ONCE, len(home)), CHUNK))
    return coefficients, spread, follows


def _fit_tracks(
    tracks: Tracks, fractions: Float[np.ndarray, " num"], degree: int
) -> tuple[Float32[np.ndarray, "num degree 2"], Float[np.ndarray, " num"]]:
    """Folds and sigma_t of tracks, at most these `fractions` of half their length: less where the fold misses them."""
    wide = np.maximum(fractions * tracks.reach / 2, MIN_FRAMES)
    wide[tracks.reach == 0] = UNTRACKED_FRAMES
    folds, miss = fit_folds(tracks, wide, degree)
    for _ in range(SHORTENINGS):
        off = np.flatnonzero((miss > MISS) & (wide > MIN_FRAMES))
        if not len(off):
            break
        wide[off] = np.maximum(wide[off] * SHORTENING, MIN_FRAMES)
        folds[off], miss[off] = fit_folds(tracks[off], wide[off], degree)
    return folds, wide


def measure_detail(frame: np.ndarray, seen: np.ndarray | None = None) -> np.ndarray:
    """Density of starts over the pixels of a frame (height, width), summing to 1: by gradient, and partly even.

    `seen`: bool, the pixels where starts may be; all, if there is none of them.
    """
    gray = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)).astype(np.float64)
    slope, even = cv2.GaussianBlur(slope, (0, 0), 1.0), np.ones(slope.shape)
    if seen is not None and seen.any():
        slope, even = slope * seen, even * seen
    even, total = even / even.sum(), slope.sum()
    return EVEN_FRACTION * even + (1 - EVEN_FRACTION) * (slope / total if total > 0 else even)


def sample_orientations(frames: np.ndarray, home: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles (num,) of edges at `position` in frames `home`, in [pi/2, 3 pi/2), and how straight they are, in [0, 1].

    The angle is that of the first axis of a Gaussian along the edge. Source: the structure tensor, Foerstner 1987.
    """
    angle, coherence = np.empty(len(home)), np.empty(len(home))
    limit = np.array(frames.shape[2:0:-1]) - 1
    for k in np.unique(home):
        here = np.flatnonzero(home == k)
        column, row = np.floor(position[here]).astype(np.int64).clip(0, limit).T
        gray = cv2.cvtColor(frames[k], cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        right, down = cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)
        products = right * right, down * down, right * down
        xx, yy, xy = (cv2.GaussianBlur(one, (0, 0), TENSOR_WIDTH)[row, column] for one in products)
        difference, total = np.hypot(xx - yy, 2 * xy), xx + yy
        coherence[here] = difference / np.maximum(total, 1e-6)
        angle[here] = np.pi + 0.5 * np.arctan2(-2 * xy, yy - xx)  # across the direction of the largest slope
    return angle, coherence


def _draw(density: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Indices distributed as `density`, by inversion."""
    summed = np.cumsum(density)
    return np.minimum(np.searchsorted(summed, uniform * summed[-1], side="right"), len(density) - 1)


def find_lifetimes(time: np.ndarray, spread: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first frame in which each Gaussian is alive, and the one after the last."""
    first, last = time - TAU_MAX * spread, time + TAU_MAX * spread
    return np.searchsorted(times, first), np.searchsorted(times, last, side="right")


def count_alive(time: np.ndarray, spread: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Gaussians alive at each of the frames."""
    first, last = find_lifetimes(time, spread, times)
    step = np.bincount(first, minlength=len(times) + 1) - np.bincount(last, minlength=len(times) + 1)
    return np.cumsum(step)[:-1]


def _even_chance(home: np.ndarray, spread: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The probability of starting in each frame with which windows of `CORE` sigma_t cover all frames equally.

    `home` and `spread` are those of trial starts, as many in every frame. Source: Richardson 1972, Lucy 1974.
    """
    num = len(times)
    first = np.searchsorted(times, times[home] - CORE * spread)
    last = np.searchsorted(times, times[home] + CORE * spread, side="right")
    length = np.bincount(home, last - first, num)
    chance = np.full(num, 1 / num)
    for _ in range(ROUNDS):
        ends = np.bincount(first, chance[home], num + 1) - np.bincount(last, chance[home], num + 1)
        rarity = np.concatenate([[0.0], np.cumsum(1 / np.cumsum(ends)[:-1])])  # of the frames before each
        chance *= np.bincount(home, rarity[last] - rarity[first], num) / length
        chance /= chance.sum()
    return chance


def _logit(p: np.ndarray) -> np.ndarray:
    return np.log(p) - np.log1p(-p)
