"""Fits of mixtures by gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

pytest.importorskip("sklearn")
from foldgauss import CallableFold, FoldedGaussian, PolynomialFold, TimeLikelihood
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture
from foldgauss.estimator.gradient_fit import fit_gradient
from foldgauss.mixture import FoldedMixture


def _two_parabolas(n=300, seed=0):
    rng = np.random.default_rng(seed)
    t, label = rng.normal(size=n), np.arange(n) % 2
    return np.stack([np.where(label, 4 + t**2, -t * t) + 0.1 * rng.normal(size=n), t], 1)


def _start(fold=None):
    fold = PolynomialFold(jnp.zeros((2, 2, 1))) if fold is None else fold
    options = {"scale": [[1.0], [1.0]], "time_loc": [0.1, -0.1], "time_scale": [1.0, 1.0]}
    components = FoldedGaussian([[-1.0], [5.0]], **options, fold=fold, envelope=TimeLikelihood(0.0))
    return FoldedMixture(components, weights=[0.5, 0.5])


@pytest.mark.slow
def test_gradient_fit_matches_em():
    x = _two_parabolas()
    em = FoldedGaussianMixture(2, degree=2, random_state=0, tol=1e-6, max_iter=200).fit(x)
    result = fit_gradient(_start(), x, steps=600)
    assert result.success
    assert result.message == "All 600 steps were taken."
    assert result.log_likelihoods[-1] > result.log_likelihoods[0] + 1
    np.testing.assert_allclose(result.log_likelihoods[-1], em.score(x), atol=0.01)


@pytest.mark.slow
def test_gradient_fit_trains_a_custom_fold():
    def bend(coefficient, u):
        return coefficient * u**2

    fold = CallableFold(jax.tree_util.Partial(bend, jnp.zeros(1)))
    x = _two_parabolas()
    x = x[np.arange(len(x)) % 2 == 0]  # s = -t^2 alone
    one = FoldedGaussian(
        [[-1.0]], scale=[[1.0]], time_loc=[0.0], time_scale=[1.0], fold=fold, envelope=TimeLikelihood(0.0)
    )
    result = fit_gradient(FoldedMixture(one, weights=[1.0]), x, steps=400)
    assert abs(float(jax.tree.leaves(result.mixture.components.fold)[0].ravel()[0]) + 1) < 0.05


def test_gradient_fit_never_returns_nan():
    x = _two_parabolas()
    x[3] = np.nan
    result = fit_gradient(_start(), x, steps=5)
    assert not result.success
    assert "not finite in step" in result.message
    assert np.isfinite(result.mixture.components.loc).all()
    weights = np.ones(len(x))
    weights[3] = 0  # is not there
    assert fit_gradient(_start(), x, steps=5, sample_weight=weights).success


@pytest.mark.slow
def test_diverging_gradient_fit_returns_last_finite_mixture():
    """Steps far too long: what is returned has a finite likelihood nevertheless."""
    x = _two_parabolas()
    for rate in (3.0, 30.0):
        result = fit_gradient(_start(), x, steps=20, optimizer=optax.sgd(rate))
        assert np.isfinite(result.mixture.log_prob(x).mean())
        assert np.isfinite(result.mixture.components.time_scale).all()
