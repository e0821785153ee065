"""What runs on a GPU, against the same on the CPU: pytest -m gpu. Its speed: python -m benchmarks.gpu."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from clips import moving_blobs

from foldgauss import FoldedGaussian, FoldedMixture, PolynomialFold
from foldgauss.render import RenderOptions, Splats2D, render
from foldgauss.video import FitConfig, evaluate, fit

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.usefixtures("optimized"),
    # Pallas's compiler for GPUs that `pallas` uses, from JAX 0.11 on; docs/gpu.md says so.
    pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning"),
]
CPU = jax.devices("cpu")[0]
SIZE = (120, 200)


@pytest.fixture(scope="module")
def gpu():
    try:
        return jax.devices("gpu")[0]
    except RuntimeError:
        pytest.skip("JAX sees no GPU")


def on(device, function, *arguments):
    """The result of a function compiled for a device, as NumPy arrays."""
    with jax.default_device(device):
        return jax.tree.map(np.asarray, jax.jit(function)(*jax.device_put(arguments, device)))


def random_splats(num=2000) -> Splats2D:
    rng = np.random.default_rng(0)
    mean = rng.uniform(-0.1, 1.1, (num, 2)) * SIZE[::-1]
    factor = rng.normal(size=(num, 2, 2)) * rng.uniform(0.5, 8, (num, 1, 1))
    leaves = mean, factor, rng.uniform(0.05, 0.9, num), rng.uniform(0, 1, (num, 3))
    return Splats2D(*(leaf.astype(np.float32) for leaf in leaves))


@pytest.mark.parametrize("compositing", ["over", "sum"])
@pytest.mark.parametrize("engine", ["xla", "pallas"])
def test_images_and_gradients(gpu, engine, compositing):
    """Of each engine on the GPU, against `xla` on the CPU. No pixel lies near the cutoff, where rounding decides."""
    splats, options = random_splats(), RenderOptions(alpha_cutoff=1e-8, transmittance_stop=0.0, support_radius=None)
    weights = np.random.default_rng(1).normal(size=(*SIZE, 3)).astype(np.float32)

    def loss(splats, weights, engine):
        image = render(splats, SIZE, engine=engine, compositing=compositing, options=options)
        return jnp.sum(image * weights), image

    def image_and_gradients(engine):
        return lambda splats, weights: jax.grad(lambda s: loss(s, weights, engine), has_aux=True)(splats)

    gradients, image = on(gpu, image_and_gradients(engine), splats, weights)
    true_gradients, truth = on(CPU, image_and_gradients("xla"), splats, weights)
    np.testing.assert_allclose(image, truth, atol=1e-5 * max(1, np.abs(truth).max()))
    for own, other in zip(jax.tree.leaves(gradients), jax.tree.leaves(true_gradients), strict=True):
        np.testing.assert_allclose(own, other, atol=1e-4 * np.abs(other).max())


@pytest.mark.parametrize("engine", ["xla", "pallas"])
def test_fits_are_as_good(gpu, engine):
    frames = moving_blobs()
    config = FitConfig(num_gaussians=300, steps=200, options=RenderOptions(alpha_ceiling=0.99))
    with jax.default_device(gpu):
        psnr = evaluate(fit(frames, dataclasses.replace(config, engine=engine)).model, frames).mean_psnr
    expected = evaluate(fit(frames, dataclasses.replace(config, engine="cpu")).model, frames).mean_psnr
    assert expected > 25
    assert abs(psnr - expected) < 0.5


def test_densities_and_their_gradients(gpu):
    """In double precision: matrix products of float32 are of fewer digits on GPUs."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(2)
        component = FoldedGaussian(
            jnp.asarray(rng.normal(size=(4, 3))),
            scale=jnp.asarray(rng.uniform(0.3, 1, (4, 3))),
            time_loc=jnp.asarray(rng.normal(size=4)),
            time_scale=jnp.ones(4),
            fold=PolynomialFold(jnp.asarray(rng.normal(size=(4, 2, 3)))),
        )
        mixture = FoldedMixture(component, weights=jnp.asarray([0.1, 0.2, 0.3, 0.4]))
        points = rng.normal(size=(1000, 4))

        def log_prob(mixture, points):
            return jnp.mean(mixture.log_prob(points)), mixture.log_prob(points)

        results = [on(device, jax.grad(log_prob, has_aux=True), mixture, points) for device in (gpu, CPU)]
        for own, other in zip(*map(jax.tree.leaves, results), strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-12)
