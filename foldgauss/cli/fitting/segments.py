"""`fit` of a clip in segments, run by workers or by this process."""

import dataclasses
import itertools
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from foldgauss.cli.app.application import Stopped, err, out, warn
from foldgauss.cli.fitting.job_progress import (
    describe_continuation,
    report_fit,
    run_jobs,
    summarize_fit,
)
from foldgauss.cli.fitting.options import WorkerOptions
from foldgauss.cli.shared.console import Display, format_count, progress_bar, show_status
from foldgauss.cli.shared.fit_progress import print_json
from foldgauss.io._atomic import write_or_keep
from foldgauss.io.media.reading import describe_crop
from foldgauss.jobs import FitJob, LongFit, Outcome, plan_long_fit
from foldgauss.jobs.job import read_record
from foldgauss.video import Evaluation
from foldgauss.video.fitting.config import SHORTEST_LIFETIME, FitConfig, chosen_num_gaussians, planned_steps


def fit_in_segments(
    job: FitJob,
    display: Display,
    options: WorkerOptions,
    *,
    segment_seconds: float,
    overwrite: bool,
) -> None:
    """Plan the segments of the job's clip, fit them, join them and print the results; continues an unfinished fit."""
    begun, target = time.monotonic(), Path(job.target)
    with options.open_client() as client:  # first: workers start while the clip is indexed
        with nullcontext() if display in ("json", "quiet") else show_status("Indexing the clip"):
            fit = plan_long_fit(
                job.clip,
                target,
                job.config,
                size=job.size,
                frames=job.frames,
                segment_seconds=segment_seconds,
                checkpoint_seconds=job.checkpoint_seconds,
                masks=job.masks,
                shadows=job.shadows,
                restart=overwrite,
            )
        _print_plan(fit, job.config, display, Path(job.clip), options)
        outcomes = run_jobs(fit.jobs, "segments", display, client, overwrite=overwrite)
    for outcome in outcomes:
        for text in (outcome.record or {}).get("warnings", ()):
            warn(f"{outcome.job.name}: {text}")
    failed = [outcome for outcome in outcomes if outcome.failure is not None]
    print_failures(failed)
    if failed:
        others = f"; the others are kept in {fit.folder}" if len(failed) < len(outcomes) else ""
        raise Stopped(f"{len(failed)} of {len(outcomes)} segments failed{others}. {describe_continuation(overwrite)}")

    def join(path: Path) -> Evaluation:
        records = {outcome.job.name: outcome.record for outcome in outcomes}
        shared = sum(max(0, before[1] - after[0]) for before, after in itertools.pairwise(fit.spans))
        with progress_bar("Joining", max(shared, 1), shown=display == "bar" and shared > 0) as advance:
            return dataclasses.replace(fit, target=path).join(records, on_frame=advance)

    joined = write_or_keep(target, join)
    fit.clean_up()
    figures = _summarize(joined, outcomes, job.config)
    figures |= {"wall_seconds": round(time.monotonic() - begun, 2), "file_bytes": target.stat().st_size}
    report_fit(display, str(target), figures)


def print_failures(failed: list[Outcome]) -> None:
    for outcome in failed:
        err.print(f"failed: {outcome.job.name}: {outcome.failure}", style="red", soft_wrap=True)


def plan_gaussians(config: FitConfig, num_frames: int, *size: int, threads: int | None = None) -> int:
    """The number of Gaussians at the start; the most, where the motion of the clip decides."""
    lifetime = min(num_frames, SHORTEST_LIFETIME)
    return chosen_num_gaussians(config, num_frames, *size, threads=threads, lifetime=lifetime)


def describe_plan(config: FitConfig, num: int, num_frames: int) -> str:
    """The Gaussians, budgets and goals of a fit, as "40,000 Gaussians of degree 1, 3,000 steps, quality 50"."""
    budgets = {"{:,} steps": planned_steps(config, num_frames), "{:g} minutes": config.minutes}
    goals = {"quality {:g}": config.quality, "{:g} MB at most": config.size_mb, "{:g} dB": config.psnr}
    texts = ([text.format(value) for text, value in of.items() if value is not None] for of in (budgets, goals))
    at_most = "up to " if config.num_gaussians is None else ""
    at_start = "" if config.strategy.growth is None else " at the start"
    gaussians = f"{at_most}{num:,} Gaussians of degree {config.fold_degree}{at_start}"
    return ", ".join(filter(None, [gaussians, *map(" or ".join, texts)]))


def print_plan(display: Display, source: str, num_frames: int, size: tuple[int, int], plan: str, **about: Any) -> None:
    """Print the clip and what is planned for it, or `about` it as JSON."""
    height, width = size
    if display == "json":
        print_json("start", {"clip": source, "num_frames": num_frames, "height": height, "width": width} | about)
    elif display != "quiet":
        out.print(f"{source}: {format_count(num_frames, 'frame')} of {height}x{width}{plan}", soft_wrap=True)


def _summarize(joined: Evaluation, outcomes: list[Outcome], config: FitConfig) -> dict[str, Any]:
    records = [outcome.record for outcome in outcomes]
    figures = summarize_fit(joined, records, config) | {"num_segments": len(records)}
    peaks = [record["peak_bytes"] for record in records]
    if None not in peaks:
        figures["peak_mib"] = round(max(peaks) / 2**20)
    return figures


def _print_plan(fit: LongFit, config: FitConfig, display: Display, video: Path, options: WorkerOptions) -> None:
    index = fit.index
    lengths = [stop - first for first, stop in fit.spans]
    size = index.size if fit.jobs[0].size is None else fit.jobs[0].size
    for note in (*index.notes, *describe_crop([index.size], size)):
        warn(f"{video}: {note}")
    longest = fit.jobs[lengths.index(max(lengths))].config  # with its part of the file's size
    num = plan_gaussians(longest, max(lengths), *size, threads=options.threads)
    done = sum(read_record(job) is not None for job in fit.jobs)
    begun = sum(job.checkpoint.exists() for job in fit.jobs)
    if (done or begun) and display in ("bar", "lines"):
        err.print(f"continuing: {done} of {len(fit.jobs)} segments done, {begun} begun", soft_wrap=True)
    at_cuts = sum(before[1] == after[0] for before, after in itertools.pairwise(fit.spans))
    span = f"{min(lengths)} to {max(lengths)}" if min(lengths) < max(lengths) else f"{lengths[0]}"
    where = f" ({at_cuts} end at cuts)" if at_cuts else ""
    plan = (
        f" in {format_count(len(lengths), 'segment')} of {span} frame{'' if span == '1' else 's'}{where}, each with "
        f"{describe_plan(config, num, max(lengths))}, by {options}"
    )
    spans = [list(span) for span in fit.spans]
    print_plan(display, str(video), index.num_frames, size, plan, spans=spans, most_gaussians=num)
