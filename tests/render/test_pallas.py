"""The Pallas engine, interpreted on the CPU: against the judge, in rounds, in batches; and lowered for a GPU."""

import jax
import jax.numpy as jnp
import judge
import numpy as np
import pytest
from scenes import KINDS, draw, scene
from test_engines import BACKGROUND, OPTIONS, grads_and_picture, judged, weights_for

from foldgauss.render import RenderOptions, Splats2D, pallas, render, rounds, tiles

QUICK = [("plain", "sum", "sharp")]  # "over" is that of several rounds
CASES = [
    pytest.param(kind, *how, marks=[] if (kind, *how) in QUICK else [pytest.mark.slow])  # each compiles for seconds
    for how in (("over", "default"), ("over", "sharp"), ("sum", "default"), ("sum", "sharp"))
    for kind in KINDS
]


@pytest.mark.parametrize(("kind", "compositing", "options"), CASES)
def test_agrees_with_reference(kind, compositing, options):
    splats, size = scene(kind)
    judgement = judged(kind, compositing, options)
    leaves = splats, BACKGROUND, weights_for(size, judgement[0])
    grads, picture = grads_and_picture("pallas", size, compositing, OPTIONS[options], *leaves)
    judge.check(grads, picture, *judgement)


@pytest.mark.parametrize(
    ("num", "most"),
    [(0, 1), (1, 2**30), (10, 5), (100_000, 20), (4_000, 540_000), (1_000_000, 130_000), (3, 2**31 - 1)],
)
def test_running_sums_of_slots_saturate(num, most):
    counts = np.random.default_rng(0).integers(0, most, num, dtype=np.int32)
    expected = np.minimum(np.cumsum(counts, dtype=np.int64), tiles._SATURATED)
    found = np.asarray(tiles._running_sum(jnp.asarray(counts)))
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, expected)


def test_small_images_have_small_tiles():
    sides = [pallas.choose_tile_size(size) for size in ((1, 1), (320, 640), (512, 511), (512, 512), (640, 1280))]
    assert sides == [8, 8, 16, 16, 16]
    leaves = *jax.tree.leaves(scene("plain")[0]), BACKGROUND
    for given, side in ({}, 8), ({"tile_size": 32}, 32), ({"list_capacity": 40}, 8), ({"list_capacity": 39}, 16):
        assert pallas.choose_plan(leaves, (40, 60), "over", RenderOptions(**given)).tile == side


@pytest.mark.slow
@pytest.mark.parametrize("tile", [8, 16, 32])
def test_several_rounds_equal_one(tile):
    """What does not fit into the lists at once is drawn later; of many rounds not every start is kept."""
    splats, size = scene("plain")
    judgement = judged("plain", "over", "default")
    options = RenderOptions(list_capacity=-(-size[0] // tile) * -(-size[1] // tile), tile_size=tile)  # the least
    leaves = *jax.tree.leaves(splats), BACKGROUND
    plan = pallas.choose_plan(leaves, size, "over", options)
    assert tiles._count_slots(plan, *leaves[:3]) > rounds.STORED_ROUNDS * plan.capacity  # so many rounds and more
    grads, picture = grads_and_picture(
        "pallas", size, "over", options, splats, BACKGROUND, weights_for(size, judgement[0])
    )
    judge.check(grads, picture, *judgement)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pallas", "xla"])
def test_batches_of_scenes(engine):
    """Each with lists and rounds of its own, forward and backward."""
    splats, size = scene("plain")
    others = Splats2D(splats.mean[::-1] * 0.5, splats.factor * 2, splats.opacity, splats.color)
    options = RenderOptions(list_capacity=256) if engine == "xla" else RenderOptions()
    gradient = jax.jit(jax.grad(lambda s: jnp.sum(render(s, size, engine=engine, options=options) ** 2)))
    together = jax.vmap(gradient)(jax.tree.map(lambda *leaves: jnp.stack(leaves), splats, others))
    alone = jax.tree.map(lambda *leaves: np.stack(leaves), gradient(splats), gradient(others))
    for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5 * max(1, np.abs(other).max()))


@pytest.mark.parametrize("compositing", ["over", pytest.param("sum", marks=pytest.mark.slow)])
def test_it_lowers_for_a_gpu(compositing):
    """Forward and backward become programs of a GPU, whole batches too, with no call of the host in between."""
    splats, size = scene("plain")

    def loss(splats):
        return jnp.sum(render(splats, size, engine="pallas", compositing=compositing) ** 2)

    step = jax.jit(jax.value_and_grad(loss)).trace(splats).lower(lowering_platforms=("cuda",)).as_text()
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), splats)
    frames = jax.jit(jax.vmap(loss)).trace(batch).lower(lowering_platforms=("cuda",)).as_text()
    assert step.count("xla.gpu.triton") >= 2
    assert frames.count("xla.gpu.triton") == 1  # one launch for all frames
    assert "callback" not in step + frames


@pytest.mark.parametrize(
    ("options", "name"), [({"alpha_ceiling": 1.0}, "alpha_ceiling"), ({"tile_size": 12}, "tile_size")]
)
def test_unsupported_options_raise(options, name):
    splats, size = scene("one")
    with pytest.raises(ValueError, match=name):
        render(splats, size, engine="pallas", options=RenderOptions(**options))


@pytest.mark.parametrize("dtype", [np.float16, pytest.param(np.float64, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_dtypes(dtype):
    """Inside it is float32."""
    with jax.enable_x64(True):
        splats, size = scene("one", dtype=dtype)
        picture = render(splats, size, engine="pallas")
        assert picture.dtype == dtype
        wide = jax.tree.map(lambda leaf: leaf.astype(np.float64), splats)
        np.testing.assert_allclose(picture, draw(wide, size, engine="reference"), atol=2e-3)
