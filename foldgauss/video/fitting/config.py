"""What a fit depends on beside its frames: numbers of things, budgets, rates."""

import dataclasses
import math
from typing import Any

from foldgauss._runtime.checks import check_one_of, invalid, is_integer, is_within
from foldgauss.render import COMPOSITINGS, RenderOptions
from foldgauss.video.fitting.economy import Economy
from foldgauss.video.fitting.growth import EXTENT, PUBLISHED_STEPS, PUBLISHED_UNIT, Growth


@dataclasses.dataclass(frozen=True)
class LearningRates:
    """Adam rates at the first step, by leaf; model space (the frame's longer side is 1).

    With `FitConfig.scale_rates_by_duration` each Gaussian's own duration is the unit of time: c_k learns at the rate
    `coefficients` (UNIT_TIME / sigma_t)^k, m_t at `time_loc_logit` sigma_t / UNIT_TIME. So a step moves short Gaussians
    in space as far as long ones, and in time by the same share of their life.
    """

    loc: float = 6.9e-4
    coefficients: float = 4e-3
    log_scale: float = 0.06
    angle_logit: float = 0.06
    opacity_logit: float = 0.15
    color_dc: float = 0.06
    time_loc_logit: float = 0.04
    log_time_scale: float = 0.1
    frame_times: float = 3e-3

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise invalid(f"rates.{name}", expected="a finite number >= 0", got=value)


#: The sigma_t for which the rates of folds and m_t are given.
UNIT_TIME = 0.06
#: Their state takes some 3 GB at degree 3; the paper's largest fit ends with 1.8 million.
MAX_GAUSSIANS = 10_000_000
#: Beyond, powers of u and their gradients no longer tell the coefficients apart in float32.
MAX_DEGREE = 16
#: 0.1 px^2 of low pass fits finer detail than the usual 0.3.
FINE = RenderOptions(low_pass=0.1)
#: Where Gaussians start, and which rates fall.
INITIALIZATIONS, DECAYED = ("clip", "uniform"), ("all", "loc")
#: What computes the steps of a fit, as the engines of `render`; "auto" is "cpu" where there is no GPU.
FIT_ENGINES = ("auto", "cpu", "xla", "pallas")
#: What a fit does that comes apart, see `guard`.
ON_DIVERGENCE = ("back-off", "stop")
#: The published rates, those of lengths in our unit; published positions learn in units of the scene's extent.
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
#: What each preset changes, see `FitConfig.preset`.
PRESETS: dict[str, dict[str, Any]] = {
    "standard": {},
    "draft": {"num_gaussians": 10_000, "degree": 2, "steps": 800},
    "paper": {
        "num_gaussians": 500_000,
        "degree": 7,
        "steps": PUBLISHED_STEPS,
        "batch_size": 3,
        "power": 2.0,
        "ssim_fraction": 0.2,
        "initialization": "uniform",
        "follow_motion": False,
        "scale_rates_by_duration": False,
        "quarter_fraction": 0.0,
        "half_fraction": 0.0,
        "sparse_updates": False,
        "l2_fraction": 0.0,
        "rates": PUBLISHED_RATES,
        "final_rate": 0.01,
        "decayed": "loc",
        "two_cameras": True,
        "growth": Growth(),
        "options": RenderOptions.standard(),
    },
}


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Everything a fit depends on beside the frames; `preset` has some of them ready.

    `steps`, `minutes` and `target_psnr` are budgets: the fit ends with the first that binds. Minutes are turned into
    steps once, by the measured pace; where Gaussians grow (`growth`, `economy`), or with a target, the clock ends the
    fit. A
    target is looked for once in four passes through the frames. With neither steps nor minutes, steps are
    `DEFAULT_STEPS`, or more for long clips. `max_size_mb` bounds the number of Gaussians by the model file's size.

    With `two_cameras` half of the views of a pass are those of the camera opposite: each frame's mirrored picture, and
    the splats as seen from behind. Flat Gaussians in one plane look mirrored from there, in the same order, so this
    gives the gradients of the front view to rounding; a pass is twice as long, and that is all. It is there for
    fidelity to the paper.
    """

    num_gaussians: int | None = None  #: at the start; None: by size and number of the frames, `default_num_gaussians`
    max_gaussians: int | None = None  #: at any time; None: `MAX_GAUSSIANS`
    degree: int = 3
    steps: int | None = None
    minutes: float | None = None
    target_psnr: float | None = None  #: dB, mean over all frames; no coarse levels then
    max_size_mb: float | None = None  #: 10^6 bytes
    batch_size: int = 1
    power: float = 1.0  #: of the envelope: 1 as in the paper's text, 2 as in its code
    floor: float = 0.0  #: of the envelope
    ssim_fraction: float = 0.2
    seed: int = 0
    learn_frame_times: bool = True
    #: Drawn from the "clip", its detail and its colours, or "uniform" over frame and time, see `initialize_uniform`.
    initialization: str = "clip"
    follow_motion: bool = True  #: start along the optical flow, shot by shot; False: at rest
    scale_rates_by_duration: bool = True  #: rates in units of each Gaussian's own time, see `LearningRates`
    #: Of the plan, at its beginning: frames at a quarter, then at half of their size, as far as they are large enough.
    quarter_fraction: float = 0.2
    half_fraction: float = 0.4
    l2_fraction: float = 0.3  #: of the plan, at its end: squared error alone, which is what PSNR measures
    #: Of the steps: a time between two frames, where what the optical flow knows of it is learned instead of a frame.
    #: Better slow motion, and less quality at the frames.
    interpolation_fraction: float = 0.0
    #: Adam's steps are for Gaussians alive in the batch; False: for all, by momentum, as published.
    sparse_updates: bool = True
    rates: LearningRates = LearningRates()
    final_rate: float = 0.07  #: rates fall exponentially to this share of themselves
    decayed: str = "all"  #: which do: all, or "loc", that of positions alone
    two_cameras: bool = False  #: see above
    growth: Growth | None = None  #: None: the number of Gaussians stays
    economy: Economy | None = None  #: None: nothing is dropped
    #: "over": front to back as 3DGS and VeGaS; "sum": contributions added up, in any order, as GaussianImage.
    compositing: str = "over"
    options: RenderOptions = FINE
    #: Where numbers become infinite or pictures much worse: "back-off" to the last sound state, with lower rates, or
    #: "stop" with `FitDiverged`.
    on_divergence: str = "back-off"
    #: What computes the steps: "cpu", or on JAX's default device "xla" or "pallas", see docs/gpu.md; "auto": "cpu",
    #: unless there is a GPU, and no setting that only "cpu" knows.
    engine: str = "auto"

    def __post_init__(self) -> None:
        numbers = {"num_gaussians": 1, "max_gaussians": 1, "degree": 0, "steps": 1, "batch_size": 1, "seed": 0}
        for name, least in numbers.items():
            value = getattr(self, name)
            if value is None and name in ("num_gaussians", "max_gaussians", "steps"):
                continue
            if not is_integer(value, least):
                raise invalid(name, expected=f"a whole number >= {least}", got=repr(value))
            object.__setattr__(self, name, int(value))  # NumPy's integers have no place in a checkpoint
        for name, most in {
            "degree": MAX_DEGREE,
            "num_gaussians": MAX_GAUSSIANS,
            "max_gaussians": MAX_GAUSSIANS,
        }.items():
            if (getattr(self, name) or 0) > most:
                raise invalid(name, expected=f"at most {most:,}", got=f"{getattr(self, name):,}")
        ranges = {
            "minutes": "(0, inf)",
            "target_psnr": "(0, inf)",
            "max_size_mb": "(0, inf)",
            "power": "[0, 16]",
            "floor": "[0, 1)",
            "ssim_fraction": "[0, 1]",
            "final_rate": "[0, 1]",
            "l2_fraction": "[0, 1]",
            "interpolation_fraction": "[0, 1)",
            "quarter_fraction": "[0, 1]",
            "half_fraction": "[0, 1]",
        }
        for name, bounds in ranges.items():
            value = getattr(self, name)
            if value is None and name in ("minutes", "target_psnr", "max_size_mb"):
                continue
            if not is_within(value, bounds):
                raise invalid(name, expected=f"a number in {bounds}", got=repr(value))
            object.__setattr__(self, name, float(value))
        check_one_of("initialization", self.initialization, INITIALIZATIONS)
        check_one_of("decayed", self.decayed, DECAYED)
        check_one_of("on_divergence", self.on_divergence, ON_DIVERGENCE)
        check_one_of("engine", self.engine, FIT_ENGINES)
        check_one_of("compositing", self.compositing, COMPOSITINGS)
        if self.quarter_fraction + self.half_fraction > 1:
            got = f"{self.quarter_fraction:g} and {self.half_fraction:g}"
            raise invalid("quarter_fraction, half_fraction", expected="at most 1 together", got=got)
        flags = ("learn_frame_times", "follow_motion", "scale_rates_by_duration", "sparse_updates", "two_cameras")
        kinds = dict.fromkeys(flags, bool) | {"rates": LearningRates, "options": RenderOptions}
        if self.growth is not None:
            kinds |= {"growth": Growth}
        if self.economy is not None:
            kinds |= {"economy": Economy}
            if self.compositing == "sum":
                # Overlapping contributions add up: what each is worth says nothing of what several are.
                cure = "Leave the economy out, or take 'over'."
                raise invalid("compositing", expected="'over' with an economy", got="'sum'", cure=cure)
            if self.target_psnr is not None:
                cure = "The smallest model at a PSNR: Economy(psnr=...), or --smallest-at-psnr, alone."
                raise invalid("target_psnr", expected="None with an economy", got=self.target_psnr, cure=cure)
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):
                article = "an" if kind.__name__[0] in "AEIOU" else "a"
                raise invalid(name, expected=f"{article} {kind.__name__}", got=repr(getattr(self, name)))
        if self.initialization == "uniform" and self.follow_motion:
            raise invalid("follow_motion", expected="False with initialization 'uniform'", got=True)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "FitConfig":
        """A named recipe, with `changes` to its fields; `minutes` given without `steps` replace a preset's steps.

        * "standard": `FitConfig()`.
        * "draft": a first look in a fraction of the time: 10,000 Gaussians of degree 2, 800 steps.
        * "paper": the published recipe. 500,000 Gaussians that start uniformly and grow (`Growth`), degree 7, batches
          of 3, 30,000 steps, L1 + 0.2 D-SSIM, two opposing cameras, the published rates, of which that of positions
          alone falls (to 1/100), Adam's momentum for all, the published rasteriser's constants. With other numbers of
          steps the schedule of growth is scaled in proportion; rates are not, so plans of a few thousand steps end
          early on their way. Unknown, and so ours: the box of the starts and the threshold of the time gradient. Not
          taken over: the published code leaves out Gaussians thinner than 1e-4 of its units.
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


#: Room for a model file's header.
HEADER_BYTES = 4096
#: Steps where neither steps nor minutes are given: this many, and at least so many visits to every frame.
DEFAULT_STEPS, DEFAULT_VISITS = 3000, 12
#: Of the default number of Gaussians, those that the smallest model at a PSNR starts from. (Bunny 80x160 at 33 dB,
#: which takes 3,100: 31.9 thousand numbers from 20,000 Gaussians, 30.9 from 14,000, 36.2 from 40,000.)
SMALLEST_SHARE = 0.7
#: Times as many for the smallest model at a PSNR: what is dropped must be made up for.
SMALLEST_TIMES = 2


def default_num_gaussians(num_frames: int, height: int, width: int) -> int:
    """40,000 for 160x320, growing as the square root of the pixels: larger frames are smoother per pixel.

    Clips for which steps are more than `DEFAULT_STEPS` get more in proportion, so that frames have no fewer each.
    """
    return round(177 * math.sqrt(height * width) * max(1.0, DEFAULT_VISITS * num_frames / DEFAULT_STEPS))


def chosen_num_gaussians(config: FitConfig, num_frames: int, height: int, width: int) -> int:
    """Gaussians at the start: `num_gaussians`, or fewer as `most_gaussians` bids. Raises ValueError as it does."""
    asked = config.num_gaussians or default_num_gaussians(num_frames, height, width)
    if config.num_gaussians is None and config.economy is not None and config.economy.psnr is not None:
        asked = max(round(SMALLEST_SHARE * asked), 1)
    return min(asked, most_gaussians(config, num_frames))


def most_gaussians(config: FitConfig, num_frames: int) -> int:
    """What `max_gaussians` and `max_size_mb` come to. Raises ValueError if not one Gaussian fits."""
    most = config.max_gaussians or MAX_GAUSSIANS
    if config.max_size_mb is None:
        return most
    each = 4 * (11 + 2 * config.degree)  # bytes
    room = int((1e6 * config.max_size_mb - HEADER_BYTES - 4 * num_frames) // each)
    if room < 1:
        least = (HEADER_BYTES + 4 * num_frames + each) / 1e6
        raise invalid("max_size_mb", expected=f"at least {least:.3f} for this clip", got=config.max_size_mb)
    return min(most, room)


def planned_steps(config: FitConfig, num_frames: int) -> int | None:
    """Steps of the whole fit; None where time ends it and no number of steps does."""
    if config.minutes is not None:
        return config.steps
    steps = max(DEFAULT_STEPS, -(-DEFAULT_VISITS * num_frames // config.batch_size))
    smallest = config.economy is not None and config.economy.psnr is not None
    return config.steps or (SMALLEST_TIMES * steps if smallest else steps)
