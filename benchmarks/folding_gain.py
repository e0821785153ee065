"""What folds bring: a folded video against every frame its own Gaussians (eq:miragevideo), at equal parameters stored.

    python -m benchmarks.folding_gain [--json FILE] [--clip bunny|bikes|carphone|PATH ...] [--size HxW] [--frames A:B]
                                      [--minutes M | --steps N] [--longer F] [--gaussians N] [--seed S]

Without options: *bunny* at 160x320, *bikes* and *carphone* at their own sizes, 3 minutes for each of the two fits, some
20 minutes in all. The default fit first; then one fit for each frame, with as many numbers in all (a Gaussian of one
frame takes 9: it has no time, no sigma_t and no fold) in as many seconds of fitting. With --json each fit that is done
is kept there, and the same command continues after it. With --steps both see every frame equally often instead: a try,
not a fair match, since a step of a few hundred Gaussians costs less. `--longer F` adds the control with F times the
time or steps.

PSNR and SSIM are of 8-bit pictures, mean over all frames.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from benchmarks import _common
from benchmarks._clips import clip_path
from benchmarks._runs import Run, Runs, fitted, scores
from foldgauss.io import Clip, read_video
from foldgauss.video import FitConfig, LearningRates, VideoModel, fit

SIZES = {"bunny": (160, 320), "bikes": None, "carphone": None}
MINUTES = 3.0
FOLDED = "folded"
ALONE = "independent frames"
#: Parameters of a Gaussian without time: position 2, scales 2, angle, opacity, color 3.
PARAMETERS = 9
#: Factor of the learning rates, which are meant for Gaussians that many frames act on (notes/experiments.md).
RATE_FACTOR = 4.0
#: Factor of the learning rate of positions.
LOC_RATE_FACTOR = 8.0


class Frames(NamedTuple):
    """A model of one frame for each frame."""

    models: list[VideoModel]

    @property
    def size(self) -> tuple[int, int]:
        return self.models[0].size

    @property
    def num_frames(self) -> int:
        return len(self.models)

    def frames(self, background: tuple[float, float, float]) -> Iterator[np.ndarray]:
        for model in self.models:
            yield from model.frames(background=background)


def of_frames(clip: Clip, num_parameters: int, config: FitConfig) -> Run:
    """The control's quality and what it took.

    The first frames get the Gaussians that equal numbers leave over; minutes are divided evenly among the frames left.
    """
    each, more = divmod(num_parameters // PARAMETERS, clip.num_frames)
    rates = {"loc": LOC_RATE_FACTOR, "log_scale": RATE_FACTOR, "angle_logit": RATE_FACTOR, "opacity_logit": RATE_FACTOR}
    rates |= {"color_dc": RATE_FACTOR}
    scaled = {name: factor * getattr(config.rates, name) for name, factor in rates.items()}
    alone = {"degree": 0, "power": 0.0, "initialization": "static"}
    alone |= {"rates": LearningRates(**scaled, frame_times=0.0, own_units=False)}
    models, steps, seconds = [], 0, 0.0
    for k in range(clip.num_frames):
        left = None if config.minutes is None else (config.minutes - seconds / 60) / (clip.num_frames - k)
        own = {"num_gaussians": each + (k < more), "seed": config.seed + k, "minutes": left and max(left, 1e-3)}
        result = fit(clip.frames[k : k + 1], dataclasses.replace(config, **alone, **own), fps=clip.fps)
        models.append(result.model)
        steps += result.history[-1].step
        seconds += result.history[-1].seconds
    num = sum(model.num_gaussians for model in models)
    run = scores(Frames(models), clip.frames) | {"gaussians": num, "floats": PARAMETERS * num}
    return run | {"steps": steps, "frames_seen": steps * config.views.batch_size, "seconds": seconds}


def measure(name: str, clip: Clip, config: FitConfig, runs: Runs, longer: float | None = None) -> dict[str, Run]:
    """Both fits of a clip; and with `longer` the control with so many times the budget."""
    folded = runs.get(f"{name} {FOLDED}", lambda: fitted(clip, config)[1])
    times = {ALONE: 1.0} | ({f"{ALONE}, {longer:g} times as long": longer} if longer else {})
    made = {FOLDED: folded}
    for title, factor in times.items():
        if config.minutes is not None:
            budget = {"minutes": factor * folded["seconds"] / 60}
        else:
            budget = {"steps": max(round(factor * folded["steps"] / clip.num_frames), 1)}
        own = dataclasses.replace(config, num_gaussians=None, **budget)
        made[title] = runs.get(f"{name} {title}", lambda own=own: of_frames(clip, folded["floats"], own))
    return made


def show(title: str, made: dict[str, Run]) -> None:
    columns = "fit", "PSNR, dB", "worst", "SSIM", "Gaussians", "parameters stored", "frames seen", "minutes", "loss, dB"
    forms = {"psnr": ".2f", "worst_psnr": ".2f", "ssim": ".4f", "gaussians": ",", "floats": ",", "frames_seen": ","}
    rows = []
    for name, run in made.items():
        cells = (format(run[figure], form) for figure, form in forms.items())
        rows.append((name, *cells, f"{run['seconds'] / 60:.2f}", f"{made[FOLDED]['psnr'] - run['psnr']:+.2f}"))
    _common.print_table(title, columns, rows)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.fit_parser(__doc__, MINUTES)
    parser.add_argument("--size", type=_common.parse_size, metavar="HxW", help="of the frames [see above]")
    parser.add_argument("--clip", action="append", help="a sample clip or a path; may be given again [all three]")
    parser.add_argument("--longer", type=_common.positive, metavar="F", help="the control again, F times as long")
    options = _common.parse(parser, arguments)
    budget = _common.budget(options)
    kept = {"size": options.size, "frames": options.frames, "gaussians": options.gaussians, "seed": options.seed}
    runs, figures = Runs(options.json, kept | budget), {}
    for name in options.clip or tuple(SIZES):
        path = clip_path(name)
        clip = read_video(path, frames=options.frames, size=options.size or SIZES.get(name))
        config = FitConfig(num_gaussians=options.gaussians, seed=options.seed, **budget)
        made = measure(path.name, clip, config, runs, options.longer)
        show(f"{path.stem}: {clip.num_frames} frames of {clip.size[0]}x{clip.size[1]}, seed {options.seed}", made)
        figures |= {f"{path.stem}, {title}: loss": made[FOLDED]["psnr"] - run["psnr"] for title, run in made.items()}
    runs.finish(figures)


if __name__ == "__main__":
    main()
