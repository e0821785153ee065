"""Three-dimensional Gaussians, pinhole cameras, and the projection of Gaussians to two-dimensional splats.

In model space x points right, y down and z away from the viewer; the frame is centered in the plane z = 0 and its
longer side is 1. The published code's (x, y, z) is (x, z, -y) here, and its unit is the distance from the front camera
to the plane.
"""

import dataclasses
import math
from numbers import Real

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, ArrayLike, Float

from foldgauss._numerics.batch import concrete_value
from foldgauss._runtime.checks import check_one_of, invalid, require, short_repr, warn_if_degrees
from foldgauss.render.splats import Splats2D, check_aspect, check_shapes, check_size, pixels_per_unit

#: Horizontal field of view of the published VeGaS and MiraGe cameras, in radians: half of it has tangent 0.36.
FIELD_OF_VIEW = 0.6911112
#: eps of eq:mirage, the standard deviation across the plane: 1e-4 pixels in a frame of 1000.
THICKNESS = 1e-7
#: Nearest depth that is rendered, in model units, as in gsplat: the linearized projection is singular at depth 0.
NEAR = 0.01
#: The Jacobian is evaluated no farther out than this times the half field of view, as in the published 3DGS.
TANGENT_LIMIT = 1.3
ORDERS = ("depth", "array")
#: The largest error of an entry of R R^T and of a viewmat's last row: matrices in text files often have four digits.
ROTATION_TOLERANCE = 1e-3


class Gaussians3D(eqx.Module):
    r"""Three-dimensional Gaussians with opacity and color.

    $$ \alpha_i(x) = \rho_i \exp(-\tfrac12 (x - m_i)^T (F_i F_i^T)^{-1} (x - m_i)) $$

    Shapes: `mean` (num, 3) and `factor` (num, 3, 3) in model space, any F with covariance F F^T (columns R S of a
    rotation and scales, or a Cholesky factor); `opacity` (num,) in [0, 1]; `color` (num, channels).
    Source: VeGaS eq:3dgs, eq:mirage.
    """

    mean: Float[Array, "num 3"]
    factor: Float[Array, "num 3 3"]
    opacity: Float[Array, " num"]
    color: Float[Array, "num channels"]

    def __check_init__(self) -> None:
        check_shapes(self, mean=(3,), factor=(3, 3))

    @classmethod
    def from_flat(cls, splats: Splats2D, *, thickness: float = THICKNESS) -> "Gaussians3D":
        """Convert splats in model space to flat Gaussians with mean (m1, m2, 0) and factor diag(F_2D, thickness).

        Source: VeGaS eq:mirage.
        """
        mean = jnp.concatenate([splats.mean, jnp.zeros_like(splats.mean[..., :1])], -1)
        across = jnp.broadcast_to(jnp.asarray([0, 0, thickness], mean.dtype), mean.shape)[..., None, :]
        plane = jnp.concatenate([splats.factor, jnp.zeros_like(splats.factor[..., :1])], -1)
        return cls(mean, jnp.concatenate([plane, across], -2), splats.opacity, splats.color)

    @classmethod
    def from_quaternions(
        cls,
        mean: Float[Array, "num 3"],
        quaternion: Float[Array, "num 4"],
        scale: Float[Array, "num 3"],
        opacity: Float[Array, " num"],
        color: Float[Array, "num channels"],
    ) -> "Gaussians3D":
        """Create Gaussians from the parameters of 3DGS: F = R(quaternion) diag(scale).

        `quaternion` is (w, x, y, z) of any length but 0: it is normalized here. `scale` has standard deviations along
        the Gaussian's axes, and `opacity` is in [0, 1], as gsplat takes them. The parameters of 3DGS, also those in its
        files, are log(scale) and logit(opacity): pass `jnp.exp(scale)` and `jax.nn.sigmoid(opacity)`.

        Raises ValueError for shapes that do not match, a quaternion of length 0 (NaN under tracing) and a negative
        scale. Source: Kerbl et al. 2023, 3D Gaussian Splatting, eq. 6.
        """
        for name, value, width in (("quaternion", quaternion, 4), ("scale", scale, 3)):
            require(
                np.shape(value) == (*np.shape(mean)[:-1], width),
                name,
                expected=f"shape (num, {width}) for means of shape {np.shape(mean)}",
                got=f"shape {np.shape(value)}",
            )
        turns, scales = concrete_value(quaternion), concrete_value(scale)
        require(
            turns is None or not (turns == 0).all(-1).any(),
            "quaternion",
            expected="(w, x, y, z) of a length above 0",
            got="zeros",
        )
        least = 0.0 if scales is None else float(scales.min(initial=0.0))
        require(
            not least < 0,
            "scale",
            expected="standard deviations >= 0",
            got=f"{least:g}",
            cure="3DGS stores their logarithms: pass jnp.exp(scale).",
        )
        rotation = Rotation.from_quat(jnp.roll(jnp.asarray(quaternion), -1, axis=-1)).as_matrix()  # x, y, z, w
        return cls(mean, rotation * jnp.asarray(scale)[..., None, :], opacity, color)


class Camera(eqx.Module):
    """A pinhole camera: axes right, down and forward, which are x, y and z of the front camera.

    Shapes: `rotation` (3, 3) takes world directions to the camera's axes, its rows; `position` (3,) in model space;
    `fov` () is the frame's horizontal field of view in radians. `aspect` is that frame's height / width (None: the
    image's own); an image of another aspect is covered by the frame as in `Splats2D.to_pixels`. `lens` (3,) is the
    ratio of the vertical to the horizontal focal length, and the principal point's offset from the frame's center in
    frame widths (right, down); None is (1, 0, 0). See `from_matrices` for the matrices of OpenCV and gsplat.
    """

    rotation: Float[Array, "3 3"]
    position: Float[Array, "3"]
    fov: Float[Array, ""]
    aspect: float | None = eqx.field(static=True, default=None)
    lens: Float[Array, "3"] | None = None

    def __check_init__(self) -> None:
        leaves = (self.rotation, self.position, self.fov, *([] if self.lens is None else [self.lens]))
        shapes = [getattr(leaf, "shape", None) for leaf in leaves]
        if any(shape is None for shape in shapes):
            return  # placeholders, as inside tree transformations
        batch = shapes[2]
        require(
            shapes == [(*batch, 3, 3), (*batch, 3), batch, (*batch, 3)][: len(shapes)],
            "rotation, position, fov, lens",
            expected="shapes (3, 3), (3,), (), (3,)",
            got=", ".join(map(str, shapes)),
        )
        if self.aspect is not None:
            check_aspect(self.aspect)
        fov = concrete_value(self.fov)
        require(
            fov is None or ((fov > 0) & (fov < math.pi)).all(),
            "fov",
            expected="radians in (0, pi)",
            got=fov,
            cure="For degrees use math.radians.",
        )

    @classmethod
    def front(cls, aspect: float, *, fov: ArrayLike = FIELD_OF_VIEW) -> "Camera":
        """The camera whose image is the plane z = 0: a frame of height / width `aspect` fills its view.

        Its position is (0, 0, -d) and it looks along z, where d = min(1, 1 / aspect) / (2 tan(fov / 2)).
        Source: VeGaS, "Video Gaussian Splatting" (two opposing cameras); field of view of the published code.
        """
        check_aspect(aspect)
        fov = _as_float(fov)
        distance = min(1.0, 1 / aspect) / (2 * jnp.tan(fov / 2))
        return cls(jnp.eye(3, dtype=fov.dtype), -distance * jnp.asarray([0, 0, 1], fov.dtype), fov, aspect)

    @classmethod
    def opposing(cls, aspect: float, *, fov: ArrayLike = FIELD_OF_VIEW) -> "Camera":
        """The camera opposite to the front camera, behind the plane: the plane appears mirrored horizontally.

        Source: VeGaS, "Video Gaussian Splatting", last paragraph; MiraGe.
        """
        return cls.front(aspect, fov=fov).orbit(math.pi)

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike = (0.0, 0.0, 0.0),
        *,
        up: ArrayLike = (0.0, -1.0, 0.0),
        fov: ArrayLike = FIELD_OF_VIEW,
        aspect: float | None = None,
    ) -> "Camera":
        """A camera at `eye` with `target` at the center of its image and `up` upright in it; all (3,), model space.

        Raises ValueError if eye and target coincide, or up is along the line of sight; NaN under tracing.
        """
        eye, target, up = _as_float(eye), _as_float(target), _as_float(up)
        require(
            eye.shape == target.shape == up.shape == (3,),
            "eye, target, up",
            expected="(x, y, z) each",
            got=f"shapes {eye.shape}, {target.shape}, {up.shape}",
            cure="Use jax.vmap for a batch.",
        )
        forward = _unit(target - eye)
        across = jnp.cross(forward, _unit(up))
        # A sine of the size of rounding errors does not determine a direction.
        undetermined = ~(_length(across) > 8 * jnp.finfo(across.dtype).eps)
        require(
            concrete_value(undetermined) is None or not undetermined.any() or jnp.isnan(eye + target + up).any(),
            "eye, target, up",
            expected="two points, and up not along their line",
            got=f"eye {eye}, target {target}, up {up}",
            cure="Looking straight up or down, choose another up, such as (0, 0, 1).",
        )
        right = jnp.where(undetermined, jnp.nan, _unit(across))
        return cls(jnp.stack([right, jnp.cross(forward, right), forward]), eye, _as_float(fov), aspect)

    @classmethod
    def from_matrices(cls, viewmat: ArrayLike, K: ArrayLike, size: tuple[int, int]) -> "Camera":
        r"""A camera from its matrices in the convention of OpenCV, COLMAP and gsplat: x right, y down, z forward.

        $$ (x, y, z) = R X + t, \quad u = f_x x / z + c_x, \quad v = f_y y / z + c_y $$

        - `viewmat`: (4, 4), [[R, t], [0, 1]], from world to camera: R a rotation, t in the unit of the Gaussians.
        - `K`: (3, 3), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], in pixels of an image of `size` = (height, width). The two
          focal lengths may differ and the principal point may be anywhere; there is no skew and no lens distortion.
        - `size`: that of the image K belongs to. Of the same aspect, images of other sizes show the same.

        Pixel centers are at +0.5, as in COLMAP and gsplat. OpenCV's calibration has them at whole numbers: add 0.5 to
        its cx and cy. `viewmat` and `intrinsics(size)` return the matrices. Differentiable in both matrices.

        Raises ValueError for other shapes, an R that is no rotation (scaled, mirrored), focal lengths that are not
        above 0, and skew; values are not checked under tracing.

        Example: `project(gaussians, Camera.from_matrices(viewmat, K, (480, 640)), (480, 640))`.
        """
        check_size(size)
        viewmat, K = _as_float(viewmat), _as_float(K)
        _check_viewmat(viewmat)
        _check_intrinsics(K)
        height, width = size
        rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
        middle = jnp.asarray([width / 2, height / 2], K.dtype)
        return cls(
            rotation,
            -jnp.matmul(rotation.T, shift, precision="highest"),
            2 * jnp.arctan(width / 2 / K[0, 0]),
            height / width,
            jnp.concatenate([K[1:2, 1] / K[0, 0], (K[:2, 2] - middle) / width]),
        )

    def orbit(self, azimuth: ArrayLike, elevation: ArrayLike = 0.0, *, target: ArrayLike = (0.0, 0.0, 0.0)) -> "Camera":
        """This camera rotated about `target`: first by `elevation` about x, then by `azimuth` about the vertical.

        Angles in radians. From the front, a positive azimuth moves to the right, a positive elevation up. Quarter turns
        are exact, so Gaussians of equal depth keep equal depths. Warns of angles that seem to be degrees.
        """
        dtype = self.position.dtype
        _check_angle("azimuth", azimuth)
        _check_angle("elevation", elevation)
        require(np.shape(target) == (3,), "target", expected="(x, y, z)", got=short_repr(target))
        (cos_a, sin_a), (cos_e, sin_e) = (_cos_sin(jnp.asarray(angle, dtype)) for angle in (azimuth, elevation))
        zero, one, target = jnp.zeros((), dtype), jnp.ones((), dtype), jnp.asarray(target, dtype)
        about_y = jnp.stack([cos_a, zero, -sin_a, zero, one, zero, sin_a, zero, cos_a]).reshape(3, 3)
        about_x = jnp.stack([one, zero, zero, zero, cos_e, sin_e, zero, -sin_e, cos_e]).reshape(3, 3)
        turn = jnp.matmul(about_y, about_x, precision="highest")
        position = target + jnp.matmul(turn, self.position - target, precision="highest")
        rotation = jnp.matmul(self.rotation, turn.T, precision="highest")
        return dataclasses.replace(self, rotation=rotation, position=position)

    def intrinsics(self, size: tuple[int, int]) -> Float[Array, "3 3"]:
        """The matrix K in pixels of an image of `size` = (height, width); see `from_matrices`."""
        width = self._frame_width(size)
        focal = width / (2 * jnp.tan(self.fov / 2))
        lens = jnp.asarray([1, 0, 0], focal.dtype) if self.lens is None else self.lens
        center = jnp.asarray([size[1] / 2, size[0] / 2], lens.dtype) + width * lens[1:]
        zero, one = jnp.zeros_like(focal), jnp.ones_like(focal)
        return jnp.stack([focal, zero, center[0], zero, focal * lens[0], center[1], zero, zero, one]).reshape(3, 3)

    @property
    def viewmat(self) -> Float[Array, "4 4"]:
        """The matrix from world to camera; see `from_matrices`."""
        shift = -jnp.matmul(self.rotation, self.position, precision="highest")
        last = jnp.asarray([[0, 0, 0, 1]], shift.dtype)
        return jnp.concatenate([jnp.concatenate([self.rotation, shift[:, None]], 1), last])

    def _frame_width(self, size: tuple[int, int]) -> float:
        """Pixels of the frame's width in an image of `size`."""
        check_size(size)
        aspect = size[0] / size[1] if self.aspect is None else self.aspect
        return pixels_per_unit(size, aspect=aspect) * min(1.0, 1 / aspect)


def project(
    gaussians: Gaussians3D, camera: Camera, size: tuple[int, int], *, order: str = "depth", near: float = NEAR
) -> Splats2D:
    r"""Project Gaussians to splats in pixels of a camera's image of `size` = (height, width), for `render`.

    $$
    F_{2D} F_{2D}^T = J W F F^T W^T J^T,
    \quad J = \tfrac{f}{z} \begin{bmatrix} 1 & 0 & -x/z \\ 0 & 1 & -y/z \end{bmatrix}
    $$

    with (x, y, z) the mean in the camera's axes W and f the focal length in pixels, by row where the camera has two; in
    J alone x/z and y/z are clipped to 1.3 times the half field of view about the image's center, as the linearization
    diverges beyond. The splats' `depth` is z.

    - `order`: "depth", front to back by z, array order where depths are equal; or "array", unchanged. In a fitted
      image the compositing order is the array order: use "array" for its flat Gaussians at a slant, as "depth" would
      compare the centers of splats of one plane. From the front and the opposing camera the two agree.
    - `near`: where z <= near (model units) the opacity is 0 and the other leaves are meaningless.

    For flat Gaussians and the front camera this equals `Splats2D.to_pixels`, plus (thickness f / z)^2 u u^T in the
    covariance with u = (x/z, y/z) clipped as above.

    Differentiable in every leaf of both, rank-deficient covariances included; the order is piecewise constant. Raises
    ValueError for an unknown order, a size below 1 and a batch (use `jax.vmap`).

    Example: `render(project(gaussians, Camera.front(0.5).orbit(0.4), (160, 320)), (160, 320))`.

    Source: Zwicker et al. 2001, EWA volume splatting (the local affine map); Kerbl et al. 2023, 3D Gaussian Splatting,
    eq. 5, and its published rasteriser for the 1.3.
    """
    check_one_of("order", order, ORDERS)
    for name, value, kind in (("gaussians", gaussians, Gaussians3D), ("camera", camera, Camera)):
        require(isinstance(value, kind), name, expected=kind.__name__, got=type(value).__name__)
    require(isinstance(near, Real) and near >= 0, "near", expected="a depth >= 0 in model units", got=near)
    require(
        gaussians.mean.ndim == 2 and camera.position.ndim == 1,
        "gaussians, camera",
        expected="mean of shape (num, 3) and position of shape (3,)",
        got=f"{gaussians.mean.shape} and {camera.position.shape}",
        cure="Use jax.vmap for a batch.",
    )
    dtype = gaussians.mean.dtype
    rotation, position = camera.rotation.astype(dtype), camera.position.astype(dtype)
    intrinsics, middle = camera.intrinsics(size).astype(dtype), jnp.asarray([size[1] / 2, size[0] / 2], dtype)
    focal, center = jnp.diagonal(intrinsics)[:2], intrinsics[:2, 2]

    view = jnp.sum(rotation[None] * (gaussians.mean - position[None])[:, None, :], -1)
    depth = view[:, 2]
    seen = depth > near
    safe_depth = jnp.where(seen, depth, jnp.ones_like(depth))
    tangent = view[:, :2] / safe_depth[:, None]
    limit, ahead = TANGENT_LIMIT * middle / focal, (middle - center) / focal
    held = jnp.clip(tangent, (ahead - limit)[None], (ahead + limit)[None])
    jacobian = (focal[None] / safe_depth[:, None])[..., None] * (
        rotation[None, :2] - held[..., None] * rotation[None, 2:]
    )
    splats = Splats2D(
        focal[None] * tangent + center[None],
        square_factor(jnp.matmul(jacobian, gaussians.factor, precision="highest")),
        jnp.where(seen, gaussians.opacity, jnp.zeros_like(gaussians.opacity)),
        gaussians.color,
        depth,
    )
    if order == "array":
        return splats
    nearest_first = jnp.argsort(depth, stable=True)
    return jax.tree.map(lambda leaf: leaf[nearest_first], splats)


def square_factor(rows: Float[Array, "*num 2 3"]) -> Float[Array, "*num 2 2"]:
    """A 2x2 factor of M M^T for M (2, 3), without forming it: M's QR decomposition, the longer row first.

    Its entries are the rows' length, inner product and area, each to its own relative accuracy where M's columns are
    graded, so a needle keeps its width. With the longer row first, no divisor is small. For rank 1 the second diagonal
    entry is 0 and so is its gradient, which is exact for any function of M M^T.
    """
    # A constant unit keeps squares in range; lengths are homogeneous, so their gradient does not depend on it.
    unit = lax.stop_gradient(jnp.max(jnp.abs(rows), axis=(-2, -1), keepdims=True))
    unit = jnp.where(unit > 0, unit, jnp.ones_like(unit))
    x, y = rows[..., 0, :] / unit[..., 0], rows[..., 1, :] / unit[..., 0]
    wide = jnp.sum(x * x, -1, keepdims=True) >= jnp.sum(y * y, -1, keepdims=True)
    first, second = jnp.where(wide, x, y), jnp.where(wide, y, x)
    length, area = _length(first), _length(jnp.cross(first, second))
    safe_length = jnp.where(length > 0, length, jnp.ones_like(length))
    first = jnp.concatenate([length, jnp.zeros_like(length)], -1)
    second = jnp.concatenate([jnp.sum(jnp.where(wide, x * y, y * x), -1, keepdims=True), area], -1) / safe_length
    return unit * jnp.stack([jnp.where(wide, first, second), jnp.where(wide, second, first)], -2)


def _length(vector: Float[Array, "*batch dim"]) -> Float[Array, "*batch 1"]:
    """Euclidean length; at 0 the gradient is 0, not NaN."""
    square = jnp.sum(vector * vector, -1, keepdims=True)
    some = square > 0
    length = jnp.sqrt(jnp.where(some, square, jnp.ones_like(square)))
    # NaN in, NaN out.
    return jnp.where(some, length, square)


def _unit(vector: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """The direction of a vector; NaN for 0."""
    return vector / _length(vector)


def _cos_sin(angle: Float[Array, ""]) -> Float[Array, "2"]:
    """Cosine and sine, 0 where they are within rounding of it: quarter turns are exact."""
    pair = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    rounding = jnp.minimum(jnp.finfo(angle.dtype).eps * jnp.abs(angle), 1e-6)
    is_rounding = jnp.abs(pair) <= rounding
    return pair - lax.stop_gradient(jnp.where(is_rounding, pair, jnp.zeros_like(pair)))


def _check_viewmat(viewmat: Float[Array, "4 4"]) -> None:
    """Raise unless it is a rigid motion; traced values are not checked."""
    require(
        viewmat.shape == (4, 4),
        "viewmat",
        expected="shape (4, 4)",
        got=f"shape {viewmat.shape}",
        cure="Append the row (0, 0, 0, 1) to [R, t]; use jax.vmap for several cameras.",
    )
    matrix = concrete_value(viewmat)
    if matrix is None:
        return
    require(
        np.allclose(matrix[3], [0, 0, 0, 1], atol=ROTATION_TOLERANCE),
        "viewmat",
        expected="a last row (0, 0, 0, 1)",
        got=matrix[3],
        cure="It multiplies columns (x, y, z, 1): transpose a matrix for rows.",
    )
    error, det = np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max(), np.linalg.det(matrix[:3, :3])
    require(
        error <= ROTATION_TOLERANCE and det > 0 and np.isfinite(matrix).all(),
        "viewmat",
        expected="a rotation R and finite numbers",
        got=f"one with max |R R^T - 1| = {error:.3g} and determinant {det:.3g}",
        cure="Move a scale into the Gaussians; an axis that is mirrored must be so in them, too.",
    )


def _check_intrinsics(K: Float[Array, "3 3"]) -> None:
    """Raise unless it is a pinhole without skew; traced values are not checked."""
    require(
        K.shape == (3, 3),
        "K",
        expected="shape (3, 3)",
        got=f"shape {K.shape}",
        cure="For several cameras use jax.vmap.",
    )
    matrix = concrete_value(K)
    if matrix is None:
        return
    pinhole = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    require(
        np.array_equal(matrix, pinhole) and matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.isfinite(matrix).all(),
        "K",
        expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy above 0",
        got=matrix.tolist(),
        cure="Undistort images with cv2.undistort and a new camera matrix without skew.",
    )


def _check_angle(parameter: str, angle: ArrayLike) -> None:
    """Raise unless it is a number, warn of degrees; traced values are not checked."""
    try:
        value = concrete_value(jnp.asarray(angle))
    except (TypeError, ValueError):
        raise invalid(parameter, expected="an angle in radians", got=short_repr(angle)) from None
    if value is not None:
        warn_if_degrees(parameter, *value.ravel().tolist(), stacklevel=4)


def _as_float(x: ArrayLike) -> Array:
    return jnp.asarray(x, jnp.result_type(float))
