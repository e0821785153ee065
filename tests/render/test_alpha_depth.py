"""Alpha and expected depth of an image: against the reference, direct sums, backgrounds and finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import check_slope, scene
from test_camera import SIZE, deep_scene, random_cameras
from test_engines import BACKGROUND, near_a_threshold

from foldgauss.render import ENGINES, RenderOptions, Splats2D, project, render
from foldgauss.render.footprint import pixel_centers
from foldgauss.render.reference import splat_alpha

#: No cutoff that a step could cross, no ceiling: the image is smooth.
SMOOTH = RenderOptions(alpha_cutoff=1e-8, alpha_ceiling=1 - 1e-12, transmittance_stop=0.0)
#: Engine "pallas", interpreted, compiles for seconds.
CASES = [(engine, kind) for engine in ENGINES[1:] for kind in ("plain", "curtain", "none") if engine != "pallas"]
CASES += [("pallas", "plain")]


def deep_splats(kind="plain", *, dtype=np.float32):
    splats, size = scene(kind, dtype=dtype)
    depth = np.sort(np.random.default_rng(1).uniform(0.5, 5, len(splats.opacity)))
    return dataclasses.replace(splats, depth=jnp.asarray(depth, dtype)), size


def direct_sums(splats, size, options):
    """Alpha and expected depth by the definition: over all splats at once, front to back."""
    alphas = np.asarray(
        jax.lax.map(lambda one: splat_alpha(one, pixel_centers(size, splats.mean.dtype), options), splats)
    )
    transmittance = np.cumprod(np.concatenate([np.ones((1, *size)), 1 - alphas]), axis=0)
    weights = alphas * transmittance[:-1]
    with np.errstate(invalid="ignore"):
        depth = np.einsum("nhw,n->hw", weights, np.asarray(splats.depth)) / weights.sum(0)
    return 1 - transmittance[-1], np.nan_to_num(depth)


@pytest.mark.parametrize(("engine", "kind"), CASES)
def test_engines_agree_with_reference(engine, kind):
    splats, size = deep_splats(kind)
    options = RenderOptions()
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), splats)
        truth = render(wide, size, engine="reference", return_alpha=True, return_depth=True)
    found = render(splats, size, engine=engine, options=options, return_alpha=True, return_depth=True)
    kept = ~near_a_threshold(splats, size, options)
    for one, other in zip(found, truth, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(np.asarray(one)[kept], np.asarray(other)[kept], atol=5e-5)
    np.testing.assert_allclose(found[0], render(splats, size, engine=engine, options=options), atol=1e-6)
    assert kind == "none" or (found[1] > 0.5).any()


@pytest.mark.parametrize("engine", ["cpu", "xla", "reference"])
def test_background_shows_through_one_minus_alpha(engine):
    splats, size = scene("plain")
    over, alpha = render(splats, size, engine=engine, background=BACKGROUND, return_alpha=True)
    black = render(splats, size, engine=engine)
    np.testing.assert_allclose(over, black + (1 - alpha)[..., None] * BACKGROUND[None, None], atol=2e-6)
    assert 0 <= float(alpha.min()) < 0.5 < float(alpha.max()) <= 1 + 1e-6


def test_sums_over_sorted_gaussians():
    """Of a scene in space and a camera, z from the camera's position and axis, in double precision."""
    with jax.enable_x64(True):
        gaussians, camera = deep_scene(), next(random_cameras(1))
        depth = np.asarray((gaussians.mean - camera.position[None]) @ camera.rotation[2])
        splats = project(gaussians, camera, SIZE)
        np.testing.assert_allclose(splats.depth, np.sort(depth), rtol=1e-12)
        options = RenderOptions(transmittance_stop=0.0)
        _, alpha, expected = render(
            splats, SIZE, engine="reference", options=options, return_alpha=True, return_depth=True
        )
        truth = direct_sums(splats, SIZE, options)
        np.testing.assert_allclose(alpha, truth[0], atol=1e-12)
        np.testing.assert_allclose(expected, truth[1], atol=1e-12)
        seen = np.asarray(alpha) > 0
        assert 0.05 < seen.mean() < 1  # and some pixels see nothing
        assert (np.asarray(expected)[~seen] == 0).all()
        assert depth.min() <= np.asarray(expected)[seen].min() < np.asarray(expected)[seen].max() <= depth.max()


@pytest.mark.parametrize("leaf", ["mean", "factor", "opacity", "depth"])
def test_gradients_by_finite_differences(leaf):
    with jax.enable_x64(True):
        splats, size = deep_splats(dtype=np.float64)
        splats = jax.tree.map(lambda leaf: leaf[:12], splats)
        weights = jnp.asarray(np.random.default_rng(2).normal(size=(2, *size)))

        @jax.jit
        def loss(splats):
            how = {"engine": "reference", "options": SMOOTH, "return_alpha": True, "return_depth": True}
            _, alpha, depth = render(splats, size, **how)
            return jnp.sum(alpha * weights[0]) + jnp.sum(alpha * depth * weights[1]) + depth[24, 30]

        check_slope(loss, splats, leaf, rtol=1e-6)


@pytest.mark.parametrize("engine", ["cpu", "xla"])
def test_gradients_agree_with_reference(engine):
    splats, size = deep_splats()
    kept = jnp.asarray(~near_a_threshold(splats, size, RenderOptions()), jnp.float32)

    def loss(splats, engine):
        _, alpha, depth = render(splats, size, engine=engine, return_alpha=True, return_depth=True)
        return jnp.sum(kept * (alpha**2 + alpha * depth))

    found, truth = (jax.grad(loss)(splats, name) for name in (engine, "reference"))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(truth), strict=True):
        scale = max(1.0, float(jnp.abs(other).max()))
        np.testing.assert_allclose(one / scale, other / scale, atol=5e-5)
    assert float(jnp.abs(found.color).max()) == 0
    assert float(jnp.abs(found.opacity).max()) > 0.1


def test_gradient_reaches_means_and_camera_through_the_depth():
    gaussians, camera = deep_scene(dtype=np.float32), next(random_cameras(1))

    @jax.jit
    @jax.grad
    def gradient(tree):
        return jnp.sum(render(project(*tree, SIZE), SIZE, return_depth=True)[1])

    leaves = jax.tree.leaves(gradient((gaussians, camera)))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)
    assert float(jnp.abs(leaves[0]).max()) > 0


def test_order_of_the_results():
    splats, size = deep_splats("one")
    image, alpha, depth = render(splats, size, return_alpha=True, return_depth=True)
    assert (image.shape, alpha.shape, depth.shape) == ((*size, 3), size, size)
    np.testing.assert_array_equal(render(splats, size, return_alpha=True)[1], alpha)
    np.testing.assert_array_equal(render(splats, size, return_depth=True)[1], depth)
    np.testing.assert_allclose(depth[alpha > 0], splats.depth[0], rtol=1e-6)


def test_batches():
    splats, size = deep_splats("one")
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf + 0.1]), splats)
    images, alphas = jax.vmap(lambda one: render(one, size, return_alpha=True))(both)
    assert (images.shape, alphas.shape) == ((2, *size, 3), (2, *size))


def test_errors():
    splats, size = scene("one")
    with pytest.raises(ValueError, match=r"^splats\.depth: expected a depth of each splat.*project sets them"):
        render(splats, size, return_depth=True)
    for name in ("return_alpha", "return_depth"):
        with pytest.raises(ValueError, match=r"^compositing: expected 'over' for alpha and depth, got 'sum'"):
            render(splats, size, compositing="sum", **{name: True})
    with pytest.raises(ValueError, match=r"^depth: expected shape \(1,\), that of opacity, got shape \(2,\)"):
        Splats2D(splats.mean, splats.factor, splats.opacity, splats.color, jnp.ones(2))
