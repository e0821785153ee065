"""The application: its commands, which are imported when one is called, its consoles and its errors."""

import functools
import importlib
import importlib.metadata
import platform
import re
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from foldgauss import __version__
from foldgauss._runtime.interrupts import use_default_signals
from foldgauss._runtime.threads import num_threads
from foldgauss.cli.app.help import Command, WithExamples
from foldgauss.cli.app.registry import COMMANDS

#: Control characters other than tab and newline, and those that change the writing direction.
_CONTROLS = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069]")
#: Packages whose versions `--version` shows, for reports of bugs.
_SHOWN = ("jax", "jaxlib", "numba", "numpy", "av")


class Stopped(Exception):
    """The user stopped a fit or a sampler; the message says how to continue."""


class _Root(WithExamples, typer.core.TyperGroup):
    """Lists all commands by name and first sentence, and imports a command when it is called.

    Importing a command loads JAX, Numba and OpenCV, which takes a second or two: too long for completion.
    """

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        listed = {name: Command(name=name, help=entry.summary) for name, entry in COMMANDS.items()}
        self.commands = listed | dict(self.commands)

    def resolve_command(self, ctx, args: list[str]) -> Any:
        self.commands |= load_commands(args[0])
        return super().resolve_command(ctx, args)


class _PlainConsole(Console):
    """A console that replaces control characters: some texts come from files of unknown origin."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(_CONTROLS.sub("\N{REPLACEMENT CHARACTER}", text), **options)


# Without markup errors stay on one line; `help` formats what is shown.
app = typer.Typer(cls=_Root, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
# Without markup and emoji codes, which file names may contain.
out = _PlainConsole(markup=False, emoji=False, highlight=False)
err = _PlainConsole(stderr=True, markup=False, emoji=False, highlight=False)


def command(name: str) -> Callable:
    """A decorator that makes a function the command of this name."""
    return app.command(name, cls=Command)


def warn(text: str) -> None:
    """Print a warning, on one line."""
    err.print(f"warning: {text}", soft_wrap=True)


def _show_version(wanted: bool) -> None:
    if wanted:
        versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _SHOWN)
        out.print(f"foldgauss {__version__}")
        out.print(f"Python {platform.python_version()}, {versions}; {num_threads()} threads", soft_wrap=True)
        raise typer.Exit


@app.callback()
def root(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            help="Show the versions of foldgauss and of what it computes with.",
            is_eager=True,
            callback=_show_version,
        ),
    ] = False,
) -> None:
    """Videos as mixtures of folded Gaussians: fit, render, evaluate, edit.

    `foldgauss COMMAND --help` describes a command, with examples.
    """


@functools.cache
def root_command() -> Any:
    """The application as one command, which is built once."""
    return typer.main.get_command(app)


@functools.cache
def load_commands(*names: str) -> dict[str, Any]:
    """The commands of these names, or all without names, imported and built. Unknown names are ignored."""
    known = [name for name in names or COMMANDS if name in COMMANDS]
    with use_default_signals():
        for name in known:
            importlib.import_module(f"foldgauss.cli.{COMMANDS[name].module}")
    commands = typer.main.get_command(app).commands
    return {name: commands[name] for name in known}
