"""The command `tradeoff`."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from foldgauss import __version__
from foldgauss._runtime.checks import check_within, invalid, require
from foldgauss._runtime.machine import describe_machine
from foldgauss._runtime.settings import check_unchanged, flatten
from foldgauss.analysis.plot import Panel, plot_tradeoff
from foldgauss.cli.app.application import command, err, out, warn
from foldgauss.cli.fitting.job_progress import run_jobs
from foldgauss.cli.shared.arguments import Frames, NewClip, Size, parse_frames, parse_size
from foldgauss.cli.shared.console import choose_display, show_status, write_json
from foldgauss.cli.shared.files import make_folder, name_after, refuse_foreign
from foldgauss.io._atomic import lock_output, write_or_keep
from foldgauss.io.figures import write_figure
from foldgauss.io.media.clip import Clip
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.rendered_clip import read_clip_or_model
from foldgauss.io.models.video_model import MODEL_SUFFIX, load_video_model
from foldgauss.io.provenance import fingerprint
from foldgauss.jobs import FitJob, Outcome
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.tradeoff import AXES, Point, check_axes, knee, measure_frame_rate, pareto_front, plan_points

RECORD = "tradeoff.json"
PLOT = "tradeoff.png"
#: Folder of the models, with the records of their fits.
MODELS = "models"
FILES = {RECORD, PLOT, MODELS}
#: What quality is compared with: columns of the results, and their labels.
COSTS = {"seconds": "time to fit (s)", "bytes": "file (bytes)", "frame_seconds": "time to render a frame (s)"}
DEFAULT_MINUTES = 10.0


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
    minutes: Annotated[float, typer.Option(help="Time for all fits, about.")] = DEFAULT_MINUTES,
    steps: Annotated[
        int | None, typer.Option(help="Optimizer steps of the base fit, instead of --minutes.", min=1)
    ] = None,
    size: Size = None,
    frames: Frames = None,
    seed: Annotated[int, typer.Option(help="Seed of all fits.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Discard earlier results.")] = False,
) -> None:
    """Measure time, size and speed against quality, one setting at a time.

    Writes the results (tradeoff.json) and a plot (tradeoff.png); prints the Pareto fronts and their knees. The same
    command continues a stopped run. See docs/results.md.
    """
    chosen = tuple(AXES) if axes is None else check_axes([name.strip() for name in axes.split(",")])
    check_within("--minutes", minutes, "(0, inf)", "a number above 0")
    num_fits = 1 + sum(not variant.played for axis in chosen for variant in AXES[axis])
    base = Point("base", "", FitConfig(seed=seed, steps=steps, minutes=None if steps else minutes / num_fits))
    out_dir = name_after(video, "-tradeoff") if out_dir is None else out_dir
    path = out_dir / RECORD
    known = overwrite or path.exists()
    refuse_foreign(out_dir, FILES, "tradeoff", record=RECORD, known=known, cure=", or start over with --overwrite")
    clip = read_clip_or_model(video, frames=parse_frames(frames), size=parse_size(size))
    for text in clip.notes:
        warn(f"{clip.source}: {text}")
    make_folder(out_dir)
    context.with_resource(lock_output(path, own=(out_dir / PLOT,), what="tradeoff"))
    make_folder(out_dir / MODELS)
    settings = {"axes": list(chosen), "minutes": None if steps else minutes, "steps": steps, "seed": seed}
    settings |= {"version": __version__} | fingerprint(clip)
    if path.exists() and not overwrite:
        check_settings(path, settings)
    record = {"settings": settings, "machine": describe_machine(), "points": []}
    if overwrite or not path.exists():
        write_json(path, record)
    folder, span, source = out_dir.absolute() / MODELS, (parse_size(size), parse_frames(frames)), fingerprint(clip)

    def fit_all(points: list[Point], num_done: int = 0) -> dict[str, Outcome]:
        """The outcomes by name; `num_done` of the points were fitted by an earlier call."""
        jobs = [
            FitJob(p.name, str(video.absolute()), str(folder / _file_name(p)), p.config, *span, source=source)
            for p in points
        ]
        for job in jobs[num_done:] if overwrite else ():
            for file in (Path(job.target), job.record, job.checkpoint):
                file.unlink(missing_ok=True)
        return {one.job.name: one for one in run_jobs(jobs, "points", choose_display(), None, overwrite=overwrite)}

    done = fit_all([base])["base"]
    require(done.failure is None, "base", expected="a fit of the base", got=done.failure)
    numbers = {name: done.record[name] for name in ("num_gaussians", "steps")}
    if numbers["steps"] < len(clip.frames):
        warn(f"--minutes: {numbers['steps']} steps of each fit are too few for {len(clip.frames)} frames.")
    plain = dataclasses.replace(base.config, minutes=None, **numbers)
    points = plan_points(plain, chosen)
    outcomes = fit_all([base, *(point for point in points[1:] if not point.played)], num_done=1)
    left_out = {name: outcome.failure for name, outcome in outcomes.items() if outcome.failure is not None}
    for name, why in left_out.items():
        err.print(f"{name} is left out: {why}", soft_wrap=True)
    with show_status("Measuring"):
        rows = [_measure(point, plain, outcomes, clip) for point in points if point.name not in left_out]
    _report(out_dir, record | {"left_out": left_out, "points": rows})


def check_settings(path: Path, settings: dict[str, Any]) -> None:
    """Refuse to continue results of other settings, and files that are no results."""
    cure = "Choose another folder, or start over with --overwrite."
    try:
        before = {**json.loads(path.read_text())["settings"]}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        got = f"something else ({error})"
        raise invalid("--out", expected=f"results of `foldgauss tradeoff` in {path}", got=got, cure=cure) from error
    check_unchanged("--out", before, settings, cure)


def _file_name(point: Point) -> str:
    """The name of the file of a point's model."""
    suffix = COMPACT_SUFFIX if point.config.is_compact else MODEL_SUFFIX
    return point.name.replace(", ", "-").replace(" ", "-").replace("/", "_") + suffix


def _measure(point: Point, base: FitConfig, outcomes: dict[str, Outcome], clip: Clip) -> dict[str, Any]:
    """The row of a point: the results of its fit, and the speed of rendering."""
    fit = outcomes["base" if point.played else point.name]
    shown, quality = load_video_model(fit.job.target), (fit.record["mean_psnr"], fit.record["mean_ssim"])
    if point.played:
        shown = shown.with_options(point.config.options)
        scores = evaluate(shown, clip.frames)
        quality = round(scores.mean_psnr, 3), round(scores.mean_ssim, 4)
    before = flatten(dataclasses.asdict(base))
    return {
        "axis": point.axis,
        "value": point.value,
        "settings": {name: x for name, x in flatten(dataclasses.asdict(point.config)).items() if x != before.get(name)},
        "psnr": quality[0],
        "ssim": quality[1],
        "seconds": fit.record["seconds"],
        "bytes": fit.record["file_bytes"],
        "floats": shown.num_parameters,
        "gaussians": shown.num_gaussians,
        "frame_seconds": 1 / measure_frame_rate(shown),
    }


def _report(folder: Path, record: dict[str, Any]) -> None:
    """Write and print the rows, the Pareto fronts and their knees."""
    rows, panels = record["points"], []
    names, quality = [f"{row['axis']} {row['value']}".rstrip() for row in rows], [row["psnr"] for row in rows]
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for title in ("point", "dB", "SSIM", "fit s", "kB", "fps"):
        table.add_column(title, justify="left" if title == "point" else "right", no_wrap=True)
    for name, row in zip(names, rows, strict=True):
        scores = f"{row['psnr']:.2f}", f"{row['ssim']:.4f}", f"{row['seconds']:.1f}"
        table.add_row(name, *scores, f"{row['bytes'] / 1000:,.0f}", f"{1 / row['frame_seconds']:.0f}")
    out.print(table)
    record["fronts"] = {}
    for column, label in COSTS.items():
        cost = [row[column] for row in rows]
        front = pareto_front(cost, quality)
        place = knee([cost[k] for k in front], [quality[k] for k in front])  # on the front
        at = None if place is None else front[place]
        panels.append(Panel(label, cost, front, at))
        found = {"front": [names[k] for k in front], "knee": None if at is None else names[at]}
        record["fronts"][column] = found
        text = f"the knee is {found['knee']}" if found["knee"] else "no knee"
        out.print(f"PSNR against {label}: {text}; the Pareto front is {'; '.join(found['front'])}", soft_wrap=True)
    write_or_keep(folder / RECORD, lambda path: write_json(path, record))
    points = [(row["axis"], row["value"]) for row in rows]
    try:
        write_figure(
            folder / PLOT,
            lambda figure: plot_tradeoff(panels, quality, points, figure.subplots(1, len(panels), sharey=True)),
            (5.5 * len(panels), 6.5),
        )
    except ImportError as error:
        warn(f"no plot in {folder / PLOT}: {error}")
