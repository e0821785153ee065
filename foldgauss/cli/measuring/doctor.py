"""The command `doctor`."""

import json
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from foldgauss.cli.app.application import app, err, out
from foldgauss.cli.measuring.diagnosis import EXTRAS, NAME, Trial, collect_facts, run_trials

GREEN, RED, YELLOW = "green", "red", "yellow"


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON to standard output.")] = False,
) -> None:
    """Check the installation: versions, devices, and a small fit.

    It takes some seconds, more if kernels are compiled for the first time. The exit code is 0 if there are no problems;
    otherwise 1, and each problem is printed with its remedy.
    """
    found = collect_facts()
    if not as_json:
        _print_facts(found)
        out.print("\nTrials", style="bold")
    done = []
    with err.status("Running trials", spinner="dots") as status:
        for trial in run_trials():
            done.append(trial)
            if not as_json:
                _print_trial(trial)
            status.update(f"Running trials: {len(done)} done")
    problems = _problems(found, done)
    if as_json:
        text = {"well": not problems, "problems": problems, **found, "trials": [one._asdict() for one in done]}
        print(json.dumps(text, indent=2))
    else:
        _print_end(done, problems)
    if problems:
        raise typer.Exit(1)


def _problems(found: dict[str, Any], done: list[Trial]) -> list[str]:
    """Problems of this installation, with remedies. A missing extra is not a problem."""
    problems = [f"{one.name}: {one.message}. {one.cure}" for one in done if not one.ok]
    missing = [name for name, version in found["versions"].items() if version is None]
    if missing:
        problems.append(f"missing: {', '.join(missing)}. pip install --upgrade {NAME}")
    return problems


def _print_facts(found: dict[str, Any]) -> None:
    for title, rows in (
        ("Versions", _version_rows(found["versions"])),
        ("Extras", _extra_rows(found["extras"])),
        ("Machine", _machine_rows(found["machine"])),
        ("Rendering", _engine_rows(found["engines"])),
    ):
        out.print(f"\n{title}", style="bold")
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True, width=2)
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        for color, name, text in rows:
            table.add_row(_mark(color), name, text)
        out.print(table)


Row = tuple[str, str, str]


def _mark(color: str) -> Text:
    return Text({GREEN: "ok", RED: "no", YELLOW: "--"}[color], style=color)


def _version_rows(found: dict[str, str | None]) -> list[Row]:
    if "unknown" in found:  # as for sources that are not installed
        return [(YELLOW, "versions", str(found["unknown"]))]
    return [(GREEN if text else RED, name, text or "missing") for name, text in found.items()]


def _extra_rows(found: dict[str, Any]) -> list[Row]:
    rows = []
    for name, packages in found.items():
        if not isinstance(packages, dict):
            return [(YELLOW, name, str(packages))]
        there = ", ".join(f"{one} {version}" for one, version in packages.items() if version)
        missing = [one for one, version in packages.items() if version is None]
        cure = f"no {', '.join(missing)}: pip install '{NAME}[{name}]'" if missing else ""
        text = "; ".join(part for part in (there, cure) if part)
        rows.append((YELLOW if missing else GREEN, name, f"{EXTRAS.get(name, '')}: {text}".removeprefix(": ")))
    return rows


def _machine_rows(found: dict[str, Any]) -> list[Row]:
    if "unknown" in found:
        return [(RED, "machine", found["unknown"])]
    free = "" if found["memory_free_gib"] is None else f", {found['memory_free_gib']:g} free"
    clip = f"clips of up to {found['largest_clip_gib']:g} GiB fit"
    return [
        (GREEN, "system", found["system"]),
        (GREEN, "processor", f"{found['processor']} ({found['instructions']})"),
        (GREEN, "cores", f"{found['cores_usable']} usable of {found['cores_present']}"),
        (GREEN, "threads", f"{found['threads']}: {found['threads_because']}"),
        (GREEN, "memory", f"{found['memory_gib'] or '?'} GiB{free}; {clip}"),
    ]


def _engine_rows(found: dict[str, Any]) -> list[Row]:
    if "unknown" in found:
        return [(RED, "engines", found["unknown"])]
    seen = ", ".join(found["jax_devices"])
    accelerator = (
        f"JAX sees {seen}: engine xla renders there, and fits run there"
        if found["gpu"]
        else f"not visible to JAX ({seen})"
    )
    return [
        (GREEN, "engines", f"{', '.join(found['engines'])}; auto is {found['auto']}"),
        (GREEN if found["gpu"] else YELLOW, "GPU", accelerator),
    ]


def _print_trial(trial: Trial) -> None:
    compiled = f", {trial.first_seconds:.1f} s more the first time" if trial.first_seconds > 0.5 else ""
    line = Text.assemble(
        ("ok  " if trial.ok else "no  ", GREEN if trial.ok else RED),
        f"{trial.name:<34}{trial.message} ({trial.seconds:.2f} s{compiled})",
    )
    out.print(line, soft_wrap=True)


def _print_end(done: list[Trial], problems: list[str]) -> None:
    seconds, first = (sum(times) for times in zip(*((one.seconds, one.first_seconds) for one in done), strict=True))
    text = f"the trials took {seconds:.1f} s, and compilation {first:.1f} s more"
    if not problems:
        out.print(f"\nNo problems; {text}.", style=GREEN, soft_wrap=True)
        return
    out.print(f"\nProblems were found; {text}.", style=RED, soft_wrap=True)
    for problem in problems:
        out.print(f"  {problem}", soft_wrap=True)
