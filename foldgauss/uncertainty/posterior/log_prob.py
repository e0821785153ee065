"""The log-posterior density of frame times, as samplers call it."""

import numpy as np
from jaxtyping import Float, Float64

from foldgauss._runtime.checks import require
from foldgauss.uncertainty.likelihood.profile_curves import ProfileCurves
from foldgauss.uncertainty.posterior.increments import check_prior, log_prior


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
