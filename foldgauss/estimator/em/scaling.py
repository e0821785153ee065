"""Centering and scaling of points for fitting, and conversion of components back to the units of the points."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import require
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import AbstractEnvelope, Constant, TimeLikelihood
from foldgauss.estimator.em.components import Parameters
from foldgauss.fold import PolynomialFold
from foldgauss.mixture import FoldedMixture

#: Spacings of floating-point times up to this fraction of a spread are harmless.
_MAX_SPACING = 0.01
_COARSE_CURE = "Subtract an offset from the time column, or enable float64: jax.config.update('jax_enable_x64', True)."


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


def check_time_resolution(name: str, x, dtype) -> None:
    """Raise if `dtype`, to which JAX converts these rows (n, d), holds their times too coarsely."""
    if not isinstance(x, np.ndarray) or x.dtype == dtype or x.ndim != 2 or not x.size:
        return
    t = x[np.isfinite(x[:, -1]), -1].astype(np.float64)
    require(
        not len(t) or not np.spacing(np.abs(t).max().astype(dtype)) > _MAX_SPACING * t.std() > 0,
        name,
        expected=f"times that {np.dtype(dtype).name} resolves",
        got=f"times from {t.min(initial=np.inf):.10g} to {t.max(initial=-np.inf):.10g}",
        cure=_COARSE_CURE,
    )


def check_export(params: Parameters, scaling: Scaling, dtype, origin: float | None) -> None:
    """Raise if `to_mixture` in this dtype would be wrong: its times too coarse, or powers of them out of range.

    The cure names `time_origin` unless `origin` is None.
    """
    _, time_loc, time_scale, curve, tril = (np.asarray(z, np.float64) for z in params)
    times, spread = scaling.shift[-1] + scaling.scale[-1] * time_loc, scaling.scale[-1] * time_scale
    step = np.spacing((np.abs(times - (origin or 0)) + 3 * spread).astype(dtype)).astype(np.float64) / spread
    speed = np.abs(curve[:, 1:2]).sum(1) / np.sqrt((tril**2).sum(-1))
    worst = float((step * np.maximum(1, speed.max(1, initial=0))).max())
    cure = "" if origin is None else f"Pass time_origin={times.mean():.0f}, from which times are then counted. "
    require(
        not worst > _MAX_SPACING,
        "times",
        expected="a dtype that resolves them",
        got=f"{np.dtype(dtype).name}, whose adjacent times differ by {worst:.2g} of a component's spread",
        cure=cure + _COARSE_CURE,
    )
    require(
        not (params.degree + 1) * np.abs(np.log(spread)).max() > np.log(float(np.finfo(dtype).max)),
        "times",
        expected="units near their spread",
        got=f"spreads of time up to {spread.max():.2g} at degree {params.degree}, out of range of {np.dtype(dtype)}",
        cure="Divide the time column, or use float64.",
    )


def from_mixture(mixture: FoldedMixture, scaling: Scaling, degree: int, dtype) -> Parameters:
    """The inverse of `to_mixture`, with 0 for powers up to `degree` that the folds do not have."""
    of = mixture.components
    parts = (of.loc, of.scale_tril, of.time_loc, of.time_scale, of.fold.coefficients)
    loc, tril, time_loc, time_scale, coefficients = (np.asarray(z, np.float64) for z in parts)
    space, time = scaling.scale[:-1], scaling.scale[-1]
    curve = np.zeros((len(loc), degree + 1, len(space)))
    curve[:, 0] = (loc - scaling.shift[:-1]) / space
    powers = time_scale[:, None, None] ** np.arange(1, of.fold.degree + 1)[None, :, None]
    curve[:, 1 : of.fold.degree + 1] = coefficients * powers / space
    times = (time_loc - scaling.shift[-1]) / time, time_scale / time
    parts = (jax.nn.log_softmax(jnp.asarray(mixture.logits, dtype)), *times, curve, tril / space[:, None])
    return Parameters(*(jnp.asarray(z, dtype) for z in parts))


def to_mixture(params: Parameters, scaling: Scaling, envelope: AbstractEnvelope, origin: float = 0.0) -> FoldedMixture:
    """Convert components to a mixture in the units of the points, with times counted from `origin`."""
    dtype = params.curve.dtype
    log_weights, time_loc, time_scale, curve, tril = (np.asarray(z, np.float64) for z in params)
    space, time = scaling.scale[:-1], scaling.scale[-1]
    time_scale = time * time_scale
    degree = params.degree
    coefficients = curve[:, 1:] * space / time_scale[:, None, None] ** np.arange(1, degree + 1)[None, :, None]
    components = FoldedGaussian(
        jnp.asarray(scaling.shift[:-1] + space * curve[:, 0], dtype),
        jnp.asarray(space[:, None] * tril, dtype),
        time_loc=jnp.asarray(scaling.shift[-1] - origin + time * time_loc, dtype),
        time_scale=jnp.asarray(time_scale, dtype),
        fold=PolynomialFold(jnp.asarray(coefficients, dtype)),
        envelope=envelope,
        validate_args=False,
    )
    return FoldedMixture(components, logits=jnp.asarray(log_weights, dtype))
