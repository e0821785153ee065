"""The log-posterior density of frame times, as samplers call it, with a Dirichlet prior on the increments."""

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import gammaln

from foldgauss._runtime.checks import is_within, require, short_repr
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves

#: Increments below this fraction are replaced by it before logarithms are taken: float64 does not resolve smaller ones.
LEAST_FRACTION = 1e-16


class FrameTimeLogProb:
    r"""Log-posterior density of the times between the first and the last, up to a constant; batched and compiled.

    $$ \log p(t \mid y) = \sum_k \ell_k(t_k) + \log \mathrm{Dirichlet}(\Delta t) + \text{const} $$

    The first frame is at 0 and the last at 1. Conditioned on: the splats (positions, folds and colors), and the noise.
    `concentration`: of the Dirichlet prior on the increments, at least 1.

    **Shapes:** called with free times (*batch, num_free), gives (*batch); -inf for times that do not increase.
    **Units:** nats. **Source:** VeGaS eq:frame_fitting. **Raises:** ValueError where the density is NaN, and for other
    shapes.
    """

    def __init__(self, curves: ProfileCurves, concentration: float = 1.0):
        check_prior(curves.num_frames, concentration)
        self.curves, self.concentration, self.num_free = curves, float(concentration), curves.num_frames - 2

    def __call__(self, free: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch"]:
        times = self.times(free)
        found = self.log_likelihood(times) + log_prior(times, self.concentration)
        require(
            not np.isnan(found).any(),
            "free",
            expected="times with a log-density",
            got="NaN",
            cure="Check curves and times for NaN.",
        )
        return found

    def times(self, free: Float[np.ndarray, "*batch num_free"]) -> Float64[np.ndarray, "*batch num_frames"]:
        """The times of all frames."""
        free = np.asarray(free, np.float64)
        require(
            free.shape[-1:] == (self.num_free,),
            "free",
            expected=f"shape (..., {self.num_free})",
            got=f"shape {free.shape}",
        )
        return np.pad(free, [*[(0, 0)] * (free.ndim - 1), (1, 1)], constant_values=(0.0, 1.0))

    def log_likelihood(self, times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch"]:
        """Joint log-likelihood of all frames at these times; 0 if every frame is at its mode."""
        return self.curves(times).sum(-1)


def check_prior(num_frames: int, concentration: float) -> None:
    """Raise ValueError for fewer than 3 frames, and a concentration below 1."""
    require(
        num_frames >= 3,
        "curves",
        expected="at least 3 frames",
        got=num_frames,
        cure="The first frame is at time 0 and the last at 1: others are needed.",
    )
    require(
        is_within(concentration, "[1, inf)"),
        "concentration",
        expected="a number >= 1",
        got=short_repr(concentration),
        cure="1 is uniform over all ordered times; larger values favor equal spacing.",
    )


def log_prior(times: Float[np.ndarray, "*batch num_frames"], concentration: float) -> Float64[np.ndarray, "*batch"]:
    """Log-density of the times between 0 and 1, -inf for times that do not increase.

    The increments have a symmetric Dirichlet distribution of `concentration` >= 1; 1 is uniform over all ordered times.
    A flat prior on the model's softmax weights would be improper, since they are invariant to an added constant.

    **Source:** VeGaS eq:frame_fitting.
    """
    alpha, steps = concentration, np.diff(times, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_density = gammaln(alpha * steps.shape[-1]) + ((alpha - 1) * np.log(steps) - gammaln(alpha)).sum(-1)
    return np.where((steps > 0).all(-1), log_density, -np.inf)


def logits_of(times: Float[np.ndarray, "*batch num_frames"]) -> Float64[np.ndarray, "*batch intervals"]:
    """The model's softmax weights w, centered to mean 0, since an added constant has no effect.

    Increments below `LEAST_FRACTION` are replaced by it.
    """
    logs = np.log(np.maximum(np.diff(np.asarray(times, np.float64), axis=-1), LEAST_FRACTION))
    return logs - logs.mean(-1, keepdims=True)
