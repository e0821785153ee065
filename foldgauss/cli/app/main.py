"""The command as a whole: which errors become which line and which exit code."""

import sys
import warnings

from foldgauss._runtime.interrupts import raise_on_sigterm
from foldgauss.cli.app.application import Stopped, WrongUse, app, as_option, err, loaded

WRONG_USE, FAILURE = 2, 1


def main(arguments: list[str] | None = None) -> None:
    """Run the command and exit: 0 fine, 2 wrong use, 1 failure, 143 for SIGTERM; one-line errors unless --debug."""
    with raise_on_sigterm():
        _run(arguments)


def _run(arguments: list[str] | None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments  # taken out, so that it may stand anywhere
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            app([argument for argument in arguments if argument != "--debug"], prog_name="foldgauss")
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            raise
        if isinstance(error, SystemError) and isinstance(error.__cause__, KeyboardInterrupt):
            error = error.__cause__  # Ctrl-C while a compiled kernel returned
        text = " ".join(str(error).split()) or type(error).__name__
        text = text.replace("allow overwriting", "add --overwrite")  # of folders
        option = as_option(text)
        if _names_an_option(text) and option.partition(":")[0] in arguments:
            text = option
        if not isinstance(error, ValueError | OSError | MemoryError | Stopped | KeyboardInterrupt):
            text = f"{type(error).__name__}: {text[:300]} (--debug shows where)"
        err.print(f"error: {text}", style="red", soft_wrap=True)
        sys.exit(_exit_code(error))


def _show_warning(message: Warning | str, *where: object) -> None:
    """One line, without the place in the code."""
    del where
    err.print(f"warning: {' '.join(str(message).split())}", soft_wrap=True)


def _exit_code(error: BaseException) -> int:
    """Wrong use: an argument that cannot be right. Failure: a file that cannot be read or written."""
    wrong = isinstance(error, WrongUse | FileNotFoundError) or _names_an_option(str(error))
    return WRONG_USE if wrong else FAILURE


def _names_an_option(text: str) -> bool:
    """Whether an error of the floors below is about what the user gave by an option of the same name."""
    if ":" not in text:
        return False
    commands = list(loaded().values())
    for command in commands:  # of groups, those within too
        commands.extend(getattr(command, "commands", {}).values())
    options = {option for command in commands for part in command.params for option in part.opts}
    return as_option(text).partition(":")[0] in options
