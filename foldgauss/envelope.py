"""The envelope a(t), by which the space covariance of a Folded-Gaussian shrinks away from `time_loc` (eq:cond_dens).

Envelopes are computed in log space: far from `time_loc` `a` underflows, `log a` does not.

**Defaults.** What is constructed or fitted to images (`FoldedGaussian`, `FitConfig`) has the paper's envelope,
`TimeLikelihood()`. What is estimated from points by maximum likelihood (`foldgauss.estimator`) has `Constant()`: with a
time likelihood the points of outlying times have weights 1/a without bound, so a few of them decide the fit, and the
likelihood itself is unbounded where power (d-1) > 2. There `envelope="time_likelihood"` is the paper's with a floor of
1e-3, which bounds both.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from foldgauss._numerics.batch import (
    BatchModule,
    FunctionModule,
    check_values,
    common_dtype,
    divide,
    steepest,
    vectorize,
)
from foldgauss._runtime.checks import check_signature, require, short_repr

__all__ = ["AbstractEnvelope", "CallableEnvelope", "Constant", "TimeLikelihood", "as_envelope", "plain_envelope"]

#: log a at time_loc that is still rounding of 0, also in half precision; a function that returns a itself has 1 there.
_PEAK_ROUNDING = 1e-2


class AbstractEnvelope(BatchModule):
    """An envelope with batch dimensions, given by its logarithm.

    **Shapes:** t, time_loc, time_scale (*batch,) -> (*batch,). **Units:** the three share theirs; a has none.

    To extend: return `log a <= 0`, elementwise, and annotate arrays with their shapes (`Float[Array, "*batch"]`), from
    which it is known what is batch. In densities all arguments and parameters are single numbers.
    """

    #: Whether it depends on its leaves only; a user's function may also close over tracers.
    is_closed: ClassVar[bool] = False

    @abstractmethod
    def log_a(
        self,
        t: Float[Array, "*#batch"],
        *,
        time_loc: Float[Array, "*#batch"],
        time_scale: Float[Array, "*#batch"],
    ) -> Float[Array, "*#batch"]:
        """log a(t); all arguments broadcast."""


class Constant(AbstractEnvelope):
    """`a(t) = 1`: the space covariance does not depend on time.

    **Shapes:** t, time_loc, time_scale (*batch,) -> (*batch,).

    **Example:** `Constant().log_a(0.2, time_loc=0.5, time_scale=0.1)  # 0.`

    **Source:** eq:cond_dens with a = 1.
    """

    is_closed = True

    def log_a(self, t, *, time_loc, time_scale):
        shape = jnp.broadcast_shapes(jnp.shape(t), jnp.shape(time_loc), jnp.shape(time_scale))
        return jnp.zeros(shape, jnp.result_type(t, time_loc, time_scale))


class TimeLikelihood(AbstractEnvelope):
    """The paper's envelope: the time likelihood, scaled to 1 at its peak, with a power and a floor.

        log a = logaddexp(log floor, log(1 - floor) - power tau^2 / 2),   tau = (t - time_loc) / time_scale

    The paper's text has `power=1` (the default); its published code scales *standard deviations* by
    `exp(-tau^2/2)`, which is `power=2`. A floor > 0 bounds the density: without a floor it is unbounded on the ridge
    `s = loc + f` if `power (d-1) > 2`, and maximum likelihood is degenerate.

    **Shapes:** `power`, `floor` (*batch,); t, time_loc, time_scale (*batch,) -> (*batch,); all broadcast.

    **Units:** none; t, time_loc and time_scale share theirs.

    **Example:** `TimeLikelihood(power=2).log_a(1.5, time_loc=0.5, time_scale=0.5)  # -2 * 2^2 / 2 = -4.`

    **Source:** eq:a_func_2d. **Raises:** ValueError if `power` is negative or not finite, or `floor` is outside [0, 1).
    """

    power: Float[Array, "*#batch"]
    floor: Float[Array, "*#batch"]

    is_closed = True

    def __init__(self, power: ArrayLike = 1.0, floor: ArrayLike = 0.0):
        self.power, self.floor = (jnp.asarray(x, common_dtype(x)) for x in (power, floor))
        cure = "The paper's text has 1, its code 2."
        check_values("power", self.power, lambda x: (x >= 0) & (x < np.inf), "a finite number >= 0", cure)
        cure = "For a = 1 use Constant()."
        check_values("floor", self.floor, lambda x: (x >= 0) & (x < 1), "a number in [0, 1)", cure)

    def log_a(self, t, *, time_loc, time_scale):
        t, time_loc, time_scale, power, floor = jnp.broadcast_arrays(t, time_loc, time_scale, self.power, self.floor)
        offset = t - time_loc
        offset = offset if jnp.issubdtype(offset.dtype, jnp.floating) else offset.astype(self.power.dtype)
        tau = _bounded_tau(offset, time_scale)
        return _log_floored(0.5 * power * tau * tau, floor)


class CallableEnvelope(FunctionModule, AbstractEnvelope):
    """Any function that returns log a, with or without parameters, as an envelope.

        log a(t) = function(t, time_loc, time_scale)

    **Shapes:** `function` maps three scalars to a scalar <= 0; this class vmaps it over batches. Arrays inside it (a
    pytree) are leaves of the envelope and are trained with it.

    **Example:** `CallableEnvelope(lambda t, m, scale: -jnp.abs((t - m) / scale))  # a = exp(-|tau|)`

    **Source:** the "suitably chosen" a of eq:cond_dens. **Raises:** ValueError if `function` is not callable.
    """

    signature = "(t, time_loc, time_scale) -> log a"

    def log_a(self, t, *, time_loc, time_scale):
        dtype = jnp.result_type(t, time_loc, time_scale)
        scalars = (jnp.asarray(x, dtype) for x in (t, time_loc, time_scale))
        return vectorize(CallableEnvelope.evaluate, self, *scalars)


def plain_envelope(a: Callable[[Array, Array, Array], Array]) -> CallableEnvelope:
    """An envelope from a function that returns `a` itself, with a smaller range.

    Where `a` underflows, log a is clipped to that of the smallest normal number (-87.3 in float32, -708.4 in float64),
    with slope 0. `exp(-tau^2/2)` reaches it at |tau| = 13.2 and 37.6; beyond, densities are those of a wider Gaussian.
    Pass log a to `CallableEnvelope` where that matters.

    **Shapes:** `a` maps three scalars (t, time_loc, time_scale) to a scalar in (0, 1].

    **Example:** `plain_envelope(lambda t, m, scale: 1 / (1 + ((t - m) / scale) ** 2))`

    **Source:** a of eq:cond_dens. **Raises:** ValueError if `a` is not callable.
    """
    require(callable(a), "a", expected="a callable (t, time_loc, time_scale) -> a in (0, 1]", got=repr(a))
    return CallableEnvelope(_Logarithm(a))


def as_envelope(envelope: AbstractEnvelope | Callable) -> AbstractEnvelope:
    """`envelope` itself if it is one, else a `CallableEnvelope` of the callable, which must return log a.

    **Shapes:** a callable maps three scalars (t, time_loc, time_scale) to a scalar <= 0. **Raises:** ValueError if it
    is not callable.

    **Example:** `as_envelope(lambda t, m, scale: -jnp.abs((t - m) / scale))`
    """
    if isinstance(envelope, AbstractEnvelope):
        return envelope
    require(
        callable(envelope),
        "envelope",
        expected="an envelope or a callable",
        got=short_repr(envelope),
        cure="Constant(), TimeLikelihood(power=...), a callable that returns log a, or plain_envelope(a).",
    )
    check_signature("envelope", envelope, "t", "time_loc", "time_scale")
    return CallableEnvelope(envelope)


def check_peak(envelope: AbstractEnvelope, time_loc: ArrayLike, time_scale: ArrayLike) -> None:
    """Raise if log a > 0 at time_loc, as where a function returns a itself; traced values pass."""
    if isinstance(envelope, Constant | TimeLikelihood):
        return
    peak = envelope.log_a(time_loc, time_loc=time_loc, time_scale=time_scale)
    cure = "For a function that returns a itself use plain_envelope(a)."
    check_values("envelope", peak, lambda log_a: ~(log_a > _PEAK_ROUNDING), "log a <= 0 at time_loc", cure)


class _Logarithm(eqx.Module):
    function: Callable

    def __call__(self, *scalars):
        a = jnp.asarray(self.function(*scalars))
        smallest = float(jnp.finfo(a.dtype).tiny)
        return jnp.log(jnp.where(a < smallest, smallest, a))  # a NaN compares false, and propagates


def _bounded_tau(offset: Float[Array, "*batch"], time_scale: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """offset / time_scale, clipped so that its square is representable; densities out there underflow anyway."""
    bound = float(np.sqrt(jnp.finfo(offset.dtype).max)) * 1e-2
    far = jnp.abs(offset) > bound * time_scale
    # Double where: an overflowing quotient would give 0 * inf in the gradient of the branch not taken.
    near = divide(jnp.where(far, 0, offset), jnp.where(far, 1, time_scale))
    return jnp.where(far, jnp.copysign(bound, offset).astype(offset.dtype), near)


@jax.custom_jvp
def _log_floored(q: Float[Array, "*batch"], floor: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """log(floor + (1 - floor) e^-q)."""
    near = jnp.log1p((1 - floor) * jnp.expm1(-q))  # exactly 0 at the peak, never above
    far = jnp.logaddexp(jnp.log(floor), jnp.log1p(-floor) - q)
    return jnp.where(q < 0.5, near, far)


@_log_floored.defjvp
def _log_floored_jvp(primals, tangents):
    # By hand, because autodiff computes 0 * inf through log(floor) at floor = 0, where the derivative is expm1(q).
    (q, floor), (q_dot, floor_dot) = primals, tangents
    log_a = _log_floored(q, floor)
    by_q = -jnp.exp(jnp.log1p(-floor) - q - log_a)
    by_floor = -jnp.expm1(-q) * jnp.exp(jnp.minimum(-log_a, math.log(steepest(q.dtype))))
    return log_a, by_q * q_dot + by_floor * floor_dot
