"""The command that fits many clips: `fit-many`."""

import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Column, Table

from foldgauss.cli.app.application import WrongUse, as_option, err, out
from foldgauss.cli.app.completion import files
from foldgauss.cli.app.shared import (
    Frames,
    Overwrite,
    Size,
    app,
    parse_frames,
    parse_size,
    write_json,
)
from foldgauss.cli.fitting.fit import make_folder
from foldgauss.cli.fitting.jobs_view import WorkerOptions, run_jobs, tell_json
from foldgauss.cli.fitting.options import (
    CheckpointSeconds,
    LogJson,
    Quiet,
    Scheduler,
    Threads,
    Workers,
    fit_options,
    manner_of,
)
from foldgauss.io._lock import lock_output
from foldgauss.jobs import FitJob, Outcome, find_clips, jobs_of
from foldgauss.jobs.fitting import begin, begun, finished
from foldgauss.jobs.many import RECORDS
from foldgauss.video.fitting.config import FitConfig

SUMMARY = "summary.json"
#: The summary is written anew no more often: there may be thousands of clips.
SUMMARY_SECONDS = 5.0
#: Above, the table shows failures alone; the summary has all.
MOST_ROWS = 60


@app.command(name="fit-many")
@fit_options
def fit_many(
    context: typer.Context,
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Folder with video files, and folders of images.", autocompletion=files()
        ),
    ],
    config: FitConfig,
    out_dir: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for the models [default: FOLDER-models, in this folder]."),
    ] = None,
    size: Size = None,
    frames: Frames = None,
    overwrite: Overwrite = False,
    checkpoint_seconds: CheckpointSeconds = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    threads: Threads = None,
    quiet: Quiet = False,
    log_json: LogJson = False,
) -> None:
    """Fit a model to each clip of a folder; those that cannot be fitted are listed.

    Models go to DIR under the clips' names, what became of each to DIR/summary.json. Given again, the command does what
    is left, from where stopped fits were kept. It exits with 1 where a clip failed.
    """
    manner = manner_of(quiet, log_json)
    hands = WorkerOptions(workers, scheduler, threads)
    found = find_clips(folder)
    out_dir = Path(f"{folder.resolve().name}-models") if out_dir is None else out_dir
    if out_dir.exists() and out_dir.resolve() == folder.resolve():
        raise WrongUse(f"--out: expected another folder than the clips', got {out_dir}.")
    make_folder(out_dir)
    make_folder(out_dir / RECORDS)
    context.with_resource(lock_output(out_dir / SUMMARY, what="fit-many"))
    try:
        how = {"size": parse_size(size), "frames": parse_frames(frames), "checkpoint_seconds": checkpoint_seconds}
        jobs = jobs_of(found.clips, out_dir, config, **how)
    except ValueError as error:
        raise WrongUse(as_option(str(error))) from error
    _make_room(jobs, overwrite)
    before = sum(finished(job) is not None for job in jobs)
    if manner in ("bar", "lines"):
        done = f", {before} of them done before" if before else ""
        out.print(f"{folder}: {_number(len(jobs), 'clip')}{done}, by {hands}", soft_wrap=True)
        if found.others:
            names = ", ".join(entry.name for entry in found.others[:3]) + (", ..." if len(found.others) > 3 else "")
            out.print(f"left alone, no clips: {names}", soft_wrap=True)
    ended: dict[str, Outcome] = {}

    written = -SUMMARY_SECONDS

    def on_end(outcome: Outcome) -> None:
        nonlocal written
        ended[outcome.job.target] = outcome
        if len(ended) == len(jobs) or time.monotonic() - written > SUMMARY_SECONDS:
            try:
                _summarise(out_dir, jobs, ended)
            except OSError as error:  # a full disk now is no reason to lose the fits
                err.print(f"warning: {error}", soft_wrap=True)
            written = time.monotonic()

    again = "Give the command again without --overwrite" if overwrite else "Give the same command again"
    with hands.crew() as crew:
        outcomes = run_jobs(jobs, "clips", manner, crew, cure=f"{again} to go on.", on_end=on_end)
    failed = [outcome for outcome in outcomes if outcome.failure is not None]
    if manner == "json":
        tell_json("done", {"summary": str(out_dir / SUMMARY), "done": len(jobs) - len(failed), "failed": len(failed)})
    elif manner != "quiet":
        _print_table(str(out_dir), outcomes)
    for outcome in failed:
        err.print(f"failed: {outcome.job.name}: {outcome.failure}", style="red", soft_wrap=True)
    if failed:
        raise typer.Exit(1)


def _number(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def _make_room(jobs: list[FitJob], overwrite: bool) -> None:
    """Refuse models and stopped fits that are there and are not of what is asked for, or give them up.

    What is asked is noted for each clip: given again, the command may replace what stood there when it was begun.
    """
    waiting = jobs if overwrite else [job for job in jobs if finished(job) is None]
    for job in [] if overwrite else waiting:
        before = begun(job)
        if before == job.asked:
            continue
        for path in (job.target, job.kept):
            mine = before is None and job.kept.exists()
            if os.path.exists(path) and not mine:
                raise WrongUse(
                    f"--out: {path} exists, of other settings or another clip. Remove it, choose another folder, or "
                    "add --overwrite, which begins all anew."
                )
    for job in waiting:
        if overwrite:
            job.kept.unlink(missing_ok=True)
        if overwrite or begun(job) != job.asked:
            begin(job)


def _summarise(out_dir: Path, jobs: list[FitJob], ended: dict[str, Outcome]) -> None:
    """What became of each so far, as JSON; of those that are not done yet, nothing."""
    rows = [_row(ended[job.target]) for job in jobs if job.target in ended]
    failed = sum("failure" in row for row in rows)
    write_json(out_dir / SUMMARY, {"clips": len(jobs), "done": len(rows) - failed, "failed": failed, "each": rows})


_FIGURES = (
    "num_frames",
    "size",
    "num_gaussians",
    "mean_psnr",
    "mean_ssim",
    "seconds",
    "steps",
    "file_bytes",
    "warnings",
)


def _row(outcome: Outcome) -> dict[str, Any]:
    named = {"clip": outcome.job.name}
    if outcome.failure is not None:
        return named | {"failure": outcome.failure}
    return named | {"model": Path(outcome.job.target).name} | {name: outcome.record[name] for name in _FIGURES}


def _print_table(title: str, outcomes: list[Outcome]) -> None:
    failed = sum(outcome.failure is not None for outcome in outcomes)
    table = Table(Column("clip", overflow="fold"), title=title)
    for name in ("frames", "PSNR (dB)", "SSIM", "Gaussians", "bytes", "seconds"):
        table.add_column(name, justify="right", no_wrap=True)
    if len(outcomes) <= MOST_ROWS:
        for outcome in outcomes:
            if outcome.failure is not None:
                table.add_row(outcome.job.name, "failed")
                continue
            one = outcome.record
            frames = f"{one['num_frames']} of {one['size'][0]}x{one['size'][1]}"
            figures = f"{one['mean_psnr']:.2f}", f"{one['mean_ssim']:.4f}", f"{one['num_gaussians']:,}"
            rest = f"{one['file_bytes']:,}", f"{one['seconds']:.1f}"
            table.add_row(outcome.job.name, frames, *figures, *rest)
        out.print(table)
    done = [outcome.record for outcome in outcomes if outcome.failure is None]
    told = f"{_number(len(done), 'model')} in {title}"
    if done:
        mean, seconds = sum(one["mean_psnr"] for one in done) / len(done), sum(one["seconds"] for one in done)
        told += f", {mean:.2f} dB in the mean, {seconds:,.0f} s of fitting"
    out.print(f"{told}; {failed} failed" if failed else told, soft_wrap=True)
