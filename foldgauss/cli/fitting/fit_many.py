"""The command `fit-many`."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from foldgauss._runtime.checks import ParameterError, require
from foldgauss.cli.app.application import command, out, warn
from foldgauss.cli.fitting.job_progress import run_jobs
from foldgauss.cli.fitting.options import (
    CheckpointSeconds,
    LogJson,
    Quiet,
    Scheduler,
    Threads,
    WorkerOptions,
    Workers,
    fit_options,
)
from foldgauss.cli.fitting.segments import print_failures
from foldgauss.cli.shared.arguments import (
    Frames,
    Overwrite,
    Size,
    parse_frames,
    parse_size,
)
from foldgauss.cli.shared.console import choose_display, format_count, write_json
from foldgauss.cli.shared.files import make_folder
from foldgauss.cli.shared.fit_progress import print_json
from foldgauss.io._atomic import lock_output, resolve
from foldgauss.jobs import FitJob, Outcome, find_clips, make_jobs
from foldgauss.jobs.job import RECORDS, read_record, read_request, write_request
from foldgauss.video.fitting.config import DEFAULT_QUALITY, FitConfig

SUMMARY = "summary.json"
#: Fields of a record that the summary shows.
_FIGURES = (
    "num_frames",
    "size",
    "num_gaussians",
    "mean_psnr",
    "mean_ssim",
    "seconds",
    "steps",
    "file_bytes",
    "notes",
    "warnings",
)


@command("fit-many")
@fit_options
def fit_many(
    context: typer.Context,
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder with video files, and folders of images."),
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
    """Fit a compact model to each clip of a folder, and list those that fail.

    Models go to DIR under the clips' names, results to DIR/summary.json. Given again, the command continues with what
    is left, from checkpoints of stopped fits. The exit code is 1 if a clip failed. Options for rare cases: docs/fit.md.
    """
    if not config.is_compact:
        config = dataclasses.replace(config, quality=DEFAULT_QUALITY)
    display = choose_display(quiet, log_json)
    options = WorkerOptions(workers, scheduler, threads)
    found = find_clips(folder)
    out_dir = Path(f"{resolve(folder).name}-models") if out_dir is None else out_dir
    require(
        not out_dir.exists() or resolve(out_dir) != resolve(folder),
        "--out",
        expected="another folder than the clips'",
        got=out_dir,
    )
    make_folder(out_dir)
    make_folder(out_dir / RECORDS)
    context.with_resource(lock_output(out_dir / SUMMARY, what="fit-many"))
    jobs = make_jobs(
        found.clips,
        out_dir,
        config,
        size=parse_size(size),
        frames=parse_frames(frames),
        checkpoint_seconds=checkpoint_seconds,
    )
    _prepare_outputs(jobs, overwrite)
    before = sum(read_record(job) is not None for job in jobs)
    if display in ("bar", "lines"):
        done = f", {before} of them done already" if before else ""
        out.print(f"{folder}: {format_count(len(jobs), 'clip')}{done}, by {options}", soft_wrap=True)
        if found.others:
            names = ", ".join(entry.name for entry in found.others[:3]) + (", ..." if len(found.others) > 3 else "")
            out.print(f"skipped, not clips: {names}", soft_wrap=True)

    def on_end(ended: dict[str, Outcome]) -> None:
        try:
            _write_summary(out_dir, jobs, ended)
        except OSError as error:  # a full disk must not end the fits
            warn(str(error))

    with options.open_client() as client:
        outcomes = run_jobs(jobs, "clips", display, client, overwrite=overwrite, on_end=on_end)
    failed = [outcome for outcome in outcomes if outcome.failure is not None]
    if display == "json":
        print_json("done", {"summary": str(out_dir / SUMMARY), "done": len(jobs) - len(failed), "failed": len(failed)})
    elif display != "quiet":
        done = [outcome.record for outcome in outcomes if outcome.failure is None]
        text = f"{format_count(len(done), 'model')} in {out_dir}"
        if done:
            mean, seconds = np.mean([one["mean_psnr"] for one in done]), sum(one["seconds"] for one in done)
            text += f", mean PSNR {mean:.2f} dB, {seconds:,.0f} s of fitting"
        out.print(f"{text}; {len(failed)} failed" if failed else text, soft_wrap=True)
    print_failures(failed)
    if failed:
        raise typer.Exit(1)


def _prepare_outputs(jobs: list[FitJob], overwrite: bool) -> None:
    """Refuse existing models and checkpoints of another request, or remove them with `overwrite`.

    The request of each clip is written, so that the same command, given again, may replace what it found here.
    """
    waiting = jobs if overwrite else [job for job in jobs if read_record(job) is None]
    for job in [] if overwrite else waiting:
        before = read_request(job)
        if before == job.request:
            continue
        for path in (job.target, job.checkpoint):
            mine = before is None and job.checkpoint.exists()
            if os.path.exists(path) and not mine:
                cure = "Remove it, choose another folder, or add --overwrite, which starts over."
                raise ParameterError("--out", f"{path} exists, with other settings or of another clip. {cure}")
    for job in waiting:
        if overwrite:
            job.checkpoint.unlink(missing_ok=True)
        if overwrite or read_request(job) != job.request:
            write_request(job)


def _write_summary(out_dir: Path, jobs: list[FitJob], ended: dict[str, Outcome]) -> None:
    """Write the results of the clips that ended so far, as JSON."""
    rows = [_row(ended[job.target]) for job in jobs if job.target in ended]
    failed = sum("failure" in row for row in rows)
    write_json(out_dir / SUMMARY, {"clips": len(jobs), "done": len(rows) - failed, "failed": failed, "each": rows})


def _row(outcome: Outcome) -> dict[str, Any]:
    named = {"clip": outcome.job.name}
    if outcome.failure is not None:
        return named | {"failure": outcome.failure}
    return named | {"model": Path(outcome.job.target).name} | {name: outcome.record[name] for name in _FIGURES}
