"""Runs the command and converts errors into one line and an exit code."""

import errno
import re
import sys
import warnings

from foldgauss._runtime.checks import invalid, require
from foldgauss._runtime.interrupts import raise_on_sigterm
from foldgauss.cli.app.application import Stopped, err, root_command, warn
from foldgauss.cli.app.help import WrongUse

#: Exit codes.
WRONG_USE = 2
FAILURE = 1
#: Errors of the system that writing raises: closed pipes, full disks, quotas, limits on files, broken devices.
OUTPUT_ERRORS = (errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF)


def main(arguments: list[str] | None = None) -> None:
    """Run the command and exit: 0 success, 2 wrong usage, 1 failure, 143 SIGTERM; one-line errors unless --debug."""
    with raise_on_sigterm():
        _run(arguments)


def _run(arguments: list[str] | None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments  # removed, so that it may be anywhere
    try:
        require(
            all(argument and not re.fullmatch("--[a-z-]+=", argument) for argument in arguments),
            "arguments",
            expected="a value for each",
            got="an empty one",  # as a path it would be the current folder
            cure="Leave it out, or set the shell variable that it stands for.",
            kind=WrongUse,
        )
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            root_command()([argument for argument in arguments if argument != "--debug"], prog_name="foldgauss")
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            raise
        if isinstance(error, SystemError) and isinstance(error.__cause__, KeyboardInterrupt):
            error = error.__cause__  # Ctrl-C while a compiled kernel returned
        text = " ".join(_describe(error).split()) or type(error).__name__
        if not isinstance(error, ValueError | OSError | MemoryError | Stopped | KeyboardInterrupt):
            text = f"{type(error).__name__}: {text[:300]} (--debug shows the traceback)"
        err.print(f"error: {text}", style="red", soft_wrap=True)
        sys.exit(WRONG_USE if isinstance(error, WrongUse | FileNotFoundError) else FAILURE)


def _describe(error: BaseException) -> str:
    """The message of an error. Errors of the system are worded as ours, and name the path or the output."""
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error)
    if error.filename is None:
        if error.errno not in OUTPUT_ERRORS:
            return f"the system refused: {error.strerror}."
        return f"output: expected one that can be written, got one that cannot ({error.strerror})."
    cure = "Choose another, or change its permissions."
    got = f"{str(error.filename)!r} ({error.strerror})"
    return str(invalid("path", expected="one that can be used", got=got, cure=cure))


def _show_warning(message: Warning | str, *where: object) -> None:
    """One line, without the place in the code."""
    warn(" ".join(str(message).split()))
