"""Mixtures rendered as densities, and mixtures as splats."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import CallableEnvelope, Constant, TimeLikelihood
from foldgauss.fold import FourierFold, PolynomialFold, ZeroFold
from foldgauss.mixture import FoldedMixture
from foldgauss.render import pixels_per_unit
from foldgauss.video import FoldedSplats, density_image

SIZE = (36, 64)


def _mixture(num=5, **changes):
    rng = np.random.default_rng(0)
    tril = np.tril(rng.uniform(0.02, 0.1, (num, 2, 2))) * [[1, 0], [-1, 1]]
    parameters = {
        "loc": rng.uniform(-0.3, 0.3, (num, 2)),
        "scale_tril": tril,
        "time_loc": rng.uniform(0.2, 0.8, num),
        "time_scale": rng.uniform(0.1, 0.3, num),
        "fold": PolynomialFold(rng.normal(size=(num, 2, 2)) * 0.3),
        "envelope": TimeLikelihood(power=1.0, floor=0.01),
    }
    return FoldedMixture(FoldedGaussian(**(parameters | changes)), weights=rng.uniform(0.5, 1, num))


def _grid(size, t):
    """Pixel centers in model space, and t."""
    height, width = size
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    scale = pixels_per_unit(size)
    return jnp.asarray(np.stack([x / scale, y / scale, np.full_like(x, t)], -1), float)


def _off(image, mixture, size=SIZE, t=0.45):
    density = np.asarray(mixture.pdf(_grid(size, t)))
    return np.abs(np.asarray(image) - density).max() / density.max()


@pytest.mark.parametrize("engine", ["cpu", pytest.param("reference", marks=pytest.mark.slow)])
def test_image_is_the_density(engine):
    mixture = _mixture()
    image = density_image(mixture, 0.45, SIZE, engine=engine)
    assert image.shape == SIZE
    assert image.max() > 1  # opacities could not be
    assert _off(image, mixture) < 1e-5
    # Power: it is that of this time, and of these weights.
    assert _off(density_image(mixture, 0.46, SIZE, engine=engine), mixture) > 1e-3
    assert _off(image, FoldedMixture(mixture.components, weights=np.ones(5))) > 1e-2


@pytest.mark.slow
def test_image_is_the_density_in_float64():
    with jax.enable_x64(True):
        mixture = _mixture()
        image = density_image(mixture, 0.45, SIZE, engine="reference")
        assert image.dtype == jnp.float64
        assert _off(image, mixture) < 1e-7


def test_image_sums_to_the_time_density():
    mixture = _mixture(loc=np.zeros((5, 2)), fold=ZeroFold(2))
    mass = density_image(mixture, 0.45, (60, 60)).sum() / pixels_per_unit((60, 60)) ** 2
    np.testing.assert_allclose(mass, mixture.marginal([-1]).pdf(jnp.array([0.45])), rtol=1e-3)


@pytest.mark.slow
def test_image_has_the_gradient_of_the_density():
    mixture = _mixture()
    drawn = jax.grad(lambda mixture: density_image(mixture, 0.45, SIZE).sum())(mixture)
    computed = jax.grad(lambda mixture: mixture.pdf(_grid(SIZE, 0.45)).sum())(mixture)
    for a, b in zip(jax.tree.leaves(drawn), jax.tree.leaves(computed), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3 * float(jnp.abs(b).max()) + 1e-1)


def test_component_of_weight_zero_is_not_rendered():
    mixture = _mixture()
    lighter = FoldedMixture(mixture.components, weights=[1.0, 0.0, 1.0, 0.0, 1.0])
    assert _off(density_image(lighter, 0.45, SIZE), lighter) < 1e-5


# --- splats ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parts",
    [{}, *(pytest.param(own, marks=pytest.mark.slow) for own in ({"fold": ZeroFold(2)}, {"envelope": Constant()}))],
)
def test_splats_hold_the_mixture(parts):
    mixture = _mixture(**parts)
    splats = FoldedSplats.from_mixture(mixture, color=[0.9, 0.2, 0.0])
    back = splats.to_mixture()
    np.testing.assert_allclose(back.weights, mixture.weights, rtol=1e-5)
    np.testing.assert_allclose(back.components.scale_tril, mixture.components.scale_tril, rtol=1e-4, atol=1e-6)
    x = mixture.sample(jax.random.key(0), (50,))
    np.testing.assert_allclose(back.log_prob(x), mixture.log_prob(x), rtol=1e-3, atol=1e-3)
    again = FoldedSplats.from_mixture(back, color=[0.9, 0.2, 0.0])
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(splats), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)


def test_splats_of_a_mixture_are_rendered():
    mixture = _mixture()
    color = np.random.default_rng(1).uniform(size=(5, 3))
    at = FoldedSplats.from_mixture(mixture, color=color).at(jnp.asarray(0.5))
    np.testing.assert_allclose(at.color, color, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(at.opacity.max(), 0.99, rtol=1e-5)
    np.testing.assert_allclose(at.mean, mixture.components.condition_time(0.5).loc, rtol=1e-4, atol=1e-5)
    traced = jax.jit(lambda own: FoldedSplats.from_mixture(own, color=color).at(jnp.asarray(0.5)))(mixture)
    np.testing.assert_allclose(traced.factor, at.factor, rtol=1e-4, atol=1e-6)


def test_round_covariances_and_dead_components_become_splats():
    mixture = _mixture(scale_tril=np.tile(0.05 * np.eye(2), (5, 1, 1)))
    mixture = FoldedMixture(mixture.components, weights=[1.0, 0.0, 1.0, 1.0, 1.0])
    back = FoldedSplats.from_mixture(mixture, color=[1.0, 1.0, 1.0]).to_mixture()
    np.testing.assert_allclose(back.weights, mixture.weights, rtol=1e-5)
    np.testing.assert_allclose(back.components.scale_tril, mixture.components.scale_tril, rtol=1e-5, atol=1e-7)


def splats_of(color=(1.0, 1.0, 1.0), **parts):
    return FoldedSplats.from_mixture(_mixture(**parts), color=color)


LINE = _mixture().marginal([0, -1])
WRONG = [
    (lambda: splats_of(time_loc=np.full(5, 1.5)), "mixture.components.time_loc"),
    (
        lambda: splats_of(fold=FourierFold(np.ones((1, 2)), np.ones((1, 2)), period=1.0)),
        "mixture.components.fold",
    ),
    (
        lambda: splats_of(envelope=CallableEnvelope(lambda t, m, scale: -jnp.abs(t - m))),
        "mixture.components.envelope",
    ),
    (lambda: splats_of(envelope=TimeLikelihood(np.float32([1, 1, 2, 1, 1]))), "envelope"),
    (lambda: splats_of(color=[1.0, 1.0]), "color"),
    (lambda: splats_of(color=[1.0, 1.0, -0.1]), "color"),
    (lambda: FoldedSplats.from_mixture(LINE, color=[1.0, 1.0, 1.0]), "mixture"),
    (lambda: density_image(LINE, 0.5, SIZE), "mixture"),
    (lambda: density_image(_mixture(), 0.5, (0, 4)), "size"),
]


@pytest.mark.parametrize(("call", "parameter"), WRONG)
def test_invalid_mixtures_and_colors_are_rejected(call, parameter):
    with pytest.raises(ValueError, match=f"^{re.escape(parameter)}: expected"):
        call()
