"""The command `tradeoff`."""

import dataclasses
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.status import Status

from foldgauss import __version__
from foldgauss._runtime.checks import check_within
from foldgauss.cli.app.application import Stopped, command, err, out, warn
from foldgauss.cli.measuring.tradeoff_record import (
    BASE,
    FILES,
    RECORD,
    Record,
    changed_settings,
    format_command,
    report,
    suffix_of,
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
from foldgauss.cli.shared.log_lines import show_status
from foldgauss.cli.shared.outputs import make_folder, name_after, refuse_foreign
from foldgauss.io._atomic import OutputError
from foldgauss.io._lock import lock_output
from foldgauss.io.media.clip import DEINTERLACE, Clip, check_reading
from foldgauss.io.media.reading import read_video
from foldgauss.io.models.compact import save_compact
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.io.provenance import fingerprint
from foldgauss.jobs.runner import describe_fit, fit_metadata, mean_scores
from foldgauss.video.fitting.config import TYPICAL_LIFETIME, FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.divergence import FitDiverged
from foldgauss.video.fitting.initialize import measure_lifetime
from foldgauss.video.fitting.loop import finish, fit_steps
from foldgauss.video.models.metrics import Evaluation, evaluate
from foldgauss.video.models.video_model import VideoModel
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

    Writes a table (tradeoff.csv, tradeoff.json) and a plot (tradeoff.png); prints the knee of each Pareto front and the
    command that reproduces each point on it. The same command continues a stopped run. See docs/results.md.
    """
    chosen = tuple(AXES) if axes is None else check_axes([name.strip() for name in axes.split(",")])
    wanted = FitConfig(seed=seed)
    check_within("--minutes", minutes, "(0, inf)", "a number above 0")
    out_dir = name_after(video, "-tradeoff") if out_dir is None else out_dir
    known = overwrite or os.path.exists(out_dir / RECORD)
    refuse_foreign(out_dir, FILES, "tradeoff", record=RECORD, known=known, cure=", or start over with --overwrite")
    reading = check_reading(deinterlace, levels)
    clip = read_video(video, frames=parse_frames(frames), size=parse_size(size), **reading._asdict())
    for text in clip.notes:
        warn(f"{clip.source}: {text}")
    make_folder(out_dir)
    own = tuple(out_dir / name for name in sorted(FILES - {RECORD}))
    context.with_resource(lock_output(out_dir / RECORD, own=own, what="tradeoff"))
    settings = {"axes": list(chosen), "minutes": None if steps else minutes, "steps": steps, "seed": seed}
    settings |= {"version": __version__} | fingerprint(clip)
    record = Record(out_dir / RECORD, settings, restart=overwrite)
    run = _Run(clip, record, fit_metadata(clip, seed, parse_frames(frames)))
    base = run.plan_base(wanted, chosen, minutes, steps)
    points, skipped = plan_points(base, chosen, clip.num_frames, has_alpha=clip.has_alpha)
    for one in skipped:
        err.print(f"note: {one.name} is left out: {one.why}.", soft_wrap=True)
    try:
        skipped += run.measure(points, base, partial(format_command, video, size, frames, reading, out_dir))
        report(record, [point for point in points if point.name in record.rows], skipped)
    except KeyboardInterrupt:
        kept = f"{len(record.rows)} of {len(points)} points are kept in {record.path}"
        raise Stopped(f"stopped; {kept}. Run the same command again to continue.") from None
    except OSError as error:
        kept = f"The points before it are kept in {record.path}: the same command continues."
        raise OutputError(f"{error} {kept}") from error


class _Run:
    """Measures the points of one clip, one after another."""

    def __init__(self, clip: Clip, record: Record, about: dict[str, Any]):
        self.clip, self.record, self.about = clip, record, about
        self._base: VideoModel | None = None
        self._motion: Motion | None = None  # of the clip, estimated once for all fits
        self._warm = False  # whether the programs for this size are compiled

    def plan_base(self, wanted: FitConfig, axes: tuple[str, ...], minutes: float, steps: int | None) -> FitConfig:
        """Choose the number of steps that the minutes allow; measures the throughput unless it is recorded."""
        if not self.record.plan:
            full, lifetime = planned_steps(wanted, self.clip.num_frames), TYPICAL_LIFETIME
            with show_status("Measuring the throughput"):
                if wanted.num_gaussians is None and wanted.follows_motion:
                    frames = np.ascontiguousarray(self.clip.frames[..., :3])
                    lifetime = measure_lifetime(frames, self._find_motion(), wanted.fold_degree)
                num = chosen_num_gaussians(wanted, self.clip.num_frames, *self.clip.size, lifetime=lifetime)
                base = dataclasses.replace(wanted, num_gaussians=num, steps=full)
                throughput = self._measure_throughput(dataclasses.replace(base, steps=PILOT_STEPS))
            points, _ = plan_points(base, axes, self.clip.num_frames, has_alpha=self.clip.has_alpha)
            allowed = estimate_steps(60 * minutes / MARGIN, points, throughput)
            least = max(LEAST_STEPS, self.clip.num_frames)  # so that the base sees every frame
            chosen = min(max(allowed, least), full) if steps is None else steps
            expected = MARGIN * estimate_seconds(points, chosen, throughput) / 60
            self.record.plan |= {"num_gaussians": num, "steps": chosen, "pace": throughput._asdict()}
            self.record.plan |= {"expected_minutes": round(expected, 2)}
            out.print(
                f"{self.clip.source}: {self.clip.num_frames} frames of {self.clip.size[0]}x{self.clip.size[1]}; "
                f"{len(points)} points around a base of {chosen:,} steps, about {expected:.1f} minutes",
                soft_wrap=True,
            )
            if steps is None and expected > 1.02 * minutes:
                warn(
                    f"--minutes: {minutes:g} are too few for {len(points)} points around a base of {chosen:,} steps, "
                    f"the fewest allowed: this takes about {expected:.1f}. Choose fewer --axes or --frames, or a "
                    "smaller --size."
                )
        self.record.save()
        return dataclasses.replace(
            wanted, num_gaussians=self.record.plan["num_gaussians"], steps=self.record.plan["steps"]
        )

    def _measure_throughput(self, config: FitConfig) -> Throughput:
        steps = list(fit_steps(self.clip.frames, config, motion=self._find_motion()))
        self._warm = True
        (state, last), (_, first) = steps[-1], steps[0]
        model, _ = finish(state, self.clip.frames, config, self.clip.fps)
        begun = time.perf_counter()
        evaluate(model, self.clip.frames)
        measure_frame_rate(model)
        evaluation = time.perf_counter() - begun
        step = (last.seconds - first.seconds) / max(last.step - first.step, 1)
        return Throughput(max(first.seconds - step, 0.0), step, evaluation)

    def _find_motion(self) -> Motion:
        """Estimate the motion once. Its duration is recorded, since `fit` spends it on every model."""
        if self._motion is None:
            begun = time.perf_counter()
            self._motion = Motion.from_frames(np.ascontiguousarray(self.clip.frames[..., :3]))
            self.record.plan.setdefault("motion_seconds", time.perf_counter() - begun)
        return self._motion

    def measure(self, points: list[Point], base: FitConfig, format_point: Callable[[Point], str]) -> list[Skipped]:
        """Measure and record the points without a row; returns those that failed.

        The base is measured again where its file is missing, since the others are compared with it.
        """
        failed = []
        if not self.record.path.with_name(BASE).exists():
            self.record.rows.pop("base", None)
        with err.status("Measuring") as status:
            for number, point in enumerate(points, 1):
                if point.name in self.record.rows:
                    continue
                try:
                    row = self._measure_point(point, base, status) | {"command": format_point(point)}
                except (ValueError, FitDiverged) as error:
                    if point.axis == "base":
                        raise
                    failed.append(Skipped(point.name, str(error)))
                    err.print(f"{number:>3} of {len(points)}  {point.name} is left out: {error}", soft_wrap=True)
                    continue
                self.record.rows[point.name] = row
                self.record.save()
                figures = f"{row['psnr']:.2f} dB, {row['seconds']:.1f} s, {row['bytes']:,} bytes"
                err.print(f"{number:>3} of {len(points)}  {point.name}: {figures}", soft_wrap=True)
        return failed

    def _measure_point(self, point: Point, base: FitConfig, status: Status) -> dict[str, Any]:
        if point.played is None:
            shown, scores, seconds, num_bytes = self._fit_model(point, status)
        else:
            shown = dataclasses.replace(self._load_base(), options=point.played)
            scores, row = evaluate(shown, self.clip.frames), self.record.rows["base"]
            seconds, num_bytes = row["seconds"], row["bytes"]
        if point.axis == "base":
            rate = measure_frame_rate(shown)
        else:  # relative to the base, measured at the same time, under the same load
            own, others = measure_frame_seconds(shown, self._load_base())
            rate = self.record.rows["base"]["frames_per_second"] * others / own
        return {
            "axis": point.axis,
            "value": point.value,
            "settings": changed_settings(point, base),
            "psnr": round(scores.mean_psnr, 4),
            "ssim": round(scores.mean_ssim, 5),
            "seconds": round(seconds, 3),
            "bytes": num_bytes,
            "floats": shown.num_parameters,
            "gaussians": shown.num_gaussians,
            "frames_per_second": round(rate, 2),
        }

    def _load_base(self) -> VideoModel:
        if self._base is None:
            self._base = load_video_model(self.record.path.with_name(BASE))
        return self._base

    def _fit_model(self, point: Point, status: Status) -> tuple[VideoModel, Evaluation, float, int]:
        """The model, its scores, seconds to fit, and the bytes of its file; only the file of the base is kept."""
        config, motion = point.config, self._find_motion()  # outside the measured time
        if not self._warm:  # of a run that is continued
            list(fit_steps(self.clip.frames, dataclasses.replace(config, steps=2), motion=motion))
        self._warm = True
        for state, info in fit_steps(self.clip.frames, config, motion=motion):
            status.update(f"{point.name}: step {info.step} of {config.steps}, {info.psnr:.2f} dB")
        ended = time.perf_counter()
        model, quantized = finish(state, self.clip.frames, config, self.clip.fps)
        seconds = info.seconds + time.perf_counter() - ended
        if config.follows_motion:  # which `fit` includes in its time
            seconds += self.record.plan["motion_seconds"]
        status.update(f"{point.name}: evaluating")
        scores = evaluate(model, self.clip.frames)
        about = self.about | describe_fit(config, state) | mean_scores(scores)
        path = self.record.path.with_name(BASE if point.axis == "base" else f".measured{suffix_of(config)}")
        try:
            if quantized is None:
                save_video_model(path, model, metadata=about)
            else:
                save_compact(path, quantized, metadata=about)
            return model, scores, seconds, path.stat().st_size
        finally:
            if point.axis != "base":
                path.unlink(missing_ok=True)
