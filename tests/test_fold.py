"""Folds: against NumPy's polynomials, their batches, and what they refuse."""

import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float
from scipy.interpolate import BSpline

from foldgauss._numerics.piecewise import locate
from foldgauss.distribution import FoldedGaussian
from foldgauss.fold import (
    AbstractFold,
    CallableFold,
    FourierFold,
    PolynomialFold,
    SharedPathFold,
    SplineFold,
    ZeroFold,
    as_fold,
)
from foldgauss.mixture import FoldedMixture

#: Jitted once: called eagerly, each operation would be compiled alone.
APPLY = eqx.filter_jit(lambda fold, u: fold(u))


def _wave(u):
    return jnp.stack([jnp.sin(u), u**2])


class _Line(eqx.Module):
    slope: jax.Array

    def __call__(self, u):
        return self.slope * u


KNOTS = [-1.0, -1.0, -1.0, -1.0, 0.2, 1.0, 1.0, 1.0, 1.0]
PATHS = {
    "times": np.array([[-0.5, 0.1, 0.6], [0.2, 0.2, 0.9]]),
    "matrices": np.eye(2, 3) + 0.3 * np.random.default_rng(2).normal(size=(2, 3, 2, 3)),
}
MOVES = [[[[1.0, 0.0]], [[3.0, 0.0]]]]
FOLDS = {
    "zero": lambda: ZeroFold(2),
    "degree 0": lambda: PolynomialFold(jnp.zeros((0, 2))),
    "cubic": lambda: PolynomialFold([[1.0, -2.0], [0.5, 0.25], [0.1, 3.0]]),
    "spline": lambda: SplineFold(KNOTS, np.arange(10.0).reshape(5, 2) ** 1.5),  # of degree 3
    "steps": lambda: SplineFold([-1.0, 0.0, 0.5], [[1.0, 2.0], [3.0, -1.0]], degree=0),
    "fourier": lambda: FourierFold([[1.0, -2.0], [0.5, 0.25]], [[0.3, 1.0], [0.0, -1.0]], period=1.7),
    "path": lambda: SharedPathFold(FOLDS["cubic"](), [0.3, -1.0], time_loc=0.25, index=2, **PATHS),
    "no path": lambda: SharedPathFold(ZeroFold(2), [0.3, -1.0], time_loc=0.25, index=0, **PATHS),
    "function": lambda: CallableFold(_wave),
    "pytree": lambda: CallableFold(_Line(jnp.array([1.0, 2.0]))),
}


@pytest.fixture(params=FOLDS)
def fold(request):
    return FOLDS[request.param]()


@settings(max_examples=15, deadline=None)
@given(degree=st.sampled_from([0, 1, 5, 12]), dim=st.sampled_from([1, 3]), seed=st.integers(0, 2**20))
def test_polynomial_equals_numpy_and_has_no_constant_term(degree, dim, seed):
    rng = np.random.default_rng(seed)
    coefficients, u = rng.normal(size=(degree, dim)), rng.uniform(-2, 2, size=7)
    with jax.enable_x64(True):
        fold = PolynomialFold(coefficients)
        expected = np.polynomial.polynomial.polyval(u, np.vstack([np.zeros((1, dim)), coefficients])).T
        values = APPLY(fold, np.append(u, 0.0))
        np.testing.assert_allclose(values[:-1], expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(values[-1], np.zeros(dim))


def test_every_fold_maps_batches_like_a_loop(fold):
    u = np.linspace(-1.0, 1.0, 6, dtype=np.float32).reshape(3, 2)
    assert isinstance(fold, AbstractFold)
    together = APPLY(fold, u)
    assert together.shape == (3, 2, 2)
    np.testing.assert_allclose(together, [[APPLY(fold, v) for v in row] for row in u], atol=1e-7)
    assert jax.eval_shape(fold, jnp.zeros((0,))).shape == (0, 2)


def test_every_fold_round_trips(fold):
    u = np.linspace(-1.0, 1.0, 6, dtype=np.float32).reshape(3, 2)
    flat, treedef = jax.tree.flatten(fold)
    np.testing.assert_array_equal(APPLY(jax.tree.unflatten(treedef, flat), u), APPLY(fold, u))
    np.testing.assert_array_equal(APPLY(pickle.loads(pickle.dumps(fold)), u), APPLY(fold, u))
    jax.tree.unflatten(treedef, [object()] * len(flat))  # as vmap and friends do


@pytest.mark.parametrize(
    ("knots", "degree"),
    [(KNOTS, 3), (np.arange(8.0) - 3.5, 2), ([0.0, 0.0, 0.5, 0.5, 1.0, 1.0], 1), ([-1.0, 0.0, 0.3, 1.0], 0)],
)
def test_spline_equals_scipy_and_is_held_outside(x64, knots, degree):
    rows = np.random.default_rng(degree).normal(size=(len(knots) - degree - 1, 2))
    domain = knots[degree], knots[len(rows)]
    u = np.r_[np.linspace(*domain, 41), np.sort(knots)[degree : len(rows) + 1], -1e30, 1e30]
    fold = SplineFold(knots, rows, degree=degree)
    both = jax.jit(lambda fold, u: (fold(u), jax.jacfwd(lambda v: fold(v))(u[7]), fold(jnp.nan)))
    got, slope, nan = both(fold, jnp.asarray(u))
    spline = BSpline(np.asarray(knots, float), rows, degree)
    np.testing.assert_allclose(got, spline(np.clip(u, *domain)), rtol=1e-12, atol=1e-12)
    if degree:
        np.testing.assert_allclose(slope, spline(u[7], nu=1), rtol=1e-10)
    assert np.isnan(nan).all()


@pytest.mark.parametrize(("knots", "degree"), [([-1, 0, 1, 1], 0), ([0, 0, 1, 1, 2], 1)])
def test_a_spline_that_jumps_at_the_end_of_its_domain_keeps_the_value_before(knots, degree):
    fold = SplineFold(knots, [[1.0], [2.0], [3.0]], degree=degree)
    np.testing.assert_allclose(fold(jnp.array([0.9999999, 1.0, 5.0])), [[2.0]] * 3, rtol=1e-6)


def test_fourier_is_its_series_and_stays_finite_far_away():
    rng = np.random.default_rng(0)
    sine, cosine = rng.normal(size=(2, 3, 2))
    u, k = rng.uniform(-3, 3, 20), np.arange(1, 4)
    phase = 2 * np.pi * k * u[:, None] / 1.7
    with jax.enable_x64(True):
        fold = FourierFold(sine, cosine, period=1.7)
        values = APPLY(fold, np.append(u, 0.0))
        expected = np.sin(phase) @ sine + (np.cos(phase) - 1) @ cosine
        np.testing.assert_allclose(values[:-1], expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(values[-1], [0, 0])
        # cos - 1 to full accuracy where the plain form gives 0
        tiny = APPLY(FourierFold(np.zeros((1, 1)), np.ones((1, 1)), period=2 * np.pi), np.array(1e-12))
        np.testing.assert_allclose(tiny, [-0.5e-24], rtol=1e-12)
    far = FourierFold([[1.0]], [[1.0]], period=1e-15)  # its square is still representable
    both = jax.vmap(jax.value_and_grad(lambda f, u: f(u).sum(), argnums=(0, 1)), in_axes=(None, 0))
    values, grads = jax.jit(both)(far, jnp.array([1e30, -3e38, 1e10, 0.0, far.period / jnp.finfo(jnp.float32).eps]))
    np.testing.assert_array_equal(values, np.zeros(5))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((values, grads)))
    assert np.isnan(APPLY(far, np.array(np.nan, np.float32))).all()


BATCHES = {
    "polynomial": lambda rng, batch: PolynomialFold(rng.normal(size=(*batch, 3, 2))),
    "spline": lambda rng, batch: SplineFold([0.0, 0.0, 1.0, 1.0], rng.normal(size=(*batch, 2, 2)), degree=1),
    "fourier": lambda rng, batch: FourierFold(*rng.normal(size=(2, *batch, 1, 2)), period=rng.uniform(1, 2, batch)),
    "period": lambda rng, batch: FourierFold(*np.ones((2, 1, 2)), period=rng.uniform(1, 2, batch)),
}


@pytest.mark.parametrize(("leading", "shape"), [((), (4,)), ((5,), ()), ((5,), (5,)), ((5, 1), (3,)), ((3,), (5, 1))])
@pytest.mark.parametrize("kind", BATCHES)
def test_batches_of_folds_broadcast(kind, leading, shape):
    rng, batch = np.random.default_rng(0), np.broadcast_shapes(leading, shape)
    fold, u = BATCHES[kind](rng, leading), rng.uniform(size=shape).astype(np.float32)
    got = np.asarray(APPLY(fold, u))
    assert got.shape == (*batch, 2)
    ranks = zip(jax.tree.leaves(fold), fold.leaf_ranks, strict=True)
    each = [np.broadcast_to(leaf, batch + leaf.shape[leaf.ndim - rank :]) for leaf, rank in ranks]
    for index in np.ndindex(batch):
        one = jax.tree.unflatten(jax.tree.structure(fold), [leaf[index] for leaf in each])
        np.testing.assert_allclose(got[index], APPLY(one, np.broadcast_to(u, batch)[index]), atol=1e-5)


def test_vmapped_callable_knows_where_its_batch_begins():
    slopes = jnp.arange(6.0).reshape(3, 2)
    folds = jax.vmap(lambda slope: CallableFold(_Line(slope)))(slopes)
    u = jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(folds(u), slopes * u[:, None])
    np.testing.assert_allclose(folds(jnp.array(2.0)), slopes * 2)
    np.testing.assert_allclose(jax.vmap(lambda fold, v: fold(v))(folds, u), slopes * u[:, None])


def test_gradient_reaches_the_parameters_of_a_callable():
    grad = jax.grad(lambda fold: fold(jnp.array([2.0, 3.0])).sum())(CallableFold(_Line(jnp.ones(2))))
    np.testing.assert_allclose(grad.parameters.slope, [5.0, 5.0])


def test_as_fold_wraps_only_what_is_no_fold(fold):
    assert as_fold(fold) is fold
    assert isinstance(as_fold(_wave), CallableFold)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: PolynomialFold([1.0, 2.0]), "coefficients"),
        (lambda: PolynomialFold(jnp.zeros((3, 0))), "coefficients"),
        (lambda: PolynomialFold(jnp.zeros((4, 2, 0))), "coefficients"),
        (lambda: ZeroFold(0), "dim"),
        (lambda: SplineFold([0, 1, 2], [[1.0], [2.0]], degree=1), "knots"),
        (lambda: SplineFold([0, 2, 1, 3], [[1.0], [2.0]], degree=1), "knots"),
        (lambda: SplineFold([0, 1, 1, 3], [[1.0], [2.0]], degree=1), "knots"),
        (lambda: SplineFold([0, 1, 0.5, 2, 3], [[1.0], [2.0], [3.0]], degree=1), "knots"),
        (lambda: SplineFold([0, 1, 2, 3], [[1.0], [2.0]], degree=-1), "degree"),
        (lambda: SplineFold([0, 1], [1.0], degree=0), "coefficients"),
        (lambda: FourierFold([1.0], [[1.0]], period=1.0), "sine"),
        (lambda: FourierFold([[1.0]], [[1.0], [2.0]], period=1.0), "cosine"),
        (lambda: FourierFold([[1.0]], [[1.0]], period=0.0), "period"),
        (lambda: ZeroFold(1.5), "dim"),
        (lambda: SharedPathFold(ZeroFold(2), 0.3, time_loc=0.0, index=1, **PATHS), "times, matrices"),
        (lambda: SharedPathFold(ZeroFold(3), jnp.ones(3), time_loc=0.0, index=1, **PATHS), "times, matrices"),
        (lambda: SharedPathFold(ZeroFold(2), jnp.ones(2), time_loc=0.0, index=3, **PATHS), "index"),
        (lambda: SharedPathFold(ZeroFold(2), jnp.ones(2), time_loc=0.0, index=-1, **PATHS), "index"),
        (lambda: SharedPathFold(ZeroFold(1), [1.0], time_loc=0, index=1, times=[[1, 0]], matrices=MOVES), "times"),
        (lambda: as_fold(3.0), "fold"),
        (lambda: CallableFold(3.0), "function"),
    ],
)
def test_bad_input_names_the_parameter(make, name):
    with pytest.raises(ValueError, match=f"^{name}: expected .*, got "):
        make()


def test_integers_become_floats():
    assert PolynomialFold([[1], [2]]).coefficients.dtype == jnp.float32
    wave = FourierFold([[1.0]], [[0.5]], period=4.0)
    np.testing.assert_array_equal(wave(1), wave(1.0))


def test_points_of_higher_precision_decide_the_dtype(fold):
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        assert jax.eval_shape(fold, jax.ShapeDtypeStruct((), jnp.float64)).dtype == jnp.float64


def test_coefficients_below_the_smallest_normal_number_warn():
    tiny = np.finfo(np.float32).tiny
    PolynomialFold(np.float32([[0.0], [1.0], [tiny]]))  # warnings are errors
    with pytest.warns(RuntimeWarning, match="coefficients below 1.2e-38, the smallest normal float32, count as 0"):
        PolynomialFold(np.float32([[1.0], [tiny / 2]]))


@pytest.mark.parametrize("kind", ["zero", "cubic"])
def test_some_coordinates_of_a_fold_are_of_its_class(kind):
    """For these classes moments are exact."""
    fold, u = FOLDS[kind](), np.float32([-0.5, 2.0])
    kept = FoldedGaussian(np.zeros(2), np.eye(2), time_loc=0.0, time_scale=1.0, fold=fold).marginal([1, -1]).fold
    assert type(kept) is type(fold)
    np.testing.assert_array_equal(APPLY(kept, u), APPLY(fold, u)[:, 1:])


def test_numpy_integers_are_integers():
    assert ZeroFold(np.int64(2)).dim == 2
    assert SplineFold(KNOTS, np.ones((5, 2)), degree=np.int64(3)).degree == 3


def test_ranks_of_leaves_follow_from_annotations():
    class Own(AbstractFold):
        way: Float[Array, "*batch d-1"]
        width: Float[Array, "*#batch"] | None
        label: str = eqx.field(static=True)
        inner: AbstractFold

        def __call__(self, u):
            return u[..., None] * self.way + self.inner(u)

    inner = FourierFold(jnp.ones((3, 2)), jnp.ones((3, 2)), period=1.0)
    own = Own(jnp.ones(2), None, "name", inner)
    assert own.leaf_ranks == (1, 2, 2, 0)
    assert Own(jnp.ones(2), jnp.ones(()), "name", inner).leaf_ranks == (1, 0, 2, 2, 0)
    dist = FoldedGaussian(jnp.zeros((4, 2)), jnp.eye(2), time_loc=jnp.zeros((5, 1)), time_scale=1.0, fold=own)
    assert dist.batch_shape == (5, 4)
    assert jax.eval_shape(dist.log_prob, jnp.zeros(3)).shape == (5, 4)


def test_a_field_without_its_shape_is_an_error():
    class Own(AbstractFold):
        way: jax.Array

        def __call__(self, u):
            return u[..., None] * self.way

    with pytest.raises(ValueError, match=r"Own: expected annotated as Float.*field way without its shape"):
        FoldedGaussian(jnp.zeros(2), jnp.eye(2), time_loc=0.0, time_scale=1.0, fold=Own(jnp.ones(2)))


def place_on_path(path, t):
    """A(t) by NumPy: linear between the knots, constant beyond them."""
    times, maps = PATHS["times"][path], PATHS["matrices"][path].reshape(3, 6)
    return np.array([np.interp(t, times, column) for column in maps.T]).reshape(2, 3)


def test_a_path_moves_the_anchor_with_its_own_fold():
    rng, num = np.random.default_rng(4), 7
    anchor, time_loc, u = rng.normal(size=(num, 2)), rng.uniform(-1, 1, num), rng.uniform(-1, 1, num)
    index, own = np.array([0, 1, 2, 1, 2, 0, 1]), rng.normal(size=(num, 3, 2))
    with jax.enable_x64(True):
        fold = SharedPathFold(PolynomialFold(own), anchor, time_loc=time_loc, index=index, **PATHS)
        got, home = APPLY(fold, u), fold.home
        np.testing.assert_array_equal(APPLY(fold, np.zeros(num)), np.zeros((num, 2)))
        along = APPLY(fold, jnp.asarray(u[:, None]))
        without = APPLY(fold.fold, u)
        paths = {name: np.broadcast_to(x, (num, *x.shape)) for name, x in PATHS.items()}  # each its own
        batched = APPLY(SharedPathFold(fold.fold, anchor, time_loc=time_loc, index=index, **paths), u)
    np.testing.assert_array_equal(got[index == 0], without[index == 0])
    np.testing.assert_allclose(batched, got, rtol=1e-12, atol=1e-12)
    for k in range(num):
        g = sum(own[k, j] * u[k] ** (j + 1) for j in range(3))
        expected, start = g, anchor[k]
        if index[k]:
            then, now = (place_on_path(index[k] - 1, t) for t in (time_loc[k] - u[k], time_loc[k]))
            start = now[:, :2] @ anchor[k] + now[:, 2]
            expected = then[:, :2] @ (anchor[k] + g) + then[:, 2] - start
        np.testing.assert_allclose(got[k], expected, atol=1e-12)
        np.testing.assert_allclose(along[k, k], expected, atol=1e-12)
        np.testing.assert_allclose(home[k], start, atol=1e-12)


def path_gaussians(num=5, dtype=np.float64, **changes) -> FoldedGaussian:
    rng = np.random.default_rng(6)
    time_loc, paths = rng.uniform(0, 0.8, num).astype(dtype), PATHS | changes
    paths = {name: np.asarray(x, dtype) for name, x in paths.items()}
    bends = PolynomialFold(rng.normal(size=(num, 2, 2)).astype(dtype))
    anchor = rng.normal(size=(num, 2)).astype(dtype)
    fold = SharedPathFold(bends, anchor, time_loc=time_loc, index=np.arange(num) % 3, **paths)
    scale = rng.uniform(0.1, 0.3, (num, 2)).astype(dtype)
    return FoldedGaussian(fold.home, scale=scale, time_loc=time_loc, time_scale=dtype(0.2), fold=fold)


def test_breaks_of_a_path_are_its_knots_and_those_of_its_own_fold():
    """Breaks are values of u = m_t - t. Without a path, the knots of the first path count."""
    own = FOLDS["spline"]()
    for index, path in ((0, 0), (1, 0), (2, 1)):
        fold = SharedPathFold(own, [0.3, -1.0], time_loc=0.25, index=index, **PATHS)
        np.testing.assert_allclose(fold.breaks, [*(0.25 - PATHS["times"][path]), *own.breaks], rtol=1e-6)
    assert FOLDS["cubic"]().breaks.shape == (0,)


@pytest.mark.parametrize("fold", FOLDS)
def test_only_functions_of_users_are_not_closed(fold):
    assert FOLDS[fold]().is_closed == (fold not in ("function", "pytree"))


def test_a_piecewise_path_ends_at_its_last_knot():
    """Also where several knots are equal at the end, in JAX and NumPy."""
    times, t = np.array([[-0.5, 0.2, 0.2], [0.1, 0.1, 0.7]]), np.array([[-1.0, 0.2, 0.5, 9.0], [0.0, 0.1, 0.4, 9.0]])
    expected = [[0, 2, 2, 2], [0, 1, 1.5, 2]]  # places in knots
    row = np.arange(2)[:, None]
    by_jax, by_numpy = locate(jnp.asarray(times), jnp.asarray(row), jnp.asarray(t)), locate(times, row, t)
    for before, after, fraction in (map(np.asarray, by_jax), by_numpy):
        np.testing.assert_allclose((1 - fraction) * before + fraction * after, expected, atol=1e-6)


def test_distributions_on_paths(x64):
    dist = path_gaussians()
    assert (dist.batch_shape, dist.event_shape) == ((5,), (3,))
    assert dist.fold.matrices.shape == (1, 2, 3, 2, 3)  # not copied for each of them
    x = jnp.asarray(np.random.default_rng(7).uniform(-0.3, 0.8, (4, 1, 3)))
    # each alone, mapped over the constructor
    alone = jax.jit(jax.vmap(lambda k: jax.tree.map(lambda leaf: leaf[k], dist).log_prob(x[0, 0])))(jnp.arange(5))
    np.testing.assert_allclose(alone, dist.log_prob(x)[0], rtol=1e-10)
    kept = dist.marginal([1, -1])
    np.testing.assert_allclose(kept.condition_time(0.3).loc, dist.condition_time(0.3).loc[:, 1:], rtol=1e-12)


@pytest.mark.slow  # quick: test_batch_shapes.py
def test_samples_on_paths_have_their_moments():
    dist = path_gaussians(dtype=np.float32, times=[[-0.5, 0.1, 0.6], [0.2, 0.5, 0.9]])
    x = np.asarray(jax.jit(lambda dist, key: dist.sample(key, (200_000,)))(dist, jax.random.key(0)), np.float64)
    for k, (mean, covariance) in enumerate(zip(*dist.moments(), strict=True)):
        own = np.cov(x[:, k].T)
        np.testing.assert_allclose(x[:, k].mean(0), mean, atol=5 * np.sqrt(np.diag(own).max() / len(x)))
        np.testing.assert_allclose(own, covariance, atol=0.02 * np.diag(own).max())


@pytest.mark.parametrize("mixed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_gradients_reach_paths(x64, mixed):
    dist, x = path_gaussians(), jnp.asarray(np.random.default_rng(8).uniform(0, 0.6, (6, 3)))
    leaves, static = eqx.partition(dist, eqx.is_inexact_array)

    def loss(one):
        own = eqx.combine(one, static)
        return (FoldedMixture(own, weights=jnp.ones(5)).log_prob(x) if mixed else own.log_prob(x[:, None])).sum()

    rng = np.random.default_rng(9)
    leaves = jax.tree.map(np.asarray, leaves)
    way = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape) * (leaf != 0), leaves)
    both = jax.jit(jax.value_and_grad(loss))
    slope = jax.tree.map(np.asarray, both(leaves)[1])
    along = sum(np.sum(a * b) for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(way), strict=True))
    step = lambda h: both(jax.tree.map(lambda a, b: a + h * b, leaves, way))[0]  # noqa: E731
    np.testing.assert_allclose((step(1e-6) - step(-1e-6)) / 2e-6, along, rtol=1e-5)
    assert np.abs(slope.fold.matrices).max() > 0
