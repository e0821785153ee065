"""Laws of scikit-learn's own tests of mixtures, as contracts on FoldedGaussianMixture; and hard units of columns."""

import warnings

import numpy as np
import pytest

pytest.importorskip("sklearn")
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import estimator_checks

from foldgauss.estimator import EMStatus, FoldedGaussianMixture, FoldedMixtureRegressor
from foldgauss.estimator.rows import warn_smooth

# Fits need not converge here.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")

K, N = 3, 300
KINDS = ("full", "tied", "diag", "spherical")
#: Most of a test's time is compilation: one kind is fitted in each run, the others in slow ones.
SOME_KINDS = [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "tied")) for kind in KINDS]
STARTS = ("kmeans", "k-means++", "random", "random_from_data", "trajectories")


def _blobs(seed=0, dtype=np.float64):
    """Three round clusters, far from each other."""
    rng, means = np.random.default_rng(seed), np.array([[0.0, 0, 0], [9, 0, 3], [0, 9, 6]])
    return (means[np.arange(N) % K] + rng.normal(size=(N, 3))).astype(dtype)


def _fit(x, num=K, *, groups=None, **options):
    return FoldedGaussianMixture(num, **({"degree": 1, "random_state": 0} | options)).fit(x, groups=groups)


ESTIMATORS = [
    FoldedGaussianMixture(2, degree=1),
    FoldedGaussianMixture(),
    FoldedMixtureRegressor(FoldedGaussianMixture(2, degree=1, random_state=0)),
    FoldedMixtureRegressor(FoldedGaussianMixture(random_state=0)),
]


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_passes_scikit_learns_checks(estimator):
    """All of them: none is expected to fail."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = estimator_checks.check_estimator(estimator, on_fail=None)
    failed = [r for r in results if r["status"] not in ("passed", "skipped")]
    assert not failed, failed


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize(
    "check",
    ["check_no_attributes_set_in_init", "check_parameters_default_constructible", "check_get_params_invariance",
     "check_estimators_unfitted", "check_fit2d_1sample", "check_fit2d_1feature"],
)  # fmt: skip
def test_passes_quick_checks(estimator, check):
    if check == "check_fit2d_1feature" and isinstance(estimator, FoldedMixtureRegressor):
        pytest.skip("A single feature is the time.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        getattr(estimator_checks, check)(type(estimator).__name__, clone(estimator))


@pytest.mark.parametrize("regression", [False, True])
def test_weights_equal_repetitions(regression):
    x, weights = _blobs(), np.random.default_rng(1).choice(3, N, p=[0.1, 0.6, 0.3])
    mixture = FoldedGaussianMixture(K, degree=1, random_state=0, max_iter=20, tol=0)
    estimator = FoldedMixtureRegressor(mixture) if regression else mixture

    def fit(repeats, **options):
        rows = np.repeat(x, repeats, axis=0)
        fitted = clone(estimator).fit(*((rows[:, :2], rows[:, 2:]) if regression else (rows,)), **options)
        return getattr(fitted, "mixture_", fitted)

    weighted, repeated, plain = fit(1, sample_weight=weights), fit(weights), fit(1)
    for name in ("weights_", "means_", "covariances_", "lower_bound_"):
        np.testing.assert_allclose(getattr(weighted, name), getattr(repeated, name), rtol=1e-7, atol=1e-9)
    assert not np.allclose(weighted.means_, plain.means_, rtol=1e-3)  # power


@pytest.mark.parametrize("kind", SOME_KINDS)
@pytest.mark.parametrize("envelope", [pytest.param("constant", marks=pytest.mark.slow), "time_likelihood"])
def test_likelihood_never_decreases(kind, envelope):
    options = {"reg_covar": 0, "reg_relative": 0, "tol": 0, "max_iter": 40, "init_params": "random"}
    bounds = _fit(_blobs(), degree=2, covariance_type=kind, envelope=envelope, **options).lower_bounds_
    assert len(bounds) == 40
    assert np.diff(bounds).min() > -1e-9
    assert bounds[-1] > bounds[0] + 0.1


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_start_gives_distinct_means_inside_the_data_in_its_dtype(start, dtype):
    x = _blobs(dtype=dtype)
    fitted, again = (_fit(x, init_params=start, max_iter=300) for _ in range(2))
    assert fitted.converged_
    assert (x.min(0) <= fitted.means_).all()
    assert (fitted.means_ <= x.max(0)).all()
    assert len(np.unique(fitted.means_.round(3), axis=0)) == K
    assert fitted.weights_.sum() == pytest.approx(1, rel=1e-6)
    for name in ("weights_", "means_", "covariances_", "precisions_", "locs_", "fold_coefficients_"):
        assert getattr(fitted, name).dtype == dtype
        np.testing.assert_array_equal(getattr(fitted, name), getattr(again, name))
    for method in ("score_samples", "predict_proba"):
        assert getattr(fitted, method)(x).dtype == dtype
    np.testing.assert_allclose(fitted.predict_proba(x).sum(1), 1, rtol=1e-5)


@pytest.mark.parametrize(("max_iter", "tol"), [(2, 1e-7), (300, 1e-1)])
def test_fit_predict_equals_fit_then_predict(max_iter, tol):
    x = _blobs()
    fitted = _fit(x, max_iter=max_iter, tol=tol, n_init=3)
    labels = FoldedGaussianMixture(**fitted.get_params()).fit_predict(x)
    np.testing.assert_array_equal(labels, fitted.predict(x))
    np.testing.assert_array_equal(labels, fitted.predict_proba(x).argmax(1))
    assert fitted.n_iter_ <= max_iter


def test_criteria_of_one_component_in_one_dimension_do_not_depend_on_the_kind():
    x = np.random.default_rng(0).normal(size=(100, 2))
    values = [(m.bic(x), m.aic(x)) for m in (_fit(x, 1, covariance_type=kind) for kind in KINDS)]
    np.testing.assert_allclose(values, values[:1] * len(KINDS), rtol=1e-9)


@pytest.mark.parametrize("kind", SOME_KINDS)
def test_samples_of_each_component_have_its_moments(kind):
    fitted = _fit(_blobs(), degree=2, covariance_type=kind)
    x, labels = fitted.sample(20_000)
    for k in range(K):
        mine = x[labels == k]
        # Six standard errors: a false alarm in 1e7 draws.
        np.testing.assert_allclose(len(mine) / 20_000, fitted.weights_[k], atol=6 * np.sqrt(0.25 / 20_000))
        spread = np.sqrt(np.diagonal(fitted.covariances_[k]))
        assert (np.abs(mine.mean(0) - fitted.means_[k]) < 6 * spread / np.sqrt(len(mine))).all()
        np.testing.assert_allclose(np.cov(mine.T), fitted.covariances_[k], atol=0.15)
    assert [fitted.sample(n)[0].shape for n in (1, 2, 99)] == [(1, 3), (2, 3), (99, 3)]
    with pytest.raises(ValueError, match="n_samples"):
        fitted.sample(0)


@pytest.mark.parametrize("kind", SOME_KINDS)
def test_initial_values_are_checked_and_kept(kind):
    shape = {"full": (K, 3, 3), "tied": (3, 3), "diag": (K, 3), "spherical": (K,)}[kind]
    good = np.broadcast_to(np.eye(3), shape) if kind in ("full", "tied") else np.ones(shape)
    bad = [
        ("weights_init", np.full((K, 1), 1 / K)),
        ("weights_init", np.full(K, 1.0)),
        ("weights_init", [2, -0.5, -0.5]),
    ]
    bad += [("means_init", np.zeros((K + 1, 3))), ("precisions_init", -good), ("precisions_init", np.ones(7))]
    for name, value in bad:
        with pytest.raises(ValueError, match=name):
            _fit(_blobs(), covariance_type=kind, **{name: value})
    means = np.array([[0.0, 1, 2], [9, 1, 2], [0, 8, 7]])
    start = _fit(_blobs(), covariance_type=kind, max_iter=0, means_init=means, weights_init=[0.5, 0.25, 0.25])
    np.testing.assert_allclose(start.means_, means, atol=1e-12)
    np.testing.assert_allclose(start.weights_, [0.5, 0.25, 0.25])
    assert (start.n_iter_, start.converged_) == (0, False)


def test_a_diverging_start_sets_all_attributes():
    """Precisions of 1e6 on a uniform cloud: most densities underflow."""
    x = np.random.default_rng(0).uniform(size=(30, 3))
    options = {"covariance_type": "spherical", "means_init": x[:6], "precisions_init": np.logspace(6, 1, 6)}
    fitted = _fit(x, 6, max_iter=1, reg_covar=0, reg_relative=0, **options)
    assert not fitted.converged_
    for name in ("weights_", "means_", "covariances_", "n_iter_", "lower_bound_", "lower_bounds_"):
        assert np.isfinite(getattr(fitted, name)).all()


def test_one_component_is_fitted_to_three_rows():
    x = np.random.default_rng(0).normal(size=(3, 2))
    assert np.isfinite(_fit(x, 1).sample()[0]).all()


# --- units of columns ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("units", [(1, 1, 1e-15), (1, 1, 1e15), (1e-15, 1, 1), (1e-25,) * 3, (1e20,) * 3])
def test_fits_in_extreme_units_are_finite(dtype, units):
    x = (np.random.default_rng(0).normal(size=(200, 3)) * np.array(units)).astype(dtype)
    for rows in (x, [x[:90], x[90:]]):
        fitted = _fit(rows, 2, degree=3)
        for name in ("means_", "covariances_", "fold_coefficients_"):
            assert np.isfinite(getattr(fitted, name)).all()
        assert np.isfinite(fitted.score(rows))


@pytest.mark.parametrize("column", [0, 2])
@pytest.mark.parametrize("constant", [False, True])
def test_units_out_of_range_name_the_column(column, constant):
    x = np.random.default_rng(0).normal(size=(50, 3))
    x[:, column] = 1e200 if constant else 1e200 * x[:, column]
    with pytest.raises(ValueError, match=f"^X: expected .*column {column}.*Divide it"):
        _fit(x, 1)


@pytest.mark.parametrize("value", [0.0, 1e-300, 1e-15, 1e15])
def test_constant_columns_are_fitted(value):
    x = np.random.default_rng(0).normal(size=(50, 3))
    for column in (0, 2):
        x[:, column] = value
        assert _fit(x, 1).status_ == EMStatus.CONVERGED


# --- groups of dependent rows -------------------------------------------------------------------------------


def _demonstrations(seed, num):
    """Smooth, noise-free curves (t, x, y) of one letter, warped in time and space; and the curve of each row."""
    rng, u = np.random.default_rng(seed), np.linspace(0, 1, 120)
    curves = []
    for _ in range(num):
        warped = u + 0.03 * rng.normal() * np.sin(np.pi * u)
        loops = np.stack([np.sin(2 * np.pi * warped), np.cos(3 * np.pi * warped)], 1)
        bend = sum(0.08 * rng.normal(size=2) * np.cos(j * np.pi * u)[:, None] for j in range(3))
        curves.append(np.column_stack([u * (1 + 0.1 * rng.normal()), loops + bend]))
    return np.concatenate(curves), np.repeat(np.arange(num), len(u))


def test_groups_keep_components_from_collapsing_onto_one_curve():
    (x, groups), (held, _) = _demonstrations(0, 5), _demonstrations(1, 5)
    with pytest.warns(UserWarning, match="smooth curves.*groups") as told:
        plain = FoldedGaussianMixture(12, degree=3, time_column=0, random_state=0).fit(x)
    assert told[0].filename == __file__
    grouped = _fit(x, 12, degree=3, time_column=0, groups=groups)
    assert plain.score(held) < grouped.score(held) - 2
    with pytest.warns(ConvergenceWarning, match=r"of 12 components are as narrow as the gap.*Lower n_components"):
        FoldedGaussianMixture(12, degree=3, time_column=0, random_state=0).fit(x, groups=groups)


@pytest.mark.parametrize(
    "kind",
    ["independent", "sorted by time", "narrow and sorted", "random walk", "noisy curves", "rounded", "grid", "huge"],
)
def test_rows_that_are_no_smooth_curves_do_not_warn(kind, recwarn):
    rng = np.random.default_rng(0)
    t, noise = rng.uniform(size=(600, 1)), rng.normal(size=(600, 2))
    x = {
        "independent": np.hstack([noise, t]),
        "sorted by time": np.hstack([noise, np.sort(t, 0)]),
        "narrow and sorted": np.hstack([np.sin(6 * np.sort(t, 0)) + 1e-6 * noise, np.sort(t, 0)]),
        "random walk": np.hstack([noise.cumsum(0), np.linspace(0, 1, 600)[:, None]]),
        "noisy curves": _demonstrations(0, 5)[0] + 0.02 * rng.normal(size=(600, 3)),
        "rounded": np.column_stack([np.round(0.4 * noise), np.arange(600.0)]),
        "grid": np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3),
        "huge": np.hstack([1e200 * noise, t]),
    }[kind]
    warn_smooth(x)
    assert not recwarn


@pytest.mark.slow
def test_automatic_choice_with_groups_generalizes():
    (x, groups), (held, _) = _demonstrations(0, 8), _demonstrations(1, 5)
    with pytest.warns(UserWarning, match="smooth curves.*groups"):
        plain = _fit(x, "auto", degree="auto", max_components=20, time_column=0)
    grouped = _fit(x, "auto", degree="auto", max_components=20, time_column=0, groups=groups)
    assert len(grouped.weights_) < len(plain.weights_)
    assert grouped.score(held) > plain.score(held) + 2


def test_criteria_count_groups():
    x, groups = _demonstrations(0, 5)
    fitted = _fit(x, 1, time_column=0)
    penalty = fitted._n_parameters()
    assert fitted.bic(x, groups) == pytest.approx(-10 * fitted.score(x) + penalty * np.log(5))
    assert fitted.aic(x, groups) == pytest.approx(-10 * fitted.score(x) + penalty * 2)


@pytest.mark.parametrize("num", [50, 70])
def test_groups_of_a_weighted_regression_are_one_per_row(num):
    x = _blobs()[:60]
    with pytest.raises(ValueError, match=r"^groups: expected shape \(60,\)"):
        FoldedMixtureRegressor(FoldedGaussianMixture(2)).fit(x[:, :1], x[:, 1], np.ones(60), np.arange(num) // 5)


@pytest.mark.parametrize(
    ("rows", "groups"),
    [
        ("array", [0]),
        ("array", np.zeros(N)),
        ("array", np.array(["a", None] * (N // 2), object)),
        ("chunks", np.arange(N)),
    ],
)
def test_invalid_groups_raise(rows, groups):
    x = _blobs()
    with pytest.raises(ValueError, match=r"^groups: expected"):
        _fit([x[:100], x[100:]] if rows == "chunks" else x, 1, groups=groups)
