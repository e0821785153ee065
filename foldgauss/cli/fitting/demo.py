"""The command `demo`."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._runtime.threads import num_threads
from foldgauss.cli.app.application import app, err, out
from foldgauss.cli.fitting.fit import stop_on_signals, summarize_fit
from foldgauss.cli.fitting.options import choose_display
from foldgauss.cli.fitting.progress import display_progress
from foldgauss.cli.shared.contact_sheet import make_comparison_sheet
from foldgauss.cli.shared.outputs import make_folder, refuse_foreign, write_result
from foldgauss.cli.shared.rendering import evaluate_with_progress
from foldgauss.cli.shared.tables import print_figures, summarize_scores, write_json
from foldgauss.io.datasets import sample_clip
from foldgauss.io.media.reading import read_video
from foldgauss.io.media.writing import write_image, write_video
from foldgauss.io.models.compact import save_compact
from foldgauss.io.provenance import describe_source
from foldgauss.jobs.runner import describe_fit, mean_scores, run_steps
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import finish, fit_steps

SIZE, FRAMES = (160, 320), (0, 24)
RECORD = "metrics.json"
FILES = {"model.fgz", "reconstruction.mp4", "comparison.png", RECORD}
CONFIG = FitConfig(num_gaussians=40_000, steps=1500, quality=80)


@app.command()
def demo(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("foldgauss-demo"),
) -> None:
    """Fit 24 frames of the clip Bunny and show the results.

    The frames are of 160x320. A later demo replaces the files of an earlier one; a folder with other files is refused.
    """
    refuse_foreign(out_dir, FILES, "demo", record=RECORD, known=_is_record(out_dir / RECORD))
    clip = read_video(sample_clip("bunny"), frames=FRAMES, size=SIZE)
    make_folder(out_dir)
    out.print(f"Bunny, frames 0 to {FRAMES[1] - 1}, 160x320, on {num_threads()} threads")
    with display_progress(choose_display(), err) as show, stop_on_signals(show) as observe:
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

    def write(folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / RECORD, figures | frames)  # first: the next demo may then replace this one, however it ends
        saved = save_compact(folder / "model.fgz", quantized, metadata=metadata)
        write_video(folder / "reconstruction.mp4", images, clip.fps)
        write_image(folder / "comparison.png", sheet)
        figures["file_bytes"] = saved.stat().st_size
        write_json(folder / RECORD, figures | frames)
        return folder

    out_dir = write_result(out_dir, write)
    print_figures("Demo", figures)
    for name, what in (
        ("comparison.png", "original, reconstruction and error side by side"),
        ("reconstruction.mp4", "the rendered model, for any player (H.264)"),
        ("model.fgz", "the model: try `foldgauss render` with --upsample 4"),
        (RECORD, "the figures above, and those of each frame"),
    ):
        out.print(f"  {out_dir / name}  {what}", soft_wrap=True)


def _is_record(path: Path) -> bool:
    """Whether a file is the record of a demo."""
    try:
        kept = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(kept, dict) and kept.keys() >= {"fit_seconds", "psnr", "ssim"}
