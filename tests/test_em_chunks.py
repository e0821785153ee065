"""EM over chunks: it ends where EM on one array does, whatever the chunks, and holds no more than some of them."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

pytest.importorskip("sklearn")
from sklearn.exceptions import ConvergenceWarning

from foldgauss.estimator import chunks as _chunks
from foldgauss.estimator.chunks import Chunks, is_chunked, summarize_rows, weighted_moments
from foldgauss.estimator.em import initialization, loop, statistics
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture

N, CUTS = 600, (1, 1, 90, 91, 350, 595)  # a chunk of one row, one of none
#: One set for nearly all tests: they share its programs.
OPTIONS = {
    "n_components": 3,
    "degree": 2,
    "covariance_type": "tied",
    "init_params": "trajectories",
    "n_init": 2,
    "random_state": 0,
    "tol": 1e-5,
}
FITTED = [
    "weights_",
    "means_",
    "covariances_",
    "locs_",
    "space_covariances_",
    "time_means_",
    "time_scales_",
    "fold_coefficients_",
    "degrees_",
    "lower_bound_",
    "lower_bounds_",
    "n_iter_",
]


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Pieces, parts and blocks so small that the tests' data make several."""
    monkeypatch.setattr(_chunks, "_PIECE_ROWS", 100)
    monkeypatch.setattr(statistics, "PAIRS_PER_CHUNK", 512)
    monkeypatch.setattr(statistics, "_CHUNKS_PER_BLOCK", 2)


def _tracks(num=N, dtype=np.float64, offset=0.0):
    rng = np.random.default_rng(0)
    t, which = rng.normal(0.5, 0.25, num), rng.integers(0, 3, num)
    s = np.choose(which, [t, 1 - t, 0.5 + 3 * t - 5 * t**2]) + 0.03 * rng.normal(size=num)
    return (np.stack([s, t], 1) + offset).astype(dtype)


def _weights(num=N):
    """Some are 0, and they sum to less than the number of rows."""
    return np.random.default_rng(1).integers(0, 3, num) / 4


def _fit(x, weights=None, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return FoldedGaussianMixture(**OPTIONS | options).fit(x, sample_weight=weights)


def _assert_same(one, other, rtol=1e-6):
    assert one.status_ == other.status_
    for name in FITTED:
        expected = np.asarray(getattr(one, name), np.float64)
        # Relative to the array's largest number: a component of one at 0 has no digits of its own.
        np.testing.assert_allclose(getattr(other, name), expected, rtol=rtol, atol=rtol * np.abs(expected).max())


class _Files:
    """As a reader of files: each pass begins anew."""

    def __init__(self, parts):
        self.parts = parts

    def __iter__(self):
        return (part.copy() for part in self.parts)


class _Changing:
    """Other rows in each pass."""

    def __init__(self, passes):
        self.passes = passes

    def __iter__(self):
        return iter(next(self.passes))


# --- the same result ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param(
            {"envelope": "time_likelihood", "covariance_type": "full", "degree": 1, "n_init": 1, "max_iter": 30},
            marks=pytest.mark.slow,
        ),
        pytest.param({"covariance_type": "full", "n_init": 1}, marks=pytest.mark.slow),
        pytest.param(
            {"n_components": "auto", "degree": "auto", "max_components": 4, "annealing": 0.5}, marks=pytest.mark.slow
        ),
        pytest.param({"degree": 8, "reg_covar": 0.0, "max_iter": 30}, marks=pytest.mark.slow),
        pytest.param({"criterion": "aic", "degree": "auto", "covariance_type": "diag"}, marks=pytest.mark.slow),
        pytest.param(
            {"envelope": "time_likelihood", "n_init": 3, "covariance_type": "spherical"}, marks=pytest.mark.slow
        ),
        pytest.param({"init_params": "random", "annealing": 0.1, "time_column": 0}, marks=pytest.mark.slow),
    ],
)
def test_chunks_equal_one_array(options):
    """Weights of zero among them, and 1e6 away from zero."""
    x, weights = _tracks(offset=1e6), _weights()
    whole = _fit(x, weights, **options)
    parted = _fit(np.split(x, CUTS), np.split(weights, CUTS), **options)
    _assert_same(whole, parted)
    assert whole.n_iter_ > 2
    if "annealing" not in options and "auto" not in options.values():  # the likelihood never falls
        assert (np.diff(parted.lower_bounds_) > -1e-9).all()


def test_all_kinds_of_chunks_are_equivalent(tmp_path):
    array = pytest.importorskip("dask.array", reason="dask is not installed")
    x, weights = _tracks(), _weights()
    parts, masses = np.split(x, CUTS), np.split(weights, CUTS)
    x.tofile(tmp_path / "rows")
    mapped = np.memmap(tmp_path / "rows", np.float64, mode="r", shape=x.shape)
    whole = _fit(x, weights)
    kinds = {
        "an object": (_Files(parts), _Files(masses)),
        "one chunk from a file": ([mapped], [weights]),
        "slices of a file, and a list": ([mapped[:7], mapped[7:]], [list(weights[:7]), weights[7:]]),
        "blocks of a dask array": (
            array.from_array(x, chunks=((70, 10, 0, 160, 1, 259, 100), 2)).blocks.ravel(),
            array.from_array(weights, chunks=((70, 10, 0, 160, 1, 259, 100),)).blocks.ravel(),
        ),
        "rows one by one": ([row[None] for row in x], weights[:, None]),
        "lists of rows in an object": (
            _Files([part.tolist() for part in parts if len(part)]),
            [mass for mass in masses if len(mass)],
        ),
    }
    for X, mass in kinds.values():
        _assert_same(whole, _fit(X, mass), 1e-9)
        np.testing.assert_array_equal(np.concatenate(list(whole.predict(X))), whole.predict(x))
    with pytest.raises(ValueError, match=r"X: expected rows, or chunks of rows, got a dask array\. .*blocks"):
        _fit(array.from_array(x))


@pytest.mark.slow
def test_float32_chunks_are_fitted_in_float32():
    x = _tracks(dtype=np.float32)
    whole, parted = _fit(x), _fit(np.split(x, CUTS))
    assert parted._params.curve.dtype == np.float32
    _assert_same(whole, parted, 1e-4)
    mixed = _fit([x[:300], x[300:].astype(np.float64)])
    assert mixed._params.curve.dtype == np.float64
    _assert_same(_fit(x.astype(np.float64)), mixed)


def test_initialization_draws_the_same_rows(monkeypatch):
    """Where a start looks at some rows only."""
    monkeypatch.setattr(initialization, "_MAX_POINTS", 100)
    x, weights = _tracks(), _weights()
    seen = []

    def record(kind, y, weights, *rest):
        seen.append((y, weights))
        return initialization.initialize(kind, y, weights, *rest)

    monkeypatch.setattr("foldgauss.estimator.folded_gaussian_mixture.initialize", record)
    _assert_same(_fit(x, weights), _fit(np.split(x, CUTS), np.split(weights, CUTS)))
    for (y, w), (again, mass) in zip(seen[:2], seen[2:], strict=True):
        assert len(y) == len(again) == 100
        np.testing.assert_allclose(np.sort(y, axis=0), np.sort(again, axis=0), atol=1e-12)
        np.testing.assert_array_equal(np.sort(w), np.sort(mass))
    assert not np.allclose(np.sort(seen[2][0], axis=0), np.sort(seen[3][0], axis=0))


def test_first_of_equal_runs_is_selected():
    """Up to rounding, which hangs on how points are chunked."""
    params = _fit(_tracks(), max_iter=1)._params
    run = loop.Run(params, [2.0], loop.EMStatus.CONVERGED)
    broken = run._replace(status=loop.EMStatus.NOT_FINITE, history=[9.0])
    lost = broken._replace(history=[])
    # A relative difference of 64 epsilons is rounding.
    for ends, expected in [((2, 2 + 2**-45), 0), ((2, 2 + 65 * 2**-51), 1), ((2 - 1e-14, 1, 2), 0), ((1, 3, 2), 1)]:
        runs = [run._replace(history=[end, np.nan]) for end in ends]
        assert loop.select_best([broken, *runs]) is runs[expected]
    assert loop.select_best([lost, broken]) is broken
    assert loop.select_best([lost, lost]).log_likelihood == -np.inf


def test_a_fit_continues_with_chunks():
    x = _tracks()
    begun = _fit(x, max_iter=2)
    reached = begun.lower_bound_
    begun.set_params(max_iter=100, start=begun.to_mixture()).fit(np.split(x, CUTS))
    assert begun.converged_
    assert begun.lower_bounds_[0] > reached


def test_variances_are_accurate_far_from_zero():
    x = 1e8 + np.random.default_rng(0).normal(size=(1000, 2)) * [1.0, 1e-3]
    weights = _weights(1000)
    found = summarize_rows(Chunks(np.array_split(x, 77), np.array_split(weights, 77)))
    mean, variance = weighted_moments(x[weights > 0], weights[weights > 0])
    np.testing.assert_allclose(found.mean, mean, rtol=1e-15)
    np.testing.assert_allclose(found.variance, variance, rtol=1e-5)
    assert (found.num_rows, found.size) == (1000, (weights > 0).sum())
    np.testing.assert_allclose(found.total, weights.sum())


# --- what is known of chunks ----------------------------------------------------------------------------------


def test_predictions_of_chunks_equal_those_of_rows():
    x = _tracks()
    fitted, parts = _fit(x), np.split(x, CUTS)
    for name in ("score", "bic", "aic"):
        np.testing.assert_allclose(getattr(fitted, name)(parts), getattr(fitted, name)(x), rtol=1e-12)
    for name in ("score_samples", "predict", "predict_proba"):
        found = list(getattr(fitted, name)(parts))
        assert [len(part) for part in found] == [len(part) for part in parts]
        expected = getattr(fitted, name)(x)
        assert {part.ndim for part in found} == {expected.ndim}
        np.testing.assert_allclose(np.concatenate(found), expected, atol=1e-12)
    labels = FoldedGaussianMixture(**OPTIONS).fit_predict(parts)
    np.testing.assert_array_equal(np.concatenate(list(labels)), fitted.predict(x))


# --- errors ---------------------------------------------------------------------------------------------------

X = _tracks(50)
_NAN = np.where(np.arange(20)[:, None] == 17, np.nan, X[:20])


@pytest.mark.parametrize(
    ("data", "weights", "match"),
    [
        ("once", None, "X: expected chunks that can be read again in each pass, got generator"),
        ([X, X[:, :1]], None, "X, chunk 1: expected 2 columns, got 1"),
        ([X, X[0]], None, "Expected 2D array, got 1D array"),
        ([X, X, _NAN], None, "X, chunk 2 contains NaN"),
        ([X, X.astype(complex)], None, "X, chunk 1: expected real numbers, got complex128"),
        ([X[:, :1]], None, "X: expected at least 2 columns"),
        (_Files([]), None, "X: expected at least one chunk with rows, got none"),
        ([X[:0]], None, "X: expected at least one chunk with rows, got none"),
        ([X[:1]], None, "X: expected at least 2 rows, got 1"),
        ([X[:2]], None, "n_components: expected at most the number of points"),
        ([X, X], [np.ones(50), np.ones(49)], "sample_weight, chunk 1: expected 50 weights, got 49"),
        ([X, X], [np.ones(50)], "sample_weight, chunk 1: expected 50 weights, got 0"),
        ([X], [np.ones(50), np.ones(50)], "sample_weight: expected as many chunks as X, got more"),
        ([X], np.ones(51), "sample_weight, chunk 0: expected 50 weights, got a number"),
        (
            [X, X],
            np.split(np.arange(100) - 70.0, 2),
            "sample_weight, chunk 0: expected finite numbers >= 0, got between -70.0",
        ),
        ([X], [np.zeros(50)], "sample_weight: expected a positive sum, got 0"),
        ([X], 0.5, "sample_weight: expected chunks"),
    ],
)
def test_invalid_chunks_raise(data, weights, match):
    data = (part for part in [X]) if data == "once" else data
    with pytest.raises(ValueError, match=match):
        _fit(data, weights)


def test_rows_that_change_between_passes_raise():
    left = iter([[X, X], [X, X], [X]])  # the first is taken by the check that there are several passes
    with pytest.raises(ValueError, match="X: expected the same rows in each pass, got 100 at first and 50 now"):
        _fit(_Changing(left))


def test_prediction_checks_chunks():
    fitted = _fit(_tracks(), max_iter=1)
    with pytest.raises(ValueError, match="X, chunk 1: expected 2 columns, got 1"):
        fitted.score([X, X[:, :1]])
    with pytest.raises(ValueError, match="X, chunk 0 contains NaN"):
        next(fitted.predict([_NAN]))
    with pytest.raises(ValueError, match="X: expected at least one chunk with rows"):
        fitted.bic(_Files([]))


def test_rows_and_chunks_are_told_apart():
    for rows in (X, X.tolist(), list(X), lambda: [X], [], "text", {"a": X}, None, [[1, 2], [3, 4]], X[None]):
        assert not is_chunked(rows)
    for chunks in ([X], (X, X), _Files([X]), (part for part in [X])):
        assert is_chunked(chunks)


# --- cost -----------------------------------------------------------------------------------------------------


def test_ragged_chunks_share_one_program(monkeypatch):
    traced = []
    sums = loop.accumulate
    monkeypatch.setattr(loop, "accumulate", lambda *args, **options: traced.append(1) or sums(*args, **options))
    for num, cuts in ((N, CUTS), (N, range(3, N, 7)), (N, ()), (450, (449,))):
        _fit(np.split(_tracks(num), cuts), n_init=1, degree=0, max_iter=3)  # a degree that no other test compiles
    assert len(traced) == 1


_PEAK = """
import sys, warnings
import numpy as np
from foldgauss.estimator import FoldedGaussianMixture
from foldgauss.jobs.runner import peak_bytes

warnings.simplefilter("ignore")

class Chunks:
    def __init__(self, num):
        self.num = num

    def __iter__(self):
        for seed in range(self.num):
            t = np.random.default_rng(seed).normal(size=50_000)
            yield np.stack([t**2 + 0.1 * np.cos(99 * t), np.sin(t), t], 1)

peaks = []
for num in (40, 640):
    fitted = FoldedGaussianMixture(2, degree=1, init_params="random_from_data", max_iter=2, random_state=0)
    fitted.fit(Chunks(num))
    fitted.score(Chunks(num))
    peaks.append(peak_bytes())
print(peaks[1] - peaks[0])
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_chunks():
    """600 chunks more, 720 MB: the peak grows by less than a sixth of it (some 60 MB are chance)."""
    pytest.importorskip("resource", reason="needs resource.getrusage")
    done = subprocess.run([sys.executable, "-c", _PEAK], capture_output=True, text=True, timeout=300, check=True)
    assert int(done.stdout) < 120e6
