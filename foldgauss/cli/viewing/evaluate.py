"""The command `evaluate`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from foldgauss.cli.app.application import command, out
from foldgauss.cli.shared.arguments import (
    AlphaCutoff,
    FittedClip,
    FittedFrames,
    ModelFile,
    Overwrite,
    SupportRadius,
    TransmittanceStop,
    override_constants,
)
from foldgauss.cli.shared.console import Video, print_figures, summarize_scores, write_json
from foldgauss.cli.shared.files import check_output, read_fitted_clip
from foldgauss.cli.shared.rendering import evaluate_with_progress
from foldgauss.io._atomic import write_or_keep
from foldgauss.io.models.video_model import load_video_model
from foldgauss.video.models.metrics import Evaluation
from foldgauss.video.segmented.segmented_video import SegmentedVideo
from foldgauss.video.tradeoff import measure_frame_rate


@command("evaluate")
def evaluate_command(
    model_path: ModelFile,
    video: FittedClip,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Also write the figures here.")
    ] = None,
    frames: FittedFrames = None,
    alpha_cutoff: AlphaCutoff = None,
    support_radius: SupportRadius = None,
    transmittance_stop: TransmittanceStop = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare a model with its clip: PSNR and SSIM of every frame.

    Also shows the size of the file, its bits per pixel and the rendering speed. The table of a model in
    segments has a row for each segment; --json has every frame.
    """
    if json_path is not None:
        check_output(json_path, overwrite, {"model": model_path, "clip": video}, "--json")
    model = load_video_model(model_path)
    constants = override_constants(model.options, alpha_cutoff, support_radius, transmittance_stop)
    model = model.with_options(constants)
    clip = read_fitted_clip(model, model_path, video, frames)
    scores = evaluate_with_progress(model, clip.frames)
    num_bytes = model_path.stat().st_size
    figures = summarize_scores(model, scores) | {"file_bytes": num_bytes}
    if clip.has_alpha:
        on_white = evaluate_with_progress(model, clip.frames, background=(1.0, 1.0, 1.0))
        figures["mean_psnr_on_white"] = round(on_white.mean_psnr, 3)
    figures["bits_per_pixel"] = 8 * num_bytes / (model.num_frames * model.size[0] * model.size[1])
    figures["frames_per_second"] = round(measure_frame_rate(model), 1)
    _print_scores(model, scores)
    print_figures(str(model_path), figures)
    if json_path is not None:
        figures |= {"psnr": scores.psnr, "ssim": scores.ssim}
        write_or_keep(json_path, lambda path: write_json(path, figures))


def _print_scores(model: Video, scores: Evaluation) -> None:
    """Print a row for each frame, or for each segment: the frames of a long clip are too many for a table."""
    if not isinstance(model, SegmentedVideo):
        table = Table("frame", "PSNR (dB)", "SSIM")
        for k, (psnr, ssim) in enumerate(zip(scores.psnr, scores.ssim, strict=True)):
            table.add_row(str(k), f"{psnr:.2f}", f"{ssim:.4f}")
    else:
        table = Table("segment", "frames", "PSNR (dB)", "lowest", "SSIM")
        stops = [segment.first for segment in model.segments[1:]] + [model.num_frames]
        for number, (segment, stop) in enumerate(zip(model.segments, stops, strict=True)):
            psnr, ssim = scores.psnr[segment.first : stop], scores.ssim[segment.first : stop]
            quality = (f"{np.mean(psnr):.2f}", f"{min(psnr):.2f}", f"{np.mean(ssim):.4f}")
            table.add_row(str(number), f"{segment.first:,}:{stop:,}", *quality)
    out.print(table)
