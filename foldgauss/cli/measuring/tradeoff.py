"""The command that measures speed against accuracy: `tradeoff`."""

import dataclasses
import functools
import math
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
from foldgauss.cli.editing.compress import save_compressed, save_halved
from foldgauss.cli.measuring.tradeoff_record import BASE, CLOCKS, FILES, RECORD, Commands, Record, report, settings_of
from foldgauss.cli.shared.arguments import Frames, NewClip, Size, parse_frames, parse_size
from foldgauss.cli.shared.outputs import make_folder, name_after, refuse_foreign
from foldgauss.cli.shared.rendering import TIME_LEFT
from foldgauss.io._atomic import atomic_path
from foldgauss.io._lock import lock_output
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.video_reading import read_video
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.io.provenance import fingerprint
from foldgauss.jobs.runner import clip_warnings, fit_metadata, mean_scores
from foldgauss.video.compression.search import compress
from foldgauss.video.fitting.config import FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.loop import FitInfo, fit_steps
from foldgauss.video.fitting.optical_flow import Motion
from foldgauss.video.fitting.state import FitState, to_model
from foldgauss.video.models.metrics import Evaluation, evaluate
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.tradeoff import (
    AXES,
    FLOAT16,
    LEAST_STEPS,
    MAX_LOSS_DB,
    PASSES,
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
#: Steps that the pace is measured by, and how much slower other minutes may be.
PILOT_STEPS, SLOWER = 40, 1.1

Tell = Callable[[str], None]


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
            help=f"Which axes, of {', '.join(AXES)} [default: all].",
            autocompletion=complete_list(AXES),
        ),
    ] = None,
    minutes: Annotated[
        float, typer.Option(help="Time for all of it: the fits are made as short as that asks for.")
    ] = DEFAULT_MINUTES,
    steps: Annotated[
        int | None, typer.Option(help="Optimiser steps of the base, instead of those that --minutes allow.", min=1)
    ] = None,
    size: Size = None,
    frames: Frames = None,
    seed: Annotated[int, typer.Option(help="Seed of all fits.")] = 0,
    clock: Annotated[
        str,
        typer.Option(
            help="Time to fit: wall, or cpu, the work of all cores, where others use them, too.",
            autocompletion=complete_choice(CLOCKS),
        ),
    ] = "wall",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start anew where results are kept.")] = False,
) -> None:
    """Measure what speed and size cost, one setting at a time.

    Leaves a table (tradeoff.csv, tradeoff.json) and a plot (tradeoff.png), names the knee of each front, and tells the
    command that reproduces each point on it. Stopped, it goes on when it is run again. See docs/tradeoff.md.
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
    refuse_foreign(out_dir, FILES, "tradeoff", record=RECORD, known=known, cure=", or start anew with --overwrite")
    settings = {"axes": list(chosen), "minutes": None if steps else minutes, "steps": steps, "seed": seed}
    clip = read_video(video, frames=parse_frames(frames), size=parse_size(size))
    for text in clip_warnings(clip):
        warn(f"{clip.source}: {text}")
    make_folder(out_dir)
    own = tuple(out_dir / name for name in sorted(FILES - {RECORD}))
    context.with_resource(lock_output(out_dir / RECORD, own=own, what="tradeoff"))
    record = Record(out_dir / RECORD, {"version": __version__} | settings | fingerprint(clip), anew=overwrite)
    run = _Run(clip, record, Commands(video, size, frames, out_dir), fit_metadata(clip, seed, parse_frames(frames)))
    base = run.planned(wanted, chosen, minutes, steps)
    made, left = plan_points(base, chosen, clip.num_frames, clip.size, has_alpha=clip.has_alpha)
    for one in left:
        err.print(f"note: {one.name} is left out: {one.why}.", soft_wrap=True)
    try:
        failed = run.measure(made, base)
    except KeyboardInterrupt:
        kept = f"{len(record.rows)} of {len(made)} points are kept in {record.path}"
        raise Stopped(f"stopped; {kept}. Run the same command again to go on.") from None
    missing = {one.name for one in failed}
    report(record, [point for point in made if point.name not in missing], left + failed, clock)


class _Run:
    """The points of one clip, measured one after another."""

    def __init__(self, clip: Clip, record: Record, words: Commands, about: dict[str, Any]):
        self.clip, self.record, self.words, self.about = clip, record, words, about
        self.folder = words.folder
        self._kept: VideoModel | None = None  # the base's model
        self._motion: Motion | None = None  # the clip's, found once for all fits
        self._warm = False  # whether what a fit compiles for this size is there

    def planned(self, wanted: FitConfig, axes: tuple[str, ...], minutes: float, steps: int | None) -> FitConfig:
        """The base, its steps as many as the minutes allow; measures the pace, unless that is kept."""
        num = chosen_num_gaussians(wanted, self.clip.num_frames, *self.clip.size)
        full = planned_steps(wanted, self.clip.num_frames)
        if not self.record.plan:
            with err.status("Measuring the pace"):
                pace = self._pace(dataclasses.replace(wanted, num_gaussians=num, steps=PILOT_STEPS))
            base = dataclasses.replace(wanted, num_gaussians=num, steps=full)
            made, _ = plan_points(base, axes, self.clip.num_frames, self.clip.size, has_alpha=self.clip.has_alpha)
            allowed = estimate_steps(60 * minutes / SLOWER, made, pace, self.clip.num_frames)
            least = max(LEAST_STEPS, self.clip.num_frames)  # so that the base sees every frame
            chosen = min(max(allowed, least), full) if steps is None else steps
            expected = SLOWER * estimate_seconds(made, chosen, pace, self.clip.num_frames) / 60
            self.record.plan |= {"steps": chosen, "expected_minutes": round(expected, 2), "pace": pace._asdict()}
            self._say(len(made), chosen, expected)
            if steps is None:
                self._say_misfit(len(made), chosen, full, expected, minutes)
        self.record.keep()
        return dataclasses.replace(wanted, num_gaussians=num, steps=self.record.plan["steps"])

    def _say(self, num_points: int, steps: int, expected: float) -> None:
        out.print(
            f"{self.clip.source}: {self.clip.num_frames} frames of {self.clip.size[0]}x{self.clip.size[1]}; "
            f"{num_points} points about a base of {steps:,} steps, about {expected:.1f} minutes",
            soft_wrap=True,
        )

    def _say_misfit(self, num_points: int, steps: int, full: int, expected: float, minutes: float) -> None:
        if steps == full and expected < 0.9 * minutes:
            err.print(f"note: {full:,} steps are a whole fit of this clip, and need no more minutes.", soft_wrap=True)
        if expected > 1.02 * minutes:
            err.print(
                f"warning: --minutes: {minutes:g} are too few for {num_points} points about a base of {steps:,} steps, "
                f"the fewest that show anything: this takes about {expected:.1f}. Name fewer --axes or --frames, or a "
                "smaller --size.",
                soft_wrap=True,
            )

    def _pace(self, config: FitConfig) -> Throughput:
        self._warm = True
        steps = list(self._fit(config, lambda info: None))
        state, last = steps[-1]
        first = steps[0][1]
        model = to_model(state, config, self.clip.size, self.clip.fps)
        begun = time.perf_counter()
        evaluate(model, self.clip.frames)
        measure_frame_rate(model)
        look = time.perf_counter() - begun
        step = (last.seconds - first.seconds) / max(last.step - first.step, 1)
        return Throughput(max(first.seconds - step, 0.0), step, look)

    def _fit(self, config: FitConfig, tell: Callable[[FitInfo], None]) -> Iterator[tuple[FitState, FitInfo]]:
        for state, info in fit_steps(self.clip.frames, config, motion=self._found_motion()):
            tell(info)
            yield state, info

    def _found_motion(self) -> Motion:
        """The clip's, found once; what that took is kept with the plan: `fit` spends it anew on every model."""
        if self._motion is None:
            begun = _Spent.now()
            self._motion = Motion.from_frames(np.ascontiguousarray(self.clip.frames[..., :3]))
            self.record.plan.setdefault("motion", _Spent.since(begun)._asdict())
        return self._motion

    def measure(self, made: list[Point], base: FitConfig) -> list[Skipped]:
        """A row for each point that has none yet, kept as soon as it is there; and the points that cannot be had."""
        failed, busy = [], False
        with _bar(len(made), sum(point.name in self.record.rows for point in made)) as (tell, advance):
            for point in made:
                if point.name in self.record.rows:
                    continue
                tell(point.name)
                try:
                    row = self._measured(point, base, lambda text, point=point: tell(f"{point.name}: {text}"))
                except ValueError as error:  # a fit that diverged, a loss out of reach
                    if point.axis == "base":
                        raise
                    failed.append(Skipped(point.name, str(error)))
                    advance(f"{point.name} is left out: {error}")
                    continue
                self.record.rows[point.name] = row
                self.record.machine["load_average_last"] = load_average()
                busy |= (load_average() or 0) > 1.5 * self.record.machine["cores"]
                self.record.keep()
                advance(f"{point.name}: {row['psnr']:.2f} dB, {row['seconds']:.1f} s, {row['bytes']:,} bytes")
        if busy:
            err.print(
                f"note: other programs shared the {self.record.machine['cores']} cores: times to fit hold their share. "
                "With --clock cpu, the same command again, the front is by the work done.",
                soft_wrap=True,
            )
        return failed

    def _measured(self, point: Point, base: FitConfig, tell: Tell) -> dict[str, Any]:
        with atomic_path(self.folder / BASE) if point.axis == "base" else _passing(self.folder, point) as path:
            if point.reuses_base:
                shown, scores, spent = self._again(self._base(base, tell), point, path, tell)
            else:
                shown, spent = self._fitted(point.config, tell)
                scores = evaluate(shown, self.clip.frames)
                save_video_model(path, shown, metadata=self.about | mean_scores(scores))
            num_bytes = (self.folder / BASE if point.played is not None else path).stat().st_size
        tell("playing")
        if point.axis == "base":
            rate = measure_frame_rate(shown)
        else:  # beside the base, which others of this machine slow down as much
            own, others = measure_frame_seconds(shown, self._base(base, tell))
            rate = self.record.rows["base"]["frames_per_second"] * others / own
        return {
            "axis": point.axis,
            "value": point.value,
            "settings": settings_of(point, base),
            "psnr": round(scores.mean_psnr, 4),
            "ssim": round(scores.mean_ssim, 5),
            "seconds": round(spent.wall, 3),
            "cpu_seconds": round(spent.cpu, 3),
            "bytes": num_bytes,
            "floats": shown.num_parameters,
            "gaussians": shown.num_gaussians,
            "frames_per_second": round(rate, 2),
            "command": self.words.of(point, self.clip.num_frames, self.clip.size),
        }

    def _again(
        self, model: VideoModel, point: Point, path: Path, tell: Tell
    ) -> tuple[VideoModel, Evaluation, "_Spent"]:
        """The base's model drawn or kept in another way; its scores, and what fit and compression took."""
        fitted = _Spent(self.record.rows["base"]["seconds"], self.record.rows["base"]["cpu_seconds"])
        if point.played is not None:
            shown = dataclasses.replace(model, options=point.played)
            return shown, evaluate(shown, self.clip.frames), fitted
        if point.stored == FLOAT16:
            score = functools.partial(evaluate, frames=self.clip.frames)
            scores = save_halved(path, model, self.about, score)
            return load_video_model(path), scores, fitted
        begun = _Spent.now()
        made = compress(
            model,
            self.clip.frames,
            max_loss_db=MAX_LOSS_DB,
            passes=PASSES[point.stored],
            on_step=lambda what, loss: tell(what if math.isnan(loss) else f"{what}, {loss:.3f} dB lost"),
        )
        spent = fitted.and_also(_Spent.since(begun))
        save_compressed(path, made, self.about)
        return made.model, evaluate(made.model, self.clip.frames), spent

    def _base(self, base: FitConfig, tell: Tell) -> VideoModel:
        """The base's model as its file has it, fitted again if that has gone."""
        path = self.folder / BASE
        if not path.exists():
            model, _ = self._fitted(base, tell)
            save_video_model(path, model, metadata=self.about | mean_scores(evaluate(model, self.clip.frames)))
        if self._kept is None:
            self._kept = load_video_model(path)
        return self._kept

    def _fitted(self, config: FitConfig, tell: Tell) -> tuple[VideoModel, "_Spent"]:
        if not self._warm:
            list(self._fit(dataclasses.replace(config, steps=2), lambda info: None))
            self._warm = True
        # Kernels are compiled on a corner of the clip: no fit's seconds count that, and neither may its CPU seconds.
        tiny = dataclasses.replace(config, num_gaussians=8, steps=1, follow_motion=False)
        list(fit_steps(self.clip.frames[:2, :32, :32].copy(), tiny))
        self._found_motion()  # before the clock runs
        begun = time.process_time()
        for state, info in self._fit(
            config, lambda info: tell(f"step {info.step} of {config.steps}, {info.psnr:.2f} dB")
        ):
            pass
        spent = _Spent(info.seconds, time.process_time() - begun)
        if config.follow_motion:  # `fit` would have found it in its own time
            spent = spent.and_also(_Spent(**self.record.plan["motion"]))
        tell("evaluating")
        return to_model(state, config, self.clip.size, self.clip.fps), spent


class _Spent(NamedTuple):
    """Seconds by the clock on the wall, and those of all cores at work."""

    wall: float
    cpu: float

    @classmethod
    def now(cls) -> "_Spent":
        return cls(time.perf_counter(), time.process_time())

    @classmethod
    def since(cls, begun: "_Spent") -> "_Spent":
        now = cls.now()
        return cls(now.wall - begun.wall, now.cpu - begun.cpu)

    def and_also(self, other: "_Spent") -> "_Spent":
        return _Spent(self.wall + other.wall, self.cpu + other.cpu)


@contextmanager
def _passing(folder: Path, point: Point) -> Iterator[Path]:
    """A place for a file that is only written to be weighed: it is gone afterwards."""
    suffix = ".fgz" if point.stored in PASSES else ".safetensors"
    path = folder / f".weighed{suffix}"
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def _bar(total: int, done: int) -> Iterator[tuple[Tell, Tell]]:
    """Two tellers: of what is being done now, and of what is done. In a log, a line for each point."""
    columns = (TextColumn("Measuring"), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn(), *TIME_LEFT)
    bar = Progress(*columns, TextColumn("{task.description}"), console=err, disable=not err.is_terminal)
    with bar:
        task = bar.add_task("", total=total, completed=done)

        def tell(text: str) -> None:
            bar.update(task, description=text)

        def advance(text: str) -> None:
            nonlocal done
            done += 1
            bar.advance(task)
            err.print(f"{done:>3} of {total}  {text}", soft_wrap=True)

        yield tell, advance
