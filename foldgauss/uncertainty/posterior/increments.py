"""The prior of frame times: a Dirichlet distribution of the increments between them."""

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import gammaln

from foldgauss._runtime.checks import is_within, require, short_repr

#: Increments below this fraction are replaced by it before logarithms are taken: float64 does not resolve smaller ones.
LEAST_FRACTION = 1e-16


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
