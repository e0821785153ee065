"""What each idea of the default fit brings: on and off at equal time, or at equal steps.

    python -m benchmarks.ideas [--json FILE] [--clip bunny|bikes ...] [--minutes M | --steps N] [--seeds N]
                               [--idea NAME ...]

Every idea is switched off alone, everything else as in `FitConfig()`; fits of one clip and seed run one after another,
the default among them, so that a slow minute of the machine hits neighbours alike. With `--steps` the machine's pace
does not matter, which is fair to ideas that do not change what a step costs. PSNR is the mean over all frames of 8-bit
pictures. *Bunny* is at 160x320 with 40,000 Gaussians, *bikes* at its own 272x640 with the default's number.
"""

import dataclasses
import itertools
import statistics

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.render import RenderOptions
from foldgauss.video import FitConfig, evaluate, fit

#: What switches an idea off.
IDEAS = {
    "starts along the flow, shots apart": {"follow_motion": False},
    "rates in units of own time": {"scale_rates_by_duration": False},
    "rates in units of own size": {"scale_rates_by_size": False},
    "squared error at the end": {"l2_fraction": 0.0},
    "frame times learned": {"learn_frame_times": False},
    "low pass 0.1 px^2 instead of 0.3": {"options": RenderOptions()},
}
CLIPS = {"bunny": ((160, 320), 40_000), "bikes": (None, None)}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", choices=tuple(CLIPS), action="append", help="[both]")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=float, default=0.5, help="of each fit [0.5]")
    length.add_argument("--steps", type=_common.whole, help="of each fit, instead of minutes")
    parser.add_argument("--seeds", type=_common.whole, default=3, help="[3]")
    parser.add_argument("--idea", choices=tuple(IDEAS), action="append", help="only this one [all]")
    options = _common.parse(parser, arguments)
    ideas = options.idea or list(IDEAS)
    budget = {"minutes": options.minutes} if options.steps is None else {"steps": options.steps}
    figures = {}
    for name in options.clip or list(CLIPS):
        size, num = CLIPS[name]
        clip = read_video(sample_clip(name), size=size)
        base = FitConfig(num_gaussians=num, **budget)
        psnr: dict[str, list[float]] = {"default": [], **{idea: [] for idea in ideas}}
        for seed, what in itertools.product(range(options.seeds), psnr):
            config = dataclasses.replace(base, seed=seed, **IDEAS.get(what, {}))
            result = fit(clip.frames, config, fps=clip.fps)
            psnr[what].append(evaluate(result.model, clip.frames).mean_psnr)
            text = f"{name}, seed {seed}, {what}: {psnr[what][-1]:.2f} dB, {result.history[-1].step:,} steps"
            console.print(text, style="dim", soft_wrap=True)
        figures |= show(name, psnr, options)
    _common.finish(options.json, figures, _common.describe_machine(), **budget, seeds=options.seeds)


def show(clip: str, psnr: dict[str, list[float]], options) -> dict[str, float]:
    """Print a clip's table; returns its figures: what each idea brings, in dB, mean and range over the seeds."""
    length = f"{options.minutes:g} minutes" if options.steps is None else f"{options.steps:,} steps"
    title = f"{clip}: dB with the idea less dB without, {length}, {options.seeds} seeds"
    table = _common.table(title, "idea", "mean", "lowest", "highest")
    default = psnr.pop("default")
    figures = {f"{clip}_default_psnr": statistics.fmean(default)}
    for idea, without in psnr.items():
        gains = [one - other for one, other in zip(default, without, strict=True)]
        table.add_row(idea, *(f"{value:+.2f}" for value in (statistics.fmean(gains), min(gains), max(gains))))
        figures[f"{clip}_{idea}"] = statistics.fmean(gains)
    table.add_section()
    table.add_row("the default, dB", f"{statistics.fmean(default):.2f}", f"{min(default):.2f}", f"{max(default):.2f}")
    console.print(table)
    return figures


if __name__ == "__main__":
    main()
