"""The M-step: updates the components from sufficient statistics by weighted regression and steps of the times.

Given (time_loc, time_scale), curve and Sigma are weighted least squares. For a constant envelope the times are updated
by moments. For others `a` depends on the times, and moments can *decrease* the likelihood: there the times take a
Newton step on the profile of the expected log-likelihood (with space maximized in closed form), and only if it ascends:
generalized EM.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from foldgauss._numerics.regression import hermite_to_powers
from foldgauss._numerics.triangular import cholesky, inverse_lower, log_det
from foldgauss.estimator.em.components import Parameters, change_variable, to_powers
from foldgauss.estimator.em.statistics import SufficientStatistics, Times, step_times

#: Longest step: half a time_scale for time_loc, a factor exp(0.5) for time_scale.
_MAX_STEP = 0.5
#: Curvature is at least this fraction of a component's mass; that of a normal distribution is 1 and 2.
_MIN_CURVATURE = 0.2


class Model(eqx.Module):
    """The structure of the mixture and its regularization."""

    degrees: Int[Array, " k"]  # the degree of each component's polynomial, at most that of the arrays
    floor: Float[Array, " d"]  # variances added to those of each coordinate, time last
    covariance: str = eqx.field(static=True)  # full, diag, spherical, tied


def update_components(
    params: Parameters, sums: SufficientStatistics, model: Model, steps: Float[Array, "2 k"] | None = None
) -> tuple[Parameters, Bool[Array, " k"]]:
    """The maximum given `sums`, and which components are unchanged: those without mass, or with a singular Sigma.

    The times are updated by moments, or by `steps` (see `step_times`).
    """
    mass = jnp.where(sums.mass > 0, sums.mass, 1)
    if steps is None:
        first = sums.first / mass  # of v = (time_loc - t) / time_scale: relative to the current time_loc
        variance = jnp.maximum(sums.second / mass - first * first, 0)
        time_loc = params.time_loc - params.time_scale * first
        time_scale = params.time_scale * jnp.sqrt(variance)
        time_scale = jnp.hypot(time_scale, jnp.sqrt(model.floor[-1]))
    else:
        time_loc, time_scale = step_times(Times(params.time_loc, params.time_scale), steps)
        time_scale = jnp.maximum(time_scale, jnp.sqrt(model.floor[-1]))
    change, scatter, _ = _solve_regression(sums.gram[0], model, params.degree)
    curve = params.curve + jnp.einsum("kjb,kab->kja", to_powers(change), params.tril)
    curve = change_variable(curve, (params.time_loc - time_loc) / params.time_scale, time_scale / params.time_scale)
    tril = _update_factor(params.tril, scatter, sums.mass, mass, model)
    new = Parameters(jnp.log(sums.mass) - jnp.log(sums.mass.sum()), time_loc, time_scale, curve, tril)
    usable = (sums.mass > 0) & (time_scale > 0)
    usable = usable & jnp.isfinite(tril).all((-2, -1)) & jnp.isfinite(curve).all((-2, -1))
    choose = lambda z, old: jnp.where(usable.reshape(-1, *[1] * (z.ndim - 1)), z, old)  # noqa: E731
    return jax.tree.map(choose, new, params)._replace(log_weights=new.log_weights), ~usable


def residual_scatter(sums: SufficientStatistics, params: Parameters, model: Model) -> Float[Array, "k p p"]:
    """The whitened residuals' scatter about the best curves of the model's degrees, which may be lower than now."""
    rows = jnp.asarray(np.linalg.inv(hermite_to_powers(params.degree)), params.curve.dtype)
    whitened = jnp.einsum("kab,kjb->kja", inverse_lower(params.tril), params.curve)
    whole = jnp.einsum("ij,kja->kia", rows, whitened)  # the current curve in Hermite polynomials
    # Residuals are from the current curve; powers removed from it are added back to them.
    over = jnp.arange(params.degree + 1, dtype=model.degrees.dtype)[None] > model.degrees[:, None]
    back = jnp.where(over[:, :, None], whole, 0)
    size, dim = params.degree + 1, params.tril.shape[-1]
    eye = jnp.broadcast_to(jnp.eye(size + dim, dtype=back.dtype)[None], (len(back), size + dim, size + dim))
    change = eye.at[:, :size, size:].set(back)  # (basis, residual) -> (basis, residual + back' basis)
    return _solve_regression(jnp.einsum("kia,kij,kjb->kab", change, sums.gram[0], change), model, params.degree)[1]


def _solve_regression(gram, model: Model, degree: int):
    """The change of the curve (k, q+1, p), in Hermite polynomials and whitened space; the residuals' scatter (k, p, p);
    and the inverse of the design's Cholesky factor, 0 for powers above a component's degree."""
    active = jnp.arange(degree + 1, dtype=model.degrees.dtype)[None] <= model.degrees[:, None]
    pairs = active[:, :, None] & active[:, None]
    design = jnp.where(pairs, gram[:, : degree + 1, : degree + 1], 0)
    cross = jnp.where(active[:, :, None], gram[:, : degree + 1, degree + 1 :], 0)
    total = gram[:, degree + 1 :, degree + 1 :]
    # A proximal term of the size of rounding: a polynomial that the times do not determine stays unchanged. The scatter
    # is that of this curve, and so never larger than before.
    largest = jnp.max(jnp.diagonal(design, axis1=1, axis2=2), axis=1)
    ridge = jnp.where(active, 32 * jnp.finfo(gram.dtype).eps * largest[:, None], 0)
    ridge = jnp.where(active & (largest > 0)[:, None], ridge, 1)
    eye = jnp.eye(degree + 1, dtype=gram.dtype)
    inverse = inverse_lower(cholesky(design + ridge[:, :, None] * eye[None]))
    change = jnp.einsum("kba,kbc,kcd->kad", inverse, inverse, cross)
    change = jnp.where(jnp.isfinite(change).all((1, 2), keepdims=True), change, 0)
    both = jnp.einsum("kja,kjb->kab", change, cross)
    scatter = total - both - jnp.swapaxes(both, 1, 2) + jnp.einsum("kia,kij,kjb->kab", change, design, change)
    return change, scatter, jnp.where(active[:, None, :], inverse, 0)


def _update_factor(tril, scatter, true_mass, mass, model: Model) -> Float[Array, "k p p"]:
    """The factor of Sigma, from the current one and the scatter of whitened residuals: that is near the identity, so
    that strong correlations cost no digits."""
    dim = tril.shape[-1]
    floor, eye = model.floor[:-1], jnp.eye(dim, dtype=tril.dtype)[None]
    if model.covariance == "diag":
        variance = jnp.diagonal(tril, axis1=1, axis2=2) ** 2 * jnp.diagonal(scatter, axis1=1, axis2=2) / mass[:, None]
        return jnp.sqrt(variance + floor[None])[:, :, None] * eye
    if model.covariance == "spherical":
        trace = (jnp.diagonal(tril, axis1=1, axis2=2) ** 2 * jnp.diagonal(scatter, axis1=1, axis2=2)).sum(1)
        return jnp.sqrt(trace / (dim * mass) + floor.mean())[:, None, None] * eye
    if model.covariance == "tied":
        scatter = jnp.broadcast_to(scatter.sum(0)[None], scatter.shape)
        mass = jnp.broadcast_to(true_mass.sum()[None], mass.shape)
    whitening = inverse_lower(tril)
    added = jnp.einsum("kab,b,kcb->kac", whitening, floor, whitening)
    return jnp.einsum("kab,kbc->kac", tril, cholesky(scatter / mass[:, None, None] + added))


# --- steps of the times, where the envelope depends on them ----------------------------------------------------


def profile_log_likelihood(
    sums: SufficientStatistics, model: Model, degree: int, steps: Float[Array, "2 k"], gram, log_a
) -> Float[Array, " k"]:
    """The expected log-likelihood of each component with space in closed form, up to a constant.

    `gram` and `log_a` are those at the stepped times. A tied Sigma is fixed, as a single component cannot change it.
    """
    mass = jnp.where(sums.mass > 0, sums.mass, 1)
    _, scatter, _ = _solve_regression(gram, model, degree)
    dim = scatter.shape[-1]
    square = jnp.exp(-2 * steps[1]) * (sums.second + 2 * steps[0] * sums.first + steps[0] ** 2 * sums.mass)
    value = -0.5 * square - sums.mass * steps[1] - 0.5 * dim * log_a
    diagonal = jnp.diagonal(scatter, axis1=1, axis2=2)
    if model.covariance == "tied":
        return value - 0.5 * diagonal.sum(1)
    if model.covariance == "full":
        return value - 0.5 * mass * log_det(cholesky(scatter / mass[:, None, None]))
    if model.covariance == "diag":
        return value - 0.5 * mass * jnp.log(diagonal / mass[:, None]).sum(1)
    return value - 0.5 * mass * dim * jnp.log(diagonal.sum(1) / mass)


def newton_step(
    sums: SufficientStatistics, model: Model, degree: int
) -> tuple[Float[Array, "2 k"], Float[Array, " k"]]:
    """The Newton step of the times, and the gain that the profile predicts; 0 where it is undetermined."""
    (g0, g1), (h00, h01, h11) = _profile_derivatives(sums, model, degree)
    a, b, c = -h00, -h01, -h11
    least = 0.5 * (a + c) - jnp.hypot(0.5 * (a - c), b)  # the smaller eigenvalue
    lift = jnp.maximum(_MIN_CURVATURE * sums.mass - least, 0)
    a, c = a + lift, c + lift
    det = a * c - b * b
    safe = jnp.where(det > 0, det, 1)
    steps = jnp.stack([c * g0 - b * g1, a * g1 - b * g0]) / safe[None]
    longest = jnp.abs(steps).max(0)
    steps = steps * jnp.where(longest > _MAX_STEP, _MAX_STEP / longest, 1)[None]
    usable = (det > 0) & jnp.isfinite(steps).all(0)
    steps = jnp.where(usable[None], steps, 0)
    return steps, jnp.where(usable, g0 * steps[0] + g1 * steps[1], 0)


def _profile_derivatives(sums: SufficientStatistics, model: Model, degree: int):
    """First and second derivatives of `profile_log_likelihood` by the steps, at 0.

    The scatter is the Schur complement M' G M of the gram, M = (-change, I). As the change is a minimum, its first
    derivative is M' G_i M, and the second M' G_ij M - B_i' D^-1 B_j - B_j' D^-1 B_i, B_i the design's rows of G_i M.
    """
    mass, dim = jnp.where(sums.mass > 0, sums.mass, 1), sums.gram.shape[-1] - degree - 1
    change, scatter, inverse = _solve_regression(sums.gram[0], model, degree)
    eye = jnp.broadcast_to(jnp.eye(dim, dtype=change.dtype), (*change.shape[:1], dim, dim))
    complement = jnp.concatenate([-change, eye], axis=1)
    of_design = jnp.einsum("okab,kbc->okac", sums.gram[1:], complement)
    rows = jnp.einsum("kij,okjc->okic", inverse, of_design[:2, :, : degree + 1])
    first = jnp.einsum("kab,okac->okbc", complement, of_design)
    twice = [2 * jnp.einsum("kia,kib->kab", rows[i], rows[j]) for i, j in ((0, 0), (0, 1), (1, 1))]
    second = first[2:] - 0.5 * jnp.stack([x + jnp.swapaxes(x, 1, 2) for x in twice])
    first, second = (_relative_change(s, scatter, mass, model) for s in (first[:2], second))
    trace = lambda s: jnp.diagonal(s, axis1=-2, axis2=-1).sum(-1)  # noqa: E731
    slopes = -0.5 * mass[None] * trace(first) - 0.5 * dim * sums.log_a[1:3]
    curvatures = trace(second)
    if model.covariance != "tied":  # the second derivative of the logarithm itself
        product = lambda i, j: (first[i] * first[j]).sum((-2, -1))  # noqa: E731
        curvatures = curvatures - jnp.stack([product(0, 0), product(0, 1), product(1, 1)])
    curvatures = -0.5 * mass[None] * curvatures - 0.5 * dim * sums.log_a[3:]
    slopes = slopes + jnp.stack([-sums.first, sums.second - sums.mass])
    return slopes, curvatures + jnp.stack([-sums.mass, 2 * sums.first, -2 * sums.second])


def _relative_change(change, scatter, mass, model: Model):
    """Changes of the scatter relative to the scatter, restricted to the kind of covariance."""
    if model.covariance == "tied":
        return change / mass[None, :, None, None]
    diagonal = jnp.diagonal(scatter, axis1=-2, axis2=-1)
    eye = jnp.eye(scatter.shape[-1], dtype=scatter.dtype)[None, None]
    if model.covariance == "diag":
        return change * eye / diagonal[None, :, :, None]
    if model.covariance == "spherical":
        traces = jnp.diagonal(change, axis1=-2, axis2=-1).sum(-1) / diagonal.sum(-1)[None]
        return traces[..., None, None] * eye
    whitening = inverse_lower(cholesky(scatter))
    return jnp.einsum("kab,okbc,kdc->okad", whitening, change, whitening)
