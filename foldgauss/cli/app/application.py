"""The application: its list of commands, each imported when it is called, and what it says things with."""

import importlib
import re
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from foldgauss import __version__
from foldgauss._runtime.interrupts import use_default_signals
from foldgauss.cli.app.help import App, Command, Group
from foldgauss.cli.app.registry import COMMANDS

#: What a terminal obeys, but for tab and new line; and what turns the direction of writing.
_CONTROLS = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069]")


class WrongUse(ValueError):
    """The command was called with arguments that cannot be right."""


class Stopped(Exception):
    """The user asked a fit, or a sampler, to stop; the message says how to go on."""


class _Root(Group):
    """All commands by name and first sentence, which is what lists and the Tab key show; one that is called, whole.

    Whole they need JAX, Numba and OpenCV: a second or two, for a word that is completed.
    """

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        listed = {name: Command(name=name, help=known.what) for name, known in COMMANDS.items()}
        self.commands = listed | dict(self.commands)

    def list_commands(self, ctx) -> list[str]:
        return list(self.commands)

    def resolve_command(self, ctx, args: list[str]) -> Any:
        self.commands |= loaded(args[0])
        return super().resolve_command(ctx, args)


class _Plain(Console):
    """A console on which texts move no cursor and command no terminal: some come from the files of strangers."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(_CONTROLS.sub("\N{REPLACEMENT CHARACTER}", text), **options)


app = App(cls=_Root, no_args_is_help=True, pretty_exceptions_enable=False)
# No markup: names of files may hold brackets, and what is a code for a picture elsewhere.
out = _Plain(markup=False, emoji=False, highlight=False)
err = _Plain(stderr=True, markup=False, emoji=False, highlight=False)


def _show_version(wanted: bool) -> None:
    if wanted:
        out.print(f"foldgauss {__version__}")
        raise typer.Exit


@app.callback()
def root(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.", is_eager=True, callback=_show_version)
    ] = False,
) -> None:
    """Videos as mixtures of folded Gaussians: fit, render, evaluate, edit.

    `foldgauss COMMAND --help` tells all of a command, with examples.
    """
    del debug, version  # read by `main`, before typer runs, and by the callback


def loaded(*names: str) -> dict[str, Any]:
    """The commands by name, these imported, or all where none is named; there may be none of such a name."""
    with use_default_signals():
        for name in names or COMMANDS:
            if name in COMMANDS:
                importlib.import_module(f"foldgauss.cli.{COMMANDS[name].module}")
    return typer.main.get_command(app).commands


def as_option(text: str) -> str:
    """An error about a setting, as one about its option: num_gaussians is --gaussians."""
    name, colon, rest = text.partition(":")
    name = name.replace("num_gaussians", "gaussians").replace("economy.psnr", "smallest_at_psnr")
    return f"--{name.replace('_', '-')}{colon}{rest}"
