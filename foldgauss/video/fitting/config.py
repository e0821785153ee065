"""The configuration of a fit, its presets, and the defaults that depend on the clip."""

import dataclasses
import math
from dataclasses import field
from typing import Any

from foldgauss._runtime.checks import check_one_of, invalid, is_within
from foldgauss._runtime.settings import check_settings, setting
from foldgauss._runtime.threads import num_threads
from foldgauss.render import COMPOSITINGS, RenderOptions
from foldgauss.video.fitting.adam import RateUnits
from foldgauss.video.fitting.growth import EXTENT, PUBLISHED_STEPS, PUBLISHED_UNIT, Growth
from foldgauss.video.models.row_layout import MAX_DEGREE


@dataclasses.dataclass(frozen=True)
class LearningRates:
    """Learning rates of Adam at the first step, by leaf, in model space (the frame's longer side is 1).

    `frame_times` is that of the times of frames, `paths` that of the maps of shared paths.

    With `FitConfig.scale_rates_by_size` the unit of length is each Gaussian's own size s, the geometric mean of its
    standard deviations: the learning rates of m_s and c_k are `loc` and `coefficients` times s / UNIT_SIZE.
    With `FitConfig.scale_rates_by_duration` the unit of time is its own duration: the learning rate of c_k is
    `coefficients` times (UNIT_TIME / sigma_t)^k, that of m_t is `time_loc_logit` sigma_t / UNIT_TIME. That of a path is
    `paths` times s / UNIT_SIZE, with s the mean size of the Gaussians.
    A step then moves small and large, short and long Gaussians by the same fraction of their sizes and durations.
    """

    loc: float = 3.5e-4
    coefficients: float = 2e-3
    log_scale: float = 0.03
    angle_logit: float = 0.03
    opacity_logit: float = 0.075
    color_dc: float = 0.03
    time_loc_logit: float = 0.02
    log_time_scale: float = 0.05
    frame_times: float = 3e-3
    paths: float = 7e-4

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not is_within(value, "[0, inf)"):
                raise invalid(f"rates.{name}", expected="a finite number >= 0", got=value)


#: The sigma_t, and the size in units of the frame's longer side, at which the learning rates of positions, folds and
#: m_t are stated.
UNIT_TIME, UNIT_SIZE = 0.06, 0.005
#: Their state takes about 3 GB at degree 3; the paper's largest fit ends with 1.8 million.
MAX_GAUSSIANS = 10_000_000
#: A low-pass filter of 0.1 px^2 fits finer detail than the usual 0.3.
FINE = RenderOptions(low_pass=0.1)
#: How Gaussians are initialized; which learning rates decay.
INITIALIZATIONS, DECAYED = ("clip", "uniform"), ("all", "loc")
#: Engines that compute the steps of a fit, named as those of `render`.
FIT_ENGINES = ("auto", "cpu", "xla", "pallas")
#: What a diverging fit does, see `divergence`.
ON_DIVERGENCE = ("back-off", "stop")
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
        "batch_size": 3,
        "power": 2.0,
        "ssim_fraction": 0.2,
        "initialization": "uniform",
        "follow_motion": False,
        "follow_camera": False,
        "scale_rates_by_duration": False,
        "scale_rates_by_size": False,
        "sparse_updates": False,
        "l2_fraction": 0.0,
        "border_weight": 1.0,
        "rates": PUBLISHED_RATES,
        "final_rate": 0.01,
        "cooldown_fraction": 0.0,
        "decayed": "loc",
        "error_fraction": 0.0,
        "relocated_fraction": 0.0,
        "interpolation_fraction": 0.0,
        "two_cameras": True,
        "growth": Growth(),
        "scale_cutoff": PUBLISHED_SCALE_CUTOFF * PUBLISHED_UNIT,
        "options": RenderOptions.standard(),
    },
}


#: The default of `FitConfig.interpolation_fraction`.
INTERPOLATION_FRACTION = 0.1
#: Groups of settings, which are the panels of `foldgauss fit --help`.
MODEL, BUDGET, OPTIMIZATION = "model", "budget", "optimization"


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """The configuration of a fit; `FitConfig.preset` returns named ones.

    `steps` and `minutes` are budgets: the fit ends at the first that is reached. Minutes are converted into steps by
    the measured speed, and corrected until the end; with `growth` once, and then the clock ends a fit that is late.
    With neither, the fit takes `DEFAULT_STEPS`, or more for long clips.

    `quality`, `size_mb` and `psnr` ask for a compact model, see `rate`; with several, the smallest of the models.

    With `two_cameras`, half of the views of a pass are those of an opposite camera: the mirrored frame, and the splats
    seen from behind. Flat Gaussians in one plane look mirrored from there, in the same order, so the gradients equal
    those of the front view up to rounding, and a pass takes twice as long. It exists for fidelity to the paper.

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
    batch_size: int = field(
        default=1, metadata=setting("Frames per step", least=1, option="--batch-size", group=OPTIMIZATION)
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
    scale_cutoff: float = field(
        default=0.0,
        metadata=setting(
            "Gaussians are rendered only where both standard deviations exceed this, in model units",
            "These are shrunk by the envelope. The published code has 1e-4 of its units, 0.18 px of 640x1280.",
            bounds="[0, 1)",
            group=MODEL,
        ),
    )
    ssim_fraction: float = field(
        default=0.2,
        metadata=setting(
            "Fraction of D-SSIM in the loss, the rest is L1",
            bounds="[0, 1]",
            option="--ssim-fraction",
            group=OPTIMIZATION,
        ),
    )
    seed: int = field(
        default=0,
        metadata=setting(
            "Random seed of the initialization and of the order of frames", option="--seed", group=OPTIMIZATION
        ),
    )
    learn_frame_times: bool = field(default=True, metadata=setting("Optimize the frame times", group=MODEL))
    initialization: str = field(
        default="clip",
        metadata=setting(
            "Initial Gaussians are sampled from the detail and colors of the clip, or uniformly over frame and time",
            "See `initialize_uniform`.",
            choices=INITIALIZATIONS,
            group=OPTIMIZATION,
        ),
    )
    follow_motion: bool = field(
        default=True,
        metadata=setting("Initial paths follow the optical flow within each shot; otherwise they are static"),
    )
    follow_camera: bool = field(
        default=True,
        metadata=setting(
            "Gaussians may follow the motion of the camera, or that of the largest moving object, each with a fold of "
            "its own in addition",
            "A Gaussian does so where its track is then longer or its fold smaller. None does where these move "
            "steadily, nor without `follow_motion`.",
            option="--follow-camera/--no-follow-camera",
            group=MODEL,
        ),
    )
    scale_rates_by_duration: bool = field(
        default=True,
        metadata=setting("Learning rates are in units of each Gaussian's duration", "See `LearningRates`."),
    )
    scale_rates_by_size: bool = field(
        default=True,
        metadata=setting("Learning rates are in units of each Gaussian's size", "See `LearningRates`."),
    )
    l2_fraction: float = field(
        default=0.3,
        metadata=setting(
            "Fraction of the steps, at the end, whose loss is the squared error, which PSNR measures",
            "For a compact model all have it.",
            bounds="[0, 1]",
        ),
    )
    border_weight: float = field(
        default=4.0,
        metadata=setting("Factor of the gradient at the outermost pixels, covered from one side", bounds="[1, inf)"),
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
    relocated_fraction: float = field(
        default=0.05,
        metadata=setting(
            "Fraction of the Gaussians moved, three times, from the smallest contributions to the largest errors",
            "Ignored with `growth`, which adds Gaussians itself, and without `sparse_updates`.",
            bounds="[0, 0.5]",
            option="--relocated-fraction",
            group=OPTIMIZATION,
        ),
    )
    sparse_updates: bool = field(
        default=True,
        metadata=setting("Adam updates the Gaussians alive in the batch; otherwise all of them, as published"),
    )
    rates: LearningRates = field(default=LearningRates(), metadata=setting("Learning rates at the first step"))
    final_rate: float = field(
        default=0.2,
        metadata=setting(
            "Learning rates decay exponentially to this fraction of their initial values", bounds="[0, 1]"
        ),
    )
    cooldown_fraction: float = field(
        default=0.2,
        metadata=setting(
            "Fraction of the steps, at the end, in which learning rates also decrease linearly, to 2%",
            "Averages out the noise of single frames in the gradients.",
            bounds="[0, 1]",
        ),
    )
    decayed: str = field(
        default="all", metadata=setting("Which learning rates decay: all, or that of positions", choices=DECAYED)
    )
    two_cameras: bool = field(
        default=False, metadata=setting("Also fit the mirrored frames, as seen by an opposite camera")
    )
    growth: Growth | None = field(
        default=None, metadata=setting("Densification", unset="the number of Gaussians stays the same")
    )
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
    on_divergence: str = field(
        default="back-off",
        metadata=setting(
            "What a diverging fit does: back-off (to the last finite state, with lower learning rates) or stop",
            'With "stop" the fit raises `FitDiverged`.',
            choices=ON_DIVERGENCE,
            option="--on-divergence",
            group=OPTIMIZATION,
        ),
    )
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
        if self.initialization == "uniform" and self.follow_motion:
            raise invalid("follow_motion", expected="False with initialization 'uniform'", got=True)

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
        return COMPACT_SQUARED_FROM if self.is_compact else 1 - self.l2_fraction

    @property
    def rate_units(self) -> RateUnits:
        """The units in which `rates` are stated."""
        by_time, by_size = self.scale_rates_by_duration, self.scale_rates_by_size
        return RateUnits(UNIT_TIME if by_time else 0.0, UNIT_SIZE if by_size else 0.0)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "FitConfig":
        """A named configuration with `changes` to its fields; `minutes` without `steps` replace the preset's steps.

        * "standard": `FitConfig()`.
        * "draft": a first impression in a fraction of the time: 10,000 Gaussians, 800 steps.
        * "paper": the published configuration. 500,000 Gaussians, initialized uniformly, that grow (`Growth`), degree
          7, batches of 3, 30,000 steps, 0.8 L1 + 0.2 D-SSIM, two opposite cameras, the published learning rates, of
          which only that of positions decays (to 1/100), Adam updates of all Gaussians, the published rasterizer's
          constants. Other numbers of steps scale the growth schedule in proportion, but not the learning rates, so fits
          of a few thousand steps stop early. As in the published code a Gaussian is rendered only where both standard
          deviations, multiplied by the envelope, exceed 1e-4 of its units (`scale_cutoff`).
          Source: VeGaS, "Implementation Details", and constants of its published code.

        Raises ValueError for an unknown name or change. Example: `FitConfig.preset("paper", steps=3000)`.
        """
        check_one_of("preset", name, tuple(PRESETS))
        unknown = changes.keys() - {field.name for field in dataclasses.fields(cls)}
        if unknown:
            raise invalid("changes", expected="fields of FitConfig", got=", ".join(sorted(unknown)))
        chosen = dict(PRESETS[name])
        if changes.get("minutes") is not None:
            chosen["steps"] = None
        return cls(**(chosen | changes))


#: Steps if neither steps nor minutes are given: this many, and at least so many visits to every frame.
DEFAULT_STEPS, DEFAULT_VISITS = 3000, 20
#: Time of a core for each pixel of a step, in microseconds, by which steps and minutes are compared.
PIXEL_TIME = 0.4
#: Gaussians per pixel of a clip where a core has one microsecond for each, and where they live for one frame; it grows
#: by these powers of the time and of the lifetime. Gaussians that live long are seldom needed anew.
DENSITY, DENSITY_POWER, LIFETIME_POWER = 0.0205, 0.85, -0.6
#: A model with parameters of so many bytes is at most as large as the frames as bytes.
PARAMETER_BYTES = 2
#: Mean lifetimes in frames: of slow clips (*Bunny* 68, carphone 35), and the shortest, in flicker. DAVIS: 5 to 19.
TYPICAL_LIFETIME, SHORTEST_LIFETIME = 35.0, 2.0
#: Gaussians alive in a frame, at most: for a frame of one pixel and one microsecond; it grows by these powers of the
#: time, likewise, and of the pixels. Where they live long, more of them leave time for too few steps.
ALIVE, ALIVE_POWER, ALIVE_PIXEL_POWER = 0.378, 0.55, 0.95
#: More Gaussians than this in each pixel gain nothing, however much time there is.
MOST_PER_PIXEL = 1.6


#: The quality of compact models that `foldgauss fit` has by default.
DEFAULT_QUALITY = 70.0
#: The fraction of the plan of a compact fit from which the loss is the squared error. Of clips with alpha, where most
#: pixels are empty, it would leave edges blurred for long.
COMPACT_SQUARED_FROM = 0.3
#: Gaussians per pixel of a clip with which a fit of quality 50 starts: some three times as many as it keeps.
START_DENSITY = 0.012
#: Growth of the binary logarithm of that number for each unit of quality.
DENSITY_PER_QUALITY = 0.08
#: The PSNR of usual clips at quality 50, in dB.
PSNR_AT_50 = 35.0
#: Growth of the binary logarithm of that number for each dB of the PSNR that is asked for.
DENSITY_PER_DB = 0.32
#: Gaussians per pixel of a clip for each microsecond of x, see `default_num_gaussians`, with which a fit of a compact
#: model starts at most: those that do not converge are not worth their bits.
START_PER_TIME = 7e-4
#: Gaussians that a fit starts with for each 10^6 bytes of the largest file: some three times as many as it keeps.
GAUSSIANS_PER_MB = 300_000


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
    parameters, with `PARAMETER_BYTES` each, take as many bytes as the frames. x is the time that `steps` take, or
    `minutes` times the number of `threads` (default: those of this process).
    """
    area = height * width
    pixels = num_frames * area
    steps, budgets = planned_steps(config, num_frames), []  # in microseconds for each pixel of all frames
    if steps is not None:
        budgets.append(PIXEL_TIME * steps * config.batch_size / num_frames)
    if config.minutes is not None:
        budgets.append(60e6 * config.minutes * (threads or num_threads()) / pixels)
    time = min(budgets)
    by_time = DENSITY * time**DENSITY_POWER * lifetime**LIFETIME_POWER * pixels
    alive = min(ALIVE * time**ALIVE_POWER * area**ALIVE_PIXEL_POWER, MOST_PER_PIXEL * area)
    by_life = alive * num_frames / lifetime
    by_size = 3 * pixels / (PARAMETER_BYTES * parameters_per_gaussian(config.fold_degree))
    return max(round(min(by_time, by_life, by_size, _most_for_rate(config, pixels, time))), 1)


def _most_for_rate(config: FitConfig, pixels: int, time: float) -> float:
    """A few times as many Gaussians as a compact model usually keeps, whose number depends on the clip."""
    limits = [START_PER_TIME * time * pixels if config.is_compact else math.inf]
    if config.quality is not None:
        limits.append(pixels * START_DENSITY * 2 ** (DENSITY_PER_QUALITY * (config.quality - 50)))
    if config.psnr is not None:  # at what quality is not known yet, so more than twice as many
        limits.append(2.5 * pixels * START_DENSITY * 2 ** (DENSITY_PER_DB * (config.psnr - PSNR_AT_50)))
    if config.size_mb is not None:
        limits.append(GAUSSIANS_PER_MB * config.size_mb)
    return min(limits)


def parameters_per_gaussian(degree: int) -> int:
    return 11 + 2 * degree


def bytes_per_gaussian(degree: int) -> int:
    """Of a model file."""
    return 4 * parameters_per_gaussian(degree)


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
    return config.steps or max(DEFAULT_STEPS, -(-DEFAULT_VISITS * num_frames // config.batch_size))


def chosen_interpolation(config: FitConfig, *, alpha: bool) -> float:
    """The fraction of the first steps that fit interpolated frames; `alpha`: whether the frames have it.

    By default none do where optical flow is not used or does not tell what is there (behind alpha).
    """
    if config.interpolation_fraction is not None:
        return config.interpolation_fraction
    return INTERPOLATION_FRACTION if config.follow_motion and not alpha else 0.0
