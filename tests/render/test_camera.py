"""Cameras: where points and shapes land, which covers which, the mirror image, and gradients."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import draw, from_scale_angle

from foldgauss.render import RenderOptions, Splats2D, render
from foldgauss.render.camera import TANGENT_LIMIT, Camera, Gaussians3D, project, square_factor

SIZE = (48, 96)
#: No cutoff that rounding could cross: a splat more or less is 1/255, whatever the camera.
SMOOTH = RenderOptions(alpha_cutoff=1e-8, transmittance_stop=0.0)


#: As compiled programs: of separate operations each would be compiled for each shape. All flat scenes are of one size.
view = jax.jit(project, static_argnames=("size", "order", "near"))
#: The orthogonal projection on the plane z = 0.
flatten = jax.jit(lambda of: Splats2D(of.mean[:, :2], square_factor(of.factor[:, :2]), of.opacity, of.color))
flat_factor = jax.jit(square_factor)
orbit, look_at = jax.jit(Camera.orbit), jax.jit(Camera.look_at, static_argnames="aspect")


def flat_scene(num=120, *, seed=0, aspect=0.5, dtype=np.float32, thickness=1e-7, thinnest=0.01):
    """Overlapping flat Gaussians that fill the frame and stick out of it."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-0.55, 0.55, (num, 2)) * [min(1, 1 / aspect), min(1, aspect)]
    scale = np.exp(rng.uniform(np.log(thinnest), np.log(0.08), (num, 2)))
    leaves = mean, scale, rng.uniform(0, 2 * np.pi, num), rng.uniform(0.2, 1, num), rng.uniform(0, 1, (num, 3))
    return from_scale_angle(*(jnp.asarray(leaf, dtype) for leaf in leaves), thickness=thickness)


def deep_scene(num=40, *, seed=0, dtype=np.float64):
    """Gaussians of any shape about the origin."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(num, 3, 3)))[0]
    factor = turn * np.exp(rng.uniform(np.log(0.005), np.log(0.2), (num, 1, 3)))
    leaves = rng.uniform(-0.4, 0.4, (num, 3)), factor, rng.uniform(0.1, 0.9, num), rng.uniform(0, 1, (num, 3))
    return Gaussians3D(*(jnp.asarray(leaf, dtype) for leaf in leaves))


def cast(tree, dtype):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, dtype)), tree)


def covariance(splats):
    factor = np.asarray(splats.factor)
    return factor @ factor.mT


# --- the front camera is the picture ---------------------------------------------------------------------------


@pytest.mark.parametrize(("aspect", "size"), [(0.5, (160, 320)), (0.5, (200, 100)), (2.0, (100, 300))])
def test_front_camera_is_to_pixels(aspect, size):
    """Means exactly; covariances up to thickness^2 (f/d)^2 u u^T, with u the tangent of the ray."""
    with jax.enable_x64(True):
        gaussians = flat_scene(aspect=aspect, dtype=np.float64, thickness=1e-3)
        flat, camera = flatten(gaussians).to_pixels(size, aspect=aspect), Camera.front(aspect)
        seen = view(gaussians, camera, size)
        np.testing.assert_allclose(seen.mean, flat.mean, atol=1e-10)
        focal = float(camera.intrinsics(size)[0, 0])
        limit = TANGENT_LIMIT * np.asarray([size[1], size[0]]) / 2 / focal
        tangent = np.clip((np.asarray(flat.mean) - [size[1] / 2, size[0] / 2]) / focal, -limit, limit)
        across = 1e-3 * focal / -float(camera.position[2]) * tangent
        truth = covariance(flat) + across[:, :, None] * across[:, None, :]
        np.testing.assert_allclose(covariance(seen), truth, rtol=1e-9, atol=1e-9)
        for name in ("opacity", "color"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(gaussians, name))


def test_published_geometry():
    """Camera at distance 1, half-width 0.36, in the published unit; ours is the frame's width."""
    camera = Camera.front(0.5)
    np.testing.assert_allclose(camera.position, [0, 0, -0.5 / math.tan(0.6911112 / 2)], rtol=1e-6)
    np.testing.assert_allclose(camera.intrinsics((640, 1280))[0, 0], 1280 / (2 * math.tan(0.6911112 / 2)), rtol=1e-6)
    assert float(-0.5 / camera.position[2]) == pytest.approx(0.36, abs=1e-6)


@pytest.mark.parametrize("thickness", [0.0, 1e-7, 1e-3])
def test_to_flat_inverts_from_flat(thickness):
    rng = np.random.default_rng(0)
    leaves = rng.normal(size=(120, 2)), rng.normal(size=(120, 2, 2)), rng.uniform(size=120), rng.uniform(size=(120, 3))
    splats = Splats2D(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))
    gaussians = Gaussians3D.from_flat(splats, thickness=thickness)
    np.testing.assert_array_equal(np.asarray(gaussians.mean)[:, 2], 0)
    np.testing.assert_allclose(np.linalg.norm(np.asarray(gaussians.factor)[:, 2], axis=-1), thickness, rtol=1e-6)
    back = flatten(gaussians)
    np.testing.assert_allclose(covariance(back), covariance(splats), rtol=2e-6, atol=2e-6)
    for name in ("mean", "opacity", "color"):
        np.testing.assert_array_equal(getattr(back, name), getattr(splats, name))


# --- the mirror ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("aspect", "size"), [(2.0, (96, 48)), pytest.param(0.6, (50, 50), marks=pytest.mark.slow)])
def test_mirror_in_double_precision(aspect, size):
    with jax.enable_x64(True):
        gaussians = flat_scene(aspect=aspect, dtype=np.float64)
        splats = [view(gaussians, camera(aspect), size) for camera in (Camera.front, Camera.opposing)]
        front, mirror = (np.asarray(draw(one, size, engine="reference")) for one in splats)
        np.testing.assert_allclose(front, mirror[:, ::-1], atol=1e-12)
        np.testing.assert_array_equal(splats[0].color, splats[1].color)  # ties: array order in both


# --- where cameras stand ---------------------------------------------------------------------------------------


def seen_at(point, camera):
    one = Gaussians3D(jnp.asarray([point]), jnp.eye(3)[None] * 0.01, jnp.ones(1), jnp.ones((1, 3)))
    return np.asarray(view(one, camera, SIZE).mean)[0] - [SIZE[1] / 2, SIZE[0] / 2]


def test_right_and_down():
    front, behind = Camera.front(0.5), Camera.opposing(0.5)
    x, y = seen_at((0.1, 0.05, 0.0), front)
    assert (x, y) == pytest.approx((9.6, 4.8), abs=1e-4)
    assert seen_at((0.1, 0.05, 0.0), behind) == pytest.approx((-9.6, 4.8), abs=1e-4)
    assert abs(seen_at((0.1, 0.0, 0.3), front)[0]) < 9.6 < abs(seen_at((0.1, 0.0, 0.3), behind)[0])  # z goes away


@pytest.mark.parametrize(
    ("angles", "position"), [((0.3, 0.0), (1, 0, 0)), ((0.0, 0.3), (0, -1, 0)), ((-0.3, -0.2), (-1, 1, 0))]
)
def test_orbit_goes_right_and_up(angles, position):
    camera, front = Camera.front(0.5).orbit(*angles), Camera.front(0.5)
    moved = np.asarray(camera.position)
    np.testing.assert_array_equal(np.sign(np.round(moved[:2], 6)), position[:2])
    assert np.linalg.norm(moved) == pytest.approx(float(-front.position[2]), rel=1e-6)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)
    assert seen_at((0.0, 0.0, 0.0), camera) == pytest.approx((0, 0), abs=1e-4)
    looking = Camera.look_at(camera.position, aspect=0.5)
    np.testing.assert_allclose(looking.rotation, camera.rotation, atol=1e-6)


@pytest.mark.parametrize("turned", [Camera.orbit, orbit])
def test_quarter_turns_are_exact(turned):
    for quarters in range(-6, 7):
        camera = turned(Camera.front(0.5), quarters * math.pi / 2)
        cos, sin = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarters % 4]
        np.testing.assert_array_equal(camera.rotation, [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], str(quarters))
        np.testing.assert_array_equal(np.asarray(camera.position) == 0, [sin == 0, True, cos == 0], str(quarters))


def test_orbit_gradient_at_a_quarter_turn():
    gradient = jax.jit(jax.jacfwd(lambda angle: Camera.front(0.5).orbit(angle).position))(jnp.asarray(math.pi))
    distance = float(-Camera.front(0.5).position[2])
    np.testing.assert_allclose(gradient, [-distance, 0, 0], atol=1e-6)


def test_orbit_about_a_target():
    target = jnp.asarray([0.2, -0.1, 0.3])
    camera = Camera.look_at((0.2, -0.1, -1.0), target).orbit(0.8, 0.3, target=target)
    assert float(jnp.linalg.norm(camera.position - target)) == pytest.approx(1.3, rel=1e-6)
    assert seen_at(target, camera) == pytest.approx((0, 0), abs=1e-4)


def test_look_at_front_and_behind():
    for camera in (Camera.front(0.5), Camera.opposing(0.5)):
        np.testing.assert_array_equal(Camera.look_at(camera.position).rotation, camera.rotation)


# --- the projection --------------------------------------------------------------------------------------------


def random_cameras(count, seed=3):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        eye = rng.normal(size=3)
        eye *= rng.uniform(1.5, 3) / np.linalg.norm(eye)
        yield look_at(eye, rng.uniform(-0.2, 0.2, 3), up=rng.normal(size=3), fov=rng.uniform(0.3, 1.2))


@pytest.mark.parametrize("ratio", [1.0, 1e-4, 1e-7, 0.0])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_square_factor(ratio, size):
    """Against the double-precision covariance, its determinant too: a needle keeps its width."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    columns = np.asarray(turn[:, :2] * (size * np.asarray([1, ratio, ratio**2])), np.float32)
    wide = columns.astype(np.float64)
    truth = wide @ np.swapaxes(wide, 1, 2)
    factor = np.asarray(flat_factor(jnp.asarray(columns)), np.float64)
    np.testing.assert_allclose(factor @ np.swapaxes(factor, 1, 2) / size**2, truth / size**2, atol=5e-7)
    area = np.linalg.norm(np.cross(wide[:, 0], wide[:, 1]), axis=-1) / size**2
    most = (np.linalg.norm(wide[:, :, 0], axis=1) * np.linalg.norm(wide[:, :, 1], axis=1)).max() / size**2
    np.testing.assert_allclose(np.abs(np.linalg.det(factor)) / size**2, area, atol=1e-6 * most)


@pytest.mark.parametrize("world", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("thickness", [0.0, 1e-7, 1e-2])
def test_single_precision_at_any_size(world, thickness):
    """A whole scene scaled, needles of 1e4:1 in it, from a slant: float32 against float64, width and length."""
    rng = np.random.default_rng(1)
    scale = np.exp(rng.uniform(np.log(0.02), np.log(0.1), (120, 2))) * [1, 1e-4]
    leaves = rng.uniform(-0.4, 0.4, (120, 2)), scale, rng.uniform(0, 6.28, 120), np.ones(120), np.ones((120, 3))
    gaussians = from_scale_angle(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves), thickness=thickness * 0.01)
    gaussians = dataclasses.replace(gaussians, mean=world * gaussians.mean, factor=world * gaussians.factor)
    camera = orbit(Camera.front(0.5), 0.9, 0.4)
    camera = dataclasses.replace(camera, position=world * camera.position)
    seen = view(gaussians, camera, SIZE, near=0.0, order="array")
    with jax.enable_x64(True):
        truth = view(cast(gaussians, np.float64), cast(camera, np.float64), SIZE, near=0.0, order="array")
    np.testing.assert_allclose(seen.mean, truth.mean, atol=1e-4)
    one, other = (np.linalg.svd(np.asarray(s.factor, np.float64), compute_uv=False) for s in (seen, truth))
    np.testing.assert_allclose(one, other, rtol=2e-5)


# --- order -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seen_from", [pytest.param(project, marks=pytest.mark.slow), view])
def test_equal_depths_keep_array_order(seen_from):
    """1003 Gaussians in one place, from a slant: an odd number, so that the vectorised loop has a remainder."""
    num = 1003
    leaves = np.tile([0.13, 0.27, 0.31], (num, 1)), np.tile(0.01 * np.eye(3), (num, 1, 1)), np.linspace(0, 1, num)
    same = Gaussians3D(*(jnp.asarray(leaf, jnp.float32) for leaf in (*leaves, np.ones((num, 3)))))
    seen = seen_from(same, orbit(Camera.front(0.5), 0.7, 0.3), SIZE)
    np.testing.assert_array_equal(seen.opacity, same.opacity)


def test_depth_order_and_array_order():
    with jax.enable_x64(True):
        scene = deep_scene()
        camera = next(random_cameras(1))
        depth = (np.asarray(scene.mean) - np.asarray(camera.position)) @ np.asarray(camera.rotation)[2]
        nearest_first = np.argsort(depth)
        assert (nearest_first != np.arange(depth.size)).any()
        by_depth, as_they_come = (view(scene, camera, SIZE, order=order) for order in ("depth", "array"))
        np.testing.assert_array_equal(as_they_come.color, scene.color)
        jax.tree.map(np.testing.assert_array_equal, by_depth, jax.tree.map(lambda x: x[nearest_first], as_they_come))


def test_flat_image_at_a_slant_needs_array_order():
    """One splat covers another of its plane from everywhere in front; by depth of centers it does not."""
    disc = (jnp.asarray([[0.0, 0.0], [0.05, 0.0]]), jnp.full((2, 2), 0.1), jnp.zeros(2), jnp.ones(2))
    gaussians = from_scale_angle(*disc, jnp.asarray([[1.0, 0, 0], [0, 0, 1]]))
    camera = orbit(Camera.front(0.5), 0.01)  # the second is nearer by 5e-4
    array, depth = (draw(view(gaussians, camera, SIZE, order=order), SIZE) for order in ("array", "depth"))
    assert array[24, 48, 0] > 0.95
    assert depth[24, 48, 0] < 0.5


def test_nothing_behind_the_camera_is_rendered():
    mean = np.zeros((6, 3), np.float32)
    mean[:, 2] = -5.0, -1.388888, -1.38, 0.0, np.nan, np.inf
    leaves = np.tile(0.1 * np.eye(3), (6, 1, 1)), np.full(6, 0.5), np.ones((6, 3))
    scene = Gaussians3D(jnp.asarray(mean), *(jnp.asarray(leaf, jnp.float32) for leaf in leaves))
    camera = Camera.front(0.5)
    seen = view(scene, camera, SIZE, order="array")
    np.testing.assert_array_equal(seen.opacity, [0, 0, 0, 0.5, 0, 0.5])
    closer = view(scene, camera, SIZE, order="array", near=0.001)
    np.testing.assert_array_equal(closer.opacity, [0, 0, 0.5, 0.5, 0, 0.5])
    picture = draw(view(scene, camera, SIZE), SIZE)
    only = draw(jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[3:4]), seen), SIZE)
    np.testing.assert_allclose(picture, only, atol=1e-6)

    def brightness(mean):
        return jnp.sum(render(project(dataclasses.replace(scene, mean=mean), camera, SIZE), SIZE))

    mean[4:] = -9
    gradient = jax.jit(jax.grad(brightness))(jnp.asarray(mean))
    assert np.isfinite(gradient).all()
    np.testing.assert_array_equal(np.asarray(gradient)[:3], 0)


# --- gradients -------------------------------------------------------------------------------------------------


def smooth_loss(scene, camera):
    """Of the mean, the depth and the covariance: any loss of a picture depends on the factor only so."""
    seen = project(scene, camera, SIZE, order="array")
    weights = jnp.asarray([[1.0, 0.7], [-0.4, 1.3]])
    means, shapes = jnp.sin(seen.mean / 30) * weights[:1], jnp.arctan(seen.factor @ seen.factor.mT / 20) * weights[None]
    others = jnp.sum(seen.opacity[:, None] * seen.color) + jnp.sum(jnp.sin(seen.depth))
    return jnp.sum(means) + jnp.sum(shapes) + others


def check_gradient(slope, tree, *, rtol=1e-6, step=1e-6):
    """`slope` is a compiled `value_and_grad`."""
    leaves, structure = jax.tree.flatten(tree)
    gradient = [np.asarray(leaf) for leaf in jax.tree.leaves(slope(tree)[1])]
    rng = np.random.default_rng(0)
    for k, leaf in enumerate(leaves):
        direction = rng.normal(size=leaf.shape)
        above, below = (
            slope(jax.tree.unflatten(structure, [*leaves[:k], jnp.asarray(np.asarray(leaf) + by), *leaves[k + 1 :]]))[0]
            for by in (step * direction, -step * direction)
        )
        assert np.isfinite(gradient[k]).all()
        numeric = (above - below) / (2 * step)
        np.testing.assert_allclose(np.sum(gradient[k] * direction), numeric, rtol=rtol, atol=1e-6, err_msg=str(k))


smooth_slope = jax.jit(jax.value_and_grad(lambda tree: smooth_loss(*tree)))
#: name: (thickness, scales, camera)
VIEWS = {
    "slanted": (1e-3, (0.05, 0.02), lambda: orbit(Camera.front(0.5), 0.5, 0.3)),
    "flat, slanted": (0.0, (0.05, 0.02), lambda: orbit(Camera.front(0.5), 0.5, 0.3)),
    "flat, edge-on": (0.0, (0.05, 0.02), lambda: orbit(Camera.front(0.5), math.pi / 2)),
    "flat, edge-on from above": (0.0, (0.05, 0.02), lambda: orbit(Camera.front(0.5), 0.0, math.pi / 2)),
    "a line": (0.0, (0.05, 0.0), lambda: orbit(Camera.front(0.5), 0.5, 0.3)),
    "points": (0.0, (0.0, 0.0), lambda: orbit(Camera.front(0.5), 0.5, 0.3)),
    "thin, edge-on": (1e-7, (0.05, 0.02), lambda: orbit(Camera.front(0.5), math.pi / 2)),
}


@pytest.mark.parametrize("view", VIEWS)
def test_gradients_by_finite_differences(view):
    """Of every leaf of the scene and of the camera, where the covariance in the picture is singular too."""
    thickness, scales, camera = VIEWS[view]
    with jax.enable_x64(True):
        rng = np.random.default_rng(5)
        leaves = rng.uniform(-0.2, 0.2, (6, 2)), np.tile(scales, (6, 1)), rng.uniform(0, 6, 6), rng.uniform(size=6)
        scene = from_scale_angle(*map(jnp.asarray, leaves), jnp.ones((6, 3)), thickness=thickness)
        check_gradient(smooth_slope, (scene, camera()))


@pytest.mark.parametrize("engine", ["cpu", pytest.param("reference", marks=pytest.mark.slow)])
def test_single_precision_gradients_are_finite_edge_on(engine):
    camera = orbit(Camera.front(0.5), math.pi / 2)

    @jax.jit
    @jax.value_and_grad
    def slope(tree):
        return jnp.sum(render(project(*tree, SIZE), SIZE, engine=engine) ** 2)

    for thickness in (0.0, 1e-7):
        value, gradients = slope((flat_scene(thickness=thickness), camera))
        assert value > 1, thickness
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients)), thickness


# --- transformations and errors --------------------------------------------------------------------------------


def test_no_gaussians():
    scene = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[:0]), flat_scene())
    seen = view(scene, orbit(Camera.front(0.5), 0.3), SIZE)
    assert seen.factor.shape == (0, 2, 2)
    assert not np.asarray(draw(seen, SIZE)).any()
    assert flatten(scene).factor.shape == (0, 2, 2)


@pytest.mark.slow
def test_vmap_over_cameras():
    scene = flat_scene()
    angles = jnp.asarray([0.0, 0.4, math.pi])
    cameras = jax.jit(jax.vmap(lambda angle: Camera.front(0.5).orbit(angle)))(angles)
    many = jax.jit(jax.vmap(lambda camera: project(scene, camera, SIZE)))(cameras)
    for k, angle in enumerate(angles):
        alone = view(scene, orbit(Camera.front(0.5), angle), SIZE)
        np.testing.assert_allclose(np.asarray(many.mean)[k], alone.mean, atol=2e-5)
        np.testing.assert_array_equal(np.asarray(many.color)[k], alone.color)
    eyes = jnp.asarray([[0.0, 0, -1], [1, 0, -1]])
    assert jax.jit(jax.vmap(Camera.look_at))(eyes).rotation.shape == (2, 3, 3)


def test_compiles_once():
    traces = []

    @jax.jit
    def seen_from(scene, camera):
        traces.append(1)
        return project(scene, camera, SIZE)

    for angle in (0.0, 0.1, math.pi):
        seen_from(flat_scene(seed=int(angle)), orbit(Camera.front(0.5), angle))
    seen_from(flat_scene(), Camera.look_at((0.0, 0.0, -2.0), aspect=0.5))
    assert len(traces) == 1


def test_dtypes():
    scene = flat_scene()
    assert view(scene, Camera.front(0.5), SIZE).mean.dtype == jnp.float32
    with jax.enable_x64(True):  # the scene decides
        camera = Camera.front(0.5)
        assert camera.position.dtype == jnp.float64
        assert {leaf.dtype for leaf in jax.tree.leaves(view(scene, camera, SIZE))} == {jnp.dtype("float32")}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Camera.front(0.0), "aspect"),
        (lambda: Camera.front(None), "aspect"),
        (lambda: Camera.opposing((160, 320)), "aspect"),
        (lambda: Camera.look_at((0, 0, -1), aspect=math.nan), "aspect"),
        (lambda: Camera.front(0.5, fov=40.0), "fov.*math.radians"),
        (lambda: Camera.look_at((0, 0, 0)), "eye, target, up"),
        (lambda: Camera.look_at((0, -1, 0)), "eye, target, up.*another up"),
        (lambda: Camera.look_at((0, -1)), "eye, target, up"),
        (lambda: Camera(jnp.eye(2), jnp.zeros(3), jnp.ones(())), "rotation, position, fov"),
        (lambda: project(flat_scene(), Camera.front(0.5), SIZE, order="back"), "order"),
        (lambda: project(flat_scene(), Camera.front(0.5), SIZE, near=-1.0), "near"),
        (lambda: project(flat_scene(), Camera.front(0.5), (0, 5)), "size"),
        (lambda: Camera.front(0.5).orbit("x"), "^azimuth: expected an angle in radians, got 'x'"),
        (lambda: Camera.front(0.5).orbit(0.1, target=(0, 0)), r"^target: expected \(x, y, z\), got \(0, 0\)"),
        (lambda: Camera(jnp.eye(3), jnp.zeros(3), jnp.ones(()), lens=jnp.ones(2)), "rotation, position, fov, lens"),
        (lambda: Camera.front(0.5).intrinsics((160.0, 320)), "size"),
        (
            lambda: project(jax.tree.map(lambda x: x[None], flat_scene()), Camera.front(0.5), SIZE),
            "jax.vmap",
        ),
        (
            lambda: Gaussians3D(jnp.zeros((2, 3)), jnp.zeros((2, 2, 2)), jnp.zeros(2), jnp.zeros((2, 3))),
            "mean, factor, opacity, color",
        ),
    ],
)
def test_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_undetermined_camera_is_nan_under_tracing():
    assert bool(jnp.isnan(jax.jit(Camera.look_at)(jnp.asarray([0.0, -1.0, 0.0])).rotation[0]).all())


def test_orbit_checks_arguments():
    """Degrees are warned of; turns that are meant are not."""
    camera = Camera.front(0.5)
    camera.orbit(6.0, -1.5).orbit(4 * math.pi)
    jax.jit(lambda angle: camera.orbit(angle).position)(20.0)
    with pytest.warns(UserWarning, match=r"^azimuth: expected radians, got 20, 3\.2 turns\. .*math\.radians\(20\)"):
        camera.orbit(20)
    with pytest.warns(UserWarning, match=r"^elevation: expected radians, got -22\.5"):
        camera.orbit(0.1, -22.5)
