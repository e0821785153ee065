"""Quality against time and against bytes: budgets and presets on three clips.

    python -m benchmarks.tradeoff_clips --models FOLDER [--json FILE] [--budgets S ...]

The first 48 frames of each sample clip, at `SIZES`, with the default settings. Each clip is fitted with each of the
budgets and with the presets *draft* and *standard* without one. Fits run on one thread, by the CPU time of the process,
so that other work on the machine takes nothing from them. The models are kept in FOLDER as model files, and written as
compact files, too, with the defaults of `foldgauss compress` (a loss of at most 0.2 dB). PSNR is the mean over all
frames of 8-bit images.

With --json finished runs are kept, and the same command goes on after them. `benchmarks.record_figures` draws them.
For a clip of one's own: `foldgauss tradeoff CLIP`.
"""

import time
from pathlib import Path

from benchmarks import _common
from benchmarks._clips import ClipSource, sample_sources
from benchmarks._runs import Run, Runs, scores
from benchmarks.presets import minutes as positive
from benchmarks.tune import prepare_process
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import load_video_model, save_compact, save_video_model
from foldgauss.video import FitConfig, compress, fit_steps
from foldgauss.video.fitting.state import to_model

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
    prepare_process(clip.num_frames)
    for state, info in fit_steps(clip.frames, config, clock=time.process_time):
        pass
    model = to_model(state, config, clip.size, clip.fps)
    save_video_model(path, model)
    run = scores(model, clip.frames, with_ssim=False) | {"gaussians": model.num_gaussians, "steps": info.step}
    return run | {"cpu_seconds": info.seconds, "bytes": path.stat().st_size}


def compress_model(source: ClipSource, path: Path) -> Run:
    """The compact file of a model: its quality, the CPU time of compression, and its bytes."""
    clip, model = source.read(), load_video_model(path)
    begun = time.process_time()
    made = compress(model, clip.frames)
    seconds = time.process_time() - begun
    file = save_compact(path.with_suffix(".fgz"), made.quantized)
    run = scores(load_video_model(file), clip.frames, with_ssim=False)
    return run | {"gaussians": made.model.num_gaussians, "cpu_seconds": seconds, "bytes": file.stat().st_size}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--models", type=Path, required=True, metavar="FOLDER", help="keep the models there")
    parser.add_argument("--budgets", nargs="+", type=positive, default=BUDGETS, metavar="S", help="CPU seconds")
    options = _common.parse(parser, arguments)
    options.models.mkdir(parents=True, exist_ok=True)
    sources = [one._replace(size=SIZES[one.name], frames=NUM_FRAMES) for one in sample_sources(SIZES)]
    runs = Runs(options.json, {"clips": [source.describe() for source in sources]})
    set_num_threads(1)
    try:
        for name, config in configurations(options.budgets).items():
            for source in sources:
                key = f"{source.name}, {name}"
                path = options.models / f"{source.name}-{name.replace(' ', '')}.safetensors"
                runs.get(key, lambda s=source, c=config, p=path: fit_clip(s, c, p))
                runs.get(f"{key}, compact", lambda s=source, p=path: compress_model(s, p))
    finally:
        set_num_threads(None)
    show(runs)


def show(runs: Runs) -> None:
    columns = "CPU seconds", "PSNR, dB", "worst frame", "Gaussians", "MB"
    table = _common.table("Quality against time and bytes", "clip, setting", *columns)
    for name, run in runs.done.items():
        numbers = f"{run['cpu_seconds']:.0f}", f"{run['psnr']:.2f}", f"{run['worst_psnr']:.2f}"
        table.add_row(name, *numbers, f"{run['gaussians']:,}", f"{run['bytes'] / 1e6:.3f}")
    _common.console.print(table)


if __name__ == "__main__":
    main()
