"""The fused conditioning kernels against `FoldedGaussian.condition_time`: values and gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from path_models import moving_splats, random_splats

from foldgauss.render import RenderOptions
from foldgauss.video import FrameTimes, VideoModel
from foldgauss.video.models.conditioning import (
    ConditioningSpec,
    backpropagate,
    condition,
    find_windows,
)
from foldgauss.video.models.row_layout import columns, pack, unpack
from foldgauss.video.models.shared_paths import SharedPaths

SIZE, T = (48, 80), np.float32(0.4)


def twin(splats, power, floor):
    rows, shape = pack(splats), ConditioningSpec(splats.degree, power, floor, SIZE, paths=splats.paths)
    return rows, shape, condition(rows, find_windows(rows, shape), T, shape)


def in_pixels(splats):
    model = VideoModel(splats, FrameTimes.uniform(2), SIZE, 25.0, RenderOptions())
    return model.at(jnp.asarray(T))


#: Splats of their own, and some on shared paths: what makes them, degree, power, floor.
CASES = [
    *((random_splats, degree, *of) for degree in (0, 1, 3, 7) for of in ((1.0, 0.0), (2.0, 0.0), (2.0, 0.05))),
    *((random_splats, degree, 0.0, 0.0) for degree in (0, 3)),
    *((moving_splats, degree, 2.0, 0.0) for degree in (0, 3)),
]


@pytest.mark.parametrize(("make", "degree", "power", "floor"), CASES)
def test_kernel_values_match_condition_time(make, degree, power, floor):
    splats = make(degree=degree, power=power, floor=floor)
    home = jax.jit(in_pixels)(splats)
    _, _, done = twin(splats, power, floor)
    alive = np.flatnonzero(np.asarray(home.opacity) > 0)
    assert 50 < len(alive) < splats.num_gaussians  # some are too far away in time
    np.testing.assert_array_equal(done.alive, alive)
    np.testing.assert_allclose(done.mean, home.mean[alive], rtol=1e-5, atol=2e-4 if splats.paths is None else 5e-4)
    np.testing.assert_allclose(done.opacity, home.opacity[alive], rtol=1e-5)
    np.testing.assert_allclose(done.color, home.color[alive], atol=1e-6)
    cov = done.factor @ np.swapaxes(done.factor, 1, 2)  # the factors differ by a rotation
    home_cov = np.asarray(home.factor @ jnp.swapaxes(home.factor, 1, 2))[alive]
    np.testing.assert_allclose(cov, home_cov, rtol=2e-4, atol=1e-5 * np.abs(home_cov).max())


@pytest.mark.parametrize(
    ("make", "degree", "power", "floor"),
    [case for case in CASES if case[0] is random_splats and case[1] in (0, 3) and case[2]]
    + [(moving_splats, 3, 1.0, 0.0)],
)
def test_kernel_gradients_match_autodiff(make, degree, power, floor):
    """Of a loss that looks at mean, covariance, opacity and color with random weights; of time, or of paths' maps."""
    splats = make(degree=degree, power=power, floor=floor)
    rows, shape, done = twin(splats, power, floor)
    rng = np.random.default_rng(1)
    w_mean, w_cov = rng.normal(size=done.mean.shape), rng.normal(size=done.factor.shape) / 50
    w_opacity, w_color = rng.normal(size=done.opacity.shape), rng.normal(size=done.color.shape)
    weights = [w.astype(np.float32) for w in (w_mean, w_cov + np.swapaxes(w_cov, 1, 2), w_opacity, w_color)]

    def loss(leaves, maps, t):
        paths = None if maps is None else SharedPaths(jnp.zeros((2, 1), maps.dtype), maps[:, None])
        model = dataclasses.replace(splats, **leaves, paths=paths)
        home = VideoModel(model, FrameTimes.uniform(2), SIZE, 25.0, RenderOptions()).at(t)
        cov = home.factor @ jnp.swapaxes(home.factor, 1, 2)
        parts = zip((home.mean, cov, home.opacity, home.color), weights, strict=True)
        return sum(jnp.sum(part[done.alive] * weight) for part, weight in parts)

    with jax.enable_x64(True):
        wide = {name: jnp.asarray(getattr(splats, name), jnp.float64) for name in columns(degree)}
        maps = None if splats.paths is None else jnp.asarray(splats.paths.at(T), jnp.float64)
        weights = [w.astype(np.float64) for w in weights]
        slopes = jax.jit(jax.grad(loss, (0, 1, 2)))(wide, maps, jnp.float64(T))
        by_leaves, by_maps, by_time = jax.tree.map(np.asarray, slopes)
        weights = [w.astype(np.float32) for w in weights]

    grad, path_grad = np.zeros_like(rows), None if maps is None else np.zeros((2, 2, 3))
    d_factor = 2 * weights[1] @ done.factor  # of sum(W * F F^T), W symmetric
    d_time = backpropagate(rows, done, (weights[0], d_factor, weights[2], weights[3]), shape, grad, path_grad)
    for name, place in columns(degree).items():
        truth = by_leaves[name].reshape(len(rows), -1)
        largest = max(np.abs(truth).max(initial=0), 1e-3)
        np.testing.assert_allclose(
            grad[:, place] / largest, truth / largest, atol=1e-5 if maps is None else 2e-5, err_msg=name
        )
    if maps is not None:
        np.testing.assert_array_equal(grad[:, -1], 0)  # the number of the path
        np.testing.assert_allclose(path_grad, by_maps, rtol=1e-4, atol=1e-5 * np.abs(by_maps).max())
    assert d_time == pytest.approx(float(by_time), rel=1e-3, abs=1e-6 * float(np.abs(grad).sum()))


@pytest.mark.parametrize(
    ("power", "floor", "cutoff"), [(1.0, 0.0, 0.02), (2.0, 0.02, 0.02), (1.0, 0.3, 0.03), (0.0, 0.0, 0.05)]
)
def test_scale_cutoff_keeps_the_times_when_both_scales_exceed_it(power, floor, cutoff):
    rows, spec, _ = twin(random_splats(power=power, floor=floor), power, floor)
    window = find_windows(rows, spec)
    cut = find_windows(rows, dataclasses.replace(spec, scale_cutoff=cutoff))
    at = columns(spec.degree)
    center, spread = 1 / (1 + np.exp(-rows[:, at["time_loc_logit"]])), np.exp(rows[:, at["log_time_scale"]])
    t = np.linspace(window.min(1), window.max(1), 102, axis=1)[:, 1:-1]
    a = floor + (1 - floor) * np.exp(-0.5 * power * ((t - center) / spread) ** 2)
    smaller = np.exp(rows[:, at["log_scale"]].min(1, keepdims=True)) * np.sqrt(a)
    kept = (cut[:, :1] < t) & (t < cut[:, 1:])
    np.testing.assert_array_equal(kept, smaller > cutoff)
    assert 0.2 < kept.mean() < 0.8


@pytest.mark.parametrize("degree", [0, 3])
def test_unpack_inverts_pack(degree):
    splats = random_splats(degree=degree)
    again = unpack(pack(splats), degree, splats.envelope)
    jax.tree.map(np.testing.assert_array_equal, splats, again)
    places = np.concatenate([np.arange(place.start, place.stop) for place in columns(degree).values()])
    np.testing.assert_array_equal(np.sort(places), np.arange(11 + 2 * degree))
