"""Options of the commands that fit: generated from the settings of `FitConfig`, and those of running a fit."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from foldgauss._runtime.settings import setting_of, settings_by_name, type_of, walk
from foldgauss.cli.app.application import WrongUse, err, name_option
from foldgauss.cli.app.completion import complete_choice
from foldgauss.cli.fitting.progress import Display
from foldgauss.cli.shared.arguments import AlphaCutoff, SupportRadius, TransmittanceStop, override_constants
from foldgauss.video.fitting.config import BUDGET, MODEL, OPTIMIZATION, PRESETS, FitConfig

#: Panels of `fit --help`, by group of settings.
PANELS = {MODEL: "Model", BUDGET: "Budgets: the first that is reached ends the fit", OPTIMIZATION: "Optimization"}
PROGRESS = "Progress and checkpoints"
WORKERS = "Workers"

Preset = Annotated[
    str,
    typer.Option(
        help=f"Preset that other options modify: {', '.join(PRESETS)} (the published configuration, slow).",
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
        help="Fit segments of about this many seconds, each with these budgets [default: 10 with workers].",
        rich_help_panel=WORKERS,
    ),
]
CheckpointSeconds = Annotated[
    float | None,
    typer.Option(
        help="Seconds between two checkpoints, the most that a kill loses [default: 30].",
        rich_help_panel=PROGRESS,
        min=0.0,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        help="Number of parallel processes on this machine (needs the extra `distributed`).",
        rich_help_panel=WORKERS,
        min=1,
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="A running dask scheduler, such as tcp://host:8786, whose workers see the same folders.",
        rich_help_panel=WORKERS,
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        help="Threads per worker on this machine [default: an equal part of the cores].", rich_help_panel=WORKERS, min=1
    ),
]


def _parameter(option: str) -> str:
    """The name of an option as a parameter."""
    return option.split("/")[0].removeprefix("--").replace("-", "_")


#: The settings that have an option, by their names.
CONFIG_FIELDS = {name: field for name, field, _ in walk(FitConfig) if setting_of(field).option}
#: Their names by those of their options as parameters.
_NAMES = {_parameter(setting_of(field).option): name for name, field in CONFIG_FIELDS.items()}
_CONSTANTS = {
    "alpha_cutoff": AlphaCutoff,
    "support_radius": SupportRadius,
    "transmittance_stop": TransmittanceStop,
}


def config_from_options(preset: str, **options: Any) -> FitConfig:
    """The configuration that options, by the names of their parameters, come to; None leaves the preset's value.

    Raises WrongUse for values that are not valid.
    """
    given = {name: value for name, value in options.items() if value is not None}
    changes = {name: given[parameter] for parameter, name in _NAMES.items() if parameter in given}
    try:
        config = FitConfig.preset(preset, **changes)
    except ValueError as error:
        raise WrongUse(name_option(str(error))) from error
    constants = (options[name] for name in _CONSTANTS)
    return dataclasses.replace(config, options=override_constants(config.options, *constants))


def fit_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command, instead of its parameter `config`, an option for each setting of a fit.

    The options are generated from the metadata of `FitConfig`; the command is called with the `FitConfig` that
    `config_from_options` makes of them.
    """
    options = [
        inspect.Parameter("preset", _KIND, default="standard", annotation=Preset),
        *(_option(parameter, name) for parameter, name in _NAMES.items()),
        *(inspect.Parameter(name, _KIND, default=None, annotation=kind) for name, kind in _CONSTANTS.items()),
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


def _option(parameter: str, name: str) -> inspect.Parameter:
    """The parameter of a command for one setting."""
    field = CONFIG_FIELDS[name]
    about = setting_of(field)
    option = typer.Option(
        about.option,
        help=f"{about.help}{_default(name, field)}.",
        rich_help_panel=PANELS[about.group],
        autocompletion=complete_choice(about.choices) if about.choices else None,
    )
    return inspect.Parameter(parameter, _KIND, default=None, annotation=Annotated[type_of(field) | None, option])


def _default(name: str, field: dataclasses.Field) -> str:
    """The default in brackets, followed by those of presets that change it; nothing for None without a meaning."""
    default = setting_of(field).unset if field.default is None else _text(field.default)
    presets = {preset: _text(settings_by_name(FitConfig(**changes))[name]) for preset, changes in PRESETS.items()}
    changed = [f"{preset}: {value}" for preset, value in presets.items() if value not in (default, "None")]
    return f" [default: {'; '.join([default, *changed])}]" if default else ""


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else f"{value}"


def choose_display(quiet: bool = False, log_json: bool = False) -> Display:
    """How progress is displayed: as the options say, otherwise a bar on a terminal and lines in a log."""
    if quiet and log_json:
        raise WrongUse("--quiet: expected one of --quiet and --log-json, got both. Leave one out.")
    if quiet or log_json:
        return "quiet" if quiet else "json"
    return "bar" if err.is_terminal else "lines"
