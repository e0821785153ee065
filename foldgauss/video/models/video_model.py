"""The fitted video: folded splats, frame times and rendering options."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss._runtime.checks import check_one_of, require
from foldgauss.render import COMPOSITINGS, RenderOptions, Splats2D, render
from foldgauss.render.splats import check_size
from foldgauss.video.models.background import BLACK, Background, check_background
from foldgauss.video.models.conditioning import PreparedModel, check_renderable
from foldgauss.video.models.frame_times import FrameTimes, snap_to_shots
from foldgauss.video.models.renderer import RenderedVideo, check_time, choose_time
from foldgauss.video.models.splats import FoldedSplats

#: Parameters of a Gaussian, without those of its fold.
PARAMETERS = 11
#: Advice in errors where a segmented video was given and one model is needed.
ONE_SEGMENT = "Take one segment's own: video.segments[k].model."


def check_model(model: object) -> None:
    """Raise unless it is a `VideoModel`."""
    cures = {
        "EditedVideo": "Use each layer's own model, before layers and edits are combined.",
        "Edit": "End the chain with .video().",
        "SegmentedVideo": ONE_SEGMENT,
    }
    require(
        isinstance(model, VideoModel),
        "model",
        expected="a VideoModel",
        got=type(model).__name__,
        cure=cures.get(type(model).__name__, "The model comes first."),
    )


class VideoModel(RenderedVideo, eqx.Module):
    """A fitted video, as stored in a model file.

    `size` is (height, width) of the frames it was fitted to, `fps` their rate; `options` and `compositing` ("over" or
    "sum") are those of the fit, and must be rendered with. `scale_cutoff`: a Gaussian is rendered only where its
    standard deviations exceed it, in model units; 0 except for imported VeGaS videos and the preset `paper`.

    Units: time is [0, 1], frame k at `frame_times.times()[k]`; lengths are in model space, see `FoldedSplats`.
    Example: `fit(frames).model.render(0.5)`. Source: VeGaS, section 4.
    """

    splats: FoldedSplats
    frame_times: FrameTimes
    size: tuple[int, int] = eqx.field(static=True)
    fps: float = eqx.field(static=True)
    options: RenderOptions = eqx.field(static=True)
    compositing: str = eqx.field(static=True, default="over")
    scale_cutoff: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        check_one_of("compositing", self.compositing, COMPOSITINGS)

    @property
    def num_frames(self) -> int:
        return self.frame_times.num_frames

    @property
    def num_gaussians(self) -> int:
        return self.splats.num_gaussians

    @property
    def degree(self) -> int:
        """Of the folds."""
        return self.splats.degree

    @property
    def num_parameters(self) -> int:
        """11 + 2 degree for each Gaussian, the frame times, and the knots of shared paths with their maps."""
        paths = self.splats.paths
        shared = 0 if paths is None else paths.times.size + paths.matrices.size
        return self.num_gaussians * (PARAMETERS + 2 * self.degree) + self.num_frames - 1 + shared

    def with_options(self, options: RenderOptions) -> "VideoModel":
        """The same model, rendered with other options."""
        return dataclasses.replace(self, options=options)

    def prepare(self, size: tuple[int, int]) -> PreparedModel:
        """The model prepared for conditioning on many times, for images of `size`."""
        return PreparedModel(self, size)

    def at(self, t: Float[Array, ""], size: tuple[int, int] | None = None) -> Splats2D:
        """The splats of time t, in pixels of an image of `size` (default: the fitted one)."""
        check_time(t)
        height, width = self.size
        return self.splats.at(t, scale_cutoff=self.scale_cutoff).to_pixels(
            self.size if size is None else size, aspect=height / width
        )

    def render(
        self,
        time: float | None = None,
        size: tuple[int, int] | None = None,
        *,
        frame: int | None = None,
        seconds: float | None = None,
        engine: str = "auto",
        background: Background = BLACK,
    ) -> Float[Array, "height width channels"]:
        """The image at one moment, values about [0, 1], over `background`; see `foldgauss.render.render`.

        With `background=None` it is (height, width, 4), with alpha and premultiplied colors.

        The moment is one of these; in the gap of a cut the nearer shot is shown:

        - `time`: in [0, 1], of the model.
        - `frame`: frame k at its learned time, `frame_times.times()[k]`; negative numbers count from the end.
        - `seconds`: of the clip, in [0, num_frames / fps]. Frame k is at k / fps, and times between frames are
          interpolated; the last frame is shown to the end.

        Raises TypeError unless exactly one is given, IndexError for a frame that the clip does not have, and ValueError
        for another time, seconds or size, and, outside of `jax.jit` and `jax.grad`, for a model with NaN or infinities.
        Example: `model.render(frame=-1)`.
        """
        size = self.size if size is None else size
        check_size(size)
        t = choose_time(self, time, frame, seconds)
        t = snap_to_shots(jnp.asarray(t, jnp.float32), self.frame_times.times())
        splats, num_broken = _splats_in_pixels(self, t, tuple(map(int, size)))
        if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((self, num_broken))):
            check_renderable(self, int(num_broken))
        behind = jnp.asarray(check_background(background, self.compositing), splats.mean.dtype)[:3]
        how = {"engine": engine, "compositing": self.compositing, "options": self.options}
        if background is not None:
            return render(splats, size, background=behind, **how)
        image, alpha = render(splats, size, return_alpha=True, **how)
        return jnp.concatenate([image, alpha[..., None]], axis=-1)


@eqx.filter_jit
def _splats_in_pixels(model: VideoModel, t: Float[Array, ""], size: tuple[int, int]) -> tuple[Splats2D, Array]:
    """The splats, and the number of Gaussians with NaN or infinities."""
    own = filter(jnp.ndim, jax.tree.leaves(dataclasses.replace(model.splats, path_index=None, paths=None)))
    finite = jnp.stack([jnp.isfinite(leaf).all(axis=tuple(range(1, leaf.ndim))) for leaf in own])
    return model.at(t, size), (~finite.all(axis=0)).sum()
