"""The command `tradeoff`."""

import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from foldgauss import __version__
from foldgauss._runtime.checks import check_one_of, is_within
from foldgauss._runtime.machine import load_average
from foldgauss.cli.app.application import Stopped, WrongUse, app, err, name_option, out, warn, wrong_use
from foldgauss.cli.app.completion import complete_choice, complete_list
from foldgauss.cli.measuring.tradeoff_record import (
    BASE,
    CLOCKS,
    FILES,
    RECORD,
    Commands,
    Record,
    changed_settings,
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
    parse_reading,
    parse_size,
)
from foldgauss.cli.shared.log_lines import show_status
from foldgauss.cli.shared.outputs import make_folder, name_after, refuse_foreign
from foldgauss.cli.shared.rendering import TIME_LEFT
from foldgauss.io._atomic import OutputError
from foldgauss.io._lock import lock_output
from foldgauss.io.media.clip import DEINTERLACE, Clip
from foldgauss.io.media.reading import read_video
from foldgauss.io.models.compact import save_compact
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.io.provenance import fingerprint
from foldgauss.jobs.runner import describe_fit, fit_metadata, mean_scores
from foldgauss.video.fitting.config import TYPICAL_LIFETIME, FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.divergence import FitDiverged
from foldgauss.video.fitting.initialize import measure_lifetime
from foldgauss.video.fitting.loop import FitInfo, finish, fit_steps
from foldgauss.video.fitting.state import FitState
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
#: Steps that measure the throughput, and a margin for variations of it.
PILOT_STEPS, MARGIN = 40, 1.1

Report = Callable[[str], None]


@app.command(name="tradeoff")
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
            autocompletion=complete_list(AXES),
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
    clock: Annotated[
        str,
        typer.Option(
            help="Clock of the fitting time: wall; or cpu, the sum over all cores, for machines with other load.",
            autocompletion=complete_choice(CLOCKS),
        ),
    ] = "wall",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Discard earlier results.")] = False,
) -> None:
    """Measure time, size and speed against quality, one setting at a time.

    Writes a table (tradeoff.csv, tradeoff.json) and a plot (tradeoff.png); prints the knee of each Pareto front and the
    command that reproduces each point on it. The same command continues a stopped run. See docs/results.md.
    """
    try:
        check_one_of("clock", clock, tuple(CLOCKS))
        chosen = tuple(AXES) if axes is None else check_axes([name.strip() for name in axes.split(",")])
        wanted = FitConfig(seed=seed)
    except ValueError as error:
        raise WrongUse(name_option(str(error))) from error
    if not is_within(minutes, "(0, inf)"):
        raise wrong_use("--minutes", expected="a number above 0", got=minutes)
    out_dir = name_after(video, "-tradeoff") if out_dir is None else out_dir
    known = overwrite or os.path.exists(out_dir / RECORD)
    refuse_foreign(out_dir, FILES, "tradeoff", record=RECORD, known=known, cure=", or start over with --overwrite")
    settings = {"axes": list(chosen), "minutes": None if steps else minutes, "steps": steps, "seed": seed}
    reading = parse_reading(deinterlace, levels)
    clip = read_video(video, frames=parse_frames(frames), size=parse_size(size), **reading._asdict())
    for text in clip.notes:
        warn(f"{clip.source}: {text}")
    make_folder(out_dir)
    own = tuple(out_dir / name for name in sorted(FILES - {RECORD}))
    context.with_resource(lock_output(out_dir / RECORD, own=own, what="tradeoff"))
    record = Record(out_dir / RECORD, {"version": __version__} | settings | fingerprint(clip), restart=overwrite)
    commands = Commands(video, size, frames, out_dir, reading)
    run = _Run(clip, record, commands, fit_metadata(clip, seed, parse_frames(frames)))
    base = run.plan_base(wanted, chosen, minutes, steps)
    points, skipped = plan_points(base, chosen, clip.num_frames, has_alpha=clip.has_alpha)
    for one in skipped:
        err.print(f"note: {one.name} is left out: {one.why}.", soft_wrap=True)
    try:
        failed = run.measure(points, base)
        missing = {one.name for one in failed}
        report(record, [point for point in points if point.name not in missing], skipped + failed, clock)
    except KeyboardInterrupt:
        kept = f"{len(record.rows)} of {len(points)} points are kept in {record.path}"
        raise Stopped(f"stopped; {kept}. Run the same command again to continue.") from None
    except OSError as error:
        kept = f"The points before it are kept in {record.path}: the same command continues."
        raise OutputError(f"{error} {kept}") from error


class _Run:
    """Measures the points of one clip, one after another."""

    def __init__(self, clip: Clip, record: Record, commands: Commands, about: dict[str, Any]):
        self.clip, self.record, self.commands, self.about = clip, record, commands, about
        self.folder = commands.folder
        self._kept: VideoModel | None = None  # the model of the base
        self._motion: Motion | None = None  # of the clip, estimated once for all fits
        self._warm = False  # whether the programs for this size are compiled

    def plan_base(self, wanted: FitConfig, axes: tuple[str, ...], minutes: float, steps: int | None) -> FitConfig:
        """Choose the number of steps that the minutes allow; measures the throughput unless it is recorded."""
        full = planned_steps(wanted, self.clip.num_frames)
        if not self.record.plan:
            num = self._choose_number(wanted)
            with show_status("Measuring the throughput"):
                throughput = self._measure_throughput(dataclasses.replace(wanted, num_gaussians=num, steps=PILOT_STEPS))
            base = dataclasses.replace(wanted, num_gaussians=num, steps=full)
            points, _ = plan_points(base, axes, self.clip.num_frames, has_alpha=self.clip.has_alpha)
            allowed = estimate_steps(60 * minutes / MARGIN, points, throughput)
            least = max(LEAST_STEPS, self.clip.num_frames)  # so that the base sees every frame
            chosen = min(max(allowed, least), full) if steps is None else steps
            expected = MARGIN * estimate_seconds(points, chosen, throughput) / 60
            self.record.plan |= {"num_gaussians": num, "steps": chosen}
            self.record.plan |= {"expected_minutes": round(expected, 2), "pace": throughput._asdict()}
            self._print_plan(len(points), chosen, expected)
            if steps is None:
                self._warn_of_minutes(len(points), chosen, full, expected, minutes)
        self.record.save()
        num = self.record.plan.get("num_gaussians")
        if num is None:  # in records of versions that did not keep it
            num = chosen_num_gaussians(wanted, self.clip.num_frames, *self.clip.size)
        return dataclasses.replace(wanted, num_gaussians=num, steps=self.record.plan["steps"])

    def _choose_number(self, wanted: FitConfig) -> int:
        """The number of Gaussians that a fit with `wanted` begins with."""
        lifetime = TYPICAL_LIFETIME
        if wanted.num_gaussians is None and wanted.follow_motion:
            frames = np.ascontiguousarray(self.clip.frames[..., :3])
            lifetime = measure_lifetime(frames, self._find_motion(), wanted.fold_degree)
        return chosen_num_gaussians(wanted, self.clip.num_frames, *self.clip.size, lifetime=lifetime)

    def _print_plan(self, num_points: int, steps: int, expected: float) -> None:
        out.print(
            f"{self.clip.source}: {self.clip.num_frames} frames of {self.clip.size[0]}x{self.clip.size[1]}; "
            f"{num_points} points around a base of {steps:,} steps, about {expected:.1f} minutes",
            soft_wrap=True,
        )

    def _warn_of_minutes(self, num_points: int, steps: int, full: int, expected: float, minutes: float) -> None:
        if steps == full and expected < 0.9 * minutes:
            err.print(
                f"note: {full:,} steps are the default for this clip; not all of the minutes are needed.",
                soft_wrap=True,
            )
        if expected > 1.02 * minutes:
            err.print(
                f"warning: --minutes: {minutes:g} are too few for {num_points} points around a base of {steps:,} "
                f"steps, the fewest allowed: this takes about {expected:.1f}. Choose fewer --axes or --frames, or a "
                "smaller --size.",
                soft_wrap=True,
            )

    def _measure_throughput(self, config: FitConfig) -> Throughput:
        self._warm = True
        steps = list(self._fit(config, lambda info: None))
        state, last = steps[-1]
        first = steps[0][1]
        model, _ = finish(state, self.clip.frames, config, self.clip.fps)
        begun = time.perf_counter()
        evaluate(model, self.clip.frames)
        measure_frame_rate(model)
        evaluation = time.perf_counter() - begun
        step = (last.seconds - first.seconds) / max(last.step - first.step, 1)
        return Throughput(max(first.seconds - step, 0.0), step, evaluation)

    def _fit(self, config: FitConfig, show: Callable[[FitInfo], None]) -> Iterator[tuple[FitState, FitInfo]]:
        for state, info in fit_steps(self.clip.frames, config, motion=self._find_motion()):
            show(info)
            yield state, info

    def _find_motion(self) -> Motion:
        """Estimate the motion once. Its duration is recorded, since `fit` spends it on every model."""
        if self._motion is None:
            begun = _Spent.now()
            self._motion = Motion.from_frames(np.ascontiguousarray(self.clip.frames[..., :3]))
            self.record.plan.setdefault("motion", _Spent.since(begun)._asdict())
        return self._motion

    def measure(self, points: list[Point], base: FitConfig) -> list[Skipped]:
        """Measure and record the points without a row; returns those that failed."""
        failed, busy = [], False
        with _bar(len(points), sum(point.name in self.record.rows for point in points)) as (show, advance):
            for point in points:
                if point.name in self.record.rows:
                    continue
                show(point.name)
                try:
                    row = self._measure_point(point, base, lambda text, point=point: show(f"{point.name}: {text}"))
                except (ValueError, FitDiverged) as error:
                    if point.axis == "base":
                        raise
                    failed.append(Skipped(point.name, str(error)))
                    advance(f"{point.name} is left out: {error}")
                    continue
                self.record.rows[point.name] = row
                self.record.machine["load_average_last"] = load_average()
                busy |= (load_average() or 0) > 1.5 * self.record.machine["cores"]
                self.record.save()
                advance(f"{point.name}: {row['psnr']:.2f} dB, {row['seconds']:.1f} s, {row['bytes']:,} bytes")
        if busy:
            err.print(
                f"note: other programs used the {self.record.machine['cores']} cores, which slows down the fits. "
                "The same command with --clock cpu shows the Pareto front by CPU time.",
                soft_wrap=True,
            )
        return failed

    def _measure_point(self, point: Point, base: FitConfig, show: Report) -> dict[str, Any]:
        if point.played is None:
            shown, scores, spent, num_bytes = self._fit_model(point, show)
        else:
            shown = dataclasses.replace(self._load_base(base, show), options=point.played)
            scores, row = evaluate(shown, self.clip.frames), self.record.rows["base"]
            spent, num_bytes = _Spent(row["seconds"], row["cpu_seconds"]), row["bytes"]
        show("playing")
        if point.axis == "base":
            rate = measure_frame_rate(shown)
        else:  # relative to the base, measured at the same time, under the same load
            own, others = measure_frame_seconds(shown, self._load_base(base, show))
            rate = self.record.rows["base"]["frames_per_second"] * others / own
        return {
            "axis": point.axis,
            "value": point.value,
            "settings": changed_settings(point, base),
            "psnr": round(scores.mean_psnr, 4),
            "ssim": round(scores.mean_ssim, 5),
            "seconds": round(spent.wall, 3),
            "cpu_seconds": round(spent.cpu, 3),
            "bytes": num_bytes,
            "floats": shown.num_parameters,
            "gaussians": shown.num_gaussians,
            "frames_per_second": round(rate, 2),
            "command": self.commands.format_point(point),
        }

    def _load_base(self, base: FitConfig, show: Report) -> VideoModel:
        """Load the model of the base, which is fitted again if its file is missing."""
        path = self.folder / BASE
        if not path.exists():
            self._fit_model(Point("base", "", base), show)
        if self._kept is None:
            self._kept = load_video_model(path)
        return self._kept

    def _fit_model(self, point: Point, show: Report) -> tuple[VideoModel, Evaluation, "_Spent", int]:
        """The model, its scores, what it took, and the bytes of its file; only the file of the base is kept."""
        config = point.config
        if not self._warm:
            list(self._fit(dataclasses.replace(config, steps=2), lambda info: None))
            self._warm = True
        # Compile kernels on a corner of the clip: FitInfo.seconds excludes compilation, and CPU seconds must, too.
        tiny = dataclasses.replace(config, num_gaussians=8, steps=1, follow_motion=False)
        list(fit_steps(self.clip.frames[:2, :32, :32].copy(), tiny))
        self._find_motion()  # outside the measured time
        begun = time.process_time()
        for state, info in self._fit(
            config, lambda info: show(f"step {info.step} of {config.steps}, {info.psnr:.2f} dB")
        ):
            pass
        spent = _Spent(info.seconds, time.process_time() - begun)
        if config.follow_motion:  # which `fit` includes in its time
            spent = spent.plus(_Spent(**self.record.plan["motion"]))
        show("evaluating")
        ended = _Spent.now()
        model, quantized = finish(state, self.clip.frames, config, self.clip.fps)
        spent = spent.plus(_Spent.since(ended))
        scores = evaluate(model, self.clip.frames)
        about = self.about | describe_fit(config, state) | mean_scores(scores)
        path = self.folder / (BASE if point.axis == "base" else f".measured{suffix_of(config)}")
        try:
            if quantized is None:
                save_video_model(path, model, metadata=about)
            else:
                save_compact(path, quantized, metadata=about)
            return model, scores, spent, path.stat().st_size
        finally:
            if point.axis != "base":
                path.unlink(missing_ok=True)


class _Spent(NamedTuple):
    """Wall-clock seconds, and CPU seconds of all cores."""

    wall: float
    cpu: float

    @classmethod
    def now(cls) -> "_Spent":
        return cls(time.perf_counter(), time.process_time())

    @classmethod
    def since(cls, begun: "_Spent") -> "_Spent":
        now = cls.now()
        return cls(now.wall - begun.wall, now.cpu - begun.cpu)

    def plus(self, other: "_Spent") -> "_Spent":
        return _Spent(self.wall + other.wall, self.cpu + other.cpu)


@contextmanager
def _bar(total: int, done: int) -> Iterator[tuple[Report, Report]]:
    """Functions that show what is running, and what is done: in a log, a line for each point."""
    columns = (TextColumn("Measuring"), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn(), *TIME_LEFT)
    bar = Progress(*columns, TextColumn("{task.description}"), console=err, disable=not err.is_terminal)
    with bar:
        task = bar.add_task("", total=total, completed=done)

        def show(text: str) -> None:
            bar.update(task, description=text)

        def advance(text: str) -> None:
            nonlocal done
            done += 1
            bar.advance(task)
            err.print(f"{done:>3} of {total}  {text}", soft_wrap=True)

        yield show, advance
