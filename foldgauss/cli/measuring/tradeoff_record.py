"""Results of `tradeoff`: its record, the commands that reproduce points, and its table."""

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from foldgauss._runtime.checks import ParameterError, invalid
from foldgauss._runtime.machine import describe_machine
from foldgauss._runtime.settings import setting_of, settings_by_name, walk
from foldgauss.analysis.plot import Panel
from foldgauss.cli.app.application import out, warn
from foldgauss.cli.shared.tables import write_json
from foldgauss.io._atomic import write_or_keep
from foldgauss.io.figures import write_tradeoff
from foldgauss.io.media.clip import Reading
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX
from foldgauss.render import RenderOptions
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.tradeoff import Point, Skipped, knee, pareto_front

RECORD = "tradeoff.json"
PLOT = "tradeoff.png"
#: Folder of the models, with the records of their fits.
MODELS = "models"
FILES = {RECORD, PLOT, MODELS}


@dataclasses.dataclass(frozen=True)
class Cost:
    """What quality is compared with: its name in results, the column of a row, the axis of the plot, and its format."""

    what: str
    column: str
    label: str
    form: str
    more_is_better: bool = False


COSTS = {
    "time": Cost("fit time", "seconds", "time to fit (s)", "{:.1f} s"),
    "size": Cost("file size", "bytes", "file (bytes)", "{:,} bytes"),
    "speed": Cost("playback speed", "frames_per_second", "frames per second", "{:.0f} frames per second", True),
}


@dataclasses.dataclass
class Record:
    """The results, in `path`: the settings, the plan and, in the end, a row for each measured point.

    The fits themselves have records of their own, so that finished ones are not repeated.

    Raises ParameterError if `path` has results of other settings or is not a record.
    """

    path: Path
    settings: dict[str, Any]
    restart: bool = False
    plan: dict[str, Any] = dataclasses.field(default_factory=dict)
    rows: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    fronts: dict[str, Any] = dataclasses.field(default_factory=dict)
    left_out: dict[str, str] = dataclasses.field(default_factory=dict)
    machine: dict[str, Any] = dataclasses.field(default_factory=describe_machine)

    def __post_init__(self) -> None:
        if not self.path.exists() or self.restart:
            return
        cure = "Choose another folder, or start over with --overwrite."
        try:
            kept = json.loads(self.path.read_text())
            before, self.plan, self.machine = dict(kept["settings"]), dict(kept["plan"]), dict(kept["machine"])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise invalid(
                "--out",
                expected=f"results of `foldgauss tradeoff` in {self.path}",
                got=f"something else ({error})",
                cure=cure,
            ) from error
        changed = sorted(name for name in self.settings if before.get(name) != self.settings[name])
        if changed:
            text = ", ".join(f"{name} was {before.get(name)!r}, is {self.settings[name]!r}" for name in changed)
            raise ParameterError("--out", f"{self.path} holds results of other settings: {text}. {cure}")

    def save(self) -> None:
        names = ("settings", "machine", "plan", "left_out", "fronts")
        kept = {name: getattr(self, name) for name in names} | {"points": list(self.rows.values())}
        write_or_keep(self.path, lambda path: write_json(path, kept))


def file_name(point: Point) -> str:
    """The name of the file of a point's model."""
    suffix = COMPACT_SUFFIX if point.config.is_compact else MODEL_SUFFIX
    return point.name.replace(", ", "-").replace(" ", "-").replace("/", "_") + suffix


def format_command(
    video: Path, size: str | None, frames: str | None, reading: Reading, folder: Path, point: Point
) -> str:
    """The command line that fits the model of `point`, or evaluates that of the base, from the current folder."""
    if point.played is not None:
        words = [
            "evaluate",
            str(folder / MODELS / f"base{MODEL_SUFFIX}"),
            str(video),
            *_options(point.played, point.config.options),
        ]
        return shlex.join(["foldgauss", *words])
    words = ["fit", str(video), "--out", file_name(point)]
    words += [] if size is None else ["--size", size]
    words += [] if frames is None else ["--frames", frames]
    words += [f"--{name}={value}" for name, value in reading.changed.items()]
    default = FitConfig()
    words += [*_options(point.config, default), *_options(point.config.options, default.options)]
    return shlex.join(["foldgauss", *words])


def _options(now: FitConfig | RenderOptions, before: FitConfig | RenderOptions) -> list[str]:
    """Command-line options for all fields that differ."""
    words = []
    for name, value in _changed(now, before).items():
        fields = {name: field for name, field, _ in walk(now)}
        option = setting_of(fields[name]).option if isinstance(now, FitConfig) else f"--{name.replace('_', '-')}"
        on, _, off = option.partition("/")
        words += [on if value else off] if off else [on, str(value)]
    return words


def _changed(now: FitConfig | RenderOptions, before: FitConfig | RenderOptions) -> dict[str, Any]:
    others = settings_by_name(before)
    return {name: x for name, x in settings_by_name(now).items() if name != "options" and x != others[name]}


def changed_settings(point: Point, base: FitConfig) -> dict[str, Any]:
    """Every setting that differs from the base."""
    options, word = (point.config.options, "fitted") if point.played is None else (point.played, "played")
    others = {f"{name} ({word})": value for name, value in _changed(options, base.options).items()}
    return _changed(point.config, base) | others


def report(record: Record, made: list[Point], skipped: list[Skipped]) -> None:
    """Write and print the Pareto fronts and their knees."""
    names, folder = [point.name for point in made], record.path.parent
    rows = [record.rows[name] for name in names]
    quality, panels = [row["psnr"] for row in rows], []
    for name, cost in COSTS.items():
        amounts = [row[cost.column] for row in rows]
        costs = [1 / amount if cost.more_is_better else amount for amount in amounts]
        front = pareto_front(costs, quality)
        place = knee([costs[k] for k in front], [quality[k] for k in front])  # on the front
        at = None if place is None else front[place]
        panels.append(Panel(cost.label, amounts, front, at))
        record.fronts[name] = {"what": cost.what, "column": cost.column, "front": [names[k] for k in front]}
        record.fronts[name]["knee"] = None if at is None else names[at]
    record.left_out = {one.name: one.why for one in skipped}
    record.save()
    marks = [[cost for cost in COSTS if name in record.fronts[cost]["front"]] for name in names]
    try:
        write_tradeoff(folder / PLOT, panels, quality, [(point.axis, point.value) for point in made])
    except ImportError as error:
        warn(f"no plot in {folder / PLOT}: {error}")
    _print_rows(rows, names, marks)
    for name, cost in COSTS.items():
        at, front = record.fronts[name]["knee"], "; ".join(record.fronts[name]["front"])
        text = f"no knee; the Pareto front is {front}"
        if at is not None:
            row = record.rows[at]
            text = f"the knee is {at}, {row['psnr']:.2f} dB with {cost.form.format(row[cost.column])}"
        out.print(f"PSNR against {cost.what}: {text}", soft_wrap=True)
    out.print("Commands of the points on the Pareto fronts:")
    for name, row, mark in zip(names, rows, marks, strict=True):
        if mark:
            out.print(f"  {name}: {row['command']}", soft_wrap=True)


def _print_rows(rows: list[dict[str, Any]], names: list[str], marks: list[list[str]]) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("point", no_wrap=True)
    for title in ("dB", "SSIM", "fit s", "kB", "fps"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("front", no_wrap=True)
    for row, name, front in zip(rows, names, marks, strict=True):
        figures = f"{row['psnr']:.2f}", f"{row['ssim']:.4f}", f"{row['seconds']:.1f}", f"{row['bytes'] / 1000:,.0f}"
        table.add_row(name, *figures, f"{row['frames_per_second']:.0f}", " ".join(front))
    out.print(table)
