"""The update of the components from the sums of one pass: weighted regression in closed form, and steps of time.

Given (time_loc, time_scale), curve and Sigma are weighted least squares. For a constant envelope the times' own
update is the moments. For others `a` depends on the times, and moments *decrease* the likelihood: there they take a
step of Newton's method on the profiled expected log-likelihood (what is left of it once space is in closed form), and
only where that goes up: generalised EM.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from foldgauss._numerics.regression import hermite_to_powers
from foldgauss.estimator.em.cholesky import cholesky, inverse_lower, log_det
from foldgauss.estimator.em.components import Parameters, moved, to_powers
from foldgauss.estimator.em.statistics import Statistics, Times, time_steps

__all__ = ["Model", "newton_step", "profile", "residual_scatter", "updated"]

#: Longest step: half a time_scale, or a factor exp(0.5) of it.
_LONGEST = 0.5
#: Curvature is held above this share of a component's mass; a normal distribution's own is 1 and 2.
_LEAST_CURVATURE = 0.2


class Model(eqx.Module):
    """What is fitted, beside the parameters."""

    used: Int[Array, " k"]  # the degree of each component's polynomial, at most that of the arrays
    floor: Float[Array, " d"]  # variances added to those of each coordinate, time last
    covariance: str = eqx.field(static=True)  # full, diag, spherical, tied


def updated(
    params: Parameters, sums: Statistics, model: Model, steps: Float[Array, "2 k"] | None = None
) -> tuple[Parameters, Bool[Array, " k"]]:
    """The maximum given `sums`, and which components have none and stay: those without mass, or with a singular Sigma.

    The times are updated by moments, or by `steps` (see `time_steps`).
    """
    mass = jnp.where(sums.mass > 0, sums.mass, 1)
    if steps is None:
        first = sums.first / mass  # of v = (time_loc - t) / time_scale: centred at the present time
        variance = jnp.maximum(sums.second / mass - first * first, 0)
        time_loc = params.time_loc - params.time_scale * first
        time_scale = params.time_scale * jnp.sqrt(variance)
        time_scale = jnp.hypot(time_scale, jnp.sqrt(model.floor[-1]))
    else:
        time_loc, time_scale = time_steps(Times(params.time_loc, params.time_scale), steps)
        time_scale = jnp.maximum(time_scale, jnp.sqrt(model.floor[-1]))
    change, scatter = _regression(sums.gram[0], model, params.degree)
    curve = params.curve + jnp.einsum("kjb,kab->kja", to_powers(change), params.tril)
    curve = moved(curve, (params.time_loc - time_loc) / params.time_scale, time_scale / params.time_scale)
    tril = _factor(params.tril, scatter, sums.mass, mass, model)
    new = Parameters(jnp.log(sums.mass) - jnp.log(sums.mass.sum()), time_loc, time_scale, curve, tril)
    usable = (sums.mass > 0) & (time_scale > 0)
    usable = usable & jnp.isfinite(tril).all((-2, -1)) & jnp.isfinite(curve).all((-2, -1))
    choose = lambda z, old: jnp.where(usable.reshape(-1, *[1] * (z.ndim - 1)), z, old)  # noqa: E731
    return jax.tree.map(choose, new, params)._replace(log_weights=new.log_weights), ~usable


def _regression(gram, model: Model, degree: int) -> tuple[Float[Array, "k q+1 p"], Float[Array, "k p p"]]:
    """The change of the curve, in Hermite polynomials and whitened space, and the residuals' scatter."""
    return _solved(gram, model, degree)[:2]


def residual_scatter(sums: Statistics, params: Parameters, model: Model) -> Float[Array, "k p p"]:
    """The whitened residuals' scatter about the best curves of the model's degrees: lower ones than now, perhaps."""
    rows = jnp.asarray(np.linalg.inv(hermite_to_powers(params.degree)), params.curve.dtype)
    whitened = jnp.einsum("kab,kjb->kja", inverse_lower(params.tril), params.curve)
    whole = jnp.einsum("ij,kja->kia", rows, whitened)  # the present curve in Hermite polynomials
    # The residuals are those from the present curve; what is left out of it goes back into them.
    over = jnp.arange(params.degree + 1, dtype=model.used.dtype)[None] > model.used[:, None]
    back = jnp.where(over[:, :, None], whole, 0)
    size, dim = params.degree + 1, params.tril.shape[-1]
    eye = jnp.broadcast_to(jnp.eye(size + dim, dtype=back.dtype)[None], (len(back), size + dim, size + dim))
    change = eye.at[:, :size, size:].set(back)  # (basis, residual) -> (basis, residual + back' basis)
    return _solved(jnp.einsum("kia,kij,kjb->kab", change, sums.gram[0], change), model, params.degree)[1]


def _solved(gram, model: Model, degree: int):
    """`_regression`, and the inverse of the design's factor; what a lower degree leaves out is inert in it."""
    active = jnp.arange(degree + 1, dtype=model.used.dtype)[None] <= model.used[:, None]
    pairs = active[:, :, None] & active[:, None]
    design = jnp.where(pairs, gram[:, : degree + 1, : degree + 1], 0)
    cross = jnp.where(active[:, :, None], gram[:, : degree + 1, degree + 1 :], 0)
    total = gram[:, degree + 1 :, degree + 1 :]
    # A proximal term, at rounding: where the times do not determine the polynomial it stays as it is. The scatter is
    # that of this very curve, and so never larger than before.
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


def _factor(tril, scatter, true_mass, mass, model: Model) -> Float[Array, "k p p"]:
    """The factor of Sigma, made from the present one and what the whitened residuals say: near the identity, so that
    strong correlations cost no digits."""
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


# --- time, where the envelope hangs on it -------------------------------------------------------------------


def profile(sums: Statistics, model: Model, degree: int, steps: Float[Array, "2 k"], gram, log_a) -> Float[Array, " k"]:
    """The expected log-likelihood of each component with space in closed form, but for a constant.

    `gram` and `log_a` are those at the stepped times. With a tied Sigma: for the present one, as one component alone
    cannot change it.
    """
    mass = jnp.where(sums.mass > 0, sums.mass, 1)
    _, scatter = _regression(gram, model, degree)
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


def newton_step(sums: Statistics, model: Model, degree: int) -> tuple[Float[Array, "2 k"], Float[Array, " k"]]:
    """The step of time, and what the profile promises for it; 0 where there is nothing to be learned."""
    (g0, g1), (h00, h01, h11) = _slopes(sums, model, degree)
    a, b, c = -h00, -h01, -h11
    least = 0.5 * (a + c) - jnp.hypot(0.5 * (a - c), b)  # the smaller eigenvalue
    lift = jnp.maximum(_LEAST_CURVATURE * sums.mass - least, 0)
    a, c = a + lift, c + lift
    det = a * c - b * b
    safe = jnp.where(det > 0, det, 1)
    steps = jnp.stack([c * g0 - b * g1, a * g1 - b * g0]) / safe[None]
    longest = jnp.abs(steps).max(0)
    steps = steps * jnp.where(longest > _LONGEST, _LONGEST / longest, 1)[None]
    usable = (det > 0) & jnp.isfinite(steps).all(0)
    steps = jnp.where(usable[None], steps, 0)
    return steps, jnp.where(usable, g0 * steps[0] + g1 * steps[1], 0)


def _slopes(sums: Statistics, model: Model, degree: int):
    """First and second derivatives of `profile` by the steps, at 0.

    The scatter is the Schur complement M' G M of the gram, M = (-change, I). As the change is a minimum, its first
    derivative is M' G_i M, and the second M' G_ij M - B_i' D^-1 B_j - B_j' D^-1 B_i, B_i the design's rows of G_i M.
    """
    mass, dim = jnp.where(sums.mass > 0, sums.mass, 1), sums.gram.shape[-1] - degree - 1
    change, scatter, inverse = _solved(sums.gram[0], model, degree)
    eye = jnp.broadcast_to(jnp.eye(dim, dtype=change.dtype), (*change.shape[:1], dim, dim))
    complement = jnp.concatenate([-change, eye], axis=1)
    of_design = jnp.einsum("okab,kbc->okac", sums.gram[1:], complement)
    rows = jnp.einsum("kij,okjc->okic", inverse, of_design[:2, :, : degree + 1])
    first = jnp.einsum("kab,okac->okbc", complement, of_design)
    twice = [2 * jnp.einsum("kia,kib->kab", rows[i], rows[j]) for i, j in ((0, 0), (0, 1), (1, 1))]
    second = first[2:] - 0.5 * jnp.stack([x + jnp.swapaxes(x, 1, 2) for x in twice])
    first, second = (_relative(s, scatter, mass, model) for s in (first[:2], second))
    trace = lambda s: jnp.diagonal(s, axis1=-2, axis2=-1).sum(-1)  # noqa: E731
    slopes = -0.5 * mass[None] * trace(first) - 0.5 * dim * sums.log_a[1:3]
    bends = trace(second)
    if model.covariance != "tied":  # a logarithm's own bend
        product = lambda i, j: (first[i] * first[j]).sum((-2, -1))  # noqa: E731
        bends = bends - jnp.stack([product(0, 0), product(0, 1), product(1, 1)]) / (
            dim if model.covariance == "spherical" else 1
        )
    bends = -0.5 * mass[None] * bends - 0.5 * dim * sums.log_a[3:]
    slopes = slopes + jnp.stack([-sums.first, sums.second - sums.mass])
    return slopes, bends + jnp.stack([-sums.mass, 2 * sums.first, -2 * sums.second])


def _relative(change, scatter, mass, model: Model):
    """Changes of the scatter in units of the scatter itself, as the covariance's kind sees them."""
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
