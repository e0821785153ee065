"""What is the XLA engine's own: lists and rounds, tiles, long lists, retraces; scenes as hard as they come."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import judge
import numpy as np
import pytest
from scenes import check_slopes, scene
from scenes import draw as compiled_draw
from test_engines import BACKGROUND, LEAVES, grads_and_picture, weights_for

from foldgauss.render import RenderOptions, Splats2D, render, rounds, tiles, xla

draw = functools.partial(render, engine="xla", background=BACKGROUND)


#: With a cutoff that hides no error, and compiled once for most tests.
SMOOTH = RenderOptions(alpha_cutoff=1e-6)


def picture_and_grads(splats, size, compositing="over", options=SMOOTH):
    """With a random incoming gradient; the picture first, the background's gradient last."""
    grads, picture = grads_and_picture("xla", size, compositing, options, splats, BACKGROUND, weights_for(size))
    return picture, *jax.tree.leaves(grads)


def check_same(ones, others, tolerance):
    for one, other in zip(ones, others, strict=True):
        one, other = np.asarray(one), np.asarray(other)
        scale = max(1.0, np.abs(other).max(initial=0))
        np.testing.assert_allclose(one / scale, other / scale, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [None, 64])
@pytest.mark.parametrize("tile_size", [None, 4, 7, 32])
@pytest.mark.parametrize(("kind", "compositing"), [("plain", "over"), ("needles", "sum"), ("curtain", "over")])
def test_each_of_rounds_and_tiles_changes_nothing(kind, compositing, tile_size, capacity):
    splats, size = scene(kind)
    least = -(-size[0] // (tile_size or xla.TILE_SIZE)) * -(-size[1] // (tile_size or xla.TILE_SIZE))
    options = dataclasses.replace(SMOOTH, tile_size=tile_size, list_capacity=capacity and max(capacity, least))
    found = picture_and_grads(splats, size, compositing, options)
    check_same(picture_and_grads(splats, size, compositing), found, 1e-5)


@pytest.mark.slow
def test_capacity_does_not_change_the_image(monkeypatch):
    """Eager, too: the room is counted, and bounded."""
    splats, size = scene("huge")
    truth, *_ = picture_and_grads(splats, size)
    monkeypatch.setattr(tiles, "MAX_SLOTS", 64)
    np.testing.assert_allclose(draw(splats, size, options=SMOOTH), truth, atol=1e-6)


def counted(monkeypatch, name):
    """A list that grows with every run, not trace, of a function of the engine."""
    calls, function = [], getattr(xla, name)

    def counting(*arguments):
        jax.debug.callback(lambda: calls.append(None))
        return function(*arguments)

    monkeypatch.setattr(xla, name, counting)
    return calls


def leaves_of(splats):
    return splats.mean, splats.factor, splats.opacity, splats.color, BACKGROUND


@pytest.mark.slow
def test_a_few_wide_splats_take_one_round_inside_jit():
    """Where sizes are not known there is room for splats that fill the picture, while they are few."""
    rng, size, plans = np.random.default_rng(0), (320, 640), []
    num = 12
    leaves = rng.uniform(0, 320, (num, 2)), np.tile(300 * np.eye(2), (num, 1, 1)), np.full(num, 0.1), np.ones((num, 3))
    leaves = [jnp.asarray(leaf, jnp.float32) for leaf in (*leaves, BACKGROUND)]
    jax.eval_shape(lambda leaves: plans.append(xla.choose_plan(leaves, size, "over", RenderOptions())), leaves)
    _, (*_, count) = jax.jit(rounds.render_forward, static_argnums=(0, 1))(xla.ENGINE, plans[0], leaves)
    assert int(count) == 1
    jax.eval_shape(lambda leaves: plans.append(xla.choose_plan(leaves, (8, 8), "over", RenderOptions())), leaves)
    assert plans[1].capacity < 2 * num  # but no more than that


@pytest.mark.slow
@pytest.mark.parametrize(("capacity", "most"), [(1600, 2), (320, 4)])
def test_backward_is_linear_in_rounds(capacity, most, monkeypatch):
    """A round is drawn again from a start that was kept, not from the first; the gradient is that of one round."""
    splats, size = scene("huge")
    leaves, weights = leaves_of(splats), weights_for(size)
    calls, grads = counted(monkeypatch, "_composite"), []
    engine = xla.ENGINE._replace(composite=xla._composite)
    for options in (RenderOptions(), RenderOptions(list_capacity=capacity)):
        plan = xla.choose_plan(leaves, size, "over", options)
        del calls[:]
        _, residuals = rounds.render_forward(engine, plan, leaves)
        grads.append(jax.tree.leaves(rounds.render_backward(engine, plan, residuals, weights)))
        jax.effects_barrier()
        num = int(residuals[-1])
        assert num <= len(calls) <= most * num
    assert num > 4
    check_same(*grads, 1e-5)


@pytest.mark.slow
def test_pixels_outside_the_image_count_as_finished(monkeypatch):
    """Tiles that reach beyond the picture are left once dark like others."""
    splats, size = scene("curtain")[0], (44, 43)
    num = 4 * len(splats.mean)
    leaves = [jnp.asarray(np.concatenate([leaf] * 4)) for leaf in map(np.asarray, jax.tree.leaves(splats))] + [
        BACKGROUND
    ]
    calls = counted(monkeypatch, "_load")
    plan = xla.choose_plan(leaves, size, "over", RenderOptions())
    picture, _ = jax.jit(lambda leaves: rounds.render_forward(xla.ENGINE, plan, leaves))(leaves)
    jax.effects_barrier()
    assert picture.shape == (*size, 3)
    assert 0 < len(calls) < num / xla.CHUNK / 4


@pytest.mark.slow
@pytest.mark.parametrize(("name", "value"), [("BATCH_PIXELS", {"cpu": 700, "other": 700}), ("_unroll", lambda: 4)])
def test_small_batches_and_unrolled_chunks(name, value, monkeypatch):
    """Many small batches of tiles, the last of them not full, and the form for GPUs give the same."""
    splats, size = scene("plain")
    options = dataclasses.replace(SMOOTH, tile_size=6)
    whole = picture_and_grads(splats, size, options=options)
    jax.clear_caches()
    monkeypatch.setattr(xla, name, value)
    check_same(picture_and_grads(splats, size, options=options), whole, 1e-5)
    jax.clear_caches()


@pytest.mark.slow
def test_a_hundred_thousand_splats_on_one_pixel():
    """Against the closed form: n equal alphas leave (1 - alpha)^n of the light."""
    num, alpha = 100_000, 1e-5
    mean, factor = np.full((num, 2), 8.5), np.tile(0.2 * np.eye(2), (num, 1, 1))
    color = (np.arange(num) < num // 2)[:, None]
    mean, factor, color = (jnp.asarray(leaf, jnp.float32) for leaf in (mean, factor, color))
    options = RenderOptions(alpha_cutoff=1e-8, low_pass=0.0)

    def center(opacity):
        return render(Splats2D(mean, factor, opacity, color), (17, 17), engine="xla", options=options)[8, 8, 0]

    value, gradient = jax.value_and_grad(center)(jnp.full(num, alpha))
    behind_half = np.exp(num / 2 * np.log1p(-alpha))
    assert float(value) == pytest.approx(1 - behind_half, rel=1e-4)
    # Splat i of the white half takes light from the white ones behind it: T_i (1 - B_i) = (1 - alpha)^(n/2 - 1).
    np.testing.assert_allclose(np.asarray(gradient)[: num // 2], behind_half, rtol=2e-3)
    np.testing.assert_allclose(np.asarray(gradient)[num // 2 :], 0, atol=1e-3)


@pytest.mark.parametrize("scale", [1e-6, 1e6, *(pytest.param(scale, marks=pytest.mark.slow) for scale in (1e-3, 1e3))])
def test_sizes(scale):
    """On pixels' centers, so that the smallest are seen at all."""
    rng, num, size = np.random.default_rng(0), 50, (30, 30)
    mean = rng.integers(0, 30, (num, 2)) + 0.5
    factor = scale * rng.normal(size=(num, 2, 2))
    leaves = mean, factor, rng.uniform(0, 1, num), rng.uniform(0, 1, (num, 3)), BACKGROUND
    *leaves, background = (np.asarray(leaf, np.float32) for leaf in leaves)
    splats, options = Splats2D(*map(jnp.asarray, leaves)), dataclasses.replace(SMOOTH, low_pass=0.0)
    _, truth = judge.grads_and_picture([*leaves, background], size, np.zeros((*size, 3)), "over", options)
    # Of the smallest, "cpu" takes P column - P X along a row, of which float32 then keeps one digit.
    for engine, bound in (("xla", 1e-5), ("cpu", 0.05 if scale == 1e-6 else 1e-5)):
        picture = compiled_draw(splats, size, engine=engine, background=BACKGROUND, options=options)
        np.testing.assert_allclose(picture, truth, atol=bound, err_msg=engine)


@pytest.mark.slow
@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_gradient_by_finite_differences(compositing):
    with jax.enable_x64(True):
        splats, size = scene("plain", dtype=np.float64)
        splats = jax.tree.map(lambda leaf: np.asarray(leaf)[:12], splats)
        options = RenderOptions(alpha_cutoff=1e-8, alpha_ceiling=1.0, transmittance_stop=0.0)  # smooth
        weights = weights_for(size).astype(jnp.float64)

        def loss(splats):
            return jnp.sum(draw(splats, size, compositing=compositing, options=options) * weights)

        check_slopes(loss, splats, LEAVES, rtol=1e-5)


@pytest.mark.parametrize("dtype", [jnp.float16, pytest.param(jnp.bfloat16, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_half_precision_is_rendered_in_single(dtype):
    splats, size = scene("plain")
    half = jax.tree.map(lambda leaf: leaf.astype(dtype), splats)
    back = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), half)
    picture = render(half, size, engine="xla")
    assert picture.dtype == dtype
    np.testing.assert_array_equal(picture, render(back, size, engine="xla").astype(dtype))


def test_retraces():
    """A jitted picture traces once; eager ones compile once while the room needed stays within a power of two."""
    splats, size = scene("plain")
    traces = []

    @jax.jit
    def step(splats):
        traces.append(None)
        return draw(splats, size)

    before = rounds.render_rounds._cache_size()
    for shift in (0.0, 0.5, 1.0):
        moved = dataclasses.replace(splats, mean=splats.mean + shift)
        step(moved)
        draw(moved, size)
    assert len(traces) == 1
    assert rounds.render_rounds._cache_size() <= before + 2  # one inside the jitted step, one eager


@pytest.mark.slow
def test_vmap_of_gradients():
    """A batch of different scenes: each one's lists and rounds are its own."""
    splats, size = scene("plain")
    others = Splats2D(splats.mean[::-1] * 0.5, splats.factor * 2, splats.opacity, splats.color)
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), splats, others)
    options = RenderOptions(list_capacity=256)
    gradient = jax.grad(lambda s: jnp.sum(draw(s, size, options=options) ** 2))
    together = jax.vmap(gradient)(stack)
    for k, one in enumerate((splats, others)):
        check_same([leaf[k] for leaf in jax.tree.leaves(together)], jax.tree.leaves(gradient(one)), 1e-5)
