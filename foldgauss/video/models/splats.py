"""Folded splats: Folded-Gaussians with opacity and color, the trainable parameters of a video."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt8

from foldgauss._numerics.batch import concrete_value
from foldgauss._runtime.checks import require
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import PolynomialFold, SharedPathFold, ZeroFold
from foldgauss.mixture import FoldedMixture
from foldgauss.render import Splats2D
from foldgauss.video.models.shared_paths import SharedPaths, move_splats

#: Degree-0 spherical harmonic, 1 / (2 sqrt(pi)): color = 0.5 + SH_C0 * color_dc, as in 3DGS.
SH_C0 = 0.28209479177387814
#: A Gaussian is rendered only where exp(-tau^2 / 2) exceeds this, as in the published VeGaS.
TIME_CUTOFF = 0.01
#: The same as a bound on |tau| = |t - m_t| / sigma_t: 3.03.
TAU_MAX = float(np.sqrt(-2 * np.log(TIME_CUTOFF)))
#: Opacity of the splat of a mixture's heaviest component; 1 would have an infinite logit.
PEAK_OPACITY = 0.99


class FoldedSplats(eqx.Module):
    """Folded Gaussians with opacity and color: raw leaves, before activation, in model space.

    Model space has its origin at the frame's center, x right, y down, and the frame's longer side is 1; time is [0, 1].

    | leaf | shape | becomes |
    |---|---|---|
    | `loc` | (num, 2) | m_s |
    | `log_scale` | (num, 2) | the two standard deviations, by exp |
    | `angle_logit` | (num,) | their rotation, by 2 pi sigmoid |
    | `time_loc_logit` | (num,) | m_t, by sigmoid |
    | `log_time_scale` | (num,) | sigma_t, by exp |
    | `coefficients` | (num, degree, 2) | the fold's c_k |
    | `opacity_logit` | (num,) | rho, by sigmoid |
    | `color_dc` | (num, 3) | 0.5 + 0.282 color_dc, not below 0 |
    | `path_index` | (num,) or None | the path that moves the Gaussian, from 1; 0 for none |

    `envelope`: the envelope of all Gaussians, with one power and one floor. `paths`: the motion that Gaussians share,
    by which those on a path are moved in addition; None without `path_index`.

    Source: VeGaS eq:vegas_equiv and "Implementation Details"; array order is depth order. Raises ValueError for an
    envelope with several powers or floors, and for paths without `path_index` or the reverse.
    """

    loc: Float[Array, "num 2"]
    log_scale: Float[Array, "num 2"]
    angle_logit: Float[Array, " num"]
    time_loc_logit: Float[Array, " num"]
    log_time_scale: Float[Array, " num"]
    coefficients: Float[Array, "num degree 2"]
    opacity_logit: Float[Array, " num"]
    color_dc: Float[Array, "num 3"]
    envelope: TimeLikelihood
    path_index: UInt8[Array, " num"] | None = None
    paths: SharedPaths | None = None

    def __check_init__(self):
        shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(self.envelope)]
        require(
            isinstance(self.envelope, TimeLikelihood) and shapes == [(), ()],
            "envelope",
            expected="a TimeLikelihood with one power and one floor for all Gaussians",
            got=f"{type(self.envelope).__name__} with parameters of shapes {shapes}",
            cure="Give each envelope a video of its own, and stack these by layers().",
        )
        require(
            (self.path_index is None) == (self.paths is None),
            "path_index",
            expected="one where there are paths, and only there",
            got="none" if self.path_index is None else "one without paths",
        )

    @property
    def num_gaussians(self) -> int:
        return self.loc.shape[0]

    @property
    def degree(self) -> int:
        return self.coefficients.shape[1]

    @property
    def degrees(self) -> Int[np.ndarray, " num"]:
        """Each Gaussian's last power whose coefficients are not both 0."""
        nonzero = (np.asarray(self.coefficients) != 0).any(axis=2)
        return (nonzero * np.arange(1, self.degree + 1)).max(axis=1, initial=0)

    def take(self, which: Bool[np.ndarray, " num"] | Int[np.ndarray, " num_new"]) -> "FoldedSplats":
        """The Gaussians of a mask or at these indices, in their order; all paths stay. Indices may repeat."""

        def index(leaf: Array) -> Array:
            # Not `jnp.asarray`, which compiles a program for each number of Gaussians.
            return leaf if leaf is self.paths or not np.ndim(leaf) else jax.device_put(np.asarray(leaf)[which])

        return jax.tree.map(index, self, is_leaf=lambda part: part is self.paths)

    def gaussians(self) -> FoldedGaussian:
        """The batch of Folded-Gaussians in the frame, batch shape (num,), event shape (3,).

        Those on a shared path have a `SharedPathFold`: their mean at each time is that of `at`. Their covariance is
        that of `at` at their own time m_t, L(m_t) Sigma L(m_t)^T, times the envelope; how the linear part L of the path
        changes while they are alive is left out.
        """
        unmoved = self._unmoved()
        if self.paths is None:
            return unmoved
        index = jnp.asarray(self.path_index)
        fold = SharedPathFold(
            unmoved.fold,
            self.loc,
            time_loc=unmoved.time_loc,
            index=index,
            times=self.paths.times,
            matrices=self.paths.matrices,
        )
        tril = _lower_factor(fold.maps(unmoved.time_loc)[..., :2] @ unmoved.scale_tril)
        return FoldedGaussian(
            fold.home,
            jnp.where((index > 0)[:, None, None], tril, unmoved.scale_tril),
            time_loc=unmoved.time_loc,
            time_scale=unmoved.time_scale,
            fold=fold,
            envelope=self.envelope,
        )

    def _unmoved(self) -> FoldedGaussian:
        """The Folded-Gaussians before `paths` move them, of covariance R S (R S)^T with R and S of eq:mirage."""
        angle = 2 * jnp.pi * jax.nn.sigmoid(self.angle_logit)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        rotation = jnp.stack([jnp.stack([cos, -sin], -1), jnp.stack([sin, cos], -1)], -2)
        return FoldedGaussian(
            self.loc,
            _lower_factor(rotation * jnp.exp(self.log_scale)[:, None]),
            time_loc=jax.nn.sigmoid(self.time_loc_logit),
            time_scale=jnp.exp(self.log_time_scale),
            fold=PolynomialFold(self.coefficients),
            envelope=self.envelope,
        )

    @classmethod
    def from_mixture(cls, mixture: FoldedMixture, *, color: ArrayLike) -> "FoldedSplats":
        """A mixture's components as splats, in their order: `gaussians()` is `mixture.components`.

        Weights become opacities, `w_k / max w` times `PEAK_OPACITY`; `to_mixture` is the inverse, for splats without
        shared paths. To render the density itself, use `density_image`.

        Shapes: `mixture` of (x, y, t) without batch dimensions, in model space, m_t in (0, 1), with polynomial or zero
        folds and one time-likelihood or constant envelope; `color` (3,) or (num, 3), not below 0. Where the values
        of the envelope are not known, as inside `jax.jit`, all splats get the envelope of the first component.
        Raises ValueError for any other mixture or color.

        Example: `FoldedSplats.from_mixture(mixture, color=[1.0, 0.5, 0.0]).at(0.5)`.
        """
        components = mixture.components
        require(
            mixture.event_shape == (3,) and mixture.batch_shape == (),
            "mixture",
            expected="points (x, y, t) and no batch",
            got=f"event {mixture.event_shape}, batch {mixture.batch_shape}",
            cure="Index its leaves.",
        )
        time_loc, dtype, num = components.time_loc, components.loc.dtype, mixture.num_components
        outside = concrete_value((time_loc <= 0) | (time_loc >= 1))
        require(
            outside is None or not outside.any(),
            "mixture.components.time_loc",
            expected="times in (0, 1)",
            got=concrete_value(time_loc),
            cure="A video's time is [0, 1]: shift and scale the mixture's.",
        )
        fold, envelope = components.fold, components.envelope
        require(
            isinstance(fold, ZeroFold | PolynomialFold),
            "mixture.components.fold",
            expected="a PolynomialFold",
            got=type(fold).__name__,
            cure="Splats hold polynomial folds only.",
        )
        require(
            isinstance(envelope, TimeLikelihood | Constant),
            "mixture.components.envelope",
            expected="a TimeLikelihood or Constant",
            got=type(envelope).__name__,
            cure="Splats hold these only.",
        )
        log_scale, angle = find_axes(components.scale_tril)
        log_weights = mixture.log_weights
        log_opacity = log_weights - log_weights.max() + float(np.log(PEAK_OPACITY))
        return cls(
            loc=components.loc,
            log_scale=log_scale,
            angle_logit=jax.scipy.special.logit(angle / (2 * jnp.pi)),
            time_loc_logit=jax.scipy.special.logit(time_loc),
            log_time_scale=jnp.log(components.time_scale),
            coefficients=jnp.zeros((num, 0, 2), dtype) if isinstance(fold, ZeroFold) else fold.coefficients,
            opacity_logit=log_opacity - jnp.log(-jnp.expm1(log_opacity)),
            color_dc=(_check_color(color, num, dtype) - 0.5) / SH_C0,
            envelope=TimeLikelihood(0.0) if isinstance(envelope, Constant) else jax.tree.map(_common_value, envelope),
        )

    def to_mixture(self) -> FoldedMixture:
        """The splats as a mixture, in model space: `gaussians()` with weights in proportion to opacity.

        Colors are left out. Example: `model.splats.to_mixture().log_prob(jnp.array([0.0, 0.1, 0.5]))`.
        """
        return FoldedMixture(self.gaussians(), logits=jax.nn.log_sigmoid(self.opacity_logit))

    def at(self, t: Float[Array, ""], *, scale_cutoff: float = 0.0) -> Splats2D:
        """The splats of time t, in model space: every Gaussian conditioned on t (eq:vegas_equiv_cond).

        A Gaussian too far away in time (`TIME_CUTOFF`), or with a standard deviation not above `scale_cutoff` at t,
        gets opacity 0.
        """
        folded = self._unmoved()
        conditional = folded.condition_time(t)
        near = jnp.abs(t - folded.time_loc) < TAU_MAX * folded.time_scale
        if scale_cutoff > 0:
            log_a = self.envelope.log_a(t, time_loc=folded.time_loc, time_scale=folded.time_scale)
            near &= self.log_scale.min(axis=-1) + log_a / 2 > float(np.log(scale_cutoff))
        opacity = jnp.where(near, jax.nn.sigmoid(self.opacity_logit), jnp.zeros_like(self.opacity_logit))
        color = jnp.maximum(0.5 + SH_C0 * self.color_dc, 0.0)
        splats = Splats2D(conditional.loc, conditional.scale_tril, opacity, color)
        return splats if self.paths is None else move_splats(splats, self.path_index, self.paths.at(t))


def _lower_factor(factor: Float[Array, "num 2 2"]) -> Float[Array, "num 2 2"]:
    """The lower-triangular factor of F F^T, in closed form; the determinant is that of F."""
    first, second = factor[:, 0], factor[:, 1]
    top = jnp.hypot(first[:, 0], first[:, 1])
    det = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    rows = [jnp.stack([top, jnp.zeros_like(top)], -1), jnp.stack([(first * second).sum(-1), jnp.abs(det)], -1)]
    return jnp.stack([rows[0], rows[1] / top[:, None]], -2)


def find_axes(tril: Float[Array, "num 2 2"]) -> tuple[Float[Array, "num 2"], Float[Array, " num"]]:
    """Logarithms of the two standard deviations, the greater first, and the angle, from the lower factor.

    Closed-form singular values of [[p, 0], [q, r]]. The angle is in [pi/2, 3 pi/2]; it is unique modulo pi.
    """
    p, q, r = tril[:, 0, 0], tril[:, 1, 0], tril[:, 1, 1]
    first = 0.5 * (jnp.hypot(p + r, q) + jnp.hypot(p - r, q))
    log_scale = jnp.stack([jnp.log(first), jnp.log(p) + jnp.log(r) - jnp.log(first)], axis=-1)
    twice_cross, difference = 2 * p * q, (p - r) * (p + r) - q * q
    isotropic = (twice_cross == 0) & (difference == 0)  # any angle is right, and has no meaningful gradient
    return log_scale, jnp.pi + 0.5 * jnp.arctan2(twice_cross, jnp.where(isotropic, 1, difference))


def _common_value(leaf: Array) -> Array:
    """The first value, unless others are known to differ: then the array."""
    values = concrete_value(leaf)
    return leaf if values is not None and (values != values.flat[0]).any() else leaf.ravel()[0]


def _check_color(color: ArrayLike, num: int, dtype) -> Float[Array, "num 3"]:
    color = jnp.asarray(color, dtype)
    require(
        color.shape in ((3,), (num, 3)),
        "color",
        expected=f"shape (3,) or ({num}, 3)",
        got=f"shape {color.shape}",
        cure="RGB in [0, 1].",
    )
    values = concrete_value(color)
    require(values is None or (values >= 0).all(), "color", expected="values >= 0", got=values)
    return jnp.broadcast_to(color, (num, 3))
