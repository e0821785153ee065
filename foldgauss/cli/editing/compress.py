"""The command `compress`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from foldgauss._runtime.checks import require
from foldgauss.cli.app.application import command, warn
from foldgauss.cli.shared.arguments import FittedFrames, ModelFile, Overwrite
from foldgauss.cli.shared.console import choose_display, print_figures
from foldgauss.cli.shared.files import check_output, is_other_clip, read_fitted_clip, refuse_segments
from foldgauss.cli.shared.fit_progress import display_progress
from foldgauss.cli.shared.rendering import evaluate_with_progress
from foldgauss.io._atomic import resolve, write_or_keep
from foldgauss.io.models.compact import COMPACT_SUFFIX, check_compact_name, leave_room, save_compact
from foldgauss.io.models.video_model import CLIP_NOTES, keep_origin, load_video_model, read_origin
from foldgauss.jobs.runner import mean_scores, missed_psnr
from foldgauss.video.fitting.compress import ROUNDING_QUALITY, compress
from foldgauss.video.fitting.config import DEFAULT_QUALITY, FitConfig
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.models.video_model import VideoModel

#: Training that is better than the model by more dB than this causes a warning.
MAX_GAIN_DB = 1.0


@command("compress")
def compress_command(
    model_path: ModelFile,
    video: Annotated[
        Path | None,
        typer.Argument(
            help="The clip it was fitted to. Without it, nothing makes up for what is dropped and rounded.",
        ),
    ] = None,
    quality: Annotated[
        float | None,
        typer.Option(
            help=f"Quality, from 0 to 100 [default: {DEFAULT_QUALITY:g}; without VIDEO {ROUNDING_QUALITY:g}].",
            min=0.0,
            max=100.0,
        ),
    ] = None,
    size_mb: Annotated[float | None, typer.Option("--size-mb", help="Largest file, in 10^6 bytes.")] = None,
    psnr: Annotated[float | None, typer.Option(help="The smallest file with this mean PSNR, in dB.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Time to compress, in minutes.")] = None,
    out_path: Annotated[
        Path | None, typer.Option("--out", help=f"FILE{COMPACT_SUFFIX} [default: the model's name in this folder].")
    ] = None,
    frames: FittedFrames = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a model as a compact file, a fraction of its size.

    `fit` writes such a file from the start. It can be rendered, evaluated, edited and exported like any model. See
    docs/compress.md.
    """
    target = Path(f"{resolve(model_path).stem}{COMPACT_SUFFIX}") if out_path is None else out_path
    check_compact_name(target, "--out")
    require(frames is None or video is not None, "--frames", expected="a VIDEO to take them from", got="none")
    check_output(target, overwrite, {"model": model_path, "clip": video})
    refuse_segments(model_path)
    model, about = load_video_model(model_path), read_origin(model_path)
    require(
        isinstance(model, VideoModel),
        "MODEL",
        expected="a plain model",
        got="one with edits, or of layers",
        cure="Compress the model before it is edited, and edit that. Layers are compact where `fit` writes a .fgz.",
    )
    clip = None if video is None else read_fitted_clip(model, model_path, video, frames)
    require(
        clip is None or not is_other_clip(model_path, clip, lambda: evaluate(model, clip.frames).mean_psnr),
        "VIDEO",
        expected="the clip that the model was fitted to",
        got=f"{str(video)!r}, another clip",
        cure="Give that clip, or none.",
    )
    about = keep_origin(about, *CLIP_NOTES, "frames_digest", "seed")
    goals = {"quality": quality, "size_mb": leave_room(size_mb, about), "psnr": psnr, "minutes": minutes}
    with display_progress(choose_display(), "Compressing") as show:
        made = compress(model, None if clip is None else clip.frames, **goals, observers=[show])
    figures: dict[str, Any] = {"num_gaussians": made.model.num_gaussians}
    figures["num_dropped"] = model.num_gaussians - made.model.num_gaussians
    if clip is not None:
        before = evaluate_with_progress(model, clip.frames)
        after = evaluate_with_progress(made.model, clip.frames)
        about |= mean_scores(after)
        figures = mean_scores(after) | {"loss_db": before.mean_psnr - after.mean_psnr} | figures
        if figures["loss_db"] < -MAX_GAIN_DB:
            warn(
                f"the compact model is {-figures['loss_db']:.1f} dB closer to the clip. Either the fit had not "
                "converged, or the model was edited, and the edits are undone. Without VIDEO they remain."
            )
    target = write_or_keep(target, lambda path: save_compact(path, made.quantized, metadata=about))
    sizes = model_path.stat().st_size, target.stat().st_size
    bits = 8 * sizes[1] / (model.num_frames * model.size[0] * model.size[1])
    figures |= {"bytes_before": sizes[0], "file_bytes": sizes[1], "ratio": sizes[0] / sizes[1], "bits_per_pixel": bits}
    print_figures(str(target), figures)
    if clip is not None:
        for text in missed_psnr(FitConfig(quality=quality, size_mb=size_mb, psnr=psnr), after.mean_psnr, "--minutes"):
            warn(text)
    if sizes[1] >= sizes[0]:
        warn(f"{target} is no smaller than {model_path}.")
