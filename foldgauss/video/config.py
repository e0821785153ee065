"""What a fit depends on beside its frames: numbers of things, budgets, rates."""

import dataclasses
import math
from numbers import Integral, Real

from foldgauss._checks import invalid
from foldgauss.render import RenderOptions


@dataclasses.dataclass(frozen=True)
class LearningRates:
    """Adam rates at the first step, by leaf; model space (the frame's longer side is 1).

    With `FitConfig.own_time` each Gaussian's own duration is the unit of what is in units of time: c_k learns at
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


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Everything a fit depends on beside the frames.

    `steps`, `minutes` and `target_psnr` are budgets: the fit ends with the first that binds. With neither steps nor
    minutes, steps are `DEFAULT_STEPS`, or more for long clips. `max_size_mb` bounds the number of Gaussians by the
    model file's size.
    """

    num_gaussians: int | None = None  # None: by the size of the frames, `default_num_gaussians`
    degree: int = 3
    steps: int | None = None
    minutes: float | None = None
    target_psnr: float | None = None  # dB, running mean over a pass through the frames
    max_size_mb: float | None = None  # 10^6 bytes
    batch_size: int = 1
    power: float = 2.0  # of the envelope: 1 as in the paper's text, 2 as in its code
    floor: float = 0.0  # of the envelope
    ssim_share: float = 0.2
    seed: int = 0
    learn_frame_times: bool = True
    follow_motion: bool = True  # start along the optical flow, shot by shot; False: at rest
    own_time: bool = True  # rates in units of each Gaussian's own time, see `LearningRates`
    square_share: float = 0.3  # of the plan, at its end: squared error alone, which is what PSNR measures
    rates: LearningRates = LearningRates()
    final_rate: float = 0.07  # all rates fall exponentially to this share of themselves
    options: RenderOptions = FINE

    def __post_init__(self) -> None:
        whole = {"num_gaussians": 1, "degree": 0, "steps": 1, "batch_size": 1, "seed": 0}
        for name, least in whole.items():
            value = getattr(self, name)
            if value is None and name in ("num_gaussians", "steps"):
                continue
            if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
                raise invalid(name, expected=f"a whole number >= {least}", got=repr(value))
            object.__setattr__(self, name, int(value))  # NumPy's integers have no place in a checkpoint
        for name, most in {"degree": MAX_DEGREE, "num_gaussians": MAX_GAUSSIANS}.items():
            if (getattr(self, name) or 0) > most:
                raise invalid(name, expected=f"at most {most:,}", got=f"{getattr(self, name):,}")
        # "[" includes the bound, "(" does not.
        ranges = {
            "minutes": "(0, inf)",
            "target_psnr": "(0, inf)",
            "max_size_mb": "(0, inf)",
            "power": "[0, 16]",
            "floor": "[0, 1)",
            "ssim_share": "[0, 1]",
            "final_rate": "[0, 1]",
            "square_share": "[0, 1]",
        }
        for name, bounds in ranges.items():
            value = getattr(self, name)
            if value is None and name in ("minutes", "target_psnr", "max_size_mb"):
                continue
            if not _within(value, bounds):
                raise invalid(name, expected=f"a number in {bounds}", got=repr(value))
            object.__setattr__(self, name, float(value))
        flags = dict.fromkeys(("learn_frame_times", "follow_motion", "own_time"), bool)
        for name, kind in (flags | {"rates": LearningRates, "options": RenderOptions}).items():
            if not isinstance(getattr(self, name), kind):
                raise invalid(name, expected=f"a {kind.__name__}", got=repr(getattr(self, name)))


def _within(value: object, bounds: str) -> bool:
    """Whether `value` is a finite number in an interval written as "[0, 1)"."""
    if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
        return False
    low, high = (float(part) for part in bounds[1:-1].split(","))
    return (low < value or (bounds[0] == "[" and low == value)) and (
        value < high or (bounds[-1] == "]" and value == high)
    )


#: Room for a model file's header.
HEADER_BYTES = 4096
#: Steps where neither steps nor minutes are given: this many, and at least so many visits to every frame.
DEFAULT_STEPS, DEFAULT_VISITS = 3000, 12


def default_num_gaussians(height: int, width: int) -> int:
    """40,000 for 160x320, growing as the square root of the pixels: larger frames are smoother per pixel."""
    return round(177 * math.sqrt(height * width))


def chosen_num_gaussians(config: FitConfig, num_frames: int, height: int, width: int) -> int:
    """What `num_gaussians` and `max_size_mb` come to. Raises ValueError if not one Gaussian fits."""
    wanted = config.num_gaussians or default_num_gaussians(height, width)
    if config.max_size_mb is None:
        return wanted
    each = 4 * (11 + 2 * config.degree)  # bytes
    room = int((1e6 * config.max_size_mb - HEADER_BYTES - 4 * num_frames) // each)
    if room < 1:
        least = (HEADER_BYTES + 4 * num_frames + each) / 1e6
        raise invalid("max_size_mb", expected=f"at least {least:.3f} for this clip", got=config.max_size_mb)
    return min(wanted, room)


def planned_steps(config: FitConfig, num_frames: int) -> int | None:
    """Steps of the whole fit; None where time ends it and no number of steps does."""
    if config.minutes is not None:
        return config.steps
    return config.steps or max(DEFAULT_STEPS, -(-DEFAULT_VISITS * num_frames // config.batch_size))
