"""The command `tradeoff`."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss import __version__
from foldgauss._runtime.checks import check_within, require
from foldgauss.cli.app.application import command, err, out, warn
from foldgauss.cli.fitting.job_progress import run_jobs
from foldgauss.cli.measuring.tradeoff_record import (
    FILES,
    MODELS,
    PLOT,
    RECORD,
    Record,
    changed_settings,
    file_name,
    format_command,
    report,
)
from foldgauss.cli.shared.arguments import (
    Deinterlace,
    Frames,
    Levels,
    NewClip,
    Size,
    parse_frames,
    parse_size,
)
from foldgauss.cli.shared.outputs import make_folder, name_after, refuse_foreign
from foldgauss.cli.shared.progress import choose_display, show_status
from foldgauss.io._lock import lock_output
from foldgauss.io.media.clip import DEINTERLACE, Clip, check_reading
from foldgauss.io.media.reading import read_video
from foldgauss.io.models.video_model import load_video_model
from foldgauss.io.provenance import fingerprint
from foldgauss.jobs import FitJob, Outcome
from foldgauss.video.fitting.config import TYPICAL_LIFETIME, FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.initialize import measure_lifetime
from foldgauss.video.fitting.loop import finish, fit_steps
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.motion.optical_flow import Motion
from foldgauss.video.tradeoff import (
    AXES,
    LEAST_STEPS,
    Point,
    Skipped,
    Throughput,
    check_axes,
    estimate_seconds,
    estimate_steps,
    measure_frame_rate,
    measure_frame_seconds,
    plan_points,
)

DEFAULT_MINUTES = 10.0
#: Steps that measure the throughput.
PILOT_STEPS = 40
#: Factor of the estimated time, for variations of the throughput.
MARGIN = 1.1


@command("tradeoff")
def tradeoff_command(
    context: typer.Context,
    video: NewClip,
    out_dir: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for the results [default: VIDEO-tradeoff in this folder]."),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="AXIS,AXIS,..",
            help=f"Axes to measure, of {', '.join(AXES)} [default: all].",
        ),
    ] = None,
    minutes: Annotated[
        float, typer.Option(help="Time for all fits, whose number of steps is chosen accordingly.")
    ] = DEFAULT_MINUTES,
    steps: Annotated[
        int | None, typer.Option(help="Optimizer steps of the base fit, instead of --minutes.", min=1)
    ] = None,
    size: Size = None,
    frames: Frames = None,
    levels: Levels = None,
    deinterlace: Deinterlace = DEINTERLACE[0],
    seed: Annotated[int, typer.Option(help="Seed of all fits.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Discard earlier results.")] = False,
) -> None:
    """Measure time, size and speed against quality, one setting at a time.

    Writes the results (tradeoff.json) and a plot (tradeoff.png); prints the knee of each Pareto front and the
    command that reproduces each point on it. The same command continues a stopped run. See docs/results.md.
    """
    chosen = tuple(AXES) if axes is None else check_axes([name.strip() for name in axes.split(",")])
    wanted = FitConfig(seed=seed)
    check_within("--minutes", minutes, "(0, inf)", "a number above 0")
    out_dir = name_after(video, "-tradeoff") if out_dir is None else out_dir
    known = overwrite or (out_dir / RECORD).exists()
    refuse_foreign(out_dir, FILES, "tradeoff", record=RECORD, known=known, cure=", or start over with --overwrite")
    reading = check_reading(deinterlace, levels)
    clip = read_video(video, frames=parse_frames(frames), size=parse_size(size), **reading._asdict())
    for text in clip.notes:
        warn(f"{clip.source}: {text}")
    make_folder(out_dir)
    context.with_resource(lock_output(out_dir / RECORD, own=(out_dir / PLOT,), what="tradeoff"))
    make_folder(out_dir / MODELS)
    settings = {"axes": list(chosen), "minutes": None if steps else minutes, "steps": steps, "seed": seed}
    source = fingerprint(clip)
    record = Record(out_dir / RECORD, settings | {"version": __version__} | source, restart=overwrite)
    base = _plan_base(clip, record, wanted, chosen, minutes, steps)
    points, skipped = plan_points(base, chosen, clip.num_frames, has_alpha=clip.has_alpha)
    for one in skipped:
        err.print(f"note: {one.name} is left out: {one.why}.", soft_wrap=True)
    fits = {point.name: point for point in points if point.played is None}
    jobs = [
        FitJob(
            name,
            str(video.absolute()),
            str(out_dir / MODELS / file_name(point)),
            point.config,
            parse_size(size),
            parse_frames(frames),
            reading=reading,
            source=source,
        )
        for name, point in fits.items()
    ]
    if overwrite:
        for job in jobs:
            for path in (Path(job.target), job.record, job.checkpoint):
                path.unlink(missing_ok=True)
    outcomes = run_jobs(jobs, "points", choose_display(), None, cure="Run the same command again to continue.")
    for outcome in outcomes:
        if outcome.failure is not None:
            require(outcome.job.name != "base", "base", expected="a fit of the base", got=outcome.failure)
            skipped.append(Skipped(outcome.job.name, outcome.failure))
            err.print(f"{outcome.job.name} is left out: {outcome.failure}", soft_wrap=True)
    with show_status("Measuring"):
        _measure(points, base, {outcome.job.name: outcome for outcome in outcomes}, clip, record)
    for point in points:
        if point.name in record.rows:
            record.rows[point.name]["command"] = format_command(video, size, frames, reading, out_dir, point)
    report(record, [point for point in points if point.name in record.rows], skipped)


def _plan_base(
    clip: Clip, record: Record, wanted: FitConfig, axes: tuple[str, ...], minutes: float, steps: int | None
) -> FitConfig:
    """Choose the number of steps that the minutes allow; measures the throughput unless it is recorded."""
    if not record.plan:
        full, lifetime = planned_steps(wanted, clip.num_frames), TYPICAL_LIFETIME
        with show_status("Measuring the throughput"):
            if wanted.num_gaussians is None and wanted.follows_motion:
                images = np.ascontiguousarray(clip.frames[..., :3])
                lifetime = measure_lifetime(images, Motion.from_frames(images), wanted.fold_degree)
            num = chosen_num_gaussians(wanted, clip.num_frames, *clip.size, lifetime=lifetime)
            base = dataclasses.replace(wanted, num_gaussians=num, steps=full)
            throughput = _measure_throughput(clip, dataclasses.replace(base, steps=PILOT_STEPS))
        points, _ = plan_points(base, axes, clip.num_frames, has_alpha=clip.has_alpha)
        allowed = estimate_steps(60 * minutes / MARGIN, points, throughput)
        least = max(LEAST_STEPS, clip.num_frames)  # so that the base sees every frame
        chosen = min(max(allowed, least), full) if steps is None else steps
        expected = MARGIN * estimate_seconds(points, chosen, throughput) / 60
        record.plan |= {"num_gaussians": num, "steps": chosen, "pace": throughput._asdict()}
        record.plan |= {"expected_minutes": round(expected, 2)}
        out.print(
            f"{clip.source}: {clip.num_frames} frames of {clip.size[0]}x{clip.size[1]}; "
            f"{len(points)} points around a base of {chosen:,} steps, about {expected:.1f} minutes",
            soft_wrap=True,
        )
        if steps is None and expected > 1.02 * minutes:
            warn(
                f"--minutes: {minutes:g} are too few for {len(points)} points around a base of {chosen:,} steps, "
                f"the fewest allowed: this takes about {expected:.1f}. Choose fewer --axes or --frames, or a "
                "smaller --size."
            )
    record.save()
    return dataclasses.replace(wanted, num_gaussians=record.plan["num_gaussians"], steps=record.plan["steps"])


def _measure_throughput(clip: Clip, config: FitConfig) -> Throughput:
    steps = list(fit_steps(clip.frames, config))
    (state, last), (_, first) = steps[-1], steps[0]
    model, _ = finish(state, clip.frames, config, clip.fps)
    begun = time.perf_counter()
    evaluate(model, clip.frames)
    measure_frame_rate(model)
    evaluation = time.perf_counter() - begun
    step = (last.seconds - first.seconds) / max(last.step - first.step, 1)
    return Throughput(max(first.seconds - step, 0.0), step, evaluation)


def _measure(points: list[Point], base: FitConfig, outcomes: dict[str, Outcome], clip: Clip, record: Record) -> None:
    """Fill the rows of the record: of each fit its results, and of each point the speed of rendering."""
    reference = load_video_model(outcomes["base"].job.target)
    rate = measure_frame_rate(reference)
    for point in points:
        fit = outcomes["base" if point.played else point.name]
        if fit.failure is not None:
            continue
        result, shown = fit.record, load_video_model(fit.job.target)
        quality = {"psnr": result["mean_psnr"], "ssim": result["mean_ssim"]}
        if point.played is not None:
            shown = shown.with_options(point.played)
            scores = evaluate(shown, clip.frames)
            quality = {"psnr": round(scores.mean_psnr, 3), "ssim": round(scores.mean_ssim, 4)}
        # Relative to the base, measured at the same time, under the same load.
        own, others = measure_frame_seconds(shown, reference)
        record.rows[point.name] = {
            "axis": point.axis,
            "value": point.value,
            "settings": changed_settings(point, base),
            **quality,
            "seconds": result["seconds"],
            "bytes": result["file_bytes"],
            "floats": shown.num_parameters,
            "gaussians": shown.num_gaussians,
            "frames_per_second": round(rate * others / own, 2),
        }
