"""The command `tradeoff`: its results and the commands that reproduce them."""

import dataclasses
import json
import shlex
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from foldgauss import __version__
from foldgauss._runtime.checks import ParameterError, check_within, invalid, require
from foldgauss._runtime.machine import describe_machine
from foldgauss._runtime.settings import setting_of, settings_by_name, walk
from foldgauss.analysis.plot import Panel, plot_tradeoff
from foldgauss.cli.app.application import command, err, out, warn
from foldgauss.cli.fitting.job_progress import run_jobs
from foldgauss.cli.shared.arguments import Frames, NewClip, Size, parse_frames, parse_size
from foldgauss.cli.shared.console import choose_display, show_status, write_json
from foldgauss.cli.shared.files import make_folder, name_after, refuse_foreign
from foldgauss.io._atomic import lock_output, write_or_keep
from foldgauss.io.figures import write_figure
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.reading import read_video
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX, load_video_model
from foldgauss.io.provenance import fingerprint
from foldgauss.jobs import FitJob, Outcome
from foldgauss.render import RenderOptions
from foldgauss.video.fitting.config import TYPICAL_LIFETIME, FitConfig, chosen_num_gaussians, planned_steps
from foldgauss.video.fitting.initialize import measure_lifetime
from foldgauss.video.fitting.loop import finish, fit_steps
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.motion.optical_flow import Motion
from foldgauss.video.tradeoff import (
    AXES,
    LEAST_STEPS,
    Point,
    Throughput,
    check_axes,
    estimate_seconds,
    estimate_steps,
    knee,
    measure_frame_rate,
    measure_frame_seconds,
    pareto_front,
    plan_points,
)

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


def open_record(path: Path, settings: dict[str, Any], *, restart: bool = False) -> dict[str, Any]:
    """The results to be written to `path`: the settings, the machine, the plan and, in the end, a row for each measured
    point by its name.

    Machine and plan are those in `path`, unless `restart`. The fits have records of their own, so that finished ones
    are not repeated. Raises ParameterError if `path` has results of other settings or is not a record.
    """
    record = {"settings": settings, "machine": describe_machine()}
    record |= {name: {} for name in ("plan", "left_out", "fronts", "points")}
    if restart or not path.exists():
        return record
    cure = "Choose another folder, or start over with --overwrite."
    try:
        kept = json.loads(path.read_text())
        before, known = dict(kept["settings"]), {name: dict(kept[name]) for name in ("plan", "machine")}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise invalid(
            "--out", expected=f"results of `foldgauss tradeoff` in {path}", got=f"something else ({error})", cure=cure
        ) from error
    changed = sorted(name for name in settings if before.get(name) != settings[name])
    if changed:
        text = ", ".join(f"{name} was {before.get(name)!r}, is {settings[name]!r}" for name in changed)
        raise ParameterError("--out", f"{path} holds results of other settings: {text}. {cure}")
    return record | known


def save_record(path: Path, record: dict[str, Any]) -> None:
    kept = record | {"points": list(record["points"].values())}
    write_or_keep(path, lambda path: write_json(path, kept))


def file_name(point: Point) -> str:
    """The name of the file of a point's model."""
    suffix = COMPACT_SUFFIX if point.config.is_compact else MODEL_SUFFIX
    return point.name.replace(", ", "-").replace(" ", "-").replace("/", "_") + suffix


def format_command(video: Path, size: str | None, frames: str | None, folder: Path, point: Point) -> str:
    """The command line that fits the model of `point`, or evaluates that of the base, from the current folder."""
    if point.played is not None:
        words = ["evaluate", str(folder / MODELS / f"base{MODEL_SUFFIX}"), str(video)]
        return shlex.join(["foldgauss", *words, *_options(point.played, point.config.options)])
    default, words = FitConfig(), ["fit", str(video), "--out", file_name(point)]
    for option, value in (("--size", size), ("--frames", frames)):
        words += [] if value is None else [option, value]
    words += [*_options(point.config, default), *_options(point.config.options, default.options)]
    return shlex.join(["foldgauss", *words])


def _options(now: FitConfig | RenderOptions, before: FitConfig | RenderOptions) -> list[str]:
    """Command-line options for all fields that differ."""
    fields, words = {name: field for name, field, _ in walk(now)}, []
    for name, value in _changed(now, before).items():
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


def report(folder: Path, record: dict[str, Any], made: list[Point]) -> None:
    """Write and print the Pareto fronts and their knees."""
    names, fronts = [point.name for point in made], record["fronts"]
    rows = [record["points"][name] for name in names]
    quality, panels = [row["psnr"] for row in rows], []
    for name, cost in COSTS.items():
        amounts = [row[cost.column] for row in rows]
        costs = [1 / amount if cost.more_is_better else amount for amount in amounts]
        front = pareto_front(costs, quality)
        place = knee([costs[k] for k in front], [quality[k] for k in front])  # on the front
        at = None if place is None else front[place]
        panels.append(Panel(cost.label, amounts, front, at))
        fronts[name] = {"what": cost.what, "column": cost.column, "front": [names[k] for k in front]}
        fronts[name]["knee"] = None if at is None else names[at]
    save_record(folder / RECORD, record)
    points = [(point.axis, point.value) for point in made]
    try:
        write_figure(
            folder / PLOT,
            lambda figure: plot_tradeoff(panels, quality, points, figure.subplots(1, len(panels), sharey=True)),
            (5.5 * len(panels), 6.5),
        )
    except ImportError as error:
        warn(f"no plot in {folder / PLOT}: {error}")
    marks = [[cost for cost in COSTS if name in fronts[cost]["front"]] for name in names]
    _print_rows(rows, names, marks)
    for name, cost in COSTS.items():
        at, text = fronts[name]["knee"], f"no knee; the Pareto front is {'; '.join(fronts[name]['front'])}"
        if at is not None:
            row = record["points"][at]
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
    clip = read_video(video, frames=parse_frames(frames), size=parse_size(size))
    for text in clip.notes:
        warn(f"{clip.source}: {text}")
    make_folder(out_dir)
    context.with_resource(lock_output(out_dir / RECORD, own=(out_dir / PLOT,), what="tradeoff"))
    make_folder(out_dir / MODELS)
    settings = {"axes": list(chosen), "minutes": None if steps else minutes, "steps": steps, "seed": seed}
    source = fingerprint(clip)
    record = open_record(out_dir / RECORD, settings | {"version": __version__} | source, restart=overwrite)
    base = _plan_base(clip, record, wanted, chosen, minutes, steps)
    save_record(out_dir / RECORD, record)
    points, skipped = plan_points(base, chosen, clip.num_frames, has_alpha=clip.has_alpha)
    for one in skipped:
        record["left_out"][one.name] = one.why
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
            source=source,
        )
        for name, point in fits.items()
    ]
    if overwrite:
        for job in jobs:
            for path in (Path(job.target), job.record, job.checkpoint):
                path.unlink(missing_ok=True)
    outcomes = run_jobs(jobs, "points", choose_display(), None, overwrite=overwrite)
    for outcome in outcomes:
        if outcome.failure is not None:
            require(outcome.job.name != "base", "base", expected="a fit of the base", got=outcome.failure)
            record["left_out"][outcome.job.name] = outcome.failure
            err.print(f"{outcome.job.name} is left out: {outcome.failure}", soft_wrap=True)
    with show_status("Measuring"):
        _measure(points, base, {outcome.job.name: outcome for outcome in outcomes}, clip, record)
    made = [point for point in points if point.name in record["points"]]
    for point in made:
        record["points"][point.name]["command"] = format_command(video, size, frames, out_dir, point)
    report(out_dir, record, made)


def _plan_base(
    clip: Clip, record: dict[str, Any], wanted: FitConfig, axes: tuple[str, ...], minutes: float, steps: int | None
) -> FitConfig:
    """Choose the number of steps that the minutes allow; measures the throughput unless it is recorded."""
    if not record["plan"]:
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
        record["plan"] = {"num_gaussians": num, "steps": chosen, "pace": throughput._asdict()}
        record["plan"]["expected_minutes"] = round(expected, 2)
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
    return dataclasses.replace(wanted, **{name: record["plan"][name] for name in ("num_gaussians", "steps")})


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


def _measure(
    points: list[Point], base: FitConfig, outcomes: dict[str, Outcome], clip: Clip, record: dict[str, Any]
) -> None:
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
        record["points"][point.name] = {
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
