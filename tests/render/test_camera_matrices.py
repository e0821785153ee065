"""Cameras by the matrices of OpenCV and gsplat, and Gaussians by quaternions: against OpenCV and SciPy."""

import math

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import draw
from scipy.spatial.transform import Rotation
from test_camera import check_gradient, covariance, deep_scene, orbit, smooth_loss, view

from foldgauss.render import Camera, Gaussians3D
from foldgauss.render.camera import TANGENT_LIMIT

SIZE = (480, 640)
K = np.array([[500.0, 0.0, 301.5], [0.0, 530.0, 262.0], [0.0, 0.0, 1.0]])


def random_pose(seed=0):
    """R and t with the origin some 3 units in front."""
    rng = np.random.default_rng(seed)
    return Rotation.from_quat(rng.normal(size=4)).as_matrix(), np.array([*rng.uniform(-0.2, 0.2, 2), 3.0])


def viewmat(rotation, shift):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix


@pytest.mark.parametrize("seed", range(4))
def test_points_are_those_of_opencv(seed):
    rotation, shift = random_pose(seed)
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (20, 3))
    truth, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], shift, K, None)
    leaves = points, np.tile(0.01 * np.eye(3), (20, 1, 1)), np.ones(20), np.ones((20, 3))
    for wide, tolerance in ((True, 1e-8), (False, 2e-3)):  # float32 has some 3e-5 px, and the angles' rounding
        with jax.enable_x64(wide):
            camera = Camera.from_matrices(viewmat(rotation, shift), K, SIZE)
            seen = view(Gaussians3D(*(jnp.asarray(leaf, float) for leaf in leaves)), camera, SIZE, order="array")
            np.testing.assert_allclose(seen.mean, truth[:, 0], atol=tolerance)
            np.testing.assert_allclose(seen.depth, (points @ rotation.T + shift)[:, 2], rtol=1e-5)


def test_covariance_is_that_of_the_jacobian():
    """Of OpenCV's own derivative of the image point by the point in space."""
    with jax.enable_x64(True):
        rotation, shift = random_pose()
        gaussians = deep_scene()
        seen = view(gaussians, Camera.from_matrices(viewmat(rotation, shift), K, SIZE), SIZE, order="array")
        for k, point in enumerate(np.asarray(gaussians.mean)):
            _, derivatives = cv2.projectPoints(point[None], cv2.Rodrigues(rotation)[0], shift, K, None)
            root = derivatives[:, 3:6] @ rotation @ np.asarray(gaussians.factor[k])  # by t, which moves as R X does
            np.testing.assert_allclose(covariance(seen)[k], root @ root.T, rtol=1e-6)


def test_shapes_are_held_beyond_the_image_on_both_sides():
    """The Jacobian's tangents are clipped 0.3 half widths beyond the image's borders, wherever the center is."""
    with jax.enable_x64(True):
        camera = Camera.from_matrices(viewmat(np.eye(3), [0, 0, 1]), K, SIZE)
        margin = (TANGENT_LIMIT - 1) * SIZE[1] / 2
        edges = np.array([(-margin - K[0, 2]) / K[0, 0], (SIZE[1] + margin - K[0, 2]) / K[0, 0]])
        x = np.array([edges[0], 1.5 * edges[0], 0.99 * edges[0], edges[1], 1.5 * edges[1], 0.99 * edges[1]])
        leaves = np.stack([x, 0 * x, 0 * x], -1), np.tile(0.1 * np.eye(3), (6, 1, 1)), np.ones(6), np.ones((6, 3))
        ball = Gaussians3D(*map(jnp.asarray, leaves))
        seen = view(ball, camera, SIZE, order="array")
        np.testing.assert_allclose(np.asarray(seen.mean)[:, 0], K[0, 0] * x + K[0, 2], rtol=1e-9)  # the center is not
        width = covariance(seen)[:, 0, 0]
        np.testing.assert_allclose(width[[1, 4]], width[[0, 3]], rtol=1e-9)
        assert (width[[2, 5]] < 0.999 * width[[0, 3]]).all()


@pytest.mark.parametrize("wide", [True, False])
def test_matrices_there_and_back(wide):
    with jax.enable_x64(wide):
        world = viewmat(*random_pose())
        camera = Camera.from_matrices(world, K, SIZE)
        tolerance = 1e-9 if wide else 1e-5
        np.testing.assert_allclose(camera.viewmat, world, atol=tolerance)
        np.testing.assert_allclose(camera.intrinsics(SIZE), K, rtol=tolerance, atol=100 * tolerance)
        half = np.diag([0.5, 0.5, 1]) @ K
        np.testing.assert_allclose(camera.intrinsics((240, 320)), half, rtol=tolerance, atol=100 * tolerance)
        again = Camera.from_matrices(camera.viewmat, camera.intrinsics(SIZE), SIZE)
        np.testing.assert_allclose(again.position, camera.position, atol=tolerance)


def test_matrices_of_other_cameras():
    """What has no matrix of its own: the front camera, turned; one matrix more shows the same image."""
    gaussians, size = deep_scene(dtype=np.float32), (48, 96)
    camera = orbit(Camera.front(0.5), 0.4, 0.2)
    same = Camera.from_matrices(camera.viewmat, camera.intrinsics(size), size)
    np.testing.assert_allclose(np.asarray(camera.intrinsics(size))[:2, 2], [48, 24])
    pictures = [draw(view(gaussians, one, size), size) for one in (camera, same)]
    np.testing.assert_allclose(*pictures, atol=1e-4)
    turned = orbit(Camera.from_matrices(viewmat(*random_pose()), K, SIZE), 0.3)
    np.testing.assert_allclose(turned.intrinsics(SIZE), K, rtol=1e-5)


def test_gradients():
    """Of both matrices, under jit, for the refinement of poses."""
    with jax.enable_x64(True):
        gaussians, world = deep_scene(), jnp.asarray(viewmat(*random_pose()))

        @jax.jit
        @jax.value_and_grad
        def slope(tree):
            pose, focal = tree
            matrix = jnp.asarray(K).at[0, 0].set(focal)
            shifted = world.at[:3, 3].add(pose)
            return smooth_loss(gaussians, Camera.from_matrices(shifted, matrix, (48, 96)))

        check_gradient(slope, (jnp.zeros(3), jnp.asarray(80.0)))


def changed(matrix, **entries):
    matrix = np.array(matrix)
    for name, value in entries.items():
        matrix[int(name[1]), int(name[2])] = value
    return matrix


WORLD = viewmat(np.eye(3), [0, 0, 3])
ERRORS = {
    "no last row": (WORLD[:3], K, SIZE, r"^viewmat: expected shape \(4, 4\), got shape \(3, 4\)\. Append the row"),
    "several": (WORLD[None], K, SIZE, r"^viewmat: .*jax\.vmap"),
    "for rows": (WORLD.T, K, SIZE, r"^viewmat: expected a last row \(0, 0, 0, 1\), got .*transpose"),
    "scaled": (changed(WORLD, e00=2, e11=2, e22=2), K, SIZE, r"^viewmat: expected a rotation.*= 3 and determinant 8"),
    "mirrored": (changed(WORLD, e11=-1), K, SIZE, r"^viewmat: expected a rotation R .*determinant -1"),
    "nan": (changed(WORLD, e03=math.nan), K, SIZE, r"^viewmat: expected a rotation R and finite numbers"),
    "skew": (WORLD, changed(K, e01=2), SIZE, r"^K: expected \[\[fx, 0, cx\].*without skew"),
    "not above 0": (WORLD, changed(K, e11=-530), SIZE, r"^K: expected .* fx and fy above 0"),
    "no pinhole": (WORLD, changed(K, e22=2), SIZE, r"^K: expected \[\[fx, 0, cx\]"),
    "four numbers": (WORLD, [500, 530, 301.5, 262], SIZE, r"^K: expected shape \(3, 3\), got shape \(4,\)"),
    "width only": (WORLD, K, 640, r"^size: expected \(height, width\)"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors(name):
    *arguments, message = ERRORS[name]
    with pytest.raises(ValueError, match=message):
        Camera.from_matrices(*arguments)


# --- quaternions -----------------------------------------------------------------------------------------------


def parameters(num=30, *, seed=0):
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=(num, 4)) * rng.uniform(0.1, 10, (num, 1))  # (w, x, y, z), of any length
    scale = np.exp(rng.uniform(-6, 1, (num, 3)))
    return rng.normal(size=(num, 3)), quaternion, scale, rng.uniform(size=num), rng.uniform(size=(num, 3))


def test_quaternions_are_those_of_scipy():
    with jax.enable_x64(True):
        leaves = parameters()
        gaussians = Gaussians3D.from_quaternions(*map(jnp.asarray, leaves))
        truth = Rotation.from_quat(leaves[1][:, [1, 2, 3, 0]]).as_matrix() * leaves[2][:, None, :]
        np.testing.assert_allclose(gaussians.factor, truth, atol=1e-14)
        for name, leaf in (("mean", leaves[0]), ("opacity", leaves[3]), ("color", leaves[4])):
            np.testing.assert_array_equal(getattr(gaussians, name), leaf)
    narrow = Gaussians3D.from_quaternions(*(np.asarray(leaf, np.float32) for leaf in leaves))  # NumPy, too
    np.testing.assert_allclose(narrow.factor, truth, rtol=1e-4, atol=1e-6)


def test_gradient_by_quaternions_and_scales():
    with jax.enable_x64(True):
        mean, quaternion, scale, opacity, color = map(jnp.asarray, parameters(4))
        weights = jnp.asarray(np.random.default_rng(1).normal(size=(4, 3, 3)))

        @jax.jit
        @jax.value_and_grad
        def slope(tree):
            factor = Gaussians3D.from_quaternions(mean, *tree, opacity, color).factor
            return jnp.sum(weights * (factor @ factor.mT))

        check_gradient(slope, (quaternion, scale))


MEAN, QUATERNION, SCALE, *REST = parameters(3)
WRONG = [
    (QUATERNION, np.log(SCALE), r"scale: expected standard deviations >= 0.*jnp\.exp\(scale\)"),
    (0 * QUATERNION, SCALE, r"quaternion: expected \(w, x, y, z\) of a length above 0"),
    (QUATERNION[:, :3], SCALE, r"quaternion: expected shape \(num, 4\) for means of shape \(3, 3\)"),
    (QUATERNION, SCALE[:, 0], r"scale: expected shape \(num, 3\).*got shape \(3,\)"),
]


@pytest.mark.parametrize(("quaternion", "scale", "message"), WRONG)
def test_quaternion_errors(quaternion, scale, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        Gaussians3D.from_quaternions(MEAN, quaternion, scale, *REST)
