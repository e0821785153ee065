"""The fused loss against scikit-image (map) and JAX (value and gradient)."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from foldgauss.video.fitting.steppers.jax_loss import ssim
from foldgauss.video.fitting.steppers.loss import C1, C2, RADIUS, SIGMA, image_loss

SLOW_SIZES = [pytest.param(*size, marks=pytest.mark.slow) for size in ((97, 83), (40, 16), (11, 11))]
SIZES = [(41, 200), (3, 50), (1, 1), *SLOW_SIZES]


def pictures(height, width, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 1, (3, height, width))
    return x.astype(np.float32), np.clip(x + rng.normal(0, 0.2, x.shape), 0, 1).astype(np.float32)


def loss_in_jax(x, y, share):
    taps = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
    kernel = jnp.asarray(np.outer(taps, taps) / taps.sum() ** 2, x.dtype)

    def blur(a):
        return jax.lax.conv_general_dilated(a[:, None], kernel[None, None], (1, 1), [(RADIUS, RADIUS)] * 2)[:, 0]

    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2, blur(x * y) - mean_x * mean_y
    top = (2 * mean_x * mean_y + C1) * (2 * cov + C2)
    ssim = top / ((mean_x**2 + mean_y**2 + C1) * (var_x + var_y + C2))
    return (1 - share) * jnp.mean(jnp.abs(x - y)) + share * (1 - jnp.mean(ssim))


value_and_gradient = jax.jit(jax.value_and_grad(loss_in_jax))


def test_map_agrees_with_scikit_image():
    x, y = (picture[0] for picture in pictures(97, 83))
    options = {"gaussian_weights": True, "sigma": SIGMA, "use_sample_covariance": False, "data_range": 1}
    _, truth = structural_similarity(x.astype(np.float64), y.astype(np.float64), full=True, **options)
    inner = (slice(RADIUS, -RADIUS),) * 2  # the border is padded with zeros here, mirrored there
    np.testing.assert_allclose(np.asarray(ssim(x[..., None], y[..., None]))[..., 0][inner], truth[inner], atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_value_and_gradient_agree_with_jax(height, width, share):
    x, y = pictures(height, width)
    with jax.enable_x64(True):
        wide = jnp.asarray(x, jnp.float64), jnp.asarray(y, jnp.float64)
        value, gradient = value_and_gradient(*wide, share)
        value, gradient = float(value), np.asarray(gradient)
    ours = image_loss(x, y, ssim_fraction=share)
    assert ours.value == pytest.approx(value, abs=2e-6)
    assert ours.mean_squared_error == pytest.approx(np.mean((x - y) ** 2), rel=1e-5)
    np.testing.assert_allclose(ours.gradient, gradient, atol=1e-4 * np.abs(gradient).max())


def test_equal_images_are_stationary():
    x, _ = pictures(60, 50)
    loss = image_loss(x, x.copy())
    assert loss.value == pytest.approx(0, abs=1e-6)
    assert np.abs(loss.gradient).max() < 1e-7


@pytest.mark.slow
def test_kernels_from_the_cache_have_the_bits_of_those_compiled_anew(tmp_path):
    """So functions that kernels call are inlined, see `_runtime.kernels.inline`."""
    code = (
        "import hashlib, numpy as np; from foldgauss.video.fitting.steppers.loss import image_loss\n"
        "x, y = np.random.default_rng(0).random((2, 3, 40, 50), np.float32); loss = image_loss(x, y)\n"
        "print(hashlib.sha256(loss.gradient.tobytes()).hexdigest(), loss.value, loss.mean_squared_error)"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [
        subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert list(tmp_path.rglob("*.nbc"))
    assert runs[0] == runs[1]


def test_shapes_are_checked():
    x, y = pictures(20, 20)
    with pytest.raises(ValueError, match="rendered, target"):
        image_loss(x, y[:, :-1])
