"""The Folded-Gaussian distribution FN(m, Sigma, a, f) of the VeGaS paper.

It is not the |X| "folded normal" of scipy and numpyro: here the *center* of a Gaussian moves along a curve in time.
Labels such as eq:foldgauss are those of the LaTeX source of the paper, arXiv:2411.11024.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from foldgauss._numerics.abstract import AbstractDistribution
from foldgauss._numerics.batch import (
    align_leaves,
    as_event,
    as_value,
    broadcast_leaves,
    cast,
    check_batch,
    check_finite,
    check_positive,
    common_dtype,
    compile_eager,
    ranked_leaves,
    vectorize,
    vectorized,
)
from foldgauss._numerics.factor import check_loc, check_rest, marginal_tril, normalize_indices, resolve_scale_tril
from foldgauss._runtime.checks import require
from foldgauss.analysis import moments
from foldgauss.analysis.conditional import TimeMixture, conditional_gaussian, time_mixture
from foldgauss.envelope import AbstractEnvelope, TimeLikelihood, as_envelope, check_peak
from foldgauss.fold import AbstractFold, CallableFold, ZeroFold, as_fold, evaluate_shift, restrict_fold
from foldgauss.gaussian import Gaussian, log_density, sample_components

__all__ = ["FoldedGaussian", "Gaussian"]


class FoldedGaussian(AbstractDistribution):
    """The Folded-Gaussian distribution of x = (s, t), space s in R^(d-1) and time t **last**.

        t     ~ N(time_loc, time_scale^2)
        s | t ~ N(loc + f(time_loc - t), a(t) Sigma),      Sigma = scale_tril scale_tril^T
        FN(x) = N(s | t) N(t)

    Note the sign of the fold's argument. The default envelope is that of the paper's text, `TimeLikelihood(power=1)`;
    the paper's published code uses `TimeLikelihood(power=2)`.

    **Shapes:** `loc` (*batch, d-1); exactly one of `scale_tril`, `covariance_matrix`, `precision_matrix`
    (*batch, d-1, d-1) and `scale` (*batch, d-1), the paper's standard deviations per coordinate; `time_loc`,
    `time_scale` (*batch,); leading dimensions broadcast. `event_shape == (d,)`. `fold` is a fold (None is
    `ZeroFold`) or any callable from one scalar u to (d-1,). `envelope` is an envelope or any callable from scalars
    (t, time_loc, time_scale) to log a; wrap a callable that returns a itself in `envelope.plain_envelope`.

    **Units:** space for `loc` and `scale_tril`, time for `time_loc` and `time_scale`.

    **dtype:** that of `loc`, `scale_tril`, `time_loc`, `time_scale` (Python numbers follow); the leaves of
    fold and envelope are cast to it.

    **Example:**

        bend = PolynomialFold([[0.0], [1.0]])  # f(u) = u^2
        dist = FoldedGaussian([0.0], [[0.2]], time_loc=0.5, time_scale=0.3, fold=bend)
        x = dist.sample(jax.random.key(0), (1000,))  # (1000, 2)
        dist.condition_time(0.8).loc                 # [0.09] = f(0.5 - 0.8)

    **Source:** eq:foldgauss with eq:cond_dens. **Raises:** ValueError that names the parameter. Shapes
    are always checked, values (finite numbers, positive `time_scale`, a valid factor or covariance, log a <= 0 at
    `time_loc`) unless they are traced or `validate_args=False`.
    """

    loc: Float[Array, "*#batch d-1"]
    scale_tril: Float[Array, "*#batch d-1 d-1"]
    time_loc: Float[Array, "*#batch"]
    time_scale: Float[Array, "*#batch"]
    fold: AbstractFold
    envelope: AbstractEnvelope

    def __init__(
        self,
        loc: ArrayLike,
        scale_tril: ArrayLike | None = None,
        *,
        covariance_matrix: ArrayLike | None = None,
        precision_matrix: ArrayLike | None = None,
        scale: ArrayLike | None = None,
        time_loc: ArrayLike,
        time_scale: ArrayLike,
        fold=None,
        envelope=None,
        validate_args: bool = True,
    ):
        given = {
            "scale_tril": scale_tril,
            "covariance_matrix": covariance_matrix,
            "precision_matrix": precision_matrix,
            "scale": scale,
        }
        dtype = common_dtype(loc, *(x for x in given.values() if x is not None), time_loc, time_scale)
        loc, time_loc, time_scale = (jnp.asarray(x, dtype) for x in (loc, time_loc, time_scale))
        check_loc(loc)
        tril = resolve_scale_tril(given, dim=loc.shape[-1], dtype=dtype, validate=validate_args)
        if validate_args:
            check_finite("loc", loc)
            check_finite("time_loc", time_loc)
            check_positive("time_scale", time_scale)
        fold = ZeroFold(loc.shape[-1]) if fold is None else as_fold(fold)
        fold = _check_fold(cast(fold, dtype), loc)
        envelope = TimeLikelihood(power=1.0) if envelope is None else envelope
        envelope = cast(as_envelope(envelope), dtype)
        # Every leaf has all batch dimensions, so that slices, `vmap` over the distribution, and an axis that `vmap`
        # over this constructor adds in front are well defined.
        parts = [(loc, 1), (tril, 2), (time_loc, 0), (time_scale, 0)]
        batch = check_batch([*parts, *ranked_leaves(fold), *ranked_leaves(envelope)])
        self.loc, self.scale_tril, self.time_loc, self.time_scale = (
            jnp.broadcast_to(x, batch + x.shape[x.ndim - rank :]) for x, rank in parts
        )
        self.envelope = broadcast_leaves(envelope, batch)
        # Parameters of a callable (say a network) are not copied per component: they keep axes of size 1.
        self.fold = align_leaves(fold, len(batch)) if fold.shares_leaves else broadcast_leaves(fold, batch)
        if validate_args:
            check_peak(self.envelope, self.time_loc, self.time_scale)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return (self.loc.shape[-1] + 1,)

    def condition_time(self, t: Float[Array, "*#batch"]) -> Gaussian:
        """The Gaussian of space at time t. The fold equation is implemented here only.

            s | t ~ N(loc + f(time_loc - t), a(t) Sigma)

        **Shapes:** t (*batch,), broadcast; the result has `event_shape == (d-1,)`.

        **Example:** `dist.condition_time(0.25).sample(key)`

        **Source:** eq:cond_dens, eq:cond_proof. Far from `time_loc`, `scale_tril` may underflow to 0; the density does
        not use it, but `log_scale`.
        """
        loc, log_scale = self._condition_time(as_value(t, self.dtype))
        return Gaussian(loc, self.scale_tril, log_scale=log_scale, validate_args=False)

    @compile_eager
    @vectorized(0)
    def _condition_time(self, t: Array) -> tuple[Array, Array]:
        at = self._at(t)
        return at.loc, at.log_scale

    def _at(self, t: Float[Array, ""]) -> Gaussian:
        """`condition_time` of one distribution and time."""
        shift = evaluate_shift(self.fold, self.time_loc - t)
        log_a = self.envelope.log_a(t, time_loc=self.time_loc, time_scale=self.time_scale)
        largest = float(jnp.finfo(log_a.dtype).max) * 1e-3  # log a = -inf would give inf - inf in the density
        log_a = jnp.clip(log_a, -largest, largest)
        return Gaussian(self.loc + shift, self.scale_tril, log_scale=0.5 * log_a, validate_args=False)

    @compile_eager
    @vectorized(1)
    def _log_prob(self, x: Array) -> Array:
        # log FN(x) = log N(s | t) + log N(t), by the chain rule (eq:foldgauss).
        s, t = x[:-1], x[-1]
        log_time = log_density(self.marginal([-1]), t[None])
        overflow = jnp.isinf(self._at(t).loc).any()
        # Double where: at times where the fold overflows, gradients are taken at f(0) instead.
        log_space = log_density(self._at(jnp.where(overflow, self.time_loc, t)), s)
        unreachable = overflow | jnp.isneginf(log_space) | jnp.isneginf(log_time)
        return jnp.where(unreachable, -jnp.inf, log_space + log_time)

    @compile_eager(static=("sample_shape",))
    def _sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...]) -> Array:
        # Every batch element has its own t, even where only loc or the fold has batch dimensions.
        noise = self._draw_noise(key, (*sample_shape, *self.batch_shape))
        return vectorize(FoldedGaussian._transform, self, *noise)

    def _draw_noise(self, key: Key[Array, ""], shape: tuple[int, ...]) -> list[tuple[Array, int]]:
        time_key, space_key = jax.random.split(key)
        space = jax.random.normal(space_key, (*shape, self.loc.shape[-1]), self.dtype)
        return [(space, 1), (jax.random.normal(time_key, shape, self.dtype), 0)]

    def _transform(self, noise: Float[Array, " d-1"], tau: Float[Array, ""]) -> Float[Array, " d"]:
        """Standard normal numbers as a sample, of one distribution."""
        t = self.time_loc + self.time_scale * tau
        return jnp.append(self._at(t)._transform(noise), t)

    def _sample_from(self, key: Key[Array, ""], sample_shape: tuple[int, ...], component: Array) -> Array:
        # One network in each of many samples would be copied for all.
        every = isinstance(self.fold, CallableFold)
        return super()._sample_from(key, sample_shape, component) if every else sample_components(self, key, component)

    def normal_to_fold(self, z: Float[Array, "*#batch d"]) -> Float[Array, "*#batch d"]:
        """Transform standard normal points to points of the distribution.

            t = time_loc + time_scale z_d,   s = loc + f(time_loc - t) + sqrt(a(t)) L (z_1, ..., z_(d-1))

        **Shapes:** z (*sample, *batch, d) -> the same.

        **Example:** `dist.normal_to_fold(jax.random.normal(key, (1000, 3)))  # samples`

        **Source:** eq:transform_s. **Raises:** ValueError if the last dimension of z is not d.
        """
        return self._normal_to_fold(self._checked(z, "z"))

    @compile_eager
    @vectorized(1)
    def _normal_to_fold(self, z: Array) -> Array:
        return self._transform(z[:-1], z[-1])

    # --- moments --------------------------------------------------------------------------------------------

    def moments(self, *, with_error: bool = False) -> tuple[Array, ...]:
        """Mean and covariance of x = (s, t).

            E s = loc + E f(u),  Cov s = E[a] Sigma + Cov f(u),  Cov(s, t) = -E[f(u) u],  u ~ N(0, time_scale^2)

        Exact for zero, polynomial and Fourier folds and built-in envelopes, else by adaptive quadrature: to rounding
        for splines and shared paths, whose knots are known. `with_error` appends the estimated error of the parts from
        f and a, in standard deviations (products of them, for covariances). A RuntimeWarning is raised if it exceeds
        5e-7 (1.7e-3 in float32), unless traced.

        **Shapes:** (*batch, d), (*batch, d, d) and (*batch,). **Example:** `mean, covariance = dist.moments()`

        **Source:** eq:cond_dens, by total mean and covariance.
        """
        return moments.moments(self, with_error=with_error)

    @property
    def mode(self) -> Float[Array, "*batch d"]:
        """The maximum of the density, (loc, time_loc), if it is unique.

        It is if `power (d-1) (1 - floor) < 2`, or, with a floor, `<= 2`. On the ridge s = loc + f(u) the density is
        proportional to exp(tau^2 (power (d-1) - 2) / 4), for `floor=0`.

        **Source:** eq:foldgauss at s = loc + f(u). **Raises:** ValueError if the density has a ridge of modes, two
        modes (a floor) or none (unbounded); under tracing the result is NaN instead.
        """
        return moments.mode(self)

    def entropy(self, *, with_error: bool = False) -> Array | tuple[Array, Array]:
        """Differential entropy, (*batch,); it does not depend on the fold.

            H = log(2 pi e time_scale^2) / 2 + log det(2 pi e Sigma) / 2 + (d-1) E[log a] / 2

        Exact without a floor, where E[log a] = -power / 2, else by adaptive quadrature. `with_error` appends the
        estimated error. A RuntimeWarning is raised as by `moments`. **Units:** nats.

        **Source:** the chain rule of eq:foldgauss. **Example:** `dist.entropy()`.
        """
        return moments.entropy(self, with_error=with_error)

    # --- marginal and conditional distributions -----------------------------------------------------------------

    def marginal(self, indices) -> "FoldedGaussian | Gaussian | TimeMixture":
        """The marginal distribution of the coordinates `indices`.

        If time is among them it is exact, a FoldedGaussian, or a Gaussian of one coordinate for time alone; otherwise
        it is outside the family: a `TimeMixture`, integrated numerically.

        **Shapes:** `indices`: integers in the order of the result, time last; -1 is time.

        **Example:** `dist.marginal([0, -1])  # first space coordinate, and time`

        **Source:** eq:integral_proof. **Raises:** ValueError on invalid indices.
        """
        indices = normalize_indices(indices, self.event_shape[0])
        time = self.event_shape[0] - 1
        if indices == tuple(range(time + 1)):
            return self
        space = tuple(i for i in indices if i != time)
        if len(space) == len(indices):
            return time_mixture(self, space, (), jnp.zeros((0,), self.loc.dtype), keeps_time=False)
        require(
            indices[-1] == time, "indices", expected="time last", got=repr(indices), cure="Time is the last coordinate."
        )
        if not space:
            return Gaussian(self.time_loc[..., None], self.time_scale[..., None, None], validate_args=False)
        return FoldedGaussian(
            self.loc[..., np.array(space)],
            marginal_tril(self.scale_tril, space),
            time_loc=self.time_loc,
            time_scale=self.time_scale,
            fold=restrict_fold(self.fold, space),
            envelope=self.envelope,
            validate_args=False,
        )

    def condition(self, indices, values: ArrayLike) -> "Gaussian | TimeMixture":
        """The conditional distribution of the other coordinates, given these.

        If time is given it is exact, a Gaussian; otherwise it is outside the family: a `TimeMixture` of the other
        coordinates and time (last), integrated numerically.

        **Shapes:** `indices`: n integers, -1 is time; `values` (*batch, n) in the same order; the result has the
        other coordinates in ascending order. For one coordinate a number will do: `dist.condition(-1, 0.5)`.

        **Example:** `dist.condition([0], [0.3]).sample(key)  # the other space coordinates, and time`

        **Source:** eq:cond_dens. **Raises:** ValueError on invalid indices, all indices, or a wrong shape of values.
        """
        indices = normalize_indices(indices, self.event_shape[0])
        values = as_event("values", values, self.dtype, (len(indices),))
        time = self.event_shape[0] - 1
        rest = tuple(i for i in range(time) if i not in indices)
        if time not in indices:
            return time_mixture(self, rest, indices, values, keeps_time=True)
        check_rest(rest)
        given = tuple(i for i in indices if i != time)
        others = values[..., np.array([indices.index(i) for i in given], int)]
        return conditional_gaussian(self.marginal((*given, *rest, time)), others, values[..., indices.index(time)])

    def log_evidence(self, indices: tuple[int, ...], values: Array, rest: Gaussian | TimeMixture) -> Array:
        """The log-density of the values of these coordinates; `rest` is the distribution given them."""
        if isinstance(rest, TimeMixture):
            return rest.time.log_normalizer  # the integral is there already
        return super().log_evidence(indices, values, rest)

    def time_given_space(self, s: Float[Array, "*#batch d-1"]) -> TimeMixture:
        """The density of time given space, by quadrature: its modes, samples, quantiles and moments.

        **Shapes:** s (*batch, d-1); the result has `event_shape == (1,)`.

        **Example:** `dist.time_given_space([0.1, -0.4]).modes()`

        **Source:** Bayes' rule on eq:foldgauss. **Raises:** ValueError if the last dimension of s is not d-1.
        """
        return self.condition(range(self.loc.shape[-1]), as_event("s", s, self.dtype, self.loc.shape[-1:]))


def _check_fold(fold: AbstractFold, loc: Array) -> AbstractFold:
    shape = jax.eval_shape(fold, jax.ShapeDtypeStruct((), loc.dtype)).shape
    require(
        shape[-1:] == loc.shape[-1:],
        "fold",
        expected=f"shifts of shape (*batch, {loc.shape[-1]})",
        got=f"shape {shape}",
        cure="It maps u to d-1 space coordinates.",
    )
    return fold
