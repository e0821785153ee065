"""The pictures of docs/concepts.md, and those beside the examples in README.

    python -m benchmarks.figures [--out FOLDER] [--only NAME ...] [--models FOLDER]

*density*, *shapes* and *marginals* are drawn from distributions of two coordinates. *pipeline* and *cameras* show 25
frames of *bikes* at 160x384, the rider of `benchmarks.editing`, fitted with 20,000 Gaussians in 3,000 steps, half of
which learn what lies between frames; `--models` keeps that model, and takes the one that is there. *distribution* and
*uncertainty* are the examples of README; the latter fits 46 frames of *Bunny* at 80x160 and samples their times, and
*increments*, for docs/uncertainty.md, all 132.
Others: `benchmarks.animation`, `benchmarks.record_figures`.
"""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib import patheffects
from matplotlib import pyplot as plt
from matplotlib.collections import EllipseCollection
from matplotlib.patches import Ellipse
from matplotlib.transforms import Affine2D

from benchmarks import _common
from benchmarks.editing import Scene, fitted, rider
from foldgauss import Constant, FoldedGaussian, PolynomialFold, TimeLikelihood, ZeroFold
from foldgauss.analysis.plot import plot_density
from foldgauss.io import Clip
from foldgauss.io._atomic import atomic_path
from foldgauss.io.datasets import bunny
from foldgauss.render import Camera, Gaussians3D, project, render
from foldgauss.uncertainty import (
    FrameTimePosterior,
    frame_time_posterior,
    increment_intervals,
    irregularities,
    likelihood_profiles,
)
from foldgauss.uncertainty.diagnostics.plots import plot_increments
from foldgauss.video import FitConfig, VideoModel, Views, fit

BLUE = "#2b5c8a"
RED = "#c2452d"
GREY = "#5a5f66"
DPI = 140
#: The clip is dark: it is shown so many times as bright.
BRIGHTNESS = 1.6
#: The frame that is shown.
SHOWN = 5
CONFIG = FitConfig(num_gaussians=20_000, steps=3_000, views=Views(interpolation_fraction=0.5, interpolation_end=1.0))
#: Inches of README's examples: text is readable on a screen of 360 pixels.
EXAMPLE_SIZE = 5.0, 3.2
HALO = {"path_effects": [patheffects.withStroke(linewidth=3, foreground="white")]}
#: Frames of *Bunny* in the example of uncertainty: 57 and 82 repeat the ones before.
REPEATING = 40, 86
#: Gaussians and steps for each frame of a clip whose times are sampled.
PER_FRAME = 130, 32
#: One in so many Gaussians has its outline drawn.
EVERY = 4


def bent() -> FoldedGaussian:
    """The example of all pictures: a cubic that narrows away from its time."""
    return FoldedGaussian(
        loc=jnp.zeros(1),
        scale_tril=jnp.array([[0.16]]),
        time_loc=0.5,
        time_scale=0.18,
        fold=PolynomialFold(jnp.array([[-0.4], [3.0], [9.0]])),
        envelope=TimeLikelihood(power=1),
    )


def density() -> plt.Figure:
    """The density with its curve, and what it is at three times."""
    fig, ax = plt.subplots(figsize=(7.4, 4.2))
    plot_density(bent(), ax, slices=[0.25, 0.5, 0.75])
    ax.set(xlabel="time t", ylabel="space s")
    note = {"arrowprops": {"arrowstyle": "->", "color": GREY, "lw": 0.8}, "color": GREY, "fontsize": 9}
    low, high = ax.get_ylim()
    ax.annotate("center $m_s + f(m_t - t)$", (0.36, float(_center(0.36))), (0.3, high - 0.1 * (high - low)), **note)
    ax.annotate("$s\\,|\\,t$ is a Gaussian with\nvariance $a(t)\\,\\Sigma$", (0.77, float(_center(0.75))),
                (0.72, low + 0.75 * (high - low)), **note)  # fmt: skip
    return fig


def _center(t: float) -> np.ndarray:
    return np.asarray(bent().condition_time(t).loc)[0]


def marginals() -> plt.Figure:
    """The same density with its two marginals: of time, normal; of space, not."""
    dist = bent()
    fig, axes = plt.subplots(2, 2, figsize=(7.4, 4.6), width_ratios=(4, 1.2), height_ratios=(1.2, 4))
    plot_density(dist, axes[1, 0], slices=())
    t, s = np.linspace(*axes[1, 0].get_xlim(), 300), np.linspace(*axes[1, 0].get_ylim(), 300)
    of_time = np.exp(np.asarray(dist.marginal([-1]).log_prob(jnp.asarray(t)[:, None])))
    of_space = np.exp(np.asarray(dist.marginal([0]).log_prob(jnp.asarray(s)[:, None])))
    axes[0, 0].fill_between(t, of_time, color=BLUE, alpha=0.3, lw=0)
    axes[0, 0].plot(t, of_time, color=BLUE)
    axes[0, 0].set_title(r"$t \sim N(m_t, \sigma_t^2)$", fontsize=10, color=GREY)
    axes[1, 1].fill_betweenx(s, of_space, color=RED, alpha=0.3, lw=0)
    axes[1, 1].plot(of_space, s, color=RED)
    axes[1, 1].set_title("$s$: an integral\nover $t$", fontsize=10, color=GREY)
    axes[0, 1].axis("off")
    for ax in (axes[0, 0], axes[1, 1]):
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    axes[0, 0].set_xlim(axes[1, 0].get_xlim())
    axes[1, 1].set_ylim(axes[1, 0].get_ylim())
    axes[1, 0].set(xlabel="time t", ylabel="space s")
    return fig


def shapes() -> plt.Figure:
    """What f and a do: columns are folds, rows envelopes."""
    folds = {
        "f = 0": ZeroFold(1),
        "f(u) = u: straight": PolynomialFold([[1.6]]),
        "u²: a turn": PolynomialFold([[0.0], [6.0]]),
        "u³: out and on": PolynomialFold([[-0.8], [0.0], [14.0]]),
    }
    envelopes = {"a = 1": Constant(), "power 1": TimeLikelihood(power=1), "power 2": TimeLikelihood(power=2)}
    fig, axes = plt.subplots(3, 4, figsize=(9.6, 5.6), sharex=True, sharey=True)
    for row, (a_name, envelope) in zip(axes, envelopes.items(), strict=True):
        for ax, (f_name, fold) in zip(row, folds.items(), strict=True):
            dist = FoldedGaussian(
                jnp.zeros(1),
                scale_tril=jnp.array([[0.14]]),
                time_loc=0.5,
                time_scale=0.16,
                fold=fold,
                envelope=envelope,
            )
            plot_density(dist, ax, t_limits=(0, 1), s_limits=(-0.75, 0.75))
            ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
            if row is axes[0]:
                ax.set_title(f_name, fontsize=10)
        row[0].set_ylabel(a_name)
    return fig


def pipeline(scene: Scene, model: VideoModel) -> plt.Figure:
    """From frames to pictures: optical flow, Gaussians, a picture between two frames."""
    k = SHOWN
    t = float(np.asarray(model.frame_times.times())[k])
    fig, axes = plt.subplots(2, 2, figsize=(9.6, 4.7))
    panels = {
        "1  frames, and what moves in them": _bright(scene.frames[k]),
        "2  Gaussians start along the flow (color: direction)": _flow(scene.frames[k], scene.frames[k + 1]),
        f"3  fitted, conditioned on t (one in {EVERY} drawn)": np.full_like(scene.frames[k], 255),
        "4  blended front to back: a picture, at any t": _bright(next(model.frames(np.array([t])))),
    }
    for ax, (title, picture) in zip(axes.flat, panels.items(), strict=True):
        ax.imshow(picture)
        ax.set_title(title, fontsize=10, loc="left")
        ax.axis("off")
    _outlines(axes[1, 0], model, t)
    return fig


def _bright(picture: np.ndarray) -> np.ndarray:
    return (BRIGHTNESS * picture.astype(np.float64)).round().clip(0, 255).astype(np.uint8)


def _flow(frame: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Optical flow as color: hue is direction, paleness is rest."""
    gray = [cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in (frame, after)]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*gray, None)
    length, angle = cv2.cartToPolar(flow[..., 0], flow[..., 1])
    saturation = np.clip(length / np.quantile(length, 0.98), 0, 1)
    hsv = np.stack([angle * 90 / np.pi, 255 * saturation, np.full_like(length, 255)], -1)
    return cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)


def _outlines(ax: plt.Axes, model: VideoModel, t: float) -> None:
    """Two-sigma ellipses of some of the Gaussians alive at t, in their colors."""
    splats = model.at(t)
    alive = np.flatnonzero(np.asarray(splats.opacity) > 0.05)[::EVERY][::-1]  # the front ones are drawn last
    factor = np.asarray(splats.factor)[alive]
    axes, scale, _ = np.linalg.svd(factor)
    angle = np.degrees(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))
    color = np.clip(BRIGHTNESS * np.asarray(splats.color)[alive], 0, 1)
    ellipses = EllipseCollection(
        *(4 * scale.T), angle, units="xy", offsets=np.asarray(splats.mean)[alive], offset_transform=ax.transData,
        facecolors=np.concatenate([color, np.full((len(color), 1), 0.35)], 1), edgecolors=color, linewidths=0.6,
    )  # fmt: skip
    ax.add_collection(ellipses)
    ax.set(xlim=(0, model.size[1]), ylim=(model.size[0], 0))


def cameras(scene: Scene, model: VideoModel) -> plt.Figure:
    """Flat Gaussians between two cameras, and what each sees, and a third from the side."""
    height, width = model.size
    aspect, k = height / width, SHOWN
    t = float(np.asarray(model.frame_times.times())[k])
    flat = Gaussians3D.from_flat(model.splats.at(jnp.asarray(t, jnp.float32)))
    front = Camera.front(aspect=aspect)
    views = {
        "the front camera's picture": (front, "depth"),
        "the opposing camera's: mirrored": (Camera.opposing(aspect=aspect), "depth"),
        "from the side": (front.orbit(0.6, 0.15), "array"),
    }
    fig = plt.figure(figsize=(9.6, 5.2))
    _stage(fig.add_subplot(2, 2, 1), _bright(scene.frames[k]), front, aspect)
    for place, (title, (camera, order)) in zip((2, 3, 4), views.items(), strict=True):
        picture = np.asarray(render(project(flat, camera, model.size, order=order), model.size))
        ax = fig.add_subplot(2, 2, place)
        ax.imshow(np.clip(BRIGHTNESS * picture, 0, 1))
        ax.set_title(title, fontsize=10)
        ax.axis("off")
    return fig


def _stage(ax: plt.Axes, picture: np.ndarray, front: Camera, aspect: float) -> None:
    """The plane with its picture between both cameras, in oblique projection: depth runs to the right."""
    away = abs(float(np.asarray(front.position)[2]))
    drawn = np.array([[0.45, 0.0, 1.0], [0.25, -1.0, 0.0]])  # of (x, y down, z): to the right, and up
    across, down = drawn[:, 0], drawn[:, 1] * aspect
    corner = -0.5 * (across + down)
    plane = Affine2D.from_values(*across, *down, *corner) + ax.transData
    ax.imshow(picture, extent=(0, 1, 1, 0), transform=plane, interpolation="bilinear")
    for side, color, name in ((-1, BLUE, "front"), (1, RED, "opposing")):
        camera = drawn @ [0, 0, side * away]
        for x in (-0.5, 0.5):
            for y in (-0.5, 0.5):
                ax.plot(*np.stack([camera, x * across + y * down], 1), color=color, lw=0.9)
        ax.plot(*camera, "o", color=color, ms=7)
        ax.annotate(name, camera, (0, 10), textcoords="offset points", ha="center", color=color, fontsize=10)
    ax.set(xlim=(-1.15 * away, 1.15 * away), ylim=(-0.55, 0.55), aspect="equal")
    ax.axis("off")


def distribution() -> plt.Figure:
    """README's example: samples colored by time, and the Gaussians at five times."""
    bend = FoldedGaussian(
        loc=jnp.zeros(2),
        scale_tril=0.1 * jnp.eye(2),
        time_loc=0.5,
        time_scale=0.2,
        fold=PolynomialFold(jnp.array([[3.0, 0.0], [0.0, 4.0]])),
    )
    x = np.asarray(bend.sample(jax.random.key(0), (1000,)))
    fig, ax = plt.subplots(figsize=EXAMPLE_SIZE)
    points = ax.scatter(*x.T[:2], c=x[:, 2], s=9, alpha=0.7, cmap="viridis", vmin=0, vmax=1, linewidths=0)
    for t in (0.1, 0.3, 0.5, 0.7, 0.9):
        given = bend.condition_time(t)
        width = 4 * float(given.scale_tril[0, 0])  # the covariance is a multiple of the identity
        ax.add_patch(Ellipse(np.asarray(given.loc), width, width, fill=False, ec="black", lw=1.2))
        ax.annotate(f"t = {t:g}", np.asarray(given.loc) - [0, 0.3], ha="center", va="center", fontsize=11, **HALO)
    fig.colorbar(points, label="time t", orientation="horizontal", aspect=40).solids.set_alpha(1)
    ax.set(xlabel="x", ylabel="y", aspect="equal")
    return fig


def uncertainty() -> plt.Figure:
    """README's example: the steps between frames of *Bunny*, two of which are repeated in the file itself."""
    first, stop = REPEATING
    posterior = _frame_times(bunny(frames=REPEATING, size=(80, 160)))
    found = increment_intervals(posterior, 0.9)
    fig, ax = plt.subplots(figsize=EXAMPLE_SIZE)
    ax.axhline(1, color=GREY, lw=0.8)
    number = np.arange(first, stop - 1)
    ax.vlines(number, found.low, found.high, color=BLUE, lw=4, alpha=0.4)
    ax.plot(number, found.mean, "o", color=BLUE, ms=4)
    for one in irregularities(posterior):
        at = one.frames[0]
        ax.plot(first + at, found.mean[at], "o", color=RED, ms=7)
        text = f"{one.kind},\nprobability {one.probability:.2f}"
        ax.annotate(text, (first + at, found.mean[at]), (-8, 0), textcoords="offset points", ha="right", va="center",
                    color=RED, fontsize=11)  # fmt: skip
    ax.set(xlabel="frame", ylabel="step to the next frame", ylim=(-0.2, 1.6))
    return fig


def _frame_times(clip: Clip) -> FrameTimePosterior:
    """Times of the frames, given a fit without shared paths."""
    gaussians, steps = (rate * len(clip.frames) for rate in PER_FRAME)
    config = FitConfig(num_gaussians=gaussians, steps=steps, follow_camera=False)
    return frame_time_posterior(likelihood_profiles(fit(clip.frames, config, fps=clip.fps).model, clip.frames))


def increments() -> plt.Figure:
    """All steps between frames of *Bunny*, with what is reported; below, how much the frames themselves differ."""
    clip = bunny(size=(80, 160))
    posterior = _frame_times(clip)
    print(posterior.message, *irregularities(posterior), sep="\n")
    fig, (above, below) = plt.subplots(2, 1, figsize=(8.6, 5.2), sharex=True, height_ratios=(2, 1))
    plot_increments(posterior, above, level=0.9)
    above.get_legend().remove()
    above.set(title="", xlabel="", ylabel="step / median step")
    change = np.sqrt((np.diff(clip.frames.astype(np.float64), axis=0) ** 2).mean((1, 2, 3)))
    below.semilogy(np.arange(len(change)) + 0.5, change, ".-", color=GREY, lw=0.8)
    below.set(xlabel="interval between frames", ylabel="difference of frames\n(gray levels, rms)")
    below.grid(alpha=0.25)
    return fig


DRAWN = {"density": density, "marginals": marginals, "shapes": shapes}
EXAMPLES = {"distribution": distribution, "uncertainty": uncertainty}
GUIDES = {"increments": increments}
FROM_CLIP = {"pipeline": pipeline, "cameras": cameras}
#: The names of files begin with what they are of.
PREFIX = dict.fromkeys((*DRAWN, *FROM_CLIP), "concept-") | dict.fromkeys(EXAMPLES, "example-")


def write(path: Path, figure: plt.Figure) -> None:
    with atomic_path(path) as temporary:
        figure.tight_layout()
        figure.savefig(temporary, dpi=DPI, format="png", facecolor="white")
        plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    every = (*DRAWN, *EXAMPLES, *GUIDES, *FROM_CLIP)
    parser = _common.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), metavar="FOLDER", help="[docs]")
    parser.add_argument("--only", choices=every, action="append", metavar="NAME", help="[all]")
    parser.add_argument("--models", type=Path, metavar="FOLDER", help="keep the model there, or take it from there")
    options = _common.parse(parser, arguments)
    matplotlib.use("Agg")
    wanted = options.only or every
    options.out.mkdir(parents=True, exist_ok=True)
    made = {name: (DRAWN | EXAMPLES | GUIDES)[name]() for name in wanted if name not in FROM_CLIP}
    if set(wanted) & FROM_CLIP.keys():
        if options.models is not None:
            options.models.mkdir(parents=True, exist_ok=True)
        scene = rider()
        model = fitted(scene._replace(name="figures"), CONFIG, options.models)
        made |= {name: FROM_CLIP[name](scene, model) for name in wanted if name in FROM_CLIP}
    for name, figure in made.items():
        write(options.out / f"{PREFIX.get(name, '')}{name}.png", figure)


if __name__ == "__main__":
    main()
