"""The command `demo`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._runtime.threads import num_threads
from foldgauss.cli.app.application import command, out
from foldgauss.cli.fitting.fit import stop_on_signals, summarize_fit
from foldgauss.cli.shared.arguments import Overwrite
from foldgauss.cli.shared.console import choose_display, print_figures, summarize_scores, write_json
from foldgauss.cli.shared.contact_sheet import make_comparison_sheet
from foldgauss.cli.shared.files import make_folder, refuse_existing
from foldgauss.cli.shared.fit_progress import display_progress
from foldgauss.cli.shared.rendering import evaluate_with_progress
from foldgauss.io.datasets import sample_clip
from foldgauss.io.media.reading import read_video
from foldgauss.io.media.writing import write_image, write_video
from foldgauss.io.models.compact import save_compact
from foldgauss.io.provenance import describe_source
from foldgauss.jobs.runner import describe_fit, mean_scores, run_steps
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import finish, fit_steps

SIZE = (160, 320)
FRAMES = (0, 24)
RECORD = "metrics.json"
FILES = ("model.fgz", "reconstruction.mp4", "comparison.png", RECORD)
CONFIG = FitConfig(num_gaussians=40_000, steps=1500, quality=80)


@command("demo")
def demo(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("foldgauss-demo"),
    overwrite: Overwrite = False,
) -> None:
    """Fit 24 frames of the clip Bunny and show the results.

    The frames are of 160x320.
    """
    for name in FILES:
        refuse_existing(out_dir / name, overwrite)
    clip = read_video(sample_clip("bunny"), frames=FRAMES, size=SIZE)
    make_folder(out_dir)
    out.print(f"Bunny, frames 0 to {FRAMES[1] - 1}, 160x320, on {num_threads()} threads")
    with display_progress(choose_display(), "Fitting") as show, stop_on_signals(show) as observe:
        state, info = run_steps(fit_steps(clip.frames, CONFIG), observe)
    model, quantized = finish(state, clip.frames, CONFIG, clip.fps)
    images: list[np.ndarray] = []
    scores = evaluate_with_progress(model, clip.frames, images.append)
    figures = summarize_scores(model, scores) | summarize_fit(info)
    frames = {"psnr": scores.psnr, "ssim": scores.ssim}
    metadata = describe_source(clip, CONFIG.seed) | describe_fit(CONFIG, state) | mean_scores(scores)
    shown = np.linspace(0, clip.num_frames - 1, 4).round().astype(int)
    captions = [f"frame {k}, {scores.psnr[k]:.1f} dB" for k in shown]
    sheet = make_comparison_sheet([clip.frames[k] for k in shown], [images[k] for k in shown], captions)

    saved = save_compact(out_dir / "model.fgz", quantized, metadata=metadata)
    write_video(out_dir / "reconstruction.mp4", images, clip.fps)
    write_image(out_dir / "comparison.png", sheet)
    figures["file_bytes"] = saved.stat().st_size
    write_json(out_dir / RECORD, figures | frames)
    print_figures("Demo", figures)
    for name, what in (
        ("comparison.png", "original, reconstruction and error side by side"),
        ("reconstruction.mp4", "the rendered model, for any player (H.264)"),
        ("model.fgz", "the model: try `foldgauss render` with --speed 0.25"),
        (RECORD, "the figures above, and those of each frame"),
    ):
        out.print(f"  {out_dir / name}  {what}", soft_wrap=True)
