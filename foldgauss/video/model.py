"""The fitted video: folded splats, frame times and what it takes to draw them."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood
from foldgauss.fold import PolynomialFold
from foldgauss.render import RenderOptions, Splats2D, render
from foldgauss.render.splats import check_size
from foldgauss.video.alpha import BLACK, checked_background
from foldgauss.video.frame_times import FrameTimes
from foldgauss.video.shots import out_of_cuts

#: Degree-0 spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 * color_dc, as in 3DGS.
SH_C0 = 0.28209479177387814
#: A Gaussian is drawn only where exp(-tau^2 / 2) exceeds this, as in the published VeGaS.
TIME_CUTOFF = 0.01
#: The same as a bound on |tau| = |t - m_t| / sigma_t: 3.03.
TAU_MAX = float(np.sqrt(-2 * np.log(TIME_CUTOFF)))


class FoldedSplats(eqx.Module):
    """Folded Gaussians with opacity and colour: raw leaves, before activation, in model space.

    Model space has its origin at the frame's centre, x right, y down, and the frame's longer side is 1; time is [0, 1].

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

    Source: VeGaS eq:vegas_equiv and "Implementation Details"; array order is depth order.
    """

    loc: Float[Array, "num 2"]
    log_scale: Float[Array, "num 2"]
    angle_logit: Float[Array, "num"]
    time_loc_logit: Float[Array, "num"]
    log_time_scale: Float[Array, "num"]
    coefficients: Float[Array, "num degree 2"]
    opacity_logit: Float[Array, "num"]
    color_dc: Float[Array, "num 3"]
    envelope: TimeLikelihood

    @property
    def num_gaussians(self) -> int:
        return self.loc.shape[0]

    @property
    def degree(self) -> int:
        return self.coefficients.shape[1]

    def gaussians(self) -> FoldedGaussian:
        """The batch of Folded-Gaussians, batch shape (num,), event shape (3,)."""
        return FoldedGaussian(
            self.loc,
            rotated_scale_tril(jnp.exp(self.log_scale), 2 * jnp.pi * jax.nn.sigmoid(self.angle_logit)),
            time_loc=jax.nn.sigmoid(self.time_loc_logit),
            time_scale=jnp.exp(self.log_time_scale),
            fold=PolynomialFold(self.coefficients),
            envelope=self.envelope,
        )

    def at(self, t: Float[Array, ""]) -> Splats2D:
        """The splats of time t, in model space: every Gaussian conditioned on t (eq:vegas_equiv_cond).

        A Gaussian too far away in time (`TIME_CUTOFF`) keeps its place with opacity 0.
        """
        folded = self.gaussians()
        conditional = folded.condition_time(t)
        near = jnp.abs(t - folded.time_loc) < TAU_MAX * folded.time_scale
        opacity = jnp.where(near, jax.nn.sigmoid(self.opacity_logit), jnp.zeros_like(self.opacity_logit))
        color = jnp.maximum(0.5 + SH_C0 * self.color_dc, 0.0)
        return Splats2D(conditional.loc, conditional.scale_tril, opacity, color)


def rotated_scale_tril(scale: Float[Array, "num 2"], angle: Float[Array, "num"]) -> Float[Array, "num 2 2"]:
    """Lower-triangular factor of R(angle) diag(scale)^2 R(angle)^T, in closed form.

    The determinant is the product of the scales, so nothing is subtracted and the factor exists for any scales > 0.
    Source: R and S of eq:mirage.
    """
    first, second = scale[:, 0], scale[:, 1]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    top = jnp.hypot(first * cos, second * sin)
    side = (first - second) * (first + second) * sin * cos / top
    rows = [jnp.stack([top, jnp.zeros_like(top)], -1), jnp.stack([side, first * second / top], -1)]
    return jnp.stack(rows, -2)


class VideoModel(eqx.Module):
    """A fitted video: what is stored in a model file.

    `size` is (height, width) of the frames it was fitted to, `fps` their rate, `options` the constants and
    `compositing` the blend ("over" or "sum") it was fitted with and must be drawn with.
    """

    splats: FoldedSplats
    frame_times: FrameTimes
    size: tuple[int, int] = eqx.field(static=True)
    fps: float = eqx.field(static=True)
    options: RenderOptions = eqx.field(static=True)
    compositing: str = eqx.field(static=True, default="over")

    @property
    def num_frames(self) -> int:
        return self.frame_times.num_frames

    @property
    def num_floats(self) -> int:
        """Numbers stored."""
        return sum(np.size(leaf) for leaf in jax.tree.leaves(self))

    def at(self, t: Float[Array, ""], size: tuple[int, int] | None = None) -> Splats2D:
        """The splats of time t, in pixels of a picture of `size` (default: the fitted one)."""
        height, width = self.size
        return self.splats.at(t).to_pixels(self.size if size is None else size, aspect=height / width)

    def render(
        self,
        t: float,
        size: tuple[int, int] | None = None,
        *,
        engine: str = "auto",
        background: tuple[float, float, float] = BLACK,
    ) -> Float[Array, "height width 3"]:
        """The picture at any time t in [0, 1], values about [0, 1], over `background`; see `foldgauss.render.render`.

        Between two shots it is the nearer shot's. Frame k is at `frame_times.times()[k]`.
        """
        size = self.size if size is None else size
        check_size(size)
        t = out_of_cuts(jnp.asarray(t, jnp.float32), self.frame_times.times())
        splats = _splats_in_pixels(self, t, tuple(size))
        behind = jnp.asarray(checked_background(background, self.compositing), splats.mean.dtype)
        drawn = {"compositing": self.compositing, "options": self.options}
        return render(splats, size, background=behind, engine=engine, **drawn)

    def frames(
        self,
        times: np.ndarray | None = None,
        size: tuple[int, int] | None = None,
        *,
        background: tuple[float, float, float] = BLACK,
    ) -> Iterator[np.ndarray]:
        """Pictures at `times` (default: the frame times) one by one, over `background`, uint8 (height, width, 3)."""
        from foldgauss.video.playback import Playback  # which knows this class

        yield from Playback(self, size, background=background).frames(times)


@eqx.filter_jit
def _splats_in_pixels(model: VideoModel, t: Float[Array, ""], size: tuple[int, int]) -> Splats2D:
    return model.at(t, size)
