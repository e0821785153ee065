"""The Folded-Gaussian distribution FN(m, Sigma, a, f) of the VeGaS paper.

It is not the |X| "folded normal" of scipy and numpyro: here the *center* of a Gaussian moves along a curve in time.
Labels such as eq:foldgauss are those of the LaTeX source of the paper, arXiv:2411.11024.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from foldgauss._numerics.batch import (
    BatchModule,
    align,
    as_event,
    as_sample_shape,
    as_value,
    batch_shape_of,
    broadcast,
    broadcast_leaves,
    cast,
    check_batch,
    check_finite,
    check_positive,
    common_dtype,
    compile_eager,
    expand_leaves,
    ranked_leaves,
)
from foldgauss._numerics.factor import check_loc, check_rest, marginal_tril, normalize_indices, resolve_scale_tril
from foldgauss._numerics.triangular import join_columns, multiply_lower, solve_lower, split_columns
from foldgauss._runtime import notebook_hooks
from foldgauss._runtime.checks import invalid
from foldgauss.analysis import interop, moments
from foldgauss.analysis.conditional import TimeDensity, TimeMixture, conditional_gaussian, time_density, time_mixture
from foldgauss.envelope import AbstractEnvelope, TimeLikelihood, as_envelope, check_peak
from foldgauss.fold import AbstractFold, ZeroFold, as_fold, evaluate_shift, restrict_fold
from foldgauss.gaussian import Gaussian, Normal, times_exp

__all__ = ["FoldedGaussian", "Gaussian", "Normal"]


class FoldedGaussian(BatchModule):
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
        self.loc, self.scale_tril, self.time_loc, self.time_scale = broadcast(parts, batch)
        self.envelope = broadcast_leaves(envelope, batch)
        # Parameters of a callable (say a network) are not copied per component: they keep axes of size 1.
        self.fold = expand_leaves(fold, len(batch)) if fold.shares_leaves else broadcast_leaves(fold, batch)
        if validate_args:
            check_peak(self.envelope, self.time_loc, self.time_scale)

    @property
    def event_shape(self) -> tuple[int, ...]:
        return (self.loc.shape[-1] + 1,)

    has_rsample = True  #: draws are differentiable in the parameters

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Broadcast leading dimensions of all leaves, including those of the fold and the envelope."""
        return batch_shape_of(ranked_leaves(self))

    @property
    def time_marginal(self) -> Normal:
        """The distribution of t alone, N(time_loc, time_scale^2): a `Normal`, with `event_shape == ()`.

        **Source:** eq:integral_proof.
        """
        return Normal(self.time_loc, self.time_scale, validate_args=False)

    def condition_time(self, t: Float[Array, "*#batch"]) -> Gaussian:
        """The Gaussian of space at time t. The fold equation is implemented here only.

            s | t ~ N(loc + f(time_loc - t), a(t) Sigma)

        **Shapes:** t (*batch,), broadcast; the result has `event_shape == (d-1,)`.

        **Example:** `dist.condition_time(0.25).sample(key)`

        **Source:** eq:cond_dens, eq:cond_proof. Far from `time_loc`, `scale_tril` may underflow to 0; the density does
        not use it, but `log_scale`.
        """
        t = as_value(t, self.loc.dtype)
        dist = expand_leaves(self, t.ndim)
        (t,) = align([(t, 0)], dist.time_loc.ndim)
        shift = evaluate_shift(dist.fold, dist.time_loc - t)
        log_a = dist.envelope.log_a(t, time_loc=dist.time_loc, time_scale=dist.time_scale)
        largest = float(jnp.finfo(log_a.dtype).max) * 1e-3  # log a = -inf would give inf - inf in the density
        log_a = jnp.clip(log_a, -largest, largest)
        return Gaussian(dist.loc + shift, dist.scale_tril, log_scale=0.5 * log_a, validate_args=False)

    def log_prob(self, value: Float[Array, "*#batch d"]) -> Float[Array, "*#batch"]:
        """log FN(x) = log N(s | t) + log N(t), by the chain rule.

        **Shapes:** value (*sample, *batch, d), time last -> (*sample, *batch). **Units:** log of 1 / (space^(d-1)
        time).

        **Example:** `dist.log_prob(jnp.array([0.1, -0.2, 0.5]))`

        **Source:** eq:foldgauss. **Raises:** ValueError if the last dimension of value is not d.
        """
        return self._log_prob(as_event("value", value, self.loc.dtype, self.event_shape))

    @compile_eager
    def _log_prob(self, value: Array) -> Array:
        s, t = value[..., :-1], value[..., -1]
        log_time = self.time_marginal.log_prob(t)
        overflow = jnp.isinf(self.condition_time(t).loc).any(-1)
        # Double where: at times where the fold overflows, gradients are taken at f(0) instead.
        near, time_loc = align([(t, 0), (self.time_loc, 0)], overflow.ndim)
        log_space = self.condition_time(jnp.where(overflow, time_loc, near)).log_prob(s)
        unreachable = overflow | jnp.isneginf(log_space) | jnp.isneginf(log_time)
        return jnp.where(unreachable, -jnp.inf, log_space + log_time)

    def pdf(self, value: Float[Array, "*#batch d"]) -> Float[Array, "*#batch"]:
        """FN(x), shapes as in `log_prob`. **Source:** eq:foldgauss."""
        return jnp.exp(self.log_prob(value))

    def sample(self, key: Key[Array, ""], sample_shape: int | tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Random samples x = (s, t): first t, then s given t; differentiable in all parameters.

        **Shapes:** -> (*sample_shape, *batch, d), time last; a number n as `sample_shape` is (n,).

        **Example:** `dist.sample(jax.random.key(0), 1000)`

        **Source:** eq:foldgauss, by ancestral sampling.
        """
        return self._sample(key, as_sample_shape(sample_shape))

    @compile_eager(static=("sample_shape",))
    def _sample(self, key: Key[Array, ""], sample_shape: tuple[int, ...]) -> Array:
        time_key, space_key = jax.random.split(key)
        # Every batch element has its own t, even where only loc or the fold has batch dimensions.
        shape = (*sample_shape, *self.batch_shape)
        noise = jax.random.normal(time_key, shape, self.loc.dtype)
        noise, time_loc, time_scale = align([(noise, 0), (self.time_loc, 0), (self.time_scale, 0)])
        t = time_loc + time_scale * noise
        s = self.condition_time(t).sample(space_key)
        return jnp.concatenate([s, t[..., None]], axis=-1)

    # --- whitening ------------------------------------------------------------------------------------------

    def fold_to_normal(self, x: Float[Array, "*#batch d"]) -> tuple[Float[Array, "*#batch d"], Float[Array, "*#batch"]]:
        """Whiten x: subtract the fold, then scale. Samples of the distribution become standard normal.

            z = (L^-1 (s - loc - f(time_loc - t)) / sqrt(a(t)), (t - time_loc) / time_scale),   log |dz/dx|

        **Shapes:** x (*sample, *batch, d) -> the same and (*sample, *batch). **Units:** none.

        **Example:** `z, log_det = dist.fold_to_normal(x)  # log_prob(x) = sum log N(z) + log_det`

        **Source:** eq:transform_s. **Raises:** ValueError if the last dimension of x is not d.
        """
        return self._fold_to_normal(self._broadcast_value(x))

    @compile_eager
    def _fold_to_normal(self, x: Array) -> tuple[Array, Array]:
        at = self.condition_time(x[..., -1])
        z, log_det = _whiten(at, x[..., :-1])
        loc, scale = (jnp.broadcast_to(y, log_det.shape) for y in (self.time_loc, self.time_scale))
        z = jnp.concatenate([z, ((x[..., -1] - loc) / scale)[..., None]], axis=-1)
        return z, log_det - jnp.log(scale)

    def normal_to_fold(self, z: Float[Array, "*#batch d"]) -> tuple[Float[Array, "*#batch d"], Float[Array, "*#batch"]]:
        """The inverse of `fold_to_normal`: x, and log |dx/dz|.

        **Shapes:** z (*sample, *batch, d) -> the same and (*sample, *batch).

        **Example:** `dist.normal_to_fold(jax.random.normal(key, (1000, 3)))[0]  # samples`

        **Source:** eq:transform_s. **Raises:** ValueError if the last dimension of z is not d.
        """
        return self._normal_to_fold(self._broadcast_value(z))

    @compile_eager
    def _normal_to_fold(self, z: Array) -> tuple[Array, Array]:
        loc, scale = (jnp.broadcast_to(y, z.shape[:-1]) for y in (self.time_loc, self.time_scale))
        t = loc + scale * z[..., -1]
        s, log_det = _unwhiten(self.condition_time(t), z[..., :-1])
        return jnp.concatenate([s, t[..., None]], axis=-1), log_det + jnp.log(scale)

    def _broadcast_value(self, x) -> Array:
        """x, checked, with all batch dimensions."""
        x = as_event("x", x, self.loc.dtype, self.event_shape)
        return jnp.broadcast_to(x, (*jnp.broadcast_shapes(x.shape[:-1], self.batch_shape), *self.event_shape))

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
    def mean(self) -> Float[Array, "*batch d"]:
        """E x, as `moments`."""
        return self.moments()[0]

    @property
    def variance(self) -> Float[Array, "*batch d"]:
        """Var x per coordinate, as `moments`."""
        return jnp.diagonal(self.moments()[1], axis1=-2, axis2=-1)

    @property
    def stddev(self) -> Float[Array, "*batch d"]:
        """Standard deviations of the coordinates, as `moments`."""
        return jnp.sqrt(self.variance)

    @property
    def covariance_matrix(self) -> Float[Array, "*batch d d"]:
        """Cov x of space and time jointly, as `moments`; for space at one time use `condition_time(t)`."""
        return self.moments()[1]

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

        If time is among them it is exact, a FoldedGaussian (time alone: a Gaussian); otherwise it is outside the
        family: a `TimeMixture`, integrated numerically.

        **Shapes:** `indices`: integers in the order of the result, time last; -1 is time.

        **Example:** `dist.marginal([0, -1])  # first space coordinate, and time`

        **Source:** eq:integral_proof. **Raises:** ValueError on invalid indices.
        """
        indices = normalize_indices(indices, self.event_shape[0])
        space = tuple(i for i in indices if i != self._time_index)
        if len(space) == len(indices):
            return time_mixture(self, space, (), jnp.zeros((0,), self.loc.dtype), keeps_time=False)
        if indices[-1] != self._time_index:
            raise invalid("indices", expected="time last", got=repr(indices), cure="Time is the last coordinate.")
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
        values = as_event("values", values, self.loc.dtype, (len(indices),))
        rest = tuple(i for i in range(self._time_index) if i not in indices)
        if self._time_index not in indices:
            return time_mixture(self, rest, indices, values, keeps_time=True)
        check_rest(rest)
        where = indices.index(self._time_index)
        given = tuple(i for i in indices if i != self._time_index)
        ordered = self.marginal((*given, *rest, self._time_index))
        others = values[..., np.array([k for k in range(len(indices)) if k != where], int)]
        return conditional_gaussian(ordered, others, values[..., where])

    def time_given_space(self, s: Float[Array, "*#batch d-1"]) -> TimeDensity:
        """The density of time given space, by quadrature: its modes, samples, quantiles and moments.

        **Shapes:** s (*batch, d-1); the result has `event_shape == ()`.

        **Example:** `dist.time_given_space([0.1, -0.4]).modes()`

        **Source:** Bayes' rule on eq:foldgauss. **Raises:** ValueError if the last dimension of s is not d-1.
        """
        return time_density(self, as_event("s", s, self.loc.dtype, self.loc.shape[-1:]))

    @property
    def _time_index(self) -> int:
        return self.event_shape[0] - 1

    # --- interoperability and display ---------------------------------------------------------------------------

    def to_numpyro(self, *, validate_args: bool | None = None):
        """This distribution as a numpyro distribution: see `foldgauss.analysis.interop.to_numpyro`."""
        return interop.to_numpyro(self, validate_args=validate_args)

    def to_scipy(self):
        """This distribution as a frozen scipy distribution: see `foldgauss.analysis.interop.to_scipy`."""
        return interop.to_scipy(self)

    def _repr_png_(self) -> bytes | None:
        """Notebook display: the density over time and space, by coordinates if there are several."""
        return notebook_hooks.show("distribution", self)


def _whiten(at: Gaussian, s: Array) -> tuple[Array, Array]:
    """Standard normal coordinates of s, and log |dz/ds|."""
    y = join_columns(solve_lower(at.base_tril, split_columns(s - at.loc)))
    return times_exp(y, -at.log_scale[..., None]), -_log_det(at)


def _unwhiten(at: Gaussian, z: Array) -> tuple[Array, Array]:
    """The inverse of `_whiten`: s, and log |ds/dz|."""
    y = join_columns(multiply_lower(at.base_tril, split_columns(z)))
    return at.loc + times_exp(y, at.log_scale[..., None]), _log_det(at)


def _log_det(at: Gaussian) -> Array:
    log_diagonal = jnp.log(jnp.diagonal(at.base_tril, axis1=-2, axis2=-1)).sum(-1)
    return jnp.broadcast_to(log_diagonal + at.loc.shape[-1] * at.log_scale, at.batch_shape)


def _check_fold(fold: AbstractFold, loc: Array) -> AbstractFold:
    shape = jax.eval_shape(fold, jax.ShapeDtypeStruct((), loc.dtype)).shape
    if shape[-1:] != loc.shape[-1:]:
        expected = f"shifts of shape (*batch, {loc.shape[-1]})"
        raise invalid("fold", expected=expected, got=f"shape {shape}", cure="It maps u to d-1 space coordinates.")
    return fold
