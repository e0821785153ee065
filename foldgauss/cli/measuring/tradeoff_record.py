"""Results of `tradeoff`: its record, the commands that reproduce points, and its tables."""

import csv
import dataclasses
import io
import itertools
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from foldgauss._runtime.checks import is_integer, is_within, short_repr
from foldgauss._runtime.machine import describe_machine
from foldgauss._runtime.settings import setting_of, settings_by_name
from foldgauss.analysis.plot import Panel
from foldgauss.cli.app.application import WrongUse, out, warn
from foldgauss.cli.fitting.options import CONFIG_FIELDS
from foldgauss.cli.shared.tables import write_json
from foldgauss.io._atomic import atomic_path, write_or_keep
from foldgauss.io.figures import write_tradeoff
from foldgauss.io.media.clip import AS_STORED, Reading
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX
from foldgauss.render import RenderOptions
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.tradeoff import Point, Skipped, knee, pareto_front

RECORD, ROWS, PLOT, BASE = "tradeoff.json", "tradeoff.csv", "tradeoff.png", "base.safetensors"
FILES = {RECORD, ROWS, PLOT, BASE}
#: Options of `fit` by field of `FitConfig`, and of `fit` and `evaluate` by constant of `RenderOptions`.
FIT_OPTIONS = {name: setting_of(field).option for name, field in CONFIG_FIELDS.items()}
RENDER_OPTIONS = {
    name: f"--{name.replace('_', '-')}" for name in ("alpha_cutoff", "support_radius", "transmittance_stop")
}
#: Panels of the plot: the cost, its label, and whether more is better.
COSTS = {
    "time": ("fit time", "time to fit (s)", False),
    "size": ("file size", "file (bytes)", False),
    "speed": ("playback speed", "frames per second", True),
}
#: Columns of the time to fit, by clock.
CLOCKS = {"wall": "seconds", "cpu": "cpu_seconds"}
COLUMNS = (
    *("axis", "value", "settings", "psnr", "ssim", "seconds", "cpu_seconds", "bytes", "floats", "gaussians"),
    *("frames_per_second", "front", "knee", "command"),
)


@dataclasses.dataclass
class Record:
    """The results so far, in `path`: the settings, the plan and a row for each measured point.

    Raises WrongUse if `path` has results of other settings or is not a record.
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
        kept = self._read()
        before = kept["settings"]
        changed = sorted(name for name in self.settings if before.get(name) != self.settings[name])
        if changed:
            raise WrongUse(
                f"--out: {self.path} holds results of other settings: "
                + ", ".join(f"{name} was {before.get(name)!r}, is {self.settings[name]!r}" for name in changed)
                + ". Choose another folder, or start over with --overwrite."
            )
        self.plan, self.machine = kept["plan"], kept["machine"]
        self.rows = {f"{row['axis']} {row['value']}".rstrip(): row for row in kept["points"]}

    def _read(self) -> dict[str, Any]:
        try:
            kept = json.loads(self.path.read_text())
            if not all(isinstance(kept[name], dict) for name in ("settings", "plan", "machine")):
                raise ValueError("parts are missing")
            for number, row in enumerate(kept["points"], 1):
                _check_row(number, row)
            _check_rest(kept)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise WrongUse(
                f"--out: expected results of `foldgauss tradeoff` in {self.path}, got something else ({error}). "
                "Choose another folder, or start over with --overwrite."
            ) from error
        return kept

    def save(self) -> None:
        kept = {"settings": self.settings, "machine": self.machine, "plan": self.plan}
        kept |= {"left_out": self.left_out, "fronts": self.fronts}
        kept |= {"points": list(self.rows.values())}
        write_or_keep(self.path, lambda path: write_json(path, kept))


#: The type of each column, and a function that checks it.
_TEXT = "a text", lambda value: isinstance(value, str)
_NUMBER = "a number", lambda value: is_within(value, "(-inf, inf)")
_SECONDS = "a number >= 0", lambda value: is_within(value, "[0, inf)")
_COUNT = "a whole number >= 0", lambda value: is_integer(value, 0)
_CELLS: dict[str, tuple[str, Callable[[object], bool]]] = {
    "axis": _TEXT,
    "value": _TEXT,
    "settings": ("settings by name", lambda value: isinstance(value, dict)),
    "psnr": _NUMBER,
    "ssim": _NUMBER,
    "seconds": _SECONDS,
    "cpu_seconds": _SECONDS,
    "bytes": ("a whole number >= 1", lambda value: is_integer(value, 1)),
    "floats": _COUNT,
    "gaussians": _COUNT,
    "frames_per_second": ("a number > 0", lambda value: is_within(value, "(0, inf)")),
    "command": _TEXT,
}


def _check_row(number: int, row: object) -> None:
    """Raise ValueError, with the names of row and column, for an invalid value."""
    if not isinstance(row, dict):
        raise ValueError(f"row {number}: {short_repr(row)}")
    named = isinstance(row.get("axis"), str) and isinstance(row.get("value"), str)
    name = f"row {number}" + (f", {row['axis']} {row['value']}".rstrip() if named else "")
    for column, (expected, holds) in _CELLS.items():
        if column not in row:
            raise ValueError(f"{name}: no {column!r}")
        if not holds(row[column]):
            raise ValueError(f"{name}: {column!r} should be {expected}, not {short_repr(row[column])}")


def _check_rest(kept: dict[str, Any]) -> None:
    """Check the other values that are used: the steps of the base, the seconds of its motion, the cores."""
    plan, motion = kept["plan"], kept["plan"].get("motion", {"wall": 0.0, "cpu": 0.0})
    if plan and not is_integer(plan.get("steps"), 1):
        raise ValueError(f"plan: 'steps' should be a whole number >= 1, not {short_repr(plan.get('steps'))}")
    known = isinstance(motion, dict) and motion.keys() == {"wall", "cpu"}
    if not known or not all(is_within(value, "[0, inf)") for value in motion.values()):
        raise ValueError(f"plan: 'motion' should be seconds, 'wall' and 'cpu', not {short_repr(motion)}")
    if not is_within(kept["machine"].get("cores"), "(0, inf)"):
        raise ValueError(f"machine: 'cores' should be a number > 0, not {short_repr(kept['machine'].get('cores'))}")


def suffix_of(config: FitConfig) -> str:
    """The extension of the file of a fit's model."""
    return COMPACT_SUFFIX if config.is_compact else MODEL_SUFFIX


@dataclasses.dataclass(frozen=True)
class Commands:
    """The command lines that reproduce points, to be run from the current folder."""

    video: Path
    size: str | None
    frames: str | None
    folder: Path
    reading: Reading = AS_STORED

    def format_point(self, point: Point) -> str:
        """The command that fits the model of `point`, or evaluates that of the base."""
        if point.played is not None:
            constants = _changed(point.played, point.config.options, RENDER_OPTIONS)
            return shlex.join(["foldgauss", "evaluate", str(self.folder / BASE), str(self.video), *constants])
        name = point.name.replace(", ", "-").replace(" ", "-").replace("/", "_")
        words = ["fit", str(self.video), "--out", f"{name}{suffix_of(point.config)}"]
        words += [] if self.size is None else ["--size", self.size]
        words += [] if self.frames is None else ["--frames", self.frames]
        words += [f"--{name}={value}" for name, value in self.reading.changed.items()]
        default = FitConfig()
        words += _changed(point.config, default, FIT_OPTIONS)
        words += _changed(point.config.options, default.options, RENDER_OPTIONS)
        return shlex.join(["foldgauss", *words])


def _changed(now: FitConfig | RenderOptions, before: FitConfig | RenderOptions, options: dict[str, str]) -> list[str]:
    """Options for all fields that differ."""
    values, others = settings_by_name(now), settings_by_name(before)
    changed = [name for name in values if name != "options" and values[name] != others[name]]
    return list(itertools.chain.from_iterable(_words(name, values[name], options) for name in changed))


def _words(name: str, value: Any, options: dict[str, str]) -> list[str]:
    on, _, off = options[name].partition("/")
    return [on if value else off] if off else [on, str(value)]


def changed_settings(point: Point, base: FitConfig) -> dict[str, Any]:
    """Every setting that differs from the base."""
    before = settings_by_name(base)
    changed = {
        name: value
        for name, value in settings_by_name(point.config).items()
        if name != "options" and value != before[name]
    }
    options = point.config.options if point.played is None else point.played
    word = "fitted" if point.played is None else "played"
    return changed | {
        f"{field.name} ({word})": getattr(options, field.name)
        for field in dataclasses.fields(options)
        if getattr(options, field.name) != getattr(base.options, field.name)
    }


def report(record: Record, made: list[Point], skipped: list[Skipped], clock: str) -> None:
    """Write and print the Pareto fronts and their knees."""
    rows, folder = [record.rows[point.name] for point in made], record.path.parent
    names = [point.name for point in made]
    panels, columns = [], {"time": CLOCKS[clock], "size": "bytes", "speed": "frames_per_second"}
    for cost, (what, label, more_is_better) in COSTS.items():
        amounts = [row[columns[cost]] for row in rows]
        costs = [1 / amount if more_is_better else amount for amount in amounts]
        quality = [row["psnr"] for row in rows]
        chosen = pareto_front(costs, quality)
        place = knee([costs[k] for k in chosen], [quality[k] for k in chosen])  # on the front
        at = None if place is None else chosen[place]
        text = label.replace("(s)", "(CPU seconds)") if columns[cost] == "cpu_seconds" else label
        panels.append(Panel(text, amounts, chosen, at))
        record.fronts[cost] = {
            "what": what,
            "column": columns[cost],
            "front": [names[k] for k in chosen],
            "knee": None if at is None else names[at],
        }
    record.left_out = {one.name: one.why for one in skipped}
    record.save()
    _write_csv(folder / ROWS, rows, record.fronts)
    try:
        write_tradeoff(
            folder / PLOT, panels, [row["psnr"] for row in rows], [(point.axis, point.value) for point in made]
        )
    except ImportError as error:
        warn(f"no plot in {folder / PLOT}: {error}")
    _print_rows(rows, record.fronts, CLOCKS[clock])
    _print_fronts(rows, names, record.fronts)


def _write_csv(path: Path, rows: list[dict[str, Any]], fronts: dict[str, Any]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS)
    writer.writeheader()
    for row in rows:
        name = f"{row['axis']} {row['value']}".rstrip()
        settings = "; ".join(f"{key}={value}" for key, value in row["settings"].items())
        on = [cost for cost in COSTS if name in fronts[cost]["front"]]
        knees = [cost for cost in COSTS if name == fronts[cost]["knee"]]
        writer.writerow(row | {"settings": settings, "front": " ".join(on), "knee": " ".join(knees)})
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), newline="")


def _print_rows(rows: list[dict[str, Any]], fronts: dict[str, Any], clock: str) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("point", no_wrap=True)
    for name in ("dB", "SSIM", "fit s" if clock == "seconds" else "CPU s", "kB", "fps"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("front", no_wrap=True)
    for row in rows:
        name = f"{row['axis']} {row['value']}".rstrip()
        figures = f"{row['psnr']:.2f}", f"{row['ssim']:.4f}", f"{row[clock]:.1f}", f"{row['bytes'] / 1000:,.0f}"
        marks = [cost for cost in COSTS if name in fronts[cost]["front"]]
        table.add_row(name, *figures, f"{row['frames_per_second']:.0f}", " ".join(marks))
    out.print(table)


def _print_fronts(rows: list[dict[str, Any]], names: list[str], fronts: dict[str, Any]) -> None:
    units = {"seconds": "{:.1f} s", "cpu_seconds": "{:.1f} CPU seconds", "bytes": "{:,} bytes"}
    units |= {"frames_per_second": "{:.0f} frames per second"}
    for cost, (what, *_) in COSTS.items():
        name, column = fronts[cost]["knee"], fronts[cost]["column"]
        if name is None:
            out.print(
                f"PSNR against {what}: no knee; the Pareto front is {'; '.join(fronts[cost]['front'])}", soft_wrap=True
            )
            continue
        row = rows[names.index(name)]
        figure = units[column].format(row[column])
        out.print(f"PSNR against {what}: the knee is {name}, {row['psnr']:.2f} dB with {figure}", soft_wrap=True)
    on = {name for cost in COSTS for name in fronts[cost]["front"]}
    out.print("Commands of the points on the Pareto fronts:")
    for name, row in zip(names, rows, strict=True):
        if name in on:
            out.print(f"  {name}: {row['command']}", soft_wrap=True)
