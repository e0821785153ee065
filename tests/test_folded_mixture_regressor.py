"""The regressor: scikit-learn's checks, linear regression and numerical integration as oracles, coverage, weights."""

import numpy as np
import pytest

pytest.importorskip("sklearn")
from sklearn.linear_model import LinearRegression

from foldgauss import FoldedGaussianMixture, FoldedMixtureRegressor

# Fits need not converge here.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def _regressor(*args, **options):
    return FoldedMixtureRegressor(FoldedGaussianMixture(*args, **options))


def _bent(n, seed=0):
    """Two features of which the first is time, and two targets that bend over it, with noise that grows."""
    rng = np.random.default_rng(seed)
    t = rng.normal(size=n)
    other = 0.5 * t + rng.normal(size=n)
    noise = (0.2 + 0.1 * np.abs(t)) * rng.normal(size=(2, n))
    return np.stack([t, other], 1), np.stack([np.sin(2 * t) + 0.5 * other, t**2], 1) + noise.T


#: One set for nearly all tests: they share its programs.
OPTIONS = {"n_components": 3, "degree": 3, "time_column": 0, "random_state": 0}
LEVELS = [0.1, 0.5, 0.9]


@pytest.fixture(scope="module")
def bent():
    """Fitted to 600 rows of two targets."""
    return _regressor(**OPTIONS).fit(*_bent(600))


# --- scikit-learn -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "used"), [(1, [0, 1, 2]), pytest.param(0, [0, 2], marks=pytest.mark.slow)])
def test_one_linear_component_is_linear_regression(degree, used):
    """Maximum likelihood of a joint Gaussian is least squares; without a fold, on all features but time."""
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 3)) @ rng.normal(size=(3, 3)) + np.array([10.0, -3.0, 0.0])
    y = X @ rng.normal(size=(3, 2)) + rng.normal(size=(200, 2)) + 5
    ours = _regressor(1, degree=degree, time_column=1, reg_covar=0, reg_relative=0).fit(X, y)
    theirs = LinearRegression().fit(X[:, used], y)
    mean, std = ours.predict(X, return_std=True)
    np.testing.assert_allclose(mean, theirs.predict(X[:, used]), rtol=1e-8)
    residual = y - theirs.predict(X[:, used])
    np.testing.assert_allclose(std, np.broadcast_to(np.sqrt((residual**2).mean(0)), std.shape), rtol=1e-8)
    assert ours.score(X, y) == pytest.approx(theirs.score(X[:, used], y), rel=1e-8)
    if degree:  # the median of a single Gaussian
        np.testing.assert_allclose(ours.predict_quantiles(X, 0.5), mean, rtol=1e-9)


# --- the conditional distribution ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("time_column", "options"),
    [
        (0, {}),
        pytest.param(
            -1, {"degree": 1, "envelope": "time_likelihood", "time_column": -1}, marks=pytest.mark.slow, id="last"
        ),
    ],
)
def test_predictions_match_integrals_of_the_joint_density(time_column, options):
    X, y = _bent(600)
    X = X if time_column == 0 else X[:, ::-1]
    regressor = _regressor(**OPTIONS | options).fit(X, y)
    assert regressor.mixture_.time_column == (0 if time_column == 0 else 1)
    grid = np.linspace(-12, 12, 801)
    first, second = np.meshgrid(grid, grid, indexing="ij")
    for x in X[:2]:
        rows = np.column_stack([np.broadcast_to(x, (grid.size**2, 2)), first.ravel(), second.ravel()])
        joint = np.exp(regressor.mixture_.score_samples(rows)).reshape(first.shape)
        mean, std = regressor.predict(x[None], return_std=True)
        quantiles = regressor.predict_quantiles(x[None], LEVELS)
        for j in range(2):
            density = joint.sum(1 - j) / joint.sum()
            expected = (density * grid).sum()
            assert mean[0, j] == pytest.approx(expected, abs=1e-6)
            assert std[0, j] == pytest.approx(np.sqrt((density * (grid - expected) ** 2).sum()), rel=1e-6)
            # Mass below a node's upper edge, by linear interpolation.
            below = np.interp(quantiles[0, j], grid + 0.5 * (grid[1] - grid[0]), np.cumsum(density))
            np.testing.assert_allclose(below, LEVELS, atol=1e-3)


def _calm_and_noisy(n, seed):
    """Two components: a calm parabola before t = 0, a steep noisy line after."""
    rng = np.random.default_rng(seed)
    late = rng.random(n) < 0.5
    t = rng.normal(np.where(late, 1.5, -1.5), 0.5)
    return t[:, None], np.where(late, 2 * t, t**2) + np.where(late, 0.6, 0.1) * rng.normal(size=n)


@pytest.fixture(scope="module")
def calm_and_noisy():
    return _regressor(2, degree=2, random_state=0).fit(*_calm_and_noisy(4000, seed=0))


def test_quantiles_cover_new_data(calm_and_noisy):
    """Of 5,000 new points each, a standard error is 0.0042: a correct interval misses 0.9 by 0.02 once in 500,000."""
    regressor, (t, y) = calm_and_noisy, _calm_and_noisy(10_000, seed=1)
    low, high = regressor.predict_quantiles(t, [0.05, 0.95]).T
    mean, std = regressor.predict(t, return_std=True)
    same = np.abs(y - mean) < 1.645 * np.sqrt((std**2).mean())
    for group in (t[:, 0] < 0, t[:, 0] > 0):
        assert ((y > low) & (y < high))[group].mean() == pytest.approx(0.9, abs=0.02)
        assert (
            abs(same[group].mean() - 0.9) > 0.05
        )  # power: an interval of one width is too wide here, too narrow there


def test_bends_where_a_line_does_not(bent):
    (X, y), (test_X, test_y) = _bent(600), _bent(1000, seed=1)
    assert bent.score(test_X, test_y) > 0.85 > 0.5 > LinearRegression().fit(X, y).score(test_X, test_y)


def test_shapes_and_blocks(bent, calm_and_noisy):
    X, (t, _) = _bent(1100)[0], _calm_and_noisy(1100, seed=0)
    assert calm_and_noisy.predict(t).shape == (1100,)
    assert calm_and_noisy.predict_quantiles(t, 0.5).shape == (1100,)
    assert calm_and_noisy.predict_quantiles(t, [0.1, 0.9]).shape == (1100, 2)
    assert bent.predict(X).shape == (1100, 2)
    assert bent.predict_quantiles(X, LEVELS).shape == (1100, 2, 3)
    np.testing.assert_allclose(bent.predict(X)[-1], bent.predict(X[-1:])[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            lambda X, y, fitted: _regressor(1, time_column=2).fit(X, y),
            "^time_column: expected a column of 2",
        ),  # a target
        (lambda X, y, fitted: _regressor(0).fit(X, y), "'n_components' parameter"),
        (lambda X, y, fitted: fitted.predict_quantiles(X, 0.0), "^quantiles: expected levels between 0 and 1"),
        (lambda X, y, fitted: fitted.predict_quantiles(X, [0.5, 1.0]), "^quantiles: expected levels between 0 and 1"),
        (lambda X, y, fitted: fitted.predict_quantiles(X, np.nan), "^quantiles: expected levels between 0 and 1"),
        (lambda X, y, fitted: FoldedMixtureRegressor().predict_quantiles(X, 0.5), "is not fitted yet"),
    ],
)
def test_invalid_arguments_raise(bent, wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong(*_bent(50), bent)
