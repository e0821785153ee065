"""The command `foldgauss`: arguments and exit codes. The work is done on the floors below."""

from foldgauss._runtime.interrupts import use_default_signals


def main(arguments: list[str] | None = None) -> None:
    """Run the command and exit: 0 fine, 2 wrong use, 1 failure, 143 for SIGTERM; one-line errors unless --debug."""
    with use_default_signals():
        from foldgauss.cli.app import main
    main.main(arguments)
