"""The estimator: scikit-learn's checks and laws, its GaussianMixture as oracle, known mixtures, hard data and units."""

import itertools
import os
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from scipy import stats

pytest.importorskip("sklearn")
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning, NotFittedError
from sklearn.mixture import GaussianMixture
from sklearn.utils import estimator_checks

from foldgauss import FoldedGaussian, FoldedMixture, PolynomialFold
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.estimator import EMStatus, FoldedGaussianMixture, FoldedMixtureRegressor
from foldgauss.estimator.likelihood import fit
from foldgauss.estimator.rows import warn_smooth

# Fits need not converge here.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")

K, N = 3, 300
#: Three crossing curves, s = sum_j c_j t^j.
CURVES = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [0.5, 3.0, -9.0, 6.0]])


def _blobs(seed=0, n=N):
    rng = np.random.default_rng(seed)
    means, factors = rng.normal(size=(K, 3)) * 3, rng.normal(size=(K, 3, 3))
    labels = np.arange(n) % K
    return means[labels] + np.einsum("nij,nj->ni", factors[labels], rng.normal(size=(n, 3)))


def _tracks(n=N, seed=0, noise=0.03):
    rng = np.random.default_rng(seed)
    labels, t = np.arange(n) % 3, rng.normal(0.5, 0.25, n)
    s = (CURVES[labels] * t[:, None] ** np.arange(4)).sum(1) + rng.normal(size=n) * noise
    return np.stack([s, t], 1), labels


def _start(means, precisions, weights=(1 / K,) * K, degree=1):
    """Joint Gaussians, time last, as a mixture of Folded-Gaussians with linear folds."""
    covariances = np.linalg.inv(precisions)
    slope = covariances[:, :-1, -1] / covariances[:, -1:, -1]
    within = covariances[:, :-1, :-1] - slope[:, :, None] * covariances[:, None, :-1, -1]
    with jax.enable_x64(True):
        parts = {"time_loc": means[:, -1], "time_scale": np.sqrt(covariances[:, -1, -1])}
        fold = PolynomialFold(-slope[:, None][:, :degree])
        components = FoldedGaussian(means[:, :-1], np.linalg.cholesky(within), **parts, fold=fold, envelope=Constant())
        return FoldedMixture(components, weights=np.asarray(weights, float))


def _same_partition(one, other) -> float:
    """Share of points on which two labelings agree, up to names."""
    table = np.array([[np.sum((one == i) & (other == j)) for j in range(K)] for i in range(K)])
    return max(sum(table[i, p[i]] for i in range(K)) for p in itertools.permutations(range(K))) / len(one)


# --- scikit-learn -------------------------------------------------------------------------------------------


def test_an_initial_weight_may_be_0():
    """Without a warning of NumPy's, which is an error here; the component is reset."""
    start = _start(_blobs()[:2], np.tile(np.eye(3), (2, 1, 1)), [1.0, 0.0])
    fitted = FoldedGaussianMixture(2, degree=1, start=start).fit(_blobs())
    assert (fitted.weights_ > 0).all()


@pytest.mark.parametrize(
    ("kind", "degree", "time"), [("full", 1, 0), pytest.param("diag", 0, -1, marks=pytest.mark.slow)]
)
def test_linear_folds_match_scikit_learn(kind, degree, time):
    """A linear fold is a full covariance, no fold a diagonal one: the same start, the same iterations."""
    x = _blobs() + np.array([100.0, -5.0, 3.0])
    full = np.tile(np.eye(3) * 0.1, (K, 1, 1))
    precisions = {"full": full, "diag": np.full((K, 3), 0.1)}[kind]
    same = {"covariance_type": kind, "reg_covar": 0, "tol": 0, "max_iter": 30}
    initial = {"means_init": x[:K], "weights_init": np.full(K, 1 / K), "precisions_init": precisions}
    theirs = GaussianMixture(K, **same, **initial).fit(x)
    start = _start(np.roll(x[:K], -1, 1) if time == 0 else x[:K], full, degree=degree)
    ours = FoldedGaussianMixture(K, degree=degree, reg_relative=0, time_column=time, start=start, **same).fit(x)
    close = {"rtol": 1e-6, "atol": 1e-8}
    covariances = theirs.covariances_ if kind == "full" else theirs.covariances_[:, :, None] * np.eye(3)
    for name in ("weights_", "means_", *(("precisions_", "precisions_cholesky_") if kind == "full" else ())):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(ours.covariances_, covariances, **close)
    np.testing.assert_allclose(ours.lower_bound_, theirs.lower_bound_, rtol=1e-9)
    np.testing.assert_allclose(ours.score_samples(x), theirs.score_samples(x), **close)
    np.testing.assert_allclose(ours.predict_proba(x), theirs.predict_proba(x), rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose([ours.bic(x), ours.aic(x)], [theirs.bic(x), theirs.aic(x)], rtol=1e-8)
    assert (ours.n_iter_, ours.converged_) == (theirs.n_iter_, theirs.converged_)


@pytest.mark.parametrize(
    ("kind", "degree"),
    [
        *(pytest.param(*case, marks=pytest.mark.slow) for case in [("full", 1), ("spherical", 2), ("diag", 0)]),
        ("tied", 2),
    ],
)
def test_covariances_are_of_their_kind_and_precisions_their_inverses(kind, degree):
    """Each component of a start has its own covariance; those of a fit are of its kind all the same."""
    x, mixture = _blobs(), FoldedGaussianMixture(K, degree=degree, covariance_type=kind, time_column=1, random_state=0)
    fitted = mixture.fit(x)
    assert fitted.precisions_.shape == fitted.precisions_cholesky_.shape == (K, 3, 3)
    np.testing.assert_allclose(fitted.precisions_ @ fitted.covariances_, np.tile(np.eye(3), (K, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(
        fitted.precisions_cholesky_ @ fitted.precisions_cholesky_.swapaxes(1, 2), fitted.precisions_, rtol=1e-9
    )
    np.testing.assert_array_equal(np.tril(fitted.precisions_cholesky_, -1), 0)
    # Whatever their kind, their sizes are those of the residuals, as far as EM has converged.
    powers = (fitted.time_means_ - x[:, 1:2])[:, :, None] ** np.arange(1, degree + 1)
    centers = fitted.locs_ + np.einsum("nkj,kjd->nkd", powers, fitted.fold_coefficients_)
    squares = ((x[:, None, [0, 2]] - centers) ** 2).sum(-1)
    sizes = np.trace(fitted.space_covariances_, axis1=1, axis2=2)
    assert (fitted.predict_proba(x) * squares).sum(1).mean() == pytest.approx(fitted.weights_ @ sizes, rel=0.02)
    free = 3 * K - 1 + K * 2 * (1 + degree) + {"full": 3 * K, "tied": 3, "diag": 2 * K, "spherical": K}[kind]
    assert fitted.bic(x) == pytest.approx(-2 * N * fitted.score(x) + np.log(N) * free, rel=1e-12)
    means = np.stack([x[k::K].mean(0) for k in range(K)])[:, [0, 2, 1]]
    start = _start(means, [np.linalg.inv(np.cov(x[k::K, [0, 2, 1]].T)) for k in range(K)], degree=min(degree, 1))
    given = mixture.set_params(start=start).fit(x).space_covariances_
    is_tied, is_diagonal, is_round = (
        np.allclose(given, z, rtol=1e-9, atol=1e-12)
        for z in (given[:1], given * np.eye(2), given[:, :1, :1] * np.eye(2))
    )
    assert (is_tied, is_diagonal, is_round) == (kind == "tied", kind in ("diag", "spherical"), kind == "spherical")


def test_transform_names_responsibilities():
    """As `LatentDirichletAllocation.transform`; `set_output` is among scikit-learn's checks."""
    x = _blobs()
    fitted = FoldedGaussianMixture(K, degree=1, random_state=0).fit(x)
    names = [f"foldedgaussianmixture{k}" for k in range(K)]
    assert fitted.get_feature_names_out().tolist() == names
    np.testing.assert_array_equal(fitted.transform(x), fitted.predict_proba(x))
    with pytest.raises(ValueError, match="X: expected rows, got chunks"):
        fitted.transform([x, x])
    with pytest.raises(NotFittedError):
        FoldedGaussianMixture().get_feature_names_out()


def test_to_mixture_samples_conditions_in_the_users_columns():
    """Time may be any column; what is fitted is the same."""
    x = _blobs()
    last = FoldedGaussianMixture(K, degree=1, random_state=0).fit(x)
    first = FoldedGaussianMixture(K, degree=1, random_state=0, time_column=0).fit(x[:, [2, 0, 1]])
    np.testing.assert_allclose(first.means_, last.means_[:, [2, 0, 1]], rtol=1e-6)
    np.testing.assert_allclose(first.covariances_, last.covariances_[:, [2, 0, 1]][:, :, [2, 0, 1]], rtol=1e-6)
    np.testing.assert_allclose(first.score_samples(x[:, [2, 0, 1]]), last.score_samples(x), rtol=1e-6)
    np.testing.assert_allclose(
        last.to_mixture().log_prob(jnp.asarray(x, jnp.float32)), last.score_samples(x), atol=1e-4
    )
    draws, _ = first.sample(2000)
    error = draws.std(0) / np.sqrt(2000)
    assert (np.abs(draws.mean(0) - x[:, [2, 0, 1]].mean(0)) < 5 * error).all()
    here = first.condition(0, 0.3)
    np.testing.assert_allclose(here.mean, last.to_mixture().condition_time(0.3).mean, rtol=1e-4)


# --- recovery -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_crossing_tracks_are_found():
    x, labels = _tracks()
    fitted = FoldedGaussianMixture(K, degree=3, init_params="trajectories", annealing=0.1, random_state=0).fit(x)
    assert fitted.converged_
    assert _same_partition(fitted.predict(x), labels) > 0.75  # they cross where most points are
    t = np.linspace(0.2, 0.8, 5)
    u = fitted.time_means_[:, None] - t
    powers = u[:, :, None] ** np.arange(1, 4)
    center = fitted.locs_[:, :1] + np.einsum("ktj,kj->kt", powers, fitted.fold_coefficients_[:, :, 0])
    truth = CURVES @ (t[None] ** np.arange(4)[:, None])
    nearest = np.abs(center[:, None] - truth[None]).max(-1)
    assert (nearest.min(0) < 0.03).all()  # 0.03 is the noise of one point
    assert sorted(nearest.argmin(1)) == [0, 1, 2]
    np.testing.assert_allclose(np.sqrt(fitted.space_covariances_.ravel()), 0.03, rtol=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("start", ["kmeans", "random_from_data"])
def test_annealing_finds_the_best_optimum(start):
    """Groups of neighbors, where tracks cross: from heat on, every start ends at the same best."""
    x, labels = _tracks()
    plain, heated = (
        [
            FoldedGaussianMixture(K, degree=3, annealing=heat, init_params=start, random_state=seed).fit(x)
            for seed in range(6)
        ]
        for heat in (1.0, 0.1)
    )
    bounds = np.array([fitted.lower_bound_ for fitted in heated])
    np.testing.assert_allclose(bounds, bounds.max(), atol=2e-3)
    assert sum(fitted.lower_bound_ < bounds.min() - 0.1 for fitted in plain) >= 2
    assert all(fitted.lower_bound_ < bounds.min() + 2e-3 for fitted in plain)
    truth = max(_same_partition(fitted.predict(x), labels) for fitted in plain)
    assert min(_same_partition(fitted.predict(x), labels) for fitted in heated) > truth - 0.02


@pytest.mark.slow
def test_annealing_ends_at_temperature_one():
    """Plain EM from its end hardly moves."""
    x, _ = _tracks()
    options = {"degree": 3, "random_state": 0}
    fitted = FoldedGaussianMixture(K, annealing=0.1, **options).fit(x)
    bound = fitted.lower_bound_
    again = fitted.set_params(start=fitted.to_mixture(), annealing=1.0).fit(x)
    assert abs(again.lower_bound_ - bound) < 1e-2
    cut = FoldedGaussianMixture(K, annealing=0.1, max_iter=10, **options).fit(x)
    assert cut.status_ == EMStatus.NOT_CONVERGED


@pytest.mark.slow
def test_annealed_components_separate_before_a_fit_converges():
    """On two concentric rings all components coincide when temperature 1 is reached."""
    rng = np.random.default_rng(0)
    angles, radii = rng.uniform(0, 2 * np.pi, 500), rng.choice([1.0, 2.0], 500) + 0.05 * rng.normal(size=500)
    x = np.stack([radii * np.cos(angles), radii * np.sin(angles)], 1)
    fitted = FoldedGaussianMixture(K, annealing=0.1, random_state=0).fit(x)
    assert scipy.spatial.distance.pdist(fitted.means_).min() > 0.1


@pytest.mark.slow
def test_auto_finds_components_and_powers():
    x, _ = _tracks(1500)
    fitted = FoldedGaussianMixture(random_state=0, init_params="trajectories", max_components=6).fit(x)
    assert len(fitted.weights_) == 3
    assert sorted(fitted.degrees_) == [1, 1, 3]
    full = FoldedGaussianMixture(6, degree=3, random_state=0, init_params="trajectories").fit(x)
    assert fitted.bic(x) < full.bic(x)


@pytest.mark.slow
def test_recovers_a_folded_mixture_with_an_envelope():
    """Draws from a known mixture whose spread shrinks away from its time; up to labels."""
    from foldgauss import FoldedGaussian, PolynomialFold
    from foldgauss.mixture import FoldedMixture

    envelope = TimeLikelihood(1.0, 1e-2)
    truth = FoldedMixture(
        FoldedGaussian(
            [[0.0, 0.0], [6.0, 0.0], [0.0, 6.0]],
            scale=[[0.5, 0.4], [0.3, 0.6], [0.4, 0.4]],
            time_loc=[0.0, 1.0, 2.0],
            time_scale=[0.5, 0.7, 0.6],
            fold=PolynomialFold(jnp.array([[[1.0, 0.0]], [[0.0, 1.0]], [[1.0, -1.0]]])),
            envelope=envelope,
        ),
        weights=[0.5, 0.3, 0.2],
    )
    x = np.asarray(truth.sample(jax.random.key(0), (3000,)))
    fitted = FoldedGaussianMixture(K, degree=1, envelope=envelope, tol=1e-5, max_iter=300, random_state=0).fit(x)
    order = np.argsort(fitted.time_means_)
    np.testing.assert_allclose(fitted.weights_[order], [0.5, 0.3, 0.2], atol=0.03)
    np.testing.assert_allclose(fitted.time_means_[order], [0.0, 1.0, 2.0], atol=0.1)
    np.testing.assert_allclose(fitted.time_scales_[order], [0.5, 0.7, 0.6], rtol=0.1)
    np.testing.assert_allclose(fitted.locs_[order], [[0, 0], [6, 0], [0, 6]], atol=0.1)
    np.testing.assert_allclose(fitted.fold_coefficients_[order, 0], [[1, 0], [0, 1], [1, -1]], atol=0.15)
    assert fitted.score(x) > float(truth.log_prob(jnp.asarray(x)).mean())  # a maximum is above the truth


def test_float32_far_from_zero():
    x = _blobs()
    near = FoldedGaussianMixture(K, degree=1, random_state=0, max_iter=30, tol=0).fit(x)
    far = FoldedGaussianMixture(K, degree=1, random_state=0, max_iter=30, tol=0).fit((x + 1e4).astype(np.float32))
    order, other = (np.argsort(f.means_[:, 0]) for f in (near, far))
    assert far.covariances_.dtype == np.float32
    variances = [np.diagonal(f.covariances_[o], axis1=1, axis2=2) for f, o in ((near, order), (far, other))]
    np.testing.assert_allclose(*variances, rtol=0.01)


# --- hard data, wrong words ---------------------------------------------------------------------------------


def test_degenerate_data_give_finite_parameters():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(N, 3))
    constant = np.concatenate([x[:, :1], np.full((N, 1), 7.0), x[:, 2:]], 1)
    still = np.concatenate([x[:, :2], np.full((N, 1), 7.0)], 1)
    duplicates = np.repeat(x[:2], N // 2, axis=0)  # two places, three components
    ends = [({}, EMStatus.CONVERGED), ({"reg_covar": 0, "reg_relative": 0}, EMStatus.SINGULAR)]
    for data in (constant, still, duplicates):
        for floors, status in ends:
            fitted = FoldedGaussianMixture(K, degree=1, random_state=0, **floors).fit(data)
            assert fitted.status_ == status
            assert fitted.converged_ == (status == EMStatus.CONVERGED)
            assert np.isfinite(fitted.score_samples(data)).all()
            assert np.isfinite(fitted.covariances_).all()


@pytest.mark.parametrize(
    ("match", "data", "options"),
    [
        ("NaN", np.array([[0.0, np.nan], [1, 2], [3, 4]]), {}),
        ("infinity", np.array([[0.0, np.inf], [1, 2], [3, 4]]), {}),
        ("minimum of 2", np.zeros((0, 3)), {}),
        ("n_samples = 1|minimum of 2", np.zeros((1, 3)), {}),
        ("n_components", np.zeros((2, 3)), {"n_components": 3}),
        ("degree", np.zeros((5, 3)), {"degree": -1}),
        ("covariance_type", np.zeros((5, 3)), {"covariance_type": "banded"}),
        ("init_params", np.zeros((5, 3)), {"init_params": "magic"}),
        ("envelope", np.zeros((5, 3)), {"envelope": 3}),
        ("time_column", np.zeros((5, 3)), {"time_column": 3}),
        ("annealing", np.zeros((5, 3)), {"annealing": 0.0}),
        ("devices", np.zeros((5, 3)), {"devices": 1000}),
        ("start", _blobs(), {"start": "here"}),
        ("start", _blobs(), {"start": _start(np.zeros((K, 2)), np.tile(np.eye(2), (K, 1, 1)))}),
        ("start", np.add(_blobs(), [0, 0, 1e9]), {"start": _start(np.zeros((K, 3)), np.tile(np.eye(3), (K, 1, 1)))}),
        ("start", _blobs(), {"n_components": 2, "start": _start(np.zeros((K, 3)), np.tile(np.eye(3), (K, 1, 1)))}),
        ("start", _blobs(), {"degree": 0, "start": _start(np.zeros((1, 3)), np.eye(3)[None], [1.0])}),
        ("verbose", np.zeros((5, 3)), {"verbose": -1}),
        ("time_column", np.zeros((5, 3)), {"time_column": True}),
    ],
)
def test_invalid_arguments_raise(match, data, options):
    with pytest.raises(ValueError, match=match):
        FoldedGaussianMixture(**({"n_components": 1, "degree": 1} | options)).fit(data)


def test_no_convergence_warns():
    with pytest.warns(ConvergenceWarning, match="NOT_CONVERGED"):
        fitted = FoldedGaussianMixture(K, degree=1, max_iter=2, tol=0, random_state=0).fit(_blobs())
    assert not fitted.converged_
    assert fitted.status_ == EMStatus.NOT_CONVERGED


# --- devices ------------------------------------------------------------------------------------------------

_SHARDED = """
import numpy as np, warnings
warnings.simplefilter("ignore")
from foldgauss.estimator import FoldedGaussianMixture
x = np.random.default_rng(0).normal(size=(1001, 3)) * [1, 2, 3]
options = {"degree": 2, "envelope": "time_likelihood", "max_iter": 10, "tol": 0, "random_state": 0}
fits = [FoldedGaussianMixture(3, devices=k, **options).fit(x) for k in (1, 4)]
for name in ("weights_", "means_", "covariances_", "lower_bounds_"):
    np.testing.assert_allclose(*(getattr(f, name) for f in fits), rtol=1e-7, atol=1e-9)
"""


@pytest.mark.slow
def test_same_on_one_and_on_four_devices():
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=4", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", _SHARDED], env=environment, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_normalized_weights_prune_alike():
    rng = np.random.default_rng(0)
    t = rng.normal(size=300)
    x = np.stack([2 * t + 0.1 * rng.normal(size=300), t], 1)
    for weights in (None, np.full(300, 1 / 300)):
        fitted = FoldedGaussianMixture(max_components=4, random_state=0).fit(x, sample_weight=weights)
        assert fitted.degrees_.tolist() == [1]


@pytest.mark.slow
def test_degrees_of_a_constant_column_and_of_exact_data():
    rng = np.random.default_rng(0)
    t = rng.normal(size=300)
    for column in (np.full(300, 3.0), 2 * t):
        x = np.stack([2 * t + 0.1 * rng.normal(size=300), column, t], 1)
        assert FoldedGaussianMixture(1, max_degree=2, random_state=0).fit(x).degrees_.tolist() == [1]


@pytest.mark.parametrize("chunked", [False, True])
def test_a_fit_continues_from_a_mixture(chunked):
    x = _blobs()
    rows, options = [x[:90], x[90:]] if chunked else x, {"degree": 1, "random_state": 0, "tol": 1e-4}
    whole = FoldedGaussianMixture(K, max_iter=200, **options).fit(x)
    parts = FoldedGaussianMixture(K, max_iter=5, **options)
    bounds = []
    for _ in range(40):
        bounds += parts.fit(rows).lower_bounds_
        if parts.converged_:
            break
        with jax.enable_x64(True):
            parts.set_params(start=parts.to_mixture())
    assert bounds == pytest.approx(whole.lower_bounds_, rel=1e-9)
    assert len(bounds) > 5  # it did need to go on
    cold = FoldedGaussianMixture(K, max_iter=5, **options).fit(x)
    assert cold.fit(x).lower_bounds_ == pytest.approx(whole.lower_bounds_[:5], rel=1e-9)


def test_verbose_prints_each_iteration(capsys):
    FoldedGaussianMixture(K, degree=1, max_iter=3, tol=0, random_state=0).fit(_blobs())
    assert capsys.readouterr().out == ""
    fitted = FoldedGaussianMixture(K, degree=1, max_iter=3, tol=0, random_state=0, verbose=1).fit(_blobs())
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["iteration 1", "iteration 2", "iteration 3"]
    told = [float(line.partition("[")[2].partition("]")[0]) for line in lines]
    np.testing.assert_allclose(np.diff(told), np.diff(fitted.lower_bounds_), atol=1e-5)


def test_sums_of_many_points_are_in_float64():
    x = _blobs().astype(np.float32)
    fitted = FoldedGaussianMixture(K, degree=1, max_iter=2, random_state=0).fit(x)
    each = fitted.score_samples(x)
    assert each.dtype == np.float32
    assert fitted.score(x) == each.astype(np.float64).mean()
    penalty = fitted._n_parameters()
    assert fitted.bic(x) == pytest.approx(-2 * each.astype(np.float64).sum() + penalty * np.log(N), rel=1e-14)
    assert fitted.aic(x) == pytest.approx(-2 * each.astype(np.float64).sum() + 2 * penalty, rel=1e-14)


@pytest.mark.parametrize("degree", [pytest.param(degree, marks=pytest.mark.slow) for degree in (4, 6, 10)])
def test_float32_fits_high_degrees(degree):
    """Times in two heaps, for which Hermite polynomials are nearly dependent: as good as NumPy's least squares."""
    rng = np.random.default_rng(0)
    t = rng.normal(np.repeat([0.0, 1.0], 250), 0.1)
    x = np.stack([np.sin(9 * t) + 0.01 * rng.normal(size=500), t], 1)
    curve = np.polynomial.Polynomial.fit(t, x[:, 0], degree)
    residual = x[:, 0] - curve(t)
    best = (stats.norm.logpdf(residual, 0, residual.std()) + stats.norm.logpdf(t, t.mean(), t.std())).mean()
    x = x.astype(np.float32)
    single = FoldedGaussianMixture(1, degree=degree, tol=1e-6).fit(x)
    assert single.fold_coefficients_.dtype == (np.float32 if degree <= 6 else np.float64)
    assert single.score(x) == pytest.approx(best, abs=1e-3)
    at = np.quantile(t, np.linspace(0.05, 0.95, 7))
    powers = (single.time_means_[0] - at)[:, None] ** np.arange(1, degree + 1)
    np.testing.assert_allclose(single.locs_[0, 0] + powers @ single.fold_coefficients_[0, :, 0], curve(at), atol=2e-3)


def test_times_too_coarse_for_float32_are_refused_or_counted_from_an_origin():
    fits = FoldedGaussianMixture(K, degree=1, random_state=0)
    fits.fit(_blobs() + np.array([0, 0, 1e3])).to_mixture()  # a spacing of 6e-5; warnings are errors
    far = fits.fit(_blobs() + np.array([0, 0, 1e6]))
    with pytest.raises(ValueError, match=r"times.*float32.*time_origin=\d+.*Subtract an offset"):
        far.to_mixture()
    with pytest.raises(ValueError, match="Subtract an offset"):
        far.condition(0, 0.0)  # time is left over
    time = float(far.time_means_[0])
    with pytest.raises(ValueError, match="values: expected finite"):
        far.condition(-1, np.nan)
    near = far.to_mixture(time_origin=1e6).condition_time(time - 1e6).mean
    np.testing.assert_allclose(near, far.condition(-1, time).mean, rtol=1e-3)
    with jax.enable_x64(True):
        assert far.to_mixture().components.loc.dtype == jnp.float64
    far.sample(3), far.condition(-1, 1e6)  # in the precision of the fit


@pytest.mark.slow
@pytest.mark.parametrize("name", ["iris", "wine"])
def test_one_start_is_as_good_as_scikit_learns(name):
    from sklearn import datasets

    x = getattr(datasets, f"load_{name}")().data[:, :5]
    ours, theirs = (
        np.mean([kind(3, random_state=seed, **options).fit(x).score(x) for seed in range(10)])
        for kind, options in ((FoldedGaussianMixture, {"degree": 1}), (GaussianMixture, {}))
    )
    assert ours > theirs - 1e-3


@pytest.mark.parametrize("chunked", [False, True])
def test_rows_of_weight_zero_are_ignored(chunked):
    x, options = _blobs(), {"degree": 1, "random_state": 0}
    weights, whole = np.append(np.ones(N), 0.0), FoldedGaussianMixture(K, **options).fit(x)
    for value in (np.nan, 1e200):
        more = np.concatenate([x, np.full((1, 3), value)])
        rows = [more] if chunked else more
        weighed = FoldedGaussianMixture(K, **options).fit(rows, sample_weight=[weights] if chunked else weights)
        assert weighed.lower_bound_ == pytest.approx(whole.lower_bound_, rel=1e-9)
    more[-1] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        FoldedGaussianMixture(K, **options).fit(rows, sample_weight=np.ones((1, N + 1) if chunked else N + 1))


@pytest.mark.parametrize("dtype", ["datetime64[s]", "timedelta64[s]", "complex128"])
def test_dates_and_complex_numbers_are_refused(dtype):
    x = np.zeros((9, 2), dtype)
    for call in (FoldedGaussianMixture(1, degree=1).fit, fit):
        with pytest.raises(ValueError, match=r"(?i)^x: expected .*numbers, got") as raised:
            call(x)
        assert len(str(raised.value)) < 200


def test_columns_of_a_data_frame_are_named():
    pandas, x = pytest.importorskip("pandas"), _blobs()
    table = pandas.DataFrame(x, columns=["t", "a", "b"])
    named = FoldedGaussianMixture(K, degree=1, random_state=0, time_column="t").fit(table)
    first = FoldedGaussianMixture(K, degree=1, random_state=0, time_column=0).fit(x)
    np.testing.assert_array_equal(named.means_, first.means_)
    np.testing.assert_array_equal(named.condition("t", 0.5).mean, first.condition(0, 0.5).mean)
    with pytest.raises(ValueError, match=r"columns: expected a column of 3, or one of t, a, b, got 'c'"):
        named.condition("c", 0.5)


@pytest.mark.slow
def test_a_function_is_an_envelope():
    log_a = lambda t, time_loc, time_scale: -0.1 * jnp.abs((t - time_loc) / time_scale)  # noqa: E731
    assert np.isfinite(FoldedGaussianMixture(1, degree=1, envelope=log_a, max_iter=2).fit(_blobs()).lower_bound_)


def test_maximum_likelihood_refuses_times_that_its_dtype_does_not_resolve():
    with pytest.raises(ValueError, match="x: expected times that float32 resolves"):
        fit(_blobs() + np.array([0, 0, 1.7e9]))


# --- laws of scikit-learn's own tests of mixtures ------------------------------------------------------------

KINDS = ("full", "tied", "diag", "spherical")
#: Most of a test's time is compilation: one kind is fitted in each run, the others in slow ones.
SOME_KINDS = [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "tied")) for kind in KINDS]
STARTS = ("kmeans", "k-means++", "random", "random_from_data", "trajectories")


def _clusters(seed=0, dtype=np.float64):
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
    x, weights = _clusters(), np.random.default_rng(1).choice(3, N, p=[0.1, 0.6, 0.3])
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
    bounds = _fit(_clusters(), degree=2, covariance_type=kind, envelope=envelope, **options).lower_bounds_
    assert len(bounds) == 40
    assert np.diff(bounds).min() > -1e-9
    assert bounds[-1] > bounds[0] + 0.1


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_start_gives_distinct_means_inside_the_data_in_its_dtype(start, dtype):
    x = _clusters(dtype=dtype)
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
    x = _clusters()
    fitted = _fit(x, max_iter=max_iter, tol=tol, n_init=3)
    labels = FoldedGaussianMixture(**fitted.get_params()).fit_predict(x)
    np.testing.assert_array_equal(labels, fitted.predict(x))
    np.testing.assert_array_equal(labels, fitted.predict_proba(x).argmax(1))
    assert fitted.n_iter_ <= max_iter


@pytest.mark.parametrize("kind", SOME_KINDS)
def test_samples_of_each_component_have_its_moments(kind):
    fitted = _fit(_clusters(), degree=2, covariance_type=kind)
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
def test_a_start_is_kept(kind):
    means, weights = np.array([[0.0, 1, 2], [9, 1, 2], [0, 8, 7]]), [0.5, 0.25, 0.25]
    given = _start(means, np.tile(np.eye(3), (K, 1, 1)), weights)
    start = _fit(_clusters(), covariance_type=kind, max_iter=0, start=given)
    np.testing.assert_allclose(start.means_, means, atol=1e-12)
    np.testing.assert_allclose(start.weights_, [0.5, 0.25, 0.25])
    assert (start.n_iter_, start.converged_) == (0, False)


def test_a_diverging_start_sets_all_attributes():
    """Precisions of 1e6 on a uniform cloud: most densities underflow."""
    x = np.random.default_rng(0).uniform(size=(30, 3))
    start = _start(x[:6], np.logspace(6, 1, 6)[:, None, None] * np.eye(3), (1 / 6,) * 6)
    fitted = _fit(x, 6, max_iter=1, reg_covar=0, reg_relative=0, covariance_type="spherical", start=start)
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


@pytest.mark.slow
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


def test_criteria_count_groups():
    x, groups = _demonstrations(0, 5)
    fitted = _fit(x, 1, time_column=0)
    penalty = fitted._n_parameters()
    assert fitted.bic(x, groups) == pytest.approx(-10 * fitted.score(x) + penalty * np.log(5))
    assert fitted.aic(x, groups) == pytest.approx(-10 * fitted.score(x) + penalty * 2)


@pytest.mark.parametrize("num", [50, 70])
def test_groups_of_a_weighted_regression_are_one_per_row(num):
    x = _clusters()[:60]
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
    x = _clusters()
    with pytest.raises(ValueError, match=r"^groups: expected"):
        _fit([x[:100], x[100:]] if rows == "chunks" else x, 1, groups=groups)
