"""Triangles: there and back, the faces of eq:traingle_face, and the faces that are none."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import from_scale_angle

from foldgauss.render import Splats2D
from foldgauss.render.camera import Gaussians3D
from foldgauss.render.triangle import Triangles

#: As compiled programs: of separate operations each would be compiled for each shape. Most Gaussians are 200.
triangles_of, gaussians_of = jax.jit(Triangles.from_gaussians), jax.jit(Triangles.to_gaussians)
from_flat, from_vertices = jax.jit(Gaussians3D.from_flat), jax.jit(Triangles.from_vertices)


def there_and_back(gaussians):
    """Not compiled as one, so that values are checked."""
    return Triangles.from_gaussians(gaussians).to_gaussians()


def rest(num=200):
    return jnp.asarray(np.full(num, 0.5, np.float32)), jnp.asarray(np.full((num, 3), 0.25, np.float32))


def parameters(num=200, *, seed=0, longest=0.1, ratio=1.0):
    """mean, scale, angle as MiraGe has them; either axis may be the longer."""
    rng = np.random.default_rng(seed)
    scale = longest * np.exp(rng.uniform(np.log(0.3), 0, (num, 2)))
    scale[np.arange(num), rng.integers(0, 2, num)] *= ratio
    leaves = rng.uniform(-0.5, 0.5, (num, 2)), scale, rng.uniform(0, 2 * np.pi, num)
    return tuple(jnp.asarray(leaf, jnp.float32) for leaf in leaves)


def covariance(factor):
    factor = np.asarray(factor, np.float64)
    return factor @ np.swapaxes(factor, -1, -2)


def assert_same_covariance(one, other, rtol=1e-6):
    one, other = covariance(one), covariance(other)
    np.testing.assert_array_less(np.abs(one - other).max((-1, -2)), rtol * np.abs(other).max((-1, -2)))


def test_vertices_are_the_paper_s():
    """v1 = m + s1 r1, v2 = m + s2 r2, in this order even where s1 < s2 (eq:traingle_face)."""
    mean, scale, angle = parameters()
    triangles = triangles_of(from_scale_angle(mean, scale, angle, *rest()))
    mean, scale, angle = map(np.asarray, (mean, scale, angle))
    assert (scale[:, 0] < scale[:, 1]).any()
    cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros(200)
    m = np.stack([mean[:, 0], mean[:, 1], zero], -1)
    first, second = np.stack([cos, sin, zero], -1) * scale[:, :1], np.stack([-sin, cos, zero], -1) * scale[:, 1:]
    np.testing.assert_allclose(triangles.vertices, np.stack([m, m + first, m + second], 1), atol=2e-7)


@pytest.mark.parametrize("ratio", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("longest", [1e-6, 0.1, 1e6])
def test_round_trip_from_scales(ratio, longest):
    gaussians = from_scale_angle(*parameters(longest=longest, ratio=ratio), *rest())
    back = there_and_back(gaussians)
    assert_same_covariance(back.factor, gaussians.factor)
    for name in ("mean", "opacity", "color"):
        np.testing.assert_array_equal(getattr(back, name), getattr(gaussians, name))
    widths = [np.linalg.svd(np.asarray(g.factor, np.float64), compute_uv=False)[:, :2] for g in (gaussians, back)]
    np.testing.assert_allclose(*widths, rtol=1e-6)


@pytest.mark.parametrize("kind", ["lower", "upper", "full", "round"])
@pytest.mark.parametrize("ratio", [1.0, 1e-2, 1e-4])
def test_round_trip_from_any_factor(kind, ratio):
    """Factors whose columns are no axes: Cholesky's, their mirror, and any other square root."""
    _, scale, angle = parameters(ratio=ratio)
    cos, sin = np.cos(angle, dtype=np.float64), np.sin(angle, dtype=np.float64)
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    axes = turn * np.asarray(scale, np.float64)[:, None, :]
    factor = {
        "lower": np.linalg.cholesky(axes @ np.swapaxes(axes, 1, 2)),
        "upper": np.linalg.cholesky(axes @ np.swapaxes(axes, 1, 2))[..., ::-1],
        "full": axes @ turn[::-1],
        "round": turn * np.asarray(scale)[:, :1, None],
    }[kind]
    splats = Splats2D(parameters()[0], jnp.asarray(factor, jnp.float32), *rest())
    gaussians = from_flat(splats)
    back = there_and_back(gaussians)
    assert_same_covariance(back.factor, gaussians.factor)
    determinants = [np.linalg.det(np.asarray(g.factor, np.float64)[:, :2, :2]) for g in (gaussians, back)]
    np.testing.assert_allclose(*np.abs(determinants), rtol=3e-6, atol=1e-7 * 0.01 if kind == "full" else 0)


def test_round_trip_anywhere_in_space():
    """Turned out of the plane and moved: still R S, still exact."""
    gaussians = from_scale_angle(*parameters(ratio=1e-3), *rest())
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], jnp.float32)
    factor = jnp.asarray(np.asarray(turn) @ np.asarray(gaussians.factor))
    moved = Gaussians3D(gaussians.mean + 3.0, factor, gaussians.opacity, gaussians.color)
    back = there_and_back(moved)
    assert_same_covariance(back.factor, moved.factor)
    third = np.abs(np.asarray(back.factor)[:, :, 2] @ np.asarray(turn)[:, 2]) / 1e-7
    np.testing.assert_allclose(third, 1, rtol=1e-4)


def test_triangle_round_trip():
    """A face with a right angle is the same face; any other becomes the right-angled one of its Gaussian."""
    rng = np.random.default_rng(1)
    vertices = rng.normal(size=(200, 3, 3)).astype(np.float32)
    triangles = from_vertices(jnp.asarray(vertices), *rest())
    np.testing.assert_allclose(triangles.vertices, vertices, atol=1e-6)
    right = triangles_of(gaussians_of(triangles))
    again = triangles_of(gaussians_of(right))
    np.testing.assert_allclose(again.edges, right.edges, atol=1e-5)
    first, edges = (np.asarray(one.edges) for one in (triangles, right))
    np.testing.assert_allclose(edges[:, 0], first[:, 0], atol=1e-5)
    np.testing.assert_allclose(np.sum(edges[:, 0] * edges[:, 1], -1), 0, atol=1e-5)
    # Same first edge, same height over it: the same plane area.
    areas = [np.linalg.norm(np.cross(own[:, 0], own[:, 1]), axis=-1) for own in (first, edges)]
    np.testing.assert_allclose(*areas, rtol=1e-4)


def test_reconstruction_is_gram_schmidt():
    """eq:gaussrecons1, eq:gaussrecons2 as printed, with e3 for the plane's normal."""
    rng = np.random.default_rng(2)
    plane = np.concatenate([rng.normal(size=(200, 3, 2)), np.zeros((200, 3, 1))], -1)
    triangles = from_vertices(jnp.asarray(plane, jnp.float32), *rest())
    for vertices, factor in zip(plane, np.asarray(gaussians_of(triangles, thickness=0.5).factor), strict=True):
        m, v1, v2 = vertices
        s1 = np.linalg.norm(v1 - m)
        r1, e3 = (v1 - m) / s1, np.asarray([0, 0, 1])
        r2 = (v2 - m) - ((v2 - m) @ r1) * r1 - ((v2 - m) @ e3) * e3
        r2 /= np.linalg.norm(r2)
        truth = np.stack([s1 * r1, ((v2 - m) @ r2) * r2, 0.5 * e3], -1)
        np.testing.assert_allclose(factor[:, :2], truth[:, :2], atol=1e-5)
        np.testing.assert_allclose(np.abs(factor[:, 2]), truth[:, 2], atol=1e-5)


def test_mirrored_faces_are_the_same_gaussian():
    """A triangle determines the covariance, not the angle."""
    triangles = triangles_of(from_scale_angle(*parameters(), *rest()))
    mirrored = dataclasses.replace(triangles, edges=jnp.asarray(np.asarray(triangles.edges)[:, ::-1]))
    assert_same_covariance(gaussians_of(mirrored).factor, gaussians_of(triangles).factor)


def test_accurate_far_from_the_origin():
    """Edges are kept: a splat of 1e-5 at a distance of 1000 comes back to 1e-6; through vertices it could not."""
    gaussians = from_scale_angle(*parameters(longest=1e-5), *rest())
    far = Gaussians3D(gaussians.mean + 1e3, gaussians.factor, gaussians.opacity, gaussians.color)
    triangles = triangles_of(far)
    assert_same_covariance(gaussians_of(triangles).factor, far.factor)
    vertices = np.asarray(triangles.vertices)
    np.testing.assert_array_equal(vertices[:, 0], vertices[:, 1])


def test_moving_a_vertex_moves_the_gaussian():
    triangles = triangles_of(from_scale_angle(*parameters(), *rest()))
    vertices, edges = np.array(triangles.vertices), np.asarray(triangles.edges)
    vertices[:, 1] += edges[:, 0]
    moved = gaussians_of(from_vertices(jnp.asarray(vertices), triangles.opacity, triangles.color))
    np.testing.assert_allclose(np.asarray(moved.factor)[:, :, 0], 2 * edges[:, 0], rtol=1e-4, atol=1e-7)


GOOD = [[1.0, 0.0, 0.0], [0.0, 1e-4, 0.0]]
BAD_FACES = {
    "collinear": [[1.0, 2.0, 0.0], [2.0, 4.0, 0.0]],
    "collinear up to rounding": [[0.1, 0.7, 0.3], [0.3, 2.1, 0.9]],
    "two vertices in one place": [[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]],
    "a point": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
}


TRIL = np.array([[[1.0, 0, 0], [0.5, 1, 0], [0.3, 0.2, 0.1]]])
WRONG = [
    *(
        (
            lambda face=face: Triangles(jnp.zeros((2, 3)), jnp.asarray([GOOD, face]), *rest(2)).to_gaussians(),
            r"edges: .*1 without area, the first at index 1\..*Move a vertex",
        )
        for face in BAD_FACES.values()
    ),
    (
        lambda: Triangles.from_gaussians(Gaussians3D(jnp.zeros((1, 3)), jnp.asarray(TRIL, jnp.float32), *rest(1))),
        r"gaussians\.factor.*from_flat",
    ),
    (lambda: Triangles(jnp.zeros((2, 3)), jnp.zeros((2, 3, 3)), *rest(2)), "origin, edges, opacity, color"),
]


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_what_is_no_triangle_raises(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("kind", BAD_FACES)
def test_faces_without_area_are_nan_under_jit(kind):
    triangles = Triangles(jnp.zeros((2, 3)), jnp.asarray([GOOD, BAD_FACES[kind]]), *rest(2))
    factor = np.asarray(gaussians_of(triangles).factor)
    assert np.isfinite(factor[0]).all()
    assert np.isnan(factor[1]).all()


def test_nan_in_nan_out():
    """Without an error: it is no face without area."""
    triangles = Triangles(jnp.zeros((2, 3)), jnp.full((2, 2, 3), jnp.nan), *rest(2))
    assert np.isnan(triangles.to_gaussians().factor).all()


def test_thin_slanted_faces_are_valid():
    edges = jnp.asarray([[[1.0, 0.0, 0.0], [1e4, 1.0, 0.0]]] * 2)
    factor = np.asarray(Triangles(jnp.zeros((2, 3)), edges, *rest(2)).to_gaussians().factor)
    np.testing.assert_allclose(factor[0, :, :2], [[1, 0], [0, 1], [0, 0]], atol=1e-6)


def test_gradients_by_finite_differences():
    weights = np.random.default_rng(0).normal(size=(10, 3, 3))

    @functools.partial(jax.jit, static_argnames="through")
    @jax.value_and_grad
    def slope(factor, mean, through=True):
        gaussians = Gaussians3D.from_flat(Splats2D(mean, factor, *rest(10)))
        if through:
            gaussians = Triangles.from_gaussians(gaussians).to_gaussians()
        return jnp.sum(gaussians.factor @ gaussians.factor.mT * (weights + weights.mT))

    for ratio in (1.0, 1e-3):
        with jax.enable_x64(True):
            mean, *leaves = (jnp.asarray(leaf, jnp.float64) for leaf in parameters(10, ratio=ratio))
            factor = np.asarray(from_scale_angle(mean, *leaves, *rest(10)).factor)[:, :2, :2]
            factor = factor @ np.asarray([[1.0, 0.0], [0.4, 1.0]])
            direction = np.random.default_rng(1).normal(size=factor.shape) * 1e-2
            gradient = np.asarray(slope(factor, mean)[1])
            above, below = (slope(factor + step * direction, mean)[0] for step in (1e-5, -1e-5))
            np.testing.assert_allclose(np.sum(gradient * direction), (above - below) / 2e-5, rtol=1e-6)
            # There and back is the identity of the covariance, so its gradient is too.
            np.testing.assert_allclose(gradient, slope(factor, mean, through=False)[1], rtol=1e-6, atol=1e-9)


def test_gradients_of_round_gaussians_are_those_of_a_fixed_angle():
    factor = 0.1 * jnp.eye(2)

    def edges(factor):
        splats = Splats2D(jnp.zeros((1, 2)), factor[None], *rest(1))
        return Triangles.from_gaussians(Gaussians3D.from_flat(splats)).edges[0]

    first, second = np.asarray(jax.jit(jax.jacrev(edges))(factor))[:, :2]
    truth = np.zeros((2, 2, 2))
    truth[0, 0, 0] = truth[1, 1, 0] = 1
    np.testing.assert_allclose(first, truth, atol=1e-6)  # its own column, whatever the other does
    np.testing.assert_allclose(second[1, 1, 1], 1, atol=1e-6)
    assert np.isfinite(second).all()


def test_none():
    none = from_scale_angle(*(jnp.asarray(np.asarray(leaf)[:0]) for leaf in parameters(3)), *rest(0))
    assert there_and_back(none).factor.shape == (0, 3, 3)


@pytest.mark.slow
@pytest.mark.usefixtures("optimized")
def test_many_and_compiled_once():
    gaussians = from_scale_angle(*parameters(), *rest())
    traces = []

    @jax.jit
    def traced(gaussians):
        traces.append(1)
        return there_and_back(gaussians)

    back = traced(traced(gaussians))
    assert len(traces) == 1
    pairs = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf).reshape(2, 100, *leaf.shape[1:])), gaussians)
    many = jax.jit(jax.vmap(traced))(pairs)
    np.testing.assert_allclose(np.asarray(many.factor).reshape(200, 3, 3), back.factor, atol=1e-7)
