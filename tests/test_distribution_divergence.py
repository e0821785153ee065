"""The Kullback-Leibler divergence: against samples, scipy-like closed forms, and its infinite cases."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from foldgauss.analysis.divergence import kl_divergence
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import AbstractEnvelope, Constant, TimeLikelihood
from foldgauss.fold import FourierFold, PolynomialFold, SplineFold, ZeroFold
from foldgauss.gaussian import Gaussian

BEND = np.array([[0.8, -0.5], [0.6, 0.9]])
TRIL = np.array([[0.3, 0.0], [0.1, 0.2]])
KL = eqx.filter_jit(kl_divergence)  # seconds to compile for each pair of envelopes, and each shape
SAMPLE = eqx.filter_jit(FoldedGaussian.sample)
LOG_PROB = eqx.filter_jit(FoldedGaussian.log_prob)


class OwnLikelihood(AbstractEnvelope):
    """The time likelihood with power 1 as an envelope of unknown form: only quadrature can know it."""

    def log_a(self, t, *, time_loc, time_scale):
        return -0.5 * ((t - time_loc) / time_scale) ** 2


pytestmark = pytest.mark.usefixtures("x64")


def _dist(power=1.0, floor=0.0, *, time_loc=0.4, time_scale=0.3, bend=BEND, envelope=None, loc=(0.1, -0.4), tril=TRIL):
    return FoldedGaussian(
        np.array(loc),
        tril,
        time_loc=time_loc,
        time_scale=time_scale,
        fold=PolynomialFold(bend),
        envelope=TimeLikelihood(power, floor) if envelope is None else envelope,
    )


def test_divergence_from_itself_is_zero():
    for power, floor in [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (2.0, 0.1)]:
        np.testing.assert_allclose(KL(_dist(power, floor), _dist(power, floor)), 0, atol=1e-12)


@pytest.mark.parametrize(
    "pair",
    [
        pytest.param(
            ({}, {"power": 0.5, "time_loc": 0.5, "time_scale": 0.4, "bend": 1.1 * BEND}), marks=pytest.mark.slow
        ),
        ({"power": 2.0}, {"power": 0.5, "floor": 0.05, "time_loc": 0.5, "time_scale": 0.4, "bend": 1.1 * BEND}),
        pytest.param(({"floor": 0.2}, {"power": 0.5, "time_scale": 0.5, "loc": (0.0, 0.0)}), marks=pytest.mark.slow),
        ({"power": 0.0}, {"power": 0.2, "time_scale": 0.4, "tril": np.diag([0.4, 0.3])}),
        pytest.param(({"envelope": OwnLikelihood()}, {"power": 0.3, "time_scale": 0.4}), marks=pytest.mark.slow),
    ],
)
def test_divergence_is_the_mean_of_the_log_ratio(pair):
    p, q = (_dist(**changes) for changes in pair)
    n = 200_000
    x = SAMPLE(p, jax.random.key(5), (n,))
    ratio = np.asarray(LOG_PROB(p, x)) - np.asarray(LOG_PROB(q, x))
    divergence = KL(p, q)
    error = ratio.std() / np.sqrt(n)
    assert abs(ratio.mean() - divergence) < 5 * error
    assert divergence > 5 * error  # so the test would see a wrong sign, or nothing


def test_exact_and_quadrature_agree():
    q = {"time_loc": 0.5, "time_scale": 0.4, "bend": 1.1 * BEND}
    exact = KL(_dist(), _dist(1.0, **q))
    np.testing.assert_allclose(KL(_dist(), _dist(envelope=OwnLikelihood(), **q)), exact, rtol=1e-9)
    np.testing.assert_allclose(KL(_dist(envelope=OwnLikelihood()), _dist(1.0, **q)), exact, rtol=1e-9)
    np.testing.assert_allclose(KL(_dist(), _dist(1.0, 1e-200, **q)), exact, rtol=1e-9)


@pytest.mark.parametrize(
    ("p", "q", "finite"),
    [
        # The covariance term, finite iff (1 + power_p) scale_q^2 > power_q scale_p^2 (same curves).
        ({"power": 1.0}, {"power": 1.0, "time_scale": 0.22}, True),
        ({"power": 1.0}, {"power": 1.0, "time_scale": 0.21}, False),
        ({"power": 0.0}, {"power": 1.0}, False),
        ({"power": 0.0}, {"power": 0.9}, True),
        # Curves that differ need scale_q^2 > power_q scale_p^2.
        ({"power": 1.0}, {"power": 1.0, "bend": 2 * BEND}, False),
        ({"power": 1.0}, {"power": 0.99, "bend": 2 * BEND}, True),
        ({"power": 1.0}, {"power": 1.0, "loc": (0.2, -0.4), "time_scale": 0.31}, True),
        # A floor in p is a tail of its own; a floor in q makes all finite.
        ({"power": 1.0, "floor": 0.1}, {"power": 1.0}, False),
        ({"power": 0.0}, {"power": 2.0, "floor": 1e-3, "bend": 2 * BEND}, True),
        # The same by quadrature, to which nobody tells the formula.
        ({"power": 0.5}, {"envelope": OwnLikelihood(), "bend": 2 * BEND, "time_scale": 0.2}, False),
        ({"envelope": OwnLikelihood()}, {"power": 1.0, "time_scale": 0.2}, False),
    ],
)
def test_where_it_is_infinite(p, q, finite):
    divergence = KL(_dist(**p), _dist(**q))
    assert np.isfinite(divergence) == finite
    assert finite or np.isposinf(divergence)


def test_same_curve_written_about_another_time_is_the_same_curve():
    # loc + c (m_t - t) with m_t moved by 0.2: the centers agree up to rounding, so only the covariance counts.
    line = BEND * np.array([[1], [0]])
    p = _dist(1.0, bend=line)
    q = _dist(1.0, time_loc=0.6, bend=line, loc=np.array([0.1, -0.4]) - 0.2 * BEND[0])
    assert np.isfinite(KL(p, q))


def test_gaussians():
    rng = np.random.default_rng(1)
    tril_p, tril_q = (np.tril(rng.uniform(0.5, 1, (3, 3))) for _ in range(2))
    loc_p, loc_q = rng.normal(size=(2, 3))
    sigma_p, inverse = tril_p @ tril_p.T * 4, np.linalg.inv(tril_q @ tril_q.T)
    log_det = np.linalg.slogdet(sigma_p @ inverse)[1]
    square = (loc_p - loc_q) @ inverse @ (loc_p - loc_q)
    expected = 0.5 * (np.trace(inverse @ sigma_p) - 3 + square - log_det)
    p, q = Gaussian(loc_p, tril_p, log_scale=np.log(2.0)), Gaussian(loc_q, tril_q)
    np.testing.assert_allclose(KL(p, q), expected, rtol=1e-12)


def test_without_fold_and_envelope_it_is_that_of_gaussians():
    flat = {"fold": ZeroFold(2), "envelope": Constant()}
    p = FoldedGaussian([0.1, 0.2], TRIL, time_loc=0.1, time_scale=0.5, **flat)
    q = FoldedGaussian([0.3, 0.1], 2 * TRIL, time_loc=0.2, time_scale=0.7, **flat)
    parts = KL(p.condition_time(0.0), q.condition_time(0.0)) + KL(p.marginal([-1]), q.marginal([-1]))
    np.testing.assert_allclose(KL(p, q), parts, rtol=1e-12)


def _logistic(u):
    return jax.nn.sigmoid((u - 0.1) / 0.01)[None]


#: Folds of one coordinate, in NumPy, and where they change fast.
CURVES = {
    "polynomial": (lambda: PolynomialFold([[0.5], [0.3]]), lambda u: 0.5 * u + 0.3 * u**2, []),
    "fourier": (
        lambda: FourierFold([[1.0]], [[0.5]], period=0.7),
        lambda u: np.sin(2 * np.pi * u / 0.7) - np.sin(np.pi * u / 0.7) ** 2,
        [],
    ),
    "spline": (
        lambda: SplineFold([-1, -1, 0, 1, 1], [[2.0], [0.0], [1.0]], degree=1),
        lambda u: np.interp(u, [-1, 0, 1], [2, 0, 1]),
        [-1, 0, 1],
    ),
    "callable": (
        lambda: _logistic,
        lambda u: 1 / (1 + np.exp(-np.clip((u - 0.1) / 0.01, -500, 500))),
        [0, 0.05, 0.1, 0.15, 0.2],
    ),
}
#: (power, floor) of p and of q.
POWERS = {
    "constant": ((0, 0), (0, 0)),
    "power": ((1, 0), (0.5, 0)),
    "floor": ((1, 0.1), (1, 0.05)),
    "own": (None, (0.5, 0)),
}
QUICK_PAIRS = {("spline", "callable", "power")}


def _kl_by_quadrature(p, q, powers, scale, sign=1):
    """The chain rule, by Gauss-Legendre in NumPy between all points where a fold is not smooth; q's time is apart."""
    (_, f, breaks_p), (_, g, breaks_q) = CURVES[p], CURVES[q]
    apart, scale_q, tril_p, tril_q = 0.3 * scale, 1.5 * scale, 0.1, 0.2
    edges = np.sort(np.r_[np.linspace(-14, 14, 1601) * scale, -np.array(breaks_p), apart - np.array(breaks_q)])
    y, weights = np.polynomial.legendre.leggauss(20)
    half = np.diff(edges)[:, None] / 2
    t, weights = (edges[:-1, None] + half * (1 + y)).ravel(), (half * weights).ravel()
    weights, inside = weights * stats.norm.pdf(t, 0, scale), abs(t) <= 14 * scale
    t, weights = t[inside], weights[inside]

    def log_a(power, tau):
        power, floor = (1, 0) if power is None else power
        return np.log(floor + (1 - floor) * np.exp(-power * tau**2 / 2))

    log_ratio = log_a(powers[0], t / scale) - (log_q := log_a(powers[1], (t - apart) / scale_q))
    square = ((f(-sign * t) - g(apart - t)) / tril_q) ** 2 * np.exp(-log_q)
    trace = (tril_p / tril_q) ** 2 * np.exp(log_ratio)
    space = 0.5 * (trace - 1 + square - log_ratio) + np.log(tril_q / tril_p)
    time = 0.5 * ((scale**2 + apart**2) / scale_q**2 - 1) + np.log(scale_q / scale)
    return time + weights @ space


def _kl_grid():
    for p, q, powers in itertools.product(CURVES, CURVES, POWERS):
        marks = [] if (p, q, powers) in QUICK_PAIRS else [pytest.mark.slow]
        yield pytest.param(p, q, powers, marks=marks)


@pytest.mark.parametrize(("p", "q", "powers"), [*_kl_grid()])
def test_divergence_of_any_folds_equals_quadrature(p, q, powers):
    scales = np.array([0.03, 0.2, 1.0, 3.0])

    def dist(name, power, time_loc, time_scale, tril):
        envelope = OwnLikelihood() if power is None else TimeLikelihood(*map(float, power))
        parts = {"time_loc": time_loc, "time_scale": time_scale, "fold": CURVES[name][0](), "envelope": envelope}
        return FoldedGaussian([0.0], [[tril]], **parts)

    own, other = POWERS[powers]
    pair = dist(p, own, 0.0, scales, 0.1), dist(q, other, 0.3 * scales, 1.5 * scales, 0.2)
    divergence, error = KL(*pair, with_error=True)
    expected = np.array([_kl_by_quadrature(p, q, POWERS[powers], scale) for scale in scales])
    np.testing.assert_allclose(divergence, expected, rtol=1e-9)
    assert (np.abs(divergence - expected) <= 10 * error + 1e-11 * expected).all()
    assert (error <= 1e-8 * expected).all()
    mirrored = np.array([_kl_by_quadrature(p, q, POWERS[powers], scale, sign=-1) for scale in scales])
    assert (np.abs(mirrored / expected - 1) > 1e-3).any()


@pytest.mark.slow
def test_eager_divergence_and_its_gradient():
    # Eager, it knows that no floor is in q, and integrates nothing.
    value, slope = jax.value_and_grad(lambda scale: kl_divergence(_dist(), _dist(0.3, time_scale=scale)))(0.4)
    low, middle, high = (KL(_dist(), _dist(0.3, time_scale=scale)) for scale in (0.4 - 1e-5, 0.4, 0.4 + 1e-5))
    np.testing.assert_allclose(value, middle, rtol=1e-12)
    np.testing.assert_allclose(slope, (high - low) / 2e-5, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("floors", [[0.0], [0.05], [0.05, 0.0]])
def test_batches_in_float32_agree_with_a_loop_in_float64(floors):
    # Offsets 0 and 1e4, time scales 1e-12, 0.3 and 1e6, time_loc of q a half, 1e3 or 1e10 scales away.
    offset, scale = (x.ravel() for x in np.meshgrid([0.0, 1e4], [1e-12, 0.3, 1e6]))
    apart = np.array([0.5, 1e3, 1e10])[:, None]
    bend = BEND * 0.3 ** np.array([[1], [2]]) / scale[:, None, None] ** np.array([[1], [2]])
    there, power = (offset + apart * scale).astype(np.float32), np.float32(0.5)
    parts = {"bend": bend.astype(np.float32), "loc": np.array([0.1, -0.4], np.float32), "tril": TRIL.astype(np.float32)}
    own, other = np.resize(floors, 6).astype(np.float32), np.resize(floors, (3, 6)).astype(np.float32)
    p = _dist(power, own, time_loc=offset.astype(np.float32), time_scale=scale.astype(np.float32), **parts)
    q = _dist(power, other, time_loc=there, time_scale=(1.5 * scale).astype(np.float32), **parts)
    divergence = KL(p, q)
    assert divergence.dtype == np.float32
    assert divergence.shape == (3, 6)
    # float64 is given float32's numbers: what is compared is the computation.
    at = lambda dist, *index: jax.tree.map(lambda x: np.asarray(x, np.float64)[index], dist)  # noqa: E731
    expected = np.array([[KL(at(p, k), at(q, j, k)) for k in range(6)] for j in range(3)])
    divergence = np.asarray(divergence, float)
    assert not np.isnan(divergence).any()
    finite = np.isfinite(divergence)
    assert finite[0].all()
    assert (expected[~finite] > 1e38).all()
    np.testing.assert_allclose(divergence[finite], expected[finite], rtol=1e-4, atol=1e-5)


def test_gaussians_far_from_time_loc():
    """1 / a is out of range: centers that are equal must not make it NaN."""
    far = _dist().condition_time(0.4 + 60 * 0.3)
    assert kl_divergence(far, far) == 0
    moved = Gaussian(far.loc + 1, far.base_tril, log_scale=far.log_scale)
    assert np.isposinf(kl_divergence(far, moved))


@pytest.mark.parametrize("make", [_dist, lambda: Gaussian(jnp.zeros(3), jnp.eye(3))])
def test_bad_pairs_are_refused(make):
    with pytest.raises(ValueError, match=r"^p, q: expected two distributions of one class and dimension, got "):
        kl_divergence(make(), Gaussian(jnp.zeros(2), jnp.eye(2)))
