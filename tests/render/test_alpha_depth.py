"""Alpha and expected depth of an image: against the reference, direct sums, backgrounds and finite differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import judge
import numpy as np
import pytest
from scenes import check_slopes, draw, scene
from test_camera import SIZE, deep_scene, random_cameras, view
from test_engines import BACKGROUND

from foldgauss.render import ENGINES, RenderOptions, Splats2D, render
from foldgauss.render.footprint import pixel_centers
from foldgauss.render.reference import splat_alpha

#: No cutoff that a step could cross, no ceiling: the image is smooth.
SMOOTH = RenderOptions(alpha_cutoff=1e-8, alpha_ceiling=1 - 1e-12, transmittance_stop=0.0)
BOTH = {"return_alpha": True, "return_depth": True}


def draw_both(splats, size, engine, background=(0, 0, 0)):
    """Image, alpha and depth, compiled once for each engine."""
    background = jnp.asarray(background, splats.mean.dtype)
    return draw(splats, size, engine=engine, background=background, **BOTH)


#: Engine "pallas", interpreted, compiles for seconds.
CASES = [(engine, kind) for engine in ENGINES[1:] for kind in ("plain", "curtain", "none") if engine != "pallas"]
CASES += [pytest.param("pallas", "plain", marks=pytest.mark.slow)]


def deep_splats(kind="plain", *, dtype=np.float32):
    splats, size = scene(kind, dtype=dtype)
    depth = np.sort(np.random.default_rng(1).uniform(0.5, 5, len(splats.opacity)))
    return dataclasses.replace(splats, depth=jnp.asarray(depth, dtype)), size


def direct_sums(splats, size, options):
    """Alpha and expected depth by the definition: over all splats at once, front to back."""
    centers = pixel_centers(size, splats.mean.dtype)
    alphas = np.asarray(jax.lax.map(lambda one: splat_alpha(one, centers, options), splats))
    transmittance = np.cumprod(np.concatenate([np.ones((1, *size)), 1 - alphas]), axis=0)
    weights = alphas * transmittance[:-1]
    with np.errstate(invalid="ignore"):
        depth = np.einsum("nhw,n->hw", weights, np.asarray(splats.depth)) / weights.sum(0)
    return 1 - transmittance[-1], np.nan_to_num(depth)


@functools.cache
def judged(kind):
    """Image, alpha and depth by the reference in double precision, and the pixels that are not near a threshold."""
    splats, size = deep_splats(kind)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), splats)
        truth = draw_both(wide, size, "reference")
    leaves = splats.mean, splats.factor, splats.opacity, splats.color
    return truth, ~judge.near_a_threshold(leaves, size, RenderOptions())


@pytest.mark.parametrize(("engine", "kind"), CASES)
def test_engines_agree_with_reference(engine, kind):
    splats, size = deep_splats(kind)
    truth, kept = judged(kind)
    found = draw_both(splats, size, engine)
    for one, other in zip(found, truth, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(np.asarray(one)[kept], np.asarray(other)[kept], atol=5e-5)
    if engine in ("cpu", "reference"):  # the image alone; it compiles longer with the others
        np.testing.assert_allclose(found[0], draw(splats, size, engine=engine), atol=1e-6)
    assert kind == "none" or (np.asarray(found[1]) > 0.5).any()


@pytest.mark.parametrize("engine", ["cpu", "xla", "reference"])
def test_background_shows_through_one_minus_alpha(engine):
    splats, size = deep_splats()
    (over, alpha, _), (black, *_) = (
        map(np.asarray, draw_both(splats, size, engine, behind)) for behind in (BACKGROUND, np.zeros(3))
    )
    np.testing.assert_allclose(over, black + (1 - alpha)[..., None] * np.asarray(BACKGROUND), atol=2e-6)
    assert 0 <= alpha.min() < 0.5 < alpha.max() <= 1 + 1e-6


def test_sums_over_sorted_gaussians():
    """Of a scene in space and a camera, z from the camera's position and axis, in double precision."""
    with jax.enable_x64(True):
        gaussians, camera = deep_scene(), next(random_cameras(1))
        depth = (np.asarray(gaussians.mean) - np.asarray(camera.position)) @ np.asarray(camera.rotation)[2]
        splats = view(gaussians, camera, SIZE)
        np.testing.assert_allclose(splats.depth, np.sort(depth), rtol=1e-12)
        options = RenderOptions(transmittance_stop=0.0)
        _, alpha, expected = draw(splats, SIZE, engine="reference", options=options, **BOTH)
        truth = direct_sums(splats, SIZE, options)
        np.testing.assert_allclose(alpha, truth[0], atol=1e-12)
        np.testing.assert_allclose(expected, truth[1], atol=1e-12)
        seen = np.asarray(alpha) > 0
        assert 0.05 < seen.mean() < 1  # and some pixels see nothing
        assert (np.asarray(expected)[~seen] == 0).all()
        assert depth.min() <= np.asarray(expected)[seen].min() < np.asarray(expected)[seen].max() <= depth.max()


def test_gradients_by_finite_differences():
    with jax.enable_x64(True):
        splats, size = deep_splats(dtype=np.float64)
        splats = jax.tree.map(lambda leaf: np.asarray(leaf)[:12], splats)
        weights = jnp.asarray(np.random.default_rng(2).normal(size=(2, *size)))

        def loss(splats):
            _, alpha, depth = render(splats, size, engine="reference", options=SMOOTH, **BOTH)
            return jnp.sum(alpha * weights[0]) + jnp.sum(alpha * depth * weights[1]) + depth[24, 30]

        check_slopes(loss, splats, ("mean", "factor", "opacity", "depth"), rtol=1e-6)


@functools.cache
def gradients(engine):
    splats, size = deep_splats()
    kept = judged("plain")[1].astype(np.float32)

    def loss(splats):
        _, alpha, depth = render(splats, size, engine=engine, **BOTH)
        return jnp.sum(kept * (alpha**2 + alpha * depth))

    return jax.tree.map(np.asarray, jax.jit(jax.grad(loss))(splats))


@pytest.mark.parametrize("engine", ["cpu", pytest.param("xla", marks=pytest.mark.slow)])
def test_gradients_agree_with_reference(engine):
    found, truth = gradients(engine), gradients("reference")
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(truth), strict=True):
        scale = max(1.0, float(np.abs(other).max()))
        np.testing.assert_allclose(one / scale, other / scale, atol=5e-5)
    assert np.abs(found.color).max() == 0
    assert np.abs(found.opacity).max() > 0.1


def test_order_of_the_results():
    splats, size = deep_splats("one")
    image, alpha, depth = render(splats, size, return_alpha=True, return_depth=True)
    assert (image.shape, alpha.shape, depth.shape) == ((*size, 3), size, size)
    np.testing.assert_array_equal(render(splats, size, return_alpha=True)[1], alpha)
    np.testing.assert_array_equal(render(splats, size, return_depth=True)[1], depth)
    np.testing.assert_allclose(depth[alpha > 0], splats.depth[0], rtol=1e-6)


ONE, ONE_SIZE = scene("one")
WRONG = [
    (lambda: render(ONE, ONE_SIZE, return_depth=True), r"splats\.depth: expected a depth of each splat.*project sets"),
    *(
        (
            lambda name=name: render(ONE, ONE_SIZE, compositing="sum", **{name: True}),
            "compositing: expected 'over' for alpha and depth, got 'sum'",
        )
        for name in ("return_alpha", "return_depth")
    ),
    (
        lambda: Splats2D(ONE.mean, ONE.factor, ONE.opacity, ONE.color, jnp.ones(2)),
        r"depth: expected shape \(1,\), that of opacity, got shape \(2,\)",
    ),
]


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_wrong_calls(call, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        call()
