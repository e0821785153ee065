"""Data that bend over time, and two mixtures, scikit-learn's and ours, each chosen by the same rule."""

import warnings
from typing import NamedTuple

import numpy as np
from sklearn.mixture import GaussianMixture
from sklearn.model_selection import GridSearchCV, GroupKFold

from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture
from foldgauss.io import datasets
from foldgauss.video.motion.optical_flow import Motion

#: s = sum_j c_j t^j, two space coordinates: three curves that cross.
CURVES = np.array(
    [
        [[0.0, 1.0, 0.0, 0.0], [0.2, 0.0, 1.0, 0.0]],
        [[1.0, -1.0, 0.0, 0.0], [0.8, 0.0, -1.0, 0.3]],
        [[0.5, 3.0, -9.0, 6.0], [0.5, -1.0, 2.0, -1.0]],
    ]
)
NOISE = 0.03
#: The shot of *bikes* whose camera turns forth and back, so that tracks bend most; the frame that corners are found in,
#: how many at most, their least quality and distance (pixels).
FRAMES, HOME, CORNERS, QUALITY, DISTANCE = (30, 76), 53, 40_000, 3e-4, 2.0
#: Tracks of at least so many frames are kept, and read once in so many frames.
LONG, EVERY = 31, 4
#: Parts of the cross-validation.
PARTS = 3


class Split(NamedTuple):
    """Points (n, 3), and to which track each belongs: no track is torn apart, neither here nor in cross-validation."""

    train: np.ndarray
    test: np.ndarray
    groups: np.ndarray
    test_groups: np.ndarray


class Side(NamedTuple):
    """A chosen mixture: its components, free parameters, and log-densities of points held out."""

    components: int
    parameters: int
    log_densities: np.ndarray

    @property
    def held_out(self) -> float:
        return float(self.log_densities.mean())

    def over(self, other: "Side", groups: np.ndarray) -> tuple[float, float]:
        """The difference of `held_out` to another's, and its standard error, a group being one draw."""
        difference = self.log_densities - other.log_densities
        sums = np.bincount(np.unique(groups, return_inverse=True)[1], difference - difference.mean())
        return float(difference.mean()), float(np.sqrt((sums**2).sum()) / len(difference))


def crossing(times: str, num: int = 3000, seed: int = 0) -> Split:
    """Points on three crossing cubic curves, with noise, at normal or at uniform times: every point by itself."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, num)
    t = {"normal": rng.normal(0.5, 0.25, num), "uniform": rng.uniform(0, 1, num)}[times]
    s = np.einsum("ndj,nj->nd", CURVES[labels], t[:, None] ** np.arange(4)) + rng.normal(size=(num, 2)) * NOISE
    x, half = np.concatenate([s, t[:, None]], 1), num // 2
    return Split(x[:half], x[half:], np.arange(half), np.arange(half, num))


def feature_tracks(seed: int = 0) -> Split:
    """Corners of a frame of *bikes*, followed by optical flow; half of the tracks is held out. In frame widths, and in
    spans of the shot.

    Tracks are read at random times, by straight lines between frames: frames' own times are few, and a component that
    sits at one of them has a density as high as its floor allows.
    """
    import cv2

    frames = np.asarray(datasets.bikes(frames=FRAMES).frames)
    home, width = HOME - FRAMES[0], frames.shape[2]
    gray = cv2.cvtColor(frames[home], cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(gray, CORNERS, QUALITY, DISTANCE).reshape(-1, 2) + np.float32(0.5)
    reach = min(home, len(frames) - 1 - home)
    tracks = Motion.from_frames(frames).follow(np.full(len(corners), home), corners, longest=reach)
    rng = np.random.default_rng(seed)
    points, groups = [], []
    for k in np.flatnonzero(tracks.known.sum(1) >= LONG):
        known = np.flatnonzero(tracks.known[k])
        at = rng.uniform(known[0], known[-1], len(known) // EVERY)
        where = (corners[k] + tracks.shift[k, known]) / width
        points.append(np.stack([*(np.interp(at, known, where[:, j]) for j in (0, 1)), (at - reach) / (2 * reach)], -1))
        groups.append(np.full(len(at), k))
    points, groups = np.concatenate(points).astype(np.float64), np.concatenate(groups)
    train = (rng.permutation(len(corners)) < len(corners) // 2)[groups]
    return Split(points[train], points[~train], groups[train], groups[~train])


def curves(times: str) -> tuple[dict[str, Side], np.ndarray]:
    """On crossing curves; and the held-out points' groups."""
    ours = {"n_components": [3, 4, 6, 8, 11], "degree": [1, 3]}
    return _compared(crossing(times), range(6, 31, 3), ours, max_components=12)


def tracks(seed: int = 0) -> tuple[dict[str, Side], np.ndarray]:
    """On feature tracks, where points of one track hang together, so that BIC sees more points than there are."""
    ours = {"n_components": [20, 30, 40], "degree": [0, 1, 2, 3]}
    return _compared(feature_tracks(seed), [10, 15, 20, 25, 30, 35, 40, 50, 60], ours, max_components=30)


def _compared(split: Split, sizes, ours: dict, max_components: int) -> tuple[dict[str, Side], np.ndarray]:
    options = {"n_init": 4, "random_state": 0, "max_iter": 200}
    theirs = GaussianMixture(**options)
    heated = {"annealing": 0.1} | options
    auto = FoldedGaussianMixture(max_components=max_components, **heated)
    grown = FoldedGaussianMixture(**heated)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of runs that stop at max_iter
        fitted = {
            "scikit-learn, BIC": _by_bic([GaussianMixture(size, **options) for size in sizes], split),
            "foldgauss, BIC (auto)": auto.fit(split.train),
            "scikit-learn, CV": _by_cv(theirs, {"n_components": list(sizes)}, split),
            "foldgauss, CV": _by_cv(grown, ours, split),
        }
        sides = {
            who: Side(len(model.weights_), model._n_parameters(), model.score_samples(split.test))
            for who, model in fitted.items()
        }
    return sides, split.test_groups


def _by_bic(models, split: Split):
    return min((model.fit(split.train) for model in models), key=lambda model: model.bic(split.train))


def _by_cv(model, grid: dict, split: Split):
    parts = GroupKFold(PARTS, shuffle=True, random_state=0)
    return GridSearchCV(model, grid, cv=parts).fit(split.train, groups=split.groups).best_estimator_
