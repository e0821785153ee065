"""Pytest in forked processes, which find the libraries imported already: that takes longer than most tests.

Reads a line of arguments (JSON) from the standard input for each run, and writes its exit code and last lines (JSON).
The working directory is the checkout; none of its own modules is imported before the fork.
"""

import json
import os
import resource
import runpy
import sys

runpy.run_path("tests/conftest.py")  # its settings must precede the import of JAX

import equinox  # noqa: E402, F401
import numba.core.caching  # noqa: E402, F401
import optax  # noqa: E402, F401
import pytest  # noqa: E402
import scipy.integrate  # noqa: E402
import scipy.interpolate  # noqa: E402
import scipy.stats  # noqa: E402, F401
import sklearn.mixture  # noqa: E402, F401

#: CPU seconds of a run.
LIMIT = 900


def run(arguments: list[str]) -> tuple[int, list[str]]:
    with open("output", "w+") as output:
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT))
            resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))  # a mutant may allocate without end
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            # JAX's libraries import a plugin of pytest, which warns that it cannot rewrite its assertions.
            code = pytest.main(["-W", "ignore::pytest.PytestAssertRewriteWarning", *arguments])
            sys.stdout.flush()
            os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        output.seek(0)
        return code, output.read().splitlines()[-50:]


if __name__ == "__main__":
    for line in sys.stdin:
        print(json.dumps(run(json.loads(line))), flush=True)
