"""Quality against time and against bytes: budgets and presets on three clips.

    python -m benchmarks.tradeoff_clips --models FOLDER [--json FILE] [--budgets S ...]

The first 48 frames of each sample clip, at `SIZES`, with the default settings. Each clip is fitted with each of the
budgets and with the presets *draft* and *standard* without one, and every fit is repeated for a compact file of the
default quality. Fits run on one thread, by the CPU time of the process, so that other work on the machine takes nothing
from them. The models are kept in FOLDER. PSNR is the mean over all frames of 8-bit images.

With --json finished runs are kept, and the same command goes on after them. `benchmarks.record_figures` draws them.
For a clip of one's own: `foldgauss tradeoff CLIP`.
"""

import dataclasses
from functools import partial
from pathlib import Path

from benchmarks import _common
from benchmarks._clips import ClipSource, sample_sources
from benchmarks._runs import Run, Runs, fit_by_clock, scores, warm_up
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import save_compact, save_video_model
from foldgauss.video import FitConfig
from foldgauss.video.fitting.config import DEFAULT_QUALITY

NUM_FRAMES = 48
SIZES = {"bunny": (160, 320), "bikes": (136, 320), "carphone": (144, 176)}
BUDGETS = (10.0, 20.0, 40.0, 80.0, 160.0, 320.0)


def configurations(budgets: list[float]) -> dict[str, FitConfig]:
    """Settings by name: each budget in CPU seconds, and each preset without one."""
    by_budget = {f"{seconds:g} s": FitConfig(minutes=seconds / 60) for seconds in budgets}
    return {"draft": FitConfig.preset("draft"), **by_budget, "standard": FitConfig()}


def fit_clip(source: ClipSource, config: FitConfig, path: Path) -> Run:
    """A fit, kept in `path`: its quality, its CPU time, and the bytes of its file."""
    clip = source.read()
    warm_up(clip.num_frames)
    result = fit_by_clock(clip.frames, config, clip.fps)
    if result.quantized is None:
        save_video_model(path, result.model)
    else:
        save_compact(path, result.quantized)
    last = result.history[-1]
    run = {"gaussians": result.model.num_gaussians, "steps": last.step, "cpu_seconds": last.seconds}
    return scores(result.model, clip.frames) | run | {"bytes": path.stat().st_size}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--models", type=Path, required=True, metavar="FOLDER", help="keep the models there")
    parser.add_argument("--budgets", nargs="+", type=_common.positive, default=BUDGETS, metavar="S", help="CPU seconds")
    options = _common.parse(parser, arguments)
    options.models.mkdir(parents=True, exist_ok=True)
    sources = [one._replace(size=SIZES[one.name], frames=NUM_FRAMES) for one in sample_sources(SIZES)]
    runs = Runs(options.json, {"clips": [source.describe() for source in sources]})
    set_num_threads(1)
    for name, config in configurations(options.budgets).items():
        compact = dataclasses.replace(config, quality=DEFAULT_QUALITY)
        for source in sources:
            path = options.models / f"{source.name}-{name.replace(' ', '')}.safetensors"
            runs.get(f"{source.name}, {name}", partial(fit_clip, source, config, path))
            small = partial(fit_clip, source, compact, path.with_suffix(".fgz"))
            runs.get(f"{source.name}, {name}, compact", small)
    columns = "clip, setting", "CPU seconds", "PSNR, dB", "worst frame", "Gaussians", "MB"
    forms = {"cpu_seconds": ".0f", "psnr": ".2f", "worst_psnr": ".2f", "gaussians": ","}
    rows = (
        (name, *(format(run[figure], form) for figure, form in forms.items()), f"{run['bytes'] / 1e6:.3f}")
        for name, run in runs.done.items()
    )
    _common.print_table("Quality against time and bytes", columns, rows)


if __name__ == "__main__":
    main()
