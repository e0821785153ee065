"""The command `demo`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss.cli.app.application import command, out
from foldgauss.cli.fitting.fit import fit_with_progress
from foldgauss.cli.fitting.job_progress import summarize_fit
from foldgauss.cli.shared.arguments import Overwrite
from foldgauss.cli.shared.console import choose_display, print_figures, write_json
from foldgauss.cli.shared.contact_sheet import make_comparison_sheet
from foldgauss.cli.shared.files import make_folder, refuse_existing
from foldgauss.io import load_video_model, read_video, write_image, write_video
from foldgauss.io.datasets import sample_clip
from foldgauss.jobs import FitJob
from foldgauss.video import Evaluation, FitConfig

SIZE = (160, 320)
FRAMES = (0, 24)
RECORD = "metrics.json"
FILES = ("model.fgz", "reconstruction.mp4", "comparison.png", RECORD)
CONFIG = FitConfig(num_gaussians=40_000, steps=1200, quality=80)


@command("demo")
def demo(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("foldgauss-demo"),
    overwrite: Overwrite = False,
) -> None:
    """Fit 24 frames of the clip Bunny and show the results.

    The frames are of 160x320.
    """
    target = out_dir / "model.fgz"
    job = FitJob("bunny", str(sample_clip("bunny")), str(target), CONFIG, SIZE, FRAMES)
    for name in FILES:
        refuse_existing(out_dir / name, overwrite or job.checkpoint.exists())
    make_folder(out_dir)
    record = fit_with_progress(job, choose_display(), overwrite=overwrite)
    clip, model = read_video(job.clip, frames=FRAMES, size=SIZE), load_video_model(target)
    images, scores = list(model.frames()), Evaluation(record["psnr"], record["ssim"])
    shown = np.linspace(0, clip.num_frames - 1, 4).round().astype(int)
    captions = [f"frame {k}, {scores.psnr[k]:.1f} dB" for k in shown]
    sheet = make_comparison_sheet([clip.frames[k] for k in shown], [images[k] for k in shown], captions)
    write_video(out_dir / "reconstruction.mp4", images, clip.fps)
    write_image(out_dir / "comparison.png", sheet)
    figures = summarize_fit(scores, [record], CONFIG) | {name: record[name] for name in ("steps", "file_bytes")}
    write_json(out_dir / RECORD, figures | {"psnr": scores.psnr, "ssim": scores.ssim})
    print_figures("Demo", figures)
    for name, what in (
        ("comparison.png", "original, reconstruction and error side by side"),
        ("reconstruction.mp4", "the rendered model, for any player (H.264)"),
        ("model.fgz", "the model: try `foldgauss render` with --speed 0.25"),
        (RECORD, "the figures above, and those of each frame"),
    ):
        out.print(f"  {out_dir / name}  {what}", soft_wrap=True)
