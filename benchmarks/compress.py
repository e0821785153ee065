"""Bytes, loss and bits per pixel of compact files. Beside video codecs: benchmarks/rate_distortion.py.

    python -m benchmarks.compress [--json FILE] [--model FILE --clip NAME --size HxW --frames N] [--loss DB]
        [--passes N]

Without options: the first 48 frames of Bunny and bikes at 160x320, each fitted first with the command's defaults.
*pruned* is the float32 file without the Gaussians that no frame shows or whose absence, all together, costs 0.01 dB;
*rounded* is `passes=0`. Seconds are those of the processor.
"""

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import Clip, read_video, save_compact, save_video_model
from foldgauss.io.datasets import sample_clip
from foldgauss.io.models.video_model import load_video_model
from foldgauss.video import FitConfig, VideoModel, compress, evaluate, fit
from foldgauss.video.selection.contributions import Contributions, sum_contributions
from foldgauss.video.selection.regions import Region

SIZE, CLIPS, PRUNED_DB = (160, 320), ("bunny", "bikes", "carphone"), 0.01


def pruned(model: VideoModel, clip: Clip) -> VideoModel:
    """Without as many of the Gaussians that add least as `PRUNED_DB` allows."""
    lit = Contributions(model)
    everywhere = np.ones(model.size, np.float32)
    order = np.argsort(sum_contributions(lit, Region(tuple(range(model.num_frames)), lambda k: everywhere))[1])
    before, least, most = evaluate(model, clip.frames).mean_psnr, 0, model.num_gaussians - 1
    while most - least > max(model.num_gaussians // 200, 1):
        middle = (least + most) // 2
        lost = before - evaluate(kept(model, np.sort(order[middle:])), clip.frames).mean_psnr
        least, most = (middle, most) if lost <= PRUNED_DB else (least, middle)
    return kept(model, np.sort(order[least:]))


def kept(model: VideoModel, indices: np.ndarray) -> VideoModel:
    return dataclasses.replace(model, splats=model.splats.take(indices))


def measure(name: str, model: VideoModel, clip: Clip, options: argparse.Namespace, figures: dict) -> None:
    pixels = model.num_frames * model.size[0] * model.size[1]
    rows = []
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)

        def row(what: str, path: Path, lost: float, num: int, seconds: float = 0.0) -> None:
            rows.append((what, path.stat().st_size, lost, num, seconds))

        before = evaluate(model, clip.frames).mean_psnr
        row("float32", save_video_model(folder / "m.safetensors", model), 0.0, model.num_gaussians)
        small = pruned(model, clip)
        lost = before - evaluate(small, clip.frames).mean_psnr
        row("float32, pruned", save_video_model(folder / "p.safetensors", small), lost, small.num_gaussians)
        for what, passes in (("rounded", 0), ("compact", options.passes)):
            begun = time.process_time()
            made = compress(model, clip.frames, max_loss_db=options.loss, passes=passes)
            seconds = time.process_time() - begun
            path = save_compact(folder / f"{what}.fgz", made.quantized)
            lost = before - evaluate(load_video_model(path), clip.frames).mean_psnr
            row(what, path, lost, made.model.num_gaussians, seconds)
    base = rows[1][1]
    title = f"{name}, {model.num_frames} frames of {model.size[0]}x{model.size[1]}, {before:.2f} dB"
    shown = _common.table(title, "file", "bytes", "pruned / it", "loss (dB)", "bits per pixel", "Gaussians", "seconds")
    for what, size, lost, num, seconds in rows:
        cells = f"{size:,}", f"{base / size:.2f}", f"{lost:.3f}", f"{8 * size / pixels:.3f}"
        shown.add_row(what, *cells, f"{num:,}" if num else "", f"{seconds:.0f}" if seconds else "")
        figures |= {f"{name}, {what}: bytes": size, f"{name}, {what}: loss (dB)": lost}
    console.print(shown)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--model", type=Path, help="a fitted model of --clip [fit them first]")
    parser.add_argument("--clip", choices=CLIPS, help="[bunny and bikes]")
    parser.add_argument("--size", type=_common.size, default=SIZE, metavar="HxW", help="[160x320]")
    parser.add_argument("--frames", type=_common.whole, default=48, metavar="N", help="the first N frames [48]")
    parser.add_argument("--loss", type=float, default=0.2, help="dB [0.2]")
    parser.add_argument("--passes", type=_common.whole, default=48, help="[48]")
    options = _common.parse(parser, arguments)
    if options.model is not None and options.clip is None:
        parser.error("--model needs --clip")
    facts, figures = _common.describe_machine(), {}
    for name in CLIPS[:2] if options.clip is None else (options.clip,):
        clip = read_video(sample_clip(name), size=options.size, frames=(0, options.frames))
        if options.model is not None:
            model = load_video_model(options.model)
        else:
            model = fit(clip.frames, FitConfig(), fps=clip.fps).model
        measure(name, model, clip, options, figures)
    setting = {name: getattr(options, name) for name in ("size", "frames", "loss", "passes")}
    _common.finish(options.json, figures, facts, setting=setting)


if __name__ == "__main__":
    main()
