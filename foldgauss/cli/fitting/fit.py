"""The command `fit`."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from foldgauss._runtime.checks import require
from foldgauss._runtime.threads import num_threads
from foldgauss.cli.app.application import Stopped, command, err, out, warn
from foldgauss.cli.app.signals import note_signals
from foldgauss.cli.fitting.job_progress import describe_continuation, report_fit, summarize_fit
from foldgauss.cli.fitting.options import (
    PROGRESS,
    CheckpointSeconds,
    LogJson,
    Quiet,
    Scheduler,
    SegmentSeconds,
    Threads,
    WorkerOptions,
    Workers,
    fit_options,
)
from foldgauss.cli.fitting.segments import describe_plan, fit_in_segments, plan_gaussians, print_plan
from foldgauss.cli.shared.arguments import (
    Frames,
    NewClip,
    Overwrite,
    Size,
    parse_frames,
    parse_size,
)
from foldgauss.cli.shared.console import Display, choose_display
from foldgauss.cli.shared.files import check_output, name_after, refuse_existing, refuse_inputs
from foldgauss.cli.shared.fit_progress import (
    Observer,
    display_progress,
)
from foldgauss.cli.shared.rendering import evaluate_with_progress
from foldgauss.io import HistoryFile, read_history, write_curves
from foldgauss.io._atomic import lock_output
from foldgauss.io.media.clip import Clip
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX
from foldgauss.jobs import FitJob
from foldgauss.jobs import Stopped as FitStopped
from foldgauss.jobs.job import MOVING
from foldgauss.jobs.object_masks import parse_click
from foldgauss.jobs.runner import run_fit
from foldgauss.jobs.segments import SEGMENT_SECONDS, has_plan
from foldgauss.video import Evaluation, FitDiverged, FitInfo
from foldgauss.video.fitting.config import DEFAULT_QUALITY, FitConfig, planned_steps
from foldgauss.video.fitting.state import FitState, running_psnr
from foldgauss.video.fitting.steppers.engines import choose_engine, describe_device


@command("fit")
@fit_options
def fit(
    context: typer.Context,
    video: NewClip,
    config: FitConfig,
    target: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="MODEL",
            help=f"FILE{COMPACT_SUFFIX}, or FILE{MODEL_SUFFIX} of float32 [default: after the clip, in this folder].",
        ),
    ] = None,
    size: Size = None,
    frames: Frames = None,
    masks: Annotated[
        str | None,
        typer.Option(
            metavar="PATH|X,Y",
            help=f"Masks, click or {MOVING!r}: objects get layers.",
        ),
    ] = None,
    shadows: Annotated[bool, typer.Option("--shadows", help="Objects have their shadows, too.")] = False,
    overwrite: Overwrite = False,
    history: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.jsonl",
            help="Write the figures of every step here, and their curves to FILE.png (extra `plot`).",
            rich_help_panel=PROGRESS,
        ),
    ] = None,
    checkpoint_seconds: CheckpointSeconds = None,
    segment_seconds: SegmentSeconds = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    threads: Threads = None,
    quiet: Quiet = False,
    log_json: LogJson = False,
) -> None:
    """Fit a model to a clip; the first of its budgets ends the fit.

    A stopped fit has a checkpoint: the same command continues it. Long clips are fitted in segments, in parallel with
    workers. Options for rare cases: docs/fit.md.
    """
    is_found = masks in (None, MOVING) or parse_click(masks) is not None
    target, config = _choose_target({"clip": video, "masks": None if is_found else Path(masks)}, target, config)
    require(
        is_found or Path(masks).exists(),
        "--masks",
        expected=f"a folder, an image or a video, X,Y or X,Y@FRAME of a click, or {MOVING!r}",
        got=f"{masks!r}, which is missing",
    )
    job = FitJob(
        video.name,
        str(video),
        str(target),
        config,
        parse_size(size),
        parse_frames(frames),
        checkpoint_seconds=checkpoint_seconds,
        masks=masks if is_found else str(Path(masks).absolute()),
        shadows=shadows,
    )
    require(masks or not shadows, "--shadows", expected="a fit with --masks", got="one without")
    require(
        history is None or masks is None,
        "--history",
        expected="a fit without layers",
        got="--masks",
        cure="Leave it out.",
    )
    display = choose_display(quiet, log_json)
    options = WorkerOptions(workers, scheduler, threads)
    context.with_resource(lock_output(target, own=(job.checkpoint,)))
    in_segments = not (segment_seconds is None and workers is None and scheduler is None)
    is_begun, is_other = has_plan(target), job.checkpoint.exists()
    if not in_segments:
        is_begun, is_other = is_other, is_begun
    refuse_existing(target, overwrite or is_begun)
    require(
        overwrite or not is_other,
        "--out",
        expected="no other fit to be unfinished",
        got=f"{'one in one piece' if in_segments else 'one in segments'} for {target}",
        cure="Give the command that began it, or add --overwrite.",
    )
    if in_segments:
        require(
            history is None, "--history", expected="a fit in one piece", got="one in segments", cure="Leave it out."
        )
        seconds = SEGMENT_SECONDS if segment_seconds is None else segment_seconds
        fit_in_segments(job, display, options, segment_seconds=seconds, overwrite=overwrite)
        return
    curves = _check_history(video, history, overwrite or is_begun)
    record = fit_with_progress(job, display, overwrite=overwrite, history=history)
    if history is not None:
        _save_curves(curves, history)
    scores = Evaluation(record["psnr"], record["ssim"])
    figures = summarize_fit(scores, [record], config) | {name: record[name] for name in ("steps", "stopped_by")}
    report_fit(display, str(target), figures | {"file_bytes": record["file_bytes"]})


def _choose_target(inputs: dict[str, Path | None], out_path: Path | None, config: FitConfig) -> tuple[Path, FitConfig]:
    """The file to write, and the settings: the default quality for a compact file of which nothing else is asked."""
    if out_path is None:
        ending = ".fit" if inputs["clip"].suffix.lower() == COMPACT_SUFFIX else ""  # it may be a model in this folder
        out_path = name_after(inputs["clip"], f"{ending}{COMPACT_SUFFIX}")
    refuse_inputs(out_path, inputs)
    if out_path.suffix.lower() == COMPACT_SUFFIX:
        return out_path, config if config.is_compact else dataclasses.replace(config, quality=DEFAULT_QUALITY)
    require(
        out_path.suffix.lower() in ("", MODEL_SUFFIX),
        "--out",
        expected=f"a name ending in {COMPACT_SUFFIX}, or in {MODEL_SUFFIX} for parameters that are not rounded",
        got=out_path,
        cure="Videos and images of a model: foldgauss render. Files of other programs: foldgauss export.",
    )
    require(
        config.size_mb is None,
        "--size-mb",
        expected="a compact file",
        got=out_path,
        cure=f"Compact files end in {COMPACT_SUFFIX}.",
    )
    return out_path, config


def fit_with_progress(
    job: FitJob,
    display: Display,
    *,
    overwrite: bool = False,
    history: Path | None = None,
) -> dict[str, Any]:
    """The record of a job that is run here, from its checkpoint unless `overwrite`, with its progress displayed.

    SIGINT and SIGTERM stop the fit after a step. A stopped or diverged fit raises `cli.Stopped`, which says how to
    continue if there is a checkpoint.
    """

    @contextmanager
    def observe(clip: Clip, config: FitConfig, state: FitState | None) -> Iterator[Observer]:
        _print_plan(clip, config, display)
        if state is not None:
            err.print(f"Continues {job.checkpoint} after {state.step:,} steps.", soft_wrap=True)
        recorded = None
        if history is not None:
            recorded = HistoryFile(history) if state is None else HistoryFile(history, state.step, running_psnr(state))
        with display_progress(display, "Fitting", history=recorded) as show, note_signals() as request:

            def note_step(state: FitState, info: FitInfo) -> bool:
                request.stepping = True
                show(state, info)
                return bool(request.signal)

            try:
                yield note_step
            except FitStopped as error:
                hint = describe_continuation(overwrite) if job.checkpoint.exists() else "Nothing was saved."
                raise Stopped(f"{error} by {request.signal}. {hint}") from error
            except FitDiverged as error:
                raise Stopped(str(error)) from error

    if job.masks is not None and display in ("bar", "lines"):
        out.print("Taking the objects out of the background ...")
    try:
        record = run_fit(
            job,
            observe,
            resume=not overwrite,
            measure=partial(evaluate_with_progress, shown=display in ("bar", "lines")),
            on_checkpoint_error=lambda error, step: warn(f"no checkpoint at step {step}: {error}"),
        )
    except KeyboardInterrupt:  # while scores are measured
        if job.checkpoint.exists():
            err.print(f"The fit is kept in {job.checkpoint}. {describe_continuation(overwrite)}", soft_wrap=True)
        raise
    job.remove_checkpoints()
    for text in record["warnings"]:
        warn(text)
    return record


def _check_history(video: Path, history: Path | None, overwrite: bool) -> Path | None:
    """The path of the curves of a history. Raises ParameterError if either path cannot be written to."""
    if history is None:
        return None
    require(history.suffix == ".jsonl", "--history", expected="a name ending in .jsonl", got=history)
    curves = history.with_suffix(".png")
    for path in (history, curves):
        check_output(path, overwrite, {"clip": video}, "--history")
    return curves


def _save_curves(path: Path, history: Path) -> None:
    """Plot the history; an error is only a warning, since the fit is finished."""
    try:
        write_curves(path, read_history(history))
    except (ImportError, OSError, ValueError) as error:
        warn(f"no curves in {path}: {error}")


def _print_plan(clip: Clip, config: FitConfig, display: Display) -> None:
    engine = choose_engine(clip.frames, config)
    for text in clip.notes:
        warn(f"{clip.source}: {text}")
    num = plan_gaussians(config, clip.num_frames, *clip.size)
    steps = planned_steps(config, clip.num_frames)
    if steps is not None and steps * config.views.batch_size < clip.num_frames:
        warn(
            f"--steps: {steps:,} steps use {steps * config.views.batch_size:,} of {clip.num_frames:,} frames; the "
            "others keep their initial Gaussians, which look faint."
        )
    computed = f"{num_threads()} threads" if engine == "cpu" else f"engine {engine} on {describe_device()}"
    alpha, plan = " with alpha" if clip.has_alpha else "", describe_plan(config, num, clip.num_frames)
    about = {"most_gaussians": num, "degree": config.fold_degree, "threads": num_threads()}
    print_plan(display, clip.source, clip.num_frames, clip.size, f"{alpha}, {plan}, {computed}", **about)
