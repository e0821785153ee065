"""Moments, entropy, mode, whitening and derivatives of a Folded-Gaussian, against quadrature and its own samples."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folded import BEND, LOC, LOG_PROB, TRIL, folded
from scipy import stats

from foldgauss._numerics.batch import cast
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import AbstractEnvelope, Constant, TimeLikelihood
from foldgauss.fold import FourierFold, PolynomialFold, SharedPathFold, SplineFold, ZeroFold

MOMENTS = eqx.filter_jit(FoldedGaussian.moments)
ENTROPY = eqx.filter_jit(FoldedGaussian.entropy)


class Slope(AbstractEnvelope):
    """An envelope of one's own, log a = -|tau|^3 / 4, known by nothing but its values."""

    def log_a(self, t, *, time_loc, time_scale):
        return -(jnp.abs((t - time_loc) / time_scale) ** 3) / 4


pytestmark = pytest.mark.usefixtures("x64")

_dist = partial(folded, 2, degree=3)


def _book_moments(a, coefficients=BEND[:, :2], scale=0.3):
    """The laws of total mean and covariance, integrated on panels in NumPy; `a` is a function of tau."""
    minus_tau, weights = _normal_rule(1.0, (0,))
    u = scale * minus_tau
    center = LOC[:2] + sum((c * u[:, None] ** (k + 1) for k, c in enumerate(coefficients)), np.zeros((len(u), 2)))
    y = np.c_[center, 0.4 - u]
    mean = weights @ y
    covariance = (weights[:, None] * (y - mean)).T @ (y - mean)
    covariance[:2, :2] += (weights @ a(minus_tau)) * TRIL[:2, :2] @ TRIL[:2, :2].T
    return mean, covariance


# --- moments ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 12])
def test_moments_equal_integrals(degree):
    powers, floors = np.array([0.0, 1.0, 2.0, 1.0]), np.array([0.0, 0.0, 0.1, 0.3])
    coefficients = np.random.default_rng(degree).normal(size=(degree, 2))
    mean, covariance = MOMENTS(_dist(powers, floors, fold=PolynomialFold(coefficients)))
    for i, (power, floor) in enumerate(zip(powers, floors, strict=True)):
        a = partial(lambda power, floor, tau: floor + (1 - floor) * np.exp(-power * tau**2 / 2), power, floor)
        expected = _book_moments(a, coefficients)
        np.testing.assert_allclose(mean[i], expected[0], rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(covariance[i], expected[1], rtol=1e-11, atol=1e-11)


def test_moments_under_an_envelope_of_ones_own_equal_integrals():
    expected = _book_moments(lambda tau: np.exp(-(np.abs(tau) ** 3) / 4))
    for found, exact in zip(MOMENTS(_dist(envelope=Slope())), expected, strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-11)


def _sigmoid(u):
    return 1 / (1 + np.exp(-np.clip((u - 0.1) / 0.01, -500, 500)))


#: Folds of one coordinate, in NumPy, and where they are not smooth.
SHARP = {
    "fourier": (
        lambda: FourierFold([[1.0]], [[0.5]], period=0.7),
        lambda u: np.sin(u / 0.7 * 2 * np.pi) - np.sin(u / 0.7 * np.pi) ** 2,
        (),
    ),
    "spline": (
        lambda: SplineFold([-1, -1, 0, 1, 1], [[2.0], [0.0], [1.0]], degree=1),
        lambda u: np.interp(u, [-1, 0, 1], [2, 0, 1]),
        (-1, 0, 1),
    ),
    "sigmoid": (lambda: lambda u: jax.nn.sigmoid((u - 0.1) / 0.01)[None], _sigmoid, (0.05, 0.1, 0.15)),
    "step": (lambda: lambda u: jnp.where(u > 0.123, 1.0, 0.0)[None], lambda u: (u > 0.123) + 0.0, (0.123,)),
    "path": (
        lambda: SharedPathFold(
            ZeroFold(1),
            [2.0],
            time_loc=0.0,
            index=1,
            times=[[-1.0, 0.3, 0.3, 1.0]],
            matrices=[[[[1.0, 0.0]], [[3.0, 0.0]], [[4.0, 0.0]], [[1.0, 2.0]]]],
        ),
        lambda u: np.interp(-u, [-1, 0.3, np.nextafter(0.3, 1), 1], [2, 6, 8, 4]) - 2 * (1 + 2 / 1.3),
        (-1, -0.3, 1),
    ),
}


def _normal_rule(scale, breaks):
    """u and weights of a normal density: Gauss-Legendre on many panels, also between the points given."""
    inside = [u for u in breaks if abs(u) < 12 * scale]
    edges = np.unique(np.r_[np.linspace(-12, 12, 1201) * scale, inside])
    y, weights = np.polynomial.legendre.leggauss(20)
    half = np.diff(edges)[:, None] / 2
    u = (edges[:-1, None] + half * (1 + y)).ravel()
    return u, (half * weights).ravel() * stats.norm.pdf(u, 0, scale)


#: As "step", which is less smooth.
LONG = {"sigmoid"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in SHARP]
)
def test_moments_of_folds_that_are_no_polynomials_equal_quadrature(name):
    fold, values, breaks = SHARP[name]
    scales = np.array([0.03, 0.3, 1.0, 5.0])
    dist = FoldedGaussian([0.0], [[0.1]], time_loc=0.0, time_scale=scales, fold=fold(), envelope=Constant())
    mean, covariance, error = MOMENTS(dist, with_error=True)
    for k, scale in enumerate(scales):
        u, weights = _normal_rule(scale, breaks)
        f = values(u)
        first, cross = weights @ f, -weights @ (u * f)
        variance = weights @ (f - first) ** 2
        off = np.abs([mean[k, 0] - first, covariance[k, 0, 0] - 0.01 - variance, covariance[k, 0, 1] - cross])
        unit = np.sqrt(variance + 0.01)
        assert (off / [unit, unit**2, scale * unit]).max() < max(2 * error[k], 1e-11)
        assert error[k] < (1e-7 if name == "step" else 1e-11)
    assert np.abs(covariance[:, 0, 1]).max() > 1e-3  # the sign of the fold shows


def test_an_estimated_error_above_the_tolerance_warns():
    fast = _dist(fold=lambda u: jnp.stack([jnp.sin(2000 * u), u]))
    with pytest.warns(RuntimeWarning, match="quadrature of moments has an estimated error"):
        _, covariance, error = fast.moments(with_error=True)
    off = abs(covariance[0, 0] - MOMENTS(_dist(fold=ZeroFold(2)))[1][0, 0] - 0.5)
    assert 1e-5 < off < error


def test_derivatives_of_moments_pass_through_functions_that_close_over_them():
    variance = lambda w: _dist(fold=lambda u: jnp.stack([jnp.tanh(w * u), u])).moments()[1][0, 0]  # noqa: E731
    at = jnp.array([1.0, 2.0, 1.0 + 1e-5, 2 + 1e-5, 1.0 - 1e-5, 2 - 1e-5])
    moved, slope = jax.jit(jax.vmap(jax.value_and_grad(variance)))(at)
    np.testing.assert_allclose(slope[:2], (moved[2:4] - moved[4:]) / 2e-5, rtol=1e-7)


@pytest.mark.parametrize(
    ("degree", "time_scale"),
    [(30, 100.0), *(pytest.param(*case, marks=pytest.mark.slow) for case in [(7, 4e5), (8, 8e4), (10, 8e3)])],
)
def test_powers_of_time_scale_do_not_overflow(degree, time_scale):
    coefficients = np.zeros((degree, 2), np.float32)
    coefficients[0], coefficients[2] = 1e-5, 1e-17

    def quantities(dtype):
        dist = _dist(
            fold=PolynomialFold(coefficients.astype(dtype)), time_scale=dtype(time_scale), loc=LOC[:2].astype(dtype)
        )
        return [np.asarray(x) for x in cast(dist, dtype).moments()]

    for a, b in zip(quantities(np.float32), quantities(np.float64), strict=True):
        assert a.dtype == np.float32
        np.testing.assert_allclose(a, b, rtol=2e-6)
    dist = cast(_dist(fold=PolynomialFold(coefficients), time_scale=time_scale), np.float32)
    slope = jax.jit(jax.grad(lambda dist: dist.variance[0]))(dist)
    assert np.isfinite(slope.time_scale)


def test_coefficients_that_jax_takes_as_zero_warn():
    with pytest.warns(RuntimeWarning, match="coefficients below 1.2e-38, the smallest normal float32, count as 0"):
        fold = PolynomialFold(np.array([[1.0], [1e-40]], np.float32))
    dist = FoldedGaussian([np.float32(0)], [[1.0]], time_loc=0.0, time_scale=np.float32(1e19), fold=fold)
    np.testing.assert_allclose(dist.mean, 0)  # as the density has it


@pytest.mark.parametrize("time_scale", [1e-12, pytest.param(0.3, marks=pytest.mark.slow), 1e6])
def test_moments_and_entropy_in_float32(time_scale):
    # Offsets 1e4 and the folds' coefficients scaled with time: the same numbers in float64, to float32's digits.
    def quantities(dtype):
        fold = PolynomialFold(
            (BEND[:, :2] * 0.3 ** np.arange(1, 4)[:, None] / time_scale ** np.arange(1, 4)[:, None]).astype(dtype)
        )
        powers, floors = jnp.asarray([0.0, 0.9, 0.5, 1.0], dtype), jnp.asarray([0.0, 0.0, 0.1, 0.3], dtype)
        dist = FoldedGaussian(
            (LOC[:2] + 1e4).astype(dtype),
            TRIL[:2, :2].astype(dtype),
            time_loc=dtype(1e4),
            time_scale=dtype(time_scale),
            fold=fold,
            envelope=TimeLikelihood(powers, floors),
        )
        mean, covariance = MOMENTS(dist)
        unit = np.r_[1.0, 1.0, time_scale]
        entropy = ENTROPY(dist)
        assert mean.dtype == covariance.dtype == entropy.dtype == dtype
        scaled = np.asarray(covariance, float) / unit / unit[:, None]
        return np.asarray(mean, float), scaled, np.asarray(entropy, float), np.asarray(dist.mode, float)

    for a, b in zip(quantities(np.float32), quantities(np.float64), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-6)


# --- entropy and mode -------------------------------------------------------------------------------------

#: One space coordinate has a mode at the paper's power.
LINE = {"loc": LOC[:1], "scale_tril": TRIL[:1, :1], "fold": PolynomialFold(BEND[:, :1])}


def test_entropy_is_exact_and_does_not_see_the_fold():
    gaussian = stats.multivariate_normal(cov=TRIL[:2, :2] @ TRIL[:2, :2].T).entropy() + stats.norm(0.4, 0.3).entropy()
    powers = np.array([0.0, 1.0, 2.0])
    np.testing.assert_allclose(ENTROPY(_dist(powers)), gaussian - powers * 2 / 4, rtol=1e-13)
    np.testing.assert_allclose(ENTROPY(_dist(powers, fold=ZeroFold(2))), gaussian - powers * 2 / 4, rtol=1e-13)
    np.testing.assert_allclose(ENTROPY(_dist(envelope=Constant())), gaussian, rtol=1e-13)


def test_entropy_with_a_floor_or_an_own_envelope_is_a_quadrature():
    tau = np.linspace(-12, 12, 200_001)
    weights = np.exp(-(tau**2) / 2) / np.sqrt(2 * np.pi) * (tau[1] - tau[0])
    base = ENTROPY(_dist(0.0))
    for floor in (1e-12, 1e-3, 0.4):
        log_a = np.log(floor + (1 - floor) * np.exp(-(tau**2)))
        np.testing.assert_allclose(ENTROPY(_dist(2.0, floor)), base + weights @ log_a, rtol=1e-10)
    expected = base + weights @ (-(np.abs(tau) ** 3) / 4)
    np.testing.assert_allclose(ENTROPY(_dist(envelope=Slope())), expected, rtol=1e-8)


@pytest.mark.parametrize("changes", [{"power": 0.9}, {"power": 0.0}, {"envelope": Constant()}, {"floor": 0.1}, LINE])
def test_mode_is_the_highest_point(changes):
    dist = _dist(**changes)
    mode = np.append(dist.loc, 0.4)
    np.testing.assert_allclose(dist.mode, mode)
    away = np.random.default_rng(0).normal(size=(500, len(mode)))
    top, *others = np.asarray(LOG_PROB(dist, mode + 0.02 * np.r_[np.zeros((1, len(mode))), away]))
    assert (np.array(others) < top).all()


@pytest.mark.parametrize(
    ("power", "floor", "case"),
    [(1.0, 0.0, "every point of the ridge"), (2.0, 0.0, "unbounded"), (2.0, 0.1, "two modes")],
)
def test_no_unique_mode_is_an_error_that_says_why(power, floor, case):
    with pytest.raises(ValueError, match=f"^mode: expected a unique mode.*got .*{case}"):
        _ = _dist(power, floor).mode
    assert np.isnan(jax.jit(lambda d: d.mode)(_dist(power, floor))).all()


def test_mode_under_an_envelope_of_ones_own():
    class Gentle(Slope):
        def log_a(self, t, *, time_loc, time_scale):
            tau = (t - time_loc) / time_scale
            return -0.2 * jnp.abs(tau) - 0.1 * (1 + jnp.sin(tau))  # highest away from time_loc

    dist = _dist(envelope=Gentle())
    at = lambda t: dist.log_prob(jnp.concatenate([dist.condition_time(t).loc, t[..., None]], axis=-1))  # noqa: E731
    t = np.linspace(-1.0, 2.0, 30_001)
    np.testing.assert_allclose(dist.mode[2], t[np.argmax(jax.jit(at)(t))], atol=1e-4)
    with pytest.raises(ValueError, match=r"^mode: expected a unique mode"):
        _ = _dist(envelope=Slope()).mode


# --- points of a standard normal ----------------------------------------------------------------------------


def test_normal_points_are_transformed_with_their_density():
    dist = _dist(power=jnp.array([0.0, 1.0, 2.0]), floor=0.01)
    z = np.random.default_rng(0).normal(size=(40, 3, 3))
    jacobian = jax.jit(jax.vmap(lambda z: jnp.einsum("kabkc->kac", jax.jacfwd(dist.normal_to_fold)(z)[:, :, None])))
    x, log_det = dist.normal_to_fold(z), np.linalg.slogdet(jacobian(z))[1]
    standard = -0.5 * (z**2).sum(-1) - 1.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(LOG_PROB(dist, x), standard - log_det, rtol=1e-11)
    np.testing.assert_allclose(x[..., 2], 0.4 + 0.3 * z[..., 2], rtol=1e-14)


# --- doors ------------------------------------------------------------------------------------------------


def test_sigma_may_be_given_four_ways():
    sigma = TRIL[:2, :2] @ TRIL[:2, :2].T
    dense = [_dist(covariance_matrix=sigma), _dist(precision_matrix=np.linalg.inv(sigma))]
    for dist in dense:
        np.testing.assert_allclose(dist.scale_tril, TRIL[:2, :2], rtol=1e-12, atol=1e-13)
    scales = np.array([[0.3, 0.2], [1.0, 2.0]])
    np.testing.assert_allclose(_dist(scale=scales).scale_tril[1], np.diag([1.0, 2.0]))
    assert _dist(scale=scales).batch_shape == (2,)
