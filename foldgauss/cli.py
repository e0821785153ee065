"""The command `foldgauss`: arguments and exit codes. The work is done on the floors below."""

import dataclasses
import hashlib
import json
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table

from foldgauss import __version__
from foldgauss._checks import invalid
from foldgauss._progress import Manner, Observer, previewing, print_json, watching
from foldgauss._threads import num_threads
from foldgauss.datasets import sample_clip
from foldgauss.io._atomic import OutputError, atomic_path, check_writable
from foldgauss.io.history import HistoryFile, read_history, write_curves
from foldgauss.io.model_file import read_header
from foldgauss.io.pictures import comparison
from foldgauss.io.video_file import MAX_FPS, VIDEO_SUFFIXES, Clip, memory_limit, read_video, write_image, write_video
from foldgauss.io.video_model import load_checkpoint, load_video_model, save_checkpoint, save_video_model
from foldgauss.video.config import PRESETS, FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fit import FitInfo, FitState, fit_steps, running_psnr, to_model
from foldgauss.video.frame_times import interpolated_times
from foldgauss.video.metrics import Evaluation, evaluate
from foldgauss.video.model import VideoModel

WRONG_USE, FAILURE = 2, 1
MAX_UPSAMPLE = 100_000  # above, a clip of seconds plays for days
#: A running fit is kept on disk this often, in seconds.
CHECKPOINT_SECONDS = 30.0
DEMO_SIZE, DEMO_FRAMES = (160, 320), (0, 24)
DEMO_FILES = {"model.safetensors", "reconstruction.mp4", "comparison.png", "metrics.json"}
DEMO_CONFIG = FitConfig(num_gaussians=20_000, degree=3, steps=1500)

#: What a user may take `fit --out` for: the clip as a picture, not the model.
_OTHER_SUFFIXES = {*VIDEO_SUFFIXES, ".mov", ".avi", ".mkv", ".gif", ".png", ".jpg", ".jpeg", ".json", ".jsonl"}

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
# No markup: names of files may hold brackets.
out = Console(markup=False, highlight=False)
err = Console(stderr=True, markup=False, highlight=False)

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an output that exists.")]
Size = Annotated[str | None, typer.Option(metavar="HxW", help="Height x width in pixels, as 160x320.")]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="Frames A up to, not including, B.")]


class WrongUse(ValueError):
    """The command was called with arguments that cannot be right."""


class Stopped(Exception):
    """The user asked a fit to stop; the message says how to go on."""


def _show_version(wanted: bool) -> None:
    if wanted:
        out.print(f"foldgauss {__version__}")
        raise typer.Exit


@app.callback()
def root(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.", is_eager=True, callback=_show_version)
    ] = False,
) -> None:
    """Videos as mixtures of folded Gaussians: fit, render, evaluate."""
    del debug, version  # read by `main`, before typer runs, and by the callback


@app.command()
def demo(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("foldgauss-demo"),
) -> None:
    """Fit 24 frames of the sample clip Bunny at 160x320 and show what comes out.

    A later demo replaces the files of an earlier one; a folder with other files in it is left alone.
    """
    _refuse_foreign(out_dir)
    clip = read_video(sample_clip("bunny"), frames=DEMO_FRAMES, size=DEMO_SIZE)
    _make_folder(out_dir)
    out.print(f"Bunny, frames 0 to {DEMO_FRAMES[1] - 1}, 160x320, on {num_threads()} threads")
    with watching(_manner(), err) as observe:
        state, info = _run_fit(clip.frames, DEMO_CONFIG, observe)
    model = to_model(state, DEMO_CONFIG, clip.size, clip.fps)
    pictures: list[np.ndarray] = []
    scores = _evaluate_with_progress(model, clip.frames, pictures.append)
    figures = _figures(model, scores) | {"fit_seconds": round(info.seconds, 2), "steps": info.step}
    path = save_video_model(
        out_dir / "model.safetensors", model, metadata=_provenance(clip, DEMO_CONFIG) | _scores(scores)
    )
    figures["file_bytes"] = path.stat().st_size
    write_video(out_dir / "reconstruction.mp4", pictures, clip.fps)
    shown = np.linspace(0, clip.num_frames - 1, 4).round().astype(int)
    captions = [f"frame {k}, {scores.psnr[k]:.1f} dB" for k in shown]
    picture = comparison([clip.frames[k] for k in shown], [pictures[k] for k in shown], captions)
    write_image(out_dir / "comparison.png", picture)
    _write_json(out_dir / "metrics.json", figures | {"psnr": scores.psnr, "ssim": scores.ssim})
    _print_figures("Demo", figures)
    for name, what in (
        ("comparison.png", "original, reconstruction and error side by side"),
        ("reconstruction.mp4", "plays in any browser (VP9)"),
        ("model.safetensors", "the model: try `foldgauss render` on it with --upsample 4"),
        ("metrics.json", "the figures above, and by frame"),
    ):
        out.print(f"  {out_dir / name}  {what}", soft_wrap=True)


@app.command()
def fit(
    video: Annotated[Path, typer.Argument(help="Video file, or folder of images in natural order.")],
    out_path: Annotated[
        Path | None, typer.Option("--out", metavar="MODEL", help="Model file [default: the clip's name].")
    ] = None,
    preset: Annotated[
        str, typer.Option(help=f"Recipe that other options change: {', '.join(PRESETS)} (slow: the published one).")
    ] = "standard",
    size: Size = None,
    frames: Frames = None,
    gaussians: Annotated[
        int | None,
        typer.Option(help="Number of Gaussians at the start [default: by the preset, or the frame's size]."),
    ] = None,
    max_gaussians: Annotated[int | None, typer.Option(help="Largest number of Gaussians, grown or not.")] = None,
    max_size_mb: Annotated[
        float | None,
        typer.Option("--max-size-mb", help="Largest model file, in 10^6 bytes; limits the Gaussians."),
    ] = None,
    degree: Annotated[
        int | None, typer.Option(help="Degree of the fold polynomial [default: 3; draft: 2; paper: 7].")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="Optimiser steps [default: 3000, more for long clips; draft: 800; paper: 30000].")
    ] = None,
    minutes: Annotated[float | None, typer.Option(help="Time to fit for.")] = None,
    target_psnr: Annotated[
        float | None, typer.Option("--target-psnr", help="Stop once the mean PSNR of the frames is this, in dB.")
    ] = None,
    batch_size: Annotated[int | None, typer.Option(help="Frames per step [default: 1; paper: 3].")] = None,
    power: Annotated[
        float | None,
        typer.Option(help="Power of the envelope a(t): 1 as in the paper's text, 2 as in its code [default: 2]."),
    ] = None,
    compositing: Annotated[
        str | None, typer.Option(help="Blend of the Gaussians: over (front to back) or sum [default: over].")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random starts and of the order of frames.")] = 0,
    overwrite: Overwrite = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from where a stopped fit was kept.")] = False,
    history: Annotated[
        Path | None,
        typer.Option(metavar="FILE.jsonl", help="Write every step's figures here as it is done; FILE.png: the curves."),
    ] = None,
    preview: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Keep a picture of the running fit here, new every 10 s.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but warnings and errors.")] = False,
    log_json: Annotated[bool, typer.Option("--log-json", help="Tell progress and figures as lines of JSON.")] = False,
) -> None:
    """Fit a model to a clip, until the first of the given budgets binds.

    A stopped fit is kept and goes on with --resume.
    """
    changes = {
        "num_gaussians": gaussians,
        "max_gaussians": max_gaussians,
        "degree": degree,
        "steps": steps,
        "minutes": minutes,
        "target_psnr": target_psnr,
        "max_size_mb": max_size_mb,
        "batch_size": batch_size,
        "power": power,
        "compositing": compositing,
        "seed": seed,
    }
    try:
        config = FitConfig.preset(preset, **{name: value for name, value in changes.items() if value is not None})
    except ValueError as error:
        raise WrongUse(_as_option(str(error))) from error
    target = Path(f"{video.resolve().stem}.safetensors") if out_path is None else out_path
    kept = target.with_name(f"{target.name}.checkpoint")
    if target.exists() and video.exists() and target.samefile(video):
        raise WrongUse(f"--out: expected another file than the clip, got {target}.")
    if out_path is not None and out_path.suffix.lower() in _OTHER_SUFFIXES:
        raise WrongUse(
            f"--out: expected a name for the model, as {out_path.with_suffix('.safetensors')}, got {out_path}."
        )
    manner = _manner(quiet, log_json)
    _refuse_existing(target, overwrite)
    curves = _check_records(target, video, history, preview, overwrite or resume)
    if kept.exists() and not (resume or overwrite):
        raise WrongUse(f"--out: a stopped fit is kept in {kept}. Go on with --resume, or start anew with --overwrite.")
    if resume and not kept.exists():
        raise WrongUse(f"--resume: expected a stopped fit in {kept}, got none. Start it without --resume.")
    check_writable(target)
    clip = read_video(video, frames=_parse_frames(frames), size=_parse_size(size))
    _say_clip(clip, config, manner)
    source = _fingerprint(clip)
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
        state, info = _run_fit(clip.frames, config, observe, state, keep, begin)
    model = to_model(state, config, clip.size, clip.fps)
    about = _provenance(clip, config) | {"frames": _parse_frames(frames)}
    save_video_model(target, model, metadata=about)  # at once: what comes now may be stopped
    kept.unlink(missing_ok=True)
    if history is not None:
        _draw_curves(curves, history)
    scores = _evaluate_with_progress(model, clip.frames, shown=manner in ("bar", "lines"))
    save_video_model(target, model, metadata=about | _scores(scores))
    figures = _figures(model, scores) | {"fit_seconds": round(info.seconds, 2), "steps": info.step}
    figures |= {"stopped_by": info.stopped_by, "file_bytes": target.stat().st_size}
    if manner == "json":
        with suppress(OSError):  # nobody listens any more, but the model is there
            print_json("done", {"model": str(target)} | figures)
    elif manner != "quiet":
        _print_figures(str(target), figures)


@app.command()
def render(
    model_path: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.")],
    out_path: Annotated[Path, typer.Option("--out", help="FILE.mp4, FILE.webm, or a folder for PNG frames.")],
    size: Size = None,
    upsample: Annotated[int, typer.Option(help="Frames per original interval.")] = 1,
    background: Annotated[
        str, typer.Option(metavar="RRGGBB", help="Colour behind a model of a clip with alpha, as ffffff.")
    ] = "000000",
    overwrite: Overwrite = False,
) -> None:
    """Draw a model as a video, in between its frames too."""
    if upsample < 1:
        raise WrongUse(str(invalid("--upsample", expected="a whole number >= 1", got=upsample)))
    if upsample > MAX_UPSAMPLE:
        raise WrongUse(str(invalid("--upsample", expected=f"at most {MAX_UPSAMPLE:,}", got=upsample)))
    picture_size, behind = _parse_size(size), _parse_color(background)
    if out_path.suffix and not out_path.is_dir():
        if out_path.suffix.lower() not in VIDEO_SUFFIXES:
            wanted = " or ".join(VIDEO_SUFFIXES)
            raise WrongUse(str(invalid("--out", expected=f"{wanted}, or a folder without extension", got=out_path)))
        _refuse_existing(out_path, overwrite)
        check_writable(out_path)
    _refuse_huge(picture_size)
    model = load_video_model(model_path)
    times = interpolated_times(np.asarray(model.frame_times.times()), upsample)
    fps = model.fps * upsample
    if out_path.suffix and fps > MAX_FPS:
        raise WrongUse(
            f"--upsample: expected at most {int(MAX_FPS / model.fps)} for a video of {model.fps:g} frames a second, "
            f"got {upsample}. Write to a folder instead."
        )
    with _bar("Rendering", len(times)) as advance:
        pictures = _counted(model.frames(times, picture_size, background=behind), advance)
        path = write_video(out_path, pictures, min(fps, MAX_FPS), overwrite=overwrite)
    out.print(f"{path}: {len(times)} frames at {fps:g} frames a second", soft_wrap=True)


@app.command(name="evaluate")
def evaluate_command(
    model_path: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.")],
    video: Annotated[Path, typer.Argument(help="The clip it was fitted to.")],
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
    frames: Frames = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare a model with its clip: PSNR and SSIM per frame, size of the file, bits per pixel."""
    if json_path is not None:
        _refuse_existing(json_path, overwrite, "--json")
        check_writable(json_path)
    model = load_video_model(model_path)
    about = read_header(model_path)["metadata"]
    kept = about.get("frames")
    wanted = _parse_frames(frames) if frames is not None else (tuple(kept) if kept else None)
    clip = read_video(video, frames=wanted, size=model.size)
    if clip.num_frames != model.num_frames:
        raise WrongUse(
            f"--frames: expected {model.num_frames} frames as in the model, got {clip.num_frames} of {clip.source!r}. "
            "Name the frames it was fitted to."
        )
    _say_other_frames(about, clip)
    scores = _evaluate_with_progress(model, clip.frames)
    num_bytes = model_path.stat().st_size
    figures = _figures(model, scores) | {"file_bytes": num_bytes}
    if clip.has_alpha:
        figures["mean_psnr_on_white"] = round(evaluate(model, clip.frames, background=(1.0, 1.0, 1.0)).mean_psnr, 3)
    figures["bits_per_pixel"] = 8 * num_bytes / (model.num_frames * model.size[0] * model.size[1])
    if json_path is not None:
        _write_json(json_path, figures | {"psnr": scores.psnr, "ssim": scores.ssim})
    _print_frames(scores)
    _print_figures(str(model_path), figures)


@app.command()
def info(model_path: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.")]) -> None:
    """Say what a model file holds."""
    model = load_video_model(model_path)
    about = read_header(model_path)["metadata"]
    envelope = model.splats.envelope
    times = np.asarray(model.frame_times.times())
    figures = {
        "frames": f"{model.num_frames} of {model.size[0]}x{model.size[1]} (height x width), {model.fps:g} a second",
        "Gaussians": f"{model.splats.num_gaussians:,}",
        "fold": f"polynomial of degree {model.splats.degree}",
        "envelope": f"time likelihood, power {float(envelope.power):g} (paper's text 1, its code 2)",
        "frame times": f"learned, steps {np.diff(times).min():.2e} to {np.diff(times).max():.2e}",
        "numbers stored": f"{model.num_floats:,}",
        "file": f"{model_path.stat().st_size:,} bytes",
    }
    table = Table(title=str(model_path), show_header=False)
    for name, value in (figures | {k: _short(v) for k, v in about.items() if v is not None}).items():
        table.add_row(name, value)
    out.print(table)


# ------------------------------------------------------------------------------------------- arguments


def _parse_size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    height, cross, width = text.lower().partition("x")
    if not (cross and height.isdecimal() and width.isdecimal() and int(height) > 0 and int(width) > 0):
        raise WrongUse(f"--size: expected HxW with both at least 1, as 160x320, got {text!r}.")
    return int(height), int(width)


def _parse_frames(text: str | None) -> tuple[int | None, int | None] | None:
    if text is None:
        return None
    first, colon, last = text.partition(":")
    if not colon or any(part and not part.isdecimal() for part in (first, last)):
        raise WrongUse(f"--frames: expected A:B with whole numbers >= 0, as 0:24, got {text!r}.")
    return (int(first) if first else None), (int(last) if last else None)


def _parse_color(text: str) -> tuple[float, float, float]:
    digits = text.removeprefix("#")
    if not re.fullmatch("[0-9a-fA-F]{6}", digits):
        raise WrongUse(f"--background: expected six hexadecimal digits RRGGBB, as ffffff for white, got {text!r}.")
    return tuple(byte / 255 for byte in bytes.fromhex(digits))


def _refuse_huge(size: tuple[int, int] | None) -> None:
    """A picture is held in floats, some copies of it."""
    if size is not None and 64 * size[0] * size[1] > memory_limit():
        raise WrongUse(f"--size: expected a picture that fits in memory, got {size[0]}x{size[1]}. Take a smaller one.")


def _refuse_existing(path: Path, overwrite: bool, option: str = "--out") -> None:
    if path.exists() and not overwrite:
        raise WrongUse(f"{option}: {path} exists. Choose another path, or add --overwrite.")


def _manner(quiet: bool = False, log_json: bool = False) -> Manner:
    """How a fit is shown: as asked, else a bar on a terminal and lines in a log."""
    if quiet and log_json:
        raise WrongUse("--quiet: expected one of --quiet and --log-json, got both. Leave one out.")
    if quiet or log_json:
        return "quiet" if quiet else "json"
    return "bar" if err.is_terminal else "lines"


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
        _refuse_existing(path, overwrite, option)
        check_writable(path)
    return curves


def _refuse_foreign(folder: Path) -> None:
    """A demo replaces its own files only, so nothing else may be among them."""
    try:
        names = {entry.name for entry in folder.iterdir() if not entry.name.startswith(".")}
    except OSError:  # missing, or no folder: making it says so
        return
    foreign = sorted(names - DEMO_FILES)
    if foreign:
        raise WrongUse(
            f"--out: expected a new folder or one that a demo wrote, got {folder} with {foreign[0]!r} in it. "
            "Choose another folder."
        )


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out: cannot make the folder {path} ({error.strerror}). Choose another.") from error
    check_writable(path / "model.safetensors")


# -------------------------------------------------------------------------------------------- progress


def _run_fit(
    frames: np.ndarray,
    config: FitConfig,
    observe: Observer,
    resumed: FitState | None = None,
    keep: Callable[[FitState], object] | None = None,
    begin: Callable[[], object] = lambda: None,
) -> tuple[FitState, FitInfo]:
    """Run the fit; `observe` sees each step, `keep` is called now and then, and before leaving on a signal.

    `begin` is called once there is a first step, and so something in place of what was there before.
    """
    with _signals() as asked:
        kept_at = time.monotonic()
        for state, info in fit_steps(frames, config, resumed):
            if not asked.stepping:
                asked.stepping = True
                begin()
            observe(state, info)  # first: what is kept at a step is in the history
            if keep is not None and time.monotonic() - kept_at > CHECKPOINT_SECONDS:
                _keep_if_possible(keep, state)
                kept_at = time.monotonic()
            if asked.name and info.progress < 1:
                raise _stopped(asked.name, state, info, keep)
    return state, info


def _keep_if_possible(keep: Callable[[FitState], object], state: FitState) -> None:
    """A full disk now is no reason to lose the fit: say so, and go on."""
    try:
        keep(state)
    except OSError as error:
        err.print(f"warning: the fit could not be kept at step {state.step}: {error}", soft_wrap=True)


def _stopped(name: str, state: FitState, info: FitInfo, keep: Callable[[FitState], object] | None) -> Stopped:
    """Keep the fit and say how to go on."""
    if keep is None:
        return Stopped(f"stopped by {name} after step {info.step}; nothing was kept.")
    keep(state)
    return Stopped(f"stopped by {name} after step {info.step}; add --resume to go on from there.")


@dataclasses.dataclass
class _Asked:
    """The signal that asked a fit to stop; and whether it had taken a step by then, which must not be cut in half."""

    name: str = ""
    stepping: bool = False


@contextmanager
def _signals() -> Iterator[_Asked]:
    """Note SIGINT and SIGTERM, for the end of a step; before the first step they stop at once, as a second SIGINT."""
    asked, before = _Asked(), {}

    def note(number, frame) -> None:
        asked.name = asked.name or signal.Signals(number).name
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if not asked.stepping:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, note)
    try:
        yield asked
    except KeyboardInterrupt as error:
        if asked.stepping:
            raise
        raise Stopped(f"stopped by {asked.name} before the first step.") from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _bar(title: str, total: int, shown: bool = True) -> Iterator[Callable[[], None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, disable=not (shown and err.is_terminal)) as progress:
        task = progress.add_task(title, total=total)
        yield lambda: progress.advance(task)


def _counted(items: Iterable[Any], advance: Callable[[], None]) -> Iterator[Any]:
    for item in items:
        yield item
        advance()


def _evaluate_with_progress(
    model: VideoModel,
    frames: np.ndarray,
    keep: Callable[[np.ndarray], None] = lambda picture: None,
    *,
    shown: bool = True,
) -> Evaluation:
    """Scores of every frame; `keep` is handed the pictures they were read off."""
    with _bar("Evaluating", model.num_frames, shown) as advance:

        def on_frame(picture: np.ndarray) -> None:
            keep(picture)
            advance()

        return evaluate(model, frames, on_frame)


# --------------------------------------------------------------------------------------------- results


def _draw_curves(path: Path, history: Path) -> None:
    """The fit is done by now: what goes wrong with its curves is told, no more."""
    try:
        write_curves(path, read_history(history))
    except (ImportError, OSError, ValueError) as error:
        err.print(f"warning: no curves in {path}: {error}", soft_wrap=True)


def _say_clip(clip: Clip, config: FitConfig, manner: Manner) -> None:
    height, width = clip.size
    if clip.num_declared > clip.num_frames:
        err.print(
            f"warning: only {clip.num_frames} of {clip.num_declared} frames of {clip.source} decode; those are used.",
            soft_wrap=True,
        )
    num = chosen_num_gaussians(config, clip.num_frames, height, width)
    steps = planned_steps(config, clip.num_frames)
    budgets = {"{:,} steps": steps, "{:g} minutes": config.minutes, "{:g} dB": config.target_psnr}
    plan = " or ".join(text.format(value) for text, value in budgets.items() if value is not None)
    if manner == "json":
        about = {"clip": clip.source, "num_frames": clip.num_frames, "height": height, "width": width}
        print_json("start", about | {"num_gaussians": num, "degree": config.degree, "threads": num_threads()})
    if manner in ("json", "quiet"):
        return
    growing = "" if config.growth is None else " at the start"
    out.print(
        f"{clip.source}: {clip.num_frames} frames of {height}x{width}{' with alpha' if clip.has_alpha else ''}, "
        f"{num:,} Gaussians of degree {config.degree}{growing}, "
        f"{plan}, {num_threads()} threads",
        soft_wrap=True,
    )


def _say_other_frames(about: dict[str, Any], clip: Clip) -> None:
    """Any clip of the right size may be compared with a model, but not unawares."""
    digest = about.get("frames_digest")  # files from before it was kept have none
    if digest is not None and digest != _fingerprint(clip)["frames_digest"]:
        err.print(
            f"warning: the frames of {clip.source} are not those that the model was fitted to ({about.get('clip')}): "
            "another clip or range, or the same one decoded by another version of OpenCV.",
            soft_wrap=True,
        )


def _figures(model: VideoModel, scores: Evaluation) -> dict[str, Any]:
    return {
        "mean_psnr": round(scores.mean_psnr, 3),
        "mean_ssim": round(scores.mean_ssim, 4),
        "lowest_psnr": round(min(scores.psnr), 3),
        "num_frames": model.num_frames,
        "height": model.size[0],
        "width": model.size[1],
        "num_gaussians": model.splats.num_gaussians,
        "degree": model.splats.degree,
    }


def _provenance(clip: Clip, config: FitConfig) -> dict[str, Any]:
    return {"clip": Path(clip.source).name, "seed": config.seed, "frames_digest": _fingerprint(clip)["frames_digest"]}


def _scores(scores: Evaluation) -> dict[str, Any]:
    return {"mean_psnr": round(scores.mean_psnr, 3), "mean_ssim": round(scores.mean_ssim, 4)}


def _fingerprint(clip: Clip) -> dict[str, Any]:
    """What a resumed fit must find again: the frames themselves, whatever they are called now."""
    digest = hashlib.blake2b(clip.frames, digest_size=16).hexdigest()
    return {"num_frames": clip.num_frames, "size": list(clip.size), "frames_digest": digest}


_LABELS = {
    "mean_psnr": ("mean PSNR", "{:.2f} dB"),
    "mean_psnr_on_white": ("mean PSNR over white", "{:.2f} dB"),
    "mean_ssim": ("mean SSIM", "{:.4f}"),
    "lowest_psnr": ("lowest PSNR of a frame", "{:.2f} dB"),
    "num_frames": ("frames", "{:,}"),
    "height": ("height", "{:,} px"),
    "width": ("width", "{:,} px"),
    "num_gaussians": ("Gaussians", "{:,}"),
    "degree": ("degree of the folds", "{}"),
    "fit_seconds": ("time spent fitting", "{:.1f} s"),
    "steps": ("steps", "{:,}"),
    "stopped_by": ("stopped by", "{}"),
    "file_bytes": ("model file", "{:,} bytes"),
    "bits_per_pixel": ("bits per pixel", "{:.3f}"),
}


def _print_figures(title: str, figures: dict[str, Any]) -> None:
    table = Table(title=title, show_header=False)
    for name, value in figures.items():
        label, form = _LABELS[name]
        table.add_row(label, form.format(value))
    out.print(table)


def _print_frames(scores: Evaluation) -> None:
    table = Table("frame", "PSNR (dB)", "SSIM")
    for k, (psnr, ssim) in enumerate(zip(scores.psnr, scores.ssim, strict=True)):
        table.add_row(str(k), f"{psnr:.2f}", f"{ssim:.4f}")
    out.print(table)


def _short(value: Any) -> str:
    text = json.dumps(value) if isinstance(value, list | dict) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _write_json(path: Path, figures: dict[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n")


# ------------------------------------------------------------------------------------------------ main


def main(arguments: list[str] | None = None) -> None:
    """Run the command and exit: 0 fine, 2 wrong use, 1 failure; one-line errors unless --debug."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments  # taken out, so that it may stand anywhere
    try:
        app([argument for argument in arguments if argument != "--debug"], standalone_mode=True)
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        option = _as_option(text)
        if _names_an_option(text) and option.partition(":")[0] in arguments:
            text = option
        if not isinstance(error, ValueError | OSError | MemoryError | Stopped | KeyboardInterrupt):
            text = f"{type(error).__name__}: {text[:300]} (--debug shows where)"
        err.print(f"error: {text}", style="red", soft_wrap=True)
        sys.exit(_exit_code(error))


def _exit_code(error: BaseException) -> int:
    """Wrong use: an argument that cannot be right. Failure: a file that cannot be read or written."""
    wrong = isinstance(error, WrongUse | FileNotFoundError) or _names_an_option(str(error))
    return WRONG_USE if wrong else FAILURE


def _names_an_option(text: str) -> bool:
    """Whether an error of the floors below is about what the user gave by an option of the same name."""
    return text.startswith(("frames:", "size:", "resume:", "max_size_mb:", "compositing:", "history:", "background:"))


def _as_option(text: str) -> str:
    """An error about a setting, as one about its option: num_gaussians is --gaussians."""
    name, colon, rest = text.partition(":")
    return f"--{name.replace('num_gaussians', 'gaussians').replace('_', '-')}{colon}{rest}"


if __name__ == "__main__":
    main()
