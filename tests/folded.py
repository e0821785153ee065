"""Folded-Gaussians of up to three space coordinates, and their methods compiled once for each shape."""

import equinox as eqx
import numpy as np

from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood
from foldgauss.fold import PolynomialFold

# Odd and even powers, so that each sign mistake shows.
LOC = np.array([0.1, -0.4, 0.2])
TRIL = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.1, 0.05, 0.25]])
BEND = np.array([[0.8, -0.5, 0.3], [0.6, 0.9, -0.4], [-0.7, 0.4, 0.1]])

# Jitted once: called eagerly, each shape would compile anew.
LOG_PROB = eqx.filter_jit(lambda dist, x: dist.log_prob(x))
SAMPLE = eqx.filter_jit(lambda dist, key, shape: dist.sample(key, shape))
CONDITION_TIME = eqx.filter_jit(lambda dist, t: dist.condition_time(t))


def folded(dim=2, power=1.0, floor=0.0, *, degree=2, **changes):
    parameters = {"loc": LOC[:dim], "time_loc": 0.4, "time_scale": 0.3, "envelope": TimeLikelihood(power, floor)}
    if not {"scale", "precision_matrix", "covariance_matrix"} & set(changes):
        parameters["scale_tril"] = TRIL[:dim, :dim]
    if "fold" not in changes:
        parameters["fold"] = PolynomialFold(BEND[:degree, :dim])
    return FoldedGaussian(**(parameters | changes))
