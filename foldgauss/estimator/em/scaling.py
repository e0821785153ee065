"""Centering and scaling of points for fitting, and conversion of components back to the units of the points."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import AbstractEnvelope, Constant, TimeLikelihood
from foldgauss.estimator.chunks import Piece
from foldgauss.estimator.em.components import Parameters
from foldgauss.fold import PolynomialFold
from foldgauss.mixture import FoldedMixture

__all__ = ["RowTransform", "Scaling", "compute_scaling", "to_mixture"]


class Scaling(NamedTuple):
    """x = shift + scale y, per coordinate, in float64."""

    shift: Float[np.ndarray, " d"]
    scale: Float[np.ndarray, " d"]

    def apply(self, x: np.ndarray) -> np.ndarray:
        """y in the dtype of x. Centered in float64, so that an offset costs the variances no digits."""
        return ((x.astype(np.float64) - self.shift) / self.scale).astype(x.dtype)

    @property
    def log_volume(self) -> float:
        """log |dx/dy|."""
        return float(np.log(self.scale).sum())


class RowTransform(NamedTuple):
    """Prepares pieces of chunks for fitting: rows of positive weight, columns in `order`, scaled."""

    order: Int[np.ndarray, " d"]
    scaling: Scaling
    factor: float  # of the weights
    dtype: np.dtype

    def __call__(self, piece: Piece) -> tuple[np.ndarray, np.ndarray]:
        kept = piece.weights > 0
        x, weights = (z.astype(self.dtype, copy=False) for z in (piece.x[kept][:, self.order], piece.weights[kept]))
        return self.scaling.apply(x), weights if self.factor == 1 else weights * self.dtype.type(self.factor)


def compute_scaling(mean, variance, envelope: AbstractEnvelope, covariance: str) -> Scaling:
    """The scaling to mean 0 and variance 1 per coordinate, as far as the model allows."""
    shift, scale = mean.copy(), np.sqrt(variance)
    # A constant column is not scaled.
    scale = np.where(scale > 8 * np.finfo(np.float64).eps * np.abs(shift), scale, 1.0)
    if covariance == "spherical":  # needs one scale for all space coordinates
        scale[:-1] = np.sqrt(np.mean(scale[:-1] ** 2))
    if not isinstance(envelope, Constant | TimeLikelihood):  # a user's function of t is defined in the original units
        shift[-1], scale[-1] = 0.0, 1.0
    return Scaling(shift, scale)


def to_mixture(params: Parameters, scaling: Scaling, envelope: AbstractEnvelope) -> FoldedMixture:
    """Convert components to a mixture in the units of the points."""
    dtype = params.curve.dtype
    log_weights, time_loc, time_scale, curve, tril = (np.asarray(z, np.float64) for z in params)
    space, time = scaling.scale[:-1], scaling.scale[-1]
    time_scale = time * time_scale
    degree = params.degree
    coefficients = curve[:, 1:] * space / time_scale[:, None, None] ** np.arange(1, degree + 1)[None, :, None]
    components = FoldedGaussian(
        jnp.asarray(scaling.shift[:-1] + space * curve[:, 0], dtype),
        jnp.asarray(space[:, None] * tril, dtype),
        time_loc=jnp.asarray(scaling.shift[-1] + time * time_loc, dtype),
        time_scale=jnp.asarray(time_scale, dtype),
        fold=PolynomialFold(jnp.asarray(coefficients, dtype)),
        envelope=envelope,
        validate_args=False,
    )
    return FoldedMixture(components, logits=jnp.asarray(log_weights, dtype))
