"""Help: options in panels, followed by examples."""

import inspect
from collections.abc import Callable
from typing import Any

import typer
import typer.core
from rich.console import Console
from rich.markup import escape

from foldgauss.cli.app.examples import EXAMPLES


class _WithExamples:
    """Mixin of a command or a group whose help has examples."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        _escape_help(self)

    def format_help(self, ctx, formatter) -> None:
        _show_help(self, ctx)


class Command(_WithExamples, typer.core.TyperCommand):
    """A command whose help has examples."""


class Group(_WithExamples, typer.core.TyperGroup):
    """A group of commands whose help has examples."""


class App(typer.Typer):
    """A Typer application whose commands have examples in their help."""

    def __init__(self, **options: Any):
        # Without markup errors stay on one line; help is formatted below.
        super().__init__(**({"cls": Group} | options), rich_markup_mode=None)

    def command(self, name: str | None = None, **options: Any) -> Callable:
        return super().command(name, **({"cls": Command} | options))


def _escape_help(command: "Command | Group") -> None:
    """Escape brackets, which are not markup here, and join the source lines of paragraphs."""
    paragraphs = inspect.cleandoc(command.help or "").split("\n\n")
    command.help = escape("\n\n".join(" ".join(one.split()) for one in paragraphs))
    for parameter in command.params:
        if getattr(parameter, "help", None):
            parameter.help = escape(parameter.help)


def _show_help(command: "Command | Group", ctx) -> None:
    from typer import rich_utils  # only here: it imports a Markdown parser

    rich_utils.rich_format_help(obj=command, ctx=ctx, markup_mode="rich")
    console = Console(markup=False, highlight=False)
    examples = EXAMPLES.get(ctx.command_path.partition(" ")[2], ())
    if examples:
        console.print(" Examples", style="bold")
    for example in examples:
        console.print(f"   {example.purpose}:", style="dim")
        console.print(f"     {example.line}", style="cyan", soft_wrap=True)
