"""Quality of a fit against time, on one clip.

    python -m benchmarks.fit_clip [--json FILE] [--clip bunny|bikes|carphone|PATH] [--size HxW] [--frames A:B]
                                  [--gaussians N] [--degree K] [--steps N | --minutes M] [--seed S]
                                  [--preset standard|draft|paper] [--set NAME=VALUE ...] [--plot FILE]

Without options: all 132 Bunny frames at 160x320, 40,000 Gaussians, degree 3, 2 minutes. Other clips keep their own size
and get `default_num_gaussians` by it; other presets have their own numbers. `--set` changes any other field of
`FitConfig`, to switch an idea off: `--set follow_motion=False`. `benchmarks.fit_bunny` and `benchmarks.fit_clips` are
this with other defaults.

The way there is the running PSNR of the fit itself (of the frames as last seen, before rounding to 8 bits);
`--plot` draws it. The end is `foldgauss.video.evaluate`: scikit-image's PSNR and SSIM of 8-bit pictures, mean
over all frames. `minutes` is the wall time of the whole fit, motion, starts and compilation included, reading and
evaluation not.
"""

import argparse
import ast
import time
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import Clip, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.video.fitting.config import PRESETS, FitConfig
from foldgauss.video.fitting.loop import FitInfo, fit
from foldgauss.video.models.metrics import Evaluation, evaluate
from foldgauss.video.models.video_model import VideoModel

SAMPLES = ("bunny", "bikes", "carphone")
BUNNY_SIZE, BUNNY_GAUSSIANS = (160, 320), 40_000  # the line of the design, section 7
MINUTES = 2.0
POINTS = 12


def read(options: argparse.Namespace) -> Clip:
    path = sample_clip(options.clip) if options.clip in SAMPLES else Path(options.clip)
    size = BUNNY_SIZE if options.clip == "bunny" and options.size is None else options.size
    return read_video(path, frames=options.frames, size=size)


def configuration(options: argparse.Namespace) -> FitConfig:
    names = {"num_gaussians": "gaussians"} | {name: name for name in ("degree", "steps", "minutes", "seed")}
    given = {name: getattr(options, own) for name, own in names.items() if getattr(options, own) is not None}
    if options.preset == "standard":
        if options.clip == "bunny" and options.size is None:
            given = {"num_gaussians": BUNNY_GAUSSIANS} | given
        if options.steps is None:
            given = {"minutes": MINUTES} | given
    return FitConfig.preset(options.preset, **given | dict(options.set or ()))


def run(clip: Clip, config: FitConfig) -> tuple[VideoModel, list[FitInfo], float]:
    """The model, the infos of `POINTS` moments, and the wall seconds of the fit."""
    kept = []

    def observe(_state, info: FitInfo) -> None:
        before = kept[-1].progress if kept else 0.0
        if int(info.progress * POINTS) > int(before * POINTS):
            kept.append(info)
            console.print(f"{info.seconds:6.1f} s  step {info.step:6,}  {info.psnr:.2f} dB", style="dim")

    begun = time.perf_counter()
    model = fit(clip.frames, config, fps=clip.fps, observers=[observe]).model
    return model, kept, time.perf_counter() - begun


def show(kept: list[FitInfo], scores: Evaluation, seconds: float, title: str) -> None:
    table = _common.table(title, "moment", "seconds", "steps", "alive", "PSNR, dB", "SSIM")
    for info in kept:
        numbers = f"{info.seconds:.1f}", f"{info.step:,}", f"{info.num_alive:,}", f"{info.psnr:.2f}"
        table.add_row("while fitting", *numbers, "")
    table.add_section()
    last = f"{seconds:.1f}", f"{kept[-1].step:,}", ""
    table.add_row("all frames, mean", *last, f"{scores.mean_psnr:.2f}", f"{scores.mean_ssim:.4f}")
    worst = int(np.argmin(scores.psnr))
    table.add_row(f"worst frame, {worst}", "", "", "", f"{scores.psnr[worst]:.2f}", f"{scores.ssim[worst]:.4f}")
    console.print(table)


def main(arguments: list[str] | None = None) -> None:
    options = _common.parse(_parser(), arguments)
    figures, setting, course = measure(options)
    if options.plot is not None:
        plot({str(options.clip): course}, options.plot)
    _common.finish(options.json, figures, _common.describe_machine(), setting=setting, course=course)


def measure(options: argparse.Namespace) -> tuple[dict, dict, list[dict]]:
    """Figures, setting and course of one fit, which is also shown."""
    clip, config = read(options), configuration(options)
    model, kept, seconds = run(clip, config)
    scores = evaluate(model, clip.frames)
    num, steps = model.splats.num_gaussians, kept[-1].step
    height, width = clip.size
    what = f"{clip.num_frames} frames of {height}x{width}, {num:,} Gaussians, degree {config.fold_degree}"
    show(kept, scores, seconds, f"{options.clip}: {what}")
    figures = {"psnr": scores.mean_psnr, "ssim": scores.mean_ssim, "gaussians": num, "minutes": seconds / 60}
    figures |= {"steps": steps, "worst_frame_psnr": min(scores.psnr), "ms_per_step": 1e3 * kept[-1].seconds / steps}
    setting = {"clip": Path(options.clip).name, "size": clip.size, "num_frames": clip.num_frames}
    setting |= {"num_gaussians": num, "degree": config.fold_degree, "seed": config.seed}
    setting |= {"preset": options.preset, "set": dict(options.set or ())}
    course = [{"seconds": info.seconds, "step": info.step, "psnr": info.psnr} for info in kept]
    return figures, setting, course


def plot(courses: dict[str, list[dict]], path: Path) -> None:
    """PSNR against time, into a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.2), layout="constrained")
    for name, course in courses.items():
        axes.plot([each["seconds"] / 60 for each in course], [each["psnr"] for each in course], "o-", label=name)
    axes.set_xlabel("minutes")
    axes.set_ylabel("PSNR while fitting, dB")
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", default="bunny", help="a sample clip or a path [bunny]")
    parser.add_argument("--size", type=_common.size, metavar="HxW", help="[160x320 for bunny, else the clip's]")
    parser.add_argument("--frames", type=_frames, metavar="A:B", help="frames A <= i < B [all]")
    parser.add_argument("--gaussians", type=_common.whole, help="[40000 for bunny, else by the frame's size]")
    parser.add_argument("--degree", type=int, help="of the folds [3]")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=_common.whole, help="how long, in steps")
    length.add_argument("--minutes", type=float, help=f"how long, in minutes of fitting [{MINUTES:g}]")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    parser.add_argument(
        "--preset", choices=tuple(PRESETS), default="standard", help="see `FitConfig.preset` [standard]"
    )
    parser.add_argument("--set", action="append", type=_setting, metavar="NAME=VALUE", help="a field of FitConfig")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the course here (PNG)")
    return parser


def _setting(text: str) -> tuple[str, object]:
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}")
    return name, ast.literal_eval(value)


def _frames(text: str) -> tuple[int | None, int | None]:
    first, colon, last = text.partition(":")
    if not colon or any(part and not part.isdecimal() for part in (first, last)):
        raise argparse.ArgumentTypeError(f"expected A:B with whole numbers >= 0, got {text!r}")
    return (int(first) if first else None), (int(last) if last else None)


if __name__ == "__main__":
    main()
