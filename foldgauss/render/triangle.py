"""Flat Gaussians as triangles for editing: moving a vertex changes the Gaussian."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from foldgauss._numerics.batch import concrete_value
from foldgauss._runtime.checks import require
from foldgauss.render.camera import THICKNESS, Gaussians3D
from foldgauss.render.splats import check_shapes

#: Edges are collinear if the sine of their angle is at most this many epsilons of the dtype.
COLLINEAR = 8.0
#: The cosine up to which a factor's third column counts as perpendicular to the other two.
ACROSS = 1e-3


class Triangles(eqx.Module):
    r"""Triangles V = [m, v1, v2] that represent flat Gaussians, with their opacity and color.

    Shapes: `origin` (num, 3), the vertex m; `edges` (num, 2, 3), v1 - m and v2 - m; `opacity` (num,); `color` (num,
    channels). Model space. Edges are stored instead of v1 and v2, since far from the origin a small edge would be lost
    in the rounding of its end point.

    Source: VeGaS eq:traingle_face; GaMeS.
    """

    origin: Float[Array, "num 3"]
    edges: Float[Array, "num 2 3"]
    opacity: Float[Array, " num"]
    color: Float[Array, "num channels"]

    def __check_init__(self) -> None:
        check_shapes(self, origin=(3,), edges=(2, 3))

    @classmethod
    def from_vertices(
        cls,
        vertices: Float[Array, "num 3 3"],
        opacity: Float[Array, " num"],
        color: Float[Array, "num channels"],
    ) -> "Triangles":
        """Create triangles from m, v1 and v2 along the second axis, each (x, y, z)."""
        return cls(vertices[..., 0, :], vertices[..., 1:, :] - vertices[..., :1, :], opacity, color)

    @property
    def vertices(self) -> Float[Array, "num 3 3"]:
        """m, v1 and v2 along the second axis; rounding, |m| 6e-8 in float32, affects the edges."""
        origin = self.origin[..., None, :]
        return jnp.concatenate([origin, origin + self.edges], -2)

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians3D) -> "Triangles":
        """v1 = m + s1 r1 and v2 = m + s2 r2, with r1 and r2 the Gaussian's axes in its plane.

        The plane is that of the factor's first two columns; the third, the thickness across it, is dropped. Columns
        R S keep their order and signs; others are rotated to the axes. Not differentiable where s1 = s2 (the axes are
        then arbitrary); the angle's part of the gradient is 0 there. Raises ValueError if the third column is not
        perpendicular to the first two.

        Source: VeGaS eq:traingle_face.
        """
        _check_perpendicular(gaussians.factor)
        unit = lax.stop_gradient(jnp.max(jnp.abs(gaussians.factor[..., :2]), axis=(-2, -1)))[..., None]
        unit = jnp.where(unit > 0, unit, jnp.ones_like(unit))
        first, second = gaussians.factor[..., 0] / unit, gaussians.factor[..., 1] / unit
        swap = _dot(first, first) < _dot(second, second)
        p, q = jnp.where(swap, second, first), jnp.where(swap, first, second)
        # One Jacobi rotation makes two columns orthogonal; the shorter follows from the area, which cannot cancel.
        twist, difference = 2 * _dot(p, q), _dot(p - q, p + q)
        isotropic = (twist == 0) & (difference == 0)
        angle = jnp.arctan2(twist, jnp.where(isotropic, jnp.ones_like(difference), difference)) / 2
        angle = jnp.where(isotropic, jnp.zeros_like(angle), angle)
        long = jnp.cos(angle) * p + jnp.sin(angle) * q
        square = _dot(long, long)
        short = jnp.cross(jnp.cross(p, q), long) / jnp.where(square > 0, square, jnp.ones_like(square))
        edges = jnp.stack([jnp.where(swap, short, long), jnp.where(swap, long, short)], -2)
        return cls(gaussians.mean, edges * unit[..., None], gaussians.opacity, gaussians.color)

    def to_gaussians(self, *, thickness: float = THICKNESS) -> Gaussians3D:
        """The flat Gaussians of these faces, F = [s1 r1, s2 r2, thickness n] with n the face's normal.

        s1 r1 = v1 - m, and s2 r2 = v2 - m less its part along r1, one step of Gram-Schmidt. For faces in the plane
        z = 0 the normal is e3 (the paper's e2 in eq:gaussrecons1 is an erratum; mirrored faces have -e3, the same
        covariance). Raises ValueError if a face is collinear; NaN for that face under tracing.

        Source: VeGaS eq:gaussrecons1, eq:gaussrecons2; GaMeS for faces anywhere in space.
        """
        first, second = self.edges[..., 0, :], self.edges[..., 1, :]
        length = jnp.sqrt(_dot(first, first))
        normal = jnp.cross(first / length, second / jnp.sqrt(_dot(second, second)))
        sine = jnp.sqrt(_dot(normal, normal))
        valid = sine > COLLINEAR * jnp.finfo(sine.dtype).eps
        _check_faces(self.edges, valid)
        along = first / length
        columns = [first, second - along * _dot(along, second), thickness * normal / sine]
        factor = jnp.where(valid[..., None], jnp.stack(columns, -1), jnp.nan)
        return Gaussians3D(self.origin, factor, self.opacity, self.color)


def _check_perpendicular(factor: Float[Array, "*num 3 3"]) -> None:
    factor = concrete_value(factor)
    if factor is None:
        return
    third = factor[..., 2:]
    slant = np.abs(np.sum(factor[..., :2] * third, -2))
    lengths = np.linalg.norm(factor[..., :2], axis=-2) * np.linalg.norm(third, axis=-2)
    require(
        not (slant > ACROSS * lengths).any(),
        "gaussians.factor",
        expected="a third column at right angles to the first two",
        got="another",
        cure="Triangles represent flat Gaussians: use Gaussians3D.from_flat, or columns R S with the thickness last.",
    )


def _check_faces(edges: Float[Array, "*num 2 3"], valid: Bool[Array, "*num 1"]) -> None:
    edges, valid = concrete_value(edges), concrete_value(valid)
    if edges is None or valid is None:
        return
    bad = ~valid[..., 0] & np.isfinite(edges).all((-1, -2))  # NaN in, NaN out
    require(
        not bad.any(),
        "edges",
        expected="faces whose three vertices span a plane",
        got=f"{bad.sum()} without area, the first at index {bad.argmax() if bad.size else 0}",
        cure="Move a vertex off the line through the other two, or drop the face.",
    )


def _dot(a: Float[Array, "*num 3"], b: Float[Array, "*num 3"]) -> Float[Array, "*num 1"]:
    return jnp.sum(a * b, -1, keepdims=True)
