"""The configuration of a fit, its presets, and the defaults that depend on the clip."""

import dataclasses
import math
from dataclasses import field
from typing import Any

from foldgauss._runtime.checks import check_one_of, require
from foldgauss._runtime.settings import check_settings, replace_settings, setting
from foldgauss._runtime.threads import num_threads
from foldgauss.render import COMPOSITINGS, RenderOptions
from foldgauss.render.camera import FIELD_OF_VIEW
from foldgauss.video.fitting.losses import LOSSES
from foldgauss.video.models.row_layout import MAX_DEGREE

#: Groups of settings, which are the panels of `foldgauss fit --help`.
MODEL = "model"
BUDGET = "budget"
OPTIMIZATION = "optimization"
#: The most Gaussians of a fit. Their state takes about 3 GB at degree 3; the paper's largest fit ends with 1.8 million.
MAX_GAUSSIANS = 10_000_000
#: The default of `Views.interpolation_fraction`.
INTERPOLATION_FRACTION = 0.1
#: Engines that compute the steps of a fit, named as those of `render`.
FIT_ENGINES = ("auto", "cpu", "xla", "pallas")
#: One unit of the published geometry in ours: there the image's half width is tan(FIELD_OF_VIEW / 2), here the longer
#: side, which is taken for the width, is 1.
PUBLISHED_UNIT = 1 / (2 * math.tan(FIELD_OF_VIEW / 2))
#: What the published code calls the scene's extent, 1.1 of its units.
EXTENT = 1.1 * PUBLISHED_UNIT
#: Steps of the published fit, which the steps of the schedule are meant for.
PUBLISHED_STEPS = 30_000
#: In plans however short, gradients are averaged over at least so many steps.
MIN_EVERY = 10
#: In plans however short, opacities have so many steps to recover between resets: at the published rate, 0.025 a step,
#: the logit of 0.01 needs 184 steps to that of 0.5.
MIN_RESET_EVERY = 200


def _rate(leaf: str, default: float) -> Any:
    return field(default=default, metadata=setting(f"Of {leaf}", bounds="[0, inf)"))


@dataclasses.dataclass(frozen=True)
class LearningRates:
    """Learning rates of Adam at the first step, by leaf, in model space (the frame's longer side is 1); their schedule.

    With `own_units` the unit of length is each Gaussian's own: m_s and c_k move along its two axes, with the learning
    rates `loc` and `coefficients` times the standard deviation along each axis / UNIT_SIZE. With r the ratio of both,
    the learning rate of the angle is divided by r - 1/r where this exceeds 1.
    The unit of time is its own duration: the learning rate of c_k is `coefficients` times
    (UNIT_TIME / sigma_t)^k, that of m_t is `time_loc_logit` sigma_t / UNIT_TIME. That of a path is `paths` times
    s / UNIT_SIZE, with s the mean of the sizes, the geometric means of both standard deviations.
    A step then moves small and large, short and long Gaussians by the same fraction of their sizes and durations.
    """

    loc: float = _rate("m_s", 5e-4)
    coefficients: float = _rate("the fold's coefficients c_k", 4e-3)
    log_scale: float = _rate("the logarithms of the standard deviations in space", 0.06)
    angle_logit: float = _rate("the angle, before its sigmoid", 0.05)
    opacity_logit: float = _rate("the opacity, before its sigmoid", 0.1)
    color_dc: float = _rate("the color", 0.03)
    time_loc_logit: float = _rate("m_t, before its sigmoid", 0.02)
    log_time_scale: float = _rate("log sigma_t", 0.07)
    frame_times: float = _rate("the times of the frames, which stay as they start if it is 0", 3e-3)
    paths: float = _rate("the maps of shared paths", 7e-4)
    final: float = field(
        default=0.3,
        metadata=setting("Learning rates decay exponentially to this fraction of these values", bounds="[0, 1]"),
    )
    cooldown: float = field(
        default=0.2,
        metadata=setting(
            "Fraction of the steps, at the end, in which learning rates also decrease linearly, to 2%",
            "Averages out the noise of single frames in the gradients.",
            bounds="[0, 1]",
        ),
    )
    decayed: str = field(
        default="all", metadata=setting("Which learning rates decay: all, or that of positions", choices=("all", "loc"))
    )
    nu: float = field(
        default=0.7,
        metadata=setting(
            "Fraction of Adam's mean gradient in a step; the rest is the latest gradient",
            "Quasi-hyperbolic Adam (Ma and Yarats 2019); 1 is Adam. Of the maps of paths and frame times it is 1.",
            bounds="[0, 1]",
        ),
    )
    own_units: bool = field(
        default=True, metadata=setting("Learning rates are in units of each Gaussian's axes and duration")
    )

    def __post_init__(self) -> None:
        check_settings(self, "rates.")


@dataclasses.dataclass(frozen=True)
class Loss:
    """The loss of an image: first L1 and D-SSIM (Kerbl et al. 2023, eq. 7), then the squared error."""

    name: str = field(
        default="3dgs",
        metadata=setting("The first loss: 3dgs, or the name of one given to `register_loss`", choices=LOSSES),
    )

    ssim_fraction: float = field(
        default=0.2,
        metadata=setting(
            "Fraction of D-SSIM in the first loss, the rest is L1",
            bounds="[0, 1]",
            option="--ssim-fraction",
            group=OPTIMIZATION,
        ),
    )
    l2_fraction: float | None = field(
        default=None,
        metadata=setting(
            "Fraction of the steps, at the end, whose loss is the squared error, which PSNR measures",
            "Default: 0.3, or 0.7 for a compact model.",
            bounds="[0, 1]",
        ),
    )
    border_weight: float = field(
        default=4.0,
        metadata=setting("Factor of the gradient at the outermost pixels, covered from one side", bounds="[1, inf)"),
    )

    def __post_init__(self) -> None:
        check_settings(self, "loss.")


@dataclasses.dataclass(frozen=True)
class Views:
    """The images that each step is fitted to.

    With `two_cameras`, half of the views of a pass are those of an opposite camera: the mirrored frame, and the splats
    seen from behind. Flat Gaussians in one plane look mirrored from there, in the same order, so the gradients equal
    those of the front view up to rounding, and a pass takes twice as long. It exists for fidelity to the paper.
    """

    batch_size: int = field(
        default=1, metadata=setting("Frames per step", least=1, option="--batch-size", group=OPTIMIZATION)
    )
    error_fraction: float = field(
        default=0.3,
        metadata=setting(
            "Fraction of the views that are chosen in proportion to the squared errors of the frames",
            "In between, all frames are visited in turn. Improves the worst frames.",
            bounds="[0, 1)",
            option="--error-fraction",
            group=OPTIMIZATION,
        ),
    )
    interpolation_fraction: float | None = field(
        default=None,
        metadata=setting(
            "Of the steps before interpolation ends, the fraction that fits frames interpolated by optical flow",
            "Improves the times between frames, for slow motion. Interpolation ends at `interpolation_end`. Views that "
            "are drawn by error (`error_fraction`) are never interpolated, which limits the fraction.",
            bounds="[0, 1)",
            unset=f"{INTERPOLATION_FRACTION:g}; 0 with alpha or no optical flow",
            option="--interpolation-fraction",
            group=OPTIMIZATION,
        ),
    )
    interpolation_end: float = field(
        default=0.5,
        metadata=setting(
            "Fraction of the steps after which no interpolated frames are fitted any more",
            "With more, times between frames improve further, at the cost of the frames: the last steps recover them.",
            bounds="[0, 1]",
            option="--interpolation-end",
            group=OPTIMIZATION,
        ),
    )
    two_cameras: bool = field(
        default=False, metadata=setting("Also fit the mirrored frames, as seen by an opposite camera")
    )

    def __post_init__(self) -> None:
        check_settings(self, "views.")


@dataclasses.dataclass(frozen=True)
class Growth:
    """When Gaussians are cloned, split, pruned and reset. For a fit of `PUBLISHED_STEPS`, see `for_plan`.

    After `from_step` and before `until_step`, on every `every`-th step: a Gaussian whose mean screen gradient reaches
    its threshold is cloned if small and split in two if not; one whose mean time gradient does, is cloned if its
    sigma_t is at most `clone_below_time` and split if not. Then Gaussians that are faint or too big are pruned. Every
    `reset_every` steps, opacities above `reset_opacity` fall to it.

    * The screen gradient is |dL/dmean| in units of half the image's width and height, the largest of a step's
      batch; the time gradient is |dL/dm_t| by the raw m_t, before its sigmoid. L is the mean over the batch: with it
      the paper's own numbers of Gaussians fall as 1 / batch (table "Ablation study": 1.72, 0.62, 0.31 million for
      batches of 1, 3, 5). Means are over the steps in which a Gaussian was seen.
    * Lengths are in model space, where the frame's longer side is 1.

    Sources: Kerbl et al. 2023, section 5.2 and its published constants; VeGaS, "Implementation Details" and its
    published constants. Raises ValueError for values out of range.
    """

    from_step: int = field(default=500, metadata=setting("First step of densification"))
    until_step: int = field(default=15_000, metadata=setting("Last step of densification"))
    every: int = field(default=100, metadata=setting("Steps between densifications", least=1))
    screen_gradient: float = field(default=2e-4, metadata=setting("Screen gradient that densifies", bounds="(0, inf)"))
    time_gradient: float = field(
        default=2e-4,
        metadata=setting(
            "Time gradient that densifies",
            "The published code has one threshold for both. Few Gaussians pass by time alone: their median time "
            "gradient is a quarter of their screen gradient.",
            bounds="(0, inf)",
        ),
    )
    clone_below: float = field(
        default=0.01 * EXTENT, metadata=setting("Larger standard deviation up to which to clone", bounds="(0, inf)")
    )
    clone_below_time: float = field(
        default=1.0,
        metadata=setting("sigma_t up to which the time gradient clones, in durations of the clip", bounds="(0, inf)"),
    )
    shrinking: float = field(default=1.6, metadata=setting("Factor by which halves are smaller", bounds="[1, inf)"))
    prune_opacity: float = field(default=0.01, metadata=setting("Least opacity; 3DGS has 0.005", bounds="(0, 1)"))
    big_from: int = field(default=3000, metadata=setting("Step from which on big Gaussians are pruned"))
    prune_radius: float | None = field(
        default=None,
        metadata=setting(
            "Largest radius in pixels: 3 standard deviations at the Gaussian's own time",
            "3DGS states 20, but its code never applies it, as its authors say (issues 123 and 643 of its repository). "
            "Applied, it prunes what covers smooth areas, and the fit fails (`benchmarks.reproduce`).",
            bounds="(0, inf)",
            unset="no limit",
        ),
    )
    prune_scale: float = field(default=0.1 * EXTENT, metadata=setting("Largest standard deviation", bounds="(0, inf)"))
    reset_every: int = field(default=3000, metadata=setting("Steps between resets of opacity", least=1))
    reset_opacity: float = field(default=0.01, metadata=setting("Opacity after a reset", bounds="(0, 1)"))

    def __post_init__(self) -> None:
        check_settings(self, "strategy.growth.")
        require(
            self.reset_opacity >= self.prune_opacity,
            "strategy.growth.reset_opacity",
            expected=f"at least prune_opacity, {self.prune_opacity:g}",
            got=self.reset_opacity,
            cure="Otherwise a reset would prune every Gaussian.",
        )

    def for_plan(self, plan: int) -> "Growth":
        """The schedule of a fit of `plan` steps: all steps scaled by plan / `PUBLISHED_STEPS`.

        Densification is at least `MIN_EVERY` steps apart, resets at least `MIN_RESET_EVERY`, at steps of densification.
        """
        if plan == PUBLISHED_STEPS:
            return self
        scale = plan / PUBLISHED_STEPS
        every = max(MIN_EVERY, round(self.every * scale))
        apart = max(MIN_RESET_EVERY, self.reset_every * scale)
        scaled = {name: round(getattr(self, name) * scale) for name in ("from_step", "until_step", "big_from")}
        return dataclasses.replace(self, **scaled, every=every, reset_every=every * math.ceil(apart / every))

    def grows_at(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after this step (steps count from 1)."""
        return self.from_step < step < self.until_step and step % self.every == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities are reset after this step."""
        return step < self.until_step and step % self.reset_every == 0


@dataclasses.dataclass(frozen=True)
class Strategy:
    """Which Gaussians there are, and which of them a step changes and renders."""

    growth: Growth | None = field(
        default=None, metadata=setting("Densification", unset="the number of Gaussians stays the same")
    )
    relocated_fraction: float = field(
        default=0.05,
        metadata=setting(
            "Fraction of the Gaussians moved, three times, from the smallest contributions to the largest errors",
            "Ignored with `growth`, which adds Gaussians itself, and without `sparse_updates`.",
            bounds="[0, 0.5]",
        ),
    )
    sparse_updates: bool = field(
        default=True,
        metadata=setting("Adam updates the Gaussians alive in the batch; otherwise all of them, as published"),
    )
    scale_cutoff: float = field(
        default=0.0,
        metadata=setting(
            "Gaussians are rendered only where both standard deviations exceed this, in model units",
            "These are shrunk by the envelope. The published code has 1e-4 of its units, 0.18 px of 640x1280.",
            bounds="[0, 1)",
        ),
    )

    def __post_init__(self) -> None:
        check_settings(self, "strategy.")


#: A low-pass filter of 0.1 px^2 fits finer detail than the usual 0.3.
FINE = RenderOptions(low_pass=0.1)
#: The published learning rates in our unit of length; published positions learn in units of the scene's extent.
PUBLISHED_RATES = LearningRates(
    loc=1.6e-4 * EXTENT,
    coefficients=1e-3 * PUBLISHED_UNIT,
    log_scale=5e-3,
    angle_logit=1e-3,
    opacity_logit=2.5e-2,
    color_dc=2.5e-3,
    time_loc_logit=1e-3,
    log_time_scale=1e-3,
    frame_times=1e-3,
    final=0.01,
    cooldown=0.0,
    decayed="loc",
    nu=1.0,
    own_units=False,
)
#: Standard deviations, in its units, above which the published code renders a Gaussian.
PUBLISHED_SCALE_CUTOFF = 1e-4
#: The fields that each preset changes, see `FitConfig.preset`.
PRESETS: dict[str, dict[str, Any]] = {
    "standard": {},
    "draft": {"num_gaussians": 10_000, "steps": 800},
    "paper": {
        "num_gaussians": 500_000,
        "degree": 7,
        "steps": PUBLISHED_STEPS,
        "power": 2.0,
        "initialization": "uniform",
        "follow_camera": False,
        "views": Views(batch_size=3, error_fraction=0.0, interpolation_fraction=0.0, two_cameras=True),
        "loss": Loss(l2_fraction=0.0, border_weight=1.0),
        "rates": PUBLISHED_RATES,
        "strategy": Strategy(
            growth=Growth(),
            relocated_fraction=0.0,
            sparse_updates=False,
            scale_cutoff=PUBLISHED_SCALE_CUTOFF * PUBLISHED_UNIT,
        ),
        "options": RenderOptions.standard(),
    },
}


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """The configuration of a fit; `FitConfig.preset` returns named ones.

    `steps` and `minutes` are budgets: the fit ends at the first that is reached. Minutes are converted into steps by
    the measured speed, and corrected until the end; with `growth` once, and then the clock ends a fit that is late.
    With neither, the fit takes `DEFAULT_STEPS`, or more for long clips.

    `quality`, `size_mb` and `psnr` ask for a compact model, see `rate`; with several, the smallest of the models.

    Documentation, valid values and command-line options of the fields are their metadata, see `_runtime.settings`.
    """

    num_gaussians: int | None = field(
        default=None,
        metadata=setting(
            "Number of Gaussians at the start",
            least=1,
            most=MAX_GAUSSIANS,
            unset="by the clip's size and length and the time to fit",
            option="--gaussians",
            group=MODEL,
        ),
    )
    max_gaussians: int | None = field(
        default=None,
        metadata=setting(
            "Largest number of Gaussians at any time",
            least=1,
            most=MAX_GAUSSIANS,
            unset=f"{MAX_GAUSSIANS:,}",
            option="--max-gaussians",
            group=MODEL,
        ),
    )
    degree: int | None = field(
        default=None,
        metadata=setting(
            "Degree of the fold polynomial",
            most=MAX_DEGREE,
            unset="3; 1 for a compact model, where higher powers are rarely worth their bits",
            option="--degree",
            group=MODEL,
        ),
    )
    steps: int | None = field(
        default=None,
        metadata=setting(
            "Optimizer steps",
            least=1,
            unset="3000, or 20 for each frame",
            option="--steps",
            group=BUDGET,
        ),
    )
    minutes: float | None = field(
        default=None,
        metadata=setting("Time to fit, in minutes", bounds="(0, inf)", option="--minutes", group=BUDGET),
    )
    quality: float | None = field(
        default=None,
        metadata=setting(
            "Quality of a compact model, from 0 to 100",
            "Ten more halve the steps of rounding, and a bit has to save only a quarter of the squared error.",
            bounds="[0, 100]",
            unset="70 for a compact file; without any of these three, parameters are not rounded",
            option="--quality",
            group=BUDGET,
        ),
    )
    size_mb: float | None = field(
        default=None,
        metadata=setting(
            "Largest compact file, in 10^6 bytes", bounds="(0, inf)", unset="no limit", option="--size-mb", group=BUDGET
        ),
    )
    psnr: float | None = field(
        default=None,
        metadata=setting(
            "The smallest compact model with this mean PSNR over all frames, in dB",
            bounds="(0, 100]",
            unset="not a goal",
            option="--psnr",
            group=BUDGET,
        ),
    )
    power: float = field(
        default=1.0,
        metadata=setting(
            "Power of the envelope a(t): 1 as in the paper's text, 2 as in its code",
            bounds="[0, 16]",
            option="--power",
            group=MODEL,
        ),
    )
    floor: float = field(default=0.0, metadata=setting("Floor of the envelope a(t)", bounds="[0, 1)", group=MODEL))
    seed: int = field(
        default=0,
        metadata=setting(
            "Random seed of the initialization and of the order of frames", option="--seed", group=OPTIMIZATION
        ),
    )
    initialization: str = field(
        default="flow",
        metadata=setting(
            "Initial Gaussians are sampled from the detail and colors of the clip, with paths along the optical flow "
            "of their shot (flow) or without (static), or uniformly over frame and time",
            "See `initialize_uniform`.",
            choices=("flow", "static", "uniform"),
            group=OPTIMIZATION,
        ),
    )
    follow_camera: bool = field(
        default=True,
        metadata=setting(
            "Gaussians may follow the motion of the camera, or that of the largest moving object, each with a fold of "
            "its own in addition",
            "A Gaussian does so where its track is then longer or its fold smaller. None does where these move "
            "steadily, nor with another `initialization` than flow.",
            option="--follow-camera/--no-follow-camera",
            group=MODEL,
        ),
    )
    views: Views = field(default=Views(), metadata=setting("The images that each step is fitted to"))
    loss: Loss = field(default=Loss(), metadata=setting("The loss of an image"))
    rates: LearningRates = field(default=LearningRates(), metadata=setting("Learning rates and their schedule"))
    strategy: Strategy = field(default=Strategy(), metadata=setting("Which Gaussians there are"))
    compositing: str = field(
        default="over",
        metadata=setting(
            "Compositing of the Gaussians: over (front to back) or sum",
            "Over as in 3DGS and VeGaS, sum as in GaussianImage.",
            choices=COMPOSITINGS,
            option="--compositing",
            group=MODEL,
        ),
    )
    options: RenderOptions = field(default=FINE, metadata=setting("Constants of the renderer", group=MODEL))
    engine: str = field(
        default="auto",
        metadata=setting(
            "Engine that computes the steps: cpu, or on a GPU pallas or xla; auto: cpu unless there is a GPU",
            "See docs/gpu.md; auto also takes cpu where a setting needs it.",
            choices=FIT_ENGINES,
            option="--engine",
            group=OPTIMIZATION,
        ),
    )

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def is_compact(self) -> bool:
        """Whether a compact model is asked for."""
        return any(goal is not None for goal in (self.quality, self.size_mb, self.psnr))

    @property
    def fold_degree(self) -> int:
        """`degree`, or the default."""
        return (1 if self.is_compact else 3) if self.degree is None else self.degree

    @property
    def squared_from(self) -> float:
        """The fraction of the plan from which the loss is the squared error; for a compact model early."""
        default = COMPACT_SQUARED_FROM if self.is_compact else SQUARED_FROM
        return default if self.loss.l2_fraction is None else 1 - self.loss.l2_fraction

    @property
    def follows_motion(self) -> bool:
        """Whether initial paths follow the optical flow."""
        return self.initialization == "flow"

    @property
    def learns_frame_times(self) -> bool:
        return self.rates.frame_times > 0

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "FitConfig":
        """A named configuration with `changes`; `minutes` without `steps` replace the preset's steps.

        Changes are those of `replace`.

        * "standard": `FitConfig()`.
        * "draft": a first impression in a fraction of the time: 10,000 Gaussians, 800 steps.
        * "paper": the published configuration. 500,000 Gaussians, initialized uniformly, that grow (`Growth`), degree
          7, batches of 3, 30,000 steps, 0.8 L1 + 0.2 D-SSIM, two opposite cameras, the published learning rates, of
          which only that of positions decays (to 1/100), Adam updates of all Gaussians, the published rasterizer's
          constants. Other numbers of steps scale the growth schedule in proportion, but not the learning rates, so fits
          of a few thousand steps stop early. As in the published code a Gaussian is rendered only where both standard
          deviations, multiplied by the envelope, exceed 1e-4 of its units (`strategy.scale_cutoff`).
          Source: VeGaS, "Implementation Details", and constants of its published code.

        Raises ValueError for an unknown name or change. Example: `FitConfig.preset("paper", steps=3000)`.
        """
        check_one_of("preset", name, tuple(PRESETS))
        chosen = dict(PRESETS[name])
        if changes.get("minutes") is not None:
            chosen["steps"] = None
        return cls(**chosen).replace(**changes)

    def replace(self, **changes: Any) -> "FitConfig":
        """This configuration with other values of some fields, also of those within a field, by names with a dot.

        Raises ValueError for an unknown name or value. Example: `config.replace(steps=300, **{"views.batch_size": 2})`.
        """
        return replace_settings(self, changes)


#: Least number of steps if neither steps nor minutes are given.
DEFAULT_STEPS = 3000
#: Then each frame is visited at least so often.
DEFAULT_VISITS = 20
#: Time of a core for each pixel of a step, in microseconds, by which steps and minutes are compared.
PIXEL_TIME = 0.4
#: Gaussians per pixel of a clip where a core has one microsecond for each, and where they live for one frame.
DENSITY = 0.0205
#: The power of the time by which that number grows.
DENSITY_POWER = 0.85
#: The power of the lifetime: Gaussians that live long are seldom needed anew.
LIFETIME_POWER = -0.6
#: A model with parameters of so many bytes is at most as large as the frames as bytes.
PARAMETER_BYTES = 2
#: Mean lifetime of Gaussians of slow clips, in frames.
TYPICAL_LIFETIME = 35.0
#: The shortest mean lifetime, in flicker, in frames.
SHORTEST_LIFETIME = 2.0
#: Gaussians alive in a frame, at most, for a frame of one pixel and one microsecond. More of them would leave time for
#: too few steps.
ALIVE = 0.378
#: The power of the time by which that number grows.
ALIVE_POWER = 0.55
#: The power of the pixels by which it grows.
ALIVE_PIXEL_POWER = 0.95
#: More Gaussians than this in each pixel gain nothing, however much time there is.
MOST_PER_PIXEL = 1.6


#: The quality of compact models that `foldgauss fit` has by default.
DEFAULT_QUALITY = 70.0
#: The fraction of the plan of a fit from which the loss is the squared error.
SQUARED_FROM = 0.7
#: The fraction of the plan of a compact fit from which the loss is the squared error. Of clips with alpha, where most
#: pixels are empty, it would leave edges blurred for long.
COMPACT_SQUARED_FROM = 0.3
#: Gaussians per pixel of a clip with which a fit of quality 50 starts: some three times as many as it keeps.
START_DENSITY = 0.012
#: Growth of the binary logarithm of that number for each unit of quality.
DENSITY_PER_QUALITY = 0.08
#: The PSNR of usual clips at quality 50, in dB.
PSNR_AT_50 = 34.0
#: Growth of the binary logarithm of that number for each dB of the PSNR that is asked for.
DENSITY_PER_DB = 0.2
#: Gaussians per pixel of a clip for each microsecond of x, see `default_num_gaussians`, with which a fit of a compact
#: model starts at most: those that do not converge are not worth their bits.
START_PER_TIME = 7e-4
#: Gaussians that a fit starts with for each 10^6 bytes of the largest file, where there is time: some ten times as many
#: as it keeps.
GAUSSIANS_PER_MB = 1_000_000


def default_num_gaussians(
    config: FitConfig,
    num_frames: int,
    height: int,
    width: int,
    *,
    lifetime: float = TYPICAL_LIFETIME,
    threads: int | None = None,
) -> int:
    """The number of Gaussians that is best for the budget, see notes/experiments.md for the measurements.

    `lifetime` is the mean number of frames in which a Gaussian is alive, which depends on the motion in the clip. The
    number is the smallest of three, where a core has x microseconds for each pixel of all frames, p pixels each:
    `DENSITY` x^`DENSITY_POWER` lifetime^`LIFETIME_POWER` for each pixel of all frames; the number of which `ALIVE`
    x^`ALIVE_POWER` p^`ALIVE_PIXEL_POWER`, at most `MOST_PER_PIXEL` p, are alive in a frame; and the number whose
    parameters, with `PARAMETER_BYTES` each, take as many bytes as the frames. `threads`: see `time_per_pixel`.
    """
    area = height * width
    pixels = num_frames * area
    time = time_per_pixel(config, num_frames, height, width, threads)
    by_time = DENSITY * time**DENSITY_POWER * lifetime**LIFETIME_POWER * pixels
    alive = min(ALIVE * time**ALIVE_POWER * area**ALIVE_PIXEL_POWER, MOST_PER_PIXEL * area)
    by_life = alive * num_frames / lifetime
    by_size = 3 * pixels / (PARAMETER_BYTES * (11 + 2 * config.fold_degree))  # with so many parameters for each
    return max(round(min(by_time, by_life, by_size, _most_for_rate(config, pixels, time))), 1)


def time_per_pixel(config: FitConfig, num_frames: int, height: int, width: int, threads: int | None = None) -> float:
    """Microseconds of a core for each pixel of all frames: x of `default_num_gaussians`.

    The time is `minutes` times the number of `threads`, by default those of this process. With `steps`, it is
    `PIXEL_TIME` for each frame of each step. If both are given, the smaller one counts.
    """
    steps = planned_steps(config, num_frames)
    by_steps = math.inf if steps is None else PIXEL_TIME * steps * config.views.batch_size / num_frames
    minutes = math.inf if config.minutes is None else config.minutes * (threads or num_threads())
    return min(by_steps, 60e6 * minutes / (num_frames * height * width))


def _most_for_rate(config: FitConfig, pixels: int, time: float) -> float:
    """A few times as many Gaussians as a compact model usually keeps, whose number depends on the clip."""
    if not config.is_compact:
        return math.inf
    by_quality = math.inf if config.quality is None else DENSITY_PER_QUALITY * (config.quality - 50)
    by_psnr = math.inf if config.psnr is None else DENSITY_PER_DB * (config.psnr - PSNR_AT_50)  # the quality is unknown
    by_size = math.inf if config.size_mb is None else GAUSSIANS_PER_MB * config.size_mb
    return min(START_PER_TIME * time * pixels, START_DENSITY * 2 ** min(by_quality, by_psnr) * pixels, by_size)


def chosen_num_gaussians(config: FitConfig, num_frames: int, height: int, width: int, **known: float | None) -> int:
    """Number of Gaussians at the start, at most `most_gaussians`.

    `known`: `lifetime` and `threads`, see `default_num_gaussians`.
    """
    num = config.num_gaussians or default_num_gaussians(config, num_frames, height, width, **known)
    return min(num, most_gaussians(config))


def most_gaussians(config: FitConfig) -> int:
    """The limit set by `max_gaussians`."""
    return config.max_gaussians or MAX_GAUSSIANS


def planned_steps(config: FitConfig, num_frames: int) -> int | None:
    """Steps of the whole fit; None where only the time limits it."""
    if config.minutes is not None:
        return config.steps
    return config.steps or max(DEFAULT_STEPS, -(-DEFAULT_VISITS * num_frames // config.views.batch_size))
