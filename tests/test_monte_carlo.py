"""Entropy and divergence by Monte Carlo, against formulas, within their own standard errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss import FoldedGaussian, FoldedMixture, PolynomialFold, kl_divergence
from foldgauss.analysis.monte_carlo import entropy_bounds, estimate_entropy, estimate_kl_divergence
from foldgauss.envelope import Constant
from foldgauss.gaussian import Gaussian, Normal

KEY = jax.random.key(0)
ENTROPY = jax.jit(estimate_entropy, static_argnums=2)
DIVERGENCE = jax.jit(estimate_kl_divergence, static_argnums=3)


def folded(bend: float = 0.5, **changes) -> FoldedGaussian:
    parameters = {"time_loc": 0.4, "time_scale": 0.3, "fold": PolynomialFold(jnp.array([[bend], [0.6]]))}
    return FoldedGaussian([0.1], [[0.3]], **(parameters | changes))


def far_apart(distance: float) -> FoldedMixture:
    components = FoldedGaussian(jnp.array([[0.0], [distance]]), [[0.3]], time_loc=0.5, time_scale=0.1)
    return FoldedMixture(components, weights=[0.25, 0.75])


@pytest.mark.parametrize("dist", [folded(), Normal(0.5, jnp.array([0.1, 2.0])), Gaussian(jnp.zeros(3), jnp.eye(3))])
def test_entropy_is_that_of_the_formula(dist):
    """Within 4 standard errors, false alarm 6e-5 each; the error falls with the root of the number of samples."""
    few, many = (jax.tree.map(np.asarray, ENTROPY(dist, KEY, num)) for num in (1_000, 16_000))
    off = many.value - np.asarray(jax.jit(lambda dist: dist.entropy())(dist))
    assert (np.abs(off) < 4 * many.standard_error).all()
    np.testing.assert_allclose(few.standard_error / many.standard_error, 4, rtol=0.2)
    assert (np.abs(off - 0.1) > 4 * many.standard_error).all()  # power


def test_divergence_is_that_of_the_formula():
    p, q = folded(0.5), folded(0.2, time_scale=0.4)
    found = DIVERGENCE(p, q, KEY, 20_000)
    assert abs(found.value - kl_divergence(p, q)) < 4 * found.standard_error
    assert abs(found.value - kl_divergence(q, p)) > 4 * found.standard_error
    np.testing.assert_array_equal(DIVERGENCE(p, p, KEY, 20_000), 0)


def test_divergence_broadcasts():
    flat, times = {"envelope": Constant()}, [0.4, 0.5, 0.6]  # with a time likelihood the divergence is infinite
    p, q = folded(**flat), folded(time_loc=jnp.array(times), **flat)
    found = jax.tree.map(np.asarray, DIVERGENCE(p, q, KEY, 4_000))
    assert found.value.shape == found.standard_error.shape == (3,)
    expected = np.array([kl_divergence(p, folded(time_loc=time, **flat)) for time in times])
    assert (np.abs(found.value - expected) <= 4 * found.standard_error).all()


@pytest.mark.parametrize(("distance", "near"), [(0.0, 0), (50.0, 1)])
def test_bounds_hold_and_are_met(distance, near):
    mixture = far_apart(distance)
    found, bounds = ENTROPY(mixture, KEY, 20_000), jax.jit(entropy_bounds)(mixture)
    assert bounds[0] < bounds[1]
    assert bounds[0] - 4 * found.standard_error < found.value < bounds[1] + 4 * found.standard_error
    assert abs(found.value - bounds[near]) < 4 * found.standard_error
    assert abs(found.value - bounds[1 - near]) > 10 * found.standard_error


def test_a_weight_of_zero_counts_nothing():
    components = FoldedGaussian(jnp.array([[0.0], [1.0]]), [[0.3]], time_loc=0.5, time_scale=0.1)
    lower, upper = entropy_bounds(FoldedMixture(components, weights=[0.0, 1.0]))
    np.testing.assert_allclose(lower, upper)
    logits = jnp.array([-jnp.inf, 0.0])
    slopes = jax.grad(lambda logits: entropy_bounds(FoldedMixture(components, logits=logits))[1])(logits)
    np.testing.assert_array_equal(slopes, 0)


def test_bad_arguments():
    with pytest.raises(ValueError, match="num_samples: expected a whole number >= 2, got 1"):
        estimate_entropy(folded(), KEY, 1)
    with pytest.raises(ValueError, match=r"q: expected the event shape of p, \(2,\), got \(\)"):
        estimate_kl_divergence(folded(), Normal(0.0, 1.0), KEY)
