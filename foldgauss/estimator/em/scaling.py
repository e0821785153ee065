"""Points centred and scaled for fitting, and components taken back to the units of the points."""

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

__all__ = ["Prepare", "Scaling", "from_mixture", "scaling_of", "to_mixture"]


class Scaling(NamedTuple):
    """x = shift + scale y, per coordinate, in float64."""

    shift: Float[np.ndarray, " d"]
    scale: Float[np.ndarray, " d"]

    def apply(self, x: np.ndarray) -> np.ndarray:
        """y in the dtype of x, rows in order. Centred in float64: an offset costs the variances no digits."""
        return ((x.astype(np.float64) - self.shift) / self.scale).astype(x.dtype)

    @property
    def log_volume(self) -> float:
        """log |dx/dy|."""
        return float(np.log(self.scale).sum())


class Prepare(NamedTuple):
    """Pieces of chunks made ready for fitting: rows with weight, their columns in `order`, scaled."""

    order: Int[np.ndarray, " d"]
    scaling: Scaling
    factor: float  # of the weights
    dtype: np.dtype

    def __call__(self, piece: Piece) -> tuple[np.ndarray, np.ndarray]:
        there = piece.weights > 0
        x, weights = (z.astype(self.dtype, copy=False) for z in (piece.x[there][:, self.order], piece.weights[there]))
        return self.scaling.apply(x), weights if self.factor == 1 else weights * self.dtype.type(self.factor)


def scaling_of(mean, variance, envelope: AbstractEnvelope, covariance: str) -> Scaling:
    """Mean 0 and variance 1 per coordinate, as far as the model allows."""
    shift, scale = mean.copy(), np.sqrt(variance)
    # A constant column is left in its own units.
    scale = np.where(scale > 8 * np.finfo(np.float64).eps * np.abs(shift), scale, 1.0)
    if covariance == "spherical":  # equal in the units of the points, so in all units that are equal
        scale[:-1] = np.sqrt(np.mean(scale[:-1] ** 2))
    if not isinstance(envelope, Constant | TimeLikelihood):  # a user's function of t means t
        shift[-1], scale[-1] = 0.0, 1.0
    return Scaling(shift, scale)


def to_mixture(params: Parameters, scaling: Scaling, envelope: AbstractEnvelope) -> FoldedMixture:
    """The mixture in the units of the points."""
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


def from_mixture(mixture: FoldedMixture, scaling: Scaling, degree: int, dtype) -> Parameters:
    """The components of a mixture with polynomial folds of at most this degree."""
    components = mixture.components
    space, time = scaling.scale[:-1], scaling.scale[-1]
    loc, tril, time_loc, time_scale = (
        np.asarray(z, np.float64)
        for z in (components.loc, components.scale_tril, components.time_loc, components.time_scale)
    )
    curve = np.zeros((len(loc), degree + 1, loc.shape[1]))
    curve[:, 0] = (loc - scaling.shift[:-1]) / space
    if isinstance(components.fold, PolynomialFold):
        rows = np.asarray(components.fold.coefficients, np.float64)
        used = rows.shape[1]
        curve[:, 1 : used + 1] = rows * time_scale[:, None, None] ** np.arange(1, used + 1)[None, :, None] / space
    parts = (
        np.asarray(mixture.log_weights, np.float64),
        (time_loc - scaling.shift[-1]) / time,
        time_scale / time,
        curve,
        tril / space[:, None],
    )
    return Parameters(*(jnp.asarray(z, dtype) for z in parts))
