"""The command as the tests call it."""

import pytest

from foldgauss import cli


def run(*arguments):
    """Exit code of the command, run in this process."""
    with pytest.raises(SystemExit) as done:
        cli.main([str(argument) for argument in arguments])
    return done.value.code or 0
