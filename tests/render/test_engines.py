"""Every engine against the judge, `reference`: pictures and all gradients."""

import subprocess
import sys
import textwrap
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import KINDS, scene

from foldgauss import _threads
from foldgauss.render import RenderOptions, Splats2D, cpu, render
from foldgauss.render.footprint import pixel_centres
from foldgauss.render.reference import splat_alpha

BACKGROUND = jnp.asarray([0.2, 0.4, 0.6])
OPTIONS = {"default": RenderOptions(), "sharp": RenderOptions(low_pass=0.01, transmittance_stop=0.0)}


def near_a_threshold(splats, size, options):
    """Pixels where some alpha is within 1e-4 of the cutoff: there float32 may fall on either side."""
    loose = RenderOptions(alpha_cutoff=1e-8, low_pass=options.low_pass)
    centres = pixel_centres(size, jnp.float32)
    if splats.opacity.size == 0:
        return np.zeros(size, bool)
    alphas = jax.lax.map(lambda splat: splat_alpha(splat, centres, loose), splats)
    edge = jnp.any(jnp.abs(alphas / options.alpha_cutoff - 1) < 1e-4, axis=0)
    light = jnp.cumprod(1 - jnp.where(alphas < options.alpha_cutoff, 0.0, jnp.minimum(alphas, 0.99)), axis=0)
    stop = jnp.any(jnp.abs(light - options.transmittance_stop) < 1e-3 * options.transmittance_stop, axis=0)
    return np.asarray(edge | stop)


def weights_for(size, avoid):
    """A random incoming gradient, zero on the pixels to avoid."""
    weights = np.random.default_rng(1).normal(size=(*size, 3)).astype(np.float32)
    return jnp.asarray(weights * ~avoid[..., None])


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("compositing", ["over", "sum"])
@pytest.mark.parametrize("kind", KINDS)
def test_cpu_agrees_with_reference(kind, compositing, options):
    splats, size = scene(kind)
    avoid = near_a_threshold(splats, size, options)
    assert avoid.mean() < 0.5 or avoid.size == 1
    kwargs = {"compositing": compositing, "options": options}

    weights = weights_for(size, avoid)

    def grads_and_picture(engine, splats, background, weights):
        def loss(splats, background):
            picture = render(splats, size, background=background, engine=engine, **kwargs)
            return jnp.sum(picture * weights), picture

        return jax.jit(jax.grad(loss, (0, 1), has_aux=True))(splats, background)

    grads, picture = grads_and_picture("cpu", splats, BACKGROUND, weights)
    with jax.enable_x64(True):  # the judge works in double precision on the same numbers
        wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), (splats, BACKGROUND, weights))
        true_grads, truth = grads_and_picture("reference", *wide)
    grads, picture, true_grads, truth = jax.tree.map(np.asarray, (grads, picture, true_grads, truth))
    scale = max(1.0, np.abs(truth).max())
    difference = np.abs(picture - truth)
    assert difference[~avoid].max(initial=0) <= 1e-5 * scale
    assert difference[avoid].max(initial=0) <= 2.5 * options.alpha_cutoff  # the stated band: a splat more or less
    names = ("mean", "factor", "opacity", "color", "background")
    for name, one, other in zip(names, jax.tree.leaves(grads), jax.tree.leaves(true_grads), strict=True):
        size_of = max(1.0, np.abs(other).max(initial=0))
        np.testing.assert_allclose(one / size_of, other / size_of, atol=2e-5, err_msg=name)


def test_cpu_in_chunks(monkeypatch):
    """Splats are shared out in chunks; a scene of several gives the same picture and gradients as one."""
    splats, size = scene("plain")
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(splats)] + [np.zeros(3, np.float32)]
    weights = np.random.default_rng(0).normal(size=(3, *size)).astype(np.float32)
    results = []
    for chunk in (cpu.CHUNK, 32):
        monkeypatch.setattr(cpu, "CHUNK", chunk)
        trace = cpu.forward(*leaves, size)
        results.append([trace.image, *cpu.backward(trace, weights)])
    for one, two in zip(*results, strict=True):
        np.testing.assert_array_equal(one, two)


def test_lists_are_cut_behind_the_last_light():
    splats, size = scene("curtain")
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(splats)] + [np.zeros(3, np.float32)]
    trace = cpu.forward(*leaves, size)
    assert sum(len(listed) for _, listed, _ in trace.lists) * cpu.PIXELS < trace.num_pairs / 2


def test_mutant_is_caught():
    """The comparison above has power: splats in the opposite order are another picture."""
    splats, size = scene("plain")
    backwards = jax.tree.map(lambda leaf: leaf[::-1], splats)
    difference = jnp.abs(render(splats, size) - render(backwards, size, engine="reference"))
    assert difference.max() > 1e-2


@pytest.mark.parametrize("leaf", ["mean", "factor", "opacity", "color"])
@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_reference_gradient_by_finite_differences(leaf, compositing):
    with jax.enable_x64(True):
        splats, size = scene("plain", dtype=np.float64)
        splats = jax.tree.map(lambda leaf: leaf[:12], splats)
        # No cutoff that a step could cross, no ceiling: the picture is smooth.
        options = RenderOptions(alpha_cutoff=1e-8, alpha_ceiling=1 - 1e-12, transmittance_stop=0.0)
        weights = jnp.asarray(np.random.default_rng(2).normal(size=(*size, 3)))

        @jax.jit
        def loss(splats):
            picture = render(splats, size, engine="reference", compositing=compositing, options=options)
            return jnp.sum(picture * weights)

        gradient = getattr(jax.grad(loss)(splats), leaf)
        direction = jnp.asarray(np.random.default_rng(3).normal(size=gradient.shape))

        def along(step):
            leaves = {name: getattr(splats, name) for name in ("mean", "factor", "opacity", "color")}
            leaves[leaf] = leaves[leaf] + step * direction
            return loss(Splats2D(**leaves))

        numeric = (along(1e-5) - along(-1e-5)) / 2e-5
        np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=1e-6)


def test_bits_do_not_depend_on_threads():
    splats, size = scene("plain")
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(splats)] + [np.zeros(3, np.float32)]
    weights = np.random.default_rng(0).normal(size=(3, *size)).astype(np.float32)
    results = []
    try:
        for count in (1, 2, 5):
            _threads.set_num_threads(count)
            trace = cpu.forward(*leaves, size)
            results.append([trace.image, *cpu.backward(trace, weights)])
    finally:
        _threads.set_num_threads(None)
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(one, two)


def test_several_python_threads_at_once():
    splats, size = scene("plain")
    truth = np.asarray(render(splats, size))
    pictures = {}

    def work(k):
        pictures[k] = np.asarray(render(splats, size))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(pictures) == 6
    assert all(np.array_equal(picture, truth) for picture in pictures.values())


def _run(script: str) -> str:
    """Run a script in a process of its own, with a time limit: a hang is a failure."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="core affinity is set through Linux")
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
    loss, count = _run(script).split()
    assert 0 < float(loss) < 1
    assert count == "4"


@pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="needs fork")
def test_kernels_work_after_fork():
    script = """
        import os, warnings
        warnings.simplefilter("ignore")  # JAX warns about fork; the kernels do not use it
        import numpy as np
        from foldgauss.render import cpu
        rng = np.random.default_rng(0)
        leaves = [rng.uniform(0, 64, (500, 2)), np.tile(3 * np.eye(2), (500, 1, 1)), np.full(500, 0.5),
                  rng.uniform(size=(500, 3)), np.zeros(3)]
        leaves = [leaf.astype(np.float32) for leaf in leaves]
        before = cpu.forward(*leaves, (64, 64)).image
        child = os.fork()
        if child == 0:
            os._exit(0 if np.array_equal(before, cpu.forward(*leaves, (64, 64)).image) else 3)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """
    assert _run(script).strip() == "0"


def test_jit_vmap_and_dtypes():
    splats, size = scene("plain")
    truth = render(splats, size)
    np.testing.assert_array_equal(jax.jit(lambda s: render(s, size))(splats), truth)
    moved = jnp.stack([splats.mean, splats.mean + 3])
    stack = jax.vmap(lambda mean: render(Splats2D(mean, splats.factor, splats.opacity, splats.color), size))(moved)
    np.testing.assert_array_equal(stack[0], truth)
    assert jnp.abs(stack[1] - truth).max() > 1e-2
    with jax.enable_x64(True):
        doubled = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), splats)
        assert render(doubled, size).dtype == jnp.float64
        np.testing.assert_allclose(render(doubled, size), truth, atol=1e-6)


def test_nothing_breaks_on_degenerate_splats():
    """Non-finite or singular splats are not drawn; the others are."""
    splats, size = scene("plain")
    bad = jnp.asarray([jnp.nan, jnp.inf, 0.0, 1e30])
    mean = splats.mean.at[:2, 0].set(bad[:2]).at[2].set(1e30)
    factor = splats.factor.at[3].set(0.0).at[4].set(jnp.nan).at[5].set(1e25)
    picture = render(Splats2D(mean, factor, splats.opacity, splats.color), size, options=RenderOptions(low_pass=0.0))
    assert bool(jnp.all(jnp.isfinite(picture)))
    assert float(picture.max()) > 0.1


@pytest.mark.parametrize("scale", [0.0, 1e-38, 1e-20, 3e-7, 1e-5, 1e5, 2.7e6, 1e15, 1e25, np.inf, np.nan])
@pytest.mark.parametrize("other", [1.0, None])
def test_gradients_of_extreme_splats_are_finite(scale, other):
    """On a pixel's centre, where a thin splat's alpha does not vanish; with no low pass to save it."""
    factor = jnp.diag(jnp.asarray([scale, scale if other is None else other]))[None]
    splats = Splats2D(jnp.asarray([[8.5, 8.5]]), factor, jnp.asarray([0.5]), jnp.ones((1, 3)))
    options = RenderOptions(low_pass=0.0)
    grads = jax.grad(lambda s: jnp.sum(render(s, (17, 17), options=options) ** 2))(splats)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(grads))
    if 1e-5 <= scale <= 1e8:
        assert float(render(splats, (17, 17), options=options)[8, 8, 0]) == pytest.approx(0.5, abs=1e-4)


def test_more_channels_take_the_reference():
    splats, size = scene("plain")
    two = Splats2D(splats.mean, splats.factor, splats.opacity, splats.color[:, :2])
    np.testing.assert_allclose(render(two, size), render(splats, size)[..., :2], atol=1e-5)


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
        ({"engine": "cpu", "options": RenderOptions(alpha_ceiling=0.9999)}, "alpha_ceiling"),
    ],
)
def test_bad_arguments(changes, message):
    splats, size = scene("plain")
    with pytest.raises(ValueError, match=message):
        render(splats, **({"size": size} | changes))


def test_two_channels_refused_by_cpu():
    splats, size = scene("plain")
    two = Splats2D(splats.mean, splats.factor, splats.opacity, splats.color[:, :2])
    with pytest.raises(ValueError, match="3 channels"):
        render(two, size, engine="cpu")


@pytest.mark.parametrize("field", ["alpha_cutoff", "alpha_ceiling", "low_pass", "transmittance_stop"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), "much", float("inf")])
def test_bad_options(field, value):
    with pytest.raises(ValueError, match=field):
        RenderOptions(**{field: value})


def test_a_batch_is_refused_with_a_cure():
    splats, size = scene("plain")
    with pytest.raises(ValueError, match="vmap"):
        render(jax.tree.map(lambda leaf: leaf[None], splats), size)


def test_bad_shapes():
    splats, _ = scene("plain")
    with pytest.raises(ValueError, match="mean, factor, opacity, color"):
        Splats2D(splats.mean, splats.factor, splats.opacity[:-1], splats.color)
