"""Options of the commands that fit: generated from the settings of `FitConfig`, and those of running a fit."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from typing import Annotated, Any

import typer

from foldgauss._runtime.checks import require
from foldgauss._runtime.settings import setting_of, settings_by_name, type_of, walk
from foldgauss._runtime.threads import available_cores
from foldgauss.cli.app.help import complete_choice
from foldgauss.cli.shared.console import format_count
from foldgauss.jobs import local_workers, running_cluster
from foldgauss.video.fitting.config import BUDGET, MODEL, OPTIMIZATION, PRESETS, FitConfig

#: Panels of `fit --help`, by group of settings.
PANELS = {MODEL: "Model", BUDGET: "Budgets: the first that is reached ends the fit", OPTIMIZATION: "Optimization"}
PROGRESS = "Progress and checkpoints"
WORKERS = "Workers"

Preset = Annotated[
    str,
    typer.Option(
        help=f"Preset that other options modify: {', '.join(PRESETS)} (as published, slow).",
        autocompletion=complete_choice(PRESETS),
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print only warnings and errors.", rich_help_panel=PROGRESS)]
LogJson = Annotated[
    bool,
    typer.Option("--log-json", help="Print progress and results as lines of JSON.", rich_help_panel=PROGRESS),
]
SegmentSeconds = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        help="Fit segments of about S seconds, each with these budgets [default: 10 with workers].",
        rich_help_panel=WORKERS,
    ),
]
CheckpointSeconds = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        help="Seconds between two checkpoints, the most that a kill loses [default: 30].",
        hidden=True,
        min=0.0,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Number of parallel processes on this machine (needs the extra `distributed`).",
        rich_help_panel=WORKERS,
        min=1,
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="A running dask scheduler, as tcp://host:8786, with the same folders.",
        rich_help_panel=WORKERS,
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Threads per worker on this machine [default: an equal part of the cores].",
        rich_help_panel=WORKERS,
        min=1,
    ),
]


#: The settings of a fit that have an option: the field's name, which is that of the command's parameter, the name in
#: `FitConfig`, and the field.
SETTINGS = {field.name: (name, field) for name, field, _ in walk(FitConfig) if setting_of(field).option}
#: Options that help does not show, since few need them: docs/fit.md lists them.
RARE = {
    "power",
    "compositing",
    "batch_size",
    "error_fraction",
    "ssim_fraction",
    "interpolation_fraction",
    "interpolation_end",
}
#: How help writes the values of settings.
_METAVARS = {int: "N", float: "X", str: "NAME"}


@dataclasses.dataclass(frozen=True)
class WorkerOptions:
    """What runs jobs: `workers` of this machine with `threads` each, those of a `scheduler`, or this process.

    Raises ParameterError for options that exclude each other.
    """

    workers: int | None
    scheduler: str | None
    threads: int | None

    def __post_init__(self) -> None:
        require(
            self.scheduler is None or (self.workers is None and self.threads is None),
            "--workers" if self.workers is not None else "--threads",
            expected="no --scheduler, which has workers of its own",
            got="both",
            cure="Leave one out.",
        )
        require(
            self.threads is None or self.workers is not None,
            "--threads",
            expected="--workers too",
            got="--threads alone",
            cure="For this process: FOLDGAUSS_NUM_THREADS.",
        )
        require(
            (self.workers is None and self.scheduler is None) or find_spec("distributed") is not None,
            "--workers" if self.scheduler is None else "--scheduler",
            expected="dask.distributed",
            got="none",
            cure="Install it: pip install 'foldgauss[distributed]'.",
        )
        if self.workers is not None and self.threads is None:
            object.__setattr__(self, "threads", max(1, available_cores() // self.workers))

    def __str__(self) -> str:
        if self.scheduler is not None:
            return f"the workers of {self.scheduler}"
        if self.workers is None:
            return "this process"
        return f"{format_count(self.workers, 'worker')} of {format_count(self.threads, 'thread')}"

    def open_client(self) -> AbstractContextManager[Any]:
        """The workers; None for this process."""
        if self.scheduler is not None:
            return running_cluster(self.scheduler)
        return nullcontext() if self.workers is None else local_workers(self.workers, threads=self.threads)


def config_from_options(preset: str, **options: Any) -> FitConfig:
    """The configuration that options, by the names of settings, come to; None leaves the preset's value."""
    given = {SETTINGS[parameter][0]: value for parameter, value in options.items() if value is not None}
    return FitConfig.preset(preset, **given)


def fit_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command, instead of its parameter `config`, an option for each setting of a fit.

    The options are generated from the metadata of `FitConfig`; the command is called with the `FitConfig` that
    `config_from_options` makes of them.
    """
    options = [
        inspect.Parameter("preset", _KIND, default="standard", annotation=Preset),
        *(_option(name, field) for name, field in SETTINGS.values()),
    ]
    own = list(inspect.signature(command).parameters.values())
    at = [parameter.name for parameter in own].index("config")

    @functools.wraps(command)
    def with_config(**values: Any) -> None:
        config = config_from_options(**{option.name: values.pop(option.name) for option in options})
        command(**values, config=config)

    parameters = [*own[:at], *options, *own[at + 1 :]]
    with_config.__signature__ = inspect.Signature(parameters)
    with_config.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_config


_KIND = inspect.Parameter.POSITIONAL_OR_KEYWORD


def _option(name: str, field: dataclasses.Field) -> inspect.Parameter:
    """The parameter of a command for one setting."""
    about = setting_of(field)
    option = typer.Option(
        about.option,
        help=f"{about.help}{_default(name, field)}.",
        metavar=_METAVARS.get(type_of(field)),
        hidden=field.name in RARE,
        rich_help_panel=PANELS[about.group],
        autocompletion=complete_choice(about.choices) if about.choices else None,
    )
    return inspect.Parameter(field.name, _KIND, default=None, annotation=Annotated[type_of(field) | None, option])


def _default(name: str, field: dataclasses.Field) -> str:
    """The default in brackets, followed by those of presets that change it; nothing for None without a meaning."""
    default = setting_of(field).unset if field.default is None else _text(field.default)
    presets = {preset: _text(settings_by_name(FitConfig(**changes))[name]) for preset, changes in PRESETS.items()}
    changed = [f"{preset}: {value}" for preset, value in presets.items() if value not in (default, "None")]
    return f" [default: {'; '.join([default, *changed])}]" if default else ""


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else f"{value}"
