"""The options of fits, which `fit` and `fit-many` share, and the settings that they come to."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from foldgauss.cli.app.application import WrongUse, as_option, err
from foldgauss.cli.app.completion import among
from foldgauss.cli.app.shared import with_constants
from foldgauss.cli.fitting.progress import Manner
from foldgauss.render import COMPOSITINGS
from foldgauss.video.fitting.config import FIT_ENGINES, ON_DIVERGENCE, PRESETS, FitConfig
from foldgauss.video.fitting.economy import Economy

#: Panels of `fit --help`.
MODEL, BUDGET, COURSE = "What is fitted", "When it ends: the first of these", "How it is fitted"
WATCHED = "Watching a fit, going on with it"
WORK = "Who does it"

Preset = Annotated[
    str,
    typer.Option(
        help=f"Recipe that other options change: {', '.join(PRESETS)} (slow: the published one).",
        autocompletion=among(PRESETS),
    ),
]
Gaussians = Annotated[
    int | None,
    typer.Option(
        help="Number of Gaussians at the start [default: by the preset, or the clip's size and length].",
        rich_help_panel=MODEL,
    ),
]
MaxGaussians = Annotated[
    int | None, typer.Option(help="Largest number of Gaussians, grown or not.", rich_help_panel=MODEL)
]
UseEconomy = Annotated[
    bool,
    typer.Option(
        "--economy",
        help="Keep only what saves more bits than it takes: Gaussians, powers, colours.",
        rich_help_panel=MODEL,
    ),
]
SmallestAtPsnr = Annotated[
    float | None,
    typer.Option(
        "--smallest-at-psnr",
        help="The smallest model whose mean PSNR is this, in dB; takes its time.",
        rich_help_panel=MODEL,
    ),
]
MaxSizeMb = Annotated[
    float | None,
    typer.Option(
        "--max-size-mb",
        help="Largest model file, in 10^6 bytes; limits the Gaussians.",
        rich_help_panel=MODEL,
    ),
]
Degree = Annotated[
    int | None,
    typer.Option(help="Degree of the fold polynomial [default: 3; draft: 2; paper: 7].", rich_help_panel=MODEL),
]
Steps = Annotated[
    int | None,
    typer.Option(
        help="Optimiser steps [default: 3000, more for long clips; draft: 800; paper: 30000].",
        rich_help_panel=BUDGET,
    ),
]
Minutes = Annotated[float | None, typer.Option(help="Time to fit for.", rich_help_panel=BUDGET)]
TargetPsnr = Annotated[
    float | None,
    typer.Option("--target-psnr", help="Stop once the mean PSNR of the frames is this, in dB.", rich_help_panel=BUDGET),
]
BatchSize = Annotated[int | None, typer.Option(help="Frames per step [default: 1; paper: 3].", rich_help_panel=COURSE)]
Power = Annotated[
    float | None,
    typer.Option(
        help="Power of the envelope a(t): 1 as in the paper's text, 2 as in its code [default: 1; paper: 2].",
        rich_help_panel=MODEL,
    ),
]
Compositing = Annotated[
    str | None,
    typer.Option(
        help="Blend of the Gaussians: over (front to back) or sum [default: over].",
        rich_help_panel=MODEL,
        autocompletion=among(COMPOSITINGS),
    ),
]
BetweenShare = Annotated[
    float | None,
    typer.Option(
        help="Share of the steps that learn what lies between frames, for slow motion, as 0.5 [default: 0].",
        rich_help_panel=COURSE,
    ),
]
SsimShare = Annotated[
    float | None,
    typer.Option(help="Share of D-SSIM in the loss, the rest being L1 [default: 0.2].", rich_help_panel=COURSE),
]
QuarterShare = Annotated[
    float | None,
    typer.Option(
        help="Share of the steps with frames at a quarter of their size [default: 0.2].", rich_help_panel=COURSE
    ),
]
HalfShare = Annotated[
    float | None,
    typer.Option(help="Share of the steps with frames at half of their size [default: 0.4].", rich_help_panel=COURSE),
]
Engine = Annotated[
    str,
    typer.Option(
        help="What computes the steps: cpu, or on a GPU xla or pallas; auto: cpu unless there is a GPU.",
        rich_help_panel=COURSE,
        autocompletion=among(FIT_ENGINES),
    ),
]
Seed = Annotated[
    int, typer.Option(help="Seed of the random starts and of the order of frames.", rich_help_panel=COURSE)
]
OnDivergence = Annotated[
    str,
    typer.Option(
        help="If the fit comes apart: back-off (to sound numbers, at lower rates) or stop.",
        rich_help_panel=COURSE,
        autocompletion=among(ON_DIVERGENCE),
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say nothing but warnings and errors.", rich_help_panel=WATCHED)]
LogJson = Annotated[
    bool,
    typer.Option("--log-json", help="Tell progress and figures as lines of JSON.", rich_help_panel=WATCHED),
]


SegmentSeconds = Annotated[
    float | None,
    typer.Option(
        help="Fit in segments of about so many seconds, each with these budgets [default: 10 with workers, else none].",
        rich_help_panel=WORK,
    ),
]
CheckpointSeconds = Annotated[
    float | None,
    typer.Option(
        help="Seconds between two checkpoints, the most that a kill costs [default: 30].",
        rich_help_panel=WATCHED,
        min=0.0,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        help="Processes of this machine that work side by side (needs the extra `distributed`).",
        rich_help_panel=WORK,
        min=1,
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="A running dask scheduler, as tcp://host:8786, whose workers see the same folders.",
        rich_help_panel=WORK,
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        help="Threads of each worker of this machine [default: its share of the cores].", rich_help_panel=WORK, min=1
    ),
]

#: Options that are fields of `FitConfig`, by their own name or another.
_FIELDS = {
    "gaussians": "num_gaussians",
    **{
        name: name
        for name in (
            *("max_gaussians", "degree", "steps", "minutes", "target_psnr", "max_size_mb", "batch_size", "power"),
            *(
                "compositing",
                "interpolation_fraction",
                "ssim_fraction",
                "quarter_fraction",
                "half_fraction",
                "on_divergence",
                "engine",
            ),
            "seed",
        )
    },
}


def config_of(given: Mapping[str, Any]) -> FitConfig:
    """The settings that a command's parameters, by name, come to. Raises WrongUse for those that cannot be right."""
    changes = {field: given[name] for name, field in _FIELDS.items() if given[name] is not None}
    try:
        if given["economy"] or given["smallest_at_psnr"] is not None:
            changes["economy"] = Economy(psnr=given["smallest_at_psnr"])
        config = FitConfig.preset(given["preset"], **changes)
    except ValueError as error:
        raise WrongUse(as_option(str(error))) from error
    constants = {name: given[name] for name in ("alpha_cutoff", "support_radius", "transmittance_stop")}
    return dataclasses.replace(config, options=with_constants(config.options, **constants))


def manner_of(quiet: bool = False, log_json: bool = False) -> Manner:
    """How a fit is shown: as asked, else a bar on a terminal and lines in a log."""
    if quiet and log_json:
        raise WrongUse("--quiet: expected one of --quiet and --log-json, got both. Leave one out.")
    if quiet or log_json:
        return "quiet" if quiet else "json"
    return "bar" if err.is_terminal else "lines"
