"""The command `compress`."""

import math
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from foldgauss._runtime.checks import is_within
from foldgauss.cli.app.application import WrongUse, app, err, warn, wrong_use
from foldgauss.cli.app.completion import complete_clips
from foldgauss.cli.shared.arguments import FittedFrames, ModelFile, Overwrite
from foldgauss.cli.shared.clips import is_other_clip, read_fitted_clip, refuse_segments
from foldgauss.cli.shared.outputs import refuse_existing, refuse_inputs, write_result
from foldgauss.cli.shared.tables import print_figures
from foldgauss.io._atomic import check_writable, resolve
from foldgauss.io.media.clip import Clip
from foldgauss.io.models.compact import COMPACT_SUFFIX, check_compact_name, save_compact
from foldgauss.io.models.video_model import (
    CLIP_NOTES,
    keep_origin,
    load_video_model,
    read_origin,
)
from foldgauss.video.compression.search import Compressed, compress
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.models.video_model import VideoModel

MAX_LOSS_DB, PASSES = 0.2, 48
#: Passes over the frames in all, in units of --passes.
USUAL_PASSES = 5
#: Fine-tuning that is better than the model by more dB than this causes a warning.
MAX_GAIN_DB = 0.5


@app.command(name="compress")
def compress_command(
    model_path: ModelFile,
    video: Annotated[
        Path | None,
        typer.Argument(
            help="The clip it was fitted to, for a smaller file and a measured loss.",
            autocompletion=complete_clips,
        ),
    ] = None,
    max_loss_db: Annotated[float, typer.Option(help="Largest loss of mean PSNR, in dB.")] = MAX_LOSS_DB,
    out_path: Annotated[
        Path | None, typer.Option("--out", help=f"FILE{COMPACT_SUFFIX} [default: the model's name in this folder].")
    ] = None,
    passes: Annotated[
        int,
        typer.Option(
            help="Passes over VIDEO of fine-tuning, 3 to 12 times as many in all stages; 0: none.",
            min=0,
        ),
    ] = PASSES,
    frames: FittedFrames = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a model as a compact file, a fraction of its size.

    It can be rendered, evaluated, edited and exported like any model. It loses at most --max-loss-db of PSNR; without
    VIDEO, this is an estimate. See docs/compress.md.
    """
    target = Path(f"{resolve(model_path).stem}{COMPACT_SUFFIX}") if out_path is None else out_path
    try:
        check_compact_name(target, "--out")
    except ValueError as error:
        raise WrongUse(str(error)) from error
    if not is_within(max_loss_db, "(0, 60]"):
        raise wrong_use("--max-loss-db", expected="a loss in (0, 60] dB", got=max_loss_db)
    if frames is not None and video is None:
        raise wrong_use("--frames", expected="a VIDEO to take them from", got="none")
    if passes not in (0, PASSES) and video is None:
        raise wrong_use("--passes", expected="a VIDEO to fine-tune to", got="none", cure="Give it, or no --passes.")
    refuse_inputs(target, {"model": model_path, "clip": video})
    refuse_existing(target, overwrite)
    check_writable(target)
    refuse_segments(model_path)
    model, about = load_video_model(model_path), read_origin(model_path)
    if not isinstance(model, VideoModel):
        cure = "Compress the model before it is edited, and edit that."
        raise wrong_use("MODEL", expected="a plain model", got="one with edits", cure=cure)
    clip = None if video is None else read_fitted_clip(model, model_path, video, frames)
    if clip is not None and is_other_clip(model_path, clip, lambda: evaluate(model, clip.frames).mean_psnr):
        cure = "Give that clip, or none: there is no fine-tuning then."
        got = f"{str(video)!r}, another clip"
        raise wrong_use("VIDEO", expected="the clip that the model was fitted to", got=got, cure=cure)
    target, figures = _write_compressed(target, model, about, clip, max_loss_db, passes)
    before, after = model_path.stat().st_size, target.stat().st_size
    figures |= {
        "bytes_before": before,
        "file_bytes": after,
        "ratio": before / after,
        "bits_per_pixel": 8 * after / (model.num_frames * model.size[0] * model.size[1]),
    }
    print_figures(str(target), figures)
    if after >= before:
        warn(f"{target} is no smaller than {model_path}.")


def save_compressed(target: Path, made: Compressed, about: dict[str, Any], *, known: bool = True) -> Path:
    """Write a compact file with the metadata `about`, and its PSNR if that is `known`."""
    about = keep_origin(about, *CLIP_NOTES, "frames_digest", "seed")
    about |= {"mean_psnr": round(made.psnr - made.loss_db, 3)} if known else {}
    return save_compact(target, made.quantized, metadata=about | {"loss_db": round(made.loss_db, 4)})


def _write_compressed(
    target: Path, model: VideoModel, about: dict[str, Any], clip: Clip | None, max_loss_db: float, passes: int
) -> tuple[Path, dict[str, Any]]:
    known_psnr = about.get("mean_psnr")
    columns = SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}")
    with Progress(*columns, console=err, disable=not err.is_terminal, transient=True) as bar:
        task = bar.add_task("Compressing", total=None)  # the number of trials is unknown
        usual = 0 if clip is None else USUAL_PASSES * passes
        gain, done, stage, started = 0.0, 0, "", time.monotonic()

        def show(what: str, loss: float) -> None:
            nonlocal gain, done, stage
            gain = gain if math.isnan(loss) else max(gain, -loss)
            done += what.startswith("fine-tuning")
            text = what if math.isnan(loss) else f"{what}, {loss:.3f} dB lost"
            text += f" (pass {done:,} of about {max(usual, done):,.0f})" if done else ""
            bar.update(task, description=f"Compressing: {text}")
            if not err.is_terminal and (what != stage or not math.isnan(loss)):
                err.print(f"{time.monotonic() - started:7.1f} s  {text}", soft_wrap=True)
            stage = what

        given = None if clip is None else clip.frames
        made = compress(model, given, max_loss_db=max_loss_db, psnr=known_psnr, passes=passes, on_step=show)
    if passes and gain > MAX_GAIN_DB:
        warn(
            f"fine-tuning came {gain:.1f} dB closer to the clip than the model. Either its fit had not converged, or "
            "it was edited, and the passes have undone the edits. --passes 0 does without fine-tuning."
        )
    known = clip is not None or known_psnr is not None
    target = write_result(target, lambda path: save_compressed(path, made, about, known=known))
    if clip is None:
        source = "recorded in the file" if known_psnr is not None else "assumed"
        err.print(
            f"note: without the clip the loss is estimated, from images of the model and a PSNR of "
            f"{made.psnr:.2f} dB, {source}. Give VIDEO for a smaller file and a measured loss.",
            soft_wrap=True,
        )
    loss = "estimated_loss_db" if clip is None else "loss_db"
    return target, {loss: made.loss_db, "num_gaussians": made.model.num_gaussians, "num_dropped": made.num_dropped}
