"""Colors by least squares: against the dense solution, and against descended colors on a real frame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import draw, scene

from foldgauss.render import Splats2D, render, solve_colors

BACKGROUND = jnp.asarray([0.2, 0.4, 0.6])


def recolored(splats, colors):
    return Splats2D(splats.mean, splats.factor, splats.opacity, colors)


PLAIN, PLAIN_SIZE = scene("plain")


def weights(splats, size, **how):
    """The map from one channel of the colors to the pixels, as a matrix (pixels, num)."""
    one_hot = recolored(splats, jnp.eye(len(splats.mean), dtype=splats.mean.dtype))
    return np.asarray(draw(one_hot, size, engine="reference", **how), np.float64).reshape(-1, len(splats.mean))


@pytest.mark.parametrize(
    ("compositing", "engine"),
    [
        ("over", "cpu"),
        *(pytest.param(*how, marks=pytest.mark.slow) for how in (("sum", "cpu"), ("over", "xla"), ("sum", "xla"))),
    ],
)
def test_equals_the_dense_solution(compositing, engine):
    """Two frames, of two sizes, that share their colors; the matrix is made from pictures of single splats."""
    splats, size = scene("plain")
    splats = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[:40]), splats)
    frames = [splats, Splats2D(splats.mean[::-1] + 2, splats.factor, splats.opacity, splats.color)]
    sizes = [size, (33, 40)]
    rng = np.random.default_rng(0)
    images = [rng.uniform(0, 1, (*size, 3)).astype(np.float32) for size in sizes]
    matrices = [weights(one, size, compositing=compositing) for one, size in zip(frames, sizes, strict=True)]
    blank = jnp.zeros_like(splats.color)
    rest = [
        image - np.asarray(render(recolored(one, blank), size, background=BACKGROUND, compositing=compositing))
        for one, size, image in zip(frames, sizes, images, strict=True)
    ]
    matrix, right = np.concatenate(matrices), np.concatenate([one.reshape(-1, 3) for one in rest])
    start, ridge = np.asarray(splats.color, np.float64), 1e-3
    damping = ridge * (matrix.T @ matrix.sum(1)).max()
    normal = matrix.T @ matrix + damping * np.eye(len(start))
    dense = np.linalg.solve(normal, matrix.T @ right + damping * start)
    colors = solve_colors(
        frames, images, background=BACKGROUND, compositing=compositing, engine=engine, ridge=ridge, tolerance=1e-6
    )
    np.testing.assert_allclose(colors, dense, atol=2e-4)


def test_recovers_the_colors_of_an_image():
    splats, size = scene("plain")
    splats = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[:40]), splats)
    image = render(splats, size, background=BACKGROUND)
    blank = recolored(splats, jnp.zeros_like(splats.color))
    solved = solve_colors(blank, image, background=BACKGROUND, ridge=0.0, tolerance=1e-7)
    np.testing.assert_allclose(render(recolored(splats, solved), size, background=BACKGROUND), image, atol=1e-4)


def test_invisible_splats_keep_their_colors():
    splats, size = scene("plain")
    away = Splats2D(splats.mean + 1e4, splats.factor, splats.opacity, splats.color)
    np.testing.assert_array_equal(solve_colors(away, jnp.ones((*size, 3)), ridge=0.0), splats.color)
    none, size = scene("none")
    assert solve_colors(none, jnp.ones((*size, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": []}, "images: expected one for each"),
        ({"images": [np.zeros((5, 5))]}, "shape"),
        ({"images": [np.full((50, 70, 3), np.inf, np.float32)]}, "images: expected finite numbers, got 10500 that"),
        ({"images": [np.where(np.arange(3 * 50 * 70).reshape(50, 70, 3) == 9, np.nan, 0)]}, "^images: .*got 1 that"),
        (
            {"splats": [recolored(PLAIN, PLAIN.color.at[2, 1].set(jnp.nan))]},
            r"^splats.color: expected finite numbers, got 1 ",
        ),
        ({"ridge": -1.0}, "ridge"),
    ],
)
def test_invalid_arguments_raise(change, message):
    """Values that are not finite would stop the solve of every channel, in silence."""
    arguments = {"splats": [PLAIN], "images": [np.zeros((*PLAIN_SIZE, 3), np.float32)]} | change
    with pytest.raises(ValueError, match=message):
        solve_colors(**arguments)


@pytest.mark.parametrize("dtype", [jnp.float16, pytest.param(jnp.bfloat16, marks=pytest.mark.slow)])
def test_half_precision_is_solved_in_single(dtype):
    splats, size = scene("plain")
    image = render(splats, size).astype(dtype)
    half = jax.tree.map(lambda leaf: leaf.astype(dtype), splats)
    start = Splats2D(half.mean, half.factor, half.opacity, jnp.zeros_like(half.color))
    found = solve_colors(start, image)
    assert found.dtype == dtype
    drawn = render(Splats2D(half.mean, half.factor, half.opacity, found), size)
    assert jnp.mean(jnp.square(drawn - image).astype(jnp.float32)) < 0.02 * jnp.mean(
        jnp.square(image).astype(jnp.float32)
    )
