"""Data that bend over time, and two mixtures of the best BIC each: scikit-learn's and ours."""

import warnings
from itertools import product
from typing import NamedTuple

import numpy as np
from sklearn.mixture import GaussianMixture

from foldgauss import datasets
from foldgauss.estimator import FoldedGaussianMixture
from foldgauss.video.motion import Motion

#: s = sum_j c_j t^j, two space coordinates: three curves that cross.
CURVES = np.array(
    [
        [[0.0, 1.0, 0.0, 0.0], [0.2, 0.0, 1.0, 0.0]],
        [[1.0, -1.0, 0.0, 0.0], [0.8, 0.0, -1.0, 0.3]],
        [[0.5, 3.0, -9.0, 6.0], [0.5, -1.0, 2.0, -1.0]],
    ]
)
NOISE = 0.03
#: Width of the frames that features are followed on; the frames of *bikes* (one shot), and that they are found in.
WIDTH, FRAMES, HOME, FEATURES = 320, (85, 135), 110, 1000
#: Numbers of components, and parts of the cross-validation.
SIZES, PARTS = [3, 5, 10, 15, 20], 3


class Split(NamedTuple):
    train: np.ndarray
    test: np.ndarray
    groups: np.ndarray  # of the points in train


class Side(NamedTuple):
    """A chosen mixture: its components, free parameters, and mean log-density of points held out."""

    components: int
    parameters: int
    held_out: float


def crossing(times: str, num: int = 3000, seed: int = 0) -> Split:
    """Points on three crossing cubic curves, with noise, at normal or at uniform times."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, num)
    t = {"normal": rng.normal(0.5, 0.25, num), "uniform": rng.uniform(0, 1, num)}[times]
    s = np.einsum("ndj,nj->nd", CURVES[labels], t[:, None] ** np.arange(4)) + rng.normal(size=(num, 2)) * NOISE
    x = np.concatenate([s, t[:, None]], 1)
    return Split(x[: num // 2], x[num // 2 :], labels[: num // 2])


def feature_tracks(seed: int = 0) -> Split:
    """Corners of a frame of *bikes*, followed by optical flow; half of the tracks is held out. In frame widths, and in
    spans of the frames followed."""
    import cv2

    clip = datasets.bikes(frames=FRAMES)
    frames = np.asarray(clip.frames)
    height = round(WIDTH * frames.shape[1] / frames.shape[2])
    frames = np.stack([cv2.resize(f, (WIDTH, height), interpolation=cv2.INTER_AREA) for f in frames])
    home = HOME - FRAMES[0]
    reach = FRAMES[1] - HOME
    grey = cv2.cvtColor(frames[home], cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(grey, FEATURES, 0.01, 4).reshape(-1, 2) + np.float32(0.5)
    tracks = Motion.of(frames).follow(np.full(len(corners), home), corners, longest=reach)
    position = (corners[:, None] + tracks.shift) / WIDTH
    t = np.broadcast_to(np.arange(-reach, reach + 1) / (2 * reach), tracks.known.shape)
    points = np.concatenate([position, t[..., None]], -1).astype(np.float64)
    train = np.random.default_rng(seed).permutation(len(corners)) < len(corners) // 2
    chosen = lambda which: points[which][tracks.known[which]]  # noqa: E731
    names = np.broadcast_to(np.arange(len(corners))[:, None], tracks.known.shape)
    return Split(chosen(train), chosen(~train), names[train][tracks.known[train]])


def _scikit_learns(num: int) -> GaussianMixture:
    return GaussianMixture(num, n_init=2, random_state=0, max_iter=200)


def _ours(num: int, degree: int | str, init_params: str) -> FoldedGaussianMixture:
    options = {"n_init": 2, "random_state": 0, "max_iter": 200, "init_params": init_params}
    return FoldedGaussianMixture(num, degree=degree, **options)


def curves(times: str) -> dict[str, Side]:
    """On crossing curves: both by BIC."""
    split = crossing(times)
    return {
        "scikit-learn, BIC": _by_bic(_scikit_learns, split, range(6, 31, 3)),
        "foldgauss, BIC": _by_bic(lambda num: _ours(num, "auto", "trajectories"), split, range(2, 7)),
    }


def tracks() -> dict[str, Side]:
    """On feature tracks, where points of one track hang together, so that BIC sees more points than there are: by BIC,
    and by cross-validation that keeps tracks whole."""
    split = feature_tracks()
    return {
        "scikit-learn, BIC": _by_bic(_scikit_learns, split, [20, 40, 80, 120]),
        "scikit-learn, CV": _by_cv(lambda choice: _scikit_learns(*choice), split, [(num,) for num in SIZES]),
        "foldgauss, CV": _by_cv(lambda choice: _ours(*choice, "kmeans"), split, list(product(SIZES, (1, 2, 3)))),
    }


def _by_bic(make, split: Split, sizes) -> Side:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = [make(num).fit(split.train) for num in sizes]
    return _side(min(fitted, key=lambda model: model.bic(split.train)), split)


def _by_cv(make, split: Split, choices) -> Side:
    names = np.unique(split.groups)
    part = np.random.default_rng(0).permutation(len(names)) % PARTS
    held = part[np.searchsorted(names, split.groups)]
    scores = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for choice in choices:
            fits = [make(choice).fit(split.train[held != k]) for k in range(PARTS)]
            scores.append(sum(fit.score_samples(split.train[held == k]).sum() for k, fit in enumerate(fits)))
        return _side(make(choices[int(np.argmax(scores))]).fit(split.train), split)


def _side(model, split: Split) -> Side:
    return Side(len(model.weights_), model._n_parameters(), model.score(split.test))
