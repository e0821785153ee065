"""Every engine against the judge, `reference`: pictures and all gradients."""

import dataclasses
import functools
import os
import subprocess
import sys
import textwrap
import types

import jax
import jax.numpy as jnp
import judge
import numpy as np
import pytest
from scenes import KINDS, check_slopes, draw, scene

from foldgauss.render import Camera, Gaussians3D, RenderOptions, Splats2D, cpu, project, render

#: Engine "pallas" takes no ceiling of 1 and, interpreted, long to compile: test_pallas.py. Here "auto" is "cpu".
OTHERS = ["cpu", "xla", "reference"]
CPU = ["cpu", *(pytest.param(engine, marks=pytest.mark.slow) for engine in ("xla", "reference"))]
LEAVES = ("mean", "factor", "opacity", "color")
BACKGROUND = jnp.asarray([0.2, 0.4, 0.6])
OPTIONS = {"default": RenderOptions(), "sharp": RenderOptions(low_pass=0.01, transmittance_stop=0.0)}


def weights_for(size, avoid=False):
    """A random incoming gradient, zero on the pixels to avoid."""
    weights = np.random.default_rng(1).normal(size=(*size, 3)).astype(np.float32)
    return jnp.asarray(weights * ~np.broadcast_to(avoid, size)[..., None])


#: XLA takes seconds to compile each: half of the combinations.
CASES = [("cpu", compositing, name) for compositing in ("over", "sum") for name in OPTIONS]
CASES += [("xla", "over", "default"), ("xla", "sum", "sharp")]
#: Of the sums, which are simpler, and where XLA compiles or options are sharp, only these; the long runs take the rest.
QUICK = ("plain", "needles", "curtain", "none")
QUICK_OVER = (*QUICK, "huge", "opaque", "giant")
COMBINATIONS = [
    pytest.param(*case, kind, marks=[] if case == ("cpu", "over", "default") or kind in quick else [pytest.mark.slow])
    for case in CASES
    for quick in [QUICK_OVER if case[1:] == ("over", "default") else QUICK if case[0] == "cpu" else ()]
    for kind in KINDS
]


@jax.jit(static_argnums=(0, 1, 2, 3))
def grads_and_picture(engine, size, compositing, options, splats, background, weights):
    def loss(splats, background):
        drawn = {"background": background, "engine": engine, "compositing": compositing, "options": options}
        picture = render(splats, size, **drawn)
        return jnp.sum(picture * weights), picture

    return jax.grad(loss, (0, 1), has_aux=True)(splats, background)


@functools.cache
def judged(kind, compositing, options):
    """Pixels near a threshold, gradients and picture: the judge works in double precision on the same numbers."""
    splats, size = scene(kind)
    leaves = *jax.tree.leaves(splats), BACKGROUND
    avoid = judge.near_a_threshold(leaves[:4], size, OPTIONS[options])
    return avoid, *judge.grads_and_picture(leaves, size, weights_for(size, avoid), compositing, OPTIONS[options])


@pytest.mark.parametrize(("engine", "compositing", "options", "kind"), COMBINATIONS)
def test_agrees_with_reference(engine, compositing, options, kind):
    splats, size = scene(kind)
    judgement = judged(kind, compositing, options)
    avoid, options = judgement[0], OPTIONS[options]
    assert avoid.mean() < 0.5 or avoid.size == 1
    leaves = splats, BACKGROUND, weights_for(size, avoid)
    found = grads_and_picture(engine, size, compositing, options, *leaves)
    judge.check(*found, *judgement, band=2.5 * options.alpha_cutoff)  # a splat more or less


def garbage(shape, dtype):
    return np.full(shape, np.nan if np.issubdtype(dtype, np.floating) else -7, dtype)


def test_cpu_in_chunks(monkeypatch):
    """Chunks of splats, rows of tiles and their order change neither the image nor the gradients.

    Nor does what was in the memory before.
    """
    splats, size = scene("plain")
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(splats)] + [np.zeros(3, np.float32)]
    weights = np.random.default_rng(0).normal(size=(3, *size)).astype(np.float32)
    results = []
    for chunk in (cpu.SPLATS_PER_TASK, 32):
        monkeypatch.setattr(cpu, "SPLATS_PER_TASK", chunk)
        trace = cpu.forward(*leaves, size)
        results.append([trace.image, *cpu.backward(trace, weights)])
        monkeypatch.setattr(cpu, "SINGLE_TASK_NS", 0)
        monkeypatch.setattr(cpu, "run_tasks", lambda task, items: [task(item) for item in reversed(items)])
        monkeypatch.setattr(cpu, "np", types.SimpleNamespace(**{**vars(np), "empty": garbage}))
    assert len(trace.parts) == 4
    for one, two in zip(*results, strict=True):
        np.testing.assert_array_equal(one, two)


def test_lists_end_where_all_pixels_are_finished():
    splats, size = scene("curtain")
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(splats)] + [np.zeros(3, np.float32)]
    trace = cpu.forward(*leaves, size)
    assert sum((stop - start[:-1]).sum() for start, _, stop, _ in trace.lists) * cpu.PIXELS < trace.num_pairs / 2
    # Pixels of a tile outside the image do not count: these splats do not reach the tile's corner.
    splats = (
        np.full((130, 2), 5),
        np.tile(4 * np.eye(2), (130, 1, 1)),
        np.full(130, 0.9),
        np.ones((130, 3)),
        np.zeros(3),
    )
    for size in ((10, 10), (16, 10), (10, 16)):
        assert cpu.forward(*map(np.float32, splats), size).lists[0][2] == (64 if size == (10, 10) else 130), size


@pytest.mark.parametrize("compositing", ["over", pytest.param("sum", marks=pytest.mark.slow)])
def test_reference_gradient_by_finite_differences(compositing):
    with jax.enable_x64(True):
        splats, size = scene("plain", dtype=np.float64)
        splats = jax.tree.map(lambda leaf: np.asarray(leaf)[:12], splats)
        # No cutoff that a step could cross, no ceiling: the picture is smooth.
        options = RenderOptions(alpha_cutoff=1e-8, alpha_ceiling=1 - 1e-12, transmittance_stop=0.0)
        weights = jnp.asarray(np.random.default_rng(2).normal(size=(*size, 3)))

        def loss(splats):
            picture = render(splats, size, engine="reference", compositing=compositing, options=options)
            return jnp.sum(picture * weights)

        check_slopes(loss, splats, LEAVES, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="core affinity exists on Linux only; CI runs it there")
def test_jit_pinned_to_one_core():
    """A callback inside jit was seen to hang on one core; `jax_cpu_enable_async_dispatch=False` is the known cure."""
    script = """
        import os
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        import jax, jax.numpy as jnp
        from foldgauss.render import Splats2D, render
        size = (640, 1280)
        key = jax.random.key(0)
        splats = Splats2D(jax.random.uniform(key, (2000, 2)) * 640, 5 * jnp.tile(jnp.eye(2), (2000, 1, 1)),
                          jnp.full(2000, 0.5), jnp.ones((2000, 3)))
        target = jnp.zeros((*size, 3))

        @jax.jit
        def step(splats):
            loss, grads = jax.value_and_grad(lambda s: jnp.mean((render(s, size) - target) ** 2))(splats)
            return loss, jax.tree.map(lambda p, g: p - g, splats, grads)

        for _ in range(5):
            loss, splats = step(splats)
        in_flight = [step(splats) for _ in range(4)]
        print(float(loss), len(jax.block_until_ready(in_flight)))
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=150, check=True)  # a hang is a failure
    loss, count = ran.stdout.split()
    assert 0 < float(loss) < 1
    assert count == "4"


@pytest.mark.parametrize("engine", ["cpu", pytest.param("xla", marks=pytest.mark.slow)])
def test_jit_and_vmap(engine):
    splats, size = scene("plain")
    draw = functools.partial(render, size=size, engine=engine, background=BACKGROUND)
    truth = np.asarray(draw(splats))
    near = {"rtol": 0} if engine == "cpu" else {"atol": 1e-6}  # one kernel, the same bits; XLA fuses anew
    _, jitted = grads_and_picture(engine, size, "over", OPTIONS["default"], splats, BACKGROUND, weights_for(size))
    np.testing.assert_allclose(jitted, truth, **near)
    moved = jnp.stack([splats.mean, splats.mean + 3])
    stack = jax.vmap(lambda mean: draw(Splats2D(mean, splats.factor, splats.opacity, splats.color)))(moved)
    np.testing.assert_allclose(np.asarray(stack)[0], truth, **near)
    assert np.abs(np.asarray(stack)[1] - truth).max() > 1e-2


@pytest.mark.parametrize(
    "engine", ["cpu", "xla", *(pytest.param(engine, marks=pytest.mark.slow) for engine in ("reference", "pallas"))]
)
@pytest.mark.parametrize("leaf", LEAVES)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_splats_that_are_not_finite_are_left_out(engine, leaf, value):
    """In the picture and in every gradient, as if it were fully transparent; its own gradient is 0."""
    splats, size = scene("plain")

    def changed(leaf, value):
        values = np.array(getattr(splats, leaf))
        values[3] = value
        own = dataclasses.replace(splats, **{leaf: jnp.asarray(values)})
        return grads_and_picture(engine, size, "over", OPTIONS["default"], own, BACKGROUND, weights_for(size))

    (grads, picture), (others, truth) = changed(leaf, value), changed("opacity", 0)
    np.testing.assert_allclose(picture, truth, atol=1e-6)
    for one, other in zip(jax.tree.leaves(grads), jax.tree.leaves(others), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3, rtol=1e-4)
    assert not any(np.asarray(one)[3].any() for one in jax.tree.leaves(grads[0]))


@pytest.mark.parametrize("engine", ["cpu", "xla"])
def test_far_outside(engine):
    """Splats nowhere near the picture are as if they were fully transparent."""
    splats, size = scene("plain")
    mean, factor, opacity, color = map(np.array, jax.tree.leaves(splats))
    opacity[-10:] = 0
    without = Splats2D(*map(jnp.asarray, (mean, factor, opacity, color)))
    away = np.asarray([1e5, -1e5, 1e9, -1e30, 3e38])
    mean[-10:] = np.concatenate([np.stack([away, away[::-1]], -1), np.stack([away, 0 * away + 5], -1)])
    factor[-10:], opacity[-10:], color[-10:] = np.eye(2), 1, 1
    with_them = Splats2D(*map(jnp.asarray, (mean, factor, opacity, color)))
    (grads, picture), (others, truth) = (
        grads_and_picture(engine, size, "over", OPTIONS["default"], one, BACKGROUND, weights_for(size))
        for one in (with_them, without)
    )
    np.testing.assert_allclose(picture, truth, atol=1e-6)
    for one, other in zip(jax.tree.leaves(grads), jax.tree.leaves(others), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    assert not any(np.asarray(one)[-10:].any() for one in jax.tree.leaves(grads[0]))


def center_of_one(engine, factor):
    """Of a splat on a pixel's center, where a thin splat's alpha does not vanish; with no low pass to save it.

    That the picture and all gradients are finite is checked.
    """
    leaves = np.full((1, 2), 8.5), np.asarray([factor]), np.full(1, 0.5), np.ones((1, 3))
    splats, size = Splats2D(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves)), (17, 40)
    leaves = splats, jnp.zeros(3), weights_for(size)
    grads, picture = jax.tree.map(np.asarray, grads_and_picture(engine, size, "over", RenderOptions.exact(), *leaves))
    assert all(np.isfinite(leaf).all() for leaf in (picture, *jax.tree.leaves(grads)))
    return float(picture[8, 8, 0])


SLOW_SCALES = [pytest.param(scale, marks=pytest.mark.slow) for scale in (1e-20, 1e5, 1e15, np.inf)]


@pytest.mark.parametrize("scale", [0.0, 1e-38, 3e-7, 1e-5, 2.7e6, 1e25, np.nan, *SLOW_SCALES])
@pytest.mark.parametrize("other", [1.0, None])
@pytest.mark.parametrize("engine", OTHERS)
def test_gradients_of_extreme_splats_are_finite(engine, scale, other):
    center = center_of_one(engine, np.diag([scale, scale if other is None else other]))
    if 1e-5 <= scale <= 1e8:
        assert center == pytest.approx(0.5, abs=1e-4)


#: Lower and upper triangular factors, and whether a splat of theirs is drawn: thickness along y at fixed x, and width.
SLANTED = [
    ([[1e12, 0], [1e-5, 1e-23]], False),  # q of 1e23: its square is no float32
    ([[1e38, 0], [1e-3, 1]], False),
    ([[1e10, 0], [0, 1]], False),
    ([[1, 0], [1e10, 1]], False),
    ([[1e10, 0], [0, 1e-5]], False),
    ([[1e3, 0], [1, 1e-8]], False),
    ([[1, 1e8], [0, 1]], False),
    ([[8e-7, 0], [0, 1]], False),  # the bound of the thickness is 8.5e-7 px
    ([[1, 0], [0, 8e-7]], False),
    ([[9e-7, 0], [0, 1]], True),
    ([[1, 0], [0, 9e-7]], True),
    ([[1e3, 0], [1e3, 1e-4]], True),
    ([[1e5, 0], [1, 1]], True),
    ([[0, 1e6], [1, 0]], True),
    ([[1, 1e4], [0, 1e3]], True),
]


@pytest.mark.parametrize(("factor", "drawn"), SLANTED)
def test_engines_agree_on_which_slanted_splats_are_rendered(factor, drawn):
    """Alpha is the opacity however thin the splat is."""
    for engine in OTHERS:
        assert center_of_one(engine, factor) == pytest.approx(0.5 if drawn else 0.0, abs=1e-4), engine


def test_auto_is_the_cpu_without_a_gpu():
    """Whatever the tiles of other engines."""
    splats, size = scene("plain")
    drawn = (render(splats, size, options=RenderOptions(tile_size=own), engine="auto") for own in (None, 8))
    for image in drawn:
        np.testing.assert_array_equal(image, render(splats, size, engine="cpu"))


def test_a_second_call_compiles_nothing(caplog):
    """Outside jit, too: a callback made anew would cost some 15 ms a call."""
    splats, size = scene("plain")
    gradient = jax.grad(lambda color: render(dataclasses.replace(splats, color=color), size, engine="cpu").sum())
    for call in (lambda: render(splats, size, engine="cpu"), lambda: gradient(splats.color)):
        call()
        with jax.log_compiles():
            caplog.clear()
            call()
            assert not caplog.records
            jax.jit(lambda x: x + 1)(0.0)
            assert caplog.records  # so they are seen


@pytest.mark.parametrize(
    ("engine", "channels"),
    [("cpu", 1), ("cpu", 5), *(pytest.param("xla", number, marks=pytest.mark.slow) for number in (1, 5))],
)
def test_channels(engine, channels):
    splats, size = scene("plain")
    color = np.random.default_rng(0).uniform(size=(len(splats.mean), channels)).astype(np.float32)
    leaves = [*jax.tree.leaves(splats)[:3], color]
    given = np.random.default_rng(1).normal(size=(*size, channels))
    truth, image = judge.grads_and_picture([*leaves, np.zeros(channels)], size, given, "over", RenderOptions())
    own = Splats2D(*map(jnp.asarray, leaves))
    np.testing.assert_allclose(draw(own, size, engine=engine), image, atol=1e-5)
    grads = jax.grad(lambda splats: jnp.vdot(draw(splats, size, engine=engine), jnp.float32(given)))(own)
    for found, expected in zip(jax.tree.leaves(grads), truth, strict=False):
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("compositing", "engine"),
    [
        *((compositing, engine) for compositing in ("over", "sum") for engine in ("cpu", "reference")),
        *(pytest.param(compositing, "xla", marks=pytest.mark.slow) for compositing in ("over", "sum")),
    ],
)
def test_exact_options_match_the_equation(engine, compositing):
    """The picture by its definition, in NumPy and double precision, with opacities of 0 and 1."""
    with jax.enable_x64(True):
        splats, size = scene("plain", dtype=np.float64)
        mean, factor, opacity, color = (np.array(leaf)[:60] for leaf in jax.tree.leaves(splats))
        opacity[:10], opacity[10:20] = 1, 0
        splats = Splats2D(*map(jnp.asarray, (mean, factor, opacity, color)))
        how = {"compositing": compositing, "engine": engine, "options": RenderOptions.exact()}
        picture = np.asarray(draw(splats, size, background=BACKGROUND, **how))
    assert picture.dtype == np.float64
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    offsets = np.stack([x, y], -1)[:, :, None] - mean
    inverse = np.linalg.inv(factor @ factor.transpose(0, 2, 1))
    alpha = opacity * np.exp(-0.5 * np.einsum("hwni,nij,hwnj->hwn", offsets, inverse, offsets))
    behind = np.cumprod(1 - alpha, axis=-1) if compositing == "over" else np.ones_like(alpha)
    light = np.concatenate([np.ones((*size, 1)), behind], axis=-1)
    truth = (alpha * light[..., :-1]) @ color + light[..., -1:] * np.asarray(BACKGROUND, np.float64)
    np.testing.assert_allclose(picture, truth, atol=1e-6)  # 60 splats dropped at alpha 1e-8


@pytest.mark.parametrize("engine", CPU)
def test_support_radius(engine):
    """Inside the radius nothing changes, outside nothing is drawn."""
    splats = Splats2D(jnp.asarray([[20.5, 20.5]]), 4 * jnp.eye(2)[None], jnp.asarray([0.9]), jnp.ones((1, 3)))
    whole, cut = (
        np.asarray(draw(splats, (41, 41), engine=engine, options=RenderOptions(low_pass=0.0, support_radius=radius)))
        for radius in (None, 2.0)
    )
    y, x = np.mgrid[:41, :41] - 20
    inside = np.hypot(x, y) <= 8
    np.testing.assert_array_equal(cut, np.where(inside[..., None], whole, 0))
    assert float(whole[20, 30, 0]) > 1 / 255


@pytest.mark.parametrize("engine", CPU)
def test_gradient_at_alpha_one(engine):
    """An opaque splat's center on a pixel's, no ceiling: what lies behind has no light, but alpha has its gradient."""
    with jax.enable_x64(True):
        color = jnp.asarray([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0]], jnp.float64)
        mean, factor = jnp.full((2, 2), 2.5, jnp.float64), jnp.stack([2 * jnp.eye(2, dtype=jnp.float64)] * 2)
        options = RenderOptions.exact()

        def center(opacity):
            splats = Splats2D(mean, factor, opacity, color)
            return render(splats, (5, 5), background=BACKGROUND, engine=engine, options=options)[2, 2]

        jacobian = jax.jit(jax.jacrev(center))(jnp.asarray([1.0, 0.5], jnp.float64))
    np.testing.assert_allclose(jacobian[:, 1], 0, atol=1e-12)
    # The pixel is finished behind alpha 1, so the second splat is not looked at: the background is what lies behind.
    np.testing.assert_allclose(jacobian[:, 0], np.asarray(color[0]) - np.asarray(BACKGROUND), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"engine": "gpu"}, "engine"),
        ({"compositing": "under"}, "compositing"),
        ({"size": (0, 10)}, "size"),
        ({"size": (10,)}, "size"),
        ({"size": ("a", 3)}, "size"),
        ({"size": None}, "size"),
        ({"size": (float("inf"), 3)}, "size"),
        ({"background": jnp.zeros(4)}, "background"),
        ({"size": (True, 10)}, "size"),
        ({"engine": "xla", "options": RenderOptions(list_capacity=10)}, "list_capacity"),
    ],
)
def test_invalid_arguments_raise(changes, message):
    splats, size = scene("plain")
    with pytest.raises(ValueError, match=message):
        render(splats, **({"size": size} | changes))


@pytest.mark.parametrize("engine", OTHERS)
def test_colors_without_a_channel_raise(engine):
    splats, size = scene("plain")
    bare = Splats2D(splats.mean, splats.factor, splats.opacity, splats.color[:, :0])
    with pytest.raises(ValueError, match=r"^splats.color: expected at least one channel"):
        render(bare, size, engine=engine)


PLAIN = scene("plain")[0]
FLAT = Gaussians3D.from_flat(PLAIN)
WRONG_TYPES = [
    (lambda: render(jax.tree.map(lambda leaf: leaf[None], PLAIN), (9, 9)), "vmap"),
    (lambda: Splats2D(PLAIN.mean, PLAIN.factor, PLAIN.opacity[:-1], PLAIN.color), "mean, factor, opacity, color"),
    (lambda: render(FLAT, (9, 9)), r"splats: expected Splats2D, got Gaussians3D.*project"),
    (lambda: render(PLAIN, (9, 9), options="fast"), "parentheses"),
    (lambda: render(PLAIN, (9, 9), options=RenderOptions.fast), "parentheses"),
    (lambda: project(PLAIN, Camera.front(0.5), (9, 9)), "gaussians: expected Gaussians3D"),
    (lambda: project(FLAT, None, (9, 9)), "camera: expected Camera"),
]


@pytest.mark.parametrize(("call", "message"), WRONG_TYPES)
def test_other_types_raise(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("channels", [pytest.param(1, marks=pytest.mark.slow), 3, 5])
def test_callback_with_copies_renders_the_same(channels, monkeypatch):
    """As where the default device is no CPU."""
    splats, size = scene("plain")
    color = jnp.asarray(np.random.default_rng(0).uniform(size=(len(splats.mean), channels)), jnp.float32)
    splats = dataclasses.replace(splats, color=color)
    draw = jax.value_and_grad(lambda own: jnp.sum(render(own, size, engine="cpu") ** 2))
    value, gradient = draw(splats)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *arrays, cpu, default: default(*arrays))
    jax.clear_caches()
    again, same = draw(splats)
    assert value == again
    jax.tree.map(np.testing.assert_array_equal, gradient, same)
    monkeypatch.undo()
    jax.clear_caches()
