"""The profile log-likelihood of (time_loc, time_scale), with space maximized in closed form, and its maximization."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from foldgauss._numerics.regression import Regression, weighted_regression
from foldgauss.envelope import AbstractEnvelope

__all__ = ["Ascent", "Profile", "Space", "maximize"]

_LOG_2PI = 1.8378770664093453
_ARMIJO = 1e-4  # sufficient increase, as a fraction of the predicted one
_MIN_FRACTION = 2.0**-20  # below this fraction of a step the value no longer changes
_MAX_STEP = 0.5  # a step changes time_loc by at most half a time_scale, and time_scale by a factor exp(0.5)


class Space(NamedTuple):
    """The maximum over space given time; `exp(2 log_unit) tril tril'` is the covariance."""

    regression: Regression
    tril: Float[Array, "d-1 d-1"]
    value: Float[Array, ""]  # log-likelihood per point, -inf where singular
    singular: Bool[Array, ""]


class Profile(eqx.Module):
    """The points of a fit: space centered and scaled, weights of sum 1."""

    t: Float[Array, " n"]
    y: Float[Array, "n d-1"]
    weights: Float[Array, " n"]
    envelope: AbstractEnvelope
    degree: int = eqx.field(static=True)
    diagonal: bool = eqx.field(static=True)

    def log_a(self, time_loc, time_scale) -> Float[Array, " n"]:
        return self.envelope.log_a(self.t, time_loc=time_loc, time_scale=time_scale)

    def space(self, time_loc: Float[Array, ""], time_scale: Float[Array, ""]) -> Space:
        """Fold, loc and Sigma by weighted least squares, and the log-likelihood there (eq:foldgauss)."""
        # Envelope theorem: at the least-squares solution the value does not move with the coefficients, nor with
        # the basis (it spans the same polynomials for every time), so only `a` and N(t) carry the gradient.
        log_a, held = self.log_a(time_loc, time_scale), lax.stop_gradient((time_loc, time_scale))
        v, held_log_a = (held[0] - self.t) / held[1], self.log_a(*held)
        held_log_a = lax.stop_gradient(held_log_a)
        regression = weighted_regression(v, self.y, held_log_a, self.weights, self.degree)
        unit, fitted = lax.stop_gradient((regression.log_unit, regression.fitted))
        root = jnp.where(self.weights > 0, jnp.exp(-0.5 * log_a - unit), 0)[:, None]
        tril, singular = self._factor(root * (self.y - fitted), lax.stop_gradient(root) * self.y)
        log_det = 2 * jnp.log(jnp.where(singular, 1, jnp.diagonal(tril))).sum() + 2 * unit * self.y.shape[1]
        tau = (self.t - time_loc) / time_scale
        mean = lambda z: (self.weights * z).sum()  # noqa: E731
        value = -0.5 * mean(tau * tau) - jnp.log(time_scale) - 0.5 * _LOG_2PI
        value = value - 0.5 * self.y.shape[1] * (mean(log_a) + _LOG_2PI + 1) - 0.5 * log_det
        return Space(regression, tril, jnp.where(singular | regression.rank_deficient, -jnp.inf, value), singular)

    def _factor(self, residual, total) -> tuple[Float[Array, "d-1 d-1"], Bool[Array, ""]]:
        """Cholesky factor of the residuals' covariance, and whether that is singular to working precision."""
        eps = jnp.finfo(residual.dtype).eps
        variance, size = ((self.weights[:, None] * z * z).sum(0) for z in (residual, total))
        singular = (variance <= (64 * eps) ** 2 * size).any()
        scale = jnp.sqrt(jnp.where(singular, 1, variance))
        if self.diagonal:
            return jnp.diag(scale), singular
        z = jnp.sqrt(self.weights)[:, None] * residual / scale[None]
        correlation = jnp.matmul(z.T, z)
        pivots = jnp.diagonal(jnp.linalg.cholesky(lax.stop_gradient(correlation)))
        singular = singular | ~(pivots**2 > 64 * eps).all()  # true for NaN pivots
        tril = jnp.linalg.cholesky(jnp.where(singular, jnp.eye(scale.size, dtype=scale.dtype), correlation))
        return scale[:, None] * tril, singular


class Ascent(NamedTuple):
    """The state of the search, in theta = (time_loc / unit, log time_scale)."""

    theta: Float[Array, "2"]
    value: Float[Array, ""]
    gradient: Float[Array, "2"]
    inverse_hessian: Float[Array, "2 2"]  # of minus the value
    fraction: Float[Array, ""]  # of the quasi-Newton step, halved until the value increases
    steps: Int[Array, ""]

    def converged(self, slack: float = 1.0) -> Bool[Array, ""]:
        # Values are accurate to eps, and so the gradient at the maximum to its square root.
        resolution = jnp.finfo(self.value.dtype).eps * jnp.maximum(1, jnp.abs(self.value))
        return jnp.abs(self.gradient).max() <= 4 * slack * jnp.sqrt(resolution)


def maximize(profile: Profile, time_loc, time_scale, max_steps: int):
    """(time_loc, time_scale, Ascent) of a local maximum of the profile, by BFGS with increasing values."""

    def times(theta):
        return time_loc + time_scale * theta[0], time_scale * jnp.exp(theta[1])

    evaluate = jax.value_and_grad(lambda theta: profile.space(*times(theta)).value)
    theta = jnp.zeros(2, profile.t.dtype)
    # Fisher information of (time_loc / time_scale, log time_scale) in N(t) is diag(1, 2): steps of natural size.
    start = jnp.diag(jnp.array([1.0, 0.5], theta.dtype))
    one, zero = jnp.ones((), theta.dtype), jnp.zeros((), jnp.int32)
    state = Ascent(theta, *evaluate(theta), start, one, zero)

    def unfinished(state):
        usable = jnp.isfinite(state.value) & (state.fraction > _MIN_FRACTION)
        return usable & ~state.converged() & (state.steps < max_steps)

    state = lax.while_loop(unfinished, lambda state: _step(state, evaluate), state)
    return *times(state.theta), state


def _step(state: Ascent, evaluate) -> Ascent:
    """One trial step: accepted with a BFGS update if the value increases enough, else the fraction is halved."""
    direction = jnp.matmul(state.inverse_hessian, state.gradient)
    direction = direction * jnp.minimum(1, _MAX_STEP / jnp.abs(direction).max())
    move = state.fraction * direction
    value, gradient = evaluate(state.theta + move)
    rises = value >= state.value + _ARMIJO * (move * state.gradient).sum()
    rises = rises & jnp.isfinite(value) & jnp.isfinite(gradient).all() & (value > state.value)
    accepted = Ascent(
        state.theta + move, value, gradient, _update_bfgs(state, move, gradient), jnp.ones_like(value), state.steps + 1
    )
    rejected = state._replace(fraction=0.5 * state.fraction, steps=state.steps + 1)
    return jax.tree.map(lambda a, b: jnp.where(rises, a, b), accepted, rejected)


def _update_bfgs(state: Ascent, move, gradient) -> Float[Array, "2 2"]:
    """The BFGS update of the inverse Hessian, skipped unless the curvature along the move is clearly positive."""
    change = state.gradient - gradient
    curvature = (move * change).sum()
    safe = curvature > 1e-3 * (move * move).sum()
    rho = jnp.where(safe, 1 / jnp.where(safe, curvature, 1), 0)
    left = jnp.eye(2, dtype=move.dtype) - rho * jnp.outer(move, change)
    updated = jnp.matmul(left, jnp.matmul(state.inverse_hessian, left.T)) + rho * jnp.outer(move, move)
    return jnp.where(safe, updated, state.inverse_hessian)
