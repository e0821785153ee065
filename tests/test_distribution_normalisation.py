"""Densities integrate to one in three and four dimensions, and so does the volume they are judged by.

Two dimensions by quadrature, scipy's multivariate normal, and samples are in test_distribution.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood
from foldgauss.fold import FourierFold, PolynomialFold, SplineFold

WIDER = 1.3  # the proposal's scale: its tails must not be lighter than the density's


@pytest.fixture(scope="module")
def normals():
    uniform = stats.qmc.Sobol(4, seed=0).random_base2(14)
    return stats.norm.ppf(np.clip(uniform, 1e-12, 1 - 1e-12))


def _dist(dim, fold, power=1.0):
    tril = np.tril(np.random.default_rng(dim).uniform(0.2, 0.5, (dim, dim)))
    loc = jnp.linspace(0.1, -0.4, dim)
    return FoldedGaussian(loc, tril, time_loc=0.4, time_scale=0.3, fold=fold, envelope=TimeLikelihood(power))


def _mass(log_prob, dist, normals):
    """Importance sampling around the ridge, with a proposal WIDER than the density in every coordinate."""
    z = WIDER * normals[:, : dist.event_shape[0]]
    t = 0.4 + 0.3 * z[:, -1]
    width = np.exp(-np.asarray(dist.envelope.power) * z[:, -1] ** 2 / 4)[:, None]
    s = np.asarray(dist.loc) + np.asarray(dist.fold(0.4 - t)) + width * (z[:, :-1] @ np.asarray(dist.scale_tril).T)
    proposal = stats.norm.logpdf(z, scale=WIDER).sum(-1) - np.log(width[:, 0]) * (z.shape[-1] - 1)
    proposal = proposal - np.log(np.diagonal(dist.scale_tril)).sum() - np.log(0.3)
    return float(np.exp(np.asarray(log_prob(dist, np.c_[s, t])) - proposal).mean())


FOLDS = {
    "cubic": lambda dim: PolynomialFold(np.random.default_rng(1).normal(size=(3, dim))),
    "spline": lambda dim: SplineFold(np.linspace(-2, 2, 9), np.random.default_rng(2).normal(size=(5, dim))),
    "fourier": lambda dim: FourierFold(*np.random.default_rng(3).normal(size=(2, 2, dim)), period=1.0),
}


@pytest.mark.parametrize(("dim", "power", "fold"), [(2, 1.0, "spline"), (3, 2.0, "fourier"), (3, 1.0, "cubic")])
def test_density_integrates_to_one(dim, power, fold, normals):
    with jax.enable_x64(True):
        dist = _dist(dim, FOLDS[fold](dim), power)
        log_prob = jax.jit(lambda dist, x: dist.log_prob(x))
        assert abs(_mass(log_prob, dist, normals) - 1) < 1e-3
        # Power: a density whose determinant forgets a tenth of the envelope is seen.
        log_a = lambda t: -power * ((t - 0.4) / 0.3) ** 2 / 2  # noqa: E731
        forgets = lambda dist, x: log_prob(dist, x) + 0.05 * dim * log_a(x[:, -1])  # noqa: E731
        assert abs(_mass(forgets, dist, normals) - 1) > 1e-2


@pytest.mark.parametrize("dim", [2, 4])
def test_ball_has_its_volume(dim, normals):
    # log N(x) = log N(0) - r^2/2: the share of standard normals with a density above that at r = 1.5, against the
    # chi-square law, whose surface factor is the n-ball's.
    with jax.enable_x64(True):
        eye = np.eye(dim - 1)
        dist = FoldedGaussian(np.zeros(dim - 1), eye, time_loc=0.0, time_scale=1.0, envelope=TimeLikelihood(0.0))
        x = 1.5 * (2 * special.ndtr(normals[:, :dim]) - 1)  # uniform in the cube around the ball
        log_prob = np.asarray(jax.jit(lambda x: dist.log_prob(x))(x))
        edge = stats.norm.logpdf([1.5] + [0.0] * (dim - 1)).sum()
        volume = 3.0**dim * (log_prob >= edge).mean()
        np.testing.assert_allclose(volume, np.pi ** (dim / 2) / special.gamma(dim / 2 + 1) * 1.5**dim, rtol=1e-2)
