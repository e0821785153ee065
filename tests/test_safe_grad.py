"""Derivatives that overflow on their way: by a toy whose every number is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss._numerics.safe_grad import evaluate_with_safe_grad
from foldgauss.distribution import FoldedGaussian
from foldgauss.fold import CallableFold, PolynomialFold

LARGEST = np.finfo(np.float32).max


def _toy(root, x, small):
    """x y with y = 1e30 small 1e30: its slope by x is 1e60 small, by small it is 1e60 x."""
    factor = 1.0 if root is None else root
    return factor * 1e30 * (factor * 1e30 * (x * small))


def _far(x, small):
    return evaluate_with_safe_grad(_toy, x, small)


def test_slopes_are_true_where_they_fit_and_saturate_where_not():
    x, small = jnp.float32(-1e-25), jnp.float32(1e-30)
    assert np.isinf(jax.grad(lambda x, s: _toy(None, x, s), argnums=1)(x, small))
    by_x, by_small = jax.grad(_far, argnums=(0, 1))(x, small)
    np.testing.assert_allclose(by_x, 1e30, rtol=1e-6)
    np.testing.assert_allclose(by_small, -1e35, rtol=1e-6)
    assert jax.grad(_far, argnums=1)(jnp.float32(-1e-5), small) == -LARGEST
    # Forward too, and as a linear map.
    np.testing.assert_allclose(jax.jvp(_far, (x, small), (1e-3, 0.0))[1], 1e27, rtol=1e-6)
    np.testing.assert_allclose(jax.linearize(_far, x, small)[1](0.0, 1e-3), -1e32, rtol=1e-6)


@pytest.mark.parametrize("jit", [lambda f: f, jax.jit])
def test_batches_decide_number_by_number(jit):
    x, small = jnp.asarray([1e-25, -1e-5, 1.0], jnp.float32), jnp.float32(1e-30)
    each = jit(jax.vmap(jax.grad(_far, argnums=(0, 1)), in_axes=(0, None)))
    by_x, by_small = each(x, small)
    np.testing.assert_allclose(by_x, [1e30] * 3, rtol=1e-6)
    np.testing.assert_allclose(by_small, [1e35, -LARGEST, LARGEST], rtol=1e-6)
    # A sum over the batch is taken before it is held: the terms do not fit, their sum does.
    total = jit(jax.grad(lambda s, x: jax.vmap(_far, in_axes=(0, None))(x, s).sum()))
    np.testing.assert_allclose(total(small, jnp.asarray([1e-20, -0.99e-20], jnp.float32)), 1e38, rtol=1e-4)
    np.testing.assert_allclose(jit(jax.vmap(total))(jnp.full(2, small), jnp.stack([x[:1], x[1:2]])), [1e35, -LARGEST])


def test_what_is_known_is_not_differentiated():
    count = 0

    @jax.custom_vjp
    def watched(x):
        return x

    def backward(_, g):
        nonlocal count
        count += 1
        return (g,)

    watched.defvjp(lambda x: (x, None), backward)
    function = lambda root, x, y: x * watched(y) * (1.0 if root is None else root * root)  # noqa: E731
    assert jax.grad(lambda x: evaluate_with_safe_grad(function, x, jnp.float32(3)))(jnp.float32(2)) == 3
    assert count == 0
    assert jax.grad(lambda y: evaluate_with_safe_grad(function, jnp.float32(2), y))(jnp.float32(3)) == 2
    assert count == 1


def test_nan_in_nan_out():
    assert np.isnan(jax.grad(_far, argnums=1)(jnp.float32(np.nan), jnp.float32(1.0)))


@pytest.mark.slow  # it compiles for long
def test_tracers_in_a_users_function_are_found():
    x = jnp.array([0.3, -0.2, 0.9])

    def log_prob(slope, u_scale, x):
        fold = lambda u: slope * (u * u_scale)  # noqa: E731
        return FoldedGaussian(jnp.zeros(2), jnp.eye(2), time_loc=0.5, time_scale=0.3, fold=fold).log_prob(x)

    def polynomial(slope, u_scale, x):
        fold = PolynomialFold(slope[None] * u_scale)
        return FoldedGaussian(jnp.zeros(2), jnp.eye(2), time_loc=0.5, time_scale=0.3, fold=fold).log_prob(x)

    slopes = jnp.array([[0.5, -1.0], [2.0, 0.1]])
    for order in (jax.grad, lambda f: jax.hessian(f)):
        both = [jax.jit(jax.vmap(order(f), in_axes=(0, None, None)))(slopes, 1.1, x) for f in (log_prob, polynomial)]
        np.testing.assert_allclose(*both, rtol=1e-4, atol=1e-5)
    # Batched only through the closure, and differentiated by something else.
    inside = [jax.vmap(lambda s, f=f: jax.grad(f, argnums=2)(s, 1.1, x))(slopes) for f in (log_prob, polynomial)]
    np.testing.assert_allclose(*inside, rtol=1e-4, atol=1e-5)


def test_far_points_do_not_spoil_a_networks_gradient():
    network = CallableFold(eqx.nn.MLP("scalar", 1, 4, 1, key=jax.random.key(0)))
    dist = FoldedGaussian([0.0], [[1.0]], time_loc=0.0, time_scale=1.0, fold=network)
    t = np.array([0.3, 14.0], np.float32)
    s = np.asarray(jax.jit(lambda dist: dist.condition_time(t).loc)(dist)) + np.array([[0.1], [1e-9]], np.float32)
    x = np.concatenate([s, t[:, None]], -1)
    for leaf in jax.tree.leaves(jax.jit(jax.grad(lambda d, x: d.log_prob(x).sum()))(dist, x)):
        assert np.isfinite(leaf).all()


def test_eager_gradients_do_not_compile_anew():
    dist = FoldedGaussian([0.0], [[1.0]], time_loc=0.0, time_scale=1.0)
    gradient = jax.grad(lambda x: dist.log_prob(x))
    x = jnp.array([1e-8, 15.0])
    gradient(x)
    with jax.log_compiles(), pytest.MonkeyPatch.context() as patch:
        compiled = []
        patch.setattr(
            "jax._src.compiler.compile_or_get_cached", lambda *a, **k: compiled.append(1) or pytest.fail("compiled")
        )
        assert np.isfinite(gradient(x)).all()
    assert not compiled


def test_python_scalars_and_two_dtypes_through_a_users_function():
    def log_prob(w, x):
        fold = lambda u: w * u * jnp.ones(2)  # noqa: E731
        return FoldedGaussian(jnp.zeros(2), jnp.eye(2), time_loc=0.4, time_scale=0.3, fold=fold).log_prob(x)

    x = np.array([0.1, -0.2, 0.9], np.float32)
    forward, backward = jax.jit(lambda w, x: (jax.jacfwd(log_prob)(w, x), jax.grad(log_prob)(w, x)))(0.5, x)
    np.testing.assert_allclose(forward, backward, rtol=1e-5)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        found = jax.jit(jax.grad(log_prob))(np.float32(0.5), x.astype(np.float64))
    np.testing.assert_allclose(found, backward, rtol=1e-4)


@pytest.mark.slow
def test_gradients_inside_shard_map():
    mesh = jax.make_mesh((1,), ("i",), axis_types=(jax.sharding.AxisType.Auto,))
    dist = FoldedGaussian([0.0], [[1.0]], time_loc=0.4, time_scale=0.3, fold=PolynomialFold([[0.7]]))
    x = jnp.array([[0.1, 0.2], [0.3, 0.9]])
    spec = jax.sharding.PartitionSpec
    one = jax.grad(lambda dist, x: jax.vmap(dist.log_prob)(x).sum(), argnums=(0, 1))
    sharded = jax.shard_map(one, mesh=mesh, in_specs=(spec(), spec("i")), out_specs=(spec(), spec("i")))
    both = jax.jit(sharded)(dist, x), jax.jit(one)(dist, x)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), *both)


def _forward_overflows(root, x, small):
    """1e60 x small, multiplied in the order that overflows forward only: backward it meets `small` first."""
    factor = 1.0 if root is None else root
    return factor * 1e30 * (factor * 1e30 * x) * small


def test_forward_mode_is_true_where_backward_needs_no_help():
    x, small = jnp.float32(1e-25), jnp.float32(1e-30)
    function = lambda x, s: evaluate_with_safe_grad(_forward_overflows, x, s)  # noqa: E731
    assert np.isinf(jax.jvp(lambda x: _forward_overflows(None, x, small), (x,), (jnp.float32(1.0),))[1])
    for jit in (lambda f: f, jax.jit):
        slope = jit(lambda x: jax.jvp(lambda x: function(x, small), (x,), (jnp.float32(1.0),))[1])(x)
        np.testing.assert_allclose(slope, 1e30, rtol=1e-6)
        np.testing.assert_allclose(jit(jax.jacfwd(function))(x, small), 1e30, rtol=1e-6)


def _deep(root, x, y, small):
    """1e90 x y small: backward passes through 1e90, which only the roots below 2^-174 bring below 2^128."""
    factor = 1.0 if root is None else root
    return factor * 1e30 * (factor * 1e30 * (1e30 * (x * y * small)))


def test_deep_roots_are_reached():
    x, y, small = jnp.float32(1e-35), jnp.float32(1e-20), jnp.float32(1e-35)
    for jit in (lambda f: f, jax.jit):
        slope = jit(jax.grad(lambda x: evaluate_with_safe_grad(_deep, x, y, small)))(x)
        np.testing.assert_allclose(slope, 1e35, rtol=1e-5)
        np.testing.assert_allclose(
            jit(jax.vmap(jax.grad(lambda x: evaluate_with_safe_grad(_deep, x, y, small))))(x[None]), 1e35, rtol=1e-5
        )
