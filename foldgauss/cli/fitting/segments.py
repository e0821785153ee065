"""`fit` of a long clip: in segments, by workers if asked."""

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from foldgauss.cli.app.application import Stopped, WrongUse, as_option, err, out
from foldgauss.cli.app.shared import print_figures, progress_bar
from foldgauss.cli.fitting.jobs_view import LINE, WorkerOptions, run_jobs, tell_json
from foldgauss.cli.fitting.progress import Manner
from foldgauss.jobs import LongFit, Outcome, plan_long_fit, segments_folder
from foldgauss.jobs.fitting import finished
from foldgauss.jobs.long import SEGMENT_SECONDS, kept_seconds
from foldgauss.video.fitting.config import FitConfig, chosen_num_gaussians, planned_steps


def fit_in_segments(
    video: Path,
    target: Path,
    config: FitConfig,
    manner: Manner,
    *,
    size: tuple[int, int] | None,
    frames: tuple[int | None, int | None] | None,
    segment_seconds: float | None,
    hands: WorkerOptions,
    checkpoint_seconds: float | None,
    resume: bool,
    overwrite: bool,
) -> None:
    """Plan, fit, join, tell. What is done is taken up where the same is asked again."""
    begun, folder = time.monotonic(), segments_folder(target)
    if resume and not folder.is_dir():
        raise WrongUse(f"--resume: expected a stopped fit in {folder}, got none. Start it without --resume.")
    anew = overwrite and not resume
    if segment_seconds is None:
        segment_seconds = None if anew else kept_seconds(target)
    asked = {"size": size, "frames": frames, "checkpoint_seconds": checkpoint_seconds, "anew": anew}
    asked["segment_seconds"] = SEGMENT_SECONDS if segment_seconds is None else segment_seconds
    with hands.crew() as crew:  # first: they get ready while the clip is looked through
        fit = _planned(video, target, config, manner, asked)
        _say_plan(fit, config, manner, video, str(hands))
        again = f"Give the same command again{' with --resume added' if anew else ''} to go on."
        outcomes = run_jobs(fit.jobs, "segments", manner, crew, cure=again)
    _say_warnings(outcomes)
    failed = [outcome for outcome in outcomes if outcome.failure is not None]
    if failed:
        for outcome in failed:
            err.print(f"failed: {outcome.job.name}: {outcome.failure}", style="red", soft_wrap=True)
        others = f"; the others are kept in {fit.folder}" if len(failed) < len(outcomes) else ""
        raise Stopped(f"{len(failed)} of {len(outcomes)} segments failed{others}. {again}")
    records = {outcome.job.name: outcome.record for outcome in outcomes}
    shared = sum(max(0, before[1] - after[0]) for before, after in zip(fit.spans[:-1], fit.spans[1:], strict=True))
    with progress_bar("Joining", max(shared, 1), shown=manner == "bar" and shared > 0) as advance:
        joined = fit.join(records, on_frame=advance)
    fit.tidy()
    height, width = outcomes[0].record["size"]
    figures = {
        "mean_psnr": round(joined.mean_psnr, 3),
        "mean_ssim": round(joined.mean_ssim, 4),
        "lowest_psnr": round(min(joined.psnr), 3),
        "num_segments": len(outcomes),
        "num_frames": fit.index.num_frames,
        "height": height,
        "width": width,
        "num_gaussians": sum(outcome.record["num_gaussians"] for outcome in outcomes),
        "degree": config.degree,
        "fit_seconds": round(sum(outcome.record["seconds"] for outcome in outcomes), 2),
        "wall_seconds": round(time.monotonic() - begun, 2),
        "file_bytes": target.stat().st_size,
    }
    peaks = [outcome.record["peak_bytes"] for outcome in outcomes]
    if None not in peaks:
        figures["peak_mib"] = round(max(peaks) / 2**20)
    if joined.seam_drop is not None:
        figures["seam_drop"] = round(joined.seam_drop, 3)
    if manner == "json":
        tell_json("done", {"model": str(target)} | figures)
    elif manner != "quiet":
        print_figures(str(target), figures)


def _planned(video: Path, target: Path, config: FitConfig, manner: Manner, asked: dict[str, Any]) -> LongFit:
    """The plan, for which the whole clip is looked through once: that is shown."""
    status = err.status("Looking through the clip") if manner == "bar" else None
    count, due = 0, time.monotonic() + LINE

    def on_frame() -> None:
        nonlocal count, due
        count += 1
        if status is not None and count % 25 == 0:
            status.update(f"Looking through the clip: {count:,} frames")
        elif manner == "lines" and time.monotonic() > due:
            due = time.monotonic() + LINE
            err.print(f"looking through the clip: {count:,} frames")

    try:
        with nullcontext() if status is None else status:
            return plan_long_fit(video, target, config, on_frame=on_frame, **asked)
    except ValueError as error:
        if str(error).startswith(("segment_seconds:", "resume:", "target:")):
            text = as_option(str(error)).replace("--target:", "--out:", 1).replace("num_gaussians=", "gaussians=")
            raise WrongUse(text) from error
        raise


def _say_plan(fit: LongFit, config: FitConfig, manner: Manner, video: Path, crew: str) -> None:
    index = fit.index
    if index.num_declared > index.num_frames:
        told = f"only {index.num_frames} of {index.num_declared} frames of {video} decode; those are used."
        err.print(f"warning: {told}", soft_wrap=True)
    for note in index.notes:
        err.print(f"warning: {video}: {note}", soft_wrap=True)
    lengths = [stop - first for first, stop in fit.spans]
    pairs = zip(fit.spans[:-1], fit.spans[1:], strict=True)
    at_cuts = sum(before[1] == after[0] for before, after in pairs)
    size = index.size if fit.jobs[0].size is None else fit.jobs[0].size
    longest = fit.jobs[lengths.index(max(lengths))].config  # it has its share of a file's size
    num = chosen_num_gaussians(longest, max(lengths), *size)
    steps = planned_steps(config, max(lengths))
    if manner == "json":
        about = {"clip": str(video), "num_frames": index.num_frames, "height": size[0], "width": size[1]}
        tell_json("start", about | {"spans": [list(span) for span in fit.spans], "num_gaussians": num})
    if manner in ("json", "quiet"):
        return
    done = sum(finished(job) is not None for job in fit.jobs)
    begun = sum(job.kept.exists() for job in fit.jobs)
    if done or begun:
        err.print(f"taken up: {done} of {len(fit.jobs)} segments done, {begun} begun", soft_wrap=True)
    budgets = {"{:,} steps": steps, "{:g} minutes": config.minutes, "{:g} dB": config.target_psnr}
    plan = " or ".join(text.format(value) for text, value in budgets.items() if value is not None)
    span = f"{min(lengths)} to {max(lengths)}" if min(lengths) < max(lengths) else f"{lengths[0]}"
    where = f" ({at_cuts} end at cuts)" if at_cuts else ""
    segments = "1 segment" if len(lengths) == 1 else f"{len(lengths)} segments"
    frames = "1 frame" if index.num_frames == 1 else f"{index.num_frames:,} frames"
    out.print(
        f"{video}: {frames} of {size[0]}x{size[1]} in {segments} of {span} frame{'' if span == '1' else 's'}{where}, "
        f"each with {num:,} Gaussians of degree {config.degree} and {plan}, by {crew}",
        soft_wrap=True,
    )


def _say_warnings(outcomes: list[Outcome]) -> None:
    for outcome in outcomes:
        for text in (outcome.record or {}).get("warnings", ()):
            err.print(f"warning: {outcome.job.name}: {text}", soft_wrap=True)
