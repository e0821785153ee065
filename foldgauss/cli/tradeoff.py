"""The command that measures speed against accuracy: `tradeoff`."""

import csv
import dataclasses
import functools
import io
import json
import math
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from foldgauss import __version__
from foldgauss._checks import invalid, within
from foldgauss._machine import load_average, machine
from foldgauss.cli._shared import (
    Frames,
    Size,
    Stopped,
    WrongUse,
    app,
    as_option,
    err,
    fingerprint,
    out,
    parse_frames,
    parse_size,
    scores_of,
    write_json,
)
from foldgauss.cli.compressing import save_compressed, save_halved
from foldgauss.cli.fitting import make_folder, noted
from foldgauss.io._atomic import atomic_path
from foldgauss.io.figures import write_tradeoff
from foldgauss.io.video_file import Clip, read_video
from foldgauss.io.video_model import load_video_model, save_video_model
from foldgauss.plot import Panel
from foldgauss.render import RenderOptions
from foldgauss.video.compress import compress
from foldgauss.video.config import FitConfig, chosen_num_gaussians, default_num_gaussians, planned_steps
from foldgauss.video.fit import FitInfo, FitState, fit_steps, to_model
from foldgauss.video.metrics import Evaluation, evaluate
from foldgauss.video.model import VideoModel
from foldgauss.video.tradeoff import (
    AXES,
    FLOAT16,
    FLOAT32,
    LEAST_STEPS,
    MAX_LOSS_DB,
    PASSES,
    Left,
    Pace,
    Point,
    check_axes,
    frames_per_second,
    front,
    knee,
    points,
    seconds_of,
    steps_within,
)

RECORD, ROWS, PLOT, BASE = "tradeoff.json", "tradeoff.csv", "tradeoff.png", "base.safetensors"
FILES = {RECORD, ROWS, PLOT, BASE}
DEFAULT_MINUTES = 10.0
#: Steps that the pace is measured by, and how much slower other minutes may be.
PILOT_STEPS, SLOWER = 40, 1.1
#: Options of `fit` by field of `FitConfig`, and of `fit` and `evaluate` by constant of `RenderOptions`.
_FIT_FIELDS = ("steps", "degree", "batch_size", "power", "compositing", "ssim_share", "quarter_share", "half_share")
FIT_OPTIONS = {"num_gaussians": "--gaussians"} | {
    name: f"--{name.replace('_', '-')}" for name in (*_FIT_FIELDS, "seed")
}
DRAW_OPTIONS = {
    name: f"--{name.replace('_', '-')}" for name in ("alpha_cutoff", "support_radius", "transmittance_stop")
}
#: Panels of the plot by column: what it is called, in short, in words and with units; whether more of it is better.
COSTS = {
    "seconds": ("time", "fit time", "time to fit (s)", False),
    "bytes": ("size", "file size", "file (bytes)", False),
    "frames_per_second": ("speed", "playback speed", "played (frames a second)", True),
}
COLUMNS = (
    *("axis", "value", "settings", "psnr", "ssim", "seconds", "bytes", "floats", "gaussians", "frames_per_second"),
    *("front", "knee", "command"),
)

Tell = Callable[[str], None]


@app.command(name="tradeoff")
def tradeoff_command(
    video: Annotated[Path, typer.Argument(help="Video file, or folder of images in natural order.")],
    out_dir: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")],
    axes: Annotated[
        str | None, typer.Option(metavar="AXIS,AXIS,..", help=f"Which axes, of {', '.join(AXES)} [default: all].")
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
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start anew where results are kept.")] = False,
) -> None:
    """Measure what speed and size cost, one setting at a time.

    Leaves a table (tradeoff.csv, tradeoff.json) and a plot (tradeoff.png), names the knee of each front, and tells the
    command that reproduces each point on it. Stopped, it goes on when it is run again. See docs/tradeoff.md.
    """
    try:
        chosen = tuple(AXES) if axes is None else check_axes([name.strip() for name in axes.split(",")])
        wanted = FitConfig(seed=seed)
    except ValueError as error:
        raise WrongUse(as_option(str(error))) from error
    if not within(minutes, "(0, inf)"):
        raise WrongUse(str(invalid("--minutes", expected="a number above 0", got=minutes)))
    _refuse_foreign(out_dir)
    settings = {"axes": list(chosen), "minutes": None if steps else minutes, "steps": steps, "seed": seed}
    clip = read_video(video, frames=parse_frames(frames), size=parse_size(size))
    record = _Record(out_dir / RECORD, {"version": __version__} | settings | fingerprint(clip), anew=overwrite)
    make_folder(out_dir)
    run = _Run(clip, record, _Words(video, size, frames, out_dir), noted(clip, seed, frames))
    base = run.planned(wanted, chosen, minutes, steps)
    shape = {"has_alpha": clip.has_alpha}
    made, left = points(base, chosen, clip.num_frames, clip.size, **shape)
    for one in left:
        err.print(f"note: {one.name} is left out: {one.why}.", soft_wrap=True)
    try:
        run.measure(made, base)
    except KeyboardInterrupt:
        kept = f"{len(record.rows)} of {len(made)} points are kept in {record.path}"
        raise Stopped(f"stopped; {kept}. Run the same command again to go on.") from None
    _finish(run, made, left)


@dataclasses.dataclass
class _Record:
    """What is known so far, in `path`: the settings, the plan and a row for each point, kept as it is done.

    Raises WrongUse where results of other settings are kept, or something else is.
    """

    path: Path
    settings: dict[str, Any]
    anew: bool = False
    plan: dict[str, Any] = dataclasses.field(default_factory=dict)
    rows: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    fronts: dict[str, Any] = dataclasses.field(default_factory=dict)
    machine: dict[str, Any] = dataclasses.field(default_factory=machine)

    def __post_init__(self) -> None:
        if not self.path.exists() or self.anew:
            return
        kept = self._read()
        before = kept["settings"]
        changed = sorted(name for name in self.settings if before.get(name) != self.settings[name])
        if changed:
            raise WrongUse(
                f"--out: {self.path} holds results of other settings: "
                + ", ".join(f"{name} was {before.get(name)!r}, is {self.settings[name]!r}" for name in changed)
                + ". Choose another folder, or start anew with --overwrite."
            )
        self.plan, self.machine = kept["plan"], kept["machine"]
        self.rows = {f"{row['axis']} {row['value']}".rstrip(): row for row in kept["points"]}

    def _read(self) -> dict[str, Any]:
        try:
            kept = json.loads(self.path.read_text())
            rows = [set(row) >= {*COLUMNS} - {"front", "knee"} for row in kept["points"]]
            if not (all(rows) and isinstance(kept["settings"], dict) and {"plan", "machine"} <= set(kept)):
                raise ValueError("parts are missing")
        except (ValueError, KeyError, TypeError) as error:
            raise WrongUse(
                f"--out: expected results of `foldgauss tradeoff` in {self.path}, got something else ({error}). "
                "Choose another folder, or start anew with --overwrite."
            ) from error
        return kept

    def keep(self) -> None:
        kept = {"settings": self.settings, "machine": self.machine, "plan": self.plan}
        write_json(self.path, kept | {"fronts": self.fronts, "points": list(self.rows.values())})


@dataclasses.dataclass(frozen=True)
class _Words:
    """The command lines that reproduce points, run from the folder that this one is run from."""

    video: Path
    size: str | None
    frames: str | None
    folder: Path

    def of(self, point: Point, clip_size: tuple[int, int]) -> str:
        """`point` as commands: its fit; or what is done to the base's model, which is kept."""
        name, base = point.name.replace(", ", "-").replace(" ", "-").replace("/", "_"), self.folder / BASE
        if point.played is not None:
            constants = _changed(point.played, point.config.options, DRAW_OPTIONS)
            return shlex.join(["foldgauss", "evaluate", str(base), str(self.video), *constants])
        if point.stored != FLOAT32:
            how = ["--float16"] if point.stored == FLOAT16 else ["--passes", str(PASSES[point.stored])]
            how += [] if point.stored == FLOAT16 else ["--max-loss-db", f"{MAX_LOSS_DB:g}"]
            suffix = ".safetensors" if point.stored == FLOAT16 else ".fgz"
            words = ["compress", str(base), str(self.video), *how, "--out", f"{name}{suffix}"]
            return shlex.join(["foldgauss", *words])
        words = ["fit", str(self.video), "--out", f"{name}.safetensors"]
        words += [] if self.size is None else ["--size", self.size]
        words += [] if self.frames is None else ["--frames", self.frames]
        default = FitConfig(num_gaussians=default_num_gaussians(*clip_size))
        words += _changed(point.config, default, FIT_OPTIONS)
        words += _changed(point.config.options, default.options, DRAW_OPTIONS)
        return shlex.join(["foldgauss", *words])


def _changed(now: FitConfig | RenderOptions, before: FitConfig | RenderOptions, options: dict[str, str]) -> list[str]:
    """Options for all fields that differ."""
    names = [field.name for field in dataclasses.fields(now) if field.name != "options"]
    changed = [name for name in names if getattr(now, name) != getattr(before, name)]
    return [word for name in changed for word in (options[name], str(getattr(now, name)))]


class _Run:
    """The points of one clip, measured one after another."""

    def __init__(self, clip: Clip, record: _Record, words: _Words, about: dict[str, Any]):
        self.clip, self.record, self.words, self.about = clip, record, words, about
        self.folder = words.folder

    def planned(self, wanted: FitConfig, axes: tuple[str, ...], minutes: float, steps: int | None) -> FitConfig:
        """The base, its steps as many as the minutes allow; measures the pace, unless that is kept."""
        num = chosen_num_gaussians(wanted, self.clip.num_frames, *self.clip.size)
        full = planned_steps(wanted, self.clip.num_frames)
        if not self.record.plan and steps is not None:
            self.record.plan = {"steps": steps}
        if not self.record.plan:
            with err.status("Measuring the pace"):
                pace = self._pace(dataclasses.replace(wanted, num_gaussians=num, steps=PILOT_STEPS))
            base = dataclasses.replace(wanted, num_gaussians=num, steps=full)
            made, _ = points(base, axes, self.clip.num_frames, self.clip.size, has_alpha=self.clip.has_alpha)
            within = steps_within(60 * minutes / SLOWER, made, pace, self.clip.num_frames)
            chosen = min(max(within, LEAST_STEPS), full)
            expected = SLOWER * seconds_of(made, chosen, pace, self.clip.num_frames) / 60
            self.record.plan = {"steps": chosen, "expected_minutes": round(expected, 2), "pace": pace._asdict()}
            self._say(len(made), chosen, full, expected, minutes)
        make_folder(self.folder)
        self.record.keep()
        return dataclasses.replace(wanted, num_gaussians=num, steps=self.record.plan["steps"])

    def _say(self, num_points: int, steps: int, full: int, expected: float, minutes: float) -> None:
        out.print(
            f"{self.clip.source}: {self.clip.num_frames} frames of {self.clip.size[0]}x{self.clip.size[1]}; "
            f"{num_points} points about a base of {steps:,} steps, about {expected:.1f} minutes",
            soft_wrap=True,
        )
        if steps == full and expected < 0.9 * minutes:
            err.print(f"note: {full:,} steps are a whole fit of this clip, and need no more minutes.", soft_wrap=True)
        if expected > 1.02 * minutes:
            err.print(
                f"warning: --minutes: {minutes:g} are too few for {num_points} points about a base of {steps:,} steps, "
                f"the fewest that show anything: this takes about {expected:.1f}. Name fewer --axes or --frames, or a "
                "smaller --size.",
                soft_wrap=True,
            )

    def _pace(self, config: FitConfig) -> Pace:
        steps = list(self._fit(config, lambda info: None))
        state, last = steps[-1]
        first = steps[0][1]
        model = to_model(state, config, self.clip.size, self.clip.fps)
        begun = time.perf_counter()
        evaluate(model, self.clip.frames)
        frames_per_second(model)
        look = time.perf_counter() - begun
        step = (last.seconds - first.seconds) / max(last.step - first.step, 1)
        return Pace(max(first.seconds - step, 0.0), step, look)

    def _fit(self, config: FitConfig, tell: Callable[[FitInfo], None]) -> Iterator[tuple[FitState, FitInfo]]:
        for state, info in fit_steps(self.clip.frames, config):
            tell(info)
            yield state, info

    def measure(self, made: list[Point], base: FitConfig) -> None:
        """A row for each point that has none yet, kept as soon as it is there."""
        with _bar(len(made), sum(point.name in self.record.rows for point in made)) as (tell, advance):
            for point in made:
                if point.name in self.record.rows:
                    continue
                tell(point.name)
                row = self._measured(point, base, lambda text, point=point: tell(f"{point.name}: {text}"))
                self.record.rows[point.name] = row
                self.record.machine["load_average_last"] = load_average()
                self.record.keep()
                advance(f"{point.name}: {row['psnr']:.2f} dB, {row['seconds']:.1f} s, {row['bytes']:,} bytes")

    def _measured(self, point: Point, base: FitConfig, tell: Tell) -> dict[str, Any]:
        with atomic_path(self.folder / BASE) if point.axis == "base" else _passing(self.folder, point) as path:
            if point.of_base:
                model, seconds = self._base(base, tell)
                shown, scores, more = self._again(model, point, path, tell)
                seconds += more
            else:
                shown, seconds = self._fitted(point.config, tell)
                scores = evaluate(shown, self.clip.frames)
                save_video_model(path, shown, metadata=self.about | scores_of(scores))
            tell("playing")
            num_bytes = path.stat().st_size
        return {
            "axis": point.axis,
            "value": point.value,
            "settings": _settings(point, base),
            "psnr": round(scores.mean_psnr, 4),
            "ssim": round(scores.mean_ssim, 5),
            "seconds": round(seconds, 3),
            "bytes": num_bytes,
            "floats": shown.num_floats,
            "gaussians": shown.num_gaussians,
            "frames_per_second": round(frames_per_second(shown), 2),
            "command": self.words.of(point, self.clip.size),
        }

    def _again(self, model: VideoModel, point: Point, path: Path, tell: Tell) -> tuple[VideoModel, Evaluation, float]:
        """The base's model drawn or kept in another way; its scores, and the seconds that takes beside its fit."""
        if point.played is not None:
            shown = dataclasses.replace(model, options=point.played)
            path.write_bytes((self.folder / BASE).read_bytes())
            return shown, evaluate(shown, self.clip.frames), 0.0
        begun = time.perf_counter()
        if point.stored == FLOAT16:
            score = functools.partial(evaluate, frames=self.clip.frames)
            scores = save_halved(path, model, self.about, score)
            return load_video_model(path), scores, 0.0
        passes = PASSES[point.stored]
        made = compress(
            model,
            self.clip.frames,
            max_loss_db=MAX_LOSS_DB,
            passes=passes,
            on_step=lambda what, loss: tell(what if math.isnan(loss) else f"{what}, {loss:.3f} dB lost"),
        )
        seconds = time.perf_counter() - begun
        save_compressed(path, made, self.about)
        return made.model, evaluate(made.model, self.clip.frames), seconds

    def _base(self, base: FitConfig, tell: Tell) -> tuple[VideoModel, float]:
        """The base's model as its file has it, fitted again if that has gone; and the seconds its fit took."""
        path, row = self.folder / BASE, self.record.rows["base"]
        if not path.exists():
            model, _ = self._fitted(base, tell)
            save_video_model(path, model, metadata=self.about | scores_of(evaluate(model, self.clip.frames)))
        return load_video_model(path), row["seconds"]

    def _fitted(self, config: FitConfig, tell: Tell) -> tuple[VideoModel, float]:
        def say(info: FitInfo) -> None:
            tell(f"step {info.step} of {config.steps}, {info.psnr:.2f} dB")

        for state, info in self._fit(config, say):
            pass
        tell("evaluating")
        return to_model(state, config, self.clip.size, self.clip.fps), info.seconds


@contextmanager
def _passing(folder: Path, point: Point) -> Iterator[Path]:
    """A file that is written to be weighed, and gone afterwards."""
    suffix = ".fgz" if point.stored in PASSES else ".safetensors"
    path = folder / f".weighed{suffix}"
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def _settings(point: Point, base: FitConfig) -> dict[str, Any]:
    """Every setting that differs from the base's."""
    changed = {
        field.name: getattr(point.config, field.name)
        for field in dataclasses.fields(base)
        if field.name != "options" and getattr(point.config, field.name) != getattr(base, field.name)
    }
    options = point.config.options if point.played is None else point.played
    word = "fitted" if point.played is None else "played"
    changed |= {
        f"{field.name} ({word})": getattr(options, field.name)
        for field in dataclasses.fields(options)
        if getattr(options, field.name) != getattr(base.options, field.name)
    }
    return changed | ({} if point.stored == FLOAT32 else {"stored": point.stored})


@contextmanager
def _bar(total: int, done: int) -> Iterator[tuple[Tell, Tell]]:
    """Two tellers: of what is being done now, and of what is done. In a log, a line for each point."""
    columns = (TextColumn("Measuring"), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn())
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


def _refuse_foreign(folder: Path) -> None:
    """Results replace results only, so nothing else may be among them."""
    try:
        names = {entry.name for entry in folder.iterdir() if not entry.name.startswith(".")}
    except OSError:  # missing, or no folder: making it says so
        return
    foreign = sorted(names - FILES)
    if foreign:
        raise WrongUse(
            f"--out: expected a new folder or one that a tradeoff wrote, got {folder} with {foreign[0]!r} in it. "
            "Choose another folder."
        )


# ------------------------------------------------------------------------------------------ what comes of it


def _finish(run: _Run, made: list[Point], left: list[Left]) -> None:
    """The fronts and their knees, into the files and onto the screen."""
    record, rows = run.record, [run.record.rows[point.name] for point in made]
    names = [point.name for point in made]
    panels = []
    for column, (_, what, label, more_is_better) in COSTS.items():
        cost = [1 / row[column] if more_is_better else row[column] for row in rows]
        quality = [row["psnr"] for row in rows]
        chosen = front(cost, quality)
        bend = knee([cost[k] for k in chosen], [quality[k] for k in chosen])
        at = None if bend is None else chosen[bend]
        panels.append(Panel(label, [row[column] for row in rows], chosen, at))
        record.fronts[column] = {
            "what": what,
            "front": [names[k] for k in chosen],
            "knee": None if at is None else names[at],
        }
    record.fronts["left_out"] = {one.name: one.why for one in left}
    record.keep()
    _write_csv(run.folder / ROWS, rows, record.fronts)
    try:
        write_tradeoff(
            run.folder / PLOT, panels, [row["psnr"] for row in rows], [(point.axis, point.value) for point in made]
        )
    except ImportError as error:
        err.print(f"warning: no plot in {run.folder / PLOT}: {error}", soft_wrap=True)
    _print_rows(rows, record.fronts)
    _print_fronts(rows, names, record.fronts)


def _write_csv(path: Path, rows: list[dict[str, Any]], fronts: dict[str, Any]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS)
    writer.writeheader()
    for row in rows:
        name = f"{row['axis']} {row['value']}".rstrip()
        settings = "; ".join(f"{key}={value}" for key, value in row["settings"].items())
        on = [column for column in COSTS if name in fronts[column]["front"]]
        knees = [column for column in COSTS if name == fronts[column]["knee"]]
        writer.writerow(row | {"settings": settings, "front": " ".join(on), "knee": " ".join(knees)})
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), newline="")


def _print_rows(rows: list[dict[str, Any]], fronts: dict[str, Any]) -> None:
    table = Table(
        title="Speed against accuracy", title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0)
    )
    table.add_column("point", no_wrap=True)
    for name in ("dB", "SSIM", "fit s", "kB", "fps"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("front", no_wrap=True)
    for row in rows:
        name = f"{row['axis']} {row['value']}".rstrip()
        figures = f"{row['psnr']:.2f}", f"{row['ssim']:.4f}", f"{row['seconds']:.1f}", f"{row['bytes'] / 1000:,.1f}"
        marks = [short for column, (short, *_) in COSTS.items() if name in fronts[column]["front"]]
        table.add_row(name, *figures, f"{row['frames_per_second']:.0f}", " ".join(marks))
    out.print(table)


def _print_fronts(rows: list[dict[str, Any]], names: list[str], fronts: dict[str, Any]) -> None:
    commands = {name: row["command"] for name, row in zip(names, rows, strict=True)}
    on = {name for column in COSTS for name in fronts[column]["front"]}
    for column, (_, what, *_) in COSTS.items():
        bend = fronts[column]["knee"]
        if bend is None:
            out.print(
                f"PSNR against {what}: no knee; the front is {', '.join(fronts[column]['front'])}", soft_wrap=True
            )
            continue
        row = rows[names.index(bend)]
        figures = {
            "seconds": f"{row['seconds']:.1f} s",
            "bytes": f"{row['bytes']:,} bytes",
            "frames_per_second": f"{row['frames_per_second']:.0f} frames a second",
        }
        out.print(
            f"PSNR against {what}: the knee is {bend}, {row['psnr']:.2f} dB with {figures[column]}", soft_wrap=True
        )
    out.print("The points on the fronts, by command:")
    for name in names:
        if name in on:
            out.print(f"  {name}: {commands[name]}", soft_wrap=True)
