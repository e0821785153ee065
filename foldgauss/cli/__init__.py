"""The command `foldgauss`: arguments, progress display, printing and exit codes. The other packages do the work.

`app` is the application: its registry of commands, help and error handling. `shared` has what commands share, and
`fitting`, `viewing`, `editing` and `measuring` the commands. `main` is the entry point.
"""

from foldgauss._runtime.interrupts import use_default_signals


def main(arguments: list[str] | None = None) -> None:
    """Run the command and exit: 0 success, 2 wrong usage, 1 failure, 143 SIGTERM; one-line errors unless --debug."""
    with use_default_signals():
        from foldgauss.cli.app import main
    main.main(arguments)
