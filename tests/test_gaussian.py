"""Moments, entropy and distribution functions of `Gaussian`, against scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from foldgauss.gaussian import Gaussian

LOC, SCALE = np.array([-1.0, 0.0, 3.0]), np.array([[0.01], [2.0]])
VALUES = np.array([-1.02, 0.5, 9.0])


pytestmark = pytest.mark.usefixtures("x64")


CDF = jax.jit(lambda normal, value: normal.cdf(value))
ICDF = jax.jit(lambda normal, q: normal.icdf(q))


def _line(loc, scale, **options):
    """The Gaussian of a single coordinate."""
    return Gaussian(jnp.asarray(loc)[..., None], jnp.asarray(scale)[..., None, None], **options)


def test_a_single_coordinate_is_scipys_normal():
    ours, scipys = _line(LOC, SCALE), stats.norm(LOC, SCALE)
    for name in ("mean", "std", "var", "entropy"):
        own = getattr(ours, {"std": "stddev", "var": "variance"}.get(name, name))
        own = own() if callable(own) else own[..., 0]
        assert own.shape == ours.batch_shape == (2, 3)
        np.testing.assert_allclose(own, getattr(scipys, name)(), rtol=1e-12)
    x = VALUES[:, None]
    np.testing.assert_allclose(ours.log_prob(x), scipys.logpdf(VALUES), rtol=1e-12)
    np.testing.assert_allclose(ours.pdf(x), scipys.pdf(VALUES), rtol=1e-9)
    np.testing.assert_allclose(CDF(ours, x), scipys.cdf(VALUES), rtol=1e-10)
    q = np.array([1e-12, 0.3, 1 - 1e-9])
    np.testing.assert_allclose(ICDF(ours, q)[..., 0], scipys.ppf(q), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(CDF(ours, ICDF(ours, q)), np.broadcast_to(q, (2, 3)), rtol=1e-8)


def test_quantiles_at_the_ends():
    normal = _line(0.5, 2.0)
    np.testing.assert_array_equal(CDF(normal, np.array([[-np.inf], [np.inf]])), [0, 1])
    np.testing.assert_array_equal(ICDF(normal, np.array([0.0, 1.0]))[:, 0], [-np.inf, np.inf])
    assert np.isnan(ICDF(normal, np.array([-0.1, 1.1]))).all()
    density = jax.jit(jax.vmap(jax.grad(normal.cdf)))(np.array([-3.0, 0.5]))
    np.testing.assert_allclose(density, stats.norm(0.5, 2.0).pdf([-3.0, 0.5]), rtol=1e-12)


def test_derivatives_of_the_cdf_of_narrow_and_wide_normals():
    with jax.enable_x64(False):
        scales = np.array([1e-30, 1e-30, 1e-30, 1e-22, 1e-22, 1e38], np.float32)
        values = np.array([-1.0, 1.0, np.inf, 0.0, 1e-22, np.inf], np.float32)
        cdf = jax.value_and_grad(lambda scale, value: _line(0.0, scale, validate_args=False).cdf(value), (0, 1))
        found, (by_scale, by_value) = jax.jit(jax.vmap(cdf))(scales, values)
    np.testing.assert_array_equal(found[:3], [0, 1, 1])
    np.testing.assert_array_equal([by_scale[:3], by_value[:3]], np.zeros((2, 3)))
    density = stats.norm.pdf([0, 1]) / 1e-22
    np.testing.assert_allclose([by_scale[3:5], by_value[3:5]], [[0, -density[1]], density], rtol=1e-5)
    assert by_scale[5] == 0


@pytest.mark.parametrize("log_scale", [0.0, -1.5])
def test_gaussian_is_scipys(log_scale):
    rng = np.random.default_rng(0)
    tril = np.tril(rng.normal(size=(4, 3, 3))) + 2 * np.eye(3)
    ours = Gaussian(rng.normal(size=3), tril, log_scale=log_scale)
    assert ours.stddev.shape == ours.mean.shape == (4, 3)
    assert ours.entropy().shape == (4,)
    np.testing.assert_allclose(ours.scale_tril @ ours.scale_tril.swapaxes(1, 2), ours.covariance_matrix, rtol=1e-12)
    for k in range(4):
        scipys = stats.multivariate_normal(ours.mean[k], np.exp(2 * log_scale) * tril[k] @ tril[k].T)
        np.testing.assert_allclose(ours.covariance_matrix[k], scipys.cov, rtol=1e-12)
        np.testing.assert_allclose(ours.entropy()[k], scipys.entropy(), rtol=1e-12)
        np.testing.assert_allclose(ours.stddev[k] ** 2, ours.variance[k], rtol=1e-12)
        np.testing.assert_allclose(ours.variance[k], np.diag(scipys.cov), rtol=1e-12)


def test_standard_deviations_do_not_underflow():
    narrow = Gaussian(jnp.zeros(2), jnp.eye(2), log_scale=-400.0)
    assert (narrow.variance == 0).all()
    np.testing.assert_allclose(jnp.log(narrow.stddev), -400)
    for factor in (1e-200, 1e200):
        squared = Gaussian(jnp.zeros(2), factor * jnp.array([[3.0, 0.0], [3.0, 4.0]]))
        np.testing.assert_allclose(squared.stddev, factor * np.array([3.0, 5.0]), rtol=1e-15)
    assert jnp.isinf(Gaussian(jnp.zeros(1), jnp.array([[jnp.inf]]), validate_args=False).stddev).all()


def test_jitted_code_may_close_over_a_gaussian_of_any_scale():
    """XLA computes with constants beforehand, and sums and products of them in another order."""
    narrow, x = Gaussian([0.0], [[1.0]], log_scale=-60.0), jnp.array([[0.0], [1e-30], [1e-20], [1.0]])
    np.testing.assert_allclose(jax.jit(lambda x: narrow.log_prob(x))(x), narrow.log_prob(x), rtol=1e-6)
