"""The commands that fit: `demo` and `fit`."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from foldgauss._runtime.checks import invalid
from foldgauss._runtime.threads import num_threads
from foldgauss.cli.app.shared import (
    Frames,
    NewClip,
    Overwrite,
    Size,
    Stopped,
    WrongUse,
    app,
    as_option,
    describe_source,
    err,
    evaluate_with_progress,
    figures_of,
    fingerprint,
    named_after,
    out,
    parse_frames,
    parse_size,
    print_figures,
    refuse_existing,
    refuse_foreign,
    refuse_input,
    scores_of,
    tell_of,
    write_json,
)
from foldgauss.cli.app.signals import noted_signals
from foldgauss.cli.fitting.jobs_view import WorkerOptions
from foldgauss.cli.fitting.long import fit_in_segments
from foldgauss.cli.fitting.options import (
    PROGRESS,
    CheckpointSeconds,
    LogJson,
    Quiet,
    Scheduler,
    SegmentSeconds,
    Threads,
    Workers,
    fit_options,
    manner_of,
)
from foldgauss.cli.fitting.progress import Manner, Observer, previewing, print_json, watching
from foldgauss.io._atomic import OutputError, check_writable
from foldgauss.io._lock import lock_output
from foldgauss.io.datasets import sample_clip
from foldgauss.io.history import HistoryFile, read_history, write_curves
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.contact_sheet import make_comparison_sheet
from foldgauss.io.media.video_reading import read_video
from foldgauss.io.media.video_writing import write_image, write_video
from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.io.models.video_model import MODEL_SUFFIX, check_model_name, save_video_model
from foldgauss.jobs.fitting import CHECKPOINT_SECONDS
from foldgauss.jobs.long import kept_seconds
from foldgauss.video.fitting.config import FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.divergence import FitDiverged
from foldgauss.video.fitting.loop import FitInfo, FitState, fit_steps, running_psnr, to_model
from foldgauss.video.fitting.steppers.engines import choose_engine, describe_device

DEMO_SIZE, DEMO_FRAMES = (160, 320), (0, 24)
DEMO_RECORD = "metrics.json"
DEMO_FILES = {"model.safetensors", "reconstruction.mp4", "comparison.png", DEMO_RECORD}
DEMO_CONFIG = FitConfig(num_gaussians=20_000, degree=3, steps=1500)


@app.command()
def demo(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("foldgauss-demo"),
) -> None:
    """Fit 24 frames of the clip Bunny and show what comes out.

    The frames are of 160x320. A later demo replaces the files of an earlier one; a folder with other files in it is
    left alone.
    """
    refuse_foreign(out_dir, DEMO_FILES, "demo", record=DEMO_RECORD, known=_is_demos(out_dir / DEMO_RECORD))
    clip = read_video(sample_clip("bunny"), frames=DEMO_FRAMES, size=DEMO_SIZE)
    make_folder(out_dir)
    out.print(f"Bunny, frames 0 to {DEMO_FRAMES[1] - 1}, 160x320, on {num_threads()} threads")
    with watching(manner_of(), err) as observe:
        state, info = _run_fit(clip.frames, DEMO_CONFIG, observe)
    model = to_model(state, DEMO_CONFIG, clip.size, clip.fps)
    pictures: list[np.ndarray] = []
    scores = evaluate_with_progress(model, clip.frames, pictures.append)
    figures = figures_of(model, scores) | {"fit_seconds": round(info.seconds, 2), "steps": info.step}
    frames = {"psnr": scores.psnr, "ssim": scores.ssim}
    write_json(out_dir / DEMO_RECORD, figures | frames)  # first: whatever stops this demo, the next may replace it
    path = save_video_model(
        out_dir / "model.safetensors", model, metadata=describe_source(clip, DEMO_CONFIG.seed) | scores_of(scores)
    )
    figures["file_bytes"] = path.stat().st_size
    write_video(out_dir / "reconstruction.mp4", pictures, clip.fps)
    shown = np.linspace(0, clip.num_frames - 1, 4).round().astype(int)
    captions = [f"frame {k}, {scores.psnr[k]:.1f} dB" for k in shown]
    picture = make_comparison_sheet([clip.frames[k] for k in shown], [pictures[k] for k in shown], captions)
    write_image(out_dir / "comparison.png", picture)
    write_json(out_dir / DEMO_RECORD, figures | frames)
    print_figures("Demo", figures)
    for name, what in (
        ("comparison.png", "original, reconstruction and error side by side"),
        ("reconstruction.mp4", "plays in any browser (VP9)"),
        ("model.safetensors", "the model: try `foldgauss render` on it with --upsample 4"),
        (DEMO_RECORD, "the figures above, and by frame"),
    ):
        out.print(f"  {out_dir / name}  {what}", soft_wrap=True)


def _is_demos(path: Path) -> bool:
    """Whether it is the record of a demo."""
    try:
        kept = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(kept, dict) and kept.keys() >= {"fit_seconds", "psnr", "ssim"}


@app.command()
@fit_options
def fit(
    context: typer.Context,
    video: NewClip,
    config: FitConfig,
    out_path: Annotated[
        Path | None,
        typer.Option("--out", metavar="MODEL", help="Model file [default: the clip's name, in this folder]."),
    ] = None,
    size: Size = None,
    frames: Frames = None,
    overwrite: Overwrite = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on from where a stopped fit was kept.", rich_help_panel=PROGRESS),
    ] = False,
    history: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.jsonl",
            help="Write every step's figures here as it is done; FILE.png: the curves.",
            rich_help_panel=PROGRESS,
        ),
    ] = None,
    preview: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png",
            help="Keep a picture of the running fit here, new every 10 s.",
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
    """Fit a model to a clip; the first of its budgets ends it.

    A stopped fit is kept and goes on with --resume. A long clip is fitted in segments, by several workers if asked.
    """
    target = named_after(video, MODEL_SUFFIX) if out_path is None else out_path
    refuse_input(target, "clip", video)
    try:
        check_model_name(target, "out")
    except ValueError as error:
        raise WrongUse(as_option(str(error))) from error
    kept = target.with_name(f"{target.name}.checkpoint")
    manner = manner_of(quiet, log_json)
    hands = WorkerOptions(workers, scheduler, threads)
    context.with_resource(lock_output(target, own=(kept,)))
    refuse_existing(target, overwrite)
    begun = kept_seconds(target) is not None and not kept.exists() and (resume or not overwrite)
    if begun or not (segment_seconds is None and workers is None and scheduler is None):
        for option, path in (("--history", history), ("--preview", preview)):
            if path is not None:
                raise WrongUse(f"{option}: expected a fit in one piece, got one in segments. Leave it out.")
        parsed = {"size": parse_size(size), "frames": parse_frames(frames)}
        how = {
            "segment_seconds": segment_seconds,
            "hands": hands,
            "checkpoint_seconds": checkpoint_seconds,
        }
        fit_in_segments(video, target, config, manner, resume=resume, overwrite=overwrite, **parsed, **how)
        return
    curves = _check_records(target, video, history, preview, overwrite or resume)
    if kept.exists() and not (resume or overwrite):
        raise WrongUse(f"--out: a stopped fit is kept in {kept}. Go on with --resume, or start anew with --overwrite.")
    if resume and not kept.exists():
        raise WrongUse(f"--resume: expected a stopped fit in {kept}, got none. Start it without --resume.")
    clip = read_video(video, frames=parse_frames(frames), size=parse_size(size))
    try:
        choose_engine(clip.frames, config)
    except ValueError as error:
        raise WrongUse(as_option(str(error))) from error
    _say_clip(clip, config, manner)
    source = fingerprint(clip)
    state = load_checkpoint(kept, config=config, source=source) if resume else None

    def keep(state: FitState) -> None:
        save_checkpoint(kept, state, config=config, source=source)

    def begin() -> None:
        if overwrite and not resume:
            kept.unlink(missing_ok=True)  # or a --resume after this fit would go on with the one before

    recorded = None
    if history is not None:
        recorded = HistoryFile(history) if state is None else HistoryFile(history, state.step, running_psnr(state))
    previews = None if preview is None else previewing(preview, clip, config)
    with watching(manner, err, history=recorded, preview=previews) as observe:
        state, info = _run_fit(clip.frames, config, observe, state, keep, begin, seconds=checkpoint_seconds)
    model = to_model(state, config, clip.size, clip.fps)
    about = noted(clip, config.seed, frames)
    try:
        save_video_model(target, model, metadata=about)  # at once: what comes now may be stopped
    except OSError as error:
        raise _unsaved(error, keep, state, kept) from error
    try:
        if history is not None:
            _draw_curves(curves, history)
        scores = evaluate_with_progress(model, clip.frames, shown=manner in ("bar", "lines"))
    except KeyboardInterrupt:
        _keep_if_possible(keep, state)
        if kept.exists():
            text = f"{target} is written, its scores are not measured yet: add --resume --overwrite for them."
            err.print(text, soft_wrap=True)
        raise
    try:
        save_video_model(target, model, metadata=about | scores_of(scores))
    except OSError as error:  # of the second write; the model is there
        err.print(f"warning: {target} is written, but its scores could not be noted in it: {error}", soft_wrap=True)
    kept.unlink(missing_ok=True)
    smallest_at_psnr = None if config.economy is None else config.economy.psnr
    if smallest_at_psnr is not None and info.stopped_by != "smallest_at_psnr":
        got = f"{scores.mean_psnr:.2f} dB after {info.step:,} steps"
        err.print(
            f"warning: --smallest-at-psnr: {smallest_at_psnr:g} dB was not reached, got {got}. "
            "Give more --steps, or more --gaussians at the start.",
            soft_wrap=True,
        )
    figures = figures_of(model, scores) | {"fit_seconds": round(info.seconds, 2), "steps": info.step}
    figures |= {"stopped_by": info.stopped_by, "file_bytes": target.stat().st_size}
    if manner == "json":
        with suppress(OSError):  # nobody listens any more, but the model is there
            print_json("done", {"model": str(target)} | figures)
    elif manner != "quiet":
        print_figures(str(target), figures)


def noted(clip: Clip, seed: int, frames: str | None) -> dict[str, Any]:
    """What `fit` notes in a model's file, but for its scores."""
    return describe_source(clip, seed) | {"frames": parse_frames(frames)}


def _check_records(target: Path, video: Path, history: Path | None, preview: Path | None, overwrite: bool) -> Path:
    """Refuse places for the history, its curves and the preview that cannot be right; returns that of the curves."""
    curves = Path() if history is None else history.with_suffix(".png")
    asked = {"--history": (history, ".jsonl"), "--preview": (preview, ".png")}
    for option, (path, suffix) in asked.items():
        if path is not None and path.suffix != suffix:
            raise WrongUse(str(invalid(option, expected=f"a name ending in {suffix}", got=path)))
    places = [("--history", history), ("--history", None if history is None else curves), ("--preview", preview)]
    taken = {target.resolve(), video.resolve()}
    for option, path in places:
        if path is None:
            continue
        if video.is_dir() and path.resolve().parent == video.resolve():
            raise WrongUse(
                f"{option}: expected a place outside the clip's folder, got {path}: it would be a frame there."
            )
        if path.resolve() in taken:
            raise WrongUse(f"{option}: expected a file of its own, got {path}, which has another use. Choose another.")
        taken.add(path.resolve())
        refuse_existing(path, overwrite, option)
        check_writable(path)
    return curves


def make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out: cannot make the folder {path} ({error.strerror}). Choose another.") from error
    check_writable(path / "model.safetensors")


def _run_fit(
    frames: np.ndarray,
    config: FitConfig,
    observe: Observer,
    resumed: FitState | None = None,
    keep: Callable[[FitState], object] | None = None,
    begin: Callable[[], object] = lambda: None,
    *,
    seconds: float | None = None,
) -> tuple[FitState, FitInfo]:
    """Run the fit; `observe` sees each step, `keep` is called now and then, and before leaving on a signal.

    `begin` is called once there is a first step, and so something in place of what was there before.
    """
    try:
        return _watched_steps(fit_steps(frames, config, resumed), observe, keep, begin, seconds)
    except FitDiverged as error:
        raise _diverged(error, keep) from error


def _watched_steps(
    steps: Iterator[tuple[FitState, FitInfo]],
    observe: Observer,
    keep: Callable[[FitState], object] | None,
    begin: Callable[[], object],
    seconds: float | None,
) -> tuple[FitState, FitInfo]:
    """The last of the steps; a signal ends them, once what is done is kept."""
    with noted_signals() as asked:
        kept_at = time.monotonic()
        for state, info in steps:
            if not asked.stepping:
                asked.stepping = True
                begin()
            observe(state, info)  # first: what is kept at a step is in the history
            if keep is not None and time.monotonic() - kept_at > (CHECKPOINT_SECONDS if seconds is None else seconds):
                _keep_if_possible(keep, state)
                kept_at = time.monotonic()
            if asked.name and info.progress < 1:
                raise _stopped(asked.name, state, info, keep)
    return state, info


def _diverged(error: FitDiverged, keep: Callable[[FitState], object] | None) -> Stopped:
    """Keep what was sound, and say so."""
    if keep is None or error.state is None:
        return Stopped(str(error))
    keep(error.state)
    return Stopped(f"{error} It is kept: --resume goes on from there, with --on-divergence back-off at lower rates.")


def _keep_if_possible(keep: Callable[[FitState], object], state: FitState) -> None:
    """A full disk now is no reason to lose the fit: say so, and go on."""
    try:
        keep(state)
    except OSError as error:
        err.print(f"warning: the fit could not be kept at step {state.step}: {error}", soft_wrap=True)


def _unsaved(error: OSError, keep: Callable[[FitState], object], state: FitState, kept: Path) -> OutputError:
    """The fit is done, its model cannot be written: keep the fit if that can be, and say how to go on."""
    _keep_if_possible(keep, state)
    if not kept.exists():
        return OutputError(f"{error} There was no room to keep the fit either: it is lost.")
    return OutputError(f"{error} The fit is kept in {kept}: --resume goes on from there, and writes the model.")


def _stopped(name: str, state: FitState, info: FitInfo, keep: Callable[[FitState], object] | None) -> Stopped:
    """Keep the fit and say how to go on."""
    if keep is None:
        return Stopped(f"stopped by {name} after step {info.step}; nothing was kept.")
    keep(state)
    return Stopped(f"stopped by {name} after step {info.step}; add --resume to go on from there.")


def _draw_curves(path: Path, history: Path) -> None:
    """The fit is done by now: what goes wrong with its curves is told, no more."""
    try:
        write_curves(path, read_history(history))
    except (ImportError, OSError, ValueError) as error:
        err.print(f"warning: no curves in {path}: {error}", soft_wrap=True)


def _say_clip(clip: Clip, config: FitConfig, manner: Manner) -> None:
    height, width = clip.size
    tell_of(clip)
    num = chosen_num_gaussians(config, clip.num_frames, height, width)
    steps = planned_steps(config, clip.num_frames)
    if steps is not None and steps * config.batch_size < clip.num_frames:
        err.print(
            f"warning: --steps: {steps:,} steps see {steps * config.batch_size:,} of {clip.num_frames:,} frames; the "
            "others stay as they start, and look faint.",
            soft_wrap=True,
        )
    budgets = {"{:,} steps": steps, "{:g} minutes": config.minutes, "{:g} dB": config.target_psnr}
    plan = " or ".join(text.format(value) for text, value in budgets.items() if value is not None)
    if config.economy is not None:
        wanted = config.economy.psnr
        plan += ", only what pays" if wanted is None else f", the smallest at {wanted:g} dB"
    if manner == "json":
        about = {"clip": clip.source, "num_frames": clip.num_frames, "height": height, "width": width}
        print_json("start", about | {"num_gaussians": num, "degree": config.degree, "threads": num_threads()})
    if manner in ("json", "quiet"):
        return
    growing = "" if config.growth is None else " at the start"
    engine = choose_engine(clip.frames, config)
    computed = f"{num_threads()} threads" if engine == "cpu" else f"engine {engine} on {describe_device()}"
    number = "1 frame" if clip.num_frames == 1 else f"{clip.num_frames} frames"
    out.print(
        f"{clip.source}: {number} of {height}x{width}{' with alpha' if clip.has_alpha else ''}, "
        f"{num:,} Gaussians of degree {config.degree}{growing}, "
        f"{plan}, {computed}",
        soft_wrap=True,
    )
