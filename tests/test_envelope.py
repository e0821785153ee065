"""Envelopes: their closed forms, the floor, and what happens far away."""

import math
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import AbstractEnvelope, CallableEnvelope, Constant, TimeLikelihood, as_envelope, plain_envelope

TAUS = [0.0, 5.0, 13.3, 14.0, 19.0, 40.0, 1e3]


def _at(envelope, tau):
    return envelope.log_a(jnp.asarray(tau), time_loc=0.0, time_scale=1.0)


#: Jitted once: called eagerly, each operation would be compiled alone.
LOG_A = eqx.filter_jit(lambda envelope, **times: envelope.log_a(**times))
AT = eqx.filter_jit(_at)


def _laplace(t, time_loc, time_scale):
    return -jnp.abs(t - time_loc) / time_scale


def _plain(t, time_loc, time_scale):
    return jnp.exp(-0.5 * ((t - time_loc) / time_scale) ** 2)


ENVELOPES = [
    Constant(),
    TimeLikelihood(),
    TimeLikelihood(2.0, floor=0.1),
    CallableEnvelope(_laplace),
    plain_envelope(_plain),
]


@pytest.mark.parametrize("envelope", ENVELOPES)
def test_every_envelope_keeps_the_protocol(envelope):
    assert isinstance(envelope, AbstractEnvelope)
    t = np.linspace(-2, 2, 6, dtype=np.float32).reshape(3, 2)
    times = {"t": t, "time_loc": np.zeros(2, np.float32), "time_scale": np.ones((3, 1), np.float32)}
    log_a = LOG_A(envelope, **times)
    assert log_a.shape == (3, 2)
    assert (np.asarray(log_a) <= 0).all()
    assert _at(envelope, 0.0) == 0
    copy = pickle.loads(pickle.dumps(envelope))
    np.testing.assert_array_equal(LOG_A(copy, **times), log_a)
    assert len(envelope.leaf_ranks) == len(jax.tree.leaves(envelope))


def test_paper_is_power_one_and_its_code_power_two(x64):
    tau = np.array([-2.0, -0.5, 0.0, 1.0])
    # eq:a_func_2d: the density of time over its peak
    np.testing.assert_allclose(np.exp(AT(TimeLikelihood(), tau)), np.exp(-(tau**2) / 2), rtol=1e-14)
    # the code multiplies standard deviations by that, so the covariance by its square
    np.testing.assert_allclose(AT(TimeLikelihood(2), tau), -(tau**2), rtol=1e-14)
    scaled = LOG_A(TimeLikelihood(), t=np.array(1.5), time_loc=0.5, time_scale=0.25)
    np.testing.assert_allclose(scaled, -8.0, rtol=1e-14)


@pytest.mark.parametrize("floor", [0.0, 1e-12, 0.01, 0.9])
def test_floor_in_log_space_equals_the_plain_form(x64, floor):
    tau = np.linspace(-5, 5, 21)
    plain = np.log(floor + (1 - floor) * np.exp(-(tau**2) / 2))
    np.testing.assert_allclose(AT(TimeLikelihood(1, floor), tau), plain, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_far_away_values_and_gradients_are_finite(dtype):
    with jax.enable_x64(dtype == jnp.float64):

        def log_a(t, power, floor, time_loc, time_scale):
            envelope = TimeLikelihood(power, floor)
            return envelope.log_a(t, time_loc=time_loc, time_scale=time_scale)

        taus, floors = (grid.ravel() for grid in np.meshgrid([*TAUS, 1e25], [0.0, 0.01]))
        arguments = [jnp.asarray(np.broadcast_to(x, taus.shape), dtype) for x in (taus, 1.5, floors, 0.25, 0.5)]
        values, grads = jax.jit(jax.vmap(jax.value_and_grad(log_a, argnums=range(5))))(*arguments)
        by_floor = grads[2]
        assert values.dtype == dtype
        assert jnp.isfinite(values).all()
        assert all(jnp.isfinite(grads[i]).all() for i in (0, 1, 3, 4))
        # e^q without a floor: infinite where it does not fit. In a density it is held at the largest number.
        assert not jnp.isnan(by_floor).any()
        assert jnp.isfinite(by_floor[floors > 0]).all()
        assert (values[floors > 0] >= math.log(0.01) - 1e-6).all()


def test_distances_whose_squares_are_too_large_are_clipped():
    bound, scales = 1e-2 * math.sqrt(np.finfo(np.float32).max), np.array([[0.25], [4.0]], np.float32)
    taus = bound * np.array([0.5, 3.0], np.float32)
    log_a = LOG_A(TimeLikelihood(), t=scales * taus, time_loc=np.float32(0), time_scale=scales)
    np.testing.assert_allclose(log_a, np.tile(-0.5 * np.minimum(taus, bound) ** 2, (2, 1)), rtol=1e-5)


def test_gradients_equal_finite_differences(x64):
    def log_a(x):
        t, power, floor, time_loc, time_scale = x
        return TimeLikelihood(power, floor).log_a(t, time_loc=time_loc, time_scale=time_scale)

    @jax.jit
    @jax.vmap
    def derivatives(x):
        first = jax.grad(log_a)
        return (log_a(x), first(x)), (jax.jacfwd(log_a)(x), jax.jacrev(first)(x))

    x, step = jnp.array([[0.5 + 0.7 * tau, 1.5, 0.2, 0.5, 0.7] for tau in (0.3, 2.0)]), 1e-5
    ups, downs = ([derivatives(x + h)[0] for h in sign * step * np.eye(5)[:, None]] for sign in (1, -1))
    for order, exact in enumerate(derivatives(x)[1]):
        differences = [(up[order] - down[order]) / (2 * step) for up, down in zip(ups, downs, strict=True)]
        np.testing.assert_allclose(exact, np.stack(differences, axis=-1), rtol=1e-6, atol=1e-8)


def test_slope_at_floor_zero_is_exact(x64):
    slope = jax.jit(jax.grad(lambda floor: _at(TimeLikelihood(1.0, floor), 2.0)))(0.0)
    np.testing.assert_allclose(slope, np.expm1(2.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"power": -1.0}, "power"),
        ({"power": np.inf}, "power"),
        ({"floor": -0.1}, "floor"),
        ({"floor": 1.0}, "floor"),
        ({"floor": [0.5, 2]}, "floor"),
    ],
)
def test_bad_input_names_the_parameter(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}: expected .*, got "):
        TimeLikelihood(**arguments)


def test_a_class_that_returns_a_is_refused_even_where_it_is_closed():
    class Own(AbstractEnvelope):
        is_closed = True

        def log_a(self, t, *, time_loc, time_scale):
            return jnp.ones(jnp.shape(t))

    with pytest.raises(ValueError, match=r"^envelope: expected log a <= 0 at time_loc, got 1.0"):
        FoldedGaussian([0.0], [[1.0]], time_loc=0.0, time_scale=1.0, fold=lambda u: u[None], envelope=Own())


@pytest.mark.parametrize("envelope", ENVELOPES)
def test_only_functions_are_not_closed(envelope):
    assert envelope.is_closed == (not isinstance(envelope, CallableEnvelope))


def test_integers_and_weak_types_become_floats():
    envelope = TimeLikelihood(np.array([1, 2]), 0)
    assert (envelope.power.dtype, envelope.floor.dtype) == (jnp.float32, jnp.float32)
    assert not envelope.floor.weak_type  # jitted code is compiled once for numbers and arrays
    np.testing.assert_allclose(TimeLikelihood(power=2).log_a(3, time_loc=1, time_scale=1), -4)


def test_nan_propagates():
    assert jnp.isnan(_at(eqx.tree_at(lambda e: e.power, TimeLikelihood(), jnp.nan), 1.0))
    assert jnp.isnan(_at(TimeLikelihood(1.0, 0.1), jnp.nan))


class _Slope(eqx.Module):
    rate: jax.Array

    def __call__(self, t, time_loc, time_scale):
        return -self.rate * jnp.abs(t - time_loc) / time_scale


def test_callable_envelope_is_its_function_and_batches_and_trains():
    t, scale = jnp.linspace(-2.0, 2.0, 6).reshape(3, 2), jnp.array([[0.5], [1.0], [2.0]])
    got = CallableEnvelope(_laplace).log_a(t, time_loc=jnp.array([0.1, 0.2]), time_scale=scale)
    np.testing.assert_allclose(got, -np.abs(np.asarray(t) - np.array([0.1, 0.2])) / np.asarray(scale), rtol=1e-6)
    mapped = jax.vmap(lambda rate: CallableEnvelope(_Slope(rate)))(jnp.arange(3.0))
    np.testing.assert_allclose(_at(mapped, jnp.full(3, 2.0)), [0, -2, -4])
    slope = jax.grad(lambda e: _at(e, 2.0))(CallableEnvelope(_Slope(jnp.array(1.5))))
    assert slope.parameters.rate == -2
    assert as_envelope(mapped) is mapped
    assert isinstance(as_envelope(_laplace), CallableEnvelope)


def test_gradient_reaches_what_an_own_envelope_closes_over():
    @jax.jit
    @jax.grad
    def slope(rate):
        envelope = CallableEnvelope(lambda t, m, scale: -rate * jnp.abs(t - m) / scale)
        dist = FoldedGaussian([0.0], [[1.0]], time_loc=0.0, time_scale=1.0, envelope=envelope)
        return dist.log_prob(jnp.array([0.5, 2.0]))

    # log p = -s^2 / (2 a) - log(a) / 2 + ..., log a = -2 rate
    np.testing.assert_allclose(slope(0.3), 1 - 0.25 * np.exp(0.6), rtol=1e-5)


@pytest.mark.parametrize(("dtype", "edge"), [(jnp.float32, 13.2), (jnp.float64, 37.6)])
def test_plain_envelope_agrees_until_a_underflows_and_is_held_beyond(dtype, edge):
    with jax.enable_x64(dtype == jnp.float64):
        over = jax.jit(jax.vmap(jax.value_and_grad(lambda tau: _at(plain_envelope(_plain), tau))))
        values, slopes = over(jnp.asarray([0.0, 1.0, edge - 0.1, edge + 0.2, 1e3, 1e25], dtype))
        tau = np.array([0.0, 1.0, edge - 0.1])
        np.testing.assert_allclose(values[:3], -(tau**2) / 2, rtol=1e-5)
        np.testing.assert_allclose(slopes[:3], -tau, rtol=1e-5)
        np.testing.assert_allclose(values[3:], math.log(jnp.finfo(dtype).tiny), rtol=1e-6)
        assert np.isfinite(slopes).all()
        assert np.isnan(AT(plain_envelope(_plain), np.array(np.nan, dtype)))
        least = jnp.finfo(dtype).tiny  # a itself, which is still a normal number
        slope = jax.grad(lambda a: _at(plain_envelope(lambda t, m, scale: t), a))
        np.testing.assert_allclose(slope(least), 1 / least, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "name"), [(CallableEnvelope, "function"), (plain_envelope, "a"), (as_envelope, "envelope")]
)
def test_what_is_not_callable_is_refused(make, name):
    with pytest.raises(ValueError, match=f"^{name}: expected .*, got "):
        make(3.0)
