"""The type of commands: their help has examples, errors about parameters name the options, choices are completed."""

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import typer.core
from rich.console import Console
from rich.markup import escape

from foldgauss._runtime.checks import ParameterError
from foldgauss.cli.app.registry import EXAMPLES


class WrongUse(ParameterError):
    """An argument of the command is invalid; `parameter` is the option or the argument as the user types it."""


class WithExamples:
    """Mixin of a command or a group whose help has examples."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        # Brackets are not markup here, and the source lines of paragraphs are joined.
        paragraphs = inspect.cleandoc(self.help or "").split("\n\n")
        self.help = escape("\n\n".join(" ".join(one.split()) for one in paragraphs))
        for parameter in self.params:
            if getattr(parameter, "help", None):
                parameter.help = escape(parameter.help)

    def format_help(self, ctx, formatter) -> None:
        from typer import rich_utils  # only here: it imports a Markdown parser

        rich_utils.rich_format_help(obj=self, ctx=ctx, markup_mode="rich")
        console = Console(markup=False, highlight=False)
        console.print(" Examples", style="bold")
        for purpose, line in EXAMPLES[ctx.command_path.partition(" ")[2]].items():
            console.print(f"   {purpose}:", style="dim")
            console.print(f"     {line}", style="cyan", soft_wrap=True)


class Command(WithExamples, typer.core.TyperCommand):
    """A command whose help has examples. It raises WrongUse for invalid values of its options and arguments."""

    def invoke(self, ctx) -> Any:
        try:
            return super().invoke(ctx)
        except ParameterError as error:
            name = self._name_as_typed(error.parameter)
            if name is None:
                raise
            raise WrongUse(name, error.problem) from error

    def _name_as_typed(self, parameter: str) -> str | None:
        """The option or argument of this name, as --gaussians for `num_gaussians`; None for another parameter."""
        if parameter.startswith("--"):
            return parameter
        for own in self.params:
            shown = own.opts[0] if own.param_type_name == "option" else own.metavar or own.name.upper()
            if parameter.rpartition(".")[2] in (own.name, shown, shown.lstrip("-").replace("-", "_")):
                return shown
        return None


def complete_choice(choices: Iterable[str]) -> Callable[[str], list[str]]:
    """Shell completion of one of the choices. Names of files are completed by the shell itself."""
    return lambda incomplete: [name for name in choices if name.startswith(incomplete)]
