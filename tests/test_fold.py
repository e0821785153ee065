"""Folds: against NumPy's polynomials, their batches, and what they refuse."""

import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foldgauss.fold import AbstractFold, CallableFold, PolynomialFold, ZeroFold, as_fold


def _wave(u):
    return jnp.stack([jnp.sin(u), u**2])


class _Line(eqx.Module):
    slope: jax.Array

    def __call__(self, u):
        return self.slope * u


FOLDS = {
    "zero": lambda: ZeroFold(2),
    "degree 0": lambda: PolynomialFold(jnp.zeros((0, 2))),
    "cubic": lambda: PolynomialFold([[1.0, -2.0], [0.5, 0.25], [0.1, 3.0]]),
    "function": lambda: CallableFold(_wave),
    "pytree": lambda: CallableFold(_Line(jnp.array([1.0, 2.0]))),
}


@pytest.fixture(params=FOLDS)
def fold(request):
    return FOLDS[request.param]()


@settings(max_examples=15, deadline=None)
@given(degree=st.integers(0, 12), dim=st.integers(1, 4), seed=st.integers(0, 2**20))
def test_polynomial_equals_numpy_and_has_no_constant_term(degree, dim, seed):
    rng = np.random.default_rng(seed)
    coefficients, u = rng.normal(size=(degree, dim)), rng.uniform(-2, 2, size=7)
    with jax.enable_x64(True):
        fold = PolynomialFold(coefficients)
        expected = np.polynomial.polynomial.polyval(u, np.vstack([np.zeros((1, dim)), coefficients])).T
        np.testing.assert_allclose(fold(jnp.asarray(u)), expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(fold(jnp.zeros(())), np.zeros(dim))


def test_every_fold_maps_batches_like_a_loop(fold):
    u = jnp.linspace(-1.0, 1.0, 6).reshape(3, 2)
    assert isinstance(fold, AbstractFold)
    assert fold(u).shape == (3, 2, 2)
    loop = np.array([[fold(v) for v in row] for row in u])
    np.testing.assert_allclose(fold(u), loop, atol=1e-7)
    np.testing.assert_allclose(eqx.filter_jit(fold)(u), loop, atol=1e-6)
    assert fold(jnp.zeros((0,))).shape == (0, 2)


def test_every_fold_round_trips(fold):
    u = jnp.linspace(-1.0, 1.0, 5)
    flat, treedef = jax.tree.flatten(fold)
    np.testing.assert_array_equal(jax.tree.unflatten(treedef, flat)(u), fold(u))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fold))(u), fold(u))
    jax.tree.unflatten(treedef, [object()] * len(flat))  # as vmap and friends do


@pytest.mark.parametrize(("leading", "shape"), [((), (4,)), ((5,), ()), ((5,), (5,)), ((5, 1), (3,)), ((3,), (5, 1))])
def test_polynomial_batches_broadcast(leading, shape):
    coefficients = jax.random.normal(jax.random.key(0), (*leading, 3, 2))
    u = jax.random.normal(jax.random.key(1), shape)
    batch = jnp.broadcast_shapes(leading, shape)
    got = PolynomialFold(coefficients)(u)
    assert got.shape == (*batch, 2)
    rows = jnp.broadcast_to(coefficients, (*batch, 3, 2)).reshape(-1, 3, 2)
    powers = jnp.broadcast_to(u, batch).reshape(-1, 1) ** jnp.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(got.reshape(-1, 2), jnp.einsum("nk,nkd->nd", powers, rows), atol=1e-5)


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


def test_as_fold_wraps_only_what_is_no_fold():
    fold = ZeroFold(1)
    assert as_fold(fold) is fold
    assert isinstance(as_fold(_wave), CallableFold)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: PolynomialFold([1.0, 2.0]), "coefficients"),
        (lambda: PolynomialFold(jnp.zeros((3, 0))), "coefficients"),
        (lambda: ZeroFold(0), "dim"),
        (lambda: ZeroFold(1.5), "dim"),
        (lambda: as_fold(3.0), "function"),
    ],
)
def test_bad_input_names_the_parameter(make, name):
    with pytest.raises(ValueError, match=f"^{name}: expected .*, got "):
        make()


def test_integers_become_floats():
    assert PolynomialFold([[1], [2]]).coefficients.dtype == jnp.float32
