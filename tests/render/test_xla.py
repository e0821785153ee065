"""What is the XLA engine's own: lists and rounds, tiles, long lists, retraces; scenes as hard as they come."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import check_slope, scene

from foldgauss.render import RenderOptions, Splats2D, render, tiles, xla

BACKGROUND = jnp.asarray([0.2, 0.4, 0.6])
draw = functools.partial(render, engine="xla", background=BACKGROUND)


def picture_and_grads(draw, splats, weights):
    def loss(splats):
        picture = draw(splats)
        return jnp.sum(picture * weights), picture

    grads, picture = jax.jit(jax.grad(loss, has_aux=True))(splats)
    return picture, *jax.tree.leaves(grads)


def weights_for(size, dtype=np.float32):
    return jnp.asarray(np.random.default_rng(1).normal(size=(*size, 3)).astype(dtype))


def check_same(ones, others, tolerance):
    for one, other in zip(ones, others, strict=True):
        one, other = np.asarray(one), np.asarray(other)
        scale = max(1.0, np.abs(other).max(initial=0))
        np.testing.assert_allclose(one / scale, other / scale, atol=tolerance)


def check_against_reference(splats, size, tolerance=2e-5, **how):
    """Picture and gradients, the judge in double precision on the same numbers."""
    weights = weights_for(size)
    ones = picture_and_grads(lambda s: render(s, size, engine="xla", **how), splats, weights)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), splats)
        others = picture_and_grads(
            lambda s: render(s, size, engine="reference", **how), wide, weights.astype(jnp.float64)
        )
        check_same(ones, others, tolerance)


@pytest.mark.parametrize(
    ("kind", "compositing"),
    [
        pytest.param("plain", "over", marks=pytest.mark.slow),
        pytest.param("needles", "sum", marks=pytest.mark.slow),
        ("curtain", "over"),
    ],
)
def test_rounds_change_nothing(kind, compositing):
    """With room for a few splats at a time, drawn in many rounds, the picture and the gradients are the same."""
    splats, size = scene(kind)
    weights, results = weights_for(size), []
    for capacity in (None, 64):
        options = RenderOptions(list_capacity=capacity)
        how = functools.partial(draw, size=size, compositing=compositing, options=options)
        results.append(picture_and_grads(how, splats, weights))
    check_same(*results, 1e-5)


def test_capacity_does_not_change_the_image(monkeypatch):
    """Eager, too: the room is counted, and bounded."""
    splats, size = scene("huge")
    truth = draw(splats, size)
    monkeypatch.setattr(tiles, "MAX_SLOTS", 64)
    np.testing.assert_allclose(draw(splats, size), truth, atol=1e-6)


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


def test_a_few_wide_splats_take_one_round_inside_jit():
    """Where sizes are not known there is room for splats that fill the picture, while they are few."""
    rng, size, plans = np.random.default_rng(0), (320, 640), []
    num = 12
    leaves = rng.uniform(0, 320, (num, 2)), np.tile(300 * np.eye(2), (num, 1, 1)), np.full(num, 0.1), np.ones((num, 3))
    leaves = [jnp.asarray(leaf, jnp.float32) for leaf in (*leaves, BACKGROUND)]
    jax.eval_shape(lambda leaves: plans.append(xla._plan(leaves, size, "over", RenderOptions())), leaves)
    _, (*_, rounds) = xla._render_fwd(plans[0], leaves)
    assert int(rounds) == 1
    jax.eval_shape(lambda leaves: plans.append(xla._plan(leaves, (8, 8), "over", RenderOptions())), leaves)
    assert plans[1].capacity < 2 * num  # but no more than that


@pytest.mark.slow
@pytest.mark.parametrize(("capacity", "most"), [(200, 2), pytest.param(64, 4, marks=pytest.mark.slow)])
def test_backward_is_linear_in_rounds(capacity, most, monkeypatch):
    """A round is drawn again from a start that was kept, not from the first; the gradient is that of one round."""
    splats, size = scene("huge")
    leaves, weights = leaves_of(splats), weights_for(size)
    calls, grads = counted(monkeypatch, "_composite_round"), []
    for options in (RenderOptions(), RenderOptions(list_capacity=capacity)):
        plan = xla._plan(leaves, size, "over", options)
        del calls[:]
        _, residuals = xla._render_fwd(plan, leaves)
        grads.append(jax.tree.leaves(xla._render_bwd(plan, residuals, weights)))
        jax.effects_barrier()
        rounds = int(residuals[-1])
        assert rounds <= len(calls) <= most * rounds
    assert rounds > 4
    check_same(*grads, 1e-5)


@pytest.mark.parametrize("size", [(40, 40), (44, 43)])
def test_pixels_outside_the_image_count_as_finished(size, monkeypatch):
    """Tiles that reach beyond the picture are left once dark like others."""
    splats, _ = scene("curtain")
    leaves, calls = leaves_of(splats), counted(monkeypatch, "_load")
    picture, _ = xla._render_fwd(xla._plan(leaves, size, "over", RenderOptions()), leaves)
    jax.effects_barrier()
    assert picture.shape == (*size, 3)
    assert 0 < len(calls) < len(splats.mean) / xla.CHUNK / 4


@pytest.mark.parametrize(
    "tile_size", [pytest.param(4, marks=pytest.mark.slow), 7, pytest.param(32, marks=pytest.mark.slow)]
)
def test_tile_size_changes_nothing(tile_size):
    splats, size = scene("plain")
    weights = weights_for(size)
    results = [
        picture_and_grads(functools.partial(draw, size=size, options=RenderOptions(tile_size=tile)), splats, weights)
        for tile in (None, tile_size)
    ]
    check_same(*results, 1e-5)


@pytest.mark.slow
def test_batches_of_tiles(monkeypatch):
    """Cut into many small batches, the last of them not full, the picture is the same."""
    splats, size = scene("plain")
    weights, how = weights_for(size), functools.partial(draw, size=size)
    whole = picture_and_grads(how, splats, weights)
    monkeypatch.setattr(xla, "BATCH_PIXELS", {"cpu": 700, "other": 700})
    check_same(picture_and_grads(lambda s: how(s), splats, weights), whole, 1e-5)


@pytest.mark.slow
def test_unrolled_chunks(monkeypatch):
    """The form for GPUs gives the same."""
    splats, size = scene("plain")
    weights, how = weights_for(size), functools.partial(draw, size=size, options=RenderOptions(tile_size=6))
    whole = picture_and_grads(how, splats, weights)
    jax.clear_caches()
    monkeypatch.setattr(xla, "_unroll", lambda: 4)
    check_same(picture_and_grads(lambda s: how(s), splats, weights), whole, 1e-5)
    jax.clear_caches()


def test_a_hundred_thousand_splats_on_one_pixel():
    """Against the closed form: n equal alphas leave (1 - alpha)^n of the light."""
    num, alpha = 100_000, 1e-5
    mean, factor = jnp.full((num, 2), 8.5), jnp.tile(0.2 * jnp.eye(2), (num, 1, 1))
    color = jnp.ones((num, 3)).at[num // 2 :].set(0.0)
    options = RenderOptions(alpha_cutoff=1e-8, low_pass=0.0)

    def center(opacity):
        return render(Splats2D(mean, factor, opacity, color), (17, 17), engine="xla", options=options)[8, 8, 0]

    value, gradient = jax.value_and_grad(center)(jnp.full(num, alpha))
    behind_half = np.exp(num / 2 * np.log1p(-alpha))
    assert float(value) == pytest.approx(1 - behind_half, rel=1e-4)
    # Splat i of the white half takes light from the white ones behind it: T_i (1 - B_i) = (1 - alpha)^(n/2 - 1).
    np.testing.assert_allclose(gradient[: num // 2], behind_half, rtol=2e-3)
    np.testing.assert_allclose(gradient[num // 2 :], 0, atol=1e-3)


@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_long_needles(compositing):
    """1e4 : 1, at all angles."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, np.pi, 40)
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(-1, 2, 2)
    factor = turn * np.asarray([3000.0, 0.3])
    leaves = rng.uniform(0, 50, (40, 2)), factor, rng.uniform(0.1, 0.9, 40), rng.uniform(0, 1, (40, 3))
    splats = Splats2D(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))
    # A rounding of the angle moves a needle's flank by 1e-4 px at 3000 px: float32 has no more.
    check_against_reference(splats, (37, 53), 1e-3, compositing=compositing, options=RenderOptions(alpha_cutoff=1e-6))


@pytest.mark.parametrize(
    ("engine", "scale", "bound"),
    [
        *(("xla", scale, 1e-5) for scale in (1e-6, 1e-3, 1e3, 1e6)),
        *(("cpu", scale, 1e-5) for scale in (1e-3, 1e3, 1e6)),
        ("cpu", 1e-6, 0.05),  # it takes P column - P X along a row, of which float32 then keeps one digit
    ],
)
def test_sizes(engine, scale, bound):
    """On pixels' centres, so that the smallest are seen at all."""
    rng = np.random.default_rng(0)
    mean = rng.integers(0, 30, (50, 2)) + 0.5
    factor = scale * rng.normal(size=(50, 2, 2))
    leaves = mean, factor, rng.uniform(0, 1, 50), rng.uniform(0, 1, (50, 3))
    splats = Splats2D(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))
    options = RenderOptions(low_pass=0.0, alpha_cutoff=1e-6) if scale < 1 else RenderOptions()
    size = (30, 30)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), splats)
        truth = render(wide, size, engine="reference", options=options)
    np.testing.assert_allclose(render(splats, size, engine=engine, options=options), truth, atol=bound)


def test_far_outside():
    splats, size = scene("plain")
    away = jnp.asarray([1e5, -1e5, 1e9, -1e30, 3e38])
    mean = jnp.concatenate([splats.mean, jnp.stack([away, away[::-1]], -1), jnp.stack([away, 0 * away + 5], -1)])
    extended = Splats2D(
        mean,
        jnp.concatenate([splats.factor, jnp.tile(jnp.eye(2), (10, 1, 1))]),
        jnp.concatenate([splats.opacity, jnp.ones(10)]),
        jnp.concatenate([splats.color, jnp.ones((10, 3))]),
    )
    weights, how = weights_for(size), functools.partial(draw, size=size)
    with_them, without = (picture_and_grads(how, one, weights) for one in (extended, splats))
    np.testing.assert_allclose(with_them[0], without[0], atol=1e-6)
    for one, other in zip(with_them[1:], without[1:], strict=True):
        np.testing.assert_allclose(one[: len(other)], other, atol=1e-4)
        assert not np.asarray(one)[len(other) :].any()


@pytest.mark.parametrize("leaf", ["mean", "factor", "opacity", "color"])
@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_gradient_by_finite_differences(leaf, compositing):
    with jax.enable_x64(True):
        splats, size = scene("plain", dtype=np.float64)
        splats = jax.tree.map(lambda leaf: leaf[:12], splats)
        options = RenderOptions(alpha_cutoff=1e-8, alpha_ceiling=1.0, transmittance_stop=0.0)  # smooth
        weights = weights_for(size, np.float64)

        def loss(splats):
            return jnp.sum(draw(splats, size, compositing=compositing, options=options) * weights)

        check_slope(loss, splats, leaf, rtol=1e-5)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
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

    before = xla._render_jit._cache_size()
    for shift in (0.0, 0.5, 1.0):
        moved = Splats2D(splats.mean + shift, splats.factor, splats.opacity, splats.color)
        step(moved)
        draw(moved, size)
    assert len(traces) == 1
    assert xla._render_jit._cache_size() <= before + 2  # one inside the jitted step, one eager


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
